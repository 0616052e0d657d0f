"""Speed and memory of the action indexer, beside the goals.  Needs no recordings.

    python -m experiments.benchmarks.action_indexer

Recognition: 1000 exemplars x 500 queries of 16 frames x 20 joints, ten classes, all at once and one at a time.
Scanning: keypoints of 17 joints at 30 fps.
Start-up: ``import dyntorch`` against ``import torch``, and ``dyntorch --help``.  Every measurement runs in a process of its
own; the workloads take turns, and the figure is the median over rounds of the median in each.  Memory is the peak above
what the process held after its imports: data, model and all.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from experiments.benchmarks.workloads import EXEMPLARS, QUERIES
from experiments.common.runner import BaseConfig, Tables, experiment
from experiments.common.tables import Row, note

PLAIN, SEARCH, WARPING, PART, SCAN = "plain", "search", "warping", "scan 20 minutes", "scan 1 hour"
PLAIN_ONE, SEARCH_ONE = "plain, one query", "search, one query"
MANY, FIT, LEARNED = "scan 1 hour, 1000 exemplars", "fit 1000 clips", "fit 1000 clips, learned"
TASK, ONE = f"{EXEMPLARS} exemplars x {QUERIES} queries", f"{EXEMPLARS} exemplars x 1 query"
STARTS = {
    "import torch": [sys.executable, "-c", "import torch"],
    "import dyntorch": [sys.executable, "-c", "import dyntorch"],
    "dyntorch --help": [str(Path(sys.executable).with_name("dyntorch")), "--help"],
}


@dataclass(frozen=True)
class Config(BaseConfig):
    """Speed and memory of the action indexer, beside the goals."""

    rounds: int = 3
    """How often every workload runs."""
    starts: int = 7
    """How often every start-up is timed."""
    threads: int = 0
    """CPU threads; 0 leaves torch's default."""


def measure(workloads: Sequence[str], rounds: int, threads: int) -> dict[str, list[dict[str, Any]]]:
    """Run the workloads in turn, each in its own process.

    Raises:
        ValueError: one of them failed; the message ends with what it said.
    """
    environment = dict(os.environ)
    if threads > 0:
        environment["OMP_NUM_THREADS"] = str(threads)
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in workloads}
    for i in range(rounds):
        for name in workloads:
            note(f"... round {i + 1} of {rounds}: {name}")
            arguments = [sys.executable, "-m", "experiments.benchmarks.workloads", name]
            done = subprocess.run(arguments, capture_output=True, text=True, env=environment, check=False)
            if done.returncode:
                last = done.stderr.strip().splitlines()[-1:] or ["no message"]
                raise ValueError(f"workload {name!r} ended with code {done.returncode}: {last[0]}")
            found[name].append(json.loads(done.stdout.splitlines()[-1]))
    return found


def start_ups(repeats: int) -> dict[str, float]:
    """Median seconds of each command that can be started at all; they take turns."""
    seconds: dict[str, list[float]] = {name: [] for name in STARTS}
    for _ in range(repeats + 1):
        for name, arguments in STARTS.items():
            start = time.perf_counter()
            try:
                code = subprocess.run(arguments, capture_output=True, check=False).returncode
            except OSError:
                code = 127
            if code == 0:
                seconds[name].append(time.perf_counter() - start)
            elif not seconds[name]:
                note(f"{name}: cannot be started (code {code}); left out")
    return {name: median(values[1:]) for name, values in seconds.items() if len(values) > 1}  # the first fills the disk cache


def table(found: dict[str, list[dict[str, Any]]], starts: dict[str, float]) -> list[Row]:
    """Everything measured, beside its goal."""

    def seconds(name: str) -> float:
        return median(median(one["seconds"]) for one in found[name])

    def most(name: str, key: str = "megabytes") -> float:
        return max(float(one[key]) for one in found[name])

    rows = []
    for name, setting, goal in ((PLAIN, "nearest, no search", 0.07), (SEARCH, "default, with search", 0.3)):
        rows.append(Row(TASK, f"{setting}: predict", seconds(name), goal, at_most=True, unit=" s"))
        rows.append(Row(TASK, f"{setting}: peak memory of predict", most(name), 500.0, at_most=True, unit=" MB"))
        rows.append(Row(TASK, f"{setting}: fit", median(one["fit_seconds"] for one in found[name]), unit=" s"))
        rows.append(Row(TASK, f"{setting}: peak memory of fit", most(name, "fit_megabytes"), 500.0, at_most=True, unit=" MB"))
    for name, setting, goal in ((PLAIN_ONE, "nearest, no search", 5.0), (SEARCH_ONE, "default, with search", 42.0)):
        rows.append(Row(ONE, f"{setting}: predict, each of many", 1e3 * seconds(name), goal, at_most=True, unit=" ms"))
    if found.get(WARPING):
        for name, setting, goal in ((PLAIN, "nearest, no search", 100.0), (SEARCH, "default", 20.0)):
            rows.append(Row(TASK, f"time of DTW (32 steps, one thread) over {setting}", seconds(WARPING) / seconds(name), goal))
    rows.append(Row("scan 1 hour at 30 fps", "score_frames", seconds(SCAN), unit=" s"))
    rows.append(Row("scan 1 hour at 30 fps", "peak memory", most(SCAN), 1000.0, at_most=True, unit=" MB"))
    rows.append(Row("scan 20 minutes", "peak memory", most(PART), unit=" MB"))
    for name, what, goal in ((MANY, "score_frames", 30.0), (FIT, "default", 60.0), (LEARNED, 'weights="learned"', 60.0)):
        rows.append(Row(name, what, seconds(name), goal, at_most=True, unit=" s"))
        rows.append(Row(name, f"{what}: peak memory", most(name), unit=" MB"))
    if {"import torch", "import dyntorch"} <= starts.keys():
        rows.append(Row("start", "import torch", starts["import torch"], unit=" s"))
        limit = starts["import torch"] + 0.3
        rows.append(Row("start", "import dyntorch", starts["import dyntorch"], limit, at_most=True, unit=" s"))
    if "dyntorch --help" in starts:
        rows.append(Row("start", "dyntorch --help", starts["dyntorch --help"], 0.5, at_most=True, unit=" s"))
    return rows


def has_aeon() -> bool:
    """Whether the baseline can run."""
    from importlib.util import find_spec

    return find_spec("aeon") is not None


@experiment(Config(), quick={"rounds": 1, "starts": 1}, one_thread=False)
def tables(config: Config) -> Tables:
    """Every workload, and start-ups.

    Raises:
        ValueError: a workload failed.
    """
    names = [PLAIN, SEARCH, PLAIN_ONE, SEARCH_ONE, *([WARPING] if has_aeon() else []), PART, SCAN, MANY, FIT, LEARNED]
    yield "Speed and memory of the action indexer", table(measure(names, config.rounds, config.threads), start_ups(config.starts))
