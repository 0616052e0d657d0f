"""Chapter 9 of the thesis, checked: the dimensions of spaces of multilinear constraints, by representation theory.

Every count is compared with a rank by its definition: products of random vectors of a prime field, by elimination in integers, in
this file; the library computes the same counts by hook lengths.
"""

from __future__ import annotations

from itertools import product
from math import comb

import numpy as np
from numpy.typing import NDArray

from dyntorch.counting import count, dim_v, partitions, semistandard_tableaux, standard_tableaux
from experiments.thesis.statements import Chapter, Finding

CHAPTER = Chapter(9, "counting")
PRIME = 1_000_003


def rank_mod(matrix: NDArray[np.int64]) -> int:
    """Rank over the integers modulo a prime, by elimination."""
    rows, found = matrix % PRIME, 0
    for column in range(rows.shape[1]):
        below = np.flatnonzero(rows[found:, column])
        if not below.size:
            continue
        rows[[found, found + below[0]]] = rows[[found + below[0], found]]
        rows[found] = rows[found] * pow(int(rows[found, column]), PRIME - 2, PRIME) % PRIME
        others = np.flatnonzero(rows[found + 1 :, column]) + found + 1
        rows[others] = (rows[others] - rows[others, column][:, None] * rows[found]) % PRIME
        found += 1
        if found == len(rows):
            break
    return found


def by_definition(n: int, m: int, k: int) -> int:
    """dim V(n, m, k): the span of products of m vectors of R^n that lie in a space of dimension k."""
    draw = np.random.default_rng(100 * n + 10 * m + k)
    rows = []
    for _ in range(n**m + 5):
        basis = draw.integers(0, PRIME, (k, n))
        row = np.ones(1, dtype=np.int64)
        for _ in range(m):
            vector = draw.integers(0, PRIME, k) @ basis % PRIME
            row = (row[:, None] * vector).ravel() % PRIME
        rows.append(row)
    return rank_mod(np.array(rows))


@CHAPTER.states(
    "9.4, claim 1",
    "dim V(n,m,k) is the sum of f_lambda s_lambda over the partitions of m into at most k parts",
    "s_lambda must be d_lambda(n), the tableaux with entries up to n",
)
def claim() -> Finding:
    cases = [(n, m, k) for n, m in product(range(1, 6), range(1, 6)) if n**m <= 130 for k in range(1, m + 1)]
    right = sum(by_definition(*case) == dim_v(*case) for case in cases)
    printed = sum(standard_tableaux(part) ** 2 for part in partitions(3) if len(part) <= 2)  # s read as f
    return Finding(
        right == len(cases) and printed == dim_v(3, 3, 2),
        f"with d_lambda(n) {right} of {len(cases)} cases equal the rank by definition",
    )


@CHAPTER.states("9.4", "V of all m vectors is the whole space: the sum of f d over all partitions is n^m")
def whole() -> Finding:
    cases = [(n, m) for n in range(1, 6) for m in range(1, 7)]
    right = sum(sum(standard_tableaux(part) * semistandard_tableaux(part, n) for part in partitions(m)) == n**m for n, m in cases)
    return Finding(right == len(cases), f"{right} of {len(cases)} pairs (n, m)")


@CHAPTER.states("9.4.1, p. 122", "closed forms for k = m - 1, m - 2 and m - 3")
def closed() -> Finding:
    def missing(n: int, m: int, less: int) -> float:
        value = float(comb(n, m)) + (less > 1) * (m - 1) ** 2 * comb(n + 1, m)
        if less > 2:
            value += comb(m - 1, 2) ** 2 * comb(n + 2, m) + (m >= 4) * m * (m - 3) ** 2 * n / 4 * comb(n + 1, m - 1)
        return value

    cases = [(n, m, less) for n in range(1, 8) for less in (1, 2, 3) for m in range(less, 8)]
    right = sum(dim_v(n, m, m - less) == n**m - missing(n, m, less) for n, m, less in cases if m > less)
    total = sum(m > less for _, m, less in cases)
    return Finding(right == total, f"{right} of {total} triples")


NUMBERS = (
    ("9.3, p. 119", "moving points of a plane in three views: dim V(3,3,2) = 26", (3, 3, 2), 26),
    ("9.3, p. 119", "of space: dim V(4,3,2) = 60", (4, 3, 2), 60),
    ("9.3, p. 119", "static points of a plane: dim V(3,3,1) = 10", (3, 3, 1), 10),
    ("9.3, p. 120", "of space: dim V(4,3,1) = 20", (4, 3, 1), 20),
    ("9.4.1, p. 123", "the 8-point shape tensor: dim V(3,4,2) = 72", (3, 4, 2), 72),
    ("9.3, p. 119", "points on one line: dim V(2,3,2) = 8", (2, 3, 2), 8),
    ("9.4.1, p. 123", "static ones among them: dim V(2,3,1) = 4", (2, 3, 1), 4),
)


def _state(place: str, says: str, case: tuple[int, int, int], value: int) -> None:
    @CHAPTER.states(place, says)
    def number() -> Finding:
        found = by_definition(*case)
        return Finding(found == dim_v(*case) == value, f"rank by definition {found}, by hook lengths {dim_v(*case)}")


for statement in NUMBERS:
    _state(*statement)


@CHAPTER.states("9.4.1, p. 123", "its sum: partitions (4), (2,2), (3,1) with f = 1, 2, 3 and d = 15, 6, 15")
def parts() -> Finding:
    found = [(standard_tableaux(part), semistandard_tableaux(part, 3)) for part in ((4,), (2, 2), (3, 1))]
    return Finding(found == [(1, 15), (2, 6), (3, 15)], f"(f, d) = {found}")


@CHAPTER.states("9.3, p. 119", "n >= m >= k", "m >= k is enough: its own V(2,3,2) and V(3,4,2) have n < m")
def ordered() -> Finding:
    cases = [(2, 3, 2), (3, 4, 2), (2, 5, 2)]
    right = sum(by_definition(*case) == dim_v(*case) for case in cases)
    return Finding(right < len(cases), f"claim 1 is right in {right} of {len(cases)} cases with n < m")


@CHAPTER.states(
    "9.4, p. 122",
    "partitions of m longer than k correspond to all partitions of all numbers up to m - k - 1",
    "only where m <= 2k + 2: then and only then",
)
def correspondence() -> Finding:
    def equal(m: int, k: int) -> bool:
        return sum(len(part) > k for part in partitions(m)) == sum(len(list(partitions(q))) for q in range(m - k))

    cases = [(m, k) for m in range(1, 10) for k in range(1, m)]
    as_said = sum(equal(*case) for case in cases)
    corrected = sum(equal(m, k) == (m <= 2 * k + 2) for m, k in cases)
    return Finding(as_said == len(cases), f"true in {as_said} of {len(cases)} cases; 'exactly where m <= 2k + 2' in {corrected}")


@CHAPTER.states(
    "1.5, p. 13",
    "how many points for the fundamental matrix; constraints on the trifocal tensor from a plane; rank of three images of points",
)
def questions() -> Finding:
    answers = count("fundamental").rank, count("trifocal", coplanar=60).rank, count(3, views=[2, 2, 2]).rank
    return Finding(answers == (8, 21, 17), f"8 points (rank {answers[0]} of 9); {answers[1]} constraints; rank {answers[2]} of 27")
