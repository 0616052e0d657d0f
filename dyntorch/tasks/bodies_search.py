"""Segmentations of matches of which nearly all belong to some body: flows, a pool of geometries, choices among them, descent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.algebra.epipolar import sampson_squared
from dyntorch.algebra.epipolar_descent import descend, fit_fundamental
from dyntorch.tasks.bodies_energy import View, energy
from dyntorch.tasks.bodies_flows import affine_flows, mean_field

RUNS = 24
"""Runs of flows per number of bodies."""
LEAST = 7
"""Fewest matches of a body."""
FITTED = 10
"""Fewest matches of a flow that enters the pool."""
ALIKE = 0.93
"""Overlap (intersection over union) of flows above which one of them is enough."""
COARSE = (4.0, 2.0)
"""Scales of the fits of the pool, pixels."""
KEPT = 6
"""Starts kept per number of bodies, of each kind."""
SETS = 400
"""Choices of geometries followed from one body to the next."""
DISTINCT = 0.97
"""Share of matches in the same groups above which two labellings are one."""
SCHEDULE = (2.0, 2.0, 1.5, 1.0, 1.0, 1.0, 1.0, 1.0)
"""Noise in the rounds of the descent, in units of the final one."""
FINE, TRUNCATED, SMOOTH = 0.5, 9.0, 3.0
"""Noise in pixels, cap of the squared distances, and weight of the links during the descent: finer than in the final energy."""
TURNS = 5


@dataclass(frozen=True)
class Candidate:
    """A segmentation into bodies.

    Attributes:
        energy: its cost.
        labels: ``(n,)`` from 0.
        fundamentals: ``(K, 3, 3)``.
    """

    energy: float
    labels: Tensor
    fundamentals: Tensor


def search(view: View, counts: Sequence[int], generator: torch.Generator | None, extra: Sequence[Tensor] = ()) -> dict[int, list[Candidate]]:
    """Segmentations into each number of bodies, the cheapest first.

    Args:
        view: matches, without outliers.
        counts: numbers of bodies.
        generator: source of all randomness.
        extra: further labellings ``(n,)`` from 0 to start from.

    Returns:
        Candidates for each number; none where no start had so many bodies of :data:`LEAST` matches.
    """
    flows = sorted({max(2, k + more) for k in counts for more in (0, 1)})
    plan = torch.tensor(flows, device=view.x1.device).repeat(RUNS if len(flows) > 2 else 2 * RUNS)
    labels = affine_flows(view.x1, view.x2, view.links, plan, 0.5 * view.pixel, generator)
    pool = _pool(view, labels, int(plan.max()), [*extra])
    cost = (sampson_squared(pool, view.x1, view.x2) / (2 * FINE * view.pixel) ** 2).clamp(max=TRUNCATED)
    cost = _smoothed(cost, view)
    starts = []
    for count in counts:
        found = _chosen(cost, count) if count > 1 else torch.zeros_like(labels[:1])
        here = [x[None] for x in extra if int(x.max()) + 1 == count]
        if count > 1:
            here += [_cheapest(view, labels[plan == count], count)]
        starts.append(torch.cat([found, *here]))
    return _descended(view, starts, counts)


def one_hot(labels: Tensor, width: int) -> Tensor:
    """Labels ``(*batch, n)`` from 0 as ``(*batch, width, n)`` of 0 and 1, double precision."""
    return (labels[..., None, :] == torch.arange(width, device=labels.device)[:, None]).double()


def _pool(view: View, labels: Tensor, width: int, extra: list[Tensor]) -> Tensor:
    """Fundamental matrices ``(P, 3, 3)`` of all different flows."""
    groups = [one_hot(labels, width).flatten(0, 1), *(one_hot(x, int(x.max()) + 1) for x in extra), torch.ones_like(view.x1[None, :, 0])]
    member = torch.cat(groups)
    size = member.sum(-1)
    order = size.argsort(descending=True, stable=True)
    member = member[order][size[order] >= FITTED]
    size = member.sum(-1)
    single = member.float()
    shared = (single @ single.mT).double()
    overlap = shared / (size[:, None] + size - shared)
    member = member[~(overlap.triu(1) > ALIKE).any(0)]
    return fit_fundamental(view.x1, view.x2, member, [view.pixel * scale for scale in COARSE], steps=2)[0]


def _smoothed(cost: Tensor, view: View) -> Tensor:
    """Costs ``(P, n)``, each match's own and those of its neighbours, by their links."""
    return (cost + view.links.pull(cost)) / (1 + view.links.weight.sum(-1))


def _chosen(cost: Tensor, count: int) -> Tensor:
    """Labellings ``(s, n)`` by the sets of geometries of least total cost, grown one geometry at a time."""
    single = cost.float()
    size = len(single)
    if size < count:
        return torch.zeros(0, cost.shape[-1], dtype=torch.long, device=cost.device)
    sets = torch.arange(size, device=cost.device)[:, None]
    totals = single.sum(-1)
    for _ in range(1, count):
        least = single[sets].amin(1)
        grown = torch.stack([torch.minimum(row, single).sum(-1) for row in least])
        total, place = grown.flatten().topk(min(5 * SETS, grown.numel()), largest=False)
        candidates = torch.cat([sets[place // size], (place % size)[:, None]], dim=-1).sort(-1).values
        fresh = (candidates.diff(dim=-1) > 0).all(-1)
        candidates, total = candidates[fresh], total[fresh]
        key = (candidates * size ** torch.arange(candidates.shape[-1], device=cost.device)).sum(-1)
        _, first = _first_of(key)
        sets, totals = candidates[first][:SETS], total[first][:SETS]
        if not len(sets):
            return torch.zeros(0, cost.shape[-1], dtype=torch.long, device=cost.device)
    labels = single[sets[: 8 * KEPT]].argmin(1)
    return _distinct(labels, totals[: 8 * KEPT], count)


def _first_of(key: Tensor) -> tuple[Tensor, Tensor]:
    """Distinct keys, and the first place of each, in the order of the places."""
    distinct, inverse = torch.unique(key, return_inverse=True)
    first = torch.full_like(distinct, len(key)).scatter_reduce(0, inverse, torch.arange(len(key), device=key.device), "amin")
    return distinct, first.sort().values


def _cheapest(view: View, labels: Tensor, count: int) -> Tensor:
    """Different ones of the labellings by flows themselves, those with the better epipolar geometries."""
    member = one_hot(labels, count)
    fundamentals = fit_fundamental(view.x1, view.x2, member.flatten(0, 1), (4 * view.pixel,), steps=2)[0].unflatten(0, member.shape[:2])
    square = sampson_squared(fundamentals, view.x1, view.x2) / (2 * FINE * view.pixel) ** 2
    total = (square.clamp(max=TRUNCATED) * member).sum((-2, -1)) + SMOOTH * view.links.cut(member)
    return _distinct(labels, total, count)


def _distinct(labels: Tensor, cost: Tensor, count: int) -> Tensor:
    """Up to KEPT labellings ``(s, n)`` that differ, the cheapest first, with enough matches in every body."""
    order = cost.argsort(stable=True)
    labels = labels[order]
    member = one_hot(labels, count).float()
    labels, member = labels[member.sum(-1).amin(-1) >= LEAST], member[member.sum(-1).amin(-1) >= LEAST]
    kept: list[int] = []
    for index in range(len(labels)):
        shared = (member[kept] @ member[index].mT).amax(1).sum(-1) if kept else labels.new_zeros(0)
        if not bool((shared > DISTINCT * labels.shape[-1]).any()):
            kept.append(index)
        if len(kept) == KEPT:
            break
    return labels[kept]


def _descended(view: View, starts: list[Tensor], counts: Sequence[int]) -> dict[int, list[Candidate]]:
    """Labels and geometries in turns, of all starts at once."""
    bodies = torch.tensor([k for k, s in zip(counts, starts, strict=True) for _ in range(len(s))], device=view.x1.device)
    width = max(counts)
    labels = torch.cat(starts)
    present = torch.arange(width, device=labels.device) < bodies[:, None]
    rows = present.flatten().nonzero().flatten()
    member = one_hot(labels, width)
    shape = member.shape[:2]
    fundamentals = torch.zeros(*shape, 3, 3, dtype=view.x1.dtype, device=view.x1.device).flatten(0, 1)
    fundamentals[rows] = fit_fundamental(view.x1, view.x2, member.flatten(0, 1)[rows], [view.pixel * s for s in (6.0, 3.0, 2.0)])[0]
    absent = ~present[..., None]

    def distances(noise: float) -> Tensor:
        square = sampson_squared(fundamentals[rows], view.x1, view.x2) / (noise * view.pixel) ** 2
        full = torch.full((*shape, labels.shape[-1]), torch.inf, device=labels.device).flatten(0, 1)
        full[rows] = square.clamp(max=TRUNCATED).float()
        return full.unflatten(0, shape)

    for turn, noise in enumerate(SCHEDULE):
        cost = distances(noise * FINE)
        member = mean_field(cost, view.links, SMOOTH, TURNS, None if turn == 0 else member).float()
        weight = member.flatten(0, 1)[rows].double()
        fundamentals[rows] = descend(fundamentals[rows], view.x1, view.x2, weight, 2 * view.pixel, steps=2)
    final = mean_field(distances(FINE), view.links, SMOOTH, TURNS, member)
    labels = final.masked_fill(absent, -1.0).argmax(1)
    member = one_hot(labels, width)
    fundamentals = fundamentals.unflatten(0, shape)
    total = energy(view, fundamentals, member)
    few = (member.sum(-1) < LEAST) & present
    result: dict[int, list[Candidate]] = {}
    for count in counts:
        these = ((bodies == count) & ~few.any(-1)).nonzero().flatten()
        these = these[total[these].argsort(stable=True)]
        result[count] = [Candidate(float(total[i]), labels[i], fundamentals[i, :count]) for i in these.tolist()]
    return result

