"""Clocks that break: frames that a camera lost, or wrote twice, without saying so, and recordings whose times say it.

After a break the files of two cameras are in step no more, whatever one offset says.  ``dyntorch.tasks.breaks`` finds the moments
from the same joints in both; here they are looked for in what was compared, and takes get the times of their frames as they were.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from indexing.clip import Clip
from indexing.sync.calibration import lenses
from indexing.sync.options import SyncOptions
from indexing.sync.people import Pairing, common_joints
from indexing.sync.recordings import Take

if TYPE_CHECKING:
    from dyntorch import Clocks

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RepairedClocks:
    """Recordings whose clocks broke, with times as if they had not."""

    found: Any
    takes: tuple[Take, ...]

    @property
    def is_attributed(self) -> bool:
        """Whether it is known whose clock broke, as far as it can be: of three cameras the other pairs of both must say so, too."""
        return len(self.takes) == 2 or all(one.camera is not None for one in self.found.breaks)

    def as_json(self) -> list[dict[str, Any]]:
        """Every break in plain types."""
        return [
            {
                "camera": None if one.camera is None else self.takes[one.camera].name,
                "candidates": [self.takes[camera].name for camera in one.candidates],
                "times": list(one.moments), "sigma": one.sigma, "jump": one.jump, "jump_sigma": one.jump_sigma,
                "frames": one.frames, "twice": one.doubled, "evidence": one.evidence, "residuals": list(one.residuals),
            }
            for one in self.found.breaks
        ]  # fmt: skip


def find_breaks(
    takes: Sequence[Take],
    compared: Mapping[tuple[int, int], Pairing],
    together: Clocks | None = None,
    *,
    calibration: Any = None,
    max_shift: float | None = None,
    options: SyncOptions | None = None,
) -> RepairedClocks | None:
    """Where the clocks of cameras broke; None where they did not, or where nothing tells: other joints in each, or no
    keypoints. compared ``(i, j)``."""
    import dyntorch

    people = _people(takes, compared)
    if people is None:
        return None
    lens = lenses(calibration, [take.name for take in takes])
    known = any(clip.confidence is not None for clip in people)
    given: dict[str, Any] = {
        "times": tuple(torch.from_numpy(np.array(clip.times, dtype=np.float64)) for clip in people),
        "weights": tuple(torch.from_numpy(_trust(clip)) for clip in people) if known else None,
        "calibration": lens.values if lens else None,
        "max_shift": max_shift,
        "options": (options or SyncOptions()).of_points,
    }
    tracks = [torch.from_numpy(np.array(clip.joints, dtype=np.float64)) for clip in people]
    if together is None:
        found = dyntorch.tasks.breaks(tracks[0], tracks[1], compared[0, 1].shift, **given)
    else:
        found = dyntorch.tasks.camera_breaks(tracks, together, **given)
    if not (found.ok and found.breaks):
        return None
    names = {str(i): take.name for i, take in enumerate(takes)}
    named = dataclasses.replace(found, notices=tuple(notice.with_names(names) for notice in found.notices))
    changes: list[Floats] = [times.numpy() - clip.times for times, clip in zip(found.times, people, strict=True)]
    return RepairedClocks(
        named,
        tuple(retime(take, np.asarray(clip.times, np.float64), by) for take, clip, by in zip(takes, people, changes, strict=True)),
    )


def _people(takes: Sequence[Take], compared: Mapping[tuple[int, int], Pairing]) -> list[Clip] | None:
    """The person of each camera, with joints that all of them have; None where they have other ones."""
    if any(take.kind != "keypoints" or take.spatial for take in takes):
        return None
    chosen = []
    for number, take in enumerate(takes):
        mine = [(one.shift.confidence, one.people[pair.index(number)]) for pair, one in compared.items() if number in pair]
        chosen.append(take.people[max(mine)[1]])
    first = chosen[0]
    for clip in chosen[1:]:
        first, _, same, _ = common_joints(first, clip)
        if not same:
            return None
    return [common_joints(first, clip)[1] for clip in chosen]


def _trust(clip: Clip) -> Floats:
    if clip.confidence is None:
        return np.where(clip.seen, 1.0, 0.0)
    return np.asarray(np.nan_to_num(np.clip(clip.confidence, 0.0, None)), dtype=np.float64)


def retime(take: Take, times: Floats, by: Floats) -> Take:
    """A recording whose clock is changed. times ``(k,)``, by ``(k,)``."""

    def new(old: Floats) -> Floats:
        rows = np.clip(np.searchsorted(times, old + 1e-9, side="right") - 1, 0, len(times) - 1)
        return np.asarray(old + by[rows], dtype=np.float64)

    if not by.any():
        return take
    changed = {id(clip): clip.replace(times=new(np.asarray(clip.times, np.float64))) for clip in (*take.people, *take.everyone)}
    people, everyone = (tuple(changed[id(clip)] for clip in clips) for clips in (take.people, take.everyone))
    return dataclasses.replace(take, people=people, everyone=everyone, times=new(take.times))
