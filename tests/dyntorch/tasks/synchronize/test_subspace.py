"""Two cameras that track different points: information against determinants, what must not matter, and what must be refused."""

import math

import pytest
import torch

from dyntorch.tasks.synchronize.row_spaces import LagCovariances
from dyntorch.tasks.synchronize.subspace import (
    HEIGHT_SAMPLE_RATE,
    MOTION_SAMPLE_RATE,
    SHAPE_SAMPLE_RATE,
    SubspaceCurve,
    body_of,
    smooth,
    subspace_curve,
    subspace_shift,
)
from tests.draws import random, seeded


def uniform(seed, *shape):
    return torch.rand(*shape, generator=seeded(seed), dtype=torch.float64)


def scene(frames, shift, n=7, m=9, noise=0.3, seed=0, modes=6):
    """Points of a body that moves in ways which never repeat, in two affine cameras with different points; px."""
    pace, phase, bend = 0.04 + 0.2 * uniform(seed, modes), 6.3 * uniform(seed + 1, modes), 1e-3 * random(modes, seed=seed + 2)

    def film(times, points, key):
        ways = torch.sin(pace * times[:, None] + bend * times[:, None] ** 2 + phase)
        place = torch.cat([ways, 0.01 * times[:, None], torch.ones(len(times), 1, dtype=torch.float64)], dim=1)
        mix = torch.cat(
            [
                8 * random(modes, points, 2, seed=key),
                30 * random(1, 1, 2, seed=key + 1).expand(1, points, 2),
                60 * random(1, points, 2, seed=key + 2),
            ]
        )
        return torch.einsum("tk,knd->tnd", place, mix) + noise * random(len(times), points, 2, seed=key + 3)

    times = torch.arange(frames, dtype=torch.float64)
    return film(times, n, seed + 10), film(times - shift, m, seed + 20)


def full(x):
    return torch.ones(x.shape[:2], dtype=torch.float64)


def curve_of(a, b, lags=(-40, 40), step=1 / 30):
    return subspace_curve(a, b, full(a), full(b), lags, step=step)


def test_scores_are_those_of_every_overlap_by_itself():
    a, b = scene(80, 5)
    curve, one, two = curve_of(a, b, (-20, 20)), body_of(a, full(a)), body_of(b, full(b))
    raw = []
    for lag in (-20, -3, 5, 20):
        start, end = max(0, -lag), min(76, 76 - lag)  # without the ends
        both = torch.cat([one.rows[start:end], two.rows[start + lag : end + lag]], dim=1)
        c, n = torch.cov(both.T, correction=0) + torch.eye(both.shape[1], dtype=torch.float64), one.rows.shape[1]
        raw.append(0.5 * float(torch.logdet(c[:n, :n]) + torch.logdet(c[n:, n:]) - torch.logdet(c)))
        assert curve.counts[lag + 20] == end - start
    told = [float(curve.shape[lag + 20]) for lag in (-20, -3, 5, 20)]
    chance = [before - after for before, after in zip(raw, told, strict=True)]
    slope = (chance[0] - chance[1]) / (1 / 56 - 1 / 73)  # a line in 1 / count
    assert chance[0] == pytest.approx(chance[3], abs=1e-9)
    assert chance[2] == pytest.approx(chance[1] + slope * (1 / 71 - 1 / 73), abs=1e-9)


@pytest.mark.parametrize("shift", [-17.0, -4.5, 0.0, 11.3, 23.75])
def test_the_shift_of_different_points_is_found_between_frames(shift):
    a, b = scene(120, shift)
    found = subspace_shift(curve_of(a, b))
    assert found.ok
    assert not found.reason
    assert found.position == pytest.approx(shift, abs=0.3)
    assert found.probability > 0.95
    assert abs(found.position - shift) < 4 * found.sigma


def test_neither_unit_nor_place_nor_order_matter():
    a, b = scene(90, 7)
    curve = curve_of(a, b)
    order = torch.randperm(9, generator=seeded(3))
    moved = curve_of(0.01 * a - 5, 40 * b[:, order] + torch.tensor([1000.0, -300.0]))
    assert torch.allclose(curve.scores, moved.scores, atol=1e-6, equal_nan=True)
    back = curve_of(b, a)
    assert torch.allclose(curve.motion, back.motion.flip(0), atol=1e-9)
    assert subspace_shift(back).position == pytest.approx(-subspace_shift(curve).position, abs=0.1)
    counted = (
        curve.counts
        / 30
        * (SHAPE_SAMPLE_RATE * curve.shape + HEIGHT_SAMPLE_RATE * curve.height + MOTION_SAMPLE_RATE * curve.motion)
    )
    judged = curve.scores.isfinite()
    assert torch.allclose(curve.scores[judged], counted[judged], atol=1e-9)


@pytest.mark.parametrize("fps", [20, 24, 25, 60])
def test_other_frame_rates_need_their_step(fps):
    a, b = scene(120, 9)
    times = torch.arange(4 * fps, dtype=torch.float64) * (30 / fps)
    times = times[times < 118]
    before, share = times.long(), (times % 1)[:, None, None]
    coarse = [torch.lerp(x[before], x[before + 1], share) for x in (a, b)]
    found = subspace_shift(curve_of(*coarse, (-fps, fps), step=1 / fps), step=1 / fps)
    assert found.position / fps == pytest.approx(9 / 30, abs=0.5 / 30)
    assert found.probability > 0.95


def test_missing_blocks_are_filled_from_the_other_points():
    a, b = scene(120, 9.5)
    wa, wb = full(a), full(b)
    for j in range(7):
        wa[10 * j : 10 * j + 25, j] = 0
        wb[12 * j + 5 : 12 * j + 30, j] = 0
    spoiled = torch.where(wa[..., None] > 0, a, torch.nan)
    found = subspace_shift(subspace_curve(spoiled, b + 1e3 * (wb == 0)[..., None], wa, wb, (-40, 40)))
    assert found.ok and found.position == pytest.approx(9.5, abs=0.4)


def test_frames_that_nobody_is_seen_in_do_not_count():
    a, b = scene(130, 6)
    wa = full(a)
    wa[50:70] = 0
    curve = subspace_curve(a, b, wa, full(b), (-30, 30))
    assert curve.counts[30] == 106
    assert subspace_shift(curve).position == pytest.approx(6, abs=0.4)


def repeated(period, frames, points, key, start=0.0):
    turn = 2 * math.pi / period * (torch.arange(frames, dtype=torch.float64) + start)
    waves = torch.stack(
        [(k * turn).sin() for k in (1, 2, 3)] + [(k * turn).cos() for k in (1, 2, 3)] + [torch.ones_like(turn)], dim=1
    )
    return torch.einsum("tk,knd->tnd", waves, 20 * random(7, points, 2, seed=key)) + random(frames, points, 2, seed=key + 1)


CHANCE = [84, 113, 258]  # estimates of the period that happen to differ


@pytest.mark.parametrize(
    ("period", "keys", "start"),
    [(20 + 2 * seed, (100 + seed, 200 + seed), -9.3) for seed in range(8)]
    + [(18 + (seed % 29) * 1.13, (100003 + 7 * seed, 500009 + 7 * seed), -9.3 + seed % 11) for seed in CHANCE],
)
def test_motion_that_repeats_itself_is_refused(period, keys, start):
    a, b = repeated(period, 120, 8, keys[0]), repeated(period, 120, 8, keys[1], start=start)
    found = subspace_shift(curve_of(a, b, (-60, 60)))
    assert not found.ok
    assert "shifts" in found.reason or "motion" in found.reason
    assert len(found.peaks) > 1


def test_noise_that_keeps_for_some_frames_is_told_by_sigma():
    errors, sigmas = [], []
    for seed in range(8):
        a, b = scene(120, 6.4, seed=100 * seed)
        slow = [3 * smooth(random(*x.shape, seed=7 + seed + k), 4.0) for k, x in enumerate((a, b))]
        found = subspace_shift(curve_of(a + slow[0], b + slow[1], (-25, 25)))
        errors.append(abs(found.position - 6.4))
        sigmas.append(found.sigma)
    ratio = torch.tensor(errors) / torch.tensor(sigmas)
    assert float(ratio.median()) < 1.3
    assert float(ratio.max()) < 4


@pytest.mark.parametrize("seed", range(8))
def test_noise_without_motion_is_refused(seed):
    a, b = (100 * random(1, 8, 2, seed=key) + random(100, 8, 2, seed=key + 50) for key in (seed, seed + 500))
    found = subspace_shift(curve_of(a, b))
    assert not found.ok
    assert found.reason


def test_nothing_to_go_by_is_refused_without_a_number_that_is_not():
    found = subspace_shift(curve_of(*scene(20, 0), (-10, 10)))
    assert (found.ok, found.position, len(found.peaks)) == (False, 0.0, 0)
    assert "overlap" in found.reason
    for frames in (1, 2, 3, 30):
        x = torch.full((frames, 3, 2), torch.nan, dtype=torch.float64)
        assert not subspace_shift(subspace_curve(x, x, full(x) * 0, full(x) * 0, (-5, 5))).ok
    still = torch.zeros(100, 5, 2, dtype=torch.float64)
    assert not subspace_shift(curve_of(still, still)).ok


def test_the_parabola_and_the_posterior_of_a_known_curve():
    lags = torch.arange(-30, 31).double()
    scores, counts = 30 - 0.5 * (lags - 3.4) ** 2 / 0.2, torch.full((61,), 100.0, dtype=torch.float64)
    found = subspace_shift(SubspaceCurve(lags, scores, counts, scores, scores, scores, (5.0, 5.0)))
    assert found.position == pytest.approx(3.4, abs=1e-9)
    weights = torch.softmax(scores, 0)
    assert found.probability == pytest.approx(float(weights[32:35].sum()), abs=1e-9)
    assert found.sigma == pytest.approx(math.hypot(0.2, math.sqrt(0.2)), abs=1e-9)


def test_covariances_in_units_of_the_noise_are_those_of_rows_in_these_units():
    a, b = random(40, 4, seed=1), random(40, 3, seed=2)
    scaled = LagCovariances.of(a, b, (-3, 3)).scale((0.25, 9.0))
    expected = LagCovariances.of(a / 0.5, b / 3, (-3, 3))
    for part in ("aa", "bb", "ab", "counts"):
        torch.testing.assert_close(getattr(scaled, part), getattr(expected, part))
