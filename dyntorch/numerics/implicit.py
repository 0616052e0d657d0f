r"""The derivative of a minimum by what is minimized, of every order: the implicit function theorem.

Where :math:`\nabla_\theta C(\theta, y) = 0`,

.. math:: \frac{d\theta}{dy} = -(\nabla^2_{\theta\theta} C)^{-1}\, \nabla^2_{\theta y} C

whatever way the minimum was found, and from wherever.  Directions in which the cost never changes (scales, a common frame) are
held still; what does not depend on them has the derivative that it has.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd import grad

from dyntorch.numerics.blocks import select
from dyntorch.numerics.nullspace import spectrum

Cost = Callable[..., Tensor]
HESSIAN_BLOCK = 1 << 21
"""Numbers of the data that are differentiated at once for the Hessian, 16 MB: what comes between takes some twenty times that."""


def follow_minimum(cost: Cost, theta: Tensor, free: Tensor, *data: Tensor) -> Tensor:
    """A minimum as a function of the data: its value, with derivatives of every order by autograd. cost ``(b, p)``, theta
    ``(b, p)``, free ``(b, p, g)`` -> ``(b, p)``."""
    found: Tensor = _Minimum.apply(cost, theta.detach(), free.detach(), *data)  # type: ignore[no-untyped-call]
    return found


def flat_directions(matrix: Tensor, count: int) -> Tensor:
    """The eigenvectors ``(b, p, count)`` of the smallest eigenvalues of Gauss-Newton matrices ``(b, p, p)``."""
    return spectrum(matrix.detach())[1][..., : max(0, count)]


class _Minimum(torch.autograd.Function):
    """The parameters as they are, and how they follow the data."""

    @staticmethod
    def forward(cost: Cost, theta: Tensor, free: Tensor, *data: Tensor) -> Tensor:
        return theta.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.cost = inputs[0]
        ctx.save_for_backward(output, *inputs[2:])

    @staticmethod
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        again = torch.is_grad_enabled()
        theta, free, *data = ctx.saved_tensors
        wanted = ctx.needs_input_grad[3:]
        with torch.enable_grad():
            # aliases: the theta of this minimum is one variable, what it depends on another
            theta = theta.view_as(theta) if again else theta.detach().requires_grad_()
            given = [x.view_as(x) if again else x.detach() for x in data]
            hessian = _hessian(ctx.cost, theta, given, again)
            sound = hessian.detach().flatten(1).isfinite().all(-1)
            right = _solve_sound(hessian, free, cotangent, sound)
            variables = [x if again else x.requires_grad_() for x, want in zip(given, wanted, strict=True) if want]
            (slope,) = grad(ctx.cost(theta, *given).sum(), theta, create_graph=True)
            found = grad(slope, variables, -right, create_graph=again, allow_unused=True)
        parts = iter(torch.zeros_like(x) if part is None else part for x, part in zip(variables, found, strict=True))
        return None, None, None, *(select(sound, next(parts), 0.0) if want else None for want in wanted)


def _hessian(cost: Cost, theta: Tensor, data: list[Tensor], again: bool) -> Tensor:
    """``(b, p, p)``: several copies of all problems at once, each of which gives one row."""
    problems, size = theta.shape
    at_once = max(1, min(size, HESSIAN_BLOCK // max(1, sum(x.numel() for x in data))))
    rows = []
    for start in range(0, size, at_once):
        count = min(at_once, size - start)
        several = theta.expand(count, problems, size).flatten(0, 1)
        copies = [x.expand(count, *x.shape).flatten(0, 1) for x in data]
        (slope,) = grad(cost(several, *copies).sum(), several, create_graph=True)
        chosen = slope.unflatten(0, (count, problems))[..., start : start + count].diagonal(dim1=0, dim2=2)
        rows.append(grad(chosen.sum(), several, create_graph=again)[0].unflatten(0, (count, problems)))
    return torch.cat(rows).movedim(0, 1)


def _solve_sound(hessian: Tensor, free: Tensor, right: Tensor, sound: Tensor) -> Tensor:
    """The solution ``(b, p)`` that does not move along ``free``; 0 where there is none, or the Hessian is not ``sound (b,)``."""
    eye = torch.eye(hessian.shape[-1], dtype=hessian.dtype, device=hessian.device)
    matrix = torch.where(sound[:, None, None], 0.5 * (hessian + hessian.mT), eye)
    size = matrix.detach().abs().amax((-2, -1), keepdim=True)
    size = torch.where(size > 0, size, 1.0)
    across = right - (free @ (free.mT @ right[..., None]))[..., 0]
    found, failed = torch.linalg.solve_ex(matrix / size + free @ free.mT, across[..., None])
    usable = (sound & (failed == 0))[:, None]
    return torch.where(usable, found[..., 0] / size[..., 0], 0.0)
