"""What a format of labels is; what its reader is asked and gathers (sound labels, and notices of everything else), where its writer
writes."""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from indexing.labels.label import NUM_NAMED, Label, LabelFile, in_order, list_spots
from indexing.opening import clip_text, count, error, shown

TIME_REMEDY = "give seconds"
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
        found = Label(begin, stop, label.strip(), **fields)
        if found.label:
            self.labels.append(found)
        else:
            self._nameless.append(found)
        for name, known in (
            (found.observation, self.observations),
            (found.tier, self.tiers),
            (found.subject, self.subjects),
            (found.media, self.media),
        ):
            if name:
                known.setdefault(name)

    def seconds(self, value: Any, where: str, what: str) -> float:
        """A time of the file as seconds: a number, digits, or ``hh:mm:ss.sss``."""
        if type(value) is float or type(value) is int:
            number = _number(value)
        else:
            number = parse_seconds(value) if isinstance(value, str) else math.nan
        if not math.isfinite(number):
            raise error(self.asked.path, f"{where}: {what} {shown(value)} is no time", TIME_REMEDY)
        return number

    def note(self, notice: str) -> None:
        """Something that a person should know, once."""
        if notice not in self.notices:
            self.notices.append(notice)

    def finish(self) -> LabelFile:
        """The file as read: labels sorted, what comes twice kept once."""
        if self._nameless:
            where = list_spots(self._nameless)
            self.note(f"{count(len(self._nameless), 'label')} without a name left out ({where})")
        kept = self.labels
        if len(set(kept)) < len(kept):
            twice = [label for label, times in Counter(kept).items() if times > 1]
            kept = list(dict.fromkeys(kept))
            again = len(self.labels) - len(kept)
            self.note(f"{count(again, 'label')} left out: there twice ({list_spots(twice)})")
        return LabelFile(
            path=self.asked.path,
            format=self.format,
            labels=tuple(sorted(kept, key=in_order)),
            observations=tuple(self.observations),
            tiers=tuple(self.tiers),
            subjects=tuple(self.subjects),
            media=tuple(self.media),
            machine=tuple(self.machine),
            watched=tuple(self.watched),
            notices=tuple(self.notices),
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
    return shown(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else ""


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
    said = f"{what} is not as dyntorch wrote it: somebody has corrected it"
    return error(target.into or target.path, said, "rename it to take it over, delete it, or write to another file")
