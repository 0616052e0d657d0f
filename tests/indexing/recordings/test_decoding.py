"""Recordings as segments: one event per performance, what is held back, and models that know less."""

import dataclasses

import numpy as np
import pytest

from indexing import ActionIndexer
from indexing.action.exemplars import recurrence
from indexing.actors import Person, dataset, detect, perform, stream
from indexing.windows import concatenate_clips

KNOWN = ("squat", "wave", "bow", "kick", "walk")


@pytest.fixture(scope="module")
def indexer():
    return ActionIndexer(scorer="nearest").fit(dataset([Person.random(0)], KNOWN, azimuth=0.0, rng=0))


@pytest.fixture(scope="module")
def three():
    """Three squats of another person, one after the other."""
    solid, truth = stream(["squat", "squat", "squat"], Person.random(1), rng=3)
    return detect(solid, azimuth=30.0, rng=5), truth


def test_three_squats_are_three_events(indexer, three):
    clip, truth = three
    found = indexer.find(clip)
    assert [event.label for event in found] == ["squat"] * 3
    for event, (_, start, end) in zip(found, truth, strict=True):
        shared = min(event.end, end) - max(event.start, start)
        assert shared / (max(event.end, end) - min(event.start, start)) > 0.5


def test_an_explanation_agrees_with_itself(indexer, three):
    clip, _ = three
    told = indexer.explain(clip)
    assert told.scores.shape == (len(clip), len(KNOWN)) and np.array_equal(told.times, clip.times)
    assert told.background.min() >= 0 and told.background.max() <= 1
    for event in told.events:
        inside = (told.times > event.start + 0.3) & (told.times < event.end - 0.3)
        assert (np.array(told.classes)[told.scores[inside].argmax(axis=1)] == event.label).mean() > 0.9
        assert told.background[inside].mean() < 0.5
    assert told.seconds("squat") == pytest.approx(sum(event.end - event.start for event in told.events))


def test_what_a_level_refuses_is_held_back(indexer, three):
    clip, _ = three
    strict = ActionIndexer(scorer="nearest", reject=1e6).fit(dataset([Person.random(0)], KNOWN, azimuth=0.0, rng=0))
    told = strict.explain(clip)
    low = [one for one in told.withheld if one.reason == "below the level"]
    assert list(told.events) == [] and [one.event.label for one in low] == ["squat"] * 3


def test_models_that_do_not_say_how_long_their_exemplars_last(indexer, three):
    clip, _ = three
    older = ActionIndexer(scorer="nearest").fit(dataset([Person.random(0)], KNOWN, azimuth=0.0, rng=0))
    exemplars = dataclasses.replace(older.model_.exemplars, seconds=None, cyclic=None)
    older.model_ = dataclasses.replace(older.model_, exemplars=exemplars)
    found = older.find(clip)
    assert [event.label for event in found] == ["squat"] * 3


def test_cycles_are_told_from_what_is_performed_once():
    person = Person.random(4)
    clips = [detect(perform(name, person, rng=1), azimuth=0.0, rng=1) for name in ("jumping_jack", "bow", "squat")]
    jack, bow, squat = recurrence(concatenate_clips(clips)).tolist()
    assert jack > 0.6 and bow < 0.4 and squat < 0.4


def test_blows_of_one_bout_are_one_performance_and_squats_in_a_row_are_not():
    lesson = dataset([Person.random(5)], ("squat", "punch", "bow", "kick"), azimuth=0.0, rng=2)
    indexer = ActionIndexer(scorer="nearest").fit(lesson)
    found = {}
    for action in ("punch", "squat"):
        clip = detect(perform(action, Person.random(8), repeats=3, rng=4), azimuth=30.0, rng=4)
        found[action] = [event.label for event in indexer.find(clip)]
    assert found == {"punch": ["punch"], "squat": ["squat"] * 3}
