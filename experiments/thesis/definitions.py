"""Scenes written from the thesis's definitions alone, exact, in double precision; apart from ``dyntorch.scenes``."""

from __future__ import annotations

import torch
from torch import Tensor

FOCAL, CENTRE = 800.0, (320.0, 240.0)


def seeded(seed: int) -> torch.Generator:
    """A generator of its own for every scene."""
    return torch.Generator().manual_seed(seed)


def normal(*shape: int, draw: torch.Generator) -> Tensor:
    """Standard normal numbers."""
    return torch.randn(*shape, generator=draw, dtype=torch.float64)


def uniform(*shape: int, draw: torch.Generator) -> Tensor:
    """Numbers between -1 and 1."""
    return 2 * torch.rand(*shape, generator=draw, dtype=torch.float64) - 1


def homogeneous(points: Tensor) -> Tensor:
    """A last coordinate of 1."""
    return torch.cat([points, torch.ones_like(points[..., :1])], -1)


def inhomogeneous(points: Tensor) -> Tensor:
    """Divided by the last coordinate, which goes."""
    return points[..., :-1] / points[..., -1:]


def mapped(points: Tensor, matrix: Tensor) -> Tensor:
    """Inhomogeneous points under a collineation or a camera."""
    return inhomogeneous(homogeneous(points) @ matrix.mT)


def apart(a: Tensor, b: Tensor) -> float:
    """Distance of two tensors as points of a projective space: both at norm 1, up to sign."""
    a, b = a.flatten() / a.norm(), b.flatten() / b.norm()
    return float(torch.minimum((a - b).norm(), (a + b).norm()))


def rank(rows: Tensor, tolerance: float = 1e-9) -> int:
    """Numerical rank of rows at unit length; exact data leave singular values of about 1e-15, so that a fixed bound decides."""
    values = torch.linalg.svdvals(rows / rows.norm(dim=-1, keepdim=True))
    return int((values > tolerance * values[0]).sum())


def products(*factors: Tensor) -> Tensor:
    """Outer products of vectors ``(n, d)``, flattened: the rows of an estimation matrix."""
    rows = factors[0]
    for factor in factors[1:]:
        rows = (rows[:, :, None] * factor[:, None, :]).flatten(1)
    return rows


def matrix_rank(views: tuple[Tensor, ...]) -> int:
    """Of the estimation matrix of points, from its definition."""
    return rank(products(*(homogeneous(view) for view in views)))


def rotation(angles: Tensor) -> Tensor:
    """Of three angles, about the axes in turn."""
    skew = torch.zeros(3, 3, 3, dtype=torch.float64)
    skew[0, 2, 1] = skew[1, 0, 2] = skew[2, 1, 0] = 1
    skew = skew - skew.mT
    turned: Tensor = torch.linalg.multi_dot([torch.linalg.matrix_exp(angle * s) for angle, s in zip(angles, skew, strict=True)])
    return turned


def cameras(count: int, draw: torch.Generator, distance: float = 6.0, turn: float = 0.25) -> Tensor:
    """Cameras ``K [R | t]`` that look at the origin from a few units away, pixels; each angle is at most ``turn`` radians."""
    K = torch.tensor([[FOCAL, 0, CENTRE[0]], [0, FOCAL, CENTRE[1]], [0, 0, 1]], dtype=torch.float64)
    views = []
    for _ in range(count):
        t = torch.tensor([0, 0, distance], dtype=torch.float64) + 0.8 * normal(3, draw=draw)
        views.append(K @ torch.cat([rotation(turn * uniform(3, draw=draw)), t[:, None]], -1))
    return torch.stack(views)


def collineations(count: int, n: int, draw: torch.Generator) -> Tensor:
    """Collineations of P^n near the identity, so that no point of the unit cube goes to infinity."""
    return torch.eye(n + 1, dtype=torch.float64) + 0.1 * uniform(count, n + 1, n + 1, draw=draw)


def on_lines(n: int, dim: int, views: int, draw: torch.Generator, static: int = 0) -> Tensor:
    """Points that take any positions on a line of their own, ``(views, n, dim)``; the first ``static`` of them stay."""
    start, direction = 2 * uniform(n, dim, draw=draw), normal(n, dim, draw=draw)
    along = 0.5 * uniform(views, n, 1, draw=draw)
    along[:, :static] = 0
    return start + along * direction


def skew(v: Tensor) -> Tensor:
    """The matrix of the cross product with a vector of three."""
    zero = torch.zeros_like(v[0])
    return torch.stack([zero, -v[2], v[1], v[2], zero, -v[0], -v[1], v[0], zero]).reshape(3, 3)


def lines_through(points: Tensor, draw: torch.Generator) -> Tensor:
    """One arbitrary line through every point of a plane, homogeneous."""
    return torch.linalg.cross(homogeneous(points), normal(*points.shape[:-1], 3, draw=draw))
