"""Reading videos in chunks: upright frames and their exact times, in bounded memory."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from indexing.video.extra import av
from indexing.video.probing import (
    REMEDY,
    UNTIMED_FPS,
    Orientation,
    VideoInfo,
    cut_off,
    nothing_decoded,
    opened,
    orientation,
    packets,
    probe,
    untimed,
)


class Chunk(NamedTuple):
    """Consecutive frames of a video.

    Attributes:
        frames: ``(c, h, w)`` uint8 grey, or ``(c, h, w, 3)`` RGB.
        times: ``(c,)`` seconds, strictly increasing; the stream's first frame has 0.
    """

    frames: NDArray[np.uint8]
    times: NDArray[np.float64]


Source = str | Path | Iterable[Chunk]
"""What functions on videos accept: a path, a :class:`Video`, or chunks (a list can be read twice, a generator once)."""


class Video:
    """A video as an iterable of chunks; every ``for`` reads it from the beginning.  Made by :func:`read_video`.

    Attributes:
        notes: what was left out or made up in the last reading; complete when that has ended.
        scale: pixels of these frames per pixel of the video as shown, ``(x, y)``; known when reading has begun.
    """

    def __init__(
        self,
        path: str | Path,
        gray: bool,
        size: int | tuple[int, int] | None,
        span: tuple[float, float],
        chunk: int,
        fps: float | None,
    ):
        self.path = Path(path)
        self.gray, self.size, self.span, self.chunk, self.fps = gray, size, span, chunk, fps
        self.notes: tuple[str, ...] = ()
        self.scale = (1.0, 1.0)

    @cached_property
    def info(self) -> VideoInfo:
        """What the whole file holds; see :func:`indexing.video.probe`."""
        return probe(self.path, fps=self.fps)

    def __iter__(self) -> Iterator[Chunk]:
        frames: list[NDArray[np.uint8]] = []
        times: list[float] = []
        for image, time in self._frames():
            frames.append(image)
            times.append(time)
            if len(frames) == self.chunk:
                yield Chunk(np.stack(frames), np.array(times))
                frames, times = [], []
        if frames:
            yield Chunk(np.stack(frames), np.array(times))

    def _frames(self) -> Iterator[tuple[NDArray[np.uint8], float]]:
        """Upright frames of the span, one by one, with their times."""
        self.notes = ()
        start, stop = self.span
        with opened(self.path) as (container, stream):
            clock = _Clock(stream, self.fps)
            if start > 0 and stream.start_time is not None:
                _seek(container, stream, start)
            decoder = _Decoder(container, stream)
            shape: _Shape | None = None
            last, seen, ended = -math.inf, 0, False
            for frame in decoder:
                time = clock(frame)
                if ended := time >= stop:
                    break
                if time <= last or time < start:
                    clock.repeated += time <= last
                    continue
                if shape is None:
                    shape = _Shape(frame, self.size, self.gray)
                    self.scale = shape.scale
                yield shape(frame), time
                last, seen = time, seen + 1
            self.notes = decoder.notes + clock.notes + (() if shape is None else shape.notes)
            claimed = stream.duration * float(stream.time_base) if stream.duration else None
        if not ended and last > -math.inf:
            self.notes += tuple(cut_off(claimed, last))
        if not decoder.received:
            raise nothing_decoded(self.path, decoder.lost)
        if not seen:
            raise ValueError(
                f"video {str(self.path)!r}: no frame between {start:g} and {stop:g} s; its last frame is at {clock.latest:.2f} s"
            )


def read_video(
    path: str | Path,
    *,
    gray: bool = True,
    size: int | tuple[int, int] | None = None,
    start: float | None = None,
    stop: float | None = None,
    chunk: int = 64,
    fps: float | None = None,
) -> Video:
    """Read a video chunk by chunk, upright and with the exact time of every frame.

    Frames are turned (and mirrored) as the file asks for; ten bit, alpha, odd sizes and paletted pictures become 8 bit grey or RGB.
    Times are the file's presentation timestamps less the stream's start: the first frame has time 0 whatever the container's
    clock, and a variable frame rate is kept as it is.  A damaged file gives what can be decoded; ``notes`` say what is missing.

    Args:
        path: of the file.
        gray: ``(c, h, w)`` grey; otherwise ``(c, h, w, 3)`` RGB.
        size: the longest side in pixels (never enlarged), or exactly (width, height) as shown; default: as it is.
        start: seconds; earlier frames are left out.
        stop: seconds; frames at this time and later are left out.
        chunk: frames per chunk, the last one may be shorter: memory is that of one chunk.
        fps: frames per second of a file without timestamps (raw H.264); default 30, and a note says so.

    Returns:
        an iterable of :class:`Chunk` (frames, times) with ``info`` and ``notes``.

    Raises:
        ValueError: no such file, not a video, nothing decodable, or an option makes no sense.

    Example:
        >>> read_video("nothing.mp4")
        Traceback (most recent call last):
        ...
        ValueError: video 'nothing.mp4': no such file; check the path
    """
    span = (0.0 if start is None else float(start), math.inf if stop is None else float(stop))
    if not 0 <= span[0] < span[1]:
        raise ValueError(f"read_video: start and stop must be 0 <= start < stop in seconds, got start={start!r}, stop={stop!r}")
    if chunk < 1:
        raise ValueError(f"read_video: chunk must be at least 1 frame, got {chunk!r}")
    if fps is not None and not 0 < fps < math.inf:
        raise ValueError(f"read_video: fps must be a positive number of frames per second, got {fps!r}")
    if size is not None and min(size if isinstance(size, tuple) else (size,)) < 8:
        raise ValueError(f"read_video: size must be at least 8 pixels, got {size!r}")
    with opened(path):
        return Video(path, gray, size, span, chunk, fps)


def chunks(source: Source, **options: Any) -> Iterable[Chunk]:
    """The chunks of a source; ``options`` are those of :func:`read_video` and count for paths alone."""
    return read_video(source, **options) if isinstance(source, (str, Path)) else source


class _Clock:
    """Seconds since the stream's start."""

    def __init__(self, stream: Any, fps: float | None):
        self.base, self.zero = float(stream.time_base), stream.start_time
        self.fps = fps
        self.made_up = self.count = self.repeated = 0
        self.latest = 0.0

    def __call__(self, frame: Any) -> float:
        if frame.pts is None:
            self.latest += 1 / (self.fps or UNTIMED_FPS) if self.count else 0.0
            self.made_up += 1
        else:
            self.zero = frame.pts if self.zero is None else self.zero
            self.latest = (frame.pts - self.zero) * self.base
        self.count += 1
        return self.latest

    @property
    def notes(self) -> tuple[str, ...]:
        """What was made up."""
        notes = (untimed(self.fps),) if self.made_up > self.count / 2 else ()
        return notes + ((f"{self.repeated} frames not later than the one before are left out",) if self.repeated else ())


class _Decoder:
    """Frames of a stream for as long as anything can be decoded."""

    def __init__(self, container: Any, stream: Any):
        self.container, self.stream = container, stream
        self.received = self.lost = self.corrupt = 0
        self.failed: list[str] = []

    def __iter__(self) -> Iterator[Any]:
        for packet in packets(self.container, self.stream, self.failed):
            try:
                frames = packet.decode()
            except av().FFmpegError:
                self.lost += 1
                continue
            for frame in frames:
                if frame.is_corrupt:
                    self.corrupt += 1
                    continue
                self.received += 1
                yield frame

    @property
    def notes(self) -> tuple[str, ...]:
        """What went wrong."""
        notes = [f"reading stopped early: {text}; {REMEDY}" for text in self.failed]
        if self.lost or self.corrupt:
            notes.append(f"{self.lost + self.corrupt} damaged frames are left out ({self.received} were decoded); {REMEDY}")
        return tuple(notes)


class _Shape:
    """Turns PyAV's frames into arrays of one shape, that of the first frame."""

    def __init__(self, frame: Any, size: int | tuple[int, int] | None, gray: bool):
        self.upright: Orientation = orientation(frame)
        self.format = "gray" if gray else "rgb24"
        self.stored = (frame.width, frame.height)
        self.changed = 0
        shown = self.upright.size(*self.stored)
        if isinstance(size, int):
            by = min(1.0, size / max(shown))
            size = (max(1, round(by * shown[0])), max(1, round(by * shown[1])))
        to = size or shown
        self.scale = (to[0] / shown[0], to[1] / shown[1])
        self.target = self.upright.size(*to)

    def __call__(self, frame: Any) -> NDArray[np.uint8]:
        self.changed += (frame.width, frame.height) != self.stored
        small = frame.reformat(*self.target, format=self.format, interpolation="AREA")
        return np.ascontiguousarray(self.upright(small.to_ndarray()))

    @property
    def notes(self) -> tuple[str, ...]:
        """What was changed."""
        return (f"{self.changed} frames of another size than the first were brought to its size",) if self.changed else ()


def _seek(container: Any, stream: Any, start: float) -> None:
    """Go to the key frame before ``start`` seconds, where the file allows for it; otherwise stay."""
    try:
        container.seek(stream.start_time + int(start / stream.time_base), stream=stream, backward=True)
    except av().FFmpegError:
        container.seek(stream.start_time, stream=stream, backward=True)
