"""The homography at infinity of translating bodies of which one or more have a known fundamental matrix."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.algebra.homogeneous import skew, unit_vectors
from dyntorch.algebra.infinity_from_planes import ridge_solution
from dyntorch.algebra.rank_one_pencils import (
    check_homographies,
    finite_matrices,
    plane_parts,
    rank_one_scale,
    unit_determinant,
)
from dyntorch.algebra.rank_two import null_vectors, rank_one
from dyntorch.nullspace import null_space

REWEIGHTINGS = 1
"""Of the planes, by how well their lines are known.  Errors 0.01 of the entries of H and 0.001 of F, 300 scenes each with
2, 3, 5 planes: median error .0116, .0097, .0079 without, .0109, .0084, .0069 with one, and the same with three."""


def infinity_from_fundamentals(fundamentals: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
    r"""The homography at infinity from two fundamental matrices of translating bodies, or more.

    :math:`F_k = [e_k]_\times H_\infty` makes :math:`H_\infty^T F_k` skew, six linear equations each:

    .. math:: H_\infty^T F_k + F_k^T H_\infty = 0.

    Their rank is 5 for one body and 8 for two whose epipoles differ.

    Args:
        fundamentals: F ``(*batch, m, 3, 3)``, x2^T F x1 = 0, of any scale, in coordinates of size 1.  One that is not finite is
            left out.
        weights: ``(*batch, m)``, not negative.

    Returns:
        :math:`H_\infty` ``(*batch, 3, 3)`` in float64, view 1 to view 2, determinant 1, and the singular values ``(*batch, 9)`` of
        the equations, descending: the last but one is 0 where the epipoles are one point.  Differentiable.

    Raises:
        ValueError: fewer than two fundamental matrices, or shapes that do not fit.

    Source: Manning and Dyer 1999 (stereo from translating bodies).

    Example:
        >>> import torch
        >>> from dyntorch.algebra.homogeneous import skew
        >>> found, _ = infinity_from_fundamentals(skew(torch.tensor([[0.0, 1.0, 0.5], [1.0, 0.0, 0.0]])))
        >>> found.round(decimals=6).abs().tolist()
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    if fundamentals.ndim < 3 or fundamentals.shape[-2:] != (3, 3) or fundamentals.shape[-3] < 2:
        raise ValueError(f"F must be (*batch, m, 3, 3) with m >= 2, got {tuple(fundamentals.shape)}")
    known = unit_vectors(finite_matrices(fundamentals)[0].flatten(-2))
    if weights is not None:
        if weights.shape != fundamentals.shape[:-2]:
            raise ValueError(f"weights must be (*batch, m) = {tuple(fundamentals.shape[:-2])}, got {tuple(weights.shape)}")
        known = known * weights.double().sqrt()[..., None]
    axes = torch.eye(9, dtype=known.dtype, device=known.device).unflatten(-1, (3, 3))
    products = axes.mT @ known.unflatten(-1, (3, 3))[..., None, :, :]
    # the equations in the columns: one for every entry, so that those off the diagonal weigh as much as in the norm
    rows = (products + products.mT).flatten(-2).mT.flatten(-3, -2)
    found = null_space(rows)[..., 0, :].unflatten(-1, (3, 3))
    return unit_determinant(found), torch.linalg.svdvals(rows.detach())


def infinity_from_mixed(fundamental: Tensor, homographies: Tensor) -> tuple[Tensor, Tensor]:
    r"""The homography at infinity from one fundamental matrix and two planes of other bodies, or more, in closed form.

    With the epipole e' of F, :math:`H_\infty = [e']_\times F + e' a^T` leaves three unknowns a.  Let N be two rows orthogonal to
    e'.  For every plane, :math:`H_i = \lambda_i (H_\infty + e_i n_i^T)` says that

    .. math::
        N H_i - \lambda_i N [e']_\times F = \lambda_i (N e_i)\, n_i^T \quad\text{has rank one, and}\quad
        e'^T H_i / \lambda_i - a^T = (e'^T e_i)\, n_i^T.

    The first is a pencil of 2 x 3 matrices: three quadrics in :math:`\lambda_i` with one common root, which is unique
    (:func:`~dyntorch.algebra.rank_one_pencils.rank_one_scale`), and one condition on the data besides.  The second puts a on a
    line along :math:`n_i`: two planes that are not parallel give one a.  So the solution is unique; a third of the nine
    equations are left over.  Planes of the body of F itself, and static planes, say nothing about a and weigh nothing.

    Args:
        fundamental: F ``(*batch, 3, 3)``, x2^T F x1 = 0, in coordinates of size 1.
        homographies: H ``(*batch, n, 3, 3)``, view 1 to view 2, in the same coordinates, of any scale; one that is not finite is
            left out.

    Returns:
        :math:`H_\infty` ``(*batch, 3, 3)`` in float64, determinant 1, and the residual ``(*batch,)``: the root mean square of the
        ones of :func:`~dyntorch.algebra.rank_one_pencils.plane_parts`, for planes of determinant 1.

    Raises:
        ValueError: fewer than two planes, or shapes that do not fit.

    Source: thesis chapter 5; the mixed case is derived here.

    Example:
        >>> import torch
        >>> from dyntorch.algebra.homogeneous import skew
        >>> rand = torch.Generator().manual_seed(0)
        >>> e, n = torch.rand(2, 2, 3, generator=rand, dtype=torch.float64)
        >>> found, residual = infinity_from_mixed(skew(torch.tensor([0.0, 1.0, 0.5])), torch.eye(3) + e[:, :, None] * n[:, None])
        >>> found.round(decimals=6).abs().tolist(), float(residual) < 1e-9
        ([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], True)
    """
    check_homographies(homographies, 2)
    if fundamental.shape[-2:] != (3, 3):
        raise ValueError(f"F must be (*batch, 3, 3), got {tuple(fundamental.shape)}")
    known, planes = finite_matrices(fundamental)[0], unit_determinant(finite_matrices(homographies)[0])
    present = (planes != 0).flatten(-2).any(-1).double()
    epipole, _ = null_vectors(known)
    visible = skew(epipole) @ known
    visible = visible / torch.linalg.matrix_norm(visible, keepdim=True).clamp(min=torch.finfo(visible.dtype).tiny)
    across = null_space(epipole[..., None, :], 2)
    base = (across @ visible)[..., None, :, :]
    scale = rank_one_scale(across[..., None, :, :] @ planes, base)
    scale = torch.where(scale == 0, 1.0, scale)[..., None]
    normal = rank_one(across[..., None, :, :] @ planes - scale[..., None] * base)[1]
    strength = normal.norm(dim=-1) * present
    normal = unit_vectors(normal)
    on_line = (epipole[..., None, None, :] @ planes)[..., 0, :] / scale
    a = _nearest_to_lines(on_line, normal, strength, scale[..., 0])
    infinity = unit_determinant(visible + epipole[..., :, None] * a[..., None, :])
    squares = plane_parts(planes, infinity).residual.square() * present
    return infinity, (squares.sum(-1) / present.sum(-1).clamp(min=1.0)).sqrt()


def _nearest_to_lines(points: Tensor, directions: Tensor, strength: Tensor, scale: Tensor) -> Tensor:
    """The point ``(*batch, 3)`` nearest to lines through points ``(*batch, n, 3)``, each by what it is known with.

    Entries of H with the error s put the line off by s / |scale|, and turn its direction by s / strength.
    """
    eye = torch.eye(3, dtype=points.dtype, device=points.device)
    weight = strength.square()
    for _ in range(1 + REWEIGHTINGS):
        across = eye - directions[..., :, None] * directions[..., None, :]
        across = across * weight[..., None, None]
        found = ridge_solution(across.sum(-3), (across @ points[..., None]).sum(-3)[..., 0])
        along = ((found[..., None, :] - points) * directions).sum(-1)
        weight = (scale * strength).square() / (strength.square() + (scale * along).square() + torch.finfo(points.dtype).tiny)
    return found.nan_to_num(0.0, 0.0, 0.0)
