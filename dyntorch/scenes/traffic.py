"""What stands and drives in a street: boxes on a road, paths of cars, houses in rows, and what a ray meets first."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

Kind = Literal["slower", "faster", "equal", "oncoming", "crossing", "turning", "stopping"]
"""What a car does: ahead of the camera, slower, faster or about as fast; towards it; across or around the corner at the junction;
or it drives for a part of the clip only, before or after it stands."""

CAR, BUS = (4.0, 1.5, 1.7), (11.0, 3.0, 2.5)
"""Length, height and width, metres."""
ROAD = 1.65
"""Metres below the origin: y points down."""
LANE = 3.3
"""Metres from the middle of a lane to that of the next; the camera drives at x = 0, oncoming traffic on the left."""
FARTHEST = 60.0
"""Metres to which the road has something to track."""
TRIES = 20
"""Paths that are drawn for a car until it meets nobody."""


class Chance:
    """Random numbers of one generator, float64."""

    def __init__(self, generator: torch.Generator | None) -> None:
        self.generator = generator

    def uniform(self, *shape: int) -> Tensor:
        """In [0, 1)."""
        return torch.rand(*shape, generator=self.generator, dtype=torch.float64)

    def normal(self, *shape: int) -> Tensor:
        """Of variance 1."""
        return torch.randn(*shape, generator=self.generator, dtype=torch.float64)

    def between(self, low: float, high: float) -> float:
        """One number."""
        return low + (high - low) * float(self.uniform(1))

    def sign(self) -> float:
        """-1 or 1."""
        return 1.0 if float(self.uniform(1)) < 0.5 else -1.0

    def whether(self, share: float) -> bool:
        """With this probability."""
        return float(self.uniform(1)) < share


def rotations(heading: Tensor) -> Tensor:
    """``(*batch, 3, 3)``, columns right, down and forward of what looks along ``heading (*batch)`` radians, 0 = z."""
    sin, cos, zero, one = heading.sin(), heading.cos(), torch.zeros_like(heading), torch.ones_like(heading)
    return torch.stack([cos, zero, sin, zero, one, zero, -sin, zero, cos], dim=-1).unflatten(-1, (3, 3))


@dataclass(frozen=True)
class Drive:
    """A car on its way."""

    kind: Kind  # what it does
    place: Tensor  # ``(frames, 3)`` metres, the middle of its floor
    heading: Tensor  # ``(frames,)`` radians, 0 = z, to the right positive
    size: tuple[float, float, float] = CAR  # length, height, width, metres

    def motion(self) -> Tensor:
        """``(frames, 3, 4)`` from frame 0 to every frame."""
        turn = rotations(self.heading)
        turn = turn @ turn[0].mT
        return torch.cat([turn, (self.place - (turn @ self.place[0, :, None])[..., 0])[..., None]], dim=-1)

    def corners(self) -> Tensor:
        """``(frames, 8, 3)``."""
        length, height, width = self.size
        signs = torch.cartesian_prod(*(torch.tensor([-0.5, 0.5], dtype=torch.float64),) * 3)
        ends = (signs - signs.new_tensor([0.0, 0.5, 0.0])) * signs.new_tensor([width, height, length])
        return self.place[:, None] + ends @ rotations(self.heading).mT


def driven(
    speed: Tensor, heading: Tensor, kind: Kind, size: tuple[float, float, float], at: tuple[float, float], frame: int
) -> Drive:
    """The path with speeds ``(frames,)`` metres per frame and headings that is ``at`` (x, z) in a frame."""
    step = speed[:, None] * torch.stack([heading.sin(), torch.zeros_like(heading), heading.cos()], dim=-1)
    place = torch.nn.functional.pad(step[:-1].cumsum(0), (0, 0, 1, 0))
    return Drive(kind, place - place[frame] + place.new_tensor([at[0], ROAD, at[1]]), heading, size)


def drives(count: int, own: Drive, junction: float, traffic: Sequence[Kind], buses: float, chance: Chance) -> list[Drive] | None:
    """Cars that meet neither one another nor the camera's, or nothing where that was not found."""
    found: list[Drive] = []
    for _ in range(count):
        for _ in range(TRIES):
            car = _drive(own, junction, traffic[int(float(chance.uniform(1)) * len(traffic))], chance.whether(buses), chance)
            if not any(_meet(car, other) for other in (own, *found)):
                found.append(car)
                break
        else:
            return None
    return found


def _drive(own: Drive, junction: float, kind: Kind, bus: bool, chance: Chance) -> Drive:
    frames = len(own.place)
    half = frames // 2
    ramp = torch.linspace(-1, 1, frames, dtype=torch.float64)
    pace = 1 + ramp * chance.between(-0.2, 0.2)
    mine = float(own.place.diff(dim=0).norm(dim=-1).mean())
    x0, z0 = float(own.place[half, 0]), float(own.place[half, 2])
    size = BUS if bus else CAR
    if kind in ("slower", "faster", "equal"):
        # a camera that stands is passed by others
        low, high = {"slower": (0.4, 0.8), "faster": (1.2, 1.7), "equal": (0.93, 1.07)}[kind]
        speed = mine * chance.between(low, high) if mine > 0.2 else chance.between(0.3, 1.0)
        lane = x0 + LANE * (chance.sign() if chance.whether(0.5) else 0.0) + chance.between(-0.3, 0.3)
        ahead, heading = chance.between(7.0, 26.0) + size[0] / 2, chance.between(-0.02, 0.02)
        return driven(speed * pace, heading + 0 * ramp, kind, size, (lane, z0 + ahead), half)
    if kind == "stopping":
        # from driving to standing, or back, within half a second
        going = (chance.sign() * (frames * chance.between(0.35, 0.65) - torch.arange(frames, dtype=torch.float64)) / 5 + 0.5).clamp(
            0, 1
        )
        at = (x0 + LANE * chance.sign(), z0 + chance.between(8.0, 22.0))
        return driven(chance.between(0.4, 0.9) * going, 0 * ramp + math.pi * (at[0] < x0), kind, size, at, half)
    if kind == "oncoming":
        at = (-LANE + chance.between(-1.0, 0.4), z0 + chance.between(8.0, 30.0))
        return driven(chance.between(0.4, 1.2) * pace, math.pi + 0 * ramp, kind, size, at, half)
    if kind == "crossing":
        heading = chance.sign() * math.pi / 2 + chance.between(-0.2, 0.2)
        at = (x0 + chance.between(-4.0, 4.0), junction + chance.between(-4.0, 4.0))
        return driven(chance.between(0.3, 0.9) * pace, heading + 0 * ramp, kind, size, at, half)
    turn = chance.sign() * chance.between(0.03, 0.09)
    begin = math.pi / 2 * int(chance.between(0.0, 4.0)) + turn * frames / 2 * chance.between(0.0, 0.5)
    # a car that has turned by a quarter goes on straight
    way = begin + (turn * half * ramp).clamp(-math.pi / 4, math.pi / 4)
    at = (x0 + chance.between(-5.0, 5.0), junction + chance.between(-4.0, 4.0))
    return driven(chance.between(0.25, 0.6) * pace, way, kind, size, at, half)


def _meet(a: Drive, b: Drive) -> bool:
    """Whether two cars come too near."""
    away = a.place - b.place
    reach = (a.size[0] + b.size[0]) / 2 + 0.7
    beside = (a.size[2] + b.size[2]) / 2 + 0.5
    for car in (a, b):
        local = (rotations(car.heading).mT @ away[..., None])[..., 0].abs()
        # cars that go askew take the room of their length
        askew = (a.heading - b.heading).sin().abs() > 0.3
        if bool(((local[:, 2] < reach) & (local[:, 0] < torch.where(askew, reach, beside))).any()):
            return True
    return False


@dataclass(frozen=True)
class Boxes:
    """What rays meet, besides the road."""

    place: Tensor  # ``(frames, b, 3)`` metres, the middle of the lower side
    heading: Tensor  # ``(frames, b)`` radians
    size: Tensor  # ``(b, 3)`` width, height, length, metres
    relief: Tensor  # ``(b,)`` metres that points lie behind the sides, at most
    body: Tensor  # ``(b,)`` 0 what stands, 1.. the cars

    def with_cars(self, cars: Sequence[Drive]) -> Boxes:
        """With cars that drive."""
        if not cars:
            return self
        return Boxes(
            torch.cat([self.place, torch.stack([car.place for car in cars], 1)], 1),
            torch.cat([self.heading, torch.stack([car.heading for car in cars], 1)], 1),
            torch.cat([self.size, self.size.new_tensor([[car.size[2], car.size[1], car.size[0]] for car in cars])]),
            torch.cat([self.relief, self.relief.new_tensor([0.2] * len(cars))]),
            torch.cat([self.body, torch.arange(1, len(cars) + 1)]),
        )

    def local(self, frame: Tensor, box: Tensor, points: Tensor) -> Tensor:
        """``(m, 3)`` of points of the world in frames ``(m,)``, in the coordinates of their boxes."""
        turn = rotations(self.heading[frame, box])
        return (turn.mT @ (points - self.place[frame, box])[..., None])[..., 0]

    def world(self, frame: int, box: Tensor, local: Tensor) -> Tensor:
        """``(m, 3)`` back, in one frame."""
        return (rotations(self.heading[frame, box]) @ local[..., None])[..., 0] + self.place[frame, box]

    def first_hit(self, frame: Tensor, origin: Tensor, ray: Tensor, ground: int, nothing: int) -> tuple[Tensor, Tensor]:
        """How many times itself a ray ``(m, 3)`` goes to what it meets first, and the box, or ``ground`` or ``nothing``."""
        sin, cos = self.heading[frame].sin(), self.heading[frame].cos()
        away = (origin[:, None] - self.place[frame]).unbind(-1)
        # the three coordinates of the box, of a point and of a direction; written out: this is where the time goes
        start = (cos * away[0] - sin * away[2], away[1], sin * away[0] + cos * away[2])
        way = (cos * ray[:, :1] - sin * ray[:, 2:], ray[:, 1:2].expand_as(sin), sin * ray[:, :1] + cos * ray[:, 2:])
        width, height, length = self.size.unbind(-1)
        enter, leave = torch.full_like(sin, -torch.inf), torch.full_like(sin, torch.inf)
        for x, dx, low, high in zip(
            start, way, (-width / 2, -height, -length / 2), (width / 2, 0 * height, length / 2), strict=True
        ):
            step = 1 / torch.where(dx.abs() < 1e-12, 1e-12, dx)
            one, two = (low - x) * step, (high - x) * step
            enter, leave = torch.maximum(enter, torch.minimum(one, two)), torch.minimum(leave, torch.maximum(one, two))
        depth = torch.where((enter < leave) & (enter > 0), enter, torch.inf)
        best, box = depth.min(1) if depth.shape[1] else (torch.full_like(ray[:, 0], torch.inf), torch.zeros_like(frame))
        down = torch.where(ray[:, 1] > 1e-9, (ROAD - origin[:, 1]) / ray[:, 1].clamp(min=1e-9), torch.inf)
        down = torch.where(down * ray.norm(dim=-1) < FARTHEST, down, torch.inf)
        box = torch.where(down < best, ground, torch.where(best.isinf(), nothing, box))
        return torch.minimum(best, down), box


def street_walls(own: Drive, cars: Sequence[Drive], junction: float, chance: Chance) -> Boxes:
    """Houses, parked cars, poles and trees along a street and one that crosses it; nothing where somebody drives."""
    frames = len(own.place)
    far = float(own.place[:, 2].max()) + 90.0
    rows: list[list[float]] = []
    for side in (-1.0, 1.0):
        away = chance.between(7.5, 11.0)
        rows += _row(side * away, side, (-25.0, junction - 8), False, chance)
        rows += _row(side * away, side, (junction + 8, far), False, chance)
        for end in (-1.0, 1.0):
            along = (away + 12, 70.0) if side > 0 else (-70.0, -away - 12)
            rows += _row(junction + end * 8.0, end, along, True, chance)
    table = torch.tensor(rows, dtype=torch.float64)
    stand = torch.zeros(len(table), dtype=torch.int64)
    walls = Boxes(table[:, :3].expand(frames, -1, 3), table[:, 3].expand(frames, -1), table[:, 4:7], table[:, 7], stand)
    near = torch.zeros(len(table), dtype=torch.bool)
    for car in (own, *cars):
        way = torch.cat([car.place[:, None], car.corners()], 1).flatten(0, 1)
        local = (rotations(walls.heading[0]).mT @ (way[:, None] - walls.place[0])[..., None])[..., 0]
        near |= ((local[..., [0, 2]].abs() - walls.size[:, [0, 2]] / 2).amax(-1) < 0.8).any(0)
    kept = ~near
    return Boxes(walls.place[:, kept], walls.heading[:, kept], walls.size[kept], walls.relief[kept], walls.body[kept])


def _row(line: float, outward: float, span: tuple[float, float], across: bool, chance: Chance) -> list[list[float]]:
    """Houses from ``line`` outwards and what stands before them: x, y, z, heading, width, height, length, relief of each."""
    rows: list[list[float]] = []

    def add_box(away: float, along: float, size: tuple[float, float, float], relief: float, lift: float = 0.0) -> None:
        place = line + outward * away
        x, z = (along, place) if across else (place, along)
        rows.append([x, ROAD - lift, z, math.pi / 2 if across else 0.0, *size, relief])

    along = span[0]
    while along < span[1]:
        length = min(chance.between(6.0, 16.0), span[1] - along)
        if length > 2.0 and chance.whether(0.9):
            add_box(5.0 + chance.between(0.0, 1.5), along + length / 2, (10.0, chance.between(4.0, 13.0), length), 0.3)
        along += length + (chance.between(1.0, 5.0) if chance.whether(0.3) else 0.0)
    length, height, width = CAR
    for kind, apart in (("car", 7.0), ("pole", 14.0), ("tree", 16.0), ("bush", 8.0)):
        along = span[0] + apart * chance.between(0.0, 1.0)
        while along < span[1]:
            if kind == "car" and chance.whether(0.5):
                add_box(-2.3, along, (width, height, length), 0.2)
            elif kind == "pole":
                add_box(-0.9, along, (0.25, chance.between(3.0, 7.0), 0.25), 0.1)
            elif kind == "tree" and chance.whether(0.5):
                add_box(-0.8, along, (0.4, 2.5, 0.4), 0.1)
                add_box(-0.8, along, (3.0, 3.0, 3.0), 1.5, 2.5)
            elif kind == "bush" and chance.whether(0.4):
                add_box(-0.5, along, (1.0, chance.between(0.5, 1.5), chance.between(1.0, 3.0)), 0.5)
            along += apart * chance.between(0.8, 1.4)
    return rows
