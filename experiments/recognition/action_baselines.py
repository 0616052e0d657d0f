"""The action indexer against nearest neighbours in 2D and dynamic time warping: same splits, same queries, one run.

    DYNTORCH_DATA=../shared/data python -m experiments.recognition.action_baselines

Leave-one-subject-out on UTKinect and Florence3D, exemplars in one 2D view, queries turned
(:mod:`experiments.recognition.protocol`).
Times are those of ``predict`` from 2D clips to labels, resampling included, for all queries of one fold in one call, warm,
with one thread each unless told otherwise: the median over repeats, the methods taking turns in each repeat.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from experiments.common.runner import BaseConfig, Tables, Words, experiment
from experiments.common.tables import Row, note
from experiments.recognition import protocol
from experiments.recognition.baselines import ImageNearest, WarpedNearest
from experiments.recognition.protocol import TURNS, Classifier, Rendered
from indexing import ActionIndexer

Array = NDArray[Any]
TITLES = {"utkinect": "UTKinect", "florence3d": "Florence3D"}
OURS, FAST = "ours", "ours, nearest only"
WARPED = ("DTW, clip-centred", "DTW, frame-centred")
GOAL_RATIO = 100.0  # times faster per query than DTW


@dataclass(frozen=True)
class Config(BaseConfig):
    """The action indexer and the usual baselines, side by side, on the recordings in the folder DYNTORCH_DATA."""

    sets: tuple[Literal["utkinect", "florence3d"], ...] = ("utkinect", "florence3d")
    """Which recordings."""
    seeds: int = 3
    """Repetitions with other noise, cameras and virtual views."""
    repeats: int = 5
    """Timed repeats of every prediction of the first seed."""
    threads: int = 1
    """CPU threads of every method; with more than one, times on a machine that does other work too are wild."""


@dataclass(frozen=True)
class Measured:
    """One method on one set: ``(seeds, turns)`` accuracy and milliseconds per query."""

    accuracy: Array
    milliseconds: float


def methods(seed: int) -> dict[str, Callable[[], Classifier]]:
    """Every method under test, by name, each as a way to make a new one."""
    jobs = torch.get_num_threads()
    plain = partial(ActionIndexer, scorer="nearest", search=False, mirror=False, virtual_views=0, random_state=seed)
    return {
        "2D nearest neighbour": ImageNearest,
        WARPED[0]: partial(WarpedNearest, "clip", jobs),
        WARPED[1]: partial(WarpedNearest, "frame", jobs),
        FAST: plain,
        OURS: partial(ActionIndexer, random_state=seed),
    }


def fold_times(fitted: Mapping[str, Classifier], queries: list[Any], repeats: int) -> dict[str, Array]:
    """``(repeats,)`` seconds of one prediction by each method; all are warm, and take turns."""
    seconds: dict[str, list[float]] = {name: [] for name in fitted}
    for _ in range(repeats):
        for name, method in fitted.items():
            start = time.perf_counter()
            method.predict(queries)
            seconds[name].append(time.perf_counter() - start)
    return {name: np.array(values) for name, values in seconds.items()}


def one_seed(rendered: Rendered, seed: int, repeats: int) -> tuple[dict[str, Array], dict[str, Array]]:
    """Accuracy ``(turns,)`` and seconds ``(repeats,)`` of all queries, by method."""
    makers = methods(seed)
    right = {name: np.zeros(len(TURNS)) for name in makers}
    seconds = {name: np.zeros(repeats) for name in makers}
    for train, test in protocol.leave_one_subject_out(rendered.subjects):
        fitted = {}
        for name, make in makers.items():
            fitted[name] = make()
            fitted[name].fit([rendered.exemplars[i] for i in train], rendered.labels[train])
            right[name] += protocol.right_by_turn(fitted[name], rendered, test).sum(axis=1)
        queries = [clips[i] for clips in rendered.queries.values() for i in test]
        for name, taken in fold_times(fitted, queries, repeats).items():
            seconds[name] += taken
    return {name: value / len(rendered.labels) for name, value in right.items()}, seconds


def compare(name: str, config: Config) -> dict[str, Measured]:
    """Every method on one set."""
    clips = protocol.load_set(name)
    found = []
    milliseconds: dict[str, float] = {}
    for seed in range(config.seeds):
        note(f"... {TITLES[name]}, seed {seed + 1} of {config.seeds}")
        accuracy, seconds = one_seed(protocol.render(clips, seed), seed, config.repeats if seed == 0 else 0)
        found.append(accuracy)
        if seed == 0:
            queries = len(clips) * len(TURNS)
            milliseconds = {method: 1e3 * float(np.median(taken)) / queries for method, taken in seconds.items()}
    return {method: Measured(np.array([one[method] for one in found]), milliseconds[method]) for method in found[0]}


def overview(found: Mapping[str, Measured]) -> Words:
    """Accuracy per turn, time and its ratio to ours."""
    lines = []
    ours = found[OURS].milliseconds
    for name, one in found.items():
        turns = (f"{value:.3f}" for value in one.accuracy.mean(axis=0))
        lines.append([name, *turns, f"{one.milliseconds:.3f}", f"{one.milliseconds / ours:.2f}"])
    return Words(["method", *(f"{turn}°" for turn in TURNS), "ms per query", "ratio to ours"], lines)


def goals(name: str, found: Mapping[str, Measured]) -> list[Row]:
    """Ours against the better of the two ways to centre DTW, turn by turn, and against the faster."""
    warped = np.max([found[method].accuracy.mean(axis=0) for method in WARPED], axis=0)
    lead = found[OURS].accuracy.mean(axis=0) - warped
    # the smallest lead that counts: more accurate, not equal
    rows = [
        Row(TITLES[name], f"lead over DTW in accuracy, turned {turn} degrees", float(lead[k]), 1e-9)
        for k, turn in enumerate(TURNS)
        if turn
    ]
    fastest = min(found[method].milliseconds for method in WARPED)
    for method in (OURS, FAST):
        ratio = fastest / found[method].milliseconds
        rows.append(Row(TITLES[name], f"DTW's time per query over that of {method}", ratio, GOAL_RATIO))
    return rows


@experiment(Config(), quick={"sets": ("florence3d",), "seeds": 1, "repeats": 1}, one_thread=False)
def tables(config: Config) -> Tables:
    """Every set: all methods, then ours against time warping.

    Raises:
        ValueError: no data folder, or no aeon.
    """
    torch.set_num_threads(config.threads)
    try:
        WarpedNearest()
    except ImportError:
        raise ValueError("aeon is not installed; pip install 'dyntorch[experiments]'") from None
    for name in config.sets:
        found = compare(name, config)
        yield TITLES[name], overview(found)
        yield f"{TITLES[name]}, beside time warping", goals(name, found)
