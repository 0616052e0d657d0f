"""The points of one view, as every format gives them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing.opening import error

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class PointSet:
    """Points or lines of one view.

    Attributes:
        path: where they come from, with the frame or the key where the file holds several views.
        values: ``(n, d)`` points, ``(n, 2, 3)`` lines by two points each, or ``(n, 6)`` lines in Pluecker coordinates; NaN =
            missing.
        ids: a name for each; None = they have none.
        weights: ``(n,)`` not negative; None = all equal.
        static: ``(n,)`` known not to move; None = not known of any.
    """

    path: str
    values: FloatArray
    ids: tuple[str, ...] | None = None
    weights: FloatArray | None = None
    static: BoolArray | None = None

    @property
    def lines(self) -> bool:
        """Whether these are lines."""
        return self.values.ndim == 3 or self.values.shape[-1] == 6


def as_view(values: Any, path: str | Path, lines: bool = False) -> FloatArray:
    """An array of a file as points ``(n, 2 | 3)`` or lines ``(n, 2, 3)`` or ``(n, 6)``, float64.

    Raises:
        ValueError: another shape, no rows, values that are no real numbers, or infinite.
    """
    array = np.asarray(values)
    expected = "lines are (n, 2, 3), two points each, or (n, 6), Pluecker" if lines else "points are (n, 2) or (n, 3)"
    if array.dtype.kind not in "fiu":
        raise error(path, f"holds values of type {array.dtype}", "give real numbers")
    fits = array.shape[1:] in ((2, 3), (6,)) if lines else array.shape[1:] in ((2,), (3,))
    if array.ndim < 2 or not fits:
        raise error(path, f"the array has shape {array.shape}", expected)
    if not len(array):
        raise error(path, "the array is empty", "give at least one row")
    infinite = np.argwhere(np.isinf(array))
    if len(infinite):
        at = tuple(int(i) for i in infinite[0])
        raise error(path, f"row {at[0] + 1}, column {at[-1] + 1}: {array[at]} is not finite", "correct it, or use NaN for missing")
    with np.errstate(invalid="ignore"):  # of bytes that are no number of any kind, but NaN
        return array.astype(np.float64)
