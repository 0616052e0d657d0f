"""Lifts: ambiguities of the theory, the upgrade by random cameras, the views that it needs."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from dyntorch import scenes
from dyntorch.geometry.lift import (
    balance_lifts,
    center_frame,
    change_frame,
    finite,
    gauge_algebra,
    kernel,
    least_views,
    steadiest_frame,
    upgrade,
)
from dyntorch.geometry.triangulation import reproject
from dyntorch.tasks.reconstruct.motions import MOTIONS
from tests.draws import random, seeded


def lifts(dim, axes, times, degree=1):
    """[I | t E | t^2 E], written down entry by entry."""
    found = torch.eye(dim + 1, dim + 1 + axes * degree, dtype=torch.float64).repeat(len(times), 1, 1)
    for i, t in enumerate(times):
        for power in range(degree):
            for j in range(axes):
                found[i, j, dim + 1 + power * axes + j] = t ** (power + 1)
    return found


# world dimension, moving axes, degree, rows of a camera, dimension of the ambiguity, views that the upgrade needs
TABLE = {
    "constant_direction_2d": (2, 1, 1, 3, 9, 3),
    "constant_velocity_2d": (2, 2, 1, 3, 9, 3),
    "constant_acceleration_2d": (2, 2, 2, 3, 11, 4),
    "constant_direction_3d": (3, 1, 1, 3, 16, 3),
    "constant_velocity_planes_3d": (3, 2, 1, 3, 16, 4),
    "constant_velocity_3d": (3, 3, 1, 3, 16, 4),
    "constant_velocity_3d_sensors": (3, 3, 1, 4, 16, 3),
}
TIMES = [(0.0, 1.0, 2.0, 3.0, 4.0, 5.0), (-3.0, 0.5, 1.0, 4.0, 9.0, 9.5), (100.0, 101.0, 103.0, 104.0, 107.0, 110.0)]


@pytest.mark.parametrize("times", TIMES, ids=["even", "uneven", "far from zero"])
@pytest.mark.parametrize("name", TABLE)
def test_ambiguities_of_the_theory(name, times):
    dim, axes, degree, rows, ambiguity, views = TABLE[name]
    B = lifts(dim, axes, times, degree)
    algebra = gauge_algebra(balance_lifts(B)[0])
    assert len(algebra) == ambiguity
    flat = algebra.flatten(1)
    torch.testing.assert_close(flat @ flat.T, torch.eye(ambiguity).double())
    # closed under products, as changes of frame are
    products = (algebra[:, None] @ algebra[None]).flatten(2).flatten(0, 1)
    assert (products - (products @ flat.T) @ flat).abs().max() < 1e-10
    # from unbalanced lifts, moved back
    Q, R = balance_lifts(B)
    torch.testing.assert_close(Q @ R, B, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(Q.flatten(0, 1).T @ Q.flatten(0, 1) / len(times), torch.eye(B.shape[-1]).double())
    assert least_views(Q, rows) == views


def test_kernels():
    B = lifts(3, 2, (0.0, 2.0, 5.0))
    N = kernel(B)
    assert N.shape == (3, 6, 2) and (B @ N).abs().max() < 1e-14
    torch.testing.assert_close(N.mT @ N, torch.eye(2).double().expand(3, 2, 2))
    square = lifts(2, 0, (0.0, 1.0))
    assert kernel(square).shape == (2, 3, 0) and len(gauge_algebra(square)) == 9
    # a plane of static points needs no upgrade
    cameras = random(4, 2, 3, 3)
    T, found = upgrade(cameras, square)
    assert torch.equal(T, torch.eye(3).double().expand(4, 3, 3))
    torch.testing.assert_close(found, cameras)


@pytest.mark.parametrize("name", TABLE)
def test_upgrade_finds_cameras(name):
    dim, axes, degree, rows, _, views = TABLE[name]
    B = lifts(dim, axes, (0.0, 1.0, 2.5, 4.0)[:views], degree)
    size = B.shape[-1]
    cameras, frame = random(2, 3, views, rows, dim + 1), random(2, 3, size, size, seed=1)
    scale = torch.rand(2, 3, views, 1, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 1.3
    projections = scale * cameras @ B @ frame[..., None, :, :]
    T, found = upgrade(projections, B)
    assert T.shape == (2, 3, size, size) and found.shape == (2, 3, views, rows, dim + 1)
    torch.testing.assert_close(projections @ T[..., None, :, :], found @ B, rtol=1e-6, atol=1e-7)
    assert torch.linalg.cond(T).max() < 1e4
    # T is the true frame up to an ambiguity of the lifts
    change = (frame @ T).flatten(0, 1).flatten(1)
    flat = gauge_algebra(B).flatten(1)
    assert (change - (change @ flat.T) @ flat).norm() < 1e-6 * change.norm()
    # batch = loop, up to that ambiguity too
    alone = upgrade(projections[1, 2], B)
    torch.testing.assert_close(projections[1, 2] @ alone[0], alone[1] @ B, rtol=1e-6, atol=1e-7)


def test_too_few_views_and_equal_times():
    with pytest.raises(ValueError, match=r"2 views give 18 equations, 24 are needed; add views"):
        upgrade(random(2, 3, 7), lifts(3, 3, (0.0, 1.0)))
    # enough equations are not enough views: with three ones wrong frames remain
    B = lifts(3, 2, (0.0, 1.0, 2.0))
    assert least_views(B, 3) == 4 and least_views(B[:2], 3) == 3
    assert least_views(lifts(2, 2, (1.0, 1.0, 1.0)), 3) == 4
    # of four views two at the same time are one more camera at that time
    assert least_views(lifts(2, 2, (0.0, 1.0, 1.0, 2.0)), 3) == 4


# Frames of lifted scenes: members of the ambiguity, images unchanged, points finite, before the cameras and of unit size.


F64 = torch.float64
LIFTED = [name for name, motion in MOTIONS.items() if motion.lift is not None]


def disguised(name: str, batch: int = 6, seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Cameras and points of true scenes in a random frame of the ambiguity, each camera and point of any scale and sign."""
    views = max(4, scenes.lifts.KINDS[name].views)
    scene = scenes.lifted_points(name, 40, views=views, batch=batch, generator=seeded(seed))
    lifts, root = balance_lifts(MOTIONS[name].lifts(scene.times))
    algebra = gauge_algebra(lifts)
    rand = seeded(seed + 1)
    G = torch.einsum("bd,dij->bij", torch.randn(batch, len(algebra), generator=rand, dtype=F64), algebra)
    cameras, structure = change_frame(G, scene.cameras, scene.structure @ root.mT, lifts)
    cameras = cameras * torch.randn(batch, views, 1, 1, generator=rand, dtype=F64)
    return cameras, structure * torch.randn(batch, 40, 1, generator=rand, dtype=F64), lifts, algebra


@pytest.mark.parametrize("name", LIFTED)
def test_all_frames_together(name: str) -> None:
    cameras, structure, lifts, algebra = disguised(name)
    before = reproject(cameras @ lifts, structure)
    weights = torch.ones(before.shape[:-1], dtype=F64)
    first, cameras, structure = finite(cameras, structure, lifts, algebra, weights)
    cameras, structure = change_frame(first, cameras, structure, lifts)
    second = steadiest_frame(structure, lifts, lifts[0], algebra, weights[:, 0])
    cameras, structure = change_frame(second, cameras, structure, lifts)
    third = center_frame(structure, lifts, weights[:, 0])
    cameras, structure = change_frame(third, cameras, structure, lifts)
    basis = algebra.flatten(1)  # they are members of the ambiguity
    for frame in (first.flatten(1), second.flatten(1), third.flatten(1)):
        torch.testing.assert_close((frame @ basis.mT) @ basis, frame, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(reproject(cameras @ lifts, structure), before, rtol=1e-8, atol=1e-6)
    world = structure[:, None] @ lifts.mT
    assert bool((world[..., -1] > 0).all())
    place = world[..., :-1] / world[..., -1:]
    size = place.shape[-1] ** 0.5
    assert bool((place.mean((1, 2)).abs() < 1e-6).all())
    torch.testing.assert_close(place.square().sum(-1).mean((1, 2)).sqrt(), torch.full((6,), size, dtype=F64), rtol=0.25, atol=0)
    if cameras.shape[-2] == 3:
        assert bool(((world @ cameras.mT)[..., -1] > 0).all())


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
    scene = scenes.lifted_points("constant_velocity_2d", 30, static=0.4, generator=seeded(2))
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
