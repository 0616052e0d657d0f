"""Dynamic shape tensors of projective cameras: exactness, counts, derivatives, what they win near by, statuses."""

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

import dyntorch as dyn
from dyntorch.counting import count
from dyntorch.shapes import projective
from dyntorch.shapes.moving import centred_views
from dyntorch.shapes.projective import PerspectiveDescent, perspective
from tests.battery.references import rank
from tests.battery.shape_cases import spread

NEAR = dyn.DynamicShapeTensor(camera="projective")


def scene(n, views, distance, *, seed=0, sigma=0.0):
    """Views ``(views, n, 2)`` of points at constant velocity, each by a turned camera, their times, and shapes ``(2, n, 3)``."""
    g = torch.Generator().manual_seed(seed)
    shapes = torch.stack([spread(n, (), g), 0.5 * torch.randn(n, 3, generator=g, dtype=torch.float64)])
    times = 2 * torch.rand(views, generator=g, dtype=torch.float64) - 1
    times[:2] = torch.tensor([-1.0, 1.0])
    turn = torch.linalg.qr(torch.randn(views, 3, 3, generator=g, dtype=torch.float64)).Q
    seen = (shapes[0] + times[:, None, None] * shapes[1]) @ turn.mT
    x = 800 * seen[..., :2] / (1 + seen[..., 2:] / distance)
    return x + sigma * 800 * torch.randn(x.shape, generator=g, dtype=torch.float64), times, shapes


@pytest.fixture(scope="module")
def exact():
    x, times, shapes = scene(9, 30, 8.0, seed=2)
    return x, times, shapes, dyn.fit(NEAR, *x[:20].unbind(1), times=times[:20]).check()


@pytest.mark.slow
def test_exact_views_give_exact_times_and_scores(exact):
    x, times, shapes, solution = exact
    inv = solution.invariant
    found = inv.recover(solution.tensor, *x[20:].unbind(1))
    torch.testing.assert_close(found.times, times[20:], atol=1e-6, rtol=0)
    assert inv.score(solution.tensor, *x[20:].unbind(1)).max() < 1e-10
    other = scene(9, 10, 8.0, seed=5)[0]
    assert inv.score(solution.tensor, *other.unbind(1)).median() > 1e-4
    assert dyn.sampson(inv, solution.tensor, *x.unbind(1), times=times).max() < 1e-3  # px of 800
    # the shapes up to an affinity of the world and a translation of every function
    flat, true = (torch.cat([s - s.mean(-2, keepdim=True) for s in both.unbind(-3)], 0) for both in (
        solution.tensor.unflatten(-1, (2, 3)).movedim(1, 0), shapes))  # fmt: skip
    left = true - flat @ torch.linalg.lstsq(flat, true).solution
    assert left.norm() < 1e-6 * true.norm()
    again = inv.compose(torch.cat([shapes[0], shapes[1]], -1))
    torch.testing.assert_close(again.abs(), solution.tensor.abs(), atol=1e-6, rtol=0)


def test_counts(exact):
    solution = exact[3]
    inv = solution.invariant
    assert (inv.dof, inv.codim, inv.minimal(), inv.width(), inv.rows()) == (6 * 8 - 9, 7, 6, 50, 1)
    rows = inv.primitives[0].vectors(solution.matches.views[0][0])
    assert rows.shape == (20, 1, 50) and rank(rows.flatten(0, 1)) == 20
    assert count("dynamic_shape", synthetic=True).minimal == 49 and count("dynamic_shape", coplanar_base=True).minimal == 8
    # the freedom that views know: rank of the derivative of all distances by the shapes
    motion, views = (solution.motion[0][None],), (solution.matches.views[0],)
    slope = inv.linearize(motion, views, (torch.ones(1).double(),))[1][0]
    values = torch.linalg.svdvals(slope)
    assert int((values > 1e-7 * values[0]).sum()) == inv.dof


@pytest.mark.slow
def test_near_views_are_dated_better_than_by_affine_cameras_and_far_ones_no_worse():
    errors = {}
    for distance in (4.0, 30.0):
        x, times, _ = scene(10, 70, distance, seed=3, sigma=0.01)
        for camera in ("affine", "projective"):
            family = dyn.DynamicShapeTensor(camera=camera)
            solution = dyn.fit(family, *x[:40].unbind(1), times=times[:40]).check()
            found = solution.invariant.recover(solution.tensor, *x[40:].unbind(1))
            errors[distance, camera] = float((found.times - times[40:]).abs().median())
    assert errors[4.0, "projective"] < 0.02 < 0.2 * errors[4.0, "affine"]
    assert errors[30.0, "projective"] < 1.1 * errors[30.0, "affine"]


@pytest.mark.slow
def test_refinement_lowers_the_distances_and_its_derivative_is_right():
    x, times, _ = scene(8, 30, 6.0, seed=2, sigma=0.005)
    solution = dyn.fit(NEAR, *x.unbind(1), times=times).check()
    refined = dyn.refine(solution, *x.unbind(1), times=times)
    cost = [dyn.sampson(s.invariant, s.tensor, *x.unbind(1), times=times).square().sum() for s in (solution, refined)]
    assert cost[1] <= cost[0] * (1 + 1e-9) and 2.5 < float(refined.sigma) < 6  # .005 of 800 px
    inv = solution.invariant
    scales, views = (torch.ones(1).double(),), (solution.matches.views[0],)
    motion = solution.motion[0][None]
    value, slope = inv.linearize((motion,), views, scales)
    step = 1e-6 * torch.randn(motion.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    costs = [inv.linearize((motion + s * step,), views, scales)[0].square().sum() for s in (1, -1)]
    # Kaufman's form leaves out a part of the derivative that is across to the residual: the gradient of the cost is whole
    torch.testing.assert_close(costs[0] - costs[1], 4 * (slope @ value[..., None]).flatten() @ step.flatten(), rtol=1e-2, atol=0)
    torch.testing.assert_close(inv.whitened_residual((motion,), views, scales).flatten(), value.flatten())


@pytest.mark.parametrize("prior", [0.0, 0.02])
def test_the_perspective_image_is_the_nearest_one(prior, monkeypatch):
    """Against scipy, whose camera has the same eleven numbers, and the prior of the relative depths."""
    x, _, shapes = scene(8, 3, 6.0, seed=4, sigma=0.01)
    views = centred_views(x[None])
    x, weight = views.x[0, 0], torch.linspace(0.5, 1.5, 8).double()
    middle = (shapes[0] * weight[:, None]).sum(0) / weight.sum()
    world, target = (shapes[0] - middle).numpy(), x.numpy()

    def residual(c):
        depth = 1 + world @ c[8:]
        off = target - (world @ c[:6].reshape(3, 2) + c[6:8]) / depth[:, None]
        root = weight.sqrt().numpy()
        more = np.sqrt(prior / weight.sum().item()) * root * (world @ c[8:])
        return np.concatenate([(off * root[:, None]).ravel(), more])

    best = least_squares(residual, np.zeros(11), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    monkeypatch.setattr(projective, "CAMERA_STEPS", 6)
    found = perspective(x, weight, shapes[0], prior)
    np.testing.assert_allclose(found.residual.square().sum(), 2 * best.cost, rtol=1e-6)
    np.testing.assert_allclose(found.cost, np.square(residual(best.x)[:16]).sum(), rtol=1e-4)


@pytest.mark.parametrize(("prior", "off"), [(0.0, 1e-6), (0.01, 5e-2)])  # what a shift of the middle does to the prior is left out
def test_the_descent_has_the_gradient_of_its_cost(prior, off, monkeypatch):
    x, times, shapes = scene(7, 12, 6.0, seed=6, sigma=0.01)
    views, rows = centred_views(x[None]), dyn.Polynomial(1).rows(times)[None]
    monkeypatch.setattr(projective, "CAMERA_STEPS", 8)
    problem = PerspectiveDescent(views, rows, torch.tensor([prior]).double())
    theta = (shapes + 0.05).flatten()[None]
    _, gradient, matrix = problem.normal_equations(theta)
    steps = 1e-5 * torch.randn(4, theta.shape[1], generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    for step in steps:
        sides = [problem.normal_equations(theta + s * step)[0] for s in (1, -1)]
        apart = (sides[0] - sides[1]) / 2 - 2 * gradient @ step
        assert float(apart.abs()) < off * float(gradient.norm() * step.norm())
    torch.testing.assert_close(matrix, matrix.mT)


@pytest.mark.slow
def test_batch_is_loop_and_bad_problems_are_statuses(exact):
    x, times, _, solution = exact
    bad = torch.stack([x[:20], torch.full_like(x[:20], torch.nan), x[:20]])
    bad[2, 4:] = torch.nan
    found = dyn.fit(NEAR, *bad.unbind(2), times=times[:20])
    assert found.status.tolist() == [dyn.Status.OK, dyn.Status.TOO_FEW, dyn.Status.TOO_FEW]
    torch.testing.assert_close(found.tensor[0], solution.tensor, atol=1e-6, rtol=0)
    assert found.tensor.isfinite().all() and found.tensor[1:].abs().max() == 0
    gone = x[20:].clone()
    gone[0, 4:] = torch.nan  # four points say nothing
    gone[1, 2] = torch.nan
    again = solution.invariant.recover(solution.tensor, *gone.unbind(1))
    assert again.status.tolist() == [dyn.Status.TOO_FEW] + [dyn.Status.OK] * 9
    torch.testing.assert_close(again.times[1:], times[21:], atol=1e-5, rtol=0)
    single = solution.invariant.recover(solution.tensor.float(), *x[20:].float().unbind(1))
    assert single.residual.dtype == torch.float32 and (single.times - times[20:]).abs().max() < 1e-2


def test_misuse_is_a_value_error_with_its_remedy(exact):
    x, times = exact[:2]
    for call, message in (
        (lambda: dyn.DynamicShapeTensor(camera="pinhole"), "camera must be 'affine' or 'projective', got 'pinhole'"),
        (lambda: dyn.DynamicShapeTensor(form="span", camera="projective"), "take the form 'joint'.*use form='joint'"),
        (lambda: dyn.DynamicShapeTensor(dyn.Polynomial(0), camera="projective"), "points that move.*use ShapeTensor"),
        (lambda: dyn.fit(NEAR, *x[:, :5].unbind(1), times=times), "needs at least 6 points, got 5"),
        (lambda: dyn.fit(NEAR, *x[:5].unbind(1), times=times[:5]), "needs at least 6 matches, got 5"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
