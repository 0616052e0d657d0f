"""Ultralytics (YOLO pose): ``result.to_json()`` exports, and label folders from ``save_txt=True``.

JSON: one list of people per frame, ``{name, class, confidence, box, track_id, keypoints: {x, y, visible}}``: a list of such
lists (or of the strings that ``to_json()`` returns), a single list (one frame), or a folder with one file per frame.
Labels: one text file per frame, one person per line: ``class cx cy w h``, then x y [v] per joint, then [confidence] [id], all
from 0 to 1.  A line does not say whether it has v, confidence or id; what fits the box and the value ranges is taken.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from indexing.clip import LARGEST, ClipSet, FloatArray
from indexing.opening import VALUE, clip_text, error, parse_json, quote, read_text
from indexing.readers.files import Format, FrameFile, Options, Source
from indexing.readers.recording import Detection, collect_detections, parse_numbers, to_clips, track_id
from indexing.skeleton import usual_layout

REMEDY = "export every frame's result.to_json() of a pose model (yolo ...-pose)"
TEXT_REMEDY = "export with a pose model and save_txt=True"
NEARLY = 0.05  # box sizes: joints guessed a little outside their box say nothing about the layout


def read(source: Source, options: Options) -> ClipSet:
    """Read Ultralytics results; frames of a JSON list count from 0, those of label files from the number in their name."""
    if source.kind == "txt folder":
        frames = _labels(source)
    else:
        frames = [
            (i, [found for k, person in enumerate(people) if (found := _person(source, i, k, person))])
            for i, people in _json_frames(source)
        ]
    recording = collect_detections(source.path, frames)
    return to_clips(source.path, replace(recording, skeleton=usual_layout(recording.joints.shape[1])), options)


def _json_frames(source: Source) -> list[tuple[int, list[Any]]]:
    if source.kind == "json folder":
        frames = [(frame.number, frame.data) for frame in source.data]
    elif isinstance(source.data, list) and any(isinstance(item, dict) for item in source.data):
        frames = [(0, source.data)]  # the people of a single frame
    else:
        frames = list(enumerate(source.data))
    return [(i, _people(source, i, frame)) for i, frame in frames]


def _people(source: Source, number: int, frame: Any) -> list[Any]:
    if isinstance(frame, str):
        frame = parse_json(source.path, frame, REMEDY, f"frame {number}")
    if not isinstance(frame, list):
        raise error(source.path, f"frame {number}: no list of people", REMEDY)
    return frame


def _person(source: Source, number: int, index: int, person: Any) -> Detection | None:
    where = f"frame {number}, person {index}"
    points = person.get("keypoints") if isinstance(person, dict) else None
    if not isinstance(points, dict) or not {"x", "y"} <= points.keys():
        raise error(source.path, f"{where}: no keypoints {{x, y, visible}}", REMEDY)
    x, y = (parse_numbers(source.path, f"{where}, keypoints.{axis}", points[axis]) for axis in "xy")
    visible = points.get("visible")
    confidence = None if visible is None else parse_numbers(source.path, f"{where}, keypoints.visible", visible)
    if x.ndim != 1 or x.shape != y.shape or (confidence is not None and confidence.shape != x.shape):
        raise error(source.path, f"{where}: keypoints x, y and visible have different lengths", REMEDY)
    return Detection(np.stack([x, y], axis=1), confidence, track_id(person.get("track_id"))) if x.size else None


def _labels(source: Source) -> list[tuple[int, list[Detection]]]:
    files: list[FrameFile] = source.data
    lines = [(file, n, words) for file in files for n, words in enumerate(_split_lines(file), start=1)]
    if not lines:
        raise error(source.path, f"no person was detected in any of {len(files)} frames", "check the model's threshold")
    width = len(lines[0][2])
    rows: list[list[float]] = []
    for file, n, words in lines:
        try:
            rows.append([float(word) for word in words])
        except ValueError:
            raise error(file.path, f"line {n} is not a list of numbers: {clip_text(' '.join(words), VALUE)}", TEXT_REMEDY) from None
        if len(words) != width:
            what = f"line {n} has {len(words)} numbers, the first person {width}"
            raise error(file.path, what, "export all frames with the same model and options")
    table = np.array(rows)
    odd = np.argwhere(~(np.abs(table) < LARGEST))
    if len(odd):
        file, n, words = lines[odd[0][0]]
        raise error(file.path, f"line {n} holds {quote(words[odd[0][1]])}", TEXT_REMEDY)
    dims, extras = _layout(source, table)
    joints = table[:, 5 : width - extras].reshape(len(table), -1, dims)
    tracks = table[:, -1].astype(int).tolist() if _last_is_id(table, extras) else [None] * len(table)
    # video frames are counted from 1 in the names that save_txt makes; times start at the first frame
    first = 0 if files[0].number == 0 else 1
    frames: dict[int, list[Detection]] = {file.number - first: [] for file in files}
    for (file, *_), joint, track in zip(lines, joints, tracks, strict=True):
        frames[file.number - first].append(Detection(joint[:, :2], joint[:, 2] if dims == 3 else None, track))
    return list(frames.items())


def _split_lines(file: FrameFile) -> list[list[str]]:
    return [line.split() for line in read_text(file.path, TEXT_REMEDY).splitlines() if line.strip()]


def _last_is_id(table: FloatArray, extras: int) -> bool:
    """The id comes last; a confidence in its place is not whole in some line."""
    return extras > 0 and bool((table[:, -1] == np.round(table[:, -1])).all())


def _layout(source: Source, table: FloatArray) -> tuple[int, int]:
    """``(2 | 3, 0 | 1 | 2)``: numbers per joint and numbers after the joints, for all lines of the recording."""
    columns = table.shape[1] - 5
    readings: list[tuple[float, int, int]] = []
    for dims in (3, 2):
        for extras in (0, 1, 2):
            if columns - extras < dims or (columns - extras) % dims or not _plausible(table, dims, extras):
                continue
            points = table[:, 5 : table.shape[1] - extras].reshape(len(table), -1, dims)
            seen = (points[..., :2] != 0).any(axis=2)
            away = np.abs(points[..., :2] - table[:, None, 1:3]) / np.maximum(table[:, None, 3:5], 1e-6) - 0.5
            outside = float(np.maximum(away, 0.0)[seen].mean()) if seen.any() else 0.0
            readings.append((outside - NEARLY * (usual_layout(points.shape[1]) is not None), dims, extras))
    if not readings:
        raise error(source.path, f"{columns} numbers after the box are not x y [v] per joint", TEXT_REMEDY)
    least = min(readings)[0]
    _, dims, extras = next(reading for reading in readings if reading[0] <= least + NEARLY)
    return dims, extras


def _plausible(table: FloatArray, dims: int, extras: int) -> bool:
    """Whether v, the confidence and the id would have values that they can have."""
    is_id = _last_is_id(table, extras)
    if (extras == 2 and not is_id) or (extras > is_id and not ((table[:, -1 - is_id] >= 0) & (table[:, -1 - is_id] <= 1)).all()):
        return False
    if dims == 2:
        return True
    visible = table[:, 5 : table.shape[1] - extras].reshape(len(table), -1, 3)[..., 2]
    return bool((((visible >= 0) & (visible <= 1)) | (visible == 2)).all())


def matches(source: Source) -> bool:
    """A folder of labels, or a list of people or of the strings that ``to_json()`` returns."""
    match source.data:
        case [{"keypoints": dict()} | {"box": _, "class": _}]:
            return True
        case [str(text)]:
            return text.lstrip().startswith("[")
    return source.kind == "txt folder"


FORMAT = Format(("Ultralytics",), ("json", "json folder", "txt folder"), read, matches, order=30)
