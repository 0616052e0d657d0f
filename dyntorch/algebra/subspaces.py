"""Subspaces spanned by the columns of tall matrices, and the largest correlation between two of them, for all pairs at once."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.arguments import check_tensor, check_together
from dyntorch.blocks import one_thread

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
        first: ``(m, rows, 2)`` orthonormal bases.
        second: ``(k, rows, 2)`` orthonormal bases.
        shared: 1 for :math:`s_1`; 2 for :math:`\sqrt{(s_1^2 + s_2^2) / 2}`, which asks the planes to coincide.

    Returns:
        ``(m, k)`` in [0, 1]; the product is one GEMM.  What is not finite counts as 0.

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
    if first.ndim != 3 or second.ndim != 3 or first.shape[-1] != 2 or second.shape[-1] != 2 or first.shape[1] != second.shape[1]:
        raise ValueError(f"expected bases (m, rows, 2) and (k, rows, 2), got {tuple(first.shape)} and {tuple(second.shape)}")
    check_together(first=(first, 3), second=(second, 3))
    # planes of coordinates, so that the four entries of every product are contiguous (m, k) matrices
    left, right = (
        torch.nan_to_num(basis).clamp(-1.0, 1.0).permute(order) for basis, order in ((first, (2, 0, 1)), (second, (2, 1, 0)))
    )
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
