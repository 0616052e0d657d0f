"""Configurations of shape tensors beyond those of P^3 -> P^2 at rest: any projections, and points that move."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, product

import numpy as np

from dyntorch.counting.exact import Field, IntArray, Step

LARGEST = 1500
"""Unknowns that are counted in seconds."""


def lifted_shape(
    field: Field, *, images: int | None = None, synthetic: bool = False, points: int = 8, space: int = 4, image: int = 2
) -> list[Step]:
    """Images P^k -> P^l of points of P^k, each a match, projections eliminated: lifted shape tensor."""
    if not 1 <= image < space:
        raise ValueError(f"projections lower the dimension: image must be 1 to space - 1, got space = {space}, image = {image}")
    least = -(-(space + 1) * (image + 1) // image)
    if not least <= points <= 2 * space + 2:
        raise ValueError(f"points must be {least} to {2 * space + 2} for P^{space} -> P^{image}, got {points}")
    others = points - space - 1
    even, more = divmod(space + 1, others)
    tables = Partitions(field, space + 1, (even + 1,) * more + (even,) * (others - more))
    if tables.width > LARGEST:
        raise ValueError(f"{tables.width:,} unknowns are too many; up to {LARGEST:,} are counted, give fewer points or dimensions")
    shape = np.vstack([np.eye(space + 1, dtype=np.int64), field.random(others, space + 1)])

    def seen() -> IntArray:
        return tables.rows(field.product(shape, field.random(space + 1, image + 1)))

    def constraints() -> IntArray:
        return tables.synthetic(points, image)

    return [Step("synthetic", int(synthetic), constraints, constraint=True), Step("image", images, seen)]


def dynamic_shape(
    field: Field, *, images: int | None = None, synthetic: bool = False, coplanar_base: bool = False, degree: int = 1
) -> list[Step]:
    """Images of six points at constant velocity (or higher degree) at known times, each through another camera of the plane."""
    if not 1 <= degree <= 4:
        raise ValueError(f"degree must be 1 to 4, got {degree}")
    paths = field.random(degree + 1, 6, 4)
    paths[1:, :, 3], paths[0, :, 3] = 0, 1
    tables = Partitions(field, 4, (2, 2))
    size = (2 if coplanar_base else 9) * degree + 1

    def powers(time: int) -> IntArray:
        return np.array([pow(time, d, field.prime) for d in range(size)], dtype=np.int64)

    def places(time: int) -> IntArray:
        moved = sum(path * pow(time, d, field.prime) % field.prime for d, path in enumerate(paths)) % field.prime
        return field.product(moved, field.random(4, 3))

    if coplanar_base:
        # the first four stand still in the plane Z = 0
        paths[1:, :4], paths[0, :4, 2] = 0, 0

    def seen() -> IntArray:
        time = int(field.random(1)[0])
        x = places(time)
        row = _across(field, x) if coplanar_base else tables.rows(x)
        return field.kron(powers(time), row)

    def constraints() -> IntArray:
        if coplanar_base:
            return np.zeros((1, 3 * size), dtype=np.int64)
        return field.kron(np.eye(size, dtype=np.int64), tables.synthetic(6, 2))

    return [Step("synthetic", int(synthetic), constraints, constraint=True), Step("image", images, seen)]


def _across(field: Field, x: IntArray) -> IntArray:
    """The line through the images of points 5 and 6 in the frame of the first four: p5 x p6."""
    frame = x[:3]
    others = field.product(x[3:], field.inverse(frame))
    one = np.array([pow(int(v), -1, field.prime) for v in others[0]], dtype=np.int64)
    a, b = (p * one % field.prime for p in others[1:])
    return np.array([[(int(a[i]) * int(b[j]) - int(a[j]) * int(b[i])) % field.prime for i, j in ((1, 2), (2, 0), (0, 1))]])


class Partitions:
    """The ordered partitions of the basis into sets of given sizes: what a view puts before each of the unknowns."""

    def __init__(self, field: Field, size: int, profile: Sequence[int]) -> None:
        self.field, self.size, self.profile = field, size, tuple(profile)
        found = list(_ordered(tuple(range(size)), self.profile))
        places = [{chosen: i for i, chosen in enumerate(combinations(range(size), a))} for a in self.profile]
        self.index = [np.array([places[j][parts[j]] for parts in found]) for j in range(len(self.profile))]
        flat = [[i for part in parts for i in part] for parts in found]
        odd = [sum(a > b for n, a in enumerate(order) for b in order[n + 1 :]) % 2 for order in flat]
        self.sign = np.where(np.array(odd) == 1, field.prime - 1, 1)

    @property
    def width(self) -> int:
        """Unknowns."""
        return len(self.sign)

    def rows(self, x: IntArray) -> IntArray:
        """Rows of one view ``(n, l + 1)``: one for every choice of hyperplanes through the points behind the basis."""
        field, slots = self.field, []
        for j, a in enumerate(self.profile):
            incidence = field.product(field.null(x[self.size + j]), x[: self.size].T)
            minors = np.stack([field.join(incidence[list(chosen)]) for chosen in combinations(range(len(incidence)), a)])
            slots.append(minors[:, self.index[j]])
        rows = []
        for chosen in product(*(range(len(slot)) for slot in slots)):
            row = self.sign
            for slot, i in zip(slots, chosen, strict=True):
                row = row * slot[i] % field.prime
            rows.append(row)
        return np.stack(rows)

    def synthetic(self, points: int, image: int) -> IntArray:
        """What vanishes in every view of any points: the null space of rows of no shape."""
        views: list[IntArray] = []
        while sum(map(len, views)) < self.width + 10:
            views.append(self.rows(self.field.random(points, image + 1)))
        return self.field.null(np.vstack(views))


def _ordered(left: tuple[int, ...], profile: tuple[int, ...]) -> list[tuple[tuple[int, ...], ...]]:
    if not profile:
        return [()]
    chosen = combinations(left, profile[0])
    return [(part, *rest) for part in chosen for rest in _ordered(tuple(i for i in left if i not in part), profile[1:])]
