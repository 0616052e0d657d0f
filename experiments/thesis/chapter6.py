"""Chapter 6 of the thesis, checked: two bodies in two views, the segmentation matrix.

The chapter is a reprint (Wolf and Shashua, CVPR 2001); its idea stands in section 1.4, and "paper" names what does not.
"""

from __future__ import annotations

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
    rank,
    seeded,
    skew,
    uniform,
)
from experiments.thesis.statements import Chapter, Finding

CHAPTER = Chapter(6, "the segmentation matrix")
S = dyn.SegmentationMatrix


def bodies(
    counts: tuple[int, ...], draw: torch.Generator, flat: tuple[bool, ...] = (), affine: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """Matches of bodies that move by themselves between two views, and their labels; ``flat`` bodies are planes."""
    first = cameras(1, draw)[0]
    x1, x2, labels = [], [], []
    for body, n in enumerate(counts):
        X = 1.5 * uniform(n, 3, draw=draw)
        if body < len(flat) and flat[body]:
            X[:, 2] = 0.3 * X[:, 0] - 0.2 * X[:, 1]
        if affine:
            x1.append(X @ normal(3, 2, draw=draw) + normal(2, draw=draw))
            x2.append(X @ normal(3, 2, draw=draw) + normal(2, draw=draw))
        else:
            x1.append(mapped(X, first))
            x2.append(mapped(X, cameras(1, draw)[0]))  # the camera's and the body's motion together
        labels.append(torch.full((n,), body + 1))
    return torch.cat(x1), torch.cat(x2), torch.cat(labels)


def agreement(found: Tensor, truth: Tensor) -> float:
    """Share of labels that are right under the better of both names."""
    same = float((found == truth).double().mean())
    return max(same, 1 - same)


def second_order(x: Tensor) -> Tensor:
    """The six monomials of degree two of homogeneous points, at unit size."""
    p = homogeneous((x - x.mean(0)) / x.std())
    i, j = torch.triu_indices(3, 3)
    return p[:, i] * p[:, j]


def rows(x1: Tensor, x2: Tensor) -> Tensor:
    """The estimation matrix by its definition: products of the monomials of both views."""
    return (second_order(x1)[:, :, None] * second_order(x2)[:, None, :]).flatten(1)


@CHAPTER.states(
    "1.4, p. 11", "the product of two fundamental matrices is linear in the second order monomials: 36 entries, 35 matches"
)
def product() -> Finding:
    x1, x2, _ = bodies((40, 40), seeded(0))
    found = rank(rows(x1, x2))
    return Finding(found == 35, f"rank of 80 matches of two bodies: {found} of 36")


@CHAPTER.states("paper", "any split with at least 8 matches on each body will do")
def splits() -> Finding:
    said, right = [], True
    for counts in ((18, 17), (27, 8), (20, 15)):
        good = 0
        for seed in range(5):
            x1, x2, labels = bodies(counts, seeded(10 + seed))
            tensor = dyn.fit(S, x1, x2).tensor
            good += int(agreement(S.labels(*S.fundamentals(tensor), x1, x2), labels) == 1)
        right &= good == 5
        said.append(f"{counts[0]} + {counts[1]}: {good} of 5")
    x1, x2, _ = bodies((28, 7), seeded(20))
    return Finding(
        right and rank(rows(x1, x2)) < 35, "all labels right in " + ", ".join(said) + f"; 28 + 7: rank {rank(rows(x1, x2))}"
    )


@CHAPTER.states(
    "1.4, p. 11",
    "the invariant is insensitive to degenerate bodies",
    "a planar body leaves 3 matrices, two leave 9: what it says of them is lost",
)
def degenerate() -> Finding:
    ranks = []
    for flat in ((True, False), (True, True)):
        x1, x2, _ = bodies((60, 60), seeded(30), flat)
        ranks.append(36 - rank(rows(x1, x2)))
    return Finding(ranks == [1, 1], f"nullity with one planar body {ranks[0]}, with two {ranks[1]}")


@CHAPTER.states("1.4, p. 12", "the product is less stable than single fundamental matrices; a nonlinear minimization mends it")
def noise() -> Finding:
    wrong: dict[str, list[float]] = {"linear": [], "refined": []}
    for seed in range(10):
        draw = seeded(40 + seed)
        x1, x2, labels = bodies((25, 25), draw)
        x1, x2 = x1 + 0.1 * normal(50, 2, draw=draw), x2 + 0.1 * normal(50, 2, draw=draw)
        linear = dyn.fit(S, x1, x2)
        for name, found in (("linear", linear), ("refined", dyn.refine(linear, x1, x2))):
            wrong[name].append(1 - agreement(S.labels(*S.fundamentals(found.tensor), x1, x2), labels))
    mean = {name: sum(values) / len(values) for name, values in wrong.items()}
    return Finding(
        mean["refined"] < 0.5 * mean["linear"],
        ", ".join(f"{name}: {value:.1%} wrong" for name, value in mean.items()) + " at .1 px",
    )


@CHAPTER.states("paper", "affine cameras: 14 matches")
def affine() -> Finding:
    good = []
    for counts in ((7, 7), (10, 4)):
        x1, x2, labels = bodies(counts, seeded(60), affine=True)
        good.append(agreement(dyn.tasks.affine_segmentation(x1, x2).labels, labels))
    return Finding(min(good) == 1, f"7 + 7: {good[0]:.0%} right; 10 + 4: {good[1]:.0%}")


@CHAPTER.states("1.5, p. 12 (Vidal)", "more than two bodies: possible, but the invariants are intractable")
def more() -> Finding:
    x1, x2, labels = bodies((50, 50, 50), seeded(70))
    found = dyn.invariants.multibody_matrix(x1, x2, 3).labels
    pairs = (found[:, None] == found) == (labels[:, None] == labels)
    return Finding(
        bool(pairs.all()),
        f"three bodies: 100 coefficients, 150 exact matches, {float(pairs.double().mean()):.0%} of the pairs right",
    )


@CHAPTER.states(
    "1.5, p. 12 (Bartoli)",
    "a static scene and points on lines of one plane that meet in a point: two 3x3 invariants with one homography",
)
def convergent() -> Finding:
    draw = seeded(80)
    H = torch.eye(3, dtype=torch.float64) + 0.1 * uniform(3, 3, draw=draw)
    e, v = normal(3, draw=draw), normal(3, draw=draw)
    x1 = uniform(60, 2, draw=draw)
    towards = torch.where(torch.arange(60)[:, None] < 30, e, v)
    x2 = inhomogeneous(homogeneous(x1) @ H.mT + 0.3 * uniform(60, 1, draw=draw) * towards)
    kind = dyn.ConvergentMotionMatrix
    found = kind.fundamentals(dyn.fit(kind, x1, x2).check().tensor)
    truth = [skew(c) @ H for c in (e, v)]
    errors = [max(apart(found[k], truth[j]) for k, j in ((0, i), (1, 1 - i))) for i in (0, 1)]
    return Finding(min(errors) < 1e-6, f"30 static and 30 moving points: both matrices to {min(errors):.0e}")
