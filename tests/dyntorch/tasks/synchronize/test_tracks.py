"""Tracks of one camera: smoothing against weighted least squares in numpy, noise against what was put in, and misuse."""

import math

import numpy as np
import pytest
import torch

from dyntorch.scenes import filmed_person
from dyntorch.tasks.synchronize.tracks import noise_ratio, read_tracks, reject_outliers, remove_positions, scale_frames, smooth_at
from tests.draws import seeded


def tracks_of(x, fps=30.0, times=None, weights=None):
    return read_tracks("a", x, None if times is not None else fps, times, weights)


def irregular(frames, seed=0):
    """Seconds of frames, some dropped, none where it should be, since 1970."""
    place = torch.arange(frames, dtype=torch.float64) + 0.3 * torch.rand(frames, generator=seeded(seed), dtype=torch.float64)
    return 1.7e9 + place[torch.rand(frames, generator=seeded(seed + 1)) > 0.1] / 30


def line(tracks, j, moment, width):
    """Position and velocity of point j by weighted least squares over all frames that show it."""
    t = tracks.times.numpy() - moment
    root = np.sqrt(tracks.weights[:, j].numpy() * np.exp(-0.5 * (t / width) ** 2))
    found = np.linalg.lstsq(root[:, None] * np.stack([np.ones_like(t), t], 1), root[:, None] * tracks.x[:, j].numpy(), rcond=None)
    return found[0]


@pytest.mark.parametrize("width", [1 / 30, 0.1])
def test_smoothing_is_weighted_least_squares_with_gaps_and_irregular_times(width):
    times = irregular(60)
    scene = filmed_person(5, times=(times, times), noise=2.0, missing=0.2, generator=seeded())
    weights = torch.rand(len(times), 5, generator=seeded(3), dtype=torch.float64)
    tracks = tracks_of(scene.a, times=times, weights=weights)
    at = times[0] + (times[-1] - times[0]) * torch.rand(25, generator=seeded(4), dtype=torch.float64)
    x, v, sure = smooth_at(tracks, at, width)
    known = (sure > 0).nonzero().tolist()
    assert len(known) > 50
    for i, j in known:
        position, velocity = line(tracks, j, float(at[i]), width)
        # the kernel ends at four standard deviations
        assert np.abs(x[i, j].numpy() - position).max() < 0.05
        assert np.abs(v[i, j].numpy() - velocity).max() < 0.05 / width
    assert not x[sure == 0].any() and not v[sure == 0].any()


def test_straight_motion_is_kept_exactly_and_gaps_have_no_weight():
    t = torch.arange(40, dtype=torch.float64) / 25
    x = torch.stack([100 + 30 * t, 50 - 80 * t], dim=-1)[:, None].clone()
    x[10:13] = torch.nan
    at = torch.linspace(0, 1.5, 33, dtype=torch.float64)
    found, v, sure = smooth_at(tracks_of(x, 25.0), at, 0.06)
    seen = sure[:, 0] > 0
    assert int(seen.sum()) > 25
    assert torch.allclose(found[seen, 0], torch.stack([100 + 30 * at, 50 - 80 * at], dim=-1)[seen], atol=1e-9)
    assert torch.allclose(v[seen, 0], torch.tensor([30.0, -80.0], dtype=torch.float64).expand(int(seen.sum()), 2), atol=1e-7)
    x = torch.zeros(60, 2, 2)
    x[20:40, 1] = torch.nan
    at = torch.tensor([-0.5, 0.5, 1.0, 1.5, 2.5], dtype=torch.float64)
    _, _, sure = smooth_at(tracks_of(x), at, 1 / 30)
    assert (sure > 0).tolist() == [[False, False], [True, True], [True, False], [True, True], [False, False]]
    assert torch.allclose(sure[1], torch.ones(2, dtype=torch.float64), atol=0.01)
    # and elsewhere that of the frames near by
    weights = torch.full((40, 1), 0.25)
    weights[20:] = 0.75
    _, _, sure = smooth_at(tracks_of(torch.zeros(40, 1, 2), weights=weights), torch.tensor([0.3, 1.0]).double(), 1 / 30)
    assert sure[:, 0].tolist() == pytest.approx([0.25, 0.75], rel=0.02)


def test_the_noise_is_that_put_in_and_of_two_cameras_compared_within_bounds():
    for sigma in (0.5, 2.0):
        scene = filmed_person(15, seconds=6.0, noise=sigma, missing=0.1, generator=seeded(2))
        assert tracks_of(scene.a).noise == pytest.approx(sigma, rel=0.15)
        scene = filmed_person(15, seconds=6.0, noise=sigma, outliers=0.05, generator=seeded(2))
        assert tracks_of(scene.a).noise == pytest.approx(1.25 * sigma, rel=0.15)  # four positions to a difference
    assert tracks_of(filmed_person(15, generator=seeded(2)).a).noise < 0.1
    scene = filmed_person(12, seconds=6.0, generator=seeded(1))
    noisy = [scene.exact[k] + torch.randn(scene.exact[k].shape, generator=seeded(k), dtype=torch.float64) for k in (0, 1)]
    a, b, large = tracks_of(noisy[0]), tracks_of(noisy[1]), tracks_of(3 * noisy[1])
    assert noise_ratio(a, b) == pytest.approx(1.0, rel=0.15)
    assert noise_ratio(a, large) == pytest.approx(3.0, rel=0.15)
    still = tracks_of(torch.zeros(30, 2, 2))
    assert math.isfinite(noise_ratio(still, a)) and math.isfinite(noise_ratio(a, still))
    straight = tracks_of(torch.arange(30.0, dtype=torch.float64)[:, None, None].expand(30, 2, 2))
    assert noise_ratio(a, straight) == pytest.approx(straight.scale / a.scale)  # by size, where noise says nothing
    wild = tracks_of(noisy[0] + 50 * torch.randn(noisy[0].shape, generator=seeded(5), dtype=torch.float64))
    assert noise_ratio(a, wild) == pytest.approx(2 * wild.scale / a.scale)


def test_missing_positions_and_weights_of_zero_are_the_same():
    x = torch.rand(20, 3, 2, generator=seeded())
    gone, weights = x.clone(), torch.ones(20, 3)
    gone[4, 1], weights[4, 1] = torch.nan, 0
    gone[7, 0, 1] = torch.inf
    weights[7, 0] = 0
    one, two = tracks_of(gone), tracks_of(x, weights=weights)
    assert torch.equal(one.x, two.x) and torch.equal(one.weights, two.weights)
    assert one.x.dtype == torch.float64
    cut = remove_positions(tracks_of(x), weights == 0)
    assert torch.equal(cut.x, one.x) and torch.equal(cut.weights, one.weights)
    assert torch.equal(one.only(torch.tensor([True, False, True])).x, one.x[:, [0, 2]])
    assert torch.allclose(tracks_of(torch.zeros(4, 1, 2), 25.0).times, torch.tensor([0, 0.04, 0.08, 0.12], dtype=torch.float64))
    found = tracks_of(torch.zeros(4, 1, 2), times=torch.tensor([5.0, 5.1, 5.2, 5.5]))
    assert found.step == pytest.approx(0.1, rel=1e-5) and found.times[0] == 5


GOOD, RISING = torch.zeros(5, 2, 2), torch.arange(5.0)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((torch.zeros(5, 2), 30.0, None, None), r"got \(5, 2\)"),
        ((GOOD, None, None, None), r"fps of a must be a positive number of frames per second, got None; or give times="),
        ((GOOD, 0.0, None, None), r"fps of a must be a positive number.*got 0.0"),
        ((GOOD, math.inf, None, None), r"fps of a .*got inf"),
        ((GOOD, math.nan, None, None), r"fps of a .*got nan"),
        ((GOOD, None, RISING.clone().index_fill(0, torch.tensor(2), math.nan), None), r"times of a must be 5 finite seconds"),
        ((GOOD, 30.0, None, -torch.ones(5, 2)), r"weights of a must be \(5, 2\), finite and not negative"),
        ((GOOD, 30.0, None, torch.full((5, 2), math.nan)), r"weights of a must be .* finite"),
    ],
)
def test_misuse_names_the_field_and_the_remedy(arguments, words):
    with pytest.raises(ValueError, match=words):
        read_tracks("a", *arguments)


def removed(before, after):
    return (before.weights > 0) & (after.weights == 0)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("noise", [0.0, 1.0, 4.0])
def test_good_positions_stay(seed, noise):
    tracks = tracks_of(filmed_person(15, seconds=4.0, noise=noise, missing=0.1, generator=seeded(seed)).a)
    after = reject_outliers(tracks)
    assert float(removed(tracks, after).sum() / (tracks.weights > 0).sum()) < 0.03
    kept = after.weights > 0
    assert torch.equal(after.x[kept], tracks.x[kept]) and not after.x[~kept].any()


@pytest.mark.parametrize("share", [0.03, 0.15])
def test_planted_outliers_go(share):
    for seed in range(3):
        scene = filmed_person(15, seconds=4.0, noise=1.0, outliers=share, generator=seeded(seed))
        tracks = tracks_of(scene.a)
        far = (tracks.x - scene.exact[0]).norm(dim=-1) > 15  # beyond doubt: 15 standard deviations
        gone = removed(tracks, reject_outliers(tracks))
        assert float((far & gone).sum() / far.sum()) > 0.93
        assert float((gone & ~far).sum() / (~far).sum()) < 0.03
        assert torch.equal(gone, removed(tracks, reject_outliers(tracks_of(4 * scene.a + 1000))))  # whatever the scale


def test_rounding_and_sudden_movements_stay():
    t = torch.arange(120, dtype=torch.float64) / 30
    step = 0.5 * torch.randn(80, 1, 2, generator=seeded(2), dtype=torch.float64)
    step[40:] += 200.0  # and stays there
    rest = 100 + 0.5 * torch.randn(100, 3, 2, generator=seeded(), dtype=torch.float64)
    rest[:, 1] = 100.0  # a detector that says exactly the same
    cases = {
        "whole pixels": ((100 + 0.3 * torch.randn(100, 4, 2, generator=seeded(), dtype=torch.float64)).round(), 15),
        "movement after rest": ((100 + 50 * torch.where(t > 2, (2 * torch.pi * t).sin(), 0.0))[:, None, None].expand(120, 1, 2), 2),
        "a step": (step, 4),  # at the step itself
        "rest": (rest, 6),
    }
    lost = {name: int(removed(tracks_of(x), reject_outliers(tracks_of(x))).sum()) for name, (x, _) in cases.items()}
    assert not {name: number for name, number in lost.items() if number > cases[name][1]}
    assert not removed(tracks_of(rest), reject_outliers(tracks_of(rest)))[:, 1].any()


def test_what_outliers_have_no_say_in():
    few = torch.randn(5, 2, 2, generator=seeded())
    assert torch.equal(reject_outliers(tracks_of(few)).weights, tracks_of(few).weights)
    x = filmed_person(5, seconds=2.0, noise=1.0, generator=seeded(4)).a
    weights = torch.rand(60, 5, generator=seeded(5), dtype=torch.float64)
    after = reject_outliers(tracks_of(x, weights=weights))
    kept = after.weights > 0
    assert torch.equal(after.weights[kept], weights[kept])
    x[:, 2] = torch.nan
    after = reject_outliers(tracks_of(x))
    assert not after.weights[:, 2].any() and after.x.isfinite().all()


def scene(**more):
    return filmed_person(11, seconds=4.0, generator=seeded(), **more)


def test_place_and_distance_are_taken_out_whatever_one_point_does():
    x = scene(walk=0.0).a
    t = torch.arange(120, dtype=torch.float64)[:, None, None] / 30
    path = torch.cat([300 * (0.7 * t).sin(), 20 * t], dim=-1)
    # constant factors change the unit alone
    one, moved = scale_frames(tracks_of(x)), scale_frames(tracks_of(3 * x + path))
    assert torch.allclose(moved.x, 3 * one.x, atol=1e-6)
    slow = 1 + 0.2 * t / 4  # somebody who comes nearer
    near = scale_frames(tracks_of(slow * x))
    ratio = (near.x.norm(dim=-1) / one.x.norm(dim=-1).clamp(min=1e-9))[15:-15].median(1).values
    assert float(ratio.max() / ratio.min()) < 1.03  # of 1.15
    tracks = tracks_of(scene(noise=1.0).a)
    x = tracks.x.clone()
    x[:, 4] += 500.0
    good, bad = scale_frames(tracks), scale_frames(tracks_of(x))
    rest = torch.arange(11) != 4
    away = (good.x - bad.x)[:, rest].norm(dim=-1)
    assert float(away.median()) < 0.2 * float(good.x[:, rest].norm(dim=-1).median())
    for frames in (1, 2):
        for x in (torch.rand(frames, 5, 2, generator=seeded(1)), torch.full((frames, 5, 2), torch.nan)):
            assert bool(scale_frames(tracks_of(x)).x.isfinite().all())


def test_medians_of_every_frame_are_nought_and_missing_positions_stay_missing():
    x = scene(noise=1.0, missing=0.3).a
    x[50] = torch.nan
    assert torch.allclose(scale_frames(tracks_of(scene(noise=1.0).a)).x.median(1).values, torch.zeros(120, 2).double(), atol=1e-9)
    found = scale_frames(tracks_of(x))
    assert bool(found.x.isfinite().all()) and not found.x[found.weights == 0].any()
    assert torch.equal(found.weights > 0, x.isfinite().all(-1))
