"""Measured figures beside their goals, as a table to print and as rows to keep."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

COLOURS = ("#0b4a60", "#e07b39", "#6aa84f", "#8e5ea2", "#b3123a", "#59636d")
MARKS = ("o", "s", "^", "D", "v", "P")


@dataclass(frozen=True)
class Row:
    """One figure: ``measured`` (a mean), its standard deviation over repetitions where there are any, and the goal."""

    task: str
    setting: str
    measured: float
    goal: float | None = None
    spread: float | None = None
    at_most: bool = False  # the goal is an upper bound (seconds, megabytes)
    unit: str = ""

    @property
    def reached(self) -> bool | None:
        """Whether the unrounded figure reaches the goal; ``None`` where there is no goal."""
        if self.goal is None:
            return None
        return self.measured <= self.goal if self.at_most else self.measured >= self.goal


def markdown(rows: Sequence[Row]) -> str:
    """The rows as a Markdown table."""
    return aligned(("task", "setting", "measured", "goal", "reached"), [_cells(row) for row in rows])


def aligned(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A Markdown table of any cells, columns aligned."""
    every = [head, *lines]
    widths = [max(len(line[k]) for line in every) for k in range(len(head))]
    text = ["| " + " | ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) + " |" for line in every]
    text.insert(1, "|" + "|".join("-" * (width + 2) for width in widths) + "|")
    return "\n".join(text)


def _cells(row: Row) -> tuple[str, ...]:
    value = f"{_number(row.measured)}{row.unit}" + ("" if row.spread is None else f" ± {row.spread:.3f}")
    if row.goal is None:
        return row.task, row.setting, value, "", ""
    sign = "<=" if row.at_most else ">="
    return row.task, row.setting, value, f"{sign} {_number(row.goal)}{row.unit}", "yes" if row.reached else "NO"


def _number(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}" if abs(value) > 1 else f"{value:.3f}"


def note(message: str) -> None:
    """Progress, apart from the tables: on stderr."""
    print(message, file=sys.stderr, flush=True)
