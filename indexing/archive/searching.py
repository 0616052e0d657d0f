"""Searching: an example in, the stretches of all recordings that resemble it out.

Stages: the example becomes probes, for each joint layout (:mod:`indexing.archive.queries`); each segment's sketches give
candidates (:func:`candidates`), which are merged (:func:`merged`); the best are compared exactly, moved and stretched
(:func:`ranked`); neighbours become one hit (:func:`distinct`).
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from dyntorch.numerics import one_thread
from indexing.archive.catalogue import Contents
from indexing.archive.comparing import Places, residuals
from indexing.archive.options import SearchOptions
from indexing.archive.queries import Query
from indexing.archive.segments import ArchiveSegment
from indexing.archive.sketches import TASK_BLOCK, Candidates, Probe, scan, settled
from indexing.archive.workers import InOrder, WorkerLost
from indexing.clip import FloatArray

Progress = Callable[[float], None] | None


@dataclass(frozen=True)
class ScanTask:
    """What one worker scans: rows of one segment (its place among all); dead: recordings that were removed."""

    path: Path
    segment: int
    probes: tuple[Probe, ...]
    keep: int
    dead: frozenset[int]
    begin: int
    end: int


@dataclass(frozen=True, eq=False)
class Snapshot:
    """An archive as it is searched: what the catalogue says, the segments in its order, and who of each was removed."""

    folder: Path
    contents: Contents
    segments: tuple[ArchiveSegment, ...]
    dead: tuple[frozenset[int], ...]

    def tasks(self, queries: Mapping[int, Query], keep: int) -> list[ScanTask]:
        """What there is to scan, in its order."""
        rows = self.contents.segments
        return [
            ScanTask(self.folder / row.file, i, queries[row.layout].probes, keep, self.dead[i], begin, begin + TASK_BLOCK)
            for i, row in enumerate(rows)
            if row.layout in queries
            for begin in range(0, len(self.segments[i].codes), TASK_BLOCK)
        ]


@dataclass(frozen=True, eq=False)
class Shortlist:
    """Windows that may be hits, each a row of all arrays."""

    places: Places
    probe: NDArray[np.int64]
    score: FloatArray
    mirrored: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.probe)

    def __getitem__(self, index: NDArray[np.intp] | slice) -> Shortlist:
        return Shortlist(self.places[index], self.probe[index], self.score[index], self.mirrored[index])

    def at(self, places: Places, score: FloatArray) -> Shortlist:
        """The same windows elsewhere, with other scores."""
        return replace(self, places=places, score=score)


def search(
    snapshot: Snapshot, queries: Mapping[int, Query], k: int, options: SearchOptions, executor: Executor | None, progress: Progress
) -> Shortlist:
    """The best ``k`` stretches, best first."""
    found = candidates(snapshot.tasks(queries, options.settled), executor, progress)
    return _chosen(snapshot, queries, found, k, options)


@one_thread
def _chosen(
    snapshot: Snapshot, queries: Mapping[int, Query], found: Sequence[tuple[int, Candidates]], k: int, options: SearchOptions
) -> Shortlist:
    shortlist = merged(snapshot, queries, found, options)
    shortlist = ranked(snapshot, queries, shortlist, k, options)
    return distinct(snapshot, shortlist, options)[:k]


# ---- candidates ----------------------------------------------------------------------------------------------------------


@one_thread
def scan_task(task: ScanTask) -> Candidates:
    """What a worker does: it needs nothing but the file."""
    return scan(_opened(str(task.path)), task.probes, task.keep, task.dead, task.begin, task.end)


@lru_cache(maxsize=256)
def _opened(path: str) -> ArchiveSegment:
    return ArchiveSegment.open(Path(path))


def candidates(tasks: Sequence[ScanTask], executor: Executor | None, progress: Progress) -> list[tuple[int, Candidates]]:
    """``(segment, candidates)`` of every task; as many threads of this process as torch has do it where there is no executor."""
    found: list[tuple[int, Candidates]] = []
    with contextlib.ExitStack() as stack:
        threads = torch.get_num_threads()
        if executor is None and threads > 1 and len(tasks) > 1:
            executor = stack.enter_context(ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)))
        for task, result in InOrder(scan_task, executor, tries=2)(tasks):
            if isinstance(result, WorkerLost):
                if not task.path.exists():
                    raise FileNotFoundError(str(task.path))
                raise ValueError(f"{task.path}: could not be searched: {result}; try again, or with fewer workers")
            found.append((task.segment, result))
            if progress is not None:
                progress(0.9 * len(found) / len(tasks))
    return found


def merged(
    snapshot: Snapshot, queries: Mapping[int, Query], found: Sequence[tuple[int, Candidates]], options: SearchOptions
) -> Shortlist:
    """The best candidates of all, settled; of those of one track that nearly coincide, whatever their tempo, the best."""
    rows = snapshot.contents.segments
    rate = snapshot.contents.options.rate
    best = _settled(snapshot, queries, found, options)
    segment = np.repeat([i for i, _ in best], [len(one) for _, one in best]).astype(np.intp)
    every = Candidates.joined([one for _, one in best])
    track, row, probe, score = every.track, every.row, every.probe, every.score.astype(float)
    asked = [queries[rows[i].layout].fine[p] for i, p in zip(segment.tolist(), probe.tolist(), strict=True)]
    middle = (row + np.array([one.span / 2 for one in asked])) / rate
    half = np.array([one.seconds / 2 for one in asked])
    kept: list[int] = []
    near: dict[tuple[int, int], list[int]] = {}
    for i in np.lexsort((probe, row, track, segment, -score)).tolist():
        others = near.setdefault((int(segment[i]), int(track[i])), [])
        if all(abs(middle[i] - middle[j]) > options.apart * 2 * min(half[i], half[j]) for j in others):
            others.append(i)
            kept.append(i)
            if len(kept) == options.candidates:
                break
    chosen = np.array(kept, dtype=np.intp)
    places = Places(segment, track, middle - half, middle + half)
    return Shortlist(places, probe, score, np.array([one.mirrored for one in asked], dtype=bool))[chosen]


def _settled(
    snapshot: Snapshot, queries: Mapping[int, Query], found: Sequence[tuple[int, Candidates]], options: SearchOptions
) -> list[tuple[int, Candidates]]:
    """The best of all scans, by more samples and to the pose: ``(segment, candidates)``."""
    rows = snapshot.contents.segments
    every = Candidates.joined([one for _, one in found])
    scan_of = np.repeat(np.arange(len(found)), [len(one) for _, one in found])
    best = np.argsort(-every.score, kind="stable")[: options.settled]
    out: list[tuple[int, Candidates]] = []
    for number in np.unique(scan_of[best]).tolist():
        i = found[number][0]
        query = queries[rows[i].layout]
        mine = np.sort(best[scan_of[best] == number])
        out.append((i, settled(snapshot.segments[i], query.probes, query.fine, every[mine])))
    return out


# ---- the exact comparison ------------------------------------------------------------------------------------------------


def ranked(snapshot: Snapshot, queries: Mapping[int, Query], shortlist: Shortlist, k: int, options: SearchOptions) -> Shortlist:
    """Candidates by their exact residual, best first; the best ones moved and stretched to where it is least."""
    shortlist = _sorted(shortlist.at(shortlist.places, _scores(snapshot, queries, shortlist, options)))
    best = shortlist[: max(options.refined, 4 * k)]
    middle, half = (best.places.begin + best.places.end) / 2, (best.places.end - best.places.begin) / 2
    parts = [
        replace(best.places, begin=middle + (2 * shift - stretch) * half, end=middle + (2 * shift + stretch) * half)
        for shift in options.shifts
        for stretch in options.stretches
    ]
    if not len(best):
        return best
    tried = np.stack([_scores(snapshot, queries, best.at(part, best.score), options) for part in parts])
    which, index = np.argmax(tried, axis=0), np.arange(len(best))
    begin, end = (np.stack([getattr(part, name) for part in parts])[which, index] for name in ("begin", "end"))
    return _sorted(best.at(replace(best.places, begin=begin, end=end), tried[which, index]))


def _scores(snapshot: Snapshot, queries: Mapping[int, Query], shortlist: Shortlist, options: SearchOptions) -> FloatArray:
    """``(windows,)`` minus the residual, layout by layout."""
    rows = snapshot.contents.segments
    layouts = np.array([rows[i].layout for i in shortlist.places.segment.tolist()], dtype=np.intp)
    out = np.full(len(shortlist), -np.inf)
    for number in np.unique(layouts).tolist():
        mine = np.flatnonzero(layouts == number)
        query = queries[number]
        image = np.array([query.fine[p].image for p in shortlist.probe[mine].tolist()], dtype=np.intp)
        metric = snapshot.contents.layouts[number].joint_metric(options)
        out[mine] = -residuals(query.windows, image, shortlist.places[mine], snapshot.segments, metric, options.length)
    return out


def _sorted(shortlist: Shortlist) -> Shortlist:
    """Best first, of equal ones in the order in which they lie; without those that could not be compared."""
    places = shortlist.places
    order = np.lexsort((shortlist.probe, places.begin, places.track, places.segment, -shortlist.score))
    return shortlist[order[np.isfinite(shortlist.score[order])]]


def distinct(snapshot: Snapshot, shortlist: Shortlist, options: SearchOptions) -> Shortlist:
    """Windows, best first, without those that mostly cover what a better one of the same person covers, from whatever image."""
    kept: list[int] = []
    spans: dict[int, list[tuple[float, float]]] = {}
    places = shortlist.places
    for i in range(len(shortlist)):
        segment, track = snapshot.segments[int(places.segment[i])], int(places.track[i])
        start = float(segment.starts[track])
        begin, end = start + float(places.begin[i]), start + float(places.end[i])
        others = spans.setdefault(int(segment.tracks[track, 0]), [])
        if all(min(end, b) - max(begin, a) < options.merged * min(end - begin, b - a) for a, b in others):
            others.append((begin, end))
            kept.append(i)
    return shortlist[np.array(kept, dtype=np.intp)]
