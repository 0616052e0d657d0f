"""What users hand in, checked once: clips, labels and parameters become plain lists or one clear ``ValueError``."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from dyntorch.numerics import affine_factorization, metric_upgrade
from indexing.action.bank import MIN_SHARED_JOINTS
from indexing.cameras import virtual
from indexing.clip import Clip, as_clip
from indexing.joints import layout_of, match_all
from indexing.movement import clip_of, clips_of, is_dataset
from indexing.remarks import same_clips
from indexing.skeleton import Skeleton
from indexing.windows import check_clips, concatenate_clips, describe_gap, sample

# share of the energy that one rigid space-time shape may leave; of synthetic people a detector's noise leaves .002-.005, views that
# lag by .3 s .006-.04, views of another action .01-.05
MAX_UNEXPLAINED = 0.01

Array = NDArray[Any]

# ----------------------------------------------------------------------------------------------------------------------
# One performance seen by several synchronized cameras -> one exemplar in 3D, where the views decide its shape.


def combine(views: tuple[Clip, ...]) -> list[Clip]:
    """A 3D clip from three or more views that decide it; otherwise the views themselves, each an exemplar of its own."""
    first = views[0]
    for i, view in enumerate(views):
        if view.joints.shape[1:] != first.joints.shape[1:] or view.dims != 2:
            raise ValueError(
                "views of one performance must be 2D with the same joints: "
                f"view 0 is {first.joints.shape[1:]}, view {i} {view.joints.shape[1:]}"
            )
        reason = describe_gap(view)
        if reason:
            raise ValueError(f"view {i} of {first.name!r}: times: {reason}")
    start, end = max(view.times[0] for view in views), min(view.times[-1] for view in views)
    if not end > start:
        raise ValueError(f"the views of {first.name!r} share no time: the last starts at {start:g} s, the first ends at {end:g} s")
    if len(views) < 3:
        return list(views)
    steps = max(4, round((end - start) * float(first.fps or 30.0)))
    source = concatenate_clips(list(views))
    seen = source.seen.all(axis=0)
    if seen.sum() < 4:
        return list(views)
    windows = sample(source, np.arange(len(views)), np.full(len(views), start), np.full(len(views), end), steps)
    shape, cameras, left = affine_factorization(windows[:, :, torch.from_numpy(seen)].flatten(1, 2))
    metric, decided = metric_upgrade(shape, cameras)
    if not bool(decided) or float(left) > MAX_UNEXPLAINED:
        unexplained = f"{float(left):.0%} of the motion is not one rigid space-time shape"
        why = unexplained if decided else "the cameras stand too close together"
        warnings.warn(
            f"views of {first.name!r} do not decide a 3D shape ({why}); each is used as an example of its own", stacklevel=2
        )
        return list(views)
    joints = np.full((steps, first.joints.shape[1], 3), np.nan, dtype=np.float32)
    joints[:, seen] = metric.reshape(steps, int(seen.sum()), 3).numpy()
    slots = (np.arange(steps) + 0.5) / steps
    return [first.replace(joints=joints, times=start + (end - start) * slots, confidence=None, up="y")]


def as_clips(clips: Iterable[Any], fps: float) -> list[Clip | tuple[Clip, ...]]:
    """Clips, arrays, movement's datasets, and tuples (or 4-D arrays) of synchronized views as clips."""
    if is_dataset(clips):
        return list(clips_of(clips, fps=fps))
    if isinstance(clips, (Clip, str, bytes)) or not isinstance(clips, Iterable):
        raise ValueError(
            f"clips: expected a list of clips or arrays, got {type(clips).__name__}; put a single clip in a list: [clip]"
        )
    found: list[Clip | tuple[Clip, ...]] = []
    for i, value in enumerate(clips):
        if isinstance(value, (str, bytes)):
            raise ValueError(f"clips: item {i} is text ({value!r}); read a file first with Clip.load(path)")
        if is_dataset(value):
            found.append(clip_of(value, fps=fps))
            continue
        several = isinstance(value, (tuple, list)) and value and all(isinstance(v, Clip) or _axes(v) == 3 for v in value)
        if several or (not isinstance(value, Clip) and _axes(value) == 4):
            found.append(tuple(as_clip(view, fps, f"{i} view {v}") for v, view in enumerate(value)))
        else:
            found.append(as_clip(value, fps, "" if isinstance(value, Clip) else str(i)))
    if not found:
        raise ValueError("clips: the list is empty; give at least one clip")
    return found


def gather(
    clips: Iterable[Any], fps: float, joints: int | None = None, skeleton: Skeleton | None = None
) -> tuple[list[Clip], list[int]]:
    """Checked training clips and, for each, the item it came from (views that do not decide the shape stay apart)."""
    found: list[Clip] = []
    owners: list[int] = []
    items = as_clips(clips, fps)
    skeleton = skeleton or layout_of([view for item in items for view in (item if isinstance(item, tuple) else [item])])
    for i, given in enumerate(items):
        views = match_all(given if isinstance(given, tuple) else [given], skeleton)
        item = tuple(views) if isinstance(given, tuple) else views[0]
        parts = combine(item) if isinstance(item, tuple) else [item]
        found += parts
        owners += [i] * len(parts)
    check_clips(found, joints, owners)
    return found, owners


def check_queries(
    clips: Iterable[Any],
    fps: float,
    joints: int,
    skeleton: Skeleton | None = None,
    fewest: int = 2,
    recordings: bool = False,
) -> list[Clip]:
    """Checked query clips of at least ``fewest`` frames, as images; 3D queries are seen along z."""
    found = []
    for i, item in enumerate(as_clips(clips, fps)):
        if isinstance(item, tuple):
            raise ValueError(f"clips: item {i} holds {len(item)} views; a query is one view, so predict each view and compare")
        found.append(item)
    found = match_all(found, skeleton)
    check_clips(found, joints, fewest=fewest, recordings=recordings)
    return [virtual(clip, 0.0, 0.1) if clip.dims == 3 else clip for clip in found]


def check_common(clips: list[Clip], seen: NDArray[np.bool_], known: NDArray[np.bool_]) -> None:
    """Raise where a query shares too few joints with every exemplar to be compared at all. seen ``(clips, joints)``."""
    most = (seen.astype(int) @ known.astype(int).T).max(axis=1)
    few = np.flatnonzero(most < min(MIN_SHARED_JOINTS, seen.shape[1]))
    if len(few):
        clip = clips[few[0]]
        raise ValueError(
            f"clip {few[0]} ({clip.name!r}): joints: it shares {most[few[0]]} joints with the learned clips, "
            f"{MIN_SHARED_JOINTS} are needed; leave it out, or learn from clips that show these joints"
        )


def gather_labels(clips: list[Clip], owners: list[int], labels: ArrayLike | None) -> Array:
    """``(clips,)`` labels in the dtype given; by default the clips' own."""
    if labels is None:
        missing = [i for i, clip in enumerate(clips) if _missing(clip.label)]
        if missing:
            raise ValueError(
                f"labels: none given, and clip {owners[missing[0]]} ({clips[missing[0]].name!r}) has no label; "
                "pass fit(clips, labels)"
            )
        values = np.asarray([clip.label for clip in clips])
    else:
        values = np.asarray(check_labels(labels, owners[-1] + 1)[owners])
    check_contradictions(clips, owners, values)
    return values


def check_contradictions(clips: list[Clip], owners: list[int], labels: Array) -> None:
    """Raise where one recording has two labels, and warn where it is given twice."""
    twice = []
    for other, i in same_clips(clips):
        both = f"{owners[other]} ({clips[other].name!r}) and {owners[i]} ({clips[i].name!r})"
        if labels[other] != labels[i]:
            raise ValueError(
                f"labels: clips {both} are the same recording, but one is {labels[other]!s} and the other {labels[i]!s}; correct a "
                "label, or leave one out"
            )
        twice += [both] if owners[other] != owners[i] else []
    if twice:
        more = f" (and {len(twice) - 1} more)" if len(twice) > 1 else ""
        warnings.warn(f"clips {twice[0]}{more} are the same recording, which counts twice; leave one out", stacklevel=4)


def gather_groups(clips: list[Clip], owners: list[int], groups: ArrayLike | None) -> Array | None:
    """``(clips,)`` names of who performs, as text; ``None`` where some clips do not say."""
    if groups is not None:
        values = np.asarray(groups)
        if values.ndim != 1 or len(values) != owners[-1] + 1:
            raise ValueError(f"groups: expected one per clip ({owners[-1] + 1}), got shape {values.shape}")
        nobody = [i for i, value in enumerate(values.tolist()) if _missing(value)]
        if nobody:
            raise ValueError(f"groups: who performs clip {nobody[0]} is missing; give every clip a group, or none of them")
        return values[owners].astype(str)
    if any("subject" not in clip.meta for clip in clips):
        return None
    return np.array([str(clip.meta["subject"]) for clip in clips])


def check_labels(labels: ArrayLike, items: int) -> Array:
    """``(items,)`` labels, one kind of thing and none missing."""
    given = labels.tolist() if isinstance(labels, np.ndarray) else labels
    if isinstance(given, Iterable) and not isinstance(given, (str, bytes)):
        given = list(given)
        bad = [i for i, value in enumerate(given) if _missing(value)]  # before numpy turns NaN among words into 'nan'
        if bad:
            raise ValueError(
                f"labels: the label of clip {bad[0]} is missing ({given[bad[0]]!r}); leave the clip out or name its action"
            )
        kinds = {isinstance(value, (str, bytes, np.str_)) for value in given}
        if len(kinds) > 1:
            raise ValueError("labels: text and numbers are mixed; give one kind of label")
    try:
        values = np.asarray(labels)
    except ValueError:
        raise ValueError(f"labels: expected one per clip ({items}), got lists of different lengths") from None
    if values.ndim != 1 or len(values) != items:
        raise ValueError(f"labels: expected one per clip ({items}), got shape {values.shape}")
    try:
        np.unique(values)
    except TypeError as error:
        raise ValueError(f"labels: they cannot be sorted ({error}); give one kind of label, text or numbers") from None
    return values


def _missing(label: Any) -> bool:
    return label is None or (isinstance(label, (float, np.floating)) and bool(np.isnan(label)))


def _axes(value: Any) -> int:
    try:
        return int(np.ndim(value))
    except ValueError:  # nested lists of different lengths: refused as a clip, by name
        return -1


def check_plan(indexer: Any, crops: int, exemplars: Any) -> None:
    """Raise where windows would be cut otherwise than those that are there."""
    count = len(exemplars)
    for name, now, then in (
        ("length", indexer.length, exemplars.crops.values.shape[1]),
        ("search", crops, len(exemplars.crops) // count),
        ("virtual_views", indexer.virtual_views, len(exemplars.views) // count),
    ):
        if now is not None and now != then:
            raise ValueError(f"{name} was changed since the clips were learned; set it back, or fit all clips again")
