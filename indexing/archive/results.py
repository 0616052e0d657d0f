"""What an archive answers: hits, events, and what became of sources, as data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from indexing.scoring import Event

Outcome = Literal["added", "replaced", "known", "failed", "left out"]


@dataclass(frozen=True)
class Hit:
    """A stretch of a recording that resembles a query.

    source: the recording's name (its file, or what the clip was called); person: who, empty where only one is in view; start, end:
    seconds on the recording's own clock; score: minus the logarithm of the fused residual, higher is better; mirrored: whether it
    is the query's mirror image that resembles it.
    """

    source: str
    person: str
    start: float
    end: float
    score: float
    mirrored: bool = False


@dataclass(frozen=True)
class ArchivedEvent(Event):
    """An event of a learned action, and where it is: the recording's name, and the person, empty where only one is in view."""

    source: str = ""
    person: str = ""


@dataclass(frozen=True)
class SourceOutcome:
    """What became of one source that was to be added."""

    source: str
    outcome: Outcome
    reason: str = ""
    windows: int = 0
    seconds: float = 0.0


@dataclass(frozen=True)
class Addition:
    """What :meth:`indexing.Archive.add` did, source by source, in the order given."""

    sources: tuple[SourceOutcome, ...]

    def of(self, outcome: Outcome) -> tuple[SourceOutcome, ...]:
        """The sources that met this outcome."""
        return tuple(one for one in self.sources if one.outcome == outcome)

    @property
    def failed(self) -> tuple[SourceOutcome, ...]:
        """Sources that could not be read, with their reasons."""
        return self.of("failed")

    @property
    def windows(self) -> int:
        """Windows that are new."""
        return sum(one.windows for one in self.sources if one.outcome in ("added", "replaced"))

    @property
    def seconds(self) -> float:
        """Seconds of recordings that are new, every person counted."""
        return sum(one.seconds for one in self.sources if one.outcome in ("added", "replaced"))


@dataclass(frozen=True)
class ArchivedRecording:
    """One person of a recording in an archive."""

    source: str
    path: str
    person: str
    start: float
    end: float
    seconds: float
    layout: str


@dataclass(frozen=True)
class ArchiveInfo:
    """What is in an archive."""

    sources: int
    recordings: int
    windows: int
    seconds: float
    segments: int
    dead: int
    size: int
    layouts: tuple[tuple[str, int, float], ...]
    version: int


@dataclass(frozen=True)
class Verification:
    """What :meth:`indexing.Archive.verify` found: one line for each problem, none where all is well."""

    windows: int
    segments: int
    problems: tuple[str, ...] = ()
    orphans: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether every window of the catalogue is there, whole, and once."""
        return not self.problems
