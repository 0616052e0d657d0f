"""Dynamic tensors against brute force: the forms that vanish, their derivatives, and the distance from the nearest flat."""

from functools import reduce

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

import dyntorch as dyn
from dyntorch import counting, scenes
from dyntorch.geometry.extensors import levi_civita
from dyntorch.invariants.dynamic_tensor import flat_residual, flat_residual_derivative, forms_of_views, vanishing_forms
from tests.draws import random, seeded
from tests.grid import assert_refused


@pytest.mark.parametrize(
    ("size", "views", "step"), [(2, 2, 1), (2, 5, 1), (3, 3, 2), (3, 4, 2), (3, 4, 1), (4, 4, 3), (4, 3, 2), (3, 5, 2)]
)
def test_vanishing_forms_are_the_complement_of_products_within_a_subspace(size, views, step):
    forms = vanishing_forms(size, views, step, torch.device("cpu")).flatten(1)
    assert len(forms) == size**views - counting.dim_v(size, views, step)
    torch.testing.assert_close(forms @ forms.T, torch.eye(len(forms), dtype=torch.float64))
    for seed in range(5):
        row = reduce(torch.kron, random(views, step, seed=seed) @ random(step, size, seed=10 + seed))
        assert (forms @ row).abs().max() < 1e-12 * row.norm()


def test_forms_of_some_views_are_found_within_those_of_all():
    A = torch.eye(3) + 0.3 * random(4, 3, 3, seed=1)
    basis = dyn.DynamicTensor(2, 5, 2).compose(*A)
    for slots in ((0, 1, 2), (0, 2, 4), (1, 3, 4)):
        found = forms_of_views(basis, 5, slots, 2)[0]
        maps = [torch.eye(3).double(), *A]
        a, b, c = (maps[s] for s in slots)
        wanted = torch.einsum("uvw,ui,vj,wk->ijk", levi_civita(3), a, b, c)
        assert abs(float((found * wanted / wanted.norm()).sum())) == pytest.approx(1, abs=1e-9)


@pytest.mark.parametrize("numbers", [(2, 3, 2), (3, 4, 3), (1, 2, 1)])
def test_derivative_of_the_tensor_is_right(numbers):
    invariant = dyn.DynamicTensor(*numbers)
    size = invariant.size
    motion = random(invariant.views - 1, 2, size, size, seed=2).unbind(0)
    value, slope = invariant.compose_derivative(motion)
    torch.testing.assert_close(value, invariant.compose(*motion).flatten(1))
    theta = torch.cat([part.flatten(1) for part in motion], dim=-1)

    def tensor(theta):
        return invariant.compose(*theta.unflatten(-1, (-1, size, size)).unbind(-3)).flatten(-invariant.views)

    torch.testing.assert_close(slope, torch.stack([torch.func.jacfwd(tensor)(row) for row in theta]).mT)


@pytest.mark.parametrize(("dim", "views", "step"), [(3, 4, 2), (3, 5, 3), (2, 3, 1)])
def test_distance_is_the_least_one_to_exact_matches(dim, views, step):
    """By a general search over the flat and the positions within it, from the true ones."""
    sigma, n = 2e-2, 4
    scene = scenes.dynamic(dim, views, step, n, sigma=sigma, generator=seeded(3))
    invariant = dyn.DynamicTensor(dim, views, step)
    found = dyn.sampson(invariant, invariant.compose(*scene.motion), *scene.views)
    maps = np.stack([np.eye(dim + 1), *(m.numpy() for m in scene.motion)])
    back = np.linalg.inv(maps)
    for i in range(n):
        seen = np.stack([x[i].numpy() for x in scene.views])
        exact = np.stack([x[i].numpy() for x in scene.exact])
        carried = np.einsum("vij,vj->vi", maps, np.hstack([exact, np.ones((views, 1))]))
        carried = carried[:, :-1] / carried[:, -1:]
        centre = carried.mean(0)
        frame = np.linalg.svd(carried - centre)[2][: step - 1]
        start = np.concatenate([centre, frame.ravel(), ((carried - centre) @ frame.T).ravel()])

        def cost(z, seen=seen):
            origin, axes, t = np.split(z, [dim, dim + (step - 1) * dim])
            world = origin + t.reshape(views, step - 1) @ axes.reshape(step - 1, dim)
            image = np.einsum("vij,vj->vi", back, np.hstack([world, np.ones((views, 1))]))
            return float(((image[:, :-1] / image[:, -1:] - seen) ** 2).sum()) / sigma**2

        least = minimize(cost, start, method="BFGS", options={"gtol": 1e-6}).fun
        assert float(found[i]) ** 2 / sigma**2 == pytest.approx(least, rel=1e-4)


@pytest.mark.parametrize(("dim", "views", "step"), [(3, 4, 2), (3, 5, 3), (2, 4, 1), (4, 5, 2)])
def test_derivative_of_the_distance_is_right(dim, views, step):
    scene = scenes.dynamic(dim, views, step, 6, batch=2, sigma=1e-2, generator=seeded(4))
    size = dim + 1
    scales = [torch.tensor([1.0, 2.0]).double() * (v + 1) for v in range(views)]

    def stacked(theta):
        return torch.cat([torch.eye(size).double().expand(2, 1, -1, -1), theta.unflatten(-1, (-1, size, size))], dim=1)

    theta = torch.cat([m.flatten(1) for m in scene.motion], dim=-1)
    value, derivative = flat_residual_derivative(stacked(theta), scene.views, scales, step)
    for along in random(3, *theta.shape, seed=5):
        squares = [
            flat_residual(stacked(theta + s * along), scene.views, scales, step).flatten(1).square().sum(-1) for s in (1e-6, -1e-6)
        ]
        expected = (squares[0] - squares[1]) / 2e-6
        torch.testing.assert_close(2 * (along[:, None] @ derivative)[:, 0].mul(value).sum(-1), expected, rtol=1e-5, atol=1e-8)


def test_points_that_stand_still_have_a_distance_as_well():
    """The flat is open there: the distance stays below that of a point, above that of the best of many lines."""
    scene = scenes.dynamic(3, 4, 2, 50, sigma=1e-3, static=1.0, generator=seeded(7))
    on_lines, at_points = dyn.DynamicTensor(3, 4, 2), dyn.DynamicTensor(3, 4, 1)
    line = dyn.sampson(on_lines, on_lines.compose(*scene.motion), *scene.views).square() / 1e-6
    point = dyn.sampson(at_points, at_points.compose(*scene.motion), *scene.views).square() / 1e-6
    assert (line <= point * (1 + 1e-9)).all() and 0.8 < float(point.mean()) / 9 < 1.2
    still = on_lines.whitened_static_residual(scene.motion, scene.views, (torch.ones(()).double(),) * 4).square().sum(-1) / 1e-6
    torch.testing.assert_close(still, point, rtol=0.05, atol=0.05)


def test_mixed_scenes_are_what_they_say():
    scene = scenes.dynamic(3, 4, 3, 30, mixed=True, generator=seeded(9))
    maps = (torch.eye(4).double(), *scene.motion)
    p = [torch.cat([x, torch.ones_like(x[:, :1])], dim=-1) for x in scene.exact]
    p = torch.stack([x @ m.T for x, m in zip(p, maps, strict=True)], dim=1)
    ranks = torch.linalg.matrix_rank(torch.nn.functional.normalize(p, dim=-1), rtol=1e-9)
    assert torch.equal(ranks, scene.extras["dimensions"]) and set(ranks.tolist()) == {1, 2, 3}


def test_misuse():
    invariant = dyn.DynamicTensor(2, 4, 2)
    assert_refused(
        (lambda: scenes.dynamic(0), "must be 1 or more, got 0, 3, 2"),
        (lambda: invariant.compose(torch.eye(3)), r"has 3 maps \(\*batch, 3, 3\), got \[\(3, 3\)\]"),
        (lambda: invariant.decompose(torch.zeros(3, 3, 3)), r"must be \(\*batch, 9, 3, 3, 3, 3\), got \(3, 3, 3\)"),
        (
            lambda: invariant.flats(torch.zeros(9, 3, 3, 3, 3), torch.zeros(1, 2)),
            "expected 4 views and one of their numbers, got 1 views and view=1",
        ),
    )
