"""Datasets of movement as clips: made by hand here, as xarray would have them, and by xarray where it is installed."""

from types import SimpleNamespace

import numpy as np
import pytest

from indexing import ActionIndexer, Clip, synchronize
from indexing.actors import Person, dataset
from indexing.movement import clip_of, clips_of, is_dataset
from indexing.skeleton import COCO17, Skeleton

AXES = ("time", "space", "keypoints", "individuals")
RANDOM = np.random.default_rng(0)


def variable(values, dims):
    return SimpleNamespace(values=np.asarray(values), dims=dims)


def poses(position, confidence=None, dims=AXES, coords=None, **attrs):
    """What a dataset of poses looks like, as far as it is looked at."""
    found = SimpleNamespace(position=variable(position, dims), attrs=attrs)
    found.coords = {name: variable(values, (name,)) for name, values in (coords or {}).items()}
    if confidence is not None:
        found.confidence = variable(confidence, tuple(axis for axis in dims if axis != "space"))
    return found


@pytest.fixture
def two():
    position = RANDOM.normal(size=(6, 2, 3, 2))
    position[2, :, 1, 0] = np.nan
    coords = {"time": np.arange(6) / 50, "space": ["x", "y"], "keypoints": ["nose", "hip", "tail"], "individuals": ["a", "b"]}
    return poses(
        position, RANDOM.uniform(size=(6, 3, 2)), coords=coords, fps=50.0, time_unit="seconds", source_file="/data/mice.h5"
    )


def test_each_individual_is_a_clip(two):
    clips = clips_of(two)
    assert [clip.name for clip in clips] == ["mice.h5#a", "mice.h5#b"]
    assert [clip.meta["person"] for clip in clips] == ["a", "b"] and {clip.meta["followed"] for clip in clips} == {"ids"}
    first = clips[0]
    assert np.array_equal(first.joints, two.position.values[..., 0].transpose(0, 2, 1), equal_nan=True)
    assert np.array_equal(first.confidence, two.confidence.values[..., 0]) and np.array_equal(first.times, np.arange(6) / 50)
    assert (first.fps, first.up, first.fps_assumed, first.skeleton.joints) == (50.0, "-y", False, ("nose", "hip", "tail"))
    with pytest.raises(ValueError, match=r"mice.h5: holds 2 individuals \(a, b\) where one is expected; choose one"):
        clip_of(two)


@pytest.mark.parametrize("order", [AXES, AXES[::-1], ("individuals", "time", "keypoints", "space")])
@pytest.mark.parametrize("singular", [False, True])
def test_axes_count_by_name(two, order, singular):
    place = [AXES.index(axis) for axis in order]
    names = tuple(axis.removesuffix("s") if singular else axis for axis in order)
    turned = poses(two.position.values.transpose(place), dims=names)
    turned.coords = {axis.removesuffix("s") if singular else axis: value for axis, value in two.coords.items()}
    found, expected = clips_of(turned, fps=50.0), clips_of(two)
    assert [clip.meta["person"] for clip in found] == ["a", "b"] and found[1].skeleton.joints == ("nose", "hip", "tail")
    assert all(np.array_equal(one.joints, other.joints, equal_nan=True) for one, other in zip(found, expected, strict=True))


def test_without_individuals_and_with_space_in_another_order():
    position = RANDOM.normal(size=(4, 3, 5))
    clip = clip_of(poses(position, dims=AXES[:3], coords={"space": ["z", "x", "y"]}))
    assert np.array_equal(clip.joints, position[:, [1, 2, 0]].transpose(0, 2, 1)) and clip.meta == {} and clip.up == "z"
    assert (clip.fps_assumed, clip.skeleton, clip.name, clip.confidence) == (True, None, "dataset", None)


def test_times():
    position = np.ones((4, 2, 3, 1)) * np.arange(3)[:, None]
    numbers = {"time": np.array([10, 11, 12, 15])}
    assert clip_of(poses(position, coords=numbers, fps=10.0, time_unit="frames")).times.tolist() == [1.0, 1.1, 1.2, 1.5]
    assert clip_of(poses(position, coords=numbers), fps=20.0).times.tolist() == [0.5, 0.55, 0.6, 0.75]
    late = clip_of(poses(position, coords=numbers, time_unit="frames"))
    assert late.fps_assumed and late.times[0] == pytest.approx(1 / 3)
    lasting = {"time": np.array([0, 40, 80, 120], dtype="timedelta64[ms]")}
    assert clip_of(poses(position, coords=lasting)).times.tolist() == [0.0, 0.04, 0.08, 0.12]
    dated = {"time": np.datetime64("2026-01-01T10:00") + np.array([0, 40, 80, 120], dtype="timedelta64[ms]")}
    assert clip_of(poses(position, coords=dated)).times.tolist() == [0.0, 0.04, 0.08, 0.12]


def test_what_is_not_seen_and_what_nobody_is_sure_of():
    position = np.ones((4, 2, 3, 2)) * np.arange(3)[:, None]
    position[..., 1] = np.nan
    sure = np.full((4, 3, 2), np.nan)
    assert [clip.confidence for clip in clips_of(poses(position, sure))] == [None]
    sure[0, 0, 0] = 0.25
    position[1, :, 2, 0] = np.nan
    clip = clips_of(poses(position, sure))[0]
    assert clip.confidence[0].tolist() == [0.25, 1.0, 1.0] and clip.confidence[1].tolist() == [1.0, 1.0, 0.0]
    assert clip.meta["person"] == "0"
    with pytest.raises(ValueError, match=r"dataset: nobody is seen in any of its 4 frames"):
        clips_of(poses(np.full((4, 2, 3, 2), np.nan)))


FOUR = np.ones((4, 2, 3, 1))
BAD = {
    "boxes": (poses(np.ones((4, 2, 3)), dims=("time", "space", "individuals")), "no keypoints; bounding boxes have none"),
    "no time": (poses(np.ones((2, 3)), dims=("space", "keypoints")), "but no time"),
    "another axis": (poses(np.ones((4, 2, 3, 2)), dims=(*AXES[:3], "view")), "axes time, space, keypoints, view.*select one"),
    "polar": (poses(FOUR, coords={"space": ["rho", "phi"]}), "space holds rho, phi; positions must be x, y"),
    "one coordinate": (poses(FOUR[:, :1], coords={"space": ["x"]}), "space holds x"),
    "text": (poses(np.full((4, 2, 3, 1), "a")), "position holds no numbers"),
    "confidence": (poses(FOUR, np.ones((3, 3, 1))), "confidence has the axes.*do not fit position"),
    "times": (poses(FOUR, coords={"time": np.arange(3)}), r"time has the shape \(3,\) for 4 frames"),
    "words for times": (poses(FOUR, coords={"time": np.array(["a"] * 4)}), "time holds 'a'"),
    "times go back": (poses(FOUR, coords={"time": np.array([0.0, 2, 1, 3])}, time_unit="seconds"), "times must increase"),
    "unit": (poses(FOUR, coords={"time": np.arange(4)}, time_unit="days"), "time_unit is 'days'"),
    "fps": (poses(FOUR, fps=1e99), "fps must be frames per second"),
    "up": (poses(FOUR, up="left"), "up must be one of"),
    "huge": (poses(FOUR * 1e30), "infinite or huge"),
}


@pytest.mark.parametrize("case", BAD, ids=str)
def test_what_is_no_dataset_of_poses(case):
    given, message = BAD[case]
    with pytest.raises(ValueError, match=message) as caught:
        clips_of(given)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "value", [None, 3, "a.nc", np.ones((4, 3, 2)), Clip(np.ones((4, 3, 2))), SimpleNamespace(position=3)], ids=repr
)
def test_what_does_not_look_like_one(value):
    assert not is_dataset(value)


@pytest.mark.slow
def test_indexers_and_synchronize_take_datasets():
    clips = list(dataset([Person.random(0)], ("squat", "wave", "kick"), azimuth=0.0, rng=0))
    given = [poses(clip.joints.transpose(0, 2, 1)[..., None], fps=30.0, time_unit="seconds") for clip in clips]
    labels = [clip.label for clip in clips]
    usual = ActionIndexer().fit(clips, labels)
    assert np.allclose(ActionIndexer().fit(given, labels).decision_function(given), usual.decision_function(clips), atol=1e-4)
    both = poses(np.stack([clip.joints[:40].transpose(0, 2, 1) for clip in clips], axis=3), fps=30.0)
    assert ActionIndexer().fit(both, labels).predict(given[:1]).tolist() == labels[:1]
    several = poses(np.stack([clips[0].joints[:40].transpose(0, 2, 1)] * 2, axis=3))
    with pytest.raises(ValueError, match="holds 2 individuals"):
        ActionIndexer().fit([several, *given[1:]], labels)
    shift = synchronize(given[1], poses(clips[1].joints[5:].transpose(0, 2, 1)[..., None], fps=30.0, time_unit="seconds"))
    assert shift.ok and shift.frames == pytest.approx(-5, abs=0.1)


# ---- the way back, where xarray is -----------------------------------------------------------------------------------------
def same(one, other):
    assert np.array_equal(one.joints, other.joints, equal_nan=True) and np.array_equal(one.times, other.times)
    assert one.fps == pytest.approx(other.fps) and one.fps_assumed == other.fps_assumed
    assert (one.up, one.label, one.skeleton) == (other.up, other.label, other.skeleton)
    assert (one.confidence is None) == (other.confidence is None)
    assert one.confidence is None or np.allclose(one.confidence, other.confidence)


def test_to_movement_and_back():
    xarray = pytest.importorskip("xarray")
    joints = RANDOM.normal(size=(9, 17, 2)).astype(np.float32) + 400
    joints[3, 4] = np.nan
    sure = np.where(np.isnan(joints).any(axis=2), 0.0, RANDOM.uniform(size=(9, 17)).astype(np.float32))
    clip = Clip(joints, confidence=sure, fps=25.0, name="a.json", label="walk", skeleton=COCO17, up="-y")
    found = clip.to_movement()
    assert isinstance(found, xarray.Dataset) and is_dataset(found)
    # what movement's own validator wants: these variables, these axes in this order, names that differ, fps and the unit of time
    assert found.position.dims == AXES and found.confidence.dims == (AXES[0], *AXES[2:])
    assert found.position.shape == (9, 2, 17, 1) and found.space.values.tolist() == ["x", "y"]
    assert found.keypoints.values.tolist() == list(COCO17.joints) and found.individuals.values.tolist() == ["id_0"]
    wanted = {"fps": 25.0, "time_unit": "seconds", "ds_type": "poses", "source_software": "dyntorch", "source_file": "a.json"}
    assert {name: found.attrs[name] for name in wanted} == wanted and np.array_equal(found.time.values, clip.times)
    same(clip_of(found), clip)
    uneven = Clip(joints, times=np.cumsum(RANDOM.uniform(0.01, 0.1, 9)), skeleton=Skeleton("s", tuple("abcdefghijklmnopq")))
    same(clip_of(uneven.to_movement()), uneven)
    nameless = Clip(np.concatenate([joints, joints[..., :1]], axis=2))
    assert nameless.to_movement().time.values.tolist() == list(range(9)) and "fps" not in nameless.to_movement().attrs
    same(clip_of(nameless.to_movement()), nameless)


def test_without_xarray_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "xarray", None)
    with pytest.raises(ValueError, match=r"datasets of movement need xarray; pip install xarray"):
        Clip(np.ones((4, 3, 2))).to_movement()
