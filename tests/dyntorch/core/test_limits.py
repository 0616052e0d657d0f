"""Numbers that several tasks share."""

import pytest
import torch

from dyntorch.core.limits import Stop, rounding_error


def test_rounding_follows_dtype_scale_and_condition():
    assert rounding_error() == 1e-15
    assert rounding_error(torch.float32, scale=1e3) == pytest.approx(1e-3)
    assert rounding_error(condition=1e9) == pytest.approx(1e-6)


def test_an_iteration_ends_where_it_gains_little_or_nothing():
    before = torch.tensor([1.0, 1.0, 1.0, float("nan")])
    after = torch.tensor([0.5, 1 - 1e-4, 2.0, 1.0])
    assert Stop(tolerance=1e-3).has_converged(before, after).tolist() == [False, True, True, True]
