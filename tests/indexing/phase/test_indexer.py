"""PhaseIndexer on synthetic people: what it says of frames, and the contract of an estimator."""

import numpy as np
import pytest
import torch
from sklearn.base import clone

from indexing import Clip
from indexing.actors import Person, dataset, detect, perform
from indexing.phase.indexer import PhaseIndexer
from indexing.phase.learning import period
from indexing.phase.model import PhaseOptions, event_levels, query_frames

ACTIONS = ("walk", "sit_down")
TURNS = (0, 40, 80)


def clips(seed, turns=TURNS, fps=10.0):
    found = []
    for k, turn in enumerate(turns):
        for action in ACTIONS:
            solid = perform(action, Person.random(seed + k), fps=fps, rng=seed + k)
            found.append(detect(solid, azimuth=float(turn), rng=seed + k))
    return found


@pytest.fixture(scope="module")
def train():
    return clips(0)


@pytest.fixture(scope="module")
def fitted(train):
    return PhaseIndexer(harmonics=2).fit(train)


@pytest.fixture(scope="module")
def asked():
    return clips(20, turns=(20, 60))


def test_single_frames_tell_the_action_and_neighbours_smooth(fitted, asked):
    assert fitted.predict(asked).tolist() == [clip.label for clip in asked]
    assert fitted.score(asked, [clip.label for clip in asked]) == 1.0
    assert np.allclose(fitted.predict_proba(asked).sum(1), 1.0)
    smooth = clone(fitted).set_params(window=0.5)
    smooth.__dict__ |= {name: value for name, value in vars(fitted).items() if name.endswith("_")}
    scores = smooth.score_frames(asked[0])
    assert scores.std(0).max() < fitted.score_frames(asked[0]).std(0).max()
    assert [event.label for event in fitted.find(asked[0])] == ["walk"]


def test_a_cycle_repeats_and_a_course_goes_from_start_to_end(fitted, asked):
    assert dict(zip(fitted.classes_.tolist(), fitted.periodic_.tolist(), strict=True)) == {"sit_down": False, "walk": True}
    walk, sitting = (next(clip for clip in asked if clip.label == name) for name in ("walk", "sit_down"))
    phase = fitted.phase(walk)[:, 1]
    assert ((phase >= 0) & (phase < 1)).all()
    rates = np.linspace(-2, 2, 81)  # cycles per second
    agree = np.abs(np.exp(2j * np.pi * (phase - rates[:, None] * walk.times)).mean(1))
    assert 0.8 < rates[agree.argmax()] < 1.1
    course = fitted.phase(sitting)[:, 0]
    assert course[: len(course) // 4].mean() < 0.3
    assert np.corrcoef(course, np.arange(len(course)))[0, 1] > 0.7


def test_a_frame_is_judged_alone(fitted, asked):
    clip = asked[0]
    whole = fitted.score_frames(clip)
    part = fitted.score_frames(clip.replace(joints=clip.joints[5:8], times=clip.times[5:8], confidence=None))
    assert np.allclose(whole[5:8], part, atol=1e-9)
    assert np.allclose(fitted.decision_function([clip])[0], whole.mean(0))
    one = clip.replace(joints=clip.joints[3:4], times=clip.times[3:4], confidence=None)
    assert np.allclose(fitted.score_frames(one), whole[3:4], atol=1e-4)
    assert np.allclose(fitted.phase(one), fitted.phase(clip)[3:4], atol=1e-4)


def test_missing_joints(fitted, asked):
    joints = asked[0].joints.copy()
    joints[:, 3] = np.nan
    joints[2, 5:] = np.nan
    scores, phase = fitted.analyse(asked[0].replace(joints=joints, confidence=None))
    assert np.isfinite(scores).all()
    assert (scores[2] == 0).all()
    assert np.isnan(phase[2]).all()
    assert (scores.argmax(1) == 1).mean() > 0.7


def test_order_of_clips_changes_nothing_and_given_phases_are_kept(train, asked):
    walks = [clip for clip in train if clip.label == "walk"]
    phases = [1.1 * clip.times + 0.1 for clip in walks]
    one, other = PhaseIndexer(harmonics=1, mirror=False), PhaseIndexer(harmonics=1, mirror=False)
    one.fit(walks, phases=phases)
    other.fit(walks[::-1], phases=phases[::-1])
    assert one.periodic_.tolist() == [True]
    assert np.allclose(one.score_frames(asked[0]), other.score_frames(asked[0]), atol=1e-9)
    off = one.phase(walks[0])[:, 0] - phases[0]
    assert np.median(np.abs((off + 0.5) % 1 - 0.5)) < 0.05


def test_depth_is_used_and_events_have_levels():
    solid = [perform(action, Person.random(1), fps=8.0, rng=1) for action in ("squat", "kick")]
    found = PhaseIndexer(harmonics=1).fit(solid)
    assert found.predict([detect(clip, azimuth=70.0, rng=3) for clip in solid]).tolist() == ["squat", "kick"]
    wrong = torch.linspace(0, 1, 101, dtype=torch.float64)
    assert event_levels(wrong, 0.2) == pytest.approx((0.8, 0.66))
    assert event_levels(wrong, None) == pytest.approx((0.9, 0.83))
    assert event_levels(wrong[:0], None) == event_levels(wrong - 9, None) == (0.3, 0.0)
    assert event_levels(wrong, 1.5) == (1.5, 1.5)


def test_bad_parameters(train):
    for parameters, message in (
        ({"reject": 0.1}, "which takes 3 classes, got 2"),
        ({"reject": 1.1, "none_label": "walk"}, "none_label='walk' is one of the learned labels"),
    ):
        with pytest.raises(ValueError, match=message):
            PhaseIndexer(**parameters).fit(train)
    with pytest.raises(ValueError, match=r"one entry per clip \(6\), got 1"):
        PhaseIndexer().fit(train, phases=[None])
    with pytest.raises(ValueError, match="its phases have shape"):
        PhaseIndexer().fit(train, phases=[np.zeros(3)] * 6)
    with pytest.raises(ValueError, match="no period was found"):
        PhaseIndexer(course="periodic").fit([Clip(x) for x in np.random.default_rng(0).normal(size=(2, 9, 17, 2))], ["a", "b"])
    few = [clip.replace(joints=clip.joints[:, :5], confidence=None, skeleton=None) for clip in train]
    with pytest.raises(ValueError, match="5 joints, but a frame needs 6"):
        PhaseIndexer().fit(few)


def test_what_was_never_learned_is_refused_and_not_found():
    people = [Person.random(seed) for seed in (1, 2)]
    train = dataset(people, ("squat", "wave", "lunge"), azimuth=(0.0, 40.0), fps=8.0, rng=0)
    indexer = PhaseIndexer(harmonics=1, reject=0.05, none_label="none").fit(train)
    other = detect(perform("jumping_jack", Person.random(5), fps=8.0, rng=1), azimuth=20.0, rng=2)
    assert indexer.predict([other]).tolist() == ["none"]
    assert indexer.find(other) == []
    assert indexer.predict([train[0]]).tolist() == ["squat"]
    assert indexer.model_.wrong.quantile(0.95) == pytest.approx(indexer.reject_threshold_)
    assert indexer.set_params(reject=-9.0).find(other)


def test_seconds_of_a_class_left_out_are_scored_by_the_others_alone(train):
    more = [clip.replace(label="stand", joints=clip.joints + 1.0) for clip in train[:2]]
    model = PhaseIndexer(harmonics=1).fit([*train, *more]).model_
    frames = query_frames(train[1])
    for c in range(3):
        rest = model.without(c)
        assert len(rest.courses) == 2
        keep = [k for k in range(3) if k != c]
        assert (rest.bank.values == model.bank.values[model.label != c]).all()
        assert rest.label.tolist() == [keep.index(k) for k in model.label.tolist() if k != c]
        assert rest.evidence(frames)[0].shape == (len(train[1]), 2)
    assert len(model.wrong) > 3


@pytest.mark.slow
def test_options_are_kept_where_they_are_not_the_defaults(tmp_path):
    clips = dataset(2, ["walk", "squat", "wave"], azimuth=0.0, rng=0)
    plain = PhaseIndexer(harmonics=2).fit(clips, clips.labels)
    options = PhaseOptions(num_phases=48, max_training_frames=60, max_kept_frames=40, event_seconds=3.0)
    taught = PhaseIndexer(harmonics=2, options=options).fit(clips, clips.labels)
    assert len(taught.model_.wrong) < len(plain.model_.wrong) and len(taught.model_.bank) < len(plain.model_.bank)
    taught.save(tmp_path / "m.safetensors")
    again = PhaseIndexer.load(tmp_path / "m.safetensors")
    assert again.options == again.model_.options == options
    np.testing.assert_array_equal(again.decision_function(clips), taught.decision_function(clips))
    assert not np.array_equal(again.decision_function(clips), plain.decision_function(clips))
    with pytest.raises(ValueError, match="options must be None or indexing"):
        PhaseIndexer(options={"num_phases": 48}).fit(clips, clips.labels)
    walk = clips.select(label="walk")[0]
    x, times = torch.from_numpy(np.nan_to_num(walk.joints).astype(float)), torch.from_numpy(walk.times)
    own = period(x, times, PhaseOptions())[0]
    assert 0.3 <= own <= 4.0
    assert period(x, times, PhaseOptions(min_period=1.2 * own))[0] != own
    assert period(x, times, PhaseOptions(max_period=0.8 * own))[0] < 0.8 * own
