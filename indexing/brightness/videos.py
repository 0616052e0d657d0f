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
from torch.nn.functional import adaptive_avg_pool2d, avg_pool2d

MAX_PAUSE_SECONDS = 10.0  # without a frame, up to which frames are interpolated: what a video costs is told by its frames
SAME_RATE = 0.01  # relative difference of frame rates that is none (29.97 and 30)


BLOCK = 32  # frames at once: memory is that of one block
FILE_BLOCK = 8  # of files: frames of 4K take 8 MB each
UNEVEN = 0.2  # of the median step, between the shortest and the longest: as for files, a tenth of a frame to either side

Times = NDArray[np.float64]


@dataclass(frozen=True)
class Footage:
    """A video that can be read any number of times."""

    source: Any  # an array, the path of a file, a :class:`indexing.video.Video`, or a list of chunks (frames, times)
    name: str  # for messages
    fps: float  # frames per second of arrays

    def __iter__(self) -> Iterator[tuple[Any, Times]]:
        """Chunks of frames as they are, and the seconds at which they were taken."""
        if isinstance(self.source, Path):
            from indexing.video import read_video

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
    """The videos of a list."""
    if isinstance(videos, (str, bytes, Path)) or not isinstance(videos, Iterable):
        raise ValueError(f"videos: expected a list of arrays or paths, got {type(videos).__name__}; use a list: [video]")
    found = [footage(video, f"video {i}", fps) for i, video in enumerate(videos)]
    if not found:
        raise ValueError("videos: the list is empty; give at least one video")
    return found


def footage(video: Any, name: str, fps: float) -> Footage:
    """One video."""
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
    """Frames at the times of an even grid, interpolated between the frame before and the one after."""

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
            if time - start > MAX_PAUSE_SECONDS:  # nothing is made up for it, whatever its length
                before, start, self.made = frame, time - self.step, math.ceil(time / self.step - 1e-9)
            while self.made * self.step <= time + 1e-9:
                share = (self.made * self.step - start) / (time - start)
                out.append(torch.lerp(before, frame, min(1.0, share)))
                self.made += 1
            self.last = frame, time
            counts.append(len(out))
        return (torch.stack(out) if out else frames[:0]), counts


# ----------------------------------------------------------------------------------------------------------------------
# Frames of any kind as small grey ones: checked, turned to grey, and averaged over areas.


SHRINKING_BLOCK = 8  # frames converted at once: stays in the cache
LUMA = (0.299, 0.587, 0.114)  # ITU-R BT.601


class Shrinker:
    """Turns chunks of one video into small grey frames; all chunks must have frames of one size and kind."""

    def __init__(self, name: str, largest: int, smallest: int) -> None:
        self.name, self.largest, self.smallest = name, largest, smallest
        self.count, self.size, self.given, self.scale = 0, (0, 0), (0, 0), 1.0
        self.white: float | None = None

    def __call__(self, frames: Any) -> Tensor:
        """``(n, h, w)`` float32 in 0..255 of a chunk of grey or colour frames."""
        chunk = torch.as_tensor(frames)
        begins = range(0, max(len(chunk), 1), SHRINKING_BLOCK)
        return torch.cat([self._small(chunk[begin : begin + SHRINKING_BLOCK]) for begin in begins])

    def _small(self, frames: Tensor) -> Tensor:
        grey = self._grey(frames)
        size = (grey.shape[1], grey.shape[2])
        if self.count == 0:
            self._begin(size)
        elif size != self.given:
            raise ValueError(
                f"{self.name}: frame {self.count} has {size[1]} x {size[0]} px, those before {self.given[1]} x {self.given[0]}"
            )
        self.count += len(grey)
        return grey.float() if self.size == size else adaptive_avg_pool2d(bin_pixels(grey, int(1 / self.scale)), self.size)

    def _begin(self, size: tuple[int, int]) -> None:
        self.given, self.scale = size, min(1.0, self.largest / max(size))
        self.size = (max(1, round(size[0] * self.scale)), max(1, round(size[1] * self.scale)))
        if min(self.size) < self.smallest:
            raise ValueError(
                f"{self.name}: frames of {size[1]} x {size[0]} px are too small or too narrow; {self.smallest} px are needed"
            )

    def _grey(self, frames: Tensor) -> Tensor:
        """``(n, h, w)`` in 0..255, of any type."""
        if frames.ndim == 4 and frames.shape[-1] == 3:
            frames = frames.float() @ torch.tensor(LUMA) if frames.dtype == torch.uint8 else frames @ torch.tensor(LUMA).to(frames)
            frames = frames.clamp_(0, 255)
        elif frames.ndim != 3:
            raise ValueError(
                f"{self.name}: expected grey frames (h, w), or colour (h, w, 3), got frames of shape {tuple(frames.shape[1:])}; "
                "convert them to grey"
            )
        if frames.dtype == torch.uint8:
            return frames
        if not frames.is_floating_point():
            raise ValueError(f"{self.name}: frames are {frames.dtype}; convert them to uint8, or to floats from 0 to 1")
        if not bool(frames.isfinite().all()):
            raise ValueError(
                f"{self.name}: frames hold NaN or infinite values; fill them in, or leave these frames out and give times"
            )
        if self.white is None:
            self.white = 1.0 if frames.numel() and float(frames.max()) <= 1 else 255.0
        low, high = (float(frames.min()), float(frames.max())) if frames.numel() else (0.0, 0.0)
        if low < 0 or high > self.white:
            raise ValueError(
                f"{self.name}: grey levels from {low:g} to {high:g}; give uint8, or floats from 0 to 1 or 0 to 255 throughout"
            )
        return (frames * (255 / self.white)).round()


def bin_pixels(frames: Tensor, cell: int) -> Tensor:
    """``(n, h // cell, w // cell)`` means over cells of ``cell`` pixels; what fills no cell is left out."""
    height, width = (n // cell for n in frames.shape[1:])
    rows = frames[:, : height * cell, : width * cell].unflatten(1, (height, cell))
    total = rows.sum(2) if frames.is_floating_point() else rows.sum(2, dtype=torch.int32)
    return avg_pool2d(total.float(), (1, cell)) / cell
