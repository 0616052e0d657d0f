"""Homogeneous coordinates, to and from them without NaN; canonical scales and signs; monomials."""

from __future__ import annotations

from itertools import combinations_with_replacement

import torch
from torch import Tensor

from dyntorch.native import library
from dyntorch.numerics.blocks import constant
from dyntorch.numerics.function_transforms import is_plain


def homogeneous(x: Tensor) -> Tensor:
    r"""Append the coordinate 1: :math:`p = (x, 1)`. x ``(..., d)`` -> ``(..., d + 1)``."""
    return torch.cat([x, torch.ones_like(x[..., :1])], dim=-1)


def inhomogeneous(p: Tensor) -> Tensor:
    r"""Divide by the last coordinate: :math:`x = (p_1, \dots, p_d) / p_{d+1}`, with finite values and gradients everywhere. p
    ``(..., d + 1)`` -> ``(..., d)``."""
    return p[..., :-1] / finite_depth(p)


def finite_depth(p: Tensor) -> Tensor:
    """The last coordinate ``(..., 1)`` of homogeneous points; at infinity the stand-in of :func:`inhomogeneous`, a constant."""
    w = p[..., -1:]
    floor = torch.finfo(p.dtype).eps * p.detach().abs().amax(dim=-1, keepdim=True)
    limit = torch.where(floor > 0, torch.copysign(floor, w.detach()), 1.0)
    return torch.where(w.abs() <= floor, limit, w)


def apply(collineation: Tensor, points: Tensor) -> Tensor:
    r"""Map points by a collineation or a projection and return them inhomogeneous: :math:`\pi(A (x, 1))`. collineation
    ``(*batch, e, d + 1)``, points ``(*batch, n, d)`` -> ``(*batch, n, e - 1)``."""
    d = points.shape[-1]
    if points.ndim < 2 or collineation.ndim < 2 or collineation.shape[-1] != d + 1:
        raise ValueError(
            f"collineation must be (*batch, e, d + 1) for points (*batch, n, d), "
            f"got {tuple(collineation.shape)} for {tuple(points.shape)}"
        )
    # the last column is the image of the appended 1: adding it saves the copy that homogeneous() makes
    return inhomogeneous(points @ collineation[..., :d].mT + collineation[..., None, :, d])


def unit(matrix: Tensor) -> Tensor:
    r"""The canonical representative of a matrix up to scale: :math:`\|A\|_F = 1` and a fixed sign. matrix
    ``(*batch, rows, columns)`` -> ``(*batch, rows, columns)``."""
    if matrix.ndim < 2:
        raise ValueError(f"matrix must be (*batch, rows, columns), got {tuple(matrix.shape)}; unsqueeze a vector first")
    norm = torch.linalg.matrix_norm(matrix, keepdim=True)
    scaled = matrix / torch.where(norm > 0, norm, torch.ones_like(norm))
    return scaled * canonical_sign(scaled.detach())


def canonical_sign(matrix: Tensor) -> Tensor:
    """``(*batch, 1, 1)`` sign, +1 or -1, that makes a matrix of norm 1 canonical."""
    flat = matrix.flatten(-2)
    leading = flat.gather(-1, flat.abs().argmax(dim=-1, keepdim=True))
    rows, columns = matrix.shape[-2:]
    if rows == columns and rows % 2:
        det = torch.linalg.det(matrix)[..., None]
        # Hadamard's bounds, by rows and by columns, are the size that the rounding error of the determinant is relative to
        bound = torch.stack([torch.linalg.vector_norm(matrix, dim=k) for k in (-1, -2)]).prod(-1).amin(0)[..., None]
        leading = torch.where(det.abs() > 10 * torch.finfo(matrix.dtype).eps * bound, det, leading)
    return nonzero_sign(leading)[..., None]


def unit_vectors(vectors: Tensor) -> Tensor:
    """Vectors ``(..., d)`` at norm 1 with the sign that they have; the zero vector stays, with finite gradients."""
    length = vectors.norm(dim=-1, keepdim=True)
    return vectors / torch.where(length > 0, length, 1.0)


def nonzero_sign(values: Tensor) -> Tensor:
    """-1 where values are negative, 1 elsewhere: a factor that may turn a vector, but never removes it."""
    return torch.where(values < 0, -1.0, 1.0).to(values.dtype)


def skew(v: Tensor) -> Tensor:
    r"""The matrix of the cross product: :math:`[v]_\times w = v \times w`. v ``(*batch, 3)`` -> ``(*batch, 3, 3)``."""
    if v.shape[-1:] != (3,):
        raise ValueError(f"v must be (*batch, 3), got {tuple(v.shape)}")
    x, y, z = v.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=-1).unflatten(-1, (3, 3))


def similarity(scale: Tensor, centre: Tensor) -> Tensor:
    r"""The similarity :math:`x \mapsto s\,(x - c)` as a collineation: it moves the centre to the origin, then scales. scale
    ``(*batch,)``, centre ``(*batch, d)`` -> ``(*batch, d + 1, d + 1)``."""
    d = centre.shape[-1]
    eye = torch.eye(d + 1, dtype=centre.dtype, device=centre.device)
    upper = torch.cat([eye[:d, :d].expand(*centre.shape, d), -centre[..., None]], dim=-1) * scale[..., None, None]
    return torch.cat([upper, eye[d:].expand(*upper.shape[:-2], 1, d + 1)], dim=-2)


def two_sided(A: Tensor, B: Tensor) -> Tensor:
    r"""The matrix of :math:`X \mapsto A X B` on entries row by row, :math:`A \otimes B^T`. A ``(*batch, i, j)``, B
    ``(*batch, l, k)`` -> ``(*batch, i k, j l)``."""
    return torch.einsum("...ij,...lk->...ikjl", A, B).flatten(-2).flatten(-3, -2)


# ----------------------------------------------------------------------------------------------------------------------
# Matrices of rank two and one in closed form: cofactors, null vectors, nearest products of vectors, for many at a time.


SQUARINGS = 5
"""A null vector of a noisy matrix is then exact to (s_3 / s_2)^64: 1e-10 even at s_3 = 0.7 s_2;
the leading vector of a matrix of rank about one to (s_2 / s_1)^64."""


def cofactors(matrix: Tensor) -> Tensor:
    r"""The matrix of cofactors, :math:`\det(M)\, M^{-T}`: how lines map where M maps points. matrix ``(*batch, 3, 3)`` ->
    ``(*batch, 3, 3)``."""
    if matrix.shape[-2:] != (3, 3):
        raise ValueError(f"matrix must be (*batch, 3, 3), got {tuple(matrix.shape)}")
    a, b, c = matrix.unbind(-1)
    cross = torch.linalg.cross
    return torch.stack([cross(b, c), cross(c, a), cross(a, b)], dim=-1)


def null_vectors(matrix: Tensor) -> tuple[Tensor, Tensor]:
    r"""Left and right null vector of a 3 x 3 matrix of rank two: :math:`y^T M = 0,\ M z = 0`. matrix ``(*batch, 3, 3)`` ->
    ``(*batch, 3)``."""
    if matrix.dtype == torch.float64 and is_plain(matrix) and library.load()[0]:
        return library.null_vectors(matrix)
    adjoint = cofactors(_rescale(matrix))
    power = adjoint @ _rescale(adjoint).mT
    for _ in range(SQUARINGS):
        power = _rescale(power)
        power = power @ power
    # every column is a multiple of the vector; the longest one of them is never zero
    pick = power.detach().diagonal(dim1=-2, dim2=-1).argmax(dim=-1, keepdim=True)[..., None].expand(*power.shape[:-1], 1)
    left = _rescale(power.gather(-1, pick))[..., 0]
    left = left / _nonzero(torch.linalg.vector_norm(left, dim=-1, keepdim=True))
    right = (_rescale(adjoint).mT @ left[..., None])[..., 0]
    return left, right / _nonzero(torch.linalg.vector_norm(right, dim=-1, keepdim=True))


def _rescale(matrix: Tensor) -> Tensor:
    """Largest entry 1.  The scale is no variable: the null vectors do not depend on it."""
    return matrix / _nonzero(matrix.detach().abs().amax(dim=(-2, -1), keepdim=True))


def _nonzero(size: Tensor) -> Tensor:
    """A divisor that leaves zero, and its gradient, alone."""
    return torch.where(size > 0, size, torch.ones_like(size))


def rank_one(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Unit vector u ``(*batch, r)`` and v ``(*batch, c)`` for which u v^T is nearest to a matrix; v = 0 for the zero matrix."""
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


# ----------------------------------------------------------------------------------------------------------------------
# Monomials of the coordinates of vectors, and where they are in symmetric matrices and products of linear forms.


def monomials(p: Tensor, degree: int) -> Tensor:
    """All monomials ``(*batch, width, n)`` of one degree of vectors ``(*batch, d + 1, n)``, which need not end in 1."""
    table = factors(degree, p.shape[-2] - 1, p.device).unbind(-1)
    product = p.index_select(-2, table[0])
    for factor in table[1:]:
        product = product * p.index_select(-2, factor)
    return product


def monomial_derivatives(p: Tensor, degree: int, count: int) -> Tensor:
    r"""Derivatives ``(*batch, n, width, count)`` of the monomials of vectors ``(*batch, n, d + 1)`` by their first coordinates."""
    table = factors(degree, p.shape[-1] - 1, p.device)
    eye = torch.eye(p.shape[-1], count, dtype=p.dtype, device=p.device)
    total = torch.zeros_like(p[..., :1, None])
    # one factor at a time replaced by its derivative
    for i in range(degree):
        term = eye[table[:, i]]
        for j in range(degree):
            term = term if j == i else term * p[..., table[:, j], None]
        total = total + term
    return total


@constant
def symmetric(dim: int, device: torch.device) -> Tensor:
    """Where the monomials of degree two are in a symmetric matrix, ``(dim + 1, dim + 1)``."""
    table = torch.tensor(list(combinations_with_replacement(range(dim + 1), 2)))
    place = torch.zeros(dim + 1, dim + 1, dtype=torch.long)
    place[table[:, 0], table[:, 1]] = place[table[:, 1], table[:, 0]] = torch.arange(len(table))
    return place.to(device)


@constant
def factors(degree: int, dim: int, device: torch.device) -> Tensor:
    """The coordinates in each monomial, ``(width, degree)``, ascending."""
    return torch.tensor(list(combinations_with_replacement(range(dim + 1), degree)), device=device)


@constant
def collecting(degree: int, dim: int, device: torch.device) -> Tensor:
    r"""Which products of coordinates are which monomial: C with :math:`p \otimes \dots \otimes p = C^T \nu(p)`, 0 and 1."""
    grids = torch.meshgrid(*[torch.arange(dim + 1)] * degree, indexing="ij")
    every = torch.stack([grid.flatten() for grid in grids], dim=-1).sort(-1).values
    table = torch.tensor(list(combinations_with_replacement(range(dim + 1), degree)))
    return (table[:, None] == every).all(-1).double().to(device)


@constant
def multiplicity(degree: int, dim: int, device: torch.device) -> Tensor:
    """How many products of coordinates are each monomial, ``(width,)``."""
    return collecting(degree, dim, torch.device("cpu")).sum(-1).to(device)
