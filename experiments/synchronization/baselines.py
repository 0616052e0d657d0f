"""How others synchronize tracks: one number per frame and camera, correlated at every shift of whole frames.

*Pose2Sim* is its procedure, written from a description: gaps bridged by straight lines, positions low-pass filtered forwards and
backwards (Butterworth, order 2, 6 Hz), the sum of the vertical speeds' absolute values over the keypoints, that sum filtered again
in the same way, Pearson's correlation per lag up to half the shorter take, the lag of the largest.
*Vertical* keeps the sign of the speeds; *activity* takes speeds in the image whatever their direction.
None of them knows refusal, other frame rates, or fractions of frames; the parabola through the best three correlations is added
here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, filtfilt
from torch import Tensor

from experiments.recognition.protocol import Array

CUTOFF = 6.0
"""Hz."""
OVERLAP = 0.5
"""Share of the shorter take that both cameras show at the largest lag tried."""


@dataclass(frozen=True)
class Answer:
    """What a baseline says: b's clock = a's clock + offset, seconds; it never refuses.  ``correlations`` at ``lags`` in frames."""

    offset: float
    lags: Array
    correlations: Array
    rate: float = 1.0
    ok: bool = True


def pose2sim(a: Tensor, b: Tensor, fps: float, max_shift: float | None = None, *, parabola: bool = False) -> Answer:
    """Sum of absolute vertical speeds, whole frames.

    Args:
        a, b: ``(frames, n, 2)`` px, NaN = missing, at the same ``fps``.
        max_shift: seconds; None = as far as the overlap allows.
        parabola: whether to interpolate between frames.
    """
    return _best([np.abs(_velocity(x, fps)[..., 1]).sum(-1) for x in (a, b)], fps, max_shift, parabola)


def vertical(a: Tensor, b: Tensor, fps: float, max_shift: float | None = None, *, parabola: bool = False) -> Answer:
    """Sum of vertical speeds, as :func:`pose2sim`."""
    return _best([_velocity(x, fps)[..., 1].sum(-1) for x in (a, b)], fps, max_shift, parabola)


def activity(a: Tensor, b: Tensor, fps: float, max_shift: float | None = None, *, parabola: bool = False) -> Answer:
    """Sum of speeds in the image, as :func:`pose2sim`."""
    return _best([np.linalg.norm(_velocity(x, fps), axis=-1).sum(-1) for x in (a, b)], fps, max_shift, parabola)


def _velocity(tracks: Tensor, fps: float) -> Array:
    """``(frames - 1, n, 2)`` px per frame, of filtered positions; tracks never seen stand still."""
    filled = tracks.numpy().copy()
    frames = np.arange(len(filled))
    for joint in range(filled.shape[1]):
        seen = np.isfinite(filled[:, joint]).all(-1)
        for axis in range(2):
            filled[:, joint, axis] = np.interp(frames, frames[seen], filled[seen, joint, axis]) if seen.any() else 0.0
    return np.diff(_smooth(filled, fps), axis=0)


def _smooth(curves: Array, fps: float) -> Array:
    """Along the first axis."""
    low = butter(2, min(CUTOFF / (fps / 2), 0.99))
    return np.asarray(filtfilt(*low, curves, axis=0, padlen=min(9, len(curves) - 1)))


def _best(curves: list[Array], fps: float, max_shift: float | None, parabola: bool) -> Answer:
    """The lag of the largest correlation of two curves."""
    first, second = (_smooth(curve, fps) for curve in curves)
    shorter = min(len(first), len(second))
    least = max(3, round(OVERLAP * shorter))
    widest = len(first) + len(second) if max_shift is None else int(max_shift * fps)
    lags = np.arange(max(least - len(first), -widest), min(len(second) - least, widest) + 1)
    scores = np.array([_correlation(first, second, int(lag)) for lag in lags])
    best = int(np.argmax(scores))
    shift = float(lags[best])
    if parabola and 0 < best < len(lags) - 1:
        before, peak, after = scores[best - 1 : best + 2]
        bend = before - 2 * peak + after
        shift += 0.5 * (before - after) / bend if bend < 0 else 0.0
    return Answer(shift / fps, lags, scores)


def _correlation(first: Array, second: Array, lag: int) -> float:
    """Pearson's, of frames i of the first and i + lag of the second; -1 where one does not change."""
    start, end = max(0, -lag), min(len(first), len(second) - lag)
    x, y = first[start:end], second[start + lag : end + lag]
    x, y = x - x.mean(), y - y.mean()
    scale = float(np.linalg.norm(x) * np.linalg.norm(y))
    return float(x @ y) / scale if scale > 0 else -1.0
