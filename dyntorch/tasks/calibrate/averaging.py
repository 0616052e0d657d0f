r"""First cameras from epipolar geometry: relative rotations of pairs, rotations by averaging them, then centres and points.

With focal lengths for a start, every pair's F gives :math:`E = K_j^T F K_i` and from it the rotation :math:`R_{ij} = R_j R_i^T`.
All rotations at once are the three leading eigenvectors of the matrix of the :math:`w_{ij} R_{ij}`.  With rotations known, centres
and points follow from one more eigenvector: a point lies on the ray of every camera that sees it,

.. math:: \min_{\sum C = 0,\ |C| = 1}\ \sum_{ij} w_{ij}\, |(I - d_{ij} d_{ij}^T)(X_j - C_i)|^2, \qquad
    d_{ij} = R_i^T K_i^{-1} x_{ij},

from which each :math:`X_j` is eliminated in closed form.  Cameras on one line are no harder than others: no translation of a pair
is ever averaged.

Source: Arie-Nachimson et al. 2012, Global motion estimation from point matches; Pan et al. 2024, Global structure-from-motion
revisited (positions from rays).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from dyntorch.geometry.epipolar import sampson_squared
from dyntorch.geometry.epipolar_fit import fit_fundamental
from dyntorch.geometry.homogeneous import homogeneous
from dyntorch.geometry.rigid import nearest_rotation
from dyntorch.tasks.calibrate.input import RigViews


@dataclass(frozen=True)
class PairGeometry:
    """Epipolar geometry of two cameras."""

    F: Tensor  # ``(3, 3)``, :math:`x_j^T F x_i = 0` in ``unit`` from the principal points
    x1: Tensor  # ``(m, 2)`` matches in ``unit`` from the principal points
    x2: Tensor
    weights: Tensor  # ``(m,)``, 1 for those that agree
    unit: float  # pixels
    sigma: float  # px, robust standard deviation of the Sampson distance
    matches: int  # positions that both saw at once


Graph = Mapping[tuple[int, int], PairGeometry]


MAX_PAIR_MATCHES = 3_000  # that the F of a pair is fitted to


def pair_graph(views: RigViews, clocks: Tensor, fewest: int) -> dict[tuple[int, int], PairGeometry]:
    """Epipolar geometry of all pairs that see enough at once. clocks ``(c, 2)``."""
    seen = views.at(clocks[None])
    x, weights = seen.x[0].flatten(1, 2), seen.weights[0].flatten(1, 2)
    unit = float(views.centers.max()) * 2
    found = {}
    for i, j in combinations(range(len(x)), 2):
        both = ((weights[i] > 0) & (weights[j] > 0)).nonzero()[:, 0]
        if len(both) >= fewest:
            some = both[:: max(1, len(both) // MAX_PAIR_MATCHES)]
            x1, x2 = (x[i, some] - views.centers[i]) / unit, (x[j, some] - views.centers[j]) / unit
            found[i, j] = _fit_pair(x1, x2, unit, len(both))
    return found


FIRST_CUTOFFS = (40.0, 20.0, 10.0)  # of the fit of F, thousandths of the longer side
LAST_CUTOFFS = (2.5, 1.5)  # of the fit of F, robust standard deviations of the residual


def _fit_pair(x1: Tensor, x2: Tensor, unit: float, matches: int) -> PairGeometry:
    weights = torch.ones(1, len(x1), dtype=torch.float64)
    F, _ = fit_fundamental(x1, x2, weights, [1e-3 * scale for scale in FIRST_CUTOFFS])
    sigma = _spread(F[0], x1, x2)
    F, _ = fit_fundamental(x1, x2, weights, [scale * sigma for scale in LAST_CUTOFFS], F[:, None])
    sigma = _spread(F[0], x1, x2)
    inside = sampson_squared(F[0], x1, x2) <= (LAST_CUTOFFS[0] * sigma) ** 2
    return PairGeometry(F[0], x1, x2, inside.double(), unit, sigma * unit, matches)


def _spread(F: Tensor, x1: Tensor, x2: Tensor) -> float:
    return max(1.4826 * float(sampson_squared(F, x1, x2).sqrt().median()), 1e-9)


def relative_rotations(pair: PairGeometry, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """The two rotations ``(s, 2, 3, 3)`` from camera i to camera j for focal lengths ``(s,)`` of both, and the share ``(s, 2)`` of
    matches before both cameras."""
    f1, f2 = first / pair.unit, second / pair.unit
    one, other = (torch.stack([f, f, torch.ones_like(f)], dim=-1) for f in (f1, f2))
    U, _, Vt = torch.linalg.svd(other[:, :, None] * pair.F * one[:, None])
    U, Vt = U * torch.linalg.det(U)[:, None, None], Vt * torch.linalg.det(Vt)[:, None, None]
    W = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    turns = torch.stack([U @ W @ Vt, U @ W.mT @ Vt], dim=1)
    # (s, 2, 3, m): rays of i in the frame of j
    here = turns @ homogeneous(pair.x1 / f1[:, None, None])[:, None].mT
    there = homogeneous(pair.x2 / f2[:, None, None])[:, None].mT
    # depths of z_2 d_2 = z_1 R d_1 + b by cross products: their signs are enough
    across = torch.linalg.cross(here, there.expand_as(here), dim=-2)
    base = U[:, None, :, 2:].expand_as(here)
    first_sign = (torch.linalg.cross(there.expand_as(here), base, dim=-2) * across).sum(-2)
    second_sign = (torch.linalg.cross(here, base, dim=-2) * across).sum(-2)
    before = ((first_sign > 0) & (second_sign > 0)).double() @ pair.weights
    behind = ((first_sign < 0) & (second_sign < 0)).double() @ pair.weights
    return turns, torch.maximum(before, behind) / pair.weights.sum().clamp(min=1.0)


AVERAGING_ITERATIONS = 6  # in which the weights of the pairs' rotations are learned
HALF_WEIGHT_DISTANCE = 0.1  # Frobenius norm between two rotations (4 degrees) at which a pair's weight is a half


def average_rotations(turns: Mapping[tuple[int, int], Tensor], weights: Mapping[tuple[int, int], float], cameras: int) -> Tensor:
    """Rotations ``(c, 3, 3)`` whose ratios :math:`R_j R_i^T` are nearest to given ones; the first is the identity."""
    soft = dict.fromkeys(turns, 1.0)
    R = torch.eye(3, dtype=torch.float64).repeat(cameras, 1, 1)
    for _ in range(AVERAGING_ITERATIONS):
        blocks = torch.zeros(cameras, 3, cameras, 3, dtype=torch.float64)
        degree = torch.zeros(cameras, dtype=torch.float64)
        for (i, j), turn in turns.items():
            w = weights[i, j] * soft[i, j]
            blocks[j, :, i], blocks[i, :, j] = w * turn, w * turn.mT
            degree[[i, j]] += w
        root = degree.clamp(min=1e-12).rsqrt()
        blocks = blocks * root[:, None, None, None] * root[:, None]
        leading = torch.linalg.eigh(blocks.reshape(3 * cameras, 3 * cameras)).eigenvectors[:, -3:]
        stacked = leading.view(cameras, 3, 3) * root[:, None, None]
        R = nearest_rotation(stacked if float(torch.linalg.det(stacked).sum()) > 0 else -stacked)
        away = {(i, j): float((R[j] @ R[i].mT - turn).norm()) for (i, j), turn in turns.items()}
        soft = {pair: 1 / (1 + (value / HALF_WEIGHT_DISTANCE) ** 2) for pair, value in away.items()}
    return R @ R[0].mT


def _across(R: Tensor, rays: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Rays ``(c, m, 3)`` in the world, and the projectors across them times the weights, ``(c, m, 3, 3)``."""
    d = normalize(rays @ R, dim=-1)
    eye = torch.eye(3, dtype=torch.float64)
    return d, weights[..., None, None] * (eye - d[..., :, None] * d[..., None, :])


def nearest_points(R: Tensor, centers: Tensor, rays: Tensor, weights: Tensor) -> Tensor:
    """Points ``(m, 3)`` nearest to the rays of all cameras."""
    _, across = _across(R, rays, weights)
    inverse = torch.linalg.pinv(across.sum(0), hermitian=True)
    return (inverse @ torch.einsum("amij,aj->mi", across, centers)[..., None])[..., 0]


def position_cameras(R: Tensor, rays: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Centres ``(c, 3)`` and points ``(m, 3)`` from rotations and rays, as the equation of this file says."""
    c = len(R)
    weights = weights * ((weights > 0).sum(0) >= 2)
    d, across = _across(R, rays, weights)
    inverse = torch.linalg.pinv(across.sum(0), hermitian=True)
    matrix = torch.block_diag(*across.sum(1)) - torch.einsum("amij,mjk,bmkl->aibl", across, inverse, across).reshape(3 * c, 3 * c)
    # a shift of all changes nothing: those three directions are lifted above all others
    shift = torch.eye(3, dtype=torch.float64).repeat(c, 1) / c**0.5
    matrix = matrix + shift @ shift.mT * matrix.diagonal().sum()
    centers = torch.linalg.eigh(matrix).eigenvectors[:, 0].view(c, 3)
    points = (inverse @ torch.einsum("amij,aj->mi", across, centers)[..., None])[..., 0]
    ahead = ((points - centers[:, None]) * d).sum(-1)
    sign = -1.0 if float((ahead.sign() * weights).sum()) < 0 else 1.0
    return sign * centers, sign * points


def first_cameras(views: RigViews, graph: Graph, clocks: Tensor, focals: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rotations ``(s, c, 3, 3)``, centres ``(s, c, 3)`` and points ``(s, T, n, 3)`` for focal lengths ``(s, c)`` px."""
    found = {(i, j): relative_rotations(pair, focals[:, i], focals[:, j]) for (i, j), pair in graph.items()}
    starts = []
    for start, own in enumerate(focals):
        turns, weights = {}, {}
        for place, (both, share) in found.items():
            best = int(share[start].argmax())
            turns[place], weights[place] = both[start, best], float(graph[place].weights.sum() * share[start, best])
        R = average_rotations(turns, weights, len(own))
        centers, points = position_cameras(R, *viewing_rays(views, clocks, own))
        starts.append((R, centers, points.view(len(views.times), -1, 3)))
    R, centers, points = (torch.stack(part) for part in zip(*starts, strict=True))
    return R, centers, points


def viewing_rays(views: RigViews, clocks: Tensor, focals: Tensor) -> tuple[Tensor, Tensor]:
    """Rays ``(c, m, 3)`` of all positions in the cameras' frames, lenses apart, and weights ``(c, m)``."""
    seen = views.at(clocks[None])
    rays = homogeneous((seen.x[0] - views.centers[:, None, None]) / focals[:, None, None, None])
    return rays.flatten(1, 2), (seen.weights[0] > 0).double().flatten(1, 2)
