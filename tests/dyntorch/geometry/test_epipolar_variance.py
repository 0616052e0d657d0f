"""The epipolar residual's variance from moments: against matches, finite differences and generalized eigenvalues."""

import numpy as np
import pytest
import scipy.linalg
import torch

from dyntorch.geometry.epipolar import epipolar_variance, gradient_moments, least_ratio, sampson_squared
from dyntorch.geometry.homogeneous import homogeneous
from dyntorch.scenes import filmed_person
from tests.grid import grid


def matches(seed=0, noise=1.0, n=12):
    """Normalized points ``(N, 2)`` of two cameras, and their noise."""
    scene = filmed_person(n, seconds=1.0, noise=noise, generator=torch.Generator().manual_seed(seed))
    flat = [x.flatten(0, 1) for x in (scene.a, scene.b)]
    scales = [float(x.std()) for x in flat]
    x1, x2 = ((x - x.mean(0)) / scale for x, scale in zip(flat, scales, strict=True))
    return x1, x2, tuple(noise / scale for scale in scales)


def rows(x1, x2):
    return torch.einsum("ni,nj->nij", homogeneous(x2), homogeneous(x1)).flatten(1)


def moments_of(x1, x2):
    z = rows(x1, x2)
    return z.mT @ z


def direct(f, x1, x2, noise):
    """Mean squares of the constraint and of its gradient, match by match."""
    F = f.reshape(3, 3)
    p, q = homogeneous(x1), homogeneous(x2)
    value = torch.einsum("ni,ij,nj->n", q, F, p)
    steps = 1e-6 * torch.eye(2, dtype=torch.float64)
    total = torch.zeros(())
    for step in steps:
        by_1 = (torch.einsum("ni,ij,nj->n", q, F, homogeneous(x1 + step)) - value) / 1e-6
        by_2 = (torch.einsum("ni,ij,nj->n", homogeneous(x2 + step), F, p) - value) / 1e-6
        total = total + (noise[0] * by_1).square().sum() + (noise[1] * by_2).square().sum()
    return float(value.square().sum()), float(total)


@pytest.mark.parametrize("noise", [(1.0, 1.0), (0.3, 2.0), (0.0, 1.0)])
def test_gradient_moments_are_the_squared_gradients_of_all_matches(noise):
    x1, x2, _ = matches()
    form = gradient_moments(moments_of(x1, x2), noise)
    assert not form[8].any() and not form[:, 8].any()
    for f in torch.randn(4, 9, generator=torch.Generator().manual_seed(1), dtype=torch.float64):
        assert float(f @ form @ f) == pytest.approx(direct(f, x1, x2, noise)[1], rel=1e-5)


@grid(("seed", range(4)), ("noise", [0.5, 3.0]))
def test_the_variance_is_the_least_generalized_eigenvalue(seed, noise):
    x1, x2, sigmas = matches(seed, noise)
    moments = moments_of(x1, x2)
    variance, F = epipolar_variance(moments, sigmas)
    # of N f = mu M f the largest mu, because N is singular
    values, vectors = scipy.linalg.eigh(gradient_moments(moments, sigmas).numpy(), moments.numpy())
    assert float(variance) == pytest.approx(1 / values[-1], rel=1e-6)
    expected = vectors[:, -1] / np.linalg.norm(vectors[:, -1])
    assert abs(float(F.flatten() @ torch.from_numpy(expected))) == pytest.approx(1, abs=1e-6)
    above, below = direct(F.flatten(), x1, x2, sigmas)
    assert float(variance) == pytest.approx(above / below, rel=1e-5)


def test_no_other_matrix_has_a_smaller_ratio():
    x1, x2, sigmas = matches(1)
    moments = moments_of(x1, x2)
    form = gradient_moments(moments, sigmas)
    variance, F = epipolar_variance(moments, sigmas)
    near = F.flatten() + 0.01 * torch.randn(200, 9, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    ratios = (near @ moments * near).sum(-1) / (near @ form * near).sum(-1)
    assert bool((ratios >= variance).all())


@pytest.mark.parametrize("noise", [0.3, 1.0, 3.0])
def test_the_variance_is_that_of_the_noise_and_of_the_sampson_distance(noise):
    x1, x2, sigmas = matches(2, noise, n=17)
    variance, F = epipolar_variance(moments_of(x1, x2), sigmas)
    assert float(variance.sqrt()) == pytest.approx(1.0, abs=0.12)
    # the same noise in both: the mean squared Sampson distance, but for the averages over all gradients
    scaled = F.clone()  # of coordinates in units of their noise
    scaled[:, :2] *= sigmas[0]
    scaled[:2] *= sigmas[1]
    sampson = sampson_squared(scaled, x1 / sigmas[0], x2 / sigmas[1])
    assert float(variance) == pytest.approx(float(sampson.mean()), rel=0.15)


def test_scale_and_place_of_the_points_do_not_matter():
    x1, x2, sigmas = matches(3)
    turn = torch.tensor([[0.6, -0.8], [0.8, 0.6]], dtype=torch.float64)
    moved = 2.5 * x1 @ turn.mT + torch.tensor([0.7, -1.1], dtype=torch.float64)
    here, _ = epipolar_variance(moments_of(x1, x2), sigmas)
    there, _ = epipolar_variance(moments_of(moved, x2), (2.5 * sigmas[0], sigmas[1]))
    assert float(there) == pytest.approx(float(here), rel=1e-6)


def test_exact_matches_give_the_fundamental_matrix():
    scene = filmed_person(15, seconds=1.0, generator=torch.Generator().manual_seed(4))
    x1, x2 = (x.flatten(0, 1) / 500 - 1 for x in scene.exact)
    variance, F = epipolar_variance(moments_of(x1, x2))
    assert float(variance) < 1e-12
    change = torch.tensor([[1 / 500, 0, -1], [0, 1 / 500, -1], [0, 0, 1]], dtype=torch.float64)
    pixels = change.mT @ F @ change
    pixels = pixels / pixels.norm()
    assert abs(float((pixels * scene.fundamental).sum())) == pytest.approx(1, abs=1e-8)


def test_batch_is_loop_and_an_empty_problem_leaves_the_others():
    every = torch.stack([moments_of(*matches(seed)[:2]) for seed in range(3)])
    every[1] = 0
    variance, F = epipolar_variance(every, (0.5, 2.0))
    assert variance[1] == torch.inf and not F[1].any()
    for k in (0, 2):
        alone = epipolar_variance(every[k], (0.5, 2.0))
        assert torch.allclose(variance[k], alone[0], rtol=1e-9) and torch.allclose(F[k], alone[1], atol=1e-9)
    assert torch.allclose(F[0].norm(), torch.ones((), dtype=torch.float64))


def test_fewer_matches_than_unknowns_have_no_variance():
    x1, x2, _ = matches()
    variance, F = epipolar_variance(moments_of(x1[:5], x2[:5]))
    assert not variance.isnan() and F.isfinite().all()
    assert variance == torch.inf or variance < 1e-9


@pytest.mark.parametrize("size", [2, 4, 8])
def test_the_least_ratio_is_the_least_generalized_eigenvalue(size):
    draw = torch.Generator().manual_seed(size)
    inner, form = (torch.randn(3, size, size, generator=draw, dtype=torch.float64) for _ in range(2))
    inner = inner @ inner.mT + torch.diag_embed(10.0 ** torch.arange(size, dtype=torch.float64))
    form = form @ form.mT
    form[:, -1], form[:, :, -1] = 0.0, 0.0  # a direction that costs nothing is never the answer
    ratio, vector = least_ratio(inner, form, torch.tensor([True, True, False]))
    for k in range(2):
        expected = 1 / scipy.linalg.eigh(form[k].numpy(), inner[k].numpy(), eigvals_only=True)[-1]
        assert float(ratio[k]) >= expected * (1 - 1e-9)  # inverse iteration comes from above
        assert float(ratio[k]) == pytest.approx(expected, rel=0.1)
        assert float(vector[k].norm()) == pytest.approx(1)
    assert ratio[2] == torch.inf
