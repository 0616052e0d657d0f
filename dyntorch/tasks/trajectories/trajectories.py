r"""Trajectory triangulation: points that move on straight lines, at any speed, each view at another time, from known cameras."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any, ClassVar

import numpy as np
import torch
from scipy.special import chdtri, fdtri
from torch import Tensor

from dyntorch.core.fit import fit
from dyntorch.core.outcome import REMEDY, Outcome, Status, is_failure
from dyntorch.geometry.extensors import (
    cameras_of_lines,
    compound,
    line_camera,
    lines_of_pencil,
    nearest_line,
    skew_line,
)
from dyntorch.geometry.homogeneous import inhomogeneous, unit
from dyntorch.invariants.grassmann_tensor import GrassmannTensor
from dyntorch.numerics.arguments import check_options, check_tensor, check_threshold, check_weights, on_cpu
from dyntorch.numerics.blocks import one_thread
from dyntorch.numerics.nullspace import gram_null_space
from dyntorch.tasks.trajectories.line_fits import LineFit, LineSightings, adjust, fit_lines, fit_points, normalize_sightings


@dataclass(frozen=True)
class TrajectoryOptions:
    """Options of :func:`dyntorch.triangulate_trajectories` and :func:`dyntorch.trajectory_cameras`."""

    max_static_sigmas: float = 2.0
    """Reprojection error as a static point, RMS per degree of freedom over the noise, up to which a point is called static."""
    max_uncertainty: float = 0.1
    """Expected error of the unit vector of a line, cameras normalized, above which it is AMBIGUOUS: at .03 to .1 nine of ten points
    are within .04 of the scene's radius, at .1 to .3 within .13 (five views, .5 px)."""


VIEWS = 4
"""Views of a point that leave finitely many lines: two."""


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
    MISFIT = 5
    """The distances from the best line, the one given, exceed the noise: the path is curved, or a sighting or a camera wrong."""


STATUS_OF_LINES = torch.tensor(
    [Status.OK, Status.TOO_FEW, Status.DEGENERATE, Status.AMBIGUOUS, Status.AMBIGUOUS, Status.NO_CONSENSUS]
)
"""The status of a :class:`LineStatus`: every line would do for a point that stands still."""


@dataclass(frozen=True, eq=False, repr=False)
class Trajectories(Outcome):
    """Result of :func:`triangulate_trajectories`."""

    lines: Tensor  # ``(*batch, n, 6)`` Pluecker coordinates, order 01, 02, 03, 12, 13, 23, of norm 1, the largest positive
    second: Tensor  # ``(*batch, n, 6)`` the other solution where the status is ``TWO_FOLD``, otherwise 0
    points: Tensor  # ``(*batch, views, n, 3)`` where the point was at each view, in the world of the cameras
    residual: Tensor  # ``(*batch, n)`` RMS distance of the points from the image lines (``STATIC``: from the image point), px
    uncertainty: Tensor  # ``(*batch, n)`` expected error of the line, as a unit vector with normalized cameras; 1 = nothing known
    sigma: Tensor  # ``(*batch,)`` noise of one image coordinate, px: as given, or as the residuals of all lines show
    kinds: Tensor  # ``(*batch, n)`` of :class:`LineStatus` values

    TASK = "triangulate_trajectories"
    REMEDIES: ClassVar[Mapping[Status, str]] = {
        **REMEDY,
        Status.NO_CONSENSUS: "the noise does not explain how far the sightings are from any line; look for curved paths and "
        "wrong sightings, or raise {arg:sigma}",
    }

    def __repr__(self) -> str:
        """How many lines of each kind."""
        views, n = self.points.shape[-3:-1]
        counts = ", ".join(f"{number} {LineStatus(k).name}" for k, number in enumerate(self.kinds.flatten().bincount()) if number)
        return f"Trajectories(views={views}, points={n}, batch={tuple(self.status.shape[:-1])}: {counts or 'empty'})"


MIN_NOISE = 1e-10  # in units of the normalized images, even of exact data


@one_thread
def triangulate_trajectories(
    cameras: Tensor,
    x: Tensor,
    weights: Tensor | None = None,
    *,
    sigma: float | None = None,
    options: TrajectoryOptions | None = None,
) -> Trajectories:
    r"""The straight lines on which points move, seen one view at a time, and where on them they were.

    The ray of :math:`x_j` meets the trajectory L, :math:`x_j^T M_j L = 0` with the line camera :math:`M_j` of view j: the null
    vector of five or more views, brought to the Klein quadric, or the two lines of the quadric in the null space of four.  From
    there the distances of the points to the image lines :math:`M_j L` are made least squares in the 4 parameters of the line.
    Speeds and times play no role, and the cameras may be projective, one of them repeated, moving or static.

    Squared distances are those of noise, :math:`\sum_j d_j^2 \sim \sigma^2 \chi^2_{v - 4}` for a point in v views; one whose are
    more (in one problem of a thousand by chance) does not move on a line, or a sighting is wrong: ``MISFIT``.

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
        options: :class:`TrajectoryOptions`; None = the defaults.

    Returns:
        :class:`Trajectories`, in the dtype and on the device of x.

    Raises:
        ValueError: what is no tensor of floating point or has another shape, fewer than four views, no point, negative weights, or
            a sigma that is not positive.

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
        >>> bool(torch.allclose(found.points[:, 0], path)), LineStatus(int(found.kinds)).name
        (True, 'OK')
    """
    options = TrajectoryOptions() if options is None else options
    check_options(options, TrajectoryOptions)
    weights = _check(cameras, x, weights, sigma)
    data, _, back = normalize_sightings(cameras.double(), x.double(), weights)
    seen = (data.weights > 0).sum(-2)
    line, second = _lines(data)
    sides = data.sides()
    still = fit_points(data, gram_null_space(sides.mT @ sides).basis[..., 0, :])  # as if no point moved
    noise = _noise(line.cost, seen) if sigma is None else torch.full_like(line.cost[..., 0], sigma)
    least = torch.maximum(noise, MIN_NOISE / data.unit[..., 0, 0])[..., None]
    static = (still.cost <= (least * options.max_static_sigmas).square() * (2 * seen - 3)) & (seen >= VIEWS)
    few, two = seen < VIEWS, second.abs().amax(-1) > 0
    # four views without two lines: noise has made them one
    uncertainty = torch.where((seen == VIEWS) & ~two, 1.0, (line.spread.sqrt() * least).clamp(max=1.0))
    single = torch.where(uncertainty > options.max_uncertainty, LineStatus.AMBIGUOUS, LineStatus.OK)
    single = torch.where(_is_misfit(line.cost, seen, data, noise, sigma is None), LineStatus.MISFIT, single)
    kinds = torch.where(two, LineStatus.TWO_FOLD, single)
    kinds = torch.where(few, LineStatus.TOO_FEW, torch.where(static, LineStatus.STATIC, kinds))
    none = (few | static)[..., None]
    total = data.weights.sum(-2)
    residual = torch.where(static, still.cost, line.cost).div(torch.where(total > 0, total, 1.0)).sqrt()
    lift = compound(back, 2).mT
    lines, second = (torch.where(none, 0.0, unit((v @ lift)[..., None])[..., 0]) for v in (line.vectors, second))
    moving = _nearest_on_lines(data, line.vectors)
    place = torch.where(static[..., None, :, None], still.vectors[..., None, :, :], moving) @ back.mT[..., None, :, :]
    points = torch.where(((data.weights > 0) & ~few[..., None, :])[..., None], inhomogeneous(place), 0.0)
    uncertainty = torch.where(few | static, 1.0, uncertainty)
    found = (lines, second, points, torch.where(few, 0.0, residual), uncertainty, noise)
    lines, second, points, residual, uncertainty, noise = (part.to(x.dtype) for part in found)
    return Trajectories(lines, second, points, residual, uncertainty, noise, kinds, status=STATUS_OF_LINES.to(kinds.device)[kinds])


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
    data = LineSightings(cameras, x, torch.ones_like(x[..., 0]), torch.ones_like(x[..., 0]))
    return inhomogeneous(_nearest_on_lines(data, lines))


def _nearest_on_lines(data: LineSightings, lines: Tensor) -> Tensor:
    """Homogeneous points ``(*batch, views, n, 4)`` of lines ``(*batch, n, 6)``, nearest in the images."""
    image = torch.einsum("...vik,...nk->...vni", line_camera(data.cameras), lines)
    a, b = image[..., 0], image[..., 1]
    u, v = data.x.unbind(-1)
    across = torch.stack([b, -a, a * v - b * u], dim=-1)
    planes = torch.einsum("...vik,...vni->...vnk", data.cameras, across)
    return torch.einsum("...nkl,...vnl->...vnk", skew_line(lines), planes)


def _check(cameras: Tensor, x: Tensor, weights: Tensor | None, sigma: float | None) -> Tensor:
    """Weights ``(*batch, views, n)`` float64, 0 where anything is missing."""
    check_tensor("cameras", cameras, "views", 3, 4)
    check_tensor("x", x, "views", "n", 2)
    if x.ndim != cameras.ndim or x.shape[:-2] != cameras.shape[:-2]:
        raise ValueError(f"x must be (*batch, views, n, 2) for cameras {tuple(cameras.shape)}, got {tuple(x.shape)}")
    if cameras.shape[-3] < VIEWS:
        raise ValueError(
            f"cameras must have {VIEWS} or more views, got {cameras.shape[-3]}; three leave a family of lines, give more"
        )
    if not x.shape[-2]:
        raise ValueError(f"x must hold a point at least, got {tuple(x.shape)}; give what was seen")
    check_threshold(sigma, name="sigma")
    if weights is None:
        weights = torch.ones_like(x[..., 0])
    if not isinstance(weights, Tensor) or weights.shape != x.shape[:-1]:
        got = tuple(weights.shape) if isinstance(weights, Tensor) else weights
        raise ValueError(f"weights must be a tensor {tuple(x.shape[:-1])}, one for each x, got {got!r}")
    check_weights(weights, "a point")
    known = x.isfinite().all(-1) & cameras.isfinite().flatten(-2).all(-1)[..., None] & weights.isfinite()
    return torch.where(known, weights, 0.0).double()


MIN_LINE_ANGLE = 1e-12  # squared sine between the unit vectors of both lines of four views


def _lines(data: LineSightings) -> tuple[LineFit, Tensor]:
    """The best lines, and the second ones of four views (0 elsewhere)."""
    rays = data.rays()
    null = gram_null_space(rays.mT @ rays, 2).basis
    pencil, real = lines_of_pencil(null[..., 0, :], null[..., 1, :])
    found = fit_lines(data, torch.stack([nearest_line(null[..., 0, :]), pencil[..., 0, :], pencil[..., 1, :]]))
    cost = torch.where(_visible(data, found.vectors), found.cost, torch.inf)
    apart = 1 - (found.vectors[1] * found.vectors[2]).sum(-1).square() > MIN_LINE_ANGLE
    two = ((data.weights > 0).sum(-2) == VIEWS) & real & apart & cost[1:].isfinite().all(0)
    best = torch.where(two, 1, cost.argmin(0))[None]
    vectors, least, spread = found.vectors.take_along_dim(best[..., None], 0), found.cost, found.spread
    line = LineFit(vectors[0], least.take_along_dim(best, 0)[0], spread.take_along_dim(best, 0)[0])
    return line, torch.where(two[..., None], found.vectors[2], 0.0)


MIN_IMAGE_LENGTH = 1e-7  # of a line, line and camera of norm 1: below, it goes through the centre of the camera


def _visible(data: LineSightings, lines: Tensor) -> Tensor:
    """Whether lines ``(*batch, n, 6)`` stay clear of the centres of the cameras that see their points: the join of two centres
    meets all rays, and has no image in them."""
    image = torch.einsum("...vik,...nk->...vni", line_camera(data.cameras), lines).norm(dim=-1)
    image = image / torch.linalg.matrix_norm(line_camera(data.cameras))[..., None].clamp(min=1e-300)
    return (torch.where(data.weights > 0, image, 1.0) > MIN_IMAGE_LENGTH).all(-2)


def _noise(cost: Tensor, seen: Tensor) -> Tensor:
    """Noise of one coordinate from the residuals of all lines of a problem: the median, so that a few curved ones do no harm."""
    free = (seen - VIEWS).clamp(min=1)
    # Wilson and Hilferty: the median of chi^2_k / k
    share = cost / (free * (1 - 2 / (9 * free)) ** 3)
    ranked = torch.where(seen > VIEWS, share, torch.nan)
    return ranked.nanmedian(-1).values.nan_to_num(nan=0.0).sqrt()


MISFIT_LEVEL = 1e-3  # chance that the noise alone makes any line of a problem a misfit
MEDIAN_EFFICIENCY = 0.6  # degrees of freedom that a median of squares is worth, of those that it is taken of
MIN_MISFIT = 1e-6  # RMS in units of the normalized images that rounding never leaves


def _is_misfit(cost: Tensor, seen: Tensor, data: LineSightings, noise: Tensor, estimated: bool) -> Tensor:
    """Whether the squares of a line ``(*batch, n)`` are more than those of noise: chi-square with ``seen - 4`` degrees of freedom,
    or Fisher's F where the noise is that of all lines."""
    views, n = data.weights.shape[-2:]
    free = np.arange(1, max(views - VIEWS, 1) + 1)
    tail = MISFIT_LEVEL / n
    limits = fdtri(free, MEDIAN_EFFICIENCY * n * free, 1 - tail) * free if estimated else chdtri(free, tail)
    limit = torch.tensor(limits, dtype=cost.dtype, device=cost.device)[(seen - VIEWS - 1).clamp(min=0)]
    # less weight is not less noise
    share = cost / data.weights.amax((-2, -1)).clamp(min=torch.finfo(cost.dtype).tiny)[..., None]
    variance = torch.maximum(noise[..., None].square(), (MIN_MISFIT / data.unit[..., 0, :]).square())
    return (seen > VIEWS) & (share > limit * variance)


# ----------------------------------------------------------------------------------------------------------------------
# Uncalibrated cameras from points that move on straight lines: the tensor of six views, and bundle adjustment with lines.


SIX = GrassmannTensor(5, (1,) * 6, dual=True)


@dataclass(frozen=True, eq=False, repr=False)
class TrajectoryCameras(Outcome):
    """Result of :func:`trajectory_cameras`."""

    cameras: Tensor  # ``(*batch, 6, 3, 4)`` of norm 1, up to one collineation of space; 0 where the status says that there are none
    trajectories: Trajectories  # lines and points in the same frame

    TASK = "trajectory_cameras"

    def __repr__(self) -> str:
        return self.head(points=self.trajectories.lines.shape[-2])


@one_thread
@on_cpu
def trajectory_cameras(
    x: Tensor,
    weights: Tensor | None = None,
    *,
    bundle: bool = True,
    sigma: float | None = None,
    options: TrajectoryOptions | None = None,
) -> TrajectoryCameras:
    r"""Six uncalibrated cameras and straight trajectories from points seen one view at a time.

    The determinant of the six rows :math:`x_i^T M_i` vanishes for a point on a line: 3^6 = 729 coefficients, 728 matches.  The
    tensor gives the line cameras up to a collineation of P^5, and the Klein quadric, which it has moved, the cameras
    (:func:`~dyntorch.geometry.extensors.cameras_of_lines`).  The distances from the images of the lines that this linear result
    leaves are 200 to 400 times the noise with 728 matches and 17 times with 1500 (``python -m
    experiments.reconstruction.trajectories``); all
    cameras and lines are then adjusted together, which brings them down to the noise.

    Static points are of no use here: alone they give the tensor rank 78.

    A search: it computes on the CPU wherever its tensors are, and the result returns to their device.

    Args:
        x: ``(*batch, 6, n, 2)`` px, 728 or more points on lines in general position; NaN = missing, which drops the point.
        weights: ``(*batch, n)``, 0 = ignore.
        bundle: follow up with bundle adjustment; without it the linear result.
        sigma: noise of one image coordinate, px, as in :func:`~dyntorch.tasks.trajectories.trajectories.triangulate_trajectories`.
        options: :class:`TrajectoryOptions`; None = the defaults.

    Returns:
        :class:`TrajectoryCameras`.

    Raises:
        ValueError: another shape, or too few points.

    Source: thesis section 1.3 names the tensor and its 728 matches; the way back to the cameras is derived here.

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> turns = torch.linalg.qr(torch.randn(6, 3, 3, generator=g).double()).Q  # cameras all around
        >>> start, way = torch.randn(2, 900, 3, generator=g).double()
        >>> points = start + torch.randn(6, 900, 1, generator=g).double() * way
        >>> seen = points @ turns.mT + torch.tensor([0.0, 0.0, 12.0])
        >>> found = trajectory_cameras(seen[..., :2] / seen[..., 2:], bundle=False)
        >>> int(found.status), bool(found.trajectories.residual.median() < 1e-9)
        (0, True)
    """
    options = TrajectoryOptions() if options is None else options
    check_options(options, TrajectoryOptions)
    check_tensor("x", x, 6, "n", 2)
    check_threshold(sigma, name="sigma")
    if weights is not None and (not isinstance(weights, Tensor) or weights.shape != (*x.shape[:-3], x.shape[-2])):
        got = tuple(weights.shape) if isinstance(weights, Tensor) else weights
        raise ValueError(f"weights must be a tensor (*batch, n) = {(*x.shape[:-3], x.shape[-2])}, one per point, got {got!r}")
    flat = x.reshape(-1, *x.shape[-3:]).double()
    mass = torch.ones_like(flat[:, 0, :, 0]) if weights is None else weights.reshape(flat.shape[0], -1).double()
    solution = fit(SIX, *flat.unbind(1), weights=mass)
    good = ~is_failure(solution.status)
    parts = torch.stack(SIX.starts(solution.normalized), dim=-3)  # (tries, b, 6, 3, 6)
    transforms = torch.stack(solution.normalization.transforms, dim=-3)
    # lines are covariant: l' = T^-T l
    cameras = cameras_of_lines(transforms.mT @ parts)
    cameras = torch.where(good[..., None, None, None], cameras, torch.eye(3, 4, dtype=cameras.dtype, device=cameras.device))
    each = (mass * good[:, None])[:, None].expand(flat.shape[:-1])
    tried = flat.expand(len(cameras), *flat.shape), each.expand(len(cameras), *each.shape)
    found = triangulate_trajectories(cameras, *tried, options=options)
    best = (found.residual.square() * mass).sum(-1).nan_to_num(nan=torch.inf).argmin(0)
    cameras = cameras[best, torch.arange(len(flat), device=x.device)]
    if bundle:
        cameras = _adjust_cameras(cameras, flat, each)
    trajectories = triangulate_trajectories(cameras, flat, each, sigma=sigma, options=options)
    cameras = torch.where(good[..., None, None, None], cameras, 0.0)
    lead = x.shape[:-3]
    shaped: dict[str, Any] = {
        name: part.reshape((*lead, *part.shape[1:])) for name, part in vars(trajectories).items() if isinstance(part, Tensor)
    }
    combined = replace(trajectories, **shaped)
    return TrajectoryCameras(cameras.reshape(*lead, 6, 3, 4).to(x.dtype), combined, status=solution.status.reshape(lead))


NUM_ADJUSTMENTS = 3  # of the cameras, each from lines that are fitted anew


def _adjust_cameras(cameras: Tensor, x: Tensor, weights: Tensor) -> Tensor:
    """Cameras ``(b, 6, 3, 4)`` of least distances of the points from the images of their lines."""
    data, transform, _ = normalize_sightings(cameras, x, torch.where(x.isfinite().all(-1), weights, 0.0))
    for _ in range(NUM_ADJUSTMENTS):
        # a line whose start from the first cameras was bad stays in a minimum of its own: all get a new start
        data = adjust(data, _lines(data)[0].vectors)
    return unit(torch.linalg.solve(transform, data.cameras))
