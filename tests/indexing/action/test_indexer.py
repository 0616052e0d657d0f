"""Recognition of synthetic people from elsewhere, and every kind of input."""

import numpy as np
import pytest
import torch

from indexing import ActionIndexer, Clip
from indexing.action.bank import fused_residual
from indexing.actors import ACTIONS, Person, dataset, perform
from indexing.cameras import virtual

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
    distance = fused_residual(windows_of(others), [windows_of(lesson)], indexer.model_.metric, terms=("nn",))
    view_bound = (lesson.labels[distance.argmin(dim=1).numpy()] == others.labels).mean()
    assert accuracy > view_bound + 0.05


@pytest.mark.slow
def test_each_scorer_is_what_it_says(lesson, others):
    from indexing.action.bank import Windows

    both = ActionIndexer().fit(lesson)
    for name, scores in (("nearest", both.model_.nearest_scores), ("kernel", both.model_.machine_scores)):
        alone = ActionIndexer(scorer=name).fit(lesson)
        query: Windows = alone._queries(others)
        np.testing.assert_allclose(alone.decision_function(others), scores(query).numpy(), atol=1e-4)
        assert not np.allclose(alone.decision_function(others), both.decision_function(others))


@pytest.mark.parametrize("scorer", ["nearest", "kernel"])
def test_each_scorer_alone(scorer, lesson, others):
    assert ActionIndexer(scorer=scorer).fit(lesson).score(others, others.labels) > 0.88


def test_no_virtual_views_and_no_search(lesson, others):
    plain = ActionIndexer(virtual_views=0, search=False).fit(lesson)
    assert plain.score(others, others.labels) > 0.8
    assert plain.model_.copies()[0].values.shape[0] == 13


def test_same_view(lesson):
    same = ActionIndexer(view="same").fit(lesson)
    seen = dataset([Person.random(1), Person.random(2)], ACTIONS, azimuth=5.0, rng=9)
    assert same.score(seen, seen.labels) > 0.9


@pytest.mark.slow
def test_learned_weights(few):
    train, test = few
    learned = ActionIndexer(weights="learned").fit(train)
    assert float(learned.model_.parts.joints.mean()) == pytest.approx(1.0, abs=1e-5)
    assert learned.score(test, test.labels) == 1.0
    single = ActionIndexer(weights="learned").fit(train[:4])  # one example per class: nobody can be left out
    assert not single.model_.parts.learned and single.model_.blend == ActionIndexer().fit(train[:4]).model_.blend


@pytest.mark.slow
def test_3d_exemplars_recognize_2d_queries(lesson_3d, others):
    solid = ActionIndexer().fit(lesson_3d)
    assert solid.score(others, others.labels) > 0.85
    assert solid.score(lesson_3d, lesson_3d.labels) > 0.9  # 3D queries are seen along z


@pytest.mark.slow
def test_2d_and_3d_exemplars_together(few):
    train, test = few
    mixed = [*train[:4], *(perform(action, Person.random(30), rng=3) for action in FEW)]
    assert ActionIndexer().fit(mixed).score(test, test.labels) == 1.0


def views_of(clip, azimuths=(0.0, 50.0, 110.0)):
    return tuple(virtual(clip, azimuth, 0.05 * i, distance=20.0) for i, azimuth in enumerate(azimuths))


@pytest.mark.parametrize("count", [1, 2, 3])
def test_several_synchronized_views_are_one_exemplar(few, count):
    _, test = few
    shown = [views_of(perform(action, Person.random(31), rng=4))[:count] for action in FEW]
    indexer = ActionIndexer().fit(shown, FEW)
    assert len(indexer.model_.labels) == 4 * (count if count < 3 else 1)  # three views decide a 3D shape
    assert indexer.score(test, test.labels) == 1.0
    assert indexer.exemplar(0).label == "squat"


def test_views_with_different_clocks_and_rates(few):
    _, test = few
    shown = []
    for action in FEW:
        a, b, c = views_of(perform(action, Person.random(31), rng=4))
        shown.append((a.between(0.1, 9), b, c.replace(joints=c.joints[::2], times=c.times[::2], fps=None)))
    indexer = ActionIndexer().fit(shown, FEW)
    assert len(indexer.model_.labels) == 4
    assert indexer.score(test, test.labels) == 1.0


def test_views_that_show_different_things_stay_apart_and_say_so(few):
    clips = [perform(action, Person.random(31), rng=4).between(0, 1.5) for action in FEW]
    odd = tuple(views_of(clip)[i] for i, clip in enumerate(clips[:3]))
    with pytest.warns(UserWarning, match="do not decide a 3D shape"):
        indexer = ActionIndexer(scorer="nearest").fit([odd, views_of(clips[3])[0]], ["mixed", "bow"])
    assert indexer.classes_[indexer.model_.labels].tolist() == ["mixed"] * 3 + ["bow"]


def test_a_four_axis_array_holds_views(few):
    _, test = few
    shown = [np.stack([v.joints for v in views_of(perform(action, Person.random(31), rng=4))]) for action in FEW]
    assert ActionIndexer().fit(shown, FEW).score(test, test.labels) == 1.0


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
    learned = []
    for i, clip in enumerate(lesson):
        joints = clip.joints.copy()
        joints[:, [3, 4, 9][i % 3]] = np.nan
        learned.append(clip.replace(joints=joints))
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


def test_tempo_frame_rate_and_trimming(indexer, others):
    changed = []
    for i, clip in enumerate(others.select(azimuth=60.0)):
        slow = clip.replace(times=clip.times * (0.6 + 0.3 * (i % 4)), fps=None)
        start, span = slow.times[0], slow.duration
        part = slow.between(start + 0.05 * span, start + 0.9 * span)
        changed.append(part.replace(joints=part.joints[:: 1 + i % 2], times=part.times[:: 1 + i % 2], confidence=None))
    assert (indexer.predict(changed) == others.select(azimuth=60.0).labels).mean() > 0.85


def test_position_and_size_in_the_image_do_not_matter(indexer, others):
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


def test_fps_is_that_of_arrays(few):
    train, _ = few
    arrays = [clip.joints for clip in train[:4]]
    slow = ActionIndexer(fps=10.0).fit(arrays, FEW)
    clips = ActionIndexer().fit([Clip(x, fps=10.0) for x in arrays], FEW)
    assert len(slow.model_.exemplars.moments) == len(clips.model_.exemplars.moments)
    assert len(slow.model_.exemplars.moments) > len(ActionIndexer(fps=30.0).fit(arrays, FEW).model_.exemplars.moments)
