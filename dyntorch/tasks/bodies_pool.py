"""A pool of epipolar geometries, and sets of them that explain all matches."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.algebra.epipolar import sampson_squared
from dyntorch.algebra.epipolar_descent import fit_fundamental
from dyntorch.tasks.bodies_energy import View

LEAST = 7
"""Fewest matches of a body."""
FITTED = 10
"""Fewest matches of a group whose geometry enters the pool."""
ALIKE = 0.93
"""Overlap (intersection over union) of groups above which one of them is enough."""
COARSE = (4.0, 2.0)
"""Scales of the fits, pixels."""
ROUGH, TRUNCATED = 1.0, 9.0
"""Noise in pixels, and cap of the squared distances, by which geometries are chosen."""
SMOOTH = 3.0
"""Weight of the links that a start cuts."""
KEPT = 6
"""Starts kept of each kind."""
SETS = 400
"""Sets followed from one geometry to the next."""
DISTINCT = 0.97
"""Share of matches in the same groups above which two labellings are one."""


@dataclass(frozen=True)
class Starts:
    """Segmentations into K bodies to start from: ``labels (s, n)`` from 0 and ``fundamentals (s, K, 3, 3)``."""

    labels: Tensor
    fundamentals: Tensor


def one_hot(labels: Tensor, width: int) -> Tensor:
    """Labels ``(*batch, n)`` from 0 as ``(*batch, width, n)`` of 0 and 1; others are in no row."""
    return (labels[..., None, :] == torch.arange(width, device=labels.device)[:, None]).double()


def rough_cost(view: View, fundamentals: Tensor) -> Tensor:
    """Truncated squared distances ``(*batch, n)``."""
    square = sampson_squared(fundamentals, view.x1, view.x2)
    return (square / (ROUGH * view.pixel) ** 2).clamp(max=TRUNCATED)


def smoothed(cost: Tensor, view: View) -> Tensor:
    """Costs ``(P, n)``, each match's own and those of its neighbours, by their links."""
    return (cost + view.links.pull(cost)) / (1 + view.links.weight.sum(-1))


def pool_of(view: View, groups: Tensor) -> Tensor:
    """Fundamental matrices ``(P, 3, 3)`` of all different groups ``(g, n)``, 0 and 1."""
    size = groups.sum(-1)
    order = size.argsort(descending=True, stable=True)
    groups = groups[order][size[order] >= min(FITTED, groups.shape[-1])]
    size, single = groups.sum(-1), groups.float()
    shared = (single @ single.mT).double()
    overlap = shared / (size[:, None] + size - shared)
    groups = groups[~(overlap.triu(1) > ALIKE).any(0)]
    return fit_fundamental(view.x1, view.x2, groups, [view.pixel * scale for scale in COARSE], steps=2)[0]


def fitted(view: View, labels: Tensor, count: int) -> Starts:
    """Labellings ``(s, n)`` with the geometries of their bodies."""
    member = one_hot(labels, count)
    found = fit_fundamental(view.x1, view.x2, member.flatten(0, 1), (COARSE[0] * view.pixel,), steps=2)[0]
    return Starts(labels, found.unflatten(0, member.shape[:2]))


def best_sets(cost: Tensor, most: int, first: int | None = None) -> list[Tensor]:
    """Sets ``(s, K)`` of geometries of least total cost, :math:`\\sum_i \\min_{k \\in \\text{set}} c_{ki}`, the best first.

    Args:
        cost: ``(P, n)``.
        most: geometries of the largest sets; sets grow by one at a time.
        first: how many of the best geometries the sets start from; None: all.

    Returns:
        The sets of one, two, ... ``most`` geometries; none where there are fewer.
    """
    single = cost.float()
    size = len(single)
    sets = single.sum(-1).argsort(stable=True)[: size if first is None else first, None]
    found = [sets]
    for count in range(2, most + 1):
        if not len(sets):  # fewer geometries than bodies
            found.append(sets.new_zeros(0, count))
            continue
        least = single[sets].amin(1)
        grown = torch.stack([torch.minimum(row, single).sum(-1) for row in least])
        place = grown.flatten().topk(min(5 * SETS, grown.numel()), largest=False).indices
        candidates = torch.cat([sets[place // size], (place % size)[:, None]], dim=-1).sort(-1).values
        candidates = candidates[(candidates.diff(dim=-1) > 0).all(-1)]
        different = list(dict.fromkeys(map(tuple, candidates.tolist())))[:SETS]
        sets = torch.tensor(different, dtype=torch.long, device=cost.device).view(-1, count)
        found.append(sets)
    return found


def distinct(view: View, starts: Starts) -> Starts:
    """Up to :data:`KEPT` starts that differ, the cheapest first, with enough matches in every body."""
    count = starts.fundamentals.shape[-3]
    member = one_hot(starts.labels, count)
    cost = (rough_cost(view, starts.fundamentals) * member).sum((-2, -1)) + SMOOTH * view.links.cut(member)
    cost = torch.where(member.sum(-1).amin(-1) >= LEAST, cost, torch.inf)
    order = cost.argsort(stable=True)
    order = order[cost[order].isfinite()]
    flat = member[order].float().flatten(0, 1)
    shared = (flat @ flat.mT).unflatten(0, (-1, count)).unflatten(-1, (-1, count))
    alike = (shared.amax(1).sum(-1) > DISTINCT * flat.shape[-1]).tolist()
    kept: list[int] = []
    for index in range(len(order)):
        if len(kept) < KEPT and not any(alike[other][index] for other in kept):
            kept.append(index)
    return Starts(starts.labels[order[kept]], starts.fundamentals[order[kept]])


def set_starts(pool: Tensor, cost: Tensor, sets: Tensor) -> Starts:
    """The starts of the first sets ``(s, K)`` of geometries ``(P, 3, 3)``: each match to the one of least cost ``(P, n)``."""
    chosen = sets[: 8 * KEPT]
    return Starts(cost[chosen].argmin(1), pool[chosen])
