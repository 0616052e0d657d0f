"""From first cameras to the best ones: starts are compared, the best is adjusted, its noise and its bones learned on the way."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyntorch.numerics.least_squares import minimize
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
)  # fmt: skip
from dyntorch.tasks.calibrate.averaging import Graph, first_cameras, meeting_points, viewing_rays
from dyntorch.tasks.calibrate.bones import learned
from dyntorch.tasks.calibrate.input import Rig
from dyntorch.tasks.calibrate.observations import RigViews
from dyntorch.tasks.calibrate.options import CalibrateOptions

RAYLEIGH = 1.1774
"""Median of the length of an error in two coordinates of standard deviation 1."""


@dataclass(frozen=True)
class Freedom:
    """What of a rig is free, and what is known of it beforehand."""

    poses: Tensor  # ``(11 c, q)`` poses and focal lengths, from where a start is
    whole: Tensor  # ``(11 c, q)`` lenses and clocks as well
    shape: Tensor  # ``(11 c, q)`` the same with the pose of the first camera, for the covariance
    priors: Priors  # of what is not geometry

    @staticmethod
    def of(
        rig: Rig, clocks: Tensor, held_clocks: bool, held_rates: bool, rate_sigmas: Tensor, options: CalibrateOptions
    ) -> Freedom:
        """Of a rig. clocks ``(c, 2)``, rate_sigmas ``(c,)``."""
        c, adjust = len(rig.tracks), options.adjust
        side = rig.sizes.amax(1)
        mean, sigma = torch.zeros(c, 5, dtype=torch.float64), torch.full((c, 5), math.inf, dtype=torch.float64)
        mean[:, 0], sigma[:, 0] = (adjust.focal * side).log(), adjust.focal_sigma
        sigma[:, 1] = adjust.k1_scale
        sigma[:, 2] = adjust.k2_sigma if adjust.k2_sigma > 0 else math.inf
        mean[:, 3:], sigma[:, 4] = clocks, torch.hypot(rate_sigmas, torch.tensor(adjust.rate_sigma, dtype=torch.float64))
        lens = torch.stack([rig.focals.isnan(), ~rig.known_lens, ~rig.known_lens & (adjust.k2_sigma > 0)], dim=-1)
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


def compared_starts(
    rig: Rig, views: RigViews, graph: Graph, clocks: Tensor, freedom: Freedom, options: CalibrateOptions
) -> tuple[RigState, Tensor]:
    """The best starts, adjusted on some of the moments, best first, and by how much each is worse than the first."""
    side = rig.sizes.amax(1)
    unknown = rig.focals.isnan()
    tried = options.start.focals if bool(unknown.any()) else options.start.focals[:1]
    starts = []
    for share in tried:
        focals = torch.where(unknown, share * side, rig.focals.nan_to_num(1.0))
        R, centers, points = first_cameras(views, graph, clocks, focals, options.start)
        starts.append((R, -(R @ centers[..., None])[..., 0], focals.log(), points))
    R, t, logs, points = (torch.stack(part) for part in zip(*starts, strict=True))
    b = len(starts)
    lens = torch.nn.functional.pad(logs[..., None], (0, 2))
    state = RigState(R, t, lens, clocks.expand(b, -1, -1).clone(), points, points.new_zeros(b, 0))
    for k, steps in enumerate(options.adjust.first_rounds):
        problem = _problem(views, state, freedom.poses, freedom.priors, options)
        state = _descended(problem, state, steps, options)
        if k == 0 and len(state.R) > options.start.kept:
            sigma = _noise(state, problem, options).log().sum(1)
            state = state.of(sigma.argsort(stable=True)[: options.start.kept])
    # all by the noise of the best one: what is more likely is then not what makes more noise
    problem = _problem(views, state, freedom.poses, freedom.priors, options)
    best = problem.sigma.log().sum(1).argmin()
    problem = replace(
        problem, sigma=problem.sigma[best].expand_as(problem.sigma), weights=problem.weights[best].expand_as(problem.weights)
    )
    cost = problem.evaluate(tuple(state)).cost
    order = cost.argsort(stable=True)
    repeats = _repeats(problem.subset(order[:1]), state.of(order[:1]), options)
    return state.of(order), (cost[order] - cost[order[0]]) / repeats


def adjusted(views: RigViews, start: RigState, freedom: Freedom, options: CalibrateOptions) -> RigSolution:
    """The solution next to a start, at all the moments of views."""
    state = start._replace(points=met_points(views, start)[None], lengths=start.lengths[:, :0])
    problem = _problem(views, state, freedom.whole, freedom.priors, options)
    for k, steps in enumerate(options.adjust.rounds):
        if k:
            problem = _problem(views, state, freedom.whole, freedom.priors, options)
            state, problem = _with_bones(state, problem, options)
        state = _descended(problem, state, steps, options)
    normal = problem.linear(state)
    _, reduced, _ = normal.eliminated(torch.zeros(1, dtype=torch.float64))
    covariance = _repeats(problem, state, options) * camera_covariance(reduced[0], freedom.shape, gauge(state.R[0], state.t[0]))
    return RigSolution(state, problem, _of_centers(covariance, state.R[0]))


def met_points(views: RigViews, state: RigState) -> Tensor:
    """Points ``(T, n, 3)`` nearest to the rays of one adjustment, lenses left out."""
    rays, known = viewing_rays(views, state.clocks[0], state.lens[0, :, 0].exp())
    return meeting_points(state.R[0], state.centers[0], rays, known).view(len(views.times), -1, 3)


def _problem(views: RigViews, state: RigState, basis: Tensor, priors: Priors, options: CalibrateOptions) -> RigAdjustment:
    """With positions that are seen now, and the noise that is left now."""
    b, c = state.R.shape[:2]
    unit = torch.ones(b, c, dtype=torch.float64)
    start = RigAdjustment(views, views.steady(state.clocks), unit, options.adjust.freedom, priors, basis)
    return replace(start, sigma=_noise(state, start, options))


def _noise(state: RigState, problem: RigAdjustment, options: CalibrateOptions) -> Tensor:
    """Robust standard deviation ``(b, c)`` px of each camera's noise."""
    seen = problem.views.at(state.clocks)
    known = problem.weights * seen.weights > 0
    far = (images(state, problem.views.centers) - seen.x).norm(dim=-1) / problem.views.noise[:, None, None]
    sigma = torch.where(known, far, torch.nan).flatten(1).nanmedian(-1).values.nan_to_num(1e6) / RAYLEIGH
    views = known.sum(1)
    mean = (views.sum((1, 2)) / (views > 0).sum((1, 2)).clamp(min=1)).clamp(min=2)
    sigma = (sigma * (2 * mean / (2 * mean - 3)).sqrt()).clamp(min=options.adjust.least_noise)
    return sigma[:, None] * problem.views.noise


def _descended(problem: RigAdjustment, state: RigState, steps: int, options: CalibrateOptions) -> RigState:
    settings = replace(options.descent, iterations=steps, tolerance=options.adjust.tolerance)
    return RigState(*minimize(problem, problem.evaluate(tuple(state)), settings).theta)


def _with_bones(state: RigState, problem: RigAdjustment, options: CalibrateOptions) -> tuple[RigState, RigAdjustment]:
    """With the lengths that stay the same, where these are asked for."""
    adjust = options.adjust
    if not adjust.lengths or state.points.shape[2] > adjust.length_points:
        return state._replace(lengths=state.lengths[:, :0]), problem
    blocks = replace(problem, bones=None).linear(state._replace(lengths=state.lengths[:, :0])).matrix[0]
    covariance = torch.linalg.pinv(blocks, hermitian=True).view(*state.points.shape[1:], 3)
    bones = learned(state.points[0], (problem.weights[0] > 0).sum(0) >= 2, covariance, adjust)
    lengths = state.lengths[:, :0] if bones is None else bones.lengths
    return state._replace(lengths=lengths), replace(problem, bones=bones)


def _repeats(problem: RigAdjustment, state: RigState, options: CalibrateOptions) -> float:
    r"""By how much fewer residuals there are than it seems: :math:`1 + 2 \sum_k \rho_k` of how they repeat themselves in time."""
    error, weight = problem.agreement(state, problem.views.at(state.clocks))
    rows = (error * weight.sqrt()[..., None])[0].movedim(1, 0).flatten(1)  # (T, *)
    total, count = 1.0, len(rows)
    power = float(rows.square().sum()) / max(count, 1)
    for lag in range(1, max(2, count // 4)):
        rho = float((rows[lag:] * rows[:-lag]).sum()) / max(count - lag, 1) / max(power, 1e-300)
        if not rho > options.adjust.repeated:
            break
        total += 2 * rho
    return total


def _of_centers(covariance: Tensor, R: Tensor) -> Tensor:
    """``(c, 11, 11)`` of each camera with its centre in place of its translation: :math:`dC = -R^T dt` about the centre."""
    c = len(R)
    own = covariance.view(c, PARAMETERS, c, PARAMETERS)
    own = torch.stack([own[i, :, i] for i in range(c)])
    change = torch.eye(PARAMETERS, dtype=torch.float64).repeat(c, 1, 1)
    change[:, 3:6, 3:6] = -R.mT
    return change @ own @ change.mT
