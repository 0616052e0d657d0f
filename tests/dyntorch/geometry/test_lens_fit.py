"""Lenses fitted to matches: against scenes seen through known lenses, and finite differences."""

import math

import pytest
import torch

from dyntorch.geometry import lens as lens_module
from dyntorch.geometry.epipolar_fit import Frames
from dyntorch.geometry.lens import Division, LensDescent, LensMatches, distort, fit_distortion
from dyntorch.scenes import two_view

SIZE = (640.0, 480.0)


def inside(views):
    """The matches within both pictures."""
    within = torch.stack([((x > 0) & (x < torch.tensor(SIZE))).all(-1) for x in views]).all(0)
    return [x[within] for x in views]


def seen(strengths, n=400, noise=0.0, seed=0):
    """Matches as lenses of the given lambda show them, with noise on what is measured."""
    generator = torch.Generator().manual_seed(seed)
    views = inside(two_view(n, generator=generator).views)
    bent = [Division.of(x, SIZE, value).distort(x) for x, value in zip(views, strengths, strict=True)]
    return [x + noise * torch.randn(x.shape, generator=generator, dtype=x.dtype) for x in bent]


@pytest.mark.slow
@pytest.mark.parametrize("strengths", [(-0.2, -0.1), (0.0, -0.3), (-0.5, -0.45), (0.1, 0.05)])
def test_exact_matches_give_the_lenses(strengths):
    fit = fit_distortion(*seen(strengths), sizes=(SIZE, SIZE))
    assert (fit.lambda_a, fit.lambda_b) == pytest.approx(strengths, abs=1e-4)
    assert fit.significant and fit.gain > 0.9


@pytest.mark.slow
def test_noisy_matches_give_the_lenses_within_their_sigmas():
    truth = torch.tensor([-0.15, -0.08], dtype=torch.float64)
    fits = [fit_distortion(*seen(truth.tolist(), noise=1.0, seed=seed), sizes=(SIZE, SIZE)) for seed in range(5)]
    errors = torch.stack([torch.tensor([fit.lambda_a, fit.lambda_b], dtype=torch.float64) for fit in fits]) - truth
    sigmas = torch.tensor([fit.sigmas for fit in fits], dtype=torch.float64)
    assert 0.4 < float((errors / sigmas).square().mean().sqrt()) < 2
    assert all(fit.significant for fit in fits)


@pytest.mark.slow
def test_ideal_cameras_are_left_alone():
    fits = [fit_distortion(*seen((0.0, 0.0), noise=1.0, seed=seed), sizes=(SIZE, SIZE)) for seed in range(6)]
    assert not any(fit.significant for fit in fits)
    assert all(fit.gain < 0.05 for fit in fits)


def test_wrong_matches_and_missing_ones():
    a, b = seen((-0.2, -0.1), noise=0.5)
    generator = torch.Generator().manual_seed(5)
    b[::7] += 60 * torch.randn(len(b[::7]), 2, generator=generator, dtype=b.dtype)
    a[3], b[10] = torch.nan, torch.nan
    weights = torch.ones(len(a))
    weights[20:40] = 0
    b[20:40] = 0
    fit = fit_distortion(a, b, weights, (SIZE, SIZE))
    assert fit.significant
    assert (fit.lambda_a, fit.lambda_b) == pytest.approx((-0.2, -0.1), abs=0.02)


def test_without_sizes_the_points_own_box_stands_in():
    a, b = seen((-0.25, -0.25))
    fit = fit_distortion(a, b)
    assert fit.significant and fit.gain > 0.4
    # what weighs nothing may lie anywhere
    anywhere = torch.full((1, 2), -5000.0, dtype=a.dtype)
    weights = torch.cat([torch.ones(len(a)), torch.zeros(1)])
    same = fit_distortion(torch.cat([a, anywhere]), torch.cat([b, anywhere]), weights)
    assert (same.lambda_a, same.lenses[0].radius) == pytest.approx((fit.lambda_a, fit.lenses[0].radius))
    straight = [lens.undistort(x) for lens, x in zip(fit.lenses, (a, b), strict=True)]
    assert all(x.isfinite().all() for x in straight)


def test_a_lens_of_another_model_is_approximated():
    views = inside(two_view(400, generator=torch.Generator().manual_seed(2)).views)
    K = torch.tensor([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    bent = [distort(x, K, torch.tensor([-0.25, 0.08, 0.0, 0.0], dtype=torch.float64)) for x in views]
    fit = fit_distortion(*bent, sizes=(SIZE, SIZE))
    assert fit.significant and fit.gain > 0.8 and fit.lambda_a < -0.05


def test_too_few_matches_decide_nothing():
    a, b = seen((-0.3, -0.3), n=30)
    fit = fit_distortion(a, b, sizes=(SIZE, SIZE))
    assert (fit.lambda_a, fit.gain, fit.significant) == (0.0, 0.0, False)


@pytest.mark.slow
def test_the_note_tells_what_to_give():
    note = fit_distortion(*seen((-0.2, -0.1)), sizes=(SIZE, SIZE)).note
    assert note.startswith("lens distortion fitted, lambda = -0.200 and -0.100") and "give calibration" in note


def test_distances_are_the_constraint_by_its_gradient_in_measured_pixels():
    a, b = seen((-0.2, -0.1), n=6, noise=3.0)
    ideal = Division.of(a, SIZE), Division.of(b, SIZE)
    F = torch.randn(1, 3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    lens = torch.tensor([[-0.2, -0.1]], dtype=torch.float64)

    def constraint(x):
        first, second = (
            torch.cat([u, 1 + value * u.square().sum(-1, keepdim=True)], dim=-1)
            for u, value in (((x[:, :2] - ideal[0].centre) / 400, -0.2), ((x[:, 2:] - ideal[1].centre) / 400, -0.1))
        )
        return torch.einsum("ni,ij,nj->n", second, F[0], first)

    x, step = torch.cat([a, b], dim=1), 1e-4
    moves = step * torch.eye(4, dtype=torch.float64)
    gradient = torch.stack([(constraint(x + move) - constraint(x - move)) / (2 * step) for move in moves], dim=-1)
    found = LensMatches.of(a, b, torch.ones(6), ideal).distances(F, lens)[0]
    assert torch.allclose(found, constraint(x) / gradient.norm(dim=-1), rtol=1e-6)


def test_the_descent_never_rises_and_keeps_fixed_lenses():
    a, b = seen((-0.2, -0.1), noise=1.0)
    data = LensMatches.of(a, b, torch.ones(len(a), dtype=torch.float64), (Division.of(a, SIZE), Division.of(b, SIZE)))
    F = torch.randn(3, 3, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    start = LensDescent(Frames.of(F), torch.tensor([[-0.1, 0.0]] * 3, dtype=torch.float64))
    scale = torch.full((3, 1), 5.0, dtype=torch.float64)
    for lens in (False, True):
        found = start.descend(data, scale, lens=lens)
        assert (found.cost(data, scale) <= start.cost(data, scale)).all()
        assert torch.equal(found.lens, start.lens) != lens


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((torch.zeros(5, 2), torch.zeros(4, 2)), r"matches must be \(N, 2\) in both cameras, got \(5, 2\) and \(4, 2\)"),
        ((torch.zeros(5, 2), torch.zeros(5, 2), torch.ones(4)), r"weights must be \(5,\), one per match, got \(4,\)"),
        ((torch.full((5, 2), torch.nan), torch.zeros(5, 2)), "no point is seen"),
    ],
)
def test_misuse_is_named(arguments, words):
    with pytest.raises(ValueError, match=words):
        fit_distortion(*arguments)


@pytest.mark.slow
def test_what_decides_that_there_is_distortion(monkeypatch):
    matches = seen((-0.2, -0.1))
    assert fit_distortion(*matches, sizes=(SIZE, SIZE)).significant
    monkeypatch.setattr(lens_module, "MIN_F_RATIO", math.inf)
    assert not fit_distortion(*matches, sizes=(SIZE, SIZE)).significant
    monkeypatch.setattr(lens_module, "MIN_MATCHES", 10**6)
    many = fit_distortion(*matches, sizes=(SIZE, SIZE))
    assert not many.significant and many.sigmas == (math.inf, math.inf)
