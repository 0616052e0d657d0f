"""How sure answers are."""

import numpy as np
import pytest

from experiments.common.decisions import calibration_error
from indexing import ActionIndexer
from indexing.actors import Person, dataset
from indexing.scoring import sharpen

KNOWN = ("squat", "lunge", "kick", "wave", "punch")


def test_rows_are_as_sharp_as_asked_and_never_prefer_another_class():
    rng = np.random.default_rng(0)
    scores, sure = rng.normal(size=(200, 4)), rng.uniform(0.0, 1.0, 200)
    likely = sharpen(scores, sure)
    assert np.allclose(likely.sum(axis=1), 1) and np.array_equal(likely.argmax(axis=1), scores.argmax(axis=1))
    assert np.allclose(likely.max(axis=1), np.maximum(sure, 0.25), atol=1e-3)
    assert np.array_equal(likely.argsort(axis=1), scores.argsort(axis=1))
    assert np.allclose(sharpen(np.zeros((1, 4)), np.array([0.9])), 0.25)  # nothing to choose


@pytest.mark.slow
@pytest.mark.parametrize("scorer", ["both", "nearest", "kernel"])
def test_a_share_of_the_answers_is_right_that_is_told(scorer):
    lesson = dataset([Person.random(0), Person.random(1)], KNOWN, azimuth=0.0, rng=0)
    indexer, rng = ActionIndexer(scorer=scorer).fit(lesson), np.random.default_rng(1)
    sure, right = [], []
    for turn in (0.0, 90.0):
        test = dataset([Person.random(10 + k) for k in range(10)], KNOWN, azimuth=turn, rng=rng)
        bad = [
            clip.replace(joints=np.where(rng.random((*clip.seen.shape, 1)) < 0.3, 500.0 * rng.random(), clip.joints))
            for clip in test
        ]
        for clips in (list(test), bad):
            likely = indexer.predict_proba(clips)
            assert np.array_equal(likely.argmax(axis=1), indexer.decision_function(clips).argmax(axis=1))
            sure.append(likely.max(axis=1))
            right.append(indexer.classes_[likely.argmax(axis=1)] == test.labels)
    assert calibration_error(np.concatenate(sure), np.concatenate(right)) < 0.12
