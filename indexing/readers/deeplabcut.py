"""DeepLabCut: header rows scorer, bodyparts, coords; with several animals: scorer, individuals, bodyparts, coords.

In CSV they are the first rows; the default output, HDF5 (``..DLC_resnet50_...h5``), keeps them as a data frame of pandas
(:mod:`indexing.readers.frames`).

The columns are x, y, likelihood per body part (labels made by hand: x, y; triangulated: x, y, z), the first column or
columns the frame number or the image's name.  Individuals are tracks; body parts that belong to no individual
(``single``) are not read when there are individuals.
"""

from __future__ import annotations

import numpy as np

from indexing.clip import ClipSet, FloatArray
from indexing.opening import error, shown
from indexing.readers.files import Options, Source, frame_number, read_columns
from indexing.readers.frames import read_frame
from indexing.readers.hdf import opened_hdf5
from indexing.readers.recording import IntArray, Recording, to_clips
from indexing.skeleton import Skeleton

Layout = dict[str, dict[str, dict[str, int]]]  # animal -> body part -> coordinate -> column
REMEDY = "export with deeplabcut.analyze_videos(..., save_as_csv=True) or analyze_videos_converth5_to_csv"


def read(source: Source, options: Options) -> ClipSet:
    """Read a DeepLabCut CSV or HDF5; times are frame number / fps."""
    source.need("deeplabcut", "csv", "hdf5")
    if source.kind == "hdf5":
        with opened_hdf5(source.path) as file:
            frame = read_frame(file)
        layout = _layout(source, frame.header["bodyparts"], frame.header["coords"], frame.header.get("individuals"))
        table = frame.values[:, _columns(layout)]
        return _clips(source, options, layout, table, _frames(source, frame.index), "individuals" in frame.header)
    header = {row[0].strip().lower(): [cell.strip() for cell in row] for row in source.data[:4]}
    lacking = [name for name in ("bodyparts", "coords") if name not in header]
    if lacking:
        raise error(source.path, f"has no header row {shown(lacking[0])} among the first four rows", REMEDY)
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
    recording = Recording(
        frames=frames,
        at=np.repeat(np.arange(len(frames)), len(layout)),
        joints=table[..., :dims],
        confidence=table[..., kinds.index("likelihood")] if "likelihood" in kinds else None,
        tracks=list(layout) * len(frames) if tracked else None,
        skeleton=Skeleton(source.path.stem, tuple(parts)),
    )
    return to_clips(source.path, recording, options)


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
            raise error(
                source.path,
                f"the individual {shown(animal)} has other body parts than the first",
                "export animals of one kind per file",
            )
    return layout


def _frames(source: Source, keys: list[str]) -> IntArray:
    """Frame numbers from the index column: numbers, or names of images."""
    numbers = [int(key) if key.isdecimal() and len(key) < 16 else frame_number(key) for key in keys]
    if None in numbers:
        raise error(
            source.path, f"frame {shown(keys[numbers.index(None)])} has no number", "number the frames, or the images by frame"
        )
    return np.array(numbers, dtype=np.int64)
