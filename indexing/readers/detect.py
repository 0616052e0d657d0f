"""Which format an opened file has: decided by its structure, not by its name."""

from __future__ import annotations

from typing import Any

from indexing.opening import error, listed
from indexing.readers.files import Source

DEEPEST = 3  # lists of people inside each other
REMEDY = (
    "export what OpenPose, COCO, AlphaPose, MediaPipe, DeepLabCut, MMPose, Ultralytics, SLEAP, FreeMoCap, OpenSim, movement or "
    "pyskl write, or a clip set, or say the format (--format, format=)"
)
KINDS = {
    "video": "video", "npz": "clipset", "txt folder": "ultralytics", "trc": "trc", "c3d": "mocap", "pickle": "pyskl",
    "npy folder": "freemocap",
}  # fmt: skip
"""Kinds of files that only one reader knows."""


def detect(source: Source) -> str:
    """The name of the format.

    Raises:
        ValueError: no reader knows this structure; the message says what was found.
    """
    if source.kind in KINDS:
        return KINDS[source.kind]
    if source.kind == "hdf5":
        return _detect_hdf5(source)
    if source.kind == "npy":
        from indexing.readers.freemocap import rank

        return "npy" if rank(source.path.name) is None else "freemocap"
    if source.kind == "csv":
        return _detect_csv(source)
    if source.kind == "json folder":
        frames = [frame.data for frame in source.data]
        found, shown = next((name for frame in frames if (name := detect_json(frame))), None), frames[0]
        empty = all(map(_only_empty_lists, frames))
    else:
        found, shown = detect_json(source.data), source.data
        empty = _only_empty_lists(shown)
    if empty:
        raise error(source.path, "no person was detected in any frame", "check the video or the pose estimator's threshold")
    if found is None:
        raise error(source.path, f"JSON without keypoints that a reader knows ({_describe(shown)})", REMEDY)
    return found


def detect_json(data: Any) -> str | None:
    """The format of parsed JSON, or None."""
    if isinstance(data, dict):
        if "people" in data or "bodies" in data:
            return "openpose"
        if "instance_info" in data:
            return "mmpose"
        if "annotations" in data:
            return "coco"
        # AlphaPose --format open | cmu: one such object per image name
        first = next(iter(data.values()), None)
        return "openpose" if isinstance(first, dict) and ("people" in first or "bodies" in first) else None
    if not isinstance(data, list):
        return None
    return next((name for item in data if (name := _detect_item(item))), None)


def _detect_item(item: Any, depth: int = 0) -> str | None:
    """The format of a list, from one of its elements."""
    if isinstance(item, list):  # a frame: a list of people
        return next((name for person in item if (name := _detect_item(person, depth + 1))), None) if depth < DEEPEST else None
    if isinstance(item, str):  # Ultralytics' to_json() gives text: one string per frame
        return "ultralytics" if item.lstrip().startswith("[") else None
    if not isinstance(item, dict):
        return None
    if "people" in item or "bodies" in item:
        return "openpose"
    if "instances" in item or "keypoint_scores" in item:
        return "mmpose"
    if isinstance(item.get("keypoints"), dict) or {"box", "class"} <= item.keys():
        return "ultralytics"
    return "coco" if "image_id" in item else None


def _detect_csv(source: Source) -> str:
    rows = source.data
    header = [cell.strip().lower() for cell in rows[0]]
    if header[0] == "scorer" or (len(rows) > 1 and rows[1][0].strip().lower() in ("bodyparts", "individuals")):
        return "deeplabcut"
    if "frame_idx" in header and any(cell.endswith(".x") for cell in header):
        return "sleap"
    from indexing.readers.mediapipe import find_columns
    from indexing.readers.spatial import is_spatial

    columns = find_columns(rows[0])
    if columns is None:
        raise error(source.path, f"text without keypoint columns that a reader knows (first row: {listed(rows[0], 6)})", REMEDY)
    return "mocap" if is_spatial(source, columns) else "mediapipe"


def _detect_hdf5(source: Source) -> str:
    from indexing.readers.frames import holds_frame
    from indexing.readers.hdf import opened_hdf5
    from indexing.readers.movement import holds_poses
    from indexing.readers.sleap import holds_sleap

    with opened_hdf5(source.path) as file:
        found = {"deeplabcut": holds_frame, "sleap": holds_sleap, "movement": holds_poses}
        name = next((name for name, holds in found.items() if holds(file)), None)
        if name is None:
            raise error(source.path, f"HDF5 without keypoints that a reader knows (it has {listed(file.names(), 6)})", REMEDY)
    return name


def _only_empty_lists(data: Any) -> bool:
    return isinstance(data, list) and all(item in ([], "[]") for item in data)


def _describe(data: Any) -> str:
    if isinstance(data, dict):
        return f"an object with {listed(data, 5)}"
    if isinstance(data, list) and data and isinstance(data[0], dict):
        return f"a list of objects with {listed(data[0], 5)}"
    return f"a {type(data).__name__}"
