"""Movement as it is stored: one person's stretch without gaps, poses at a steady rate, joints as whole numbers of 16 bits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from dyntorch.numerics import one_thread
from indexing.cameras import rotation, y_up
from indexing.clip import Clip, FloatArray
from indexing.windows import ragged, repair_clip, sample

MISSING = -(2**15)  # stored coordinate of a joint that was not seen
LARGEST = 2**15 - 2  # of the others
MIN_JOINTS = 3  # that a frame must show, to show anybody
MAX_BRIDGED_GAP = 1.0  # seconds between two sightings of a joint over which it is interpolated; it is not seen in longer gaps
MAX_BODY_SIZES = 200.0  # from the middle of a stretch; beyond it a joint is a slip: rounding costs .6 % of a body at worst
MAX_SIZED_FRAMES = 500  # by which the size of a body is measured for that
REPAIR_STRIDE = 8  # of so many sightings one tells how far is usual: a third of the time on clean clips


@dataclass(frozen=True)
class StorageFormat:
    """How an archive stores movement, as it says itself: poses per second, directions of a sketch, seconds of the shortest window,
    degrees about the vertical from which movement in 3D is kept (see :class:`indexing.ArchiveOptions`)."""

    rate: float = 15.0
    dimensions: int = 8
    min_duration: float = 0.5
    views: tuple[float, ...] = (0.0, 90.0)


@dataclass(frozen=True, eq=False)
class Track:
    """A stretch of one person's movement."""

    recording: int
    view: int
    start: float
    joints: NDArray[np.int16]
    origin: FloatArray
    scale: float

    def __len__(self) -> int:
        return len(self.joints)

    def positions(self, first: int = 0, end: int | None = None) -> NDArray[np.float32]:
        """``(rows, joints, 2)`` in the unit of the source, NaN where not seen."""
        return positions(self.joints[first:end], self.origin, self.scale)


def positions(stored: NDArray[np.int16], origin: FloatArray, scale: float | FloatArray) -> NDArray[np.float32]:
    """Stored joints in the unit of their source."""
    found = (stored * scale + origin).astype(np.float32)
    found[(stored == MISSING).any(axis=-1)] = np.nan
    return found


@one_thread
def tracks_of(clip: Clip, storage: StorageFormat, recording: int = 0) -> list[Track]:
    """One person's recording as tracks; none where nobody is in view for long enough."""
    found: list[Track] = []
    clip = repair_clip(clip, REPAIR_STRIDE)
    for view, image in enumerate(images(clip, storage.views)):
        there = image.seen.sum(axis=1) >= min(MIN_JOINTS, image.joints.shape[1])
        if not there.any():
            continue
        rows = np.flatnonzero(there)
        joints, times = y_up(image)[rows], image.times[rows]
        cuts = np.flatnonzero(np.diff(times) > MAX_BRIDGED_GAP + 1e-6) + 1
        for begin, end in pairwise([0, *cuts.tolist(), len(times)]):
            track = _track(joints[begin:end], times[begin:end], storage, recording, view)
            found += [] if track is None else [track]
    return found


def images(clip: Clip, views: Sequence[float]) -> list[Clip]:
    """What is kept of a clip: itself where it is an image, else the images of cameras far away, at degrees about the vertical."""
    if clip.dims == 2:
        return [clip]
    points = y_up(clip)
    turned = [points @ rotation(np.deg2rad(azimuth), 0.0).T.astype(points.dtype) for azimuth in views]
    return [clip.replace(joints=np.ascontiguousarray(one[..., :2]), up="y") for one in turned]


def _track(joints: FloatArray, times: FloatArray, storage: StorageFormat, recording: int, view: int) -> Track | None:
    """A stretch without gaps at a steady rate; ``None`` where it is too short."""
    count = int((times[-1] - times[0]) * storage.rate + 1e-6) + 1
    if count < storage.min_duration * storage.rate + 1 or len(times) < 2:
        return None
    joints = _without_slips(joints)
    source = ragged([Clip(joints, times=times)])
    at = times[0] + np.arange(count) / storage.rate
    half = 0.5 / storage.rate
    values = sample(source, np.zeros(count, dtype=np.intp), at - half, at + half, 1)[:, 0].numpy().astype(np.float64)
    seen: NDArray[np.bool_] = np.asarray(~np.isnan(joints).any(axis=2))
    shown = seen_around(seen, times, at, MAX_BRIDGED_GAP)
    if not shown.any():
        return None
    low, high = values[shown].min(axis=0), values[shown].max(axis=0)
    origin, scale = (low + high) / 2, float((high - low).max()) / 2 / LARGEST
    if not scale > 0:
        return None  # all joints at one place
    stored = np.clip(np.round((values - origin) / scale), -LARGEST, LARGEST).astype(np.int16)
    stored[~shown] = MISSING
    return Track(recording, view, float(times[0]), stored, origin, scale)


def _without_slips(joints: FloatArray) -> FloatArray:
    """Joints without those so far from the others that nothing else could be told from one another beside them."""
    some = joints[:: max(1, len(joints) // MAX_SIZED_FRAMES)].reshape(-1, 2)
    some = some[~np.isnan(some).any(axis=1)]
    if not len(some):
        return joints
    middle = np.median(some, axis=0)
    body = max(2 * float(np.median(np.abs(some - middle), axis=0).max()), 1e-30)
    low, high = np.nanmin(joints, axis=(0, 1)), np.nanmax(joints, axis=(0, 1))
    if max(float((high - middle).max()), float((middle - low).max())) <= MAX_BODY_SIZES * body:
        return joints  # nearly always
    with np.errstate(invalid="ignore"):
        slip = (np.abs(joints - middle) > MAX_BODY_SIZES * body).any(axis=2)
    joints = joints.copy()
    joints[slip] = np.nan
    return joints


def seen_around(seen: NDArray[np.bool_], times: FloatArray, at: FloatArray, bridged: float) -> NDArray[np.bool_]:
    """``(moments, joints)``: which joints are known at moments, from sightings on both sides that are not too far apart."""
    found = np.zeros((len(at), seen.shape[1]), dtype=bool)
    step = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    for joint in range(seen.shape[1]):
        known = times[seen[:, joint]]
        if not len(known):
            continue
        after = np.searchsorted(known, at)
        before, later = known[np.maximum(after - 1, 0)], known[np.minimum(after, len(known) - 1)]
        near = np.minimum(np.abs(at - before), np.abs(later - at)) <= 0.5 * step + 1e-9
        found[:, joint] = near | ((before <= at) & (at <= later) & (later - before <= bridged))
    return found


def windows_of(rows: int, storage: StorageFormat) -> int:
    """How many windows of the shortest duration begin at a pose of a track."""
    return max(0, rows - math.ceil(storage.min_duration * storage.rate))


def total_windows(tracks: Sequence[Track], storage: StorageFormat) -> int:
    """Windows of some tracks."""
    return sum(windows_of(len(track), storage) for track in tracks)
