"""Which points are the same in both cameras: subsets vote, each at the shift it likes best."""

from __future__ import annotations

import torch
from torch import Generator, Tensor

from dyntorch.algebra.epipolar_variance import epipolar_variance, gradient_moments
from dyntorch.lags import epipolar_moments
from dyntorch.tasks.sync_attempt import Attempt
from dyntorch.tasks.sync_curve import FEWEST, OVERLAP, Samples
from dyntorch.tasks.sync_tracks import Tracks

SIZE = 6
"""Points of a subset."""
TRIALS = 60
"""A subset of 6 without 4 wrong points of 17 comes up with probability .14: one in 60 trials in all but 1 of 10,000."""
SHARE = 0.7
"""Of the points that have to fit."""
WRONG = 3.0
"""Times the median residual of those that fit, beyond which a point is wrong."""
FEW = 8
"""Points below which none can be told wrong."""
LAGS = 800
"""At most; longer searches are made in coarser steps."""


def consistent_points(a: Tracks, b: Tracks, found: Attempt, generator: Generator | None) -> Tensor | None:
    """Points ``(n,)`` bool whose epipolar residual agrees with the others' at one and the same shift; None where there are too few.

    Subsets of six are drawn; each has its own best shift and fundamental matrix, by which all points are judged.  The subset
    counts that is fitted best by 70 of 100 points: a plain fit starts at a wrong shift, from where no reweighting returns.

    Source: Fischler and Bolles 1981, Random sample consensus, over points instead of matches.
    """
    n = a.x.shape[1]
    lo, hi = found.samples.lags(found.max_shift)
    if n < FEW or lo > hi:
        return None
    step = found.step * max(1, -(-(hi - lo) // LAGS))
    samples = Samples.of(a, b, step, found.samples.rate)
    moments, counts = epipolar_moments(
        samples.x1, samples.x2, samples.lags(found.max_shift), (samples.w1, samples.w2), per_point=True
    )
    total = counts.sum(0)
    judged = (total >= OVERLAP * total.max()) & (total >= FEWEST)
    if not bool(judged.any()):
        return None
    moments, counts = moments[:, judged], counts[:, judged]
    forms = gradient_moments(moments, samples.noise)
    generator = generator or torch.Generator().manual_seed(0)
    best: tuple[float, Tensor] | None = None
    for _ in range(TRIALS):
        chosen = torch.randperm(n, generator=generator)[:SIZE].to(moments.device)
        variance, F = epipolar_variance(moments[chosen].sum(0), samples.noise)
        lag = int((variance / counts[chosen].sum(0).clamp(min=1).sqrt()).argmin())
        each = _variances(moments[:, lag], forms[:, lag], F[lag])
        cost = float(each.nanquantile(SHARE))
        if best is None or cost < best[0]:
            best = cost, each
    assert best is not None
    each = best[1]
    level = each[each <= best[0]].median()
    kept = ~(each > WRONG**2 * level)
    return kept if int(kept.sum()) >= SHARE * n else None


def _variances(moments: Tensor, forms: Tensor, F: Tensor) -> Tensor:
    """``(n,)`` each point's residual variance by one F; NaN where it is never seen."""
    f = F.flatten()
    below = torch.einsum("i,nij,j->n", f, forms, f)
    return torch.where(below > 0, torch.einsum("i,nij,j->n", f, moments, f) / torch.where(below > 0, below, 1.0), torch.nan)
