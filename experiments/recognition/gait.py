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
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.metrics import roc_auc_score

from experiments.common.real_data import takes
from experiments.common.runner import BaseConfig, Tables, experiment
from experiments.common.tables import Row, note
from experiments.synchronization.data import RECORDED, SAME
from indexing import Clip
from indexing.cameras import virtual
from indexing.phase.indexer import PhaseIndexer
from indexing.skeleton import Skeleton

OTHERS = {"run": "run", "jump": "jump", "punch": "punch", "bend": "bend", "wash": "wash"}
"""The other actions, by a word of the take's description."""
JOINTS = (
    "pelvis", "left_hip", "right_hip", "left_knee", "left_ankle", "right_knee", "right_ankle", "spine", "thorax", "neck",
    "left_shoulder", "right_shoulder", "head", "left_elbow", "left_wrist", "right_elbow", "right_wrist",
)  # fmt: skip
ELEVATIONS = (-0.1, 0.5)
STEP = 3
"""Frames from one that is kept to the next: 20 per second."""
PIECE, LEAST = 60, 600
"""Frames that a test camera stays, and frames of every take that are asked at least."""
LONG = 600
"""Frames: longer walks give two clips, whose cameras differ."""
HIP, ANKLE, TOES = (1, 2), (4, 6), ((6, 7), (10, 11))
"""Hips and ankles among the 17 joints; feet and toes among the 31."""


@dataclass(frozen=True)
class Frames:
    """A clip, whose it is, and the phase of every frame in cycles (NaN: not known, or no walking)."""

    clip: Clip
    label: str
    take: str
    phase: Array

    @property
    def joints(self) -> Array:
        """``(frames, 17, 2)``."""
        return np.asarray(self.clip.joints)


@dataclass(frozen=True)
class Split:
    """What is learned from and what is asked."""

    train: list[Frames]
    test: list[Frames]


def walks() -> list[str]:
    """Names of the walking takes."""
    return [take.name for take in takes() if "walk" in take.what]


def split(held_out: str, views: int, seed: int, noise: float, camera: Callable[..., Clip] = virtual) -> Split:
    """One walking take asked, the others learned from in so many views each; of other actions the first half is learned."""
    rng = np.random.default_rng([seed, views])
    data = Split([], [])
    for take in takes():
        joints = take.joints.numpy()
        label = "walk" if "walk" in take.what else next((name for name, word in OTHERS.items() if word in take.what), None)
        if label is None:
            continue
        count = len(joints)
        phase = step_phase(joints) if label == "walk" else np.full(count, np.nan)
        asked = (0, count) if take.name == held_out else (count, count) if label == "walk" else (count // 2, count)
        if asked[0] > 0:
            cuts = [0, count // 2, count] if label == "walk" and count > LONG else [0, asked[0]]
            for first, last in pairwise(cuts):
                for _ in range(views):
                    data.train.append(_filmed(joints, phase, (first, last), label, take.name, rng, noise, camera))
        for _ in range(max(1, round(LEAST / max(1, asked[1] - asked[0]))) if asked[1] > asked[0] else 0):
            for first in range(asked[0], asked[1] - PIECE // 3, PIECE):
                data.test.append(
                    _filmed(joints, phase, (first, min(first + PIECE, asked[1])), label, take.name, rng, noise, camera)
                )
    return data


def _filmed(
    joints: Array,
    phase: Array,
    part: tuple[int, int],
    label: str,
    take: str,
    rng: np.random.Generator,
    noise: float,
    camera: Callable[..., Clip],
) -> Frames:
    chosen = slice(part[0], part[1], STEP)
    bones = Skeleton("CMU-17", JOINTS)
    solid = Clip(joints[chosen][:, list(SAME)], fps=RECORDED / STEP, skeleton=bones, name=take)
    image = camera(solid, rng.uniform(0, 360), rng.uniform(*ELEVATIONS), noise=noise, random_state=rng)
    return Frames(image, label, take, phase[chosen])


def step_phase(joints: Array) -> Array:
    """``(frames,)`` cycles since some step, from the ankles in 3D: how far the left is ahead of the right.

    0 where it is furthest ahead, .5 where the right one is, .25 and .75 where they pass; linear in time in between.  NaN more
    than a fifth of a cycle before the first and after the last of these.
    """
    body = joints[:, list(SAME)]
    across = body[:, HIP[0]] - body[:, HIP[1]]
    ahead = np.cross(across, [0.0, 1.0, 0.0])
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    feet = sum(joints[:, toe] - joints[:, foot] for foot, toe in TOES)
    sign = np.sign(np.mean(np.sum(ahead * feet, axis=1)))
    lead = _smoothed(sign * np.sum((body[:, ANKLE[0]] - body[:, ANKLE[1]]) * ahead, axis=1))
    pass_ = np.flatnonzero(lead[1:] * lead[:-1] < 0)
    at = pass_ + lead[pass_] / (lead[pass_] - lead[pass_ + 1])
    events: list[tuple[float, float]] = []
    for k, (time, first) in enumerate(zip(at, pass_, strict=True)):
        events.append((float(time), 0.75 if lead[first + 1] > lead[first] else 0.25))
        if k + 1 < len(at):
            widest = first + 1 + int(np.argmax(np.abs(lead[first + 1 : pass_[k + 1] + 1])))
            events.append((float(widest), 0.0 if lead[widest] > 0 else 0.5))
    if len(events) < 3:
        return np.full(len(joints), np.nan)
    when = np.array([time for time, _ in events])
    cycles = np.unwrap(np.array([phase for _, phase in events]), period=1.0)
    rate = (cycles[-1] - cycles[0]) / (when[-1] - when[0])
    frames = np.arange(len(joints))
    phase = np.interp(frames, when, cycles)
    early, late = np.minimum(frames - when[0], 0), np.maximum(frames - when[-1], 0)
    phase = phase + rate * (early + late)
    return np.where((-early > 0.2 / rate) | (late > 0.2 / rate), np.nan, phase)


def _smoothed(values: Array, sigma: int = 3) -> Array:
    reach = 4 * sigma
    kernel = np.exp(-0.5 * np.square(np.arange(-reach, reach + 1) / sigma))
    padded = np.pad(values, reach, mode="reflect", reflect_type="odd")
    return np.convolve(padded, kernel / kernel.sum(), mode="valid")


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
