"""A video as pieces that are worked one by one, by one worker or several, and kept on the disk until all are there.

Where a video is cut depends on the video alone, and every piece begins with a tracker of its own: the same people come out whatever
number of workers there is, and however often the work was interrupted.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing.clip import check_fps
from indexing.files import prepare, replacing
from indexing.opening import error, open_file, size_of
from indexing.pose.blazepose import JOINTS, Floats, VideoPicture
from indexing.pose.networks import Networks
from indexing.pose.tracking import PoseOptions, Sighting, Sightings, Tracker
from indexing.readers.npz import NumpyArchive
from indexing.video.reading import Video, VideoInfo, frame_times

HEAD_BLOCK = 2**20  # bytes at both ends of a file that tell it from others
VERSION = 2  # of the way from pictures to joints: what another one made is not used

Stop = Callable[[], bool]


@dataclass(frozen=True, eq=False)
class Piece:
    """Frames of a video that one worker looks at."""

    number: int  # of the piece
    frames: NDArray[np.int64]  # numbers of the frames that count, from 0
    lead: NDArray[np.int64]  # numbers of frames before these that are looked at, too


@dataclass(frozen=True, eq=False)
class VideoPlan:
    """A video and how it is cut."""

    path: Path
    info: VideoInfo
    fps: float | None
    times: Floats  # ``(frames,)`` seconds of every frame that the file announces
    people: int
    every: int
    model: str  # name of the networks
    pieces: tuple[Piece, ...]  # in order; together they hold every frame that is looked at
    options: PoseOptions
    content: str  # of the video, as a hash
    made_from: str  # what the result depends on, as a short hash: the video's content, the networks, and every option

    @property
    def frames(self) -> int:
        """Frames to look at."""
        return sum(len(piece.frames) for piece in self.pieces)


def plan(path: Path, people: int, every: int, fps: float | None, model: str, options: PoseOptions) -> VideoPlan:
    """Look at a video file, and cut it."""
    if fps is not None:
        check_fps(fps, f"{path}: ")
    info, times = frame_times(path, fps=fps)
    numbers = np.flatnonzero(times >= 0)
    wanted = numbers[::every] if len(numbers) else np.arange(len(times))[::every]
    # where the file has no times there is no way to go to one
    cuts = split_times(times[wanted], options) if info.timed else [(0, 0, len(wanted))]
    pieces = tuple(Piece(number, wanted[a:b], wanted[lead:a]) for number, (lead, a, b) in enumerate(cuts))
    content = content_of(path)
    about = (VERSION, content, model, people, every, fps, options)
    made_from = hashlib.sha256(repr(about).encode()).hexdigest()[:16]
    return VideoPlan(path, info, fps, times, people, every, model, pieces, options, content, made_from)


def split_times(times: Floats, options: PoseOptions) -> list[tuple[int, int, int]]:
    """Where each piece's lead begins, where it begins, and where it ends."""
    if not len(times):
        return []
    number = np.floor((times - times[0]) / options.chunk_seconds + 1e-9).astype(np.int64)
    starts = np.flatnonzero(np.diff(number, prepend=-1))
    leads = np.searchsorted(times, times[starts] - options.lead_seconds - 1e-9)
    ends = np.append(starts[1:], len(times))
    return [(int(a), int(b), int(c)) for a, b, c in zip(leads, starts, ends, strict=True)]


def content_of(path: Path) -> str:
    """What tells a file from others: its size, and what stands at both its ends."""
    size = size_of(path)
    hashed = hashlib.sha256(str(size).encode())
    with open_file(path) as stream:
        hashed.update(stream.read(HEAD_BLOCK))
        stream.seek(max(0, size - HEAD_BLOCK))
        hashed.update(stream.read(HEAD_BLOCK))
    return hashed.hexdigest()


class Stopped(Exception):
    """The work was to be stopped."""


class PieceLost(ValueError):
    """No frame of a piece can be decoded, and trying again will not help."""


def work(task: VideoPlan, piece: Piece, networks: Networks, moved: Callable[[], None], stop: Stop = lambda: False) -> Sightings:
    """Look at the frames of a piece."""
    tracker, kept = Tracker(networks, task.people, task.options), _Gathered()
    both = np.concatenate([piece.lead, piece.frames])
    edge = np.diff(task.times).min(initial=1.0) / 2
    span = max(0.0, float(task.times[both[0]] - edge)), float(task.times[both[-1]] + edge)
    video = Video(task.path, False, None, span, 1, task.fps)
    counted, looked = set(piece.frames.tolist()), set(both.tolist())
    size: tuple[int, int] | None = None
    changed, reformat = 0, import_module("av.video.reformatter").VideoReformatter().reformat
    for frame, time in _decode(task, video):
        if stop():
            raise Stopped
        size = size or (frame.width, frame.height)
        changed += (frame.width, frame.height) != size
        number = nearest(task.times, time)
        if number not in looked:
            continue
        looked.discard(number)
        seen = tracker.step(VideoPicture(frame, size, reformat), time)
        if number in counted:
            kept.add(time, seen)
            moved()
    if looked:  # frames that the file had when it was looked at first
        _check_unchanged(task)
    notes = [*video.notes, *([f"{changed} frames of another size than the first were brought to its size"] if changed else [])]
    return kept.sightings(tracker.crowd, notes)


def _decode(task: VideoPlan, video: Video) -> Iterator[tuple[Any, float]]:
    """The frames of a video as they are stored, and their times."""
    try:
        yield from video.stored_frames()
    except ValueError as problem:
        _check_unchanged(task)
        raise PieceLost(*problem.args) from problem


def _check_unchanged(task: VideoPlan) -> None:
    """Raise where the file is gone, cannot be read any more, or is another one than it was."""
    if content_of(task.path) != task.content:
        raise error(task.path, "has changed while it was worked", "start again when it is complete")


def nearest(times: Floats, time: float) -> int:
    """Which of increasing times is the nearest one."""
    after = int(np.searchsorted(times, time))
    if after == 0 or (after < len(times) and times[after] - time < time - times[after - 1]):
        return after
    return after - 1


@dataclass
class _Gathered:
    """What was seen so far."""

    times: list[float] = field(default_factory=list)
    seen: list[list[Sighting]] = field(default_factory=list)

    def add(self, time: float, seen: list[Sighting]) -> None:
        self.times.append(time)
        self.seen.append(seen)

    def sightings(self, crowd: list[int], notes: Sequence[str]) -> Sightings:
        flat = [one for seen in self.seen for one in seen]
        joints = np.array([one.joints for one in flat], dtype=np.float32).reshape(-1, JOINTS, 2)
        confidence = np.array([one.confidence for one in flat], dtype=np.float32).reshape(-1, JOINTS)
        at = np.repeat(np.arange(len(self.seen)), [len(seen) for seen in self.seen]).astype(np.int64)
        tracks = np.array([one.track for one in flat], dtype=np.int64)
        return Sightings(np.array(self.times), at, tracks, joints, confidence, np.array(crowd, dtype=np.int64), tuple(notes))


# ----------------------------------------------------------------------------------------------------------------------
# Pieces on the disk, in a hidden folder beside what is made of them.


class Store:
    """Finished pieces of one video."""

    def __init__(self, folder: Path, task: VideoPlan) -> None:
        self.folder, self.task = folder, task
        self._lock = threading.Lock()

    def _path(self, piece: Piece) -> Path:
        return self.folder / f"{self.task.made_from}-{piece.number:06d}.npz"

    def get(self, piece: Piece) -> Sightings | None:
        """A piece that was finished before, if it is whole."""
        try:
            data = NumpyArchive(self._path(piece))
            times, at, tracks, joints = data["times"], data["at"], data["tracks"], data["joints"]
            notes = tuple(map(str, data["notes"]))
            found = Sightings(times, at, tracks, joints, data["confidence"], data["crowd"], notes)
        except (ValueError, KeyError):
            return None
        return found if len(found.joints) == len(found.at) == len(found.tracks) == len(found.confidence) else None

    def save(self, piece: Piece, seen: Sightings) -> None:
        """Keep a finished piece."""
        with self._lock:
            if not self.folder.is_dir():
                prepare(self.folder)
            for other in self.folder.glob("*.npz"):
                if not other.name.startswith(self.task.made_from):
                    with suppress(OSError):  # it is only in the way
                        other.unlink()
        with replacing(self._path(piece)) as stream:
            np.savez(
                stream, times=seen.times, at=seen.at, tracks=seen.tracks, joints=seen.joints, confidence=seen.confidence,
                crowd=seen.crowd, notes=np.array(seen.notes, dtype=np.str_),
            )  # fmt: skip
