"""Search: an example in, the stretches of all recordings that resemble it out.

Stages: the example becomes probes, for each joint layout (:func:`queries_of`); each segment's sketches give candidates
(:func:`candidates`), which are merged (:func:`merge_candidates`); the best are compared exactly, shifted and stretched
(:func:`rank`); neighbours become one hit (:func:`suppress_overlaps`).
"""

from __future__ import annotations

import contextlib
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from dyntorch.numerics import one_thread
from indexing.action.bank import Bank, Copy, JointMetric, Windows, fused_residuals, planes_of
from indexing.archive.catalogue import Contents
from indexing.archive.segments import ArchiveSegment
from indexing.archive.sketches import TASK_BLOCK, Candidates, Probe, orthonormal, refine_candidates, scan
from indexing.archive.tracks import WINDOW_LENGTH, Layout, images
from indexing.archive.workers import InOrder, check_done
from indexing.cameras import y_up
from indexing.clip import Clip, FloatArray
from indexing.windows import Ragged, concatenate_clips, describe_unusable, interpolate_gaps, repair_clip, resample_clips, sample

Progress = Callable[[float], None] | None

TEMPOS = (0.8, 1.0, 1.25)  # durations that are searched, in those of the query: people differ
# durations of a recording up to which its first and last windows are compared: they may lie between two steps of the scan
MAX_TRIMMED = 2.0
NUM_SAMPLES = 4  # steps that a window is divided into by the scan, where its duration allows
NUM_FINE_SAMPLES = 16  # the same of the windows that are kept
MAX_SCANNED_WINDOWS = 2000  # of the scan that are compared at all tempos by more samples, and moved to the pose where they fit best
MIN_SEPARATION = 0.05  # durations between two candidates; of right ones among ten in exercises, .2 finds .49, .05 .54
SHIFTS = (-0.1, -0.05, 0.0, 0.05, 0.1)  # durations, in its own, by which a candidate is moved where it is compared exactly
MAX_REFINED = 100  # best candidates that are moved and stretched
MAX_OVERLAP = 0.5  # of the shorter of two hits of one person, from which they are one
MAX_EXAMPLE_SECONDS = 30.0  # a longer example is no movement but a recording
READ_AROUND = 2  # poses beyond both ends of a window: what the first and last of its steps are averaged from


# ---- the example ---------------------------------------------------------------------------------------------------------


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


@dataclass(frozen=True, eq=False)
class Query:
    """An example as it faces the recordings of one layout."""

    windows: Windows
    probes: tuple[Probe, ...]
    fine: tuple[Probe, ...]


def check_example(clip: Clip, min_duration: float) -> Clip:
    """An example that can be searched."""
    who = f"{clip.name!r}" if clip.name else "the example"
    there = np.flatnonzero(clip.seen.any(axis=1))
    if not len(there):
        raise ValueError(f"{who}: nobody is in view in any frame; give a clip that shows the movement")
    reason = describe_unusable(clip)
    if reason:
        raise ValueError(f"{who}: {reason}; give a clip that shows the movement")
    clip = repair_clip(clip.replace(joints=clip.joints[there], times=clip.times[there], confidence=None))
    if clip.duration < min_duration * (1 - 1e-9):
        raise ValueError(
            f"{who}: shows {clip.duration:.3g} s, but the shortest window lasts {min_duration:g} s; give more of the movement"
        )
    if clip.duration > MAX_EXAMPLE_SECONDS:
        raise ValueError(
            f"{who}: lasts {clip.duration:.4g} s, an example {MAX_EXAMPLE_SECONDS:g} s at most; cut out one performance, as in "
            "throw.json@2.1-3.0"
        )
    return clip


def queries_of(clip: Clip, contents: Contents, mirrored: bool = False) -> dict[int, Query]:
    """The example, for each layout that it has enough joints of."""
    found: dict[int, Query] = {}
    for number, layout in contents.layouts.items():
        facing = layout.facing(clip)
        if facing is not None:
            example = _example(facing, layout, contents.storage.rate, contents.storage.views, mirrored)
            if example.probes:
                found[number] = example
    if not found:
        own = clip.skeleton.name if clip.skeleton is not None else f"{clip.joints.shape[1]} joints without names"
        known = ", ".join(layout.name for layout in contents.layouts.values())
        who = f"{clip.name!r}" if clip.name else "the example"
        raise ValueError(
            f"{who}: joints: {own} has too few in common with what is in the archive ({known}); use the same pose estimator"
        )
    return found


def _example(clip: Clip, layout: Layout, rate: float, views: Sequence[float], mirrored: bool) -> Query:
    clips = [one.replace(joints=y_up(one), up="y", confidence=None) for one in images(clip, views)]
    count = len(clips)
    if mirrored:
        swap = layout.swap
        if swap is None:
            raise ValueError(f"{clip.name!r}: which joints are left and right cannot be told; name the joints, or search as it is")
        # an image and its mirror image are of one shape: only the joints change places
        clips += [one.replace(joints=one.joints[:, swap]) for one in clips]
    source = concatenate_clips(clips)
    coarse, fine = (
        [
            probe_of(source, i, layout, rate, tempo, samples, mirrored=i >= count)
            for i in range(len(clips))
            for tempo in dict.fromkeys((1.0, *TEMPOS))
        ]
        for samples in (NUM_SAMPLES, NUM_FINE_SAMPLES)
    )
    windows = Windows(resample_clips(source, WINDOW_LENGTH), torch.from_numpy(source.seen))
    return Query(windows, tuple(one for one in coarse if one is not None), tuple(one for one in fine if one is not None))


def probe_of(
    source: Ragged,
    image: int,
    layout: Layout,
    rate: float,
    tempo: float,
    num_samples: int = NUM_SAMPLES,
    *,
    mirrored: bool = False,
    moving: bool = False,
) -> Probe | None:
    """One image of an example at one tempo; ``None`` where hardly any joint was seen."""
    first, last = source.starts[image], source.starts[image + 1] - 1
    begin, end = float(source.times[first]), float(source.times[last])
    seconds = (end - begin) * tempo
    stride = max(1, int(seconds * rate / num_samples + 1e-6))
    samples = max(2, int(seconds * rate / stride + 1e-6) + 1)
    # the moments of the example that lie under poses of the archive, in the middle of it
    at = (begin + end) / 2 + (np.arange(samples) - (samples - 1) / 2) * stride / rate / tempo
    half = 0.5 / rate / tempo
    poses = sample(source, np.full(samples, image), at - half, at + half, 1)[:, 0].numpy()
    poses[:, ~source.seen[image]] = np.nan
    each = np.ascontiguousarray(layout.project(poses).transpose(1, 0, 2))
    mean = each.mean(axis=1, keepdims=True)
    codes = orthonormal(each - mean if moving else each)
    if codes is None:
        return None
    moved = float(((each - mean) ** 2).sum() / max(float((each**2).sum()), 1e-30))
    longest = int(MAX_TRIMMED * seconds * rate)
    return Probe(image, mirrored, seconds, stride, codes, moved, tempo == 1, longest)


# ---- the archive, and the stages of a search -----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Places:
    """Where windows are: tracks of segments and seconds from the first pose of these, each window a row of all arrays."""

    segment: NDArray[np.intp]
    track: NDArray[np.int64]
    begin: FloatArray
    end: FloatArray

    def __len__(self) -> int:
        return len(self.segment)

    def __getitem__(self, index: NDArray[np.intp] | slice) -> Places:
        return Places(self.segment[index], self.track[index], self.begin[index], self.end[index])


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


def search(
    snapshot: Snapshot, queries: Mapping[int, Query], k: int, num_candidates: int, executor: Executor | None, progress: Progress
) -> Shortlist:
    """The best ``k`` stretches, best first."""
    scanned = candidates(snapshot.tasks(queries, MAX_SCANNED_WINDOWS), executor, progress)
    return _select(snapshot, queries, scanned, k, num_candidates)


@one_thread
def _select(
    snapshot: Snapshot, queries: Mapping[int, Query], scanned: Sequence[tuple[int, Candidates]], k: int, num_candidates: int
) -> Shortlist:
    shortlist = merge_candidates(snapshot, queries, scanned, num_candidates)
    shortlist = rank(snapshot, queries, shortlist, k)
    return suppress_overlaps(snapshot, shortlist)[:k]


# ---- candidates ----------------------------------------------------------------------------------------------------------


@one_thread
def scan_task(task: ScanTask) -> Candidates:
    """What a worker does: it needs nothing but the file."""
    return scan(_open_segment(str(task.path)), task.probes, task.keep, task.dead, task.begin, task.end)


@lru_cache(maxsize=256)
def _open_segment(path: str) -> ArchiveSegment:
    return ArchiveSegment.open(Path(path))


def candidates(tasks: Sequence[ScanTask], executor: Executor | None, progress: Progress) -> list[tuple[int, Candidates]]:
    """``(segment, candidates)`` of every task; as many threads of this process as torch has do it where there is no executor."""
    found: list[tuple[int, Candidates]] = []
    with contextlib.ExitStack() as stack:
        threads = torch.get_num_threads()
        if executor is None and threads > 1 and len(tasks) > 1:
            executor = stack.enter_context(ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)))
        for task, result in InOrder(scan_task, executor, tries=2)(tasks):
            found.append((task.segment, check_done(task.path, result)))
            if progress is not None:
                progress(0.9 * len(found) / len(tasks))
    return found


def merge_candidates(
    snapshot: Snapshot, queries: Mapping[int, Query], scanned: Sequence[tuple[int, Candidates]], num_candidates: int
) -> Shortlist:
    """The best candidates of all scans, refined; of those of one track that nearly coincide, whatever their tempo, the best."""
    rows = snapshot.contents.segments
    rate = snapshot.contents.storage.rate
    best = _refine(snapshot, queries, scanned)
    segment = np.repeat([i for i, _ in best], [len(one) for _, one in best]).astype(np.intp)
    every = Candidates.concatenate([one for _, one in best])
    track, row, probe, score = every.track, every.row, every.probe, every.score.astype(float)
    asked = [queries[rows[i].layout].fine[p] for i, p in zip(segment.tolist(), probe.tolist(), strict=True)]
    middle = (row + np.array([one.span / 2 for one in asked])) / rate
    half = np.array([one.seconds / 2 for one in asked])
    order = np.lexsort((probe, row, track, segment, -score))
    chosen = _separate(middle, half, order, segment * (int(track.max(initial=0)) + 1) + track, num_candidates)
    places = Places(segment, track, middle - half, middle + half)
    return Shortlist(places, probe, score, np.array([one.mirrored for one in asked], dtype=bool))[chosen]


def _separate(
    middle: FloatArray, half: FloatArray, order: NDArray[np.intp], person: NDArray[np.int64], count: int
) -> NDArray[np.intp]:
    """The first of some windows, in an order, whose middles are not within a share of the shorter one of each other's of the same
    person: those of each person are kept sorted, so that only neighbours are compared."""
    kept: list[int] = []
    reach, widest = 2 * MIN_SEPARATION, 2.001 * MIN_SEPARATION * float(half.max(initial=0.0))
    near: dict[int, tuple[list[float], list[float]]] = {}
    centres, halves, people = middle.tolist(), half.tolist(), person.tolist()
    for i in order.tolist():
        at, others = near.setdefault(people[i], ([], []))
        first, last = bisect_left(at, centres[i] - widest), bisect_right(at, centres[i] + widest)
        if all(abs(centres[i] - at[j]) > reach * min(halves[i], others[j]) for j in range(first, last)):
            place = bisect_left(at, centres[i])
            at.insert(place, centres[i])
            others.insert(place, halves[i])
            kept.append(i)
            if len(kept) == count:
                break
    return np.array(kept, dtype=np.intp)


def _refine(
    snapshot: Snapshot, queries: Mapping[int, Query], scanned: Sequence[tuple[int, Candidates]]
) -> list[tuple[int, Candidates]]:
    """The best of all scans, by more samples and to the pose: ``(segment, candidates)``."""
    rows = snapshot.contents.segments
    every = Candidates.concatenate([one for _, one in scanned])
    scan_of = np.repeat(np.arange(len(scanned)), [len(one) for _, one in scanned])
    best = np.argsort(-every.score, kind="stable")[:MAX_SCANNED_WINDOWS]
    out: list[tuple[int, Candidates]] = []
    for number in np.unique(scan_of[best]).tolist():
        i = scanned[number][0]
        query = queries[rows[i].layout]
        mine = np.sort(best[scan_of[best] == number])
        out.append((i, refine_candidates(snapshot.segments[i], query.probes, query.fine, every[mine])))
    return out


# ---- the exact comparison ------------------------------------------------------------------------------------------------


def residuals(
    example: Windows, image: NDArray[np.intp], places: Places, segments: Sequence[ArchiveSegment], metric: JointMetric
) -> FloatArray:
    """``(places,)`` fused residual between each window and the image of the example that it is compared with."""
    if not len(places):
        return np.zeros(0)
    windows = cut_windows(places, segments)
    (table,) = fused_residuals(example, [Bank([Copy(windows)], planes_of(metric))], [("epi",)])
    found = table.double().numpy()[image, np.arange(len(places))]
    # a window that shows none of the joints fits everything
    return np.asarray(np.where(windows.seen.any(dim=1).numpy(), found, np.inf))


def cut_windows(places: Places, segments: Sequence[ArchiveSegment]) -> Windows:
    """Windows resampled from the stored joints, gaps bridged in time, as the indexer cuts them from a clip."""
    joints = segments[int(places.segment[0])].joints.shape[1]
    values = torch.empty(len(places), WINDOW_LENGTH, joints, 2)
    seen = torch.empty(len(places), joints, dtype=torch.bool)
    for number in np.unique(places.segment).tolist():
        mine = np.flatnonzero(places.segment == number)
        segment, track = segments[number], places.track[mine]
        begin, end = places.begin[mine], places.end[mine]
        rows = segment.tracks[track, 3]
        # a window that hangs over an end repeats the pose there
        first = np.clip(np.floor(begin * segment.rate).astype(np.intp) - READ_AROUND, 0, rows - 2)
        last = np.clip(np.ceil(end * segment.rate).astype(np.intp) + READ_AROUND + 1, first + 2, rows)
        counts = last - first
        starts = np.concatenate([[0], np.cumsum(counts)])
        step = np.arange(starts[-1]) - np.repeat(starts[:-1], counts) + np.repeat(first, counts)
        source = interpolate_gaps(segment.poses(np.repeat(track, counts), step), step / segment.rate, starts)
        values[mine] = sample(source, np.arange(len(mine)), begin, end, WINDOW_LENGTH)
        seen[mine] = torch.from_numpy(source.seen)
    return Windows(values, seen)


def rank(snapshot: Snapshot, queries: Mapping[int, Query], shortlist: Shortlist, k: int) -> Shortlist:
    """Candidates by their exact residual, best first; the best ones moved and stretched to where it is least."""
    shortlist = _sort_shortlist(replace(shortlist, score=_scores(snapshot, queries, shortlist)))
    best = shortlist[: max(MAX_REFINED, 4 * k)]
    middle, half = (best.places.begin + best.places.end) / 2, (best.places.end - best.places.begin) / 2
    parts = [replace(best.places, begin=middle + (2 * shift - 1) * half, end=middle + (2 * shift + 1) * half) for shift in SHIFTS]
    if not len(best):
        return best
    tried = np.stack([_scores(snapshot, queries, replace(best, places=part)) for part in parts])
    which, index = np.argmax(tried, axis=0), np.arange(len(best))
    begin, end = (np.stack([getattr(part, name) for part in parts])[which, index] for name in ("begin", "end"))
    return _sort_shortlist(replace(best, places=replace(best.places, begin=begin, end=end), score=tried[which, index]))


def _scores(snapshot: Snapshot, queries: Mapping[int, Query], shortlist: Shortlist) -> FloatArray:
    """``(windows,)`` minus the residual, layout by layout."""
    rows = snapshot.contents.segments
    layouts = np.array([rows[i].layout for i in shortlist.places.segment.tolist()], dtype=np.intp)
    out = np.full(len(shortlist), -np.inf)
    for number in np.unique(layouts).tolist():
        mine = np.flatnonzero(layouts == number)
        query = queries[number]
        image = np.array([query.fine[p].image for p in shortlist.probe[mine].tolist()], dtype=np.intp)
        metric = snapshot.contents.layouts[number].joint_metric()
        out[mine] = -residuals(query.windows, image, shortlist.places[mine], snapshot.segments, metric)
    return out


def _sort_shortlist(shortlist: Shortlist) -> Shortlist:
    """Best first, of equal ones in the order in which they lie; without those that could not be compared."""
    places = shortlist.places
    order = np.lexsort((shortlist.probe, places.begin, places.track, places.segment, -shortlist.score))
    return shortlist[order[np.isfinite(shortlist.score[order])]]


def suppress_overlaps(snapshot: Snapshot, shortlist: Shortlist) -> Shortlist:
    """Non-maximum suppression per person, over all images: windows, best first, without those that a better one mostly covers."""
    kept: list[int] = []
    spans: dict[int, list[tuple[float, float]]] = {}
    places = shortlist.places
    for i in range(len(shortlist)):
        segment, track = snapshot.segments[int(places.segment[i])], int(places.track[i])
        start = float(segment.starts[track])
        begin, end = start + float(places.begin[i]), start + float(places.end[i])
        others = spans.setdefault(int(segment.tracks[track, 0]), [])
        if all(min(end, b) - max(begin, a) < MAX_OVERLAP * min(end - begin, b - a) for a, b in others):
            others.append((begin, end))
            kept.append(i)
    return shortlist[np.array(kept, dtype=np.intp)]
