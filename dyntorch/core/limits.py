"""Numbers that several tasks share: what is rounding, when an iteration ends, and when agreement is no accident."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

from scipy.special import chdtri
from torch import Tensor

MIN_CONSENSUS = 0.4
"""Share of the matches with weight that must agree with a motion; fewer agree with a wrong one by accident."""
MAX_SQUARED_DISTANCE = 9.0
"""Squared distance, over the squared noise, at which the cost of a match is cut off: three standard deviations."""
MIN_INFORMATION = 1e-13
"""Information on the worst direction of a motion, over that on the best, up to which it is rounding: the motion is open."""


@dataclass(frozen=True)
class Stop:
    """When an iteration ends: after ``max_iterations``, or when one lowers the cost by a share of ``tolerance`` at most."""

    max_iterations: int = 30
    tolerance: float = 1e-9

    def has_converged(self, before: Tensor, after: Tensor) -> Tensor:
        """Where the costs ``(b,)`` before and after an iteration end it, bool."""
        return ~(before - after > self.tolerance * after)


# ----------------------------------------------------------------------------------------------------------------------
# Quantiles of chi-square: what the square sum of so many standard normal numbers keeps below with a given chance.


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
