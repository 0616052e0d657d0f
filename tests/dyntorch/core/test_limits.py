"""Numbers that several tasks share; quantiles of chi-square against closed forms and the distribution function of torch."""

import math

import pytest
import torch

from dyntorch.core.limits import Stop, median, quantile, three_sigma
from tests.grid import grid


def test_an_iteration_ends_where_it_gains_little_or_nothing():
    before = torch.tensor([1.0, 1.0, 1.0, float("nan")])
    after = torch.tensor([0.5, 1 - 1e-4, 2.0, 1.0])
    assert Stop(tolerance=1e-3).has_converged(before, after).tolist() == [False, True, True, True]


@grid(("degrees", [1, 2, 3, 4, 6, 17, 300]), ("probability", [1e-6, 0.005, 0.1, 0.5, 0.9, 0.9973, 1 - 1e-6]))
def test_the_distribution_function_gives_the_probability_back(degrees, probability):
    half = torch.tensor([degrees / 2, quantile(probability, degrees) / 2], dtype=torch.float64)
    assert float(torch.special.gammainc(half[0], half[1])) == pytest.approx(probability, rel=1e-8)
    assert quantile(probability, 2) == pytest.approx(-2 * math.log1p(-probability), rel=1e-9)
    # one degree is the square of a normal number
    assert three_sigma(1) == pytest.approx(9.0, rel=1e-12)
    assert 0.5 * (1 + math.erf(math.sqrt(median(1) / 2))) == pytest.approx(0.75, rel=1e-12)
