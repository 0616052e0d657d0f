"""The protocol of recognition on tiny synthetic sets: splits, cameras, cuts.  No recordings needed."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.recognition import open_set, protocol
from indexing import ActionIndexer, Clip, ClipSet
from indexing.actors import Person, perform


@pytest.fixture(scope="module")
def people() -> ClipSet:
    """Three people doing three actions, in 3D."""
    return ClipSet(
        perform(action, Person.random(who), fps=15.0, rng=who).replace(meta={"subject": who})
        for who in range(3)
        for action in ("squat", "wave", "kick")
    )


class Told:
    """Remembers what it was given, and answers the true labels."""

    def __init__(self, seen: list[tuple[int, int]]) -> None:
        self.seen = seen

    def fit(self, clips, labels):
        self.dims = clips[0].dims
        self.seen.append((self.dims, len(clips)))
        return self

    def predict(self, clips):
        assert all(clip.dims == 2 for clip in clips)
        return np.array([clip.label for clip in clips])


def test_every_subject_and_class_is_left_out_once_in_even_groups() -> None:
    subjects = np.array([2, 1, 2, 3, 1])
    folds = list(protocol.leave_one_subject_out(subjects))
    assert sorted(np.concatenate([test for _, test in folds]).tolist()) == [0, 1, 2, 3, 4]
    for train, test in folds:
        assert len(set(subjects[test])) == 1 and not set(subjects[train]) & set(subjects[test])
    subjects = np.array([7, 3, 3, 9, 5, 1, 7])
    assert protocol.merged(subjects, 2).tolist() == [1, 0, 0, 1, 0, 0, 1] and len(np.unique(protocol.merged(subjects, 9))) == 5
    companies = open_set.companies(np.repeat(list("abcdefg"), 2), 3, seed=0)
    assert sorted(np.concatenate(companies).tolist()) == list("abcdefg") and max(map(len, companies)) == 3
    labels = np.repeat(["a", "b", "c"], [5, 3, 1])
    chosen = protocol.few(labels, 2, np.random.default_rng(0))
    assert len(set(chosen.tolist())) == len(chosen) and [int((labels[chosen] == name).sum()) for name in "abc"] == [2, 2, 1]


def test_rendering_depends_on_the_seed_only(people: ClipSet) -> None:
    first, again, other = protocol.render(people, 0), protocol.render(people, 0), protocol.render(people, 1)
    assert tuple(first.queries) == protocol.TURNS
    assert all(clip.dims == 2 for clip in first.exemplars) and all(clip.dims == 3 for clip in first.solid)
    for turn in protocol.TURNS:
        assert np.array_equal(first.queries[turn][4].joints, again.queries[turn][4].joints)
    assert not np.array_equal(first.exemplars[0].joints, other.exemplars[0].joints)
    # the query at azimuth 0 has noise and elevation of its own
    assert not np.allclose(first.exemplars[0].joints, first.queries[0][0].joints, atol=1e-3)
    assert np.array_equal(first.exemplars[0].times, people[0].times)


def test_accuracy_counts_every_clip_at_every_turn(people: ClipSet) -> None:
    seen: list[tuple[int, int]] = []
    rendered = protocol.render(people, 0)
    assert protocol.accuracy_by_turn(lambda: Told(seen), rendered).tolist() == [1.0] * 4
    assert protocol.accuracy_by_turn(lambda: Told(seen), rendered, solid=True).tolist() == [1.0] * 4
    assert seen == [(2, 6)] * 3 + [(3, 6)] * 3


def test_runs_and_cuts_of_a_stream() -> None:
    labels = np.array([4, 4, 4, 2, 4, 4])
    assert protocol.runs(labels) == [(0, 3), (3, 4), (4, 6)]
    clip = Clip(np.random.default_rng(0).normal(size=(18, 5, 3)), fps=30.0)
    exercise = protocol.Exercise("13_29", clip, labels)
    clips, found = protocol.cut_runs(exercise, clip)
    assert exercise.subject == "13"
    # the run of one label lasts three frames: too short to hold an exercise
    assert found == [4, 4] and [len(one) for one in clips] == [9, 6]
    assert clips[1].times[0] == 12 / 30
    assert exercise.frames.tolist() == [1, 4, 7, 10, 13, 16]


@pytest.mark.slow
def test_stream_accuracy_asks_the_other_subject_only(people: ClipSet) -> None:
    def stream(name: str, who: int) -> protocol.Exercise:
        parts = [perform(action, Person.random(who), fps=30.0, rng=who) for action in ("squat", "wave")]
        joints = np.concatenate([part.joints for part in parts])
        ends = np.repeat([1, 2], [len(part) for part in parts])
        return protocol.Exercise(name, Clip(joints, fps=30.0), ends[1::3][: len(joints) // 3])

    exercises = [stream("13_1", 0), stream("14_1", 1)]
    accuracy, count = protocol.stream_accuracy(lambda: ActionIndexer(scorer="nearest"), exercises, 0)
    assert count == sum(len(one.labels) for one in exercises)
    assert accuracy.shape == (2,) and accuracy[0] > 0.8


def test_open_set_figures_by_hand() -> None:
    answers = open_set.Answers(
        known=[True, True, True, False, False],
        right={0.1: [True, False, False, False, False]},
        accepted={0.1: [True, True, False, True, False]},
        evidence={"x": [3.0, 2.0, 1.0, 1.5, 0.0]},
    )
    assert open_set.auroc(answers)["x"] == pytest.approx(5 / 6)
    assert open_set.rates(answers, [0.1])[0] == pytest.approx((1 / 2, 2 / 3, 1 / 3))
