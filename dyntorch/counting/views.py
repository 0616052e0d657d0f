"""Views of a projective space, and the rows that geometric primitives in it give to an estimation matrix."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from math import comb
from typing import Literal

import numpy as np

from dyntorch.counting.field import Field, IntArray

Measure = Literal["join", "hyper"]

LARGEST = 4096  # unknowns
CAMERAS = 1 << 17  # entries of all projections


class Views:
    r"""Random projections :math:`P^k \to P^{l_v}`, and what is measured in each.

    Primitives are given as the points that span them, ``(m, k + 1)``.  A view measures either their ``join``, the Pluecker
    coordinates of their extensor (a point stays a point), every ``hyper`` plane that contains them, or, given a number, every
    intersection of so many of these, as the Pluecker coordinates of the hyperplanes (a Grassmann tensor takes k + 1 in all).

    Args:
        field: where random elements come from.
        k: projective dimension of the space.
        views: projective dimensions ``l_v`` of the views.
        measure: ``"join"``, ``"hyper"`` or a number of hyperplanes, per view.
        cameras: the projections ``(l_v + 1, k + 1)``, where they are not random.
        points: that span a primitive.
    """

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
        return [self.measured(points, kind) for points, kind in zip(seen, self.measure, strict=True)]

    def measured(self, points: IntArray, kind: Measure | int) -> IntArray:
        """What a view measures of the primitive that these points of it span, ``(rows, width)``."""
        if kind == "join":
            return self.field.join(points)[None]
        through = self.field.null(points)
        return (
            through
            if kind in ("hyper", 1)
            else np.stack([self.field.join(through[list(c)]) for c in combinations(range(len(through)), int(kind))])
        )

    def fixed(self, primitive: IntArray) -> IntArray:
        """Rows of a primitive that does not move."""
        return self.field.kron(*self.images([primitive] * len(self.cameras)))

    def moving(self, extensor: IntArray, number: int = 1) -> IntArray:
        """Rows of a primitive spanned by this number of points that are anywhere within an extensor, in every view anew."""
        return self.field.kron(*self.images([self.within(extensor, number) for _ in self.cameras]))

    def labelled(self, primitive: IntArray) -> IntArray:
        """Rows of a primitive that is known not to move: any measurement of one view completes those of the others."""
        seen = self.images([primitive] * len(self.cameras))
        free = [np.eye(image.shape[1], dtype=np.int64) for image in seen]
        return np.vstack([self.field.kron(*seen[:view], free[view], *seen[view + 1 :]) for view in range(len(seen))])

    def filled(self, extensor: IntArray) -> IntArray:
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
        least = "at least " if width > LARGEST else ""
        raise ValueError(
            f"{least}{max(width, rows):,} unknowns are too many; up to {LARGEST:,} are counted within a minute or so: "
            "take fewer or smaller views"
        )
