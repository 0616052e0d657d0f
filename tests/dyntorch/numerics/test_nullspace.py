"""Null spaces against the SVD and closed forms, their certificates on hard spectra, gradients against finite differences."""

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from dyntorch.numerics import eigenspaces, nullspace
from dyntorch.numerics.nullspace import eigenvalues, eigh, gram_null_space, null_space, spectrum
from tests.draws import random
from tests.grid import assert_refused, grid

aten = torch.ops.aten


def rotation(*shape, seed=0):
    return torch.linalg.qr(random(*shape, seed=seed)).Q


def with_spectrum(singular, rows, batch=20, seed=0):
    """``(batch, rows, D)`` matrices with these singular values (cut where rows are few), and their right vectors as rows."""
    singular = torch.as_tensor(singular, dtype=torch.float64)
    size = len(singular)
    count = min(rows, size)
    v = rotation(batch, size, size, seed=seed)
    u = rotation(batch, rows, count, seed=seed + 1)
    return (u * singular[:count]) @ v[..., :count].mT, v.mT


def noisy_spectrum(size, dim, kappa=50.0, ratio=0.1):
    s = torch.logspace(0, -torch.log10(torch.tensor(kappa)).item(), size - dim, dtype=torch.float64)
    return torch.cat([s, s[-1] * ratio * torch.linspace(1.0, 0.5, dim, dtype=torch.float64)])


def angle(a, b):
    """Largest sine between row spaces, per problem."""
    return (a - a @ b.mT @ b).norm(dim=(-2, -1))


def projector(basis):
    return basis.mT @ basis


def gradient_holds(function, *inputs):
    return torch.autograd.gradcheck(function, inputs, fast_mode=True)


@pytest.fixture
def accelerator(monkeypatch):
    """The code takes the branches of an accelerator, and reading a value on the host raises."""
    for module in (eigenspaces, nullspace):
        monkeypatch.setattr(module, "on_host", lambda tensor: False)
    forbidden = {aten._local_scalar_dense.default, aten.nonzero.default, aten.is_nonzero.default, aten.equal.default}
    forbidden |= {aten._linalg_eigh.default, aten._linalg_svd.default, aten._linalg_check_errors.default}

    class NoWaiting(TorchDispatchMode):
        def __torch_dispatch__(self, func, types, args=(), kwargs=None):
            # waits for the device: the values of a tensor, a decomposition that checks for errors, an index of booleans
            masks = [i for i in args[1] if i is not None and i.dtype == torch.bool] if func is aten.index.Tensor else []
            assert func not in forbidden and not masks, f"{func} waits for the device"
            return func(*args, **(kwargs or {}))

    return NoWaiting


# --- values


@grid(("size", [4, 9, 27, 36]), ("extra", [0, 1, 7, 60]), ("dim", [1, 3]), ("batch", [1, 24]))
def test_spans_what_the_svd_spans(size, extra, dim, batch):
    matrix, expected = with_spectrum(noisy_spectrum(size, dim), size - dim + extra, batch, seed=size + extra)
    basis = null_space(matrix, dim)
    assert angle(basis, expected[:, -dim:]).max() < 1e-10
    torch.testing.assert_close(basis @ basis.mT, torch.eye(dim, dtype=torch.float64).expand(batch, -1, -1))


@pytest.mark.parametrize("dim", [1, 4])
def test_gram_gives_the_same_space_with_its_eigenvalues(dim):
    matrix, expected = with_spectrum(noisy_spectrum(64, dim), 80)
    gram = matrix.mT @ matrix
    found = gram_null_space(gram, dim)
    values = torch.linalg.eigvalsh(gram)
    assert angle(found.basis, expected[:, -dim:]).max() < 1e-10
    torch.testing.assert_close(found.residual, values[:, :dim], rtol=1e-6, atol=1e-14)
    torch.testing.assert_close(found.competing, (1 / values[:, dim:]).sum(-1), rtol=1e-6, atol=0)
    assert not found.degenerate.any()
    # rows of the basis are eigenvectors, in the order of the eigenvalues
    torch.testing.assert_close(found.basis @ gram, found.residual[..., None] * found.basis, rtol=0, atol=1e-10)


@grid(("ratio", [1e-8, 0.3, 0.6, 0.9, 0.99, 0.9999]), ("dim", [1, 4]))
def test_close_competitors_are_told_apart(ratio, dim):
    spectrum = noisy_spectrum(27, dim, kappa=30, ratio=ratio)
    matrix, expected = with_spectrum(spectrum, 60, batch=50, seed=3)
    limit = 1e-10 / (1 - ratio)
    assert angle(null_space(matrix, dim), expected[:, -dim:]).max() < limit
    assert angle(gram_null_space(matrix.mT @ matrix, dim).basis, expected[:, -dim:]).max() < limit


@grid((("kappa", "limit"), [(1e1, 1e-12), (1e3, 1e-10), (1e5, 1e-9), (1e7, 1e-7), (1e9, 1e-5)]))
def test_rows_lose_no_more_than_the_svd(kappa, limit):
    matrix, expected = with_spectrum(noisy_spectrum(27, 1, kappa), 54, batch=30, seed=4)
    assert angle(null_space(matrix), expected[:, -1:]).max() < limit
    assert angle(null_space(matrix[:3]), expected[:3, -1:]).max() < limit


def test_start_vectors_that_miss_the_null_vector_are_noticed():
    start = eigenspaces._generic(12, 2, torch.device("cpu"))
    missed = rotation(12, 12, seed=5)
    missed[:, 0] = torch.linalg.qr(torch.cat([start, missed], -1)).Q[:, 2]  # orthogonal to every start vector
    v = torch.linalg.qr(missed).Q
    gram = (v * torch.tensor([1e-4, *torch.linspace(0.1, 1, 11)])) @ v.mT
    found = gram_null_space(gram.expand(20, -1, -1).contiguous())
    assert angle(found.basis, v[:, :1].mT).max() < 1e-10


def test_dependent_rows_and_growth_in_the_elimination_are_noticed():
    matrix = random(10, 8, 9)
    matrix[:, 3] = matrix[:, 1] - matrix[:, 2]
    matrix[5:, 0] = 0.0
    basis = null_space(matrix)
    assert (matrix @ basis.mT).abs().max() < 1e-13
    torch.testing.assert_close(basis.norm(dim=-1), torch.ones(10, 1, dtype=torch.float64))
    # Wilkinson's matrix doubles an entry in every step of partial pivoting
    size = 70
    columns = torch.eye(size, dtype=torch.float64) - torch.ones(size, size, dtype=torch.float64).tril(-1)
    columns[:, -1] = 1.0
    matrix = (columns[:, :-1] + 1e-3 * random(size, size - 1, seed=6)).T.contiguous()
    expected = torch.linalg.svd(matrix, full_matrices=True).Vh[-1:]
    assert angle(null_space(matrix.expand(8, -1, -1)), expected).max() < 1e-10


@grid(("scale", [1e-140, 1e-20, 1e20, 1e140, 1e200]), ("rows", [26, 40]))
def test_units_do_not_matter(scale, rows):
    matrix, expected = with_spectrum(noisy_spectrum(27, 1), rows)
    assert angle(null_space(matrix * scale), expected[:, -1:]).max() < 1e-10


# --- the contract


@grid(("rows", [8, 30]), ("batch", [(), (1,), (3,), (2, 5), (2, 3, 4)]))
def test_batch_equals_loop_including_signs(rows, batch):
    matrix = random(*batch, rows, 9, seed=rows)
    basis = null_space(matrix)
    assert basis.shape == (*batch, 1, 9)
    single = torch.stack([null_space(one) for one in matrix.reshape(-1, rows, 9)]).reshape(basis.shape)
    torch.testing.assert_close(basis, single, rtol=0, atol=1e-9)
    found = gram_null_space(matrix.mT @ matrix, 2)
    assert found.basis.shape == (*batch, 2, 9) and found.residual.shape == (*batch, 2)
    assert found.competing.shape == found.degenerate.shape == batch


def test_signs_hold_where_entries_tie():
    # skew tensors have pairs of entries of equal size: the sign must not hang on which one rounding makes larger
    skew = torch.tensor([0.0, 3, -1, -3, 0, 2, 1, -2, 0], dtype=torch.float64)
    skew = skew / skew.norm()
    complement = torch.linalg.qr(torch.cat([skew[:, None], random(9, 8, seed=8)], -1)).Q[:, 1:]
    matrices = torch.stack([random(8, 8, seed=seed) @ complement.T for seed in range(40)])
    basis = null_space(matrices)
    torch.testing.assert_close(basis, basis[:1].expand_as(basis), rtol=0, atol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16, torch.bfloat16])
@pytest.mark.parametrize("rows", [26, 60])
def test_lower_precision_is_solved_in_double(dtype, rows):
    matrix, _ = with_spectrum(noisy_spectrum(27, 1), rows)
    rounded = matrix.to(dtype)
    basis = null_space(rounded)
    assert basis.dtype == dtype
    assert angle(basis.double(), null_space(rounded.double())).max() < 2 * torch.finfo(dtype).eps
    found = gram_null_space((rounded.double().mT @ rounded.double()).float())
    assert found.basis.dtype == found.residual.dtype == found.competing.dtype == torch.float32
    if dtype == torch.float32:
        exact, single = rounded.double().requires_grad_(), rounded.clone().requires_grad_()
        null_space(exact).sum().backward()
        null_space(single).sum().backward()
        torch.testing.assert_close(single.grad, exact.grad.float(), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("shape", [(0, 5, 6), (0, 9, 6), (3, 0, 9, 6)])
def test_no_problems_no_trouble(shape):
    matrix = torch.zeros(shape, dtype=torch.float64, requires_grad=True)
    null_space(matrix).sum().backward()
    assert matrix.grad.shape == shape
    found = gram_null_space(torch.zeros(*shape[:-2], 6, 6))
    assert found.basis.shape == (*shape[:-2], 1, 6) and found.degenerate.shape == shape[:-2]


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize(("rows", "batch"), [(8, 10), (30, 10), (30, 3), (8, 2)])
def test_one_bad_problem_leaves_the_others_alone(value, rows, batch):
    matrix = random(batch, rows, 9)
    gram = matrix.mT @ matrix
    expected, sound = null_space(matrix), gram_null_space(gram)
    matrix[1, 2, 3], gram[1, 4, 4] = value, value
    keep = torch.arange(batch) != 1
    basis, found = null_space(matrix), gram_null_space(gram)
    torch.testing.assert_close(basis[keep], expected[keep], rtol=0, atol=1e-12)
    torch.testing.assert_close(found.basis[keep], sound.basis[keep], rtol=0, atol=1e-12)
    assert (basis[1] == 0).all()
    assert (found.basis[1] == 0).all() and found.degenerate.tolist() == (~keep).tolist()
    assert found.residual.isfinite().all() and found.competing.isfinite().all()


@grid(("batch", [2, 30]), (("size", "rank"), [(9, 7), (27, 25), (27, 10), (64, 62), (64, 1)]))
def test_a_null_space_that_is_larger_is_reported(batch, size, rank):
    for nothing in (torch.zeros(batch, size, size), torch.eye(size).expand(batch, -1, -1)):
        found = gram_null_space(nothing.double())
        torch.testing.assert_close(found.basis.norm(dim=-1), torch.ones(batch, 1, dtype=torch.float64))
        assert found.residual.isfinite().all() and found.competing.isfinite().all()
    assert gram_null_space(torch.zeros(batch, size, size)).degenerate.all()
    matrix = random(batch, 100, rank, seed=1) @ random(batch, rank, size, seed=2)
    gram = matrix.mT @ matrix
    found = gram_null_space(gram)
    assert found.degenerate.all()
    assert (gram @ found.basis.mT).norm(dim=(-2, -1)).max() < 1e-12 * gram.norm(dim=(-2, -1)).max()
    assert not gram_null_space(gram, size - rank).degenerate.any()


@grid(("batch", [2, 30]), ("size", [9, 27, 64]))
def test_bad_conditioning_is_not_a_larger_null_space(batch, size):
    spectra = [
        noisy_spectrum(size, 1, 1e6, ratio=1e-3),
        torch.tensor([1.0] + [1e-6] * (size - 2) + [0.0]),
        torch.tensor([1.0] * (size - 2) + [1e-6, 0.0]),
    ]
    for singular in spectra:
        matrix, expected = with_spectrum(singular, 80, batch)
        found = gram_null_space(matrix.mT @ matrix)
        assert not found.degenerate.any()
        assert angle(found.basis, expected[:, -1:]).max() < 1e-2


def test_the_whole_space_is_a_null_space():
    gram = random(6, 7, 3).mT @ random(6, 7, 3)
    found = gram_null_space(gram, 3)
    torch.testing.assert_close(projector(found.basis), torch.eye(3, dtype=torch.float64).expand(6, -1, -1))
    torch.testing.assert_close(found.residual, torch.linalg.eigvalsh(gram))
    assert (found.competing == 0).all() and not found.degenerate.any()
    basis = null_space(torch.zeros(3, 0, 4, dtype=torch.float64), dim=4)  # no rows leave everything
    torch.testing.assert_close(projector(basis), torch.eye(4, dtype=torch.float64).expand(3, -1, -1))


@pytest.mark.parametrize("rows", [26, 60])
def test_blocks_of_unequal_size_give_the_same(monkeypatch, rows):
    matrix, _ = with_spectrum(noisy_spectrum(27, 1), rows, batch=50)
    whole, parts = matrix.clone().requires_grad_(), matrix.clone().requires_grad_()
    expected = null_space(whole)
    expected.sum().backward()
    monkeypatch.setattr(eigenspaces, "GRAM_BLOCK", 16 * 8 * 27 * 27)
    found = null_space(parts)
    found.sum().backward()
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-10)
    torch.testing.assert_close(parts.grad, whole.grad, rtol=1e-6, atol=1e-7)


def test_misuse_is_refused():
    assert_refused(
        (lambda: null_space(random(5, 6, 9)), r"\(5, 6, 9\).*6 rows.*at least 8.*dim=3"),
        (lambda: null_space(random(9, 9), dim=0), "dim must be from 1 to D = 9, got 0"),
        (lambda: gram_null_space(random(9, 9), dim=10), "dim must be from 1 to D = 9, got 10"),
        (lambda: null_space(torch.ones(9, 9, dtype=torch.int64)), "matrix must be of floating point"),
        (lambda: gram_null_space(random(9)), r"gram must be .*\(9,\)"),
        (lambda: gram_null_space(random(8, 9)), r"gram must be square .*\(8, 9\)"),
    )


# --- gradients


@grid(
    (("rows", "size", "dim"), [(8, 9, 1), (12, 9, 1), (60, 27, 1), (26, 27, 1), (20, 12, 4), (8, 12, 4), (10, 12, 4)]),
    ("batch", [2, 6]),
)
def test_gradient_of_the_projector(rows, size, dim, batch):
    matrix = with_spectrum(noisy_spectrum(size, dim, kappa=5, ratio=0.3), rows, batch)[0].requires_grad_()
    assert gradient_holds(lambda a: projector(null_space(a, dim)), matrix)
    assert gradient_holds(lambda a: projector(gram_null_space(a.mT @ a, dim).basis), matrix)
    gram = (matrix.mT @ matrix).detach().requires_grad_()
    assert gradient_holds(lambda g: projector(gram_null_space((g + g.mT) / 2, dim).basis), gram)


@pytest.mark.parametrize("rows", [8, 20])
def test_gradient_with_equal_other_singular_values(rows):  # torch.linalg.svd divides by their differences
    matrix = with_spectrum([1.0] * 4 + [0.5] * 4 + [0.1], rows, batch=6)[0].requires_grad_()
    assert gradient_holds(lambda a: projector(null_space(a)), matrix)


@pytest.mark.parametrize("batch", [2, 10])
def test_gradient_of_an_ambiguous_null_vector_is_finite_and_not_silent(batch):
    matrix = with_spectrum([3.0, 2, 1, 0, 0], 12, batch)[0].requires_grad_()
    (null_space(matrix) * random(5)).sum().backward()
    assert matrix.grad.isfinite().all() and (matrix.grad.abs().amax((-2, -1)) > 0).all()
    gram = (matrix.mT @ matrix).detach().requires_grad_()
    (gram_null_space(gram).basis * random(5)).sum().backward()
    assert gram.grad.isfinite().all() and (gram.grad.abs().amax((-2, -1)) > 0).all()


@pytest.mark.parametrize("rows", [8, 20])
def test_gradient_of_a_bad_problem_is_zero_and_of_the_others_unchanged(rows):
    matrix = random(7, rows, 9)
    good = matrix.clone().requires_grad_()
    null_space(good).sum().backward()
    matrix[2, 1, 1] = torch.nan
    bad = matrix.requires_grad_()
    (slope,) = torch.autograd.grad(null_space(bad).sum(), bad, create_graph=True)
    keep = torch.arange(7) != 2
    torch.testing.assert_close(slope[keep].detach(), good.grad[keep])
    assert (slope[2] == 0).all()
    (second,) = torch.autograd.grad(slope.square().sum(), bad)
    assert second.isfinite().all() and (second[2] == 0).all() and second[keep].abs().amax((-2, -1)).min() > 0
    gram = (matrix.mT @ matrix).detach().requires_grad_()
    gram_null_space(gram).basis.sum().backward()
    assert gram.grad.isfinite().all() and (gram.grad[2] == 0).all()


# --- second derivatives, and the ways of torch.func


def gauge_free(basis):
    """Three numbers that do not depend on the choice of the basis."""
    fixed = torch.linspace(-1, 1, 3 * basis.shape[-1], dtype=basis.dtype).sin().reshape(-1, 3)
    return (projector(basis) @ fixed).square().sum(-2)


@grid(("batch", [1, 4]), (("rows", "size", "dim"), [(8, 9, 1), (12, 9, 1), (40, 27, 1), (8, 12, 4), (12, 8, 3)]))
def test_second_derivatives(rows, size, dim, batch):
    matrix = with_spectrum(noisy_spectrum(size, dim, kappa=5, ratio=0.3), rows, batch)[0].requires_grad_()
    for function in (lambda a: gauge_free(null_space(a, dim)), lambda a: gauge_free(gram_null_space(a.mT @ a, dim).basis)):
        assert torch.autograd.gradgradcheck(function, matrix, fast_mode=True)


@pytest.mark.parametrize(("rows", "dim"), [(12, 1), (8, 1), (12, 2)])
def test_torch_func_agrees_with_autograd(rows, dim):
    batch = random(3, rows, 9)
    for solve in (lambda a: null_space(a, dim), lambda a: gram_null_space(a.mT @ a, dim).basis):

        def value(a, solve=solve):
            return gauge_free(solve(a)).sum()

        leaf = batch.clone().requires_grad_()
        (expected,) = torch.autograd.grad(value(leaf), leaf)
        torch.testing.assert_close(torch.func.vmap(torch.func.grad(value))(batch), expected)
        torch.testing.assert_close(torch.func.vmap(lambda a: projector(solve(a)))(batch), projector(solve(batch)))  # noqa: B023
        tangent = random(3, rows, 9, seed=5)
        moved = torch.func.jvp(value, (batch,), (tangent,))[1]
        torch.testing.assert_close(moved, (expected * tangent).sum())
        hessian = torch.func.jacrev(torch.func.jacrev(value))(batch[0]).flatten(0, 1).flatten(1)
        other = torch.func.jacfwd(torch.func.jacrev(value))(batch[0]).flatten(0, 1).flatten(1)
        torch.testing.assert_close(hessian, hessian.mT, rtol=1e-6, atol=1e-8)
        torch.testing.assert_close(hessian, other, rtol=1e-6, atol=1e-8)


# --- accelerators


@grid((("rows", "dim"), [(26, 1), (60, 1), (60, 4), (23, 4)]))
def test_nothing_waits_for_an_accelerator(accelerator, rows, dim):
    matrix, expected = with_spectrum(noisy_spectrum(27, dim), rows)
    matrix[3, 0, 0] = torch.nan
    keep = torch.arange(20) != 3
    leaf = matrix.requires_grad_()
    with accelerator():
        basis = null_space(leaf, dim)
        basis.sum().backward()
        gram = (leaf.mT @ leaf).detach().requires_grad_()
        found = gram_null_space(gram, dim)
        found.basis.sum().backward()
    for result in (basis, found.basis):
        assert angle(result[keep], expected[keep, -dim:]).max() < 1e-10
    assert (basis[3] == 0).all() and (found.basis[3] == 0).all()
    assert found.degenerate.tolist() == (~keep).tolist()
    assert leaf.grad.isfinite().all() and gram.grad.isfinite().all()


def test_accelerator_reports_what_it_could_not_decide(accelerator):
    matrix = random(10, 40, 5) @ random(10, 5, 9, seed=1)
    assert gram_null_space(matrix.mT @ matrix).degenerate.all()


def test_entries_that_are_zero_have_derivatives():
    """A diagonal matrix turns when its other entries grow: dv_1 = dM_12 / (m_1 - m_2) v_2."""
    matrix = torch.diag(torch.tensor([1.0, 3.0], dtype=torch.float64)).requires_grad_()
    for vectors in (eigh(matrix)[1], spectrum(matrix)[1]):
        turn = vectors[0, 1] * vectors[1, 1].sign()
        slope = torch.autograd.grad(turn, matrix)[0]
        torch.testing.assert_close(0.5 * (slope + slope.mT), torch.tensor([[0.0, 0.25], [0.25, 0.0]], dtype=torch.float64))
    (first,) = torch.autograd.grad(eigenvalues(matrix)[1], matrix, create_graph=True)
    curved = torch.autograd.grad(first[0, 1] + first[1, 0], matrix)[0]
    torch.testing.assert_close(curved.sum() - curved.trace(), torch.tensor(1.0, dtype=torch.float64))  # 3 + e^2 / 2
