r"""Lines and points nearest to what known cameras see of them, and the cameras themselves: distances, derivatives, descents."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from dyntorch.geometry.extensors import (
    line_camera,
    nearest_line,
    plucker_form,
    skew_line,
)
from dyntorch.geometry.homogeneous import apply, finite_depth, homogeneous, similarity, skew
from dyntorch.numerics.blocks import each
from dyntorch.numerics.least_squares import Iterate, LeastSquares, LeastSquaresOptions, Tensors, damped_step, minimize
from dyntorch.numerics.nullspace import eigenvalues

SURFACE = LeastSquaresOptions(iterations=15, damping=1e-4, increase=10.0, least_damping=1e-15, tolerance=None)
DERIVATIVE_STEPS, MAX_DERIVATIVE_STEP = 5, 1e-4
"""Steps that carry derivatives, where they are as small as at a minimum."""
EIGENVALUE_ROUNDING = 1e-13  # eigenvalue of a Gauss-Newton matrix of trace 1 that is rounding
MIN_IMAGE_LINE = 1e-12  # relative size of an image line, or a depth, below which an image is no measurement


@dataclass(frozen=True)
class LineSightings:
    """Points seen by cameras, each at its own time."""

    cameras: Tensor  # ``(*batch, views, 3, 4)``
    x: Tensor  # ``(*batch, views, n, 2)`` finite
    weights: Tensor  # ``(*batch, views, n)``
    unit: Tensor  # ``(*batch, views, n)``, the coordinates of x per pixel

    def rays(self) -> Tensor:
        """The rows :math:`x^T M` that a line through the ray of x fulfils, of norm 1 times the root of the weight,
        ``(*batch, n, views, 6)``."""
        rows = torch.einsum("...vni,...vik->...nvk", homogeneous(self.x), line_camera(self.cameras))
        size = rows.norm(dim=-1, keepdim=True)
        return rows / torch.where(size > 0, size, 1.0) * self.weights.mT.sqrt()[..., None]

    def sides(self) -> Tensor:
        """Two planes through each ray, weighted: what a point on all rays fulfils, ``(*batch, n, 2 views, 4)``."""
        top, last = self.cameras[..., :2, :], self.cameras[..., 2, :]
        rows = self.x[..., None] * last[..., None, None, :] - top[..., None, :, :]
        rows = rows / rows.norm(dim=-1, keepdim=True).clamp(min=torch.finfo(rows.dtype).tiny)
        return (rows * self.weights.sqrt()[..., None, None]).transpose(-4, -3).flatten(-3, -2)


def normalize_sightings(cameras: Tensor, x: Tensor, weights: Tensor) -> tuple[LineSightings, Tensor, Tensor]:
    """Images about 0 and of size 1, in a world in which the stacked cameras are orthonormal."""
    known = (weights > 0)[..., None]
    x = torch.where(known, x, 0.0)
    cameras = torch.where(cameras.isfinite().flatten(-2).all(-1)[..., None, None], cameras, 0.0)
    total = weights.sum(-1, keepdim=True)
    centre = (x * weights[..., None]).sum(-2) / torch.where(total > 0, total, 1.0)
    common = (x * weights[..., None]).sum((-3, -2)) / weights.sum((-2, -1)).clamp(min=1e-300)[..., None]
    square = ((x - common[..., None, None, :]).square().sum(-1) * weights).sum((-2, -1))
    spread = (square / weights.sum((-2, -1)).clamp(min=1e-300)).sqrt()
    scale = torch.where(spread > 0, math.sqrt(2) / torch.where(spread > 0, spread, 1.0), 1.0)[..., None].expand(centre.shape[:-1])
    transform = similarity(scale, centre)
    moved = transform @ cameras
    size = torch.linalg.matrix_norm(moved, keepdim=True)
    moved = moved / torch.where(size > 0, size, 1.0)
    # only a gauge: where it lies makes no difference to the result, nor to its derivatives
    upper = torch.linalg.qr(moved.detach().flatten(-3, -2), mode="r")[1]
    diagonal = upper.diagonal(dim1=-2, dim2=-1).abs()
    eye = torch.eye(4, dtype=x.dtype, device=x.device)
    # cameras of one centre only leave the world as it is: nothing can be triangulated
    upper = torch.where((diagonal.amin(-1) > 1e-12 * diagonal.amax(-1))[..., None, None], upper, eye)
    back = torch.linalg.solve_triangular(upper, eye.expand_as(upper), upper=True)
    data = LineSightings(moved @ back[..., None, :, :], apply(transform, x), weights, scale[..., None].expand(weights.shape))
    return data, transform, back


@dataclass(frozen=True)
class LineFit:
    """Unit vectors ``(*batch, n, k)``, their cost ``(*batch, n)`` in px^2, and the trace of the inverse Gauss-Newton matrix along
    the surface, ``(*batch, n)``: the squared uncertainty at a noise of 1 px."""

    vectors: Tensor
    cost: Tensor
    spread: Tensor


def image_distances(data: LineSightings, lines: Tensor) -> tuple[Tensor, Tensor]:
    r"""Weighted distances of the points from the image lines, px, and their derivatives in the image lines. lines
    ``(*batch, n, 6)`` -> ``(*batch, views, n)``."""
    image = torch.einsum("...vik,...nk->...vni", line_camera(data.cameras), lines)
    # a line through the centre of a camera has no image there
    size = image[..., :2].norm(dim=-1).clamp(min=MIN_IMAGE_LINE)
    distance = (homogeneous(data.x) * image).sum(-1) / size
    normal = homogeneous(data.x - (distance / size)[..., None] * image[..., :2])
    factor = data.weights.sqrt() / data.unit
    return distance * factor, normal * (factor / size)[..., None]


def to_lines(data: LineSightings, lines: Tensor) -> tuple[Tensor, Tensor]:
    """The distances ``(*batch, n, views)`` and their derivatives in the lines, ``(*batch, n, views, 6)``."""
    distance, slope = image_distances(data, lines)
    return distance.mT, torch.einsum("...vni,...vik->...nvk", slope, line_camera(data.cameras))


def to_points(data: LineSightings, points: Tensor) -> tuple[Tensor, Tensor]:
    """Weighted reprojection errors of points ``(*batch, n, 4)``, px: ``(*batch, n, 2 views)`` and ``(*batch, n, 2 views, 4)``."""
    image = torch.einsum("...vik,...nk->...vni", data.cameras, points)
    depth = finite_depth(image)
    seen = image[..., :2] / depth
    top, last = data.cameras[..., None, :2, :], data.cameras[..., None, 2:, :]
    slope = (top - seen[..., None] * last) / depth[..., None]
    factor = (data.weights.sqrt() / data.unit)[..., None]
    error, slope = (seen - data.x) * factor, slope * factor[..., None]
    return error.transpose(-3, -2).flatten(-2), slope.transpose(-4, -3).flatten(-3, -2)


def fit_lines(data: LineSightings, starts: Tensor) -> LineFit:
    """Lines ``(*batch, n, 6)`` of least distance, from starts on the Klein quadric; leading dimensions of the starts broadcast."""
    form = plucker_form(device=starts.device)
    return _descend(Surface(lambda v: to_lines(data, v), lambda v: torch.stack([v, v @ form], dim=-2), nearest_line), starts)


def fit_points(data: LineSightings, starts: Tensor) -> LineFit:
    """Points ``(*batch, n, 4)`` of least reprojection error."""
    return _descend(Surface(lambda p: to_points(data, p), lambda p: p[..., None, :], lambda p: normalize(p, dim=-1)), starts)


@dataclass(frozen=True)
class Surface(LeastSquares):
    """Least squares on a surface of unit vectors ``(*batch, n, k)``: steps along it, then back to the nearest of its points."""

    measure: Callable[[Tensor], tuple[Tensor, Tensor]]  # residuals ``(*batch, n, rows)`` of vectors and their derivative
    normals: Callable[[Tensor], Tensor]  # orthonormal directions off the surface, ``(*batch, n, constraints, k)``
    nearest: Callable[[Tensor], Tensor]  # the nearest point of the surface

    def evaluate(self, theta: Tensors) -> Iterate:
        """With gradient, Gauss-Newton matrix and its trace along the surface."""
        value, slope = self.measure(theta[0])
        across = self.normals(theta[0])
        along = torch.eye(across.shape[-1], dtype=value.dtype, device=value.device) - across.mT @ across
        slope = slope @ along
        matrix = slope.mT @ slope
        # an equation of their own for the directions off the surface, of the size of the others
        size = matrix.diagonal(dim1=-2, dim2=-1).sum(-1) + torch.finfo(value.dtype).tiny
        matrix = matrix + size[..., None, None] * (across.mT @ across)
        return Iterate(theta, value.square().sum(-1), ((slope.mT @ value[..., None])[..., 0], matrix, size))

    def step(self, at: Iterate, damping: Tensor) -> Tensors:
        """Along the surface."""
        gradient, matrix, _ = at.terms
        return (damped_step(gradient.flatten(0, -2), matrix.flatten(0, -3), damping.flatten()).view(gradient.shape),)

    def retract(self, theta: Tensors, step: Tensors) -> Tensors:
        """Back onto it."""
        return (self.nearest(theta[0] - step[0]),)


def _descend(surface: Surface, starts: Tensor) -> LineFit:
    """The vectors of least cost; with their derivatives, where gradients are recorded."""
    with torch.no_grad():
        at = Iterate(*minimize(surface, surface.evaluate((starts.detach(),)), SURFACE)[:3])
    if torch.is_grad_enabled():
        at = surface.evaluate(at.theta)
        # at the minimum the derivatives are those of the last steps: each brings them nearer by what Gauss-Newton leaves out
        for _ in range(DERIVATIVE_STEPS):
            (step,) = surface.step(at, torch.zeros_like(at.cost))
            near = step.detach().norm(dim=-1, keepdim=True) < MAX_DERIVATIVE_STEP
            at = surface.advance(at, (torch.where(near, step, 0.0),))
    (vectors,), (_, matrix, size) = at.theta, at.terms
    return LineFit(vectors, at.cost, _spread(matrix.detach(), size.detach(), surface.normals(vectors).shape[-2]))


def _spread(matrix: Tensor, size: Tensor, constraints: int) -> Tensor:
    """Trace of the inverse along the surface; infinite where a direction is free."""
    sound = matrix.isfinite().flatten(-2).all(-1) & size.isfinite()
    eye = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    values = eigenvalues(torch.where(sound[..., None, None], matrix / size[..., None, None], eye))
    free = ~sound | (values[..., 0] < EIGENVALUE_ROUNDING)
    return torch.where(
        free, torch.inf, (values.clamp(min=EIGENVALUE_ROUNDING).reciprocal().sum(-1) - constraints).clamp(min=0) / size
    )


# ----------------------------------------------------------------------------------------------------------------------
# Bundle adjustment of cameras and straight trajectories: all distances of points from the images of their lines at once.


ADJUSTMENT = LeastSquaresOptions(iterations=25, increase=10.0, stuck_damping=1e8, tolerance=1e-6)


@dataclass(frozen=True)
class Adjustment(LeastSquares):
    r"""Least squares in cameras ``(b, views, 3, 4)`` and lines ``(b, n, 6)``, the lines eliminated (Schur complement)."""

    data: LineSightings
    """Whose cameras do not count."""

    def subset(self, keep: Tensor) -> Adjustment:
        """Only some of the problems."""
        return each(lambda part: part[keep], self)

    def evaluate(self, theta: Tensors) -> Iterate:
        """Sum of squared weighted distances, px^2."""
        return Iterate(theta, image_distances(self._at(theta), theta[1])[0].square().sum((-2, -1)), ())

    def step(self, at: Iterate, damping: Tensor) -> Tensors:
        """Of cameras and lines."""
        return _adjustment_step(self._at(at.theta), at.theta[1], damping)

    def retract(self, theta: Tensors, step: Tensors) -> Tensors:
        """Cameras of norm 1, lines on the Klein quadric."""
        cameras = theta[0] - step[0]
        return cameras / torch.linalg.matrix_norm(cameras, keepdim=True), nearest_line(theta[1] - step[1])

    def _at(self, theta: Tensors) -> LineSightings:
        return replace(self.data, cameras=theta[0])


def adjust(data: LineSightings, lines: Tensor) -> LineSightings:
    r"""Cameras and lines of least distances of the points from the images of the lines. lines ``(*batch, n, 6)``."""
    problem = Adjustment(data)
    return replace(data, cameras=minimize(problem, problem.evaluate((data.cameras, lines)), ADJUSTMENT).theta[0])


def _adjustment_step(data: LineSightings, lines: Tensor, damping: Tensor) -> Tensors:
    """Steps of the cameras ``(*batch, views, 3, 4)`` and the lines ``(*batch, n, 6)``, to be subtracted."""
    distance, slope = image_distances(data, lines)  # (*batch, views, n), (*batch, views, n, 3)
    by_line = torch.einsum("...vni,...vik->...nvk", slope, line_camera(data.cameras))
    across = torch.stack([lines, lines @ plucker_form(device=lines.device)], dim=-2)
    by_line = by_line - (by_line @ across.mT) @ across
    by_camera = (skew(slope) @ data.cameras[..., None, :, :] @ skew_line(lines)[..., None, :, :, :]).flatten(-2)
    views = distance.shape[-2]
    own = by_line.mT @ by_line
    size = own.diagonal(dim1=-2, dim2=-1).sum(-1) + torch.finfo(own.dtype).tiny
    own = own + torch.diag_embed(own.diagonal(dim1=-2, dim2=-1) * damping[..., None, None])
    factor, _ = torch.linalg.cholesky_ex(
        own + size[..., None, None] * (across.mT @ across + 1e-12 * torch.eye(6, dtype=own.dtype, device=own.device))
    )
    pull = torch.einsum("...nvk,...vn->...nk", by_line, distance)
    mixed = (by_camera.transpose(-3, -2)[..., None] * by_line[..., None, :]).flatten(-3, -2)  # (*batch, n, 12 views, 6)
    solved = torch.cholesky_solve(mixed.mT, factor).mT
    whole = torch.einsum("...vnp,...vnq->...vpq", by_camera, by_camera)
    blocks = torch.eye(views, dtype=whole.dtype, device=whole.device)[:, None, :, None] * whole[..., :, :, None, :]
    reduced = blocks.flatten(-4, -3).flatten(-2) - (mixed.transpose(-3, -2).flatten(-2) @ solved.transpose(-3, -2).flatten(-2).mT)
    gradient = torch.einsum("...vnp,...vn->...vp", by_camera, distance).flatten(-2) - (solved @ pull[..., None])[..., 0].sum(-2)
    shift = damped_step(gradient.flatten(0, -2), reduced.flatten(0, -3), damping.flatten()).view(gradient.shape)
    rest = pull - (mixed.mT @ shift[..., None, :, None])[..., 0]
    turn = torch.cholesky_solve(rest[..., None], factor)[..., 0]
    return shift.unflatten(-1, (views, 3, 4)), torch.where(turn.isfinite(), turn, 0.0)
