"""How far matches are from a tensor: algebraic and Sampson residuals, one implementation for all invariants."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from dyntorch.core.invariant import Invariant, as_invariant
from dyntorch.core.matches import check_plain, check_views
from dyntorch.numerics.arguments import FARTHEST
from dyntorch.numerics.blocks import select
from dyntorch.numerics.function_transforms import is_transformed, over_problems
from dyntorch.numerics.least_squares import by_match, flatten_parts, parts_of

SINGULAR = 1e-14  # squared gradient, in normalized units, added where value and gradient vanish together (static points)
LETTERS = "abcdefghijkl"


def algebraic(invariant: Invariant | type[Invariant], tensor: Tensor, *views: Tensor, **given: Tensor) -> Tensor:
    r"""Algebraic residual :math:`T(u_1, u_2, \dots)` of each match, with points as (x, 1) and hyperplanes with unit normals.

    Args:
        invariant: one whose matches give one row each.
        tensor: ``(*batch, *axes)``.
        *views: matches, ``(*batch, n, ...)`` each.
        **given: what else the invariant takes.

    Returns:
        ``(*batch, n)``, infinite where a coordinate is missing (NaN or infinite).

    Raises:
        ValueError: an invariant whose matches give several rows, or of several tensors; shapes, dtypes or devices that do not
            fit.

    Example:
        >>> import torch, dyntorch as dyn
        >>> F = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # pure translation along x: y2 = y1
        >>> algebraic(dyn.FundamentalMatrix, F, torch.tensor([[0.0, 1.0]]), torch.tensor([[5.0, 3.0]])).tolist()
        [-2.0]
    """
    invariant, views = as_invariant(invariant).bind_arguments(views, **given)
    _check(invariant, tensor, views)
    if invariant.nullity > 1 or invariant.copies is not None:
        raise ValueError(f"the tensors of {invariant!r} do not stand alone: a match has no single algebraic residual; use sampson")
    views, missing = _mask_missing(invariant, views)
    return _infinite(_form(invariant, tensor, views)[0], missing)


def sampson(invariant: Invariant | type[Invariant], tensor: Tensor, *views: Tensor, **given: Tensor) -> Tensor:
    r"""Sampson distance of each match: to first order, how far its measurements must move to fulfil the invariant.

    For one condition :math:`h = T(u_1, u_2, \dots)`,

    .. math:: d = |h| \Big/ \sqrt{\textstyle\sum_v \|\partial h / \partial x_v\|^2};

    for several conditions e (3D points on a line, constant velocity) :math:`d^2 = e^T (J J^T)^{-1} e` with the motion that the
    tensor decomposes into.  With noise of standard deviation s in every coordinate, :math:`d^2 / s^2` follows
    :math:`\chi^2` with ``invariant.codim`` degrees of freedom.

    Args:
        invariant: an invariant class, or an instance of a parametric family.
        tensor: ``(*batch, *axes)``.
        *views: matches, ``(*batch, n, ...)`` each.
        **given: what else the invariant takes.

    Returns:
        ``(*batch, n)`` distances, not negative, in the unit of the measurements; infinite where a coordinate is missing (NaN or
        infinite) or the tensor belongs to no motion.

    Raises:
        ValueError: shapes, dtypes or devices that do not fit.

    Source: Sampson 1982; Hartley and Zisserman, section 11.4.

    Example:
        >>> import torch, dyntorch as dyn
        >>> F = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
        >>> round(float(sampson(dyn.FundamentalMatrix, F, torch.tensor([[0.0, 1.0]]), torch.tensor([[5.0, 3.0]]))), 4)
        1.4142
    """
    invariant, views = as_invariant(invariant).bind_arguments(views, **given)
    _check(invariant, tensor, views)
    views, missing = _mask_missing(invariant, views)
    ones = (torch.ones((), dtype=tensor.dtype, device=tensor.device),) * len(views)
    if invariant.single():
        return _infinite(multilinear(invariant, tensor, views, ones).abs(), missing)
    if not is_transformed(tensor, views):
        return _infinite(distance(invariant, invariant.motion_of(tensor), views, ones), missing)
    check_plain(invariant)
    return _infinite(_distance_by_problem(invariant, tensor, views, missing.shape[:-1]), missing)


def _distance_by_problem(invariant: Invariant, tensor: Tensor, views: Sequence[Tensor], batch: torch.Size) -> Tensor:
    """Distances ``(*batch, n)`` within ``torch.func``: how a tensor decomposes is decided by its values."""
    axes = len(invariant.shape()) + (invariant.nullity > 1) + (invariant.copies is not None)
    full_batch = torch.broadcast_shapes(batch, tensor.shape[: tensor.ndim - axes])
    places = [p.match_axis(x) for p, x in zip(invariant.primitives, views, strict=True)]
    flat = [_flat(x, full_batch, place) for x, place in zip(views, places, strict=True)]

    def distance_of(tensor: Tensor, views: tuple[Tensor, ...]) -> Tensor:
        ones = (torch.ones((), dtype=tensor.dtype, device=tensor.device),) * len(views)
        return distance(invariant, invariant.motion_of(tensor), views, ones)

    result = over_problems(distance_of, _flat(tensor, full_batch, tensor.ndim - axes), tuple(flat))
    return result.reshape(*full_batch, views[0].shape[places[0]])


def _flat(x: Tensor, batch: torch.Size, leading: int) -> Tensor:
    """A tensor with so many leading dimensions, in all problems of a batch, which are one dimension."""
    return x.expand(*batch, *x.shape[leading:]).reshape(math.prod(batch), *x.shape[leading:])


def _mask_missing(invariant: Invariant, views: Sequence[Tensor]) -> tuple[tuple[Tensor, ...], Tensor]:
    """The views with 0 for matches that are missing in any of them, and which these are, ``(*batch, n)``."""
    present = [(x.abs() <= FARTHEST).flatten(p.match_axis(x) + 1).all(-1) for p, x in zip(invariant.primitives, views, strict=True)]
    missing = ~torch.stack(present).all(0)
    return tuple(select(~missing, x, 0.0) for x in views), missing


def _infinite(residual: Tensor, missing: Tensor) -> Tensor:
    """The residual, infinite where there is none."""
    return torch.where(missing | residual.isnan(), torch.inf, residual)


def _check(invariant: Invariant, tensor: Tensor, views: Sequence[Tensor]) -> None:
    check_views(invariant, views)
    shape = (invariant.nullity,) * (invariant.nullity > 1) + invariant.shape()
    if not isinstance(tensor, Tensor) or tuple(tensor.shape[-len(shape) :]) != shape:
        given = tuple(tensor.shape) if isinstance(tensor, Tensor) else type(tensor).__name__
        raise ValueError(f"tensor of {invariant!r} must be (*batch, {', '.join(map(str, shape))}), got {given}")
    if (tensor.dtype, tensor.device) != (views[0].dtype, views[0].device):
        raise ValueError(
            f"tensor is {tensor.dtype} on {tensor.device}, the views {views[0].dtype} on {views[0].device}; use .to(views[0])"
        )


def distance(invariant: Invariant, motion: tuple[Tensor, ...], views: Sequence[Tensor], scales: tuple[Tensor, ...]) -> Tensor:
    """Sampson distance ``(*batch, n)`` from the motion, in standard deviations of noise ``scales``; see :func:`sampson`."""
    return whitened_residual(invariant, motion, views, scales).norm(dim=-1)


def whitened_residual(
    invariant: Invariant, motion: tuple[Tensor, ...], views: Sequence[Tensor], scales: tuple[Tensor, ...]
) -> Tensor:
    """Whitened residual ``(*batch, n, c)`` of matches that may move: the invariant's own, or that of its multilinear form."""
    own = invariant.whitened_residual(motion, tuple(views), scales)
    return own if own is not None else multilinear(invariant, invariant.compose(*motion), views, scales)[..., None]


def residual_derivative(
    residual: Callable[[tuple[Tensor, ...], tuple[Tensor, ...], tuple[Tensor, ...]], Tensor],
    motion: tuple[Tensor, ...],
    views: tuple[Tensor, ...],
    scales: tuple[Tensor, ...],
) -> tuple[Tensor, Tensor]:
    """A residual of motion, views and scales, flat ``(b, n c)``, and its derivative ``(b, p, n c)`` by the motion."""
    shapes = [part.shape[1:] for part in motion]

    def of_copies(theta: Tensor, scales: tuple[Tensor, ...], single: tuple[Tensor, ...]) -> Tensor:
        return residual(parts_of(theta, shapes), single, scales)

    return by_match(of_copies, flatten_parts(motion), scales, views)


def multilinear(invariant: Invariant, tensor: Tensor, views: Sequence[Tensor], scales: tuple[Tensor, ...]) -> Tensor:
    """Signed Sampson residual ``(*batch, n)`` of a form with one row per match; ``scales (*batch,)`` as in ``whitened``."""
    value, _, square = _sampson_terms(invariant, tensor, views, scales)
    return value * square.rsqrt()


def multilinear_derivative(
    invariant: Invariant, tensor: Tensor, views: Sequence[Tensor], scales: tuple[Tensor, ...]
) -> tuple[Tensor, Tensor]:
    r"""Signed Sampson residual ``(*batch, n)`` and its derivative ``(*batch, n, D)`` by the entries of the tensor."""
    value, slopes, square = _sampson_terms(invariant, tensor, views, scales)
    vectors = [p.raw(x) for p, x in zip(invariant.primitives, views, strict=True)]
    share = (value / square)[..., None]
    root = square.rsqrt()
    order = [int(v) for v in invariant.axes()]
    # products of the vectors in front of a slot, and of those with one slot replaced, extended slot by slot
    plain, changed = root[..., None], torch.zeros_like(root)[..., None]
    for v in order:
        primitive, x, scale = invariant.primitives[v], views[v], scales[v][..., None, None]
        bent = primitive.pushforward(x, slopes[v] * scale) * share
        changed = _outer(changed, vectors[v]) + _outer(plain, bent)
        plain = _outer(plain, vectors[v])
    return value * root, plain - changed


def _outer(rows: Tensor, vectors: Tensor) -> Tensor:
    return (rows[..., :, None] * vectors[..., None, :]).flatten(-2)


def _sampson_terms(
    invariant: Invariant, tensor: Tensor, views: Sequence[Tensor], scales: tuple[Tensor, ...]
) -> tuple[Tensor, list[Tensor], Tensor]:
    """Value of the form, its derivatives by the measurements in standard deviations, and their total square."""
    value, gradients = _form(invariant, tensor, views)
    square = torch.full_like(value, SINGULAR) * tensor.detach().square().flatten(-len(invariant.shape())).sum(-1)[..., None]
    slopes = []
    for primitive, x, gradient, scale in zip(invariant.primitives, views, gradients, scales, strict=True):
        slopes.append(scale[..., None, None] * primitive.pullback(x, gradient))
        square = square + slopes[-1].square().sum(-1)
    return value, slopes, square.clamp(min=torch.finfo(value.dtype).tiny)


def _form(invariant: Invariant, tensor: Tensor, views: Sequence[Tensor]) -> tuple[Tensor, list[Tensor]]:
    """The multilinear form at each match, and its derivative with respect to the vector of every view."""
    if invariant.rows() != 1 or invariant.intrinsic:
        raise ValueError(f"a match of {invariant!r} gives {invariant.rows()} rows; it has no single algebraic residual")
    vectors = [p.raw(x) for p, x in zip(invariant.primitives, views, strict=True)]
    letters = [LETTERS[v] for v in range(len(views))]
    axes = "".join(letters[v] for v in invariant.axes())
    gradients = []
    for v, letter in enumerate(letters):
        others = [u for u in range(len(views)) if u != v]
        terms = ",".join(f"...n{letters[u]}" for u in others)
        gradients.append(torch.einsum(f"...{axes},{terms}->...n{letter}", tensor, *(vectors[u] for u in others)))
    return (gradients[0] * vectors[0]).sum(-1), gradients


def whiten(error: Tensor, covariance: Tensor) -> Tensor:
    r"""Solve :math:`L w = e` with the Cholesky factor :math:`L L^T = Q` of each small covariance. error ``(..., c)``,
    covariance ``(..., c, c)`` -> ``(..., c)``."""
    entries = [[covariance[..., i, j] for j in range(i + 1)] for i in range(error.shape[-1])]
    return torch.stack(whiten_entries(error.unbind(-1), entries), dim=-1)


def whiten_entries(error: Sequence[Tensor], covariance: Sequence[Sequence[Tensor | float]]) -> list[Tensor]:
    """:func:`whiten` of c components, given the lower triangle of the covariance entry by entry (0.0 where it is zero)."""
    tiny = torch.finfo(error[0].dtype).eps ** 2
    factor: list[list[Tensor]] = []  # rows of the Cholesky factor, with the inverse on the diagonal
    solved: list[Tensor] = []
    for i, value in enumerate(error):
        row: list[Tensor] = []
        for j in range(i):
            inner = covariance[i][j]
            for k in range(j):
                inner = inner - row[k] * factor[j][k]
            row.append(inner * factor[j][j])
        pivot = torch.as_tensor(covariance[i][i])
        for k in range(i):
            pivot, value = pivot - row[k].square(), value - row[k] * solved[k]
        row.append(pivot.clamp(min=tiny).rsqrt())
        factor.append(row)
        solved.append(value * row[i])
    return solved
