"""The damped step against the equations it solves."""

from __future__ import annotations

import torch

from dyntorch.numerics.least_squares import damped_step


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
