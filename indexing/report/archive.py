"""Reports on an archive: what resembles a query, and where in thousands of recordings learned actions were found.

An archive may hold thousands of hours, so a page shows the best of what was found, counts the rest, and leaves the lists to
``hits.csv`` and ``events.csv``.  Hits and events play beside the query or the example: key frames in a row that slide by behind a
window of one frame, which style sheets do without a script.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from indexing import files
from indexing.clip import Clip
from indexing.opening import count
from indexing.report.canvas import WIDTH, strip
from indexing.report.page import LISTED, Script, even, markup, table_csv, time_cell
from indexing.report.pictures import colours
from indexing.report.player import Player, players
from indexing.report.recognition import EVENTS_HEAD, OURS, duration, event_row, none, score_text
from indexing.report.results import RecognitionReport, RecordingResult, by_recording, cell
from indexing.report.summary import Summary, Table, register_page

if TYPE_CHECKING:
    from indexing.archive.actions import ArchivedEvent
    from indexing.archive.archive import ArchivedRecording, ArchiveInfo
    from indexing.archive.search import Hit
    from indexing.archive.writer import Verification

PICTURED = 60  # hits, or events of all actions, that are drawn
WEIGHT = 2_000_000  # characters of drawings in a page, beyond which no more are drawn: layouts of 133 joints are heavy
LEAST, MOST = 3, 12  # events of each action that are drawn, whatever the number of actions
DOUBTFUL = 3  # of them one is of the least margin
ROWS = 1000  # hits that are listed
FIRST = 25  # recordings with finds that are listed without a click
FILM = (8, 24, 10.0)  # frames of a film at least and at most, and of each second
AROUND = 0.7  # seconds of the recording before and after what is drawn, which say where a joint should be
PLAYED, PLAYED_SECONDS = 12, 7200.0  # recordings, and seconds of them all, that have a player
MARKS = 250  # events of a recording that its line of marks shows
MAX_EVENTS_PRINTED = 100  # events that are printed: all are in the report
FILES = ("report.html", "hits.csv", "events.csv", "metrics.json", "manifest.json")
HITS_HEAD = ("rank", "file", "start", "end", "score", "person", "mirrored")


class Keeper(Protocol):
    """What pictures need of an archive."""

    def clip(self, source: str, start: float | None = None, end: float | None = None, person: str = "") -> Clip: ...


@dataclass(frozen=True, eq=False)
class SearchReport:
    """What resembles a query."""

    query: Clip
    hits: Sequence[Hit]
    archive: Keeper
    info: ArchiveInfo
    notes: Sequence[str] = ()
    seconds: float = 0.0
    mirror: bool = False
    manifest: Mapping[str, Any] = field(default_factory=dict)

    @property
    def title(self) -> str:
        """Heading of the page."""
        return f"What resembles {self.query.name or 'the query'}"


@dataclass(frozen=True, eq=False)
class FindReport:
    """Where learned actions were found in an archive."""

    classes: Sequence[Hashable]
    events: Sequence[ArchivedEvent]
    recordings: Sequence[ArchivedRecording]
    archive: Keeper
    info: ArchiveInfo
    exemplars: Mapping[Hashable, Sequence[Clip]] = field(default_factory=dict)
    notes: Sequence[str] = ()
    seconds: float = 0.0
    manifest: Mapping[str, Any] = field(default_factory=dict)

    @property
    def title(self) -> str:
        """Heading of the page."""
        return f"Actions in an archive of {count(len({one.source for one in self.recordings}), 'recording')}"


@register_page(SearchReport, "hits", FILES, OURS)
def summarize_search(report: SearchReport) -> Summary:
    """Everything that is said of what resembles a query."""
    measured = measure_search(report)
    return Summary(
        headline=_search_words(report, measured), cards=_search_cards(report, measured), tables=_hits_tables(report),
        notes=report.notes,
        closing=[f"{count(len(report.hits), 'hit')} in {size_text(report.info)}, searched in {report.seconds:.1f} s"],
        files={
            "hits.csv": partial(hits_csv, report.hits), "metrics.json": lambda: measured, files.MANIFEST: lambda: report.manifest,
        },
        values=partial(_search_values, report),
    )  # fmt: skip


def _search_values(report: SearchReport) -> dict[str, Any]:
    """The query, the hits that are drawn, and those that are listed."""
    rows = _hit_rows(report)
    scores = even([hit.score for hit in report.hits[:ROWS]])
    rest = [
        [f"{number}", hit.source, hit.person, *_when(hit.start, hit.end), score, "yes" if hit.mirrored else ""]
        for number, (hit, score) in enumerate(zip(report.hits[:ROWS], scores, strict=True), 1)
    ][len(rows) :]
    query = strip(report.query, frames=8, alt="Key frames of the query") or none("no joint seen")
    return {"query": query, "rows": rows, "rest": rest, "unlisted": max(0, len(report.hits) - ROWS), "sides": _sides(rows)}


@register_page(FindReport, "finds", FILES, OURS)
def summarize_finds(report: FindReport) -> Summary:
    """Everything that is said of where learned actions were found."""
    measured, tables = measure_finds(report), _events_tables(report)
    many = len(report.events) > MAX_EVENTS_PRINTED
    where = f"{count(len(report.events), 'action')} found in {count(measured['recordings_with_events'], 'recording')} of"
    return Summary(
        headline=_find_words(report, measured), cards=_find_cards(measured), tables=tables,
        notes=["each event, with its times, is in events.csv of a report (--report FOLDER)"] * many,
        closing=[
            f"{where if report.events else 'no action found in'} {size_text(report.info)}, searched in {report.seconds:.1f} s"
        ],
        files={
            "events.csv": partial(events_csv, report.events), "metrics.json": lambda: measured,
            files.MANIFEST: lambda: report.manifest,
        },
        values=partial(_find_values, report, measured),
    )  # fmt: skip


def _find_values(report: FindReport, measured: Mapping[str, Any]) -> dict[str, Any]:
    """Actions and recordings with finds, drawn, counted and played."""
    paint = colours([*report.classes, *(event.label for event in report.events)])
    played, actions = _event_players(report), _actions(report)
    return {
        "actions": actions, "counts": _count_rows(report), "found": _recording_rows(report, paint), "FIRST": FIRST, "paint": paint,
        "played": played, "script": Script("player.js") if played else None,
        "unlisted": max(0, measured["recordings_with_events"] - LISTED),
        "sides": any(_sides(rows) for one in actions for _, rows in one["groups"]),
    }  # fmt: skip


# ---- what the terminal prints --------------------------------------------------------------------------------------------
def size_text(info: ArchiveInfo) -> str:
    """How many sources an archive holds, and for how long."""
    return f"{count(info.sources, 'source')} ({duration(info.seconds)})"


def _hits_tables(report: SearchReport) -> list[Table]:
    hits, mirror = report.hits, report.mirror
    people, scores = any(hit.person for hit in hits), even([hit.score for hit in hits])
    rows = [
        [f"{number}", hit.source, *[hit.person] * people, *_when(hit.start, hit.end), score, *["mirrored" * hit.mirrored] * mirror]
        for number, (hit, score) in enumerate(zip(hits, scores, strict=True), 1)
    ]
    return [Table(["rank ", "source", *["person"] * people, "start (s) ", "end (s) ", "score ", *[""] * mirror], rows)] * bool(rows)


def _events_tables(report: FindReport) -> list[Table]:
    """Few events one by one; of many, how many there are of each action."""
    events = report.events
    if len(events) > MAX_EVENTS_PRINTED:
        sources: dict[str, list[str]] = {str(label): [] for label in report.classes}
        for event in events:
            sources.setdefault(str(event.label), []).append(event.source)
        rows: list[list[object]] = [[label, f"{len(where):,}", f"{len(set(where)):,}"] for label, where in sources.items()]
        return [Table(["action", "times ", "sources "], rows)]
    people = any(event.person for event in events)
    scores, margins = even([event.score for event in events]), even([event.margin for event in events])
    rows = [
        [event.source, *[event.person] * people, event.label, *_when(event.start, event.end), score, margin]
        for event, score, margin in zip(events, scores, margins, strict=True)
    ]
    return [Table(["source", *["person"] * people, "action", "start (s) ", "end (s) ", "score ", "margin "], rows)] * bool(rows)


def summarize_info(info: ArchiveInfo, recordings: Sequence[ArchivedRecording] | None = None) -> Summary:
    """What is in an archive: its layouts, or all its recordings."""
    table = Table(["joint layout", "joints ", "time "], [[name, joints, duration(s)] for name, joints, s in info.layouts])
    if recordings is not None:
        columns = ["source", "person", "start (s) ", "end (s) ", "stored (s) ", "joints"]
        rows = [[one.source, one.person, *_when(one.start, one.end), f"{one.seconds:.1f}", one.layout] for one in recordings]
        table = Table(columns, rows)
    people = f" ({count(info.recordings, 'recording')} of one person each)" * (info.recordings != info.sources)
    hours = info.seconds / 3600
    each = f", {info.size / 1e6 / hours:.1f} MB an hour" * (hours >= 1)
    closing = [
        f"{count(info.sources, 'source')}{people}, {duration(info.seconds)}, {count(info.windows, 'window')}",
        f"{info.size / 1e6:,.1f} MB in {count(info.segments, 'segment')}{each}; version {info.version}",
    ]
    if info.dead:
        closing.append(f"{count(info.dead, 'window')} of what was removed still take space; later additions take it back")
    return Summary(tables=[table], closing=closing)


def summarize_verification(verification: Verification) -> Summary:
    """Whether all of an archive is there, and what is left of interrupted additions."""
    where = f"{count(verification.windows, 'window')} in {count(verification.segments, 'segment')}"
    state = "all there, whole, and once" if verification.ok else count(len(verification.problems), "problem")
    left = count(len(verification.orphans), "file")
    note = f"{left} of interrupted additions hold nothing that is missed; the next addition takes them away"
    return Summary(notes=[note] * bool(verification.orphans), closing=[f"{where}: {state}"])


# ---- the files -----------------------------------------------------------------------------------------------------------
def hits_csv(hits: Sequence[Hit]) -> str:
    """All hits as CSV, best first: ``rank,file,start,end,score,person,mirrored``; seconds with 3 decimals."""
    rows = [
        [
            number, cell(hit.source), f"{hit.start:.3f}", f"{hit.end:.3f}", score_text(hit.score), cell(hit.person),
            "yes" if hit.mirrored else "no",
        ]
        for number, hit in enumerate(hits, 1)
    ]  # fmt: skip
    return table_csv(HITS_HEAD, rows)


def events_csv(events: Sequence[ArchivedEvent]) -> str:
    """All events as CSV, as a scan of the recordings writes them."""
    return table_csv(EVENTS_HEAD, [event_row(event.source, event, event.person) for event in events])


def measure_search(report: SearchReport) -> dict[str, Any]:
    """All numbers of a search, in JSON types."""
    scores = [hit.score for hit in report.hits]
    return {
        "hits": len(report.hits),
        "sources": len({hit.source for hit in report.hits}),
        "best_score": max(scores, default=math.nan),
        "last_score": min(scores, default=math.nan),
        "query_seconds": report.query.duration,
        "searched": {"sources": report.info.sources, "windows": report.info.windows, "seconds": report.info.seconds},
        "notes": list(report.notes),
    }


def measure_finds(report: FindReport) -> dict[str, Any]:
    """All numbers of a find, in JSON types."""
    kinds = Counter(str(event.label) for event in report.events)
    kinds.update(dict.fromkeys(map(str, report.classes), 0))
    where: dict[str, set[str]] = {}
    for event in report.events:
        where.setdefault(str(event.label), set()).add(event.source)
    return {
        "events": len(report.events),
        "events_by_class": dict(kinds.most_common()),
        "recordings_by_class": {label: len(where.get(label, ())) for label, _ in kinds.most_common()},
        "recordings": len({one.source for one in report.recordings}),
        "recordings_with_events": len({event.source for event in report.events}),
        "people": sum(bool(one.person) for one in report.recordings),
        "seconds": float(sum(one.seconds for one in report.recordings)),
        "notes": list(report.notes),
    }


# ---- what both pages share -----------------------------------------------------------------------------------------------
def _when(start: float, end: float) -> tuple[str, str]:
    return f"{start:.2f}", f"{end:.2f}"


def _who(source: str, *more: str) -> Any:
    """A recording, and in small print whatever else is to be said of it."""
    small = " · ".join(word for word in more if word)
    return markup('{name}<small class="quiet">{small}</small>', name=source, small=small) if small else source


def _sides(rows: Sequence[Sequence[Any]]) -> bool:
    """Whether some drawing tells left limbs from right ones."""
    return any('class="l"' in str(item) or 'class="r"' in str(item) for row in rows for item in row)


def frames_of(seconds: float) -> int:
    """Frames of a film that lasts so long."""
    least, most, rate = FILM
    return min(max(round(seconds * rate), least), most)


def hover_strip(drawing: str, seconds: float, mirrored: bool = False) -> Any:
    """A strip as a film that plays when its row is pointed at: the strip slides by behind a window of one frame."""
    found = re.search(r'viewBox="0 0 ([\d.]+) ', drawing)
    if found is None:
        return ""
    steps, lasts = round(float(found[1]) / WIDTH), f"{max(seconds, 0.3):.2f}"
    css = "film turned" if mirrored else "film"
    html = '<span class="{css}" style="--steps:{steps};--lasts:{lasts}s">{drawing}</span>'
    return markup(html, css=css, steps=steps, lasts=lasts, drawing=drawing)


@dataclass
class _Drawing:
    """Draws stretches of an archive, until as much is drawn as a page may weigh."""

    archive: Keeper
    weight: int = 0

    @property
    def full(self) -> bool:
        """Whether nothing more should be drawn."""
        return self.weight >= WEIGHT

    def draw_pair(self, found: Hit | ArchivedEvent, model: Any, seconds: float, what: str) -> list[Any]:
        """Key frames of what was found, and its film beside that of what it resembles, at the same pace."""
        try:
            clip = self.archive.clip(found.source, found.start - AROUND, found.end + AROUND, found.person)
        except ValueError:  # removed since it was found
            return [none("no longer stored"), ""]
        alt = f"Key frames of {what}: {found.source} at {found.start:.1f} to {found.end:.1f} s"
        drawn = strip(clip, found.start, found.end, alt=alt)
        if not drawn:
            return [none("no joint seen"), ""]
        moving = strip(clip, found.start, found.end, frames=frames_of(seconds))
        pair = markup(
            '<span class="pair" tabindex="0" role="img" aria-label="{what}, played beside what it resembles">{one}{other}</span>',
            what=what, one=hover_strip(model, seconds, getattr(found, "mirrored", False)), other=hover_strip(moving, seconds),
        )  # fmt: skip
        self.weight += len(drawn) + len(pair)
        return [drawn, pair]


# ---- search --------------------------------------------------------------------------------------------------------------
def _hit_rows(report: SearchReport) -> list[list[Any]]:
    """The hits that are drawn, the best first."""
    drawing, lasts = _Drawing(report.archive), report.query.duration
    model = strip(report.query, frames=frames_of(lasts))
    scores, rows = even([hit.score for hit in report.hits[:ROWS]]), []
    for number, hit in enumerate(report.hits[:PICTURED], 1):
        if drawing.full:
            break
        small = (f"person {hit.person}" * bool(hit.person), "mirrored" * hit.mirrored)
        name = markup('<span class="rank">{number}</span> {who}', number=number, who=_who(hit.source, *small))
        pictures = drawing.draw_pair(hit, model, lasts, f"hit {number}")
        rows.append([name, time_cell(hit.start, hit.end), scores[number - 1], *pictures])
    return rows


def _search_words(report: SearchReport, measured: Mapping[str, Any]) -> str:
    searched = f"{duration(report.info.seconds)} of {count(report.info.sources, 'source')}"
    if not report.hits:
        return f"Nothing was found in {searched}."
    these = "This stretch resembles" if len(report.hits) == 1 else f"These {len(report.hits):,} stretches resemble"
    where = count(measured["sources"], "recording")
    return f"{these} the query most, seen from whatever side: in {where}, among {searched}."


def _search_cards(report: SearchReport, measured: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    searched = f"{count(report.info.windows, 'window')} of {count(report.info.sources, 'source')}"
    best, last = even([measured["best_score"], measured["last_score"]])
    return [
        ("Hits", f"{len(report.hits):,}", f"in {count(measured['sources'], 'recording')}"),
        ("Scores", best, f"of the best; {last} of the last one shown"),
        ("Searched", duration(report.info.seconds), searched),
        ("Query", duration(report.query.duration), f"{count(report.query.joints.shape[1], 'joint')} in {report.query.dims}D"),
    ]  # fmt: skip


# ---- find ----------------------------------------------------------------------------------------------------------------
def _by_label(report: FindReport) -> dict[str, list[ArchivedEvent]]:
    """The events of each action that has some, the most frequent first."""
    events_of: dict[str, list[ArchivedEvent]] = {}
    for event in report.events:
        events_of.setdefault(str(event.label), []).append(event)
    return dict(sorted(events_of.items(), key=lambda item: (-len(item[1]), item[0])))


def _find_words(report: FindReport, measured: Mapping[str, Any]) -> str:
    where = f"{count(measured['recordings'], 'recording')} ({duration(measured['seconds'])} in all)"
    if not report.events:
        return f"None of the actions was found in {where}."
    kinds = [name for name, number in measured["events_by_class"].items() if number]
    often = f", most often {kinds[0]} ({measured['events_by_class'][kinds[0]]:,} times)" if len(kinds) > 1 else ""
    were = "was" if measured["events"] == 1 else "were"
    found = f"{count(measured['events'], 'action')} of {count(len(kinds), 'kind')} {were} found"
    return f"{found} in {measured['recordings_with_events']:,} of {where}{often}."


def _find_cards(measured: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    kinds = sum(number > 0 for number in measured["events_by_class"].values())
    without = measured["recordings"] - measured["recordings_with_events"]
    items = [
        ("Actions found", f"{measured['events']:,}", f"of {count(kinds, 'kind')}"),
        ("Recordings", f"{measured['recordings_with_events']:,}", f"with a find; {without:,} without"),
        ("Searched", duration(measured["seconds"]), f"in {count(measured['recordings'], 'recording')}"),
    ]
    if measured["people"]:
        items.append(("People", f"{measured['people']:,}", "each searched by itself"))
    return items


def _count_rows(report: FindReport) -> list[list[Any]]:
    """Of each action: how often, in how many recordings, seconds in all, and its scores."""
    events_of = _by_label(report)
    best = even([max((event.score for event in events), default=math.nan) for events in events_of.values()])
    middle = even([float(np.median([event.score for event in events])) for events in events_of.values()])
    rows: list[list[Any]] = [
        [
            label, f"{len(events):,}", f"{len({event.source for event in events}):,}",
            duration(sum(event.end - event.start for event in events)), top, usual,
        ]
        for (label, events), top, usual in zip(events_of.items(), best, middle, strict=True)
    ]  # fmt: skip
    absent = [name for name in map(str, report.classes) if name not in events_of]
    return rows + [[name, "0", "0", none("none"), "", ""] for name in absent]


def _actions(report: FindReport) -> list[dict[str, Any]]:
    """Drawings of the surest and the most doubtful finds of each action."""
    events_of, drawing = _by_label(report), _Drawing(report.archive)
    room = min(max(PICTURED // max(len(events_of), 1), LEAST), MOST)
    out = []
    for label, events in events_of.items():
        groups = []
        for title, some in _select_events(events, room):
            rows = list(_event_rows(report, drawing, some))
            if rows:
                groups.append((title, rows))
        if groups:
            out.append({"label": label, "events": len(events), "groups": groups})
    return out


def _select_events(events: Sequence[ArchivedEvent], room: int) -> list[tuple[str, list[ArchivedEvent]]]:
    """All events, surest first, where they fit; else the surest, and those of the least margin."""
    ordered = sorted(events, key=lambda event: -event.score)
    if len(ordered) <= room:
        return [("", ordered)]
    surest = ordered[: room - room // DOUBTFUL]
    rest = sorted(ordered[len(surest) :], key=lambda event: event.margin)
    return [("The surest", surest), ("The most doubtful: hardly more than the next best action", rest[: room // DOUBTFUL])]


def _event_rows(report: FindReport, drawing: _Drawing, events: Sequence[ArchivedEvent]) -> Iterator[list[Any]]:
    scores, margins = even([event.score for event in events]), even([event.margin for event in events])
    for event, score, margin in zip(events, scores, margins, strict=True):
        if drawing.full:
            return
        clip = _example(report, event)
        model = strip(clip, frames=frames_of(event.end - event.start)) if clip is not None else ""
        pictures = drawing.draw_pair(event, model, event.end - event.start, str(event.label))
        yield [
            _who(event.source, f"person {event.person}" * bool(event.person)),
            time_cell(event.start, event.end),
            score,
            margin,
            *pictures,
        ]


def _example(report: FindReport, event: ArchivedEvent) -> Clip | None:
    return RecognitionReport("", exemplars=report.exemplars).exemplar(event)


def _recording_rows(report: FindReport, paint: Mapping[str, str]) -> list[list[Any]]:
    """Recordings with finds, those with most first: how often each action, and when."""
    spans: dict[str, tuple[float, float]] = {}
    for one in report.recordings:
        low, high = spans.get(one.source, (math.inf, -math.inf))
        spans[one.source] = (min(low, one.start), max(high, one.end))
    events_of: dict[str, list[ArchivedEvent]] = {}
    for event in report.events:
        events_of.setdefault(event.source, []).append(event)
    rows: list[list[Any]] = []
    for source, events in sorted(events_of.items(), key=lambda item: (-len(item[1]), item[0]))[:LISTED]:
        kinds = Counter(str(event.label) for event in events).most_common()
        counts_text = ", ".join(f"{number} {label}" for label, number in kinds[:6]) + f" and {len(kinds) - 6} more kinds" * (
            len(kinds) > 6
        )
        low, high = spans.get(source, (events[0].start, events[-1].end))
        rows.append([_who(source, duration(high - low)), f"{len(events):,}", counts_text, marks(events[:MARKS], low, high, paint)])
    return rows


def marks(events: Sequence[ArchivedEvent], start: float, end: float, paint: Mapping[str, str]) -> Any:
    """When a recording's events are, as a line of marks in the colours of their actions."""
    lasts = max(end - start, 1e-9)
    drawn = [
        markup(
            '<rect x="{x}" width="{wide}" height="10" fill="{colour}"/>', x=f"{1000 * (event.start - start) / lasts:.1f}",
            wide=f"{max(1000 * (event.end - event.start) / lasts, 3.0):.1f}", colour=paint[str(event.label)],
        )
        for event in events
    ]  # fmt: skip
    return markup(
        '<svg class="marks" viewBox="0 0 1000 10" preserveAspectRatio="none" aria-hidden="true">'
        '<rect class="track" width="1000" height="10"/>{drawn}</svg>',
        drawn=markup("").join(drawn),
    )


def _event_players(report: FindReport) -> list[dict[str, Any]]:
    """Players of the recordings with finds, where they are few and short enough for a page."""
    found = {event.source for event in report.events}
    some = [one for one in report.recordings if one.source in found]
    if len(found) > PLAYED or sum(one.seconds for one in some) > PLAYED_SECONDS:
        return []
    results, classes = [], [str(label) for label in report.classes]  # all, so that an action has one colour on all the page
    for one in some:
        try:
            clip = report.archive.clip(one.source, person=one.person)
        except ValueError:  # removed since it was searched
            continue
        events = [event for event in report.events if (event.source, event.person) == (one.source, one.person)]
        unscored = np.full((len(clip), len(classes)), np.nan)
        results.append(RecordingResult(one.source, clip, clip.times, classes, unscored, events, person=one.person))
    groups = by_recording(results)
    play: Sequence[Player | None] = players(groups, RecognitionReport("", exemplars=report.exemplars))
    return [{"name": people[0].name, "player": player} for people, player in zip(groups, play, strict=True) if player is not None]
