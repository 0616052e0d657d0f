"""Two cameras with clocks of their own: known offsets and rates, what must not matter, and what is wrong with real tracks."""

import dataclasses
import math

import pytest
import torch

from dyntorch.geometry.lens import distort
from dyntorch.scenes import filmed_person
from dyntorch.tasks.synchronize.synchronize import synchronize
from tests.draws import random, seeded

FRAME = 1 / 30


def film(seed=0, **more):
    return filmed_person(**{"noise": 1.0, "generator": seeded(seed)} | more)


def synced(scene, **more):
    return synchronize(scene.a, scene.b, **{"fps": scene.fps} | more)


def assert_found(shift, scene, within):
    assert shift.ok, shift.reason
    assert not shift.reason and shift.check() is shift
    assert shift.offset == pytest.approx(scene.offset, abs=within)


def same(one, other, tolerance=1e-6):
    assert one.offset == pytest.approx(other.offset, abs=tolerance)
    assert one.rate == pytest.approx(other.rate, abs=tolerance)
    assert one.sigma == pytest.approx(other.sigma, rel=0.01)
    assert one.ok == other.ok


@pytest.mark.parametrize(
    ("offset", "noise", "within"), [(0.4217, 0.0, 0.01), (0.0, 0.0, 0.01), (-1.1, 1.0, 0.04), (0.7, 1.0, 0.04), (0.35, 4.0, 0.15)]
)
def test_offsets_are_found_between_frames(offset, noise, within):
    scene = film(1, noise=noise, offset=offset)
    shift = synced(scene)
    assert_found(shift, scene, within * FRAME)
    assert shift.rate == 1 and shift.rate_sigma == 0 and shift.method == "epipolar" and shift.fps == pytest.approx((30, 30))
    assert shift.confidence > 0.9 and 0 < shift.sigma < 0.1 * FRAME
    assert shift.frames == pytest.approx(30 * shift.offset)
    assert shift.points.all() and shift.points.shape == (15,) and not shift.notes
    assert abs(shift.offset - offset) < 5 * math.hypot(shift.sigma, 0.001 * FRAME)


def test_the_curve_and_its_peaks():
    scene = film(3, offset=0.5)
    shift = synced(scene)
    assert shift.peaks.dtype == torch.float64 and shift.peaks.shape[1] == 2 and len(shift.peaks) > 1
    assert shift.peaks[0, 0] == pytest.approx(shift.offset)
    assert shift.peaks[:, 1].tolist() == sorted(shift.peaks[:, 1].tolist(), reverse=True)
    best = int(shift.scores.nan_to_num(-math.inf).argmax())
    assert float(shift.lags[best]) == pytest.approx(shift.offset, abs=0.51 * FRAME)
    assert len(shift.lags) == len(shift.scores) == len(scene.a) + len(scene.b) - 1
    assert shift.scores[0].isnan() and shift.scores[-1].isnan()


def clock(frames, fps, seed, start):
    """Seconds of frames, a tenth dropped, each somewhat late."""
    place = torch.arange(frames, dtype=torch.float64) + 0.3 * torch.rand(frames, generator=seeded(seed), dtype=torch.float64)
    return start + place[torch.rand(frames, generator=seeded(seed + 1)) > 0.1] / fps


@pytest.mark.parametrize("start", [0.0, 1.7e9])
def test_times_since_1970_of_irregular_frames(start):
    times = clock(120, 30.0, 0, 0.0), clock(110, 25.0, 5, 0.5)
    scene = film(5, times=times, offset=0.25)
    shift = synchronize(scene.a, scene.b, times=(times[0] + start, times[1] + start + 7))
    assert shift.ok and shift.offset == pytest.approx(7.25, abs=0.1 * FRAME)
    assert start < shift.center < start + 5
    assert float(shift.at(start + 2.0)) == pytest.approx(start + 9.25, abs=0.1 * FRAME)


def test_times_of_later_and_exchanged_clocks_give_the_inverse_clock():
    scene = film(6, offset=0.3)
    shift = synchronize(scene.a, scene.b, times=scene.times)
    same(shift, synced(scene), 1e-9)
    later = synchronize(scene.a, scene.b, times=(scene.times[0] - 3, scene.times[1] + 5))
    same(dataclasses.replace(later, offset=later.offset - 8), shift, 1e-7)
    assert later.center == pytest.approx(shift.center - 3, abs=1e-6)
    assert torch.allclose(later.lags, shift.lags + 8, atol=1e-6)
    fps = 30.0, 50.0
    scene = film(7, offset=-0.37, fps=fps)
    shift, back = synced(scene), synchronize(scene.b, scene.a, fps=fps[::-1])
    assert back.offset == pytest.approx(-shift.offset, abs=2 * shift.sigma)
    assert back.sigma == pytest.approx(shift.sigma, rel=0.5)
    F = shift.fundamental
    assert abs(float((back.fundamental.mT * F).sum())) == pytest.approx(1, abs=1e-3)


@pytest.mark.slow
def test_neither_pixels_nor_order_nor_precision_matter():
    scene = film(8, offset=0.2)
    shift = synced(scene)
    turn = torch.tensor([[0.8, -0.6], [0.6, 0.8]], dtype=torch.float64)
    same(synchronize(scene.a @ turn.mT * 0.25 + 7, scene.b * 0.25 - 100, fps=30.0), shift, 2e-4)
    same(synchronize(2.0 * scene.a, scene.b, fps=30.0), shift, 2e-4)
    same(synchronize(scene.a.flip(1), scene.b.flip(1), fps=30.0), shift, 1e-6)
    same(synchronize(scene.a.float(), scene.b.float(), fps=30.0), shift, 1e-5)
    assert torch.equal(synced(scene).scores.nan_to_num(0), shift.scores.nan_to_num(0))
    assert synced(scene).offset == shift.offset


def test_takes_played_backwards_and_of_other_lengths():
    scene = film(9, offset=0.3)
    # frame i is at (T - i) / fps of clocks that run backwards
    back, cut = ((scene.a.flip(0), scene.b.flip(0)), -0.3), ((scene.a[20:], scene.b[:90]), 0.3 + 20 * FRAME)
    for takes, offset in (back, cut):
        shift = synchronize(*takes, fps=30.0)
        assert shift.ok and shift.offset == pytest.approx(offset, abs=0.05 * FRAME)


@pytest.mark.slow
@pytest.mark.parametrize(("rate", "seconds"), [(30 / 29.83, 60.0), (1.0002, 30.0), (0.985, 12.0)])
def test_clock_rates_are_found(rate, seconds):
    scene = film(11, seconds=seconds, n=8, rate=rate, offset=0.7)
    shift = synced(scene, max_shift=2.0)
    assert_found(shift, scene, 0.1 * FRAME)
    assert abs(shift.rate - rate) < max(4 * shift.rate_sigma, 1e-6) < 5e-4
    moments = torch.tensor([1.0, seconds - 1], dtype=torch.float64)
    assert torch.allclose(shift.at(moments), rate * moments + 0.7, atol=0.1 * FRAME)
    assert torch.allclose(shift.inverse(shift.at(moments)), moments)
    assert shift.peaks[0, 0] == pytest.approx(float(shift.at(shift.center)) - shift.center, abs=1e-6)
    assert f"rate {1e6 * (shift.rate - 1):+.0f} ±" in repr(shift)


@pytest.mark.slow
def test_rates_are_found_or_held():
    scene = film(12, seconds=20.0, n=10, fps=(30.0, 29.83), offset=0.5)
    shift = synced(scene, fps=30.0, max_shift=2.0)
    assert shift.ok and shift.rate == pytest.approx(29.83 / 30, abs=1e-4)
    assert shift.offset == pytest.approx(0.5 * 29.83 / 30, abs=0.1 * FRAME)
    scene = film(13, rate=0.9, offset=0.7)
    shift = synced(scene, rate=0.9)
    assert_found(shift, scene, 0.05 * FRAME)
    assert shift.rate == 0.9 and shift.rate_sigma == 0
    for seed in range(2):  # and clocks of rate one stay so
        assert synced(film(seed, seconds=12.0, n=12, offset=0.2), max_shift=1.0).rate == 1


def test_missing_blocks_and_gross_outliers():
    for more in ({"missing": 0.35, "offset": -0.4}, {"outliers": 0.15, "offset": 0.6}):
        scene = film(1, **more)
        before = scene.a.clone(), scene.b.clone()
        assert_found(synced(scene), scene, 0.1 * FRAME)
        for one, other in zip(before, (scene.a, scene.b), strict=True):  # the input stays as it was
            assert torch.equal(one.nan_to_num(-1), other.nan_to_num(-1))


@pytest.mark.slow
def test_wrong_points_are_named_and_left_out():
    scene = film(0, n=17, wrong=2, offset=-0.6)
    shift = synced(scene, generator=seeded())
    assert_found(shift, scene, 0.1 * FRAME)
    assert torch.equal(~shift.points, scene.wrong)
    which = ", ".join(str(int(k)) for k in scene.wrong.nonzero())
    assert shift.notes == (f"2 of 17 points never agree with the others and were left out: {which}",)


def test_points_never_seen_or_of_no_weight_change_nothing():
    scene = film(4, offset=0.3)
    a = torch.cat([scene.a, torch.full_like(scene.a[:, :1], torch.nan)], dim=1)
    same(synchronize(a, torch.cat([scene.b, scene.b[:, :1]], dim=1), fps=30.0), synced(scene), 1e-4)
    a, gone, weights = scene.a.clone(), scene.a.clone(), torch.ones(scene.a.shape[:2])
    a[20:50, 3], gone[20:50, 3], weights[20:50, 3] = 7.0, torch.nan, 0
    same(synchronize(a, scene.b, fps=30.0, weights=(weights, None)), synchronize(gone, scene.b, fps=30.0), 1e-9)


def test_one_point_on_a_long_path_and_everything_at_once():
    scene = film(6, n=1, seconds=20.0, noise=0.5, walk=1.5, offset=0.7)
    shift = synced(scene, max_shift=3.0)
    assert_found(shift, scene, 0.1 * FRAME)
    assert shift.points.tolist() == [True]
    scene = film(3, n=17, seconds=6.0, noise=2.0, missing=0.2, outliers=0.08, wrong=1, offset=0.45, fps=(30.0, 25.0))
    shift = synced(scene)
    assert_found(shift, scene, 0.2 * FRAME)
    assert shift.fps == pytest.approx((30.0, 25.0))


def test_affine_cameras_on_request():
    scene = film(7, seconds=6.0, offset=0.3)
    shift = synced(scene, camera="affine")
    assert_found(shift, scene, 0.3 * FRAME)
    assert shift.method == "affine" and shift.fundamental is None
    assert synced(scene, camera="perspective").offset == synced(scene).offset


def test_calibration_is_applied():
    scene = film(8, noise=0.2, walk=1.2, offset=0.3)
    K = torch.tensor([[1000.0, 0, 640], [0, 1000, 480], [0, 0, 1]], dtype=torch.float64)
    dist = torch.tensor([-0.3, 0.1, 0.001, 0.0], dtype=torch.float64)
    bent = distort(scene.a, K, dist), distort(scene.b, K, dist)
    shift = synchronize(*bent, fps=30.0, calibration=((K, dist), (K.tolist(), dist.tolist())))
    same(shift, synced(scene), 1e-5)
    assert not shift.notes
    one = synchronize(bent[0], scene.b, fps=30.0, calibration=((K, dist), None))
    same(one, synced(scene), 1e-5)


@pytest.mark.slow
def test_lenses_that_nobody_calibrated_are_straightened_with_a_note():
    scene = film(9, n=10, seconds=5.0, noise=0.3, walk=1.2, lens=-0.35, offset=0.7)
    shift = synced(scene)
    assert_found(shift, scene, 0.05 * FRAME)
    assert len(shift.notes) == 1
    assert shift.notes[0].startswith("lens distortion fitted, lambda = -0.")


def test_a_camera_that_moves_in_between_is_noted():
    scene = film(10, seconds=6.0, noise=0.5, offset=0.1)
    b = scene.b.clone()
    b[95:] += torch.tensor([4.0, 8.0], dtype=torch.float64)
    shift = synchronize(scene.a, b, fps=30.0)
    assert shift.offset == pytest.approx(0.1, abs=0.2 * FRAME)
    assert any("a camera may have moved" in note for note in shift.notes)


A, TIMES = torch.rand(20, 4, 2, generator=seeded()), torch.arange(20.0)
K = [[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({}, r"give either fps or times, got neither"),
        ({"fps": 30.0, "times": (TIMES, TIMES)}, r"give either fps or times, got both"),
        ({"fps": (30.0, 30.0, 25.0)}, r"fps must be a pair, one of a and one of b, got 3 values"),
        ({"times": (TIMES,)}, r"times must be a pair, one of a and one of b, got 1 values"),
        ({"fps": (30.0, -1.0)}, r"fps of b must be a positive number of frames per second, got -1.0"),
        ({"times": (TIMES, TIMES[:19])}, r"times of b must be 20 finite seconds, one per frame, got \(19,\)"),
        ({"times": (TIMES.flip(0), TIMES)}, r"times of a must increase, but frame 1 is not after the one before; sort or drop"),
        ({"fps": 30.0, "max_shift": 0.0}, r"max_shift must be a positive number of seconds or None, got 0.0"),
        ({"fps": 30.0, "max_shift": math.inf}, r"max_shift must be .* got inf"),
        ({"fps": 30.0, "rate": 30.0}, r"rate must be about 1 .*, got 30.0; give fps for frame rates"),
        ({"fps": 30.0, "camera": "pinhole"}, r"camera must be one of auto, perspective, affine, projective, got 'pinhole'"),
        ({"fps": 30.0, "camera": "affine", "correspondence": False}, r"camera='affine' is for corresponding points; leave it out"),
        ({"fps": 30.0, "weights": (torch.ones(20, 4),)}, r"weights must be a pair, one of a and one of b"),
        ({"fps": 30.0, "weights": torch.ones(20, 4)}, r"weights must be a pair, one of a and one of b"),
        ({"fps": 30.0, "weights": (None, torch.ones(20, 3))}, r"weights of b must be \(20, 4\)"),
        ({"fps": 30.0, "calibration": (K, None)}, r"calibration of a: calibration of a camera must be None or \(K, dist\)"),
        ({"fps": 30.0, "calibration": ((K, None),)}, r"calibration must be a pair, of a and of b: each None or \(K, dist\)"),
        ({"fps": 30.0, "calibration": (None, ([[1.0]], None))}, r"calibration of b: calibration: K must be"),
        ({"fps": 30.0, "a": A.numpy()}, r"a must be a tensor \(frames, points, 2\), got ndarray"),
        ({"fps": 30.0, "b": A[..., :1]}, r"b must be a tensor \(frames, points, 2\), got \(20, 4, 1\)"),
        ({"fps": 30.0, "b": A.long()}, r"b must hold floating point numbers, got torch.int64"),
        ({"fps": 30.0, "a": A[:11]}, r"a has 11 frames, 12 are needed at least"),
        ({"fps": 30.0, "b": A[:, :3]}, r"a has 4 points and b 3: corresponding points are as many; .* correspondence=False"),
    ],
)
def test_misuse_names_the_field_and_the_remedy(more, words):
    with pytest.raises(ValueError, match=words):
        synchronize(**{"a": A, "b": A} | more)


@pytest.mark.parametrize("gap", [864000.0, 1e12])
def test_takes_that_are_nearly_all_gap_are_refused(gap):
    points, clock = A.double().repeat(2, 1, 1), torch.arange(40, dtype=torch.float64) / 30
    torn = clock + gap * (torch.arange(40) > 29)
    with pytest.raises(
        ValueError, match=r"times of b run over .* it has 40 frames 0.0333 s apart, and none for .* one side of that gap"
    ):
        synchronize(points, points, times=(clock, torn))


STRAIGHT = (None, None)  # cameras without distortion, so that none is looked for


def film_of_refusal(seed=0, **more):
    return film(seed, **{"n": 10, "seconds": 2.5} | more)


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
    scene = film_of_refusal(seed, noise=noise, period=0.6, walk=0.0, offset=0.13)
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


def test_a_gait_that_crosses_the_room_is_refused_or_right():
    scene = film_of_refusal(0, period=0.8, walk=0.0, offset=0.23)
    shift = synchronize(scene.a, scene.b, fps=30.0, max_shift=0.35)  # within a period it is decided
    assert shift.ok and shift.offset == pytest.approx(0.23, abs=0.05 * FRAME), shift.reason
    scene = film_of_refusal(1, period=0.8, walk=1.5, offset=0.23, n=15)
    shift = synchronize(scene.a, scene.b, fps=30.0, max_shift=1.2)
    assert float((shift.peaks[:, 0] - 0.23).abs().min()) < 0.5 * FRAME
    assert not shift.ok or shift.offset == pytest.approx(0.23, abs=0.1 * FRAME)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_nothing_moves(noise):
    still = film_of_refusal(2).exact
    a, b = (x[:1] + noise * random(50, 10, 2, seed=k) for k, x in enumerate(still))
    shift = synchronize(a, b, fps=30.0, max_shift=0.3, calibration=STRAIGHT)
    assert_refused(shift, "motion is too small", "nothing moves", "repeats itself or is too small", "halves of the take")


@pytest.mark.slow
def test_unrelated_motion():
    a, b = film_of_refusal(0).a, film_of_refusal(50).b
    shift = synchronize(a, b, fps=30.0, max_shift=0.4)
    assert_refused(shift, "motion is too small", "repeats itself or is too small", "halves of the take", "end of the search")
    assert shift.confidence < 0.7


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "offset", "backwards"), [(0, 1.5, False), (8, 0.0, True)])
def test_wrong_shifts_are_not_made_to_fit_by_leaving_points_out(seed, offset, backwards):
    scene = film_of_refusal(seed, n=12, seconds=4.0, offset=offset)
    b = scene.b.flip(0) if backwards else scene.b
    shift = synchronize(scene.a, b, fps=30.0, max_shift=None if backwards else 1.0, calibration=STRAIGHT, camera="perspective")
    assert_refused(shift, "motion is too small", "repeats itself", "halves of the take", "fit", "end of the search")


def test_the_best_shift_lies_in_the_search_or_is_refused():
    scene = film_of_refusal(5, offset=0.5)
    shift = synchronize(scene.a, scene.b, fps=30.0, max_shift=0.5)
    assert_refused(shift, "lies at the end of the search or beyond; raise max_shift")
    assert shift.offset == pytest.approx(0.5, abs=0.1 * FRAME)
    scene = film_of_refusal(6)
    shift = synchronize(scene.a, scene.b, times=(scene.times[0], scene.times[1] + 100), max_shift=1.0)
    assert_refused(shift, "raise max_shift")
    assert shift.sigma == math.inf and shift.confidence == 0 and len(shift.peaks) == 0
    found = synchronize(scene.a, scene.b, times=(scene.times[0], scene.times[1] + 100))
    assert found.ok and found.offset == pytest.approx(100, abs=0.1 * FRAME)


@pytest.mark.parametrize("name", ["a", "b"])
def test_nothing_is_seen(name):
    scene = film_of_refusal(8)
    views = {"a": scene.a, "b": scene.b}
    views[name] = torch.full_like(views[name], torch.nan)
    shift = synchronize(views["a"], views["b"], fps=30.0)
    assert_refused(shift, f"no point is seen in {name}; check the detections")
    assert shift.fundamental is None and len(shift.lags) == 0
    weights = tuple(torch.zeros(scene.a.shape[:2]) if name == one else None for one in "ab")
    assert synchronize(scene.a, scene.b, fps=30.0, weights=weights).reason == shift.reason
    # in both, but never at one time
    a, b = scene.a.clone(), scene.b.clone()
    a[:50], b[40:] = torch.nan, torch.nan
    assert_refused(synchronize(a, b, fps=30.0, max_shift=0.2), "enough points")


@pytest.mark.slow
def test_the_halves_of_a_take_disagree():
    one, other = (film_of_refusal(9, seconds=3.0, offset=offset) for offset in (0.1, 0.5))
    b = torch.cat([one.b[:48], other.b[48:]])
    shift = synchronize(one.a, b, fps=30.0, max_shift=0.7, calibration=STRAIGHT)
    assert_refused(shift, "the halves of the take say", "repeats itself or is too small")
    assert min(abs(shift.offset - value) for value in (0.1, 0.5)) < 3 * FRAME
