"""What users hand in, checked once: clips, labels and parameters become plain lists or one clear ``ValueError``."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from indexing.cameras import virtual
from indexing.clip import Clip, as_clip
from indexing.multiview import combine
from indexing.windows import check_clips

Array = NDArray[Any]


def as_clips(clips: Iterable[Any], fps: float) -> list[Clip | tuple[Clip, ...]]:
    """Clips, arrays, and tuples (or 4-D arrays) of synchronized views as clips."""
    if isinstance(clips, (Clip, str, bytes)) or not isinstance(clips, Iterable):
        raise ValueError(
            f"clips: expected a list of clips or arrays, got {type(clips).__name__}; put a single clip in a list: [clip]"
        )
    found: list[Clip | tuple[Clip, ...]] = []
    for i, value in enumerate(clips):
        if isinstance(value, (str, bytes)):
            raise ValueError(f"clips: item {i} is text ({value!r}); read a file first with Clip.load(path)")
        several = isinstance(value, (tuple, list)) and value and all(isinstance(v, Clip) or np.ndim(v) == 3 for v in value)
        if several or (not isinstance(value, Clip) and np.ndim(value) == 4):
            found.append(tuple(as_clip(view, fps, f"{i} view {v}") for v, view in enumerate(value)))
        else:
            found.append(as_clip(value, fps, "" if isinstance(value, Clip) else str(i)))
    if not found:
        raise ValueError("clips: the list is empty; give at least one clip")
    return found


def gather(clips: Iterable[Any], fps: float, joints: int | None = None) -> tuple[list[Clip], list[int]]:
    """Checked training clips and, for each, the item it came from (views that do not decide the shape stay apart)."""
    found: list[Clip] = []
    owners: list[int] = []
    for i, item in enumerate(as_clips(clips, fps)):
        parts = combine(item) if isinstance(item, tuple) else [item]
        found += parts
        owners += [i] * len(parts)
    check_clips(found, joints)
    return found, owners


def check_queries(clips: Iterable[Any], fps: float, joints: int) -> list[Clip]:
    """Checked query clips as images; 3D queries are seen along z."""
    found = []
    for i, item in enumerate(as_clips(clips, fps)):
        if isinstance(item, tuple):
            raise ValueError(f"clips: item {i} holds {len(item)} views; a query is one view, so predict each view and compare")
        found.append(item)
    check_clips(found, joints)
    return [virtual(clip, 0.0, 0.1) if clip.dims == 3 else clip for clip in found]


def gather_labels(clips: list[Clip], owners: list[int], labels: ArrayLike | None) -> Array:
    """``(clips,)`` labels in the dtype given; by default the clips' own."""
    if labels is None:
        missing = [i for i, clip in enumerate(clips) if clip.label is None]
        if missing:
            raise ValueError(
                f"labels: none given, and clip {missing[0]} ({clips[missing[0]].name!r}) has no label; pass fit(clips, labels)"
            )
        return np.asarray([clip.label for clip in clips])
    values = np.asarray(labels)
    items = owners[-1] + 1
    if values.ndim != 1 or len(values) != items:
        raise ValueError(f"labels: expected one per clip ({items}), got shape {values.shape}")
    bad = [i for i, v in enumerate(values.tolist()) if v is None or v != v]
    if bad:
        raise ValueError(
            f"labels: the label of clip {bad[0]} is missing ({values[bad[0]]!r}); leave the clip out or name its action"
        )
    return np.asarray(values[owners])


_CHOICES: dict[str, tuple[Any, ...]] = {
    "view": ("any", "same"),
    "weights": ("equal", "learned"),
    "scorer": ("both", "nearest", "kernel"),
    "mirror": ("auto", True, False),
}


def check_parameters(indexer: Any) -> None:
    """Raise on parameters that make no sense, naming the parameter and what it accepts."""
    for name, accepted in _CHOICES.items():
        if getattr(indexer, name) not in accepted:
            raise ValueError(f"{name} must be one of {', '.join(map(repr, accepted))}, got {getattr(indexer, name)!r}")
    for name in ("fps", "window", "stride"):
        if not _positive(getattr(indexer, name)):
            raise ValueError(f"{name} must be a positive number, got {getattr(indexer, name)!r}")
    if not (isinstance(indexer.pool, (int, float)) and indexer.pool >= 0):
        raise ValueError(f"pool must be seconds, 0 or more, got {indexer.pool!r}")
    tempi = list(indexer.tempi)
    if not tempi or not all(_positive(tempo) for tempo in tempi):
        raise ValueError(f"tempi must be positive speed factors such as (0.7, 1.0, 1.4), got {indexer.tempi!r}")
    for name, least in (("length", 4), ("virtual_views", 0)):
        value = getattr(indexer, name)
        if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or value < least:
            raise ValueError(f"{name} must be a whole number, {least} or more, got {value!r}")
    if indexer.reject is not None and not (isinstance(indexer.reject, (int, float, np.floating)) and np.isfinite(indexer.reject)):
        raise ValueError(f"reject must be None, a rate between 0 and 1 or a threshold, got {indexer.reject!r}")
    try:
        torch.empty(0, device=indexer.device)
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"device {indexer.device!r} is not there: {str(error).splitlines()[0]}; use device='cpu'") from None


def _positive(value: Any) -> bool:
    return isinstance(value, (int, float, np.integer, np.floating)) and bool(np.isfinite(value) and value > 0)
