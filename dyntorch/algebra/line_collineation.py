"""Collineations as they act on lines: from a map of Pluecker coordinates back to the map of points."""

from __future__ import annotations

from itertools import combinations

import torch
from torch import Tensor

from dyntorch.algebra.extensors import join, plucker_form
from dyntorch.algebra.homogeneous import unit
from dyntorch.nullspace import null_space

PAIRS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))  # rows of the second compound matrix, as in Pluecker coordinates
TRIPLES = ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3))


def compound_root(matrix: Tensor) -> Tensor:
    r"""The collineation whose second compound matrix is given up to scale: :math:`\Lambda = c\, C_2(A)`.

    Row (i, j) of the compound matrix is the line through the rows i and j of A, taken as points.  Row i of A is thus the
    common point :math:`a_i` of three lines, up to a scale :math:`\rho_i`.  These scales follow from

    .. math:: k_{ij} = \langle a_i \wedge a_j, \Lambda_{ij} \rangle / \|a_i \wedge a_j\|^2 = c\, \rho_i \rho_j :

    the sign of c is that of :math:`k_{ij} k_{jl} k_{il}`, the rest is linear in the logarithms.

    Args:
        matrix: ``(*batch, 6, 6)`` of any scale and sign; with noise least squares in each step.

    Returns:
        ``(*batch, 4, 4)`` A of norm 1 and canonical sign; 0 for a matrix that is 0 or not finite.

    Raises:
        ValueError: another shape.

    Source: thesis section 8.4; the scales and signs, without which the rows are no collineation, are derived here.

    Example:
        >>> import torch
        >>> compound_root(-3 * torch.eye(6)).diagonal().tolist()
        [0.5, 0.5, 0.5, 0.5]
    """
    if matrix.ndim < 2 or matrix.shape[-2:] != (6, 6):
        raise ValueError(f"matrix must be (*batch, 6, 6), got {tuple(matrix.shape)}")
    good = (matrix.isfinite().flatten(-2).all(-1) & (matrix.abs().amax((-1, -2)) > 0))[..., None, None]
    safe = torch.where(good, matrix, torch.eye(6, dtype=matrix.dtype, device=matrix.device)).double()
    lines = safe / torch.linalg.matrix_norm(safe, keepdim=True)
    rows, ratio = compound_rows(lines, 4)
    return torch.where(good, unit(_scales(ratio)[..., None] * rows), torch.zeros_like(rows)).to(matrix.dtype)


def compound_rows(lines: Tensor, size: int) -> tuple[Tensor, Tensor]:
    r"""The rows of a matrix, up to a scale each, from its second compound matrix, up to scale as well.

    Args:
        lines: ``(*batch, size (size - 1) / 2, 6)``, the lines that pairs of rows span, in lexicographic order.
        size: number of rows.

    Returns:
        rows :math:`a_i` of norm 1 ``(*batch, size, 4)``, and :math:`k_{ij} = \langle a_i \wedge a_j, \Lambda_{ij} \rangle /
        \|a_i \wedge a_j\|^2`, one for each line.
    """
    pairs = list(combinations(range(size), 2))
    shared = torch.tensor([[p for p, pair in enumerate(pairs) if i in pair] for i in range(size)], device=lines.device)
    rows = common_point(lines[..., shared, :])
    first, second = torch.tensor(pairs, device=lines.device).unbind(-1)
    joined = join(rows[..., first, :], rows[..., second, :])
    square = joined.square().sum(-1)
    return rows, (joined * lines).sum(-1) / torch.where(square > 0, square, 1.0)


def common_point(lines: Tensor) -> Tensor:
    """The point ``(..., 4)`` of norm 1 that is nearest to all lines ``(..., k, 6)``."""
    # p lies on l iff the dual skew matrix takes it to 0
    return null_space(skew_line(lines @ plucker_form(dtype=lines.dtype, device=lines.device)).flatten(-3, -2))[..., 0, :]


def skew_line(lines: Tensor) -> Tensor:
    """The skew matrix P Q^T - Q P^T of each line, ``(..., 4, 4)``."""
    p01, p02, p03, p12, p13, p23 = lines.unbind(-1)
    o = torch.zeros_like(p01)
    entries = (o, p01, p02, p03, -p01, o, p12, p13, -p02, -p12, o, p23, -p03, -p13, -p23, o)
    return torch.stack(entries, dim=-1).unflatten(-1, (4, 4))


def _scales(ratio: Tensor) -> Tensor:
    r"""The scales :math:`\rho_i` of the rows from :math:`k_{ij} = c \rho_i \rho_j`, ``(*batch, 4)``, up to a common one."""
    place = {pair: p for p, pair in enumerate(PAIRS)}
    sign = torch.where(ratio < 0, -1.0, 1.0).to(ratio.dtype)
    triples = [sign[..., place[i, j]] * sign[..., place[j, k]] * sign[..., place[i, k]] for i, j, k in TRIPLES]
    common = torch.where(torch.stack(triples).sum(0) < 0, -1.0, 1.0).to(ratio.dtype)
    # least squares of log|rho_i| + log|rho_j| = log|k_ij|
    logs = ratio.abs().clamp(min=torch.finfo(ratio.dtype).tiny).log()
    sums = torch.stack([logs[..., [p for p, pair in enumerate(PAIRS) if i in pair]].sum(-1) for i in range(4)], dim=-1)
    size = ((sums - sums.sum(-1, keepdim=True) / 6) / 2).exp()
    turned = [torch.ones_like(common)] + [common * sign[..., place[0, j]] for j in range(1, 4)]
    return size * torch.stack(turned, dim=-1)
