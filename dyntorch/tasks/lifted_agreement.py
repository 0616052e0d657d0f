"""Which observations agree with given projections: per point all of its views, or all but the fewest that spoil it."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from dyntorch.algebra.triangulation import reproject, triangulate
from dyntorch.chi_square import quantile
from dyntorch.tasks.lifted_projections import Tracks

SHARE = 0.997
"""Of the inliers that agree: what three standard deviations are for one coordinate."""
SPARE = 2
"""Equations that must remain to confirm a point that has lost a view: with fewer, wrong ones confirm each other."""
STEPS = 2
"""Of triangulation."""
FAR = 1e30
"""Squared distance in place of one that is no number."""
WIDE, SETTLING = 1.5, 4
"""Times the threshold up to which distances count when the noise is estimated, and how often that is repeated."""
SMALL = 2.0
"""Largest correction of the variance for the degrees of freedom of the projections."""
EXACT = 1e-8
"""Least noise, as part of the image."""
PAIRS = 1 << 14
"""Points that are looked at together with one view left out."""


def distance(tracks: Tracks, projections: Tensor) -> Tensor:
    """Squared reprojection error of every point over its views, ``(b, n)``, measured units; :data:`FAR` where there is none."""
    structure = triangulate(projections, tracks.x, tracks.weights, steps=STEPS)
    error = (tracks.x - reproject(projections, structure)).square().sum(-1) / tracks.scales.square()[..., None]
    total = torch.where(tracks.weights > 0, error, 0.0).sum(1)
    return torch.where((structure != 0).any(-1), total, FAR).nan_to_num(nan=FAR, posinf=FAR).clamp(max=FAR)


def freedom(tracks: Tracks, k: int) -> Tensor:
    """Equations that every point fulfils beside those that determine it, ``(b, n)``, not negative."""
    return ((tracks.weights > 0).sum(1) * tracks.x.shape[-1] - k).clamp(min=0)


def bound(free: Tensor, share: float = SHARE) -> Tensor:
    """The squared distance, in standard deviations, that so many of the inliers keep; 0 where nothing is left to judge by."""
    top = int(free.max()) if free.numel() else 0
    return torch.tensor(_bounds(top, share), dtype=torch.float64, device=free.device)[free]


@lru_cache(maxsize=64)
def _bounds(top: int, share: float) -> tuple[float, ...]:
    return (0.0, *(quantile(share, free) for free in range(1, top + 1)))


def noise(square: Tensor, free: Tensor, chosen: Tensor, part: float = 0.5) -> Tensor:
    """Standard deviation ``(b,)`` of one coordinate from a quantile of the chosen points; 0 where there are none.

    Args:
        square: ``(b, n)`` squared distances.
        free: ``(b, n)`` of :func:`freedom`.
        chosen: ``(b, n)`` bool.
        part: the quantile, the median by default.
    """
    relative = square / bound(free, part).clamp(min=torch.finfo(square.dtype).tiny)
    counted = chosen & (free >= 1)
    order = relative.masked_fill(~counted, torch.inf).sort(-1).values
    number = counted.sum(-1, keepdim=True)
    place = (number * part).long().clamp(min=0, max=max(0, square.shape[-1] - 1))
    found = order.gather(-1, torch.minimum(place, (number - 1).clamp(min=0)))[:, 0]
    return torch.where(number[:, 0] > 0, found, 0.0).sqrt()


def settled_noise(tracks: Tracks, square: Tensor, free: Tensor, chosen: Tensor, used: int, part: float = 0.5) -> Tensor:
    """Noise ``(b,)`` of one coordinate from a quantile of the chosen points, then the median of those within its threshold.

    Args:
        tracks: flat batch.
        square: ``(b, n)`` squared distances.
        free: ``(b, n)`` of :func:`freedom`.
        chosen: ``(b, n)`` bool.
        used: degrees of freedom of the projections, fitted to these points.
        part: the first quantile.
    """
    least = EXACT / tracks.scales.amin(1)
    level = torch.maximum(noise(square, free, chosen, part), least)
    for _ in range(SETTLING):
        inside = chosen & (square <= (WIDE * level).square()[:, None] * bound(free))
        rows = (free * inside).sum(-1)
        small = rows / (rows - used).clamp(min=1)
        level = torch.maximum(noise(square, free, inside) * small.clamp(min=1, max=SMALL).sqrt(), least)
    return level


def agreeing(tracks: Tracks, projections: Tensor, sigma: Tensor) -> Tensor:
    r"""Weights ``(b, views, n)``, 0 for all observations that do not agree with the projections.

    A point agrees where its squared distance is below the quantile of :math:`\sigma^2 \chi^2`.  Of one that does not, the view
    without which the others agree best is left out, and the next one, as long as enough remains to tell.

    Args:
        tracks: flat batch.
        projections: ``(b, views, l + 1, K)``.
        sigma: ``(b,)`` noise of one coordinate, measured unit.
    """
    k, size = projections.shape[-1] - 1, tracks.x.shape[-1]
    free = freedom(tracks, k)
    agrees = (distance(tracks, projections) <= sigma.square()[:, None] * bound(free)) & (free >= 1)
    kept = tracks.weights * agrees[:, None]
    rest = (~agrees & (free - size >= SPARE)).nonzero()
    for some in rest.split(PAIRS):
        problem, point = some.unbind(-1)
        kept[problem, :, point] = _without(tracks, projections, sigma, problem, point)
    return kept


def _without(tracks: Tracks, projections: Tensor, sigma: Tensor, problem: Tensor, point: Tensor) -> Tensor:
    """Weights ``(p, views)`` of single points, without the views that spoil them; all 0 where no views agree."""
    alone = Tracks(
        tracks.x[problem, :, point][:, :, None],
        tracks.weights[problem, :, point][:, :, None],
        tracks.scales[problem],
        tracks.transforms[problem],
        tracks.times,
    )
    matrices, limit = projections[problem], sigma[problem].square()
    views, k, size = matrices.shape[1], matrices.shape[-1] - 1, tracks.x.shape[-1]
    result = torch.zeros_like(alone.weights[..., 0])
    left = torch.arange(len(problem), device=problem.device)
    others = 1 - torch.eye(views, dtype=tracks.x.dtype, device=tracks.x.device)
    while len(left):
        seen = alone.weights[:, :, 0] > 0
        fewer = alone.repeated(views).only((alone.weights[:, None] * others[:, :, None]).flatten(0, 1))
        square = distance(fewer, matrices.repeat_interleave(views, dim=0)).unflatten(0, (-1, views))[..., 0]
        least, worst = square.masked_fill(~seen, torch.inf).min(-1)
        alone = alone.only(alone.weights * others[worst][:, :, None])
        free = freedom(alone, k)[:, 0]
        agrees = least <= limit * bound(free)
        result[left[agrees]] = alone.weights[agrees][..., 0]
        on = (~agrees & (free - size >= SPARE)).nonzero()[:, 0]
        left, alone, matrices, limit = left[on], alone.subset(on), matrices[on], limit[on]
    return result
