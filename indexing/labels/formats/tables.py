"""Tables of labels: CSV or TSV with ``label,start,end``, and whatever else a label has.

Names of columns are those of this package and their synonyms (``action``, ``behavior``; ``begin``, ``onset``, ``start_time``;
``stop``, ``offset``; ``person``; ``file``, ``video``).  ``duration`` may stand for ``end``, and ``start_frame`` with ``end_frame``
(the last one) for both, where somebody says how many frames a second has.  Times are in seconds, or ``hh:mm:ss.sss``.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from indexing.files import write_text
from indexing.labels.format import Gathering, LabelFormat, Request, Target, parse_seconds, parse_whole
from indexing.labels.label import Label, LabelFile, sort_key
from indexing.opening import Row, clip_text, error, listing, quote

COLUMNS = {
    "label": ("label", "action", "behavior", "behaviour", "class", "event", "code", "annotation", "value"),
    "start": ("start", "begin", "onset", "start_time", "start time", "begin_time", "begin time", "start (s)", "begin (s)"),
    "end": ("end", "stop", "offset", "end_time", "end time", "stop_time", "stop time", "end (s)", "stop (s)"),
    "duration": ("duration", "duration (s)", "length"),
    "start_frame": ("start_frame", "start frame", "first_frame", "frame_start", "begin_frame"),
    "end_frame": ("end_frame", "end frame", "last_frame", "frame_end", "stop_frame"),
    "subject": ("subject", "person", "individual", "animal", "actor", "participant"),
    "media": ("media", "file", "video", "recording", "filename", "file_name", "media file", "media_file"),
    "tier": ("tier", "track", "row"),
    "observation": ("observation", "annotator", "observer", "rater", "coder"),
    "comment": ("comment", "note", "notes"),
    "modifiers": ("modifiers", "modifier"),
    "score": ("score", "confidence"),
}
FORM = "write it as CSV in UTF-8 with the columns label,start,end"
WRITTEN = ("label", "start", "end", "subject", "media", "tier", "observation", "comment", "modifiers", "score")


def read(rows: list[Row], asked: Request) -> LabelFile:
    """Read a table."""
    out = Gathering(asked, "tables")
    columns = _columns(asked.path, rows[0][1])
    framed = "start" not in columns
    if framed and asked.fps is None:
        message = f"counts frames (column {rows[0][1][columns['start_frame']]!r}), and does not say how many a second has"
        raise error(asked.path, message, "give them (--fps)")
    for line, cells in rows[1:]:
        row = {name: cells[i].strip() if i < len(cells) else "" for name, i in columns.items()}
        where = f"line {line}"
        start, end = _frames(out, row, where) if framed else _seconds(out, row, where)
        fields: dict[str, Any] = {name: row.get(name, "") for name in ("subject", "media", "tier", "observation", "comment")}
        fields["modifiers"] = tuple(row["modifiers"].split("|")) if row.get("modifiers") else ()
        out.add(row["label"], start, end, where, score=_score(asked.path, row.get("score", ""), where), **fields)
    return out.finish()


def _columns(path: Path, header: Sequence[str]) -> dict[str, int]:
    """Where each column stands."""
    names = [cell.strip().lower() for cell in header]
    columns: dict[str, int] = {}
    for column, synonyms in COLUMNS.items():
        at = [names.index(name) for name in synonyms if name in names]
        if at:
            columns[column] = at[0]
    lacking = [] if "label" in columns else ["label"]
    if not {"start", "end"} <= columns.keys() and not {"start", "duration"} <= columns.keys():
        if {"start_frame", "end_frame"} <= columns.keys():
            columns.pop("start", None)
        else:
            lacking += [name for name in ("start", "end") if name not in columns]
    if lacking:
        raise error(path, f"has no column {lacking[0]!r} (the first line has {listing(header, 5)})", FORM)
    return columns


def _seconds(out: Gathering, row: dict[str, str], where: str) -> tuple[float, float]:
    start = out.seconds(row["start"], where, "column 'start':")
    if row.get("end"):
        return start, out.seconds(row["end"], where, "column 'end':")
    if row.get("duration"):
        return start, start + out.seconds(row["duration"], where, "column 'duration':")
    return start, out.seconds("", where, "column 'end':")


def _frames(out: Gathering, row: dict[str, str], where: str) -> tuple[float, float]:
    times = []
    for column in ("start_frame", "end_frame"):
        number = parse_whole(row[column])
        if number is None:
            message = f"{where}: column {column!r}: {quote(row[column])} is no frame number"
            raise error(out.asked.path, message, "count frames from 0")
        times.append(number / (out.asked.fps or math.nan))
    return times[0], times[1]


def _score(path: Path, text: str, where: str) -> float | None:
    if not text:
        return None
    number = parse_seconds(text)
    if not math.isfinite(number):
        raise error(path, f"{where}: column 'score': {quote(text)} is no number", "leave it empty where there is none")
    return number


def write(labels: Sequence[Label], target: Target) -> list[str]:
    """Write a table: ``label,start,end`` and the columns that some label fills; seconds to the microsecond."""
    filled = [name for name in WRITTEN if name in WRITTEN[:3] or any(getattr(one, name) not in ("", (), None) for one in labels)]
    stream = io.StringIO()
    table = csv.writer(stream, delimiter="\t" if target.format == "tsv" else ",", lineterminator="\n")
    table.writerow(filled)
    notices: dict[str, None] = {}
    for label in sorted(labels, key=sort_key):
        if any("|" in modifier for modifier in label.modifiers):
            notices[f"modifiers with | become several ({clip_text(label.modifiers, 40)})"] = None
        table.writerow([_cell(getattr(label, name)) for name in filled])
    write_text(target.path, stream.getvalue())
    return list(notices)


def _cell(value: Any) -> str:
    if isinstance(value, float | int):
        return f"{value:.6f}".rstrip("0").rstrip(".") if math.isfinite(value) else ""
    return "|".join(value) if isinstance(value, tuple) else str(value or "")


FORMAT = LabelFormat("CSV with label,start,end", ("table",), read, order=90, write=write, written={"csv": ".csv", "tsv": ".tsv"})
