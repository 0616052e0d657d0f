"""Matches of two images, all in one file: ``.npz``, ``.npy`` or CSV -> arrays whose rows correspond."""

from __future__ import annotations

import struct
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing.opening import VALUE, clip_text, error, first_duplicate, listing, shown, size_of
from indexing.readers import points
from indexing.readers.matches import opening
from indexing.readers.npz import NumpyArchive, read_npy
from indexing.readers.points import FloatArray, as_view

COLUMNS = ("x1", "y1", "x2", "y2")
IDS = ("id", "name", "match", "track")
KNOWN = ("label", "labels")
FORMATS = "give npz with x1, x2 (n, 2), or CSV with columns x1,y1,x2,y2 (and perhaps id, weight, label)"
KEYS = "give x1 and x2 (n, 2), and perhaps label, weights, ids, wh; of several pairs NAME/x1 and NAME/x2"
EXTRA = {"label": KNOWN, "weights": points.WEIGHTS, "ids": ("ids", "id"), "wh": ("wh", "size")}
MOST = 2**31  # labels
TRACKS = ("y", "tracks")  # (frames, n, 2), as of Hopkins 155
FRAMES = "it seems to hold tracks (frames, n, 2): leave --pair out, or say which with --key"


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
    def seen(self) -> NDArray[np.bool_]:
        """``(n,)`` matches that are there in both images."""
        return np.asarray(np.isfinite(np.concatenate([self.x1, self.x2], axis=1)).all(axis=1))


def read_pair(path: str | Path, pair: str | None = None) -> MatchedPair:
    """Read the matches of two images."""
    path = Path(path).expanduser()
    head = opening(path)
    if head.startswith(b"PK"):
        return _archive(path, pair)
    if pair is not None:
        raise error(path, f"--pair {pair}: holds one pair", "leave --pair out; it is for .npz with several")
    if head.startswith(b"\x93NUMPY"):
        values = read_npy(path)
        if values.ndim != 2 or values.shape[1] != 4:
            raise error(path, f"the array has shape {values.shape}", "matches are (n, 4): x1, y1, x2, y2; numpy.hstack([x1, x2])")
        return _pair(path, path.name, _points(values[:, :2], path), _points(values[:, 2:], path))
    if b"\0" in head:
        raise error(path, "is a binary file of no known format", FORMATS)
    return _table(path)


def _pair(path: Path, name: str, x1: FloatArray, x2: FloatArray, ids: tuple[str, ...] | None = None, **known: Any) -> MatchedPair:
    return MatchedPair(str(path), name, x1, x2, ids or tuple(str(i + 1) for i in range(len(x1))), **known)


def _points(values: Any, where: str | Path) -> FloatArray:
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
def _archive(path: Path, pair: str | None) -> MatchedPair:
    archive = NumpyArchive(path)
    before = _select_prefix(path, list(archive), pair)
    x1, x2 = (_points(archive[before + name], f"{path} {before}{name}") for name in ("x1", "x2"))
    if len(x1) != len(x2):
        raise error(path, f"{before}x1 has {len(x1)} rows, {before}x2 {len(x2)}", "give a row per match in both")
    extra = {}
    for kind, names in EXTRA.items():
        name = next((before + name for name in names if before + name in archive), None)
        if name is not None:
            extra[kind] = archive[name]
            if kind != "wh" and extra[kind].shape != (len(x1),):
                raise error(path, f"{name} has shape {extra[kind].shape}, {before}x1 has {len(x1)} rows", "give one per match")
    ids = tuple(map(str, extra["ids"].tolist())) if "ids" in extra else None
    twice = first_duplicate(ids or ())
    if twice is not None:
        raise error(
            path, f"{before}ids: {shown(twice)} names several matches", "give each match a name of its own, or leave ids out"
        )
    return _pair(path, pair or before.rstrip("/") or path.name, x1, x2, ids, **_marks(path, extra))


def _select_prefix(path: Path, names: list[str], pair: str | None) -> str:
    """What the names of the arrays of the pair begin with."""
    several = [name.removesuffix("x1") for name in names if name.endswith("/x1")]
    pairs = listing(name.rstrip("/") for name in several)
    if pair is not None and f"{pair}/x1" not in names and (several or "x1" in names):
        raise error(
            path, f"has no pair {shown(pair)}", f"its pairs are {pairs}" if several else "it holds one pair: leave --pair out"
        )
    if pair is None and "x1" not in names and len(several) > 1:
        raise error(path, f"holds {len(several)} pairs ({pairs})", f"say which: --pair {clip_text(several[0].rstrip('/'), VALUE)}")
    before = f"{pair}/" if pair is not None else "" if "x1" in names or not several else several[0]
    missing = next((before + name for name in ("x1", "x2") if before + name not in names), None)
    if missing is not None:
        tracks = not several and any(name.rpartition("/")[2] in TRACKS for name in names)
        remedy = FRAMES if tracks else KEYS
        raise error(path, f"has no {missing} (its arrays are {listing(names)})", remedy)
    return before


def _marks(path: Path, extra: Mapping[str, Any]) -> dict[str, Any]:
    """Weights, known labels and size, where the file has them."""
    for kind, values in extra.items():
        if kind != "ids" and values.dtype.kind not in "fiub":
            raise error(path, f"{kind} holds values of type {values.dtype}", "give numbers")
    found: dict[str, Any] = {}
    if "weights" in extra:
        weights = np.nan_to_num(extra["weights"].astype(np.float64), posinf=-1)
        if (weights < 0).any():
            at = int(np.flatnonzero(weights < 0)[0])
            raise error(path, f"match {at + 1}: the weight is {extra['weights'][at]:g}", "weights are 0 or more, and finite")
        found["weights"] = weights
    if "label" in extra:
        labels = extra["label"].astype(np.float64)
        odd = np.flatnonzero(~(np.isfinite(labels) & (labels >= 0) & (labels < MOST) & (labels == np.round(labels))))
        if len(odd):
            said = f"match {odd[0] + 1}: the label is {labels[odd[0]]:g}"
            raise error(path, said, "labels are 0 for an outlier, 1, 2, ... for the bodies; or leave them out")
        found["known"] = labels.astype(np.int64)
    if "wh" in extra:
        size = extra["wh"].astype(np.float64).ravel()
        if len(size) == 2 and np.isfinite(size).all() and (size > 0).all():
            found["size"] = (float(size[0]), float(size[1]))
    return found


# ---- tables --------------------------------------------------------------------------------------------------------------
def _table(path: Path) -> MatchedPair:
    rows = [(line, _cells(cells)) for line, cells in points.read_rows(path)]
    rows = [(line, cells) for line, cells in rows if cells]
    if not rows:
        raise error(path, "the file is empty", "export it again")
    if points.is_data(rows[0][1]):
        names = _default_columns(path, rows[0][1])
    else:
        names, rows = [cell.strip().lower() for cell in rows[0][1]], rows[1:]
    absent = [name for name in COLUMNS if name not in names]
    if absent:
        said = f"has no column {shown(absent[0])} (its columns are {listing(names)})"
        raise error(path, said, "name the columns x1,y1,x2,y2 (and perhaps id, weight, label)")
    if not rows:
        raise error(path, "the file has a header but no rows", "export it again")
    points.check_widths(path, rows, names)
    twice = first_duplicate(name for name in names if name in (*COLUMNS, *IDS, *points.WEIGHTS, *KNOWN))
    if twice is not None:
        raise error(path, f"there are two columns {shown(twice)}", "leave one of them out")
    values = points.column_values(path, rows, names, COLUMNS)
    extra = {
        "weights": points.optional_column(path, rows, names, points.WEIGHTS),
        "label": points.optional_column(path, rows, names, KNOWN),
    }
    marks = _marks(path, {kind: column for kind, column in extra.items() if column is not None})
    return _pair(path, path.name, values[:, :2], values[:, 2:], points.row_names(path, rows, names, IDS), **marks)


def _cells(cells: list[str]) -> list[str]:
    """The cells of a row; what numpy.savetxt writes has blanks between them, and # before the header."""
    if len(cells) == 1:
        cells = cells[0].split()
    if cells and cells[0].startswith("#"):
        cells = [cells[0][1:].strip(), *cells[1:]]
        cells = cells if cells[0] else cells[1:]
    return cells


def _default_columns(path: Path, cells: list[str]) -> list[str]:
    """Names of the columns of a table without a header: the four coordinates, and perhaps a name before them."""
    named = points.number(cells[0]) is None
    if len(cells) != len(COLUMNS) + named:
        said = f"row 1 has {len(cells)} columns, and no row names them"
        raise error(path, said, "matches without a header are x1,y1,x2,y2; name further columns (id, weight, label) in a header")
    return [*(["id"] if named else []), *COLUMNS]


# ----------------------------------------------------------------------------------------------------------------------
# Photographs behind a picture: any file that Pillow reads -> gray values.


PLENTY = 2**24, 10_000  # pixels from which on there must not be so many in a byte: of one colour, a photograph has a hundred
# what Pillow raises over a file that is damaged
DAMAGED = (OSError, ValueError, SyntaxError, TypeError, LookupError, ArithmeticError, MemoryError, struct.error, EOFError)
SIDE = 1600  # pixels kept along the longer side: a panel of a report shows fewer


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
                if opened.width * opened.height > max(PLENTY[0], PLENTY[1] * length):
                    raise ValueError(f"{opened.width} x {opened.height} pixels in {length} bytes")
                turned = ImageOps.exif_transpose(opened)
                size = (float(turned.width), float(turned.height))
                gray = _gray(turned)
    except (*DAMAGED, Image.DecompressionBombError) as problem:
        said = f"cannot be read as an image ({type(problem).__name__})"
        raise error(path, said, "save it again as png or jpg") from None
    return Photograph(path.name, gray, size)


def _gray(image: object) -> NDArray[np.float32]:
    from PIL import Image

    assert isinstance(image, Image.Image)
    if image.mode.startswith(("I", "F")):  # 16 bits and more: from the least value to the greatest
        deep = np.asarray(image, dtype=np.float32)
        low, high = float(np.nanmin(deep)), float(np.nanmax(deep))
        image = Image.fromarray(np.uint8(255 * np.nan_to_num((deep - low) / max(high - low, 1e-9))))
    image = image.convert("L")
    image.thumbnail((SIDE, SIDE))
    return np.asarray(image, dtype=np.float32) / np.float32(255)
