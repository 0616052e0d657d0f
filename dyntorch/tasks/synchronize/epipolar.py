"""How well the same points fit together at every shift: the variance of the epipolar residual over lags."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import torch
from torch import Tensor

from dyntorch.geometry.epipolar import epipolar_variance, gradient_moments, rank_two
from dyntorch.geometry.homogeneous import homogeneous
from dyntorch.numerics.lags import epipolar_moments
from dyntorch.numerics.least_squares import damped_step
from dyntorch.tasks.synchronize.tracks import Tracks, lag_range, noise_ratio, smooth_at

MIN_PEAK_SEPARATION_FRAMES = 2.5  # Within this peaks are one, and halves of a take agree.
MIN_HALF_OVERLAP_SHARE = 0.5  # Share of the largest overlap below which a half of the take does not score a lag.


PIECE = 4096
"""Lags at a time: bounds the memory on long takes."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Smoothed, normalized points of both cameras at equal steps of a's clock."""

    x1: Tensor  # ``(m1, n, 2)`` and ``(m2, n, 2)``, 0 where missing
    x2: Tensor
    w1: Tensor  # weights
    w2: Tensor
    step: float  # seconds
    start: float  # lag of the first of b against the first of a, seconds
    rate: float  # of b's clock that was taken out
    noise: tuple[float, float]  # of both cameras in normalized coordinates, in px of a

    @classmethod
    def of(cls, a: Tracks, b: Tracks, step: float, rate: float = 1.0) -> Self:
        """b's clock goes ``rate`` seconds in one of a's.  The kernel is as wide as a step."""
        first, w1 = _sample(a, step, step)
        second, w2 = _sample(b, step * rate, step * rate)
        noise = float(a.change[0, 0]), float(b.change[0, 0]) * noise_ratio(a, b)
        start = float(b.times[0]) / rate - float(a.times[0])
        return cls(first, second, w1, w2, step, start, rate, noise)

    def lags(self, max_shift: float | None) -> tuple[int, int]:
        """First and last lag, in steps, with some overlap and shifts within ``max_shift`` seconds."""
        return lag_range((len(self.x1), len(self.x2)), self.start, self.step, self.rate, max_shift)

    def only(self, points: Tensor) -> Samples:
        """These points ``(n,)`` bool alone."""
        x1, x2, w1, w2 = (part[:, points] for part in (self.x1, self.x2, self.w1, self.w2))
        return dataclasses.replace(self, x1=x1, x2=x2, w1=w1, w2=w2)

    def moments(self, lags: tuple[int, int], per_point: bool = False) -> tuple[Tensor, Tensor]:
        """Moments ``([n,] L, ...)`` of the residual at lags, and counts ``([n,] L)`` of pairs of positions."""
        return epipolar_moments(self.x1, self.x2, lags, (self.w1, self.w2), per_point)

    def solve(self, moments: Tensor) -> tuple[Tensor, Tensor]:
        """Variances ``(L,)`` of the residual, px^2 of a, and the geometry ``(L, ...)`` that has it."""
        return epipolar_variance(moments, self.noise)

    def variances_by(self, geometry: Tensor, moments: Tensor) -> Tensor:
        """``(n,)`` each point's residual variance by one geometry; NaN where it is never seen."""
        f = geometry.flatten()
        below = torch.einsum("i,nij,j->n", f, gradient_moments(moments, self.noise), f)
        return torch.where(below > 0, torch.einsum("i,nij,j->n", f, moments, f) / torch.where(below > 0, below, 1.0), torch.nan)


@dataclass(frozen=True, eq=False)
class Curve:
    """Scores over lags."""

    lags: Tensor  # ``(L,)`` seconds of a's clock: a moment t of a is at rate (t + lag) of b
    scores: Tensor  # ``(L,)`` nats, higher is better, NaN where not judged
    variance: Tensor  # ``(L,)`` of the residual, px^2 of a
    counts: Tensor  # ``(L,)`` pairs of positions
    rate: float  # of b's clock
    level: float  # the median of the variance where judged

    @property
    def offsets(self) -> Tensor:
        """``(L,)`` seconds of b's clock at time 0 of a's."""
        return self.lags * self.rate

    def misfit(self, lag: float) -> float:
        """Nats by which the residual is smaller than usual where it is least near a lag, whatever the overlap."""
        place = int((self.lags - lag).abs().argmin())
        near = self.variance[max(0, place - 1) : place + 2]
        least = float(near[near.isfinite()].min()) if bool(near.isfinite().any()) else math.inf
        return -0.5 * math.log(max(least, 1e-300) / max(self.level, 1e-300)) if least < math.inf else -math.inf

    def peaks(self, count: int) -> list[tuple[float, float]]:
        """Lag (between steps by the parabola through the variance) and score of local maxima, best first."""
        scores = self.scores.nan_to_num(-math.inf)
        padded = torch.nn.functional.pad(scores, (1, 1), value=-math.inf)
        top = ((scores > padded[:-2]) & (scores >= padded[2:])).nonzero()[:, 0]
        best = top[scores[top].argsort(descending=True)][:count].tolist()
        return [(self._between(i), float(scores[i])) for i in best]

    def _between(self, i: int) -> float:
        lag = float(self.lags[i])
        if not 0 < i < len(self.lags) - 1:
            return lag
        before, here, after = self.variance[i - 1 : i + 2].tolist()
        bend = before - 2 * here + after
        step = float(self.lags[1] - self.lags[0])
        if not (math.isfinite(bend) and bend > 0):
            return lag
        return lag + step * max(-0.5, min(0.5, 0.5 * (before - after) / bend))


MIN_OVERLAP_SHARE = 0.25  # Share of the largest overlap below which a lag is not scored.
MIN_CURVE_PAIRS = 24  # Pairs of positions below which a lag is not scored: three times the unknowns of F.


def epipolar_curve(samples: Samples, max_shift: float | None = None, overlap: float | None = None) -> Curve:
    r"""Scores at all lags."""
    overlap = MIN_OVERLAP_SHARE if overlap is None else overlap
    lo, hi = samples.lags(max_shift)
    chunks = [_score_chunk(samples, first, min(first + PIECE - 1, hi)) for first in range(lo, hi + 1, PIECE)]
    if not chunks:
        empty = samples.x1.new_zeros(0)
        return Curve(empty, empty, empty, empty, samples.rate, 1.0)
    variance, counts = (torch.cat(parts) for parts in zip(*chunks, strict=True))
    judged = (counts >= overlap * counts.max()) & (counts >= MIN_CURVE_PAIRS) & variance.isfinite()
    level = variance[judged].median() if bool(judged.any()) else variance.new_ones(())
    tiny = torch.finfo(variance.dtype).tiny
    scores = -0.5 * (variance / level.clamp(min=tiny)).clamp(min=tiny).log() + 0.5 * (counts / counts.max()).clamp(min=tiny).log()
    lags = samples.start + samples.step * torch.arange(lo, hi + 1, dtype=torch.float64, device=variance.device)
    return Curve(lags, torch.where(judged, scores, torch.nan), variance, counts, samples.rate, float(level))


def _score_chunk(samples: Samples, lo: int, hi: int) -> tuple[Tensor, Tensor]:
    moments, counts = samples.moments((lo, hi))
    return samples.solve(moments)[0], counts


def _sample(tracks: Tracks, step: float, width: float) -> tuple[Tensor, Tensor]:
    x, _, weights = smooth_at(tracks, tracks.every(step), width)
    linear, moved = tracks.change[:-1, :-1], tracks.change[:-1, -1]
    return torch.where((weights > 0)[..., None], x @ linear.mT + moved, 0.0), weights


# ----------------------------------------------------------------------------------------------------------------------
# Smoothed tracks at equal steps, for positions and velocities at any moment between.


# Extra width of the velocity kernel per noise-to-motion ratio: noise shared with the residuals would bias the shift.
VELOCITY_WIDTH_SLOPE = 0.75
MIN_VELOCITY_WIDTH = 1.25  # Smallest width of that kernel over the one of positions.
MAX_VELOCITY_WIDTH = 2.5  # Largest width.


@dataclass(frozen=True, eq=False)
class Grid:
    """Smoothed tracks of b at equal steps, for positions and velocities anywhere between by cubic Hermite polynomials."""

    start: float
    step: float
    x: Tensor  # (m, n, d)
    v: Tensor
    smooth_velocities: Tensor  # velocities to differentiate by
    weights: Tensor  # (m, n)

    @staticmethod
    def of(tracks: Tracks, width: float) -> Grid:
        """With steps of half the kernel's width: between them the polynomial is exact to thousandths of the noise."""
        step, start = width / 2, float(tracks.times[0])
        count = max(2, math.ceil((float(tracks.times[-1]) - start) / step) + 1)
        at = start + step * torch.arange(count, dtype=torch.float64, device=tracks.x.device)
        x, v, weights = smooth_at(tracks, at, width)
        speed = float(torch.where(weights > 0, v.square().sum(-1), torch.nan).nanmedian()) ** 0.5
        wider = min(
            max(1 + VELOCITY_WIDTH_SLOPE * tracks.noise / max(speed * width, 1e-300), MIN_VELOCITY_WIDTH), MAX_VELOCITY_WIDTH
        )
        _, calm, _ = smooth_at(tracks, at, wider * width)
        return Grid(start, step, x, v, calm, weights)

    def at(self, times: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Positions, velocities ``(m, n, 2)`` and weights ``(m, n)``, 0 where not seen."""
        place = (times - self.start) / self.step
        left = place.floor().clamp(0, len(self.x) - 2)
        u = (place - left)[:, None, None]
        inside = (place >= 0) & (place <= len(self.x) - 1)
        parts = self.polynomials.index_select(0, left.long())
        x, v, weights = parts.split([4 * self.x.shape[-1], 2 * self.x.shape[-1], 2], dim=-1)
        (x0, x1, x2, x3), (v0, v1), (w0, w1) = x.chunk(4, -1), v.chunk(2, -1), weights.unbind(-1)
        return x0 + u * (x1 + u * (x2 + u * x3)), v0 + u * v1, torch.where(inside[:, None], w0 + u[..., 0] * w1, 0.0)

    @cached_property
    def polynomials(self) -> Tensor:
        """``(m - 1, n, 6 d + 2)``: coefficients between two steps, of positions, velocities and weights."""
        x0, v0, v1 = self.x[:-1], self.step * self.v[:-1], self.step * self.v[1:]
        d, s = self.x[1:] - x0, v0 + v1
        w0, w1 = self.weights[:-1], self.weights[1:]
        weight = torch.stack([w0, w1 - w0], dim=-1) * ((w0 > 0) & (w1 > 0))[..., None]
        smooth = self.smooth_velocities
        return torch.cat([x0, v0, 3 * d - s - v0, s - 2 * d, smooth[:-1], smooth.diff(dim=0), weight], dim=-1)


# ----------------------------------------------------------------------------------------------------------------------
# Offset, clock rate and fundamental matrix at once: robust least squares of the Sampson distance from a start near by.


@dataclass(frozen=True, eq=False)
class EpipolarFit:
    """A minimum."""

    offset: float  # b's clock = a's clock * rate + offset
    rate: float
    center: float  # a's time in the middle of the residuals
    sigma: float  # of the shift there, seconds; robust against what residuals have in common over time
    rate_sigma: float  # of the rate
    residual: float  # robust standard deviation of the Sampson distance, px of a
    fundamental: Tensor  # ``(3, 3)`` of norm 1, of the coordinates given; of a camera and points in space the camera ``(3, 4)``
    distances: Tensor  # ``(frames, n)`` signed Sampson distances over ``residual``; NaN where not both are seen
    times: Tensor  # ``(frames,)`` of a's clock
    effective: float  # how many independent residuals there are

    @property
    def shift(self) -> float:
        """Of b's clock against a's, at the center, seconds."""
        return self.offset + (self.rate - 1) * self.center


SIGMA_INFLATION = 1.6  # True errors over the sigma of the residuals: 1.5 to 1.8 on motion capture with 5 to 60 mm of noise.
MAX_ITERATIONS = 30  # Steps, on some of the rows and on all.
STEP_TOLERANCE_FRAMES = 1e-5  # Step that ends the descent, frames.
COARSE_STEP_TOLERANCE_FRAMES = 1e-3  # The same on some of the rows.
NUM_COARSE_ROWS = 4_000  # Rows for most of the way.
MAX_STEP_FRAMES = 2.0  # Largest step, frames.
MIN_SIGMA_FRAMES = 0.003  # Error that smoothing leaves in exact data, frames.
MAX_RATE_CHANGE = 0.03  # Change of the clock rate at which a descent has diverged.
MAX_ROWS = 200_000  # Residuals of one descent; of longer takes at moments at equal distances.
MIN_DESCENT_PAIRS = 16  # Pairs of positions below which there is no descent.
MAX_CORRELATION_SECONDS = 2.0  # Time over which residuals depend on each other: errors of detectors last for so long.
MIN_CORRELATION_BLOCKS = 6  # and at most the overlap over this number.


class ShiftDescent:
    """The problem for two cameras: what does not depend on the start is smoothed once."""

    def __init__(self, a: Tracks, b: Tracks, width: float, rows: int | None = None) -> None:
        stride = max(1, math.ceil(len(a.times) * a.x.shape[1] / (MAX_ROWS if rows is None else rows)))
        step = max(a.step, b.step) * stride
        span = float(a.times[-1] - a.times[0])
        self.times = a.times[0] + step * torch.arange(int(span / step) + 1, dtype=torch.float64, device=a.x.device)
        self.x, _, self.weights = smooth_at(a, self.times, width)
        self.grid = Grid.of(b, width)
        self.frame = max(a.step, b.step)
        self.width = width
        self.changes = (a.change, b.change)
        self.noise = (float(a.change[0, 0]), float(b.change[0, 0]) * noise_ratio(a, b))  # one px of a, in normalized coordinates

    def run(self, offset: float, rate: float = 1.0, *, free_rate: bool = False, start: Tensor | None = None) -> EpipolarFit | None:
        """Descend from a start; None where too little is seen there, or the rate runs away."""
        state = _State(offset, rate, start)
        stride = max(1, self.weights.numel() // NUM_COARSE_ROWS)
        # most of the way on some of the rows, the rest on all
        for every in (stride, 1) if stride > 1 else (1,):
            for _ in range(MAX_ITERATIONS):
                rows = self._rows(state, every)
                if rows is None:
                    return None
                moved = self._step(state, rows, free_rate)
                if abs(state.rate / rate - 1) > MAX_RATE_CHANGE:
                    return None
                if moved < (STEP_TOLERANCE_FRAMES if every == 1 else COARSE_STEP_TOLERANCE_FRAMES) * self.frame:
                    break
        rows = self._rows(state)
        return None if rows is None else self._fit(state, rows, free_rate)

    def variances(self, offsets: Sequence[float], rate: float = 1.0) -> list[float]:
        """Of the residual at states, as on the curve, by the F that is best there; infinite where too little is seen."""
        matched = [self._match(offset, rate) for offset in offsets]
        moments = [self._moments(one) for one in matched if one is not None]
        solved = iter(self._solve(torch.stack(moments))[0].tolist() if moments else ())
        return [math.inf if one is None else next(solved) for one in matched]

    def _match(self, offset: float, rate: float, every: int = 1) -> Matched | None:
        """Normalized positions of both cameras at the same moments, or at some of them; None where too few."""
        x2, v2, w2 = self.grid.at(self.times[::every] * rate + offset)
        sure = self.weights[::every] * w2
        both = sure > 0
        if int(both.sum()) < MIN_DESCENT_PAIRS:
            return None
        first, second = self.changes
        p, q = homogeneous(self.x[::every][both]) @ first.mT, homogeneous(x2[both]) @ second.mT
        return Matched(p, q, torch.nn.functional.pad(v2[both], (0, 1)) @ second.mT, both, sure[both])

    def _moments(self, matched: Matched) -> Tensor:
        """What variance and F follow from, ``(9, 9)``."""
        products = matched.products
        return products.mT @ (matched.sure[:, None] * products)

    def _solve(self, moments: Tensor) -> tuple[Tensor, Tensor]:
        """Variance and F by the moments alone, of several states."""
        return epipolar_variance(moments, self.noise)

    @staticmethod
    def _nearest(matrix: Tensor) -> Tensor:
        """The nearest F of norm 1."""
        return rank_two(matrix)

    @staticmethod
    def _tangent(matrix: Tensor) -> Tensor:
        """``(7, 9)`` orthonormal directions in which F may change."""
        return _tangent(matrix)

    def _rows(self, state: _State, every: int = 1) -> Residuals | None:
        """Residuals and their derivatives at a state; a first F where there is none."""
        matched = self._match(state.offset, state.rate, every)
        if matched is None:
            return None
        times = self.times[::every, None].expand_as(matched.both)[matched.both]
        if state.center is None:
            state.center = float(times.mean())
        if state.F is None:
            state.F = self._nearest(self._solve(self._moments(matched)[None])[1][0])
        return self._residuals(state.F, matched, times)

    def _residuals(self, F: Tensor, matched: Matched, times: Tensor) -> Residuals:
        """Residuals, and their derivatives by the entries of F and by the shift."""
        Fp, Fq = matched.p @ F.mT, matched.q @ F
        s1, s2 = self.noise
        gradient = (s1**2 * Fq[:, :2].square().sum(-1) + s2**2 * Fp[:, :2].square().sum(-1)).clamp(min=1e-300).sqrt()
        residual = (matched.q * Fp).sum(-1) / gradient
        along = (matched.speed * Fp).sum(-1) / gradient
        return Residuals(residual, matched.products / gradient[:, None], along, times, matched.both, matched.sure)

    def _step(self, state: _State, rows: Residuals, free_rate: bool) -> float:
        """One step of iteratively reweighted least squares; its length in seconds, at the ends of the overlap."""
        assert state.F is not None
        assert state.center is not None
        tangent = self._tangent(state.F)
        columns = [rows.products @ tangent.mT, rows.along[:, None]]
        lever = float((rows.times - state.center).abs().max())
        if free_rate:
            columns.append((rows.along * (rows.times - state.center) / max(lever, 1e-9))[:, None])
        J = torch.cat(columns, dim=1)
        w = rows.weights()
        damping = torch.full((1,), 1e-6, dtype=J.dtype, device=J.device)
        step = damped_step((J.mT @ (w * rows.residual))[None], (J.mT @ (J * w[:, None]))[None], damping)[0]
        turns = len(tangent)
        moves = -step[turns:]
        limit = MAX_STEP_FRAMES * self.frame
        share = min(1.0, limit / max(float(moves.abs().max()), 1e-300))
        state.F = self._nearest(state.F - share * (step[:turns] @ tangent).unflatten(0, state.F.shape))
        shift = share * float(moves[0])
        change = share * float(moves[1]) / max(lever, 1e-9) if free_rate else 0.0
        state.rate += change
        state.offset += shift - change * state.center
        return abs(shift) + abs(change) * lever

    def _fit(self, state: _State, rows: Residuals, free_rate: bool) -> EpipolarFit:
        """What is found, and how sure: each frame's influence on the estimate, with what neighbouring frames have in common."""
        assert state.F is not None
        assert state.center is not None
        tangent = self._tangent(state.F)
        J = torch.cat([rows.products @ tangent.mT, rows.along[:, None], (rows.along * (rows.times - state.center))[:, None]], 1)
        J = J if free_rate else J[:, :-1]
        frames = self._influence(rows, J, J.shape[1] - len(tangent))[1]
        step = float(self.times[1] - self.times[0]) if len(self.times) > 1 else self.frame
        sigmas = long_run_sigma(
            frames, round(min(MAX_CORRELATION_SECONDS, float(rows.times[-1] - rows.times[0]) / MIN_CORRELATION_BLOCKS) / step)
        )
        scale_of = rows.scale()
        F = self._denormalize(state.F)
        distances = torch.full(rows.both.shape, torch.nan, dtype=J.dtype, device=J.device)
        distances[rows.both] = rows.distances / max(scale_of, 1e-300)
        correlated = 2 * math.sqrt(math.pi) * self.width / step  # frames that the kernel makes into one
        return EpipolarFit(
            offset=state.offset,
            rate=state.rate,
            center=state.center,
            sigma=math.hypot(SIGMA_INFLATION * float(sigmas[0]), MIN_SIGMA_FRAMES * self.frame),
            rate_sigma=SIGMA_INFLATION * float(sigmas[1]) if free_rate else 0.0,
            residual=scale_of,
            fundamental=F / F.norm(),
            distances=distances,
            times=self.times,
            effective=float(rows.sure.sum() / rows.sure.max()) / max(1.0, correlated),
        )

    def _influence(self, rows: Residuals, J: Tensor, last: int) -> tuple[Tensor, Tensor]:
        """What every residual ``(m, last)`` and every frame ``(frames, last)`` adds to the last parameters, of derivatives J."""
        w = rows.weights()
        scale = J.square().mul(w[:, None]).sum(0).sqrt().clamp(min=1e-300)
        H = (J / scale).mT @ (J / scale * w[:, None])
        inverse = torch.linalg.pinv(H, hermitian=True, rtol=1e-12) / scale[:, None] / scale
        influence = (J * (w * rows.residual)[:, None]) @ inverse[:, -last:]
        return influence, J.new_zeros(len(self.times), last).index_add_(0, rows.frames, influence)

    def jumps(self, fit: EpipolarFit, moments: Sequence[float]) -> tuple[Tensor, Tensor]:
        """What the offset changes by, beyond the fit, after each of some moments of a's clock: seconds ``(k,)``, and their
        standard deviations."""
        first, second = self.changes
        F = torch.linalg.inv(second).mT @ fit.fundamental @ torch.linalg.inv(first)
        state = _State(fit.offset, fit.rate, F / F.norm(), fit.center)
        rows = self._rows(state)
        assert rows is not None
        tangent = self._tangent(F / F.norm())
        later = [rows.along * (rows.times > moment) for moment in moments]
        J = torch.cat([rows.products @ tangent.mT, torch.stack([rows.along, *later], dim=1)], dim=1)
        influence, frames = self._influence(rows, J, len(later))
        memory = min(MAX_CORRELATION_SECONDS, float(rows.times[-1] - rows.times[0]) / MIN_CORRELATION_BLOCKS)
        sigmas = SIGMA_INFLATION * long_run_sigma(frames, round(memory / self.frame))
        return -influence.sum(0), sigmas.hypot(torch.as_tensor(MIN_SIGMA_FRAMES * self.frame))

    def _denormalize(self, F: Tensor) -> Tensor:
        """The same F, of the coordinates given."""
        first, second = self.changes
        return second.mT @ F @ first


@dataclass
class _State:
    offset: float
    rate: float
    F: Tensor | None = None
    center: float | None = None


@dataclass(frozen=True, eq=False)
class Matched:
    """Normalized positions of both at the same moments."""

    p: Tensor  # (m, 3) of a
    q: Tensor  # (m, 3) of b
    speed: Tensor  # (m, 3) derivative of q by b's clock
    both: Tensor  # (frames, n) bool
    sure: Tensor  # (m,) weights

    @cached_property
    def products(self) -> Tensor:
        """``(m, 9)``: by the entries of F."""
        return torch.einsum("ni,nj->nij", self.q, self.p).flatten(1)


ROBUST_CUTOFF_SIGMAS = 4.0  # Residual at which Geman and McClure's weight is a quarter, robust sigmas.
SCALE_BLOCK_FRAMES = 30  # Frames that share one residual scale.
SCALE_RANGE = (0.4, 6.0)  # Least and largest scale of a point or a block, over the pooled one.


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals at a state, with their derivatives."""

    residual: Tensor  # (m,) px of a
    products: Tensor  # (m, 9): by the entries of F
    along: Tensor  # (m,): by the shift
    times: Tensor  # (m,)
    both: Tensor  # (frames, n) bool
    sure: Tensor  # (m,): weights of the positions

    @property
    def distances(self) -> Tensor:
        """``(m,)`` of every pair of positions."""
        return self.residual

    @property
    def frames(self) -> Tensor:
        """Frame of every residual."""
        return self.both.nonzero()[:, 0]

    def scale(self) -> float:
        return 1.4826 * float(self.distances.abs().median())

    def weights(self) -> Tensor:
        """Of Geman and McClure, by the scale of each point and of each second or so: who is nearer errs by more pixels."""
        pooled = max(self.scale(), 1e-300)
        every = torch.full(self.both.shape, torch.nan, dtype=torch.float64, device=self.residual.device)
        distances = self.distances
        every[self.both] = distances.abs() * (1.4826 / pooled)
        point = every.nanmedian(0).values.nan_to_num(1.0).clamp(*SCALE_RANGE)
        pad = -len(every) % SCALE_BLOCK_FRAMES
        blocks = (
            torch.nn.functional.pad(every / point, (0, 0, 0, pad), value=torch.nan)
            .unflatten(0, (-1, SCALE_BLOCK_FRAMES))
            .flatten(1)
        )
        moment = blocks.nanmedian(1).values.nan_to_num(1.0).clamp(*SCALE_RANGE).repeat_interleave(SCALE_BLOCK_FRAMES)[: len(every)]
        own = (moment[:, None] * point)[self.both]
        return self.sure * (1 + (distances / (ROBUST_CUTOFF_SIGMAS * pooled * own)).square()).pow(-2) / own.square()


def _tangent(F: Tensor) -> Tensor:
    """``(7, 9)`` orthonormal directions that keep the norm and, to first order, the rank of F."""
    cofactors = torch.linalg.cross(F[[1, 2, 0]], F[[2, 0, 1]], dim=-1)
    normals = torch.stack([F.flatten(), cofactors.flatten() / cofactors.norm().clamp(min=1e-300)])
    return torch.linalg.qr(normals.mT, mode="complete")[0][:, 2:].mT


@dataclass(frozen=True)
class PairModel:
    """What is compared: the classes that score all shifts, and that descend from one."""

    method: str  # its name in results
    samples: type[Samples]
    descent: type[ShiftDescent]


EPIPOLAR = PairModel("epipolar", Samples, ShiftDescent)
"""Two cameras that see the same points."""


def long_run_sigma(influence: Tensor, memory: int) -> Tensor:
    """Standard deviations of sums ``(frames, k)`` of what neighbouring frames have in common (Newey and West)."""
    variance = influence.square().sum(0)
    for lag in range(1, min(memory, len(influence) - 1) + 1):
        variance = variance + 2 * (1 - lag / (memory + 1)) * (influence[lag:] * influence[:-lag]).sum(0)
    return variance.clamp(min=0).sqrt()
