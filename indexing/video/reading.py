"""Reading videos in chunks: upright frames and their exact times, in bounded memory."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from indexing.opening import size_of

# ----------------------------------------------------------------------------------------------------------------------
# The two packages of the extra ``video``, imported when they are needed and not before.


def av() -> Any:
    """PyAV: reads and writes video files."""
    return _load("av", "PyAV")


def cv2() -> Any:
    """OpenCV: finds points, follows them, warps pictures."""
    return _load("cv2", "OpenCV")


def _load(module: str, name: str) -> Any:
    try:
        return import_module(module)
    except ImportError as error:
        raise ValueError(f"video: {name} ({module}) cannot be imported ({error}); install 'dyntorch[video]'") from error


# ----------------------------------------------------------------------------------------------------------------------
# What a video file holds: size as shown, frames and their exact times; and opening one with errors that a person understands.


REMEDY = "copy it again from the camera, or convert it: ffmpeg -i IN -c:v libx264 OUT.mp4"
UNTIMED_FPS = 30.0  # of files without times, where nobody says otherwise
UNEVEN = 0.1  # frames that a time may be off the even grid before we call the rate variable: a tenth shows in a sub-frame shift
MISSING_END = (0.5, 0.02)  # seconds, and share of the length, that pictures may end before the file says they do


@dataclass(frozen=True)
class VideoInfo:
    """What a video file holds.

    Attributes:
        path: the file.
        width: pixels, as shown (after rotation).
        height: pixels, as shown.
        frames: how many there are; of several with one and the same time, one counts.
        duration: seconds from the first frame to the last.
        fps: frames per second by the timestamps: :math:`(\\text{frames} - 1) / \\text{duration}`.
        variable: whether the frames lie off an even grid by more than a tenth of a frame somewhere: then only times tell when
            a frame was taken, and frame number / fps does not.
        rotation: degrees clockwise by which frames are turned for showing (phones): 0, 90, 180 or 270.
        mirrored: whether they are mirrored as well (left-right, before turning).
        start: time of the first frame on the file's own clock, in seconds.  Times on this package's clock start there at 0.
        repeated: frames left out because they are not later than the frame before them.
        dropped: frames missing in gaps of the timestamps (of the median interval).
        codec: as FFmpeg calls it.
        notes: what a user should know.
        timed: whether the frames' times are the file's own.
    """

    path: Path
    width: int
    height: int
    frames: int
    duration: float
    fps: float
    variable: bool
    rotation: int
    mirrored: bool
    start: float
    repeated: int
    dropped: int
    codec: str
    notes: tuple[str, ...]
    timed: bool = True


@dataclass(frozen=True)
class Orientation:
    """How a stored frame is brought upright: transpose, then flip; covers all eight ways to hold (and mirror) a camera."""

    transpose: bool = False
    flip_x: bool = False
    flip_y: bool = False

    @property
    def is_mirrored(self) -> bool:
        """Whether no rotation alone does it."""
        return self.transpose ^ self.flip_x ^ self.flip_y

    @property
    def rotation(self) -> int:
        """Degrees clockwise, of what is done after the mirroring (left-right), if there is one."""
        # what a left-right mirror before the turn leaves: x flips along the stored x, which is the shown y after a transposition
        flip_x = self.flip_x ^ (self.is_mirrored and not self.transpose)
        return (90 if flip_x else 270) if self.transpose else (180 if flip_x else 0)

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The image ``(h, w, ...)`` upright."""
        if self.transpose:
            image = image.swapaxes(0, 1)
        return image[:: -1 if self.flip_y else 1, :: -1 if self.flip_x else 1]

    def size(self, width: int, height: int) -> tuple[int, int]:
        """(width, height) as shown of (width, height) as stored, and back."""
        return (height, width) if self.transpose else (width, height)


def orientation(frame: Any) -> Orientation:
    """How to bring PyAV's frame upright, by its display matrix (x' = a x + c y, y' = b x + d y in pixels, y down)."""
    for data in frame.side_data:
        if data.type.name == "DISPLAYMATRIX":
            a, b, _, c, d = np.frombuffer(bytes(data), np.int32)[:5].tolist()
            if abs(c) > abs(a):
                return Orientation(True, c < 0, b < 0)
            return Orientation(False, a < 0, d < 0)
    return Orientation()


@contextmanager
def open_video(path: str | Path) -> Iterator[tuple[Any, Any]]:
    """PyAV's container and its video stream."""
    name = repr(str(path))
    try:
        size = size_of(path)
    except ValueError as problem:
        raise ValueError(f"video {name}: {str(problem).removeprefix(f'{path}: ')}") from None
    try:
        # tags may hold other bytes than text, and a playlist may name other files, or what is on the net
        container = av().open(f"file:{path}", metadata_errors="replace", options={"protocol_whitelist": "file"})
    except (av().FFmpegError, OSError, ValueError) as error:
        cause = "is empty" if size == 0 else f"cannot be read as video ({_error_text(error)}): cut off, damaged, or no video"
        raise ValueError(f"video {name}: the file {cause}; {REMEDY}") from error
    with container:
        # cover pictures of audio files are video streams, too; and FFmpeg draws text files as pictures of themselves
        streams = [s for s in container.streams.video if not _is_cover(s)] if container.format.name != "tty" else []
        if not streams:
            has = ", ".join(sorted({s.type for s in container.streams})) if container.format.name != "tty" else "text"
            raise ValueError(f"video {name}: has no video stream (it has: {has or 'nothing'}); give a video file, or {REMEDY}")
        known = [s for s in streams if s.codec_context is not None]
        if not known:
            raise ValueError(f"video {name}: is packed by a codec that is not known here; {REMEDY}")
        stream = max(known, key=lambda s: (s.width or 0) * (s.height or 0))
        stream.thread_type = "AUTO"
        yield container, stream


def packets(container: Any, stream: Any, failed: list[str]) -> Iterator[Any]:
    """The stream's packets up to the end, or up to where the file cannot be read; then ``failed`` says why."""
    source = container.demux(stream)
    while True:
        try:
            yield next(source)
        except StopIteration:
            return
        except av().FFmpegError as error:
            failed.append(_error_text(error))
            return


def probe(path: str | Path, *, fps: float | None = None) -> VideoInfo:
    """Size, frames, times and orientation of a video file; reads the file once, and decodes its first frame only.

    Args:
        path: of the file.
        fps: frames per second of a file without timestamps (raw H.264); default 30, and a note says so.

    Raises:
        ValueError: the file cannot be read, or has no frame that can be decoded.

    Example:
        >>> probe("nothing.mp4")
        Traceback (most recent call last):
        ...
        ValueError: video 'nothing.mp4': no such file; check the path
    """
    return frame_times(path, fps=fps)[0]


def frame_times(path: str | Path, *, fps: float | None = None) -> tuple[VideoInfo, NDArray[np.float64]]:
    """What :func:`probe` says, and when every frame is shown: ``(frames,)`` seconds on the clock of :func:`read_video`."""
    failed: list[str] = []
    stamps: list[int | None] = []
    first = None
    with open_video(path) as (container, stream):
        for packet in packets(container, stream, failed):
            if packet.size and not packet.is_discard:
                stamps.append(packet.pts)
            if first is None:
                with suppress(av().FFmpegError):
                    first = next(iter(packet.decode()), None)
        if first is None:
            raise nothing_decoded(path, len(stamps))
        upright = orientation(first)
        width, height = upright.size(first.width, first.height)
        base, zero = float(stream.time_base), stream.start_time
        nominal = float(stream.average_rate or stream.guessed_rate or 0)
        claimed = _declared_duration(container, stream)
        codec = stream.codec_context.name
    timed = np.sort(np.array([s for s in stamps if s is not None], np.float64)) * base
    notes = [f"reading stopped early: {text}" for text in failed]
    has_times = len(timed) >= 0.5 * len(stamps)
    if not has_times:
        notes.append(assumed_rate_note(fps))
        timed, zero, nominal = np.arange(len(stamps)) / (fps or UNTIMED_FPS), 0, 0.0
    start = timed[0] if zero is None else zero * base
    times = np.unique(timed)
    uneven, dropped = evenness(times, base)
    duration = float(times[-1] - times[0])
    repeated = len(timed) - len(times)
    notes += _notes(uneven, dropped, repeated, claimed, times[-1] - start, upright)
    info = VideoInfo(
        path=Path(path), width=width, height=height, frames=len(times), duration=duration,
        fps=(len(times) - 1) / duration if duration else nominal, variable=uneven > UNEVEN,
        rotation=upright.rotation, mirrored=upright.is_mirrored, start=float(start), repeated=repeated, dropped=dropped,
        codec=codec, notes=tuple(notes), timed=has_times,
    )  # fmt: skip
    return info, times - start


def evenness(times: NDArray[np.float64], tick: float = 0.0) -> tuple[float, int]:
    """How far times lie off the even grid from first to last, in frames, and how many frames are missing in gaps. times
    ``(frames,)``."""
    if len(times) < 3:
        return 0.0, 0
    grid = np.linspace(times[0], times[-1], len(times))
    off = np.clip(np.abs(times - grid) - tick, 0, None).max() * (len(times) - 1) / (times[-1] - times[0])
    steps = np.diff(times)
    usual = np.median(steps)
    missing = np.rint(steps / usual)[steps > 1.5 * usual + tick] - 1
    return float(off), int(missing.clip(0).sum())


def assumed_rate_note(fps: float | None) -> str:
    """The note for files without times."""
    return (
        f"the file has no timestamps: {fps:g} fps as given" if fps else f"the file has no timestamps: {UNTIMED_FPS:g} fps assumed"
    )


def nothing_decoded(path: str | Path, received: int) -> ValueError:
    """The error for files with not one frame."""
    cause = f"none of its {received} frames can be decoded" if received else "it has a video stream, but no frames: cut off?"
    return ValueError(f"video {str(path)!r}: {cause}; {REMEDY}")


def _declared_duration(container: Any, stream: Any) -> float | None:
    """Seconds that a file says its pictures last; of Matroska a text says so, or the length of all, where there is no sound."""
    if stream.duration:
        return float(stream.duration * stream.time_base)
    parts = str(stream.metadata.get("DURATION", "")).split(":")
    try:
        hours, minutes, seconds = (float(part) for part in parts)
        return 3600 * hours + 60 * minutes + seconds
    except ValueError:
        alone = len(container.streams) == 1 and container.duration
        return float(container.duration) / 1e6 if alone else None


def cut_off(claimed: float | None, end: float) -> list[str]:
    """A note where pictures end (``end`` seconds) well before the file says they do, else none."""
    if claimed is None or claimed - end < max(MISSING_END[0], MISSING_END[1] * claimed):
        return []
    return [f"the file says {claimed:.2f} s, but its pictures end at {end:.2f} s: cut off or damaged; what is there is used"]


def _notes(uneven: float, dropped: int, repeated: int, claimed: float | None, end: float, upright: Orientation) -> list[str]:
    notes = []
    if uneven > UNEVEN:
        gaps = f", {dropped} frames dropped" if dropped else ""
        notes.append(f"variable frame rate (frames up to {uneven:.1f} frames off an even grid{gaps}): timestamps are used")
    if repeated:
        notes.append(f"{repeated} frames repeat the time of another one and are left out")
    if upright.is_mirrored:
        notes.append("the file asks for mirrored pictures (selfie camera): shown mirrored, as the file says")
    return notes + cut_off(claimed, end)


def _is_cover(stream: Any) -> bool:
    return "attached_pic" in str(stream.disposition).lower()


def _error_text(error: BaseException) -> str:
    return str(getattr(error, "strerror", None) or error)


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
        shape: _Shape | None = None
        for frame, time in self.stored_frames():
            if shape is None:
                shape = _Shape(frame, self.size, self.gray)
                self.scale = shape.scale
            yield shape(frame), time
        self.notes += () if shape is None else shape.notes

    def stored_frames(self) -> Iterator[tuple[Any, float]]:
        """PyAV's own frames of the span, as they are stored (not turned, in the file's colours), one by one, with their times."""
        self.notes = ()
        start, stop = self.span
        with open_video(self.path) as (container, stream):
            clock = _Clock(stream, self.fps)
            if start > 0 and stream.start_time is not None:
                _seek(container, stream, start)
            decoder = _Decoder(container, stream)
            last, seen, ended = -math.inf, 0, False
            for frame in decoder:
                time = clock(frame)
                if ended := time >= stop:
                    break
                if time <= last or time < start:
                    clock.repeated += time <= last
                    continue
                yield frame, time
                last, seen = time, seen + 1
            self.notes = decoder.notes + clock.notes
            claimed = _declared_duration(container, stream)
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
    with open_video(path):
        return Video(path, gray, size, span, chunk, fps)


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
        notes = (assumed_rate_note(self.fps),) if self.made_up > self.count / 2 else ()
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
        # one for all frames: PyAV makes another one for each, which takes 3 ms of a frame of 1080x1920
        self._reformat = import_module("av.video.reformatter").VideoReformatter().reformat
        shown = self.upright.size(*self.stored)
        if isinstance(size, int):
            by = min(1.0, size / max(shown))
            size = (max(1, round(by * shown[0])), max(1, round(by * shown[1])))
        to = size or shown
        self.scale = (to[0] / shown[0], to[1] / shown[1])
        self.target = self.upright.size(*to)

    def __call__(self, frame: Any) -> NDArray[np.uint8]:
        self.changed += (frame.width, frame.height) != self.stored
        small = self._reformat(frame, *self.target, format=self.format, interpolation="AREA")
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
