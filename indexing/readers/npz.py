"""The one gate to numpy's files: what an array would take is known, and fits the file, before a byte of it is unpacked.

``.npy`` and the members of ``.npz`` begin with a header that declares shape and type.  It is believed only where it agrees with
the size of the member; a member is believed only where its packing can have that size.  Nothing is ever unpickled.
"""

from __future__ import annotations

import ast
import math
import re
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from indexing.opening import VALUE, clip_text, error, open_file, quote, size_of

Array = NDArray[Any]
Take = Callable[[int], bytes]
AGAIN = "write it again with numpy.savez"
KINDS = "biufcUSmM"  # plain values: no Python objects, no records
MAGIC = b"\x93NUMPY"
HEADER = 10_000  # bytes of a header, which takes about a hundred
PYTHON_2 = re.compile(r"(\d)L\b")  # whole numbers as it wrote them
AXES = 32
LAST_LETTER = 0x10FFFF
CHUNK = 2**20  # bytes unpacked at once
EMPTY = 2**16  # rows and columns of an array without values
PACKED = 1032, 64  # deflate makes at most 1032 bytes of one, and some of none
PLENTY = 2**26, 250  # bytes from which on an array must not unpack to this many times its size: marks of residuals reach 208
NAMES = {1: "shrinking", 6: "implode", 9: "Deflate64", 12: "bzip2", 14: "LZMA", 93: "Zstandard", 95: "xz", 98: "PPMd", 99: "AES"}
ENCRYPTED = 0x1 | 0x40 | 0x2000
# what zipfile raises over a directory or a member that is damaged
DAMAGED = (
    zipfile.BadZipFile, zlib.error, struct.error, ValueError, EOFError, KeyError, IndexError, OverflowError, RuntimeError, OSError,
)  # fmt: skip
# what numpy raises over a header that is no dictionary of Python
NO_HEADER = (ValueError, SyntaxError, TypeError, KeyError, RecursionError, MemoryError, OverflowError)


class Header(NamedTuple):
    """What an array declares of itself."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    fortran: bool
    length: int  # bytes of the header

    @property
    def size(self) -> int:
        """Bytes of the values."""
        return math.prod(self.shape) * self.dtype.itemsize


class NumpyArchive(Mapping[str, Array]):
    """The arrays of an ``.npz``, each read when it is asked for."""

    def __init__(self, path: Path) -> None:
        self.path = path
        size_of(path)
        try:
            self._zip = zipfile.ZipFile(path)
        except DAMAGED as problem:
            message = f"it is not an .npz file ({clip_text(problem, VALUE)}; the file may be truncated)"
            raise error(path, f"cannot be read as numpy data: {message}", "write or copy it again") from None
        self._members = {info.filename.removesuffix(".npy"): info for info in self._zip.infolist()}

    def __getitem__(self, name: str) -> Array:
        where, take = f"array {quote(name)}", self._open_member(name)
        header, info = _header(self.path, where, take, self._members[name].file_size), self._members[name]
        large, times = PLENTY
        if header.size > max(large, times * info.compress_size):
            message = f"{where} would unpack to {header.size / 2**30:.1f} GB from {info.compress_size / 2**20:.1f} MB"
            raise error(self.path, message, "if that is what it holds, write it with numpy.savez instead of savez_compressed")
        return _values(self.path, where, take, header)

    def __iter__(self) -> Iterator[str]:
        return iter(self._members)

    def __len__(self) -> int:
        return len(self._members)

    def __contains__(self, name: object) -> bool:
        return name in self._members  # without reading it

    def shape(self, name: str) -> tuple[int, ...]:
        """The shape of an array, which is not read."""
        return _header(self.path, f"array {quote(name)}", self._open_member(name), self._members[name].file_size).shape

    def _open_member(self, name: str) -> Take:
        """A member to read from; whatever goes wrong with its packing is said in one line."""
        info, where = self._members[name], f"array {quote(name)}"
        if info.flag_bits & ENCRYPTED:
            raise error(self.path, f"{where} is encrypted", "save it without a password")
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            packing = NAMES.get(info.compress_type, f"method {info.compress_type}")
            raise error(self.path, f"{where} is packed by {packing}, which numpy does not write", AGAIN)
        times, more = PACKED if info.compress_type == zipfile.ZIP_DEFLATED else (1, 0)
        if info.file_size > times * info.compress_size + more:
            raise error(self.path, f"{where} cannot have the {info.file_size} bytes that the archive says", AGAIN)

        def guard_read(read: Callable[[], Any]) -> Any:
            try:
                return read()
            except DAMAGED as problem:
                message = f"{where} cannot be read ({clip_text(problem, VALUE)}; the file may be truncated)"
                raise error(self.path, message, "write or copy it again") from None

        stream = guard_read(lambda: self._zip.open(info))
        return lambda count: guard_read(lambda: stream.read(count))


def read_npy(path: Path) -> Array:
    """The array of an ``.npy`` file."""
    with open_file(path) as file:
        header = _header(path, "the array", file.read, size_of(path))
        return _values(path, "the array", file.read, header)


def _header(path: Path, where: str, take: Take, size: int) -> Header:
    """What the array declares, which must be what ``size`` bytes can hold."""
    start = take(10)
    if len(start) < 10 or start[:6] != MAGIC:
        raise error(path, f"{where} is no array of numpy (the file may be truncated)", AGAIN)
    version, length, before = start[6], int.from_bytes(start[8:10], "little"), 10
    if version not in (1, 2):
        raise error(path, f"{where} has the header of version {version} of the format, of records or of the future", AGAIN)
    if version == 2:
        length, before = length + (int.from_bytes(take(2), "little") << 16), 12
    text = take(length) if length <= HEADER else b""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of names of types that numpy means to give up
            declared = ast.literal_eval(PYTHON_2.sub(r"\1", text.decode("latin-1").strip()))
            shape, dtype, fortran = declared["shape"], np.dtype(declared["descr"]), bool(declared["fortran_order"])
        if not isinstance(shape, tuple) or not all(type(side) is int for side in shape):
            raise TypeError(shape)
    except NO_HEADER:
        raise error(path, f"{where} cannot be read: its header is damaged (the file may be truncated)", AGAIN) from None
    if dtype.hasobject:
        message = f"{where} cannot be read: it holds Python objects, which would need pickle"
        raise error(path, message, "save numbers or text: numpy.asarray(values, dtype=...)")
    if dtype.kind not in KINDS:
        raise error(path, f"{where} holds records, not plain values", "save each field as an array")
    header = Header(shape, dtype, fortran, before + length)
    sides = math.prod(side for side in shape if side)
    if len(shape) > AXES or min(shape, default=0) < 0 or (not header.size and sides > EMPTY):
        raise error(path, f"{where} cannot have the shape {quote(shape)}", AGAIN)
    if header.length + header.size != size:
        message = (
            f"{where} cannot be read as numpy data: it declares {header.size} bytes, and {max(0, size - header.length)} are there"
        )
        raise error(path, f"{message} (the file may be truncated)", "write or copy it again")
    return header


def _values(path: Path, where: str, take: Take, header: Header) -> Array:
    """The values behind the header, as plain numbers and text of this machine."""
    buffer, at = np.empty(header.size, np.uint8), 0
    while at < header.size:
        chunk = take(min(CHUNK, header.size - at))
        if not chunk:
            raise error(path, f"{where} cannot be read: it ends after {at} of {header.size} bytes", "write or copy it again")
        buffer[at : at + len(chunk)] = np.frombuffer(chunk, np.uint8)
        at += len(chunk)
    take(1)  # the end, where an archive compares its checksum
    dtype = header.dtype
    if not header.size:
        return np.zeros(header.shape, dtype)
    values = buffer.view(dtype).reshape(header.shape, order="F" if header.fortran else "C")
    if dtype.kind == "b":
        return np.asarray(values.view(np.uint8) != 0)  # other bytes than 0 and 1 are neither true nor false
    if dtype.kind == "U" and int(buffer.view(np.dtype(np.uint32).newbyteorder(dtype.byteorder)).max()) > LAST_LETTER:
        raise error(path, f"{where} holds text with letters that do not exist", AGAIN)
    kind = np.dtype(np.float64) if dtype.kind == "f" and dtype.itemsize not in (4, 8) else dtype.newbyteorder("=")
    with np.errstate(over="ignore", invalid="ignore"):  # what is beyond float64 is infinite, and refused where that matters
        return np.asarray(values.astype(kind, copy=False))
