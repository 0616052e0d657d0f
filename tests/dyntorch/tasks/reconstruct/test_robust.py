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
from dyntorch.tasks.reconstruct.robust import distance, freedom, have_outliers, noise, robust_projections, select_inliers
from dyntorch.tasks.reconstruct.scene import Lifting, distances, projections_of_tracks
from tests.draws import seeded


def tracks_of(images, times):
    return normalize_tracks(images.nan_to_num(), images.isfinite().all(-1).double(), times)


def problem(motion, n, batch=2, seed=0, **options):
    scene = scenes.lifted_points(motion, n, batch=batch, sigma=options.pop("sigma", 0.5), generator=seeded(seed), **options)
    model = MOTIONS[motion]
    tracks = tracks_of(scene.tracks, scene.times)
    invariant = model.tensor(min(model.views(scene.times), model.k + 1))
    return scene, tracks, invariant, model.lift and Lifting.of(model, scene.times, tracks.x)


def kept_and_let_in(scene, fewer):
    right = scene.labels != 0
    seen = (fewer.weights > 0).any(1)
    return (seen & right).sum(-1) / right.sum(-1), (fewer.weights > 0).all(1) & ~right


@pytest.mark.slow
@pytest.mark.parametrize(
    ("motion", "limit", "outliers"),
    [
        *((motion, limit, 0.3) for motion in ("constant_velocity_2d", "constant_direction_3d") for limit in (1.5, None)),
        ("constant_velocity_planes_3d", 1.5, 0.1),
    ],
)
def test_a_third_of_the_tracks_may_be_wrong(motion, limit, outliers):
    scene, tracks, invariant, lifting = problem(motion, 60, outliers=outliers)
    found, fewer = robust_projections(tracks, invariant, lifting, limit, seeded(1), options=ReconstructOptions())
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


def test_an_outlier_in_one_of_many_views_costs_that_observation_only():
    scene, tracks, invariant, lifting = problem("constant_velocity_2d", 40, views=6, outliers=0.3)
    found, fewer = robust_projections(tracks, invariant, lifting, 1.5, seeded(1), options=ReconstructOptions())
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
            tracks_of(mixed, scene.times), invariant, lifting, limit, seeded(1), options=ReconstructOptions()
        )
        assert found.status.tolist() == [Status.NO_CONSENSUS]
        assert bool(found.projections.isfinite().all())


@pytest.mark.slow
def test_exact_tracks_with_outliers_are_solved_exactly():
    scene, tracks, invariant, lifting = problem("constant_velocity_2d", 40, batch=1, sigma=0.0, outliers=0.2)
    found, fewer = robust_projections(tracks, invariant, lifting, None, seeded(1), options=ReconstructOptions())
    kept, _ = kept_and_let_in(scene, fewer)
    assert found.status.tolist() == [Status.OK]
    assert float(kept) == 1.0
    assert float(distance(fewer, found.projections)[scene.labels != 0].max()) < 1e-12


def test_bodies_have_no_lift():
    scene, tracks, invariant, lifting = problem("two_bodies_3d", 60, batch=1, outliers=0.2)
    found, fewer = robust_projections(tracks, invariant, lifting, 1.5, seeded(1), options=ReconstructOptions())
    kept, _ = kept_and_let_in(scene, fewer)
    assert found.status.tolist() == [Status.OK]
    assert float(kept) > 0.95


@pytest.mark.parametrize(("sigma", "outliers"), [(0.0, 0.0), (0.5, 0.0), (0.5, 0.02), (0.5, 0.1), (0.5, 0.3)])
def test_outliers_are_suspected_and_clean_tracks_are_not(sigma, outliers):
    _, tracks, invariant, _ = problem("constant_velocity_2d", 100 if outliers else 60, batch=16, sigma=sigma, outliers=outliers)
    found = projections_of_tracks(tracks, invariant)
    apart = distances(tracks, found.projections, found.structure)
    for limit, few in ((None, 0.2), (1.5, 0.1)):
        share = float(have_outliers(tracks, apart, 4, limit).double().mean())
        assert share == 1 if outliers else share <= few


def test_distance_is_the_reprojection_error_of_the_triangulated_points():
    scene, tracks, _, _ = problem("constant_velocity_2d", 20)
    projections = tracks.transforms @ scene.projections
    structure = triangulate(projections, tracks.x, tracks.weights, steps=2)
    expected = distances(tracks, projections, structure).square().sum(1)
    assert torch.allclose(distance(tracks, projections), expected)
    # in pixels: chi square with two degrees of freedom
    assert 0.3 < float(noise(expected, freedom(tracks, 4), torch.ones(2, 20).bool()).mean()) < 0.75


@pytest.mark.parametrize(
    ("views", "astray", "seen"),
    [(7, {(1, 3): 40, (5, 3): -30}, {3: [0, 2, 3, 4, 6]}), (3, {(1, 3): 60, (2, 5): torch.nan}, {3: [], 5: []})],
)
def test_views_that_disagree_are_left_out_and_points_that_nothing_confirms_drop_out(views, astray, seen):
    scene, _, _, _ = problem("constant_velocity_2d", 20, views=views, batch=1)
    images = scene.tracks.clone()
    for (view, point), off in astray.items():
        images[0, view, point] += off
    spoiled = tracks_of(images, scene.times)
    weights = select_inliers(spoiled, spoiled.transforms @ scene.projections, torch.tensor([0.6]).double())
    for point in range(20):
        assert (weights[0, :, point] > 0).nonzero().flatten().tolist() == seen.get(point, list(range(views)))
