"""A grey video as the direct method reads it: small 8-bit frames and their times, from an array or from chunks of any number."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

LARGEST = 320  # px of the longer side kept: a person a quarter as tall as a 1080p image keeps 45 px
FEWEST = 20  # frames
SMALLEST = 16  # px of the shorter side
BLOCK = 8  # frames converted at once: stays in the cache
LUMA = (0.299, 0.587, 0.114)  # ITU-R BT.601


@dataclass(frozen=True, eq=False)
class Take:
    """What is kept of a video.

    Attributes:
        frames: ``(T, h, w)`` uint8, the longer side at most LARGEST; of a stream, in a file that goes with the object.
        times: ``(T,)`` float64 seconds, increasing.
        scale: pixels here per pixel of the video.
        name: for messages.
    """

    frames: Tensor
    times: Tensor
    scale: float
    name: str

    @property
    def fps(self) -> float:
        """Frames per second, by the median step."""
        return float(1 / self.times.diff().median())


def take(source: Any, name: str, fps: float | None = None, times: Any = None) -> Take:
    """Read a video once.

    Args:
        source: ``(frames, h, w)`` uint8 or float (0..1 or 0..255), an array or a tensor, colour as ``(frames, h, w, 3)``; or an
            iterable of such chunks, or of pairs (chunk, times of its frames).
        name: for messages.
        fps: frames per second where there are no times.
        times: ``(frames,)`` seconds.

    Raises:
        ValueError: something else, missing values, fewer than 20 frames, no times at all, or times that do not increase.
    """
    spool = _Spool(name)
    if not isinstance(source, (np.ndarray, Tensor)):
        with tempfile.TemporaryFile() as file:
            stamps = [stamp for stamp in (spool.add(part, file) for part in _parts(source, name)) if stamp is not None]
            spool.check()
            file.flush()
            frames = torch.from_numpy(np.memmap(file, np.uint8, "r+", shape=(spool.count, *spool.size)))
        if stamps and times is None:
            times = np.concatenate(stamps)
    else:
        if source.ndim < 3:
            raise ValueError(f"{name}: expected grey frames (frames, h, w), got an array of shape {tuple(source.shape)}")
        small = [spool.small(source[begin : begin + BLOCK]) for begin in range(0, max(len(source), 1), BLOCK)]
        spool.check()
        frames = torch.cat(small)
    return Take(frames, _times(times, fps, len(frames), name), spool.scale, name)


def _parts(source: Any, name: str) -> Iterator[Any]:
    if isinstance(source, (str, bytes)) or not isinstance(source, Iterable):
        raise ValueError(
            f"{name}: expected grey frames (frames, h, w) or an iterable of chunks, got {type(source).__name__}; "
            "read a file first, for example with indexing.video.read_video(path)"
        )
    return iter(source)


class _Spool:
    """Checks chunks, makes them small, and counts."""

    def __init__(self, name: str) -> None:
        self.name, self.count, self.size, self.given, self.scale = name, 0, (0, 0), (0, 0), 1.0
        self.white: float | None = None

    def add(self, part: Any, file: Any) -> Any:
        """Write a chunk to a file; its times, where it has any."""
        stamps = None
        if isinstance(part, tuple) and len(part) == 2:
            part, stamps = part
            stamps = np.atleast_1d(np.asarray(stamps, dtype=np.float64))
        chunk = torch.as_tensor(part)
        chunk = chunk[None] if chunk.ndim == 2 else chunk
        if stamps is not None and len(stamps) != len(chunk):
            raise ValueError(f"{self.name}: a chunk of {len(chunk)} frames has {len(stamps)} times; give one per frame")
        for begin in range(0, len(chunk), BLOCK):
            file.write(self.small(chunk[begin : begin + BLOCK]).numpy().tobytes())
        return stamps

    def small(self, frames: Any) -> Tensor:
        """``(n, h, w)`` uint8 of a chunk."""
        grey = self._grey(torch.as_tensor(frames))
        size = (grey.shape[1], grey.shape[2])
        if self.count == 0:
            self.given, self.scale = size, min(1.0, LARGEST / max(size))
            self.size = (max(1, round(size[0] * self.scale)), max(1, round(size[1] * self.scale)))
            if min(self.size) < SMALLEST:
                raise ValueError(
                    f"{self.name}: frames of {size[1]} x {size[0]} px are too small or too narrow; {SMALLEST} px are needed"
                )
        elif size != self.given:
            raise ValueError(
                f"{self.name}: frame {self.count} has {size[1]} x {size[0]} px, those before {self.given[1]} x {self.given[0]}"
            )
        self.count += len(grey)
        if self.size != size:
            grey = adaptive_avg_pool2d(_binned(grey, int(1 / self.scale)), self.size).round_()
        return grey.to(torch.uint8)

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

    def check(self) -> None:
        """Raise where there are too few frames."""
        if self.count < FEWEST:
            raise ValueError(f"{self.name}: {self.count} frames; at least {FEWEST} are needed")


def _binned(frames: Tensor, cell: int) -> Tensor:
    """Means over cells of ``cell`` pixels; what fills no cell is left out.  Full HD: a quarter of `adaptive_avg_pool2d`'s time."""
    height, width = (n // cell for n in frames.shape[1:])
    rows = frames[:, : height * cell, : width * cell].unflatten(1, (height, cell))
    total = rows[:, :, 0].float() if frames.is_floating_point() else rows[:, :, 0].to(torch.int32)
    for k in range(1, cell):
        total = total + rows[:, :, k]
    return total.float().unflatten(2, (width, cell)).sum(3) / cell**2


def _times(times: Any, fps: float | None, frames: int, name: str) -> Tensor:
    if times is None:
        if fps is None:
            raise ValueError(f"{name}: neither fps nor times are given; say how many frames per second the video has")
        if not (np.isfinite(fps) and fps > 0):
            raise ValueError(f"{name}: fps must be a positive number, got {fps!r}")
        return torch.arange(frames, dtype=torch.float64) / fps
    stamps = torch.as_tensor(times, dtype=torch.float64)
    if stamps.shape != (frames,):
        raise ValueError(f"{name}: times must be one per frame, ({frames},), got {tuple(stamps.shape)}")
    if not bool(stamps.isfinite().all()) or not bool((stamps.diff() > 0).all()):
        raise ValueError(f"{name}: times must be finite and increase from frame to frame; sort the frames and drop repeated ones")
    return stamps
