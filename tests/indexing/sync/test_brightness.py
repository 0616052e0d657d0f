"""Two videos, no tracks: right shifts are found and believed, everything else is refused with its reason."""

import math

import numpy as np
import pytest
import torch

from indexing.sync.brightness import (
    OUTLIER_SHARE,
    OVERLAP_POWER,
    SOFTMAX_SHARPNESS,
    WINDOW_FRAMES,
    WINDOW_LAG_RANGE,
    Curve,
    brightness_shift,
    evidence,
    lag_sums,
    part_curve,
    score_curve,
    windows,
)
from tests.battery.pretend_device import counted, moved, pretend_device

FPS = (30.0, 30.0)


@pytest.mark.slow
def test_a_known_shift_is_believed_and_others_are_refused(films, other):
    a, b = films
    shift = brightness_shift(a[25:], b[:-10], fps=FPS)
    assert (
        shift.ok and shift.method == "brightness" and abs(shift.frames - 25) <= 1 and abs(shift.offset - 25 / 30) < 3 * shift.sigma
    )
    assert shift.peaks[0, 0] == shift.offset and shift.confidence > 0.9 and shift.rate == 1.0
    assert shift.scores.nan_to_num(-1).argmax() == (shift.lags - 25 / 30).abs().argmin() or abs(shift.frames - 25) > 0.5
    other_way = brightness_shift(b[:-10], a[25:], fps=FPS)
    assert other_way.ok and other_way.offset == pytest.approx(-shift.offset, abs=0.02)
    for second in (other, b[::-1].copy()):
        shift = brightness_shift(a, second, fps=FPS)
        assert not shift.ok and shift.reason and len(shift.peaks) >= 1
        with pytest.raises(ValueError, match="synchronize: "):
            shift.check()


@pytest.mark.slow
def test_streams_sizes_rates_and_clocks(films):
    a, b = (video[:110] for video in films)
    times = 100 + np.arange(0, 110, 2) / 30.0
    stream = ((torch.from_numpy(b[2 * i : 2 * i + 8 : 2]), times[i : i + 4]) for i in range(0, 55, 4))
    large = np.repeat(np.repeat(a, 5, axis=1), 5, axis=2)
    shift = brightness_shift(large, stream, fps=(30.0, 15.0), times=(np.arange(110) / 30.0, None))
    assert abs(shift.offset - 100) < 1 / 15
    assert shift.fps == pytest.approx((30.0, 15.0))


def test_videos_on_an_accelerator(films):
    a, b = (torch.from_numpy(video) for video in films)
    pair, home = (a[10:60], b[:50]), pretend_device()
    here = brightness_shift(*pair, fps=FPS)
    with counted() as traffic:
        there = brightness_shift(*moved(pair, home), fps=FPS)
    assert len(traffic) <= 2, str(traffic)  # one copy for each video
    assert {there.peaks.device, there.lags.device, there.scores.device} == {home}
    assert (there.offset, there.sigma, there.ok, there.reason) == (here.offset, here.sigma, here.ok, here.reason)
    assert torch.equal(there.peaks.cpu(), here.peaks)


def test_repeated_motion_is_refused_with_its_peaks(films):
    a, b = (np.concatenate([video[20:65]] * 3) for video in films)
    shift = brightness_shift(a[45:], b, fps=FPS)
    assert not shift.ok and "another shift fits nearly as well" in shift.reason
    lags = (shift.peaks[:4, 0] * 30).round() % 45
    assert torch.minimum(lags, 45 - lags).max() <= 1


def test_too_little_motion_and_flicker_are_said(films, rng):
    a, b = films
    still = np.clip(b[:1] + rng.normal(0, 2, b.shape), 0, 255).astype(np.uint8)
    a, b, still = a[:40], b[:40], still[:40]
    assert "nothing moves in b" in brightness_shift(a, still, fps=FPS).reason
    flicker = (b * (0.2 + 0.4 * (np.arange(len(b)) % 3))[:, None, None]).astype(np.uint8)
    assert "light flickers" in brightness_shift(a, flicker, fps=FPS).reason
    constant = brightness_shift(np.zeros_like(a), np.zeros_like(b), fps=FPS)
    assert not constant.ok and np.isfinite([constant.offset, constant.sigma, constant.confidence]).all()


def test_shaking_camera_is_said_and_max_shift_and_region_bound_the_search(films):
    a, b = (video[:60] for video in films)
    rng = np.random.default_rng(1)
    path = np.cumsum(rng.integers(-1, 2, (len(b), 2)), axis=0).clip(-6, 6)
    shaken = np.stack([np.pad(f, 8, mode="edge")[8 + y : 68 + y, 8 + x : 88 + x] for f, (x, y) in zip(b, path, strict=True)])
    assert any("b: the camera moves" in note for note in brightness_shift(a, shaken, fps=FPS).notes)
    shift = brightness_shift(a[15:], b, fps=FPS, max_shift=0.5, region=(0, 0, 80, 60))
    assert abs(shift.offset) <= 0.5 + 1 / 60
    assert brightness_shift(a[15:], b, fps=FPS, region=None).lags.shape == (45 + 60 - 1,)


BAD = {
    "max_shift must be": {"max_shift": -1.0},
    "overlap by less than": {"times": (np.arange(30) / 30.0, 500 + np.arange(30) / 30.0), "max_shift": 2.0},
    "region must be 'motion'": {"region": "person"},
    "region must be .x0": {"region": (5.0, 0.0, 2.0, 9.0)},
    "outside the image of a": {"region": (500.0, 0.0, 600.0, 9.0)},
    "fps must be a pair": {"fps": 30.0},
    "neither fps nor times": {"fps": None},
}


def test_bad_input_is_named(films):
    for words, options in BAD.items():
        with pytest.raises(ValueError, match=words):
            brightness_shift(*(video[:30] for video in films), **({"fps": FPS} | options))


# Sums and scores at all lags against loops.


def unit(rows, seed):
    values = torch.randn(rows, 40, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.nn.functional.normalize(values, dim=1)


def test_scores_leave_out_missing_frames_and_parts_keep_their_lags():
    a, b = unit(30, 0), unit(25, 1)
    products = a @ b.T
    want = [products.diagonal(lag).sum().item() for lag in range(-29, 25)]
    assert lag_sums(a, b).tolist() == pytest.approx(want, abs=1e-12)
    a[4:9] = 0
    curve = score_curve(a, b, 10)
    for lag in range(-29, 25):
        pairs = [(i, i + lag) for i in range(30) if 0 <= i + lag < 25 and not 4 <= i < 9]
        if len(pairs) < 10:
            assert curve.at(lag) == -torch.inf
        else:
            mean = sum(products[i, j].item() for i, j in pairs) / len(pairs)
            assert curve.at(lag) == pytest.approx(mean * (len(pairs) / float(curve.counts.max())) ** OVERLAP_POWER, abs=1e-12)
    a = unit(60, 3)
    b = torch.cat([unit(11, 5), a])
    assert score_curve(a, b, 20).best_lag == 11
    assert part_curve(a, b, slice(35, 50)).best_lag == 11
    assert part_curve(a, b, slice(35, 50)).within(-5, 5).best_lag != 11


def test_peaks_and_parabola():
    lags = torch.arange(-20, 21)
    x = lags.double()
    scores = torch.exp(-((x - 3.3) ** 2) / 20) + 0.5 * torch.exp(-((x + 12) ** 2) / 20)
    curve = Curve(lags, scores, torch.ones(41))
    assert curve.lags[curve.peaks(4)].tolist() == [3, -12]
    assert curve.best_lag + curve.offset(curve.best_lag) == pytest.approx(3.3, abs=0.01)
    assert curve.offset(-20) == 0.0
    assert curve.within(-20, 3).offset(3) == 0.0


# Evidence of short windows: all agree, none agrees, nothing known.


REACH, WINDOW = WINDOW_LAG_RANGE, WINDOW_FRAMES


def walk(rows, seed):
    """Unit vectors that change within a few frames."""
    steps = torch.randn(rows + 8, 18, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.nn.functional.normalize(steps.unfold(0, 8, 1).mean(-1)[:rows], dim=1)


def test_windows_are_means_about_the_lag():
    a, b = walk(60, 0), walk(70, 1)
    found = windows(a, b, 5)
    means = (a @ b.T).diagonal(5 + 2)[24 : 24 + WINDOW].mean()
    assert torch.allclose(found[3, REACH + 2], means)
    assert found[0, 0].isnan() and found[0, REACH].isfinite()  # the first rows have no partner 12 frames earlier
    a, b = walk(WINDOW + 2 * REACH, 0)[REACH:-REACH], walk(WINDOW + 2 * REACH, 1)
    means = torch.stack([(a * b[REACH + d : REACH + d + WINDOW]).sum(1).mean() for d in range(-REACH, REACH + 1)])
    share = torch.softmax(SOFTMAX_SHARPNESS * means, dim=0)[REACH - 1 : REACH + 2].sum().item()
    assert math.isclose(evidence(a, b, REACH), math.log((1 - OUTLIER_SHARE) * share * 25 / 3 + OUTLIER_SHARE), rel_tol=1e-9)


def test_agreement_adds_up_and_disagreement_too_and_missing_frames_say_nothing():
    a = walk(120, 0)
    b = torch.cat([walk(7, 2), a])
    right, beside, unrelated = evidence(a, b, 7), evidence(a, b, 13), evidence(a, walk(120, 3), 7)
    assert right > 20 and beside < -20 and -30 < unrelated < 5
    assert right > evidence(a[:60], b, 7) > 5
    assert evidence(a, torch.zeros_like(a), 0) == 0.0 == evidence(a, a, 200)
