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

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing.clip import UP_AXES, Clip, ClipSet, FloatArray, LabelledSet
from indexing.files import replacing
from indexing.joints import check_named_layout, choose_layout
from indexing.opening import error, listing, quote
from indexing.readers.files import Format, Options, Source
from indexing.readers.npz import NumpyArchive
from indexing.readers.recording import merge_people, to_clips
from indexing.skeleton import Skeleton, candidates

# ----------------------------------------------------------------------------------------------------------------------
# Writing clip sets; the format is described in :mod:`indexing.readers.formats.clipset`.


Array = NDArray[Any]


def write_clip_set(clips: Sequence[Clip], path: str | Path) -> None:
    """Write clips to one ``.npz``: joints, times (seconds), labels, confidences, names and every ``meta`` field."""
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
        if key not in NOTES or all(key in clip.meta for clip in clips):
            data[key] = _column(path, clips, key)
    if not path.parent.is_dir():
        raise error(path, f"the folder {path.parent} does not exist", "create it first")
    with replacing(path) as stream:
        np.savez_compressed(stream, **data)  # type: ignore[arg-type]


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
        raise error(path, f"the label {quote(odd)} does not go with the others", "use text for all, or integers from 0 for all")
    return {"action": np.array([-1 if label is None else label for label in labels])}


def _bones(path: Path, clips: list[Clip]) -> dict[str, Array]:
    skeletons: set[Skeleton] = {clip.skeleton for clip in clips if clip.skeleton is not None}
    if not skeletons:
        return {}
    if len(skeletons) > 1:
        names = ", ".join(sorted(skeleton.name for skeleton in skeletons))
        raise error(path, f"the clips have different skeletons ({names})", "write one file per skeleton")
    skeleton = skeletons.pop()
    return {
        "bones": np.array(skeleton.bones, dtype=np.int64).reshape(-1, 2),
        "joint_names": np.array(skeleton.joints),
        "skeleton_name": np.array(skeleton.name),
    }


def _column(path: Path, clips: list[Clip], key: str) -> Array:
    lacking = [clip.name or str(i) for i, clip in enumerate(clips) if key not in clip.meta]
    if lacking:
        raise error(path, f"the clip {quote(lacking[0])} has no field {quote(key)}, others have", "give it to all, or to none")
    try:
        column = np.asarray([clip.meta[key] for clip in clips])
    except ValueError:
        column = np.empty(0, dtype=object)
    if column.dtype.kind not in "biufU":
        raise error(path, f"the field {quote(key)} is not numbers or text of one shape", "convert it, or drop it from Clip.meta")
    return column


# ----------------------------------------------------------------------------------------------------------------------
# What all ``.npz`` sets of recordings share: offsets, labels, names, clocks and whatever else is known of each recording.


# keys that describe frames, joints or the whole set: never meta, whatever their length
RESERVED = {"joints", "offsets", "action", "action_names", "times", "frame", "fps_assumed", "confidence", "up"}
RESERVED |= {"bones", "parents", "joint_names", "skeleton_name"}
NOTES = ("people", "layout", "may_lag")  # what readers say of some clips: left out of a set where not all have it
SLOWEST, FASTEST = 1e-6, 1e6  # frames per second: two a month, and the fastest cameras there are
LAST = 2**53  # whole numbers are exact below it
OFFSETS = "save offsets (N + 1): where each clip starts, and the end"
FORMS = {"joints": "joints (F, n, 2 or 3)", "frames": "frames (F, height, width)"}


def require_array(path: Path, data: Mapping[str, Array], key: str, ndim: int) -> Array:
    """One array with so many axes, or an error that names what the file holds."""
    if key not in data:
        what = f"is not a clip set: it has no {quote(key)} (it has {listing(data)})"
        raise error(path, what, f"save {FORMS.get(key, key)}, offsets (N + 1), action (N)")
    if data[key].ndim != ndim:
        raise error(path, f"{key} must have {ndim} dimensions, got shape {data[key].shape}", "see docs/guide/formats.md")
    return data[key]


def clip_offsets(path: Path, data: Mapping[str, Array], key: str) -> NDArray[np.int64]:
    """``(N + 1,)`` where each clip starts among the rows of ``key``, and the end."""
    frames = len(data[key])
    if "offsets" not in data:
        actions = data.get("action", np.zeros(1))
        if actions.size > 1:
            raise error(path, f"has {actions.size} actions but no offsets", OFFSETS)
        return np.array([0, frames])
    offsets = require_array(path, data, "offsets", 1)
    if offsets.dtype.kind not in "iu" or len(offsets) < 2:
        raise error(path, f"offsets must be at least 2 integers, got {offsets.dtype} {offsets.shape}", OFFSETS)
    offsets = offsets.astype(np.int64)
    if offsets[0] != 0 or offsets[-1] != frames:
        raise error(path, f"offsets run from {offsets[0]} to {offsets[-1]}, but {key} has {frames} frames", OFFSETS)
    stuck = np.flatnonzero(np.diff(offsets) <= 0)
    if stuck.size:
        i = int(stuck[0])
        both = offsets[i : i + 2].tolist()
        raise error(path, f"offsets must increase, but offsets[{i}:{i + 2}] = {both}", "leave empty clips out")
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
    action = require_array(path, data, "action", 1)
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
    names = require_array(path, data, "action_names", 1)
    if max(index) >= len(names):
        at = int(np.argmax(index))
        raise error(path, f"action[{at}] = {index[at]}, but there are {len(names)} action_names", "add the name")
    return [str(names[i]) if i >= 0 else None for i in index]


def frame_times(
    path: Path, data: Mapping[str, Array], offsets: NDArray[np.int64], rate: Array, names: Sequence[str]
) -> FloatArray | None:
    """``(F,)`` seconds, or None where neither times nor frame numbers are known."""
    key = next((key for key in ("times", "frame") if key in data), None)
    if rate.dtype.kind not in "fiu" or not ((rate >= SLOWEST).all() and (rate <= FASTEST).all()):
        raise error(path, f"fps must be positive, from {SLOWEST:g} to {FASTEST:g}", "save one value, or one per clip")
    if key is None:
        return None
    stamps = data[key]
    if stamps.shape != (offsets[-1],) or stamps.dtype.kind not in "fiu":
        raise error(path, f"{key} must be {offsets[-1]} numbers, got {stamps.dtype} {stamps.shape}", "save one per frame")
    stamps = stamps.astype(np.float64)  # before any difference: unsigned frame numbers would wrap around
    odd = np.flatnonzero(~(np.abs(stamps) < LAST))
    if odd.size:
        owner = int(np.searchsorted(offsets, odd[0], side="right")) - 1
        message = f"clip {quote(names[owner])}: {key} must increase, but row {odd[0]} has {stamps[odd[0]]:g}"
        raise error(path, message, "save seconds, or numbers of frames, of a recording")
    forward = stamps[1:] > stamps[:-1]
    forward[offsets[1:-1] - 1] = True  # a new clip may start anywhere
    if not forward.all():
        row = int(np.argmin(forward)) + 1
        clip = int(np.searchsorted(offsets, row, side="right")) - 1
        what = f"{key} must increase, but row {row} has {stamps[row]:g} after {stamps[row - 1]:g}"
        raise error(path, f"clip {quote(names[clip])}: {what}", "sort the frames and drop repeated ones")
    return np.asarray(stamps if key == "times" else stamps / np.repeat(rate.astype(np.float64), np.diff(offsets)))


def clip_meta(data: NumpyArchive, count: int, rows: str) -> dict[str, Array]:
    """What else is known of each clip, one entry per clip; ``rows`` is the key of what all of them consist of."""
    meta: dict[str, Array] = {}
    for key in data:
        if key in RESERVED or key == rows or data.shape(key)[:1] != (count,):
            continue
        values = meta[key] = data[key]
        if values.ndim == 2:
            meta.update({f"{key}{k}": values[:, k] for k in range(values.shape[1])})
    return meta


def to_python(value: Any) -> Any:
    """A Python number or text; rows of 2-D arrays stay arrays."""
    return value.item() if isinstance(value, np.generic) else value


def read(source: Source, options: Options) -> ClipSet:
    """Read a clip set; ``person`` matters where its clips are the people of one recording, as ``dyntorch pose`` writes them."""
    if options.size is not None:
        raise error(source.path, "size= does not apply to a clip set", "leave size out")
    known = {name: getattr(options, name) for name in ("fps", "label", "min_confidence", "layout")}
    clips = read_clip_set(source.path, **known)
    people = merge_people(clips)
    return clips if people is None else to_clips(source.path, people, replace(options, label=clips[0].label))


def read_clip_set(
    path: str | Path,
    *,
    fps: float | None = None,
    label: Hashable | None = None,
    min_confidence: float = 0.0,
    layout: str | None = None,
) -> ClipSet:
    """Read a clip-set ``.npz`` (its keys are listed above), without pickle."""
    path = Path(path)
    data = NumpyArchive(path)
    joints = require_array(path, data, "joints", 3)
    if joints.shape[2] not in (2, 3) or joints.dtype.kind not in "fiu":
        raise error(path, f"joints must be numbers (F, n, 2 or 3), got {joints.dtype} {joints.shape}", "save x, y or x, y, z")
    dims = joints.shape[2]
    if not joints.shape[1] or not len(joints):
        raise error(path, f"joints has shape {joints.shape}", "a clip needs at least one frame and one joint")
    offsets = clip_offsets(path, data, "joints")
    count = len(offsets) - 1
    labels = [label] * count if label is not None else clip_labels(path, data, count)
    names = clip_names(path, data, count)
    joints, confidence = _mask_unsure(path, data, joints, min_confidence)
    rate = per_clip(path, data, "fps", count, 30.0 if fps is None else fps)
    assumed = per_clip(path, data, "fps_assumed", count, "fps" not in data and "times" not in data and fps is None)
    times = frame_times(path, data, offsets, rate, names)
    up = per_clip(path, data, "up", count, "y")
    wrong = next((axis for axis in dict.fromkeys(map(str, up)) if axis not in UP_AXES or (axis.endswith("z") and dims == 2)), None)
    if wrong is not None:
        raise error(path, f"up is {quote(wrong)} for {dims}D joints", f"save one of {', '.join(UP_AXES)} (z only for 3D joints)")
    meta = {key: values for key, values in clip_meta(data, count, "joints").items() if key != "layout" or layout is None}
    skeleton, message = _layout(path, data, joints, [str(axis) for axis in dict.fromkeys(up.tolist())], layout)
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
                    meta={**{key: to_python(values[i]) for key, values in meta.items()}, **message},
                    fps_assumed=bool(assumed[i]),
                )
            )
        except ValueError as problem:
            what, _, remedy = str(problem).partition("; ")
            raise error(path, what, remedy or "correct it, and save the clip set again") from None
    return ClipSet(clips, path.name)


def _mask_unsure(path: Path, data: Mapping[str, Array], joints: Array, min_confidence: float) -> tuple[Array, Array | None]:
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


def _layout(
    path: Path, data: Mapping[str, Array], joints: Array, ups: Sequence[str], name: str | None
) -> tuple[Skeleton | None, dict[str, str]]:
    """Which joint is which: as the caller or the file says, or as the body shows; and what to say about it."""
    own = _skeleton(path, data, joints.shape[1])
    if name is not None:
        return check_named_layout(path, name, joints.shape[1], own), {}
    if "joint_names" in data or len(ups) != 1:
        return own, {}
    layout, message, _ = choose_layout(joints, None, candidates(joints.shape[1]), ups[0])
    return layout or own, message


def _skeleton(path: Path, data: Mapping[str, Array], joints: int) -> Skeleton | None:
    if not {"bones", "joint_names", "parents"} & data.keys():
        return None
    names = tuple(str(name) for name in data["joint_names"].ravel()) if "joint_names" in data else tuple(map(str, range(joints)))
    if len(names) != joints:
        raise error(path, f"joint_names has {len(names)} names for {joints} joints", "save one name per joint")
    try:
        if "bones" in data:
            bones = [(a, b) for a, b in _parse_integers(data["bones"], 2).tolist()]
        else:
            parents = _parse_integers(data.get("parents", np.zeros(0)), 1).tolist()
            bones = [(parent, i) for i, parent in enumerate(parents) if parent >= 0]
        return Skeleton(str(data.get("skeleton_name", path.stem)), names, tuple(bones))
    except (TypeError, ValueError, OverflowError) as problem:
        raise error(path, f"bones or parents do not fit the joints ({problem})", "save bones (m, 2) or parents (n)") from None


def _parse_integers(values: Array, ndim: int) -> NDArray[np.int64]:
    if values.ndim != ndim or values.dtype.kind not in "fiu" or not (np.abs(values) < 2**31).all():
        raise ValueError(f"{values.dtype} of shape {values.shape}")
    return values.astype(np.int64)


# ----------------------------------------------------------------------------------------------------------------------
# Film sets: one ``.npz`` with the grey frames of many short videos, laid out like a clip set.
#
# ``frames (F, height, width)`` uint8 takes the place of ``joints``; ``offsets``, ``action``, ``action_names``, ``times`` or
# ``frame``, ``fps``, ``names`` and whatever else is known of each film are the same.


@dataclass(frozen=True, eq=False)
class Film:
    """A short grey video in memory. frames ``(F, height, width)``."""

    frames: NDArray[np.uint8]
    times: NDArray[np.float64]
    label: Hashable | None = None
    name: str = ""
    meta: Mapping[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def duration(self) -> float:
        """Seconds from the first frame to the last."""
        return float(self.times[-1] - self.times[0])


class FilmSet(LabelledSet[Film]):
    """A list of films that can be selected by what is known of them."""


def holds_frames(path: str | Path) -> bool:
    """Whether a file is an ``.npz`` of frames, not of joints; looks at its table of contents only."""
    path = Path(path).expanduser()
    if path.suffix.lower() != ".npz":
        return False
    try:
        names = set(NumpyArchive(path))
    except ValueError:
        return False  # whoever reads it says what is wrong
    return "frames" in names and "joints" not in names


def read_film_set(path: str | Path, *, fps: float | None = None) -> FilmSet:
    """Read a film set, without pickle."""
    path = Path(path).expanduser()
    data = NumpyArchive(path)
    frames = require_array(path, data, "frames", 3)
    if frames.dtype != np.uint8:
        raise error(path, f"frames must be uint8 grey, got {frames.dtype}", "save grey values from 0 to 255")
    offsets = clip_offsets(path, data, "frames")
    count = len(offsets) - 1
    labels, names = clip_labels(path, data, count), clip_names(path, data, count)
    rate = per_clip(path, data, "fps", count, 30.0 if fps is None else fps)
    times = frame_times(path, data, offsets, rate, names)
    meta = clip_meta(data, count, "frames")
    films = []
    for i, (start, end) in enumerate(pairwise(offsets.tolist())):
        clock = np.arange(end - start) / float(rate[i]) if times is None else times[start:end] - times[start]
        known = {key: to_python(values[i]) for key, values in meta.items()}
        films.append(Film(frames[start:end], clock, labels[i], names[i], known))
    return FilmSet(films, path.name)


FORMAT = Format((), ("npz",), read)
