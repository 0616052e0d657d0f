"""The row-band profile: how much moves up, down and sideways, at which height of the box, frame by frame."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool1d, normalize

from indexing.brightness.features import blur, gradients, weighted_differences

SIGMA = 1.5  # px of the 96 px crop
BANDS = 6  # rows 4..12: the same
QUIET = 2.0
"""Times the median brightness change, below which change is noise.  Share within 1 frame at 0 / 2 / 4, training seeds: CMU in
place, 70 frames, noise 8: .78 / .88 / .82; walking and running .68 / .72 / .72; 150 frames: all the same."""
REACH, RIDGE = 3, 0.05
"""Frames on either side that are whitened together, and the ridge.  Share within 1 frame of 218 training pairs of all kinds: no
neighbours, ridge .1: .86; reach 2 / 3 / 4 / 6, ridge .1: .89 / .90 / .90 / .90; reach 3, ridge .03 / .2: .91 / .87."""
BLOCK = 32  # frames at once


def row_profile(crops: Tensor, bands: int = BANDS) -> Tensor:
    """``(T, 3 * bands)`` motion upwards, downwards and sideways in ``bands`` rows that overlap by half, of crops ``(T, s, s)``.

    Square roots of means over the full width: cameras that stand upright share the height of what they see, not its place across,
    and the sign of sideways motion depends on the side from which a camera looks.
    """
    parts = []
    for begin in range(0, len(crops), BLOCK):
        first, end = max(begin - 1, 0), min(begin + BLOCK + 1, len(crops))
        gx, gy, gt = gradients(blur(crops[first:end], SIGMA))
        gt = gt.sign() * (gt.abs() - QUIET * gt.abs().median()).clamp(min=0)
        u, v = weighted_differences(gx, gy, gt)
        parts.append(_pooled(u, v, bands)[begin - first : begin - first + BLOCK])
    return torch.cat(parts)


def reversed_profile(profile: Tensor) -> Tensor:
    """The profile of the same take played backwards: what moved up moves down."""
    up, down, across = profile.flip(0).chunk(3, dim=1)
    return torch.cat([down, up, across], dim=1)


def _pooled(u: Tensor, v: Tensor, bands: int) -> Tensor:
    rows = torch.stack([(-v).clamp(min=0).mean(-1), v.clamp(min=0).mean(-1), u.abs().mean(-1)], dim=1)  # (T, 3, s)
    step = rows.shape[-1] // (bands + 1)
    pooled = avg_pool1d(rows, 2 * step, step)[..., :bands]
    return pooled.sqrt().flatten(1).double()


def whitened(first: Tensor, second: Tensor, ridge: float = RIDGE, reach: int = REACH) -> tuple[Tensor, Tensor]:
    r"""Both cameras' profiles in space and time: centred, whitened by the covariance that they share, of norm 1 per frame.

    .. math:: z_t \leftarrow \frac{W (y_t - \bar y)}{\|\cdot\|},\quad y_t = (z_{t-3}, \dots, z_{t+3}),\quad
        W = (C + \rho\,\lambda_{max} I)^{-1/2},\quad C = (C_a + C_b) / 2

    Whitening takes the slow part away that all motion has in common; the ridge :math:`\rho` keeps short takes from blowing up
    noise.  At the ends the first and the last profile are repeated; rows with NaN (missing frames) nearby become 0.

    Args:
        first, second: ``(T, D)``, of lengths of their own.

    Returns:
        ``(T, (2 reach + 1) D)`` each.
    """
    around = torch.arange(-reach, reach + 1)
    stacked = [z[(torch.arange(len(z))[:, None] + around).clamp(0, len(z) - 1)].flatten(1) for z in (first, second)]
    known = [y.isfinite().all(1) for y in stacked]
    centred = [y - y[seen].mean(0) for y, seen in zip(stacked, known, strict=True)]
    a, b = (y[seen] for y, seen in zip(centred, known, strict=True))
    root = inverse_root((a.T @ a / len(a) + b.T @ b / len(b)) / 2, ridge)
    one, two = (normalize((y @ root).nan_to_num(0.0), dim=1, eps=1e-9) for y in centred)
    return one, two


def inverse_root(matrix: Tensor, ridge: float) -> Tensor:
    """``(M + ridge * largest eigenvalue * I)^(-1/2)`` of a symmetric positive matrix ``(D, D)``."""
    values, vectors = torch.linalg.eigh(matrix)
    values = values.clamp(min=0) + ridge * values[-1].clamp(min=1e-30)
    return (vectors / values.sqrt()) @ vectors.T
