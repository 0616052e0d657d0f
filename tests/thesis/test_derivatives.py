"""What the tensors of the thesis change by when their points move: data from its definitions, references of plain torch."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.func import grad, jacrev, jvp, vmap

import dyntorch as dyn
from tests.draws import random as drawn


def moving_points_of_a_plane(n: int, seed: int = 0, noise: float = 1e-3) -> tuple[Tensor, ...]:
    """Chapter 3: points on straight lines of a plane, seen at three times by three cameras, p1 ~ A p2 ~ B p3 for static ones."""
    start, along = drawn(2, n, 2, seed=seed)
    maps = torch.eye(3).double() + 0.2 * drawn(3, 3, 3, seed=seed + 1) * torch.tensor([1.0, 1.0, 0.2]).double()[:, None]
    times = 0.3 * drawn(n, 3, seed=seed + 2)  # no velocity is constant
    seen = [
        torch.cat([start + t[:, None] * along, torch.ones(n, 1).double()], -1) @ m.T for t, m in zip(times.T, maps, strict=True)
    ]
    return tuple(p[:, :2] / p[:, 2:] + noise * drawn(n, 2, seed=seed + 3 + v) for v, p in enumerate(seen))


def rows(x1: Tensor, x2: Tensor, x3: Tensor) -> Tensor:
    """Equation 3.1 of every triplet: the 27 products of the coordinates."""
    p = [torch.cat([x, torch.ones_like(x[:, :1])], -1) for x in (x1, x2, x3)]
    return torch.einsum("ni,nj,nk->nijk", *p).flatten(1)


def by_svd(x1: Tensor, x2: Tensor, x3: Tensor) -> Tensor:
    """The tensor's projector by torch's own SVD, whose derivatives are right where there are more rows than columns."""
    null = torch.linalg.svd(rows(x1, x2, x3), full_matrices=False)[2][-1]
    return null[:, None] * null


def by_fit(x1: Tensor, x2: Tensor, x3: Tensor) -> Tensor:
    tensor = dyn.fit(dyn.HomographyTensor, x1, x2, x3, normalize=False).tensor.flatten()
    return tensor[:, None] * tensor


def test_second_derivatives_are_those_of_the_singular_value_decomposition():
    views, fixed = moving_points_of_a_plane(40), drawn(27, 27, seed=9)
    along = [drawn(40, 2, seed=20 + v) for v in range(3)]

    def value(projector, s: Tensor) -> Tensor:
        return (projector(*(x + s * e for x, e in zip(views, along, strict=True))) * fixed).sum()

    zero = torch.zeros((), dtype=torch.float64)
    for order in (grad, lambda f: grad(grad(f))):
        found, expected = (order(lambda s, p=p: value(p, s))(zero) for p in (by_fit, by_svd))
        torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-9)
    # at the minimal count, where the SVD has no gradient: finite differences
    views = moving_points_of_a_plane(26, noise=0.0)
    along = [drawn(26, 2, seed=20 + v) for v in range(3)]
    slope, h = grad(lambda s: value(by_fit, s)), 1e-5
    expected = (slope(zero + h) - slope(zero - h)) / (2 * h)
    torch.testing.assert_close(grad(slope)(zero), expected, rtol=1e-4, atol=1e-4 * float(slope(zero).abs()))


def test_torch_func_in_any_nesting_on_the_tensors_of_chapter_3():
    problems = [moving_points_of_a_plane(40, seed=s) for s in (0, 50)]
    views, fixed = tuple(torch.stack(x) for x in zip(*problems, strict=True)), drawn(27, 27, seed=9)

    def energy(projector, *views: Tensor) -> Tensor:
        return (projector(*views) * fixed).sum()

    ways = {
        "vmap": lambda f: vmap(f)(*views),
        "vmap of grad": lambda f: vmap(grad(f))(*views),
        "jacrev of vmap": lambda f: jacrev(vmap(f))(*views),
        "jvp": lambda f: jvp(vmap(f), views, tuple(x.cos() for x in views))[1],
    }
    for way in ways.values():
        found, expected = (way(lambda *v, p=p: energy(p, *v)) for p in (by_fit, by_svd))
        torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("form", ["joint", "basis"])
def test_dynamic_shape_tensors_follow_their_points_and_times(form):
    """Chapter 4: a shape of 7 points at constant velocities, every view another affine camera."""
    times = torch.linspace(0, 3, 16).double()
    start, velocity = drawn(2, 7, 3)
    x = (start + times[:, None, None] * velocity) @ drawn(16, 3, 2, seed=1) + 1e-3 * drawn(16, 7, 2, seed=2)
    along, later = 1e-3 * drawn(16, 7, 2, seed=3), 1e-2 * drawn(16, seed=4)
    fixed = drawn(400, seed=5)
    for verb in ("fit", "refine"):

        def value(s: Tensor, verb: str = verb) -> Tensor:
            points, when = (x + s * along).unbind(1), times + s * later
            found = dyn.fit(dyn.DynamicShapeTensor(form=form), *points, times=when)
            if verb == "refine":
                found = dyn.refine(found, *points, times=when)
            tensor = found.tensor.flatten() / found.tensor.norm()
            return (tensor * fixed[: len(tensor)]).sum()

        at, h = torch.zeros((), dtype=torch.float64, requires_grad=True), 1e-2
        (slope,) = torch.autograd.grad(value(at), at, create_graph=True)
        steps = [value(torch.tensor(s * h, dtype=torch.float64)) for s in (-2.0, -1.0, 1.0, 2.0)]
        expected = (8 * (steps[2] - steps[1]) - (steps[3] - steps[0])) / (12 * h)
        torch.testing.assert_close(slope.detach(), expected, rtol=1e-4, atol=1e-7)
        (second,) = torch.autograd.grad(slope, at)
        bend = (steps[1] + steps[2] - 2 * value(at)) / h**2
        torch.testing.assert_close(second, bend.detach(), rtol=2e-2, atol=1e-4 * float(slope.detach().abs()) + 1e-7)


def test_a_missing_point_does_not_spoil_the_gradient_of_the_others():
    x = drawn(12, 7, 3) @ drawn(12, 3, 2, seed=1)
    x[3, 6], x[5, 0] = torch.nan, torch.nan
    weights = torch.ones(12).double()
    weights[7] = 0.0
    for form in ("joint", "basis"):
        inputs = [x.clone().requires_grad_(), weights.clone().requires_grad_()]
        inv, times = dyn.DynamicShapeTensor(form=form), torch.linspace(0, 1, 12).double()
        found = dyn.fit(inv, *inputs[0].unbind(1), times=times, weights=inputs[1])
        slopes = torch.autograd.grad(found.tensor.sin().sum(), inputs)
        assert all(s.isfinite().all() for s in slopes)
        assert slopes[0][torch.isnan(x)].eq(0).all() and slopes[0][7].eq(0).all()
