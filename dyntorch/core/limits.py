"""Numbers that several tasks share: what is rounding, when an iteration ends, and when agreement is no accident."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

MIN_CONSENSUS = 0.4
"""Share of the matches with weight that must agree with a motion; fewer agree with a wrong one by accident."""
MAX_SQUARED_DISTANCE = 9.0
"""Squared distance, over the squared noise, at which the cost of a match is cut off: three standard deviations."""
MIN_INFORMATION = 1e-13
"""Information on the worst direction of a motion, over that on the best, up to which it is rounding: the motion is open."""


def rounding_error(dtype: torch.dtype = torch.float64, scale: float = 1.0, condition: float = 1.0) -> float:
    """What rounding leaves of a zero: the last safe decimal of ``dtype`` (1e-15, 1e-6) of numbers of size ``scale``, times what the
    computation loses (``condition``)."""
    return torch.finfo(dtype).resolution * scale * condition


@dataclass(frozen=True)
class Stop:
    """When an iteration ends: after ``max_iterations``, or when one lowers the cost by a share of ``tolerance`` at most."""

    max_iterations: int = 30
    tolerance: float = 1e-9

    def has_converged(self, before: Tensor, after: Tensor) -> Tensor:
        """Where the costs ``(b,)`` before and after an iteration end it, bool."""
        return ~(before - after > self.tolerance * after)
