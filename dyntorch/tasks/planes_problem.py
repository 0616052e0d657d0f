r"""Least squares on translating planes and bodies: :math:`H_i = d_i H_\infty + e_i n_i^T,\ F_k = [e_k]_\times H_\infty`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from dyntorch.algebra.homogeneous import skew
from dyntorch.forward import jacobian
from dyntorch.invariants.agreement import static_residual
from dyntorch.invariants.fundamental_matrix import FundamentalMatrix
from dyntorch.residual import multilinear_derivative


class Normal(NamedTuple):
    """Least squares in the entries of each of c matrices."""

    cost: Tensor
    """``(b, c)``."""
    gradient: Tensor
    """``(b, c, 9)``."""
    matrix: Tensor
    """``(b, c, 9, 9)``, of Gauss and Newton."""


@dataclass(frozen=True)
class Layout:
    r"""Parameters ``(*, size)`` of p planes and m bodies: :math:`H_\infty`, all epipoles, the planes :math:`(n_i, d_i)`."""

    planes: int
    bodies: int

    @property
    def shared(self) -> int:
        """Size of the part that has one scale: the homography at infinity and the epipoles."""
        return 9 + 3 * (self.planes + self.bodies)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.shared + 4 * self.planes

    @staticmethod
    def pack(infinity: Tensor, epipoles: Tensor, planes: Tensor) -> Tensor:
        """The inverse of :meth:`unpack`."""
        return torch.cat([infinity.flatten(-2), epipoles.flatten(-2), planes.flatten(-2)], dim=-1)

    def unpack(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """``(*, 3, 3)`` homography at infinity, ``(*, p + m, 3)`` epipoles, ``(*, p, 4)`` planes."""
        infinity, epipoles, planes = theta.split([9, self.shared - 9, 4 * self.planes], dim=-1)
        count = self.planes + self.bodies
        return infinity.unflatten(-1, (3, 3)), epipoles.unflatten(-1, (count, 3)), planes.unflatten(-1, (self.planes, 4))

    def parts(self, theta: Tensor) -> tuple[Tensor, ...]:
        r"""The parts of any scale: each plane is homogeneous, and all projections :math:`[H_\infty \mid e_i]` share one scale."""
        return theta.split([self.shared] + [4] * self.planes, dim=-1)

    def models(self, theta: Tensor) -> Tensor:
        """``(*, p + m, 3, 3)`` homographies of the planes, then fundamental matrices of the bodies."""
        infinity, epipoles, planes = self.unpack(theta)
        infinity = infinity[..., None, :, :]
        along, moving = epipoles[..., : self.planes, :], epipoles[..., self.planes :, :]
        homographies = planes[..., 3, None, None] * infinity + along[..., :, None] * planes[..., None, :3]
        return torch.cat([homographies, skew(moving) @ infinity], dim=-3)


@dataclass(frozen=True)
class Matrices:
    r"""Measured matrices: the residual of M is what :math:`M / \langle M, G \rangle` differs from the given matrix G of norm 1.

    Attributes:
        given: ``(b, c, 3, 3)`` of norm 1; zero where one is missing.
        weights: ``(c,)`` inverse variances.
    """

    given: Tensor
    weights: Tensor

    def normal(self, models: Tensor) -> Normal:
        """Cost and derivatives by the entries of the models ``(b, c, 3, 3)``."""
        m, g = models.flatten(-2), self.given.flatten(-2)
        along = (m * g).sum(-1, keepdim=True)
        there = (g != 0).any(-1)
        along = torch.where(there[..., None], torch.where(along == 0, torch.finfo(m.dtype).tiny, along), 1.0)
        image = m / along
        eye = torch.eye(9, dtype=m.dtype, device=m.device)
        weight = there * self.weights
        # transposed derivative of the residual
        slope = (eye - g[..., :, None] * image[..., None, :]) / along[..., None]
        return _normal(weight[..., None] * (image - g), image - g, slope, weight)

    def each(self, function: Callable[[Tensor], Tensor]) -> Matrices:
        """With every array of problems changed."""
        return replace(self, given=function(self.given))


def _normal(weighted: Tensor, value: Tensor, slope: Tensor, weight: Tensor) -> Normal:
    cost = (weighted * value).sum(-1)
    return Normal(cost, (slope @ weighted[..., None])[..., 0], weight[..., None, None] * (slope @ slope.mT))


@dataclass(frozen=True)
class Matches:
    """Matches in normalized coordinates: Sampson distances in the unit of the measured points.

    Attributes:
        planes: two views ``(b, p, n, 2)`` of the points of the planes, finite.
        plane_weights: ``(b, p, n)``, 0 = missing.
        bodies: two views ``(b, m, n', 2)`` of the points of the bodies.
        body_weights: ``(b, m, n')``.
        scales: two views ``(b,)``, the unit of the measured points in normalized coordinates.
    """

    planes: tuple[Tensor, Tensor]
    plane_weights: Tensor
    bodies: tuple[Tensor, Tensor]
    body_weights: Tensor
    scales: tuple[Tensor, Tensor]

    def normal(self, models: Tensor) -> Normal:
        """Cost and derivatives by the entries of the models ``(b, p + m, 3, 3)``."""
        p = self.plane_weights.shape[1]
        rows = (self._homographies(models[:, :p]), self._fundamentals(models[:, p:]))
        found = [((value.square()).sum(-1), (slope @ value[..., None])[..., 0], slope @ slope.mT) for value, slope in rows]
        return Normal(*(torch.cat(parts, dim=1) for parts in zip(*found, strict=True)))

    def _homographies(self, models: Tensor) -> tuple[Tensor, Tensor]:
        """Whitened residuals ``(b, p, 2 n)`` and their derivatives ``(b, p, 9, 2 n)``."""
        (x1, x2), (s1, s2), (b, p, n) = self.planes, self.scales, self.plane_weights.shape
        if not p:
            return models.new_zeros(b, 0, 2 * n), models.new_zeros(b, 0, 9, 2 * n)
        views = x2.flatten(0, 1), x1.flatten(0, 1)
        scales = s2.repeat_interleave(p), s1.repeat_interleave(p)

        def residual(entries: Tensor) -> Tensor:
            return static_residual([entries.unflatten(-1, (3, 3))], views, scales).flatten(1)

        value, slope = jacobian(residual, models.reshape(b * p, 9))
        root = self.plane_weights.sqrt().repeat_interleave(2, dim=-1)
        return value.reshape(b, p, 2 * n) * root, slope.reshape(b, p, 9, 2 * n) * root[..., None, :]

    def _fundamentals(self, models: Tensor) -> tuple[Tensor, Tensor]:
        """Sampson residuals ``(b, m, n')`` and their derivatives ``(b, m, 9, n')``."""
        scales = self.scales[0][:, None], self.scales[1][:, None]
        value, slope = multilinear_derivative(FundamentalMatrix(), models, self.bodies, scales)
        root = self.body_weights.sqrt()
        return value * root, (slope * root[..., None]).mT

    def each(self, function: Callable[[Tensor], Tensor]) -> Matches:
        """With every array of problems changed."""

        def both(pair: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
            return function(pair[0]), function(pair[1])

        plane_weights, body_weights = both((self.plane_weights, self.body_weights))
        return Matches(both(self.planes), plane_weights, both(self.bodies), body_weights, both(self.scales))


@dataclass(frozen=True)
class PlanesProblem:
    """Least squares over a block of problems; a :class:`dyntorch.least_squares.Minimand`."""

    layout: Layout
    evidence: Matrices | Matches

    def parts(self, theta: Tensor) -> tuple[Tensor, ...]:
        """The parts of parameters ``(b, size)`` that have a scale each."""
        return self.layout.parts(theta)

    def subset(self, keep: Tensor) -> PlanesProblem:
        """Only some of the problems."""
        return replace(self, evidence=self.evidence.each(lambda x: x[keep]))

    def repeated(self, count: int) -> PlanesProblem:
        """All problems ``count`` times, one round after the other."""
        return replace(self, evidence=self.evidence.each(lambda x: x.repeat(count, *[1] * (x.ndim - 1))))

    def blocks(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cost ``(b, c)``, gradient ``(b, c, size)`` and Gauss-Newton matrix ``(b, c, size, size)`` of every plane and body."""
        models, slope = jacobian(lambda t: self.layout.models(t).flatten(1), theta)
        slope = slope.unflatten(-1, (-1, 9)).transpose(1, 2)  # (b, c, size, 9)
        normal = self.evidence.normal(models.unflatten(-1, (-1, 3, 3)))
        return normal.cost, (slope @ normal.gradient[..., None])[..., 0], slope @ normal.matrix @ slope.mT

    def normal_equations(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cost ``(b,)``, gradient ``(b, size)`` and Gauss-Newton matrix ``(b, size, size)``."""
        cost, gradient, matrix = (part.sum(1) for part in self.blocks(theta))
        return torch.where(cost.isfinite(), cost, torch.inf), gradient, matrix
