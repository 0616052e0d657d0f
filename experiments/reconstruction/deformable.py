"""Deforming shapes from two cameras, beside one-camera methods, on motion capture and on shapes whose truth is few.

``python -m experiments.reconstruction.deformable`` (DYNTORCH_DATA: the CMU motion capture set) prints the 3D error, rms over points
and frames after the best similarity (and mirror) of every frame by itself, over the rms radius of the frames:

- rigid: one shape (Tomasi and Kanade), one camera;
- mean shape: that of the training takes, in the best pose of every frame: what a method reaches that sees nothing;
- trajectories: K cosines for every coordinate (Akhter, Sheikh, Khan and Kanade 2008), one camera, rotations of the rigid shape;
- block matrix: least nuclear norm of the rearranged shapes (Dai, Li and He 2012), one camera, the same rotations;
- trajectories*, block matrix*: the same two with the true rotations of the cameras, which nobody has;
- two views: two cameras, factorization and constant lengths of bones, no shape basis;
- deformable_shapes: with a basis; and with 20 % of the images of each camera missing, where no method above gives anything.

Numbers of cosines and shapes and the weight of the nuclear norm are chosen on training takes (subjects 01 and 03), the table is of
the others.  Cameras: orthographic, a person of 400 px, noise of 2 px, the second 60 degrees beside the first; they stand still, or
go around by 180 degrees in 60 frames at 15 Hz.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch.shapes import deformable_shapes
from experiments.common.real_data import takes
from experiments.common.runner import SceneConfig, Tables, Words, experiment
from experiments.common.tables import note

FRAMES, STEP, NOISE, SIZE, BESIDE, ELEVATION = 60, 4, 2.0, 400 / 1.7, math.radians(60), 0.2
TRAINING = 3
"""Every so many-th training take is used: choosing takes most of the time."""
COSINES, SHAPES, WEIGHTS = (3, 5, 8, 12), (4, 6, 9, 12), (0.1, 0.3, 1.0)
PARENTS = (-1, 0, 0, 0, 1, 4, 5, 6, 2, 8, 9, 10, 3, 12, 13, 13, 13, 14, 17, 15, 19, 20, 21, 21, 22, 16, 25, 26, 27, 27, 28)


class Window(NamedTuple):
    """A moving body before two cameras."""

    points: Tensor
    """``(frames, n, 3)`` px about their mean in each frame, in the frame of the first camera."""
    images: Tensor
    """``(2, frames, n, 2)`` with noise."""
    rotations: Tensor
    """``(frames, 3, 3)`` world to first camera."""


def window(joints: Tensor, around: float, seed: int) -> Window:
    """Cameras that go around by an angle, radians, and their images."""
    draw = torch.Generator().manual_seed(seed)
    points = SIZE * (joints - joints.mean(1, keepdim=True))
    start = float(torch.rand((), generator=draw)) * 2 * math.pi
    turns = [_camera(start + around * t / len(joints)) for t in range(len(joints))]
    first = torch.stack(turns)
    beside = torch.stack([_camera(start + around * t / len(joints) + BESIDE) for t in range(len(joints))])
    images = torch.stack([(points @ turn.mT)[..., :2] for turn in (first, beside)])
    noise = NOISE * torch.randn(images.shape, generator=draw, dtype=torch.float64)
    return Window(points @ first.mT, images + noise, first)


def _camera(azimuth: float) -> Tensor:
    """Rotation of a camera that looks at the world (y up) from an azimuth and a little above."""
    c, s, a, b = math.cos(azimuth), math.sin(azimuth), math.cos(ELEVATION), math.sin(ELEVATION)
    around = torch.tensor([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]], dtype=torch.float64)
    return torch.tensor([[1.0, 0.0, 0.0], [0.0, a, -b], [0.0, b, a]], dtype=torch.float64) @ around


def error(found: Tensor, true: Tensor) -> float:
    """Rms distance after the best similarity of each frame, mirrored or not, over the rms radius."""
    a, b = (x - x.mean(1, keepdim=True) for x in (found.nan_to_num(), true))
    u, s, vh = torch.linalg.svd(b.mT @ a)
    size = s.sum(-1) / a.square().sum((1, 2)).clamp(min=1e-300)
    return float((size[:, None, None] * a @ (u @ vh).mT - b).norm() / b.norm())


# ---- one-camera methods ----------------------------------------------------------------------------------------------


def posed(images: Tensor) -> tuple[Tensor, Tensor]:
    """The rigid shape ``(n, 3)`` of one camera's images ``(frames, n, 2)``, and its rotations ``(frames, 3, 3)``."""
    shape, cameras, _ = dyn.numerics.affine_factorization(images)
    metric, decided = dyn.numerics.metric_upgrade(shape, cameras)
    metric = metric if bool(decided) else shape
    x = images - images.mean(1, keepdim=True)
    rows = torch.linalg.lstsq(metric.expand(len(x), -1, -1), x).solution.mT
    u, _, vh = torch.linalg.svd(rows, full_matrices=False)
    rows = u @ vh
    return metric, torch.cat([rows, torch.linalg.cross(rows[:, 0], rows[:, 1])[:, None]], dim=1)


def rigid(images: Tensor) -> Tensor:
    """One shape for all frames."""
    return posed(images)[0].expand(len(images), -1, -1)


def trajectories(images: Tensor, cosines: int, rotations: Tensor) -> Tensor:
    """Every coordinate of every point a sum of cosines of the time; a small ridge keeps what the camera does not show at rest."""
    x = images - images.mean(1, keepdim=True)
    T = len(x)
    time = (torch.arange(T, dtype=torch.float64) + 0.5) * math.pi / T
    waves = torch.stack([(k * time).cos() for k in range(cosines)], dim=-1)
    rows = torch.einsum("tij,tk->tikj", rotations[:, :2], waves).reshape(2 * T, 3 * cosines)
    target = x.transpose(1, 2).reshape(2 * T, -1)
    gram = rows.mT @ rows
    ridge = 1e-4 * gram.diagonal().mean() * torch.eye(len(gram), dtype=gram.dtype)
    found = torch.linalg.solve(gram + ridge, rows.mT @ target).unflatten(0, (cosines, 3))
    return torch.einsum("tk,kjn->tnj", waves, found)


def block_matrix(images: Tensor, weight: float, rotations: Tensor) -> Tensor:
    """The shapes of least nuclear norm, rearranged as (frames, 3 n), that the camera sees so: proximal gradient, warm started."""
    x = (images - images.mean(1, keepdim=True)).mT
    turn = rotations[:, :2]
    shapes = turn.mT @ x
    top = float(torch.linalg.matrix_norm(shapes.flatten(1), ord=2))
    for share in (0.3, 0.1, 0.03, 0.01, 0.003):
        for _ in range(60):
            shapes = shapes - turn.mT @ (turn @ shapes - x)
            u, s, vh = torch.linalg.svd(shapes.flatten(1), full_matrices=False)
            shapes = ((u * (s - weight * share * top).clamp(min=0)) @ vh).view_as(shapes)
    return shapes.mT


# ---- two cameras -----------------------------------------------------------------------------------------------------


def bones() -> Tensor:
    """Pairs of joints of the skeleton that are one apart."""
    return torch.tensor([(child, parent) for child, parent in enumerate(PARENTS) if parent >= 0])


def two_views(images: Tensor) -> Tensor:
    """Points of every frame by factorization and the lengths of bones alone: as many shapes as there are coordinates."""
    most = min(images.shape[1], 3 * images.shape[2])
    return deformable_shapes(images[0], images[1], most, lengths=bones(), orthographic=True, iterations=0).points


def deformable(images: Tensor, shapes: int) -> Tensor:
    """With a shape basis."""
    return deformable_shapes(images[0], images[1], shapes, lengths=bones(), orthographic=True).points


def gaps(images: Tensor, share: float, seed: int) -> Tensor:
    """The images with some missing, of each camera by itself."""
    draw = torch.Generator().manual_seed(seed)
    return torch.where(torch.rand(images.shape[:-1], generator=draw)[..., None] < share, torch.nan, images)


@dataclass(frozen=True)
class Config(SceneConfig):
    """Shapes that deform."""

    windows: int = 1
    """Windows per take at most."""


def windows(training: bool, around: float, per_take: int) -> list[Window]:
    """Some windows of every take that is long enough."""
    found = []
    for number, take in enumerate(takes()):
        if (take.name[:2] in ("01", "03")) != training:
            continue
        joints = take.joints[::STEP]
        for place in range(min(per_take, len(joints) // FRAMES)):
            start = (len(joints) - FRAMES) * (2 * place + 1) // (2 * per_take)
            found.append(window(joints[start : start + FRAMES], around, 100 * number + place))
    return found


def best(settings: tuple[float, ...], method: Callable[[Window, float], Tensor], training: list[Window]) -> float:
    """The setting of least mean error on the training windows."""
    scores = [np.mean([error(method(one, setting), one.points) for one in training]) for setting in settings]
    return settings[int(np.argmin(scores))]


def table(around: float, per_take: int) -> Words:
    """The table of one path of the cameras."""
    training, test = windows(True, around, 1)[::TRAINING], windows(False, around, per_take)
    joints = [take.joints[::STEP] for take in takes() if take.name[:2] in ("01", "03")]
    mean = _mean_shape(torch.cat([x - x.mean(1, keepdim=True) for x in joints]))
    chosen: list[tuple[str, Callable[[Window, float], Tensor], tuple[float, ...]]] = [
        ("rigid", lambda one, _: rigid(one.images[0]), (0,)),
        ("mean shape", lambda one, _: mean.expand(len(one.points), -1, -1), (0,)),
        ("trajectories", lambda one, k: trajectories(one.images[0], int(k), posed(one.images[0])[1]), COSINES),
        ("trajectories*", lambda one, k: trajectories(one.images[0], int(k), one.rotations), COSINES),
        ("block matrix", lambda one, k: block_matrix(one.images[0], k, posed(one.images[0])[1]), WEIGHTS),
        ("block matrix*", lambda one, k: block_matrix(one.images[0], k, one.rotations), WEIGHTS),
        ("two views", lambda one, _: two_views(one.images), (0,)),
        ("deformable_shapes", lambda one, k: deformable(one.images, int(k)), SHAPES),
        ("deformable_shapes, 20 % missing", lambda one, k: deformable(gaps(one.images, 0.2, 1), int(k)), SHAPES),
    ]
    lines = []
    for name, method, settings in chosen:
        setting = best(settings, method, training) if len(settings) > 1 else 0
        scores = [100 * error(method(one, setting), one.points) for one in test]
        what = f"{setting:g}" if len(settings) > 1 else "-"
        lines.append((name, what, f"{np.median(scores):.3g}", f"{np.max(scores):.3g}"))
        note(name)
    return Words(("method", "chosen", "error, %, median", "worst"), lines)


def _mean_shape(frames: Tensor) -> Tensor:
    """The mean of shapes ``(m, n, 3)``, turned onto each other."""
    shape = frames[0]
    for _ in range(5):
        u, _, vh = torch.linalg.svd(shape.mT @ frames)
        shape = (frames @ (u @ vh).mT).mean(0)
    return shape


# ---- shapes whose truth is few ---------------------------------------------------------------------------------------


def synthetic(count: int) -> Words:
    """Random bases: error of the metric points by noise, number of shapes and share of missing images."""
    lines = []
    for basis, n, noise, missing in ((2, 20, 0.0, 0.0), (2, 20, 1.0, 0.0), (3, 30, 1.0, 0.0), (3, 30, 3.0, 0.0), (3, 30, 1.0, 0.3)):
        scores = [_once(basis, n, noise / 100, missing, seed) for seed in range(count)]
        first, second = (float(np.median([score[k] for score in scores])) for k in (0, 1))
        alone = "-" if missing else f"{100 * first:.2g}"
        lines.append((f"{basis}", f"{n}", f"{FRAMES}", f"{noise:g}", f"{100 * missing:g}", alone, f"{100 * second:.2g}"))
    return Words(("basis", "points", "frames", "noise, % of the size", "missing, %", "two views, %", "deformable_shapes, %"), lines)


def _once(basis: int, n: int, noise: float, missing: float, seed: int) -> tuple[float, float]:
    """Errors without and with a basis: a third of the points is rigid, and its distances are the lengths."""
    draw = torch.Generator().manual_seed(seed)

    def normal(*size: int) -> Tensor:
        return torch.randn(*size, generator=draw, dtype=torch.float64)

    shapes, share = normal(basis, n, 3), torch.cat([torch.ones(FRAMES, 1).double(), 0.4 * normal(FRAMES, basis - 1)], dim=1)
    shapes[1:, : n // 3] = 0
    turn = torch.linalg.qr(torch.eye(3).double() + 0.5 * normal(FRAMES, 3, 3))[0]
    points = torch.einsum("tb,bnj->tnj", share, shapes) @ (turn * torch.linalg.det(turn)[:, None, None]).mT
    points = points - points.mean(1, keepdim=True)
    rig = torch.stack([_camera(0.3), _camera(0.3 + BESIDE)])[:, :2]
    images = points @ rig[:, None].mT
    images = images + noise * points.square().sum(-1).mean().sqrt() * normal(*images.shape)
    pairs = torch.combinations(torch.arange(n // 3))
    seen = gaps(images, missing, seed)
    plain = deformable_shapes(images[0], images[1], FRAMES, lengths=pairs, iterations=0).points
    return error(plain, points), error(deformable_shapes(seen[0], seen[1], basis, lengths=pairs).points, points)


@experiment(Config(scenes=10))
def tables(config: Config) -> Tables:
    """Random bases, then captured bodies."""
    yield "random bases, medians", synthetic(config.scenes)
    for name, around in (("cameras that stand still", 0.0), ("cameras that go around by 180 degrees", math.pi)):
        yield f"{name}: CMU motion capture, 31 joints", table(around, config.windows)
