"""Translating lines: against determinants of four points, brute-force ranks, automatic derivatives and synthetic scenes."""

from itertools import combinations

import pytest
import torch

from dyntorch.core.residual import multilinear
from dyntorch.geometry.extensors import compound, plucker, plucker_form
from dyntorch.geometry.homogeneous import apply, homogeneous, unit
from dyntorch.invariants.translating_lines_matrix import TranslatingLinesMatrix
from dyntorch.metrics import relative_error
from dyntorch.scenes import translating_lines
from tests.draws import random, seeded
from tests.dyntorch.invariants.test_constant_velocity_tensor import reference_square

TL = TranslatingLinesMatrix
ONES = (torch.ones((), dtype=torch.float64),) * 2


def lines(ends):
    """Pluecker coordinates written out from the definition."""
    p, q = homogeneous(ends).unbind(-2)
    minors = [p[..., i] * q[..., j] - p[..., j] * q[..., i] for i, j in combinations(range(4), 2)]
    return torch.nn.functional.normalize(torch.stack(minors, dim=-1), dim=-1)


def rows(l1, l2):
    """Rows l2 x l1 from two points of each line."""
    return torch.einsum("ni,nj->nij", lines(l2), lines(l1)).flatten(1)


def move_ends(matrix, ends):
    return apply(matrix, ends.flatten(-3, -2)).unflatten(-2, ends.shape[-3:-1])


def test_compose_is_the_determinant_of_four_points():
    matrix = random(4, 4, seed=1)
    form = TL.compose(matrix)
    ends1, ends2 = random(2, 20, 2, 3, seed=2)
    p = homogeneous(ends1)
    q = homogeneous(ends2) @ matrix.mT
    determinant = torch.linalg.det(torch.cat([p, q], dim=-2))
    value = torch.einsum("ni,ij,nj->n", plucker(ends2), form, plucker(ends1))
    assert torch.allclose(value / determinant, (value / determinant)[0], rtol=1e-9)
    scene = translating_lines(50, generator=seeded(3))
    assert (rows(*scene.views) @ TL.compose(*scene.motion).flatten()).abs().max() < 1e-13


def test_static_points_alone():
    scene = translating_lines(1, batch=2, static_points=5, generator=seeded(6))
    x1, x2 = scene.extras["points1"], scene.extras["points2"]
    l1, l2 = TL.static_point_lines(x1, x2, length=2.0)
    assert l1.shape == l2.shape == (2, 45, 2, 3)
    ranks = [torch.linalg.matrix_rank(rows(l1[0, : 9 * k], l2[0, : 9 * k]), rtol=1e-9) for k in range(1, 6)]
    assert ranks == [9, 17, 24, 30, 35]
    values = torch.einsum("bni,bij,bnj->bn", lines(l2), TL.compose(*scene.motion), lines(l1))
    assert values.abs().max() < 1e-13
    assert torch.equal(l1[..., 0, :], x1.repeat_interleave(9, dim=-2)) and torch.equal(
        l2[..., 0, :], x2.repeat_interleave(9, dim=-2)
    )
    assert torch.allclose((l1[..., 1, :] - l1[..., 0, :]).norm(dim=-1), torch.full((2, 45), 2.0, dtype=torch.float64))
    with pytest.raises(ValueError, match="alike"):
        TL.static_point_lines(x1, x2[:, :4])


def test_transfer_of_lines():
    (matrix,) = translating_lines(1, batch=3, generator=seeded(13)).motion
    form = TL.compose(matrix)
    ends2 = random(3, 8, 2, 3, seed=14)
    ends1 = move_ends(matrix, ends2)
    for found, expected in (
        (TL.transfer(form, ends2), lines(ends1)),
        (TL.transfer(form, plucker(ends2), source=2), lines(ends1)),
        (TL.transfer(form, ends1, source=1), lines(ends2)),
    ):
        cosine = (torch.nn.functional.normalize(found, dim=-1) * expected).sum(-1).abs()
        assert torch.allclose(cosine, torch.ones_like(cosine), atol=1e-12)
    with pytest.raises(ValueError, match="source must be"):
        TL.transfer(form, ends1, source=3)


def test_static_residual_against_automatic_derivatives():
    scene = translating_lines(8, static=0.5, sigma=0.02, generator=seeded(20))
    (matrix,) = scene.motion
    scales = tuple(torch.tensor(s, dtype=torch.float64) for s in (1.0, 0.5))
    found = TL().whitened_static_residual(scene.motion, scene.views, scales).square().sum(-1)
    expected = []
    for n in range(8):
        l1, l2 = (x[n] for x in scene.views)
        along = torch.nn.functional.normalize(l1[1] - l1[0], dim=0)
        across = torch.linalg.svd(along[None]).Vh[1:]

        def residual(a, b, across=across, along=along):
            mapped = apply(matrix, b)
            # where the line of view 1 passes at the same place, a constant as far as the noise is concerned
            direction = a[1] - a[0]
            place = ((mapped - a[0]) @ along) / (direction @ along)
            return ((mapped - a[0] - place[:, None] * direction) @ across.mT).flatten()

        e = residual(l1, l2)
        expected.append((e, reference_square(residual, (l1, l2), scales)))
    # to first order: the covariances differ by the angle between the lines, which is of the size of the residual
    exact = torch.stack([s for _, s in expected])
    still = ~scene.extras["moving"]
    assert torch.allclose(found[still], exact[still], rtol=0.1)
    assert (found[~still] > 50 * found[still].median()).all()
    clean = translating_lines(10, static=1.0, generator=seeded(21))
    assert TL().whitened_static_residual(clean.motion, clean.views, ONES).abs().max() < 1e-10
    assert TL().whitened_static_residual(clean.motion, tuple(map(plucker, clean.views)), ONES).abs().max() < 1e-9


def test_residuals_follow_chi_squared():
    sigma = torch.tensor(1e-3, dtype=torch.float64)
    moving = translating_lines(4000, sigma=float(sigma), generator=seeded(22))
    still = translating_lines(4000, static=1.0, sigma=float(sigma), generator=seeded(23))
    square = multilinear(TL(), TL.compose(*moving.motion), moving.views, (sigma, sigma)).square()
    assert square.mean().item() == pytest.approx(1, abs=4 * (2 / 4000) ** 0.5)
    square = TL().whitened_static_residual(still.motion, still.views, (sigma, sigma)).square().sum(-1)
    assert square.mean().item() == pytest.approx(4, abs=4 * (8 / 4000) ** 0.5)
    assert square.var().item() == pytest.approx(8, rel=0.25)


def test_nothing_spoils_a_batch():
    matrix = unit(random(5, 4, 4, seed=28))
    bad = TL.compose(matrix)
    bad[1], bad[2], bad[3] = 0.0, float("nan"), torch.outer(*random(2, 6, seed=29))
    bad.requires_grad_()
    found = TL.decompose(bad)
    assert found.isfinite().all() and (found[1:3] == 0).all()
    assert (found[[0, 4]] - matrix[[0, 4]]).abs().max() < 1e-9
    assert (found[4] - TL.decompose(bad[4])).abs().max() < 1e-12
    (gradient,) = torch.autograd.grad(found[[0, 4]].pow(3).sum(), bad)
    assert gradient.isfinite().all()
    zero = torch.zeros(4, 4, dtype=torch.float64)
    same = torch.zeros(6, 2, 3, dtype=torch.float64)
    assert TL.compose(zero).isfinite().all()
    for m in (zero, matrix[0]):
        assert TL().whitened_static_residual((m,), (same, same), ONES).isfinite().all()
        assert multilinear(TL(), TL.compose(m), (same, same), ONES).isfinite().all()
    assert TL.decompose(bad.float()).dtype == torch.float32
    assert TL.decompose(bad[:0]).shape == (0, 4, 4)
    with pytest.raises(ValueError, match="matrix must be"):
        TL.decompose(matrix)


def test_compound_root_needs_its_signs():
    """The rows as common points of lines alone are no collineation: each is known up to scale and sign."""
    matrix = unit(random(200, 4, 4, seed=30))
    minors = compound(matrix, 2)
    found = TL.decompose((plucker_form() @ minors).mT)
    assert relative_error(found, matrix).max() < 1e-8
    rescaled = unit(found / found.norm(dim=-1, keepdim=True))
    assert relative_error(rescaled, matrix).median() > 0.1
