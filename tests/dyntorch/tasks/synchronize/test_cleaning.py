"""Positions that are elsewhere: planted ones go, good ones stay."""

import pytest
import torch

from dyntorch.scenes import filmed
from dyntorch.tasks.synchronize.tracks import read_tracks, reject_outliers


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def tracks_of(x):
    return read_tracks("a", x, 30.0, None, None)


def removed(before, after):
    return (before.weights > 0) & (after.weights == 0)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("noise", [0.0, 1.0, 4.0])
def test_good_positions_stay(seed, noise):
    tracks = tracks_of(filmed(15, seconds=4.0, noise=noise, missing=0.1, generator=seeded(seed)).a)
    after = reject_outliers(tracks)
    assert float(removed(tracks, after).sum() / (tracks.weights > 0).sum()) < 0.03
    kept = after.weights > 0
    assert torch.equal(after.x[kept], tracks.x[kept]) and not after.x[~kept].any()


@pytest.mark.parametrize("share", [0.03, 0.15])
def test_planted_outliers_go(share):
    for seed in range(3):
        scene = filmed(15, seconds=4.0, noise=1.0, outliers=share, generator=seeded(seed))
        tracks = tracks_of(scene.a)
        far = (tracks.x - scene.exact[0]).norm(dim=-1) > 15  # beyond doubt: 15 standard deviations
        gone = removed(tracks, reject_outliers(tracks))
        assert float((far & gone).sum() / far.sum()) > 0.93
        assert float((gone & ~far).sum() / (~far).sum()) < 0.03


def test_one_wrong_position_goes_and_nothing_else():
    x = filmed(6, seconds=2.0, noise=0.5, generator=seeded(1)).a
    before = reject_outliers(tracks_of(x))
    x[30, 2] += 40
    after = reject_outliers(tracks_of(x))
    assert after.weights[30, 2] == 0
    assert int((before.weights != after.weights).sum()) <= 2


def test_a_point_at_rest_keeps_its_positions():
    x = 100 + 0.5 * torch.randn(100, 3, 2, generator=seeded(), dtype=torch.float64)
    x[:, 1] = 100.0  # a detector that says exactly the same
    tracks = tracks_of(x)
    assert float(removed(tracks, reject_outliers(tracks)).float().mean()) < 0.02
    assert not removed(tracks, reject_outliers(tracks))[:, 1].any()


def test_positions_in_whole_pixels_stay():
    x = (100 + 0.3 * torch.randn(100, 4, 2, generator=seeded(), dtype=torch.float64)).round()
    tracks = tracks_of(x)
    assert float(removed(tracks, reject_outliers(tracks)).float().mean()) < 0.02


def test_movement_after_rest_stays():
    t = torch.arange(120, dtype=torch.float64) / 30
    x = (100 + 50 * torch.where(t > 2, (2 * torch.pi * t).sin(), 0.0))[:, None, None].expand(120, 1, 2)
    tracks = tracks_of(x)
    assert int(removed(tracks, reject_outliers(tracks)).sum()) <= 2


def test_a_sudden_movement_stays():
    x = 0.5 * torch.randn(80, 1, 2, generator=seeded(2), dtype=torch.float64)
    x[40:] += 200.0  # and stays there
    tracks = tracks_of(x)
    assert int(removed(tracks, reject_outliers(tracks)).sum()) <= 4  # at the step itself


def test_what_scale_the_picture_has_does_not_matter():
    x = filmed(8, seconds=2.0, noise=1.0, outliers=0.1, generator=seeded(3)).a
    one, two = reject_outliers(tracks_of(x)), reject_outliers(tracks_of(4 * x + 1000))
    assert torch.equal(one.weights, two.weights)


def test_a_take_of_a_few_frames_is_left_alone():
    x = torch.randn(5, 2, 2, generator=seeded())
    assert torch.equal(reject_outliers(tracks_of(x)).weights, tracks_of(x).weights)


def test_weights_that_were_given_are_kept():
    x = filmed(5, seconds=2.0, noise=1.0, generator=seeded(4)).a
    weights = torch.rand(60, 5, generator=seeded(5), dtype=torch.float64)
    after = reject_outliers(read_tracks("a", x, 30.0, None, weights))
    kept = after.weights > 0
    assert torch.equal(after.weights[kept], weights[kept])


def test_a_point_never_seen_does_no_harm():
    x = filmed(5, seconds=2.0, noise=1.0, generator=seeded(4)).a
    x[:, 2] = torch.nan
    after = reject_outliers(tracks_of(x))
    assert not after.weights[:, 2].any() and after.x.isfinite().all()
