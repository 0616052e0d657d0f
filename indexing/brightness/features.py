"""Brightness differences weighted by image gradients: what the direct method reads off a video."""

from __future__ import annotations

import torch
from kornia.filters import gaussian_blur2d, spatial_gradient3d
from torch import Tensor

SOFT = 0.02  # grey 0..1: gradients below this are not divided by (theory: within noise from .01 to .05)


def as_grey(frames: Tensor) -> Tensor:
    """Float32 in 0..1 of uint8 or float frames."""
    return frames.float() / 255 if frames.dtype == torch.uint8 else frames.float()


def blur(frames: Tensor, sigma: float) -> Tensor:
    """Frames ``(T, h, w)`` smoothed by a Gaussian of ``sigma`` pixels."""
    size = 2 * int(3 * sigma + 0.5) + 1
    size = min(size, 2 * ((min(frames.shape[-2:]) - 1) // 2) + 1)
    return gaussian_blur2d(frames[:, None], (size, size), (sigma, sigma))[:, 0]


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
    weight = -gt / ((gx * gx + gy * gy).sqrt() + SOFT)
    return weight * gx, weight * gy
