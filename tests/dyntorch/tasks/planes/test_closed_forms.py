"""Closed forms of translating planes: pencils of rank one, parts of planes, and the homography at infinity by every method."""

import pytest
import torch

from dyntorch.geometry.homogeneous import rank_one, skew
from dyntorch.tasks.planes import closed_forms
from dyntorch.tasks.planes.closed_forms import (
    infinity_closed_form,
    infinity_from_fundamentals,
    infinity_from_mixed,
    infinity_linear,
    infinity_thesis,
    plane_parts,
    rank_one_scale,
    second_singular_value,
    unit_determinant,
)
from tests.draws import random


def planes(*batch, n=4, f=0, kind="generic", seed=0):
    """Homographies of determinant 1, the homography at infinity, epipoles, normals, and f fundamental matrices of other bodies."""
    infinity = torch.eye(3).double() + 0.4 * random(*batch, 3, 3, seed=seed)
    e, v = 0.4 * random(*batch, n, 3, seed=seed + 1), 0.8 * random(*batch, n, 3, seed=seed + 2)
    if kind in {"collinear", "both"}:
        e = e[..., :2] @ random(*batch, 2, 3, seed=seed + 3)
    if kind in {"coplanar", "both"}:
        v = v[..., :2] @ random(*batch, 2, 3, seed=seed + 4)
    bodies = {"pair": [0, 0, *range(2, n)], "triple": [0, 0, 0, *range(3, n)]}.get(kind, list(range(n)))
    e = e[..., bodies, :]
    if kind == "static":
        e[..., 0, :] = 0
    homographies = infinity[..., None, :, :] + e[..., :, None] * v[..., None, :]
    det = torch.linalg.det(homographies)[..., None, None]
    fundamentals = skew(random(*batch, f, 3, seed=seed + 5)) @ infinity[..., None, :, :]
    return homographies / (det.sign() * det.abs() ** (1 / 3)), infinity, e, v, fundamentals


def error(found, true):
    """Distance ``(*batch,)`` of matrices up to scale."""
    a, b = (x / torch.linalg.matrix_norm(x, keepdim=True) for x in (found, true))
    return torch.minimum(torch.linalg.matrix_norm(a - b), torch.linalg.matrix_norm(a + b))


def test_determinants_of_one_and_singular_values():
    matrices = torch.cat([random(5, 3, 3), torch.zeros(1, 3, 3).double(), torch.diag(torch.tensor([5.0, 2, 0]))[None].double()])
    found = unit_determinant(matrices)
    torch.testing.assert_close(torch.linalg.det(found[:5]), torch.ones(5).double())
    assert error(found[:5], matrices[:5]).max() < 1e-12
    assert (found[5] == 0).all() and abs(found[6].norm() - 1) < 1e-12
    matrix = random(30, 3, 3)
    values = torch.linalg.svdvals(matrix)
    found = second_singular_value(matrix)
    assert (found >= values[:, 1] / 2**0.5 - 1e-12).all() and (found <= (values[:, 1:].square().sum(-1)).sqrt() + 1e-12).all()
    u, s, vh = torch.linalg.svd(random(30, 3, 1) * random(30, 1, 3, seed=1) + 0.1 * matrix)
    left, right = rank_one(u @ torch.diag_embed(s) @ vh)
    torch.testing.assert_close(left[..., None] * right[:, None], s[:, :1, None] * u[..., :1] * vh[:, :1], atol=1e-8, rtol=1e-8)


@pytest.mark.parametrize("shape", [(2, 3), (3, 3)])
def test_the_scale_of_a_noisy_pencil_is_a_minimum(shape):
    b, scale = random(20, *shape), random(20, seed=2)
    exact = scale[:, None, None] * b + random(20, shape[0], 1, seed=3) * random(20, 1, shape[1], seed=4)
    a = exact + 1e-3 * random(20, *shape, seed=5)
    found = rank_one_scale(a, b)

    def minors(scale):
        values = torch.linalg.svdvals(a[..., None, :, :] - scale[..., None, None] * b[..., None, :, :]).square()
        products = [values[..., i] * values[..., j] for i in range(values.shape[-1]) for j in range(i)]
        return torch.stack(products).sum(0)

    around = found[:, None] + torch.linspace(-1, 1, 201).double() * 0.01
    assert (minors(around).argmin(-1) - 100).abs().max() <= 1
    assert (found - scale).abs().median() < 3e-3


@pytest.mark.parametrize("kind", ["generic", "collinear", "both", "pair", "static"])
def test_parts_of_exact_planes(kind):
    homographies, infinity, e, v, _ = planes(40, kind=kind)
    parts = plane_parts(homographies, infinity)
    outer = parts.epipole[..., :, None] * parts.normal[..., None, :]
    torch.testing.assert_close(outer, e[..., :, None] * v[..., None, :], atol=1e-6, rtol=1e-6)
    torch.testing.assert_close(parts.scale[..., None, None] * (infinity[:, None] + outer), homographies, atol=1e-8, rtol=1e-8)
    assert parts.residual.max() < 1e-8
    torch.testing.assert_close(parts.epipole.norm(dim=-1), torch.ones(40, 4).double())


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

    noisy = homographies[2] + 0.01 * random(4, 3, 3, seed=7)
    assert torch.autograd.gradcheck(outer, (noisy.requires_grad_(),), atol=1e-5)


@pytest.mark.parametrize(
    ("kind", "least"), [("generic", 3), ("collinear", 3), ("coplanar", 3), ("both", 5), ("pair", 4), ("triple", 5), ("static", 4)]
)
def test_exact_planes(kind, least):
    for n in (least, least + 1, 8):
        homographies, infinity, *_ = planes(60, n=n, kind=kind, seed=n)
        found, residual = infinity_closed_form(homographies)
        # almost parallel planes, or almost equal epipoles, are among them
        assert error(found, infinity).quantile(0.95) < 1e-6 and error(found, infinity).max() < 1e-3
        assert residual.max() < 1e-4 and residual.median() < 1e-9
        torch.testing.assert_close(torch.linalg.det(found), torch.ones(60).double())


def test_scales_and_order_do_not_matter():
    homographies = planes(10, n=5)[0] + 1e-3 * random(10, 5, 3, 3, seed=8)
    found, residual = infinity_closed_form(homographies)
    again, same = infinity_closed_form(homographies * (5 * random(10, 5, 1, 1, seed=2)))
    torch.testing.assert_close(found, again, atol=1e-6, rtol=1e-6)
    torch.testing.assert_close(residual, same, atol=1e-6, rtol=1e-4)
    torch.testing.assert_close(infinity_linear(homographies)[0], infinity_linear(-7 * homographies)[0])
    first, second = plane_parts(homographies, found), plane_parts(-3 * homographies, 0.2 * found)
    torch.testing.assert_close(first.residual, second.residual, atol=1e-8, rtol=1e-6)
    torch.testing.assert_close(-15 * first.scale, second.scale)
    assert (first.residual > 1e-5).any() and (first.residual < 0.2).all()


def mixed(*batch, **options):
    homographies, infinity, e, v, fundamentals = planes(*batch, f=1, **options)
    return fundamentals[..., 0, :, :], homographies, infinity, e, v


def test_from_fundamental_matrices():
    for f in (2, 3, 6):
        *_, infinity, _, _, fundamentals = planes(50, f=f, seed=f)
        found, spectrum = infinity_from_fundamentals(fundamentals)
        assert error(found, infinity).max() < 1e-9
        torch.testing.assert_close(torch.linalg.det(found), torch.ones(50).double())
        assert (spectrum[..., 8] < 1e-12).all() and (spectrum[..., 7] > 1e-4).all()
    twice = torch.cat([fundamentals[:, :1], -2 * fundamentals[:, :1]], -3)  # one body, one epipole
    assert ((infinity_from_fundamentals(twice)[1] > 1e-10).sum(-1) == 5).all()


@pytest.mark.parametrize("n", [2, 3, 5])
@pytest.mark.parametrize("kind", ["generic", "collinear", "coplanar", "both"])
def test_one_fundamental_matrix_and_planes(n, kind):
    if kind in {"coplanar", "both"} and n > 2:
        n += 1  # more than two coplanar normals still have two directions
    f, homographies, infinity, *_ = mixed(300, n=n, kind=kind, seed=n)
    found, residual = infinity_from_mixed(f, homographies)
    assert (error(found, infinity) < 1e-6).all()
    assert residual.max() < 1e-7


def test_a_plane_of_the_known_body_says_nothing():
    f, homographies, infinity, *_ = mixed(50, n=2)
    epipole = torch.linalg.svd(f).U[..., 2]
    own = infinity + epipole[..., :, None] * random(50, 1, 3, seed=8)
    static = 2 * infinity
    more = torch.cat([own[:, None], homographies, static[:, None]], -3)
    assert error(infinity_from_mixed(f, more)[0], infinity).max() < 1e-6
    # with one plane of another body a line of solutions is left, of which one comes out
    assert infinity_from_mixed(f, more[:, :2])[0].isfinite().all()


KINDS = ["generic", "collinear", "coplanar", "both", "pair", "triple", "static"]
LINEAR = {  # nullity for 4, 5, 6, 8 planes
    "generic": (1, 1, 1, 1),
    "collinear": (1, 1, 1, 1),
    "coplanar": (1, 1, 1, 1),
    "both": (6, 3, 2, 2),
    "pair": (1, 1, 1, 1),
    "triple": (4, 1, 1, 1),
    "static": (3, 1, 1, 1),
}
THESIS = {  # for 5, 6, 8 planes
    "generic": (1, 1, 1),
    "collinear": (9, 8, 7),
    "coplanar": (6, 1, 1),
    "both": (14, 11, 10),
    "pair": (1, 1, 1),
    "triple": (9, 1, 1),
    "static": (6, 1, 1),
}


def nullities(spectrum):
    assert (spectrum.diff() <= 0).all()
    return set((spectrum < 1e-11 * spectrum[..., :1]).sum(-1).tolist())


@pytest.mark.parametrize("kind", KINDS)
def test_ranks_of_degenerate_planes(kind):
    for n, linear in zip((4, 5, 6, 8), LINEAR[kind], strict=True):
        homographies, infinity, *_ = planes(3, n=n, kind=kind, seed=10 * n)
        found, spectrum = infinity_linear(homographies)
        assert nullities(spectrum) == {linear}, (n, spectrum[:, -8:])
        assert (error(found, infinity).max() < 1e-8) == (linear == 1)
    for n, full in zip((5, 6, 8), THESIS[kind], strict=True):
        homographies, infinity, *_ = planes(2, n=n, kind=kind, seed=10 * n)
        found, spectrum = infinity_thesis(homographies)
        assert nullities(spectrum) == {full}, (n, spectrum[:, -16:])
        assert (error(found, infinity).max() < 1e-7) == (full == 1)


def test_ranks_of_few_planes(monkeypatch):
    monkeypatch.setattr(closed_forms, "check_homographies", lambda *_: None)
    for n, linear, full in ((1, 20, 20), (2, 39, 39), (3, 56, 57), (4, 63, 74), (5, 63, 83)):
        homographies = planes(3, n=n, seed=n)[0]
        assert nullities(infinity_linear(homographies)[1]) == {64 - linear}
        assert nullities(infinity_thesis(homographies)[1]) == {84 - full}


def all_methods(*batch, n=5, noise=0.0):
    """Every method with data for it, whose problems lead, and the truth."""
    homographies, infinity, _, _, f = planes(*batch, n=n, f=3)
    f = f / torch.linalg.matrix_norm(f, keepdim=True)
    h, f = homographies + noise * random(*homographies.shape, seed=8), f + 0.1 * noise * random(*f.shape, seed=5)
    return infinity, {
        "closed form": (infinity_closed_form, (h,)),
        "linear": (infinity_linear, (h,)),
        "thesis": (infinity_thesis, (h,)),
        "mixed": (infinity_from_mixed, (f[..., 0, :, :], h)),
        "fundamentals": (infinity_from_fundamentals, (f,)),
    }


def test_a_batch_is_its_loop_and_a_bad_problem_stays_alone():
    infinity, methods = all_methods(2, 3, noise=1e-4)
    for name, (method, data) in methods.items():
        data = [x.clone() for x in data]
        data[-1][0, 1, 0], data[-1][0, 2], data[-1][1, 0] = torch.nan, torch.inf, 0.0
        data[-1][1, 1] = data[-1][1, 1, :1]  # several times the same
        found, more = method(*data)
        assert found.isfinite().all() and more.isfinite().all(), name
        for i, j in ((0, 0), (1, 2)):
            assert error(found[i, j], infinity[i, j]) < 0.05, name
            alone = method(*(x[i, j] for x in data))
            torch.testing.assert_close(found[i, j], alone[0], atol=1e-7, rtol=1e-7)
            torch.testing.assert_close(more[i, j], alone[1], atol=1e-7, rtol=1e-7)
        # a matrix that is not finite is one fewer
        fewer = method(*(x[0, 1] for x in data[:-1]), data[-1][0, 1, 1:]) if name != "thesis" else method(data[0][0, 1])
        torch.testing.assert_close(found[0, 1], fewer[0], atol=1e-7, rtol=1e-7)
    empty, residual = infinity_closed_form(torch.zeros(0, 3, 3, 3))
    assert empty.shape == (0, 3, 3) and residual.shape == (0,)


def test_noise():
    infinity, methods = all_methods(100, noise=1e-3)
    errors = {name: float(error(method(*data)[0], infinity).median()) for name, (method, data) in methods.items()}
    assert errors["linear"] < 0.7 * errors["thesis"], errors
    assert errors["closed form"] < 1.5 * errors["linear"] and errors["closed form"] < 0.01, errors
    assert errors["mixed"] < 1.2 * errors["linear"] and errors["mixed"] < 3e-3, errors


@pytest.mark.slow
def test_gradients():
    _, methods = all_methods(noise=0.01)
    for name in ("linear", "fundamentals"):
        method, (data,) = methods[name]
        assert torch.autograd.gradcheck(lambda x, method=method: method(x)[0], (data.requires_grad_(),), atol=1e-4, rtol=1e-3), name


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: plane_parts(torch.eye(3), torch.eye(3)), "H must be a floating point tensor"),
        (lambda: plane_parts(torch.rand(1, 3, 3), torch.rand(3)), "infinity must be"),
        (lambda: plane_parts(torch.ones(2, 3, 3, dtype=torch.int64), torch.eye(3)), "H must be a floating point tensor"),
        (lambda: infinity_closed_form(torch.rand(2, 3, 3)), "at least 3: add 1"),
        (lambda: infinity_linear(torch.rand(3, 3, 3)), "at least 4: add 1"),
        (lambda: infinity_thesis(torch.rand(4, 3, 3)), "at least 5: add 1"),
        (lambda: infinity_from_fundamentals(torch.rand(1, 3, 3)), "m >= 2"),
        (lambda: infinity_from_mixed(torch.rand(3, 3), torch.rand(1, 3, 3)), "at least 2: add 1"),
        (lambda: infinity_from_mixed(torch.rand(3, 2), torch.rand(2, 3, 3)), "F must be"),
    ],
)
def test_refusals(call, message):
    with pytest.raises(ValueError, match=message):
        call()
