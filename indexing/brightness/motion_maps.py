r"""Rectified motion maps of a stream: how much moves right, left, down and up, pixel by pixel, as fast as frames come in."""

from __future__ import annotations

import torch
from torch import Tensor

from indexing.brightness.features import blurred, inner_gradients, weighted_differences

SIGMA = 1.2  # px of the work image (80 px wide)
QUIET = 0.004  # grey 0..1 per frame: below, brightness change is noise (theory: .004; .008 at sensor noise 3/255)


class MotionMaps:
    """Keeps the last two blurred frames of a stream; gives ``(n, 4, h, w)`` maps for ``n`` more frames.

    The maps of frame t need the frames up to t alone: brightness changes from t - 2 to t about frame t - 1.

    Args:
        sigma: pixels.
        quiet: grey 0..1 per frame.
    """

    def __init__(self, sigma: float = SIGMA, quiet: float = QUIET) -> None:
        self.sigma, self.quiet = sigma, quiet
        self.last: Tensor | None = None

    def push(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        """Maps ``(n, 4, h, w)`` (right, left, down, up) and brightness change ``(n, h, w)`` of frames ``(n, h, w)`` in 0..1."""
        smooth = blurred(frames, self.sigma)
        known = torch.cat([smooth[:1].expand(2, -1, -1) if self.last is None else self.last, smooth])
        self.last = known[-2:]
        gx, gy, gt = inner_gradients(known)
        change = gt.abs()
        u, v = weighted_differences(gx, gy, gt.sign() * (change - self.quiet).clamp(min=0))
        return rectified(u, v), change


def rectified(u: Tensor, v: Tensor) -> Tensor:
    """``(n, 4, h, w)`` what moves right, left, down and up: pooled apart, so that opposite motions do not cancel."""
    return torch.stack([u, -u, v, -v], dim=1).clamp_(min=0)
