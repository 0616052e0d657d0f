"""Cameras that see different points: clocks, rates, refusal, and what must not matter."""

import math

import numpy as np
import pytest
import torch

from dyntorch import scenes
from dyntorch.tasks.synchronize.different_points import _refuse_coarse
from dyntorch.tasks.synchronize.subspace import SubspaceShift
from dyntorch.tasks.synchronize.synchronize import synchronize
from tests.draws import random, seeded

FRAME = 1 / 30


def uniform(seed, *shape):
    return torch.rand(*shape, generator=seeded(seed), dtype=torch.float64)


class Body:
    """A body that moves in a few ways that never repeat; every point is a mix of them, in affine cameras."""

    def __init__(self, seed=0, ways=6):
        self.places = 0.3 * torch.arange(400, dtype=torch.float64) - 20
        self.values = random(400, ways, seed=seed)

    def film(self, times, points, key, noise=0.5):
        near = torch.exp(-0.5 * ((times[:, None] - self.places) / 0.25).square())  # smooth noise in time
        ways = near @ self.values
        place = 400 + 60 * random(1, points, 2, seed=key)
        mix = 12 * random(ways.shape[1], points, 2, seed=key + 1) + 20 * random(ways.shape[1], 1, 2, seed=key + 2)
        return place + torch.einsum("tk,knd->tnd", ways, mix) + noise * random(len(times), points, 2, seed=key + 3)


def clock(seconds, fps):
    return torch.arange(round(seconds * fps), dtype=torch.float64) / fps


def pair(offset, rate=1.0, seconds=8.0, fps=(30.0, 30.0), seed=0, **more):
    """Tracks of eight points in a and six others in b."""
    body, (ta, tb) = Body(seed), (clock(seconds, one) for one in fps)
    return body.film(ta, 8, 10 + seed, **more), body.film((tb - offset) / rate, 6, 50 + seed, **more)


def synced(a, b, **more):
    return synchronize(a, b, correspondence=False, **{"fps": 30.0} | more)


@pytest.mark.slow
def test_the_same_tracks_get_the_same_digits():
    """Least squares by the default driver would read memory that nobody wrote."""
    scene = scenes.nonrigid_pair(10, 8, 90, sigma=0.3, offset=0.2, generator=seeded(1))

    def found(turn):
        for n in range(1, 40):  # what memory that was freed holds is something else every time
            torch.randint(0, 3, (n,), dtype=torch.int32, generator=seeded(turn))
        shift = synchronize(scene.a, scene.b, correspondence=False, fps=scene.fps, generator=seeded())
        return [shift.offset, shift.sigma, shift.rate, shift.confidence, *shift.peaks.flatten().tolist(), *shift.scores.tolist()]

    first = np.array(found(0))
    assert all(np.array(found(turn)).tobytes() == first.tobytes() for turn in range(1, 20))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("offset", "fps"), [*((offset, (30.0, 30.0)) for offset in (0.0, 1.417, -0.75)), (0.6, (30.0, 25.0)), (0.6, (25.0, 50.0))]
)
def test_the_offset_is_found(offset, fps):
    shift = synced(*pair(offset, fps=fps), fps=fps)
    assert shift.ok, shift.reason
    assert shift.offset == pytest.approx(offset, abs=0.4 * FRAME) and shift.fps == pytest.approx(fps)
    assert shift.method == "subspace" and shift.points is None and shift.fundamental is None
    assert shift.rate == 1 and shift.confidence > 0.9 and 0 < shift.sigma < FRAME
    assert shift.peaks[0, 0] == pytest.approx(shift.offset, abs=1e-6)
    assert shift.peaks[:, 1].tolist() == sorted(shift.peaks[:, 1].tolist(), reverse=True)
    best = int(shift.scores.nan_to_num(-math.inf).argmax())
    assert float(shift.lags[best]) == pytest.approx(offset, abs=FRAME)


@pytest.mark.slow
def test_times_since_1970_with_dropped_frames():
    a, b = pair(0.4)
    ta, tb = clock(8.0, 30.0) + 1.7e9, clock(8.0, 30.0) + 1.7e9 + 5
    kept = uniform(3, 240) > 0.1
    shift = synchronize(a[kept], b, correspondence=False, times=(ta[kept], tb), max_shift=8.0)
    assert shift.ok and shift.offset == pytest.approx(5.4, abs=0.4 * FRAME)
    assert 1.7e9 < shift.center < 1.7e9 + 8


@pytest.mark.slow
def test_neither_pixels_nor_order_nor_outliers_matter():
    a, b = pair(0.9)
    shift = synced(a, b)
    for other in (synced(0.5 * a + 30, b), synced(a.flip(1), b), synced(a.float(), b.float()), synced(a, b)):
        assert other.ok and other.offset == pytest.approx(shift.offset, abs=0.02 * FRAME)
    assert synced(b, a).offset == pytest.approx(-shift.offset, abs=0.1 * FRAME)
    t = clock(8.0, 30.0)
    later = synchronize(a, b, correspondence=False, times=(t + 3, t - 4))
    assert later.offset == pytest.approx(shift.offset - 7, abs=1e-6) and later.sigma == pytest.approx(shift.sigma)
    a, b = a.clone(), b.clone()
    a[uniform(1, 240, 8) < 0.03] += 120.0
    a[60:85, 2], b[100:130, 4] = torch.nan, torch.nan
    weights = torch.ones(240, 6)
    b[150:170, 1], weights[150:170, 1] = 0.0, 0.0
    shift = synced(a, b, weights=(None, weights))
    assert shift.ok and shift.offset == pytest.approx(0.9, abs=0.4 * FRAME)


@pytest.mark.slow
def test_a_clock_rate_is_found_or_given():
    shift = synced(*pair(0.5, rate=1.012, seconds=24.0), max_shift=2.0)
    assert shift.ok and shift.rate == pytest.approx(1.012, abs=1e-3)
    assert float(shift.at(12.0)) == pytest.approx(0.5 + 1.012 * 12, abs=FRAME)
    assert abs(shift.rate - 1.012) < 5 * shift.rate_sigma
    held = synced(*pair(0.5, rate=0.95), rate=0.95)
    assert held.ok and held.rate == 0.95 and held.rate_sigma == 0
    assert held.offset == pytest.approx(0.5, abs=0.5 * FRAME)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_unrelated_motion_is_refused(seed):
    a, b = pair(0.0, seed=seed)[0], pair(0.0, seed=seed + 100)[1]
    shift = synced(a, b)
    assert not shift.ok and shift.reason
    with pytest.raises(ValueError, match="synchronize: "):
        shift.check()


@pytest.mark.slow
def test_periodic_motion_is_refused():
    body = Body(4)
    t = clock(8.0, 30.0)
    a, b = body.film(t % 1.2, 8, 1), body.film((t - 0.3) % 1.2, 6, 7)
    shift = synced(a, b)
    assert not shift.ok and shift.reason
    away = (shift.peaks[:, 0] - 0.3) / 1.2
    assert float((away - away.round()).abs().min()) < 0.05


@pytest.mark.parametrize("more", [{"max_shift": 1.0}, {}])
def test_nothing_to_go_by_is_refused(more):
    a, b = pair(0.0)
    for one, other in ((torch.full_like(a, torch.nan), b), (a, torch.full_like(b, torch.nan)), (torch.ones_like(a), b)):
        shift = synced(one, other, **more)
        assert not shift.ok and shift.reason and math.isfinite(shift.offset)


def test_the_search_ends_at_the_largest_shift():
    a, b = pair(0.5)
    shift = synced(a, b, max_shift=1.0)
    assert shift.ok and float(shift.lags.abs().max()) < 1.0 + 1e-6
    t = clock(8.0, 30.0)
    far = synchronize(a, b, correspondence=False, times=(t, t + 100), max_shift=1.0)
    assert not far.ok and far.reason
    with pytest.raises(ValueError, match=r"b must be a tensor \(frames, points, 2\), got \(240, 12\)"):
        synced(a, b.flatten(1))


def test_a_shift_that_is_not_known_to_a_frame_of_fast_cameras_is_refused():
    found = SubspaceShift(3.0, 0.5, torch.zeros(0, 2), 0.99, 9.0)
    assert _refuse_coarse(found, 1 / 30, 1 / 30) is found
    fast = _refuse_coarse(found, 1 / 30, 1 / 60)
    assert not fast.ok and "uncertain by 0.017 s" in fast.reason and fast.position == found.position


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.0, 0.5])
def test_straight_lines_at_constant_velocity_carry_no_time(sigma):
    # the size of the whole grows and shrinks about the middle of either take, which looked like one event
    generator = seeded(9010)
    frames = torch.arange(120, dtype=torch.float64)[:, None, None]

    def tracks(n):
        places, velocity = (torch.randn(1, n, 2, generator=generator, dtype=torch.float64) for _ in range(2))
        return 100 * places + 2 * velocity * frames + sigma * torch.randn(120, n, 2, generator=generator, dtype=torch.float64)

    for _ in range(4):
        found = synchronize(tracks(12), tracks(14), correspondence=False, fps=30.0)
        assert not found.ok and "straight lines" in found.reason
