"""What a recognition report is made of.  Plain data: nothing here draws, writes or learns."""

from __future__ import annotations

import math
import numbers
import warnings
from collections import Counter
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from indexing.clip import Clip
from indexing.opening import count
from indexing.report.page import table_csv

if TYPE_CHECKING:
    from indexing.recordings.decoding import Withheld
    from indexing.recordings.repetitions import RepetitionCount

Truth = tuple[Hashable, float, float]
MIN_OVERLAP = 0.5  # of the time of a reported and a known action, from which the first is right


class ReportedEvent(Protocol):
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
    """What was found in one recording, or of one person in a recording of several.

    Args:
        name: usually the file's name; results of one name with a ``person`` are of one recording.
        clip: the recording's joints, for the pictures; ``None`` where there are none (video).
        times: ``(F,)`` seconds, increasing.
        classes: ``C`` labels.
        scores: ``(F, C)`` higher is better; NaN = no score.
        events: what was found.
        truth: ``(label, start, end)`` of what is known to have happened; ``None`` = not known, ``[]`` = nothing happened.
        person: who of several; empty where one is alone.
        withheld: what looked like an action and was not reported, and why.
        repetitions: how often each action was performed; ``None`` = not counted.

    Raises:
        ValueError: shapes do not fit, or an interval ends before it starts.
    """

    name: str
    clip: Clip | None
    times: NDArray[np.floating[Any]]
    classes: Sequence[Hashable]
    scores: NDArray[np.floating[Any]]
    events: Sequence[ReportedEvent] = ()
    truth: Sequence[Truth] | None = None
    person: str = ""
    withheld: Sequence[Withheld] = ()
    repetitions: Sequence[RepetitionCount] | None = None

    def __post_init__(self) -> None:
        who = f"recording {self.name!r}" + f", person {self.person}" * bool(self.person)
        times, scores = np.asarray(self.times, dtype=np.float64), np.asarray(self.scores, dtype=np.float64)
        if times.ndim != 1 or not len(times) or not np.isfinite(times).all() or (np.diff(times) < 0).any():
            raise ValueError(f"{who}: times must be (frames,) increasing finite seconds, at least one, got shape {times.shape}")
        if scores.shape != (len(times), len(self.classes)):
            raise ValueError(f"{who}: scores must be (frames, classes) = ({len(times)}, {len(self.classes)}), got {scores.shape}")
        events = [*self.events, *(one.event for one in self.withheld)]
        spans = [(event.label, event.start, event.end) for event in events] + list(self.truth or ())
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
        timings: seconds of each step.
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
    timings: Mapping[str, float] = field(default_factory=dict)
    manifest: Mapping[str, Any] = field(default_factory=dict)

    def exemplar(self, event: ReportedEvent) -> Clip | None:
        """The clip that an event is shown beside."""
        known = self.exemplars.get(event.label)
        if known is None or isinstance(known, Clip):
            return known
        index = getattr(event, "exemplar", None)
        return (known[index] if index is not None and 0 <= index < len(known) else known[0]) if len(known) else None


# ----------------------------------------------------------------------------------------------------------------------
# The numbers of a recognition report, from labels and intervals; scikit-learn does the arithmetic of recognition.


def measure(report: RecognitionReport) -> dict[str, Any]:
    """All numbers of a report, in JSON types (NaN where a number does not exist)."""
    out = dict(report.metrics)
    if report.notes:
        out["notes"] = list(report.notes)
    if report.evaluations:
        out.update(recognition(report.evaluations))
        plain = _baseline(report)
        if plain:
            out["baseline"] = plain
    if report.recordings:
        out.update(_search(report.recordings))
    return out


def recognition(evaluations: Sequence[EvaluationResult]) -> dict[str, Any]:
    """Accuracy per setting and over all clips, and precision, recall, F1 per class over all clips."""
    from sklearn.metrics import accuracy_score, confusion_matrix, f1_score, precision_recall_fscore_support

    settings: dict[str, list[tuple[str, str]]] = {}
    names: dict[str, None] = dict.fromkeys(str(name) for evaluation in evaluations for name in evaluation.classes)
    for evaluation in evaluations:
        pairs = [(str(true), str(guess)) for true, guess in zip(evaluation.truth, evaluation.predicted, strict=True)]
        settings.setdefault(evaluation.setting, []).extend(pairs)
        names.update(dict.fromkeys(sorted({label for pair in pairs for label in pair} - set(names))))
    labels = list(names)
    true, guess = (list(column) for column in zip(*(pair for pairs in settings.values() for pair in pairs), strict=True))
    precision, recall, f1, support = precision_recall_fscore_support(true, guess, labels=labels, zero_division=np.nan)
    performed = [name for name in labels if name in set(true)]
    accuracy = float(accuracy_score(true, guess))
    with warnings.catch_warnings():  # that there is just one class is no mistake
        warnings.filterwarnings("ignore", message="A single label was found")
        counts = confusion_matrix(true, guess, labels=labels)
    return {
        "clips": len(true),
        "accuracy": accuracy,
        "accuracy_interval": wilson(accuracy, len(true)),
        # Over the actions that were performed: a class without a clip has no recall to average.
        "macro_f1": float(f1_score(true, guess, labels=performed, average="macro", zero_division=0)),
        "accuracy_by_setting": {
            name: float(accuracy_score(*(list(column) for column in zip(*pairs, strict=True)))) for name, pairs in settings.items()
        },
        "clips_by_setting": {name: len(pairs) for name, pairs in settings.items()},
        "per_class": {
            name: {"precision": float(p), "recall": float(r), "f1": float(f), "clips": int(n)}
            for name, p, r, f, n in zip(labels, precision, recall, f1, support, strict=True)
        },
        "confusion": {"labels": labels, "counts": counts.tolist()},
    }


def _baseline(report: RecognitionReport) -> dict[str, Any]:
    """Name, accuracy and accuracy per setting of the plain method that the evaluations were compared with; empty without one."""
    right: dict[str, list[bool]] = {}
    for evaluation in report.evaluations:
        if evaluation.baseline is not None:
            pairs = zip(evaluation.truth, evaluation.baseline, strict=True)
            right.setdefault(evaluation.setting, []).extend(str(true) == str(guess) for true, guess in pairs)
    if not right:
        return {}
    together = [value for values in right.values() for value in values]
    by_setting = {name: float(np.mean(values)) for name, values in right.items()}
    return {"name": report.baseline[0], "accuracy": float(np.mean(together)), "accuracy_by_setting": by_setting}


def wilson(share: float, number: int) -> tuple[float, float]:
    """95 % interval of a proportion (Wilson's; it also holds near 0 and 1, where the usual one is empty)."""
    z = 1.959964
    middle = (share + z * z / (2 * number)) / (1 + z * z / number)
    half = z / (1 + z * z / number) * math.sqrt(share * (1 - share) / number + z * z / (4 * number * number))
    return max(0.0, middle - half), min(1.0, middle + half)


def overlapping(event: ReportedEvent, truth: Sequence[Truth]) -> str | None:
    """The known action that shares most time with an event; of equals, the one with the event's own label.  None = no one."""
    own = str(event.label)
    shared = [(min(event.end, end) - max(event.start, start), str(label) == own, str(label)) for label, start, end in truth]
    best = max(shared, default=None)
    return best[2] if best is not None and best[0] > 0 else None


def missed_actions(recording: RecordingResult) -> list[Truth]:
    """Known actions that no event of the same label overlaps."""
    by_label: dict[str, list[ReportedEvent]] = {}
    for event in recording.events:
        by_label.setdefault(str(event.label), []).append(event)
    return [
        (label, start, end)
        for label, start, end in recording.truth or ()
        if not any(event.start < end and event.end > start for event in by_label.get(str(label), ()))
    ]


def frame_accuracy(recording: RecordingResult) -> float:
    """Share of the frames inside known actions whose best-scoring action is the known one; NaN without such frames."""
    known = _known_frames(recording)
    inside = known != ""
    names = np.array([str(name) for name in recording.classes], dtype=object)
    best = names[np.nan_to_num(recording.scores, nan=-np.inf).argmax(axis=1)]
    return float((best[inside] == known[inside]).mean()) if inside.any() else math.nan


def frame_agreement(recording: RecordingResult) -> float:
    """Share of all frames for which the reported events say what is known: the same action, or none."""
    reported = np.full(len(recording.times), "", dtype=object)
    for event in recording.events:
        reported[(recording.times >= event.start) & (recording.times <= event.end)] = str(event.label)
    return float((reported == _known_frames(recording)).mean())


def _known_frames(recording: RecordingResult) -> Any:
    """``(F,)`` the known action of each frame; empty text where none is known."""
    known = np.full(len(recording.times), "", dtype=object)
    for label, start, end in recording.truth or ():
        known[(recording.times >= start) & (recording.times <= end)] = str(label)
    return known


def confused_with(confusion: Mapping[str, Any], label: str) -> tuple[str, int] | None:
    """What a class is most often mistaken for, and how often."""
    labels, counts = confusion["labels"], confusion["counts"]
    row = Counter({name: count for name, count in zip(labels, counts[labels.index(label)], strict=True) if name != label and count})
    return row.most_common(1)[0] if row else None


def count_matches(recording: RecordingResult) -> int:
    r"""How many events are right: each of a known action of its own, of the same name, with which it shares enough of the time,"""
    pairs = []
    for i, event in enumerate(recording.events):
        for j, (label, start, end) in enumerate(recording.truth or ()):
            shared = min(event.end, end) - max(event.start, start)
            if str(label) == str(event.label) and shared > 0:
                pairs.append((shared / (max(event.end, end) - min(event.start, start)), i, j))
    used: set[tuple[str, int]] = set()
    for share, i, j in sorted(pairs, reverse=True):
        if share >= MIN_OVERLAP and not {("event", i), ("known", j)} & used:
            used |= {("event", i), ("known", j)}
    return len(used) // 2


def by_recording(recordings: Sequence[RecordingResult]) -> list[list[RecordingResult]]:
    """Results person by person, put together where they are of one recording."""
    out: list[list[RecordingResult]] = []
    for one in recordings:
        if out and one.person and out[-1][0].person and out[-1][0].name == one.name:
            out[-1].append(one)
        else:
            out.append([one])
    return out


def seconds(people: Sequence[RecordingResult]) -> float:
    """From the first frame of a recording, of whomever it shows, to the last."""
    return float(max(one.times[-1] for one in people) - min(one.times[0] for one in people))


def _search(recordings: Sequence[RecordingResult]) -> dict[str, Any]:
    events = Counter(str(event.label) for recording in recordings for event in recording.events)
    groups = by_recording(recordings)
    out: dict[str, Any] = {
        "recordings": len(groups),
        "people": sum(bool(recording.person) for recording in recordings),
        "seconds": float(sum(map(seconds, groups))),
        "events": sum(events.values()),
        "events_by_class": dict(events.most_common()),
        "withheld": dict(Counter(one.reason for recording in recordings for one in recording.withheld)),
    }
    counted = [recording.repetitions for recording in recordings if recording.repetitions is not None]
    if counted:
        numbers: Counter[str] = Counter()
        for counts in counted:
            numbers.update({str(one.label): one.count for one in counts})
        out["repetitions"] = dict(numbers)
    known = [recording for recording in recordings if recording.truth is not None]
    return out | (_against_known(known) if known else {})


def _against_known(known: Sequence[RecordingResult]) -> dict[str, Any]:
    """How what was reported compares with what is known, over the recordings of which something is."""
    reported, happened = sum(len(recording.events) for recording in known), sum(len(recording.truth or ()) for recording in known)
    right = sum(map(count_matches, known))
    inside = np.array([(_known_frames(recording) != "").sum() for recording in known], dtype=float)
    shares = np.array([frame_accuracy(recording) for recording in known])
    frames = [len(recording.times) for recording in known]
    return {
        "known_events": happened,
        "compared_events": reported,
        "false_events": sum(
            overlapping(event, recording.truth or ()) != str(event.label) for recording in known for event in recording.events
        ),
        "missed_events": sum(len(missed_actions(recording)) for recording in known),
        "right_events": right,
        "precision": right / reported if reported else math.nan,
        "recall": right / happened if happened else math.nan,
        "frame_accuracy": float(np.nansum(shares * inside) / inside.sum()) if inside.any() else math.nan,
        "frame_agreement": float(np.average([frame_agreement(recording) for recording in known], weights=frames)),
    }


# ----------------------------------------------------------------------------------------------------------------------
# Many performances in a few words: how often, how long and how far; and what was held back and why.


TIMES = 3  # of what was held back that are said of each action
COUNTS = ("action", "count ", "each (s) ", "from-to (s) ", "pause (s) ", "range ")
"""Headings of :func:`count_row`; those of numbers end in a space."""
MEANING = {
    "at rest": "it looks like the action, but the person hardly moves, compared with calm moments of the action",
    "nobody there": "the person is not in view for most of it",
    "below the level": "weaker than the level that was asked for (reject)",
    "other movement": "there is movement, but it resembles the action no more than ordinary movement does",
}
"""What the reasons mean for which something is not reported."""


def count_row(one: RepetitionCount) -> list[str]:
    """Of one action: how often, seconds of each (mean, shortest to longest), mean pause between, mean range."""
    if not one.count:
        return [str(one.label), "0", "", "", "", ""]
    shortest, longest = min(one.durations), max(one.durations)
    pause = f"{np.mean(one.pauses):.2f}" if one.pauses else ""
    number = count(one.count, "cycle") if one.unit == "cycle" else f"{one.count}"
    each, reach = f"{np.mean(one.durations):.2f}", f"{np.mean(one.ranges):.2f}"
    return [str(one.label), number, each, f"{shortest:.2f}-{longest:.2f}" if one.count > 1 else "", pause, reach]


def repetition_rows(one: RepetitionCount) -> list[list[str]]:
    """Of one action, for each performance: number, start, end, seconds, pause before (empty for the first), range."""
    pauses = ["", *(f"{pause:.3f}" for pause in one.pauses)]
    return [
        [f"{number}", f"{part.start:.3f}", f"{part.end:.3f}", f"{part.end - part.start:.3f}", pause, f"{part.range:.3f}"]
        for number, (part, pause) in enumerate(zip(one.performances, pauses, strict=True), 1)
    ]


def repetitions_csv(recordings: Sequence[RecordingResult]) -> str:
    """All performances as CSV, one a row; seconds and body heights with 3 decimals."""
    head = ["file", "person", "label", "unit", "number", "start", "end", "seconds", "pause_before", "range"]
    rows = [
        [*map(cell, (recording.name, recording.person, one.label)), one.unit, *row]
        for recording in recordings
        for one in recording.repetitions or ()
        for row in repetition_rows(one)
    ]
    return table_csv(head, rows)


def cell(value: object) -> str:
    """A name as a cell.  Spreadsheets run text that begins like a formula; an apostrophe keeps it text.  Numbers stay numbers."""
    text = str(value)
    is_number = isinstance(value, numbers.Number)
    return f"'{text}" if not is_number and text.lstrip(" ")[:1] in tuple("=+-@\t\r\n") else text


def held_back(recordings: Sequence[RecordingResult]) -> dict[str, dict[str, list[tuple[RecordingResult, float]]]]:
    """Reason -> label -> where and when: what was not reported; the most frequent first."""
    withheld: dict[str, dict[str, list[tuple[RecordingResult, float]]]] = {}
    for recording in recordings:
        for one in recording.withheld:
            withheld.setdefault(one.reason, {}).setdefault(str(one.event.label), []).append((recording, one.event.start))
    reasons = sorted(withheld, key=lambda reason: -sum(map(len, withheld[reason].values())))
    return {reason: dict(sorted(withheld[reason].items(), key=lambda item: -len(item[1]))) for reason in reasons}


def held_times(where: Sequence[tuple[RecordingResult, float]], recordings: Sequence[RecordingResult]) -> str:
    """The first few times, with the recording where there are several, and how many more there are."""
    several = len({one.name for one in recordings}) > 1
    times = []
    for recording, start in where[:TIMES]:
        who = f" of person {recording.person}" * bool(recording.person) + f" in {recording.name}" * several
        times.append(f"{start:.2f} s{who}")
    more = len(where) - TIMES
    return ", ".join(times) + f" and {more} more" * (more > 0)


def held_sentences(recordings: Sequence[RecordingResult]) -> list[str]:
    """What was held back, a sentence for each reason."""
    out = []
    for reason, labels in held_back(recordings).items():
        each = [f"{len(where)} {label} ({held_times(where, recordings)})" for label, where in list(labels.items())[:TIMES]]
        more = len(labels) - TIMES
        out.append(f"held back, {reason}: {'; '.join(each)}" + f"; and of {count(more, 'action')} more" * (more > 0))
    return out


def held_rows(recordings: Sequence[RecordingResult]) -> list[list[Any]]:
    """The same as a table: reason, action, number, when."""
    return [
        [reason, label, f"{len(where)}", held_times(where, recordings)]
        for reason, labels in held_back(recordings).items()
        for label, where in labels.items()
    ]
