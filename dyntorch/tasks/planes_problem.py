r"""Least squares on translating planes and bodies: :math:`H_i = d_i H_\infty + e_i n_i^T,\ F_k = [e_k]_\times H_\infty`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from dyntorch.algebra.homogeneous import skew
from dyntorch.constants import constant
from dyntorch.forward import by_match, jacobian
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
        return self.models_of(pad(theta, (0, 1))[..., _own(self.planes, self.bodies, theta.device)])

    def models_of(self, entries: Tensor) -> Tensor:
        """The same from the parameters ``(*, p + m, 16)`` of each: homography at infinity, epipole, plane (0 for a body)."""
        infinity, epipoles, planes = entries.split([9, 3, 4], dim=-1)
        infinity, p = infinity.unflatten(-1, (3, 3)), self.planes
        along, moving = epipoles[..., :p, :], epipoles[..., p:, :]
        homographies = planes[..., :p, 3, None, None] * infinity[..., :p, :, :] + along[..., :, None] * planes[..., :p, None, :3]
        return torch.cat([homographies, skew(moving) @ infinity[..., p:, :, :]], dim=-3)


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

        def residual(entries: Tensor, scales: tuple[Tensor, ...], views: tuple[Tensor, ...]) -> Tensor:
            return static_residual([entries.unflatten(-1, (3, 3))], views, scales)

        value, slope = by_match(residual, models.reshape(b * p, 9), scales, views)
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

    def normal_equations(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cost ``(b,)``, gradient ``(b, size)`` and Gauss-Newton matrix ``(b, size, size)``."""
        own, size = _own(self.layout.planes, self.layout.bodies, theta.device), self.layout.size
        # a plane or body depends on 16 parameters: its share has that size, whatever their number
        entries = pad(theta, (0, 1))[:, own]
        flat, slopes = jacobian(lambda each: self.layout.models_of(each).flatten(-2), entries)
        models, slope = flat.unflatten(-1, (3, 3)), slopes  # (b, c, 16, 9)
        normal = self.evidence.normal(models)
        gradient = theta.new_zeros(len(theta), size + 1)
        gradient.index_add_(1, own.flatten(), (slope @ normal.gradient[..., None]).flatten(1))
        matrix = theta.new_zeros(len(theta), (size + 1) ** 2)
        place = own[:, :, None] * (size + 1) + own[:, None]
        matrix.index_add_(1, place.flatten(), (slope @ normal.matrix @ slope.mT).flatten(1))
        cost = normal.cost.sum(1)
        square = matrix.unflatten(1, (size + 1, size + 1))[:, :size, :size]
        return torch.where(cost.isfinite(), cost, torch.inf), gradient[:, :size], square


@constant
def _own(planes: int, bodies: int, device: torch.device) -> Tensor:
    """Where the 16 parameters of every plane and body are, ``(p + m, 16)``; a body has no plane, and points behind the end."""
    count = planes + bodies
    shared = torch.arange(9, device=device).expand(count, 9)
    epipoles = 9 + torch.arange(3 * count, device=device).reshape(count, 3)
    own = 9 + 3 * count + torch.arange(4 * planes, device=device).reshape(planes, 4)
    none = torch.full((bodies, 4), 9 + 3 * count + 4 * planes, device=device)
    return torch.cat([shared, epipoles, torch.cat([own, none])], dim=1)
