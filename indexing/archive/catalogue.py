"""The catalogue of an archive: what is in which segment, in one SQLite file that only the process that adds writes.

A segment is there when its row is committed.  What a killed addition leaves is a file without a row, which holds nothing that is
missed.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import sqlite3
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from indexing.archive.layout import Layout, layout_key
from indexing.archive.options import StorageOptions
from indexing.skeleton import Skeleton
from indexing.windows import RepairOptions

VERSION = 1
CATALOGUE, LOCK, SEGMENTS = "catalogue.sqlite", "writer.lock", "segments"
PATIENCE = 30.0  # seconds that a reader waits for a commit
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
    options: StorageOptions
    layouts: dict[int, Layout]
    segments: tuple[SegmentRow, ...]
    windows: int


class Catalogue:
    """The catalogue of the archive in a folder.

    Args:
        folder: of the archive.

    Raises:
        ValueError: the folder is no archive, or one of a newer version.
    """

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
    def make(cls, folder: Path, options: StorageOptions) -> Catalogue:
        """The catalogue of a folder, a new one where there is none.

        Raises:
            ValueError: other files are in the folder.
        """
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / CATALOGUE
        strangers = [one.name for one in folder.iterdir() if not one.name.startswith((".", CATALOGUE, LOCK, SEGMENTS))]
        if not path.exists() and strangers:
            raise ValueError(
                f"{folder}: is a folder with other files ({sorted(strangers)[0]}); give a new or an empty one for the archive"
            )
        (folder / SEGMENTS).mkdir(exist_ok=True)
        with contextlib.closing(sqlite3.connect(path, timeout=PATIENCE, isolation_level=None)) as connection:
            connection.execute("PRAGMA journal_mode=WAL")
            connection.execute("BEGIN IMMEDIATE")
            if not connection.execute("SELECT name FROM sqlite_master WHERE name = 'meta'").fetchone():
                for statement in SCHEMA.split(";"):
                    connection.execute(statement)
                facts = {"version": str(VERSION), "generation": "0", "storage": json.dumps(dataclasses.asdict(options))}
                connection.executemany("INSERT INTO meta VALUES (?, ?)", list(facts.items()))
            connection.execute("COMMIT")
        return cls(folder)

    @contextlib.contextmanager
    def reading(self) -> Iterator[sqlite3.Connection]:
        """A connection whose answers are all of one moment."""
        with contextlib.closing(self._connect()) as connection, _told(self.folder):
            connection.execute("BEGIN")
            yield connection
            connection.execute("COMMIT")

    @contextlib.contextmanager
    def writing(self) -> Iterator[sqlite3.Connection]:
        """A connection whose changes are made all or none, when the block ends."""
        with contextlib.closing(self._connect()) as connection, _told(self.folder):
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

    def _connect(self) -> sqlite3.Connection:
        return sqlite3.connect(self.path, timeout=PATIENCE, isolation_level=None)

    def _version(self) -> int:
        with self.reading() as connection:
            row = connection.execute("SELECT value FROM meta WHERE key = 'version'").fetchone()
        if row is None:
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
            facts = dict(connection.execute("SELECT key, value FROM meta").fetchall())
            layouts = {
                row[0]: Layout.load(row[3], row[1], _skeleton(row[2]))
                for row in connection.execute("SELECT id, joints, skeleton, learned FROM layouts")
            }
            segments = tuple(SegmentRow(*row) for row in connection.execute("SELECT * FROM segments ORDER BY id"))
            windows = int(connection.execute("SELECT COALESCE(SUM(windows), 0) FROM recordings").fetchone()[0])
        stored = json.loads(facts["storage"])
        options = StorageOptions(**{**stored, "repair": RepairOptions(**stored["repair"])})
        return Contents(int(facts["generation"]), options, layouts, segments, windows)

    def sources(self) -> dict[str, SourceRow]:
        """All sources, by key."""
        with self.reading() as connection:
            return {row[1]: SourceRow(*row) for row in connection.execute("SELECT * FROM sources ORDER BY id")}

    def recordings(self, segment: int | None = None) -> list[RecordingRow]:
        """All recordings, or those of a segment."""
        where, given = ("", ()) if segment is None else (" WHERE segment = ?", (segment,))
        with self.reading() as connection:
            return [RecordingRow(*row) for row in connection.execute(f"SELECT * FROM recordings{where} ORDER BY id", given)]

    def named(self, numbers: Sequence[int]) -> dict[int, RecordingRow]:
        """Some recordings, by number."""
        found: dict[int, RecordingRow] = {}
        with self.reading() as connection:
            for number in dict.fromkeys(numbers):
                row = connection.execute("SELECT * FROM recordings WHERE id = ?", (number,)).fetchone()
                if row is not None:
                    found[number] = RecordingRow(*row)
        return found

    def by_name(self, name: str) -> list[RecordingRow]:
        """The recordings that a name, or a source's name or path, stands for."""
        with self.reading() as connection:
            rows = connection.execute(
                "SELECT * FROM recordings WHERE name = ? OR source IN (SELECT id FROM sources WHERE name = ? OR path = ?)"
                " ORDER BY id",
                (name, name, name),
            ).fetchall()
        return [RecordingRow(*row) for row in rows]

    # ---- writing -----------------------------------------------------------------------------------------------------
    @contextlib.contextmanager
    def alone(self) -> Iterator[None]:
        """Hold the archive against others who write; whoever dies lets go of it.

        Raises:
            ValueError: another process writes.
        """
        with contextlib.closing(sqlite3.connect(self.folder / LOCK, timeout=0.0, isolation_level=None)) as lock:
            try:
                lock.execute("BEGIN EXCLUSIVE")
            except sqlite3.OperationalError as problem:
                if "locked" not in str(problem):
                    raise ValueError(f"{self.folder / LOCK}: {problem}; check the folder's permissions and the disk") from problem
                raise ValueError(
                    f"{self.folder}: is locked, another process adds to it or removes from it; try again when it has ended"
                ) from None
            try:
                yield
            finally:
                lock.execute("ROLLBACK")


def add_layout(connection: sqlite3.Connection, layout: Layout) -> int:
    """Register what was learned of a layout; its number."""
    skeleton = layout.skeleton
    said = None if skeleton is None else json.dumps([skeleton.name, skeleton.joints, skeleton.bones])
    values = (layout_key(layout.joints, skeleton), layout.joints, said, layout.dump())
    found = connection.execute("INSERT INTO layouts (key, joints, skeleton, learned) VALUES (?, ?, ?, ?)", values)
    return int(found.lastrowid or 0)


def drop_recordings(connection: sqlite3.Connection, source: int) -> int:
    """Take the recordings of a source out; their windows are dead from now on.  How many recordings."""
    connection.execute(
        "UPDATE segments SET dead = dead + (SELECT COALESCE(SUM(windows), 0) FROM recordings WHERE source = ?"
        " AND segment = segments.id) WHERE id IN (SELECT segment FROM recordings WHERE source = ?)",
        (source, source),
    )
    return int(connection.execute("DELETE FROM recordings WHERE source = ?", (source,)).rowcount)


def _skeleton(text: str | None) -> Skeleton | None:
    if text is None:
        return None
    name, joints, bones = json.loads(text)
    return Skeleton(name, tuple(joints), tuple((int(a), int(b)) for a, b in bones))


@contextlib.contextmanager
def _told(folder: Path) -> Iterator[None]:
    """What SQLite says, as one line with a remedy."""
    try:
        yield
    except sqlite3.OperationalError as problem:
        remedy = "another process holds it; try again" if "locked" in str(problem) else "check the disk and the permissions"
        raise ValueError(f"{folder / CATALOGUE}: {problem}; {remedy}") from problem
    except sqlite3.DatabaseError as problem:
        raise ValueError(
            f"{folder / CATALOGUE}: {problem}; restore it from a copy, or add the recordings to a new archive"
        ) from problem
