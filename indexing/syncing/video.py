"""Synchronization where a camera gives no keypoints: tracks of whatever moves, and brightness, each a check of the other."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from indexing.syncing.takes import Take

if TYPE_CHECKING:
    from dyntorch import Shift

AGREE = 2.0  # frames within which two methods say the same
FEWEST = 4  # tracks
SMALL = 320  # pixels of the longer side: all that the brightness method looks at


def synchronize_videos(a: Take, b: Take, method: str, **options: Any) -> Shift:
    """Two recordings of which at least one is a video: by tracks, by brightness, or by both.

    Raises:
        ValueError: a video cannot be read.
    """
    options.pop("correspondence", None)  # tracks of two videos never correspond
    brightness = {name: value for name, value in options.items() if name == "max_shift"}
    if method == "brightness":
        return _brightness(a, b, **brightness)
    tracked = _tracks(a, b, **options)
    if method == "tracks" or "keypoints" in (a.kind, b.kind):
        return tracked
    try:
        bright = _brightness(a, b, **brightness)
    except ValueError as problem:  # too short for it; the files can be read, as the tracks show
        bright = refused(a, b, str(problem), [], "brightness")
    return agreed(tracked, bright)


def agreed(tracked: Shift, bright: Shift) -> Shift:
    """One answer from two methods: the tracks' where both are sure of the same, a refusal with both where they are not.

    The two know nothing of each other's data, so that what one suspects and the other is sure of is taken, too.
    """
    both = (tracked, bright)
    sure = [shift for shift in both if shift.ok]
    said = f"tracks say {_told(tracked)}, brightness says {_told(bright)}"
    best = sure[0] if sure else max(both, key=lambda shift: shift.confidence)
    other = bright if best is tracked else tracked
    notes = [said, *best.notes, *(note for note in other.notes if note not in best.notes)]
    apart = min((abs(offset - _middle(best)) for offset in _candidates(other)), default=float("inf"))
    if sure and apart <= AGREE / min(best.fps):
        return dataclasses.replace(best, notes=tuple(notes))
    peaks = torch.cat([best.peaks, other.peaks])  # scores of two methods: each list is in order, and the best one's comes first
    reason = f"{said}; record keypoints of the people, or a longer take with more motion"
    if not sure:
        reason = f"neither tracks nor brightness decide: {tracked.reason or 'no tracks'}; {bright.reason}"
    return dataclasses.replace(best, ok=False, reason=reason, peaks=peaks, notes=tuple(notes))


def _told(shift: Shift) -> str:
    if not len(shift.peaks):
        return "nothing"
    return f"{_middle(shift):+.3f} s ({'sure' if shift.ok else 'not sure'})"


def _middle(shift: Shift) -> float:
    return float(shift.at(shift.center)) - shift.center


def _candidates(shift: Shift) -> list[float]:
    """What a method holds possible: its answer where it is sure, else its peaks."""
    return [_middle(shift)] if shift.ok else [_middle(shift), *shift.peaks[:, 0].tolist()]


def _tracks(a: Take, b: Take, *, calibration: Any = None, **options: Any) -> Shift:
    """Different points in both: trajectories that span meeting subspaces."""
    import dyntorch

    found = [points_of(take) for take in (a, b)]
    notes = [note for *_, more in found for note in more]
    few = [take.name for take, (points, _, _) in zip((a, b), found, strict=True) if points.shape[1] < FEWEST]
    if few:
        return refused(a, b, f"fewer than {FEWEST} moving points could be followed in {' and '.join(few)}; use keypoints", notes)
    shift: Shift = dyntorch.synchronize(
        found[0][0],
        found[1][0],
        correspondence=False,
        times=(found[0][1], found[1][1]),
        calibration=calibration,
        **options,
    )
    return dataclasses.replace(shift, notes=(*notes, *shift.notes))


def points_of(take: Take) -> tuple[Tensor, Tensor, list[str]]:
    """``(frames, n, 2)`` of whatever moves, ``(frames,)`` seconds, and what to say about it."""
    if take.kind == "keypoints":
        clip = take.people[0]
        return torch.from_numpy(np.array(clip.joints, dtype=np.float64)), torch.from_numpy(clip.times.copy()), []
    from indexing.video import track_points

    tracks = track_points(source_of(take))
    return tracks.points, tracks.times, [f"{take.name}: {note}" for note in tracks.notes]


def source_of(take: Take) -> Any:
    """A video as the functions of :mod:`indexing.video` take it."""
    if take.path is not None:
        return take.path
    from indexing.video import Chunk

    assert take.frames is not None
    return [Chunk(gray_of(take), take.times)]


def gray_of(take: Take) -> Any:
    """``(frames, height, width)`` uint8; gray values from 0 to 1 are brought to 0 to 255."""
    assert take.frames is not None
    if take.frames.dtype == np.uint8:
        return take.frames
    values = np.nan_to_num(np.asarray(take.frames, dtype=np.float64))
    return (values * (255.0 if values.max(initial=0.0) <= 1.0 else 1.0)).clip(0, 255).astype(np.uint8)


def _brightness(a: Take, b: Take, **options: Any) -> Shift:
    """No points at all."""
    from indexing.brightness import brightness_shift
    from indexing.video import read_video

    sources = [iter(source_of(take)) if take.path is None else read_video(take.path, size=SMALL) for take in (a, b)]
    shift: Shift = brightness_shift(*sources, **options)
    return shift


def refused(a: Take, b: Take, reason: str, notes: list[str], method: str = "subspace") -> Shift:
    """What is said where there is nothing to compare."""
    from dyntorch import Shift

    none = torch.zeros(0, dtype=torch.float64)
    return Shift(
        offset=0.0, sigma=float("inf"), rate=1.0, rate_sigma=0.0, confidence=0.0, peaks=none.reshape(0, 2), ok=False, reason=reason,
        method=method, fps=(a.fps, b.fps), center=0.0, lags=none, scores=none, notes=tuple(notes),
    )  # fmt: skip
