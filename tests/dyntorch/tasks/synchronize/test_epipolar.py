"""How well points fit at every lag: against a loop over the lags, and peaks against a finer search."""

import math

import pytest
import scipy.optimize
import torch

from dyntorch.geometry.epipolar import epipolar_variance
from dyntorch.geometry.homogeneous import homogeneous
from dyntorch.scenes import filmed_person
from dyntorch.tasks.synchronize.epipolar import Grid, Samples, ShiftDescent, epipolar_curve
from dyntorch.tasks.synchronize.tracks import read_tracks, smooth_at
from tests.draws import seeded

FRAME = 1 / 30


def scene_of(seed=0, **more):
    return filmed_person(10, **{"seconds": 2.0, "noise": 1.0, "generator": seeded(seed)} | more)


def tracks_of(scene, noise=0.0, seed=0):
    draw = seeded(seed)
    parts = (x + noise * torch.randn(x.shape, generator=draw, dtype=torch.float64) for x in (scene.a, scene.b))
    return [read_tracks(name, x, None, t, None) for name, x, t in zip("ab", parts, scene.times, strict=True)]


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


def test_the_search_ends_at_the_largest_shift():
    scene = scene_of(1, offset=0.3)
    curve = epipolar_curve(samples_of(scene), 0.5)
    whole = epipolar_curve(samples_of(scene))
    assert (float(curve.lags[0]), float(curve.lags[-1])) == pytest.approx((-0.5, 0.5))
    same = (whole.lags[:, None] - curve.lags).abs().argmin(0)
    assert torch.allclose(whole.variance[same], curve.variance, rtol=1e-6)
    far = read_tracks("b", scene.b, None, scene.times[1] + 100, None)
    curve = epipolar_curve(Samples.of(tracks_of(scene)[0], far, FRAME), 1.0)
    assert len(curve.scores) == 0 and curve.peaks(3) == []


def test_some_points_alone_and_takes_longer_than_a_piece(monkeypatch):
    scene = scene_of(5, noise=0.5)
    chosen = torch.tensor([True, False] * 5)
    samples = samples_of(scene).only(chosen)
    assert samples.x1.shape[1] == 5
    moments = [at_lag(samples, lag)[0] for lag in (-3, 0, 4)]
    curve = epipolar_curve(samples)
    lo = samples.lags(None)[0]
    assert curve.variance[torch.tensor([-3, 0, 4]) - lo].tolist() == pytest.approx(moments, rel=1e-4)
    monkeypatch.setattr("dyntorch.tasks.synchronize.epipolar.PIECE", 17)
    assert torch.allclose(epipolar_curve(samples).scores, curve.scores, atol=1e-6, equal_nan=True)


def sampson(F, p, q):
    """Signed distances, px."""
    value = torch.einsum("ni,ij,nj->n", q, F, p)
    return value / ((q @ F)[:, :2].square().sum(-1) + (p @ F.mT)[:, :2].square().sum(-1)).sqrt()


def test_positions_between_the_steps_of_a_grid_are_those_of_smoothing():
    scene = filmed_person(6, seconds=3.0, generator=seeded(1))
    for noise in (0.0, 2.0):
        tracks = tracks_of(scene, noise)[1]
        grid = Grid.of(tracks, FRAME)
        at = 0.2 + 2.5 * torch.rand(200, generator=seeded(2), dtype=torch.float64)
        expected, _, sure = smooth_at(tracks, at, FRAME)
        x, v, weights = grid.at(at)
        assert bool((sure > 0).all()) and torch.allclose(weights, sure, atol=0.01)
        assert float((x - expected).abs().max()) < 0.01 + 0.02 * noise
        assert float((x - expected).square().mean().sqrt()) < 0.002 + 0.005 * noise
        # the velocity is smoothed more widely
        ahead, behind = (grid.at(at + sign * 0.01)[0] for sign in (1, -1))
        slope = (ahead - behind) / 0.02
        assert float((v - slope).square().mean().sqrt()) < 10 + 40 * noise
        if not noise:
            assert float((v - slope).square().mean().sqrt() / slope.square().mean().sqrt()) < 0.1


def test_noise_of_a_grid_does_not_depend_on_the_place_between_frames():
    frames = 3000
    tracks = read_tracks("b", torch.randn(frames, 3, 2, generator=seeded(), dtype=torch.float64), 30.0, None, None)
    grid, middle = Grid.of(tracks, FRAME), torch.arange(10, frames - 10, dtype=torch.float64)
    left = [float(grid.at((middle + phase) * FRAME)[0].square().mean()) for phase in torch.linspace(0, 1, 9).tolist()]
    assert max(left) / min(left) < 1.015
    # none in gaps and beyond the take
    x = torch.zeros(60, 2, 2)
    x[20:40, 1] = torch.nan
    _, _, weights = Grid.of(read_tracks("b", x, 30.0, None, None), FRAME).at(torch.tensor([-0.1, 0.3, 1.0, 1.7, 2.5]).double())
    assert (weights > 0).tolist() == [[False, False], [True, True], [True, False], [True, True], [False, False]]


@pytest.mark.parametrize("seed", range(2))
def test_the_minimum_is_that_of_a_general_solver(seed):
    a, b = tracks_of(filmed_person(9, seconds=1.5, offset=0.113, generator=seeded(seed)), 1.0, seed)
    fit = ShiftDescent(a, b, FRAME).run(0.113)
    x1, _, w1 = smooth_at(a, a.times, FRAME)
    centre, size = torch.tensor([640.0, 480.0], dtype=torch.float64), 300.0
    own = (w1 > 0.5) & (a.times > 0.25)[:, None] & (a.times < 1.25)[:, None]  # seen in both whatever the shift
    p = homogeneous(((x1 - centre) / size)[own])

    def residuals(theta):
        x2, _, _ = smooth_at(b, a.times + float(theta[0]), FRAME)
        A, B = torch.from_numpy(theta[1:]).reshape(2, 3, 2)  # of rank 2
        return (size * sampson(A @ B.mT, p, homogeneous(((x2 - centre) / size)[own]))).numpy()

    change = torch.tensor([[size, 0, 640.0], [0, size, 480.0], [0, 0, 1]], dtype=torch.float64)
    U, S, Vh = torch.linalg.svd(change.mT @ fit.fundamental @ change)
    start = torch.cat([torch.tensor([0.12]), (U[:, :2] * S[:2]).flatten() / S[0], Vh[:2].mT.flatten()]).numpy()
    found = scipy.optimize.least_squares(residuals, start, x_scale=[0.01] + [1.0] * 12)
    assert fit.offset == pytest.approx(found.x[0], abs=0.6 * fit.sigma)  # weights and edges differ a little
    assert (2 * found.cost / len(p)) ** 0.5 == pytest.approx(fit.residual, rel=0.15)


@pytest.mark.parametrize("start", [-1.4, -0.5, 0.0, 0.8, 1.5])
def test_starts_within_a_frame_or_two_lead_to_the_same_minimum(start):
    a, b = tracks_of(filmed_person(12, seconds=3.0, offset=0.4, generator=seeded(4)), 1.0)
    fit = ShiftDescent(a, b, FRAME).run(0.4 + start * FRAME)
    assert fit.offset == pytest.approx(0.4, abs=0.03 * FRAME)
    again = ShiftDescent(a, b, FRAME).run(fit.offset)
    assert again.offset == pytest.approx(fit.offset, abs=1e-4 * FRAME)
    descent = ShiftDescent(a, b, FRAME)
    *near, far = descent.variances([*(fit.offset + 0.1 * k * FRAME for k in (-1, 0, 1)), 5.0])
    assert near[1] == min(near) and far == math.inf


def test_exact_cameras_give_the_fundamental_matrix_and_distances_in_pixels():
    scene = filmed_person(15, seconds=4.0, offset=0.3, generator=seeded(5))
    fit = ShiftDescent(*tracks_of(scene), FRAME).run(0.3)
    F = fit.fundamental
    assert float(F.norm()) == pytest.approx(1.0)
    assert float(torch.linalg.svdvals(F)[2]) < 1e-12
    x2 = filmed_person(15, seconds=4.0, generator=seeded(5)).exact[1]  # b at a's moments
    away = sampson(F, homogeneous(scene.exact[0].flatten(0, 1)), homogeneous(x2.flatten(0, 1)))
    assert float(away.square().mean().sqrt()) < 0.2  # what smoothing leaves
    assert fit.offset == pytest.approx(0.3, abs=0.005 * FRAME)
    scene = filmed_person(8, seconds=2.0, offset=0.2, missing=0.2, generator=seeded(10))
    a, b = tracks_of(scene, 1.0)
    fit = ShiftDescent(a, b, FRAME).run(0.2)
    x1, _, w1 = smooth_at(a, fit.times, FRAME)
    x2, _, w2 = smooth_at(b, fit.times + fit.offset, FRAME)
    seen = fit.distances.isfinite()
    assert int(seen.sum()) > 200
    assert float((((w1 * w2) > 0) == seen).double().mean()) > 0.95
    # in px of a: the noise of b is taken into its units
    own = sampson(fit.fundamental, homogeneous(x1[seen]), homogeneous(x2[seen])) / fit.residual
    assert float(torch.corrcoef(torch.stack([own, fit.distances[seen]]))[0, 1].abs()) > 0.99
    assert 1.4826 * float(fit.distances[seen].abs().median()) == pytest.approx(1.0)


@pytest.mark.slow
def test_sigma_is_the_scatter_of_repeated_draws():
    scene = filmed_person(12, seconds=2.5, offset=0.123, generator=seeded(6))
    fits = [ShiftDescent(*tracks_of(scene, 1.5, seed), FRAME).run(0.123) for seed in range(30)]
    errors = torch.tensor([fit.offset - 0.123 for fit in fits], dtype=torch.float64)
    sigmas = torch.tensor([fit.sigma for fit in fits], dtype=torch.float64)
    assert 0.4 < float((errors / sigmas).square().mean().sqrt()) < 1.7
    assert abs(float(errors.mean())) < 0.02 * FRAME + 3 * float(errors.std()) / 30**0.5
    assert float(sigmas.max() / sigmas.min()) < 4
    smooth = (0.5 / math.sqrt(math.pi)) ** 0.5
    assert torch.tensor([fit.residual for fit in fits]).mean().item() == pytest.approx(1.5 * smooth, rel=0.15)


@pytest.mark.slow
def test_fractions_of_a_frame_do_not_draw_the_estimate():
    scenes = {phase: filmed_person(12, seconds=2.5, offset=phase * FRAME, generator=seeded(7)) for phase in (0.0, 0.25, 0.5)}
    for phase, scene in scenes.items():
        fits = [ShiftDescent(*tracks_of(scene, 3.0, seed), FRAME).run(phase * FRAME) for seed in range(7)]
        errors = torch.tensor([fit.offset / FRAME - phase for fit in fits])
        assert abs(float(errors.mean())) < 3.5 * float(errors.std()) / 7**0.5 + 0.005  # splines: drawn by .1 to halves


def test_the_rate_is_found_and_long_takes_are_thinned():
    scene = filmed_person(10, seconds=12.0, rate=1.004, offset=0.3, generator=seeded(8))
    fit = ShiftDescent(*tracks_of(scene, 1.0), FRAME).run(0.32, 1.003, free_rate=True)
    assert abs(fit.rate - 1.004) < 4 * fit.rate_sigma < 1e-3
    assert fit.offset + fit.rate * fit.center == pytest.approx(0.3 + 1.004 * fit.center, abs=4 * fit.sigma)
    assert fit.shift == pytest.approx(fit.offset + (fit.rate - 1) * fit.center)
    held = ShiftDescent(*tracks_of(scene, 1.0), FRAME).run(0.32, 1.004)
    assert held.rate == 1.004 and held.rate_sigma == 0
    a, b = tracks_of(filmed_person(10, seconds=4.0, offset=0.2, generator=seeded(11)), 1.0)
    whole, thin = ShiftDescent(a, b, FRAME).run(0.2), ShiftDescent(a, b, FRAME, rows=300).run(0.2)
    assert len(thin.times) <= 31 < len(whole.times)
    assert thin.offset == pytest.approx(whole.offset, abs=3 * (thin.sigma + whole.sigma))
    assert 20 < thin.effective < whole.effective
    assert ShiftDescent(a, b, FRAME).run(5.0) is None  # nothing in common
