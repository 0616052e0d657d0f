"""Movement as it is stored: a stretch without gaps at a steady rate, the joints of an archive, and the codes of poses."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dyntorch.numerics import one_thread
from indexing.action.bank import JointMetric
from indexing.action.exemplars import mirror_permutation
from indexing.cameras import rotation, y_up
from indexing.clip import Clip, FloatArray
from indexing.joints import FEWEST, has_names, places
from indexing.skeleton import Skeleton
from indexing.windows import concatenate_clips, interpolate_gaps, repair_clip, sample

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
    source = concatenate_clips([Clip(joints, times=times)])
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
    slip = (np.abs(joints - middle) > MAX_BODY_SIZES * body).any(axis=2, keepdims=True)
    return np.asarray(np.where(slip, np.nan, joints))


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


# evens out directions of codes: .25 gives .88 / .98 / .99 of right moments among 10 / 100 / 300, at 2 s .82 for .88
CODE_WHITENING_POWER = 0.5
CODE_FLOOR = 0.03  # added to the covariance of mean diagonal 1
MIDDLE_VARIANCE = 10.0  # of where the middle of all joints is, in those of a joint, where some were not seen
SIGHTING_VARIANCE = 1e-3  # in the same: nearly none, a code is to be that of the joints that were seen
MAX_LEARNED_POSES = 20_000  # from which the directions of a layout are learned, and after which they stay: 22 minutes
MAX_SAMPLED_WINDOWS = 3000  # from which the joint metric of a layout is learned
# of the joint metric; right moment first, of 280,000 of 1 s and 2 s: .25 gives .81 / .93, .4 .83 / .95, .5 .79 / .95
METRIC_POWER = 0.4
METRIC_FLOOR = 0.05
WINDOW_LENGTH = 12  # steps that windows are resampled to for the exact comparison

EIGHT = 127  # largest whole number of 8 bits


@dataclass(frozen=True, eq=False)
class Layout:
    """Joints that recordings share, and what was learned of them."""

    joints: int
    skeleton: Skeleton | None
    covariance: NDArray[np.float64]
    basis: NDArray[np.float32]
    metric: NDArray[np.float64]
    poses: int = 0
    swap: NDArray[np.int64] | None = None

    @property
    def name(self) -> str:
        """What to call it."""
        return self.skeleton.name if self.skeleton is not None else f"{self.joints} joints"

    @classmethod
    def learn(cls, tracks: Sequence[Track], skeleton: Skeleton | None, storage: StorageFormat) -> Layout:
        """From the tracks that came first."""
        joints = tracks[0].joints.shape[1]
        step = max(1, sum(map(len, tracks)) // MAX_LEARNED_POSES)
        poses = np.concatenate([track.positions()[::step] for track in tracks])
        centred = _unit(poses)
        covariance = _normalize_gram(np.einsum("tjd,tkd->jk", centred, centred, dtype=np.float64))
        values, vectors = np.linalg.eigh(covariance)
        values, vectors = values[::-1][: storage.dimensions].clip(min=0), vectors[:, ::-1][:, : storage.dimensions]
        # the sign of a direction is nobody's choice: the largest entry is positive, on every machine
        vectors = vectors * np.sign(vectors[np.abs(vectors).argmax(axis=0), np.arange(vectors.shape[1])])
        basis = (vectors * (values + CODE_FLOOR) ** -CODE_WHITENING_POWER).astype(np.float32)
        windows, seen = _windows(tracks, storage)
        mirrored = mirror_permutation(skeleton, windows, seen)
        swap = None if mirrored is None else mirrored.numpy()
        return cls(joints, skeleton, covariance, basis, _metric(windows, seen), sum(map(len, tracks)), swap)

    # ---- codes -------------------------------------------------------------------------------------------------------
    def project(self, poses: FloatArray) -> NDArray[np.float32]:
        """``(poses, 2, dimensions)`` codes of ``(poses, joints, 2)``, NaN = not seen; 0 where nearly nothing was."""
        seen: NDArray[np.bool_] = np.asarray(~np.isnan(poses).any(axis=2))
        out = np.zeros((len(poses), 2, self.basis.shape[1]), dtype=np.float32)
        known = np.where(seen[..., None], poses, 0.0).astype(np.float32)
        known = known - known.sum(axis=1, keepdims=True) / np.maximum(seen.sum(axis=1), 1)[:, None, None]
        patterns, which = np.unique(np.packbits(seen, axis=1), axis=0, return_inverse=True)
        which = which.reshape(-1)
        for number in range(len(patterns)):
            rows = np.flatnonzero(which == number)
            mine = seen[rows[0]]
            if mine.sum() >= min(FEWEST, self.joints):
                out[rows] = np.einsum("rjd,jk->rdk", known[rows][:, mine], self._reader(mine))
        return out

    def _reader(self, seen: NDArray[np.bool_]) -> NDArray[np.float32]:
        """``(seen, dimensions)``: from the joints seen to codes."""
        if seen.all():
            return self.basis
        wide = self.covariance + MIDDLE_VARIANCE
        given = wide[np.ix_(seen, seen)] + SIGHTING_VARIANCE * np.eye(int(seen.sum()))
        likely = np.linalg.solve(given, wide[seen])  # (seen, joints)
        likely = likely - likely.mean(axis=1, keepdims=True)
        return np.asarray((likely @ self.basis).astype(np.float32))

    def codes(self, poses: FloatArray) -> tuple[NDArray[np.int8], NDArray[np.float32]]:
        """Codes as they are stored: ``(poses, 2, dimensions)`` whole numbers, and ``(poses,)`` what a step of 1 is."""
        exact = self.project(poses)
        scale = np.abs(exact).max(axis=(1, 2)) / EIGHT
        whole = np.round(exact / np.where(scale > 0, scale, 1.0)[:, None, None])
        return whole.astype(np.int8), scale.astype(np.float32)

    # ---- who is compared with it -------------------------------------------------------------------------------------
    def facing(self, clip: Clip) -> Clip | None:
        """A clip with its joints in the order of these; ``None`` where too few are the same."""
        own = clip.skeleton
        if own is None or self.skeleton is None or not (has_names(own) and has_names(self.skeleton)):
            return clip if clip.joints.shape[1] == self.joints else None
        place = np.array(places(own, self.skeleton))
        shared = int((place >= 0).sum())
        if shared < max(FEWEST, min(self.joints, len(own.joints)) / 2):
            return None
        joints = clip.joints[:, place].copy()
        joints[:, place < 0] = np.nan
        return clip.replace(joints=joints, confidence=None, skeleton=self.skeleton) if (joints == joints).any() else None

    def joint_metric(self) -> JointMetric:
        """For the exact comparison."""
        return JointMetric(torch.from_numpy(self.metric), METRIC_POWER, floor=METRIC_FLOOR)

    # ---- as bytes ----------------------------------------------------------------------------------------------------
    def dump(self) -> bytes:
        """What was learned, as a file of numpy's."""
        stream = io.BytesIO()
        np.savez(
            stream,
            covariance=self.covariance,
            basis=self.basis,
            metric=self.metric,
            poses=self.poses,
            swap=[] if self.swap is None else self.swap,
        )
        return stream.getvalue()

    @classmethod
    def load(cls, data: bytes, joints: int, skeleton: Skeleton | None) -> Layout:
        """From the same."""
        with np.load(io.BytesIO(data), allow_pickle=False) as found:
            swap = found["swap"].astype(np.int64) if len(found["swap"]) else None
            return cls(joints, skeleton, found["covariance"], found["basis"], found["metric"], int(found["poses"]), swap)


def layout_key(joints: int, skeleton: Skeleton | None) -> str:
    """What tells layouts apart: names in their order, or how many joints, with their bones where these are known."""
    if skeleton is not None and has_names(skeleton):
        return ",".join(joint.replace(",", " ") for joint in skeleton.joints)
    bones = "" if skeleton is None else " ".join(f"{min(bone)}-{max(bone)}" for bone in sorted(skeleton.bones))
    return f"{joints}:{bones}" if bones else str(joints)


def _unit(poses: FloatArray) -> NDArray[np.float64]:
    """Centred poses of norm 1; joints that were not seen are in the middle."""
    seen = ~np.isnan(poses).any(axis=2, keepdims=True)
    x = np.where(seen, poses, 0.0).astype(np.float64)
    x = np.where(seen, x - x.sum(axis=1, keepdims=True) / np.maximum(seen.sum(axis=1, keepdims=True), 1), 0.0)
    norm = np.sqrt((x**2).sum(axis=(1, 2), keepdims=True))
    return np.asarray(x / np.where(norm > 0, norm, 1.0))


def _normalize_gram(gram: NDArray[np.float64]) -> NDArray[np.float64]:
    """With mean diagonal 1; a joint of which nothing is known is like the others."""
    unknown = np.diag(gram) <= 0
    total = np.trace(gram)
    scaled = gram * ((len(gram) - unknown.sum()) / total) if total > 0 else np.eye(len(gram))
    scaled[unknown, unknown] = 1.0
    return np.asarray(scaled)


def _metric(windows: Tensor, seen: Tensor) -> NDArray[np.float64]:
    """``(channels, joints, joints)`` covariances over windows."""
    return np.stack([_normalize_gram(one) for one in JointMetric.learn(windows, seen, 1.0).covariance.numpy()])


def _windows(tracks: Sequence[Track], storage: StorageFormat) -> tuple[Tensor, Tensor]:
    """``(N, length, joints, 2)`` windows of a second, evenly spread, and ``(N, joints)`` which joints were seen in each."""
    spans = [max(len(track) - round(storage.rate), 1) for track in tracks]
    step = max(1.0, sum(spans) / MAX_SAMPLED_WINDOWS)
    windows: list[Tensor] = []
    seen: list[NDArray[np.bool_]] = []
    offset = 0.0
    for track, span in zip(tracks, spans, strict=True):
        first = offset + step * np.arange(max(0, math.ceil((span - offset) / step)))
        offset += step * len(first) - span
        if not len(first):
            continue
        times = np.arange(len(track)) / storage.rate
        begin = times[first.astype(np.intp)]
        source = interpolate_gaps(track.positions(), times, np.array([0, len(track)]))
        windows.append(sample(source, np.zeros(len(first), dtype=np.intp), begin, begin + 1.0, WINDOW_LENGTH))
        seen.append(np.repeat(source.seen, len(first), axis=0))
    return torch.cat(windows), torch.from_numpy(np.concatenate(seen))
