r"""Sketches compared: an example of any duration slid along the codes of every pose of an archive.

With :math:`q_d \in R^{L k}` the codes of the example's x and y at L moments, orthonormalized, and :math:`a_d(t)` those of a window
that begins at t, the window resembles the example by the largest canonical correlation of the two planes,

.. math:: \sigma_1^2 = \lambda_{\max}\!\left(G^{-1} C C^T\right), \quad C_{de} = a_d(t)^T q_e, \quad G_{de} = a_d(t)^T a_e(t),

which is 1 where both are images of one movement by affine cameras, whatever these are (thesis, chapter 7).  All windows share
their products with each of the example's poses, so that no window is ever stored:
:math:`C(t) = \sum_l \langle a(t + l m), q_l \rangle`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dyntorch.numerics import native_correlations
from indexing.archive.segments import ArchiveSegment

BLOCK = 2**15  # windows compared at once: 5 ns a window and pass; at 4096 half of the time is spent between the passes
TASK_BLOCK = 2**20  # rows of a segment that one worker scans: 19 hours
GRAM_EPSILON = 1e-6  # of the trace of G, added to its diagonal: planes that are nearly lines stay finite


@dataclass(frozen=True, eq=False)
class Probe:
    """An example as it is slid along the codes."""

    image: int
    mirrored: bool
    seconds: float
    stride: int
    codes: NDArray[np.float32]
    moved: float = 0.0
    everywhere: bool = True
    longest: int = 0

    @property
    def samples(self) -> int:
        """How many poses of a window are compared."""
        return int(self.codes.shape[1])

    @property
    def span(self) -> int:
        """Poses from the first one compared to the last."""
        return (self.samples - 1) * self.stride


@dataclass(frozen=True, eq=False)
class Candidates:
    """Windows that resemble an example, best first, each a row of all arrays."""

    score: NDArray[np.float32]
    track: NDArray[np.int64]
    row: NDArray[np.int64]
    probe: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.score)

    @classmethod
    def concatenate(cls, parts: Sequence[Candidates]) -> Candidates:
        """Several, one after the other."""
        types = {"score": np.float32, "track": np.int64, "row": np.int64, "probe": np.int64}
        arrays = ([np.zeros(0, kind), *(getattr(part, name) for part in parts)] for name, kind in types.items())
        return cls(*(np.concatenate(array) for array in arrays))

    def __getitem__(self, index: NDArray[np.intp]) -> Candidates:
        return Candidates(self.score[index], self.track[index], self.row[index], self.probe[index])

    def top(self, count: int) -> Candidates:
        """The best ones; equal ones in the order in which they lie."""
        some = self
        if len(self) > count > 0:  # what is certainly not among them is not sorted
            some = self[np.flatnonzero(self.score >= np.partition(self.score, -count)[-count])]
        return some[np.lexsort((some.probe, some.row, some.track, -some.score))[:count]]


def orthonormal(codes: NDArray[np.float32]) -> NDArray[np.float32] | None:
    """``(2, samples, k)`` the same plane with orthonormal axes; ``None`` where it is no plane (nothing was seen)."""
    flat = codes.reshape(2, -1).astype(np.float64)
    gram = flat @ flat.T
    trace = np.trace(gram)
    if not trace > 0:
        return None
    lower = np.linalg.cholesky(gram + GRAM_EPSILON * trace * np.eye(2))
    return np.linalg.solve(lower, flat).reshape(codes.shape).astype(np.float32)


def correlation(c: Tensor, gram: Tensor) -> Tensor:
    r"""``(probes, n)`` squared largest canonical correlations."""
    trace = gram[0] + gram[2]
    g00, g01, g11 = gram[0] + GRAM_EPSILON * trace, gram[1], gram[2] + GRAM_EPSILON * trace
    determinant = g00 * g11 - g01 * g01
    inverse = torch.where(determinant > 0, determinant, torch.inf).reciprocal_()
    (a0, a1), (b0, b1) = (c[d].unbind(1) for d in range(2))
    p, q, r = (a0 * a0).addcmul_(a1, a1), (a0 * b0).addcmul_(a1, b1), (b0 * b0).addcmul_(b1, b1)
    total = (p * g11).addcmul_(q, g01, value=-2.0).addcmul_(r, g00).mul_(inverse)
    product = p.mul_(r).addcmul_(q, q, value=-1.0).mul_(inverse)
    return (total * total).add_(product, alpha=-4.0).clamp_(min=0.0).sqrt_().add_(total).mul_(0.5)


def scan(
    segment: ArchiveSegment,
    probes: Sequence[Probe],
    keep: int,
    dead: frozenset[int] = frozenset(),
    begin: int = 0,
    end: int | None = None,
) -> Candidates:
    """The windows of a segment that resemble an example best.

    Args:
        keep: windows at most; dead: recordings that were removed; begin, end: rows at which windows may begin.
    """
    end = len(segment.codes) if end is None else min(end, len(segment.codes))
    found = _TopWindows(keep)
    gone = np.isin(segment.tracks[:, 0], list(dead)) if dead else np.zeros(len(segment), dtype=bool)
    groups = sorted({(probe.stride, probe.samples) for probe in probes if probe.everywhere})
    for stride, samples in groups:
        numbers = [i for i, one in enumerate(probes) if one.everywhere and (one.stride, one.samples) == (stride, samples)]
        windows = -(-len(segment.codes) // stride) - samples + 1
        for low in range(-(-begin // stride), min(windows, -(-end // stride)), BLOCK):
            high = min(low + BLOCK, windows, -(-end // stride))  # windows that begin from low to high
            scores = _scores_along(segment, low, high, stride, [probes[i] for i in numbers])
            for i, score in zip(numbers, scores.numpy(), strict=True):
                better = np.flatnonzero(score > found.threshold)
                rows = (better + low) * stride
                track = np.searchsorted(segment.firsts, rows, side="right") - 1
                inside = ~gone[track] & (rows + (samples - 1) * stride < segment.firsts[track] + segment.tracks[track, 3])
                found.add(score[better[inside]], rows[inside], i)
    for i, probe in enumerate(probes):
        if probe.stride > 1 or not probe.everywhere:
            _scan_ends(found, segment, gone, probe, i, (begin, end))
    return found.candidates(segment)


def refine_candidates(segment: ArchiveSegment, coarse: Sequence[Probe], fine: Sequence[Probe], found: Candidates) -> Candidates:
    """Candidates of a scan, at every tempo moved by less than a step of it to where they resemble the example best."""
    parts: list[Candidates] = []
    for number in np.unique(found.probe).tolist():
        mine = np.flatnonzero(found.probe == number)
        track, image = found.track[mine], coarse[number].image
        first, rows = segment.firsts[track], segment.tracks[track, 3]
        for index, probe in enumerate(fine):
            if probe.image != image:
                continue
            # both windows have one middle; one that hangs over the ends of its track stays as it is
            row, score = found.row[mine] + (coarse[number].span - probe.span) // 2, found.score[mine].copy()
            last = rows - 1 - probe.span
            fits = last >= 0
            moves = np.arange(-(coarse[number].stride // 2), coarse[number].stride // 2 + 1)
            begin = np.clip(row[:, None] + moves, 0, np.maximum(last, 0)[:, None])[fits]
            each = _scores_at(segment, probe, begin + first[fits, None])
            best, count = each.argmax(axis=1), np.arange(len(each))
            row[fits], score[fits] = begin[count, best], each[count, best]
            parts.append(Candidates(score, track, row, np.full(len(row), index)))
    return Candidates.concatenate(parts)


def _scores_at(segment: ArchiveSegment, probe: Probe, first: NDArray[np.int64]) -> NDArray[np.float32]:
    """Squared correlations of windows that begin at some rows of the segment, in an array of any shape."""
    begins, steps = first.reshape(-1), np.arange(probe.samples)[:, None] * probe.stride
    axes, out = torch.from_numpy(probe.codes).flatten(1), np.empty(len(begins), dtype=np.float32)
    stored, scales = np.asarray(segment.codes), np.asarray(segment.scales)
    if native_correlations(stored, scales, probe.codes[None], probe.stride, begins, GRAM_EPSILON, out[None]):
        return out.reshape(first.shape)
    for low in range(0, len(begins), BLOCK):
        rows = begins[low : low + BLOCK] + steps
        # windows last, and a window's samples in one axis with its directions: all sums run over rows of windows
        codes = torch.from_numpy(stored.take(rows, axis=0)).permute(2, 0, 3, 1).contiguous().float()  # (2, samples, k, windows)
        x = codes.mul_(torch.from_numpy(scales.take(rows))[:, None]).flatten(1, 2)
        out[low : low + BLOCK] = correlation((axes @ x)[:, None], _gram(x))[0].numpy()
    return out.reshape(first.shape)


def _scores_along(segment: ArchiveSegment, low: int, high: int, stride: int, probes: Sequence[Probe]) -> Tensor:
    """``(probes, windows)`` the same of windows ``low`` to ``high``, a stride apart, of probes with as many samples."""
    axes, out = np.stack([probe.codes for probe in probes]), np.empty((len(probes), high - low), dtype=np.float32)
    stored, scales = np.asarray(segment.codes), np.asarray(segment.scales)
    if native_correlations(stored, scales, axes, stride, low * stride, GRAM_EPSILON, out):
        return torch.from_numpy(out)
    x = _poses(segment, low, high + axes.shape[2] - 1, stride)
    return _scores(x, _gram(x), probes)


def _scan_ends(
    found: _TopWindows, segment: ArchiveSegment, gone: NDArray[np.bool_], probe: Probe, number: int, inner: tuple[int, int]
) -> None:
    """The first and the last window of each short track: they may lie between two steps of the scan."""
    rows = segment.tracks[:, 3]
    there = ~gone & (rows > probe.span) & (rows <= probe.longest)
    first, last = segment.firsts[there], (segment.firsts + rows - 1 - probe.span)[there]
    first = np.concatenate([first, last[last > first]])
    first = first[(first >= inner[0]) & (first < inner[1])]
    if len(first):
        score = _scores_at(segment, probe, first)
        better = score > found.threshold
        found.add(score[better], first[better], number)


def mark_resembling(
    segment: ArchiveSegment, probes: Sequence[Probe], min_correlation: float, min_motion: float
) -> NDArray[np.bool_]:
    """``(rows,)`` the poses of windows that move as an example does, well enough."""
    marks = np.zeros(len(segment.codes) + 1, dtype=np.int64)
    none = np.zeros(len(segment), dtype=bool)
    for stride, samples in sorted({(probe.stride, probe.samples) for probe in probes}):
        mine = [probe for probe in probes if (probe.stride, probe.samples) == (stride, samples)]
        total = -(-len(segment.codes) // stride)
        for low in range(0, total - samples + 1, BLOCK):
            x = _poses(segment, low, min(total, low + BLOCK + samples - 1), stride)
            gram = _gram(x)
            resting = _gram(_window_sums(x, samples)) / samples
            scores = _scores(x, gram, mine, resting)
            energy = _window_sums(gram[0] + gram[2], samples)
            moved = 1.0 - (resting[0] + resting[2]) / torch.where(energy > 0, energy, 1.0)
            scores[moved < min_motion * torch.tensor([[probe.moved] for probe in mine])] = -1.0
            best = scores.amax(dim=0)
            best[torch.from_numpy(_outside(segment, none, low, len(best), samples, stride))] = -1.0
            begin = (np.flatnonzero(best.numpy() >= min_correlation) + low) * stride
            np.add.at(marks, begin, 1)
            np.add.at(marks, np.minimum(begin + (samples - 1) * stride + 1, len(marks) - 1), -1)
    return np.asarray(np.cumsum(marks[:-1]) > 0)


def _poses(segment: ArchiveSegment, low: int, high: int, stride: int) -> Tensor:
    """``(2, k, n)`` codes of every ``stride``-th pose, as they were before they were rounded."""
    rows = slice(low * stride, (high - 1) * stride + 1, stride)
    codes = segment.codes[rows]
    x = torch.from_numpy(np.ascontiguousarray(codes.reshape(len(codes), -1).T)).float()
    return x.mul_(torch.from_numpy(np.array(segment.scales[rows]))).view(2, codes.shape[2], len(codes))


def _gram(x: Tensor) -> Tensor:
    """``(3, n)`` x x, x y and y y of each pose."""
    return torch.stack([(x[0] * x[0]).sum(0), (x[0] * x[1]).sum(0), (x[1] * x[1]).sum(0)])


def _scores(x: Tensor, gram: Tensor, probes: Sequence[Probe], resting: Tensor | None = None) -> Tensor:
    """``(probes, windows)`` of all windows whose poses are there, of probes with as many samples."""
    codes = torch.from_numpy(np.stack([probe.codes for probe in probes]))  # (probes, 2, samples, k)
    samples = codes.shape[2]
    count = x.shape[2] - samples + 1
    products = (codes.flatten(0, 2) @ x).view(2, len(probes), 2, samples, x.shape[2])
    c = products[:, :, :, 0, :count].clone()
    for step in range(1, samples):
        c += products[:, :, :, step, step : step + count]
    total = _window_sums(gram, samples)
    return correlation(c, total if resting is None else total - resting)


def _window_sums(values: Tensor, samples: int) -> Tensor:
    """``(..., windows)`` the sums over each window of ``(..., poses)``."""
    count = values.shape[-1] - samples + 1
    total = values[..., :count].clone()
    for step in range(1, samples):
        total += values[..., step : step + count]
    return total


def _outside(
    segment: ArchiveSegment, gone: NDArray[np.bool_], low: int, count: int, samples: int, stride: int
) -> NDArray[np.bool_]:
    """``(windows,)`` which of them do not lie in one track that counts."""
    bounds = np.append(segment.firsts, len(segment.codes))
    first = max(0, int(np.searchsorted(bounds, low * stride, side="right")) - 1)
    last = int(np.searchsorted(bounds, (low + count + samples) * stride, side="left")) + 1
    begins, ends = bounds[first:last][:-1], bounds[first:last][1:]
    # windows that begin in a track, and those of them that end in it
    mine = np.clip(-(-begins // stride) - low, 0, count), np.clip(-(-(ends - (samples - 1) * stride) // stride) - low, 0, count)
    there = ~gone[first : first + len(begins)] & (mine[1] > mine[0])
    steps = np.zeros(count + 1, dtype=np.int64)
    np.add.at(steps, mine[0][there], 1)
    np.add.at(steps, mine[1][there], -1)
    return np.asarray(np.cumsum(steps[:-1]) <= 0)


class _TopWindows:
    """The best windows so far: what is certainly not among them is not looked at."""

    def __init__(self, keep: int) -> None:
        self.keep, self.threshold = keep, 0.0
        self._parts: list[tuple[NDArray[np.float32], NDArray[np.int64], int]] = []
        self._count = 0

    def add(self, scores: NDArray[np.float32], rows: NDArray[np.int64], probe: int) -> None:
        if len(scores) > self.keep:  # the first block, of which all is new: sorting it would take as long as comparing it
            self.threshold = max(self.threshold, float(np.partition(scores, -self.keep)[-self.keep]))
            mine = scores >= self.threshold
            scores, rows = scores[mine], rows[mine]
        self._parts.append((scores, rows, probe))
        self._count += len(scores)
        if self._count > 8 * self.keep:
            scores, rows, probes = self._all()
            order = np.lexsort((probes, rows, -scores))[: self.keep]
            self.threshold = float(scores[order[-1]])
            self._parts = [(scores[order][probes[order] == i], rows[order][probes[order] == i], i) for i in set(probes.tolist())]
            self._count = len(order)

    def _all(self) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.int64]]:
        scores = np.concatenate([np.zeros(0, np.float32), *(part[0] for part in self._parts)])
        rows = np.concatenate([np.zeros(0, np.int64), *(part[1] for part in self._parts)])
        probes = np.concatenate([np.zeros(0, np.int64), *(np.full(len(part[0]), part[2]) for part in self._parts)])
        return scores, rows, probes

    def candidates(self, segment: ArchiveSegment) -> Candidates:
        scores, rows, probes = self._all()
        track = np.searchsorted(segment.firsts, rows, side="right") - 1
        return Candidates(scores, track, rows - segment.firsts[track], probes).top(self.keep)
