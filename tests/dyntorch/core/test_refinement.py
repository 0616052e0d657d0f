"""refine(): covariance against its formula, labelled static matches, weights, blocks; what holds for all is in the battery."""

import pytest
import torch

import dyntorch as dyn
from dyntorch import metrics, scenes
from dyntorch.core import refine as refinement
from tests.battery.cases import CASES
from tests.battery.references import first_order, noisy

COLLINEATION = next(case for case in CASES if repr(case) == "Collineation(2)")


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


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


def test_minimum_is_that_of_another_optimizer():
    case = COLLINEATION
    views = noisy(case, case.scene(15).exact, 0.02)
    refined = dyn.refine(dyn.fit(case.invariant, *views), *views)
    theta = dyn.fit(case.invariant, *views).motion[0].clone().requires_grad_()
    search = torch.optim.LBFGS([theta], max_iter=500, tolerance_grad=1e-13, tolerance_change=1e-16, line_search_fn="strong_wolfe")

    def cost():
        return first_order(case, (theta,), views, (1.0, 1.0)).square().sum()

    def closure():
        search.zero_grad()
        value = 1e3 * cost()
        value.backward()
        return value

    search.step(closure)
    found = first_order(case, refined.motion, views, (1.0, 1.0)).square().sum()
    torch.testing.assert_close(found, cost().detach(), rtol=1e-7, atol=0)
    assert metrics.relative_error(refined.motion[0], theta.detach()) < 1e-4


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


def test_weights_come_from_the_solution_unless_given():
    case = COLLINEATION
    scene = case.scene(30, batch=(3,))
    views = noisy(case, scene.exact, 1e-3)
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


def test_a_weight_is_an_inverse_variance():
    """Half of the matches with twice the noise: weighing them a quarter is better than all alike, and sigma is that of weight 1."""
    case = COLLINEATION
    scene = case.scene(60, batch=(40,))
    fine, coarse = noisy(case, scene.exact, 1e-3, seed=1), noisy(case, scene.exact, 4e-3, seed=2)
    views = tuple(torch.cat([x[:, :30], y[:, 30:]], dim=1) for x, y in zip(fine, coarse, strict=True))
    weights = torch.ones(60).double()
    weights[30:] = 1 / 16
    errors = []
    for w in (None, weights):
        refined = dyn.refine(dyn.fit(case.invariant, *views, weights=w), *views)
        errors.append(metrics.relative_error(refined.motion[0], scene.motion[0]).median())
    assert errors[1] < 0.75 * errors[0]
    assert abs(float(refined.sigma.mean()) / 1e-3 - 1) < 0.05


def test_minimal_matches_leave_no_noise_to_estimate():
    case = COLLINEATION
    views = noisy(case, case.scene(4, batch=(2,)).exact, 1e-3)
    refined = dyn.refine(dyn.fit(case.invariant, *views), *views)
    assert refined.sigma.isinf().all() and refined.covariance.isinf().all()
    assert not refined.covariance.isnan().any() and refined.motion[0].isfinite().all()


def test_no_iterations_change_nothing():
    scene = scenes.planar(50, sigma=0.5, batch=2, generator=seeded())
    solution = dyn.fit(dyn.HomographyTensor, *scene.views)
    same = dyn.refine(solution, *scene.views, iterations=0)
    for a, b in zip(same.motion, solution.motion, strict=True):
        assert metrics.relative_error(a, b).max() < 1e-9
    assert same.sigma.isfinite().all()


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


def test_result_keeps_its_gradientless_place_in_the_chain():
    scene = scenes.planar(40, sigma=0.5, generator=seeded())
    views = [x.requires_grad_() for x in scene.views]
    refined = dyn.refine(dyn.fit(dyn.HomographyTensor, *views), *views)
    assert not refined.covariance.requires_grad and refined.tensor.isfinite().all()
    assert repr(refined).startswith("Solution(HomographyTensor, matches=40, batch=(): 1 OK, sigma ")
    assert refined.check() is refined
