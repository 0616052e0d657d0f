"""The points of every frame, when the cameras are known."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyntorch.numerics.least_squares import LeastSquaresOptions, minimize
from dyntorch.tasks.calibrate.adjusting import COST_TOLERANCE, RAYLEIGH, RigSolution, met_points
from dyntorch.tasks.calibrate.adjustment import RigAdjustment, RigState, images
from dyntorch.tasks.calibrate.observations import RigViews


@dataclass(frozen=True)
class Structure:
    """Points and how well they agree with the pictures."""

    points: Tensor  # ``(T, n, 3)``, NaN where two cameras do not tell
    sigmas: Tensor  # ``(T, n)`` root mean square of the standard deviations along the axes
    residuals: Tensor  # ``(c, n)`` px, root mean square of the positions that agree
    inliers: Tensor  # ``(c,)`` share of the positions that agree


BLOCK_POINTS = 20_000  # points times moments that are solved at a time


def structure(views: RigViews, found: RigSolution) -> Structure:
    """Points of all moments of views, each the least squares of the positions that see it, with the noise of Student's t."""
    n = views.grids[0].x.shape[1]
    step = max(1, BLOCK_POINTS // n)
    parts = [_block(replace(views, times=times), found) for times in views.times.split(step)]
    points, sigmas = (torch.cat([part[k] for part in parts]) for k in (0, 1))
    square, agree, seen = (torch.stack([part[k] for part in parts]).sum(0) for k in (2, 3, 4))
    residuals = torch.where(agree > 0, (square / agree.clamp(min=1)).sqrt(), torch.nan)
    inliers = agree.sum(1) / seen.sum(1).clamp(min=1)
    return Structure(points, sigmas, residuals, inliers)


POINT_ITERATIONS = 8  # of their least squares
MAX_POINT_SIGMA = 0.08  # over the distance of the cameras
OUTLIER_SIGMAS = 4.0  # of the noise beyond which a position does not agree


def _block(views: RigViews, found: RigSolution) -> tuple[Tensor, ...]:
    """Points, their standard deviations, and per camera and point: sum of squares and number of what agrees, number of all."""
    state = found.state
    weights = views.at(state.clocks).weights
    weights = weights * ((weights > 0).sum(1, keepdim=True) >= 2)
    held = found.problem.basis[:, :0]
    problem = RigAdjustment(views, weights, found.problem.sigma, found.problem.freedom, found.problem.priors, held)
    state = state._replace(points=met_points(views, state)[None])
    settings = LeastSquaresOptions(iterations=POINT_ITERATIONS, tolerance=COST_TOLERANCE)
    state = RigState(*minimize(problem, problem.evaluate(tuple(state)), settings).theta)
    sigmas = _sigmas(problem, state)
    far = (state.centers[0, :, None, None] - state.points[0]).norm(dim=-1).median(0).values
    known = (weights[0] > 0).any(0) & (sigmas <= MAX_POINT_SIGMA * far)
    error = (images(state, views.centers) - views.at(state.clocks).x)[0].norm(dim=-1)
    seen = (weights[0] > 0) & known
    agree = seen & (error <= OUTLIER_SIGMAS * RAYLEIGH * problem.sigma[0, :, None, None])
    return (
        torch.where(known[..., None], state.points[0], torch.nan),
        torch.where(known, sigmas, torch.nan),
        torch.where(agree, error.square() / 2, 0.0).sum(1),
        agree.double().sum(1),
        seen.double().sum(1),
    )


def _sigmas(problem: RigAdjustment, state: RigState) -> Tensor:
    """Root mean square ``(T, n)`` of the standard deviations of points along the axes; infinite where they have none."""
    blocks = problem.linear(state).matrix[0]
    values = torch.linalg.eigvalsh(blocks).clamp(min=0)
    variance = torch.where(values > 0, 1 / values, torch.inf).mean(-1)
    return variance.sqrt().view(state.points.shape[1:3])
