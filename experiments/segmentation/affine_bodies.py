"""Two bodies between affine views: ``affine_segmentation`` beside the projective segmentation matrix and ``segment``.

    python -m experiments.segmentation.affine_bodies --quick

Bodies of about 100 pixels, each under its own affine motion between two affine views, half of the matches on each. Wrong labels,
under the better naming, means over the scenes. 14 matches are the least (7 on each body); the segmentation matrix takes 35.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro

import dyntorch as dyn
from dyntorch.metrics import misclassification
from experiments.common.tables import NoiseConfig, command, noise_tables
from experiments.thesis.definitions import normal, seeded

SETTINGS = tuple((n, sigma) for n in (14, 20, 60, 200) for sigma in (0.0, 0.5, 1.0, 2.0))
SIZE = 50.0
"""Pixels: standard deviation of the image of a body."""
LEAST = 35
S = dyn.SegmentationMatrix
HEAD = ("matches", "noise px", "affine", "segmentation matrix", "segment")


@dataclass(frozen=True)
class Config(NoiseConfig):
    """Wrong labels of two bodies in affine views over the matches and the noise."""

    scenes: int = 40
    """Scenes per cell."""
    quick: bool = False
    """Only noise of 0.5 pixels, 20 scenes."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")] = Path("results/affine_bodies.json")
    """Where the results and this configuration are written as JSON."""


def line(n: int, sigma: float, scenes: int, seed: int) -> Sequence[str]:
    """One row of the table."""
    draw = seeded(seed)
    labels = (torch.arange(n) >= n // 2).long() + 1
    X = normal(scenes, n, 3, draw=draw)
    # every body has an affine camera of its own in each view: the motion of body and camera together
    cameras = SIZE * normal(scenes, 2, 2, 3, 2, draw=draw) / 3**0.5
    shifts = 2 * SIZE * normal(scenes, 2, 2, 1, 2, draw=draw)
    body = labels - 1
    seen = [(X[:, :, None] @ cameras[:, v][:, body])[:, :, 0] + shifts[:, v][:, body, 0] for v in (0, 1)]
    x1, x2 = (view + sigma * normal(*view.shape, draw=draw) for view in seen)
    wrong = [misclassification(dyn.tasks.affine_segmentation(x1, x2).labels, labels.expand(scenes, n)).mean()]
    cells = [f"{wrong[0]:.1%}"]
    if n >= LEAST:
        found = dyn.fit(S, x1, x2)
        matrix = S.labels(*S.fundamentals(found.tensor), x1, x2)
        general = dyn.segment(x1, x2, bodies=2, threshold=max(3 * sigma, 0.5), spatial=False, generator=draw).labels
        cells += [f"{misclassification(given, labels.expand(scenes, n)).mean():.1%}" for given in (matrix, general)]
    return str(n), f"{sigma:g}", *cells, *["-"] * (3 - len(cells))


def run(config: Config) -> None:
    """Print the table, then write the file."""
    scenes = min(config.scenes, 20) if config.quick else config.scenes
    chosen = [setting for setting in SETTINGS if not config.quick or setting[1] == 0.5]
    title = f"wrong labels, means of {scenes} scenes"
    noise_tables({title: lambda: (HEAD, [line(*setting, scenes, config.seed) for setting in chosen])}, config)


if __name__ == "__main__":
    command(lambda: run(tyro.cli(Config, prog="python -m experiments.segmentation.affine_bodies")))
