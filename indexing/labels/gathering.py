"""What a reader is asked, and what it gathers: labels that are sound, and notices of everything else."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from indexing.labels.label import Label, LabelFile, in_order, spots
from indexing.labels.options import LabelOptions
from indexing.opening import clipped, count, error, shown

TIME_REMEDY = "give seconds"


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
    options: LabelOptions = field(default_factory=LabelOptions)


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
            where = spots(self._nameless, self.asked.options)
            self.note(f"{count(len(self._nameless), 'label')} without a name left out ({where})")
        kept = self.labels
        if len(set(kept)) < len(kept):
            twice = [label for label, times in Counter(kept).items() if times > 1]
            kept = list(dict.fromkeys(kept))
            again = len(self.labels) - len(kept)
            self.note(f"{count(again, 'label')} left out: there twice ({spots(twice, self.asked.options)})")
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


def whole(value: Any) -> int | None:
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


def few(names: Iterable[object], options: LabelOptions) -> str:
    """The first names of a list, each short."""
    listed = [clipped(name, 40) or "(unnamed)" for name in names]
    return ", ".join(listed[: options.named]) + f" and {len(listed) - options.named} more" * (len(listed) > options.named)


def _number(value: Any) -> float:
    try:
        return float(value)
    except (ValueError, OverflowError):
        return math.nan
