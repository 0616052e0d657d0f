"""Pages register themselves, and what the terminal prints of a result stands on its page, too."""

from __future__ import annotations

import html
import json
import re
from pathlib import Path

import pytest

from indexing.report import summary
from indexing.report.summary import registered_pages
from tests.indexing.cli.conftest import outcome as outcome
from tests.indexing.report.test_page import Page

LINES = {
    "align a.csv b.csv c.csv --out align": "alignment",
    "segment matches.npz --out segment": "segmentation",
    "segment street.csv --bodies 3 --size 1242 375 --out street": "bodies",
    "reconstruct tracks.csv --motion constant_velocity_3d --static parked.csv --fps 25 --out reconstruct": "reconstruction",
    "sync cam1 cam2 cam3 --fps 30 --out sync": "sync",
    "calibrate cam1 cam2 cam3 --size 1920x1080 --fps 30 --out calib": "calibration",
    "index fit lesson.npz -o moves.safetensors --report learned": "training",
    "index scan session.npz -m moves.safetensors --truth truth.csv --write found.csv --report scan": "recognition",
    "index evaluate people.npz --train azimuth=0 --test azimuth=90 --report evaluate": "recognition",
    "index evaluate found.csv --labels truth.csv --report agree": "agreement",
    "archive add lab lesson.npz week --workers 1": "",
    "archive search lab squat.json -k 5 --report hits": "hits",
    "archive find lab -m moves.safetensors --report acted": "finds",
    "archive info lab": "",
    "archive verify lab": "",
}
"""A line for every kind of result, with the template of its page."""


def test_every_page_has_a_template_and_every_template_a_page():
    folder = Path(summary.__file__).parent
    pages = {path.name.partition(".")[0] for path in folder.glob("*.j2") if "extends" in path.read_text(encoding="utf-8")}
    assert {page.template for page in registered_pages()} == pages


@pytest.mark.slow
def test_terminal_page_and_files_are_drawn_from_one_summary(outcome):
    found = {line: outcome(line) for line in LINES}
    refused = {line for line, one in found.items() if one.code == 3 and one.err.startswith("dyntorch: refused: ")}
    wrong = [f"{line}: {one.code}, {one.err}" for line, one in found.items() if line not in refused and (one.code or one.err)]
    for line, one in found.items():
        if not LINES[line]:
            continue
        place = re.search(r"^report: (.*)$", one.out, re.MULTILINE)
        path = one.folder / place[1]
        text = path.read_text(encoding="utf-8")
        words = " ".join(html.unescape(re.sub(r"<[^>]+>", " ", text)).split()).casefold()
        notes = [note for note in re.findall(r"^note: (.*)$", one.out, re.MULTILINE) if "events.csv of a report" not in note]
        wrong += [f"{line}: {note}" for note in notes if note.casefold() not in words]
        parser = type("Whole", (Page,), {"VOID": Page.VOID | {"input"}})(text)
        wrong += [f"{line}: {fault}" for fault in parser.bad]
        for file in path.parent.glob("*.json"):
            json.loads(file.read_text(encoding="utf-8"))
    assert wrong == []
    assert {page.template for page in registered_pages()} <= {*LINES.values(), "static"}, "LINES has no command for a page"
