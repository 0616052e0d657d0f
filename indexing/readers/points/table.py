"""Points and lines as CSV: a row each, columns ``x,y``, ``x,y,z`` or ``x1,y1,z1,x2,y2,z2``, with or without a header."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from indexing.opening import Row, error, listed, repeated, shown
from indexing.opening import read_rows as rows_of
from indexing.readers.points.pointset import FloatArray, PointSet

IDS = ("id", "name", "marker", "point", "track", "label")  # headings of the column that names a row, the best one first
WEIGHTS, STATIC = ("weight", "weights"), ("static",)
LINE = ("x1", "y1", "z1", "x2", "y2", "z2")
SHAPES = (LINE, ("x", "y", "z"), ("x", "y"))
MISSING = ("", "na", "n/a", "nan", "none", "null")
EXPECTED = "name the columns x,y or x,y,z, of lines x1,y1,z1,x2,y2,z2, and a column of names id"


def read(path: Path) -> PointSet:
    """The points of a CSV file; ``;`` and tabs separate, too.

    Raises:
        ValueError: no rows, unknown columns, a short row, or a cell that is not a number: with row, column and value.
    """
    rows = read_rows(path)
    if not rows:
        raise error(path, "the file is empty", "export it again")
    header = None if is_data(rows[0][1]) else [cell.strip().lower() for cell in rows[0][1]]
    if header is None:
        names = _unnamed(path, rows[0][1])
    else:
        names, rows = header, rows[1:]
        if not rows:
            raise error(path, "the file has a header but no rows", "export it again")
    check_widths(path, rows, names)
    columns = next((shape for shape in SHAPES if set(shape) <= set(names)), None)
    if columns is None:
        raise error(path, f"its columns are {listed(names)}", EXPECTED)
    twice = repeated(name for name in names if name in (*columns, *IDS))
    if twice is not None:
        raise error(path, f"there are two columns {shown(twice)}", "leave one of them out")
    values = column_values(path, rows, names, columns)
    values = values.reshape(-1, 2, 3) if columns == LINE else values
    return PointSet(
        str(path), values, row_names(path, rows, names), optional_column(path, rows, names, WEIGHTS), flags(path, rows, names)
    )


def read_rows(path: Path) -> list[Row]:
    """Line number (1-based) and cells of every row that is not blank."""
    return list(rows_of(path, "give points as CSV, npz, npy, PLY or C3D"))


def check_widths(path: Path, rows: Sequence[Row], names: Sequence[str]) -> None:
    """Raise on a row with other than a cell per column.

    Raises:
        ValueError: naming the row.
    """
    for line, cells in rows:
        if len(cells) != len(names):
            raise error(path, f"row {line} has {len(cells)} cells, the first row {len(names)}", "correct the row")


def is_data(cells: Sequence[str]) -> bool:
    """Whether a row is one of numbers (and perhaps a name before them) rather than a header."""
    return any(number(cell) is not None and cell.strip().lower() not in MISSING for cell in cells)


def _unnamed(path: Path, cells: Sequence[str]) -> list[str]:
    """Names of the columns of a file without a header."""
    named = number(cells[0]) is None  # words before numbers name the rows
    size = len(cells) - named
    shape = next((shape for shape in SHAPES if len(shape) == size), None)
    if shape is None:
        raise error(path, f"row 1 has {len(cells)} columns and there is no header", EXPECTED)
    return [*(["id"] if named else []), *shape]


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
                raise error(
                    path, f"row {line}, column {shown(name)}: {shown(cells[place])} {what}", "correct the cell or leave it empty"
                )
            out[i, j] = value
    return out


def row_names(path: Path, rows: Sequence[Row], names: Sequence[str], known: Sequence[str] = IDS) -> tuple[str, ...] | None:
    """The names of the rows, from the first column that is known to hold such; None = no column does.

    Raises:
        ValueError: a row without a name, or two of the same.
    """
    column = next((names.index(name) for name in known if name in names), None)
    if column is None:
        return None
    found: dict[str, int] = {}
    for line, cells in rows:
        name = cells[column].strip()
        if not name:
            raise error(path, f"row {line}, column {shown(names[column])}: is empty", "name the row, or leave the column out")
        if name in found:
            said = f"row {line}, column {shown(names[column])}: {shown(name)} was in row {found[name]}, too"
            raise error(path, said, "give each row a name of its own")
        found[name] = line
    return tuple(found)


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
