"""Two cameras that track different points of one motion: how much either tells about the other, over all time lags."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.lags import lag_covariances
from dyntorch.tasks.sync_subspace_body import STEP, Body, body_of

OVERLAP = 0.35
"""Share of the shorter take below which a lag is not judged."""
FEWEST = 0.8
"""Seconds of overlap below which a lag is not judged."""
SHAPE, HEIGHT, MOTION = 2.4, 2.25, 5.7
"""Independent samples per second of the shape, of its vertical part and of the motion: neighbouring frames repeat each other.
Fitted as weights to the posterior of the true lag (30 frames per second, half of the motion capture takes, 15 mm)."""
LOADING = 0.02
"""Share of its own variance that a velocity is blurred by: no two medians of different points are the same."""
BACKWARDS = 40
"""Lags at which chance is measured."""
PIECE = 2048
"""Lags at a time: bounds the memory on long takes."""


@dataclass(frozen=True, eq=False)
class SubspaceCurve:
    """Evidence over lags; frame i of a goes with frame i + lag of b.

    Attributes:
        lags: ``(L,)`` frames.
        scores: ``(L,)`` nats, higher is better, NaN where the overlap is too short: logarithm of the posterior but for a constant.
        counts: ``(L,)`` frames that overlap, but for the ends of each take.
        shape: ``(L,)`` nats per frame that the shapes tell about each other, beyond chance.
        height: ``(L,)`` the same of vertical coordinates alone.
        motion: ``(L,)`` nats per frame that the motions of the whole tell.
        signal: of either camera, directions in which the shape moves by more than noise.
    """

    lags: Tensor
    scores: Tensor
    counts: Tensor
    shape: Tensor
    height: Tensor
    motion: Tensor
    signal: tuple[float, float]
    bodies: tuple[Body, Body] | None = None

    @property
    def rates(self) -> Tensor:
        """``(L,)`` nats per frame: what does not grow with the overlap."""
        return self.scores / self.counts.clamp(min=1.0)


def subspace_curve(a: Tensor, b: Tensor, wa: Tensor, wb: Tensor, lags: tuple[int, int], *, step: float = STEP) -> SubspaceCurve:
    r"""Evidence for every lag between the tracks of two static cameras that need not have a point in common.

    .. math:: S(s) = m(s)\, [\, 2.4\, (J - J_0) + 2.25\, (J_y - J_{y0}) + 5.7\, J_v\, ],\qquad
              J = \tfrac12 \log \frac{|C_{aa} + I|\, |C_{bb} + I|}{|C + I|}

    J is the mutual information of Gaussian rows, coordinates of all points about the body's middle over its size in units of noise:
    a scale-free count of the directions that row spaces share (Wolf and Zomet ask for the least rank of :math:`[A; B]`).
    :math:`J_y` is that of the image's y alone, which upright cameras share most: half the rows, a quarter of the ways to agree by
    chance.  What b played backwards tells, a line in 1/m, is subtracted from both.  :math:`J_v` is the information of the median
    velocities, and m the seconds that overlap.

    Args:
        a: ``(Ta, n, 2)`` px, frames ``step`` apart.
        b: ``(Tb, m, 2)``, the same step.
        wa: ``(Ta, n)``, 0 = missing.
        wb: ``(Tb, m)``.
        lags: first and last, frames.
        step: seconds from frame to frame.

    Returns:
        The curve.

    Raises:
        ValueError: lags in the wrong order.

    Source: thesis, chapter 7; Wolf and Zomet 2006, Wide baseline matching between unsynchronized video sequences.

    Example:
        >>> import torch
        >>> generator = torch.Generator().manual_seed(0)
        >>> time = torch.arange(100, dtype=torch.float64)[:, None]
        >>> pace = 0.05 + 0.15 * torch.rand(4, generator=generator, dtype=torch.float64)
        >>> waves = torch.cat([(pace * time).sin(), (pace * time + 0.004 * time**2).cos()], dim=1)
        >>> mix = lambda n: 50 * torch.randn(8, n, 2, generator=generator, dtype=torch.float64)
        >>> a, b = (torch.einsum("tk,knd->tnd", part, mix(6)) for part in (waves[:90], waves[7:]))
        >>> curve = subspace_curve(a, b, torch.ones(90, 6), torch.ones(93, 6), (-40, 40))
        >>> int(curve.lags[curve.scores.nan_to_num(-torch.inf).argmax()])
        -7
    """
    return bodies_curve(body_of(a, wa, step), body_of(b, wb, step), lags, step)


def bodies_curve(first: Body, second: Body, lags: tuple[int, int], step: float = STEP) -> SubspaceCurve:
    """The same of what is prepared."""
    shape, height, motion, counts = _curves(first, second, lags)
    judged = counts >= max(OVERLAP * min(float(first.weights.sum()), float(second.weights.sum())), FEWEST / step - 1e-9)
    if bool(judged.any()):
        chance = _chance(first, second.reversed, counts, judged, lags)
        shape, height = shape - chance[:, 0], height - chance[:, 1]
    scores = counts * step * (SHAPE * shape + HEIGHT * height + MOTION * motion)
    span = torch.arange(lags[0], lags[1] + 1, dtype=torch.float64, device=counts.device)
    return SubspaceCurve(
        span, torch.where(judged, scores, torch.nan), counts, shape, height, motion, (first.signal, second.signal), (first, second)
    )


def _curves(a: Body, b: Body, lags: tuple[int, int]) -> list[Tensor]:
    """Information of shapes, of heights and of motions, and counts, at all lags."""
    weights = None if bool((a.weights > 0).all() and (b.weights > 0).all()) else (a.weights, b.weights)
    found = []
    for lo in range(lags[0], lags[1] + 1, PIECE):
        span = lo, min(lo + PIECE - 1, lags[1])
        aa, bb, ab, counts = lag_covariances(a.rows, b.rows, span, weights)
        *motion, _ = lag_covariances(a.motion, b.motion, span, weights)
        found.append((_shared(aa, bb, ab), _shared(*_vertical(aa, bb, ab)), _correlated(*motion), counts))
    return [torch.cat(parts) for parts in zip(*found, strict=True)]


def _chance(a: Body, b: Body, counts: Tensor, judged: Tensor, lags: tuple[int, int]) -> Tensor:
    """What shapes and heights ``(L, 2)`` of different events tell about each other: a line in 1 / count, through some lags."""
    at = judged.nonzero()[:, 0]
    at = at[torch.linspace(0, len(at) - 1, min(BACKWARDS, len(at))).round().long().to(at.device)]
    told, inverse, n = [], [], a.rows.shape[1]
    for lag in (at + lags[0]).tolist():
        start, end = max(0, -lag), min(len(a.rows), len(b.rows) - lag)
        seen = a.weights[start:end] * b.weights[start + lag : end + lag] > 0
        both = torch.cat([a.rows[start:end], b.rows[start + lag : end + lag]], dim=1)[seen]
        both = both - both.mean(0)
        share = 1 / max(len(both), 1)
        c = (share * both.mT @ both)[None]
        parts = c[:, :n, :n], c[:, n:, n:], c[:, :n, n:]
        told.append(torch.cat([_shared(*parts), _shared(*_vertical(*parts))]))
        inverse.append([1.0, share])
    line = torch.linalg.lstsq(torch.tensor(inverse, dtype=torch.float64, device=counts.device), torch.stack(told)).solution
    return line[0] + line[1] / counts.clamp(min=1.0)[:, None]


def information(shape: Tensor, n: int, motion: Tensor) -> Tensor:
    """Evidence per second ``(L,)`` of joint covariances: of shapes, whose first n rows are a's, and of motions; chance is in it."""
    parts = shape[:, :n, :n], shape[:, n:, n:], shape[:, :n, n:]
    told = SHAPE * _shared(*parts) + HEIGHT * _shared(*_vertical(*parts))
    return told + MOTION * _correlated(motion[:, :2, :2], motion[:, 2:, 2:], motion[:, :2, 2:])


def _vertical(aa: Tensor, bb: Tensor, ab: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Covariances of the y of points alone."""
    return aa[..., 1::2, 1::2], bb[..., 1::2, 1::2], ab[..., 1::2, 1::2]


def _shared(aa: Tensor, bb: Tensor, ab: Tensor) -> Tensor:
    """Mutual information ``(L,)`` of rows with noise of variance 1."""
    aa, bb = (c + torch.eye(c.shape[-1], dtype=c.dtype, device=c.device) for c in (aa, bb))
    low_a, low_b = _factor(aa), _factor(bb)
    white = torch.linalg.solve_triangular(low_a, ab, upper=False)
    white = torch.linalg.solve_triangular(low_b, white.mT, upper=False)
    left = torch.eye(white.shape[-2], dtype=aa.dtype, device=aa.device) - white @ white.mT
    return -_factor(left).diagonal(dim1=-2, dim2=-1).log().sum(-1)


def _correlated(aa: Tensor, bb: Tensor, ab: Tensor) -> Tensor:
    """Mutual information ``(L,)`` where each coordinate has noise in proportion to itself."""
    one, two = (LOADING * c.diagonal(dim1=-2, dim2=-1) for c in (aa, bb))
    one, two = (v.clamp(min=1e-12 * float(v.max()) + 1e-300).rsqrt()[..., None] for v in (one, two))
    return _shared(one * aa * one.mT, two * bb * two.mT, one * ab * two.mT)


def _factor(c: Tensor) -> Tensor:
    low: Tensor = torch.linalg.cholesky_ex(c).L
    return low
