"""The recognition page: safe with any name, self-contained, honest about what it leaves out, and complete in its files."""

from __future__ import annotations

import base64
import csv
import hashlib
import html
import io
import json
import re
import struct
from html.parser import HTMLParser

import numpy as np
import pytest

from indexing import files
from indexing.report import EvaluationResult, RecognitionReport, manifest, page, write_recognition
from indexing.report.recognition import events_csv
from indexing.report.summary import Summary
from tests.indexing.report.people import SCRIPT, Hit, person, recording

PNG = struct.pack(">8sI4sII", b"\x89PNG\r\n\x1a\n", 13, b"IHDR", 30, 30)


class Page(HTMLParser):
    """Tags that do not nest, addresses that leave the file, and ids of what is on the page."""

    VOID = {"meta", "img", "rect", "path", "br"}

    def __init__(self, text):
        super().__init__()
        self.open, self.bad, self.tags, self.addresses = [], [], [], []
        self.feed(text)
        self.bad += self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.addresses += [value for name, value in attrs if name in ("src", "srcset", "href", "data", "action")]
        self.bad += [f"{tag} {name}" for name, _ in attrs if name.startswith("on")]
        if tag == "img" and not dict(attrs).get("alt"):
            self.bad.append("img without alt")
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)

    def handle_endtag(self, tag):
        if not self.open or self.open.pop() != tag:
            self.bad.append(f"/{tag}")


def write(folder, report):
    """The written page, after what must hold of every page."""
    path = write_recognition(folder, report)
    text = path.read_text(encoding="utf-8")
    parsed = Page(text)
    assert parsed.bad == []
    assert "link" not in parsed.tags and "iframe" not in parsed.tags
    scripts = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    assert len(scripts) == parsed.tags.count("script") == ("data-player=" in text)
    for script in scripts:  # the page lets run what has this hash, and nothing else
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        assert f"script-src &#39;sha256-{digest}&#39;" in text and script == page.Script("player.js").text
    assert scripts or "script-src" not in text
    assert "fetch(" not in text and "XMLHttpRequest" not in text and "import(" not in text and "http" not in "".join(scripts)
    assert all(address.startswith("data:image/png;base64,") for address in parsed.addresses)
    assert "url(" not in text and "@import" not in text and "default-src 'none'" in text
    assert not list(path.parent.glob(".*"))
    return text


def test_a_full_report(tmp_path):
    events = [Hit("squat", 1, 3), Hit("lunge", 5, 6.5, exemplar=1)]
    report = RecognitionReport(
        "Session",
        recordings=[recording(events, [("squat", 1.0, 3.0), ("squat", 7.0, 8.0)])],
        evaluations=[EvaluationResult(["squat", "lunge"], ["squat", "lunge"], ["squat", "squat"], f"azimuth {a}") for a in (0, 90)],
        exemplars={"squat": person(), "lunge": [person(40), person(50)]},
        metrics={"mean_overlap": 0.81, "nested": {"x": np.arange(2)}},
        manifest=manifest({"command": "scan"}, [__file__], seed=1),
    )
    text = write(tmp_path, report)
    names = ["confusion.png", "events.csv", "manifest.json", "metrics.json", "report.html", "timeline.png"]  # nobody counted
    assert sorted(file.name for file in tmp_path.iterdir()) == names
    assert text.count('<svg class="strip"') == 4 and "left limbs" in text
    said = ["2 actions of 2 kinds were found", "2 of 4 clips (50.0%)", "Mean overlap", "azimuth 90", "✓ agrees", "Each action"]
    said += ["nothing known here", "Known, but not found: squat 7.0 to 8.0 s", "command", "1.00 to 3.00 s"]
    for words in said:
        assert words in text, words
    numbers = json.loads((tmp_path / "metrics.json").read_text())
    assert numbers["accuracy"] == 0.5 and numbers["nested"] == {"x": [0, 1]} and numbers["missed_events"] == 1
    kept = json.loads((tmp_path / "manifest.json").read_text())
    assert kept["files"] == names and kept["seed"] == 1


@pytest.mark.slow
def test_names_cannot_break_out_of_the_page(tmp_path):
    evil = ['"><img src=x onerror=alert(1)>', SCRIPT, "a\x00b\x1b", "深蹲 приседание नमस्ते", "=1+1", "</style>$title"]
    events = [Hit(name, i, i + 1) for i, name in enumerate(evil)]
    report = RecognitionReport(
        f"T {SCRIPT}", summary=f"S {SCRIPT}",
        recordings=[recording(events, [(SCRIPT, 0, 9)], classes=evil, name=f"file {SCRIPT}")],
        evaluations=[EvaluationResult(evil, evil, evil[::-1], f"setting {SCRIPT}")],
        exemplars={name: person() for name in evil},
        metrics={SCRIPT: SCRIPT},
        manifest={"arguments": {SCRIPT: [SCRIPT]}, "time": SCRIPT, "versions": {"dyntorch": SCRIPT}},
    )  # fmt: skip
    text = write(tmp_path, report)
    assert text.count("<script") == 1 and text.count("&lt;script&gt;alert(1)&lt;/script&gt;") > 12
    played = json.loads(html.unescape(re.search(r'data-player="([^"]*)"', text)[1]))
    assert SCRIPT in [name for name, _ in played["actions"]] and "</style>$title" in [name for name, _ in played["actions"]]
    assert "onerror=alert(1)&gt;" in text and "深蹲 приседание नमस्ते" in text and "\x00" not in text and "\x1b" not in text


def test_nothing_found_and_nothing_known(tmp_path):
    text = write(tmp_path, RecognitionReport("Empty", recordings=[recording(classes=["only"])]))
    assert "No action was found in 1 recording" in text and "Nothing was found" in text and "Known" not in text
    assert (tmp_path / "events.csv").read_text() == "file,label,start,end,score,margin,person\n"
    assert not (tmp_path / "confusion.png").exists()
    assert "neither recordings nor evaluations" in write(tmp_path / "none", RecognitionReport("Nothing"))
    assert "0 of 1" in write(tmp_path / "missed", RecognitionReport("Missed", recordings=[recording([], [("squat", 1, 2)])]))


def test_odd_scores_and_earlier_pictures(tmp_path):
    events = [Hit("squat", 0, 0, np.nan, np.inf), Hit(3, 1, 2, 12345.6)]
    text = write(tmp_path, RecognitionReport("Odd", recordings=[recording(events, clip=False)]))
    assert "n/a" in text and "12,346" in text and '<svg class="strip"' not in text and ">nan<" not in text
    rows = list(csv.DictReader(io.StringIO((tmp_path / "events.csv").read_text())))
    assert rows[0]["score"] == rows[0]["margin"] == "" and float(rows[1]["score"]) == 12345.6
    inputs = {"op": {f"op_{i:012d}_keypoints.json": f"{i:064x}" for i in range(1164)}, "moves.safetensors": "f" * 64}
    (_, folder), last = page.settings({"inputs": inputs})
    assert str(folder).startswith("1,164 files, each in manifest.json; sha256 of their names and hashes: ")
    assert last == ("inputs.moves.safetensors", "f" * 64)


@pytest.mark.slow
def test_many_events_are_counted_not_drawn(tmp_path):
    events = [Hit("squat", i / 20, i / 20 + 0.04) for i in range(1200)]
    report = RecognitionReport(
        "Many", recordings=[recording(events, frames=2000), recording(events[:1], name="second")], exemplars={"squat": person()}
    )
    text = write(tmp_path, report)
    assert text.count('<svg class="strip"') == 120 and "940 more without pictures" in text
    assert "200 further actions are listed in events.csv only" in text and len(text) < 5_000_000
    assert len((tmp_path / "events.csv").read_text().splitlines()) == 1202


def test_an_earlier_reports_pictures_do_not_stay(tmp_path):
    write(tmp_path, RecognitionReport("Two", recordings=[recording(), recording(name="b")]))
    assert (tmp_path / "timeline-2.png").exists()
    (tmp_path / "timeline-3.png").write_text("the user's own")
    (tmp_path / "notes.txt").write_text("the user's own")
    listed = json.loads((tmp_path / "manifest.json").read_text())
    files.write_json(tmp_path / "manifest.json", {**listed, "files": [*listed["files"], "notes.txt", "../x"]})
    write(tmp_path, RecognitionReport("None", evaluations=[EvaluationResult(["a"], ["a"], ["a"])]))
    left = ["confusion.png", "manifest.json", "metrics.json", "notes.txt", "report.html", "timeline-3.png"]
    assert sorted(file.name for file in tmp_path.iterdir()) == left


@pytest.mark.parametrize(
    "label", ["=cmd|' /C calc'!A0", "+1", "-squat", "@x", "\tx", "  =1", 'quo"te, comma', "two\nlines", "plain", "深蹲"]
)
def test_csv_cells_are_quoted_and_never_formulas(label):
    text = events_csv([recording([Hit(label, 1.23456, 2, score=-0.5, margin=1e-9)], name=label)])
    row = next(csv.DictReader(io.StringIO(text, newline="")))
    guarded = label.strip(" ")[0] in "=+-@\t"
    assert row["label"] == row["file"] == ("'" + label if guarded else label)
    assert (row["start"], row["end"], row["score"], row["margin"]) == ("1.235", "2.000", "-0.5", "1e-09")
    text = events_csv([recording([Hit(-1, 0, 1), Hit(np.int64(-2), 2, 3), Hit("-3", 4, 5)])])  # numbers stay numbers
    assert [row["label"] for row in csv.DictReader(io.StringIO(text))] == ["-1", "-2", "'-3"]


def test_page_parts_escape_and_nest():
    notes = page.notes_of("", [("<k>", 1.0, "<m>")], ["<q>"])
    report = {"title": "<t>", "notes": notes, "manifest": {"a": {"b": [1, 2]}, "time": "<f>"}}
    values = {"joints": [["<j>", "A & B"]]}
    drawn = {"picture": page.Picture(PNG, tips=[page.Tip(0, 0, 1, 1, "<u>")]), "weighing": [], "examples": []}
    text = page.render("training", report, summary=Summary(headline="<s>", cards=[("<n>", "1", "<i>\x00")]), **values, **drawn)
    assert Page(text).bad == [] and "A &amp; B" in text and "<code>a.b</code>" in text and "<code>1 2</code>" in text
    assert not re.search(r"<(n|i|s|k|m|q|j|u|f|t)>", text) and "\x00" not in text
    long = page.render("training", {**report, "manifest": {str(i): i for i in range(205)}}, summary=Summary(), **values, **drawn)
    assert "5 more lines" in long and "<code>199</code>" in long and "<code>200</code>" not in long
    assert 'width="100.0"' in page.bar(1.7) and 'width="0.0"' in page.bar(-1)


def test_finds_are_explained_and_the_comparison_stacks_on_narrow_screens(tmp_path):
    events = [Hit("squat", 1, 3), Hit("lunge", 5, 6.5)]
    plain = EvaluationResult(["squat"], ["squat"], ["lunge"], "azimuth 0", baseline=["squat"])
    other = EvaluationResult(["squat"], ["squat"], ["squat"], "azimuth 90", baseline=["lunge"])
    report = RecognitionReport("t", recordings=[recording(events, [("squat", 1.0, 3.0)])], evaluations=[plain, other])
    text = write(tmp_path, report)
    assert "Score: the evidence for the action" in text and "Margin: how far that is above the next best" in text
    assert "1 of them false" in text and "<title>found: lunge, 5.00 to 6.50 s</title>" in text
    assert re.search(r'<table class="stack">\s*<thead><tr><th scope="col" class="">Setting', text)
