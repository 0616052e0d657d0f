"""Monomials of points: values one by one, the action of collineations, derivatives by autograd, rotations."""

from itertools import combinations_with_replacement

import pytest
import torch

from dyntorch.core.primitives import Monomials
from dyntorch.geometry.homogeneous import collecting, monomial_derivatives, monomials, multiplicity, symmetric

ALL = [Monomials(d, k, isometric) for d in (1, 2, 3) for k in (1, 2, 4) for isometric in (False, True)]


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def lift(x):
    return torch.cat([x, torch.ones_like(x[..., :1])], dim=-1)


@pytest.mark.parametrize("primitive", ALL)
def test_values_and_shapes(primitive):
    x = random(2, 5, primitive.dim)
    products = [torch.stack([lift(x)[..., i] for i in place], -1).prod(-1) for place in places(primitive)]
    counts = [len(set(permutations(place))) for place in places(primitive)]
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


def places(primitive):
    return list(combinations_with_replacement(range(primitive.dim + 1), primitive.degree))


def permutations(place):
    if len(place) < 2:
        return [place]
    return [(place[i], *rest) for i in range(len(place)) for rest in permutations(place[:i] + place[i + 1 :])]


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
    moved = lift(x) @ frames.mT
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
        torch.testing.assert_close(primitive.raw(x).norm(dim=-1), lift(x).norm(dim=-1) ** degree)
