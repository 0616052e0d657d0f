"""Scores -> decisions: probabilities, thresholds, events.  Pure functions of arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

SHARPNESS = 2.0  # of the softmax over standardized scores: leave-one-out likelihood peaks between 1.5 and 2.5 on UTKinect
FALSE_ALARMS = 0.1  # rate at which `find` may take a wrong action for a known one, where `reject` is not set
SHORTEST = 0.3  # seconds: shorter finds are flicker

Array = NDArray[Any]


@dataclass(frozen=True)
class Event:
    """One action found in a recording; start and end in seconds on its clock.

    score: mean evidence while it lasts; margin: how far its class stands above the next one, same scale; exemplar: number
    of the exemplar that fits best, among those of the model.
    """

    label: Any
    start: float
    end: float
    score: float
    margin: float
    exemplar: int | None = None


def probabilities(scores: Array) -> Array:
    """``(N, classes)`` softmax of the scores after standardizing each row.

    Example:
        >>> import numpy as np
        >>> probabilities(np.array([[2.0, 0.0, 0.0]])).round(2).tolist()
        [[0.97, 0.01, 0.01]]
    """
    centred = scores - scores.mean(axis=1, keepdims=True)
    spread = np.maximum(centred.std(axis=1, keepdims=True), 1e-9) if scores.shape[1] > 2 else 0.5
    odds = np.exp(SHARPNESS * centred / spread - (SHARPNESS * centred / spread).max(axis=1, keepdims=True))
    return np.asarray(odds / odds.sum(axis=1, keepdims=True))


def reject_threshold(reject: float | None, wrong: Tensor) -> float | None:
    """The least evidence that is accepted.

    Args:
        reject: ``None``; a false-alarm rate in (0, 1); or, outside that interval, the threshold itself.
        wrong: ``(N,)`` the evidence that clips of one class find in the other classes.
    """
    if reject is None or not 0 < reject < 1:
        return reject
    return float(np.quantile(wrong.cpu().numpy(), 1 - reject))


def smooth(scores: Array, times: Array, seconds: float) -> Array:
    """``(T, classes)`` mean of the scores over a centred interval of time.

    Args:
        scores: ``(T, classes)``; times: ``(T,)`` increasing.
    """
    total = np.vstack([np.zeros((1, scores.shape[1])), np.cumsum(scores, axis=0)])
    low = np.searchsorted(times, times - seconds / 2 - 1e-9)
    high = np.searchsorted(times, times + seconds / 2 + 1e-9)
    return np.asarray((total[high] - total[low]) / (high - low)[:, None])


def events(scores: Array, times: Array, classes: Sequence[Any], threshold: float) -> list[Event]:
    """Runs of samples whose best class is the same and reaches the threshold.

    Args:
        scores: ``(T, classes)``; times: ``(T,)`` seconds.

    Example:
        >>> import numpy as np
        >>> found = events(np.array([[0, 1], [5, 1], [5, 2], [0, 1.0]]), np.arange(4.0), ["a", "b"], 3.0)
        >>> [(e.label, e.start, e.end, e.margin) for e in found]
        [('a', 0.5, 2.5, 3.5)]
    """
    best = scores.argmax(axis=1)
    top = scores.max(axis=1)
    state = np.where(top >= threshold, best, -1)
    cuts = np.flatnonzero(np.diff(state)) + 1
    edges = np.concatenate([[times[0]], (times[cuts - 1] + times[cuts]) / 2, [times[-1]]])
    found = []
    for i, run in enumerate(np.split(np.arange(len(times)), cuts)):
        label = state[run[0]]
        if label < 0 or edges[i + 1] - edges[i] < SHORTEST:
            continue
        others = np.delete(scores[run], label, axis=1)
        margin = float((top[run] - others.max(axis=1)).mean()) if others.shape[1] else float("inf")
        found.append(Event(classes[label], float(edges[i]), float(edges[i + 1]), float(top[run].mean()), margin))
    return found
