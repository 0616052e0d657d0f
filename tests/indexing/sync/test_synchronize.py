"""indexing.synchronize: what is read, who is compared, by which method, and what is said about it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import dyntorch
import indexing
from indexing.clip import Clip
from indexing.skeleton import COCO17, HALPE26, Skeleton
from indexing.sync.options import SyncOptions
from indexing.sync.people import common_joints
from indexing.sync.recordings import take_of
from indexing.sync.synchronize import recording_notices, synchronize
from tests.indexing.sync.scene import FPS, SKIPPED, cut, write_openpose

# torch's own, when it first loads its transforms; hidden outside of tests
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated")


# ---- what goes in --------------------------------------------------------------------------------------------------------
def test_it_is_public():
    assert indexing.synchronize is synchronize and "synchronize" in indexing.__all__


def test_clips_arrays_and_files_ask_the_same(cameras, library, tmp_path):
    first, second = cameras[:2]
    folders = [write_openpose(tmp_path / f"cam{i}_json", [clip]) for i, clip in enumerate((first, second), start=1)]
    found = [synchronize(first, second), synchronize(*folders, fps=FPS), synchronize(first.joints, second.joints, fps=(FPS, FPS))]
    for i in (1, 2):
        for name in ("a", "b"):
            assert torch.allclose(library[0][name], library[i][name], equal_nan=True) and library[i][name].dtype == torch.float64
        assert all(torch.allclose(*times) for times in zip(library[0]["times"], library[i]["times"], strict=True))
        assert library[i]["correspondence"] and library[i]["max_shift"] is None and library[i]["calibration"] is None
    weights = library[1]["weights"]
    assert [w.shape for w in weights] == [first.joints.shape[:2], second.joints.shape[:2]] and library[2]["weights"] is None
    assert torch.equal(weights[0] > 0, torch.from_numpy(first.seen)) and torch.allclose(weights[0], library[0]["weights"][0])
    assert not any(one.notes for one in found)


def test_rates_differ_and_options_reach_the_library(cameras, library):
    synchronize(cameras[0].joints, cameras[1].joints, fps=(30, 60), max_shift=1.5, calibration=(None, None))
    assert library[0]["times"][1][1].item() == pytest.approx(1 / 60)
    assert library[0]["max_shift"] == 1.5 and library[0]["calibration"] == (None, None)


def test_missing_frames_of_a_folder_keep_the_times_of_the_others(cameras, library, tmp_path):
    write_openpose(tmp_path / "a", [cameras[0]], missing=(3, 4, 5))
    notes = synchronize(tmp_path / "a", cameras[1], fps=FPS).notes
    assert notes == (f"a: 3 of {len(cameras[0])} frames are missing; the others keep their times",)
    times = library[0]["times"][0]
    assert len(times) == len(cameras[0]) - 3 and times[3].item() == pytest.approx(6 / FPS)


def test_frames_without_a_person_are_mentioned(cameras, library, tmp_path):
    half = cameras[0].replace(
        joints=np.where(np.arange(len(cameras[0]))[:, None, None] % 2, np.nan, cameras[0].joints), confidence=None
    )
    write_openpose(tmp_path / "a", [half])
    notes = synchronize(tmp_path / "a", cameras[1], fps=FPS).notes
    assert notes == ("a: 50 % of the frames show nobody",)


def test_rates_that_nobody_said_and_one_recording_twice_are_mentioned(cameras, library, tmp_path):
    folder = write_openpose(tmp_path / "cam1_json", [cameras[0]])
    notes = synchronize(folder, cameras[0].joints, fps=(None, 25.0)).notes
    assert notes[0] == "30 frames per second assumed for cam1; fps= says otherwise"
    assert synchronize(folder, folder, fps=FPS).notes == ("cam1 and cam1 are the same recording",)
    assert synchronize(cameras[0], cameras[0]).notes == ("cam1 and cam1 are the same recording",)
    assert synchronize(cameras[0].joints, cameras[0].joints.copy(), fps=FPS).notes == ("a and b are the same recording",)


def test_layouts_that_differ(cameras, library):
    more = np.concatenate([cameras[1].joints, np.full((len(cameras[1]), 9, 2), 5.0)], axis=2 - 1)
    halpe = Clip(more, fps=FPS, skeleton=HALPE26, name="halpe")
    note = "COCO-17 and Halpe-26 share 17 joints; these are compared"
    assert synchronize(cameras[0], halpe).notes == (note,) and library[0]["b"].shape[1] == 17 and library[0]["correspondence"]
    other = Clip(cameras[1].joints[:, :7], fps=FPS, skeleton=Skeleton("dots", tuple("abcdefg")))
    notes = synchronize(cameras[0], other).notes
    assert not library[1]["correspondence"] and library[1]["a"].shape[1] == 17 and library[1]["b"].shape[1] == 7
    assert notes == ("different joints (COCO-17, dots): compared as different points, which needs longer takes",)
    synchronize(cameras[0], cameras[1], correspondence=False)
    assert not library[2]["correspondence"]
    with pytest.raises(ValueError, match=r"correspondence=True needs the same joints in both, got 17 and 7"):
        synchronize(cameras[0], other, correspondence=True)


def test_common_joints_are_those_of_one_name(cameras):
    order = list(reversed(COCO17.joints))
    turned = cameras[1].replace(joints=cameras[1].joints[:, ::-1], confidence=None, skeleton=Skeleton("turned", tuple(order)))
    a, b, same, _ = common_joints(cameras[0], turned)
    assert same and np.array_equal(a.joints, cameras[0].joints, equal_nan=True)
    assert np.array_equal(b.joints, cameras[1].joints, equal_nan=True)


@pytest.mark.parametrize(
    ("a", "options", "says"),
    [
        ("no.json", {}, r"no\.json: no such file or folder"),
        ("empty", {}, r"empty: no person was detected in any of 5 frames"),
        ("cam1", {"method": "brightness"}, r"cam1: holds keypoints, and method='brightness' needs videos"),
        ("cam1", {"method": "guess"}, r"method must be one of auto, keypoints, tracks, brightness, sound, got 'guess'"),
        ("cam1", {"fps": 0}, r"fps must be a positive number of frames per second, got 0"),
        ("cam1", {"fps": (1, 2, 3)}, r"fps must be one number, or one for each of two cameras"),
        ("cam1", {"person": "me"}, r"person must be one of auto, largest, confident, tracked, got 'me'"),
        ("no.mp4", {}, r"no\.mp4'?: no such file"),
        ("broken.mp4", {}, r"broken\.mp4"),
    ],
)
def test_bad_input_is_one_line(cameras, library, tmp_path, a, options, says):
    write_openpose(tmp_path / "cam1", [cameras[0]])
    write_openpose(tmp_path / "empty", [cut(cameras[0], 0, 5).replace(joints=np.full((5, 17, 2), np.nan), confidence=None)])
    (tmp_path / "broken.mp4").write_bytes(b"\0\0\0\x18ftypmp42" + bytes(200))
    with pytest.raises(ValueError, match=says) as caught:
        synchronize(tmp_path / a, cameras[1], **options)
    assert "\n" not in str(caught.value) and not library


@pytest.mark.parametrize(
    ("value", "says"),
    [
        (np.zeros((4, 5)), r"a: expected keypoints \(frames, joints, 2\), motion capture \(frames, markers, 3\) or gray frames"),
        (np.zeros((4, 5, 3)), r"a: 4 frames, 12 are needed"),
        ("text", r"text: no such file or folder"),
        ([["a"]], r"a: expected a clip, a path or an array, got list"),
        (Clip(np.zeros((3, 4, 3)), name="deep"), r"deep: 3 frames, 12 are needed"),
        ([Clip(np.zeros((3, 4, 3)), name="deep"), Clip(np.zeros((3, 4, 2)))], r"a: holds 2D and 3D joints"),
    ],
)
def test_arrays_of_other_kinds_are_refused(cameras, library, value, says):
    with pytest.raises(ValueError, match=says):
        synchronize(value, cameras[1])


def test_remarks_are_about_recordings():
    takes = [take_of(np.full((5, 3, 2), float(i)), name=f"c{i}", fps=None if i else 25.0) for i in range(3)]
    assert [note.text for note in recording_notices(takes)] == ["30 frames per second assumed for c1, c2; fps= says otherwise"]


# ---- the library itself --------------------------------------------------------------------------------------------------
def test_two_cameras_of_one_scene(cameras):
    found = synchronize(cameras[0], cameras[1])
    assert found.ok and found.frames == pytest.approx(SKIPPED[0] - SKIPPED[1], abs=0.5), found


def test_options_reach_the_library(cameras, library):
    synchronize(cameras[0], cameras[1], options=SyncOptions(min_margin=0.7))
    assert library[0]["options"] == dyntorch.SynchronizeOptions(min_margin=0.7)


def test_options_reach_the_stages(rng):
    still = rng.normal(size=(30, 8, 2))
    with pytest.raises(ValueError, match="30 frames, 40 are needed"):
        synchronize(still, still, fps=30.0, options=SyncOptions(min_frames=40))
    with pytest.raises(ValueError, match="options must be SyncOptions"):
        synchronize(still, still, fps=30.0, options=dyntorch.SynchronizeOptions())
