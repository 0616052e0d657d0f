"""One action learned alone, and a background of other movement: nothing of it is ever an answer."""

from __future__ import annotations

import json

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.torch import save_file

from indexing import ActionIndexer, Clip
from indexing.action import background as of_background
from indexing.action.background import BackgroundClips, cut_background, perform_other_actions, replay_clips
from indexing.actors import Person, dataset, detect, stream
from indexing.skeleton import COCO17, OPENPOSE18


@pytest.fixture(scope="module")
def squat():
    return dataset([Person.random(3)], ["squat"], azimuth=0.0, rng=3).clips[0]


@pytest.fixture(scope="module")
def others():
    """Other people, who do other things, too."""
    return dataset([Person.random(i) for i in (11, 12)], ["squat", "wave", "kick", "bow", "throw"], azimuth=20.0, rng=4)


@pytest.fixture(scope="module")
def alone(squat):
    return ActionIndexer(virtual_views=2, none_label="nothing").fit([squat], ["squat"])


@pytest.fixture(scope="module")
def session():
    clip, truth = stream(["wave", "squat", "kick", "squat"], Person.random(21), rng=5)
    return detect(clip, azimuth=20.0, rng=6), truth


@pytest.mark.slow
def test_one_action_is_told_from_everything_else(alone, others):
    assert alone.classes_.tolist() == ["squat"] and alone.model_.hidden > 3
    said = alone.predict(others)
    assert set(said.tolist()) <= {"squat", "nothing"}
    assert np.mean(said[others.labels == "squat"] == "squat") == 1.0 and np.mean(said[others.labels != "squat"] == "squat") <= 0.25


def test_scores_are_of_the_known_actions_and_models_come_back_from_their_files(alone, others, tmp_path):
    likely = alone.predict_proba(others)[:, 0]
    assert alone.decision_function(others).shape == (len(others), 1) and (likely >= 0).all() and (likely <= 1).all()
    assert likely[others.labels == "squat"].min() > np.median(likely[others.labels != "squat"])
    alone.save(tmp_path / "squat.safetensors")
    again = ActionIndexer.load(tmp_path / "squat.safetensors")
    assert again.model_.hidden == alone.model_.hidden and again.reject_threshold_ == alone.reject_threshold_
    assert again.predict(others).tolist() == alone.predict(others).tolist()


@pytest.mark.slow
def test_a_recording_holds_the_one_action(alone, session):
    clip, truth = session
    told = alone.decode(clip)
    squats = [(start, end) for label, start, end in truth if label == "squat"]
    assert told.classes == ("squat",) and told.scores.shape == (len(clip), 1)
    assert [event.label for event in told.events] == ["squat"] * len(squats)
    for event, (start, end) in zip(told.events, squats, strict=True):
        assert min(event.end, end) - max(event.start, start) > 0.5 * (end - start)
    assert {one.event.label for one in told.withheld} <= {"squat"}
    least = ActionIndexer(virtual_views=2, reject=-1e9).fit([alone.exemplar(0)], ["squat"]).decode(clip)  # nothing is below it
    assert "other movement" in {one.reason for one in least.withheld}
    assert told.background is not None and (told.background >= 0).all() and (told.background <= 1).all()


@pytest.mark.slow
def test_the_rate_sets_the_level_and_a_second_action_can_be_added(squat, others):
    strict, loose, indexer = (
        ActionIndexer(scorer="nearest", virtual_views=0, reject=rate).fit([squat], ["squat"]) for rate in (0.02, 0.5, None)
    )
    # where nothing is said a rate is asked for all the same
    assert strict.reject_threshold_ > indexer.reject_threshold_ > loose.reject_threshold_
    hidden, waves = indexer.model_.hidden, [clip for clip in others if clip.label == "wave"]
    indexer.partial_fit(waves)
    assert indexer.classes_.tolist() == ["squat", "wave"] and indexer.model_.hidden < hidden  # others who wave
    assert indexer.predict(waves).tolist() == ["wave"] * len(waves) and indexer.predict([squat]).tolist() == ["squat"]


def test_files_that_know_neither_background_nor_profiles_are_read(others, tmp_path):
    indexer = ActionIndexer(scorer="nearest", virtual_views=0).fit(others)
    assert indexer.model_.profiles is not None
    indexer.save(tmp_path / "new.safetensors")
    with safe_open(tmp_path / "new.safetensors", "pt") as file:
        header = json.loads(file.metadata()["dyntorch"])
        tensors = {name: file.get_tensor(name) for name in file.keys() if not name.startswith("profiles.")}  # noqa: SIM118
    assert header.pop("hidden") == 0
    save_file(tensors, tmp_path / "old.safetensors", metadata={"dyntorch": json.dumps(header)})
    again = ActionIndexer.load(tmp_path / "old.safetensors")
    assert again.model_.profiles is None and again.model_.hidden == 0
    assert again.predict(others).tolist() == indexer.predict(others).tolist()
    header["hidden"] = 2
    save_file(tensors, tmp_path / "bad.safetensors", metadata={"dyntorch": json.dumps(header)})
    with pytest.raises(ValueError, match=r"bad\.safetensors"):
        ActionIndexer.load(tmp_path / "bad.safetensors")


def test_several_actions_and_a_recording_of_something_else(others, session):
    taught, kicks = others.select(label=["squat", "wave"]), others.select(label="kick")
    clip, _ = stream(["kick", "throw", "kick"], Person.random(8), rng=9)
    indexer = ActionIndexer(virtual_views=2, none_label="nothing").fit(taught, background=[detect(clip, azimuth=20.0, rng=1)])
    assert indexer.classes_.tolist() == ["squat", "wave"] and 1 <= indexer.model_.hidden <= 6
    assert indexer.reject_threshold_ is None  # several actions: no rate where none is asked for
    assert (indexer.predict(kicks) == "nothing").all() and (indexer.predict(taught) == taught.labels).all()
    assert {event.label for event in indexer.find(session[0])} <= {"squat", "wave"}


def test_what_is_made(monkeypatch):
    monkeypatch.setattr(of_background, "NUM_PEOPLE", 1)
    monkeypatch.setattr(of_background, "NUM_CAMERAS", 1)
    clip = Clip(np.random.default_rng(0).normal(size=(20, 17, 2)), skeleton=COCO17)
    rng = np.random.default_rng(0)
    played = replay_clips([clip], True, rng)
    assert all(one.joints.shape == clip.joints.shape for one in played.clips) and not any(played.trusted)
    for one, kind in zip(played.clips, played.kinds, strict=True):
        assert np.allclose(one.joints.mean(axis=0), clip.joints.mean(axis=0), atol=1e-5), kind  # other movement about the same pose
    people = perform_other_actions(OPENPOSE18, 2, rng)
    assert len(set(people.kinds)) == 13 and {one.joints.shape[1:] for one in people.clips} == {(18, 2)}
    assert len(perform_other_actions(None, 2, rng)) == 0
    assert len(people + played) == len(people) + len(played) and len(BackgroundClips()) == 0


def test_recordings_are_cut_into_pieces_as_long_as_the_action(monkeypatch):
    monkeypatch.setattr(of_background, "MAX_PIECES", 10)
    monkeypatch.setattr(of_background, "MAX_KINDS", 3)
    clip = Clip(np.random.default_rng(0).normal(size=(600, 5, 2)), fps=30.0)
    pieces = cut_background([clip], 30.0, 5, None, 2.0)
    assert len(pieces) == 10 and len(set(pieces.kinds)) == 3 and all(pieces.trusted)
    assert {round(piece.duration, 1) for piece in pieces.clips} == {2.0}
    short = cut_background([clip.replace(joints=clip.joints[:20], times=clip.times[:20])], 30.0, 5, None, 2.0)
    assert len(short) == 1


def test_bad_backgrounds(squat, monkeypatch):
    for background, message in (
        ([], "background: clips: the list is empty"),
        ([np.zeros((0, 17, 2))], "background: "),
        ([np.full((30, 17, 2), np.nan)], "background: clip 0.*joint"),
        ([np.random.default_rng(0).normal(size=(30, 9, 2))], "background: clip 0.*9 joints, but the fitted clips have 17"),
        (3, "background: clips: expected a list"),
        (["session.json"], "background: clips: item 0 is text"),
    ):
        with pytest.raises(ValueError, match=message):
            ActionIndexer().fit([squat], ["squat"], background=background)
    turning = np.linspace(0, 12 * np.pi, 90)  # an action that is the same however it is played
    wheel = np.stack([np.stack([np.cos(turning + i), np.sin(turning + i)], axis=1) for i in range(6)], axis=1)
    monkeypatch.setattr(of_background, "NUM_EXCHANGES", 0)
    with pytest.raises(ValueError, match=r"labels: only one class .*'wheel'.*background="):
        ActionIndexer(scorer="nearest", virtual_views=0).fit([wheel], ["wheel"])
