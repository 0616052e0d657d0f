"""Joints of people who move, seen by virtual sensors in space: how well A and B come out of motion that is only nearly straight."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch.geometry.homogeneous import apply
from dyntorch.geometry.rigid import rigid_alignment
from dyntorch.scenes.scene import Draw
from experiments.alignment.real.solvers import Matrices, Solver, aligned, gap, listed, median, tensor
from experiments.common.real_data import Take
from experiments.common.tables import Row, note

SPACINGS = (1, 2, 4)
"""Frames between the views, at 60 per second."""
PEOPLE = 12


@dataclass(frozen=True)
class Crowd:
    """People at three instants: ``world (3, n, 3)`` metres, three views of it, and the true A, B."""

    world: Tensor
    views: list[Tensor]
    sensors: Tensor
    motion: Matrices

    @property
    def deviation(self) -> Tensor:
        """``(n,)`` standard deviation of a joint across the line that fits its three positions best, metres."""
        centred = (self.world - self.world.mean(0)).movedim(1, 0)
        return (torch.linalg.svdvals(centred)[:, 1].square() / 2).sqrt()


def crowd(pool: list[Take], spacing: int, kind: str, draw: torch.Generator) -> Crowd:
    """Random people at random instants, each turned about the vertical and put somewhere in a room of 4 m."""
    people = []
    for _ in range(PEOPLE):
        joints = pool[int(torch.randint(len(pool), (1,), generator=draw))].joints
        start = int(torch.randint(len(joints) - 2 * spacing, (1,), generator=draw))
        three = joints[[start, start + spacing, start + 2 * spacing]]
        angle, place = (torch.rand(1, generator=draw) * 2 * torch.pi).double(), torch.rand(2, generator=draw).double() * 4 - 2
        cos, sin = angle.cos(), angle.sin()
        x, y, z = (three - three[1].mean(0) * torch.tensor([1.0, 0.0, 1.0], dtype=three.dtype)).unbind(-1)
        people.append(torch.stack([cos * x + sin * z + place[0], y - 1.0, cos * z - sin * x + place[1]], dim=-1))
    world = torch.cat(people, dim=1)
    sensors = Draw(world.shape[1], (), 0.0, 0.0, 0.0, draw, torch.float64).sensors(3, kind)
    # the first sensor is rigid in either case, so that errors in its frame are metres
    sensors[0] = Draw(1, (), 0.0, 0.0, 0.0, draw, torch.float64).sensors(1, "rigid")[0]
    motion = tuple(sensors[0] @ torch.linalg.inv(m) for m in sensors[1:])
    return Crowd(world, [apply(m, x) for m, x in zip(sensors, world, strict=True)], sensors, (motion[0], motion[1]))


def _still(views: list[Tensor], _: Matrices) -> tuple[Matrices, str]:
    a, b = (dyn.fit(dyn.Collineation(3), views[0], x).tensor for x in views[1:])
    return (a, b), "no test"


def _kabsch(views: list[Tensor], _: Matrices) -> tuple[Matrices, str]:
    return (rigid_alignment(views[0], views[1]), rigid_alignment(views[0], views[2])), "no test"


METHODS: dict[str, tuple[str, Solver]] = {
    "all still: collineations": ("projective", _still),
    "JoinTensor, linear": ("projective", tensor(dyn.JoinTensor)),
    "MinimalJoinTensor, linear": ("projective", tensor(dyn.MinimalJoinTensor)),
    "ConstantVelocityTensor, linear": ("projective", tensor(dyn.ConstantVelocityTensor)),
    'align_points("join")': ("projective", aligned("join")),
    'align_points("minimal_join")': ("projective", aligned("minimal_join")),
    'align_points("constant_velocity")': ("projective", aligned("constant_velocity")),
    "all still: rigid motions": ("rigid", _kabsch),
    'align_points("rigid")': ("rigid", aligned("rigid")),
}


def bodies_rows(pool: list[Take], crowds: int, seed: int) -> list[Row]:
    """Errors on the test takes with the spacing chosen on the training takes."""
    training, test = pool[::2], pool[1::2]
    rows: list[Row] = []
    for name, (kind, solve) in METHODS.items():
        note(f"... bodies, {name}")
        training_errors: list[float] = []
        for spacing in SPACINGS:
            draw = torch.Generator().manual_seed(seed)
            some = [crowd(training, spacing, kind, draw) for _ in range(max(1, crowds // 2))]
            training_errors.append(median([gap(solve(c.views, c.motion)[0], c.motion, c.views) for c in some]))
        best = SPACINGS[min(range(len(SPACINGS)), key=training_errors.__getitem__)]
        draw = torch.Generator().manual_seed(seed + 1)
        asked = [crowd(test, best, kind, draw) for _ in range(crowds)]
        found = [solve(c.views, c.motion) for c in asked]
        errors = [gap(motion, c.motion, c.views) for (motion, _), c in zip(found, asked, strict=True)]
        bent = 1000 * torch.cat([c.deviation for c in asked])
        gone = 1000 * torch.cat([(c.world[2] - c.world[0]).norm(dim=-1) for c in asked])
        setting = f"{kind}, {best} frames apart, joints go {gone.median():.0f} mm, off their lines by {bent.median():.2f} mm "
        setting += f"(rms {bent.square().mean().sqrt():.1f}); {listed(Counter(state for _, state in found))}; worst "
        setting += f"{1000 * max(errors):.3g} mm, median"
        rows.append(Row(name, setting, 1000 * median(errors), unit=" mm"))
    return rows
