"""Estimation matrix and Gram: against rows built one by one, in pieces, with labels and copies, and their gradients."""

import pytest
import torch

import dyntorch as dyn
from dyntorch.core import matrix
from dyntorch.core.matrix import estimation_matrix, gram, labelled_rows
from tests.battery.cases import CASES
from tests.battery.references import matrices


def data(case, n=9):
    """One problem, with the dimension of copies where there is one."""
    scene = case.scene(n)
    views = tuple(x[None] for x in scene.exact) if case.invariant.copies else scene.exact
    return scene, views


def brute(case, scene, weights, static=None):
    """The weighted Gram, camera by camera."""
    found = []
    for m in matrices(case, scene.exact, static):
        if static is None:
            m = (m.unflatten(0, (len(weights), -1)) * weights.sqrt()[:, None, None]).flatten(0, 1)
        found.append(m.T @ m)
    return torch.stack(found)


@pytest.mark.parametrize("case", CASES, ids=repr)
def test_gram_is_that_of_rows_built_one_by_one(case):
    scene, views = data(case)
    weights = torch.rand(9, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    weights[3] = 0
    expected = brute(case, scene, weights)
    found = gram(case.invariant.primitives, views, weights)
    torch.testing.assert_close(found, expected if case.invariant.copies else expected[0])
    rows = estimation_matrix(case.invariant.primitives, views, weights)
    assert rows.shape[-2:] == (9 * case.invariant.rows(), case.invariant.width())
    torch.testing.assert_close(rows.mT @ rows, found)


@pytest.mark.parametrize("case", [c for c in CASES if c.invariant.labels_static], ids=repr)
def test_labelled_matches_put_in_all_rows(case):
    scene, views = data(case)
    static = torch.arange(9) % 3 == 0
    ones = torch.ones(9, dtype=torch.float64)
    expected = brute(case, scene, ones, static.tolist())
    found = gram(case.invariant.primitives, views, ones, static)
    torch.testing.assert_close(found, expected if case.invariant.copies else expected[0])
    rows = estimation_matrix(case.invariant.primitives, views, ones, static)
    torch.testing.assert_close(rows.mT @ rows, found)
    # a weight scales all rows of its match
    weights = torch.linspace(0, 2, 9, dtype=torch.float64)
    axis = 1 if case.invariant.copies else 0
    parts = zip(*(x.split(1, axis) for x in views), strict=True)
    total = sum(w * gram(case.invariant.primitives, x, ones[:1], s[None]) for w, x, s in zip(weights, parts, static, strict=True))
    torch.testing.assert_close(gram(case.invariant.primitives, views, weights, static), total)
    assert labelled_rows(dyn.HomographyTensor.primitives) == [3 + 3 + 3, 9 + 9 + 9]


@pytest.mark.parametrize("kind", [dyn.HomographyTensor, dyn.ConstantVelocityTensor, dyn.FundamentalMatrix])
def test_many_matches_in_pieces_are_the_same_sum(kind, monkeypatch):
    invariant = kind()
    g = torch.Generator().manual_seed(0)
    views = [torch.randn(2, 1000, p.dim, generator=g, dtype=torch.float64) for p in invariant.primitives]
    weights = torch.rand(2, 1000, generator=g, dtype=torch.float64)
    static = torch.rand(2, 1000, generator=g) < 0.3 if invariant.labels_static else None
    whole = gram(invariant.primitives, views, weights, static)
    monkeypatch.setattr(matrix, "CHUNK", 1)
    torch.testing.assert_close(gram(invariant.primitives, views, weights, static), whole)


def test_no_matches_give_zero():
    invariant = dyn.HomographyTensor()
    views = [torch.zeros(2, 0, 2).double()] * 3
    assert torch.equal(gram(invariant.primitives, views, torch.zeros(2, 0).double()), torch.zeros(2, 27, 27).double())
    assert estimation_matrix(invariant.primitives, views, torch.zeros(2, 0).double()).shape == (2, 0, 27)


@pytest.mark.parametrize("static", [False, True])
def test_gradient_by_finite_differences(static):
    invariant = dyn.HomographyTensor()
    g = torch.Generator().manual_seed(0)
    views = [torch.randn(3, 2, generator=g, dtype=torch.float64).requires_grad_() for _ in range(3)]
    weights = torch.rand(3, generator=g, dtype=torch.float64).requires_grad_()
    label = torch.tensor([True, False, False]) if static else None
    mixed = torch.randn(27, 27, generator=g, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda w, *v: (gram(invariant.primitives, v, w, label) * mixed).sum(), [weights, *views])
