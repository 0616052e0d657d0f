"""Extensors against determinants one by one, Cauchy-Binet, incidence of points, lines and planes, spans by the SVD."""

from itertools import combinations, permutations
from math import comb

import pytest
import torch

from dyntorch.geometry.extensors import (
    camera_of_lines,
    cameras_of_lines,
    check_extensor,
    compound,
    dual,
    extensor_of,
    join,
    klein_frame,
    levi_civita,
    line_camera,
    lines_of_pencil,
    meet,
    nearest_line,
    plucker,
    plucker_form,
    subspace_of,
    wedge,
)
from dyntorch.geometry.homogeneous import apply, homogeneous, inhomogeneous
from dyntorch.metrics import relative_error
from tests.draws import random
from tests.grid import assert_refused, grid


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


def test_tables_are_cached_and_those_of_inference_mode_serve_gradients():
    with torch.inference_mode():
        first = levi_civita(3, dtype=torch.float32)
        wedge(random(8), random(28, seed=1), 8, (1, 2))
    assert levi_civita(3, dtype=torch.float32) is first
    x = torch.ones(3, requires_grad=True)
    torch.einsum("ijk,i,j->k", first, x, x).sum().backward()
    assert x.grad.isfinite().all()
    assert levi_civita(3).dtype == torch.float64
    x = random(8).requires_grad_()
    wedge(x, random(28, seed=1), 8, (1, 2)).sum().backward()
    assert x.grad.isfinite().all()


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


def test_compound_is_exact_on_integers_and_differentiable_at_any_rank():
    m = torch.tensor([[2.0, 3.0, 5.0], [7.0, 11.0, 13.0], [17.0, 19.0, 23.0]])
    assert compound(m, 3).item() == -78.0
    assert compound(m.long(), 3).dtype == torch.int64 and compound(m.long(), 3).item() == -78
    assert torch.autograd.gradcheck(lambda x: compound(x, 3), random(4, 4).requires_grad_())
    flat = (random(4, 1) @ random(1, 4, seed=1)).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: compound(x, 3), flat)


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


def test_wedges_and_duals_of_any_extensors():
    for size, step in [(3, 1), (3, 2), (4, 1), (4, 2), (4, 3), (7, 2)]:
        x = join(*random(step, 5, size))
        twice = dual(dual(x, size, step), size, size - step)
        assert torch.equal(twice, (-1.0) ** (step * (size - step)) * x)
        # with the extensor it spans everything, at the squared norm
        torch.testing.assert_close(wedge(x, dual(x, size, step), size, (step, size - step))[..., 0], (x * x).sum(-1))
    for size, a, b in [(4, 2, 2), (5, 2, 1), (5, 1, 3), (6, 3, 2), (6, 2, 4), (4, 0, 2)]:
        left, right = random(comb(size, a)), random(comb(size, b), seed=1)
        torch.testing.assert_close(wedge(left, right, size, (a, b)), brute_wedge(left, right, size, a, b), msg=f"{size, a, b}")


def test_plucker_form_is_the_determinant_of_the_four_points():
    pair = random(8, 2, 2, 3)
    lines = plucker(pair)
    assert lines.shape == (8, 2, 6) and plucker(pair.float()).dtype == plucker_form(dtype=torch.float32).dtype == torch.float32
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


# Line cameras against images of points, the way back to cameras, and the Klein quadric against the definition of a line.


J = plucker_form()


def misfit(cameras, found):
    """Reference: residual of the best T with found_i ~ cameras_i T, all of norm 1, and the gap to the next best."""
    views = len(cameras)
    unit = [c / c.norm() for c in cameras], [f / f.norm() for f in found]
    rows = torch.zeros(views, 12, 16 + views, dtype=torch.float64)
    for i in range(views):
        rows[i, :, :16] = torch.kron(unit[0][i].contiguous(), torch.eye(4, dtype=torch.float64))
        rows[i, :, 16 + i] = -unit[1][i].flatten()
    values = torch.linalg.svdvals(rows.flatten(0, 1))
    return float(values[-1]), float(values[-2])


def test_a_line_camera_maps_joins_to_cross_products():
    P, A, B = random(5, 3, 4), random(5, 4, seed=1), random(5, 4, seed=2)
    image = torch.linalg.cross((P @ A[..., None])[..., 0], (P @ B[..., None])[..., 0])
    torch.testing.assert_close((line_camera(P) @ join(A, B)[..., None])[..., 0], image)
    # the rows are isotropic; what has no image passes through the centre
    assert (line_camera(P) @ J @ line_camera(P).mT).abs().max() < 1e-12
    centre = torch.linalg.svd(P).Vh[:, -1]
    assert (line_camera(P) @ join(centre, A)[..., None]).abs().max() < 1e-12


@pytest.mark.parametrize("scale", [1.0, -3.0])
def test_camera_of_lines_is_the_inverse(scale):
    P = random(7, 2, 3, 4)
    found = camera_of_lines(scale * line_camera(P))
    assert relative_error(found, P).max() < 1e-9
    torch.testing.assert_close(found.flatten(-2).norm(dim=-1), torch.ones(7, 2, dtype=torch.float64))
    # what is no camera is data
    bad = torch.stack([line_camera(P[0, 0]), torch.full((3, 6), torch.nan).double(), torch.zeros(3, 6).double()])
    assert camera_of_lines(bad)[0].abs().max() > 0
    assert not camera_of_lines(bad)[1:].any()


@pytest.mark.parametrize("views", [5, 6, 9])
def test_cameras_come_back_from_a_collineation_of_p5(views):
    cameras, H, scale = random(8, views, 3, 4), random(8, 6, 6, seed=1), random(8, views, 1, 1, seed=2)
    seen = line_camera(cameras) @ H[:, None] * scale
    found = cameras_of_lines(seen)
    for one, other, several in zip(cameras, found, seen, strict=True):
        residual, gap = misfit(one, other)
        assert residual < 1e-10 < 1e-2 < gap
        torch.testing.assert_close(cameras_of_lines(several), other, rtol=1e-6, atol=1e-8)


def test_correlations_are_recognised():
    cameras = random(6, 3, 4)
    # J makes lines through a point lines in a plane
    assert misfit(cameras, cameras_of_lines(line_camera(cameras) @ J))[0] < 1e-12
    assert misfit(cameras, cameras_of_lines(line_camera(cameras)))[0] < 1e-12


def test_four_views_leave_a_family_of_quadrics_and_five_do_not():
    i, j = torch.triu_indices(6, 6)
    for views, rank in ((3, 15), (4, 18), (5, 20), (6, 20)):
        M = line_camera(random(views, 3, 4)) @ random(6, 6, seed=1)
        rows = [((a[i] * b[j] + a[j] * b[i]) / (1 + (i == j).double())) for m in M for a in m for b in m]
        assert int(torch.linalg.matrix_rank(torch.stack(rows), rtol=1e-9)) == rank


def test_frames_of_bad_projections_are_zero_and_harm_no_other():
    good = line_camera(random(6, 3, 4))
    flat = good.clone()
    flat[..., 0] = 0
    found = klein_frame(torch.stack([good, good * torch.nan, flat, torch.zeros_like(good)]))
    torch.testing.assert_close(found[0], klein_frame(good))
    assert not found[1:].any()


def test_nearest_line_is_on_the_quadric_and_nearest():
    v = random(50, 6)
    line = nearest_line(v)
    assert ((line @ J) * line).sum(-1).abs().max() < 1e-14
    torch.testing.assert_close(line.norm(dim=-1), torch.ones(50, dtype=torch.float64))
    # reference: the best of many lines, and the line itself where it is one
    others = torch.nn.functional.normalize(join(random(20000, 4, seed=1), random(20000, 4, seed=2)), dim=-1)
    unit = torch.nn.functional.normalize(v, dim=-1)
    assert ((unit @ others.T).abs().amax(-1) <= (unit * line).sum(-1) + 1e-12).all()
    torch.testing.assert_close(nearest_line(3 * others[:9]), others[:9])
    assert not nearest_line(J[0] + torch.eye(6)[0].double()).any()


def test_a_pencil_of_complexes_has_two_lines_or_none():
    first, second = (torch.nn.functional.normalize(join(random(4, seed=s), random(4, seed=s + 9)), dim=-1) for s in (1, 2))
    basis = torch.linalg.qr(torch.stack([first, second], dim=-1)).Q.T
    lines, real = lines_of_pencil(*basis)
    assert bool(real)
    assert min(relative_error(lines, torch.stack(pair), dims=1).max() for pair in ((first, second), (second, first))) < 1e-7
    plus = torch.eye(6, dtype=torch.float64)[:2] @ (torch.eye(6) + J) / 2**0.5
    lines, real = lines_of_pencil(*plus)  # positive for the form: no line in it
    assert not bool(real)
    assert bool(lines.isfinite().all())


def test_gradients():
    P = random(3, 4).requires_grad_()
    assert torch.autograd.gradcheck(line_camera, P)
    assert torch.autograd.gradcheck(lambda p: camera_of_lines(line_camera(p)), P)
    assert torch.autograd.gradcheck(nearest_line, random(3, 6).requires_grad_())


def test_misuse():
    assert_refused(
        *((lambda n=n: levi_civita(n), "n must be 1 to 6") for n in (0, 7)),
        *((lambda order=order: compound(random(3, 5), order), "order must be") for order in (0, 4)),
        *((lambda sizes=sizes: join(*map(random, sizes)), "join takes") for sizes in ((), (3, 4), (2, 2, 2))),
        *((lambda sizes=sizes: meet(*map(random, sizes)), "meet takes") for sizes in ((), (3, 4), (2, 2, 2))),
        (lambda: dual(random(4), 4, 2), "has 6 entries, got 4"),
        (lambda: dual(random(4), 4, -1), "has no entries, got 4"),
        (lambda: plucker(random(5, 6)), "two points of each line"),
        (lambda: wedge(random(10), random(10), 5, (3, 3)), r"steps \(3, 3\) do not fit into 5"),
        (lambda: check_extensor(random(9), 5, 2), "has 10 entries, got 9"),
        (lambda: wedge(random(9), random(1), 5, (6, 1)), "has no entries"),
        (lambda: subspace_of(random(4), 5, 2), "has 10 entries"),
        *((lambda step=step: subspace_of(random(1), 5, step), "step must be 1 to 5") for step in (0, 6)),
        *((lambda shape=shape: extensor_of(random(*shape)), "basis must be") for shape in ((4, 3), (0, 3), (3,))),
        (lambda: line_camera(torch.zeros(4, 3)), "camera must be"),
        (lambda: camera_of_lines(torch.zeros(3, 4)), "matrix must be"),
        *((lambda shape=shape: klein_frame(torch.zeros(shape)), "5 or more views") for shape in ((4, 3, 6), (6, 3, 4), (3, 6))),
    )
