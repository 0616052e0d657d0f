"""Synchronization of two cameras by tracks: virtual cameras around motion capture, whose clocks are known.

    DYNTORCH_DATA=../shared/data python -m experiments.synchronization.synchronization
    DYNTORCH_DATA=../shared/data python -m experiments.synchronization.synchronization --quick

Pairs are those of ``experiments.synchronization.data``: static perspective cameras with random places around a person, 120 frames
at 30 fps, shifted by up to 35 frames and fractions of them; noise in mm at the person.  Every method may search shifts up to
``--max-shift``.  *Right* is an answer within one frame of the truth in the middle of the overlap, whether or not it is called ok.
Other methods never refuse; they get whole frames unless a parabola is mentioned.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from statistics import fmean, median
from typing import Any, Protocol

import dyntorch as dyn
from experiments.common.runner import BaseConfig, Tables, experiment
from experiments.common.tables import Row
from experiments.synchronization.baselines import activity, pose2sim, vertical
from experiments.synchronization.data import (
    Pair,
    cmu_pair,
    cmu_pairs,
    long_take,
    moving,
    periodic_pair,
    reversed_pair,
    seeded,
    still_pair,
    unrelated_pair,
)

NOISE = (0.0, 15.0, 30.0, 60.0)
"""mm."""
PROTOTYPE = {"auto": (1.0, 1.0, 1.0, 0.95), "Pose2Sim": (0.60, 0.57, 0.40, 0.28)}
"""Right at these noises, on other pairs of the same takes: what is to be reached, and what was measured for Pose2Sim's formula."""
RATES = ((30.0, 25.0), (60.0, 29.97), (24.0, 50.0))
"""fps of a and b."""
MINUTES = 120.0
"""s: how long two clocks run apart."""


class Found(Protocol):
    """An answer: b's clock = a's clock * rate + offset."""

    @property
    def offset(self) -> float: ...

    @property
    def rate(self) -> float: ...

    @property
    def ok(self) -> bool: ...


Method = Callable[[Pair], Found]


@dataclass(frozen=True)
class Config(BaseConfig):
    """Synchronization of virtual cameras around the motion capture in the folder DYNTORCH_DATA."""

    trials: int = 100
    """Pairs per figure."""
    max_shift: float = 2.0
    """Seconds: how far every method searches."""


@dataclass(frozen=True)
class Summary:
    """Of answers: share within one frame, median error in frames of b, share called ok, and the share right of those."""

    right: float
    error: float
    ok: float
    trusted: float

    def __str__(self) -> str:
        trusted = f"right of those {self.trusted:.2f}" if self.ok else "none"
        return f"median {self.error:.3f} frame, ok {self.ok:.2f}, {trusted}"


def summary(pairs: Sequence[Pair], answers: Sequence[Found]) -> Summary:
    """How right the answers to the pairs are."""
    errors = [abs(pair.error(answer.offset, answer.rate)) for pair, answer in zip(pairs, answers, strict=True)]
    trusted = [error <= 1 for error, answer in zip(errors, answers, strict=True) if answer.ok]
    return Summary(
        fmean(error <= 1 for error in errors), median(errors), len(trusted) / len(errors), fmean(trusted) if trusted else math.nan
    )


def library(config: Config, correspondence: bool = True, **options: Any) -> Method:
    """This library's answer."""
    return lambda pair: dyn.synchronize(
        pair.a, pair.b, correspondence=correspondence, fps=pair.fps, max_shift=config.max_shift, **options
    )


def others(config: Config) -> dict[str, Method]:
    """The baselines, by name."""
    return {
        "Pose2Sim": lambda pair: pose2sim(pair.a, pair.b, pair.fps[0], config.max_shift),
        "Pose2Sim, parabola": lambda pair: pose2sim(pair.a, pair.b, pair.fps[0], config.max_shift, parabola=True),
        "vertical speed": lambda pair: vertical(pair.a, pair.b, pair.fps[0], config.max_shift),
        "activity": lambda pair: activity(pair.a, pair.b, pair.fps[0], config.max_shift),
    }


def same(config: Config) -> list[Row]:
    """The same 17 joints in both cameras, over the noise."""
    methods = {name: library(config, camera=name) for name in ("auto", "perspective", "affine")} | others(config)
    rows = []
    for index, noise in enumerate(NOISE):
        pairs = cmu_pairs(config.trials, config.seed, noise_mm=noise)
        for name, method in methods.items():
            found = summary(pairs, [method(pair) for pair in pairs])
            goal = PROTOTYPE["auto"][index] if name == "auto" else None
            known = f" (prototype {PROTOTYPE[name][index]:g})" if name == "Pose2Sim" else ""
            rows.append(Row(f"{name}, right", f"{noise:g} mm; {found}{known}", found.right, goal))
            if name == "auto" and noise == 15:
                rows.append(Row("auto, median error", f"{noise:g} mm", found.error, 0.03, at_most=True, unit=" frame"))
    return rows


def different(config: Config) -> list[Row]:
    """14 joints in one camera, 14 others in the other, over the noise."""
    methods = {"subspace": library(config, correspondence=False)} | others(config)
    rows = []
    for noise in NOISE:
        pairs = cmu_pairs(config.trials, config.seed, noise_mm=noise, points="different")
        for name, method in methods.items():
            found = summary(pairs, [method(pair) for pair in pairs])
            judged = name == "subspace" and noise == 15
            rows.append(Row(f"{name}, right", f"{noise:g} mm; {found}", found.right, 0.92 if judged else None))
            if judged:
                rows.append(Row("subspace, right of those called ok", f"{noise:g} mm", found.trusted, 0.97))
    return rows


def robustness(config: Config) -> list[Row]:
    """Missing detections, wrong ones, confused joints, and lenses; 15 mm."""
    cases: dict[str, tuple[dict[str, Any], float | None]] = {
        "25 % missing in blocks": ({"missing": 0.25}, 1.0),
        "15 % gross outliers": ({"outliers": 0.15}, 0.97),
        "two wrong joints": ({"wrong_joints": 2}, 0.95),
        "both lenses, k1 -.3 to -.1": ({"lens": (-0.3, -0.1)}, None),
        "all of these, 10 % each": ({"missing": 0.1, "outliers": 0.1, "wrong_joints": 2, "lens": (-0.1, -0.1)}, None),
    }
    rows = []
    for name, (settings, goal) in cases.items():
        pairs = cmu_pairs(config.trials, config.seed, **settings)
        answers = [library(config)(pair) for pair in pairs]
        found = summary(pairs, answers)
        rows.append(Row("right", f"{name}; {found}", found.right, goal))
        if "wrong_joints" in settings:
            rows += flagged(name, pairs, answers)
        peer = summary(pairs, [others(config)["Pose2Sim"](pair) for pair in pairs])
        rows.append(Row("Pose2Sim, right", f"{name}; {peer}", peer.right))
    return rows


def flagged(name: str, pairs: Iterable[Pair], answers: Iterable[Any]) -> list[Row]:
    """Of the wrong joints and of the good ones, how many are said to be wrong."""
    wrong, good = [], []
    for pair, answer in zip(pairs, answers, strict=True):
        if pair.wrong is not None and answer.points is not None:
            wrong += (~answer.points[pair.wrong]).tolist()
            good += (~answer.points[~pair.wrong]).tolist()
    if not wrong:
        return []
    return [Row("wrong joints named", name, fmean(wrong)), Row("good joints called wrong", name, fmean(good))]


def refusal(config: Config) -> list[Row]:
    """Answers called ok that are wrong by more than a frame, of takes that do not say when they are; counts."""
    takes = moving()

    def draw(build: Callable[..., Pair], two: bool = False, **settings: Any) -> list[Pair]:
        pairs = []
        for index in range(config.trials):
            which = [takes[(index * (1 + 5 * k) + 7 * k) % len(takes)].joints for k in range(1 + two)]
            if two and which[0] is which[1]:
                which[1] = takes[(index + 1) % len(takes)].joints
            pairs.append(build(*which, seeded(config.seed, 2, index), **settings))
        return pairs

    rows = []
    for points in ("same", "different"):
        cases = {
            "periodic, 15 mm": draw(periodic_pair, points=points),
            "periodic, no noise": draw(periodic_pair, points=points, noise_mm=0.0),
            "standing": draw(still_pair, points=points),
            "another take": draw(unrelated_pair, two=True, points=points),
            "film runs backwards": draw(reversed_pair, points=points),
        }
        for name, pairs in cases.items():
            answers = [library(config, correspondence=points == "same")(pair) for pair in pairs]
            rights = [abs(pair.error(x.offset, x.rate)) <= 1 for pair, x in zip(pairs, answers, strict=True)]
            wrong = sum(x.ok and not right for x, right in zip(answers, rights, strict=True))
            trusted = sum(x.ok and right for x, right in zip(answers, rights, strict=True))
            setting = f"{name}, {points} points; {len(pairs)} trials, {trusted} called ok and right"
            rows.append(Row("ok but wrong", setting, wrong, 0.0, at_most=True))
    return rows


def clocks(config: Config) -> list[Row]:
    """Two clocks at 30 and 29.83 fps, both said to be 30, for two minutes; 15 mm."""
    errors, drifts, trusted = [], [], []
    for index in range(1 if config.quick else 5):
        generator = seeded(config.seed, 3, index)
        take = long_take(MINUTES + 5, generator)
        pair = cmu_pair(take, generator, frames=round(MINUTES * 30), rate=29.83 / 30)
        answer = library(config)(pair)
        start, end = (pair.error(answer.offset, answer.rate, at=share) for share in (0.0, 1.0))
        errors.append(max(abs(start), abs(end)))
        drifts.append(abs(end - start))
        trusted.append(answer.ok)
    setting = f"{len(drifts)} takes of {MINUTES:g} s"
    return [
        Row("drift error, median", setting, median(drifts), 0.02, at_most=True, unit=" frame"),
        Row("drift error, worst", setting, max(drifts), unit=" frame"),
        Row("error at the ends, worst", setting, max(errors), unit=" frame"),
        Row("called ok", setting, fmean(trusted)),
    ]


def frame_rates(config: Config) -> list[Row]:
    """Cameras of different frame rates, 15 mm, 4 s; errors in frames of b."""
    rows = []
    for fps in RATES:
        for points in ("same", "different"):
            pairs = cmu_pairs(config.trials, config.seed, fps=fps, frames=round(4 * fps[0]), max_shift=fps[0], points=points)
            found = summary(pairs, [library(config, correspondence=points == "same")(pair) for pair in pairs])
            rows.append(Row("right", f"{fps[0]:g} and {fps[1]:g} fps, {points} points; {found}", found.right))
    return rows


@experiment(Config(), quick={"trials": 15})
def tables(config: Config) -> Tables:
    """Every table; quick: takes of two minutes only once."""
    yield "Same joints", same(config)
    yield "Different joints", different(config)
    yield "Bad detections", robustness(config)
    yield "Refusal", refusal(config)
    yield "Two clocks", clocks(config)
    yield "Frame rates", frame_rates(config)
