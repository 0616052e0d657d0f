"""Subspaces spanned by the columns of tall matrices, and the largest correlation between two of them, for all pairs at once."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.numerics.arguments import check_tensor, check_together
from dyntorch.numerics.blocks import one_thread
from dyntorch.numerics.nullspace import eigh

RIDGE = 1e-6  # of the squared norm: a flat direction gets a harmless basis vector instead of amplified noise


@one_thread
def orthonormal_basis(matrix: Tensor) -> Tensor:
    r"""Orthonormal basis of each column space: :math:`U = X L^{-T}` with :math:`L L^T = X^T X + \epsilon \|X\|^2 I`.

    A Cholesky factor of the small Gram replaces the SVD of the tall matrix.  A direction far below the norm of the matrix
    (squared ratio under 1e-6) comes out short instead of unit length, and a zero matrix gives a zero basis: never NaN.

    Args:
        matrix: ``(*batch, rows, columns)`` with few columns.

    Returns:
        ``(*batch, rows, columns)``; zero where a matrix holds a number that is not finite.

    Raises:
        ValueError: no floating point tensor of that shape, or one of half precision.

    Example:
        >>> import torch
        >>> u = orthonormal_basis(torch.tensor([[3.0, 1.0], [0.0, 2.0], [0.0, 0.0]], dtype=torch.float64))
        >>> bool(torch.allclose(u.mT @ u, torch.eye(2, dtype=torch.float64), atol=1e-5))
        True
    """
    check_tensor("matrix", matrix, "rows", "columns")
    # the unit is that of the largest entry: no square of it leaves the range
    largest = matrix.detach().abs().amax((-2, -1), keepdim=True) if matrix.shape[-2:].numel() else matrix.new_ones(1, 1)
    usable = largest.isfinite()
    matrix = torch.where(usable, matrix, 0.0) / torch.where(usable & (largest > 0), largest, 1.0)
    gram = matrix.mT @ matrix
    energy = gram.diagonal(dim1=-2, dim2=-1).sum(-1)
    # normalizing first keeps the ridge meaningful for any unit of the data
    scale = energy.clamp(min=torch.finfo(matrix.dtype).tiny).rsqrt()[..., None, None]
    eye = torch.eye(gram.shape[-1], dtype=matrix.dtype, device=matrix.device)
    factor, _ = torch.linalg.cholesky_ex(gram * scale**2 + RIDGE * eye)
    # inverting the small factor and one product is twice as fast as solving for every row
    inverse = torch.linalg.solve_triangular(factor, eye.expand_as(factor), upper=False)
    return matrix @ (inverse * scale).mT


@one_thread
def canonical_correlation(first: Tensor, second: Tensor, *, shared: int = 1) -> Tensor:
    r"""Correlation between the planes of all pairs: large where they share a direction (``shared=1``) or coincide (``2``).

    For two views of one rigid space-time shape by affine cameras the four coordinate rows obey one linear relation (the
    affine epipolar constraint), so the two planes share a direction and the largest canonical correlation
    :math:`s_1 = \sigma_1(U^T V)` is 1.  In closed form, with :math:`C = U^T V` of size 2x2,

    .. math:: s_{1,2}^2 = \tfrac12 \left(\|C\|^2 \pm \sqrt{\|C\|^4 - 4 \det(C)^2}\right).

    Args:
        first: ``(*batch, m, rows, 2)`` orthonormal bases.
        second: ``(*batch, k, rows, 2)`` orthonormal bases; batches broadcast.
        shared: 1 for :math:`s_1`; 2 for :math:`\sqrt{(s_1^2 + s_2^2) / 2}`, which asks the planes to coincide.

    Returns:
        ``(*batch, m, k)`` in [0, 1]; the product is one GEMM, batched.  What is not finite counts as 0.

    Raises:
        ValueError: bases that are not planes, of different lengths, or another ``shared``.

    Source: Tomasi-Kanade rank constraint; thesis chapter 7 (the rank of stacked measurements).

    Example:
        >>> import torch
        >>> u = torch.eye(3)[None, :, :2]
        >>> v = torch.eye(3)[None, :, 1:]
        >>> round(float(canonical_correlation(u, v)), 3), round(float(canonical_correlation(u, v, shared=2)), 3)
        (1.0, 0.707)
    """
    check_tensor("first", first)
    check_tensor("second", second)
    flat = first.ndim < 3 or second.ndim < 3
    if flat or first.shape[-1] != 2 or second.shape[-1] != 2 or first.shape[-2] != second.shape[-2]:
        shapes = f"{tuple(first.shape)} and {tuple(second.shape)}"
        raise ValueError(f"expected bases (*batch, m, rows, 2) and (*batch, k, rows, 2), got {shapes}")
    check_together(first=(first, 3), second=(second, 3))
    # planes of coordinates, so that the four entries of every product are contiguous (m, k) matrices
    left, right = (torch.nan_to_num(basis).clamp(-1.0, 1.0).movedim(-1, 0) for basis in (first, second))
    right = right.mT
    c00, c01, c10, c11 = (left[i] @ right[j] for i in (0, 1) for j in (0, 1))
    norm = c00.square().addcmul_(c01, c01).addcmul_(c10, c10).addcmul_(c11, c11)
    if shared == 2:
        return norm.mul_(0.5).clamp_(max=1.0).sqrt_()
    if shared != 1:
        raise ValueError(f"shared must be 1 or 2, got {shared!r}")
    det = c00.mul_(c11).addcmul_(c01, c10, value=-1.0)
    # ||C||^4 - 4 det^2 factors, which keeps it from cancelling where s1 = s2
    root = (norm - 2 * det).clamp_(min=0.0).mul_((norm + 2 * det).clamp_(min=0.0)).sqrt_()
    return norm.add_(root).mul_(0.5).clamp_(max=1.0).sqrt_()


# ----------------------------------------------------------------------------------------------------------------------
# Shape from several synchronized affine views: the Tomasi-Kanade factorization and its metric upgrade.


@one_thread
def affine_factorization(views: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    r"""Best rank-3 fit of centred affine views: :math:`x_v - \bar x_v \approx X A_v`.

    Args:
        views: ``(*batch, views, points, 2)``, at least two views of the same points, no NaN.

    Returns:
        shape ``(*batch, points, 3)`` with orthogonal columns, cameras ``(*batch, views, 3, 2)`` and the part of the energy
        that the fit leaves unexplained ``(*batch,)``, from 0 (exact) to 1.

    Raises:
        ValueError: fewer than two views or three points, or coordinates that are not finite.

    Source: Tomasi and Kanade 1992.
    """
    check_tensor("views", views, "views", "points", 2)
    if views.shape[-3] < 2 or min(views.shape[-2], 2 * views.shape[-3]) < 3:
        raise ValueError(f"views must be (*batch, views >= 2, points >= 3, 2), got {tuple(views.shape)}")
    if not bool(views.isfinite().all()):
        raise ValueError("views hold coordinates that are NaN or infinite; leave those points out, or fill them in")
    largest = views.double().abs().amax((-3, -2, -1))[..., None, None]  # no square leaves the range
    scaled = views.double() / torch.where(largest > 0, largest, 1.0)[..., None]
    centred = scaled - scaled.mean(dim=-2, keepdim=True)
    count, points = views.shape[-3], views.shape[-2]
    stacked = centred.movedim(-3, -2).reshape(*views.shape[:-3], points, 2 * count)
    u, s, vt = torch.linalg.svd(stacked, full_matrices=False)
    shape = u[..., :3] * s[..., None, :3] * largest
    cameras = vt[..., :3, :].reshape(*views.shape[:-3], 3, count, 2).movedim(-3, -2)
    energy = s.square().sum(-1)
    left = torch.where(energy > 0, s[..., 3:].square().sum(-1) / energy.clamp(min=1e-300), torch.ones_like(energy))
    return shape.to(views.dtype), cameras.to(views.dtype), left.to(views.dtype)


@one_thread
def metric_upgrade(shape: Tensor, cameras: Tensor) -> tuple[Tensor, Tensor]:
    r"""Turn an affine shape into a metric one for scaled-orthographic cameras, with y along the mean vertical of the images.

    Finds the symmetric :math:`Q = H H^T` with :math:`a_v^T Q b_v = 0` and :math:`a_v^T Q a_v = b_v^T Q b_v` for the two
    columns of every camera; the shape becomes :math:`X H^{-T}`.  The result is defined up to scale, a rotation about the
    vertical and the mirror image :math:`z \to -z`.

    Args:
        shape: ``(points, 3)``; cameras: ``(views, 3, 2)``, at least three views.

    Returns:
        metric shape ``(points, 3)``, and whether the cameras decide it (``False``: Q is not positive definite, or the
        views are too few or too alike; the shape returned is then the affine one, unchanged).
    """
    largest = cameras.double().abs().amax() if cameras.numel() else torch.ones((), device=cameras.device)
    scaled = cameras.double() / torch.where(largest > 0, largest, 1.0)  # no square leaves the range
    a, b = scaled.unbind(-1)
    extent = shape.double().norm(dim=0)
    # a flat shape leaves the third row of the cameras to chance
    if len(cameras) < 3 or not (extent.min() > 1e-6 * extent.max()) & extent.max().isfinite() & largest.isfinite():
        return shape, torch.tensor(False, device=shape.device)
    rows = torch.cat([_quadratic(a, b), _quadratic(a, a) - _quadratic(b, b)])
    _, s, vt = torch.linalg.svd(rows, full_matrices=True)
    q = vt[-1]
    matrix = torch.stack([q[[0, 1, 2]], q[[1, 3, 4]], q[[2, 4, 5]]])
    matrix = matrix * torch.sign(torch.trace(matrix))
    values, vectors = eigh(matrix)
    # one solution only where the fifth singular value stands clear of the noise floor
    if not (values[0] > 1e-3 * values[-1] and s[4] > 1e-3 * s[0]):
        return shape, torch.tensor(False, device=shape.device)
    half = vectors * values.sqrt()
    upright = _vertical(scaled.mT @ half)
    metric = shape.double() @ torch.linalg.inv(half).mT @ upright
    return metric.to(shape.dtype), torch.tensor(True, device=shape.device)


def _quadratic(a: Tensor, b: Tensor) -> Tensor:
    """``(views, 6)`` coefficients of a^T Q b in the entries 00, 01, 02, 11, 12, 22 of the symmetric Q."""
    i, j = torch.triu_indices(3, 3, device=a.device).unbind()
    return torch.where(i == j, a[:, i] * b[:, i], a[:, i] * b[:, j] + a[:, j] * b[:, i])


def _vertical(rotated: Tensor) -> Tensor:
    """``(3, 3)`` rotation (columns x, y, z) whose y is the mean image vertical of the cameras ``(views, 2, 3)``."""
    y = torch.nn.functional.normalize(torch.nn.functional.normalize(rotated[:, 1], dim=-1).mean(0), dim=0)
    x = rotated[0, 0] - (rotated[0, 0] @ y) * y
    x = torch.nn.functional.normalize(x, dim=0)
    return torch.stack([x, y, torch.linalg.cross(x, y)], dim=1)
