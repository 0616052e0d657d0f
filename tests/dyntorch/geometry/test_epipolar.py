"""Fundamental matrices of samples and weightings: against constructed scenes, SVDs and polynomial roots from numpy."""

import numpy as np
import pytest
import scipy.linalg
import torch

from dyntorch.geometry.epipolar import (
    affine_fundamental,
    eight_point,
    epipolar_variance,
    gradient_moments,
    least_ratio,
    null_vector,
    sampson_squared,
)
from dyntorch.geometry.epipolar_fit import draw, sample_fundamentals, seven_point
from dyntorch.geometry.homogeneous import homogeneous, unit
from dyntorch.metrics import relative_error
from dyntorch.scenes import filmed_person, two_view
from tests.draws import random, seeded
from tests.grid import grid

CENTRE, SIZE = torch.tensor([320.0, 240.0], dtype=torch.float64), 300.0


def scene(n=60, sigma=0.0, seed=0):
    """Matches in a frame of unit size, and F there."""
    made = two_view(n, sigma=sigma, generator=seeded(seed))
    change = torch.eye(3, dtype=torch.float64) * SIZE
    change[:2, 2], change[2, 2] = CENTRE, 1.0
    return *((view - CENTRE) / SIZE for view in made.views), unit(change.T @ made.motion[0] @ change)


def products(x1, x2):
    return (homogeneous(x2)[..., :, None] * homogeneous(x1)[..., None, :]).flatten(-2)


def moments_of(x1, x2):
    z = products(x1, x2)
    return z.mT @ z


def rms(F, x1, x2):
    return sampson_squared(F, x1, x2).mean(-1).sqrt()


def test_seven_points_determine_a_singular_matrix_among_at_most_three():
    x1, x2, truth = scene(400)
    chosen = torch.rand(200, 400, generator=torch.Generator().manual_seed(1)).argsort(-1)[:, :7]
    F, valid = seven_point(x1[chosen], x2[chosen])
    assert F.shape == (200, 3, 3, 3)
    assert set(valid.sum(-1).tolist()) == {1, 3}
    assert (products(x1[chosen], x2[chosen])[:, None] @ F.flatten(-2)[..., None]).abs().max() < 1e-12
    assert torch.linalg.det(F).abs().max() < 1e-13
    torch.testing.assert_close(F.flatten(-2).norm(dim=-1), valid.double())
    best = torch.where(valid, relative_error(F, truth), 2.0).amin(-1)
    assert best.median() < 1e-12
    assert best.max() < 1e-6


def test_seven_point_finds_the_real_roots_that_numpy_finds():
    x1, x2 = random(2, 300, 7, 2)
    F, valid = seven_point(x1, x2)
    for sample in range(0, 300, 5):
        null = np.linalg.svd(products(x1, x2)[sample].numpy())[2][7:].reshape(2, 3, 3)
        at = [-1.0, 0.0, 1.0, 2.0]
        roots = np.roots(np.polyfit(at, [np.linalg.det(a * null[0] + null[1]) for a in at], 3))
        real = roots[np.abs(roots.imag) < 1e-9].real
        assert len(real) == valid[sample].sum()
        for a in real:
            expected = unit(torch.as_tensor(a * null[0] + null[1]))
            assert relative_error(F[sample], expected).min() < 1e-6


def test_seven_point_of_special_pencils():
    # a pure translation, an affine scene and seven equal matches: roots at infinity, double roots, no equations at all
    x1 = random(7, 2)
    shifts = random(7, 1, seed=1)
    for x2 in (
        x1 + shifts * torch.tensor([1.0, 0.0]).double(),
        x1 @ random(2, 2, seed=2) + shifts * random(2, seed=3),
        x1[:1].expand(7, 2),
    ):
        F, valid = seven_point(x1[:1].expand(7, 2) if x2.stride(0) == 0 else x1, x2)
        assert F.isfinite().all()
        assert valid.any()
        assert torch.linalg.det(F).abs().max() < 1e-10
    with pytest.raises(ValueError, match=r"\(\*batch, 7, 2\)"):
        seven_point(x1[:6], x1[:6])


def test_sampson_distance_by_its_definition():
    F, (x1, x2) = random(4, 5, 3, 3), random(2, 11, 2, seed=1)
    p1, p2 = homogeneous(x1), homogeneous(x2)
    for i in range(4):
        for j in range(5):
            value = torch.einsum("ni,ij,nj->n", p2, F[i, j], p1)
            one, two = p1 @ F[i, j].T, p2 @ F[i, j]
            expected = value**2 / (one[:, :2].square().sum(-1) + two[:, :2].square().sum(-1))
            torch.testing.assert_close(sampson_squared(F, x1, x2)[i, j], expected)
    assert (sampson_squared(torch.zeros(3, 3).double(), x1, x2) == 0).all()


def hartley_of_one(x, w):
    """Weighted mean at 0, root mean square distance sqrt(2)."""
    centre = (w[:, None] * x).sum(0) / w.sum()
    scale = (2 / ((w[:, None] * (x - centre) ** 2).sum() / w.sum())).sqrt()
    change = torch.diag(torch.stack([scale, scale, torch.ones_like(scale)]))
    change[:2, 2] = -scale * centre
    return change


def reference_eight_point(x1, x2, w):
    """Hartley's algorithm, one problem, by SVDs."""
    changes = [hartley_of_one(x, w) for x in (x1, x2)]
    y1, y2 = homogeneous(x1) @ changes[0].T, homogeneous(x2) @ changes[1].T
    rows = (y2[:, :, None] * y1[:, None, :]).flatten(1) * w.sqrt()[:, None]
    u, s, vt = torch.linalg.svd(torch.linalg.svd(rows)[2][-1].reshape(3, 3))
    s[2] = 0
    return unit(changes[1].T @ (u * s) @ vt @ changes[0])


@pytest.mark.parametrize("sigma", [0.0, 1.0])
def test_eight_point_is_hartleys_for_every_weighting(sigma):
    x1, x2, truth = scene(60, sigma)
    weights = torch.rand(6, 60, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    # a small body far from the centre has its own coordinates
    weights[5] *= (x1 - x1[0]).norm(dim=-1) < 0.4
    F = eight_point(x1, x2, weights)
    for k in range(6):
        assert relative_error(unit(F[k]), reference_eight_point(x1, x2, weights[k])) < (1e-5 if k == 5 else 1e-7)
    assert torch.linalg.det(F).abs().max() < 1e-15
    if sigma == 0.0:
        assert relative_error(F, truth).max() < 1e-8


def test_weighing_by_the_gradient_gets_nearer_to_the_least_sampson_distance():
    gain = []
    for seed in range(20):
        x1, x2, _ = scene(50, 1.0, seed)
        ones = torch.ones(1, 50, dtype=torch.float64)
        gain.append(rms(eight_point(x1, x2, ones), x1, x2) - rms(eight_point(x1, x2, ones, rounds=3), x1, x2))
    assert torch.stack(gain).mean() > 0
    assert (torch.stack(gain) > -1e-4).all()


def test_affine_fundamental_is_the_total_least_squares_hyperplane():
    x1 = random(40, 2)
    x2 = x1 @ random(2, 2, seed=1) + random(40, 1, seed=2) * random(2, seed=3) + 0.01 * random(40, 2, seed=4)
    weights = torch.rand(3, 40, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    F = affine_fundamental(x1, x2, weights)
    joint = torch.cat([x2, x1], dim=-1)
    for k in range(3):
        centred = joint - (weights[k][:, None] * joint).sum(0) / weights[k].sum()
        least = torch.linalg.svd(weights[k].sqrt()[:, None] * centred)[1][-1] ** 2
        torch.testing.assert_close((weights[k] * sampson_squared(F[k], x1, x2)).sum(), least)
    assert (F[:, :2, :2] == 0).all()


def test_matches_that_decide_nothing_still_give_finite_matrices():
    x1, x2, _ = scene(20)
    weights = torch.zeros(4, 20, dtype=torch.float64)
    weights[1, 0], weights[2, :5], weights[3] = 1.0, 1.0, 1.0
    for F in (eight_point(x1, x2, weights, 2), affine_fundamental(x1, x2, weights), eight_point(x1 * 0, x2 * 0, weights, 2)):
        assert F.isfinite().all()
        torch.testing.assert_close(F.flatten(1).norm(dim=-1), torch.ones(4, dtype=torch.float64))
    # one bad problem leaves the others alone
    torch.testing.assert_close(eight_point(x1, x2, weights)[3], eight_point(x1, x2, weights[3:])[0])


def test_null_vector_is_the_smallest_eigenvector():
    for size in (4, 9):
        rows = random(50, 30, size)
        gram = rows.mT @ rows
        values = torch.linalg.eigvalsh(gram)
        found = null_vector(gram)
        excess = (found[:, None] @ gram @ found[..., None])[:, 0, 0] / values[:, 0] - 1
        apart = values[:, 0] < 0.7 * values[:, 1]
        assert apart.sum() > 5
        assert excess.max() < 0.05
        assert excess[apart].max() < 1e-5
    assert null_vector(torch.zeros(2, 9, 9).double()).isfinite().all()
    # a neighbour of another size changes nothing
    torch.testing.assert_close(null_vector(torch.stack([gram[0], 1e20 * gram[1]]))[0], null_vector(gram[:1])[0])


def test_draws_are_without_replacement_and_by_weight():
    weights = torch.tensor(
        [[1.0] * 8 + [0.0] * 4, [0.0, 5.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0, 3.0, 0.5]], dtype=torch.float64
    )
    chosen = draw(weights, 7, 4000, torch.Generator().manual_seed(0))
    assert chosen.shape == (2, 4000, 7)
    assert (chosen.sort(-1).values.diff(dim=-1) > 0).all()
    assert (weights.gather(1, chosen.flatten(1)) > 0).all()
    first = torch.stack([torch.bincount(c, minlength=12) for c in chosen[..., 0]]) / 4000
    assert (first - weights / weights.sum(-1, keepdim=True)).abs().max() < 0.03
    # of eight equal weights every one is left out equally often
    assert (torch.bincount(chosen[0].flatten(), minlength=12)[:8] / 4000 - 7 / 8).abs().max() < 0.03
    # the second of two draws follows the weights that are left
    pair = draw(weights[1:], 2, 40000, torch.Generator().manual_seed(1))[0]
    second = torch.bincount(pair[pair[:, 0] == 1, 1], minlength=12).double()
    left = weights[1].clone()
    left[1] = 0
    assert (second / second.sum() - left / left.sum()).abs().max() < 0.02


def test_samples_of_a_pool_fit_the_pool():
    x1, x2, truth = scene(60)
    other = scene(60, seed=5)
    x1, x2 = torch.cat([x1, other[0]]), torch.cat([x2, other[1]])
    weights = torch.zeros(3, 120, dtype=torch.float64)
    weights[0, :60], weights[1, 60:], weights[2, :6] = 1.0, 1.0, 1.0
    F, valid = sample_fundamentals(x1, x2, weights, 10, torch.Generator().manual_seed(0))
    again, _ = sample_fundamentals(x1, x2, weights, 10, torch.Generator().manual_seed(0))
    assert F.shape == (3, 30, 3, 3)
    assert torch.equal(F, again)
    assert not valid[2].any()
    assert relative_error(F[0], truth).min() < 1e-8
    assert relative_error(F[1], other[2]).min() < 1e-8


# The epipolar residual's variance from moments: against matches, finite differences and generalized eigenvalues.


def matches(seed=0, noise=1.0, n=12):
    """Normalized points ``(N, 2)`` of two cameras, and their noise."""
    scene = filmed_person(n, seconds=1.0, noise=noise, generator=seeded(seed))
    flat = [x.flatten(0, 1) for x in (scene.a, scene.b)]
    scales = [float(x.std()) for x in flat]
    x1, x2 = ((x - x.mean(0)) / scale for x, scale in zip(flat, scales, strict=True))
    return x1, x2, tuple(noise / scale for scale in scales)


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
    for f in random(4, 9, seed=1):
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
    # scale and place of the points do not matter
    turn = torch.tensor([[0.6, -0.8], [0.8, 0.6]], dtype=torch.float64)
    moved = 2.5 * x1 @ turn.mT + torch.tensor([0.7, -1.1], dtype=torch.float64)
    there, _ = epipolar_variance(moments_of(moved, x2), (2.5 * sigmas[0], sigmas[1]))
    assert float(there) == pytest.approx(float(variance), rel=1e-6)


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
    x1, x2, _ = matches()  # fewer than unknowns
    variance, F = epipolar_variance(moments_of(x1[:5], x2[:5]))
    assert F.isfinite().all() and (variance == torch.inf or variance < 1e-9)


@pytest.mark.parametrize("size", [2, 4, 8])
def test_the_least_ratio_is_the_least_generalized_eigenvalue(size):
    inner, form = random(2, 3, size, size, seed=size)
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


def test_null_vectors_of_grams_have_their_derivative():
    """Compiled code answers only where nobody asks for it."""
    rows = random(2, 12, 9) * torch.tensor([1.0] * 8 + [0.05], dtype=torch.float64)
    gram = (rows.mT @ rows).requires_grad_()

    def projector(gram):
        vector = null_vector(gram)
        return vector[..., :, None] * vector[..., None, :]

    assert torch.autograd.gradcheck(lambda x: projector(0.5 * (x + x.mT)), (gram,), atol=1e-5)
    torch.testing.assert_close(projector(gram).detach(), projector(gram.detach()), rtol=0, atol=1e-6)
