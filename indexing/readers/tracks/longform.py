"""Tracks as one table: a row per point and view, columns ``frame`` (or ``time``), ``id``, ``x``, ``y`` and perhaps ``z``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from indexing.opening import VALUE, Row, check_dense, clipped, error, listed, shown
from indexing.readers.points.pointset import BoolArray, FloatArray
from indexing.readers.points.table import IDS, STATIC, WEIGHTS, check_widths, column_values, flags, is_data, read_rows
from indexing.readers.tracks.trackset import TrackSet, exact

IntArray = NDArray[np.intp]
VIEWS = ("view", "frame", "image")
TIMES = ("time", "t", "seconds", "timestamp")
EXPECTED = "name the columns frame (or time), id, x, y, and z for 3D points"


def heading(path: Path) -> list[str]:
    """The headings of a table, in small letters; empty where its first row is data."""
    rows = read_rows(path)
    return [cell.strip().lower() for cell in rows[0][1]] if rows and not is_data(rows[0][1]) else []


def is_long(names: Sequence[str]) -> bool:
    """Whether these are headings of tracks, rather than of the points of one view."""
    return bool({*VIEWS, *TIMES} & set(names)) and {"x", "y"} <= set(names)


def check_headings(path: Path) -> None:
    """Raise on a table that is neither of tracks nor of the points of one view, with the columns that tracks need.

    Raises:
        ValueError: rows without headings, or headings without x and y.
    """
    names = heading(path)
    if not names and read_rows(path):
        raise error(path, "row 1 holds numbers, and no row names the columns", EXPECTED)
    if names and not ({"x", "y"} <= set(names) or {"x1", "y1"} <= set(names)):
        raise error(path, f"its columns are {listed(names)}", EXPECTED)


def read_long(path: Path) -> TrackSet:
    """The tracks of a table; rows that are absent and cells that are empty are missing observations.

    Raises:
        ValueError: columns that are absent, cells that are no numbers, a point twice in a view, a view with several times.
    """
    rows, names = read_rows(path)[1:], heading(path)
    if not rows:
        raise error(path, "the file has a header but no rows", "export it again")
    check_widths(path, rows, names)
    point = next((names.index(name) for name in IDS if name in names), None)
    if point is None:
        raise error(path, f"no column names the points (its columns are {listed(names)})", EXPECTED)
    timed = next((name for name in TIMES if name in names), None)
    viewed = next((name for name in VIEWS if name in names), timed)
    assert viewed is not None  # is_long
    axes = [axis for axis in ("x", "y", "z") if axis in names]
    xyz = column_values(path, rows, names, axes)
    place = _present(path, rows, names, viewed)
    moments, views = np.unique(place, return_inverse=True)
    ids: dict[str, int] = {}
    columns = np.array([ids.setdefault(_named(path, line, cells[point], names[point]), len(ids)) for line, cells in rows])
    _once(path, rows, names[point], views, columns, moments)
    shape = (len(moments), len(ids))
    same = "give a point the same name, and a frame the same number, in all of its rows"
    check_dense(path, len(moments) * len(ids), len(rows), f"{len(moments)} views and {len(ids)} points", same)
    values = np.full((*shape, len(axes)), np.nan)
    values[views, columns] = xyz
    return TrackSet(
        str(path), values, tuple(ids), tuple(exact(moment) for moment in moments),
        None if timed is None else moments if timed == viewed else _times(path, rows, names, timed, views, moments),
        _weights(path, rows, names, views, columns, shape), _static(path, rows, names, columns, len(ids)),
        by_time=timed == viewed,
    )  # fmt: skip


def _present(path: Path, rows: Sequence[Row], names: Sequence[str], column: str) -> FloatArray:
    """A column of numbers of which none may be missing."""
    found = column_values(path, rows, names, [column])[:, 0]
    if np.isnan(found).any():
        line = rows[int(np.flatnonzero(np.isnan(found))[0])][0]
        raise error(path, f"row {line}, column {shown(column)}: is empty", "every row needs the view that it belongs to")
    return found


def _named(path: Path, line: int, cell: str, column: str) -> str:
    if not cell.strip():
        raise error(path, f"row {line}, column {shown(column)}: is empty", "name the point")
    return cell.strip()


def _once(path: Path, rows: Sequence[Row], point: str, views: IntArray, columns: IntArray, moments: FloatArray) -> None:
    before: dict[tuple[int, int], int] = {}
    for (line, cells), view, column in zip(rows, views.tolist(), columns.tolist(), strict=True):
        if (view, column) in before:
            again = f"was in frame {exact(moments[view])} before, in row {before[view, column]}"
            said = f"row {line}: point {column + 1} of the file {again}"
            raise error(
                path,
                f"{said} (row: {clipped(', '.join(cells), VALUE)})",
                f"give each point one row per frame; column {shown(point)} names it",
            )
        before[view, column] = line


def _times(path: Path, rows: Sequence[Row], names: Sequence[str], column: str, views: IntArray, moments: FloatArray) -> FloatArray:
    found = _present(path, rows, names, column)
    out = found[np.unique(views, return_index=True)[1]]
    wrong = np.flatnonzero(found != out[views])
    if len(wrong):
        line, view = rows[wrong[0]][0], views[wrong[0]]
        said = (
            f"row {line}: frame {exact(moments[view])} has the {column} {exact(found[wrong[0]])} here and {exact(out[view])} before"
        )
        raise error(path, said, "a view has one time")
    return out


def _weights(
    path: Path, rows: Sequence[Row], names: Sequence[str], views: IntArray, columns: IntArray, shape: tuple[int, int]
) -> FloatArray | None:
    column = next((name for name in WEIGHTS if name in names), None)
    if column is None:
        return None
    found = np.nan_to_num(column_values(path, rows, names, [column])[:, 0])
    if (found < 0).any():
        at = int(np.flatnonzero(found < 0)[0])
        raise error(path, f"row {rows[at][0]}, column {shown(column)}: the weight is {found[at]:g}", "weights are 0 or more")
    out = np.zeros(shape)
    out[views, columns] = found
    return out


def _static(path: Path, rows: Sequence[Row], names: Sequence[str], columns: IntArray, count: int) -> BoolArray | None:
    """A point is static where all of its rows say so."""
    if not set(STATIC) & set(names):
        return None
    found = np.asarray(flags(path, rows, names))
    out = np.ones(count, dtype=bool)
    out[columns[~found]] = False
    return out
