r"""Rows of moving shapes: what one affine view of n points at a known time says, linear in the unknowns."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.algebra.dynamic_shape_basis import Trajectory
from dyntorch.algebra.dynamic_shape_descent import centred_views, framed
from dyntorch.algebra.dynamic_shape_linear import shapes_through
from dyntorch.algebra.shape_rows import centred
from dyntorch.constants import constant

Base = tuple[int, int, int, int]


@constant
def arranged(n: int, base: Base, device: torch.device) -> Tensor:
    """Indices of the four basis points, then of all others in order."""
    return torch.tensor([*base, *(i for i in range(n) if i not in base)], device=device)


def graph_rows(measured: Tensor, trajectory: Trajectory, base: Base) -> Tensor:
    r"""Rows of :math:`D(t) x_j = \sum_{i=1}^4 N_{ij}(t) x_i` with :math:`\sum_i N_{ij} = D` eliminated.

    Differences from the fourth basis point leave :math:`D(t)(x_j - x_4) = \sum_{i \le 3} N_{ij}(t) (x_i - x_4)`, in which the
    sums are gone.

    Args:
        measured: ``(*batch, views, n, 4)``: x, y, 1 where seen (else three zeros), and the time.
        trajectory: of the points; D and N are products of three of its functions, K in number.
        base: the basis points.

    Returns:
        ``(*batch, views, 2 (n - 4), K (1 + 3 (n - 4)))``; unknowns: D, then :math:`N_{1j}, N_{2j}, N_{3j}` point by point.
        Zero rows for points that the view misses, all of them where it misses a basis point.
    """
    n = measured.shape[-2]
    order = arranged(n, base, measured.device)
    seen = measured[..., order, 2] > 0
    points = centred_views(measured[..., :2], measured[..., 2]).x[..., order, :]
    use = (seen[..., 4:] & seen[..., :4].all(-1, keepdim=True)).to(points.dtype)[..., None]
    y = points[..., :3, :] - points[..., 3:4, :]
    z = (points[..., 4:, :] - points[..., 3:4, :]) * use
    powers = trajectory.power(3).rows(measured[..., 0, 3])  # (.., K)
    first = z[..., None] * powers[..., None, None, :]  # (.., m, 2, K)
    own = torch.eye(n - 4, dtype=z.dtype, device=z.device)[:, None, :, None, None] * use[..., None, None, None]
    rest = -y.mT[..., None, :, None, :, None] * powers[..., None, None, None, None, :]  # (.., 1, 2, 1, 3, K)
    return torch.cat([first, (own * rest).flatten(-3)], dim=-1).flatten(-3, -2)


def span_rows(measured: Tensor) -> Tensor:
    """The two centred coordinates of each view, ``(*batch, views, 2, n - 1)``; 0 where a point is missing."""
    n = measured.shape[-2]
    whole = (measured[..., 2] > 0).all(-1)[..., None, None]
    return torch.where(whole, centred_views(measured[..., :2]).x.mT @ centred(n, measured.device).mT, 0.0)


def span_residual(measured: Tensor, basis: Tensor) -> Tensor:
    """Part of the energy of each view ``(*batch, views, n, 3)`` in the directions ``basis (*batch, k, n - 1)``; 1 for no view."""
    rows = span_rows(measured)
    energy = rows.square().sum((-2, -1))
    left = (rows @ basis.mT[..., None, :, :]).square().sum((-2, -1))
    return torch.where(energy > 0, left / torch.where(energy > 0, energy, 1.0), 1.0)


def annihilator(unknowns: Tensor, n: int, base: Base) -> Tensor:
    r"""The polynomial matrix N(t) with :math:`N(t)^T x = 0` and :math:`N(t)^T 1 = 0`.

    Args:
        unknowns: ``(*batch, K (1 + 3 m))`` of :func:`graph_rows`, m = n - 4.
        n: number of points.
        base: the basis points.

    Returns:
        ``(*batch, K, n, m)`` coefficients of the basis functions.
    """
    m = n - 4
    scale, slopes = _split(unknowns, m)
    size = scale.shape[-1]
    eye = torch.eye(m, dtype=unknowns.dtype, device=unknowns.device)
    above = slopes.movedim(-1, -3).mT  # (.., K, 3, m)
    fourth = scale[..., None, None] - above.sum(-2, keepdim=True)
    matrix = torch.cat([above, fourth, -scale[..., None, None] * eye], dim=-2)
    order = arranged(n, base, unknowns.device).argsort()
    return matrix[..., order, :].reshape(*unknowns.shape[:-1], size, n, m)


def unknowns_of(matrix: Tensor, base: Base) -> Tensor:
    """The inverse of :func:`annihilator`."""
    n = matrix.shape[-2]
    ordered = matrix[..., arranged(n, base, matrix.device), :]
    scale = -ordered[..., 4:, :].diagonal(dim1=-2, dim2=-1).mean(-1)
    return torch.cat([scale, ordered[..., :3, :].mT.movedim(-3, -1).flatten(-3)], dim=-1)


def _split(unknowns: Tensor, m: int) -> tuple[Tensor, Tensor]:
    """D ``(*batch, K)`` and N ``(*batch, m, 3, K)``."""
    size = unknowns.shape[-1] // (1 + 3 * m)
    return unknowns[..., :size], unknowns[..., size:].unflatten(-1, (m, 3, size))


def graph_of(shapes: Tensor, trajectory: Trajectory, base: Base) -> Tensor:
    """The unknowns ``(*batch, K (1 + 3 m))`` of :func:`graph_rows`, of any scale, of shapes ``(*batch, B, n, 3)``: brackets."""
    n = shapes.shape[-2]
    rows, inverse = _samples(trajectory, shapes.device)
    every = torch.einsum("gb,...bnk->...gnk", rows, shapes)[..., arranged(n, base, shapes.device), :]
    y, z = every[..., :3, :] - every[..., 3:4, :], every[..., 4:, :] - every[..., 3:4, :]
    sides = torch.linalg.cross(y[..., [1, 2, 0], :], y[..., [2, 0, 1], :])
    scale = (y[..., 0, :] * sides[..., 0, :]).sum(-1)  # (.., g)
    slopes = (z @ sides.mT).flatten(-2)  # (.., g, 3 m)
    scale, slopes = (inverse @ scale[..., None])[..., 0], inverse @ slopes
    return torch.cat([scale, slopes.mT.flatten(-2)], dim=-1)


def shapes_of_graph(unknowns: Tensor, n: int, trajectory: Trajectory, base: Base) -> Tensor:
    """The shapes ``(*batch, B, n, 3)`` nearest to the unknowns of :func:`graph_rows`, centroids 0."""
    rows, _ = _samples(trajectory, unknowns.device)
    m = n - 4
    scale, slopes = _split(unknowns.reshape(-1, unknowns.shape[-1]), m)
    powers = trajectory.power(3).rows(_nodes(trajectory, unknowns.device))
    eye = torch.eye(4, 3, dtype=unknowns.dtype, device=unknowns.device)
    above = (scale @ powers.mT)[..., None, None] * eye
    below = torch.einsum("gk,xmik->xgmi", powers, slopes)
    points = torch.cat([above, below], dim=-2)[..., arranged(n, base, unknowns.device).argsort(), :]
    helmert = centred(n, unknowns.device)
    problems = len(points)
    found = shapes_through(helmert @ points, rows.expand(problems, *rows.shape), points.new_ones(problems, len(rows)))
    return (helmert.mT @ found).reshape(*unknowns.shape[:-1], trajectory.size, n, 3)


def beside(shapes: Tensor) -> Tensor:
    """``(*batch, B, n, 3)`` to ``(*batch, n, 3 B)``."""
    return shapes.transpose(-3, -2).flatten(-2)


def apart(shapes: Tensor) -> Tensor:
    """``(*batch, n, 3 B)`` to ``(*batch, B, n, 3)``."""
    return shapes.unflatten(-1, (shapes.shape[-1] // 3, 3)).transpose(-3, -2)


def framed_beside(shapes: Tensor) -> Tensor:
    """Shapes ``(*batch, B, n, 3)`` in their canonical frame, side by side."""
    return beside(framed(shapes.reshape(-1, *shapes.shape[-3:])).reshape(shapes.shape))


@constant
def _nodes(trajectory: Trajectory, device: torch.device) -> Tensor:
    return trajectory.nodes(2 * trajectory.power(3).size).to(device)


@constant
def _samples(trajectory: Trajectory, device: torch.device) -> tuple[Tensor, Tensor]:
    """Values of the functions at the nodes ``(g, B)``, and from values at the nodes to coefficients of products ``(K, g)``."""
    nodes = _nodes(trajectory, device)
    return trajectory.rows(nodes), torch.linalg.pinv(trajectory.power(3).rows(nodes))
