"""The readers on real files; skipped where DYNTORCH_DATA names no folder."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from indexing.clip import ClipSet
from indexing.readers import read, read_clip
from indexing.skeleton import BODY25B

FOLDER = os.environ.get("DYNTORCH_DATA")
pytestmark = pytest.mark.skipif(not FOLDER, reason="DYNTORCH_DATA is not set: no real data")
DATA = Path(FOLDER or ".")

SETS = {  # clips, frames, joints, dims, classes
    "utkinect": (100, 3095, 20, 3, 10),
    "florence3d": (215, 4016, 15, 3, 9),
    "jhmdb_joints2d": (609, 21126, 15, 2, 14),
    "cmu_mocap_60fps": (30, 43571, 31, 3, 0),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SETS)
def test_clip_sets(name: str, tmp_path: Path) -> None:
    clips = read(DATA / f"{name}.npz")
    count, frames, joints, dims, classes = SETS[name]
    assert len(clips) == count
    assert sum(map(len, clips)) == frames
    assert all(clip.joints.shape[1:] == (joints, dims) for clip in clips)
    assert len({clip.label for clip in clips if clip.label is not None}) == classes
    assert all(clip.fps_assumed == (name != "cmu_mocap_60fps") for clip in clips)
    clips.save(tmp_path / "copy.npz")
    for before, after in zip(clips, ClipSet.load(tmp_path / "copy.npz"), strict=True):
        np.testing.assert_array_equal(before.joints, after.joints)
        np.testing.assert_array_equal(before.times, after.times)
        assert (before.label, before.name, before.skeleton) == (after.label, after.name, after.skeleton)


def test_what_is_known_of_the_clips() -> None:
    assert read(DATA / "utkinect.npz").select(subject=[1, 2]).column("subject").tolist() == [1] * 20 + [2] * 20
    assert len(read(DATA / "jhmdb_joints2d.npz").select(split0=0)) + len(read(DATA / "jhmdb_joints2d.npz").select(split0=1)) == 609
    steps = np.concatenate([np.diff(clip.times) for clip in read(DATA / "utkinect.npz")]) * 30
    assert round(steps.min()) == 2
    assert round(steps.max()) == 16
    mocap = read(DATA / "cmu_mocap_60fps.npz")[0]
    assert mocap.skeleton is not None
    assert (mocap.name, mocap.fps, mocap.skeleton.joints[0]) == ("01_01", 60.0, "root")


@pytest.mark.parametrize("rule", ["largest", "confident", "tracked"])
@pytest.mark.parametrize("camera", range(4))
def test_openpose_of_four_cameras(camera: int, rule: str, tmp_path: Path) -> None:
    data = np.load(DATA / "pose2sim" / "pose2sim_balancing.npz")
    for i, people in enumerate(np.nan_to_num(data["keypoints_all"][camera])):
        listed = [{"person_id": [-1], "pose_keypoints_2d": one.ravel().tolist()} for one in people if one.any()]
        (tmp_path / f"cam_{i:012d}_keypoints.json").write_text(json.dumps({"version": 1.3, "people": listed}))
    clip = read_clip(tmp_path, fps=60.0, person=rule)
    chosen = np.nan_to_num(data["keypoints"][camera])
    truth = np.where(chosen[..., 2:] > 0, chosen[..., :2], np.nan)
    same = [np.allclose(a, b, equal_nan=True) for a, b in zip(clip.joints, truth, strict=True)]
    assert np.mean(same) >= 0.99  # in one frame of camera 0 the file's own choice is the bystander
    moved = np.nanmedian(np.linalg.norm(np.diff(clip.joints, axis=0), axis=2), axis=1)
    assert moved.max() < 60  # pixels per frame: nobody hops
    assert clip.skeleton is BODY25B
    np.testing.assert_allclose(clip.times, np.arange(100) / 60)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("mocap6_exercises.npz", ("not a clip set", "no 'joints'")),
        ("asl_gestures/eat.mkv", ("is a video", "no pose model")),
        ("asl_gestures", ("no .json or .txt",)),
        ("README.md", ("without keypoint columns",)),
    ],
)
def test_other_files_are_refused(name: str, words: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match=Path(name).name) as caught:
        read(DATA / name)
    assert all(word in str(caught.value) for word in words)
