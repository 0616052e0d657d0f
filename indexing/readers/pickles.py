"""Pickles that hold arrays and plain containers, and nothing else: the one place where such files are read.

A pickle is a program: it names functions and says what to call them with.  This reader runs that program on a short list of steps,
and knows six names, which do not lead to numpy's functions but to stand-ins here that make an array of numbers or text from its
parts, having checked them.  Every other name is refused, and said.  Nothing that a file says is imported or called, no step takes
more memory than the file has bytes, and there are no more steps than a file of its size needs.

Python's own reader in C is not used: it lays out a table as large as a number in the file says (``LONG_BINPUT``), and attributes of
the functions that it is handed can be set by a file (``BUILD``).  Keys of dictionaries are text and numbers: a tuple is hashed by
going into it, which a tuple of tuples can make endless, or deeper than the stack.  There are no sets, which hash what they hold.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing.opening import LARGEST, VALUE, clip_text, error, quote, read_bytes

REMEDY = "save it again with nothing in it but numpy arrays of numbers, text, lists and dictionaries"
# steps of pickles by their names: containers, numbers, text, bytes, the memo, and calls of the names below
STEPS = {
    *("MARK", "STOP", "POP", "POP_MARK", "DUP", "GET", "BINGET", "LONG_BINGET", "PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE", "PROTO"),
    *("FRAME", "NONE", "NEWTRUE", "NEWFALSE", "INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT"),
    *("STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE", "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8", "BINBYTES"),
    *("SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8", "EMPTY_LIST", "APPEND", "APPENDS", "LIST", "EMPTY_TUPLE", "TUPLE", "TUPLE1"),
    *("TUPLE2", "TUPLE3", "EMPTY_DICT", "DICT", "SETITEM", "SETITEMS"),
    *("GLOBAL", "STACK_GLOBAL", "REDUCE", "BUILD"),
}
# what a step that is not known may do, in words
OTHERS = {
    "PERSID": "a persistent id", "BINPERSID": "a persistent id", "EXT1": "an extension code", "EXT2": "an extension code",
    "EXT4": "an extension code", "NEXT_BUFFER": "values outside of the file", "EMPTY_SET": "a set", "ADDITEMS": "a set",
    "FROZENSET": "a set",
}  # fmt: skip
PLAIN = "biufSU"  # kinds of arrays: numbers and text
STEP_BLOCK = 2**16, 4, 2**24  # steps of any file, bytes of a file per further step, and steps of the largest file
MADE_BLOCK = 2**20, 4  # bytes, and bytes per byte of the file, of what is decoded
LATIN = ("latin1", "latin-1")
KEYS = (str, bytes, int, float, bool, type(None))  # types of keys that are hashed in time that a file cannot choose
WHOLE = 2**53  # whole numbers beyond it are no keys: those that are 2^61 - 1 apart have one hash
NUMBERED_BLOCK = 2**13  # keys of a dictionary with numbers among them: names of classes are some hundred
LONGEST_CODE = 12  # characters of a type's name, such as <f8 or U100


class Refused(Exception):
    """What a pickle must not hold, in words."""


class _Kind:
    """A type of values, on its way to numpy's."""

    __slots__ = ("dtype",)

    def __init__(self, code: Any) -> None:
        code = code.decode("latin-1") if isinstance(code, bytes) and len(code) <= LONGEST_CODE else code
        if not isinstance(code, str) or len(code) > LONGEST_CODE or not code[1:].isdigit() or code[:1] not in PLAIN:
            raise Refused(f"an array of {quote(code)}, neither numbers nor text")
        try:
            self.dtype = np.dtype(code)
        except (TypeError, ValueError):
            raise Refused(f"an array of {quote(code)}, which numpy does not know") from None

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) < 5 or any(part is not None for part in state[2:5]):
            raise Refused("an array of records")
        order = state[1].decode("latin-1") if isinstance(state[1], bytes) else state[1]
        if order not in ("<", ">", "|", "="):
            raise Refused("an array in no order of bytes")
        size = state[5] if len(state) > 5 else -1
        if type(size) is int and size > 0 and self.dtype.kind in "SU":
            self.dtype = np.dtype(f"{self.dtype.kind}{size // (4 if self.dtype.kind == 'U' else 1)}")
        self.dtype = self.dtype.newbyteorder(order)  # type: ignore[arg-type]  # one of four, as it says above


class _Array:
    """An array, on its way to numpy's."""

    __slots__ = ("bytes_of", "values")

    def __init__(self, bytes_of: Callable[[int], None], values: NDArray[Any] | None = None) -> None:
        self.bytes_of, self.values = bytes_of, values

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) != 5:
            raise Refused("an array without its parts")
        _, shape, kind, fortran, data = state
        self.values = _values(data, kind, shape, "F" if fortran else "C", self.bytes_of)


class _Name:
    """Stands in for one of the names that are known: it can be called, and nothing about it can be changed."""

    __slots__ = ("_called",)
    _called: Callable[..., Any]

    def __init__(self, called: Callable[..., Any]) -> None:
        object.__setattr__(self, "_called", called)

    def __call__(self, *arguments: Any) -> Any:
        return self._called(*arguments)

    def __setattr__(self, name: str, value: Any) -> None:
        raise Refused("a change to a function")

    def __setstate__(self, state: Any) -> None:
        raise Refused("a change to a function")


class _Memo(dict[Any, Any]):
    """What a file keeps under numbers that it chooses: by their digits, whose hashes it cannot choose."""

    def __setitem__(self, key: int, value: Any) -> None:
        super().__setitem__(str(key), value)

    def __getitem__(self, key: int) -> Any:
        return super().__getitem__(str(key))


class _Reader(pickle._Unpickler):
    """Python's own reader of pickles, less all that it can do but containers, numbers, text and six names."""

    def __init__(self, data: bytes) -> None:
        super().__init__(io.BytesIO(data), encoding="latin1")  # of arrays that Python 2 wrote
        self._bytes, self._made = len(data), 0
        self.memo = _Memo()
        most, per, last = STEP_BLOCK
        self._steps = min(most + len(data) // per, last)
        ndarray = _Name(self._never)
        made = {"_reconstruct": _Name(lambda *a: self._reconstruct(ndarray, *a)), "scalar": _Name(self._scalar)}
        self._known: dict[tuple[str, str], _Name] = {
            ("numpy", "ndarray"): ndarray, ("numpy", "dtype"): _Name(lambda code, *_: _Kind(code)),
            ("_codecs", "encode"): _Name(self._encode), ("builtins", "bytes"): _Name(lambda: b""),
            **{(f"numpy.{core}.multiarray", name): one for core in ("core", "_core") for name, one in made.items()},
            **{(f"numpy.{core}.numeric", "_frombuffer"): _Name(self._frombuffer) for core in ("core", "_core")},
        }  # fmt: skip

    def load(self) -> Any:
        """The value, or :class:`Refused`."""
        internals: Any = pickle  # what its reader in Python is made of, which the stubs do not list
        self._unframer = internals._Unframer(self._file_read, self._file_readline)  # type: ignore[attr-defined]
        self.read, self.readinto, self.readline = self._unframer.read, self._unframer.readinto, self._unframer.readline
        self.metastack: list[Any] = []
        self.stack: list[Any] = []
        self.append = self.stack.append
        self.proto = 0
        for _ in range(self._steps):
            key = self.read(1)
            if not key:
                raise EOFError("it ends before its value")
            step = _STEPS.get(key[0])
            if step is None:
                raise Refused(_OTHER.get(key[0], f"the step {quote(key)}"))
            try:
                step(self)
            except internals._Stop as stop:
                return stop.value
        raise Refused("more steps than its size allows")

    def find_class(self, module: str, name: str) -> Any:
        """A stand-in, whatever the file names."""
        stand_in = self._known.get((module.replace("__builtin__", "builtins"), name))
        if stand_in is None:
            raise Refused(f"the name {clip_text(f'{module}.{name}', VALUE)}")
        return stand_in

    def persistent_load(self, pid: Any) -> Any:
        raise Refused("a persistent id")

    def bytes_of(self, size: int) -> None:
        """Count bytes that come from fewer ones."""
        self._made += size
        least, times = MADE_BLOCK
        if self._made > least + times * self._bytes:
            raise Refused("the same bytes again and again")

    # ---- what the names stand for ------------------------------------------------------------------------------------
    def _never(self, *_: Any) -> Any:
        raise Refused("a call of numpy.ndarray")

    def _reconstruct(self, ndarray: _Name, kind: Any, *_: Any) -> _Array:
        if kind is not ndarray:
            raise Refused("an array of another class")
        return _Array(self.bytes_of)

    def _scalar(self, kind: Any, data: Any = None) -> Any:
        values = _values(data, kind, (), "C", self.bytes_of)
        self.bytes_of(values.nbytes)
        return values[()]

    def _frombuffer(self, data: Any, kind: Any, shape: Any, order: Any) -> _Array:
        return _Array(self.bytes_of, _values(data, kind, shape, "F" if order == "F" else "C", self.bytes_of))

    def _encode(self, text: Any, encoding: Any = None) -> bytes:
        if not isinstance(text, str) or encoding not in LATIN:
            raise Refused(f"text in the encoding {quote(encoding)}")
        self.bytes_of(len(text))
        return text.encode("latin-1")

    # ---- steps of its own --------------------------------------------------------------------------------------------
    def _dict(self) -> None:
        made: dict[Any, Any] = {}
        _fill(made, self.pop_mark())  # type: ignore[attr-defined]  # the stubs do not list what the reader is made of
        self.append(made)

    def _setitem(self) -> None:
        value, key = self.stack.pop(), self.stack.pop()
        _fill(self.stack[-1], [key, value])

    def _setitems(self) -> None:
        items = self.pop_mark()  # type: ignore[attr-defined]
        _fill(self.stack[-1], items)

    def _bytearray(self) -> None:
        (size,) = struct.unpack("<Q", self.read(8))
        if size > self._bytes:
            raise EOFError("it ends before its value")
        self.append(bytes(self.read(size)))


def _fill(into: Any, items: list[Any]) -> None:
    """Put keys and values, which take turns, into a dictionary."""
    if type(into) is not dict or len(items) % 2:
        raise Refused("keys and values without a dictionary")
    for key, value in zip(items[::2], items[1::2], strict=True):
        if type(key) not in KEYS:
            raise Refused(f"a key of the type {clip_text(type(key).__name__, VALUE)}")
        if type(key) is int and abs(key) > WHOLE:
            raise Refused(f"the key {quote(key)}")
        if type(key) in (int, float) and len(into) >= NUMBERED_BLOCK:
            raise Refused(f"more than {NUMBERED_BLOCK} numbers as keys")
        into[key] = value


def _values(data: Any, kind: Any, shape: Any, order: Any, bytes_of: Callable[[int], None]) -> NDArray[Any]:
    """An array from its parts, each of which is checked; what is copied is counted by ``bytes_of``."""
    if not isinstance(kind, _Kind) or not isinstance(shape, tuple) or not all(type(side) is int and side >= 0 for side in shape):
        raise Refused("an array without its parts")
    if isinstance(data, str):  # as Python 2 wrote it
        bytes_of(len(data))
        data = data.encode("latin-1")
    if not isinstance(data, bytes):
        raise Refused("an array of Python objects")
    if len(shape) > 32 or max(shape, default=0) >= 2**63 or math.prod(shape) * kind.dtype.itemsize != len(data):
        raise Refused(f"an array of {len(data)} bytes for the shape {quote(shape)}")
    if not len(data):
        if max(shape, default=0) > LARGEST or (not kind.dtype.itemsize and math.prod(shape) > 1):  # numpy makes U0 a U1
            raise Refused(f"an array of the shape {quote(shape)}")
        return np.zeros(shape, kind.dtype)
    return np.frombuffer(data, kind.dtype).reshape(shape, order=order)


_CODES = {opcode.name: opcode.code.encode("latin-1")[0] for opcode in pickletools.opcodes}
_OWN: dict[str, Callable[[Any], None]] = {
    "BYTEARRAY8": _Reader._bytearray, "DICT": _Reader._dict, "SETITEM": _Reader._setitem, "SETITEMS": _Reader._setitems,
}  # fmt: skip
_STEPS: dict[int, Callable[[Any], None]] = {
    _CODES[name]: _OWN.get(name) or pickle._Unpickler.dispatch[_CODES[name]] for name in STEPS
}
_OTHER = {_CODES[name]: OTHERS.get(name, f"the step {name}") for name in _CODES if name not in STEPS}


def read_pickle(path: Path) -> Any:
    """What a pickle holds: numpy arrays, numbers, text, lists, tuples and dictionaries."""
    return unpickle_bytes(path, read_bytes(path), "")


def unpickle_bytes(path: Path, data: bytes, where: str) -> Any:
    """The same of bytes in a file."""
    who = f"{where}: the pickle" if where else "the pickle"
    try:
        return _replace_parts(_Reader(data).load(), {})
    except Refused as refused:
        raise error(path, f"{who} holds {refused}, which is not read from a file", REMEDY) from None
    except Exception as problem:  # a program that does not run fails in as many ways as there are steps
        message = clip_text(f"{type(problem).__name__}: {problem}", VALUE)
        raise error(path, f"{who} cannot be read ({message}; the file may be truncated)", REMEDY) from None


def _replace_parts(value: Any, seen: dict[int, Any]) -> Any:
    """The value with arrays in place of what they were made of; containers are changed in place, each once."""
    stack = [value]
    while stack:
        one = stack.pop()
        if not isinstance(one, (list, dict, tuple)) or id(one) in seen:
            continue
        seen[id(one)] = one
        inside = one.items() if isinstance(one, dict) else enumerate(one)
        for key, part in list(inside):
            if isinstance(part, (_Kind, _Name)) or isinstance(key, (_Array, _Kind, _Name)):
                raise Refused("a part of an array outside of one")
            if isinstance(part, _Array):
                if isinstance(one, tuple):
                    raise Refused("an array in a tuple")
                one[key] = _require_values(part)
            else:
                stack.append(part)
    if isinstance(value, (_Kind, _Name)):
        raise Refused("a part of an array outside of one")
    return _require_values(value) if isinstance(value, _Array) else value


def _require_values(part: _Array) -> NDArray[Any]:
    if part.values is None:
        raise Refused("an array without its parts")
    return part.values
