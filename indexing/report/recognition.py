"""The report on recognition: what was found in recordings, and how well clips are recognized."""

from __future__ import annotations

import numbers
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from indexing import files
from indexing.opening import count
from indexing.report import pictures
from indexing.report.canvas import letters_without_font, strip
from indexing.report.page import Picture, bar, even, markup, render, table_csv, write_files
from indexing.report.pictures import timeline_tips
from indexing.report.results import RecognitionReport, RecordingResult, ReportedEvent, confused_with, measure, missed, overlapping

TIMELINES = 12  # recordings whose timeline is drawn
STRIPS = 60  # events that are shown as stick figures, over all recordings
TIPS = 2000  # bars of a timeline that say what they are when pointed at
ROWS = 1000  # events that are listed, over all recordings
LOST = 12  # known actions that were not found and are listed
NONE = "n/a"  # shown where a number does not exist
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
        >>> from indexing.report import EvaluationResult, RecognitionReport
        >>> evaluation = EvaluationResult(["squat", "lunge"], ["squat", "lunge"], ["squat", "squat"], "azimuth 90")
        >>> path = write_recognition(tempfile.mkdtemp(), RecognitionReport("Two moves", evaluations=[evaluation]))
        >>> sorted(file.name for file in path.parent.iterdir())
        ['confusion.png', 'manifest.json', 'metrics.json', 'report.html']
    """
    where = files.prepare(folder)
    measured = measure(report)
    drawn: dict[str, bytes] = {}
    shown, before = [], 0
    for index, recording in enumerate(report.recordings):
        picture = None
        if index < TIMELINES:
            at = (recording.times, recording.scores, recording.classes, recording.events, recording.truth)
            drawn[timeline_name(index)] = pictures.timeline(*at)
            tips = timeline_tips(recording.times, recording.classes, recording.events, recording.truth)
            picture = Picture(drawn[timeline_name(index)], tips=tips[:TIPS])
        shown.append({**of_recording(report, recording, before), "picture": picture})
        before += len(recording.events)
    notes = [("", "", note) for note in report.notes]
    values: dict[str, Any] = {
        "shown": shown,
        "cards": headline(report, measured),
        "notes": notes,
        "percent": percent,
        "duration": duration,
    }
    if report.evaluations:
        drawn["confusion.png"] = pictures.confusion(measured["confusion"]["counts"], measured["confusion"]["labels"])
        values |= {"confusion": Picture(drawn["confusion.png"]), **by_setting(report, measured), **by_class(measured)}
    summary = report.summary or describe(report, measured)
    html = render("recognition", report, summary=summary, measured=measured, TIMELINES=TIMELINES, STRIPS=STRIPS, **values)
    contents: dict[str, Any] = {**drawn, **({"events.csv": events_csv(report.recordings)} if report.recordings else {})}
    names = sorted([*contents, "metrics.json", files.MANIFEST, "report.html"])
    files.remove_stale(where, names, OURS)
    contents |= {"metrics.json": measured, files.MANIFEST: {**report.manifest, "files": names}, "report.html": html}
    return write_files(folder, contents)


def describe(report: RecognitionReport, measured: Mapping[str, Any]) -> str:
    """The report in plain words, from its numbers."""
    words = []
    if report.recordings:
        where = f"{count(measured['recordings'], 'recording')} ({duration(measured['seconds'])} in all)"
        kinds = measured["events_by_class"]
        if not measured["events"]:
            words.append(f"No action was found in {where}.")
        else:
            most, *others = kinds  # most frequent first
            often = f", most often {most} ({kinds[most]} times)" if others and kinds[most] > kinds[others[0]] else ""
            were = "was" if measured["events"] == 1 else "were"
            words.append(f"{count(measured['events'], 'action')} of {count(len(kinds), 'kind')} {were} found in {where}{often}.")
        if measured.get("known_events"):
            got = measured["known_events"] - measured["missed_events"]
            words.append(f"Of {count(measured['known_events'], 'known action')}, {got} overlap a find of the same name.")
    if report.evaluations:
        by_setting = measured["accuracy_by_setting"]
        right = round(measured["accuracy"] * measured["clips"])
        words.append(
            f"{right} of {count(measured['clips'], 'clip')} ({percent(measured['accuracy'])}) were recognized, "
            f"among {count(len(measured['confusion']['labels']), 'action')}."
        )
        if len(by_setting) > 1:
            best, worst = max(by_setting, key=by_setting.__getitem__), min(by_setting, key=by_setting.__getitem__)
            if by_setting[best] > by_setting[worst]:
                words.append(f"Best setting: {best} ({percent(by_setting[best])}); worst: {worst} ({percent(by_setting[worst])}).")
    return " ".join(words)


def headline(report: RecognitionReport, measured: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Headline numbers: name, value, and how to read it."""
    items: list[tuple[str, str, str]] = []
    if report.evaluations:
        low, high = measured["accuracy_interval"]
        number = len(measured["confusion"]["labels"])
        items += [
            ("Accuracy", percent(measured["accuracy"]), f"95% interval {100 * low:.0f} to {100 * high:.0f}%"),
            ("Clips tested", f"{measured['clips']:,}", f"{count(number, 'action')}; guessing gets {percent(1 / number)}"),
            ("Mean F1", f"{measured['macro_f1']:.2f}", "over actions; 1 is perfect"),
        ]
    if report.recordings:
        kinds = f"of {count(len(measured['events_by_class']), 'kind')}"
        if "false_events" in measured:
            kinds += f"; {measured['false_events']:,} of them false: something else, or nothing known there"
        items.append(("Actions found", f"{measured['events']:,}", kinds))
        if measured.get("known_events"):
            got = measured["known_events"] - measured["missed_events"]
            items.append(("Known actions hit", f"{got} of {measured['known_events']}", "overlap a find of the same name"))
            every = percent(measured["frame_agreement"])
            note = f"in known actions, by the best score; {every} of all frames, by what was reported"
            items.append(("Frames right", percent(measured["frame_accuracy"]), note))
        items.append(("Searched", duration(measured["seconds"]), f"in {count(measured['recordings'], 'recording')}"))
    for name, value in report.metrics.items():
        if isinstance(value, (int, float, str, np.number, np.bool_)) and measured.get(name) is value:
            items.append((str(name).replace("_", " ").capitalize(), value if isinstance(value, str) else _plain(value), ""))
    return items


def of_recording(report: RecognitionReport, recording: RecordingResult, before: int) -> dict[str, Any]:
    """What the page says of one recording.

    Args:
        before: how many events the recordings before it have: so many are listed, and drawn, over all.
    """
    events = sorted(recording.events, key=lambda event: event.start)
    draw = max(0, min(len(events), STRIPS - before)) if recording.clip is not None else 0
    listed = max(0, min(len(events), ROWS - before))
    scores, margins = even([event.score for event in events[:listed]]), even([event.margin for event in events[:listed]])
    rows: list[list[Any]] = []
    for number, (event, score, margin) in enumerate(zip(events[:listed], scores, margins, strict=True)):
        rows.append([event.label, _when(event), score, margin])
        if recording.truth is not None:
            rows[-1].append(_verdict(event, overlapping(event, recording.truth)))
        if number < draw and recording.clip is not None:
            alt = f"Key frames of {event.label} found at {event.start:.1f} to {event.end:.1f} s"
            rows[-1].append(strip(recording.clip, event.start, event.end, alt=alt) or none("no joint seen"))
            if report.exemplars:
                clip = report.exemplar(event)
                example = strip(clip, alt=f"Key frames of the example of {event.label}") if clip is not None else ""
                rows[-1].append(example or none("not given"))
    lost = missed(recording)
    more = f"; and {len(lost) - LOST} more" if len(lost) > LOST else ""
    return {
        "recording": recording, "events": len(events), "drawn": rows[:draw], "rest": rows[draw:],
        "unlisted": len(events) - listed, "sides": any('class="l"' in str(row) or 'class="r"' in str(row) for row in rows[:draw]),
        "boxes": letters_without_font([*recording.classes, *(event.label for event in events)])[:12],
        "lost": "; ".join(f"{label} {start:.1f} to {end:.1f} s" for label, start, end in lost[:LOST]) + more,
    }  # fmt: skip


def none(text: str) -> Any:
    """What stands in a table's cell where there is nothing."""
    return markup('<span class="none">{text}</span>', text=text)


def _when(event: ReportedEvent) -> Any:
    clock = f" · at {int(event.start) // 60}:{int(event.start) % 60:02d} min" if event.end >= 60 else ""
    span = f"{event.start:.2f} to {event.end:.2f} s"
    return markup("{span}<small>{long} s long{clock}</small>", span=span, long=f"{event.end - event.start:.1f}", clock=clock)


def _verdict(event: ReportedEvent, known: str | None) -> Any:
    if known == str(event.label):
        return markup('<span class="good">✓ agrees</span>')
    return markup('<span class="bad">✗ {said}</span>', said="nothing known here" if known is None else f"is {known}")


def by_setting(report: RecognitionReport, measured: Mapping[str, Any]) -> dict[str, Any]:
    """The page's table of settings, with the method that was compared, where one was."""
    guess = 1 / len(measured["confusion"]["labels"])
    rows = []
    for name, value in measured["accuracy_by_setting"].items():
        rows.append([name or "all clips", f"{measured['clips_by_setting'][name]:,}", percent(value), bar(value, guess)])
        if "baseline" in measured:
            share = measured["baseline"]["accuracy_by_setting"].get(name, np.nan)
            rows[-1] += [NONE, ""] if np.isnan(share) else [percent(share), bar(share, guess)]
    return {"settings": rows, "guess": guess, "baseline": "baseline" in measured}


def by_class(measured: Mapping[str, Any]) -> dict[str, Any]:
    """The page's table of actions, and those that are always right."""
    rows, perfect = [], []
    for name, row in measured["per_class"].items():
        if row["precision"] == row["recall"] == 1:
            perfect.append(f"{name} ({row['clips']:,})")
            continue
        wrong = confused_with(measured["confusion"], name)
        values = [none(NONE) if np.isnan(row[key]) else f"{row[key]:.2f}" for key in ("precision", "recall", "f1")]
        taken = none("none") if wrong is None else f"{wrong[0]} ({wrong[1]})"
        rows.append([name, f"{row['clips']:,}", *values, bar(0.0 if np.isnan(row["f1"]) else row["f1"]), taken])
    return {"classes": rows, "perfect": ", ".join(perfect)}


def duration(seconds: float) -> str:
    """Seconds as a reader says them.

    Example:
        >>> duration(12.34), duration(75), duration(7500)
        ('12.3 s', '1 min 15 s', '2 h 5 min')
    """
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes = round(seconds / 60) if seconds >= 3600 else int(seconds) // 60
    return f"{minutes // 60} h {minutes % 60} min" if seconds >= 3600 else f"{minutes} min {int(seconds) % 60} s"


def percent(value: float) -> str:
    """A share in percent."""
    return f"{100 * value:.1f}%"


def _plain(value: Any) -> str:
    if isinstance(value, (bool, np.bool_)):
        return "yes" if value else "no"
    if value is None or not np.isfinite(value):
        return NONE
    return f"{value:,}" if isinstance(value, (int, np.integer)) else f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def timeline_name(index: int) -> str:
    """File name of the picture of the recording with this index (from 0)."""
    return "timeline.png" if index == 0 else f"timeline-{index + 1}.png"


def events_csv(recordings: Sequence[RecordingResult]) -> str:
    """All events as CSV: ``file,label,start,end,score,margin``; seconds with 3 decimals, an empty cell for no number."""
    rows = [
        [
            _cell(recording.name),
            _cell(event.label),
            f"{event.start:.3f}",
            f"{event.end:.3f}",
            *map(_number, (event.score, event.margin)),
        ]
        for recording in recordings
        for event in sorted(recording.events, key=lambda event: event.start)
    ]
    return table_csv(["file", "label", "start", "end", "score", "margin"], rows)


def _cell(value: object) -> str:
    """A name as a cell.  Spreadsheets run text that begins like a formula; an apostrophe keeps it text.  Numbers stay numbers."""
    text = str(value)
    is_number = isinstance(value, numbers.Number)
    return f"'{text}" if not is_number and text.lstrip(" ")[:1] in tuple("=+-@\t\r\n") else text


def _number(value: float) -> str:
    return f"{value:.6g}" if value is not None and np.isfinite(value) else ""
