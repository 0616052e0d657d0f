"""Vertices of PLY files (ASCII and binary): what 3D scanners and CloudCompare, MeshLab, Open3D write."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from indexing.opening import error, first_duplicate, listing, read_bytes, shown
from indexing.readers.points import FloatArray, PointSet, as_view

TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
HEADER_LIMIT = 65536  # bytes; a header takes a few hundred


@dataclass
class Element:
    """A table of a PLY file: so many rows with these properties (name, numpy type); None = it has lists."""

    name: str
    rows: int
    properties: list[tuple[str, str]] | None


def read(path: Path) -> PointSet:
    """The vertices; a property ``id`` names them."""
    data = read_bytes(path)
    order, elements, start = _header(path, data)
    before: list[Element] = []
    for element in elements:
        if element.name == "vertex":
            break
        before.append(element)
    else:
        raise error(path, "has no element 'vertex'", "export a point cloud")
    kinds = element.properties
    if kinds is None:
        raise error(path, "its vertices have list properties", "export plain x, y, z")
    names = [name for name, _ in kinds]
    missing = [name for name in "xyz" if name not in names]
    if missing:
        raise error(path, f"its vertices have no property {shown(missing[0])} (they have {listing(names)})", "export x, y, z")
    if not element.rows:
        raise error(path, "has no vertices", "export a point cloud")
    read_rows = _text if order == "" else _binary
    columns = read_rows(path, data[start:], order, before, element)
    ids = None
    if "id" in columns:
        ids = tuple(f"{value:g}" for value in columns["id"])
        twice = first_duplicate(ids)
        if twice is not None:
            raise error(path, f"property 'id': {twice} names several vertices", "give each vertex an id of its own")
    return PointSet(str(path), as_view(np.stack([columns[name] for name in "xyz"], axis=-1), path), ids)


def _header(path: Path, data: bytes) -> tuple[str, list[Element], int]:
    """Byte order ('' = ASCII), elements, and where the rows begin."""
    end = data.find(b"end_header", 0, HEADER_LIMIT)
    newline = data.find(b"\n", end)
    if end < 0 or newline < 0:
        raise error(path, "the PLY header has no end_header", "the file may be truncated: export it again")
    order, elements = None, []
    for line in data[:end].decode("ascii", "replace").splitlines():
        words = line.split()
        try:
            if words[:1] == ["format"]:
                order = ORDERS[words[1]]
            elif words[:1] == ["element"]:
                elements.append(Element(words[1], int(words[2]), []))
                if not 0 <= elements[-1].rows <= len(data):
                    raise ValueError(words[2])
            elif words[:2] == ["property", "list"]:
                elements[-1].properties = None
            elif words[:1] == ["property"] and elements[-1].properties is not None:
                elements[-1].properties.append((words[2], TYPES[words[1]]))
        except (IndexError, KeyError, ValueError):
            raise error(path, f"the PLY header has the line {shown(line)}, which makes no sense", "export it again") from None
    if order is None:
        raise error(path, "the PLY header has no format", "export it again")
    return order, elements, newline + 1


def _text(path: Path, data: bytes, order: str, before: list[Element], element: Element) -> dict[str, FloatArray]:
    rows = [line.split() for line in data.decode("ascii", "replace").splitlines() if line.strip()]
    rows = rows[sum(other.rows for other in before) :][: element.rows]
    if len(rows) < element.rows:
        raise error(path, f"has {len(rows)} of {element.rows} vertices", "the file may be truncated: export it again")
    names = [name for name, _ in element.properties or []]
    columns: dict[str, FloatArray] = {name: np.empty(element.rows) for name in names}
    for i, words in enumerate(rows):
        if len(words) != len(names):
            raise error(path, f"vertex {i + 1} has {len(words)} values, the header {len(names)}", "export it again")
        for name, word in zip(names, words, strict=True):
            try:
                columns[name][i] = float(word)
            except ValueError:
                raise error(path, f"vertex {i + 1}, {shown(name)}: {shown(word)} is not a number", "correct the value") from None
    return columns


def _binary(path: Path, data: bytes, order: str, before: list[Element], element: Element) -> dict[str, FloatArray]:
    skip = 0
    for other in before:
        if other.properties is None:
            raise error(path, f"the lists of {shown(other.name)} come before the vertices", "export a point cloud only")
        skip += other.rows * _type(order, other).itemsize
    kind = _type(order, element)
    if len(data) < skip + element.rows * kind.itemsize:
        rows = max(0, len(data) - skip) // kind.itemsize
        raise error(path, f"has {rows} of {element.rows} vertices", "the file may be truncated: export it again")
    table = np.frombuffer(data, kind, count=element.rows, offset=skip)
    with np.errstate(invalid="ignore"):  # of bytes that are no number of any kind, but NaN
        return {name: table[f"{i}"].astype(np.float64) for i, (name, _) in enumerate(element.properties or [])}


def _type(order: str, element: Element) -> np.dtype[np.void]:
    # numbered, because names of properties may repeat
    return np.dtype([(f"{i}", order + kind) for i, (_, kind) in enumerate(element.properties or [])])
