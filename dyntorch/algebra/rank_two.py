"""Matrices of rank two and one in closed form: cofactors, null vectors, nearest products of vectors, for many at a time."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.algebra.homogeneous import unit_vectors

SQUARINGS = 5
"""A null vector of a noisy matrix is then exact to (s_3 / s_2)^64: 1e-10 even at s_3 = 0.7 s_2;
the leading vector of a matrix of rank about one to (s_2 / s_1)^64."""


def cofactors(matrix: Tensor) -> Tensor:
    r"""The matrix of cofactors, :math:`\det(M)\, M^{-T}`: how lines map where M maps points.

    It exists for every matrix, so one singular matrix in a batch raises nothing.

    Args:
        matrix: ``(*batch, 3, 3)``.

    Returns:
        ``(*batch, 3, 3)``.

    Raises:
        ValueError: not 3 x 3.

    Example:
        >>> import torch
        >>> cofactors(torch.diag(torch.tensor([2.0, 3.0, 5.0]))).diagonal().tolist()
        [15.0, 10.0, 6.0]
    """
    if matrix.shape[-2:] != (3, 3):
        raise ValueError(f"matrix must be (*batch, 3, 3), got {tuple(matrix.shape)}")
    a, b, c = matrix.unbind(-1)
    cross = torch.linalg.cross
    return torch.stack([cross(b, c), cross(c, a), cross(a, b)], dim=-1)


def null_vectors(matrix: Tensor) -> tuple[Tensor, Tensor]:
    r"""Left and right null vector of a 3 x 3 matrix of rank two: :math:`y^T M = 0,\ M z = 0`.

    The cofactors of such a matrix are :math:`c\, y z^T`.  For a matrix that noise has made regular, the result is the pair of
    singular vectors to its smallest singular value: the leading ones of the cofactors, found by repeated squaring.  Where
    the rank is exactly two, the units of the coordinates (pixels beside the constant 1) cost no accuracy, as they do in an
    orthogonal decomposition.

    Args:
        matrix: ``(*batch, 3, 3)`` of any scale.

    Returns:
        Unit vectors y and z ``(*batch, 3)``, of any sign; zero where the rank is below two and the cofactors vanish.

    Raises:
        ValueError: not 3 x 3.

    Example:
        >>> import torch
        >>> left, right = null_vectors(torch.diag(torch.tensor([2.0, 0.0, 5.0])))
        >>> left.abs().tolist(), right.abs().tolist()
        ([0.0, 1.0, 0.0], [0.0, 1.0, 0.0])
    """
    adjoint = cofactors(_scaled(matrix))
    power = adjoint @ _scaled(adjoint).mT
    for _ in range(SQUARINGS):
        power = _scaled(power)
        power = power @ power
    # every column is a multiple of the vector; the longest one of them is never zero
    pick = power.detach().diagonal(dim1=-2, dim2=-1).argmax(dim=-1, keepdim=True)[..., None].expand(*power.shape[:-1], 1)
    left = _scaled(power.gather(-1, pick))[..., 0]
    left = left / _nonzero(torch.linalg.vector_norm(left, dim=-1, keepdim=True))
    right = (_scaled(adjoint).mT @ left[..., None])[..., 0]
    return left, right / _nonzero(torch.linalg.vector_norm(right, dim=-1, keepdim=True))


def _scaled(matrix: Tensor) -> Tensor:
    """Largest entry 1.  The scale is no variable: the null vectors do not depend on it."""
    return matrix / _nonzero(matrix.detach().abs().amax(dim=(-2, -1), keepdim=True))


def _nonzero(size: Tensor) -> Tensor:
    """A divisor that leaves zero, and its gradient, alone."""
    return torch.where(size > 0, size, torch.ones_like(size))


def rank_one(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Unit vector u ``(*batch, r)`` and v ``(*batch, c)`` for which u v^T is nearest to a matrix; v = 0 for the zero matrix.

    Example:
        >>> import torch
        >>> left, right = rank_one(torch.tensor([[0.0, 0.0], [3.0, 4.0]]))
        >>> (left[:, None] * right).tolist()
        [[0.0, 0.0], [3.0, 4.0]]
    """
    scaled, _ = unit_size(matrix)
    power = scaled @ scaled.mT
    for _ in range(SQUARINGS):
        power, _ = unit_size(power)
        power = power @ power
    pick = power.detach().diagonal(dim1=-2, dim2=-1).argmax(dim=-1, keepdim=True)[..., None].expand(*power.shape[:-1], 1)
    left = power.gather(-1, pick)[..., 0]
    first = torch.zeros_like(left)
    first[..., 0] = 1.0
    left = unit_vectors(torch.where((left == 0).all(-1, keepdim=True), first, left))
    return left, (matrix.mT @ left[..., None])[..., 0]


def unit_size(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Frobenius norm 1, and the norm ``(*batch, 1, 1)``; zero stays."""
    norm = torch.linalg.matrix_norm(matrix, keepdim=True)
    return matrix / torch.where(norm > 0, norm, 1.0), norm
