r"""Points from their images and projections from points, for any :math:`P^k \to P^l`: linear, each up to scale."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from dyntorch.geometry.homogeneous import finite_depth, inhomogeneous
from dyntorch.numerics.arguments import check_tensor, check_together, check_weights
from dyntorch.numerics.blocks import one_thread
from dyntorch.numerics.nullspace import gram_null_space


def reproject(projections: Tensor, structure: Tensor) -> Tensor:
    r"""Images of points: :math:`x_{ij} = \pi(M_i Y_j)`.

    Args:
        projections: ``(*batch, views, l + 1, k + 1)`` of any scale.
        structure: ``(*batch, n, k + 1)`` homogeneous points of any scale.

    Returns:
        ``(*batch, views, n, l)``; images at infinity as in :func:`~dyntorch.geometry.homogeneous.inhomogeneous`; the zero point
        and one that is not finite, or seen by a projection that is not, give 0.

    Raises:
        ValueError: projections of another width than the points have coordinates, dtypes, devices or batches that do not agree.

    Example:
        >>> import torch
        >>> reproject(torch.eye(3)[None], torch.tensor([[4.0, 6.0, 2.0]])).tolist()
        [[[2.0, 3.0]]]
    """
    _check_width("projections", projections, structure)
    check_together(projections=(projections, 3), structure=(structure, 2))
    image = inhomogeneous(_rescale(structure, 1)[..., None, :, :] @ _rescale(projections, 2).mT)
    return torch.where(image.isfinite(), image, 0.0)


def _rescale(values: Tensor, last: int) -> Tensor:
    """Homogeneous quantities in the last dimensions with their largest entry 1 where it is extreme; 0 where one is not finite."""
    axes = tuple(range(-last, 0))
    if not values.shape[-last:].numel():
        return values
    largest = values.detach().abs().amax(axes, keepdim=True)
    extreme = (largest > 1e60) | (largest < 1e-60)
    values = torch.where(largest.isfinite(), values, 0.0)
    return torch.where(extreme & (largest > 0) & largest.isfinite(), values / torch.where(largest > 0, largest, 1.0), values)


def unit_projections(projections: Tensor) -> Tensor:
    """Projections ``(..., l + 1, k + 1)`` of Frobenius norm 1; zero ones stay zero."""
    norm = projections.flatten(-2).norm(dim=-1)[..., None, None]
    return projections / norm.clamp(min=torch.finfo(projections.dtype).tiny)


@one_thread
def triangulate(projections: Tensor, x: Tensor, weights: Tensor | None = None, *, steps: int = 0) -> Tensor:
    r"""Points seen by known projections: the null vector of the equations :math:`[I \mid -x_{ij}]\, M_i Y_j = 0` of all views.

    With ``steps`` the reprojection error :math:`\sum_i w_{ij} |x_{ij} - \pi(M_i Y_j)|^2` is minimized from there on.

    Args:
        projections: ``(*batch, views, l + 1, k + 1)`` of any scale.
        x: ``(*batch, views, n, l)`` images, best of order 1 (normalized); NaN where a point is missing.
        weights: ``(*batch, views, n)``, 0 = missing.
        steps: Gauss-Newton steps on the reprojection error; a step that would raise it is left out.

    Returns:
        ``(*batch, n, k + 1)`` of norm 1 in the dtype of ``x``, differentiable.  Zero where the images do not determine the
        point: fewer than k equations, or a larger null space (centres that meet in more than a point).

    Raises:
        ValueError: shapes that do not fit each other.

    Source: Hartley and Zisserman, chapter 12; Hartley and Schaffalitzky 2004 for any k and l.

    Example:
        >>> import torch
        >>> M = torch.rand(3, 3, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> Y = torch.tensor([[1.0, 2.0, 1.0, 0.5, -1.0]], dtype=torch.float64)
        >>> found = triangulate(M, reproject(M, Y))[0]
        >>> (found / found[2]).round(decimals=6).tolist()
        [1.0, 2.0, 1.0, 0.5, -1.0]
    """
    x, weights, dtype = *mask_missing(x, weights), x.dtype
    rows, width = _check_views(projections, x)
    check_together(projections=(projections.to(x.dtype), 3), x=(x, 3))
    sound = projections.isfinite().flatten(-2).all(-1)[..., None]
    flat = torch.where(sound, projections.to(x.dtype).flatten(-2), 0.0)
    matrices = normalize(flat, dim=-1).unflatten(-1, (rows, width))[..., None, :, :]
    weights = weights * sound
    equations = (matrices[..., :-1, :] - x[..., None] * matrices[..., -1:, :]) * _root(weights)[..., None, None]
    equations = equations.movedim(-4, -3).flatten(-3, -2)
    found = gram_null_space(equations.mT @ equations)
    known = ((weights > 0).sum(-2) * (rows - 1) >= width - 1) & ~found.degenerate
    structure = torch.where(known[..., None], found.basis[..., 0, :], 0.0)
    for _ in range(steps):
        structure = _gauss_newton(structure, matrices, x, weights * known[..., None, :])
    return structure.to(dtype)


@one_thread
def resect(structure: Tensor, x: Tensor, weights: Tensor | None = None, *, lifts: Tensor | None = None) -> Tensor:
    r"""Projections of known points: per view the null vector of the equations :math:`[I \mid -x_{ij}]\, M_i Y_j = 0` of all points.

    With lifts :math:`B_i` the unknown is :math:`P_i` in :math:`M_i = P_i B_i`: resection from the points :math:`B_i Y_j`.

    Args:
        structure: ``(*batch, n, k + 1)`` homogeneous points; a zero point is not counted.
        x: ``(*batch, views, n, l)`` images, best of order 1 (normalized); NaN where a point is missing.
        weights: ``(*batch, views, n)``, 0 = missing.
        lifts: ``(views, a + 1, k + 1)`` or ``(*batch, views, a + 1, k + 1)``; default: the identity.

    Returns:
        ``(*batch, views, l + 1, k + 1)``, with lifts ``(*batch, views, l + 1, a + 1)``, of norm 1, differentiable.  Zero where
        the points do not determine the projection: too few, or in special position.

    Raises:
        ValueError: shapes that do not fit each other.

    Source: Hartley and Zisserman, section 7.1, for any k and l.

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> M, Y = torch.rand(1, 3, 4, generator=g).double(), torch.rand(6, 4, generator=g).double()
        >>> found = resect(Y, reproject(M, Y))
        >>> bool(torch.allclose(found * M.norm() * torch.sign(found[0, 0, 0]), M))
        True
    """
    x, weights, dtype = *mask_missing(x, weights), x.dtype
    _check_points(structure, x)
    batch = check_together(structure=(structure.to(x.dtype), 2), x=(x, 3))
    x, weights = x.expand(*batch, *x.shape[-3:]), weights.expand(*batch, *weights.shape[-2:])
    points = normalize(structure.to(x.dtype), dim=-1)[..., None, :, :]
    if lifts is not None:
        _check_width("lifts", lifts, structure)
        points = points @ lifts.to(x.dtype).mT
    points, width = points.expand((*x.shape[:-1], points.shape[-1])), points.shape[-1]
    seen = (weights > 0) & points.isfinite().all(-1) & (points != 0).any(-1)
    points, weight = torch.where(seen[..., None], points, 0.0), torch.where(seen, weights, 0.0)[..., None]
    # the Gram consists of the second moments of the points with three kinds of weights: w, -w x and w |x|^2
    factors = torch.cat([weight, -weight * x, weight * x.square().sum(-1, keepdim=True)], dim=-1)
    moments = factors.mT @ (points[..., :, None] * points[..., None, :]).flatten(-2)
    moments = moments.unflatten(-1, (width, width))
    plain, mixed, last = moments[..., :1, :, :], moments[..., 1:-1, :, :], moments[..., -1:, :, :]
    size = x.shape[-1]
    head = torch.eye(size, dtype=x.dtype, device=x.device)[..., None, None] * plain[..., None, :, :]
    blocks = torch.cat([torch.cat([head, mixed[..., None, :, :]], -3), torch.cat([mixed, last], -3)[..., None, :, :, :]], -4)
    found = gram_null_space(blocks.transpose(-3, -2).flatten(-4, -3).flatten(-2))
    known = (seen.sum(-1) * size >= (size + 1) * width - 1) & ~found.degenerate
    return torch.where(known[..., None, None], found.basis[..., 0, :].unflatten(-1, (size + 1, width)), 0.0).to(dtype)


def mask_missing(x: Tensor, weights: Tensor | None) -> tuple[Tensor, Tensor]:
    """Images and weights in float64, with 0 for both where an image is missing. x ``(*batch, views, n, l)``, weights
    ``(*batch, views, n)``."""
    check_tensor("x", x, "views", "n", "l")
    if weights is not None and not isinstance(weights, Tensor):
        raise ValueError(f"weights must be a torch.Tensor, got {type(weights).__name__}; use torch.as_tensor(...)")
    if weights is not None and weights.shape != x.shape[:-1]:
        raise ValueError(f"weights must be (*batch, views, n) = {tuple(x.shape[:-1])}, got {tuple(weights.shape)}")
    check_weights(weights, "an image")
    x = x.double()
    w = torch.ones_like(x[..., 0]) if weights is None else weights.to(x)
    seen = x.isfinite().all(-1) & (w > 0)
    return torch.where(seen[..., None], x, 0.0), torch.where(seen, w, 0.0)


def _root(weights: Tensor) -> Tensor:
    """Square roots of weights, with the gradient 0 at 0."""
    return torch.where(weights > 0, torch.where(weights > 0, weights, 1.0).sqrt(), 0.0)


def _gauss_newton(structure: Tensor, matrices: Tensor, x: Tensor, weights: Tensor) -> Tensor:
    """One step of every point on its reprojection error; where that would rise, the point as it was."""
    root = _root(weights)[..., None]

    def errors(points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        image = (matrices @ points[..., None, :, :, None])[..., 0]
        depth = torch.where(root > 0, finite_depth(image), 1.0)
        y = image[..., :-1] / depth
        error = (y - x) * root
        return y, depth, error, error.square().sum((-1, -3))

    y, depth, error, cost = errors(structure)
    derivative = (matrices[..., :-1, :] - y[..., None] * matrices[..., -1:, :]) * (root / depth)[..., None]
    derivative = derivative.movedim(-4, -3).flatten(-3, -2)
    normal = derivative.mT @ derivative
    trace = normal.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    # the scale of the point is free: the step stays orthogonal to it; points that nobody sees get an equation of their own
    held = torch.eye(structure.shape[-1], dtype=x.dtype, device=x.device) * torch.where(trace > 0, 1e-14 * trace, 1.0)
    factor, _ = torch.linalg.cholesky_ex(normal + trace * structure[..., :, None] * structure[..., None, :] + held)
    step = torch.cholesky_solve(derivative.mT @ error.movedim(-3, -2).flatten(-2)[..., None], factor)[..., 0]
    trial = normalize(structure - torch.where(step.isfinite(), step, 0.0), dim=-1)
    return torch.where((errors(trial)[3] < cost)[..., None], trial, structure)


def _check_width(name: str, matrices: Tensor, structure: Tensor) -> None:
    check_tensor(name, matrices, "views", "rows", "k + 1")
    check_tensor("structure", structure, "n", "k + 1")
    if not structure.shape[-1] or not matrices.shape[-2] or matrices.shape[-1] != structure.shape[-1]:
        raise ValueError(
            f"{name} must be (*batch, views, rows, k + 1) for structure (*batch, n, k + 1), "
            f"got {tuple(matrices.shape)} for {tuple(structure.shape)}"
        )


def _check_views(projections: Tensor, x: Tensor) -> tuple[int, int]:
    check_tensor("projections", projections, "views", "l + 1", "k + 1")
    views, rows = x.shape[-3], x.shape[-1] + 1
    if projections.shape[-3:-1] != (views, rows):
        raise ValueError(
            f"projections must be (*batch, {views}, {rows}, k + 1) for x {tuple(x.shape)}, got {tuple(projections.shape)}"
        )
    return rows, projections.shape[-1]


def _check_points(structure: Tensor, x: Tensor) -> None:
    check_tensor("structure", structure, "n", "k + 1")
    if structure.shape[-2] != x.shape[-2]:
        raise ValueError(
            f"structure must be (*batch, n, k + 1) with n = {x.shape[-2]} points as in x {tuple(x.shape)}, "
            f"got {tuple(structure.shape)}"
        )
