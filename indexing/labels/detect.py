"""Which format a file of labels has: decided by what it holds, not by its name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from indexing.opening import error, head_of, listed, parse_json, read_rows, read_text

FORMATS = ("boris", "boris_tables", "elan", "tables", "activitynet", "label_studio", "via")
REMEDY = "give a BORIS project or export, an ELAN .eaf, CSV with label,start,end, or JSON of ActivityNet, Label Studio or VIA"
FOREIGN = (
    (b"\x1f\x8b", "is compressed (gzip)", "unpack it, as gunzip does, or save it uncompressed in BORIS"),
    (b"PK\x03\x04", "is a zip archive or a spreadsheet", "export it as TSV or CSV in UTF-8"),
    (b"\xd0\xcf\x11\xe0", "is a spreadsheet of Excel", "export it as TSV or CSV in UTF-8"),
    (b"\xff\xfe", "is text in UTF-16", "save it in UTF-8"),
    (b"\xfe\xff", "is text in UTF-16", "save it in UTF-8"),
)
HEADER_ROWS = frozenset(range(80))  # the rows in which a BORIS table says what it is about, before it begins


def detect(path: Path) -> tuple[str, Any]:
    """The format, and what was parsed to tell: the JSON, the rows of a table, nothing for XML.

    Raises:
        ValueError: it cannot be read, or no reader knows it; the message says what was found.
    """
    head = head_of(path)
    for magic, said, remedy in FOREIGN:
        if head.startswith(magic):
            raise error(path, said, remedy)
    begin = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if begin.startswith(b"<"):
        return "elan", None
    if begin.startswith((b"{", b"[")):
        data = parse_json(path, read_text(path, "export it again in UTF-8"), "export it again as JSON")
        return detect_json(path, data), data
    rows = list(read_rows(path, "export it again as CSV in UTF-8", numbers=False))
    return detect_table(path, rows), rows


def detect_json(path: Path, data: Any) -> str:
    """The format of parsed JSON."""
    if isinstance(data, dict):
        if isinstance(data.get("observations"), dict):
            return "boris"
        if isinstance(data.get("metadata"), dict) and isinstance(data.get("file"), dict):
            return "via"
        if isinstance(data.get("database"), dict) or isinstance(data.get("results"), dict):
            return "activitynet"
        if "annotations" in data or "predictions" in data:
            return "label_studio"
        said = f"an object with {listed(data, 5)}" if data else "an empty object"
    elif isinstance(data, list):
        if data and all(isinstance(task, dict) for task in data):
            return "label_studio"
        said = "a list of no tasks"
    else:
        said = f"a {type(data).__name__}"
    raise error(path, f"JSON without labels that a reader knows ({said})", REMEDY)


def detect_table(path: Path, rows: list[tuple[int, list[str]]]) -> str:
    """The format of a table."""
    for number, (_, cells) in enumerate(rows):
        if number not in HEADER_ROWS:
            break
        names = {cell.strip().lower() for cell in cells}
        if any("csv_header" in name or name == "temporal_segment_start" for name in names):
            return "via"
        coded = "behavior" in names or "behaviour" in names
        timed = names & {"start (s)", "time"}
        kind = names & {"behavior type", "status", "observation id", "media file name", "media file path", "media file"}
        if coded and timed and kind:
            return "boris_tables"
    if not rows:
        raise error(path, "the file is empty", "export it again")
    return "tables"
