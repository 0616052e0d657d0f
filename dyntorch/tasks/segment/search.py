"""Segmentations of matches of which nearly all belong to some body: flows, a pool of geometries, choices among them, descent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.core.limits import MAX_SQUARED_DISTANCE
from dyntorch.geometry.epipolar import sampson_squared
from dyntorch.geometry.epipolar_fit import descend, fit_fundamental, sample_fundamentals
from dyntorch.numerics.blocks import uniform
from dyntorch.tasks.segment.coherence import ENERGY_MAX_SQUARED_DISTANCE, SAMPSON_NOISE_PIXELS, Links, View, energy, mean_field

# ----------------------------------------------------------------------------------------------------------------------
# Starts of a segmentation: several affine flows at a time, from random patches of the image that move alike.


# matches of the patches that runs start from, in turns: small bodies need small ones, noisy flows large ones
PATCH_SIZES = (12, 20, 30, 45)
NUM_FLOW_ROUNDS = 8  # of expectation maximization
NUM_FLOW_LABEL_UPDATES = 3  # of the mean field in each round
NUM_FLOW_SCALE_UPDATES = 2  # of each flow in each round
FLOW_CUT_COST = 2.0  # of a link of weight 1 between two flows
FLOW_FREEDOM = 3.0  # degrees of freedom of Student's distribution of the deviations: bodies have depth
MIN_FLOW_NOISE_PIXELS = 0.5  # least standard deviation of a flow
MIN_FITTED_MATCHES = 10  # of a group whose geometry enters the pool
MAX_GROUP_OVERLAP = 0.93  # intersection over union above which one of two groups is enough
POOL_FIT_SCALES_PIXELS = (4.0, 2.0)  # one after the other
POOL_NOISE_PIXELS = 1.0  # of a Sampson distance by which geometries are selected
POOL_CUT_COST = 3.0  # of a link of weight 1 between two bodies in the search
MAX_STARTS = 6  # of each kind
MAX_SETS = 400  # followed from one geometry to the next
MAX_LABEL_OVERLAP = 0.97  # share of the matches in the same groups above which two labellings are one
DESCENT_SCHEDULE = (2.0, 2.0, 1.5, 1.0, 1.0, 1.0, 1.0, 1.0)  # noise in the rounds, over that at the end
DESCENT_NOISE_PIXELS = 0.5  # at the end: finer than in the final energy, for small bodies to hold their own
NUM_DESCENT_LABEL_UPDATES = 3  # of the mean field in each round
DESCENT_FIT_SCALE_PIXELS = 2.0  # scale of the fits, pixels
SAMPLES_AT_ONCE = 6000  # samples drawn at a time
NUM_PURE_SAMPLES = 10.0  # wanted, all of whose matches are of the largest body
SAMPLE_DISTANCE_PIXELS = 3.0  # up to which a match votes for a sample
NUM_DESCENDED_SAMPLES = 240  # of a round
SAMPLE_FIT_SCALES_PIXELS = (3.0, 2.0)  # one after the other
NUM_PARTIAL_SETS = 4  # whose unexplained matches the next round samples
NUM_FIRST_GEOMETRIES = 40  # that sets start from
MAX_SUPPORT_OVERLAP = 0.97  # intersection over union above which one of two geometries is enough
NUM_DESCENDED_SETS = 30  # for each number of bodies
MIN_BODY_GAIN = 5.0  # in units of the root of the number of matches: by chance 2 to 5, small bodies 8


def affine_flows(x1: Tensor, x2: Tensor, links: Links, bodies: Tensor, noise: float, generator: torch.Generator | None) -> Tensor:
    r"""Labellings by robust affine flows :math:`x_2 = A_k x_1 + b_k`, smooth over the links. x1, x2 ``(n, 2)``, bodies
    ``(runs,)`` -> ``(runs, n)``."""
    a = torch.cat([x1, torch.ones_like(x1[:, :1])], dim=-1).float()
    b = x2.float()
    width = int(bodies.max())
    absent = (torch.arange(width, device=x1.device) >= bodies[:, None])[..., None]
    member = _patches(x1.float(), (x2 - x1).float(), bodies, width, generator).masked_fill(absent, 0.0)
    moments, targets = (a[:, :, None] * a[:, None, :]).flatten(1), (a[:, :, None] * b[:, None, :]).flatten(1)
    eye = torch.eye(3, dtype=a.dtype, device=a.device)
    weight, variance = member, None
    for _ in range(NUM_FLOW_ROUNDS):
        inner = (weight @ moments).unflatten(-1, (3, 3))
        ridge = 1e-6 * inner.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] + 1e-12
        flow = torch.linalg.solve_ex(inner + ridge * eye, (weight @ targets).unflatten(-1, (3, 2)))[0]
        square = (a @ flow - b).square().sum(-1)
        total = 2 * member.sum(-1) + 1e-9
        for _ in range(NUM_FLOW_SCALE_UPDATES):
            heavy = 1.0 if variance is None else (FLOW_FREEDOM + 2) / (FLOW_FREEDOM + square / variance[..., None])
            variance = ((member * heavy * square).sum(-1) / total).clamp(min=noise * noise)
        assert variance is not None
        ratio = square / variance[..., None]
        cost = (FLOW_FREEDOM + 2) * torch.log1p(ratio / FLOW_FREEDOM) + 2 * variance.log()[..., None]
        member = mean_field(cost.masked_fill(absent, torch.inf), links, FLOW_CUT_COST, NUM_FLOW_LABEL_UPDATES)
        weight = member * (FLOW_FREEDOM + 2) / (FLOW_FREEDOM + ratio)
    return member.argmax(1)


def _patches(x: Tensor, motion: Tensor, bodies: Tensor, width: int, generator: torch.Generator | None) -> Tensor:
    """Members ``(runs, width, n)`` of patches: nearest matches in place and motion of seeds that are far from each other."""
    squares = [torch.cdist(part, part).square() for part in (x, motion)]
    distance = squares[0] / squares[0].median().clamp(min=1e-12) + squares[1] / squares[1].median().clamp(min=1e-12)
    runs, count = len(bodies), len(x)
    seeds = (uniform(runs, 1, generator=generator, device=x.device) * count).long().clamp(max=count - 1)
    for _ in range(1, width):
        far = distance[seeds].amin(1).double().cumsum(-1)
        pick = uniform(runs, 1, generator=generator, device=x.device) * far[:, -1:]
        seeds = torch.cat([seeds, torch.searchsorted(far, pick).clamp(max=count - 1)], dim=-1)
    sizes = torch.tensor(PATCH_SIZES, device=x.device)[torch.arange(runs, device=x.device) % len(PATCH_SIZES)]
    order = distance[seeds].topk(min(max(PATCH_SIZES), count), dim=-1, largest=False).indices
    chosen = (torch.arange(order.shape[-1], device=x.device) < sizes[:, None, None].clamp(max=max(4, count // 2))).expand_as(order)
    return torch.zeros(runs, width, count, dtype=torch.float32, device=x.device).scatter_(-1, order, chosen.float())


# ----------------------------------------------------------------------------------------------------------------------
# A pool of epipolar geometries, and sets of them that explain all matches.


MIN_BODY_MATCHES = 7
"""Fewest matches of a body."""


@dataclass(frozen=True)
class Starts:
    """Segmentations into K bodies to start from: ``labels (s, n)`` from 0 and ``fundamentals (s, K, 3, 3)``."""

    labels: Tensor
    fundamentals: Tensor


def draw_subset(count: int, most: int, generator: torch.Generator | None, device: torch.device) -> Tensor:
    """``(count,)`` bool: all, or a random part of very many: what is dense beside the noise shows no motion of its own."""
    if count <= most:
        return torch.ones(count, dtype=torch.bool, device=device)
    return uniform(count, generator=generator, device=device).argsort().argsort() < most


def one_hot(labels: Tensor, width: int) -> Tensor:
    """Labels ``(*batch, n)`` from 0 as ``(*batch, width, n)`` of 0 and 1; others are in no row."""
    return (labels[..., None, :] == torch.arange(width, device=labels.device)[:, None]).double()


def rough_cost(view: View, fundamentals: Tensor, noise: float = POOL_NOISE_PIXELS, most: float = MAX_SQUARED_DISTANCE) -> Tensor:
    """Truncated squared distances ``(*batch, n)`` over the variance."""
    return (sampson_squared(fundamentals, view.x1, view.x2) / (noise * view.pixel) ** 2).clamp(max=most)


def final_cost(view: View, fundamentals: Tensor) -> Tensor:
    """The same as the energy counts them."""
    return rough_cost(view, fundamentals, SAMPSON_NOISE_PIXELS, ENERGY_MAX_SQUARED_DISTANCE)


def fit_pool(view: View, groups: Tensor) -> Tensor:
    """Fundamental matrices ``(P, 3, 3)`` of all different groups ``(g, n)``, 0 and 1."""
    size = groups.sum(-1)
    order = size.argsort(descending=True, stable=True)
    groups = groups[order][size[order] >= min(MIN_FITTED_MATCHES, groups.shape[-1])]
    size, single = groups.sum(-1), groups.float()
    shared = (single @ single.mT).double()
    overlap = shared / (size[:, None] + size - shared)
    groups = groups[~(overlap.triu(1) > MAX_GROUP_OVERLAP).any(0)]
    return fit_fundamental(view.x1, view.x2, groups, [view.pixel * scale for scale in POOL_FIT_SCALES_PIXELS], steps=2)[0]


def fit_labellings(view: View, labels: Tensor, count: int) -> Starts:
    """Labellings ``(s, n)`` with the geometries of their bodies."""
    member = one_hot(labels, count)
    fundamentals = fit_fundamental(view.x1, view.x2, member.flatten(0, 1), (POOL_FIT_SCALES_PIXELS[0] * view.pixel,), steps=2)[0]
    return Starts(labels, fundamentals.unflatten(0, member.shape[:2]))


def best_sets(cost: Tensor, most: int, first: int | None = None) -> list[Tensor]:
    """Sets ``(s, K)`` of geometries of least total cost, :math:`\\sum_i \\min_{k \\in \\text{set}} c_{ki}`, the best first."""
    single = cost.float()
    size = len(single)
    sets = single.sum(-1).argsort(stable=True)[: size if first is None else first, None]
    sets_by_size = [sets]
    for count in range(2, most + 1):
        if not len(sets):  # fewer geometries than bodies
            sets_by_size.append(sets.new_zeros(0, count))
            continue
        least = single[sets].amin(1)
        grown = torch.stack([torch.minimum(row, single).sum(-1) for row in least])
        place = grown.flatten().topk(min(5 * MAX_SETS, grown.numel()), largest=False).indices
        candidates = torch.cat([sets[place // size], (place % size)[:, None]], dim=-1).sort(-1).values
        candidates = candidates[(candidates.diff(dim=-1) > 0).all(-1)]
        different = list(dict.fromkeys(map(tuple, candidates.tolist())))[:MAX_SETS]
        sets = torch.tensor(different, dtype=torch.long, device=cost.device).view(-1, count)
        sets_by_size.append(sets)
    return sets_by_size


def select_distinct(view: View, starts: Starts) -> Starts:
    """Up to ``MAX_STARTS`` starts that differ, the cheapest first, with enough matches in every body."""
    count = starts.fundamentals.shape[-3]
    member = one_hot(starts.labels, count)
    cost = (rough_cost(view, starts.fundamentals) * member).sum((-2, -1)) + POOL_CUT_COST * view.links.cut_weight(member)
    cost = torch.where(member.sum(-1).amin(-1) >= MIN_BODY_MATCHES, cost, torch.inf)
    order = cost.argsort(stable=True)
    order = order[cost[order].isfinite()]
    flat = member[order].float().flatten(0, 1)
    shared = (flat @ flat.mT).unflatten(0, (-1, count)).unflatten(-1, (-1, count))
    alike = (shared.amax(1).sum(-1) > MAX_LABEL_OVERLAP * flat.shape[-1]).tolist()
    selected: list[int] = []
    for index in range(len(order)):
        if len(selected) < MAX_STARTS and not any(alike[other][index] for other in selected):
            selected.append(index)
    return Starts(starts.labels[order[selected]], starts.fundamentals[order[selected]])


# ----------------------------------------------------------------------------------------------------------------------
# Labels and epipolar geometries in turns, from many starts at once.


@dataclass(frozen=True)
class Candidate:
    """A segmentation into bodies."""

    energy: float  # its cost
    labels: Tensor  # ``(n,)`` from 0
    fundamentals: Tensor  # ``(K, 3, 3)``


def descend_starts(view: View, starts: Sequence[Starts]) -> dict[int, list[Candidate]]:
    """The segmentations that the starts lead to, by their number of bodies, the cheapest first."""
    device = view.x1.device
    bodies = torch.cat([torch.full((len(s.labels),), s.fundamentals.shape[1], device=device) for s in starts])
    width = int(bodies.max()) if len(bodies) else 1
    present = torch.arange(width, device=device) < bodies[:, None]
    # only bodies that exist are fitted; the others stay 0, at infinite cost
    rows = present.flatten().nonzero().flatten()
    geometry = torch.cat([s.fundamentals.flatten(0, 1) for s in starts])

    def turn(noise: float, member: Tensor) -> Tensor:
        full = torch.full((present.numel(), len(view.x1)), torch.inf, dtype=torch.float32, device=device)
        full[rows] = rough_cost(view, geometry, noise * DESCENT_NOISE_PIXELS).float()
        return mean_field(full.unflatten(0, present.shape), view.links, POOL_CUT_COST, NUM_DESCENT_LABEL_UPDATES, member)

    member = torch.cat([one_hot(s.labels, width) for s in starts]).float()
    for noise in DESCENT_SCHEDULE:
        member = turn(noise, member)
        weight = member.flatten(0, 1)[rows].double()
        geometry = descend(geometry, view.x1, view.x2, weight, DESCENT_FIT_SCALE_PIXELS * view.pixel, steps=2)
    member = turn(1.0, member)
    labels = member.masked_fill(~present[..., None], -1.0).argmax(1)
    hard = one_hot(labels, width)
    fundamentals = geometry.new_zeros(present.numel(), 3, 3)
    fundamentals[rows] = geometry
    fundamentals = fundamentals.unflatten(0, present.shape)
    total = energy(view, fundamentals, hard)
    sound = ~((hard.sum(-1) < MIN_BODY_MATCHES) & present).any(-1)
    candidates: dict[int, list[Candidate]] = {}
    for count in sorted({s.fundamentals.shape[1] for s in starts}):
        these = ((bodies == count) & sound).nonzero().flatten()
        these = these[total[these].argsort(stable=True)]
        candidates[count] = [Candidate(float(total[i]), labels[i], fundamentals[i, :count]) for i in these.tolist()]
    return candidates


def search(view: View, counts: Sequence[int], generator: torch.Generator | None, num_starts: int) -> dict[int, list[Candidate]]:
    """Segmentations of matches, without outliers, into each number of bodies, the cheapest first; none where no start had so many
    bodies of enough matches."""
    flows = sorted({max(2, count + more) for count in counts for more in (0, 1)})
    plan = torch.tensor(flows, device=view.x1.device).repeat(num_starts if len(flows) > 2 else 2 * num_starts)
    labels = affine_flows(view.x1, view.x2, view.links, plan, MIN_FLOW_NOISE_PIXELS * view.pixel, generator)
    pool = fit_pool(view, torch.cat([one_hot(labels, int(plan.max())).flatten(0, 1), torch.ones_like(view.x1[None, :, 0])]))
    cost = rough_cost(view, pool)
    # each match's own and those of its neighbours, by their links
    cost = (cost + view.links.pull(cost)) / (1 + view.links.weight.sum(-1))
    sets = best_sets(cost, max(counts))
    starts = []
    for count in counts:
        chosen = sets[count - 1][: 8 * MAX_STARTS]
        starts.append(Starts(cost[chosen].argmin(1), pool[chosen]))
        starts += [fit_labellings(view, labels[plan == count], count)] if count in flows else []
    return descend_starts(view, [select_distinct(view, start) for start in starts])


# ----------------------------------------------------------------------------------------------------------------------
# Segmentations by geometry alone, from samples of seven matches: bodies that interleave, outliers among them.


BLOCK = 1024
"""Geometries scored at a time, which stay in the cache."""


def search_samples(
    view: View, counts: Sequence[int], generator: torch.Generator | None, max_samples: int
) -> dict[int, list[Candidate]]:
    """Segmentations into each number of bodies, the cheapest first."""
    pool = _pool(view, min(counts), max(counts), generator, max_samples)
    cost = rough_cost(view, pool)
    sets = best_sets(cost, max(counts), NUM_FIRST_GEOMETRIES)
    chosen = [sets[count - 1][:NUM_DESCENDED_SETS] for count in counts if count <= len(pool)]
    candidates = descend_starts(view, [Starts(cost[some].argmin(1), pool[some]) for some in chosen]) if chosen else {}
    return {count: _rank_candidates(view, candidates.get(count, [])) for count in counts}


def _rank_candidates(view: View, candidates: list[Candidate]) -> list[Candidate]:
    """The candidates with enough inliers in every body, by their cost if what is far from all bodies is in none."""
    if not candidates:
        return []
    fundamentals = torch.stack([candidate.fundamentals for candidate in candidates])
    square = final_cost(view, fundamentals)
    member = one_hot(square.argmin(1), square.shape[1]) * (square < ENERGY_MAX_SQUARED_DISTANCE)
    inliers = member.sum(-1)
    total = energy(view, fundamentals, member) + ENERGY_MAX_SQUARED_DISTANCE * (len(view.x1) - inliers.sum(-1))
    order = total.argsort(stable=True)
    order = order[inliers[order].amin(-1) >= MIN_BODY_MATCHES]
    if not len(order):
        return []
    # between numbers of bodies only distances count: parallax tells true bodies from spurious ones less well
    total = total - total[order[0]] + square[order].amin(1).sum(-1).min()
    return [Candidate(float(total[i]), candidates[i].labels, candidates[i].fundamentals) for i in order.tolist()]


def _remove_duplicates(view: View, pool: Tensor) -> Tensor:
    """Those of the geometries that not many of the same matches agree with, the cheapest first."""
    cost = rough_cost(view, pool)
    order = cost.sum(-1).argsort(stable=True)
    near = (cost[order] < MAX_SQUARED_DISTANCE).float()
    shared, size = near @ near.mT, near.sum(-1)
    alike = shared > MAX_SUPPORT_OVERLAP * (size[:, None] + size - shared)
    return pool[order[~alike.triu(1).any(0)]]


def _pool(view: View, least: int, most: int, generator: torch.Generator | None, max_samples: int) -> Tensor:
    """Geometries ``(P, 3, 3)``: of samples from all matches, then from those that sets of one, two, ... leave unexplained."""
    left = torch.ones_like(view.x1[None, :, 0])
    pool = view.x1.new_zeros(0, 3, 3)
    last = ENERGY_MAX_SQUARED_DISTANCE * len(view.x1)
    for count in range(1, most + 1):
        pool = _remove_duplicates(
            view, torch.cat([pool, *(_sample_geometries(view, open_, len(left), generator, max_samples) for open_ in left)])
        )
        if count == most or len(pool) < count:
            break
        cost = rough_cost(view, pool)
        sets = best_sets(cost, count, NUM_FIRST_GEOMETRIES)[-1][:NUM_PARTIAL_SETS]
        total = float(final_cost(view, pool[sets]).amin(1).sum(-1).min())
        if count > least and last - total < MIN_BODY_GAIN * len(view.x1) ** 0.5:
            break
        last = total
        left = (cost[sets].amin(1) >= MAX_SQUARED_DISTANCE).double()
        left = left[left.sum(-1) > MIN_BODY_MATCHES]
    return pool


def _sample_geometries(view: View, weight: Tensor, parts: int, generator: torch.Generator | None, max_samples: int) -> Tensor:
    """Geometries of the best samples of the matches with weights ``(n,)``, descended; this is one of several parts of the work."""
    x1, x2, single = view.x1.float(), view.x2.float(), weight.float()
    best, votes = view.x1.new_zeros(0, 3, 3), single.new_zeros(0)
    drawn, needed, scale = 0, 1.0, SAMPLE_DISTANCE_PIXELS * view.pixel
    while drawn < min(needed, max_samples / parts):
        geometries, valid = sample_fundamentals(view.x1, view.x2, weight[None], SAMPLES_AT_ONCE // parts, generator)
        drawn += SAMPLES_AT_ONCE // parts
        geometries = geometries[valid]
        # what the matches near each geometry count together
        near = [1 - sampson_squared(part, x1, x2) / scale**2 for part in geometries.float().split(BLOCK)]
        totals = [part.clamp_(min=0) @ single for part in near]
        best, votes = torch.cat([best, geometries]), torch.cat([votes, *totals])
        votes, place = votes.topk(min(NUM_DESCENDED_SAMPLES // parts, len(votes)))
        best = best[place]
        share = float(votes[0] / single.sum()) if len(votes) else 0.0
        needed = NUM_PURE_SAMPLES / max(share, 0.1) ** 7
    for scale in SAMPLE_FIT_SCALES_PIXELS:
        best = descend(best, view.x1, view.x2, weight.expand(len(best), -1), scale * view.pixel)
    return best
