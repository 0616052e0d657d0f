"""Exact linear algebra modulo a prime: what a configuration of matches is drawn from, and what its rank is counted with."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

IntArray = NDArray[np.int64]

PIECE = 11  # bits: 11-bit pieces times 31-bit numbers, 2048 of them added, stay under 2**53, so float64 products are exact
INNER = 2048
SMALL = 64  # entries of matrices for which integer products are twice as fast as those of pieces


class Field:
    """Integers modulo a prime below 2**31, with a generator of random elements.

    Args:
        prime: the modulus.
        seed: of the random elements.

    Example:
        >>> field = Field(2**31 - 1, seed=0)
        >>> point = field.random(3)
        >>> bool((field.product(field.null(point), point) == 0).all())
        True
    """

    def __init__(self, prime: int, seed: int | list[int] = 0) -> None:
        if not 2 < prime < 2**31:
            raise ValueError(f"prime must lie between 2 and 2**31, so that products fit into 62 bits, got {prime}")
        self.prime = prime
        self._generator = np.random.default_rng(seed)

    def random(self, *shape: int) -> IntArray:
        """Uniform elements."""
        return self._generator.integers(0, self.prime, shape)

    def product(self, first: ArrayLike, second: ArrayLike) -> IntArray:
        """``first @ second`` for integer matrices or vectors, exact: three float64 products of pieces that cannot overflow."""
        left, right = self.reduce(first), self.reduce(second)
        if left.size <= SMALL and right.size <= SMALL:
            terms = left * right if right.ndim == 1 else left[..., None] * right
            return (terms % self.prime).sum(-right.ndim) % self.prime
        if left.shape[-1] > INNER:
            return (self.product(left[..., :INNER], right[:INNER]) + self.product(left[..., INNER:], right[INNER:])) % self.prime
        whole, mask = right.astype(np.float64), (1 << PIECE) - 1
        total = np.zeros((), dtype=np.int64)
        for shift in (2 * PIECE, PIECE, 0):
            piece = ((left >> shift) & mask).astype(np.float64)
            total = ((total << PIECE) + (piece @ whole).astype(np.int64)) % self.prime
        return total

    def kron(self, *factors: ArrayLike) -> IntArray:
        """Kronecker products of rows, every row of one factor with every row of the others: ``(r1 r2..., n1 n2...)``."""
        rows = np.ones((1, 1), dtype=np.int64)
        for factor in factors:
            right = np.atleast_2d(self.reduce(factor))
            rows = (rows[:, None, :, None] * right[None, :, None, :] % self.prime).reshape(len(rows) * len(right), -1)
        return rows

    def join(self, points: ArrayLike) -> IntArray:
        """Pluecker coordinates of the extensor of the given rows: minors in lexicographic order (01, 02, 03, 12, 13, 23)."""
        first, *others = np.atleast_2d(self.reduce(points)).tolist()
        minors: dict[tuple[int, ...], int] = {(i,): value for i, value in enumerate(first)}
        for step, point in enumerate(others, start=2):
            minors = {
                chosen: sum(
                    (-1) ** (step - 1 - at) * point[i] * minors[chosen[:at] + chosen[at + 1 :]] for at, i in enumerate(chosen)
                )
                % self.prime
                for chosen in combinations(range(len(first)), step)
            }
        return np.array(list(minors.values()), dtype=np.int64)

    def null(self, matrix: ArrayLike) -> IntArray:
        """Basis ``(n - rank, n)`` of the right null space of a matrix; of one point, the hyperplanes through it."""
        rows = np.atleast_2d(self.reduce(matrix))
        echelon = Echelon(self, rows.shape[1])
        echelon.add(rows)
        free = np.setdiff1d(np.arange(rows.shape[1]), echelon.pivots)
        basis = np.zeros((len(free), rows.shape[1]), dtype=np.int64)
        basis[np.arange(len(free)), free] = 1
        basis[:, echelon.pivots] = -echelon.basis[:, free].T % self.prime
        return basis

    def inverse(self, matrix: ArrayLike) -> IntArray:
        """Inverse of a square matrix."""
        square = self.reduce(matrix)
        size = len(square)
        echelon = Echelon(self, 2 * size)
        echelon.add(np.hstack([square, np.eye(size, dtype=np.int64)]))
        if max(echelon.pivots) >= size:
            raise ValueError(f"matrix of shape {square.shape} has no inverse modulo {self.prime}")
        return echelon.basis[np.argsort(echelon.pivots), size:]

    def reduce(self, values: ArrayLike) -> IntArray:
        """Integers of any size as elements of the field."""
        found = np.asarray(values)
        if found.dtype.kind not in "iuO" or (found.dtype.kind == "O" and not all(isinstance(value, int) for value in found.flat)):
            raise ValueError(f"the field has integers only, got {found.dtype}; scale fractions to integers first")
        return (found % self.prime).astype(np.int64)


class Echelon:
    """Reduced row echelon form that grows as rows arrive; whether a row raises the rank depends on the rows before it only.

    Args:
        field: of the entries.
        width: length of a row.

    Example:
        >>> echelon = Echelon(Field(7), width=3)
        >>> echelon.add(np.array([[1, 2, 3], [2, 4, 6], [0, 0, 5]])).tolist(), echelon.rank
        ([True, False, True], 2)
    """

    def __init__(self, field: Field, width: int) -> None:
        self.field, self.width = field, width
        self.basis: IntArray = np.zeros((0, width), dtype=np.int64)
        self.pivots: list[int] = []

    @property
    def rank(self) -> int:
        """Number of independent rows so far."""
        return len(self.pivots)

    def add(self, rows: IntArray) -> NDArray[np.bool_]:
        """Add rows, already reduced modulo the prime, and say which of them raised the rank.

        The rows so far act through two matrix products; only within the new rows is elimination one by one.
        """
        prime = self.field.prime
        rows = (rows - self.field.product(rows[:, self.pivots], self.basis)) % prime
        raised = np.zeros(len(rows), dtype=bool)
        found: list[int] = []
        for i in range(len(rows)):
            pivot = int((rows[i] != 0).argmax())
            if rows[i, pivot] == 0:
                continue
            scaled = rows[i] * pow(int(rows[i, pivot]), -1, prime) % prime
            rows = (rows - rows[:, pivot, None] * scaled % prime) % prime
            rows[i] = scaled
            raised[i] = True
            found.append(pivot)
        new = rows[raised]
        old = (self.basis - self.field.product(self.basis[:, found], new)) % prime
        self.basis = np.vstack([old, new])
        self.pivots += found
        return raised
