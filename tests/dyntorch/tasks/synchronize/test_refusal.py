"""What two cameras cannot decide is refused, with a reason, and the best guess stays."""

import math

import pytest
import torch

from dyntorch.scenes import filmed
from dyntorch.tasks.synchronize.synchronize import synchronize

FRAME = 1 / 30
STRAIGHT = (None, None)
"""Calibration of cameras without distortion, so that none is looked for."""


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def film(seed=0, **more):
    return filmed(**{"n": 10, "seconds": 2.5, "noise": 1.0, "generator": seeded(seed)} | more)


def normal(seed, *shape):
    return torch.randn(*shape, generator=seeded(seed), dtype=torch.float64)


def assert_refused(shift, *words):
    """Refused in words, with numbers that are numbers."""
    assert not shift.ok
    assert any(word in shift.reason for word in words), shift.reason
    assert "\n" not in shift.reason
    assert math.isfinite(shift.offset) and math.isfinite(shift.center) and math.isfinite(shift.rate)
    assert 0 <= shift.confidence <= 1 and not math.isnan(shift.sigma)
    assert shift.peaks.ndim == 2 and shift.peaks.shape[1] == 2 and bool(shift.peaks.isfinite().all())
    assert "refused" in repr(shift)
    with pytest.raises(ValueError, match="synchronize: "):
        shift.check()


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "seed", "calibration"), [(0.0, 0, STRAIGHT), (1.0, 1, None)])
def test_exactly_periodic_motion(noise, seed, calibration):
    scene = film(seed, noise=noise, period=0.6, walk=0.0, offset=0.13)
    shift = synchronize(scene.a, scene.b, fps=30.0, max_shift=0.8, calibration=calibration)
    assert_refused(shift, "repeats itself")
    assert shift.confidence < 0.5
    offsets = shift.peaks[:, 0]
    others = shift.peaks[1:, 1].tolist()
    assert float(offsets[0]) == pytest.approx(shift.offset, abs=1e-9) and others == sorted(others, reverse=True)
    # the true one is among the peaks, and so are the others
    for period in (-0.6, 0.0, 0.6):
        assert float((offsets - 0.13 - period).abs().min()) < 0.5 * FRAME
    assert f"{float(offsets[0]):+.3g} s fits hardly better than" in shift.reason


def test_periodic_motion_within_a_period_is_decided():
    scene = film(0, period=0.8, walk=0.0, offset=0.23)
    shift = synchronize(scene.a, scene.b, fps=30.0, max_shift=0.35)
    assert shift.ok, shift.reason
    assert shift.offset == pytest.approx(0.23, abs=0.05 * FRAME)


def test_a_gait_that_crosses_the_room_is_refused_or_right():
    scene = film(1, period=0.8, walk=1.5, offset=0.23, n=15)
    shift = synchronize(scene.a, scene.b, fps=30.0, max_shift=1.2)
    assert float((shift.peaks[:, 0] - 0.23).abs().min()) < 0.5 * FRAME
    assert not shift.ok or shift.offset == pytest.approx(0.23, abs=0.1 * FRAME)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_nothing_moves(noise):
    still = film(2).exact
    a, b = (x[:1] + noise * normal(k, 50, 10, 2) for k, x in enumerate(still))
    shift = synchronize(a, b, fps=30.0, max_shift=0.3, calibration=STRAIGHT)
    assert_refused(shift, "motion is too small", "nothing moves", "repeats itself or is too small", "halves of the take")


@pytest.mark.slow
def test_unrelated_motion():
    a, b = film(0).a, film(50).b
    shift = synchronize(a, b, fps=30.0, max_shift=0.4)
    assert_refused(shift, "motion is too small", "repeats itself or is too small", "halves of the take", "end of the search")
    assert shift.confidence < 0.7


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "offset", "backwards"), [(0, 1.5, False), (8, 0.0, True)])
def test_wrong_shifts_are_not_made_to_fit_by_leaving_points_out(seed, offset, backwards):
    scene = film(seed, n=12, seconds=4.0, offset=offset)
    b = scene.b.flip(0) if backwards else scene.b
    shift = synchronize(scene.a, b, fps=30.0, max_shift=None if backwards else 1.0, calibration=STRAIGHT, camera="perspective")
    assert_refused(shift, "motion is too small", "repeats itself", "halves of the take", "fit", "end of the search")


def test_the_best_shift_is_at_the_end_of_the_search():
    scene = film(5, offset=0.5)
    shift = synchronize(scene.a, scene.b, fps=30.0, max_shift=0.5)
    assert_refused(shift, "lies at the end of the search or beyond; raise max_shift")
    assert shift.offset == pytest.approx(0.5, abs=0.1 * FRAME)


def test_clocks_too_far_apart_for_the_search():
    scene = film(6)
    shift = synchronize(scene.a, scene.b, times=(scene.times[0], scene.times[1] + 100), max_shift=1.0)
    assert_refused(shift, "raise max_shift")
    assert shift.sigma == math.inf and shift.confidence == 0 and len(shift.peaks) == 0
    found = synchronize(scene.a, scene.b, times=(scene.times[0], scene.times[1] + 100))
    assert found.ok and found.offset == pytest.approx(100, abs=0.1 * FRAME)


def test_points_are_never_seen_in_both():
    scene = film(7)
    a, b = scene.a.clone(), scene.b.clone()
    a[:50], b[40:] = torch.nan, torch.nan
    assert_refused(synchronize(a, b, fps=30.0, max_shift=0.2), "enough points")


@pytest.mark.parametrize("name", ["a", "b"])
def test_nothing_is_seen(name):
    scene = film(8)
    views = {"a": scene.a, "b": scene.b}
    views[name] = torch.full_like(views[name], torch.nan)
    shift = synchronize(views["a"], views["b"], fps=30.0)
    assert_refused(shift, f"no point is seen in {name}; check the detections")
    assert shift.fundamental is None and len(shift.lags) == 0
    weights = tuple(torch.zeros(scene.a.shape[:2]) if name == one else None for one in "ab")
    assert synchronize(scene.a, scene.b, fps=30.0, weights=weights).reason == shift.reason


@pytest.mark.slow
def test_the_halves_of_a_take_disagree():
    one, other = (film(9, seconds=3.0, offset=offset) for offset in (0.1, 0.5))
    b = torch.cat([one.b[:48], other.b[48:]])
    shift = synchronize(one.a, b, fps=30.0, max_shift=0.7, calibration=STRAIGHT)
    assert_refused(shift, "the halves of the take say", "repeats itself or is too small")
    assert min(abs(shift.offset - value) for value in (0.1, 0.5)) < 3 * FRAME
