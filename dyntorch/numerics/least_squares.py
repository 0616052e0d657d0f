"""Nonlinear least squares by Levenberg-Marquardt, for a block of problems at once.

A problem only accumulates: what it costs, and the step that its normal equations give.  What is done with that, whether a step is
taken, how much the next one is damped, which problems are done, is decided here, once for all.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import grad

from dyntorch.numerics.blocks import each, replace_problems, select, select_problems
from dyntorch.numerics.nullspace import spectrum

SHORT = 1e-13  # change of parameters of norm 1 that is rounding

Tensors = tuple[Tensor, ...]

DAMPING_DECREASE = 0.1  # factor of the damping after a step that lowers the cost
SETTLING_LENGTH = 1e-3  # of a step, of parameters of norm 1, that ends near the minimum


@dataclass(frozen=True)
class LeastSquaresOptions:
    """How a descent damps its steps and when it ends.  Dampings and costs are relative, they have no unit."""

    iterations: int = 30
    """Steps at most, the refused ones included."""
    damping: float = 1e-3
    """Of the first step, as a multiple of the diagonal of the Gauss-Newton matrix."""
    increase: float = 8.0
    """Factor of the damping after one that does not and is refused."""
    least_damping: float = 1e-12
    """Damping never falls below; rounding moves the parameters along directions that are free by its inverse."""
    stuck_damping: float = 1e6
    """A problem is done where a step of more damping is refused: there is no way down even by the shortest steps."""
    tolerance: float | None = 1e-9
    """A problem is done where a step lowers its cost by this share at most.  None: all problems take all steps."""
    settling_steps: int = 0
    """Gauss-Newton steps of all problems at the end.  The last digits of a step depend on how many problems take it, and a flat
    minimum makes more of them than digits; these steps take them back."""

    def rules(self) -> tuple[float, ...]:
        """In the order in which the kernel takes them."""
        steps = self.damping, self.increase, DAMPING_DECREASE, self.least_damping, self.stuck_damping
        return *steps, self.tolerance or 0.0, SHORT


class Iterate(NamedTuple):
    """Where a block of problems is: parameters ``(b, ...)`` each, cost ``(b,)``, and what else is known there and the next step
    takes, ``(b, ...)`` each.  A problem whose cost is not finite stays where it is."""

    theta: Tensors
    cost: Tensor
    terms: Tensors

    def where(self, chosen: Tensor, other: Iterate) -> Iterate:
        """This one where ``chosen (b,)``, the other elsewhere."""
        return select_problems(chosen, self, other)


class Minimum(NamedTuple):
    """Where a descent ended, as :class:`Iterate` says it, after ``steps (b,)``, the refused ones included."""

    theta: Tensors
    cost: Tensor
    terms: Tensors
    steps: Tensor


class LeastSquares(ABC):
    """A block of least squares problems."""

    @abstractmethod
    def evaluate(self, theta: Tensors) -> Iterate:
        """The cost of parameters, and what of it the next step takes; in the normal form that the problem wants them in."""

    @abstractmethod
    def step(self, at: Iterate, damping: Tensor) -> Tensors:
        """The step ``(b, ...)`` of Levenberg and Marquardt with damping ``(b,)``, most often :func:`damped_step`."""

    def retract(self, theta: Tensors, step: Tensors) -> Tensors:
        """The parameters after a step."""
        return tuple([part - move for part, move in zip(theta, step, strict=True)])

    def advance(self, at: Iterate, step: Tensors) -> Iterate:
        """The place after a step."""
        return self.evaluate(self.retract(at.theta, step))

    def has_converged(self, at: Iterate, fresh: Iterate, step: Tensors, tolerance: float) -> Tensor | None:
        """Problems ``(b,)`` that the step from one place to another shows to be done, whatever the cost says."""
        return None

    def subset(self, keep: Tensor) -> LeastSquares:
        """Only some of the problems; what descends with a tolerance says how."""
        raise NotImplementedError(f"{type(self).__name__} has no subset: descend with tolerance=None")


class NormalEquations(LeastSquares):
    """Least squares in one vector ``(b, p)`` of parameters, whose derivatives come with the cost."""

    free: Tensor | None = None
    """``(p,)``, 0 for parameters that stay as they are; None: all vary."""

    @abstractmethod
    def normal_equations(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cost ``(b,)``, gradient ``(b, p)`` and Gauss-Newton matrix ``(b, p, p)``."""

    def parts(self, theta: Tensor) -> Tensors:
        """The parts ``(b, *shape)`` of parameters ``(b, p)`` that may have any scale: each is kept at norm 1."""
        return (theta,)

    def evaluate(self, theta: Tensors) -> Iterate:
        """At parameters whose parts have norm 1, which changes nothing but the size of the numbers."""
        scaled = [part.flatten(1) / part.flatten(1).norm(dim=-1, keepdim=True).clamp(min=1e-30) for part in self.parts(theta[0])]
        vector = torch.cat(scaled, dim=-1)
        cost, gradient, matrix = self.normal_equations(vector)
        return Iterate((vector,), cost, (gradient, matrix))

    def step(self, at: Iterate, damping: Tensor) -> Tensors:
        """By the normal equations."""
        gradient, matrix = at.terms
        return (damped_step(gradient, matrix, damping, self.free),)

    def has_converged(self, at: Iterate, fresh: Iterate, step: Tensors, tolerance: float) -> Tensor | None:
        """Where nothing moves."""
        return step[0].abs().amax(-1) < SHORT


def flatten_parts(parts: Sequence[Tensor]) -> Tensor:
    """All entries of motions ``(b, ...)``, part after part, ``(b, p)``."""
    return torch.cat([part.flatten(1) for part in parts], dim=-1)


def parts_of(theta: Tensor, shapes: Sequence[torch.Size]) -> tuple[Tensor, ...]:
    """The inverse of :func:`flatten_parts`, for any leading dimensions."""
    sizes = [shape.numel() for shape in shapes]
    return tuple(part.unflatten(-1, shape) for part, shape in zip(theta.split(sizes, -1), shapes, strict=True))


def damped_step(gradient: Tensor, matrix: Tensor, damping: Tensor, free: Tensor | None = None, ridge: float = 0.0) -> Tensor:
    r"""The step of Levenberg and Marquardt, :math:`(H + \mu\,\mathrm{diag}\,H)^{-1} g`, to be subtracted; 0 where it is not
    finite. gradient ``(b, p)``, matrix ``(b, p, p)``, damping ``(b,)``, free ``(p,)``."""
    if free is not None:
        gradient, matrix = gradient * free, matrix * free * free[:, None]
    diagonal = matrix.diagonal(dim1=-2, dim2=-1)
    # directions that the matches leave open (scales, a common velocity) must not be divided by zero
    largest = diagonal.amax(-1, keepdim=True)
    floor = damping[:, None] * (diagonal.add(largest, alpha=1e-9) + torch.finfo(matrix.dtype).tiny)
    floor = floor.add(largest, alpha=ridge) if ridge else floor
    # a parameter that stays has an equation of its own, step = 0
    floor = floor if free is None else floor + (1 - free)
    damped = matrix.clone()
    damped.diagonal(dim1=-2, dim2=-1).add_(floor)
    factor, _ = torch.linalg.cholesky_ex(damped)
    step = torch.cholesky_solve(gradient[..., None], factor)[..., 0]
    return torch.where(step.isfinite(), step, 0.0)


def minimize(problem: LeastSquares, start: Iterate, options: LeastSquaresOptions) -> Minimum:
    """The minimum next to given parameters, of every problem of a block, by Levenberg-Marquardt."""
    at, damping = start, torch.full_like(start.cost, options.damping)
    steps = torch.full_like(start.cost, options.iterations, dtype=torch.long)
    if options.tolerance is None:
        for _ in range(options.iterations):
            at, damping, _ = _take_step(problem, at, damping, options)
    else:
        at = _until_done(problem, at, damping, options, steps)
    for _ in range(options.settling_steps):
        at = _take_final_step(problem, at, options)
    return Minimum(at.theta, at.cost, at.terms, steps)


def _until_done(problem: LeastSquares, start: Iterate, damping: Tensor, options: LeastSquaresOptions, steps: Tensor) -> Iterate:
    """Steps of every problem until it is done; their numbers are written into ``steps``."""
    at, done = start, ~start.cost.isfinite()
    left = torch.arange(done.shape[0], device=done.device)
    for count in range(options.iterations):
        # problems that are done leave: the slow ones do not make the others wait.  An accelerator is asked once per step, which
        # launches hundreds of kernels
        keep = (~done).nonzero()[:, 0]
        if keep.shape != left.shape:
            start = replace_problems(start, left, at)
            steps[left[done]] = count
            left, damping, at, problem = left[keep], damping[keep], each(itemgetter(keep), at), problem.subset(keep)
        if not keep.shape[0]:
            return start
        at, damping, done = _take_step(problem, at, damping, options)
    return at if left.shape == steps.shape else replace_problems(start, left, at)


def _take_step(problem: LeastSquares, at: Iterate, damping: Tensor, options: LeastSquaresOptions) -> tuple[Iterate, Tensor, Tensor]:
    """Where a step of every problem leads, the next damping, and which problems are done (where there is a tolerance)."""
    step = problem.step(at, damping)
    fresh = problem.advance(at, step)
    fall = at.cost - fresh.cost
    done = better = fall > 0
    if options.tolerance is not None:
        done = torch.where(better, fall <= options.tolerance * at.cost, damping > options.stuck_damping)
        finished = problem.has_converged(at, fresh, step, options.tolerance)
        done = done if finished is None else done | finished
    damping = torch.where(better, (damping * DAMPING_DECREASE).clamp(min=options.least_damping), damping * options.increase)
    return fresh.where(better, at), damping, done


def _take_final_step(problem: LeastSquares, at: Iterate, options: LeastSquaresOptions) -> Iterate:
    """One step of every problem that is near its minimum, whatever rounding makes of the cost."""
    step = problem.step(at, torch.full_like(at.cost, options.least_damping))
    fresh = problem.advance(at, step)
    near = step[0].abs().amax(-1) < SETTLING_LENGTH
    return fresh.where(near & (fresh.cost <= at.cost * (1 + (options.tolerance or 0.0))), at)


# ----------------------------------------------------------------------------------------------------------------------
# Derivatives of batched functions along tangents: how changes of the parameters carry forward to the values.


def derivatives(function: Callable[[Tensor], Tensor], theta: Tensor, tangents: Tensor) -> tuple[Tensor, Tensor]:
    """Value and directional derivatives by one pass over all tangents. function ``(k, *batch, p)``, theta ``(*batch, p)``,
    tangents ``(k, *batch, p)`` -> ``(*batch, rows)``."""
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


FEW_COPIES = 1 << 15
"""Numbers of the copies that :func:`by_match` differentiates up to which one pass for all columns takes less time than one each:
six columns of 60 matches 5.9 ms instead of 14, of 400 13 instead of 20, of 2,000 47 instead of 45."""


def by_match(
    function: Callable[[Tensor, tuple[Tensor, ...], tuple[Tensor, ...]], Tensor],
    theta: Tensor,
    problems: tuple[Tensor, ...],
    matches: tuple[Tensor, ...],
) -> tuple[Tensor, Tensor]:
    """Value and transposed Jacobian of a function of the matches: a few values per match, many parameters. function
    ``(b, n, p)``, theta ``(b, p)``, problems ``(b, ...)``, matches ``(b, n, ...)`` -> ``(b, n c)``."""
    count = matches[0].shape[1]
    # copies: what was made in inference mode may not be saved for a backward pass
    with torch.inference_mode(False):
        shared = tuple(x.detach().clone()[:, None].expand(-1, count, *x.shape[1:]) for x in problems)
        single = tuple(x.detach().clone().unsqueeze(2) for x in matches)
        copies = theta.detach()[:, None].repeat(1, count, 1)
        repeats = 1
        if copies.numel() <= FEW_COPIES:  # every column has copies of its own, and all of them one pass back
            with torch.no_grad():
                repeats = function(copies[:, :0], *each(lambda x: x[:, :0], (shared, single))).shape[-1]
        shared, single, copies = each(lambda x: x.repeat(repeats, *[1] * (x.ndim - 1)), (shared, single, copies))
        with torch.enable_grad():
            copies.requires_grad_()
            value = function(copies, shared, single)[..., 0, :].unflatten(0, (repeats, len(theta)))
            columns = value.diagonal(dim1=0, dim2=-1)[None] if repeats > 1 else value[0].movedim(-1, 0)
            slopes = torch.cat([grad(column.sum(), copies, retain_graph=True)[0] for column in columns])
    return value[0].detach().flatten(1), slopes.unflatten(0, (value.shape[-1], len(theta))).movedim(0, 2).flatten(1, 2).mT


def normalized_derivative(value: Tensor, slope: Tensor) -> tuple[Tensor, Tensor]:
    r""":math:`v / |v|` and its transposed Jacobian, from values ``(*batch, rows)`` and their own ``(*batch, p, rows)``."""
    norm = value.norm(dim=-1, keepdim=True)
    norm = norm.where(norm > 0, 1.0)
    value = value / norm
    # across the value: along it only the scale changes
    return value, (slope - (slope @ value[..., None]) * value[..., None, :]) / norm[..., None]


# ----------------------------------------------------------------------------------------------------------------------
# The derivative of a minimum by what is minimized, of every order: where the gradient by theta of the cost C(theta, y) is 0, the
# implicit function theorem says d theta / d y = -(d^2 C / d theta^2)^-1 d^2 C / d theta d y, whatever way the minimum was found.
# Directions in which the cost never changes (scales, a common frame) are held still; what does not depend on them has the
# derivative that it has.


Cost = Callable[..., Tensor]
HESSIAN_BLOCK = 1 << 21
"""Numbers of the data that are differentiated at once for the Hessian, 16 MB: what comes between takes some twenty times that."""


def follow_minimum(cost: Cost, theta: Tensor, free: Tensor, *data: Tensor) -> Tensor:
    """A minimum as a function of the data: its value, with derivatives of every order by autograd. cost ``(b, p)``, theta
    ``(b, p)``, free ``(b, p, g)`` -> ``(b, p)``."""
    minimum: Tensor = _Minimum.apply(cost, theta.detach(), free.detach(), *data)  # type: ignore[no-untyped-call]
    return minimum


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
        create_graph = torch.is_grad_enabled()
        theta, free, *data = ctx.saved_tensors
        wanted = ctx.needs_input_grad[3:]
        with torch.enable_grad():
            # aliases: the theta of this minimum is one variable, what it depends on another
            theta = theta.view_as(theta) if create_graph else theta.detach().requires_grad_()
            given = [x.view_as(x) if create_graph else x.detach() for x in data]
            hessian = _hessian(ctx.cost, theta, given, create_graph)
            sound = hessian.detach().flatten(1).isfinite().all(-1)
            right = _solve_sound(hessian, free, cotangent, sound)
            variables = [x if create_graph else x.requires_grad_() for x, want in zip(given, wanted, strict=True) if want]
            (slope,) = grad(ctx.cost(theta, *given).sum(), theta, create_graph=True)
            gradients = grad(slope, variables, -right, create_graph=create_graph, allow_unused=True)
        parts = iter(torch.zeros_like(x) if part is None else part for x, part in zip(variables, gradients, strict=True))
        return None, None, None, *(select(sound, next(parts), 0.0) if want else None for want in wanted)


def _hessian(cost: Cost, theta: Tensor, data: list[Tensor], create_graph: bool) -> Tensor:
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
        rows.append(grad(chosen.sum(), several, create_graph=create_graph)[0].unflatten(0, (count, problems)))
    return torch.cat(rows).movedim(0, 1)


def _solve_sound(hessian: Tensor, free: Tensor, right: Tensor, sound: Tensor) -> Tensor:
    """The solution ``(b, p)`` that does not move along ``free``; 0 where there is none, or the Hessian is not ``sound (b,)``."""
    eye = torch.eye(hessian.shape[-1], dtype=hessian.dtype, device=hessian.device)
    matrix = torch.where(sound[:, None, None], 0.5 * (hessian + hessian.mT), eye)
    size = matrix.detach().abs().amax((-2, -1), keepdim=True)
    size = torch.where(size > 0, size, 1.0)
    across = right - (free @ (free.mT @ right[..., None]))[..., 0]
    solution, failed = torch.linalg.solve_ex(matrix / size + free @ free.mT, across[..., None])
    usable = (sound & (failed == 0))[:, None]
    return torch.where(usable, solution[..., 0] / size[..., 0], 0.0)
