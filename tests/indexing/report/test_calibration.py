"""The report on a calibration: what it says of a good rig and of a refused one, and whose files it leaves alone."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dyntorch.core import Notice
from dyntorch.tasks.calibrate.result import CalibrationNotice
from indexing.report.calibration import (
    CalibrationReport,
    camera_rows,
    check_folder_of,
    clock_rows,
    earlier,
    outputs,
    residual_rows,
    write_calibration,
)  # fmt: skip
from indexing.sync.calibration import read_calibration
from tests.indexing.calibrate.scene import rig

GOOD = ["Calib_dyntorch.toml", "calibration.json", "keypoints_3d.c3d", "keypoints_3d.npz", "keypoints_3d.trc", "report.html",
        "residuals.png", "rig.png"]  # fmt: skip


def listed(folder):
    return sorted(str(path.relative_to(folder)) for path in Path(folder).rglob("*") if path.is_file())


@pytest.mark.slow
def test_everything_is_written_and_a_hostile_name_stays_text(tmp_path):
    found = rig()
    page = write_calibration(tmp_path / "out", CalibrationReport(found, heading="Kitchen"))[0]
    assert listed(tmp_path / "out") == GOOD and page == tmp_path / "out" / "report.html"
    text, said = page.read_text(), json.loads((tmp_path / "out" / "calibration.json").read_text())
    assert "<h1>Kitchen</h1>" in text and "data-rig=" in text and "script-src &#39;sha256-" in text
    for part in ("1500.0 ± 15.0", "-0.4000 ± 0.0005", "scale from a standing height of 1.75 m", "left_ankle to left_eye", "97 %"):
        assert part in text.replace("Scale from", "scale from"), part
    assert said["ok"] and said["reason"] is None and said["units"] == "m" and said["files"] == sorted(GOOD)
    assert np.shape(said["residuals"]) == (3, 17) and said["residuals"][1][3] is None and said["joints"][5] == "left_shoulder"
    one = said["cameras"][1]
    assert one["focal"] == 1500 and one["focal_sigma"] == pytest.approx(15) and one["offset"] == pytest.approx(-0.4)
    assert np.shape(one["covariance"]) == (11, 11) and len(said["covariance_of"]) == 11
    assert one["offset_sigma"] == pytest.approx(5e-4)
    assert np.allclose(one["center"], [0.5, 4.2, 1.7]) and said["scale"]["height"] == 1.75
    assert said["point_sigma"] == pytest.approx(0.006) and said["clock_confidence"] == 0.99 and "± 6 mm" in text
    assert {notice["code"] for notice in said["notices"]} == {"note"} and said["manifest"]["arguments"]["command"] == "calibrate"
    found = rig()
    object.__setattr__(found.views[0].take, "name", "</script><b>\x07")
    text = write_calibration(tmp_path, CalibrationReport(found))[0].read_text()
    assert "<b>\x07" not in text and "</script><b>" not in text.replace("</script>\n", "") and (tmp_path / "rig.png").is_file()


@pytest.mark.slow
def test_a_refusal_leaves_nothing_that_could_be_taken_for_good(tmp_path):
    write_calibration(tmp_path, CalibrationReport(rig()))
    assert listed(tmp_path) == GOOD
    page, report = write_calibration(tmp_path, CalibrationReport(rig(ok=False)))
    assert listed(tmp_path) == ["calibration.json", "report.html", "residuals.png", "rig.png"]
    said, text = json.loads((tmp_path / "calibration.json").read_text()), page.read_text()
    assert not said["ok"] and said["status"] == "degenerate" and "cameras in a line: cam2 tells nothing new" in said["reason"]
    assert "The recordings do not decide" in text and "Refused." in text and "not to be relied on" in text and "give focal=" in text
    assert any("removed, as this run does not decide: Calib_dyntorch.toml" in note for note in report.notes)


def test_nothing_found_is_a_page_too(tmp_path):
    base = rig(ok=False).calibration
    names = ("K", "R", "t", "distortion", "covariance", "residuals")
    empty = {name: torch.full_like(getattr(base, name), torch.nan) for name in names}
    empty |= {"inliers": torch.full((3,), torch.nan), "times": base.times[:0], "points": base.points[:0], "metric": False}
    clocks = replace(base.clocks, offsets=torch.tensor([0.0, torch.nan, torch.nan]))
    found = rig(ok=False, **{**empty, "metric": False, "clocks": clocks})
    page, report = write_calibration(tmp_path, CalibrationReport(found))
    assert listed(tmp_path) == ["calibration.json", "report.html"] and "data-rig" not in page.read_text()
    assert [row[2] for row in camera_rows(report)] == ["unknown"] * 3 and [row[2] for row in clock_rows(report)][1] == "unknown"
    assert [row[1:] for row in residual_rows(report)] == [["n/a", "none", "none"]] * 3


@pytest.mark.slow
def test_what_is_somebody_elses_stays(tmp_path):
    for name in (*outputs(1), "pose-associated"):
        folder = tmp_path / name.replace(".", "_")
        folder.mkdir()
        (folder / name).write_text("mine")
        with pytest.raises(ValueError, match=f"{name}: is there, and not from this command; move it away, or choose another"):
            write_calibration(folder, CalibrationReport(rig()))
        assert listed(folder) == [name] and (folder / name).read_text() == "mine"
    write_calibration(tmp_path / "good", CalibrationReport(rig()))
    assert earlier(tmp_path / "good") == set(GOOD) and earlier(tmp_path) == set()
    (tmp_path / "good" / "notes.txt").write_text("mine")
    write_calibration(tmp_path / "good", CalibrationReport(rig(people=2)))  # one file for each person now
    assert "keypoints_3d.trc" not in listed(tmp_path / "good") and "keypoints_3d_person2.trc" in listed(tmp_path / "good")
    assert "notes.txt" in listed(tmp_path / "good")
    inputs = [tmp_path / "good" / "keypoints_3d.npz"]
    with pytest.raises(ValueError, match=r"keypoints_3d.npz: is an input, and the output would replace it"):
        check_folder_of(tmp_path / "good", inputs)
    with pytest.raises(ValueError, match="is an input, and files of the report among its frames would spoil it"):
        check_folder_of(tmp_path / "good", [tmp_path / "good"])


@pytest.mark.slow
def test_what_cannot_be_known_is_said(tmp_path):
    open_ = [Notice(CalibrationNotice.UNKNOWN_SCALE), Notice(CalibrationNotice.CAMERA_UP, 12.0)]
    found = rig(metric=False, upright=False, notices=tuple(open_))
    text = write_calibration(tmp_path, CalibrationReport(found))[0].read_text()
    assert "The scale is unknown" in text and "nobody stands upright" in text and "up to its scale" in text
    assert not any("scale is unknown" in note for note in found.notes) and len(found.unknown) == 3
    assert [lens.name for lens in read_calibration(tmp_path / "Calib_dyntorch.toml")] == ["cam1", "cam2", "cam3"]
