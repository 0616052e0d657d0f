"""Descents by damped steps against the equations they solve; derivatives along tangents against dual numbers and closed forms."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import pytest
import torch

import dyntorch as dyn
from dyntorch.core.invariant import Invariant
from dyntorch.invariants.constant_velocity_tensor import inverses
from dyntorch.numerics.least_squares import (
    Iterate,
    LeastSquares,
    LeastSquaresOptions,
    by_match,
    damped_step,
    derivatives,
    jacobian,
    minimize,
    normalized_derivative,
)
from tests.draws import random


def problem(b=3, p=5):
    g = torch.Generator().manual_seed(0)
    root = torch.randn(b, p, 2 * p, generator=g, dtype=torch.float64)
    return torch.randn(b, p, generator=g, dtype=torch.float64), root @ root.mT, torch.tensor([1e-6, 1e-2, 10.0]).double()


def test_the_damped_equations_are_solved_whatever_stays_or_is_open():
    gradient, matrix, damping = problem()
    expected = [torch.linalg.solve(h + m * torch.diag(h.diagonal()), g) for g, h, m in zip(gradient, matrix, damping, strict=True)]
    torch.testing.assert_close(damped_step(gradient, matrix, damping), torch.stack(expected), rtol=1e-6, atol=1e-9)
    # a ridge holds what the equations leave open
    expected = torch.linalg.solve(matrix[0] + 0.1 * matrix[0].diagonal().max() * torch.eye(5), gradient[0])
    torch.testing.assert_close(damped_step(gradient, matrix, 0 * damping, ridge=0.1)[0], expected)
    free = torch.tensor([1.0, 0, 1, 1, 0]).double()
    kept = free.bool()
    step = damped_step(gradient, matrix, damping, free)
    assert (step[:, ~kept] == 0).all()
    alone = damped_step(gradient[:, kept], matrix[:, kept][:, :, kept], damping)
    torch.testing.assert_close(step[:, kept], alone)
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
    none = problem.subset(one[:0])
    assert len(minimize(none, none.evaluate((theta[0][:0],)), options).cost) == 0


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


# Derivatives along tangents: closed forms, dual numbers, many threads at once, and nothing heavy imported.


THETA = torch.randn(3, 48, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


def cubes(theta):
    return torch.stack([theta[..., 0] ** 3, theta[..., 0] * theta[..., 1]], dim=-1)


def by_dual_numbers(function, theta):
    eye = torch.eye(theta.shape[-1], dtype=theta.dtype)[:, None].expand(-1, len(theta), -1)
    values, slopes = torch.func.vmap(lambda v: torch.func.jvp(function, (theta,), (v,)))(eye)
    return values[0], slopes.transpose(0, 1)


def composed(invariant, *shapes):
    def tensor(theta):
        sizes = [torch.Size(shape).numel() for shape in shapes]
        parts = theta[..., : sum(sizes)].split(sizes, -1)
        made = invariant.compose(*(part.unflatten(-1, shape) for part, shape in zip(parts, shapes, strict=True)))
        return made.flatten(theta.ndim - 1)

    return tensor


FUNCTIONS = {
    "fewer values": cubes,
    "more values": lambda t: torch.cat([t.sin(), t.square()], dim=-1),
    "HomographyTensor": composed(dyn.HomographyTensor, (3, 3), (3, 3)),
    "JoinTensor": composed(dyn.JoinTensor, (4, 4), (4, 4)),
    "MinimalJoinTensor": composed(dyn.MinimalJoinTensor, (4, 4), (4, 4)),
    "ConstantVelocityTensor": composed(dyn.ConstantVelocityTensor, (4, 4), (4, 4), (4, 4)),
    "TranslatingLinesMatrix": composed(dyn.TranslatingLinesMatrix, (4, 4)),
    "FundamentalMatrix": composed(dyn.FundamentalMatrix, (3, 3), (3,)),
    "inverses": lambda t: torch.cat([m.flatten(-2) for m in inverses(tuple(t.unflatten(-1, (3, 4, 4)).unbind(-3)))], -1),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_the_same_as_dual_numbers(name):
    value, slope = jacobian(FUNCTIONS[name], THETA)
    expected, expected_slope = by_dual_numbers(FUNCTIONS[name], THETA)
    torch.testing.assert_close(value, expected, rtol=1e-12, atol=1e-12 * float(expected.abs().max()))
    torch.testing.assert_close(slope, expected_slope, rtol=1e-12, atol=1e-12 * float(expected_slope.abs().max()))
    tangent = THETA.cos()
    along = derivatives(FUNCTIONS[name], THETA, tangent[None])[1][:, 0]
    torch.testing.assert_close(along, (tangent[:, None] @ slope)[:, 0], atol=1e-11 * float(slope.abs().max()), rtol=1e-9)


@pytest.mark.parametrize(
    "invariant", [dyn.HomographyTensor(), dyn.FundamentalMatrix(), dyn.Collineation(2), dyn.Collineation(3)], ids=repr
)
def test_tensors_by_hand_have_the_automatic_derivative(invariant):
    sizes = [tuple(invariant.primitives[v].dim + 1 for v in (f.target, f.source) if v is not None) for f in invariant.motion]
    motion = tuple(random(3, *size, seed=k) for k, size in enumerate(sizes))
    by_hand, automatic = invariant.compose_derivative(motion), Invariant.compose_derivative(invariant, motion)
    for found, expected in zip(by_hand, automatic, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-13)


def test_a_tensor_of_nothing_has_a_finite_derivative():
    nothing = dyn.HomographyTensor().compose_derivative((torch.zeros(1, 3, 3), torch.zeros(1, 3, 3)))
    assert all(part.isfinite().all() for part in nothing)
    value, slope = normalized_derivative(torch.zeros(2, 3), torch.ones(2, 4, 3))  # a length of zero
    assert (value == 0).all() and slope.isfinite().all()


@pytest.mark.parametrize("batch", [0, 1, 3])
def test_empty_batches_and_functions_without_values(batch):
    theta = torch.ones(batch, 2, dtype=torch.float64)
    assert jacobian(cubes, theta)[1].shape == (batch, 2, 2)
    value, slope = jacobian(lambda t: t[..., :0], theta)
    assert value.shape == (batch, 0) and slope.shape == (batch, 2, 0)
    assert not jacobian(lambda t: torch.ones(*t.shape[:-1], 5, dtype=t.dtype), theta)[1].any()  # nor of the parameters


@pytest.mark.parametrize("mode", [torch.no_grad, torch.enable_grad, torch.inference_mode])
def test_any_mode_of_differentiation(mode):
    expected = jacobian(torch.sin, THETA)[1]
    with mode():
        torch.testing.assert_close(jacobian(torch.sin, THETA.clone())[1], expected, rtol=0, atol=0)


def test_values_of_matches():
    draw = torch.Generator().manual_seed(1)
    scales, x = torch.rand(3, dtype=torch.float64, generator=draw), torch.rand(3, 7, 4, dtype=torch.float64, generator=draw)

    def residual(theta, problems, matches):
        image = (theta.unflatten(-1, (12, 4)) @ matches[0].mT).mT * problems[0][..., None, None]
        return image[..., :2] / (3 + image[..., 2:3].square())

    value, slope = by_match(residual, THETA, (scales,), (x,))
    whole = by_dual_numbers(lambda t: residual(t, (scales,), (x,)).flatten(1), THETA)
    for found, expected in zip((value, slope), whole, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-13)
    with torch.inference_mode():
        views = x * 1  # made here
        torch.testing.assert_close(by_match(residual, THETA * 1, (scales * 1,), (views,))[1], slope, rtol=0, atol=0)
    assert by_match(residual, THETA, (scales,), (x[:, :0],))[1].shape == (3, 48, 0)


def test_threads_do_not_disturb_each_other():
    """Dual numbers have one level for the whole process; reverse mode has none."""
    theta = torch.rand(50, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))

    def run(_):
        return jacobian(lambda t: t.sin().cumsum(-1).exp(), theta)[1]

    expected = run(0)
    with ThreadPoolExecutor(8) as pool:
        assert all(torch.equal(found, expected) for found in pool.map(run, range(200)))


CALLS = {
    "reconstruct": "s = scenes.lifted_points('constant_velocity_2d', 40, views=4, sigma=0.5, generator=g); "
    "dyn.reconstruct(s.tracks, motion='constant_velocity_2d')",
    "align_planar": "dyn.align_planar(*scenes.planar(n=60, sigma=0.5, static=0.5, generator=g).views, generator=g)",
    "align_lines": "dyn.align_lines(*scenes.translating_lines(60, sigma=0.002, generator=g).views, threshold=0.006)",
    "translating_planes": "dyn.translating_planes(x1=planes.x1, x2=planes.x2)",
}


@pytest.mark.slow
@pytest.mark.parametrize("verb", CALLS)
def test_first_answers_do_not_wait_for_torchs_compiler(verb):
    """Importing it takes longer than any of these verbs."""
    code = (
        "import sys, torch, dyntorch as dyn; from dyntorch import scenes; g = torch.Generator().manual_seed(0); "
        f"planes = scenes.translating_planes(6, sigma=0.5, generator=g); {CALLS[verb]}; "
        "print(*sorted({'torch._dynamo', 'sympy', 'torch._inductor', 'torch._decomp.decompositions_for_jvp'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
