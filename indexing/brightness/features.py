"""Brightness differences weighted by image gradients: what the direct method reads off a video."""

from __future__ import annotations

from functools import lru_cache

import torch
from kornia.filters import gaussian_blur2d, spatial_gradient3d
from torch import Tensor

GRADIENT_EPSILON = 0.02  # grey 0..1: gradients below this are not divided by (theory: within noise from .01 to .05)
FEW_BLOCK = 4
"""Frames up to which tables are faster: 1 / 4 / 8 / 32 frames of 60 x 80 take 35 / 103 / 196 / 826 us by tables and 55 / 110 / 161
/ 328 us by kornia."""


def as_grey(frames: Tensor) -> Tensor:
    """Float32 in 0..1 of uint8 or float frames."""
    return frames.float() / 255 if frames.dtype == torch.uint8 else frames.float()


def blur(frames: Tensor, sigma: float) -> Tensor:
    """Frames ``(T, h, w)`` smoothed by a Gaussian of ``sigma`` pixels."""
    size = 2 * int(3 * sigma + 0.5) + 1
    size = min(size, 2 * ((min(frames.shape[-2:]) - 1) // 2) + 1)
    return gaussian_blur2d(frames[:, None], (size, size), (sigma, sigma))[:, 0]


def blur_small(frames: Tensor, sigma: float) -> Tensor:
    """What :func:`blur` gives, in two products with tables: a quarter of its time for single small frames."""
    height, width = frames.shape[-2:]
    down, across = (_blur_table(n, min(height, width), sigma, frames.dtype, frames.device) for n in (height, width))
    return down @ (frames @ across.T)


@lru_cache(maxsize=64)
def _blur_table(length: int, shorter: int, sigma: float, dtype: torch.dtype, device: torch.device) -> Tensor:
    """``(length, length)`` the blur of one axis of images whose shorter side has ``shorter`` pixels."""
    impulses = torch.eye(length, dtype=dtype, device=device)[:, :, None].expand(-1, -1, shorter)
    return blur(impulses, sigma)[:, :, 0].T.contiguous()


def gradients(frames: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Central differences ``(gx, gy, gt)``, each ``(T, h, w)``, of frames ``(T, h, w)``; repeated at the borders: kornia's."""
    gx, gy, gt = spatial_gradient3d(frames[None, None], mode="diff", order=1)[0, 0]
    return gx, gy, gt


def inner_gradients(frames: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """:func:`gradients` of the frames between the first and the last; of few frames in products with tables of the same filter."""
    if len(frames) > FEW_BLOCK + 2:
        gx, gy, gt = (part[1:-1] for part in gradients(frames))
        return gx, gy, gt
    change = _difference_table(len(frames), frames.dtype, frames.device)[1:-1]
    return *slopes(frames[1:-1]), (change @ frames.flatten(1)).view(-1, *frames.shape[1:])


def slopes(frames: Tensor) -> tuple[Tensor, Tensor]:
    """``gx, gy`` of :func:`gradients`, where no change in time is asked for, in products with tables of the same filter."""
    down, across = (_difference_table(n, frames.dtype, frames.device) for n in frames.shape[-2:])
    return frames @ across.mT, down @ frames


@lru_cache(maxsize=64)
def _difference_table(length: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """``(length, length)`` what :func:`gradients` does along one axis: its response to every unit impulse."""
    impulses = torch.eye(length, dtype=dtype, device=device)[:, :, None]
    return gradients(impulses)[1][:, :, 0].T.contiguous()


def weighted_differences(gx: Tensor, gy: Tensor, gt: Tensor) -> tuple[Tensor, Tensor]:
    r"""Horizontal and vertical brightness change per gradient. gx, gy, gt ``(..., h, w)``."""
    weight = -gt / ((gx * gx + gy * gy).sqrt() + GRADIENT_EPSILON)
    return weight * gx, weight * gy
