"""The one gate to files that others wrote: what is no regular file, too large, or not what it says is refused in one line."""

from __future__ import annotations

import csv
import errno
import gc
import io
import json
import os
import re
import reprlib
import stat
import tomllib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from dyntorch.numerics import Message

VALUE = 60  # characters of a received value that a message quotes
SAID = 240  # characters of what is wrong, and of what to do
SHORT = reprlib.Repr()  # knows where to stop in a list of a million, or in one that is a thousand deep
SHORT.maxstring = SHORT.maxother = SHORT.maxlong = VALUE
LISTED = 8  # names that a message lists
LARGEST = 2**31  # bytes of a file that is read as a whole: an hour of poses is a tenth of it
WIDEST = 20_000  # cells of a row: the largest set of landmarks takes a tenth of them
DEEPEST = 100  # brackets inside each other: keypoints take five, and parsers that recur take their time over thousands
LONGEST_TOML = 2**20  # characters: a calibration takes some hundred per camera
DOTTED = re.compile(rf"(?<![\w\"'-])(?:[\w\"'-]++\s*+\.\s*+){{{DEEPEST}}}")  # one key in another, so deep
DENSE = 2**22, 0.02  # cells of a table from which on at least this share of them must be filled

Row = tuple[int, list[str]]
TABLE_REMEDY = "export it again as CSV in UTF-8, a row per line"
TEXT_REMEDY = "export it again as text in UTF-8"
KINDS: tuple[tuple[Callable[[int], bool], str, str], ...] = (
    (stat.S_ISDIR, "is a folder", "give the file in it"),
    (stat.S_ISFIFO, "is a pipe, not a file", "save what comes out of it, and give that file"),
    (stat.S_ISSOCK, "is a socket, not a file", "save what comes out of it, and give that file"),
)


# ---- messages ------------------------------------------------------------------------------------------------------------
def error(path: str | Path, what: object, remedy: str) -> ValueError:
    """The one shape of every message, a line that is never long: file, what is wrong, what to do."""
    message, help_ = (part if isinstance(part, Message) else clip_text(part) for part in (what, remedy))
    return ValueError(Message("{path}: {what}; {remedy}", path=str(path), what=message, remedy=help_))


def clip_text(text: object, most: int = SAID) -> str:
    """Text on one line, without control characters, and without its middle where it is long."""
    plain = " ".join(str(text).split())
    if not plain.isprintable():
        plain = "".join(c if c.isprintable() else "?" for c in plain)
    half = (most - 3) // 2
    return plain if len(plain) <= most else f"{plain[: most - 3 - half]}...{plain[len(plain) - half :]}"


def quote(value: Any) -> str:
    """A received value for a message: its ``repr``, of which only the ends are shown where it is long.

    Example:
        >>> quote("12"), quote(10**99)
        ("'12'", '1000000000000000000000000000...00000000000000000000000000000')
    """
    if type(value) is int and value.bit_length() < VALUE:
        return repr(value)  # asked for each of a hundred thousand detections
    if type(value) is str and len(value) < VALUE // 2 and value.isascii() and value.isprintable() and " " not in value:
        return repr(value)
    if isinstance(value, int) and value.bit_length() > 1000:  # Python refuses to print some thousand digits
        return f"a whole number of about {int(value.bit_length() * 0.30103)} digits"
    return clip_text(SHORT.repr(value), VALUE)


def count(number: int, one: str, many: str = "") -> str:
    """``1 clip``, ``2 clips``; ``many`` where the plural is not the noun with an s.

    Example:
        >>> count(2, "match", "matches")
        '2 matches'
    """
    return f"{number:,} {one if number == 1 else many or f'{one}s'}"


def listing(names: Iterable[object], most: int = LISTED) -> str:
    """The first names, each clipped."""
    clipped = [clip_text(name, VALUE // 3) or "(unnamed)" for name, _ in zip(names, range(most + 1), strict=False)]
    return ", ".join(clipped[:most]) + ", ..." * (len(clipped) > most) or "none"


def first_duplicate(names: Iterable[Any]) -> Any:
    """The first that comes again later, None where none does."""
    names = list(names)
    counts = Counter(names)
    return next((name for name in names if counts[name] > 1), None)


# ---- files ---------------------------------------------------------------------------------------------------------------
def size_of(path: str | Path, remedy: str = "check the path", what: str = "file") -> int:
    """Bytes of a regular file."""
    try:
        status = os.stat(path)
    except OSError as problem:
        raise _unreachable(path, problem, remedy, what) from None
    except ValueError:  # a null character
        raise error(quote(str(path)), "no file can have this name", "check the path") from None
    kind = next(((message, do) for test, message, do in KINDS if test(status.st_mode)), None)
    if kind is None and not stat.S_ISREG(status.st_mode):
        kind = "is a device, not a file", "give a file"
    if kind is not None:
        raise error(path, *kind)
    return status.st_size


def is_regular(path: str | Path) -> bool:
    """Whether there is a file that can be read, rather than nothing, a folder, a pipe or a device."""
    try:
        size_of(path)
    except ValueError:
        return False
    return True


def _unreachable(path: str | Path, problem: OSError, remedy: str, what: str) -> ValueError:
    if problem.errno == errno.ELOOP:
        return error(path, "is a link that leads back to itself", "give the file that it should lead to")
    if os.path.islink(path):
        return error(path, "is a link to a file that is not there", "give that file, or mend the link")
    if problem.errno in (errno.ENOENT, errno.ENOTDIR):
        return error(path, f"no such {what}", remedy)
    return error(path, f"cannot be opened ({problem.strerror or problem})", "check the path and its permissions")


def entries(folder: Path) -> list[Path]:
    """What a folder holds, sorted by name, less what is hidden."""
    try:
        return sorted(entry for entry in folder.iterdir() if not entry.name.startswith("."))
    except OSError as problem:
        raise error(folder, f"cannot be listed ({problem.strerror or problem})", "check the path and its permissions") from None


@contextmanager
def open_file(path: str | Path, remedy: str = "check the path") -> Iterator[BinaryIO]:
    """A regular file, to be read; an error of the disk while it is read names the file, too."""
    size_of(path, remedy)
    try:
        with open(path, "rb") as file:
            yield file
    except OSError as problem:
        message = f"cannot be read ({problem.strerror or problem})"
        raise error(path, message, "check its permissions and the disk that holds it") from None


def head_of(path: str | Path, length: int = 512) -> bytes:
    """The first bytes of a file."""
    with open_file(path) as file:
        head = file.read(length)
    if not head.strip():
        raise error(path, "the file is empty", "export it again")
    return head


def read_bytes(path: str | Path, remedy: str = "check the path") -> bytes:
    """All of a file."""
    with open_file(path, remedy) as file:
        size = os.fstat(file.fileno()).st_size
        if size > LARGEST:
            raise error(path, f"has {size / 2**30:.1f} GB, more than can be read at once", "split the recording")
        return file.read(LARGEST)


def read_text(path: str | Path, remedy: str = TEXT_REMEDY, missing: str = "check the path") -> str:
    """All of a file as text in UTF-8."""
    try:
        return read_bytes(path, missing).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise error(path, "is not a text file in UTF-8", remedy) from None


@contextmanager
def without_garbage_collection() -> Iterator[None]:
    """Without Python's search for reference cycles: read objects make none, and among a million it takes a third of the time."""
    before = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if before:
            gc.enable()


# ---- JSON and TOML -------------------------------------------------------------------------------------------------------
def parse_json(path: str | Path, text: str, remedy: str, where: str = "") -> Any:
    """Parsed JSON (``NaN`` allowed)."""
    before = f"{where}: " if where else ""
    try:
        return json.loads(text)
    except json.JSONDecodeError as problem:
        message = f"{before}not valid JSON at line {problem.lineno}, column {problem.colno} ({problem.msg})"
        raise error(path, message, remedy) from None
    except RecursionError:
        raise error(path, f"{before}the JSON is nested too deeply", remedy) from None
    except ValueError:  # more digits than Python reads
        raise error(path, f"{before}the JSON has a number of thousands of digits", remedy) from None


def parse_toml(path: str | Path, text: str, remedy: str) -> dict[str, Any]:
    """Parsed TOML."""
    # Python's parser recurs into brackets, and takes time that grows with the square of the number of dotted keys
    if len(text) > LONGEST_TOML:
        raise error(path, "is larger than any such TOML file", remedy)
    if _depth(text) > DEEPEST or DOTTED.search(text):
        raise error(path, "the TOML is nested too deeply", remedy)
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as problem:
        raise error(path, f"is not a TOML file ({clip_text(problem, 2 * VALUE)})", remedy) from None
    except RecursionError:
        raise error(path, "the TOML is nested too deeply", remedy) from None
    except ValueError:
        raise error(path, "the TOML has a number or date that is none", remedy) from None


def _depth(text: str) -> int:
    """An upper bound of how deep brackets stand inside each other."""
    depth = deepest = 0
    for letter in text:
        if letter in "[{":
            depth += 1
            deepest = max(deepest, depth)
        elif letter in "]}":
            depth = max(0, depth - 1)
    return deepest


# ---- tables --------------------------------------------------------------------------------------------------------------
def read_rows(path: str | Path, remedy: str = TABLE_REMEDY, missing: str = "check the path", numbers: bool = True) -> Iterator[Row]:
    """Line number (1-based) and cells of every row of a table that is not blank; commas, semicolons or tabs separate cells."""
    with open_file(path, missing) as file:
        if os.fstat(file.fileno()).st_size > LARGEST:
            raise error(path, "is larger than any table of points", "split the recording")
        text = io.TextIOWrapper(file, encoding="utf-8-sig", newline="")
        try:
            first = text.readline()
            text.seek(0)
            delimiter = max(",;\t", key=first.count)
            for line, cells in enumerate(csv.reader(text, delimiter=delimiter), start=1):
                if len(cells) > WIDEST:
                    raise error(path, f"row {line} has {len(cells)} cells", remedy)
                if any(cells):
                    yield line, [cell.replace(",", ".") for cell in cells] if numbers and delimiter == ";" else cells
        except UnicodeDecodeError:
            raise error(path, "is not a text file in UTF-8", remedy) from None
        except csv.Error as problem:
            raise error(path, f"is no table ({problem})", remedy) from None


def check_dense(path: str | Path, cells: int, filled: int, what: str, remedy: str) -> None:
    """Refuse a table that is nearly empty before it is laid out: sixty thousand names of each other thing take gigabytes."""
    most, share = DENSE
    if cells > most and filled < share * cells:
        raise error(path, f"its {filled} rows would fill {100 * filled / cells:.2g} % of a table of {what}", remedy)
