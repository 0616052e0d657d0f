"""Rank while matches arrive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dyntorch.counting.field import Echelon, Field, IntArray
from dyntorch.counting.step import Step
from dyntorch.counting.views import LARGEST

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
    """Counts the ranks of steps of matches, one step after the other.

    Args:
        field: of the rows.
    """

    def __init__(self, field: Field) -> None:
        self.field = field
        self.profile: list[int] = []
        self.kinds: list[Kind] = []
        self.echelon: Echelon | None = None

    @property
    def rank(self) -> int:
        """Of everything so far."""
        return 0 if self.echelon is None else self.echelon.rank

    def take(self, step: Step) -> None:
        """Add the matches of a step to the profile; a constraint raises the rank only."""
        before = self.rank
        ranks = self.ranks(step)
        if ranks and not step.constraint:
            self.profile += ranks
            self.kinds.append(Kind(step.kind, len(ranks), len({before, *ranks}) - 1, self.rank))

    def ranks(self, step: Step) -> list[int]:
        """Rank after each match of a step; where their number is open, up to the last one that raises it."""
        found: list[int] = []
        last, idle, ended = self.rank, 0, False
        while not ended and idle < step.patience and (step.matches is None or len(found) < step.matches):
            block, ended = self._draw(step, None if step.matches is None else step.matches - len(found))
            for rank in self._add(block):
                last, idle = rank, 0 if rank > last else idle + 1
                found.append(rank)
        if step.matches is None:
            return found[: len(found) - idle]
        if ended and len(found) < step.matches:
            raise ValueError(f"the sampler ended after {len(found)} matches, {step.matches} were asked for")
        return found + [self.rank] * (step.matches - len(found))

    def _draw(self, step: Step, most: int | None) -> tuple[list[IntArray], bool]:
        """The next matches, about a block of rows, and whether there are no others."""
        block: list[IntArray] = []
        while sum(map(len, block)) < BLOCK and (most is None or len(block) < most):
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
