"""Derivatives along tangents: closed forms, torch's own dual numbers, many threads at once, and nothing heavy imported."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

import dyntorch as dyn
from dyntorch.core.invariant import Invariant
from dyntorch.invariants.constant_velocity_tensor import inverses
from dyntorch.numerics.least_squares import by_match, derivatives, jacobian, normalized_derivative

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


def test_the_homography_tensor_by_hand_is_that_of_the_automatic_derivative():
    motion = tuple(THETA[:, :18].unflatten(-1, (2, 3, 3)).unbind(1))
    by_hand, automatic = (
        dyn.HomographyTensor().compose_derivative(motion),
        Invariant.compose_derivative(dyn.HomographyTensor(), motion),
    )
    for found, expected in zip(by_hand, automatic, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-13)
    nothing = dyn.HomographyTensor().compose_derivative((torch.zeros(1, 3, 3), torch.zeros(1, 3, 3)))
    assert all(part.isfinite().all() for part in nothing)


def test_closed_forms():
    theta = torch.tensor([[2.0, 3.0], [-1.0, 5.0]], dtype=torch.float64)
    value, slope = jacobian(cubes, theta)
    torch.testing.assert_close(value, torch.tensor([[8.0, 6.0], [-1.0, -5.0]], dtype=torch.float64))
    expected = torch.tensor([[[12.0, 3.0], [0.0, 2.0]], [[3.0, 5.0], [0.0, -1.0]]], dtype=torch.float64)
    torch.testing.assert_close(slope, expected)
    tangent = torch.tensor([[1.0, -2.0], [0.5, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(derivatives(cubes, theta, tangent[None])[1][:, 0], (tangent[:, None] @ expected)[:, 0])


@pytest.mark.parametrize("batch", [0, 1, 3])
def test_empty_batches_and_functions_without_values(batch):
    theta = torch.ones(batch, 2, dtype=torch.float64)
    assert jacobian(cubes, theta)[1].shape == (batch, 2, 2)
    value, slope = jacobian(lambda t: t[..., :0], theta)
    assert value.shape == (batch, 0) and slope.shape == (batch, 2, 0)


def test_a_function_that_does_not_depend_on_the_parameters():
    assert jacobian(lambda t: torch.ones(*t.shape[:-1], 5, dtype=t.dtype), THETA)[1].abs().max() == 0


def test_lengths_that_are_zero_have_finite_derivatives():
    value, slope = normalized_derivative(torch.zeros(2, 3), torch.ones(2, 4, 3))
    assert (value == 0).all() and slope.isfinite().all()


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
