"""The catalogue of an archive: what is in which segment, in one SQLite file that only the process that adds writes.

A segment is there when its row is committed.  What a killed addition leaves is a file without a row, which holds nothing that is
missed.
"""

from __future__ import annotations

import contextlib
import json
import random
import sqlite3
import time
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from indexing.archive.tracks import Layout, StorageFormat, layout_key
from indexing.modelfile import skeleton_from_json, skeleton_to_json

VERSION = 1
LOCK_SECONDS = 30.0  # that a reader waits for a commit
STORED = {"rate": "rate", "dimensions": "dimensions", "shortest": "min_duration", "views": "views"}  # key in the file -> field
CATALOGUE, LOCK, SEGMENTS = "catalogue.sqlite", "writer.lock", "segments"
SCHEMA = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE layouts (id INTEGER PRIMARY KEY, key TEXT UNIQUE NOT NULL, joints INTEGER NOT NULL, skeleton TEXT,
  learned BLOB NOT NULL);
CREATE TABLE segments (id INTEGER PRIMARY KEY AUTOINCREMENT, file TEXT UNIQUE NOT NULL,
  layout INTEGER NOT NULL REFERENCES layouts(id), windows INTEGER NOT NULL,
  dead INTEGER NOT NULL DEFAULT 0, size INTEGER NOT NULL, sha256 TEXT NOT NULL);
CREATE TABLE sources (id INTEGER PRIMARY KEY AUTOINCREMENT, key TEXT UNIQUE NOT NULL, name TEXT NOT NULL, path TEXT NOT NULL,
  size INTEGER NOT NULL, modified INTEGER NOT NULL, sha256 TEXT NOT NULL, reading TEXT NOT NULL, note TEXT NOT NULL DEFAULT '');
CREATE TABLE recordings (id INTEGER PRIMARY KEY AUTOINCREMENT, source INTEGER NOT NULL REFERENCES sources(id),
  segment INTEGER NOT NULL REFERENCES segments(id), name TEXT NOT NULL, person TEXT NOT NULL, begins REAL NOT NULL,
  ends REAL NOT NULL, seconds REAL NOT NULL, windows INTEGER NOT NULL);
CREATE INDEX recordings_by_source ON recordings(source);
CREATE INDEX recordings_by_segment ON recordings(segment);
CREATE INDEX recordings_by_name ON recordings(name);
"""


@dataclass(frozen=True)
class SegmentRow:
    """A committed segment: number, file name, number of its layout, windows, how many of them are of removed sources."""

    id: int
    file: str
    layout: int
    windows: int
    dead: int
    size: int
    sha256: str


@dataclass(frozen=True)
class SourceRow:
    """A source: number, what it is known by, what to call it, its file (empty: from memory), and what the file was like."""

    id: int
    key: str
    name: str
    path: str
    size: int
    modified: int
    sha256: str
    reading: str
    note: str


@dataclass(frozen=True)
class RecordingRow:
    """One person of a recording."""

    id: int
    source: int
    segment: int
    name: str
    person: str
    begins: float
    ends: float
    seconds: float
    windows: int


@dataclass(frozen=True, eq=False)
class Contents:
    """What an archive held at one moment: everything that a search needs of the catalogue."""

    generation: int
    storage: StorageFormat
    layouts: dict[int, Layout]
    segments: tuple[SegmentRow, ...]
    windows: int


class Catalogue:
    """The catalogue of the archive in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        if not self.path.is_file():
            raise ValueError(f"{folder}: is no archive; make one with: dyntorch archive add {folder} RECORDINGS")
        self.version = self._version()
        if self.version > VERSION:
            raise ValueError(
                f"{folder}: is an archive of version {self.version}, this dyntorch reads up to version {VERSION}; update dyntorch"
            )

    @property
    def path(self) -> Path:
        """Of the SQLite file."""
        return self.folder / CATALOGUE

    @property
    def segments_folder(self) -> Path:
        """Where segments lie."""
        return self.folder / SEGMENTS

    @classmethod
    def make(cls, folder: Path, storage: StorageFormat) -> Catalogue:
        """The catalogue of a folder, a new one where there is none."""
        path = folder / CATALOGUE
        try:
            folder.mkdir(parents=True, exist_ok=True)
            strangers = [one.name for one in folder.iterdir() if not one.name.startswith((".", CATALOGUE, LOCK))]
            if not path.exists() and strangers:
                raise ValueError(
                    f"{folder}: is a folder with other files ({sorted(strangers)[0]}); give a new or an empty one for the archive"
                )
            if not path.exists():
                path.touch()  # first of all: a folder with an empty catalogue is an archive that somebody was killed in making
            (folder / SEGMENTS).mkdir(exist_ok=True)
        except OSError as problem:
            said = problem.strerror or problem
            raise ValueError(f"{folder}: cannot be written ({said}); choose a folder that you may write to") from problem
        with _database_errors(folder), contextlib.closing(_connect(path)) as connection:
            if connection.execute("SELECT name FROM sqlite_master").fetchone() is None:
                _write_ahead(connection)
                connection.execute("BEGIN IMMEDIATE")
                if connection.execute("SELECT name FROM sqlite_master").fetchone() is None:
                    if any((folder / SEGMENTS).iterdir()):
                        raise ValueError(
                            f"{path}: is empty, but segments are there; restore it from a copy, or give another folder"
                        )
                    _create(connection, storage)
                connection.execute("COMMIT")
        return cls(folder)

    @contextlib.contextmanager
    def reading(self) -> Iterator[sqlite3.Connection]:
        """A connection whose answers are all of one moment."""
        with _database_errors(self.folder), contextlib.closing(self._reader()) as connection:
            connection.execute("BEGIN")
            yield connection
            connection.execute("COMMIT")

    def _reader(self) -> sqlite3.Connection:
        """A connection to what is committed; of a catalogue that was begun and never made, to an empty one."""
        connection = _connect(self.path)
        try:
            made = connection.execute("SELECT name FROM sqlite_master").fetchone()
        except sqlite3.OperationalError as problem:
            connection.close()
            log = self.path.with_name(f"{CATALOGUE}-wal")
            if "locked" in str(problem) or (log.exists() and log.stat().st_size):
                raise
            connection = sqlite3.connect(f"{self.path.absolute().as_uri()}?immutable=1", uri=True, isolation_level=None)
            made = connection.execute("SELECT name FROM sqlite_master").fetchone()
        if made is None:
            connection.close()
            connection = sqlite3.connect(":memory:", isolation_level=None)
            _create(connection, StorageFormat())
        return connection

    @contextlib.contextmanager
    def writing(self) -> Iterator[sqlite3.Connection]:
        """A connection whose changes are made all or none, when the block ends."""
        with _database_errors(self.folder), contextlib.closing(_connect(self.path)) as connection:
            connection.execute("PRAGMA synchronous=FULL")
            connection.execute("BEGIN IMMEDIATE")
            try:
                yield connection
                connection.execute("UPDATE meta SET value = CAST(value AS INTEGER) + 1 WHERE key = 'generation'")
                connection.execute("COMMIT")
            except BaseException:
                with contextlib.suppress(sqlite3.Error):
                    connection.execute("ROLLBACK")
                raise

    def _version(self) -> int:
        with self.reading() as connection:
            tables = {row[0] for row in connection.execute("SELECT name FROM sqlite_master")}
            row = connection.execute("SELECT value FROM meta WHERE key = 'version'").fetchone() if "meta" in tables else None
        if row is None or not str(row[0]).isdecimal():
            raise ValueError(f"{self.path}: has no version, so it is no catalogue of an archive; give another folder")
        return int(row[0])

    # ---- reading -----------------------------------------------------------------------------------------------------
    def generation(self) -> int:
        """A number that changes with the contents."""
        with self.reading() as connection:
            return int(connection.execute("SELECT value FROM meta WHERE key = 'generation'").fetchone()[0])

    def contents(self) -> Contents:
        """Everything that a search needs."""
        with self.reading() as connection:
            return self._contents(connection)

    def _contents(self, connection: sqlite3.Connection) -> Contents:
        try:
            facts = dict(connection.execute("SELECT key, value FROM meta").fetchall())
            layouts = {
                row[0]: Layout.load(row[3], row[1], skeleton_from_json(json.loads(row[2] or "null"), row[1]))
                for row in connection.execute("SELECT id, joints, skeleton, learned FROM layouts")
            }
            segments = tuple(SegmentRow(*row) for row in connection.execute("SELECT * FROM segments ORDER BY id"))
            windows = sum(row.windows - row.dead for row in segments)
            stored = json.loads(facts["storage"])
            storage = StorageFormat(**{name: stored[key] for key, name in STORED.items()} | {"views": tuple(stored["views"])})
            return Contents(int(facts["generation"]), storage, layouts, segments, windows)
        except (ValueError, TypeError, KeyError, EOFError, zipfile.BadZipFile) as problem:
            raise _senseless(self.folder, problem) from problem

    def searchable(self) -> tuple[Contents, dict[int, set[int]]]:
        """Contents, and of the segments from which something was removed the recordings that are left, all of one moment."""
        with self.reading() as connection:
            contents = self._contents(connection)
            left: dict[int, set[int]] = {row.id: set() for row in contents.segments if row.dead}
            for segment, mine in left.items():
                mine.update(one for (one,) in connection.execute("SELECT id FROM recordings WHERE segment = ?", (segment,)))
            return contents, left

    def moment(self, checked: bool = False) -> tuple[Contents, list[RecordingRow], list[SourceRow]]:
        """Contents, recordings and sources, all of one moment, whoever writes meanwhile."""
        with self.reading() as connection:
            (said,) = connection.execute("PRAGMA integrity_check(1)").fetchone() if checked else ("ok",)
            if said != "ok":
                raise _senseless(self.folder, " ".join(str(said).split()))
            recordings = [RecordingRow(*row) for row in connection.execute("SELECT * FROM recordings ORDER BY id")]
            sources = [SourceRow(*row) for row in connection.execute("SELECT * FROM sources ORDER BY id")]
            return self._contents(connection), recordings, sources

    def sources(self) -> dict[str, SourceRow]:
        """All sources, by key."""
        with self.reading() as connection:
            return {row[1]: SourceRow(*row) for row in connection.execute("SELECT * FROM sources ORDER BY id")}

    def recordings_by_id(self, numbers: Sequence[int]) -> dict[int, RecordingRow]:
        """Some recordings, by number."""
        with self.reading() as connection:
            rows = [connection.execute("SELECT * FROM recordings WHERE id = ?", (number,)).fetchone() for number in set(numbers)]
        return {row[0]: RecordingRow(*row) for row in rows if row is not None}

    def by_name(self, name: str) -> list[RecordingRow]:
        """The recordings that a name, or a source's name or path, stands for."""
        name = storable(name)
        with self.reading() as connection:
            rows = connection.execute(
                "SELECT * FROM recordings WHERE name = ? OR source IN (SELECT id FROM sources WHERE name = ? OR path = ?)"
                " ORDER BY id",
                (name, name, name),
            ).fetchall()
        return [RecordingRow(*row) for row in rows]

    # ---- writing -----------------------------------------------------------------------------------------------------
    @contextlib.contextmanager
    def write_lock(self) -> Iterator[None]:
        """Hold the archive against others who write; whoever dies lets go of it."""
        with contextlib.ExitStack() as stack:
            try:
                lock = stack.enter_context(
                    # a moment, for those who only look whether somebody writes
                    contextlib.closing(sqlite3.connect(self.folder / LOCK, timeout=0.1, isolation_level=None))
                )
                lock.execute("BEGIN EXCLUSIVE")
            except sqlite3.Error as problem:
                if "locked" not in str(problem):
                    raise ValueError(f"{self.folder / LOCK}: {problem}; check the folder's permissions and the disk") from problem
                raise ValueError(
                    f"{self.folder}: is locked, another process adds to it or removes from it; try again when it has ended"
                ) from None
            yield  # closing lets go of it

    def is_locked(self) -> bool:
        """Whether somebody writes right now."""
        lock = self.folder / LOCK
        try:
            with contextlib.closing(sqlite3.connect(f"{lock.absolute().as_uri()}?mode=ro", uri=True, timeout=0.0)) as connection:
                connection.execute("SELECT name FROM sqlite_master").fetchone()
        except sqlite3.Error as problem:
            return "locked" in str(problem)
        return False


def storable(text: str) -> str:
    r"""Text as SQLite takes it: bytes of a file name that are no UTF-8 (Python's lone surrogates) are written out."""
    return text.encode("utf-8", "backslashreplace").decode()


def _connect(path: Path) -> sqlite3.Connection:
    """To a catalogue that is there: one that was deleted is not made anew."""
    return sqlite3.connect(f"{path.absolute().as_uri()}?mode=rw", uri=True, timeout=LOCK_SECONDS, isolation_level=None)


def _write_ahead(connection: sqlite3.Connection) -> None:
    """Let others read while somebody writes.  SQLite does not wait for others to do the same to the same file."""
    until = time.monotonic() + LOCK_SECONDS
    while True:
        try:
            connection.execute("PRAGMA journal_mode=WAL")
            return
        except sqlite3.OperationalError as problem:
            if "locked" not in str(problem) or time.monotonic() > until:
                raise
            time.sleep(random.uniform(0.001, 0.02))


def _create(connection: sqlite3.Connection, storage: StorageFormat) -> None:
    """The tables of a new catalogue."""
    for statement in SCHEMA.split(";"):
        connection.execute(statement)
    facts = {
        "version": str(VERSION),
        "generation": "0",
        "storage": json.dumps({key: getattr(storage, name) for key, name in STORED.items()}),
    }
    connection.executemany("INSERT INTO meta VALUES (?, ?)", list(facts.items()))


def add_layout(connection: sqlite3.Connection, layout: Layout) -> int:
    """Register what was learned of a layout; its number."""
    skeleton = None if layout.skeleton is None else json.dumps(skeleton_to_json(layout.skeleton))
    values = (storable(layout_key(layout.joints, layout.skeleton)), layout.joints, skeleton, layout.dump())
    cursor = connection.execute("INSERT INTO layouts (key, joints, skeleton, learned) VALUES (?, ?, ?, ?)", values)
    return int(cursor.lastrowid or 0)


def drop_recordings(connection: sqlite3.Connection, source: int) -> int:
    """Take the recordings of a source out; their windows are dead from now on.  How many recordings."""
    connection.execute(
        "UPDATE segments SET dead = dead + (SELECT COALESCE(SUM(windows), 0) FROM recordings WHERE source = ?"
        " AND segment = segments.id) WHERE id IN (SELECT segment FROM recordings WHERE source = ?)",
        (source, source),
    )
    return int(connection.execute("DELETE FROM recordings WHERE source = ?", (source,)).rowcount)


@contextlib.contextmanager
def _database_errors(folder: Path) -> Iterator[None]:
    """What SQLite says, as one line with a remedy."""
    try:
        yield
    except sqlite3.OperationalError as problem:
        remedy = "another process holds it; try again" if "locked" in str(problem) else "check the disk and the permissions"
        raise ValueError(f"{folder / CATALOGUE}: {problem}; {remedy}") from problem
    except sqlite3.DatabaseError as problem:
        raise _senseless(folder, problem) from problem


def _senseless(folder: Path, problem: object) -> ValueError:
    return ValueError(f"{folder / CATALOGUE}: {problem}; restore it from a copy, or add the recordings to a new archive")
