"""Several cameras on one clock: what ``synchronize_cameras`` gains over the pairs it is made of.

    python -m experiments.synchronization.cameras --quick

Scenes of :func:`dyntorch.scenes.filmed_person`: all pairs of cameras share the motion, and every further one sees it
at an offset of its own. The error of a camera's offset against the first camera, in frames: of the direct pair alone, and of the
clocks of all pairs together. In the second table one pair is given a wrong answer (half a second off, as sure as the others).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Annotated

import torch
import tyro
from torch import Tensor

import dyntorch as dyn
from experiments.common.tables import NoiseConfig, command, noise_tables
from experiments.thesis.definitions import mapped, normal, rotation, seeded, uniform

FPS, SECONDS, POINTS = 30.0, 4.0, 14
FOCAL = 900.0
SETTINGS = tuple((cameras, noise) for cameras in (2, 3, 4, 6) for noise in (1.0, 4.0, 8.0))
HEAD = ("cameras", "noise px", "direct pair frames", "all pairs frames", "worst camera frames", "called ok")
WRONG = 0.5
"""Seconds that one pair is wrong by."""


@dataclass(frozen=True)
class Config(NoiseConfig):
    """Errors of the clocks of several cameras."""

    scenes: int = 10
    """Scenes per cell."""
    quick: bool = False
    """Only noise of 4 pixels, 3 scenes."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")] = Path("results/cameras.json")
    """Where the results and this configuration are written as JSON."""


def takes(cameras: int, noise: float, draw: torch.Generator) -> tuple[list[Tensor], list[float]]:
    """Tracks of every camera and its offset in seconds to the first; camera c films 4 s from its own moment on."""
    cycles = 0.4 + 1.2 * torch.rand(6, POINTS, 3, generator=draw, dtype=torch.float64)
    phases = 2 * math.pi * torch.rand(6, POINTS, 3, generator=draw, dtype=torch.float64)
    heights = 0.12 * normal(6, POINTS, 3, draw=draw)
    body = uniform(POINTS, 3, draw=draw) * torch.tensor([0.4, 0.9, 0.4], dtype=torch.float64)
    starts = [0.0, *(uniform(cameras - 1, draw=draw)).tolist()]
    tracks = []
    for camera, start in enumerate(starts):
        t = start + torch.arange(int(SECONDS * FPS), dtype=torch.float64) / FPS
        waves = torch.sin(2 * math.pi * cycles * t[:, None, None, None] + phases)
        X = body + (heights * waves).sum(1)
        turn = rotation(torch.tensor([0.15, 2 * math.pi * camera / cameras + 0.3, 0.0], dtype=torch.float64))
        K = torch.diag(torch.tensor([FOCAL, FOCAL, 1.0], dtype=torch.float64))
        P = K @ torch.cat([turn, torch.tensor([[0.0], [0.0], [4.5]], dtype=torch.float64)], -1)
        x = mapped(X, P)
        tracks.append(x + noise * normal(*x.shape, draw=draw))
    # what camera c shows at its own time 0 the first shows at `start`: its clock is behind by that
    return tracks, [-start for start in starts]


def line(cameras: int, noise: float, scenes: int, seed: int, spoilt: bool) -> Sequence[str]:
    """One row of the table."""
    direct, joint, worst, ok = [], [], [], 0
    for scene in range(scenes):
        tracks, offsets = takes(cameras, noise, seeded(1000 * seed + scene))
        pairs = {
            (i, j): dyn.synchronize(tracks[i], tracks[j], fps=(FPS, FPS), max_shift=2.2) for i, j in combinations(range(cameras), 2)
        }
        if spoilt:
            first = pairs[0, 1]
            peaks = first.peaks.clone()
            peaks[:, 0] += WRONG
            pairs[0, 1] = replace(first, offset=first.offset + WRONG, peaks=peaks)
        clocks = dyn.combine_shifts(pairs, cameras)
        direct += [abs(float(pairs[0, c].offset) - offsets[c]) * FPS for c in range(1, cameras)]
        errors = [abs(float(clocks.offsets[c]) - offsets[c]) * FPS for c in range(1, cameras)]
        joint += errors
        worst.append(max(errors))
        ok += int(bool(clocks.ok))
    cells = [float(torch.tensor(values).median()) for values in (direct, joint, worst)]
    return str(cameras), f"{noise:g}", *(f"{value:.3f}" for value in cells), f"{ok} of {scenes}"


def run(config: Config) -> None:
    """Print the tables, then write the file."""
    scenes = min(config.scenes, 3) if config.quick else config.scenes
    chosen = [setting for setting in SETTINGS if not config.quick or setting[1] == 4.0]
    tables = {
        f"error of a camera's clock, medians of {scenes} scenes": lambda: (
            HEAD,
            [line(*setting, scenes, config.seed, False) for setting in chosen],
        ),
        "the same where the first two cameras were synchronized wrongly": lambda: (
            HEAD,
            [line(*setting, scenes, config.seed, True) for setting in chosen if setting[0] > 2],
        ),
    }
    noise_tables(tables, config)


if __name__ == "__main__":
    command(lambda: run(tyro.cli(Config, prog="python -m experiments.synchronization.cameras")))
