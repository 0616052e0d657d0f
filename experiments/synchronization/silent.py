"""Silent errors: answers that are called ok and are wrong, of films that cannot be synchronized or that somebody meddled with.

    DYNTORCH_DATA=../shared/data python -m experiments.synchronization.silent --trials 2000

Every trial is a pair of films of 3 to 8 s at 30 fps with 5 to 30 mm of noise at the person, by the same 17 joints, or by 14 others
each:

- **periodic**: a person who repeats one cycle exactly; **still**: one who stands and sways by 3 mm;
- **backwards**: one film runs backwards; **other take**: the cameras show two takes of anything;
- **same person**: two takes of one person who does the same; **other person**: two people at the same exercise;
- **mirrored**: one film is mirrored, half of them with left and right joints renamed, as a detector would.

A silent error is an answer called ok that is wrong by more than a frame, or called ok where there is no right one.  Good pairs are
drawn from the same takes.  The thresholds of the library were chosen on ``--training`` trials, of other takes and seeds.
"""

from __future__ import annotations

import json
import math
import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro
from scipy.interpolate import CubicSpline
from torch import Generator, Tensor

import dyntorch as dyn
from dyntorch.numerics.blocks import one_thread
from experiments.common.real_data import Take
from experiments.common.runner import BaseConfig, Tables, Words, experiment
from experiments.common.tables import COLOURS, note
from experiments.recognition.protocol import data_folder
from experiments.synchronization.data import (
    SIZE,
    Pair,
    cmu_pair,
    draw,
    moving,
    periodic_pair,
    reversed_pair,
    seeded,
    still_pair,
    unrelated_pair,
)
from indexing.files import prepare
from indexing.report.canvas import LIGHT, new_figure, png, style

KINDS = ("periodic", "still", "backwards", "other take", "same person", "other person", "mirrored", "good")
"""The last one is no trap; as many as of each other kind are drawn."""
POINTS = ("same", "different")
SEARCHED = 2.0
"""Seconds of shift that are searched."""
FRAMES = (90, 120, 240)
"""Lengths of the films."""
NOISE_MM = (5.0, 30.0)
"""Least and largest noise at the person."""
SHORTEST_RUN = 30
"""Labels, ten a second: shorter runs of one exercise hold too little of it."""
GOAL = 1 / 500
"""Share of the traps that are called ok and wrong."""
THRESHOLDS = (0.0, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 0.97, 0.98, 0.99, 0.994, 0.996, 1.0)
"""Confidence from which an answer would be believed."""
SWAPPED = (0, 2, 1, 5, 6, 3, 4, 7, 8, 9, 11, 10, 12, 15, 16, 13, 14)
"""Which of the 17 joints a detector calls by the name of each in a mirrored film: left ones right, and right ones left."""


@dataclass(frozen=True)
class Config(BaseConfig):
    """Silent errors of synchronization, on the motion capture in the folder DYNTORCH_DATA."""

    trials: int = 2000
    """Trials that are traps; good pairs come besides."""
    training: bool = False
    """Takes and seeds that the thresholds were chosen on, instead of the others."""
    workers: int = 2
    """Processes."""

    @property
    def indices(self) -> range:
        """Of all trials, good pairs included."""
        return range(math.ceil(self.trials * len(KINDS) / (len(KINDS) - 1)))

    answers: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("results/silent")
    """Of the answers.  Trials that are there already are not computed again, so that a run that was stopped goes on: empty it for
    another version of the library."""

    @property
    def kept(self) -> Path:
        """The file of answers, one a line."""
        return self.answers.expanduser() / ("training.jsonl" if self.training else "trials.jsonl")


@dataclass(frozen=True)
class Answer:
    """What the library says of a trial.

    Attributes:
        index: of the trial.
        kind: of :data:`KINDS`.
        points: ``"same"`` or ``"different"``.
        ok: whether it is called ok.
        confidence: as told.
        error: frames; infinite where no answer is right.
        reason: why not, as a code.
        seconds: of processor time.
    """

    index: int
    kind: str
    points: str
    ok: bool
    confidence: float
    error: float
    reason: str
    seconds: float

    @property
    def wrong(self) -> bool:
        """Whether the shift is wrong by more than a frame, or there is no right one."""
        return not self.error <= 1


# ----------------------------------------------------------------------------------------------------------------------
# The trials.


def trial(index: int, training: bool) -> tuple[str, str, Pair]:
    """Kind, points, and films: the same for the same number."""
    kind, points = KINDS[index % len(KINDS)], POINTS[index // len(KINDS) % len(POINTS)]
    generator = seeded(71 if training else 74, index)
    frames = FRAMES[int(torch.randint(len(FRAMES), (1,), generator=generator))]
    settings = {"points": points, "frames": frames, "noise_mm": draw(*NOISE_MM, generator)}
    return kind, points, _FILMS[kind](_takes(training), generator, settings)


@cache
def _takes(training: bool) -> list[Take]:
    """Every other take of motion capture, and the exercises of some streams."""
    return moving()[0 if training else 1 :: 2]


@cache
def _exercises(training: bool) -> list[Take]:
    """Runs of one exercise of two people, at 60 fps like the other takes, named by person and exercise.

    Source: Fox et al., Joint modeling of multiple time series via the beta process, AoAS 2014, of mocap.cs.cmu.edu.
    """
    streams = ("13_29", "14_14") if training else ("13_30", "13_31", "14_20")
    found = []
    with np.load(data_folder() / "mocap6_exercises.npz") as file:
        for stream in streams:
            label, joints = np.asarray(file[f"{stream}/label_10fps"]), np.asarray(file[f"{stream}/joints_30fps"], dtype=float)
            edges = np.flatnonzero(np.diff(label, prepend=-2, append=-2))
            for start, end in pairwise(edges.tolist()):
                part = joints[3 * start : 3 * end]
                if end - start >= SHORTEST_RUN and 0 <= label[start] < len(file["action_names"]):
                    twice = CubicSpline(np.arange(len(part)), part)(np.arange(2 * len(part) - 1) / 2)
                    found.append(Take(stream[:2], str(file["action_names"][label[start]]), torch.from_numpy(twice)))
    return found


def _one(takes: Sequence[Take], generator: Generator) -> Tensor:
    return takes[int(torch.randint(len(takes), (1,), generator=generator))].joints


def _alone(build: Callable[..., Pair], takes: list[Take], generator: Generator, settings: dict[str, object]) -> Pair:
    return build(_one(takes, generator), generator, **settings)


def _two(takes: list[Take], generator: Generator, settings: dict[str, object], alike: Callable[[Take, Take], bool]) -> Pair:
    """Cameras around two takes that belong together in a way."""
    couples = [(x, y) for x in takes for y in takes if x is not y and alike(x, y)]
    first, second = couples[int(torch.randint(len(couples), (1,), generator=generator))]
    return unrelated_pair(first.joints, second.joints, generator, **settings)


def _other_take(takes: list[Take], generator: Generator, settings: dict[str, object]) -> Pair:
    return _two(takes, generator, settings, lambda x, y: x.what != y.what)


def _same_person(takes: list[Take], generator: Generator, settings: dict[str, object]) -> Pair:
    return _two(takes, generator, settings, lambda x, y: x.what == y.what and x.name[:2] == y.name[:2])


def _other_person(takes: list[Take], generator: Generator, settings: dict[str, object]) -> Pair:
    every = _exercises(takes is _takes(True))
    return _two(every, generator, settings, lambda x, y: x.what == y.what and x.name != y.name)


def _mirrored(takes: list[Take], generator: Generator, settings: dict[str, object]) -> Pair:
    joints = _one(takes, generator)
    pair = cmu_pair(joints, generator, **settings)
    b = torch.stack([SIZE[0] - pair.b[..., 0], pair.b[..., 1]], dim=-1)
    if settings["points"] == "same" and draw(0, 1, generator) < 0.5:
        b = b[:, SWAPPED]
    return replace(pair, b=b)


_FILMS: dict[str, Callable[[list[Take], Generator, dict[str, object]], Pair]] = {
    "periodic": partial(_alone, periodic_pair),
    "still": partial(_alone, still_pair),
    "backwards": partial(_alone, reversed_pair),
    "other take": _other_take,
    "same person": _same_person,
    "other person": _other_person,
    "mirrored": _mirrored,
    "good": partial(_alone, cmu_pair),
}


@one_thread
def answer(index: int, training: bool) -> Answer:
    """One trial, and what the library says."""
    kind, points, pair = trial(index, training)
    clock = time.process_time()
    found = dyn.synchronize(pair.a, pair.b, correspondence=points == "same", fps=pair.fps, max_shift=SEARCHED)
    clock = time.process_time() - clock
    error = abs(pair.error(found.offset, found.rate)) if math.isfinite(pair.offset) else math.inf
    reason = "" if found.ok else next(str(one.code) for one in found.notices if one.code.refuses is not None)
    return Answer(index, kind, points, bool(found.ok), float(found.confidence), error, reason, clock)


def answers(config: Config) -> list[Answer]:
    """Of all trials, in their order; those that are in the file, and the rest by so many processes."""
    known = {one.index: one for one in _read(config.kept)}
    left = [index for index in config.indices if index not in known]
    note(f"{len(known)} answers are in {config.kept}, {len(left)} are left")
    with config.kept.open("a", encoding="utf-8") as file:
        for done, one in enumerate(_answered(left, config), start=1):
            known[one.index] = one
            file.write(json.dumps(asdict(one)) + "\n")
            file.flush()
            if done % 100 == 0:
                note(f"... {done} of {len(left)}")
    return [known[index] for index in config.indices]


def _read(path: Path) -> Iterator[Answer]:
    if not path.exists():
        return
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        try:
            yield Answer(**json.loads(line))
        except (TypeError, ValueError) as problem:
            raise ValueError(f"{path}, line {number}: no answer ({problem}); remove the file to begin again") from None


def _answered(indices: Sequence[int], config: Config) -> Iterator[Answer]:
    ask = partial(answer, training=config.training)
    if config.workers == 1:
        yield from map(ask, indices)
        return
    with ProcessPoolExecutor(config.workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        yield from pool.map(ask, indices, chunksize=4)


# ----------------------------------------------------------------------------------------------------------------------
# What comes of it.


def table(every: Sequence[Answer]) -> list[tuple[str, ...]]:
    """A line per points and kind."""
    lines: list[tuple[str, ...]] = []
    for points in POINTS:
        for kind in KINDS:
            of = [one for one in every if (one.points, one.kind) == (points, kind)]
            said = [one for one in of if one.ok]
            wrong = sum(one.wrong for one in said)
            seconds = sum(one.seconds for one in of) / max(len(of), 1)
            lines.append((points, kind, str(len(of)), str(len(said) - wrong), str(wrong), f"{seconds:.2f}"))
    return lines


def shares(every: Sequence[Answer], believed: Callable[[Answer], bool]) -> tuple[float, float]:
    """Share of the good pairs that are refused, and share of the traps that are believed and wrong."""
    good = [one for one in every if one.kind == "good"]
    traps = [one for one in every if one.kind != "good"]
    refused = sum(not believed(one) for one in good) / max(len(good), 1)
    return refused, sum(believed(one) and one.wrong for one in traps) / max(len(traps), 1)


def curve(every: Sequence[Answer]) -> list[tuple[float, float, float]]:
    """Threshold of the confidence, and the shares of :func:`shares` with it."""
    return [(level, *shares(every, lambda one, level=level: one.confidence >= level)) for level in THRESHOLDS]  # type: ignore[misc]


def drawn(every: Sequence[Answer]) -> bytes:
    """PNG: silent errors against refusals as the threshold of the confidence moves; what is called ok as a large mark."""
    with style(LIGHT):
        figure = new_figure(8.4, 3.6)
        for axes, points in zip(figure.subplots(1, 2, sharey=True), POINTS, strict=True):
            of = [one for one in every if one.points == points]
            line = curve(of)
            axes.plot([x for _, x, _ in line], [y for *_, y in line], color=COLOURS[0], marker=".", label="confidence at least t")
            refused, silent = shares(of, lambda one: one.ok)
            axes.plot([refused], [silent], color=COLOURS[1], marker="o", markersize=9, linestyle="none", label="called ok")
            axes.axhline(GOAL, color=LIGHT.muted, linestyle=":", linewidth=1.0, label="goal: 1 in 500")
            for level, x, y in line:
                if level in (0.5, 0.9, 0.99):
                    axes.annotate(f"t = {level:g}", (x, y), textcoords="offset points", xytext=(6, 4), fontsize=7)
            axes.set_yscale("symlog", linthresh=1e-3)
            axes.set_ylim(-1e-4, 1.0)
            axes.set_yticks([0, 1e-3, 1e-2, 1e-1, 1], labels=["0", ".001", ".01", ".1", "1"])
            axes.set_xlabel("share of good pairs refused")
            axes.set_title(f"{points} points", fontsize=9)
            axes.grid(color=LIGHT.line, linewidth=0.5)
        figure.axes[0].set_ylabel("share of traps believed and wrong")
        figure.axes[1].legend(frameon=False, fontsize=7)
        figure.tight_layout()
        return png(figure)


@experiment(Config(), quick={"trials": 20}, one_thread=False)
def tables(config: Config) -> Tables:
    """Ask, and keep the answers."""
    prepare(config.answers.expanduser())
    every = answers(config)
    yield "Silent errors", Words(("points", "kind", "trials", "ok and right", "ok and wrong", "processor s"), table(every))
    lines = []
    for points in (*POINTS, "both"):
        of = [one for one in every if points in (one.points, "both")]
        refused, silent = shares(of, lambda one: one.ok)
        lines.append((points, f"{silent:.4f}", f"{GOAL:.4f}", "yes" if silent <= GOAL else "NO", f"{refused:.3f}"))
    yield "Share", Words(("points", "silent", "goal", "reached", "good refused"), lines)
    levels = [(f"{level:g}", f"{refused:.3f}", f"{silent:.4f}") for level, refused, silent in curve(every)]
    yield "As the threshold of the confidence moves", Words(("confidence from", "good refused", "silent"), levels)
    yield "synchronization-silent", drawn(every)
