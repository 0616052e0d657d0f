"""All joints of a moving shape at once: descent, starts, missing points, and the time of a single view."""

import math

import pytest
import torch

from dyntorch.shapes.basis import Fourier, Polynomial
from dyntorch.shapes.moving import (
    ShapeDescent,
    canonical,
    canonical_frame,
    centred_views,
    complete,
    cost_of,
    fit_shapes,
    graph_start,
    pooled_start,
    window_start,
)
from dyntorch.shapes.times import recover_times
from tests.draws import random, seeded
from tests.dyntorch.shapes.moving_views import LINEAR, SQUARE, WAVE, draw, moving_views
from tests.grid import assert_refused


def times(count, seed=1, low=-1.0, high=1.0):
    return low + (high - low) * torch.rand(count, generator=seeded(seed), dtype=torch.float64)


def planes(shapes, rows):
    """Projectors ``(views, n, n)`` onto the span of 1 and the shape at each view, by SVD."""
    at = torch.einsum("...vb,...bnk->...vnk", rows, shapes)
    u = torch.linalg.svd(torch.cat([at, torch.ones_like(at[..., :1])], dim=-1), full_matrices=False)[0]
    return u @ u.mT


@pytest.mark.parametrize("basis", [Polynomial(0), Polynomial(1), Polynomial(4), Fourier(0), Fourier(2, period=3.0)])
def test_slopes_are_derivatives_of_rows_and_powers_hold_all_products(basis):
    t = times(40).requires_grad_()
    rows = basis.rows(t)
    assert rows.shape == (40, basis.size)
    for b in range(1, basis.size):
        (slope,) = torch.autograd.grad(rows[:, b].sum(), t, retain_graph=True)
        torch.testing.assert_close(basis.slopes(t)[:, b], slope, rtol=1e-10, atol=1e-12)
    assert not basis.slopes(t)[:, 0].any()
    products = torch.einsum("ti,tj,tk->tijk", rows, rows, rows).flatten(1).detach()
    powers = basis.power(3).rows(t).detach()
    explained = powers @ torch.linalg.lstsq(powers, products).solution
    torch.testing.assert_close(explained, products, rtol=0, atol=1e-9)


def test_times_and_units_are_inverse():
    t, interval = times(7, low=3.0, high=9.0), torch.tensor([3.0, 9.0]).double()
    unit = Polynomial(1).unit(t, interval)
    assert unit.abs().max() <= 1
    torch.testing.assert_close(Polynomial(1).time(unit, interval), t)
    assert not Polynomial(1).unit(torch.full((2,), 5.0), torch.tensor([5.0, 5.0])).any()  # one time alone
    assert float(Fourier(1, period=2.0).time(torch.tensor(-0.5), interval)) == 1.5


def test_normal_equations_are_the_derivatives_of_the_cost():
    t = times(12)
    x, shapes = moving_views(LINEAR, t, n=7, batch=(2,), noise=0.05)
    rows = Polynomial(1).rows(t).expand(2, -1, -1)
    weights = torch.rand(2, 12, 7, generator=seeded(3), dtype=torch.float64)
    weights[0, :3, 0] = 0.0
    views = centred_views(x, weights, 1 + weights[..., 0])
    at = canonical(shapes).requires_grad_()
    (slope,) = torch.autograd.grad(cost_of(views, rows, at).sum(), at)
    cost, gradient, matrix = ShapeDescent(views, rows).normal_equations(at.detach().flatten(1))
    torch.testing.assert_close(cost, cost_of(views, rows, at.detach()))
    torch.testing.assert_close(gradient, slope.flatten(1) / 2)
    # affine frames of the world and translations of each shape change nothing
    frame, shift = at.detach()[0] @ random(3, 3, seed=4), random(2, 1, 3, seed=5).expand(2, 7, 3)
    for move in (frame.flatten(), shift.flatten()):
        assert (matrix[0] @ move).norm() < 1e-10 * matrix[0].norm() * move.norm()


@pytest.mark.parametrize(("functions", "basis"), [(LINEAR, Polynomial(1)), (SQUARE, Polynomial(2)), (WAVE, Fourier(1))])
def test_exact_views_give_the_shapes_and_the_times(functions, basis):
    t = times(45, high=1.0 if basis.period is None else 5.0)
    x, shapes = moving_views(functions, t, n=11)
    rows = basis.rows(t)
    found = fit_shapes(x[:30], rows[:30])
    assert found.residual.max() < 1e-18
    assert not found.underdetermined
    assert not found.degenerate
    torch.testing.assert_close(planes(found.shapes, rows), planes(shapes, rows), atol=1e-7, rtol=0)
    seen = recover_times(found.shapes, basis, x[30:])
    off = (seen.times - t[30:]).abs()
    assert (off if basis.period is None else torch.minimum(off, basis.period - off)).max() < 1e-7
    assert seen.residual.max() < 1e-12


def test_linear_starts_are_exact_for_exact_views():
    t = times(40)
    x, _ = moving_views(LINEAR, t, n=10, batch=(2,))
    rows, views = Polynomial(1).rows(t).expand(2, -1, -1), centred_views(x)
    assert torch.equal(complete(views), views.x)
    for start in (graph_start, pooled_start):
        assert cost_of(views, rows, start(views.x, rows, views.share)).max() < 1e-15
    assert cost_of(views, rows, window_start(views.x, rows, views.share)).max() < 0.3  # of 40
    assert pooled_start(views.x[..., :5, :], rows, views.share) is None  # seven dimensions in five points
    assert graph_start(views.x[:, :5], rows[:, :5], views.share[:, :5]) is None


def test_few_frames_suffice_where_the_conditions_do():
    # 14 points: 69 numbers, 20 conditions per view
    t = times(9)
    x, shapes = moving_views(LINEAR, t, n=14, noise=1e-6)
    rows = Polynomial(1).rows(t)
    five = fit_shapes(x[:5], rows[:5])
    assert not five.underdetermined
    assert (planes(five.shapes, rows) - planes(shapes, rows)).norm(dim=(-2, -1)).max() < 1e-3
    three = fit_shapes(x[:3], rows[:3])
    assert three.underdetermined
    assert not three.shapes.any()
    assert three.uncertainty == torch.inf


def test_noise_is_the_noise_and_no_other_shapes_fit_better():
    t = times(60)
    x, shapes = moving_views(LINEAR, t, n=12, batch=(4,), noise=0.02)
    rows = Polynomial(1).rows(t)
    found = fit_shapes(x, rows)
    # a view of norm 1 has 24 coordinates
    torch.testing.assert_close(found.noise, torch.full((4,), 0.02 / math.sqrt(24)).double(), rtol=0.1, atol=0)
    views, wide = centred_views(x), rows.expand(4, -1, -1)
    assert (cost_of(views, wide, found.shapes) < cost_of(views, wide, shapes)).all()
    views_of_one = centred_views(x[:1])
    near = canonical_frame(found.shapes[:1] + 1e-3 * random(50, *found.shapes.shape[1:], seed=8))
    many = views_of_one.repeat(50)
    assert (cost_of(many, rows.expand(50, -1, -1), near) >= cost_of(views_of_one, wide[:1], found.shapes[:1])).all()
    # uncertainty: the error of the subspaces is of its size
    error = (planes(found.shapes, rows) - planes(shapes, rows)).norm(dim=(-2, -1)).mean(-1)
    assert ((error / found.uncertainty) > 0.1).all()
    assert ((error / found.uncertainty) < 10).all()


def test_one_time_is_accurate_at_one_percent():
    t = times(90)
    x, _ = moving_views(LINEAR, t, n=14, batch=(10,), noise=0.01)
    found = fit_shapes(x[:, :40], Polynomial(1).rows(t[:40]))
    seen = recover_times(found.shapes, Polynomial(1), x[:, 40:])
    off = (seen.times - t[40:]).abs()
    assert off.median() < 0.004  # the prototype with four basis points: 0.005
    ratio = off / (seen.sigma * found.noise[:, None])
    assert 0.4 < ratio.median() < 1.0  # 0.67 for a normal distribution
    assert not seen.ambiguous(found.noise).any()


def test_grid_and_refinement_find_the_global_minimum():
    t = times(8)
    x, shapes = moving_views(SQUARE, t, n=6, noise=0.1)
    basis = Polynomial(2)
    seen = recover_times(shapes, basis, x)
    fine = torch.cat([torch.linspace(-1, 1, 101).double().expand(8, -1), seen.times[:, None]], 1)
    # part of the energy of each view about its centroid that no affine camera explains at those times, by least squares
    across = torch.eye(6).double() - planes(shapes, basis.rows(fine))
    centred = x - x.mean(-2, keepdim=True)
    curve = (across @ centred[:, None]).square().sum((-2, -1)) / centred.square().sum((-2, -1))[:, None]
    torch.testing.assert_close(seen.residual, curve[:, -1], rtol=1e-9, atol=0)
    assert (seen.residual <= curve.amin(1) + 1e-12).all()
    assert (seen.times - fine.gather(1, curve[:, :-1].argmin(1, keepdim=True))[:, 0]).abs().max() < 0.03
    assert (seen.rise >= 0).all()


def test_a_view_that_fits_two_times_is_ambiguous():
    # points that swing back and forth along one line of shapes pass every place twice
    start, way = random(2, 8, 3, seed=1)
    shapes = torch.stack([start, way, torch.zeros_like(way)])  # 1, cos, sin
    x = (start + math.cos(1.0) * way) @ torch.eye(3, 2).double()
    seen = recover_times(shapes, Fourier(1), x[None])
    both = sorted([float(seen.times), float(seen.second)])
    assert math.isclose(both[0], 1.0, abs_tol=1e-6)
    assert math.isclose(both[1], 2 * math.pi - 1.0, abs_tol=1e-6)
    assert seen.ambiguous(0.001).all()


def test_missing_points_and_weights_are_absent():
    t = times(50)
    x, shapes = moving_views(LINEAR, t, n=9, batch=(2,))
    rows = Polynomial(1).rows(t)
    holes = torch.rand(2, 50, 9, generator=seeded(2)) < 0.15
    spoilt = torch.where(holes[..., None], torch.nan, x)
    wrong = torch.where(holes[..., None], 100.0, x)
    found = fit_shapes(spoilt, rows)
    assert found.residual.max() < 1e-12
    wide = rows.expand(2, -1, -1)
    torch.testing.assert_close(planes(found.shapes, wide), planes(shapes, wide), atol=1e-5, rtol=0)
    weighed = fit_shapes(wrong, rows, (~holes).double())
    torch.testing.assert_close(weighed.shapes, found.shapes)
    # a view alone in its error can be left out
    bad, share = x.clone(), torch.ones(2, 50).double()
    bad[:, 4], share[:, 4] = random(9, 2, seed=9), 0.0
    assert fit_shapes(bad, rows, share=share).residual[:, torch.arange(50) != 4].max() < 1e-12
    seen = recover_times(shapes, Polynomial(1), spoilt)
    same = recover_times(shapes, Polynomial(1), wrong, (~holes).double())
    enough = (~holes).sum(-1) > 5
    assert (seen.times - t)[enough].abs().max() < 1e-6
    torch.testing.assert_close(seen.times, same.times)


def test_one_bad_problem_leaves_the_others_as_they_are_and_batch_is_loop():
    t = times(20)
    x, _ = moving_views(LINEAR, t, n=8, batch=(2, 2), noise=0.01)
    rows = Polynomial(1).rows(t)
    x[0, 1] = torch.nan
    x[1, 0] = x[1, 0, :, :1]  # all points in one place
    found = fit_shapes(x, rows)
    assert found.underdetermined.tolist() == [[False, True], [True, False]]
    assert all(part.isfinite().all() for part in (found.shapes, found.noise, found.residual))
    for i, j in ((0, 0), (1, 1)):
        torch.testing.assert_close(fit_shapes(x[i, j], rows).shapes, found.shapes[i, j], rtol=1e-6, atol=1e-8)
    seen = recover_times(found.shapes, Polynomial(1), x)
    assert seen.residual.isfinite().all()
    assert (seen.residual[0, 1] == 1).all()
    assert seen.times.isfinite().all()
    assert fit_shapes(x[:0], rows).shapes.shape == (0, 2, 2, 8, 3)


def test_what_no_view_can_tell_is_said():
    t = times(25)
    _, shapes = moving_views(LINEAR, t, n=8)
    g = torch.Generator().manual_seed(1)
    flat = shapes.clone()
    flat[..., 2] = flat[..., 0]
    still = shapes.clone()
    still[1] = 0.0
    for name in (flat, still):
        x = torch.einsum("vb,bnk,vkd->vnd", Polynomial(1).rows(t), name, draw(25, 3, 2, g=g))
        found = fit_shapes(x, Polynomial(1).rows(t))
        assert found.degenerate
        assert found.uncertainty == torch.inf
        assert found.residual.max() < 1e-12  # and yet it explains them


def test_similarities_of_single_views_change_nothing_and_dtype_is_kept():
    t = times(25)
    x, _ = moving_views(LINEAR, t, n=8, noise=0.02)
    rows, g = Polynomial(1).rows(t), torch.Generator().manual_seed(1)
    turn = torch.linalg.qr(draw(25, 2, 2, g=g))[0] * draw(25, 1, 1, g=g).exp()
    moved = x @ turn + draw(25, 1, 2, g=g)
    first, second = fit_shapes(x, rows), fit_shapes(moved, rows)
    torch.testing.assert_close(first.shapes, second.shapes, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(first.residual, second.residual, rtol=1e-5, atol=1e-9)
    single = fit_shapes(x.float(), rows)
    assert single.shapes.dtype == torch.float32
    torch.testing.assert_close(single.shapes.double(), first.shapes, rtol=1e-3, atol=1e-3)
    assert recover_times(single.shapes, Polynomial(1), x.float()).times.dtype == torch.float32


def test_misuse():
    x, rows, line = torch.rand(9, 6, 2), torch.rand(9, 2), Polynomial(1)
    assert_refused(
        (lambda: fit_shapes(x[..., :4, :], rows), "at least 5 points"),
        (lambda: fit_shapes(x[0], rows), r"\(\*batch, views, n, 2\)"),
        (lambda: fit_shapes(x, rows[1:]), "for 9 views"),
        (lambda: fit_shapes(x, rows, -torch.ones(9, 6)), "must not be negative"),
        (lambda: recover_times(torch.zeros(2, 5, 3), line, x), "expected shapes"),
        (lambda: recover_times(torch.zeros(3, 6, 3), line, x), "2 functions"),
        (lambda: recover_times(torch.zeros(2, 6, 3), line, x, grid=2), "at least 3"),
        (lambda: Polynomial(-1), "must be"),
        (lambda: Fourier(-1), "must be"),
        (lambda: Fourier(1, period=0.0), "must be"),
    )
