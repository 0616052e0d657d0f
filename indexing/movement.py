"""Poses of ``movement`` datasets as clips, by what such a dataset looks like: neither movement nor xarray is imported.

A dataset of poses has ``position`` with the axes time, space, keypoints and, where it says who is who, individuals (in any order;
the names count), perhaps ``confidence`` with the same axes but space, coordinates (``time`` in seconds, or frames where nobody
knows the rate), and attributes (``fps``, ``time_unit``, ``source_file``).  See https://movement.neuroinformatics.dev.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing.clip import Clip, ClipSet, FloatArray, check_fps
from indexing.opening import clip_text, listing, quote
from indexing.skeleton import Skeleton

AXES = {
    "time": ("time",),
    "space": ("space",),
    "keypoints": ("keypoints", "keypoint"),
    "individuals": ("individuals", "individual"),
}
"""What the axes are called; a newer convention of the field has the singular."""
CARTESIAN = ("x", "y", "z")
NEEDED = "give a dataset of poses, as movement.io.load_poses gives it"


def is_dataset(value: Any) -> bool:
    """Whether a value looks like a dataset of movement: it has ``position`` with named axes."""
    ours = isinstance(value, (Clip, ClipSet, np.ndarray, str, bytes, Path))
    return not ours and hasattr(getattr(value, "position", None), "dims")


def clips_of(dataset: Any, *, fps: float | None = None, up: str | None = None, name: str = "") -> ClipSet:
    """A clip of each individual of a dataset of poses."""
    attrs = getattr(dataset, "attrs", None)
    attrs = attrs if isinstance(attrs, Mapping) else {}
    source = attrs.get("source_file")
    name = name or (Path(source).name if isinstance(source, str) and source else "dataset")
    values, axes = _values(dataset, "position", name)
    lacking = [axis for axis in ("time", "space", "keypoints") if axis not in axes]
    if lacking:
        boxes = "bounding boxes have none; " if lacking == ["keypoints"] else ""
        raise ValueError(f"{name}: position has the axes {listing(axes)}, but no {lacking[0]}; {boxes}{NEEDED}")
    position = _reorder(values, axes, ("time", "individuals", "keypoints", "space"))[..., _spatial(dataset, axes, values, name)]
    confidence = _confidence(dataset, position, name)
    times, rate, assumed = _times(dataset, attrs, len(position), fps, name)
    joints, people = _names(dataset, "keypoints", position.shape[2]), _names(dataset, "individuals", position.shape[1])
    bones = _skeleton(attrs, joints, name)
    visible: NDArray[np.bool_] = np.asarray(~np.isnan(position).any(axis=3))
    stated_up = attrs["up"] if isinstance(attrs.get("up"), str) else "-y" if position.shape[3] == 2 else "z"
    clips = []
    for i in range(position.shape[1]):
        if not visible[:, i].any():
            continue
        sure = None if confidence is None else confidence[:, i]
        if sure is not None and np.isnan(sure).all():
            sure = None
        who = (people[i] if people else str(i)) if position.shape[1] > 1 else None
        clips.append(
            Clip(
                np.ascontiguousarray(position[:, i]),
                times=times,
                confidence=None if sure is None else np.where(np.isnan(sure), visible[:, i], sure),
                fps=rate,
                fps_assumed=assumed,
                label=_label(attrs),
                name=name if who is None else f"{name}#{who}",
                skeleton=bones,
                up=up or stated_up,
                meta={} if who is None else {"person": who, "followed": "ids", "untracked": 0},
            )
        )
    if not clips:
        raise ValueError(f"{name}: nobody is seen in any of its {len(position)} frames (all NaN); leave it out")
    return ClipSet(clips, name)


def clip_of(dataset: Any, *, fps: float | None = None, name: str = "") -> Clip:
    """The only individual of a dataset of poses."""
    clips = clips_of(dataset, fps=fps, name=name)
    if len(clips) > 1:
        people = listing(clip.meta["person"] for clip in clips)
        what = f"{clips.name}: holds {len(clips)} individuals ({people}) where one is expected"
        raise ValueError(f"{what}; choose one: indexing.movement.clips_of(dataset)[0]")
    return clips[0]


def _values(dataset: Any, name: str, who: str) -> tuple[FloatArray, tuple[str, ...]]:
    """A variable as numbers, and its axes by the names that they have here."""
    variable = getattr(dataset, name)
    try:
        values = np.asarray(getattr(variable, "values", variable))
        if values.dtype.kind not in "fiub":
            raise TypeError(f"dtype {values.dtype}")
    except (TypeError, ValueError) as problem:
        raise ValueError(f"{who}: {name} holds no numbers ({clip_text(problem)}); {NEEDED}") from None
    called = {word: axis for axis, words in AXES.items() for word in words}
    axes = tuple(called.get(str(axis), str(axis)) for axis in variable.dims)
    strange = [axis for axis in axes if axis not in AXES]
    if strange or len(axes) != values.ndim or len(set(axes)) < len(axes):
        what = f"{who}: {name} has the axes {listing(axes)} and the shape {values.shape}"
        raise ValueError(f"{what}; select one of what is no axis of poses")
    return values.astype(values.dtype if values.dtype in (np.float32, np.float64) else np.float64), axes


def _reorder(values: FloatArray, axes: tuple[str, ...], wanted: tuple[str, ...]) -> FloatArray:
    """The axes in an order, those that are not there with one entry."""
    there = [axis for axis in wanted if axis in axes]
    values = values.transpose([axes.index(axis) for axis in there])
    return np.asarray(values[tuple(slice(None) if axis in axes else None for axis in wanted)])


def _coordinate(dataset: Any, axis: str) -> np.ndarray[Any, Any] | None:
    """What the entries of an axis are called, or its numbers; None where the dataset does not say."""
    coords = getattr(dataset, "coords", None)
    for name in AXES[axis]:
        try:
            coordinate = coords[name]  # type: ignore[index]
        except (KeyError, TypeError, IndexError):
            continue
        return np.atleast_1d(np.asarray(getattr(coordinate, "values", coordinate)))
    return None


def _names(dataset: Any, axis: str, count: int) -> list[str]:
    """Names of the entries of an axis; none where the dataset has none, or not as many."""
    coordinate = _coordinate(dataset, axis)
    return [str(name) for name in coordinate] if coordinate is not None and coordinate.shape == (count,) else []


def _spatial(dataset: Any, axes: tuple[str, ...], values: FloatArray, who: str) -> list[int]:
    """Where x, y and z are along the axis space."""
    count = values.shape[axes.index("space")]
    names = [name.lower() for name in _names(dataset, "space", count)] or list(CARTESIAN[:count])
    if sorted(names) != sorted(CARTESIAN[:count]) or count < 2:
        raise ValueError(f"{who}: space holds {listing(names)}; positions must be x, y or x, y, z (movement.utils.vector.pol2cart)")
    return [names.index(axis) for axis in CARTESIAN[:count]]


def _confidence(dataset: Any, position: FloatArray, who: str) -> FloatArray | None:
    """``(time, individuals, keypoints)``, or None where nothing is known."""
    if not hasattr(getattr(dataset, "confidence", None), "dims"):
        return None
    values, axes = _values(dataset, "confidence", who)
    confidence = _reorder(values, axes, ("time", "individuals", "keypoints", "space"))
    if confidence.shape != (*position.shape[:3], 1):
        what = f"{who}: confidence has the axes {listing(axes)} and the shape {values.shape}"
        raise ValueError(f"{what}, which do not fit position; {NEEDED}")
    return np.asarray(confidence[..., 0])


def _times(
    dataset: Any, attrs: Mapping[str, Any], frames: int, fps: float | None, who: str
) -> tuple[FloatArray, float | None, bool]:
    """Seconds of the frames, frames per second, and whether nobody said how many."""
    stated_fps = attrs.get("fps")
    stated_fps = float(stated_fps) if isinstance(stated_fps, (int, float, np.integer, np.floating)) and stated_fps > 0 else None
    rate = check_fps(30.0 if fps is None and stated_fps is None else stated_fps or fps, f"{who}: ")
    assumed = stated_fps is None and fps is None
    stamps = _coordinate(dataset, "time")
    if stamps is None:
        return np.arange(frames) / rate, rate, assumed
    if stamps.shape != (frames,):
        raise ValueError(f"{who}: time has the shape {stamps.shape} for {frames} frames; {NEEDED}")
    if stamps.dtype.kind in "mM":  # durations, or dates, of which the first begins the clock
        begin = stamps[0] if stamps.dtype.kind == "M" else np.timedelta64(0)
        return np.asarray((stamps - begin) / np.timedelta64(1, "s")), stated_fps, False
    if stamps.dtype.kind not in "fiu":
        raise ValueError(f"{who}: time holds {quote(stamps.flat[0].item())}; give seconds, or numbers of frames")
    unit = attrs.get("time_unit") or ("frames" if stated_fps is None else "seconds")
    if unit not in ("seconds", "frames"):
        raise ValueError(f"{who}: time_unit is {quote(unit)}; it must be 'seconds' or 'frames'")
    return (stamps.astype(np.float64), stated_fps, False) if unit == "seconds" else (stamps / rate, rate, assumed)


def _label(attrs: Mapping[str, Any]) -> str | int | None:
    label = attrs.get("label")
    return label.item() if isinstance(label, np.generic) else label if isinstance(label, (str, int)) else None


def _skeleton(attrs: Mapping[str, Any], joints: list[str], who: str) -> Skeleton | None:
    """The joints by name, with the bones that :meth:`Clip.to_movement` has noted."""
    if not joints or joints == [f"keypoint_{i}" for i in range(len(joints))]:  # which movement calls those without names
        return None
    try:
        flat = np.asarray(attrs.get("bones", [])).reshape(-1, 2).astype(np.int64)
        bones = tuple((int(a), int(b)) for a, b in flat)
        return Skeleton(str(attrs.get("skeleton", who)), tuple(joints), bones)
    except (TypeError, ValueError, OverflowError):
        return Skeleton(who, tuple(joints))
