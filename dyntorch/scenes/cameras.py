"""Calibrated cameras that look at a point of the scene."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize


def looking_at(position: Tensor, target: Tensor, up: Tensor) -> Tensor:
    r"""World to camera maps :math:`[R \mid -R c]` of cameras at c whose optical axis passes through a target.

    Args:
        position: ``(*batch, 3)`` centres c.
        target: ``(*batch, 3)`` points on the optical axis, in front of the camera.
        up: ``(*batch, 3)`` directions that are seen upright (towards smaller image y); not along the axis.

    Returns:
        ``(*batch, 3, 4)``; the z of the camera is the depth.

    Example:
        >>> import torch
        >>> eye, origin, up = torch.tensor([0.0, 0.0, -4.0]), torch.zeros(3), torch.tensor([0.0, -1.0, 0.0])
        >>> looking_at(eye, origin, up).tolist()
        [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 4.0]]
    """
    axis = normalize(target - position, dim=-1)
    right = normalize(torch.linalg.cross(axis, up), dim=-1)
    rotation = torch.stack([right, torch.linalg.cross(axis, right), axis], dim=-2)
    return torch.cat([rotation, -rotation @ position[..., None]], dim=-1) + 0.0  # no negative zeros


def calibration(focal: Tensor, centre: float) -> Tensor:
    """Calibration matrices ``(*batch, 3, 3)`` of square pixels: focal length ``(*batch,)`` and principal point in pixels.

    Example:
        >>> import torch
        >>> calibration(torch.tensor(1300.0), 500.0).tolist()
        [[1300.0, 0.0, 500.0], [0.0, 1300.0, 500.0], [0.0, 0.0, 1.0]]
    """
    one, zero = torch.ones_like(focal), torch.zeros_like(focal)
    entries = [focal, zero, centre * one, zero, focal, centre * one, zero, zero, one]
    return torch.stack(entries, dim=-1).unflatten(-1, (3, 3))
