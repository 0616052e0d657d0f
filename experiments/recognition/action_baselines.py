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
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
import tyro
from numpy.typing import NDArray

from experiments.common.tables import Row, command, markdown, note
from experiments.recognition import protocol
from experiments.recognition.baselines import ImageNearest, WarpedNearest
from experiments.recognition.protocol import TURNS, Classifier, Rendered
from indexing import ActionIndexer
from indexing.files import manifest, prepare, write_json

Array = NDArray[Any]
TITLES = {"utkinect": "UTKinect", "florence3d": "Florence3D"}
OURS, FAST = "ours", "ours, nearest only"
WARPED = ("DTW, clip-centred", "DTW, frame-centred")
GOAL_RATIO = 100.0  # times faster per query than DTW


@dataclass(frozen=True)
class Config:
    """The action indexer and the usual baselines, side by side, on the recordings in the folder DYNTORCH_DATA."""

    sets: tuple[Literal["utkinect", "florence3d"], ...] = ("utkinect", "florence3d")
    """Which recordings."""
    seeds: int = 3
    """Repetitions with other noise, cameras and virtual views."""
    repeats: int = 5
    """Timed repeats of every prediction of the first seed."""
    threads: int = 1
    """CPU threads of every method; with more than one, times on a machine that does other work too are wild."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")] = Path("results/action_baselines.json")
    """Where the results and this configuration are written as JSON."""


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


def overview(found: Mapping[str, Measured]) -> str:
    """Accuracy per turn, time and its ratio to ours, as a Markdown table."""
    lines = ["| method | " + " | ".join(f"{turn}°" for turn in TURNS) + " | ms per query | ratio to ours |"]
    lines.append("|---" * (len(TURNS) + 3) + "|")
    ours = found[OURS].milliseconds
    for name, one in found.items():
        turns = " | ".join(f"{value:.3f}" for value in one.accuracy.mean(axis=0))
        lines.append(f"| {name} | {turns} | {one.milliseconds:.3f} | {one.milliseconds / ours:.2f} |")
    return "\n".join(lines)


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


def run(config: Config) -> None:
    """Print the tables, then write the file.

    Raises:
        ValueError: no data folder, a missing file, nothing to repeat, or no aeon.
    """
    if min(config.seeds, config.repeats, config.threads) < 1:
        raise ValueError(f"seeds, repeats and threads must be at least 1, got {config.seeds}, {config.repeats}, {config.threads}")
    folder = protocol.data_folder()
    target = config.out.expanduser()
    prepare(target.parent)
    torch.set_num_threads(config.threads)
    try:
        WarpedNearest()
    except ImportError:
        raise ValueError("aeon is not installed; pip install 'dyntorch[experiments]'") from None
    tables = {}
    for name in config.sets:
        found = compare(name, config)
        rows = goals(name, found)
        print(f"\n### {TITLES[name]}\n\n{overview(found)}\n\n{markdown(rows)}", flush=True)
        kept = {method: {"accuracy": one.accuracy, "ms_per_query": one.milliseconds} for method, one in found.items()}
        tables[name] = {"methods": kept, "goals": [{**vars(row), "reached": row.reached} for row in rows]}
    about = manifest(vars(config), [folder / f"{name}.npz" for name in config.sets], seed=config.seeds)
    write_json(target, {"manifest": about, "threads": torch.get_num_threads(), "turns": TURNS, "tables": tables})
    note(f"written: {target}")


if __name__ == "__main__":
    command(lambda: run(tyro.cli(Config, prog="python -m experiments.recognition.action_baselines")))
