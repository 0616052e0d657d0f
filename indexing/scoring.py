"""Scores -> decisions: probabilities, thresholds, events.  Pure functions of arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit
from torch import Tensor

Array = NDArray[Any]


SHARPNESS = 2.0  # of the softmax over standardized scores: leave-one-out likelihood peaks between 1.5 and 2.5 on UTKinect
SHARPNESS_RANGE, NUM_HALVINGS = (1e-3, 1e4), 60  # within which the sharpness of a row is looked for, the interval halved so often
MIN_EVENT_SECONDS = 0.4  # shorter finds are flicker
MAX_GAP_SECONDS = 0.5  # between two finds of one class, which are then one


@dataclass(frozen=True)
class Event:
    """One action found in a recording; start and end in seconds on its clock.

    score: mean evidence while it lasts; margin: how far its class stands above the next one, 0 or more; exemplar: number
    of the exemplar that fits best, among those of the model.
    """

    label: Any
    start: float
    end: float
    score: float
    margin: float
    exemplar: int | None = None


def probabilities(scores: Array, sharpness: float = SHARPNESS) -> Array:
    """``(N, classes)`` softmax of ``sharpness`` times the scores, after standardizing each row."""
    centred = scores - scores.mean(axis=1, keepdims=True)
    spread = np.maximum(centred.std(axis=1, keepdims=True), 1e-9) if scores.shape[1] > 2 else 0.5
    exponent = sharpness * centred / spread
    odds = np.exp(exponent - exponent.max(axis=1, keepdims=True))
    return np.asarray(odds / odds.sum(axis=1, keepdims=True))


def sharpen(scores: Array, sure: Array) -> Array:
    """``(N, classes)`` softmax of the scores, each row as sharp as it must be for its best class to be as likely as ``sure``
    ``(N,)``, or as all others where that is less."""
    below = scores - scores.max(axis=1, keepdims=True)
    below = below / np.maximum(-below.mean(axis=1, keepdims=True), 1e-9)
    low, high = (np.full((len(scores), 1), end) for end in SHARPNESS_RANGE)
    for _ in range(NUM_HALVINGS):
        middle = (low + high) / 2
        likely = 1 / np.exp(middle * below).sum(axis=1, keepdims=True)
        low, high = np.where(likely < sure[:, None], middle, low), np.where(likely < sure[:, None], high, middle)
    odds = np.exp(high * below)
    return np.asarray(odds / odds.sum(axis=1, keepdims=True))


def reject_threshold(reject: float | None, wrong: Tensor, classes: int | None = None) -> float | None:
    r"""The least evidence that is accepted: what wrong evidence ``(N,)`` exceeds at a rate.

    Of few ``classes`` that it was learned from no quantile of a low rate can be counted, and the rate is that of the next class:
    :math:`\mu + \sigma \sqrt{1 + 1/C}\, t_{C-1}(1 - r)`, the upper end of Student's prediction interval.
    """
    if reject is None or not 0 < reject < 1:
        return reject
    values = wrong.cpu().numpy().astype(float)
    if classes is None:
        return float(np.quantile(values, 1 - reject))
    return float(values.mean() + values.std() * np.sqrt(1 + 1 / classes) * stdtrit(max(classes - 1, 1), 1 - reject))


def event_levels(wrong: Array, rate: float, extent: float, least: tuple[float, float]) -> tuple[float, float]:
    """What an event must reach somewhere, and throughout."""
    if not 0 < rate < 1:
        return float(rate), float(rate)
    if not len(wrong):
        return least
    peak, floor = np.quantile(wrong, [1 - rate, 1 - min(1.0, extent * rate)])
    return max(least[0], float(peak)), max(least[1], float(floor))


def smooth(scores: Array, times: Array, seconds: float) -> Array:
    """``(T, classes)`` mean of the scores over a centred interval of time."""
    total = np.vstack([np.zeros((1, scores.shape[1])), np.cumsum(scores, axis=0)])
    low = np.searchsorted(times, times - seconds / 2 - 1e-9)
    high = np.searchsorted(times, times + seconds / 2 + 1e-9)
    return np.asarray((total[high] - total[low]) / (high - low)[:, None])


def events(
    scores: Array,
    times: Array,
    classes: Sequence[Any],
    peak: float,
    floor: float,
    blocked: Array | None = None,
) -> list[Event]:
    """Runs of samples whose best class is the same: at least ``floor`` throughout and ``peak`` somewhere. scores
    ``(T, classes)``."""
    top = scores.max(axis=1)
    open_ = top >= floor if blocked is None else (top >= floor) & ~blocked
    state = np.where(open_, scores.argmax(axis=1), -1)
    middle = (times[1:] + times[:-1]) / 2
    edges = np.concatenate([times[:1], middle, times[-1:]])
    runs = _bridge_gaps(_runs(state), state, edges, MAX_GAP_SECONDS)
    # once flicker is gone, what it parted is one again
    long = [(a, b) for a, b in runs if edges[b + 1] - edges[a] >= MIN_EVENT_SECONDS]
    runs = _bridge_gaps(long, state, edges, MAX_GAP_SECONDS)
    events_ = []
    for first, last in runs:
        label, inside = int(state[first]), np.arange(first, last + 1)
        inside = inside[state[inside] == label]
        if top[inside].max() < peak:
            continue
        others = np.delete(scores[inside], label, axis=1).max(axis=1)
        score, margin = float(top[inside].mean()), float((top[inside] - others).mean())
        events_.append(Event(classes[label], float(edges[first]), float(edges[last + 1]), score, margin))
    return events_


def _bridge_gaps(runs: list[tuple[int, int]], state: Array, edges: Array, gap: float) -> list[tuple[int, int]]:
    """Runs of one class that only a short gap parts become one."""
    out: list[tuple[int, int]] = []
    for first, last in runs:
        if out and state[out[-1][0]] == state[first] and edges[first] - edges[out[-1][1] + 1] <= gap:
            out[-1] = (out[-1][0], last)
        else:
            out.append((first, last))
    return out


def _runs(state: Array) -> list[tuple[int, int]]:
    """First and last sample of every run of one state that is not -1."""
    cuts = np.flatnonzero(np.diff(state)) + 1
    firsts, lasts = np.concatenate([[0], cuts]), np.concatenate([cuts, [len(state)]]) - 1
    return [(int(a), int(b)) for a, b in zip(firsts, lasts, strict=True) if state[a] >= 0]


# ----------------------------------------------------------------------------------------------------------------------
# Labels of any one kind: put together, compared, and replaced where an answer is refused.


def same_label(a: Any, b: Any) -> bool:
    """Whether two labels are equal and of one type: 1 is not True."""
    return type(a) is type(b) and bool(a == b)


def join_labels(first: Array, second: Array) -> Array:
    """Labels of both, refusing to mix kinds that numpy would silently turn into strings."""
    if first.dtype.kind != second.dtype.kind and {first.dtype.kind, second.dtype.kind} & {"U", "S", "O"}:
        raise ValueError(
            f"labels: the fitted labels are of type {first.dtype}, the new ones {second.dtype}; give one kind of label"
        )
    return np.concatenate([first, second])


def refuse(labels: Array, refused: NDArray[np.bool_], none_label: Any) -> Array:
    """The labels with ``none_label`` where refused; the dtype stays where it can hold both."""
    if not refused.any():
        return np.asarray(labels)
    wide = np.asarray(none_label).dtype.kind == labels.dtype.kind
    out = labels.astype(np.result_type(labels.dtype, np.asarray(none_label).dtype) if wide else object)
    out[refused] = none_label
    return np.asarray(out)
