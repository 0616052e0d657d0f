"""Batched Levenberg-Marquardt: the motion that minimizes the Sampson distances of all matches."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from dyntorch.blocks import map_blocks, one_thread, workers
from dyntorch.constrained import algebraic_motion
from dyntorch.eigenspace import spectrum
from dyntorch.forward import jacobian
from dyntorch.invariant import Invariant
from dyntorch.least_squares import minimize
from dyntorch.matches import Matches, largest_weights, matches
from dyntorch.motion_problem import BLOCK, Problem, flattened
from dyntorch.normalize import Normalization, denormalize, denormalize_motion, relative
from dyntorch.solution import Solution, failed

ITERATIONS = 30


@one_thread
def refine(
    solution: Solution,
    *views: Tensor,
    weights: Tensor | None = None,
    static: Tensor | None = None,
    iterations: int = ITERATIONS,
    **given: Tensor,
) -> Solution:
    r"""Refine the motion of a solution: minimize :math:`\sum_n w_n d_n^2` over its entries by Levenberg-Marquardt.

    :math:`d_n` is the Sampson distance of match n, for several conditions per match its vector form
    :math:`Q^{-1/2} e`.  The internal constraints of the tensor hold exactly, because its motion is what is varied.  Matches
    labelled static are held to agree in all views (the segmented refinement).  The cost never rises; where the solution had
    failed it is returned as it was.

    Args:
        solution: from :func:`dyntorch.fit` or :func:`dyntorch.robust_fit`.
        *views: the same matches.
        weights: ``(*batch, n)``; default: the solution's inliers, else its weights.
        static: ``(*batch, n)`` bool, matches that do not move; default: those labelled in the fit.
        iterations: at most so many steps.
        **given: what else the invariant takes.

    Returns:
        The solution with ``tensor``, ``motion``, ``sigma`` (noise per coordinate, in the unit of the matches, that the
        residuals show) and ``covariance`` of the entries of the motion (rank ``invariant.dof``: its scale is fixed; infinite
        where no match is left to estimate the noise).

    Raises:
        ValueError: matches that do not fit the solution.

    Source: theory of nonlinear estimation as in Hartley and Zisserman, appendix A6.

    Example:
        >>> import torch, dyntorch as dyn
        >>> from dyntorch import scenes
        >>> scene = scenes.planar(n=60, sigma=0.5, generator=torch.Generator().manual_seed(0))
        >>> solution = dyn.fit(dyn.HomographyTensor, *scene.views)
        >>> refined = dyn.refine(solution, *scene.views)
        >>> bool((refined.sigma - 0.5).abs() < 0.15)
        True
    """
    invariant, views = solution.invariant.prepared(views, **given)
    data = matches(invariant, views, weights, static)
    old = solution.matches
    if data.batch != old.batch or data.count != old.count:
        raise ValueError(
            f"these matches have batch {data.batch} and {data.count} matches, the solution was fitted to batch {old.batch} and "
            f"{old.count}; give the same ones"
        )
    if weights is None:
        keep = old.weights if solution.inliers is None else solution.inliers.reshape(old.weights.shape).to(old.weights)
        data = replace(data, weights=data.weights * (keep > 0 if solution.inliers is not None else keep))
    if static is None and old.static is not None:
        data = replace(data, static=old.static)
    return refine_matches(solution, data, iterations)


def refine_matches(solution: Solution, data: Matches, iterations: int = ITERATIONS) -> Solution:
    """:func:`refine` for checked matches."""
    invariant, norm = solution.invariant, _plain(solution)
    parts = solution.normalized_motion()
    shapes = tuple(part.shape[1:] for part in parts)
    thetas = [flattened(parts).detach()]
    if invariant.staged and solution.refined is None:
        thetas.append(flattened(algebraic_motion(solution, data)))
    moved = tuple(x.detach() for x in norm.apply(invariant, data.views))
    frames = tuple(t.detach() for t in norm.transforms)
    base = invariant.normalized(tuple(t.detach() for t in solution.normalization.transforms))
    flags = () if data.static is None else (data.static,)
    count = len(moved)

    def run(*block: Tensor) -> tuple[Tensor, ...]:
        views, scales, rest = block[1 : 1 + count], block[1 + count : 1 + 2 * count], block[1 + 2 * count :]
        problem = Problem(base, shapes, views, scales, rest[0], rest[1] if len(rest) > 1 else None)
        starts = block[0]
        if starts.shape[1] == 1:
            return minimize(problem, starts[:, 0], iterations)
        costs = torch.stack([problem.normal_equations(theta)[0] for theta in starts.unbind(1)], dim=1)
        best = costs.argmin(1)[:, None, None].expand(-1, 1, starts.shape[-1])
        return minimize(problem, starts.gather(1, best)[:, 0], iterations)

    # a block for every thread at least: threads inside of small operations cost more than they bring
    theta = torch.stack(thetas, dim=1)
    size = max(1, min(BLOCK // max(1, data.count * theta.shape[-1]), -(-len(theta) // workers())))
    with torch.no_grad():
        start = torch.where(theta.isfinite(), theta, torch.zeros_like(theta))
        scales, unit = relative(norm.scales)
        best, cost, matrix = map_blocks(run, start, *moved, *scales, data.weights, *flags, size=size)
        cost, matrix = cost / unit.square(), matrix / unit.square()[:, None, None]
        return _refined(solution, data, norm, frames, shapes, best, cost, matrix)


def _refined(
    solution: Solution,
    data: Matches,
    norm: Normalization,
    frames: tuple[Tensor, ...],
    shapes: tuple[torch.Size, ...],
    theta: Tensor,
    cost: Tensor,
    matrix: Tensor,
) -> Solution:
    """The solution with the refined motion, where refinement was possible."""
    invariant = solution.invariant
    problem = Problem(invariant, shapes, (), (), data.weights, None)
    status = solution.status.reshape(-1).to(theta.device)
    good = cost.isfinite() & ~failed(status)
    motion = tuple(
        torch.where(good[(..., *([None] * (part.ndim - 1)))], part, old)
        for part, old in zip(problem.parts(theta), solution.normalized_motion(), strict=True)
    )
    safe = tuple(torch.where(good[(..., *([None] * (part.ndim - 1)))], part, _any(part)) for part in motion)
    # tensors of copies have the axis of the copies behind the batch, like the transforms of the solution
    normalized = invariant.normalized(solution.normalization.transforms).compose(*safe)
    tensor = denormalize(invariant, normalized, solution.normalization.actions)
    keep = good[(..., *([None] * (tensor.ndim - 1)))]
    conditions = torch.full_like(data.weights, float(invariant.codim))
    if data.static is not None:
        still = sum(p.freedom() for p in invariant.primitives[1:])
        conditions = torch.where(data.static, float(still), conditions)
    spare = ((data.weights > 0) * conditions).sum(-1) - invariant.dof
    mean = cost / largest_weights(data.weights).clamp(min=torch.finfo(cost.dtype).tiny)
    sigma = torch.where(spare > 0, (mean / spare.clamp(min=1)).sqrt(), torch.inf)
    covariance = _covariance(invariant, problem, frames, theta, matrix, sigma, data.weights)
    return replace(
        solution,
        tensor=torch.where(data.back(keep), data.back(tensor), solution.tensor),
        normalized=torch.where(keep, normalized, solution.normalized),
        refined=motion,
        sigma=data.back(torch.where(good, sigma, torch.zeros_like(sigma))),
        covariance=data.back(torch.where(good[:, None, None], covariance, torch.zeros_like(covariance))),
    )


def _covariance(
    invariant: Invariant,
    problem: Problem,
    frames: tuple[Tensor, ...],
    theta: Tensor,
    matrix: Tensor,
    sigma: Tensor,
    weights: Tensor,
) -> Tensor:
    r"""Covariance ``(b, p, p)`` of the motion in the coordinates of the matches: :math:`\sigma^2 D H^+ D^T`, H of rank dof."""
    values, vectors = spectrum(matrix)
    count = min(invariant.dof, values.shape[-1])
    values, vectors = values[..., -count:], vectors[..., -count:]
    root = vectors * values.clamp(min=1e-12 * values[..., -1:].clamp(min=torch.finfo(values.dtype).tiny)).rsqrt()[..., None, :]

    def moved(t: Tensor) -> Tensor:
        return torch.cat([part.flatten(t.ndim - 1) for part in denormalize_motion(invariant, problem.parts(t), frames)], dim=-1)

    _, derivative = jacobian(moved, theta)
    spread = derivative.mT @ root
    scale = sigma * largest_weights(weights).sqrt()
    covariance = (spread @ spread.mT) * scale.square()[:, None, None]
    # a motion without a matrix in the coordinates of the matches (singular) is not known at all, like one without spare matches
    known = scale.isfinite() & covariance.isfinite().flatten(1).all(-1)
    return torch.where(known[:, None, None], covariance, torch.inf)


def _any(part: Tensor) -> Tensor:
    """A harmless motion in place of one that failed."""
    if part.ndim == 3:
        return torch.eye(part.shape[-2], part.shape[-1], dtype=part.dtype, device=part.device).expand_as(part)
    return torch.ones_like(part)


def _plain(solution: Solution) -> Normalization:
    """The normalization of one problem each, without the dimension of copies."""
    norm = solution.normalization
    if solution.invariant.copies is None:
        return norm
    return Normalization(
        tuple(t[:, 0] for t in norm.transforms), norm.primitives, norm.actions, tuple(s[:, 0] for s in norm.scales)
    )
