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


def seg(label: str, start: float, end: float, score: float = 0.0) -> Event:
    return Event(label, start, end, score, 0.0)


TRUTH = [[seg("a", 0, 4), seg("b", 4, 6), seg("a", 10, 12)]]


def test_runs_of_labels_are_segments() -> None:
    found = segments(np.array(["", "a", "a", "b", ""]), 0.1, background="")
    assert [one.label for one in found] == ["a", "b"]
    assert [(one.start, one.end) for one in found] == [pytest.approx((0.1, 0.3)), pytest.approx((0.3, 0.4))]
    assert segments(np.zeros(0), 0.1) == []


def test_overlap_by_hand() -> None:
    table = overlap([seg("a", 0, 2), seg("b", 5, 6)], [seg("c", 1, 3), seg("d", 0, 2), seg("e", 2, 5)])
    np.testing.assert_allclose(table, [[1 / 3, 1, 0], [0, 0, 0]])
    assert overlap([], [seg("a", 0, 1)]).shape == (0, 1)


def test_the_truth_is_perfect() -> None:
    assert mean_average_precision(TRUTH, TRUTH, 1.0) == 1
    assert f1(TRUTH, TRUTH, 1.0) == 1
    assert edit_score(TRUTH, TRUTH) == 1


def test_average_precision_by_hand() -> None:
    # by score: right (first a), wrong (a second time), wrong (too short), right (second a): precision 1, 1/2, 1/3, 1/2
    found = [[seg("a", 0, 3.9, 0.9), seg("a", 0, 4, 0.8), seg("a", 10, 10.5, 0.7), seg("a", 10, 12, 0.6)]]
    assert average_precision(found, TRUTH, "a", 0.5) == pytest.approx((1 + 1 / 2) / 2)
    # precision is made to fall with recall: a find that is wrong before two that are right
    found = [[seg("a", 20, 21, 0.9), seg("a", 0, 4, 0.8), seg("a", 10, 12, 0.6)]]
    assert average_precision(found, TRUTH, "a", 0.5) == pytest.approx(2 / 3)
    assert average_precision([[]], TRUTH, "a", 0.5) == 0
    assert np.isnan(average_precision(found, TRUTH, "z", 0.5))


def test_precision_is_ranked_over_all_recordings() -> None:
    truth = [[seg("a", 0, 1)], [seg("a", 0, 1)]]
    found = [[seg("a", 0, 1, 0.2)], [seg("a", 5, 6, 0.9)]]
    assert average_precision(found, truth, "a", 0.5) == pytest.approx(1 / 4)
    assert mean_average_precision(found, [[seg("a", 0, 1), seg("b", 2, 3)], []], 0.5) == pytest.approx(1 / 4)


def test_a_find_takes_the_segment_that_is_free() -> None:
    truth = [[seg("a", 0, 10), seg("a", 4, 14)]]
    found = [[seg("a", 0, 10, 0.9), seg("a", 1, 11, 0.8)]]  # the second overlaps the taken one more
    assert average_precision(found, truth, "a", 0.5) == 1


def test_f1_by_hand() -> None:
    found = [[seg("a", 0, 3), seg("a", 3, 4), seg("b", 4, 5), seg("c", 10, 12)]]
    # first a and b are right (3/4 and 1/2 overlap), the piece of a and c are wrong, the second a is missed
    assert f1(found, TRUTH, 0.5) == pytest.approx(2 * 2 / (4 + 3))
    assert f1(found, TRUTH, 0.7) == pytest.approx(2 * 1 / 7)
    assert f1([[]], TRUTH) == 0
    assert np.isnan(f1([[]], [[]]))


def brute(a: str, b: str) -> int:
    if not a or not b:
        return len(a) + len(b)
    return min(brute(a[1:], b) + 1, brute(a, b[1:]) + 1, brute(a[1:], b[1:]) + (a[0] != b[0]))


def test_edit_distance_against_recursion() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        a, b = ("".join(rng.choice(list("xyz"), rng.integers(0, 6))) for _ in range(2))
        assert edit_distance(a, b) == brute(a, b)


def test_edit_score_looks_at_the_order_only() -> None:
    found = [[seg("b", 50, 60), seg("a", 0, 1), seg("a", 90, 99)]]
    assert edit_score(found, TRUTH) == 1
    assert edit_score([[seg("a", 0, 1)]], TRUTH) == pytest.approx(1 / 3)
    assert edit_score([[], []], [[], [seg("a", 0, 1)]]) == pytest.approx(1 / 2)


def test_finds_in_strange_actions_are_left_out() -> None:
    strange = [seg("?", 4, 6)]
    assert detection.outside([seg("a", 4.5, 6.4), seg("b", 5.5, 8)], strange) == [seg("b", 5.5, 8)]
