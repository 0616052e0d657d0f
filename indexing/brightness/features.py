"""Brightness differences weighted by image gradients: what the direct method reads off a video."""

from __future__ import annotations

from functools import lru_cache

import torch
from kornia.filters import gaussian_blur2d, spatial_gradient3d
from torch import Tensor

GRADIENT_EPSILON = 0.02  # grey 0..1: gradients below this are not divided by (theory: within noise from .01 to .05)


def as_grey(frames: Tensor) -> Tensor:
    """Float32 in 0..1 of uint8 or float frames."""
    return frames.float() / 255 if frames.dtype == torch.uint8 else frames.float()


def blur(frames: Tensor, sigma: float) -> Tensor:
    """Frames ``(T, h, w)`` smoothed by a Gaussian of ``sigma`` pixels."""
    size = 2 * int(3 * sigma + 0.5) + 1
    size = min(size, 2 * ((min(frames.shape[-2:]) - 1) // 2) + 1)
    return gaussian_blur2d(frames[:, None], (size, size), (sigma, sigma))[:, 0]


def blurred(frames: Tensor, sigma: float) -> Tensor:
    """What :func:`blur` gives, in two products with tables: a quarter of its time for single small frames."""
    height, width = frames.shape[-2:]
    down, across = (_blur_table(n, min(height, width), sigma, frames.dtype, frames.device) for n in (height, width))
    return down @ (frames @ across.T)


@lru_cache(maxsize=64)
def _blur_table(length: int, shorter: int, sigma: float, dtype: torch.dtype, device: torch.device) -> Tensor:
    """``(length, length)`` the blur of one axis of images whose shorter side has ``shorter`` pixels."""
    impulses = torch.eye(length, dtype=dtype, device=device)[:, :, None].expand(-1, -1, shorter)
    return blur(impulses, sigma)[:, :, 0].T.contiguous()


def inner_gradients(frames: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """:func:`gradients` of the frames between the first and the last, in products with tables."""
    inner = frames[1:-1]
    down, across = (_difference_table(n, frames.dtype, frames.device) for n in frames.shape[-2:])
    return inner @ across.mT, down @ inner, (frames[2:] - frames[:-2]).mul_(0.5)


@lru_cache(maxsize=64)
def _difference_table(length: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """``(length, length)`` central differences along one axis; repeated at the borders."""
    at = torch.arange(length)
    table = torch.zeros(length, length, dtype=dtype)
    table[at, (at + 1).clamp(max=length - 1)] += 0.5
    table[at, (at - 1).clamp(min=0)] -= 0.5
    return table.to(device)


def gradients(frames: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Central differences ``(gx, gy, gt)``, each ``(T, h, w)``, of frames ``(T, h, w)``; repeated at the borders."""
    gx, gy, gt = spatial_gradient3d(frames[None, None], mode="diff", order=1)[0, 0]
    return gx, gy, gt


def weighted_differences(gx: Tensor, gy: Tensor, gt: Tensor) -> tuple[Tensor, Tensor]:
    r"""Horizontal and vertical brightness change per gradient.

    .. math:: (u, v) = -\frac{I_t\,(I_x, I_y)}{\|\nabla I\| + \epsilon}

    the thesis's :math:`h = I_t \nabla I` divided by the contrast once: the sign of the contrast drops out, its size enters once.

    Args:
        gx, gy, gt: ``(..., h, w)`` gradients, grey 0..1 per pixel and frame.

    Returns:
        u and v, same shape; positive to the right and downwards.

    Example:
        >>> u, v = weighted_differences(torch.tensor([[-0.2]]), torch.tensor([[0.0]]), torch.tensor([[0.1]]))
        >>> round(u.item(), 3)  # darker to the right and getting brighter: the bright side moves right
        0.091
    """
    weight = -gt / ((gx * gx + gy * gy).sqrt() + GRADIENT_EPSILON)
    return weight * gx, weight * gy
