"""What else can be read off a video frame by frame: the same online warping, with other descriptors.  For comparison only.

All look at the crop about what moves in the whole take (:mod:`indexing.sync.brightness_features`; not causal, which favours them).

*activity*: how much changes, in the second before: a curve, compared by correlation.
*energy grid*: how much changes in each of 8 x 8 cells.  *HOG*: histograms of oriented gradients of what is not background.
*tracks*: where points that are followed (KLT) move which way.
*thesis kernel*: the rank-type kernel of brightness differences over short windows of the whole image, which knows no places.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d, normalize

from experiments.recognition.protocol import Array
from indexing.brightness.descriptors import SMALLEST, blur, describe_cells, gradients
from indexing.brightness.stream import VideoExemplars, Warping, build_library
from indexing.brightness.videos import Shrinker
from indexing.sync.brightness_features import CROP_SIDE, boxes, crop, inverse_root, motion, window_kernels
from indexing.video import Chunk, track_points

Frames = NDArray[np.uint8]
Look = Callable[[Frames, float], Tensor]
CELLS, DIRECTIONS = 8, 8
SIGMA = 1.5
QUIET = 0.006  # grey 0..1 per frame
SIZE, HALF, PATCH = 80, 5, 5  # of the thesis kernel: px of the longer side, frames on either side, px (theory: 10 px at 160 px)
RIDGE = 0.02  # of its whitening
CEILING = 1.05  # of scores in the log: as for the brightness indexer
SOFT_NORM = 0.02  # added to the norm of what points move: near 0 where nothing does


def cropped(frames: Frames, fps: float) -> Tensor:
    """``(F, 96, 96)`` crops in 0..1."""
    source = torch.from_numpy(frames)
    return crop(source, boxes(motion(source), fps)[0], CROP_SIDE)


def activity(frames: Frames, fps: float) -> Tensor:
    """``(F, one second)`` how much changed in the second before each frame, about its mean, of unit length."""
    curve = motion(torch.from_numpy(frames)).activity.float()
    length = max(2, round(fps))
    past = torch.cat([curve[:1].expand(length - 1), curve]).unfold(0, length, 1)
    return normalize(past - past.mean(1, keepdim=True), dim=1, eps=1e-6)


def energy_grid(frames: Frames, fps: float) -> Tensor:
    """``(F, 64)`` brightness change above the noise in cells that overlap by half."""
    _, _, gt = gradients(blur(cropped(frames, fps), SIGMA))
    change = (gt.abs() - QUIET).clamp(min=0)
    return describe_cells(_cells(change[:, None]))


def oriented_gradients(frames: Frames, fps: float) -> Tensor:
    """``(F, 64 * 8)`` histograms of the directions of gradients, unsigned, of the difference to the take's median."""
    crops = blur(cropped(frames, fps), 1.0)
    gx, gy, _ = gradients(crops - crops.median(0).values)
    strength = (gx * gx + gy * gy).sqrt()
    sector = (torch.atan2(gy, gx) / torch.pi * DIRECTIONS).floor().long() % DIRECTIONS
    maps = torch.zeros(len(crops), DIRECTIONS, *crops.shape[1:]).scatter_(1, sector[:, None], strength[:, None])
    return describe_cells(_cells((maps - QUIET).clamp(min=0)))


def tracks(frames: Frames, fps: float) -> Tensor:
    """``(F, 256)`` speeds of followed points to the right, left, down and up, in the cells of the square in which they move."""
    points = track_points([Chunk(frames, np.arange(len(frames)) / fps)], complete=0.3, keep=100).points
    known = points.isfinite().all(2)
    if not bool(known.any()):
        return torch.zeros(len(frames), 4 * CELLS**2)
    low, high = torch.quantile(points[known], torch.tensor([0.02, 0.98], dtype=points.dtype), dim=0)
    place = ((points - (low + high) / 2) / (high - low).max().clamp(min=1.0) + 0.5).nan_to_num(-1.0) * CELLS
    speed = torch.zeros_like(points)
    speed[1:-1] = (points[2:] - points[:-2]) / 2
    speed = speed.nan_to_num(0.0) / max(frames.shape[1:])
    near = (1 - (place[..., None] - 0.5 - torch.arange(CELLS)).abs()).clamp(min=0)  # (F, n, 2, cells): bilinear shares
    ways = torch.cat([speed, -speed], dim=2).clamp(min=0)
    cells = torch.einsum("fni,fnj,fnk->fkij", near[:, :, 1], near[:, :, 0], ways).flatten(1)
    root = cells.float().sqrt()
    return root / (root.norm(dim=-1, keepdim=True) + SOFT_NORM)


def _cells(maps: Tensor) -> Tensor:
    """``(F, c * 64)`` means in 8 x 8 cells that overlap by half."""
    size = 2 * maps.shape[-1] // (CELLS + 1)
    return avg_pool2d(maps, size, size // 2)[:, :, :CELLS, :CELLS].flatten(1)


BASELINES: dict[str, Look] = {
    "activity correlation": activity,
    "energy grid": energy_grid,
    "HOG": oriented_gradients,
    "tracks": tracks,
}


class FrameNearest:
    """Nearest exemplar frames under leaky online warping, whatever describes a frame.

    Args:
        look: descriptors ``(F, D)`` of a video.
        fps: of the videos; window: seconds that the warping remembers.
    """

    def __init__(self, look: Look, fps: float, window: float = 0.5) -> None:
        self.look, self.fps, self.window = look, fps, window

    def fit(self, videos: Sequence[Frames], labels: Any) -> Self:
        """Keep the exemplars' descriptors."""
        self.classes_, numbers = np.unique(np.asarray(labels), return_inverse=True)
        rows = [self.look(video, self.fps) for video in videos]
        lengths = torch.tensor([len(one) for one in rows])
        every = torch.cat(rows)
        kept = VideoExemplars(every, lengths, torch.from_numpy(numbers))
        self.library = build_library(kept, len(self.classes_), flip=False)
        return self

    def answer(self, video: Frames) -> tuple[Array, Array]:
        """Scores of the classes for the whole video, ``(classes,)``, and after every frame, ``(F, classes)``."""
        rows = self.look(video, self.fps)
        scores = Warping(self.library, self.window * self.fps).push(rows)
        weight = rows.square().sum(1, keepdim=True)
        weight[: min(int(self.window * self.fps), len(rows) // 2)] = 0
        total = (weight * -torch.log((CEILING - scores).clamp(min=1e-3))).sum(0)
        return total.numpy(), scores.numpy()


class WindowKernels(FrameNearest):
    """The thesis's measure alone: window kernels, about the mean of the exemplars' and whitened by it."""

    def __init__(self, fps: float, window: float = 0.5) -> None:
        super().__init__(self._look, fps, window)

    def fit(self, videos: Sequence[Frames], labels: Any) -> Self:
        """Learn mean and whitening from the frames in which something moves, then keep the exemplars' descriptors."""
        kernels = torch.cat([self._kernels(video) for video in videos])
        kernels = kernels[kernels.diagonal(dim1=1, dim2=2).sum(1) > 0]
        self.root = inverse_root(kernels.mean(0), RIDGE)
        self.mean = (self.root @ kernels @ self.root).mean(0)
        return super().fit(videos, labels)

    def _look(self, frames: Frames, fps: float) -> Tensor:
        """``(F, 121)`` of unit length, 0 where nothing moves."""
        kernels = self._kernels(frames)
        still = kernels.abs().amax((1, 2)) == 0
        white = (self.root @ kernels @ self.root - self.mean).flatten(1)
        return normalize(white, dim=1).masked_fill(still[:, None], 0.0).float()

    def _kernels(self, frames: Frames) -> Tensor:
        """``(F, 11, 11)`` about frame t - 5; 0 before frame 10."""
        found = window_kernels(Shrinker("video", SIZE, SMALLEST)(frames) / 255, half=HALF, patch=PATCH)
        return torch.cat([found.new_zeros(len(frames) - len(found), *found.shape[1:]), found])
