"""Measured figures beside their goals, as a table to print and as rows to keep."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeVar

import tyro

from experiments.common.results import published
from experiments.common.timing import threads
from indexing.files import manifest, prepare, write_json

C = TypeVar("C")


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


@dataclass(frozen=True)
class NoiseConfig:
    """What the tables over scenes with noise have in common; each says what is ``quick``, and its file."""

    scenes: int = 100
    """Scenes per cell."""
    quick: bool = False
    """Fewer cells."""
    seed: int = 0
    """Of the scenes."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")] = Path("results/noise.json")
    """Where the results and this configuration are written as JSON."""

    def target(self) -> Path:
        """The file, after its folder was made.

        Raises:
            ValueError: no scenes, or a folder that cannot be written.
        """
        if self.scenes < 1:
            raise ValueError(f"scenes must be at least 1, got {self.scenes}")
        target = self.out.expanduser()
        prepare(target.parent)
        return target


def markdown(rows: Sequence[Row], title: str = "") -> str:
    """The rows as a Markdown table, ready for the README."""
    text = aligned(("task", "setting", "measured", "goal", "reached"), [_cells(row) for row in rows])
    return f"\n### {title}\n\n{text}" if title else text


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


def measured(names: Sequence[str], table: Callable[[str], list[Row]], target: Path, settings: Mapping[str, object]) -> None:
    """Print the tables of all names, say how many goals were reached, and write everything to a JSON file.

    Args:
        names: of the tables, in order.
        table: the rows of one.
        target: the file.
        settings: what the figures depend on, for its manifest.
    """
    results, seconds = {}, {}
    for name in names:
        note(f"... {name}")
        clock = time.perf_counter()
        results[name] = table(name)
        seconds[name] = time.perf_counter() - clock
        print(markdown(results[name], name), flush=True)
    goals = [row.reached for rows in results.values() for row in rows if row.reached is not None]
    print(f"\n{sum(goals)} of {len(goals)} goals reached, {sum(seconds.values()):.0f} s")
    tables = {name: [{**vars(row), "reached": row.reached} for row in rows] for name, rows in results.items()}
    write_json(target, {"manifest": manifest(settings, [], seed=0, timings=seconds), "tables": tables})
    note(f"written: {target}")


def noise_tables(tables: Mapping[str, Callable[[], tuple[Sequence[str], list[Sequence[str]]]]], config: NoiseConfig) -> None:
    """Print tables of words, each a head and lines, on one thread, and write them to the file of their configuration.

    Raises:
        ValueError: no scenes, or a file that cannot be written; said before anything is measured.
    """
    target = config.target()
    kept = {}
    with threads(1):
        for title, table in tables.items():
            note(f"... {title}")
            head, lines = table()
            print(f"\n### {title}\n\n{aligned(head, lines)}", flush=True)
            kept[title] = [dict(zip(head, line, strict=True)) for line in lines]
    write_json(target, {"manifest": manifest(vars(config), seed=config.seed), "tables": kept})
    note(f"written: {target}")


def measured_on_one_thread(tables: Mapping[str, Callable[[C], list[Row]]], config: C, out: Path) -> None:
    """:func:`measured` of named tables of one configuration, which goes into the file, without the noise of threads.

    Raises:
        ValueError: the file cannot be written; said before anything is measured.
    """
    target = out.expanduser()
    prepare(target.parent)
    with threads(1):
        measured(list(tables), lambda name: tables[name](config), target, vars(config))


def command(run: Callable[[], None]) -> None:
    """Run a script and put what it prints into its page of results; bad input ends in one line on stderr and exit code 2."""
    about = getattr(sys.modules["__main__"], "__spec__", None)
    try:
        with published(about.name if about else "", sys.argv[1:]):
            run()
    except ValueError as problem:
        print(f"error: {problem}", file=sys.stderr)
        raise SystemExit(2) from None
