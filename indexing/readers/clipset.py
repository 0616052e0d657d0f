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

from collections.abc import Hashable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing.clip import UP_AXES, Clip, ClipSet
from indexing.opening import error, shown
from indexing.readers.files import Source
from indexing.readers.npz import Archive
from indexing.readers.options import Options
from indexing.readers.sets import clip_labels, clip_meta, clip_names, clip_offsets, frame_times, need, per_clip, plain
from indexing.skeleton import Skeleton

Array = NDArray[Any]


def read(source: Source, options: Options) -> ClipSet:
    """Read a clip set; ``person`` does not matter, since a clip is one person already."""
    source.need("clipset", "npz")
    if options.size is not None:
        raise error(source.path, "size= does not apply to a clip set", "leave size out")
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
    data = Archive(path)
    joints = need(path, data, "joints", 3)
    if joints.shape[2] not in (2, 3) or joints.dtype.kind not in "fiu":
        raise error(
            path, f"joints must be numbers (F, n, 2 or 3), got {joints.dtype} {joints.shape}", "save x, y or x, y, z per joint"
        )
    dims = joints.shape[2]
    if not joints.shape[1] or not len(joints):
        raise error(path, f"joints has shape {joints.shape}", "a clip needs at least one frame and one joint")
    offsets = clip_offsets(path, data, "joints")
    count = len(offsets) - 1
    labels = [label] * count if label is not None else clip_labels(path, data, count)
    names = clip_names(path, data, count)
    joints, confidence = _trusted(path, data, joints, min_confidence)
    rate = per_clip(path, data, "fps", count, 30.0 if fps is None else fps)
    assumed = per_clip(path, data, "fps_assumed", count, "fps" not in data and "times" not in data and fps is None)
    times = frame_times(path, data, offsets, rate, names)
    up = per_clip(path, data, "up", count, "y")
    wrong = next((axis for axis in dict.fromkeys(map(str, up)) if axis not in UP_AXES or (axis.endswith("z") and dims == 2)), None)
    if wrong is not None:
        raise error(path, f"up is {shown(wrong)} for {dims}D joints", f"save one of {', '.join(UP_AXES)} (z only for 3D joints)")
    meta, skeleton = clip_meta(data, count, "joints"), _skeleton(path, data, joints.shape[1])
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
                    meta={key: plain(values[i]) for key, values in meta.items()},
                    fps_assumed=bool(assumed[i]),
                )
            )
        except ValueError as problem:
            what, _, remedy = str(problem).partition("; ")
            raise error(path, what, remedy or "correct it, and save the clip set again") from None
    return ClipSet(clips, path.name)


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


def _skeleton(path: Path, data: Mapping[str, Array], joints: int) -> Skeleton | None:
    if not {"bones", "joint_names", "parents"} & data.keys():
        return None
    names = tuple(str(name) for name in data["joint_names"].ravel()) if "joint_names" in data else tuple(map(str, range(joints)))
    if len(names) != joints:
        raise error(path, f"joint_names has {len(names)} names for {joints} joints", "save one name per joint")
    try:
        if "bones" in data:
            bones = [(a, b) for a, b in _whole(data["bones"], 2).tolist()]
        else:
            bones = [(parent, i) for i, parent in enumerate(_whole(data.get("parents", np.zeros(0)), 1).tolist()) if parent >= 0]
        return Skeleton(str(data.get("skeleton_name", path.stem)), names, tuple(bones))
    except (TypeError, ValueError, OverflowError) as problem:
        raise error(path, f"bones or parents do not fit the joints ({problem})", "save bones (m, 2) or parents (n)") from None


def _whole(values: Array, ndim: int) -> NDArray[np.int64]:
    if values.ndim != ndim or values.dtype.kind not in "fiu" or not (np.abs(values) < 2**31).all():
        raise ValueError(f"{values.dtype} of shape {values.shape}")
    return values.astype(np.int64)
