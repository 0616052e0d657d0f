"""Chapter 4 and section 9.2 of the thesis, checked: shape tensors, of points that stay and of points that move.

The chapter is a reprint (Levin, Wolf and Shashua, CVPR 2001); its aim stands in section 1.3, the eight-point tensor in section 9.2.
"""

from __future__ import annotations

from itertools import combinations

import torch
from torch import Tensor

import dyntorch as dyn
from experiments.thesis.definitions import (
    apart,
    cameras,
    homogeneous,
    inhomogeneous,
    mapped,
    normal,
    products,
    rank,
    seeded,
    uniform,
)
from experiments.thesis.statements import Chapter, Finding

CHAPTER = Chapter(4, "shape tensors")
EXACT = 1e-6


def plane_and_more(n: int, draw: torch.Generator) -> Tensor:
    """Points of space, the first four of them on a plane, in the coordinates of section 9.2, ``(n, 4)``."""
    return torch.cat(
        [torch.eye(4, dtype=torch.float64)[:3], torch.tensor([[1, 1, 1, 0]], dtype=torch.float64), normal(n - 4, 4, draw=draw)]
    )


def reduced(camera: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Images of the points in the image coordinates of section 9.2, and the camera in both: three diagonal entries and a column."""
    p = points @ camera.mT
    scale = torch.linalg.solve(p[:3].mT, p[3])
    change = torch.linalg.inv(p[:3].mT * scale)
    return p @ change.mT, change @ camera


@CHAPTER.states(
    "9.2, p. 116", "with four coplanar points as the basis the camera has 4 entries: delta on the diagonal, alpha, beta, gamma"
)
def reduced_camera() -> Finding:
    draw = seeded(0)
    P = plane_and_more(8, draw)
    _, M = reduced(normal(3, 4, draw=draw), P)
    left = M[:, :3] / M[0, 0] - torch.eye(3, dtype=torch.float64)
    return Finding(float(left.abs().max()) < EXACT, f"the 3x3 part is a multiple of the identity, to {left.abs().max():.0e}")


@CHAPTER.states("9.2, p. 116", "duality: p = M P = Phat M, the point and the camera change places")
def duality() -> Finding:
    draw = seeded(1)
    P = plane_and_more(8, draw)
    p, M = reduced(normal(3, 4, draw=draw), P)
    worst = 0.0
    camera = torch.cat([M[:, 3], M[0, :1]])
    for X, image in zip(P[4:], p[4:], strict=True):
        hat = torch.cat([X[3] * torch.eye(3, dtype=torch.float64), X[:3, None]], -1)
        dual = torch.stack([camera[3] * X[0], camera[3] * X[1], camera[3] * X[2]]) + X[3] * camera[:3]
        swapped = torch.cat([hat[:, 3:], hat[:, :3]], -1) @ torch.cat([camera[3:], camera[:3]])
        worst = max(worst, apart(dual, image), apart(swapped, image))
    return Finding(worst < EXACT, f"4 points, against the images: {worst:.0e}")


def rows_of(p: Tensor) -> Tensor:
    """The 16 rows of a view: two lines through each of four image points, every choice."""
    lines = torch.linalg.svd(p[:, None]).Vh[:, 1:]
    choice = torch.cartesian_prod(*[torch.arange(2)] * 4)
    return products(*(lines[k, choice[:, k]] for k in range(4)))


def synthetic(draw: torch.Generator) -> Tensor:
    """Rows that hold for any shape: four lines through one point."""
    return torch.cat([rows_of(u[None].expand(4, 3)) for u in normal(40, 3, draw=draw)])


@CHAPTER.states("9.2, p. 117", "the 8-point tensor has 81 coefficients and 16 constraints a view")
def constraints() -> Finding:
    draw = seeded(2)
    P = plane_and_more(8, draw)
    ranks = [rank(torch.cat([rows_of(reduced(normal(3, 4, draw=draw), P)[0][4:]) for _ in range(views)])) for views in (1, 2, 3, 6)]
    return Finding(ranks[0] == 16 and ranks[-1] == 80, f"rank of 1, 2, 3, 6 views: {ranks}")


@CHAPTER.states("9.2, 9.4.1, p. 123", "72 of its constraints are synthetic: dim V(3,4,2)")
def synthetic_constraints() -> Finding:
    draw = seeded(3)
    P = plane_and_more(8, draw)
    fixed = synthetic(draw)
    more = [
        rank(torch.cat([fixed, *(rows_of(reduced(normal(3, 4, draw=draw), P)[0][4:]) for _ in range(views))])) for views in (1, 2)
    ]
    holds = rank(fixed) == dyn.counting.dim_v(3, 4, 2) == 72
    return Finding(holds, f"rank {rank(fixed)}; with one view {more[0]}, with two {more[1]} of 80: two views determine the tensor")


@CHAPTER.states("9.2, p. 117", "the tensor of our fit satisfies the 16 constraints of new views and the synthetic ones")
def fitted() -> Finding:
    draw = seeded(4)
    P = plane_and_more(8, draw)
    views = [inhomogeneous(P @ camera.mT) for camera in normal(5, 3, 4, draw=draw)]
    tensor = dyn.fit(dyn.ShapeTensor("plane"), *torch.stack(views[:2]).unbind(1)).check().tensor
    rows = torch.cat([synthetic(draw), *(rows_of(reduced_image(view)[4:]) for view in views[2:])])
    left = float((rows @ tensor.flatten() / tensor.norm()).abs().max())
    return Finding(left < EXACT, f"from 2 views, on 3 new ones and 640 synthetic rows: {left:.0e}")


def reduced_image(x: Tensor) -> Tensor:
    """Homogeneous image points after the first four became the basis."""
    p = homogeneous(x)
    return p @ torch.linalg.inv(p[:3].mT * torch.linalg.solve(p[:3].mT, p[3])).mT


@CHAPTER.states("1.3, p. 9", "multi-point tensors index single images: a new view of the shape fits, another shape does not")
def indexing() -> Finding:
    said, holds = [], True
    for n, views in ((6, 4), (7, 3), (8, 2)):
        draw = seeded(10 + n)
        P = normal(n, 3, draw=draw)
        seen = torch.stack([mapped(P, camera) for camera in cameras(views + 3, draw)])
        other = torch.stack([mapped(normal(n, 3, draw=draw), camera) for camera in cameras(3, draw)])
        tensor = dyn.fit(dyn.ShapeTensor, *seen[:views].unbind(1)).check().tensor
        new, strange = (dyn.sampson(dyn.ShapeTensor, tensor, *x.unbind(1)) for x in (seen[views:], other))
        holds &= bool(new.max() < 1e-3 < 1 < strange.min())
        said.append(f"{n} points from {views} views: new {new.max():.0e} px, another shape {strange.min():.0f} px")
    return Finding(holds, "; ".join(said))


@CHAPTER.states("chapter 4", "dynamic shape tensors: from one image of points with constant velocities, the time (affine cameras)")
def moving() -> Finding:
    errors = []
    for n, views in ((5, 8), (8, 7), (14, 7)):
        draw = seeded(20 + n)
        start, speed = normal(n, 3, draw=draw), 0.4 * normal(n, 3, draw=draw)
        times = torch.linspace(-1, 1, views + 5, dtype=torch.float64)
        order = torch.randperm(views + 5, generator=draw)
        train = torch.cat([torch.tensor([0, views + 4]), order[(order > 0) & (order < views + 4)][: views - 2]])
        test = torch.tensor([k for k in range(views + 5) if k not in train.tolist()])
        images = torch.stack([(start + t * speed) @ normal(3, 2, draw=draw) + normal(2, draw=draw) for t in times])
        found = dyn.fit(dyn.DynamicShapeTensor, *images[train].unbind(1), times=times[train]).check()
        read = found.invariant.recover(found.tensor, *images[test].unbind(1)).times
        errors.append(float((read - times[test]).abs().max()))
    return Finding(
        max(errors) < 1e-4, f"5, 8 and 14 points from 8, 7 and 7 views, 5 new single views each: time to {max(errors):.0e}"
    )


@CHAPTER.states("chapter 4", "shapes before any affine camera: two views determine the tensor")
def affine() -> Finding:
    draw = seeded(30)
    P = normal(6, 3, draw=draw)
    images = torch.stack([P @ normal(3, 2, draw=draw) + normal(2, draw=draw) for _ in range(5)])
    tensor = dyn.fit(dyn.ShapeTensor("affine"), *images[:2].unbind(1)).check().tensor
    left = float(dyn.sampson(dyn.ShapeTensor("affine"), tensor, *images[2:].unbind(1)).max())
    basis = torch.cat([P, torch.ones(6, 1, dtype=torch.float64)], -1)
    minors = [torch.linalg.det(basis[list(four)]) for four in combinations(range(6), 4)]
    return Finding(left < EXACT and min(abs(float(m)) for m in minors) > 1e-3, f"3 new views: {left:.0e} px")


@CHAPTER.states("1.3, p. 9", "shape tensors for any kind of projection matrix")
def any_projection() -> Finding:
    said, holds = [], True
    for k, target in ((2, 1), (3, 2), (4, 2), (4, 3)):
        draw = seeded(40 + 10 * k + target)
        invariant = dyn.LiftedShapeTensor(k, target)
        n, views = invariant.min_points, dyn.LiftedShapeTensor(k, target, points=invariant.min_points).minimal()
        P = normal(n, k + 1, draw=draw)
        images = torch.stack([inhomogeneous(P @ M.mT) for M in normal(views + 3, target + 1, k + 1, draw=draw)])
        other = torch.stack([inhomogeneous(normal(n, k + 1, draw=draw) @ M.mT) for M in normal(3, target + 1, k + 1, draw=draw)])
        found = dyn.fit(invariant, *images[:views].unbind(1))
        new, strange = (found.invariant.score(found.tensor, *x.unbind(1)) for x in (images[views:], other))
        holds &= bool(found.status == dyn.Status.OK) and bool(new.max() < 1e-5 < strange.min())
        said.append(f"P^{k} to P^{target}, {n} points: new views {new.max():.0e}, another shape {strange.min():.0e}")
    return Finding(holds, "; ".join(said))


@CHAPTER.states("1.3, p. 9; chapter 4", "dynamic shape tensors for perspective cameras: the time of one image")
def perspective() -> Finding:
    draw = seeded(60)
    n, views = 9, 30
    start, speed = normal(n, 3, draw=draw), 0.4 * normal(n, 3, draw=draw)
    times = torch.cat([torch.tensor([-1.0, 1.0], dtype=torch.float64), uniform(views - 2, draw=draw)])
    turns = torch.linalg.qr(normal(views, 3, 3, draw=draw)).Q
    seen = (start + times[:, None, None] * speed) @ turns.mT
    images = 800 * seen[..., :2] / (8 + seen[..., 2:])
    errors = []
    for kind in (dyn.DynamicShapeTensor(), dyn.DynamicShapeTensor(camera="projective")):
        found = dyn.fit(kind, *images[:20].unbind(1), times=times[:20])
        read = found.invariant.recover(found.tensor, *images[20:].unbind(1)).times
        errors.append(float((read - times[20:]).abs().median()))
    return Finding(errors[1] < 1e-5, f"cameras 8 away of points of size 1: affine form {errors[0]:.3f}, projective {errors[1]:.0e}")
