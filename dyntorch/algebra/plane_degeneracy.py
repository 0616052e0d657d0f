"""What makes the homography at infinity of translating planes ambiguous: planes of one body, epipoles on one line."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.algebra.homogeneous import unit_vectors
from dyntorch.algebra.rank_one_pencils import (
    check_homographies,
    finite_matrices,
    rank_one_scale,
    second_singular_value,
    unit_determinant,
)
from dyntorch.nullspace import gram_null_space


def pairwise_homology(homographies: Tensor) -> tuple[Tensor, Tensor]:
    r"""How far every pair of planes is from one body: whether :math:`D_{ij} = H_i - t H_j` has rank one for some t.

    Two planes of one body, and any plane beside one that stands still relative to the camera's rotation (:math:`e_i = 0`), have
    :math:`D_{ij} = e\, n^T`: then :math:`H_j^{-1} H_i` is a homology.  The t is that of
    :func:`~dyntorch.algebra.rank_one_pencils.rank_one_scale`.

    Args:
        homographies: H ``(*batch, n, 3, 3)`` of any scale, in coordinates of size 1.

    Returns:
        ratio and residual ``(*batch, n, n)``, symmetric, 0 on the diagonal: about :math:`\sigma_2 / \sigma_1` of D, and about
        :math:`\sigma_2` in units of the planes at determinant 1.  The residual is what compares with the errors of H; where a
        plane is seen twice, D is noise and the ratio says nothing.  Both are 1 for a plane that is not finite.

    Raises:
        ValueError: shapes that do not fit.

    Source: thesis chapter 5 (planes of one body).

    Example:
        >>> import torch
        >>> e, n = torch.eye(3).double()[[0, 0, 1]], torch.tensor([[0.5, 0.2, 0.1], [0.0, 0.3, 0.4], [0.1, 0.1, 0.6]]).double()
        >>> ratio, _ = pairwise_homology(torch.eye(3) + e[:, :, None] * n[:, None, :])
        >>> (ratio < 1e-6).int().tolist()
        [[1, 1, 0], [1, 1, 0], [0, 0, 1]]
    """
    check_homographies(homographies, 1)
    given, finite = finite_matrices(homographies)
    planes = unit_determinant(given)
    first, second = torch.broadcast_tensors(planes[..., :, None, :, :], planes[..., None, :, :, :])
    difference = first - rank_one_scale(first, second)[..., None, None] * second
    size = torch.linalg.matrix_norm(difference)
    smaller, scale = second_singular_value(difference), torch.linalg.matrix_norm(first)
    ratio = smaller / torch.where(size > 0, size, 1.0)
    residual = smaller / torch.where(scale > 0, scale, 1.0)
    known = finite[..., :, None] & finite[..., None, :]
    same = torch.eye(planes.shape[-3], dtype=torch.bool, device=planes.device)
    result = []
    for values in (ratio, residual):
        symmetric = torch.minimum(values, values.mT)
        result.append(torch.where(same, 0.0, torch.where(known, symmetric, 1.0)))
    return result[0], result[1]


def flatness(vectors: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
    r"""How far vectors of space are from one plane: epipoles from a line, normals from coplanar ones.

    Args:
        vectors: ``(*batch, n, 3)`` of any length; those of length 0, or not finite, are left out.
        weights: ``(*batch, n)``, not negative: for epipoles, say, the length of the normals, as a static plane's epipole means
            nothing.

    Returns:
        The smallest singular value of the unit vectors, relative to the root mean square of all three ``(*batch,)``, from 0 (flat,
        and always for two vectors) to 1; and the unit vector ``(*batch, 3)`` orthogonal to the plane: the line of epipoles.

    Raises:
        ValueError: shapes that do not fit.

    Example:
        >>> import torch
        >>> ratio, line = flatness(torch.tensor([[1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [2.0, -1.0, 0.0]]).double())
        >>> round(float(ratio), 6), line.abs().tolist()
        (0.0, [0.0, 0.0, 1.0])
    """
    if vectors.ndim < 2 or vectors.shape[-1] != 3:
        raise ValueError(f"vectors must be (*batch, n, 3), got {tuple(vectors.shape)}")
    if weights is not None and weights.shape != vectors.shape[:-1]:
        raise ValueError(f"weights must be (*batch, n) = {tuple(vectors.shape[:-1])}, got {tuple(weights.shape)}")
    unit = unit_vectors(torch.where(vectors.isfinite().all(-1, keepdim=True), vectors, 0.0).double())
    if weights is not None:
        unit = unit * weights.double().sqrt()[..., None]
    found = gram_null_space(unit.mT @ unit)
    total = unit.square().sum((-2, -1))
    ratio = (3 * found.residual[..., 0] / torch.where(total > 0, total, 1.0)).sqrt()
    return ratio, found.basis[..., 0, :]
