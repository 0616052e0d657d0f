r"""The joints of an archive, and the codes of poses: what a sketch keeps of one.

Of the joints of a pose, centred, :math:`x, y \in R^n`, a sketch keeps :math:`B^T x, B^T y` with
:math:`B = U_k (\Lambda_k + \lambda)^{-\alpha}` from the covariance :math:`\Sigma = U \Lambda U^T` of joints, learned once for each
joint layout.  B acts on both coordinates alike, so that two images of one movement have codes of one space, whatever the cameras.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from indexing.action.bank import JointMetric
from indexing.action.symmetry import mirror_permutation
from indexing.archive.tracks import StorageFormat, Track
from indexing.clip import Clip, FloatArray
from indexing.joints import FEWEST, has_names, places
from indexing.skeleton import Skeleton
from indexing.windows import interpolate_gaps, sample

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
