"""Phases of neighbouring frames agree on a rate: what a window adds to single frames."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
FASTEST = 3.0  # cycles per second
RATES = 61  # tried, from backwards to forwards


def smooth_phases(phase: Array, times: Array, seconds: float, periodic: Array) -> Array:
    r"""``(T, classes)`` phases, each from its neighbours too.

    A cycle's: the argument of :math:`\sum_j e^{2\pi i(\phi_j - \rho(t_j - t))}` at the rate with the largest modulus; a course's:
    the median.

    Args:
        phase: ``(T, classes)``, NaN = not known; times: ``(T,)`` seconds; periodic: ``(classes,)``.

    Example:
        >>> import numpy as np
        >>> t = np.arange(20) / 10
        >>> noisy = ((t + 0.02 * (-1.0) ** np.arange(20)) % 1)[:, None]
        >>> bool(abs(smooth_phases(noisy, t, 1.0, np.array([True]))[15, 0] - 0.5) < 0.01)
        True
    """
    out = np.full_like(phase, np.nan)
    rates = np.linspace(-FASTEST, FASTEST, RATES)
    for i, time in enumerate(times):
        near = np.abs(times - time) <= seconds / 2
        for c, turns in enumerate(periodic):
            known = near & np.isfinite(phase[:, c])
            if not known.any():
                continue
            if not turns:
                out[i, c] = np.median(phase[known, c])
                continue
            total = np.exp(2j * np.pi * (phase[known, c] - rates[:, None] * (times[known] - time))).sum(1)
            best = total[np.abs(total).argmax()]
            out[i, c] = (np.angle(best) / (2 * np.pi)) % 1.0 % 1.0
    return out
