"""Joints are matched by name: the order in which a file lists them means nothing."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from indexing import ActionIndexer, Clip, ClipSet, PhaseIndexer
from indexing.actors import Person, dataset, detect, stream
from indexing.joints import canonical, layout_of, match_joints, places, rank_layouts, recognize_layout
from indexing.readers import read, read_clip
from indexing.skeleton import (
    BLAZEPOSE33,
    BODY25,
    BODY25B,
    COCO17,
    H36M17,
    HALPE26,
    HALPE136,
    HAND21,
    KINECT20,
    LAYOUTS,
    MEDIAPIPE33,
    NTU25,
    WHOLEBODY133,
    Skeleton,
    candidates,
    layout_named,
    usual_layout,
)
from tests.indexing.readers import tools

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


def test_layouts_that_hold_one_another(lesson, recording):
    indexer = ActionIndexer(scorer="nearest").fit(lesson, lesson.labels)
    with pytest.warns(UserWarning, match=r"of its 25 joints \(BODY_25\) the 17 learned \(COCO-17\) are used"):
        scores = indexer.score_frames(as_body25(recording))
    np.testing.assert_array_equal(scores, indexer.score_frames(recording))
    hand = Skeleton("mouse", ("snout", "tail", *(f"paw_{i}" for i in range(14)), "nose"))
    with pytest.raises(ValueError, match=r"clip 0 .*: joints: 1 of its 17 \(snout, tail, paw_0, paw_1, ...\) have names of the 17"):
        indexer.predict([lesson[0].replace(skeleton=hand)])
    wide = indexer.fit([as_body25(clip) for clip in lesson], lesson.labels)
    with pytest.warns(UserWarning, match=r"17 of the 25 joints learned are in it; not neck, mid_hip"):
        wide.predict([recording])


def test_joints_that_a_clip_does_not_have_are_not_seen(lesson, recording):
    few = [i for i, name in enumerate(COCO17.joints) if "ear" not in name]
    part = recording.replace(
        joints=recording.joints[:, few], confidence=None, skeleton=Skeleton("no ears", tuple(COCO17.joints[i] for i in few))
    )
    clip, said = match_joints(part, COCO17, "a.json")
    assert clip.joints.shape[1] == 17 and not clip.seen[:, [3, 4]].any() and clip.skeleton is COCO17
    assert said == "a.json: 15 of the 17 joints learned are in it; not left_ear, right_ear"
    np.testing.assert_array_equal(clip.joints[:, few], part.joints)


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
    if learned in (WHOLEBODY133, HALPE136):  # faces and fingers do not make another layout
        assert said.startswith(f"a.json: 17 of the {len(learned.joints)} joints learned are in it; not ")
    with pytest.raises(ValueError, match=r"0 of its 17 \(nose, left_eye, right_eye, left_ear, ...\) have names of the 21 joints"):
        match_joints(recording, HAND21)


SAME = [
    ("LShoulder", "left_shoulder"), ("RBigToe", "right_big_toe"), ("knee.R", "right_knee"), ("l_ankle", "Left Ankle"),
    ("lhip", "left_hip"), ("MidHip", "hip"), ("pelvis", "mid_hip"), ("root", "CHip"), ("Head", "head_top"),
    ("mouth_left", "left_mouth"),
]  # fmt: skip
NEAR = [
    ("neck", "upper_neck"), ("head", "head_center"), ("left_hip", "mid_hip"), ("spine_base", "mid_hip"), ("neck", "thorax"),
    ("left_foot_index", "left_big_toe"), ("rear", "right_ear"), ("left_foot", "left_ankle"), ("hip_center", "root"),
]  # fmt: skip


def test_the_same_point_in_other_words_and_points_that_are_only_near():
    for one, other in SAME:
        assert canonical(one) == canonical(other) and places(Skeleton("a", ("x", one)), Skeleton("b", (other,))) == [1], one
    for one, other in NEAR:
        assert canonical(one) != canonical(other) and places(Skeleton("a", (one,)), Skeleton("b", (other,))) == [-1], one
    # two joints with names for one point are taken by their own
    assert places(Skeleton("a", ("hip", "mid_hip")), Skeleton("b", ("mid_hip", "hip"))) == [1, 0]
    assert places(Skeleton("a", ("hip", "root", "nose")), Skeleton("b", ("pelvis", "nose"))) == [-1, 2]  # which one nobody knows
    assert places(Skeleton("a", ("hip",)), Skeleton("b", ("hip", "pelvis"))) == [0, -1]
    shared = [sum(i >= 0 for i in places(a, b)) for a, b in ((BODY25, HALPE26), (BODY25B, HALPE26), (BODY25, BODY25B))]
    assert shared == [25, 24, 23]


# Layouts: by the names of a file, by what a body looks like where there are none, or as a person says


BODIES = [layout for layout in LAYOUTS.values() if layout not in (HAND21, BLAZEPOSE33)]


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=lambda layout: layout.name)
def test_layouts_are_whole(layout: Skeleton) -> None:
    assert len(set(layout.joints)) == len(layout.joints)
    connected = {i for bone in layout.bones for i in bone}
    assert {joint for i, joint in enumerate(layout.joints) if i not in connected and not joint.startswith(("face", "mouth"))} <= {
        *("left_eye_inner", "left_eye_outer", "right_eye_inner", "right_eye_outer", "left_pinky", "right_pinky", "left_thumb"),
        *("right_thumb", "left_hip", "right_hip"),
    }
    swapped = {joint.replace("left", "*").replace("right", "left").replace("*", "right") for joint in layout.joints}
    assert swapped == set(layout.joints)  # whoever has a left one has a right one
    pairs = {frozenset(layout.joints[i] for i in bone) for bone in layout.bones}
    mirrored = {frozenset(j.replace("left", "*").replace("right", "left").replace("*", "right") for j in pair) for pair in pairs}
    assert mirrored == pairs
    assert layout_named(layout.name.lower().replace("-", "")) is layout


def test_numbers_of_joints() -> None:
    sizes = {layout.name: len(layout.joints) for layout in LAYOUTS.values()}
    assert sizes == {
        "COCO-17": 17, "H36M-17": 17, "BODY_25": 25, "BODY_25B": 25, "NTU-25": 25, "Kinect-20": 20, "Halpe-26": 26,
        "Halpe-136": 136, "COCO-WholeBody-133": 133, "MediaPipe-33": 33, "blazepose33": 33, "MediaPipe-hand-21": 21,
        "OpenPose-COCO-18": 18,
        "OpenPose-MPI-15": 15,
    }  # fmt: skip
    usual = {17: COCO17, 25: BODY25, 26: HALPE26, 33: MEDIAPIPE33, 133: WHOLEBODY133, 136: HALPE136, 20: None}
    assert {count: usual_layout(count) for count in usual} == usual
    assert candidates(17) == (COCO17, H36M17) and candidates(25) == (BODY25, BODY25B, NTU25) and candidates(9) == ()


@pytest.mark.parametrize(
    ("layout", "places"),
    [
        (BODY25B, {"left_hip": 11, "upper_neck": 17, "head_top": 18, "left_big_toe": 19, "right_heel": 24}),
        (H36M17, {"root": 0, "right_hip": 1, "left_ankle": 6, "head": 10, "left_shoulder": 11, "right_wrist": 16}),
        (NTU25, {"head_center": 3, "left_hand": 7, "right_shoulder": 8, "left_hip": 12, "spine_shoulder": 20, "right_thumb": 24}),
        (KINECT20, {"hip_center": 0, "head_center": 3, "left_shoulder": 4, "right_hand": 11, "left_hip": 12, "right_foot": 19}),
        (HALPE136, {"head": 17, "hip": 19, "right_heel": 25, "face_0": 26, "left_hand_wrist": 94, "right_hand_wrist": 115}),
        (WHOLEBODY133, {"left_big_toe": 17, "right_heel": 22, "face_0": 23, "left_hand_wrist": 91, "right_hand_wrist": 112}),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_joints_are_where_the_tool_puts_them(layout: Skeleton, places: dict[str, int]) -> None:
    assert {name: layout.joints.index(name) for name in places} == places


# ---- by what a body looks like -------------------------------------------------------------------------------------------
@pytest.mark.parametrize("layout", [layout for layout in BODIES if len(layout.joints) <= 33], ids=lambda layout: layout.name)
def test_a_body_is_recognized_among_its_rivals_and_what_is_up(layout: Skeleton) -> None:
    flat, solid = (tools.standing(layout, dims=dims) for dims in (2, 3))
    turned = solid[..., [0, 2, 1]]
    for points, up, said in (
        (flat, "-y", "-y"), (flat, "-y", None), (solid, "y", "y"), (solid, "y", None), (turned, "z", None), (-turned, "-z", None),
    ):  # fmt: skip
        found = recognize_layout(points, candidates(len(layout.joints)), said)
        assert found is not None and found.layout is layout and (said is not None or found.up == up)


def test_points_of_no_body_are_not_recognized_and_missing_joints_do_not_matter_much() -> None:
    rng = np.random.default_rng(0)
    for joints in (17, 20, 25):
        assert recognize_layout(rng.normal(size=(50, joints, 2)), candidates(joints), "-y") is None
        assert recognize_layout(np.full((5, joints, 2), np.nan), candidates(joints), "-y") is None
        assert recognize_layout(np.zeros((5, joints, 2)), candidates(joints), None) is None
    assert recognize_layout(rng.normal(size=(50, 9, 2)), candidates(9), "-y") is None
    assert recognize_layout(tools.standing(BODY25)[..., ::-1], candidates(25), "-y") is None  # lying
    body = tools.standing(BODY25B, frames=60)
    body[rng.random(body.shape[:2]) < 0.4] = np.nan
    found = recognize_layout(body, candidates(25), "-y")
    assert found is not None and found.layout is BODY25B
    best, second, _ = rank_layouts(body, candidates(25), "-y")
    assert best.layout is BODY25B and best.bones < 0.5 < second.bones


# ---- in files ------------------------------------------------------------------------------------------------------------
def openpose(folder: Path, body: np.ndarray) -> Path:
    folder.mkdir()
    for i, frame in enumerate(body):
        flat = np.c_[frame, np.ones(len(frame))].ravel().tolist()
        (folder / f"a_{i:012d}_keypoints.json").write_text(json.dumps({"people": [{"pose_keypoints_2d": flat}]}))
    return folder


def test_openpose_writes_two_layouts_of_25_and_what_is_not_clear_a_person_decides(tmp_path: Path) -> None:
    for layout, meta in ((BODY25, {}), (BODY25B, {"layout": "recognized: BODY_25B"})):
        clip = read_clip(openpose(tmp_path / layout.name, tools.standing(layout)))
        assert (clip.skeleton, clip.meta) == (layout, meta)
    folder = openpose(tmp_path / "a", tools.standing(BODY25B)[..., ::-1])
    clip = read_clip(folder)
    assert (clip.skeleton, clip.meta) == (BODY25, {"layout": "guessed: BODY_25, not BODY_25B"})
    clip = read_clip(folder, layout="body25b")
    assert (clip.skeleton, clip.meta) == (BODY25B, {})
    with pytest.raises(
        ValueError, match=r"a: has 25 joints, but layout=COCO-17 has 17; name another one \(of 25 joints: BODY_25, "
    ):
        read(folder, layout="COCO-17")
    with pytest.raises(ValueError, match=r"layout 'nothing': there is none of this name; use one of COCO-17, "):
        read(folder, layout="nothing")


@pytest.mark.parametrize("layout", [COCO17, H36M17, KINECT20, NTU25, BODY25B])
def test_clip_sets_without_names(layout: Skeleton, tmp_path: Path) -> None:
    body = tools.standing(layout, dims=3)
    np.savez(tmp_path / "set.npz", joints=np.concatenate([body, body]), offsets=[0, 12, 24], fps=30.0)
    clips = read(tmp_path / "set.npz")
    assert all(clip.skeleton is layout for clip in clips)
    assert clips.column("layout").tolist() == [f"recognized: {layout.name}"] * 2
    clips.save(tmp_path / "copy.npz")
    again = ClipSet.load(tmp_path / "copy.npz")
    assert [clip.skeleton for clip in again] == [layout] * 2 and again.column("layout").tolist() == clips.column("layout").tolist()
    other = read(tmp_path / "set.npz", layout={17: "COCO-17", 20: "Kinect-20", 25: "BODY_25"}[len(layout.joints)])
    assert other[0].skeleton is usual_layout(len(layout.joints)) or layout is KINECT20
    assert "layout" not in other.fields
    assert "layout" not in read(tmp_path / "copy.npz", layout=layout.name).fields


def test_clip_sets_whose_bodies_show_nothing_stay_without_names(tmp_path: Path) -> None:
    np.savez(tmp_path / "set.npz", joints=np.random.default_rng(0).normal(size=(9, 17, 2)))
    (clip,) = read(tmp_path / "set.npz")
    assert (clip.skeleton, dict(clip.meta)) == (None, {})
    names = [f"mine{i}" for i in range(17)]
    np.savez(tmp_path / "named.npz", joints=tools.standing(COCO17, dims=3), joint_names=names)
    (clip,) = read(tmp_path / "named.npz")
    assert clip.skeleton is not None and clip.skeleton.joints == tuple(names)
    (clip,) = read(tmp_path / "named.npz", layout="COCO-17")
    assert clip.skeleton is COCO17
    np.savez(tmp_path / "flat.npz", joints=tools.standing(COCO17), up="-y")
    found = read_clip(tmp_path / "flat.npz")
    assert "layout" in found.meta  # what readers say of some clips does not keep a set from being saved
    ClipSet([found, found.replace(meta={})]).save(tmp_path / "both.npz")
    assert "layout" not in ClipSet.load(tmp_path / "both.npz").fields


def test_a_lifter_of_mmpose_gives_the_joints_of_human36m(tmp_path: Path) -> None:
    body = tools.standing(H36M17, dims=3)[..., [0, 2, 1]]  # z up
    frames = [{"frame_id": i, "instances": [{"keypoints": f.tolist(), "keypoint_scores": [1.0] * 17}]} for i, f in enumerate(body)]
    (tmp_path / "bare.json").write_text(json.dumps(frames))
    clip = read_clip(tmp_path / "bare.json")
    assert (clip.skeleton, clip.up, clip.dims) == (H36M17, "z", 3)
    names = [name.replace("ankle", "foot") for name in H36M17.joints]
    meta = {"dataset_name": "h36m", "keypoint_id2name": {str(i): name for i, name in enumerate(names)}, "skeleton_links": []}
    (tmp_path / "named.json").write_text(json.dumps({"meta_info": meta, "instance_info": frames}))
    clip = read_clip(tmp_path / "named.json")
    assert clip.skeleton is not None and clip.skeleton.joints == H36M17.joints


def test_a_layout_does_not_overrule_names_that_a_file_carries(tmp_path):
    joints = np.random.default_rng(0).normal(size=(9, 17, 2)) * 50 + 300
    mixed = Skeleton("mine", (COCO17.joints[1], COCO17.joints[0], *COCO17.joints[2:]))
    for name, own in (("named", mixed), ("numbered", Skeleton("any", tuple(map(str, range(17)))))):
        ClipSet([Clip(joints, skeleton=own, up="-y", fps=30.0)]).save(tmp_path / f"{name}.npz")
    with pytest.raises(ValueError, match=r"named.npz: names its joints itself \(left_eye where layout=COCO-17 has nose\); leave"):
        read(tmp_path / "named.npz", layout="COCO-17")
    assert read(tmp_path / "numbered.npz", layout="COCO-17")[0].skeleton.joints == COCO17.joints
    np.save(tmp_path / "bare.npy", joints)
    assert read(tmp_path / "bare.npy", layout="H36M-17")[0].skeleton.name == "H36M-17"
