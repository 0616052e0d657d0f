"""Repetitions of synthetic people are counted from the front and from the side, however the events were cut."""

import numpy as np
import pytest

from indexing import Event
from indexing.actors import Person, detect, perform, stream
from indexing.recordings.repetitions import Repetition, RepetitionCount, count_repetitions


def shown(action):
    return [detect(perform(action, Person.random(40 + k), rng=k), azimuth=0.0, rng=k) for k in range(2)]


@pytest.mark.parametrize(("action", "unit"), [("squat", "performance"), ("kick", "performance"), ("jumping_jack", "cycle")])
@pytest.mark.parametrize("azimuth", [0.0, 90.0])
def test_touching_repetitions_are_counted(action, unit, azimuth):
    seen = detect(perform(action, Person.random(7), repeats=6, rng=1), azimuth=azimuth, rng=1)
    (found,) = count_repetitions(seen, [Event(action, 0.0, seen.duration, 1.0, 1.0)], {action: shown(action)})
    assert found.unit == unit
    assert abs(found.count - 6) <= 1


def test_events_that_are_split_make_no_more():
    solid, truth = stream(["bow"] * 5, Person.random(3), rng=2)
    seen = detect(solid, azimuth=90.0, rng=2)
    events = [Event("bow", a, b, 1.0, 1.0) for _, s, e in truth for a, b in ((s, (s + e) / 2), ((s + e) / 2, e))]
    (found,) = count_repetitions(seen, events, {"bow": shown("bow")})
    assert found.count == 5
    assert all(0.1 < reach < 1.0 for reach in found.ranges)


def test_durations_and_pauses():
    one = RepetitionCount("bow", (Repetition(0.0, 1.0, 0.2), Repetition(1.5, 3.0, 0.3)))
    assert (one.count, one.durations, one.pauses, one.ranges) == (2, (1.0, 1.5), (0.5,), (0.2, 0.3))


def test_nothing_found_is_nothing_counted_and_other_joints_are_refused():
    seen = detect(perform("bow", Person(), rng=1), azimuth=0.0)
    assert count_repetitions(seen, []) == []
    other = seen.replace(joints=np.zeros((len(seen), 5, 2)), confidence=None, skeleton=None)
    with pytest.raises(ValueError, match="5 joints"):
        count_repetitions(seen, [Event("bow", 0.0, 1.0, 1.0, 1.0)], {"bow": [other]})
