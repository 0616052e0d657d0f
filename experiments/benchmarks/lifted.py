"""How long reconstructions take: one problem against a batch of the same code, and the largest tensor.

    python -m experiments.benchmarks.lifted

All candidates take turns in one process; the figures are medians over the rounds, on one thread and on all.  Needs no recordings.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

import dyntorch as dyn
from dyntorch import scenes
from experiments.common.runner import BaseConfig, Tables, experiment
from experiments.common.tables import Row
from experiments.common.timing import interleaved, threads


@dataclass(frozen=True)
class Config(BaseConfig):
    """Settings of the benchmark."""

    rounds: int = 7
    """Turns of every candidate."""
    batch: int = 1000
    """Problems in the batch."""


def job(motion: str, n: int, views: int, batch: tuple[int, ...] = ()) -> Callable[[], object]:
    """The reconstruction of scenes with half a pixel of noise, outliers not excluded."""
    scene = scenes.lifted_points(motion, n, views, sigma=0.5, batch=batch, generator=torch.Generator().manual_seed(0))
    return lambda: dyn.reconstruct(scene.tracks, motion, scene.times)


def rows(config: Config, count: int) -> list[Row]:
    """The table on so many threads."""
    with threads(count):
        single = interleaved(
            {
                "plane": job("constant_velocity_2d", 60, 3),
                "space": job("constant_velocity_3d", 200, 4),
                "bodies": job("two_bodies_3d", 60, 3),
            },
            config.rounds,
        )
        many = interleaved({"batch": job("constant_velocity_2d", 60, 3, (config.batch,))}, max(1, config.rounds // 2))["batch"]
    each = many / config.batch
    on = f"{count} thread{'s' * (count > 1)}"
    return [
        Row(
            "constant_velocity_2d", f"3 views x 60 points, one problem, {on}", 1e3 * single["plane"], 60.0, at_most=True, unit=" ms"
        ),
        Row("constant_velocity_2d", f"the same in a batch of {config.batch}, each, {on}", 1e3 * each, unit=" ms"),
        Row("constant_velocity_2d", f"one problem over each of the batch, {on}", single["plane"] / each, 20.0, unit="x"),
        Row(
            "constant_velocity_3d",
            f"4 views x 200 points, one problem, {on}",
            1e3 * single["space"],
            500.0,
            at_most=True,
            unit=" ms",
        ),
        Row("two_bodies_3d", f"3 views x 60 points, one problem, {on}", 1e3 * single["bodies"], unit=" ms"),
    ]


@experiment(Config(), quick={"rounds": 1, "batch": 10}, one_thread=False)
def tables(config: Config) -> Tables:
    """On one thread, and on all."""
    several = torch.get_num_threads()
    yield "Reconstruction by lifted projections", [*rows(config, 1), *(rows(config, several) if several > 1 else [])]
