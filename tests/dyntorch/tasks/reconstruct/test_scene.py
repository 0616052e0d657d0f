"""Scenes from projections: exact without noise, at the minimum that the truth leads to with it, with many gaps as well."""

from dataclasses import replace

import pytest
import torch

from dyntorch import metrics, scenes
from dyntorch.core.outcome import Status
from dyntorch.tasks.reconstruct import scene as module
from dyntorch.tasks.reconstruct.motions import MOTIONS
from dyntorch.tasks.reconstruct.reconstruct import normalize_tracks
from dyntorch.tasks.reconstruct.scene import (
    LiftedState,
    Lifting,
    adjust_scene,
    distances,
    fix_frame,
    positions,
    projections_of_tracks,
    scene_of,
    velocities,
)

MOVING = [name for name, motion in MOTIONS.items() if motion.lift is not None and not motion.static]


def solved(name, n, seed=0, **options):
    """Truth, tracks, lifting, projections and scene."""
    options = {"batch": (1,), **options}
    truth = scenes.lifted_points(name, n, generator=torch.Generator().manual_seed(seed), **options)
    seen = truth.tracks.isfinite().all(-1).double()
    tracks = normalize_tracks(truth.tracks.nan_to_num(), seen, truth.times)
    motion = MOTIONS[name]
    lifting = Lifting.of(motion, truth.times, tracks.x)
    found = projections_of_tracks(tracks, motion.tensor(min(motion.views(truth.times), motion.k + 1)))
    return truth, tracks, lifting, found, scene_of(tracks, found, lifting)


def error(truth, lifting, scene):
    return metrics.lifted_error(scene.structure @ torch.linalg.inv(lifting.root).mT, truth.structure, truth.lifts)


def from_truth(truth, tracks, lifting):
    return adjust_scene(
        tracks,
        LiftedState(tracks.transforms @ truth.cameras, truth.structure @ lifting.root.mT, None),
        lifting,
    )


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


def test_no_scene_costs_infinity_and_leaves_the_others_alone():
    _, tracks, lifting, found, scene = solved("constant_velocity_3d", 60, views=4, sigma=0.2, batch=(3,))
    weights = tracks.weights.clone()
    weights[1, :, 8:] = 0
    tracks = tracks.only(weights)
    found = projections_of_tracks(tracks, MOTIONS["constant_velocity_3d"].tensor(4))
    again = scene_of(tracks, found, lifting)
    assert bool(again.cost[1].isinf())
    torch.testing.assert_close(again.cost[[0, 2]], scene.cost[[0, 2]], rtol=1e-6, atol=0)


@pytest.mark.slow
def test_batch_equals_loop():
    _, tracks, lifting, found, scene = solved("constant_velocity_3d", 60, views=4, sigma=0.2, batch=(2,))
    for i in range(2):
        one = torch.tensor([i])
        part = replace(found, projections=found.projections[one], structure=found.structure[one], status=found.status[one])
        alone = scene_of(tracks.subset(one), part, lifting)
        torch.testing.assert_close(alone.cost, scene.cost[one], rtol=1e-5, atol=0)


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


def test_velocities_are_the_derivatives_of_positions():
    _, _, lifting, _, scene = solved("constant_acceleration_2d", 60, views=6)
    motion, inverse = MOTIONS["constant_acceleration_2d"], torch.linalg.inv(lifting.root)
    before, after = (positions(scene.structure, motion.lifts([t])[0] @ inverse) for t in (-1e-4, 1e-4))
    expected = (after - before) / 2e-4
    torch.testing.assert_close(velocities(scene.structure, lifting.start, lifting.slope), expected, rtol=1e-4, atol=1e-6)
