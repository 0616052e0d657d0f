"""The experiments' protocol on tiny synthetic sets: splits, cameras, cuts, tables.  No recordings needed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from experiments.benchmarks import workloads
from experiments.common.tables import Row, command, markdown
from experiments.recognition import action_recognition, protocol
from experiments.recognition.baselines import ImageNearest
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


def test_every_subject_is_left_out_once() -> None:
    subjects = np.array([2, 1, 2, 3, 1])
    folds = list(protocol.leave_one_subject_out(subjects))
    assert sorted(np.concatenate([test for _, test in folds]).tolist()) == [0, 1, 2, 3, 4]
    for train, test in folds:
        assert len(set(subjects[test])) == 1
        assert not set(subjects[train]) & set(subjects[test])


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


def test_few_draws_the_same_number_of_every_class() -> None:
    labels = np.repeat(["a", "b", "c"], [5, 3, 1])
    chosen = protocol.few(labels, 2, np.random.default_rng(0))
    assert len(set(chosen.tolist())) == len(chosen)
    assert [int((labels[chosen] == name).sum()) for name in "abc"] == [2, 2, 1]


def test_few_examples_reach_the_method(people: ClipSet) -> None:
    seen: list[tuple[int, int]] = []
    rng = np.random.default_rng(0)
    protocol.accuracy_by_turn(lambda: Told(seen), protocol.render(people, 0), choose=lambda labels: protocol.few(labels, 1, rng))
    assert seen == [(2, 3)] * 3


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


def test_view_bound_baseline_recognizes_its_own_view(people: ClipSet) -> None:
    rendered = protocol.render(people, 0, turns=(0, 90))
    straight, turned = protocol.accuracy_by_turn(ImageNearest, rendered)
    assert straight >= turned
    assert straight > 0.7


def test_ours_runs_through_the_same_path(people: ClipSet) -> None:
    accuracy = protocol.accuracy_by_turn(lambda: ActionIndexer(scorer="nearest"), protocol.render(people, 0))
    assert accuracy.mean() > 0.7


def test_warping_baseline(people: ClipSet) -> None:
    pytest.importorskip("aeon")
    import torch

    from experiments.recognition.baselines import WarpedNearest

    threads = torch.get_num_threads()
    method = WarpedNearest()
    clips = list(protocol.render(people, 0).exemplars)
    assert method.fit(clips, people.labels).predict(clips).tolist() == people.labels.tolist()
    assert torch.get_num_threads() == threads


@pytest.mark.parametrize(
    ("row", "reached"),
    [
        (Row("t", "s", 0.9, 0.9), True),
        (Row("t", "s", 0.8999, 0.9), False),
        (Row("t", "s", 0.3, 0.2, at_most=True), False),
        (Row("t", "s", 0.1, 0.2, at_most=True), True),
        (Row("t", "s", 0.1), None),
    ],
)
def test_goals_are_compared_unrounded(row: Row, reached: bool | None) -> None:
    assert row.reached is reached


def test_table_is_markdown() -> None:
    lines = markdown([Row("UTKinect", "turned 0", 0.98, 0.96), Row("x", "y", 1.5, 2.0, at_most=True, unit=" s")]).splitlines()
    assert len({line.count("|") for line in lines}) == 1
    assert "yes" in lines[2] and "<= 2 s" in lines[3]


def test_without_data_a_script_stops_with_one_line(monkeypatch, capsys, tmp_path: Path) -> None:
    monkeypatch.delenv(protocol.DATA, raising=False)
    config = action_recognition.Config(out=tmp_path / "never.json")
    with pytest.raises(SystemExit) as stopped:
        command(lambda: action_recognition.run(config))
    assert stopped.value.code == 2
    error = capsys.readouterr().err
    assert protocol.DATA in error and len(error.strip().splitlines()) == 1
    monkeypatch.setenv(protocol.DATA, str(tmp_path / "absent"))
    with pytest.raises(ValueError, match="no such folder"):
        protocol.data_folder()


@pytest.mark.slow
def test_one_command_writes_tables_and_configuration(people: ClipSet, monkeypatch, capsys, tmp_path: Path) -> None:
    people.save(tmp_path / "utkinect.npz")
    monkeypatch.setenv(protocol.DATA, str(tmp_path))
    out = tmp_path / "results" / "figures.json"
    action_recognition.run(action_recognition.Config(sets=("utkinect",), seeds=1, draws=1, out=out))
    printed = capsys.readouterr().out
    assert "turned 150 degrees" in printed and "5 examples per class" in printed and ">= 0.880" in printed
    written = json.loads(out.read_text())
    assert written["manifest"]["arguments"]["seeds"] == 1
    assert len(written["tables"]) == 3


def test_benchmark_movements_are_smooth_and_differ() -> None:
    clips = workloads.movements(np.array([0, 0, 1]), 16, np.random.default_rng(0))
    assert clips.shape == (3, 16, 20, 2)
    inside, between = np.abs(clips[0] - clips[1]).mean(), np.abs(clips[0] - clips[2]).mean()
    assert inside < between
    assert workloads.peak() >= workloads.resident() - 1 > 0
