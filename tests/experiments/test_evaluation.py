"""The evaluation protocol on tiny synthetic sets: corruptions, open set, robustness, trimmed recognition, one run of each."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from experiments.common import plots
from experiments.common.book import Book
from experiments.common.tables import Row
from experiments.recognition import corruptions, novelty, open_set, protocol, recognition_protocol, robustness
from experiments.recognition.baselines import ImageNearest
from experiments.recognition.contenders import NAMES, check_methods, contender, sliding
from indexing import ActionIndexer, Clip, ClipSet
from indexing.actors import dataset

ACTIONS = ("squat", "wave", "kick", "punch")
FAST = {"scorer": "nearest", "search": False, "mirror": False, "virtual_views": 0}


@pytest.fixture(scope="module")
def people() -> ClipSet:
    """Three people doing four actions, in 3D."""
    return dataset(3, ACTIONS, azimuth=None, fps=12.0, rng=0)


@pytest.fixture
def folder(people: ClipSet, tmp_path: Path, monkeypatch) -> Path:
    """A folder of data with these people; pictures take time, and one test draws them."""
    for module in (robustness, recognition_protocol, open_set):
        monkeypatch.setattr(module, "curves", lambda *a, **k: b"curves")
    monkeypatch.setattr(recognition_protocol.pictures, "confusion", lambda counts, classes: np.asarray(counts).tobytes())
    monkeypatch.setattr(recognition_protocol, "heat", lambda *a, **k: b"heat")
    people.save(tmp_path / "utkinect.npz")
    monkeypatch.setenv(protocol.DATA, str(tmp_path))
    return tmp_path


# ---- corruptions -------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def long_clip() -> Clip:
    return Clip(np.random.default_rng(0).normal(size=(1000, 12, 2)), fps=30.0)


def test_amount_zero_changes_nothing_and_the_seed_decides(long_clip: Clip) -> None:
    for change, _, amounts in corruptions.KINDS.values():
        assert amounts[0] == 0 and list(amounts) == sorted(amounts)
        assert change(long_clip, 0.0, np.random.default_rng(0)) is long_clip
        first, again, other = (change(long_clip, amounts[-1], np.random.default_rng(seed)) for seed in (1, 1, 2))
        np.testing.assert_array_equal(first.joints, again.joints)
        assert not np.array_equal(first.joints, other.joints)


@pytest.mark.parametrize("change", [corruptions.missing, corruptions.missing_bursts])
def test_joints_are_missing_as_often_as_asked(long_clip: Clip, change) -> None:
    changed = change(long_clip, 0.3, np.random.default_rng(0))
    assert np.mean(~changed.seen) == pytest.approx(0.3, abs=0.03)
    np.testing.assert_array_equal(changed.joints[changed.seen], long_clip.joints[changed.seen])


def test_bursts_last_as_long_as_asked_at_any_frame_rate(long_clip: Clip) -> None:
    for fps in (10.0, 60.0):
        clip = Clip(long_clip.joints, fps=fps)
        struck = corruptions.bursts(clip, 0.2, 0.5, np.random.default_rng(0))
        lengths = np.concatenate([[b - a for a, b in protocol.runs(one) if one[a]] for one in struck.T])
        assert lengths.mean() / fps == pytest.approx(0.5, rel=0.2)


def test_something_stays_to_compare() -> None:
    clip = Clip(np.zeros((5, 4, 2)))
    assert corruptions.missing(clip, 1.0, np.random.default_rng(0)).seen.sum() == 2
    assert len(corruptions.dropped(clip, 1.0, np.random.default_rng(0))) == 2


def test_dropped_frames_keep_their_times(long_clip: Clip) -> None:
    changed = corruptions.dropped(long_clip, 0.5, np.random.default_rng(0))
    where = np.searchsorted(long_clip.times, changed.times)
    assert len(changed) == 500
    np.testing.assert_array_equal(long_clip.joints[where], changed.joints)


@pytest.mark.parametrize("change", [corruptions.astray, corruptions.astray_bursts, corruptions.mistaken])
def test_joints_are_wrong_as_often_as_asked_and_near_the_person(long_clip: Clip, change) -> None:
    changed = change(long_clip, 0.1, np.random.default_rng(0))
    assert np.mean((changed.joints != long_clip.joints).any(axis=2)) == pytest.approx(0.1, abs=0.02)
    assert changed.joints.min() >= long_clip.joints.min() and changed.joints.max() <= long_clip.joints.max()


def test_exchanged_joints_are_all_still_there(long_clip: Clip) -> None:
    changed = corruptions.mistaken(long_clip, 0.5, np.random.default_rng(0))
    np.testing.assert_array_equal(np.sort(changed.joints, axis=1), np.sort(long_clip.joints, axis=1))


def test_a_joint_that_was_not_seen_is_not_seen_wrongly() -> None:
    joints = np.random.default_rng(0).normal(size=(30, 4, 2))
    joints[:, 1] = np.nan
    assert not corruptions.astray(Clip(joints), 0.9, np.random.default_rng(0)).seen[:, 1].any()


# ---- contenders --------------------------------------------------------------------------------------------------------
def test_baselines_know_their_own_exemplars(people: ClipSet) -> None:
    clips = list(protocol.render(people, 0, turns=()).exemplars)
    method = ImageNearest().fit(clips, people.labels)
    assert method.distances(clips).argmin(axis=1).tolist() == list(range(len(clips)))
    assert (method.evidence(clips) >= method.evidence([clip.replace(joints=clip.joints[::-1]) for clip in clips])).all()


def test_every_name_is_a_method() -> None:
    options = ActionIndexer(weights="learned", reject=0.1).get_params()
    assert contender("learned", 0, reject=0.1)().get_params() == options
    assert not contender("unrepaired")().repair
    assert isinstance(contender("image")(), ImageNearest)
    assert isinstance(sliding("equal"), ActionIndexer)
    with pytest.raises(ValueError, match="at least one of equal, learned"):
        check_methods(())
    assert len(set(NAMES.values())) == len(NAMES)


# ---- splits ------------------------------------------------------------------------------------------------------------
def test_subjects_are_merged_into_even_groups() -> None:
    subjects = np.array([7, 3, 3, 9, 5, 1, 7])
    assert protocol.merged(subjects, 2).tolist() == [1, 0, 0, 1, 0, 0, 1]
    assert len(np.unique(protocol.merged(subjects, 9))) == 5


def test_every_class_is_held_out_once() -> None:
    companies = open_set.companies(np.repeat(list("abcdefg"), 2), 3, seed=0)
    assert sorted(np.concatenate(companies).tolist()) == list("abcdefg")
    assert max(map(len, companies)) == 3


# ---- what is said of answers -------------------------------------------------------------------------------------------
def test_open_set_figures_by_hand() -> None:
    answers = open_set.Answers(
        known=[True, True, True, False, False],
        right={0.1: [True, False, False, False, False]},
        accepted={0.1: [True, True, False, True, False]},
        evidence={"x": [3.0, 2.0, 1.0, 1.5, 0.0]},
    )
    assert open_set.auroc(answers)["x"] == pytest.approx(5 / 6)
    assert open_set.rates(answers, [0.1])[0] == pytest.approx((1 / 2, 2 / 3, 1 / 3))


def test_loss_is_the_mean_of_the_turns() -> None:
    amounts = corruptions.KINDS["dropped frames"][2]
    found = np.ones((2, len(amounts), 2))
    found[:, amounts.index(0.5)] = [[0.9, 1.0], [0.98, 1.0]]
    (row,) = robustness.losses("dropped frames", found)
    assert row.measured == pytest.approx(0.03) and row.spread == pytest.approx(0.02)
    assert robustness.losses("noise", found) == []


# ---- one run of each ---------------------------------------------------------------------------------------------------
def written(folder: Path) -> tuple[dict, list[str]]:
    return json.loads((folder / "figures.json").read_text())["tables"], sorted(path.name for path in folder.glob("*.png"))


def test_robustness_runs(folder: Path, capsys) -> None:
    out = folder / "out"
    kinds = ("wrong joints, exchanged",)
    robustness.run(robustness.Config(kinds=kinds, methods=("image",), seeds=1, out=out))
    tables, pictures = written(out)
    (table,) = tables.values()
    line = table["lines"]["2D nearest neighbour, 0°"]
    assert len(line) == 6 and line[0] > 0.5
    assert table["figures"][0]["goal"] == 0.03
    assert pictures == ["robustness_0.png", "robustness_90.png"]
    assert "wrong joints, exchanged: 0.05" in capsys.readouterr().out


def test_recognition_runs(folder: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(recognition_protocol, "AZIMUTHS", (0, 90))
    out = folder / "out"
    tables = ("cross-subject", "cross-view", "few-shot")
    config = recognition_protocol.Config(tables=tables, sets=("utkinect",), methods=("image",), draws=1, examples=(1, 2), out=out)
    recognition_protocol.run(config)
    found, pictures = written(out)
    assert [len(table["lines"]) for table in found.values()] == [1, 3, 1]
    assert pictures == ["confusion_utkinect.png", "cross_view_utkinect.png", "few_shot_utkinect.png"]
    views = found["UTKinect, other people, from camera to camera"]["lines"]
    assert views["2D nearest neighbour, learned at 0°"][0] >= 0.5
    assert "turned 150 degrees" in capsys.readouterr().out


def test_official_splits_run(people: ClipSet, tmp_path: Path, monkeypatch) -> None:
    parts = {f"split{k}": lambda who, k=k: int(who == k) for k in range(3)}
    clips = [clip.replace(meta={name: of(clip.meta["subject"]) for name, of in parts.items()}) for clip in people]
    flat = [clip.replace(joints=clip.joints[..., :2]) for clip in clips]
    monkeypatch.setattr(protocol, "load_set", lambda name: ClipSet(flat))
    book = Book(tmp_path)
    recognition_protocol.jhmdb(recognition_protocol.Config(methods=("image",)), book)
    line = book.tables["JHMDB, official splits"]["lines"]["2D nearest neighbour"]
    assert line[3] == pytest.approx(np.mean(line[:3])) and line[3] > 0.5


def test_open_set_runs(folder: Path, monkeypatch, capsys) -> None:
    monkeypatch.setitem(open_set.OPTIONS, "equal", FAST)
    monkeypatch.setattr(open_set, "FOLDS", 2)
    out = folder / "out"
    asked = {"held_out": 2, "turns": (0,), "rates": (0.3,), "ways": False}
    open_set.run(open_set.Config(sets=("utkinect",), methods=("equal", "image"), out=out, **asked))
    tables, pictures = written(out)
    areas, rates = tables.values()
    assert set(areas["lines"]) == {"ours", "ours, best probability", "2D nearest neighbour"}
    assert areas["lines"]["ours"][0] > 0.6
    ((alarms, kept, right),) = rates["lines"].values()
    assert 0 <= alarms < kept and right <= kept
    assert pictures == ["rates_utkinect.png"]
    capsys.readouterr()


@pytest.mark.slow
def test_ways_to_tell_unknown_actions() -> None:
    clips = dataset(4, ACTIONS, takes=2, azimuth=0.0, fps=12.0, rng=0)
    taught, asked = [c for c in clips if c.label != "punch" and c.meta["subject"] < 3], list(clips.select(subject=3))
    indexer = ActionIndexer(**FAST).fit(taught)
    said = novelty.ways(indexer, taught, np.array([clip.label for clip in taught]), "actors")(asked)
    assert {way[0] for way in said if way[1] == ":"} == set("abcde")  # five ways that are compared
    assert all(values.shape == (len(asked),) and np.isfinite(values).all() for values in said.values())
    known = np.array([clip.label != "punch" for clip in asked])
    best = said["e: with the profiles of the nearest"]
    assert best[known].mean() > best[~known].mean()
    few = [next(clip for clip in clips if clip.label == label) for label in ACTIONS]
    with pytest.raises(ValueError, match="one exemplar only"):
        novelty.ways(ActionIndexer(**FAST).fit(few), few, np.array(ACTIONS), "actors")


def test_the_rate_asked_for_is_that_of_a_new_fit(people: ClipSet) -> None:
    clips, labels = list(protocol.render(people, 0, turns=()).exemplars), people.labels
    one = ActionIndexer(**FAST).fit(clips, labels)
    one.set_params(reject=0.2, none_label="?")._calibrate()
    two = ActionIndexer(reject=0.2, none_label="?", **FAST).fit(clips, labels)
    assert one.predict(clips).tolist() == two.predict(clips).tolist()
    assert one.reject_threshold_ == two.reject_threshold_


@pytest.mark.parametrize(
    ("run", "config", "message"),
    [
        (robustness.run, robustness.Config(kinds=("rain",)), "kinds must be some of .noise., .*rain"),
        (robustness.run, robustness.Config(seeds=0), "seeds at least 1"),
        (open_set.run, open_set.Config(rates=(1.5,)), "rates must be between 0 and 1"),
        (recognition_protocol.run, recognition_protocol.Config(examples=(0,)), "at least 1"),
    ],
)
def test_nothing_to_measure_is_said_before_measuring(run, config, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        run(config)


def test_a_book_keeps_what_it_prints(tmp_path: Path, capsys) -> None:
    book = Book(tmp_path / "new")
    book.grid("Table", ["a", "b"], {"ours": [0.5, np.nan]}, [Row("t", "s", 0.5, 0.4), Row("t", "u", 0.5, 0.9)])
    book.picture("dot", plots.heat({"x": np.array([[0.2, np.nan]])}, ["r"], ["a", "b"], ("down", "across")))
    book.picture("line", plots.curves({"x": {"ours": ([0, 1], [0.5, 1.0])}}, "amount", ticks=True))
    book.picture("bar", plots.bars({"x": (["a"], {"ours": [0.3], "theirs": [1.0]})}))
    book.close({"seed": 1})
    kept, pictures = written(tmp_path / "new")
    assert kept["Table"]["lines"]["ours"][0] == 0.5 and pictures == ["bar.png", "dot.png", "line.png"]
    assert "1 of 2 goals reached" in capsys.readouterr().out
