r"""How far two sets of labels of the same recordings agree: a person's and a model's, or those of two people.

Time is integrated exactly, between the boundaries of the labels, so that no grid and no frame rate decides anything.  Of a span
of time let :math:`d_i` be the durations between neighbouring boundaries, and :math:`K_i`, :math:`F_i` the labels that are known and
found there.  **Confusion over time** is the table

.. math:: T_{ab} = \sum_i d_i\, w_i(a, b), \qquad \sum_{ab} w_i(a, b) = 1

whose rows are what is known and whose columns are what was found, no label among them.  Where at most one label holds at a time,
:math:`w_i` is 1 for the pair and 0 elsewhere.  Where several hold, the moment is shared evenly: with
:math:`m = \max(|K_i|, |F_i|)`, each label of both gives :math:`1 / m` to the diagonal, and the others of :math:`K_i` are spread
evenly over the others of :math:`F_i`, of which the shorter list is filled up with no label.  So the table always sums to the time
compared.

**Cohen's kappa over time** (Cohen 1960) is agreement beyond chance,

.. math:: \kappa = \frac{p - e}{1 - e}, \quad p = \frac{\operatorname{tr} T}{S}, \quad
          e = \sum_a \frac{T_{a\cdot} T_{\cdot a}}{S^2}, \quad S = \sum_{ab} T_{ab},

the limit of the usual kappa per frame as frames become short.  No label counts as one of the answers: a recording in which little
happens agrees on much of its time.

**F1 at an overlap k** is that of temporal segmentation (Lea et al. 2017; MS-TCN, Farha and Gall 2019): segments found are taken in
order of time, each is compared with the known segment of its label with the largest temporal intersection over union, and is right
where that is k or more and no earlier one took it.  Segments are compared by label, and within one person of one recording.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Interval = tuple[Hashable, float, float]
NONE = "(none)"
SHARE_EPSILON = 1e-9  # an overlap of exactly one half is one half, however its ends were rounded

OVERLAPS = (0.1, 0.25, 0.5)  # intersection over union from which two segments are one
MAX_LABELS = 500  # different ones: free text is no label, and a table of more is neither read nor drawn
BLOCK = 128
"""Moments between boundaries that are counted at a time, and only the labels that hold in them: 50,000 labels of 500 names take
0.8 s and 12 MB so, 6.6 s and 0.94 GB all at once.  It changes no result."""


@dataclass(frozen=True)
class ComparedSpan:
    """The time of one person in one recording, and the labels of both sides in it."""

    name: str
    start: float
    end: float
    known: Sequence[Interval]
    found: Sequence[Interval]
    person: str = ""


@dataclass(frozen=True)
class SegmentCounts:
    """How many segments were found, how many are known, and how many of those found are right."""

    right: int
    found: int
    known: int

    def __add__(self, other: SegmentCounts) -> SegmentCounts:
        return SegmentCounts(self.right + other.right, self.found + other.found, self.known + other.known)

    @property
    def precision(self) -> float:
        """Share of what was found; NaN where nothing was."""
        return self.right / self.found if self.found else math.nan

    @property
    def recall(self) -> float:
        """Share of what is known; NaN where nothing is."""
        return self.right / self.known if self.known else math.nan

    @property
    def f1(self) -> float:
        """Harmonic mean of both; NaN where nothing is known and nothing was found."""
        return 2 * self.right / (self.found + self.known) if self.found + self.known else math.nan


@dataclass(frozen=True)
class LabelAgreement:
    """One label: seconds known, found, and both; kappa of this label against everything else; segments at each overlap."""

    known: float
    found: float
    both: float
    kappa: float
    segments: Mapping[float, SegmentCounts]


@dataclass(frozen=True, eq=False)
class Agreement:
    """How far two sets of labels agree."""

    labels: tuple[str, ...]
    seconds: FloatArray
    by_label: Mapping[str, LabelAgreement]
    segments: Mapping[float, SegmentCounts]

    @property
    def total_seconds(self) -> float:
        """Seconds, of all people."""
        return float(self.seconds.sum())

    @property
    def kappa(self) -> float:
        """Cohen's, over time; NaN where both sides say one and the same throughout."""
        return kappa(self.seconds)

    @property
    def agreement(self) -> float:
        """Share of the time in which both say the same; NaN where no time is compared."""
        return float(np.trace(self.seconds)) / self.total_seconds if self.total_seconds > 0 else math.nan

    def to_json(self) -> dict[str, Any]:
        """All numbers in the types of JSON."""
        by_label = {
            name: {
                "seconds_known": one.known,
                "seconds_found": one.found,
                "seconds_both": one.both,
                "kappa": one.kappa,
                "at_overlap": _at_overlap(one.segments),
            }
            for name, one in self.by_label.items()
        }
        return {
            "seconds_compared": self.total_seconds,
            "agreement": self.agreement,
            "kappa": self.kappa,
            "at_overlap": _at_overlap(self.segments),
            "by_label": by_label,
            "confusion_seconds": {"labels": [*self.labels, NONE], "rows_known_columns_found": self.seconds.tolist()},
        }


def _at_overlap(segments: Mapping[float, SegmentCounts]) -> dict[str, Any]:
    return {
        f"{overlap:g}": {**vars(one), "precision": one.precision, "recall": one.recall, "f1": one.f1}
        for overlap, one in segments.items()
    }


def compare(spans: Sequence[ComparedSpan]) -> Agreement:
    """How far what was found agrees with what is known, over all spans together."""
    inside = [(_inside(one.known, one), _inside(one.found, one)) for one in spans]
    names = sorted({str(label) for sides in inside for side in sides for label, _, _ in side})
    if len(names) > MAX_LABELS:
        raise ValueError(
            f"{len(names):,} different labels, of which {MAX_LABELS} can be compared; are they free text? choose a tier that "
            "holds names of actions"
        )
    number = {name: index for index, name in enumerate(names)}
    table = np.zeros((len(names) + 1, len(names) + 1))
    lasting = np.zeros((len(names), 3))
    for span, (known, found) in zip(spans, inside, strict=True):
        for lengths, here, there, used in _moments(span, (known, found), number):
            table[np.ix_([*used, -1], [*used, -1])] += time_table(lengths, here, there)
            lasting[used] += np.stack([lengths @ side for side in (here, there, here & there)], axis=1)
    segments = {overlap: _count_segments(inside, names, overlap) for overlap in OVERLAPS}
    total = float(table.sum())
    by_label = {}
    for i, name in enumerate(names):
        mine, theirs, both = map(float, lasting[i])
        alone = _one_against_all(lasting[i], total)
        by_label[name] = LabelAgreement(mine, theirs, both, alone, {overlap: each[i] for overlap, each in segments.items()})
    together = {overlap: sum(each, SegmentCounts(0, 0, 0)) for overlap, each in segments.items()}
    return Agreement(tuple(names), table, by_label, together)


def _inside(intervals: Sequence[Interval], span: ComparedSpan) -> list[Interval]:
    """Intervals cut at the ends of a span, in order of time."""
    out = []
    if not (math.isfinite(span.start) and math.isfinite(span.end) and span.start <= span.end):
        raise ValueError(f"{span.name}: {span.start} s to {span.end} s is no span of time; give seconds, start first")
    for label, start, end in intervals:
        if not (math.isfinite(start) and math.isfinite(end) and start <= end):
            raise ValueError(f"{span.name}: {label!r} from {start} s to {end} s is no interval; give seconds, start first")
        low, high = max(start, span.start), min(end, span.end)
        if high > low:
            out.append((label, low, high))
    return sorted(out, key=lambda one: (one[1], one[2], str(one[0])))


def _moments(
    span: ComparedSpan, sides: tuple[Sequence[Interval], Sequence[Interval]], number: Mapping[str, int]
) -> Iterator[tuple[FloatArray, NDArray[np.bool_], NDArray[np.bool_], NDArray[np.int64]]]:
    """Block by block, durations ``(M,)`` between neighbouring boundaries, the labels ``(M, n)`` that are known and found there, and
    which ``(n,)`` labels these are."""
    edges = np.unique([t for side in sides for _, start, end in side for t in (start, end)] + [span.start, span.end])
    edges = edges[(edges >= span.start) & (edges <= span.end)]
    lengths = np.diff(edges)
    changes = [_changes(edges, side, number) for side in sides]
    holding: NDArray[np.int32] = np.zeros((2, len(number)), dtype=np.int32)  # how often each label holds before a block
    for first in range(0, len(lengths), BLOCK):
        rows = min(BLOCK, len(lengths) - first)
        parts = [each[:, slice(*np.searchsorted(each[0], [first, first + rows]))] for each in changes]
        used = np.unique(np.concatenate([parts[0][1], parts[1][1], np.flatnonzero(holding.any(axis=0))]))
        held = []
        for before, (at, label, step) in zip(holding, parts, strict=True):
            change: NDArray[np.int32] = np.zeros((rows, len(used)), dtype=np.int32)
            np.add.at(change, (at - first, np.searchsorted(used, label)), step)
            change[0] += before[used]
            times = np.cumsum(change, axis=0, dtype=np.int32)
            before[used] = times[-1]
            held.append(times > 0)
        yield lengths[first : first + rows], held[0], held[1], used


def _changes(edges: FloatArray, side: Sequence[Interval], number: Mapping[str, int]) -> NDArray[np.int64]:
    """``(3, K)``: at which boundary which label begins (1) or ends (-1), in order of the boundaries."""
    rows = np.searchsorted(edges, [[start for _, start, _ in side], [end for *_, end in side]])
    labels = [number[str(label)] for label, _, _ in side]
    out = np.array([rows.ravel(), labels * 2, [1] * len(side) + [-1] * len(side)], dtype=np.int64)
    return out[:, np.argsort(out[0], kind="stable")]


def time_table(lengths: FloatArray, known: NDArray[np.bool_], found: NDArray[np.bool_]) -> FloatArray:
    r"""``(n + 1, n + 1)`` seconds, rows known, columns found, the last of both no label; it sums to the sum of the lengths."""
    both = known & found
    each = np.maximum(np.maximum(known.sum(axis=1), found.sum(axis=1)), 1)
    num_unmatched = each - both.sum(axis=1)
    share = lengths / each
    unmatched = []
    for side in (known, found):
        alone = side & ~both
        unmatched.append(np.column_stack([alone, num_unmatched - alone.sum(axis=1)]).astype(np.float64))
    spread = np.divide(share, num_unmatched, out=np.zeros(len(lengths)), where=num_unmatched > 0)
    table = (unmatched[0] * spread[:, None]).T @ unmatched[1]
    table[np.arange(both.shape[1]), np.arange(both.shape[1])] += share @ both
    return np.asarray(table)


def kappa(table: FloatArray) -> float:
    """Cohen's kappa of a square table of counts or seconds; NaN where chance alone explains everything."""
    total = float(table.sum())
    if not total > 0:
        return math.nan
    message = float(np.trace(table)) / total
    chance = float(table.sum(axis=1) @ table.sum(axis=0)) / total**2
    return (message - chance) / (1 - chance) if chance < 1 - SHARE_EPSILON else math.nan


def _one_against_all(lasting: FloatArray, total: float) -> float:
    """Kappa of one label and everything else, from the seconds in which it is known, found, and both."""
    known, found, both = lasting.tolist()
    return kappa(np.array([[both, known - both], [found - both, total - known - found + both]]))


def _count_segments(
    inside: Sequence[tuple[Sequence[Interval], Sequence[Interval]]], names: Sequence[str], overlap: float
) -> list[SegmentCounts]:
    """Of each label, the segments of all spans."""
    counts = {name: SegmentCounts(0, 0, 0) for name in names}
    for known, found in inside:
        sides = [_by_label(side) for side in (known, found)]
        for name in {*sides[0], *sides[1]}:
            mine, theirs = sides[0].get(name, []), sides[1].get(name, [])
            counts[name] += SegmentCounts(right_segments(theirs, mine, overlap), len(theirs), len(mine))
    return [counts[name] for name in names]


def _by_label(side: Sequence[Interval]) -> dict[str, list[tuple[float, float]]]:
    out: dict[str, list[tuple[float, float]]] = {}
    for label, start, end in side:
        out.setdefault(str(label), []).append((start, end))
    return out


def right_segments(found: Sequence[tuple[float, float]], known: Sequence[tuple[float, float]], overlap: float) -> int:
    """How many segments found of one label are right: each of a known one of its own, with which it shares enough of the time."""
    ends = np.array(sorted(known), dtype=np.float64).reshape(-1, 2)
    # sorted by their begins, those that can share time with a segment stand together: from the first one up to which anything ends
    # behind its start, to the last one that begins before its end
    latest = np.maximum.accumulate(ends[:, 1]) if len(ends) else ends[:, 1]
    taken = np.zeros(len(ends), dtype=bool)
    for start, end in sorted(found):
        first, last = np.searchsorted(latest, start, side="right"), np.searchsorted(ends[:, 0], end)
        if first >= last:
            continue
        near = ends[first:last]
        both = np.maximum(np.minimum(near[:, 1], end) - np.maximum(near[:, 0], start), 0.0)
        shares = both / ((near[:, 1] - near[:, 0]) + (end - start) - both)
        best = int(shares.argmax())
        if shares[best] >= overlap - SHARE_EPSILON and not taken[first + best]:
            taken[first + best] = True
    return int(taken.sum())
