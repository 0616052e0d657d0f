r"""Moving shapes from single affine views at known times: the all-joint form, and where in time a new view belongs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import prod

import torch
from torch import Tensor

from dyntorch.core.outcome import Outcome, Status, status_of
from dyntorch.geometry.homogeneous import nonzero_sign
from dyntorch.numerics.arguments import check_weights
from dyntorch.numerics.blocks import one_thread, select
from dyntorch.numerics.least_squares import LeastSquaresOptions, NormalEquations, flat_directions, follow_minimum, minimize
from dyntorch.numerics.nullspace import eigenvalues, eigh, gram_null_space, null_space, spectrum
from dyntorch.shapes.static import centring_basis

# ----------------------------------------------------------------------------------------------------------------------
# All joints of a moving shape at once: the least squares shapes :math:`X_b` behind single affine views of it.


RIDGE_EPSILON = 1e-12
"""Ridge of the Gram of three coordinates, of its trace: a planar shape keeps the residual finite and exact to 1e-12."""
SAME_FUNCTION = 1e-9
"""Singular value, over the largest, below which products of basis functions are the same function at the times of the views."""
MIN_WINDOW_VIEWS = 6
"""Least number of views in a window in which the shape is taken to stand still."""
MAX_WINDOWS = 200
FILL_ITERATIONS = 3
"""Iterations in which missing points are filled in from the mean shape."""
FILL_RIDGE = 1e-3
"""Ridge of the regression of a view's points on the mean shape, whose columns are of norm 1."""
START_STEPS = 20
"""Steps from every start before the best one goes on: of 240 scenes (degree 1 and 2, 1 and 2 harmonics, 8 and 14 points, noise 1
and 3 %, 40 views) 3 go on from a start that does not lead to the least cost of all."""
STEPS_PER_FUNCTION = 5
"""Steps for each function that is added to the last start."""
FREE_EIGENVALUE = 4e-12
"""Eigenvalue of the normal matrix with all cameras at norm 1, over the largest, below which its direction is free: the affine frame
1e-12 (the ridge of the Grams), points in a plane or at rest 1e-16 to 2e-12, five points of degree 2 from 7e-11."""
MAX_UNCERTAINTY = 0.5
"""Expected relative error of the shapes above which other shapes explain the views as well."""
EXACT_NOISE = 1e-6
"""Noise of views of norm 1 below which they are called exact; float32 leaves 1e-8 to 1e-7."""


@dataclass(frozen=True)
class AffineViews:
    """Centred single views, one row of the problem each."""

    x: Tensor  # ``(b, views, n, 2)`` finite, weighted centroid 0, weighted energy 1 (0 where a view says nothing)
    weights: Tensor  # ``(b, views, n)``, the sum over a view is n (or 0): missing points weigh nothing
    share: Tensor  # ``(b, views)`` weight of each view
    scale: Tensor  # ``(b, views)`` what the coordinates were divided by

    def repeat(self, count: int) -> AffineViews:
        """The same problems ``count`` times, one after the other."""
        return AffineViews(*(part.repeat(count, *([1] * (part.ndim - 1))) for part in vars(self).values()))

    def subset(self, keep: Tensor) -> AffineViews:
        """Some of the problems."""
        return AffineViews(*(part[keep] for part in vars(self).values()))


def centred_views(x: Tensor, weights: Tensor | None = None, share: Tensor | None = None) -> AffineViews:
    """Views ``(b, views, n, 2)`` at their centroids, each with energy 1; NaN and weight 0 are missing points."""
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
    energy = (moved.square() * weight[..., None]).sum((-2, -1))
    # no root of 0, whose derivative is not finite
    scale = torch.where(energy > 0, energy, 1.0).sqrt() * (energy > 0)
    # coordinates equal to rounding are one place
    known = (seen > 4) & (scale > 1e-12 * clean.abs().amax((-2, -1)))
    scale = torch.where(known, scale, 1.0)
    given = known.to(x.dtype) if share is None else torch.where(known, share, 0.0)
    return AffineViews(torch.where(known[..., None, None], moved / scale[..., None, None], 0.0), weight, given, scale)


@dataclass(frozen=True)
class ProjectedShapes:
    """Views projected onto a shape at each view."""

    residual: Tensor  # ``(..., n, 2)`` weighted by the root of the weights
    cameras: Tensor  # ``(..., 3, 2)`` least squares A of :math:`x = X A + 1 b`
    basis: Tensor  # ``(..., n, 3)`` orthonormal basis of the centred weighted shape
    inverse: Tensor  # ``(..., 3, 3)`` what makes the shape that basis


def project(x: Tensor, weights: Tensor, shape: Tensor) -> ProjectedShapes:
    """Residuals of centred views ``(..., n, 2)`` for shapes ``(..., n, 3)`` (or of other width); their translation is nothing."""
    root = weights.sqrt()[..., None]
    centre = (shape * weights[..., None]).sum(-2, keepdim=True) / weights.sum(-1)[..., None, None].clamp(min=1e-300)
    moved = (shape - centre) * root
    seen = x * root
    gram = moved.mT @ moved
    eye = torch.eye(gram.shape[-1], dtype=x.dtype, device=x.device)
    ridge = RIDGE_EPSILON * gram.diagonal(dim1=-2, dim2=-1).sum(-1) + torch.finfo(x.dtype).tiny
    factor, _ = torch.linalg.cholesky_ex(gram + ridge[..., None, None] * eye)
    inverse = torch.linalg.solve_triangular(factor, eye.expand_as(factor), upper=False).mT
    basis = moved @ inverse
    inner = basis.mT @ seen
    return ProjectedShapes(seen - basis @ inner, inverse @ inner, basis, inverse)


def slopes(found: ProjectedShapes, weights: Tensor, rows: Tensor) -> Tensor:
    r"""Derivative of the residuals by the shapes (Golub and Pereyra): :math:`dr = -\Pi^\perp dX A - (X^+)^T dX^T r`. weights
    ``(..., views, n)``, rows ``(..., views, B)`` -> ``(..., views, n, B, 3, n, 2)``."""
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


def canonical_frame(shapes: Tensor) -> Tensor:
    """:func:`canonical` with the columns of :math:`X_0` orthogonal, the longest first: one representative of each family."""
    moved = canonical(shapes)
    first = moved[:, 0]
    axes = eigh(first.mT @ first)[1].flip(-1)
    turned = moved @ axes[:, None]
    flat = turned.flatten(1, 2)
    return turned * nonzero_sign(flat.take_along_dim(flat.abs().argmax(1, keepdim=True), 1))[:, None]


def cost_of(views: AffineViews, rows: Tensor, shapes: Tensor) -> Tensor:
    """Weighted square sum of the residuals ``(b,)``."""
    return _cost(views, project(views.x, views.weights, shapes_at(shapes, rows)))


def _cost(views: AffineViews, found: ProjectedShapes) -> Tensor:
    return (found.residual.square().sum((-2, -1)) * views.share).sum(-1)


@dataclass(frozen=True)
class ShapeDescent(NormalEquations):
    r"""The shapes that leave the least, the cameras eliminated."""

    views: AffineViews  # see :class:`AffineViews`
    rows: Tensor  # ``(b, views, B)`` values of the basis functions

    def shapes(self, theta: Tensor) -> Tensor:
        """Shapes ``(b, B, n, 3)`` of parameters ``(b, 3 n B)``."""
        return theta.unflatten(1, (self.rows.shape[-1], -1, 3))

    def parts(self, theta: Tensor) -> tuple[Tensor, ...]:
        """The shapes in their canonical form: what no view can tell does not run away."""
        return (canonical(self.shapes(theta)),)

    def subset(self, keep: Tensor) -> ShapeDescent:
        """Some of the problems."""
        return ShapeDescent(self.views.subset(keep), self.rows[keep])

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


def descend(views: AffineViews, rows: Tensor, shapes: Tensor, iterations: int) -> tuple[Tensor, Tensor]:
    r"""Minimize :math:`\sum_v w_v \|(I - \Pi(t_v))\,x_v\|^2` over the shapes (variable projection). rows ``(b, views, B)``,
    shapes ``(b, B, n, 3)`` -> ``(b,)``."""
    problem = ShapeDescent(views, rows)
    found = minimize(problem, problem.evaluate((shapes.flatten(1),)), LeastSquaresOptions(iterations=iterations))
    return canonical(found.theta[0].unflatten(1, shapes.shape[1:])), found.cost


# ----------------------------------------------------------------------------------------------------------------------
# Linear forms of a moving shape seen by affine cameras: the graph over a basis, and the span of all its positions.


@dataclass(frozen=True)
class Graph:
    r"""The subspace as a graph over three coordinates: :math:`D(t)\, z_j = \sum_i N_{ij}(t)\, y_i`."""

    scale: Tensor  # ``(b, K)`` coefficients of D, norm 1
    slopes: Tensor  # ``(b, K, 3, m)`` coefficients of N
    degenerate: Tensor  # ``(b,)`` bool: more than one such graph fulfils the equations

    def bases(self, powers: Tensor) -> Tensor:
        """Columns that span the subspace ``(b, views, 3 + m, 3)`` at ``powers (b, views, K)``: y above, z below."""
        eye = torch.eye(3, dtype=powers.dtype, device=powers.device)
        above = (powers @ self.scale[..., None])[..., None] * eye
        below = torch.einsum("bvk,bkim->bvmi", powers, self.slopes)
        return torch.cat([above, below], dim=-2)


def graph(y: Tensor, z: Tensor, powers: Tensor, share: Tensor) -> Graph:
    r"""Solve :math:`D(t_v)\, z_j = \sum_i N_{ij}(t_v)\, y_i` for the coefficients of D and N, linear for known times. y
    ``(b, views, 3, 2)``, z ``(b, views, m, 2)``, powers ``(b, views, K)``, share ``(b, views)``."""
    root = share.sqrt()[..., None, None, None]
    known = (powers[..., :, None, None] * y[..., None, :, :] * root).flatten(-3, -2)  # (b, v, 3 K, 2)
    known = known.mT.flatten(1, 2)
    q, r = torch.linalg.qr(known)
    pivots = r.diagonal(dim1=-2, dim2=-1).abs()
    flat = pivots.amin(-1) <= 1e-12 * pivots.amax(-1)
    columns = (powers[..., :, None, None] * z[..., None, :, :] * root).permute(0, 3, 1, 4, 2).flatten(2, 3)  # (b, m, 2 v, K)
    inner = q.mT[:, None] @ columns
    left = columns - q[:, None] @ inner
    found = gram_null_space((left.mT @ left).sum(1))
    scale = null_space(left.flatten(1, 2))[..., 0, :]
    slopes = torch.linalg.solve_triangular(r, (inner @ scale[:, None, :, None])[..., 0].mT, upper=True)
    slopes = slopes.unflatten(1, (powers.shape[-1], 3))
    slopes = torch.where(slopes.isfinite(), slopes, 0.0)
    return Graph(scale, slopes, flat | found.degenerate)


def complete(views: AffineViews) -> Tensor:
    """The centred views ``(b, views, n, 2)`` with missing points filled in from the mean shape of all views."""
    x, seen = views.x, (views.weights > 0)[..., None]
    if bool(seen.all()):
        return x
    for _ in range(FILL_ITERATIONS):
        mean = leading(x, views.share)[:, None]
        part = torch.where(seen, mean, 0.0)
        filled = mean @ _regress(part, torch.where(seen, x, 0.0))
        x = torch.where(seen, x, filled)
        x = x - x.mean(-2, keepdim=True)
    return x


def _regress(basis: Tensor, x: Tensor) -> Tensor:
    gram = basis.mT @ basis
    eye = torch.eye(basis.shape[-1], dtype=x.dtype, device=x.device)
    return torch.linalg.solve_ex(gram + FILL_RIDGE * eye, basis.mT @ x)[0]


def leading(x: Tensor, share: Tensor, count: int = 3) -> Tensor:
    """The directions ``(..., n, count)`` with the most energy in views ``(..., views, n, 2)``."""
    scatter = (x * share[..., None, None]).movedim(-3, -2).flatten(-2) @ x.movedim(-3, -2).flatten(-2).mT
    return spectrum(scatter)[1][..., -count:].flip(-1)


def products(rows: Tensor) -> Tensor:
    """Orthonormal basis ``(b, views, K)`` of all products of three of the functions ``(b, views, B)``, as seen at the views."""
    size = rows.shape[-1]
    places = torch.combinations(torch.arange(size), 3, with_replacement=True).to(rows.device)
    cubes = rows[..., places].prod(-1)
    u, s, _ = torch.linalg.svd(cubes, full_matrices=False)
    # one width for the whole batch: a function more than a problem can tell is one it cannot tell either
    return u[..., : max((s > SAME_FUNCTION * s[..., :1]).sum(-1).clamp(min=1).tolist(), default=size)]


def shapes_through(bases: Tensor, rows: Tensor, share: Tensor) -> Tensor:
    r"""The shapes whose span is nearest to given subspaces: :math:`(I - \Pi_v) \sum_b c_{vb} X_b = 0`, a null space of
    dimension 3. bases ``(b, views, k, 3)``, rows ``(b, views, B)``, share ``(b, views)`` -> ``(b, B, k, 3)``."""
    q = torch.linalg.qr(torch.where(bases.isfinite(), bases, 0.0))[0]
    eye = torch.eye(q.shape[-2], dtype=q.dtype, device=q.device)
    away = (eye - q @ q.mT).flatten(2)
    lifted = (rows[..., None] * rows[..., None, :]).flatten(2) * share[..., None]
    size, k = rows.shape[-1], q.shape[-2]
    gram = (lifted.mT @ away).reshape(-1, size, size, k, k).transpose(2, 3).reshape(-1, size * k, size * k)
    return gram_null_space(gram, 3).basis.mT.unflatten(1, (size, k))


def graph_start(x: Tensor, rows: Tensor, share: Tensor) -> Tensor | None:
    """Shapes ``(b, B, n, 3)`` by the graph over the mean shape of centred views ``(b, views, n, 2)``; None with too few views."""
    powers = products(rows)
    helmert = centring_basis(x.shape[-2], x.device)
    flat = helmert @ x
    if 2 * x.shape[1] < 3 * powers.shape[-1] + 1:
        return None
    scatter = leading(flat, share, flat.shape[-2])
    turned = scatter.mT[:, None] @ flat
    found = graph(turned[..., :3, :], turned[..., 3:, :], powers, share)
    return helmert.mT @ scatter[:, None] @ shapes_through(found.bases(powers), rows, share)


def window_start(x: Tensor, rows: Tensor, share: Tensor) -> Tensor:
    """Shapes ``(b, B, n, 3)`` by the static shapes of windows of views at about one time."""
    helmert = centring_basis(x.shape[-2], x.device)
    flat = helmert @ x
    count = x.shape[1]
    anchors = torch.linspace(0, count - 1, min(count, MAX_WINDOWS), device=x.device).round().long()
    nearest = min(count, max(MIN_WINDOW_VIEWS, count // (4 * rows.shape[-1])))
    apart = torch.cdist(rows[:, anchors], rows) + torch.where(share > 0, 0.0, torch.inf)[:, None]
    window = apart.topk(nearest, largest=False).indices  # (b, anchors, nearest)
    problem = torch.arange(len(x), device=x.device)[:, None, None]
    bases = leading(flat[problem, window], share[problem, window])
    return helmert.mT @ shapes_through(bases, rows[:, anchors], torch.ones_like(share[:, anchors]))


def pooled_start(x: Tensor, rows: Tensor, share: Tensor) -> Tensor | None:
    r"""Shapes ``(b, B, n, 3)`` by the span of all positions, of dimension 3 B; None where that is the whole space."""
    size, n = rows.shape[-1], x.shape[-2]
    if n - 1 < 3 * size or 2 * x.shape[1] * (size - 1) < 3 * size * size - 3:
        return None
    u = leading(x, share, 3 * size)
    y = u.mT[:, None] @ x  # (b, v, 3 B, 2)
    q = torch.linalg.qr(rows[..., None], mode="complete")[0][..., 1:]  # (b, v, B, B - 1)
    equations = torch.einsum("bvcq,bvku,bv->bvquck", q, y, share.sqrt()).flatten(4).flatten(1, 3)
    inverse = null_space(equations, 3).unflatten(-1, (size, 3 * size)).transpose(1, 2).flatten(1, 2)  # (b, 3 B, 3 B): rows (b, k)
    shapes = torch.linalg.solve_ex(inverse.mT, u.mT)[0].mT  # (b, n, 3 B)
    return canonical(shapes.unflatten(-1, (size, 3)).transpose(1, 2))


GAUGE = 9
"""Parameters of the shapes that no view can tell: a constant affine frame of the world."""


@dataclass(frozen=True, eq=False, repr=False)
class MovingShapes(Outcome):
    """Result of :func:`fit_shapes`.

    Attributes:
        shapes: ``(*batch, B, n, 3)`` the shape :math:`X_b` of every basis function, centroids 0, columns orthonormal over all b.
        noise: ``(*batch,)`` standard deviation of one coordinate of a view, its centred views having Frobenius norm 1.
        residual: ``(*batch, views)`` part of the energy of each view that the shape does not explain, in [0, 1].
        uncertainty: ``(*batch,)`` expected relative error of the shapes from the noise; infinite where they are not determined.
        status: ``(*batch,)``: ``TOO_FEW`` where fewer views are given than determine the shapes, ``DEGENERATE`` where other shapes
            explain the views exactly as well (planar or resting points, equal times).
    """

    shapes: Tensor
    noise: Tensor
    residual: Tensor
    uncertainty: Tensor

    TASK = "fit_shapes"

    @property
    def underdetermined(self) -> Tensor:
        """``(*batch,)`` bool: fewer views than determine the shapes."""
        return self.status == Status.TOO_FEW

    @property
    def degenerate(self) -> Tensor:
        """``(*batch,)`` bool: other shapes explain the views exactly as well."""
        return self.status == Status.DEGENERATE

    def __repr__(self) -> str:
        return self.head(views=self.residual.shape[-1], points=self.shapes.shape[-2], functions=self.shapes.shape[-3])


@one_thread
def fit_shapes(
    x: Tensor,
    rows: Tensor,
    weights: Tensor | None = None,
    *,
    share: Tensor | None = None,
    iterations: int = 50,
) -> MovingShapes:
    r"""Learn how n points move from single affine views of them, all points at once, each view by another camera.

    .. math:: \min_{X_b, A_v, b_v} \sum_v \Big\| x_v - \sum_b c_b(t_v)\, X_b\, A_v - 1 b_v^T \Big\|^2

    with every view brought to norm 1: maximum likelihood for noise that is the same part of the size of every view.  The
    cameras are eliminated (variable projection).  It starts from up to four solutions (graph over the mean shape, windows in which
    the shape stands still, span of all positions, shapes that learn one function of the time after the other) and goes on from the
    one that explains most.

    Args:
        x: ``(*batch, views, n, 2)`` image points in any unit, n >= 5; NaN = missing.
        rows: ``(*batch, views, B)`` or ``(views, B)`` values of the basis functions at the time of each view, the first one 1
            (:class:`~dyntorch.shapes.basis.Polynomial`, ``Fourier``).
        weights: ``(*batch, views, n)``, 0 = ignore.
        share: ``(*batch, views)`` weight of whole views.
        iterations: steps of the descent at most.

    Returns:
        :class:`MovingShapes` in the dtype of x; zero shapes where ``underdetermined``.

    Raises:
        ValueError: shapes that do not agree, or fewer than five points.

    Source: thesis chapter 4 (dynamic shape tensors), with all points in the place of four basis points; Golub and Pereyra 1973.

    Example:
        >>> import torch
        >>> from dyntorch import Polynomial
        >>> g = torch.Generator().manual_seed(0)
        >>> rows = Polynomial(1).rows(torch.linspace(-1, 1, 12).double())
        >>> points, cameras = torch.randn(2, 8, 3, generator=g).double(), torch.randn(12, 3, 2, generator=g).double()
        >>> found = fit_shapes(torch.einsum("vb,bnk,vkd->vnd", rows, points, cameras), rows)
        >>> bool(found.residual.max() < 1e-12), bool(found.degenerate)
        (True, False)
    """
    batch, views, times = checked_views(x, rows, weights, share)
    few = _is_underdetermined(views, times)
    shapes, cost = _fit_from_starts(views, times, iterations)
    uncertainty, noise, free = _uncertainty(views, times, shapes, cost)
    found = project(views.x, views.weights, shapes_at(shapes, times))
    residual = found.residual.square().sum((-2, -1)).clamp(0, 1)
    none = few[:, None, None, None]
    back = [torch.where(none, 0.0, canonical_frame(shapes)), noise, residual, torch.where(few, torch.inf, uncertainty)]
    done = [part.reshape((*batch, *part.shape[1:])).to(x.dtype) for part in back]
    return MovingShapes(*done, status=status_of(free, few).reshape(batch))


def followed_shapes(shapes: Tensor, measured: Tensor, rows: Tensor, share: Tensor) -> Tensor:
    """The shapes ``(b, B, n, 3)`` of least squares as a function of what they were fitted to, in the same form."""
    theta = shapes.detach().flatten(1)
    with torch.no_grad():
        matrix = ShapeDescent(_views_of(measured, share), rows).normal_equations(theta)[2]
    free = flat_directions(matrix, GAUGE + 3 * rows.shape[-1])

    def cost(theta: Tensor, measured: Tensor, rows: Tensor, share: Tensor) -> Tensor:
        return cost_of(_views_of(measured, share), rows, theta.unflatten(1, shapes.shape[1:]))

    found = follow_minimum(cost, theta, free, measured, rows, share).unflatten(1, shapes.shape[1:])
    # what no view can tell is nailed down as it is in the fit
    none = (theta == 0).all(-1)
    return select(~none, canonical_frame(select(~none, found, _placeholder_shape(shapes))), 0.0)


def _placeholder_shape(shapes: Tensor) -> Tensor:
    """A shape whose frame has derivatives, in place of one that is zero."""
    n = torch.arange(1.0, shapes.shape[-2] * 3 + 1, dtype=shapes.dtype, device=shapes.device).reshape(-1, 3)
    return (n.sin() * torch.tensor([1.0, 2.0, 3.0]).to(n)).expand_as(shapes)


def _views_of(measured: Tensor, share: Tensor) -> AffineViews:
    return centred_views(measured[..., :2], measured[..., 2].detach(), share)


def checked_views(
    x: Tensor, rows: Tensor, weights: Tensor | None, share: Tensor | None
) -> tuple[tuple[int, ...], AffineViews, Tensor]:
    """Batch, flat centred views and flat rows."""
    if x.ndim < 3 or x.shape[-1] != 2 or not x.is_floating_point():
        raise ValueError(f"x must be floating point (*batch, views, n, 2), got {tuple(x.shape)} {x.dtype}")
    if x.shape[-2] < 5:
        raise ValueError(f"x needs at least 5 points, four of which an affine camera takes anywhere, got {x.shape[-2]}")
    batch, (count, n) = tuple(x.shape[:-3]), x.shape[-3:-1]
    if rows.ndim < 2 or rows.shape[-2] != count:
        raise ValueError(f"rows must be (*batch, views, B) for {count} views, got {tuple(rows.shape)}")
    flat = prod(batch)
    wide = rows.double().expand(*batch, *rows.shape[-2:]).reshape(flat, count, rows.shape[-1])
    known = wide.isfinite().all(-1)
    part = known.double() if share is None else torch.where(known, share.double().expand(*batch, count).reshape(flat, count), 0.0)
    weight = None if weights is None else weights.double().expand(*batch, count, n).reshape(flat, count, n)
    check_weights(weight, "a point")
    views = centred_views(x.double().reshape(flat, count, n, 2), weight, part)
    wide = torch.where(known[..., None], wide, 0.0)
    # shapes have no size: in the unit of the largest function no product of three leaves the range
    largest = wide.abs().flatten(1).amax(-1)[:, None, None] if wide.numel() else wide.new_ones(())
    return batch, views, wide / torch.where(largest > 0, largest, 1.0)


def _is_underdetermined(views: AffineViews, rows: Tensor) -> Tensor:
    """Whether the views hold fewer conditions than the shapes have parameters."""
    return _spare(views, rows) < 0


def _spare(views: AffineViews, rows: Tensor) -> Tensor:
    """Conditions beyond those that determine the shapes ``(b,)``."""
    seen = ((views.weights > 0).sum(-1) - 4).clamp(min=0) * (views.share > 0)
    return 2 * seen.sum(-1) - (3 * rows.shape[-1] * (views.x.shape[-2] - 1) - GAUGE)


def _fit_from_starts(views: AffineViews, rows: Tensor, iterations: int) -> tuple[Tensor, Tensor]:
    """Shapes and cost of the best of all starts."""
    filled = complete(views)
    made = [make(filled, rows, views.share) for make in (graph_start, window_start)]
    made += [pooled_start(filled, rows, views.share), _incremental_start(views, filled, rows)]
    starts = [torch.where(start.isfinite(), start, 0.0) for start in made if start is not None]
    shapes, cost = descend(views.repeat(len(starts)), rows.repeat(len(starts), 1, 1), torch.cat(starts), START_STEPS)
    cost = torch.where(cost.isfinite(), cost, torch.inf).unflatten(0, (len(starts), -1))
    best = cost.argmin(0)
    chosen = shapes.unflatten(0, (len(starts), -1))[best, torch.arange(len(best), device=best.device)]
    return descend(views, rows, chosen, max(0, iterations - START_STEPS))


def _incremental_start(views: AffineViews, filled: Tensor, rows: Tensor) -> Tensor:
    """Shapes ``(b, B, n, 3)`` that start at rest and are given one function of the time after the other."""
    shapes = leading(filled, views.share)[:, None]
    for size in range(2, rows.shape[-1] + 1):
        wider = torch.nn.functional.pad(shapes, (0, 0, 0, 0, 0, 1))
        shapes, _ = descend(views, rows[..., :size], wider, STEPS_PER_FUNCTION)
    return shapes


def _uncertainty(views: AffineViews, rows: Tensor, shapes: Tensor, cost: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Expected relative error, noise, and whether another shape explains the views as well, exactly; ``(b,)`` each."""
    open_ = GAUGE + 3 * rows.shape[-1]  # affine frame, and a translation of every basis function
    rest = _eigenvalues(views, rows, shapes)[..., open_:]
    spare = _spare(views, rows)
    share = views.share.sum(-1) / (views.share > 0).sum(-1).clamp(min=1)
    variance = cost / (spare.clamp(min=1) * torch.where(share > 0, share, 1.0))
    inverse = (share[:, None] / rest.clamp(min=torch.finfo(rest.dtype).tiny)).sum(-1)
    # the weights of the views do not move the null space: none of them may be large because its shape is nearly flat
    size = project(views.x, views.weights, shapes_at(shapes, rows)).cameras.square().sum((-2, -1))
    even = _eigenvalues(replace(views, share=views.share / torch.where(size > 0, size, 1.0)), rows, shapes)
    free = (even[..., open_] <= FREE_EIGENVALUE * even[..., -1]) & (variance < EXACT_NOISE**2)
    return torch.where(free, torch.inf, (variance * inverse / 3).sqrt()), variance.sqrt(), free


def _eigenvalues(views: AffineViews, rows: Tensor, shapes: Tensor) -> Tensor:
    """Of the normal matrix, ascending ``(b, 3 n B)``."""
    matrix = ShapeDescent(views, rows).normal_equations(shapes.flatten(1))[2]
    return eigenvalues(matrix)
