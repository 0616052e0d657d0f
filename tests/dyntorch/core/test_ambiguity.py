"""A tensor that only noise singles out is not called certain, and one that the matches decide is."""

from __future__ import annotations

import pytest
import torch

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.metrics import relative_error
from tests.battery.steps import equal_steps


def fitted(motion: str, **options: int) -> tuple[dyn.Solution, torch.Tensor]:
    scene = scenes.translating_lines(80, batch=6, sigma=0.005, motion=motion, generator=torch.Generator().manual_seed(0), **options)
    solution = dyn.fit(dyn.TranslatingLinesMatrix, *scene.views)
    return solution, relative_error(solution.motion[0], scene.motion[0])


def test_one_rigid_body_is_ambiguous_however_clear_the_gap():
    # rank 20 of 36: the noise lifts 15 null directions by its first order and one by its second, and that one is not the truth
    solution, error = fitted("objects", objects=1)
    values = solution.singular_values
    assert (values[..., -1] < 0.1 * values[..., -2]).all()  # the ratio looks healthy
    assert (error > 0.1).all()  # and the motion is wrong
    assert (solution.status == dyn.Status.AMBIGUOUS).all()


def test_general_motion_is_certain():
    solution, error = fitted("in_plane")
    assert (error < 0.1).all() and (solution.status == dyn.Status.OK).all()


@pytest.mark.parametrize("velocities", ["planar", "linear", "equal"])
@pytest.mark.parametrize("sigma", [1e-4, 1e-2])
def test_velocities_of_lower_dimension_are_ambiguous_at_any_noise(velocities, sigma):
    draw = torch.Generator().manual_seed(1)
    scene = scenes.constant_velocity(60, batch=4, sigma=sigma, velocities=velocities, generator=draw)
    assert (dyn.fit(dyn.ConstantVelocityTensor, *scene.views).status == dyn.Status.AMBIGUOUS).all()


def test_nothing_depends_on_the_global_generator_or_changes_it():
    torch.manual_seed(5)
    first = fitted("objects", objects=1)[0].status
    state = torch.get_rng_state()
    assert torch.equal(first, fitted("objects", objects=1)[0].status) and torch.equal(state, torch.get_rng_state())


def test_very_many_matches_are_judged_by_a_part_of_them():
    scene = scenes.constant_velocity(5000, sigma=1e-3, velocities="planar", generator=torch.Generator().manual_seed(2))
    assert dyn.fit(dyn.ConstantVelocityTensor, *scene.views).status == dyn.Status.AMBIGUOUS


@pytest.mark.parametrize("still", [0.0, 0.1])
def test_equal_steps_leave_a_family_of_cameras(still):
    # at constant velocity all is as straight from a camera that moves along at any velocity: four tensors, not one
    views = equal_steps(80, still=still, generator=torch.Generator().manual_seed(3))
    assert dyn.fit(dyn.HomographyTensor, *views).status == dyn.Status.AMBIGUOUS
    draw = torch.Generator().manual_seed(4)
    assert dyn.robust_fit(dyn.HomographyTensor, *views, threshold=1.5, generator=draw).status == dyn.Status.AMBIGUOUS


@pytest.mark.parametrize("still", [0.0, 0.4, 1.0])
def test_changing_speeds_and_points_that_stand_still_are_certain(still):
    scene = scenes.planar(80, batch=4, sigma=0.5, static=still, generator=torch.Generator().manual_seed(5))
    assert (dyn.fit(dyn.HomographyTensor, *scene.views).status == dyn.Status.OK).all()


@pytest.mark.parametrize(("depth", "shift"), [(0.01, 0.5), (1.0, 1e-3)])
def test_nearly_degenerate_views_are_certain_without_noise_and_not_with_it(depth, shift):
    # exact numbers decide: nearly a plane, or hardly a translation, is not a plane or a rotation
    draw = torch.Generator().manual_seed(6)
    points = torch.randn(40, 3, generator=draw, dtype=torch.float64) * torch.tensor([1.0, 1.0, depth], dtype=torch.float64)
    points = points + torch.tensor([0.0, 0.0, 5.0], dtype=torch.float64)
    angle = torch.tensor(0.1, dtype=torch.float64)
    turn = torch.eye(3, dtype=torch.float64)
    turn[0, 0], turn[0, 2], turn[2, 0], turn[2, 2] = angle.cos(), angle.sin(), -angle.sin(), angle.cos()
    moved = points @ turn.mT + shift * torch.tensor([1.0, 0.3, 0.2], dtype=torch.float64)
    x1, x2 = (800 * x[:, :2] / x[:, 2:] for x in (points, moved))
    exact = dyn.fit(dyn.FundamentalMatrix, x1, x2)
    assert exact.status == dyn.Status.OK and dyn.sampson(dyn.FundamentalMatrix, exact.tensor, x1, x2).abs().max() < 1e-6
    noise = 0.5 * torch.randn(2, 40, 2, generator=draw, dtype=torch.float64)
    assert dyn.fit(dyn.FundamentalMatrix, x1 + noise[0], x2 + noise[1]).status == dyn.Status.AMBIGUOUS
