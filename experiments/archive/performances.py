"""Another person's performance of an action: how many of the ten first hits are of the action that was asked.

    DYNTORCH_DATA=../shared/data python -m experiments.archive.performances

*UTKinect*, *Florence3D*: every clip asks an archive of the other people's clips; a hit counts for the clip that it lies in.
*Exercises*: the middle of every run of one exercise asks an archive of the other person's streams; a hit counts for the label at
its middle.  Everything archived is seen at azimuth 0, queries from 0 and from 90 degrees (cameras as in
:mod:`experiments.recognition.protocol`).  Clips that last less than the archive's shortest window, or more than ``--longest``, do
not ask.

P@k: share of the first k hits that are right.  AP: average precision of the stretches of one label in the order in which hits find
them, those never found being wrong.  *Archive* is :meth:`indexing.Archive.search` as it is; below, with one thing changed.
*Exhaustive* compares all windows of the same durations on a grid of .1 s exactly.  *DTW, windows*: the same with dynamic time
warping (aeon) of normalized poses, every .2 s; *DTW, clips*: whole clips with whole clips, told where actions begin and end.
"""

from __future__ import annotations

import contextlib
import dataclasses
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from unittest import mock

import numpy as np

from experiments.archive.exhaustive import STEP, Measure, exact, hits, metric_of, rankings, warped
from experiments.common.runner import BaseConfig, Grid, Tables, experiment
from experiments.common.tables import Row, note
from experiments.recognition import protocol
from experiments.recognition.baselines import WarpedNearest
from experiments.recognition.protocol import Array
from indexing import Archive, ArchiveOptions, Clip, ClipSet
from indexing.archive import search
from indexing.archive.search import Hit

SETS = Literal["utkinect", "florence3d", "exercises"]
TURNS = (0, 90)
COLUMNS = ("P@5", "P@10", "AP")
FILES = {"utkinect": "utkinect", "florence3d": "florence3d", "exercises": "mocap6_exercises"}
FEW, MANY = 10, 100  # hits per query: what somebody looks at, and as good as all of them
DTW_STEP = 0.2  # seconds between windows
WITHIN = 0.01  # of exhaustive
ARCHIVE, EXHAUSTIVE, WARPED, CLIPS = "archive", "exhaustive", "DTW, windows", "DTW, clips"
# what a search is with one thing changed
CHANGED: dict[str, dict[str, Any]] = {
    "archive, the query's tempo only": {"TEMPOS": (1.0,)},
    "archive, five tempi": {"TEMPOS": (0.64, 0.8, 1.0, 1.25, 1.56)},
    "archive, scanned in 16 steps": {"NUM_SAMPLES": 16},
    "archive, refined in 4 steps": {"NUM_FINE_SAMPLES": 4},
    "archive, candidates farther apart": {"MIN_SEPARATION": 0.35},
    "archive, nothing refined": {"SHIFTS": (0.0,)},
    "archive, 30 candidates": {"num_candidates": 30},
    "archive, 100 candidates": {"num_candidates": 100},
    "archive, 300 candidates": {"num_candidates": 300},
}


@dataclass(frozen=True)
class Stretch:
    """What is known of a part of a recording: its label, and seconds."""

    label: object
    start: float
    end: float


@dataclass(frozen=True)
class Known:
    """A recording in one view, and its stretches."""

    clip: Clip
    stretches: tuple[Stretch, ...]

    def at(self, moment: float) -> int | None:
        """The stretch that a moment lies in."""
        return next((i for i, one in enumerate(self.stretches) if one.start <= moment <= one.end), None)


@dataclass(frozen=True)
class Query:
    """What is asked: the same performance from every azimuth, and its label."""

    views: dict[int, Clip]
    label: object


@dataclass(frozen=True)
class Task:
    """An archive of some people, and what another person asks of it."""

    archived: tuple[Known, ...]
    queries: tuple[Query, ...]


@dataclass(frozen=True)
class Config(BaseConfig):
    """Other people's performances, found in an archive: recordings of the folder DYNTORCH_DATA."""

    sets: tuple[SETS, ...] = ("utkinect", "florence3d", "exercises")
    """Which recordings."""
    changes: tuple[str, ...] = tuple(CHANGED)
    """Searches with one thing changed."""
    dtw: bool = True
    """Whether to measure dynamic time warping (minutes), too."""
    longest: float = 10.0
    """Seconds: longer clips do not ask."""
    middle: float = 1.5
    """Seconds of a run of exercises that ask."""
    most: int = 0
    """Queries per set at most, drawn at random; 0: all."""


# ---- who asks whom -----------------------------------------------------------------------------------------------------
def clip_tasks(name: str, longest: float, seed: int) -> Iterator[Task]:
    """One per person: the clips of the others, asked by this person's."""
    clips, shortest = protocol.load_set(name), ArchiveOptions().storage.min_duration
    seen = protocol.render(clips, seed, TURNS)
    known = [
        Known(clip, (Stretch(label, -np.inf, np.inf),)) for clip, label in zip(seen.exemplars, seen.labels.tolist(), strict=True)
    ]
    for others, mine in protocol.leave_one_subject_out(seen.subjects):
        asking = [i for i in mine if shortest <= clips[i].duration <= longest]
        queries = [Query({turn: seen.queries[turn][i] for turn in TURNS}, seen.labels[i].item()) for i in asking]
        yield Task(tuple(known[i] for i in others if clips[i].duration >= shortest), tuple(queries))


def exercise_tasks(middle: float, seed: int) -> Iterator[Task]:
    """One per person: the other's streams, asked by the middles of this person's runs."""
    exercises, rng = protocol.load_exercises(), np.random.default_rng(seed)
    known, asked = [], []
    for one in exercises:
        views = {turn: protocol.query_view(one.clip, turn, rng) for turn in TURNS}
        spans = protocol.runs(one.labels)
        step = protocol.RATIO / 30.0
        stretches = tuple(Stretch(int(one.labels[a]), a * step, b * step) for a, b in spans)
        known.append(Known(protocol.exemplar_view(one.clip, rng), stretches))
        asked.append([Query({turn: _middle(clip, part, middle) for turn, clip in views.items()}, part.label) for part in stretches])
    for others, mine in protocol.leave_one_subject_out(np.array([one.subject for one in exercises])):
        yield Task(tuple(known[i] for i in others), tuple(query for i in mine for query in asked[i]))


def _middle(clip: Clip, part: Stretch, seconds: float) -> Clip:
    half = min(seconds, part.end - part.start) / 2
    middle = (part.start + part.end) / 2
    return clip.between(middle - half, middle + half)


def tasks_of(name: SETS, config: Config) -> list[Task]:
    """The tasks of one set, with as many queries as are asked for; whose label nobody archived shows, does not ask."""
    exercises = name == "exercises"
    tasks = exercise_tasks(config.middle, config.seed) if exercises else clip_tasks(name, config.longest, config.seed)
    kept = []
    for task in tasks:
        there = {part.label for one in task.archived for part in one.stretches}
        kept.append(dataclasses.replace(task, queries=tuple(query for query in task.queries if query.label in there)))
    if not config.most:
        return kept
    rng, share = np.random.default_rng(config.seed), config.most / max(1, sum(len(task.queries) for task in kept))
    few = [rng.permutation(len(task.queries))[: max(1, round(share * len(task.queries)))] for task in kept]
    return [dataclasses.replace(task, queries=tuple(task.queries[i] for i in some)) for task, some in zip(kept, few, strict=True)]


Answer = tuple[list[Hit], list[Hit]]
"""The first FEW hits of one query, and the first MANY; a search that is asked for more looks at more."""
Way = Callable[[Task, Archive, int], list[Answer]]
"""From a task, its archive and an azimuth to what every query finds."""


# ---- what is right -----------------------------------------------------------------------------------------------------
def figures(answer: Answer, label: object, archived: dict[str, Known]) -> list[float]:
    """P@5, P@10 and AP of the hits of one query.

    Args:
        archived: recordings by name.
    """
    few, many = ([(hit.source, archived[hit.source].at((hit.start + hit.end) / 2)) for hit in hits] for hits in answer)

    def right(where: tuple[str, int | None]) -> bool:
        source, at = where
        return at is not None and archived[source].stretches[at].label == label

    first = [one for one in dict.fromkeys(many) if one[1] is not None]
    total = sum(part.label == label for one in archived.values() for part in one.stretches)
    precisions = [sum(map(right, few[:k])) / k for k in (5, 10)]
    return [*precisions, average_precision([right(one) for one in first], total)]


def average_precision(right: Sequence[bool], total: int) -> float:
    """Mean over all that is right of the precision where it is found, 0 for what is not.

    Example:
        >>> average_precision([True, False, True], 4)
        0.4166666666666667
    """
    found = np.flatnonzero(right)
    return float(((np.arange(len(found)) + 1) / (found + 1)).sum() / max(1, total))


# ---- ways to ask -------------------------------------------------------------------------------------------------------
def searching(changes: dict[str, Any], mirror: bool = False) -> Way:
    """By the archive, with other options and constants of its search."""

    def ask(task: Task, archive: Archive, turn: int) -> list[Answer]:
        views = [query.views[turn] for query in task.queries]
        options = {name: value for name, value in changes.items() if name.islower()}
        other = Archive(archive.path, dataclasses.replace(archive.options, **options))
        with contextlib.ExitStack() as stack:
            for constant, value in changes.items():
                if constant not in options:
                    stack.enter_context(mock.patch.object(search, constant, value))
            return [(other.search(view, FEW, mirror=mirror), other.search(view, MANY, mirror=mirror)) for view in views]

    return ask


def comparing(make: Callable[[Archive], Measure], step: float) -> Way:
    """With all windows, of the durations that the archive tries."""

    def ask(task: Task, archive: Archive, turn: int) -> list[Answer]:
        measure, answers = {"": make(archive)}, []
        clips = [one.clip for one in task.archived]
        for query in task.queries:
            asked = query.views[turn]
            (found,) = rankings([asked], clips, asked.duration, measure, step=step)[""]
            best = hits(found, clips, MANY)
            answers.append((best[:FEW], best))
        return answers

    return ask


def by_exact(archive: Archive) -> Measure:
    """The residual of the archive's last stage."""
    return exact(metric_of(archive))


def whole_clips(task: Task, archive: Archive, turn: int) -> list[Answer]:
    """Dynamic time warping of whole clips, or of whole stretches."""
    parts = [
        (one.clip.name, one.clip if np.isinf(part.start) else one.clip.between(part.start, part.end))
        for one in task.archived
        for part in one.stretches
    ]
    method = WarpedNearest().fit([clip for _, clip in parts], np.zeros(len(parts)))
    answers = []
    for row in method.distances([query.views[turn] for query in task.queries]):
        some = [(parts[i], -float(row[i])) for i in np.argsort(row, kind="stable")[:MANY]]
        best = [Hit(name, "", float(clip.times[0]), float(clip.times[-1]), score) for (name, clip), score in some]
        answers.append((best[:FEW], best))
    return answers


def measured(way: Way, tasks: Sequence[Task], archives: Sequence[Archive], turn: int) -> Array:
    """``(queries, 3)`` figures."""
    rows = []
    for task, archive in zip(tasks, archives, strict=True):
        archived = {one.clip.name: one for one in task.archived}
        answers = way(task, archive, turn)
        rows += [figures(answer, query.label, archived) for answer, query in zip(answers, task.queries, strict=True)]
    return np.array(rows)


# ---- tables ------------------------------------------------------------------------------------------------------------
def both_views(name: SETS, config: Config) -> Tables:
    """Both views of one set."""
    tasks = tasks_of(name, config)
    asked, archived = sum(len(task.queries) for task in tasks), np.mean([len(task.archived) for task in tasks])
    note(f"... {name}: {asked} queries, {archived:.0f} recordings in an archive")
    with tempfile.TemporaryDirectory() as folder:
        archives = [Archive(Path(folder) / f"{i}.archive") for i in range(len(tasks))]
        for task, archive in zip(tasks, archives, strict=True):
            archive.add(ClipSet(one.clip for one in task.archived))
        ways: dict[str, Way] = {ARCHIVE: searching({})}
        ways |= {change: searching(CHANGED[change]) for change in config.changes}
        ways |= {"archive, mirror images, too": searching({}, mirror=True)} if config.changes else {}
        ways[EXHAUSTIVE] = comparing(by_exact, STEP)
        if config.dtw:
            ways |= {WARPED: comparing(lambda _: warped(), DTW_STEP), CLIPS: whole_clips}
        for turn in TURNS:
            lines = {}
            for title, way in ways.items():
                note(f"... {name}, {turn} degrees, {title}")
                lines[title] = measured(way, tasks, archives, turn).mean(axis=0).tolist()
            ten = {title: line[COLUMNS.index("P@10")] for title, line in lines.items()}
            rows = [Row(f"{name}, {turn}°", "P@10, exhaustive within .01", ten[ARCHIVE], ten[EXHAUSTIVE] - WITHIN)]
            if config.dtw:
                goal = max(ten[WARPED], ten[CLIPS]) if turn else None
                rows.append(Row(f"{name}, {turn}°", "P@10, above DTW", ten[ARCHIVE], goal))
            yield f"{name}, asked from {turn} degrees, {asked} queries", Grid(COLUMNS, lines, rows)


@experiment(Config(), quick={"sets": ("florence3d",), "changes": (), "dtw": False, "most": 4})
def tables(config: Config) -> Tables:
    """Other people's performances, found in an archive.

    Raises:
        ValueError: no data folder, a change that is not known, or aeon is not installed though it is asked for.
    """
    strange = [change for change in config.changes if change not in CHANGED]
    if strange:
        raise ValueError(f"changes: {strange[0]!r} is none of {', '.join(CHANGED)}")
    if config.dtw:
        warped()
    for name in config.sets:
        yield from both_views(name, config)
