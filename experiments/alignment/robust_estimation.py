"""Robust estimation of the invariants: how often the right model is found among wrong matches, how accurate it is, and how fast.

    python -m experiments.alignment.robust_estimation
    python -m experiments.alignment.robust_estimation --quick

Synthetic scenes of 200 matches, all of them moving where the invariant is about motion; of an outlier one view is replaced by a
random point of that view.  A scene is a success if the RMS distance of its exact true matches from the model is below the noise
of one coordinate and 95 % of the true matches are among the inliers.  Times are per scene in batches, the median over them.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.core.invariant import Invariant
from dyntorch.core.limits import quantile
from dyntorch.scenes.scene import OUTLIER, Scene
from experiments.common.runner import SceneConfig, Tables, experiment
from experiments.common.tables import Row

KEPT = 0.95


@dataclass(frozen=True)
class Task:
    """An invariant with scenes for it, and the goals: a share of successes per share of outliers, milliseconds."""

    invariant: Invariant
    scene: Callable[..., Scene]
    sigma: float
    goals: dict[float, float]
    milliseconds: float | None = None
    batch: int = 32


TASKS = {
    "homography tensor": Task(dyn.HomographyTensor(), scenes.planar, 0.5, {0.4: 0.95}, 15.0, 64),
    "join tensor": Task(dyn.JoinTensor(), scenes.moving_points, 0.01, {0.2: 0.95}),
    "minimal join tensor": Task(dyn.MinimalJoinTensor(), scenes.moving_points, 0.01, {0.2: 0.95}),
    "constant velocity tensor": Task(dyn.ConstantVelocityTensor(), scenes.constant_velocity, 0.01, {0.2: 0.95}),
    "fundamental matrix": Task(dyn.FundamentalMatrix(), scenes.two_view, 0.5, {}, batch=64),
    "collineation": Task(dyn.Collineation(2), scenes.collineation, 0.002, {}, batch=64),
}


@dataclass(frozen=True)
class Config(SceneConfig):
    """Robust estimation over shares of outliers, beside the goals."""

    outliers: tuple[float, ...] = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
    """Shares of wrong matches."""
    matches: int = 200
    """Matches per scene."""
    estimate: bool = False
    """Do not give the threshold, but have it estimated."""


def measure(task: Task, share: float, config: Config) -> tuple[float, float, float]:
    """Share of successes, median RMS distance of the exact true matches in units of the noise, milliseconds per scene."""
    found, errors, times = [], [], []
    threshold = None if config.estimate else task.sigma * quantile(0.995, task.invariant.codim) ** 0.5
    for seed, start in enumerate(range(0, config.scenes, task.batch)):
        size = min(task.batch, config.scenes - start)
        made = task.scene(
            n=config.matches, batch=size, sigma=task.sigma, outliers=share, generator=torch.Generator().manual_seed(seed)
        )
        clock = time.perf_counter()
        solution = dyn.robust_fit(
            task.invariant, *made.views, threshold=threshold, generator=torch.Generator().manual_seed(1000 + seed)
        )
        times.append((time.perf_counter() - clock) / size * 1e3)
        assert solution.inliers is not None
        right = made.labels != OUTLIER
        clean = dyn.sampson(task.invariant, solution.tensor, *made.exact)
        rms = ((clean.square() * right).sum(-1) / right.sum(-1)).sqrt() / task.sigma
        kept = (solution.inliers & right).sum(-1) / right.sum(-1)
        found.append((rms < 1) & (kept >= KEPT) & (solution.status == dyn.Status.OK))
        errors.append(rms)
    return float(torch.cat(found).double().mean()), float(torch.cat(errors).median()), sorted(times)[len(times) // 2]


def table(name: str, config: Config) -> list[Row]:
    """Success, accuracy and time of one invariant over the shares of outliers."""
    task, rows = TASKS[name], []
    for share in config.outliers:
        success, error, milliseconds = measure(task, share, config)
        setting = f"{share:.0%} outliers"
        goal = task.goals.get(share)
        rows += [
            Row(name, f"{setting}, success", success, goal),
            Row(name, f"{setting}, error / noise", error),
            Row(name, f"{setting}, time per scene", milliseconds, task.milliseconds if goal else None, at_most=True, unit=" ms"),
        ]
    return rows


@experiment(Config(scenes=128), quick={"scenes": 16, "outliers": (0.2, 0.4)})
def tables(config: Config) -> Tables:
    """Success, accuracy and time of every invariant over the shares of outliers."""
    dyn.robust_fit(dyn.HomographyTensor, *scenes.planar(60, batch=4, sigma=0.5).views, threshold=1.5)  # first calls are slow
    for name in TASKS:
        yield name, table(name, config)
