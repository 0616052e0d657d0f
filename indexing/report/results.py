"""What a recognition report is made of.  Plain data: nothing here draws, writes or learns."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from indexing.clip import Clip

Truth = tuple[Hashable, float, float]


class Event(Protocol):
    """An action found in a recording; any object with these attributes will do (``exemplar`` may be absent or ``None``)."""

    @property
    def label(self) -> Hashable: ...
    @property
    def start(self) -> float: ...  # seconds
    @property
    def end(self) -> float: ...  # seconds
    @property
    def score(self) -> float: ...  # higher is better
    @property
    def margin(self) -> float: ...  # score above the next-best class


@dataclass(frozen=True, eq=False)
class RecordingResult:
    """What was found in one recording.

    Args:
        name: usually the file's name.
        clip: the recording's joints, for the pictures; ``None`` where there are none (video).
        times: ``(F,)`` seconds, increasing.
        classes: ``C`` labels.
        scores: ``(F, C)`` higher is better; NaN = no score.
        events: what was found.
        truth: ``(label, start, end)`` of what is known to have happened; ``None`` = not known, ``[]`` = nothing happened.

    Raises:
        ValueError: shapes do not fit, or an interval ends before it starts.
    """

    name: str
    clip: Clip | None
    times: NDArray[np.floating[Any]]
    classes: Sequence[Hashable]
    scores: NDArray[np.floating[Any]]
    events: Sequence[Event] = ()
    truth: Sequence[Truth] | None = None

    def __post_init__(self) -> None:
        who = f"recording {self.name!r}"
        times, scores = np.asarray(self.times, dtype=np.float64), np.asarray(self.scores, dtype=np.float64)
        if times.ndim != 1 or not len(times) or not np.isfinite(times).all() or (np.diff(times) < 0).any():
            raise ValueError(f"{who}: times must be (frames,) increasing finite seconds, at least one, got shape {times.shape}")
        if scores.shape != (len(times), len(self.classes)):
            raise ValueError(f"{who}: scores must be (frames, classes) = ({len(times)}, {len(self.classes)}), got {scores.shape}")
        spans = [(event.label, event.start, event.end) for event in self.events] + list(self.truth or ())
        for label, start, end in spans:
            if not (np.isfinite(start) and np.isfinite(end) and start <= end):
                raise ValueError(f"{who}: {label!r} from {start} s to {end} s is no interval; give seconds, start first")
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "scores", scores)

    @property
    def duration(self) -> float:
        """Seconds from the first frame to the last."""
        return float(self.times[-1] - self.times[0])


@dataclass(frozen=True, eq=False)
class EvaluationResult:
    """Recognition of ``N`` clips in one setting.

    Args:
        classes: the labels that could be answered, in the order of the tables.
        truth: ``(N,)`` labels.
        predicted: ``(N,)`` labels; one that is not in ``classes`` (the none label, say) gets a row of its own.
        setting: what was measured, e.g. ``"azimuth 90"``.
        baseline: ``(N,)`` what a plain method answers, where one was asked for comparison.

    Raises:
        ValueError: ``truth``, ``predicted`` and ``baseline`` differ in length, or are empty.
    """

    classes: Sequence[Hashable]
    truth: Sequence[Hashable] | NDArray[Any]
    predicted: Sequence[Hashable] | NDArray[Any]
    setting: str = ""
    baseline: Sequence[Hashable] | NDArray[Any] | None = None

    def __post_init__(self) -> None:
        if len(self.truth) != len(self.predicted) or not len(self.truth):
            raise ValueError(
                f"evaluation {self.setting!r}: truth and predicted must hold one label per clip, at least one; "
                f"got {len(self.truth)} and {len(self.predicted)}"
            )
        if self.baseline is not None and len(self.baseline) != len(self.truth):
            raise ValueError(
                f"evaluation {self.setting!r}: baseline must hold one label per clip ({len(self.truth)}), got {len(self.baseline)}"
            )


@dataclass(frozen=True, eq=False)
class RecognitionReport:
    """Everything that a recognition report says; all parts but the title may be left out.

    Args:
        title: heading of the page.
        summary: one paragraph in plain words; by default one is written from the numbers.
        recordings: streams that were searched.
        evaluations: measured recognition, one per setting.
        exemplars: label -> the clip it was learned from, or a list of them, of which an event's ``exemplar`` names one.
        metrics: further numbers for metrics.json; those at its top level are shown as cards.
        baseline: name of the method behind the evaluations' ``baseline``, and how it works in a few words.
        notes: what a reader must know to judge the numbers, a sentence each.
        manifest: of :func:`indexing.files.manifest`.
    """

    title: str
    summary: str = ""
    recordings: Sequence[RecordingResult] = ()
    evaluations: Sequence[EvaluationResult] = ()
    exemplars: Mapping[Hashable, Clip | Sequence[Clip]] = field(default_factory=dict)
    metrics: Mapping[str, Any] = field(default_factory=dict)
    baseline: tuple[str, str] = ("Baseline", "")
    notes: Sequence[str] = ()
    manifest: Mapping[str, Any] = field(default_factory=dict)

    def exemplar(self, event: Event) -> Clip | None:
        """The clip that an event is shown beside."""
        known = self.exemplars.get(event.label)
        if known is None or isinstance(known, Clip):
            return known
        index = getattr(event, "exemplar", None)
        return (known[index] if index is not None and 0 <= index < len(known) else known[0]) if len(known) else None
