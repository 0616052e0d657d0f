"""Frames of any kind as small grey ones: checked, turned to grey, and averaged over areas."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, avg_pool2d

BLOCK = 8  # frames converted at once: stays in the cache
LUMA = (0.299, 0.587, 0.114)  # ITU-R BT.601


class Shrinker:
    """Turns chunks of one video into small grey frames; all chunks must have frames of one size and kind.

    Args:
        name: of the video, for messages.
        largest: pixels of the longer side kept; smaller frames stay as they are.
        smallest: pixels of the shorter side, below which a video is refused.

    Attributes:
        count: frames so far.  size: height and width of the small frames.  scale: pixels there per pixel of the video.
    """

    def __init__(self, name: str, largest: int, smallest: int) -> None:
        self.name, self.largest, self.smallest = name, largest, smallest
        self.count, self.size, self.given, self.scale = 0, (0, 0), (0, 0), 1.0
        self.white: float | None = None

    def __call__(self, frames: Any) -> Tensor:
        """``(n, h, w)`` float32 in 0..255 of a chunk of grey or colour frames.

        Raises:
            ValueError: naming the video: wrong shape, type or size, NaN, grey levels out of range.
        """
        chunk = torch.as_tensor(frames)
        return torch.cat([self._small(chunk[begin : begin + BLOCK]) for begin in range(0, max(len(chunk), 1), BLOCK)])

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
        return grey.float() if self.size == size else adaptive_avg_pool2d(binned(grey, int(1 / self.scale)), self.size)

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


def binned(frames: Tensor, cell: int) -> Tensor:
    """``(n, h // cell, w // cell)`` means over cells of ``cell`` pixels; what fills no cell is left out.

    Rows are summed in integers first: 640 x 480 to 80 x 60 takes a third of `avg_pool2d`'s time.

    Example:
        >>> binned(torch.arange(8, dtype=torch.uint8).view(1, 2, 4), 2).tolist()
        [[[2.5, 4.5]]]
    """
    height, width = (n // cell for n in frames.shape[1:])
    rows = frames[:, : height * cell, : width * cell].unflatten(1, (height, cell))
    total = rows.sum(2) if frames.is_floating_point() else rows.sum(2, dtype=torch.int32)
    return avg_pool2d(total.float(), (1, cell)) / cell
