r"""Moving shapes from single affine views at known times: the all-joint form, and where in time a new view belongs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import prod

import torch
from torch import Tensor

from dyntorch.algebra.dynamic_shape_descent import Descent, Views, centred_views, descend, framed, project, shapes_at
from dyntorch.algebra.dynamic_shape_linear import complete, graph_start, leading, pooled_start, window_start
from dyntorch.blocks import one_thread
from dyntorch.eigenspace import eigenvalues

GAUGE = 9
"""Parameters of the shapes that no view can tell: a constant affine frame of the world."""
TRIED = 20
"""Steps from every start before the best one goes on.  Measured (16 kinds of 15 scenes: degree 1 and 2, 1 and 2 harmonics, 8 and 14
points, noise 1 and 3 %, 40 views): of 240 scenes 3 go on from a start that does not lead to the least cost of all; of 45 of the
hardest kind (2 harmonics, 8 points, 3 %) 6, and 8 after 10 steps, which take 15 % less time."""
GROWN = 5
"""Steps for each function that is added to the last start.  It leads to the least cost most often where points move by a third of
the extent of their shape (55 of 60 scenes of degree 2 and of 2 harmonics at 1 %, the graph 33), the graph where by all of it."""
AMBIGUOUS = 0.5
"""Expected relative error of the shapes above which other shapes explain the views as well."""
FREE = 4e-12
"""Eigenvalue of the normal matrix with all cameras at norm 1, of the largest, below which its direction is free.  Measured: the
affine frame, which is, 1e-12 (the ridge of the Grams), points in a plane or at rest 1e-16 to 2e-12, five points of degree 2 from
7e-11, eight points of constant velocity from 3e-4."""
EXACT = 1e-6
"""Noise of views of norm 1 below which they are called exact; float32 leaves 1e-8 to 1e-7."""


@dataclass(frozen=True, eq=False)
class MovingShapes:
    """Result of :func:`fit_shapes`.

    Attributes:
        shapes: ``(*batch, B, n, 3)`` the shape :math:`X_b` of every basis function, centroids 0, columns orthonormal over all b.
        noise: ``(*batch,)`` standard deviation of one coordinate of a view, its centred views having Frobenius norm 1.
        residual: ``(*batch, views)`` part of the energy of each view that the shape does not explain, in [0, 1].
        uncertainty: ``(*batch,)`` expected relative error of the shapes from the noise; infinite where they are not determined.
        few: ``(*batch,)`` bool: fewer views than determine the shapes.
        degenerate: ``(*batch,)`` bool: other shapes explain the views exactly as well (planar or resting points, equal times).
    """

    shapes: Tensor
    noise: Tensor
    residual: Tensor
    uncertainty: Tensor
    few: Tensor
    degenerate: Tensor


@one_thread
def fit_shapes(
    x: Tensor, rows: Tensor, weights: Tensor | None = None, *, share: Tensor | None = None, iterations: int = 50
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
            (:class:`~dyntorch.algebra.dynamic_shape_basis.Polynomial`, ``Fourier``).
        weights: ``(*batch, views, n)``, 0 = ignore.
        share: ``(*batch, views)`` weight of whole views.
        iterations: steps of the descent at most.

    Returns:
        :class:`MovingShapes` in the dtype of x; zero shapes where ``few``.

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
    batch, views, times = _checked(x, rows, weights, share)
    few = _few(views, times)
    shapes, cost = _best(views, times, iterations)
    uncertainty, noise, free = _uncertainty(views, times, shapes, cost)
    found = project(views.x, views.weights, shapes_at(shapes, times))
    residual = found.residual.square().sum((-2, -1)).clamp(0, 1)
    none = few[:, None, None, None]
    back = [torch.where(none, 0.0, framed(shapes)), noise, residual, torch.where(few, torch.inf, uncertainty), few, free & ~few]
    done = [part.reshape((*batch, *part.shape[1:])) for part in back]
    return MovingShapes(*(part.to(x.dtype) if part.is_floating_point() else part for part in done))


def _checked(x: Tensor, rows: Tensor, weights: Tensor | None, share: Tensor | None) -> tuple[tuple[int, ...], Views, Tensor]:
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
    if weight is not None and bool((weight < 0).any()):
        raise ValueError(f"weights must not be negative, got {float(weight.min()):g}; use 0 to leave a point out")
    views = centred_views(x.double().reshape(flat, count, n, 2), weight, part)
    wide = torch.where(known[..., None], wide, 0.0)
    # shapes have no size: in the unit of the largest function no product of three leaves the range
    largest = wide.abs().flatten(1).amax(-1)[:, None, None] if wide.numel() else wide.new_ones(())
    return batch, views, wide / torch.where(largest > 0, largest, 1.0)


def _few(views: Views, rows: Tensor) -> Tensor:
    """Whether the views hold fewer conditions than the shapes have parameters."""
    return _spare(views, rows) < 0


def _spare(views: Views, rows: Tensor) -> Tensor:
    """Conditions beyond those that determine the shapes ``(b,)``."""
    seen = ((views.weights > 0).sum(-1) - 4).clamp(min=0) * (views.share > 0)
    return 2 * seen.sum(-1) - (3 * rows.shape[-1] * (views.x.shape[-2] - 1) - GAUGE)


def _best(views: Views, rows: Tensor, iterations: int) -> tuple[Tensor, Tensor]:
    """Shapes and cost of the best of all starts."""
    filled = complete(views)
    made = [make(filled, rows, views.share) for make in (graph_start, window_start, pooled_start)]
    made.append(_grown(views, filled, rows))
    starts = [torch.where(start.isfinite(), start, 0.0) for start in made if start is not None]
    shapes, cost = descend(views.repeated(len(starts)), rows.repeat(len(starts), 1, 1), torch.cat(starts), TRIED)
    cost = torch.where(cost.isfinite(), cost, torch.inf).unflatten(0, (len(starts), -1))
    best = cost.argmin(0)
    chosen = shapes.unflatten(0, (len(starts), -1))[best, torch.arange(len(best), device=best.device)]
    return descend(views, rows, chosen, max(0, iterations - TRIED))


def _grown(views: Views, filled: Tensor, rows: Tensor) -> Tensor:
    """Shapes ``(b, B, n, 3)`` that start at rest and are given one function of the time after the other."""
    shapes = leading(filled, views.share)[:, None]
    for size in range(2, rows.shape[-1] + 1):
        wider = torch.nn.functional.pad(shapes, (0, 0, 0, 0, 0, 1))
        shapes, _ = descend(views, rows[..., :size], wider, GROWN)
    return shapes


def _uncertainty(views: Views, rows: Tensor, shapes: Tensor, cost: Tensor) -> tuple[Tensor, Tensor, Tensor]:
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
    free = (even[..., open_] <= FREE * even[..., -1]) & (variance < EXACT**2)
    return torch.where(free, torch.inf, (variance * inverse / 3).sqrt()), variance.sqrt(), free


def _eigenvalues(views: Views, rows: Tensor, shapes: Tensor) -> Tensor:
    """Of the normal matrix, ascending ``(b, 3 n B)``."""
    matrix = Descent(views, rows).normal_equations(shapes.flatten(1))[2]
    return eigenvalues(matrix)
