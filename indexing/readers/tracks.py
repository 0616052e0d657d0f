"""Files -> tracks, whatever their format."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing.opening import VALUE, Row, check_dense, clip_text, error, head_of, is_regular, listing, quote, size_of
from indexing.readers.matches import open_points
from indexing.readers.npz import NumpyArchive, read_npy
from indexing.readers.points import (
    IDS,
    STATIC,
    WEIGHTS,
    BoolArray,
    FloatArray,
    PointSequence,
    PointSet,
    as_view,
    check_widths,
    column_values,
    flags,
    is_data,
    read_rows,
)

# ----------------------------------------------------------------------------------------------------------------------
# Tracks of points through views, as every format gives them.


@dataclass(frozen=True, eq=False)
class TrackSet:
    """Points followed through views."""

    path: str  # the file, or the first of several
    values: FloatArray  # ``(views, n, 2 | 3)``, NaN = missing
    ids: tuple[str, ...]  # ``n`` names
    views: tuple[str, ...]  # names of the views: frame numbers, times, or files
    times: FloatArray | None = None  # ``(views,)``; None = the files say nothing of time
    weights: FloatArray | None = None  # ``(views, n)`` not negative; None = all equal
    static: BoolArray | None = None  # ``(n,)`` known to stand still; None = not known of any
    notes: tuple[str, ...] = field(default=())  # what a reader should know, a sentence each
    by_time: bool = False  # whether the views are named by their times
    start: float = 0.0  # the time from which ``times`` count, in full: that of the first view where they begin at 0
    known: NDArray[np.int64] | None = None  # ``(n,)`` known labels, 0 outlier, 1.. the bodies; None = not known

    def since_first(self) -> TrackSet:
        """The same with times that begin at 0; views that are named by their times are named by the new ones."""
        if self.times is None:
            return self
        first = float(self.times[0])
        views = relative_names(self.times) if self.by_time else self.views
        return replace(self, views=views, times=self.times - first, start=self.start + first)

    def select(self, frames: Sequence[str]) -> TrackSet:
        """The views of these names, in this order."""
        twice = next((frame for i, frame in enumerate(frames) if frame in frames[:i]), None)
        if twice is not None:
            raise error(self.path, f"frame {twice} is asked for twice", "name each view once")
        lost = next((frame for frame in frames if frame not in self.views), None)
        if lost is not None:
            raise error(self.path, f"has no frame {lost}", f"its {len(self.views)} frames are {self.views[0]} to {self.views[-1]}")
        at = np.array([self.views.index(frame) for frame in frames])
        return replace(
            self,
            values=self.values[at],
            views=tuple(frames),
            times=None if self.times is None else self.times[at],
            weights=None if self.weights is None else self.weights[at],
        )

    def drop_short(self, least: int = 2) -> TrackSet:
        """Without the tracks that fewer views see: of these nothing can be known."""
        count = np.isfinite(self.values).all(axis=-1).sum(axis=0)
        kept = count >= least
        if kept.all():
            return self
        lost = int((~kept).sum())
        was = "track is seen in fewer than {} views and was" if lost == 1 else "tracks are seen in fewer than {} views and were"
        message = f"{lost} {was.format(least)} left out"
        return replace(
            self,
            values=self.values[:, kept],
            ids=tuple(name for name, keep in zip(self.ids, kept, strict=True) if keep),
            weights=None if self.weights is None else self.weights[:, kept],
            static=None if self.static is None else self.static[kept],
            known=None if self.known is None else self.known[kept],
            notes=(*self.notes, message),
        )


def relative_names(times: FloatArray) -> tuple[str, ...]:
    """Times since the first, in as many decimals as they have; in full where that would give two the same name."""
    finest = float(np.spacing(np.abs(times).max()))
    short = tuple(f"{step:.10g}" for step in np.round(times - times[0], int(np.floor(-np.log10(finest)))))
    return short if len(set(short)) == len(short) else tuple(shortest_repr(time - times[0]) for time in times)


def shortest_repr(value: float) -> str:
    """A number with all the digits that it has, and no more."""
    return repr(float(value)).removesuffix(".0")


def default_names(count: int) -> tuple[str, ...]:
    """Names of tracks that have none."""
    return tuple(str(i + 1) for i in range(count))


# ----------------------------------------------------------------------------------------------------------------------
# Tracks as one table: a row per point and view, columns ``frame`` (or ``time``), ``id``, ``x``, ``y`` and perhaps ``z``.


IntArray = NDArray[np.intp]
VIEWS = ("view", "frame", "image")
TIMES = ("time", "t", "seconds", "timestamp")
EXPECTED = "name the columns frame (or time), id, x, y, and z for 3D points"


def read_headings(path: Path) -> list[str]:
    """The headings of a table, in small letters; empty where its first row is data."""
    rows = read_rows(path)
    return [cell.strip().lower() for cell in rows[0][1]] if rows and not is_data(rows[0][1]) else []


def is_long(names: Sequence[str]) -> bool:
    """Whether these are headings of tracks, rather than of the points of one view."""
    return bool({*VIEWS, *TIMES} & set(names)) and {"x", "y"} <= set(names)


def check_headings(path: Path) -> None:
    """Raise on a table that is neither of tracks nor of the points of one view, with the columns that tracks need."""
    names = read_headings(path)
    if not names and read_rows(path):
        raise error(path, "row 1 holds numbers, and no row names the columns", EXPECTED)
    if names and not ({"x", "y"} <= set(names) or {"x1", "y1"} <= set(names)):
        raise error(path, f"its columns are {listing(names)}", EXPECTED)


def read_long(path: Path) -> TrackSet:
    """The tracks of a table; rows that are absent and cells that are empty are missing observations."""
    rows, names = read_rows(path)[1:], read_headings(path)
    if not rows:
        raise error(path, "the file has a header but no rows", "export it again")
    check_widths(path, rows, names)
    point = next((names.index(name) for name in IDS if name in names), None)
    if point is None:
        raise error(path, f"no column names the points (its columns are {listing(names)})", EXPECTED)
    timed = next((name for name in TIMES if name in names), None)
    viewed = next((name for name in VIEWS if name in names), timed)
    assert viewed is not None  # is_long
    axes = [axis for axis in ("x", "y", "z") if axis in names]
    xyz = column_values(path, rows, names, axes)
    place = _complete_column(path, rows, names, viewed)
    moments, views = np.unique(place, return_inverse=True)
    ids: dict[str, int] = {}
    columns = np.array([ids.setdefault(_point_name(path, line, cells[point], names[point]), len(ids)) for line, cells in rows])
    _check_unique(path, rows, names[point], views, columns, moments)
    shape = (len(moments), len(ids))
    same = "give a point the same name, and a frame the same number, in all of its rows"
    check_dense(path, len(moments) * len(ids), len(rows), f"{len(moments)} views and {len(ids)} points", same)
    values = np.full((*shape, len(axes)), np.nan)
    values[views, columns] = xyz
    return TrackSet(
        str(path), values, tuple(ids), tuple(shortest_repr(moment) for moment in moments),
        None if timed is None else moments if timed == viewed else _times(path, rows, names, timed, views, moments),
        _weights(path, rows, names, views, columns, shape), _static(path, rows, names, columns, len(ids)),
        by_time=timed == viewed,
    )  # fmt: skip


def _complete_column(path: Path, rows: Sequence[Row], names: Sequence[str], column: str) -> FloatArray:
    """A column of numbers of which none may be missing."""
    values = column_values(path, rows, names, [column])[:, 0]
    if np.isnan(values).any():
        line = rows[int(np.flatnonzero(np.isnan(values))[0])][0]
        raise error(path, f"row {line}, column {quote(column)}: is empty", "every row needs the view that it belongs to")
    return values


def _point_name(path: Path, line: int, cell: str, column: str) -> str:
    if not cell.strip():
        raise error(path, f"row {line}, column {quote(column)}: is empty", "name the point")
    return cell.strip()


def _check_unique(path: Path, rows: Sequence[Row], point: str, views: IntArray, columns: IntArray, moments: FloatArray) -> None:
    before: dict[tuple[int, int], int] = {}
    for (line, cells), view, column in zip(rows, views.tolist(), columns.tolist(), strict=True):
        if (view, column) in before:
            what = f"row {line} ({clip_text(', '.join(cells), VALUE)}): it was in frame {shortest_repr(moments[view])} before,"
            remedy = f"give each point one row per frame; column {quote(point)} names it"
            raise error(path, f"{what} in row {before[view, column]}", remedy)
        before[view, column] = line


def _times(path: Path, rows: Sequence[Row], names: Sequence[str], column: str, views: IntArray, moments: FloatArray) -> FloatArray:
    stamps = _complete_column(path, rows, names, column)
    out = stamps[np.unique(views, return_index=True)[1]]
    wrong = np.flatnonzero(stamps != out[views])
    if len(wrong):
        line, view = rows[wrong[0]][0], views[wrong[0]]
        here, before = shortest_repr(stamps[wrong[0]]), shortest_repr(out[view])
        message = f"row {line}: frame {shortest_repr(moments[view])} has the {column} {here} here and {before} before"
        raise error(path, message, "a view has one time")
    return out


def _weights(
    path: Path, rows: Sequence[Row], names: Sequence[str], views: IntArray, columns: IntArray, shape: tuple[int, int]
) -> FloatArray | None:
    column = next((name for name in WEIGHTS if name in names), None)
    if column is None:
        return None
    values = np.nan_to_num(column_values(path, rows, names, [column])[:, 0])
    if (values < 0).any():
        at = int(np.flatnonzero(values < 0)[0])
        raise error(path, f"row {rows[at][0]}, column {quote(column)}: the weight is {values[at]:g}", "weights are 0 or more")
    out = np.zeros(shape)
    out[views, columns] = values
    return out


def _static(path: Path, rows: Sequence[Row], names: Sequence[str], columns: IntArray, count: int) -> BoolArray | None:
    """A point is static where all of its rows say so."""
    if not set(STATIC) & set(names):
        return None
    marks = np.asarray(flags(path, rows, names))
    out = np.ones(count, dtype=bool)
    out[columns[~marks]] = False
    return out


# ----------------------------------------------------------------------------------------------------------------------
# Tracks as the arrays of an ``.npz``.


KEYS = "give 'tracks' (views, n, 2 or 3) or 'y' (frames, points, 2), and perhaps 'times', 'ids', 'static', 'weights'"
EXTRA = ("times", "ids", "static", "weights")
VISIBLE = ("vis", "visible", "visibility")
KNOWN = ("label", "labels", "s")  # the last one as in the files of Hopkins 155


def read_arrays(path: Path, key: str | None) -> TrackSet:
    """Tracks of an ``.npz``."""
    archive = NumpyArchive(path)
    before, name = _select_prefix(path, list(archive), key)
    values, extra = archive[name], {kind: archive[before + kind] for kind in EXTRA if before + kind in archive}
    if values.ndim != 3 or values.shape[-1] not in (2, 3):
        raise error(path, f"{name} has shape {values.shape}", KEYS)
    flat = as_view(values.reshape(-1, values.shape[-1]), f"{path} {name}")
    views, n = values.shape[:2]
    for kind, shape in (("times", (views,)), ("ids", (n,)), ("static", (n,)), ("weights", (views, n))):
        if kind in extra and extra[kind].shape != shape:
            raise error(path, f"{kind} has shape {extra[kind].shape}, {name} has {values.shape}", f"expected {shape}")
    ids = tuple(map(str, extra["ids"].tolist())) if "ids" in extra else default_names(n)
    return TrackSet(
        str(path), _hidden(archive, before, flat.reshape(values.shape)), ids, tuple(map(str, range(views))),
        _reals(path, extra, "times"),
        _reals(path, extra, "weights", 0.0), None if "static" not in extra else extra["static"].astype(bool),
        known=_read_labels(archive, before, n),
    )  # fmt: skip


def _hidden(archive: NumpyArchive, before: str, values: FloatArray) -> FloatArray:
    """The same, NaN where the file says that a point is not visible."""
    for name in (before + kind for kind in VISIBLE):
        if name in archive and archive[name].shape == values.shape[:2]:
            return np.where((archive[name] != 0)[..., None], values, np.nan)
    return values


def _read_labels(archive: NumpyArchive, before: str, count: int) -> NDArray[np.int64] | None:
    """Labels of the tracks, where the file has some that can be meant."""
    for name in (before + kind for kind in KNOWN):
        labels = archive[name] if name in archive else np.zeros(0)
        if labels.shape == (count,) and labels.dtype.kind in "iub" and (labels >= 0).all():
            return np.asarray(labels, dtype=np.int64)
    return None


def _select_prefix(path: Path, names: list[str], key: str | None) -> tuple[str, str]:
    """What the names of the arrays begin with, and the name of the tracks."""
    several = [name[:-2] for name in names if name.endswith("/y")]
    if key is not None and key in names:
        return "", key
    if key is not None and key not in several:
        known = f"its sequences are {listing(several)}" if several else f"its arrays are {listing(names)}"
        raise error(path, f"has no {'sequence' if several else 'array'} {quote(key)}", known)
    if key is None and several:
        what = f"holds {len(several)} sequences ({listing(several, 4)})"
        raise error(path, what, f"say which: --key {clip_text(several[0], VALUE)}")
    before = "" if key is None else f"{key}/"
    name = next((f"{before}{kind}" for kind in ("tracks", "y") if f"{before}{kind}" in names), None)
    if name is None:
        others = [other for other in names if other not in EXTRA]
        choice = f"; or say which array has the tracks: --key {clip_text(others[0], VALUE)}" if others else ""
        raise error(path, f"its arrays are {listing(names)}", KEYS + choice)
    return before, name


def _reals(path: Path, extra: dict[str, Any], kind: str, least: float = -np.inf) -> FloatArray | None:
    if kind not in extra:
        return None
    values = extra[kind]
    if values.dtype.kind not in "fiub" or not np.isfinite(values).all() or (values < least).any():
        of = "" if np.isinf(least) else f" of {least:g} or more"
        raise error(path, f"{kind} holds values that are no finite numbers{of}", "correct them")
    return np.asarray(values, dtype=np.float64)


FORMATS = "give a table with columns frame, id, x, y, an array (views, n, 2 or 3), or a file of points for each view"


def read_tracks(
    paths: Sequence[str | Path], *, frames: Sequence[str] | None = None, key: str | None = None, static: Path | None = None
) -> TrackSet:
    """Read tracks."""
    files = [Path(path).expanduser() for path in paths]
    if not files:
        raise ValueError(f"no files; {FORMATS}")
    tracks = _read(files, key)
    if frames is not None:
        tracks = tracks.select(frames)
    if len(tracks.views) < 2:
        raise error(tracks.path, f"holds {len(tracks.views)} view", FORMATS)
    return tracks if static is None else replace(tracks, static=_static_points(static.expanduser(), tracks.ids))


def _read(files: Sequence[Path], key: str | None) -> TrackSet:
    if len(files) == 1 and _start(files[0]).startswith(b"PK"):
        return read_arrays(files[0], key)
    if key is not None:
        raise error(files[0], f"--key {key}: has no keys", "leave --key out; it is for .npz with several sequences or arrays")
    if len(files) == 1 and _is_text(files[0]):
        if is_long(read_headings(files[0])):
            return read_long(files[0])
        check_headings(files[0])
    opened = [open_points(path) for path in files]
    first = opened[0]
    if isinstance(first, PointSequence) and len(opened) == 1:
        names = tuple(str(first.first + i) for i in range(len(first.values)))
        return TrackSet(first.path, first.values, first.ids or default_names(first.values.shape[1]), names)
    views = []
    for view in opened:
        if isinstance(view, PointSequence):
            raise error(view.path, f"holds {len(view.values)} frames", "give such a file alone")
        if view.lines:
            raise error(view.path, "holds lines", "give points")
        views.append(view)
    if len(views) == 1:
        raise error(views[0].path, "holds the points of one view", FORMATS)
    return _match_views(views)


def holds_tracks(path: Path) -> bool:
    """Whether a file is one of tracks through frames, rather than of matches; False where it cannot be read."""
    start = _start(path)
    try:
        if start.startswith(b"PK"):
            names = [name.rpartition("/")[2] for name in NumpyArchive(path)]
            return "x1" not in names and bool({"tracks", "y"} & set(names))
        if start.startswith(b"\x93NUMPY"):
            return read_npy(path).ndim == 3
        return _is_text(path) and is_long(read_headings(path))
    except ValueError:
        return False


def _start(path: Path) -> bytes:
    """The first bytes of a file; none where there is no file."""
    return head_of(path) if is_regular(path) else b""


def _is_text(path: Path) -> bool:
    """Whether the file is a table, rather than arrays or a cloud of points."""
    start = _start(path)
    return bool(start) and b"\0" not in start and not start.startswith(b"ply")


def _match_views(views: Sequence[PointSet]) -> TrackSet:
    """One file per view: by name where all have names, and then a name may be absent from some; otherwise by row."""
    first = views[0]
    odd = next((view for view in views if view.values.shape[1] != first.values.shape[1]), None)
    if odd is not None:
        raise error(odd.path, f"holds {odd.values.shape[1]}D points, {first.path} {first.values.shape[1]}D", "give one kind")
    if all(view.ids is not None for view in views):
        places = {name: i for i, name in enumerate(dict.fromkeys(name for view in views for name in view.ids or ()))}
        rows = [np.array([places[name] for name in view.ids or ()]) for view in views]
        ids = tuple(places)
    else:
        longer = next((view for view in views if len(view.values) != len(first.values)), None)
        if longer is not None:
            message = f"has {len(longer.values)} rows, {first.path} {len(first.values)}"
            raise error(longer.path, message, "give a row per track in every file, or a column id to match the rows by")
        rows, ids = [np.arange(len(first.values))] * len(views), default_names(len(first.values))
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


def _static_points(path: Path, ids: Sequence[str]) -> BoolArray:
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
        raise error(path, f"row {named[stranger]}: no track is named {quote(stranger)}", f"the tracks are {listing(ids, 4)}")
    return np.array([name in named for name in ids])
