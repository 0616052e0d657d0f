"""Nonlinear least squares by Levenberg-Marquardt, for a block of problems at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from torch.autograd import grad

CONVERGED = 1e-9  # relative decrease of the cost
LEAST = 1e-12  # damping
NEAR = 1e-3  # length of a step, of motions of norm 1, that ends near the minimum


class Minimand(Protocol):
    """A block of least squares problems in the entries of motions."""

    def parts(self, theta: Tensor) -> tuple[Tensor, ...]:
        """The parts ``(b, *shape)`` of parameters ``(b, p)``, each of any scale."""
        ...

    def normal_equations(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cost ``(b,)``, gradient ``(b, p)`` and Gauss-Newton matrix ``(b, p, p)``."""
        ...

    def subset(self, keep: Tensor) -> Minimand:
        """Only some of the problems."""
        ...


class Minimum(NamedTuple):
    """Where a block of least squares problems ended."""

    theta: Tensor
    """``(b, p)`` parameters."""
    cost: Tensor
    """``(b,)``."""
    matrix: Tensor
    """``(b, p, p)`` of Gauss and Newton."""


def flattened(parts: Sequence[Tensor]) -> Tensor:
    """All entries of motions ``(b, ...)``, part after part, ``(b, p)``."""
    return torch.cat([part.flatten(1) for part in parts], dim=-1)


def parts_of(theta: Tensor, shapes: Sequence[torch.Size]) -> tuple[Tensor, ...]:
    """The inverse of :func:`flattened`, for any leading dimensions."""
    sizes = [shape.numel() for shape in shapes]
    return tuple(part.unflatten(-1, shape) for part, shape in zip(theta.split(sizes, -1), shapes, strict=True))


def damped_step(gradient: Tensor, matrix: Tensor, damping: Tensor, free: Tensor | None = None) -> Tensor:
    r"""The step of Levenberg and Marquardt, :math:`(H + \mu\,\mathrm{diag}\,H)^{-1} g`, to be subtracted; 0 where it is not finite.

    Args:
        gradient: ``(b, p)``.
        matrix: ``(b, p, p)``.
        damping: ``(b,)``.
        free: ``(p,)``, 0 for parameters that stay as they are.
    """
    if free is not None:
        gradient, matrix = gradient * free, matrix * free * free[:, None]
    diagonal = matrix.diagonal(dim1=-2, dim2=-1)
    # directions that the matches leave open (scales, a common velocity) must not be divided by zero
    floor = damping[:, None] * (diagonal + 1e-9 * diagonal.amax(-1, keepdim=True) + torch.finfo(matrix.dtype).tiny)
    # a parameter that stays has an equation of its own, step = 0
    floor = floor if free is None else floor + (1 - free)
    factor, _ = torch.linalg.cholesky_ex(matrix + torch.diag_embed(floor))
    step = torch.cholesky_solve(gradient[..., None], factor)[..., 0]
    return torch.where(step.isfinite(), step, torch.zeros_like(step))


def minimize(problem: Minimand, theta: Tensor, iterations: int, *, settle: int = 0, least: float = LEAST) -> Minimum:
    """Parameters, cost and Gauss-Newton matrix at the minimum of every problem of a block, by Levenberg-Marquardt.

    Args:
        problem: says cost and derivatives.
        theta: ``(b, p)`` start.
        iterations: at most so many steps.
        settle: Gauss-Newton steps of all problems at the end.  The last digits of a step depend on how many problems take it,
            and a flat minimum makes more of them than digits; these steps take them back.
        least: damping never falls below; rounding moves the motion along directions that are free by its inverse.
    """
    given = problem
    theta = _unit_parts(problem, theta)
    result: tuple[Tensor, ...] = (theta, *problem.normal_equations(theta))
    damping = torch.full_like(result[1], 1e-3)
    left = torch.arange(theta.shape[0], device=theta.device)
    state, current = result, problem
    for _ in range(iterations):
        state, damping, done = _step(current, state, damping, least)
        # problems that are done leave: the slow ones do not make the others wait.  An accelerator is asked once per step, which
        # launches hundreds of kernels
        result = tuple(whole.index_copy(0, left, part) for whole, part in zip(result, state, strict=True))
        keep = (~done).nonzero().flatten()
        if not len(keep):
            break
        if len(keep) < len(left):
            left, damping, current = left[keep], damping[keep], current.subset(keep)
            state = tuple(part[keep] for part in state)
    for _ in range(settle):
        result = _settled(given, result, least)
    theta, cost, _, matrix = result
    return Minimum(theta, cost, matrix)


def _step(problem: Minimand, state: tuple[Tensor, ...], damping: Tensor, least: float) -> tuple[tuple[Tensor, ...], Tensor, Tensor]:
    """One damped step of every problem: the new state, the new damping, and which problems are done."""
    theta, cost, gradient, matrix = state
    step = damped_step(gradient, matrix, damping)
    trial = _unit_parts(problem, theta - step)
    fresh = (trial, *problem.normal_equations(trial))
    better = fresh[1] < cost
    # a problem is done when it gains nothing any more, does not move, or finds no way down even by the shortest steps
    gained = torch.where(better, cost - fresh[1], torch.inf) <= CONVERGED * cost
    done = gained | (step.abs().amax(-1) < 1e-13) | (~better & (damping > 1e6)) | ~cost.isfinite()
    damping = torch.where(better, (damping * 0.1).clamp(min=least), damping * 8)
    chosen = tuple(torch.where(better[(..., *([None] * (new.ndim - 1)))], new, old) for new, old in zip(fresh, state, strict=True))
    return chosen, damping, done


def _settled(problem: Minimand, state: tuple[Tensor, ...], least: float) -> tuple[Tensor, ...]:
    """One step of every problem that is near its minimum, whatever rounding makes of the cost."""
    theta, cost, gradient, matrix = state
    step = damped_step(gradient, matrix, torch.full_like(cost, least))
    trial = _unit_parts(problem, theta - step)
    fresh = (trial, *problem.normal_equations(trial))
    good = (step.abs().amax(-1) < NEAR) & (fresh[1] <= cost * (1 + CONVERGED))
    return tuple(torch.where(good[(..., *([None] * (new.ndim - 1)))], new, old) for new, old in zip(fresh, state, strict=True))


def _unit_parts(problem: Minimand, theta: Tensor) -> Tensor:
    """Every part of the motion with norm 1, which changes nothing but the size of the numbers."""
    scaled = [part.flatten(1) / part.flatten(1).norm(dim=-1, keepdim=True).clamp(min=1e-30) for part in problem.parts(theta)]
    return torch.cat(scaled, dim=-1)


# ----------------------------------------------------------------------------------------------------------------------
# Derivatives of batched functions along tangents: how changes of the parameters carry forward to the values.


def derivatives(function: Callable[[Tensor], Tensor], theta: Tensor, tangents: Tensor) -> tuple[Tensor, Tensor]:
    """Value and directional derivatives by one pass over all tangents.

    By reverse mode alone: what it pulls back is linear in the cotangent, and pulling back through that carries tangents forward.
    Dual numbers would do it in one pass, but torch's first product of one with a constant imports its compiler, as does the first
    backward pass of ``torch.func``, and gradients given to autograd import sympy: that takes longer (1.5 s, 0.5 s) than most verbs.
    Only sums are differentiated here.

    Args:
        function: ``(k, *batch, p)`` to ``(k, *batch, rows)``, each problem of each k by itself.  Tensors that were made in
            inference mode cannot take part.
        theta: ``(*batch, p)``.
        tangents: ``(k, *batch, p)``.

    Returns:
        ``(*batch, rows)`` and ``(*batch, k, rows)``.

    Example:
        >>> import torch
        >>> derivatives(torch.square, torch.tensor([[3.0, 4.0]]), torch.tensor([[[1.0, 0.5]]]))[1].tolist()
        [[[6.0, 4.0]]]
    """
    count = len(tangents)
    with torch.inference_mode(False), torch.enable_grad():
        several = theta.detach().expand(tangents.shape).clone().requires_grad_()
        values = function(several)
        rows = values.shape[-1]
        if not values.requires_grad:
            return values[0], torch.zeros_like(values).movedim(0, -2)
        if rows <= count:  # fewer values than tangents: one pass back, each copy of theta for one value
            slopes = grad(values[:rows].diagonal(dim1=0, dim2=-1).sum(), several)[0][:rows]
            return values[0].detach(), torch.einsum("k...p,r...p->...kr", tangents, slopes)
        cotangents = torch.zeros_like(values, requires_grad=True)
        pulled = grad((values * cotangents).sum(), several, create_graph=True)[0]
        pushed = grad((pulled * tangents.detach().clone()).sum(), cotangents)[0]
    return values[0].detach(), pushed.movedim(0, -2)


def jacobian(function: Callable[[Tensor], Tensor], theta: Tensor) -> tuple[Tensor, Tensor]:
    """Value ``(*batch, rows)`` and transposed Jacobian ``(*batch, p, rows)`` of a function of ``theta (*batch, p)``."""
    count = theta.shape[-1]
    tangents = torch.eye(count, dtype=theta.dtype, device=theta.device).reshape(count, *[1] * (theta.ndim - 1), count)
    return derivatives(function, theta, tangents.expand(count, *theta.shape))


def by_match(
    function: Callable[[Tensor, tuple[Tensor, ...], tuple[Tensor, ...]], Tensor],
    theta: Tensor,
    problems: tuple[Tensor, ...],
    matches: tuple[Tensor, ...],
) -> tuple[Tensor, Tensor]:
    """Value and transposed Jacobian of a function of the matches: a few values per match, many parameters.

    Every match gets its own copy of the parameters, so that one backward pass per value serves all matches.

    Args:
        function: parameters ``(b, n, p)``, what belongs to a problem ``(b, n, ...)`` and to a match ``(b, n, 1, ...)`` to
            ``(b, n, 1, c)``.
        theta: ``(b, p)``.
        problems: ``(b, ...)`` each.
        matches: ``(b, n, ...)`` each.

    Returns:
        ``(b, n c)`` and ``(b, p, n c)``.

    Example:
        >>> import torch
        >>> x = torch.tensor([[1.0, 2.0]])
        >>> by_match(lambda t, p, m: t[..., None, :] * m[0][..., None], torch.tensor([[3.0]]), (), (x,))[1].tolist()
        [[[1.0, 2.0]]]
    """
    count = matches[0].shape[1]
    # copies: what was made in inference mode may not be saved for a backward pass
    with torch.inference_mode(False), torch.enable_grad():
        copies = theta.detach()[:, None].repeat(1, count, 1).requires_grad_()
        shared = tuple(x.detach().clone()[:, None].expand(-1, count, *x.shape[1:]) for x in problems)
        value = function(copies, shared, tuple(x.detach().clone().unsqueeze(2) for x in matches))[..., 0, :]
        slopes = [grad(column.sum(), copies, retain_graph=True)[0] for column in value.unbind(-1)]
    return value.detach().flatten(1), torch.stack(slopes, dim=2).flatten(1, 2).mT


def normalized_derivative(value: Tensor, slope: Tensor) -> tuple[Tensor, Tensor]:
    r""":math:`v / |v|` and its transposed Jacobian, from values ``(*batch, rows)`` and their own ``(*batch, p, rows)``.

    Values that are 0 stay so.

    Example:
        >>> import torch
        >>> value, slope = normalized_derivative(torch.tensor([0.0, 2.0]), torch.eye(2))
        >>> value.tolist(), slope.tolist()
        ([0.0, 1.0], [[0.5, 0.0], [0.0, 0.0]])
    """
    norm = value.norm(dim=-1, keepdim=True)
    norm = norm.where(norm > 0, 1.0)
    value = value / norm
    # across the value: along it only the scale changes
    return value, (slope - (slope @ value[..., None]) * value[..., None, :]) / norm[..., None]
