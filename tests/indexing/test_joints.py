"""Joints are matched by name: the order in which a file lists them means nothing."""

import numpy as np
import pytest

from indexing import ActionIndexer, Clip, PhaseIndexer
from indexing.actors import Person, dataset, detect, stream
from indexing.joints import canonical, layout_of, match_joints, places
from indexing.skeleton import (
    BODY25,
    BODY25B,
    COCO17,
    H36M17,
    HALPE26,
    HALPE136,
    HAND21,
    KINECT20,
    LAYOUTS,
    NTU25,
    WHOLEBODY133,
    Skeleton,
)

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


@pytest.mark.slow
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
    clip, said = match_joints(part, COCO17, "a.json")
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
        match_joints(clip, chain)
    assert match_joints(clip, star) == (clip, "") and match_joints(clip.replace(skeleton=None), None)[1] == ""
    assert "joint 0 is taken for joint 0" in match_joints(clip.replace(skeleton=None), chain)[1]
    assert layout_of([clip, clip.replace(skeleton=Skeleton("named", ("a", "b", "c", "d")))]).name == "named"


@pytest.mark.parametrize("learned", [layout for layout in LAYOUTS.values() if layout is not HAND21], ids=lambda x: x.name)
def test_a_model_of_any_layout_of_a_body_takes_coco(recording, learned):
    clip, said = match_joints(recording, learned, "a.json")
    shared = [name for name in COCO17.joints if name in learned.joints]
    assert clip.skeleton is learned or learned is COCO17
    for name in shared:
        np.testing.assert_array_equal(clip.joints[:, learned.joints.index(name)], recording.joints[:, COCO17.joints.index(name)])
    assert (said == "") == (learned is COCO17)
    assert ("near each other" in said) == (learned in (H36M17, KINECT20, NTU25))


def test_faces_and_fingers_do_not_make_another_layout(recording):
    for learned, count in ((WHOLEBODY133, 133), (HALPE136, 136)):
        said = match_joints(recording, learned, "a.json")[1]
        assert said.startswith(f"a.json: 17 of the {count} joints learned are in it; not ")
    with pytest.raises(ValueError, match=r"0 of its 17 \(nose, left_eye, right_eye, left_ear, ...\) have names of the 21 joints"):
        match_joints(recording, HAND21)


def test_a_model_of_openpose_scans_coco(recording):
    lesson = dataset([Person.random(0)], KNOWN, azimuth=0.0, rng=0)
    wide = [as_body25(clip) for clip in lesson]
    indexer = ActionIndexer(scorer="nearest").fit(wide, lesson.labels)
    with pytest.warns(UserWarning, match=r"17 of the 25 joints learned are in it; not neck, mid_hip"):
        indexer.predict([recording])


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("LShoulder", "left_shoulder"), ("RBigToe", "right_big_toe"), ("knee.R", "right_knee"), ("l_ankle", "Left Ankle"),
        ("lhip", "left_hip"), ("MidHip", "hip"), ("pelvis", "mid_hip"), ("root", "CHip"), ("Head", "head_top"),
        ("mouth_left", "left_mouth"),
    ],
)  # fmt: skip
def test_the_same_point_in_other_words(one, other):
    assert canonical(one) == canonical(other)
    assert places(Skeleton("a", ("x", one)), Skeleton("b", (other,))) == [1]


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("neck", "upper_neck"), ("head", "head_center"), ("left_hip", "mid_hip"), ("spine_base", "mid_hip"), ("neck", "thorax"),
        ("left_foot_index", "left_big_toe"), ("rear", "right_ear"), ("left_foot", "left_ankle"), ("hip_center", "root"),
    ],
)  # fmt: skip
def test_points_that_are_only_near_are_others(one, other):
    assert canonical(one) != canonical(other)
    assert places(Skeleton("a", (one,)), Skeleton("b", (other,))) == [-1]


def test_two_joints_with_names_for_one_point_are_taken_by_their_own(recording):
    assert places(Skeleton("a", ("hip", "mid_hip")), Skeleton("b", ("mid_hip", "hip"))) == [1, 0]
    assert places(Skeleton("a", ("hip", "root", "nose")), Skeleton("b", ("pelvis", "nose"))) == [-1, 2]  # which one nobody knows
    assert places(Skeleton("a", ("hip",)), Skeleton("b", ("hip", "pelvis"))) == [0, -1]


def test_openpose_layouts_share_what_they_share():
    found = {
        (a.name, b.name): sum(i >= 0 for i in places(a, b)) for a in (BODY25, BODY25B, HALPE26) for b in (BODY25, BODY25B, HALPE26)
    }
    assert found["BODY_25", "Halpe-26"] == 25 and found["BODY_25B", "Halpe-26"] == 24 and found["BODY_25", "BODY_25B"] == 23
