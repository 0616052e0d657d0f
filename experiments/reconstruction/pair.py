"""Reconstruction of a moving person from two static cameras that track different points.

``python -m experiments.reconstruction.pair`` prints, of CMU motion capture (120 frames at 30 fps, parts in which the joints move
by 100 to 200 mm rms):

- affine: two orthographic cameras; a tracks 16 joints, b the middles of 15 bones, which are exact combinations of a's joints.
  The rms error of b's motions transferred to a (mm), the same up to the scale between the cameras, which is estimated as well,
  that of a ridge regression that is told the true directions, the scale and the noise, and the error of the directions (degrees,
  of both together).  The prototype of the method, told the scale, had 6, 14 and 20 mm, .4, 1.1 and 4.6 degrees at 1, 3 and 10 mm
  of noise;
- perspective: cameras from 4.5 m, 14 joints in each, none seen by both, 31 to choose from: not affine, and not combinations of one
  another.  The share of b's points that is called transferable, their error (mm at the person), their rms motion, and the
  share of the motion of all points that is explained; and corresponding joints by their fundamental matrix: the share found.
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
from experiments.common.real_data import takes
from experiments.common.tables import NoiseConfig, Row, command, measured
from experiments.synchronization.data import DIFFERENT, SAME, Filming, image, seeded

FRAMES, STEP, FPS = 120, 2, 30.0
MOTION = (0.1, 0.2)
"""Metres rms of the parts that are taken."""
JOINTS = (0, 3, 13, 18, 4, 5, 6, 8, 9, 10, 19, 20, 22, 25, 26, 28)
BONES = (
    (0, 3),
    (3, 13),
    (13, 18),
    (0, 4),
    (4, 5),
    (5, 6),
    (0, 8),
    (8, 9),
    (9, 10),
    (13, 19),
    (19, 20),
    (20, 22),
    (13, 25),
    (25, 26),
    (26, 28),
)
"""Ends of the bones, of the joints recorded."""
GOALS = {1.0: 5.0}
APART = 20.0
"""Degrees, at least, between the viewing directions."""
TABLES = ("affine", "perspective")


@dataclass(frozen=True)
class Config(NoiseConfig):
    """Settings of the tables."""

    scenes: int = 24
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")] = Path("results/pair_reconstruction.json")


def parts() -> list[Tensor]:
    """``(FRAMES, 31, 3)`` metres, of all takes."""
    found = []
    for take in takes():
        joints = take.joints[::STEP]
        for start in range(0, len(joints) - FRAMES, FRAMES // 2):
            part = joints[start : start + FRAMES]
            if MOTION[0] < rms(part) < MOTION[1]:
                found.append(part)
    return found


def rms(tracks: Tensor) -> float:
    """Of the points ``(T, n, d)`` about their mean places."""
    return float((tracks - tracks.mean(0)).square().sum(-1).mean().sqrt())


def orthographic(generator: torch.Generator) -> Tensor:
    """``(2, 3)`` of a random camera, x to the right and y down, up to 30 degrees above the horizon."""
    azimuth, elevation = torch.rand(2, generator=generator, dtype=torch.float64).tolist()
    azimuth, elevation = 2 * math.pi * azimuth, 0.6 * elevation - 0.1
    view = torch.tensor(
        [math.cos(azimuth) * math.cos(elevation), math.sin(elevation), math.sin(azimuth) * math.cos(elevation)], dtype=torch.float64
    )
    right = torch.nn.functional.normalize(torch.linalg.cross(view, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)), dim=0)
    return torch.stack([right, torch.linalg.cross(view, right)])


def cameras(generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Two orthographic cameras that look from different directions."""
    while True:
        first, second = orthographic(generator), orthographic(generator)
        views = torch.linalg.cross(first[0], first[1]), torch.linalg.cross(second[0], second[1])
        if abs(float(views[0] @ views[1])) < math.cos(math.radians(APART)):
            return first, second


def affine(part: Tensor, sigma: float, seed: int) -> dict[str, float]:
    """Figures of one scene; noise in mm."""
    draw = seeded(seed)
    first, second = cameras(draw)
    joints = 1e3 * part[:, list(JOINTS)]
    middles = torch.stack([500 * (part[:, i] + part[:, j]) for i, j in BONES], dim=1)
    truth = middles @ first.T
    a = joints @ first.T
    b = middles @ second.T
    a, b = (x + sigma * torch.randn(x.shape, generator=draw, dtype=torch.float64) for x in (a, b))
    found = reconstruct_pair(a, b, 0.0, fps=FPS)
    seen = found.images()[0, :, len(JOINTS) :]
    common = torch.nn.functional.normalize(torch.linalg.cross(*(torch.linalg.cross(c[0], c[1]) for c in (first, second))), dim=0)
    normals = [c @ common for c in (first, second)]
    kept = found.labels[len(JOINTS) :] > 0
    angles = [(normal / normal.norm() @ one).abs().clamp(max=1).acos() for normal, one in zip(normals, found.normals, strict=True)]
    true, moved = (x[:, kept] - x[:, kept].mean(0) for x in (truth, seen))
    scaled = moved * (moved * true).sum() / moved.square().sum()
    told = _told(a, b, normals, sigma)
    return {
        "transfer": rms(moved - true),
        "transfer up to scale": rms(scaled - true),
        "told": rms(told - truth),
        "direction": math.degrees(float(torch.stack(angles).norm())),
        "kept": 100 * float(kept.double().mean()),
    }


def _told(a: Tensor, b: Tensor, normals: list[Tensor], sigma: float) -> Tensor:
    """The motions of b in a, by ridge regression along the true directions."""
    x, y = a - a.mean(0), b - b.mean(0)
    u, v = x @ normals[0], y @ normals[1]
    ridge = len(a) * max(sigma, 1e-3) ** 2 * torch.eye(u.shape[1], dtype=u.dtype)
    return torch.einsum("tid,ij->tjd", x, torch.linalg.solve(u.T @ u + ridge, u.T @ v))


def perspective(part: Tensor, sigma: float, seed: int) -> dict[str, float]:
    """Figures of one scene before perspective cameras; noise in mm."""
    draw = seeded(seed)
    around = part.reshape(-1, 3)
    views, exact, sizes = [], [], []
    for _ in range(2):
        state = draw.get_state()
        exact.append(image(part, around, Filming(noise_mm=0.0), draw)[0])
        draw.set_state(state)
        view, _ = image(part, around, Filming(noise_mm=sigma), draw)
        views.append(view)
        again = seeded(0)
        again.set_state(state)
        sizes.append(image(part, around, Filming(noise_mm=1.0), again)[1])
    chosen = torch.randperm(part.shape[1], generator=draw)[: 2 * DIFFERENT]
    first, second = chosen[:DIFFERENT], chosen[DIFFERENT:]
    found = reconstruct_pair(views[0][:, first], views[1][:, second], 0.0, fps=FPS)
    truth = exact[0][:, second] / sizes[0]
    seen = found.images()[0, :, DIFFERENT:] / sizes[0]
    kept = found.labels[DIFFERENT:] > 0
    same = reconstruct_pair(views[0][:, SAME], views[1][:, SAME], 0.0, True, fps=FPS, generator=draw)
    missed = torch.where(kept, (seen - seen.mean(0) - truth + truth.mean(0)).square().sum(-1).mean(0), torch.nan)
    moved = (truth - truth.mean(0)).square().sum(-1).mean(0)
    explained = torch.where(kept, 1 - missed / moved, 0.0).clamp(min=0)
    return {
        "transferable": 100 * float(kept.double().mean()),
        "error": float(missed.nanmean().sqrt()),
        "motion": float(moved[kept].mean().sqrt()),
        "explained": 100 * float(explained.median()),
        "corresponding": 100 * float((same.labels > 0).double().mean()),
    }


def table(name: str, config: Config) -> list[Row]:
    """The rows of one table."""
    pool = parts()
    order = torch.randperm(len(pool), generator=seeded(config.seed)).tolist()
    rows = []
    levels = (1.0,) if config.quick else (0.0, 1.0, 3.0, 10.0) if name == "affine" else (0.0, 3.0, 15.0)
    for sigma in levels:
        figure = affine if name == "affine" else perspective
        scenes = [figure(pool[order[k % len(pool)]], sigma, 1 + config.seed + k) for k in range(config.scenes)]
        for what in scenes[0]:
            values = torch.tensor([scene[what] for scene in scenes], dtype=torch.float64)
            setting = f"{sigma:g} mm"
            goal = GOALS.get(sigma) if what == "transfer" else None
            rows.append(Row(f"{what}, mean", setting, float(values.nanmean()), goal, at_most=True, unit=UNITS[what]))
            rows.append(Row(f"{what}, median", setting, float(values.nanmedian()), goal, at_most=True, unit=UNITS[what]))
    return rows


UNITS = {
    "transfer": " mm",
    "transfer up to scale": " mm",
    "told": " mm",
    "direction": " deg",
    "kept": " %",
    "transferable": " %",
    "error": " mm",
    "motion": " mm",
    "explained": " %",
    "corresponding": " %",
}


def run(config: Config) -> None:
    """Print the tables and write them."""
    measured(TABLES, lambda name: table(name, config), config.target(), {"scenes": config.scenes, "seed": config.seed})


if __name__ == "__main__":
    command(lambda: run(tyro.cli(Config, description=__doc__)))
