"""The report on recognition: what was found in recordings, and how well clips are recognized."""

from __future__ import annotations

import csv
import io
import numbers
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from indexing import files
from indexing.report import pictures
from indexing.report.canvas import DARK, LIGHT
from indexing.report.measures import measure
from indexing.report.page import made_by, page
from indexing.report.recognition_page import TIMELINES, body, describe
from indexing.report.results import RecognitionReport, RecordingResult

OURS = r"confusion\.png|timeline(-\d+)?\.png|events\.csv"


def write_recognition(folder: str | Path, report: RecognitionReport) -> Path:
    """Write a report into a folder: ``report.html`` and the numbers and pictures it shows, as files.

    ``report.html`` (one file that needs no other), ``metrics.json``, ``manifest.json``; for recordings ``events.csv`` and
    ``timeline.png`` (``timeline-2.png``... for further ones); for evaluations ``confusion.png``.  Every file is written whole
    or not at all, ``report.html`` last.  What an earlier report left in the folder and this one does not have is removed.

    Returns:
        the path of ``report.html``.

    Raises:
        ValueError: the folder or a file in it cannot be written.

    Example:
        >>> import tempfile
        >>> evaluation = EvaluationResult(["squat", "lunge"], ["squat", "lunge"], ["squat", "squat"], "azimuth 90")
        >>> path = write_recognition(tempfile.mkdtemp(), RecognitionReport("Two moves", evaluations=[evaluation]))
        >>> sorted(file.name for file in path.parent.iterdir())
        ['confusion.png', 'manifest.json', 'metrics.json', 'report.html']
    """
    where = files.prepare(folder)
    measured = measure(report)
    drawn: dict[str, bytes] = {}
    dark: dict[str, bytes] = {}
    for theme, shelf in ((LIGHT, drawn), (DARK, dark)):
        for index, recording in enumerate(report.recordings[:TIMELINES]):
            shelf[timeline_name(index)] = pictures.timeline(
                recording.times, recording.scores, recording.classes, recording.events, recording.truth, theme=theme
            )
        if report.evaluations:
            table = measured["confusion"]
            shelf["confusion.png"] = pictures.confusion(table["counts"], table["labels"], theme=theme)
    texts = {"events.csv": events_csv(report.recordings)} if report.recordings else {}
    names = sorted([*drawn, *texts, "metrics.json", files.MANIFEST, "report.html"])
    files.remove_stale(where, names, OURS)
    for name, png in drawn.items():
        files.write_bytes(where / name, png)
    for name, text in texts.items():
        files.write_text(where / name, text)
    files.write_json(where / "metrics.json", measured)
    files.write_json(where / files.MANIFEST, {**report.manifest, "files": names})
    html = page(
        report.title,
        body(report, measured, {name: (png, dark[name]) for name, png in drawn.items()}),
        summary=report.summary or describe(report, measured),
        kind="Action recognition",
        footer=made_by(report.manifest),
    )
    return files.write_text(where / "report.html", html)


def timeline_name(index: int) -> str:
    """File name of the picture of the recording with this index (from 0)."""
    return "timeline.png" if index == 0 else f"timeline-{index + 1}.png"


def events_csv(recordings: Sequence[RecordingResult]) -> str:
    """All events as CSV: ``file,label,start,end,score,margin``; seconds with 3 decimals, an empty cell for no number."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["file", "label", "start", "end", "score", "margin"])
    for recording in recordings:
        for event in sorted(recording.events, key=lambda event: event.start):
            times = [f"{event.start:.3f}", f"{event.end:.3f}"]
            writer.writerow([_cell(recording.name), _cell(event.label), *times, _number(event.score), _number(event.margin)])
    return out.getvalue()


def _cell(value: object) -> str:
    """A name as a cell.  Spreadsheets run text that begins like a formula; an apostrophe keeps it text.  Numbers stay numbers."""
    text = str(value)
    is_number = isinstance(value, numbers.Number)
    return f"'{text}" if not is_number and text.lstrip(" ")[:1] in tuple("=+-@\t\r\n") else text


def _number(value: float) -> str:
    return f"{value:.6g}" if value is not None and np.isfinite(value) else ""
