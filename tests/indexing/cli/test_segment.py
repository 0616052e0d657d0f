"""``dyntorch segment``: scenes whose truth is known from files to files, and what is refused and how."""

from __future__ import annotations

import csv
import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch

import dyntorch
from dyntorch import scenes
from dyntorch.numerics import Message
from dyntorch.tasks.segment.result import Segmentation
from indexing.report.segmentation import FILES

COMMAND = "segment"
FOCAL = 800.0


@pytest.fixture(scope="module")
def scene():
    """x1, x2, labels and fundamentals of two bodies and wrong matches, of which the fourth is missing."""
    made = scenes.bodies((72, 48), sigma=0.2, outliers=1 / 6, generator=torch.Generator().manual_seed(0))
    x1, x2 = (view.numpy() for view in made.views)
    x1[3] = np.nan
    return x1, x2, made.labels.numpy(), torch.stack(made.motion).numpy()


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory, scene) -> Path:
    """The scene as ``m.npz`` with labels, ``several.npz``, ``m.npy``, ``m.csv`` with a header, ``bare.csv`` and ``bare.txt``
    without; ``left.png``, ``right.jpg``."""
    from PIL import Image

    folder = tmp_path_factory.mktemp("matches")
    x1, x2, labels, _ = scene
    np.savez(folder / "m.npz", x1=x1, x2=x2, label=labels.astype(np.uint8), wh=[640, 480])
    np.savez(
        folder / "several.npz", **{"desk/x1": x1[:, None], "desk/x2": x2, "desk/label": labels, "shelf/x1": x1, "names": ["desk"]}
    )
    np.save(folder / "m.npy", np.hstack([x1, x2]))
    rows = [",".join("" if np.isnan(v) else repr(float(v)) for v in row) for row in np.hstack([x1, x2])]
    (folder / "bare.csv").write_text("\n".join(rows))
    named = [f"p{i},{row},{label},1" for i, (row, label) in enumerate(zip(rows, labels, strict=True))]
    (folder / "m.csv").write_text("\n".join(["ID,x1,y1,x2,y2,label,weight", *named]))
    np.savetxt(folder / "bare.txt", np.hstack([x1, x2]), header="x1 y1 x2 y2")
    gray = np.random.default_rng(0).integers(0, 255, size=(480, 640), dtype=np.uint8)
    Image.fromarray(gray).save(folder / "left.png")
    Image.fromarray(gray).convert("RGB").save(folder / "right.jpg")
    Image.fromarray(gray[:200, :200]).save(folder / "small.png")
    return folder


@pytest.fixture
def solved(monkeypatch, scene):
    """The library's answer, known: two matches of body 1 called outliers, body 2 a homography.  Records how it was asked."""
    _, _, truth, fundamentals = scene
    asked: dict = {}

    def segment(x1, x2, **options):
        asked.update(options, x1=x1, x2=x2)
        seen = torch.isfinite(torch.cat([x1, x2], -1)).all(-1)
        labels = torch.where(seen, torch.from_numpy(truth)[: len(x1)], 0)
        labels[torch.nonzero(labels == 1)[:2]] = 0
        probabilities = 0.9 * torch.eye(3, dtype=torch.float64)[labels] + 0.1 / 3
        homographies = torch.zeros(2, 3, 3, dtype=torch.float64)
        homographies[1] = torch.eye(3) / 3**0.5
        residuals = torch.where(labels == 0, 9.0, 0.25 * labels).double()
        limit = torch.tensor(float(options["threshold"] or 1.5))
        return Segmentation(
            labels=labels, bodies=torch.tensor(2), homographies=homographies, planar=torch.tensor([False, True]),
            probabilities=probabilities * seen[:, None], residuals=residuals, threshold=limit,
            fundamentals=torch.from_numpy(fundamentals), coherence=torch.ones(len(x1)), status=torch.tensor(0),
        )  # fmt: skip

    monkeypatch.setattr(dyntorch, "segment", segment, raising=False)
    return asked


def read(folder: str | Path = "out") -> dict:
    return json.loads((Path(folder) / "segmentation.json").read_text())


# ---- what is found -------------------------------------------------------------------------------------------------------
def test_an_archive_with_labels(run, solved, scene):
    x1, _, truth, fundamentals = scene
    code, out, err = run("@/m.npz --out out/")
    assert (code, err) == (0, "") and "report: out/report.html" in out
    assert sorted(path.name for path in Path("out").iterdir()) == sorted(set(FILES) - {"tracks.csv"})
    assert re.search(r"body 1 +58 +48\.7 % +fundamental +0\.25", out) and re.search(r"body 2 +39 +32\.8 % +homography +0\.5", out)
    assert "outliers" in out and "misclassified: 1.68 %" in out and "note: 1 match lacks a coordinate and was left out" in out
    assert solved["bodies"] is None and solved["threshold"] == 2.5 and solved["spatial"] and solved["weights"] is None
    found, arrays = read(), np.load("out/segmentation.npz")
    assert found["status"] == "OK" and found["counts"] == {"body 1": 58, "body 2": 39, "outlier": 22, "missing": 1}
    assert found["misclassified"] == pytest.approx(2 / 119) and found["manifest"]["seed"] == 0
    assert [part["model"] for part in found["bodies"]] == ["fundamental", "homography"] and found["bodies"][0]["homography"] is None
    assert len(found["manifest"]["inputs"]) == 1 and found["threshold"] == 2.5
    np.testing.assert_array_equal(arrays["fundamentals"], fundamentals)
    np.testing.assert_array_equal(arrays["known"], truth)
    assert arrays["models"].tolist() == ["fundamental", "homography"] and str(arrays["status"]) == "OK"
    with Path("out/labels.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["id", "x1", "y1", "x2", "y2", "label", "name", "probability", "residual"] and len(rows) == 120
    assert rows[3] == {**rows[3], "id": "4", "x1": "", "label": "0", "name": "missing", "probability": "", "residual": ""}
    assert [int(row["label"]) for row in rows] == arrays["labels"].tolist()
    assert float(rows[0]["x1"]) == pytest.approx(x1[0, 0]) and float(rows[0]["probability"]) == pytest.approx(0.9333, abs=1e-4)
    page = Path("out/report.html").read_text()
    assert page.count("data:image/png;base64,") == 1 and "Compared with the labels of the file" in page and "1.7 %" in page


def test_the_same_from_other_files(run, solved):
    tables = []
    for files in ("@/m.npz", "@/several.npz --pair desk", "@/m.npy", "@/m.csv", "@/bare.csv", "@/bare.txt"):
        code, out, err = run(files)
        assert (code, err) == (0, "")
        assert ("misclassified" in out) == any(name in files for name in ("m.npz", "several", "m.csv"))
        tables.append(out.split("misclassified")[0].split("note")[0])
        assert (solved["weights"] is not None) == (files == "@/m.csv")
    assert len(set(tables)) == 1


def test_flags_reach_the_library(run, solved):
    code, out, _ = run("@/m.npz --bodies 3 --threshold auto --no-spatial --seed 7")
    assert code == 0 and "note: --bodies asks for 3, the matches carry 2" in out
    assert solved["bodies"] == 3 and solved["threshold"] is None and not solved["spatial"]
    assert solved["generator"].initial_seed() == 7 and solved["x1"].dtype == torch.float64


@pytest.mark.slow
def test_on_photographs(run, solved):
    code, out, _ = run("@/m.npz --images @/left.png @/right.jpg --out out --title Desk")
    assert code == 0 and "lie outside" not in out and "<h1>Desk</h1>" in Path("out/report.html").read_text()
    assert len(read()["manifest"]["inputs"]) == 3
    code, out, _ = run("@/m.npz --images @/small.png @/right.jpg")
    assert code == 0 and re.search(r"note: \d+ of 119 matches lie outside of small\.png \(200 by 200\); give the images", out)


def test_points_that_are_hardly_pixels_or_outside_of_the_size_are_mentioned(run, solved, scene):
    np.savez("unit.npz", x1=scene[0] / FOCAL, x2=scene[1] / FOCAL)
    assert "if they are not in pixels, give --threshold in their unit, or auto" in run("unit.npz --threshold 0.05")[1]
    assert "pixels" not in run("unit.npz --threshold 0.005")[1]
    code, out, err = run("unit.npz --out out")  # the default is larger than the image
    assert (code, out) == (2, "") and err.startswith("dyntorch: unit.npz: the points lie within ") and not Path("out").exists()
    assert err.endswith(" and --threshold is 2.5: give --threshold in the unit of the points, or --threshold auto\n")
    assert "lie outside" not in run("@/m.csv --size 640 480")[1] + run("@/m.npz")[1]
    swapped = [x[:, ::-1] for x in scene[:2]]
    np.savez("swapped.npz", x1=swapped[0], x2=swapped[1], wh=[640, 480])
    out = run("swapped.npz")[1]
    assert re.search(r"note: \d+ of 119 matches lie outside of image 1 \(640 by 480\); give the size of the images in", out)
    assert "in their order, and x before y" in out and "outside of image 2 (640" in out


@pytest.mark.skipif("segment" not in dyntorch.__all__, reason="the library has no segment")
def test_the_library_itself(run):
    code, out, _ = run("@/m.npz --bodies 2 --out out")
    assert code == 0 and read()["misclassified"] < 0.06 and "body 2" in out


# ---- what is refused -----------------------------------------------------------------------------------------------------
def test_data_that_cannot_decide_are_refused_with_code_3(run, solved, monkeypatch):
    solve = dyntorch.segment

    def nothing(x1, x2, **options):
        found = solve(x1, x2, **options)
        zero = torch.zeros(0, 3, 3)
        return dataclasses.replace(
            found, labels=0 * found.labels, bodies=torch.tensor(0), fundamentals=zero, homographies=zero,
            planar=torch.zeros(0, dtype=torch.bool),
            probabilities=found.probabilities[:, :1], residuals=0 * found.residuals,
        )  # fmt: skip

    monkeypatch.setattr(dyntorch, "segment", nothing)
    code, out, err = run("@/m.npz --out out")
    reason = "no body moves so that enough of the matches agree; raise --threshold, or clean the matches"
    assert (code, err) == (3, f"dyntorch: refused: {reason}\n")
    assert re.search(r"unlabelled +119", out)
    assert read()["status"] == "NO_CONSENSUS" and read()["bodies"] == [] and read()["misclassified"] is None
    page = Path("out/report.html").read_text()
    assert "do not decide" in page and "How each body moved" not in page and "Refused." in page


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("", "no input; give a video, a file of tracks, or a file of matches with x1, x2"),
        ("no.npz", "no.npz: no such file; check the path"),
        ("@/", "small.png: has 200 x 200 pixels, left.png 640 x 480; pictures of one sequence"),
        ("@/left.png", "left.png: has 1 frame, and motion needs at least 2"),
        ("@/m.npz --bodies 0", "--bodies must be a whole number from 1, or auto, got 0"),
        ("@/m.npz --bodies two", "see dyntorch segment --help"),
        ("@/m.npz --threshold 0", "--threshold must be a positive distance in pixels or auto, got 0"),
        ("@/m.npz --seed -1", "--seed must be a whole number"),
        ("@/m.npz --size 0 480", "--size must be width and height in pixels"),
        ("@/m.npz --size 640 480 --images @/left.png @/right.jpg", "--size and --images both say"),
        ("@/m.npz --images @/left.png", "--images: 1 is given, and matches are drawn on two; give both images"),
        ("@/m.npz --images", "--images: its value is missing"),
        ("@/m.npz @/m.csv", "2 files; give one file of tracks or of matches, or pictures alone"),
        ("@/m.npz --key desk", "m.npz: has no array 'desk'"),
        ("@/m.npz --every 2", "--every 2: it is for a video"),
        ("@/m.npz --images @/left.png no.png", "no.png: no such file; give an image"),
        ("@/m.npz --images @/m.csv @/left.png", "m.csv: cannot be read as an image"),
        ("@/m.npz --pair desk", "m.npz: has no pair 'desk'; it holds one pair: leave --pair out"),
        ("@/m.csv --pair desk", "m.csv: --pair desk: holds one pair; leave --pair out"),
        ("@/several.npz", "several.npz: holds 2 pairs (desk, shelf); say which: --pair desk"),
        ("@/several.npz --pair chair", "several.npz: has no pair 'chair'; its pairs are desk, shelf"),
        ("@/several.npz --pair shelf", "several.npz: has no shelf/x2 (its arrays are desk/x1"),
        ("@/m.npz --out @/m.npz", "is a file; choose another folder"),
        ("@/m.npz --masks masks", "--masks masks: it is for --colmap DATABASE; leave it out"),
        ("@/m.npz --colmap a.db --out b.db", "m.npz: --colmap a.db gives the matches; leave one out"),
        ("--colmap a.db --out b.db --frames 0,1", "--frames does not go with --colmap; leave it out"),
        ("--colmap a.db --out b.db --bodies 2", "--bodies 2 does not go with --colmap"),
        ("--colmap a.db --out b.db --images x y", "--images: 2 are given; with --colmap, give the folder of the images"),
    ],
)
def test_bad_input_is_one_line_and_code_2(refuse, solved, line, says):
    refuse(line, says=(says,))


def test_refusals_name_the_file_and_overwrite_no_input(run, data, solved, monkeypatch):
    before = (data / "m.csv").read_text()
    Path("labels.csv").write_text(before)
    code, _, err = run("labels.csv --out .")
    assert code == 2 and "labels.csv: is an input" in err and Path("labels.csv").read_text() == before

    def refuse(*x, **options):
        raise ValueError(Message("{arg:bodies=40} need 280 matches; lower {arg:bodies=}"))

    monkeypatch.setattr(dyntorch, "segment", refuse, raising=False)
    code, _, err = run("@/m.npz --bodies 40")
    assert code == 2 and re.fullmatch(r"dyntorch: \S+m\.npz: --bodies 40 need 280 matches; lower --bodies\n", err)


def test_a_database_of_colmap_goes_its_own_way(run, monkeypatch):
    jobs = []
    monkeypatch.setattr("indexing.cli.commands.segment.run_colmap", lambda flags: jobs.append(flags) or 3)
    assert run("--colmap a.db --out b.db --images photos --masks m --threshold auto --no-spatial --seed 4 --title Yard")[0] == 3
    assert jobs[0].colmap == Path("a.db") and jobs[0].images == (Path("photos"),)
