"""The report on recognition: what was found in recordings, and how well clips are recognized."""

from __future__ import annotations

import csv
import io
import numbers
from collections.abc import Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from indexing import files
from indexing.clip import Clip
from indexing.report import pictures
from indexing.report.canvas import DARK, LIGHT, letters_without_font, strip
from indexing.report.page import Card, Column, bar, cards, details, escape, even, made_by, page, picture, section, settings, table
from indexing.report.pictures import timeline_tips
from indexing.report.results import RecognitionReport, RecordingResult, ReportedEvent, confused_with, measure, missed, overlapping

# ----------------------------------------------------------------------------------------------------------------------
# The sections of the recognition report, as HTML.


TIMELINES = 12  # recordings whose timeline is drawn
STRIPS = 60  # events that are shown as stick figures, over all recordings
TIPS = 2000  # bars of a timeline that say what they are when pointed at
SCORES = (
    "Score: the evidence for the action, averaged over the time it lasts; higher is better. "
    "Margin: how far that is above the next best action; near 0 it might as well be that one."
)
NO_FONT = "No font of this computer has {}: boxes stand for them in the picture; with Noto Sans CJK installed they are drawn."
NONE = "n/a"  # shown where a number does not exist
ROWS = 1000  # events that are listed, over all recordings
Pictures = Mapping[str, tuple[bytes, bytes]]  # file name -> PNG for light and for dark screens


def body(report: RecognitionReport, measured: Mapping[str, Any], drawn: Pictures) -> str:
    """The page's sections: headline numbers, recordings, settings, actions, confusion, and how the report was made."""
    parts = [cards(_headline(report, measured)), _notes(report)]
    if report.evaluations:
        parts.append(_by_setting(report, measured))
    timelines = [pair for name, pair in drawn.items() if name.startswith("timeline")]
    before = 0
    for index, recording in enumerate(report.recordings):
        parts.append(_recording(report, recording, timelines[index] if index < len(timelines) else None, before))
        before += len(recording.events)
    if report.evaluations:
        parts += [_by_class(measured), _confusion(measured, drawn["confusion.png"])]
    if not report.recordings and not report.evaluations:
        parts.append(section("Nothing to show", "", "The report holds neither recordings nor evaluations."))
    if report.manifest:
        note = "What was run, with which versions and on which files: enough to run it again."
        parts.append(section("How this was made", details("Settings, versions and inputs", settings(report.manifest)), note))
    return "\n".join(part for part in parts if part)


def describe(report: RecognitionReport, measured: Mapping[str, Any]) -> str:
    """The report in plain words, from its numbers."""
    words = []
    if report.recordings:
        where = f"{_count(measured['recordings'], 'recording')} ({_duration(measured['seconds'])} in all)"
        kinds = measured["events_by_class"]
        if not measured["events"]:
            words.append(f"No action was found in {where}.")
        else:
            most, *others = kinds  # most frequent first
            often = f", most often {most} ({kinds[most]} times)" if others and kinds[most] > kinds[others[0]] else ""
            were = "was" if measured["events"] == 1 else "were"
            words.append(f"{_count(measured['events'], 'action')} of {_count(len(kinds), 'kind')} {were} found in {where}{often}.")
        if measured.get("known_events"):
            got = measured["known_events"] - measured["missed_events"]
            words.append(f"Of {_count(measured['known_events'], 'known action')}, {got} overlap a find of the same name.")
    if report.evaluations:
        by_setting = measured["accuracy_by_setting"]
        right = round(measured["accuracy"] * measured["clips"])
        words.append(
            f"{right} of {_count(measured['clips'], 'clip')} ({_percent(measured['accuracy'])}) were recognized, "
            f"among {_count(len(measured['confusion']['labels']), 'action')}."
        )
        if len(by_setting) > 1:
            best, worst = max(by_setting, key=by_setting.__getitem__), min(by_setting, key=by_setting.__getitem__)
            if by_setting[best] > by_setting[worst]:
                words.append(
                    f"Best setting: {best} ({_percent(by_setting[best])}); worst: {worst} ({_percent(by_setting[worst])})."
                )
    return " ".join(words)


def _headline(report: RecognitionReport, measured: Mapping[str, Any]) -> list[Card]:
    items = []
    if report.evaluations:
        low, high = measured["accuracy_interval"]
        number = len(measured["confusion"]["labels"])
        items += [
            Card("Accuracy", _percent(measured["accuracy"]), f"95% interval {100 * low:.0f} to {100 * high:.0f}%"),
            Card("Clips tested", f"{measured['clips']:,}", f"{_count(number, 'action')}; guessing gets {_percent(1 / number)}"),
            Card("Mean F1", f"{measured['macro_f1']:.2f}", "over actions; 1 is perfect"),
        ]
    if report.recordings:
        kinds = f"of {_count(len(measured['events_by_class']), 'kind')}"
        if "false_events" in measured:
            kinds += f"; {measured['false_events']:,} of them false: something else, or nothing known there"
        items.append(Card("Actions found", f"{measured['events']:,}", kinds))
        if measured.get("known_events"):
            got = measured["known_events"] - measured["missed_events"]
            items.append(Card("Known actions hit", f"{got} of {measured['known_events']}", "overlap a find of the same name"))
            every = _percent(measured["frame_agreement"])
            note = f"in known actions, by the best score; {every} of all frames, by what was reported"
            items.append(Card("Frames right", _percent(measured["frame_accuracy"]), note))
        items.append(Card("Searched", _duration(measured["seconds"]), f"in {_count(measured['recordings'], 'recording')}"))
    for name, value in report.metrics.items():
        if isinstance(value, (int, float, str, np.number, np.bool_)) and measured.get(name) is value:
            items.append(Card(str(name).replace("_", " ").capitalize(), value if isinstance(value, str) else _plain(value)))
    return items


def _notes(report: RecognitionReport) -> str:
    lines = "".join(f"<li>{escape(note)}</li>" for note in report.notes)
    return section("Please note", f"<ul>{lines}</ul>") if lines else ""


def _recording(report: RecognitionReport, recording: RecordingResult, drawn: tuple[bytes, bytes] | None, before: int) -> str:
    number = len(recording.events)
    parts = []
    if drawn is not None:
        what = "Each row is an action: the stronger its colour, the better it fits at that moment; frames mark what was reported. "
        known = "" if recording.truth is None else "Known actions are below the found ones."
        alt = f"Timeline of {recording.name}: {_count(number, 'found action')} over {_duration(recording.duration)}"
        tips = timeline_tips(recording.times, recording.classes, recording.events, recording.truth)
        parts.append(picture(drawn[0], alt, dark=drawn[1], caption=what + known, tips=tips[:TIPS]))
        boxes = letters_without_font([*recording.classes, *(event.label for event in recording.events)])
        if boxes:
            parts.append(f'<p class="note">{escape(NO_FONT.format(boxes[:12]))}</p>')
    else:
        parts.append(f'<p class="note">No timeline: only those of the first {TIMELINES} recordings are drawn.</p>')
    lost = missed(recording)
    if lost:
        listed = "; ".join(f"{label} {start:.1f} to {end:.1f} s" for label, start, end in islice(lost, 12))
        more = f"; and {len(lost) - 12} more" if len(lost) > 12 else ""
        parts.append(f'<p class="note">Known, but not found: {escape(listed + more)}.</p>')
    parts.append(_events(report, recording, before) if number else '<p class="note">Nothing was found in this recording.</p>')
    note = f"{_count(number, 'action')} found in {_duration(recording.duration)}."
    return section(recording.name or "Recording", "".join(parts), note)


def _events(report: RecognitionReport, recording: RecordingResult, before: int) -> str:
    events = sorted(recording.events, key=lambda event: event.start)
    draw = max(0, min(len(events), STRIPS - before)) if recording.clip is not None else 0
    listed = max(0, min(len(events), ROWS - before))
    columns = [Column("Action"), Column("Time", "time"), Column("Score", "number"), Column("Margin", "number")]
    if recording.truth is not None:
        columns.append(Column("Known", "name"))
    plain, shown = list(columns), []
    scores, margins = even([event.score for event in events[:listed]]), even([event.margin for event in events[:listed]])
    for event, score, margin in zip(events[:listed], scores, margins, strict=True):
        shown.append([escape(event.label), _when(event), score, margin])
        if recording.truth is not None:
            shown[-1].append(_verdict(event, overlapping(event, recording.truth)))
    if draw and recording.clip is not None:
        columns += [Column("Found", "strips")] + [Column("Its example", "strips")] * bool(report.exemplars)
        for row, event in zip(shown[:draw], events, strict=False):
            row += [_found(recording.clip, event)] + [_example(report.exemplar(event), event)] * bool(report.exemplars)
    html = table(columns, shown[:draw], caption=f"Actions found in {recording.name}", css="stack") if draw else ""
    if draw:
        html += _legend(html)
    html = f'<p class="note">{escape(SCORES)}</p>{html}'
    if listed > draw:
        rest = table(plain, shown[draw:], caption=f"Further actions found in {recording.name}", css="stack")
        left = f"{listed - draw} more without pictures (figures are drawn for {STRIPS} at most)"
        html += details(left, rest) if draw else rest
    if listed and not draw and recording.clip is not None:
        html += f'<p class="note">Figures are drawn for the first {STRIPS} actions of the report only.</p>'
    if len(events) > listed:
        html += f'<p class="note">{len(events) - listed} further actions are listed in events.csv only.</p>'
    return html


def _found(clip: Clip, event: ReportedEvent) -> str:
    alt = f"Key frames of {event.label} found at {event.start:.1f} to {event.end:.1f} s"
    return strip(clip, event.start, event.end, alt=alt) or '<span class="none">no joint seen</span>'


def _example(clip: Clip | None, event: ReportedEvent) -> str:
    drawn = strip(clip, alt=f"Key frames of the example of {event.label}") if clip is not None else ""
    return drawn or '<span class="none">not given</span>'


def _legend(html: str) -> str:
    if 'class="l"' not in html and 'class="r"' not in html:
        return ""
    key = '<svg class="key" viewBox="0 0 10 3" aria-hidden="true"><rect class="{}" width="10" height="3" rx="1.5"/></svg>'
    return f'<p class="note">{key.format("l")} left limbs &ensp;{key.format("r")} right limbs</p>'


def _verdict(event: ReportedEvent, known: str | None) -> str:
    if known == str(event.label):
        return '<span class="good">✓ agrees</span>'
    return f'<span class="bad">✗ {"nothing known here" if known is None else f"is {escape(known)}"}</span>'


def _by_setting(report: RecognitionReport, measured: Mapping[str, Any]) -> str:
    values = measured["accuracy_by_setting"]
    guess = 1 / len(measured["confusion"]["labels"])
    rows = [
        [escape(name or "all clips"), f"{measured['clips_by_setting'][name]:,}", _percent(value), bar(value, guess)]
        for name, value in values.items()
    ]
    columns = [Column("Setting"), Column("Clips", "number"), Column("Accuracy", "number"), Column("0 to 100%", "wide")]
    note = f"Share of clips recognized. The tick is what guessing would reach ({_percent(guess)})."
    plain = measured.get("baseline")
    if plain:
        name, how = report.baseline
        columns += [Column(name, "number"), Column(f"{name}, 0 to 100%", "wide")]
        for row, setting in zip(rows, values, strict=True):
            share = plain["accuracy_by_setting"].get(setting, np.nan)
            row += [NONE, ""] if np.isnan(share) else [_percent(share), bar(share, guess)]
        note += f" {name}, for comparison: {how}." if how else ""
    return section("Accuracy by setting", table(columns, rows, css="stack"), note) if len(values) > 1 or "" not in values else ""


def _by_class(measured: Mapping[str, Any]) -> str:
    rows, perfect = [], []
    for name, row in measured["per_class"].items():
        if row["precision"] == row["recall"] == 1:
            perfect.append(f"{name} ({row['clips']:,})")
            continue
        wrong = confused_with(measured["confusion"], name)
        taken = f"{escape(wrong[0])} ({wrong[1]})" if wrong else '<span class="none">none</span>'
        values = [_share(row[key]) for key in ("precision", "recall", "f1")]
        rows.append([escape(name), f"{row['clips']:,}", *values, bar(0.0 if np.isnan(row["f1"]) else row["f1"]), taken])
    columns = [Column("Action"), *(Column(name, "number") for name in ("Clips", "Precision", "Recall", "F1"))]
    columns += [Column("F1, 0 to 1", "wide"), Column("Most often taken for", "name")]
    note = "Precision: how many of the clips given this name deserve it. Recall: how many of the action's clips got its name."
    html = table(columns, rows, css="stack") if rows else ""
    if perfect:
        which = "Always recognized, and nothing else taken for them (clips in brackets): "
        html += f'<p class="note">{escape(which + ", ".join(perfect))}.</p>'
    return section("Each action", html, f"{note} F1: their harmonic mean." if rows else "")


def _confusion(measured: Mapping[str, Any], drawn: tuple[bytes, bytes]) -> str:
    number = _count(len(measured["confusion"]["labels"]), "action")
    if measured["accuracy"] == 1:
        return section("What is taken for what", "", "No action was taken for another one. The matrix is in confusion.png.")
    note = "A row per performed action, a column per answer. Numbers count clips, colour is the share of the row."
    alt = f"Confusion matrix of {number}; overall {_percent(measured['accuracy'])} are on the diagonal"
    return section("What is taken for what", picture(drawn[0], alt, dark=drawn[1]), note)


def _when(event: ReportedEvent) -> str:
    clock = f" · {_clock(event.start)}" if event.end >= 60 else ""
    return f"{event.start:.2f} to {event.end:.2f} s<small>{event.end - event.start:.1f} s long{clock}</small>"


def _clock(seconds: float) -> str:
    return f"at {int(seconds) // 60}:{int(seconds) % 60:02d} min"


def _duration(seconds: float) -> str:
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes = round(seconds / 60) if seconds >= 3600 else int(seconds) // 60
    return f"{minutes // 60} h {minutes % 60} min" if seconds >= 3600 else f"{minutes} min {int(seconds) % 60} s"


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def _percent(value: float) -> str:
    return f"{100 * value:.1f}%"


def _share(value: float) -> str:
    return f'<span class="none">{NONE}</span>' if np.isnan(value) else f"{value:.2f}"


def _plain(value: Any) -> str:
    if isinstance(value, (bool, np.bool_)):
        return "yes" if value else "no"
    if value is None or not np.isfinite(value):
        return NONE
    return f"{value:,}" if isinstance(value, (int, np.integer)) else f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


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
