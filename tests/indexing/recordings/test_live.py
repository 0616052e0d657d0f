"""Recordings explained as their frames come in: the same events, whatever comes at once, in time, and within a bounded memory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from indexing import ActionIndexer
from indexing.actors import Person, dataset, detect, stream
from indexing.recordings import live as of_live
from indexing.recordings.evidence import whole_scores
from indexing.recordings.live import ActionStream, RunningLevel

KNOWN = ("squat", "wave", "bow", "kick", "walk")


@pytest.fixture(scope="module")
def indexer():
    return ActionIndexer().fit(dataset([Person.random(0)], KNOWN, azimuth=0.0, rng=0))


@pytest.fixture(scope="module")
def seen():
    """Six performances of another person, from the side, and when they are."""
    solid, truth = stream(["squat", "walk", "kick", "bow", "squat", "wave"], Person.random(1), rng=3)
    return detect(solid, azimuth=60.0, rng=5), truth


def pushed(live, clip, chunk, begin=0):
    """Everything that a stream says, and after how many seconds' frames each event was said."""
    told, when = [], []
    for at in range(begin, len(clip), chunk):
        answer = live.push(clip.joints[at : at + chunk], clip.times[at : at + chunk])
        told.append(answer)
        when += [float(clip.times[min(at + chunk, len(clip)) - 1])] * len(answer.events)
    rest = live.finish()
    return (
        np.concatenate([one.times for one in [*told, rest]]),
        np.concatenate([one.scores for one in [*told, rest]]),
        [event for one in told for event in one.events],
        list(rest.events),
        when,
    )


def overlapped(event, start, end):
    return (min(event.end, end) - max(event.start, start)) / (max(event.end, end) - min(event.start, start))


def plain(events):
    return [(event.label, event.start, event.end, event.score, event.margin, event.exemplar) for event in events]


@pytest.mark.slow
def test_a_stream_finds_what_is_found_in_the_whole(indexer, seen):
    clip, truth = seen
    times, scores, events, rest, _ = pushed(indexer.stream(up=clip.up), clip, 10)
    found, whole = events + rest, indexer.decode(clip)
    assert np.array_equal(times, clip.times) and scores.shape == (len(clip), len(KNOWN)) and np.isfinite(scores).all()
    assert [event.label for event in found] == [event.label for event in whole.events] == [name for name, _, _ in truth]
    assert all(overlapped(event, start, end) > 0.5 for event, (_, start, end) in zip(found, truth, strict=True))
    assert all(overlapped(event, other.start, other.end) > 0.6 for event, other in zip(found, whole.events, strict=True))
    acting = np.array([any(start < at < end for _, start, end in truth) for at in times])
    assert (scores.argmax(axis=1) == whole.scores.argmax(axis=1))[acting].mean() > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("lag", [None, 8.0])
def test_an_event_is_told_when_the_lag_is_over(lag, indexer, seen):
    clip, _ = seen
    live = indexer.stream(lag=lag, up=clip.up)
    assert lag is None or lag - 0.1 < live.lag <= lag
    _, _, events, rest, when = pushed(live, clip, 1)
    assert len(events) > 2 and all(at <= event.end + live.lag + 0.04 for event, at in zip(events, when, strict=True))
    assert all(event.end > clip.times[-1] - live.lag - 0.04 for event in rest)


@pytest.mark.slow
def test_what_comes_at_once_the_clock_and_the_order_of_joints_change_nothing(indexer, seen):
    clip, _ = seen
    turned = replace(clip.skeleton, joints=clip.skeleton.joints[::-1], bones=())
    deep = np.concatenate([clip.joints, np.full_like(clip.joints[..., :1], 5.0)], axis=2)[:, ::-1]  # looked at along its depth
    answers = [pushed(indexer.stream(up=clip.up), clip, chunk) for chunk in (1, 7, 100, len(clip))]
    answers.append(
        pushed(indexer.stream(up=clip.up, skeleton=turned), clip.replace(joints=deep, skeleton=turned, confidence=None), 100)
    )
    for times, scores, events, rest, _ in answers[1:]:
        assert np.array_equal(times, answers[0][0]) and np.array_equal(scores, answers[0][1])
        assert plain(events + rest) == plain(answers[0][2] + answers[0][3])
    _, _, events, rest, _ = pushed(indexer.stream(up=clip.up), clip.replace(times=clip.times + 1.7e9), 50)
    whole = answers[0][2] + answers[0][3]
    assert [event.label for event in events + rest] == [event.label for event in whole]
    assert [event.start - 1.7e9 for event in events + rest] == pytest.approx([event.start for event in whole], abs=0.02)


@pytest.mark.slow
def test_what_is_said_of_the_latest_frames_changes_nothing(indexer, seen):
    clip, _ = seen
    live, other = indexer.stream(up=clip.up), indexer.stream(up=clip.up)
    told, early = [], []
    for at in range(0, len(clip), 30):
        told.append(live.push(clip.joints[at : at + 30], clip.times[at : at + 30]))
        now = live.latest()
        assert now.times[-1] == clip.times[min(at + 30, len(clip)) - 1] and len(now.scores) == len(now.times)
        assert np.isfinite(now.scores).all()
        early += [event.label for event in now.events]
    events = [event for one in [*told, live.finish()] for event in one.events]
    _, _, same, rest, _ = pushed(other, clip, 30)
    assert plain(events) == plain(same + rest) and {event.label for event in events} <= set(early)


@pytest.mark.slow
def test_memory_does_not_grow(indexer, seen):
    clip, truth = seen
    live, kept, found = indexer.stream(up=clip.up), [], []
    for i in range(3):
        joints = clip.joints if i % 2 == 0 else clip.joints[::-1]
        for at in range(0, len(clip), 25):
            found += live.push(joints[at : at + 25], clip.times[at : at + 25] + i * (clip.times[-1] + 1 / 30)).events
            kept.append(live.num_frames)
    assert max(kept) < 30 * (live.lag + 6.0) and max(kept[-50:]) <= max(kept[:50]) + 30
    assert len(found) >= 2 * len(truth)
    arrays = [value for value in vars(live).values() if isinstance(value, np.ndarray)]
    assert all(len(array) <= max(kept) for array in arrays)


@pytest.mark.slow
@pytest.mark.parametrize("pause", [2.0, 86400.0, 30 * 365.25 * 86400.0], ids=["seconds", "a day", "thirty years"])
def test_nothing_reaches_across_a_pause(pause, indexer, seen):
    clip, truth = seen
    middle = len(clip) // 2
    odd = clip.replace(times=clip.times + pause * (np.arange(len(clip)) >= middle))
    times, scores, events, rest, _ = pushed(indexer.stream(up=clip.up), odd, 11)
    assert np.array_equal(times, odd.times) and np.isfinite(scores).all()
    before, after = odd.times[middle - 1], odd.times[middle]
    found = events + rest
    assert len(found) >= len(truth) - 2 and all(event.end <= before or event.start >= after for event in found)
    assert any(event.end <= before for event in found) and any(event.start >= after for event in found)


@pytest.mark.slow
def test_nobody_is_no_action_and_missing_joints_are_filled(indexer, seen):
    clip, truth = seen
    joints = np.array(clip.joints)
    away = (clip.times > truth[2][1] - 0.3) & (clip.times < truth[3][2])  # during the kick and the bow
    joints[away] = np.nan
    joints[::9, 5:9] = np.nan
    times, scores, events, rest, _ = pushed(indexer.stream(up=clip.up), clip.replace(joints=joints, confidence=None), 10)
    found = events + rest
    assert np.array_equal(times, clip.times) and np.isfinite(scores).all()
    inside = [event for event in found if truth[2][1] < (event.start + event.end) / 2 < truth[3][2]]
    assert inside == [] and {"squat", "walk", "wave"} <= {event.label for event in found}
    nobody = clip.replace(joints=np.full_like(joints, np.nan), confidence=None)
    strict = ActionIndexer(scorer="nearest", reject=1e6).fit(dataset([Person.random(0)], KNOWN, azimuth=0.0, rng=0))
    for model, shown in ((indexer, nobody), (strict, clip)):  # nor what a level refuses
        _, scores, events, rest, _ = pushed(model.stream(up=clip.up), shown, 50)
        assert events + rest == [] and np.isfinite(scores).all()


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_few_frames_are_nothing_or_an_honest_answer(count, indexer, seen):
    clip, _ = seen
    live = indexer.stream(up=clip.up)
    told = [live.push(clip.joints[i], clip.times[i]) for i in range(count)]
    rest = live.finish()
    assert sum(len(one.times) for one in [*told, rest]) == count and len(rest.events) <= 1
    again = live.push(clip.joints[:3])  # begins anew, at the stream's frame rate
    assert len(again.times) == 0 and live.latest().times == pytest.approx(np.arange(3) / 30)


def test_windows_say_what_they_say_in_the_whole(indexer, seen, monkeypatch):
    """One comparison with all exemplars, instead of one for each duration."""
    clip, _ = seen
    monkeypatch.setattr(of_live, "HORIZON", 100.0)  # nothing is decided
    source = replace(indexer.stream().source, repair=False)
    live = ActionStream(source, None, clip.up, None)
    live.push(clip.joints[:300], clip.times[:300])
    one = live._decode(live.num_frames).one
    with torch.no_grad():
        whole = whole_scores(live.source.model, one.lattice, lambda rows: one.resample(rows, indexer.length), live._durations)
    assert np.array_equal(np.isnan(whole), np.isnan(one.whole))
    assert np.nanmax(np.abs(whole - one.whole)) < 1e-3


def test_running_levels():
    rng = np.random.default_rng(0)
    values = rng.normal(3.0, 2.0, 1000)
    running = RunningLevel(1e9)
    for part in np.split(values, 10):
        running.push(np.append(part, np.nan))
    assert running.level() == pytest.approx((values.mean(), values.std()))
    brief = RunningLevel(100.0)
    for part in np.split(np.concatenate([values + 50.0, values]), 40):
        brief.push(part)
    assert brief.level() == pytest.approx((3.0, 2.0), abs=0.6)
    assert RunningLevel(5.0).level() == (0.0, 1.0)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda i, c: i.stream(lag=0.1), "lag must be seconds"),
        (lambda i, c: i.stream(lag=float("nan")), "lag must be seconds"),
        (lambda i, c: i.stream(fps=0), "fps must be a positive number"),
        (lambda i, c: i.stream(up="x"), "up must be one of"),
        (lambda i, c: i.stream().push(c.joints[:, :5]), "5 joints, but the fitted clips have 17"),
        (lambda i, c: i.stream().push(c.joints[0, 0]), "joints must be"),
        (lambda i, c: i.stream().push(np.full((17, 2), np.inf)), "infinite or huge"),
        (lambda i, c: i.stream().push(c.joints[:2], [1.0, 1.0]), "times"),
        (lambda i, c: i.stream().push(c.joints[:2], [1.0]), "times"),
        (lambda i, c: i.stream().push(c.joints[:2], [1.0, np.nan]), "times"),
        (lambda i, c: i.stream().push(c.joints[:50], np.arange(50) * 40.0), "frames are 40 s apart"),
    ],
)
def test_what_cannot_be_looked_at_is_refused_in_one_line(call, said, indexer, seen):
    with pytest.raises(ValueError, match=said) as told:
        call(indexer, seen[0])
    assert "\n" not in str(told.value)


def test_time_does_not_go_back(indexer, seen):
    clip, _ = seen
    live = indexer.stream(up=clip.up)
    live.push(clip.joints[:10], clip.times[:10])
    with pytest.raises(ValueError, match="comes after"):
        live.push(clip.joints[5], clip.times[5])
    live.push(clip.joints[10], clip.times[10])  # what was refused has left nothing behind
    assert live.num_frames == 11
    assert isinstance(live.latest().times[-1], float) and live.latest().times[-1] == clip.times[10]
