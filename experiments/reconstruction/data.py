"""Moving points for reconstructions: pairs of tracked bodies, people and traffic in the world, and virtual cameras to see them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch import metrics
from dyntorch.geometry.bundle import bundle_adjust
from dyntorch.geometry.homogeneous import homogeneous, inhomogeneous
from dyntorch.geometry.lift import balance_lifts
from dyntorch.geometry.triangulation import reproject, resect
from dyntorch.scenes.scene import calibration, looking_at
from dyntorch.tasks.reconstruct.motions import as_motion
from dyntorch.tasks.reconstruct.reconstruct import normalize_tracks
from dyntorch.tasks.reconstruct.result import Reconstruction
from experiments.common.real_data import Take, Traffic, rotation
from experiments.recognition.protocol import data_folder

FOCAL, CENTRE = 1300.0, 500.0
CORNERS = torch.tensor([[i, j, k] for i in (-0.5, 0.5) for j in (-0.5, 0.5) for k in (-0.5, 0.5)], dtype=torch.float64)


@dataclass(frozen=True)
class World:
    """Points in the world at some times, z up: ``places (views, n, 3)`` metres, ``times (views,)`` seconds, and which of them
    ``(n,)`` move."""

    places: Tensor
    times: Tensor
    moving: Tensor

    @property
    def straight(self) -> tuple[Tensor, Tensor]:
        """Positions at time 0 and velocities ``(n, 3)`` that fit the places best."""
        rows = torch.stack([torch.ones_like(self.times), self.times], dim=-1)
        start, speed = (torch.linalg.pinv(rows) @ self.places.flatten(1)).unflatten(-1, (-1, 3))
        return start, speed

    @property
    def radius(self) -> float:
        """Rms distance from the centre, metres."""
        return float((self.places - self.places.mean((0, 1))).square().sum(-1).mean().sqrt())

    def bent(self, share: float) -> World:
        """This share of the points' way off their straight lines: 0 none of it, 1 as it was."""
        start, speed = self.straight
        line = start + self.times[:, None, None] * speed
        return World(line + share * (self.places - line), self.times, self.moving)

    @property
    def deviation(self) -> Tensor:
        """``(views, n)`` distances from the straight lines, metres."""
        return (self.places - self.bent(0.0).places).norm(dim=-1)

    def turned(self) -> World:
        """Turned about the vertical until the first axis is the main horizontal direction of motion."""
        speed = self.straight[1].clone()
        speed[:, 2] = 0.0
        axes = torch.linalg.svd(speed, full_matrices=False).Vh
        across = torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0], dtype=axes.dtype), axes[0])
        turn = torch.stack([axes[0], across, torch.tensor([0.0, 0.0, 1.0], dtype=axes.dtype)])
        return World(self.places @ turn.mT, self.times, self.moving)

    def structure(self, motion: str) -> Tensor:
        """True lifted points ``(n, K)`` of a model of space, by least squares; a common direction is the first axis."""
        if as_motion(motion).static:
            return homogeneous(self.places.mean(0))
        start, speed = self.straight
        return torch.cat([homogeneous(start), speed[:, : as_motion(motion).k - 3]], dim=-1)

    def only(self, views: Sequence[int]) -> World:
        """Some of the times."""
        return World(self.places[list(views)], self.times[list(views)], self.moving)


# ---- recordings --------------------------------------------------------------------------------------------------------
def pairs() -> list[Traffic]:
    """The Hopkins155 sequences of two bodies, bodies 1 and 2."""
    found = []
    with np.load(data_folder() / "hopkins155.npz") as file:
        for name in map(str, file["names"]):
            bodies, group = np.unique(file[f"{name}/s"], return_inverse=True)
            if len(bodies) == 2:
                found.append(Traffic(name, torch.from_numpy(file[f"{name}/y"].astype(float)), torch.from_numpy(group + 1)))
    return found


def crowd(pool: list[Take], spacing: int, views: int, draw: torch.Generator, people: int = 12, room: float = 2.0) -> World:
    """Joints of random people at random instants, each turned about the vertical and put somewhere in a room (metres)."""
    found = []
    for _ in range(people):
        joints = pool[int(torch.randint(len(pool), (1,), generator=draw))].joints
        start = int(torch.randint(len(joints) - spacing * (views - 1), (1,), generator=draw))
        angle, place = torch.rand(1, generator=draw).double() * 2 * torch.pi, (torch.rand(2, generator=draw).double() - 0.5) * room
        x, height, z = joints[start : start + spacing * (views - 1) + 1 : spacing].unbind(-1)
        x, z = x - x[0].mean(), z - z[0].mean()
        cos, sin = angle.cos(), angle.sin()
        found.append(torch.stack([cos * x + sin * z + place[0], cos * z - sin * x + place[1], height], dim=-1))
    places = torch.cat(found, dim=1)
    return World(places, torch.arange(views).double() * spacing / 60, torch.ones(places.shape[1], dtype=torch.bool))


@dataclass(frozen=True)
class Boxes:
    """Corners of the boxes of an Argoverse 2 log in the city: ``corners (boxes, sweeps, 8, 3)`` metres, NaN = absent; the
    sensor's ``poses (sweeps, 4, 4)``, sensor to city; ``seconds (sweeps,)``."""

    name: str
    corners: Tensor
    poses: Tensor
    seconds: Tensor

    def window(self, start: int, step: int, views: int) -> tuple[World, Tensor]:
        """The corners at sweeps start, start + step, ... about their mean, and as the moving sensor measures them."""
        sweeps = [start + step * i for i in range(views)]
        some = self.corners[:, sweeps]
        some = some[some.isfinite().flatten(1).all(-1)]
        times = self.seconds[sweeps] - self.seconds[start]
        moving = (some[:, -1] - some[:, 0]).mean(1).norm(dim=-1) > 0.5 * times[-1]
        places = some.transpose(0, 1).flatten(1, 2)
        measured = homogeneous(places) @ torch.linalg.inv(self.poses[sweeps]).mT
        return World(places - places.mean((0, 1)), times, moving.repeat_interleave(8)), measured[..., :3]


def boxes() -> list[Boxes]:
    """The logs, without the box of the vehicle that carries the sensor."""
    found = []
    for path in sorted((data_folder() / "argoverse2").glob("*.npz")):
        with np.load(path) as file:
            box = torch.from_numpy(file["box_ego"][file["category"] != "EGO_VEHICLE"].astype(float))
            pose = torch.from_numpy(file["ego_qxyz"].astype(float))
            seconds = torch.from_numpy((file["t_ns"] - file["t_ns"][0]) * 1e-9)
        poses = torch.eye(4, dtype=torch.float64).repeat(len(pose), 1, 1)
        poses[:, :3, :3], poses[:, :3, 3] = rotation(pose[:, :4]), pose[:, 4:]
        corners = box[..., None, :3] + (CORNERS * box[..., None, 7:10]) @ rotation(box[..., 3:7]).mT
        city = inhomogeneous(homogeneous(corners) @ poses.mT)
        found.append(Boxes(path.stem[:8], city, poses, seconds))
    return found


# ---- virtual cameras ---------------------------------------------------------------------------------------------------
def drone(world: World, draw: torch.Generator, distance: float = 4.0, sway: float = 0.5) -> Tensor:
    """Cameras ``(views, 3, 4)`` of a drone: so many radii away, half a radius of flight in all, and sway (radii, rms) in each
    view; the scene keeps its size in the image."""
    views, radius, middle = len(world.times), world.radius, world.places.mean((0, 1))
    around = torch.rand(1, generator=draw).double() * 2 * torch.pi
    away = torch.cat([0.7 * around.cos(), 0.7 * around.sin(), torch.full_like(around, 0.7)])
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    side = torch.linalg.cross(away, up)
    noise = torch.rand(2, views, 3, generator=draw).double() * 12**0.5 - 3**0.5
    place = distance * away + 0.5 * torch.linspace(-0.5, 0.5, views).double()[:, None] * side + sway * noise[0]
    pose = looking_at(middle + radius * place, middle + 0.1 * radius * noise[1], up.expand(views, 3))
    return calibration(torch.full((views,), FOCAL * distance / 4, dtype=torch.float64), CENTRE) @ pose


def seen(world: World, cameras: Tensor, draw: torch.Generator, sigma: float = 0.5) -> Tensor:
    """Tracks ``(views, n, 2)`` with noise, px."""
    exact = inhomogeneous(homogeneous(world.places) @ cameras.mT)
    return exact + sigma * torch.randn(exact.shape, generator=draw, dtype=exact.dtype)


# ---- what a reconstruction is worth ------------------------------------------------------------------------------------
def predicted(found: Reconstruction, time: float, image: Tensor, known: Tensor) -> Tensor:
    """Where a view ``image (n, 2)`` at any time shows the points, its camera being resected from the ``known (n,)`` ones alone."""
    centre, size = image[known].mean(0), image[known].std()
    x = ((image - centre) / size)[None]
    lift = found.motion.lifts([time]).to(image)
    weights = (known & found.structure.isfinite().all(-1)).to(image)[None]
    trusted = weights
    for _ in range(6):  # algebraic errors become distances once the depths are known
        camera = resect(found.structure, x, trusted, lifts=lift)
        depth = (found.structure @ (camera @ lift)[0, -1]).abs()
        trusted = weights * (depth.median() / depth.clamp(min=1e-3 * float(depth.median()) + 1e-300)).square().clamp(max=100)
    return reproject(camera @ lift, found.structure)[0] * size + centre


def minimum(tracks: Tensor, world: World, cameras: Tensor, motion: str) -> tuple[float, metrics.LiftedError]:
    """Rms reprojection distance and errors of the minimum that bundle adjustment finds from the truth."""
    lifts, root = balance_lifts(as_motion(motion).lifts(world.times))
    data = normalize_tracks(tracks[None], torch.ones_like(tracks[None, ..., 0]), world.times)
    done = bundle_adjust(
        data.x, data.weights, data.transforms @ cameras, (world.structure(motion) @ root.mT)[None], lifts, iterations=100
    )
    away = reproject(torch.linalg.inv(data.transforms) @ done.cameras @ lifts, done.structure) - tracks
    structure = done.structure[0] @ torch.linalg.inv(root).mT
    return float(away.square().sum(-1).mean().sqrt()), scene_error(structure, world, motion)


def scene_error(structure: Tensor, world: World, motion: str) -> metrics.LiftedError:
    """Errors of lifted points against the best straight lines of the world."""
    return metrics.lifted_error(structure, world.structure(motion), as_motion(motion).lifts(world.times))


def declared(tracks: Tensor, motion: str | dyn.Motion, times: Tensor, threshold: float | None) -> Reconstruction:
    """Reconstruct with fixed random numbers."""
    return dyn.reconstruct(tracks, motion, times, threshold=threshold, generator=torch.Generator().manual_seed(0))
