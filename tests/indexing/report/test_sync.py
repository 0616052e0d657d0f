"""The report on a synchronization: what is written, drawn and said."""

from __future__ import annotations

import json
import math
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import torch

from dyntorch import Clocks, Shift
from dyntorch.tasks.synchronize.result import Pair
from indexing import Clip
from indexing.report.summary import write_report
from indexing.report.sync import Compared, SyncReport, as_json, describe, picture_of, title_of
from indexing.skeleton import Skeleton
from indexing.sync.people import Pairing
from indexing.sync.recordings import Take
from tests.indexing.sync.scene import shift


def take(name: str, assumed: bool = False) -> Take:
    person = Clip(np.zeros((90, 3, 2)), skeleton=Skeleton("three", ("nose", "hip", "knee"), ()))
    return Take(name, "keypoints", Path("pose") / name, (person,), fps_assumed=assumed, times=np.linspace(0, 3, 90), count=90)


def report(cameras: int = 2, first: Shift | None = None, outliers=(), **changes) -> SyncReport:
    takes = [take(f"cam{i}<b>", assumed=i == 1) for i in range(cameras)]
    points, ends = torch.tensor([True, False, True]), list(combinations(range(cameras), 2))
    drift = {"points": points, "rate": 1.00002, "rate_sigma": 1e-6, "center": 0.0}
    compared = {(i, j): Pairing(first or shift(0.4 * (j - i), **drift), (0, 0)) for i, j in ends}
    together = None
    if cameras > 2:
        column = torch.arange(cameras, dtype=torch.float64)
        rows = tuple(Pair(end, 0.4, 0.002, 0.001, 0, True) for end in ends)
        together = Clocks(
            0.4 * column, 1 + 2e-5 * column, column * 0 + 0.002, column * 0, 0.9, rows, 0.0123, None, list(outliers),
            0, 1.5, {}, status=torch.tensor(0),
        )  # fmt: skip
    return SyncReport(**{"takes": takes, "compared": compared, "together": together, "remarks": ["a note & more"], **changes})


def one(found: Shift) -> Compared:
    return Compared(take("a"), take("b"), Pairing(found, (0, 0)))


def test_files_are_written_and_say_what_was_found(tmp_path):
    written = write_report(tmp_path, report(manifest={"time": "now"}))
    assert written.name == "report.html" and sorted(p.name for p in tmp_path.iterdir()) == ["curve.png", "report.html", "sync.json"]
    found = json.loads((tmp_path / "sync.json").read_text())
    assert found["cameras"][1]["rate"] == pytest.approx(1.00002) and found["pairs"][0]["wrong_points"] == ["hip (joint 1)"]
    assert found["pairs"][0]["residual"] is None and found["manifest"] == {"time": "now"}
    text = written.read_text()
    assert "cam1&lt;b&gt;" in text and "<b>cam" not in text and "a note &amp; more" in text.lower() and "Cycle" not in text
    said = describe(report())
    assert "cam1<b> began 0.400 ± 0.002 s before cam0<b> (12.00 frames), and its clock gains +0.072 s in an hour." in said
    assert describe(report(first=shift(-0.4))) == "cam1<b> began 0.400 ± 0.002 s after cam0<b> (12.00 frames)."
    assert "do not decide" in describe(report(first=shift(ok=False, reason="too still")))


@pytest.mark.slow
def test_more_cameras_have_a_cycle_error_and_an_outlier(tmp_path):
    three = report(3, outliers=[(0, 2)], checks=["check.mp4"])
    html = write_report(tmp_path, three).read_text()
    assert "12.3 ms" in html and "cam0&lt;b&gt; and cam2&lt;b&gt; stands out" in html and "3 of 3" in html and "check.mp4" in html
    assert "off the clocks of all cameras" in html and "3 cameras" in describe(three)
    assert as_json(three)["outlier_pair"] == ["cam0<b>", "cam2<b>"]


def test_curves_are_drawn_whatever_they_hold(tmp_path):
    none = torch.zeros(0, dtype=torch.float64)
    odd = [
        shift(scores=torch.full((121,), math.nan, dtype=torch.float64)),
        shift(lags=none, scores=none, peaks=none.reshape(0, 2), sigma=math.inf, ok=False, reason="no overlap"),
        shift(lags=none + 1, scores=none + 1),
        shift(peaks=torch.zeros(1, 2), sigma=math.nan),
    ]
    four = {(0, i): Pairing(found, (0, 0)) for i, found in enumerate(odd)}
    assert picture_of(report(takes=[take(name) for name in "abcd"], compared=four))[:4] == b"\x89PNG"
    assert title_of(one(odd[1])) == "a → b: refused"
    assert "Refused." in write_report(tmp_path, report(first=odd[1])).read_text()
    assert json.loads((tmp_path / "sync.json").read_text())["pairs"][0]["sigma"] is None
