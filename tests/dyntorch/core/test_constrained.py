"""constrain(): the least algebraic error among the tensors of motions."""

from dataclasses import replace

import pytest
import torch

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.core.matches import matches
from dyntorch.core.outcome import is_failure
from dyntorch.core.refine import constrain_matches
from tests.battery.projections import tensor_error, unit

P4, P6 = dyn.GrassmannTensor(4, (2, 2, 1)), dyn.GrassmannTensor(6, (2, 2, 2, 1))


def scene(motion, times, n, sigma, batch=4, seed=0):
    made = scenes.lifted_points(motion, n, times=times, sigma=sigma, batch=batch, generator=torch.Generator().manual_seed(seed))
    return made.tracks.unbind(-3), made.exact.unbind(-3), tuple(unit(made.projections).unbind(-3))


def energy(solution, tensor, weights=None):
    """Algebraic error of a tensor, row by row, in the coordinates in which the solution is normalized."""
    norm, invariant = solution.normalization, solution.invariant
    moved = norm.apply(invariant, solution.matches.views)
    rows = [p.vectors(x) for p, x in zip(norm.primitives, moved, strict=True)]
    total = rows[0]
    for u in rows[1:]:
        total = (total[..., :, None, :, None] * u[..., None, :, None, :]).flatten(-4, -3).flatten(-2)
    value = (total @ invariant.basis_of(tensor)[:, :1, :, None])[..., 0].square().sum(-1)
    return value.sum(-1) if weights is None else (value * weights).sum(-1)


@pytest.mark.parametrize(
    ("invariant", "views"),
    [
        (P4, scene("constant_velocity_2d", (0, 1, 3), 60, 1.0)[0]),
        (P6, scene("constant_velocity_3d", (0, 2, 4, 7), 80, 0.5)[0]),
        (dyn.GrassmannTensor(5, (2, 2, 2)), scene("constant_velocity_planes_3d", (0, 2, 5), 60, 0.5)[0]),
        (dyn.HomographyTensor(), scenes.planar(80, sigma=1.0, batch=3, generator=torch.Generator().manual_seed(1)).views),
        # the axes of its tensor are in another order than its views
        (dyn.FundamentalMatrix(), scenes.two_view(40, sigma=1.0, batch=3, generator=torch.Generator().manual_seed(1)).views),
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
    draw = torch.Generator().manual_seed(2)
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


def test_exact_tensors_stay():
    for invariant, (_, exact, true) in (
        (P4, scene("constant_velocity_2d", (0, 1, 3), 30, 0.0)),
        (P6, scene("constant_velocity_3d", (0, 2, 4, 7), 60, 0.0)),
    ):
        found = dyn.constrain(dyn.fit(invariant, *exact))
        assert tensor_error(invariant.profile, found.motion, true).max() < 1e-8


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


def test_empty_batch_and_steps():
    views = tuple(torch.zeros(0, 20, 2, dtype=torch.float64) for _ in range(3))
    assert dyn.constrain(dyn.fit(P4, *views)).tensor.shape == (0, 3, 3, 3)
    views, _, _ = scene("constant_velocity_2d", (0, 1, 3), 40, 1.0)
    linear = dyn.fit(P4, *views)
    errors = [energy(linear, dyn.constrain(linear, iterations=steps).normalized) for steps in (0, 1, 30)]
    assert (errors[1] <= errors[0]).all() and (errors[2] <= errors[1]).all() and (errors[2] < errors[0]).all()


def test_tensors_that_do_not_stand_alone():
    data = scenes.moving_points(70, generator=torch.Generator().manual_seed(0)).views
    for invariant in (dyn.JoinTensor, dyn.MinimalJoinTensor):
        solution = dyn.fit(invariant, *data)
        with pytest.raises(ValueError, match="do not stand alone; use refine"):
            dyn.constrain(solution)
