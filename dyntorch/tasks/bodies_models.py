"""Whether two views show a body as one with depth, or as a plane: a fundamental matrix or a homography."""

from __future__ import annotations

from dataclasses import dataclass
from math import log

import torch
from torch import Tensor

from dyntorch.algebra.epipolar import sampson_squared
from dyntorch.algebra.plane_homography import homography, homography_sampson_squared
from dyntorch.tasks.bodies_energy import View

LEAST_NOISE = 0.1
"""Least standard deviation of a coordinate, pixels: no detector is better, and exact data shows none."""


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

    with dimension d = 3 and k = 7 parameters of a fundamental matrix, d = 2 and k = 8 of a homography.

    Args:
        view: matches.
        fundamentals: ``(K, 3, 3)``.
        members: ``(K, n)`` weights.

    Source: Torr, Geometric motion segmentation and model selection, 1998.
    """
    count = members.sum(-1)
    epipolar = sampson_squared(fundamentals, view.x1, view.x2)
    # one coordinate of noise for both models: the fundamental matrix always fits, and costs seven degrees of freedom
    noise = _typical(epipolar, members) * count / (count - 7).clamp(min=1.0)
    noise = noise.clamp(min=(LEAST_NOISE * view.pixel) ** 2)
    plane = homography(view.x1, view.x2, members, scale=3 * view.pixel, steps=8)[0]
    planar = homography_sampson_squared(plane, view.x1, view.x2)
    first = _criterion(epipolar / noise[:, None], members, 3, 7)
    second = _criterion(planar / noise[:, None], members, 2, 8)
    return Models(plane, second < first)


def _typical(square: Tensor, members: Tensor) -> Tensor:
    """Variance ``(K,)`` by the weighted median of squared distances of one dimension."""
    order = square.argsort(-1)
    share = members.gather(-1, order).cumsum(-1)
    middle = (share >= 0.5 * share[:, -1:]).to(torch.int8).argmax(-1, keepdim=True)
    return square.gather(-1, order).gather(-1, middle)[:, 0] / 0.455


def _criterion(square: Tensor, members: Tensor, dimension: int, parameters: int) -> Tensor:
    count = members.sum(-1)
    fit = (square.clamp(max=2.0 * (4 - dimension)) * members).sum(-1)
    return fit + dimension * count * log(4) + parameters * (4 * count).clamp(min=1.0).log()
