"""Tables that BORIS exports, as TSV or CSV: tabular events (a row for each START, STOP and point), aggregated ones (one a label).

Older versions put the observation above the table; newer ones repeat it in every row.  Times are on the clock of the observation,
on which files run after each other; only newer versions say how long each is (``Media duration (s)``).
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from indexing.labels.format import (
    NUM_HEADER_ROWS,
    Gathering,
    LabelFormat,
    Request,
    Span,
    base_name,
    list_few,
    of_recording,
    parse_seconds,
    split_by_media,
)
from indexing.labels.formats.boris import MACHINE, Entry, Interval, add_interval, join_comments
from indexing.labels.label import LabelFile
from indexing.opening import Row, count, error, listing, quote

COLUMNS = {
    "observation": ("observation id",),
    "subject": ("subject",),
    "code": ("behavior", "behaviour"),
    "kind": ("status", "behavior type", "behaviour type"),
    "time": ("time",),
    "start": ("start (s)",),
    "stop": ("stop (s)",),
    "media": ("media file name", "media file path", "media file"),
    "source": ("source",),
    "lengths": ("media duration (s)",),
    "offset": ("time offset (s)",),
    "description": ("description",),
    "comment": ("comment", "comment start"),
    "comment_stop": ("comment stop",),
}
NOTHING = ("", "NA", "Not found", "nan")
NOBODY = "No focal subject"
PLAYER = re.compile(r"[|\s]*player #\d+\s*:", re.IGNORECASE)
REMEDY = "export the events again from BORIS, or give its project (.boris)"


@dataclass
class Sitting:
    """An observation."""

    name: str
    offset: float = 0.0
    files: dict[str, None] = field(default_factory=dict)
    beside: list[str] = field(default_factory=list)
    lengths: list[float] = field(default_factory=list)
    stretches: list[tuple[Interval, str]] = field(default_factory=list)
    begun: dict[tuple[str, str, str], tuple[Entry, str]] = field(default_factory=dict)
    timeless: int = 0
    stray: list[str] = field(default_factory=list)


def read(rows: list[Row], asked: Request) -> LabelFile:
    """Read an exported table."""
    out = Gathering(asked, "boris_tables")
    at, columns, modifiers = _header(asked, rows)
    above = {cells[0].strip().lower(): cells[1].strip() for _, cells in rows[:at] if len(cells) > 1 and cells[0].strip()}
    sittings: dict[str, Sitting] = {}
    for line, cells in rows[at + 1 :]:
        row = {name: cells[i].strip() if i < len(cells) else "" for name, i in columns.items()}
        name = row.get("observation") or above.get("observation id", "")
        if name not in sittings:
            offset = row.get("offset") or above.get("time offset (s)", "")
            sittings[name] = _sitting(out, name, offset, row, f"line {line}")
            if name and (row.get("description") or above.get("description", "")).startswith(MACHINE):
                out.machine.setdefault(name)
        _row(out, sittings[name], row, [cells[i].strip() for i in modifiers if i < len(cells)], f"line {line}")
    for sitting in sittings.values():
        out.media.update(dict.fromkeys([*sitting.files, *sitting.beside]))
        if sitting.name:
            out.observations.setdefault(sitting.name)
    mine = of_recording(out.media, asked)
    for sitting in sittings.values():
        _place(out, sitting, mine)
    return out.finish()


def _header(asked: Request, rows: Sequence[Row]) -> tuple[int, dict[str, int], list[int]]:
    """Which row names the columns, where each column stands, and those of modifiers."""
    for at, (_, cells) in enumerate(rows):
        names = [cell.strip().lower() for cell in cells]
        first = {column: next((name for name in known if name in names), None) for column, known in COLUMNS.items()}
        columns = {column: names.index(name) for column, name in first.items() if name is not None}
        if "code" in columns and ("time" in columns or {"start", "stop"} <= columns.keys()):
            if "time" in columns and "start" not in columns and "kind" not in columns:
                raise error(asked.path, "has no column 'Behavior type' or 'Status', which tells START from STOP", REMEDY)
            return at, columns, [i for i, name in enumerate(names) if name == "modifiers" or name.startswith("modifier #")]
    raise error(asked.path, "has no row with the columns 'Behavior' and 'Time', or 'Start (s)' and 'Stop (s)'", REMEDY)


def _sitting(out: Gathering, name: str, offset: str, row: dict[str, str], where: str) -> Sitting:
    """An observation with the files that it plays, where its rows say so."""
    sitting = Sitting(name, 0.0 if offset in NOTHING else out.seconds(offset, where, "column 'Time offset (s)':"))
    source, lengths = row.get("source", ""), row.get("lengths", "").split("|")
    players = PLAYER.split(source)[1:]
    if not players:  # before BORIS named the player, where there was one
        own = base_name(row.get("media", ""))
        players = [source] if own and own in map(base_name, source.split(";")) else []
    for number, player in enumerate(players):
        files = [one.strip() for one in player.split(";") if one.strip()]
        if number == 0:
            sitting.files.update(dict.fromkeys(files))
            sitting.lengths = [length for length in map(parse_seconds, lengths[0].split(";")) if length > 0]
        else:
            sitting.beside += files
    return sitting


def _row(out: Gathering, sitting: Sitting, row: dict[str, str], modifiers: list[str], where: str) -> None:
    """A label, or what begins or ends one."""
    media = "" if row.get("media", "") in NOTHING else row["media"]
    media = next((name for name in sitting.files if name == media or base_name(name) == media), media)
    if media:
        sitting.files.setdefault(media)
    subject = "" if row.get("subject", "") == NOBODY else row.get("subject", "")
    key = subject, row["code"], "|".join(modifiers).strip("|")
    times = [row.get(name, "") for name in (("start", "stop") if "start" in row else ("time",))]
    if any(time in NOTHING for time in times):
        sitting.timeless += 1
        return
    start, *stops = (out.seconds(time, where, "time") for time in times)
    comment = "" if row.get("comment", "") in NOTHING else row.get("comment", "")
    if stops:
        stop = "" if row.get("comment_stop", "") in NOTHING else row["comment_stop"]
        sitting.stretches.append((Interval(start, stops[0], key, join_comments(comment, stop)), media))
        return
    _event(out, sitting, Entry(start, key, comment), row["kind"].upper(), media, where)


def _event(out: Gathering, sitting: Sitting, event: Entry, kind: str, media: str, where: str) -> None:
    """A row of tabular events."""
    of = f"{event.key[1]} at {event.time:.6g} s"
    if kind == "POINT":
        sitting.stretches.append((Interval(event.time, event.time, event.key, event.comment), media))
    elif kind == "START":
        if event.key in sitting.begun:
            sitting.stray.append(f"{event.key[1]} at {sitting.begun[event.key][0].time:.6g} s")
        sitting.begun[event.key] = event, media
    elif kind == "STOP":
        if event.key in sitting.begun:
            begin, first = sitting.begun.pop(event.key)
            sitting.stretches.append(
                (Interval(begin.time, event.time, event.key, join_comments(begin.comment, event.comment)), first)
            )
        else:
            sitting.stray.append(of)
    else:
        raise error(out.asked.path, f"{where}: {quote(kind)} is none of START, STOP and POINT", REMEDY)


def _place(out: Gathering, sitting: Sitting, mine: set[str] | None) -> None:
    """The labels of an observation, on the clock of the file that is played then."""
    where = f"observation {sitting.name!r}" if sitting.name else "the observation"
    stray = sitting.stray + [f"{event.key[1]} at {event.time:.6g} s" for event, _ in sitting.begun.values()]
    if stray:
        lone = f"START without STOP, or the other way round ({list_few(stray)})"
        out.note(f"{where}: {count(len(stray), 'event')} left out: {lone}")
    if sitting.timeless:
        out.note(f"{where}: {count(sitting.timeless, 'event')} left out: of pictures without a time")
    if mine is not None and mine & set(sitting.beside) and not mine & set(sitting.files):
        message = f"{where} plays {listing(mine)} beside {listing(sitting.files)}, and the table does not say how they are shifted"
        raise error(out.asked.path, message, "give the project (.boris)")
    spans = _spans(sitting)
    lost: Counter[str] = Counter()
    for number, (stretch, media) in enumerate(sorted(sitting.stretches, key=lambda pair: pair[0].start), start=1):
        start, end = stretch.start - sitting.offset, stretch.end - sitting.offset
        pieces = split_by_media(start, end, spans) if spans else [(media, start, end)]
        if not spans and len(sitting.files) > 1 and media != next(iter(sitting.files)):
            lost[media] += 1
            continue
        pieces = [piece for piece in pieces if mine is None or not piece[0] or piece[0] in mine]
        add_interval(out, stretch, pieces, sitting.name, f"{where}, label {number}")
    if lost:
        message = f"of {list_few(lost)}, which is not played first, and the table does not say how long the first is"
        if mine is not None and mine & lost.keys():
            raise error(out.asked.path, f"{where} has labels {message}", "give the project (.boris)")
        out.note(f"{where}: {count(sum(lost.values()), 'label')} left out: {message}; the project (.boris) does")


def _spans(sitting: Sitting) -> list[Span]:
    """When which file is played; empty where several are, and nobody knows."""
    files = list(sitting.files)
    if len(files) == 1:
        return [Span(files[0])]
    if not files or len(sitting.lengths) != len(files):
        return []
    spans, begin = [], 0.0
    for number, (name, length) in enumerate(zip(files, sitting.lengths, strict=True)):
        spans.append(Span(name, begin, math.inf if number == len(files) - 1 else begin + length))
        begin += length
    return spans


def matches(rows: list[Row]) -> bool:
    """A table with a row of names of columns that BORIS has, below what it is about."""
    for _, cells in rows[:NUM_HEADER_ROWS]:
        names = {cell.strip().lower() for cell in cells}
        kind = names & {"behavior type", "status", "observation id", "media file name", "media file path", "media file"}
        if names & {"behavior", "behaviour"} and names & {"start (s)", "time"} and kind:
            return True
    return False


FORMAT = LabelFormat("an exported table of BORIS", ("table",), read, matches, order=30)
