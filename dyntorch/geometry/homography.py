"""Homographies of many weightings of the same matches: linear, affine, and by Levenberg-Marquardt on the Sampson distance.

As in :mod:`dyntorch.geometry.epipolar`, the matches are centred, of about unit size, and at the same scale in both views.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf
from typing import NamedTuple

import torch
from torch import Tensor

from dyntorch.geometry.epipolar import TINY, hartley, null_vector
from dyntorch.geometry.epipolar_fit import CAP, DESCENT, RIDGE
from dyntorch.geometry.homogeneous import homogeneous, unit_vectors
from dyntorch.numerics.blocks import map_blocks
from dyntorch.numerics.least_squares import Iterate, LeastSquares, Tensors, damped_step, minimize

BLOCK = 1 << 15
"""Matches times fits per block: the Jacobian, 15 numbers per match, stays in the cache."""


def homography_sampson_squared(H: Tensor, x1: Tensor, x2: Tensor) -> Tensor:
    r"""Squared Sampson distances of matches from a homography, in both views: H ``(*batch, 3, 3)``, x1, x2 ``(n, 2)`` ->
    ``(*batch, n)``."""

    def block(H: Tensor) -> Tensor:
        return _terms(H, x1, x2).distance

    distance = map_blocks(block, H.reshape(-1, 3, 3), size=max(1, BLOCK // max(1, len(x1))))
    return distance.reshape(*H.shape[:-2], len(x1))


def linear_homography(x1: Tensor, x2: Tensor, weights: Tensor) -> Tensor:
    r"""Linear fits of weighted matches, :math:`\min_{\|\hat H\|=1} \sum_i w_i \|c_i\|^2`, in Hartley's coordinates of each. x1,
    x2 ``(n, 2)``, weights ``(B, n)`` -> ``(B, 3, 3)``."""
    first = homogeneous(x1)
    outer = (first[:, :, None] * first[:, None, :])[:, None]  # (n, 1, 3, 3)
    factors = torch.cat([torch.ones_like(x1[:, :1]), x2, x2.square().sum(-1, keepdim=True)], dim=-1)
    sums = (weights @ (factors[..., None, None] * outer).flatten(1)).unflatten(-1, (4, 3, 3))
    gram = sums.new_zeros(len(sums), 3, 3, 3, 3)  # rows i, columns j of H: (i, j, k, l)
    gram[:, 0, :, 0] = gram[:, 1, :, 1] = sums[:, 0]
    gram[:, 0, :, 2] = gram[:, 2, :, 0] = -sums[:, 1]
    gram[:, 1, :, 2] = gram[:, 2, :, 1] = -sums[:, 2]
    gram[:, 2, :, 2] = sums[:, 3]
    second = torch.zeros_like(sums[:, 0])
    second[:, 0, 0], second[:, :2, 2], second[:, 2, 2] = sums[:, 3, 2, 2], sums[:, 1:3, 2, 2], sums[:, 0, 2, 2]
    here, there = hartley(sums[:, 0]), torch.linalg.inv(hartley(second))
    # vec(T2^-1 H T1) = (T2^-1 (x) T1^T) vec(H)
    change = (there[:, :, None, :, None] * here.mT[:, None, :, None, :]).reshape(-1, 9, 9)
    vector = (change @ null_vector(change.mT @ gram.reshape(-1, 9, 9) @ change)[..., None])[..., 0]
    return unit_vectors(vector).unflatten(-1, (3, 3))


def affine_homography(x1: Tensor, x2: Tensor, weights: Tensor) -> Tensor:
    r"""Affine maps :math:`x_2 = A x_1 + b` of least squares in view 2. x1, x2 ``(n, 2)``, weights ``(B, n)`` -> ``(B, 3, 3)``."""
    joint = torch.cat([x1, x2], dim=-1)
    total = weights.sum(-1, keepdim=True).clamp(min=TINY)
    centre = weights @ joint / total
    moments = (weights @ (joint[:, :, None] * joint[:, None, :2]).flatten(1) / total).unflatten(-1, (4, 2))
    moments = moments - centre[:, :, None] * centre[:, None, :2]
    inner, cross = moments[:, :2], moments[:, 2:]
    ridge = 1e-12 * inner.diagonal(dim1=-2, dim2=-1).sum(-1) + TINY
    inner = inner + ridge[:, None, None] * torch.eye(2, dtype=inner.dtype, device=inner.device)
    a, b, c = inner[:, 0, 0], inner[:, 0, 1], inner[:, 1, 1]
    adjoint = torch.stack([c, -b, -b, a], dim=-1).unflatten(-1, (2, 2))
    H = moments.new_zeros(len(moments), 3, 3)
    H[:, :2, :2] = cross @ adjoint / (a * c - b * b).clamp(min=TINY**2)[:, None, None]
    H[:, :2, 2] = centre[:, 2:] - (H[:, :2, :2] @ centre[:, :2, None])[..., 0]
    H[:, 2, 2] = 1.0
    return H


def homography(x1: Tensor, x2: Tensor, weights: Tensor, scale: float | None = None, steps: int = 3) -> tuple[Tensor, Tensor]:
    r"""The better of two descents, from the linear and from the affine fit. x1, x2 ``(n, 2)``, weights ``(B, n)`` ->
    ``(B, 3, 3)``."""
    starts = torch.cat([linear_homography(x1, x2, weights), affine_homography(x1, x2, weights)])
    H, cost = descend_homography(starts, x1, x2, weights.repeat(2, 1), scale, steps)
    (H, other), (cost, second) = H.chunk(2), cost.chunk(2)
    better = second < cost
    return torch.where(better[:, None, None], other, H), torch.minimum(cost, second)


def descend_homography(
    H: Tensor, x1: Tensor, x2: Tensor, weights: Tensor, scale: float | None = None, steps: int = 3
) -> tuple[Tensor, Tensor]:
    r"""Levenberg-Marquardt steps towards the least truncated Sampson distance, :math:`\sum_i w_i \min(d_i^2 / T^2,\ 2.25)`. H
    ``(B, 3, 3)``, x1, x2 ``(n, 2)``, weights ``(B, n)`` -> ``(B, 3, 3)``."""
    inverse, cap = (1.0, inf) if scale is None else (1 / scale**2, CAP)
    size = max(1, BLOCK // max(1, weights.shape[-1]))

    def block(H: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        problem = HomographyProblem(x1, x2, weights, inverse, cap)
        found = minimize(problem, problem.evaluate((H,)), replace(DESCENT, iterations=steps))
        return found.theta[0], found.cost

    found, cost = map_blocks(block, H, weights, size=size)
    return found, cost


@dataclass(frozen=True)
class HomographyProblem(LeastSquares):
    """Truncated Sampson distances of matches ``(n, 2)`` with weights ``(b, n)`` from homographies ``(b, 3, 3)``."""

    x1: Tensor
    x2: Tensor
    weights: Tensor
    inverse: float
    """Of the squared scale."""
    cap: float

    def evaluate(self, theta: Tensors) -> Iterate:
        """Of homographies of norm 1."""
        H = unit_vectors(theta[0].flatten(1)).unflatten(-1, (3, 3))
        terms = _terms(H, self.x1, self.x2)
        return Iterate((H,), _msac(terms, self.weights, self.inverse, self.cap), terms)

    def step(self, at: Iterate, damping: Tensor) -> Tensors:
        """By the matches that are not truncated, smoothly."""
        terms = _Terms(*at.terms)
        weighted = self.weights * (1 - terms.distance * (self.inverse / self.cap)).clamp(min=0)
        matrix, gradient = _normal_equations(at.theta[0], terms, self.x1, self.x2, weighted)
        return (damped_step(gradient, matrix, damping, ridge=RIDGE).unflatten(-1, (3, 3)),)


class _Terms(NamedTuple):
    """Of every match ``(*batch, n)``: what the Sampson distance consists of."""

    depth: Tensor  # h_3 (x_1, 1)
    first: Tensor  # entries of J J^T
    mixed: Tensor
    second: Tensor
    one: Tensor  # (J J^T)^-1 c
    two: Tensor
    distance: Tensor  # squared


def _slopes(H: Tensor, x2: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Derivatives of both constraints by the point of view 1, ``(*batch, n)`` each."""
    x, y = x2.unbind(-1)
    h = H[..., None]
    third = h[..., 2, 0, :], h[..., 2, 1, :]
    return (
        h[..., 0, 0, :] - x * third[0],
        h[..., 0, 1, :] - x * third[1],
        h[..., 1, 0, :] - y * third[0],
        h[..., 1, 1, :] - y * third[1],
    )


def _terms(H: Tensor, x1: Tensor, x2: Tensor) -> _Terms:
    u, v, depth = (H @ homogeneous(x1).mT).unbind(-2)
    c, d = u - x2[:, 0] * depth, v - x2[:, 1] * depth
    a0, a1, b0, b1 = _slopes(H, x2)
    square = depth.square()
    first, second, mixed = a0 * a0 + a1 * a1 + square, b0 * b0 + b1 * b1 + square, a0 * b0 + a1 * b1
    det = (first * second - mixed * mixed).clamp_(min=TINY)
    one, two = (second * c - mixed * d) / det, (first * d - mixed * c) / det
    return _Terms(depth, first, mixed, second, one, two, (one * c + two * d).clamp_(min=0))


def _msac(terms: _Terms, weights: Tensor, inverse: float, cap: float) -> Tensor:
    return torch.linalg.vecdot((terms.distance * inverse).clamp_(max=cap), weights)


def _normal_equations(H: Tensor, terms: _Terms, x1: Tensor, x2: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    r"""Matrix ``(b, 9, 9)`` and the exact gradient ``(b, 9)`` of half the weighted sum of squared distances."""
    a0, a1, b0, b1 = _slopes(H, x2)
    one, two = terms.one, terms.two
    corrected = torch.stack([x1[:, 0] - a0 * one - b0 * two, x1[:, 1] - a1 * one - b1 * two, torch.ones_like(one)], dim=1)
    points = homogeneous(x1).mT
    last = [-x * corrected - (terms.depth * part)[:, None] * points for x, part in zip(x2.unbind(-1), (one, two), strict=True)]
    slopes = torch.cat([corrected, *last], dim=1) @ torch.stack([weights * one, weights * two], dim=-1)
    gradient = torch.cat([slopes[:, :3, 0], slopes[:, :3, 1], slopes[:, 3:6, 0] + slopes[:, 6:, 1]], dim=-1)
    # the rows (corrected, 0, last_1) and (0, corrected, last_2), whitened by (J J^T)^-1 = R R^T with R lower triangular
    det = (terms.first * terms.second - terms.mixed * terms.mixed).clamp_(min=TINY)
    second = terms.second.clamp(min=TINY)
    corner, root = (weights * second / det).sqrt()[:, None], (weights / second).sqrt()[:, None]
    mixed = -(terms.mixed / second)[:, None] * corner
    white = torch.cat([corrected * corner, corrected * mixed, (last[0] * corner).addcmul_(last[1], mixed)], dim=1)
    other = torch.cat([corrected, last[1]], dim=1) * root
    matrix, h = white @ white.mT, H.flatten(1)
    matrix[:, 3:, 3:] += other @ other.mT
    # the scale of H is free
    gauge = matrix.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None] * h[:, :, None] * h[:, None, :]
    return matrix + gauge, gradient
