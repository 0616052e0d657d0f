"""constrain(): the tensor of a motion with the least algebraic error, between the linear fit and refinement."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyntorch.blocks import map_blocks, one_thread, workers
from dyntorch.invariant import Invariant
from dyntorch.least_squares import minimize
from dyntorch.matches import Matches, relative_weights
from dyntorch.matrix import gram
from dyntorch.motion_problem import BLOCK, parts_of
from dyntorch.normalize import denormalize
from dyntorch.solution import Solution, copied, failed

ITERATIONS = 30
FREE = 1e-8  # least damping: leaves the gauge of the motions where it is to 1e-10


@dataclass(frozen=True)
class Algebraic:
    r"""The algebraic error :math:`u^T G u` of tensors :math:`u = A(M) / |A(M)|`, with the Gram G of the matches."""

    invariant: Invariant
    shapes: tuple[torch.Size, ...]
    gram: Tensor
    """``(b, D, D)``."""

    def parts(self, theta: Tensor) -> tuple[Tensor, ...]:
        return parts_of(theta, self.shapes)

    def subset(self, keep: Tensor) -> Algebraic:
        return Algebraic(self.invariant, self.shapes, self.gram[keep])

    def cost(self, theta: Tensor) -> Tensor:
        """``(b,)``."""
        tensor = self._columns(self.invariant.compose(*self.parts(theta)).flatten(1))
        return ((self.gram @ tensor[..., None])[..., 0] * tensor).sum(-1)

    def normal_equations(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        tensor, slope = (self._columns(x) for x in self.invariant.compose_derivative(self.parts(theta)))
        image = (self.gram @ tensor[..., None])[..., 0]
        cost = (image * tensor).sum(-1)
        bent = slope @ self.gram
        return torch.where(cost.isfinite(), cost, torch.inf), (slope @ image[..., None])[..., 0], bent @ slope.mT

    def _columns(self, tensor: Tensor) -> Tensor:
        """Flat tensors ``(b, ..., D)`` with their entries in the order of the columns of the estimation matrix."""
        return self.invariant.basis_of(tensor.unflatten(-1, self.invariant.shape()))[..., 0, :]


@one_thread
def constrain(solution: Solution, *, iterations: int = ITERATIONS) -> Solution:
    r"""Replace the tensor of a linear fit by that of a motion: minimize :math:`|E\,A(M)| / |A(M)|` over the motion M.

    The null vector of noisy matches is the tensor of no motion, and what it decomposes into may be far from the best one
    (projections from :math:`P^6` at one pixel of noise: useless).  This stage searches among the tensors of motions, from
    several starts, by Levenberg-Marquardt; :func:`dyntorch.refine`, which minimizes distances in the images, does it first
    where an invariant needs it.

    Args:
        solution: of :func:`dyntorch.fit`, for an invariant of nullity one.
        iterations: at most so many steps.

    Returns:
        The solution with the new tensor and motion; failed problems stay as they are.

    Raises:
        ValueError: an invariant of nullity above one or with copies, whose tensors do not stand alone.

    Source: Hartley and Zisserman, sections 11.3 and 16.3 (algebraic minimization), for the motion of any invariant.

    Example:
        >>> import torch, dyntorch as dyn
        >>> draw = torch.Generator().manual_seed(0)
        >>> M, Y = (torch.randn(*size, generator=draw, dtype=torch.float64) for size in ((3, 3, 5), (60, 5)))
        >>> seen = torch.einsum("vij,nj->vni", M, Y)
        >>> views = seen[..., :2] / seen[..., 2:] + 1e-3 * torch.randn(3, 60, 2, generator=draw, dtype=torch.float64)
        >>> found = constrain(dyn.fit(dyn.GrassmannTensor(4, (2, 2, 1)), *views))
        >>> bool(torch.allclose(found.invariant.compose(*found.motion).abs(), found.tensor.abs()))
        True
    """
    return constrain_matches(solution, solution.matches, iterations)


def constrain_matches(solution: Solution, data: Matches, iterations: int = ITERATIONS) -> Solution:
    """:func:`constrain` by other weights of the same matches."""
    invariant = solution.invariant
    if invariant.nullity > 1 or invariant.copies is not None:
        raise ValueError(f"the tensors of {invariant!r} do not stand alone; use refine")
    with torch.no_grad():
        motion = algebraic_motion(solution, data, iterations)
        base = invariant.normalized(solution.normalization.transforms)
        normalized = base.compose(*motion)
        tensor = data.back(denormalize(invariant, normalized, solution.normalization.actions))
        bad = failed(solution.status.reshape(-1))
        wide = bad[(..., *[None] * (normalized.ndim - 1))]
        return replace(
            solution,
            tensor=torch.where(data.back(wide), solution.tensor, tensor),
            normalized=torch.where(wide.to(normalized.device), solution.normalized, normalized),
            refined=motion,
        )


def algebraic_motion(solution: Solution, data: Matches, iterations: int = ITERATIONS) -> tuple[Tensor, ...]:
    """The motion of least algebraic error in normalized coordinates, from the best start of each problem."""
    invariant, norm = solution.invariant, solution.normalization
    views, weights, static = copied(invariant, data)
    views = tuple(x.detach() for x in norm.apply(invariant, views))
    weights = relative_weights(weights)
    base = invariant.normalized(tuple(t.detach() for t in norm.transforms))
    starts = base.starts(solution.normalized.detach())
    shapes = tuple(part.shape[2:] for part in starts)

    def run(tensors: Tensor, *block: Tensor) -> tuple[Tensor, Tensor]:
        rest = block[1 + len(views) :]
        matrix = gram(norm.primitives, block[: len(views)], block[len(views)], rest[0] if rest else None)
        trace = matrix.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None]
        problem = Algebraic(base, shapes, matrix / trace.clamp(min=torch.finfo(trace.dtype).tiny))
        costs = torch.stack([problem.cost(theta) for theta in tensors.unbind(1)])
        best = costs.nan_to_num(nan=torch.inf).argmin(0)
        theta = tensors.gather(1, best[:, None, None].expand(-1, 1, tensors.shape[-1]))[:, 0]
        return minimize(problem, theta, iterations, settle=2, least=FREE)[:2]

    theta = torch.cat([part.flatten(2) for part in starts], dim=-1).transpose(0, 1)
    options = () if static is None else (static,)
    size = max(1, min(BLOCK // (invariant.width() * theta.shape[-1]), -(-len(theta) // workers())))
    found = map_blocks(run, theta, *views, weights, *options, size=size)[0]
    return parts_of(found, shapes)
