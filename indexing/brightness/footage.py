"""Videos as users hand them in, arrays, files or chunks with times, chunk by chunk and at one frame rate."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

BLOCK = 32  # frames at once: memory is that of one block
FILE_BLOCK = 8  # of files: frames of 4K take 8 MB each
UNEVEN = 0.2  # of the median step, between the shortest and the longest: as for files, a tenth of a frame to either side
PAUSE = 10.0  # seconds without a frame, for which none are interpolated: what a video costs is told by its frames
SAME_RATE = 0.01  # relative difference of frame rates that is none (29.97 and 30)

Times = NDArray[np.float64]


@dataclass(frozen=True)
class Footage:
    """A video that can be read any number of times.

    Attributes:
        source: an array, the path of a file, a :class:`indexing.video.Video`, or a list of chunks (frames, times).
        name: for messages.
        fps: frames per second of arrays.
    """

    source: Any
    name: str
    fps: float

    def __iter__(self) -> Iterator[tuple[Any, Times]]:
        """Chunks of frames as they are, and the seconds at which they were taken."""
        if isinstance(self.source, Path):
            from indexing.video import read_video  # needs PyAV, an extra

            yield from read_video(self.source, chunk=FILE_BLOCK, fps=self.fps)
            return
        if not _is_array(self.source):
            yield from self.source
            return
        for begin in range(0, len(self.source), BLOCK):
            part = self.source[begin : begin + BLOCK]
            yield part, (begin + np.arange(len(part))) / self.fps

    @property
    def own_rate(self) -> float | None:
        """Frames per second where they are not those of arrays; NaN where they vary."""
        if _is_array(self.source):
            return None
        if isinstance(self.source, list):
            steps = np.diff(np.concatenate([chunk.times for chunk in self.source]))
            if not len(steps):
                return None
            return float("nan") if np.ptp(steps) > UNEVEN * np.median(steps) else float(1 / np.median(steps))
        return float("nan") if self._info.variable else float(self._info.fps)

    @property
    def span(self) -> tuple[float, float]:
        """Seconds of the first and of the last frame, about."""
        if _is_array(self.source):
            return 0.0, (len(self.source) - 1) / self.fps
        if isinstance(self.source, list):
            return float(self.source[0].times[0]), float(self.source[-1].times[-1])
        start, stop = getattr(self.source, "span", (0.0, math.inf))
        return start, min(stop, self._info.duration)

    @cached_property
    def _info(self) -> Any:
        if not isinstance(self.source, Path):
            return self.source.info
        from indexing.video import probe

        return probe(self.source, fps=self.fps)


def gather(videos: Any, fps: float) -> list[Footage]:
    """The videos of a list.

    Raises:
        ValueError: no list, an empty one, or an item that is no video.
    """
    if isinstance(videos, (str, bytes, Path)) or not isinstance(videos, Iterable):
        raise ValueError(f"videos: expected a list of arrays or paths, got {type(videos).__name__}; use a list: [video]")
    found = [footage(video, f"video {i}", fps) for i, video in enumerate(videos)]
    if not found:
        raise ValueError("videos: the list is empty; give at least one video")
    return found


def footage(video: Any, name: str, fps: float) -> Footage:
    """One video.

    Raises:
        ValueError: neither a path, nor frames.
    """
    if isinstance(video, (str, Path)):
        return Footage(Path(video), f"{name} ({str(video)!r})", fps)
    if _is_read(video):
        return Footage(video if not isinstance(video, tuple) else list(video), name, fps)
    if isinstance(video, (list, tuple)) and video and all(isinstance(v, (np.ndarray, Tensor)) for v in video):
        sizes = {tuple(v.shape) for v in video}
        if len(sizes) > 1:
            raise ValueError(f"{name}: frames of different sizes, {sorted(sizes)[0]} and {sorted(sizes)[1]}; use one size")
        video = torch.stack([torch.as_tensor(v) for v in video])
    if not isinstance(video, (np.ndarray, Tensor)):
        raise ValueError(f"{name}: expected an array (frames, height, width) or the path of a file, got {type(video).__name__}")
    if video.ndim not in (3, 4) or len(video) == 0:
        raise ValueError(f"{name}: expected grey frames (frames, height, width) or colour (..., 3), got shape {tuple(video.shape)}")
    return Footage(video, name, fps)


def _is_array(source: Any) -> bool:
    return isinstance(source, (np.ndarray, Tensor))


def _is_read(video: Any) -> bool:
    """Whether something is what :mod:`indexing.video` reads: a video, or a list of chunks of one."""
    if isinstance(video, (list, tuple)):
        return bool(video) and all(hasattr(chunk, "frames") and len(chunk.frames) == len(chunk.times) > 0 for chunk in video)
    return hasattr(video, "info") and hasattr(video, "span")


class Resampler:
    """Frames at the times of an even grid, interpolated between the frame before and the one after.

    Args:
        rate: frames per second of the grid.
        fps: of the video: ``None`` where it is that of the grid, NaN where it varies.
    """

    def __init__(self, rate: float, fps: float | None) -> None:
        self.step, self.made = 1 / rate, 0
        self.off = fps is not None and not abs(fps / rate - 1) <= SAME_RATE
        self.last: tuple[Tensor, float] | None = None
        self.begin = 0.0

    def push(self, frames: Tensor, times: Times) -> tuple[Tensor, list[int]]:
        """Frames of the grid that are known by now, and how many of these after each pushed frame."""
        if not self.off:
            return frames, list(range(1, len(frames) + 1))
        out: list[Tensor] = []
        counts = []
        if self.last is None and len(times):
            self.begin = float(times[0])
        for frame, time in zip(frames, (times - self.begin).tolist(), strict=True):
            before, start = self.last or (frame, time - self.step)
            if time - start > PAUSE:  # nothing is made up for it, whatever its length
                before, start, self.made = frame, time - self.step, math.ceil(time / self.step - 1e-9)
            while self.made * self.step <= time + 1e-9:
                share = (self.made * self.step - start) / (time - start)
                out.append(torch.lerp(before, frame, min(1.0, share)))
                self.made += 1
            self.last = frame, time
            counts.append(len(out))
        return (torch.stack(out) if out else frames[:0]), counts
