"""The points of one view, as every format gives them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing.opening import Row, error, first_duplicate, listing, quote, read_bytes
from indexing.opening import read_rows as rows_of
from indexing.readers.npz import NumpyArchive
from indexing.readers.npz import read_npy as read_npy_file

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class PointSet:
    """Points or lines of one view."""

    path: str  # where they come from, with the frame or the key where the file holds several views
    values: FloatArray  # ``(n, d)`` points, ``(n, 2, 3)`` lines by two points each, or ``(n, 6)`` lines in Pluecker coordinates
    ids: tuple[str, ...] | None = None  # a name for each; None = they have none
    weights: FloatArray | None = None  # ``(n,)`` not negative; None = all equal
    static: BoolArray | None = None  # ``(n,)`` known not to move; None = not known of any

    @property
    def lines(self) -> bool:
        """Whether these are lines."""
        return self.values.ndim == 3 or self.values.shape[-1] == 6

    def select_rows(self, rows: NDArray[np.intp], ids: tuple[str, ...]) -> PointSet:
        """Some rows, in an order, under these names."""
        weights = None if self.weights is None else self.weights[rows]
        return PointSet(self.path, self.values[rows], ids, weights, None if self.static is None else self.static[rows])


def as_view(values: Any, path: str | Path, lines: bool = False) -> FloatArray:
    """An array of a file as points ``(n, 2 | 3)`` or lines ``(n, 2, 3)`` or ``(n, 6)``, float64."""
    array = np.asarray(values)
    expected = "lines are (n, 2, 3), two points each, or (n, 6), Pluecker" if lines else "points are (n, 2) or (n, 3)"
    if array.dtype.kind not in "fiu":
        raise error(path, f"holds values of type {array.dtype}", "give real numbers")
    fits = array.shape[1:] in ((2, 3), (6,)) if lines else array.shape[1:] in ((2,), (3,))
    if array.ndim < 2 or not fits:
        raise error(path, f"the array has shape {array.shape}", expected)
    if not len(array):
        raise error(path, "the array is empty", "give at least one row")
    infinite = np.argwhere(np.isinf(array))
    if len(infinite):
        at = tuple(int(i) for i in infinite[0])
        raise error(path, f"row {at[0] + 1}, column {at[-1] + 1}: {array[at]} is not finite", "correct it, or use NaN for missing")
    with np.errstate(invalid="ignore"):  # of bytes that are no number of any kind, but NaN
        return array.astype(np.float64)


# ----------------------------------------------------------------------------------------------------------------------
# Points over time: files of which two or three frames are the views.


@dataclass(frozen=True, eq=False)
class PointSequence:
    """Points over time."""

    path: str  # the file
    values: FloatArray  # ``(frames, n, d)``, NaN = missing
    ids: tuple[str, ...] | None = None  # ``n`` names; None = none
    first: int = 0  # number of the first frame
    rate: float = 0.0  # frames per second; 0 = not known
    units: str = ""  # of the values; up: the direction that is up, as of a clip. Empty = not known
    up: str = ""

    def views(self, frames: tuple[int, ...] | None) -> list[PointSet]:
        """The frames of these numbers; without numbers, all, where there are two or three."""
        count = len(self.values)
        last = self.first + count - 1
        if frames is None:
            if count not in (2, 3):
                middle = (self.first + last) // 2
                example = f"--frames {self.first},{middle},{last}"
                raise error(self.path, f"has {count} frames ({self.first} to {last})", f"say which are the views: {example}")
            frames = tuple(range(self.first, last + 1))
        for frame in frames:
            if not self.first <= frame <= last:
                raise error(self.path, f"has no frame {frame}", f"its frames are {self.first} to {last}")
        return [PointSet(f"{self.path} frame {frame}", self.values[frame - self.first], self.ids) for frame in frames]


# ----------------------------------------------------------------------------------------------------------------------
# Points and lines as CSV: a row each, columns ``x,y``, ``x,y,z`` or ``x1,y1,z1,x2,y2,z2``, with or without a header.


IDS = ("id", "name", "marker", "point", "track", "label")  # headings of the column that names a row, the best one first
WEIGHTS, STATIC = ("weight", "weights"), ("static",)
LINE = ("x1", "y1", "z1", "x2", "y2", "z2")
SHAPES = (LINE, ("x", "y", "z"), ("x", "y"))
MISSING = ("", "na", "n/a", "nan", "none", "null")
EXPECTED = "name the columns x,y or x,y,z, of lines x1,y1,z1,x2,y2,z2, and a column of names id"


def read_csv(path: Path) -> PointSet:
    """The points of a CSV file; ``;`` and tabs separate, too."""
    rows, names, columns = split_header(path, read_rows(path), SHAPES, EXPECTED, IDS)
    values = column_values(path, rows, names, columns)
    values = values.reshape(-1, 2, 3) if columns == LINE else values
    return PointSet(
        str(path), values, row_names(path, rows, names), optional_column(path, rows, names, WEIGHTS), flags(path, rows, names)
    )


def split_header(
    path: Path, rows: list[Row], shapes: Sequence[tuple[str, ...]], remedy: str, single: Sequence[str]
) -> tuple[list[Row], list[str], tuple[str, ...]]:
    """Rows of data, the names of their columns, and those of the coordinates: the first of some shapes that the table has.

    Without a header the columns are those of a shape, perhaps with a name before them; columns of ``single`` must not come twice.
    """
    if not rows:
        raise error(path, "the file is empty", "export it again")
    cells = rows[0][1]
    if is_data(cells):
        named = ["id"] * (number(cells[0]) is None)  # words before numbers name the rows
        shape = next((shape for shape in shapes if len(shape) == len(cells) - len(named)), None)
        if shape is None:
            raise error(path, f"row 1 has {len(cells)} columns, and no row names them", remedy)
        names = [*named, *shape]
    else:
        names, rows = [cell.strip().lower() for cell in cells], rows[1:]
        if not rows:
            raise error(path, "the file has a header but no rows", "export it again")
    columns = next((shape for shape in shapes if set(shape) <= set(names)), None)
    if columns is None:
        raise error(path, f"its columns are {listing(names)}", remedy)
    check_widths(path, rows, names)
    twice = first_duplicate(name for name in names if name in (*columns, *single))
    if twice is not None:
        raise error(path, f"there are two columns {quote(twice)}", "leave one of them out")
    return rows, names, columns


def read_rows(path: Path) -> list[Row]:
    """Line number (1-based) and cells of every row that is not blank."""
    return list(rows_of(path, "give points as CSV, npz, npy, PLY or C3D"))


def check_widths(path: Path, rows: Sequence[Row], names: Sequence[str]) -> None:
    """Raise on a row with other than a cell per column."""
    for line, cells in rows:
        if len(cells) != len(names):
            raise error(path, f"row {line} has {len(cells)} cells, the first row {len(names)}", "correct the row")


def is_data(cells: Sequence[str]) -> bool:
    """Whether a row is one of numbers (and perhaps a name before them) rather than a header."""
    return any(number(cell) is not None and cell.strip().lower() not in MISSING for cell in cells)


def number(cell: str) -> float | None:
    if cell.strip().lower() in MISSING:
        return math.nan
    try:
        return float(cell)
    except ValueError:
        return None


def column_values(path: Path, rows: Sequence[Row], names: Sequence[str], columns: Sequence[str]) -> FloatArray:
    places = [names.index(name) for name in columns]
    out = np.empty((len(rows), len(columns)))
    for i, (line, cells) in enumerate(rows):
        for j, (name, place) in enumerate(zip(columns, places, strict=True)):
            value = number(cells[place])
            if value is None or math.isinf(value):
                what = "is not a number" if value is None else "is not finite"
                where = f"row {line}, column {quote(name)}"
                raise error(path, f"{where}: {quote(cells[place])} {what}", "correct the cell or leave it empty")
            out[i, j] = value
    return out


def row_names(path: Path, rows: Sequence[Row], names: Sequence[str], known: Sequence[str] = IDS) -> tuple[str, ...] | None:
    """The names of the rows, from the first column that is known to hold such; None = no column does."""
    column = next((names.index(name) for name in known if name in names), None)
    if column is None:
        return None
    lines: dict[str, int] = {}
    for line, cells in rows:
        name = cells[column].strip()
        if not name:
            raise error(path, f"row {line}, column {quote(names[column])}: is empty", "name the row, or leave the column out")
        if name in lines:
            message = f"row {line}, column {quote(names[column])}: {quote(name)} was in row {lines[name]}, too"
            raise error(path, message, "give each row a name of its own")
        lines[name] = line
    return tuple(lines)


def optional_column(path: Path, rows: Sequence[Row], names: Sequence[str], known: Sequence[str]) -> FloatArray | None:
    name = next((name for name in known if name in names), None)
    return None if name is None else column_values(path, rows, names, [name])[:, 0]


def flags(path: Path, rows: Sequence[Row], names: Sequence[str]) -> np.ndarray | None:
    words = {"true": "1", "yes": "1", "false": "0", "no": "0", "": "0"}
    plain = [(line, [words.get(cell.strip().lower(), cell) for cell in cells]) for line, cells in rows]
    values = optional_column(path, plain, names, STATIC)
    if values is not None and not np.isin(values, (0, 1)).all():
        at = int(np.flatnonzero(~np.isin(values, (0, 1)))[0])
        raise error(path, f"row {rows[at][0]}, column 'static': {values[at]:g} is neither 0 nor 1", "use 1 for known static")
    return None if values is None else values == 1


# ----------------------------------------------------------------------------------------------------------------------
# Points and lines as numpy arrays: ``.npy`` with one view or several, ``.npz`` with all views of the matches.


KEYS = "keys are x1, x2, x3 (2D), P1, P2, P3 (3D) or l1, l2 (lines), also ids, weights, static, and with lines static1, static2"
EXTRA = ("ids", "weights", "static", "static1", "static2")


def read_npy(path: Path) -> PointSet | PointSequence:
    """One view ``(n, d)``, lines ``(n, 2, 3)`` or ``(n, 6)``, or several views ``(views, n, d)``."""
    array = read_npy_file(path)
    if array.ndim == 3 and array.shape[1:] != (2, 3) and array.shape[-1] in (2, 3):
        return PointSequence(str(path), as_view(array.reshape(-1, array.shape[-1]), path).reshape(array.shape))
    lines = array.ndim == 3 or array.shape[-1:] == (6,)
    return PointSet(str(path), as_view(array, path, lines))


def read_npz(path: Path) -> tuple[list[PointSet], list[PointSet]]:
    """All views, and for lines the static points of both."""
    archive = NumpyArchive(path)
    names = list(archive)
    prefix = next((prefix for prefix in ("x", "P", "l") if f"{prefix}1" in names), None)
    if prefix is None:
        raise error(path, f"its arrays are {listing(names)}", KEYS)
    unknown = [name for name in names if name not in EXTRA and not (name[:1] == prefix and name[1:] in ("1", "2", "3"))]
    if unknown:
        raise error(path, f"has an array {quote(unknown[0])}, which is not known", KEYS)
    wanted = [f"{prefix}{i}" for i in ((1, 2) if prefix == "l" else (1, 2, 3))]
    missing = [name for name in wanted if name not in names]
    if missing:
        raise error(path, f"has {wanted[0]} but no {missing[0]}", KEYS)
    extra = {name: archive[name] for name in EXTRA if name in names}
    views = []
    for name in wanted:
        where = f"{path} {name}"
        values = as_view(archive[name], where, lines=prefix == "l")
        for field in ("ids", "weights", "static"):
            if field in extra and extra[field].shape != (len(values),):
                raise error(path, f"{field} has shape {extra[field].shape}, {name} has {len(values)} rows", "give one per row")
        ids = tuple(map(str, extra["ids"].tolist())) if "ids" in extra else None
        views.append(PointSet(where, values, ids, _weights(path, extra), _static(path, extra)))
    places = {f"{path} {name}": extra[name] for name in ("static1", "static2") if name in extra}
    return views, [PointSet(where, as_view(values, where)) for where, values in places.items()]


def _weights(path: Path, extra: dict[str, Any]) -> Any:
    if "weights" not in extra:
        return None
    if extra["weights"].dtype.kind not in "fiub":
        raise error(path, f"weights are of type {extra['weights'].dtype}", "give real numbers")
    return extra["weights"].astype(np.float64)


def _static(path: Path, extra: dict[str, Any]) -> Any:
    if "static" not in extra:
        return None
    if not np.isin(extra["static"], (0, 1)).all():
        raise error(path, "static holds other values than 0 and 1", "use 1 for matches known to be static")
    return extra["static"].astype(bool)


# ----------------------------------------------------------------------------------------------------------------------
# Vertices of PLY files (ASCII and binary): what 3D scanners and CloudCompare, MeshLab, Open3D write


PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
MAX_PLY_HEADER = 65536  # bytes; a header takes a few hundred


@dataclass
class PlyElement:
    """A table of a PLY file: so many rows with these properties (name, numpy type); None = it has lists."""

    name: str
    rows: int
    properties: list[tuple[str, str]] | None


def read_ply(path: Path) -> PointSet:
    """The vertices; a property ``id`` names them."""
    data = read_bytes(path)
    order, elements, start = _ply_header(path, data)
    before: list[PlyElement] = []
    for element in elements:
        if element.name == "vertex":
            break
        before.append(element)
    else:
        raise error(path, "has no element 'vertex'", "export a point cloud")
    kinds = element.properties
    if kinds is None:
        raise error(path, "its vertices have list properties", "export plain x, y, z")
    names = [name for name, _ in kinds]
    missing = [name for name in "xyz" if name not in names]
    if missing:
        raise error(path, f"its vertices have no property {quote(missing[0])} (they have {listing(names)})", "export x, y, z")
    if not element.rows:
        raise error(path, "has no vertices", "export a point cloud")
    read_rows = _ply_rows if order == "" else _ply_records
    columns = read_rows(path, data[start:], order, before, element)
    ids = None
    if "id" in columns:
        ids = tuple(f"{value:g}" for value in columns["id"])
        twice = first_duplicate(ids)
        if twice is not None:
            raise error(path, f"property 'id': {twice} names several vertices", "give each vertex an id of its own")
    return PointSet(str(path), as_view(np.stack([columns[name] for name in "xyz"], axis=-1), path), ids)


def _ply_header(path: Path, data: bytes) -> tuple[str, list[PlyElement], int]:
    """Byte order ('' = ASCII), elements, and where the rows begin."""
    end = data.find(b"end_header", 0, MAX_PLY_HEADER)
    newline = data.find(b"\n", end)
    if end < 0 or newline < 0:
        raise error(path, "the PLY header has no end_header", "the file may be truncated: export it again")
    order, elements = None, []
    for line in data[:end].decode("ascii", "replace").splitlines():
        words = line.split()
        try:
            if words[:1] == ["format"]:
                order = PLY_ORDERS[words[1]]
            elif words[:1] == ["element"]:
                elements.append(PlyElement(words[1], int(words[2]), []))
                if not 0 <= elements[-1].rows <= len(data):
                    raise ValueError(words[2])
            elif words[:2] == ["property", "list"]:
                elements[-1].properties = None
            elif words[:1] == ["property"] and elements[-1].properties is not None:
                elements[-1].properties.append((words[2], PLY_TYPES[words[1]]))
        except (IndexError, KeyError, ValueError):
            raise error(path, f"the PLY header has the line {quote(line)}, which makes no sense", "export it again") from None
    if order is None:
        raise error(path, "the PLY header has no format", "export it again")
    return order, elements, newline + 1


def _ply_rows(path: Path, data: bytes, order: str, before: list[PlyElement], element: PlyElement) -> dict[str, FloatArray]:
    rows = [line.split() for line in data.decode("ascii", "replace").splitlines() if line.strip()]
    rows = rows[sum(other.rows for other in before) :][: element.rows]
    if len(rows) < element.rows:
        raise error(path, f"has {len(rows)} of {element.rows} vertices", "the file may be truncated: export it again")
    names = [name for name, _ in element.properties or []]
    columns: dict[str, FloatArray] = {name: np.empty(element.rows) for name in names}
    for i, words in enumerate(rows):
        if len(words) != len(names):
            raise error(path, f"vertex {i + 1} has {len(words)} values, the header {len(names)}", "export it again")
        for name, word in zip(names, words, strict=True):
            try:
                columns[name][i] = float(word)
            except ValueError:
                raise error(path, f"vertex {i + 1}, {quote(name)}: {quote(word)} is not a number", "correct the value") from None
    return columns


def _ply_records(path: Path, data: bytes, order: str, before: list[PlyElement], element: PlyElement) -> dict[str, FloatArray]:
    skip = 0
    for other in before:
        if other.properties is None:
            raise error(path, f"the lists of {quote(other.name)} come before the vertices", "export a point cloud only")
        skip += other.rows * _ply_type(order, other).itemsize
    kind = _ply_type(order, element)
    if len(data) < skip + element.rows * kind.itemsize:
        rows = max(0, len(data) - skip) // kind.itemsize
        raise error(path, f"has {rows} of {element.rows} vertices", "the file may be truncated: export it again")
    table = np.frombuffer(data, kind, count=element.rows, offset=skip)
    with np.errstate(invalid="ignore"):  # of bytes that are no number of any kind, but NaN
        return {name: table[f"{i}"].astype(np.float64) for i, (name, _) in enumerate(element.properties or [])}


def _ply_type(order: str, element: PlyElement) -> np.dtype[np.void]:
    # numbered, because names of properties may repeat
    return np.dtype([(f"{i}", order + kind) for i, (_, kind) in enumerate(element.properties or [])])
