"""The one gate to HDF5 files: what a dataset would take is known, and fits the file, before it is read; no link out is followed.

Links to other files, values kept in other files and virtual datasets are refused: a file of keypoints holds what it says.  h5py is
an extra (``pip install 'dyntorch[h5]'``) and imported when the first such file is opened.
"""

from __future__ import annotations

import math
import mmap
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from indexing.opening import LARGEST, VALUE, clip_text, error, listing, open_file, quote, size_of

HEAP = b"GCOL\x01\0\0\0"
AGAIN = "export or copy it again"
PLENTY_BLOCK = 2**26, 250  # bytes from which on a dataset must not be this many times as large as what is stored of it
MOST_TEXTS_BLOCK = 20_000  # names in a dataset of text
TEXT = 3  # HDF5's class of text, among others whose values are Python's objects: references, rows of any length
GZIP = 1  # HDF5's number of this filter
ENTRY = 16  # bytes of a text of any length in its dataset: its length (4), its heap (8), and which of its pieces (4)
DAMAGED = (
    OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError, OverflowError, MemoryError, IndexError, SystemError,
    RecursionError,
)  # fmt: skip
"""What h5py raises over a file that is damaged: each layer has its own."""

Array = NDArray[Any]
T = TypeVar("T")


class Hdf5:
    """What an open HDF5 file holds; every failure is one line that names the file and the part."""

    def __init__(self, path: Path, handle: Any, size: int) -> None:
        self.path, self._handle, self._size = path, handle, size

    def __contains__(self, name: str) -> bool:
        group, _, last = name.rpartition("/")
        return last in self.names(group or "/")

    def names(self, group: str = "/") -> list[str]:
        """What a group holds, less links that lead out of the file; empty where there is no such group."""

        def inside() -> list[str]:
            node = self._handle[group] if group == "/" or self._hard(group) else None
            if node is None or not hasattr(node, "keys"):
                return []
            kinds = {name: type(node.get(name, getlink=True)).__name__ for name in node}
            return [name for name, kind in kinds.items() if kind in ("HardLink", "SoftLink")]

        return self._guard(inside, group)

    def array(self, name: str, ndim: int | None = None, kinds: str = "biuf") -> Array:
        """The values of a dataset."""
        data = self._dataset(name)
        if data.dtype.kind not in kinds or (ndim is not None and data.ndim != ndim):
            what = f"{data.ndim} axes of {data.dtype}" if data.dtype.kind != "O" else "text"
            raise error(self.path, f"{quote(name)} has {what}, which it cannot have", AGAIN)
        return np.asarray(self._guard(lambda: data[()], name))

    def records(self, name: str, fields: tuple[str, ...]) -> dict[str, Array]:
        """Fields of a table of records, a column each; a field may be a row of numbers itself."""
        data = self._dataset(name)
        there = data.dtype.names or ()
        missing = [field for field in fields if field not in there]
        if missing or data.ndim != 1:
            raise error(self.path, f"{quote(name)} has no field {quote((missing or fields)[0])} (it has {listing(there)})", AGAIN)
        kinds = {field: data.dtype[field].base.kind for field in fields}
        odd = [field for field, kind in kinds.items() if kind not in "biufS"]
        if odd:
            raise error(self.path, f"{quote(name)}: {quote(odd[0])} has values that are no numbers", AGAIN)
        if data.dtype.hasobject:  # a piece of a heap may be the field of every record, and is copied for each
            raise error(self.path, f"{quote(name)} has fields that are neither numbers nor text of one length", AGAIN)
        table = self._guard(lambda: data[()], name)
        return {field: np.asarray(table[field]) for field in fields}

    def fields(self, name: str) -> tuple[str, ...]:
        """Names of the fields of a table; empty where there is no such table."""
        return tuple(self._dataset(name).dtype.names or ()) if name in self else ()

    def shape(self, name: str) -> tuple[int, ...]:
        """Of a dataset that is not read."""
        return tuple(self._dataset(name).shape)

    def texts(self, name: str) -> list[str]:
        """The texts of a dataset with one axis, or of none (a single text)."""
        data = self._dataset(name)
        if data.ndim > 1 or data.size > MOST_TEXTS_BLOCK or data.dtype.kind not in "OS":
            raise error(self.path, f"{quote(name)} is no list of names", AGAIN)
        if data.dtype.kind == "O" and self._guard(lambda: data.id.get_type().get_class(), name) != TEXT:
            raise error(self.path, f"{quote(name)} is no list of names", AGAIN)
        if data.dtype.kind == "O":
            self._check_lengths(data, name)
        return [_text(value) for value in np.atleast_1d(self._guard(lambda: data[()], name))]

    def _check_lengths(self, data: Any, name: str) -> None:
        """Refuse texts that say they are longer than the file, alone or together: the library would make room for each of
        them."""
        total = 0
        with open_file(self.path) as file:
            for offset, size, packed in self._guard(lambda: _places(data), name):
                file.seek(min(offset, self._size))
                raw = file.read(min(size, ENTRY * MOST_TEXTS_BLOCK))
                lengths = self._guard(partial(_lengths, raw, packed), name)
                total += int(lengths.sum(dtype=np.uint64))
                if total > self._size:
                    what = "a text longer" if (lengths > self._size).any() else "texts that are together longer"
                    raise error(self.path, f"{quote(name)} has {what} than the file (which may be truncated)", AGAIN)

    def attribute(self, name: str, key: str) -> Any:
        """An attribute of a group or dataset, text as ``str`` or ``bytes``; ``None`` where there is none."""

        def value() -> Any:
            owner = self._handle[name] if name == "/" or self._hard(name) else None
            if owner is None or key not in owner.attrs:
                return None
            about = owner.attrs.get_id(key)
            if about.dtype.hasobject and math.prod(about.shape) > 1:  # texts that may be one piece of a heap, copied for each
                return None
            return owner.attrs[key] if about.get_storage_size() <= min(self._size, LARGEST) else None

        return self._guard(value, f"{name}@{key}")

    def text(self, name: str, key: str) -> str:
        """An attribute that is text; empty where there is none."""
        value = self.attribute(name, key)
        return "" if value is None else _text(value)

    def _dataset(self, name: str) -> Any:
        """A dataset that is what it says."""
        dataset = self._guard(lambda: self._handle[name] if self._hard(name) else None, name)
        if dataset is None or not hasattr(dataset, "shape"):
            raise error(self.path, f"has no dataset {quote(name)} (it has {listing(self.names())})", AGAIN)

        if self._guard(lambda: bool(dataset.external) or bool(dataset.is_virtual), name):
            raise error(self.path, f"{quote(name)} is kept in another file", "copy its values into one file")
        if self._guard(lambda: dataset.shape is None, name):
            raise error(self.path, f"{quote(name)} is empty", AGAIN)
        size, stored = self._guard(lambda: (math.prod(dataset.shape) * dataset.dtype.itemsize, dataset.id.get_storage_size()), name)
        large, times = PLENTY_BLOCK
        if size > LARGEST or stored > self._size or size > max(large, times * stored):
            raise error(self.path, f"{quote(name)} would take {size / 2**30:.1f} GB of {stored / 2**20:.1f} MB", AGAIN)
        return dataset

    def _hard(self, name: str) -> bool:
        """Whether every step of a path is there, in this very file."""
        at = ""
        for step in name.strip("/").split("/"):
            parent, at = at or "/", f"{at}/{step}"
            owner = self._handle[parent]
            if not hasattr(owner, "get") or type(owner.get(step, getlink=True)).__name__ != "HardLink":
                return False
        return True

    def _guard(self, read: Callable[[], T], name: str) -> T:
        try:
            return read()
        except DAMAGED as problem:
            if type(problem) is ValueError and str(self.path) in str(problem):
                raise
            message = f"{quote(name)} cannot be read ({clip_text(problem, VALUE)}; the file may be truncated)"
            raise error(self.path, message, AGAIN) from None


@contextmanager
def open_hdf5(path: Path) -> Iterator[Hdf5]:
    """An HDF5 file, to be read."""
    size = size_of(path)
    try:
        import h5py
    except ImportError:
        raise error(path, "is an HDF5 file, which takes h5py to read", "pip install 'dyntorch[h5]'") from None
    _check_heaps(path)
    try:
        handle = h5py.File(path, "r", locking=False)
    except DAMAGED as problem:
        raise error(path, f"cannot be read as HDF5 ({clip_text(problem, VALUE)}; the file may be truncated)", AGAIN) from None
    try:
        yield Hdf5(path, handle, size)
    finally:
        handle.close()


def _check_heaps(path: Path) -> None:
    """Refuse a heap of texts with an empty piece of free space: the library would go from it to itself without end."""
    with open_file(path) as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        at = data.find(HEAP)
        while at >= 0:
            size = min(int.from_bytes(data[at + 8 : at + 16], "little"), len(data) - at)
            step, end = at + 16, at + size
            while step + 16 <= end:
                index, length = (int.from_bytes(data[a:b], "little") for a, b in ((step, step + 2), (step + 8, step + 16)))
                if not index and not length:
                    raise error(path, "is damaged: one of its heaps of text has no end (the file may be truncated)", AGAIN)
                step += length if not index else 16 + -(-length // 8) * 8
            at = data.find(HEAP, at + 8)


def _places(data: Any) -> list[tuple[int, int, bool]]:
    """Where a dataset keeps its values: offset and size of each block, and whether it is packed."""
    creation = data.file.id.get_create_plist()
    if creation.get_sizes() != (8, 8) or creation.get_userblock():
        raise ValueError("text is kept in an uncommon way")
    if data.chunks is None:
        offset = data.id.get_offset()
        if offset is None and data.id.get_storage_size():
            raise ValueError("text is kept in an uncommon way")
        return [] if offset is None else [(offset, ENTRY * data.size, False)]
    plan = data.id.get_create_plist()
    filters = [plan.get_filter(i)[0] for i in range(plan.get_nfilters())]
    blocks = []
    for i in range(data.id.get_num_chunks()):
        one = data.id.get_chunk_info(i)
        used = [number for k, number in enumerate(filters) if not one.filter_mask >> k & 1]  # a set bit: it was passed over
        if used not in ([], [GZIP]):
            raise ValueError("text is packed in an uncommon way")
        blocks.append((one.byte_offset, one.size, bool(used)))
    return blocks


def _lengths(raw: bytes, packed: bool) -> Array:
    """Lengths of the texts of a block."""
    if packed:
        most = ENTRY * MOST_TEXTS_BLOCK
        try:
            raw = zlib.decompressobj().decompress(raw, most + 1)
        except zlib.error as problem:
            raise ValueError(str(problem)) from None
        if len(raw) > most:
            raise ValueError("a block of text is too large")
    return np.frombuffer(raw[: len(raw) // ENTRY * ENTRY], np.dtype([("length", "<u4"), ("place", "V12")]))["length"]


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace").rstrip("\0") if isinstance(value, bytes) else str(value)
