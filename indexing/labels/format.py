"""What a format of labels is; what its reader is asked and gathers (sound labels, and notices of everything else), where its writer
writes."""

from __future__ import annotations

import hashlib
import math
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from indexing.labels.label import NUM_NAMED, Label, LabelFile, list_spots, sort_key
from indexing.opening import clip_text, count, error, head_of, listing, parse_json, quote, read_rows, read_text
from indexing.registry import load_formats

TIME_REMEDY = "give seconds"
NAMES = {"observations": "observation", "tiers": "tier", "subjects": "subject", "media": "media"}
"""Of a file of labels, lists of names, and the field of a label that each is of."""
NUM_HEADER_ROWS = 80  # in which a table says what it is about, before it begins


@dataclass(frozen=True)
class Request:
    """What somebody wants of a file; the arguments are those of :func:`indexing.labels.open_labels`."""

    path: Path
    recording: str | Path | None = None
    media: str | None = None
    observation: str | None = None
    subject: str | None = None
    tier: str | None = None
    fps: float | None = None


@dataclass(frozen=True)
class Target:
    """A file to write labels into; the arguments are those of :func:`indexing.labels.write_labels`."""

    path: Path
    media: tuple[str, ...] = ()
    into: Path | None = None
    tier: str = "dyntorch"
    duration: float | None = None
    fps: float | None = None
    annotator: str = ""
    name: str | None = None
    dry: bool = False
    format: str = ""


@dataclass(frozen=True)
class LabelFormat:
    """A format of labels, declared as ``FORMAT`` in the file or room of ``indexing/labels/formats`` that has its name."""

    title: str
    """What a person is asked to give, as errors list it."""
    kinds: tuple[str, ...]
    """Of files: ``"json"`` (matched by the value), ``"table"`` (by its rows: line, cells), ``"xml"`` (by None)."""
    read: Callable[[Any, Request], LabelFile]
    matches: Callable[[Any], bool] = lambda data: True
    """Whether a file of these kinds is of the format, by what was parsed of it."""
    order: int = 50
    """Among formats of one kind, those with the stricter telltale are asked first."""
    write: Callable[[Sequence[Label], Target], list[str]] | None = None
    written: Mapping[str, str] = field(default_factory=dict)
    """Names by which it is written, and the suffix that means each; empty where only ``format=`` does."""
    program: str = ""
    """Whose files are written into where they are there, beside what a person made; empty: written anew."""
    one_recording: bool = False
    """Whether a file is of one recording only."""


class Gathering:
    """Labels of a file while it is read."""

    def __init__(self, asked: Request, name: str) -> None:
        self.asked = asked
        self.format = name
        self.labels: list[Label] = []
        self.observations: dict[str, None] = {}
        self.tiers: dict[str, None] = {}
        self.subjects: dict[str, None] = {}
        self.media: dict[str, None] = {}
        self.machine: dict[str, None] = {}
        self.watched: dict[tuple[str, str], None] = {}
        self.notices: list[str] = []
        self._nameless: list[Label] = []

    def add(self, label: str, start: Any, end: Any, where: str, **fields: Any) -> None:
        """A label with the times that the file says."""
        begin, stop = self.seconds(start, where, "start"), self.seconds(end, where, "end")
        if stop < begin:
            raise error(self.asked.path, f"{where}: ends at {stop:g} s, but starts at {begin:g} s", "give start first")
        entry = Label(begin, stop, label.strip(), **fields)
        if entry.label:
            self.labels.append(entry)
        else:
            self._nameless.append(entry)
        for names, field_ in NAMES.items():
            if name := getattr(entry, field_):
                getattr(self, names).setdefault(name)

    def seconds(self, value: Any, where: str, what: str) -> float:
        """A time of the file as seconds: a number, digits, or ``hh:mm:ss.sss``."""
        if type(value) is float or type(value) is int:
            number = _number(value)
        else:
            number = parse_seconds(value) if isinstance(value, str) else math.nan
        if not math.isfinite(number):
            raise error(self.asked.path, f"{where}: {what} {quote(value)} is no time", TIME_REMEDY)
        return number

    def list_of(self, value: Any, where: str, remedy: str) -> list[Any]:
        """A list of the file; an empty one where nothing is there."""
        if value is not None and not isinstance(value, list):
            raise error(self.asked.path, f"{where} is {quote(value)}, not a list", remedy)
        return value or []

    def note(self, notice: str) -> None:
        """Something that a person should know, once."""
        if notice not in self.notices:
            self.notices.append(notice)

    def finish(self) -> LabelFile:
        """The file as read: labels sorted, what comes twice kept once."""
        if self._nameless:
            where = list_spots(self._nameless)
            self.note(f"{count(len(self._nameless), 'label')} without a name left out ({where})")
        labels = self.labels
        if len(set(labels)) < len(labels):
            twice = [label for label, times in Counter(labels).items() if times > 1]
            labels = list(dict.fromkeys(labels))
            again = len(self.labels) - len(labels)
            self.note(f"{count(again, 'label')} left out: there twice ({list_spots(twice)})")
        return LabelFile(
            path=self.asked.path,
            format=self.format,
            labels=tuple(sorted(labels, key=sort_key)),
            **{name: tuple(getattr(self, name)) for name in (*NAMES, "machine", "watched", "notices")},
        )


def parse_seconds(text: str) -> float:
    """Seconds from digits or ``hh:mm:ss.sss``; NaN where it is neither."""
    sign = -1.0 if text.strip().startswith("-") else 1.0
    parts = text.strip().lstrip("+-").replace(",", ".").split(":")
    if len(parts) > 3 or "_" in text:
        return math.nan
    total = 0.0
    for part in parts:
        number = _number(part)
        if not number >= 0:
            return math.nan
        total = 60 * total + number
    return sign * total


def parse_whole(value: Any) -> int | None:
    """A whole number of a file, None where it is none."""
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        return None
    number = _number(value)
    return int(number) if math.isfinite(number) and number == int(number) else None


def text_of(value: Any) -> str:
    """What a JSON file has for a name: text, or a number that somebody wrote for one; empty where it is neither."""
    if isinstance(value, str):
        return value
    return quote(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else ""


def list_few(names: Iterable[object]) -> str:
    """The first names of a list, each short."""
    listed = [clip_text(name, 40) or "(unnamed)" for name in names]
    return ", ".join(listed[:NUM_NAMED]) + f" and {len(listed) - NUM_NAMED} more" * (len(listed) > NUM_NAMED)


def _number(value: Any) -> float:
    try:
        return float(value)
    except (ValueError, OverflowError):
        return math.nan


def seal(*parts: object) -> str:
    """A mark of what was written into a tier or an observation: it stands beside it, and tells whether somebody changed it
    since."""
    text = "\x1f".join(" ".join(str(part).split()) for part in parts)
    return hashlib.sha256(text.encode("utf-8", "backslashreplace")).hexdigest()[:8]


def correction_error(target: Target, what: str) -> ValueError:
    """What was found is corrected where it stands: nobody loses that without a word."""
    message = f"{what} is not as dyntorch wrote it: somebody has corrected it"
    return error(target.into or target.path, message, "rename it to take it over, delete it, or write to another file")


# ----------------------------------------------------------------------------------------------------------------------
# Which format a file of labels has: decided by what it holds, not by its name


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
    for magic, message, remedy in FOREIGN:
        if head.startswith(magic):
            raise error(path, message, remedy)
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


# ----------------------------------------------------------------------------------------------------------------------
# Which file that labels are of is the recording at hand, and whose clock runs when several are played after each other


SUFFIX = re.compile(r"\.\w{1,8}$")
REMEDY = "name the recording as its video is named, or say which it is (--media NAME)"


@dataclass(frozen=True)
class Span:
    """A stretch of a clock on which one file is played."""

    media: str
    begin: float = 0.0
    end: float = math.inf


def split_by_media(start: float, end: float, spans: Sequence[Span]) -> list[tuple[str, float, float]]:
    """A stretch of a clock, by the files that are played then: each file with start and end on its own clock."""
    pieces = []
    for number, span in enumerate(spans):
        first = -math.inf if number == 0 else span.begin
        last = math.inf if number == len(spans) - 1 else span.end
        inside = first <= start < last if start == end else start < last and end > first
        if inside:
            pieces.append((span.media, max(start, first) - span.begin, min(end, last) - span.begin))
    return pieces


def base_name(name: str) -> str:
    """The name of a file without folders, whatever system or address it was written on."""
    plain = unquote(name) if "://" in name or name.startswith("file:") else name
    return re.split(r"[\\/]", plain.rstrip("\\/"))[-1]


def of_recording(names: Iterable[str], asked: Request) -> set[str] | None:
    """Those of the files in a label file that are the recording at hand; None where none is at hand."""
    known = list(dict.fromkeys(name for name in names if name))
    if asked.media is not None:
        same = {name for name in known if name == asked.media} or {name for name in known if base_name(name) == asked.media}
        if not same:
            message = f"has no labels of {asked.media}, only of {listing(known)}"
            raise error(asked.path, message, "give one of these names (--media)")
        return same
    if asked.recording is None or not known:
        return None
    ranks = {name: _likeness(name, str(asked.recording)) for name in known}
    best = max(ranks.values())
    if not best:
        recording = base_name(str(asked.recording))
        raise error(asked.path, f"its labels are of {listing(known)}, not of {recording}", REMEDY)
    best_names = [name for name in known if ranks[name] == best]
    if len(best_names) > 1:
        raise error(asked.path, f"{base_name(str(asked.recording))} may be any of {listing(best_names)}", REMEDY)
    return set(best_names)


def same_recording(name: str, other: str) -> bool:
    """Whether two files are called alike, but for their folders and suffixes: a video and its keypoints."""
    return SUFFIX.sub("", base_name(name)).casefold() == SUFFIX.sub("", base_name(other)).casefold()


def _likeness(name: str, recording: str) -> tuple[int, int] | tuple[()]:
    """How much a file of the labels is like the recording: empty where it is another one."""
    folders = [re.split(r"[\\/]", text)[:-1] for text in (name, os.path.abspath(os.path.expanduser(recording)))]
    shared = 0
    for a, b in zip(reversed(folders[0]), reversed(folders[1]), strict=False):
        if a != b:
            break
        shared += 1
    theirs, ours = base_name(name), base_name(recording)
    if theirs == ours:
        return 3, shared
    stems = [SUFFIX.sub("", text).casefold() for text in (theirs, ours)]
    if stems[0] == stems[1]:
        return 2, shared
    if all(stems) and (_holds(stems[1], stems[0]) or _holds(stems[0], stems[1])):
        return 1, len(min(stems, key=len))
    return ()


def _holds(text: str, word: str) -> bool:
    return re.search(rf"(?<![^\W_]){re.escape(word)}(?![^\W_])|^{re.escape(word)}dlc", text) is not None
