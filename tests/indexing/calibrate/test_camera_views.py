"""What the cameras saw: the same joints in all of them, frames at their times, pictures that hold their keypoints."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from indexing.calibrate.camera_views import check_cameras, check_overlap, check_size, make_view, select_common_joints, to_pixels
from indexing.clip import Clip
from indexing.skeleton import BODY25, COCO17, HAND21, Skeleton
from indexing.sync.recordings import take_of
from tests.indexing.calibrate.scene import FPS, SIZE, filmed


def clip(joints, **more):
    return Clip(joints, **{"fps": FPS, "up": "-y", **more})


def moving(frames=30, joints=17, seed=0):
    rng = np.random.default_rng(seed)
    return 500 + np.cumsum(rng.normal(0, 5, (frames, joints, 2)), axis=0)


# ---- frames --------------------------------------------------------------------------------------------------------------
def test_frames_keep_their_times_and_joints_their_confidence_and_people_stand_side_by_side():
    joints, kept = moving(), np.r_[4:10, 13:30]
    joints[7, 3] = np.nan
    trust = np.linspace(0.1, 1, 30 * 17).reshape(30, 17)
    one = clip(joints[kept], times=kept / FPS, confidence=trust[kept])
    view = make_view(take_of(one, name="a"), [one], SIZE)
    tracks, weights = view.table(range(17))
    assert np.array_equal(view.times, kept / FPS)
    assert np.array_equal(tracks.numpy(), joints[kept], equal_nan=True) and float(weights[3, 3]) == 0
    weights[3, 3] = trust[7, 3]
    assert np.array_equal(weights.numpy(), trust[kept])
    a, b = clip(moving(seed=1)), clip(moving(20, seed=2), times=(np.arange(20) + 5) / FPS)
    tracks, weights = make_view(take_of([a, b], name="x"), [a, None, b], SIZE).table(range(17))
    assert tracks.shape == (30, 51, 2) and weights.shape == (30, 51) and bool(tracks[:, 17:34].isnan().all())  # who is missing
    assert torch.equal(tracks[:, :17], torch.tensor(a.joints)) and torch.equal(tracks[5:25, 34:], torch.tensor(b.joints))


def test_a_clock_that_runs_over_hardly_any_frames_is_refused():
    one = clip(moving(4, 3), times=np.array([0.0, 1 / FPS, 2 / FPS, 1e5]))
    with pytest.raises(ValueError, match="b: 11 frames show somebody, 12 are needed at least; film longer"):
        make_view(take_of(clip(moving(11)), name="b"), [clip(moving(11))], SIZE)
    with pytest.raises(ValueError, match="a: 4 frames over 100000 s at 30 per second: nearly all gap"):
        make_view(take_of(one, name="a"), [one], SIZE)


# ---- joints --------------------------------------------------------------------------------------------------------------
def test_layouts_are_joined_by_names():
    halves = Skeleton("upper", (*COCO17.joints[:13], "neck"), ((0, 13),))
    clips = [clip(moving(20, len(one.joints)), skeleton=one) for one in (COCO17, BODY25, halves)]
    found = select_common_joints(clips, ["a", "b", "c"])
    assert found.skeleton.joints == (*COCO17.joints, "neck")  # all that two of them have
    for one, place in zip(clips, found.places, strict=True):
        tracks = make_view(take_of(one, name="x"), [one], SIZE).table(place)[0]
        for i, (at, joint) in enumerate(zip(place, found.skeleton.joints, strict=True)):
            assert (one.skeleton.joints[at] == joint) if at >= 0 else joint not in one.skeleton.joints
            expected = one.joints[:, at] if at >= 0 else np.full((20, 2), np.nan)  # missing where a camera lacks it
            assert np.array_equal(tracks[:, i], expected, equal_nan=True)
    assert "COCO-17, BODY_25, upper: 18 joints" in found.note and (17, 0) in found.skeleton.bones
    same = select_common_joints(clips[:1] * 3, ["a", "b", "c"])
    assert same.skeleton is COCO17 and same.places == (tuple(range(17)),) * 3 and same.note == ""
    hand = Clip(np.zeros((1, 21, 2)), skeleton=HAND21)
    with pytest.raises(
        ValueError, match=r"a: its joints \(nose, .*\) share 0 names with those of any other camera, and 8 are needed"
    ):
        select_common_joints([clips[0], hand], ["a", "b"])
    bare = [Clip(np.zeros((1, n, 2))) for n in (14, 15)]
    with pytest.raises(ValueError, match="a: has 14 joints without names, b has 15, so nobody knows which is which; give layout="):
        select_common_joints(bare, ["a", "b"])
    assert select_common_joints(bare[:1] * 2, ["a", "b"]).skeleton is None


# ---- pictures ------------------------------------------------------------------------------------------------------------
def test_sizes_from_wherever_they_are_known_and_coordinates_from_0_to_1_become_pixels():
    named = take_of(clip(moving(), meta={"size": np.array([640, 480])}), name="a")
    assert to_pixels(named, None)[1] == (640, 480) and to_pixels(named, (1920, 1080))[1] == (1920, 1080)
    with pytest.raises(ValueError, match="b: the size of its picture is not known; give size= such as 1920x1080"):
        to_pixels(take_of(clip(moving()), name="b"), None)
    take, size = to_pixels(take_of(clip(moving() / np.array(SIZE), name="n"), name="n"), SIZE)
    assert np.allclose(take.people[0].joints, moving()) and np.allclose(take.everyone[0].joints, moving()) and size == SIZE
    assert not any("0 to 1" in str(note) for note in take.notes)


def test_sizes_and_times_that_do_not_hold_the_keypoints():
    one = filmed()[0][0]
    check_size(take_of(one, name="a"), [one], SIZE)
    tall = one.replace(joints=one.joints[..., ::-1] + np.array([0.0, 0.0]))
    with pytest.raises(ValueError, match=r"a: its picture of 640x480 does not hold its keypoints, which go from \(\d+, \d+\) to"):
        check_size(take_of(one, name="a"), [one], (640, 480))
    with pytest.raises(ValueError, match=r"is it 1080x1920\? "):
        check_size(take_of(tall, name="a"), [tall.replace(joints=tall.joints * [1.0, 1.5])], SIZE)
    few = np.array(one.joints)
    few[0, 0] = [90_000, -90_000]  # a detector's mistake is no contradiction
    check_size(take_of(one, name="a"), [one.replace(joints=few)], SIZE)
    clips = {name: clip(moving(seed=i), times=100 * (i == 2) + np.arange(30) / FPS) for i, name in enumerate("abc")}
    views = [make_view(take_of(one, name=name), [one], SIZE) for name, one in clips.items()]
    known = torch.tensor([[0.0, 1.0]] * 3, dtype=torch.float64)
    check_overlap(views[:2], known[:2])
    with pytest.raises(
        ValueError, match=r"c recorded from 100.000 to 100.967 s, a from 0.000 to 0.967 s of one clock: .* no time in"
    ):
        check_overlap(views, known)
    known[2, 0] = 100.0
    check_overlap(views, known)


# ---- together ------------------------------------------------------------------------------------------------------------
def test_cameras_that_are_none_of_one_rig():
    takes = [take_of(own, name=f"c{i}") for i, own in enumerate(filmed())]
    check_cameras(takes)
    with pytest.raises(ValueError, match="1 camera: two to 8 are calibrated together; add a camera"):
        check_cameras(takes[:1])
    with pytest.raises(ValueError, match="9 cameras: two to 8 are calibrated together; leave some out"):
        check_cameras(takes * 3)
    again = take_of(filmed()[0][0].replace(name="copy"), name="copy")
    with pytest.raises(ValueError, match="c0 and copy hold the same recording: a camera is given twice"):
        check_cameras([*takes, again])
    with pytest.raises(ValueError, match="gray: has no keypoints"):
        check_cameras([takes[0], take_of(np.zeros((20, 32, 32)), name="gray")])
