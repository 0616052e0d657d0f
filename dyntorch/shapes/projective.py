r"""Moving shapes from single perspective views at known times, and when a new view was taken: all points at once.

A view of points :math:`X_i(t) = \sum_b c_b(t) X_{bi}` by any camera of the plane is, up to a similarity of the view,

.. math:: x_i = \frac{A^T X_i + b}{1 + m^T X_i}, \qquad A\ (3 \times 2),\ b\ (2),\ m\ (3),

with m = 0 for affine cameras: :math:`m^T X_i` is how much further than the middle of the shape a point is, in parts of the
distance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyntorch.core.outcome import status_of
from dyntorch.numerics.blocks import one_thread
from dyntorch.numerics.least_squares import LeastSquaresOptions, NormalEquations, minimize
from dyntorch.numerics.nullspace import eigenvalues
from dyntorch.shapes.basis import Trajectory
from dyntorch.shapes.moving import (
    EXACT_NOISE,
    FREE_EIGENVALUE,
    GAUGE,
    AffineViews,
    MovingShapes,
    canonical,
    canonical_frame,
    checked_views,
    fit_shapes,
    shapes_at,
)
from dyntorch.shapes.times import Recovery, date_views

CAMERA = 11
RIDGE = 1e-13
CAMERA_STEPS = 2
"""Gauss-Newton steps from the linear camera."""
MIN_DEPTH = 0.05
"""Least depth of a point, in parts of that of the middle of the shape."""
EXPECTED_DEPTH = 0.15
"""Relative depths of points to expect, RMS: people before a camera at 2 m have .1 to .15, at 4.5 m .05."""
FIRST_EXPECTED_DEPTH = 1.0
"""The same in the first descent, whose noise is what affine cameras leave (.15: 1.5 to 2 times as many steps)."""
MAX_DESCENTS = 8
"""Each with the noise that the last one left: the cameras leave the affine ones step by step."""
CONVERGED_NOISE = 0.8
"""Of the noise of the last descent, above which it is the noise of the views and no more follow."""


@dataclass(frozen=True)
class PerspectiveViews:
    """Views beside the best perspective images of a shape at each view."""

    residual: Tensor
    cost: Tensor  # ``(...)`` its square sum without the prior
    slopes: Tensor  # ``(..., n, 3, 3)`` of the three numbers of the image of each point by the point
    columns: Tensor  # ``(..., 3 n, 11)`` of them by the camera
    inverse: Tensor  # ``(..., 11, 11)`` of their Gram
    depth: Tensor  # ``(..., n)`` the depths of the points, 1 in the middle

    def across(self, x: Tensor) -> Tensor:
        """What no camera takes away of columns ``(..., 3 n, k)``."""
        return x - self.columns @ (self.inverse @ (self.columns.mT @ x))


def perspective(x: Tensor, weights: Tensor, shape: Tensor, prior: Tensor | float) -> PerspectiveViews:
    r"""The best perspective image of a shape in each view: a linear solution, then Gauss-Newton steps. x ``(..., n, 2)``, shape
    ``(..., n, 3)``."""
    root = weights.sqrt()
    total = weights.sum(-1)[..., None, None].clamp(min=1e-300)
    points = shape - (shape * weights[..., None]).sum(-2, keepdim=True) / total
    square = (points * weights[..., None]).mT @ points / total
    # in a frame of unit spread: points of a plane keep a camera
    eye = torch.eye(3, dtype=x.dtype, device=x.device)
    trace = square.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    factor = torch.linalg.cholesky_ex(square + (1e-12 * trace + 1e-300) * eye)[0]
    points = torch.linalg.solve_triangular(factor, points.mT, upper=False).mT
    pull = (
        torch.as_tensor(prior, dtype=x.dtype, device=x.device).expand(x.shape[:-2]).sqrt()[..., None] * root / total[..., 0].sqrt()
    )
    camera = _camera(points, x, torch.ones_like(root), root, torch.nn.functional.pad(x * root[..., None], (0, 1)), pull)[0]
    for step in range(CAMERA_STEPS + 1):
        depth = (1 + (points @ camera[..., 8:, None])[..., 0]).clamp(min=MIN_DEPTH)
        image = (points @ camera[..., :6].unflatten(-1, (3, 2)) + camera[..., None, 6:8]) / depth[..., None]
        error = torch.cat([(x - image) * root[..., None], (pull * (1 - depth))[..., None]], dim=-1)
        change, columns, inverse = _camera(points, image, depth, root, error, pull)
        if step < CAMERA_STEPS:
            camera = camera + change
    affine, lean = camera[..., :6].unflatten(-1, (3, 2)).mT, camera[..., 8:]
    own = (affine[..., None, :, :] - image[..., None] * lean[..., None, None, :]) * (root / depth)[..., None, None]
    own = torch.cat([own, pull[..., None, None] * lean[..., None, None, :]], dim=-2)
    # back to the frame of the shape: a point moves by factor^-1 of what it moves there
    own = torch.linalg.solve_triangular(factor[..., None, :, :], own, upper=False, left=False)
    return PerspectiveViews(error.flatten(-2), error[..., :2].square().sum((-2, -1)), own, columns, inverse, depth)


def _camera(
    points: Tensor, image: Tensor, depth: Tensor, root: Tensor, wanted: Tensor, pull: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Least squares change of the camera for ``wanted`` changes ``(..., n, 3)``, the columns, and the inverse of their Gram."""
    wide = torch.nn.functional.pad(points, (0, 1), value=1.0)  # of A and b, each for both coordinates
    eye = torch.eye(2, dtype=points.dtype, device=points.device)
    above = (wide[..., None, :, None] * eye[:, None]).flatten(-2)  # (.., n, 2, 8)
    columns = torch.cat([above, -image[..., None] * points[..., None, :]], dim=-1) * (root / depth)[..., None, None]
    held = torch.nn.functional.pad(pull[..., None] * points, (CAMERA - 3, 0))
    columns = torch.cat([columns, held[..., None, :]], dim=-2).flatten(-3, -2)
    gram = columns.mT @ columns
    scale = gram.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt()
    whole = torch.eye(CAMERA, dtype=points.dtype, device=points.device)
    even = gram * scale[..., None, :] * scale[..., :, None] + RIDGE * whole
    inverse = torch.linalg.inv_ex(even)[0] * scale[..., None, :] * scale[..., :, None]
    return (inverse @ (columns.mT @ wanted.flatten(-2)[..., None]))[..., 0], columns, inverse


@dataclass(frozen=True)
class PerspectiveDescent(NormalEquations):
    """The shapes that leave the least, the perspective cameras eliminated (variable projection, Kaufman's Jacobian)."""

    views: AffineViews  # see :class:`~dyntorch.shapes.moving.AffineViews`
    rows: Tensor  # ``(b, views, B)`` values of the basis functions
    prior: Tensor  # ``(b,)`` see :func:`perspective`

    def at(self, theta: Tensor) -> PerspectiveViews:
        """All views beside the shapes of parameters ``(b, 3 n B)``."""
        shapes = shapes_at(theta.unflatten(1, (self.rows.shape[-1], -1, 3)), self.rows)
        return perspective(self.views.x, self.views.weights, shapes, self.prior[:, None])

    def parts(self, theta: Tensor) -> tuple[Tensor, ...]:
        """The shapes in their canonical form: what no view can tell does not run away."""
        return (canonical(theta.unflatten(1, (self.rows.shape[-1], -1, 3))),)

    def subset(self, keep: Tensor) -> PerspectiveDescent:
        """Some of the problems."""
        return PerspectiveDescent(self.views.subset(keep), self.rows[keep], self.prior[keep])

    def normal_equations(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cost ``(b,)``, gradient ``(b, p)`` and matrix ``(b, p, p)``."""
        found, rows = self.at(theta), self.rows
        b, _, n = self.views.weights.shape
        size = rows.shape[-1]
        share = self.views.share
        own = torch.eye(n, dtype=theta.dtype, device=theta.device)
        whole = (found.slopes[..., None, :] * own[:, None, :, None]).flatten(-2).flatten(2, 3)
        slope = found.across(whole) * share.sqrt()[..., None, None]  # (b, v, 3 n, 3 n)
        residual = found.residual * share.sqrt()[..., None]
        gradient = (rows.mT @ -(slope.mT @ residual[..., None])[..., 0]).flatten(1)
        lifted = (rows[..., None] * rows[..., None, :]).flatten(2)
        matrix = (lifted.mT @ (slope.mT @ slope).flatten(2)).reshape(b, size, size, 3 * n, 3 * n)
        matrix = matrix.permute(0, 1, 3, 2, 4).reshape(b, size * n * 3, size * n * 3)
        cost = residual.square().sum((-2, -1))
        return torch.where(cost.isfinite(), cost, torch.inf), gradient, matrix


@one_thread
def fit_perspective_shapes(
    x: Tensor,
    rows: Tensor,
    weights: Tensor | None = None,
    *,
    share: Tensor | None = None,
    iterations: int = 60,
) -> MovingShapes:
    r"""Learn how n points move from single perspective views of them, all points at once, each view by another camera.

    .. math:: \min_{X_b, A_v, b_v, m_v} \sum_v \sum_i \Big| x_{vi} - \frac{A_v^T X_i(t_v) + b_v}{1 + m_v^T X_i(t_v)} \Big|^2
              + \kappa \sum_v \frac 1n \sum_i (m_v^T X_i(t_v))^2

    from the affine shapes of :func:`~dyntorch.shapes.fit_shapes`, with :math:`\kappa` falling to the noise variance over that of
    the relative depths that people have before cameras: it vanishes with the noise, and where perspective is weaker than noise
    the cameras are affine.  A descent: 20 of 21 exact scenes (9 and 14 points, 20 and 30 views, distance 8) end at the shapes to
    rounding, the other one in another minimum, with more ``uncertainty`` than is told from noise.

    Args:
        x: ``(*batch, views, n, 2)`` image points in any unit, n >= 6; NaN = missing.
        rows: ``(*batch, views, B)`` or ``(views, B)`` values of the basis functions at the time of each view, the first one 1.
        weights: ``(*batch, views, n)``, 0 = ignore.
        share: ``(*batch, views)`` weight of whole views.
        iterations: steps of each descent at most.

    Returns:
        :class:`~dyntorch.shapes.MovingShapes`: its shapes are up to a constant affine frame (a collineation where nothing moves).

    Raises:
        ValueError: shapes that do not agree, or fewer than six points.

    Source: thesis chapter 4 (dynamic shape tensors of projective cameras); Golub and Pereyra 1973.

    Example:
        >>> import torch
        >>> from dyntorch import Polynomial
        >>> g = torch.Generator().manual_seed(0)
        >>> t = torch.linspace(-1, 1, 14).double()
        >>> points = torch.randn(9, 3, generator=g).double() + t[:, None, None] * 0.5 * torch.randn(9, 3, generator=g).double()
        >>> seen = points @ torch.linalg.qr(torch.randn(14, 3, 3, generator=g).double())[0]
        >>> found = fit_perspective_shapes(seen[..., :2] / (8 + seen[..., 2:]), Polynomial(1).rows(t))
        >>> bool(found.residual.max() < 1e-12), found.count_statuses()
        (True, '1 OK')
    """
    if x.ndim > 2 and x.shape[-2] < 6:
        raise ValueError(f"x needs at least 6 points, five of which a camera takes anywhere, got {x.shape[-2]}")
    batch, views, times = checked_views(x, rows, weights, share)
    views = replace(views, share=views.share * ((views.weights > 0).sum(-1) > 5))
    affine = fit_shapes(views.x, times, views.weights, share=views.share, iterations=iterations)
    shapes, noise = affine.shapes, affine.noise
    few = _spare(views, times) < 0
    for round_ in range(MAX_DESCENTS):
        # what affine cameras leave is perspective for the most part, no noise
        descent = PerspectiveDescent(views, times, (noise / (EXPECTED_DEPTH if round_ else FIRST_EXPECTED_DEPTH)).square())
        found = minimize(descent, descent.evaluate((shapes.flatten(1),)), LeastSquaresOptions(iterations=iterations))
        shapes, old = canonical(found.theta[0].unflatten(1, shapes.shape[1:])), noise
        noise = _noise(views, times, descent.at(shapes.flatten(1)).cost)
        # the noise that the next round believes: exact views have less every time, others the same
        if round_ > 1 and bool((noise > CONVERGED_NOISE * old).all()):
            break
    uncertainty, free = _uncertainty(descent, shapes, noise)
    none = few[:, None, None, None]
    residual = descent.at(shapes.flatten(1)).cost.clamp(0, 1)
    back = [torch.where(none, 0.0, canonical_frame(shapes)), noise, residual, torch.where(few, torch.inf, uncertainty)]
    done = [part.reshape((*batch, *part.shape[1:])).to(x.dtype) for part in back]
    return MovingShapes(*done, status=status_of(free, few).reshape(batch))


def _spare(views: AffineViews, rows: Tensor) -> Tensor:
    """Conditions beyond those that determine the shapes ``(b,)``."""
    seen = (2 * (views.weights > 0).sum(-1) - CAMERA).clamp(min=0) * (views.share > 0)
    return seen.sum(-1) - (3 * rows.shape[-1] * (views.x.shape[-2] - 1) - gauge(rows.shape[-1]))


def gauge(size: int) -> int:
    """Freedom of the frame of the shapes of so many functions, without the translations: affine, projective where nothing moves."""
    return GAUGE + 3 * (size == 1)


def _noise(views: AffineViews, rows: Tensor, cost: Tensor) -> Tensor:
    share = views.share.sum(-1) / (views.share > 0).sum(-1).clamp(min=1)
    variance = (cost * views.share).sum(-1) / (_spare(views, rows).clamp(min=1) * torch.where(share > 0, share, 1.0))
    return variance.sqrt()


def _uncertainty(descent: PerspectiveDescent, shapes: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Expected relative error, and whether another shape explains the views as well, exactly; ``(b,)`` each."""
    size = descent.rows.shape[-1]
    values = eigenvalues(replace(descent, prior=torch.zeros_like(descent.prior)).normal_equations(shapes.flatten(1))[2])
    rest = values[..., gauge(size) + 3 * size :]
    share = descent.views.share.sum(-1) / (descent.views.share > 0).sum(-1).clamp(min=1)
    inverse = (share[:, None] / rest.clamp(min=torch.finfo(rest.dtype).tiny)).sum(-1)
    free = (rest[..., 0] <= FREE_EIGENVALUE * values[..., -1]) & (noise < EXACT_NOISE)
    return torch.where(free, torch.inf, (noise.square() * inverse / 3).sqrt()), free


# ----------------------------------------------------------------------------------------------------------------------
# When a perspective view was taken.


@one_thread
def recover_perspective_times(
    shapes: Tensor,
    basis: Trajectory,
    x: Tensor,
    weights: Tensor | None = None,
    *,
    grid: int = 64,
    interval: tuple[float, float] = (-1.0, 1.0),
) -> Recovery:
    r"""As :func:`~dyntorch.shapes.recover_times`, by perspective images of the shapes.

    Args:
        shapes: ``(*batch, B, n, 3)`` of :func:`fit_perspective_shapes`.
        basis: of the trajectories.
        x: ``(*batch, views, n, 2)`` image points in any unit; NaN = missing.  A view says something from six points on.
        weights: ``(*batch, views, n)``, 0 = ignore.
        grid: times tried.
        interval: polynomial trajectories: times tried from and to.  Periodic ones are tried over the period.

    Returns:
        :class:`~dyntorch.shapes.Recovery` in the dtype of x.

    Raises:
        ValueError: shapes that do not agree, negative weights, or a grid of fewer than 3 times.

    Source: thesis chapter 4: one view of enough points determines the time.

    Example:
        >>> import torch
        >>> from dyntorch import Polynomial
        >>> g = torch.Generator().manual_seed(0)
        >>> points = torch.randn(2, 8, 3, generator=g).double()
        >>> seen = points[0] + 0.3 * points[1]
        >>> found = recover_perspective_times(points, Polynomial(1), (seen[..., :2] / (6 + seen[..., 2:]))[None])
        >>> bool(found.residual < 1e-12), round(float(found.times), 6)
        (True, 0.3)
    """

    def image(shapes: Tensor, x: Tensor, weights: Tensor, t: Tensor) -> PerspectiveViews:
        shape = shapes_at(shapes, basis.rows(t).flatten(1, 2)).unflatten(1, t.shape[1:])
        return perspective(
            x[:, :, None].expand(*t.shape, *x.shape[-2:]), weights[:, :, None].expand(*t.shape, weights.shape[-1]), shape, 0.0
        )

    def curve(shapes: Tensor, x: Tensor, weights: Tensor, times: Tensor) -> Tensor:
        return image(shapes, x, weights, times.expand(*x.shape[:2], -1)).residual.square().sum(-1)

    def slopes(shapes: Tensor, x: Tensor, weights: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        found = image(shapes, x, weights, t)
        speed = shapes_at(shapes, basis.slopes(t).flatten(1, 2)).unflatten(1, t.shape[1:])
        slope = found.across((found.slopes @ speed[..., None])[..., 0].flatten(-2)[..., None])[..., 0]
        return found.residual.square().sum(-1), (found.residual * slope).sum(-1), slope.square().sum(-1)

    return date_views(shapes, basis, x, weights, grid, interval, curve, slopes, width=50 * x.shape[-2], min_points=6)
