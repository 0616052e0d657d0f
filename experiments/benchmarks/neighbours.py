"""What a busy neighbour costs: every verb with torch's default threads and on one thread, beside two processes that never rest.

    python -m experiments.benchmarks.neighbours

Both ways take turns in one process under the same load; the figure is the ratio of the medians of wall-clock seconds.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro

from experiments.benchmarks.interleaved import interleaved, threads
from experiments.benchmarks.verbs import VERBS
from experiments.common.tables import Row, command, measured, note
from indexing.files import prepare

GOAL = 1.2
LONG = 0.3  # seconds of a turn, at least
BUSY = "while True: sum(range(100000))"


@dataclass(frozen=True)
class Config:
    """Verbs beside busy neighbours."""

    neighbours: int = 2
    """Processes that never rest."""
    rounds: int = 7
    """Turns of each way."""
    only: str = ""
    """Verbs whose name holds this."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")] = Path("results/benchmark_neighbours.json")
    """Where the results and this configuration are written as JSON."""


@contextmanager
def neighbours(count: int) -> Iterator[None]:
    """Busy processes, as long as this lasts."""
    busy = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(count)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


def on(count: int, call: Callable[[], object], times: int) -> Callable[[], None]:
    """The call, so many times, with torch on so many threads."""

    def run() -> None:
        with threads(count):
            for _ in range(times):
                call()

    return run


def repeats(call: Callable[[], object]) -> int:
    """How many calls take as long as some turns of the neighbours on a core: one short call meets them by chance."""
    call()
    start = time.perf_counter()
    call()
    return max(1, round(LONG / (time.perf_counter() - start)))


def table(config: Config) -> list[Row]:
    """Seconds on one thread, and the ratio of the default to it."""
    rows, default = [], torch.get_num_threads()
    with neighbours(config.neighbours):
        for name, make in VERBS.items():
            if config.only not in name:
                continue
            note(f"... {name}")
            call = make()
            count = repeats(call)
            found = interleaved({"one": on(1, call, count), "default": on(default, call, count)}, config.rounds)
            ratio, one = found["default"] / found["one"], found["one"] / count
            setting = f"{default} threads over one, {config.neighbours} neighbours; one takes {one:.3g} s"
            rows.append(Row(name, setting, ratio, GOAL, at_most=True, unit="x"))
    return rows


def run(config: Config) -> None:
    """Print the table, then write the file.

    Raises:
        ValueError: torch has one thread only, or the file cannot be written.
    """
    if torch.get_num_threads() == 1:
        raise ValueError("torch has one thread here, there is nothing to compare; unset OMP_NUM_THREADS")
    target = config.out.expanduser()
    prepare(target.parent)
    measured(["Beside busy neighbours"], lambda _: table(config), target, vars(config))


if __name__ == "__main__":
    command(lambda: run(tyro.cli(Config, description=__doc__)))
