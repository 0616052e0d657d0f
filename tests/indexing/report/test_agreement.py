"""The report on how far two sets of labels agree: what it shows, what it writes, and names that are no markup."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from indexing.comparing import ComparedSpan, compare
from indexing.report.agreement import AgreementReport, describe_agreement, label_rows, overlap_rows
from indexing.report.summary import write_report

KNOWN = [("squat", 1.0, 4.0), ("kick", 5.0, 6.0), ("=wave", 12.0, 14.0)]
FOUND = [("squat", 1.5, 4.0), ("<b>jump</b>", 5.0, 6.0)]


def report(**changes):
    spans = [ComparedSpan("a.json", 0.0, 20.0, KNOWN, FOUND), ComparedSpan("b.json", 0.0, 10.0, [], FOUND, person="2")]
    return AgreementReport("m against a", compare(spans), spans, ("a.eaf", "m.safetensors"), ["a note"], **changes)


@pytest.mark.slow
def test_everything_is_written_and_says_the_same(tmp_path: Path) -> None:
    page = write_report(tmp_path / "out", report(manifest={"time": "now", "seed": None}))
    names = {path.name for path in page.parent.iterdir()}
    expected = {"report.html", "metrics.json", "manifest.json", "confusion.png", "confusion.csv", "timeline.png", "timeline-2.png"}
    assert names == expected and set(json.loads((page.parent / "manifest.json").read_text())["files"]) == expected
    both = report().agreement
    measured = json.loads((page.parent / "metrics.json").read_text())
    assert measured["kappa"] == pytest.approx(both.kappa) and measured["sides"] == {"known": "a.eaf", "found": "m.safetensors"}
    assert [(one["recording"], one["person"]) for one in measured["by_recording"]] == [("a.json", ""), ("b.json", "2")]
    assert measured["by_recording"][1]["kappa"] == 0.0 and measured["notes"] == ["a note"]
    table = list(csv.reader((page.parent / "confusion.csv").open(encoding="utf-8")))
    assert table[0] == ["known \\ found", "<b>jump</b>", "'=wave", "kick", "squat", "(none)"]
    assert sum(float(cell) for row in table[1:] for cell in row[1:]) == pytest.approx(both.total_seconds)
    text = page.read_text(encoding="utf-8")
    assert "&lt;b&gt;jump" in text and "<b>jump" not in text and "<script" not in text and "b.json, person 2" in text
    assert f"{both.kappa:.3f}" in text and "a note" in text
    both = report().agreement
    rows = {row[0]: row for row in label_rows(both)}
    assert rows["squat"][1:4] == ["3.0", "5.0", "2.5"] and rows["squat"][5:7] == ["1", "2"]
    assert rows["squat"][-1] == "0.667" and rows["kick"][-1] == "0.000"
    assert overlap_rows(both)[-1] == ["0.5", "1", "4", "3", "0.250", "0.333", "0.286"]
    assert "1 of 4 segments found share half of their time or more with one of 3 known." in describe_agreement(report())
    nothing = [ComparedSpan("a", 0.0, 5.0, [], [])]
    assert overlap_rows(compare(nothing))[0] == ["0.1", "0", "0", "0", "n/a", "n/a", "n/a"]
    none = AgreementReport("none", compare(nothing), nothing)
    assert "100.0%" in describe_agreement(none) and "Cohen" in write_report(tmp_path, none).read_text()
