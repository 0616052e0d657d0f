"""Clip and ClipSet: the only data types of ``indexing``.

A clip is one recording of one person: joints over time, in the units they were measured in.  It holds what was seen and
nothing else: missing joints are NaN, times are seconds, and no value is invented here (interpolation happens in
:mod:`indexing.windows`, on a copy).
"""

from __future__ import annotations

import dataclasses
import sys
import warnings
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol, Self, TypeVar, cast, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from indexing.skeleton import Skeleton

# ----------------------------------------------------------------------------------------------------------------------
# A list of recordings that can be selected by what is known of them: the part that sets of clips and of films share.


class Labelled(Protocol):
    """What every recording in a set has: its action, if known, and whatever else is known of it."""

    @property
    def label(self) -> Hashable | None: ...
    @property
    def meta(self) -> Mapping[str, Any]: ...


T = TypeVar("T", bound=Labelled)


class LabelledSet(Sequence[T]):
    """Recordings, their labels, and selection by field."""

    def __init__(self, clips: Iterable[T], name: str = "") -> None:
        self.clips: tuple[T, ...] = tuple(clips)
        self.name = name

    @overload
    def __getitem__(self, index: int) -> T: ...

    @overload
    def __getitem__(self, index: slice | Sequence[int] | NDArray[Any]) -> Self: ...

    def __getitem__(self, index: int | slice | Sequence[int] | NDArray[Any]) -> T | Self:
        if isinstance(index, (int, np.integer)):
            return self.clips[index]
        if isinstance(index, slice):
            return type(self)(self.clips[index], self.name)
        chosen = np.asarray(index)
        if chosen.dtype == bool:
            if len(chosen) != len(self):
                raise ValueError(f"set {self.name!r}: a mask of {len(chosen)} values cannot select from {len(self)} clips")
            chosen = np.flatnonzero(chosen)
        return type(self)((self.clips[int(i)] for i in chosen), self.name)

    def __len__(self) -> int:
        return len(self.clips)

    def __iter__(self) -> Iterator[T]:
        return iter(self.clips)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r}, {len(self)} clips, fields: {', '.join(self.fields) or 'none'})"

    @property
    def labels(self) -> NDArray[Any]:
        """``(clips,)`` the actions; ``None`` where unknown."""
        values = [clip.label for clip in self.clips]
        if any(value is None or isinstance(value, tuple) for value in values):
            out = np.empty(len(values), dtype=object)
            out[:] = values
            return out
        return np.asarray(values)

    @property
    def fields(self) -> tuple[str, ...]:
        """Names that :meth:`select` and :meth:`column` accept."""
        names: dict[str, None] = {}
        for clip in self.clips:
            names.update(dict.fromkeys(clip.meta))
        return tuple(names)

    def column(self, name: str) -> NDArray[Any]:
        """``(clips, ...)`` one field of every clip; ``"action"`` or ``"label"`` gives the labels."""
        if name in ("action", "label") and name not in self.fields:
            return self.labels
        missing = [i for i, clip in enumerate(self.clips) if name not in clip.meta]
        if missing or not self.clips:
            raise ValueError(f"clip set {self.name!r}: no field {name!r}; known fields: {', '.join(self.fields) or 'none'}")
        return np.asarray([clip.meta[name] for clip in self.clips])

    def select(self, **criteria: Any) -> Self:
        """The clips whose fields equal the given value, or one of the given values."""
        keep = np.ones(len(self), dtype=bool)
        for name, wanted in criteria.items():
            column = self.column(name)
            if column.ndim != 1:
                raise ValueError(f"clip set {self.name!r}: field {name!r} has several columns; select one of them, e.g. {name}0")
            values = [wanted] if isinstance(wanted, str) or not isinstance(wanted, Iterable) else list(wanted)
            keep &= np.array([any(_equals(entry, value) for value in values) for entry in column.tolist()], dtype=bool)
        return self[keep]


def _equals(entry: Any, value: Any) -> bool:
    """Whether a field equals a value that may come as text (command line): 60 == 60.0 == "60"."""
    if entry == value or str(entry) == str(value):
        return True
    try:
        return float(entry) == float(value)
    except (TypeError, ValueError):
        return False


FloatArray = NDArray[np.floating[Any]]
LARGEST = 1e9  # of a coordinate: pixels, millimetres and map metres stay far below; float32 arithmetic needs a bound
GAP = 1.0  # seconds without frames, after which what follows is another stretch: no window that holds frames of both lasts longer
RARE = 4.0  # times the usual step between frames, which a gap is longer than, too: few frames per second are no gaps
FINEST, COARSEST = 1e6, 1e-3  # frames per second of any recording: outside these a rate is a slip
EXACT = 0.01  # of the step between frames, that neighbouring numbers may be apart where the clock is
UP_AXES = ("y", "-y", "z", "-z")


# when the third of three coordinates, from 0 to 1, is the confidence of pixels and no depth
SURE_PIXELS = 50.0  # units that a body goes over in x and y where they are surely no metres: no body is so flat
LIKELY_PIXELS = 10.0  # units that it goes over where they are probably none
MAX_ONES = 0.05  # share of values of exactly 1, and of places outside of the image, of which coordinates have hardly any
MIN_CONFIDENCE_MEDIAN = 0.9  # 3D data brought to 0 to 1 axis by axis stay below .87 (345 clips of three sets)
MIN_UNSTEADINESS = 2.5  # from frame to frame, over that of x and y: confidences 2.9 to 5.9 (pose2sim), depth at most 1.9


@dataclass(frozen=True, eq=False)
class Clip:
    """One person's joints over time.

    Args:
        joints: ``(frames, joints, 2 | 3)``; pixels, metres or any unit.  NaN (in any coordinate) = joint not seen.
        times: ``(frames,)`` seconds, strictly increasing.  Default: ``arange(frames) / fps``.
        confidence: ``(frames, joints)`` as the detector gave it; kept, and NaN only where the joint is NaN.
        fps: frame rate used where ``times`` is not given (30 by default, and then ``fps_assumed`` is true).
        label: the action, if known.
        name: what to call the clip in messages and reports (usually the file's name).
        skeleton: joint names and bones, where known (pictures, joint matching).
        up: the direction that points up in the scene: ``"y"`` (default), ``"-y"`` (image coordinates, where y points down),
            ``"z"`` or ``"-z"`` (3D only).  Every reader of pixel files sets ``"-y"``.
        meta: whatever else is known of the clip: subject, view, trial, split...

    Raises:
        ValueError: shapes do not fit, times are not increasing, or ``up`` is unknown.

    Example:
        >>> import numpy as np
        >>> clip = Clip(np.zeros((4, 17, 2)), fps=25.0)
        >>> clip.times.tolist(), clip.duration
        ([0.0, 0.04, 0.08, 0.12], 0.12)
    """

    joints: FloatArray
    times: FloatArray = None  # type: ignore[assignment]  # filled from fps in __post_init__
    confidence: FloatArray | None = None
    fps: float | None = None
    label: Hashable | None = None
    name: str = ""
    skeleton: Skeleton | None = None
    up: str = "y"
    meta: Mapping[str, Any] = field(default_factory=dict)
    fps_assumed: bool = False

    def __post_init__(self) -> None:
        who = f"clip {self.name!r}" if self.name else "clip"
        joints = _float_array(self.joints, f"{who}: joints")
        if joints.ndim != 3 or joints.shape[2] not in (2, 3):
            remedy = "one clip is one person, several clips are a list"
            if joints.ndim == 3 and joints.shape[2] == 4:
                remedy = "of x, y, z and a confidence give joints[..., :3] and confidence=joints[..., 3]"
            raise ValueError(f"{who}: joints must be (frames, joints, 2 or 3), got shape {joints.shape}; {remedy}")
        if joints.shape[0] == 0 or joints.shape[1] == 0:
            raise ValueError(f"{who}: joints is empty (shape {joints.shape}); a clip needs at least one frame and one joint")
        if (np.abs(joints) > LARGEST).any():
            raise ValueError(f"{who}: joints contains infinite or huge values (over {LARGEST:g}); mark missing joints with NaN")
        assumed = self.fps_assumed
        if cast("FloatArray | None", self.times) is None:
            fps = 30.0 if self.fps is None else self.fps
            assumed = assumed or self.fps is None
            times = np.arange(len(joints)) / check_fps(fps, f"{who}: ")
        else:
            times = np.array(_float_array(self.times, f"{who}: times"), dtype=np.float64)
            _check_times(times, len(joints), who)
            fps = self.fps if self.fps is not None else _rate(times)
        _check_depth(joints, who)
        confidence = self.confidence
        if confidence is not None:
            confidence = _float_array(confidence, f"{who}: confidence")
            if confidence.shape != joints.shape[:2]:
                raise ValueError(f"{who}: confidence must be (frames, joints) = {joints.shape[:2]}, got {confidence.shape}")
            seen = ~np.isnan(joints).any(axis=2)
            if np.isnan(confidence[seen]).any():
                at = np.argwhere(np.isnan(confidence) & seen)[0]
                raise ValueError(
                    f"{who}: confidence is NaN at frame {at[0]}, joint {at[1]}, though the joint has coordinates; "
                    "give 0 for a joint that is not trusted, or NaN coordinates for one that was not seen"
                )
        if self.up not in UP_AXES or (self.up.endswith("z") and joints.shape[2] == 2):
            raise ValueError(f"{who}: up must be one of {UP_AXES} (z only for 3D joints), got {self.up!r}")
        if self.skeleton is not None and len(self.skeleton.joints) != joints.shape[1]:
            raise ValueError(
                f"{who}: the skeleton {self.skeleton.name!r} has {len(self.skeleton.joints)} joints, the data {joints.shape[1]}"
            )
        final = {"joints": joints, "times": times, "confidence": confidence, "fps": fps, "fps_assumed": assumed}
        times.flags.writeable = False
        for key, value in final.items():
            object.__setattr__(self, key, value)

    def __len__(self) -> int:
        return len(self.joints)

    def __repr__(self) -> str:
        frames, joints, dims = self.joints.shape
        label = f", label={self.label!r}" if self.label is not None else ""
        return f"Clip({self.name!r}{label}, {frames} frames x {joints} joints x {dims}D, {self.duration:.2f} s)"

    @property
    def dims(self) -> int:
        """2 or 3."""
        return int(self.joints.shape[2])

    @property
    def duration(self) -> float:
        """Seconds from the first frame to the last."""
        return float(self.times[-1] - self.times[0])

    @property
    def seen(self) -> NDArray[np.bool_]:
        """``(frames, joints)``: which joints have coordinates."""
        return np.asarray(~np.isnan(self.joints).any(axis=2))

    def between(self, start: float, end: float) -> Clip:
        """The frames with ``start <= time <= end`` (seconds, on the clip's own clock).

        Raises:
            ValueError: no frame lies in the interval.
        """
        keep = (self.times >= start) & (self.times <= end)
        if not keep.any():
            since, until = ("its start" if start == -np.inf else f"{start:g} s"), ("its end" if end == np.inf else f"{end:g} s")
            raise ValueError(
                f"clip {self.name!r}: no frame between {since} and {until}; "
                f"it runs from {self.times[0]:.6g} s to {self.times[-1]:.6g} s, so give seconds within"
            )
        return dataclasses.replace(
            self,
            joints=self.joints[keep],
            times=self.times[keep],
            confidence=None if self.confidence is None else self.confidence[keep],
        )

    def replace(self, **changes: Any) -> Clip:
        """A copy with the named fields changed."""
        return dataclasses.replace(self, **changes)

    def save(self, path: str | Path, units: str | None = None) -> list[str]:
        """Write the clip in the format that the suffix says: ``.npz``, ``.trc``, ``.c3d`` or ``.nc``; see :meth:`ClipSet.save`."""
        return ClipSet([self], self.name).save(path, units)

    def to_movement(self) -> Any:
        """The clip as a dataset of poses of ``movement``: an ``xarray.Dataset``.

        ``position (time, space, keypoints, individuals)`` and ``confidence`` without space (NaN where none is known), time in
        seconds (frames, where nobody said how many per second), attributes ``fps``, ``time_unit``, ``ds_type``,
        ``source_software``, and ``up``, ``label`` and bones besides.  :func:`indexing.movement.clips_of` is the way back.

        Raises:
            ValueError: xarray is not installed.
        """
        return _files("writers.formats.nc").dataset_of([self])

    @classmethod
    def load(cls, path: str | Path, **options: Any) -> Clip:
        """Read one clip from a keypoint file or folder; see :func:`indexing.readers.read_clip`."""
        return cast("Clip", _files("readers").read_clip(path, **options))


class ClipSet(LabelledSet[Clip]):
    """A list of clips that can be selected by what is known of them.

    Example:
        >>> import numpy as np
        >>> clips = ClipSet([Clip(np.zeros((5, 3, 2)), label="walk", meta={"view": v}) for v in (1, 2, 3)])
        >>> len(clips.select(view=[1, 2])), clips.labels.tolist()
        (2, ['walk', 'walk', 'walk'])
    """

    def save(self, path: str | Path, units: str | None = None) -> list[str]:
        """Write the clips in the format that the suffix says.

        Args:
            path: of a clip-set ``.npz`` (everything; :meth:`load` reads it), or, of one recording's people, ``.trc``, ``.c3d`` or
                ``.nc`` (:mod:`indexing.writers`).
            units: of the coordinates, for ``.trc`` and ``.c3d``; see :func:`indexing.writers.write`.

        Returns:
            what the format has no place for, and what was assumed, a sentence each.

        Raises:
            ValueError: what the format cannot hold; nothing is written then.
        """
        writers = _files("writers")
        if Path(path).suffix.lower() in writers.FORMATS:
            return cast("list[str]", writers.write(self.clips, path, units))
        _files("readers.formats.clipset").write_clip_set(self, path)
        return []

    @classmethod
    def load(cls, path: str | Path, **options: Any) -> ClipSet:
        """Read a clip-set ``.npz``, or any keypoint file as a set of one; see :func:`indexing.readers.read`."""
        return cast("ClipSet", _files("readers").read(path, **options))


def _files(module: str) -> Any:
    """A module of readers or writers by its name: they make clips of files, so that clips cannot import them."""
    return import_module(f"indexing.{module}")


def as_clip(value: Clip | ArrayLike, fps: float = 30.0, name: str = "") -> Clip:
    """A :class:`Clip` from a clip, or from a uniformly sampled ``(frames, joints, 2 | 3)`` array at ``fps``."""
    if isinstance(value, Clip):
        return value
    return Clip(_float_array(value, f"clip {name!r}" if name else "clip"), fps=fps, name=name)


def stretches(times: FloatArray, gap: float = GAP) -> NDArray[np.intp]:
    """A recording cut where it has no frames for long: the one place where gaps of a clock are told from its steps. times
    ``(frames,)`` -> ``(stretches, 2)``."""
    steps = np.diff(times)
    usual = float(np.median(steps)) if len(steps) else 0.0
    cuts = np.flatnonzero(steps > max(gap, RARE * usual)) + 1
    return np.stack([np.concatenate([[0], cuts]), np.concatenate([cuts, [len(times)]])], axis=1).astype(np.intp)


def is_number(value: Any) -> bool:
    """Whether a value is a finite number, and not a truth value."""
    return isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool) and bool(np.isfinite(value))


def check_fps(fps: Any, who: str = "") -> float:
    """A frame rate that a recording can have."""
    if not (is_number(fps) and fps > 0):
        raise ValueError(f"{who}fps must be a positive number of frames per second, got {fps!r}")
    if not COARSEST <= fps <= FINEST:
        raise ValueError(f"{who}fps must be frames per second, from {COARSEST:g} to {FINEST:,.0f}, got {fps:g}")
    return float(fps)


def _float_array(value: Any, what: str) -> FloatArray:
    """A real array of float32 or float64 that nobody else can change."""
    if type(value) is np.ndarray and value.base is None and not value.flags.writeable and value.dtype in (np.float32, np.float64):
        return value  # one of those that this made
    try:
        array = np.asarray(value.detach().cpu().numpy() if hasattr(value, "detach") else value)
        if array.dtype.kind not in "fiub":
            raise TypeError(f"dtype {array.dtype}")
        array = np.array(array, dtype=array.dtype if array.dtype in (np.float32, np.float64) else np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{what}: expected an array of numbers, got {type(value).__name__} ({error})") from None
    array.flags.writeable = False
    return array


def _check_depth(joints: FloatArray, who: str) -> None:
    """Raise where what should be depth is surely the confidence of pixels, and warn where it may be."""
    if joints.shape[2] != 3:
        return
    least, most = (float(edge.reduce(joints[..., 2], axis=None)) for edge in (np.fmin, np.fmax))
    if not (least >= 0 and 0 < most <= 1):
        return  # nearly always, or nothing is seen
    known: NDArray[np.bool_] = np.asarray(~np.isnan(joints).any(axis=2))
    if not known.any():
        return
    third = joints[..., 2][known]
    low, high = (
        edge(np.where(known[..., None], joints[..., :2], fill), axis=1) for edge, fill in ((np.min, np.inf), (np.max, -np.inf))
    )
    seen = known.any(axis=1)
    # of one point, the way that it goes
    width = float(np.median((high - low)[seen].max(axis=1)) if joints.shape[1] > 1 else np.ptp(high[seen], axis=0).max())
    typical = _is_confidence(joints, known)
    remedy = "give joints[..., :2] and confidence=joints[..., 2]"
    if width > (LIKELY_PIXELS if typical else SURE_PIXELS) and (typical or joints.shape[1] > 1):
        raise ValueError(
            f"{who}: joints: x and y go over {width:.3g}, and z from {third.min():.2g} to {third.max():.2g}, which is "
            f"the confidence of pixels, not depth; {remedy}"
        )
    inside = float(((joints[known][:, :2] >= 0) & (joints[known][:, :2] <= 1)).all(axis=1).mean())
    if width > LIKELY_PIXELS or (typical and inside > 1 - MAX_ONES):
        # without the clip's name: of a set, it is said once
        warnings.warn(
            f"joints: z goes from 0 to 1 as a confidence does, and is taken for depth; if it is none, {remedy}", stacklevel=4
        )


def _is_confidence(joints: FloatArray, known: NDArray[np.bool_]) -> bool:
    """Whether the third of ``(frames, joints, 3)`` values goes as the confidences of detectors do."""
    third, nowhere = joints[..., 2][known], (joints[known][:, :2] == 0).all(axis=1)
    if nowhere.any() and bool((nowhere == (third == 0)).all()):
        return True  # nobody, as detectors write it
    if joints.shape[1] == 1:
        return False
    across, along = _unsteady(joints[..., :2]), _unsteady(joints[..., 2:])
    if float((third == 1).mean()) > MAX_ONES or float(np.median(third)) > MIN_CONFIDENCE_MEDIAN:
        return True
    return float(along[0]) > MIN_UNSTEADINESS * float(across.max())


def _unsteady(values: FloatArray) -> FloatArray:
    """``(d,)`` how far ``(frames, joints, d)`` values go from frame to frame, of how far they are from the joint's mean."""
    known = ~np.isnan(values)
    means = np.where(known, values, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    steps, away = np.abs(np.diff(values, axis=0)), np.abs(values - means)
    ratio = [np.where(np.isnan(one), 0.0, one).sum(axis=(0, 1)) / max(1, int((~np.isnan(one)).sum())) for one in (steps, away)]
    return np.asarray(ratio[0] / np.maximum(ratio[1], np.finfo(np.float64).tiny))


def _check_times(times: FloatArray, frames: int, who: str) -> None:
    if times.shape != (frames,):
        raise ValueError(f"{who}: times must hold one value per frame ({frames}), got shape {times.shape}")
    if not np.isfinite(times).all():
        raise ValueError(
            f"{who}: times contains NaN or infinite values at frame {int(np.argmin(np.isfinite(times)))}; drop those frames"
        )
    steps = np.diff(times)
    if (steps <= 0).any():
        at = int(np.argmax(steps <= 0)) + 1
        raise ValueError(
            f"{who}: times must increase, but frame {at} is at {times[at]:g} s after {times[at - 1]:g} s; "
            "sort the frames by time and drop repeated ones"
        )
    usual, coarse = float(np.median(steps)) if len(steps) else np.inf, float(np.spacing(np.abs(times).max()))
    if coarse > EXACT * usual:
        raise ValueError(
            f"{who}: times reach {times[np.abs(times).argmax()]:.3g} s, where numbers are {coarse:.2g} s apart, but frames "
            f"{usual:.2g} s; number frames, or count seconds, from the start of the recording"
        )


def _rate(times: FloatArray) -> float:
    # of steps below the smallest normal number the rate would be infinite
    return float(1.0 / max(float(np.median(np.diff(times))), sys.float_info.min)) if len(times) > 1 else 30.0
