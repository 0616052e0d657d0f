"""A match whose rows are not products of slots: one slot that holds all of it, and the function that gives its rows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NoReturn

import torch
from torch import Tensor

from dyntorch.primitives.base import Primitive


@dataclass(frozen=True, repr=False)
class Equations(Primitive):
    """All that one match measures, and the rows that it puts into the estimation matrix.

    For invariants from which something that belongs to each match (its camera) is eliminated: see
    :attr:`dyntorch.Invariant.intrinsic`.

    Args:
        measured: shape of one measurement, ``(points, 2 + ...)``: image coordinates, and what is known of each point without noise.
        width: columns of the estimation matrix.
        make: measurements ``(*batch, n, *measured)`` to rows ``(*batch, n, r, width)``, r of any size, differentiable; 0 where
            a measurement says nothing.
        rows: independent rows of one match.
    """

    measured: tuple[int, ...]
    width: int
    make: Callable[[Tensor], Tensor]
    rows: int = 1
    dim = 0

    def shapes(self) -> tuple[tuple[int, ...], ...]:
        return (self.measured,)

    def vectors(self, x: Tensor) -> Tensor:
        return self.make(x)

    def disturbed(self, x: Tensor, noise: Tensor) -> Tensor:
        # matches are not normalized: the size of each is its own unit
        xy = x[..., :2]
        size = (xy - xy.mean(-2, keepdim=True)).square().mean((-2, -1), keepdim=True).sqrt()
        return torch.cat([xy + noise[..., :2] * size, x[..., 2:]], dim=-1)

    def action(self, transform: Tensor) -> Tensor:
        return transform

    def move(self, x: Tensor, transform: Tensor) -> Tensor:
        return x

    def raw(self, x: Tensor) -> Tensor:
        self._no_slot()

    def pullback(self, x: Tensor, gradient: Tensor) -> Tensor:
        self._no_slot()

    def pushforward(self, x: Tensor, change: Tensor) -> Tensor:
        self._no_slot()

    def _no_slot(self) -> NoReturn:
        raise NotImplementedError("a match that gives its rows as a whole has no single vector")
