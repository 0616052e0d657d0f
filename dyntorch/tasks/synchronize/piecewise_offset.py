"""An offset that jumps: piecewise constant by dynamic programming under one fundamental matrix, and the evidence for each jump."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dyntorch.geometry.epipolar import epipolar_variance
from dyntorch.numerics.lags import epipolar_moments
from dyntorch.tasks.synchronize.epipolar import (
    MIN_HALF_OVERLAP_SHARE,
    MIN_PEAK_SEPARATION_FRAMES,
    ROBUST_CUTOFF_SIGMAS,
    SCALE_RANGE,
    EpipolarFit,
    Grid,
    Samples,
    ShiftDescent,
    epipolar_curve,
)
from dyntorch.tasks.synchronize.result import SynchronizeOptions
from dyntorch.tasks.synchronize.tracks import Tracks, smooth_at

# ----------------------------------------------------------------------------------------------------------------------
# One fundamental matrix, and at every moment the lag that it explains best: the cheapest course of lags that seldom jumps.


@dataclass(frozen=True)
class Jump:
    """Where the offset changes, on a's clock, as the frames' own times say."""

    moment: float  # seconds of a's clock: the last moment before
    sigma: float  # of the moment, seconds
    size: float  # seconds by which the offset grows; negative where b lost frames


@dataclass(frozen=True)
class PiecewiseOffset:
    """An offset with jumps."""

    rate: float  # of b's clock that was taken out
    offset: float  # of the first piece, seconds
    jumps: tuple[Jump, ...]  # in order
    fit: EpipolarFit  # of everything, with what was lost put back
    scale: Tensor  # ``(n,)`` standard deviation of each point's residuals, px

    def at(self, moment: float) -> float:
        """The offset at a moment of a's clock, seconds."""
        return self.offset + sum(jump.size for jump in self.jumps if jump.moment < moment)


WINDOW_SECONDS = 4.0  # Window that has a best shift by itself, where the search starts.
MAX_WINDOWS = 8  # Windows at most.
MIN_WINDOW_OVERLAP_SHARE = 0.6  # Share of a window that has to overlap.
HALF_FRAME_RANGE = 4.0  # Frames about the current offset within which half frames are compared, too.
MIN_PIECE_SECONDS = 0.7  # Shortest piece.
LAG_RESOLUTION_FRAMES = 0.2  # Image motion within this is no residual, frames.
UNSEEN_COST = 1.0  # Nats of a position that the other camera does not show: twice those of one that fits.
JUMP_PENALTY = 12.0  # Nats that a jump costs in the search.
MAX_ALTERNATIONS = 6  # Alternations of search and fit.


class PiecewiseOffsetSearch:
    """Both cameras at equal steps of a's clock, for one rate of b's."""

    def __init__(self, a: Tracks, b: Tracks, rate: float, max_shift: float | None, options: SynchronizeOptions) -> None:
        self.a, self.b, self.rate, self.options = a, b, rate, options
        self.step = max(a.step, b.step)
        self.samples = Samples.of(a, b, self.step, rate)
        self.max_shift = max_shift
        self.times = a.every(self.step)
        self.x, _, self.weights = smooth_at(a, self.times, self.step)
        self.grid = Grid.of(b, self.step)

    def starts(self) -> list[tuple[float, float, Tensor]]:
        """Middle, offset and fundamental matrix (px) of windows of the take by themselves: within most of them nothing jumps."""
        w1 = self.samples.w1
        size = round(WINDOW_SECONDS / self.step)
        count = min(MAX_WINDOWS, max(1, round(2 * len(w1) / size) - 1))
        found = []
        for first in np.linspace(0, max(0, len(w1) - size), count).round().astype(int).tolist():
            part = torch.zeros_like(w1)
            part[first : first + size] = w1[first : first + size]
            samples = dataclasses.replace(self.samples, w1=part)
            best = epipolar_curve(samples, self.max_shift, MIN_WINDOW_OVERLAP_SHARE).peaks(1)
            if best:
                middle = float(self.times[min(first + size // 2, len(self.times) - 1)])
                found.append((middle, best[0][0] * self.rate, self._fundamental(samples, best[0][0])))
        return found

    def _fundamental(self, samples: Samples, lag: float) -> Tensor:
        """Of px, by the pairs at the nearest step."""
        at = round((lag - samples.start) / samples.step)
        moments, _ = epipolar_moments(samples.x1, samples.x2, (at, at), (samples.w1, samples.w2))
        F = epipolar_variance(moments, samples.noise)[1][0]
        return self.b.change.mT @ F @ self.a.change

    def residuals(self, F: Tensor, offset: float) -> Tensor:
        """Signed Sampson distances ``(T, n)`` in px of a at one offset; NaN where not both are seen."""
        x2, _, w2 = self.grid.at(self.times * self.rate + offset)
        ratio = self._ratio
        Fp, Fq = _epipolar_lines(self.x, F), _epipolar_lines(x2, F.mT)
        gradient = Fq[..., :2].square().sum(-1) + ratio**2 * Fp[..., :2].square().sum(-1)
        distance = ((x2 * Fp[..., :2]).sum(-1) + Fp[..., 2]) / gradient.clamp(min=1e-300).sqrt()
        return torch.where((self.weights > 0) & (w2 > 0), distance, torch.nan)

    @cached_property
    def _ratio(self) -> float:
        s1, s2 = self.samples.noise
        return s2 / s1 * float(self.a.change[0, 0]) / float(self.b.change[0, 0])

    def costs(self, F: Tensor, offsets: Tensor, scale: Tensor) -> NDArray[np.float64]:
        """Nats ``(T, L)`` that the residuals of every moment cost at each offset; a little more than usual where nothing is seen,
        or the course would go where that is so."""
        unseen = UNSEEN_COST
        return np.stack([_cost(self.residuals(F, one), scale, unseen) for one in offsets.tolist()], axis=1)

    def scale(self, F: Tensor, offset: float) -> Tensor:
        """``(n,)`` robust standard deviation of each point's residuals at an offset, px."""
        return torch.maximum(_robust_scale(self.residuals(F, offset)), self.finest(F, offset))

    def finest(self, F: Tensor, offset: float) -> Tensor:
        """``(n,)`` px that a part of a frame makes: what lags that are frames apart cannot tell."""
        moved = self.residuals(F, offset + self.step) - self.residuals(F, offset)
        return LAG_RESOLUTION_FRAMES * _robust_scale(moved).clamp(min=1e-9 * self.a.scale)

    def estimate(self, offset: float, F: Tensor) -> PiecewiseOffset | None:
        """From a start: the cheapest lags, what was lost put back, and one fit of all that, until the jumps stay."""
        scale, known, fit = self.scale(F, offset), None, None
        for _ in range(MAX_ALTERNATIONS):
            offsets = self._offsets(offset)
            if not len(offsets):
                return None  # gone astray
            costs = self.costs(F, offsets, scale)
            path = cheapest_path(costs, JUMP_PENALTY)
            jumps = self._jumps(path, offsets, costs)
            first = float(offsets[path[0]])
            mended_a, mended_b = repair_clocks(self.a, self.b, self.rate, first, jumps)
            fit = ShiftDescent(mended_a, mended_b, self.step).run(first, self.rate)
            if fit is None:
                return None
            same, known = _same_jumps(jumps, known, self.step), jumps
            offset, F = fit.offset, fit.fundamental
            scale = torch.maximum(_robust_scale(fit.distances * fit.residual), self.finest(F, offset))
            if same:
                break
        assert known is not None
        assert fit is not None
        return PiecewiseOffset(self.rate, fit.offset, known, fit, scale)

    def _offsets(self, middle: float) -> Tensor:
        """What is compared ``(L,)``: half frames near the middle, as one fit of two pieces lies between both, else whole ones."""
        reach, near = round(self.options.max_jump / self.step), round(HALF_FRAME_RANGE)
        whole = torch.arange(-reach, reach + 1, dtype=torch.float64)
        half = torch.arange(-near, near, dtype=torch.float64) + 0.5
        offsets = middle + self.step * torch.cat([whole, half]).sort().values
        # the clocks were started within ``max_shift``, and what was lost since adds to it
        return offsets if self.max_shift is None else offsets[offsets.abs() <= self.max_shift + self.options.max_jump]

    def _jumps(self, path: NDArray[np.int64], offsets: Tensor, costs: NDArray[np.float64]) -> tuple[Jump, ...]:
        """Where the course changes, with the moments that the costs of both sides allow."""
        path = _without_short(path, costs, round(MIN_PIECE_SECONDS / self.step))
        at = np.flatnonzero(np.diff(path))
        found = []
        for place, (before, after) in enumerate(zip([0, *(at + 1)], [*(at + 1), len(path)], strict=True)):
            if place == len(at):
                break
            end = int(at[place + 1]) + 1 if place + 1 < len(at) else len(path)
            left, right = int(path[before]), int(path[after])
            size = float(offsets[right] - offsets[left])
            lost = round(-size / self.rate / self.step) if size < 0 else 0
            moment, sigma = _moment(costs[before:end, left], costs[before:end, right], lost)
            start = float(self.times[0]) + self.step * int(before)
            found.append(Jump(start + self.step * moment, self.step * max(sigma, 0.5), size))
        return tuple(found)


def _epipolar_lines(x: Tensor, F: Tensor) -> Tensor:
    """Homogeneous lines ``(..., 3)`` of points ``(..., 2)``."""
    return x @ F[:, :2].mT + F[:, 2]


CORRELATED_RESIDUALS = 2.0  # Residuals that count as one, beside those that smoothing correlates.


def _cost(far: Tensor, scale: Tensor, unseen: float = 0.0) -> NDArray[np.float64]:
    """Nats per moment, of residuals ``(T, n)``: quadratic where they fit, bounded where they do not, ``unseen`` where there are
    none."""
    square = (far / scale).square()
    cut = ROBUST_CUTOFF_SIGMAS**2
    alike = 2 * math.sqrt(math.pi)  # frames that a kernel of one frame makes into one
    return (0.5 * square / (1 + square / cut)).nan_to_num(unseen).sum(-1).div(alike * CORRELATED_RESIDUALS).numpy()


def _robust_scale(far: Tensor) -> Tensor:
    """``(n,)`` robust standard deviation of each point's residuals ``(T, n)``."""
    pooled = max(1.4826 * float(far.abs().nanmedian().nan_to_num(0.0)), 1e-300)
    own = (1.4826 * far.abs().nanmedian(0).values / pooled).nan_to_num(1.0)
    return pooled * own.clamp(*SCALE_RANGE)


def _same_jumps(jumps: tuple[Jump, ...], known: tuple[Jump, ...] | None, step: float) -> bool:
    if known is None or len(jumps) != len(known):
        return False
    return all(abs(x.size - y.size) < 0.6 * step and abs(x.moment - y.moment) < 2 * step for x, y in zip(jumps, known, strict=True))


def cheapest_path(costs: NDArray[np.float64], penalty: float) -> NDArray[np.int64]:
    r"""The course of states ``(T,)`` that costs least where every change costs the same."""
    count, states = costs.shape
    total, here = costs[0].copy(), np.arange(states)
    came = np.empty((count, states), dtype=np.int64)
    for moment in range(1, count):
        best = int(total.argmin())
        jumps = total > total[best] + penalty
        came[moment] = np.where(jumps, best, here)
        total = np.where(jumps, total[best] + penalty, total) + costs[moment]
    path = np.empty(count, dtype=np.int64)
    path[-1] = int(total.argmin())
    for moment in range(count - 1, 0, -1):
        path[moment - 1] = came[moment, path[moment]]
    return path


def _without_short(path: NDArray[np.int64], costs: NDArray[np.float64], shortest: int) -> NDArray[np.int64]:
    """Pieces that are too short to say anything join the neighbour that costs less there."""
    path = path.copy()
    while True:
        edges = [0, *(np.flatnonzero(np.diff(path)) + 1).tolist(), len(path)]
        sizes = np.diff(edges)
        if len(sizes) == 1 or int(sizes.min()) >= shortest:
            return path
        k = int(sizes.argmin())
        part = slice(edges[k], edges[k + 1])
        beside = [int(path[at]) for at in (edges[k] - 1, edges[k + 1]) if 0 <= at < len(path)]
        path[part] = min(beside, key=lambda state: float(costs[part, state].sum()))


def _moment(left: NDArray[np.float64], right: NDArray[np.float64], lost: int) -> tuple[float, float]:
    """Steps after the first at which the offset changes, mean and standard deviation, by the costs of both sides."""
    count = len(left)
    before = np.concatenate([[0.0], np.cumsum(left)])
    after = np.concatenate([np.cumsum(right[::-1])[::-1], [0.0]])
    usual = min(float(np.median(left)), float(np.median(right)))
    at = np.arange(1, max(2, count - lost))
    cost = before[at] + after[np.minimum(at + lost, count)] + usual * lost
    weight = np.exp(-(cost - cost.min()))
    weight /= weight.sum()
    mean = float((weight * at).sum())
    return mean - 0.5, math.sqrt(float((weight * (at - mean) ** 2).sum()) + 1 / 12)


# ----------------------------------------------------------------------------------------------------------------------
# What was lost put back: the frames' times, as a camera that keeps time would have told them.


def repair_clocks(a: Tracks, b: Tracks, rate: float, offset: float, jumps: Sequence[Jump]) -> tuple[Tracks, Tracks]:
    """Tracks with times that leave room for what was lost: by b where the offset falls, by a where it grows."""
    ta, tb = a.times.clone(), b.times.clone()
    for jump in jumps:
        there = jump.moment * rate + offset
        if jump.size < 0:
            tb = torch.where(b.times > there, tb - jump.size, tb)
        else:
            ta = torch.where(a.times > jump.moment, ta + jump.size / rate, ta)
        offset += jump.size
    return dataclasses.replace(a, times=ta), dataclasses.replace(b, times=tb)


# ----------------------------------------------------------------------------------------------------------------------
# What speaks for every jump: against one offset, and of each piece by itself.


MIN_JUMP_FRAMES = 0.7  # Smallest jump, frames.
MIN_JUMP_EVIDENCE = 25.0  # Nats by which a jump must explain the residuals better than one offset.
MIN_SECONDS_OF_OWN_SHIFT = 3.0  # Piece from which its own best shift must agree.


class JumpEvidence:
    """The cheapest course of several, without the jumps that a fit without them explains nearly as well."""

    def __init__(self, a: Tracks, b: Tracks, rates: Sequence[float], start: float | None, max_shift: float | None,
                 options: SynchronizeOptions) -> None:  # fmt: skip
        self.a, self.b, self.options, self.max_shift = a, b, options, max_shift
        self.frame = max(a.step, b.step)
        found: list[PiecewiseOffset] = []
        for rate in dict.fromkeys(rates):
            search = PiecewiseOffsetSearch(a, b, rate, max_shift, options)
            plain = None if start is None else self._fit((), start, rate)
            starts = [] if plain is None else [(plain.center, plain.offset, plain.fundamental)]
            courses: list[PiecewiseOffset] = []
            for moment, offset, F in starts + search.starts():
                # a window that a course explains already leads to the same one
                if all(abs(one.at(moment) - offset) > 1.5 * self.frame for one in courses):
                    course = search.estimate(offset, F)
                    courses += [] if course is None else [course]
            found += courses
        self.course = self._select_cheapest(found, rates[0])

    def _select_cheapest(self, courses: list[PiecewiseOffset], given: float) -> PiecewiseOffset | None:
        """The one whose residuals and jumps cost least, on the scale of the one with the least residuals."""
        if not courses:
            return None
        scale = min(courses, key=lambda one: one.fit.residual).scale
        penalty = JUMP_PENALTY
        return min(courses, key=lambda one: self._cost(one.fit, scale) + penalty * (len(one.jumps) + (one.rate != given)))

    def _cost(self, fit: EpipolarFit, scale: Tensor) -> float:
        """Nats of all residuals of a fit, for as many as there could be."""
        cost = _cost(fit.distances * fit.residual, scale)
        seen = float(fit.distances.isfinite().sum())
        return float(cost.sum()) / max(seen, 1.0) * float((self.a.weights > 0).sum())

    def _fit(self, jumps: Sequence[Jump], offset: float, rate: float) -> EpipolarFit | None:
        a, b = repair_clocks(self.a, self.b, rate, offset, jumps)
        return ShiftDescent(a, b, self.frame).run(offset, rate)

    def select_significant(self) -> tuple[PiecewiseOffset, list[float], list[float]] | None:
        """The course with the jumps that are beyond doubt, nats for each of them, and the residual without it, px."""
        course = self.course
        while course is not None:
            scale = course.scale
            own = self._cost(course.fit, scale)
            nats, residuals = [], []
            for k in range(len(course.jumps)):
                worse = self._without(course, k)
                fit = min(worse, key=lambda one: self._cost(one, scale), default=None)
                nats.append(math.inf if fit is None else self._cost(fit, scale) - own)
                residuals.append(math.inf if fit is None else fit.residual)
            least = MIN_JUMP_FRAMES * min(self.a.step, self.b.step)
            sizes = [abs(jump.size) for jump in course.jumps]
            weak = [k for k, one in enumerate(nats) if one < MIN_JUMP_EVIDENCE or sizes[k] < least]
            if not weak:
                return course, nats, residuals
            course = self._drop_jump(course, min(weak, key=nats.__getitem__))
        return None

    def _without(self, course: PiecewiseOffset, k: int) -> list[EpipolarFit]:
        """Fits of one offset on both sides of a jump, from that of either side."""
        rest = (*course.jumps[:k], *course.jumps[k + 1 :])
        size = course.jumps[k].size
        found = [self._fit(rest, course.offset + share * size, course.rate) for share in (0.0, 0.5, 1.0)]
        return [fit for fit in found if fit is not None]

    def _drop_jump(self, course: PiecewiseOffset, k: int) -> PiecewiseOffset | None:
        """The course without a jump; of neighbouring pieces the longer keeps its place."""
        rest = list(course.jumps[:k]) + list(course.jumps[k + 1 :])
        fits = self._without(course, k)
        if not fits:
            return None
        fit = min(fits, key=lambda one: one.residual)
        return PiecewiseOffset(course.rate, fit.offset, tuple(rest), fit, course.scale)

    def sizes(self, course: PiecewiseOffset) -> tuple[list[float], list[float]]:
        """Seconds by which the offset changes at each jump, and their standard deviations, by least squares of all at once."""
        a, b = repair_clocks(self.a, self.b, course.rate, course.offset, course.jumps)
        gained, moments = 0.0, []
        for jump in course.jumps:
            moments.append(jump.moment + gained)
            gained += max(jump.size, 0.0) / course.rate
        descent = ShiftDescent(a, b, self.frame)
        moved, sigmas = descent.jumps(course.fit, moments)
        return [jump.size + more for jump, more in zip(course.jumps, moved.tolist(), strict=True)], sigmas.tolist()

    def is_contradicted(self, course: PiecewiseOffset) -> bool:
        """Whether a piece that is long enough to say so is elsewhere by itself, with a fundamental matrix of its own."""
        a, b = repair_clocks(self.a, self.b, course.rate, course.offset, course.jumps)
        samples = Samples.of(a, b, self.frame, course.rate)
        times = float(a.times[0]) + self.frame * torch.arange(len(samples.x1), dtype=torch.float64)
        edges = [-math.inf, *(jump.moment for jump in course.jumps), math.inf]
        for low, high in itertools.pairwise(edges):
            inside = (times > low) & (times <= high)
            if float(inside.sum()) * self.frame < MIN_SECONDS_OF_OWN_SHIFT:
                continue
            part = dataclasses.replace(samples, w1=torch.where(inside[:, None], samples.w1, 0.0))
            best = epipolar_curve(part, self.max_shift, MIN_HALF_OVERLAP_SHARE).peaks(1)
            if best and abs(best[0][0] * course.rate - course.fit.offset) > MIN_PEAK_SEPARATION_FRAMES * self.frame:
                return True
        return False
