"""Projections and points of P^k from tracks: choices of views, exactness, failures as data."""

import pytest
import torch

from dyntorch import scenes
from dyntorch.core.outcome import Status
from dyntorch.geometry.triangulation import reproject
from dyntorch.tasks.reconstruct.motions import MOTIONS
from dyntorch.tasks.reconstruct.reconstruct import normalize_tracks
from dyntorch.tasks.reconstruct.scene import Projections, ViewTracks, mean_error, projections_of_tracks, view_subsets


def tracks_of(name, n=60, seed=0, **options):
    options = {"batch": (1,), **options}
    scene = scenes.lifted_points(name, n, generator=torch.Generator().manual_seed(seed), **options)
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


def test_mean_error_is_that_of_each_observation_and_counts_lost_points():
    _, tracks = tracks_of("constant_velocity_2d", n=13, views=3, sigma=0.5)
    draw = torch.Generator().manual_seed(1)
    M = torch.rand(1, 3, 3, 5, generator=draw, dtype=torch.float64)
    Y = torch.rand(1, 13, 5, generator=draw, dtype=torch.float64)
    Y[0, 4] = 0
    total = 0.0
    for v in range(3):
        for j in range(13):
            q = M[0, v] @ Y[0, j]
            error = 1.0 if j == 4 else float((tracks.x[0, v, j] - q[:2] / q[2]).square().sum())
            total += float(tracks.weights[0, v, j]) * error
    found = Projections(M, Y, torch.zeros(1, dtype=torch.long))
    assert float(mean_error(tracks, found)) == pytest.approx(total / 39)


def test_parts_of_tracks():
    _, tracks = tracks_of("constant_velocity_2d", views=4, batch=(2,))
    some = tracks.at(torch.tensor([3, 1]))
    assert torch.equal(some.x[:, 0], tracks.x[:, 3])
    assert some.times.tolist() == [3.0, 1.0]
    twice = tracks.repeat(2)
    assert isinstance(twice, ViewTracks)
    assert torch.equal(twice.x[0], twice.x[1])
    assert torch.equal(twice.x[2], tracks.x[1])
    assert torch.equal(tracks.subset(torch.tensor([1])).weights[0], tracks.weights[1])
