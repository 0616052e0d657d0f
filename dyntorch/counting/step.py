"""A step of a configuration: matches of one kind."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from dyntorch.counting.field import IntArray


@dataclass(frozen=True)
class Step:
    """Matches of one kind.

    Args:
        kind: its name.
        matches: how many; None: as many as raise the rank.
        draw: gives the rows ``(rows, width)`` of the next match.
        constraint: these rows hold without any match.
        patience: matches in a row that add nothing before no more are drawn; in general position the first one tells.
    """

    kind: str
    matches: int | None
    draw: Callable[[], IntArray]
    constraint: bool = False
    patience: int = 20


Configuration = Callable[..., list[Step]]
