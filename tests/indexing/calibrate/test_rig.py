"""The files of a rig: read back by this package and by OpenCV's rules, all of them or none, nobody else's replaced."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace

import numpy as np
import pytest
import torch

from indexing import ActionIndexer, ClipSet
from indexing.calibrate.camera_views import make_view
from indexing.calibrate.rig import toml_of, write_associated
from indexing.readers import read
from indexing.sync.calibration import read_calibration
from indexing.sync.recordings import take_of
from tests.indexing.calibrate.scene import FPS, LATE, SIZE, filmed, rig, truth, write_cameras

BENT = torch.tensor([[-0.1, 0.02, 0.001, -0.002, 0.0], [-0.1, 0.02, 0.001, -0.002, 0.003], [0.0] * 5], dtype=torch.float64)


def projected(section, points):
    """By the pinhole of the file and the lens of Brown, written from OpenCV's page."""
    angle = np.linalg.norm(section["rotation"])
    x, y, z = np.array(section["rotation"]) / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    R = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    u = points @ R.T + section["translation"]
    u = u[..., :2] / u[..., 2:]
    k1, k2, p1, p2, k3 = (*section["distortions"], 0.0)[:5]
    r2 = np.square(u).sum(-1, keepdims=True)
    both = 2 * u[..., :1] * u[..., 1:]
    tangent = np.concatenate([p1 * both + p2 * (r2 + 2 * u[..., :1] ** 2), p1 * (r2 + 2 * u[..., 1:] ** 2) + p2 * both], axis=-1)
    u = u * (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) + tangent
    K = np.array(section["matrix"])
    return u @ K[:2, :2].T + K[:2, 2]


def test_the_calibration_file_says_what_the_rig_does(tmp_path):
    found = rig(distortion=BENT)
    path = found.save_cameras(tmp_path / "Calib.toml")
    content = tomllib.loads(path.read_text())
    assert list(content) == ["cam1", "cam2", "cam3", "metadata"] and content["metadata"]["units"] == "m"
    points = found.calibration.points[::20]
    images = found.calibration.project(points).numpy()
    for i, name in enumerate(("cam1", "cam2", "cam3")):
        assert np.abs(projected(content[name], points.numpy()) - images[i]).max() < 1e-6
        assert content[name]["fisheye"] is False and content[name]["size"] == [*map(float, SIZE)]
        assert len(content[name]["distortions"]) == (5 if i == 1 else 4)
    back = read_calibration(path)
    assert [lens.name for lens in back] == found.names and back[0].size == SIZE
    for lens, K, bent in zip(back, found.calibration.K, BENT, strict=True):
        assert torch.equal(lens.matrix, K) and torch.equal(lens.distortions, bent[: len(lens.distortions)])


def test_cameras_are_in_the_order_of_their_folders_whatever_they_are_called():
    found = rig()
    for view, name in zip(found.views, ("cam10", "cam2 “süd”", "metadata"), strict=True):
        object.__setattr__(view.take, "name", name)
    content = tomllib.loads(toml_of(found))
    assert list(content)[:3] == ["cam2 “süd”", "cam10", "metadata_camera"] and content["metadata_camera"]["name"] == "metadata"
    assert content["cam10"]["translation"] == pytest.approx(truth().t[0].tolist())


def test_the_movement_is_y_up_in_all_formats_and_learned_from(tmp_path):
    found = rig()
    for suffix in ("trc", "c3d", "npz"):
        found.save_people(tmp_path / f"p.{suffix}")
        clip = ClipSet.load(tmp_path / f"p.{suffix}")[0]
        world = truth().points[..., [1, 2, 0]]
        assert np.abs(clip.joints - world).max() < 1e-5 and clip.up == "y" and clip.meta["units"] == "m"
        assert np.allclose(clip.times, np.arange(110) / FPS, atol=1e-5)
    head = (tmp_path / "p.trc").read_text().splitlines()[2].split("\t")
    assert float(head[0]) == pytest.approx(FPS) and head[2:5] == ["110", "17", "m"]
    clip = ClipSet.load(tmp_path / "p.npz")[0]
    model = ActionIndexer(view="any").fit([clip.between(0.0, 1.7), clip.between(1.7, 3.6)], ["squat", "wave"])
    assert model.predict([filmed()[2][0].between(0.0, 0.9)]) == ["squat"]


def test_a_refused_rig_saves_nothing_and_an_unknown_scale_is_not_called_metres(tmp_path):
    found = rig(ok=False)
    for save in (lambda: found.save_cameras(tmp_path / "c.toml"), lambda: found.save_people(tmp_path / "p.trc"), found.check):
        with pytest.raises(
            ValueError, match="calibrate: cameras in a line: cam2 tells nothing new; move one of them, or give focal="
        ):
            save()
    assert list(tmp_path.iterdir()) == [] and "refused" in repr(found)
    found = rig(metric=False)
    found.save_people(tmp_path / "p.trc")
    found.save_cameras(tmp_path / "c.toml")
    assert "\tunknown\t" in (tmp_path / "p.trc").read_text() and 'units = "unknown"' in (tmp_path / "c.toml").read_text()
    assert "units" not in ClipSet.load(tmp_path / "p.trc")[0].meta and found.people[0].meta["units"] == "unknown"


def test_keypoint_files_on_one_clock_with_people_in_one_order(tmp_path):
    found = rig(people=2)
    gone = found.views[1]
    object.__setattr__(gone, "people", (gone.people[0], None))
    done = write_associated(tmp_path, found)
    assert {name: one["files"] for name, one in done.items()} == {"cam1": 110, "cam2": 98, "cam3": 85}
    assert all(one["rest"] < 1e-6 for one in done.values())
    for i, late in enumerate(LATE):
        folder = tmp_path / "pose-associated" / f"cam{i + 1}_json"
        first = json.loads((folder / f"cam{i + 1}_{late:06d}.json").read_text())["people"]
        assert len(list(folder.iterdir())) == 110 - late and [one["person_id"] for one in first] == [[0], [1]]
        for who, one in enumerate(first):
            table = np.array(one["pose_keypoints_2d"]).reshape(17, 3)
            clip = filmed(2)[i][who]
            expected = np.zeros((17, 3)) if (i, who) == (1, 1) else np.c_[clip.joints[0], np.ones(17)]
            assert np.allclose(table, expected)
    back = read(tmp_path / "pose-associated" / "cam3_json", fps=FPS, person="all")
    assert len(back) == 2 and back[0].times[0] == pytest.approx(25 / FPS)


@pytest.mark.slow
def test_files_of_the_input_keep_their_names(tmp_path):
    write_cameras(tmp_path)
    found = rig()
    takes = [take_of(tmp_path / name, fps=FPS) for name in found.names]
    (tmp_path / "out").mkdir()
    write_associated(tmp_path / "out", replace(found, views=[make_view(take, [take.people[0]], SIZE) for take in takes]))
    files = sorted(path.name for path in (tmp_path / "out" / "pose-associated" / "cam2_json").iterdir())
    assert files[0] == "cam2_000000000012_keypoints.json" and len(files) == 98
