"""Videos to keypoints: :func:`detect`, and the work behind it, for one video or many.

1. The file is looked at and cut into pieces (:mod:`indexing.pose.chunks`).
2. Each piece is worked: people are found and followed from frame to frame (:mod:`indexing.pose.tracking`).
3. Tracks of all pieces become people (:mod:`indexing.pose.tracking`), and people clips.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from indexing.clip import Clip, ClipSet, check_fps
from indexing.opening import count, error
from indexing.pose.blazepose import JOINTS, Floats
from indexing.pose.chunks import Piece, PieceLost, Stopped, Store, VideoPlan, plan, work
from indexing.pose.models import ModelSet, load_models
from indexing.pose.networks import LiteNetworks
from indexing.pose.tracking import Indices, PoseOptions, Sightings, concatenate, identities, largest
from indexing.readers.recording import MIN_CROWDED_SHARE, NobodySeen
from indexing.skeleton import BLAZEPOSE33
from indexing.video.reading import av, cv2

ModelName = Literal["heavy", "full", "lite"]
Progress = Callable[[float], None]
FrameProgress = Callable[[int, int], None]
"""Called with the frames that are done, and how many there are in all."""


class NobodyInVideo(NobodySeen):
    """A video in which no person was found."""

    def __init__(self, path: Path, frames: Indices, times: Any, notes: Sequence[str] = ()) -> None:
        super().__init__(path, frames, times)
        what = "; ".join([f"no person was found in any of its {count(len(frames), 'frame')}", *notes])
        self.args = error(path, what, "a person must be in view as a whole, and not too small; see docs/guide/pose.md").args


@dataclass(frozen=True, eq=False)
class Detected:
    """What was found in a video.

    Attributes:
        clips: one per person, the largest first.
        frames: numbers of the frames that were looked at, in the file, from 0.
        times: ``(frames,)`` their seconds.
        shown: share of them that show a person.
        seconds: that the work took, of all workers together.
        notes: what a user should know.
    """

    clips: ClipSet
    frames: Indices
    times: Any
    shown: float
    seconds: float
    notes: tuple[str, ...]


def detect(
    path: str | Path,
    people: int = 1,
    *,
    model: ModelName | None = None,
    models: str | Path | None = None,
    every: int = 1,
    fps: float | None = None,
    workers: int = 1,
    progress: Progress | None = None,
    options: PoseOptions | None = None,
) -> ClipSet:
    """Find people in a video and follow their joints, offline; nothing is smoothed and nothing is filled in.

    Joints are those that BlazePose sees in each frame by itself: a filter as in MediaPipe's own programs would delay them by up to
    some frames, which moves the clock of a camera.

    Args:
        path: of a video, however it is turned and however uneven its frame rate.
        people: how many are followed at once, at most.  One person is whoever is the largest, taken over the whole video, among
            those in view.
        model: ``"heavy"``, ``"full"`` or ``"lite"``; by default the sharpest that is there.
        models: folder of the model files; by default where ``dyntorch pose --get-models`` keeps them.
        every: look at one frame in so many.
        fps: frames per second of a file without timestamps; default 30.
        workers: threads that work on pieces of the video; the result does not depend on their number.
        progress: called with the share done.
        options: chunks, scores and absences.

    Returns:
        one :class:`~indexing.Clip` per person, the largest first: ``joints (frames, 33, 2)`` in pixels of the upright picture, from
        its upper left corner, NaN where the person is not seen, and where a joint lies outside of the picture; exact ``times``;
        ``confidence``, the lower one of the network's two probabilities that a joint is visible and that it is in the picture;
        ``meta`` with ``size`` (width, height), ``model``,
        ``every`` and who it is.  With ``people=1`` the clip has all frames, otherwise those from a person's first to the last.

    Raises:
        ValueError: no model files, no runtime, no such video, nothing in it that can be decoded, or nobody in it.

    Source: Bazarevsky et al., "BlazePose: On-device Real-time Body Pose tracking", 2020.

    Example:
        >>> detect("a.mp4", people=0)
        Traceback (most recent call last):
        ...
        ValueError: detect: people must be a whole number from 1, got 0
    """
    check(people, every, workers, fps)
    chosen = load_models(model, models)
    task = VideoTask(Path(path).expanduser(), people, every, fps, chosen.name, options or PoseOptions())
    ((_, found),) = run([task], chosen, workers, as_frames(progress))
    if isinstance(found, ValueError):
        raise found
    return found.clips


def check(people: int, every: int, workers: int = 1, fps: float | None = None, who: str = "detect: ") -> None:
    """Raise where a number makes no sense."""
    for name, value in (("people", people), ("every", every), ("workers", workers)):
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
            raise ValueError(f"{who}{name} must be a whole number from 1, got {value!r}")
    if fps is not None:
        check_fps(fps, who)


# ----------------------------------------------------------------------------------------------------------------------
# The work: pieces of all videos, by so many threads.  LiteRT, OpenCV and FFmpeg let go of Python while they compute.


@dataclass(frozen=True)
class VideoTask:
    """A video to work on; ``parts``: the folder in which its finished pieces are kept, if they are."""

    path: Path
    people: int
    every: int
    fps: float | None
    model: str
    options: PoseOptions = field(default_factory=PoseOptions)
    parts: Path | None = None


@dataclass(eq=False)
class _Job:
    """A video that is being worked; what is wrong with it ends its other pieces, too."""

    task: VideoTask
    plan: VideoPlan | None = None
    store: Store | None = None
    pieces: list[Future[Sightings]] = field(default_factory=list)
    problem: ValueError | None = None
    seconds: float = 0.0


def run(
    tasks: Sequence[VideoTask], models: ModelSet, workers: int = 1, progress: FrameProgress | None = None
) -> Iterator[tuple[VideoTask, Detected | ValueError]]:
    """Work on videos; each comes out as soon as it is done, in order, or with what is wrong with it."""
    av(), cv2()
    jobs = [_plan_job(task) for task in tasks]
    meter = _Meter(sum(job.plan.frames for job in jobs if job.plan is not None), progress)
    own, halted = threading.local(), threading.Event()

    def work_piece(job: _Job, task: VideoPlan, piece: Piece) -> Sightings:
        begun = time.perf_counter()
        kept = None if job.store is None else job.store.get(piece)
        if kept is not None:
            meter.add(len(piece.frames))
            return kept
        if halted.is_set() or job.problem is not None:
            raise Stopped
        before = meter.of_thread()
        try:
            if not hasattr(own, "networks"):
                own.networks = LiteNetworks(models)
            seen = work(task, piece, own.networks, meter.add, lambda: halted.is_set() or job.problem is not None)
            if job.store is not None:
                job.store.save(piece, seen)
        except PieceLost:
            raise
        except ValueError as problem:
            job.problem = job.problem or problem
            raise
        finally:
            job.seconds += time.perf_counter() - begun
        meter.add(len(piece.frames) - (meter.of_thread() - before))
        return seen

    with SINGLE_THREADED.hold(), ThreadPoolExecutor(workers) as pool:
        try:
            for job in jobs:
                if job.plan is not None:
                    job.pieces = [pool.submit(work_piece, job, job.plan, piece) for piece in job.plan.pieces]
            for job in jobs:
                yield job.task, _outcome(job)
        finally:
            halted.set()
            pool.shutdown(wait=True, cancel_futures=True)


def _plan_job(task: VideoTask) -> _Job:
    job = _Job(task)
    try:
        job.plan = plan(task.path, task.people, task.every, task.fps, task.model, task.options)
    except ValueError as problem:
        job.problem = problem
        return job
    job.store = None if task.parts is None else Store(task.parts, job.plan)
    return job


def _outcome(job: _Job) -> Detected | ValueError:
    """What became of a video, when all of its pieces are done."""
    if job.plan is None:
        assert job.problem is not None
        return job.problem
    parts: list[Sightings] = []
    first: ValueError | None = None
    for piece in job.pieces:
        try:
            parts.append(piece.result())
        except PieceLost as problem:
            first = first or problem
        except ValueError as problem:
            return problem
        except Stopped:
            if job.problem is None:
                raise
            return job.problem
    if not parts:
        return first or error(job.task.path, "has no frame to look at", "leave --every out")
    lost = [] if first is None else [f"{count(len(job.pieces) - len(parts), 'part')} of it cannot be decoded ({first})"]
    try:
        found = make_clips(job.plan, concatenate(parts), job.seconds)
    except NobodyInVideo as problem:
        return problem
    return replace(found, notes=(*found.notes, *lost))


class _Meter:
    """Frames done of all, from any thread."""

    def __init__(self, total: int, progress: FrameProgress | None) -> None:
        self._total, self._progress = total, progress
        self._done = 0
        self._lock = threading.Lock()
        self._own = threading.local()

    def add(self, frames: int = 1) -> None:
        self._own.frames = self.of_thread() + frames
        with self._lock:
            self._done += frames
            if self._progress is not None and frames:
                self._progress(min(self._done, self._total), self._total)

    def of_thread(self) -> int:
        return getattr(self._own, "frames", 0)


class _SingleThreadedOpenCV:
    """OpenCV without threads of its own, while anybody works: on pictures this small they only wait for each other."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._users, self._before = 0, 0

    @contextmanager
    def hold(self) -> Iterator[None]:
        """As long as this lasts; the last one who leaves gives the threads back."""
        with self._lock:
            if not self._users:
                self._before = cv2().getNumThreads()
                cv2().setNumThreads(1)
            self._users += 1
        try:
            yield
        finally:
            with self._lock:
                self._users -= 1
                if not self._users:
                    cv2().setNumThreads(self._before)


SINGLE_THREADED = _SingleThreadedOpenCV()  # the process has one OpenCV


def workers_here() -> int:
    """As many as there are cores."""
    return os.cpu_count() or 1


def as_frames(progress: Progress | None) -> FrameProgress | None:
    """What is called with the share done, called with frames."""
    return None if progress is None else lambda done, total: progress(done / max(1, total))


# ----------------------------------------------------------------------------------------------------------------------
# People as clips.


def make_clips(task: VideoPlan, seen: Sightings, seconds: float = 0.0) -> Detected:
    """The people of a video as clips."""
    if not len(seen.at):
        raise NobodyInVideo(task.path, np.arange(len(seen.times)), seen.times, seen.notes)
    people = identities(seen, task.options.max_absence)
    name = task.path.name
    known = {"size": (task.info.width, task.info.height), "every": task.every, "content": task.content, "made_from": task.made_from}
    if task.people == 1:
        rows = largest(seen, people)
        crowded = len(seen.crowd) > 0 and float((seen.crowd > 1).mean()) > MIN_CROWDED_SHARE
        others = {"people": int(seen.crowd.max())} if crowded else {}
        who = {"person": 0, "followed": "position", **others}
        clips = [_clip(task, seen, rows, np.arange(len(seen.times)), name, {**known, **who})]
    else:
        clips = []
        for number, rows in enumerate(people, 1):
            frames = np.arange(int(seen.at[rows[0]]), int(seen.at[rows[-1]]) + 1)
            who = {"person": number, "followed": "ids", "untracked": 0}
            clips.append(_clip(task, seen, rows, frames, f"{name}#{number}", {**known, **who}))
    index = np.searchsorted(task.times, seen.times - np.diff(task.times).min(initial=1.0) / 2)
    notes = tuple(dict.fromkeys((*task.info.notes, *seen.notes)))
    return Detected(ClipSet(clips, name), index, seen.times, len(np.unique(seen.at)) / len(seen.times), seconds, notes)


def in_view(joints: Floats, confidence: Floats, size: tuple[int, int]) -> tuple[Floats, Floats]:
    """Joints less those that lie outside of the picture, where the network can only guess. joints ``(..., n, 2)``."""
    out = np.asarray(((joints < 0) | (joints > np.asarray(size))).any(axis=-1))
    return np.where(out[..., None], np.nan, joints), np.where(out, 0.0, confidence)


def _clip(task: VideoPlan, seen: Sightings, rows: Indices, frames: Indices, name: str, meta: dict[str, Any]) -> Clip:
    """One person in these frames, NaN and confidence 0 where it is not seen."""
    joints = np.full((len(frames), JOINTS, 2), np.nan, dtype=np.float32)
    confidence = np.zeros((len(frames), JOINTS), dtype=np.float32)
    at = seen.at[rows] - frames[0]
    joints[at], confidence[at] = in_view(seen.joints[rows], seen.confidence[rows], (task.info.width, task.info.height))
    times = seen.times[frames]
    return Clip(joints, times, confidence, name=name, skeleton=BLAZEPOSE33, up="-y", meta={**meta, "model": task.model})
