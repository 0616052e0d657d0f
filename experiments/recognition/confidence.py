"""Does ``predict_proba`` hold: of answers that are told as likely as p, is a share p right, also turned and badly seen?

    DYNTORCH_DATA=../shared/data python -m experiments.recognition.confidence

*UTKinect*, *Florence3D*: learned from one 2D view of the others' clips (five folds of people), asked at 0, 45 and 90 degrees, as
they are seen and spoiled: joints anywhere, joints missing, heavy noise, cut short.  Before: a softmax of standardized scores.

``--train`` learns the table of :mod:`indexing.action.confidence` anew, from synthetic people and UI-PRMD, which are not printed.
Calibration error: mean difference of probability and frequency over ten bins, by the answers in each.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal

import numpy as np

from dyntorch.numerics import DecisionModel
from experiments.common.decisions import calibration_error, reliability_diagram, train, write
from experiments.common.runner import BaseConfig, Grid, Tables, experiment
from experiments.common.tables import Row, note
from experiments.recognition import protocol
from experiments.recognition.protocol import Array
from indexing import ActionIndexer, Clip
from indexing.action.confidence import FIGURES, TABLE, class_probabilities, confidence_figures
from indexing.actors import ACTIONS, dataset
from indexing.scoring import probabilities

SETS = Literal["utkinect", "florence3d"]
TURNS = (0, 45, 90)
SPOILED = ("as seen", "anywhere", "missing", "noise", "cut")
WANTED = 0.05  # calibration error
TRAINED = ((2, 1), (4, 3), (6, 1), (8, 2), (13, 3))  # actions, and people learned from
FOLDS = 5


@dataclass(frozen=True)
class Config(BaseConfig):
    """How sure answers are, on recordings in the folder DYNTORCH_DATA."""

    sets: tuple[SETS, ...] = ("utkinect", "florence3d")
    """Which recordings."""
    train: bool = False
    """Learn the table first."""


@dataclass(frozen=True)
class Asked:
    """Answers to clips seen in one way: figures, probabilities now and before, whether right, and who was asked."""

    turn: int
    kind: str
    figures: Array
    now: Array
    before: Array
    right: Array
    people: list[str]


def spoil(clip: Clip, kind: str, rng: np.random.Generator) -> Clip:
    """A clip as a bad detector sees it, or without a third of it."""
    joints = clip.joints.copy()
    shape, low, high = joints.shape[:2], np.nanmin(joints, (0, 1)), np.nanmax(joints, (0, 1))
    if kind == "anywhere":
        wrong = rng.random(shape) < rng.uniform(0.05, 0.35)
        joints[wrong] = rng.uniform(low, high, (int(wrong.sum()), 2))
    if kind == "missing":
        joints[rng.random(shape) < 0.5] = np.nan
    if kind == "noise":
        joints += rng.standard_t(1.5, joints.shape) * 0.01 * float((high - low).max())
    if kind == "cut" and len(clip) > 8:
        first = int(rng.integers(0, len(clip) // 3))
        part = slice(first, first + 2 * len(clip) // 3)
        return clip.replace(joints=joints[part], times=clip.times[part], fps=None, confidence=None)
    return clip.replace(joints=joints, confidence=None)


def ask(indexer: ActionIndexer, clips: Sequence[Clip], labels: Array, people: list[str], turn: int, seed: int) -> Iterator[Asked]:
    """Clips of known actions, seen in every way."""
    rng = np.random.default_rng([seed, turn])
    known = [i for i, label in enumerate(labels.tolist()) if label in indexer.classes_]
    for kind in SPOILED:
        query = indexer._queries([spoil(clips[i], kind, rng) for i in known])
        model = indexer.model_
        nearest = model.nearest_scores(query)
        scores = model.scores(query, nearest)
        right = indexer.classes_[scores.argmax(dim=1).numpy()] == labels[known]
        now, before = class_probabilities(model, query).max(axis=1), probabilities(scores.numpy()).max(axis=1)
        who = [people[i] for i in known]
        yield Asked(turn, kind, confidence_figures(model, query, scores, nearest), now, before, right, who)


def asked_of_set(name: str, seed: int, every: slice = slice(None)) -> Iterator[Asked]:
    """Of one set, five folds of people."""
    clips = protocol.load_set(name)
    clips = clips[every]
    rendered = protocol.render(clips, seed, TURNS)
    people = [f"{name} {one}" for one in rendered.subjects]
    for train_, test in protocol.leave_one_subject_out(protocol.merged(rendered.subjects, FOLDS)):
        indexer = ActionIndexer().fit([rendered.exemplars[i] for i in train_], rendered.labels[train_])
        for turn in TURNS:
            mine = [rendered.queries[turn][i] for i in test]
            yield from ask(indexer, mine, rendered.labels[test], [people[i] for i in test], turn, seed)


def asked_of_actors(seed: int) -> Iterator[Asked]:
    """Of synthetic people, models of few and of many actions."""
    rng = np.random.default_rng([seed, 9])
    for number, (count, people) in enumerate(TRAINED):
        lesson = dataset(people, sorted(rng.choice(ACTIONS, count, replace=False).tolist()), azimuth=0.0, rng=rng)
        indexer = ActionIndexer().fit(lesson, lesson.labels)
        for turn in TURNS:
            test = dataset(4, lesson.labels[:count].tolist(), azimuth=float(turn), rng=rng)
            names = [f"{number} {one}" for one in test.column("subject")]
            yield from ask(indexer, list(test), test.labels, names, turn, seed)


def learn_table(seed: int) -> None:
    """Write the table: answers as seen count four times those of each kind of spoiled ones, both sources the same."""
    parts = [list(asked_of_actors(seed)), list(asked_of_set("uiprmd_half", seed, slice(0, None, 4)))]
    told = [one for part in parts for one in part]
    sizes = [sum(len(one.right) for one in part) for part in parts]
    weights = np.concatenate(
        [
            np.full(len(one.right), (1.0 if one.kind == SPOILED[0] else 0.25) / size)
            for part, size in zip(parts, sizes, strict=True)
            for one in part
        ]
    )
    right, people = np.concatenate([one.right for one in told]), [who for one in told for who in one.people]
    figures = np.concatenate([one.figures for one in told])
    trained = train(FIGURES, figures, right, people, weights / weights.mean())
    source = f"{datetime.now(UTC):%Y-%m-%d}, {len(right)} answers, python -m experiments.recognition.confidence --train"
    write(TABLE, source, {"answer": trained.table})
    DecisionModel.load.cache_clear()


@experiment(Config(), quick={"sets": ("utkinect",)})
def tables(config: Config) -> Tables:
    """Calibration errors, now and before.

    Raises:
        ValueError: no data folder.
    """
    warnings.simplefilter("ignore", UserWarning)
    if config.train:
        learn_table(config.seed)
    lines: dict[str, list[float]] = {}
    rows, curves = [], {}
    for name in config.sets:
        note(f"... {name}")
        told = list(asked_of_set(name, config.seed))
        groups = {f"{turn}°": [one for one in told if one.turn == turn and one.kind == SPOILED[0]] for turn in TURNS}
        groups |= {kind: [one for one in told if one.kind == kind] for kind in SPOILED[1:]}
        for title, some in groups.items():
            now, before, right = (np.concatenate([getattr(one, part) for one in some]) for part in ("now", "before", "right"))
            error = calibration_error(now, right)
            means = float(right.mean()), float(now.mean())
            lines[f"{name}, {title}"] = [len(right), *means, calibration_error(before, right), error]
            if title[-1] == "°":
                rows.append(Row(name, f"calibration error at {title}", error, WANTED, at_most=True))
        curves[str(name)] = np.concatenate([one.now for one in told]), np.concatenate([one.right for one in told])
    columns = ["answers", "right", "told", "error before", "error"]
    yield "how sure answers are", Grid(columns, lines, rows)
    yield "recognition-confidence", reliability_diagram(curves)
