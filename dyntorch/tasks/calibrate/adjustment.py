r"""The least squares problem of a rig: cameras, lenses, clocks and points in one adjustment, and what is known of the cameras then.

What is minimized is in :mod:`dyntorch.tasks.calibrate.bundle`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from dyntorch.geometry.homogeneous import skew
from dyntorch.geometry.rigid import rotation_exponential
from dyntorch.numerics.least_squares import Iterate, LeastSquares, Tensors, damped_step
from dyntorch.tasks.calibrate.input import RigViews, Sightings

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
    """Normal equations of G points, and of P = 11 c parameters of cameras; those that no column of the basis changes are 0.  Points
    come last: what is computed for all of them are products of whole planes."""

    matrix: Tensor
    """``(b, 3, 3, G)``."""
    slope: Tensor
    """``(b, 3, G)``, the gradient by the points."""
    mixed: Tensor
    """``(b, 3, p, G)``, of the p parameters that vary."""
    place: Tensor
    """``(p,)``: which of the P these are."""
    others: Tensor
    """``(b, P, P)``."""
    gradient: Tensor
    """``(b, P)``."""

    def eliminate_points(self, damping: Tensor) -> tuple[PointFactor, Tensor, Tensor]:
        """What moves the points once the cameras have moved; matrix and gradient that are left of the cameras."""
        diagonal = self.matrix.diagonal(dim1=1, dim2=2)  # (b, G, 3)
        # points that nobody sees have no equation: they stay
        floor = damping[:, None, None] * diagonal + torch.where(diagonal > 0, 0.0, 1.0)
        factor = PointFactor.of(self, (diagonal + floor + 1e-12 * diagonal.amax(-1, keepdim=True)).movedim(-1, 0))
        others, gradient = self.others.clone(), self.gradient.clone()
        others[:, self.place[:, None], self.place] -= (factor.mixed @ factor.mixed.mT).sum(1)
        gradient[:, self.place] -= (factor.mixed @ factor.slope[..., None]).sum(1)[..., 0]
        return factor, others, gradient


@dataclass(frozen=True)
class PointFactor:
    """Cholesky factors L of the points' matrices, and what else is :math:`L^{-1}` times that of :class:`RigNormal`."""

    inverse: tuple[Tensor, Tensor, Tensor]
    """``(b, G)``: one over the diagonal, 0 where there is none."""
    below: tuple[Tensor, Tensor, Tensor]
    """``(b, G)``: L_10, L_20, L_21."""
    mixed: Tensor
    slope: Tensor

    @staticmethod
    def of(normal: RigNormal, diagonal: Tensor) -> PointFactor:
        """With the damped diagonal ``(3, b, G)`` of the matrices."""

        def one_over(square: Tensor) -> Tensor:
            return torch.where(square > 0, square.rsqrt(), 0.0)

        # by hand: LAPACK takes one small matrix after the other
        i0 = one_over(diagonal[0])
        l10, l20 = normal.matrix[:, 1, 0] * i0, normal.matrix[:, 2, 0] * i0
        i1 = one_over(diagonal[1] - l10.square())
        l21 = (normal.matrix[:, 2, 1] - l20 * l10) * i1
        i2 = one_over(diagonal[2] - l20.square() - l21.square())

        def apply_inverse(right: Tensor) -> Tensor:
            out = torch.empty_like(right)
            extra = (slice(None), *[None] * (right.ndim - 3))
            first = torch.mul(right[:, 0], i0[extra], out=out[:, 0])
            second = torch.addcmul(right[:, 1], l10[extra], first, value=-1, out=out[:, 1]).mul_(i1[extra])
            third = torch.addcmul(right[:, 2], l20[extra], first, value=-1, out=out[:, 2])
            third.addcmul_(l21[extra], second, value=-1).mul_(i2[extra])
            return out.nan_to_num_(nan=0.0, posinf=0.0, neginf=0.0)

        return PointFactor((i0, i1, i2), (l10, l20, l21), apply_inverse(normal.mixed), apply_inverse(normal.slope))

    def steps(self, moves: Tensor) -> Tensor:
        """Steps ``(b, 3, G)`` of the points with those of the p parameters ``(b, p)``."""
        (i0, i1, i2), (l10, l20, l21) = self.inverse, self.below
        y = self.slope - (moves[:, None, None] @ self.mixed)[:, :, 0]
        third = y[:, 2] * i2
        second = (y[:, 1] - l21 * third) * i1
        return torch.stack([(y[:, 0] - l10 * second - l20 * third) * i0, second, third], dim=1)


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

    @cached_property
    def kinds(self) -> list[int]:
        """Which of the 11 parameters of a camera vary, in some camera."""
        changed = (self.basis != 0).any(-1).view(-1, PARAMETERS).any(0)
        return [int(k) for k in changed.nonzero()]

    def evaluate(self, theta: Tensors) -> Iterate:
        """The cost ``(b,)``, and what is seen at the times of the clocks, which the next step takes, too."""
        return self._evaluate(RigState(*theta), sighting_planes(self.views.at(theta[3])))

    def advance(self, at: Iterate, step: Tensors) -> Iterate:
        """The place after a step; clocks that stay show what they have shown."""
        state = RigState(*self.retract(at.theta, step))
        still = CLOCK.start not in self.kinds and CLOCK.stop - 1 not in self.kinds
        return self._evaluate(state, Planes(*at.terms) if still else sighting_planes(self.views.at(state.clocks)))

    def _evaluate(self, state: RigState, seen: Planes) -> Iterate:
        share = (_images(state, self.views.centers) - seen.x).square().sum(2) / (self.freedom * self.sigma.square()[..., None])
        total = (self._position_weights(seen) * (self.freedom + 2) * share.log1p_()).sum((1, 2)) + self.priors.costs(state)
        return Iterate(tuple(state), torch.where(total.isfinite(), total, torch.inf), tuple(seen))

    def _position_weights(self, seen: Planes) -> Tensor:
        return self.weights.flatten(2) * (seen.weights > 0)

    def step(self, at: Iterate, damping: Tensor) -> Tensors:
        """The damped Gauss-Newton step."""
        state = RigState(*at.theta)
        normal = self.linear(state, Planes(*at.terms))
        factor, reduced, gradient = normal.eliminate_points(damping)
        if self.basis.shape[1]:
            moves = damped_step(gradient @ self.basis, self.basis.mT @ reduced @ self.basis, damping) @ self.basis.mT
        else:
            moves = torch.zeros_like(gradient)
        points = factor.steps(moves[:, normal.place])
        return moves.unflatten(1, (-1, PARAMETERS)), points.mT.reshape(state.points.shape)

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

    def agreement(self, state: RigState, seen: Planes) -> tuple[Tensor, Tensor]:
        """Errors ``(b, c, 2, G)`` px and what the quadratic model weighs them by ``(b, c, G)``."""
        error = _images(state, self.views.centers) - seen.x
        spread = self.sigma.square()[..., None]
        share = error.square().sum(2) / (self.freedom * spread)
        return error, self._position_weights(seen) * (self.freedom + 2) / self.freedom / (1 + share) / spread

    def linear(self, state: RigState, seen: Planes | None = None) -> RigNormal:
        """The normal equations at a state."""
        seen = sighting_planes(self.views.at(state.clocks)) if seen is None else seen
        error, weights = self.agreement(state, seen)
        weight = weights[:, :, None, None]
        by_point, by_camera = _derivatives(state, self.kinds, seen.v, self.views.times)
        (b, c), (count, points) = error.shape[:2], by_camera.shape[3:]
        heavy = by_point * weight  # (b, c, 2, 3, G)
        matrix = error.new_empty(b, 3, 3, points)
        for i, j in ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2)):
            matrix[:, i, j] = matrix[:, j, i] = (heavy[:, :, :, i] * by_point[:, :, :, j]).sum((1, 2))
        slope = (heavy * error[:, :, :, None]).sum((1, 2))
        mixed = error.new_empty(b, 3, c, count, points)
        planes = mixed.transpose(1, 2)
        torch.mul(heavy[:, :, 0, :, None], by_camera[:, :, 0, None], out=planes)
        planes.addcmul_(heavy[:, :, 1, :, None], by_camera[:, :, 1, None])
        rows = by_camera * weight
        own, pull = (rows @ by_camera.mT).sum(2), (rows @ error[..., None]).sum(2)[..., 0]
        place = torch.tensor(self.kinds, dtype=torch.long) + PARAMETERS * torch.arange(c)[:, None]  # (c, count)
        reduced, gradient = error.new_zeros(b, c * PARAMETERS, c * PARAMETERS), error.new_zeros(b, c * PARAMETERS)
        reduced[:, place[:, :, None], place[:, None]] = own
        gradient[:, place] = pull
        self._add_priors(state, reduced, gradient)
        return RigNormal(matrix, slope, mixed.flatten(2, 3), place.flatten(), reduced, gradient)

    def _add_priors(self, state: RigState, reduced: Tensor, gradient: Tensor) -> None:
        weights, slopes = self.priors.equations(state)
        for i in range(weights.shape[1]):
            place = torch.arange(i * PARAMETERS + LENS.start, (i + 1) * PARAMETERS)
            reduced[:, place, place] += weights[:, i]
            gradient[:, place] += slopes[:, i]


class Planes(NamedTuple):
    """What is seen, moments and points together in the last dimension, G of them."""

    x: Tensor  # (b, c, 2, G) px
    v: Tensor  # (b, c, 2, G) px per second
    weights: Tensor  # (b, c, G)


def sighting_planes(seen: Sightings) -> Planes:
    return Planes(seen.x.flatten(2, 3).mT.contiguous(), seen.v.flatten(2, 3).mT.contiguous(), seen.weights.flatten(2))


def images(state: RigState, centers: Tensor) -> Tensor:
    """Images ``(b, c, T, n, 2)`` px of the points in all cameras, with principal points ``(c, 2)``."""
    return _images(state, centers).mT.unflatten(2, state.points.shape[1:3])


def _images(state: RigState, centers: Tensor) -> Tensor:
    """The same, ``(b, c, 2, G)``."""
    u = _rays(state)[2]
    focal, k1, k2 = _lens(state)
    square = u.square().sum(2)
    return (focal * (1 + square * (k1 + k2 * square)))[:, :, None] * u + centers[..., None]


def _rays(state: RigState) -> tuple[Tensor, Tensor, Tensor]:
    """Points ``(b, c, 3, G)`` in the frames of the cameras, their depths, and what is divided by these ``(b, c, 2, G)``."""
    b, c = state.t.shape[:2]
    seen = (state.R.reshape(b, 3 * c, 3) @ state.points.flatten(1, 2).mT).unflatten(1, (c, 3)) + state.t[..., None]
    depth = seen[:, :, 2].clamp(min=MIN_DEPTH)
    return seen, depth, seen[:, :, :2] / depth[:, :, None]


def _lens(state: RigState) -> tuple[Tensor, Tensor, Tensor]:
    """Focal length, k1 and k2, ``(b, c, 1)`` each."""
    logs, k1, k2 = state.lens[..., None].unbind(2)
    return logs.exp(), k1, k2


def _prior_parameters(state: RigState) -> Tensor:
    """``(b, c, 5)``: what priors are about."""
    return torch.cat([state.lens, state.clocks], dim=-1)


def _derivatives(state: RigState, kinds: list[int], v: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives of the errors by the points ``(b, c, 2, 3, G)`` and by the cameras' parameters ``(b, c, 2, kinds, G)``."""
    seen, depth, u = _rays(state)
    focal, k1, k2 = _lens(state)
    square = u.square().sum(2)
    bend = focal * (1 + square * (k1 + k2 * square))
    # focal (bend I + slope u u^T)
    along = (2 * focal * (k1 + 2 * k2 * square))[:, :, None] * u
    by_seen = u.new_empty(*u.shape[:3], 3, u.shape[-1])
    torch.mul(along[:, :, :, None], u[:, :, None], out=by_seen[:, :, :, :2])
    by_seen[:, :, 0, 0] += bend
    by_seen[:, :, 1, 1] += bend
    by_seen[:, :, :, 2] = -(by_seen[:, :, :, :2] * u[:, :, None]).sum(3)
    by_seen /= depth[:, :, None, None]
    delta = times.repeat_interleave(state.points.shape[2]) * state.clocks[:, :, 1:].exp()
    parts = {
        LENS.start: lambda: bend[:, :, None] * u,
        LENS.start + 1: lambda: (focal * square)[:, :, None] * u,
        LENS.start + 2: lambda: (focal * square.square())[:, :, None] * u,
        CLOCK.start: lambda: -v,
        CLOCK.start + 1: lambda: -v * delta[:, :, None],
    }
    by_camera = u.new_empty(*u.shape[:3], len(kinds), u.shape[-1])
    x, y, z = seen[:, :, None].unbind(3)
    p, q, r = by_seen.unbind(3)
    turned = y * r - z * q, z * p - x * r, x * q - y * p
    for place, kind in enumerate(kinds):
        if kind < LENS.start:
            by_camera[:, :, :, place] = (turned, (p, q, r))[kind // 3][kind % 3]
        else:
            by_camera[:, :, :, place] = parts[kind]()
    return state.R[:, :, None].mT @ by_seen, by_camera


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
