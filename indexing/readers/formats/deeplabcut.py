"""DeepLabCut: header rows scorer, bodyparts, coords; with several animals: scorer, individuals, bodyparts, coords.

In CSV they are the first rows; the default output, HDF5 (``..DLC_resnet50_...h5``), keeps them as a data frame of pandas
(below).

The columns are x, y, likelihood per body part (labels made by hand: x, y; triangulated: x, y, z), the first column or
columns the frame number or the image's name.  Individuals are tracks; body parts that belong to no individual
(``single``) are not read when there are individuals.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from indexing.clip import ClipSet, FloatArray
from indexing.opening import error, listing, quote
from indexing.readers.files import Format, Options, Source, frame_number, read_columns
from indexing.readers.hdf import AGAIN, Hdf5, open_hdf5
from indexing.readers.pickles import unpickle_bytes
from indexing.readers.recording import IntArray, dense_recording, to_clips

Layout = dict[str, dict[str, dict[str, int]]]  # animal -> body part -> coordinate -> column
REMEDY = "export with deeplabcut.analyze_videos(..., save_as_csv=True) or analyze_videos_converth5_to_csv"


def read(source: Source, options: Options) -> ClipSet:
    """Read a DeepLabCut CSV or HDF5; times are frame number / fps."""
    if source.kind == "hdf5":
        with open_hdf5(source.path) as file:
            frame = read_frame(file)
        layout = _layout(source, frame.header["bodyparts"], frame.header["coords"], frame.header.get("individuals"))
        table = frame.values[:, _columns(layout)]
        return _clips(source, options, layout, table, _frames(source, frame.index), "individuals" in frame.header)
    header = {row[0].strip().lower(): [cell.strip() for cell in row] for row in source.data[:4]}
    lacking = [name for name in ("bodyparts", "coords") if name not in header]
    if lacking:
        raise error(source.path, f"has no header row {quote(lacking[0])} among the first four rows", REMEDY)
    if len({len(row) for row in header.values()}) > 1:
        raise error(source.path, "the header rows have different lengths", REMEDY)
    individuals = header.get("individuals")
    layout = _layout(source, header["bodyparts"], header["coords"], individuals)
    start = next(i for i, cell in enumerate(header["coords"]) if cell.lower() == "x")
    values, keys = read_columns(source.path, 4 if individuals else 3, _columns(layout), [start - 1])
    return _clips(source, options, layout, values, _frames(source, keys[0]), individuals is not None)


def _columns(layout: Layout) -> list[int]:
    """The columns of all animals, in the order of the first one's body parts."""
    parts = list(next(iter(layout.values())))
    return [column for animal in layout.values() for part in parts for column in animal[part].values()]


def _clips(source: Source, options: Options, layout: Layout, values: FloatArray, frames: IntArray, tracked: bool) -> ClipSet:
    """Clips of a table with the columns of :func:`_columns`, a row per frame in ``frames``."""
    first = next(iter(layout.values()))
    parts, kinds = list(first), list(next(iter(first.values())))
    table = values.reshape(-1, len(parts), len(kinds))  # one row per frame and animal
    dims = 3 if "z" in kinds else 2
    sure = table[..., kinds.index("likelihood")] if "likelihood" in kinds else None
    people = list(layout) if tracked else None
    return to_clips(source.path, dense_recording(source.path, table[..., :dims], sure, frames, people, parts), options)


def _layout(source: Source, parts: list[str], coords: list[str], individuals: list[str] | None) -> Layout:
    layout: Layout = {}
    for column, coord in enumerate(coords):
        if coord.lower() in ("x", "y", "z", "likelihood"):
            animal = individuals[column] if individuals else ""
            layout.setdefault(animal, {}).setdefault(parts[column], {})[coord.lower()] = column
    if len(layout) > 1:
        layout.pop("single", None)
    if not layout:
        raise error(source.path, "the row 'coords' names no x and y", REMEDY)
    first = next(iter(layout.values()))
    kinds = tuple(next(iter(first.values())))
    for animal, its in layout.items():
        for part, columns in its.items():
            if tuple(columns) != kinds or kinds[:2] != ("x", "y"):
                who = f"{animal} {part}".strip()
                raise error(source.path, f"{who} has the columns {', '.join(columns)}, not x, y, likelihood", REMEDY)
        if its.keys() != first.keys():
            what = f"the individual {quote(animal)} has other body parts than the first"
            raise error(source.path, what, "export animals of one kind per file")
    return layout


def _frames(source: Source, keys: list[str]) -> IntArray:
    """Frame numbers from the index column: numbers, or names of images."""
    numbers = [int(key) if key.isdecimal() and len(key) < 16 else frame_number(key) for key in keys]
    if None in numbers:
        raise error(source.path, f"frame {quote(keys[numbers.index(None)])} has no number", "number the frames, or the images")
    return np.array(numbers, dtype=np.int64)


def matches(source: Source) -> bool:
    """A table that begins with the rows of DeepLabCut, or one of pandas in HDF5."""
    if source.kind == "hdf5":
        return bool(_keys(source.data))
    first = [row[0].strip().lower() for row in source.data[:2]]
    return first[0] == "scorer" or first[1:] in (["bodyparts"], ["individuals"])


# ----------------------------------------------------------------------------------------------------------------------
# Data frames that pandas keeps in HDF5, both of its layouts: what DeepLabCut writes by default, read without pandas.
#
# *Fixed*: ``axis0_level<k>`` the words of each row of column names, ``axis0_label<k>`` which word each column has, ``axis1`` the
# index, ``block<i>_values`` the numbers.  *Table*: a table of records with a row of numbers as ``values_block_<i>``, whose column
# names are a pickle in an attribute (read by :mod:`indexing.readers.pickles`).


NAMES_BLOCK = 2**22  # names of the columns of a frame, each row of them counted, or of its rows: a day at 48 frames per second
MOST_BLOCK = 100  # blocks of one frame, and rows of column names: usual are one, and three or four
WORD_BLOCK = 2**10  # bytes of a name that is a value of numpy's, which is copied for each column
KEY = "df_with_missing"
LEVELS = {3: ("scorer", "bodyparts", "coords"), 4: ("scorer", "individuals", "bodyparts", "coords")}  # where they have no names


@dataclass(frozen=True, eq=False)
class HdfFrame:
    """A table of numbers. values ``(rows, columns)``."""

    header: dict[str, list[str]]
    values: FloatArray
    index: list[str]


def read_frame(file: Hdf5) -> HdfFrame:
    """The one frame of a file, or the one that DeepLabCut means."""
    keys = _keys(file)
    key = KEY if KEY in keys else keys[0] if len(keys) == 1 else None
    if key is None:
        raise error(file.path, f"holds {len(keys)} tables of pandas ({listing(keys)}), none of them {KEY}", "save one per file")
    kind = _to_text(file.attribute(key, "pandas_type"))
    if kind == "frame_table":
        return _read_table(file, key)
    if kind != "frame":
        raise error(file.path, f"{quote(key)} is a {quote(kind)} of pandas, not a data frame", AGAIN)
    return _read_fixed(file, key)


def _keys(file: Hdf5) -> list[str]:
    return [name for name in file.names() if file.attribute(name, "pandas_type") is not None]


def _read_fixed(file: Hdf5, key: str) -> HdfFrame:
    count = _count(file, key, "nblocks")
    columns: list[list[list[str]]] = []
    blocks: list[FloatArray] = []
    if _to_text(file.attribute(key, "axis1_variety")) == "multi":  # of labelled images, the parts of their path
        rows = ["/".join(row) for row in zip(*_read_name_rows(file, f"{key}/axis1", _levels(file, key, "axis1")), strict=True)]
    else:
        rows = _read_texts(file, f"{key}/axis1")
    for i in range(count):
        name = f"{key}/block{i}_items"
        levels = _levels(file, key, f"block{i}_items")
        parts = _read_name_rows(file, name, levels)
        values = file.array(f"{key}/block{i}_values", 2).astype(np.float64)
        if file.attribute(f"{key}/block{i}_values", "transposed") in (0, None) and values.shape != (len(rows), len(parts[0])):
            values = values.T
        if values.shape != (len(rows), len(parts[0])):
            raise error(file.path, f"{key}: {len(rows)} rows and {len(parts[0])} columns, but values {values.shape}", AGAIN)
        if columns and len(parts) != len(columns[0]):
            raise error(file.path, f"{key}: blocks with {len(columns[0])} and {len(parts)} rows of column names", AGAIN)
        columns.append(parts)
        blocks.append(values)
    names = [_to_text(file.attribute(f"{key}/axis0_level{k}", "name")) for k in range(len(columns[0]))]
    header = [[word for part in columns for word in part[k]] for k in range(len(names))]
    return _build_frame(file, header, names, blocks, rows)


def _read_table(file: Hdf5, key: str) -> HdfFrame:
    table = f"{key}/table"
    fields = file.fields(table)
    blocks = [name for name in fields if name.startswith("values_block_")]
    if not blocks or "index" not in fields or len(blocks) > MOST_BLOCK:
        raise error(file.path, f"{quote(table)} has the fields {listing(fields)}, no index and values", AGAIN)
    parts: list[tuple[str, ...]] = []
    for block in blocks:
        kind = file.attribute(table, f"{block}_kind")
        found = unpickle_bytes(file.path, _to_bytes(kind), f"{table}@{block}_kind")
        if not isinstance(found, list) or not all(_is_column_name(one) for one in found):
            raise error(file.path, f"{block} has no columns named by {' and '.join(LEVELS[3])}", AGAIN)
        parts += [tuple(map(str, one)) for one in found]
    records = file.records(table, ("index", *blocks))
    values = [np.asarray(records[block], dtype=np.float64).reshape(len(records["index"]), -1) for block in blocks]
    levels = {len(one) for one in parts}
    if len(levels) != 1 or sum(block.shape[1] for block in values) != len(parts):
        raise error(file.path, f"{quote(table)} has {len(parts)} names for {sum(b.shape[1] for b in values)} columns", AGAIN)
    header = [[one[k] for one in parts] for k in range(levels.pop())]
    return _build_frame(file, header, _level_names(file, key), values, [_to_text(name) for name in records["index"].tolist()])


def _level_names(file: Hdf5, key: str) -> list[str]:
    """What the rows of column names of a table are called; empty where it does not say."""
    raw = file.attribute(key, "info")
    try:
        info = unpickle_bytes(file.path, _to_bytes(raw), f"{key}@info")
        names = tuple(info[1]["names"])
        return list(map(str, names)) if _is_column_name(names) else []
    except (ValueError, KeyError, TypeError, IndexError):
        return []


def _is_column_name(one: Any) -> bool:
    """Whether the words of a column's name are text and numbers: text of a tuple of tuples can be without end."""

    def is_word(word: Any) -> bool:
        short = word.nbytes < WORD_BLOCK if isinstance(word, np.generic) else type(word) is int and abs(word) < 2**63
        return type(word) in (str, float) or short

    return isinstance(one, tuple) and 0 < len(one) <= MOST_BLOCK and all(map(is_word, one))


def _build_frame(file: Hdf5, header: list[list[str]], names: list[str], blocks: Sequence[FloatArray], rows: list[str]) -> HdfFrame:
    usual = LEVELS.get(len(header), ())
    told = len(set(names)) == len(header) and {"bodyparts", "coords"} <= set(names)
    named = names if told else list(usual)
    if not named:
        raise error(file.path, f"has {len(header)} rows of column names, not {' or '.join(map(str, LEVELS))}", AGAIN)
    if not rows:
        raise error(file.path, "has columns but no rows", AGAIN)
    return HdfFrame(dict(zip(named, header, strict=True)), np.concatenate(blocks, axis=1), rows)


def _read_name_rows(file: Hdf5, name: str, levels: int) -> list[list[str]]:
    """Each row of column names: words, and which of them each column has."""
    found = []
    for k in range(levels):
        if levels * math.prod(file.shape(f"{name}_label{k}")) > NAMES_BLOCK:
            raise error(file.path, f"{quote(name)} has more names than any table of points", AGAIN)
        words = _read_texts(file, f"{name}_level{k}")
        which = file.array(f"{name}_label{k}", 1, "iu").astype(np.int64)
        if which.size and not (which.min() >= -1 and which.max() < len(words)):
            raise error(file.path, f"{quote(name)} names columns by words that are not there", AGAIN)
        found.append([words[i] if i >= 0 else "" for i in which.tolist()])
    if not found or len({len(row) for row in found}) > 1:
        raise error(file.path, f"{quote(name)} has rows of column names of different lengths", AGAIN)
    return found


def _read_texts(file: Hdf5, name: str) -> list[str]:
    if math.prod(file.shape(name)) > NAMES_BLOCK:
        raise error(file.path, f"{quote(name)} has more names than any table of points", AGAIN)
    data = file.array(name, 1, "iufS")
    return [_to_text(value) for value in data.tolist()]


def _levels(file: Hdf5, key: str, axis: str) -> int:
    return 0 if file.attribute(key, f"{axis}_nlevels") is None else _count(file, key, f"{axis}_nlevels")


def _count(file: Hdf5, key: str, name: str) -> int:
    value: Any = file.attribute(key, name)
    number = int(value) if isinstance(value, (int, np.integer)) else -1
    if not 0 < number <= MOST_BLOCK:
        raise error(file.path, f"{quote(key)}: {name} is {quote(value)}", AGAIN)
    return number


def _to_text(value: Any) -> str:
    """A number or text as text."""
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace").rstrip("\0")
    return f"{value:g}" if isinstance(value, float) and value == value and abs(value) < 1e15 else str(value)


def _to_bytes(value: Any) -> bytes:
    """The bytes of an attribute that holds a pickle."""
    return value if isinstance(value, bytes) else str(value or "").encode("latin-1", "replace")


FORMAT = Format(("DeepLabCut",), ("csv", "hdf5"), read, matches, order=10)
