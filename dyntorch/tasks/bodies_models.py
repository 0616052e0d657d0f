"""Whether two views show a body as one with depth, or as a plane: a fundamental matrix or a homography."""

from __future__ import annotations

from dataclasses import dataclass
from math import log

import torch
from torch import Tensor

from dyntorch.algebra.epipolar import sampson_squared
from dyntorch.algebra.plane_homography import homography, homography_sampson_squared
from dyntorch.chi_square import median
from dyntorch.tasks.bodies_energy import PIXELS, View

OFF, WIDE = 0.02, 1.5
"""Share of a planar body that may be off the plane, wrong matches that lie on its epipolar lines; and from which distance they are,
in thresholds (in two dimensions)."""
LEAST_NOISE = 0.1
"""Least standard deviation of a coordinate, pixels: no detector is better, and exact data shows none."""
TRUNCATED, KEPT = 6.25, 0.978
"""Squares of it count up to the first in the mean, which is the second then."""
ROUNDS = 10
TINY = 1e-30


@dataclass(frozen=True)
class Models:
    """Models of K bodies.

    Attributes:
        homographies: ``(K, 3, 3)`` of norm 1, best fits, whatever the choice.
        planar: ``(K,)`` bool, the homography explains the body.
    """

    homographies: Tensor
    planar: Tensor


def choose(view: View, fundamentals: Tensor, members: Tensor) -> Models:
    r"""The model with the smaller robust information criterion,

    .. math:: \sum_i \min\!\Big(\frac{e_i^2}{\sigma^2},\ 2 (4 - d)\Big) + n\,d \log 4 + k \log 4n,

    with dimension d = 3 and k = 7 parameters of a fundamental matrix, d = 2 and k = 8 of a homography.  The noise
    :math:`\sigma` is that of all bodies.  The sum bears a few matches off the plane; but a body is no plane if more than
    :data:`OFF` of it are farther than :data:`WIDE` thresholds.

    Args:
        view: matches.
        fundamentals: ``(K, 3, 3)``.
        members: ``(K, n)`` weights, of any scale.

    Source: Torr, Geometric motion segmentation and model selection, 1998.
    """
    # weights are relative: they count as so many equal ones
    members = members * (members.sum(-1) / members.square().sum(-1).clamp(min=TINY))[:, None]
    epipolar = sampson_squared(fundamentals, view.x1, view.x2)
    noise = _noise(epipolar, members).clamp(min=(LEAST_NOISE * view.pixel) ** 2)
    plane = homography(view.x1, view.x2, members, scale=3 * view.pixel, steps=8)[0]
    planar = homography_sampson_squared(plane, view.x1, view.x2)
    first = _criterion(epipolar / noise, members, 3, 7)
    second = _criterion(planar / noise, members, 2, 8)
    off = ((planar > (WIDE * PIXELS * view.pixel) ** 2) * members).sum(-1) / members.sum(-1).clamp(min=TINY)
    return Models(plane, (second < first) & (off <= OFF))


def _noise(square: Tensor, members: Tensor) -> Tensor:
    """Variance ``()`` of a coordinate by the distances ``(K, n)`` from the epipolar lines of all bodies.

    The homographies would overestimate it where there is depth.  The median alone is too uncertain (a plane of 100 matches was
    recognized in 7 of 10 cases): it starts a truncated mean.
    """
    every, weight = square.flatten(), members.flatten()
    order = every.argsort()
    share = weight[order].cumsum(0)
    total = share[-1].clamp(min=TINY)
    variance = every[order[(share >= 0.5 * total).to(torch.int8).argmax()]] / median(1)
    for _ in range(ROUNDS):
        variance = (every.minimum(TRUNCATED * variance) * weight).sum() / (KEPT * total)
    count = members.sum(-1)
    # the best F of a plane is the luckiest of a family: measured with 15 to 100 matches, its squares lack sqrt(2n) beyond 7
    freedom = (count - 7 - (2 * count).sqrt()).clamp(min=0).sum().clamp(min=1)
    return variance * total / freedom


def _criterion(square: Tensor, members: Tensor, dimension: int, parameters: int) -> Tensor:
    count = members.sum(-1)
    fit = (square.clamp(max=2.0 * (4 - dimension)) * members).sum(-1)
    return fit + dimension * count * log(4) + parameters * (4 * count).clamp(min=1.0).log()
