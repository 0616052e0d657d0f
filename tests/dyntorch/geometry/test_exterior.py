"""Joins and meets of extensors of any step against the spans and intersections of their subspaces by the SVD."""

from itertools import combinations, permutations
from math import comb

import pytest
import torch

from dyntorch.geometry.extensors import check_extensor, compound, dual, extensor_of, join, meet, regressive, subspace_of, wedge

STEPS = [(n, a, b) for n in range(4, 10) for a in range(1, n) for b in sorted({1, 2, n // 2, n - 2, n - 1})]


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def sine(first, second):
    """Sine of the largest angle between two row spaces of one dimension."""
    q, r = (torch.linalg.qr(x.mT).Q for x in (first, second))
    return torch.linalg.matrix_norm(q - r @ (r.mT @ q), 2)


def intersection(first, second):
    """Reference: vectors u = A^T x = B^T y, from the last right singular vectors of [A^T, -B^T]."""
    c = first.shape[-2] + second.shape[-2] - first.shape[-1]
    vh = torch.linalg.svd(torch.cat([first.mT, -second.mT], -1)).Vh
    return vh[..., -c:, : first.shape[-2]] @ first


def brute_wedge(left, right, size, a, b):
    """Reference: the coefficients of the product of two forms, term by term."""
    result = dict.fromkeys(combinations(range(size), a + b), 0.0)
    for i, s in enumerate(combinations(range(size), a)):
        for j, t in enumerate(combinations(range(size), b)):
            if not set(s) & set(t):
                sign = (-1) ** sum(x > y for x, y in combinations(s + t, 2))
                result[tuple(sorted(s + t))] += sign * float(left[i] * right[j])
    return torch.tensor(list(result.values()), dtype=torch.float64)


@pytest.mark.parametrize(("size", "a", "b"), [(4, 2, 2), (5, 2, 1), (5, 1, 3), (6, 3, 2), (6, 2, 4), (4, 0, 2)])
def test_wedge_of_any_extensors_term_by_term(size, a, b):
    left, right = random(comb(size, a)), random(comb(size, b), seed=1)
    torch.testing.assert_close(wedge(left, right, size, (a, b)), brute_wedge(left, right, size, a, b))


@pytest.mark.parametrize(("size", "a", "b"), [s for s in STEPS if s[1] + s[2] <= s[0]])
def test_join_spans_both(size, a, b):
    first, second = random(2, a, size), random(2, b, size, seed=1)
    both = torch.cat([first, second], -2)
    joined = wedge(extensor_of(first), extensor_of(second), size, (a, b))
    torch.testing.assert_close(joined, compound(both, a + b)[..., 0, :], rtol=1e-9, atol=1e-10)
    torch.testing.assert_close(
        wedge(extensor_of(second), extensor_of(first), size, (b, a)), (-1) ** (a * b) * joined, rtol=1e-9, atol=1e-10
    )
    assert (sine(subspace_of(joined, size, a + b), both) < 1e-9).all()


@pytest.mark.parametrize(("size", "a", "b"), [s for s in STEPS if s[1] + s[2] > s[0]])
def test_meet_is_the_intersection(size, a, b):
    first, second = random(2, a, size), random(2, b, size, seed=1)
    met = regressive(extensor_of(first), extensor_of(second), size, (a, b))
    c = a + b - size
    basis = subspace_of(met, size, c)
    assert basis.shape == (2, c, size)
    torch.testing.assert_close(basis @ basis.mT, torch.eye(c, dtype=torch.float64).expand(2, c, c))
    assert (sine(basis, intersection(first, second)) < 1e-9).all()
    swapped = regressive(extensor_of(second), extensor_of(first), size, (b, a))
    torch.testing.assert_close(swapped, (-1) ** ((size - a) * (size - b)) * met, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("size", range(4, 8))
def test_meet_agrees_with_the_meet_of_hyperplanes_without_a_sign(size):
    planes = random(3, 2, size)
    first, second, third = (meet(h) for h in planes)
    line = regressive(first, second, size, (size - 1, size - 1))
    torch.testing.assert_close(line, meet(planes[0], planes[1]))
    expected = meet(*planes)
    torch.testing.assert_close(regressive(line, third, size, (size - 2, size - 1)), expected)
    other = regressive(second, third, size, (size - 1, size - 1))
    torch.testing.assert_close(regressive(first, other, size, (size - 1, size - 2)), expected)  # associative


@pytest.mark.parametrize(("size", "a", "b"), [(4, 2, 2), (5, 2, 3), (5, 4, 1), (6, 3, 3), (7, 3, 4)])
def test_complementary_steps_meet_in_the_determinant(size, a, b):
    first, second = random(a, size), random(b, size, seed=1)
    det = torch.linalg.det(torch.cat([first, second]))
    for product in (wedge, regressive):
        torch.testing.assert_close(product(extensor_of(first), extensor_of(second), size, (a, b)), det[None])


@pytest.mark.parametrize(("size", "a", "b"), [(4, 3, 2), (5, 3, 3), (6, 4, 4), (6, 5, 3)])
def test_meet_by_the_shuffle_formula(size, a, b):
    """Grassmann-Cayley: A ^ B = sum over the splits of A of sign * [A_1 v B] A_2, with steps n - b and a + b - n."""
    first, second = random(a, size), random(b, size, seed=1)
    head = size - b
    total = torch.zeros(comb(size, a - head), dtype=torch.float64)
    for taken in combinations(range(a), head):
        rest = [i for i in range(a) if i not in taken]
        sign = (-1) ** sum(x > y for x, y in combinations([*taken, *rest], 2))
        total += sign * torch.linalg.det(torch.cat([first[list(taken)], second])) * extensor_of(first[rest])
    met = regressive(extensor_of(first), extensor_of(second), size, (a, b))
    torch.testing.assert_close(met, total)


def test_products_vanish_outside_general_position():
    p, q, r, s = random(4, 5)
    first, second = torch.stack([p, q, r]), torch.stack([p, q, s])  # two planes of P^4 that share a line, not just a point
    assert regressive(extensor_of(first), extensor_of(second), 5, (3, 3)).abs().max() < 1e-12
    line, point = extensor_of(torch.stack([p, q])), p + 2 * q
    assert wedge(line, point, 5, (2, 1)).abs().max() < 1e-12
    assert extensor_of(torch.stack([p, q, p - q])).abs().max() < 1e-12


def test_subspace_of_inverts_extensor_of():
    basis = random(3, 2, 4, 7)
    extensor = extensor_of(basis)
    assert extensor.shape == (3, 2, 35)
    found = subspace_of(extensor, 7, 4)
    assert (sine(found, basis) < 1e-10).all()
    again = extensor_of(found)
    correlation = torch.nn.functional.cosine_similarity(again, extensor, dim=-1).abs()
    torch.testing.assert_close(correlation, torch.ones(3, 2, dtype=torch.float64))
    assert sine(subspace_of(extensor[1, 1], 7, 4), found[1, 1]) < 1e-10
    torch.testing.assert_close(subspace_of(random(2, 1), 4, 4), torch.eye(4, dtype=torch.float64).expand(2, 4, 4))
    # the complement of the subspace has the dual extensor
    assert (found @ subspace_of(dual(extensor, 7, 4), 7, 3).mT).abs().max() < 1e-10


def test_only_joins_have_the_subspace_of_their_step():
    """Decomposable iff u -> A v u has a null space of the step; for step 2 iff A v A = 0 (Grassmann-Pluecker)."""

    def singular(extensor):
        eye = torch.eye(6, dtype=torch.float64)
        return torch.linalg.svdvals(wedge(extensor[None], eye, 6, (2, 1)))

    line, other = extensor_of(random(2, 6)), extensor_of(random(2, 6, seed=1))
    assert singular(line)[-2] < 1e-12 and wedge(line, line, 6, (2, 2)).abs().max() < 1e-12
    assert singular(line + other)[-2] > 1e-2 and wedge(line + other, line + other, 6, (2, 2)).abs().max() > 1e-2


def test_collineations_act_by_their_compound():
    h, first, second = random(6, 6), random(4, 6), random(3, 6, seed=1)
    met = regressive(extensor_of(first), extensor_of(second), 6, (4, 3))
    moved = regressive(extensor_of(first @ h.mT), extensor_of(second @ h.mT), 6, (4, 3))
    torch.testing.assert_close(moved, torch.linalg.det(h) * met @ compound(h, 1).mT, rtol=1e-9, atol=1e-9)


def test_batches_broadcast_and_gradients_exist_in_every_mode():
    left, right = random(3, 1, 10), random(4, 10, seed=1)  # step 3 and step 2 of 5
    met = regressive(left, right, 5, (3, 3))
    assert met.shape == (3, 4, 5)
    torch.testing.assert_close(met[2, 1], regressive(left[2, 0], right[1], 5, (3, 3)))
    x, y = left[0, 0].clone().requires_grad_(), right[0].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda x, y: regressive(x, y, 5, (3, 3)), (x, y), check_forward_ad=True)
    basis = random(2, 4).requires_grad_()

    def projector(b):
        u = subspace_of(extensor_of(b), 4, 2)
        return u.mT @ u

    assert torch.autograd.gradcheck(projector, basis)


def test_tables_made_in_inference_mode_serve_gradients():
    with torch.inference_mode():
        wedge(random(8), random(28, seed=1), 8, (1, 2))
    x = random(8).requires_grad_()
    wedge(x, random(28, seed=1), 8, (1, 2)).sum().backward()
    assert x.grad.isfinite().all()


def test_join_of_points_is_the_same_in_any_order_up_to_the_sign():
    points = random(3, 5)
    for order in permutations(range(3)):
        product = wedge(wedge(points[order[0]], points[order[1]], 5, (1, 1)), points[order[2]], 5, (2, 1))
        sign = (-1) ** sum(x > y for x, y in combinations(order, 2))
        torch.testing.assert_close(product, sign * join(*points))


def test_misuse_is_refused():
    with pytest.raises(ValueError, match=r"steps \(3, 3\) do not fit into 5"):
        wedge(random(10), random(10), 5, (3, 3))
    with pytest.raises(ValueError, match=r"sum must reach 5"):
        regressive(random(10), random(5), 5, (2, 1))
    with pytest.raises(ValueError, match="has 10 entries, got 9"):
        check_extensor(random(9), 5, 2)
    with pytest.raises(ValueError, match="has no entries"):
        wedge(random(9), random(1), 5, (6, 1))
    with pytest.raises(ValueError, match="has 10 entries"):
        subspace_of(random(4), 5, 2)
    for step in (0, 6):
        with pytest.raises(ValueError, match="step must be 1 to 5"):
            subspace_of(random(1), 5, step)
    for shape in [(4, 3), (0, 3), (3,)]:
        with pytest.raises(ValueError, match="basis must be"):
            extensor_of(random(*shape))
