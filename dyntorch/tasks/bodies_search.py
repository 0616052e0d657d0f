"""Segmentations of matches of which nearly all belong to some body: flows, a pool of geometries, choices among them, descent."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from dyntorch.tasks.bodies_descent import Candidate, descended
from dyntorch.tasks.bodies_energy import View
from dyntorch.tasks.bodies_flows import affine_flows
from dyntorch.tasks.bodies_matrix import matrix_pairs
from dyntorch.tasks.bodies_pool import best_sets, distinct, fitted, one_hot, pool_of, rough_cost, set_starts, smoothed

RUNS = 16
"""Runs of flows for each number of flows."""
FLOW_NOISE = 0.5
"""Least standard deviation of a flow, pixels."""


def search(
    view: View, counts: Sequence[int], generator: torch.Generator | None, extra: Sequence[Tensor] = ()
) -> dict[int, list[Candidate]]:
    """Segmentations into each number of bodies, the cheapest first.

    Args:
        view: matches, without outliers.
        counts: numbers of bodies.
        generator: source of all randomness.
        extra: further labellings ``(n,)`` from 0 to start from.

    Returns:
        Candidates for each number; none where no start had so many bodies of enough matches.
    """
    flows = sorted({max(2, count + more) for count in counts for more in (0, 1)})
    plan = torch.tensor(flows, device=view.x1.device).repeat(RUNS if len(flows) > 2 else 2 * RUNS)
    labels = affine_flows(view.x1, view.x2, view.links, plan, FLOW_NOISE * view.pixel, generator)
    widths = [(labels, int(plan.max())), *((x[None], int(x.max()) + 1) for x in extra), (torch.zeros_like(labels[:1]), 1)]
    pool = pool_of(view, torch.cat([one_hot(x, width).flatten(0, 1) for x, width in widths]))
    if max(counts) > 1:
        # linear: the search improves it, and its weights would take longer than all flows
        pool = torch.cat([pool, matrix_pairs(view, torch.ones_like(view.x1[None, :, 0]), rounds=0)])
    cost = smoothed(rough_cost(view, pool), view)
    sets = best_sets(cost, max(counts))
    starts = []
    for count in counts:
        starts.append(set_starts(pool, cost, sets[count - 1]))
        groups = [labels[plan == count], *(x[None] for x in extra if int(x.max()) + 1 == count)]
        starts += [fitted(view, x, count) for x in groups if len(x)]
    return descended(view, [distinct(view, start) for start in starts])
