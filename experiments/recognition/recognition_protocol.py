"""Recognition of trimmed clips as people report it: other people, other views, few examples, what is confused, official splits.

    DYNTORCH_DATA=../shared/data python -m experiments.recognition.recognition_protocol

*cross-subject*: leave-one-subject-out, learned at azimuth 0 and asked at 0 / 45 / 90 / 150, with the confusion matrix of all turns.
*cross-view*: learned from one camera (or two), asked from every other, other people: a table azimuth x azimuth.
*few-shot*: 1, 2, 5 and 10 examples per class, or all where there are fewer, mean over the turns.
*JHMDB*: real footage, official splits; both sides of the split see people from the same side, and ours is told so.
Cameras, noise and folds are those of :mod:`experiments.recognition.protocol`; the two latter tables leave out groups of subjects
(five folds).
All methods see the same clips.  Ours runs with the library's defaults, which were chosen while looking at these recordings (see
:mod:`experiments.recognition.action_recognition`); the baselines have nothing to choose but the band of DTW (10 %).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from experiments.common.runner import BaseConfig, Grid, Tables, experiment
from experiments.common.tables import Row, note
from experiments.recognition import protocol
from experiments.recognition.action_recognition import FILES, TITLES
from experiments.recognition.contenders import NAMES, OPTIONS, Method, check_methods, contender
from experiments.recognition.protocol import TURNS, Array, Classifier, Rendered
from indexing import Clip

Table = Literal["cross-subject", "cross-view", "few-shot", "jhmdb"]
FOLDS = 5
AZIMUTHS = (0, 45, 90, 135, 180)
SEVERAL = (0, 90)  # cameras learned from together
GOALS = {"utkinect": (0.97, 0.96, 0.95, 0.93), "florence3d": (0.90, 0.88, 0.87, 0.86)}  # by turn
GOAL_JHMDB = 0.85
GOALS_FEW = {1: 0.80, 2: 0.87, 5: 0.93}


@dataclass(frozen=True)
class Config(BaseConfig):
    """The protocol of recognition, on recordings in the folder DYNTORCH_DATA."""

    tables: tuple[Table, ...] = ("cross-subject", "cross-view", "few-shot", "jhmdb")
    """What is measured."""
    sets: tuple[Literal["utkinect", "florence3d"], ...] = ("utkinect", "florence3d")
    """On which recordings (JHMDB has its own)."""
    methods: tuple[Method, ...] = ("equal", "image", "dtw")
    """Which methods; goals are those of the first."""
    seeds: int = 1
    """Repetitions with other noise, cameras and virtual views."""
    draws: int = 2
    """Choices of the few examples, each with other noise and cameras."""
    examples: tuple[int, ...] = (1, 2, 5, 10)
    """Per class."""


Make = Callable[[], Classifier]


def answers(make: Make, rendered: Rendered) -> Array:
    """``(turns, clips)`` what is said of every query, leave-one-subject-out."""
    out = np.empty((len(rendered.queries), len(rendered.labels)), dtype=rendered.labels.dtype)
    for train, test in protocol.leave_one_subject_out(rendered.subjects):
        learned = make()
        learned.fit([rendered.exemplars[i] for i in train], rendered.labels[train])
        asked = [clips[i] for clips in rendered.queries.values() for i in test]
        out[:, test] = np.asarray(learned.predict(asked)).reshape(len(rendered.queries), len(test))
    return out


def cross_subject(name: str, config: Config) -> tuple[str, Grid]:
    """Accuracy by turn."""
    clips = protocol.load_set(FILES[name])
    found: dict[Method, list[Array]] = {method: [] for method in config.methods}
    for seed in range(config.seeds):
        rendered = protocol.render(clips, seed)
        for method in config.methods:
            note(f"... {TITLES[name]}, cross-subject, {NAMES[method]}, seed {seed + 1} of {config.seeds}")
            found[method].append(answers(contender(method, seed), rendered))
    right = {method: np.mean(np.array(said) == clips.labels, axis=(0, 2)) for method, said in found.items()}
    first = config.methods[0]
    rows = [
        Row(TITLES[name], f"{NAMES[first]}, turned {turn} degrees", float(right[first][k]), GOALS[name][k])
        for k, turn in enumerate(TURNS)
    ]
    lines = {NAMES[method]: [*value.tolist(), float(value.mean())] for method, value in right.items()}
    return "other people", Grid([*(f"{turn}°" for turn in TURNS), "mean"], lines, rows)


def cameras(
    name: str, seed: int
) -> tuple[dict[str, list[int]], dict[int, tuple[Clip, ...]], dict[int, tuple[Clip, ...]], Array, Array]:
    """What is learned from by name; exemplars and queries by azimuth; labels and groups of subjects."""
    clips = protocol.load_set(FILES[name])
    rng = np.random.default_rng([seed, 3])
    exemplars = {turn: tuple(protocol.query_view(clip, turn, rng) for clip in clips) for turn in AZIMUTHS}
    queries = {turn: tuple(protocol.query_view(clip, turn, rng) for clip in clips) for turn in AZIMUTHS}
    sources = {f"{turn}°": [turn] for turn in AZIMUTHS} | {"+".join(map(str, SEVERAL)): list(SEVERAL)}
    return sources, exemplars, queries, clips.labels, protocol.merged(clips.column("subject"), FOLDS)


def cross_view(name: str, config: Config) -> tuple[str, Grid]:
    """Accuracy from every camera (row) to every other (column)."""
    found: dict[Method, list[Array]] = {method: [] for method in config.methods}
    sources: dict[str, list[int]] = {}
    for seed in range(config.seeds):
        sources, exemplars, queries, labels, groups = cameras(name, seed)
        for method in config.methods:
            note(f"... {TITLES[name]}, cross-view, {NAMES[method]}, seed {seed + 1} of {config.seeds}")
            table = np.zeros((len(sources), len(AZIMUTHS)))
            for row, turns in enumerate(sources.values()):
                for train, test in protocol.leave_one_subject_out(groups):
                    learned = contender(method, seed)()
                    learned.fit([exemplars[turn][i] for turn in turns for i in train], np.tile(labels[train], len(turns)))
                    asked = [queries[turn][i] for turn in AZIMUTHS for i in test]
                    said = np.asarray(learned.predict(asked)).reshape(len(AZIMUTHS), len(test))
                    table[row] += np.sum(said == labels[test], axis=1) / len(labels)
            found[method].append(table)
    shares = {NAMES[method]: np.mean(values, axis=0) for method, values in found.items()}
    lines = {f"{method}, learned at {row}": table[i].tolist() for method, table in shares.items() for i, row in enumerate(sources)}
    return "other people, from camera to camera", Grid([f"{turn}°" for turn in AZIMUTHS], lines)


def few_shot(name: str, config: Config) -> tuple[str, Grid]:
    """Accuracy against the number of examples per class, mean over the turns."""
    clips = protocol.load_set(FILES[name])
    found = {method: np.zeros((config.draws, len(config.examples))) for method in config.methods}
    for draw in range(config.draws):
        rendered = protocol.render(clips, draw)
        rendered = replace(rendered, subjects=protocol.merged(rendered.subjects, FOLDS))
        for method in config.methods:
            note(f"... {TITLES[name]}, few-shot, {NAMES[method]}, draw {draw + 1} of {config.draws}")
            for k, count in enumerate(config.examples):
                choose = partial(protocol.few, count=count, rng=np.random.default_rng([draw, count]))
                found[method][draw, k] = protocol.accuracy_by_turn(contender(method, draw), rendered, choose=choose).mean()
    lines = {NAMES[method]: value.mean(axis=0).tolist() for method, value in found.items()}
    first = config.methods[0]
    goals = [
        Row(TITLES[name], f"{NAMES[first]}, {count} per class", float(found[first][:, k].mean()), GOALS_FEW.get(count))
        for k, count in enumerate(config.examples)
        if name == "utkinect"
    ]
    return "examples per class", Grid(config.examples, lines, goals)


def jhmdb(config: Config) -> Grid:
    """Official splits."""
    clips = protocol.load_set(FILES["jhmdb"])
    found = {}
    for method in config.methods:
        note(f"... JHMDB, {NAMES[method]}")
        told: dict[str, Any] = {"view": "same"} if method in OPTIONS else {}
        found[method] = [
            float(np.mean([protocol.split_accuracy(contender(method, seed, **told)(), clips, k) for seed in range(config.seeds)]))
            for k in range(3)
        ]
    lines = {NAMES[method]: [*values, float(np.mean(values))] for method, values in found.items()}
    first = config.methods[0]
    row = Row("JHMDB", f"{NAMES[first]}, mean of 3 splits", float(np.mean(found[first])), GOAL_JHMDB)
    return Grid(["split 1", "split 2", "split 3", "mean"], lines, [row])


@experiment(Config(), quick={"tables": ("cross-subject",), "sets": ("florence3d",), "methods": ("equal",)})
def tables(config: Config) -> Tables:
    """Every table on every set.

    Raises:
        ValueError: no data folder, a missing file, or a method that cannot be made.
    """
    check_methods(config.methods)
    for kind in config.tables:
        if kind == "jhmdb":
            yield "JHMDB, official splits", jhmdb(config)
            continue
        for name in config.sets:
            title, table = {"cross-subject": cross_subject, "cross-view": cross_view, "few-shot": few_shot}[kind](name, config)
            yield f"{TITLES[name]}, {title}", table
