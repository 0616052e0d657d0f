"""The report on recognition: what was found in recordings, and how well clips are recognized."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from indexing import files
from indexing.opening import count
from indexing.report import pictures
from indexing.report.canvas import Theme, letters_without_font, strip
from indexing.report.page import Picture, Script, bar, even, markup, table_csv, time_cell
from indexing.report.player import Player, players
from indexing.report.results import (
    COUNTS,
    MEANING,
    RecognitionReport,
    RecordingResult,
    ReportedEvent,
    by_recording,
    cell,
    confused_with,
    count_row,
    held_rows,
    held_sentences,
    measure,
    missed_actions,
    overlapping,
    repetition_rows,
    repetitions_csv,
    seconds,
)
from indexing.report.summary import Summary, Table, register_page, write_report

FILES = ("report.html", "metrics.json", "manifest.json", "events.csv", "repetitions.csv", "confusion.png", "timeline.png")
TIMELINES = 12  # recordings, or people in them, whose timeline is drawn, and recordings that have a player
STRIPS = 60  # events that are shown as stick figures, over all recordings
TIPS = 2000  # bars of a timeline that say what they are when pointed at
ROWS = 1000  # events that are listed, over all recordings
PERFORMANCES = 400  # performances that are listed of a recording
MISSED = 5  # known actions that were not found and are printed
LOST = 12  # known actions that were not found and are listed
EVENTS_HEAD = ("file", "label", "start", "end", "score", "margin", "person")
NONE = "n/a"  # shown where a number does not exist
OURS = r"confusion\.(png|csv)|timeline(-\d+)?\.png|hits\.csv|events\.csv|repetitions\.csv"  # of this and other reports on actions


@register_page(RecognitionReport, "recognition", FILES, OURS)
def summarize(report: RecognitionReport) -> Summary:
    """Everything that is said of what was found in recordings, and of how well clips are recognized."""
    measured, recordings = measure(report), report.recordings
    tables = [_events_table(recordings), _counts_table(recordings)] if recordings else []
    closing = (
        [*held_sentences(recordings), _search_sentence(report, measured), *_truth_sentences(report, measured)] if recordings else []
    )
    drawn: dict[str, Any] = {name: partial(_timeline, one, span) for name, one, span in _timelines(recordings)}
    if report.evaluations:
        tables += _evaluation_tables(measured)
        closing += _evaluation_sentences(report, measured)
        confusion = measured["confusion"]
        drawn["confusion.png"] = lambda theme: pictures.confusion(confusion["counts"], confusion["labels"])
    counted = any(one.repetitions is not None for one in recordings)
    return Summary(
        headline=report.summary or describe(report, measured), cards=headline(report, measured),
        tables=[table for table in tables if table.rows], closing=closing,
        notes=report.notes, pictures=drawn,
        files={
            **({"events.csv": partial(events_csv, recordings)} if recordings else {}),
            **({"repetitions.csv": partial(repetitions_csv, recordings)} if counted else {}),
            "metrics.json": lambda: measured, files.MANIFEST: lambda: report.manifest,
        },
        values=partial(page_values, report, measured),
    )  # fmt: skip


def write_recognition(folder: str | Path, report: RecognitionReport) -> Path:
    """Write a report into a folder: ``report.html`` and the numbers and pictures it shows, as files.

    ``report.html`` (one file that needs no other), ``metrics.json``, ``manifest.json``; for recordings ``events.csv``,
    ``repetitions.csv`` where performances were counted, and ``timeline.png`` (``timeline-2.png``... for further ones, and for
    further people); for evaluations ``confusion.png``.  Every file is written whole
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
    return write_report(folder, report)


def page_values(report: RecognitionReport, measured: Mapping[str, Any]) -> dict[str, Any]:
    """What the page says of each recording, its tables of settings and actions, and the player's script."""
    recordings = of_recordings(report)
    values: dict[str, Any] = {
        "shown": recordings, "measured": measured, "percent": percent, "duration": duration, "TIMELINES": TIMELINES,
        "STRIPS": STRIPS,
        "script": Script("player.js") if any(one["player"] is not None for one in recordings) else None,
    }  # fmt: skip
    return values | (by_setting(report, measured) | by_class(measured) if report.evaluations else {})


# ----------------------------------------------------------------------------------------------------------------------
# Tables and sentences of the terminal.


def _events_table(results: Sequence[RecordingResult]) -> Table:
    """The events, with the recording and the person where there are several."""
    events = [(result, event) for result in results for event in result.events]
    scores, margins = even([event.score for _, event in events]), even([event.margin for _, event in events])
    columns, cells_of = _person_columns(results)
    rows = [
        [*cells_of(result), str(event.label), f"{event.start:.2f}", f"{event.end:.2f}", score, margin]
        for (result, event), score, margin in zip(events, scores, margins, strict=True)
    ]
    return Table([*columns, "action", "start (s) ", "end (s) ", "score ", "margin "], rows)


def _counts_table(results: Sequence[RecordingResult]) -> Table:
    """How often each action was performed, and how."""
    columns, cells_of = _person_columns(results)
    return Table(
        [*columns, *COUNTS], [[*cells_of(result), *count_row(each)] for result in results for each in result.repetitions or ()]
    )


def _person_columns(results: Sequence[RecordingResult]) -> tuple[list[str], Callable[[RecordingResult], list[str]]]:
    """Headings that tell recordings and people apart, where there are several, and a result's cells below them."""
    columns = {"recording": len({result.name for result in results}) > 1, "person": any(result.person for result in results)}
    return (
        [name for name, several in columns.items() if several],
        lambda result: [result.name] * columns["recording"] + [result.person] * columns["person"],
    )


def _search_sentence(report: RecognitionReport, measured: Mapping[str, Any]) -> str:
    """What was found, where, and how long it took; of a recording with several people, its length counts once."""
    where = f"{count(measured['recordings'], 'recording')} ({measured['seconds']:.1f} s long)"
    who = f" of {count(measured['people'], 'person', 'people')}" if measured["people"] else ""
    actions = count(measured["events"], "action") if measured["events"] else "no action"
    return f"{actions}{who} found in {where} in {report.timings.get('scan', 0.0):.1f} s"


def _truth_sentences(report: RecognitionReport, measured: Mapping[str, Any]) -> list[str]:
    """How many of the known actions an event of the same name overlaps, which are missed, and how much of what is reported is
    right."""
    if "known_events" not in measured:
        return []
    missed = [action for result in report.recordings for action in missed_actions(result)]
    named = ", ".join(f"{label} at {start:.2f} to {end:.2f} s" for label, start, end in missed[:MISSED])
    more = f" and {len(missed) - MISSED} more" if len(missed) > MISSED else ""
    known = measured["known_events"]
    sentence = f"{known - len(missed)} of {count(known, 'known action')} found" + (f"; missed: {named}{more}" if missed else "")
    shares = [f"{name} {measured[name]:.3f}" for name in ("precision", "recall") if not np.isnan(measured[name])]
    right = (
        f"{measured['right_events']} of {measured['compared_events']} reported share half of their time or more with a known one"
    )
    return [sentence, *[f"{right} ({', '.join(shares)})"] * bool(shares)]


def _evaluation_tables(measured: Mapping[str, Any]) -> list[Table]:
    """Recall and precision of each action, and the accuracy by setting and group."""
    rows = []
    for name, row in measured["per_class"].items():
        wrong = confused_with(measured["confusion"], name)
        taken = f"{wrong[0]} ({wrong[1]})" if wrong else ""
        if row["clips"]:
            rows.append([name, row["clips"], f"{row['recall']:.3f}", f"{row['precision']:.3f}", taken])
    by_setting = measured["accuracy_by_setting"]
    accuracy = by_setting | {name: value for name, value in measured.get("accuracy_by_group", {}).items() if name not in by_setting}
    settings = [[name, f"{value:.3f}"] for name, value in accuracy.items()] if set(accuracy) != {""} else []
    return [
        Table(["action", "clips ", "recall ", "precision ", "most often taken for"], rows),
        Table(["setting", "accuracy "], settings),
    ]


def _evaluation_sentences(report: RecognitionReport, measured: Mapping[str, Any]) -> list[str]:
    """The accuracy over all clips with its interval, and the time that it took."""
    low, high = measured["accuracy_interval"]
    learn, recognize = (report.timings.get(step, 0.0) for step in ("learn", "recognize"))
    return [
        f"accuracy {measured['accuracy']:.3f} ({measured['clips']:,} clips; 95 % interval {low:.3f} to {high:.3f})",
        f"learned in {learn:.1f} s, recognized in {recognize:.1f} s",
    ]


def describe(report: RecognitionReport, measured: Mapping[str, Any]) -> str:
    """The report in plain words, from its numbers."""
    words = []
    if report.recordings:
        where = f"{count(measured['recordings'], 'recording')} ({duration(measured['seconds'])} in all)"
        kinds = measured["events_by_class"]
        who = f" of {count(measured['people'], 'person', 'people')}" if measured["people"] else ""
        if not measured["events"]:
            words.append(f"No action{who} was found in {where}.")
        else:
            most, *others = kinds  # most frequent first
            often = f", most often {most} ({kinds[most]} times)" if others and kinds[most] > kinds[others[0]] else ""
            were = "was" if measured["events"] == 1 else "were"
            words.append(
                f"{count(measured['events'], 'action')} of {count(len(kinds), 'kind')}{who} {were} found in {where}{often}."
            )
        if measured.get("known_events"):
            got = measured["known_events"] - measured["missed_events"]
            words.append(f"Of {count(measured['known_events'], 'known action')}, {got} overlap a find of the same name.")
        if measured["withheld"]:
            reasons = ", ".join(f"{number:,} {reason}" for reason, number in measured["withheld"].items())
            words.append(f"Held back: {reasons}.")
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
        items += _of_search(measured)
    for name, value in report.metrics.items():
        if isinstance(value, (int, float, str, np.number, np.bool_)) and measured.get(name) is value:
            items.append((str(name).replace("_", " ").capitalize(), value if isinstance(value, str) else _plain_text(value), ""))
    return items


def _of_search(measured: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Headline numbers of recordings: what was reported, and how much of it is right; else who, and how often."""
    kinds = f"of {count(len(measured['events_by_class']), 'kind')}"
    if "false_events" in measured:
        kinds += f"; {measured['false_events']:,} of them false: something else, or nothing known there"
    items = [("Actions reported", f"{measured['events']:,}", kinds)]
    if measured.get("known_events"):
        right, reported, happened = measured["right_events"], measured["compared_events"], measured["known_events"]
        like = "share half of their time, or more, with a known action of their name"
        if reported:
            items.append(("Precision", percent(measured["precision"]), f"{right} of {reported} reported {like}"))
        items.append(("Recall", percent(measured["recall"]), f"{right} of {happened} known actions are reported so"))
        items.append(("Frames right", percent(measured["frame_agreement"]), "of all, by what was reported: the action, or none"))
    if "repetitions" in measured:
        often = sorted(measured["repetitions"].items(), key=lambda item: -item[1])
        shown = often if len(often) < 5 else often[:3]
        each = ", ".join(f"{number:,} {label}" for label, number in shown)
        note = each + f", and of {len(often) - 3} more" * (len(shown) < len(often)) or "nothing was performed"
        items.append(("Performances", f"{sum(measured['repetitions'].values()):,}", note))
    if measured["people"]:
        items.append(("People", f"{measured['people']:,}", "each searched by itself"))
    items.append(("Searched", duration(measured["seconds"]), f"in {count(measured['recordings'], 'recording')}"))
    return items


def _timelines(recordings: Sequence[RecordingResult]) -> list[tuple[str, RecordingResult, tuple[float, float]]]:
    """Name of the picture, person and seconds shown, of those whose timeline is drawn."""
    timelines = []
    for people in by_recording(recordings):
        span = (float(min(one.times[0] for one in people)), float(max(one.times[-1] for one in people)))
        timelines += [(one, span) for one in people]
    return [(timeline_name(i), *timeline) for i, timeline in enumerate(timelines[:TIMELINES])]


def _timeline(recording: RecordingResult, span: tuple[float, float], theme: Theme) -> Picture:
    bars = (recording.classes, recording.events, recording.truth, span)
    drawn = pictures.timeline(recording.times, recording.scores, *bars)
    return Picture(drawn, tips=pictures.timeline_tips(recording.times, *bars)[:TIPS])


def of_recordings(report: RecognitionReport) -> list[dict[str, Any]]:
    """What the page says of each recording, person by person."""
    groups = by_recording(report.recordings)
    play: list[Player | None] = [*players(groups[:TIMELINES], report), *[None] * len(groups[TIMELINES:])]
    shown: list[dict[str, Any]] = []
    index = before = 0
    for people, player in zip(groups, play, strict=True):
        lanes = []
        for recording in people:
            lanes.append({**of_recording(report, recording, before), "picture": timeline_name(index)})
            before += len(recording.events)
            index += 1
        shown.append({
            "name": people[0].name or "Recording", "lanes": lanes, "player": player, "seconds": seconds(people),
            "events": sum(len(one.events) for one in people), "held": held_rows(people), "meaning": MEANING, **counting(people),
        })  # fmt: skip
    return shown


def counting(people: Sequence[RecordingResult]) -> dict[str, Any]:
    """The tables of how often each action was performed, and of each performance; ``counted`` is false where nobody counted."""
    several = any(one.person for one in people)
    counts: list[list[Any]] = []
    performances: list[list[Any]] = []
    for one in people:
        for each in one.repetitions or ():
            head = [each.label, *[one.person] * several]
            counts.append([*head, *(text or none("none") for text in count_row(each)[1:])])
            performances += [[*head, *(text or none("none") for text in row)] for row in repetition_rows(each)]
    return {
        "counted": any(one.repetitions is not None for one in people), "several": several, "counts": counts,
        "performances": performances[:PERFORMANCES], "uncounted": max(0, len(performances) - PERFORMANCES),
    }  # fmt: skip


def of_recording(report: RecognitionReport, recording: RecordingResult, before: int) -> dict[str, Any]:
    """What the page says of one person in a recording."""
    events = sorted(recording.events, key=lambda event: event.start)
    draw = max(0, min(len(events), STRIPS - before)) if recording.clip is not None else 0
    listed = max(0, min(len(events), ROWS - before))
    scores, margins = even([event.score for event in events[:listed]]), even([event.margin for event in events[:listed]])
    rows: list[list[Any]] = []
    for number, (event, score, margin) in enumerate(zip(events[:listed], scores, margins, strict=True)):
        rows.append([event.label, time_cell(event.start, event.end), score, margin])
        if recording.truth is not None:
            rows[-1].append(_verdict(event, overlapping(event, recording.truth)))
        if number < draw:
            rows[-1] += _draw_event(report, recording, event)
    lost = missed_actions(recording)
    more = f"; and {len(lost) - LOST} more" if len(lost) > LOST else ""
    return {
        "recording": recording, "events": len(events), "drawn": rows[:draw], "rest": rows[draw:],
        "unlisted": len(events) - listed, "sides": any('class="l"' in str(row) or 'class="r"' in str(row) for row in rows[:draw]),
        "boxes": letters_without_font([*recording.classes, *(event.label for event in events)])[:12],
        "lost": "; ".join(f"{label} {start:.1f} to {end:.1f} s" for label, start, end in lost[:LOST]) + more,
    }  # fmt: skip


def _draw_event(report: RecognitionReport, recording: RecordingResult, event: ReportedEvent) -> list[Any]:
    """An event's cells with key frames: its own, and those of its example."""
    assert recording.clip is not None  # else nothing is drawn
    alt = f"Key frames of {event.label} found at {event.start:.1f} to {event.end:.1f} s"
    cells = [strip(recording.clip, event.start, event.end, alt=alt) or none("no joint seen")]
    if report.exemplars:
        clip = report.exemplar(event)
        example = strip(clip, alt=f"Key frames of the example of {event.label}") if clip is not None else ""
        cells.append(example or none("not given"))
    return cells


def none(text: str) -> Any:
    """What stands in a table's cell where there is nothing."""
    return markup('<span class="none">{text}</span>', text=text)


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
    """Seconds as a reader says them."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes = round(seconds / 60) if seconds >= 3600 else int(seconds) // 60
    return f"{minutes // 60} h {minutes % 60} min" if seconds >= 3600 else f"{minutes} min {int(seconds) % 60} s"


def percent(value: float) -> str:
    """A share in percent."""
    return f"{100 * value:.1f}%"


def _plain_text(value: Any) -> str:
    if isinstance(value, (bool, np.bool_)):
        return "yes" if value else "no"
    if value is None or not np.isfinite(value):
        return NONE
    return f"{value:,}" if isinstance(value, (int, np.integer)) else f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def timeline_name(index: int) -> str:
    """File name of the picture of the recording with this index (from 0)."""
    return "timeline.png" if index == 0 else f"timeline-{index + 1}.png"


def event_row(file: str, event: ReportedEvent, person: str) -> list[str]:
    """A row of ``events.csv``: seconds with 3 decimals, an empty cell for no number and for whoever is alone."""
    times, scores = [f"{event.start:.3f}", f"{event.end:.3f}"], map(score_text, (event.score, event.margin))
    return [cell(file), cell(event.label), *times, *scores, cell(person)]


def events_csv(recordings: Sequence[RecordingResult]) -> str:
    """All events as CSV."""
    rows = [
        event_row(recording.name, event, recording.person)
        for recording in recordings
        for event in sorted(recording.events, key=lambda event: event.start)
    ]
    return table_csv(EVENTS_HEAD, rows)


def score_text(value: float) -> str:
    """A score as a cell of CSV, empty where it is no number."""
    return f"{value:.6g}" if value is not None and np.isfinite(value) else ""
