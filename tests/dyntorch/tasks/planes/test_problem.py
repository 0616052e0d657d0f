"""The least squares problem of translating planes: derivatives, scales that change nothing, and where a fit starts."""

from __future__ import annotations

import pytest
import torch

from dyntorch import scenes
from dyntorch.geometry.extensors import project
from dyntorch.geometry.homogeneous import apply, unit
from dyntorch.tasks.planes.input import GivenPlanes
from dyntorch.tasks.planes.problem import (
    Layout,
    Matrices,
    PlaneMatches,
    PlanesProblem,
    frames_of_calibration,
    frames_of_matrices,
    noise_variance,
    parameters,
    project_covariance,
)
from tests.draws import seeded

F64 = torch.float64
LAYOUT = Layout(3, 2)


def given(sigma=0.5, seed=0):
    scene = scenes.translating_planes(3, 2, n=9, batch=2, sigma=sigma, generator=seeded(seed))
    found = GivenPlanes.of(scene.homographies, scene.body_fundamentals, (scene.x1, scene.x2), (scene.body_x1, scene.body_x2), None)
    infinity = unit(found.frames[1] @ scene.infinity @ torch.linalg.inv(found.frames[0]))
    return scene, found, parameters(found.homographies, found.fundamentals, infinity)


def problems(found):
    scales = found.frames[0][:, 0, 0], found.frames[1][:, 0, 0]
    matches = PlaneMatches(found.planes.views, found.planes.weights, found.bodies.views, found.bodies.weights, scales)
    weights = torch.tensor([1.0, 2.0, 3.0, 4.0, 5.0], dtype=F64)
    matrices = Matrices(torch.cat([found.homographies, found.fundamentals], dim=1), weights.expand(2, -1))
    return {"matches": PlanesProblem(LAYOUT, matches), "matrices": PlanesProblem(LAYOUT, matrices)}


@pytest.mark.parametrize("kind", ["matches", "matrices"])
def test_gradient_is_half_the_derivative_of_the_cost_which_no_scale_of_a_part_changes(kind):
    _, found, theta = given()
    theta = theta + 0.01 * torch.randn(theta.shape, generator=seeded(1), dtype=F64)
    problem = problems(found)[kind]
    cost, gradient, matrix = problem.normal_equations(theta)
    for k in range(0, LAYOUT.size, 3):
        step = torch.zeros_like(theta)
        step[:, k] = 1e-6
        slope = (problem.normal_equations(theta + step)[0] - problem.normal_equations(theta - step)[0]) / 2e-6
        assert torch.allclose(slope, 2 * gradient[:, k], rtol=1e-4, atol=1e-6 * float(cost.max()))
    scaled = torch.cat([part * factor for part, factor in zip(problem.parts(theta), (-2.0, 3.0, 0.5, -1.0), strict=True)], dim=-1)
    assert torch.allclose(problem.normal_equations(scaled)[0], cost)
    assert torch.allclose(matrix, matrix.mT) and bool((torch.linalg.eigvalsh(matrix) > -1e-9 * matrix.abs().amax()).all())


def test_the_truth_has_no_residual():
    _, found, theta = given(sigma=0.0)
    for problem in problems(found).values():
        assert bool((problem.normal_equations(theta)[0] < 1e-14).all())
        assert torch.allclose(
            problem.subset(torch.tensor([1])).normal_equations(theta[1:])[1], problem.normal_equations(theta)[1][1:]
        )
        twice = problem.repeat(2).normal_equations(torch.cat([theta, theta]))[0]
        assert twice.shape == (4,)


def test_the_cost_of_matches_is_the_least_correction_in_pixels():
    scene, found, theta = given(sigma=0.1)
    models = LAYOUT.models(theta)[:, :3]
    cost = problems(found)["matches"].evidence.normal(LAYOUT.models(theta)).cost[:, :3]
    back = torch.linalg.inv(found.frames[1])[:, None] @ models @ found.frames[0][:, None]
    # by brute force: the exact match nearest to each, by Gauss-Newton from the measured point
    point, eye = scene.x1.clone(), torch.eye(2, dtype=F64)
    for _ in range(10):
        image, slope = project(back, point)
        rows = torch.cat([eye.expand_as(slope), slope], dim=-2)
        error = torch.cat([point - scene.x1, image - scene.x2], dim=-1)
        point = point - torch.linalg.lstsq(rows, error[..., None]).solution[..., 0]
    least = ((point - scene.x1).square() + (apply(back, point) - scene.x2).square()).sum((-2, -1))
    assert torch.allclose(cost, least, rtol=1e-2)


def test_projected_is_the_covariance_of_unit_vectors():
    vector = torch.randn(5, generator=seeded(2), dtype=F64)
    root = 1e-4 * torch.randn(5, 5, generator=seeded(3), dtype=F64)
    samples = vector + torch.randn(200_000, 5, generator=seeded(4), dtype=F64) @ root.mT
    measured = torch.cov(torch.nn.functional.normalize(samples, dim=-1).mT)
    assert torch.allclose(project_covariance(root @ root.mT, vector), measured, atol=0.02 * float(measured.abs().max()))


@pytest.mark.parametrize("focal", [300.0, 1000.0, 4000.0])
@pytest.mark.parametrize("centre", [(0.0, 0.0), (0.5, 0.4)])
def test_frames_find_the_size_of_the_image(focal, centre):
    scene = scenes.translating_planes(6, batch=4, generator=seeded(5))
    old = torch.linalg.inv(scene.calibration)
    new = torch.tensor([[focal, 0, centre[0] * focal], [0, focal, centre[1] * focal], [0, 0, 1]], dtype=F64)
    change = new @ old
    H = change @ scene.homographies @ torch.linalg.inv(change)
    first, second = frames_of_matrices(H, H[:, :0])
    wanted = frames_of_calibration((new.expand(4, 3, 3), new.expand(4, 3, 3)))
    assert torch.equal(first, second)
    ratio = first[:, 0, 0] / wanted[0][:, 0, 0]
    assert bool(((ratio > 0.5) & (ratio < 2.0)).all())


def test_frames_of_affine_and_equal_homographies_are_finite():
    shift = torch.eye(3, dtype=F64).repeat(1, 4, 1, 1)
    shift[..., 0, 2] = torch.tensor([10.0, 20.0, 30.0, 40.0])
    for H in (shift, torch.eye(3, dtype=F64).expand(1, 4, 3, 3), torch.zeros(1, 4, 3, 3, dtype=F64)):
        assert all(bool(frame.isfinite().all()) for frame in frames_of_matrices(H, H[:, :0]))


@pytest.mark.parametrize("spare", [1, 4, 16, 200])
def test_the_noise_is_underestimated_one_time_in_ten(spare):
    cost = torch.randn(40000, spare, generator=seeded(24), dtype=torch.float64).square().sum(-1)
    found = noise_variance(cost, torch.tensor(float(spare), dtype=torch.float64), risk=0.1)
    assert float((found < 1).double().mean()) == pytest.approx(0.1, abs=0.01)
    assert noise_variance(cost[:1], torch.zeros(1, dtype=torch.float64), risk=0.1).tolist() == [0.0]
