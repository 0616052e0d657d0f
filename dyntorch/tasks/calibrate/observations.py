"""What the cameras saw, at common moments: tracks smoothed by the same kernel, read at any time of any clock."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import torch
from torch import Tensor

from dyntorch.tasks.synchronize.epipolar import Grid
from dyntorch.tasks.synchronize.tracks import Tracks


class Seen(NamedTuple):
    """Positions at common moments."""

    x: Tensor
    """``(b, c, T, n, 2)`` px, 0 where not seen."""
    v: Tensor
    """``(b, c, T, n, 2)`` px per second."""
    weights: Tensor
    """``(b, c, T, n)``, 0 where not seen."""


@dataclass(frozen=True)
class RigViews:
    """The tracks of c cameras, ready to be read at T moments of the reference clock."""

    grids: tuple[Grid, ...]  # of each camera
    centers: Tensor  # ``(c, 2)`` px, the principal points
    middle: float  # the moment in the middle, seconds of the reference clock
    times: Tensor  # ``(T,)`` seconds from the middle
    frames: Tensor  # ``(c,)`` seconds from one frame to the next
    noise: Tensor  # ``(c,)`` of the tracks, over its geometric mean

    def at(self, clocks: Tensor, shift: float = 0.0) -> Seen:
        """What is seen with clocks ``(b, c, 2)``: against the reference clock at the middle, and the logarithm of the rate."""
        shape = (len(clocks), len(self.times), self.grids[0].x.shape[1])
        parts = []
        for i, grid in enumerate(self.grids):
            own = clocks[:, i, 1:].exp() * self.times + clocks[:, i, :1] + (self.middle + shift * float(self.frames[i]))
            x, v, w = grid.at(own.flatten())
            parts.append((x.view(*shape, 2), v.view(*shape, 2), w.view(shape)))
        return Seen(*(torch.stack(part, dim=1) for part in zip(*parts, strict=True)))

    def steady(self, clocks: Tensor) -> Tensor:
        """Weights ``(b, c, T, n)`` of positions that two cameras see, and a frame before and after, too: clocks may move so far."""
        now, before, after = (self.at(clocks, shift).weights for shift in (0.0, -1.0, 1.0))
        steady = torch.where((before > 0) & (after > 0), now, 0.0)
        return steady * ((steady > 0).sum(1, keepdim=True) >= 2)

    def some(self, count: int) -> RigViews:
        """About ``count`` of the moments, evenly spread."""
        return replace(self, times=self.times[:: max(1, len(self.times) // count)])

    def between(self, start: float, end: float) -> RigViews:
        """The moments from ``start`` on and before ``end``, seconds from the middle."""
        return replace(self, times=self.times[(self.times >= start) & (self.times < end)])


KERNEL_FRAMES = 1.0  # standard deviation of the smoothing: below 1 clocks are drawn to half frames
MAX_NOISE_RATIO = 2.0  # noise of a camera over the geometric mean of all, and its inverse
MIN_NOISE = 0.05  # px: exact data have no scale


def common_views(tracks: Sequence[Tracks], centers: Tensor, clocks: Tensor) -> RigViews:
    """Views at the moments at which two cameras at least run, a frame of the slowest camera apart. centers ``(c, 2)``, clocks
    ``(c, 2)``."""
    runs = [((float(t.times[0]) - o) / r, (float(t.times[-1]) - o) / r) for t, (o, r) in zip(tracks, clocks.tolist(), strict=True)]
    start, end = sorted(run[0] for run in runs)[1], sorted(run[1] for run in runs)[-2]
    step = max(t.step / r for t, (_, r) in zip(tracks, clocks.tolist(), strict=True))
    # the second start and the last end but one may lie in a gap, or in one camera's run alone
    if not any(max(a[0], b[0]) + step < min(a[1], b[1]) for a, b in combinations(runs, 2)):
        said = ", ".join(f"camera {i} {a:.3g} to {b:.3g} s" for i, (a, b) in enumerate(runs))
        raise ValueError(
            f"tracks: no two cameras run at the same time ({said} of the reference clock): check clocks, fps and times"
        )
    middle = 0.5 * (start + end)
    times = start - middle + step * torch.arange(math.floor((end - start) / step + 1e-9) + 1, dtype=torch.float64)
    grids = tuple(Grid.of(t, KERNEL_FRAMES * step * r) for t, (_, r) in zip(tracks, clocks.tolist(), strict=True))
    frames, noise = torch.tensor([[t.step, t.noise] for t in tracks], dtype=torch.float64).unbind(-1)
    most = math.log(MAX_NOISE_RATIO)
    noise = noise.clamp(min=MIN_NOISE).log()
    noise = (noise - noise.mean()).clamp(-most, most).exp()
    return RigViews(grids, centers, middle, times, frames, noise)
