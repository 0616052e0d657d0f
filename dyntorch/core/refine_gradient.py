"""How the minimum that refinement finds follows the matches, their weights and what normalizes them."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from dyntorch.core.invariant import Invariant
from dyntorch.core.matches import Matches
from dyntorch.core.normalize import relative
from dyntorch.core.outcome import Notice, NoticeCode, notices
from dyntorch.core.residual import whitened_residual
from dyntorch.core.solution import Solution
from dyntorch.numerics.blocks import map_blocks
from dyntorch.numerics.implicit import flat_directions, follow_minimum
from dyntorch.numerics.least_squares import Minimum, parts_of
from dyntorch.numerics.nullspace import spectrum

GRADIENT_BLOCK = 1 << 21
"""Numbers of the matches of all copies of a block of problems, whose Hessian needs one copy per parameter: 16 MB."""


UNFINISHED_DECREASE = 1e-6
"""Share of the cost that the next step would still take above which gradients are not those of a minimum.  Homography tensors (60
matches, 0.5 px) after 1, 2 and 3 steps: 2e-5, 9e-9, 7e-12, with gradients off by 1e-4, 1e-6, 2e-8."""
UNFINISHED_LENGTH = 1e-6
"""Least length of that step, of parameters of norm 1: of exact matches the cost is all rounding."""


class RefineNotice(NoticeCode):
    """What limits a refinement."""

    UNFINISHED = (
        "unfinished",
        "the descent ended before the minimum: its next step would lower the cost by {value:.1g} of it, and gradients are those of "
        "a minimum that was not reached; raise {arg:iterations}",
    )
    """Refinement took all its steps, and gradients were wanted."""


def needs_gradient(solution: Solution, data: Matches) -> bool:
    """Whether gradients are recorded of what refinement depends on."""
    given = *data.views, data.weights, *solution.normalization.transforms
    return torch.is_grad_enabled() and any(x.requires_grad for x in given)


def differentiable_minimum(
    solution: Solution, data: Matches, shapes: tuple[torch.Size, ...], found: Minimum
) -> tuple[Tensor, Tensor]:
    """Parameters ``(b, p)`` of the minimum and its cost ``(b,)``, in the unit of the matches, with their derivatives."""
    invariant, theta = solution.invariant, found.theta[0]
    count, labelled = len(data.views), data.static is not None
    cost = _cost(invariant, shapes, count, labelled)
    free = flat_directions(found.terms[1], theta.shape[-1] - invariant.dof)
    flat = *data.views, data.weights, *solution.normalization.transforms, *((data.static,) if data.static is not None else ())
    numbers = sum(x.numel() for x in data.views) * theta.shape[-1]
    size = max(1, GRADIENT_BLOCK * len(theta) // max(1, numbers))

    def block(theta: Tensor, free: Tensor, *flat: Tensor) -> tuple[Tensor, Tensor]:
        at = follow_minimum(cost, theta, free, *flat)
        return at, cost(at, *flat)

    return map_blocks(block, theta, free, *flat, size=size)


def _cost(invariant: Invariant, shapes: tuple[torch.Size, ...], count: int, labelled: bool) -> Callable[..., Tensor]:
    """What refinement minimizes, as a function of parameters, views, weights, transforms and labels, one after the other."""

    def cost(theta: Tensor, *flat: Tensor) -> Tensor:
        views, weights, transforms = flat[:count], flat[count], flat[count + 1 : 2 * count + 1]
        label = flat[-1] if labelled else torch.zeros_like(weights, dtype=torch.bool)
        frames = tuple(t.reshape(t.shape[0], *t.shape[-2:]) for t in transforms)
        moved = tuple(p.move(x, t) for p, x, t in zip(invariant.primitives, views, frames, strict=True))
        scales, unit = relative([t[:, 0, 0] for t in frames])
        base, motion = invariant.normalize(transforms), parts_of(theta, shapes)
        total = whitened_residual(base, motion, moved, scales).square().sum(-1) * torch.where(label == 0, weights, 0.0)
        for free in range(1, (2 if label.dtype == torch.bool else invariant.within) if labelled else 1):
            smaller = base.confine(free)
            rest = (
                base.whitened_static_residual(motion, moved, scales)
                if smaller is None
                else whitened_residual(smaller, motion, moved, scales)
            )
            total = total + rest.square().sum(-1) * torch.where(label == free, weights, 0.0)
        return total.sum(-1) / unit.square()

    return cost


def unfinished_notices(found: Minimum, dof: int, batch: tuple[int, ...]) -> list[Notice]:
    """A notice for every problem whose next step would still be long and lower its cost."""
    gradient, matrix = found.terms
    values, vectors = spectrum(matrix)
    count = min(dof, values.shape[-1])
    values = values[..., -count:].clamp(min=torch.finfo(values.dtype).tiny)
    along = (vectors[..., -count:].mT @ gradient[..., None])[..., 0]
    share = (along.square() / values).sum(-1) / found.cost.clamp(min=torch.finfo(values.dtype).tiny)
    open_ = (share > UNFINISHED_DECREASE) & ((along / values).norm(dim=-1) > UNFINISHED_LENGTH) & found.cost.isfinite()
    return notices(RefineNotice.UNFINISHED, share, open_, batch)
