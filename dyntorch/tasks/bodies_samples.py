"""Segmentations by geometry alone, from samples of seven matches: bodies that interleave, outliers among them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from dyntorch.algebra.epipolar import sampson_squared
from dyntorch.algebra.epipolar_descent import descend
from dyntorch.algebra.epipolar_samples import sample_fundamentals
from dyntorch.fitting import fit
from dyntorch.invariants.segmentation_matrix import SegmentationMatrix
from dyntorch.tasks.bodies_descent import Candidate, descended
from dyntorch.tasks.bodies_energy import View
from dyntorch.tasks.bodies_pool import TRUNCATED, Starts, best_sets, rough_cost

SAMPLES = 8000
"""Per round."""
BLOCK = 1024
"""Geometries scored at a time, which stay in the cache."""
WIDE = 3.0
"""Distance up to which a match speaks for a sample, pixels: seven matches fix a geometry less well than all of a body."""
BEST = 120
"""Samples of a round that descend."""
SCALES = (3.0, 2.0)
"""Of these descents, pixels."""
PARTIAL = 4
"""Sets of geometries whose unexplained matches the next round samples."""
FIRST = 40
"""Geometries that sets start from."""
ALIKE = 0.97
"""Overlap (intersection over union) of the matches that agree above which one of two geometries is enough."""
STARTS = 30
"""Sets that descend, for each number of bodies."""
MATRIX, REWEIGHTED = 35, 3
"""Matches that a segmentation matrix takes, and rounds of its weights."""


def search_samples(view: View, counts: Sequence[int], generator: torch.Generator | None) -> dict[int, list[Candidate]]:
    """Segmentations into each number of bodies, the cheapest first.

    Args:
        view: matches, outliers among them; links do not matter.
        counts: numbers of bodies.
        generator: source of all randomness.

    Returns:
        Candidates for each number.
    """
    pool = _pool(view, max(counts), generator)
    cost = rough_cost(view, pool)
    starts = []
    for count in counts:
        chosen = best_sets(cost, count, FIRST)[:STARTS]
        starts.append(Starts(cost[chosen].argmin(1), pool[chosen]))
    return descended(view, starts)


def _different(view: View, pool: Tensor) -> Tensor:
    """Those of the geometries that not many of the same matches agree with, the cheapest first."""
    cost = rough_cost(view, pool)
    order = cost.sum(-1).argsort(stable=True)
    near = (cost[order] < TRUNCATED).float()
    shared, size = near @ near.mT, near.sum(-1)
    alike = shared > ALIKE * (size[:, None] + size - shared)
    return pool[order[~alike.triu(1).any(0)]]


def _pool(view: View, most: int, generator: torch.Generator | None) -> Tensor:
    """Geometries ``(P, 3, 3)``: of samples from all matches, then from those that sets of one, two, ... leave unexplained."""
    pool = matrix_pair(view) if most > 1 else view.x1.new_zeros(0, 3, 3)
    weights = torch.ones_like(view.x1[None, :, 0])
    for count in range(1, most + 1):
        pool = _different(view, torch.cat([pool, _sampled(view, weights, generator)]))
        if count < most:
            cost = rough_cost(view, pool)
            sets = best_sets(cost, count, FIRST)[:PARTIAL]
            left = (cost[sets].amin(1) >= cost.max()).double()
            weights = left[left.sum(-1) >= 8]
            if not len(weights):
                break
    return pool


def _sampled(view: View, weights: Tensor, generator: torch.Generator | None) -> Tensor:
    """Geometries of the best samples from each pool of matches ``(B, n)``, descended."""
    count = len(weights)
    found, valid = sample_fundamentals(view.x1, view.x2, weights, SAMPLES // count, generator)
    x1, x2, single = view.x1.float(), view.x2.float(), weights.float()
    starts, members = [], []
    for F, exists, weight in zip(found, valid, single, strict=True):
        F = F[exists]
        total = torch.cat([_votes(part, x1, x2, weight, WIDE * view.pixel) for part in F.float().split(BLOCK)])
        best = total.topk(min(BEST // count, len(total)), largest=False).indices
        starts.append(F[best])
        members.append(weight.double().expand(len(best), -1))
    result, member = torch.cat(starts), torch.cat(members)
    for scale in SCALES:
        result = descend(result, view.x1, view.x2, member, scale * view.pixel)
    return result


def _votes(F: Tensor, x1: Tensor, x2: Tensor, weight: Tensor, scale: float) -> Tensor:
    """Truncated cost ``(p,)`` of geometries."""
    return (sampson_squared(F, x1, x2) / scale**2).clamp_(max=1) @ weight


def matrix_pair(view: View) -> Tensor:
    """Both geometries ``(2, 3, 3)`` of the segmentation matrix of all matches; none where there are too few."""
    if len(view.x1) < MATRIX:
        return view.x1.new_zeros(0, 3, 3)
    tensor = fit(SegmentationMatrix, view.x1, view.x2).tensor
    for _ in range(REWEIGHTED):
        weights = SegmentationMatrix.reweighted(tensor, view.x1, view.x2)
        tensor = fit(SegmentationMatrix, view.x1, view.x2, weights=weights).tensor
    return torch.stack(SegmentationMatrix.fundamentals(tensor))
