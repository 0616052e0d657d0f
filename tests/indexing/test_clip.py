"""Clip and ClipSet: what they accept, what they say, and that they hold still."""

import dataclasses
import warnings

import numpy as np
import pytest
import torch

from indexing import ActionIndexer, Clip, ClipSet, synchronize
from indexing.actors import Person, stream
from indexing.clip import as_clip
from indexing.skeleton import COCO17, Skeleton

JOINTS = np.arange(5 * 3 * 2, dtype=float).reshape(5, 3, 2)


def with_value(array, at, value):
    out = np.array(array, dtype=float)
    out[at] = value
    return out


BAD = {
    "two axes": ({"joints": np.zeros((5, 3))}, r"joints must be \(frames, joints, 2 or 3\).*\(5, 3\)"),
    "several people": ({"joints": np.zeros((2, 5, 3, 2))}, "several clips are a list"),
    "four coordinates": ({"joints": np.zeros((5, 3, 4))}, r"\(5, 3, 4\)"),
    "no frame": ({"joints": np.zeros((0, 3, 2))}, "at least one frame"),
    "no joint": ({"joints": np.zeros((5, 0, 2))}, "one joint"),
    "infinite": ({"joints": with_value(JOINTS, (1, 1, 1), np.inf)}, "infinite.*NaN"),
    "text": ({"joints": "walk.json"}, "joints: expected an array of numbers"),
    "words": ({"joints": [[["a", "b"]]]}, "joints: expected an array of numbers"),
    "ragged": ({"joints": [[[1, 2]], [[1, 2], [3, 4]]]}, "joints: expected an array of numbers"),
    "none": ({"joints": None}, "joints: expected an array of numbers, got NoneType"),
    "complex": ({"joints": JOINTS * 1j}, "joints: expected an array of numbers"),
    "few times": ({"times": np.arange(4.0)}, r"times must hold one value per frame \(5\)"),
    "times of a table": ({"times": np.zeros((5, 1))}, "times must hold one value per frame"),
    "unsorted": ({"times": [0, 2, 1, 3, 4]}, "times must increase.*frame 2 is at 1 s after 2 s.*sort"),
    "repeated": ({"times": [0, 1, 1, 2, 3]}, "times must increase.*frame 2 is at 1 s after 1 s.*repeated"),
    "time NaN": ({"times": [0, 1, np.nan, 3, 4]}, "times contains NaN.*frame 2"),
    "time infinite": ({"times": [0, 1, 2, 3, np.inf]}, "times contains NaN or infinite values at frame 4"),
    "time text": ({"times": ["0", "1", "2", "3", "4"]}, "times: expected an array of numbers"),
    "confidence shape": ({"confidence": np.ones((3, 5))}, r"confidence must be \(frames, joints\) = \(5, 3\), got \(3, 5\)"),
    "confidence NaN": ({"confidence": with_value(np.ones((5, 3)), (2, 1), np.nan)}, "confidence is NaN at frame 2, joint 1"),
    "up": ({"up": "x"}, "up must be one of.*'x'"),
    "up None": ({"up": None}, "up must be one of"),
    "up z in 2D": ({"up": "z"}, "z only for 3D"),
    "up -z in 2D": ({"up": "-z"}, "z only for 3D"),
    "fps 0": ({"fps": 0.0}, "fps must be a positive number.*0.0"),
    "fps negative": ({"fps": -30}, "fps must be a positive number"),
    "fps NaN": ({"fps": np.nan}, "fps must be a positive number"),
    "fps infinite": ({"fps": np.inf}, "fps must be a positive number"),
    "fps text": ({"fps": "30"}, "fps must be a positive number"),
    "skeleton": ({"skeleton": COCO17}, "skeleton 'COCO-17' has 17 joints, the data 3"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_clips_are_refused_by_name(case):
    change, message = BAD[case]
    with pytest.raises(ValueError, match=message) as caught:
        Clip(**{"joints": JOINTS, "name": "take 7", **change})
    assert str(caught.value).startswith("clip 'take 7': ")


def test_times_come_from_the_rate_or_the_rate_from_the_times():
    clip = Clip(JOINTS)
    assert (clip.fps, clip.fps_assumed) == (30.0, True)
    np.testing.assert_allclose(clip.times, np.arange(5) / 30)
    clip = Clip(JOINTS, fps=50)
    assert (clip.fps, clip.fps_assumed, clip.duration) == (50, False, 0.08)
    clip = Clip(JOINTS, times=[1.0, 1.1, 1.2, 1.4, 1.5])
    assert clip.fps == pytest.approx(10.0) and not clip.fps_assumed
    assert clip.duration == pytest.approx(0.5)


def test_numbers_of_any_kind_become_floats():
    for kind in (np.float32, np.float64, np.int64, np.uint8, bool):
        clip = Clip(JOINTS.astype(kind))
        assert clip.joints.dtype == (kind if kind in (np.float32, np.float64) else np.float64)
        np.testing.assert_array_equal(clip.joints, JOINTS.astype(kind))
    assert Clip(JOINTS.tolist()).joints.shape == (5, 3, 2)
    assert Clip(torch.zeros(5, 3, 2, requires_grad=True)).joints.dtype == np.float32
    solid = Clip(np.zeros((5, 3, 3)), fps=25, name="a", label="walk", up="z", skeleton=Skeleton("s", ("x", "y", "w")))
    assert (len(solid), solid.dims) == (5, 3)
    assert repr(solid) == "Clip('a', label='walk', 5 frames x 3 joints x 3D, 0.16 s)"


def test_missing_joints_and_their_confidence():
    joints = with_value(JOINTS, (1, 2, 0), np.nan)
    clip = Clip(joints, confidence=with_value(np.ones((5, 3)), (1, 2), np.nan))
    assert not clip.seen[1, 2] and clip.seen.sum() == 14
    assert np.isnan(clip.confidence[1, 2])


def test_nothing_of_a_clip_can_be_changed():
    joints, times, confidence = JOINTS.copy(), np.arange(5.0), np.ones((5, 3))
    clip = Clip(joints, times=times, confidence=confidence)
    joints[:] = times[:] = confidence[:] = -1
    np.testing.assert_array_equal(clip.joints, JOINTS)
    np.testing.assert_array_equal(clip.times, np.arange(5.0))
    np.testing.assert_array_equal(clip.confidence, np.ones((5, 3)))
    for array in (clip.joints, clip.times, clip.confidence, Clip(JOINTS).times):
        assert not array.flags.writeable
    with pytest.raises(dataclasses.FrozenInstanceError):
        clip.label = "run"


def test_between_and_replace_keep_the_clock_and_everything_else():
    confidence = np.arange(15).reshape(5, 3)
    clip = Clip(JOINTS, times=[10, 11, 12, 13, 14], confidence=confidence, label="walk", name="w", meta={"view": 2})
    part = clip.between(11, 13)
    assert part.times.tolist() == [11, 12, 13]
    np.testing.assert_array_equal(part.joints, JOINTS[1:4])
    np.testing.assert_array_equal(part.confidence, confidence[1:4])
    assert (part.label, part.name, part.meta) == ("walk", "w", {"view": 2})
    with pytest.raises(ValueError, match=r"clip 'w': no frame between 20 s and 30 s; it runs from 10 s to 14 s"):
        clip.between(20, 30)
    assert clip.replace(label="run").label == "run" and clip.label == "walk"
    with pytest.raises(ValueError, match="times must hold"):
        clip.replace(joints=JOINTS[:3])
    assert as_clip(clip, fps=99) is clip
    made = as_clip(JOINTS, fps=10, name="3")
    assert (made.fps, made.name, made.fps_assumed) == (10, "3", False)
    with pytest.raises(ValueError, match=r"clip '3'.*array of numbers"):
        as_clip("file.json", name="3")


@pytest.fixture
def clips():
    meta = [{"view": v, "subject": s, "azimuth": 30.0 * v} for s in ("ann", "bob") for v in (1, 2, 3)]
    return ClipSet([Clip(JOINTS + i, label=f"a{i % 2}", meta=m) for i, m in enumerate(meta)], "set")


def test_select(clips):
    for asked, count in (
        ({"view": 2}, 2), ({"view": [1, 3]}, 4), ({"view": np.array([1, 3]), "subject": "bob"}, 2), ({"action": "a1"}, 3),
        ({"label": "a1"}, 3), ({"view": 99}, 0), ({"azimuth": 60}, 2), ({"view": 2.0}, 2),
    ):  # fmt: skip
        assert len(clips.select(**asked)) == count, asked
    assert [c.meta["view"] for c in clips.select(view=(3, 1), subject="ann")] == [1, 3]  # the set's order, not the query's
    with pytest.raises(ValueError, match=r"clip set 'set': no field 'camera'; known fields: view, subject, azimuth"):
        clips.select(camera=1)


def test_index(clips):
    assert clips[1] is clips.clips[1] and clips[np.int64(-1)] is clips.clips[-1]
    assert isinstance(clips[1:3], ClipSet) and clips[1:3].name == "set"
    assert [c.meta["view"] for c in clips[[2, 0]]] == [3, 1]
    assert len(clips[np.array([True, False] * 3)]) == 3 and len(clips[[]]) == 0
    with pytest.raises(ValueError, match="mask of 2 values cannot select from 6"):
        clips[np.array([True, False])]
    with pytest.raises(IndexError):
        clips[6]
    assert list(clips) == list(clips.clips)


def test_columns(clips):
    assert clips.fields == ("view", "subject", "azimuth")
    assert clips.column("view").tolist() == [1, 2, 3] * 2 and clips.column("view").dtype.kind == "i"
    assert clips.column("subject").dtype.kind == "U"
    np.testing.assert_array_equal(clips.column("action"), clips.labels)
    half = ClipSet([*clips, Clip(JOINTS)])
    with pytest.raises(ValueError, match="no field 'view'"):
        half.column("view")


def test_labels_keep_their_type():
    for labels, kind in (
        ([1, 2], "i"), (["a", "bcd"], "U"), ([0.5, 1.5], "f"), ([True, False], "b"), (["a", None], "O"), ([None, None], "O"),
        ([("arm", "left"), ("arm", "right")], "O"),
    ):  # fmt: skip
        found = ClipSet([Clip(JOINTS, label=label) for label in labels]).labels
        assert found.dtype.kind == kind and found.tolist() == labels


def test_rates_that_no_camera_has_and_times_beyond_the_precision_of_numbers_are_refused():
    for fps in (1e-300, 1e300, 1e-310):
        with pytest.raises(ValueError, match=r"fps must be frames per second, from 0.001 to 1,000,000, got"):
            Clip(np.zeros((4, 3, 2)), fps=fps)
    times = np.append(np.arange(39), 9e15) / 30
    with pytest.raises(ValueError, match=r"clip 'a': times reach 3e\+14 s, where numbers are 0.062 s apart, but frames 0.033 s"):
        Clip(np.zeros((40, 3, 2)), times=times, name="a")
    Clip(np.zeros((40, 3, 2)), times=np.arange(40) / 30 + 1.8e9)  # a date
    with pytest.raises(ValueError, match="joints contains infinite or huge values"):
        Clip(np.full((4, 3, 2), 1e12))


# ---- a third column that is no depth ---------------------------------------------------------------------------------------
def detected(frames=60, scale=(1280.0, 720.0)):
    """Joints that move smoothly, and how sure a detector is of each: x, y and confidence."""
    rng = np.random.default_rng(0)
    body = rng.uniform(-0.1, 0.1, (1, 17, 2)) + 0.5 + 0.1 * np.sin(np.arange(frames) / 9)[:, None, None]
    sure = rng.beta(5, 2, (frames, 17, 1))
    return np.concatenate([body * scale, sure], axis=2)


SURE = "which is the confidence of pixels, not depth; give joints\\[..., :2\\] and confidence=joints\\[..., 2\\]"
MAYBE = "z goes from 0 to 1 as a confidence does, and is taken for depth; if it is none, give joints"


def unseen(value):
    """The same with some joints not seen: ``value`` at all three."""
    joints = detected()
    joints[::3, 5] = value
    return joints


@pytest.mark.parametrize(
    "joints", [detected(), unseen(0.0), unseen(np.nan), detected() * [0.1, 0.1, 1]], ids=["all", "0", "NaN", "small"]
)
def test_confidence_of_pixels_is_no_depth(joints):
    for refused in (lambda: Clip(joints), lambda: ActionIndexer().fit([joints] * 2, "ab"), lambda: synchronize(joints, joints)):
        with pytest.raises(ValueError, match=SURE):
            refused()
    with pytest.warns(UserWarning, match=MAYBE):  # stretched to 0 to 1, only the values say what they are
        Clip(joints * [1 / 1280, 1 / 720, 1])
    point = detected()[:, :1]
    with pytest.warns(UserWarning, match=MAYBE):
        Clip(point)
    point[3] = 0
    with pytest.raises(ValueError, match=SURE):
        Clip(point)
    assert Clip(point[..., :2], confidence=point[..., 2]).dims == 2
    with pytest.raises(ValueError, match=r"of x, y, z and a confidence give joints\[..., :3\]"):
        Clip(np.ones((4, 3, 4)))


def test_depth_is_depth():
    """Bodies in 3D whose heights or depths go from 0 to 1: in metres, brought to a cube, far away, in millimetres."""
    scene, _ = stream(["wave", "squat", "kick"], Person(), rng=1)
    joints = scene.joints - scene.joints.min(axis=(0, 1))
    unit = joints / np.ptp(joints)
    far = joints / [1, 1, np.ptp(joints[..., 2])] + np.linspace(0, 80, len(joints))[:, None, None] * [1, 0, 0]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for one in (joints, unit, unit[..., [0, 2, 1]], unit[..., [2, 1, 0]], far, 1000 * joints, unit[:, :1], unit * [1, 1, 0]):
            assert Clip(one).dims == 3
