r"""Leaky online warping: every exemplar frame holds how well the last half second fits what led up to it.

.. math:: a_j(t) = g\,\max(a_{j-1},\; a_j - s,\; a_{j-2} - s)(t-1) + (1 - g)\,\langle f_t, f_j\rangle,\qquad g = 1 - 1/window

One float per library frame is all the memory; steps of 0, 1 and 2 library frames allow for half to double tempo.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor

from indexing.brightness.library import Library

SLACK = 0.02  # price of a step other than 1
BLOCK = 32  # frames compared at once: library rows are read once per block


class Warping:
    """The state of one stream against a library.

    Args:
        window: frames of memory.
    """

    def __init__(self, source: Library, window: float) -> None:
        self.source, self.keep = source, 1 - 1 / window
        self.state = source.rows.new_zeros(len(source.rows))
        self.held = 1.0

    def push(self, rows: Tensor) -> Tensor:
        """``(n, classes)`` scores after each of ``n`` more frames ``(n, D)``: the best exemplar frame's, cold start corrected."""
        rows = rows @ self.source.basis
        return torch.cat([self._block(part) for part in rows.split(BLOCK)]) if len(rows) else self._tops(rows @ self.source.rows.T)

    def _block(self, rows: Tensor) -> Tensor:
        states = rows @ self.source.rows.T
        states *= 1 - self.keep
        slower = torch.empty_like(self.state)
        before = self.state
        known = []
        for state in states:
            torch.sub(before, SLACK, out=slower)
            best = slower.clone()
            torch.maximum(best[2:], slower[:-2], out=best[2:])
            torch.maximum(best[1:], before[:-1], out=best[1:])
            state.add_(best, alpha=self.keep)
            state[self.source.gaps] = 0
            before = state
            self.held *= self.keep
            known.append([1 - self.held])
        self.state = before.clone()
        return self._tops(states) / states.new_tensor(known)

    def _tops(self, states: Tensor) -> Tensor:
        """``(n, classes)`` largest state of each class."""
        sizes = [b - a for a, b in pairwise(self.source.bounds)]
        return torch.stack([part.amax(1) for part in states.split(sizes, dim=1)], dim=1)
