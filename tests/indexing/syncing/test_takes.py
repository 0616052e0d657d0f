"""What one camera recorded: cameras in folders, their names and frame rates."""

from __future__ import annotations

import numpy as np
import pytest

from indexing.clip import Clip
from indexing.syncing.files import plan
from indexing.syncing.takes import find_cameras, take_of
from tests.indexing.syncing.scene import cut, write_openpose

# torch's own, when it first loads its transforms; hidden outside of tests
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated")


def test_cameras_are_found_and_named(tmp_path, cameras):
    one, two = (write_openpose(tmp_path / "pose" / f"cam0{i}_json", [cut(cameras[0], 0, 3)]) for i in (1, 2))
    assert list(find_cameras([one, two])) == ["cam01", "cam02"]
    assert find_cameras([tmp_path / "pose"]) == find_cameras([tmp_path]) == {"cam01": one, "cam02": two}
    (tmp_path / "videos").mkdir()
    for name in ("l.mp4", "r.MOV"):
        (tmp_path / "videos" / name).touch()
    assert list(find_cameras([tmp_path / "videos"])) == ["l", "r"]
    files = [tmp_path / name / "pose.json" for name in ("left", "right")]
    assert list(find_cameras(files)) == ["left", "right"]
    with pytest.raises(ValueError, match=r"cam01_json: given twice"):
        find_cameras([one, two, tmp_path / "pose" / ".." / "pose" / "cam01_json"])
    for paths in ([], [one]):
        with pytest.raises(ValueError, match=r"two are needed"):
            find_cameras(paths)


def test_frame_numbers_do_not_drift_from_rounded_times():
    joints = np.ones((300, 3, 2))
    take = take_of(Clip(joints, times=np.round(np.arange(300) / 30, 4)))  # steps of 0.0333 and 0.0334 s: 30.03 by their median
    assert take.fps == pytest.approx(30, rel=1e-5) and plan(take, 0.0, 1.0, take.fps).rest < 2e-4
    assert take_of(Clip(joints[::2], times=np.arange(0, 300, 2) / 29.97)).fps == pytest.approx(14.985)
