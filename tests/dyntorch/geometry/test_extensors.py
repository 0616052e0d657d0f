"""Extensors against determinants one by one, Cauchy-Binet, incidence of points, lines and planes, spans by the SVD."""

from itertools import combinations, permutations
from math import comb

import pytest
import torch

from dyntorch.geometry.extensors import (
    check_extensor,
    compound,
    dual,
    extensor_of,
    join,
    levi_civita,
    meet,
    plucker,
    plucker_form,
    subspace_of,
    wedge,
)
from dyntorch.geometry.homogeneous import apply, homogeneous, inhomogeneous
from tests.grid import grid


def random(*shape, seed=0, dtype=torch.float64):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def minors(matrix, order):
    """Reference: every minor of one matrix by its own determinant."""
    rows, columns = (list(combinations(range(n), order)) for n in matrix.shape)
    return torch.tensor([[torch.linalg.det(matrix[list(r)][:, list(c)]) for c in columns] for r in rows], dtype=matrix.dtype)


@grid(("n", [1, 2, 3, 4]))
def test_levi_civita_computes_determinants(n):
    e, m = levi_civita(n), random(n, n)
    assert int(e.abs().sum()) == len(list(permutations(range(n))))
    value = e
    for row in m:
        value = torch.tensordot(row, value, dims=([0], [0]))
    torch.testing.assert_close(value, torch.linalg.det(m))


def test_levi_civita_is_cached_and_safe_for_gradients():
    with torch.inference_mode():
        first = levi_civita(3, dtype=torch.float32)
    assert levi_civita(3, dtype=torch.float32) is first
    x = torch.ones(3, requires_grad=True)
    torch.einsum("ijk,i,j->k", first, x, x).sum().backward()
    assert x.grad.isfinite().all()
    assert levi_civita(3).dtype == torch.float64
    for n in (0, 7):
        with pytest.raises(ValueError, match="n must be 1 to 6"):
            levi_civita(n)


@grid((("rows", "columns", "order"), [(4, 4, 1), (4, 4, 2), (4, 4, 3), (4, 4, 4), (3, 5, 2), (6, 4, 3), (2, 7, 2)]))
def test_compound_holds_every_minor(rows, columns, order):
    m = random(2, 3, rows, columns)
    c = compound(m, order)
    for i in range(2):
        for j in range(3):
            torch.testing.assert_close(c[i, j], minors(m[i, j], order))


@pytest.mark.parametrize("order", [1, 2, 3])
def test_cauchy_binet(order):
    a, b = random(5, 4, 6), random(5, 6, 3, seed=1)
    torch.testing.assert_close(compound(a @ b, order), compound(a, order) @ compound(b, order), rtol=1e-10, atol=1e-10)


def test_compound_of_the_inverse_and_of_the_identity():
    a = random(5, 4, 4)
    torch.testing.assert_close(compound(torch.linalg.inv(a), 2), torch.linalg.inv(compound(a, 2)), rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(compound(torch.eye(5), 3), torch.eye(10))
    # Sylvester-Franke: det C_k(A) = det(A)^binomial(n-1, k-1)
    torch.testing.assert_close(torch.linalg.det(compound(a, 2)), torch.linalg.det(a) ** 3, rtol=1e-9, atol=1e-9)


def test_compound_is_exact_on_integers_and_differentiable_at_any_rank():
    m = torch.tensor([[2.0, 3.0, 5.0], [7.0, 11.0, 13.0], [17.0, 19.0, 23.0]])
    assert compound(m, 3).item() == -78.0
    assert compound(m.long(), 3).dtype == torch.int64 and compound(m.long(), 3).item() == -78
    assert torch.autograd.gradcheck(lambda x: compound(x, 3), random(4, 4).requires_grad_())
    flat = (random(4, 1) @ random(1, 4, seed=1)).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: compound(x, 3), flat)


@pytest.mark.parametrize("order", [0, 4])
def test_compound_refuses_orders_without_minors(order):
    with pytest.raises(ValueError, match="order must be"):
        compound(random(3, 5), order)


@grid(("d", [1, 2, 3, 6]))
def test_join_of_two_points(d):
    p, q = random(4, 5, d + 1), random(4, 5, d + 1, seed=1)
    expected = torch.stack([p[..., i] * q[..., j] - p[..., j] * q[..., i] for i, j in combinations(range(d + 1), 2)], -1)
    torch.testing.assert_close(join(p, q), expected)
    torch.testing.assert_close(join(q, p), -expected)
    assert join(p, 2 * p).abs().max() == 0


def test_join_of_all_is_the_determinant_and_batches_broadcast():
    points = random(4, 6, 4)
    torch.testing.assert_close(join(*points)[..., 0], torch.linalg.det(points.movedim(0, -2)))
    assert torch.equal(join(points[0], points[1, 0]), join(points[0], points[1, 0].expand(6, 4)))
    assert torch.equal(join(points[0]), points[0])


@pytest.mark.parametrize("sizes", [(), (3, 4), (2, 2, 2)])
def test_join_and_meet_refuse_other_arguments(sizes):
    with pytest.raises(ValueError, match="join takes"):
        join(*(random(s) for s in sizes))
    with pytest.raises(ValueError, match="meet takes"):
        meet(*(random(s) for s in sizes))


def test_meet_of_lines_and_planes():
    a, b, c = random(3, 7, 3)
    torch.testing.assert_close(meet(a, b), torch.linalg.cross(a, b))
    torch.testing.assert_close(
        meet(join(a, b).flip(-1) * a.new_tensor([1, -1, 1]), c), torch.linalg.cross(torch.linalg.cross(a, b), c)
    )
    planes = random(3, 7, 4, seed=1)
    point = meet(*planes)
    assert (planes * point).sum(-1).abs().max() < 1e-13
    assert torch.equal(meet(planes[0]), dual(planes[0], 4, 1))


def test_meets_of_extensors_are_the_shuffle_formula():
    """The meet of joins, dual to the join of the duals, is the sum of det(part of A, B) times the rest of A over all shuffles."""
    for n, k, m in ((3, 2, 2), (4, 3, 2), (4, 2, 3), (4, 3, 3), (5, 3, 3), (5, 4, 2)):
        a, b = random(k, n, seed=n), random(m, n, seed=10 * k + m)
        A, B = join(*a), join(*b)
        rest = k + m - n
        shuffles = torch.zeros(comb(n, rest), dtype=torch.float64)
        for chosen in combinations(range(k), n - m):
            others = [i for i in range(k) if i not in chosen]
            sign = (-1) ** sum(x > y for x, y in combinations((*chosen, *others), 2))
            det = torch.linalg.det(torch.cat([a[list(chosen)], b]))
            shuffles += sign * det * (join(*a[others]) if others else 1.0)
        found = dual(wedge(dual(A, n, k), dual(B, n, m), n, (n - k, n - m)), n, 2 * n - k - m)
        torch.testing.assert_close(found * (found @ shuffles).sign(), shuffles, rtol=1e-9, atol=1e-12)
        if rest == 1:  # the common point lies in both
            assert all(wedge(found, E, n, (1, step)).abs().max() < 1e-12 * E.norm() for E, step in ((A, k), (B, m)) if step < n)


def test_meet_of_two_planes_is_the_join_of_two_of_their_points():
    p, q, r, s = (homogeneous(x) for x in random(4, 6, 3))
    line = join(p, q)
    other = meet(meet_of_points(p, q, r), meet_of_points(p, q, s))
    scale = (line * other).sum(-1, keepdim=True) / (line * line).sum(-1, keepdim=True)
    torch.testing.assert_close(other, scale * line, rtol=1e-9, atol=1e-9)


def meet_of_points(p, q, r):
    """The plane through three points, from the null space of their matrix."""
    return torch.linalg.svd(torch.stack([p, q, r], -2)).Vh[..., -1, :]


def test_dual_twice_is_the_extensor_up_to_the_known_sign():
    for size, step in [(3, 1), (3, 2), (4, 1), (4, 2), (4, 3), (7, 2)]:
        x = join(*random(step, 5, size))
        twice = dual(dual(x, size, step), size, size - step)
        assert torch.equal(twice, (-1.0) ** (step * (size - step)) * x)
    with pytest.raises(ValueError, match="has 6 entries, got 4"):
        dual(random(4), 4, 2)
    with pytest.raises(ValueError, match="has no entries, got 4"):
        dual(random(4), 4, -1)


def test_dual_completes_to_the_squared_norm():
    for size, step in [(3, 2), (4, 3)]:
        points = random(step, size)
        x = join(*points)
        torch.testing.assert_close(join(*points, dual(x, size, step))[0], (x * x).sum())


def test_plucker_form_is_the_determinant_of_the_four_points():
    pair = random(8, 2, 2, 3)
    lines = plucker(pair)
    assert lines.shape == (8, 2, 6)
    det = torch.linalg.det(homogeneous(pair).reshape(8, 4, 4))
    torch.testing.assert_close(torch.einsum("ni,ij,nj->n", lines[:, 0], plucker_form(), lines[:, 1]), det)
    j = plucker_form()
    torch.testing.assert_close(j @ j, torch.eye(6, dtype=torch.float64))
    assert torch.einsum("nki,ij,nkj->nk", lines, j, lines).abs().max() < 1e-13


def test_plucker_lines_map_by_the_second_compound():
    a, pair = random(5, 4, 4), random(5, 9, 2, 3, seed=1)
    c, j = compound(a, 2), plucker_form()
    mapped = homogeneous(pair) @ a.mT[:, None]
    torch.testing.assert_close((plucker(pair) @ c.mT), join(mapped[..., 0, :], mapped[..., 1, :]))
    torch.testing.assert_close(c.mT @ j @ c, torch.linalg.det(a)[:, None, None] * j, rtol=1e-9, atol=1e-9)
    # the same line through the inhomogeneous images of its points
    other = plucker(apply(a, pair.flatten(1, 2)).unflatten(1, (9, 2)))
    cosine = torch.nn.functional.cosine_similarity(plucker(pair) @ c.mT, other, dim=-1)
    torch.testing.assert_close(cosine.abs(), torch.ones(5, 9, dtype=torch.float64))
    assert torch.equal(inhomogeneous(homogeneous(pair)), pair)


def test_plucker_refuses_other_shapes_and_keeps_the_dtype():
    with pytest.raises(ValueError, match="two points of each line"):
        plucker(random(5, 6))
    assert plucker(random(5, 2, 3, dtype=torch.float32)).dtype == torch.float32
    assert plucker_form(dtype=torch.float32).dtype == torch.float32


# --- products of extensors of any step, and the subspaces they stand for


def sine(first, second):
    """Sine of the largest angle between two row spaces of one dimension."""
    q, r = (torch.linalg.qr(x.mT).Q for x in (first, second))
    return torch.linalg.matrix_norm(q - r @ (r.mT @ q), 2)


def brute_wedge(left, right, size, a, b):
    """Reference: the coefficients of the product of two forms, term by term."""
    result = dict.fromkeys(combinations(range(size), a + b), 0.0)
    for i, s in enumerate(combinations(range(size), a)):
        for j, t in enumerate(combinations(range(size), b)):
            if not set(s) & set(t):
                sign = (-1) ** sum(x > y for x, y in combinations(s + t, 2))
                result[tuple(sorted(s + t))] += sign * float(left[i] * right[j])
    return torch.tensor(list(result.values()), dtype=torch.float64)


def test_wedge_of_any_extensors_term_by_term():
    for size, a, b in [(4, 2, 2), (5, 2, 1), (5, 1, 3), (6, 3, 2), (6, 2, 4), (4, 0, 2)]:
        left, right = random(comb(size, a)), random(comb(size, b), seed=1)
        torch.testing.assert_close(wedge(left, right, size, (a, b)), brute_wedge(left, right, size, a, b), msg=f"{size, a, b}")


@pytest.mark.parametrize("size", range(4, 10))
def test_join_spans_both(size):
    others = sorted({1, 2, size // 2, size - 2, size - 1})
    failures = []
    for a, b in [(a, b) for a in range(1, size) for b in others if a + b <= size]:
        first, second = random(2, a, size), random(2, b, size, seed=1)
        both = torch.cat([first, second], -2)
        product = wedge(extensor_of(first), extensor_of(second), size, (a, b))
        exchanged = wedge(extensor_of(second), extensor_of(first), size, (b, a))
        expected = {"minors": (product, compound(both, a + b)[..., 0, :]), "order": (exchanged, (-1) ** (a * b) * product)}
        failures += [(size, a, b, name) for name, pair in expected.items() if not torch.allclose(*pair, rtol=1e-9, atol=1e-10)]
        if not (sine(subspace_of(product, size, a + b), both) < 1e-9).all():
            failures.append((size, a, b, "span"))
    assert failures == []


def test_complementary_steps_join_in_the_determinant():
    for size, a, b in [(4, 2, 2), (5, 2, 3), (5, 4, 1), (6, 3, 3), (7, 3, 4)]:
        first, second = random(a, size), random(b, size, seed=1)
        det = torch.linalg.det(torch.cat([first, second]))
        torch.testing.assert_close(wedge(extensor_of(first), extensor_of(second), size, (a, b)), det[None], msg=f"{size, a, b}")


def test_joins_vanish_outside_general_position():
    p, q = random(2, 5)
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


def test_batches_broadcast_and_gradients_exist_in_every_mode():
    left, right = random(3, 1, 10), random(4, 5, seed=1)  # steps 2 and 1 of 5
    product = wedge(left, right, 5, (2, 1))
    assert product.shape == (3, 4, 10)
    torch.testing.assert_close(product[2, 1], wedge(left[2, 0], right[1], 5, (2, 1)))
    x, y = left[0, 0].clone().requires_grad_(), right[0].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda x, y: wedge(x, y, 5, (2, 1)), (x, y), check_forward_ad=True)
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
