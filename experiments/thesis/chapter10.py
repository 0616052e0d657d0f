"""Chapter 10 of the thesis, checked: its discussion, what it leaves open, and what has come of that.

**From a tensor to its cameras, in general** (open in 10.1). The Grassmann tensor of projections M_1, ..., M_v of P^k with the
profile (a_1, ..., a_v), a_1 + ... + a_v = k + 1, holds the determinants of a_i rows of every M_i. Closed form, up to a
collineation of P^k:

1. Choose a_i rows of every view whose determinant is not zero; a collineation makes these k + 1 rows the unit matrix. Every
   other row of view i then has a block of a_q entries for every view q, and every other coordinate of the tensor is a minor of
   these.
2. Coordinates with one row replaced are, by Cramer's rule, the entries of the row's block (i, i), signed.
3. Coordinates with a row replaced in two views i and q give, less the product of two known entries, b_t c_j: entries of block
   (i, q) times entries of block (q, i), a matrix of rank one. It determines both blocks up to one factor, x and 1/x.
4. A diagonal collineation has one factor a view, and takes the factors of the pairs (1, q) to one. Of any other pair the
   coordinates with a row replaced in views 1, i and q give x X + Y / x = Z with known X, Y, Z: its least squares solution is a
   root of a quartic.

That is a proof that the cameras are unique where step 4 has one solution, which two equations that are not proportional ensure.
Limits: three views P^2 -> P^1 have one equation and two solutions; a view with a_i = l + 1 has no row left over, and any
combination of its rows can be added to the other views; views without a nonzero coordinate (all centres meet) have no tensor.
Hartley and Schaffalitzky (2004) proved uniqueness by another way. The first statement recomposes tensors from their cameras for
nine profiles.
"""

from __future__ import annotations

import numpy as np
import torch

import dyntorch as dyn
from experiments.thesis.chapter9 import PRIME, rank_mod
from experiments.thesis.definitions import apart, collineations, homogeneous, mapped, normal, products, rank, seeded, uniform
from experiments.thesis.statements import Chapter, Finding

CHAPTER = Chapter(10, "conclusions and what was open")
PROFILES = (
    (3, (2, 2), 2),
    (3, (2, 1, 1), 2),
    (3, (1, 1, 1, 1), 2),
    (4, (2, 2, 1), 2),
    (5, (2, 2, 2), 2),
    (6, (2, 2, 2, 1), 2),
    (3, (1, 1, 1, 1), 1),
    (6, (3, 3, 1), 3),
    (8, (4, 3, 2), 4),
)
"""k, the profile, l."""


@CHAPTER.states(
    "10.1, p. 126",
    "no algorithm recovers structure in P^k from projections to P^l in general",
    answer="a closed form does, for any profile",
)
def cameras() -> Finding:
    errors = []
    for k, profile, target in PROFILES:
        invariant = dyn.GrassmannTensor(k, profile, target)
        M = normal(len(profile), target + 1, k + 1, draw=seeded(k + target + len(profile)))
        tensor = invariant.compose(*M)
        errors.append(apart(invariant.compose(*invariant.decompose(tensor)), tensor))
    return Finding(
        max(errors) < 1e-9,
        f"{len(PROFILES)} profiles, k = 3..8, l = 1..4: tensors recomposed from their cameras to {max(errors):.0e}",
    )


@CHAPTER.states(
    "10.1, p. 126", "two projections from P^k to P^l combine to one to P^(2l)", "their rows together map to R^(2l+2), so P^(2l+1)"
)
def combined() -> Finding:
    rows = torch.cat([normal(3, 7, draw=seeded(0)), normal(3, 7, draw=seeded(1))])
    return Finding(rank(rows) == 5, f"P^6 to P^2 twice: {rank(rows)} independent rows, a map to P^{rank(rows) - 1}")


@CHAPTER.states("10.1, p. 125", "no tensor of the thesis has a larger estimation matrix than the quadrifocal tensor, 81 unknowns")
def sizes() -> Finding:
    invariants = (
        dyn.HomographyTensor, dyn.DualHomographyTensor, dyn.JoinTensor, dyn.MinimalJoinTensor(), dyn.ConstantVelocityTensor,
        dyn.TranslatingLinesMatrix, dyn.SegmentationMatrix, dyn.GrassmannTensor(4, (2, 2, 1)), dyn.GrassmannTensor(5, (2, 2, 2)),
        dyn.GrassmannTensor(6, (2, 2, 2, 1)), dyn.ShapeTensor("plane", 8),
    )  # fmt: skip
    sizes = [invariant.width() for invariant in invariants]
    return Finding(max(sizes) <= 81, f"unknowns of the invariants of chapters 2 to 8: {sorted(sizes)}")


def images(k: int, views: int, moving: bool) -> int:
    """Rank of the products of images in P^2 of points of P^k that stay, or take any place on a line, by its definition."""
    draw = np.random.default_rng(k)
    cameras = draw.integers(0, PRIME, (views, 3, k + 1))
    rows = []
    for _ in range(3**views + 5):
        points = draw.integers(0, PRIME, (2, k + 1))
        row = np.ones(1, dtype=np.int64)
        for camera in cameras:
            X = draw.integers(0, PRIME, 2) @ points % PRIME if moving else points[0]
            row = (row[:, None] * (camera @ X % PRIME)).ravel() % PRIME
        rows.append(row)
    return rank_mod(np.array(rows))


@CHAPTER.states(
    "10.1, p. 126",
    "how many invariants for n views in P^l of extensors of step m of P^k that move on one of step r",
    answer="exact ranks over a prime field (dyntorch.counting.count)",
)
def general_counts() -> Finding:
    cases = {
        "points on lines of P^3, four views": (dyn.counting.count(3, views=[2] * 4, m=1, r=2).rank, images(3, 4, moving=True)),
        "points of P^4, three views": (dyn.counting.count(4, views=[2] * 3, m=1, r=1).rank, images(4, 3, moving=False)),
        "points of P^3, three views": (dyn.counting.count(3, views=[2] * 3, m=1, r=1).rank, images(3, 3, moving=False)),
    }
    said = "; ".join(f"{name}: {ours} (by definition {theirs})" for name, (ours, theirs) in cases.items())
    return Finding(all(ours == theirs for ours, theirs in cases.values()), said)


@CHAPTER.states(
    "10.1, p. 126",
    "the minimal conditions on the measurements, such as 'up to 10 points on one hyperplane'",
    answer="a table for every invariant (results: minimal conditions; dyntorch count)",
)
def conditions() -> Finding:
    draw = seeded(5)
    flat = torch.zeros(80, 1, dtype=torch.float64)
    plane, line = torch.cat([2 * uniform(80, 2, draw=draw), flat], -1), torch.cat([2 * uniform(80, 1, draw=draw), flat, flat], -1)
    # by definition: static points seen by three sensors, rows of the join tensors
    own = [rank(products(*(homogeneous(mapped(points, A)) for A in collineations(3, 3, draw)))) for points in (plane, line)]
    counted = {c.option: c.matches for c in dyn.counting.capacities("join", only=["static_on_plane", "static_on_line"])}
    found = [counted["static_on_plane"], counted["static_on_line"]]
    said = f"static points of join tensors on one plane: {found[0]} (by definition {own[0]}), on one line {found[1]} ({own[1]})"
    return Finding(found == own and own[0] == 10, said)
