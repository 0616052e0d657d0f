r"""Trajectory triangulation: points that move on straight lines, at any speed, each view at another time, from known cameras."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

import torch
from torch import Tensor

from dyntorch.algebra.extensors import compound
from dyntorch.algebra.homogeneous import inhomogeneous, unit
from dyntorch.algebra.klein_quadric import lines_of_pencil, nearest_line
from dyntorch.algebra.line_cameras import line_camera
from dyntorch.algebra.line_collineation import skew_line
from dyntorch.blocks import one_thread
from dyntorch.nullspace import gram_null_space
from dyntorch.tasks.line_descent import Found, Sightings, best_lines, best_points, normalized

VIEWS = 4
"""Views of a point that leave finitely many lines: two."""
STILL = 2.0
"""A point whose reprojection errors as a static point are below so many sigma (RMS per degree of freedom) is called static."""
UNCERTAIN = 0.1
"""Expected error of the unit vector of a line, cameras normalized, above which other lines explain the views as well.
Five views, 0.5 px: at 0.03 to 0.1 nine of ten points are within 0.04 of the scene's radius, at 0.1 to 0.3 within 0.13."""
ROUNDING = 1e-10
"""Noise, in units of the normalized images, that even exact data are taken to have."""


class LineStatus(IntEnum):
    """How the triangulation of one trajectory ended."""

    OK = 0
    TOO_FEW = 1
    """Fewer than four views.  Line and points are zero."""
    STATIC = 2
    """The point does not move beyond the noise: every line through it would do.  The line is zero, ``points`` the one point."""
    AMBIGUOUS = 3
    """Other lines fit as well within the noise (the point hardly moves, or its rays lie almost in a plane).  The line is one."""
    TWO_FOLD = 4
    """Four views: two lines fulfil them exactly, ``lines`` and ``second``; nothing tells which of them is true."""


@dataclass(frozen=True, eq=False)
class Trajectories:
    """Result of :func:`triangulate_trajectories`.

    Attributes:
        lines: ``(*batch, n, 6)`` Pluecker coordinates, order 01, 02, 03, 12, 13, 23, of norm 1, the largest positive; 0 where the
            status says so.
        second: ``(*batch, n, 6)`` the other solution where the status is ``TWO_FOLD``, otherwise 0; its points are
            ``points_on_lines(cameras, x, second)``.
        points: ``(*batch, views, n, 3)`` where the point was at each view, in the world of the cameras; 0 at views that miss it.
        residual: ``(*batch, n)`` RMS distance of the points from the image lines (``STATIC``: from the image point), px.
        uncertainty: ``(*batch, n)`` expected error of the line, as a unit vector with normalized cameras; 1 = nothing known.
        sigma: ``(*batch,)`` noise of one image coordinate, px: as given, or as the residuals of all lines show.
        status: ``(*batch, n)`` of :class:`LineStatus` values.
    """

    lines: Tensor
    second: Tensor
    points: Tensor
    residual: Tensor
    uncertainty: Tensor
    sigma: Tensor
    status: Tensor


@one_thread
def triangulate_trajectories(
    cameras: Tensor, x: Tensor, weights: Tensor | None = None, *, sigma: float | None = None
) -> Trajectories:
    r"""The straight lines on which points move, seen one view at a time, and where on them they were.

    The ray of :math:`x_j` meets the trajectory L, :math:`x_j^T M_j L = 0` with the line camera :math:`M_j` of view j: the null
    vector of five or more views, brought to the Klein quadric, or the two lines of the quadric in the null space of four.  From
    there the distances of the points to the image lines :math:`M_j L` are made least squares in the 4 parameters of the line.
    Speeds and times play no role, and the cameras may be projective, one of them repeated, moving or static.

    A static point has three times infinitely many lines through it; it is recognised by its reprojection errors as a point.

    Conic trajectories are left out.  A conic of space has 8 parameters, and a view gives one condition, of degree 2 in its ray: 8
    views leave finitely many conics, 9 one, by nonlinear equations only.  What is linear is the Chow form, a quadratic form on
    the lines of space modulo J, with 20 coefficients: 19 views of one point, most of them spent on forms that are no conics, and
    ill-conditioned, because a short piece of a conic is nearly a line.  Uncalibrated, its tensor would join 20 views and have
    6^20 entries.  Thesis section 1.3 calls these cases "even less tractable".

    Args:
        cameras: ``(*batch, views, 3, 4)`` P of each view, px; four or more views.
        x: ``(*batch, views, n, 2)`` px, undistorted; NaN = not seen.
        weights: ``(*batch, views, n)``, 0 = ignore.
        sigma: noise of one image coordinate, px; None takes it from the residuals of the lines of five or more views (with
            only four views every point that moves at all then counts as moving).

    Returns:
        :class:`Trajectories`, in the dtype and on the device of x.

    Raises:
        ValueError: other shapes, fewer than four views, negative weights, or a sigma that is not positive.

    Source: thesis section 1.3; Avidan and Shashua 2000, "Trajectory triangulation".  Four views, the nonlinear refinement and the
    tests for static points are derived here.

    Example:
        >>> import torch
        >>> t = torch.tensor([0.0, 1.0, 1.5, 3.0, 5.0]).double()
        >>> path = torch.stack([t, 1 - t, 2 * t + 4], dim=-1)  # a straight line
        >>> g = torch.Generator().manual_seed(0)
        >>> cameras = torch.cat([torch.eye(3).expand(5, 3, 3), torch.randn(5, 3, 1, generator=g)], dim=-1).double()
        >>> x = torch.stack([torch.cat([p, p.new_ones(1)]) @ c.T for c, p in zip(cameras, path)])
        >>> found = triangulate_trajectories(cameras, (x[:, :2] / x[:, 2:])[:, None])
        >>> bool(torch.allclose(found.points[:, 0], path)), LineStatus(int(found.status)).name
        (True, 'OK')
    """
    weights = _checked(cameras, x, weights, sigma)
    data, _, back = normalized(cameras.double(), x.double(), weights)
    seen = (data.weights > 0).sum(-2)
    line, second = _lines(data)
    still = _points(data)
    noise = _noise(line.cost, seen) if sigma is None else torch.full_like(line.cost[..., 0], sigma)
    least = torch.maximum(noise, ROUNDING / data.unit[..., 0, 0])[..., None]
    static = (still.cost <= (least * STILL).square() * (2 * seen - 3)) & (seen >= VIEWS)
    few, two = seen < VIEWS, second.abs().amax(-1) > 0
    # four views without two lines: noise has made them one
    uncertainty = torch.where((seen == VIEWS) & ~two, 1.0, (line.spread.sqrt() * least).clamp(max=1.0))
    status = torch.where(two, LineStatus.TWO_FOLD, torch.where(uncertainty > UNCERTAIN, LineStatus.AMBIGUOUS, LineStatus.OK))
    status = torch.where(few, LineStatus.TOO_FEW, torch.where(static, LineStatus.STATIC, status))
    none = (few | static)[..., None]
    total = data.weights.sum(-2)
    residual = torch.where(static, still.cost, line.cost).div(torch.where(total > 0, total, 1.0)).sqrt()
    lift = compound(back, 2).mT
    lines, second = (torch.where(none, 0.0, unit((v @ lift)[..., None])[..., 0]) for v in (line.vectors, second))
    moving = _feet(data, line.vectors)
    place = torch.where(static[..., None, :, None], still.vectors[..., None, :, :], moving) @ back.mT[..., None, :, :]
    points = torch.where(((data.weights > 0) & ~few[..., None, :])[..., None], inhomogeneous(place), 0.0)
    uncertainty = torch.where(few | static, 1.0, uncertainty)
    found = (lines, second, points, torch.where(few, 0.0, residual), uncertainty, noise)
    lines, second, points, residual, uncertainty, noise = (part.to(x.dtype) for part in found)
    return Trajectories(lines, second, points, residual, uncertainty, noise, status)


def points_on_lines(cameras: Tensor, x: Tensor, lines: Tensor) -> Tensor:
    r"""Where on their lines points were at each view: the points of the lines whose images are nearest to what was seen.

    :math:`X = [L]\, P^T m`, the meet of the line with the plane of the image line m that goes through x at right angles to the
    image of L.

    Args:
        cameras: ``(*batch, views, 3, 4)``.
        x: ``(*batch, views, n, 2)`` px.
        lines: ``(*batch, n, 6)`` Pluecker coordinates of any scale.

    Returns:
        ``(*batch, views, n, 3)``, NaN where x is; differentiable.

    Source: thesis section 1.3.

    Example:
        >>> import torch
        >>> line = torch.tensor([[0.0, -4.0, -1.0, 0.0, 0.0, 0.0]])  # through (0, 0, 4) along x
        >>> points_on_lines(torch.eye(3, 4)[None], torch.tensor([[[0.5, 0.1]]]), line).tolist()
        [[[2.0, 0.0, 4.0]]]
    """
    data = Sightings(cameras, x, torch.ones_like(x[..., 0]), torch.ones_like(x[..., 0]))
    return inhomogeneous(_feet(data, lines))


def _feet(data: Sightings, lines: Tensor) -> Tensor:
    """Homogeneous points ``(*batch, views, n, 4)`` of lines ``(*batch, n, 6)``, nearest in the images."""
    image = torch.einsum("...vik,...nk->...vni", line_camera(data.cameras), lines)
    a, b = image[..., 0], image[..., 1]
    u, v = data.x.unbind(-1)
    across = torch.stack([b, -a, a * v - b * u], dim=-1)
    planes = torch.einsum("...vik,...vni->...vnk", data.cameras, across)
    return torch.einsum("...nkl,...vnl->...vnk", skew_line(lines), planes)


def _checked(cameras: Tensor, x: Tensor, weights: Tensor | None, sigma: float | None) -> Tensor:
    """Weights ``(*batch, views, n)`` float64, 0 where anything is missing."""
    if cameras.ndim < 3 or cameras.shape[-2:] != (3, 4):
        raise ValueError(f"cameras must be (*batch, views, 3, 4), got {tuple(cameras.shape)}")
    if x.ndim != cameras.ndim or x.shape[-1] != 2 or x.shape[:-2] != cameras.shape[:-2]:
        raise ValueError(f"x must be (*batch, views, n, 2) for cameras {tuple(cameras.shape)}, got {tuple(x.shape)}")
    if cameras.shape[-3] < VIEWS:
        raise ValueError(
            f"cameras must have {VIEWS} or more views, got {cameras.shape[-3]}; three leave a family of lines, give more"
        )
    if sigma is not None and not 0 < sigma < math.inf:
        raise ValueError(f"sigma must be the noise of an image coordinate in px, above 0, got {sigma}; None estimates it")
    if weights is None:
        weights = torch.ones_like(x[..., 0])
    if weights.shape != x.shape[:-1]:
        raise ValueError(f"weights must be {tuple(x.shape[:-1])}, one for each x, got {tuple(weights.shape)}")
    if bool((weights < 0).any()):
        raise ValueError(f"weights must not be negative, got {float(weights.min()):g}; use 0 to ignore a point")
    known = x.isfinite().all(-1) & cameras.isfinite().flatten(-2).all(-1)[..., None] & weights.isfinite()
    return torch.where(known, weights, 0.0).double()


def fitted_lines(data: Sightings) -> Tensor:
    """The best lines ``(*batch, n, 6)`` of normalized sightings."""
    return _lines(data)[0].vectors


def _lines(data: Sightings) -> tuple[Found, Tensor]:
    """The best lines, and the second ones of four views (0 elsewhere)."""
    rays = data.rays()
    null = gram_null_space(rays.mT @ rays, 2).basis
    pencil, real = lines_of_pencil(null[..., 0, :], null[..., 1, :])
    found = best_lines(data, torch.stack([nearest_line(null[..., 0, :]), pencil[..., 0, :], pencil[..., 1, :]]))
    cost = torch.where(_visible(data, found.vectors), found.cost, torch.inf)
    apart = 1 - (found.vectors[1] * found.vectors[2]).sum(-1).square() > 1e-12
    two = ((data.weights > 0).sum(-2) == VIEWS) & real & apart & cost[1:].isfinite().all(0)
    best = torch.where(two, 1, cost.argmin(0))[None]
    vectors, least, spread = found.vectors.take_along_dim(best[..., None], 0), found.cost, found.spread
    line = Found(vectors[0], least.take_along_dim(best, 0)[0], spread.take_along_dim(best, 0)[0])
    return line, torch.where(two[..., None], found.vectors[2], 0.0)


def _points(data: Sightings) -> Found:
    """Every point as if it did not move."""
    sides = data.sides()
    return best_points(data, gram_null_space(sides.mT @ sides).basis[..., 0, :])


def _visible(data: Sightings, lines: Tensor) -> Tensor:
    """Whether lines ``(*batch, n, 6)`` stay clear of the centres of the cameras that see their points: the join of two centres
    meets all rays, and has no image in them."""
    image = torch.einsum("...vik,...nk->...vni", line_camera(data.cameras), lines).norm(dim=-1)
    image = image / torch.linalg.matrix_norm(line_camera(data.cameras))[..., None].clamp(min=1e-300)
    return (torch.where(data.weights > 0, image, 1.0) > 1e-7).all(-2)


def _noise(cost: Tensor, seen: Tensor) -> Tensor:
    """Noise of one coordinate from the residuals of all lines of a problem: the median, so that a few curved ones do no harm."""
    free = (seen - VIEWS).clamp(min=1)
    # Wilson and Hilferty: the median of chi^2_k / k
    share = cost / (free * (1 - 2 / (9 * free)) ** 3)
    ranked = torch.where(seen > VIEWS, share, torch.nan)
    return ranked.nanmedian(-1).values.nan_to_num(nan=0.0).sqrt()
