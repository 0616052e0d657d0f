"""Clips of actions that were never learned: are they told from known ones, and does the rate that was asked for hold?

    DYNTORCH_DATA=../shared/data python -m experiments.recognition.open_set

UTKinect and Florence3D, five folds of subjects, exemplars in one 2D view, queries turned.  Some classes are held out: nothing is
learned of them, and their clips are to be answered "none"; every class once per repetition, in random company.  AUROC is the
chance that a clip of a learned class has more evidence than one of a class held out; evidence is pooled over all folds of one
camera, so it must be comparable between them.  Then ``reject`` asks for rates of false alarms: the share of unknown clips that are
taken for a known action is what one got, beside the share of known clips that are answered, and answered rightly.
Evidence of the baselines is minus the distance to the nearest exemplar; "best probability" is the largest of ``predict_proba``,
as people take it from a softmax.  The other ways (a to e) are those of :mod:`experiments.recognition.novelty`; ours is e with the
profiles of both scorers.  How the threshold is calibrated was chosen on UTKinect and Florence3D (leave-class-out among the
exemplars), so rates on them are, if anything, too good; the weight of the profiles is on a plateau of both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from sklearn.metrics import roc_auc_score

from experiments.common.runner import BaseConfig, Grid, Tables, experiment
from experiments.common.tables import note
from experiments.recognition import protocol
from experiments.recognition.contenders import NAMES, OPTIONS, Method, check_methods, contender
from experiments.recognition.novelty import ways
from experiments.recognition.protocol import Array, Rendered
from indexing import Clip

FOLDS = 5
NONE = "(none)"


@dataclass(frozen=True)
class Config(BaseConfig):
    """Unknown actions, on recordings in the folder DYNTORCH_DATA."""

    sets: tuple[Literal["utkinect", "florence3d"], ...] = ("utkinect", "florence3d")
    """Which recordings."""
    methods: tuple[Method, ...] = ("equal", "image", "dtw")
    """Which methods; ``reject`` is asked of ours only."""
    turns: tuple[int, ...] = (0, 90)
    """Azimuths of the queries, degrees."""
    rates: tuple[float, ...] = (0.05, 0.1, 0.3)
    """False-alarm rates that are asked for."""
    held_out: int = 3
    """Classes that are not learned."""
    draws: int = 1
    """Repetitions: every class is held out once in each."""
    ways: bool = True
    """Whether other ways to tell unknown actions are compared (:mod:`experiments.recognition.novelty`)."""


@dataclass
class Answers:
    """Of all queries of one method and camera: evidence by its name, whether known, and by rate what was answered."""

    known: list[bool]
    right: dict[float, list[bool]]
    accepted: dict[float, list[bool]]
    evidence: dict[str, list[float]]


def evidences(
    method: Method, learned: Any, clips: Sequence[Clip], labels: Array, compared: str | None
) -> Callable[[Sequence[Clip]], dict[str, Array]]:
    """What a learned method says of how well it knows clips, in all its ways.

    Args:
        clips, labels: that it has learned; compared: the set they are of, where other ways are compared with its own.
    """
    mine = NAMES[method]
    if method not in OPTIONS:
        return lambda asked: {mine: learned.evidence(asked)}
    others = ways(learned, clips, labels, compared) if compared is not None else (lambda _: {})

    def say(asked: Sequence[Clip]) -> dict[str, Array]:
        return {
            mine: learned.evidence(asked),
            f"{mine}, best probability": learned.predict_proba(asked).max(axis=1),
            **{f"{mine}, {way}": values for way, values in others(asked).items()},
        }

    return say


def fold(
    rendered: Rendered, train: Array, test: Array, method: Method, seed: int, config: Config, name: str, into: dict[int, Answers]
) -> None:
    """Learn from some clips, ask about others, and add what was said, by azimuth; name: of the set."""
    clips, labels = [rendered.exemplars[i] for i in train], rendered.labels[train]
    learned: Any = contender(method, seed)()
    learned.fit(clips, labels)
    known = np.isin(rendered.labels[test], labels)
    say = evidences(method, learned, clips, labels, name if config.ways else None)
    for turn, answers in into.items():
        asked = [rendered.queries[turn][i] for i in test]
        answers.known += known.tolist()
        for way, values in say(asked).items():
            answers.evidence.setdefault(way, []).extend(values.tolist())
    for rate in config.rates if method in OPTIONS else ():
        # what fitting with reject=rate does last, and all that depends on the rate: a new fit per rate takes four times as long
        learned.set_params(reject=rate, none_label=NONE)._calibrate()
        for turn, answers in into.items():
            said = np.asarray(learned.predict([rendered.queries[turn][i] for i in test]))
            answers.accepted[rate] += (said != NONE).tolist()
            answers.right[rate] += (said == rendered.labels[test]).tolist()


def companies(labels: Array, size: int, seed: int) -> list[Array]:
    """All classes in random groups of at most ``size``."""
    classes = np.random.default_rng([seed, 2]).permutation(np.unique(labels))
    return np.array_split(classes, -(-len(classes) // size))


def ask(name: str, method: Method, config: Config) -> dict[int, Answers]:
    """By azimuth, what a method says of all queries: all held out classes, all subjects."""
    clips = protocol.load_set(name)
    into = {
        turn: Answers([], {rate: [] for rate in config.rates}, {rate: [] for rate in config.rates}, {}) for turn in config.turns
    }
    for seed in range(config.draws):
        rendered = protocol.render(clips, seed, turns=config.turns)
        for hidden in companies(rendered.labels, config.held_out, seed):
            for train, test in protocol.leave_one_subject_out(protocol.merged(rendered.subjects, FOLDS)):
                fold(rendered, train[~np.isin(rendered.labels[train], hidden)], test, method, seed, config, name, into)
    return into


def auroc(answers: Answers) -> dict[str, float]:
    """By kind of evidence: the chance that a known clip has more of it than an unknown one."""
    return {name: float(roc_auc_score(answers.known, values)) for name, values in answers.evidence.items()}


def rates(answers: Answers, wanted: Sequence[float]) -> list[tuple[float, float, float]]:
    """By rate: false alarms, share of the known clips that are accepted, and that are answered rightly."""
    known = np.array(answers.known)
    return [
        (
            float(np.mean(np.array(answers.accepted[rate])[~known])),
            float(np.mean(np.array(answers.accepted[rate])[known])),
            float(np.mean(np.array(answers.right[rate])[known])),
        )
        for rate in wanted
    ]


def unknown_actions(name: str, config: Config) -> Tables:
    """Measure one set."""
    found = {}
    for method in config.methods:
        note(f"... {name}, {NAMES[method]}")
        found[method] = ask(name, method, config)
    areas = {turn: {k: v for method in config.methods for k, v in auroc(found[method][turn]).items()} for turn in config.turns}
    lines = {kind: [areas[turn][kind] for turn in config.turns] for kind in areas[config.turns[0]]}
    yield f"{name}, AUROC of known against unknown", Grid([f"{turn}°" for turn in config.turns], lines)
    lines = {}
    for method in (method for method in config.methods if method in OPTIONS):
        for turn in config.turns:
            got = rates(found[method][turn], config.rates)
            for rate, (alarms, kept, right) in zip(config.rates, got, strict=True):
                lines[f"{NAMES[method]}, {turn}°, asked {rate:g}"] = [alarms, kept, right]
    if lines:
        yield f"{name}, false alarms", Grid(["false alarms got", "known accepted", "known right"], lines)


@experiment(Config(), quick={"sets": ("florence3d",), "methods": ("equal",), "turns": (0,), "ways": False})
def tables(config: Config) -> Tables:
    """Known against unknown actions, and false alarms.

    Raises:
        ValueError: no data folder, too much held out, a rate that is none, or a method that cannot be made.
    """
    if config.held_out > 7 or not config.rates or not all(0 < rate < 1 for rate in config.rates):
        raise ValueError(f"held-out must be 1 to 7, rates between 0 and 1, got {config.held_out} and {config.rates}")
    check_methods(config.methods)
    for name in config.sets:
        yield from unknown_actions(name, config)
