"""``dyntorch reconstruct``: scenes whose truth is known from files to files, and what is refused and how."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch

from dyntorch import Segmentation, Status, metrics, scenes
from dyntorch.tasks.reconstruct import motions
from dyntorch.tasks.reconstruct.result import Reconstruction
from indexing.cli.flags.geometry import MotionName
from indexing.report.reconstruction import FILES, PURPOSE

TIMES = [0.0, 1.0, 2.5, 3.0]

COMMAND = "reconstruct"


def draw(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def table(path: Path, tracks: np.ndarray, times, static=None) -> Path:
    header = ["frame", "time", "id", *"xyz"[: tracks.shape[-1]], *(["static"] if static is not None else [])]
    lines = [",".join(header)]
    for i, time in enumerate(times):
        for j, place in enumerate(tracks[i]):
            if np.isfinite(place).all():
                mark = [str(int(static[j]))] if static is not None else []
                lines.append(",".join([str(10 * i), repr(float(time)), f"p{j}", *(f"{v:.6f}" for v in place), *mark]))
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="module")
def scene():
    return scenes.lifted_points("constant_velocity_2d", 50, times=TIMES, sigma=0.3, static=0.4, generator=draw(0))


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory, scene) -> Path:
    """``plane.csv`` with a column static, ``bare.csv`` without, ``parked.csv`` with static names, ``v0.csv ...`` per view."""
    folder = tmp_path_factory.mktemp("tracks")
    tracks, static = scene.tracks.numpy(), (scene.labels == 1).numpy()
    table(folder / "plane.csv", tracks, TIMES, static)
    table(folder / "bare.csv", tracks, TIMES)
    (folder / "parked.csv").write_text("\n".join(["id", *(f"p{j}" for j in np.flatnonzero(static))]))
    np.savez(folder / "plane.npz", tracks=tracks)
    for i, view in enumerate(tracks):
        (folder / f"v{i}.csv").write_text("\n".join(["x,y", *(f"{x:.6f},{y:.6f}" for x, y in view)]))
    return folder


def read(folder: str | Path = "out") -> dict:
    return json.loads((Path(folder) / "reconstruction.json").read_text())


# ---- what is found -------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_a_plane_from_a_table(run, scene):
    code, out, err = run("@/plane.csv --motion constant_velocity_2d --threshold none --out out/")
    assert (code, err) == (0, "") and "report: out/report.html" in out and "open: known up to an affinity" in out
    assert sorted(path.name for path in Path("out").iterdir()) == sorted(set(FILES) - {"tracks.csv"})
    found, arrays = read(), np.load("out/reconstruction.npz")
    assert found["status"] == "OK" and found["motion"] == "constant_velocity_2d" and found["times"] == TIMES
    assert found["residual"] < 0.45 and np.array(found["cameras"]).shape == (4, 3, 3) and found["threshold"] is None
    assert found["manifest"]["seed"] == 0 and len(found["manifest"]["inputs"]) == 1
    structure = torch.from_numpy(arrays["structure"])
    error = metrics.lifted_error(structure, scene.structure, scene.lifts)
    assert error.position < 0.03
    # x ~ P (X + t v), with what the files say
    assert str(arrays["status"]) == "OK" and arrays["ids"].tolist() == [f"p{j}" for j in range(50)]
    for i, time in enumerate(TIMES):
        rays = np.c_[arrays["points"] + time * arrays["velocities"], np.ones(50)] @ arrays["cameras"][i].T
        distance = np.linalg.norm(rays[:, :2] / rays[:, 2:] - arrays["tracks"][i], axis=1)
        np.testing.assert_allclose(distance, arrays["residuals"][i], atol=1e-6)
    with Path("out/points.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["id", "label", "name", "x", "y", "vx", "vy", "views", "rms"] and len(rows) == 50
    assert float(rows[7]["vx"]) == pytest.approx(arrays["velocities"][7, 0], rel=1e-6) and rows[7]["views"] == "4"
    assert not arrays["velocities"][(scene.labels == 1).numpy()].any()  # known to stand still
    page = Path("out/report.html").read_text()
    assert page.count("data:image/png;base64,") == 2 and "each at its own constant velocity" in page


@pytest.mark.slow
def test_a_calibration_makes_it_metric(run, data, tmp_path):
    """Numbers and a file with the same say the same; poses are written; what is no calibration is refused."""
    draw_ = draw(3)
    points, speed = torch.randn(30, 2, generator=draw_).double(), 0.1 * torch.randn(30, 2, generator=draw_).double()
    turn, _ = torch.linalg.qr(torch.eye(3).double() + 0.3 * torch.randn(4, 3, 3, generator=draw_).double())
    turn = turn * torch.linalg.det(turn)[:, None, None]
    place = points + torch.tensor(TIMES, dtype=torch.float64)[:, None, None] * speed
    seen = place @ turn[..., :2].mT + torch.tensor([0.1, -0.2, 7.0], dtype=torch.float64)
    image = 900 * seen[..., :2] / seen[..., 2:] + torch.tensor([320.0, 240.0])
    table(tmp_path / "metric.csv", image.numpy(), TIMES)
    inner = "[cam]\nmatrix = [[900, 0, 320], [0, 900, 240], [0, 0, 1]]\ndistortions = [0, 0, 0, 0]\n"
    (tmp_path / "lens.toml").write_text(inner)
    for given in ("900,900,320,240", str(tmp_path / "lens.toml")):
        line = f"{tmp_path}/metric.csv --motion constant_velocity_2d --threshold none --out out --calibration {given}"
        code, out, _ = run(line)
        assert code == 0 and "open: known up to a similarity of the plane" in out
        found, arrays = read(), np.load("out/reconstruction.npz")
        assert found["metric"] is True and np.array(found["rotations"]).shape == (4, 3, 3)
        lengths = np.linalg.norm(arrays["points"][:1] - arrays["points"][1:], axis=1)
        true = (points[:1] - points[1:]).norm(dim=1).numpy()
        np.testing.assert_allclose(lengths / lengths[0], true / true[0], rtol=1e-3)
    for wrong, says in (("900,900", "fx,fy,cx,cy"), ("900,-900,320,240", "fx,fy,cx,cy")):
        code, _, err = run(f"@/plane.csv --calibration {wrong}")
        assert code == 2 and says in err.lower()


@pytest.mark.slow
def test_the_same_from_other_files(run, scene):
    results = []
    for i, files in enumerate((
        "@/plane.csv",
        "@/bare.csv --static @/parked.csv",
        "@/v0.csv @/v1.csv @/v2.csv @/v3.csv --times 5,6,7.5,8",
        "@/plane.npz --times 0,1,2.5,3",
    )):  # fmt: skip
        code, out, _ = run(f"{files} --motion constant_velocity_2d --threshold none")
        assert code == 0 and ("time 0 of the result is the first view, at 5" in out) == (i == 2)
        assert ("no point is known to stand still" in out) == (i > 1)
        results.append(re.search(r"constant_velocity_2d +4 +50 .* ([\d.]+) +ok", out)[1])
    # known static points hold the cameras: another estimate of the noise (0.3), and the better one
    assert results[0] == results[1] and results[2] == results[3]
    assert abs(float(results[0]) - 0.3) < abs(float(results[2]) - 0.3) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "times", "says"),
    [
        ("--fps 10", [0, 1, 2, 3], ""),
        ("--frames 0,20,30", [0, 2.5, 3], ""),
        ("--frames 10,20,30", [0, 1.5, 2], "note: time 0 of the result is the first view, at 1"),
    ],
)
def test_times(run, options, times, says):
    code, out, _ = run(f"@/bare.csv --motion constant_velocity_2d --threshold none --out out {options}")
    assert code in (0, 3) and says in out
    assert read()["times"] == times


def test_numbers_of_frames_are_times_where_there_are_no_others(run):
    code, out, _ = run("@/plane.npz --motion constant_velocity_2d --threshold none")
    assert code in (0, 3) and "note: times are the numbers of the frames" in out


@pytest.mark.slow
def test_two_bodies(run, tmp_path):
    scene = scenes.lifted_points("two_bodies_3d", 60, views=4, sigma=0.3, generator=draw(1))
    table(tmp_path / "t.csv", scene.tracks.numpy(), range(4))
    assert run("t.csv --motion two_bodies_3d --threshold none --out out")[0] == 0
    labels = np.load("out/reconstruction.npz")["labels"]
    share = (labels == scene.labels.numpy()).mean()
    assert max(share, 1 - share) > 0.95 and "velocities" not in np.load("out/reconstruction.npz").files
    assert "are on body 1" in Path("out/report.html").read_text()


@pytest.mark.slow
def test_the_model_is_chosen_and_the_others_listed(run, tmp_path):
    scene = scenes.lifted_points("static_2d", 40, views=3, sigma=0.3, generator=draw(2))
    table(tmp_path / "t.csv", scene.tracks.numpy(), range(3))
    code, out, _ = run("t.csv --out out")
    assert code == 0 and re.search(r"static_2d +3 +40", out) and "penalized cost" in out
    tried = read()["candidates"]
    assert read()["counts"] == {"static": 40, "moving": 0, "outlier": 0, "missing": 0}
    assert "not tried: constant_acceleration_2d (needs 4 views)" in out
    assert tried[0]["motion"] == read()["motion"] == "static_2d" and "static_3d" in [one["motion"] for one in tried]
    assert "Which motion" in Path("out/report.html").read_text()


@pytest.mark.slow
def test_missing_observations_and_tracks_seen_once(run, scene, tmp_path):
    tracks = scene.tracks.numpy().copy()
    tracks[1, 3] = np.nan
    tracks[1:, 4] = np.nan
    table(tmp_path / "t.csv", tracks, TIMES)
    code, out, _ = run("t.csv --motion constant_velocity_2d --threshold none --out out")
    assert code == 0 and "note: 1 track is seen in fewer than 2 views and was left out" in out
    arrays = np.load("out/reconstruction.npz")
    assert "p4" not in arrays["ids"] and len(arrays["ids"]) == 49
    assert np.isnan(arrays["residuals"][1, 3]) and np.isfinite(arrays["points"]).all()


def test_times_of_day_are_counted_from_the_first_view_and_kept_in_full(run, scene, tmp_path):
    rows = ["time,id,x,y"]
    for time, view in zip(TIMES, scene.tracks.tolist(), strict=True):
        rows += [f"{1700000000.25 + 0.1 * time!r},p{j},{x!r},{y!r}" for j, (x, y) in enumerate(view)]
    (tmp_path / "t.csv").write_text("\n".join(rows))
    code, out, _ = run("t.csv --motion constant_velocity_2d --threshold none --out out")
    assert code in (0, 3) and "note: time 0 of the result is the first view, at 1700000000.25" in out
    assert read()["first_time"] == np.load("out/reconstruction.npz")["first_time"] == 1700000000.25
    assert read()["views"] == ["0", "0.1", "0.25", "0.3"]
    np.testing.assert_allclose(read()["times"], 0.1 * np.array(TIMES), atol=1e-6)


# ---- what is refused -----------------------------------------------------------------------------------------------------
def test_too_few_tracks_and_equal_images_are_refused(run, tmp_path, data):
    still = np.repeat(np.random.default_rng(0).uniform(0, 500, size=(1, 40, 2)), 4, axis=0)
    table(tmp_path / "t.csv", still, TIMES)
    code, _, err = run("t.csv --motion constant_velocity_2d --threshold none --out out")
    assert code == 3 and re.fullmatch(r"dyntorch: refused: [^\n]+\n", err)
    assert "Refused" in Path("out/report.html").read_text() and read()["status"] != "OK"
    rows = (data / "bare.csv").read_text().splitlines()
    (tmp_path / "t.csv").write_text("\n".join(row for row in rows if re.search(r",p\d,|id", row)))
    code, _, err = run("t.csv --motion constant_velocity_2d")
    assert code == 2 and "t.csv: 'constant_velocity_2d' needs at least 13 tracks through 3 views, got 10; add tracks" in err


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("", "no files; give a table of tracks with columns frame, id, x, y"),
        ("no.csv", "no.csv: no such file; check the path"),
        ("@/plane.csv --motion sideways", "sideways"),
        ("@/plane.csv --threshold 0", "--threshold must be a positive distance"),
        ("@/plane.csv --threshold x", "--threshold must be a positive distance in the unit of the tracks, auto or none, got x"),
        ("@/plane.csv --fps 0", "--fps must be a positive number"),
        ("@/plane.csv --fps 5 --times 0,1,2,3", "leave one out"),
        ("@/plane.csv --seed -1", "--seed must be a whole number"),
        ("@/plane.csv --times 0,1", "--times '0,1': 2 times for 4 views; give one finite number per view"),
        ("@/plane.csv --times 0,1,2,x", "expected numbers with commas between them"),
        ("@/plane.csv --times 1,1,1,1 --motion constant_velocity_2d", "all times are 0"),
        ("@/plane.csv --frames 0,5", "has no frame 5; its 4 frames are 0 to 30"),
        ("@/plane.csv --key cars", "--key cars: has no keys"),
        ("@/plane.csv --static no.csv", "no.csv: no such file"),
        ("@/plane.csv --frames 0,10 --motion constant_velocity_2d", "'constant_velocity_2d' needs at least 3 views, got 2"),
        ("@/plane.csv --motion constant_velocity_3d_sensors", "'constant_velocity_3d_sensors' takes tracks of 3D sensors"),
        ("@/v0.csv", "v0.csv: holds the points of one view"),
        ("@/plane.csv --out @/plane.csv", "is a file; choose another folder"),
    ],
)
def test_bad_input_is_one_line_and_code_2(refuse, line, says):
    refuse(line, says=(says,))


def test_every_model_and_status_is_named():
    assert set(get_args(MotionName)) == {*motions.MOTIONS, "auto"} and set(PURPOSE) == set(motions.MOTIONS)
    for result in (Reconstruction, Segmentation):
        assert set(result.REMEDIES) == set(Status) - {Status.OK}
