"""Recordings as segments: one event per performance, what is held back, and models that know less."""

from __future__ import annotations

import copy
import dataclasses
from itertools import pairwise

import numpy as np
import pytest

from indexing import ActionIndexer, Clip
from indexing.action.exemplars import recurrence
from indexing.actors import Person, dataset, detect, perform, stream
from indexing.recordings.decoding import best_tiling, posterior, through
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


def test_three_squats_are_three_events_and_the_explanation_agrees_with_itself(indexer, three):
    clip, truth = three
    told = indexer.decode(clip)
    assert [event.label for event in told.events] == ["squat"] * 3
    for event, (_, start, end) in zip(told.events, truth, strict=True):
        shared = min(event.end, end) - max(event.start, start)
        assert shared / (max(event.end, end) - min(event.start, start)) > 0.5
    assert told.scores.shape == (len(clip), len(KNOWN)) and np.array_equal(told.times, clip.times)
    assert told.background.min() >= 0 and told.background.max() <= 1
    for event in told.events:
        inside = (told.times > event.start + 0.3) & (told.times < event.end - 0.3)
        assert (np.array(told.classes)[told.scores[inside].argmax(axis=1)] == event.label).mean() > 0.9
        assert told.background[inside].mean() < 0.5
    assert told.seconds("squat") == pytest.approx(sum(event.end - event.start for event in told.events))


def test_levels_hold_back_and_models_need_not_say_how_long_their_exemplars_last(indexer, three):
    other = ActionIndexer(scorer="nearest", reject=1e6).fit(dataset([Person.random(0)], KNOWN, azimuth=0.0, rng=0))
    told = other.decode(three[0])
    low = [one for one in told.withheld if one.reason == "below the level"]
    assert list(told.events) == [] and [one.event.label for one in low] == ["squat"] * 3
    other = copy.copy(indexer)
    exemplars = dataclasses.replace(indexer.model_.exemplars, seconds=None, cyclic=None)
    other.model_ = dataclasses.replace(indexer.model_, exemplars=exemplars)
    assert [event.label for event in other.find(three[0])] == ["squat"] * 3


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


# The best segments that do not overlap, against looking at every explanation there is


def explanations(windows, cells):
    """Every set of windows that do not overlap, as tuples of their numbers."""

    def grow(edge):
        if edge >= cells:
            yield ()
            return
        yield from grow(edge + 1)
        for number in np.flatnonzero(windows[:, 0] == edge).tolist():
            for rest in grow(int(windows[number, 1])):
                yield (number, *rest)

    return list(grow(0))


@pytest.fixture(params=range(4))
def problem(request):
    rng, cells = np.random.default_rng(request.param), 6
    windows = np.array([(a, b) for b in range(1, cells + 1) for a in range(b) if rng.random() < 0.6])
    return windows, rng.normal(size=(len(windows), 2)) * 2, rng.normal(size=cells)


def worth(chosen, windows, values, background):
    outside = np.ones(len(background), dtype=bool)
    for number in chosen:
        outside[windows[number, 0] : windows[number, 1]] = False
    return background[outside].sum() + sum(values[number].max() for number in chosen)


def test_the_best_explanation_and_the_sums_over_all(problem):
    windows, values, background = problem
    every = explanations(windows, len(background))
    segments, value = best_tiling(windows, values, background)
    assert value == pytest.approx(max(worth(chosen, *problem) for chosen in every))
    assert value == pytest.approx(worth([one.window for one in segments], *problem))
    assert all(a.last <= b.first for a, b in pairwise(segments))
    assert all(one.label == values[one.window].argmax() for one in segments)
    want = [max(worth(chosen, *problem) for chosen in every if number in chosen) for number in range(len(windows))]
    np.testing.assert_allclose(through(windows, values, background), want)
    want, total = np.zeros((len(background), 2)), 0.0
    for chosen in explanations(windows, len(background)):
        outside = np.ones(len(background), dtype=bool)
        for number in chosen:
            outside[windows[number, 0] : windows[number, 1]] = False
        weight = np.exp(background[outside].sum() / 0.7 + sum(np.logaddexp.reduce(values[k] / 0.7) for k in chosen))
        total += weight
        for number in chosen:
            share = np.exp(values[number] / 0.7 - np.logaddexp.reduce(values[number] / 0.7))
            want[windows[number, 0] : windows[number, 1]] += weight * share
    np.testing.assert_allclose(posterior(windows, values, background, 0.7), want / total, atol=1e-9)
    nothing = np.empty((0, 2), dtype=np.intp)  # where no window is there is background
    assert best_tiling(nothing, values[:0], background)[0] == [] and not posterior(nothing, values[:0], background, 1.0).any()


# Recordings whose clock or content is odd: one clear line, or an honest answer


DAY, YEARS = 86400.0, 30 * 365.25 * 86400.0


@pytest.fixture(scope="module")
def small_lesson():
    return dataset([Person.random(0)], ("squat", "wave", "kick"), azimuth=0.0, rng=0)


@pytest.fixture(scope="module")
def small_indexer(small_lesson):
    return ActionIndexer().fit(small_lesson)


@pytest.fixture(scope="module")
def clip():
    return detect(stream(("squat", "wave"), Person.random(1), rng=3)[0], azimuth=0, rng=5)


def timed(clip, times, joints=None):
    return Clip(clip.joints if joints is None else joints, times=times, up=clip.up, skeleton=clip.skeleton, name="odd")


def frames(clip):
    return np.arange(len(clip))


CLOCKS = {
    "a day in the middle": lambda c: c.times + DAY * (frames(c) > len(c) // 2),
    "thirty years in the middle": lambda c: c.times + YEARS * (frames(c) > len(c) // 2),
    "a day after every tenth frame": lambda c: c.times + DAY * (frames(c) // 10),
    "thirty years after every third frame": lambda c: frames(c) // 3 * YEARS + frames(c) % 3 / 30,
    "steps of a thousand-millionth": lambda c: frames(c) * 1e-9,
    "denormal": lambda c: frames(c) * 1e-310,
    "since 1970": lambda c: c.times + 1.7e9,
}


@pytest.mark.parametrize("clock", CLOCKS)
def test_any_clock_costs_what_its_frames_cost(clock, small_indexer, clip):
    odd = timed(clip, CLOCKS[clock](clip))
    told = []
    scores, found = small_indexer.scan(odd, told.append)
    assert scores.shape == (len(clip), 3) and np.isfinite(scores).all()
    assert all(odd.times[0] <= event.start <= event.end <= odd.times[-1] and np.isfinite(event.score) for event in found)
    assert all(event.end - event.start <= len(clip) for event in found)  # none reaches across a pause


@pytest.mark.parametrize(
    "times",
    [
        lambda c: np.linspace(0, 1e300, len(c)),
        lambda c: np.append(c.times[:-1], 1e300),
        lambda c: np.zeros(len(c)),
        lambda c: frames(c) * 5e-324,
        lambda c: frames(c) * YEARS,
        lambda c: np.where(frames(c) == 3, np.nan, c.times),
    ],
    ids=["to 1e300", "one of 1e300", "constant", "the smallest steps", "frames of thirty years", "NaN"],
)
def test_what_is_no_clock_is_refused_in_one_line(times, small_indexer, clip):
    for verb in (small_indexer.scan, small_indexer.find, small_indexer.score_frames):
        with pytest.raises(ValueError, match="times") as told:
            verb(timed(clip, times(clip)))
        assert "\n" not in str(told.value)


def test_few_frames_and_hardly_anybody_are_an_answer_one_frame_and_nobody_are_refused_by_name(small_indexer, clip):
    for count in (2, 3, 5):
        scores, found = small_indexer.scan(timed(clip, clip.times[:count], clip.joints[:count]))
        assert scores.shape == (count, 3) and np.isfinite(scores).all() and len(found) <= 1
    for kept in ([5], [5, -5]):
        joints = np.full_like(clip.joints, np.nan)
        joints[kept] = clip.joints[kept]
        scores, found = small_indexer.scan(timed(clip, clip.times, joints))
        assert found == [] and np.isfinite(scores).all()
    with pytest.raises(ValueError, match="clip 0 \\('odd'\\): joints: one frame only"):
        small_indexer.scan(timed(clip, clip.times[:1], clip.joints[:1]))
    with pytest.raises(ValueError, match="no joint was seen in any frame"):
        small_indexer.scan(timed(clip, clip.times, np.full_like(clip.joints, np.nan)))


def test_an_example_that_is_mostly_pauses_is_refused(small_lesson, clip):
    for clock in ("a day in the middle", "a day after every tenth frame", "thirty years after every third frame"):
        torn = timed(clip, CLOCKS[clock](clip))
        with pytest.raises(ValueError, match=r"no frames for .* a clip is one performance: cut it there"):
            ActionIndexer().fit([torn, *small_lesson], ["new", *small_lesson.labels])
