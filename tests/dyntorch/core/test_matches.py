"""Checked matches: what is missing, what is refused, and the way back."""

import pytest
import torch

import dyntorch as dyn
from dyntorch.core.matches import matches
from tests.grid import assert_refused, grid

H = dyn.HomographyTensor()


def views(*batch, n=4, dtype=torch.float64):
    g = torch.Generator().manual_seed(0)
    return tuple(torch.rand(*batch, n, 2, generator=g, dtype=dtype) for _ in range(3))


@grid(("batch", [(), (3,), (2, 3), (0,), (2, 0)]), ("dtype", [torch.float32, torch.float64]))
def test_batch_is_flat_in_double_and_comes_back(batch, dtype):
    given = views(*batch, dtype=dtype)
    data = matches(H, given)
    flat = max(1, len(batch)) and torch.Size(batch).numel()
    assert data.count == 4 and data.batch == batch and data.dtype == dtype
    for x, y in zip(data.views, given, strict=True):
        assert x.dtype == torch.float64 and x.shape == (flat, 4, 2)
        assert torch.equal(x.reshape(y.shape).to(dtype), y)
    assert torch.equal(data.weights, torch.ones(flat, 4, dtype=torch.float64)) and data.static is None
    back = data.back(torch.zeros(flat, 5, dtype=torch.float64))
    assert back.shape == (*batch, 5) and back.dtype == dtype
    assert data.back(torch.zeros(flat, dtype=torch.int64)).dtype == torch.int64


@grid(("bad", [torch.nan, torch.inf, -torch.inf]), ("view", [0, 1, 2]))
def test_what_is_not_finite_weighs_nothing(bad, view):
    given = [x.clone() for x in views(2)]
    given[view][1, 2, 0] = bad
    data = matches(H, given)
    expected = torch.ones(2, 4, dtype=torch.float64)
    expected[1, 2] = 0
    assert torch.equal(data.weights, expected)
    for x, y in zip(data.views, given, strict=True):
        assert x.isfinite().all()
        assert torch.equal(x[expected > 0], y[expected > 0])
    # the caller's tensor is as it was
    assert not given[view].isfinite().all()


def test_missing_ends_of_lines_and_weights_that_are_not_numbers():
    g = torch.Generator().manual_seed(0)
    l1, l2 = torch.rand(2, 3, 2, 3, generator=g), torch.rand(2, 3, 2, 3, generator=g)
    l2[0, 1, 1, 2] = torch.nan
    weights = torch.tensor([1.0, 2.0, torch.inf])
    data = matches(dyn.TranslatingLinesMatrix(), (l1, l2), weights)
    assert data.weights.tolist() == [[1.0, 0.0, 0.0], [1.0, 2.0, 0.0]]
    assert matches(dyn.TranslatingLinesMatrix(), (l1[0, :, 0].repeat(1, 2), l2[0, :, 0].repeat(1, 2))).count == 3


def test_options_broadcast_and_gradients_pass():
    static = torch.tensor([True, False, False, True])
    data = matches(H, views(2, 3), torch.arange(4.0).double(), static)
    assert data.weights.tolist() == [[0.0, 1.0, 2.0, 3.0]] * 6 and data.static.tolist() == [static.tolist()] * 6
    less = data.restrict(static.expand(6, 4))
    assert less.weights.tolist() == [[0.0, 0.0, 0.0, 3.0]] * 6 and less.static is data.static and less.batch == (2, 3)
    given = [x.requires_grad_() for x in views(2)]
    with torch.no_grad():
        given[0][0, 0] = torch.nan
    sum(x.sum() for x in matches(H, given).views).backward()
    assert given[0].grad[0, 0].tolist() == [0.0, 0.0] and given[0].grad[1].eq(1).all() and given[1].grad[0, 0].eq(0).all()


def test_a_class_of_numbers_that_is_not_a_tensor_is_named():
    x, _, y = views()
    assert_refused(
        (lambda: matches(H, views(), None, [True] * 4), r"static must be a torch\.Tensor, got list"),
        (lambda: matches(H, views(), torch.ones(4, device="meta")), r"weights is on meta, the matches on cpu; use .to\(device\)"),
        (
            lambda: matches(H, (x, torch.zeros(2).double(), y)),
            r"view 2 of HomographyTensor: expected \(\*batch, n, 2\), got \(2,\)",
        ),
    )


@pytest.mark.parametrize("batch", [(), (2,), (2, 0)])
def test_no_matches_at_all_keep_their_batch(batch):
    data = matches(H, [torch.zeros(*batch, 0, 2).double()] * 3, torch.zeros(0).double())
    assert data.views[0].shape == (torch.Size(batch).numel(), 0, 2) and data.back(data.weights).shape == (*batch, 0)
    if 0 not in batch:
        with pytest.raises(ValueError, match="needs at least 26 matches, got 0"):
            dyn.fit(H, *[torch.zeros(*batch, 0, 2).double()] * 3)
