"""The causal motion box: where somebody has moved of late, known while the frames come in."""

from __future__ import annotations

import torch
from torch import Tensor

MEMORY = 20.0  # seconds over which motion is forgotten; 10: .007 fewer of the frames of exercises
LIVELY = 0.006  # grey 0..1 per frame: less does not widen the box
INSIDE = (0.02, 0.98)  # quantiles of the motion that a box encloses
NOTHING = 1e-12  # brightness change of every pixel in a box: where nothing has moved, it is about the whole image
PAD = 0.15  # of the box, on each side


class MotionBox:
    r"""Square box about what has moved, frame by frame.

    .. math:: A_t = \max\bigl((1 - \tfrac{1}{m}) A_{t-1},\; \max(|I_t| - .006, 0)\bigr)

    and the box encloses the 2 % to 98 % quantiles of the marginals of A.  It knows the frames up to t alone.

    Args:
        memory: m, frames.
        seen: ``(h, w)`` A before the first frame; nothing by default.
    """

    def __init__(self, memory: float, seen: Tensor | None = None) -> None:
        self.decay, self.seen = 1 - 1 / memory, seen

    def push(self, change: Tensor) -> Tensor:
        """``(n, 4)`` centre x, centre y, width and height in pixels for brightness changes ``(n, h, w)``."""
        n = len(change)
        age = self.decay ** torch.arange(1, n + 1, dtype=change.dtype, device=change.device)[:, None, None]
        fresh = (change - LIVELY).clamp_(min=NOTHING) / age
        if self.seen is not None:
            fresh[0] = torch.maximum(fresh[0], self.seen)
        seen = fresh.cummax(0).values * age
        self.seen = seen[-1]
        return boxes_about(seen)


def boxes_about(seen: Tensor) -> Tensor:
    """Square boxes ``(n, 4)`` about most of what is in maps ``(n, h, w)``."""
    n, height, width = seen.shape
    sums = seen.new_zeros(n, 2, max(height, width))
    torch.sum(seen, 1, out=sums[:, 0, :width])
    torch.sum(seen, 2, out=sums[:, 1, :height])
    total = sums.cumsum(2)
    ends = (total[:, None] < torch.stack([q * total[:, :, -1:] for q in INSIDE], dim=1)).sum(3).to(seen)  # (n, low or high, x or y)
    low, high = ends[:, 0], ends[:, 1] + 1
    size = (high - low).amax(1, keepdim=True) * (1 + 2 * PAD)
    return torch.cat([(low + high) / 2, size, size], dim=1)


def together(seen: list[Tensor]) -> list[Tensor]:
    """Of each video, what moved in it and in all videos of its size that were taken at its place.

    Where the box about one holds at least half of the other's, somebody stands at one place in both.

    Args:
        seen: ``(h, w)`` what moved in each video.

    Example:
        >>> arm, legs = torch.zeros(2, 20, 20)
        >>> arm[4:8, 4:8], legs[6:16, 6:10] = 1.0, 2.0
        >>> [int(one.sum()) for one in together([arm, legs, torch.ones(5, 5)])]
        [92, 92, 25]
    """
    out = list(seen)
    for shape in {one.shape for one in seen}:
        of = [i for i, one in enumerate(seen) if one.shape == shape]
        maps = torch.stack([seen[i] for i in of])
        boxes = boxes_about(maps)
        low, high = boxes[:, :2] - boxes[:, 2:] / 2, boxes[:, :2] + boxes[:, 2:] / 2
        common = (torch.minimum(high[:, None], high) - torch.maximum(low[:, None], low)).clamp(min=0).prod(2)
        area = boxes[:, 2:].prod(1)
        near = common >= torch.minimum(area[:, None], area) / 2
        for i, row in zip(of, near, strict=True):
            out[i] = maps[row].amax(0)
    return out
