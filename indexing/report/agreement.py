"""The report on how far two sets of labels agree: a person's and a model's, or those of two people."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from indexing import files
from indexing.comparing import NONE, Agreement, ComparedSpan, SegmentCounts, compare
from indexing.opening import count
from indexing.report import pictures
from indexing.report.canvas import Theme
from indexing.report.page import Picture, bar, table_csv
from indexing.report.recognition import OURS, TIMELINES, TIPS, duration, percent, timeline_name
from indexing.report.results import cell
from indexing.report.summary import Summary, Table, register_page

FILES = ("report.html", "metrics.json", "manifest.json", "confusion.png", "confusion.csv", "timeline.png")


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


@register_page(AgreementReport, "agreement", FILES, OURS)
def summarize(report: AgreementReport) -> Summary:
    """Everything that is said of how far two sets of labels agree."""
    both, (known, found) = report.agreement, report.sides
    names = [*both.labels, NONE]
    seconds = [
        [name, *(f"{value:.1f}" if value >= 0.05 else "" for value in row)]
        for name, row in zip(names, both.seconds.tolist(), strict=True)
    ]
    labels = [
        "label",
        "known (s) ",
        "found (s) ",
        "both (s) ",
        "kappa ",
        "known ",
        "found ",
        *(f"F1@{k:g} " for k in both.segments),
    ]
    drawn: dict[str, Any] = {timeline_name(i): partial(_timeline, span) for i, span in enumerate(report.spans[:TIMELINES])}
    axes = f"seconds known ({known})", f"seconds found ({found})"
    drawn["confusion.png"] = lambda theme: pictures.confusion(both.seconds.round(1), names, axes)
    return Summary(
        headline=describe_agreement(report), cards=_cards(both),
        opening=[f"confusion over time, in seconds: rows are {known}, columns {found}"],
        tables=[
            Table(["", *(f"{name} " for name in names)], seconds), Table(labels, label_rows(both)),
            Table(["overlap", "right ", "found ", "known ", "precision ", "recall ", "F1 "], overlap_rows(both)),
        ],
        notes=report.notes, closing=[_agreement_sentence(report)], pictures=drawn,
        files={
            "confusion.csv": partial(confusion_csv, both), "metrics.json": partial(as_json, report),
            files.MANIFEST: lambda: report.manifest,
        },
        values=partial(page_values, report),
    )  # fmt: skip


def page_values(report: AgreementReport) -> dict[str, Any]:
    """Rows of the page's tables, and whose timelines are drawn."""
    both = report.agreement
    counts = zip(overlap_rows(both), both.segments.values(), strict=True)
    return {
        "timelines": [(timeline_name(i), span_name(span)) for i, span in enumerate(report.spans[:TIMELINES])],
        "hidden": max(0, len(report.spans) - TIMELINES),
        "spans": [
            [span_name(span), duration(one.total_seconds), _share(one.agreement), _number(one.kappa), _number(_last(one).f1)]
            for span, one in _compare_each(report)
        ],
        "heads": [(f"F1 at {overlap:g}", "number") for overlap in both.segments],
        "labels": label_rows(both),
        "overlaps": [[*row, bar(0.0 if math.isnan(one.f1) else one.f1)] for row, one in counts],
    }


def _compare_each(report: AgreementReport) -> list[tuple[ComparedSpan, Agreement]]:
    """Each recording and person by itself."""
    return [(span, compare([span])) for span in report.spans]


def as_json(report: AgreementReport) -> dict[str, Any]:
    """All numbers: of all recordings together, and of each."""
    return {
        **report.agreement.to_json(),
        "by_recording": [
            {"recording": span.name, "person": span.person, "start": span.start, "end": span.end, **_headline(one)}
            for span, one in _compare_each(report)
        ],
        "sides": {"known": report.sides[0], "found": report.sides[1]},
        "notes": list(report.notes),
    }


def _agreement_sentence(report: AgreementReport) -> str:
    """How much was compared, and how far both sides agree."""
    both, spans = report.agreement, report.spans
    people = sum(bool(span.person) for span in spans)
    who = f" of {count(people, 'person', 'people')}" if people else ""
    kappa = "does not exist (one label throughout)" if math.isnan(both.kappa) else f"{both.kappa:.3f}"
    return (
        f"{report.sides[1]} against {report.sides[0]}: {duration(both.total_seconds)}{who} in "
        f"{count(len({span.name for span in spans}), 'recording')}; "
        f"the same in {100 * both.agreement:.1f} % of the time, Cohen's kappa over time {kappa}"
    )


def describe_agreement(report: AgreementReport) -> str:
    """The result in plain words."""
    both = report.agreement
    known, found = report.sides
    last = _last(both)
    words = [f"{duration(both.total_seconds)} of {count(len(report.spans), 'recording')} compared: {found} against {known}."]
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
    return [
        [f"{k:g}", f"{n.right:,}", f"{n.found:,}", f"{n.known:,}", *map(_number, (n.precision, n.recall, n.f1))]
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
        ("Compared", duration(both.total_seconds), count(len(both.labels), "label")),
    ]


def _headline(both: Agreement) -> dict[str, float]:
    return {"seconds": both.total_seconds, "agreement": both.agreement, "kappa": both.kappa, "f1": _last(both).f1}


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


def _timeline(span: ComparedSpan, theme: Theme) -> Picture:
    found, known = _bars(span)
    ends = [span.start, span.end]
    tips = pictures.timeline_tips(ends, [], found, known)
    return Picture(pictures.timeline(ends, np.zeros((2, 0)), [], found, known), tips=tips[:TIPS])


def _number(value: float) -> str:
    return "n/a" if math.isnan(value) else f"{value:.3f}"


def _share(value: float) -> str:
    return "n/a" if math.isnan(value) else percent(value)
