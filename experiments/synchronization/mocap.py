"""A camera against motion capture: offsets, whether their sigma is honest, and what is refused.

    DYNTORCH_DATA=../shared/data python -m experiments.synchronization.mocap
    DYNTORCH_DATA=../shared/data python -m experiments.synchronization.mocap --quick

**Virtual**: a person as recorded (CMU), or the 51 markers of an arm that lifts a box (pyomeca), millimetres, y or z up, at 100 to
240 Hz; a camera at a random place films 5 s of it at 25 to 60 fps: 3 to 6 px of noise, a tenth of every track missing in blocks,
unknown focal length, and for some a lens nobody calibrated or a clock that runs otherwise.  Same points: the 17 joints of a usual
skeleton in both.  Different points: these in the camera, 14 others in space, in an order that nobody knows; of the box a third of
the markers in the camera, the others in space.

**Undecidable**: films that run backwards, of another take, of people who repeat themselves exactly, or stand.

**Detected keypoints**: BODY_25B of four cameras at 60 fps, 100 frames of a person who balances, against the same in space as
Pose2Sim triangulated it from all of them; cut by known amounts.

Errors are in frames of the camera; ``z`` is the error over sigma.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import fmean, median

import numpy as np
import torch
from torch import Generator, Tensor

import dyntorch as dyn
from experiments.common.runner import BaseConfig, Tables, experiment
from experiments.common.tables import Row
from experiments.recognition.protocol import data_folder
from experiments.synchronization.data import (
    MOVING,
    RECORDED,
    SAME,
    Filming,
    Motion,
    draw,
    gaps,
    image,
    moving,
    periodic_motion,
    played,
    seeded,
    still_motion,
)
from experiments.synchronization.real import people
from indexing.joints import places
from indexing.skeleton import LAYOUTS, Skeleton

SECONDS = 5.0
"""Of the film."""
WIDER = 2.5
"""Seconds that the motion capture records before and after the film, at most."""
RATES = ((30.0, 120.0), (25.0, 100.0), (60.0, 240.0), (50.0, 200.0), (29.97, 100.0), (30.0, 240.0))
"""Frames per second of the camera and of the motion capture."""
SHIFTS = (-20, -7, 0, 3, 12)
"""Frames at 60 fps that are cut from the camera, or from the motion capture where negative."""
DIFFERENT = tuple(k for k in range(31) if k not in SAME)
"""Joints of the 31 recorded that the camera does not see."""
WITHIN = 0.5
"""Frames of the camera."""


@dataclass(frozen=True)
class Config(BaseConfig):
    """A camera against motion capture."""

    cases: int = 16
    """Virtual cases per table of people, of the markers a quarter of it, and trials per kind that is undecidable."""


@dataclass(frozen=True)
class Take:
    """What a camera saw ``(frames, n, 2)`` px and what was recorded ``(frames, m, 3)`` mm.

    Attributes:
        offset, rate: the time of the motion capture = the time of the film * rate + offset, seconds; NaN where they are of
            different events.
        fps: of the camera and of the motion capture.
    """

    name: str
    film: Tensor
    space: Tensor
    fps: tuple[float, float]
    offset: float
    rate: float = 1.0

    def error(self, found: dyn.Shift) -> float:
        """Frames of the camera, in the middle of the film."""
        moment = 0.5 * (len(self.film) - 1) / self.fps[0]
        return (found.rate * moment + found.offset - self.rate * moment - self.offset) * self.fps[0]


@dataclass(frozen=True)
class Setting:
    """How a case is recorded.

    Attributes:
        index: which pair of rates, and which axis is up.
        rate: seconds of the motion capture's clock per second of the film's.
        lens: range of k1.
        seen, recorded: points of the camera, and of the motion capture.
    """

    index: int
    rate: float
    lens: tuple[float, float]
    seen: Sequence[int]
    recorded: Sequence[int]


def recorded(motion: Motion, seconds: float, setting: Setting, generator: Generator) -> Take:
    """A film of a part of a motion that lasts so long, and the motion capture from a while before it to a while after."""
    fps, rate = RATES[setting.index % len(RATES)], setting.rate
    frames = int(min(SECONDS, 0.8 * seconds) * fps[0])
    duration = rate * frames / fps[0]
    for _ in range(20):
        start = draw(0.0, seconds - duration, generator)
        part = motion(start + torch.linspace(0, duration, 50, dtype=torch.float64))
        if float((part - part.mean(0)).square().sum(-1).mean().sqrt()) > MOVING:
            break
    first = max(0.0, start - draw(0.0, WIDER, generator))
    last = min(seconds, start + duration + draw(0.0, WIDER, generator))
    seen = motion(start + rate * torch.arange(frames, dtype=torch.float64) / fps[0])[:, list(setting.seen)]
    filming = Filming(noise_mm=draw(13.0, 18.0, generator), missing=0.1, lens=setting.lens)
    film, _ = image(seen, seen.reshape(-1, 3), filming, generator)
    space = motion(torch.arange(first, last, 1 / fps[1], dtype=torch.float64))[:, list(setting.recorded)]
    space = 1000 * (space if setting.index % 2 else space[..., [2, 0, 1]])  # y up, or z up
    return Take("", film, gaps(space, 0.02, generator), fps, start - first, rate)


def person(index: int, config: Config, *, same: bool) -> tuple[Motion, float, Setting, Generator]:
    """The motion of a take, how long it is, and how the case is recorded."""
    long = moving(8.0)
    generator = seeded(config.seed, 41, index)
    take = long[int(torch.randperm(len(long), generator=seeded(config.seed, 42))[index % len(long)])]
    lens = (-0.25, 0.0) if index % 4 == 3 else (0.0, 0.0)
    rate = 1.0005 if index % 5 == 4 else 1.0
    setting = Setting(index, rate, lens, SAME, SAME if same else DIFFERENT)
    return played(take.joints), (len(take.joints) - 1) / RECORDED, setting, generator


def lifting() -> tuple[Motion, float, int]:
    """The markers of an arm that lifts a box, metres; how long, and how many.

    Source: pyomeca (Apache-2.0).
    """
    from scipy.interpolate import CubicSpline

    with np.load(data_folder() / "pyomeca_markers.npz") as file:
        markers, fps = file["markers_mm"].astype(float) / 1000, float(file["rate"])
    whole = np.isfinite(markers).all((0, 2))
    spline = CubicSpline(np.arange(len(markers)) / fps, markers[:, whole][..., [1, 2, 0]], axis=0)  # y up, as of people
    return lambda times: torch.from_numpy(spline(times.numpy())), (len(markers) - 1) / fps, int(whole.sum())


def cases(config: Config, *, same: bool) -> list[Take]:
    """People, then the box."""
    found = []
    for index in range(config.cases):
        motion, seconds, setting, generator = person(index, config, same=same)
        found.append(replace(recorded(motion, seconds, setting, generator), name="people"))
    motion, seconds, count = lifting()
    for index in range(max(config.cases // 4, 1)):
        generator = seeded(config.seed, 43, index)
        order = torch.randperm(count, generator=generator).tolist()
        seen, others = order[: count // 3], order[count // 3 :]
        setting = Setting(index, 1.0, (0.0, 0.0), seen, seen if same else others)
        found.append(replace(recorded(motion, seconds, setting, generator), name="box"))
    return found


def solved(takes: Sequence[Take], *, same: bool) -> tuple[list[dyn.Shift], list[float]]:
    """Answers, and seconds that each took."""
    found, seconds = [], []
    for take in takes:
        started = time.perf_counter()
        found.append(dyn.synchronize(take.film, take.space, correspondence=same, fps=take.fps))
        seconds.append(time.perf_counter() - started)
    return found, seconds


def rows_of(takes: Sequence[Take], *, same: bool, goal: float) -> list[Row]:
    """Share within half a frame, errors over sigma, what is called ok and wrong, and seconds."""
    rows = []
    for name in dict.fromkeys(take.name for take in takes):
        chosen = [take for take in takes if take.name == name]
        found, seconds = solved(chosen, same=same)
        errors = [take.error(one) for take, one in zip(chosen, found, strict=True)]
        ok = [one.ok for one in found]
        z = [e / (one.sigma * take.fps[0]) for e, one, take in zip(errors, found, chosen, strict=True) if one.ok]
        rms = math.sqrt(fmean(value**2 for value in z)) if z else math.nan
        sigma = median([one.sigma * take.fps[0] for one, take in zip(found, chosen, strict=True)])
        told = f"{len(errors)} cases; median {median(map(abs, errors)):.3f} frames, worst {max(map(abs, errors)):.2f}"
        wrong = sum(good and abs(error) > 1 for error, good in zip(errors, ok, strict=True))
        told_ok = f"median sigma {sigma:.3f} frames; z of these: rms {rms:.2f}, worst {max(map(abs, z), default=0.0):.1f}"
        rows += [
            Row(f"{name}, within half a frame", told, fmean(abs(error) <= WITHIN for error in errors), goal),
            Row(f"{name}, called ok", told_ok, fmean(ok)),
            Row(f"{name}, ok but wrong", "by more than a frame", float(wrong), 0.0, at_most=True),
            Row(f"{name}, time", "median per pair", median(seconds), unit=" s"),
        ]
    return rows


def undecidable(config: Config, *, same: bool) -> list[Row]:
    """None of these should be ok."""
    kinds: dict[str, Callable[[int], Take]] = {
        "backwards": lambda k: _backwards(_of(k, config, same=same)),
        "another take": lambda k: replace(_of(k, config, same=same), space=_of(k + 7, config, same=same).space),
        "periodic": lambda k: _repeating(periodic_motion, k, config, same=same),
        "still": lambda k: _repeating(still_motion, k, config, same=same),
    }
    rows = []
    for name, make in kinds.items():
        takes = [make(index) for index in range(config.cases)]
        found, _ = solved(takes, same=same)
        reasons = [one.notices[0].code.name.lower() for one in found if not one.ok]
        said = ", ".join(f"{reasons.count(code)} {code}" for code in dict.fromkeys(reasons))
        told = f"of {len(found)}; refused: {said}"
        rows.append(Row(f"{name}, called ok", told, float(sum(one.ok for one in found)), 0.0, at_most=True))
    return rows


def _of(index: int, config: Config, *, same: bool) -> Take:
    motion, seconds, setting, generator = person(index, config, same=same)
    return recorded(motion, seconds, setting, generator)


def _backwards(take: Take) -> Take:
    return replace(take, film=take.film.flip(0), offset=math.nan)


def _repeating(make: Callable[[Tensor, Generator], Motion], index: int, config: Config, *, same: bool) -> Take:
    _, _, setting, generator = person(index, config, same=same)
    joints = moving(8.0)[index % len(moving(8.0))].joints
    return recorded(make(joints, generator), 2 * SECONDS, setting, generator)


def detected() -> tuple[list[tuple[Tensor, Tensor]], float]:
    """Every camera's keypoints and the same points in space, by name; and the frame rate."""
    cameras, fps = people()
    with np.load(data_folder() / "pose2sim" / "pose2sim_balancing.npz") as file:
        space, names = torch.from_numpy(file["trc_raw"].astype(float)), tuple(str(name) for name in file["trc_names"])
    both = [(i, j) for i, j in enumerate(places(Skeleton("trc", names), LAYOUTS["BODY_25B"])) if j >= 0]
    seen, points = (list(part) for part in zip(*both, strict=True))
    return [(one[:, seen], space[:, points]) for one in cameras], fps


def keypoints(config: Config) -> list[Row]:
    """Errors of every camera at every cut, at 60 fps and at half of it."""
    pairs, fps = detected()
    takes: list[Take] = []
    for film, space in pairs[:: 2 if config.quick else 1]:
        for cut in SHIFTS[1:3] if config.quick else SHIFTS:
            early, late = max(cut, 0), max(-cut, 0)
            takes.append(Take("60 fps", film[early:], space[late:], (fps, fps), (early - late) / fps))
            takes.append(Take("30 fps", film[early::2], space[late:], (fps / 2, fps), (early - late) / fps))
    rows = rows_of(takes, same=True, goal=1.0)
    other = [replace(take, film=take.film[:, ::2], space=take.space[:, 1::2]) for take in takes if take.name == "60 fps"]
    return rows + [replace(row, task=f"different points, {row.task}") for row in rows_of(other, same=False, goal=0.0)]


@experiment(Config(), quick={"cases": 4})
def tables(config: Config) -> Tables:
    """Virtual cases, those that are undecidable, and detected keypoints."""
    yield "Same points", rows_of(cases(config, same=True), same=True, goal=1.0)
    yield "Different points", rows_of(cases(config, same=False), same=False, goal=0.8)
    yield "Undecidable, same points", undecidable(config, same=True)
    yield "Undecidable, different points", undecidable(config, same=False)
    yield "Detected keypoints, 100 frames", keypoints(config)
