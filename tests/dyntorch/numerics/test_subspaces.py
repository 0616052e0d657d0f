"""Subspaces: bases against QR and SVD, canonical correlations against singular values, the rank condition between views."""

import math

import pytest
import torch

from dyntorch.numerics import canonical_correlation, orthonormal_basis
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


def test_basis_agrees_with_svd():
    matrix = random(4, 20, 2, seed=3)
    u = torch.linalg.svd(matrix, full_matrices=False).U
    basis = orthonormal_basis(matrix)
    torch.testing.assert_close(basis @ basis.mT, u @ u.mT, atol=1e-4, rtol=0)


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


def test_basis_of_a_batch_is_the_basis_of_each():
    matrices = random(7, 18, 2, seed=7)
    torch.testing.assert_close(
        orthonormal_basis(matrices), torch.stack([orthonormal_basis(m) for m in matrices]), atol=1e-12, rtol=0
    )


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


def test_correlation_leaves_its_inputs_as_they_are():
    u, v = exact_basis(random(2, 8, 2, seed=16)), exact_basis(random(3, 8, 2, seed=17))
    before = u.clone(), v.clone()
    canonical_correlation(u, v)
    canonical_correlation(u, v, shared=2)
    assert torch.equal(u, before[0]) and torch.equal(v, before[1])


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
