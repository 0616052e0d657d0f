"""Reprojection residuals without the point: chi-square, minimization over the points, finite differences, changes of frame."""

import pytest
import torch

import dyntorch as dyn
from dyntorch.geometry.homogeneous import homogeneous, inhomogeneous
from dyntorch.invariants.reprojection import linearize, residual, residual_derivative
from tests.draws import random
from tests.dyntorch.invariants.test_grassmann_tensor import images, projections

PROFILES = [
    dyn.GrassmannTensor(3, (2, 1, 1)),
    dyn.GrassmannTensor(4, (2, 2, 1)),
    dyn.GrassmannTensor(6, (2, 2, 2, 1)),
    dyn.GrassmannTensor(6, (3, 3, 1), (3, 3, 2)),
    dyn.GrassmannTensor(3, (1, 1, 1, 1), (1, 2, 1, 2)),
]


def scene(invariant, n, *batch, seed=0):
    """Random projections and points ``(*batch, n, K)`` at finite places."""
    return projections(invariant, *batch, seed=seed, last=0.1), homogeneous(random(*batch, n, invariant.k, seed=100 * seed + 50))


def scales_of(motion, values):
    return tuple(torch.full(m.shape[:-2], v, dtype=torch.float64) for m, v in zip(motion, values, strict=False))


def noisy(views, scales, size, seed=9):
    return tuple(
        x + size * s[..., None, None] * random(*x.shape, seed=seed + i) for i, (x, s) in enumerate(zip(views, scales, strict=True))
    )


@pytest.mark.parametrize("invariant", PROFILES, ids=repr)
def test_it_is_the_least_reprojection_error(invariant):
    """Newton's method on the points, by automatic differentiation."""
    motion, structure = scene(invariant, 20)
    scales = scales_of(motion, (1.0, 3.0, 0.5, 2.0))
    views = noisy(images(motion, structure=structure), scales, 1e-3)

    def cost(y, *x):
        seen = zip(motion, x, scales, strict=True)
        return sum(((inhomogeneous(m @ y) - x_i) / s).square().sum() for m, x_i, s in seen) + (y.square().sum() - 1).square()

    y = structure / structure.norm(dim=-1, keepdim=True)
    derivatives = torch.func.vmap(torch.func.grad(cost)), torch.func.vmap(torch.func.hessian(cost))
    for _ in range(20):
        gradient, curvature = (d(y, *views) for d in derivatives)
        y = y - torch.linalg.solve(curvature, gradient[..., None])[..., 0]
    assert gradient.abs().max() < 1e-9
    found = residual(motion, views, scales).square().sum(-1)
    least = torch.func.vmap(cost)(y, *views)
    torch.testing.assert_close(found, least, rtol=1e-5, atol=1e-14)
    at = linearize(motion, views, scales)
    torch.testing.assert_close(at.structure.norm(dim=-1), torch.ones(20).double())
    torch.testing.assert_close(inhomogeneous(at.structure @ motion[0].mT), inhomogeneous(y @ motion[0].mT), rtol=1e-6, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("invariant", PROFILES, ids=repr)
def test_derivative_by_finite_differences(invariant):
    motion, structure = scene(invariant, 12, 2)
    scales = scales_of(motion, (1.0, 3.0, 0.5, 2.0))
    sizes = [m[0].numel() for m in motion]
    theta = torch.cat([m.flatten(1) for m in motion], dim=-1)

    def parts(t):
        return tuple(p.reshape(m.shape) for p, m in zip(t.split(sizes, -1), motion, strict=True))

    def slopes(function, step=1e-6):
        columns = torch.eye(theta.shape[-1], dtype=torch.float64) * step
        return torch.stack([(function(theta + c) - function(theta - c)) / (2 * step) for c in columns], dim=1)

    exact = images(motion, structure=structure)
    value, derivative = invariant.linearize(motion, exact, scales)
    assert value.abs().max() < 1e-10
    expected = slopes(lambda t: invariant.whitened_residual(parts(t), exact, scales).flatten(1))
    assert (derivative - expected).norm() < 1e-7 * expected.norm()
    # with residuals that are not zero, the gradient of their square sum
    views = noisy(exact, scales, 1e-2)
    value, derivative = residual_derivative(motion, views, scales)
    torch.testing.assert_close(value, residual(motion, views, scales).flatten(1))
    gradient = (derivative @ value[..., None])[..., 0]
    expected = slopes(lambda t: residual(parts(t), views, scales).square().sum((-2, -1)) / 2)
    assert (gradient - expected).norm() < 1e-3 * expected.norm()


def test_nothing_depends_on_the_frame_of_the_space_or_on_scales():
    invariant = PROFILES[2]
    motion, structure = scene(invariant, 15)
    scales = scales_of(motion, (1.0,) * 4)
    views = noisy(images(motion, structure=structure), scales, 1e-3)
    change = torch.eye(7, dtype=torch.float64) + 0.3 * random(7, 7, seed=4)
    moved = tuple(f * m @ change for f, m in zip((2.0, -0.1, 30.0, -5.0), motion, strict=True))
    torch.testing.assert_close(residual(moved, views, scales), residual(motion, views, scales), rtol=1e-4, atol=1e-9)


def test_degenerate_matches_stay_finite():
    motion, structure = scene(PROFILES[1], 6)
    scales = scales_of(motion, (1.0,) * 3)
    views = [x.clone() for x in images(motion, structure=structure)]
    # at infinity in a view, in a centre of one, and projections that see nothing
    structure[0] = torch.linalg.svd(motion[0][2:]).Vh[2]
    structure[1] = torch.linalg.svd(motion[0]).Vh[4]
    views[1], views[2] = (inhomogeneous(structure @ m.mT) for m in motion[1:])
    for cameras in (motion, tuple(torch.zeros_like(m) for m in motion), tuple(m * (torch.arange(5) < 2) for m in motion)):
        value, derivative = residual_derivative(
            tuple(m[None] for m in cameras), tuple(x[None] for x in views), tuple(s[None] for s in scales)
        )
        assert value.isfinite().all() and derivative.isfinite().all()


def test_one_condition_is_left_to_the_form_itself():
    for invariant in (
        dyn.GrassmannTensor(5, (2, 2, 2)),
        dyn.GrassmannTensor(3, (2, 2)),
        dyn.GrassmannTensor(3, (1,) * 4, dual=True),
    ):
        empty = tuple(torch.zeros(1, m, invariant.k + 1, dtype=torch.float64) for m in invariant.sizes)
        assert invariant.whitened_residual(empty, (), ()) is None and invariant.linearize(empty, (), ()) is None
