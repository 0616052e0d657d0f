"""What all ``.npz`` sets of recordings share: offsets, labels, names, clocks and whatever else is known of each recording."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing.clip import FloatArray
from indexing.opening import error, listed, shown
from indexing.readers.npz import Archive

Array = NDArray[Any]
# keys that describe frames, joints or the whole set: never meta, whatever their length
RESERVED = {"joints", "offsets", "action", "action_names", "times", "frame", "fps_assumed", "confidence", "up"}
RESERVED |= {"bones", "parents", "joint_names", "skeleton_name"}
SLOWEST, FASTEST = 1e-6, 1e6  # frames per second: two a month, and the fastest cameras there are
LAST = 2**53  # whole numbers are exact below it
FORMS = {"joints": "joints (F, n, 2 or 3)", "frames": "frames (F, height, width)"}


def need(path: Path, data: Mapping[str, Array], key: str, ndim: int) -> Array:
    """One array with so many axes, or an error that names what the file holds."""
    if key not in data:
        raise error(
            path,
            f"is not a clip set: it has no {shown(key)} (it has {listed(data)})",
            f"save {FORMS.get(key, key)}, offsets (N + 1), action (N)",
        )
    if data[key].ndim != ndim:
        raise error(
            path, f"{key} must have {ndim} dimensions, got shape {data[key].shape}", "see indexing.readers.clipset for the format"
        )
    return data[key]


def clip_offsets(path: Path, data: Mapping[str, Array], key: str) -> NDArray[np.int64]:
    """``(N + 1,)`` where each clip starts among the rows of ``key``, and the end."""
    frames = len(data[key])
    if "offsets" not in data:
        actions = data.get("action", np.zeros(1))
        if actions.size > 1:
            raise error(
                path, f"has {actions.size} actions but no offsets", "save offsets (N + 1): where each clip starts, and the end"
            )
        return np.array([0, frames])
    offsets = need(path, data, "offsets", 1)
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
            f"offsets run from {offsets[0]} to {offsets[-1]}, but {key} has {frames} frames",
            "offsets must run from 0 to that number",
        )
    stuck = np.flatnonzero(np.diff(offsets) <= 0)
    if stuck.size:
        i = int(stuck[0])
        raise error(
            path, f"offsets must increase, but offsets[{i}:{i + 2}] = {offsets[i : i + 2].tolist()}", "leave empty clips out"
        )
    return offsets


def per_clip(path: Path, data: Mapping[str, Array], key: str, count: int, default: Any) -> Array:
    """``(N,)`` from one value for all, one per clip, or the default."""
    value = data.get(key, np.asarray(default))
    if value.size == 1:
        return np.broadcast_to(value.reshape(()), (count,))
    if value.shape != (count,):
        raise error(path, f"{key} must be one value or one per clip ({count}), got shape {value.shape}", "correct its length")
    return value


def clip_names(path: Path, data: Mapping[str, Array], count: int) -> list[str]:
    """``(N,)`` names, or the file's name and a number."""
    if "names" not in data:
        return [f"{path.stem}[{i}]" for i in range(count)]
    return [str(name) for name in per_clip(path, data, "names", count, "")]


def clip_labels(path: Path, data: Mapping[str, Array], count: int) -> list[Hashable | None]:
    """``(N,)`` labels; ``None`` where unknown."""
    if "action" not in data:
        return [None] * count
    action = need(path, data, "action", 1)
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
    names = need(path, data, "action_names", 1)
    if max(index) >= len(names):
        raise error(
            path, f"action[{int(np.argmax(index))}] = {max(index)}, but there are {len(names)} action_names", "add the name"
        )
    return [str(names[i]) if i >= 0 else None for i in index]


def frame_times(
    path: Path, data: Mapping[str, Array], offsets: NDArray[np.int64], rate: Array, names: Sequence[str]
) -> FloatArray | None:
    """``(F,)`` seconds, or None where neither times nor frame numbers are known."""
    key = next((key for key in ("times", "frame") if key in data), None)
    if rate.dtype.kind not in "fiu" or not ((rate >= SLOWEST).all() and (rate <= FASTEST).all()):
        said = f"fps must be positive, from {SLOWEST:g} to {FASTEST:g}"
        raise error(path, said, "save frames per second, one value or one per clip")
    if key is None:
        return None
    stamps = data[key]
    if stamps.shape != (offsets[-1],) or stamps.dtype.kind not in "fiu":
        raise error(
            path, f"{key} must be {offsets[-1]} numbers, one per frame, got {stamps.dtype} {stamps.shape}", "save one per frame"
        )
    stamps = stamps.astype(np.float64)  # before any difference: unsigned frame numbers would wrap around
    odd = np.flatnonzero(~(np.abs(stamps) < LAST))
    if odd.size:
        owner = int(np.searchsorted(offsets, odd[0], side="right")) - 1
        said = f"clip {shown(names[owner])}: {key} must increase, but row {odd[0]} has {stamps[odd[0]]:g}"
        raise error(path, said, "save seconds, or numbers of frames, of a recording")
    forward = stamps[1:] > stamps[:-1]
    forward[offsets[1:-1] - 1] = True  # a new clip may start anywhere
    if not forward.all():
        row = int(np.argmin(forward)) + 1
        clip = int(np.searchsorted(offsets, row, side="right")) - 1
        raise error(
            path,
            f"clip {shown(names[clip])}: {key} must increase, but row {row} has {stamps[row]:g} after {stamps[row - 1]:g}",
            "sort the frames and drop repeated ones",
        )
    return np.asarray(stamps if key == "times" else stamps / np.repeat(rate.astype(np.float64), np.diff(offsets)))


def clip_meta(data: Archive, count: int, rows: str) -> dict[str, Array]:
    """What else is known of each clip, one entry per clip; ``rows`` is the key of what all of them consist of."""
    meta: dict[str, Array] = {}
    for key in data:
        if key in RESERVED or key == rows or data.shape(key)[:1] != (count,):
            continue
        values = meta[key] = data[key]
        if values.ndim == 2:
            meta.update({f"{key}{k}": values[:, k] for k in range(values.shape[1])})
    return meta


def plain(value: Any) -> Any:
    """A Python number or text; rows of 2-D arrays stay arrays."""
    return value.item() if isinstance(value, np.generic) else value
