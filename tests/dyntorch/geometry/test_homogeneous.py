"""Homogeneous coordinates: finite at infinity, in value and gradient; collineations, canonical signs, hyperplane bases."""

import pytest
import torch

from dyntorch.geometry.homogeneous import (
    apply,
    homogeneous,
    hyperplanes_through,
    inhomogeneous,
    nonzero_sign,
    similarity,
    skew,
    two_sided,
    unit,
    unit_vectors,
)
from tests.grid import grid


def random(*shape, seed=0, dtype=torch.float64):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


@pytest.mark.parametrize("d", [1, 2, 3, 6])
def test_inhomogeneous_undoes_homogeneous_at_any_scale(d):
    x = random(3, 5, d)
    for scale in (1.0, -1e-200, 1e200):
        torch.testing.assert_close(inhomogeneous(scale * homogeneous(x)), x, rtol=1e-15, atol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("bad", [[1.0, -2.0, 0.0], [0.0, 0.0, 0.0], [3.0, 1.0, 1e-30], [1e-38, 1e-38, -1e-38], [1e30, 1.0, -1e-8]])
def test_points_at_infinity_are_finite_and_do_not_touch_the_others(bad, dtype):
    good = [4.0, 6.0, 2.0]
    p = torch.tensor([good, bad, good], dtype=dtype, requires_grad=True)
    x = inhomogeneous(p)
    assert x.isfinite().all()
    assert x.abs().max() <= 1 / torch.finfo(dtype).eps
    x.sum().backward()
    assert p.grad.isfinite().all()
    torch.testing.assert_close(p.grad[0], torch.tensor([0.5, 0.5, -2.5], dtype=dtype))
    assert torch.equal(p.grad[0], p.grad[2])


def test_infinity_keeps_the_direction():
    x = inhomogeneous(torch.tensor([[3.0, -4.0, 0.0], [3.0, -4.0, -0.0]], dtype=torch.float64))
    torch.testing.assert_close(torch.nn.functional.normalize(x, dim=-1), torch.tensor([[0.6, -0.8], [-0.6, 0.8]]).double())
    torch.testing.assert_close(x.abs().amax(-1), torch.full((2,), 1 / torch.finfo(torch.float64).eps).double())


def test_gradients_of_the_division():
    p = homogeneous(random(4, 3)) * random(4, 1, seed=1)
    assert torch.autograd.gradcheck(inhomogeneous, p.requires_grad_())
    assert torch.autograd.gradcheck(apply, (random(2, 3, 4, seed=2).requires_grad_(), random(2, 5, 3, seed=3).requires_grad_()))


@grid((("e", "d"), [(2, 1), (3, 2), (4, 3), (3, 3)]), ("batch", [(), (4,), (2, 3)]))
def test_apply_is_the_division_of_the_product(e, d, batch):
    a, x = random(*batch, e, d + 1), random(*batch, 7, d, seed=1)
    y = apply(a, x)
    assert y.shape == (*batch, 7, e - 1)
    ones = torch.ones(*batch, 7, 1, dtype=torch.float64)
    p = torch.einsum("...ij,...nj->...ni", a, torch.cat([x, ones], -1))
    torch.testing.assert_close(y, p[..., :-1] / p[..., -1:])
    torch.testing.assert_close(apply(-3 * a, x), y)


def test_apply_composes_and_inverts():
    a, b, x = random(5, 4, 4), random(5, 4, 4, seed=1), random(5, 9, 3, seed=2)
    torch.testing.assert_close(apply(a, apply(b, x)), apply(a @ b, x), rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(apply(torch.linalg.inv(a), apply(a, x)), x, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize(("a", "x"), [((3, 3), (5, 3)), ((3, 3), (2,)), ((3,), (5, 2))])
def test_apply_refuses_matrices_of_another_space(a, x):
    with pytest.raises(ValueError, match="collineation must be"):
        apply(random(*a), random(*x))


@pytest.mark.parametrize("shape", [(3, 3), (5, 5), (4, 4), (2, 2), (3, 4)])
def test_unit_depends_on_the_line_only(shape):
    a = random(50, *shape)
    u = unit(a)
    torch.testing.assert_close(torch.linalg.matrix_norm(u), torch.ones(50, dtype=torch.float64))
    for scale in (-1.0, 1e-30, -1e30):
        torch.testing.assert_close(unit(scale * a), u)
    if shape[0] == shape[1] and shape[0] % 2:
        assert (torch.linalg.det(u) > 0).all()
    else:
        assert torch.equal(u.flatten(1).abs().amax(1), u.flatten(1).amax(1))


def test_unit_of_an_image_homography_sees_its_small_determinant():
    shift = torch.tensor([[1.0, 0.0, 4000.0], [0.0, 1.0, -9000.0], [0.0, 0.0, 1.0]])
    for dtype in (torch.float32, torch.float64):
        # its determinant is 1e-12 of the cube of its norm, its largest entry negative
        assert unit(shift.to(dtype))[0, 2] > 0
        assert unit(-shift.to(dtype))[0, 2] > 0


def test_unit_of_singular_and_zero_matrices():
    singular = random(20, 3, 2) @ random(20, 2, 3, seed=1)
    u = unit(singular)
    assert torch.equal(u, unit(-singular))
    assert (u.flatten(1).amax(1) == u.flatten(1).abs().amax(1)).all()
    zero = torch.zeros(3, 3, dtype=torch.float64, requires_grad=True)
    unit(zero).sum().backward()
    assert torch.equal(unit(zero), torch.zeros_like(zero)) and zero.grad.isfinite().all()
    with pytest.raises(ValueError, match="unsqueeze"):
        unit(random(3))


def test_unit_is_differentiable_and_orthogonal_to_itself():
    a = random(2, 3, 3).requires_grad_()
    assert torch.autograd.gradcheck(unit, a)
    (unit(a) * random(2, 3, 3, seed=1)).sum().backward()
    torch.testing.assert_close((a.grad * a).sum(), torch.zeros((), dtype=torch.float64), atol=1e-14, rtol=0)


def test_skew_is_the_cross_product():
    v, w = random(4, 5, 3), random(4, 5, 3, seed=1)
    torch.testing.assert_close((skew(v) @ w[..., None])[..., 0], torch.linalg.cross(v, w))
    with pytest.raises(ValueError, match="v must be"):
        skew(random(4))


@pytest.mark.parametrize("d", [1, 2, 3])
def test_similarity_scales_about_the_centre(d):
    s, c, x = random(6).abs() + 0.1, random(6, d, seed=1), random(6, 8, d, seed=2)
    t = similarity(s, c)
    assert t.shape == (6, d + 1, d + 1)
    torch.testing.assert_close(apply(t, x), s[:, None, None] * (x - c[:, None]))
    torch.testing.assert_close(torch.linalg.det(t), s**d)


@pytest.mark.parametrize("d", [1, 2, 3, 6])
def test_hyperplanes_are_orthonormal_and_pass_through_the_point(d):
    x = random(4, 10, d) * torch.logspace(-3, 3, 10, dtype=torch.float64)[:, None]
    n = hyperplanes_through(x)
    assert n.shape == (4, 10, d, d + 1)
    torch.testing.assert_close(n @ n.mT, torch.eye(d, dtype=torch.float64).expand(4, 10, d, d), rtol=0, atol=1e-13)
    p = torch.nn.functional.normalize(homogeneous(x), dim=-1)
    assert (n @ p[..., None]).abs().max() < 1e-14


def test_hyperplanes_are_smooth():
    assert torch.autograd.gradcheck(hyperplanes_through, random(3, 3).requires_grad_())
    x = random(1, 2)
    # around a small loop the basis comes back to itself, without a jump
    angles = torch.linspace(0, 2 * torch.pi, 2000, dtype=torch.float64)
    n = hyperplanes_through(x + torch.stack([angles.cos(), angles.sin()], -1))
    assert (n[1:] - n[:-1]).abs().max() < 0.01


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_unit_vectors_and_signs_leave_zero_alone(dtype):
    x = random(4, 3, dtype=dtype)
    x[1] = 0
    x.requires_grad_()
    found = unit_vectors(x)
    torch.testing.assert_close(found.norm(dim=-1), torch.tensor([1.0, 0, 1, 1], dtype=dtype))
    assert ((found * x).sum(-1)[[0, 2, 3]] > 0).all() and found.dtype == dtype
    (gradient,) = torch.autograd.grad(found[:, 0].sum(), x)
    assert gradient.isfinite().all()
    # across the vector: its length does not matter
    assert (gradient * x).sum(-1).abs().max() < 10 * torch.finfo(dtype).eps
    sign = nonzero_sign(x.detach())
    assert sign.dtype == dtype and torch.equal(sign * x.abs(), x) and (sign[1] == 1).all()


def test_a_product_from_both_sides_is_a_matrix_on_entries():
    A, X, B = (
        torch.randn(4, *size, dtype=torch.float64, generator=torch.Generator().manual_seed(5)) for size in ((3, 2), (2, 4), (4, 5))
    )
    found = two_sided(A, B)
    assert found.shape == (4, 15, 8)
    torch.testing.assert_close((found @ X.flatten(1)[..., None])[..., 0], (A @ X @ B).flatten(1))
