"""Accuracy against noise of reconstructions by lifted projections, stage by stage, beside the reference.

``python -m experiments.reconstruction.noise`` prints, for every motion, number of views and points, and noise, the medians over
scenes of the reprojection error (pixels), of the position error (median over points relative to the rms radius of the scene) and of
the velocity error (relative to the rms speed), both after the best alignment within what the views leave open:

- linear: projections of the nearest tensor of the linear fit, upgraded;
- constrained: those of least algebraic error (``dyn.constrain``);
- reconstruct: ``dyn.reconstruct``, which ends with structured bundle adjustment over all views;
- from the truth: the same bundle adjustment started at the true scene, what no other start can undercut;
- reached: share of the scenes whose cost is within 1 % of that one.

The reference is a float64 prototype, medians of 10 scenes of its own: good to a third or so.  ``--exact`` prints instead the
errors without noise at the minimal number of matches.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch import metrics, scenes
from dyntorch.geometry.lift import upgrade
from dyntorch.geometry.triangulation import resect, triangulate
from dyntorch.tasks.reconstruct.motions import MOTIONS, Motion
from dyntorch.tasks.reconstruct.reconstruct import normalize_tracks
from dyntorch.tasks.reconstruct.scene import LiftedState, Lifting, ViewTracks, adjust_scene, distances
from experiments.common.runner import SceneConfig, Tables, Words, experiment
from experiments.common.tables import note


@dataclass(frozen=True)
class Config(SceneConfig):
    """Errors of reconstructions."""

    exact: bool = False
    """Without noise, at the minimal number of matches."""


class Setting(NamedTuple):
    """One row of the table, with what the reference reached after bundle adjustment."""

    motion: str
    views: int
    points: int
    sigma: float
    rms: float
    position: float
    velocity: float | None


TABLE = (
    Setting("constant_direction_2d", 3, 60, 1.0, 0.99, 0.63, 2.1),
    Setting("constant_velocity_2d", 3, 60, 0.5, 0.40, 0.84, 2.8),
    Setting("constant_velocity_2d", 3, 60, 1.0, 0.80, 1.7, 5.6),
    Setting("constant_velocity_2d", 5, 60, 1.0, 1.1, 0.60, 1.4),
    Setting("constant_direction_3d", 3, 200, 0.5, 0.41, 4.9, 14.0),
    Setting("constant_direction_3d", 3, 60, 1.0, 0.78, 39.0, None),
    Setting("constant_direction_3d", 6, 60, 1.0, 1.1, 0.84, 1.4),
    Setting("constant_velocity_planes_3d", 4, 60, 0.5, 0.40, 1.2, 3.1),
    Setting("constant_velocity_planes_3d", 6, 60, 1.0, 1.0, 1.3, 2.1),
    Setting("constant_velocity_3d", 4, 60, 0.5, 0.31, 4.3, 19.0),
    Setting("constant_velocity_3d", 4, 200, 0.5, 0.34, 2.1, 7.6),
    Setting("constant_velocity_3d", 4, 200, 1.0, 0.68, 4.3, 15.0),
    Setting("constant_velocity_3d", 6, 60, 1.0, 0.93, 1.4, 3.6),
    Setting("constant_velocity_3d", 6, 200, 0.5, 0.50, 0.59, 1.3),
    Setting("constant_acceleration_2d", 6, 200, 1.0, 1.0, 0.50, 1.2),
)
BODIES = (("two_bodies_2d", 2, 40, 1.0, 1.7), ("two_bodies_3d", 3, 40, 1.0, 1.5), ("two_bodies_3d", 6, 40, 1.0, 0.55))


def flat(tracks: Tensor, times: Tensor) -> ViewTracks:
    """Tracks ``(b, views, n, l)`` as the steps of a reconstruction take them."""
    return normalize_tracks(tracks, torch.ones_like(tracks[..., 0]), times)


def stages(tracks: ViewTracks, motion: Motion) -> dict[str, tuple[Tensor, Tensor]]:
    """Projections and points, in the frame of the scene, of the stages before bundle adjustment.

    The tensor takes the first, the last, and evenly spread views between them; the others are resected.
    """
    count = min(motion.views(tracks.times), motion.k + 1)
    chosen = torch.linspace(0, tracks.x.shape[1] - 1, count).round().long()
    linear = dyn.fit(motion.tensor(count), *tracks.x[:, chosen].unbind(1))
    lifting = Lifting.of(motion, tracks.times, tracks.x)
    found = {}
    for name, solution in (("linear", linear), ("constrained", dyn.constrain(linear))):
        some = torch.stack(solution.motion, dim=1)
        structure = triangulate(some, tracks.x[:, chosen])
        whole = resect(structure, tracks.x)
        whole[:, chosen] = some
        projections = upgrade(whole, lifting.lifts)[1] @ lifting.lifts
        found[name] = projections, triangulate(projections, tracks.x)
    return found


def motion_lifts(scene: scenes.LiftedScene) -> Tensor:
    """The true lifts."""
    assert scene.lifts is not None
    return scene.lifts


def cell(setting: Setting, count: int, seed: int) -> list[str]:
    """One line of the table."""
    motion = MOTIONS[setting.motion]
    draw = torch.Generator().manual_seed(seed)
    scene = scenes.lifted_points(setting.motion, setting.points, setting.views, sigma=setting.sigma, batch=(count,), generator=draw)
    tracks = flat(scene.tracks, scene.times)
    lifting = Lifting.of(motion, tracks.times, tracks.x)
    truth = adjust_scene(
        tracks,
        LiftedState(tracks.transforms @ scene.cameras, scene.structure @ lifting.root.mT, tracks.x[:, 0, 0, 0]),
        lifting,
    )
    found = dyn.reconstruct(scene.tracks, setting.motion, scene.times, threshold=float("inf"))
    steps = stages(tracks, motion)
    steps["truth"] = truth.cameras @ lifting.lifts, truth.structure
    figures = {name: _figures(tracks, *both, lifting, scene) for name, both in steps.items()}
    ours = metrics.lifted_error(found.structure, scene.structure, motion_lifts(scene))
    figures["ours"] = float(found.residual.median()), 100 * float(ours.position.median()), 100 * float(ours.velocity.median())
    seen = scene.tracks.shape[1] * scene.tracks.shape[2]
    best = distances(tracks, truth.cameras @ lifting.lifts, truth.structure).square().flatten(1).sum(-1)
    reached = float((found.residual.square() * seen <= 1.01 * best).double().mean())
    columns = []
    for place, reference in enumerate((setting.rms, setting.position, setting.velocity)):
        row = " / ".join(_short(figures[name][place]) for name in ("linear", "constrained", "ours", "truth"))
        columns.append(f"{row} ({'-' if reference is None else _short(reference)})")
    name = f"{setting.motion}, {setting.views} views, {setting.points} points, {setting.sigma:g} px"
    return [name, *columns, f"{reached:.2f}"]


def _figures(
    tracks: ViewTracks, projections: Tensor, structure: Tensor, lifting: Lifting, scene: scenes.LiftedScene
) -> tuple[float, float, float]:
    """Reprojection, position (%) and velocity (%) error, medians over the scenes."""
    rms = distances(tracks, projections, structure).square().nanmean((1, 2)).sqrt()
    error = metrics.lifted_error(structure @ lifting.back.mT, scene.structure, motion_lifts(scene))
    return float(rms.median()), 100 * float(error.position.median()), 100 * float(error.velocity.median())


def _short(value: float) -> str:
    return f"{value:.2g}" if value < 10 else f"{value:.0f}"


def bodies(name: str, views: int, points: int, sigma: float, reference: float, count: int, seed: int) -> list[str]:
    """One line of the table of two bodies."""
    draw = torch.Generator().manual_seed(seed)
    scene = scenes.lifted_points(name, points, views, sigma=sigma, batch=(count,), generator=draw)
    found = dyn.reconstruct(scene.tracks, name, scene.times, threshold=float("inf"))
    # which body is called the first is arbitrary
    same = (found.labels == scene.labels).double().mean(-1)
    wrong = 1 - torch.maximum(same, 1 - same)
    error = metrics.body_error(found.points, scene.points, scene.labels)
    return [
        f"{name}, {views} views, {points} points, {sigma:g} px",
        f"{float(found.residual.median()):.2g}",
        f"{100 * float(error.median()):.2g} ({reference:g})",
        f"{100 * float(wrong.mean()):.2g}",
    ]


def exact(count: int, seed: int) -> list[list[str]]:
    """Errors without noise at the minimal number of matches and views."""
    lines = []
    for name, motion in MOTIONS.items():
        views = motion.views(torch.arange(6.0))
        need = motion.tensor(views).minimal()
        need = max(need, (motion.k + 1) * (motion.k + 2) // 2 - 1) if motion.bodies > 1 else need
        draw = torch.Generator().manual_seed(seed)
        scene = scenes.lifted_points(name, need, views, batch=(count,), generator=draw)
        found = dyn.reconstruct(scene.tracks, name, scene.times, threshold=float("inf"))
        if motion.bodies > 1:
            error = metrics.body_error(found.points, scene.points, scene.labels).amax(-1)
        else:
            error = metrics.lifted_error(found.structure, scene.structure, motion_lifts(scene)).position
        row = f"{float(found.residual.median()):.1e} / {float(found.residual.max()):.1e}"
        lines.append([name, str(views), str(need), row, f"{float(error.median()):.1e} / {float(error.max()):.1e}"])
    return lines


@experiment(Config(scenes=40), quick={"scenes": 8})
def tables(config: Config) -> Tables:
    """With noise, or (exact) without, at the minimal number of matches."""
    if config.exact:
        head = ("motion", "views", "matches", "residual (px), median / worst", "position error, median / worst")
        yield "without noise", Words(head, exact(config.scenes, config.seed))
        return
    title = f"medians over {config.scenes} scenes: linear / constrained / reconstruct / from the truth (reference)"
    lines = []
    for setting in TABLE:
        note(f"{setting.motion}, {setting.views} views")
        lines.append(cell(setting, config.scenes, config.seed))
    yield title, Words(("", "reprojection rms, px", "position error, %", "velocity error, %", "reached"), lines)
    lines = [bodies(*case, config.scenes, config.seed) for case in BODIES]
    yield "two bodies", Words(("", "reprojection rms, px", "affine error of a body, % (reference)", "wrong labels, %"), lines)
