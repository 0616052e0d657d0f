"""Trajectory triangulation: a noise table of straight trajectories, and a flying drone seen by cameras that never fire together.

    DYNTORCH_DATA=../shared/data OMP_NUM_THREADS=1 python -m experiments.reconstruction.trajectories

Synthetic: cameras at 5 units around points that move by up to 2 units at random speeds, f = 1300 px; per number of views the
error of the line, 1 - cos of the angle between unit vectors of R^6, and of the points; then the tensor of six uncalibrated views.

Real (drone_tracking/dataset3, Li et al. 2020, CC BY-NC-SA 4.0): the cameras are resected from the detections of the first half
of the flight and the RTK track, whose clock is found by the way.  In the second half, wherever the track is straight and the
drone moves, the line is triangulated from asynchronous detections alone and compared with the track.
"""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dyntorch.geometry.extensors import plucker
from dyntorch.geometry.homogeneous import apply
from dyntorch.tasks.trajectories.trajectories import LineStatus, points_on_lines, trajectory_cameras, triangulate_trajectories
from experiments.common.runner import SceneConfig, Tables, Words, experiment
from experiments.common.tables import note
from experiments.recognition.protocol import data_folder

Array = NDArray[Any]
CAMERAS = (0, 2, 3, 4, 5)  # camera 1 has a variable frame rate
RATE = 5.0  # Hz of the track, to start from
FRAMES = 59.94006  # per second of camera 0, whose frames are the common time
MOVING, STRAIGHT = 2.0, 0.05
"""m/s, and metres from the chord, that a piece of the track must be above and below."""


@dataclass(frozen=True)
class Flight:
    """Detections of all cameras on one clock, and the true track.

    Attributes:
        cameras: ``(cameras, 3, 4)`` px to metres of the track.
        camera, time, x: ``(detections,)``, ``(detections,)`` s, ``(detections, 2)`` undistorted px, in order of time.
        clock: samples of the track per second, and its sample at time 0.
        track: ``(samples, 3)`` metres.
    """

    cameras: Tensor
    camera: Tensor
    time: Tensor
    x: Tensor
    clock: tuple[float, float]
    track: Tensor

    def position(self, time: Tensor) -> Tensor:
        """Where the drone was, ``(..., 3)``."""
        return torch.from_numpy(interpolated(self.track.numpy(), (time * self.clock[0] + self.clock[1]).numpy()))


def interpolated(track: Array, place: Array) -> Array:
    """The track ``(samples, 3)`` between its samples."""
    first = np.clip(np.floor(place).astype(int), 0, len(track) - 2)
    part = (place - first)[..., None]
    return np.asarray(track[first] * (1 - part) + track[first + 1] * part)


def scene(shape: tuple[int, int], n: int, noise: float, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Cameras ``(scenes, views, 3, 4)``, images, points ``(scenes, views, n, 3)`` and lines ``(scenes, n, 6)``."""

    def random(*size: int) -> Tensor:
        return torch.randn(*size, generator=generator, dtype=torch.float64)

    centres = 5 * torch.nn.functional.normalize(random(*shape, 3), dim=-1)
    z = -centres / 5
    across = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.1, 0.2, 1.0]).double().expand_as(z), z), dim=-1)
    turn = torch.stack([across, torch.linalg.cross(z, across), z], dim=-2)
    lens = torch.tensor([[1300.0, 0, 500], [0, 1300, 500], [0, 0, 1]]).double()
    cameras = lens @ torch.cat([turn, -turn @ centres[..., None]], dim=-1)
    start, heading = 0.6 * random(shape[0], n, 3), torch.nn.functional.normalize(random(shape[0], n, 3), dim=-1)
    place = 2 * torch.rand(*shape, n, 1, generator=generator, dtype=torch.float64) - 1
    points = start[:, None] + place * heading[:, None]
    x = apply(cameras, points) + noise * random(*shape, n, 2)
    lines = torch.nn.functional.normalize(plucker(torch.stack([start, start + heading], dim=-2)), dim=-1)
    return cameras, x, points, lines


def synthetic(views: int, noise: float, config: SceneConfig, generator: torch.Generator) -> dict[str, float]:
    """One row of the noise table."""
    cameras, x, points, lines = scene((config.scenes, views), 200, noise, generator)
    found = triangulate_trajectories(cameras, x)
    angle = 1 - torch.maximum((found.lines * lines).sum(-1).abs(), (found.second * lines).sum(-1).abs())
    ok = (found.kinds == LineStatus.OK) | (found.kinds == LineStatus.TWO_FOLD)
    # of four views nothing tells which line is true: the better one counts
    other = points_on_lines(cameras, x, found.second)
    error = torch.minimum(*((p - points).norm(dim=-1).mean(1) for p in (found.points, other)))
    return {
        "views": views,
        "noise": noise,
        "ok": float(ok.double().mean()),
        "one_minus_cos": float(angle[ok].median()),
        "one_minus_cos_90": float(angle[ok].quantile(0.9)),
        "points": float(error[ok].median()),
    }


def uncalibrated(n: int, noise: float, config: SceneConfig) -> dict[str, float]:
    """One row of the table of six uncalibrated views, one scene: noise that the residuals show, px, before and after adjustment."""
    x = scene((1, 6), n, noise, torch.Generator().manual_seed(config.seed))[1][0]
    row: dict[str, float] = {"matches": n, "noise": noise}
    for name, bundle in (("linear", False), ("adjusted", True)):
        begin = perf_counter()
        row[name] = float(trajectory_cameras(x, bundle=bundle).trajectories.sigma)
        row[f"{name}_seconds"] = perf_counter() - begin
    return row


def flight() -> Flight:
    """The third data set of drone_tracking, cameras from the first half of it.

    Raises:
        ValueError: the data folder is not named, or lacks it.
    """
    path = data_folder() / "drone_tracking" / "dataset3.npz"
    if not path.exists():
        raise ValueError(f"{path}: no such file")
    with np.load(path) as file:
        data = {name: file[name] for name in file.files}
    pixels, seconds = [], []
    for i in CAMERAS:
        found = data[f"cam{i}/det"].astype(float)
        pixels.append(cv2.undistortPoints(found[:, None, 1:], data[f"cam{i}/K"], data[f"cam{i}/dist"], P=data[f"cam{i}/K"])[:, 0])
        seconds.append((data["alpha"][i, 0] * found[:, 0] + data["beta"][i, 0]) / FRAMES)
    half = np.median(np.concatenate(seconds))
    lenses = [data[f"cam{i}/K"] for i in CAMERAS]
    clock = synchronized(data["rtk"], pixels, seconds, lenses, half)
    cameras = []
    for x, t, lens in zip(pixels, seconds, lenses, strict=True):
        early = (t < half) & (t * clock[0] + clock[1] > 0)
        world = interpolated(data["rtk"], t[early] * clock[0] + clock[1])
        _, turn, shift, _ = cv2.solvePnPRansac(world, x[early], lens, None, reprojectionError=6.0, iterationsCount=300)
        cameras.append(lens @ np.c_[cv2.Rodrigues(turn)[0], shift])
    order = np.argsort(np.concatenate(seconds), kind="stable")
    return Flight(
        torch.from_numpy(np.stack(cameras)),
        torch.from_numpy(np.repeat(np.arange(len(CAMERAS)), [len(t) for t in seconds])[order]),
        torch.from_numpy(np.concatenate(seconds)[order]),
        torch.from_numpy(np.concatenate(pixels)[order]),
        clock,
        torch.from_numpy(data["rtk"]),
    )


def synchronized(track: Array, pixels: list[Array], seconds: list[Array], lenses: list[Array], half: float) -> tuple[float, float]:
    """Rate and first sample of the track's clock: where cameras fit the first half of the flight best, ever finer."""

    def misfit(rate: float, start: float) -> float:
        """Sum over the cameras of the median error, in units of the focal length, of the best linear camera."""
        total = 0.0
        for x, t, lens in zip(pixels, seconds, lenses, strict=True):
            place = t * rate + start
            use = np.flatnonzero((t < half) & (place > 0) & (place < len(track) - 1))
            if len(use) < 200:
                return np.inf
            use = use[:: len(use) // 200]
            world, seen = interpolated(track, place[use]), (x[use] - lens[:2, 2]) / lens[[0, 1], [0, 1]]
            world = np.c_[(world - world.mean(0)) / world.std(), np.ones(len(use))]
            none = np.zeros_like(world)
            rows = np.r_[np.c_[world, none, -seen[:, :1] * world], np.c_[none, world, -seen[:, 1:] * world]]
            image = world @ np.linalg.eigh(rows.T @ rows)[1][:, 0].reshape(3, 4).T
            total += float(np.median(np.linalg.norm(image[:, :2] / image[:, 2:] - seen, axis=1)))
        return total

    best = min((misfit(RATE, start), RATE, start) for start in np.arange(-len(track) / 4, len(track) / 4, 2.5).tolist())
    step = np.array([1e-3, 1.0])
    for _ in range(8):
        grid = [(best[1] + a * step[0], best[2] + b * step[1]) for a in (-2, -1, 0, 1, 2) for b in (-2, -1, 0, 1, 2)]
        best = min((misfit(*point), *point) for point in grid)
        step /= 2
    return float(best[1]), float(best[2])


def pieces(data: Flight, length: float) -> Tensor:
    """Starts ``(pieces,)``, s, of pieces of the second half where the track is straight and the drone moves."""
    begin, end = (
        float(data.time.median()),
        min(float(data.time.max()), (len(data.track) - 2 - data.clock[1]) / data.clock[0]) - length,
    )
    starts = torch.arange(begin, end, length, dtype=torch.float64)
    within = torch.linspace(0, length, 7, dtype=torch.float64)
    path = data.position(starts[:, None] + within)
    chord = path[:, -1] - path[:, 0]
    away = torch.linalg.cross(path - path[:, :1], torch.nn.functional.normalize(chord, dim=-1)[:, None].expand_as(path)).norm(
        dim=-1
    )
    return starts[(chord.norm(dim=-1) > MOVING * length) & (away.amax(-1) < STRAIGHT)]


def views(data: Flight, start: float, length: float, count: int | None, generator: torch.Generator) -> Tensor | None:
    """Detections ``(views,)`` of a piece: all, or ``count`` of them, at least one of each camera; None where a camera has none."""
    first, last = torch.searchsorted(data.time, torch.tensor([start, start + length], dtype=torch.float64)).tolist()
    mixed = first + torch.randperm(last - first, generator=generator)
    one = [mixed[data.camera[mixed] == i][:1] for i in range(len(CAMERAS))]
    if any(len(i) == 0 for i in one):
        return None
    if count is None:
        return torch.arange(first, last)
    chosen = torch.cat(one)
    rest = mixed[~torch.isin(mixed, chosen)]
    return torch.cat([chosen, rest[: count - len(chosen)]])


def real(data: Flight, length: float, count: int | None, seed: int) -> dict[str, float]:
    """One row of the table of real trajectories."""
    generator = torch.Generator().manual_seed(seed)
    starts = [(float(s), views(data, float(s), length, count, generator)) for s in pieces(data, length)]
    some = [(start, chosen) for start, chosen in starts if chosen is not None]
    size = max(len(chosen) for _, chosen in some)
    cameras = data.cameras[0].expand(len(some), size, 3, 4).clone()
    x = torch.full((len(some), size, 1, 2), torch.nan, dtype=torch.float64)
    time = torch.full((len(some), size), torch.nan, dtype=torch.float64)
    for k, (_, chosen) in enumerate(some):
        cameras[k, : len(chosen)], x[k, : len(chosen), 0], time[k, : len(chosen)] = (
            data.cameras[data.camera[chosen]], data.x[chosen], data.time[chosen]
        )  # fmt: skip
    found = triangulate_trajectories(cameras, x, sigma=1.0)
    ok = found.kinds[:, 0] == LineStatus.OK
    begin = torch.tensor([start for start, _ in some], dtype=torch.float64)
    head, tail = data.position(begin), data.position(begin + length)
    line = found.lines[:, 0]
    heading = torch.nn.functional.normalize(-line[:, [2, 4, 5]], dim=-1)
    true = torch.nn.functional.normalize(tail - head, dim=-1)
    angle = (heading * true).sum(-1).abs().clamp(max=1).acos().rad2deg()
    known = time.isfinite()
    true_points = data.position(time.nan_to_num(nan=float(begin[0])))
    error = torch.where(known, (found.points[:, :, 0] - true_points).norm(dim=-1), torch.nan).nanmedian(-1).values
    middle = (head + tail) / 2
    anchor = found.points[:, 0, 0]
    distance = torch.linalg.cross(middle - anchor, heading).norm(dim=-1)
    return {
        "seconds": length,
        "views": float(known.sum(-1).double().median()),
        "pieces": len(some),
        "ok": float(ok.double().mean()),
        "residual": float(found.residual[ok].median()),
        "angle": float(angle[ok].median()),
        "angle_90": float(angle[ok].quantile(0.9)),
        "distance": float(distance[ok].median()),
        "distance_90": float(distance[ok].quantile(0.9)),
        "points": float(error[ok].median()),
        "metres": float((tail - head).norm(dim=-1).median()),
    }


def table(rows: list[dict[str, float]]) -> Words:
    """Figures in words."""
    return Words(list(rows[0]), [[f"{value:.3g}" for value in row.values()] for row in rows])


@experiment(SceneConfig(scenes=20), quick={"scenes": 2})
def tables(config: SceneConfig) -> Tables:
    """Synthetic scenes of 200 points, one uncalibrated scene, and a drone; quick: the first."""
    generator = torch.Generator().manual_seed(config.seed)
    noise = [synthetic(v, 0.5, config, generator) for v in (4, 5, 6, 8)]
    yield "Synthetic, medians: 1 - cos of lines in R^6, points in units of a scene of radius 1", table(noise)
    if config.quick:
        return
    cases = ((728, 0.0), (728, 0.01), (1500, 0.1), (1500, 0.5), (3000, 0.5))
    yield "Six uncalibrated views: noise that the residuals show, px", table([uncalibrated(*case, config) for case in cases])
    data = flight()
    note(f"clock of the track: {data.clock[0]:.4f} samples/s, {data.clock[1]:.2f} at time 0")
    rows = [real(data, length, count, config.seed) for length in (0.5, 1.0) for count in (5, 8, 16, None)]
    yield "Drone, pieces of straight flight: medians and 90 %, degrees and metres against RTK", table(rows)
