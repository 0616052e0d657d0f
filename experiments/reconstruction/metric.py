"""How right angles and lengths are where the calibration of the cameras is known, motion by motion.

``python -m experiments.reconstruction.metric`` prints, for every motion and number of views, medians (and worst) over scenes of

- exact: error of the metric points without noise;
- points: the same at half a pixel (1000-pixel images; 3D sensors: 0.1 % of the size of the scene): rms distance of all points at
  all views after one similarity and a shift of each view (the motion that all points may share), over the radius of the scene;
- closed form: the same before bundle adjustment with calibrated cameras: the metric frame of the uncalibrated scene;
- affinity: the same of the scene without calibration, whose angles mean nothing;
- rotation: largest error of the cameras' rotations against each other, degrees;
- open: problems where several frames are metric (a plane in two views).

The scenes are written from the definitions (points, velocities, K [R | t]), not by ``dyntorch.scenes``.
"""

from __future__ import annotations

from unittest.mock import patch

import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch.geometry.rigid import rotation_exponential
from dyntorch.tasks.reconstruct import calibrated
from dyntorch.tasks.reconstruct.motions import MOTIONS, Motion
from dyntorch.tasks.reconstruct.result import Reconstruction
from experiments.common.runner import SceneConfig, Tables, Words, experiment
from experiments.common.tables import note

K = torch.tensor([[1300.0, 0.0, 500.0], [0.0, 1280.0, 480.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
AXES = {"constant_direction_2d": 1, "constant_direction_3d": 1, "constant_velocity_planes_3d": 2}
POINTS, PIXELS, SENSOR = 60, 0.5, 1e-3


def scenes(motion: Motion, views: int, count: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Exact images ``(b, views, n, l)``, points ``(b, views, n, d)`` and rotations of many scenes."""
    draw, dim = torch.Generator().manual_seed(seed), motion.dim
    moving = AXES.get(motion.name, 0 if motion.static or motion.bodies > 1 else dim)

    def normal(*size: int) -> Tensor:
        return torch.randn(count, *size, generator=draw, dtype=torch.float64)

    t = torch.arange(float(views), dtype=torch.float64)[:, None, None] - (views - 1) / 2
    X = torch.zeros(count, views, POINTS, 3, dtype=torch.float64)
    X[..., :dim] = normal(1, POINTS, dim)
    X[..., :moving] += 0.12 * t * normal(1, POINTS, moving)
    if motion.name == "constant_acceleration_2d":
        X[..., :2] += 0.03 * t**2 * normal(1, POINTS, 2)
    if motion.bodies > 1:
        X[:, :, POINTS // 2 :, :dim] += 0.5 * normal(views, 1, dim)
    R = rotation_exponential(0.35 * normal(views, 3) + torch.tensor([0.5, 0.2, 0.0], dtype=torch.float64))
    shift = 0.6 * normal(views, 3) + torch.tensor([0.0, 0.0, 6.0], dtype=torch.float64)
    seen = X @ R.mT + shift[:, :, None]
    if motion.sensor == 2:
        seen = seen @ K.mT
        seen = seen[..., :2] / seen[..., 2:]
    return seen, X[..., :dim], R


def errors(found: Reconstruction, X: Tensor) -> Tensor:
    """``(b,)`` relative errors of the points; of two bodies each by itself."""
    motion, views = found.motion, X.shape[1]
    if motion.bodies == 1:
        return _apart(torch.stack([found.at(float(t)) for t in range(views)], dim=1), X, motion.sensor == 2)
    half = X.shape[2] // 2
    parts = [_apart(found.points[:, None, part], X[:, :1, part], True) for part in (slice(0, half), slice(half, None))]
    return torch.stack(parts).square().mean(0).sqrt()


def _apart(found: Tensor, true: Tensor, scale: bool) -> Tensor:
    a, b = (x - x.mean(-2, keepdim=True) for x in (found.nan_to_num(), true))
    u, s, vh = torch.linalg.svd((b.mT @ a).sum(1))
    size = s.sum(-1) / a.square().sum((1, 2, 3)) if scale else torch.ones_like(s[:, 0])
    off = size[:, None, None, None] * a @ (u @ vh).mT[:, None] - b
    return (off.square().sum((1, 2, 3)) / b.square().sum((1, 2, 3))).sqrt()


def turned(found: Reconstruction, R: Tensor) -> Tensor:
    """``(b,)`` largest error of a rotation between two views, degrees."""
    assert found.rotations is not None
    between = (found.rotations @ found.rotations[:, :1].mT).mT @ (R @ R[:, :1].mT)
    sine = (between - between.mT).flatten(-2).norm(dim=-1) / 8**0.5
    return torch.rad2deg(sine.clamp(max=1).asin()).amax(-1)


def row(name: str, views: int, count: int, seed: int) -> list[str]:
    """One line of the table."""
    motion = MOTIONS[name]
    x, X, R = scenes(motion, views, count, seed)
    given = K if motion.sensor == 2 else torch.eye(4, dtype=torch.float64)
    sigma = PIXELS if motion.sensor == 2 else SENSOR
    noisy = x + sigma * torch.randn(x.shape, generator=torch.Generator().manual_seed(seed + 1), dtype=torch.float64)
    limit = float("inf")
    clean = dyn.reconstruct(x, name, threshold=limit, calibration=given)
    found = dyn.reconstruct(noisy, name, threshold=limit, calibration=given)
    with patch.object(calibrated, "METRIC_ITERATIONS", 0), patch.object(calibrated, "MAX_MISFIT", float("inf")):
        start = dyn.reconstruct(noisy, name, threshold=limit, calibration=given)
    plain = dyn.reconstruct(noisy, name, threshold=limit)
    assert clean.metric is not None and found.metric is not None
    several = sum(one.code == "metric_several" for one in found.notices)
    settled = torch.ones(count, dtype=torch.bool)
    for one in (*clean.notices, *found.notices):
        if one.code == "metric_several":
            settled[one.problem] = False
    cells = [_of(errors(clean, X)[settled]), _percent(errors(found, X)[settled]), _percent(errors(start, X)[settled])]
    cells += [_percent(errors(plain, X)), f"{float(turned(found, R)[settled].median()):.2g}"]
    cells += [f"{int(found.metric.sum())} of {count}", str(several)]
    return [name, str(views), *cells]


def _of(values: Tensor) -> str:
    return f"{float(values.median()):.0e} / {float(values.max()):.0e}"


def _percent(values: Tensor) -> str:
    return f"{100 * float(values.median()):.2g} / {100 * float(values.max()):.2g}"


@experiment(SceneConfig(scenes=40), quick={"scenes": 5})
def tables(config: SceneConfig) -> Tables:
    """Every motion at its least number of views, and three more."""
    head = ("motion", "views", "exact", "points, %", "closed form, %", "affinity, %", "rotation, deg", "metric", "open")
    lines = []
    for name, motion in MOTIONS.items():
        least = motion.views(torch.arange(6.0))
        for views in (least, least + 3):
            lines.append(row(name, views, config.scenes, config.seed))
            note(f"{name}, {views} views")
    title = (
        f"{config.scenes} scenes a row, {POINTS} points, {PIXELS} px; median / worst; problems with several metric frames left out"
    )
    yield title, Words(head, lines)
