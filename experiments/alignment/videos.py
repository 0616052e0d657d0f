"""From the picture to the tensor: points followed through videos, and what align, segment and reconstruct make of them.

    python -m experiments.alignment.videos
    DYNTORCH_DATA=../shared/data python -m experiments.alignment.videos --recorded

Rendered videos have their truth in every pixel: a wall with posters that slide over it before a camera that turns and goes (planar
scene), and a room with a box that moves and turns (two bodies).  All is textured, so that what is measured is following and
estimation, not where there happen to be corners.
With ``--recorded``, fixed cameras that film people: the true motion of the camera is none, and so A, B and the background's
homography are the identity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

import dyntorch as dyn
from dyntorch import metrics
from experiments.common.runner import SceneConfig, Tables, experiment
from experiments.common.tables import Row, note
from experiments.recognition.protocol import data_folder
from indexing.actors.textured import RenderedVideo, render, sheet
from indexing.video import Chunk, SceneTracks, track_scene
from indexing.video.scene import SCENE_FOLLOWING, THRESHOLD

Floats = NDArray[np.float64]
SIZE = (480, 360)
CAMERA = np.array([[450.0, 0, 239.5], [0, 450.0, 179.5], [0, 0, 1]])
FPS = 25.0
RECORDED = ("pose2sim/cam01.mp4", "pose2sim/cam02.mp4")


@dataclass(frozen=True)
class Config(SceneConfig):
    """Videos to tracks to tensors, with truth."""

    frames: int = 40
    """Of each."""
    noise: float = 2.0
    """Grey levels, standard deviation."""
    recorded: bool = False
    """The videos of the folder DYNTORCH_DATA as well."""


def turned(axis: Floats, angle: float) -> Floats:
    """The rotation about an axis, by radians."""
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


def seen_from(centre: Floats, rotation: Floats) -> Floats:
    """The camera there."""
    return np.asarray(CAMERA @ np.c_[rotation, -rotation @ centre])


def planar_scene(config: Config, seed: int, posters: int = 6) -> RenderedVideo:
    """A wall, and posters that slide over it at constant velocity."""
    generator, rng = torch.Generator().manual_seed(seed), np.random.default_rng(seed)
    time = np.linspace(-0.5, 0.5, config.frames)
    sheets = [sheet((-6, -5, 6), (12, 0, 0), (0, 10, 0), 1100, 0, generator)]
    motions = np.tile(np.eye(4), (config.frames, posters + 1, 1, 1))
    for k in range(1, posters + 1):
        (wide, tall), at = rng.uniform(0.7, 1.2, 2), rng.uniform((-1.8, -1.4), (1.8, 1.4))
        corner = (at[0] - wide / 2, at[1] - tall / 2, 5.999 - 1e-4 * k)
        sheets.append(sheet(corner, (wide, 0, 0), (0, tall, 0), 110, k, generator))
        motions[:, k, :2, 3] = time[:, None] * rng.uniform(-1.0, 1.0, 2)
    axis, way = rng.normal(size=3), rng.uniform(-0.5, 0.5, 3) * [1.6, 1.2, 0.8]
    cameras = np.stack([seen_from(way * t, turned(axis, 0.12 * t) @ turned(np.array([0, 1.0, 0]), 0.15)) for t in time])
    return render(sheets, cameras, motions, SIZE, noise=config.noise, generator=generator)


def room_scene(config: Config, seed: int) -> RenderedVideo:
    """A wall, a floor, a side and a screen that stand, and a box that moves and turns."""
    generator, rng = torch.Generator().manual_seed(seed), np.random.default_rng(seed)
    time, upright = np.linspace(-0.5, 0.5, config.frames), np.array([0, 1.0, 0])
    standing = (
        ((-5, -4, 8), (10, 0, 0), (0, 8, 0), 800),
        ((-5, 1.3, 2), (10, 0, 0), (0, 0, 6), 700),
        ((-3.0, -3, 3.2), (0, 0, 4.8), (0, 4.3, 0), 500),
        ((-1.6, 0.1, 4.6), (1, 0, 0.2), (0, 1.2, 0), 150),
    )
    faces = (
        ((-0.6, -0.6, -0.6), (1.2, 0, 0), (0, 1.2, 0)),
        ((-0.6, -0.6, 0.6), (0, 0, -1.2), (0, 1.2, 0)),
        ((-0.6, -0.6, 0.6), (1.2, 0, 0), (0, 0, -1.2)),
    )
    sheets = [sheet(corner, right, down, pixels, 0, generator) for corner, right, down, pixels in standing]
    sheets += [sheet(corner, right, down, 170, 1, generator) for corner, right, down in faces]
    motions = np.tile(np.eye(4), (config.frames, 2, 1, 1))
    velocity, axis = rng.uniform((0, -0.5, -0.5), (1, 0.5, 0.5)), rng.normal(size=3)
    for i, t in enumerate(time):
        motions[i, 1, :3, :3] = turned(axis, 0.3 * t) @ turned(upright, -0.5) @ turned(np.array([1.0, 0, 0]), 0.35)
        motions[i, 1, :3, 3] = np.array([0.5, 0, 4.5]) + velocity * t
    way = rng.uniform(-1, 1, 3) * [0.7, 0.4, 0.5] + [0.3, 0, 0]
    cameras = np.stack([seen_from(way * t + [0, -0.1, 0], turned(upright, 0.1 * t)) for t in time])
    return render(sheets, cameras, motions, SIZE, noise=config.noise, generator=generator)


def followed(video: RenderedVideo, **options: object) -> SceneTracks:
    """Points through a rendered video."""
    stream = [Chunk(video.frames, np.arange(len(video.frames)) / FPS)]
    return track_scene(stream, **options)  # type: ignore[arg-type]


def track_errors(video: RenderedVideo, tracks: SceneTracks) -> Floats:
    """Pixels of every point of the first picture from its truth in the others; those on edges have none."""
    points, frames = tracks.points.numpy(), tracks.frames
    found = [np.linalg.norm(video.transfer(points[0], frames[0], frames[k]) - points[k], axis=1) for k in range(1, len(frames))]
    errors = np.concatenate(found)
    return np.asarray(errors[np.isfinite(errors)])


def track_rows(errors: list[Floats], setting: str) -> list[Row]:
    """How well points are followed."""
    every = np.concatenate(errors)
    return [
        Row("track error, median px", setting, float(np.median(every)), 0.25, at_most=True),
        Row("track error, 95 % px", setting, float(np.quantile(every, 0.95))),
        Row("tracks off by more than 1 px", setting, float((every > 1).mean()), 0.03, at_most=True),
    ]


def aligned(config: Config) -> list[Row]:
    """Planar scenes: tracks, labels, and the camera's motion."""
    tracks_of, labels, motion, solved = [], [], [], 0
    for seed in range(config.seed, config.seed + config.scenes):
        video = planar_scene(config, seed)
        tracks = followed(video, views=3)
        tracks_of.append(track_errors(video, tracks))
        found = dyn.align_planar(*tracks.points, threshold=THRESHOLD, generator=torch.Generator().manual_seed(0))
        solved += int(found.status == dyn.Status.OK)
        shown = video.visible_sheets(tracks.points[0].numpy(), tracks.frames[0])
        truth = np.where(video.bodies[shown] > 0, 2, 1)
        known = (shown >= 0) & (found.labels.numpy() > 0)
        labels.append(float((found.labels.numpy() == truth)[known].mean()))
        for matrix, frame in zip((found.A, found.B), tracks.frames[1:], strict=True):
            true = torch.from_numpy(video.maps[tracks.frames[0], 0] @ np.linalg.inv(video.maps[frame, 0]))
            motion.append(float(metrics.grid_transfer_error(matrix, true, *map(float, SIZE))))
        note(f"planar {seed}: {tracks.notes[0]}; labels {labels[-1]:.3f}, A and B within {max(motion[-2:]):.2f} px")
    setting = f"{config.scenes} videos, {config.frames} frames"
    return [
        *track_rows(tracks_of, setting),
        Row("align_planar: decided", setting, solved / config.scenes),
        Row("align_planar: labels right", setting, float(np.mean(labels)), 0.95),
        Row("align_planar: A and B, rms px over the image", setting, float(np.mean(motion)), 0.5, at_most=True),
    ]


def segmented(config: Config) -> list[Row]:
    """Rooms: tracks, bodies, and their fundamental matrices."""
    tracks_of, wrong, epipolar = [], [], []
    for seed in range(config.seed, config.seed + config.scenes):
        video = room_scene(config, seed)
        tracks = followed(video, views=2)
        tracks_of.append(track_errors(video, tracks))
        found = dyn.segment(*tracks.points, generator=torch.Generator().manual_seed(0))
        first, second = tracks.frames
        points = tracks.points[0].numpy()
        shown = video.visible_sheets(points, first)
        truth = torch.from_numpy(np.where(shown >= 0, video.bodies[shown] + 1, 0))
        kept = truth > 0
        wrong.append(float(metrics.misclassification(found.labels[kept], truth[kept])))
        exact = torch.from_numpy(video.transfer(points, first, second))
        for body in (1, 2):
            mine = truth == body
            label = int(found.labels[mine & (found.labels > 0)].mode().values)
            epipolar.append(float(lines_off(found.fundamentals[label - 1], tracks.points[0][mine], exact[mine])))
        note(f"room {seed}: misclassified {wrong[-1]:.3f}, epipolar lines off by {epipolar[-2]:.2f} and {epipolar[-1]:.2f} px")
    setting = f"{config.scenes} videos, {config.frames} frames"
    return [
        *track_rows(tracks_of, setting),
        Row("segment: misclassified", setting, float(np.mean(wrong)), 0.05, at_most=True),
        Row("segment: true points from the lines of F, rms px", setting, float(np.mean(epipolar)), 1.0, at_most=True),
    ]


def lines_off(F: torch.Tensor, x1: torch.Tensor, x2: torch.Tensor) -> torch.Tensor:
    """Root mean square distance of the second points from the epipolar lines of the first."""
    one = torch.ones_like(x1[:, :1])
    lines = torch.cat([x1, one], dim=1) @ F.mT
    return ((lines * torch.cat([x2, one], dim=1)).sum(1) / lines[:, :2].norm(dim=1)).square().mean().sqrt()


def reconstructed(config: Config) -> list[Row]:
    """Planar scenes through eight frames: what the reconstruction says of every view, against where the points truly are."""
    away, residuals = [], []
    for seed in range(config.seed, config.seed + config.scenes):
        video = planar_scene(config, seed)
        tracks = followed(video, views=8, missing=True)
        found = dyn.reconstruct(tracks.points, "constant_velocity_2d", tracks.times, generator=torch.Generator().manual_seed(0))
        residuals.append(float(found.residual))
        start = tracks.points[0].numpy()
        fits = (found.labels > 0).numpy() & np.isfinite(start[:, 0])
        for k, frame in enumerate(tracks.frames):
            rays = torch.cat([found.at(float(tracks.times[k])), torch.ones_like(found.points[:, :1])], dim=1) @ found.cameras[k].mT
            predicted = (rays[:, :2] / rays[:, 2:]).numpy()
            off = np.linalg.norm(predicted - video.transfer(start, tracks.frames[0], frame), axis=1)[fits]
            away.append(off[np.isfinite(off)])
        note(f"planar {seed}: {int(fits.sum())} points, residual {residuals[-1]:.3f} px")
    setting = f"{config.scenes} videos, 8 frames"
    return [
        Row("reconstruct: residual, rms px", setting, float(np.mean(residuals))),
        Row("reconstruct: points from their truth, median px", setting, float(np.median(np.concatenate(away))), 0.3, at_most=True),
    ]


def recordings(config: Config) -> list[Row]:
    """Fixed cameras: how far the motion that is found is from none."""
    rows = []
    for name in RECORDED:
        tracks = track_scene(data_folder() / name, views=3)
        shrunk = max(1.0, max(tracks.size) / SCENE_FOLLOWING.working_side)
        found = dyn.align_planar(*tracks.points, threshold=shrunk * THRESHOLD, generator=torch.Generator().manual_seed(0))
        still = torch.eye(3, dtype=torch.float64)
        size = (float(tracks.size[0]), float(tracks.size[1]))
        off = max(float(metrics.grid_transfer_error(matrix, still, *size)) for matrix in (found.A, found.B))
        counts = [int((found.labels == label).sum()) for label in (1, 2, 0)]
        note(f"{name}: {tracks.notes[0]}; {counts[0]} static, {counts[1]} moving, {counts[2]} outliers, {found.status}")
        rows.append(Row("align_planar: A and B from the identity, rms px", name, off, 1.0, at_most=True))
        pair = track_scene(data_folder() / name, views=2)
        bodies = dyn.segment(*pair.points, generator=torch.Generator().manual_seed(0))
        rest = (pair.points[1] - pair.points[0]).norm(dim=1) < 1.0
        one = bodies.labels[rest & (bodies.labels > 0)]
        together = float((one == one.mode().values).double().mean()) if len(one) else 0.0
        rows.append(Row("segment: points that rest, in one body", name, together, 0.95))
    return rows


@experiment(Config(scenes=3, seed=1), quick={"scenes": 1})
def tables(config: Config) -> Tables:
    """Rendered videos, and those of the folder DYNTORCH_DATA."""
    yield "a wall with posters that slide", aligned(config)
    yield "a room with a box that moves", segmented(config)
    yield "a wall with posters, reconstructed", reconstructed(config)
    if config.recorded:
        yield "recorded by fixed cameras", recordings(config)
