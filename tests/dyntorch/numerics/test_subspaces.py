"""Subspaces: bases, canonical correlations, factorization of affine views and its metric upgrade."""

from __future__ import annotations

import math

import pytest
import torch

from dyntorch.numerics import affine_factorization, canonical_correlation, metric_upgrade, orthonormal_basis
from tests.draws import random
from tests.grid import assert_refused, grid


def exact_basis(matrix):
    return torch.linalg.qr(matrix).Q


def affine_views(seed, count=2, points=40):
    """``(count, points, 2)`` centred images of one random 3D shape in random affine cameras."""
    shape = random(points, 3, seed=seed)
    return (shape - shape.mean(0)) @ random(count, 3, 2, seed=seed + 1000)


@grid(("columns", [1, 2, 3]), ("batch", [(), (5,), (2, 3)]))
def test_basis_spans_the_columns(batch, columns):
    matrix = random(*batch, 30, columns, seed=columns)
    basis = orthonormal_basis(matrix)
    assert basis.shape == matrix.shape
    q = exact_basis(matrix)
    torch.testing.assert_close(basis @ basis.mT, q @ q.mT, atol=1e-4, rtol=0)
    torch.testing.assert_close(basis.mT @ basis, torch.eye(columns, dtype=torch.float64).expand(*batch, -1, -1), atol=1e-4, rtol=0)
    # the column space itself is exact: nothing of the basis lies outside of it
    torch.testing.assert_close(q @ (q.mT @ basis), basis, atol=1e-12, rtol=0)


@grid(("unit", [1e-9, 1e-3, 0.0, 1e6]), ("dtype", [torch.float32, torch.float64]))
def test_basis_does_not_depend_on_the_unit_and_is_zero_of_zeros(unit, dtype):
    matrix = random(6, 24, 2, seed=4).to(dtype)
    basis = orthonormal_basis(matrix * unit)
    assert basis.dtype == dtype
    torch.testing.assert_close(basis, orthonormal_basis(matrix) * float(unit > 0), atol=1e-5, rtol=1e-4)


def test_a_flat_direction_is_short_and_the_basis_differentiable():
    line = random(12, 1, seed=5)
    basis = orthonormal_basis(torch.cat([line, 2 * line], dim=1))
    unit = line / line.norm()
    torch.testing.assert_close(unit @ (unit.mT @ basis), basis, atol=1e-9, rtol=0)
    assert basis.norm(dim=0).max() <= 1 + 1e-9
    matrix = random(6, 2, seed=8).requires_grad_()
    fixed = random(6, 6, seed=9)
    assert torch.autograd.gradcheck(lambda x: (fixed @ orthonormal_basis(x) @ orthonormal_basis(x).mT).diagonal().sum(), (matrix,))


@pytest.mark.parametrize("bad", [math.nan, math.inf, 0.0])
def test_one_bad_matrix_leaves_the_others_alone(bad):
    matrices, keep = random(4, 15, 2, seed=6), [0, 2, 3]
    broken = matrices.clone()
    broken[1] = bad
    assert torch.equal(orthonormal_basis(broken)[keep], orthonormal_basis(matrices)[keep])
    first, second = exact_basis(matrices), exact_basis(random(4, 15, 2, seed=19))
    broken = first.clone()
    broken[1] = math.nan
    assert torch.equal(canonical_correlation(broken, second)[keep], canonical_correlation(first, second)[keep])


@pytest.mark.parametrize("shared", [1, 2])
def test_correlation_of_all_pairs_is_that_of_their_singular_values(shared):
    first, second = exact_basis(random(2, 3, 4, 14, 2, seed=10)), exact_basis(random(3, 5, 14, 2, seed=11))
    table = canonical_correlation(first, second, shared=shared)
    assert table.shape == (2, 3, 4, 5) and table.min() >= 0 and table.max() <= 1
    s = torch.linalg.svdvals(first[..., :, None, :, :].mT @ second[:, None])
    expected = s[..., 0] if shared == 1 else s.square().mean(dim=-1).sqrt()
    torch.testing.assert_close(table, expected, atol=1e-12, rtol=0)
    # neither the bases matter nor the order
    spin = exact_basis(random(2, 2, seed=15))
    torch.testing.assert_close(canonical_correlation(first @ spin, second, shared=shared), table, atol=1e-10, rtol=0)
    torch.testing.assert_close(canonical_correlation(second, first, shared=shared), table.mT, atol=1e-12, rtol=0)


def test_correlation_where_both_singular_values_are_equal():
    u = exact_basis(random(3, 10, 2, seed=12))
    turned = u @ torch.tensor([[0.6, -0.8], [0.8, 0.6]], dtype=torch.float64)
    torch.testing.assert_close(canonical_correlation(u, turned).diagonal(), torch.ones(3, dtype=torch.float64), atol=1e-7, rtol=0)
    half = exact_basis(torch.eye(4, dtype=torch.float64)[:, :2] + torch.eye(4, dtype=torch.float64)[:, 2:])
    corner = torch.eye(4, dtype=torch.float64)[:, :2]
    expected = torch.tensor([[math.sqrt(0.5)]], dtype=torch.float64)
    torch.testing.assert_close(canonical_correlation(half[None], corner[None]), expected, atol=1e-7, rtol=0)


@grid(("seed", range(5)))
def test_views_of_one_shape_share_a_direction_and_others_do_not(seed):
    one, two = affine_views(seed)
    bases = exact_basis(torch.stack([one, two, affine_views(seed + 500)[0]]))
    s = canonical_correlation(bases[:1], bases[1:])[0]
    assert abs(s[0] - 1) < 1e-6 and s[1] < 0.95
    # the ridge shortens a direction that carries the part p of the energy by 1e-6 / p
    assert 1 - 1e-4 < float(canonical_correlation(orthonormal_basis(one)[None], orthonormal_basis(two)[None])) <= 1


def test_misuse_is_refused():
    u, sizes = torch.eye(8, 2)[None], (((8, 3), (8, 2)), ((8, 2), (8, 1)), ((8, 2), (9, 2)))
    shapes = (*(((2, *a), (2, *b)) for a, b in sizes), ((8, 2), (2, 8, 2)), ((2, 8, 2), (8, 2)), ((2,), (2,)))
    assert_refused(
        *((lambda a=a, b=b: canonical_correlation(torch.zeros(a), torch.zeros(b)), r"m, rows, 2\)") for a, b in shapes),
        *((lambda n=n: canonical_correlation(u, u, shared=n), "shared must be 1 or 2") for n in (0, 3, "1")),
        *((lambda n=n: affine_factorization(torch.zeros(n)), "views must be") for n in ((1, 10, 2), (10, 2), (3, 10, 3))),
    )


# Affine factorization and metric upgrade: exact on exact views, and honest where the views do not decide.


def orthographic(azimuth, elevation=0.0, scale=1.0):
    """``(3, 2)``: an upright camera turned about the vertical (y), then about its horizontal axis; degrees."""
    a, e = math.radians(azimuth), math.radians(elevation)
    x = [math.cos(a), 0.0, math.sin(a)]
    y = [math.sin(e) * math.sin(a), math.cos(e), -math.sin(e) * math.cos(a)]
    return scale * torch.tensor([x, y], dtype=torch.float64).T


def film(shape, cameras, offset_seed=1):
    """``(views, points, 2)``: every view has its own origin."""
    return shape @ torch.stack(cameras) + 10 * random(len(cameras), 1, 2, seed=offset_seed)


CAMERAS = [orthographic(0, 5, 1.0), orthographic(50, -5, 2.0), orthographic(110, 10, 0.7), orthographic(200, 0, 1.3)]


def solved(shape, cameras):
    return metric_upgrade(*affine_factorization(film(shape, cameras))[:2])


@pytest.mark.parametrize("views", [2, 3, 5])
def test_affine_views_are_rank_three(views):
    images = random(30, 3, seed=2) @ random(views, 3, 2, seed=3) + random(views, 1, 2, seed=4)
    shape, cameras, left = affine_factorization(images)
    assert shape.shape == (30, 3) and cameras.shape == (views, 3, 2) and left < 1e-20
    torch.testing.assert_close(shape @ cameras, images - images.mean(dim=1, keepdim=True), atol=1e-10, rtol=0)
    gram = shape.mT @ shape
    torch.testing.assert_close(gram, torch.diag(gram.diagonal()), atol=1e-9, rtol=0)


def test_unexplained_part_is_the_energy_beyond_rank_three():
    images = random(25, 3, seed=5) @ random(4, 3, 2, seed=6) + 0.1 * random(4, 25, 2, seed=7)
    different = torch.stack([random(25, 3, seed=seed) @ orthographic(40 * seed) for seed in range(4)])
    parts = []
    for given in (images, different):
        centred = given - given.mean(dim=1, keepdim=True)
        s = torch.linalg.svdvals(torch.cat(list(centred), dim=1))
        parts.append(affine_factorization(given)[2])
        torch.testing.assert_close(parts[-1], s[3:].square().sum() / s.square().sum(), atol=1e-12, rtol=0)
    assert 0 < parts[0] < 0.05 and parts[1] > 0.2


def test_a_batch_is_factored_like_each_of_its_members_and_float32_stays():
    images = random(2, 3, 4, 20, 2, seed=8)
    shape, cameras, left = affine_factorization(images)
    assert shape.shape == (2, 3, 20, 3) and cameras.shape == (2, 3, 4, 3, 2) and left.shape == (2, 3)
    for place in ((0, 0), (1, 2)):
        one_shape, one_cameras, one_left = affine_factorization(images[place])
        torch.testing.assert_close(shape[place] @ cameras[place], one_shape @ one_cameras, atol=1e-9, rtol=0)
        torch.testing.assert_close(left[place], one_left)
    shape, cameras, left = affine_factorization(torch.ones(3, 10, 2))  # points at one place explain nothing
    assert shape.dtype == cameras.dtype == left.dtype == torch.float32 and float(left) == 1.0
    assert torch.isfinite(shape).all() and torch.isfinite(cameras).all()


@grid(("seed", range(4)), ("sigma", [0.0, 0.01]))
def test_metric_upgrade_recovers_distances_up_to_scale(seed, sigma):
    shape = random(60, 3, seed=seed)
    metric, decided = metric_upgrade(*affine_factorization(film(shape, CAMERAS) + sigma * random(4, 60, 2, seed=11))[:2])
    assert bool(decided)
    truth, got = torch.cdist(shape, shape), torch.cdist(metric, metric)
    assert (got * (truth.sum() / got.sum()) - truth).abs().max() < (0.05 * truth.max() if sigma else 1e-6)


def test_vertical_is_that_of_the_images():
    shape = random(25, 3, seed=12)
    cameras = [orthographic(a, 0, s) for a, s in ((0, 1.0), (60, 1.5), (130, 0.8))]
    # upright cameras at one height leave Q undetermined in no direction only if their elevations differ, so tilt them evenly
    cameras += [orthographic(a, e, 1.0) for a, e in ((0, 10), (180, 10))]
    metric, decided = solved(shape, cameras)
    assert bool(decided)
    y, true = (x[:, 1] - x[:, 1].mean() for x in (metric, shape))
    assert (y @ true) / (y.norm() * true.norm()) > 0.999  # and it points up, not down


def test_two_cameras_or_flat_shapes_are_undecided_and_come_back_unchanged():
    shape = random(20, 3, seed=13)
    flat = shape * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
    for points, cameras in ((shape, CAMERAS[:2]), (shape, CAMERAS[:1] * 3), (shape, CAMERAS[:2] * 3), (flat, CAMERAS)):
        affine, fitted, _ = affine_factorization(film(points, cameras, 1))
        metric, decided = metric_upgrade(affine, fitted)
        assert not bool(decided) and torch.equal(metric, affine)
