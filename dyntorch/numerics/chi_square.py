"""Quantiles of chi-square: what the square sum of so many standard normal numbers keeps below with a given chance."""

from __future__ import annotations

import math
from functools import cache

from scipy.special import chdtri


@cache
def quantile(probability: float, degrees: float) -> float:
    """The value that chi-square with so many degrees of freedom stays below with this probability."""
    return float(chdtri(degrees, 1 - probability))


def median(degrees: float) -> float:
    """The median of chi-square."""
    return quantile(0.5, degrees)


def three_sigma(degrees: float) -> float:
    """The quantile at 99.73 %: what the square of three standard deviations is for one condition, for several."""
    return quantile(math.erf(3 / math.sqrt(2)), degrees)
