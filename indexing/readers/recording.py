"""Detections of any format -> clips: the one place that decides about people, missing joints and times.

A format turns its file into a :class:`Recording` (directly, or through :func:`collect_detections` where the file lists people frame
by frame); :func:`to_clips` does the rest, the same for all formats.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dyntorch.numerics import Message
from indexing.clip import LARGEST, Clip, ClipSet, FloatArray
from indexing.joints import check_named_layout, choose_layout, estimate_up
from indexing.opening import error, quote
from indexing.readers.files import Options
from indexing.skeleton import LAYOUTS, Skeleton

# ----------------------------------------------------------------------------------------------------------------------
# Who is who where a frame shows several people: the one place where that is decided.
#
# An *identity* is a set of detections, at most one per frame, taken to be one person: the tracker's ids where the file has
# them, otherwise people linked from frame to frame by position (:func:`link_by_position`).  On identities the rules are:
#
# - ``"largest"``: in each frame, the identity with the largest bounding boxes, summed over the whole recording, of those
#   present.  It does not hop between two people who are both there, and it continues with the next largest where that
#   person is absent, so broken tracks of one person join up.
# - ``"confident"``: the same with mean joint confidence in place of the area.
# - ``"tracked"``: one identity only, and empty frames where it is absent: the id seen in most frames (of equals, the larger);
#   without ids, the identity with the largest summed box.
# - ``"all"``: every tracked identity by itself; needs ids in the file.
# - ``"everyone"``: the same, with identities by position where the file has no ids; there, all frames of the one person where
#   never two are in view together.
#
# Ids that repeat within a frame are not identities (some tools write the same id for everybody) and are not used.
# Detections without an id, in a file that has ids, are used by ``"largest"`` and ``"confident"`` where no other is there.


IntArray = NDArray[np.int64]
POINT_BOX_SHARE = 0.2  # of the scene, that counts as the box of a person of whom there is only one point
MAX_STEP_DIAGONALS = 0.5
"""Box diagonals: a joint moves less from one detection of a person to the next, another person is farther away."""
MAX_WAITING = 256
"""Identities that are waited for at most, the latest seen: where nobody matches, the time for all detections is linear."""
MAX_ABSENCE_SECONDS = 2.0
"""Without a person, of which that person's own clip keeps no frames: an hour of 200 people who come and go would take 6 GB."""
MIN_CROWDED_SHARE = 0.05
"""Of the frames with somebody that show several people, from where on a clip says how many."""


def select_people(path: Path, recording: Recording, person: str) -> list[tuple[Hashable | None, IntArray]]:
    """The detections that make each clip."""
    ids, names, repeated = _read_ids(recording)
    if person == "all" and ids is None:
        why = f"its person ids repeat in frame {repeated}" if repeated is not None else "it has no person ids"
        what = Message("{arg:person='all'} needs tracked people, but {why}", why=why)
        raise error(path, what, Message("run a tracker, or use {arg:person='largest'} or 'tracked'"))
    alone = ids is None and len(np.unique(recording.at)) == len(recording.at)  # never more than one person
    if person == "everyone" and alone:
        return [(None, np.arange(len(recording.at)))]
    if person in ("all", "everyone"):
        ids = link_by_position(recording.at, recording.joints) if ids is None else ids
        return [(name, np.flatnonzero(ids == i)) for i, name in enumerate(names or range(int(ids.max()) + 1))]
    if person == "confident" and recording.confidence is None:
        what = Message("has no confidences, so {arg:person='confident'} cannot be applied")
        raise error(path, what, Message("use {arg:person='largest'} or 'tracked'"))
    if alone:
        return [(None, np.arange(len(recording.at)))]
    area = np.sort(_extents(recording.joints), axis=1)[:, -2:].prod(axis=1)  # of the box; in 3D, of its largest face
    weight = recording.confidence.mean(axis=1) if person == "confident" and recording.confidence is not None else area
    tracked = ids is not None
    if ids is None:
        ids = link_by_position(recording.at, recording.joints)
    safe_ids = np.maximum(ids, 0)
    total = np.bincount(safe_ids, weight * (ids >= 0))
    if person == "tracked":
        count = np.bincount(safe_ids, ids >= 0) if tracked else np.zeros(len(total))
        best = np.lexsort((total, count))[-1]
        return [(names[best] if tracked else None, np.flatnonzero(ids == best))]
    rank = np.where(ids >= 0, total[safe_ids], -1.0)
    order = np.lexsort((weight, rank, recording.at))  # by frame, and within it the best last
    last = np.append(np.diff(recording.at[order]) > 0, True)
    return [(None, order[last])]


def _read_ids(recording: Recording) -> tuple[IntArray | None, list[Hashable], int | None]:
    """Ids 0, 1, ... of the detections (-1: none) and their names; None, and the frame where they repeat, if unusable."""
    if recording.tracks is None or all(track is None for track in recording.tracks):
        return None, [], None
    index: dict[Hashable, int] = {}
    for track in recording.tracks:
        if track is not None:
            index.setdefault(track, len(index))
    ids = np.array([-1 if track is None else index[track] for track in recording.tracks], dtype=np.int64)
    pairs = np.stack([recording.at[ids >= 0], ids[ids >= 0]], axis=1)
    unique, counts = np.unique(pairs, axis=0, return_counts=True)
    if (counts > 1).any():
        return None, [], int(recording.frames[unique[np.argmax(counts > 1), 0]])
    return ids, list(index), None


def link_by_position(at: IntArray, joints: FloatArray) -> IntArray:
    """Identities by position: each detection continues the nearest identity, nearest pairs first. at ``(m,)``, joints
    ``(m, n, 2 | 3)`` -> ``(m,)``."""
    identity = np.full(len(at), -1, dtype=np.int64)
    count, waiting = 0, np.zeros(0, dtype=np.int64)
    last = np.zeros(len(at), dtype=np.int64)  # per identity, its latest detection,
    step = np.zeros((len(at), joints.shape[2]))  # and how far it had moved since the one before
    diagonal = np.linalg.norm(_extents(joints), axis=1)
    if len(at) and not (diagonal > 0).any():
        if len(np.unique(at)) == len(at):
            return np.zeros(len(at), dtype=np.int64)
        diagonal[:] = POINT_BOX_SHARE * np.linalg.norm(_extents(joints.reshape(1, -1, joints.shape[2])))
    for rows in np.split(np.argsort(at, kind="stable"), np.flatnonzero(np.diff(np.sort(at))) + 1):
        before = last[waiting]
        cost = _distances(joints[before] + step[waiting, None], joints[rows], np.maximum.outer(diagonal[before], diagonal[rows]))
        while cost.size and cost.min() <= MAX_STEP_DIAGONALS:
            old, new = (int(i) for i in np.unravel_index(int(np.argmin(cost)), cost.shape))
            who, row = waiting[old], rows[new]
            step[who] = np.nanmean(joints[row] - joints[last[who]], axis=0)
            identity[row], last[who] = who, row
            cost[old, :] = cost[:, new] = np.inf
        fresh = rows[identity[rows] < 0]
        identity[fresh] = np.arange(count, count + len(fresh))
        last[identity[fresh]] = fresh
        count += len(fresh)
        waiting = _latest(np.append(waiting, identity[fresh]), at, last, MAX_WAITING)
    return identity


def _latest(waiting: IntArray, at: IntArray, last: IntArray, most: int) -> IntArray:
    """Of some identities those that were seen last, ``most`` of them, and all seen in the same frame as the first of these."""
    if len(waiting) <= most:
        return waiting
    frames = at[last[waiting]]
    return waiting[frames >= np.partition(frames, -most)[-most]]


def _distances(awaited: FloatArray, candidates: FloatArray, size: FloatArray) -> FloatArray:
    """``(awaited, found)`` mean joint distance in units of ``size``; infinite where no joint is shown by both."""
    distances = np.linalg.norm(awaited[:, None] - candidates[None], axis=3)
    both = ~np.isnan(distances)
    shared = both.sum(axis=2)
    usable = (shared > 0) & (size > 0)
    mean = np.where(both, distances, 0.0).sum(axis=2) / np.maximum(shared, 1)
    return np.where(usable, mean / np.where(usable, size, 1.0), np.inf)


def _extents(joints: FloatArray) -> FloatArray:
    """``(m, d)`` sides of the boxes around the joints seen."""
    seen = ~np.isnan(joints)
    return np.asarray(np.where(seen, joints, -np.inf).max(axis=1) - np.where(seen, joints, np.inf).min(axis=1))


FOLLOWING = ("person", "followed", "untracked", "people")  # what is known of a clip because of who is followed in it
LAST_FRAME = 2**53  # whole numbers are exact below it
NORMALIZED = 4.0  # coordinates from 0 to 1 stay below it even for joints guessed outside the image; pixels do not


class Detection(NamedTuple):
    """One person in one frame, as the file says it."""

    joints: FloatArray  # (n, 2 | 3)
    confidence: FloatArray | None  # (n,)
    track: Hashable | None = None


@dataclass(frozen=True)
class Recording:
    """Everything one file says: ``m`` detections in ``f`` frames. frames ``(f,)``, at ``(m,)``, joints ``(m, n, 2 | 3)``,
    confidence ``(m, n)``, times ``(f,)``."""

    frames: IntArray
    at: IntArray
    joints: FloatArray
    confidence: FloatArray | None
    tracks: Sequence[Hashable | None] | None = None
    times: FloatArray | None = None
    skeleton: Skeleton | None = None
    up: str = "-y"
    layouts: tuple[Skeleton, ...] = ()
    meta: Mapping[str, Any] = field(default_factory=dict)


def dense_recording(
    path: Path, joints: FloatArray, confidence: FloatArray | None, frames: IntArray, people: Sequence[Hashable] | None,
    names: Sequence[str], bones: Sequence[tuple[int, int]] = (), **more: Any,
) -> Recording:  # fmt: skip
    """A recording with a row of everybody in each frame. joints ``(frames * people, n, d)``; people: tracked, by name."""
    at = np.repeat(np.arange(len(frames)), len(joints) // len(frames))
    tracks = None if people is None else list(people) * len(frames)
    return Recording(frames, at, joints, confidence, tracks, skeleton=Skeleton(path.stem, tuple(names), tuple(bones)), **more)


def parse_numbers(path: Path, where: str, value: Any) -> FloatArray:
    """An array of float64 from parsed JSON (``null`` = NaN)."""
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):  # of whole numbers of hundreds of digits
        raise error(path, f"{where}: expected numbers, got {quote(value)}", "export the file again") from None


def frame_numbers(path: Path, values: FloatArray) -> IntArray:
    """Frame numbers from a column of a table."""
    bad = np.flatnonzero(~(np.abs(values) < LAST_FRAME))
    if bad.size:
        raise error(path, f"data row {bad[0] + 1} has no frame number ({values[bad[0]]:g})", "number every row")
    return values.astype(np.int64)


def track_id(value: Any) -> Hashable | None:
    """A person's identity as trackers write it (a number or text, perhaps in a list); None where there is none (``-1``)."""
    while isinstance(value, list):
        value = value[0] if value else None
    if isinstance(value, (int, float)):
        return int(value) if 0 <= value < LAST_FRAME else None
    return value if isinstance(value, str) and value else None


def parse_flat_joints(path: Path, where: str, value: Any, width: int = 3) -> tuple[FloatArray, FloatArray]:
    """``(n, width - 1)`` joints and ``(n,)`` confidences from a flat list ``x, y, c, x, y, c, ...``."""
    array = parse_numbers(path, where, value)
    if array.ndim == 2 and array.shape[1] == width:  # some exporters keep one row per joint
        array = array.ravel()
    if array.ndim != 1 or array.size == 0 or array.size % width:
        what = f"{where}: expected a flat list of {width} numbers per joint, got shape {array.shape}"
        raise error(path, what, "export x, y and confidence of every joint")
    table = array.reshape(-1, width)
    return table[:, :-1], table[:, -1]


def collect_detections(path: Path, frames: Sequence[tuple[int, Sequence[Detection]]]) -> Recording:
    """A recording from the people of each frame."""
    frames = sorted(frames, key=lambda frame: frame[0])
    if frames and max(abs(frames[0][0]), abs(frames[-1][0])) >= LAST_FRAME:
        raise error(path, f"frame number {quote(frames[-1][0])} is beyond any recording", "number images by frame")
    detections = [(i, number, person) for i, (number, people) in enumerate(frames) for person in people]
    if not detections:
        raise NobodySeen(path, np.array([number for number, _ in frames], dtype=np.int64))
    shape = detections[0][2].joints.shape
    for _, number, person in detections:
        if person.joints.shape != shape:
            what = f"frame {number} has a person with joints {person.joints.shape}, frame {detections[0][1]} one with {shape}"
            raise error(path, what, "export every person with the same joint layout, or one file per layout")
    confidence = None
    if any(person.confidence is not None for *_, person in detections):
        confidence = np.stack([np.ones(shape[0]) if p.confidence is None else p.confidence for *_, p in detections])
    return Recording(
        frames=np.array([number for number, _ in frames], dtype=np.int64),
        at=np.array([i for i, *_ in detections], dtype=np.int64),
        joints=np.stack([person.joints for *_, person in detections]),
        confidence=confidence,
        tracks=[person.track for *_, person in detections],
    )


def to_clips(path: Path, recording: Recording, options: Options) -> ClipSet:
    """Choose people by ``options.person`` and make their clips."""
    recording = _assign_layout(path, _mask(path, _scale(path, recording, options), options.min_confidence), options)
    times, fps = _times(path, recording, options.fps)
    name = path.name or path.resolve().name
    each = options.person in ("all", "everyone")
    ids = _read_ids(recording)[0] if each else None
    followed = {"followed": "position"} if ids is None else {"followed": "ids", "untracked": int((ids < 0).sum())}
    crowd = np.bincount(recording.at)
    others = {"people": int(crowd.max())} if (crowd > 1).mean() > MIN_CROWDED_SHARE else {}
    meta = dict(recording.meta)
    clips = []
    for track, rows in select_people(path, recording, options.person):
        # each person's clip spans what was seen of that person
        one = each and track is not None
        frames = _select_frames(times, recording.at[rows], MAX_ABSENCE_SECONDS) if one else np.arange(len(times))
        joints, confidence = _fill(recording, rows, frames)
        clips.append(
            Clip(
                joints=joints,
                times=times[frames],
                confidence=confidence,
                fps=fps,
                label=options.label,
                name=f"{name}#{track}" if one else name,
                skeleton=recording.skeleton,
                up=recording.up,
                meta={**meta, "person": track, **followed} if each else meta | others,
                fps_assumed=recording.times is None and options.fps is None,
            )
        )
    return ClipSet(clips, name)


def merge_people(clips: Sequence[Clip]) -> Recording | None:
    """The recording that clips are the people of, as :func:`to_clips` gives them for ``person="everyone"``; of others None."""
    if not clips or not all("followed" in clip.meta and "person" in clip.meta for clip in clips):
        return None
    first, people = clips[0], [clip.meta["person"] for clip in clips]
    kinds = {(clip.joints.shape[1:], clip.up, clip.label) for clip in clips}
    if len(set(people)) < len(people) or len(kinds) > 1 or not any(clip.seen.any() for clip in clips):
        return None
    times = np.unique(np.concatenate([clip.times for clip in clips]))
    seen = [clip.seen.any(axis=1) for clip in clips]
    sure = [clip.seen * 1.0 if clip.confidence is None else clip.confidence for clip in clips]
    given, alone = any(clip.confidence is not None for clip in clips), len(clips) == 1
    return Recording(
        frames=np.arange(len(times)),
        at=np.concatenate([np.searchsorted(times, clip.times[rows]) for clip, rows in zip(clips, seen, strict=True)]),
        joints=np.concatenate([clip.joints[rows] for clip, rows in zip(clips, seen, strict=True)]),
        confidence=np.concatenate([one[rows] for one, rows in zip(sure, seen, strict=True)]) if given else None,
        tracks=None if alone else [person for person, rows in zip(people, seen, strict=True) for _ in range(int(rows.sum()))],
        times=times,
        skeleton=first.skeleton,
        up=first.up,
        meta={key: value for key, value in first.meta.items() if key not in FOLLOWING or (alone and key == "people")},
    )


class NobodySeen(ValueError):
    """A file without a single usable detection; of its frames, the numbers and the times (seconds) where it has them."""

    def __init__(self, path: Path, frames: IntArray, times: FloatArray | None = None) -> None:
        what = f"no person was detected in any of {len(frames)} frames"
        super().__init__(*error(path, what, Message("check the video, the estimator's threshold and {arg:min_confidence}")).args)
        self.frames, self.times = frames, times


def _assign_layout(path: Path, recording: Recording, options: Options) -> Recording:
    """Which joint is which: as the caller says, or where only their number is known, as the body looks."""
    if options.layout is not None:
        by_number = any(recording.skeleton is one for one in LAYOUTS.values())
        own = None if by_number else recording.skeleton
        meta = {key: value for key, value in recording.meta.items() if key != "layout"}
        return replace(recording, skeleton=check_named_layout(path, options.layout, recording.joints.shape[1], own), meta=meta)
    if not recording.layouts:
        return recording
    layout, message, _ = choose_layout(recording.joints, recording.skeleton, recording.layouts, recording.up)
    return replace(recording, skeleton=layout, meta={**recording.meta, **message})


def _select_frames(times: FloatArray, at: IntArray, away: float) -> IntArray:
    """The frames from the first to the last of a person, without those where nothing was seen of it for longer than ``away``."""
    seen = np.sort(at)
    frames = np.arange(int(seen[0]), int(seen[-1]) + 1)
    after = np.searchsorted(seen, frames)
    before = np.where(seen[after] == frames, after, after - 1)
    return np.asarray(frames[times[seen[after]] - times[seen[before]] <= away])


def _scale(path: Path, recording: Recording, options: Options) -> Recording:
    """Coordinates from 0 to 1 -> pixels, where the image size is given."""
    if options.size is None:
        return recording
    finite = np.abs(recording.joints[np.isfinite(recording.joints)])
    with np.errstate(over="ignore"):  # what is too large is refused when it is known which joints count
        if recording.joints.shape[2] != 2 or (finite.size and np.median(finite) > NORMALIZED):
            raise error(path, Message("{arg:size=} is for 2D coordinates from 0 to 1, and these are not"), "leave size out")
        return replace(recording, joints=recording.joints * np.asarray(options.size, dtype=float))


def _mask(path: Path, recording: Recording, min_confidence: float) -> Recording:
    """Joints that were not seen -> NaN, detections without any joint -> dropped."""
    joints, confidence = recording.joints.astype(np.float64), recording.confidence
    missing = np.asarray(np.isnan(joints).any(axis=2))
    if joints.shape[2] == 2:  # exactly (0, 0) is how detectors write "not found" (in 3D the origin is a real place)
        missing |= (joints == 0).all(axis=2)
    if confidence is not None:
        odd = np.isnan(confidence) & ~missing
        if odd.any():
            what = f"{_spot(recording, odd)}: the confidence is NaN, but the joint has coordinates"
            raise error(path, what, "write 0 for a joint that was not seen")
        missing |= ~(confidence > 0) | (confidence < min_confidence)
    elif min_confidence > 0:
        what_for = Message("has no confidences, so {arg:min_confidence} cannot be applied")
        raise error(path, what_for, Message("leave {arg:min_confidence} at 0"))
    far = (np.abs(joints) > LARGEST).any(axis=2) & ~missing
    if far.any():
        raise error(path, f"{_spot(recording, far)}: infinite coordinates, or beyond {LARGEST:g}", "leave them empty")
    joints[missing] = np.nan
    keep = np.asarray(~missing.all(axis=1))
    if not keep.any():
        raise NobodySeen(path, recording.frames, recording.times)
    tracks = None if recording.tracks is None else [track for track, kept in zip(recording.tracks, keep, strict=True) if kept]
    return replace(
        recording,
        at=recording.at[keep],
        joints=joints[keep],
        confidence=None if confidence is None else np.nan_to_num(confidence[keep]),
        tracks=tracks,
    )


def _spot(recording: Recording, where: NDArray[np.bool_]) -> str:
    """The first joint of a mask."""
    row, joint = np.argwhere(where)[0]
    return f"frame {recording.frames[recording.at[row]]}, joint {joint}"


def _times(path: Path, recording: Recording, fps: float | None) -> tuple[FloatArray, float | None]:
    repeated = np.flatnonzero(np.diff(recording.frames) <= 0)
    if repeated.size:
        a, b = recording.frames[repeated[0] : repeated[0] + 2]
        raise error(path, f"frame numbers must increase, but {b} follows {a}", "sort the frames and drop repeated ones")
    if recording.times is None:
        rate = 30.0 if fps is None else float(fps)
        return recording.frames / rate, rate
    bad = np.flatnonzero(~(np.abs(recording.times) < LAST_FRAME))
    if bad.size:
        message = f"frame {recording.frames[bad[0]]} has no time, or one beyond any recording"
        raise error(path, message, Message("give every row a time, or drop the column and use {arg:fps=}"))
    back = np.flatnonzero(np.diff(recording.times) <= 0)
    if back.size:
        a, b = recording.times[back[0] : back[0] + 2]
        what = f"times must increase, but frame {recording.frames[back[0] + 1]} is at {b:g} s after {a:g} s"
        raise error(path, what, "sort the rows by time and drop repeated ones")
    return recording.times, None


def _fill(recording: Recording, rows: IntArray, frames: IntArray) -> tuple[FloatArray, FloatArray | None]:
    """``(f, n, d)`` and ``(f, n)``: the chosen detections in their frames, NaN (confidence 0) in the others."""
    f, (_, n, d) = len(frames), recording.joints.shape
    at = np.searchsorted(frames, recording.at[rows])
    joints = np.full((f, n, d), np.nan)
    joints[at] = recording.joints[rows]
    if recording.confidence is None:
        return joints, None
    confidence = np.zeros((f, n))
    confidence[at] = recording.confidence[rows]
    return joints, confidence


# ----------------------------------------------------------------------------------------------------------------------
# Markers of motion capture as recordings: what C3D, TRC and tables of points share


UNITS = {
    "m": ("m", "meter", "meters", "metre", "metres"), "cm": ("cm", "centimeters", "centimetres"),
    "mm": ("mm", "millimeter", "millimeters", "millimetre", "millimetres"), "in": ("in", "inch", "inches"), "px": ("px", "pixels"),
}  # fmt: skip
METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}


def build_marker_recording(
    path: Path, points: FloatArray, names: list[str], frames: IntArray, times: FloatArray | None, units: str, up: str
) -> Recording:
    """A recording of named markers. points ``(frames, markers, 3)``."""
    people, joints = split_people(names)
    unit = next((unit for unit, words in UNITS.items() if units.lower() in words), "")
    values = METRES.get(unit, 1.0) * points.reshape(len(points) * len(people), len(joints), 3)
    depth = values[..., 2]
    if unit == "px" or not depth[np.isfinite(depth)].any():
        values, up = values[..., :2], up if not up.endswith("z") else ""
    usual = "-y" if unit == "px" else "y" if values.shape[2] == 2 or path.suffix.lower() == ".trc" else "z"
    meta = {"units": "m" if unit in METRES else unit} if unit else {}
    up = up or estimate_up(values, joints, usual)
    tracked = people if len(people) > 1 else None
    return dense_recording(path, values, None, frames, tracked, joints, times=times, up=up, meta=meta)


def split_people(names: Sequence[str]) -> tuple[list[str], list[str]]:
    """Who is in a file of markers, and the markers of each."""
    parts = [name.partition(":") for name in names]
    if not all(before and colon and after for before, colon, after in parts):
        return [""], list(names)
    people = list(dict.fromkeys(before for before, _, _ in parts))
    joints = [after for before, _, after in parts if before == people[0]]
    if [f"{who}:{joint}" for who in people for joint in joints] != list(names):
        return [""], list(names)
    return people if len(people) > 1 else [""], joints
