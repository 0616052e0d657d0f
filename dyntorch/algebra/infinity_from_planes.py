r"""The homography at infinity of independently translating planes in closed form, from three of them.

With the right scales, :math:`G_i = H_i / \lambda_i = H_\infty + e_i n_i^T`, the differences

.. math:: D_{ij} = G_i - G_j = e_i n_i^T - e_j n_j^T

are singular; a left null vector of :math:`D_{ij}` is the line through both epipoles, a right one the line of both normals.
"""

from __future__ import annotations

from math import prod

import torch
from torch import Tensor

from dyntorch.algebra.homogeneous import skew, unit_vectors
from dyntorch.algebra.rank_one_pencils import (
    check_homographies,
    finite_matrices,
    plane_parts,
    second_singular_value,
    unit_determinant,
)
from dyntorch.algebra.rank_two import cofactors, null_vectors
from dyntorch.eigenspace import real_eigenvalues
from dyntorch.nullspace import gram_null_space

BEAM = 243
"""Scales that are kept while planes are added: every choice of up to six planes."""
KEPT = 4
"""Choices of scales that are solved to the end."""
RIDGE = 1e-14  # of the trace: what keeps normal equations invertible


def infinity_closed_form(homographies: Tensor) -> tuple[Tensor, Tensor]:
    r"""The homography at infinity from three planes of translating bodies, or more, in closed form.

    1. :math:`H_1 - t_j H_j` is singular for the right scale: :math:`t_j` is an eigenvalue of :math:`H_j^{-1} H_1`, one of three.
    2. The choice of all :math:`t_j` for which all :math:`D_{ij}` are nearest to singular; the best few go on.
    3. Planes in general position: :math:`e_i` is where the left null vectors of the :math:`D_{ij}` meet, :math:`n_i` the same of
       the right ones, and :math:`H_\infty` the least squares solution of :math:`G_i = H_\infty + s_i e_i n_i^T`.  Collinear
       epipoles, where the left null vectors are one line: linear equations for two rows of :math:`H_\infty`.  Coplanar
       normals: the transposed problem.  A static plane is the solution itself.  All are solved, and the least residual of
       :func:`~dyntorch.algebra.rank_one_pencils.plane_parts` wins.

    It needs four planes where two are of one body, or one is static, and five where the epipoles are collinear and the normals
    coplanar too.

    Args:
        homographies: H ``(*batch, n, 3, 3)``, view 1 to view 2, of any scale, in coordinates of size 1 (normalized, the same ones
            for all planes).  A plane that is not finite is left out.

    Returns:
        :math:`H_\infty` ``(*batch, 3, 3)`` in float64, determinant 1, and the residual ``(*batch,)``, the root mean square over the
        planes; a problem without solution has some finite matrix.

    Raises:
        ValueError: fewer than three planes, or shapes that do not fit.

    Source: chapter 5 of the thesis asks for five planes; this is derived here.

    Example:
        >>> import torch
        >>> rand = torch.Generator().manual_seed(0)
        >>> e, n = torch.rand(2, 3, 3, generator=rand, dtype=torch.float64)
        >>> found, residual = infinity_closed_form(torch.eye(3) + e[:, :, None] * n[:, None, :])
        >>> found.round(decimals=6).abs().tolist(), float(residual) < 1e-9
        ([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], True)
    """
    check_homographies(homographies, 3)
    batch, count = homographies.shape[:-3], homographies.shape[-3]
    given, finite = finite_matrices(homographies.reshape(prod(batch), count, 3, 3))
    # those that are not finite last: the first plane is the one that all scales refer to
    finite, order = finite.sort(dim=-1, descending=True, stable=True)
    planes = unit_determinant(given.take_along_dim(order[..., None, None], dim=1))
    present = finite.double()[:, None]
    scaled = _choices(_scaled_candidates(planes), present)
    # the last candidates: each of the planes, if it is static
    found = torch.cat([*(solve(scaled, present) for solve in SOLVERS), planes], dim=1)
    found = unit_determinant(found.nan_to_num(0.0, 0.0, 0.0))
    errors = _mean(plane_parts(planes[:, None], found).residual.square()[..., None], present)[..., 0].sqrt()
    errors = torch.where((found == 0).flatten(-2).all(-1), 1.0, errors)  # all of a plane
    best = errors.argmin(-1, keepdim=True)
    residual = errors.gather(-1, best)[:, 0]
    found = found.take_along_dim(best[..., None, None], dim=1)[:, 0]
    return found.reshape(*batch, 3, 3), residual.reshape(batch)


def _scaled_candidates(planes: Tensor) -> Tensor:
    """``(b, n, 3, 3, 3)``: every plane with three scales, of which one goes with the first plane as it is.

    H_1 - t H_j is singular for the eigenvalues t of H_j^-1 H_1; real parts serve where noise made a pair complex.
    """
    inverse = cofactors(planes[:, 1:]).mT  # determinant 1
    ratios = real_eigenvalues(inverse @ planes[:, :1])
    ratios = torch.cat([torch.ones_like(planes[:, :1, 0]), ratios], dim=1)
    return ratios[..., None, None] * planes[:, :, None]


def _choices(candidates: Tensor, present: Tensor) -> Tensor:
    """``(b, k, n, 3, 3)``: the choices of scales for which the differences are nearest to singular."""
    cost = _pair_costs(candidates) * (present.mT * present)[..., None, None]
    b, n = candidates.shape[:2]
    chosen = torch.zeros(b, 1, 1, dtype=torch.long, device=candidates.device)
    total = cost.new_zeros(b, 1)
    for j in range(1, n):
        # cost[i, j, choice_i, .] summed over the planes i before j
        rows = [cost[:, i, j].gather(1, chosen[:, :, i, None].expand(-1, -1, 3)) for i in range(j)]
        more = (total[..., None] + torch.stack(rows).sum(0)).flatten(1)
        total, index = more.topk(min(BEAM, more.shape[1]), dim=1, largest=False)
        before = chosen.gather(1, (index // 3)[..., None].expand(-1, -1, j))
        chosen = torch.cat([before, (index % 3)[..., None]], dim=-1)
    chosen = chosen.gather(1, total.topk(min(KEPT, total.shape[1]), largest=False).indices[..., None].expand(-1, -1, n))
    return candidates[:, None].take_along_dim(chosen[..., None, None, None], dim=3)[:, :, :, 0]


def _pair_costs(candidates: Tensor) -> Tensor:
    """How far from singular the differences of two planes are, ``(b, n, n, 3, 3)``: scales of the first, of the second."""
    first, second = candidates[:, :, None, :, None], candidates[:, None, :, None, :]
    difference = first - second
    size = torch.linalg.matrix_norm(first) + torch.linalg.matrix_norm(second)
    minors = torch.linalg.matrix_norm(cofactors(difference))
    third = torch.linalg.det(difference).abs() / torch.where(minors > 0, minors, 1.0)
    # below rank two the quotient of two zeros says nothing
    return torch.minimum(third, second_singular_value(difference)) / torch.where(size > 0, size, 1.0)


def _general(planes: Tensor, present: Tensor) -> Tensor:
    """The solution ``(b, k, 3, 3)`` for scaled planes ``(b, k, n, 3, 3)`` in general position: all e_i, n_i, then least squares."""
    left, right = (gram_null_space(v.mT @ v).basis[..., 0, :] for v in _null_vectors(planes, present))
    outer = (left[..., :, None] * right[..., None, :]).flatten(-2)
    across = torch.eye(9, dtype=planes.dtype, device=planes.device) - outer[..., :, None] * outer[..., None, :]
    across = across * present[..., None, None]
    found = ridge_solution(across.sum(-3), (across @ planes.flatten(-2)[..., None]).sum(-3)[..., 0])
    return found.unflatten(-1, (3, 3))


def _collinear(planes: Tensor, present: Tensor) -> Tensor:
    r"""The solution for epipoles on one line l, where :math:`l^T G_i = l^T H_\infty` for all planes.

    The two other rows p, q of :math:`H_\infty` differ from those of :math:`G_i` by a matrix of rank one, so that
    :math:`(p_i - p) \times (q_i - q) = 0`.  Subtracting this equation for the mean leaves linear ones in p and q.
    """
    lines = _null_vectors(planes, present)[0].flatten(-3, -2)
    line, across = _leading(lines.mT @ lines)
    rows = across[..., None, :, :] @ planes
    centre = _mean(rows, present)
    p, q = (rows - centre[..., None, :, :]).unbind(-2)
    equations = torch.cat([-skew(q), skew(p)], dim=-1)
    constants = torch.linalg.cross(p, q)
    equations = (equations - _mean(equations, present)[..., None, :, :]) * present[..., None, None]
    constants = (constants - _mean(constants, present)[..., None, :]) * present[..., None]
    equations, constants = equations.flatten(-3, -2), constants.flatten(-2)
    found = ridge_solution(equations.mT @ equations, (equations.mT @ constants[..., None])[..., 0]).unflatten(-1, (2, 3))
    return across.mT @ (found + centre) + line[..., :, None] * (line[..., None, :] @ _mean(planes, present))


def _coplanar(planes: Tensor, present: Tensor) -> Tensor:
    """The solution for normals that are orthogonal to one direction: the transposed problem."""
    return _collinear(planes.mT, present).mT


SOLVERS = (_general, _collinear, _coplanar)


def _null_vectors(planes: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
    """Left and right null vectors ``(b, k, n, n, 3)`` of all differences, as long as these are far from rank one."""
    difference = planes[..., :, None, :, :] - planes[..., None, :, :, :]
    left, right = null_vectors(difference)
    strength = (second_singular_value(difference) * present[..., :, None] * present[..., None, :])[..., None]
    return left * strength, right * strength


def _mean(values: Tensor, present: Tensor) -> Tensor:
    """Over the planes ``(b, k, n, ...)`` that are present ``(b, 1, n)``."""
    weights = (present / present.sum(-1, keepdim=True).clamp(min=1.0))[(..., *([None] * (values.ndim - 3)))]
    return (values * weights).sum(2)


def _leading(gram: Tensor) -> tuple[Tensor, Tensor]:
    """The eigenvector ``(..., 3)`` of the largest eigenvalue, and two unit vectors ``(..., 2, 3)`` across it."""
    across = gram_null_space(gram, 2).basis
    return unit_vectors(torch.linalg.cross(across[..., 0, :], across[..., 1, :])), across


def ridge_solution(gram: Tensor, right: Tensor) -> Tensor:
    """Solution ``(..., k)`` of normal equations ``(..., k, k)``, finite for a singular matrix, as of parallel planes."""
    trace = gram.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    eye = torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
    inverse = torch.linalg.inv_ex(gram + (RIDGE * trace + torch.finfo(gram.dtype).tiny) * eye)[0]
    return (inverse @ right[..., None])[..., 0]
