"""Chapter 2 of the thesis, checked: homography tensors, of three views of planar points that stay or move along lines.

The chapter is a reprint (Shashua and Wolf, ECCV 2000); its counts are repeated in chapters 1 and 9, and "paper" names what is not.
"""

from __future__ import annotations

import torch
from torch import Tensor

import dyntorch as dyn
from experiments.thesis.definitions import (
    apart,
    collineations,
    lines_through,
    mapped,
    matrix_rank,
    normal,
    on_lines,
    seeded,
)
from experiments.thesis.statements import Chapter, Finding

CHAPTER = Chapter(2, "homography tensors")
H, DUAL = dyn.HomographyTensor, dyn.DualHomographyTensor
EXACT = 1e-6
"""A minimal sample of exact matches leaves 1e-12 to 1e-8."""


def scene(points: Tensor, draw: torch.Generator) -> tuple[tuple[Tensor, ...], Tensor, Tensor]:
    """Three views of planar points ``(3, n, 2)``, and the homographies A, B of the second and third view to the first."""
    A, B = collineations(2, 2, draw)
    views = points[0], mapped(points[1], torch.linalg.inv(A)), mapped(points[2], torch.linalg.inv(B))
    return views, A, B


def on_given_lines(counts: list[int], draw: torch.Generator) -> Tensor:
    """So many moving points on each of a few lines."""
    lines = [normal(2, draw=draw) + normal(3, n, 1, draw=draw) * normal(2, draw=draw) for n in counts]
    return torch.cat(lines, 1)


@CHAPTER.states("9.3, p. 119", "26 matches of points that move along lines determine the tensor")
def moving() -> Finding:
    errors = []
    for seed in range(10):
        draw = seeded(seed)
        views, A, B = scene(on_lines(26, 2, 3, draw), draw)
        found = dyn.fit(H, *views).check()
        errors.append(max(apart(mine, true) for mine, true in zip(H.decompose(found.tensor), (A, B), strict=True)))
    fewer = matrix_rank(tuple(view[:25] for view in views))
    return Finding(max(errors) < EXACT and fewer == 25, f"10 scenes: A and B to {max(errors):.0e}; 25 matches have rank {fewer}")


@CHAPTER.states("9.3, p. 119", "static points fill a space of 10 dimensions, so that at least 16 points must move")
def static() -> Finding:
    draw = seeded(1)
    ranks = {}
    for still, go in ((60, 0), (40, 15), (40, 16), (10, 16)):
        views, _, _ = scene(on_lines(still + go, 2, 3, draw, static=still), draw)
        ranks[still, go] = matrix_rank(views)
    holds = list(ranks.values()) == [10, 25, 26, 26]
    return Finding(holds, "; ".join(f"{still} static + {go} moving: rank {value}" for (still, go), value in ranks.items()))


@CHAPTER.states("9.3, p. 119", "at most 8 points of one line give independent constraints, of static ones at most 4")
def collinear() -> Finding:
    draw = seeded(2)
    line = on_given_lines([12], draw)
    ranks = [matrix_rank(scene(points, draw)[0]) for points in (line, line[:1].expand(3, -1, -1))]
    few, enough = (matrix_rank(scene(on_given_lines(counts, draw), draw)[0]) for counts in ([8, 8, 8, 2], [8, 7, 6, 5]))
    said = f"12 points that move on one line: rank {ranks[0]}; 12 static ones: {ranks[1]}"
    return Finding(
        ranks == [8, 4], f"{said}; the bound alone is not enough: 8 + 8 + 8 + 2 have rank {few}, 8 + 7 + 6 + 5 rank {enough}"
    )


@CHAPTER.states("paper", "labelled static points: 0, 1, 2, 3, 4 of them leave 26, 19, 12, 5, 0 moving ones to be found")
def labelled() -> Finding:
    said, right = [], True
    for still, go in enumerate((26, 19, 12, 5, 0)):
        draw = seeded(20 + still)
        views, A, _ = scene(on_lines(still + go, 2, 3, draw, static=still), draw)
        label = torch.arange(still + go) < still
        found = dyn.fit(H, *views, static=label)
        good = found.status == dyn.Status.OK and apart(H.decompose(found.tensor)[0], A) < EXACT
        right &= bool(good)
        said.append(f"{still} + {go}: {'exact' if good else dyn.Status(int(found.status)).name}")
    return Finding(right, "; ".join(said))


@CHAPTER.states("paper", "the tensor maps static points between views without A and B, and tells them from moving ones")
def direct() -> Finding:
    draw = seeded(4)
    views, _, _ = scene(on_lines(60, 2, 3, draw, static=30), draw)
    tensor = dyn.fit(H, *views).check().tensor
    error = float((H.transfer(tensor, views[0][:30], 1, 3) - views[2][:30]).norm(dim=-1).max())
    distance = H.static_distance(tensor, *views)
    holds = error < EXACT and float(distance[:30].max()) < EXACT < float(distance[30:].min())
    return Finding(
        holds, f"view 1 to 3: {error:.0e}; static at most {distance[:30].max():.0e}, moving at least {distance[30:].min():.0e}"
    )


@CHAPTER.states("1.3, p. 8", "the dual tensor takes 26 triplets of lines, or four static points")
def dual() -> Finding:
    draw = seeded(5)
    views, A, B = scene(on_lines(26, 2, 3, draw, static=26), draw)
    lines = dyn.fit(DUAL, *(lines_through(view, draw) for view in views)).check()
    points = dyn.fit(DUAL("points"), *(view[:4] for view in views)).check()
    errors = [max(apart(a, b) for a, b in zip(DUAL.decompose(f.tensor), (A, B), strict=True)) for f in (lines, points)]
    return Finding(max(errors) < EXACT, f"A and B from 26 lines to {errors[0]:.0e}, from 4 points to {errors[1]:.0e}")


@CHAPTER.states("9.3, p. 118", "the same for any number of views, and points of P^n: all collineations are recovered")
def any_views() -> Finding:
    said, holds = [], True
    for n, views, k in ((2, 4, 2), (3, 4, 2), (3, 4, 3)):
        draw = seeded(6)
        invariant = dyn.DynamicTensor(n, views, k)
        count = invariant.minimal()
        maps = collineations(views - 1, n, draw)
        within = normal(k, count, n, draw=draw)  # each point anywhere in the span of k points of its own
        at = torch.softmax(normal(views, k, count, 1, draw=draw), 1)
        points = (at * within).sum(1)
        seen = [points[0], *(mapped(x, torch.linalg.inv(m)) for x, m in zip(points[1:], maps, strict=True))]
        found = dyn.fit(invariant, *seen).check()
        error = max(apart(mine, true) for mine, true in zip(invariant.decompose(found.tensor), maps, strict=True))
        holds &= error < EXACT and count == dyn.counting.dim_v(n + 1, views, k)
        said.append(f"P^{n}, {views} views, k = {k}: {error:.0e} from {count}")
    return Finding(holds, "; ".join(said))


@CHAPTER.states(
    "10.1, p. 125", "dynamic invariants are less stable than static ones; normalization, sampling and refinement are needed"
)
def stability() -> Finding:
    errors: dict[str, list[float]] = {"tensor": [], "refined": [], "static homography": []}
    for seed in range(10):
        draw = seeded(40 + seed)
        views, A, _ = scene(on_lines(60, 2, 3, draw, static=30), draw)
        noisy = tuple(view + 0.002 * normal(*view.shape, draw=draw) for view in views)
        found = dyn.fit(H, *noisy)
        refined = dyn.refine(found, *noisy)
        known = dyn.fit(dyn.Collineation(2), noisy[0][:30], noisy[1][:30]).tensor
        grid = on_lines(200, 2, 1, seeded(0))[0]
        for name, estimate in (("tensor", found.motion[0]), ("refined", refined.motion[0]), ("static homography", known)):
            errors[name].append(float((mapped(mapped(grid, torch.linalg.inv(A)), estimate) - grid).norm(dim=-1).median()))
    middle = {name: float(torch.tensor(values).median()) for name, values in errors.items()}
    holds = middle["refined"] < middle["tensor"] and middle["static homography"] < middle["tensor"]
    return Finding(holds, "grid error at noise .002: " + ", ".join(f"{name} {value:.4f}" for name, value in middle.items()))
