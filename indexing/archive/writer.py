"""Writing an archive, and verifying it: sources are read by workers, and committed in their order; the coordinator alone writes.

Stages: what is known already is left alone (:func:`_news`); the others are read (:mod:`indexing.archive.sources`); batches of them
are written as segments and committed in one step each (:meth:`Adder.commit`); small segments are put together (:func:`tidy`).
"""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from dyntorch.numerics import one_thread
from indexing.archive.catalogue import Catalogue, Contents, RecordingRow, SegmentRow, SourceRow, add_layout, drop_recordings
from indexing.archive.segments import ArchiveSegment, WrittenSegment, damage_error, is_intact, write_segment
from indexing.archive.sources import ArchiveSource, ReadRecording, ReadSource, failure_text, read_source, reading_key, stamp
from indexing.archive.tracks import MAX_LEARNED_POSES, Layout, StorageFormat, Track, layout_key, total_windows, windows_of
from indexing.archive.workers import InOrder, WorkerLost
from indexing.opening import count, listing
from indexing.skeleton import Skeleton

Progress = Callable[[float], None] | None

MAX_DEAD_SHARE = 0.5  # of removed windows, from which a segment is written anew
MAX_TRIES = 3  # of a source where its worker dies, the last time by itself
TASKS_AHEAD = 4  # sources per worker that are read ahead of what is written: bounds memory
MAX_ATTEMPTS = 3  # of a question where segments are merged meanwhile


@dataclass(frozen=True)
class ArchiveOptions:
    """How an archive stores movement (the first four, fixed when it is made), grows and is searched."""

    rate: float = 15.0
    """Stored poses per second, each with a sketch: 4.8 MB per hour of 17 joints.  Windows may begin and end at any of them."""
    dimensions: int = 8
    """Directions of joint space that a sketch keeps, of x and of y.  Right moment among the best 10 / 100 / 300 of 280,000 windows
    of 1 s (CMU): 6 give .72 / .89 / .96, 8 .88 / .98 / .99, 12 .92 / 1.00 / 1.00, all .98 / .99 / .99 (without re-ranking)."""
    views: tuple[float, ...] = (0.0, 90.0)
    """Degrees about the vertical from which movement in 3D is kept: what goes towards one camera, the other sees."""
    max_segment_windows: int = 1_000_000
    """Windows of one file, unless one source has more: 18 hours, 88 MB of 17 joints."""
    commit_seconds: float = 120.0
    """Seconds after which what was read is committed: as much is lost at most where an addition is killed."""
    max_small_segments: int = 16
    """Files of less than half that size that may lie about before they are merged."""
    relearn_factor: float = 4.0
    """Times as much movement as a layout was learned from, from which on it is learned anew, until it was learned from enough."""
    num_candidates: int = 1000
    """Moments that a search compares exactly: what it costs, and what it may miss."""

    @property
    def storage(self) -> StorageFormat:
        """How a new archive stores movement."""
        return StorageFormat(self.rate, self.dimensions, views=self.views)


Outcome = Literal["added", "replaced", "known", "failed", "left out"]


@dataclass(frozen=True)
class SourceOutcome:
    """What became of one source that was to be added."""

    source: str
    outcome: Outcome
    reason: str = ""
    windows: int = 0
    seconds: float = 0.0


@dataclass(frozen=True)
class Addition:
    """What :meth:`indexing.Archive.add` did, source by source, in the order given."""

    sources: tuple[SourceOutcome, ...]

    def of(self, outcome: Outcome) -> tuple[SourceOutcome, ...]:
        """The sources that met this outcome."""
        return tuple(one for one in self.sources if one.outcome == outcome)

    @property
    def failures(self) -> tuple[SourceOutcome, ...]:
        """Sources that could not be read, with their reasons."""
        return self.of("failed")

    @property
    def windows(self) -> int:
        """Windows that are new."""
        return sum(one.windows for one in self.sources if one.outcome in ("added", "replaced"))

    @property
    def seconds(self) -> float:
        """Seconds of recordings that are new, every person counted."""
        return sum(one.seconds for one in self.sources if one.outcome in ("added", "replaced"))


@dataclass(frozen=True)
class Verification:
    """What :meth:`indexing.Archive.verify` found: one line for each problem, none where all is well."""

    windows: int
    segments: int
    problems: tuple[str, ...] = ()
    orphans: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether every window of the catalogue is there, whole, and once."""
        return not self.problems


@one_thread
def add(
    catalogue: Catalogue,
    sources: Sequence[ArchiveSource],
    options: ArchiveOptions,
    executor: Executor | None,
    reading: Mapping[str, Any],
    progress: Progress,
) -> Addition:
    """Add what is new or has changed; see :meth:`indexing.Archive.add`."""
    with catalogue.write_lock():
        remove_orphans(catalogue)
        adder = Adder(catalogue, options, reading)
        outcomes: dict[str, SourceOutcome] = {}
        news = list(_news(adder.known, sources, adder.reading, outcomes))
        work = InOrder(partial(read_source, reading=dict(reading), storage=adder.storage), executor, TASKS_AHEAD, MAX_TRIES)
        try:
            for done, (source, read) in enumerate(work(news), 1):
                outcomes[source.key] = adder.stage(source, read)
                if progress is not None:
                    progress(done / len(news))
        finally:
            # whoever interrupts keeps what was read
            adder.commit()
        tidy(catalogue, options)
    return Addition(tuple(outcomes[source.key] for source in sources))


def _news(
    known: Mapping[str, SourceRow], sources: Sequence[ArchiveSource], reading: str, outcomes: dict[str, SourceOutcome]
) -> Iterator[ArchiveSource]:
    """The sources that must be read; of the others, what became of them."""
    for source in sources:
        row = known.get(source.key)
        if row is None or row.reading != _reading_of(source, reading):
            yield source
            continue
        try:
            now = stamp(source)
        except (OSError, ValueError) as problem:
            outcomes[source.key] = SourceOutcome(
                source.name, "failed", f"{failure_text(source, problem)}; what is in the archive of it stays"
            )
            continue
        same = now.sha256 == row.sha256 if source.clip is not None else (now.size, now.modified) == (row.size, row.modified)
        if same:
            outcomes[source.key] = SourceOutcome(source.name, "known", row.note)
        else:
            yield source


def _reading_of(source: ArchiveSource, reading: str) -> str:
    """How a source is read: clips from memory are as they are."""
    return reading if source.clip is None else ""


@dataclass(frozen=True, eq=False)
class PreparedSegment:
    """A segment that is written and not entered yet, and the rows of those that it takes the place of."""

    layout: Layout
    made: WrittenSegment
    windows: int
    joined: tuple[SegmentRow, ...]


class Adder:
    """Takes what was read, and commits it batch by batch."""

    def __init__(self, catalogue: Catalogue, options: ArchiveOptions, reading: Mapping[str, Any]) -> None:
        self.catalogue, self.options, self.reading = catalogue, options, reading_key(reading)
        contents = catalogue.contents()
        self.storage = contents.storage
        self.known = catalogue.sources()
        self.layouts = {layout_key(one.joints, one.skeleton): (number, one) for number, one in contents.layouts.items()}
        self.batch: list[tuple[ArchiveSource, ReadSource]] = []
        self.since = time.monotonic()

    def stage(self, source: ArchiveSource, read: ReadSource | WorkerLost) -> SourceOutcome:
        """What becomes of a source."""
        if isinstance(read, WorkerLost):
            return SourceOutcome(source.name, "failed", f"{source.name}: {read}; leave it out, or give its worker more memory")
        if read.failure:
            return SourceOutcome(source.name, "failed", read.failure)
        row = self.known.get(source.key)
        if row is not None and row.reading == _reading_of(source, self.reading) and row.sha256 == read.stamp.sha256:
            with self.catalogue.writing() as connection:  # the same content at another time
                times = (read.stamp.size, read.stamp.modified, row.id)
                connection.execute("UPDATE sources SET size = ?, modified = ? WHERE id = ?", times)
            return SourceOutcome(source.name, "known", row.note)
        self.batch.append((source, read))
        full = sum(each.windows for _, each in self.batch) >= self.options.max_segment_windows
        if full or time.monotonic() - self.since >= self.options.commit_seconds:
            self.commit()
        outcome: Outcome = "left out" if not read.windows else "added" if row is None else "replaced"
        return SourceOutcome(source.name, outcome, read.note, read.windows, read.seconds)

    def commit(self) -> None:
        """Write what is staged as segments, and let the catalogue know: all of it or nothing."""
        batch, self.batch, self.since = self.batch, [], time.monotonic()
        if not batch:
            return
        number = self._first_number()
        numbered: list[tuple[int, int, ReadRecording]] = []  # (source, number, recording)
        for i, (_, read) in enumerate(batch):
            for one in read.recordings:
                numbered.append((i, number, one))
                number += 1
        written: dict[str, PreparedSegment] = {}
        try:
            for key in dict.fromkeys(layout_key(one.joints, one.skeleton) for _, _, one in numbered):
                mine = [(n, one) for _, n, one in numbered if layout_key(one.joints, one.skeleton) == key]
                tracks = [replace(track, recording=n) for n, one in mine for track in one.tracks]
                layout, joined, older = self._layout(key, tracks, mine[0][1].skeleton)
                made = write_segment(self.catalogue.segments_folder, [*older, *tracks], layout, self.storage)
                windows = total_windows(older, self.storage) + sum(one.windows for _, one in mine)
                written[key] = PreparedSegment(layout, made, windows, joined)
            self._enter(batch, numbered, written)
            _unlink(self.catalogue, [row for one in written.values() for row in one.joined])
        except BaseException:
            with contextlib.suppress(OSError, ValueError):
                remove_orphans(self.catalogue)  # what is not in the catalogue: an interruption may have come after the commit
            raise

    def _layout(
        self, key: str, tracks: Sequence[Track], skeleton: Skeleton | None
    ) -> tuple[Layout, tuple[SegmentRow, ...], list[Track]]:
        """What a layout's codes are, and which segments are written anew for that, with what is in them."""
        storage = self.storage
        if key not in self.layouts:
            return Layout.learn(tracks, skeleton, storage), (), []
        number, layout = self.layouts[key]
        rows = tuple(row for row in self.catalogue.contents().segments if row.layout == number)
        total = sum(row.windows - row.dead for row in rows) + sum(map(len, tracks))
        if layout.poses >= MAX_LEARNED_POSES or total < self.options.relearn_factor * layout.poses:
            return layout, (), []
        try:
            older = [track for row in rows for track in live_tracks(self.catalogue, row)]
        except (OSError, ValueError):
            return layout, (), []  # damaged: verifying says so
        return Layout.learn([*older, *tracks], skeleton, storage), rows, older

    def _first_number(self) -> int:
        """Of the recordings to come; nobody else writes."""
        with self.catalogue.reading() as connection:
            row = connection.execute("SELECT seq FROM sqlite_sequence WHERE name = 'recordings'").fetchone()
        return 1 + (int(row[0]) if row is not None else 0)

    def _enter(
        self,
        batch: Sequence[tuple[ArchiveSource, ReadSource]],
        numbered: Sequence[tuple[int, int, ReadRecording]],
        written: Mapping[str, PreparedSegment],
    ) -> None:
        fresh: dict[str, tuple[int, Layout]] = {}
        with self.catalogue.writing() as connection:
            segments: dict[str, int] = {}
            for key, one in written.items():
                number = self.layouts[key][0] if key in self.layouts else add_layout(connection, one.layout)
                fresh[key] = (number, one.layout)
                segments[key] = enter_segment(connection, one.made, number, one.windows, one.joined)
                if one.joined:
                    connection.execute("UPDATE layouts SET learned = ? WHERE id = ?", (one.layout.dump(), number))
            rows = [_enter_source(connection, source, read, self.reading) for source, read in batch]
            connection.executemany(
                "INSERT INTO recordings VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
                [
                    (n, rows[i].id, segments[layout_key(one.joints, one.skeleton)], one.name, one.person, one.begins, one.ends,
                     one.seconds, one.windows)
                    for i, n, one in numbered
                ],
            )  # fmt: skip
        self.layouts |= fresh
        self.known |= {row.key: row for row in rows}


def _enter_source(connection: Any, source: ArchiveSource, read: ReadSource, reading: str) -> SourceRow:
    """The row of a source, in the place of an earlier one."""
    path = source.key.removeprefix("file:") if source.clip is None else ""
    stamped = read.stamp
    values = (source.name, path, stamped.size, stamped.modified, stamped.sha256, _reading_of(source, reading), read.note)
    row = connection.execute("SELECT id FROM sources WHERE key = ?", (source.key,)).fetchone()
    if row is not None:
        drop_recordings(connection, int(row[0]))
        fields = "name = ?, path = ?, size = ?, modified = ?, sha256 = ?, reading = ?, note = ?"
        connection.execute(f"UPDATE sources SET {fields} WHERE id = ?", (*values, row[0]))
        return SourceRow(int(row[0]), source.key, *values)
    found = connection.execute(
        "INSERT INTO sources (key, name, path, size, modified, sha256, reading, note) VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
        (source.key, *values),
    )
    return SourceRow(int(found.lastrowid or 0), source.key, *values)


# ---- keeping house; the caller holds the archive alone -------------------------------------------------------------------


def orphans(catalogue: Catalogue) -> list[Path]:
    """Files of interrupted additions: nothing in the catalogue says that they are there."""
    there = sorted(catalogue.segments_folder.iterdir()) if catalogue.segments_folder.is_dir() else []
    known = {row.file for row in catalogue.contents().segments}  # asked last: what was committed meanwhile is no orphan
    return [one for one in there if one.name not in known]


def remove_orphans(catalogue: Catalogue) -> None:
    """Take the files of interrupted additions away."""
    for one in orphans(catalogue):
        with contextlib.suppress(OSError):
            one.unlink()


def tidy(catalogue: Catalogue, options: ArchiveOptions) -> None:
    """Put small segments together, and write those anew of which much was removed."""
    contents = catalogue.contents()
    for number, layout in contents.layouts.items():
        mine = [row for row in contents.segments if row.layout == number]
        small = [row for row in mine if row.windows - row.dead < options.max_segment_windows / 2]
        due = [row for row in mine if row.dead > MAX_DEAD_SHARE * row.windows]
        if len(small) > options.max_small_segments:
            due = [row for row in mine if row in small or row in due]
        batch: list[SegmentRow] = []
        with contextlib.suppress(ValueError):  # what it would have freed or put together is no part of what was asked for
            for row in due:
                if row.dead < row.windows and not is_intact(catalogue.segments_folder / row.file, row.sha256):
                    continue
                batch.append(row)
                if sum(one.windows - one.dead for one in batch) >= options.max_segment_windows:
                    _merge_segments(catalogue, batch, layout, contents.storage)
                    batch = []
            if batch:
                _merge_segments(catalogue, batch, layout, contents.storage)


def _merge_segments(catalogue: Catalogue, rows: Sequence[SegmentRow], layout: Layout, storage: StorageFormat) -> None:
    """One segment in the place of some, without what was removed."""
    tracks = [track for row in rows for track in live_tracks(catalogue, row)]
    made = write_segment(catalogue.segments_folder, tracks, layout, storage) if tracks else None
    with catalogue.writing() as connection:
        enter_segment(connection, made, rows[0].layout, total_windows(tracks, storage), rows)
    _unlink(catalogue, rows)


def live_tracks(catalogue: Catalogue, row: SegmentRow) -> list[Track]:
    """What is in a segment, without what was removed."""
    with catalogue.reading() as connection:
        live = {number for (number,) in connection.execute("SELECT id FROM recordings WHERE segment = ?", (row.id,))}
    if not live:
        return []
    path = catalogue.segments_folder / row.file
    if not is_intact(path, row.sha256):
        raise damage_error(path, "it is not what was written")
    segment = ArchiveSegment.open(path)
    return [segment.track(i) for i in range(len(segment)) if int(segment.tracks[i, 0]) in live]


def enter_segment(connection: Any, made: WrittenSegment | None, layout: int, windows: int, joined: Sequence[SegmentRow]) -> int:
    """The row of a new segment, in the place of those joined in it; its number, 0 where there is none."""
    number = 0
    if made is not None:
        found = connection.execute(
            "INSERT INTO segments (file, layout, windows, size, sha256) VALUES (?, ?, ?, ?, ?)",
            (made.file, layout, windows, made.size, made.sha256),
        )
        number = int(found.lastrowid or 0)
    for row in joined:
        connection.execute("UPDATE recordings SET segment = ? WHERE segment = ?", (number, row.id))
        connection.execute("DELETE FROM segments WHERE id = ?", (row.id,))
    return number


def _unlink(catalogue: Catalogue, rows: Sequence[SegmentRow]) -> None:
    """The files of segments that others took the place of."""
    for row in rows:
        with contextlib.suppress(OSError):
            (catalogue.segments_folder / row.file).unlink()


# ---- verification: whether every window of the catalogue is there, whole, and once ---------------------------------------


def verify(catalogue: Catalogue) -> Verification:
    """Every segment read and compared with the catalogue; again where somebody changed the archive meanwhile."""
    for attempt in range(MAX_ATTEMPTS):
        contents, recordings, sources = catalogue.moment(checked=True)
        problems = _problems(catalogue.segments_folder, contents, recordings, sources)
        if not problems or attempt == MAX_ATTEMPTS - 1 or catalogue.generation() == contents.generation:
            break
    left = tuple(path.name for path in orphans(catalogue))
    # whoever adds right now has files that are no leftovers
    return Verification(contents.windows, len(contents.segments), tuple(problems), () if catalogue.is_locked() else left)


def _problems(folder: Path, contents: Contents, recordings: Sequence[RecordingRow], sources: Sequence[SourceRow]) -> list[str]:
    problems: list[str] = []
    by_segment: dict[int, list[RecordingRow]] = {row.id: [] for row in contents.segments}
    for one in recordings:
        if one.segment in by_segment:
            by_segment[one.segment].append(one)
        else:
            problems.append(f"{one.name}: its segment is not in the catalogue; remove its source and add it again")
    names = {row.id: row.name for row in sources}
    for row in contents.segments:
        if row.layout not in contents.layouts:
            problems.append(
                f"{folder / row.file}: its joint layout is not in the catalogue; {_loss_text(by_segment[row.id], names)}"
            )
            continue
        problems += _segment_problems(folder, row, by_segment[row.id], contents, names)
    twice = [key for key, count in Counter((one.source, one.name, one.person) for one in recordings).items() if count > 1]
    problems += [f"{name}{f', {who}' * bool(who)}: is there twice; remove its source and add it again" for _, name, who in twice]
    problems += [
        f"{one.name}: belongs to no source; restore the catalogue from a copy, or add the recordings to a new archive"
        for one in recordings
        if one.source not in names
    ]
    return problems


def _segment_problems(
    folder: Path, row: SegmentRow, recordings: Sequence[RecordingRow], contents: Contents, names: Mapping[int, str]
) -> list[str]:
    path, lost = folder / row.file, _loss_text(recordings, names)
    try:
        if path.stat().st_size != row.size or not is_intact(path, row.sha256):
            return [f"{path}: is not what was written; {lost}"]
        segment = ArchiveSegment.open(path)
    except OSError as problem:
        return [f"{path}: {problem.strerror or problem}; {lost}"]
    except ValueError as problem:
        return [f"{problem}; {lost}"]
    if segment.joints.shape[1] != contents.layouts[row.layout].joints or segment.rate != contents.storage.rate:
        return [f"{path}: has other joints or another rate than the catalogue says; {lost}"]
    live = {one.id: one for one in recordings}
    windows: Counter[int] = Counter()
    held: dict[int, list[tuple[float, float]]] = {number: [] for number in live}  # first and last second of each track
    for (recording, view, _, rows), start in zip(segment.tracks.tolist(), segment.starts.tolist(), strict=True):
        windows[recording] += windows_of(rows, contents.storage)
        if recording in live and view == 0:
            held[recording].append((start, start + (rows - 1) / segment.rate))
    found = [
        f"{path}: does not hold what the catalogue says of {one.name}; remove {names.get(one.source, one.name)} and add it again"
        for one in recordings
        if windows[one.id] != one.windows or not _same_times(held[one.id], one)
    ]
    total = sum(windows.values())
    dead = total - sum(windows[number] for number in live)
    if (row.windows, row.dead) != (total, dead):
        found.append(
            f"{path}: has {total} windows, {dead} of them removed; the catalogue says {row.windows} and {row.dead}; {lost}"
        )
    return found


def _same_times(spans: Sequence[tuple[float, float]], row: RecordingRow) -> bool:
    """Whether a recording begins, ends and lasts as the catalogue says, to a thousandth of a second."""
    if not spans:
        return row.seconds == 0  # movement in 3D that only the second image shows
    told = min(begin for begin, _ in spans), max(end for _, end in spans), sum(end - begin for begin, end in spans)
    return all(abs(a - b) <= 1e-3 for a, b in zip(told, (row.begins, row.ends, row.seconds), strict=True))


def _loss_text(recordings: Sequence[RecordingRow], names: Mapping[int, str]) -> str:
    """What a segment takes with it, and what to do."""
    if not recordings:
        return "nothing of it is used"
    sources = sorted({names.get(one.source, one.name) for one in recordings})
    return f"{count(len(recordings), 'recording')} lost: remove and add again {listing(sources)}"
