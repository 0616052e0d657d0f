"""What synchronization compares: the profile and the window kernels of a take, at the frames of a grid that both takes share."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from indexing.brightness.box import crop
from indexing.brightness.profile import reversed_profile, row_profile
from indexing.brightness.takes import Take
from indexing.brightness.window_kernel import HALF, window_kernels

FASTEST = 45.0  # frames per second: faster video is compared at a half, a third... of its rate; windows were chosen at 30
GAP = 2.5  # frames: over longer gaps nothing is interpolated
BLOCK = 64  # grid frames at once


@dataclass(frozen=True)
class Sampled:
    """A take on the grid: ``profile (T, D)``, ``kernels (T - 2 HALF, L, L)`` (the first at frame HALF); NaN in gaps.

    Attributes:
        start: seconds, of the first frame of the grid.
        rate: frames of the grid per second.
    """

    profile: Tensor
    kernels: Tensor
    start: float
    rate: float

    def backwards(self) -> Sampled:
        """The same take played backwards."""
        return Sampled(reversed_profile(self.profile), self.kernels.flip(0, 1, 2), self.start, self.rate)


def common_rate(first: Take, second: Take) -> float:
    """The rate of the slower video, or a whole fraction of it."""
    rate = min(first.fps, second.fps)
    return rate / -(-rate // FASTEST)


def sampled(source: Take, where: Tensor, rate: float) -> Sampled:
    """Profile and kernels of a take in boxes ``(T, 3)`` of its frames, block by block."""
    start = float(source.times[0])
    count = int((float(source.times[-1]) - start) * rate + 1e-6) + 1
    profiles, kernels = [], []
    for begin in range(0, count, BLOCK):
        first, end = max(begin - HALF, 0), min(begin + BLOCK + HALF, count)
        crops, known = _crops(source, where, start + torch.arange(first, end, dtype=torch.float64) / rate)
        part = row_profile(crops)
        part[~_around(known, 1)] = torch.nan
        profiles.append(part[begin - first :][: min(BLOCK, count - begin)])
        found = window_kernels(crops).float()
        found[~_around(known, HALF)[HALF : HALF + len(found)]] = torch.nan
        kernels.append(found)
    return Sampled(torch.cat(profiles), torch.cat(kernels), start, rate)


def _crops(source: Take, where: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
    """Crops at any times, blended from the frames before and after, and whether these are near enough."""
    stamps = source.times
    after = torch.searchsorted(stamps, times - 1e-9).clamp(1, len(stamps) - 1)
    before = after - 1
    span = stamps[after] - stamps[before]
    share = ((times - stamps[before]) / span).clamp(0, 1)
    share = torch.where(share < 1e-3, 0.0, torch.where(share > 1 - 1e-3, 1.0, share))
    box = torch.lerp(where[before], where[after], share[:, None])
    low, high = int(before[0]), int(after[-1]) + 1
    frames = source.frames[low:high]
    out = crop(frames[torch.where(share < 1, before, after) - low], box)
    mixed = ((share > 0) & (share < 1)).nonzero()[:, 0]
    if len(mixed):
        out[mixed] = torch.lerp(out[mixed], crop(frames[after[mixed] - low], box[mixed]), share[mixed].float()[:, None, None])
    known = (span <= GAP / source.fps) | (share == 0) | (share == 1)
    return out, known


def _around(known: Tensor, reach: int) -> Tensor:
    """``(T,)`` bool: whether all frames within ``reach`` are known."""
    lost = torch.nn.functional.max_pool1d((~known).float()[None], 2 * reach + 1, 1, reach)[0]
    return lost == 0
