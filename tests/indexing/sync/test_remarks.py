"""What synchronize() says of recordings that are read without an error and still are not what they seem."""

from __future__ import annotations

import numpy as np
import pytest

from indexing import synchronize
from indexing.clip import Clip, ClipSet
from indexing.skeleton import Skeleton
from indexing.sync.people import common_joints
from indexing.sync.recordings import take_of
from tests.indexing.sync.scene import FPS, cut, moved, write_openpose

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated")
STRETCHED = "coordinates from 0 to 1, so the shape of the image is not known and people may be stretched; give size="


@pytest.mark.slow
def test_somebody_else_in_view_is_said_where_one_is_followed(cameras, tmp_path):
    small = cut(cameras[0], 0, 25)
    small = small.replace(joints=small.joints / 4 + 900.0)  # too short in view to be tried, and too long to be a ghost
    folder = write_openpose(tmp_path / "cam1_json", [cameras[0], small])
    said = "cam1: 2 people in view; compared is the largest; person= says otherwise"
    assert said in take_of(folder, fps=FPS).notes and said in take_of(folder, fps=FPS, person="largest").notes
    sure = take_of(folder, fps=FPS, person="confident").notes
    assert any("compared is the one that the detector trusts most" in note for note in sure)
    alone = write_openpose(tmp_path / "cam2_json", [cameras[0]])
    assert take_of(alone, fps=FPS).notes == take_of(alone, fps=FPS, person="largest").notes == ()
    both = take_of(write_openpose(tmp_path / "cam3_json", [cameras[0], moved(cameras[0], 900.0)]), fps=FPS)
    assert len(both.people) > 1 and not any("people in view" in note for note in both.notes)  # the pairing that is taken is said


def test_the_shape_of_the_image_is_not_known(cameras, tmp_path):
    a, b = ((clip.replace(joints=clip.joints / [1920, 1080], up="-y")) for clip in cameras[:2])
    found = synchronize(a, b)
    assert [one.text for one in found.notices if STRETCHED in one.text] == [f"{a.name}: {STRETCHED}", f"{b.name}: {STRETCHED}"]
    lens = (np.eye(3), np.zeros(5))
    with pytest.raises(ValueError, match=r"cam1: its coordinates go from 0 to 1, and calibration= is of pixels; give size="):
        synchronize(a, b, calibration=(lens, lens))
    ClipSet([a]).save(tmp_path / "a.npz")
    assert any(STRETCHED in note for note in take_of(tmp_path / "a.npz").notes)


def test_layouts_are_matched_by_what_joints_are_called_whatever_the_spelling(cameras):
    names = [f"{side}{part}" for part in ("Shoulder", "Elbow", "Wrist", "Hip", "Knee", "Ankle") for side in "LR"]
    other = [name for part in ("shoulder", "elbow", "wrist", "hip", "knee") for name in (f"right_{part}", f"left_{part}")]
    a = Clip(cameras[0].joints[:, :12], skeleton=Skeleton("short", tuple(names)))
    b = Clip(cameras[1].joints[:, :10], skeleton=Skeleton("long", tuple(other)))
    first, second, same, said = common_joints(a, b)
    assert same and said == "short and long share 10 joints; these are compared"
    assert first.skeleton == second.skeleton and first.skeleton.joints == tuple(names[:10])
    assert np.array_equal(first.joints, a.joints[:, :10], equal_nan=True)
    assert np.array_equal(second.joints, b.joints[:, [1, 0, 3, 2, 5, 4, 7, 6, 9, 8]], equal_nan=True)
    numbers = Skeleton("numbers", tuple(map(str, range(12))))
    assert common_joints(a, Clip(a.joints, skeleton=numbers))[2] is False


@pytest.mark.parametrize(("head", "row"), [("frame,x,y", "{i},"), ("time,x,y", "{t},"), ("frame,x,y,score", "{i},")])
def test_one_tracked_point_is_a_track(tmp_path, head, row):
    rng = np.random.default_rng(3)
    way = np.cumsum(np.cumsum(rng.normal(size=(420, 3)), axis=0) * 0.03, axis=0)
    way = 5 * (way - way.mean(axis=0)) / way.std() + [0, 0, 40]
    for name, turn, skip in (("a", 0.0, 0), ("b", 0.6, 24)):
        place = way @ np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]) + [
            0,
            0,
            40 * (turn > 0),
        ]
        seen = 1000 * place[:, :2] / place[:, 2:] + 500 + rng.normal(size=(420, 2)) * 0.3
        last = ",0.9" if "score" in head else ""
        lines = [f"{row.format(i=i, t=i / 30)}{x:.3f},{y:.3f}{last}" for i, (x, y) in enumerate(seen[skip : skip + 390])]
        (tmp_path / f"{name}.csv").write_text("\n".join([head, *lines]))
    takes = [take_of(tmp_path / f"{name}.csv", fps=30.0) for name in "ab"]
    assert [take.count for take in takes] == [390, 390] and [len(take.people) for take in takes] == [1, 1]
    found = synchronize(*takes, rate=1.0)
    assert found.frames == pytest.approx(-24, abs=0.5)


def test_frame_numbers_of_a_file_are_its_times(cameras, tmp_path):
    a, b = cameras[:2]
    kept = np.setdiff1d(np.arange(len(b)), np.arange(30, 50))
    np.savez(tmp_path / "b.npz", joints=b.joints[kept], frame=kept + 100, fps=FPS)
    take = take_of(tmp_path / "b.npz")
    assert np.allclose(take.times, (kept + 100) / FPS) and take.fps == pytest.approx(FPS)
    assert "b: 20 of" in take.notes[-1] and "frames are missing; the others keep their times" in take.notes[-1]
    found = synchronize(a, tmp_path / "b.npz")
    assert found.ok and found.offset == pytest.approx((100 - 12) / FPS, abs=0.5 / FPS)
