"""Homogeneous coordinates, to and from them without NaN; canonical scales and signs; hyperplanes of a point."""

from __future__ import annotations

from itertools import combinations_with_replacement

import torch
from torch import Tensor

from dyntorch.numerics.blocks import constant


def homogeneous(x: Tensor) -> Tensor:
    r"""Append the coordinate 1: :math:`p = (x, 1)`.

    Args:
        x: ``(..., d)`` inhomogeneous points, in any unit.

    Returns:
        ``(..., d + 1)``.

    Example:
        >>> import torch
        >>> homogeneous(torch.tensor([2.0, 3.0])).tolist()
        [2.0, 3.0, 1.0]
    """
    return torch.cat([x, torch.ones_like(x[..., :1])], dim=-1)


def inhomogeneous(p: Tensor) -> Tensor:
    r"""Divide by the last coordinate: :math:`x = (p_1, \dots, p_d) / p_{d+1}`, with finite values and gradients everywhere.

    A point at infinity, :math:`|p_{d+1}| \le \epsilon \max_i |p_i|` with the precision :math:`\epsilon` of the dtype, is put
    where its direction meets the distance :math:`1/\epsilon`; its value then does not depend on :math:`p_{d+1}` (gradient
    0).  The zero vector, which is no point at all, gives 0.  So one bad point of a batch never spoils a gradient of another.

    Args:
        p: ``(..., d + 1)`` homogeneous points of any scale and sign.

    Returns:
        ``(..., d)``, no coordinate above :math:`1/\epsilon` for finite input.

    Example:
        >>> import torch
        >>> inhomogeneous(torch.tensor([4.0, 6.0, 2.0])).tolist()
        [2.0, 3.0]
        >>> bool(inhomogeneous(torch.tensor([4.0, 6.0, 0.0])).isfinite().all())
        True
    """
    return p[..., :-1] / finite_depth(p)


def finite_depth(p: Tensor) -> Tensor:
    """The last coordinate ``(..., 1)`` of homogeneous points; at infinity the stand-in of :func:`inhomogeneous`, a constant."""
    w = p[..., -1:]
    floor = torch.finfo(p.dtype).eps * p.detach().abs().amax(dim=-1, keepdim=True)
    limit = torch.where(floor > 0, torch.copysign(floor, w.detach()), 1.0)
    return torch.where(w.abs() <= floor, limit, w)


def apply(collineation: Tensor, points: Tensor) -> Tensor:
    r"""Map points by a collineation or a projection and return them inhomogeneous: :math:`\pi(A (x, 1))`.

    Args:
        collineation: ``(*batch, e, d + 1)`` of any scale and sign.
        points: ``(*batch, n, d)``.

    Returns:
        ``(*batch, n, e - 1)``; images at infinity as in :func:`inhomogeneous`.

    Raises:
        ValueError: the matrix does not take ``d + 1`` coordinates.

    Example:
        >>> import torch
        >>> shift = torch.tensor([[1.0, 0.0, 5.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        >>> apply(shift, torch.tensor([[1.0, 2.0]])).tolist()
        [[6.0, 2.0]]
    """
    d = points.shape[-1]
    if points.ndim < 2 or collineation.ndim < 2 or collineation.shape[-1] != d + 1:
        raise ValueError(
            f"collineation must be (*batch, e, d + 1) for points (*batch, n, d), "
            f"got {tuple(collineation.shape)} for {tuple(points.shape)}"
        )
    # the last column is the image of the appended 1: adding it saves the copy that homogeneous() makes
    return inhomogeneous(points @ collineation[..., :d].mT + collineation[..., None, :, d])


def unit(matrix: Tensor) -> Tensor:
    r"""The canonical representative of a matrix up to scale: :math:`\|A\|_F = 1` and a fixed sign.

    A square matrix of odd size is given a positive determinant; every other one, and one that is singular to working
    precision, a positive entry of largest magnitude.  (With even size the sign of the determinant does not depend on the
    scale, so it cannot fix the sign.)  The zero matrix is returned unchanged.

    Args:
        matrix: ``(*batch, rows, columns)``.

    Returns:
        ``(*batch, rows, columns)``.

    Raises:
        ValueError: fewer than two dimensions.

    Example:
        >>> import torch
        >>> unit(-3 * torch.eye(4)).diagonal().tolist()
        [0.5, 0.5, 0.5, 0.5]
    """
    if matrix.ndim < 2:
        raise ValueError(f"matrix must be (*batch, rows, columns), got {tuple(matrix.shape)}; unsqueeze a vector first")
    norm = torch.linalg.matrix_norm(matrix, keepdim=True)
    scaled = matrix / torch.where(norm > 0, norm, torch.ones_like(norm))
    return scaled * _sign(scaled.detach())


def _sign(matrix: Tensor) -> Tensor:
    """``(*batch, 1, 1)`` sign, +1 or -1, that makes a matrix of norm 1 canonical."""
    flat = matrix.flatten(-2)
    leading = flat.gather(-1, flat.abs().argmax(dim=-1, keepdim=True))
    rows, columns = matrix.shape[-2:]
    if rows == columns and rows % 2:
        det = torch.linalg.det(matrix)[..., None]
        # Hadamard's bounds, by rows and by columns, are the size that the rounding error of the determinant is relative to
        bound = torch.minimum(matrix.norm(dim=-1).prod(dim=-1), matrix.norm(dim=-2).prod(dim=-1))[..., None]
        leading = torch.where(det.abs() > 10 * torch.finfo(matrix.dtype).eps * bound, det, leading)
    return nonzero_sign(leading)[..., None]


def unit_vectors(vectors: Tensor) -> Tensor:
    """Vectors ``(..., d)`` at norm 1 with the sign that they have; the zero vector stays, with finite gradients.

    Example:
        >>> import torch
        >>> unit_vectors(torch.tensor([[0.0, -2.0], [0.0, 0.0]])).tolist()
        [[0.0, -1.0], [0.0, 0.0]]
    """
    length = vectors.norm(dim=-1, keepdim=True)
    return vectors / torch.where(length > 0, length, 1.0)


def nonzero_sign(values: Tensor) -> Tensor:
    """-1 where values are negative, 1 elsewhere: a factor that may turn a vector, but never removes it.

    Example:
        >>> import torch
        >>> nonzero_sign(torch.tensor([-2.0, 0.0, 3.0])).tolist()
        [-1.0, 1.0, 1.0]
    """
    return torch.where(values < 0, -1.0, 1.0).to(values.dtype)


def skew(v: Tensor) -> Tensor:
    r"""The matrix of the cross product: :math:`[v]_\times w = v \times w`.

    Args:
        v: ``(*batch, 3)``.

    Returns:
        ``(*batch, 3, 3)``.

    Raises:
        ValueError: the last dimension is not 3.

    Example:
        >>> import torch
        >>> (skew(torch.tensor([0.0, 0.0, 1.0])) @ torch.tensor([1.0, 0.0, 0.0])).tolist()
        [0.0, 1.0, 0.0]
    """
    if v.shape[-1:] != (3,):
        raise ValueError(f"v must be (*batch, 3), got {tuple(v.shape)}")
    x, y, z = v.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=-1).unflatten(-1, (3, 3))


def similarity(scale: Tensor, centre: Tensor) -> Tensor:
    r"""The similarity :math:`x \mapsto s\,(x - c)` as a collineation: it moves the centre to the origin, then scales.

    Args:
        scale: ``(*batch,)``.
        centre: ``(*batch, d)``.

    Returns:
        ``(*batch, d + 1, d + 1)``, last row ``(0, ..., 0, 1)``.

    Example:
        >>> import torch
        >>> apply(similarity(torch.tensor(2.0), torch.tensor([1.0, 1.0])), torch.tensor([[3.0, 1.0]])).tolist()
        [[4.0, 0.0]]
    """
    d = centre.shape[-1]
    eye = torch.eye(d + 1, dtype=centre.dtype, device=centre.device)
    upper = torch.cat([eye[:d, :d].expand(*centre.shape, d), -centre[..., None]], dim=-1) * scale[..., None, None]
    return torch.cat([upper, eye[d:].expand(*upper.shape[:-2], 1, d + 1)], dim=-2)


def hyperplanes_through(x: Tensor) -> Tensor:
    r"""Orthonormal basis of the hyperplanes through each point: :math:`N (x, 1) = 0`, :math:`N N^T = I`.

    The Householder reflection that takes the homogeneous point to the last axis, without its last row:

    .. math:: N = \left[\, I - \frac{x x^T}{s (s + 1)} \;\Big|\; -\frac{x}{s} \,\right], \qquad s = \sqrt{1 + \|x\|^2}.

    It is smooth in x everywhere, which a basis from an SVD is not.

    Args:
        x: ``(*batch, n, d)``; conditioned best where the coordinates are of order 1.

    Returns:
        ``(*batch, n, d, d + 1)``: ``d`` hyperplanes per point.

    Example:
        >>> import torch
        >>> hyperplanes_through(torch.zeros(1, 2)).abs().tolist()
        [[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]]
    """
    s = (1 + x.square().sum(-1, keepdim=True)).sqrt()
    eye = torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)
    outer = (x / s)[..., :, None] * (x / (s + 1))[..., None, :]
    return torch.cat([eye - outer, -(x / s)[..., None]], dim=-1)


def two_sided(A: Tensor, B: Tensor) -> Tensor:
    r"""The matrix of :math:`X \mapsto A X B` on entries row by row, :math:`A \otimes B^T`.

    Args:
        A: ``(*batch, i, j)``.
        B: ``(*batch, l, k)``.

    Returns:
        ``(*batch, i k, j l)``.

    Example:
        >>> import torch
        >>> A, X, B = torch.rand(3, 2, 2, generator=torch.Generator().manual_seed(0)).unbind()
        >>> bool(torch.allclose(two_sided(A, B) @ X.flatten(), (A @ X @ B).flatten()))
        True
    """
    return torch.einsum("...ij,...lk->...ikjl", A, B).flatten(-2).flatten(-3, -2)


# ----------------------------------------------------------------------------------------------------------------------
# Matrices of rank two and one in closed form: cofactors, null vectors, nearest products of vectors, for many at a time.


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


# ----------------------------------------------------------------------------------------------------------------------
# Monomials of the coordinates of vectors, and where they are in symmetric matrices and products of linear forms.


def monomials(p: Tensor, degree: int) -> Tensor:
    """All monomials ``(*batch, width, n)`` of one degree of vectors ``(*batch, d + 1, n)``, which need not end in 1.

    Example:
        >>> import torch
        >>> monomials(torch.tensor([[2.0], [3.0], [-1.0]]), 2).flatten().tolist()
        [4.0, 6.0, -2.0, 9.0, -3.0, 1.0]
    """
    table = factors(degree, p.shape[-2] - 1, p.device).unbind(-1)
    product = p.index_select(-2, table[0])
    for factor in table[1:]:
        product = product * p.index_select(-2, factor)
    return product


def monomial_derivatives(p: Tensor, degree: int, count: int) -> Tensor:
    r"""Derivatives ``(*batch, n, width, count)`` of the monomials of vectors ``(*batch, n, d + 1)`` by their first coordinates.

    Example:
        >>> import torch
        >>> monomial_derivatives(torch.tensor([[2.0, 3.0, -1.0]]), 2, 3)[0, 1].tolist()  # of x y
        [3.0, 2.0, 0.0]
    """
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
    r"""Which products of coordinates are which monomial: C with :math:`p \otimes \dots \otimes p = C^T \nu(p)`, 0 and 1.

    The coefficients of a product of linear forms are :math:`C (a \otimes b \otimes \dots)`.  ``(width, (dim + 1)^degree)``.
    """
    grids = torch.meshgrid(*[torch.arange(dim + 1)] * degree, indexing="ij")
    every = torch.stack([grid.flatten() for grid in grids], dim=-1).sort(-1).values
    table = torch.tensor(list(combinations_with_replacement(range(dim + 1), degree)))
    return (table[:, None] == every).all(-1).double().to(device)


@constant
def multiplicity(degree: int, dim: int, device: torch.device) -> Tensor:
    """How many products of coordinates are each monomial, ``(width,)``."""
    return collecting(degree, dim, torch.device("cpu")).sum(-1).to(device)
