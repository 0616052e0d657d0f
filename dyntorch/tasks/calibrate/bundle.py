r"""Space and time adjusted together: cameras, lenses, clocks and moving points that explain what all cameras saw.

A point j at the moment U of the reference clock is seen by camera i at its own time

.. math:: \tau_i(U) = e^{\rho_i} (U - \bar U) + \delta_i + \bar U,

and what is minimized over cameras, clocks and points is, with Student's t for the noise of the detector,

.. math:: \sum_{ijU} w_{ijU}\, (\nu + 2) \log\Bigl(1 + \frac{|\pi_i(X_{jU}) - x_{ij}(\tau_i(U))|^2}{\nu\, \sigma_i^2}\Bigr)
    + \text{priors},

twice the negative logarithm of the likelihood.  Points are eliminated first, each by itself; what is left are the cameras' few
parameters.

Source: Triggs et al. 2000, Bundle adjustment: a modern synthesis; Lange et al. 1989 for Student's t; Albl et al. 2017, On the
two-view geometry of unsynchronized cameras, for clocks as unknowns of the geometry of two views.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyntorch.numerics.least_squares import LeastSquaresOptions, minimize
from dyntorch.tasks.calibrate.adjustment import (
    CLOCK,
    LENS,
    PARAMETERS,
    Priors,
    RigAdjustment,
    RigState,
    camera_covariance,
    gauge,
    images,
    sighting_planes,
)
from dyntorch.tasks.calibrate.averaging import Graph, first_cameras, nearest_points, viewing_rays
from dyntorch.tasks.calibrate.input import MIN_NOISE, Rig, RigViews

RAYLEIGH = 1.1774
"""Median of the length of an error in two coordinates of standard deviation 1."""


PRIOR_FOCAL = 0.85  # over the longer side: 61 degrees across, a phone
PRIOR_FOCAL_SIGMA = 0.7  # of its logarithm: a factor of two
PRIOR_K1_SCALE = 0.015  # of Cauchy's distribution: most phones have less than .05, action cameras .3
PRIOR_RATE_SIGMA = 1e-4  # of the logarithm of a clock rate: what quartz clocks differ by


@dataclass(frozen=True)
class Freedom:
    """What of a rig is free, and what is known of it beforehand."""

    poses: Tensor  # ``(11 c, q)`` poses and focal lengths, from where a start is
    whole: Tensor  # ``(11 c, q)`` lenses and clocks as well
    shape: Tensor  # ``(11 c, q)`` the same with the pose of the first camera, for the covariance
    priors: Priors  # of what is not geometry

    @staticmethod
    def of(rig: Rig, clocks: Tensor, held_clocks: bool, held_rates: bool, rate_sigmas: Tensor) -> Freedom:
        """Of a rig. clocks ``(c, 2)``, rate_sigmas ``(c,)``."""
        c = len(rig.tracks)
        side = rig.sizes.amax(1)
        mean, sigma = torch.zeros(c, 5, dtype=torch.float64), torch.full((c, 5), math.inf, dtype=torch.float64)
        mean[:, 0], sigma[:, 0] = (PRIOR_FOCAL * side).log(), PRIOR_FOCAL_SIGMA
        sigma[:, 1] = PRIOR_K1_SCALE
        mean[:, 3:], sigma[:, 4] = clocks, torch.hypot(rate_sigmas, torch.tensor(PRIOR_RATE_SIGMA, dtype=torch.float64))
        # k2 is held at 0
        lens = torch.stack([rig.focals.isnan(), ~rig.known_lens, torch.zeros_like(rig.known_lens)], dim=-1)
        free = torch.zeros(c, PARAMETERS, dtype=torch.bool)
        free[1:, :6] = True
        free[:, LENS.start] = lens[:, 0]
        whole = free.clone()
        whole[:, LENS] = lens
        whole[1:, CLOCK] = not held_clocks
        whole[1:, CLOCK.stop - 1] &= not held_rates
        shape = whole.clone()
        shape[0, :6] = True
        tied = rig.one_lens
        return Freedom(_columns(free, tied), _columns(whole, tied), _columns(shape, tied), Priors(mean, sigma))


def _columns(free: Tensor, tied: bool) -> Tensor:
    """A column for each free parameter of ``(c, 11)``, or for all cameras' one where lenses are tied."""
    c = len(free)
    eye = torch.eye(c * PARAMETERS, dtype=torch.float64)
    columns = [
        eye[:, k] for k in free.flatten().nonzero()[:, 0].tolist() if not (tied and k % PARAMETERS in range(LENS.start, LENS.stop))
    ]
    if tied:
        for place in range(LENS.start, LENS.stop):
            together = (free[:, place, None] * eye.view(-1, c, PARAMETERS)[:, :, place].mT).sum(0)
            if bool(together.any()):
                columns.append(together)
    return torch.stack(columns, dim=-1)


@dataclass(frozen=True)
class Pose:
    """Cameras of one solution."""

    R: Tensor
    """``(c, 3, 3)``."""
    centers: Tensor
    """``(c, 3)``."""
    middle: Tensor
    """``(3,)`` of the points."""


@dataclass(frozen=True)
class RigSolution:
    """A solution."""

    state: RigState  # of one adjustment
    problem: RigAdjustment  # what it solves
    covariance: Tensor  # ``(c, 11, 11)`` of the cameras, centres in place of translations

    @property
    def pose(self) -> Pose:
        """Cameras and the middle of the points."""
        return pose_of(self.state)


def pose_of(state: RigState, place: int = 0) -> Pose:
    """Cameras of one of several adjustments."""
    points = state.points[place].flatten(0, 1)
    return Pose(state.R[place], state.centers[place], points.median(0).values)


TRIED_FOCALS = (0.45, 0.6, 0.8, 1.05, 1.4, 1.9, 2.6)  # over the longer side of the picture: 96 to 22 degrees of view across
NUM_KEPT_STARTS = 3  # that are adjusted to the end
START_ITERATIONS = (8, 15, 15)  # of the rounds in which starts are compared; the noise is estimated between rounds


def compare_starts(rig: Rig, views: RigViews, graph: Graph, clocks: Tensor, freedom: Freedom) -> tuple[RigState, Tensor]:
    """The best starts, adjusted on some of the moments, best first, and by how much each is worse than the first."""
    side = rig.sizes.amax(1)
    unknown = rig.focals.isnan()
    tried = TRIED_FOCALS if bool(unknown.any()) else TRIED_FOCALS[:1]
    focals = torch.stack([torch.where(unknown, share * side, rig.focals.nan_to_num(1.0)) for share in tried])
    R, centers, points = first_cameras(views, graph, clocks, focals)
    t, logs = -(R @ centers[..., None])[..., 0], focals.log()
    lens = torch.nn.functional.pad(logs[..., None], (0, 2))
    state = RigState(R, t, lens, clocks.expand(len(focals), -1, -1).clone(), points)
    for k, steps in enumerate(START_ITERATIONS):
        problem = _problem(views, state, freedom.poses, freedom.priors)
        state = _descend(problem, state, steps)
        if k == 0 and len(state.R) > NUM_KEPT_STARTS:
            sigma = _noise(state, problem).log().sum(1)
            state = state.of(sigma.argsort(stable=True)[:NUM_KEPT_STARTS])
    # all by the noise of the best one: what is more likely is then not what makes more noise
    problem = _problem(views, state, freedom.poses, freedom.priors)
    best = problem.sigma.log().sum(1).argmin()
    problem = replace(
        problem, sigma=problem.sigma[best].expand_as(problem.sigma), weights=problem.weights[best].expand_as(problem.weights)
    )
    cost = problem.evaluate(tuple(state)).cost
    order = cost.argsort(stable=True)
    repeats = _autocorrelation_factor(problem.subset(order[:1]), state.of(order[:1]))
    return state.of(order), (cost[order] - cost[order[0]]) / repeats


BUNDLE_ITERATIONS = (12, 12, 10)  # of the rounds of the last adjustment; the noise and who is seen are estimated between rounds


def adjust_bundle(views: RigViews, start: RigState, freedom: Freedom) -> RigSolution:
    """The solution next to a start, at all the moments of views."""
    state = start._replace(points=intersect_rays(views, start)[None])
    problem = _problem(views, state, freedom.whole, freedom.priors)
    for k, steps in enumerate(BUNDLE_ITERATIONS):
        if k:
            problem = _problem(views, state, freedom.whole, freedom.priors)
        state = _descend(problem, state, steps)
    normal = problem.linear(state)
    _, reduced, _ = normal.eliminate_points(torch.zeros(1, dtype=torch.float64))
    covariance = _autocorrelation_factor(problem, state) * camera_covariance(
        reduced[0], freedom.shape, gauge(state.R[0], state.t[0])
    )
    return RigSolution(state, problem, _covariance_of_centers(covariance, state.R[0]))


def intersect_rays(views: RigViews, state: RigState) -> Tensor:
    """Points ``(T, n, 3)`` nearest to the rays of one adjustment, lenses left out."""
    rays, known = viewing_rays(views, state.clocks[0], state.lens[0, :, 0].exp())
    return nearest_points(state.R[0], state.centers[0], rays, known).view(len(views.times), -1, 3)


NOISE_FREEDOM = 4.0  # degrees of freedom of Student's t, the noise of a detector


def _problem(views: RigViews, state: RigState, basis: Tensor, priors: Priors) -> RigAdjustment:
    """With positions that are seen now, and the noise that is left now."""
    b, c = state.R.shape[:2]
    unit = torch.ones(b, c, dtype=torch.float64)
    start = RigAdjustment(views, views.steady_weights(state.clocks), unit, NOISE_FREEDOM, priors, basis)
    return replace(start, sigma=_noise(state, start))


def _noise(state: RigState, problem: RigAdjustment) -> Tensor:
    """Robust standard deviation ``(b, c)`` px of each camera's noise."""
    seen = problem.views.at(state.clocks)
    known = problem.weights * seen.weights > 0
    far = (images(state, problem.views.centers) - seen.x).norm(dim=-1) / problem.views.noise[:, None, None]
    sigma = torch.where(known, far, torch.nan).flatten(1).nanmedian(-1).values.nan_to_num(1e6) / RAYLEIGH
    views = known.sum(1)
    mean = (views.sum((1, 2)) / (views > 0).sum((1, 2)).clamp(min=1)).clamp(min=2)
    sigma = (sigma * (2 * mean / (2 * mean - 3)).sqrt()).clamp(min=MIN_NOISE)
    return sigma[:, None] * problem.views.noise


COST_TOLERANCE = 1e-5  # relative gain of a step that ends a round


def _descend(problem: RigAdjustment, state: RigState, steps: int) -> RigState:
    settings = LeastSquaresOptions(iterations=steps, tolerance=COST_TOLERANCE)
    return RigState(*minimize(problem, problem.evaluate(tuple(state)), settings).theta)


MIN_AUTOCORRELATION = 0.02  # of residuals some moments apart, down to which it is summed


def _autocorrelation_factor(problem: RigAdjustment, state: RigState) -> float:
    r"""By how much fewer residuals there are than it seems: :math:`1 + 2 \sum_k \rho_k` of how they repeat themselves in time."""
    error, weight = problem.agreement(state, sighting_planes(problem.views.at(state.clocks)))
    rows = (error * weight.sqrt()[:, :, None])[0].unflatten(-1, state.points.shape[1:3]).movedim(2, 0).flatten(1)  # (T, *)
    total, count = 1.0, len(rows)
    power = float(rows.square().sum()) / max(count, 1)
    for lag in range(1, max(2, count // 4)):
        rho = float((rows[lag:] * rows[:-lag]).sum()) / max(count - lag, 1) / max(power, 1e-300)
        if not rho > MIN_AUTOCORRELATION:
            break
        total += 2 * rho
    return total


def _covariance_of_centers(covariance: Tensor, R: Tensor) -> Tensor:
    """``(c, 11, 11)`` of each camera with its centre in place of its translation: :math:`dC = -R^T dt` about the centre."""
    c = len(R)
    own = covariance.view(c, PARAMETERS, c, PARAMETERS)
    own = torch.stack([own[i, :, i] for i in range(c)])
    change = torch.eye(PARAMETERS, dtype=torch.float64).repeat(c, 1, 1)
    change[:, 3:6, 3:6] = -R.mT
    return change @ own @ change.mT


@dataclass(frozen=True)
class Structure:
    """Points and how well they agree with the pictures."""

    points: Tensor  # ``(T, n, 3)``, NaN where two cameras do not tell
    sigmas: Tensor  # ``(T, n)`` root mean square of the standard deviations along the axes
    residuals: Tensor  # ``(c, n)`` px, root mean square of the positions that agree
    inliers: Tensor  # ``(c,)`` share of the positions that agree


BLOCK_POINTS = 20_000  # points times moments that are solved at a time


def triangulate_frames(views: RigViews, found: RigSolution) -> Structure:
    """Points of all moments of views, each the least squares of the positions that see it, with the noise of Student's t."""
    n = views.grids[0].x.shape[1]
    step = max(1, BLOCK_POINTS // n)
    parts = [_triangulate_block(replace(views, times=times), found) for times in views.times.split(step)]
    points, sigmas = (torch.cat([part[k] for part in parts]) for k in (0, 1))
    square, agree, seen = (torch.stack([part[k] for part in parts]).sum(0) for k in (2, 3, 4))
    residuals = torch.where(agree > 0, (square / agree.clamp(min=1)).sqrt(), torch.nan)
    inliers = agree.sum(1) / seen.sum(1).clamp(min=1)
    return Structure(points, sigmas, residuals, inliers)


POINT_ITERATIONS = 8  # of their least squares
MAX_POINT_SIGMA = 0.08  # over the distance of the cameras
OUTLIER_SIGMAS = 4.0  # of the noise beyond which a position does not agree


def _triangulate_block(views: RigViews, found: RigSolution) -> tuple[Tensor, ...]:
    """Points, their standard deviations, and per camera and point: sum of squares and number of what agrees, number of all."""
    state = found.state
    weights = views.at(state.clocks).weights
    weights = weights * ((weights > 0).sum(1, keepdim=True) >= 2)
    held = found.problem.basis[:, :0]
    problem = RigAdjustment(views, weights, found.problem.sigma, found.problem.freedom, found.problem.priors, held)
    state = state._replace(points=intersect_rays(views, state)[None])
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
    blocks = problem.linear(state).matrix[0].movedim(-1, 0)
    values = torch.linalg.eigvalsh(blocks).clamp(min=0)
    variance = torch.where(values > 0, 1 / values, torch.inf).mean(-1)
    return variance.sqrt().view(state.points.shape[1:3])
