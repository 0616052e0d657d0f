"""BORIS: ``project`` reads projects and ``writing`` writes them; its exported tables are a format of their own."""

from __future__ import annotations

from typing import Any

from indexing.labels.format import LabelFormat
from indexing.labels.formats.boris.project import read
from indexing.labels.formats.boris.writing import write


def matches(data: Any) -> bool:
    """An object with observations."""
    return isinstance(data, dict) and isinstance(data.get("observations"), dict)


FORMAT = LabelFormat(
    "a BORIS project", ("json",), read, matches, order=10, write=write, written={"boris": ".boris"}, program="BORIS"
)  # fmt: skip
