"""Frames of lifted scenes: members of the ambiguity, images unchanged, points finite, before the cameras and of unit size."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from dyntorch import scenes
from dyntorch.geometry.lift import balance_lifts, center_frame, change_frame, finite, gauge_algebra, steadiest_frame
from dyntorch.geometry.triangulation import reproject
from dyntorch.tasks.reconstruct.motions import MOTIONS

F64 = torch.float64
LIFTED = [name for name, motion in MOTIONS.items() if motion.lift is not None]


def draw(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def disguised(name: str, batch: int = 6, seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Cameras and points of true scenes in a random frame of the ambiguity, each camera and point of any scale and sign."""
    views = max(4, scenes.lifts.KINDS[name].views)
    scene = scenes.lifted_points(name, 40, views=views, batch=batch, generator=draw(seed))
    lifts, root = balance_lifts(MOTIONS[name].lifts(scene.times))
    algebra = gauge_algebra(lifts)
    rand = draw(seed + 1)
    G = torch.einsum("bd,dij->bij", torch.randn(batch, len(algebra), generator=rand, dtype=F64), algebra)
    cameras, structure = change_frame(G, scene.cameras, scene.structure @ root.mT, lifts)
    cameras = cameras * torch.randn(batch, views, 1, 1, generator=rand, dtype=F64)
    return cameras, structure * torch.randn(batch, 40, 1, generator=rand, dtype=F64), lifts, algebra


@pytest.mark.parametrize("name", LIFTED)
def test_all_frames_together(name: str) -> None:
    cameras, structure, lifts, algebra = disguised(name)
    before = reproject(cameras @ lifts, structure)
    weights = torch.ones(before.shape[:-1], dtype=F64)
    G, cameras, structure = finite(cameras, structure, lifts, algebra, weights)
    cameras, structure = change_frame(G, cameras, structure, lifts)
    G = steadiest_frame(structure, lifts, lifts[0], algebra, weights[:, 0])
    cameras, structure = change_frame(G, cameras, structure, lifts)
    cameras, structure = change_frame(center_frame(structure, lifts, weights[:, 0]), cameras, structure, lifts)
    torch.testing.assert_close(reproject(cameras @ lifts, structure), before, rtol=1e-8, atol=1e-6)
    world = structure[:, None] @ lifts.mT
    assert bool((world[..., -1] > 0).all())
    place = world[..., :-1] / world[..., -1:]
    size = place.shape[-1] ** 0.5
    assert bool((place.mean((1, 2)).abs() < 1e-6).all())
    torch.testing.assert_close(place.square().sum(-1).mean((1, 2)).sqrt(), torch.full((6,), size, dtype=F64), rtol=0.25, atol=0)
    if cameras.shape[-2] == 3:
        assert bool(((world @ cameras.mT)[..., -1] > 0).all())


@pytest.mark.parametrize("name", ["static_3d", "constant_direction_3d", "constant_velocity_3d"])
def test_frames_are_members_of_the_ambiguity(name: str) -> None:
    cameras, structure, lifts, algebra = disguised(name, seed=3)
    weights = torch.ones(*structure.shape[:1], len(lifts), structure.shape[1], dtype=F64)
    G, cameras, structure = finite(cameras, structure, lifts, algebra, weights)
    _, structure = change_frame(G, cameras, structure, lifts)
    for member in (
        G,
        steadiest_frame(structure, lifts, lifts[0], algebra, weights[:, 0]),
        center_frame(structure, lifts, weights[:, 0]),
    ):
        basis = algebra.flatten(1)
        inside = (member.flatten(1) @ basis.mT) @ basis
        torch.testing.assert_close(inside, member.flatten(1), rtol=1e-9, atol=1e-9)


def test_a_problem_does_not_change_the_others() -> None:
    cameras, structure, lifts, algebra = disguised("constant_direction_3d", batch=3)
    weights = torch.ones(3, len(lifts), structure.shape[1], dtype=F64)
    good = finite(cameras, structure, lifts, algebra, weights)[0]
    structure[1] = 0.0
    cameras[1] = float("nan")
    found = finite(cameras, structure, lifts, algebra, weights)[0]
    torch.testing.assert_close(found[[0, 2]], good[[0, 2]])
    after = center_frame(structure, lifts, weights[:, 0])
    torch.testing.assert_close(after[[0, 2]], center_frame(structure[[0, 2]], lifts, weights[:2, 0]))
    torch.testing.assert_close(after[1], torch.eye(5, dtype=F64))


def test_steady_brings_the_chosen_points_to_rest() -> None:
    scene = scenes.lifted_points("constant_velocity_2d", 30, static=0.4, generator=draw(2))
    lifts, root = balance_lifts(MOTIONS["constant_velocity_2d"].lifts(scene.times))
    common = torch.eye(5, dtype=F64)
    common[3:, 2] = torch.tensor([0.7, -0.3])
    structure = scene.structure @ common.mT @ root.mT
    still = scene.labels == 1
    G = steadiest_frame(
        structure, lifts, MOTIONS["constant_velocity_2d"].lifts([0.0])[0] @ torch.linalg.inv(root), gauge_algebra(lifts), still
    )
    found = structure @ G.mT @ torch.linalg.inv(root).mT
    torch.testing.assert_close(found / found[:, 2:3], scene.structure, rtol=1e-9, atol=1e-9)
