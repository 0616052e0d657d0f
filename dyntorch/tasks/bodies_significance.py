"""Whether so many matches would agree with an epipolar geometry by chance."""

from __future__ import annotations

from math import lgamma, log

import torch
from torch import Tensor

from dyntorch.algebra.epipolar import sampson_squared
from dyntorch.tasks.bodies_energy import PIXELS, View

SAMPLE = 7
"""Matches that determine a fundamental matrix."""
FALSE_ALARMS = 1e-2
"""Bodies expected in random matches, below which a body is believed."""


def significant(view: View, fundamentals: Tensor, labels: Tensor) -> Tensor:
    r"""Which bodies are no accident, ``(K,)`` bool: their expected number in random matches,

    .. math:: (n - 7) \binom{n}{k} \binom{k}{7}\, p^{\,k - 7}, \qquad p = 2 T D / A,

    is below :data:`FALSE_ALARMS`, for k of n matches within T of their epipolar lines in an image of area A and diagonal D.  What
    other bodies explain is left out.

    Args:
        view: matches, outliers among them.
        fundamentals: ``(K, 3, 3)``.
        labels: ``(n,)``, 0 outlier, 1..K.

    Source: Moisan and Stival, A probabilistic criterion to detect rigid point matches, IJCV 2004.
    """
    threshold = PIXELS * view.pixel
    near = sampson_squared(fundamentals, view.x1, view.x2) <= threshold**2
    chance = max(_chance(x, threshold) for x in (view.x1, view.x2))
    found = []
    for number, close in enumerate(near, start=1):
        own = labels == number
        count, among = int((own & close).sum()), int((own | (labels == 0)).sum())
        found.append(count > SAMPLE and _alarms(among, count, chance) < log(FALSE_ALARMS))
    return torch.tensor(found, dtype=torch.bool, device=labels.device)


def _chance(x: Tensor, threshold: float) -> float:
    """Probability p that a random match is near the line of another point, in the box that holds nearly all ``(n, 2)``."""
    low, high = torch.quantile(x, x.new_tensor([0.02, 0.98]), dim=0)
    width, height = (high - low).clamp(min=threshold).tolist()
    return float(min(1.0, 2 * threshold * (width**2 + height**2) ** 0.5 / (width * height)))


def _alarms(n: int, k: int, chance: float) -> float:
    """Logarithm of the expected number of bodies of k among n random matches."""
    return log(max(1, n - SAMPLE)) + _choose(n, k) + _choose(k, SAMPLE) + (k - SAMPLE) * log(chance)


def _choose(n: int, k: int) -> float:
    """Logarithm of the binomial coefficient."""
    return lgamma(n + 1) - lgamma(k + 1) - lgamma(n - k + 1)
