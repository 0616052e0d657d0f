"""``dyntorch align``: every model on files of a scene whose truth is known, what is written, and what is refused and how."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from dyntorch import Status, scenes
from dyntorch.core.outcome import Notice, NoticeCode
from dyntorch.tasks.align.result import Alignment
from indexing.readers.matches import Matched
from indexing.report.alignment import (
    FILES,
    AlignmentReport,
    as_segments,
    display_scale,
    figures,
    labels_csv,
    transform_points,
    turn_and_shift,
)
from indexing.report.summary import write_report
from tests.indexing.report.people import SCRIPT, draw_all

COMMAND = "align"


def draw(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def table(path: Path, values: np.ndarray, names: list[str] | None = None, header: str = "") -> Path:
    rows = values.reshape(len(values), -1)
    lines = [",".join([*([names[i]] if names else []), *(f"{v:.6f}" for v in row)]) for i, row in enumerate(rows)]
    path.write_text("\n".join([*([header] if header else []), *lines]) + "\n")
    return path


@pytest.fixture(scope="module")
def planar():
    return scenes.planar(n=90, sigma=0.5, static=0.35, outliers=0.1, generator=draw(0))


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory, planar) -> Path:
    """``a.csv, b.csv, c.csv`` of a plane, ``rigid.npz``, ``l1.csv, l2.csv`` with static points ``p1.csv, p2.csv``."""
    folder = tmp_path_factory.mktemp("align")
    names = [f"p{i}" for i in range(90)]
    for name, view in zip("abc", planar.views, strict=True):
        table(folder / f"{name}.csv", view.numpy(), names, "id,x,y")
    rigid = scenes.moving_points(60, sigma=0.01, static=0.3, outliers=0.1, sensors="rigid", generator=draw(1))
    np.savez(folder / "rigid.npz", **{f"P{i}": view.numpy() for i, view in enumerate(rigid.views, start=1)})
    np.save(folder / "truth.npy", rigid.motion[0].numpy())
    lines = scenes.translating_lines(60, sigma=0.002, static_points=6, generator=draw(2))
    for i in (1, 2):
        table(folder / f"l{i}.csv", lines.views[i - 1].numpy(), header="x1,y1,z1,x2,y2,z2")
        table(folder / f"p{i}.csv", lines.extras[f"points{i}"].numpy())
    np.save(folder / "line_truth.npy", lines.motion[0].numpy())
    return folder


def read(folder: str | Path = "out") -> dict:
    return json.loads((Path(folder) / "alignment.json").read_text())


# ---- what is found -------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_planar_from_csv(run, planar, tmp_path):
    code, out, err = run("@/a.csv @/b.csv @/c.csv --model planar --threshold 1.5 --out out/")
    assert (code, err) == (0, "")
    assert sorted(path.name for path in Path("out").iterdir()) == sorted(set(FILES) - {"tracks.csv"})
    found = read()
    assert found["status"] == "OK" and found["model"] == "planar" and found["threshold"] == 1.5
    for name, truth in zip("AB", planar.motion, strict=True):
        error = np.abs(np.array(found[name]) - truth.numpy())
        spread = np.array(found[f"{name}_deviation"])
        assert np.linalg.norm(error) < 0.02 and (error <= 6 * spread + 1e-9).all()  # the files have 6 decimals
    assert np.array(found["covariance"]).shape == (18, 18) and 0.3 < found["sigma"] < 0.7
    labels = np.array(found["labels"])
    assert (labels == planar.labels.numpy()).mean() > 0.85
    with Path("out/labels.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["id"] for row in rows] == found["ids"] == [f"p{i}" for i in range(90)]
    assert [int(row["label"]) for row in rows] == labels.tolist()
    assert {row["name"]: row["label"] for row in rows} == {"outlier": "0", "static": "1", "moving": "2"}
    assert sum(found["counts"].values()) == 90 and found["ambiguity"]
    assert found["manifest"]["seed"] == 0 and len(found["manifest"]["inputs"]) == 3
    counts = [str(found["counts"][name]) for name in ("static", "moving", "outlier", "missing")]
    assert ["90", *counts] in [line.split()[:5] for line in out.splitlines()] and "report: out/report.html" in out
    assert "A: view 2 to view 1" in out and "open: The collineations are unique" in out
    page = Path("out/report.html").read_text()
    assert page.count("data:image/png;base64,") == 1 and f"{counts[0]} stand still and {counts[1]} move" in page
    assert Path("out/alignment.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_the_model_follows_from_the_files_and_the_output_says_so(run, data):
    code, out, _ = run("@/rigid.npz --out out")
    assert code == 0 and "note: model rigid, because the files hold 3D points; if their scale" in out
    truth = np.load(data / "truth.npy")
    found = read()
    np.testing.assert_allclose(found["A"], truth / truth[3, 3], atol=0.03)
    assert found["threshold"] is None and 0.005 < found["sigma"] < 0.02
    assert "A turn by" in Path("out/report.html").read_text()


@pytest.mark.slow
def test_lines_with_static_points(run, data):
    code, out, _ = run("@/l1.csv @/l2.csv --model lines --threshold 0.006 --static-points @/p1.csv @/p2.csv --out out")
    assert code == 0 and "B: view 3" not in out
    truth = np.load(data / "line_truth.npy")
    assert np.linalg.norm(np.array(read()["A"]) - truth) < 0.05 and "B" not in read()


@pytest.mark.slow
def test_pluecker_lines(run, data, tmp_path):
    views = [np.loadtxt(data / f"l{i}.csv", delimiter=",", skiprows=1).reshape(-1, 2, 3) for i in (1, 2)]
    ends = [np.concatenate([view, np.ones((len(view), 2, 1))], axis=2) for view in views]
    pairs = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
    both = [np.stack([e[:, 0, i] * e[:, 1, j] - e[:, 0, j] * e[:, 1, i] for i, j in pairs], axis=1) for e in ends]
    np.savez(tmp_path / "m.npz", l1=both[0], l2=both[1])
    assert run("m.npz --threshold 0.012 --out out")[0] == 0
    assert np.linalg.norm(np.array(read()["A"]) - np.load(data / "line_truth.npy")) < 0.05
    segments = as_segments(both[0])
    across = np.cross(segments - views[0][:, :1], (views[0][:, 1] - views[0][:, 0])[:, None])
    assert np.abs(across).max() < 1e-6


@pytest.mark.slow
def test_rows_are_matched_by_name_and_missing_ones_said(run, data, tmp_path):
    rows = (data / "b.csv").read_text().splitlines()
    mixed = [rows[0], *reversed(rows[4:]), "p1,,7", "stranger,1,2"]  # p0 and p2 are absent, p1 is missing
    (tmp_path / "b.csv").write_text("\n".join(mixed) + "\n")
    code, out, _ = run("@/a.csv b.csv @/c.csv --threshold 3 --out out")
    assert code == 0 and "note: 3 names are not in every view and were left out: p0, p2, stranger" in out
    found = read()
    assert found["matches"] == 88 and found["counts"]["missing"] == 1 and found["status"] == "OK"
    assert "p1,0,missing" in Path("out/labels.csv").read_text().splitlines()
    assert run("@/a.csv @/b.csv @/c.csv --threshold 3 --out whole")[0] == 0
    assert np.abs(np.array(found["A"]) - np.array(read("whole")["A"])).max() < 0.01


def test_without_a_folder_nothing_is_written(run, tmp_path):
    code, out, _ = run("@/rigid.npz")
    assert code == 0 and "report" not in out and list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_calibration_tells_how_the_camera_moved_and_the_plane(run, tmp_path):
    """Numbers and a file with the same say the same; the page and the JSON have it."""
    side = torch.tensor([[0.8, 0.0], [0.0, 1.0], [0.6, 0.0]], dtype=torch.float64)
    normal = torch.tensor([-0.6, 0.0, 0.8], dtype=torch.float64)
    points = 0.3 * torch.randn(60, 2, generator=draw(5)).double()
    speed = 0.1 * torch.randn(60, 2, generator=draw(6)).double() * (torch.arange(60) > 20)[:, None]
    turns, shifts = [0.0, 0.1, -0.15], [[0.0, 0.0, 0.0], [0.1, -0.2, 0.1], [-0.2, 0.0, 0.15]]
    for name, pace, turn, shift in zip("abc", (0.0, 1.0, 1.7), turns, shifts, strict=True):
        c, s = np.cos(turn), np.sin(turn)
        camera = torch.tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]], dtype=torch.float64)
        place = normal + (points + pace * speed) @ side.mT
        seen = place @ camera.mT + torch.tensor(shift, dtype=torch.float64)
        table(tmp_path / f"{name}.csv", (900 * seen[:, :2] / seen[:, 2:] + torch.tensor([320.0, 240.0])).numpy())
    (tmp_path / "lens.toml").write_text("[cam]\nmatrix = [[900, 0, 320], [0, 900, 240], [0, 0, 1]]\ndistortions = [0, 0, 0, 0]\n")
    for given in ("900,900,320,240", "lens.toml"):
        code, out, err = run(f"a.csv b.csv c.csv --threshold 0.1 --out out --calibration {given}")
        assert (code, err) == (0, "") and re.search(r"view 2 +5\.73°  +0\.1 ", out) and "plane: normal (" in out
        found = read()
        np.testing.assert_allclose(found["normal"], normal.numpy(), atol=1e-5)
        np.testing.assert_allclose(found["translations"], shifts, atol=1e-5)
        assert np.shape(found["rotations"]) == (3, 3, 3) and found["other_motion"] is None
        assert "Camera against view 1" in Path("out/report.html").read_text()
    assert run("a.csv b.csv c.csv --threshold 0.1 --out plain")[0] == 0
    assert "rotations" not in read("plain") and np.allclose(read("plain")["A"], found["A"], atol=1e-9)


# ---- what is refused -----------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_data_that_cannot_decide_are_refused_with_code_3(run, tmp_path):
    equal = table(tmp_path / "e.csv", np.full((40, 2), 5.0))
    code, out, err = run(f"{equal} {equal} {equal} --model planar --out out")
    assert code == 3 and re.fullmatch(r"dyntorch: refused: [^\n]+; add matches[^\n]+\n", err)
    assert "degenerate" in out and "A: view" not in out
    found = read()
    assert found["status"] == "DEGENERATE" and "A" not in found and found["covariance"] is None and found["warnings"]
    assert found["reason"] and "Refused" in Path("out/report.html").read_text()
    assert sorted(path.name for path in Path("out").iterdir()) == sorted(set(FILES) - {"tracks.csv"})


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("", "no files; give a file of points for each view"),
        ("no.csv @/b.csv @/c.csv", "no.csv: no such file; check the path"),
        ("@/a.csv @/b.csv", "--model planar needs 3 views, got 2 views"),
        ("@/a.csv @/b.csv @/c.csv --model rigid", "a.csv: holds 2D points, --model rigid needs 3D points; use --model planar"),
        ("@/rigid.npz --model planar", "holds 3D points, --model planar needs 2D points; use --model rigid, join"),
        ("@/l1.csv @/l2.csv --model join", "l1.csv: holds lines, --model join needs 3D points; use --model lines"),
        ("@/a.csv @/l1.csv @/l2.csv", "holds lines, but"),
        ("@/p1.csv @/p2.csv @/a.csv --model rigid", "a.csv"),
        ("@/a.csv @/b.csv @/c.csv --model plane", "plane"),
        ("@/a.csv @/b.csv @/c.csv --threshold 0", "--threshold must be a positive distance"),
        ("@/a.csv @/b.csv @/c.csv --threshold x", "threshold"),
        ("@/a.csv @/b.csv @/c.csv --seed -1", "--seed must be a whole number"),
        ("@/a.csv @/b.csv @/c.csv --motion constant_velocity", "--motion constant_velocity belongs to --model rigid"),
        ("@/a.csv @/b.csv @/c.csv --calibration 900,900", "expected fx,fy,cx,cy"),
        ("@/rigid.npz --calibration 900,900,320,240", "--calibration is of cameras, and --model rigid of 3D sensors"),
        ("@/rigid.npz --frames 1,x,3", "--frames '1,x,3': expected whole numbers"),
        ("@/rigid.npz --frames 1,2,3", "an .npz has no frames"),
        ("@/a.csv @/b.csv @/c.csv --static-points @/p1.csv", "static points are for lines"),
        ("@/a.csv @/b.csv @/c.csv --out @/a.csv", "is a file; choose another folder"),
    ],
)
def test_bad_input_is_one_line_and_code_2(refuse, line, says):
    refuse(line, says=(says,))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda rows: rows[:6], "a.csv, b.csv, c.csv: align_planar needs at least 26 matches, got 5"),
        (lambda rows: [row.partition(",")[2] for row in rows][:-1], "b.csv: has 90 rows, "),
        (lambda rows: ["id,u,v", *rows[1:]], "a.csv: its columns are id, u, v"),
        (lambda rows: [*rows[:7], "p6,12,abc", *rows[8:]], "a.csv: row 8, column 'y': 'abc' is not a number"),
        (lambda rows: [rows[0], *(f"q{row}" for row in rows[1:])], "a.csv: no name is in all of"),
        (lambda rows: [], "a.csv: the file is empty"),
    ],
)
def test_bad_files_are_one_line_and_code_2(run, data, tmp_path, change, says):
    for name in "abc":
        rows = (data / f"{name}.csv").read_text().splitlines()
        rows = change(rows) if name == "a" else rows
        (tmp_path / f"{name}.csv").write_text("\n".join(rows))
    code, out, err = run("a.csv b.csv c.csv --model planar --out out")
    assert (code, out) == (2, "") and not Path("out").exists()
    assert err.startswith("dyntorch: ") and err.count("\n") == 1 and says in err


# ---- the report ----------------------------------------------------------------------------------------------------------
class Hostile(NoticeCode):
    TOLD = "hostile", SCRIPT


def report(**changes) -> AlignmentReport:
    points = np.array([[0.0, 0.0], [3.0, 1.0], [1.0, 2.0], [np.nan, 1.0]])
    matched = Matched(
        tuple(changes.pop("views", [points] * 3)), tuple(changes.pop("ids", [SCRIPT, "=1+1", "-2", "d"])), (SCRIPT, "b", "c")
    )
    values = {
        "A": np.eye(3), "B": np.eye(3), "labels": np.array([1, 1, 2, 0]), "status": np.array(0), "sigma": np.array(0.1),
        "covariance": np.eye(18) * 1e-8, "unverified": None,
    }  # fmt: skip
    tensors = {name: None if value is None else torch.as_tensor(value) for name, value in {**values, **changes}.items()}
    found = Alignment(**tensors, ambiguity="", notices=(Notice(Hostile.TOLD),))
    return AlignmentReport(result=found, read=matched, model="planar", heading=SCRIPT)


def test_what_comes_from_files_is_escaped(tmp_path):
    page = write_report(tmp_path, report()).read_text()
    assert SCRIPT not in page and "&lt;script&gt;" in page
    assert labels_csv(report()).splitlines() == [
        "id,label,name", f"{SCRIPT},1,static", "'=1+1,1,static", "-2,2,moving", "d,0,missing",
    ]  # fmt: skip


@pytest.mark.slow
def test_every_kind_of_data_can_be_drawn(tmp_path):
    lines = np.random.default_rng(0).normal(size=(5, 2, 3))
    changes = [
        {"status": Status.DEGENERATE, "A": np.zeros((3, 3)), "B": np.zeros((3, 3))},
        {"views": [np.full((4, 2), np.nan)] * 3, "labels": np.zeros(4, dtype=int)},
        {"views": [np.full((4, 2), 1e9)] * 3},
        {"views": [lines, lines], "labels": np.array([0, 1, 2, 2, 1]), "ids": list("abcde"),
         "A": np.eye(4), "B": None, "covariance": np.eye(16)},
        {"unverified": np.array([False, False, True, False])},
        {"A": np.diag([1.0, 1.0, 0.0])},
        {"covariance": np.full((18, 18), np.inf)},
    ]  # fmt: skip
    draw_all((report(**each) for each in changes), tmp_path, "alignment.json")


def test_display_scale_and_small_numbers_of_the_page():
    rng = np.random.default_rng(1)
    matrix = rng.normal(size=(3, 3))
    root = rng.normal(size=(9, 9)) * 1e-4
    shown, spread, scaled = display_scale(matrix, root @ root.T)
    assert scaled and shown[2, 2] == 1 and spread[2, 2] == 0
    draws = matrix.ravel() + rng.normal(size=(40000, 9)) @ root.T
    np.testing.assert_allclose((draws / draws[:, -1:]).std(axis=0).reshape(3, 3)[:2], spread[:2], rtol=0.03)
    assert not display_scale(np.diag([1.0, 1.0, 0.0]), np.eye(9))[2]
    angle = np.radians(170)
    motion = np.eye(4)
    motion[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    motion[:3, 3] = 1, 2, 3
    turn, shift = turn_and_shift(2 * motion)
    assert abs(turn - 170) < 1e-9 and shift.tolist() == [1, 2, 3]
    np.testing.assert_allclose(transform_points(motion, np.array([[1.0, 0, 0]])), [[1 + np.cos(angle), 2 + np.sin(angle), 3]])
    assert figures(1.0, float("inf")) == ("1", "") and figures(0.0, 1e-9)[1] == "1.0e-09"
    assert figures(123456.0, 2345.0) == ("123456", "2345")
