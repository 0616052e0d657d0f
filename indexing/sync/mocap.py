"""Motion capture on the clock of the reference camera: the recorded frames as they are, numbered from the camera's number 0.

No frame is interpolated: that would smooth what was measured.  Times of a TRC file are exact; a C3D file has but a rate and the
number of its first frame, so that its frames are off by half a sample at most, which is said.  Analog channels and events stay in
the original, whose offset is in ``sync.json``.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from indexing.clip import Clip
from indexing.files import prepare, write_bytes
from indexing.opening import parse_json, read_text
from indexing.readers.markers import METRES
from indexing.sync.takes import Take

FOLDER = "mocap-sync"


@dataclass(frozen=True, eq=False)
class Retimed:
    """Motion capture from the reference's number 0 on."""

    take: Take
    people: tuple[Clip, ...]
    name: str
    first: int
    rest: float

    @property
    def frames(self) -> int:
        """How many are kept."""
        return self.take.count - self.first


def retimed(take: Take, offset: float, rate: float) -> Retimed | None:
    """Motion capture on the reference's clock; None where it ended before the reference's number 0."""
    half = 0.5 / take.fps
    kept = take.times >= offset - half
    if not kept.any():
        return None
    first = int(np.argmax(kept))
    c3d = take.path is not None and take.path.suffix.lower() == ".c3d"
    begin = (float(take.times[first]) - offset) / rate
    moved = -begin if c3d else 0.0  # its first frame is at number 0, whatever is left
    return Retimed(
        take=take,
        people=tuple(_moved(clip, offset, rate, float(take.times[first]), moved, c3d) for clip in take.everyone),
        name=f"{take.name}{'.c3d' if c3d else '.trc'}",
        first=first,
        rest=abs(moved),
    )


def _moved(clip: Clip, offset: float, rate: float, since: float, more: float, millimetres: bool) -> Clip:
    """A person on the reference's clock; in millimetres, as C3D files usually are, where the unit is known."""
    kept = clip.times >= since - 1e-9
    times = np.asarray((clip.times[kept] - offset) / rate + more, dtype=np.float64)
    known = millimetres and clip.meta.get("units") == "m"
    meta = {**clip.meta, "units": "mm"} if known else clip.meta
    fps = None if clip.fps is None else clip.fps * rate
    confidence = None if clip.confidence is None else clip.confidence[kept]
    joints = clip.joints[kept] / (METRES["mm"] if known else 1.0)
    return clip.replace(joints=joints, times=times, fps=fps, confidence=confidence, meta=meta)


def write_mocap(folder: Path, one: Retimed) -> list[str]:
    """Write ``mocap-sync/NAME.trc`` or ``.c3d``, whole or not at all; what to know of it, a sentence each."""
    from indexing.writers import encode

    target = folder / FOLDER / one.name
    data, notes = encode(one.people, target)
    prepare(target.parent)
    write_bytes(target, data)
    if target.suffix == ".c3d":
        notes.append("analog channels and events are left where they are")
    return [f"{FOLDER}/{one.name}: {note}" for note in notes]


def check_mocap(folder: Path, takes: Sequence[Path]) -> None:
    """Raise where the file would replace an input, or stand among files that this command did not write."""
    target = folder / FOLDER
    inside = [path for path in takes if target.resolve() in path.resolve().parents]
    if inside:
        raise ValueError(f"{inside[0]}: is an input, and {target} would be replaced; choose another folder for --out")
    if target.exists() and not _ours(folder):
        raise ValueError(f"{target}: is there, and not from this command; move it away, or choose another folder for --out")


def drop_mocap(folder: Path) -> bool:
    """Remove what an earlier run of this command wrote there."""
    target = folder / FOLDER
    if not (target.is_dir() and _ours(folder)):
        return False
    shutil.rmtree(target)
    return True


def _ours(folder: Path) -> bool:
    """Whether an earlier run wrote the folder's motion capture: its results name the file."""
    try:
        known = parse_json(folder, read_text(folder / "sync.json"), "")
        return any(str((one.get("shifted") or {}).get("folder", "")).startswith(f"{FOLDER}/") for one in known["cameras"])
    except (ValueError, KeyError, TypeError, AttributeError, json.JSONDecodeError):
        return False
