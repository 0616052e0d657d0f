"""The nearest Grassmann tensor: against the true projections, in turned images, by its stationarity; finite differences."""

import pytest
import torch

from dyntorch.geometry.extensors import compound
from dyntorch.geometry.grassmann import grassmann_tensor
from dyntorch.geometry.grassmann_nearest import _Nearest, projections_of
from dyntorch.numerics.least_squares import jacobian
from tests.draws import random, seeded
from tests.dyntorch.geometry.test_grassmann import CASES, distance, relative, scene
from tests.grid import assert_refused

FULL = [((3, 1), (3, 3)), ((2, 2, 2), (3, 2, 3))]
LINE = ((1, 1, 1), (2, 2, 2))


def noisy(profile, sizes, *batch, sigma=1e-2, seed=0):
    """A tensor of norm 1 and noise of norm about ``sigma``."""
    tensor = grassmann_tensor(scene(profile, sizes, *batch, seed=seed), profile)
    views = len(profile)
    tensor = tensor / tensor.flatten(-views).norm(dim=-1).reshape(*batch, *[1] * views)
    return tensor + sigma * random(*tensor.shape, seed=seed + 50) / tensor[(0,) * len(batch)].numel() ** 0.5


def composed(tensor, profile, sizes):
    return grassmann_tensor(projections_of(tensor, profile, sizes), profile)


@pytest.mark.parametrize(("profile", "sizes"), CASES)
def test_exact_tensors_give_the_true_projections(profile, sizes):
    views = scene(profile, sizes, 4)
    tensor = -3 * grassmann_tensor(views, profile)
    found = projections_of(tensor, profile, sizes)
    assert relative(found, views).max() < 1e-9
    assert distance(found, tensor, profile).max() < 1e-13
    assert all(part.shape == view.shape for part, view in zip(found, views, strict=True))


def each(function):
    """A function of parameters ``(b, p)``, for copies of them ``(k, b, p)``."""
    return lambda copies: torch.stack([function(theta) for theta in copies])


@pytest.mark.parametrize(("profile", "sizes"), [*CASES, *FULL])
def test_nothing_is_nearer(profile, sizes):
    views = scene(profile, sizes, 4)
    tensor = grassmann_tensor(views, profile)
    tensor = tensor + 1e-3 * tensor.flatten(1).norm(dim=-1).mean() * random(*tensor.shape, seed=9) / tensor[0].numel() ** 0.5
    found = projections_of(tensor, profile, sizes)
    apart = distance(found, tensor, profile)
    assert (apart <= distance(views, tensor, profile)).all()
    # stationary: the gradient of the cosine vanishes, by forward differentiation
    unit = tensor.flatten(1) / tensor.flatten(1).norm(dim=-1, keepdim=True)
    problem = _Nearest(tuple(profile), tuple(sizes))

    def cosine(theta):
        value = grassmann_tensor(problem.parts(theta), profile).flatten(1)
        return ((value / value.norm(dim=-1, keepdim=True)) * unit).sum(-1, keepdim=True)

    assert jacobian(each(cosine), problem.stack_projections(found))[1].abs().max() < 1e-12


@pytest.mark.slow
def test_the_hessian_is_the_second_derivative_at_a_minimum():
    profile, sizes = (2, 2, 1), (3, 3, 3)
    tensor = noisy(profile, sizes, 2, sigma=0.1).flatten(1)
    problem, tensor = _Nearest(profile, sizes), tensor / tensor.norm(dim=-1, keepdim=True)
    theta = problem.lowest_minimum(tensor)
    aim = problem.orient(theta, tensor)
    u, _, matrix = problem.linearize(theta)
    hessian = problem.hessian(theta, aim, u, matrix)
    for k in range(theta.shape[1]):
        step = 1e-5 * torch.eye(theta.shape[1], dtype=theta.dtype)[k]
        ahead, behind = (jacobian(each(lambda t: problem.cost(t, aim)[:, None]), theta + s)[1][..., 0] for s in (step, -step))
        torch.testing.assert_close((ahead - behind) / 2e-5, hessian[:, k], rtol=1e-6, atol=1e-8)
    # the free directions are all that it leaves open
    free = problem.free(theta)
    assert (hessian @ free).abs().max() < 1e-12
    assert torch.linalg.matrix_rank(free).tolist() == [27, 27]
    assert torch.linalg.matrix_rank(hessian, rtol=1e-9).tolist() == [18, 18]


@pytest.mark.parametrize(("profile", "sizes"), [((2, 2, 1), (3, 3, 3)), ((2, 2, 2, 1), (3, 3, 3, 3)), ((3, 3, 1), (4, 4, 3))])
def test_noisy_tensors_turn_with_the_images(profile, sizes):
    tensor = noisy(profile, sizes, 6, sigma=3e-2)
    rotations = [torch.linalg.qr(random(m, m, seed=7 + i)).Q for i, m in enumerate(sizes)]
    turned = tensor
    for i, (rotation, alpha) in enumerate(zip(rotations, profile, strict=True)):
        turned = torch.tensordot(turned, compound(rotation, alpha), dims=([i + 1], [1])).movedim(-1, i + 1)
    found = projections_of(tensor, profile, sizes)
    expected = grassmann_tensor([r @ m for r, m in zip(rotations, found, strict=True)], profile)
    assert distance(projections_of(turned, profile, sizes), expected, profile).max() < 1e-11


@pytest.mark.parametrize(("profile", "sizes"), [((2, 2, 1), (3, 3, 3)), ((2, 2, 2), (3, 3, 3)), ((2, 2, 2, 1), (3, 3, 3, 3))])
def test_candidates_start_as_well_as_the_truth(profile, sizes):
    tensor = noisy(profile, sizes, 20, sigma=3e-2).flatten(1)
    tensor = tensor / tensor.norm(dim=-1, keepdim=True)
    problem = _Nearest(profile, sizes)
    theta = problem.stack_projections(scene(profile, sizes, 20))
    truth = problem.nearest(theta, tensor)[1]
    found = problem.lowest_minimum(tensor)
    assert (problem.cost(found, problem.orient(found, tensor)) <= 1.0001 * truth).all()


def test_gauge_sign_scale_and_batch():
    profile, sizes = (2, 2, 2, 1), (3, 3, 3, 3)
    tensor = noisy(profile, sizes, 2, 3)
    found = projections_of(tensor, profile, sizes)
    size = grassmann_tensor(found, profile).flatten(2).norm(dim=-1)
    torch.testing.assert_close(size, torch.ones_like(size))
    norms = torch.stack([part.flatten(-2).norm(dim=-1) for part in found])
    torch.testing.assert_close(norms, norms[:1].expand(4, -1, -1))
    for factor in (-1.0, 1e-200, -1e100):
        for part, same in zip(projections_of(factor * tensor, profile, sizes), found, strict=True):
            torch.testing.assert_close(part, same, rtol=0, atol=1e-9)
    for a in range(2):
        for b in range(3):
            for part, same in zip(projections_of(tensor[a, b], profile, sizes), found, strict=True):
                torch.testing.assert_close(part, same[a, b], rtol=0, atol=1e-9)
    assert projections_of(tensor[:, :0], profile, sizes)[0].shape == (2, 0, 3, 7)
    single = projections_of(tensor.float(), profile, sizes)[3]
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), found[3], rtol=0, atol=1e-3)


@pytest.mark.parametrize("sigma", [0.0, 1e-3, 1e-2])
@pytest.mark.parametrize(("profile", "sizes"), [*CASES, *FULL, LINE])
def test_gradients(profile, sizes, sigma):
    tensor = noisy(profile, sizes, 2, sigma=sigma).requires_grad_()

    def function(t):
        return composed(t, profile, sizes)

    assert torch.autograd.gradcheck(function, tensor, eps=1e-7, atol=1e-5, rtol=1e-3, fast_mode=True)


def test_the_gradient_at_an_exact_tensor_is_the_projector_on_the_tangents():
    profile, sizes = (2, 2, 1), (3, 3, 3)
    tensor = noisy(profile, sizes, 1, sigma=0.0)
    derivative = torch.autograd.functional.jacobian(lambda t: composed(t, profile, sizes), tensor).reshape(27, 27)
    problem = _Nearest(profile, sizes)
    tensors = each(lambda t: grassmann_tensor(problem.parts(t), profile).flatten(1))
    slope = jacobian(tensors, problem.stack_projections(scene(profile, sizes, 1)))[1][0]
    u = tensor.flatten()
    basis = torch.linalg.svd(slope - (slope @ u)[:, None] * u).Vh[:18]
    torch.testing.assert_close(derivative * derivative.trace().sign(), basis.T @ basis, rtol=0, atol=1e-9)


def test_bad_tensors():
    """Refused where the numbers do not fit; finite far from any projection; zero, and alone in it, where they are not finite."""
    assert_refused(
        (lambda: projections_of(random(3, 3, 3), (2, 2, 0), (3, 3, 3)), "profile must have 1 to m_i rows"),
        (lambda: projections_of(random(3, 3), (2, 2, 1), (3, 3, 3)), "is floating point"),
    )
    for profile, sizes in (((2, 2, 1), (3, 3, 3)), LINE):
        tensor = random(*noisy(profile, sizes, 4).shape, seed=3).requires_grad_()
        found = projections_of(tensor, profile, sizes)
        assert all(part.isfinite().all() for part in found)
        assert torch.autograd.grad(sum(part.sum() for part in found), tensor)[0].isfinite().all()
        assert (distance(found, tensor, profile) < 1).all()
    one = torch.zeros(1, 3, 3, 3, dtype=torch.float64)
    one[0, 0, 1, 2] = 1.0  # a single minor is a tensor of its own, with many projections of rank below three
    assert distance(projections_of(one, (2, 2, 1), (3, 3, 3)), one, (2, 2, 1)).max() < 1e-12
    profile, sizes = (2, 2, 1), (3, 3, 3)
    tensor = noisy(profile, sizes, 4)
    tensor[0], tensor[2, 1, 1, 1], tensor[3, 0, 0, 0] = 0.0, torch.nan, torch.inf
    tensor.requires_grad_()
    found = projections_of(tensor, profile, sizes)
    weights = [random(3, 5, seed=i) for i in range(3)]
    (gradient,) = torch.autograd.grad(sum((part * w).sum() for part, w in zip(found, weights, strict=True)), tensor)
    alone = tensor[1:2].detach().requires_grad_()
    again = projections_of(alone, profile, sizes)
    (expected,) = torch.autograd.grad(sum((part * w).sum() for part, w in zip(again, weights, strict=True)), alone)
    for part, same in zip(found, again, strict=True):
        assert (part[[0, 2, 3]] == 0).all()
        torch.testing.assert_close(part[1], same[0], rtol=0, atol=1e-9)
    assert (gradient[[0, 2, 3]] == 0).all()
    assert expected.norm() > 0
    torch.testing.assert_close(gradient[1], expected[0], rtol=1e-8, atol=1e-9)


def test_second_derivatives_of_the_nearest_tensor():
    """Of a noisy tensor, composed again: free of the gauge of the projections."""
    draw = seeded(4)
    true = grassmann_tensor(torch.randn(3, 3, 4, generator=draw, dtype=torch.float64), (2, 1, 1))
    noisy = true / true.norm() + 0.01 * torch.randn(true.shape, generator=draw, dtype=torch.float64)

    def again(tensor):
        return grassmann_tensor(projections_of(tensor, (2, 1, 1), (3, 3, 3)), (2, 1, 1))

    assert torch.autograd.gradgradcheck(again, noisy.requires_grad_(), fast_mode=True, eps=1e-5, atol=1e-4)
