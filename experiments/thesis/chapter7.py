"""Chapter 7 of the thesis, checked: two fixed affine cameras that see different points of a non-rigid scene, at different times.

The chapter is a reprint (Wolf and Zomet, ECCV 2002 workshop); its setting and claims stand in sections 1.4, 1.5 and 10.1.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

import dyntorch as dyn
from experiments.thesis.definitions import homogeneous, normal, rank, rotation, seeded, uniform
from experiments.thesis.statements import Chapter, Finding

CHAPTER = Chapter(7, "synchronization and reconstruction from different points")
FRAMES, FPS = 150, 25.0
BASIS = 4
TAKES = 6


def smooth(frames: int, count: int, draw: torch.Generator) -> Tensor:
    """``(frames, count)`` sums of slow waves."""
    t = torch.arange(frames, dtype=torch.float64)[:, None, None]
    cycles = 0.004 + 0.03 * torch.rand(12, count, generator=draw, dtype=torch.float64)
    phases = 2 * math.pi * torch.rand(12, count, generator=draw, dtype=torch.float64)
    heights = normal(12, count, draw=draw) / (1 + 0.12 * torch.arange(12, dtype=torch.float64)[:, None])
    return (heights * torch.sin(2 * math.pi * cycles * t + phases)).sum(1)


def take(draw: torch.Generator, shift: int, planar: bool = False, foreign: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Two sequences of one non-rigid scene in fixed affine cameras: 10 and 9 different points, and those points in space.

    Every point is a fixed combination of a few points that move by themselves: the thesis's only assumption.  Frame f of the first
    sequence and frame f + shift of the second show the same instant.  ``foreign`` points of the second move on their own.
    """
    frames = FRAMES + abs(shift)
    basis = torch.stack([smooth(frames, 3, draw) for _ in range(BASIS)], 1)
    if planar:
        basis[..., 2] = 0.2 * basis[..., 0] - 0.1 * basis[..., 1]
    spaces = [torch.einsum("pb,fbd->fpd", torch.softmax(2 * normal(n, BASIS, draw=draw), 1), basis) for n in (10, 9)]
    if foreign:
        spaces[1][:, :foreign] = torch.stack([smooth(frames, 3, draw) for _ in range(foreign)], 1)
    views = [50 * X @ rotation(uniform(3, draw=draw))[:2].mT + 300 for X in spaces]
    starts = max(shift, 0), max(-shift, 0)  # frame 0 of the first shows what frame `shift` of the second does
    cut = [slice(starts[k], starts[k] + FRAMES) for k in (0, 1)]
    return views[0][cut[0]], views[1][cut[1]], spaces[0][cut[0]], spaces[1][cut[1]]


def measurement(view: Tensor) -> Tensor:
    """Coordinates of all points in time without their means, ``(frames, 2 n)``."""
    return (view - view.mean(0)).flatten(1)


@CHAPTER.states("1.4, p. 12", "the cameras are related only by this: each point of one is a combination of points of the other")
def common_space() -> Finding:
    draw = seeded(0)
    a, b, _, _ = take(draw, 0)
    ranks = [rank(m) for m in (measurement(a), measurement(b), torch.cat([measurement(a), measurement(b)], 1))]
    return Finding(
        ranks == [8, 8, 12], f"{BASIS} moving points: rank of each {ranks[:2]} (2 coordinates), of both {ranks[2]} (3 coordinates)"
    )


@CHAPTER.states("chapter 7", "the rank of both sequences together is least at the true shift")
def least_rank() -> Finding:
    right = 0
    for seed in range(TAKES):
        draw = seeded(10 + seed)
        shift = int(torch.randint(-20, 21, (), generator=draw))
        a, b, _, _ = take(draw, shift)
        ranks = {}
        for candidate in range(-25, 26):
            first, second = max(0, -candidate), max(0, candidate)
            length = FRAMES - abs(candidate)
            both = torch.cat([measurement(a[first : first + length]), measurement(b[second : second + length])], 1)
            ranks[candidate] = rank(both)
        least = min(ranks.values())
        right += int([c for c, value in ranks.items() if value == least] == [shift])
    return Finding(right == TAKES, f"by its definition, exact tracks: the only least rank in {right} of {TAKES} takes")


def offsets(sigma: float, planar: bool = False, foreign: int = 0) -> list[tuple[float, bool]]:
    """Errors in frames of our estimates on takes with different points, and whether it answered."""
    found = []
    for seed in range(TAKES):
        draw = seeded(30 + seed)
        shift = int(torch.randint(-20, 21, (), generator=draw))
        a, b, _, _ = take(draw, shift, planar, foreign)
        a, b = a + sigma * normal(*a.shape, draw=draw), b + sigma * normal(*b.shape, draw=draw)
        result = dyn.synchronize(a, b, correspondence=False, fps=(FPS, FPS), max_shift=1.2)
        found.append((abs(float(result.offset) * FPS - shift), bool(result.ok)))
    return found


def summary(found: list[tuple[float, bool]]) -> tuple[bool, str]:
    """Whether most takes are within a frame and nothing that was answered is wrong, and a sentence."""
    errors = torch.tensor([error for error, _ in found])
    answered = sum(ok for _, ok in found)
    wrong = sum(ok and error > 1 for error, ok in found)
    near = int((errors <= 1).sum())
    return near >= 0.9 * len(found) and not wrong, (
        f"within a frame {near} of {len(found)}, median {errors.median():.3f} frame, answered {answered}, wrongly {wrong}"
    )


@CHAPTER.states("1.4, p. 12", "synchronization from different points, unknown fixed affine cameras")
def synchronization() -> Finding:
    exact, noisy = summary(offsets(0.0)), summary(offsets(0.5))
    return Finding(exact[0] and noisy[0], f"exact: {exact[1]}; at .5 px: {noisy[1]}")


@CHAPTER.states("1.4, p. 12", "3D and planar scenes in one frame, without model selection")
def planar() -> Finding:
    holds, said = summary(offsets(0.5, planar=True))
    return Finding(holds, f"planar scenes at .5 px: {said}")


@CHAPTER.states("1.4, p. 12", "outlier points are detected and discarded")
def outliers() -> Finding:
    right = 0
    for seed in range(TAKES):
        draw = seeded(40 + seed)
        a, b, _, _ = take(draw, 0, foreign=2)
        a, b = a + 0.5 * normal(*a.shape, draw=draw), b + 0.5 * normal(*b.shape, draw=draw)
        kept = dyn.reconstruct_pair(a, b, 0.0, fps=(FPS, FPS)).labels > 0
        right += int(kept[:10].all() and not kept[10:12].any() and kept[12:].all())
    found = offsets(0.5, foreign=2)
    _, said = summary(found)
    wrong = any(ok and error > 1 for error, ok in found)
    return Finding(
        right >= TAKES - 1 and not wrong,
        f"2 of 9 points foreign, .5 px: just these discarded in {right} of {TAKES} takes; synchronized {said}",
    )


@CHAPTER.states("1.4, p. 12", "the points of both views are reconstructed")
def reconstruction() -> Finding:
    draw = seeded(50)
    a, b, Xa, Xb = take(draw, 0)
    found = dyn.reconstruct_pair(a, b, 0.0, fps=(FPS, FPS)).check()
    X, Y = homogeneous(found.points.reshape(-1, 3)), torch.cat([Xa, Xb], 1).reshape(-1, 3)
    left = (X @ torch.linalg.lstsq(X, Y).solution - Y).reshape(FRAMES, -1, 3).abs() / Y.std()
    errors = float(left[:, found.source == 0].max()), float(left[:, found.source == 1].max())
    return Finding(
        max(errors) < 1e-5, f"up to an affine map: points of the first view to {errors[0]:.0e}, of the second to {errors[1]:.0e}"
    )


@CHAPTER.states("1.5, p. 13; 10.1, p. 127", "with the same points in both (Zelnik-Manor and Irani) the results are nearly perfect")
def same_points() -> Finding:
    errors = []
    for seed in range(TAKES):
        draw = seeded(60 + seed)
        shift = int(torch.randint(-20, 21, (), generator=draw))
        frames = FRAMES + abs(shift)
        X = torch.stack([smooth(frames, 3, draw) for _ in range(10)], 1)
        views = [50 * X @ rotation(uniform(3, draw=draw))[:2].mT + 0.5 * normal(frames, 10, 2, draw=draw) for _ in range(2)]
        starts = max(shift, 0), max(-shift, 0)
        a, b = (view[start : start + FRAMES] for view, start in zip(views, starts, strict=True))
        errors.append(abs(float(dyn.synchronize(a, b, fps=(FPS, FPS), max_shift=1.2).offset) * FPS - shift))
    return Finding(max(errors) < 0.05, f"at .5 px: {TAKES} takes to {max(errors):.3f} frame")
