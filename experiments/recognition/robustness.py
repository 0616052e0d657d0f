"""How much is still recognized of bad keypoints: noise, missing joints, dropped frames, wrong joints, more and more of each.

    DYNTORCH_DATA=../shared/data python -m experiments.recognition.robustness

Leave-one-subject-out on UTKinect (or another set in 3D); exemplars are clean and in one view at azimuth 0, queries are seen from
0 and from 90 degrees and then corrupted (:mod:`experiments.recognition.corruptions`), the same for all methods.  All of a curve's
amounts strike the same queries.  The goals are losses of accuracy against clean queries, mean over both cameras, with the library's
defaults.  UTKinect gives 200 answers per seed, and answers to queries of one clip are not independent: half a percent is one
answer, and a loss of .01 is within the noise.
Nothing is tuned here.  But whoever changes the treatment of bad joints will look at this table: other recordings, kept apart,
decide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from experiments.common.runner import BaseConfig, Grid, Tables, experiment
from experiments.common.tables import Row, note
from experiments.recognition import protocol
from experiments.recognition.contenders import NAMES, Method, check_methods, contender
from experiments.recognition.corruptions import KINDS
from experiments.recognition.protocol import Array, Rendered
from indexing import Clip, ClipSet

TURNS = (0, 90)
LOSS = 0.03  # of accuracy, at most
ASKED = {
    "missing joints": 0.3,
    "missing joints, bursts": 0.3,
    "dropped frames": 0.5,
    "wrong joints, anywhere": 0.05,
    "wrong joints, lasting": 0.05,
    "wrong joints, exchanged": 0.05,
}


@dataclass(frozen=True)
class Config(BaseConfig):
    """Accuracy against the corruption of queries, on recordings in the folder DYNTORCH_DATA."""

    data: Literal["utkinect", "florence3d"] = "utkinect"
    """Which recordings."""
    kinds: tuple[str, ...] = tuple(KINDS)
    """Which corruptions."""
    methods: tuple[Method, ...] = ("equal", "unrepaired", "image", "dtw")
    """Which methods; the goals are those of the first."""
    seeds: int = 2
    """Repetitions with other noise, cameras and corruptions."""


def corrupted(rendered: Rendered, kind: str, amount: float, seed: int) -> dict[int, tuple[Clip, ...]]:
    """All queries by azimuth, corrupted; every query has a generator of its own, the same for all amounts."""
    change = KINDS[kind][0]
    return {
        turn: tuple(change(clip, amount, np.random.default_rng([seed, turn, i])) for i, clip in enumerate(clips))
        for turn, clips in rendered.queries.items()
    }


def accuracies(rendered: Rendered, kinds: Sequence[str], method: Method, seed: int) -> dict[str, Array]:
    """By kind: ``(amounts, turns)`` accuracy, leave-one-subject-out; a fold is learned once and asked everything."""
    asked = {(kind, amount): corrupted(rendered, kind, amount, seed) for kind in kinds for amount in KINDS[kind][2]}
    right = {key: np.zeros(len(rendered.queries)) for key in asked}
    for train, test in protocol.leave_one_subject_out(rendered.subjects):
        learned = contender(method, seed)()
        learned.fit([rendered.exemplars[i] for i in train], rendered.labels[train])
        queries = [clips[i] for views in asked.values() for clips in views.values() for i in test]
        answers = answered(learned, queries).reshape(len(asked), len(rendered.queries), len(test))
        for key, one in zip(asked, answers, strict=True):
            right[key] += np.sum(one == rendered.labels[test], axis=1)
    count = len(rendered.labels)
    return {kind: np.array([right[kind, amount] / count for amount in KINDS[kind][2]]) for kind in kinds}


def answered(learned: protocol.Classifier, queries: Sequence[Clip]) -> Array:
    """Labels; a query that the method refuses (with most frames dropped it is no longer one performance) has none, and is wrong."""
    try:
        return np.asarray(learned.predict(queries))
    except ValueError:
        if len(queries) == 1:
            return np.array([None])
        half = len(queries) // 2
        return np.concatenate([answered(learned, queries[:half]), answered(learned, queries[half:])])


def measure(clips: ClipSet, config: Config) -> dict[Method, dict[str, Array]]:
    """By method and kind: ``(seeds, amounts, turns)``."""
    found: dict[Method, list[dict[str, Array]]] = {method: [] for method in config.methods}
    for seed in range(config.seeds):
        rendered = protocol.render(clips, seed, turns=TURNS)
        for method in config.methods:
            note(f"... {NAMES[method]}, seed {seed + 1} of {config.seeds}")
            found[method].append(accuracies(rendered, config.kinds, method, seed))
    return {method: {kind: np.array([one[kind] for one in runs]) for kind in config.kinds} for method, runs in found.items()}


def losses(kind: str, found: Array) -> list[Row]:
    """The goal of one kind, where it has one: ``(seeds, amounts, turns)`` accuracy of the method that is to reach it."""
    if kind not in ASKED:
        return []
    at = KINDS[kind][2].index(ASKED[kind])
    lost = (found[:, 0] - found[:, at]).mean(axis=1)
    spread = float(lost.std()) if len(lost) > 1 else None
    return [Row("loss of accuracy", f"{kind}: {ASKED[kind]:g}", float(lost.mean()), LOSS, spread, at_most=True)]


@experiment(Config(), quick={"kinds": tuple(KINDS)[:1], "methods": ("equal",), "seeds": 1})
def tables(config: Config) -> Tables:
    """A table per kind of corruption.

    Raises:
        ValueError: no data folder, an unknown kind, or a method that cannot be made.
    """
    unknown = [kind for kind in config.kinds if kind not in KINDS]
    if unknown or not config.kinds:
        raise ValueError(f"kinds must be some of {', '.join(map(repr, KINDS))}, got {config.kinds}")
    check_methods(config.methods)
    found = measure(protocol.load_set(config.data), config)
    for kind in config.kinds:
        _, unit, amounts = KINDS[kind]
        lines = {
            f"{NAMES[method]}, {turn}°": one[kind].mean(axis=0)[:, k].tolist()
            for method, one in found.items()
            for k, turn in enumerate(TURNS)
        }
        rows = losses(kind, found[config.methods[0]][kind])
        yield f"{kind} ({unit})", Grid([f"{amount:g}" for amount in amounts], lines, rows)
