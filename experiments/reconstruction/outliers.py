"""Reconstruction of scenes in which everything moves, from tracks of which some are wrong: how often it succeeds, and how fast.

    python -m experiments.reconstruction.outliers
    python -m experiments.reconstruction.outliers --quick

Scenes of ``dyntorch.scenes.lifted_points`` with 0.5 pixels of noise; of an outlier one view is moved by up to 100 pixels in each
coordinate.  The best is what the right points alone give.  A scene is a success if its status is the same as there (OK, or
AMBIGUOUS where the noise hides the motion), more than 95 % of the right points are reconstructed and stay below 3 pixels in every
view that counts, and the error of the positions is at most twice that of the best.  A scene is wrong if the status is OK, but
that error is more than 3 times as large or less than 90 % are kept.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import torch

import dyntorch as dyn
from dyntorch import metrics, scenes
from experiments.common.runner import BaseConfig, Tables, experiment
from experiments.common.tables import Row

SIGMA, NEAR, KEPT, CLOSE, WRONG = 0.5, 3.0, 0.95, 2.0, 3.0
SETTINGS: dict[str, tuple[tuple[int, int, int], ...]] = {
    "constant_velocity_2d": ((3, 100, 32), (3, 200, 32), (6, 100, 16)),
    "constant_direction_3d": ((3, 100, 32), (3, 200, 32)),
    "constant_velocity_planes_3d": ((4, 100, 16), (5, 100, 8)),
    "constant_velocity_3d": ((4, 100, 8), (4, 200, 8), (6, 100, 8)),
    "constant_acceleration_2d": ((6, 200, 8),),
}
"""Views, points and scenes per model."""
GOALS = {("constant_velocity_2d", 3): 0.3, ("constant_direction_3d", 3): 0.3}
"""Share of outliers up to which 95 % shall succeed."""


@dataclass(frozen=True)
class Config(BaseConfig):
    """Reconstruction over shares of outliers, beside the goals."""

    outliers: tuple[float, ...] = (0.0, 0.1, 0.2, 0.3)
    """Shares of wrong tracks."""
    motions: tuple[str, ...] = tuple(SETTINGS)
    """Models."""
    estimate: bool = False
    """Do not give the threshold, but have it estimated."""


def measure(
    motion: str, views: int, n: int, share: float, count: int, threshold: float | None
) -> tuple[float, float, float, float]:
    """Shares of successes and of wrong scenes, median error over that of the right points alone, seconds per scene."""
    generator = torch.Generator().manual_seed(0)
    scene = scenes.lifted_points(motion, n, views=views, sigma=SIGMA, outliers=share, batch=count, generator=generator)
    assert scene.lifts is not None
    clock = time.perf_counter()
    found = dyn.reconstruct(scene.tracks, motion, scene.times, threshold=threshold, generator=torch.Generator().manual_seed(1))
    seconds = (time.perf_counter() - clock) / count
    right = scene.labels != 0
    clean = torch.where(right[:, None, :, None], scene.tracks, torch.nan)
    oracle = dyn.reconstruct(clean, motion, scene.times, threshold=torch.inf)
    known = right & (found.labels > 0)
    near = (found.residuals.nan_to_num(nan=0.0) < NEAR).all(1)
    kept = (known & near).sum(-1) / right.sum(-1)
    error = metrics.lifted_error(found.structure, scene.structure, scene.lifts, known).position
    best = metrics.lifted_error(oracle.structure, scene.structure, scene.lifts, right).position
    relative = (error / best).nan_to_num(nan=torch.inf)
    sure = found.status == dyn.Status.OK
    success = (found.status == oracle.status) & (kept > KEPT) & (relative <= CLOSE)
    wrong = sure & ((kept < 0.9) | (relative > WRONG))
    return float(success.double().mean()), float(wrong.double().mean()), float(relative.median()), seconds


def table(motion: str, config: Config) -> list[Row]:
    """One model over its numbers of views and points and the shares of outliers."""
    rows = []
    threshold = None if config.estimate else 3 * SIGMA
    for views, n, count in SETTINGS[motion][: 1 if config.quick else None]:
        for share in config.outliers:
            success, wrong, relative, seconds = measure(
                motion, views, n, share, max(2, count // (8 if config.quick else 1)), threshold
            )
            setting = f"{views} views, {n} points, {share:.0%} outliers"
            goal = 0.95 if 0 < share <= GOALS.get((motion, views), 0.0) else None
            rows += [
                Row(motion, f"{setting}, success", success, goal),
                Row(motion, f"{setting}, wrong", wrong),
                Row(motion, f"{setting}, error / best", relative),
                Row(motion, f"{setting}, time per scene", seconds, unit=" s"),
            ]
    return rows


@experiment(Config())
def tables(config: Config) -> Tables:
    """Every model over the shares of outliers; quick: an eighth of the scenes, the least views and points."""
    for motion in config.motions:
        yield motion, table(motion, config)
