"""Recordings whose clock or content is odd: one clear line, or an honest answer, and never more work than there are frames."""

from __future__ import annotations

import numpy as np
import pytest

from indexing import ActionIndexer, Clip
from indexing.actors import Person, dataset, detect, stream

DAY, YEARS = 86400.0, 30 * 365.25 * 86400.0


@pytest.fixture(scope="module")
def lesson():
    return dataset([Person.random(0)], ("squat", "wave", "kick"), azimuth=0.0, rng=0)


@pytest.fixture(scope="module")
def indexer(lesson):
    return ActionIndexer().fit(lesson)


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
def test_any_clock_costs_what_its_frames_cost(clock, indexer, clip):
    odd = timed(clip, CLOCKS[clock](clip))
    told = []
    scores, found = indexer.scan(odd, told.append)
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
def test_what_is_no_clock_is_refused_in_one_line(times, indexer, clip):
    for verb in (indexer.scan, indexer.find, indexer.score_frames):
        with pytest.raises(ValueError, match="times") as told:
            verb(timed(clip, times(clip)))
        assert "\n" not in str(told.value)


@pytest.mark.parametrize("count", [2, 3, 5])
def test_shorter_than_any_exemplar(count, indexer, clip):
    short = timed(clip, clip.times[:count], clip.joints[:count])
    scores, found = indexer.scan(short)
    assert scores.shape == (count, 3) and np.isfinite(scores).all() and len(found) <= 1


def test_one_frame_and_nobody_are_refused_by_name(indexer, clip):
    with pytest.raises(ValueError, match="clip 0 \\('odd'\\): joints: one frame only"):
        indexer.scan(timed(clip, clip.times[:1], clip.joints[:1]))
    with pytest.raises(ValueError, match="no joint was seen in any frame"):
        indexer.scan(timed(clip, clip.times, np.full_like(clip.joints, np.nan)))


@pytest.mark.parametrize("kept", [[5], [5, -5]], ids=["one frame", "two frames"])
def test_hardly_anybody_in_view_finds_nothing(kept, indexer, clip):
    joints = np.full_like(clip.joints, np.nan)
    joints[kept] = clip.joints[kept]
    scores, found = indexer.scan(timed(clip, clip.times, joints))
    assert found == [] and np.isfinite(scores).all()


def test_an_example_that_is_mostly_pauses_is_refused(lesson, clip):
    for clock in ("a day in the middle", "a day after every tenth frame", "thirty years after every third frame"):
        torn = timed(clip, CLOCKS[clock](clip))
        with pytest.raises(ValueError, match=r"no frames for .* a clip is one performance: cut it there"):
            ActionIndexer().fit([torn, *lesson], ["new", *lesson.labels])
