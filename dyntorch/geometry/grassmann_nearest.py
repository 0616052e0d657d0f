"""The projections of the Grassmann tensor nearest to a given one, and how they follow it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, combinations, product
from math import comb, prod

import torch
from torch import Tensor

from dyntorch.geometry.grassmann import (
    balance_projections,
    candidates,
    check,
    grassmann_derivative,
    grassmann_tensor,
    normalize_tensors,
    rotate_tensors,
    tables,
)
from dyntorch.geometry.homogeneous import unit_vectors
from dyntorch.numerics.blocks import constant, map_blocks
from dyntorch.numerics.least_squares import Iterate, LeastSquares, LeastSquaresOptions, Tensors, minimize

DESCENT = LeastSquaresOptions(increase=10.0, least_damping=0.0, stuck_damping=5e4, tolerance=0.0)
NEWTON = 8
"""Newton's steps at most, in each round."""
NEAR = (1e-2, 1e-4, 1e-7)
"""Length of a step, relative to the projections, at which a round leaves the rest to Newton; the next is for those he fails."""
LAST = 1e-9
"""Length of a relative step of Newton's after which he has converged: the next would be about its square."""
BLOCK = 1 << 18
"""Entries of the derivatives per block of the batch: a (2, 2, 1, 1, 1) takes 14 ms with 1 << 16, 6.2 with 18, 7.4 with 20."""
EQUAL = 1e-12
"""Squared distance below which candidates count as exact, and the first of them is taken."""
STARTS, FAR = 3, 0.02
"""Candidates to start from, where the minimum next to the nearest is farther than ``FAR``.  With noise of 3, 10 and 30 % of the
tensor the first missed the lowest minimum in up to 8, 20 and 38 % of 60 scenes of five motions, all three in up to 2, 5 and 8 %."""


def projections_of(tensor: Tensor, profile: Sequence[int], sizes: Sequence[int]) -> tuple[Tensor, ...]:
    r"""Projections of the Grassmann tensor nearest to T: :math:`\max_M \langle A(M), T \rangle^2 / (|A(M)|^2 |T|^2)`."""
    check(tensor, profile, sizes)
    batch = tensor.shape[: tensor.ndim - len(sizes)]
    scaled, sound = normalize_tensors(tensor.reshape(prod(batch), *tensor.shape[len(batch) :]))
    # in turned images no minor vanishes for all projections of a kind, as many do for [I | 0]
    table = tables(tuple(profile), tuple(sizes), 1, tensor.device)
    target = rotate_tensors(scaled, table.compounds)[0]
    problem = _Nearest(tuple(profile), tuple(sizes))
    with torch.no_grad():
        theta = map_blocks(problem.lowest_minimum, target.flatten(1), size=problem.block)
    if target.requires_grad:
        theta = map_blocks(problem.follow_target, theta, target.flatten(1), size=problem.block)
    parts = [rotation.mT @ part for part, rotation in zip(problem.parts(theta), table.rotations, strict=True)]
    parts = _standard(parts, profile)
    parts = [torch.where(sound[:, None, None], part, 0.0).to(tensor.dtype) for part in parts]
    return tuple(part.reshape(*batch, *part.shape[-2:]) for part in parts)


class _Nearest:
    r"""Minimizes :math:`f = |u - T|^2 / 2 = 1 - \langle u, T \rangle`, :math:`u = A / |A|`, in all entries of M; T has norm 1."""

    def __init__(self, profile: tuple[int, ...], sizes: tuple[int, ...]) -> None:
        self.profile, self.sizes, self.width = profile, sizes, sum(profile)
        self.shape = tuple(comb(m, a) for m, a in zip(sizes, profile, strict=True))
        self.block = max(1, BLOCK // (self.width * sum(sizes) * prod(self.shape)))

    def parts(self, theta: Tensor) -> list[Tensor]:
        """Projections ``(b, m_i, K)`` of parameters ``(b, p)``."""
        return list(theta.unflatten(-1, (-1, self.width)).split(self.sizes, dim=-2))

    def stack_projections(self, parts: Sequence[Tensor]) -> Tensor:
        """Parameters ``(b, p)``: the stack of all projections."""
        return torch.cat(list(parts), dim=-2).flatten(-2)

    def lowest_minimum(self, target: Tensor) -> Tensor:
        """The lowest minimum found, balanced."""
        first, *others = self.starts(target)
        theta, cost = self.nearest(first, target)
        far = (2 * cost > FAR**2).nonzero()[:, 0]
        if len(far):
            for start in others:
                again, lower = self.nearest(start[far], target[far])
                better = lower < (1 - EQUAL) * cost[far]
                theta[far] = torch.where(better[:, None], again, theta[far])
                cost[far] = torch.where(better, lower, cost[far])
        return self.stack_projections(balance_projections(self.parts(theta)))

    def follow_target(self, theta: Tensor, target: Tensor) -> Tensor:
        """The minimum as a function of the target: the value that it has, with its first derivative and its second."""
        sided = self.orient(theta, target)
        step = self.newton_step(theta, sided)[0]
        first = theta - (step - step.detach())
        with torch.no_grad():
            u, _, matrix = self.linearize(theta)
            hessian = self.hessian(theta, sided, u, matrix) + self.free(theta)
        with torch.enable_grad():
            (slope,) = torch.autograd.grad(self.cost(first, sided).sum(), first, create_graph=True)
        again = _solve_positive_definite(hessian, slope)[0]
        return first - (again - again.detach())

    def starts(self, target: Tensor) -> list[Tensor]:
        """The nearest candidates, ``(b, p)`` each."""
        found = candidates(target.unflatten(-1, self.shape), self.profile, self.sizes)
        cosine = (unit_vectors(grassmann_tensor(found, self.profile).flatten(2)) * target).sum(-1)
        order = (1 - cosine.square()).clamp(min=EQUAL).argsort(stable=True, dim=0)[:STARTS]
        every = torch.arange(len(target), device=target.device)
        return [self.stack_projections([part[best, every] for part in found]) for best in order]

    def orient(self, theta: Tensor, target: Tensor) -> Tensor:
        """The target with the sign of the tensor."""
        product = (grassmann_tensor(self.parts(theta), self.profile).flatten(1) * target.detach()).sum(-1, keepdim=True)
        return torch.where(product < 0, -target, target)

    def linearize(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        r"""The unit tensor u ``(b, D)``, :math:`\nabla A / |A|` ``(b, p, D)`` and the Gauss-Newton matrix :math:`J_u J_u^T`."""
        value, slope = grassmann_derivative(self.parts(theta), self.profile)
        size = value.norm(dim=-1, keepdim=True).clamp(min=1e-300)
        u, slope = value / size, slope / size[..., None]
        along = slope @ u[..., None]
        return u, slope, slope @ slope.mT - along @ along.mT

    def free(self, theta: Tensor) -> Tensor:
        r"""The Gram :math:`N N^T` of all directions that leave u alone, ``(b, p, p)``; u is known to have no others."""
        stack = theta.unflatten(-1, (-1, self.width))
        eye = torch.eye(self.width, dtype=theta.dtype, device=theta.device)
        rows = stack @ stack.mT
        gram = torch.einsum("bij,cd->bicjd", rows, eye).flatten(3).flatten(1, 2)
        every = torch.eye(stack.shape[-2], dtype=theta.dtype, device=theta.device)
        for view in _views(self.sizes, self.width):
            scale = theta[:, view]
            gram[:, view, view] += scale[..., None] * scale[:, None]
        for alpha, part in zip(self.profile, self.parts(theta), strict=True):
            if alpha == part.shape[-2]:
                gram += torch.einsum("ij,bcd->bicjd", every, part.mT @ part).flatten(3).flatten(1, 2)
        return gram

    def nearest(self, theta: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """The minimum next to ``theta``, of the target or its negative, and f there ``(b,)``."""
        target = self.orient(theta, target)
        active = torch.arange(len(theta), device=theta.device)
        for near in NEAR:
            found, done = self.newton(self.descend(theta[active], target[active], near), target[active])
            theta[active] = found
            active = active[~done]
            if len(active) == 0:
                break
        return theta, self.cost(theta, target)

    def descend(self, theta: Tensor, target: Tensor, near: float) -> Tensor:
        """Levenberg-Marquardt, until the steps are short."""
        problem = NearestProblem(self, target, near)
        return minimize(problem, problem.evaluate((theta,)), DESCENT).theta[0]

    def newton(self, theta: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Newton's steps while they get shorter, the last digits at any distance of the target; and whether they did ``(b,)``."""
        active = torch.arange(len(theta), device=theta.device)
        start, length = theta.clone(), torch.full_like(theta[:, 0], 0.1)
        for _ in range(NEWTON):
            step, sound = self.newton_step(theta[active], target[active])
            shorter = step.norm(dim=-1) / theta[active].norm(dim=-1)
            good = sound & (shorter < length[active])
            theta[active] -= torch.where(good[:, None], step, torch.zeros_like(step))
            length[active] = torch.where(sound, torch.minimum(shorter, length[active]), 1.0)
            active = active[good & (shorter > LAST)]
            if len(active) == 0:
                break
        done = length < LAST
        return torch.where(done[:, None], theta, start), done

    def newton_step(self, theta: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        r""":math:`H^+ \nabla f`, to be subtracted, and whether it exists; its derivative by the target is that of the minimum."""
        with torch.no_grad():
            u, slope, matrix = self.linearize(theta)
            hessian = self.hessian(theta, target.detach(), u, matrix)
        return _solve_positive_definite(hessian + self.free(theta), -(slope @ _across(target, u)[..., None])[..., 0])

    def hessian(self, theta: Tensor, target: Tensor, u: Tensor, matrix: Tensor) -> Tensor:
        r"""Second derivative of f where its gradient vanishes ``(b, p, p)``."""
        weight = _across(target, u) * u
        rows, stack = _determinant_rows(self.profile, self.sizes, theta.device), theta.unflatten(-1, (-1, self.width))
        inverse = torch.linalg.inv_ex(stack[:, rows]).inverse.nan_to_num(0.0, 0.0, 0.0)
        spread = inverse.new_zeros(*inverse.shape[:2], stack.shape[1], self.width)
        spread.scatter_(2, rows[..., None].expand(*inverse.shape[:2], -1, self.width), inverse.mT)
        spread = spread.flatten(2)
        ordered = (spread.mT @ (spread * weight[..., None])).unflatten(-1, stack.shape[1:]).unflatten(1, stack.shape[1:])
        bend = (ordered - ordered.transpose(2, 4)).flatten(3).flatten(1, 2)
        second: Tensor = (u * target).sum(-1)[:, None, None] * matrix - bend
        return second

    def cost(self, theta: Tensor, target: Tensor) -> Tensor:
        u = unit_vectors(grassmann_tensor(self.parts(theta), self.profile).flatten(1))
        return 0.5 * (u - target).square().sum(-1)


@dataclass(frozen=True)
class NearestProblem(LeastSquares):
    """The distance of unit tensors from ``target (b, D)``, until steps are as short as ``near``, relative to the projections."""

    family: _Nearest
    target: Tensor
    near: float

    def subset(self, keep: Tensor) -> NearestProblem:
        """Only some of the problems."""
        return NearestProblem(self.family, self.target[keep], self.near)

    def evaluate(self, theta: Tensors) -> Iterate:
        """Half the squared distance."""
        return Iterate(theta, self.family.cost(theta[0], self.target), ())

    def step(self, at: Iterate, damping: Tensor) -> Tensors:
        """Across the directions that leave the tensor alone."""
        u, slope, matrix = self.family.linearize(at.theta[0])
        gradient = -(slope @ _across(self.target, u)[..., None])[..., 0]
        diagonal = matrix.diagonal(dim1=-2, dim2=-1)
        floor = damping[:, None] * (diagonal + 1e-3 * diagonal.mean(-1, keepdim=True))
        return (_solve_positive_definite(matrix + self.family.free(at.theta[0]) + torch.diag_embed(floor), gradient)[0],)

    def has_converged(self, at: Iterate, fresh: Iterate, step: Tensors, tolerance: float) -> Tensor:
        """Where the rest is left to Newton."""
        return step[0].norm(dim=-1) <= self.near * at.theta[0].norm(dim=-1)


def _standard(parts: Sequence[Tensor], profile: Sequence[int]) -> list[Tensor]:
    """The same projections with a tensor of norm 1 whose product with a fixed one is positive."""
    tensor = grassmann_tensor(parts, profile).flatten(1)
    size = tensor.norm(dim=-1)
    scale = torch.where(size > 0, size, 1.0) ** (-1 / sum(profile))
    generic = torch.cos(torch.arange(1, tensor.shape[-1] + 1, dtype=tensor.dtype, device=tensor.device) ** 2)
    flip = torch.ones(len(tensor), sum(profile), dtype=tensor.dtype, device=tensor.device)
    flip[:, 0] = torch.where(tensor.detach() @ generic < 0, -1.0, 1.0)
    return [part * (scale[:, None] * flip)[:, None] for part in parts]


def _solve_positive_definite(matrix: Tensor, vector: Tensor) -> tuple[Tensor, Tensor]:
    """Solutions for positive definite matrices ``(b, p)``, zero for others, and which were ``(b,)``."""
    factor, failed = torch.linalg.cholesky_ex(matrix.nan_to_num(0.0, 0.0, 0.0))
    step = torch.cholesky_solve(vector[..., None], factor)[..., 0]
    sound = (failed == 0) & step.detach().isfinite().all(-1)
    return torch.where(sound[:, None], step, 0.0), sound


def _views(sizes: Sequence[int], width: int) -> list[slice]:
    """The parameters of each view."""
    ends = [width * end for end in accumulate(sizes)]
    return [slice(start, end) for start, end in zip([0, *ends], ends, strict=False)]


@constant
def _determinant_rows(profile: tuple[int, ...], sizes: tuple[int, ...], device: torch.device) -> Tensor:
    """The rows of the stack of which each entry of the tensor is the determinant, ``(D, K)``."""
    starts = [0, *accumulate(sizes)]
    sets = [combinations(range(start, start + size), alpha) for start, size, alpha in zip(starts, sizes, profile, strict=False)]
    return torch.tensor([[row for part in rows for row in part] for rows in product(*sets)], device=device)


def _across(vector: Tensor, unit: Tensor) -> Tensor:
    """The part that is orthogonal to a unit vector."""
    return vector - (vector * unit).sum(-1, keepdim=True) * unit
