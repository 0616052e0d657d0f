"""What the indexer sees of a video: one descriptor per frame, as the frames come in."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from indexing.brightness.motion_box import MEMORY, MotionBox
from indexing.brightness.motion_maps import MotionMaps
from indexing.brightness.pooling import CELLS, described, pooled, profile
from indexing.brightness.shrinking import Shrinker

SMALLEST = 16  # px of the shorter side
NEAR = 0.35  # of the image's height: the smallest box about what moves
SHARES = (0.25, 0.07, 0.48, 0.2)
"""Of the cells about what moves, of those of the image, and of the row profiles of body and image, in the likeness of two frames.
Chosen on films of exercises by another person, camera turned 0 / 60, with seeds 0, 3, 7 of :mod:`experiments.brightness_indexing`,
and on arm raises of another person (moving frames; videos of 126 recognized when shifted, scaled, stretched or cropped):
.25 .07 .48 .2: .821 .829 .828 / .751 .722 .786, .963, 119; .3 .1 .5 .1: .822 .830 .829 / .739 .691 .775, .960, 120;
.2 .1 .6 .1: .811 .823 .829 / .756 .746 .786, .967, 120; with nothing of the image, .35 0 .65 0: .821 / .719 (seed 0), .964, 125;
the image alone: .812 / .779 (seed 0), .939, 100."""
LENGTH = 2 * (4 * CELLS**2 + 3 * CELLS)  # of a descriptor

Region = tuple[float, float, float, float]


@dataclass(frozen=True)
class Optics:
    """How videos are looked at.

    Attributes:
        fps: frames per second at which everything is compared.
        size: px of the longer side of the work image.
        region: ``"motion"``, ``None`` (the whole image) or ``(x0, y0, x1, y1)`` in pixels of the video.
        device: where to compute.
    """

    fps: float
    size: int
    region: str | Region | None
    device: str


class Sight:
    """Descriptors of one video, chunk by chunk; those of frame t need the frames up to t alone.

    Args:
        name: of the video, for messages.
        seen: ``(h, w)`` where something has moved before the first frame.
    """

    def __init__(self, optics: Optics, name: str, seen: Tensor | None = None) -> None:
        self.optics = optics
        self.shrink = Shrinker(name, optics.size, SMALLEST)
        self.maps, self.box = MotionMaps(), MotionBox(MEMORY * optics.fps, seen)

    def push(self, frames: Tensor) -> Tensor:
        """Descriptors ``(n, 560)`` of more small frames ``(n, h, w)``, grey 0..1, at the rate of the optics."""
        return self._described(*self.maps.push(frames)) if len(frames) else frames.new_zeros(0, LENGTH)

    def small(self, frames: Any) -> Tensor:
        """Small grey frames ``(n, h, w)`` in 0..1 of frames as given."""
        return self.shrink(frames).to(self.optics.device) / 255

    def _described(self, maps: Tensor, change: Tensor) -> Tensor:
        n, height, width = change.shape
        region = self.optics.region
        x0, y0, x1, y1 = (v * self.shrink.scale for v in region) if isinstance(region, tuple) else (0.0, 0.0, width, height)
        boxes = change.new_tensor([(x0 + x1) / 2, (y0 + y1) / 2, x1 - x0, y1 - y0]).repeat(n, 3, 1)  # near, image, body
        if region == "motion":
            boxes[:, ::2] = self.box.push(change)[:, None]
            boxes[:, 0, 2:].clamp_(min=NEAR * height)
            boxes[:, 2, 2:].clamp_(min=height)
        cells = pooled(maps, boxes)
        grids, rows = described(cells[:, :2]), described(profile(cells.flip(1)[:, :2]))
        return torch.cat([grids.flatten(1), rows.flatten(1)], dim=1).mul_(_weights(maps.dtype, maps.device))


@lru_cache(maxsize=64)
def _weights(dtype: torch.dtype, device: torch.device) -> Tensor:
    """``(560,)`` factors by which the parts of a descriptor have their shares in the likeness."""
    sizes = torch.tensor([4 * CELLS**2, 4 * CELLS**2, 3 * CELLS, 3 * CELLS])
    return torch.tensor(SHARES, dtype=dtype, device=device).sqrt().repeat_interleave(sizes.to(device))
