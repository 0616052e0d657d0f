"""Learned actions found in an archive, beside the same model on the recordings themselves: what storing and skipping cost.

    DYNTORCH_DATA=../shared/data python -m experiments.archive.finding

Recordings and models are those of :mod:`experiments.recognition.detection`.  *All actions*: the model knows every action that is
performed, so that nearly all of a recording may hold one.  *Three actions*: it knows three of them, drawn anew for each fold, and
the others are what an archive is full of.  *And standing*: after every action the person stands three times as long as it took.

Columns: F1 of the events at half overlap against the truth, of ``ActionIndexer.find`` on the recordings at 30 frames per second,
of ``Archive.find`` that looks at everything, and of ``Archive.find`` as it is; the share of poses that the sketches skip;
and the share of the events of the first that the last has, too.
"""

from __future__ import annotations

import dataclasses
import tempfile
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import numpy as np

from experiments.common.runner import BaseConfig, Grid, Tables, experiment
from experiments.common.tables import note
from experiments.recognition.detection import SETS, Recording, Task, actor_tasks, exercise_tasks, joined_tasks
from experiments.recognition.detection_metrics import f1
from indexing import ActionIndexer, Archive
from indexing.archive import actions
from indexing.archive.actions import marked_rows, probes_of
from indexing.scoring import Event

COLUMNS = ("F1 recordings", "F1 all looked at", "F1 archive", "skipped", "kept")
KNOWN = 3  # actions of a model that knows few
STANDING = 3  # times as long as the action before
JITTER = 0.002  # of the image's extent: what a detector says of who stands


@dataclass(frozen=True)
class Config(BaseConfig):
    """Learned actions in an archive."""

    sets: tuple[SETS, ...] = ("utkinect, evenly", "exercises", "actors")
    """Which recordings."""
    turn: int = 0
    """Degrees that the camera is turned; the other side of each set where it is not 0."""
    folds: int = 5
    """Folds of each set at most."""


@dataclass
class Tally:
    """What was found in all recordings of a set, and how much was looked at."""

    truth: list[list[Event]] = dataclasses.field(default_factory=list)
    direct: list[list[Event]] = dataclasses.field(default_factory=list)
    whole: list[list[Event]] = dataclasses.field(default_factory=list)
    sketched: list[list[Event]] = dataclasses.field(default_factory=list)
    rows: list[tuple[int, int]] = dataclasses.field(default_factory=list)  # looked at, of all

    def line(self) -> list[float]:
        """In the order of COLUMNS."""
        looked, total = np.sum(self.rows, axis=0).tolist()
        kept = [alike(one, mine) for one_of, mine in zip(self.direct, self.sketched, strict=True) for one in one_of]
        scores = [f1(found, self.truth) for found in (self.direct, self.whole, self.sketched)]
        return [*scores, 1.0 - looked / max(1, total), float(np.mean(kept)) if kept else 1.0]


def alike(one: Event, others: Sequence[Event]) -> bool:
    """Whether one of the others has its name and half of its time."""
    return any(
        one.label == other.label
        and min(one.end, other.end) - max(one.start, other.start) > 0.5 * (max(one.end, other.end) - min(one.start, other.start))
        for other in others
    )


def tasks_of(name: SETS, seed: int, folds: int) -> list[Task]:
    """The tasks of one set."""
    if name == "exercises":
        return exercise_tasks(seed)[:folds]
    if name == "actors":
        return actor_tasks(4, 8, seed)
    return joined_tasks(name.split(",")[0], name.endswith("evenly"), 20.0, seed)[:folds]


def with_standing(recording: Recording, rng: np.random.Generator) -> Recording:
    """The person stands after every action, as still as a detector lets anybody stand."""
    clip, truth, parts, clocks, late = recording.clip, [], [], [], 0.0
    extent = float(np.nanmax(np.ptp(np.nan_to_num(clip.joints), axis=1)))
    for one in recording.truth:
        mine = np.flatnonzero((clip.times >= one.start) & (clip.times < one.end))
        if len(mine) < 2:
            continue
        pose, step = clip.joints[mine[-1]], float(np.median(np.diff(clip.times[mine])))
        still = pose + rng.normal(scale=JITTER * extent, size=(STANDING * len(mine), *pose.shape))
        parts += [clip.joints[mine], still]
        begin = late + step
        clocks += [begin + np.arange((1 + STANDING) * len(mine)) * step]
        truth.append(Event(one.label, begin, begin + len(mine) * step, 0.0, 0.0))
        late = float(clocks[-1][-1])
    times = np.concatenate(clocks)
    whole = clip.replace(joints=np.concatenate(parts), times=times, fps=None, confidence=None)
    return Recording(whole, truth, times, np.full(len(times), ""))


def ask(indexer: ActionIndexer, recordings: Sequence[Recording], tally: Tally) -> None:
    """Everything that is asked of one model."""
    known = set(indexer.classes_.tolist())
    with tempfile.TemporaryDirectory() as folder:
        archive = Archive(Path(folder) / "archive")
        clips = [one.clip.replace(name=f"recording {i}") for i, one in enumerate(recordings)]
        archive.add(clips)
        with mock.patch.multiple(actions, MIN_CORRELATION=-1.0, MIN_MOTION_SHARE=0.0):
            whole = archive.find(indexer)
        sketched = archive.find(indexer)
        tally.rows.append(looked_at(archive, indexer))
    for one, clip in zip(recordings, clips, strict=True):
        tally.truth.append([event for event in one.truth if event.label in known])
        tally.direct.append(list(indexer.find(clip)))
        tally.whole.append([event for event in whole if event.source == clip.name])
        tally.sketched.append([event for event in sketched if event.source == clip.name])


def looked_at(archive: Archive, indexer: ActionIndexer) -> tuple[int, int]:
    """Poses that the sketches leave, and all."""
    snapshot = archive._open_snapshot()
    probes = probes_of(snapshot, indexer)
    looked = total = 0
    for row, segment in zip(snapshot.contents.segments, snapshot.segments, strict=True):
        for track in range(len(segment)):
            mask = marked_rows(segment.only(track), probes[row.layout])
            looked, total = looked + int(mask.sum()), total + len(mask)
    return looked, total


@experiment(Config(), quick={"sets": ("actors",), "folds": 1})
def tables(config: Config) -> Tables:
    """Learned actions in an archive."""
    rng = np.random.default_rng(config.seed)
    lines: dict[str, list[float]] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        for name in config.sets:
            tallies = {kind: Tally() for kind in ("all actions", "three actions", "three actions, and standing")}
            for number, task in enumerate(tasks_of(name, config.seed, config.folds)):
                note(f"... {name}, fold {number + 1}")
                turns = list(task.asked)
                asked = task.asked[turns[0] if config.turn == 0 else turns[1]]
                drawn = rng.choice(np.unique(task.labels), KNOWN, replace=False)
                mine = np.flatnonzero(np.isin(task.labels, drawn))
                few = ActionIndexer(random_state=config.seed).fit([task.clips[i] for i in mine], task.labels[mine])
                every = ActionIndexer(random_state=config.seed).fit(task.clips, task.labels)
                ask(every, asked, tallies["all actions"])
                ask(few, asked, tallies["three actions"])
                ask(few, [with_standing(one, rng) for one in asked], tallies["three actions, and standing"])
            lines |= {f"{name}, {kind}": tally.line() for kind, tally in tallies.items()}
    yield f"camera turned by {'0 degrees' if config.turn == 0 else 'the other angle'}", Grid(COLUMNS, lines)
