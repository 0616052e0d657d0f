"""Segmentations by geometry alone, from samples of seven matches: bodies that interleave, outliers among them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from dyntorch.algebra.epipolar import sampson_squared
from dyntorch.algebra.epipolar_descent import descend
from dyntorch.algebra.epipolar_samples import sample_fundamentals
from dyntorch.tasks.bodies_descent import Candidate, descended
from dyntorch.tasks.bodies_energy import CAP, NOISE, View, energy
from dyntorch.tasks.bodies_matrix import matrix_pairs
from dyntorch.tasks.bodies_pool import LEAST, TRUNCATED, Starts, best_sets, one_hot, rough_cost

SAMPLES, MOST_SAMPLES = 6000, 24000
"""At a time, and at most from the same matches."""
PURE = 10.0
"""Samples wanted all of whose matches are of the largest body."""
BLOCK = 1024
"""Geometries scored at a time, which stay in the cache."""
WIDE = 3.0
"""Distance up to which a match speaks for a sample, pixels: seven matches fix a geometry less well than all of a body."""
BEST = 240
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
WORTH = 5.0
"""What a body that is worth looking for further ones explains, in units of the root of the number of matches: by chance 2 to 5,
small bodies 8."""
REWEIGHTED = 3
"""Rounds of the weights of the segmentation matrix."""


def search_samples(view: View, counts: Sequence[int], generator: torch.Generator | None) -> dict[int, list[Candidate]]:
    """Segmentations into each number of bodies, the cheapest first.

    Args:
        view: matches, outliers among them; links do not matter.
        counts: numbers of bodies.
        generator: source of all randomness.

    Returns:
        Candidates for each number.
    """
    pool = _pool(view, min(counts), max(counts), generator)
    cost = rough_cost(view, pool)
    sets = best_sets(cost, max(counts), FIRST)
    starts = []
    for count in counts:
        if count <= len(pool):
            chosen = sets[count - 1][:STARTS]
            starts.append(Starts(cost[chosen].argmin(1), pool[chosen]))
    found = descended(view, starts) if starts else {}
    return {count: _ranked(view, found.get(count, [])) for count in counts}


def _ranked(view: View, candidates: list[Candidate]) -> list[Candidate]:
    """The candidates with enough inliers in every body, by their cost if what is far from all bodies is in none."""
    if not candidates:
        return []
    fundamentals = torch.stack([candidate.fundamentals for candidate in candidates])
    square = _distances(view, fundamentals)
    member = one_hot(square.argmin(1), square.shape[1]) * (square < CAP)
    inliers = member.sum(-1)
    total = energy(view, fundamentals, member) + CAP * (len(view.x1) - inliers.sum(-1))
    order = total.argsort(stable=True)
    order = order[inliers[order].amin(-1) >= LEAST]
    if not len(order):
        return []
    # between numbers of bodies only distances count: parallax tells true bodies from spurious ones less well
    total = total - total[order[0]] + square[order].amin(1).sum(-1).min()
    return [Candidate(float(total[i]), candidates[i].labels, candidates[i].fundamentals) for i in order.tolist()]


def _different(view: View, pool: Tensor) -> Tensor:
    """Those of the geometries that not many of the same matches agree with, the cheapest first."""
    cost = rough_cost(view, pool)
    order = cost.sum(-1).argsort(stable=True)
    near = (cost[order] < TRUNCATED).float()
    shared, size = near @ near.mT, near.sum(-1)
    alike = shared > ALIKE * (size[:, None] + size - shared)
    return pool[order[~alike.triu(1).any(0)]]


def _pool(view: View, least: int, most: int, generator: torch.Generator | None) -> Tensor:
    """Geometries ``(P, 3, 3)``: of samples from all matches, then from those that sets of one, two, ... leave unexplained.

    Beyond the least number of bodies there are no further samples once another body explains little.
    """
    left = torch.ones_like(view.x1[None, :, 0])
    pool = matrix_pairs(view, left[: most - 1], REWEIGHTED)  # none for a single body
    last = CAP * len(view.x1)
    for count in range(1, most + 1):
        pool = _different(view, torch.cat([pool, *(_sampled(view, open_, len(left), generator) for open_ in left)]))
        if count == most or len(pool) < count:
            break
        cost = rough_cost(view, pool)
        sets = best_sets(cost, count, FIRST)[-1][:PARTIAL]
        total = float(_distances(view, pool[sets]).amin(1).sum(-1).min())
        if count > least and last - total < WORTH * len(view.x1) ** 0.5:
            break
        last = total
        left = (cost[sets].amin(1) >= TRUNCATED).double()
        left = left[left.sum(-1) > LEAST]
    return pool


def _distances(view: View, fundamentals: Tensor) -> Tensor:
    """Truncated squared distances ``(*batch, n)`` as the energy counts them."""
    return (sampson_squared(fundamentals, view.x1, view.x2) / (NOISE * view.pixel) ** 2).clamp(max=CAP)


def _sampled(view: View, weight: Tensor, parts: int, generator: torch.Generator | None) -> Tensor:
    """Geometries of the best samples of the matches with weights ``(n,)``, descended; this is one of several parts of the work."""
    x1, x2, single = view.x1.float(), view.x2.float(), weight.float()
    best, votes = view.x1.new_zeros(0, 3, 3), single.new_zeros(0)
    drawn, needed = 0, 1.0
    while drawn < min(needed, MOST_SAMPLES / parts):
        found, valid = sample_fundamentals(view.x1, view.x2, weight[None], SAMPLES // parts, generator)
        drawn += SAMPLES // parts
        found = found[valid]
        totals = [_votes(part, x1, x2, single, WIDE * view.pixel) for part in found.float().split(BLOCK)]
        best, votes = torch.cat([best, found]), torch.cat([votes, *totals])
        votes, place = votes.topk(min(BEST // parts, len(votes)))
        best = best[place]
        share = float(votes[0] / single.sum()) if len(votes) else 0.0
        needed = PURE / max(share, 0.1) ** 7
    for scale in SCALES:
        best = descend(best, view.x1, view.x2, weight.expand(len(best), -1), scale * view.pixel)
    return best


def _votes(F: Tensor, x1: Tensor, x2: Tensor, weight: Tensor, scale: float) -> Tensor:
    """What the matches ``(n,)`` near each geometry ``(p,)`` count together."""
    return (1 - sampson_squared(F, x1, x2) / scale**2).clamp_(min=0) @ weight
