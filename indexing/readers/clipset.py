"""Clip sets: one ``.npz`` with many clips of different lengths, the project's own exchange format.

======================  ==============================================================================================
``joints``              ``(F, n, 2 | 3)`` the frames of all clips, one clip after the other; NaN = not seen
``offsets``             ``(N + 1,)`` clip i is rows ``offsets[i]:offsets[i + 1]`` (may be absent in a file with one clip)
``action``              ``(N,)`` optional; index into ``action_names`` ``(K,)``, or the label itself; below 0 = unknown
``times`` / ``frame``   ``(F,)`` optional; seconds, or frame numbers of the original recording (time = frame / fps)
``fps``                 optional; one for all or ``(N,)``
``confidence``          ``(F, n)`` optional
``names``               ``(N,)`` optional; the clips' names
``bones``, ``parents``  ``(m, 2)`` pairs of joints, or ``(n,)`` the parent of each joint (-1 = root); optional
``joint_names``         ``(n,)`` optional
``up``                  optional; one for all or ``(N,)``, as in :class:`indexing.clip.Clip`
anything ``(N, ...)``   what is known of each clip: becomes ``Clip.meta``; of ``split (N, 3)`` also split0, split1, split2
======================  ==============================================================================================
"""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Hashable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing.clip import Clip, ClipSet, FloatArray
from indexing.readers.clipset_write import write_clip_set
from indexing.readers.files import Source, error
from indexing.readers.options import Options
from indexing.skeleton import Skeleton

__all__ = ["read", "read_clip_set", "write_clip_set"]

Array = NDArray[Any]
# keys that describe frames, joints or the whole set: never meta, whatever their length
RESERVED = {"joints", "offsets", "action", "action_names", "times", "frame", "fps_assumed", "confidence", "up"}
RESERVED |= {"bones", "parents", "joint_names", "skeleton_name"}


def read(source: Source, options: Options) -> ClipSet:
    """Read a clip set; ``person`` does not matter, since a clip is one person already."""
    source.need("clipset", "npz")
    if options.size is not None:
        raise error(source.path, "size= does not apply to a clip set", "leave size away")
    return read_clip_set(source.path, fps=options.fps, label=options.label, min_confidence=options.min_confidence)


def read_clip_set(
    path: str | Path, *, fps: float | None = None, label: Hashable | None = None, min_confidence: float = 0.0
) -> ClipSet:
    """Read a clip-set ``.npz`` (its keys are listed above), without pickle.

    Args:
        fps: frames per second where the file has neither ``times`` nor ``fps``; without it 30 is assumed.
        label: replaces the labels of all clips.
        min_confidence: joints below it become NaN.

    Raises:
        ValueError: not such a file, truncated, or inconsistent; the message names the file, the key and the clip.

    Example:
        >>> import pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "set.npz"
        >>> np.savez(path, joints=np.ones((9, 3, 2)), offsets=[0, 4, 9], action=[0, 1], action_names=["run", "sit"], fps=10.0)
        >>> clips = read_clip_set(path)
        >>> clips.labels.tolist(), clips[1].duration
        (['run', 'sit'], 0.4)
    """
    path = Path(path)
    data = _load(path)
    joints = _need(path, data, "joints", 3)
    if joints.shape[2] not in (2, 3) or joints.dtype.kind not in "fiu":
        raise error(
            path, f"joints must be numbers (F, n, 2 or 3), got {joints.dtype} {joints.shape}", "save x, y or x, y, z per joint"
        )
    offsets = _offsets(path, data, len(joints))
    count = len(offsets) - 1
    labels = [label] * count if label is not None else _labels(path, data, count)
    names = _names(path, data, count)
    joints, confidence = _trusted(path, data, joints, min_confidence)
    rate = _per_clip(path, data, "fps", count, 30.0 if fps is None else fps)
    assumed = _per_clip(path, data, "fps_assumed", count, "fps" not in data and "times" not in data and fps is None)
    times = _times(path, data, offsets, rate, names)
    up = _per_clip(path, data, "up", count, "y")
    meta, skeleton = _meta(data, count), _skeleton(path, data, joints.shape[1])
    clips = []
    for i, (start, end) in enumerate(pairwise(offsets.tolist())):
        known = None if confidence is None or np.isnan(confidence[start:end]).all() else confidence[start:end]
        try:
            clips.append(
                Clip(
                    joints=joints[start:end],
                    times=None if times is None else times[start:end],  # type: ignore[arg-type]
                    confidence=known,
                    fps=float(rate[i]),
                    label=labels[i],
                    name=names[i],
                    skeleton=skeleton,
                    up=str(up[i]),
                    meta={key: _plain(values[i]) for key, values in meta.items()},
                    fps_assumed=bool(assumed[i]),
                )
            )
        except ValueError as problem:
            raise ValueError(f"{path}: {problem}") from None
    return ClipSet(clips, path.name)


def _load(path: Path) -> dict[str, Array]:
    """All arrays of the file; nothing in it is ever unpickled."""
    if not path.is_file():
        raise error(path, "no such file", "check the path")
    key = ""
    try:
        with np.load(path, allow_pickle=False) as file:
            data = {}
            for key in file.files:
                data[key] = file[key]
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error, NotImplementedError) as problem:
        if "allow_pickle" in str(problem) and key:
            raise error(
                path,
                f"{key} is an array of Python objects, which would need pickle",
                "save numbers or text: np.asarray(values, dtype=...)",
            ) from None
        what = f"{key} cannot be read" if key else "is not an .npz file"
        raise error(path, f"{what} (the file may be truncated)", "write or copy it again") from None
    return {key: np.asarray(value) for key, value in data.items()}


def _need(path: Path, data: Mapping[str, Array], key: str, ndim: int) -> Array:
    if key not in data:
        keys = ", ".join(list(data)[:8]) or "nothing"
        raise error(
            path, f"is not a clip set: it has no {key!r} (it has {keys})", "save joints (F, n, 2 or 3), offsets (N + 1), action (N)"
        )
    if data[key].ndim != ndim:
        raise error(
            path, f"{key} must have {ndim} dimensions, got shape {data[key].shape}", "see indexing.readers.clipset for the format"
        )
    return data[key]


def _offsets(path: Path, data: Mapping[str, Array], frames: int) -> NDArray[np.int64]:
    if "offsets" not in data:
        actions = data.get("action", np.zeros(1))
        if actions.size > 1:
            raise error(
                path, f"has {actions.size} actions but no offsets", "save offsets (N + 1): where each clip starts, and the end"
            )
        return np.array([0, frames])
    offsets = _need(path, data, "offsets", 1)
    if offsets.dtype.kind not in "iu" or len(offsets) < 2:
        raise error(
            path,
            f"offsets must be at least 2 integers, got {offsets.dtype} {offsets.shape}",
            "save where each clip starts, and the end",
        )
    offsets = offsets.astype(np.int64)
    if offsets[0] != 0 or offsets[-1] != frames:
        raise error(
            path,
            f"offsets run from {offsets[0]} to {offsets[-1]}, but joints has {frames} frames",
            "offsets must run from 0 to that number",
        )
    stuck = np.flatnonzero(np.diff(offsets) <= 0)
    if stuck.size:
        i = int(stuck[0])
        raise error(
            path, f"offsets must increase, but offsets[{i}:{i + 2}] = {offsets[i : i + 2].tolist()}", "leave empty clips out"
        )
    return offsets


def _per_clip(path: Path, data: Mapping[str, Array], key: str, count: int, default: Any) -> Array:
    """``(N,)`` from one value for all, one per clip, or the default."""
    value = data.get(key, np.asarray(default))
    if value.size == 1:
        return np.broadcast_to(value.reshape(()), (count,))
    if value.shape != (count,):
        raise error(path, f"{key} must be one value or one per clip ({count}), got shape {value.shape}", "correct its length")
    return value


def _names(path: Path, data: Mapping[str, Array], count: int) -> list[str]:
    if "names" not in data:
        return [f"{path.stem}[{i}]" for i in range(count)]
    return [str(name) for name in _per_clip(path, data, "names", count, "")]


def _labels(path: Path, data: Mapping[str, Array], count: int) -> list[Hashable | None]:
    if "action" not in data:
        return [None] * count
    action = _need(path, data, "action", 1)
    if len(action) != count:
        raise error(path, f"action has {len(action)} values for {count} clips", "save one action per clip")
    if action.dtype.kind == "U":
        return [str(value) for value in action]
    # some tools keep missing labels as NaN, and all of them as floats then
    whole = np.isnan(action) | ((np.abs(action) < 2**53) & (action == np.round(action))) if action.dtype.kind == "f" else None
    if not (action.dtype.kind in "iu" or (whole is not None and whole.all())):
        raise error(path, f"action must be integers or text, got {action.dtype}", "save indices into action_names")
    index = np.nan_to_num(action, nan=-1).astype(np.int64).tolist()
    if "action_names" not in data:
        return [i if i >= 0 else None for i in index]
    names = _need(path, data, "action_names", 1)
    if max(index) >= len(names):
        raise error(
            path, f"action[{int(np.argmax(index))}] = {max(index)}, but there are {len(names)} action_names", "add the name"
        )
    return [str(names[i]) if i >= 0 else None for i in index]


def _trusted(path: Path, data: Mapping[str, Array], joints: Array, min_confidence: float) -> tuple[Array, Array | None]:
    """Joints, NaN where their confidence is below the limit, and the confidences."""
    if "confidence" not in data:
        if min_confidence > 0:
            raise error(path, "has no confidence, so min_confidence cannot be applied", "leave min_confidence at 0")
        return joints, None
    confidence = data["confidence"]
    if confidence.shape != joints.shape[:2] or confidence.dtype.kind not in "fiu":
        what = f"confidence must be numbers {joints.shape[:2]}, got {confidence.dtype} {confidence.shape}"
        raise error(path, what, "save one confidence per frame and joint")
    if min_confidence > 0:
        joints = np.where((confidence < min_confidence)[..., None], np.nan, joints)
    return joints, confidence


def _times(
    path: Path, data: Mapping[str, Array], offsets: NDArray[np.int64], rate: Array, names: Sequence[str]
) -> FloatArray | None:
    """``(F,)`` seconds, or None where neither times nor frame numbers are known."""
    key = next((key for key in ("times", "frame") if key in data), None)
    if rate.dtype.kind not in "fiu" or not (np.isfinite(rate).all() and (rate > 0).all()):
        raise error(path, "fps must be positive", "save frames per second, one value or one per clip")
    if key is None:
        return None
    stamps = data[key]
    if stamps.shape != (offsets[-1],) or stamps.dtype.kind not in "fiu":
        raise error(
            path, f"{key} must be {offsets[-1]} numbers, one per frame, got {stamps.dtype} {stamps.shape}", "save one per frame"
        )
    stamps = stamps.astype(np.float64)  # before any difference: unsigned frame numbers would wrap around
    forward = stamps[1:] > stamps[:-1]
    forward[offsets[1:-1] - 1] = True  # a new clip may start anywhere
    if not forward.all():
        row = int(np.argmin(forward)) + 1
        clip = int(np.searchsorted(offsets, row, side="right")) - 1
        raise error(
            path,
            f"clip {names[clip]!r}: {key} must increase, but row {row} has {stamps[row]:g} after {stamps[row - 1]:g}",
            "sort the frames and drop repeated ones",
        )
    return np.asarray(stamps if key == "times" else stamps / np.repeat(rate.astype(np.float64), np.diff(offsets)))


def _meta(data: Mapping[str, Array], count: int) -> dict[str, Array]:
    meta: dict[str, Array] = {}
    for key, values in data.items():
        if key in RESERVED or values.ndim == 0 or len(values) != count:
            continue
        meta[key] = values
        if values.ndim == 2:
            meta.update({f"{key}{k}": values[:, k] for k in range(values.shape[1])})
    return meta


def _skeleton(path: Path, data: Mapping[str, Array], joints: int) -> Skeleton | None:
    if not {"bones", "joint_names", "parents"} & data.keys():
        return None
    names = tuple(str(name) for name in data["joint_names"].ravel()) if "joint_names" in data else tuple(map(str, range(joints)))
    if len(names) != joints:
        raise error(path, f"joint_names has {len(names)} names for {joints} joints", "save one name per joint")
    try:
        if "bones" in data:
            bones = [(int(a), int(b)) for a, b in data["bones"]]
        else:
            bones = [(int(parent), i) for i, parent in enumerate(data.get("parents", [])) if parent >= 0]
        return Skeleton(str(data.get("skeleton_name", path.stem)), names, tuple(bones))
    except (TypeError, ValueError, OverflowError) as problem:
        raise error(path, f"bones or parents do not fit the joints ({problem})", "save bones (m, 2) or parents (n)") from None


def _plain(value: Any) -> Any:
    """A Python number or text; rows of 2-D arrays stay arrays."""
    return value.item() if isinstance(value, np.generic) else value
