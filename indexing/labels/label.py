"""A label, and a file of them: what every format is read into, and written from."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

from indexing.opening import clip_text, count

MAX_OVERHANG_SECONDS = 0.1
"""That a label may reach beyond its recording without a word: players stop some frames before or after the last one."""
NUM_NAMED = 3  # examples that a notice names


@dataclass(frozen=True, slots=True, repr=False)
class Label:
    """What somebody marked in a recording, or what was found there.

    Args:
        start, end: seconds on the clock of the recording, 0 at its first frame; equal where a moment was marked (:attr:`point`).
        label: the action.
        subject: who does it; empty where nobody said.
        media: the file that it is of, as the label file names it; empty where it names none.
        tier: the tier (ELAN), the attribute (VIA), or whatever else keeps labels of one file apart; empty where nothing does.
        observation: the observation (BORIS), the annotator (Label Studio), or whoever else it was; empty where nobody said.
        comment: free text.
        modifiers: of the action (BORIS).
        score: how sure a program was; None for what a person marked.

    Raises:
        ValueError: a time is no finite number, or it ends before it starts.

    Example:
        >>> Label(1.5, 4.0, "squat", "Ann"), Label(2.0, 2.0, "clap").point
        (Label(1.5, 4.0, 'squat', subject='Ann'), True)
    """

    start: float
    end: float
    label: str
    subject: str = ""
    media: str = ""
    tier: str = ""
    observation: str = ""
    comment: str = ""
    modifiers: tuple[str, ...] = ()
    score: float | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.start) and math.isfinite(self.end)):
            raise ValueError(f"label {clip_text(self.label)!r}: start={self.start}, end={self.end}; give finite seconds")
        if self.end < self.start:
            message = f"ends at {self.end:g} s, but starts at {self.start:g} s"
            raise ValueError(f"label {clip_text(self.label)!r}: {message}; give start first")

    @property
    def point(self) -> bool:
        """Whether it marks a moment rather than a stretch of time."""
        return self.start == self.end

    @property
    def duration(self) -> float:
        """Seconds."""
        return self.end - self.start

    def __repr__(self) -> str:
        message = [f"{self.start!r}, {self.end!r}, {self.label!r}"]
        for name in ("subject", "media", "tier", "observation", "comment", "modifiers", "score"):
            value: Any = getattr(self, name)
            if value not in ("", (), None):
                message.append(f"{name}={value!r}")
        return f"Label({', '.join(message)})"


def sort_key(label: Label) -> tuple[float, float, str, str, str]:
    """By which labels are sorted."""
    return label.start, label.end, label.label, label.subject, label.tier


@dataclass(frozen=True)
class LabelFile:
    """A file of labels, with what a person should know of it.

    Args:
        path: the file.
        format: the name of a file in ``indexing/labels/formats``.
        labels: sorted by start; times on the clock of the medium that each is of.
        observations, tiers, subjects, media: all names that the file has, also those without labels, in its order.
        machine: of the observations and tiers, those that a program wrote: found, and confirmed by nobody.
        watched: observation or tier, and a medium that it is of, also where nothing is marked there.
        notices: what was left out, dropped or assumed, a sentence each.
    """

    path: Path
    format: str
    labels: tuple[Label, ...]
    observations: tuple[str, ...] = ()
    tiers: tuple[str, ...] = ()
    subjects: tuple[str, ...] = ()
    media: tuple[str, ...] = ()
    machine: tuple[str, ...] = ()
    watched: tuple[tuple[str, str], ...] = ()
    notices: tuple[str, ...] = field(default=(), repr=False)


def within(labels: Iterable[Label], begin: float, end: float, name: str = "the recording") -> tuple[list[Label], list[str]]:
    """The labels of a recording that lie in it, cut where it begins and ends, and what was left out or cut.

    Args:
        begin, end: times of the first and the last frame, in seconds.
        name: of the recording, for the notices.

    Example:
        >>> kept, notices = within([Label(1, 3, "squat"), Label(9, 12, "squat"), Label(70, 71, "squat")], 0, 10, "a.json")
        >>> kept
        [Label(1, 3, 'squat'), Label(9, 10, 'squat')]
        >>> notices[0]
        '1 label left out: outside a.json, which runs from 0 to 10 s (squat at 70-71 s)'
        >>> notices[1]
        '1 label cut: a.json runs from 0 to 10 s (squat at 9-12 s)'
    """
    kept: list[Label] = []
    outside: list[Label] = []
    cut: list[Label] = []
    for label in labels:
        if label.end < begin - MAX_OVERHANG_SECONDS or label.start > end + MAX_OVERHANG_SECONDS:
            outside.append(label)
            continue
        inside = replace(label, start=min(max(label.start, begin), end), end=max(min(label.end, end), begin))
        if inside.point and not label.point:  # all of it lies in the slack
            outside.append(label)
            continue
        kept.append(inside)
        if label.start < begin - MAX_OVERHANG_SECONDS or label.end > end + MAX_OVERHANG_SECONDS:
            cut.append(label)
    runs = f"runs from {begin:.6g} to {end:.6g} s"
    notices = []
    if outside:
        notices.append(f"{count(len(outside), 'label')} left out: outside {name}, which {runs} ({list_spots(outside)})")
    if cut:
        notices.append(f"{count(len(cut), 'label')} cut: {name} {runs} ({list_spots(cut)})")
    return kept, notices


def list_spots(labels: Iterable[Label]) -> str:
    """The first of some labels, for a notice."""
    spots = [describe_spot(label) for label in islice(labels, NUM_NAMED + 1)]
    return ", ".join(spots[:NUM_NAMED]) + ", ..." * (len(spots) > NUM_NAMED)


def describe_spot(label: Label) -> str:
    """A label for a notice, short."""
    when = f"{label.start:.6g}" if label.point else f"{label.start:.6g}-{label.end:.6g}"
    return f"{clip_text(label.label, 24) or '(no name)'} at {when} s"
