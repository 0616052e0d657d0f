"""Events that are told apart from other movement."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.recognition.other_movement import right_events
from indexing import ActionIndexer
from indexing.actors import Person, dataset, detect, stream
from indexing.recordings.verification import FIGURES, adapt, log_odds
from indexing.scoring import Event

KNOWN, OTHERS = ("squat", "wave", "kick", "walk"), ("punch", "throw", "jumping_jack")


def test_doubtful_events_are_what_the_others_of_their_recording_are():
    doubtful = np.zeros(1)
    assert adapt(np.concatenate([np.full(30, 6.0), doubtful]))[-1] > 0
    assert adapt(np.concatenate([np.full(30, -6.0), doubtful]))[-1] < -2
    assert len(adapt(np.zeros(0))) == 0
    odds = np.random.default_rng(0).normal(size=20)
    assert np.array_equal(adapt(odds).argsort(), odds.argsort())


def test_more_evidence_is_more_likely_and_what_is_not_known_does_not_count():
    usual = np.zeros((3, len(FIGURES)))
    usual[:, FIGURES.index("evidence")] = (0.0, 0.5, 1.0)
    assert np.all(np.diff(log_odds(usual)) > 0)
    assert np.isfinite(log_odds(np.full((1, len(FIGURES)), np.nan))).all()


@pytest.mark.slow
def test_what_others_do_is_told_as_a_learned_action_hardly_ever_and_what_was_learned_is_told():
    indexer = ActionIndexer().fit(dataset([Person.random(k) for k in (0, 1, 2)], KNOWN, azimuth=0.0, rng=0))
    every = ActionIndexer(reject=-1e9).fit(dataset([Person.random(k) for k in (0, 1, 2)], KNOWN, azimuth=0.0, rng=0))
    rng, counts = np.random.default_rng(5), np.zeros((2, 2), dtype=int)
    for number in range(6):
        for row, actions in enumerate((KNOWN, OTHERS)):
            solid, spans = stream(rng.choice(actions, 6).tolist(), Person.random(20 + number), rng=rng)
            clip, truth = detect(solid, azimuth=15.0, rng=rng), [Event(label, a, b, 0.0, 0.0) for label, a, b in spans]
            for column, one in enumerate((every, indexer)):
                found = one.find(clip)
                counts[row, column] += len(found) if row else right_events(found, truth).sum()
    assert counts[0, 1] > 0.7 * counts[0, 0] and counts[1, 1] <= 0.1 * counts[1, 0] and counts[1, 0] > 15, counts.tolist()
