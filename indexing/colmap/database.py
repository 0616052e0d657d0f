"""COLMAP's database: what is read of it, and the copy that is written; the database itself is never written to.

SQLite does both, whatever version of COLMAP made the database: opened by COLMAP itself, an older one would be changed to the newest
form.  Matrices and points are rows of little-endian numbers; a pair of images has the number ``(2**31 - 1) * first + second``.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing.opening import clip_text, error, listing, size_of

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
NEEDED = {
    "cameras": ("camera_id", "model", "width", "height", "params"),
    "images": ("image_id", "name", "camera_id"),
    "keypoints": ("image_id", "rows", "cols", "data"),
    "matches": ("pair_id", "rows", "cols", "data"),
    "two_view_geometries": ("pair_id", "rows", "cols", "data", "config"),
}
"""Tables and their columns, in every version of COLMAP."""
OPEN = "-wal", "-journal"  # what SQLite writes beside a database that a program has open
MAKE = "give the database that colmap feature_extractor and a matcher write"


@dataclass(frozen=True, eq=False)
class DatabaseCamera:
    """A camera: COLMAP's number of its model, its size in pixels, its parameters, and whether its focal length was known."""

    model: int
    width: int
    height: int
    params: FloatArray
    prior: bool


@dataclass(frozen=True, eq=False)
class DatabaseImage:
    """An image: its number and name in the database, its camera, and its keypoints ``(n, 2)``, 0.5 = middle of the first pixel."""

    key: int
    name: str
    camera: DatabaseCamera
    points: FloatArray


@dataclass(frozen=True, eq=False)
class DatabasePair:
    """Matches of two images: the pair's number, the places of both images in the list of them, rows of keypoints ``(m, 2)``."""

    key: int
    first: int
    second: int
    matches: IntArray


@dataclass(frozen=True, eq=False)
class MatchDatabase:
    """What a database holds.

    Attributes:
        path: the file.
        images: in the order of their numbers.
        pairs: with at least one match, in the order of their numbers.
    """

    path: Path
    images: tuple[DatabaseImage, ...]
    pairs: tuple[DatabasePair, ...]

    @property
    def matches(self) -> int:
        """Of all pairs."""
        return sum(len(pair.matches) for pair in self.pairs)


@dataclass(frozen=True, eq=False)
class PairGeometry:
    """What COLMAP keeps of two views: its number of the configuration, inlier matches ``(m, 2)``, and matrices, None = none."""

    config: int
    inliers: IntArray
    F: FloatArray | None = None
    E: FloatArray | None = None
    H: FloatArray | None = None


def read_database(path: str | Path) -> MatchDatabase:
    """Read images, keypoints and matches of a COLMAP database; the file stays as it is.

    Matches are those that the matcher found; of pairs that have none of these, the inlier matches.

    Raises:
        ValueError: no such file, no COLMAP database, no matches, or entries that contradict each other; one line with the remedy.
    """
    path = Path(path).expanduser()
    _check_file(path)
    try:
        with contextlib.closing(_connect(path)) as database:
            _check_tables(path, database)
            images = _images(path, database)
            places = {image.key: place for place, image in enumerate(images)}
            found = _pairs(path, database, "two_view_geometries") | _pairs(path, database, "matches")
    except sqlite3.Error as problem:
        raise error(path, f"cannot be read ({problem})", "close what writes it, or make it again with COLMAP") from None
    pairs = tuple(_pair(path, key, rows, images, places) for key, rows in sorted(found.items()))
    if not pairs:
        raise error(path, f"holds {len(images)} images and no matches", "run a matcher first, such as colmap exhaustive_matcher")
    return MatchDatabase(path, images, pairs)


def _check_file(path: Path) -> None:
    size_of(path, MAKE, "database")
    try:
        with open(path, "rb") as stream:
            head = stream.read(16)
    except OSError as problem:
        raise error(path, f"cannot be opened ({problem.strerror or problem})", "check its permissions") from None
    if head != b"SQLite format 3\0":
        raise error(path, "is no SQLite database" if head else "is empty", MAKE)


def _connect(path: Path) -> sqlite3.Connection:
    """The database, to read; one that no other program has open, without a file of SQLite's beside it, not even for a moment."""
    busy = any(Path(f"{path}{end}").exists() for end in OPEN)
    return sqlite3.connect(f"{path.resolve().as_uri()}?{'mode=ro' if busy else 'mode=ro&immutable=1'}", uri=True)


def _columns(database: sqlite3.Connection, table: str) -> list[str]:
    return [str(row[1]) for row in database.execute(f"PRAGMA table_info({table})")]


def _check_tables(path: Path, database: sqlite3.Connection) -> None:
    tables = [str(row[0]) for row in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
    for table, names in NEEDED.items():
        if table not in tables:
            raise error(path, f"is no database of COLMAP: it has no table {table} (its tables are {listing(tables)})", MAKE)
        there = _columns(database, table)
        lacking = [name for name in names if name not in there]
        if lacking:
            raise error(path, f"is no database of COLMAP: its table {table} has no column {lacking[0]}", MAKE)


def _images(path: Path, database: sqlite3.Connection) -> tuple[DatabaseImage, ...]:
    prior = "prior_focal_length" if "prior_focal_length" in _columns(database, "cameras") else "0"
    cameras = {}
    for key, model, width, height, params, known in database.execute(
        f"SELECT camera_id, model, width, height, params, {prior} FROM cameras"
    ):
        if not (isinstance(width, int) and isinstance(height, int) and width > 0 and height > 0):
            raise error(path, f"camera {key} has a size of {width} x {height}", "extract the features again")
        cameras[key] = DatabaseCamera(model, width, height, _numbers(path, f"camera {key}", params, "<f8"), bool(known))
    points = {}
    for key, rows, columns, data in database.execute("SELECT image_id, rows, cols, data FROM keypoints"):
        points[key] = _table(path, f"keypoints of image {key}", data, "<f4", rows, columns)[:, :2].astype(np.float64)
    images = []
    for key, name, camera in database.execute("SELECT image_id, name, camera_id FROM images ORDER BY image_id"):
        if camera not in cameras:
            raise error(path, f"image {clip_text(name)} has camera {camera}, which is not there", "extract the features again")
        images.append(DatabaseImage(key, str(name), cameras[camera], points.get(key, np.zeros((0, 2)))))
    return tuple(images)


def _numbers(path: Path, what: str, data: Any, kind: str) -> NDArray[Any]:
    data = data or b""
    if not isinstance(data, bytes) or len(data) % np.dtype(kind).itemsize:
        raise error(path, f"{what}: no row of numbers", "make it again with COLMAP")
    return np.frombuffer(data, dtype=kind)


def _table(path: Path, what: str, data: Any, kind: str, rows: int, columns: int) -> NDArray[Any]:
    values = _numbers(path, what, data, kind)
    if rows and (columns < 2 or rows * columns != len(values)):
        raise error(path, f"{what}: {rows} rows of {columns}, and {len(values)} numbers", "make it again with COLMAP")
    values = values.reshape(rows, columns) if rows else np.zeros((0, 2), dtype=kind)
    if values.dtype.kind == "f" and not np.isfinite(values[:, :2]).all():
        raise error(path, f"{what}: a coordinate is no number", "extract the features again")
    return values


def _pairs(path: Path, database: sqlite3.Connection, table: str) -> dict[int, IntArray]:
    """Matches of the pairs that have some, by the pair's number."""
    found = database.execute(f"SELECT pair_id, rows, cols, data FROM {table} WHERE rows > 0")
    return {key: _table(path, f"{table} {key}", data, "<u4", rows, cols)[:, :2].astype(np.int64) for key, rows, cols, data in found}


def _pair(path: Path, key: int, rows: IntArray, images: Sequence[DatabaseImage], places: Mapping[int, int]) -> DatabasePair:
    first, second = divmod(key, 2**31 - 1)
    missing = [image for image in (first, second) if image not in places]
    if missing:
        raise error(path, f"matches of pair {key} are of image {missing[0]}, which is not there", "match the images again")
    pair = DatabasePair(key, places[first], places[second], rows)
    for place, column in ((pair.first, rows[:, 0]), (pair.second, rows[:, 1])):
        image = images[place]
        if column.max() >= len(image.points):
            said = f"a match of image {clip_text(image.name)} is keypoint {column.max()}, and it has {len(image.points)}"
            raise error(path, said, "match the images again")
    return pair


# ----------------------------------------------------------------------------------------------------------------------
# The copy.


def check_target(path: str | Path, source: Path) -> Path:
    """The file to write, if it is there to be written.

    Raises:
        ValueError: it is the database itself, or there is something of its name already.
    """
    path = Path(path).expanduser()
    if path.exists() and source.exists() and path.samefile(source):
        raise error(path, "is the database that is read, and stays as it is", "choose another name for --out")
    for there in (path, *(Path(f"{path}{end}") for end in OPEN)):
        if there.exists() or there.is_symlink():
            raise error(there, "is there already", "choose another name for --out, or move it away")
    return path


def write_database(
    source: MatchDatabase, path: str | Path, matches: Mapping[int, IntArray], geometries: Mapping[int, PairGeometry]
) -> Path:
    """Write a copy of a database with other matches and geometries of its pairs; everything else is as it was. matches
    ``(m, 2)``."""
    path = check_target(path, source.path)
    with (
        _atomic_file(path) as temporary,
        contextlib.closing(_connect(source.path)) as old,
        contextlib.closing(sqlite3.connect(temporary)) as new,
    ):
        old.backup(new)
        new.execute("PRAGMA journal_mode = DELETE")  # one file, whatever the database was
        with new:
            _replace(new, matches, geometries)
    return path


@contextlib.contextmanager
def _atomic_file(path: Path) -> Iterator[Path]:
    """A temporary name beside a file, which becomes its name at the end."""
    temporary = path.parent / f".dyntorch-{secrets.token_hex(8)}.tmp"
    try:
        yield temporary
        os.replace(temporary, path)
    except (sqlite3.Error, OSError) as problem:
        raise error(path, f"cannot be written ({problem})", "free the name or the disk, or choose another folder") from None
    finally:
        for end in ("", *OPEN, "-shm"):
            with contextlib.suppress(OSError):
                Path(f"{temporary}{end}").unlink()


def _replace(database: sqlite3.Connection, matches: Mapping[int, IntArray], geometries: Mapping[int, PairGeometry]) -> None:
    rows = [(len(kept), _blob(kept, "<u4"), key) for key, kept in matches.items()]
    database.executemany("UPDATE matches SET rows = ?, cols = 2, data = ? WHERE pair_id = ? AND rows > 0", rows)
    columns = _columns(database, "two_view_geometries")
    database.execute("DELETE FROM two_view_geometries")
    for key, found in geometries.items():
        values: dict[str, Any] = {
            "pair_id": key,
            "rows": len(found.inliers),
            "cols": 2,
            "data": _blob(found.inliers, "<u4"),
            "config": found.config,
            **{name: None if (held := getattr(found, name)) is None else _blob(held, "<f8") for name in "FEH"},
        }
        values = {name: value for name, value in values.items() if name in columns}
        marks = ", ".join("?" * len(values))
        database.execute(f"INSERT INTO two_view_geometries ({', '.join(values)}) VALUES ({marks})", tuple(values.values()))


def _blob(values: NDArray[Any], kind: str) -> bytes:
    return np.ascontiguousarray(values, dtype=kind).tobytes()
