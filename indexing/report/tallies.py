"""What is told of many performances in a few words: how often, how long and how far; and what was held back and why."""

from __future__ import annotations

import numbers
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from indexing.opening import count
from indexing.report.page import table_csv
from indexing.report.results import RecordingResult

if TYPE_CHECKING:
    from indexing.recordings.repetitions import RepetitionCount

TIMES = 3  # of what was held back that are said of each action
COUNTS = ("action", "count ", "each (s) ", "from-to (s) ", "pause (s) ", "range ")
"""Headings of :func:`count_row`; those of numbers end in a space."""
MEANING = {
    "at rest": "it looks like the action, but the person hardly moves, compared with calm moments of the action",
    "nobody there": "the person is not in view for most of it",
    "below the level": "weaker than the level that was asked for (reject)",
    "other movement": "there is movement, but it resembles the action no more than ordinary movement does",
}
"""What the reasons mean for which something is not reported."""


def count_row(one: RepetitionCount) -> list[str]:
    """Of one action: how often, seconds of each (mean, shortest to longest), mean pause between, mean range."""
    if not one.count:
        return [str(one.label), "0", "", "", "", ""]
    shortest, longest = min(one.durations), max(one.durations)
    pause = f"{np.mean(one.pauses):.2f}" if one.pauses else ""
    number = count(one.count, "cycle") if one.unit == "cycle" else f"{one.count}"
    each, reach = f"{np.mean(one.durations):.2f}", f"{np.mean(one.ranges):.2f}"
    return [str(one.label), number, each, f"{shortest:.2f}-{longest:.2f}" if one.count > 1 else "", pause, reach]


def repetition_rows(one: RepetitionCount) -> list[list[str]]:
    """Of one action, for each performance: number, start, end, seconds, pause before (empty for the first), range."""
    pauses = ["", *(f"{pause:.3f}" for pause in one.pauses)]
    return [
        [f"{number}", f"{part.start:.3f}", f"{part.end:.3f}", f"{part.end - part.start:.3f}", pause, f"{part.range:.3f}"]
        for number, (part, pause) in enumerate(zip(one.performances, pauses, strict=True), 1)
    ]


def repetitions_csv(recordings: Sequence[RecordingResult]) -> str:
    """All performances as CSV, one a row; seconds and body heights with 3 decimals."""
    head = ["file", "person", "label", "unit", "number", "start", "end", "seconds", "pause_before", "range"]
    rows = [
        [*map(cell, (recording.name, recording.person, one.label)), one.unit, *row]
        for recording in recordings
        for one in recording.repetitions or ()
        for row in repetition_rows(one)
    ]
    return table_csv(head, rows)


def cell(value: object) -> str:
    """A name as a cell.  Spreadsheets run text that begins like a formula; an apostrophe keeps it text.  Numbers stay numbers."""
    text = str(value)
    is_number = isinstance(value, numbers.Number)
    return f"'{text}" if not is_number and text.lstrip(" ")[:1] in tuple("=+-@\t\r\n") else text


def held_back(recordings: Sequence[RecordingResult]) -> dict[str, dict[str, list[tuple[RecordingResult, float]]]]:
    """Reason -> label -> where and when: what was not reported; the most frequent first."""
    found: dict[str, dict[str, list[tuple[RecordingResult, float]]]] = {}
    for recording in recordings:
        for one in recording.withheld:
            found.setdefault(one.reason, {}).setdefault(str(one.event.label), []).append((recording, one.event.start))
    reasons = sorted(found, key=lambda reason: -sum(map(len, found[reason].values())))
    return {reason: dict(sorted(found[reason].items(), key=lambda item: -len(item[1]))) for reason in reasons}


def held_times(where: Sequence[tuple[RecordingResult, float]], recordings: Sequence[RecordingResult]) -> str:
    """The first few times, with the recording where there are several, and how many more there are."""
    several = len({one.name for one in recordings}) > 1
    said = []
    for recording, start in where[:TIMES]:
        who = f" of person {recording.person}" * bool(recording.person) + f" in {recording.name}" * several
        said.append(f"{start:.2f} s{who}")
    more = len(where) - TIMES
    return ", ".join(said) + f" and {more} more" * (more > 0)


def held_sentences(recordings: Sequence[RecordingResult]) -> list[str]:
    """What was held back, a sentence for each reason."""
    out = []
    for reason, labels in held_back(recordings).items():
        each = [f"{len(where)} {label} ({held_times(where, recordings)})" for label, where in list(labels.items())[:TIMES]]
        more = len(labels) - TIMES
        out.append(f"held back, {reason}: {'; '.join(each)}" + f"; and of {count(more, 'action')} more" * (more > 0))
    return out


def held_rows(recordings: Sequence[RecordingResult]) -> list[list[Any]]:
    """The same as a table: reason, action, number, when."""
    return [
        [reason, label, f"{len(where)}", held_times(where, recordings)]
        for reason, labels in held_back(recordings).items()
        for label, where in labels.items()
    ]
