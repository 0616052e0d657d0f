"""Clocks that break: lost and doubled frames, found by two cameras and blamed on one of three."""

import itertools
import math

import numpy as np
import pytest
import torch

import dyntorch as dyn
from dyntorch.tasks.synchronize.breaks import breaks, camera_breaks, repair_times
from dyntorch.tasks.synchronize.piecewise_offset import MIN_JUMP_EVIDENCE, Jump, cheapest_path, repair_clocks
from dyntorch.tasks.synchronize.result import ClockBreak, SynchronizeOptions
from dyntorch.tasks.synchronize.tracks import read_tracks

FPS, FRAMES, OFFSET = 30.0, 200, 0.31
SHORT = SynchronizeOptions(max_jump=0.4)  # of what is lost: a third of the work


def motion(seed=0, points=12):
    """Points that wobble, each at its own speeds: metres at any seconds."""
    g = torch.Generator().manual_seed(seed)
    base = torch.randn(points, 3, generator=g, dtype=torch.float64)
    speeds = 1 + 3 * torch.rand(points, 3, generator=g, dtype=torch.float64)
    phases = 6 * torch.rand(points, 3, generator=g, dtype=torch.float64)
    return lambda t: 0.7 * base + 0.3 * torch.sin(speeds * t[:, None, None] + phases)


def film(course, turn, offset=0.0, noise=1.0, seed=1, frames=FRAMES):
    """Px from five metres away, of a camera whose clock is ahead by an offset."""
    p = course(torch.arange(frames, dtype=torch.float64) / FPS - offset)
    c, s = math.cos(turn), math.sin(turn)
    x, z = c * p[..., 0] + s * p[..., 2], c * p[..., 2] - s * p[..., 0]
    pixels = 800 * torch.stack([x, p[..., 1]], -1) / (z + 5)[..., None]
    return pixels + noise * torch.randn(pixels.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def without(x, at, count):
    return torch.cat([x[:at], x[at + count :]])


def twice(x, at, count):
    """The frame before ``at`` so many times more."""
    return torch.cat([x[:at], x[at - 1 : at].expand(count, *x.shape[1:]), x[at:]])


@pytest.fixture(scope="module")
def pair():
    course = motion()
    return film(course, 0.0), film(course, 1.0, OFFSET, seed=2)


@pytest.mark.slow
@pytest.mark.parametrize(("which", "change", "count", "loser"), [("b", without, 6, 1), ("a", without, 2, 0), ("b", twice, 3, 0)])
def test_one_break(pair, which, change, count, loser):
    a, b = pair
    at = 95
    a, b = (change(a, at, count), b) if which == "a" else (a, change(b, at, count))
    found = breaks(a, b, fps=FPS, max_shift=1.0, options=SHORT)
    assert found.ok
    (one,) = found.breaks
    assert one.frames == count
    assert one.candidates == (loser, 1 - loser)
    assert one.camera is None
    truth = (at - 0.5) / FPS
    moment = one.moments[one.candidates.index("ab".index(which))]
    assert abs(moment - truth) < max(0.12, 4 * one.sigma)
    assert one.evidence > MIN_JUMP_EVIDENCE
    assert one.residuals[0] > one.residuals[1]
    assert one.jump == pytest.approx((-1 if loser else 1) * count / FPS, abs=0.5 / FPS)
    assert abs(found.clocks.offset - OFFSET) < 0.3 / FPS
    assert "a third one would" in found.notes[0]
    assert f"{count} frames lost" in repr(found)
    if change is without:  # times of a clock that keeps time; the moment is known to some frames
        own = found.times["ab".index(which)]
        assert int(((own - without(torch.arange(FRAMES, dtype=torch.float64) / FPS, at, count)).abs() > 1e-6).sum()) <= 4
        assert bool((own.diff() > 0).all())


@pytest.mark.slow
def test_several_breaks(pair):
    a, b = pair
    found = breaks(a, without(without(b, 140, 4), 65, 7), fps=FPS, max_shift=1.0, options=SHORT)
    assert [one.frames for one in found.breaks] == [7, 4]
    assert abs(found.clocks.offset - OFFSET) < 0.3 / FPS


def test_nothing_broke(pair):
    found = breaks(*pair, fps=FPS, max_shift=1.0, options=SHORT)
    assert found.ok
    assert found.breaks == ()
    assert found.times[1].tolist() == pytest.approx((torch.arange(FRAMES) / FPS).tolist())


@pytest.mark.slow
def test_another_frame_rate_is_no_break():
    course = motion(3)
    a, b = film(course, 0.0), film(lambda t: course(t * 1.005), 1.0, seed=2)
    found = breaks(a, b, fps=FPS, max_shift=1.0, options=SHORT)
    assert found.breaks == ()


@pytest.mark.slow
def test_films_that_have_nothing_in_common_are_refused(pair):
    found = breaks(pair[0], film(motion(9), 1.0, seed=4), fps=FPS, max_shift=1.0, options=SHORT)
    assert not found.ok
    assert found.breaks == ()
    assert "not decided" in found.reason
    with pytest.raises(ValueError, match="breaks: "):
        found.check()


@pytest.fixture(scope="module")
def three():
    course = motion(5)
    return [film(course, turn, offset, seed=k) for k, (turn, offset) in enumerate([(0.0, 0.0), (1.0, OFFSET), (2.1, -0.2)])]


@pytest.mark.slow
@pytest.mark.parametrize(("camera", "change", "sign"), [(2, without, -1), (0, twice, 1)])
def test_three_cameras_tell_which(three, camera, change, sign):
    films = [change(x, 100, 5) if k == camera else x for k, x in enumerate(three)]
    clocks = dyn.synchronize_cameras(films, fps=FPS, max_shift=1.0, breaks=True, options=SHORT)
    assert clocks.ok
    (one,) = clocks.breaks.breaks
    assert one.camera == camera
    assert one.frames == 5
    assert one.is_doubled == (sign > 0)
    assert one.jump == pytest.approx(sign * 5 / FPS, abs=0.4 / FPS)
    assert abs(one.time - 99.5 / FPS) < 0.3
    assert clocks.offsets.tolist() == pytest.approx([0.0, OFFSET, -0.2], abs=0.3 / FPS)
    assert [len(x) for x in clocks.breaks.times] == [len(x) for x in films]
    assert all(bool((times.diff() > 0).all()) for times in clocks.breaks.times)
    assert "break: " in repr(clocks)


@pytest.mark.slow
def test_good_cameras_have_no_breaks(three):
    clocks = dyn.synchronize_cameras(three, fps=FPS, max_shift=1.0)
    found = camera_breaks(three, clocks, fps=FPS, max_shift=1.0, options=SHORT)
    assert found.ok
    assert found.breaks == ()
    assert found.clocks is clocks


def test_cheapest_is_the_cheapest_of_all():
    rng = np.random.default_rng(0)
    for penalty in (0.0, 0.4, 2.0):
        costs = rng.uniform(size=(6, 3))

        def price(path, costs=costs, penalty=penalty):
            changes = sum(x != y for x, y in itertools.pairwise(path))
            return sum(costs[k, state] for k, state in enumerate(path)) + penalty * changes

        best = min(itertools.product(range(3), repeat=6), key=price)
        assert price(cheapest_path(costs, penalty).tolist()) == pytest.approx(price(best))


def test_doubled_and_mended_frames_stand_where_they_were():
    tracks = [read_tracks("a", torch.ones(20, 1, 2).double(), 10.0, None, None) for _ in range(2)]
    a, b = repair_clocks(*tracks, 1.0, 0.5, (Jump(0.45, 0.1, -0.3), Jump(1.05, 0.1, 0.2)))
    assert a.times[:11].tolist() == pytest.approx((torch.arange(11) / 10).tolist())
    assert a.times[11].item() == pytest.approx(1.3)
    assert b.times[9].item() == pytest.approx(0.9)
    assert b.times[10].item() == pytest.approx(1.3)
    one = ClockBreak((1,), (0.35,), 0.1, 0.2, 0.0, 2, 99.0, (2.0, 1.0))
    times = repair_times(torch.arange(9, dtype=torch.float64) / 10, 1, [one])
    assert times.tolist() == pytest.approx([0, 0.1, 0.2, 0.3, 0.3 + 0.1 / 3, 0.3 + 0.2 / 3, 0.4, 0.5, 0.6])
    assert repair_times(torch.arange(3.0), 0, [one]).tolist() == [0, 1, 2]


def test_misuse(pair):
    a, b = pair
    with pytest.raises(ValueError, match="corresponding points; a has 12 and b 11"):
        breaks(a, b[:, 1:], dyn.synchronize(a, b, fps=FPS, max_shift=1.0), fps=FPS)
    with pytest.raises(ValueError, match="one by one"):
        breaks(a, b, dyn.synchronize(a[None], b[None], fps=FPS, max_shift=1.0), fps=FPS)
    clocks = dyn.synchronize_cameras([a, b], fps=FPS, max_shift=1.0)
    with pytest.raises(ValueError, match="fps: 3 values for 2 cameras"):
        camera_breaks([a, b], clocks, fps=[30.0, 30.0, 30.0])
    with pytest.raises(ValueError, match="either fps or times"):
        camera_breaks([a, b], clocks)
    with pytest.raises(ValueError, match="corresponding points"):
        dyn.synchronize_cameras([a, b], False, fps=FPS, breaks=True)
