"""Chapter 1 of the thesis, checked: projective spaces, extensors, trajectories and the counts of its overview."""

from __future__ import annotations

import math
from itertools import combinations

import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch.geometry.extensors import join, plucker
from experiments.thesis.definitions import (
    apart,
    cameras,
    homogeneous,
    inhomogeneous,
    mapped,
    normal,
    on_lines,
    products,
    rank,
    seeded,
)
from experiments.thesis.statements import Chapter, Finding

CHAPTER = Chapter(1, "projective spaces, extensors, trajectories")
EXACT = 1e-8
"""Errors below this are exact: data and solves in double precision leave 1e-16 times the conditioning of a minimal sample."""


@CHAPTER.states("1.1.1, p. 3", "a collineation of P^k is defined by k + 2 pairs of points, k constraints each")
def collineation() -> Finding:
    errors, refused = [], 0
    for k in range(1, 7):
        draw = seeded(k)
        A, x2 = normal(k + 1, k + 1, draw=draw), normal(k + 2, k, draw=draw)
        x1 = mapped(x2, A)
        errors.append(apart(dyn.fit(dyn.Collineation(k), x1, x2).tensor, A))
        fewer = dyn.fit(dyn.Collineation(k), torch.cat([x1[:-1], x1[:1]]), torch.cat([x2[:-1], x2[:1]]))
        refused += int(fewer.status != dyn.Status.OK)
    return Finding(max(errors) < EXACT and refused == 6, f"k = 1..6: error {max(errors):.0e}; {refused} of 6 refused from k + 1")


@CHAPTER.states("1.1.1, p. 3", "a match between P^k and P^l gives l constraints on the projection matrix")
def projection() -> Finding:
    errors = []
    for k, target in ((2, 1), (3, 2), (4, 2), (5, 2), (6, 2), (6, 3)):
        draw = seeded(10 * k + target)
        M = normal(target + 1, k + 1, draw=draw)
        Y = normal(math.ceil(((target + 1) * (k + 1) - 1) / target), k + 1, draw=draw)
        errors.append(apart(dyn.geometry.resect(Y, inhomogeneous(Y @ M.mT)[None]), M))
    return Finding(max(errors) < 1e-5, f"6 pairs (k, l) from ceil(((l+1)(k+1) - 1) / l) points: error {max(errors):.0e}")


def minors(vectors: Tensor) -> Tensor:
    """Extensor of the rows, by its definition: all square minors."""
    k, n = vectors.shape
    return torch.stack([torch.linalg.det(vectors[:, list(columns)]) for columns in combinations(range(n), k)])


@CHAPTER.states(
    "1.1.3, p. 4", "the extensors of step k of R^n have C(n, k) coordinates, the minors, and do not depend on the basis"
)
def extensors() -> Finding:
    worst, same = 0.0, 0.0
    for n in range(3, 9):
        for k in range(1, n):
            draw = seeded(10 * n + k)
            vectors, change = normal(k, n, draw=draw), normal(k, k, draw=draw)
            worst = max(worst, float((join(*vectors) - minors(vectors)).abs().max()))
            same = max(same, apart(join(*(change @ vectors)), minors(vectors)))
    return Finding(max(worst, same) < EXACT, f"n = 3..8, all k: minors {worst:.0e}, another basis {same:.0e}")


@CHAPTER.states("1.1.3, p. 5", "the join A v B is zero exactly where the two subspaces intersect")
def vanishing_join() -> Finding:
    meet, miss = 0.0, math.inf
    for n in range(3, 9):
        for k in range(1, n - 1):
            draw = seeded(100 + 10 * n + k)
            A, B = normal(k, n, draw=draw), normal(n - k, n, draw=draw)
            miss = min(miss, float(join(*A, *B).abs().max()))
            B[0] = normal(1, k, draw=draw)[0] @ A
            meet = max(meet, float(join(*A, *B).abs().max()))
    return Finding(meet < EXACT < miss, f"n = 3..8: at most {meet:.0e} where they intersect, at least {miss:.0e} where not")


@CHAPTER.states(
    "1.1.3, p. 5",
    "if k + j > n the intersection has dimension k + j - n",
    "it has at least that dimension; equality is the generic case",
)
def meets() -> Finding:
    draw = seeded(3)
    generic, special = 0, 0
    for n, k, j in ((4, 3, 2), (5, 3, 3), (6, 4, 4), (9, 6, 6)):
        A, B = normal(k, n, draw=draw), normal(j, n, draw=draw)
        generic += int(k + j - rank(torch.cat([A, B])) == k + j - n)
        B[: min(k, j)] = A[: min(k, j)]
        special += int(k + j - rank(torch.cat([A, B])) == k + j - n)
    return Finding(generic == special == 4, f"random subspaces: {generic} of 4 have it; B through A: {special} of 4")


@CHAPTER.states("1.3, p. 7", "a 3x6 line camera, its rows the meets of pairs of planes, maps a 3D line to its image l ~ M L")
def line_cameras() -> Finding:
    draw = seeded(4)
    P, ends = cameras(5, draw), normal(40, 2, 3, draw=draw)
    L = plucker(ends)
    worst = 0.0
    for camera in P:
        seen = homogeneous(ends) @ camera.mT
        images = torch.linalg.cross(seen[:, 0], seen[:, 1])
        mine = L @ dyn.geometry.line_camera(camera).mT
        worst = max(worst, *(apart(a, b) for a, b in zip(images, mine, strict=True)))
    return Finding(worst < EXACT, f"5 cameras, 40 lines: {worst:.0e}")


@CHAPTER.states("1.3, p. 7", "points p_j of one trajectory line satisfy p_j' M_j L = 0 in every view")
def trajectories() -> Finding:
    draw = seeded(5)
    P = cameras(6, draw)
    X = on_lines(40, 3, 6, draw)
    x = torch.stack([mapped(X[j], P[j]) for j in range(6)])
    found = dyn.triangulate_trajectories(P, x)
    error = float((found.points - X).norm(dim=-1).max())
    return Finding(error < 1e-6, f"40 moving points, 6 views: positions to {error:.0e}")


@CHAPTER.states("1.3, p. 8", "the six-view tensor of trajectories has 3^6 elements and takes 728 matches")
def six_views() -> Finding:
    draw = seeded(6)
    P = normal(6, 3, 4, draw=draw)
    X = on_lines(760, 3, 6, draw)
    rows = products(*(homogeneous(X[j]) @ P[j].mT for j in range(6)))
    found = rank(rows, 1e-12)
    return Finding(found == 728 and rows.shape[1] == 729, f"{rows.shape[1]} entries; rank of 760 matches {found}")


@CHAPTER.states(
    "1.3, p. 8", "three points on a line are dual to three lines through a point: the quadrifocal tensor contracted with a line"
)
def duality() -> Finding:
    draw = seeded(7)
    P, t = normal(4, 3, 4, draw=draw), normal(3, draw=draw)
    rows = torch.cartesian_prod(*[torch.arange(3)] * 4)
    quadrifocal = torch.linalg.det(torch.stack([P[v, rows[:, v]] for v in range(4)], 1))
    plane = P[3].mT @ t
    basis = torch.linalg.svd(plane[None]).Vh[1:].mT
    G = P[:3] @ basis
    A, B = G[0] @ torch.linalg.inv(G[1]), G[0] @ torch.linalg.inv(G[2])
    dual = dyn.DualHomographyTensor
    error = apart(dual.from_quadrifocal(quadrifocal.reshape(3, 3, 3, 3), t), dual.compose(A, B))
    return Finding(error < EXACT, f"contracted tensor against the dual homography tensor of that plane: {error:.0e}")


@CHAPTER.states(
    "1.4, p. 10", "the fundamental matrices of bodies that translate relative to each other lie in a 3-dimensional subspace of R^9"
)
def fundamentals() -> Finding:
    draw = seeded(8)
    infinity = normal(3, 3, draw=draw)
    F = torch.stack([torch.linalg.cross(normal(3, 1, draw=draw).expand(3, 3), infinity, dim=0) for _ in range(12)])
    found = rank(F.flatten(1))
    return Finding(found == 3, f"12 translating bodies: rank {found}")


@CHAPTER.states("1.5, p. 13", "points of constant velocity are treated in chapter 6", "in chapter 3")
def reference() -> Finding:
    return Finding(False, "chapter 3 lifts constant velocity to P^4 (planar) and P^6 (space)")
