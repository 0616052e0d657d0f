"""Starts without a tensor: exact for a scene at rest, and frames that differ by a collineation of the world."""

import pytest
import torch

from dyntorch import scenes
from dyntorch.geometry.triangulation import reproject, triangulate
from dyntorch.tasks.reconstruct.motions import MOTIONS
from dyntorch.tasks.reconstruct.reconstruct import normalize_tracks
from dyntorch.tasks.reconstruct.scene import middle_views, static_cameras, static_constants, tilt_infinity


@pytest.mark.parametrize("dim", [2, 3])
def test_a_scene_at_rest_is_explained_exactly_and_stands_before_all_cameras(dim):
    scene = scenes.lifted_points(f"static_{dim}d", 40, views=4, batch=(3,), generator=torch.Generator().manual_seed(0))
    tracks = normalize_tracks(scene.tracks, torch.ones_like(scene.tracks[..., 0]), scene.times)
    cameras = static_cameras(tracks, 2, dim)
    points = triangulate(cameras, tracks.x)
    torch.testing.assert_close(reproject(cameras, points), tracks.x, rtol=0, atol=1e-9)
    points = points / points[..., -1:]
    depth = (points[:, None] @ cameras.mT)[..., -1]
    assert bool((depth * depth[:, :1, :1].sign() > 0).all())
    deviation = points[..., :-1].std(1)
    torch.testing.assert_close(deviation, torch.ones_like(deviation), rtol=0.05, atol=0)


def test_frames_are_collineations_of_the_first():
    cameras = torch.rand(2, 4, 3, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert torch.equal(tilt_infinity(cameras, 0), cameras)
    frames = [torch.linalg.lstsq(cameras.flatten(0, 2), tilt_infinity(cameras, k).flatten(0, 2)).solution for k in (1, 2)]
    for frame in frames:
        torch.testing.assert_close(frame[:-1], torch.eye(4, dtype=torch.float64)[:-1])
    assert not torch.allclose(frames[0], frames[1])


def test_constants_of_resting_points_do_not_move_them():
    times = torch.arange(4.0)
    lifts = MOTIONS["constant_velocity_3d"].lifts(times)
    still = static_constants(lifts)
    assert still.shape == (7, 4)
    torch.testing.assert_close(still.mT @ still, torch.eye(4, dtype=torch.float64))
    places = lifts @ still
    torch.testing.assert_close(places, places[:1].expand_as(places))
    always = torch.stack([torch.eye(3, 4, dtype=torch.float64).roll(int(t), 1) for t in range(4)])
    assert static_constants(always).shape == (4, 0)


def test_middle_views_are_neighbours_in_time():
    assert middle_views(torch.tensor([0.0, 1.0, 2.0])).tolist() == [0, 1, 2]
    many = torch.tensor([7.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    assert middle_views(many).tolist() == [2, 3, 4, 5, 6, 7]
    assert middle_views(many, 1).tolist() == [2, 3, 4, 5, 6]
