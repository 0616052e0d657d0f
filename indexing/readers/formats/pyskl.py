"""Skeleton sets of pyskl and mmaction2 (``.pkl``): ``{"split": {name: [frame_dir]}, "annotations": [...]}``, or the bare list.

Each annotation is a clip: ``keypoint`` (people, frames, joints, 2 | 3), ``keypoint_score`` (people, frames, joints), ``label``,
``frame_dir`` (its name), ``total_frames``, ``img_shape``.  Joints at (0, 0) were not seen.  Joints of 17 and 25 are COCO's and
NTU's, which is what these sets hold, unless a body shows something else.  Pickles can run code: this one cannot
(:mod:`indexing.readers.pickles`).
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import replace
from typing import Any

import numpy as np

from indexing.clip import Clip, ClipSet
from indexing.opening import LARGEST, clip_text, error, listing, quote, size_of
from indexing.readers.files import Format, Options, Source
from indexing.readers.pickles import read_pickle
from indexing.readers.recording import IntArray, NobodySeen, Recording, to_clips
from indexing.skeleton import COCO17, NTU25, candidates, usual_layout

REMEDY = "save {'split': ..., 'annotations': [{'frame_dir', 'label', 'keypoint', ...}]}, as pyskl does"
GROWTH_BLOCK = 2**24, 64  # bytes, and times the bytes of the file, that its clips may take: half floats become four times as large


def read(source: Source, options: Options) -> ClipSet:
    """Read a set; a label is a number, as it is in the file, and ``split`` says which parts of the set a clip is in."""
    data = read_pickle(source.path)
    annotations = data.get("annotations") if isinstance(data, dict) else data
    if not isinstance(annotations, list) or not annotations:
        what = f"a dictionary with {listing(data)}" if isinstance(data, dict) else f"a {type(data).__name__}"
        raise error(source.path, f"is a pickle of {what}, not of skeletons", REMEDY)
    parts = _splits(source, data)
    if len(annotations) > 1 and options.person == "everyone":  # clips are no people of one recording
        options = replace(options, person="largest")
    least, times = GROWTH_BLOCK
    room, used = min(LARGEST, max(least, times * size_of(source.path))), 0
    clips: list[Clip] = []
    nobody: NobodySeen | None = None
    for i, one in enumerate(annotations):
        if _is_empty(one):
            nobody = nobody or NobodySeen(source.path, np.zeros(0, dtype=np.int64))
            continue
        recording, name = _annotation(source, i, one)
        used += 8 * (recording.joints.size + len(recording.frames))
        if used > room:
            raise error(source.path, f"annotation {i}: the same array again and again", REMEDY)
        label = options.label if options.label is not None else _label(source, i, one)
        try:
            recorded = to_clips(source.path, recording, replace(options, label=label))
        except NobodySeen as nothing:
            nobody = nothing
            continue
        for clip in recorded:
            who = clip.name[len(recorded.name) :]  # which person, where each has a clip
            clips.append(clip.replace(name=f"{name}{who}", meta={**clip.meta, **_about(one), **parts(name)}))
    if nobody is not None and not clips:
        raise nobody
    return ClipSet(clips, source.path.name)


def _is_empty(annotation: Any) -> bool:
    """Whether an annotation has no people: a detector found nobody."""
    keypoint = annotation.get("keypoint") if isinstance(annotation, dict) else None
    return isinstance(keypoint, np.ndarray) and keypoint.ndim == 4 and keypoint.shape[0] == 0


def _annotation(source: Source, index: int, one: Any) -> tuple[Recording, str]:
    """What an annotation shows, and what it is called."""
    if not isinstance(one, dict) or not isinstance(one.get("keypoint"), np.ndarray):
        has = f"has {listing(one)}" if isinstance(one, dict) else f"is a {type(one).__name__}"
        raise error(source.path, f"annotation {index}: no array 'keypoint' (it {has})", REMEDY)
    name = clip_text(one["frame_dir"]) if isinstance(one.get("frame_dir"), str) else f"{source.path.stem}[{index}]"
    where, keypoint = f"annotation {index} ({quote(name)})", one["keypoint"]
    if keypoint.ndim == 3:
        keypoint = keypoint[None]
    if keypoint.ndim != 4 or keypoint.shape[3] not in (2, 3) or keypoint.dtype.kind not in "fiu" or not all(keypoint.shape):
        message = f"{where}: keypoint must be (people, frames, joints, 2 or 3), got {keypoint.dtype} {keypoint.shape}"
        raise error(source.path, message, REMEDY)
    people, frames, joints, dims = keypoint.shape
    score = one.get("keypoint_score")
    if score is not None:
        score = score[None] if isinstance(score, np.ndarray) and score.ndim == 2 else score
        if not isinstance(score, np.ndarray) or score.shape != keypoint.shape[:3] or score.dtype.kind not in "fiu":
            got = f"{score.dtype} {score.shape}" if isinstance(score, np.ndarray) else f"a {type(score).__name__}"
            raise error(source.path, f"{where}: keypoint_score must be {keypoint.shape[:3]}, got {got}", REMEDY)
        score = np.moveaxis(score, 0, 1).reshape(frames * people, joints).astype(np.float64)
    at: IntArray = np.repeat(np.arange(frames), people)
    table = np.moveaxis(keypoint, 0, 1).reshape(frames * people, joints, dims).astype(np.float64)
    if dims == 3:  # a person who is not there
        table[(table == 0).all(axis=(1, 2))] = np.nan
    usual, up = (usual_layout(joints), "-y") if dims == 2 else (NTU25 if joints == len(NTU25.joints) else None, "y")
    tracks: list[Hashable | None] | None = [str(i) for i in range(people)] * frames if people > 1 else None
    could = () if usual is COCO17 else candidates(joints)
    return Recording(np.arange(frames), at, table, score, tracks, None, usual, up, could), name


def _label(source: Source, index: int, annotation: dict[str, Any]) -> Hashable | None:
    label = annotation.get("label")
    label = label.item() if isinstance(label, (np.generic, np.ndarray)) and label.size == 1 else label
    if label is None or isinstance(label, str) or (isinstance(label, int) and not isinstance(label, bool) and label < 2**63):
        return None if isinstance(label, int) and label < 0 else label
    raise error(source.path, f"annotation {index}: label must be a number or text, got {quote(label)}", REMEDY)


def _about(annotation: dict[str, Any]) -> dict[str, Any]:
    """What else is known of a clip, where it is a number or a few."""
    about = {}
    for key in ("img_shape", "original_shape"):
        value = annotation.get(key)
        if isinstance(value, (tuple, list)) and len(value) == 2 and all(isinstance(side, (int, np.integer)) for side in value):
            about[key] = tuple(int(side) for side in value)
    return about


def _splits(source: Source, data: Any) -> Any:
    """From a clip's name the parts of the set that it is in: one field, or one per part where a clip is in several."""
    split = data.get("split") if isinstance(data, dict) else None
    if split is None:
        return lambda name: {}
    if not isinstance(split, dict) or not all(isinstance(names, list) for names in split.values()):
        raise error(source.path, f"split must be lists of names, got {quote(split)}", REMEDY)
    # one list may be every part of the set; a name, and a part of a clip's, take a byte of the file at least
    if sum(map(len, split.values())) + len(split) * len(data["annotations"]) > size_of(source.path):
        raise error(source.path, f"split has {len(split)} parts with more names than the file has bytes", REMEDY)
    parts = {str(part): {name for name in names if isinstance(name, str)} for part, names in split.items()}
    if sum(map(len, parts.values())) == len(set().union(*parts.values())):
        return lambda name: {"split": next((part for part, names in parts.items() if name in names), "")}
    return lambda name: {part: int(name in names) for part, names in parts.items()}


FORMAT = Format(("pyskl",), ("pickle",), read)
