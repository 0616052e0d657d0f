"""Offset, clock rate and fundamental matrix at once: robust least squares of the Sampson distance from a start near by."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from dyntorch.algebra.epipolar import rank_two
from dyntorch.algebra.epipolar_variance import epipolar_variance
from dyntorch.algebra.homogeneous import homogeneous
from dyntorch.least_squares import damped_step
from dyntorch.tasks.sync_grid import Grid
from dyntorch.tasks.sync_tracks import Tracks, noise_ratio, smoothed

CUT = 4.0
"""Robust standard deviations of the residual at which Geman and McClure's weight is a quarter."""
BLOCK = 30
"""Frames that share a scale."""
UNEQUAL = (0.4, 6.0)
"""Least and largest scale of a point or a block, over that of all."""
OPTIMISM = 1.6
"""Errors over the sigma that the residuals alone say: 1.5 to 1.8 on motion capture with 5 to 60 mm of noise."""
ITERATIONS = 30
DONE = 1e-5
"""Frames: the descent ends with a step below it."""
NEARLY = 1e-3
"""Frames: the same before the last rows come in."""
ENOUGH = 4_000
"""Rows for most of the way."""
LEAP = 2.0
"""Frames: the largest step."""
LEAST = 0.003
"""Frames of error that smoothing leaves in exact data."""
FASTEST = 0.03
"""Change of the rate at which a descent has gone astray."""
ROWS = 200_000
"""Residuals that a descent takes at most; from longer takes it takes moments at equal distances.  Beyond, only sigma would
shrink."""
FEWEST = 16
"""Pairs of positions."""
MEMORY = 2.0, 6
"""Residuals are taken to depend on each other over two seconds, but a sixth of the overlap at the most: detectors err for that
long."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A minimum.

    Attributes:
        offset, rate: b's clock = a's clock * rate + offset.
        center: a's time in the middle of the residuals.
        sigma: of the shift there, seconds; robust against what residuals have in common over time.
        rate_sigma: of the rate.
        residual: robust standard deviation of the Sampson distance, px of a.
        fundamental: ``(3, 3)`` of norm 1, of the coordinates given.
        distances: ``(frames, n)`` signed Sampson distances over ``residual``; NaN where not both are seen.
        times: ``(frames,)`` of a's clock.
        effective: how many independent residuals there are.
    """

    offset: float
    rate: float
    center: float
    sigma: float
    rate_sigma: float
    residual: float
    fundamental: Tensor
    distances: Tensor
    times: Tensor
    effective: float

    @property
    def shift(self) -> float:
        """Of b's clock against a's, at the center, seconds."""
        return self.offset + (self.rate - 1) * self.center


class Descent:
    """The problem for two cameras: what does not depend on the start is smoothed once."""

    def __init__(self, a: Tracks, b: Tracks, width: float, rows: int = ROWS) -> None:
        stride = max(1, math.ceil(len(a.times) * a.x.shape[1] / rows))
        step = max(a.step, b.step) * stride
        span = float(a.times[-1] - a.times[0])
        self.times = a.times[0] + step * torch.arange(int(span / step) + 1, dtype=torch.float64, device=a.x.device)
        self.x, _, self.weights = smoothed(a, self.times, width)
        self.grid = Grid.of(b, width)
        self.frame = max(a.step, b.step)
        self.width = width
        self.changes = (a.change, b.change)
        self.noise = (float(a.change[0, 0]), float(b.change[0, 0]) * noise_ratio(a, b))  # one px of a, in normalized coordinates

    def run(self, offset: float, rate: float = 1.0, *, free_rate: bool = False, start: Tensor | None = None) -> Fit | None:
        """Descend from a start; None where too little is seen there, or the rate runs away.

        Args:
            start: F of the normalized coordinates; by default the best for the start.
        """
        state = _State(offset, rate, start)
        stride = max(1, self.weights.numel() // ENOUGH)
        # most of the way on some of the rows, the rest on all
        for every in (stride, 1) if stride > 1 else (1,):
            for _ in range(ITERATIONS):
                rows = self._rows(state, every)
                if rows is None:
                    return None
                moved = self._step(state, rows, free_rate)
                if abs(state.rate / rate - 1) > FASTEST:
                    return None
                if moved < (DONE if every == 1 else NEARLY) * self.frame:
                    break
        rows = self._rows(state)
        return None if rows is None else self._fit(state, rows, free_rate)

    def variance(self, offset: float, rate: float = 1.0) -> float:
        """Of the residual at a state, as on the curve, by the F that is best there; infinite where too little is seen."""
        matched = self._matched(offset, rate)
        return math.inf if matched is None else float(self._moment_fit(matched)[0])

    def _matched(self, offset: float, rate: float, every: int = 1) -> _Matched | None:
        """Normalized positions of both cameras at the same moments, or at some of them; None where too few."""
        x2, v2, w2 = self.grid.at(self.times[::every] * rate + offset)
        sure = self.weights[::every] * w2
        both = sure > 0
        if int(both.sum()) < FEWEST:
            return None
        first, second = self.changes
        p, q = homogeneous(self.x[::every][both]) @ first.mT, homogeneous(x2[both]) @ second.mT
        return _Matched(p, q, torch.nn.functional.pad(v2[both], (0, 1)) @ second.mT, both, sure[both])

    def _moment_fit(self, matched: _Matched) -> tuple[Tensor, Tensor]:
        """Variance and F by the moments alone."""
        products = matched.products
        return epipolar_variance(products.mT @ (matched.sure[:, None] * products), self.noise)

    def _rows(self, state: _State, every: int = 1) -> _Rows | None:
        """Residuals and their derivatives at a state; a first F where there is none."""
        matched = self._matched(state.offset, state.rate, every)
        if matched is None:
            return None
        times = self.times[::every, None].expand_as(matched.both)[matched.both]
        if state.center is None:
            state.center = float(times.mean())
        if state.F is None:
            state.F = rank_two(self._moment_fit(matched)[1])
        Fp, Fq = matched.p @ state.F.mT, matched.q @ state.F
        s1, s2 = self.noise
        gradient = (s1**2 * Fq[:, :2].square().sum(-1) + s2**2 * Fp[:, :2].square().sum(-1)).clamp(min=1e-300).sqrt()
        residual = (matched.q * Fp).sum(-1) / gradient
        along = (matched.speed * Fp).sum(-1) / gradient
        return _Rows(residual, matched.products / gradient[:, None], along, times, matched.both, matched.sure)

    def _step(self, state: _State, rows: _Rows, free_rate: bool) -> float:
        """One step of iteratively reweighted least squares; its length in seconds, at the ends of the overlap."""
        assert state.F is not None
        assert state.center is not None
        tangent = _tangent(state.F)
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
        limit = LEAP * self.frame
        share = min(1.0, limit / max(float(moves.abs().max()), 1e-300))
        state.F = rank_two(state.F - share * (step[:turns] @ tangent).unflatten(0, (3, 3)))
        shift = share * float(moves[0])
        change = share * float(moves[1]) / max(lever, 1e-9) if free_rate else 0.0
        state.rate += change
        state.offset += shift - change * state.center
        return abs(shift) + abs(change) * lever

    def _fit(self, state: _State, rows: _Rows, free_rate: bool) -> Fit:
        """What is found, and how sure: each frame's influence on the estimate, with what neighbouring frames have in common."""
        assert state.F is not None
        assert state.center is not None
        tangent = _tangent(state.F)
        J = torch.cat([rows.products @ tangent.mT, rows.along[:, None], (rows.along * (rows.times - state.center))[:, None]], 1)
        J = J if free_rate else J[:, :-1]
        w = rows.weights()
        scale = J.square().mul(w[:, None]).sum(0).sqrt().clamp(min=1e-300)
        H = (J / scale).mT @ (J / scale * w[:, None])
        inverse = torch.linalg.pinv(H, hermitian=True, rtol=1e-12) / scale[:, None] / scale
        influence = (J * (w * rows.residual)[:, None]) @ inverse[:, len(tangent) :]
        frames = torch.zeros(len(self.times), influence.shape[1], dtype=J.dtype, device=J.device)
        frames.index_add_(0, rows.both.nonzero()[:, 0], influence)
        step = float(self.times[1] - self.times[0]) if len(self.times) > 1 else self.frame
        sigmas = _long_run(frames, round(min(MEMORY[0], float(rows.times[-1] - rows.times[0]) / MEMORY[1]) / step))
        scale_of = rows.scale()
        first, second = self.changes
        F = second.mT @ state.F @ first
        distances = torch.full(rows.both.shape, torch.nan, dtype=J.dtype, device=J.device)
        distances[rows.both] = rows.residual / max(scale_of, 1e-300)
        correlated = 2 * math.sqrt(math.pi) * self.width / step  # frames that the kernel makes into one
        return Fit(
            offset=state.offset,
            rate=state.rate,
            center=state.center,
            sigma=math.hypot(OPTIMISM * float(sigmas[0]), LEAST * self.frame),
            rate_sigma=OPTIMISM * float(sigmas[1]) if free_rate else 0.0,
            residual=scale_of,
            fundamental=F / F.norm(),
            distances=distances,
            times=self.times,
            effective=float(rows.sure.sum() / rows.sure.max()) / max(1.0, correlated),
        )


@dataclass
class _State:
    offset: float
    rate: float
    F: Tensor | None = None
    center: float | None = None


@dataclass(frozen=True, eq=False)
class _Matched:
    p: Tensor  # (m, 3) of a
    q: Tensor  # (m, 3) of b
    speed: Tensor  # (m, 3) derivative of q by b's clock
    both: Tensor  # (frames, n) bool
    sure: Tensor  # (m,) weights

    @cached_property
    def products(self) -> Tensor:
        """``(m, 9)``: by the entries of F."""
        return torch.einsum("ni,nj->nij", self.q, self.p).flatten(1)


@dataclass(frozen=True, eq=False)
class _Rows:
    residual: Tensor  # (m,) px of a
    products: Tensor  # (m, 9): by the entries of F
    along: Tensor  # (m,): by the shift
    times: Tensor  # (m,)
    both: Tensor  # (frames, n) bool
    sure: Tensor  # (m,): weights of the positions

    def scale(self) -> float:
        return 1.4826 * float(self.residual.abs().median())

    def weights(self) -> Tensor:
        """Of Geman and McClure, by the scale of each point and of each second or so: who is nearer errs by more pixels."""
        pooled = max(self.scale(), 1e-300)
        every = torch.full(self.both.shape, torch.nan, dtype=torch.float64, device=self.residual.device)
        every[self.both] = self.residual.abs() * (1.4826 / pooled)
        point = every.nanmedian(0).values.nan_to_num(1.0).clamp(*UNEQUAL)
        pad = -len(every) % BLOCK
        blocks = torch.nn.functional.pad(every / point, (0, 0, 0, pad), value=torch.nan).unflatten(0, (-1, BLOCK)).flatten(1)
        moment = blocks.nanmedian(1).values.nan_to_num(1.0).clamp(*UNEQUAL).repeat_interleave(BLOCK)[: len(every)]
        own = (moment[:, None] * point)[self.both]
        return self.sure * (1 + (self.residual / (CUT * pooled * own)).square()).pow(-2) / own.square()


def _tangent(F: Tensor) -> Tensor:
    """``(7, 9)`` orthonormal directions that keep the norm and, to first order, the rank of F."""
    cofactors = torch.linalg.cross(F[[1, 2, 0]], F[[2, 0, 1]], dim=-1)
    normals = torch.stack([F.flatten(), cofactors.flatten() / cofactors.norm().clamp(min=1e-300)])
    return torch.linalg.qr(normals.mT, mode="complete")[0][:, 2:].mT


def _long_run(influence: Tensor, memory: int) -> Tensor:
    """Standard deviations of sums ``(frames, k)`` of what neighbouring frames have in common (Newey and West)."""
    variance = influence.square().sum(0)
    for lag in range(1, min(memory, len(influence) - 1) + 1):
        variance = variance + 2 * (1 - lag / (memory + 1)) * (influence[lag:] * influence[:-lag]).sum(0)
    return variance.clamp(min=0).sqrt()
