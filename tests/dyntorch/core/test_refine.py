"""refine() and constrain(): covariance, labels, weights, blocks; least algebraic error among motions; gradients of the minimum."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch import metrics, scenes
from dyntorch.core import refine as refinement
from dyntorch.core.matches import matches
from dyntorch.core.matrix import estimation_matrix
from dyntorch.core.outcome import is_failure
from dyntorch.core.refine import RefineNotice, constrain_matches
from tests.battery.cases import CASES
from tests.battery.projections import unit
from tests.battery.references import noisy
from tests.draws import seeded

COLLINEATION = next(case for case in CASES if repr(case) == "Collineation(2)")


def test_covariance_is_the_formula():
    r""":math:`\sigma^2 (J^T J)^+`, J by finite differences in the coordinates of the matches."""
    case, sigma = COLLINEATION, 1e-3
    views = noisy(case, case.scene(40).exact, sigma)
    refined = dyn.refine(dyn.fit(case.invariant, *views), *views)
    a = refined.motion[0]

    # the whitened vectors: the noise of the difference of the two views
    def residual(theta):
        matrix = theta.reshape(3, 3)
        image = torch.cat([views[1], torch.ones(40, 1).double()], -1) @ matrix.T
        y = image[:, :2] / image[:, 2:]
        jac = (matrix[:2, :2] - y[:, :, None] * matrix[2:, :2]) / image[:, 2:, None]
        covariance = torch.eye(2).double() + jac @ jac.mT
        return torch.linalg.solve_triangular(torch.linalg.cholesky(covariance), (y - views[0])[..., None], upper=False).flatten()

    step, columns = 1e-6, []
    for direction in torch.eye(9).double():
        columns.append((residual(a.flatten() + step * direction) - residual(a.flatten() - step * direction)) / (2 * step))
    jacobian = torch.stack(columns, dim=-1)
    square = residual(a.flatten()).square().sum() / (2 * 40 - 8)
    torch.testing.assert_close(refined.sigma, square.sqrt(), rtol=1e-5, atol=0)
    expected = square * torch.linalg.pinv(jacobian.T @ jacobian, rtol=1e-9)
    torch.testing.assert_close(refined.covariance, expected, rtol=1e-4, atol=1e-5 * float(expected.abs().max()))
    values = torch.linalg.eigvalsh(refined.covariance)
    assert values[0].abs() < 1e-9 * values[-1] and values[1] > 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "scene"),
    [
        (dyn.HomographyTensor, lambda: scenes.planar(60, static=0.4, sigma=0.5, batch=20, generator=seeded())),
        (dyn.JoinTensor, lambda: scenes.moving_points(90, static=0.5, sigma=2e-3, batch=6, generator=seeded())),
        (dyn.MinimalJoinTensor, lambda: scenes.moving_points(80, static=0.5, sigma=2e-3, batch=6, generator=seeded())),
        (dyn.TranslatingLinesMatrix, lambda: scenes.translating_lines(60, static=0.3, sigma=2e-3, batch=10, generator=seeded())),
    ],
)
def test_static_labels_sharpen_the_motion_and_keep_sigma(kind, scene):
    scene = scene()
    static = scene.labels == 1
    plain = dyn.refine(dyn.fit(kind, *scene.views), *scene.views)
    linear = dyn.fit(kind, *scene.views, static=static)
    segmented = dyn.refine(linear, *scene.views)
    errors = [metrics.relative_error(s.motion[0], scene.motion[0]).median() for s in (plain, segmented)]
    assert errors[1] < 0.85 * errors[0]
    assert abs(float(segmented.sigma.mean()) / scene.sigma - 1) < 0.06
    # given to refine alone the labels do the same, and taking them back undoes it
    late = dyn.refine(dyn.fit(kind, *scene.views), *scene.views, static=static)
    assert metrics.relative_error(late.motion[0], segmented.motion[0]).max() < 1e-4
    # static points that may move make a rough landscape, so that the motions of two starts differ below the noise
    without = dyn.refine(linear, *scene.views, static=torch.zeros_like(static))
    assert (without.sigma / plain.sigma - 1).abs().median() < 0.01


def test_weights_are_inverse_variances_that_only_count_by_their_ratios():
    """Half of the matches with four times the noise: weighing them so is better than all alike, and sigma is that of weight 1."""
    case = COLLINEATION
    scene = case.scene(60, batch=(40,))
    fine, coarse = noisy(case, scene.exact, 1e-3, seed=1), noisy(case, scene.exact, 4e-3, seed=2)
    views = tuple(torch.cat([x[:, :30], y[:, 30:]], dim=1) for x, y in zip(fine, coarse, strict=True))
    weights = torch.ones(60).double()
    weights[30:] = 1 / 16
    alike, weighed = (dyn.refine(dyn.fit(case.invariant, *views, weights=w), *views) for w in (None, weights))
    errors = [metrics.relative_error(x.motion[0], scene.motion[0]).median() for x in (alike, weighed)]
    assert errors[1] < 0.75 * errors[0] and abs(float(weighed.sigma.mean()) / 1e-3 - 1) < 0.05
    views = tuple(x[:3, :30].clone() for x in fine)
    views[0][:, :5] += 3.0
    weights = torch.ones(3, 30).double()
    weights[:, :5] = 0
    solution = dyn.fit(case.invariant, *views, weights=weights)
    kept = dyn.refine(solution, *views)
    alone = dyn.refine(dyn.fit(case.invariant, *(x[:, 5:] for x in views)), *(x[:, 5:] for x in views))
    assert metrics.relative_error(kept.motion[0], alone.motion[0]).max() < 1e-6
    torch.testing.assert_close(kept.sigma, alone.sigma, rtol=1e-6, atol=0)
    torch.testing.assert_close(kept.covariance, alone.covariance, rtol=1e-4, atol=1e-12)
    everything = dyn.refine(solution, *views, weights=torch.ones(3, 30).double())
    assert everything.sigma.min() > 10 * kept.sigma.max()
    # only the ratios of the weights count
    for factor in (1e-3, 50.0):
        scaled = dyn.refine(solution, *views, weights=factor * weights)
        torch.testing.assert_close(scaled.sigma, kept.sigma, rtol=1e-6, atol=0)
        torch.testing.assert_close(scaled.covariance, kept.covariance, rtol=1e-4, atol=1e-12)
    case = COLLINEATION
    views = noisy(case, case.scene(4, batch=(2,)).exact, 1e-3)
    refined = dyn.refine(dyn.fit(case.invariant, *views), *views)
    assert refined.sigma.isinf().all() and refined.covariance.isinf().all()
    assert not refined.covariance.isnan().any() and refined.motion[0].isfinite().all()


@pytest.mark.parametrize("name", ["HomographyTensor", "ConstantVelocityTensor(space)", "MinimalJoinTensor"])
def test_blocks_and_pieces_change_nothing(name, monkeypatch):
    case = next(c for c in CASES if repr(c) == name)
    n = 300 if name == "HomographyTensor" else case.minimal + 20
    views = noisy(case, case.scene(n, batch=(3,)).exact, case.noise)
    solution = dyn.fit(case.invariant, *views)
    whole = dyn.refine(solution, *views)
    monkeypatch.setattr(refinement, "BLOCK", 1)
    pieces = dyn.refine(solution, *views)
    assert case.error(pieces.motion, whole.motion).max() < 1e-6
    torch.testing.assert_close(pieces.sigma, whole.sigma, rtol=1e-6, atol=0)


def test_reaches_the_accuracy_of_the_theory():
    """Median over scenes, 100 matches that all move, half a pixel: 0.51 px; noise of the size that there is."""
    scene = scenes.planar(100, sigma=0.5, batch=60, generator=seeded())
    solution = dyn.fit(dyn.HomographyTensor, *scene.views)
    refined = dyn.refine(solution, *scene.views)
    error = [metrics.grid_transfer_error(s.motion[0], scene.motion[0], 640, 480).median() for s in (solution, refined)]
    assert error[1] < 0.9 * error[0] and error[1] < 1.1 * 0.51
    assert abs(float(refined.sigma.median()) / 0.5 - 1) < 0.05


# constrain(): the least algebraic error among the tensors of motions.


P4, P6 = dyn.GrassmannTensor(4, (2, 2, 1)), dyn.GrassmannTensor(6, (2, 2, 2, 1))


def scene(motion, times, n, sigma, batch=4, seed=0):
    made = scenes.lifted_points(motion, n, times=times, sigma=sigma, batch=batch, generator=seeded(seed))
    return made.tracks.unbind(-3), made.exact.unbind(-3), tuple(unit(made.projections).unbind(-3))


def energy(solution, tensor, weights=None):
    """Algebraic error of a tensor, row by row, in the coordinates in which the solution is normalized."""
    norm, invariant = solution.normalization, solution.invariant
    moved = norm.apply(invariant, solution.matches.views)
    weights = torch.ones(moved[0].shape[:2], dtype=torch.float64) if weights is None else weights[None]
    rows = estimation_matrix(norm.primitives, moved, weights)
    return (rows @ invariant.basis_of(tensor)[:, 0, :, None]).square().sum((-2, -1))


@pytest.mark.parametrize(
    ("invariant", "views"),
    [
        (P4, scene("constant_velocity_2d", (0, 1, 3), 60, 1.0)[0]),
        (P6, scene("constant_velocity_3d", (0, 2, 4, 7), 80, 0.5)[0]),
        (dyn.GrassmannTensor(5, (2, 2, 2)), scene("constant_velocity_planes_3d", (0, 2, 5), 60, 0.5)[0]),
        (dyn.HomographyTensor(), scenes.planar(80, sigma=1.0, batch=3, generator=seeded(1)).views),
        # the axes of its tensor are in another order than its views
        (dyn.FundamentalMatrix(), scenes.two_view(40, sigma=1.0, batch=3, generator=seeded(1)).views),
    ],
    ids=["P4", "P6", "P5", "homography", "fundamental"],
)
def test_least_error_of_all_motions(invariant, views):
    linear = dyn.fit(invariant, *views).check()
    found = dyn.constrain(linear)
    assert torch.equal(found.status, linear.status)
    motion = found.normalized_motion()
    torch.testing.assert_close(invariant.compose(*motion), found.normalized)
    assert 1 - (invariant.compose(*found.motion) * found.tensor).flatten(1).sum(-1).abs().min() < 1e-9
    least = energy(linear, found.normalized)
    # more than the linear tensor, less than what that decomposes into, and nothing nearby is better
    parts = invariant.normalize(linear.normalization.transforms).decompose(linear.normalized)
    if type(invariant).constrain is dyn.Invariant.constrain:  # else the fit has left the null vector already
        assert (energy(linear, linear.normalized) <= least).all()
    assert (least <= energy(linear, invariant.compose(*parts)) * (1 + 1e-9)).all()
    draw = seeded(2)
    for size in (1e-2, 1e-3, 1e-4):
        for _ in range(5):
            other = tuple(m + size * torch.randn(m.shape, generator=draw, dtype=m.dtype) * m.norm() / m.numel() for m in motion)
            assert (energy(linear, invariant.compose(*other)) >= least * (1 - 1e-6)).all()
    again = dyn.constrain(found)
    assert 1 - (again.tensor * found.tensor).flatten(1).sum(-1).abs().min() < 1e-8


@pytest.mark.slow
def test_p6_needs_it():
    """Half a pixel of noise: the constrained motion shows the images better than what the linear tensor decomposes into."""
    views, _, true = scene("constant_velocity_3d", (0, 1, 2, 3), 60, 0.5, batch=8)
    linear = dyn.fit(P6, *views)
    found, refined = dyn.constrain(linear), dyn.refine(linear, *views)
    ones = (torch.ones((), dtype=torch.float64),) * 4
    off = [
        P6.whitened_residual(motion, views, ones).square().mean((-2, -1)).sqrt()
        for motion in (linear.motion, found.motion, refined.motion)
    ]
    assert off[1].median() < 0.6 * off[0].median() and (off[2] < off[1]).all()
    # refinement begins with it: the error is that of a start from the truth
    known = replace(linear, refined=tuple(f @ m for f, m in zip(linear.normalization.transforms, true, strict=True)))
    assert (refined.sigma < 1.001 * dyn.refine(known, *views).sigma).double().mean() >= 0.85


def test_batch_is_loop_and_failed_problems_stay():
    views, _, _ = scene("constant_velocity_2d", (0, 1, 3), 40, 0.5, batch=(2, 2))
    views = [x.clone() for x in views]
    for x in views:
        x[0, 1] = x[0, 1, :1]
    views[1][1, 1, ::2] = torch.nan
    weights = torch.ones(2, 2, 40, dtype=torch.float64)
    weights[1, 0, :20] = 3.0
    linear = dyn.fit(P4, *views, weights=weights)
    whole = dyn.constrain(linear)
    assert is_failure(whole.status).tolist() == [[False, True], [False, False]]
    assert whole.tensor[0, 1].abs().max() == 0 and all(m.isfinite().all() for m in (whole.tensor, *whole.motion))
    for i, j in ((0, 0), (1, 0), (1, 1)):
        alone = dyn.constrain(dyn.fit(P4, *(x[i, j] for x in views), weights=weights[i, j]))
        assert 1 - (alone.tensor * whole.tensor[i, j]).sum().abs() < 1e-9
        assert 1 - (linear.tensor[i, j] * whole.tensor[i, j]).sum().abs() > 1e-9
    single = dyn.constrain(dyn.fit(P4, *(x[0, 0].float() for x in views)))
    assert single.tensor.dtype == torch.float32 and all(m.dtype == torch.float32 for m in single.motion)


def test_other_weights_of_the_same_matches():
    views, _, _ = scene("constant_velocity_2d", (0, 1, 3), 40, 0.5, batch=())
    linear = dyn.fit(P4, *views)
    keep = (torch.arange(40) < 25).double()
    found = constrain_matches(linear, matches(P4, views, keep))
    expected = dyn.constrain(dyn.fit(P4, *views, weights=keep))
    # another normalization weighs the rows a little differently
    assert 1 - (found.tensor * expected.tensor).sum().abs() < 1e-3
    plain = dyn.constrain(linear)
    values = [energy(linear, s.normalized, keep) for s in (found, plain)]
    assert values[0] < values[1]


def test_empty_batch_steps_and_tensors_that_do_not_stand_alone():
    views = tuple(torch.zeros(0, 20, 2, dtype=torch.float64) for _ in range(3))
    assert dyn.constrain(dyn.fit(P4, *views)).tensor.shape == (0, 3, 3, 3)
    views, _, _ = scene("constant_velocity_2d", (0, 1, 3), 40, 1.0)
    linear = dyn.fit(P4, *views)
    errors = [energy(linear, dyn.constrain(linear, iterations=steps).normalized) for steps in (0, 1, 30)]
    assert (errors[1] <= errors[0]).all() and (errors[2] <= errors[1]).all() and (errors[2] < errors[0]).all()
    data = scenes.moving_points(70, generator=seeded(0)).views
    for invariant in (dyn.JoinTensor, dyn.MinimalJoinTensor):
        with pytest.raises(ValueError, match="do not stand alone; use refine"):
            dyn.constrain(dyn.fit(invariant, *data))


# Gradients: every order, weights, labels, inliers, problems that failed, descents that ended early.


H = dyn.HomographyTensor


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
def test_derivatives_of_the_minimum_are_those_of_a_brute_force_descent():
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
    same = dyn.refine(solution, *views, iterations=0)
    assert all(metrics.relative_error(a, b).max() < 1e-9 for a, b in zip(same.motion, solution.motion, strict=True))
    for x in views:
        x.requires_grad_()
    early = dyn.refine(solution, *views, iterations=1).notices
    assert [(notice.code, notice.problem) for notice in early] == [(RefineNotice.UNFINISHED, (0,)), (RefineNotice.UNFINISHED, (1,))]
    assert "raise iterations" in str(early[0]) and early[0].value > 1e-6
    assert dyn.refine(solution, *views).notices == ()
    with torch.no_grad():
        assert dyn.refine(solution, *views, iterations=1).notices == ()
    exact = tuple(x.requires_grad_() for x in scenes.planar(40, generator=seeded()).views)
    found = dyn.refine(dyn.fit(H, *exact), *exact)
    assert found.notices == ()
    for one in torch.autograd.grad(found.tensor.sin().sum(), exact):
        assert one.isfinite().all() and one.abs().max() > 0
