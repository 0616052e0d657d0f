"""How well the same points fit together at every shift: the variance of the epipolar residual over lags."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.algebra.epipolar_variance import epipolar_variance
from dyntorch.lags import epipolar_moments
from dyntorch.tasks.sync_tracks import Tracks, noise_ratio, smoothed

OVERLAP = 0.25
"""Share of the largest overlap below which a shift is not judged: little data fit anything."""
FEWEST = 24
"""Pairs of positions below which a shift is not judged: three times the unknowns of F."""
PIECE = 4096
"""Lags at a time: bounds the memory on long takes."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Smoothed, normalized points of both cameras at equal steps of a's clock.

    Attributes:
        x1, x2: ``(m1, n, 2)`` and ``(m2, n, 2)``, 0 where missing.
        w1, w2: weights.
        step: seconds.
        start: lag of the first of b against the first of a, seconds.
        rate: of b's clock that was taken out.
        noise: of both cameras in normalized coordinates, in px of a.
    """

    x1: Tensor
    x2: Tensor
    w1: Tensor
    w2: Tensor
    step: float
    start: float
    rate: float
    noise: tuple[float, float]

    @staticmethod
    def of(a: Tracks, b: Tracks, step: float, rate: float = 1.0) -> Samples:
        """b's clock goes ``rate`` seconds in one of a's.  The kernel is as wide as a step."""
        first, w1 = _sampled(a, step, step)
        second, w2 = _sampled(b, step * rate, step * rate)
        noise = float(a.change[0, 0]), float(b.change[0, 0]) * noise_ratio(a, b)
        start = float(b.times[0]) / rate - float(a.times[0])
        return Samples(first, second, w1, w2, step, start, rate, noise)

    def lags(self, max_shift: float | None) -> tuple[int, int]:
        """First and last lag, in steps, with some overlap and shifts within ``max_shift`` seconds."""
        lo, hi = 1 - len(self.x1), len(self.x2) - 1
        if max_shift is not None:
            lo = max(lo, math.ceil((-max_shift / self.rate - self.start) / self.step - 1e-9))
            hi = min(hi, math.floor((max_shift / self.rate - self.start) / self.step + 1e-9))
        return lo, hi

    def only(self, points: Tensor) -> Samples:
        """These points ``(n,)`` bool alone."""
        x1, x2, w1, w2 = (part[:, points] for part in (self.x1, self.x2, self.w1, self.w2))
        return dataclasses.replace(self, x1=x1, x2=x2, w1=w1, w2=w2)


@dataclass(frozen=True, eq=False)
class Curve:
    """Scores over lags.

    Attributes:
        lags: ``(L,)`` seconds of a's clock: a moment t of a is at rate (t + lag) of b.
        scores: ``(L,)`` nats, higher is better, NaN where not judged.
        variance: ``(L,)`` of the residual, px^2 of a.
        counts: ``(L,)`` pairs of positions.
        rate: of b's clock.
        level: the median of the variance where judged.
    """

    lags: Tensor
    scores: Tensor
    variance: Tensor
    counts: Tensor
    rate: float
    level: float

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


def epipolar_curve(samples: Samples, max_shift: float | None = None, overlap: float = OVERLAP) -> Curve:
    r"""Scores at all lags.

    .. math:: \text{score}(s) = -\tfrac12 \log \frac{\lambda(s)}{\operatorname{med} \lambda}
              + \tfrac12 \log \frac{c(s)}{\max c},

    with the residual's variance :math:`\lambda` of :func:`dyntorch.algebra.epipolar_variance.epipolar_variance` over c(s) pairs of
    positions.  The second term keeps short overlaps, whose variance scatters, from winning by chance: a shift by a period of a gait
    with half the overlap has to fit with half the variance.

    Args:
        overlap: share of the largest overlap below which a lag is not judged.

    Source: thesis, chapter 7; Taubin 1991 for the normalization.
    """
    lo, hi = samples.lags(max_shift)
    found = [_piece(samples, first, min(first + PIECE - 1, hi)) for first in range(lo, hi + 1, PIECE)]
    if not found:
        empty = samples.x1.new_zeros(0)
        return Curve(empty, empty, empty, empty, samples.rate, 1.0)
    variance, counts = (torch.cat(parts) for parts in zip(*found, strict=True))
    judged = (counts >= overlap * counts.max()) & (counts >= FEWEST) & variance.isfinite()
    level = variance[judged].median() if bool(judged.any()) else variance.new_ones(())
    tiny = torch.finfo(variance.dtype).tiny
    scores = -0.5 * (variance / level.clamp(min=tiny)).clamp(min=tiny).log() + 0.5 * (counts / counts.max()).clamp(min=tiny).log()
    lags = samples.start + samples.step * torch.arange(lo, hi + 1, dtype=torch.float64, device=variance.device)
    return Curve(lags, torch.where(judged, scores, torch.nan), variance, counts, samples.rate, float(level))


def _piece(samples: Samples, lo: int, hi: int) -> tuple[Tensor, Tensor]:
    moments, counts = epipolar_moments(samples.x1, samples.x2, (lo, hi), (samples.w1, samples.w2))
    return epipolar_variance(moments, samples.noise)[0], counts


def _sampled(tracks: Tracks, step: float, width: float) -> tuple[Tensor, Tensor]:
    x, _, weights = smoothed(tracks, tracks.every(step), width)
    change = tracks.change
    return torch.where((weights > 0)[..., None], x @ change[:2, :2].mT + change[:2, 2], 0.0), weights
