"""The one way in which an experiment runs: tables are measured, printed beside their goals, written as JSON and into a page.

A script is a function that yields its tables, one after the other, below its own docstring::

    @experiment(SceneConfig(scenes=40), quick={"scenes": 10})
    def tables(config: SceneConfig) -> Tables:
        yield "errors by noise", [Row("linear", f"{sigma:g} px", error(sigma, config.scenes)) for sigma in NOISES]

``python -m experiments.room.script`` runs it; the fields of its configuration are the flags.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar

import numpy as np
import tyro

from experiments.common.results import page_name, published
from experiments.common.tables import Row, aligned, markdown, note
from experiments.common.timing import threads
from indexing.files import manifest, prepare, to_json_types, write_bytes, write_json


@dataclass(frozen=True)
class BaseConfig:
    """What every experiment can be told."""

    quick: bool = False
    """Few settings, drawn few times: to see that it runs."""
    seed: int = 0
    """Of all that is drawn."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("results")
    """Where tables (JSON) and pictures are written."""


@dataclass(frozen=True)
class SceneConfig(BaseConfig):
    """An experiment on synthetic scenes."""

    scenes: int = 100
    """Scenes per cell."""


@dataclass(frozen=True)
class Grid:
    """A table with a line per method and a column per setting; under it, figures beside their goals."""

    columns: Sequence[object]
    lines: Mapping[str, Sequence[Any]]
    rows: Sequence[Row] = ()


@dataclass(frozen=True)
class Words:
    """A table of words: a head, and lines as long."""

    head: Sequence[str]
    lines: Sequence[Sequence[str]]


C = TypeVar("C", bound=BaseConfig)
Table = Sequence[Row] | Grid | Words | str | bytes
"""Figures beside their goals, a table of either kind, text, or a picture (PNG)."""
Tables = Iterator[tuple[str, Table]]
"""Tables with their titles; of text, an empty title gives no heading."""


@dataclass
class Experiment(Generic[C]):
    """The tables of a script, and what they are made with.

    Attributes:
        tables: yields them; what lies between two of them is the time that the second takes.
        default: the configuration; ``quick``: the fields that are others with ``--quick``.
        one_thread: torch computes on one thread, so that times are comparable and results the same anywhere.
        pictures: files of those that a run has written.
    """

    tables: Callable[[C], Tables]
    default: C
    quick: Mapping[str, Any]
    one_thread: bool
    pictures: dict[str, Path] = field(default_factory=dict)

    def configure(self, words: Sequence[str]) -> C:
        """The configuration that a command line asks for.

        Raises:
            ValueError: nothing to measure.
        """
        module = sys.modules[self.tables.__module__]
        default = replace(self.default, **self.quick) if "--quick" in words else self.default
        config = tyro.cli(type(default), args=words, default=default, description=module.__doc__)
        for name in (entry.name for entry in fields(config)):
            usual, value = getattr(self.default, name), getattr(config, name)
            if type(usual) is int and usual >= 1 > value and name != "seed":
                raise ValueError(f"--{name.replace('_', '-')} must be at least 1, got {value}")
        return config

    def run(self, config: C, name: str) -> None:
        """Measure and print every table, then say how many goals were reached, and write everything to ``name`` in the folder.

        Raises:
            ValueError: what the tables need is not there, or the folder cannot be written; said before anything is measured.
        """
        folder = prepare(config.out.expanduser())
        contents: dict[str, Any] = {}
        seconds: dict[str, float] = {}
        reached: list[bool] = []
        with threads(1) if self.one_thread else contextlib.nullcontext():
            clock = time.perf_counter()
            for title, table in self.tables(config):
                if isinstance(table, bytes):
                    self.pictures[title] = write_bytes(folder / f"{title}.png", table)
                    note(f"picture: {self.pictures[title]}")
                    continue
                now = time.perf_counter()
                seconds[title], clock = now - clock, now
                heading = f"\n### {title}\n" if title else ""
                print(f"{heading}\n{text_of(table)}", flush=True)
                contents[title] = contents_of(table)
                rows = table.rows if isinstance(table, Grid) else () if isinstance(table, (Words, str)) else table
                reached += [row.reached for row in rows if row.reached is not None]
        if reached:
            print(f"\n{sum(reached)} of {len(reached)} goals reached, {sum(seconds.values()):.0f} s")
        about = manifest(vars(config), seed=config.seed, timings=seconds)
        note(f"written: {write_json(folder / f'{name}.json', {'manifest': about, 'tables': to_json_types(contents)})}")

    def main(self) -> None:
        """Run as a command: what is printed goes into the page of the module; bad input is one line on stderr and exit code 2."""
        about = sys.modules["__main__"].__spec__
        module = about.name if about else Path(sys.argv[0]).stem
        try:
            with published(module, sys.argv[1:], self.pictures):
                self.run(self.configure(sys.argv[1:]), page_name(module) if "." in module else module)
        except ValueError as problem:
            print(f"error: {problem}", file=sys.stderr)
            raise SystemExit(2) from None


def experiment(
    default: C, quick: Mapping[str, Any] | None = None, *, one_thread: bool = True
) -> Callable[[Callable[[C], Tables]], Experiment[C]]:
    """A decorator: the function below, the last of its file, yields the tables of the script, which runs where it is the command.

    Args:
        default: the configuration without flags.
        quick: fields that are others with ``--quick``.
        one_thread: of torch.
    """

    def make(tables: Callable[[C], Tables]) -> Experiment[C]:
        made = Experiment(tables, default, quick or {}, one_thread)
        if tables.__module__ == "__main__":
            made.main()
        return made

    return make


def text_of(table: Sequence[Row] | Grid | Words | str) -> str:
    """As Markdown."""
    if isinstance(table, str):
        return table
    if isinstance(table, Words):
        return aligned(table.head, table.lines)
    if isinstance(table, Grid):
        lines = [[name, *map(_cell, values)] for name, values in table.lines.items()]
        text = aligned(["", *map(str, table.columns)], lines)
        return f"{text}\n\n{markdown(table.rows)}" if table.rows else text
    return markdown(table)


def contents_of(table: Sequence[Row] | Grid | Words | str) -> Any:
    """As values for the file."""
    if isinstance(table, str):
        return table
    if isinstance(table, Words):
        return [dict(zip(table.head, line, strict=True)) for line in table.lines]
    if isinstance(table, Grid):
        return {"columns": list(map(str, table.columns)), "lines": table.lines, "figures": contents_of(table.rows)}
    return [{**vars(row), "reached": row.reached} for row in table]


def _cell(value: Any) -> str:
    if isinstance(value, (float, np.floating)):
        number = float(value)
        return "" if np.isnan(number) else f"{number:.3f}" if abs(number) < 10 else f"{number:.0f}"
    return str(value)
