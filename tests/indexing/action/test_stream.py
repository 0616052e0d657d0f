"""Untrimmed recordings: a score for every frame, and the events they form."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from indexing import ActionIndexer, Event, PhaseIndexer
from indexing.action.exemplars import slide
from indexing.actors import ACTIONS, Person, dataset, detect, stream
from indexing.windows import concatenate_clips

KNOWN = ("squat", "wave", "bow", "jumping_jack", "kick", "walk")
ORDER = ("squat", "wave", "bow", "kick", "jumping_jack", "squat", "walk", "wave")


@pytest.fixture(scope="module")
def indexer():
    return ActionIndexer().fit(dataset([Person.random(0)], KNOWN, azimuth=0.0, rng=0))


@pytest.fixture(scope="module")
def recordings():
    """The same person filmed from the learned view and from the side, with the truth."""
    solid, truth = stream(ORDER, Person.random(1), rng=3)
    return [detect(solid, azimuth=azimuth, rng=5) for azimuth in (0.0, 60.0)], truth


def frame_accuracy(indexer, clip, truth):
    answer = indexer.classes_[indexer.score_frames(clip).argmax(axis=1)]
    right = [answer[(clip.times >= start) & (clip.times <= end)] == label for label, start, end in truth]
    return np.concatenate(right).mean()


def hits(found, truth):
    """Which true actions have an event of their label around their middle."""
    return [any(e.label == label and e.start <= (a + b) / 2 <= e.end for e in found) for label, a, b in truth]


@pytest.mark.slow
def test_frames_have_scores_and_events_whatever_the_clock(indexer, recordings):
    clips, truth = recordings
    for clip in clips:
        late = clip.replace(times=clip.times + 500.0, fps=None)
        results = [indexer.scan(one) for one in (clip, late)]
        for one, (scores, events) in zip((clip, late), results, strict=True):
            assert scores.shape == (len(clip), len(KNOWN)) and np.isfinite(scores).all()
            assert events and all(isinstance(event, Event) for event in events)
            assert all(one.times[0] <= e.start < e.end <= one.times[-1] for e in events)
            assert all(a.end <= b.start for a, b in pairwise(events))
            assert all(e.label in indexer.classes_ and np.isfinite([e.score, e.margin]).all() and e.margin >= 0 for e in events)
            assert all(indexer.classes_[indexer.model_.labels[e.exemplar]] == e.label for e in events)
        assert frame_accuracy(indexer, clip, truth) > 0.7
        np.testing.assert_allclose(results[0][0], results[1][0], atol=0.05)
        for a, b in zip(results[0][1], results[1][1], strict=True):
            assert (a.label, a.start, a.end) == (b.label, *(pytest.approx(t - 500, abs=0.02) for t in (b.start, b.end)))


@pytest.mark.slow
def test_labels_keep_their_type_and_arrays_have_the_rate_of_the_indexer(recordings):
    clip = recordings[0][0]
    lesson = dataset([Person.random(0)], KNOWN, azimuth=0.0, rng=0)
    fast = ActionIndexer(scorer="nearest", fps=60.0).fit(lesson, np.arange(10, 16))
    events = fast.find(clip.joints * [1, -1])
    assert events and {e.label for e in events} <= set(range(10, 16)) and max(e.end for e in events) <= (len(clip) - 1) / 60.0
    assert fast.set_params(reject=1e9).fit(lesson).find(clip) == []


@pytest.mark.slow
def test_the_frame_rate_does_not_matter(indexer, recordings):
    clip, truth = recordings[0][0], recordings[1]
    half = clip.replace(joints=clip.joints[::2], times=clip.times[::2], confidence=None, fps=None)
    full, coarse = indexer.score_frames(clip)[::2], indexer.score_frames(half)
    assert (full.argmax(axis=1) == coarse.argmax(axis=1)).mean() > 0.85
    assert frame_accuracy(indexer, half, truth) > 0.7


def test_recordings_shorter_than_a_window_and_stray_frames(indexer, recordings):
    clip = recordings[0][0]
    for frames in (2, 3, 10, 25):
        short = clip.between(clip.times[40], clip.times[39 + frames])
        scores = indexer.score_frames(short)
        assert scores.shape == (frames, len(KNOWN)) and np.isfinite(scores).all()
        assert all(short.times[0] <= e.start < e.end <= short.times[-1] for e in indexer.find(short)), frames
    stray = np.array([1e5, 1e7, 1e9])
    more = clip.replace(
        joints=np.concatenate([clip.joints, clip.joints[:3]]), times=np.concatenate([clip.times, stray]), confidence=None, fps=None
    )
    scores, found = indexer.scan(more)
    assert [(e.label, e.start, e.end) for e in found] == [(e.label, e.start, e.end) for e in indexer.find(clip)]
    assert len(scores) == len(more) and (scores[-3:] == scores[-1, 0]).all()


def test_most_true_actions_are_found_and_joints_lost_for_a_while_do_not_break_the_scan(indexer, recordings):
    (clip, side), truth = recordings
    assert np.mean(hits(indexer.find(clip), truth)) >= 0.75 and np.mean(hits(indexer.find(side), truth)) >= 0.6
    joints = clip.joints.copy()
    joints[:, 3] = np.nan
    joints[100:130] = np.nan  # nobody in the picture
    holed = clip.replace(joints=joints)
    assert np.isfinite(indexer.score_frames(holed)).all()
    assert frame_accuracy(indexer, holed, truth) > 0.65
    with pytest.raises(ValueError, match=r"33.3 s apart, and a window lasts 1 s; times are seconds"):
        indexer.find(clip.replace(times=clip.times * 1000, fps=None))  # milliseconds


def test_progress_grows_to_one(indexer, recordings, monkeypatch):
    monkeypatch.setattr("indexing.action.stream.BLOCK", 50)
    told = []
    blocks = indexer.score_frames(recordings[0][0], progress=told.append)
    assert len(told) > 1 and told == sorted(told)
    assert told[0] > 0 and told[-1] == 1.0
    monkeypatch.undo()
    # scores are logarithms of likelihoods: of the faintest, rounding is seen
    np.testing.assert_allclose(np.exp(blocks), np.exp(indexer.score_frames(recordings[0][0])), atol=5e-3)


# ---- nobody there, nothing done ------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_nothing_is_found_while_nobody_is_seen(indexer, recordings):
    clip = recordings[0][0]
    half = len(clip) // 2
    gap = np.full((6000, *clip.joints.shape[1:]), np.nan)
    joints = np.concatenate([clip.joints[:half], gap, clip.joints[half:]])
    holed = clip.replace(joints=joints, times=None, fps=30.0, confidence=None)
    jump = clip.replace(times=np.where(np.arange(len(clip)) < half, clip.times, clip.times + 200.0), fps=None)
    for one in (holed, jump):
        start, end = one.times[half - 1] + 0.8, clip.times[half - 1] + 199.0
        assert all(event.end <= start or event.start >= end for event in indexer.find(one))
        assert np.isfinite(indexer.score_frames(one)).all()


@pytest.mark.slow
def test_a_resting_person_is_mostly_left_alone():
    lesson = dataset([Person.random(10)], ACTIONS, azimuth=0.0, rng=10)
    indexer = ActionIndexer(scorer="nearest").fit(lesson)
    solid, truth = stream(["squat", "kick", "wave", "bow"], Person.random(2), rng=3, rest=(6.0, 8.0))
    found = indexer.find(detect(solid, azimuth=30, rng=3))
    idle = [e for e in found if all(e.end <= start or e.start >= end for _, start, end in truth)]
    assert sum(e.end - e.start for e in idle) < 0.15 * solid.duration
    assert np.mean(hits(found, truth)) >= 0.75


# ---- gaps: what a recording costs is told by its frames, not by its clock ------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("gap", [20.0, 86400.0, 2.6e6, 1e9, 1e12])
def test_gaps_of_any_length_part_a_recording(indexer, recordings, gap):
    clip = recordings[0][0]
    half = len(clip) // 2
    early, late = clip.between(-1.0, clip.times[half - 1]), clip.between(clip.times[half], 1e3)
    torn = clip.replace(times=np.concatenate([early.times, late.times + gap]), fps=None)
    scores, found = indexer.scan(torn)
    (first, a), (second, b) = indexer.scan(early), indexer.scan(late)
    parts = a + [replace(event, start=event.start + gap, end=event.end + gap) for event in b]
    assert [event.label for event in found] == [event.label for event in parts]
    # what is usual is judged over the whole recording, so that a border may move by some steps of .1 s
    close = 0.5 + 1e-15 * gap
    for one, other in zip(found, parts, strict=True):
        assert (one.start, one.end) == (pytest.approx(other.start, abs=close), pytest.approx(other.end, abs=close))
    assert np.mean(scores.argmax(axis=1) == np.concatenate([first, second]).argmax(axis=1)) > 0.95


@pytest.mark.parametrize("gap", [60.0, 1e9])
def test_an_example_with_a_gap_is_no_single_performance(gap):
    clips = dataset([Person.random(0)], KNOWN[:3], azimuth=0.0, rng=0)
    torn = [clips[0].replace(times=clips[0].times + gap * (np.arange(len(clips[0])) > at), fps=None) for at in (9, 30)]
    for indexer in (ActionIndexer(scorer="nearest"), PhaseIndexer(harmonics=2)):
        with pytest.raises(ValueError, match=r"no frames for .* s after 0.3 s, which is most of the clip; .* cut it there"):
            indexer.fit([torn[0], *clips[1:]], list(KNOWN[:3]))
        indexer.fit(clips, list(KNOWN[:3]))
    with pytest.raises(ValueError, match="no frames for"):
        ActionIndexer(scorer="nearest").fit(clips).predict(torn[:1])
    assert all(event.end - event.start < gap for event in indexer.find(torn[1]))


def test_short_windows_of_an_example_stay_inside_its_parts():
    clip = dataset([Person.random(0)], KNOWN[:1], azimuth=0.0, rng=0)[0]
    held = clip.replace(times=clip.times + np.where(clip.times > clip.duration / 2, 1.4, 0.0), fps=None)
    source = concatenate_clips([held])
    moments, owner = slide(source, 12, 0.5, 0.1)
    whole, _ = slide(concatenate_clips([clip]), 12, 0.5, 0.1)
    assert (owner == 0).all() and len(moments) < len(whole)
    speed = moments.values.diff(dim=1).square().sum((1, 2, 3))
    assert speed.min() > 0.1 * whole.values.diff(dim=1).square().sum((1, 2, 3)).min()  # none is a frozen pose
