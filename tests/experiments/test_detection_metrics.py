"""Metrics of detection against cases worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.recognition import detection
from experiments.recognition.detection_metrics import (
    average_precision,
    edit_distance,
    edit_score,
    f1,
    mean_average_precision,
    overlap,
    segments,
)
from indexing.scoring import Event


def segs(*parts: tuple) -> list[Event]:
    """Segments of (label, start, end) or (label, start, end, score)."""
    return [Event(label, start, end, score[0] if score else 0.0, 0.0) for label, start, end, *score in parts]


TRUTH = [segs(("a", 0, 4), ("b", 4, 6), ("a", 10, 12))]


def test_runs_of_labels_are_segments_and_overlap() -> None:
    found = segments(np.array(["", "a", "a", "b", ""]), 0.1, background="")
    assert [(one.label, one.start, one.end) for one in found] == [("a", 0.1, pytest.approx(0.3)), ("b", pytest.approx(0.3), 0.4)]
    assert segments(np.zeros(0), 0.1) == []
    table = overlap(segs(("a", 0, 2), ("b", 5, 6)), segs(("c", 1, 3), ("d", 0, 2), ("e", 2, 5)))
    np.testing.assert_allclose(table, [[1 / 3, 1, 0], [0, 0, 0]])
    assert overlap([], segs(("a", 0, 1))).shape == (0, 1)
    left = detection.outside(segs(("a", 4.5, 6.4), ("b", 5.5, 8)), segs(("?", 4, 6)))  # finds in strange actions are left out
    assert left == segs(("b", 5.5, 8))


# by score: right (first a), wrong (a second time), wrong (too short), right (second a): precision 1, 1/2, 1/3, 1/2
MIXED = [segs(("a", 0, 3.9, 0.9), ("a", 0, 4, 0.8), ("a", 10, 10.5, 0.7), ("a", 10, 12, 0.6))]
# precision is made to fall with recall: a find that is wrong before two that are right
LATE = [segs(("a", 20, 21, 0.9), ("a", 0, 4, 0.8), ("a", 10, 12, 0.6))]
# the second overlaps the taken one more, and takes the one that is free
CROWDED = [segs(("a", 0, 10, 0.9), ("a", 1, 11, 0.8))], [segs(("a", 0, 10), ("a", 4, 14))]
RANKED = [segs(("a", 0, 1, 0.2)), segs(("a", 5, 6, 0.9))]


def test_average_precision_by_hand() -> None:
    for found, truth, expected in (
        (MIXED, TRUTH, (1 + 1 / 2) / 2),
        (LATE, TRUTH, 2 / 3),
        ([[]], TRUTH, 0.0),
        (*CROWDED, 1.0),
        (RANKED, [segs(("a", 0, 1))] * 2, 1 / 4),  # over all recordings
    ):
        assert average_precision(found, truth, "a", 0.5) == pytest.approx(expected)
    assert np.isnan(average_precision(MIXED, TRUTH, "z", 0.5))
    assert mean_average_precision(RANKED, [segs(("a", 0, 1), ("b", 2, 3)), []], 0.5) == pytest.approx(1 / 4)
    assert mean_average_precision(TRUTH, TRUTH, 1.0) == 1


def test_f1_by_hand() -> None:
    found = [segs(("a", 0, 3), ("a", 3, 4), ("b", 4, 5), ("c", 10, 12))]
    # first a and b are right (3/4 and 1/2 overlap), the piece of a and c are wrong, the second a is missed
    assert f1(found, TRUTH, 0.5) == pytest.approx(2 * 2 / (4 + 3))
    assert f1(found, TRUTH, 0.7) == pytest.approx(2 * 1 / 7)
    assert f1([[]], TRUTH) == 0 and f1(TRUTH, TRUTH, 1.0) == 1 and np.isnan(f1([[]], [[]]))


def brute(a: str, b: str) -> int:
    if not a or not b:
        return len(a) + len(b)
    return min(brute(a[1:], b) + 1, brute(a, b[1:]) + 1, brute(a[1:], b[1:]) + (a[0] != b[0]))


def test_edit_distance_against_recursion_and_its_score_looks_at_the_order_only() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        a, b = ("".join(rng.choice(list("xyz"), rng.integers(0, 6))) for _ in range(2))
        assert edit_distance(a, b) == brute(a, b)
    assert edit_score(TRUTH, TRUTH) == edit_score([segs(("b", 50, 60), ("a", 0, 1), ("a", 90, 99))], TRUTH) == 1
    assert edit_score([segs(("a", 0, 1))], TRUTH) == pytest.approx(1 / 3)
    assert edit_score([[], []], [[], segs(("a", 0, 1))]) == pytest.approx(1 / 2)
