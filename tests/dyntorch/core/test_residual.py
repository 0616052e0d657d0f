"""Residuals: whitening against Cholesky, derivatives by autograd, singular points, misuse."""

import pytest
import torch

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.core.residual import multilinear, multilinear_derivative, whiten
from tests.battery.cases import CASES
from tests.battery.references import noisy
from tests.draws import random, seeded
from tests.grid import grid

FORMS = [case for case in CASES if case.invariant.rows() == 1 and case.nullity == 1 and case.invariant.copies is None]


@pytest.mark.parametrize("size", [1, 2, 3, 6])
def test_whiten_is_the_cholesky_solution(size):
    root, error = random(5, 7, size, size), random(5, 7, size, seed=1)
    covariance = root @ root.mT + 0.1 * torch.eye(size).double()
    expected = torch.linalg.solve_triangular(torch.linalg.cholesky(covariance), error[..., None], upper=False)[..., 0]
    torch.testing.assert_close(whiten(error, covariance), expected)
    torch.testing.assert_close(whiten(error, covariance).square().sum(-1), (error * torch.linalg.solve(covariance, error)).sum(-1))
    inputs = [x[0, 0].clone().requires_grad_() for x in (error, covariance)]
    assert torch.autograd.gradcheck(whiten, inputs, check_forward_ad=True)
    for singular in (torch.ones(size, size).double(), torch.zeros(size, size).double()):
        assert whiten(error, singular.expand(5, 7, -1, -1)).isfinite().all()


def test_sampson_of_epipolar_geometry_by_hand():
    f, x1, x2 = random(4, 3, 3), random(4, 6, 2, seed=1), random(4, 6, 2, seed=2)
    p1, p2 = (torch.cat([x, torch.ones(4, 6, 1).double()], -1) for x in (x1, x2))
    l2, l1 = p1 @ f.mT, p2 @ f
    value = (p2 * l2).sum(-1)
    expected = value.abs() / (l1[..., :2].square().sum(-1) + l2[..., :2].square().sum(-1)).sqrt()
    torch.testing.assert_close(dyn.sampson(dyn.FundamentalMatrix, f, x1, x2), expected)
    torch.testing.assert_close(dyn.core.algebraic(dyn.FundamentalMatrix, f, x1, x2), value)
    for scale in (1e-3, -4.0):
        torch.testing.assert_close(dyn.sampson(dyn.FundamentalMatrix, scale * f, x1, x2), expected)


@pytest.mark.parametrize("case", FORMS, ids=repr)
def test_scales_are_the_noise_of_each_view(case):
    """Noise s_v in view v is noise 1 in coordinates that are divided by s_v."""
    if "Dual" in repr(case):
        pytest.skip("the angle of a line has no unit")
    scene = case.scene(12)
    tensor = case.invariant.compose(*scene.motion)
    views = noisy(case, scene.exact, 0.01)
    scales = torch.tensor([0.3, 2.0, 0.7]).double()[: len(views)]
    found = multilinear(case.invariant, tensor, views, tuple(scales))
    value, square = dyn.core.algebraic(case.invariant, tensor, *views), torch.zeros(12).double()
    for v, s in enumerate(scales):
        parts = [x.clone() for x in views]
        parts[v].requires_grad_()
        (slope,) = torch.autograd.grad(dyn.core.algebraic(case.invariant, tensor, *parts).sum(), parts[v])
        square = square + (s * slope).flatten(1).square().sum(-1)
    torch.testing.assert_close(found, value / square.sqrt(), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("case", FORMS, ids=repr)
def test_derivative_by_the_tensor_is_that_of_autograd(case):
    scene = case.scene(5, batch=(2,))
    views = noisy(case, scene.exact, 0.02)
    tensor = random(2, *case.invariant.shape())
    scales = tuple(torch.rand(2, generator=torch.Generator().manual_seed(v)).double() + 0.5 for v in range(len(views)))
    value, derivative = multilinear_derivative(case.invariant, tensor, views, scales)
    torch.testing.assert_close(value, multilinear(case.invariant, tensor, views, scales))
    assert derivative.shape == (2, 5, case.invariant.width())
    for b in range(2):
        one = tuple(x[b] for x in views), tuple(s[b] for s in scales)
        expected = torch.func.jacrev(lambda t, one=one: multilinear(case.invariant, t, *one))(tensor[b]).flatten(1)
        torch.testing.assert_close(derivative[b], expected, rtol=1e-6, atol=1e-7)


def test_static_points_have_a_finite_distance_and_gradient():
    """Value and gradient of the homography tensor vanish together there; with noise a third of the variance is left."""
    scene = scenes.planar(4000, static=1.0, generator=torch.Generator().manual_seed(0))
    tensor = dyn.HomographyTensor.compose(*scene.motion)
    exact = [x.clone().requires_grad_() for x in scene.exact]
    found = dyn.sampson(dyn.HomographyTensor, tensor, *exact)
    found.sum().backward()
    assert found.isfinite().all() and found.max() < 1e-3 and all(x.grad.isfinite().all() for x in exact)
    views = [x + 0.5 * random(*x.shape, seed=v) for v, x in enumerate(scene.exact)]
    square = (dyn.sampson(dyn.HomographyTensor, tensor, *views) / 0.5).square()
    assert abs(float(square.mean()) - 1 / 3) < 0.03
    assert float((square.sqrt() < 1.4).double().mean()) > 0.98


@pytest.mark.parametrize("case", CASES, ids=repr)
def test_distance_of_a_batch_is_that_of_its_problems(case):
    scene = case.scene(7, batch=(2, 3))
    views = noisy(case, scene.exact, 0.01)
    tensor = case.invariant.compose(*scene.motion)
    whole = dyn.sampson(case.invariant, tensor, *views)
    assert whole.shape == (2, 3, 7) and whole.dtype == torch.float64
    alone = dyn.sampson(case.invariant, tensor[1, 2], *(x[1, 2] for x in views))
    torch.testing.assert_close(whole[1, 2], alone, rtol=1e-6, atol=1e-9)
    views[0][1, 2, 3] = torch.nan  # missing
    assert dyn.sampson(case.invariant, tensor, *views).isinf().nonzero().tolist() == [[1, 2, 3]]


F, H, CV = dyn.FundamentalMatrix, dyn.HomographyTensor, dyn.ConstantVelocityTensor
PLANE, SPACE = scenes.planar(12, generator=seeded()), scenes.constant_velocity(5, generator=seeded())
T = H.compose(*PLANE.motion)


@grid(
    (
        ("call", "message"),
        [
            (lambda f: dyn.core.algebraic(CV, CV.compose(*SPACE.motion), *SPACE.views), "gives 3 rows; it has no single algebraic"),
            (lambda f: f("F", torch.eye(3), torch.rand(4, 2), torch.rand(4, 2)), "expected an invariant"),
            (lambda f: f(F, torch.eye(3), *[torch.rand(4, 2)] * 3), r"takes .*2 views, got 3"),
            (lambda f: f(H, T, *PLANE.views[:2]), "3 views, got 2"),
            (lambda f: f(H, T, PLANE.views[0][:5], *PLANE.views[1:]), "same .*batch, n"),
            (lambda f: f(H, T[0], *PLANE.views), "tensor .* must be .*3, 3, 3"),
            (lambda f: f(H, T, *(x.float() for x in PLANE.views)), "tensor is torch.float64"),
            (lambda f: f(H, T, *(x[:, :1] for x in PLANE.views)), "view 1"),
        ],
    ),
    ("function", [dyn.sampson, dyn.core.algebraic]),
)
def test_what_does_not_fit_is_named(call, message, function):
    with pytest.raises(ValueError, match=message):
        call(function)
