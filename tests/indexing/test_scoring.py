"""Scores -> decisions: pure functions of arrays."""

import numpy as np
import pytest
import torch

from indexing.scoring import events, probabilities, reject_threshold, smooth


def test_smooth_is_a_centred_mean():
    rng = np.random.default_rng(0)
    times, scores = np.cumsum(rng.uniform(0.05, 0.2, 40)), rng.normal(size=(40, 3))
    got = smooth(scores, times, 0.8)
    for i, t in enumerate(times):
        np.testing.assert_allclose(got[i], scores[np.abs(times - t) <= 0.4 + 1e-9].mean(axis=0))
    np.testing.assert_allclose(smooth(scores, times, 0.0), scores)


def test_events_by_hand():
    times = np.arange(10) * 0.5
    scores = np.full((10, 2), -1.0)
    scores[1:4, 0], scores[4:6, 1], scores[8, 1] = 5.0, 3.0, 0.5
    found = events(scores, times, ["a", "b"], 1.0, 1.0)
    assert [(e.label, e.start, e.end, e.score, e.margin) for e in found] == [
        ("a", 0.25, 1.75, 5.0, 6.0),
        ("b", 1.75, 2.75, 3.0, 4.0),
    ]
    assert events(scores, times, ["a", "b"], 9.0, 1.0) == []
    assert [e.label for e in events(scores, times, ["a", "b"], -5.0, -5.0)][:1] == ["a"]


def test_events_reach_the_ends_and_flicker_and_short_gaps_do_not_part_them():
    times = np.arange(6) * 0.15
    scores = np.array([[2.0, 0], [2, 0], [2, 0], [2, 0], [0, 2], [2, 0]])
    assert [(e.label, e.start, round(e.end, 3)) for e in events(scores, times, [0, 1], 1.0, 1.0)] == [(0, 0.0, 0.525)]
    times = np.arange(20) * 0.1
    scores = np.tile([2.0, 0.0], (20, 1))
    scores[8], scores[14] = [0.0, 2.0], [0.5, 0.0]
    (event,) = events(scores, times, ["a", "b"], 1.5, 1.0)
    assert (event.label, event.start, event.end, event.score) == ("a", 0.0, times[-1], 2.0)


def test_an_event_needs_its_peak_but_reaches_to_its_floor():
    times = np.arange(12) * 0.2
    scores = np.zeros((12, 2))
    scores[2:10, 0], scores[5, 0] = 1.5, 3.0
    assert [(e.start, e.end) for e in events(scores, times, ["a", "b"], 2.5, 1.0)] == [(pytest.approx(0.3), pytest.approx(1.9))]
    assert events(scores, times, ["a", "b"], 3.5, 1.0) == []


def test_probabilities_follow_the_scores():
    scores = np.random.default_rng(1).normal(size=(5, 4)) * [[1], [10], [1e-6], [1e4], [0]]
    chances = probabilities(scores)
    np.testing.assert_allclose(chances.sum(axis=1), 1)
    np.testing.assert_array_equal(chances[:4].argmax(axis=1), scores[:4].argmax(axis=1))
    np.testing.assert_allclose(chances[4], 0.25)
    np.testing.assert_allclose(probabilities(scores * 7 + 3)[0], chances[0])


def test_reject_threshold():
    wrong = torch.arange(101.0)
    assert reject_threshold(None, wrong) is None
    assert reject_threshold(0.1, wrong) == pytest.approx(90)
    assert reject_threshold(-3.5, wrong) == -3.5 and reject_threshold(7, wrong) == 7
    assert reject_threshold(-2.0, wrong, 5) == -2.0


def test_a_rate_is_that_of_the_next_class_however_few_it_was_learned_from():
    rng = np.random.default_rng(0)
    for classes in (4, 12):
        levels = rng.normal(size=(1000, classes + 1))
        for rate in (0.02, 0.1, 0.3):
            passed = [
                last >= reject_threshold(rate, torch.from_numpy(some), classes)
                for *some_, last in levels
                for some in [np.array(some_)]
            ]
            assert np.mean(passed) == pytest.approx(rate, abs=0.04), (classes, rate)
