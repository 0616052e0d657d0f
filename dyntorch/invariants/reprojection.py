"""Reprojection residuals of matches under projections P^k -> P^l, with the point that is seen eliminated."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from dyntorch.nullspace import gram_null_space

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
    r"""Triangulate every match and linearize its images :math:`\pi(M_v Y)`.

    Args:
        projections: :math:`M_v`, ``(*batch, l_v + 1, K)``.
        views: ``(*batch, n, l_v)``.
        scales: ``(*batch,)`` noise of each view.
    """
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
    r"""The error that no displacement of the point takes away, :math:`(I - J V^{-1} J^T)\, e`, ``(*batch, n, c)``.

    To first order the least reprojection error in standard deviations; its square sum follows :math:`\chi^2` with
    :math:`\sum_v l_v - k` degrees of freedom.
    """
    at = linearize(projections, views, scales)
    return at.error - (at.slope @ (at.inverse @ (at.slope.mT @ at.error[..., None])))[..., 0]


def residual_derivative(projections: Sequence[Tensor], views: Sequence[Tensor], scales: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    r""":func:`residual`, flat ``(b, n c)``, and its derivative ``(b, p, n c)`` by all entries of the projections.

    With the points following the projections, :math:`\partial r = (I - J V^{-1} J^T)\, \partial e` (Kaufman's form of
    variable projection), the Schur complement of bundle adjustment.
    """
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
