"""Walking against other actions from single frames, and the phase of the step: one command prints every figure.

    DYNTORCH_DATA=../shared/data python -m experiments.recognition.gait

CMU motion capture, 17 joints.  One walking take at a time is left out and asked, in other views than those learned from; the
five other actions have one take each, so they are learned from its first half and asked in the second (temporally apart, the
same person); one row learns walking alone, so that none of the others was ever seen.
Every camera is a perspective one 4.5 m away at any azimuth, elevation -.1 to .5 rad, 20 mm of noise on every 3D joint
coordinate; people are 1.5 m tall.  An exemplar is a take in one view; ``views`` says how many such clips each take gives.

The phase is that of the ankles in 3D: 0 where the left one is furthest ahead, 1/4 and 3/4 where they pass, linear in time in
between.  Where the phase is found rather than given, its arbitrary zero is taken from the training takes.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.metrics import roc_auc_score

from experiments.common.runner import BaseConfig, Tables, experiment
from experiments.common.tables import Row, note
from experiments.recognition.gait_data import OTHERS, Frames, Split, split, walks
from indexing.phase.indexer import PhaseIndexer

Array = NDArray[Any]
GOAL_AUC, GOAL_PHASE = 0.95, 12.0
OURS, FOUND = "PhaseIndexer", "PhaseIndexer, phases found"
ZERO = 12  # training clips that the zero of phases is taken from


@dataclass(frozen=True)
class Config(BaseConfig):
    """Walking from single frames, on the recordings in the folder DYNTORCH_DATA."""

    takes: tuple[str, ...] = ()
    """Walking takes that are asked, one at a time; all by default."""
    views: tuple[int, ...] = (1, 4)
    """Clips per training take, each in a view of its own."""
    seeds: int = 1
    """Repetitions with other cameras and noise."""
    noise: float = 0.02
    """m: on every 3D joint coordinate."""


@dataclass
class Figures:
    """What one method reaches on every left-out take."""

    auc: list[float] = field(default_factory=list)
    error: list[float] = field(default_factory=list)
    wrong: list[float] = field(default_factory=list)

    def rows(self, name: str, setting: str, goals: bool) -> list[Row]:
        """Means over the takes."""
        out = [Row(f"{name}: AUC", setting, float(np.mean(self.auc)), GOAL_AUC if goals else None, spread=float(np.std(self.auc)))]
        if np.isfinite(self.error).all():
            goal = GOAL_PHASE if goals else None
            out.append(Row(f"{name}: phase error", setting, float(np.mean(self.error)), goal, at_most=True, unit=" deg"))
            out.append(Row(f"{name}: half a cycle off", setting, float(np.mean(self.wrong))))
        return out


Answer = Callable[[Frames], tuple[Array, Array]]
"""Score of walking and phase, ``(frames,)`` each."""


def nearest_frame(data: Split) -> Answer:
    """Baseline: the nearest training image of walking against the nearest of the others; the phase is that of the former."""
    unit = [_unit(clip.joints) for clip in data.train]
    labels = np.concatenate([np.full(len(x), clip.label == "walk") for x, clip in zip(unit, data.train, strict=True)])
    phase = np.concatenate([clip.phase for clip in data.train])
    bank = np.concatenate(unit)

    def answer(clip: Frames) -> tuple[Array, Array]:
        apart = 1.001 - _unit(clip.joints) @ bank.T
        nearest = np.where(labels & np.isfinite(phase), apart, np.inf)
        rest = apart[:, ~labels].min(1) if (~labels).any() else 1.0
        return np.log(rest) - np.log(nearest.min(1)), phase[nearest.argmin(1)]

    return answer


def _unit(joints: Array) -> Array:
    x = joints - joints.mean(1, keepdims=True)
    return np.asarray(x.reshape(len(x), -1) / np.linalg.norm(x, axis=(1, 2))[:, None])


def barycentric(data: Split, basis: tuple[int, ...] = (0, 12, 3, 6), harmonics: int = 3) -> Answer:
    """Baseline: every joint an affine combination of four fixed ones, with coefficients that are a series in the phase.

    Source: the dynamic shape tensor with basis points; pelvis, head and knees.
    """
    walking = [clip for clip in data.train if clip.label == "walk"]
    x, phase = np.concatenate([clip.joints for clip in walking]), np.concatenate([clip.phase for clip in walking])
    x, phase = x[np.isfinite(phase)], phase[np.isfinite(phase)]
    rest = [j for j in range(x.shape[1]) if j not in basis]

    def parts(joints: Array) -> tuple[Array, Array]:
        scale = np.linalg.norm(joints - joints.mean(1, keepdims=True), axis=(1, 2))[:, None, None]
        sides = (joints[:, basis[1:]] - joints[:, basis[:1]]) / scale  # (F, 3, 2)
        return sides, (joints[:, rest] - joints[:, basis[:1]]) / scale

    sides, wanted = parts(x)
    design = np.einsum("fb,fkd->fdbk", _series(phase, harmonics), sides).reshape(2 * len(x), -1)
    target = wanted.transpose(0, 2, 1).reshape(2 * len(x), -1)
    found = np.linalg.solve(design.T @ design + 1e-3 * np.eye(design.shape[1]), design.T @ target)
    grid = np.arange(120) / 120
    at = np.einsum("gb,bkj->gkj", _series(grid, harmonics), found.reshape(-1, 3, len(rest)))

    def answer(clip: Frames) -> tuple[Array, Array]:
        sides, wanted = parts(clip.joints)
        left = np.square(np.einsum("gkj,fkd->fgjd", at, sides) - wanted[:, None]).sum((2, 3))
        return -np.log(left.min(1)), grid[left.argmin(1)]

    return answer


def _series(phase: Array, harmonics: int) -> Array:
    turns = 2 * np.pi * phase[:, None] * np.arange(1, harmonics + 1)
    return np.concatenate([np.ones((len(phase), 1)), np.cos(turns), np.sin(turns)], axis=1)


def learn(data: Split, *, given: bool, alone: bool = False) -> PhaseIndexer:
    """The library's.  ``given``: the phases of the training frames; ``alone``: walking is learned, nothing else."""
    clips = [clip for clip in data.train if clip.label == "walk" or not alone]
    phases = [clip.phase if clip.label == "walk" else None for clip in clips] if given else None
    return PhaseIndexer().fit([clip.clip for clip in clips], [clip.label for clip in clips], phases)


def asked(indexer: PhaseIndexer, zero: float = 0.0) -> Answer:
    """What it says of walking."""
    column = list(indexer.classes_).index("walk")

    def answer(clip: Frames) -> tuple[Array, Array]:
        scores, phase = indexer.analyse(clip.clip)
        return scores[:, column], (phase[:, column] - zero) % 1.0

    return answer


def zero_of(indexer: PhaseIndexer, data: Split) -> float:
    """Where a cycle that was found begins, among those that are given."""
    answer = asked(indexer)
    turns = np.concatenate(
        [answer(clip)[1] - clip.phase for clip in data.train[:: max(1, len(data.train) // ZERO)] if clip.label == "walk"]
    )
    return float(np.angle(np.nanmean(np.exp(2j * np.pi * turns))) / (2 * np.pi))


def methods(data: Split) -> dict[str, Answer]:
    """All of them, learned."""
    given, found = learn(data, given=True), learn(data, given=False)
    return {
        OURS: asked(given),
        FOUND: asked(found, zero_of(found, data)),
        f"{OURS}, .5 s of neighbours": asked(copy(given).set_params(window=0.5)),
        "walking alone learned": asked(learn(data, given=True, alone=True)),
        "2D nearest frame": nearest_frame(data),
        "barycentric series": barycentric(data),
    }


def judge(answer: Answer, data: Split) -> tuple[float, float, float]:
    """AUC of walking's frames against the others' (every action counts the same), median phase error in degrees, and the
    share of the frames more than 90 degrees off.
    """
    scores, names, errors = [], [], []
    for clip in data.test:
        score, phase = answer(clip)
        scores.append(score)
        names += [clip.label] * len(score)
        if clip.label == "walk":
            off = 360 * np.abs((phase - clip.phase + 0.5) % 1.0 - 0.5)
            errors.append(off[np.isfinite(off)])
    labels = np.array(names)
    weight = np.array([1.0 / np.sum(labels == name) for name in labels])
    off = np.concatenate(errors)
    auc = roc_auc_score(labels == "walk", np.concatenate(scores), sample_weight=weight)
    return float(auc), float(np.median(off)), float(np.mean(off > 90))


def table(config: Config, views: int) -> list[Row]:
    """All methods, with so many views per training take."""
    takes = config.takes or tuple(walks())[: 1 if config.quick else None]
    figures: dict[str, Figures] = defaultdict(Figures)
    for take in takes:
        for seed in range(config.seeds):
            data = split(take, views, seed, config.noise)
            for name, answer in methods(data).items():
                auc, error, wrong = judge(answer, data)
                figures[name].auc.append(auc)
                figures[name].error.append(error)
                figures[name].wrong.append(wrong)
            ours, found = figures[OURS], figures[FOUND]
            note(f"    {take}: AUC {ours.auc[-1]:.3f}, phase {ours.error[-1]:.1f} deg off, {found.error[-1]:.1f} where it is found")
    setting = f"{views} view{'s' if views > 1 else ''} per take, {len(takes)} takes"
    return [row for name, reached in figures.items() for row in reached.rows(name, setting, name == OURS)]


@experiment(Config(), quick={"views": (1,)})
def tables(config: Config) -> Tables:
    """All methods, by views per training take; quick: the first take."""
    for views in config.views:
        yield f"walking against {', '.join(OTHERS)}; {views} view(s) per take", table(config, views)
