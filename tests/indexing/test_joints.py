"""Joints are matched by name: the order in which a file lists them means nothing."""

import numpy as np
import pytest

from indexing import ActionIndexer, Clip, PhaseIndexer
from indexing.actors import Person, dataset, detect, stream
from indexing.joints import layout_of, matched
from indexing.skeleton import BODY25, COCO17, Skeleton

KNOWN = ("squat", "wave", "jumping_jack")
ORDER = np.random.default_rng(0).permutation(17)


@pytest.fixture(scope="module")
def lesson():
    return dataset([Person.random(0)], KNOWN, azimuth=0.0, rng=0)


@pytest.fixture(scope="module")
def recording():
    return detect(stream(["squat", "wave"], Person.random(1), rng=3)[0], azimuth=30.0, rng=5)


def shuffled(clip):
    skeleton = Skeleton("mine", tuple(COCO17.joints[i].replace("_", " ").title() for i in ORDER))
    confidence = None if clip.confidence is None else clip.confidence[:, ORDER]
    return clip.replace(joints=clip.joints[:, ORDER], confidence=confidence, skeleton=skeleton)


def as_body25(clip):
    """The same in BODY_25, whose other joints are somewhere, too."""
    joints = np.full((len(clip), 25, 2), 7.0)
    for i, name in enumerate(COCO17.joints):
        joints[:, BODY25.joints.index(name)] = clip.joints[:, i]
    return clip.replace(joints=joints, confidence=None, skeleton=BODY25)


@pytest.mark.parametrize("kind", [ActionIndexer, PhaseIndexer])
def test_the_order_of_the_joints_does_not_matter(lesson, recording, kind):
    indexer = kind().fit(lesson, lesson.labels)
    np.testing.assert_array_equal(indexer.score_frames(shuffled(recording)), indexer.score_frames(recording))
    mixed = kind().fit([shuffled(clip) if i % 2 else clip for i, clip in enumerate(lesson)], lesson.labels)
    np.testing.assert_array_equal(mixed.score_frames(recording), indexer.score_frames(recording))
    np.testing.assert_array_equal(
        indexer.decision_function([shuffled(clip) for clip in lesson]), indexer.decision_function(list(lesson))
    )


def test_a_layout_that_holds_the_other(lesson, recording):
    indexer = ActionIndexer(scorer="nearest").fit(lesson, lesson.labels)
    with pytest.warns(UserWarning, match=r"of its 25 joints \(BODY_25\) the 17 learned \(COCO-17\) are used"):
        scores = indexer.score_frames(as_body25(recording))
    np.testing.assert_array_equal(scores, indexer.score_frames(recording))


def test_joints_that_a_clip_does_not_have_are_not_seen(lesson, recording):
    few = [i for i, name in enumerate(COCO17.joints) if "ear" not in name]
    part = recording.replace(
        joints=recording.joints[:, few], confidence=None, skeleton=Skeleton("no ears", tuple(COCO17.joints[i] for i in few))
    )
    clip, said = matched(part, COCO17, "a.json")
    assert clip.joints.shape[1] == 17 and not clip.seen[:, [3, 4]].any() and clip.skeleton is COCO17
    assert said == "a.json: 15 of the 17 joints learned are in it; not left_ear, right_ear"
    np.testing.assert_array_equal(clip.joints[:, few], part.joints)


def test_layouts_that_share_too_little_are_refused(lesson):
    indexer = ActionIndexer(scorer="nearest").fit(lesson, lesson.labels)
    hand = Skeleton("mouse", ("snout", "tail", *(f"paw_{i}" for i in range(14)), "nose"))
    with pytest.raises(ValueError, match=r"clip 0 .*: joints: 1 of its 17 \(snout, tail, paw_0, paw_1, ...\) have names of the 17"):
        indexer.predict([lesson[0].replace(skeleton=hand)])


def test_layouts_without_names_that_contradict_each_other_are_refused():
    numbers = tuple(str(i) for i in range(4))
    chain, star = Skeleton("chain", numbers, ((0, 1), (1, 2), (2, 3))), Skeleton("star", numbers, ((0, 1), (0, 2), (0, 3)))
    clip = Clip(np.random.default_rng(0).normal(size=(5, 4, 2)), skeleton=star, name="b")
    with pytest.raises(ValueError, match=r"clip 'b': joints: their bones \(star\) are not those learned \(chain\)"):
        matched(clip, chain)
    assert matched(clip, star) == (clip, "") and matched(clip.replace(skeleton=None), None)[1] == ""
    assert "joint 0 is taken for joint 0" in matched(clip.replace(skeleton=None), chain)[1]
    assert layout_of([clip, clip.replace(skeleton=Skeleton("named", ("a", "b", "c", "d")))]).name == "named"
