"""Motion capture beside cameras: read from its files, on one clock with them, and written on the clock of the reference."""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from indexing import synchronize
from indexing.actors import Person, detect, stream
from indexing.cli import main
from indexing.clip import Clip
from indexing.readers import read
from indexing.skeleton import Skeleton
from indexing.sync.files import MOCAP_FOLDER, retime_mocap
from indexing.sync.recordings import take_of
from indexing.writers import write
from tests.indexing.sync.scene import write_openpose

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated")

FPS, RECORDED = 30.0, 100.0
LATE = 25  # frames that the cameras start after the motion capture


@lru_cache
def scene() -> tuple[Clip, Clip]:
    """A person in space at 100 Hz, z up, and at the frames of the cameras."""
    moving, _ = stream(("squat", "kick", "wave"), Person.random(3), fps=FPS, rng=3)
    times = np.arange(int(moving.times[-1] * RECORDED)) / RECORDED
    joints = np.stack([np.interp(times, moving.times, row) for row in moving.joints.reshape(len(moving), -1).T], axis=1)
    joints = joints.reshape(len(times), *moving.joints.shape[1:])[..., [2, 0, 1]]
    recorded = Clip(joints, fps=RECORDED, name="vicon", skeleton=moving.skeleton, meta={"units": "m"})
    return recorded, moving


@lru_cache
def camera(azimuth: float = 30.0) -> Clip:
    seen = detect(scene()[1], azimuth=azimuth, rng=7)
    joints = seen.joints[LATE : LATE + 150]
    confidence = None if seen.confidence is None else seen.confidence[LATE : LATE + 150]
    return seen.replace(joints=joints, times=np.arange(len(joints)) / FPS, confidence=confidence, name="cam1")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mocap")
    recorded = scene()[0]
    millimetres = recorded.replace(joints=1000 * recorded.joints, meta={"units": "mm"})
    write([millimetres], folder / "vicon.c3d", "mm")
    write([recorded], folder / "vicon.trc", "m")
    write_openpose(folder / "cam1", [camera()])
    header = ["time", *(f"{name}_{axis}" for name in recorded.skeleton.joints for axis in "xyz")]
    rows = [[t, *one.ravel()] for t, one in zip(recorded.times, recorded.joints, strict=True)]
    (folder / "points.csv").write_text("\n".join([",".join(header), *(",".join(f"{v:.6f}" for v in row) for row in rows)]))
    return folder


def assert_found(shift, sign=1, within=0.5):
    assert shift.ok, shift.reason
    assert abs(sign * shift.offset - LATE / FPS) < within / FPS


@pytest.mark.parametrize("name", ["vicon.c3d", "vicon.trc", "points.csv"])
def test_files_of_motion_capture_are_compared_with_keypoints(data, name):
    shift = synchronize(camera(), data / name)
    assert_found(shift)
    assert shift.method == "camera" and shift.projection is not None and shift.fps[1] == pytest.approx(RECORDED)


def test_joints_of_the_same_names_are_the_same_points_in_any_order():
    recorded, seen = scene()[0], camera()
    names = recorded.skeleton.joints
    order = np.random.default_rng(0).permutation(len(names))
    shuffled = recorded.replace(joints=recorded.joints[:, order], skeleton=Skeleton("markers", tuple(names[k] for k in order)))
    shift = synchronize(seen, shuffled)
    assert_found(shift)
    assert shift.method == "camera" and any(f"share {len(names)} joints" in note for note in shift.notes)


@pytest.mark.slow
def test_markers_of_other_names_are_different_points():
    recorded = scene()[0]
    other = Skeleton("markers", tuple(f"M{k}" for k in range(recorded.joints.shape[1] - 1)))
    shift = synchronize(camera(), recorded.replace(joints=recorded.joints[:, 1:], skeleton=other))
    assert shift.method == "subspace" and any("compared as different points" in note for note in shift.notes)
    assert abs(shift.offset - LATE / FPS) < 2 / FPS  # squats, kicks and waves of one person may be too few to be sure of


def test_either_may_be_the_first_and_arrays_do():
    assert_found(synchronize(scene()[0].joints, camera().joints, fps=(RECORDED, FPS)), sign=-1)


def test_two_motion_captures_are_no_cameras(data):
    with pytest.raises(ValueError, match="vicon and vicon both hold points in space"):
        synchronize(data / "vicon.c3d", data / "vicon.trc")


@pytest.mark.slow
def test_the_command_writes_motion_capture_on_the_clock_of_the_camera(data, tmp_path, capsys):
    assert main(["sync", str(data / "cam1"), str(data / "vicon.c3d"), "--fps", "30", "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert "mocap-sync/vicon.c3d, on the clock of cam1" in said and "pose-sync/ (cam1)" in said
    results = json.loads((tmp_path / "out" / "sync.json").read_text())
    offset = results["cameras"][1]["offset"]
    assert offset == pytest.approx(LATE / FPS, abs=0.5 / FPS)
    assert results["pairs"][0]["method"] == "camera" and np.shape(results["pairs"][0]["projection"]) == (3, 4)
    (moved,) = read(tmp_path / "out" / MOCAP_FOLDER / "vicon.c3d")
    first = round(offset * RECORDED)
    assert results["cameras"][1]["shifted"]["left_out"] == first and len(moved) == len(scene()[0]) - first
    assert moved.times[0] == 0 and moved.fps == pytest.approx(RECORDED)
    assert np.abs(moved.joints - scene()[0].joints[first:]).max() < 1e-5  # metres as read; nothing is interpolated
    # a run that writes none removes it
    assert main(["sync", str(data / "vicon.c3d"), str(data / "cam1"), "--fps", "30", "--out", str(tmp_path / "out")]) == 0
    assert not (tmp_path / "out" / MOCAP_FOLDER).exists()
    assert "mocap-sync of an earlier run was removed" in capsys.readouterr().out
    frames = sorted((tmp_path / "out" / "pose-sync" / "cam1_json").iterdir())
    assert abs(int(frames[0].name.split("_")[1]) - LATE) <= 1  # frame k is at k / 30 s of the motion capture


@pytest.mark.slow
def test_a_table_of_points_in_space_is_motion_capture(data, tmp_path):
    out = tmp_path / "out"
    assert main(["sync", str(data / "cam1"), str(data / "points.csv"), "--fps", "30", "--out", str(out)]) == 0
    results = json.loads((out / "sync.json").read_text())
    assert results["pairs"][0]["method"] == "camera"
    assert results["cameras"][1]["offset"] == pytest.approx(LATE / FPS, abs=0.5 / FPS)
    assert read(out / MOCAP_FOLDER / "points.trc")[0].dims == 3


def test_what_is_in_the_way_and_two_of_them_are_said_before_the_work(data, tmp_path, capsys):
    foreign = tmp_path / "out" / MOCAP_FOLDER
    foreign.mkdir(parents=True)
    arguments = ["sync", str(data / "cam1"), str(data / "vicon.c3d"), "--fps", "30"]
    assert main([*arguments, "--out", str(tmp_path / "out")]) == 2
    assert "mocap-sync: is there, and not from this command" in capsys.readouterr().err
    assert main(["sync", str(data / "vicon.trc"), *arguments[1:]]) == 2
    assert "are both motion capture; give one, and cameras" in capsys.readouterr().err


@pytest.mark.parametrize("suffix", ["c3d", "trc"])
def test_times_on_the_clock_of_the_reference(tmp_path, suffix):
    path = tmp_path / f"vicon.{suffix}"
    write([scene()[0]], path, "m")
    one = retime_mocap(take_of(path), offset=0.5037, rate=1.001)
    times = one.people[0].times
    assert one.first == 50 and one.frames == len(times) and one.rest == pytest.approx(0.0037 / 1.001 if suffix == "c3d" else 0)
    assert np.diff(times) == pytest.approx(0.01 / 1.001)
    assert times[0] == pytest.approx(0.0 if suffix == "c3d" else (0.5 - 0.5037) / 1.001)
    assert retime_mocap(take_of(path), offset=1e3, rate=1.0) is None
