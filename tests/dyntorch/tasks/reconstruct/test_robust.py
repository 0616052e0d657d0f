"""Tests of the projections from tracks of which some are wrong."""

from __future__ import annotations

import pytest
import torch

from dyntorch import scenes
from dyntorch.core.outcome import Status
from dyntorch.geometry.triangulation import triangulate
from dyntorch.tasks.reconstruct.motions import MOTIONS
from dyntorch.tasks.reconstruct.reconstruct import normalize_tracks
from dyntorch.tasks.reconstruct.result import ReconstructOptions
from dyntorch.tasks.reconstruct.robust import bound, distance, freedom, have_outliers, noise, robust_projections, select_inliers
from dyntorch.tasks.reconstruct.scene import Lifting, distances, projections_of_tracks


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def tracks_of(images, times):
    return normalize_tracks(images.nan_to_num(), images.isfinite().all(-1).double(), times)


def problem(motion, n, batch=2, seed=0, **options):
    scene = scenes.lifted_points(motion, n, batch=batch, sigma=options.pop("sigma", 0.5), generator=generator(seed), **options)
    model = MOTIONS[motion]
    tracks = tracks_of(scene.tracks, scene.times)
    invariant = model.tensor(min(model.views(scene.times), model.k + 1))
    return scene, tracks, invariant, model.lift and Lifting.of(model, scene.times, tracks.x)


def kept_and_let_in(scene, fewer):
    right = scene.labels != 0
    seen = (fewer.weights > 0).any(1)
    return (seen & right).sum(-1) / right.sum(-1), (fewer.weights > 0).all(1) & ~right


@pytest.mark.slow
@pytest.mark.parametrize("limit", [1.5, None])
@pytest.mark.parametrize("motion", ["constant_velocity_2d", "constant_direction_3d"])
def test_a_third_of_the_tracks_may_be_wrong(motion, limit):
    scene, tracks, invariant, lifting = problem(motion, 60, outliers=0.3)
    found, fewer = robust_projections(tracks, invariant, lifting, limit, generator(1), options=ReconstructOptions())
    kept, wrong = kept_and_let_in(scene, fewer)
    assert found.status.tolist() == [Status.OK] * 2
    assert bool((kept > 0.9).all())
    assert int(wrong.sum()) <= 1
    truth = tracks.transforms @ scene.projections
    right = (scene.labels != 0).double()[:, None]
    apart = distance(tracks.only(tracks.weights * right), found.projections)
    best = distance(tracks.only(tracks.weights * right), truth)
    seen = right[:, 0] > 0
    assert bool(apart[seen].median() <= 1.2 * best[seen].median())


@pytest.mark.slow
def test_points_of_p5_in_planes():
    scene, tracks, invariant, lifting = problem("constant_velocity_planes_3d", 60, outliers=0.1)
    found, fewer = robust_projections(tracks, invariant, lifting, 1.5, generator(1), options=ReconstructOptions())
    kept, wrong = kept_and_let_in(scene, fewer)
    assert found.status.tolist() == [Status.OK] * 2
    assert bool((kept > 0.9).all())
    assert not bool(wrong.any())


def test_an_outlier_in_one_of_many_views_costs_that_observation_only():
    scene, tracks, invariant, lifting = problem("constant_velocity_2d", 40, views=6, outliers=0.3)
    found, fewer = robust_projections(tracks, invariant, lifting, 1.5, generator(1), options=ReconstructOptions())
    hit = (scene.tracks - scene.exact).norm(dim=-1) > 10
    assert found.status.tolist() == [Status.OK] * 2
    assert not bool((fewer.weights > 0)[hit].any())
    assert float((fewer.weights > 0)[~hit].double().mean()) > 0.97


@pytest.mark.slow
def test_no_consensus_among_mixed_tracks():
    scene, _, invariant, lifting = problem("constant_velocity_2d", 30, batch=1)
    mixed = torch.stack([scene.tracks[:, v].roll(7 * v, 1) for v in range(3)], dim=1)
    for limit in (1.5, None):
        found, _ = robust_projections(
            tracks_of(mixed, scene.times), invariant, lifting, limit, generator(1), options=ReconstructOptions()
        )
        assert found.status.tolist() == [Status.NO_CONSENSUS]
        assert bool(found.projections.isfinite().all())


@pytest.mark.slow
def test_exact_tracks_with_outliers_are_solved_exactly():
    scene, tracks, invariant, lifting = problem("constant_velocity_2d", 40, batch=1, sigma=0.0, outliers=0.2)
    found, fewer = robust_projections(tracks, invariant, lifting, None, generator(1), options=ReconstructOptions())
    kept, _ = kept_and_let_in(scene, fewer)
    assert found.status.tolist() == [Status.OK]
    assert float(kept) == 1.0
    assert float(distance(fewer, found.projections)[scene.labels != 0].max()) < 1e-12


def test_bodies_have_no_lift():
    scene, tracks, invariant, lifting = problem("two_bodies_3d", 60, batch=1, outliers=0.2)
    found, fewer = robust_projections(tracks, invariant, lifting, 1.5, generator(1), options=ReconstructOptions())
    kept, _ = kept_and_let_in(scene, fewer)
    assert found.status.tolist() == [Status.OK]
    assert float(kept) > 0.95


@pytest.mark.parametrize("sigma", [0.0, 0.5])
def test_clean_tracks_are_not_suspected(sigma):
    _, tracks, invariant, _ = problem("constant_velocity_2d", 60, batch=24, sigma=sigma)
    found = projections_of_tracks(tracks, invariant)
    apart = distances(tracks, found.projections, found.structure)
    assert float(have_outliers(tracks, apart, 4, None).double().mean()) <= 0.2
    assert float(have_outliers(tracks, apart, 4, 1.5).double().mean()) <= 0.1


@pytest.mark.parametrize("outliers", [0.02, 0.1, 0.3])
def test_outliers_are_suspected(outliers):
    _, tracks, invariant, _ = problem("constant_velocity_2d", 100, batch=8, outliers=outliers)
    found = projections_of_tracks(tracks, invariant)
    apart = distances(tracks, found.projections, found.structure)
    assert bool(have_outliers(tracks, apart, 4, None).all())
    assert bool(have_outliers(tracks, apart, 4, 1.5).all())


def test_distance_is_the_reprojection_error_of_the_triangulated_points():
    scene, tracks, _, _ = problem("constant_velocity_2d", 20)
    projections = tracks.transforms @ scene.projections
    structure = triangulate(projections, tracks.x, tracks.weights, steps=2)
    expected = distances(tracks, projections, structure).square().sum(1)
    assert torch.allclose(distance(tracks, projections), expected)
    # in pixels: chi square with two degrees of freedom
    assert 0.3 < float(noise(expected, freedom(tracks, 4), torch.ones(2, 20).bool()).mean()) < 0.75


def test_bound_is_the_quantile_of_chi_square():
    free = torch.tensor([0, 1, 2, 4])
    draws = torch.randn(200000, 4, generator=generator(), dtype=torch.float64).square()
    for part, limit in zip(free, bound(free, 0.9), strict=True):
        share = (draws[:, : int(part)].sum(-1) <= limit).double().mean()
        assert abs(float(share) - (0.9 if part else 1.0)) < 0.005


def test_agreeing_leaves_out_two_views_of_a_point():
    scene, _, _, _ = problem("constant_velocity_2d", 20, views=7, batch=1)
    images = scene.tracks.clone()
    images[0, 1, 3] += 40
    images[0, 5, 3] -= 30
    spoiled = tracks_of(images, scene.times)
    weights = select_inliers(spoiled, spoiled.transforms @ scene.projections, torch.tensor([0.6]).double())
    assert (weights[0, :, 3] > 0).tolist() == [True, False, True, True, True, False, True]
    assert bool((weights[0, :, :3] > 0).all())


def test_agreeing_drops_points_that_nothing_confirms():
    scene, _, _, _ = problem("constant_velocity_2d", 20, batch=1)
    images = scene.tracks.clone()
    images[0, 1, 3] += 60
    images[0, 2, 5] = torch.nan
    spoiled = tracks_of(images, scene.times)
    weights = select_inliers(spoiled, spoiled.transforms @ scene.projections, torch.tensor([0.6]).double())
    gone = (weights[0] == 0).all(0)
    assert bool(gone[3])
    assert bool(gone[5])  # two views of it say nothing but where it is
    assert int(gone.sum()) == 2
