"""Homogeneous coordinates: finite at infinity, in value and gradient; collineations, canonical signs, hyperplane bases."""

from itertools import combinations_with_replacement, permutations

import pytest
import torch
from torch.nn.functional import normalize

from dyntorch.core.primitives import Monomials
from dyntorch.geometry.homogeneous import (
    apply,
    cofactors,
    collecting,
    homogeneous,
    inhomogeneous,
    monomial_derivatives,
    monomials,
    multiplicity,
    nonzero_sign,
    null_vectors,
    similarity,
    skew,
    symmetric,
    two_sided,
    unit,
    unit_vectors,
)
from dyntorch.metrics import relative_error
from tests.draws import random
from tests.grid import assert_refused, grid


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
    # infinity keeps the direction
    x = inhomogeneous(torch.tensor([[3.0, -4.0, 0.0], [3.0, -4.0, -0.0]], dtype=torch.float64))
    torch.testing.assert_close(normalize(x, dim=-1), torch.tensor([[0.6, -0.8], [-0.6, 0.8]]).double())
    torch.testing.assert_close(x.abs().amax(-1), torch.full((2,), 1 / torch.finfo(torch.float64).eps).double())


@grid((("e", "d"), [(2, 1), (3, 2), (4, 3), (3, 3)]), ("batch", [(), (4,), (2, 3)]))
def test_apply_is_the_division_of_the_product(e, d, batch):
    a, x = random(*batch, e, d + 1), random(*batch, 7, d, seed=1)
    y = apply(a, x)
    assert y.shape == (*batch, 7, e - 1)
    ones = torch.ones(*batch, 7, 1, dtype=torch.float64)
    p = torch.einsum("...ij,...nj->...ni", a, torch.cat([x, ones], -1))
    torch.testing.assert_close(y, p[..., :-1] / p[..., -1:])
    torch.testing.assert_close(apply(-3 * a, x), y)


def test_gradients():
    m, point = rank_two(3).requires_grad_(), (homogeneous(random(4, 3)) * random(4, 1, seed=1)).requires_grad_()

    def projectors(m):
        return tuple(v[..., :, None] * v[..., None, :] for v in null_vectors(m))

    for function, given in (
        (inhomogeneous, point),
        (projectors, m),
        (cofactors, m),
        (apply, (random(2, 3, 4, seed=2).requires_grad_(), random(2, 5, 3, seed=3).requires_grad_())),
    ):
        assert torch.autograd.gradcheck(function, given)


def test_misuse():
    assert_refused(
        *(
            (lambda a=a, x=x: apply(random(*a), random(*x)), "collineation must be")
            for a, x in (((3, 3), (5, 3)), ((3, 3), (2,)), ((3,), (5, 2)))
        ),
        *((lambda f=f: f(torch.zeros(2, 4)), r"\(2, 4\)") for f in (cofactors, null_vectors)),
        (lambda: unit(random(3)), "unsqueeze"),
        (lambda: skew(random(4)), "v must be"),
    )


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


def test_unit_sees_small_determinants_and_is_orthogonal_to_its_gradient():
    shift = torch.tensor([[1.0, 0.0, 4000.0], [0.0, 1.0, -9000.0], [0.0, 0.0, 1.0]])
    for dtype in (torch.float32, torch.float64):
        # its determinant is 1e-12 of the cube of its norm, its largest entry negative
        assert unit(shift.to(dtype))[0, 2] > 0
        assert unit(-shift.to(dtype))[0, 2] > 0
    a = random(2, 3, 3).requires_grad_()
    assert torch.autograd.gradcheck(unit, a)
    (unit(a) * random(2, 3, 3, seed=1)).sum().backward()
    torch.testing.assert_close((a.grad * a).sum(), torch.zeros((), dtype=torch.float64), atol=1e-14, rtol=0)


def test_unit_of_singular_and_zero_matrices():
    singular = random(20, 3, 2) @ random(20, 2, 3, seed=1)
    u = unit(singular)
    assert torch.equal(u, unit(-singular))
    assert (u.flatten(1).amax(1) == u.flatten(1).abs().amax(1)).all()
    zero = torch.zeros(3, 3, dtype=torch.float64, requires_grad=True)
    unit(zero).sum().backward()
    assert torch.equal(unit(zero), torch.zeros_like(zero)) and zero.grad.isfinite().all()


def test_skew_and_products_from_both_sides_are_matrices_on_entries():
    v, w = random(4, 5, 3), random(4, 5, 3, seed=1)
    torch.testing.assert_close((skew(v) @ w[..., None])[..., 0], torch.linalg.cross(v, w))
    A, X, B = (random(4, *size, seed=5) for size in ((3, 2), (2, 4), (4, 5)))
    found = two_sided(A, B)
    assert found.shape == (4, 15, 8)
    torch.testing.assert_close((found @ X.flatten(1)[..., None])[..., 0], (A @ X @ B).flatten(1))


@pytest.mark.parametrize("d", [1, 2, 3])
def test_similarity_scales_about_the_centre(d):
    s, c, x = random(6).abs() + 0.1, random(6, d, seed=1), random(6, 8, d, seed=2)
    t = similarity(s, c)
    assert t.shape == (6, d + 1, d + 1)
    torch.testing.assert_close(apply(t, x), s[:, None, None] * (x - c[:, None]))
    torch.testing.assert_close(torch.linalg.det(t), s**d)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_unit_vectors_and_signs_leave_zero_alone(dtype):
    x = random(4, 3).to(dtype)
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


# 3 x 3 cofactors and null vectors: against inverses and singular vectors; pixels, noise, rank below two, gradients.


def rank_two(*batch, seed=0):
    return random(*batch, 3, 2, seed=seed) @ random(*batch, 2, 3, seed=seed + 1)


def test_cofactors_are_the_scaled_inverse_transpose():
    m = random(50, 3, 3)
    torch.testing.assert_close(cofactors(m), torch.linalg.det(m)[:, None, None] * torch.linalg.inv(m).mT)
    torch.testing.assert_close(cofactors(m[0] @ m[1]), cofactors(m[0]) @ cofactors(m[1]))


def test_null_vectors_of_rank_two():
    m = rank_two(200)
    left, right = null_vectors(m)
    assert (left[:, None] @ m).abs().max() < 1e-12
    assert (m @ right[..., None]).abs().max() < 1e-12
    torch.testing.assert_close(left.norm(dim=-1), torch.ones(200).double())
    torch.testing.assert_close(right.norm(dim=-1), torch.ones(200).double())


@pytest.mark.parametrize("noise", [1e-6, 1e-2, 0.1])
def test_noisy_matrices_give_the_smallest_singular_vectors(noise):
    m = rank_two(500) + noise * random(500, 3, 3, seed=9)
    u, s, vt = torch.linalg.svd(m)
    clear = s[:, 2] < 0.6 * s[:, 1]
    assert clear.sum() > 300
    left, right = null_vectors(m[clear])
    assert relative_error(left, u[clear][..., 2], dims=1).max() < 1e-9
    assert relative_error(right, vt[clear][:, 2], dims=1).max() < 1e-9


def test_units_of_the_coordinates_do_not_matter():
    # pixels beside the constant 1, exaggerated; the last singular value of such a matrix is known to 1e-4 of the middle one
    rows, columns = torch.tensor([1e-6, 1e-6, 1.0]).double(), torch.tensor([1.0, 1e6, 1e6]).double()
    m = rank_two(100)
    left, right = null_vectors(m)
    scaled_left, scaled_right = null_vectors(rows[:, None] * m * columns)
    for plain, scaled, factor in ((left, scaled_left, rows), (right, scaled_right, columns)):
        assert relative_error(plain, scaled * factor, dims=1).max() < 1e-10


def test_rank_below_two_is_zero_and_does_not_touch_the_others():
    m = torch.stack([torch.zeros(3, 3), torch.ones(3, 3), rank_two(), torch.full((3, 3), torch.nan)]).double().requires_grad_()
    left, right = null_vectors(m)
    assert torch.equal(left[:2], torch.zeros(2, 3).double())
    assert torch.equal(right[:2], torch.zeros(2, 3).double())
    (left[:3].square().sum() + right[:3].sum()).backward()
    assert m.grad[:3].isfinite().all()
    torch.testing.assert_close(torch.stack([left[2], right[2]]), torch.stack(null_vectors(m[2])), rtol=0, atol=0)


# Monomials of points: values one by one, the action of collineations, derivatives by autograd, rotations.


ALL = [Monomials(d, k, isometric) for d in (1, 2, 3) for k in (1, 2, 4) for isometric in (False, True)]


@pytest.mark.parametrize("primitive", ALL)
def test_values_and_shapes(primitive):
    x = random(2, 5, primitive.dim)
    places = list(combinations_with_replacement(range(primitive.dim + 1), primitive.degree))
    products = [torch.stack([homogeneous(x)[..., i] for i in place], -1).prod(-1) for place in places]
    counts = [len(set(permutations(place))) for place in places]
    scale = torch.tensor(counts).double().sqrt() if primitive.isometric else torch.ones(len(counts)).double()
    expected = torch.stack(products, dim=-1) * scale
    torch.testing.assert_close(primitive.raw(x), expected)
    torch.testing.assert_close(primitive.components(x), expected.mT)
    torch.testing.assert_close(primitive.vectors(x), expected[..., None, :])
    assert primitive.width == expected.shape[-1] and primitive.match_axis(x) == 1
    rows, columns = torch.triu_indices(primitive.width, primitive.width)
    torch.testing.assert_close(primitive.pack(x), (expected[..., rows] * expected[..., columns]).mT)
    with pytest.raises(ValueError, match=r"expected \(\*batch, n, \d.*\), got \(2, 5, 17\)"):
        primitive.match_axis(torch.zeros(2, 5, 17))


def test_order_of_the_plane():
    assert Monomials().raw(torch.tensor([[2.0, 3.0]])).tolist() == [[4.0, 6.0, 2.0, 9.0, 3.0, 1.0]]
    assert multiplicity(2, 2, torch.device("cpu")).tolist() == [1, 2, 2, 1, 2, 1]
    assert symmetric(2, torch.device("cpu")).tolist() == [[0, 1, 2], [1, 3, 4], [2, 4, 5]]
    p = random(3)
    collect = collecting(2, 2, torch.device("cpu"))
    torch.testing.assert_close(torch.kron(p, p), collect.mT @ torch.stack([p[i] * p[j] for i in range(3) for j in range(i, 3)]))


@pytest.mark.parametrize("primitive", ALL)
def test_action_is_that_of_the_moved_point(primitive):
    d = primitive.dim
    frames, x = torch.eye(d + 1).double() + 0.3 * random(2, d + 1, d + 1, seed=1), random(2, 5, d)
    moved = homogeneous(x) @ frames.mT
    image = primitive.raw(moved[..., :-1] / moved[..., -1:]) * moved[..., -1:] ** primitive.degree
    torch.testing.assert_close(primitive.raw(x) @ primitive.action(frames).mT, image)


@pytest.mark.parametrize("primitive", ALL)
def test_pullback_and_pushforward_are_the_derivative(primitive):
    x, slope = random(2, 5, primitive.dim), random(2, 5, primitive.width, seed=1)
    change = random(2, 5, primitive.dim, seed=2)
    value, along = torch.func.jvp(primitive.raw, (x,), (change,))
    torch.testing.assert_close(primitive.pushforward(x, change), along)
    torch.testing.assert_close(primitive.pullback(x, slope), torch.func.vjp(primitive.raw, x)[1](slope)[0])
    assert value.shape == slope.shape


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_vectors_that_do_not_end_in_one(degree):
    p = random(5, 3)
    expected = torch.stack([p[:, list(c)].prod(-1) for c in combinations_with_replacement(range(3), degree)])
    torch.testing.assert_close(monomials(p.mT, degree), expected)
    slopes = torch.func.vmap(torch.func.jacrev(lambda v: monomials(v[:, None], degree)[:, 0]))(p)
    torch.testing.assert_close(monomial_derivatives(p, degree, 3), slopes)
    torch.testing.assert_close(monomial_derivatives(p, degree, 2), slopes[..., :2])


def test_isometric_ones_turn_with_the_point():
    for degree in (1, 2, 3):
        primitive = Monomials(degree).normalize(torch.eye(3))
        assert primitive.isometric
        turn = torch.linalg.qr(random(3, 3)).Q
        action = primitive.action(turn)
        torch.testing.assert_close(action @ action.mT, torch.eye(primitive.width).double())
        x = random(5, 2)
        torch.testing.assert_close(primitive.raw(x).norm(dim=-1), homogeneous(x).norm(dim=-1) ** degree)
