r"""The best explanation of a recording as segments that do not overlap, and how likely each frame belongs to each class.

A recording is a row of ``n`` cells between ``n + 1`` edges.  A window is a run of cells that may be one segment of one class; a
cell that lies in none is background.  An explanation's value is the sum of its segments' and of its background cells', so that
dynamic programming over the edges finds the best one: a hidden semi-Markov model whose states are the classes.

.. math:: V_e = \max\Bigl(V_{e-1} + b_{e-1},\; \max_{(s,e),c} V_s + S_{(s,e),c}\Bigr)

Source: Ostendorf et al. 1996 (segment models); Sarawagi and Cohen 2004 (semi-Markov fields).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


@dataclass(frozen=True)
class TiledSegment:
    """A run of cells, from edge ``first`` to edge ``last``, of one class (its number), what it is worth, and which window it is."""

    first: int
    last: int
    label: int
    value: float
    window: int


def best_tiling(windows: Array, values: Array, background: Array) -> tuple[list[TiledSegment], float]:
    """The segments of the best explanation, in order, and its value. windows ``(W, 2)``."""
    label = values.argmax(axis=1) if len(values) else np.empty(0, dtype=np.intp)
    best = values.max(axis=1) if len(values) else np.empty(0)
    total, chosen = _forward(windows, best, background)
    found: list[TiledSegment] = []
    edge = len(background)
    while edge > 0:
        window = int(chosen[edge])
        if window < 0:
            edge -= 1
            continue
        found.append(TiledSegment(int(windows[window, 0]), edge, int(label[window]), float(best[window]), window))
        edge = int(windows[window, 0])
    return found[::-1], float(total[-1])


def through(windows: Array, values: Array, background: Array) -> Array:
    """``(W,)`` the value of the best explanation that holds each window."""
    best = values.max(axis=1)
    before, _ = _forward(windows, best, background)
    after = _backward(windows, best, background, soft=False)
    return np.asarray(before[windows[:, 0]] + best + after[windows[:, 1]])


def posterior(windows: Array, values: Array, background: Array, temperature: float) -> Array:
    r"""``(cells, classes)`` how likely each cell belongs to each class, 0..1; what is left to 1 is background."""
    cells, classes = len(background), values.shape[1]
    if not len(windows):
        return np.zeros((cells, classes))
    scaled, calm = values / temperature, background / temperature
    each = np.logaddexp.reduce(scaled, axis=1)
    before = _backward(cells - windows[::-1, ::-1], each[::-1], calm[::-1], soft=True)[::-1]
    after = _backward(windows, each, calm, soft=True)
    likely = np.exp(np.minimum(before[windows[:, 0], None] + scaled + after[windows[:, 1], None] - after[0], 0.0))
    change = np.zeros((cells + 1, classes))
    np.add.at(change, windows[:, 0], likely)
    np.add.at(change, windows[:, 1], -likely)
    return np.asarray(np.clip(np.cumsum(change, axis=0)[:cells], 0.0, 1.0))


def _forward(windows: Array, best: Array, background: Array) -> tuple[Array, Array]:
    """``(edges,)`` value of the best explanation up to each edge, and the window that ends it there (-1: a background cell)."""
    cells = len(background)
    bounds = np.searchsorted(windows[:, 1], np.arange(cells + 2))
    first = windows[:, 0]
    total, chosen = np.zeros(cells + 1), np.full(cells + 1, -1)
    for edge in range(1, cells + 1):
        total[edge] = total[edge - 1] + background[edge - 1]
        low, high = bounds[edge], bounds[edge + 1]
        if high > low:
            value = total[first[low:high]] + best[low:high]
            at = int(value.argmax())
            if value[at] > total[edge]:
                total[edge], chosen[edge] = value[at], low + at
    return total, chosen


def _backward(windows: Array, best: Array, background: Array, soft: bool) -> Array:
    """``(edges,)`` the value of the best explanation from each edge on; ``soft``: the logarithm of the sum of all."""
    cells = len(background)
    order = np.argsort(windows[:, 0], kind="stable")
    bounds = np.searchsorted(windows[order, 0], np.arange(cells + 2))
    last, best = windows[order, 1], best[order]
    total = np.zeros(cells + 1)
    for edge in range(cells - 1, -1, -1):
        low, high = bounds[edge], bounds[edge + 1]
        values = np.append(total[last[low:high]] + best[low:high], total[edge + 1] + background[edge])
        top = values.max()
        total[edge] = top + np.log(np.exp(values - top).sum()) if soft else top
    return total
