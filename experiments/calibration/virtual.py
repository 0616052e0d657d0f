"""Cameras from a moving person: virtual rigs (CMU motion before four cameras that nobody calibrated or synchronized), with truth.

    DYNTORCH_DATA=../shared/data python -m experiments.calibration.virtual

Figures are medians over the rigs, errors those after the similarity between both worlds; *ok* counts the rigs that are not refused,
*worst* is the largest rotation error of any camera of those.  What the data cannot decide has to be refused.
"""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from statistics import median

import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch.geometry.rigid import rotation_exponential
from experiments.calibration.rigs import Rig, RigErrors, RigSpec, errors, motions, project, virtual_rig
from experiments.common.runner import BaseConfig, Tables, experiment
from experiments.common.tables import Row


@dataclass(frozen=True)
class Config(BaseConfig):
    """Virtual rigs."""

    rigs: int = 20
    """Rigs per row."""
    first: int = 0
    """Seed of the first."""
    workers: int = 2
    """Processes, each on one thread; seconds are those of the processor."""


@dataclass(frozen=True)
class Case:
    """A row: what is drawn, what is told, and what is done to it."""

    spec: RigSpec = field(default_factory=RigSpec)
    focal: bool = False
    one_lens: bool = False
    spoiled: str = ""
    """What is done to the tracks: ``still``, ``plane``, ``moved``, ``line``, or nothing."""


@dataclass(frozen=True)
class Outcome:
    """Of one rig; None where it has no cameras."""

    errors: RigErrors | None
    ok: bool
    reason: str
    seconds: float


CASES = {
    "focal lengths unknown": Case(),
    "focal lengths known": Case(focal=True),
    "two cameras, focal lengths known": Case(RigSpec(cameras=2), focal=True),
    "one unknown lens in all cameras": Case(RigSpec(focal=(1450.0, 1450.0)), one_lens=True),
    "30, 29.97, 25 and 30 frames per second, k1 down to -.2": Case(RigSpec(fps=(30.0, 29.97, 25.0, 30.0), k1=(-0.2, 0.0))),
    "clocks 50 and 100 ppm apart, 20 seconds": Case(RigSpec(frames=600, rates=(1.0, 1 + 5e-5, 1 - 1e-4, 1.0))),
    "eight cameras": Case(RigSpec(cameras=8, apart=15.0)),
    "all cameras in a line": Case(spoiled="line"),
}
SPOILED = {
    "two cameras, focal lengths unknown": Case(RigSpec(cameras=2)),
    "nobody moves": Case(spoiled="still"),
    "motion in one plane": Case(spoiled="plane"),
    "a camera moved by 4 degrees": Case(spoiled="moved"),
}


def outcome(case: Case, seed: int) -> Outcome:
    """Of one rig of a row."""
    torch.set_num_threads(1)
    rig = spoiled(virtual_rig(seed, case.spec, motions()), case, seed)
    clocks = rig.offsets.tolist() if case.spoiled == "still" else None
    clock = time.process_time()
    found = dyn.calibrate(
        rig.tracks, rig.fps, rig.sizes, focal=rig.K[:, 0, 0].tolist() if case.focal else None, one_lens=case.one_lens, clocks=clocks
    )
    seconds = time.process_time() - clock
    known = bool(found.K.isfinite().all()) and case.spoiled in ("", "line")
    return Outcome(errors(found, rig) if known else None, bool(found.ok), found.reason, seconds)


def spoiled(rig: Rig, case: Case, seed: int) -> Rig:
    """A rig whose recordings do not decide."""
    g = torch.Generator().manual_seed(seed)
    noise = 3.0 * torch.randn(*rig.tracks[0].shape, generator=g, dtype=torch.float64)

    def filmed(points: Callable[[Tensor], Tensor], R: Tensor = rig.R, t: Tensor = rig.t) -> Rig:
        tracks = []
        for i in range(len(rig.tracks)):
            moments = (torch.arange(len(rig.tracks[i]), dtype=torch.float64) / rig.fps[i] - rig.offsets[i]) / rig.rates[i]
            seen = project(rig.K[i], R[i], t[i], rig.distortion[i], points(moments))
            tracks.append(torch.where(rig.tracks[i].isnan(), torch.nan, seen + noise))
        return dataclasses.replace(rig, tracks=tracks, R=R, t=t)

    if case.spoiled == "still":
        return filmed(lambda moments: rig.points(torch.zeros_like(moments)))
    if case.spoiled == "plane":
        flat = torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64)
        middle = rig.points(torch.zeros(1, dtype=torch.float64)).mean((0, 1)) * (1 - flat)
        return filmed(lambda moments: rig.points(moments) * flat + middle)
    if case.spoiled == "moved":
        turn = torch.tensor([0.0, 0.07, 0.0], dtype=torch.float64)
        bent = rotation_exponential(turn) @ rig.R[1]
        moments = torch.arange(len(rig.tracks[1]), dtype=torch.float64) / rig.fps[1] - rig.offsets[1]
        after = project(rig.K[1], bent, rig.t[1], rig.distortion[1], rig.points(moments)) + noise
        half = len(after) // 2
        late = torch.where(rig.tracks[1][half:].isnan(), torch.nan, after[half:])
        return dataclasses.replace(rig, tracks=[rig.tracks[0], torch.cat([rig.tracks[1][:half], late]), *rig.tracks[2:]])
    if case.spoiled == "line":
        return filmed(rig.points, *_in_line(rig))
    return rig


def _in_line(rig: Rig) -> tuple[Tensor, Tensor]:
    """Cameras a metre apart on a straight line, level with the people, who are looked at."""
    middle = rig.points(torch.linspace(0, 8, 20, dtype=torch.float64)).mean((0, 1))
    R, t = [], []
    for i in range(len(rig.R)):
        center = middle + torch.tensor([1.2 * (i - 1.5), -5.0, 0.0], dtype=torch.float64)
        ahead = torch.nn.functional.normalize(middle - center, dim=0)
        right = torch.nn.functional.normalize(torch.linalg.cross(ahead, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)), dim=0)
        R.append(torch.stack([right, torch.linalg.cross(ahead, right), ahead]))
        t.append(-R[-1] @ center)
    return torch.stack(R), torch.stack(t)


def outcomes(case: Case, config: Config) -> list[Outcome]:
    """Of all rigs of a row, side by side."""
    seeds = range(config.first, config.first + config.rigs)
    if config.workers == 1:
        return [outcome(case, seed) for seed in seeds]
    os.environ["OMP_NUM_THREADS"] = "1"
    with ProcessPoolExecutor(config.workers, mp_context=get_context("spawn")) as pool:
        return list(pool.map(outcome, [case] * len(seeds), seeds))


GOALS: dict[str, dict[str, float]] = {
    "focal lengths unknown": {"rotation": 0.25, "focal": 1.0, "center": 0.6, "joints": 15.0, "worst": 2.0, "seconds": 15.0},
    "focal lengths known": {"rotation": 0.15, "worst": 2.0},
    "two cameras, focal lengths known": {"rotation": 0.25, "worst": 2.0},
    "30, 29.97, 25 and 30 frames per second, k1 down to -.2": {"rotation": 0.35, "worst": 2.0},
}
UNITS = {
    "rotation": " deg",
    "focal": " %",
    "center": " %",
    "joints": " mm",
    "clock": " ms",
    "worst": " deg",
    "seconds": " s",
    "ok": "",
}


def accuracy(config: Config, name: str) -> list[Row]:
    """The rows of one case."""
    found = outcomes(CASES[name], config)
    every = [one.errors for one in found if one.errors is not None]
    sure = [one.errors for one in found if one.ok and one.errors is not None]
    figures = {
        "rotation": median(one.rotation for one in every),
        "focal": 100 * median(one.focal for one in every),
        "center": 100 * median(one.center for one in every),
        "joints": median(one.joints for one in every),
        "clock": 1e3 * median(one.clock for one in every),
        "worst": max((one.worst for one in sure), default=float("nan")),
        "seconds": median(one.seconds for one in found),
    }
    if CASES[name].focal:
        del figures["focal"]
    goals = GOALS.get(name, {})
    rows = [Row(key, f"{len(every)} rigs", value, goals.get(key), at_most=True, unit=UNITS[key]) for key, value in figures.items()]
    return [*rows, Row("ok", f"of {len(found)}", len(sure))]


def refusals(config: Config, name: str) -> list[Row]:
    """How many are refused, and why most."""
    found = outcomes(SPOILED[name], config)
    reasons = [one.reason.partition(";")[0] for one in found if not one.ok]
    most = max(set(reasons), key=reasons.count) if reasons else ""
    return [Row("refused", f"of {len(found)}: {most}", len(reasons), len(found))]


@experiment(Config(), quick={"rigs": 3})
def tables(config: Config) -> Tables:
    """Rigs that are to be calibrated, and those that are to be refused."""
    for name in CASES:
        yield name, accuracy(config, name)
    for name in SPOILED:
        yield name, refusals(config, name)
