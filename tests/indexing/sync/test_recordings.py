"""What one camera recorded: cameras in folders, their names and frame rates."""

from __future__ import annotations

import numpy as np
import pytest

from indexing.clip import Clip
from indexing.readers.recording import link_by_position
from indexing.sync.files import plan
from indexing.sync.recordings import find_cameras, take_of
from tests.indexing.sync.scene import cut, write_openpose

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
    for fps in (1e-300, 1e300, 0.0, -30.0, float("nan")):  # no camera has it
        with pytest.raises(ValueError, match="fps must be"):
            take_of(joints, fps=fps)


# ---- gaps, and points ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("gap", [864000.0, 1e9, 1e12])
def test_of_a_take_that_is_nearly_all_gap_the_longest_stretch_is_compared(cameras, gap):
    kept = len(cameras[1]) - 20
    jump = np.arange(kept + 20) >= kept
    torn, paused = (cameras[1].replace(times=cameras[1].times + late * jump, fps=None, name="cam2") for late in (gap, 120.0))
    take = take_of(torn, name="cam2")
    assert take.count == len(torn) and [len(clip) for clip in take.people] == [kept]
    assert f"cam2: nearly all gap: only its {kept} frames from 0 to {torn.times[kept - 1]:.6g} s are compared" in take.notes
    found = plan(take, 0.0, 1.0, 30.0)  # what is written are all frames, as many as there are
    assert len(found.numbers) == len(torn) and found.rest < 1e-3
    pause = take_of(paused, name="cam2")  # is no gap of a take
    assert [len(clip) for clip in pause.people] == [len(paused)] and pause.notes == ()


def test_a_tracked_point_is_one_and_points_that_are_told_apart_stay_two(tmp_path):
    places = np.cumsum(np.random.default_rng(0).normal(scale=40.0, size=(60, 2)), axis=0)
    head = ["scorer,me,me,me", "bodyparts,ball,ball,ball", "coords,x,y,likelihood"]
    rows = [f"{i},{x:.3f},{y:.3f},1.0" for i, (x, y) in enumerate(places) if i != 30]
    (tmp_path / "ballDLC_resnet50.csv").write_text("\n".join([*head, *rows]) + "\n")
    take = take_of(tmp_path / "ballDLC_resnet50.csv", fps=30.0)
    assert [len(clip) for clip in take.people] == [59] and take.count == 59
    t = np.arange(40)
    one, two = np.stack([4.0 * t, 0.0 * t], 1), np.stack([160 - 4.0 * t, 0.0 * t + 90], 1)
    assert link_by_position(np.repeat(t, 2), np.stack([one, two], 1).reshape(80, 1, 2)).tolist() == [0, 1] * 40
