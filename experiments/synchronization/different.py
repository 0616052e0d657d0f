"""Different points before two cameras: every measure of the thesis's chapter 7 by name, and what is called ok, by kind of camera.

    python -m experiments.synchronization.different
    python -m experiments.synchronization.different --quick

Takes are those of ``experiments.synchronization.takes``: one to four bodies that are rigid, hinged or in one plane, or points
between free ones; 10 points in a and 9 others in b, 8 s at 25 fps, shifted by up to 1.2 s and fractions of frames.  Errors are
in frames.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean, median
from typing import Annotated

import tyro

import dyntorch as dyn
from dyntorch.tasks.synchronize.result import SynchronizeOptions
from dyntorch.tasks.synchronize.row_spaces import MEASURES
from experiments.common.tables import Row, command, measured_on_one_thread
from experiments.synchronization.data import Pair
from experiments.synchronization.takes import Scene, drawn

REACH = 2.4
"""Seconds: how far is searched."""
NOISES = (0.0, 0.5, 1.0)
"""px."""


@dataclass(frozen=True)
class Config:
    """Different points before two cameras, by measure and by kind of camera."""

    takes: int = 16
    """Takes per figure: of each kind of motion with one to four bodies in turn."""
    quick: bool = False
    """4 takes per figure."""
    seed: int = 0
    """Of the takes."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")] = Path("results/different_points.json")
    """Where the results and this configuration are written as JSON."""

    @property
    def count(self) -> int:
        """Takes per figure."""
        return min(self.takes, 4) if self.quick else self.takes


def found(pairs: Sequence[Pair], options: SynchronizeOptions) -> tuple[list[float], list[bool]]:
    """Errors in frames, and what is called ok."""
    answers = [dyn.synchronize(p.a, p.b, correspondence=False, fps=p.fps, max_shift=REACH, options=options) for p in pairs]
    return [abs(p.error(x.offset, x.rate)) for p, x in zip(pairs, answers, strict=True)], [x.ok for x in answers]


def row(task: str, setting: str, pairs: Sequence[Pair], options: SynchronizeOptions) -> list[Row]:
    """Share within a frame, and how many are called ok and wrong."""
    errors, ok = found(pairs, options)
    wrong = sum(good and error > 1 for error, good in zip(errors, ok, strict=True))
    told = f"{setting}; median {median(errors):.4f} frame, ok {fmean(ok):.2f}"
    return [
        Row(f"{task}, within a frame", told, fmean(e <= 1 for e in errors)),
        Row("ok but wrong", setting, wrong, 0.0, at_most=True),
    ]


def measures(config: Config) -> list[Row]:
    """The thesis's measures on its own model, fixed affine cameras, and all evidence together."""
    rows = []
    for noise in NOISES[:2]:
        pairs = drawn(Scene(noise=noise), config.count, config.seed)
        for measure in MEASURES:
            options = SynchronizeOptions()
            if measure != "auto":
                options = replace(options, measure=measure, camera_model="affine")
            rows += row(measure, f"fixed affine cameras, {noise:g} px", pairs, options)
    return rows


def cameras(config: Config) -> list[Row]:
    """Every kind of camera, chosen by evidence."""
    rows = []
    for camera in ("affine", "affine_moving", "perspective"):
        for noise in NOISES:
            pairs = drawn(Scene(camera=camera, noise=noise), config.count, config.seed + 1)
            rows += row(camera, f"{noise:g} px", pairs, SynchronizeOptions())
    return rows


def foreign(config: Config) -> list[Row]:
    """Two of b's nine tracks have no part in the motion."""
    rows = []
    for camera in ("affine", "perspective"):
        pairs = drawn(Scene(camera=camera, foreign=2), config.count, config.seed + 2)
        rows += row(camera, "0.5 px, 2 of 9 foreign", pairs, SynchronizeOptions())
    return rows


def unrelated(config: Config) -> list[Row]:
    """Films of different events: none should be ok."""
    rows = []
    for camera in ("affine", "perspective"):
        pairs = drawn(Scene(camera=camera), config.count, config.seed + 3)
        strange = [replace(p, b=q.b, offset=math.nan) for p, q in zip(pairs, [*pairs[1:], *pairs[:1]], strict=True)]
        _, ok = found(strange, SynchronizeOptions())
        rows.append(Row("ok but wrong", f"{camera}, another event, of {len(ok)}", float(sum(ok)), 0.0, at_most=True))
    return rows


TABLES = {
    "Measures by name": measures,
    "Kinds of cameras": cameras,
    "Foreign tracks": foreign,
    "Other events": unrelated,
}


def run(config: Config) -> None:
    """Print every table, then write the file.

    Raises:
        ValueError: a file that cannot be written.
    """
    measured_on_one_thread(TABLES, config, config.out)


if __name__ == "__main__":
    command(lambda: run(tyro.cli(Config, prog="python -m experiments.synchronization.different")))
