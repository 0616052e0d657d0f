"""Whitened disagreement of static points, collinearity of moving ones: against brute force, their statistics and derivatives."""

from __future__ import annotations

import pytest
import torch

from dyntorch.core.residual import whiten
from dyntorch.geometry.homogeneous import apply, homogeneous, unit
from dyntorch.invariants.agreement import collinearity, join_forms, motion_of_forms, static_residual
from dyntorch.scenes import moving_points
from tests.draws import random, seeded


def collineations(count, d, *batch, seed=0):
    noise = random(count, *batch, d + 1, d + 1, seed=seed) * 0.15
    noise[..., -1, :-1] *= 0.5
    return list(torch.eye(d + 1).double() + noise)


def static_views(motion, n, d, sigma, seed=1):
    first = random(*motion[0].shape[:-2], n, d, seed=seed)
    exact = [first, *(apply(torch.linalg.inv(m), first) for m in motion)]
    return [x + sigma * random(*x.shape, seed=seed + 1 + v) for v, x in enumerate(exact)]


def error(motion, views):
    return torch.cat([apply(m, x) - views[0] for m, x in zip(motion, views[1:], strict=True)], -1)


@pytest.mark.parametrize("d", [1, 2, 3])
@pytest.mark.parametrize("count", [1, 2, 3])
def test_covariance_agrees_with_finite_differences(d, count):
    motion = collineations(count, d)
    views = static_views(motion, 4, d, 0.1)
    scales = [torch.tensor(s).double() for s in (0.7, 1.3, 0.4, 2.0)[: count + 1]]
    e, step = error(motion, views), 1e-6
    covariance = torch.zeros(4, d * count, d * count).double()
    for v in range(count + 1):
        for c in range(d):
            moved = [x.clone() for x in views]
            moved[v][:, c] += step
            upper = error(motion, moved)
            moved[v][:, c] -= 2 * step
            column = (upper - error(motion, moved)) / (2 * step) * scales[v]
            covariance += column[:, :, None] * column[:, None, :]
    torch.testing.assert_close(static_residual(motion, views, scales), whiten(e, covariance), rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("d", [2, 3])
def test_norm_is_the_true_geometric_distance(d):
    motion = collineations(2, d)
    views = static_views(motion, 30, d, 0.01)
    ones = [torch.ones(()).double()] * 3
    start = torch.cat(views, -1)

    def constraint(z):
        return error(motion, [x[None] for x in z.split(d)])[0]

    # least squares under the constraint: project onto its linearization until nothing changes
    moved = start.clone()
    for _ in range(20):
        jacobian = torch.func.vmap(torch.func.jacrev(constraint))(moved)
        value = torch.func.vmap(constraint)(moved) + (jacobian @ (start - moved)[..., None])[..., 0]
        moved = start - (torch.linalg.pinv(jacobian) @ value[..., None])[..., 0]
    assert torch.func.vmap(constraint)(moved).abs().max() < 1e-10
    truth = (moved - start).norm(dim=-1)
    found = static_residual(motion, views, ones).norm(dim=-1)
    assert ((found - truth) / truth).abs().max() < 0.02


def test_points_at_infinity_stay_finite_in_value_and_gradient():
    matrix = torch.eye(3).double()
    matrix[2] = torch.tensor([1.0, 0.0, 0.0])
    x1, x2 = random(3, 2), random(3, 2, seed=1)
    x2[0, 0] = 0.0
    x2.requires_grad_()
    w = static_residual([matrix, matrix], [x1, x2, x2], [torch.ones(()).double()] * 3)
    w.sum().backward()
    assert w.isfinite().all()
    assert x2.grad.isfinite().all()


# Collinearity of three points: against a brute-force geometric distance; the motion of forms.


ONE = torch.ones((), dtype=torch.float64)


def noisy(sigmas, *, seed, **options):
    scene = moving_points(generator=seeded(seed), **options)
    g = seeded(seed + 1)
    views = tuple(x + s * torch.randn(x.shape, generator=g, dtype=x.dtype) for x, s in zip(scene.exact, sigmas, strict=True))
    return scene, views, tuple(ONE * s for s in sigmas)


def geometric_distance(motion, views, scales):
    """The smallest weighted move of all nine coordinates of each match that puts its three points on a line, by Gauss-Newton.

    The line and the places on it are the unknowns: start point, direction, two places; the third is the start itself.
    """
    inverse = [torch.eye(4, dtype=torch.float64), *(torch.linalg.inv(m) for m in motion)]
    first = [views[0], apply(motion[0], views[1]), apply(motion[1], views[2])]
    direction = first[2] - first[0]
    place = [((y - first[0]) * direction).sum(-1, keepdim=True) / direction.square().sum(-1, keepdim=True) for y in first[1:]]
    found = torch.cat([first[0], direction, *place], dim=-1)

    def residual(p, x):
        start, along, a, b = p[:3], p[3:6], p[6], p[7]
        points = (start, start + a * along, start + b * along)
        return torch.cat([(apply(m, q[None])[0] - y) / s for m, q, y, s in zip(inverse, points, x, scales, strict=True)])

    jacobian = torch.func.vmap(torch.func.jacfwd(residual))
    value = torch.func.vmap(residual)
    for _ in range(12):
        r, j = value(found, views), jacobian(found, views)
        # two directions of the eight parameters do not change the points: the least squares solution of smallest norm
        found = found - (torch.linalg.pinv(j, rtol=1e-10) @ r[..., None])[..., 0]
    return value(found, views).norm(dim=-1)


@pytest.mark.parametrize("sigmas", [(1e-3, 1e-3, 1e-3), (2e-4, 2e-3, 6e-4)])
def test_equals_the_geometric_distance_to_first_order(sigmas):
    scene, views, scales = noisy(sigmas, n=200, seed=1)
    distance = collinearity(scene.motion, views, scales).norm(dim=-1)
    exact = geometric_distance(scene.motion, views, scales)
    assert exact.min() > 0.01
    # a second-order difference: relative to one standard deviation it is of the order of the noise over the motion
    assert (distance - exact).abs().max() < 0.05
    assert (distance - exact).abs().median() < 2e-3


def test_scales_of_motion_and_unit_do_not_matter():
    scene, views, scales = noisy((0.01,) * 3, n=30, batch=2, seed=5)
    expected = collinearity(scene.motion, views, scales)
    torch.testing.assert_close(collinearity((-3 * scene.motion[0], 0.2 * scene.motion[1]), views, scales), expected)
    metre = torch.diag(torch.tensor([1000.0, 1000.0, 1000.0, 1.0], dtype=torch.float64))
    motion = [metre @ m @ torch.linalg.inv(metre) for m in scene.motion]
    got = collinearity(tuple(motion), tuple(1000 * x for x in views), tuple(1000 * s for s in scales))
    torch.testing.assert_close(got, expected, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("static", [0.0, 1.0])
def test_forward_derivative_equals_finite_differences(static):
    scene, views, scales = noisy((0.005,) * 3, n=300, static=static, seed=8)
    step = tuple(0.3 * random(4, 4, seed=s) for s in (80, 81))

    def residual(a, b):
        return collinearity((a, b), views, scales)

    _, tangent = torch.func.jvp(residual, scene.motion, step)
    h = 1e-6
    plus, minus = (residual(*(m + sign * h * d for m, d in zip(scene.motion, step, strict=True))) for sign in (1, -1))
    error = ((plus - minus) / (2 * h) - tangent).norm(dim=-1) / tangent.norm(dim=-1)
    assert error.median() < 1e-6
    # static points have no direction of their own, so that a few are strongly curved; none jumps
    assert error.max() < (1e-5 if static == 0 else 1e-2)


def test_degenerate_matches_give_finite_values_and_derivatives():
    eye, x = torch.eye(4, dtype=torch.float64), random(5, 3, seed=11)
    flat = torch.tensor([0.0, 1.0, 1.0], dtype=torch.float64)

    def residual(a, b, one, two, three):
        return collinearity((a, b), (one, two, three), (ONE,) * 3)

    for name, case in {
        "all equal": (eye, eye, x, x, x),
        "two equal": (eye, eye, x, x, x + 1),
        "there and back": (eye, eye, x, x + 1, x),
        "zero motion": (0 * eye, 0 * eye, x, x, x),
        "singular motion": (torch.diag(homogeneous(flat).roll(1)), eye, x, x + 1, x + 2),
        "at infinity": (eye[[3, 1, 2, 0]], eye, x, x * flat, x),
    }.items():
        parts = residual(*case), *torch.func.jacfwd(residual, argnums=(0, 1, 2, 3, 4))(*case)
        assert all(part.isfinite().all() for part in parts), name


def test_static_points_among_moving_ones_leave_finite_gradients_and_nan_stays_in_its_match():
    scene = moving_points(20, static=0.5, generator=seeded(12))
    inputs = [x.clone().requires_grad_() for x in (*scene.motion, *scene.exact)]
    collinearity(tuple(inputs[:2]), tuple(inputs[2:]), (ONE,) * 3).square().sum().backward()
    assert all(x.grad.isfinite().all() for x in inputs)
    expected = collinearity(scene.motion, scene.views, (ONE,) * 3)
    broken = scene.views[1].clone()
    broken[2] = torch.nan
    got = collinearity(scene.motion, (scene.views[0], broken, scene.views[2]), (ONE,) * 3)
    assert torch.equal(got[[0, 1, *range(3, 20)]], expected[[0, 1, *range(3, 20)]])


def test_forms_are_determinants():
    a, b, v = random(3, 4, 4, seed=14), random(3, 4, 4, seed=15), random(3, 4, seed=16)
    p, q, r = (homogeneous(random(3, 3, seed=s)) for s in (17, 18, 19))
    value = torch.einsum("zijk,zi,zj,zk->z", join_forms(a, b, v), p, q, r)
    columns = torch.stack([p, (a @ q[..., None])[..., 0], (b @ r[..., None])[..., 0], v], dim=-1)
    torch.testing.assert_close(value, torch.linalg.det(columns))


@pytest.mark.parametrize("count", [2, 3, 4])
def test_motion_of_two_forms_or_more(count):
    a, b = random(5, 4, 4, seed=20), random(5, 4, 4, seed=21)
    forms = join_forms(a[:, None], b[:, None], random(5, count, 4, seed=22))
    for got, true in zip(motion_of_forms(forms), (a, b), strict=True):
        torch.testing.assert_close(got, unit(true), atol=1e-11, rtol=0)
