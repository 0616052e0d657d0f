"""Different points of one rigid body before two uncalibrated perspective cameras: the clocks, then both point sets in one frame.

``python -m experiments.reconstruction.bodies`` prints, of synthetic takes at 30 fps (a body of .3 m that turns by about a radian
and wanders by .3 m, cameras 60 degrees apart; all is written from x ~ P M(t) X), for each setting and noise: the share of shifts
that are accepted, the share that are accepted and off by more than half a frame, the median error (frames), and the median error
of both point sets after the best affinity of space (per cent of their spread), at the shift that was found.  The last setting is of
pairs that show different motions: nothing may be accepted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro
from torch import Tensor

from dyntorch.tasks.pair.pair import reconstruct_pair
from dyntorch.tasks.synchronize.synchronize import synchronize
from experiments.common.tables import NoiseConfig, Row, command, measured

FPS, OFFSET = 30.0, 0.217
SETTINGS = {
    "8 points, 4 s, at 4 m": (8, 120, 4.0, 0),
    "6 points": (6, 120, 4.0, 0),
    "2 s": (8, 60, 4.0, 0),
    "at 12 m": (8, 120, 12.0, 0),
    "2 of 9 on no body": (9, 120, 4.0, 2),
    "different motions": (8, 120, 4.0, 0),
}
"""Points of each camera, frames, metres from the cameras, and points that go their own way."""
D = torch.float64


@dataclass(frozen=True)
class Config(NoiseConfig):
    """Settings of the table."""

    scenes: int = 8
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")] = Path("results/rigid_bodies.json")


def rotation(v: Tensor) -> Tensor:
    """Rotations ``(..., 3, 3)`` by axes times angles."""
    zero = torch.zeros_like(v[..., 0])
    x, y, z = v.unbind(-1)
    rows = [torch.stack(row, -1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    turn: Tensor = torch.linalg.matrix_exp(torch.stack(rows, -2))
    return turn


class Take:
    """A body, its motion, and two cameras."""

    def __init__(self, seed: int, n: int, distance: float, foreign: int) -> None:
        self.draw = torch.Generator().manual_seed(seed)
        self.waves = self._waves(6)
        self.points = [0.3 * self._normal(n, 3) for _ in range(2)]
        self.strangers = [[self._waves(3) for _ in range(foreign)] for _ in range(2)]
        inner = torch.tensor([[[900.0, 0, 640], [0, 900, 480], [0, 0, 1]], [[1200.0, 0, 600], [0, 1150, 500], [0, 0, 1]]], dtype=D)
        seats = rotation(torch.tensor([[0.1, 0.0, 0.1], [0.2, math.pi / 3, 0.0]], dtype=D))
        place = torch.tensor([0.0, 0.1, distance], dtype=D).expand(2, 3)[..., None]
        self.cameras = inner @ torch.cat([seats, place], -1)

    def _normal(self, *shape: int) -> Tensor:
        return torch.randn(*shape, generator=self.draw, dtype=D)

    def _waves(self, count: int) -> Tensor:
        free = torch.rand(2, 4, count, generator=self.draw, dtype=D)
        return torch.cat([free, self._normal(1, 4, count)])

    @staticmethod
    def waved(t: Tensor, waves: Tensor) -> Tensor:
        """Sums of four waves of .1 to .6 Hz."""
        angle = 2 * math.pi * ((0.1 + 0.5 * waves[0]) * t[:, None, None] + waves[1])
        return (waves[2] * angle.sin()).sum(1) / 2

    def placed(self, camera: int, t: Tensor) -> Tensor:
        """Points ``(frames, n, 3)`` metres."""
        way = self.waved(t, self.waves)
        x = self.points[camera] @ rotation(0.6 * way[:, :3]).mT + 0.3 * way[:, None, 3:]
        for k, waves in enumerate(self.strangers[camera]):
            x[:, k] = 0.3 * self.waved(t, waves)
        return x

    def film(self, camera: int, t: Tensor, noise: float) -> Tensor:
        """Tracks ``(frames, n, 2)`` px."""
        x = self.placed(camera, t)
        image = torch.cat([x, torch.ones_like(x[..., :1])], -1) @ self.cameras[camera].T
        return image[..., :2] / image[..., 2:] + noise * self._normal(*x.shape[:2], 2)


def figures(setting: str, noise: float, seed: int) -> tuple[float, float, float]:
    """Whether a shift is accepted, its error (frames), and the error of the points (NaN where there are none)."""
    n, frames, distance, foreign = SETTINGS[setting]
    take, clock = Take(seed, n, distance, foreign), torch.arange(frames, dtype=D) / FPS
    other = Take(seed + 1000, n, distance, foreign) if setting == "different motions" else take
    a, b = take.film(0, clock, noise), other.film(1, clock - OFFSET, noise)
    shift = synchronize(a, b, False, fps=FPS, camera="projective")
    error = abs(shift.offset - OFFSET) * FPS if other is take else math.inf
    if not shift.ok or other is not take:
        return float(shift.ok), error, math.nan
    found = reconstruct_pair(a, b, shift, camera="projective")
    good = found.labels > 0
    if not bool(good.any()):
        return 1.0, error, math.nan
    x = (found.points[..., :3] / found.points[..., 3:])[:, good]
    y = torch.cat([take.placed(k, found.times) for k in range(2)], 1)[:, good].flatten(0, 1)
    x = torch.cat([x, torch.ones_like(x[..., :1])], -1).flatten(0, 1)
    left = x @ torch.linalg.lstsq(x, y, driver="gelsd").solution - y
    return 1.0, error, 100 * float(left.square().mean().sqrt() / y.std())


def table(name: str, config: Config) -> list[Row]:
    """The rows of one setting."""
    rows = []
    for noise in (0.5,) if config.quick or name == "different motions" else (0.0, 0.3, 0.5, 1.0):
        found = torch.tensor([figures(name, noise, config.seed + k) for k in range(config.scenes)], dtype=D)
        ok, error, points = found.unbind(1)
        label = f"{noise:g} px"
        rows.append(Row("accepted", label, 100 * float(ok.mean()), unit=" %"))
        rows.append(Row("accepted and wrong", label, 100 * float((ok * (error > 0.5)).mean()), 0.0, at_most=True, unit=" %"))
        if name != "different motions":
            rows.append(Row("error, median", label, float(error.median()), unit=" frame"))
            rows.append(Row("points, median", label, float(points.nanmedian()), unit=" %"))
    return rows


def run(config: Config) -> None:
    """Print the table and write it."""
    measured(tuple(SETTINGS), lambda name: table(name, config), config.target(), {"scenes": config.scenes, "seed": config.seed})


if __name__ == "__main__":
    command(lambda: run(tyro.cli(Config, description=__doc__)))
