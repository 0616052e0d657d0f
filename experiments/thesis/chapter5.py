"""Chapter 5 of the thesis, checked: independently translating planes in two views, by a common transversal.

The chapter is a reprint (Wolf and Shashua, ICCV 2001); its argument and counts are repeated in section 1.4.
"""

from __future__ import annotations

import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch.geometry.extensors import join
from experiments.thesis.definitions import apart, normal, rank, rotation, seeded, skew, uniform
from experiments.thesis.statements import Chapter, Finding

CHAPTER = Chapter(5, "translating planes")
EXACT = 1e-6


def planes(n: int, draw: torch.Generator, flat: bool = False) -> tuple[Tensor, Tensor, Tensor]:
    """Homographies ``H_i = H_inf + e_i n_i'`` of planes that translate by themselves, H_inf and the fundamental matrices.

    With ``flat`` all motions are parallel to one plane, so that the epipoles are collinear.
    """
    infinity = rotation(0.3 * uniform(3, draw=draw))
    e, normals = normal(n, 3, draw=draw), normal(n, 3, draw=draw)
    if flat:
        e[:, 2] = e[:, 0] - 0.5 * e[:, 1]
    H = infinity + 0.5 * e[:, :, None] * normals[:, None, :]
    F = torch.stack([skew(v) @ infinity for v in e])
    return H * torch.exp(0.3 * normal(n, 1, 1, draw=draw)), infinity, F


def conforming(H: Tensor) -> tuple[Tensor, int]:
    """The fundamental matrices that conform with a homography, ``H' F + F' H = 0``, as three rows of nine, and the rank."""
    units = torch.eye(9, dtype=torch.float64).reshape(9, 3, 3)
    equations = (H.mT @ units + units.mT @ H).flatten(1).mT
    return torch.linalg.svd(equations).Vh[6:], rank(equations[equations.norm(dim=1) > 0])


@CHAPTER.states("1.4, p. 10", "a homography puts 6 linear constraints on the fundamental matrix: a 3-dimensional space remains")
def constraints() -> Finding:
    H, _, F = planes(5, seeded(0))
    found = [conforming(h) for h in H]
    inside = max(
        float((f.flatten() - f.flatten() @ basis.mT @ basis).norm() / f.norm()) for f, (basis, _) in zip(F, found, strict=True)
    )
    ranks = sorted({rows for _, rows in found})
    return Finding(ranks == [6] and inside < EXACT, f"5 planes: rank {ranks}; the true F is in the space, to {inside:.0e}")


@CHAPTER.states(
    "1.4, p. 11", "the space of all F of the scene is that of the homography at infinity, and every plane's space meets it"
)
def transversal() -> Finding:
    H, infinity, F = planes(5, seeded(1))
    common, _ = conforming(infinity)
    inside = max(float((f.flatten() - f.flatten() @ common.mT @ common).norm() / f.norm()) for f in F)
    meets = [rank(torch.cat([common, conforming(h)[0]])) for h in H]
    return Finding(
        inside < EXACT and set(meets) == {5},
        f"F of the bodies in it to {inside:.0e}; spaces together have rank {sorted(set(meets))}",
    )


@CHAPTER.states("1.4, p. 10", "five homographies determine the common transversal linearly, among the extensors of step 3 of R^9")
def five() -> Finding:
    H, infinity, _ = planes(5, seeded(2))
    units = torch.eye(9, dtype=torch.float64)
    triples = torch.combinations(torch.arange(9), 3)
    rows, ranks = [], []
    for h in H:
        basis = conforming(h)[0]
        rows.append(torch.stack([join(*units[triple], *basis) for triple in triples], 1))
        together = torch.cat(rows)
        ranks.append(rank(together[together.norm(dim=1) > 1e-12]))
    error = apart(dyn.translating_planes(H, method="thesis").homography_at_infinity, infinity)
    return Finding(
        ranks == [20, 39, 57, 74, 83] and error < EXACT, f"rank of 1..5 planes in 84 unknowns: {ranks}; H_inf to {error:.0e}"
    )


@CHAPTER.states(
    "1.4, p. 10", "five homographies are sufficient", "not where the epipoles are collinear: motions parallel to a ground plane"
)
def ground_plane() -> Finding:
    H, _, _ = planes(5, seeded(3), flat=True)
    units = torch.eye(9, dtype=torch.float64)
    triples = torch.combinations(torch.arange(9), 3)
    rows = torch.cat([torch.stack([join(*units[triple], *conforming(h)[0]) for triple in triples], 1) for h in H])
    nullity = 84 - rank(rows[rows.norm(dim=1) > 1e-12])
    return Finding(nullity == 1, f"5 planes whose epipoles are on one line: nullity {nullity}")


@CHAPTER.states("beyond 1.4", "three homographies suffice without linearity, four in a linear system of 64 unknowns")
def fewer() -> Finding:
    errors = {}
    for n in (3, 4):
        H, infinity, _ = planes(n, seeded(4 + n))
        errors[n] = apart(dyn.translating_planes(H).homography_at_infinity, infinity)
    return Finding(max(errors.values()) < EXACT, "; ".join(f"{n} planes: H_inf to {error:.0e}" for n, error in errors.items()))


@CHAPTER.states("1.4, p. 10", "two homographies of planes of a static scene recover its fundamental matrix (the classic result)")
def classic() -> Finding:
    draw = seeded(9)
    infinity, e = rotation(0.3 * uniform(3, draw=draw)), normal(3, draw=draw)
    H = infinity + 0.5 * e[None, :, None] * normal(2, 1, 3, draw=draw)
    spaces = torch.cat([conforming(h)[0] for h in H])
    left = torch.linalg.svd(spaces.mT).Vh[-1]  # the combination of the six rows that vanishes: one F is in both spaces
    F = (left[:3] @ spaces[:3]).reshape(3, 3)
    return Finding(
        apart(F, skew(e) @ infinity) < EXACT, f"rank of both spaces {rank(spaces)}; F to {apart(F, skew(e) @ infinity):.0e}"
    )


@CHAPTER.states(
    "1.5, p. 12 (Manning and Dyer)", "two fundamental matrices of translating bodies leave only the homography at infinity to find"
)
def known_fundamentals() -> Finding:
    _, infinity, F = planes(2, seeded(10))
    error = apart(dyn.translating_planes(fundamentals=F).homography_at_infinity, infinity)
    return Finding(error < EXACT, f"H_inf to {error:.0e}")


@CHAPTER.states("1.4, p. 10", "F belongs to each of the views", "to each of the bodies")
def wording() -> Finding:
    _, _, F = planes(3, seeded(11))
    return Finding(rank(F.flatten(1)) == 1, f"one pair of views, three bodies: rank of their F {rank(F.flatten(1))}")
