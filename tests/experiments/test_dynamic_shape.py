"""The table of dynamic shape tensors: counts by rank, and one row of accuracy."""

import pytest
import torch

from dyntorch.shapes.basis import Polynomial
from experiments.recognition import dynamic_shape


def test_counts_are_those_of_the_theory():
    rows = dynamic_shape.counts(dynamic_shape.Config(scenes=1))
    assert [row.measured for row in rows] == [8, 7, 7, 2, 3, 5, 49, 8]
    assert all(row.reached for row in rows)


def test_views_cover_the_interval_and_errors_go_around_the_period():
    config = dynamic_shape.Config(scenes=2)
    data = dynamic_shape.views(config, Polynomial(1), 6, frames=20)
    assert data.times[:, :20].amin() == -1
    assert data.times[:, :20].amax() == 1
    assert len(data.seen) == 6
    assert data.new[0].shape == (2, dynamic_shape.VIEWS, 2)
    assert dynamic_shape.error(data, data.times[:, 20:] + 0.99, 1.0) == pytest.approx(0.01)


def test_a_rank_out_of_reach_is_said():
    with pytest.raises(ValueError, match="not reached by 3 views"):
        dynamic_shape.least(torch.ones(3, 2, 4).double(), 2)
