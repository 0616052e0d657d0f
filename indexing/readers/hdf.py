"""The one gate to HDF5 files: what a dataset would take is known, and fits the file, before it is read; no link out is followed.

Links to other files, values kept in other files and virtual datasets are refused: a file of keypoints holds what it says.  h5py is
an extra (``pip install 'dyntorch[h5]'``) and imported when the first such file is opened.
"""

from __future__ import annotations

import math
import mmap
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from indexing.opening import LARGEST, VALUE, clipped, error, listed, opened, shown, size_of

HEAP = b"GCOL\x01\0\0\0"
AGAIN = "export or copy it again"
PLENTY_BLOCK = 2**26, 250  # bytes from which on a dataset must not be this many times as large as what is stored of it
MOST_TEXTS_BLOCK = 20_000  # names in a dataset of text
RECORDED = 7  # HDF5's class of references to other objects: values are read as numbers, text or records of these
DAMAGED = (
    OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError, OverflowError, MemoryError, IndexError, SystemError,
    RecursionError,
)  # fmt: skip
"""What h5py raises over a file that is damaged: each layer has its own."""

Array = NDArray[Any]
T = TypeVar("T")


class Hdf5:
    """What an open HDF5 file holds; every failure is one line that names the file and the part.

    Args:
        path: of the file; handle: of h5py.
    """

    def __init__(self, path: Path, handle: Any, size: int) -> None:
        self.path, self._handle, self._size = path, handle, size

    def __contains__(self, name: str) -> bool:
        group, _, last = name.rpartition("/")
        return last in self.names(group or "/")

    def names(self, group: str = "/") -> list[str]:
        """What a group holds, less links that lead out of the file; empty where there is no such group."""

        def inside() -> list[str]:
            found = self._handle[group] if group == "/" or self._hard(group) else None
            if found is None or not hasattr(found, "keys"):
                return []
            kinds = {name: type(found.get(name, getlink=True)).__name__ for name in found}
            return [name for name, kind in kinds.items() if kind in ("HardLink", "SoftLink")]

        return self._sure(inside, group)

    def array(self, name: str, ndim: int | None = None, kinds: str = "biuf") -> Array:
        """The values of a dataset.

        Args:
            ndim: how many axes it must have; kinds: of numpy, that its values may be of.

        Raises:
            ValueError: there is none, or it is larger than what is stored of it, kept elsewhere, or of other values.
        """
        data = self._dataset(name)
        if data.dtype.kind not in kinds or (ndim is not None and data.ndim != ndim):
            what = f"{data.ndim} axes of {data.dtype}" if data.dtype.kind != "O" else "text"
            raise error(self.path, f"{shown(name)} has {what}, which it cannot have", AGAIN)
        return np.asarray(self._sure(lambda: data[()], name))

    def records(self, name: str, fields: tuple[str, ...]) -> dict[str, Array]:
        """Fields of a table of records, a column each; a field may be a row of numbers itself.

        Raises:
            ValueError: as :meth:`array`, or a field is not there.
        """
        data = self._dataset(name)
        there = data.dtype.names or ()
        missing = [field for field in fields if field not in there]
        if missing or data.ndim != 1:
            raise error(self.path, f"{shown(name)} has no field {shown((missing or fields)[0])} (it has {listed(there)})", AGAIN)
        kinds = {field: data.dtype[field].base.kind for field in fields}
        odd = [field for field, kind in kinds.items() if kind not in "biufS"]
        if odd:
            raise error(self.path, f"{shown(name)}: {shown(odd[0])} has values that are no numbers", AGAIN)
        whole = self._sure(lambda: data[()], name)
        return {field: np.asarray(whole[field]) for field in fields}

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
            raise error(self.path, f"{shown(name)} is no list of names", AGAIN)
        if data.dtype.kind == "O" and self._sure(lambda: data.id.get_type().get_class(), name) == RECORDED:
            raise error(self.path, f"{shown(name)} is no list of names", AGAIN)
        if data.dtype.kind == "O":
            self._check_lengths(data, name)
        return [_text(value) for value in np.atleast_1d(self._sure(lambda: data[()], name))]

    def _check_lengths(self, data: Any, name: str) -> None:
        """Refuse texts that say they are longer than the file: the library would make room for them.

        A text of any length is kept as its length (4 bytes), and where it is: a heap (8), and which of its pieces (4).
        """

        def places() -> list[tuple[int, int]]:
            if data.chunks is None:
                offset = data.id.get_offset()
                return [] if offset is None else [(offset, 16 * data.size)]
            if data.compression or data.shuffle or data.fletcher32:
                return []  # a checksum or packing, which damage does not survive
            found = [data.id.get_chunk_info(i) for i in range(data.id.get_num_chunks())]
            return [(one.byte_offset, one.size) for one in found]

        with opened(self.path) as file:
            for offset, size in self._sure(places, name):
                file.seek(min(offset, self._size))
                raw = file.read(min(size, 16 * MOST_TEXTS_BLOCK))
                lengths = np.frombuffer(raw[: len(raw) // 16 * 16], dtype=np.dtype([("length", "<u4"), ("rest", "V12")]))["length"]
                if (lengths > self._size).any():
                    raise error(self.path, f"{shown(name)} has a text longer than the file (which may be truncated)", AGAIN)

    def attribute(self, name: str, key: str) -> Any:
        """An attribute of a group or dataset, text as ``str`` or ``bytes``; ``None`` where there is none."""

        def value() -> Any:
            owner = self._handle[name] if name == "/" or self._hard(name) else None
            if owner is None or key not in owner.attrs:
                return None
            size = owner.attrs.get_id(key).get_storage_size()
            return owner.attrs[key] if size <= min(self._size, LARGEST) else None

        return self._sure(value, f"{name}@{key}")

    def _dataset(self, name: str) -> Any:
        """A dataset that is what it says."""
        found = self._sure(lambda: self._handle[name] if self._hard(name) else None, name)
        if found is None or not hasattr(found, "shape"):
            raise error(self.path, f"has no dataset {shown(name)} (it has {listed(self.names())})", AGAIN)

        def elsewhere() -> bool:
            return bool(found.external) or bool(found.is_virtual)

        if self._sure(elsewhere, name):
            raise error(self.path, f"{shown(name)} is kept in another file", "copy its values into one file")
        if self._sure(lambda: found.shape is None, name):
            raise error(self.path, f"{shown(name)} is empty", AGAIN)
        size, stored = self._sure(lambda: (math.prod(found.shape) * found.dtype.itemsize, found.id.get_storage_size()), name)
        large, times = PLENTY_BLOCK
        if size > LARGEST or stored > self._size or size > max(large, times * stored):
            raise error(self.path, f"{shown(name)} would take {size / 2**30:.1f} GB of {stored / 2**20:.1f} MB", AGAIN)
        return found

    def _hard(self, name: str) -> bool:
        """Whether every step of a path is there, in this very file."""
        at = ""
        for step in name.strip("/").split("/"):
            parent, at = at or "/", f"{at}/{step}"
            owner = self._handle[parent]
            if not hasattr(owner, "get") or type(owner.get(step, getlink=True)).__name__ != "HardLink":
                return False
        return True

    def _sure(self, read: Callable[[], T], name: str) -> T:
        try:
            return read()
        except DAMAGED as problem:
            if type(problem) is ValueError and str(self.path) in str(problem):
                raise
            said = f"{shown(name)} cannot be read ({clipped(problem, VALUE)}; the file may be truncated)"
            raise error(self.path, said, AGAIN) from None


@contextmanager
def opened_hdf5(path: Path) -> Iterator[Hdf5]:
    """An HDF5 file, to be read.

    Raises:
        ValueError: it is none, is damaged, or h5py is not installed.
    """
    size = size_of(path)
    try:
        import h5py
    except ImportError:
        raise error(path, "is an HDF5 file, which takes h5py to read", "pip install 'dyntorch[h5]'") from None
    _check_heaps(path)
    try:
        handle = h5py.File(path, "r", locking=False)
    except DAMAGED as problem:
        said = f"cannot be read as HDF5 ({clipped(problem, VALUE)}; the file may be truncated)"
        raise error(path, said, AGAIN) from None
    try:
        yield Hdf5(path, handle, size)
    finally:
        handle.close()


def _check_heaps(path: Path) -> None:
    """Refuse a heap of texts with an empty piece of free space: the library would go from it to itself without end.

    A heap is ``GCOL``, its version and size, and pieces: index (0 = free), references, size, each a multiple of 8 bytes.

    Raises:
        ValueError: there is one, or the file cannot be read.
    """
    with opened(path) as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        at = data.find(HEAP)
        while at >= 0:
            size = min(int.from_bytes(data[at + 8 : at + 16], "little"), len(data) - at)
            step, end = at + 16, at + size
            while step + 16 <= end:
                index, length = (
                    int.from_bytes(data[step : step + 2], "little"),
                    int.from_bytes(data[step + 8 : step + 16], "little"),
                )
                if not index and not length:
                    raise error(path, "is damaged: one of its heaps of text has no end (the file may be truncated)", AGAIN)
                step += length if not index else 16 + -(-length // 8) * 8
            at = data.find(HEAP, at + 8)


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace").rstrip("\0") if isinstance(value, bytes) else str(value)
