r"""All joints of a moving shape at once: the least squares shapes :math:`X_b` behind single affine views of it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.algebra.homogeneous import nonzero_sign
from dyntorch.eigenspace import eigh
from dyntorch.least_squares import minimize

FLAT = 1e-12
"""Ridge of the Gram of three coordinates, of its trace: a planar shape keeps the residual finite and exact to 1e-12."""


@dataclass(frozen=True)
class Views:
    """Centred single views, one row of the problem each.

    Attributes:
        x: ``(b, views, n, 2)`` finite, weighted centroid 0, weighted energy 1 (0 where a view says nothing).
        weights: ``(b, views, n)``, the sum over a view is n (or 0): missing points weigh nothing.
        share: ``(b, views)`` weight of each view.
        scale: ``(b, views)`` what the coordinates were divided by.
    """

    x: Tensor
    weights: Tensor
    share: Tensor
    scale: Tensor

    def repeated(self, count: int) -> Views:
        """The same problems ``count`` times, one after the other."""
        return Views(*(part.repeat(count, *([1] * (part.ndim - 1))) for part in vars(self).values()))

    def subset(self, keep: Tensor) -> Views:
        """Some of the problems."""
        return Views(*(part[keep] for part in vars(self).values()))


def centred_views(x: Tensor, weights: Tensor | None = None, share: Tensor | None = None) -> Views:
    """Views ``(b, views, n, 2)`` at their centroids, each with energy 1; NaN and weight 0 are missing points.

    A view with fewer than five points, or all in one place, says nothing about the shape and weighs 0.
    """
    present = x.isfinite().all(-1)
    weight = present.to(x.dtype)
    if weights is not None:
        weight = torch.where(present & weights.isfinite(), weights.clamp(min=0), 0.0)
    seen = (weight > 0).sum(-1)
    total = weight.sum(-1, keepdim=True)
    weight = weight * x.shape[-2] / torch.where(total > 0, total, 1.0)
    clean = torch.where(present[..., None], x, 0.0)
    centre = (clean * weight[..., None]).sum(-2, keepdim=True) / x.shape[-2]
    moved = torch.where((weight > 0)[..., None], clean - centre, 0.0)
    scale = (moved.square() * weight[..., None]).sum((-2, -1)).sqrt()
    # coordinates equal to rounding are one place
    known = (seen > 4) & (scale > 1e-12 * clean.abs().amax((-2, -1)))
    scale = torch.where(known, scale, 1.0)
    given = known.to(x.dtype) if share is None else torch.where(known, share, 0.0)
    return Views(torch.where(known[..., None, None], moved / scale[..., None, None], 0.0), weight, given, scale)


@dataclass(frozen=True)
class Projected:
    """Views projected onto a shape at each view.

    Attributes:
        residual: ``(..., n, 2)`` weighted by the root of the weights.
        cameras: ``(..., 3, 2)`` least squares A of :math:`x = X A + 1 b`.
        basis: ``(..., n, 3)`` orthonormal basis of the centred weighted shape.
        inverse: ``(..., 3, 3)`` what makes the shape that basis.
    """

    residual: Tensor
    cameras: Tensor
    basis: Tensor
    inverse: Tensor


def project(x: Tensor, weights: Tensor, shape: Tensor) -> Projected:
    """Residuals of centred views ``(..., n, 2)`` for shapes ``(..., n, 3)`` (or of other width); their translation is nothing."""
    root = weights.sqrt()[..., None]
    centre = (shape * weights[..., None]).sum(-2, keepdim=True) / weights.sum(-1)[..., None, None].clamp(min=1e-300)
    moved = (shape - centre) * root
    seen = x * root
    gram = moved.mT @ moved
    eye = torch.eye(gram.shape[-1], dtype=x.dtype, device=x.device)
    ridge = FLAT * gram.diagonal(dim1=-2, dim2=-1).sum(-1) + torch.finfo(x.dtype).tiny
    factor, _ = torch.linalg.cholesky_ex(gram + ridge[..., None, None] * eye)
    inverse = torch.linalg.solve_triangular(factor, eye.expand_as(factor), upper=False).mT
    basis = moved @ inverse
    inner = basis.mT @ seen
    return Projected(seen - basis @ inner, inverse @ inner, basis, inverse)


def slopes(found: Projected, weights: Tensor, rows: Tensor) -> Tensor:
    r"""Derivative of the residuals by the shapes (Golub and Pereyra): :math:`dr = -\Pi^\perp dX A - (X^+)^T dX^T r`.

    Args:
        found: by :func:`project` at ``shapes_at(shapes, rows)``.
        weights: ``(..., views, n)``.
        rows: ``(..., views, B)``.

    Returns:
        ``(..., views, n, B, 3, n, 2)``: of the last two by the three before.
    """
    root = weights.sqrt()
    mean = (root / weights.sum(-1, keepdim=True).clamp(min=1e-300))[..., None] * root[..., None, :]
    away = torch.eye(weights.shape[-1], dtype=rows.dtype, device=rows.device) - mean - found.basis @ found.basis.mT
    first = torch.einsum("...ij,...b,...kd->...jbkid", away * root[..., None, :], rows, found.cameras)
    second = torch.einsum("...ik,...b,...jd->...jbkid", found.basis @ found.inverse.mT, rows, root[..., None] * found.residual)
    return -first - second


def shapes_at(shapes: Tensor, rows: Tensor) -> Tensor:
    r""":math:`X_v = \sum_b c_{vb} X_b`: ``(*batch, B, n, 3)`` and ``(*batch, views, B)`` to ``(*batch, views, n, 3)``."""
    return (rows @ shapes.flatten(-2)).unflatten(-1, shapes.shape[-2:])


def canonical(shapes: Tensor) -> Tensor:
    """The same family of subspaces ``(b, B, n, 3)``: centroids 0, and the 3 columns orthonormal over all basis functions."""
    centred = shapes - shapes.mean(-2, keepdim=True)
    flat = torch.where(centred.isfinite(), centred, 0.0).flatten(1, 2)
    return torch.linalg.qr(flat)[0].unflatten(1, shapes.shape[1:3])


def framed(shapes: Tensor) -> Tensor:
    """:func:`canonical` with the columns of :math:`X_0` orthogonal, the longest first: one representative of each family."""
    moved = canonical(shapes)
    first = moved[:, 0]
    axes = eigh(first.mT @ first)[1].flip(-1)
    turned = moved @ axes[:, None]
    flat = turned.flatten(1, 2)
    return turned * nonzero_sign(flat.take_along_dim(flat.abs().argmax(1, keepdim=True), 1))[:, None]


def cost_of(views: Views, rows: Tensor, shapes: Tensor) -> Tensor:
    """Weighted square sum of the residuals ``(b,)``."""
    return _cost(views, project(views.x, views.weights, shapes_at(shapes, rows)))


def _cost(views: Views, found: Projected) -> Tensor:
    return (found.residual.square().sum((-2, -1)) * views.share).sum(-1)


@dataclass(frozen=True)
class Descent:
    r"""The shapes that leave the least, the cameras eliminated; a :class:`dyntorch.least_squares.Minimand`.

    Gauss-Newton with Kaufman's Jacobian :math:`dr = -\Pi^\perp\,dX(t_v)\,A_v`: its normal matrix is a sum of Kronecker products
    :math:`(c c^T) \otimes (A A^T) \otimes \Pi^\perp`, one product of two matrices whatever the number of views.

    Attributes:
        views: see :class:`Views`.
        rows: ``(b, views, B)`` values of the basis functions.
    """

    views: Views
    rows: Tensor

    def shapes(self, theta: Tensor) -> Tensor:
        """Shapes ``(b, B, n, 3)`` of parameters ``(b, 3 n B)``."""
        return theta.unflatten(1, (self.rows.shape[-1], -1, 3))

    def parts(self, theta: Tensor) -> tuple[Tensor, ...]:
        """The shapes in their canonical form: what no view can tell does not run away."""
        return (canonical(self.shapes(theta)),)

    def subset(self, keep: Tensor) -> Descent:
        """Some of the problems."""
        return Descent(self.views.subset(keep), self.rows[keep])

    def normal_equations(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cost ``(b,)``, gradient ``(b, p)`` and matrix ``(b, p, p)``."""
        views, rows, shapes = self.views, self.rows, self.shapes(theta)
        found = project(views.x, views.weights, shapes_at(shapes, rows))
        size, n = shapes.shape[1:3]
        root = views.weights.sqrt()
        pull = -root[..., None] * found.residual @ found.cameras.mT * views.share[..., None, None]  # (b, v, n, 3)
        gradient = (rows.mT @ pull.flatten(2)).flatten(1)
        away = torch.diag_embed(views.weights) - views.weights[..., :, None] * views.weights[..., None, :] / n
        side = root[..., None] * found.basis
        away = away - side @ side.mT
        lifted = (rows[..., None] @ rows[..., None, :])[..., :, None, :, None]
        cameras = (found.cameras @ found.cameras.mT)[..., None, :, None, :]
        motion = (lifted * cameras).flatten(2) * views.share[..., None]  # (b, v, (3 B)^2)
        matrix = (motion.mT @ away.flatten(2)).reshape(-1, size, 3, size, 3, n, n)
        matrix = matrix.permute(0, 1, 5, 2, 3, 6, 4).reshape(len(shapes), size * n * 3, size * n * 3)
        cost = _cost(views, found)
        return torch.where(cost.isfinite(), cost, torch.inf), gradient, matrix


def descend(views: Views, rows: Tensor, shapes: Tensor, iterations: int) -> tuple[Tensor, Tensor]:
    r"""Minimize :math:`\sum_v w_v \|(I - \Pi(t_v))\,x_v\|^2` over the shapes (variable projection).

    Args:
        views: see :class:`Views`.
        rows: ``(b, views, B)`` values of the basis functions.
        shapes: ``(b, B, n, 3)`` start.
        iterations: at most so many steps.

    Returns:
        Shapes in canonical form, and the cost ``(b,)``, which never rises.

    Source: Golub and Pereyra 1973; Kaufman 1975.
    """
    theta, cost, _ = minimize(Descent(views, rows), shapes.flatten(1), iterations)
    return canonical(theta.unflatten(1, shapes.shape[1:])), cost
