"""Dynamic shape tensors through ``fit``: forms, counts, invariance, missing points, times in the unit given; projective cameras."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

import dyntorch as dyn
from dyntorch.counting import count
from dyntorch.invariants.dynamic_shape_tensor import DynamicShapeTensor
from dyntorch.shapes import projective
from dyntorch.shapes.basis import Fourier, Polynomial
from dyntorch.shapes.moving import centred_views
from dyntorch.shapes.projective import PerspectiveDescent, perspective
from tests.battery.references import rank
from tests.battery.shape_cases import spread
from tests.draws import random, seeded
from tests.dyntorch.shapes.moving_views import LINEAR, SQUARE, WAVE, moving_views
from tests.grid import assert_refused

FORMS = ("joint", "basis", "span")
TIMED = ("joint", "basis")


def times(count, seed=1):
    inner = 2 * torch.rand(count - 2, generator=seeded(seed), dtype=torch.float64) - 1
    return torch.cat([torch.tensor([-1.0, 1.0]).double(), inner])


def fitted(x, t, form="joint", trajectory=None, **options):
    return dyn.fit(DynamicShapeTensor(trajectory or Polynomial(1), form=form), *x.unbind(-2), times=t, **options)


def vanishing(tensor, trajectory, t, form):
    """A matrix per view ``(v, n, m)`` that is orthogonal to its shape, from the definition of the tensor."""
    if form == "basis":
        return torch.einsum("vk,knm->vnm", trajectory.power(3).rows(t), tensor)
    if form == "span":
        return tensor.reshape(-1, tensor.shape[-1]).mT.expand(len(t), -1, -1)
    n = len(tensor)
    shape = torch.einsum("vb,nbk->vnk", trajectory.rows(t), tensor.unflatten(-1, (-1, 3)))
    full = torch.cat([shape, torch.ones(len(t), n, 1).double()], dim=-1)
    return torch.linalg.svd(full)[0][..., 4:]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("functions", "trajectory"), [(LINEAR, Polynomial(1)), (WAVE, Fourier(1, period=torch.pi * 2))])
def test_the_tensor_of_exact_views_vanishes_on_new_ones(form, functions, trajectory):
    t = times(45)
    x, shapes = moving_views(functions, t, n=12)
    solution = fitted(x[:35], t[:35], form, trajectory).check()
    assert solution.tensor.shape[-len(solution.invariant.shape()) :] == solution.invariant.shape()
    matrix = vanishing(solution.tensor, trajectory, t[35:], form)
    assert (matrix.mT @ x[35:]).abs().max() < 1e-7
    assert (matrix.mT @ torch.ones(12, 1).double()).abs().max() < 1e-10
    # the same tensor is that of the true shapes
    true = replace(solution.invariant, points=12).compose(shapes.transpose(0, 1).flatten(1))
    if form == "span":
        same = solution.tensor.mT, true.mT
    elif form == "basis":
        same = solution.tensor.reshape(-1, 1), true.reshape(-1, 1)
    else:
        same = vanishing(solution.tensor, trajectory, t, form), vanishing(true, trajectory, t, form)
    first, second = (torch.linalg.qr(m)[0] for m in same)
    assert (first @ first.mT - second @ second.mT).abs().max() < 1e-7


@pytest.mark.parametrize(("form", "n", "count"), [("basis", 5, 8), ("basis", 8, 7), ("basis", 14, 7), ("joint", 14, 7)])
def test_constant_velocity_needs_eight_or_seven_frames(form, n, count):
    t = times(30)
    x, _ = moving_views(LINEAR, t, n=n)
    assert DynamicShapeTensor(form=form, points=n).minimal() == count
    solution = fitted(x[:count], t[:count], form).check()
    assert solution.singular_values[-2] > 1e-9 * solution.singular_values[0]
    assert solution.invariant.score(solution.tensor, *x.unbind(-2)).max() < 1e-10
    with pytest.raises(ValueError, match=rf"at least {count} matches, got {count - 1}"):
        fitted(x[: count - 1], t[: count - 1], form)
    if (form, n) == ("basis", 8):  # too high a degree
        assert fitted(x, t, "basis", Polynomial(2)).status == dyn.Status.DEGENERATE


@pytest.mark.parametrize(("size", "count"), [(1, 2), (2, 3), (3, 5)])
def test_the_span_of_all_positions_needs_two_three_five_frames(size, count):
    n, t = 3 * size + 2, times(20)
    x, _ = moving_views(SQUARE[:size], t, n=n)
    invariant = DynamicShapeTensor(Polynomial(size - 1), form="span", points=n)
    assert (invariant.minimal(), invariant.nullity) == (count, 1)
    solution = dyn.fit(invariant, *x[:count].unbind(-2)).check()  # no times
    assert solution.invariant.score(solution.tensor, *x.unbind(-2)).max() < 1e-12
    assert solution.invariant.score(solution.tensor, *random(9, n, 2, seed=3).unbind(-2)).min() > 1e-4
    with pytest.raises(ValueError, match=f"at least {n} points, got {n - 1}"):
        dyn.fit(invariant, *x[:, 1:].unbind(-2))


@pytest.mark.parametrize("form", TIMED)
def test_times_come_back_in_their_own_unit(form):
    t = 100.0 + 7.0 * times(40)
    x, _ = moving_views(LINEAR, (t - 100) / 7, n=8)
    solution = fitted(x[:30], t[:30], form)
    found = solution.invariant.recover(solution.tensor, *x[30:].unbind(-2))
    torch.testing.assert_close(found.times, t[30:], atol=1e-6, rtol=0)
    plain = fitted(x[:30], (t[:30] - 100) / 7, form)
    # the unit and the origin of the times are no part of the tensor
    torch.testing.assert_close(plain.tensor, solution.tensor, rtol=1e-6, atol=1e-8)
    assert (dyn.sampson(solution.invariant, solution.tensor, *x.unbind(-2), times=t) < 1e-7).all()


@pytest.mark.parametrize("form", TIMED)
def test_decompose_gives_the_trajectories_up_to_an_affine_frame(form):
    t = times(20)
    _, shapes = moving_views(LINEAR, t, n=9)
    invariant = DynamicShapeTensor(form=form, points=9)
    found = invariant.decompose(invariant.compose(shapes.transpose(0, 1).flatten(1)))
    both = [s - s.mean(-2, keepdim=True) for s in (found.unflatten(-1, (2, 3)).transpose(0, 1), shapes)]
    known, wanted = (s.flatten(0, 1) for s in both)  # one 3 x 3 frame for position and velocity
    torch.testing.assert_close(known @ torch.linalg.lstsq(known, wanted).solution, wanted, rtol=0, atol=1e-8)
    again = invariant.tensor_of(invariant.basis_of(invariant.compose(found)))
    torch.testing.assert_close(again / again.norm(), invariant.compose(found))


def test_joint_is_more_accurate_than_basis_and_refinement_keeps_it():
    t = times(90)
    x, _ = moving_views(LINEAR, t, n=14, batch=(6,), noise=0.01)

    def error(solution):
        return float((solution.invariant.recover(solution.tensor, *x[:, 40:].unbind(-2)).times - t[40:]).abs().median())

    basis, joint = (fitted(x[:, :40], t[:40], form) for form in ("basis", "joint"))
    assert not joint.status.any()
    assert error(joint) < 0.004  # the prototype with four basis points: 0.005
    assert error(joint) < 0.6 * error(basis)
    assert (joint.uncertainty < 0.05).all()


def test_refinement_brings_four_basis_points_to_the_least_distances():
    t = times(40)
    x, _ = moving_views(LINEAR, t, n=7, noise=0.01)
    solutions = [fitted(x, t, form) for form in TIMED]
    refined = [dyn.refine(solution, *x.unbind(-2), times=t) for solution in solutions]
    before, after = (
        [float(dyn.sampson(s.invariant, s.tensor, *x.unbind(-2), times=t).square().sum()) for s in group]
        for group in (solutions, refined)
    )
    assert after[0] == pytest.approx(after[1], rel=1e-4)
    assert after[1] < before[1]
    assert after[0] < before[0]
    # the noise is the same part of each view here, and it is that of the views together
    extent = (x - x.mean(-2, keepdim=True)).square().mean((-2, -1)).mean().sqrt()
    assert 0.005 < float(refined[0].sigma / extent) < 0.02


@pytest.mark.parametrize("form", TIMED)
def test_derivatives_of_distances_are_those_of_automatic_differentiation(form):
    t = times(6)
    x, shapes = moving_views(LINEAR, t, n=6, batch=(2,), noise=0.1)
    wide = t[:, None, None].expand(*x.shape[:-1], 1)
    views = torch.cat([x, torch.ones_like(wide), wide], dim=-1)
    views[0, 2, 1, :3] = 0.0
    invariant, motion = DynamicShapeTensor(form=form, points=6), shapes.transpose(1, 2).flatten(2)
    scales = torch.tensor([1.3, 1.8], dtype=torch.float64)
    value, derivative = invariant.linearize((motion,), (views,), (scales,))
    torch.testing.assert_close(value, invariant.whitened_residual((motion,), (views,), (scales,)).flatten(1))
    jacobian = torch.autograd.functional.jacobian(
        lambda m: invariant.whitened_residual((m,), (views,), (scales,)).flatten(1), motion
    )
    expected = torch.stack([jacobian[b, :, b].flatten(1).mT for b in range(2)])
    torch.testing.assert_close(derivative, expected, rtol=1e-6, atol=1e-9)


def test_the_span_has_distances_too():
    t = times(40)
    x, _ = moving_views(LINEAR, t, n=10, noise=0.01)
    solution = fitted(x, t, "span")
    basis = solution.invariant.decompose(solution.tensor)
    full = torch.cat([basis, torch.ones(10, 1).double()], dim=-1)
    left = x - full @ torch.linalg.lstsq(full.expand(40, -1, -1), x).solution
    found = dyn.sampson(solution.invariant, solution.tensor, *x.unbind(-2))
    torch.testing.assert_close(found, left.flatten(1).norm(dim=-1), rtol=1e-6, atol=1e-9)
    assert dyn.sampson(solution.invariant, dyn.refine(solution, *x.unbind(-2)).tensor, *x.unbind(-2)).norm() <= found.norm()
    torch.testing.assert_close(
        solution.invariant.score(solution.tensor, *x.unbind(-2)),
        found.square() / (x - x.mean(-2, keepdim=True)).square().sum((-2, -1)),
    )


@pytest.mark.parametrize("form", FORMS)
def test_missing_points_views_and_times_are_absent(form):
    t = times(40)
    x, _ = moving_views(LINEAR, t, n=9)
    spoilt, when, weights = x.clone(), t.clone(), torch.ones(40).double()
    spoilt[::5, 6] = torch.nan
    spoilt[1] = torch.nan
    spoilt[2], weights[2] = 50.0 * random(9, 2, seed=2), 0.0
    if form != "span":
        spoilt[3], when[3] = 70.0, torch.nan
    else:
        weights[3] = 0.0
    solution = fitted(spoilt, when, form, weights=weights).check()
    assert solution.invariant.score(solution.tensor, *x.unbind(-2)).max() < 1e-9


def test_times_keep_their_digits_where_points_have_fewer_and_those_of_no_weight_have_no_say():
    t = times(20)
    x, _ = moving_views(LINEAR, t, n=8)
    solution = fitted(x.float(), 1.7e9 + t)  # seconds since 1970
    solution = pickle.loads(pickle.dumps(solution))  # it can be stored
    found = solution.invariant.recover(solution.tensor, *x.float().unbind(-2))
    assert found.times.dtype == torch.float64 and found.residual.dtype == torch.float32
    assert (found.times - 1.7e9 - t).abs().max() < 1e-4
    wave = Fourier(1, period=2.0)
    near, far = (fitted(x.float(), t + shift, trajectory=wave, form="basis").tensor for shift in (0, 2e9))
    torch.testing.assert_close(near, far, rtol=0, atol=1e-4)
    weights = torch.ones(20).double()
    weights[2], t[2] = 0.0, 1e9
    assert fitted(x, t, weights=weights).invariant.interval.tolist() == [-1.0, 1.0]


# Projective cameras: exactness, counts, derivatives, what they win near by, statuses.


NEAR = dyn.DynamicShapeTensor(camera="projective")


def scene(n, views, distance, *, seed=0, sigma=0.0):
    """Views ``(views, n, 2)`` of points at constant velocity, each by a turned camera, their times, and shapes ``(2, n, 3)``."""
    g = seeded(seed)
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
    both = solution.tensor.unflatten(-1, (2, 3)).movedim(1, 0), shapes
    flat, true = ((s - s.mean(-2, keepdim=True)).flatten(0, 1) for s in both)
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
    step = 1e-6 * random(*motion.shape)
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
    for step in 1e-5 * random(4, theta.shape[1], seed=1):
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
    t, D = times(10), DynamicShapeTensor
    x, (near, when) = moving_views(LINEAR, t, n=8)[0], exact[:2]
    views = x.unbind(-2)
    assert_refused(
        (lambda: dyn.fit(D, *views), "needs times="),
        (lambda: fitted(x, t[:4]), r"times must be \(\*batch, views\) = \(10,\)"),
        (lambda: fitted(x[:, :4], t), "at least 5 points, got 4"),
        (lambda: D(form="all"), "form must be"),
        (lambda: D(base=(0, 0, 1, 2)), "four different points"),
        (lambda: dyn.fit(D(form="basis", base=(0, 1, 2, 8)), *views, times=t), "four of 8 points"),
        (lambda: D(form="span", points=8).recover(torch.zeros(1, 8), *views), "no shape of any"),
        (lambda: D(2), r"must be dyntorch.Polynomial or dyntorch.Fourier, got 2"),
        (lambda: D(camera="pinhole"), "camera must be 'affine' or 'projective', got 'pinhole'"),
        (lambda: D(form="span", camera="projective"), "take the form 'joint'.*use form='joint'"),
        (lambda: D(dyn.Polynomial(0), camera="projective"), "points that move.*use ShapeTensor"),
        (lambda: dyn.fit(NEAR, *near[:, :5].unbind(1), times=when), "needs at least 6 points, got 5"),
        (lambda: dyn.fit(NEAR, *near[:5].unbind(1), times=when[:5]), "needs at least 6 matches, got 5"),
    )
    assert_refused((lambda: dyn.fit(D, *views, times=t, phase=t), "takes no argument 'phase'"), error=TypeError)
