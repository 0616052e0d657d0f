"""Nonlinear least squares by Levenberg-Marquardt, for a block of problems at once."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

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


def minimize(
    problem: Minimand, theta: Tensor, iterations: int, *, settle: int = 0, least: float = LEAST
) -> tuple[Tensor, Tensor, Tensor]:
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
    return result[0], result[1], result[3]


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
