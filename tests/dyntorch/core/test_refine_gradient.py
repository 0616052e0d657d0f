"""How refined solutions follow the data: every order, weights, labels, inliers, problems that failed, descents that ended early."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.core.refine import RefineNotice

H = dyn.HomographyTensor


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def line(sigma: float = 0.02) -> tuple[Tensor, Tensor]:
    """Matches of a collineation of the line."""
    x = torch.randn(8, 1, generator=seeded(), dtype=torch.float64)
    y = (2 * x + 1) / (0.3 * x + 3) + sigma * torch.randn(8, 1, generator=seeded(1), dtype=torch.float64)
    return x, y


def refined(x: Tensor, y: Tensor, weights: Tensor | None = None) -> Tensor:
    """Four numbers of the motion that do not depend on its scale."""
    solution = dyn.refine(dyn.fit(dyn.Collineation(1), x, y, weights=weights), x, y)
    matrix = solution.motion[0]
    return torch.stack([*(matrix / matrix[1, 1]).flatten()[:3], solution.sigma])


@pytest.mark.slow
def test_the_minimum_is_that_of_a_brute_force_descent_and_follows_like_it():
    """The Sampson error written out for a map of the line, minimized by Newton's method of automatic differentiation alone."""
    x, y = line()

    def cost(h: Tensor, x: Tensor, y: Tensor) -> Tensor:
        top, below = h[0] * y[:, 0] + h[1], h[2] * y[:, 0] + 1
        slope = (h[0] * below - h[2] * top) / below.square()
        return ((x[:, 0] - top / below).square() / (1 + slope.square())).sum()

    def newton(x: Tensor, y: Tensor) -> Tensor:
        h = refined(x, y)[:3].detach()
        for _ in range(3):  # two beside the minimum: derivatives of second order go through the steps
            h = h - torch.linalg.solve(torch.func.hessian(cost)(h, x, y), torch.func.grad(cost)(h, x, y))
        return h

    value, expected = refined(x, y)[:3], newton(x, y)
    torch.testing.assert_close(value, expected, rtol=1e-6, atol=1e-9)
    weight = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    found = torch.func.jacrev(lambda x: refined(x, y)[:3])(x)
    torch.testing.assert_close(found, torch.func.jacrev(lambda x: newton(x, y))(x), rtol=1e-5, atol=1e-8)
    found = torch.func.hessian(lambda x: (refined(x, y)[:3] * weight).sum())(x)
    torch.testing.assert_close(found, torch.func.hessian(lambda x: (newton(x, y) * weight).sum())(x), rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_derivatives_by_matches_and_weights_up_to_the_second():
    x, y = line()
    weights = torch.linspace(0.5, 1.5, 8, dtype=torch.float64)
    inputs = [part.requires_grad_() for part in (x, y, weights)]
    assert torch.autograd.gradcheck(refined, inputs, fast_mode=True, eps=1e-5, atol=1e-6)
    assert torch.autograd.gradgradcheck(refined, inputs, fast_mode=True, eps=1e-5, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("labelled", [False, True])
def test_torch_func_agrees_with_autograd(labelled):
    views = scenes.planar(40, sigma=0.5, batch=2, static=0.3, generator=seeded()).views
    static = torch.rand(2, 40, generator=seeded(2)) < 0.2 if labelled else None

    def value(views: tuple[Tensor, ...], static: Tensor | None) -> Tensor:
        found = dyn.refine(dyn.fit(H, *views, static=static), *views)
        assert found.sigma is not None and found.covariance is not None
        return found.tensor.sin().sum() + found.sigma.sum() + (0 * found.covariance).sum()

    leaves = tuple(x.clone().requires_grad_() for x in views)
    expected = torch.autograd.grad(value(leaves, static), leaves)
    ways = [torch.func.grad(lambda v: value(v, static))(views)]
    ways.append(torch.func.vmap(torch.func.grad(value), in_dims=(0, 0 if labelled else None))(views, static))
    for way in ways:
        for one, other in zip(way, expected, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-9 * float(other.abs().max()))
    tangents = tuple(torch.randn(x.shape, generator=seeded(5), dtype=x.dtype) for x in views)
    moved = torch.func.jvp(lambda *v: value(v, static), views, tangents)[1]
    torch.testing.assert_close(moved, sum((a * b).sum() for a, b in zip(expected, tangents, strict=True)), rtol=1e-6, atol=1e-10)


def test_inliers_of_a_robust_fit_are_weights_that_stay():
    views = tuple(x.requires_grad_() for x in scenes.planar(100, sigma=0.5, outliers=0.3, generator=seeded()).views)
    robust = dyn.robust_fit(H, *views, threshold=1.5, generator=seeded())
    found = torch.autograd.grad(dyn.refine(robust, *views).tensor.sin().sum(), views)
    weights = robust.inliers.double()
    same = dyn.refine(replace(robust, inliers=None), *views, weights=weights)
    for one, other in zip(found, torch.autograd.grad(same.tensor.sin().sum(), views), strict=True):
        torch.testing.assert_close(one, other)
        assert (one[~robust.inliers] == 0).all() and (one[robust.inliers] != 0).any(-1).all()
    assert not robust.tensor.requires_grad


def test_problems_that_failed_have_gradients_of_zero_and_leave_the_others_alone():
    views = [x.clone() for x in scenes.planar(40, sigma=0.5, batch=3, generator=seeded()).views]
    views[0][1] = torch.nan
    views[1][2] = 1.0
    views = [x.requires_grad_() for x in views]
    for verb in (lambda *v: dyn.fit(H, *v), lambda *v: dyn.refine(dyn.fit(H, *v), *v)):
        found = verb(*views)
        assert found.status.tolist() == [0, dyn.Status.TOO_FEW, dyn.Status.DEGENERATE]
        total = found.tensor.sin().sum() + sum(m.square().sin().sum() for m in found.motion)
        alone = verb(*(x[0] for x in views))
        expected = torch.autograd.grad(alone.tensor.sin().sum() + sum(m.square().sin().sum() for m in alone.motion), views)
        for one, other in zip(torch.autograd.grad(total, views), expected, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-10)
            assert (one[1:] == 0).all()


def test_a_descent_that_ended_early_says_so_where_gradients_are_wanted():
    views = scenes.planar(60, sigma=3.0, batch=2, generator=seeded()).views
    solution = dyn.fit(H, *views)
    assert dyn.refine(solution, *views, iterations=1).notices == ()
    for x in views:
        x.requires_grad_()
    early = dyn.refine(solution, *views, iterations=1).notices
    assert [(notice.code, notice.problem) for notice in early] == [(RefineNotice.UNFINISHED, (0,)), (RefineNotice.UNFINISHED, (1,))]
    assert "raise iterations" in str(early[0]) and early[0].value > 1e-6
    assert dyn.refine(solution, *views).notices == ()
    with torch.no_grad():
        assert dyn.refine(solution, *views, iterations=1).notices == ()


def test_exact_matches_have_finite_gradients_without_a_notice():
    views = tuple(x.requires_grad_() for x in scenes.planar(40, generator=seeded()).views)
    found = dyn.refine(dyn.fit(H, *views), *views)
    assert found.notices == ()
    for one in torch.autograd.grad(found.tensor.sin().sum(), views):
        assert one.isfinite().all() and one.abs().max() > 0
