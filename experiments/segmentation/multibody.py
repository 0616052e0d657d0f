"""More than two bodies by one matrix: why the thesis calls these invariants intractable.

    python -m experiments.segmentation.multibody --quick

Scenes of :func:`dyntorch.scenes.bodies`, interleaved; per number of bodies and noise the ratio of the last but one singular value
to the last (the room that noise has) and the share of right labels under the best naming, with one label for all beside it;
``segment``, which is told the number of bodies, on the same matches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import comb
from pathlib import Path
from typing import Annotated

import torch
import tyro
from torch import Tensor

import dyntorch as dyn
from dyntorch.metrics import misclassification
from dyntorch.scenes import bodies as made
from experiments.common.tables import NoiseConfig, command, noise_tables
from experiments.thesis.definitions import homogeneous

MATCHES = {2: 300, 3: 219, 4: 384}
NOISES = (0.0, 0.01, 0.1, 0.5)
HEAD = ("bodies", "coefficients", "matches", "noise px", "room", "labels right", "one label", "segment")


@dataclass(frozen=True)
class Config(NoiseConfig):
    """Right labels of the multibody matrix over the bodies and the noise."""

    scenes: int = 10
    """Scenes per cell."""
    quick: bool = False
    """Two and three bodies, 5 scenes."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")] = Path("results/multibody.json")
    """Where the results and this configuration are written as JSON."""


def room(bodies: int, x1: Tensor, x2: Tensor) -> float:
    """Median over the scenes of the last but one singular value over the last, of unit rows in normalized coordinates."""
    factors = []
    for x in (x1, x2):
        p = homogeneous((x - x.mean(-2, keepdim=True)) / x.std((-2, -1), keepdim=True))
        powers = torch.combinations(torch.arange(3), bodies, with_replacement=True)
        factors.append(p[..., powers].prod(-1))
    rows = (factors[0][..., :, None] * factors[1][..., None, :]).flatten(-2)
    values = torch.linalg.svdvals(rows / rows.norm(dim=-1, keepdim=True))
    return float((values[..., -2] / values[..., -1].clamp(min=torch.finfo(values.dtype).tiny)).median())


def line(bodies: int, sigma: float, scenes: int, seed: int) -> Sequence[str]:
    """One row of the table."""
    draw = torch.Generator().manual_seed(seed)
    n = MATCHES[bodies]
    scene = made(n, bodies, batch=scenes, sigma=sigma, interleaved=True, generator=draw)
    found = dyn.invariants.multibody_matrix(scene.views[0], scene.views[1], bodies).labels
    segmented = dyn.segment(*scene.views, bodies=bodies, threshold=max(3 * sigma, 0.1), spatial=False, generator=draw).labels
    shares = [1 - float(misclassification(labels, scene.labels).mean()) for labels in (found, segmented)]
    size = comb(bodies + 2, 2) ** 2
    cells = f"{room(bodies, *scene.views):.1g}", f"{shares[0]:.1%}", f"{1 / bodies:.0%}", f"{shares[1]:.1%}"
    return str(bodies), str(size), str(n), f"{sigma:g}", *cells


def run(config: Config) -> None:
    """Print the table, then write the file."""
    scenes = min(config.scenes, 5) if config.quick else config.scenes
    chosen = [(bodies, sigma) for bodies in MATCHES for sigma in NOISES if bodies < 4 or not config.quick]
    title = f"medians of the room and means of the labels, {scenes} scenes a row"
    noise_tables({title: lambda: (HEAD, [line(*setting, scenes, config.seed) for setting in chosen])}, config)


if __name__ == "__main__":
    command(lambda: run(tyro.cli(Config, prog="python -m experiments.segmentation.multibody")))
