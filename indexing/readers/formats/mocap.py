"""Recordings of motion capture: C3D (Vicon, Qualisys, OptiTrack), and tables of points in space.

Such a table is CSV: a row per frame with ``name_x, name_y, name_z`` of every point, or a row per frame and point.

Columns are found, and times read, as in :mod:`indexing.readers.formats.mediapipe`, whose tables have a ``z`` too, that was never
measured.  What tells them apart:

=====================================  ===============================  =======================
columns                                x and y within 0 and 1           x and y beyond
=====================================  ===============================  =======================
visibility                             MediaPipe                        MediaPipe
the 33 or 21 landmarks of MediaPipe    MediaPipe                        not known: refused
other points with a confidence         MediaPipe                        in space
other points without one               not known: refused               in space
=====================================  ===============================  =======================

Units are not known and coordinates stay as they are; which way is up is decided as for C3D.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dyntorch.numerics import Message
from indexing.clip import ClipSet
from indexing.opening import error, listing
from indexing.readers.c3d import read as read_c3d
from indexing.readers.files import Format, Options, Source
from indexing.readers.formats.mediapipe import PREFIX, SUFFIX, Columns, find_columns, layout_of, read_table
from indexing.readers.recording import build_marker_recording, split_people, to_clips
from indexing.skeleton import HAND21, MEDIAPIPE33

MIN_SHARE_INSIDE = 0.8
"""Share of x and y from 0 to 1 from which on they may be MediaPipe's, which guesses limbs outside the image, too."""
VISIBILITY = ("visibility", "vis", "v", "c")
REMEDY = Message(
    "say which it is: {arg:format='mocap'} (points in space) or {arg:format='mediapipe'} (x and y in an image); beside files of "
    "other formats, first write it so with dyntorch convert"
)


def read(source: Source, options: Options) -> ClipSet:
    """Read the markers of a C3D file, or of a table."""
    if source.kind == "csv":
        return read_spatial(source, options)
    found = read_c3d(source.path)
    frames = np.arange(len(found.values)) + max(found.first - 1, 0)
    rate = options.fps or found.rate
    times = frames / rate if rate > 0 else None
    recording = build_marker_recording(source.path, found.values, list(found.ids or ()), frames, times, found.units, found.up)
    return to_clips(source.path, recording, options)


def is_spatial(source: Source, columns: Columns) -> bool:
    """Whether a table holds points in space rather than landmarks in an image."""
    joints = columns.joints
    flat = [joint for joint, kinds in joints.items() if "z" not in kinds]
    if len(flat) == len(joints) or any("v" in kinds and _visibility(source, kinds["v"]) for kinds in joints.values()):
        return False
    if flat:
        raise error(source.path, f"has z of some points, but not of {listing(flat)}", REMEDY)
    rated = any("v" in kinds for kinds in joints.values())
    table = read_table(source, columns, "xy", False)
    values = table.values[np.isfinite(table.values)]
    inside = len(values) > 0 and float(((values >= 0) & (values <= 1)).mean()) >= MIN_SHARE_INSIDE
    landmarks = layout_of(source, table.names) in (MEDIAPIPE33, HAND21)
    if inside and not (landmarks or rated):
        raise error(source.path, "x and y run from 0 to 1, as in an image, but there is a z and no visibility", REMEDY)
    if landmarks and not inside:
        raise error(source.path, "has MediaPipe's landmarks with z, but no visibility, and x and y beyond 0 to 1", REMEDY)
    return not inside


def read_spatial(source: Source, options: Options) -> ClipSet:
    """Read a table of points in space; times come from the time column where there is one, else from frame number / fps."""
    columns = find_columns(source.data[0])
    flat = None if columns is None else [joint or "the points" for joint, kinds in columns.joints.items() if "z" not in kinds]
    if columns is None or flat:
        what = "has no columns like hip_x, hip_y, hip_z" if flat is None else f"has no z of {listing(flat)}"
        raise error(source.path, what, "export x, y and z of every point, with a header row")
    rated = all("v" in kinds for kinds in columns.joints.values())
    table = read_table(source, columns, "xyz", rated)
    points = table.values[..., :3]
    points = np.where(np.isfinite(points).all(axis=2, keepdims=True), points, np.nan)
    names = table.names if columns.landmark is not None else [_original_spelling(source, columns, joint) for joint in table.names]
    people = split_people(names)[0]
    if table.people is not None and len(people) > 1:
        raise error(source.path, f"names people in a column and before the points ({listing(people)})", "keep one of the two")
    recording = build_marker_recording(source.path, points, names, table.frames, table.times, "", "")
    if rated:
        recording = replace(recording, confidence=table.values[..., 3].reshape(recording.joints.shape[:2]))
    if table.people is not None:
        recording = replace(recording, at=table.at, tracks=[person or None for person in table.people])
    return to_clips(source.path, recording, options)


def _visibility(source: Source, column: int) -> bool:
    """Whether a column of confidences has the name that MediaPipe has for it."""
    name = source.data[0][column].strip().lower()
    if found := SUFFIX.fullmatch(name):
        return found[2] in VISIBILITY
    found = PREFIX.fullmatch(name)
    return (found[1] if found else name) in VISIBILITY


def _original_spelling(source: Source, columns: Columns, joint: str) -> str:
    """A point's name with the capitals of the file."""
    cell = source.data[0][columns.joints[joint]["x"]].strip()
    found = cell[: len(joint)] if SUFFIX.fullmatch(cell.lower()) else cell[-len(joint) :]
    return found if found.lower() == joint else joint


def matches(source: Source) -> bool:
    """C3D, or a table whose points were measured in space."""
    columns = find_columns(source.data[0]) if source.kind == "csv" else None
    return source.kind == "c3d" or (columns is not None and is_spatial(source, columns))


FORMAT = Format((), ("c3d", "csv"), read, matches, order=30)
