"""Keypoint files and motion capture on one clock: equal frame numbers are equal moments, as Pose2Sim's ``pose-sync`` has them.

Pose2Sim aligns cameras by copying the files under shifted frame numbers; a folder ``pose-sync`` beside ``pose`` is what its
next step reads.  Here every frame number of the reference camera takes the nearest frame of each other camera: a shift by whole
frames where the clocks run alike, and a frame repeated or left out now and then where they do not.

Motion capture (``mocap-sync``) keeps its frames as they are, numbered from the camera's number 0: to interpolate would smooth what
was measured.  Times of a TRC file are exact; a C3D file has but a rate and the number of its first frame, so that its frames are
off by half a sample at most, which is said.  Analog channels and events stay in the original, whose offset is in ``sync.json``.
"""

from __future__ import annotations

import json
import math
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from indexing.clip import Clip
from indexing.files import prepare, replacing_folder, write_bytes
from indexing.opening import error, parse_json, read_text
from indexing.readers.files import detect_json, frame_number, load_json
from indexing.readers.recording import METRES
from indexing.sync.recordings import Take, joint_weights

POSE_FOLDER = "pose-sync"


NEAR = 0.5 + 1e-6  # frames: no other frame is nearer


def count_repeated(rows: NDArray[np.int64]) -> int:
    """How many of the frames ``(n,)`` stand more than once."""
    return len(rows) - len(np.unique(rows))


@dataclass(frozen=True, eq=False)
class Plan:
    """Which frame of a camera stands for which moment of the reference. numbers ``(k,)``, rows ``(k,)``."""

    take: Take
    numbers: NDArray[np.int64]
    rows: NDArray[np.int64]
    rest: float
    before: int

    @property
    def num_repeated(self) -> int:
        """How many frames stand for more than one moment."""
        return count_repeated(self.rows)

    @property
    def shift(self) -> int | None:
        """What is taken off the frame numbers where that is the same for all frames; None where it is not."""
        off = np.unique(np.rint(self.take.times[self.rows] * self.take.fps).astype(np.int64) - self.numbers)
        return int(off[0]) if len(off) == 1 else None


def plan(take: Take, offset: float, rate: float, fps: float, times: NDArray[np.float64] | None = None) -> Plan:
    """Match a camera's frames with the frame numbers of the reference camera. times ``(frames,)``."""
    times = take.times if times is None else times
    nearest = np.floor((times - offset) / rate * fps).astype(np.int64)
    reach = int(np.ceil(NEAR * fps / (rate * take.fps)))  # numbers on either side that one frame may stand for
    numbers = np.unique(nearest[:, None] + np.arange(-reach, reach + 2))
    numbers = numbers[numbers >= 0]
    wanted = rate * numbers / fps + offset
    after = np.clip(np.searchsorted(times, wanted), 0, len(times) - 1)
    before = np.maximum(after - 1, 0)
    rows = np.where(np.abs(times[before] - wanted) <= np.abs(times[after] - wanted) - 1e-9, before, after)
    apart = np.abs(times[rows] - wanted)
    keep = apart <= NEAR / take.fps
    earlier = int((times < offset - NEAR / take.fps).sum())
    return Plan(take, numbers[keep], rows[keep], float(apart[keep].max(initial=0.0)), earlier)


def check_target(folder: Path, inputs: Sequence[Path]) -> None:
    """Raise where the shifted files would replace an input, or a folder that this command did not write.

    Raises:
        ValueError: naming what is in the way.
    """
    target = folder / POSE_FOLDER
    same = [path for path in inputs if path.is_dir() and path.resolve() == folder.resolve()]
    if same:
        raise ValueError(f"{same[0]}: is an input, and files of the report among its frames would spoil it; choose another --out")
    check_inputs(target, inputs)
    if target.exists() and not owns_poses(folder):
        raise not_ours(target)


def check_inputs(target: Path, inputs: Sequence[Path]) -> None:
    """Raise where a folder that is to be replaced holds an input."""
    inside = [path for path in inputs if target.resolve() in (path.resolve(), *path.resolve().parents)]
    if inside:
        raise ValueError(f"{inside[0]}: is an input, and {target} would be replaced; choose another folder for --out")


def not_ours(path: Path) -> ValueError:
    """The error where something is there that this command did not write."""
    return ValueError(f"{path}: is there, and not from this command; move it away, or choose another folder for --out")


def owns_poses(folder: Path) -> bool:
    """Whether an earlier run of this command wrote the folder's shifted files."""
    try:
        known = parse_json(folder, read_text(folder / "sync.json"), "")
        return str(known["manifest"]["arguments"]["command"]) == "sync"
    except (ValueError, KeyError, TypeError):
        return False


def write_poses(folder: Path, plans: Sequence[Plan], count: int | None = None) -> Path:
    """Write ``pose-sync/<camera>_json/`` for every camera: all of them, or nothing."""
    target = folder / POSE_FOLDER
    with replacing_folder(target) as building:
        for matched in (matched for matched in plans if len(matched.rows)):
            _write_camera(building / folder_of(matched.take), matched, count)
    return target


def drop_poses(folder: Path) -> bool:
    """Remove the shifted files of an earlier run, which a refusal has taken the ground from."""
    target = folder / POSE_FOLDER
    if not (target.is_dir() and owns_poses(folder)):
        return False
    shutil.rmtree(target)
    return True


def folder_of(take: Take) -> str:
    """The name of the folder of a camera's shifted files: that of its own files, by which Pose2Sim finds them again."""
    own = take.path is not None and take.path.is_dir() and "json" in take.path.name
    return take.path.name if own and take.path is not None else f"{take.name}_json"


def _write_camera(folder: Path, matched: Plan, count: int | None = None) -> None:
    folder.mkdir()
    sources = source_files(matched.take)
    texts = [] if sources else openpose_frames(matched.take)
    like = next(iter(sources.values())).name if sources else f"{matched.take.name}_000000.json"
    written = set()
    for number, row in zip(matched.numbers.tolist(), matched.rows.tolist(), strict=True):
        if number >= (count or math.inf) or (sources and row not in sources):
            continue
        if sources:
            shutil.copyfile(sources[row], folder / renumber(sources[row].name, number))
        else:
            (folder / renumber(like, number)).write_text(texts[row], encoding="utf-8")
        written.add(number)
    for number in set(range(count or 0)) - written:
        (folder / renumber(like, number)).write_text(openpose_frame([]), encoding="utf-8")


def source_files(take: Take) -> dict[int, Path]:
    """Row of a frame -> its file, where the camera is a folder of OpenPose JSON."""
    by_number = {int(np.rint(time * take.fps)): row for row, time in enumerate(take.times)}
    return {by_number[number]: path for number, path in openpose_files(take.path).items() if number in by_number}


def openpose_files(path: Path | None) -> dict[int, Path]:
    """Frame number -> file, where the camera is a folder of OpenPose JSON."""
    if path is None or not path.is_dir():
        return {}
    found = [entry for entry in sorted(path.iterdir()) if entry.suffix.lower() == ".json" and not entry.name.startswith(".")]
    if not found or next((kind for file in found if (kind := detect_json(file, load_json(file)))), None) != "openpose":
        return {}
    return {number: file for file in found if (number := frame_number(file.name)) is not None}


def renumber(name: str, number: int) -> str:
    """A file name with another frame number, at least as many digits."""
    stem, dot, suffix = name.rpartition(".")
    found = re.search(r"(\d{1,18})(?=_keypoints)", stem) or re.search(r"(\d{1,18})(?=\D*$)", stem)
    if found is None:
        raise error(name, "the file name has no frame number", "name frames by number")
    return f"{stem[: found.start()]}{number:0{len(found[0])}d}{stem[found.end() :]}{dot}{suffix}"


def openpose_frames(take: Take) -> list[str]:
    """A camera's people as OpenPose JSON, one text per frame; a joint not seen is 0, 0, 0."""
    people: list[list[tuple[int, NDArray[np.float64]]]] = [[] for _ in take.times]
    for index, clip in enumerate(take.everyone):
        rows = np.searchsorted(take.times, clip.times)
        for row, table, seen in zip(rows.tolist(), keypoint_table(clip), np.asarray(clip.seen.any(axis=1)).tolist(), strict=True):
            if seen:
                people[row].append((index if len(take.everyone) > 1 else -1, table))
    return [openpose_frame(present) for present in people]


def openpose_frame(people: Sequence[tuple[int, NDArray[np.float64]]]) -> str:
    """One frame's people, each a number and a table ``(joints, 3)`` of x, y and confidence."""
    entries = [{"person_id": [who], "pose_keypoints_2d": table.ravel().tolist()} for who, table in people]
    return json.dumps({"version": 1.3, "people": entries})


def keypoint_table(clip: Clip) -> NDArray[np.float64]:
    """``(frames, joints, 3)`` x, y and confidence of a 2D clip; 0 where a joint is not seen."""
    table = np.concatenate([clip.joints, joint_weights(clip)[..., None]], axis=2)
    return np.asarray(np.where(clip.seen[..., None], table, 0.0), dtype=np.float64)


MOCAP_FOLDER = "mocap-sync"


@dataclass(frozen=True, eq=False)
class RetimedMocap:
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


def retime_mocap(take: Take, offset: float, rate: float) -> RetimedMocap | None:
    """Motion capture on the reference's clock; None where it ended before the reference's number 0."""
    half = 0.5 / take.fps
    kept = take.times >= offset - half
    if not kept.any():
        return None
    first = int(np.argmax(kept))
    c3d = take.path is not None and take.path.suffix.lower() == ".c3d"
    begin = (float(take.times[first]) - offset) / rate
    moved = -begin if c3d else 0.0  # its first frame is at number 0, whatever is left
    return RetimedMocap(
        take=take,
        people=tuple(_retime_clip(clip, offset, rate, float(take.times[first]), moved, c3d) for clip in take.everyone),
        name=f"{take.name}{'.c3d' if c3d else '.trc'}",
        first=first,
        rest=abs(moved),
    )


def _retime_clip(clip: Clip, offset: float, rate: float, since: float, more: float, millimetres: bool) -> Clip:
    """A person on the reference's clock; in millimetres, as C3D files usually are, where the unit is known."""
    kept = clip.times >= since - 1e-9
    times = np.asarray((clip.times[kept] - offset) / rate + more, dtype=np.float64)
    known = millimetres and clip.meta.get("units") == "m"
    meta = {**clip.meta, "units": "mm"} if known else clip.meta
    fps = None if clip.fps is None else clip.fps * rate
    confidence = None if clip.confidence is None else clip.confidence[kept]
    joints = clip.joints[kept] / (METRES["mm"] if known else 1.0)
    return clip.replace(joints=joints, times=times, fps=fps, confidence=confidence, meta=meta)


def write_mocap(folder: Path, one: RetimedMocap) -> list[str]:
    """Write ``mocap-sync/NAME.trc`` or ``.c3d``, whole or not at all; what to know of it, a sentence each."""
    from indexing.writers import encode

    target = folder / MOCAP_FOLDER / one.name
    data, notes = encode(one.people, target)
    prepare(target.parent)
    write_bytes(target, data)
    if target.suffix == ".c3d":
        notes.append("analog channels and events are left where they are")
    return [f"{MOCAP_FOLDER}/{one.name}: {note}" for note in notes]


def check_mocap(folder: Path, takes: Sequence[Path]) -> None:
    """Raise where the file would replace an input, or stand among files that this command did not write."""
    target = folder / MOCAP_FOLDER
    check_inputs(target, takes)
    if target.exists() and not _owns_mocap(folder):
        raise not_ours(target)


def drop_mocap(folder: Path) -> bool:
    """Remove what an earlier run of this command wrote there."""
    target = folder / MOCAP_FOLDER
    if not (target.is_dir() and _owns_mocap(folder)):
        return False
    shutil.rmtree(target)
    return True


def _owns_mocap(folder: Path) -> bool:
    """Whether an earlier run wrote the folder's motion capture: its results name the file."""
    try:
        known = parse_json(folder, read_text(folder / "sync.json"), "")
        return any(str((one.get("shifted") or {}).get("folder", "")).startswith(f"{MOCAP_FOLDER}/") for one in known["cameras"])
    except (ValueError, KeyError, TypeError, AttributeError, json.JSONDecodeError):
        return False
