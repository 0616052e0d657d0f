"""The damped step against the equations it solves, and the descent by such steps."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch

from dyntorch.numerics.least_squares import Iterate, LeastSquares, LeastSquaresOptions, damped_step, minimize


def problem(b=3, p=5):
    g = torch.Generator().manual_seed(0)
    root = torch.randn(b, p, 2 * p, generator=g, dtype=torch.float64)
    return torch.randn(b, p, generator=g, dtype=torch.float64), root @ root.mT, torch.tensor([1e-6, 1e-2, 10.0]).double()


def test_it_solves_the_damped_equations():
    gradient, matrix, damping = problem()
    expected = [torch.linalg.solve(h + m * torch.diag(h.diagonal()), g) for g, h, m in zip(gradient, matrix, damping, strict=True)]
    torch.testing.assert_close(damped_step(gradient, matrix, damping), torch.stack(expected), rtol=1e-6, atol=1e-9)


def test_what_stays_does_not_move_and_is_not_felt_by_the_rest():
    gradient, matrix, damping = problem()
    free = torch.tensor([1.0, 0, 1, 1, 0]).double()
    kept = free.bool()
    step = damped_step(gradient, matrix, damping, free)
    assert (step[:, ~kept] == 0).all()
    alone = damped_step(gradient[:, kept], matrix[:, kept][:, :, kept], damping)
    torch.testing.assert_close(step[:, kept], alone)


def test_an_open_direction_and_a_broken_problem_stay_finite():
    gradient, matrix, damping = problem()
    matrix[0], gradient[0] = 0.0, 0.0
    matrix[1] = torch.nan
    step = damped_step(gradient, matrix, damping)
    assert step.isfinite().all() and (step[:2] == 0).all() and (step[2] != 0).all()


@dataclass(frozen=True)
class Circles(LeastSquares):
    """Circles ``(x, y, r)`` of least squared distances from points ``(b, n, 2)``."""

    points: torch.Tensor

    def subset(self, keep):
        return Circles(self.points[keep])

    def evaluate(self, theta):
        away = self.points - theta[0][:, None, :2]
        distance = away.norm(dim=-1)
        value = distance - theta[0][:, 2:]
        slope = torch.cat([-away / distance[..., None], -torch.ones_like(value)[..., None]], dim=-1)
        return Iterate(theta, value.square().sum(-1), (slope.mT @ value[..., None], slope.mT @ slope))

    def step(self, at, damping):
        return (damped_step(at.terms[0][..., 0], at.terms[1], damping),)


def circles(b=6, n=20):
    g = torch.Generator().manual_seed(1)
    angle = 6 * torch.rand(b, n, generator=g, dtype=torch.float64)
    points = torch.stack([angle.cos(), angle.sin()], dim=-1) + 0.02 * torch.randn(b, n, 2, generator=g, dtype=torch.float64)
    return Circles(points), (0.1 + torch.rand(b, 3, generator=g, dtype=torch.float64),)


def test_problems_end_in_a_minimum_that_their_neighbours_do_not_move():
    problem, theta = circles()
    options = LeastSquaresOptions(iterations=60, tolerance=1e-14)
    found = minimize(problem, problem.evaluate(theta), options)
    assert (found.terms[0].abs() < 1e-6).all() and len(found.steps.unique()) > 1 and (found.steps < 60).all()
    for k in range(6):
        one = torch.tensor([k])
        alone = minimize(problem.subset(one), problem.subset(one).evaluate((theta[0][one],)), options)
        torch.testing.assert_close(alone.theta[0][0], found.theta[0][k], rtol=1e-9, atol=1e-9)
        assert int(alone.steps[0]) == int(found.steps[k])
    assert len(minimize(problem.subset(one[:0]), problem.evaluate(theta).subset(one[:0]), options).cost) == 0


@pytest.mark.parametrize("tolerance", [None, 1e-9])
def test_the_cost_never_rises_and_what_is_not_finite_stays(tolerance):
    problem, theta = circles()
    theta[0][2] = torch.nan
    start = problem.evaluate(theta)
    found = minimize(problem, start, LeastSquaresOptions(iterations=3, tolerance=tolerance))
    good = torch.arange(6) != 2
    assert (found.cost[good] < start.cost[good]).all()
    assert found.theta[0][2].isnan().all() and int(found.steps[0]) <= 3
    assert tolerance is None or int(found.steps[2]) == 0
    again = minimize(problem, start, LeastSquaresOptions(iterations=0, tolerance=tolerance))
    torch.testing.assert_close(again.theta, start.theta, equal_nan=True)


def test_a_ridge_holds_what_the_equations_leave_open():
    gradient, matrix, damping = problem()
    expected = torch.linalg.solve(matrix[0] + 0.1 * matrix[0].diagonal().max() * torch.eye(5), gradient[0])
    torch.testing.assert_close(damped_step(gradient, matrix, 0 * damping, ridge=0.1)[0], expected)
