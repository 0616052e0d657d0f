"""Descent of the Sampson distance: derivatives by finite differences, minima by the perturbations that do not improve them."""

import pytest
import torch

from dyntorch.geometry.epipolar import PairMonomials, affine_fundamental, eight_point, sampson_squared
from dyntorch.geometry.epipolar_fit import FEW, Frames, Products, _normal_equations, descend, fit_fundamental
from dyntorch.geometry.homogeneous import skew, unit
from dyntorch.metrics import relative_error
from tests.draws import random
from tests.dyntorch.geometry.test_epipolar import rms, scene

ONES = torch.ones(1, 60, dtype=torch.float64)


def test_frames_hold_the_nearest_matrix_of_rank_two_and_stay_frames():
    F = random(20, 3, 3)
    u, s, vt = torch.linalg.svd(F)
    expected = unit((u[..., :2] * s[:, None, :2]) @ vt[:, :2])
    assert relative_error(Frames.of(F).matrix().unflatten(-1, (3, 3)), expected).max() < 1e-12
    frames, step = Frames.of(F).retract(random(20, 7, seed=1)), 1e-3 * random(20, 7, seed=2)
    torch.testing.assert_close(frames.turns @ frames.turns.mT, torch.eye(3).double().expand(20, 2, 3, 3))
    torch.testing.assert_close(frames.matrix().norm(dim=-1), torch.ones(20).double())
    assert torch.linalg.det(frames.matrix().unflatten(-1, (3, 3))).abs().max() < 1e-15
    # a small step turns by the exponential
    axes = torch.nn.functional.pad(step[:, :4].unflatten(-1, (2, 2)), (0, 1))
    torch.testing.assert_close(frames.retract(step).turns, frames.turns @ torch.linalg.matrix_exp(skew(axes)), atol=1e-8, rtol=0)


@pytest.mark.parametrize("count", [FEW, FEW + 1])
@pytest.mark.parametrize("start", [torch.diag(torch.tensor([1.0, 1.0, 0.0])), torch.diag(torch.tensor([1.0, 0.0, 0.0])), None])
def test_derivative_by_finite_differences(start, count):
    frames = Frames.of(random(count, 3, 3) if start is None else start.double().expand(count, 3, 3))
    data = PairMonomials(*random(2, 11, 2, seed=1))
    weights = torch.rand(count, 11, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def residual(step):
        value, square = data.flat_terms(frames.retract(step).matrix())
        return value / square.sqrt()

    steps = 1e-6 * torch.eye(7, dtype=torch.float64)[:, None].expand(7, count, 7)
    slopes = torch.stack([(residual(step) - residual(-step)) / 2e-6 for step in steps], dim=1)
    value, square = data.flat_terms(frames.matrix())
    inverse = 20.0  # a scale at which some of the matches are cut off
    kept = weights * (1 - value.square() / square * inverse / 2.25).clamp(min=0)
    assert (kept == 0).any()
    expected = (slopes * kept[:, None]) @ slopes.mT, (slopes @ (kept * residual(steps[0] * 0))[..., None])[..., 0]
    matrix, gradient = _normal_equations(Products(data), frames, frames.matrix(), value, square, weights, inverse)
    torch.testing.assert_close(matrix, expected[0], rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(gradient, expected[1], rtol=1e-6, atol=1e-8)


def test_descent_ends_in_a_minimum():
    x1, x2, _ = scene(60, 1.0)
    F = descend(eight_point(x1, x2, ONES), x1, x2, ONES, scale=100.0, steps=20)
    least = sampson_squared(F, x1, x2).sum()
    around = Frames.of(F.expand(200, 3, 3)).retract(1e-4 * random(200, 7)).matrix().unflatten(-1, (3, 3))
    assert (sampson_squared(around, x1, x2).sum(-1) > least).all()
    # the start does not matter
    far = descend(affine_fundamental(x1, x2, ONES), x1, x2, ONES, scale=100.0, steps=40)
    torch.testing.assert_close(sampson_squared(far, x1, x2).sum(), least)


def test_descent_never_gets_worse_and_is_that_of_each_problem():
    x1, x2, truth = scene(60, 0.5)
    x2 = x2.clone()
    x2[:15] = random(15, 2)
    starts = torch.cat([random(20, 3, 3), unit(truth + 0.05 * random(10, 3, 3, seed=3)), torch.zeros(1, 3, 3).double()])
    weights = torch.rand(31, 60, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    F = descend(starts, x1, x2, weights, scale=0.02, steps=4)

    def cost(F):
        return (weights * (sampson_squared(F, x1, x2) / 0.02**2).clamp(max=2.25)).sum(-1)

    before = cost(Frames.of(starts).matrix().unflatten(-1, (3, 3)))
    assert (cost(F) <= before + 1e-12).all()
    assert (cost(F)[20:30] < 0.5 * before[20:30]).sum() >= 8
    single = torch.cat([descend(starts[k : k + 1], x1, x2, weights[k : k + 1], 0.02, 4) for k in (0, 7, 25)])
    assert relative_error(F[[0, 7, 25]], single).max() < 1e-6
    assert descend(starts[:0], x1, x2, weights[:0], 0.02).shape == (0, 3, 3)


def test_fit_ignores_outliers_and_reaches_the_least_squares_of_the_inliers():
    x1, x2, _ = scene(60, 0.5)
    bad = x2.clone()
    bad[:9] += 0.3 * random(9, 2)
    F, cost = fit_fundamental(x1, bad, ONES, scales=(6 / 300, 3 / 300, 2 / 300), steps=6)
    inliers = ONES * (torch.arange(60) >= 9)
    best = descend(eight_point(x1, x2, inliers), x1, x2, inliers, scale=1.0, steps=20)
    assert rms(F, x1[9:], x2[9:]) < 1.1 * rms(best, x1[9:], x2[9:])
    ratio = (sampson_squared(F, x1, bad) * 150**2).clamp(max=2.25)
    torch.testing.assert_close(cost, ratio.sum(-1))


def test_fit_of_a_small_body_and_of_an_affine_one():
    x1, x2, _ = scene(60, 0.3)
    small, offset = 0.15, torch.tensor([0.8, -0.6], dtype=torch.float64)
    F, _ = fit_fundamental(small * x1 + offset, small * x2 + offset, ONES, scales=(0.003, 0.0015, 0.001))
    whole, _ = fit_fundamental(x1, x2, ONES, scales=(0.02, 0.01, 1 / 150), steps=20)
    assert rms(F, small * x1 + offset, small * x2 + offset) < 1.02 * small * rms(whole, x1, x2)
    y2 = x1 @ random(2, 2, seed=1) + random(60, 1, seed=2) * random(2, seed=3) + 0.001 * random(60, 2, seed=4)
    F, _ = fit_fundamental(x1, y2, ONES, scales=(0.02, 0.01, 1 / 150))
    assert rms(F, x1, y2) <= rms(affine_fundamental(x1, y2, ONES), x1, y2)


def test_fit_never_loses_a_given_start():
    x1, x2, truth = scene(60, 0.1)
    x2 = x2.clone()
    x2[:40] = random(40, 2)
    given = torch.stack([truth, unit(random(3, 3))])[None]
    F, cost = fit_fundamental(x1, x2, ONES, scales=(0.1, 0.002), starts=given, steps=3)
    start = (sampson_squared(truth, x1, x2) / 0.002**2).clamp(max=2.25).sum()
    assert cost <= start + 1e-9
    assert relative_error(F, truth) < 0.05
    with pytest.raises(ValueError, match="scales must be positive"):
        fit_fundamental(x1, x2, ONES, scales=(0.0,))
