"""What the brightness indexer sees of a video: one descriptor per frame, as the frames come in."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
from kornia.filters import gaussian_blur2d, spatial_gradient3d
from torch import Tensor

from indexing.brightness.videos import Shrinker

FEW_FRAMES = 4  # up to which products with tables are faster than the filter (experiments.benchmarks.brightness_indexer)
GRADIENT_EPSILON = 0.02  # grey 0..1: gradients below this are not divided by (theory: within noise from .01 to .05)


def as_grey(frames: Tensor) -> Tensor:
    """Float32 in 0..1 of uint8 or float frames."""
    return frames.float() / 255 if frames.dtype == torch.uint8 else frames.float()


def blur(frames: Tensor, sigma: float) -> Tensor:
    """Frames ``(T, h, w)`` smoothed by a Gaussian of ``sigma`` pixels."""
    size = 2 * int(3 * sigma + 0.5) + 1
    size = min(size, 2 * ((min(frames.shape[-2:]) - 1) // 2) + 1)
    return gaussian_blur2d(frames[None], (size, size), (sigma, sigma))[0]


def blur_small(frames: Tensor, sigma: float) -> Tensor:
    """What :func:`blur` gives, in two products with tables of kornia's answers: a quarter of its time for single small frames."""
    height, width = frames.shape[-2:]
    down, across = (_blur_table(n, min(height, width), sigma, frames.dtype, frames.device) for n in (height, width))
    return down @ (frames @ across.mT)


@lru_cache(maxsize=64)
def _blur_table(length: int, shorter: int, sigma: float, dtype: torch.dtype, device: torch.device) -> Tensor:
    """``(length, length)`` the blur of one axis of images whose shorter side has ``shorter`` pixels."""
    impulses = torch.eye(length, dtype=dtype, device=device)[:, :, None].expand(-1, -1, shorter)
    return blur(impulses, sigma)[:, :, 0].mT.contiguous()


def gradients(frames: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Central differences ``(gx, gy, gt)``, each ``(T, h, w)``, of frames ``(T, h, w)``; repeated at the borders: kornia's."""
    gx, gy, gt = spatial_gradient3d(frames[None, None], mode="diff", order=1)[0, 0]
    return gx, gy, gt


def inner_gradients(frames: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """:func:`gradients` of the frames between the first and the last; of few frames in products with tables of the same filter."""
    if len(frames) > FEW_FRAMES + 2:
        gx, gy, gt = (part[1:-1] for part in gradients(frames))
        return gx, gy, gt
    change, down, across = (_difference_table(n, frames.dtype, frames.device) for n in frames.shape)
    return frames[1:-1] @ across.mT, down @ frames[1:-1], (change[1:-1] @ frames.flatten(1)).view(-1, *frames.shape[1:])


@lru_cache(maxsize=64)
def _difference_table(length: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """``(length, length)`` what :func:`gradients` does along one axis: its response to every unit impulse."""
    impulses = torch.eye(length, dtype=dtype, device=device)[:, :, None]
    return gradients(impulses)[1][:, :, 0].mT.contiguous()


def weighted_differences(gx: Tensor, gy: Tensor, gt: Tensor) -> tuple[Tensor, Tensor]:
    r"""Horizontal and vertical brightness change per gradient. gx, gy, gt ``(..., h, w)``."""
    weight = -gt / ((gx * gx + gy * gy).sqrt() + GRADIENT_EPSILON)
    return weight * gx, weight * gy


MIN_CHANGE = 0.006  # grey 0..1 per frame: less does not widen the box
BOX_QUANTILES = (0.02, 0.98)  # of the motion that a box encloses
BOX_PAD = 0.15  # of the box, added on each side
MIN_BOX = 0.35  # of the image's height
SOFT_NORM = 0.005  # added to a descriptor's norm: noise frames stay near 0 instead of being blown up
# of the cells about what moves, of those of the image, and of the row profiles of body and image, in the likeness of two frames
# (experiments.recognition.brightness_indexing, seeds 0, 3, 7)
SHARES = (0.25, 0.07, 0.48, 0.2)

# ----------------------------------------------------------------------------------------------------------------------
# Rectified motion maps of a stream: how much moves right, left, down and up, pixel by pixel, as fast as frames come in.


class MotionMaps:
    """Keeps the last two blurred frames of a stream; gives ``(n, 4, h, w)`` maps for ``n`` more frames."""

    def __init__(self, sigma: float, noise: float) -> None:
        self.sigma, self.noise = sigma, noise
        self.last: Tensor | None = None

    def push(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        """Maps ``(n, 4, h, w)`` (right, left, down, up) and brightness change ``(n, h, w)`` of frames ``(n, h, w)`` in 0..1."""
        smooth = blur_small(frames, self.sigma)
        known = torch.cat([smooth[:1].expand(2, -1, -1) if self.last is None else self.last, smooth])
        self.last = known[-2:]
        gx, gy, gt = inner_gradients(known)
        change = gt.abs()
        u, v = weighted_differences(gx, gy, gt.sign() * (change - self.noise).clamp(min=0))
        return rectify(u, v), change


def rectify(u: Tensor, v: Tensor) -> Tensor:
    """``(n, 4, h, w)`` what moves right, left, down and up: pooled apart, so that opposite motions do not cancel."""
    return torch.stack([u, -u, v, -v], dim=1).clamp_(min=0)


# ----------------------------------------------------------------------------------------------------------------------
# The causal motion box: where somebody has moved of late, known while the frames come in.


NOTHING_EPSILON = 1e-12  # brightness change of every pixel in a box: where nothing has moved, it is about the whole image


class MotionBox:
    r"""Square box about what has moved, frame by frame. seen ``(h, w)``."""

    def __init__(self, memory: float, seen: Tensor | None = None) -> None:
        self.decay, self.seen = 1 - 1 / memory, seen

    def push(self, change: Tensor) -> Tensor:
        """``(n, 4)`` centre x, centre y, width and height in pixels for brightness changes ``(n, h, w)``."""
        n = len(change)
        age = self.decay ** torch.arange(1, n + 1, dtype=change.dtype, device=change.device)[:, None, None]
        fresh = (change - MIN_CHANGE).clamp_(min=NOTHING_EPSILON) / age
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
    inside = torch.stack([q * total[:, :, -1:] for q in BOX_QUANTILES], dim=1)
    ends = (total[:, None] < inside).sum(3).to(seen)  # (n, low or high, x or y)
    low, high = ends[:, 0], ends[:, 1] + 1
    size = (high - low).amax(1, keepdim=True) * (1 + 2 * BOX_PAD)
    return torch.cat([(low + high) / 2, size, size], dim=1)


def merge_motion(seen: list[Tensor]) -> list[Tensor]:
    """Of each video, what moved in it and in all videos of its size that were taken at its place. seen ``(h, w)``."""
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


# ----------------------------------------------------------------------------------------------------------------------
# Pooling of motion maps in the cells of a box, and the unit of a frame's descriptor.


CELLS = 8


def overlaps(centre: Tensor, side: Tensor, pixels: int, cells: int = CELLS) -> Tensor:
    """``(..., cells, pixels)`` share of each cell's interval that lies in each pixel; neighbouring cells overlap by half."""
    places, pixel, after = _positions(cells, pixels, side.dtype, side.device)
    step = (side / cells)[..., None, None]
    middle = centre[..., None, None] + step * places
    shared = torch.minimum(middle + step, after).sub_(torch.maximum(middle - step, pixel))
    return shared.clamp_(min=0).div_(2 * step)


@lru_cache(maxsize=64)
def _positions(cells: int, pixels: int, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Middles of cells about the centre, in cells; where pixels begin and end."""
    edges = torch.arange(pixels + 1, dtype=dtype, device=device)
    return (torch.arange(cells, dtype=dtype, device=device) + 0.5 - cells / 2)[:, None], edges[:-1], edges[1:]


def pool_cells(maps: Tensor, boxes: Tensor, cells: int = CELLS) -> Tensor:
    """``(n, b, c * cells * cells)`` mean of maps ``(n, c, h, w)`` in the cells of boxes ``(n, b, 4)``; 0 outside the image."""
    (n, b, _), (height, width) = boxes.shape, maps.shape[2:]
    across, along = overlaps(boxes[..., :2], boxes[..., 2:], max(height, width), cells).unbind(2)
    columns = across[..., :width].reshape(n, 1, b * cells, width)
    bands = (maps @ columns.mT).unflatten(3, (b, cells)).movedim(3, 1)
    return (along[:, :, None, :, :height] @ bands).flatten(2)


def describe_cells(cells: Tensor) -> Tensor:
    r"""Descriptor :math:`f = s / (\|s\| + .005)` with :math:`s = \sqrt{cells}`: shorter than 1, and near 0 where nothing moves."""
    root = cells.sqrt()
    return root / (root.norm(dim=-1, keepdim=True) + SOFT_NORM)


def profile(cells: Tensor) -> Tensor:
    """``(..., 24)`` motion sideways, down and up in each row of cells ``(..., 256)``."""
    right, left, down, up = cells.unflatten(-1, (4, CELLS, CELLS)).sum(-1).unbind(-2)
    return torch.cat([right + left, down, up], dim=-1)


def mirror_rows(rows: Tensor) -> Tensor:
    """Descriptors of the same video seen in a mirror: right and left change places; a row profile at the end stays."""
    size = 4 * CELLS**2
    grids, rest = rows.split([rows.shape[1] // size * size, rows.shape[1] % size], dim=1)
    maps = grids.unflatten(1, (-1, 4, CELLS, CELLS)).flip(4)
    return torch.cat([maps[:, :, [1, 0, 2, 3]].flatten(1), rest], dim=1)


SMALLEST = 16  # px of the shorter side
LENGTH = 2 * (4 * CELLS**2 + 3 * CELLS)  # of a descriptor

Region = tuple[float, float, float, float]


@dataclass(frozen=True)
class BrightnessOptions:
    """What :class:`indexing.BrightnessIndexer` is to know of the videos, and what it costs."""

    blur_sigma: float = 1.2
    """Pixels of the work image (80 pixels wide): more for grainy videos."""
    noise_level: float = 0.004
    """Grey 0..1 per frame below which brightness change is noise (theory: .004; .008 at sensor noise 3/255)."""
    motion_memory: float = 20.0
    """Seconds over which the box forgets where somebody moved: less where people wander."""
    num_directions: int = 96
    """Principal directions in which frames are compared: all of 560 cost 4.3 ms per frame and 20,000 rows, these .2 ms; 32 name
    .7 of a percent fewer frames."""


@dataclass(frozen=True)
class Optics:
    """How videos are looked at."""

    fps: float  # frames per second at which everything is compared
    size: int  # px of the longer side of the work image
    region: str | Region | None  # ``"motion"``, ``None`` (the whole image) or ``(x0, y0, x1, y1)`` in pixels of the video
    device: str  # where to compute
    options: BrightnessOptions


class Sight:
    """Descriptors of one video, chunk by chunk; those of frame t need the frames up to t alone. seen ``(h, w)``."""

    def __init__(self, optics: Optics, name: str, seen: Tensor | None = None) -> None:
        self.optics = optics
        self.shrink = Shrinker(name, optics.size, SMALLEST)
        options = optics.options
        self.maps = MotionMaps(options.blur_sigma, options.noise_level)
        self.box = MotionBox(options.motion_memory * optics.fps, seen)

    def push(self, frames: Tensor) -> Tensor:
        """Descriptors ``(n, 560)`` of more small frames ``(n, h, w)``, grey 0..1, at the rate of the optics."""
        return self._describe(*self.maps.push(frames)) if len(frames) else frames.new_zeros(0, LENGTH)

    def small(self, frames: Any) -> Tensor:
        """Small grey frames ``(n, h, w)`` in 0..1 of frames as given."""
        return self.shrink(frames).to(self.optics.device) / 255

    def _describe(self, maps: Tensor, change: Tensor) -> Tensor:
        n, height, width = change.shape
        region = self.optics.region
        x0, y0, x1, y1 = (v * self.shrink.scale for v in region) if isinstance(region, tuple) else (0.0, 0.0, width, height)
        boxes = change.new_tensor([(x0 + x1) / 2, (y0 + y1) / 2, x1 - x0, y1 - y0]).repeat(n, 3, 1)  # near, image, body
        if region == "motion":
            boxes[:, ::2] = self.box.push(change)[:, None]
            boxes[:, 0, 2:].clamp_(min=MIN_BOX * height)
            boxes[:, 2, 2:].clamp_(min=height)
        cells = pool_cells(maps, boxes)
        grids, rows = (describe_cells(part) for part in (cells[:, :2], profile(cells.flip(1)[:, :2])))
        weights = _weights(SHARES, maps.dtype, maps.device)
        return torch.cat([grids.flatten(1), rows.flatten(1)], dim=1).mul_(weights)


@lru_cache(maxsize=64)
def _weights(shares: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """``(560,)`` factors by which the parts of a descriptor have their shares in the likeness."""
    sizes = torch.tensor([4 * CELLS**2, 4 * CELLS**2, 3 * CELLS, 3 * CELLS])
    return torch.tensor(shares, dtype=dtype, device=device).sqrt().repeat_interleave(sizes.to(device))
