"""Files -> tracks, whatever their format."""

from __future__ import annotations

from collections.abc import Sequence as Several
from dataclasses import replace
from pathlib import Path

import numpy as np

from indexing.opening import error, head_of, is_regular, listed, shown, size_of
from indexing.readers.points import PointSet, Sequence, open_points
from indexing.readers.points.pointset import BoolArray
from indexing.readers.points.table import IDS, STATIC, flags, read_rows
from indexing.readers.tracks.arrays import read_arrays
from indexing.readers.tracks.longform import check_headings, heading, is_long, read_long
from indexing.readers.tracks.trackset import TrackSet, numbered

FORMATS = "give a table with columns frame, id, x, y, an array (views, n, 2 or 3), or a file of points for each view"


def read_tracks(
    paths: Several[str | Path], *, frames: Several[str] | None = None, key: str | None = None, static: Path | None = None
) -> TrackSet:
    """Read tracks.

    Args:
        paths: a table with a column ``frame`` or ``time``, an ``.npz``, ``.npy`` or ``.c3d``; or a file of points for each view.
        frames: names of the views to take; all by default.
        key: of an ``.npz`` with several sequences ``key/y``, or several arrays, the one to take.
        static: a file that names the points known to stand still, in a column ``id``; where it has a column ``static``, those
            marked 1.

    Raises:
        ValueError: one line with the file, the field, what is wrong and what to do.

    Example:
        >>> import pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "tracks.csv"
        >>> _ = path.write_text("time,id,x,y\\n0,p,1,2\\n0,q,3,4\\n0.5,p,2,2\\n1.5,q,3,5\\n1.5,p,4,2\\n")
        >>> found = read_tracks([path])
        >>> found.ids, found.times.tolist(), found.values[:, 1].tolist()
        (('p', 'q'), [0.0, 0.5, 1.5], [[3.0, 4.0], [nan, nan], [3.0, 5.0]])
    """
    files = [Path(path).expanduser() for path in paths]
    if not files:
        raise ValueError(f"no files; {FORMATS}")
    found = _read(files, key)
    if frames is not None:
        found = found.select(frames)
    if len(found.views) < 2:
        raise error(found.path, f"holds {len(found.views)} view", FORMATS)
    return found if static is None else replace(found, static=_marked(static.expanduser(), found.ids))


def _read(files: Several[Path], key: str | None) -> TrackSet:
    if len(files) == 1 and _start(files[0]).startswith(b"PK"):
        return read_arrays(files[0], key)
    if key is not None:
        raise error(files[0], f"--key {key}: has no keys", "leave --key out; it is for .npz with several sequences or arrays")
    if len(files) == 1 and _is_text(files[0]):
        if is_long(heading(files[0])):
            return read_long(files[0])
        check_headings(files[0])
    opened = [open_points(path) for path in files]
    first = opened[0]
    if isinstance(first, Sequence) and len(opened) == 1:
        names = tuple(str(first.first + i) for i in range(len(first.values)))
        return TrackSet(first.path, first.values, first.ids or numbered(first.values.shape[1]), names)
    views = []
    for view in opened:
        if isinstance(view, Sequence):
            raise error(view.path, f"holds {len(view.values)} frames", "give such a file alone")
        if view.lines:
            raise error(view.path, "holds lines", "give points")
        views.append(view)
    if len(views) == 1:
        raise error(views[0].path, "holds the points of one view", FORMATS)
    return _joined(views)


def _start(path: Path) -> bytes:
    """The first bytes of a file; none where there is no file."""
    return head_of(path) if is_regular(path) else b""


def _is_text(path: Path) -> bool:
    """Whether the file is a table, rather than arrays or a cloud of points."""
    start = _start(path)
    return bool(start) and b"\0" not in start and not start.startswith(b"ply")


def _joined(views: Several[PointSet]) -> TrackSet:
    """One file per view: by name where all have names, and then a name may be absent from some; otherwise by row."""
    first = views[0]
    odd = next((view for view in views if view.values.shape[1] != first.values.shape[1]), None)
    if odd is not None:
        said = f"holds {odd.values.shape[1]}D points, {first.path} {first.values.shape[1]}D"
        raise error(odd.path, said, "give one kind")
    if all(view.ids is not None for view in views):
        places = {name: i for i, name in enumerate(dict.fromkeys(name for view in views for name in view.ids or ()))}
        rows = [np.array([places[name] for name in view.ids or ()]) for view in views]
        ids = tuple(places)
    else:
        longer = next((view for view in views if len(view.values) != len(first.values)), None)
        if longer is not None:
            said = f"has {len(longer.values)} rows, {first.path} {len(first.values)}"
            raise error(longer.path, said, "give a row per track in every file, or a column id to match the rows by")
        rows, ids = [np.arange(len(first.values))] * len(views), numbered(len(first.values))
    values = np.full((len(views), len(ids), first.values.shape[1]), np.nan)
    weights = np.ones(values.shape[:2])
    still = np.ones(len(ids), dtype=bool)
    for i, (view, row) in enumerate(zip(views, rows, strict=True)):
        values[i, row] = view.values
        if view.weights is not None:
            weights[i, row] = np.nan_to_num(view.weights)
        if view.static is not None:
            still[row] &= view.static
    if (weights < 0).any():
        raise error(first.path, f"a weight is {weights.min():g}", "weights are 0 or more")
    return TrackSet(
        first.path, values, ids, tuple(Path(view.path).name for view in views), None,
        weights if any(view.weights is not None for view in views) else None,
        still if any(view.static is not None for view in views) else None,
    )  # fmt: skip


def _marked(path: Path, ids: Several[str]) -> BoolArray:
    """Points that a file names: those of the column ``id``, or of its only column."""
    size_of(path, "check the path; --static is a CSV with a column id")
    rows = read_rows(path)
    names = [cell.strip().lower() for cell in rows[0][1]] if rows else []
    column = next((names.index(name) for name in IDS if name in names), None)
    if column is not None:
        rows = rows[1:]
    elif rows and len(rows[0][1]) == 1:
        names, column = ["id"], 0
    else:
        raise error(path, "has no column of names", "name the points that stand still in a column id")
    marks = flags(path, rows, names) if set(STATIC) & set(names) else None
    named = {cells[column].strip(): line for i, (line, cells) in enumerate(rows) if marks is None or marks[i]}
    stranger = next((name for name in named if name not in set(ids)), None)
    if stranger is not None:
        raise error(path, f"row {named[stranger]}: no track is named {shown(stranger)}", f"the tracks are {listed(ids, 4)}")
    return np.array([name in named for name in ids])
