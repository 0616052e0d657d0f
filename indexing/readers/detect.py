"""Which format an opened file has: decided by its structure, not by its name; each format says itself what is its own."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from indexing.opening import error, listing
from indexing.readers.files import Format, Source
from indexing.readers.hdf import opened_hdf5
from indexing.registry import list_programs, load_formats

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
        with opened_hdf5(source.path) as file:
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
        said = f"export what {writers} write, or a clip set, or say the format (--format, format=)"
        raise error(source.path, _describe(source.kind, data), said)
    return name


def _first_match(samples: Iterable[Source]) -> str | None:
    """The first format that takes the first sample that any takes."""
    for sample in samples:
        for name, known in registered_formats().items():
            if sample.kind in known.kinds and known.matches(sample):
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
