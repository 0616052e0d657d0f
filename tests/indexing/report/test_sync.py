"""The report on a synchronization: what is written, drawn and said."""

from __future__ import annotations

import json
import math

import pytest
import torch

from indexing.report.canvas import DARK, LIGHT
from indexing.report.sync import Clock, Compared, SyncReport, as_json, body, describe, named, picture_of, title_of, write_sync
from tests.indexing.sync.scene import shift


def report(cameras: int = 2, **changes) -> SyncReport:
    names = [f"cam{i}<b>" for i in range(cameras)]
    clocks = [
        Clock(name, f"pose/{name}", 30.0, i == 1, 90, 0.0, 3.0, 0.4 * i, 0.002, 1 + 2e-5 * i, 1e-6) for i, name in enumerate(names)
    ]
    points = torch.tensor([True, False, True])
    pairs = [
        Compared(names[i], names[j], shift(0.4 * (j - i), points=points, rate=1.00002, center=0.0), ("nose", "hip", "knee"), 0.001)
        for i in range(cameras)
        for j in range(i + 1, cameras)
    ]
    values = {"title": "Two cameras", "clocks": clocks, "pairs": pairs, "ok": True, "notes": ["a note & more"]}
    return SyncReport(**{**values, **changes})


def test_files_are_written_and_parse(tmp_path):
    page = write_sync(tmp_path, report(manifest={"time": "now"}))
    assert page.name == "report.html" and sorted(p.name for p in tmp_path.iterdir()) == ["curve.png", "report.html", "sync.json"]
    found = json.loads((tmp_path / "sync.json").read_text())
    assert found["cameras"][1]["rate"] == pytest.approx(1.00002) and found["pairs"][0]["wrong_points"] == ["hip (joint 1)"]
    assert found["pairs"][0]["residual"] == 0.001 and found["manifest"] == {"time": "now"}
    text = page.read_text()
    assert "cam1&lt;b&gt;" in text and "<b>cam" not in text and "a note &amp; more" in text.lower() and "Cycle" not in text


def test_what_two_cameras_say_in_words():
    said = describe(report())
    assert "cam1<b> began 0.400 ± 0.002 s before cam0<b> (12.00 frames), and its clock gains +0.072 s in an hour." in said
    late = Clock("b", "b", 30.0, False, 9, 0.0, 3.0, -0.4, 0.002)
    assert describe(report(clocks=[report().clocks[0], late])) == "b began 0.400 ± 0.002 s after cam0<b> (12.00 frames)."
    assert "do not decide" in describe(report(ok=False, reason="too still"))


def test_more_cameras_have_a_cycle_error_and_an_outlier():
    three = report(3, cycle=0.0123, outlier=("cam0<b>", "cam2<b>"))
    html = body(three, (picture_of(three, LIGHT),) * 2, ["check.mp4"])
    assert "12.3 ms" in html and "cam0&lt;b&gt; and cam2&lt;b&gt; stands out" in html and "3 of 3" in html and "check.mp4" in html
    assert "off the clocks of all cameras" in html and "3 cameras" in describe(three)
    assert as_json(three)["outlier_pair"] == ["cam0<b>", "cam2<b>"]


@pytest.mark.parametrize("theme", [LIGHT, DARK])
def test_curves_are_drawn_whatever_they_hold(theme):
    none = torch.zeros(0, dtype=torch.float64)
    odd = [
        shift(scores=torch.full((121,), math.nan, dtype=torch.float64)),
        shift(lags=none, scores=none, peaks=none.reshape(0, 2), sigma=math.inf, ok=False, reason="no overlap"),
        shift(lags=none + 1, scores=none + 1),
        shift(peaks=torch.zeros(1, 2), sigma=math.nan),
    ]
    assert picture_of(report(pairs=[Compared("a", "b", one) for one in odd]), theme)[:4] == b"\x89PNG"
    assert title_of(Compared("a", "b", odd[1])) == "a → b: refused"


def test_a_report_without_a_curve_is_written(tmp_path):
    none = torch.zeros(0, dtype=torch.float64)
    lost = shift(0.0, lags=none, scores=none, peaks=none.reshape(0, 2), sigma=math.inf, ok=False, reason="nothing moves")
    page = write_sync(tmp_path, report(pairs=[Compared("a", "b", lost)], ok=False, reason="nothing moves"))
    assert "Refused." in page.read_text() and json.loads((tmp_path / "sync.json").read_text())["pairs"][0]["sigma"] is None


def test_wrong_points_without_names_have_numbers():
    pair = Compared("a", "b", shift(points=torch.tensor([True, False])))
    assert pair.wrong == ["joint 1"] and pair.runner_up == (pytest.approx(0.7), 4.0) and Compared("a", "b", shift()).wrong == []


def test_cameras_have_names_instead_of_numbers():
    names = ["left-1", "mid", "right"]
    assert named("camera 2: tied by one pair alone", names) == "camera right: tied by one pair alone"
    assert (
        named("pair 0-2 differs by -0.5 s; pairs 0-1, 1-2", names)
        == "pair left-1-right differs by -0.5 s; pairs left-1-mid, mid-right"
    )
    assert named("cameras 0, 7", names) == "cameras left-1, 7"
