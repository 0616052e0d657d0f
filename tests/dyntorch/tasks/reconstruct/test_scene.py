"""Scenes from projections: exact without noise, at the minimum that the truth leads to with it, with many gaps as well."""

from dataclasses import replace

import pytest
import torch

from dyntorch import metrics, scenes
from dyntorch.core.outcome import Status
from dyntorch.geometry.triangulation import reproject, triangulate
from dyntorch.tasks.reconstruct import scene as module
from dyntorch.tasks.reconstruct.motions import MOTIONS
from dyntorch.tasks.reconstruct.reconstruct import normalize_tracks
from dyntorch.tasks.reconstruct.scene import (
    LiftedState,
    Lifting,
    adjust_scene,
    distances,
    fix_frame,
    mean_error,
    positions,
    projections_of_tracks,
    scene_of,
    static_cameras,
    velocities,
    view_subsets,
)
from tests.draws import seeded

MOVING = [name for name, motion in MOTIONS.items() if motion.lift is not None and not motion.static]


def solved(name, n, seed=0, **options):
    """Truth, tracks, lifting, projections and scene."""
    options = {"batch": (1,), **options}
    truth = scenes.lifted_points(name, n, generator=seeded(seed), **options)
    seen = truth.tracks.isfinite().all(-1).double()
    tracks = normalize_tracks(truth.tracks.nan_to_num(), seen, truth.times)
    motion = MOTIONS[name]
    lifting = Lifting.of(motion, truth.times, tracks.x)
    found = projections_of_tracks(tracks, motion.tensor(min(motion.views(truth.times), motion.k + 1)))
    return truth, tracks, lifting, found, scene_of(tracks, found, lifting)


def error(truth, lifting, scene):
    return metrics.lifted_error(scene.structure @ torch.linalg.inv(lifting.root).mT, truth.structure, truth.lifts)


def from_truth(truth, tracks, lifting):
    return adjust_scene(tracks, LiftedState(tracks.transforms @ truth.cameras, truth.structure @ lifting.root.mT, None), lifting)


@pytest.mark.slow
@pytest.mark.parametrize("name", MOVING)
def test_the_fewest_noise_free_tracks_give_the_scene(name):
    views, n = MOTIONS[name].minimal(torch.arange(6.0))
    truth, _, lifting, found, scene = solved(name, n, views=views, batch=(3,))
    assert found.status.tolist() == [Status.OK] * 3
    apart = error(truth, lifting, scene)
    assert float(apart.position.median()) < 1e-9
    assert float(apart.velocity.median()) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "n", "views"),
    [
        ("constant_velocity_2d", 60, 3),
        ("constant_direction_3d", 60, 3),
        ("constant_velocity_planes_3d", 60, 4),
        ("constant_velocity_3d", 60, 4),
        ("constant_acceleration_2d", 60, 4),
    ],
)
def test_noisy_tracks_lead_to_the_minimum_near_the_truth(name, n, views):
    truth, tracks, lifting, _, scene = solved(name, n, seed=1, views=views, sigma=0.5, batch=(6,))
    best = from_truth(truth, tracks, lifting)
    assert bool((scene.cost < 1.01 * best.cost).all())


def test_weak_acceleration_is_lost_by_the_tensor_alone(monkeypatch):
    # neither a second start nor the look at what lies behind cameras: costs are 40 to 100,000 times the least one
    monkeypatch.setattr(module, "MULTISTART_SIZE", 99)
    monkeypatch.setattr(module, "MAX_BEHIND_SHARE", 2.0)
    truth, tracks, lifting, _, scene = solved("constant_acceleration_2d", 60, seed=1, views=4, sigma=1.0, batch=(4,))
    assert (scene.cost > 2 * from_truth(truth, tracks, lifting).cost).sum() >= 3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["constant_velocity_3d", "constant_acceleration_2d"])
def test_where_no_views_share_enough_points_the_scene_is_found_without_a_tensor(name):
    truth, tracks, lifting, found, scene = solved(name, 50, views=9, sigma=0.5, missing=0.25, batch=(2,))
    assert found.status.tolist() == [Status.TOO_FEW] * 2
    assert bool((scene.cost < 1.01 * from_truth(truth, tracks, lifting).cost).all())


@pytest.mark.parametrize("name", ["constant_velocity_2d", "constant_velocity_3d", "constant_direction_3d"])
def test_the_frame_is_finite_round_and_brings_static_points_to_rest(name):
    truth, tracks, lifting, _, scene = solved(name, 60, views=6, static=0.3, batch=(2,))
    shown = fix_frame(replace(tracks, static=truth.labels == 1), scene, lifting)
    assert float(distances(tracks, shown.cameras @ lifting.lifts, shown.structure).max()) < 1e-6
    speed = velocities(shown.structure, lifting.start, lifting.slope)
    assert float(speed[truth.labels == 1].abs().max()) < 1e-6
    assert float(speed[truth.labels == 2].norm(dim=-1).mean()) > 1e-2
    path = torch.stack([positions(shown.structure, lift) for lift in lifting.lifts], dim=1)
    assert float(path.mean((1, 2)).abs().max()) < 1e-6
    torch.testing.assert_close(
        path.square().mean((1, 2)).sum(-1), torch.full((2,), path.shape[-1] * 1.0).double(), rtol=1e-3, atol=0
    )


def tracks_of(name, n=60, seed=0, **options):
    options = {"batch": (1,), **options}
    scene = scenes.lifted_points(name, n, generator=seeded(seed), **options)
    seen = scene.tracks.isfinite().all(-1).double()
    return scene, normalize_tracks(scene.tracks.nan_to_num(), seen, scene.times)


def tensor_of(name, times):
    motion = MOTIONS[name]
    return motion.tensor(min(motion.views(times), motion.k + 1))


@pytest.mark.parametrize(
    "name", ["constant_velocity_2d", "constant_velocity_planes_3d", "constant_velocity_3d_sensors", "two_bodies_3d"]
)
@pytest.mark.parametrize("more", [0, 2])
def test_noise_free_tracks_are_explained_exactly(name, more):
    views = MOTIONS[name].views(torch.arange(6.0)) + more
    _, tracks = tracks_of(name, views=views, batch=(2,))
    found = projections_of_tracks(tracks, tensor_of(name, tracks.times))
    assert found.status.tolist() == [Status.OK] * 2
    torch.testing.assert_close(reproject(found.projections, found.structure), tracks.x, rtol=0, atol=1e-9)
    assert bool((mean_error(tracks, found) < 1e-18).all())


def test_batch_equals_loop_and_a_failed_problem_stays_alone():
    _, tracks = tracks_of("constant_velocity_2d", views=4, batch=(3,), sigma=0.5)
    weights = tracks.weights.clone()
    weights[1, :, 5:] = 0  # too few for any tensor
    tracks = tracks.only(weights)
    invariant = tensor_of("constant_velocity_2d", tracks.times)
    found = projections_of_tracks(tracks, invariant)
    assert found.status.tolist() == [Status.OK, Status.TOO_FEW, Status.OK]
    assert not found.projections[1].any()
    assert not found.structure[1].any()
    for i in range(3):
        alone = projections_of_tracks(tracks.subset(torch.tensor([i])), invariant)
        images = reproject(alone.projections, alone.structure)
        torch.testing.assert_close(images[0], reproject(found.projections, found.structure)[i], rtol=1e-6, atol=1e-6)


def test_choices_are_all_views_or_those_seen_most_and_spread():
    _, tracks = tracks_of("constant_velocity_2d", views=3)
    assert view_subsets(tracks, 3).tolist() == [[[0, 1, 2]]]
    _, tracks = tracks_of("constant_velocity_2d", views=5)
    assert view_subsets(tracks, 3)[0, 0].tolist() == [0, 2, 4]
    weights = tracks.weights.clone()
    weights[:, 2, 10:] = 0
    assert not (view_subsets(tracks.only(weights), 3)[0, :3] == 2).any()
    _, tracks = tracks_of("constant_velocity_3d", views=12)
    few = view_subsets(tracks, 4)
    assert few.shape == (1, 6, 4)
    assert bool((few.diff(dim=-1) > 0).all())


@pytest.mark.parametrize("dim", [2, 3])
def test_a_scene_at_rest_is_explained_exactly_and_stands_before_all_cameras(dim):
    scene = scenes.lifted_points(f"static_{dim}d", 40, views=4, batch=(3,), generator=seeded())
    tracks = normalize_tracks(scene.tracks, torch.ones_like(scene.tracks[..., 0]), scene.times)
    cameras = static_cameras(tracks, 2, dim)
    points = triangulate(cameras, tracks.x)
    torch.testing.assert_close(reproject(cameras, points), tracks.x, rtol=0, atol=1e-9)
    points = points / points[..., -1:]
    depth = (points[:, None] @ cameras.mT)[..., -1]
    assert bool((depth * depth[:, :1, :1].sign() > 0).all())
    deviation = points[..., :-1].std(1)
    torch.testing.assert_close(deviation, torch.ones_like(deviation), rtol=0.05, atol=0)
