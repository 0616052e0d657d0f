r"""The epipolar coordinates of one camera's points as combinations of the other's, by ridge regression of most evidence.

.. math:: y_j(t) = \sum_i x_i(t)\,Q_{ij} + e_j(t), \qquad Q \sim N(0, \tau^2), \quad e \sim N(0, s^2)

in many pairs of directions at once.  Where points are affine combinations of the others' points, their mean places obey the same
Q, but for the scale c and the offset o between the two cameras' coordinates, :math:`\sum_i Q_{ij} = c` and
:math:`\bar y_j = \sum_i \bar x_i Q_{ij} + o`: two more rows, with c and o common to all j.  Then :math:`Q - c / n` is what is
expected near 0: about 0 itself, c would come out up to 40 % too small (CMU joints, 10 mm).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

LEAST, STEPS = 1e-22, 72
"""Smallest ridge over the largest eigenvalue of the Gram, and how many are tried from there to 1."""
FIRM = 10.0
"""Weight of the row of sums, times the largest singular value."""
BLOCKS = 5
"""Stretches of time that are predicted from the others."""


@dataclass(frozen=True)
class Ridge:
    """Regressions in g pairs of directions.

    Attributes:
        evidence: ``(g,)`` log likelihood of y with Q integrated out.
        ridge: ``(g,)`` :math:`s^2 / \\tau^2`.
        variance: ``(g,)`` s^2.
        gauge: ``(g, 2)`` o and c; zero where the means were not given.
        precision: ``(g, 2, 2)`` inverse covariance of o and c.
    """

    evidence: Tensor
    ridge: Tensor
    variance: Tensor
    gauge: Tensor
    precision: Tensor


@dataclass(frozen=True)
class Rows:
    """Regressors and what they are to explain, with the rows of the means: ``x (g, F, n)``, ``y (g, F, m)``, ``free (g, F, 2)``.

    ``dropped`` rows were zero after a rotation of the rows, and left out.
    """

    x: Tensor
    y: Tensor
    free: Tensor
    dropped: int = 0

    @staticmethod
    def of(x: Tensor, y: Tensor, means: tuple[Tensor, Tensor] | None = None, dropped: int = 0) -> Rows:
        """``x (g, F, n)``, ``y (g, F, m)`` over time, and mean places ``(g, n)``, ``(g, m)`` where they count."""
        free = x.new_zeros(*x.shape[:2], 2)
        if means is None:
            return Rows(x, y, free, dropped)
        # the largest singular value to a factor of a few is all that is needed
        firm = FIRM * x.square().sum((1, 2)).sqrt()
        free[..., 1] = x.mean(-1)
        unit = free.new_zeros(len(free), 2, 2)
        unit[:, 0, 0], unit[:, 0, 1] = 1.0, means[0].mean(-1)
        x = torch.cat([x, means[0][:, None], firm[:, None, None].expand(-1, 1, x.shape[2])], dim=1)
        y = torch.cat([y, means[1][:, None], torch.zeros_like(means[1])[:, None]], dim=1)
        return Rows(x, y, torch.cat([free, unit], dim=1), dropped)


def regress(rows: Rows, *, means: bool) -> Ridge:
    """The ridge, common to all columns of y, of most evidence.

    Args:
        rows: of :meth:`Rows.of`.
        means: whether the rows of the means are among them, and c and o unknown.
    """
    u, s, _ = torch.linalg.svd(rows.x, full_matrices=False)
    inside, outside = u.mT @ rows.y, rows.y - u @ (u.mT @ rows.y)
    free, beyond = u.mT @ rows.free, rows.free - u @ (u.mT @ rows.free)
    # the part outside the regressors' span in few coordinates, without the cancellation of normal equations
    small = torch.linalg.qr(torch.cat([beyond, outside], dim=-1)).R
    beyond, outside = small[..., :2], small[..., 2:]
    energies = s.square()
    ridge = energies.amax(-1).clamp(min=1e-300)[:, None] * _grid(s)
    share = 1 / (energies[:, None] / ridge[..., None] + 1)  # (g, L, n)
    # c and o are common to all columns: what they change of squares summed over columns is the mean of the columns
    columns = rows.y.shape[2]
    inner, outer = inside.mean(-1), outside.mean(-1)
    spread, apart = (inside - inner[..., None]).square().sum(-1), (outside - outer[..., None]).square().sum((-2, -1))
    gauge = rows.x.new_zeros(*ridge.shape, 2)
    precision = gauge.new_zeros(*ridge.shape, 2, 2)
    if means:
        precision = free.mT[:, None] @ (share[..., None] * free[:, None]) + (beyond.mT @ beyond)[:, None]
        moment = (share * inner[:, None]) @ free + outer[:, None] @ beyond
        gauge = torch.linalg.solve_ex(precision, moment[..., None])[0][..., 0]
    left, rest = inner[:, None] - gauge @ free.mT, outer[:, None] - gauge @ beyond.mT
    cost = (share * (spread[:, None] + columns * left.square())).sum(-1) + apart[:, None] + columns * rest.square().sum(-1)
    count = (rows.y.shape[1] + rows.dropped) * columns - (2 if means else 0)
    variance = (cost / count).clamp(min=1e-300)
    level = -0.5 * count * variance.log() + 0.5 * columns * share.log().sum(-1)
    if means:
        level = level - 0.5 * torch.linalg.slogdet(precision + 1e-300).logabsdet
    best = level.nan_to_num(nan=-torch.inf).argmax(-1)
    pick = torch.arange(len(best), device=best.device), best
    scaled = precision[pick] * (columns / variance[pick])[:, None, None]
    return Ridge(level[pick], ridge[pick], variance[pick], gauge[pick], scaled)


def combinations(rows: Rows, ridge: Tensor, gauge: Tensor) -> Tensor:
    """Q ``(g, n, m)`` for a known ridge ``(g,)``, o and c ``(g, 2)``."""
    u, s, vt = torch.linalg.svd(rows.x, full_matrices=False)
    target = rows.y - rows.free @ gauge[..., None]
    found = vt.mT @ ((s / (s.square() + ridge[:, None]))[..., None] * (u.mT @ target))
    return found + gauge[:, 1, None, None] / rows.x.shape[2]


def predicted_apart(x: Tensor, y: Tensor, ridge: Tensor) -> Tensor:
    r"""Residuals of y where every stretch of time is predicted from all others, :math:`(I - H_{BB})^{-1} (y - H y)_B`.

    Args:
        x: ``(T, n)``; y: ``(T, m)``; ridge: a number, or ``(m,)``.

    Returns:
        ``(T, m)``.

    Source: Allen 1974 (PRESS), for blocks.
    """
    u, s, _ = torch.linalg.svd(x, full_matrices=False)
    energies = s.square()
    share = energies / (energies + ridge.reshape(-1, 1).clamp(min=1e-300))  # (1 or m, n)
    inside = u.mT @ y
    residual = y - u @ (share.mT * inside)
    pieces = []
    for rows in torch.arange(len(x), device=x.device).chunk(BLOCKS):
        part = u[rows]
        eye = torch.eye(len(rows), dtype=x.dtype, device=x.device)
        hat = (part * share[:, None]) @ part.mT
        # a stretch that alone shows some motion says nothing of it; the least shift keeps the matrix regular
        solved = torch.linalg.solve_ex(eye * (1 + 1e-12) - hat, residual[rows].mT[..., None].expand(y.shape[1], -1, 1))[0]
        pieces.append(solved[..., 0].mT)
    return torch.cat(pieces)


def ridges_apart(x: Tensor, y: Tensor) -> Tensor:
    """The ridge of most evidence of every column of ``y (T, m)`` by itself, given ``x (T, n)``: ``(m,)``."""
    u, s, _ = torch.linalg.svd(x, full_matrices=False)
    inside = u.mT @ y
    rest = (y - u @ inside).square().sum(0)
    energies = s.square()
    ridge = energies.amax().clamp(min=1e-300) * _grid(s)
    share = 1 / (energies / ridge[:, None] + 1)
    cost = share @ inside.square() + rest
    level = -0.5 * len(y) * cost.clamp(min=1e-300).log() + 0.5 * share.log().sum(-1, keepdim=True)
    return ridge[level.argmax(0)]


def _grid(like: Tensor) -> Tensor:
    return torch.logspace(0, 1, STEPS, base=1 / LEAST, dtype=like.dtype, device=like.device) * LEAST
