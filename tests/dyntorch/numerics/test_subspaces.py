"""Subspaces: bases, canonical correlations, factorization of affine views and its metric upgrade."""

from __future__ import annotations

import math

import pytest
import torch

from dyntorch.numerics import affine_factorization, canonical_correlation, metric_upgrade, orthonormal_basis
from tests.draws import random as random_factorization
from tests.grid import grid


def random(*shape, seed=0, dtype=torch.float64):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


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


@pytest.mark.parametrize("unit", [1e-9, 1e-3, 1.0, 1e6])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_basis_does_not_depend_on_the_unit(unit, dtype):
    matrix = random(6, 24, 2, seed=4, dtype=dtype)
    torch.testing.assert_close(orthonormal_basis(matrix * unit), orthonormal_basis(matrix), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_zero_matrix_gives_a_zero_basis(dtype):
    basis = orthonormal_basis(torch.zeros(3, 10, 2, dtype=dtype))
    assert basis.dtype == dtype
    assert (basis == 0).all()


def test_a_flat_direction_comes_out_short_and_finite():
    line = random(12, 1, seed=5)
    basis = orthonormal_basis(torch.cat([line, 2 * line], dim=1))
    assert torch.isfinite(basis).all()
    unit = line / line.norm()
    torch.testing.assert_close(unit @ (unit.mT @ basis), basis, atol=1e-9, rtol=0)
    assert basis.norm(dim=0).max() <= 1 + 1e-9


@pytest.mark.parametrize("bad", [math.nan, math.inf, 0.0])
def test_one_bad_matrix_leaves_the_others_alone(bad):
    matrices = random(4, 15, 2, seed=6)
    expected = orthonormal_basis(matrices)
    broken = matrices.clone()
    broken[1] = bad
    got = orthonormal_basis(broken)
    keep = [0, 2, 3]
    assert torch.equal(got[keep], expected[keep])


def test_basis_is_differentiable():
    matrix = random(6, 2, seed=8).requires_grad_()
    fixed = random(6, 6, seed=9)
    assert torch.autograd.gradcheck(lambda x: (fixed @ orthonormal_basis(x) @ orthonormal_basis(x).mT).diagonal().sum(), (matrix,))


@pytest.mark.parametrize("shared", [1, 2])
def test_correlation_of_all_pairs_against_singular_values(shared):
    first, second = exact_basis(random(9, 14, 2, seed=10)), exact_basis(random(11, 14, 2, seed=11))
    table = canonical_correlation(first, second, shared=shared)
    assert table.shape == (9, 11)
    s = torch.linalg.svdvals(first[:, None].mT @ second[None])
    expected = s[..., 0] if shared == 1 else s.square().mean(dim=-1).sqrt()
    torch.testing.assert_close(table, expected, atol=1e-12, rtol=0)


def test_correlation_where_both_singular_values_are_equal():
    u = exact_basis(random(3, 10, 2, seed=12))
    turned = u @ torch.tensor([[0.6, -0.8], [0.8, 0.6]], dtype=torch.float64)
    torch.testing.assert_close(canonical_correlation(u, turned).diagonal(), torch.ones(3, dtype=torch.float64), atol=1e-7, rtol=0)
    half = exact_basis(torch.eye(4, dtype=torch.float64)[:, :2] + torch.eye(4, dtype=torch.float64)[:, 2:])
    corner = torch.eye(4, dtype=torch.float64)[:, :2]
    expected = torch.tensor([[math.sqrt(0.5)]], dtype=torch.float64)
    torch.testing.assert_close(canonical_correlation(half[None], corner[None]), expected, atol=1e-7, rtol=0)


def test_correlation_ignores_the_basis_and_the_order():
    u, v = exact_basis(random(5, 12, 2, seed=13)), exact_basis(random(6, 12, 2, seed=14))
    spin = exact_basis(random(2, 2, seed=15))
    for shared in (1, 2):
        table = canonical_correlation(u, v, shared=shared)
        torch.testing.assert_close(canonical_correlation(u @ spin, v, shared=shared), table, atol=1e-10, rtol=0)
        torch.testing.assert_close(canonical_correlation(v, u, shared=shared), table.mT, atol=1e-12, rtol=0)
        assert table.min() >= 0 and table.max() <= 1


@pytest.mark.parametrize("seed", range(5))
def test_views_of_one_shape_share_a_direction_and_others_do_not(seed):
    one, two = affine_views(seed)
    other = affine_views(seed + 500)[0]
    bases = exact_basis(torch.stack([one, two, other]))
    s = canonical_correlation(bases[:1], bases[1:])[0]
    assert abs(s[0] - 1) < 1e-6
    assert s[1] < 0.95


@pytest.mark.parametrize("seed", range(5))
def test_the_rank_condition_survives_the_ridge(seed):
    one, two = affine_views(seed)
    s = canonical_correlation(orthonormal_basis(one)[None], orthonormal_basis(two)[None])
    # the ridge shortens a direction that carries the part p of the energy by 1e-6 / p
    assert 1 - 1e-4 < float(s) <= 1


def test_a_nan_basis_stays_in_its_own_row():
    u, v = exact_basis(random(3, 8, 2, seed=18)), exact_basis(random(4, 8, 2, seed=19))
    expected = canonical_correlation(u, v)
    broken = u.clone()
    broken[1] = math.nan
    assert torch.equal(canonical_correlation(broken, v)[[0, 2]], expected[[0, 2]])


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ((2, 8, 3), (2, 8, 2)),
        ((2, 8, 2), (2, 8, 1)),
        ((2, 8, 2), (2, 9, 2)),
        ((8, 2), (2, 8, 2)),
        ((2, 8, 2), (8, 2)),
        ((2,), (2,)),
    ],
)
def test_wrong_shapes_are_refused(first, second):
    with pytest.raises(ValueError, match=r"m, rows, 2\)"):
        canonical_correlation(torch.zeros(first), torch.zeros(second))


@pytest.mark.parametrize("shared", [0, 3, "1"])
def test_other_numbers_of_shared_directions_are_refused(shared):
    u = exact_basis(random(2, 8, 2))
    with pytest.raises(ValueError, match="shared must be 1 or 2"):
        canonical_correlation(u, u, shared=shared)


# ----------------------------------------------------------------------------------------------------------------------
# Affine factorization and metric upgrade: exact on exact views, and honest where the views do not decide.


def orthographic(azimuth, elevation=0.0, scale=1.0):
    """``(3, 2)``: an upright camera turned about the vertical (y), then about its horizontal axis; degrees."""
    a, e = math.radians(azimuth), math.radians(elevation)
    x = [math.cos(a), 0.0, math.sin(a)]
    y = [math.sin(e) * math.sin(a), math.cos(e), -math.sin(e) * math.cos(a)]
    return scale * torch.tensor([x, y], dtype=torch.float64).T


def film(shape, cameras, offset_seed=1):
    """``(views, points, 2)``: every view has its own origin."""
    return shape @ torch.stack(cameras) + 10 * random_factorization(len(cameras), 1, 2, seed=offset_seed)


CAMERAS = [orthographic(0, 5, 1.0), orthographic(50, -5, 2.0), orthographic(110, 10, 0.7), orthographic(200, 0, 1.3)]


def solved(shape, cameras):
    affine, fitted, _ = affine_factorization(film(shape, cameras))
    return metric_upgrade(affine, fitted)


@pytest.mark.parametrize("views", [2, 3, 5])
def test_affine_views_are_rank_three(views):
    images = random_factorization(30, 3, seed=2) @ random_factorization(views, 3, 2, seed=3) + random_factorization(
        views, 1, 2, seed=4
    )
    shape, cameras, left = affine_factorization(images)
    assert shape.shape == (30, 3)
    assert cameras.shape == (views, 3, 2)
    assert left < 1e-20
    torch.testing.assert_close(shape @ cameras, images - images.mean(dim=1, keepdim=True), atol=1e-10, rtol=0)
    gram = shape.mT @ shape
    torch.testing.assert_close(gram, torch.diag(gram.diagonal()), atol=1e-9, rtol=0)


def test_unexplained_part_is_the_energy_beyond_rank_three():
    images = random_factorization(25, 3, seed=5) @ random_factorization(4, 3, 2, seed=6) + 0.1 * random_factorization(
        4, 25, 2, seed=7
    )
    _, _, left = affine_factorization(images)
    centred = images - images.mean(dim=1, keepdim=True)
    s = torch.linalg.svdvals(torch.cat(list(centred), dim=1))
    torch.testing.assert_close(left, s[3:].square().sum() / s.square().sum(), atol=1e-12, rtol=0)
    assert 0 < left < 0.05


def test_different_shapes_leave_much_unexplained():
    images = torch.stack([random_factorization(30, 3, seed=seed) @ orthographic(40 * seed) for seed in range(4)])
    assert affine_factorization(images)[2] > 0.2


def test_a_batch_is_factored_like_each_of_its_members():
    images = random_factorization(2, 3, 4, 20, 2, seed=8)
    shape, cameras, left = affine_factorization(images)
    assert shape.shape == (2, 3, 20, 3) and cameras.shape == (2, 3, 4, 3, 2) and left.shape == (2, 3)
    for i in range(2):
        for j in range(3):
            one_shape, one_cameras, one_left = affine_factorization(images[i, j])
            torch.testing.assert_close(shape[i, j] @ cameras[i, j], one_shape @ one_cameras, atol=1e-9, rtol=0)
            torch.testing.assert_close(left[i, j], one_left)


def test_float32_stays_float32_and_points_at_one_place_explain_nothing():
    shape, cameras, left = affine_factorization(torch.ones(3, 10, 2))
    assert shape.dtype == cameras.dtype == left.dtype == torch.float32
    assert float(left) == 1.0
    assert torch.isfinite(shape).all() and torch.isfinite(cameras).all()


@pytest.mark.parametrize("shape", [(1, 10, 2), (10, 2), (3, 10, 3)])
def test_wrong_views_are_refused(shape):
    with pytest.raises(ValueError, match="views must be"):
        affine_factorization(torch.zeros(shape))


@pytest.mark.parametrize("seed", range(4))
def test_metric_upgrade_recovers_distances_up_to_scale(seed):
    shape = random_factorization(25, 3, seed=seed)
    metric, decided = solved(shape, CAMERAS)
    assert bool(decided)
    truth, got = torch.cdist(shape, shape), torch.cdist(metric, metric)
    scale = truth.sum() / got.sum()
    torch.testing.assert_close(got * scale, truth, atol=1e-8, rtol=0)


def test_noise_moves_the_result_only_a_little():
    shape = random_factorization(60, 3, seed=10)
    images = film(shape, CAMERAS) + 0.01 * random_factorization(4, 60, 2, seed=11)
    affine, cameras, left = affine_factorization(images)
    metric, decided = metric_upgrade(affine, cameras)
    assert bool(decided) and 0 < left < 1e-3
    truth, got = torch.cdist(shape, shape), torch.cdist(metric, metric)
    assert ((got * (truth.sum() / got.sum()) - truth).abs().max() / truth.max()) < 0.05


def test_vertical_is_that_of_the_images():
    shape = random_factorization(25, 3, seed=12)
    cameras = [orthographic(a, 0, s) for a, s in ((0, 1.0), (60, 1.5), (130, 0.8))]
    # upright cameras at one height leave Q undetermined in no direction only if their elevations differ, so tilt them evenly
    cameras += [orthographic(a, e, 1.0) for a, e in ((0, 10), (180, 10))]
    metric, decided = solved(shape, cameras)
    assert bool(decided)
    y = metric[:, 1] - metric[:, 1].mean()
    true = shape[:, 1] - shape[:, 1].mean()
    assert (y @ true) / (y.norm() * true.norm()) > 0.999  # and it points up, not down


def test_two_views_are_undecided_and_come_back_unchanged():
    affine, cameras, _ = affine_factorization(film(random_factorization(20, 3, seed=13), CAMERAS[:2]))
    metric, decided = metric_upgrade(affine, cameras)
    assert not bool(decided)
    assert torch.equal(metric, affine)


@pytest.mark.parametrize("count", [3, 5])
def test_identical_views_are_undecided(count):
    images = film(random_factorization(20, 3, seed=14), CAMERAS[:1]).repeat(count, 1, 1)
    affine, cameras, _ = affine_factorization(images)
    metric, decided = metric_upgrade(affine, cameras)
    assert not bool(decided)
    assert torch.equal(metric, affine)


def test_two_distinct_cameras_are_undecided_however_often_repeated():
    affine, cameras, _ = affine_factorization(film(random_factorization(20, 3, seed=15), [CAMERAS[0], CAMERAS[1]] * 3))
    assert not bool(metric_upgrade(affine, cameras)[1])


@grid(("seed", range(8)))
def test_a_flat_shape_is_undecided(seed):
    # the third row of every camera is then any vector of the null space, and nothing that it says can be believed
    shape = random_factorization(25, 3, seed=seed) * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
    assert not bool(solved(shape, CAMERAS)[1])
