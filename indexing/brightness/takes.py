"""A grey video as the direct method reads it: small 8-bit frames and their times, from an array or from chunks of any number."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from indexing.brightness.shrinking import BLOCK, Shrinker

LARGEST = 320  # px of the longer side kept: a person a quarter as tall as a 1080p image keeps 45 px
FEWEST = 20  # frames
SMALLEST = 16  # px of the shorter side


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
    spool = _Spool(name, LARGEST, SMALLEST)
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
        small = [spool.bytes(source[begin : begin + BLOCK]) for begin in range(0, max(len(source), 1), BLOCK)]
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


class _Spool(Shrinker):
    """Counts, and keeps 8-bit frames."""

    def add(self, part: Any, file: Any) -> Any:
        """Write a chunk to a file; its times, where it has any."""
        stamps = None
        if isinstance(part, tuple) and len(part) == 2:
            part, stamps = part
            stamps = np.atleast_1d(torch.as_tensor(stamps, dtype=torch.float64).numpy(force=True))
        chunk = torch.as_tensor(part).cpu()
        chunk = chunk[None] if chunk.ndim == 2 else chunk
        if stamps is not None and len(stamps) != len(chunk):
            raise ValueError(f"{self.name}: a chunk of {len(chunk)} frames has {len(stamps)} times; give one per frame")
        for begin in range(0, len(chunk), BLOCK):
            file.write(self.bytes(chunk[begin : begin + BLOCK]).numpy().tobytes())
        return stamps

    def bytes(self, frames: Any) -> Tensor:
        """``(n, h, w)`` uint8 of a chunk."""
        return self(frames).round_().to(torch.uint8)

    def check(self) -> None:
        """Raise where there are too few frames."""
        if self.count < FEWEST:
            raise ValueError(f"{self.name}: {self.count} frames; at least {FEWEST} are needed")


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
