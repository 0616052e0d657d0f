"""Exact linear algebra modulo a prime: what a configuration of matches is drawn from, and what its rank is counted with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import comb
from typing import Literal

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
        right_float, mask = right.astype(np.float64), (1 << PIECE) - 1
        total = np.zeros((), dtype=np.int64)
        for shift in (2 * PIECE, PIECE, 0):
            piece = ((left >> shift) & mask).astype(np.float64)
            total = ((total << PIECE) + (piece @ right_float).astype(np.int64)) % self.prime
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
        array = np.asarray(values)
        if array.dtype.kind not in "iuO" or (array.dtype.kind == "O" and not all(isinstance(value, int) for value in array.flat)):
            raise ValueError(f"the field has integers only, got {array.dtype}; scale fractions to integers first")
        return (array % self.prime).astype(np.int64)


class Echelon:
    """Reduced row echelon form that grows as rows arrive; whether a row raises the rank depends on the rows before it only."""

    def __init__(self, field: Field, width: int) -> None:
        self.field, self.width = field, width
        self.basis: IntArray = np.zeros((0, width), dtype=np.int64)
        self.pivots: list[int] = []

    @property
    def rank(self) -> int:
        """Number of independent rows so far."""
        return len(self.pivots)

    def add(self, rows: IntArray) -> NDArray[np.bool_]:
        """Add rows, already reduced modulo the prime, and say which of them raised the rank."""
        prime = self.field.prime
        rows = (rows - self.field.product(rows[:, self.pivots], self.basis)) % prime
        raised = np.zeros(len(rows), dtype=bool)
        pivots: list[int] = []
        for i in range(len(rows)):
            pivot = int((rows[i] != 0).argmax())
            if rows[i, pivot] == 0:
                continue
            scaled = rows[i] * pow(int(rows[i, pivot]), -1, prime) % prime
            rows = (rows - rows[:, pivot, None] * scaled % prime) % prime
            rows[i] = scaled
            raised[i] = True
            pivots.append(pivot)
        new = rows[raised]
        old = (self.basis - self.field.product(self.basis[:, pivots], new)) % prime
        self.basis = np.vstack([old, new])
        self.pivots += pivots
        return raised


# ----------------------------------------------------------------------------------------------------------------------
# A step of a configuration: matches of one kind.


@dataclass(frozen=True)
class Step:
    """Matches of one kind. draw ``(rows, width)``."""

    kind: str
    matches: int | None
    draw: Callable[[], IntArray]
    constraint: bool = False
    patience: int = 20


Configuration = Callable[..., list[Step]]


# ----------------------------------------------------------------------------------------------------------------------
# Views of a projective space, and the rows that geometric primitives in it give to an estimation matrix.


Measure = Literal["join", "hyper"]

LARGEST = 4096  # unknowns
CAMERAS = 1 << 17  # entries of all projections


class Views:
    r"""Random projections :math:`P^k \to P^{l_v}`, and what is measured in each. cameras ``(l_v + 1, k + 1)``."""

    def __init__(
        self,
        field: Field,
        k: int,
        views: Sequence[int],
        measure: Sequence[Measure | int],
        cameras: Sequence[IntArray] | None = None,
        points: int = 1,
    ) -> None:
        check_size(k, views, measure, points)
        self.field, self.k, self.measure = field, k, tuple(measure)
        self.cameras = [field.random(size + 1, k + 1) for size in views] if cameras is None else list(cameras)

    def extensor(self, step: int) -> IntArray:
        """Random points, one per row, that span an extensor of this step."""
        return self.field.random(step, self.k + 1)

    def within(self, extensor: IntArray, number: int = 1) -> IntArray:
        """Random points inside an extensor."""
        return self.field.product(self.field.random(number, len(extensor)), extensor)

    def images(self, primitives: Sequence[IntArray]) -> list[IntArray]:
        """What each view measures of its primitive: one row (``join``), or several (``hyper``)."""
        seen = [self.field.product(points, camera.T) for points, camera in zip(primitives, self.cameras, strict=True)]
        return [self.measure_points(points, kind) for points, kind in zip(seen, self.measure, strict=True)]

    def measure_points(self, points: IntArray, kind: Measure | int) -> IntArray:
        """What a view measures of the primitive that these points of it span, ``(rows, width)``."""
        if kind == "join":
            return self.field.join(points)[None]
        through = self.field.null(points)
        return (
            through
            if kind in ("hyper", 1)
            else np.stack([self.field.join(through[list(c)]) for c in combinations(range(len(through)), int(kind))])
        )

    def static_rows(self, primitive: IntArray) -> IntArray:
        """Rows of a primitive that does not move."""
        return self.field.kron(*self.images([primitive] * len(self.cameras)))

    def moving_rows(self, extensor: IntArray, number: int = 1) -> IntArray:
        """Rows of a primitive spanned by this number of points that are anywhere within an extensor, in every view anew."""
        return self.field.kron(*self.images([self.within(extensor, number) for _ in self.cameras]))

    def labelled_rows(self, primitive: IntArray, free: int = 1) -> IntArray:
        """Rows of a primitive that is known not to move: any measurement of one view (or of more) completes those of the others."""
        seen = self.images([primitive] * len(self.cameras))
        anything = [np.eye(image.shape[1], dtype=np.int64) for image in seen]
        chosen = combinations(range(len(seen)), free)
        return np.vstack([self.field.kron(*(anything[v] if v in c else seen[v] for v in range(len(seen)))) for c in chosen])

    def star_rows(self, extensor: IntArray) -> IntArray:
        """Rows of an extensor, any point of which matches any other."""
        return self.field.kron(*(self.field.product(extensor, camera.T) for camera in self.cameras))


def check_size(k: int, views: Sequence[int], measure: Sequence[Measure | int], points: int) -> None:
    """Refuse numbers whose rows would not fit, before any is drawn."""
    if max((k, *views)) >= LARGEST or len(views) > LARGEST:
        raise ValueError(f"{max(k, len(views), *views):,} dimensions or views are too many; give fewer than {LARGEST:,}")
    cameras = sum((size + 1) * (k + 1) for size in views)
    if cameras > CAMERAS:
        raise ValueError(f"the projections have {cameras:,} entries; up to {CAMERAS:,} are counted within a minute or so")
    width = rows = 1
    for size, kind in zip(views, measure, strict=True):
        used = points if kind == "join" else 1 if kind == "hyper" else int(kind)
        width *= comb(size + 1, used)
        rows *= 1 if kind == "join" else comb(size + 1 - points, used)
        if width > LARGEST:
            break
    if width > LARGEST or rows > LARGEST:
        at_least = "at least " if width > LARGEST else ""
        raise ValueError(
            f"{at_least}{max(width, rows):,} unknowns are too many; up to {LARGEST:,} are counted within a minute or so: "
            "take fewer or smaller views"
        )


# ----------------------------------------------------------------------------------------------------------------------
# Rank while matches arrive.


BLOCK = 32  # rows eliminated together: 728 of width 729 take 0.6 s, as with 16 or 64; one by one they take 8 s


@dataclass(frozen=True)
class Kind:
    """What the matches of one kind add.

    Args:
        name: of the kind.
        matches: how many there are.
        useful: how many of them raise the rank.
        rank: of all matches up to the last of these.
    """

    name: str
    matches: int
    useful: int
    rank: int


class Tally:
    """Counts the ranks of steps of matches, one step after the other."""

    def __init__(self, field: Field) -> None:
        self.field = field
        self.profile: list[int] = []
        self.kinds: list[Kind] = []
        self.echelon: Echelon | None = None

    @property
    def rank(self) -> int:
        """Of everything so far."""
        return 0 if self.echelon is None else self.echelon.rank

    def add_step(self, step: Step) -> None:
        """Add the matches of a step to the profile; a constraint raises the rank only."""
        before = self.rank
        ranks = self.ranks(step)
        if ranks and not step.constraint:
            self.profile += ranks
            self.kinds.append(Kind(step.kind, len(ranks), len({before, *ranks}) - 1, self.rank))

    def ranks(self, step: Step) -> list[int]:
        """Rank after each match of a step; where their number is open, up to the last one that raises it."""
        ranks: list[int] = []
        last, idle, ended = self.rank, 0, False
        while not ended and idle < step.patience and (step.matches is None or len(ranks) < step.matches):
            block, ended = self._draw(step, None if step.matches is None else step.matches - len(ranks))
            for rank in self._add(block):
                last, idle = rank, 0 if rank > last else idle + 1
                ranks.append(rank)
        if step.matches is None:
            return ranks[: len(ranks) - idle]
        if ended and len(ranks) < step.matches:
            raise ValueError(f"the sampler ended after {len(ranks)} matches, {step.matches} were asked for")
        return ranks + [self.rank] * (step.matches - len(ranks))

    def _draw(self, step: Step, max_matches: int | None) -> tuple[list[IntArray], bool]:
        """The next matches, about a block of rows, and whether there are no others."""
        block: list[IntArray] = []
        while sum(map(len, block)) < BLOCK and (max_matches is None or len(block) < max_matches):
            try:
                block.append(step.draw())
            except StopIteration:
                return block, True
        return block, False

    def _add(self, block: Sequence[IntArray]) -> list[int]:
        """Rank after each match of a block."""
        if not block:
            return []
        widths = {rows.shape[-1] for rows in block} | ({self.echelon.width} if self.echelon is not None else set())
        if len(widths) > 1 or any(rows.ndim != 2 for rows in block):
            raise ValueError(f"every match must give rows (rows, width) of one width, got widths {sorted(widths)}")
        if max(widths) > LARGEST:
            raise ValueError(f"{max(widths):,} unknowns are too many; up to {LARGEST:,} are counted within a minute or so")
        self.echelon = self.echelon or Echelon(self.field, widths.pop())
        before = self.rank
        raised = np.concatenate([[0], self.echelon.add(np.vstack(block)).cumsum()])
        return [before + int(raised[end]) for end in np.cumsum([len(rows) for rows in block])]
