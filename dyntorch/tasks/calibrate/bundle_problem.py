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

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from dyntorch.geometry.homogeneous import cofactors, skew
from dyntorch.geometry.rigid import rotation_exponential
from dyntorch.numerics.least_squares import Iterate, LeastSquares, Tensors, damped_step
from dyntorch.tasks.calibrate.observations import RigViews, Seen

TURN, MOVE, LENS, CLOCK = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 11)
"""Places of a camera's parameters: rotation vector and translation; logarithm of the focal length, k1, k2; offset, log rate."""
PARAMETERS = 11
MIN_DEPTH = 1e-3
"""Depth that stands in for smaller ones and for points behind a camera, whose images are then far away."""


class RigState(NamedTuple):
    """Where b adjustments are."""

    R: Tensor
    """``(b, c, 3, 3)`` world to camera."""
    t: Tensor
    """``(b, c, 3)``."""
    lens: Tensor
    """``(b, c, 3)``: logarithm of the focal length, k1, k2."""
    clocks: Tensor
    """``(b, c, 2)``: a camera's clock against the reference clock at the middle moment, seconds; logarithm of the rate."""
    points: Tensor
    """``(b, T, n, 3)``."""

    def of(self, keep: Tensor) -> RigState:
        """Of some of the adjustments."""
        return RigState(*(part[keep] for part in self))

    @property
    def centers(self) -> Tensor:
        """``(b, c, 3)``."""
        return -(self.R.mT @ self.t[..., None])[..., 0]


@dataclass(frozen=True)
class Priors:
    """What is known beforehand of log focal, k1, k2, offset and log rate, ``(c, 5)`` each."""

    mean: Tensor
    scale: Tensor
    """Infinite where nothing is known."""

    def costs(self, state: RigState) -> Tensor:
        """Twice the negative logarithm ``(b,)``."""
        square = ((_prior_parameters(state) - self.mean) / self.scale).square()
        return torch.where(self._heavy, 2 * square.log1p(), square).sum((1, 2))

    def equations(self, state: RigState) -> tuple[Tensor, Tensor]:
        """Curvature of the quadratic model and gradient, ``(b, c, 5)``."""
        away = _prior_parameters(state) - self.mean
        weight = self.scale.square().reciprocal()
        weight = torch.where(self._heavy, 2 * weight / (1 + away.square() * weight), weight)
        return weight, weight * away

    @property
    def _heavy(self) -> Tensor:
        return torch.arange(self.mean.shape[1]) == 1


@dataclass(frozen=True)
class RigNormal:
    """Normal equations of G points, and of P = 11 c parameters of cameras."""

    matrix: Tensor
    """``(b, G, 3, 3)``."""
    mixed: Tensor
    """``(b, G, 3, P + 1)``; the last column is the gradient by the points."""
    others: Tensor
    """``(b, P, P)``."""
    gradient: Tensor
    """``(b, P)``."""

    def eliminated(self, damping: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Solutions ``(b, G, 3, P + 1)`` of all columns by the points; matrix and gradient that are left of the cameras."""
        diagonal = self.matrix.diagonal(dim1=-2, dim2=-1)
        held = self.matrix.clone()
        # points that nobody sees have no equation: they stay
        floor = damping[:, None, None] * diagonal + torch.where(diagonal > 0, 0.0, 1.0)
        held.diagonal(dim1=-2, dim2=-1).add_(floor + 1e-12 * diagonal.amax(-1, keepdim=True))
        # in closed form: LAPACK takes one small matrix after the other
        inverse = cofactors(held) / torch.linalg.det(held).clamp(min=torch.finfo(held.dtype).tiny)[..., None, None]
        solved = inverse @ self.mixed
        solved = torch.where(solved.isfinite(), solved, 0.0)
        product = self.mixed[..., :-1].flatten(1, 2).mT @ solved.flatten(1, 2)
        return solved, self.others - product[..., :-1], self.gradient - product[..., -1]


@dataclass(frozen=True)
class RigAdjustment(LeastSquares):
    """b adjustments of the same views from different starts."""

    views: RigViews
    weights: Tensor
    """``(b, c, T, n)``: which positions take part, held while a descent goes on."""
    sigma: Tensor
    """``(b, c)`` px of the noise."""
    freedom: float
    """Of Student's t."""
    priors: Priors
    basis: Tensor
    """``(11 c, q)``: the q free parameters, each a column that says which of the cameras' parameters it changes."""

    def subset(self, keep: Tensor) -> RigAdjustment:
        """Only some of the starts."""
        return replace(self, weights=self.weights[keep], sigma=self.sigma[keep])

    def evaluate(self, theta: Tensors) -> Iterate:
        """The cost ``(b,)``."""
        state = RigState(*theta)
        seen = self.views.at(state.clocks)
        share = (images(state, self.views.centers) - seen.x).square().sum(-1)
        share = share / (self.freedom * self.sigma.square()[..., None, None])
        known = self.weights * (seen.weights > 0)
        total = (known * (self.freedom + 2) * share.log1p()).sum((1, 2, 3))
        total = total + self.priors.costs(state)
        return Iterate(theta, torch.where(total.isfinite(), total, torch.inf), ())

    def step(self, at: Iterate, damping: Tensor) -> Tensors:
        """The damped Gauss-Newton step."""
        state = RigState(*at.theta)
        normal = self.linear(state)
        solved, reduced, gradient = normal.eliminated(damping)
        if self.basis.shape[1]:
            moves = damped_step(gradient @ self.basis, self.basis.mT @ reduced @ self.basis, damping) @ self.basis.mT
        else:
            moves = torch.zeros_like(gradient)
        points = solved[..., -1] - (solved[..., :-1] @ moves[:, None, :, None])[..., 0]
        return moves.unflatten(1, (-1, PARAMETERS)), points.reshape(state.points.shape)

    def retract(self, theta: Tensors, step: Tensors) -> Tensors:
        """Cameras turn about their own centres."""
        state, (cameras, points) = RigState(*theta), step
        turn = rotation_exponential(-cameras[..., TURN])
        return RigState(
            turn @ state.R,
            (turn @ state.t[..., None])[..., 0] - cameras[..., MOVE],
            state.lens - cameras[..., LENS],
            state.clocks - cameras[..., CLOCK],
            state.points - points,
        )

    def agreement(self, state: RigState, seen: Seen) -> tuple[Tensor, Tensor]:
        """Errors ``(b, c, T, n, 2)`` px and what the quadratic model weighs them by ``(b, c, T, n)``."""
        error = images(state, self.views.centers) - seen.x
        spread = self.sigma.square()[..., None, None]
        share = error.square().sum(-1) / (self.freedom * spread)
        known = self.weights * (seen.weights > 0)
        return error, known * (self.freedom + 2) / self.freedom / (1 + share) / spread

    def linear(self, state: RigState) -> RigNormal:
        """The normal equations at a state."""
        b, T, n = state.points.shape[:3]
        c = state.R.shape[1]
        total = c * PARAMETERS
        blocks = state.points.new_zeros(b, T, n, 3, 3)
        mixed = state.points.new_zeros(b, T, n, 3, total + 1)
        reduced, gradient = state.points.new_zeros(b, total, total), state.points.new_zeros(b, total)
        seen = self.views.at(state.clocks)
        errors, weights = self.agreement(state, seen)
        for i in range(c):
            place = slice(i * PARAMETERS, (i + 1) * PARAMETERS)
            by_point, by_camera = _derivatives(state, i, seen.v[:, i], self.views.times)
            weight, error = weights[:, i, ..., None, None], errors[:, i, ..., None]
            heavy, rows = (by_point * weight).mT, (by_camera * weight).flatten(1, 3).mT
            blocks += heavy @ by_point
            mixed[..., place] = heavy @ by_camera
            mixed[..., -1:] += heavy @ error
            reduced[:, place, place] = rows @ by_camera.flatten(1, 3)
            gradient[:, place] = (rows @ error.flatten(1, 3))[..., 0]
        self._add_priors(state, reduced, gradient)
        return RigNormal(blocks.flatten(1, 2), mixed.flatten(1, 2), reduced, gradient)

    def _add_priors(self, state: RigState, reduced: Tensor, gradient: Tensor) -> None:
        weights, slopes = self.priors.equations(state)
        for i in range(weights.shape[1]):
            place = torch.arange(i * PARAMETERS + LENS.start, (i + 1) * PARAMETERS)
            reduced[:, place, place] += weights[:, i]
            gradient[:, place] += slopes[:, i]


def images(state: RigState, centers: Tensor) -> Tensor:
    """Images ``(b, c, T, n, 2)`` px of the points in all cameras, with principal points ``(c, 2)``."""
    u = _rays(state.R[:, :, None, None], state.t[:, :, None, None], state.points[:, None])[1]
    lens = state.lens[:, :, None, None]
    return lens[..., :1].exp() * _distortion(u, lens)[1] * u + centers[:, None, None]


def _rays(R: Tensor, t: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Points in the frame of a camera, and divided by their depths."""
    seen = (points[..., None, :] * R).sum(-1) + t
    return seen, seen[..., :2] / seen[..., 2:].clamp(min=MIN_DEPTH)


def _distortion(u: Tensor, lens: Tensor) -> tuple[Tensor, Tensor]:
    """Squared distance from the axis, and what the lens multiplies it by."""
    square = u.square().sum(-1, keepdim=True)
    return square, 1 + square * (lens[..., 1:2] + lens[..., 2:] * square)


def _prior_parameters(state: RigState) -> Tensor:
    """``(b, c, 5)``: what priors are about."""
    return torch.cat([state.lens, state.clocks], dim=-1)


def _derivatives(state: RigState, i: int, v: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives of the errors of a camera by the points ``(b, T, n, 2, 3)`` and by its parameters ``(b, T, n, 2, 11)``."""
    R, lens = state.R[:, i, None, None], state.lens[:, i, None, None]
    seen, u = _rays(R, state.t[:, i, None, None], state.points)
    square, bend = _distortion(u, lens)
    focal, k1, k2 = lens[..., :1].exp(), lens[..., 1:2], lens[..., 2:]
    eye = torch.eye(2, dtype=u.dtype)
    by_u = focal[..., None] * (bend[..., None] * eye + 2 * (k1 + 2 * k2 * square)[..., None] * u[..., None] * u[..., None, :])
    by_seen = torch.cat([by_u, -by_u @ u[..., None]], dim=-1) / seen[..., 2:].clamp(min=MIN_DEPTH)[..., None]
    delta = times[:, None, None] * state.clocks[:, i, 1, None, None, None].exp()
    own = torch.stack([focal * bend * u, focal * square * u, focal * square.square() * u, -v, -v * delta], dim=-1)
    return by_seen @ R, torch.cat([-by_seen @ skew(seen), by_seen, own], dim=-1)


# ----------------------------------------------------------------------------------------------------------------------
# What is known of the cameras in the end.


def gauge(R: Tensor, t: Tensor) -> Tensor:
    """Changes of the world ``(11 c, 7)`` that no image tells: turns, shifts, and scale, as changes of cameras ``(c, ...)``."""
    c = len(R)
    total = R.new_zeros(c, PARAMETERS, 7)
    total[:, TURN, :3] = -R
    total[:, MOVE, :3] = -skew(t) @ R
    total[:, MOVE, 3:6] = -R
    total[:, MOVE, 6] = t
    return total.flatten(0, 1)


def camera_covariance(reduced: Tensor, basis: Tensor, unseen: Tensor) -> Tensor:
    """Covariance ``(11 c, 11 c)`` of the cameras from their information, in the world whose changes have no part in it."""
    inside = basis / basis.norm(dim=0)
    world = torch.linalg.qr(inside.mT @ unseen).Q
    allowed = inside @ torch.linalg.qr(world, mode="complete").Q[:, 7:]
    matrix = allowed.mT @ reduced @ allowed
    diagonal = matrix.diagonal()
    # rounding may leave less than nothing of what is not known
    scale = diagonal.clamp(min=max(1e-20 * float(diagonal.max()), torch.finfo(matrix.dtype).tiny)).rsqrt()
    # what the images do not tell has no information: its variance is as large as numbers can say
    eye = torch.eye(len(matrix), dtype=matrix.dtype)
    factor, failed = torch.linalg.cholesky_ex(scale[:, None] * matrix * scale + 1e-12 * eye)
    inverse = 1e12 * eye if int(failed) else torch.cholesky_inverse(factor)
    spread = scale[:, None] * inverse * scale
    return allowed @ spread @ allowed.mT
