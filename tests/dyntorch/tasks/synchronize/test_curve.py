"""How well points fit at every lag: against a loop over the lags, and peaks against a finer search."""

import math

import pytest
import torch

from dyntorch.geometry.epipolar import epipolar_variance
from dyntorch.geometry.homogeneous import homogeneous
from dyntorch.scenes import filmed
from dyntorch.tasks.synchronize.epipolar import Samples, epipolar_curve
from dyntorch.tasks.synchronize.tracks import read_tracks, smooth_at


def scene_of(seed=0, **more):
    return filmed(10, **{"seconds": 2.0, "noise": 1.0, "generator": torch.Generator().manual_seed(seed)} | more)


def tracks_of(scene):
    return tuple(read_tracks(name, x, None, t, None) for name, x, t in zip("ab", (scene.a, scene.b), scene.times, strict=True))


def samples_of(scene, step=1 / 30, rate=1.0):
    return Samples.of(*tracks_of(scene), step, rate)


def at_lag(samples, lag):
    """Variance and number of pairs of one lag in steps, match by match."""
    first = torch.arange(max(0, -lag), min(len(samples.x1), len(samples.x2) - lag))
    if not len(first):
        return math.nan, 0.0
    sure = samples.w1[first] * samples.w2[first + lag]
    both = sure > 0
    p, q = homogeneous(samples.x1[first][both]), homogeneous(samples.x2[first + lag][both])
    z = torch.einsum("ni,nj->nij", q, p).flatten(1)
    variance, _ = epipolar_variance(z.mT @ (sure[both][:, None] * z), samples.noise)
    return float(variance), float(sure.sum())


@pytest.mark.parametrize("more", [{}, {"missing": 0.3}, {"fps": (30.0, 25.0), "offset": 0.3}])
def test_the_curve_is_a_loop_over_lags(more):
    samples = samples_of(scene_of(**more))
    curve = epipolar_curve(samples)
    lo, hi = samples.lags(None)
    assert (lo, hi) == (1 - len(samples.x1), len(samples.x2) - 1)
    expected = [at_lag(samples, lag) for lag in range(lo, hi + 1)]
    counts = torch.tensor([count for _, count in expected], dtype=torch.float64)
    assert torch.allclose(curve.counts, counts, atol=1e-6)
    judged = curve.scores.isfinite()
    assert torch.equal(judged, (counts >= 0.25 * counts.max()) & (counts >= 24))
    variance = torch.tensor([value for value, _ in expected], dtype=torch.float64)
    assert torch.allclose(curve.variance[judged], variance[judged], rtol=1e-4)
    scores = -0.5 * (variance[judged] / variance[judged].median()).log() + 0.5 * (counts[judged] / counts.max()).log()
    assert torch.allclose(curve.scores[judged], scores, atol=1e-4)
    assert curve.lags.diff().tolist() == pytest.approx([1 / 30] * (hi - lo))


@pytest.mark.parametrize(
    ("offset", "fps"), [(0.0, (30.0, 30.0)), (-0.415, (30.0, 30.0)), (0.37, (30.0, 24.0)), (0.2, (25.0, 60.0))]
)
def test_the_best_peak_is_the_shift(offset, fps):
    scene = scene_of(1, seconds=3.0, offset=offset, fps=fps)
    step = 1 / min(fps)
    curve = epipolar_curve(samples_of(scene, step))
    (lag, score), *others = curve.peaks(6)
    assert lag == pytest.approx(offset, abs=0.1 * step)
    assert all(score > other for _, other in others)
    assert [value for _, value in others] == sorted((value for _, value in others), reverse=True)
    assert curve.misfit(lag) > max(curve.misfit(other) for other, _ in others)


def test_lags_are_those_of_the_clocks():
    scene = scene_of(2, offset=0.25)
    later = tuple(
        read_tracks(n, x, None, t + s, None) for n, x, t, s in zip("ab", (scene.a, scene.b), scene.times, (3, 8), strict=True)
    )
    here, there = (
        epipolar_curve(samples_of(scene)),
        epipolar_curve(Samples.of(*later, 1 / 30)),
    )
    assert torch.allclose(there.lags, here.lags + 5, atol=1e-9)
    assert torch.allclose(there.scores, here.scores, atol=1e-6, equal_nan=True)


def test_another_clock_rate_is_taken_out():
    scene = scene_of(3, seconds=8.0, rate=1.02, offset=0.3)
    right, wrong = (epipolar_curve(samples_of(scene, rate=rate)) for rate in (1.02, 1.0))
    assert right.peaks(1)[0][1] > wrong.peaks(1)[0][1] + 0.3
    assert float(right.offsets[int(right.scores.nan_to_num(-math.inf).argmax())]) == pytest.approx(0.3, abs=0.03)


def test_the_search_ends_at_the_largest_shift():
    scene = scene_of(1, offset=0.3)
    curve = epipolar_curve(samples_of(scene), 0.5)
    whole = epipolar_curve(samples_of(scene))
    assert (float(curve.lags[0]), float(curve.lags[-1])) == pytest.approx((-0.5, 0.5))
    same = (whole.lags[:, None] - curve.lags).abs().argmin(0)
    assert torch.allclose(whole.variance[same], curve.variance, rtol=1e-6)


def test_no_lag_within_the_largest_shift_gives_an_empty_curve():
    scene = scene_of(1)
    far = read_tracks("b", scene.b, None, scene.times[1] + 100, None)
    curve = epipolar_curve(Samples.of(tracks_of(scene)[0], far, 1 / 30), 1.0)
    assert len(curve.scores) == 0 and curve.peaks(3) == []


def test_a_take_longer_than_a_piece_is_the_same(monkeypatch):
    samples = samples_of(scene_of(4))
    whole = epipolar_curve(samples)
    monkeypatch.setattr("dyntorch.tasks.synchronize.epipolar.PIECE", 17)
    assert torch.allclose(epipolar_curve(samples).scores, whole.scores, atol=1e-6, equal_nan=True)


def test_some_points_alone():
    scene = scene_of(5, noise=0.5)
    chosen = torch.tensor([True, False] * 5)
    samples = samples_of(scene).only(chosen)
    assert samples.x1.shape[1] == 5
    moments = [at_lag(samples, lag)[0] for lag in (-3, 0, 4)]
    curve = epipolar_curve(samples)
    lo = samples.lags(None)[0]
    assert curve.variance[torch.tensor([-3, 0, 4]) - lo].tolist() == pytest.approx(moments, rel=1e-4)


def test_samples_are_the_smoothed_tracks_normalized():
    scene = scene_of(6, missing=0.2)
    a, b = tracks_of(scene)
    samples = Samples.of(a, b, 0.04)
    at = torch.arange(10, dtype=torch.float64) * 0.04
    x, _, w = smooth_at(b, at, 0.04)
    seen = w > 0
    expected = (homogeneous(x) @ b.change.mT)[..., :2]
    assert torch.allclose(samples.x2[:10][seen], expected[seen]) and not samples.x2[:10][~seen].any()
    assert float(samples.x1[samples.w1 > 0].square().sum(-1).mean()) == pytest.approx(2, rel=0.05)


def test_the_variance_at_the_shift_is_that_of_the_smoothed_noise():
    scene = scene_of(7, noise=2.0, seconds=4.0)
    curve = epipolar_curve(samples_of(scene))
    smooth = 0.5 / math.sqrt(math.pi)  # of white noise, by a Gaussian kernel of one frame
    assert float(curve.variance.min()) == pytest.approx(4 * smooth, rel=0.2)
