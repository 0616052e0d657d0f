"""Homographies of weightings: against the DLT by SVD, autograd, and the least squares of perturbed matches."""

import pytest
import torch

from dyntorch.geometry.homogeneous import apply, homogeneous, unit
from dyntorch.geometry.homography import (
    _normal_equations,
    _terms,
    affine_homography,
    descend_homography,
    homography,
    homography_sampson_squared,
    linear_homography,
)
from dyntorch.scenes import collineation
from tests.draws import random, seeded
from tests.dyntorch.geometry.test_epipolar import hartley_of_one

ONES = torch.ones(1, 50, dtype=torch.float64)


def scene(n=50, sigma=0.0, seed=0):
    made = collineation(2, n, sigma=sigma, generator=seeded(seed))
    x2, x1 = made.views
    return x1, x2, unit(made.motion[0])


def cost(H, x1, x2):
    return homography_sampson_squared(H, x1, x2).sum(-1)


def test_sampson_distance_by_its_definition():
    H, (x1, x2) = random(2, 3, 3, 3), random(2, 9, 2, seed=1)

    def constraint(z, H):
        p = H @ homogeneous(z[:2])
        return p[:2] - z[2:] * p[2]

    found = homography_sampson_squared(H, x1, x2)
    for i in range(2):
        for j in range(3):
            for k, z in enumerate(torch.cat([x1, x2], dim=-1)):
                c, J = constraint(z, H[i, j]), torch.func.jacrev(constraint)(z, H[i, j])
                torch.testing.assert_close(found[i, j, k], c @ torch.linalg.solve(J @ J.T, c))


def reference(x1, x2, w):
    """Normalized DLT of one problem by an SVD."""
    changes = [hartley_of_one(x, w) for x in (x1, x2)]
    y1, y2 = homogeneous(x1) @ changes[0].T, apply(changes[1], x2)
    zero = torch.zeros_like(y1)
    rows = torch.cat([torch.cat([y1, zero, -y2[:, :1] * y1], -1), torch.cat([zero, y1, -y2[:, 1:] * y1], -1)])
    H = torch.linalg.svd(w.sqrt().repeat(2)[:, None] * rows)[2][-1].reshape(3, 3)
    return unit(torch.linalg.inv(changes[1]) @ H @ changes[0])


@pytest.mark.parametrize("sigma", [0.0, 0.01])
def test_linear_homography_is_the_normalized_dlt_for_every_weighting(sigma):
    x1, x2, truth = scene(50, sigma)
    weights = torch.rand(5, 50, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    H = unit(linear_homography(x1, x2, weights))
    for k in range(5):
        torch.testing.assert_close(H[k], reference(x1, x2, weights[k]), rtol=0, atol=1e-8)
    if sigma == 0.0:
        torch.testing.assert_close(H[0], truth, rtol=0, atol=1e-9)


def test_affine_homography_is_the_least_squares_of_view_two():
    x1, x2 = random(2, 50, 2)
    weights = torch.rand(3, 50, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    H = affine_homography(x1, x2, weights)
    for k in range(3):
        root = weights[k].sqrt()[:, None]
        torch.testing.assert_close(H[k, :2].T, torch.linalg.lstsq(root * homogeneous(x1), root * x2).solution)


def test_gradient_is_that_of_the_sampson_distance():
    x1, x2 = random(2, 11, 2, seed=1)
    H = unit(random(4, 3, 3)).requires_grad_()
    weights = torch.rand(4, 11, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    (expected,) = torch.autograd.grad((weights * homography_sampson_squared(H, x1, x2)).sum() / 2, H)
    with torch.no_grad():
        _, gradient = _normal_equations(H, _terms(H, x1, x2), x1, x2, weights)
    torch.testing.assert_close(gradient, expected.flatten(1))


def test_descent_ends_in_a_minimum_and_agrees_with_every_start():
    x1, x2, _ = scene(50, 0.02)
    H, least = homography(x1, x2, ONES, steps=20)
    around = H + 1e-4 * random(200, 3, 3)
    assert (cost(around, x1, x2) > least).all()
    torch.testing.assert_close(cost(H, x1, x2), least)
    torch.testing.assert_close(descend_homography(affine_homography(x1, x2, ONES), x1, x2, ONES, steps=30)[1], least)
    # three steps are enough
    torch.testing.assert_close(homography(x1, x2, ONES)[1], least, rtol=1e-6, atol=0)


def test_outliers_are_cut_off():
    x1, x2, truth = scene(50, 0.002)
    x2 = x2.clone()
    x2[:15] += 0.3 * random(15, 2)
    H, found = homography(x1, x2, ONES, scale=0.1, steps=5)
    H, found = descend_homography(H, x1, x2, ONES, scale=0.01, steps=5)
    inliers = ONES * (torch.arange(50) >= 15)
    assert cost(H, x1[15:], x2[15:]) < 1.1 * homography(x1, x2, inliers, steps=10)[1]
    torch.testing.assert_close(found, (homography_sampson_squared(H, x1, x2) / 0.01**2).clamp(max=2.25).sum(-1))
    assert (unit(H) - truth).norm() < 0.01


def test_matches_that_decide_nothing_still_give_finite_matrices():
    x1, x2, _ = scene(50)
    weights = torch.zeros(4, 50, dtype=torch.float64)
    weights[1, 0], weights[2, :3], weights[3] = 1.0, 1.0, 1.0
    for H in (linear_homography(x1, x2, weights), affine_homography(x1, x2, weights), homography(x1, x2, weights, 0.01)[0]):
        assert H.isfinite().all()
    H, found = homography(x1, x2, weights)
    assert found.max() < 1e-12
    torch.testing.assert_close(unit(H[3]), unit(homography(x1, x2, weights[3:])[0][0]))
