"""Dynamic shape tensors on synthetic points: how well a single view tells the time, by form, points, noise and number of frames.

``python -m experiments.recognition.dynamic_shape`` learns every shape from single affine views at known times (random points,
velocities
and cameras; noise as a part of the RMS extent of a view) and asks new views with the same noise for their time.  Goals are the
figures of a float64 prototype with four basis points: 40 frames, constant velocity, noise 1 %.  ``counts`` finds the least
numbers of frames from ranks, beside those of the theory.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from typing import cast

import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch.invariants.dynamic_shape_tensor import DynamicShapeTensor, Form
from dyntorch.shapes.basis import Fourier, Polynomial, Trajectory, reference_plane_rows, six_point_rows
from experiments.common.runner import SceneConfig, Tables, experiment
from experiments.common.tables import Row

PROTOTYPE = {5: 0.027, 8: 0.008, 14: 0.005}
"""Points to median error of t on [-1, 1], four basis points."""
LEAST: dict[tuple[Form, int], int] = {
    ("basis", 5): 8,
    ("basis", 8): 7,
    ("basis", 14): 7,
    ("span", 5): 2,
    ("span", 8): 3,
    ("span", 11): 5,
}
VIEWS, FRAMES, NOISE = 50, 40, 0.01
TRAJECTORIES: dict[str, Trajectory] = {
    "constant velocity": Polynomial(1),
    "degree 2": Polynomial(2),
    "1 harmonic": Fourier(1),
    "2 harmonics": Fourier(2),
}


@dataclass(frozen=True)
class Views:
    """Single views ``(scenes, frames + VIEWS, n, 2)`` of moving points, and their times; the last ones are to be dated."""

    x: Tensor
    times: Tensor
    frames: int

    @property
    def seen(self) -> tuple[Tensor, ...]:
        """Point by point, for learning."""
        return self.x[:, : self.frames].unbind(-2)

    @property
    def new(self) -> tuple[Tensor, ...]:
        """Point by point, to be dated."""
        return self.x[:, self.frames :].unbind(-2)


def views(config: SceneConfig, trajectory: Trajectory, n: int, *, noise: float = NOISE, frames: int = FRAMES) -> Views:
    """Random scenes; polynomial trajectories on [-1, 1], periodic ones over the period."""
    g = torch.Generator().manual_seed(config.seed)
    total, scenes = frames + VIEWS, config.scenes
    shapes = torch.randn(scenes, trajectory.size, n, 3, generator=g, dtype=torch.float64)
    times = torch.rand(scenes, total, generator=g, dtype=torch.float64)
    times = 2 * times - 1 if trajectory.period is None else times * trajectory.period
    if trajectory.period is None:
        # the interval of the training is the whole of [-1, 1], the unit of the errors
        times[:, :2] = torch.tensor([-1.0, 1.0])
    cameras = torch.randn(scenes, total, 3, 2, generator=g, dtype=torch.float64)
    x = torch.einsum("svb,sbnk,svkd->svnd", trajectory.rows(times), shapes, cameras)
    extent = (x - x.mean(-2, keepdim=True)).square().mean((-2, -1), keepdim=True).sqrt()
    return Views(x + noise * extent * torch.randn(x.shape, generator=g, dtype=torch.float64), times, frames)


def error(data: Views, found: Tensor, period: float | None) -> float:
    """Median error of the times of the new views."""
    off = (found - data.times[:, data.frames :]).abs()
    return float(off.median() if period is None else torch.minimum(off, period - off).median())


def dated(form: Form) -> Callable[[Views, Trajectory], float]:
    """Learn by one form, date the new views, return the median error."""

    def solve(data: Views, trajectory: Trajectory) -> float:
        solution = dyn.fit(DynamicShapeTensor(trajectory, form=form), *data.seen, times=data.times[:, : data.frames])
        found = cast(DynamicShapeTensor, solution.invariant).recover(solution.tensor, *data.new)
        return error(data, found.times, trajectory.period)

    return solve


FORMS = {"four basis points": dated("basis"), "all points": dated("joint")}


def row(task: str, setting: str, value: float, goal: float | None = None) -> Row:
    """A small error, in thousandths."""
    return Row(task, setting, 1e3 * value, None if goal is None else 1e3 * goal, at_most=True, unit="e-3")


def times(config: SceneConfig) -> list[Row]:
    """Constant velocity beside the prototype, and other trajectories."""
    rows = []
    for name, trajectory in TRAJECTORIES.items():
        for n in PROTOTYPE:
            data = views(config, trajectory, n)
            goal = PROTOTYPE[n] if name == "constant velocity" else None  # set by four basis points, to be met by all points
            for form, solve in FORMS.items():
                found = solve(data, trajectory)
                rows.append(
                    row(f"{name}, {form}", f"{n} points, {FRAMES} frames, 1 %", found, goal if form == "all points" else None)
                )
    return rows


def noises(config: SceneConfig) -> list[Row]:
    """Against the noise, 14 points of constant velocity."""
    values = (0.0, 0.01, 0.05) if config.quick else (0.0, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1)
    found = [(noise, views(config, Polynomial(1), 14, noise=noise)) for noise in values]
    return [
        row(f"noise, {form}", f"{noise:.1%}", solve(data, Polynomial(1))) for noise, data in found for form, solve in FORMS.items()
    ]


def frames(config: SceneConfig) -> list[Row]:
    """Against the number of frames, 14 points of constant velocity, noise 1 %."""
    values = (10, 40) if config.quick else (7, 8, 10, 15, 20, 40, 80, 160)
    found = [(frames, views(config, Polynomial(1), 14, frames=frames)) for frames in values]
    return [row(f"frames, {form}", str(f), solve(data, Polynomial(1))) for f, data in found for form, solve in FORMS.items()]


def least(rows: Tensor, wanted: int) -> int:
    """The first number of views ``(views, r, width)`` whose rows have the rank wanted."""
    for views in count(1):
        if views > len(rows):
            raise ValueError(f"the rank {wanted} is not reached by {len(rows)} views")
        block = rows[:views].flatten(0, 1)
        # the forms of projective cameras lose most digits: 1e-8 of six points is signal
        if int(torch.linalg.matrix_rank(block / block.norm(dim=-1, keepdim=True), rtol=1e-12)) >= wanted:
            return views
    raise AssertionError


def counts(config: SceneConfig) -> list[Row]:
    """Least numbers of frames, from ranks."""
    rows = []
    for (form, n), goal in LEAST.items():
        size = (n - 2) // 3 if form == "span" else 2
        one = views(SceneConfig(scenes=1, seed=config.seed), Polynomial(size - 1), n, noise=0.0)
        kind = DynamicShapeTensor(Polynomial(size - 1), form=form)
        invariant, measured = kind.bind_arguments(one.seen, times=one.times[:, : one.frames])
        found = least(invariant.primitives[0].vectors(measured[0])[0], invariant.width() - invariant.nullity)
        rows.append(Row(f"{form}, B = {size}", f"{n} points", found, goal, at_most=True))
    g = torch.Generator().manual_seed(config.seed)
    start, velocity = torch.randn(2, 6, 3, generator=g, dtype=torch.float64)
    t = 2 * torch.rand(60, generator=g, dtype=torch.float64) - 1
    cameras = torch.randn(60, 3, 4, generator=g, dtype=torch.float64)
    rows.append(
        Row("projective, degree 9", "6 points", least(six_point_rows(_images(start, velocity, t, cameras), t)[:, None], 49), 49)
    )
    start[3], velocity[:4] = torch.tensor([0.3, 0.5, 0.2], dtype=torch.float64) @ start[:3], 0.0
    plane = reference_plane_rows(_images(start, velocity, t, cameras), t)[:, None]
    return [*rows, Row("projective, static plane", "4 + 2 points", least(plane, 8), 8, at_most=True)]


def _images(start: Tensor, velocity: Tensor, t: Tensor, cameras: Tensor) -> Tensor:
    """Views ``(v, n, 2)`` of points of constant velocity in projective cameras ``(v, 3, 4)``."""
    points = torch.nn.functional.pad(start + t[:, None, None] * velocity, (0, 1), value=1.0) @ cameras.mT
    return points[..., :2] / points[..., 2:]


@experiment(SceneConfig(scenes=60), quick={"scenes": 10})
def tables(config: SceneConfig) -> Tables:
    """Times of single views, by trajectory, noise and number of frames; and the least numbers."""
    yield "times", times(config)
    yield "noise", noises(config)
    yield "frames", frames(config)
    yield "counts", counts(config)
