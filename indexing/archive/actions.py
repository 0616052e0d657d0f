"""Finding: all actions of a learned model in everything, recording by recording, as the indexer decodes them.

The sketches say first where somebody moves at all as an exemplar does (:func:`indexing.archive.sketches.mark_resembling`); what
they leave is decoded by the indexer itself.  Workers need the file of a segment and the model, and nothing else.
"""

from __future__ import annotations

import os
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dyntorch.numerics import one_thread
from indexing.archive.catalogue import Catalogue
from indexing.archive.search import Snapshot, probe_of
from indexing.archive.segments import ArchiveSegment
from indexing.archive.sketches import Probe, mark_resembling
from indexing.archive.tracks import Layout
from indexing.archive.workers import InOrder, check_done
from indexing.cameras import y_up
from indexing.clip import Clip
from indexing.scoring import Event
from indexing.windows import concatenate_clips, describe_unusable

if TYPE_CHECKING:
    from indexing.action.indexer import ActionIndexer

Progress = Callable[[float], None] | None
# squared, of movement between sketches and the nearest exemplar: all of 182 actions by others reach .33; .36 costs .07 of F1
MIN_CORRELATION = 0.3
# of an exemplar's movement, by energy beside that of the pose, below which somebody rests: skips a quarter of a recording
MIN_MOTION_SHARE = 0.25
TEMPOS = (0.7, 1.0, 1.4)  # durations of exemplars by which that is measured, in their own
MARGIN_SECONDS = 0.5  # around what may be an action, that are read with it
POSES_PER_TASK = 54_000  # that one worker reads before it answers: an hour
MODEL = "model.safetensors"


@dataclass(frozen=True)
class ArchivedEvent(Event):
    """An event of a learned action, and where it is: the recording's name, and the person, empty where only one is in view."""

    source: str = ""
    person: str = ""


@dataclass(frozen=True)
class FindTask:
    """Some recordings of a segment, what tells where to look in them, and the model as bytes of its file."""

    path: Path
    recordings: tuple[tuple[int, tuple[int, ...]], ...]
    layout: Layout
    probes: tuple[Probe, ...]
    model: bytes


@one_thread
def find(
    snapshot: Snapshot,
    catalogue: Catalogue,
    model: ActionIndexer | str | os.PathLike[str],
    executor: Executor | None,
    progress: Progress,
) -> list[ArchivedEvent]:
    """See :meth:`indexing.Archive.find`."""
    from indexing.action.indexer import ActionIndexer

    indexer = ActionIndexer.load(Path(model).expanduser()) if isinstance(model, (str, os.PathLike)) else model
    data = _model_bytes(indexer)
    probes = probes_of(snapshot, indexer)
    if not probes:
        known = ", ".join(one.name for one in snapshot.contents.layouts.values()) or "nothing"
        raise ValueError(
            f"{catalogue.folder}: joints: the model has too few in common with what is in the archive ({known}); use the same pose "
            "estimator for both"
        )
    tasks = _tasks(snapshot, probes, data)
    names = catalogue.recordings_by_id([number for task in tasks for number, _ in task.recordings])
    found: list[ArchivedEvent] = []
    for done, (task, events) in enumerate(InOrder(find_in, executor, tries=2)(tasks), 1):
        for number, event in check_done(task.path, events):
            row = names.get(number)
            if row is not None:
                found.append(ArchivedEvent(**{**vars(event), "source": row.name, "person": row.person}))
        if progress is not None:
            progress(done / len(tasks))
    return sorted(found, key=lambda event: (event.source, event.person, event.start, event.end))


def probes_of(snapshot: Snapshot, indexer: ActionIndexer) -> dict[int, tuple[Probe, ...]]:
    """How the exemplars move, for each layout that the model can be asked about."""
    rate = snapshot.contents.storage.rate
    model = indexer.model_
    exemplars = [indexer.exemplar(i) for i in range(len(model.labels))]
    if model.symmetry is not None:  # those that count mirrored: an image and its mirror image are of one shape, but for the joints
        swap, mirrored = model.symmetry.numpy(), model.mirrored.tolist()
        exemplars += [one.replace(joints=one.joints[:, swap]) for one, too in zip(exemplars, mirrored, strict=True) if too]
    found: dict[int, tuple[Probe, ...]] = {}
    for number, layout in snapshot.contents.layouts.items():
        facing = [layout.facing(clip) for clip in exemplars]
        if any(clip is None for clip in facing):
            continue
        clips = [clip.replace(joints=y_up(clip), up="y") for clip in facing if clip is not None]
        source = concatenate_clips(clips)
        all_of = [probe_of(source, i, layout, rate, tempo, moving=True) for i in range(len(clips)) for tempo in TEMPOS]
        found[number] = tuple(probe for probe in all_of if probe is not None)
    return found


def _tasks(snapshot: Snapshot, probes: dict[int, tuple[Probe, ...]], model: bytes) -> list[FindTask]:
    contents, tasks = snapshot.contents, []
    for i, row in enumerate(contents.segments):
        if row.layout not in probes:
            continue
        segment = snapshot.segments[i]
        by_recording: dict[int, list[int]] = {}
        for track in np.flatnonzero(segment.tracks[:, 1] == 0).tolist():
            number = int(segment.tracks[track, 0])
            if number not in snapshot.dead[i]:
                by_recording.setdefault(number, []).append(track)
        layout = contents.layouts[row.layout]
        tasks += [
            FindTask(segment.path, part, layout, probes[row.layout], model)
            for part in _parts(by_recording, segment, POSES_PER_TASK)
        ]
    return tasks


def _parts(
    by_recording: Mapping[int, Sequence[int]], segment: ArchiveSegment, rows: int
) -> Iterator[tuple[tuple[int, tuple[int, ...]], ...]]:
    """Recordings, so many together that their poses are about as many as asked."""
    part: list[tuple[int, tuple[int, ...]]] = []
    count = 0
    for number, tracks in by_recording.items():
        part.append((number, tuple(tracks)))
        count += int(segment.tracks[list(tracks), 3].sum())
        if count >= rows:
            yield tuple(part)
            part, count = [], 0
    if part:
        yield tuple(part)


# ---- some recordings, in a worker ----------------------------------------------------------------------------------------


@one_thread
def find_in(task: FindTask) -> list[tuple[int, Event]]:
    """``(recording, event)`` of all events of some recordings."""
    segment = ArchiveSegment.open(task.path)
    return [(number, event) for number, tracks in task.recordings for event in _events(task, segment, tracks)]


def _events(task: FindTask, segment: ArchiveSegment, tracks: Sequence[int]) -> list[Event]:
    clips: list[tuple[NDArray[np.float64], NDArray[np.float32]]] = []
    for track in sorted(tracks, key=lambda number: float(segment.starts[number])):
        part = segment.only(track)
        rows = np.flatnonzero(marked_rows(part, task.probes))
        if len(rows) > 1:
            clips.append((float(part.starts[0]) + rows / part.rate, part.poses(np.zeros(len(rows), np.int64), rows)))
    if not clips:
        return []
    times, joints = np.concatenate([one for one, _ in clips]), np.concatenate([one for _, one in clips])
    clip = Clip(joints, times=times, skeleton=task.layout.skeleton)
    if describe_unusable(clip):
        return []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # that the model has other joints, too, is so of every recording
        return list(_load_model(task.model).find(clip))


def marked_rows(track: ArchiveSegment, probes: Sequence[Probe]) -> NDArray[np.bool_]:
    """``(rows,)`` the poses of a track that are looked at: of what moves as an exemplar does, and a margin around it."""
    mask, margin = mark_resembling(track, probes, MIN_CORRELATION, MIN_MOTION_SHARE), round(MARGIN_SECONDS * track.rate)
    total = np.concatenate([[0], np.cumsum(mask)])
    index = np.arange(len(mask))
    return np.asarray(total[np.minimum(index + margin + 1, len(mask))] > total[np.maximum(index - margin, 0)])


def _model_bytes(indexer: ActionIndexer) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / MODEL
        indexer.save(path)
        return path.read_bytes()


@lru_cache(maxsize=4)
def _load_model(data: bytes) -> ActionIndexer:
    """A worker loads a model once, however many tasks bring it along."""
    from indexing.action.indexer import ActionIndexer

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / MODEL
        path.write_bytes(data)
        return ActionIndexer.load(path)
