"""``dyntorch calibrate``: from keypoint folders to cameras and the movement in space, and what is refused and how."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch

import dyntorch
from indexing import ClipSet
from indexing.cli import main
from tests.indexing.calibrate.scene import FOCAL, LATE, PLACES, SIZE, filmed, solved, truth, write_cameras

COMMAND = "calibrate"
THREE = "@/cam1 @/cam2 @/cam3 --fps 30 --size 1920x1080"


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``cam1`` to ``cam3``; the first also as shares of the picture, and again under another name; another camera."""
    folder = write_cameras(tmp_path_factory.mktemp("cameras"))
    clip = filmed()[0][0]
    table = np.c_[clip.joints.reshape(-1, 34) / np.tile(SIZE, 17)].reshape(-1, 17, 2)
    ClipSet([clip.replace(joints=table, label=None)]).save(folder / "shares.npz")
    ClipSet([clip]).save(folder / "again.npz")
    lens = "[cam1]\nmatrix = [[900, 0, 900], [0, 900, 500], [0, 0, 1]]\ndistortions = []\n"
    (folder / "lens.toml").write_text(lens)
    ClipSet([filmed()[1][0].replace(times=filmed()[1][0].times + 1000.0)]).save(folder / "late.npz")
    return folder


@pytest.fixture
def library(monkeypatch):
    """The truth, whatever is asked; records how."""
    said: dict = {"asked": [], "ok": True}

    def answer(tracks, **options):
        said["asked"].append({"tracks": tracks, **options})
        return solved(ok=said["ok"], metric=options["lengths"] is not None)

    monkeypatch.setattr(dyntorch, "calibrate", answer, raising=False)
    return said


def listed(folder: str) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in Path(folder).rglob("*") if path.is_file())


# ---- what is found -------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_three_folders(run, library):
    code, out, err = run(f"{THREE} --height 1.75 --out calib")
    assert (code, err) == (0, "") and "report: calib/report.html" in out
    assert all(word in out for word in ("cam2", "1500.0 ± 15.0", "-0.4000 ± 0.0005"))
    assert re.search(r"\+0\.\d{3}, \+[34]\.\d{3}, \+1\.\d{3} ± 0\.00\d", out)
    assert "note: scale from a standing height of 1.75 m" in out and "open: where in the world the rig stands" in out
    assert "written to calib/: Calib_dyntorch.toml, keypoints_3d.c3d, keypoints_3d.npz, keypoints_3d.trc" in out
    [asked] = library["asked"]
    assert [len(x) for x in asked["tracks"]] == [110 - late for late in LATE] and asked["sizes"] == [SIZE] * 3
    assert torch.allclose(asked["tracks"][1][0], torch.from_numpy(filmed()[1][0].joints[0].copy()))
    assert asked["lengths"] is None and asked["clocks"] is None and asked["focal"] is None
    assert asked["times"][2][:3].tolist() == pytest.approx([0, 1 / 30, 2 / 30]) and asked["rate"] is None and not asked["one_lens"]
    assert {"versions", "inputs", "timings"} <= json.loads(Path("calib/calibration.json").read_text())["manifest"].keys()


@pytest.mark.slow
def test_flags_reach_the_library(run, library):
    assert run(f"{THREE} --focal 1500,1510,1520 --synchronized --length left_hip left_knee 0.42")[0] == 0
    assert run(f"{THREE} --one-lens --max-shift 2 --no-rate --min-confidence 0.5")[0] == 0
    first, second = library["asked"]
    assert first["focal"] == [1500, 1510, 1520] and first["clocks"].tolist() == [[0, 1]] * 3
    assert first["lengths"] == {(11, 13): 0.42}
    assert second["one_lens"] and second["max_shift"] == 2 and second["rate"] == 1.0


@pytest.mark.slow
def test_known_lenses_and_clocks_from_files(run, library):
    section = "[{}]\nmatrix = [[900, 0, 900], [0, 900, 500], [0, 0, 1]]\ndistortions = [-0.1, 0, 0, 0]\nsize = [1920, 1080]\n"
    Path("lens.toml").write_text("".join(section.format(f"cam{i}") for i in (1, 2, 3)))
    cameras = [{"name": f"cam{i}", "offset": -0.1 * i, "rate": 1.0} for i in range(1, 4)]
    Path("sync.json").write_text(json.dumps({"ok": True, "cameras": cameras}))
    code, _, _ = run(f"{THREE} --calibration lens.toml --clocks sync.json --out out")
    [asked] = library["asked"]
    assert code == 0 and asked["focal"] is None and float(asked["calibration"][1][0][0, 0]) == 900
    assert asked["clocks"][:, 0].tolist() == pytest.approx([0.0, -0.1, -0.2])
    inputs = json.loads(Path("out/calibration.json").read_text())["manifest"]["inputs"]
    assert {Path(name).name for name in inputs} == {"cam1", "cam2", "cam3", "lens.toml", "sync.json"}


def test_shares_of_the_picture_become_pixels(run, library):
    code, out, _ = run("@/shares.npz @/cam2 @/cam3 --fps 30 --size 1920x1080")
    assert code == 0 and "0 to 1" not in out
    assert torch.allclose(library["asked"][0]["tracks"][0], torch.from_numpy(filmed()[0][0].joints.copy()), atol=1e-3)


# ---- what is refused -----------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_what_does_not_decide_is_refused(run, library):
    assert run(f"{THREE} --height 1.75 --out calib")[0] == 0
    library["ok"] = False
    code, out, err = run(f"{THREE} --height 1.75 --out calib")
    said = "dyntorch: refused: cameras in a line: cam2 tells nothing new; move one of them, or give --focal\n"
    assert (code, err) == (3, said)
    assert listed("calib") == ["calibration.json", "report.html", "residuals.png", "rig.png"]
    assert "note: removed, as this run does not decide: Calib_dyntorch.toml" in out and "report alone, and no calibration" in out
    assert "give --focal" in Path("calib/report.html").read_text()


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("", "no cameras given, two are needed"),
        ("@/cam1 --size 1920x1080", "cam1: is one camera, two are needed"),
        ("@/cam1 @/cam1 --size 1920x1080", "cam1: given twice; name every camera once"),
        ("@/cam1 @/again.npz @/cam2 --size 1920x1080", "cam1 and again hold the same recording: a camera is given twice"),
        ("@/cam1 @/cam2", "cam1: the size of its picture is not known; give --size such as 1920x1080"),
        ("@/shares.npz @/cam2", "shares: the size of its picture is not known; give --size"),
        ("@/cam1 @/cam2 --size 640x480", "cam1: its picture of 640x480 does not hold its keypoints"),
        ("@/cam1 @/cam2 --size 1920", "--size must be width x height in pixels, as in 1920x1080"),
        ("@/cam1 @/cam2 --size 1920x0", "--size must be width x height in pixels"),
        ("@/cam1 @/cam2 --size 9x9,9x9,9x9", "--size gives 3 sizes for 2 cameras"),
        ("@/cam1 @/cam2 --size 1920x1080 --height 0", "--height must be that of a standing person in metres, 0.4 to 2.6, got 0"),
        ("@/cam1 @/cam2 --size 1920x1080 --height 17", "0.4 to 2.6, got 17"),
        ("@/cam1 @/cam2 --size 1920x1080 --height 175", "got 175; in centimetres? give 1.75"),
        ("@/cam1 @/cam2 --size 1920x1080 --height 1750", "got 1750; in millimetres? give 1.75"),
        ("@/cam1 @/cam2 --size 1920x1080 --focal 0", "--focal must be a positive number of pixels"),
        ("@/cam1 @/cam2 --size 1920x1080 --focal 1,2,3", "--focal gives 3 numbers for 2 cameras"),
        ("@/cam1 @/cam2 --size 1920x1080 --focal 9 --one-lens", "--focal and --one-lens both say what the focal lengths are"),
        ("@/cam1 @/cam2 --size 1920x1080 --exif", "cam1, cam2: no 35 mm equivalent is written in its video"),
        ("@/cam1 @/cam2 --size 1920x1080 --fps 0", "--fps must be a positive number of frames per second"),
        ("@/cam1 @/cam2 --size 1920x1080 --height 1.7 --length nose left_hip 1", "--height and --length both fix the scale"),
        ("@/cam1 @/cam2 --size 1920x1080 --length nose tail 1", "'tail': there is no such joint; the joints are nose, left_eye"),
        ("@/cam1 @/cam2 --size 1920x1080 --length nose nose 1", "--length nose nose: expected two joints and the metres between"),
        ("@/cam1 @/cam2 --size 1920x1080 --length nose left_hip 0", "--length nose left_hip: expected two joints"),
        ("@/cam1 @/cam2 --size 1920x1080 --clocks no.json", "no.json: no such file"),
        ("@/cam1 @/cam2 --size 1920x1080 --clocks a.json --synchronized", "--synchronized and --clocks a.json both say how"),
        ("@/cam1 @/cam2 --size 1920x1080 --synchronized --max-shift 2", "--max-shift is of clocks that are searched"),
        ("@/cam1 @/cam2 --size 1920x1080 --max-shift -1", "--max-shift must be a positive number of seconds, got -1"),
        ("@/cam1 @/cam2 --size 1920x1080 --calibration no.toml", "no.toml: no such file"),
        (f"{THREE} --calibration @/lens.toml", "lens.toml: its cameras are cam1, and cam1, cam2, cam3 are asked for"),
        ("@/cam1 @/cam2 --size 1920x1080 --by pixels", "--by pixels: cameras are calibrated from the joints of people"),
        ("@/cam1 @/late.npz --size 1920x1080 --fps 30 --synchronized", "they have no time in common"),
        ("@/cam1 @/cam2 --size 1920x1080 --out @/again.npz", "is a file; choose another folder"),
        ("@/cam1 @/cam2 --size 1920x1080 --out @/cam1", "cam1: is an input, and files of the report among its frames would"),
        ("@/cam1 @/cam2 --size 1920x1080 --person nobody", "see dyntorch calibrate --help"),
    ],
)
def test_bad_input_is_one_line_and_code_2(refuse, library, line, says):
    refuse(line, says=(says,))
    assert library["asked"] == []


def test_nine_cameras_are_too_many(run, library):
    clip = filmed()[0][0]
    for i in range(9):
        ClipSet([clip.replace(joints=clip.joints + i)]).save(f"c{i}.npz")
    code, _, err = run(" ".join(f"c{i}.npz" for i in range(9)) + " --size 1920x1080")
    assert code == 2 and "9 cameras: two to 8 are calibrated together; leave some out" in err


# ---- the library itself --------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_three_cameras_from_files_to_files(run):
    code, _, err = run(f"{THREE} --focal {FOCAL:g} --height 1.75 --out calib")
    assert (code, err) == (0, "")
    said = json.loads(Path("calib/calibration.json").read_text())
    assert [camera["offset"] for camera in said["cameras"]] == pytest.approx([-late / 30 for late in LATE], abs=0.01)
    centers, true = np.array([camera["center"] for camera in said["cameras"]]), np.array(PLACES)
    for i, j in ((0, 1), (0, 2), (1, 2)):
        assert np.linalg.norm(centers[i] - centers[j]) == pytest.approx(np.linalg.norm(true[i] - true[j]), rel=0.06)
    clip = ClipSet.load("calib/keypoints_3d.npz")[0]
    knee = np.nanmedian(np.linalg.norm(clip.joints[:, 13] - clip.joints[:, 15], axis=1))
    assert knee == pytest.approx(np.median(np.linalg.norm(truth().points[:, 13] - truth().points[:, 15], axis=1)), rel=0.06)
    assert np.nanmedian(clip.joints[:, 0, 1]) > np.nanmedian(clip.joints[:, 15, 1]) + 1.0  # y is up
    parts = ["squat=calib/keypoints_3d.npz@0-1.7", "wave=calib/keypoints_3d.npz@1.7-3.6"]
    assert main(["index", "fit", *parts, "-o", "m.safetensors"]) == 0  # solid examples to learn from
