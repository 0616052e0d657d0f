"""Chapter 3 of the thesis, checked: scenes with linear motion lifted to projections from P^k to P^2.

The chapter is a reprint (Wolf and Shashua, IJCV 2002); its counts and tools are named in chapters 1, 8 and 10, "paper" names
what is not.
"""

from __future__ import annotations

import torch
from torch import Tensor

import dyntorch as dyn
from experiments.thesis.definitions import apart, cameras, homogeneous, inhomogeneous, normal, rank, seeded, uniform
from experiments.thesis.statements import Chapter, Finding

CHAPTER = Chapter(3, "projections from P^k to P^2")
EXACT = 1e-6
"""A minimal sample of exact matches leaves 1e-12 to 1e-8."""
SCENES = 5


def lifted(kind: str, n: int, views: int, draw: torch.Generator) -> tuple[Tensor, Tensor]:
    """Projections ``(views, 3, k + 1)`` and points ``(n, k + 1)`` of a model: position, one, motion per unit of time.

    ``kind`` is the dimension of the scene and its motion: ``direction`` (all along one), ``velocity`` (each its own), ``plane``
    (each its own within parallel planes).
    """
    dim, motion = int(kind[0]), kind[2:]
    X = homogeneous(2 * uniform(n, dim, draw=draw))
    velocities = {"direction": 1, "plane": 2, "velocity": dim}[motion]
    axes = torch.eye(dim, dtype=torch.float64) if motion == "velocity" else normal(dim, velocities, draw=draw)
    Y = torch.cat([X, 0.4 * normal(n, velocities, draw=draw)], -1)
    flat = torch.cat([axes, torch.zeros(1, velocities, dtype=torch.float64)])
    kept = [0, 1, 3] if dim == 2 else [0, 1, 2, 3]
    P = cameras(views, draw)[:, :, kept]
    M = torch.stack([P[t] @ torch.cat([torch.eye(dim + 1, dtype=torch.float64), t * flat], -1) for t in range(views)])
    return M, Y


def minimal(kind: str, k: int, profile: tuple[int, ...], n: int) -> tuple[int, float]:
    """Scenes whose tensor is exact from n matches, and the worst error of those."""
    invariant = dyn.GrassmannTensor(k, profile)
    errors = []
    for seed in range(SCENES):
        M, Y = lifted(kind, n, len(profile), seeded(100 + seed))
        found = dyn.fit(invariant, *(inhomogeneous(Y @ m.mT) for m in M))
        errors.append(apart(found.tensor, invariant.compose(*M)) if found.status == dyn.Status.OK else 1.0)
    return sum(error < EXACT for error in errors), max(errors)


MINIMAL = (
    ("P^3: planar scene, one common direction, two views", "2 direction", 3, (2, 2), 8),
    ("P^4: planar constant velocity, three views", "2 velocity", 4, (2, 2, 1), 13),
    ("P^4: a common direction in space, three views", "3 direction", 4, (2, 2, 1), 13),
    ("P^5: motion within parallel planes, three views", "3 plane", 5, (2, 2, 2), 26),
    ("P^6: constant velocity in space, four views", "3 velocity", 6, (2, 2, 2, 1), 40),
)
"""What, the scene, k, the profile and the matches that the paper states."""


def _state(what: str, kind: str, k: int, profile: tuple[int, ...], n: int) -> None:
    @CHAPTER.states("paper", f"{what}: {n} matches")
    def enough() -> Finding:
        exact, worst = minimal(kind, k, profile, n)
        counted = dyn.GrassmannTensor(k, profile).minimal()
        return Finding(
            exact == SCENES and counted == n, f"exact in {exact} of {SCENES} scenes, error {worst:.0e}; counted {counted}"
        )


for statement in MINIMAL:
    _state(*statement)


@CHAPTER.states("1.1.1, p. 3", "the centre of a projection P^k -> P^l is an extensor of step k - l")
def centres() -> Finding:
    found = []
    for k, target in ((3, 2), (4, 2), (5, 2), (6, 2), (6, 3)):
        M = normal(target + 1, k + 1, draw=seeded(k + target))
        found.append(k + 1 - rank(M) == k - target)
    return Finding(all(found), f"{sum(found)} of {len(found)} pairs (k, l)")


@CHAPTER.states("1.3, p. 9; 10.1, p. 126", "joint epipoles: the images of a line that meets the centres of all views of P^4")
def joint() -> Finding:
    M, _ = lifted("3 direction", 1, 3, seeded(7))
    epipoles = dyn.geometry.joint_epipoles(list(M)).epipoles
    centre = torch.linalg.svd(M).Vh[:, 3:]  # the centres are lines of P^4: two points each
    errors = []
    for view in range(3):
        others = [other for other in range(3) if other != view]
        images = [centre[other] @ M[view].mT for other in others]  # the two lines meet in the epipole
        meet = torch.linalg.cross(*(torch.linalg.cross(image[0], image[1]) for image in images))
        errors.append(apart(epipoles[view], meet))
    return Finding(max(errors) < EXACT, f"3 views, against the meet of the images of the other two centres: {max(errors):.0e}")


@CHAPTER.states("8.3, p. 105", "constant velocities are known up to a common one, which one static point fixes")
def ambiguity() -> Finding:
    errors = {}
    M, Y = lifted("3 velocity", 60, 5, seeded(8))
    tracks = torch.stack([inhomogeneous(Y @ m.mT) for m in M])
    drift = torch.eye(7, dtype=torch.float64)
    drift[4:, 3] = torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64)  # every velocity changes by as much, every camera moves back
    moved = torch.stack([inhomogeneous((Y @ drift.mT) @ (m @ torch.linalg.inv(drift)).mT) for m in M])
    errors["images"] = float((moved - tracks).abs().max())
    found = dyn.reconstruct(tracks, "constant_velocity_3d")
    truth, mine = Y[:, 4:], found.velocities
    affine = torch.linalg.lstsq(homogeneous(found.points), Y[:, :3]).solution
    left = mine @ affine[:3] - truth
    errors["velocities apart from a common one"] = float((left - left.mean(0)).abs().max())
    return Finding(max(errors.values()) < 1e-5, "; ".join(f"{name} {value:.0e}" for name, value in errors.items()))


@CHAPTER.states("1.2, p. 7; 1.3, p. 8", "constant velocity is affine: points and velocities are recovered up to an affine map")
def affine() -> Finding:
    M, Y = lifted("2 velocity", 40, 4, seeded(9))
    found = dyn.reconstruct(torch.stack([inhomogeneous(Y @ m.mT) for m in M]), "constant_velocity_2d").check()
    X = homogeneous(found.points)
    error = float((X @ torch.linalg.lstsq(X, Y[:, :2]).solution - Y[:, :2]).abs().max())
    return Finding(error < EXACT, f"planar scene, 4 views: points to {error:.0e} after an affine map")


@CHAPTER.states("1.4, p. 10", "two bodies in relative translation are one scene of P^3 (planar) or P^4 (space) and are told apart")
def bodies() -> Finding:
    shares = []
    for dim, views, counts in ((2, 2, (5, 4)), (3, 3, (8, 6))):
        draw = seeded(10 + dim)
        X = 2 * uniform(sum(counts), dim, draw=draw)
        second = (torch.arange(sum(counts)) >= counts[0]).double()[:, None]
        P = cameras(views, draw)[:, :, [0, 1, 3] if dim == 2 else [0, 1, 2, 3]]
        tracks = torch.stack([inhomogeneous(homogeneous(X + second * 0.8 * normal(dim, draw=draw)) @ p.mT) for p in P])
        labels = dyn.reconstruct(tracks, f"two_bodies_{dim}d").labels
        same = (labels == labels[0]) == (second[:, 0] == 0)
        shares.append(float(same.double().mean()))
    return Finding(min(shares) == 1, f"5 + 4 planar points, two views: {shares[0]:.0%}; 8 + 6 points, three views: {shares[1]:.0%}")
