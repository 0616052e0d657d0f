"""Reprojection residuals under projections P^k -> P^l: of a match with its point eliminated, of a view with its camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import torch
from torch import Tensor

from dyntorch.core.invariant import Frame, Invariant
from dyntorch.core.matches import constellations
from dyntorch.geometry.homogeneous import unit_vectors
from dyntorch.numerics.blocks import constant
from dyntorch.numerics.least_squares import jacobian
from dyntorch.numerics.nullspace import gram_null_space, null_space
from dyntorch.shapes import static
from dyntorch.shapes.static import AFFINE, GENERAL, PLANE, local

STEPS = 2
"""Gauss-Newton steps from the algebraic point to the one of least reprojection error."""
SPREAD = 1e-12
"""Of the trace: what keeps the inverse of a point's information finite where its views do not determine it."""
FLOOR = 1e-15
"""Of the last coordinate of an image, with point and projections of norm 1: points at infinity stay finite."""
TINY = 1e-100


class Linearization(NamedTuple):
    """Residuals of matches at the points that they show, and their first derivatives."""

    error: Tensor
    """``(*batch, n, c)`` measurement minus image over the noise; c the coordinates of all views."""
    structure: Tensor
    """``(*batch, n, K)`` points of norm 1."""
    slope: Tensor
    """``(*batch, n, c, K)`` of the images (not of the error) by the points."""
    inverse: Tensor
    """``(*batch, n, K, K)`` inverse of the information on each point, its scale fixed."""
    depth: Tensor
    """``(*batch, n, c)`` last coordinate of the image that each coordinate belongs to."""
    image: Tensor
    """``(*batch, n, c)`` coordinates of the images."""
    weight: Tensor
    """``(*batch, 1, c)`` one over the noise of each coordinate."""


def linearize(projections: Sequence[Tensor], views: Sequence[Tensor], scales: Sequence[Tensor]) -> Linearization:
    r"""Triangulate every match and linearize its images :math:`\pi(M_v Y)`. projections ``(*batch, l_v + 1, K)``, views
    ``(*batch, n, l_v)``, scales ``(*batch,)``."""
    x = torch.cat(list(views), dim=-1)
    top = torch.cat([m[..., :-1, :] for m in projections], dim=-2)[..., None, :, :]
    sizes = [m.shape[-2] - 1 for m in projections]
    last = torch.cat([m[..., -1:, :].expand(*m.shape[:-2], c, -1) for m, c in zip(projections, sizes, strict=True)], dim=-2)
    last = last[..., None, :, :]
    weight = torch.stack([1 / s for s, c in zip(scales, sizes, strict=True) for _ in range(c)], dim=-1)[..., None, :]
    incidence = (top - x[..., None] * last) * weight[..., None]
    y = gram_null_space(incidence.mT @ incidence).basis[..., 0, :]
    for step in range(STEPS + 1):
        depth = (last @ y[..., None])[..., 0]
        depth = torch.where(depth.abs() < FLOOR, torch.copysign(torch.full_like(depth, FLOOR), depth), depth)
        image = (top @ y[..., None])[..., 0] / depth
        slope = (top - image[..., None] * last) * (weight / depth)[..., None]
        information = slope.mT @ slope
        # projections that see nothing have no information, but an inverse
        trace = information.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None].clamp(min=TINY)
        fixed = information + trace * (y[..., :, None] * y[..., None, :] + SPREAD * _eye(information))
        inverse = torch.linalg.inv_ex(fixed)[0]
        error = (x - image) * weight
        if step < STEPS:
            y = y + (inverse @ (slope.mT @ error[..., None]))[..., 0]
            y = y / y.norm(dim=-1, keepdim=True).clamp(min=TINY)
    return Linearization(error, y, slope, inverse, depth, image, weight)


def residual(projections: Sequence[Tensor], views: Sequence[Tensor], scales: Sequence[Tensor]) -> Tensor:
    r"""The error that no displacement of the point takes away, :math:`(I - J V^{-1} J^T)\, e`, ``(*batch, n, c)``."""
    at = linearize(projections, views, scales)
    return at.error - (at.slope @ (at.inverse @ (at.slope.mT @ at.error[..., None])))[..., 0]


def residual_derivative(projections: Sequence[Tensor], views: Sequence[Tensor], scales: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    r""":func:`residual`, flat ``(b, n c)``, and its derivative ``(b, p, n c)`` by all entries of the projections."""
    at = linearize(projections, views, scales)
    root = at.inverse @ at.slope.mT
    value = at.error - (at.slope @ (root @ at.error[..., None]))[..., 0]
    n, c = value.shape[-2:]
    factor = (at.weight / at.depth)[..., None] * at.structure[..., None, :]  # (b, n, c, K)
    columns, start = [], 0
    for m in projections:
        size = m.shape[-2] - 1
        piece = slice(start, start + size)
        # the images by the rows of this projection: each coordinate by its own row, and all by the last one
        own = factor.new_zeros(*factor.shape[:-2], c, size + 1, factor.shape[-1])
        for j in range(size):
            own[..., start + j, j, :] = factor[..., start + j, :]
        own[..., piece, size, :] = -at.image[..., piece, None] * factor[..., piece, :]
        columns.append(own.flatten(-2))
        start += size
    moved = torch.cat(columns, dim=-1)  # (b, n, c, p)
    derivative = -(moved - at.slope @ (root @ moved))
    return value.flatten(-2), derivative.movedim(-1, -3).reshape(*value.shape[:-2], moved.shape[-1], n * c)


def _eye(like: Tensor) -> Tensor:
    return torch.eye(like.shape[-1], dtype=like.dtype, device=like.device)


# ----------------------------------------------------------------------------------------------------------------------
# How far the points of each view are from the nearest image of a known shape, with the camera of the view eliminated.  A camera
# is to the points of a view what a point is to the cameras of several views, so it is eliminated in the same way: point i sees the
# unknown camera P^k -> P^l through the Kronecker product of X_i^T and I.


@dataclass(frozen=True)
class CameraKind:
    """The cameras that each view may have: all projections :math:`P^k \\to P^l`, or the affine ones among them."""

    k: int = 3
    l: int = 2  # noqa: E741 - its name in the literature
    affine: bool = False

    @property
    def freedom(self) -> int:
        """Degrees of freedom."""
        return self.l * (self.k + 1) if self.affine else (self.k + 1) * (self.l + 1) - 1


def reprojection_residual(structure: Tensor, x: Tensor, scale: Tensor, cameras: CameraKind) -> Tensor:
    r"""Reprojection error that no camera takes away, in standard deviations of noise, to first order. structure
    ``(*batch, n, k + 1)``, x ``(*batch, views, n, l + 1)``, scale ``(*batch,)`` -> ``(*batch, views, l n)``."""
    at, informative, _ = _linearize(structure, x, scale, cameras)
    error = at.error - (at.slope @ (at.inverse @ (at.slope.mT @ at.error[..., None])))[..., 0]
    return torch.where(informative[..., None], error[..., 0, :], torch.nan)


def reprojection_derivative(structure: Tensor, x: Tensor, scale: Tensor, cameras: CameraKind) -> tuple[Tensor, Tensor]:
    """The residual and its derivative ``(*batch, views, l n, n, k + 1)`` by the points; both 0 where a view says nothing."""
    at, informative, length = _linearize(structure, x, scale, cameras)
    informative = informative[..., None, None]
    project = torch.eye(at.error.shape[-1], dtype=x.dtype, device=x.device) - (at.slope @ at.inverse @ at.slope.mT)[..., 0, :, :]
    error = (project @ at.error.mT)[..., 0]
    n, size = x.shape[-2], cameras.l
    # the image of each point by its own coordinates
    moved = torch.einsum("...k,ark->...ra", at.structure[..., 0, :], _maps(cameras, x.device))  # (.., l + 1, k + 1): the camera
    image, depth, weight = (
        part[..., 0, :].unflatten(-1, (n, size)) for part in (at.image, at.depth, at.weight.expand_as(at.image))
    )
    own = (moved[..., None, :size, :] - image[..., None] * moved[..., None, size:, :]) * (weight / depth)[..., None]
    seen = looked_at(x)[..., None, None]
    own = torch.where(seen, own / length[..., None, None], 0.0)
    derivative = -torch.einsum("...cni,...nia->...cna", project.unflatten(-1, (n, size)), own)
    return torch.where(informative[..., 0], error, 0.0), torch.where(informative[..., None], derivative, 0.0)


def looked_at(x: Tensor) -> Tensor:
    """Which points of measurements ``(..., n, l + 1)`` are seen."""
    return x[..., -1] > 0


def _linearize(structure: Tensor, x: Tensor, scale: Tensor, cameras: CameraKind) -> tuple[Linearization, Tensor, Tensor]:
    """Cameras and images of all views; which views say something; the lengths ``(*batch, views | 1, n)`` of the points."""
    if structure.ndim < x.ndim:
        structure = structure[..., None, :, :]
    seen = looked_at(x)
    # zero measurements where missing, and zero points there, give zero equations
    p, factor = local(torch.cat([torch.where(seen[..., None], x[..., :-1], 0.0), seen[..., None].to(x)], dim=-1))
    noise = scale[..., None] * factor
    length = structure.norm(dim=-1)
    points = unit_vectors(structure) * seen[..., None]
    looks = torch.einsum("...na,ark->...nrk", points, _maps(cameras, x.device))
    n = x.shape[-2]
    at = linearize(looks.unbind(-3), [p[..., i, None, :-1] for i in range(n)], [noise] * n)
    return at, cameras.l * seen.sum(-1) > cameras.freedom, torch.where(length > 0, length, 1.0)


@constant
def _maps(cameras: CameraKind, device: torch.device) -> Tensor:
    """What point coordinate a shows of camera entry j in image coordinate r: ``(k + 1, l + 1, entries)``."""
    points, images = cameras.k + 1, cameras.l + 1
    maps = torch.einsum("ab,rs->arsb", torch.eye(points), torch.eye(images)).flatten(-2).double()
    if cameras.affine:
        # the last row of the camera is (0, ..., 0, s)
        maps = maps[..., [*range(points * cameras.l), points * images - 1]]
    return maps.to(device)


# ----------------------------------------------------------------------------------------------------------------------
# What the tensors of the shape of points have in common.


class PointShape(Invariant):
    r"""Base of the tensors of n points of :math:`P^k` from which the projection of every view to :math:`P^l` is eliminated."""

    k: int
    l: int  # noqa: E741 - its name in the literature
    frame: str
    points: int | None
    intrinsic = True
    motion = (Frame(None),)

    @property
    def n(self) -> int:
        """Points of one view."""
        if self.points is None:
            raise ValueError(f"{self!r} does not know its number of points; give it, {repr(self)[:-1]}, points=...)")
        return self.points

    def with_points(self, n: int) -> Self:
        """The family's member for so many points."""
        return replace(self, points=n)  # type: ignore[type-var]

    def check_points(self, n: int) -> None:
        """Raise a ``ValueError`` for numbers of points that the tensor does not take."""
        raise NotImplementedError

    @property
    def cameras(self) -> CameraKind:
        """The projections that are eliminated."""
        return CameraKind(self.k, self.l, self.frame == AFFINE)

    def bind_arguments(
        self, views: Sequence[Tensor], weights: Tensor | None = None, **given: Tensor
    ) -> tuple[Invariant, tuple[Tensor, ...]]:
        super().bind_arguments(views, weights, **given)
        if self.points not in (None, len(views)):
            raise ValueError(f"{self!r} takes {self.points} points, each (*batch, views, {self.l}), got {len(views)} arguments")
        self.check_points(len(views))
        return self.with_points(len(views)), (constellations(self, views, self.l),)

    @property
    def resolves_noise(self) -> bool:  # type: ignore[override]
        """Not where points of the basis that nearly depend on each other make the frame of every view an accident."""
        return self.frame == AFFINE

    @property
    def nullity(self) -> int:  # type: ignore[override]
        return self.n - self.k - 1 if self.frame == AFFINE else 1

    @property
    def dof(self) -> int:  # type: ignore[override]
        """Coordinates of the points less the collineations that keep the basis."""
        n, k = self.n, self.k
        return {GENERAL: k * (n - k - 2), PLANE: k * (n - k - 1) - k - 1, AFFINE: k * (n - k - 1)}[self.frame]

    @property
    def codim(self) -> int:  # type: ignore[override]
        """Coordinates of a view less the freedom of its camera."""
        return self.l * self.n - self.cameras.freedom

    def compose_points(self, points: Tensor) -> Tensor:
        """The tensor ``(*batch, [nullity,] *shape)`` of points ``(*batch, n, k)`` or homogeneous; 0 without a frame."""
        own = self.with_points(int(points.shape[-2]))
        standard = points if points.shape[-1] == self.k + 1 else torch.nn.functional.pad(points, (0, 1), value=1.0)
        if standard.shape[-1] != self.k + 1:
            raise ValueError(f"points must be (*batch, n, {self.k}) or homogeneous, (*batch, n, {self.k + 1}), got {points.shape}")
        standard = static.standard(standard.double(), own.frame)
        sound = standard.isfinite().flatten(-2).all(-1)[..., None, None]
        stand_in = (
            torch.ones_like(standard)
            if own.frame == PLANE
            else torch.eye(*standard.shape[-2:], device=standard.device).to(standard)
        )
        stand_in = torch.where(torch.arange(standard.shape[-2], device=standard.device)[:, None] > self.k, 1.0, stand_in)
        flat = own.compose_standard(torch.where(sound, standard, stand_in)).flatten(-len(own.shape()))
        norm = flat.norm(dim=-1, keepdim=True)
        flat = torch.where(sound if own.nullity > 1 else sound[..., 0], flat / torch.where(norm > 0, norm, 1.0), 0.0)
        return flat.unflatten(-1, own.shape()).to(points.dtype)

    def compose_standard(self, points: Tensor) -> Tensor:
        """The tensor, of any scale, of points ``(*batch, n, k + 1)`` in the standard frame."""
        if self.frame == AFFINE:
            annihilator = null_space(points.mT, self.nullity)
            return annihilator.squeeze(-2) if self.nullity == 1 else annihilator
        others = points[..., self.k + 1 :, :]
        v = others[..., :-1] / others[..., -1:]
        return v - v.mean(-2, keepdim=True)

    def whitened_residual(self, motion: tuple[Tensor, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...]) -> Tensor:
        """Reprojection error ``(*batch, views, l n)`` of the points of each view, whose camera is found first."""
        structure = static.standard(motion[0].double(), self.frame)
        return reprojection_residual(structure, views[0].double(), scales[0].double(), self.cameras).to(views[0].dtype)

    def linearize(self, motion: tuple[Tensor, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
        shape = motion[0].shape[-2:]
        value, slope = jacobian(lambda t: static.standard(t.unflatten(-1, shape), self.frame).flatten(-2), motion[0].flatten(-2))
        error, derivative = reprojection_derivative(value.unflatten(-1, shape), views[0], scales[0], self.cameras)
        return error.flatten(-2), slope @ derivative.flatten(-2).flatten(-3, -2).mT
