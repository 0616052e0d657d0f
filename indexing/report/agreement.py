"""The report on how far two sets of labels agree: a person's and a model's, or those of two people."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from indexing import files
from indexing.comparing import NONE, Agreement, ComparedSpan, SegmentCounts, compare
from indexing.opening import count
from indexing.report import pictures
from indexing.report.page import Picture, bar, render, table_csv, write_files
from indexing.report.recognition import TIMELINES, TIPS, duration, percent, timeline_name
from indexing.report.results import cell

FILES = ("report.html", "metrics.json", "manifest.json", "confusion.png", "confusion.csv", "timeline.png")
OURS = r"confusion\.(png|csv)|timeline(-\d+)?\.png|events\.csv|repetitions\.csv"


@dataclass(frozen=True, eq=False)
class AgreementReport:
    """Two sets of labels, compared."""

    title: str
    agreement: Agreement
    spans: Sequence[ComparedSpan]
    sides: tuple[str, str] = ("known", "found")
    notes: Sequence[str] = ()
    manifest: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class _Bar:
    """An interval as the timeline draws it."""

    label: str
    start: float
    end: float
    score: float = math.nan
    margin: float = math.nan


def write_agreement(folder: str | Path, report: AgreementReport) -> Path:
    """Write a report into a folder: ``report.html``, ``metrics.json``, ``manifest.json``, ``confusion.png``, ``confusion.csv``
    and ``timeline.png`` (``timeline-2.png``... of further recordings and people), each whole or not at all, ``report.html``
    last."""
    where = files.prepare(folder)
    both = report.agreement
    names = [*both.labels, NONE]
    each = [(span, compare([span])) for span in report.spans]
    drawn = {timeline_name(i): _timeline(span) for i, span in enumerate(report.spans[:TIMELINES])}
    sides = f"seconds known ({report.sides[0]})", f"seconds found ({report.sides[1]})"
    drawn_confusion = pictures.confusion(both.seconds.round(1), names, sides)
    values: dict[str, Any] = {
        "summary": describe_agreement(report),
        "cards": _cards(both),
        "notes": [("", "", note) for note in report.notes],
        "timelines": [
            (span_name(span), Picture(png, tips=_tips(span)[:TIPS]))
            for span, png in zip(report.spans, drawn.values(), strict=False)
        ],
        "hidden": len(report.spans) - len(drawn),
        "spans": [
            [span_name(span), duration(one.compared), _share(one.agreement), _number(one.kappa), _number(_last(one).f1)]
            for span, one in each
        ],
        "heads": [(f"F1 at {overlap:g}", "number") for overlap in both.segments],
        "labels": label_rows(both),
        "overlaps": [[*row, bar(0.0 if math.isnan(one.f1) else one.f1)] for row, one in _overlap_rows(both)],
        "confusion": Picture(drawn_confusion),
    }
    html = render("agreement", report, **values)
    measured = {
        **both.plain(),
        "by_recording": [
            {"recording": span.name, "person": span.person, "start": span.start, "end": span.end, **_headline(one)}
            for span, one in each
        ],
        "sides": {"known": report.sides[0], "found": report.sides[1]},
        "notes": list(report.notes),
    }
    contents: dict[str, Any] = {**drawn, "confusion.png": drawn_confusion, "confusion.csv": confusion_csv(both)}
    written = sorted([*contents, "metrics.json", files.MANIFEST, "report.html"])
    files.remove_stale(where, written, OURS)
    contents |= {"metrics.json": measured, files.MANIFEST: {**report.manifest, "files": written}, "report.html": html}
    return write_files(folder, contents)


def describe_agreement(report: AgreementReport) -> str:
    """The result in plain words."""
    both = report.agreement
    known, found = report.sides
    last = _last(both)
    words = [f"{duration(both.compared)} of {count(len(report.spans), 'recording')} compared: {found} against {known}."]
    if not math.isnan(both.agreement):
        words.append(f"They say the same in {percent(both.agreement)} of the time.")
    words.append(
        f"{last.right} of {count(last.found, 'segment')} found share half of their time or more with one of {last.known} known."
    )
    return " ".join(words)


def label_rows(both: Agreement) -> list[list[Any]]:
    """Label, seconds known, found and both, kappa, segments known and found, and F1 at each overlap."""
    rows: list[list[Any]] = []
    for name, one in both.by_label.items():
        counts = next(iter(one.segments.values()), SegmentCounts(0, 0, 0))
        seconds = [f"{value:,.1f}" for value in (one.known, one.found, one.both)]
        f1 = [_number(each.f1) for each in one.segments.values()]
        rows.append([name, *seconds, _number(one.kappa), f"{counts.known:,}", f"{counts.found:,}", *f1])
    return rows


def overlap_rows(both: Agreement) -> list[list[str]]:
    """Least overlap, segments right, found and known, precision, recall and F1."""
    return [row for row, _ in _overlap_rows(both)]


def _overlap_rows(both: Agreement) -> list[tuple[list[str], SegmentCounts]]:
    return [
        ([f"{k:g}", f"{n.right:,}", f"{n.found:,}", f"{n.known:,}", *map(_number, (n.precision, n.recall, n.f1))], n)
        for k, n in both.segments.items()
    ]


def confusion_csv(both: Agreement) -> str:
    """The table of confusion over time, in seconds, with names of rows (known) and columns (found)."""
    names = [*both.labels, NONE]
    rows = [[cell(name), *(f"{value:.3f}" for value in row)] for name, row in zip(names, both.seconds.tolist(), strict=True)]
    return table_csv(["known \\ found", *map(cell, names)], rows)


def span_name(span: ComparedSpan) -> str:
    """A recording, and the person where there are several."""
    return f"{span.name}, person {span.person}" if span.person else span.name


def _cards(both: Agreement) -> list[tuple[str, str, str]]:
    last = _last(both)
    return [
        ("Cohen's kappa", _number(both.kappa), "over time, beyond chance; 1 is perfect, 0 is chance"),
        ("Same label", _share(both.agreement), "of the time, no label being one of the answers"),
        ("F1", _number(last.f1), "of segments that share half of their time or more"),
        ("Precision", _number(last.precision), f"{last.right} of {last.found} found"),
        ("Recall", _number(last.recall), f"{last.right} of {last.known} known"),
        ("Compared", duration(both.compared), count(len(both.labels), "label")),
    ]


def _headline(both: Agreement) -> dict[str, float]:
    return {"seconds": both.compared, "agreement": both.agreement, "kappa": both.kappa, "f1": _last(both).f1}


def _last(both: Agreement) -> SegmentCounts:
    """Segments at the largest overlap."""
    return both.segments[max(both.segments)] if both.segments else SegmentCounts(0, 0, 0)


def _bars(span: ComparedSpan) -> tuple[list[_Bar], list[tuple[str, float, float]]]:
    """Both sides, cut to the span."""
    sides = [
        [(str(label), max(a, span.start), min(b, span.end)) for label, a, b in side if b > span.start and a < span.end]
        for side in (span.found, span.known)
    ]
    return [_Bar(*one) for one in sides[0]], sides[1]


def _timeline(span: ComparedSpan) -> bytes:
    found, known = _bars(span)
    return pictures.timeline([span.start, span.end], np.zeros((2, 0)), [], found, known)


def _tips(span: ComparedSpan) -> list[Any]:
    found, known = _bars(span)
    return pictures.timeline_tips([span.start, span.end], [], found, known)


def _number(value: float) -> str:
    return "n/a" if math.isnan(value) else f"{value:.3f}"


def _share(value: float) -> str:
    return "n/a" if math.isnan(value) else percent(value)
