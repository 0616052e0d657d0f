"""The fit of translating planes: every start refined on the matrices, then on the matches; the best one, and its covariance."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.algebra.homogeneous import unit_vectors
from dyntorch.chi_square import quantile
from dyntorch.eigenspace import spectrum
from dyntorch.least_squares import minimize
from dyntorch.tasks.planes_problem import Layout, Matches, Matrices, PlanesProblem
from dyntorch.tasks.planes_starts import parameters, starts

ROUGH, FINE = 40, 100
"""Steps on the matrices and on the matches, at most.  With 60 on the matches the median error of 3 to 5 planes at 0.5 px is the
same, that of 8 at 1 px 0.031 instead of 0.027."""
KEPT = 4
"""Results on the matrices, of different homographies at infinity, that are refined on the matches.  Of 4 planes at 0.5 px the best
minimum is reached in 98 %; with 2 in 90 %."""
SAME = 1e-6
"""One minus the cosine of homographies at infinity that are one solution."""
APART = 0.3
"""Sine of homographies at infinity that are two solutions: a camera that turns by 20 degrees moves them as far."""
LIKELY = 4.0
"""Difference of costs in noise variances up to which a solution is as likely as the best."""
LOW = 0.1
"""Share of problems whose noise is underestimated.  With a quarter instead, 8 of 109 answers to 3 to 8 planes without matches at
0.5 px are off by more than 0.2 and three standard deviations; so 3 of 97."""
EXACT = 1e-20
"""Cost that is rounding error."""
FLOOR = 1e-15
"""Eigenvalue of a Gauss-Newton matrix with the diagonal 1 that is rounding error."""
OPEN = 1e12
"""Variance of the homography at infinity over what it would be if all epipoles and planes were known, from which on it is open.
Three planes: 1e3 to 1e9; with collinear epipoles and coplanar normals: 1e14 and more."""
BODY_WEIGHT = 100.0
"""Inverse variance of a fundamental matrix against that of a homography: a body with depth is seen larger than a plane's patch.
Of 5 planes and 2 bodies at 0.5 px the error without matches is 0.0112; with 1 it is 0.0174, with 10 or 10000 0.012."""


def solve(
    homographies: Tensor, fundamentals: Tensor, matches: Matches | None, spare: Tensor, method: str, refine: bool
) -> tuple[Tensor, ...]:
    """The best fit to a block of problems.

    Args:
        homographies: ``(b, p, 3, 3)`` of norm 1 in normalized coordinates, zero where one is missing.
        fundamentals: ``(b, m, 3, 3)``.
        matches: None fits the matrices alone.
        spare: ``(b,)`` residuals beyond the degrees of freedom.
        method: see :func:`~dyntorch.tasks.planes_starts.starts`.
        refine: False leaves a start as it is.

    Returns:
        theta ``(b, size)`` of :class:`Layout`, cost ``(b,)``, the covariance ``(b, size, size)`` of theta for residuals of
        variance 1, gauges held, whether the data leave the homography at infinity open ``(b,)``, exactly, and whether another one
        fits them as well ``(b,)``.
    """
    layout, b = Layout(homographies.shape[1], fundamentals.shape[1]), len(homographies)
    weights = homographies.new_tensor([1.0] * layout.planes + [BODY_WEIGHT] * layout.bodies)
    matrices = PlanesProblem(layout, Matrices(torch.cat([homographies, fundamentals], dim=1), weights))
    first = starts(method, homographies, fundamentals, several=refine)
    theta = torch.cat([parameters(homographies, fundamentals, infinity) for infinity in first])
    rounds = matrices.repeated(len(first))
    if refine:
        theta = minimize(rounds, theta, ROUGH)[0]
    theta, cost = _distinct(theta.unflatten(0, (len(first), b)), rounds.normal_equations(theta)[0].unflatten(0, (len(first), b)))
    problem = matrices if matches is None else PlanesProblem(layout, matches)
    if matches is not None:
        chosen = cost.flatten().isfinite().nonzero()[:, 0]
        again = problem.repeated(len(cost)).subset(chosen)
        if refine:
            found, value, _ = minimize(again, theta.flatten(0, 1)[chosen], FINE)
            theta = theta.flatten(0, 1).index_copy(0, chosen, found).unflatten(0, cost.shape)
        else:
            value = again.normal_equations(theta.flatten(0, 1)[chosen])[0]
        cost = cost.flatten().index_copy(0, chosen, value).unflatten(0, cost.shape)
    best = cost.argmin(0)
    everyone = torch.arange(b, device=best.device)
    other = _others(theta[..., :9], cost, best, spare) if refine else torch.zeros_like(spare, dtype=torch.bool)
    theta, cost = theta[best, everyone], cost[best, everyone]
    covariance, undetermined = _covariance(problem, theta)
    if matches is not None:
        undetermined = _covariance(matrices, theta)[1]
    return theta, cost, covariance, undetermined, other


def _distinct(theta: Tensor, cost: Tensor) -> tuple[Tensor, Tensor]:
    """The ``KEPT`` best of several results ``(rounds, b, *)``; the cost of one that was found before is infinite."""
    cost, order = cost.nan_to_num(torch.inf).sort(dim=0, stable=True)
    theta = theta.gather(0, order[..., None].expand_as(theta))
    directions = unit_vectors(theta[..., :9])
    cosine = torch.einsum("kbi,lbi->klb", directions, directions).abs()
    again = cosine > 1 - SAME
    before = torch.ones(len(cost), len(cost), dtype=torch.bool, device=cost.device).tril(-1)[..., None]
    cost = torch.where((again & before).any(1), torch.inf, cost)
    cost, order = cost.sort(dim=0, stable=True)
    return theta.gather(0, order[..., None].expand_as(theta))[:KEPT], cost[:KEPT]


def _others(infinity: Tensor, cost: Tensor, best: Tensor, spare: Tensor) -> Tensor:
    """Where another homography at infinity ``(k, b, 9)`` has about the cost of the best."""
    directions = unit_vectors(infinity)
    everyone = torch.arange(len(best), device=best.device)
    least = cost[best, everyone]
    sine = (1 - (directions * directions[best, everyone]).sum(-1).square()).clamp(min=0).sqrt()
    limit = least + LIKELY * noise_variance(least, spare) + EXACT * (least + 1)
    return ((cost <= limit) & (sine > APART)).any(0)


def noise_variance(cost: Tensor, spare: Tensor) -> Tensor:
    r"""Variance of the noise, :math:`c / q` with the lower quantile q of :math:`\chi^2`, which is near the number of residuals to
    spare where that is large; 0 where none is.

    Three planes have one to spare, which is often near 0 by chance: :math:`c / 1` would say so every time.

    Args:
        cost: c ``(b,)``.
        spare: ``(b,)`` residuals beyond the degrees of freedom.
    """
    limits = spare.new_tensor([quantile(LOW, degrees) for degrees in spare.clamp(min=1).flatten().tolist()]).reshape(spare.shape)
    return torch.where(spare > 0, cost / limits, 0.0)


def _covariance(problem: PlanesProblem, theta: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse of the Gauss-Newton matrix with the gauges held, and whether the homography at infinity has an open direction."""
    matrix = problem.normal_equations(theta)[2]
    size = matrix.diagonal(dim1=-2, dim2=-1).sqrt()
    # parameters that nothing depends on (of a missing plane) are held
    none = size <= FLOOR * size.amax(-1, keepdim=True)
    unit = torch.where(none, torch.inf, size)
    gauges = unit_vectors(_gauges(problem.layout, theta) * torch.where(none, 0.0, size)[:, None]).mT
    scaled = matrix / (unit[:, :, None] * unit[:, None]) + gauges @ gauges.mT + torch.diag_embed(none.to(matrix.dtype))
    values, vectors = spectrum(scaled)
    inverse = (vectors / values.clamp(min=FLOOR)[:, None, :]) @ vectors.mT / (unit[:, :, None] * unit[:, None])
    spread = projected(inverse[:, :9, :9], theta[:, :9]).diagonal(dim1=-2, dim2=-1).sum(-1)
    least = 1 / matrix[:, :9, :9].diagonal(dim1=-2, dim2=-1).mean(-1).clamp(min=torch.finfo(matrix.dtype).tiny)
    return inverse, spread > OPEN * least


def projected(covariance: Tensor, vector: Tensor) -> Tensor:
    """Covariance ``(*, k, k)`` of the direction of a vector ``(*, k)`` of any length."""
    length = vector.norm(dim=-1)[..., None, None].clamp(min=torch.finfo(vector.dtype).tiny)
    unit = unit_vectors(vector)
    across = (torch.eye(vector.shape[-1], dtype=unit.dtype, device=unit.device) - unit[..., :, None] * unit[..., None, :]) / length
    return across @ covariance @ across


def _gauges(layout: Layout, theta: Tensor) -> Tensor:
    """Directions ``(b, k, size)`` that change no matrix: scales of the common part, of every plane and of every epipole."""
    infinity, epipoles, planes = layout.unpack(theta)
    p = layout.planes
    directions = [torch.cat([theta[:, : layout.shared], torch.zeros_like(theta[:, layout.shared :])], dim=-1)[:, None]]
    which = torch.eye(p + layout.bodies, dtype=theta.dtype, device=theta.device)
    along = which[None, :, :, None] * epipoles[:, None]
    across = which[None, :, :p, None] * planes[:, None]
    none = torch.zeros_like(infinity)[:, None].expand(-1, p + layout.bodies, -1, -1)
    normal = across * planes.new_tensor([1.0, 1.0, 1.0, 0.0])
    directions.append(layout.pack(none, along, -normal))
    directions.append(layout.pack(none[:, :p], torch.zeros_like(along[:, :p]), across[:, :p]))
    return torch.cat(directions, dim=1)
