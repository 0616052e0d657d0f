"""How well actions are found in untrimmed recordings, as pure functions of segments and of labels per frame.

A segment is an :class:`indexing.scoring.Event`: label, start and end in seconds, and a score where it was found (ignored in the
truth).  A recording is a list of them; what was found and what is true of several recordings are two lists of lists.

Average precision is that of ActivityNet and THUMOS (greedy matches from the highest score down, area under the interpolated
curve); the edit score and F1 are those of temporal segmentation (Lea et al. 2017).  All are between 0 and 1.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import numpy as np

from experiments.recognition.protocol import Array, runs
from indexing.scoring import Event

Segments = Sequence[Event]


def segments(labels: Array, step: float, background: Hashable = None) -> list[Event]:
    """Maximal runs of one label, as segments; frame i lasts from ``i * step`` to ``(i + 1) * step`` seconds.

    Args:
        labels: ``(frames,)``; background: the label of frames without an action.

    Example:
        >>> [(e.label, e.start, e.end) for e in segments(np.array([0, 0, 7, 7, 7, 0]), 0.5, background=0)]
        [(7, 1.0, 2.5)]
    """
    return [
        Event(labels[first].item(), first * step, last * step, 0.0, 0.0)
        for first, last in (runs(labels) if len(labels) else [])
        if labels[first] != background
    ]


def overlap(found: Segments, truth: Segments) -> Array:
    """``(found, truth)`` temporal intersection over union, whatever the labels.

    Example:
        >>> a, b = Event("a", 0.0, 2.0, 1.0, 0.0), Event("a", 1.0, 4.0, 0.0, 0.0)
        >>> overlap([a], [a, b]).tolist()
        [[1.0, 0.25]]
    """
    ends = [np.array([[one.start, one.end] for one in side], dtype=float).reshape(-1, 2) for side in (found, truth)]
    low = np.maximum(ends[0][:, None, 0], ends[1][None, :, 0])
    high = np.minimum(ends[0][:, None, 1], ends[1][None, :, 1])
    both = np.maximum(high - low, 0.0)
    either = np.diff(ends[0])[:, None, 0] + np.diff(ends[1])[None, :, 0] - both
    return np.asarray(both / np.maximum(either, 1e-12))


def average_precision(found: Sequence[Segments], truth: Sequence[Segments], label: Hashable, threshold: float) -> float:
    """Area under precision against recall of one class, over all recordings.

    From the highest score down, a find is right if it overlaps a segment of its class by at least the threshold that no earlier
    find took; precision is made to fall with recall.  NaN where the class is nowhere.

    Args:
        found, truth: one list of segments per recording; threshold: intersection over union.
    """
    total = sum(one.label == label for part in truth for one in part)
    if not total:
        return float("nan")
    finds = [(one.score, which, one) for which, part in enumerate(found) for one in part if one.label == label]
    finds.sort(key=lambda find: -find[0])
    true = [[one for one in part if one.label == label] for part in truth]
    taken = [np.zeros(len(part), dtype=bool) for part in true]
    right = np.zeros(len(finds), dtype=bool)
    for rank, (_, which, one) in enumerate(finds):
        shares = np.where(taken[which], -1.0, overlap([one], true[which])[0])
        if len(shares) and shares.max() >= threshold:
            right[rank] = True
            taken[which][int(shares.argmax())] = True
    hits = np.cumsum(right)
    precision = hits / np.arange(1, len(finds) + 1)
    falling = np.maximum.accumulate(precision[::-1])[::-1]
    return float(np.sum(falling[right]) / total)


def mean_average_precision(found: Sequence[Segments], truth: Sequence[Segments], threshold: float = 0.5) -> float:
    """Mean over the classes of the truth of :func:`average_precision`; finds of other classes do not count."""
    labels = {one.label for part in truth for one in part}
    values = [average_precision(found, truth, label, threshold) for label in labels]
    return float(np.mean(values)) if values else float("nan")


def f1(found: Sequence[Segments], truth: Sequence[Segments], threshold: float = 0.5) -> float:
    """F1 of segments over all recordings: right if the best overlap with a segment of the same label reaches the threshold.

    Each true segment counts once: what overlaps it after that is wrong, too.  Scores play no part.
    """
    hits, finds, total = 0, sum(map(len, found)), sum(map(len, truth))
    for part, true in zip(found, truth, strict=True):
        taken = np.zeros(len(true), dtype=bool)
        same = np.array([[a.label == b.label for b in true] for a in part], dtype=bool).reshape(len(part), len(true))
        for shares in overlap(part, true) * same:
            best = int(shares.argmax()) if len(shares) else -1
            if best >= 0 and shares[best] >= threshold and not taken[best]:
                taken[best], hits = True, hits + 1
    return 2 * hits / (finds + total) if finds + total else float("nan")


def edit_distance(a: Sequence[Hashable], b: Sequence[Hashable]) -> int:
    """Levenshtein distance: insertions, deletions and replacements that turn one sequence into the other.

    Example:
        >>> edit_distance("kitten", "sitting")
        3
    """
    row = list(range(len(b) + 1))
    for i, mine in enumerate(a, start=1):
        before, row[0] = row[0], i
        for j, theirs in enumerate(b, start=1):
            before, row[j] = row[j], min(row[j] + 1, row[j - 1] + 1, before + (mine != theirs))
    return row[-1]


def edit_score(found: Sequence[Segments], truth: Sequence[Segments]) -> float:
    """Mean over recordings of 1 - edit distance of the labels in order / length of the longer sequence: is the order right?"""
    values = []
    for part, true in zip(found, truth, strict=True):
        orders = [[one.label for one in sorted(side, key=lambda one: one.start)] for side in (part, true)]
        longer = max(map(len, orders))
        values.append(1 - edit_distance(*orders) / longer if longer else 1.0)
    return float(np.mean(values)) if values else float("nan")
