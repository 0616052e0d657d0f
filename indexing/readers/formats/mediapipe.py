"""MediaPipe landmarks in CSV, as the usual export scripts write them (there is no official file format).

Wide, one row per frame: ``nose_x, nose_y, nose_z, nose_visibility``, ``landmark_0_x``, ``x0, y0, z0, v0``, ``x_0``...
Long, one row per landmark: ``frame, landmark, x, y, z, visibility``, the landmark by index or by name.
One point, a row per frame: ``frame, x, y``.
Optional columns: ``frame``, a time (``time``, ``timestamp``, ``time_ms``...), and a person where several poses were kept.

Image landmarks run from 0 to 1 in x and in y, so the picture is stretched by its aspect ratio: give ``size=(width, height)``
to get pixels back.  ``z`` (a guess relative to the hips, not a measured depth) is dropped; tables of points that were measured in
space are told apart by :mod:`indexing.readers.formats.mocap`.

MediaPipe's own interface smooths landmarks as they come, which makes them late where movement is quick, by up to 2.4 frames: bad
for clocks.  ``Clip.meta["may_lag"]`` says that of a body of 33 landmarks, unless the noise of calm moments shows that nothing was
smoothed.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from indexing.clip import Clip, ClipSet, FloatArray
from indexing.opening import VALUE, check_dense, error, quote
from indexing.readers.files import Format, Options, Source, read_columns
from indexing.readers.recording import IntArray, Recording, frame_numbers, to_clips
from indexing.skeleton import HAND21, MEDIAPIPE33, Skeleton

KINDS = {"x": "x", "y": "y", "z": "z"} | dict.fromkeys(("v", "c", "vis", "visibility", "confidence", "score", "likelihood"), "v")
FRAME = ("frame", "frame_number", "frame_num", "frame_no", "frame_id", "frame_idx", "frame_index", "index", "")
TIME = re.compile(r"(?:time|timestamp|t|seconds|sec)(?:[ _(\[]*(s|sec|seconds|ms|msec|us|ns)[)\]]?)?", re.IGNORECASE)
UNITS = {"ms": 1e-3, "msec": 1e-3, "us": 1e-6, "ns": 1e-9}
PERSON = ("person", "person_id", "pose", "pose_id", "pose_index", "track", "track_id")
LANDMARK = ("landmark", "landmark_id", "landmark_index", "landmark_idx", "landmark_name", "joint", "keypoint", "id", "name")
ONE_NAME = "give a landmark the same name in every frame"
CALM_SHARE = 0.3  # of the frames, those with the least movement, in which noise is looked at
MAX_RAW_CORRELATION = -0.2
"""Of one frame's step with the next in calm frames, below which nothing was smoothed: noise alone gives -.5; actors with noise of
.5 to 1 % of their height -.22 to -.44; through MediaPipe's filter -.15 to .92, with any noise."""
MIN_CALM_FRAMES = 30  # that show it: a second
MOST = 1000  # MediaPipe's largest set, pose with face and hands, has 543 landmarks
SUFFIX = re.compile(r"(.+?)[ _.\-:](" + "|".join(KINDS) + ")")
PREFIX = re.compile("(" + "|".join(KINDS) + r")(?:[ _.\-:](.+)|(\d+))")


class Columns(NamedTuple):
    """Where a header keeps what: indices of columns."""

    joints: dict[str, dict[str, int]]  # landmark (long: "") -> x, y, v
    landmark: int | None
    frame: int | None
    time: int | None
    person: int | None


class LandmarkTable(NamedTuple):
    """A table of points: ``m`` rows of somebody in a frame, in ``f`` frames."""

    frames: IntArray  # (f,) numbers
    at: IntArray  # (m,) which of the frames
    times: FloatArray | None  # (f,) seconds
    values: FloatArray  # (m, names, kinds)
    people: list[str] | None  # (m,)
    names: list[str]


def find_columns(header: Sequence[str]) -> Columns | None:
    """The columns of a landmark table, or None where the header is not one."""
    names = [cell.strip().lower() for cell in header]
    place = {name: i for i, name in reversed(list(enumerate(names)))}
    landmark = next((place[name] for name in LANDMARK if name in place), None)
    joints: dict[str, dict[str, int]] = {}
    if landmark is not None and {"x", "y"} <= place.keys():
        joints[""] = {KINDS[name]: i for i, name in enumerate(names) if name in KINDS}
    else:
        landmark = None
        for i, name in enumerate(names):
            if found := SUFFIX.fullmatch(name):
                joints.setdefault(found[1], {})[KINDS[found[2]]] = i
            elif found := PREFIX.fullmatch(name):
                joints.setdefault(found[2] or found[3], {})[KINDS[found[1]]] = i
    joints = {joint: kinds for joint, kinds in joints.items() if {"x", "y"} <= kinds.keys()}
    time = next((i for i, name in enumerate(names) if TIME.fullmatch(name)), None)
    # an unnamed first column numbers the rows, which are frames only in a wide table
    frame = next((place[name] for name in (FRAME if landmark is None else FRAME[:-2]) if name in place), None)
    person = next((place[name] for name in PERSON if name in place), None)
    if not joints and {"x", "y"} <= place.keys() and person is None and (time is not None or frame is not None):
        joints["point"] = {KINDS[name]: i for i, name in enumerate(names) if name in KINDS}  # one point over time: a ball, a drone
    if not joints:
        return None
    return Columns(joints, landmark, frame, time, person)


def read(source: Source, options: Options) -> ClipSet:
    """Read a landmark CSV; times come from the time column where there is one, else from frame number / fps."""
    columns = find_columns(source.data[0])
    if columns is None:
        raise error(source.path, "has no columns like nose_x, nose_y or landmark, x, y", "export landmarks with a header row")
    recorded = all("v" in kinds for kinds in columns.joints.values())
    found = read_table(source, columns, "xy", recorded)
    table, people = found.values, found.people
    confidence = table[..., 2] if recorded and (table[..., 2] > 0).any() else None  # hand models write 0 for every landmark
    tracks = None if people is None else [person or None for person in people]
    recording = Recording(found.frames, found.at, table[..., :2], confidence, tracks, found.times, layout_of(source, found.names))
    clips = to_clips(source.path, recording, options)
    if recording.skeleton is not MEDIAPIPE33:
        return clips
    return ClipSet([clip.replace(meta={**clip.meta, "may_lag": True}) if may_lag(clip) else clip for clip in clips], clips.name)


def read_table(source: Source, columns: Columns, axes: str, recorded: bool) -> LandmarkTable:
    """The rows of a table, of which values are the axes (``"xy"`` or ``"xyz"``) and, where it is recorded, the confidence."""
    kinds = (*axes, "v") if recorded else tuple(axes)
    numeric = [place for place in (columns.frame, columns.time) if place is not None]
    numeric += [joint[kind] for joint in columns.joints.values() for kind in kinds]
    text = [place for place in (columns.person, columns.landmark) if place is not None]
    values, words = read_columns(source.path, 1, numeric, text)
    keys = values[:, : len(numeric) - len(columns.joints) * len(kinds)]
    table = values[:, keys.shape[1] :].reshape(len(values), -1, len(kinds))
    frames, at, times = _frames(source, columns, keys)
    people = words[0] if columns.person is not None else None
    names = list(columns.joints)
    if columns.landmark is not None:
        at, table, people, names = _widen(source, at, table[:, 0], people, words[-1])
        if recorded:
            table[..., -1] = np.nan_to_num(table[..., -1])
    elif people is None and len(frames) < len(at):
        back = np.flatnonzero(np.diff(at) <= 0)[0]
        raise error(source.path, f"frame {frames[at[back + 1]]} comes twice", "drop repeated rows, or add a column 'person'")
    return LandmarkTable(frames, at, times, table, people, names)


def may_lag(clip: Clip) -> bool:
    """Whether MediaPipe may have smoothed a body as it was recorded: unless its noise shows that it did not."""
    steps = np.diff(clip.joints, axis=0)
    joints = np.isfinite(steps).all(axis=(0, 2))
    if len(steps) < MIN_CALM_FRAMES or not joints.any():
        return True
    steps = steps[:, joints]
    speed = np.median(np.linalg.norm(steps, axis=2), axis=1)
    pair = np.maximum(speed[1:], speed[:-1])
    calm = pair <= np.quantile(pair, CALM_SHARE)
    after, before = (part[calm] - part[calm].mean(axis=0) for part in (steps[1:], steps[:-1]))
    size = np.sqrt(np.square(after).sum(axis=(0, 2)) * np.square(before).sum(axis=(0, 2)))
    if not (size > 0).any():
        return True
    return float(np.median((after * before).sum(axis=(0, 2))[size > 0] / size[size > 0])) >= MAX_RAW_CORRELATION


def _frames(source: Source, columns: Columns, keys: FloatArray) -> tuple[IntArray, IntArray, FloatArray | None]:
    """Frame numbers, the frame of each row, and the time of each frame (None: no time column)."""
    several = columns.landmark is not None or columns.person is not None
    number = keys[:, 0] if columns.frame is not None else None
    stamp = keys[:, -1] if columns.time is not None else None
    if number is None and several:
        if stamp is None:
            raise error(source.path, "has no frame or time column, so its rows cannot be put together", "export one with every row")
        number = np.unique(stamp, return_inverse=True)[1].astype(float)
    if number is None:
        number = np.arange(len(keys), dtype=float)
    whole = frame_numbers(source.path, number)
    back = np.flatnonzero(np.diff(number) < 0)
    if back.size and columns.landmark is None:
        a, b = number[back[0] : back[0] + 2]
        raise error(source.path, f"frame numbers must increase, but {b:g} follows {a:g}", "sort the rows; one recording per file")
    frames, first, at = np.unique(whole, return_index=True, return_inverse=True)
    if stamp is None:
        return frames, at, None
    return frames, at, stamp[first] * _unit(source.data[0][columns.time or 0], stamp[first])


def _unit(name: str, stamps: FloatArray) -> float:
    """Seconds per unit of a time column: as its name says, else from its steps (no camera waits a second per frame)."""
    found = TIME.fullmatch(name.strip())
    if found and found[1]:
        return UNITS.get(found[1].lower(), 1.0)
    steps = np.abs(np.diff(stamps))
    step = float(np.median(steps[np.isfinite(steps)])) if np.isfinite(steps).any() else 0.0
    return next((unit for limit, unit in ((1e6, 1e-9), (1e3, 1e-6), (1.0, 1e-3)) if step > limit), 1.0)


def _widen(
    source: Source, at: IntArray, rows: FloatArray, people: list[str] | None, landmarks: list[str]
) -> tuple[IntArray, FloatArray, list[str] | None, list[str]]:
    """One row per landmark -> one row per person and frame; landmarks that a frame lacks are NaN."""
    names = list(dict.fromkeys(name.lower() for name in landmarks))
    if set(names) <= set(MEDIAPIPE33.joints):  # in its order, whatever that of the rows
        names = [joint for joint in MEDIAPIPE33.joints if joint in names]
    if all(name.isdecimal() and len(name) < VALUE for name in names):  # numbered from 0 or from 1
        landmarks = [str(int(name)) for name in landmarks]
        highest = max(map(int, names))
        if highest > MOST:
            what = f"landmark {quote(highest)} is beyond any MediaPipe model"
            raise error(source.path, what, f"number landmarks from 0 or 1 to at most {MOST}")
        names = [str(i) for i in range(min(1, *map(int, names)), highest + 1)]
    column = {name: i for i, name in enumerate(names)}
    joint = np.array([column[name.lower()] for name in landmarks])
    who = np.unique(people, return_inverse=True)[1] if people is not None else np.zeros(len(at), dtype=np.int64)
    keys, first, person = np.unique(np.stack([at, who], axis=1), axis=0, return_index=True, return_inverse=True)
    # numpy 2.0.0 gives it as a column
    person = person.reshape(-1)
    cells, counts = np.unique(person * len(names) + joint, return_counts=True)
    if (counts > 1).any():
        twice = names[int(cells[np.argmax(counts > 1)]) % len(names)]
        raise error(source.path, f"landmark {quote(twice)} comes twice in a frame", "drop repeated rows, or add a column 'person'")
    check_dense(source.path, len(keys) * len(names), len(rows), f"{len(keys)} people and {len(names)} landmarks", ONE_NAME)
    table = np.full((len(keys), len(names), rows.shape[1]), np.nan)
    table[person, joint] = rows
    return keys[:, 0], table, None if people is None else [people[i] for i in first], names


def layout_of(source: Source, names: list[str]) -> Skeleton:
    """MediaPipe's own layouts where the names or, for numbered landmarks, their count are theirs."""
    plain = [re.sub(r"^(pose|landmark|lm|joint|kp|point|hand)s?[ _.\-]?(?=\d+$)", "", name) for name in names]
    for layout in (MEDIAPIPE33, HAND21):
        if len(names) == len(layout.joints) and (tuple(names) == layout.joints or all(name.isdigit() for name in plain)):
            return layout
    return Skeleton(source.path.stem, tuple(names))


def matches(source: Source) -> bool:
    """A table with columns of points; whether they were measured in space is asked before."""
    return find_columns(source.data[0]) is not None


FORMAT = Format(("MediaPipe",), ("csv",), read, matches, order=40)
