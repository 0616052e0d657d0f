"""A crossroads drawn from formulas: a flat textured scene in which every car keeps its velocity, seen by a flying camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.geometry.homogeneous import apply, homogeneous, inhomogeneous
from dyntorch.scenes.scene import looking_at

WIDTH, HEIGHT, FOCAL = 320, 240, 330.0  # pixels
SAMPLES = 2  # per pixel and axis: what a lens does against aliasing
ROAD, WALK = 6.0, 8.2  # metres from the middle of a road to its edge, and to the end of the pavement
GLASS = (0.13, 0.17, 0.22)
TREES = (
    (-13, 12, 2.6), (-19, 17, 3.1), (-12, 20, 2.2), (14, 13, 3.0), (21, 11, 2.3), (16, 21, 2.7), (-15, -13, 2.9), (-22, -12, 2.4),
    (-12, -20, 2.5), (12, -14, 2.3), (19, -20, 3.2), (27, -13, 2.6), (-27, 12, 2.5), (28, 18, 2.9), (-28, -20, 3.0),
)  # fmt: skip
"""x, y and radius of their crowns, metres."""


@dataclass(frozen=True)
class Car:
    """A moving patch of the plane.

    Attributes:
        middle: where its middle is at time 0, metres.
        velocity: metres per unit of time; it points where the car does.
        colour: of its paint.
        size: length and width, metres.
    """

    middle: tuple[float, float]
    velocity: tuple[float, float]
    colour: tuple[float, float, float]
    size: tuple[float, float] = (5.0, 2.3)

    @property
    def heading(self) -> tuple[float, float]:
        """Unit vector along the car."""
        speed = math.hypot(*self.velocity)
        return self.velocity[0] / speed, self.velocity[1] / speed

    def corners(self, time: float) -> Tensor:
        """``(4, 2)`` at a time, in order around the car."""
        (cos, sin), (length, width) = self.heading, self.size
        turn = torch.tensor([[cos, -sin], [sin, cos]], dtype=torch.float64)
        box = torch.tensor([[1, 1], [1, -1], [-1, -1], [-1, 1]], dtype=torch.float64) * torch.tensor([length / 2, width / 2])
        return box @ turn.mT + self.place(time)

    def place(self, time: float) -> Tensor:
        """``(2,)`` its middle at a time."""
        start, way = (torch.tensor(v, dtype=torch.float64) for v in (self.middle, self.velocity))
        return start + time * way

    def paint(self, plane: Tensor, time: float) -> tuple[Tensor, Tensor]:
        """Colours ``(..., 3)`` at points ``(..., 2)`` of the plane, and where the car covers them."""
        (cos, sin), (length, width) = self.heading, self.size
        away = plane - self.place(time)
        along, across = away[..., 0] * cos + away[..., 1] * sin, away[..., 1] * cos - away[..., 0] * sin
        inside = (along.abs() < length / 2) & (across.abs() < width / 2)
        colour = torch.tensor(self.colour, dtype=torch.float64) * (1.06 - 0.16 * (2 * across / width).square())[..., None]
        panes = ((along - 0.13 * length).abs() < 0.07 * length) | ((along + 0.3 * length).abs() < 0.06 * length)
        pane = (across.abs() < 0.42 * width) & panes
        lamp = (along > 0.44 * length) & (across.abs() > 0.26 * width)
        brake = (along < -0.46 * length) & (across.abs() > 0.24 * width)
        for where, value in ((pane, GLASS), (lamp, (1.0, 0.97, 0.8)), (brake, (0.75, 0.08, 0.08))):
            colour = torch.where(where[..., None], torch.tensor(value, dtype=torch.float64), colour)
        return colour, inside


CARS = (
    Car((-17.0, -1.6), (5.5, 0.0), (0.84, 0.16, 0.13)),
    Car((-9.0, -4.4), (4.4, 0.0), (0.95, 0.95, 0.93), (7.4, 2.6)),
    Car((13.0, 1.6), (-5.0, 0.0), (0.13, 0.38, 0.78)),
    Car((21.0, 4.3), (-6.5, 0.0), (0.97, 0.74, 0.12)),
    Car((1.6, -18.5), (0.0, 2.3), (0.20, 0.62, 0.42)),
    Car((4.3, 9.5), (0.0, 3.4), (0.93, 0.48, 0.12)),
    Car((-1.6, -7.5), (0.0, -2.4), (0.52, 0.24, 0.62)),
    Car((-4.4, 22.5), (0.0, -2.4), (0.16, 0.70, 0.78)),
)


def noise(plane: Tensor, cell: float, seed: int) -> Tensor:
    """``(...)`` smooth random values from -1 to 1 over points ``(..., 2)``, that change from cell to cell of a lattice."""
    lattice = torch.rand(64, 64, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 2 - 1
    place = plane / cell
    low = place.floor()
    share = (place - low).square() * (3 - 2 * (place - low))
    i, j = (low.long() % 64).unbind(-1)
    k, m = (i + 1) % 64, (j + 1) % 64
    first = torch.lerp(lattice[i, j], lattice[k, j], share[..., 0])
    return torch.lerp(first, torch.lerp(lattice[i, m], lattice[k, m], share[..., 0]), share[..., 1])


def ground(plane: Tensor) -> Tensor:
    """Colours ``(..., 3)`` of the ground at points ``(..., 2)``: lawns, trees, pavements, and two roads with their marks."""
    x, y = plane.unbind(-1)
    near, far = torch.minimum(x.abs(), y.abs()), torch.maximum(x.abs(), y.abs())  # from the road, and from the crossing
    along = torch.where(x.abs() < y.abs(), y, x)
    grain = noise(plane, 0.6, 1)

    def laid(under: Tensor, where: Tensor, colour: Sequence[float], rough: float = 0.0) -> Tensor:
        over = torch.tensor(colour, dtype=torch.float64) + rough * grain[..., None]
        return torch.where(where[..., None], over, under)

    lawn = torch.tensor((0.50, 0.63, 0.36), dtype=torch.float64) + 0.06 * noise(plane, 3.1, 2)[..., None] + 0.015 * grain[..., None]
    out = lawn
    for left, bottom, radius in TREES:
        away = (plane - torch.tensor((left, bottom), dtype=torch.float64)).norm(dim=-1) + 0.35 * noise(plane, 1.1, 3)
        out = laid(out, away < radius, (0.22, 0.42, 0.24), 0.03)
        out = laid(out, away < 0.55 * radius, (0.30, 0.51, 0.29), 0.03)
    out = laid(out, near < WALK, (0.80, 0.77, 0.71), 0.015)
    out = laid(out, (near < WALK) & (near > ROAD) & ((along % 2.2) < 0.18), (0.70, 0.67, 0.62))
    out = laid(out, near < ROAD, (0.43, 0.45, 0.48), 0.012)
    out = laid(out, (near < 0.16) & (far > 12.2), (0.95, 0.82, 0.35))
    out = laid(out, ((near - 3.0).abs() < 0.13) & (far > 12.2) & ((along % 4.0) < 2.2), (0.93, 0.93, 0.91))
    crossing = (near < ROAD - 0.4) & (far > WALK) & (far < WALK + 2.8) & ((torch.where(x.abs() < y.abs(), x, y) % 1.5) < 0.8)
    return laid(out, crossing, (0.93, 0.93, 0.91))


def camera(position: Sequence[float], target: Sequence[float] = (0.0, 0.0)) -> Tensor:
    """``(3, 3)`` from the plane, in metres, to pixels, for a camera above it that looks at a point of it."""
    K = torch.tensor([[FOCAL, 0.0, (WIDTH - 1) / 2], [0.0, FOCAL, (HEIGHT - 1) / 2], [0.0, 0.0, 1.0]], dtype=torch.float64)
    centre, aim = torch.tensor(position, dtype=torch.float64), torch.tensor((*target, 0.0), dtype=torch.float64)
    return (K @ looking_at(centre, aim, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)))[:, [0, 1, 3]]


def render(view: Tensor, time: float) -> Tensor:
    """The image ``(3, HEIGHT, WIDTH)`` that a camera takes at a time, values from 0 to 1; the middle of a pixel is whole."""
    inside = (torch.arange(SAMPLES, dtype=torch.float64) + 0.5) / SAMPLES - 0.5
    u, v = ((torch.arange(size, dtype=torch.float64)[:, None] + inside).flatten() for size in (WIDTH, HEIGHT))
    pixels = torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1)
    plane = apply(torch.linalg.inv(view), pixels)
    out = ground(plane)
    for car in CARS:
        colour, covered = car.paint(plane, time)
        out = torch.where(covered[..., None], colour, out)
    return out.clamp(0, 1).reshape(HEIGHT, SAMPLES, WIDTH, SAMPLES, 3).mean(dim=(1, 3)).permute(2, 0, 1)


def observe(views: Tensor, times: Sequence[float], still: Tensor, sigma: float, generator: torch.Generator) -> Tensor:
    """Tracks ``(views, 4 cars + n, 2)`` of the cars' corners and of points ``(n, 2)`` at rest; NaN where they are not seen."""
    seen = []
    for view, time in zip(views, times, strict=True):
        plane = torch.cat([*(car.corners(time) for car in CARS), still])
        pixels = inhomogeneous(homogeneous(plane) @ view.mT)
        pixels = pixels + sigma * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
        size = torch.tensor([WIDTH - 1.0, HEIGHT - 1.0], dtype=torch.float64)
        hidden = torch.zeros(len(plane), dtype=torch.bool)
        for car in CARS:
            hidden[4 * len(CARS) :] |= car.paint(still, time)[1]
        lost = hidden | ((pixels < 0) | (pixels > size)).any(-1)
        seen.append(torch.where(lost[:, None], torch.nan, pixels))
    return torch.stack(seen)
