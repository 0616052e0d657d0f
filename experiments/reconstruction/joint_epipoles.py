"""Joint epipoles under noise: the vanishing point of a common direction of motion, from three views of moving points.

    python -m experiments.reconstruction.joint_epipoles --quick

Scenes of :func:`dyntorch.scenes.lifted_points`, ``constant_direction_3d`` (P^4 to P^2), first three views. The joint epipole of a
view is the vanishing point of the direction; the figure is the angle in degrees, seen from the camera, between it and the true
direction, the median over views and scenes. "tensor" is the closed form that takes the tensor alone, "projections" goes through
its cameras, "refined" through those of the refined tensor. The last table has planar constant velocities, where theory says there
is none: its definedness, the least sine between the two lines that should meet.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch.geometry.grassmann import joint_epipoles_of_tensor
from dyntorch.scenes import LiftedScene, lifted_points
from experiments.common.runner import SceneConfig, Tables, Words, experiment

PROFILE = dyn.GrassmannTensor(4, (2, 2, 1))
SETTINGS = tuple((n, sigma) for n in (20, 60, 200) for sigma in (0.0, 0.1, 0.5, 1.0))
HEAD = ("points", "noise px", "tensor deg", "projections deg", "refined deg", "definedness")
NONE = ("points", "noise px", "definedness", "of a common direction")
FOCAL = 1300.0
"""Of the cameras of these scenes, about: an angle from pixels."""


def angle(epipoles: Tensor, scene: LiftedScene) -> float:
    """Median angle between the joint epipoles and the images of the direction, degrees."""
    # the projections of the lift are P [I | t d]: their last column over the time is the image of the direction
    times = scene.times[..., :3]
    true = scene.projections[..., 1:3, :, 4] / times[..., 1:3, None]
    back = torch.tensor([FOCAL, FOCAL, 1.0], dtype=true.dtype)
    centre = torch.tensor([500.0, 500.0], dtype=true.dtype)

    def ray(p: Tensor) -> Tensor:
        moved = torch.cat([p[..., :2] - centre * p[..., 2:], p[..., 2:]], -1) / back
        return moved / moved.norm(dim=-1, keepdim=True)

    cosine = (ray(epipoles[..., 1:3, :]) * ray(true)).sum(-1).abs().clamp(max=1)
    return float(torch.rad2deg(torch.acos(cosine)).median())


def line(n: int, sigma: float, scenes: int, seed: int) -> Sequence[str]:
    """One row over the noise."""
    scene = lifted_points("constant_direction_3d", n, 3, batch=scenes, sigma=sigma, generator=torch.Generator().manual_seed(seed))
    views = scene.tracks.unbind(1)
    found = dyn.fit(PROFILE, *views)
    refined = dyn.refine(found, *views)
    cells, definedness = [f"{angle(joint_epipoles_of_tensor(found.tensor).epipoles, scene):.2g}"], 0.0
    for solution in (found, refined):
        epipoles = dyn.geometry.joint_epipoles(PROFILE.decompose(solution.tensor))
        cells.append(f"{angle(epipoles.epipoles, scene):.2g}")
        definedness = float(epipoles.definedness.median())
    return str(n), f"{sigma:g}", *cells, f"{definedness:.1g}"


def undefined(n: int, sigma: float, scenes: int, seed: int) -> Sequence[str]:
    """One row over planar constant velocities."""
    cells = []
    for kind in ("constant_velocity_2d", "constant_direction_3d"):
        scene = lifted_points(kind, n, 3, batch=scenes, sigma=sigma, generator=torch.Generator().manual_seed(seed))
        refined = dyn.refine(dyn.fit(PROFILE, *scene.tracks.unbind(1)), *scene.tracks.unbind(1))
        cells.append(f"{float(dyn.geometry.joint_epipoles(PROFILE.decompose(refined.tensor)).definedness.median()):.1g}")
    return str(n), f"{sigma:g}", *cells


@experiment(SceneConfig(scenes=40), quick={"scenes": 10})
def tables(config: SceneConfig) -> Tables:
    """Angle of the joint epipole over the points and the noise."""
    chosen = [setting for setting in SETTINGS if not config.quick or setting[1] == 0.5]
    lines = [line(*setting, config.scenes, config.seed) for setting in chosen]
    yield f"angle to the true direction, medians of {config.scenes} scenes", Words(HEAD, lines)
    lines = [undefined(*setting, config.scenes, config.seed) for setting in chosen]
    yield "planar constant velocities have none", Words(NONE, lines)
