"""Opening files and folders: what every format needs before it looks at a single keypoint."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from indexing.clip import ClipSet, FloatArray, check_fps, is_number
from indexing.opening import VALUE, clip_text, entries, error, head_of, listing, parse_json, quote, read_rows, read_text, size_of
from indexing.readers.hdf import open_hdf5
from indexing.readers.points import number
from indexing.registry import list_programs, load_formats
from indexing.skeleton import layout_named

VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv")
KEYPOINTS = "give keypoints as JSON, CSV or a clip-set .npz"
BINARY = {b"\x89HDF": "hdf5", b"\x93NUMPY": "npy", b"PathFileType": "trc", **{b"\x80" + bytes([i]): "pickle" for i in range(2, 6)}}
"""Kinds of files by how they begin."""
PICKLES = (".pkl", ".pickle")
HEADER_ROWS = 5  # enough to tell every CSV format apart


class FrameFile(NamedTuple):
    """One file of a folder that holds one file per frame."""

    number: int
    path: Path
    data: Any


@dataclass(frozen=True)
class Source:
    """An opened input."""

    path: Path
    kind: str
    data: Any = None

    def require_kind(self, name: str, *kinds: str) -> None:
        """Refuse an input that cannot be of the format ``name``."""
        if self.kind not in kinds:
            what = f"is a {self.kind}, but the format {name!r} is a {' or a '.join(kinds)}"
            raise error(self.path, what, "leave format= out to detect it")


@dataclass(frozen=True)
class Format:
    """A format of keypoint files, declared as ``FORMAT`` in the file of ``indexing/readers/formats`` that has its name."""

    programs: tuple[str, ...]
    """That write it, as errors list them."""
    kinds: tuple[str, ...]
    """Of files, as :func:`open_source` tells them apart."""
    read: Callable[[Source, Options], ClipSet]
    matches: Callable[[Source], bool] = lambda source: True
    """Whether a file of these kinds is of the format.  ``source.data`` holds the rows with which a table begins, the open file of
    HDF5, and of JSON the object that the file is, or a list of one of its elements.  Some file of a folder has to match."""
    order: int = 50
    """Among formats of one kind, those with the stricter telltale are asked first."""


def open_source(path: str | Path) -> Source:
    """Look at what a path holds, without deciding on a format.

    Raises:
        ValueError: it does not exist, is empty, or cannot hold keypoints (a video, a model, weights of a network).
    """
    path = Path(path).expanduser()
    if os.path.isdir(path):
        return _open_folder(path)
    size_of(path, what="file or folder")
    suffix = path.suffix.lower()
    if suffix in VIDEOS:
        return Source(path, "video")
    head = head_of(path)
    _refuse_binary(path, suffix, head)
    for start, kind in BINARY.items():
        if head.startswith(start):
            return Source(path, kind)
    if suffix in PICKLES:
        return Source(path, "pickle")
    if suffix == ".c3d":
        return Source(path, "c3d")
    if head.startswith(b"PK") or suffix == ".npz":
        return Source(path, "npz")
    if head.removeprefix(b"\xef\xbb\xbf").lstrip()[:1] in (b"{", b"["):
        return Source(path, "json", load_json(path))
    rows = [cells for _, cells in islice(read_rows(path, KEYPOINTS), HEADER_ROWS)]
    if not rows:
        raise error(path, "the file is empty", "export it again")
    return Source(path, "csv", rows)


def _refuse_binary(path: Path, suffix: str, head: bytes) -> None:
    if suffix == ".safetensors" or head[8:10] == b'{"':
        raise error(path, "is a model file, but keypoints are expected", "give it with -m (--model), or to ActionIndexer.load")
    if suffix in (".pt", ".pth", ".joblib"):
        raise error(path, "is a pickle, which can run code when it is read", "export JSON, CSV or a clip-set .npz instead")
    if head.startswith(b"CDF"):
        raise error(path, "is a netCDF file of version 3", "save it as netCDF 4: dataset.to_netcdf(path, engine='h5netcdf')")
    if b"\0" in head and not head.startswith((b"PK", *BINARY)) and suffix not in (".npz", ".c3d", *PICKLES):
        raise error(path, "is a binary file that no reader knows", KEYPOINTS)


def _arrays(folder: Path, visible: Sequence[Path]) -> list[Path]:
    """The arrays of a recording of FreeMoCap, whose folder has them two floors down."""
    arrays = [entry for entry in visible if entry.suffix.lower() == ".npy"]
    for name in ("output_data", "raw_data"):
        inside = next((entry for entry in visible if entry.name == name and entry.is_dir()), None)
        if inside is not None:
            arrays += _arrays(inside, entries(inside))
    return arrays


def _open_folder(folder: Path) -> Source:
    visible = entries(folder)
    if any(entry.name == "output_data" for entry in visible):
        return Source(folder, "npy folder", _arrays(folder, visible))
    for suffix in (".json", ".txt"):
        files = [entry for entry in visible if entry.suffix.lower() == suffix and entry.name != "classes.txt"]
        if not files:
            continue
        numbered: dict[int, Path] = {}
        for file in files:
            number = frame_number(file.name)
            if number is None:
                raise error(file, "the file name has no frame number", "a folder is one recording; name other files singly")
            if number in numbered:
                names = " and ".join(clip_text(one.name, VALUE) for one in (numbered[number], file))
                raise error(folder, f"{names} are both frame {number}", "put each recording in a folder of its own")
            numbered[number] = file
        for file in files:
            size_of(file)  # a folder or a pipe among them is named before any of them is read
        # text files are read by the one format that uses them
        read = load_json if suffix == ".json" else lambda path: None
        return Source(folder, f"{suffix[1:]} folder", [FrameFile(n, f, read(f)) for n, f in sorted(numbered.items())])
    arrays = _arrays(folder, visible)
    if arrays:
        return Source(folder, "npy folder", arrays)
    inside = listing((entry.name for entry in visible), 5) if visible else "nothing"
    raise error(folder, f"the folder has no .json or .txt keypoint files (it has {inside})", "give the folder of one recording")


def frame_number(name: str) -> int | None:
    """The frame number in a file name: before ``_keypoints``, else the last number before the suffix."""
    stem = re.sub(r"\.\w+$", "", name)
    match = re.search(r"(\d{1,18})_keypoints", stem) or re.search(r"(\d{1,18})\D*$", stem)  # 18 digits fit int64
    return int(match.group(1)) if match else None


def load_json(path: Path) -> Any:
    """Parsed JSON (``NaN`` allowed)."""
    text = read_text(path, KEYPOINTS)
    if not text.strip():
        raise error(path, "the file is empty", "export it again")
    return parse_json(path, text, "the file may be truncated: export it again")


def read_columns(path: Path, skip: int, numeric: Sequence[int], text: Sequence[int] = ()) -> tuple[FloatArray, list[list[str]]]:
    """Some columns of a CSV file."""
    header: list[str] = []
    values: list[FloatArray] = []
    words: list[list[str]] = [[] for _ in text]
    for index, (line, cells) in enumerate(read_rows(path, KEYPOINTS)):
        if index < skip:
            header = cells
            continue
        if len(cells) < len(header):
            what = f"row {line} has {len(cells)} cells, the header {len(header)}"
            raise error(path, what, "the file may be truncated: export it again")
        try:
            values.append(np.array([float(cells[c]) for c in numeric]))
        except ValueError:
            values.append(np.array([_number(path, line, header[c], cells[c]) for c in numeric]))
        for column, c in zip(words, text, strict=True):
            column.append(cells[c].strip())
    if not values:
        raise error(path, "the file has a header but no rows", "export it again")
    return np.stack(values), words


def _number(path: Path, line: int, column: str, cell: str) -> float:
    value = number(cell)
    if value is None:
        raise error(path, f"row {line}, column {quote(column)}: {quote(cell)} is not a number", "correct it or leave it empty")
    return value


# ----------------------------------------------------------------------------------------------------------------------
# What a caller may ask of a reader, checked once.


PEOPLE = ("largest", "confident", "tracked", "all", "everyone")


@dataclass(frozen=True)
class WatchOptions:
    """How people are found in a video, by :func:`indexing.pose.detect`."""

    people: int = 4
    """Looked for at most.  Where there are fewer, looking for others takes some twenty looks of the detector every two seconds,
    which is 5 ms a frame of 30 fps."""
    model: Literal["heavy", "full", "lite"] | None = None
    """The network; the sharpest that is there where none is named."""
    every: int = 1
    """Frames of which one is looked at."""


@dataclass(frozen=True)
class Options:
    """The arguments of :func:`indexing.readers.read` that the format modules share.

    Raises:
        ValueError: a value that no file could satisfy.
    """

    fps: float | None = None
    person: str = "largest"
    min_confidence: float = 0.0
    label: Hashable | None = None
    size: tuple[float, float] | None = None
    layout: str | None = None
    watching: WatchOptions | None = None

    def __post_init__(self) -> None:
        if self.fps is not None:
            check_fps(self.fps)
        if self.person not in PEOPLE:
            raise ValueError(f"unknown person={self.person!r}; use one of {', '.join(PEOPLE)}")
        if not isinstance(self.watching, WatchOptions | None):
            raise ValueError(f"watching must be WatchOptions, got {self.watching!r}; use dataclasses.replace(WatchOptions(), ...)")
        if self.layout is not None:
            layout_named(self.layout)
        if not is_number(self.min_confidence):
            raise ValueError(f"min_confidence must be a number (0 keeps every joint), got {self.min_confidence!r}")
        if self.size is not None:
            size = np.asarray(self.size, dtype=float)
            if size.shape != (2,) or not (np.isfinite(size).all() and (size > 0).all()):
                raise ValueError(f"size must be (width, height) of the image in pixels, got {self.size!r}")


# ----------------------------------------------------------------------------------------------------------------------
# Which format an opened file has: decided by its structure, not by its name; each format says itself what is its own


MAX_DEPTH = 3  # lists of people inside each other


@cache
def registered_formats() -> dict[str, Format]:
    """The formats by name, in the order in which they are asked."""
    return load_formats("readers")


def detect(source: Source) -> str:
    """The name of the format.

    Raises:
        ValueError: no reader knows this structure; the message says what was found.
    """
    if source.kind == "video":
        return "video"
    if source.kind == "hdf5":
        with open_hdf5(source.path) as file:
            return _detect_opened(replace(source, data=file))
    return _detect_opened(source)


def detect_json(path: Path, data: Any) -> str | None:
    """The format of parsed JSON, or None."""
    return _first_match(_samples(Source(path, "json", data)))


def _detect_opened(source: Source) -> str:
    data = source.data
    if source.kind == "json folder":
        samples: Iterable[Source] = (
            sample for frame in data for sample in _samples(replace(source, path=frame.path, kind="json", data=frame.data))
        )
        empty, data = all(_only_empty_lists(frame.data) for frame in data), data[0].data
    else:
        samples = _samples(source)
        empty = source.kind == "json" and _only_empty_lists(data)
    if empty:
        raise error(source.path, "no person was detected in any frame", "check the video or the pose estimator's threshold")
    name = _first_match(samples)
    if name is None:
        programs = list_programs(registered_formats().values())
        writers = f"{', '.join(programs[:-1])} or {programs[-1]}"
        message = f"export what {writers} write, or a clip set, or say the format (--format, format=)"
        raise error(source.path, _describe(source.kind, data), message)
    return name


def _first_match(samples: Iterable[Source]) -> str | None:
    """The first format that takes the first sample that any takes."""
    for sample in samples:
        for name, entry in registered_formats().items():
            if sample.kind in entry.kinds and entry.matches(sample):
                return name
    return None


def _samples(source: Source) -> Iterator[Source]:
    """What the formats are shown of a file; of a list in JSON, each element in a list of its own, those of lists inside it, too."""
    if source.kind != "json" or isinstance(source.data, dict):
        yield source
    elif isinstance(source.data, list):
        yield from (replace(source, data=[element]) for element in _elements(source.data))


def _elements(values: list[Any], depth: int = 0) -> Iterator[Any]:
    """The elements of a list that are no lists: a frame is a list of people."""
    for value in values:
        if not isinstance(value, list):
            yield value
        elif depth < MAX_DEPTH:
            yield from _elements(value, depth + 1)


def _only_empty_lists(data: Any) -> bool:
    return isinstance(data, list) and all(item in ([], "[]") for item in data)


def _describe(kind: str, data: Any) -> str:
    """What was found, of a kind of file that several readers know."""
    if kind == "csv":
        return f"text without keypoint columns that a reader knows (first row: {listing(data[0], 6)})"
    if kind == "hdf5":
        return f"HDF5 without keypoints that a reader knows (it has {listing(data.names(), 6)})"
    shape = f"a {type(data).__name__}"
    if isinstance(data, dict):
        shape = f"an object with {listing(data, 5)}"
    elif isinstance(data, list) and data and isinstance(data[0], dict):
        shape = f"a list of objects with {listing(data[0], 5)}"
    return f"JSON without keypoints that a reader knows ({shape})"
