"""Recognition of synthetic people from elsewhere, and every kind of input."""

import numpy as np
import pytest
import torch

from indexing import ActionIndexer, Clip
from indexing.actors import ACTIONS, Person, dataset, perform
from indexing.cameras import virtual
from indexing.scoring import reject_threshold
from tests.indexing.residuals import fused_residual

FEW = ("squat", "wave", "kick", "bow")


@pytest.fixture(scope="module")
def few():
    """Four actions by three people in one view, and by three others from elsewhere."""
    people = [Person.random(seed) for seed in range(20, 26)]
    return dataset(people[:3], FEW, azimuth=0.0, rng=1), dataset(people[3:], FEW, azimuth=(70.0,), rng=2)


# ---- recognition -------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_one_example_recognizes_other_people_from_other_viewpoints(indexer, lesson, others, windows_of):
    accuracy = indexer.score(others, others.labels)
    assert accuracy > 0.9  # chance is 1 / 13
    distance = fused_residual(windows_of(others), [windows_of(lesson)], indexer.model_.metric, ("nn",))
    view_bound = (lesson.labels[distance.argmin(dim=1).numpy()] == others.labels).mean()
    assert accuracy > view_bound + 0.05


@pytest.mark.slow
def test_each_scorer_is_what_it_says_and_fewer_exemplars(indexer, lesson, others):
    for name, scores in (("nearest", indexer.model_.nearest_scores), ("kernel", indexer.model_.machine_scores)):
        alone = ActionIndexer(scorer=name).fit(lesson)
        found = alone.decision_function(others)
        np.testing.assert_allclose(found, scores(alone._queries(others)).numpy(), atol=1e-4)
        assert not np.allclose(found, indexer.decision_function(others)) and alone.score(others, others.labels) > 0.88, name
    plain = ActionIndexer(virtual_views=0, search=False).fit(lesson)
    assert plain.score(others, others.labels) > 0.8
    assert len(plain.model_.exemplars.crops) == 13 and not len(plain.model_.exemplars.views)
    seen = dataset([Person.random(1), Person.random(2)], ACTIONS, azimuth=5.0, rng=9)
    assert ActionIndexer(view="same").fit(lesson).score(seen, seen.labels) > 0.9


@pytest.mark.slow
def test_learned_weights(few):
    train, test = few
    learned = ActionIndexer(weights="learned").fit(train)
    assert learned.score(test, test.labels) == 1.0
    single = ActionIndexer(weights="learned").fit(train[:4])  # one example per class: nobody can be left out
    assert single.model_.joint_weights is None and single.model_.blend == ActionIndexer().fit(train[:4]).model_.blend


@pytest.mark.slow
def test_3d_exemplars_recognize_2d_queries_and_go_with_2d_ones(lesson_3d, others, few):
    solid = ActionIndexer().fit(lesson_3d)
    assert solid.score(others, others.labels) > 0.85
    assert solid.score(lesson_3d, lesson_3d.labels) > 0.9  # 3D queries are seen along z
    train, test = few
    mixed = [*train[:4], *(perform(action, Person.random(30), rng=3) for action in FEW)]
    assert ActionIndexer().fit(mixed).score(test, test.labels) == 1.0


def views_of(clip, azimuths=(0.0, 50.0, 110.0)):
    return tuple(virtual(clip, azimuth, 0.05 * i, distance=20.0) for i, azimuth in enumerate(azimuths))


@pytest.mark.slow
def test_several_synchronized_views_are_one_exemplar(few):
    _, test = few
    solid = [perform(action, Person.random(31), rng=4) for action in FEW]
    shown = {count: [views_of(clip)[:count] for clip in solid] for count in (1, 2, 3)}
    shown["arrays"] = [np.stack([view.joints for view in views_of(clip)]) for clip in solid]
    shown["other clocks and rates"] = [
        (a.between(0.1, 9), b, c.replace(joints=c.joints[::2], times=c.times[::2], fps=None)) for a, b, c in map(views_of, solid)
    ]
    for name, clips in shown.items():
        indexer = ActionIndexer().fit(clips, FEW)
        assert len(indexer.model_.labels) == 4 * (name if name in (1, 2) else 1), name  # three views decide a 3D shape
        assert indexer.score(test, test.labels) == 1.0, name
        assert indexer.exemplar(0).label == "squat"


def test_views_that_show_different_things_stay_apart_and_say_so(few):
    clips = [perform(action, Person.random(31), rng=4).between(0, 1.5) for action in FEW]
    odd = tuple(views_of(clip)[i] for i, clip in enumerate(clips[:3]))
    with pytest.warns(UserWarning, match="do not decide a 3D shape"):
        indexer = ActionIndexer(scorer="nearest").fit([odd, views_of(clips[3])[0]], ["mixed", "bow"])
    assert indexer.classes_[indexer.model_.labels].tolist() == ["mixed"] * 3 + ["bow"]


@pytest.mark.slow
def test_missing_joints(indexer, others):
    rng = np.random.default_rng(0)
    holed = []
    for clip in others:
        joints = clip.joints.copy()
        joints[rng.random(joints.shape[:2]) < 0.3] = np.nan
        joints[:, rng.choice(17, 3, replace=False)] = np.nan  # and three are never seen
        holed.append(clip.replace(joints=joints))
    scores = indexer.decision_function(holed)
    assert np.isfinite(scores).all()
    assert (indexer.classes_[scores.argmax(axis=1)] == others.labels).mean() > 0.8


@pytest.mark.slow
def test_joints_never_seen_in_the_exemplars(lesson, others):
    hidden = [np.isin(np.arange(17), [3, 4, 9][i % 3])[:, None] for i in range(len(lesson))]
    learned = [clip.replace(joints=np.where(gone, np.nan, clip.joints)) for clip, gone in zip(lesson, hidden, strict=True)]
    indexer = ActionIndexer().fit(learned)
    assert indexer.score(others, others.labels) > 0.85
    assert np.isnan(indexer.exemplar(0).joints[:, 3]).all()


def test_a_joint_never_seen_is_as_good_as_a_joint_that_does_not_exist(few):
    train, test = few
    keep = [j for j in range(17) if j not in (3, 4)]

    def without(clips, joints):
        return [clip.replace(joints=np.where(np.isin(np.arange(17), joints)[:, None], np.nan, clip.joints)) for clip in clips]

    def cut(clips):
        return [clip.replace(joints=clip.joints[:, keep], confidence=None, skeleton=None) for clip in clips]

    options = {"scorer": "nearest", "mirror": False}
    holed = ActionIndexer(**options).fit(without(train, (3, 4)), train.labels)
    small = ActionIndexer(**options).fit(cut(train), train.labels)
    np.testing.assert_allclose(
        holed.decision_function(without(test, (3, 4))), small.decision_function(cut(test)), atol=0.3
    )  # equal but for the part that the metric's scale and floor play


def test_tempo_frame_rate_trimming_position_and_size_do_not_matter(indexer, others):
    changed = []
    for i, clip in enumerate(others.select(azimuth=60.0)):
        slow = clip.replace(times=clip.times * (0.6 + 0.3 * (i % 4)), fps=None)
        start, span = slow.times[0], slow.duration
        part = slow.between(start + 0.05 * span, start + 0.9 * span)
        changed.append(part.replace(joints=part.joints[:: 1 + i % 2], times=part.times[:: 1 + i % 2], confidence=None))
    assert (indexer.predict(changed) == others.select(azimuth=60.0).labels).mean() > 0.85
    moved = [clip.replace(joints=clip.joints * 0.01 - 40) for clip in others[:20]]
    np.testing.assert_allclose(indexer.decision_function(moved), indexer.decision_function(others[:20]), atol=0.05)


# ---- forms of input ----------------------------------------------------------------------------------------------------
def test_arrays_and_clips_give_the_same(few):
    train, test = few
    bare = [Clip(clip.joints, fps=30.0, up="-y") for clip in (*train, *test)]
    upright = [clip.joints * [1, -1] for clip in bare]
    a = ActionIndexer(mirror=False).fit(bare[: len(train)], train.labels)
    b = ActionIndexer(mirror=False).fit(upright[: len(train)], train.labels)
    np.testing.assert_allclose(a.decision_function(bare[len(train) :]), b.decision_function(upright[len(train) :]), atol=1e-3)
    lists = [torch.from_numpy(x) for x in upright[len(train) :]]
    np.testing.assert_allclose(b.decision_function(lists), b.decision_function(upright[len(train) :]), atol=1e-6)
    arrays = [clip.joints for clip in train[:4]]  # of which fps is the rate
    slow, clips, fast = (
        len(ActionIndexer(scorer="nearest", fps=fps).fit(what, FEW).model_.exemplars.moments)
        for fps, what in ((10.0, arrays), (30.0, [Clip(x, fps=10.0) for x in arrays]), (30.0, arrays))
    )
    assert slow == clips > fast


@pytest.fixture(scope="module")
def crowd():
    """Four people in the view that is learned from, and four others, all actions each."""
    people = [Person.random(seed) for seed in range(8)]
    return dataset(people[:4], ACTIONS, azimuth=0.0, rng=0), dataset(people[4:], ACTIONS, azimuth=0.0, rng=50)


# ---- partial_fit -------------------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("scorer", ["both", "nearest", "kernel"])
def test_partial_fit_is_as_good_as_fit_on_all(crowd, scorer):
    train, test = (clips.select(action=FEW) for clips in crowd)
    grown = ActionIndexer(scorer=scorer)
    for subject in range(4):
        part = train.select(subject=subject)
        assert grown.partial_fit(part, part.labels, classes=FEW) is grown
    whole = ActionIndexer(scorer=scorer).fit(train)
    assert grown.classes_.tolist() == whole.classes_.tolist() and len(grown.model_.labels) == 16
    assert grown.score(test, test.labels) == whole.score(test, test.labels) == 1.0
    if scorer == "nearest":  # nothing in it is drawn at random
        np.testing.assert_allclose(grown.decision_function(test), whole.decision_function(test), atol=1e-3)


def test_partial_fit_keeps_every_exemplar_with_its_own_copies(crowd):
    train, _ = crowd
    first, second = train.select(subject=0, action=FEW), train.select(subject=1, action=(*FEW, "lunge", "run"))
    grown = ActionIndexer().fit(first).partial_fit(second)
    order = ActionIndexer().fit([*first, *second])
    for i in range(6):
        np.testing.assert_array_equal(grown.model_.exemplars.crop(i).values, order.model_.exemplars.crop(i).values)
    np.testing.assert_array_equal(grown.model_.exemplars.owner, order.model_.exemplars.owner)
    np.testing.assert_array_equal(grown.classes_[grown.model_.labels], [*first.labels, *second.labels])
    assert len(grown.model_.exemplars.views) == len(order.model_.exemplars.views)


def test_partial_fit_keeps_old_classes_and_the_type_of_labels(crowd, tmp_path):
    one = crowd[0].select(subject=0, action=FEW)
    ActionIndexer(random_state=None).partial_fit(one[:3], [5, 3, 9]).save(tmp_path / "m.safetensors")
    indexer = ActionIndexer.load(tmp_path / "m.safetensors").partial_fit(one[3:], [1])
    assert indexer.classes_.tolist() == [1, 3, 5, 9] and indexer.classes_.dtype.kind == "i"
    assert indexer.predict(one).tolist() == [5, 3, 9, 1]
    with pytest.raises(ValueError, match="labels: the fitted labels are of type int64, the new ones <U3"):
        indexer.partial_fit(one[3:], ["bow"])
    named = ActionIndexer().fit(one[:2]).partial_fit(one[3:], ["jumping_jack"])  # a longer name than any before, and alone
    assert named.classes_.tolist() == ["jumping_jack", "squat", "wave"]
    assert named.predict([*one[:2], one[3]]).tolist() == ["squat", "wave", "jumping_jack"]


# ---- reject ------------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def strangers(crowd):
    """Per action: an indexer that was not taught it, and how well other people's clips of that action fit all the same."""
    train, test = crowd
    fitted = [ActionIndexer(scorer="nearest").fit(train[train.labels != action]) for action in ACTIONS]
    return [(one, one.evidence(test[test.labels == action])) for one, action in zip(fitted, ACTIONS, strict=True)]


@pytest.mark.slow
def test_unknown_actions_are_not_taken_for_known_ones_more_often_than_asked_for(strangers):
    def share(rate, classes):
        return np.mean([found >= reject_threshold(rate, one.model_.evidence_out, classes) for one, found in strangers])

    for rate in (0.1, 0.3):
        by_class, by_clip = share(rate, len(ACTIONS) - 1), share(rate, None)  # the last as if each clip were of its own action
        assert by_class <= 1.2 * rate and by_class <= by_clip and 0.2 * rate <= by_clip <= 1.6 * rate, rate


@pytest.mark.slow
def test_a_stricter_rate_refuses_more_and_only_ever_replaces_answers(crowd):
    train, test = crowd
    indexer = ActionIndexer(scorer="nearest", none_label="none")
    answers = [indexer.set_params(reject=rate).fit(train).predict(test) for rate in (0.5, 0.1, 0.02)]
    refused = [(answer == "none").mean() for answer in answers]
    assert refused == sorted(refused) and refused[1] < 0.15  # known actions by other people
    assert (answers[1] == test.labels).mean() > 0.85
    train = train.select(subject=[0, 1])
    free, bound = ActionIndexer().fit(train), ActionIndexer(reject=0.02, none_label="none").fit(train)
    np.testing.assert_array_equal(free.decision_function(test), bound.decision_function(test))
    evidence, answers = bound.evidence(test), bound.predict(test)
    kept = answers != "none"
    np.testing.assert_array_equal(answers[kept], free.predict(test)[kept])
    np.testing.assert_array_equal(kept, evidence >= bound.reject_threshold_)
    level = float(np.median(evidence))
    assert level > 1
    for threshold in (level, 1e9, -1e9):
        indexer = bound.set_params(reject=threshold).fit(train)
        assert indexer.reject_threshold_ == threshold
        np.testing.assert_array_equal(indexer.predict(test) == "none", evidence < threshold)


@pytest.mark.slow
def test_none_label_keeps_the_type_where_it_can(crowd):
    train = crowd[0].select(subject=[0, 1], action=FEW)
    for labels, none_label, kind in (
        ("int", -1, "i"), ("str", "a long name for nothing", "U"), ("str", -1, "O"), ("str", None, "O"), ("float", -1.0, "f"),
    ):  # fmt: skip
        y = train.labels if labels == "str" else np.unique(train.labels, return_inverse=True)[1].astype(labels)
        indexer = ActionIndexer(scorer="nearest", reject=1e9, none_label=none_label).fit(train, y)
        answer = indexer.predict(train)
        assert answer.dtype.kind == kind and answer.tolist() == [none_label] * len(train), labels
        assert indexer.score(train, y) == 0.0
