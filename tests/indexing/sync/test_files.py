"""Keypoint files on one clock."""

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
from indexing.sync.files import MOCAP_FOLDER, openpose_frames, plan, renumber, retime_mocap, write_poses
from indexing.sync.recordings import take_of
from indexing.writers import write
from tests.indexing.sync.scene import FPS, cut, moved, write_openpose

# torch's own, when it first loads its transforms; hidden outside of tests
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated")


def test_equal_numbers_are_equal_moments():
    take = take_of(np.ones((50, 3, 2)), fps=30.0)
    same = plan(take, -0.4, 1.0, 30.0)  # this camera began 0.4 s later: its frame 0 is the reference's frame 12
    assert same.numbers.tolist() == list(range(12, 62)) and same.shift == -12 and same.before == same.num_repeated == 0
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
    for name, number, renamed in (
        ("a1_000000000012_keypoints.json", 7, "a1_000000000007_keypoints.json"), ("cam01.99.json", 1234, "cam01.1234.json"),
        ("000.json", 5, "005.json"),
    ):  # fmt: skip
        assert renumber(name, number) == renamed  # names keep their form
    gone = cut(cameras[0], 0, 12).joints.copy()
    gone[:4] = np.nan  # frames without people are shifted as well
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


# Motion capture beside cameras: read from its files, on one clock with them, and written on the clock of the reference.


RECORDED = 100.0


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
    write([recorded.replace(joints=1000 * recorded.joints, meta={"units": "mm"})], folder / "vicon.c3d", "mm")
    write([recorded], folder / "vicon.trc", "m")
    write_openpose(folder / "cam1", [camera()])
    header = ["time", *(f"{name}_{axis}" for name in recorded.skeleton.joints for axis in "xyz")]
    rows = [[t, *one.ravel()] for t, one in zip(recorded.times, recorded.joints, strict=True)]
    (folder / "points.csv").write_text("\n".join([",".join(header), *(",".join(f"{v:.6f}" for v in row) for row in rows)]))
    return folder


def test_motion_capture_is_compared_with_keypoints(data):
    recorded, names = scene()[0], scene()[0].skeleton.joints
    order = np.random.default_rng(0).permutation(len(names))
    shuffled = recorded.replace(joints=recorded.joints[:, order], skeleton=Skeleton("markers", tuple(names[k] for k in order)))
    found = {what: synchronize(camera(), what) for what in (shuffled, *(data / f"vicon.{end}" for end in ("c3d", "trc")))}
    for what, one in found.items():
        assert one.ok and abs(one.offset - LATE / FPS) < 0.5 / FPS, what
        assert one.method == "camera" and one.projection is not None and one.fps[1] == pytest.approx(RECORDED)
    # joints of the same names are the same points in any order
    assert any(f"share {len(names)} joints" in note for note in found[shuffled].notes)
    turned = synchronize(recorded.joints, camera().joints, fps=(RECORDED, FPS))  # either may be the first, and arrays do
    assert turned.ok and abs(turned.offset + LATE / FPS) < 0.5 / FPS
    with pytest.raises(ValueError, match="vicon and vicon both hold points in space"):
        synchronize(data / "vicon.c3d", data / "vicon.trc")


@pytest.mark.slow
def test_markers_of_other_names_are_different_points():
    recorded = scene()[0]
    other = Skeleton("markers", tuple(f"M{k}" for k in range(recorded.joints.shape[1] - 1)))
    shift = synchronize(camera(), recorded.replace(joints=recorded.joints[:, 1:], skeleton=other))
    assert shift.method == "subspace" and any("compared as different points" in note for note in shift.notes)
    assert abs(shift.offset - LATE / FPS) < 2 / FPS  # squats, kicks and waves of one person may be too few to be sure of


@pytest.mark.slow
def test_the_command_writes_motion_capture_on_the_clock_of_the_camera(data, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["sync", str(data / "cam1"), str(data / "vicon.c3d"), "--fps", "30", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "mocap-sync/vicon.c3d, on the clock of cam1" in said and "pose-sync/ (cam1)" in said
    results = json.loads((out / "sync.json").read_text())
    offset = results["cameras"][1]["offset"]
    assert offset == pytest.approx(LATE / FPS, abs=0.5 / FPS)
    assert results["pairs"][0]["method"] == "camera" and np.shape(results["pairs"][0]["projection"]) == (3, 4)
    (moved,) = read(out / MOCAP_FOLDER / "vicon.c3d")
    first = round(offset * RECORDED)
    assert results["cameras"][1]["shifted"]["left_out"] == first and len(moved) == len(scene()[0]) - first
    assert moved.times[0] == 0 and moved.fps == pytest.approx(RECORDED)
    assert np.abs(moved.joints - scene()[0].joints[first:]).max() < 1e-5  # metres as read; nothing is interpolated
    # a run that writes none removes it
    assert main(["sync", str(data / "vicon.c3d"), str(data / "cam1"), "--fps", "30", "--out", str(out)]) == 0
    assert not (out / MOCAP_FOLDER).exists()
    assert "mocap-sync of an earlier run was removed" in capsys.readouterr().out
    frames = sorted((out / "pose-sync" / "cam1_json").iterdir())
    assert abs(int(frames[0].name.split("_")[1]) - LATE) <= 1  # frame k is at k / 30 s of the motion capture
    # a table of points in space is motion capture, too
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
