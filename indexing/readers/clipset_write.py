"""Writing clip sets; the format is described in :mod:`indexing.readers.clipset`."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing.clip import Clip
from indexing.files import replacing
from indexing.opening import error, shown
from indexing.skeleton import Skeleton

Array = NDArray[Any]


def write_clip_set(clips: Sequence[Clip], path: str | Path) -> None:
    """Write clips to one ``.npz``: joints, times (seconds), labels, confidences, names and every ``meta`` field.

    The file appears whole or not at all: it is written under another name and moved into place.

    Raises:
        ValueError: no clips, clips that differ in joints, dimensions or skeleton, labels that are not all text or all
            integers from 0, a field that some clips lack, or a folder that does not exist.

    Example:
        >>> import pathlib, tempfile
        >>> from indexing.clip import Clip, ClipSet
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "set.npz"
        >>> write_clip_set([Clip(np.ones((4, 3, 2)), fps=25.0, label="jump", name="a", meta={"view": 2})], path)
        >>> ClipSet.load(path).select(view=2)[0]
        Clip('a', label='jump', 4 frames x 3 joints x 2D, 0.12 s)
    """
    path = Path(path)
    clips = list(clips)
    if not clips:
        raise error(path, "there are no clips to write", "give at least one")
    shapes = {clip.joints.shape[1:] for clip in clips}
    if len(shapes) > 1:
        raise error(path, f"the clips have different joints and dimensions: {sorted(shapes)}", "write one file per layout")
    data: dict[str, Array] = {
        "joints": np.concatenate([clip.joints for clip in clips]),
        "offsets": np.cumsum([0, *(len(clip) for clip in clips)]),
        "times": np.concatenate([clip.times for clip in clips]),
        "fps": np.array([clip.fps for clip in clips], dtype=np.float64),
        "fps_assumed": np.array([clip.fps_assumed for clip in clips]),
        "names": np.array([clip.name for clip in clips]),
        "up": np.array([clip.up for clip in clips]),
    }
    data |= _actions(path, [clip.label for clip in clips])
    if any(clip.confidence is not None for clip in clips):  # all NaN = this clip has none
        blank = [np.full(clip.joints.shape[:2], np.nan) if clip.confidence is None else clip.confidence for clip in clips]
        data["confidence"] = np.concatenate(blank)
    data |= _bones(path, clips)
    for key in dict.fromkeys(key for clip in clips for key in clip.meta if key not in data):
        data[key] = _column(path, clips, key)
    _write(path, data)


def _actions(path: Path, labels: list[Hashable | None]) -> dict[str, Array]:
    given = [label for label in labels if label is not None]
    if not given:
        return {}
    if all(isinstance(label, str) for label in given):
        index = {label: i for i, label in enumerate(dict.fromkeys(given))}
        action = [-1 if label is None else index[label] for label in labels]
        return {"action": np.array(action), "action_names": np.array([str(label) for label in index])}
    whole = all(isinstance(label, (int, np.integer)) and not isinstance(label, bool) and label >= 0 for label in given)
    if not whole:
        odd = next(label for label in given if not isinstance(label, (int, np.integer)) or isinstance(label, bool) or label < 0)
        raise error(
            path, f"the label {shown(odd)} cannot be written with the others", "use text for all labels, or integers from 0 for all"
        )
    return {"action": np.array([-1 if label is None else label for label in labels])}


def _bones(path: Path, clips: list[Clip]) -> dict[str, Array]:
    skeletons: set[Skeleton] = {clip.skeleton for clip in clips if clip.skeleton is not None}
    if not skeletons:
        return {}
    if len(skeletons) > 1:
        names = ", ".join(sorted(skeleton.name for skeleton in skeletons))
        raise error(
            path, f"the clips have different skeletons ({names})", "write one file per skeleton, or set skeleton to one of them"
        )
    skeleton = skeletons.pop()
    return {
        "bones": np.array(skeleton.bones, dtype=np.int64).reshape(-1, 2),
        "joint_names": np.array(skeleton.joints),
        "skeleton_name": np.array(skeleton.name),
    }


def _column(path: Path, clips: list[Clip], key: str) -> Array:
    lacking = [clip.name or str(i) for i, clip in enumerate(clips) if key not in clip.meta]
    if lacking:
        raise error(
            path, f"the clip {shown(lacking[0])} has no field {shown(key)}, other clips have", "give it to every clip, or to none"
        )
    try:
        column = np.asarray([clip.meta[key] for clip in clips])
    except ValueError:
        column = np.empty(0, dtype=object)
    if column.dtype.kind not in "biufU":
        raise error(path, f"the field {shown(key)} is not numbers or text of one shape", "convert it, or drop it from Clip.meta")
    return column


def _write(path: Path, data: dict[str, Array]) -> None:
    if not path.parent.is_dir():
        raise error(path, f"the folder {path.parent} does not exist", "create it first")
    with replacing(path) as stream:
        np.savez_compressed(stream, **data)  # type: ignore[arg-type]
