"""Lines that move within planes, measured by a 3D sensor: ``align_lines`` under noise, on bodies, and with static points.

    python -m experiments.alignment.lines --quick

Scenes of :func:`dyntorch.scenes.translating_lines`, of about 4 units; medians of the relative error of A. The second table is the
thesis's own case (section 8.4): lines of a few translating bodies, whose exact estimation matrix has rank 20, 28, 31, 31 for 1,
2, 3 and many bodies, and what static points add.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro

import dyntorch as dyn
from dyntorch.geometry.extensors import plucker
from dyntorch.metrics import relative_error
from dyntorch.scenes import translating_lines
from experiments.common.tables import NoiseConfig, command, noise_tables
from experiments.thesis.definitions import rank

SETTINGS = tuple((n, sigma) for n in (60, 120, 300) for sigma in (0.001, 0.005, 0.02))
HEAD = ("lines", "noise", "linear", "refined", "aligned: 40 % static, 20 % outliers", "solved", "labels of those right")
BODIES = ("bodies", "static points", "rank", "solved", "relative error", "at noise .001: solved", "relative error")


@dataclass(frozen=True)
class Config(NoiseConfig):
    """Errors of lines over their number and the noise."""

    scenes: int = 20
    """Scenes per cell."""
    quick: bool = False
    """Only noise of 0.005, 6 scenes."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")] = Path("results/lines.json")
    """Where the results and this configuration are written as JSON."""


def line(n: int, sigma: float, scenes: int, seed: int) -> Sequence[str]:
    """One row of the table over the noise."""
    draw = torch.Generator().manual_seed(seed)
    scene = translating_lines(n, batch=scenes, sigma=sigma, generator=draw)
    linear = dyn.fit(dyn.TranslatingLinesMatrix, *scene.views)
    errors = [relative_error(found.motion[0], scene.motion[0]) for found in (linear, dyn.refine(linear, *scene.views))]
    mixed = translating_lines(n, batch=scenes, sigma=sigma, static=0.4, outliers=0.2, generator=draw)
    aligned = dyn.align_lines(*mixed.views, threshold=3 * sigma, generator=draw)
    good = aligned.status == dyn.Status.OK
    cells = [f"{float(value.median()):.2g}" for value in errors]
    if not bool(good.any()):
        return str(n), f"{sigma:g}", *cells, "-", f"0 of {scenes}", "-"
    found = float(relative_error(aligned.A, mixed.motion[0])[good].median())
    right = (aligned.labels == mixed.labels)[good].double().mean()
    return str(n), f"{sigma:g}", *cells, f"{found:.2g}", f"{int(good.sum())} of {scenes}", f"{right:.3f}"


def bodies(objects: int, points: int, scenes: int, seed: int) -> Sequence[str]:
    """One row of the table over the bodies; 0 bodies: every line by itself."""
    draw = torch.Generator().manual_seed(seed)
    kind = {"motion": "objects", "objects": objects} if objects else {"motion": "translation"}
    cells = []
    for sigma in (0.0, 0.001):
        scene = translating_lines(90, batch=scenes, sigma=sigma, static_points=points, generator=draw, **kind)
        given = (scene.extras["points1"], scene.extras["points2"]) if points else None
        found = dyn.align_lines(*scene.views, static_points=given, threshold=max(3 * sigma, 1e-6), generator=draw)
        good = found.status == dyn.Status.OK
        error = relative_error(found.A, scene.motion[0])[good]
        cells += [f"{int(good.sum())} of {scenes}", f"{float(error.median()):.1g}" if len(error) else "-"]
        if sigma == 0:
            first, second = (plucker(view[0]) for view in scene.views)
            cells.insert(0, str(rank((second[:, :, None] * first[:, None, :]).flatten(1))))
    return str(objects or "every line"), str(points), *cells


def run(config: Config) -> None:
    """Print the tables, then write the file."""
    scenes = min(config.scenes, 6) if config.quick else config.scenes
    chosen = [setting for setting in SETTINGS if not config.quick or setting[1] == 0.005]
    pairs = [(objects, points) for objects in (1, 2, 3, 0) for points in (0, 2, 4)]
    tables = {
        f"relative error of A, medians of {scenes} scenes": lambda: (HEAD, [line(*s, scenes, config.seed) for s in chosen]),
        "lines of translating bodies, without and with static points": lambda: (
            BODIES,
            [bodies(*pair, scenes, config.seed) for pair in pairs],
        ),
    }
    noise_tables(tables, config)


if __name__ == "__main__":
    command(lambda: run(tyro.cli(Config, prog="python -m experiments.alignment.lines")))
