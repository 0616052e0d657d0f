"""Keypoint files on one clock."""

from __future__ import annotations

import json

import numpy as np
import pytest

from indexing.clip import Clip
from indexing.readers import read
from indexing.sync.files import openpose_frames, plan, renumber, write_poses
from indexing.sync.recordings import take_of
from tests.indexing.sync.scene import FPS, cut, moved, write_openpose

# torch's own, when it first loads its transforms; hidden outside of tests
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated")


def test_equal_numbers_are_equal_moments():
    take = take_of(np.ones((50, 3, 2)), fps=30.0)
    same = plan(take, -0.4, 1.0, 30.0)  # this camera began 0.4 s later: its frame 0 is the reference's frame 12
    assert same.numbers.tolist() == list(range(12, 62)) and same.shift == -12 and same.before == same.repeated == 0
    assert same.rest < 1e-9
    for offset, rate, fps, frames in ((0.41, 1.0, 25.0, 30.0), (-0.2, 1.0003, 60.0, 30.0), (0.013, 0.9998, 30.0, 59.94)):
        other = take_of(np.ones((4000, 3, 2)), fps=frames)
        found = plan(other, offset, rate, fps)
        moments = rate * found.numbers / fps + offset
        best = np.abs(other.times[None] - moments[:200, None]).min(axis=1)
        assert np.abs(other.times[found.rows] - moments).max() == pytest.approx(found.rest) and found.rest <= 0.5 / frames * 1.001
        assert np.allclose(np.abs(other.times[found.rows] - moments)[:200], best) and (np.diff(found.numbers) == 1).all()
    over = plan(take, 30.0, 1.0, 30.0)  # it ended before the reference began
    assert len(over.rows) == 0 and over.before == 50 and over.rest == 0 and over.shift is None


def test_names_keep_their_form():
    assert renumber("a1_000000000012_keypoints.json", 7) == "a1_000000000007_keypoints.json"
    assert renumber("cam01.99.json", 1234) == "cam01.1234.json" and renumber("000.json", 5) == "005.json"


def test_shifted_folders(tmp_path, cameras):
    source = write_openpose(tmp_path / "cam2_json", [cut(cameras[0], 0, 20), moved(cut(cameras[0], 0, 20), 700.0)], missing=(7,))
    take = take_of(source, fps=FPS)
    target = write_poses(tmp_path, [plan(take, 4.25 / FPS, 1.0, FPS)])
    names = sorted(path.name for path in (target / "cam2_json").iterdir())
    assert names == [f"cam2_json_{i:012d}_keypoints.json" for i in range(16) if i != 3]  # frame 7 is missing, and 4 are before 0
    for i in (0, 2, 15):
        text = (target / "cam2_json" / names[i if i < 3 else i - 1]).read_text()
        assert text == (source / f"cam2_json_{i + 4:012d}_keypoints.json").read_text()
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


def test_frames_without_people_are_shifted_as_well(tmp_path, cameras):
    gone = cut(cameras[0], 0, 12).joints.copy()
    gone[:4] = np.nan
    take = take_of(write_openpose(tmp_path / "cam1", [Clip(gone, fps=FPS)]), fps=FPS)
    assert take.count == 12 and len(list((write_poses(tmp_path, [plan(take, 0.0, 1.0, FPS)]) / "cam1_json").iterdir())) == 12


def test_other_formats_are_written_as_openpose(tmp_path, cameras):
    clip = cut(cameras[0], 0, 6)
    table = np.nan_to_num(np.concatenate([clip.joints, np.where(clip.seen, 0.8, 0.0)[..., None]], axis=2))
    rows = [{"image_id": i, "category_id": 1, "keypoints": table[i].ravel().tolist(), "score": 1.0} for i in range(6)]
    (tmp_path / "cam1.json").write_text(json.dumps(rows))
    take = take_of(tmp_path / "cam1.json", fps=FPS)
    target = write_poses(tmp_path, [plan(take, 2 / FPS, 1.0, FPS)])
    again = read(target / "cam1_json", fps=FPS)[0]
    assert np.allclose(again.joints, clip.joints[2:], equal_nan=True) and len(again) == 4
    assert json.loads(openpose_frames(take)[0])["people"][0]["person_id"] == [-1]
