"""Which format a file of labels has: decided by what it holds, not by its name; each format says itself what is its own."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from indexing.labels.format import LabelFormat
from indexing.opening import error, head_of, listing, parse_json, read_rows, read_text
from indexing.registry import load_formats

FOREIGN = (
    (b"\x1f\x8b", "is compressed (gzip)", "unpack it, as gunzip does, or save it uncompressed in BORIS"),
    (b"PK\x03\x04", "is a zip archive or a spreadsheet", "export it as TSV or CSV in UTF-8"),
    (b"\xd0\xcf\x11\xe0", "is a spreadsheet of Excel", "export it as TSV or CSV in UTF-8"),
    (b"\xff\xfe", "is text in UTF-16", "save it in UTF-8"),
    (b"\xfe\xff", "is text in UTF-16", "save it in UTF-8"),
)


@cache
def registered_formats() -> dict[str, LabelFormat]:
    """The formats by name, in the order in which they are asked."""
    return load_formats("labels")


def detect(path: Path) -> tuple[str, Any]:
    """The format, and what was parsed to tell: the JSON, the rows of a table, nothing for XML.

    Raises:
        ValueError: it cannot be read, or no reader knows it; the message says what was found.
    """
    kind, data = _parse(path)
    for name, known in registered_formats().items():
        if kind in known.kinds and known.matches(data):
            return name, data
    titles = [known.title for _, known in sorted(registered_formats().items())]
    remedy = f"give {', '.join(titles[:-1])} or {titles[-1]}"
    raise error(path, f"JSON without labels that a reader knows ({_describe(data)})", remedy)


def _parse(path: Path) -> tuple[str, Any]:
    """The kind of a file, and what it holds."""
    head = head_of(path)
    for magic, said, remedy in FOREIGN:
        if head.startswith(magic):
            raise error(path, said, remedy)
    begin = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if begin.startswith(b"<"):
        return "xml", None
    if begin.startswith((b"{", b"[")):
        return "json", parse_json(path, read_text(path, "export it again in UTF-8"), "export it again as JSON")
    rows = list(read_rows(path, "export it again as CSV in UTF-8", numbers=False))
    if not rows:
        raise error(path, "the file is empty", "export it again")
    return "table", rows


def _describe(data: Any) -> str:
    if isinstance(data, dict):
        return f"an object with {listing(data, 5)}" if data else "an empty object"
    return "a list of no tasks" if isinstance(data, list) else f"a {type(data).__name__}"
