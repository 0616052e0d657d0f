"""Whole calibrations of smooth motion: against rigs that are known, and refused where nothing decides."""

import math

import pytest
import torch

import dyntorch as dyn
from dyntorch.tasks.calibrate.result import CalibrationNotice as Told
from tests.dyntorch.tasks.calibrate.rigs import F64, Motion, angles, exponential, filmed, pictures, shape_error

SIZE = (1920, 1080)


def calibrated(take, **given):
    given = {"fps": 30.0, "sizes": SIZE, **given}
    return dyn.calibrate(take.tracks, **given)


def near(rig, take, degrees=0.1, focal=0.003, place=0.003):
    """The kernel of one frame shortens what swings fast by a thousandth: that is what is left of exact data."""
    assert rig.ok, rig.reason
    assert float(angles(rig.R, take.R).max()) < degrees
    assert rig.focals.tolist() == pytest.approx(take.focals, rel=focal)
    assert shape_error(rig.centers, take.centers) < place


def codes(rig):
    return {notice.code for notice in rig.notices}


@pytest.mark.slow
def test_unknown_clocks_and_lenses():
    take = filmed(Motion(), offsets=[0.0, 0.25, -0.31, 0.1], focals=[1500.0, 1300.0, 1700.0, 1400.0], frames=130)
    rig = calibrated(take, max_shift=1.0, rate=1.0)
    near(rig, take, degrees=0.2, focal=0.006, place=0.006)
    assert rig.clocks.offsets.tolist() == pytest.approx([0.0, 0.25, -0.31, 0.1], abs=0.002)
    assert rig.points.shape == (len(rig.times), 8, 3) and rig.check() is rig and not rig.metric
    assert all(part.dtype == F64 for part in (rig.K, rig.R, rig.points, rig.covariance))


@pytest.mark.slow
def test_lens_clocks_given_and_projection():
    take = filmed(Motion(seed=1), k1=-0.1, offsets=[0.0, 0.2, -0.1, 0.3])
    forms = ([0.0, 0.2, -0.1, 0.3], torch.tensor([[0.0, 1.0], [0.2, 1.0], [-0.1, 1.0], [0.3, 1.0]], dtype=F64))
    first, second = (calibrated(take, clocks=clocks, focal=1500.0) for clocks in forms)
    third = calibrated(take, clocks=first.clocks, focal=1500.0)
    near(first, take)
    assert torch.allclose(first.distortion[:, 0], torch.tensor(-0.1, dtype=F64), atol=0.01)
    for other in (second, third):
        assert torch.allclose(first.points, other.points, equal_nan=True, atol=1e-9)
    assert float(first.covariance[:, 6].abs().max()) == float(first.covariance[:, 9:].abs().max()) == 0.0
    seen = first.project(first.points)
    for i in range(4):
        lens = first.distortion[i, :2].tolist()
        own = pictures(first.points, first.R[i], first.t[i], first.focals[i], *lens)
        assert torch.allclose(seen[i], own, equal_nan=True, atol=1e-6)
    # what is seen again is what was filmed
    at = first.times
    truth = pictures(Motion(seed=1)(at), take.R[0], take.t[0], 1500.0, -0.1)
    assert float((seen[0] - truth).norm(dim=-1).nanmedian()) < 2.0


@pytest.mark.slow
def test_given_lenses_with_pixels_that_are_not_square():
    take = filmed(Motion(seed=2), k1=-0.15, cameras=3)
    wide = torch.tensor([1.0, 1.04], dtype=F64)
    take.tracks[1] = take.tracks[1] * wide
    K = torch.diag(torch.tensor([1500.0, 1500.0, 1.0], dtype=F64))
    K[:2, 2] = torch.tensor([960.0, 540.0], dtype=F64)
    stretched = torch.diag(torch.tensor([1.0, 1.04, 1.0], dtype=F64)) @ K
    dist = torch.tensor([-0.15, 0.0, 0.0, 0.0, 0.0], dtype=F64)
    rig = calibrated(take, calibration=[(K, dist), (stretched, dist), (K, dist)], clocks=[0.0] * 3)
    near(rig, take)
    assert torch.allclose(rig.K[1], stretched) and torch.allclose(rig.distortion, dist.expand(3, 5))


@pytest.mark.slow
def test_noise_gaps_weights_float32_and_uneven_times():
    draw = torch.Generator().manual_seed(5)
    times = [torch.arange(110, dtype=F64) / 30 + 0.004 * (torch.rand(110, generator=draw, dtype=F64) - 0.5) for _ in range(4)]
    take = filmed(Motion(seed=3), noise=0.5, times=times)
    weights = [torch.ones(110, 8) for _ in range(4)]
    tracks = [x.clone() for x in take.tracks]
    for i in range(4):
        tracks[i][10 * i + 20 : 10 * i + 28, i] = math.nan
        tracks[i][40:60, 7 - i] += 300.0
        weights[i][40:60, 7 - i] = 0.0
    rig = dyn.calibrate([x.float() for x in tracks], times=times, sizes=SIZE, weights=weights, clocks=[0.0] * 4, one_lens=True)
    near(rig, take, degrees=0.5, focal=0.02, place=0.02)
    assert float(rig.focals.std()) < 1e-6 and rig.K.dtype == F64
    assert 0.05 < float(rig.residuals.nanmedian()) < 1.5 and float(rig.inliers.min()) > 0.9


@pytest.mark.slow
def test_several_people_and_a_length_that_is_known():
    one, two = Motion(4, 4), Motion(4, 5, (0.8, 0.0, 0.3))
    take = filmed(lambda t: torch.cat([one(t), two(t), one(t)[:, :1] + torch.tensor([0.0, 0.5, 0.0])], 1), cameras=3)
    rig = calibrated(take, clocks=[0.0] * 3, lengths={(0, 8): 0.5})
    near(rig, take)
    assert rig.metric and float(torch.pdist(rig.centers).max()) == pytest.approx(float(torch.pdist(take.centers).max()), rel=0.01)


@pytest.mark.slow
def test_the_order_of_cameras_and_points_changes_nothing():
    take = filmed(Motion(seed=6), cameras=3, noise=0.3)
    rig = calibrated(take, clocks=[0.0] * 3)
    order, points = [2, 0, 1], torch.tensor([3, 0, 7, 1, 2, 6, 5, 4])
    other = dyn.calibrate([take.tracks[i][:, points] for i in order], sizes=SIZE, clocks=[0.0] * 3)
    assert rig.ok and other.ok
    assert other.focals.tolist() == pytest.approx(rig.focals[order].tolist(), rel=1e-3)
    assert shape_error(other.centers, rig.centers[order]) < 1e-3
    assert float(angles(other.R, rig.R[order]).max()) < 0.05


def refused(rig, *expected):
    assert not rig.ok and codes(rig) & set(expected), (codes(rig), rig.reason)
    with pytest.raises(ValueError, match="calibrate: "):
        rig.check()
    return rig


@pytest.mark.slow
def test_two_cameras_need_a_focal_length():
    take = filmed(Motion(seed=1), cameras=2)
    refused(calibrated(take, clocks=[0.0, 0.0]), Told.TWO_FOCALS)
    rig = calibrated(take, clocks=[0.0, 0.0], focal=1500.0)
    near(rig, take)
    assert Told.TWO in codes(rig)


def test_nobody_moves():
    still = Motion(8)(torch.zeros(1, dtype=F64))
    take = filmed(lambda t: still.expand(len(t), 8, 3), cameras=3, noise=1.0)
    rig = refused(calibrated(take, clocks=[0.0] * 3), Told.STILL)
    assert bool(rig.R.isnan().all()) and bool(rig.K.isnan().all()) and len(rig.times) == 0


@pytest.mark.slow
def test_motion_in_a_plane():
    flat, turn = Motion(seed=2, flat=True), exponential(torch.tensor([-0.6, 0.7, 0.0]))  # no camera sees the plane from its edge
    take = filmed(lambda t: flat(t) @ turn.mT, cameras=3, noise=2.0)
    refused(calibrated(take, clocks=[0.0] * 3), Told.PLANE)


@pytest.mark.slow
def test_a_camera_that_shows_something_else():
    take = filmed(Motion(seed=3), cameras=4, noise=0.5)
    take.tracks[2] = filmed(Motion(seed=9), cameras=4, noise=0.5).tracks[2]
    refused(calibrated(take, clocks=[0.0] * 4), Told.DISAGREES, Told.RIVAL, Told.FOCAL, Told.ROTATION)


@pytest.mark.slow
def test_a_camera_that_moved():
    take = filmed(Motion(seed=4), cameras=4, frames=240, noise=0.5)
    turn = exponential(torch.tensor([0.0, 0.08, 0.0]))
    after = pictures(Motion(seed=4)(take.times[1]), turn @ take.R[1], turn @ take.t[1], 1500.0)
    take.tracks[1][120:] = after[120:]
    refused(calibrated(take, clocks=[0.0] * 4, focal=1500.0), Told.MOVED, Told.DISAGREES)


@pytest.mark.slow
def test_clocks_that_nothing_decides():
    still = Motion(8)(torch.zeros(1, dtype=F64))
    take = filmed(lambda t: still.expand(len(t), 8, 3), cameras=3, frames=60, noise=1.0)
    rig = refused(calibrated(take, max_shift=0.5, rate=1.0), Told.CLOCKS)
    assert rig.R.shape == (3, 3, 3)


@pytest.mark.slow
def test_options_decide():
    take = filmed(Motion(seed=2), cameras=3, frames=90, noise=0.5)

    def rig(**options):
        return calibrated(take, clocks=[0.0] * 3, options=dyn.CalibrateOptions(**options))

    whole = rig()
    assert whole.ok
    for options, told in (
        ({"min_matches": 10_000}, Told.APART),
        ({"max_focal_sigma": 1e-9}, Told.FOCAL),
        ({"max_rotation_sigma": 1e-9}, Told.ROTATION),
        ({"max_center_sigma": 1e-9}, Told.CENTER),
    ):
        refused = rig(**options)
        assert not refused.ok and told in codes(refused), options
    # other cameras from a third of the moments, but the same rig
    few = rig(max_positions=30 * 8)
    near(few, take, degrees=0.3, focal=0.01, place=0.01)
    assert not torch.equal(few.focals, whole.focals)
