"""Files of points -> views whose rows correspond: by name where all rows have one, otherwise by row."""

from __future__ import annotations

import os
import struct
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing.opening import VALUE, clip_text, error, first_duplicate, head_of, listing, quote, size_of
from indexing.readers import c3d, points
from indexing.readers.npz import NumpyArchive, read_npy
from indexing.readers.points import BoolArray, FloatArray, PointSequence, PointSet, as_view

MAX_LISTED = 5  # names listed in a message


@dataclass(frozen=True, eq=False)
class Matched:
    """Views whose rows correspond."""

    views: tuple[FloatArray, ...]  # ``(n, 2 | 3)`` points or ``(n, 2, 3)`` or ``(n, 6)`` lines each, float64, NaN = missing
    ids: tuple[str, ...]  # ``n`` names; numbers of the rows, from 1, where the files have none
    names: tuple[str, ...]  # where each view comes from
    weights: FloatArray | None = None  # ``(n,)``; None = all equal
    static: BoolArray | None = None  # ``(n,)`` known not to move; None = not known of any
    static_points: tuple[FloatArray, ...] = ()  # static points ``(m, 3)`` of both views of lines; empty = none
    notes: tuple[str, ...] = ()  # what a reader should know, a sentence each

    @property
    def lines(self) -> bool:
        """Whether the matches are lines."""
        return self.views[0].ndim == 3 or self.views[0].shape[-1] == 6

    @property
    def dims(self) -> tuple[int, ...]:
        """Coordinates of the points of each view, 2 or 3."""
        return tuple(3 if self.lines else int(view.shape[-1]) for view in self.views)


def read_matches(
    paths: Sequence[str | Path], *, frames: tuple[int, ...] | None = None, static_points: Sequence[str | Path] = ()
) -> Matched:
    """Read the views of an alignment."""
    if not paths:
        raise ValueError("no files; give a file of points for each view, or one .npz or .c3d with all of them")
    views, resting = _read_views([Path(path).expanduser() for path in paths], frames)
    if static_points:
        if resting:
            raise error(paths[0], "holds static points, too", "leave --static-points out")
        resting, _ = _read_views([Path(path).expanduser() for path in static_points], None)
    matched = match_views(views)
    if not resting:
        return matched
    if not matched.lines:
        raise error(resting[0].path, "static points are for lines", "mark static matches by a column static instead")
    points = match_views(resting)
    if points.lines or points.dims != (3,) * len(matched.views):
        what = f"{len(points.views)} files of {points.dims[0]}D static points"
        raise error(resting[0].path, what, "give 3D points for each view")
    notes = matched.notes + tuple(f"static points: {note}" for note in points.notes)
    seen = np.isfinite(np.concatenate(points.views, axis=1)).all(axis=1)
    if not seen.all():
        notes += (f"static points: {int((~seen).sum())} missing in a view were left out",)
    return replace(matched, static_points=tuple(view[seen] for view in points.views), notes=notes)


def open_points(path: Path) -> PointSet | PointSequence:
    """One file of points, by its content."""
    head = read_head(path)
    if head.startswith(b"ply"):
        return points.read_ply(path)
    if head.startswith(b"\x93NUMPY"):
        return points.read_npy(path)
    if len(head) > 1 and head[1] == 0x50 and (path.suffix.lower() == ".c3d" or b"\0" in head):
        return c3d.read(path)
    if b"\0" in head:
        raise error(path, "is a binary file of no known format", "give points as CSV, npz, npy, PLY or C3D")
    return points.read_csv(path)


def read_head(path: Path) -> bytes:
    """The first bytes of a file of points."""
    if os.path.isdir(path):
        raise error(path, "is a folder", "give a file of points")
    return head_of(path)


def _read_views(paths: Sequence[Path], frames: tuple[int, ...] | None) -> tuple[list[PointSet], list[PointSet]]:
    """The views, and the static points that came with them."""
    if len(paths) == 1 and read_head(paths[0]).startswith(b"PK"):
        if frames is not None:
            raise error(paths[0], "an .npz has no frames", "leave --frames out")
        return points.read_npz(paths[0])
    views: list[PointSet] = []
    for path in paths:
        if read_head(path).startswith(b"PK"):
            raise error(path, "an .npz holds all views", "give it alone")
        loaded = open_points(path)
        if isinstance(loaded, PointSequence):
            if len(paths) > 1:
                raise error(path, f"holds {len(loaded.values)} frames", "give one such file alone, with --frames")
            return loaded.views(frames), []
        views.append(loaded)
    if frames is not None:
        raise error(paths[0], "has no frames", "leave --frames out; it is for .c3d, and .npy of shape (frames, n, d)")
    return views, []


def match_views(views: Sequence[PointSet]) -> Matched:
    """Rows that correspond: by name where all views have names, otherwise by row."""
    first = views[0]
    odd = next((view for view in views if view.lines != first.lines), None)
    if odd is not None:
        points, lines = (first, odd) if odd.lines else (odd, first)
        raise error(lines.path, f"holds lines, but {points.path} points", "give one kind")
    names = tuple(view.path for view in views)
    if all(view.ids is not None for view in views):
        return _match_by_name(views, names)
    notes = []
    named = [view.path for view in views if view.ids is not None]
    if named:
        bare = next(view.path for view in views if view.ids is None)
        notes.append(f"rows were matched by their order, not by name, because {bare} has no column of names")
    longer = next((view for view in views if len(view.values) != len(first.values)), None)
    if longer is not None:
        message = f"has {len(longer.values)} rows, {first.path} {len(first.values)}"
        raise error(longer.path, message, "give a row per match in every file, or a column id to match the rows by")
    ids = next((view.ids for view in views if view.ids is not None), None) or tuple(str(i + 1) for i in range(len(first.values)))
    weights, static = _weights_and_static(views)
    return Matched(tuple(view.values for view in views), ids, names, weights, static, (), tuple(notes))


def _match_by_name(views: Sequence[PointSet], names: tuple[str, ...]) -> Matched:
    places = [{name: i for i, name in enumerate(view.ids or ())} for view in views]
    shared = [name for name in places[0] if all(name in place for place in places[1:])]
    if not shared:
        mine, theirs = next(iter(places[0])), next(iter(places[1]))
        message = f"no name is in all of {', '.join(names)} (it has {quote(mine)}, where {names[1]} has {quote(theirs)})"
        raise error(names[0], message, "name the same match the same, or leave the column out to match rows by their order")
    notes = []
    lost = sorted({name for place in places for name in place} - set(shared))
    if lost:
        more = f" and {len(lost) - MAX_LISTED} more" if len(lost) > MAX_LISTED else ""
        left = "name is not in every view and was" if len(lost) == 1 else "names are not in every view and were"
        notes.append(f"{len(lost)} {left} left out: {', '.join(clip_text(name, VALUE) for name in lost[:MAX_LISTED])}{more}")
    order = [np.array([place[name] for name in shared]) for place in places]
    sorted_views = [view.select_rows(rows, tuple(shared)) for view, rows in zip(views, order, strict=True)]
    weights, static = _weights_and_static(sorted_views)
    return Matched(tuple(view.values for view in sorted_views), tuple(shared), names, weights, static, (), tuple(notes))


def _weights_and_static(views: Sequence[PointSet]) -> tuple[FloatArray | None, BoolArray | None]:
    """Weights and static matches of the first view that has any."""
    weights = next((view for view in views if view.weights is not None), None)
    static = next((view.static for view in views if view.static is not None), None)
    if weights is None or weights.weights is None:
        return None, static
    return _check_weights(weights.path, weights.weights), static


def _check_weights(path: str | Path, weights: NDArray[Any]) -> FloatArray:
    """Weights of matches, 0 where one is NaN."""
    values = np.where(np.isnan(weights.astype(np.float64)), 0.0, weights)
    bad = np.flatnonzero(~((values >= 0) & (values < np.inf)))
    if bad.size:
        raise error(path, f"match {bad[0] + 1}: the weight is {values[bad[0]]:g}", "weights are 0 or more, and finite")
    return values


# ----------------------------------------------------------------------------------------------------------------------
# Matches of two images, all in one file: npz, npy or CSV


PAIR_COLUMNS = ("x1", "y1", "x2", "y2")
PAIR_IDS = ("id", "name", "match", "track")
PAIR_LABELS = ("label", "labels")
PAIR_COLUMNS_REMEDY = "name the columns x1,y1,x2,y2 (and perhaps id, weight, label)"
PAIR_FORMATS = "give npz with x1, x2 (n, 2), or CSV with columns x1,y1,x2,y2 (and perhaps id, weight, label)"
PAIR_KEYS = "give x1 and x2 (n, 2), and perhaps label, weights, ids, wh; of several pairs NAME/x1 and NAME/x2"
PAIR_EXTRA = {"label": PAIR_LABELS, "weights": points.WEIGHTS, "ids": ("ids", "id"), "wh": ("wh", "size")}
MAX_LABEL = 2**31  # labels
TRACK_ARRAYS = ("y", "tracks")  # (frames, n, 2), as of Hopkins 155
TRACKS_REMEDY = "it seems to hold tracks (frames, n, 2): leave --pair out, or say which with --key"


@dataclass(frozen=True, eq=False)
class MatchedPair:
    """Matches of two images."""

    path: str  # the file
    name: str  # of the pair: its key in a file of several, otherwise the file's name
    x1: FloatArray  # ``(n, 2)`` of image 1, NaN = missing
    x2: FloatArray  # ``(n, 2)`` of image 2
    ids: tuple[str, ...]  # ``n`` names; numbers of the rows, from 1, where the file has none
    weights: FloatArray | None = None  # ``(n,)`` not negative; None = all equal
    known: NDArray[np.int64] | None = None  # ``(n,)`` known labels, 0 outlier, 1.. the bodies; None = not known
    size: tuple[float, float] | None = None  # width and height of the images; None = the file does not say

    @property
    def complete(self) -> NDArray[np.bool_]:
        """``(n,)`` matches that are there in both images."""
        return np.asarray(np.isfinite(np.concatenate([self.x1, self.x2], axis=1)).all(axis=1))


def read_pair(path: str | Path, pair: str | None = None) -> MatchedPair:
    """Read the matches of two images."""
    path = Path(path).expanduser()
    head = read_head(path)
    if head.startswith(b"PK"):
        return _read_archive(path, pair)
    if pair is not None:
        raise error(path, f"--pair {pair}: holds one pair", "leave --pair out; it is for .npz with several")
    if head.startswith(b"\x93NUMPY"):
        values = read_npy(path)
        if values.ndim != 2 or values.shape[1] != 4:
            raise error(path, f"the array has shape {values.shape}", "matches are (n, 4): x1, y1, x2, y2; numpy.hstack([x1, x2])")
        return _build_pair(path, path.name, _image_points(values[:, :2], path), _image_points(values[:, 2:], path))
    if b"\0" in head:
        raise error(path, "is a binary file of no known format", PAIR_FORMATS)
    return _read_table(path)


def _build_pair(
    path: Path, name: str, x1: FloatArray, x2: FloatArray, ids: tuple[str, ...] | None = None, **marks: Any
) -> MatchedPair:
    return MatchedPair(str(path), name, x1, x2, ids or tuple(str(i + 1) for i in range(len(x1))), **marks)


def _image_points(values: Any, where: str | Path) -> FloatArray:
    """Points of one image; those of OpenCV have an axis between, ``(n, 1, 2)``."""
    array = np.asarray(values)
    if array.ndim == 3 and array.shape[1:] == (1, 2):
        array = array[:, 0]
    if array.ndim != 2 or array.shape[1] != 2:
        how = ""
        if array.ndim == 2 and 3 in array.shape[1:]:
            how = ": divide homogeneous ones by their third coordinate"
        elif array.ndim == 2 and array.shape[0] == 2:
            how = ": transpose it"
        raise error(where, f"the array has shape {array.shape}", f"points of an image are (n, 2){how}")
    return as_view(array, where)


# ---- npz -----------------------------------------------------------------------------------------------------------------
def _read_archive(path: Path, pair: str | None) -> MatchedPair:
    archive = NumpyArchive(path)
    before = _select_pair(path, list(archive), pair)
    x1, x2 = (_image_points(archive[before + name], f"{path} {before}{name}") for name in ("x1", "x2"))
    if len(x1) != len(x2):
        raise error(path, f"{before}x1 has {len(x1)} rows, {before}x2 {len(x2)}", "give a row per match in both")
    extra = {}
    for kind, names in PAIR_EXTRA.items():
        name = next((before + name for name in names if before + name in archive), None)
        if name is not None:
            extra[kind] = archive[name]
            if kind != "wh" and extra[kind].shape != (len(x1),):
                raise error(path, f"{name} has shape {extra[kind].shape}, {before}x1 has {len(x1)} rows", "give one per match")
    ids = tuple(map(str, extra["ids"].tolist())) if "ids" in extra else None
    twice = first_duplicate(ids or ())
    if twice is not None:
        raise error(path, f"{before}ids: {quote(twice)} names several matches", "name each by itself, or leave ids out")
    return _build_pair(path, pair or before.rstrip("/") or path.name, x1, x2, ids, **_pair_marks(path, extra))


def _select_pair(path: Path, names: list[str], pair: str | None) -> str:
    """What the names of the arrays of the pair begin with."""
    several = [name.removesuffix("x1") for name in names if name.endswith("/x1")]
    pairs = listing(name.rstrip("/") for name in several)
    if pair is not None and f"{pair}/x1" not in names and (several or "x1" in names):
        remedy = f"its pairs are {pairs}" if several else "it holds one pair: leave --pair out"
        raise error(path, f"has no pair {quote(pair)}", remedy)
    if pair is None and "x1" not in names and len(several) > 1:
        raise error(path, f"holds {len(several)} pairs ({pairs})", f"say which: --pair {clip_text(several[0].rstrip('/'), VALUE)}")
    before = f"{pair}/" if pair is not None else "" if "x1" in names or not several else several[0]
    missing = next((before + name for name in ("x1", "x2") if before + name not in names), None)
    if missing is not None:
        tracks = not several and any(name.rpartition("/")[2] in TRACK_ARRAYS for name in names)
        remedy = TRACKS_REMEDY if tracks else PAIR_KEYS
        raise error(path, f"has no {missing} (its arrays are {listing(names)})", remedy)
    return before


def _pair_marks(path: Path, extra: Mapping[str, Any]) -> dict[str, Any]:
    """Weights, known labels and size, where the file has them."""
    for kind, values in extra.items():
        if kind != "ids" and values.dtype.kind not in "fiub":
            raise error(path, f"{kind} holds values of type {values.dtype}", "give numbers")
    marks: dict[str, Any] = {}
    if "weights" in extra:
        marks["weights"] = _check_weights(path, extra["weights"])
    if "label" in extra:
        labels = extra["label"].astype(np.float64)
        odd = np.flatnonzero(~(np.isfinite(labels) & (labels >= 0) & (labels < MAX_LABEL) & (labels == np.round(labels))))
        if len(odd):
            message = f"match {odd[0] + 1}: the label is {labels[odd[0]]:g}"
            raise error(path, message, "labels are 0 for an outlier, 1, 2, ... for the bodies; or leave them out")
        marks["known"] = labels.astype(np.int64)
    if "wh" in extra:
        size = extra["wh"].astype(np.float64).ravel()
        if len(size) == 2 and np.isfinite(size).all() and (size > 0).all():
            marks["size"] = (float(size[0]), float(size[1]))
    return marks


# ---- tables --------------------------------------------------------------------------------------------------------------
def _read_table(path: Path) -> MatchedPair:
    rows = [(line, cells) for line, row in points.read_rows(path) if (cells := _split_cells(row))]
    single = (*PAIR_IDS, *points.WEIGHTS, *PAIR_LABELS)
    rows, names, _ = points.split_header(path, rows, (PAIR_COLUMNS,), PAIR_COLUMNS_REMEDY, single)
    values = points.column_values(path, rows, names, PAIR_COLUMNS)
    extra = {kind: points.optional_column(path, rows, names, PAIR_EXTRA[kind]) for kind in ("weights", "label")}
    marks = _pair_marks(path, {kind: column for kind, column in extra.items() if column is not None})
    return _build_pair(path, path.name, values[:, :2], values[:, 2:], points.row_names(path, rows, names, PAIR_IDS), **marks)


def _split_cells(cells: list[str]) -> list[str]:
    """The cells of a row; what numpy.savetxt writes has blanks between them, and # before the header."""
    if len(cells) == 1:
        cells = cells[0].split()
    if cells and cells[0].startswith("#"):
        cells = [cells[0][1:].strip(), *cells[1:]]
        cells = cells if cells[0] else cells[1:]
    return cells


# ----------------------------------------------------------------------------------------------------------------------
# Photographs behind a picture: any file that Pillow reads -> gray values.


MAX_PIXELS = 2**24, 10_000  # pixels from which on there must not be so many in a byte: of one colour, a photograph has a hundred
# what Pillow raises over a file that is damaged
DAMAGED_IMAGE = (OSError, ValueError, SyntaxError, TypeError, LookupError, ArithmeticError, MemoryError, struct.error, EOFError)
MAX_SIDE = 1600  # pixels kept along the longer side: a panel of a report shows fewer


@dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph."""

    name: str  # of the file
    gray: NDArray[np.float32]  # ``(h, w)`` in [0, 1], perhaps smaller than the file's
    size: tuple[float, float]  # width and height in pixels of the file, in which points are measured


def read_image(path: str | Path) -> Photograph:
    """Read a photograph, turned as its EXIF entry says (as OpenCV does)."""
    from PIL import Image, ImageOps

    path = Path(path).expanduser()
    length = size_of(path, "give an image, such as png or jpg")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that it is large is no reason to worry: it is made smaller
            with Image.open(path) as opened:
                if opened.width * opened.height > max(MAX_PIXELS[0], MAX_PIXELS[1] * length):
                    raise ValueError(f"{opened.width} x {opened.height} pixels in {length} bytes")
                turned = ImageOps.exif_transpose(opened)
                size = (float(turned.width), float(turned.height))
                gray = _to_gray(turned)
    except (*DAMAGED_IMAGE, Image.DecompressionBombError) as problem:
        raise error(path, f"cannot be read as an image ({type(problem).__name__})", "save it again as png or jpg") from None
    return Photograph(path.name, gray, size)


def _to_gray(image: object) -> NDArray[np.float32]:
    from PIL import Image

    assert isinstance(image, Image.Image)
    if image.mode.startswith(("I", "F")):  # 16 bits and more: from the least value to the greatest
        deep = np.asarray(image, dtype=np.float32)
        low, high = float(np.nanmin(deep)), float(np.nanmax(deep))
        image = Image.fromarray(np.uint8(255 * np.nan_to_num((deep - low) / max(high - low, 1e-9))))
    image = image.convert("L")
    image.thumbnail((MAX_SIDE, MAX_SIDE))
    return np.asarray(image, dtype=np.float32) / np.float32(255)
