"""Members of rank one of pencils, and the parts of planes."""

import pytest
import torch

from dyntorch.geometry.homogeneous import rank_one, skew
from dyntorch.tasks.planes.closed_forms import plane_parts, rank_one_scale, second_singular_value, unit_determinant


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def planes(*batch, n=4, f=0, kind="generic", seed=0):
    """Homographies of determinant 1, the homography at infinity, epipoles, normals, and f fundamental matrices of other bodies."""
    infinity = torch.eye(3).double() + 0.4 * normal(*batch, 3, 3, seed=seed)
    e, v = 0.4 * normal(*batch, n, 3, seed=seed + 1), 0.8 * normal(*batch, n, 3, seed=seed + 2)
    if kind in {"collinear", "both"}:
        e = e[..., :2] @ normal(*batch, 2, 3, seed=seed + 3)
    if kind in {"coplanar", "both"}:
        v = v[..., :2] @ normal(*batch, 2, 3, seed=seed + 4)
    bodies = {"pair": [0, 0, *range(2, n)], "triple": [0, 0, 0, *range(3, n)]}.get(kind, list(range(n)))
    e = e[..., bodies, :]
    if kind == "static":
        e[..., 0, :] = 0
    homographies = infinity[..., None, :, :] + e[..., :, None] * v[..., None, :]
    det = torch.linalg.det(homographies)[..., None, None]
    fundamentals = skew(normal(*batch, f, 3, seed=seed + 5)) @ infinity[..., None, :, :]
    return homographies / (det.sign() * det.abs() ** (1 / 3)), infinity, e, v, fundamentals


def error(found, true):
    """Distance ``(*batch,)`` of matrices up to scale."""
    a, b = (x / torch.linalg.matrix_norm(x, keepdim=True) for x in (found, true))
    return torch.minimum(torch.linalg.matrix_norm(a - b), torch.linalg.matrix_norm(a + b))


def test_determinant_of_one():
    matrices = torch.cat([normal(5, 3, 3), torch.zeros(1, 3, 3).double(), torch.diag(torch.tensor([5.0, 2, 0]))[None].double()])
    found = unit_determinant(matrices)
    torch.testing.assert_close(torch.linalg.det(found[:5]), torch.ones(5).double())
    assert error(found[:5], matrices[:5]).max() < 1e-12
    assert (found[5] == 0).all() and abs(found[6].norm() - 1) < 1e-12


@pytest.mark.parametrize("shape", [(2, 3), (3, 3)])
def test_the_scale_of_a_noisy_pencil_is_a_minimum(shape):
    b, scale = normal(20, *shape), normal(20, seed=2)
    exact = scale[:, None, None] * b + normal(20, shape[0], 1, seed=3) * normal(20, 1, shape[1], seed=4)
    a = exact + 1e-3 * normal(20, *shape, seed=5)
    found = rank_one_scale(a, b)

    def minors(scale):
        values = torch.linalg.svdvals(a[..., None, :, :] - scale[..., None, None] * b[..., None, :, :]).square()
        products = [values[..., i] * values[..., j] for i in range(values.shape[-1]) for j in range(i)]
        return torch.stack(products).sum(0)

    around = found[:, None] + torch.linspace(-1, 1, 201).double() * 0.01
    assert (minors(around).argmin(-1) - 100).abs().max() <= 1
    assert (found - scale).abs().median() < 3e-3


@pytest.mark.parametrize("shape", [(2, 3), (3, 3)])
def test_the_scale_of_an_exact_pencil(shape):
    b, scale = normal(50, *shape), normal(50, seed=2)
    exact = normal(50, shape[0], 1, seed=3) * normal(50, 1, shape[1], seed=4)
    exact[0] = 0
    torch.testing.assert_close(rank_one_scale(scale[:, None, None] * b + exact, b), scale, atol=1e-7, rtol=1e-7)


def test_second_singular_value_and_rank_one():
    matrix = normal(30, 3, 3)
    values = torch.linalg.svdvals(matrix)
    found = second_singular_value(matrix)
    assert (found >= values[:, 1] / 2**0.5 - 1e-12).all() and (found <= (values[:, 1:].square().sum(-1)).sqrt() + 1e-12).all()
    u, s, vh = torch.linalg.svd(normal(30, 3, 1) * normal(30, 1, 3, seed=1) + 0.1 * matrix)
    left, right = rank_one(u @ torch.diag_embed(s) @ vh)
    torch.testing.assert_close(left[..., None] * right[:, None], s[:, :1, None] * u[..., :1] * vh[:, :1], atol=1e-8, rtol=1e-8)


@pytest.mark.parametrize("kind", ["generic", "collinear", "both", "pair", "static"])
def test_parts_of_exact_planes(kind):
    homographies, infinity, e, v, _ = planes(40, kind=kind)
    parts = plane_parts(homographies, infinity)
    outer = parts.epipole[..., :, None] * parts.normal[..., None, :]
    torch.testing.assert_close(outer, e[..., :, None] * v[..., None, :], atol=1e-6, rtol=1e-6)
    torch.testing.assert_close(parts.scale[..., None, None] * (infinity[:, None] + outer), homographies, atol=1e-8, rtol=1e-8)
    assert parts.residual.max() < 1e-8
    torch.testing.assert_close(parts.epipole.norm(dim=-1), torch.ones(40, 4).double())


def test_residual_of_parts_does_not_depend_on_scales():
    homographies, infinity, *_ = planes(20)
    homographies = homographies + 0.05 * normal(20, 4, 3, 3, seed=9)
    first = plane_parts(homographies, infinity)
    second = plane_parts(-3 * homographies, 0.2 * infinity)
    torch.testing.assert_close(first.residual, second.residual, atol=1e-8, rtol=1e-6)
    torch.testing.assert_close(-15 * first.scale, second.scale)
    assert (first.residual > 1e-4).any() and (first.residual < 0.2).all()


def test_parts_have_gradients_and_no_nan():
    homographies, infinity, *_ = planes(3)
    homographies[0, 1], homographies[1, 2] = torch.nan, 0.0
    parts = plane_parts(homographies, infinity)
    assert all(x.isfinite().all() for x in vars(parts).values())
    assert parts.scale[0, 1] == 0
    alone = plane_parts(homographies[2], infinity[2])
    torch.testing.assert_close(parts.scale[2], alone.scale)

    def outer(h):
        p = plane_parts(h, infinity[2])
        return p.scale, p.epipole[..., :, None] * p.normal[..., None, :]

    noisy = homographies[2] + 0.01 * normal(4, 3, 3, seed=7)
    assert torch.autograd.gradcheck(outer, (noisy.requires_grad_(),), atol=1e-5)


def test_refusals():
    with pytest.raises(ValueError, match="H must be a floating point tensor"):
        plane_parts(torch.eye(3), torch.eye(3))
    with pytest.raises(ValueError, match="infinity must be"):
        plane_parts(torch.rand(1, 3, 3), torch.rand(3))
    with pytest.raises(ValueError, match="H must be a floating point tensor"):
        plane_parts(torch.ones(2, 3, 3, dtype=torch.int64), torch.eye(3))
