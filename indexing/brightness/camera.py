"""Whether the camera moves: the flow of the image's border, where the background is."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

BORDER = 0.12  # of the image, on each side
EXPLAINED = (
    0.5  # share of the border's change that one translation must explain; a person who crosses the border leaves most unexplained
)
LEAST = 0.05  # px per frame: below, a tripod
OFTEN = 0.1  # share of the frames
CHANGE = 0.02  # grey 0..1 per frame: 5 standard deviations of a noise of 8 grey levels, after the blur
CHANGED = 0.3  # share of the border that changes so without one translation: a fast pan, a cut, flicker


@dataclass(frozen=True)
class Drift:
    """Motion of the background.

    Attributes:
        step: ``(T, 2)`` px per frame where it is followed, else 0.
        lost: ``(T,)`` bool, where it cannot be.
    """

    step: Tensor
    lost: Tensor

    @property
    def moves(self) -> bool:
        """Whether the camera moves."""
        return bool((self.step.norm(dim=1) > 0).double().mean() > OFTEN)

    @property
    def hopeless(self) -> bool:
        """Whether it moves faster than can be followed, or the light changes."""
        return bool(self.lost.double().mean() > OFTEN)

    @property
    def path(self) -> Tensor:
        """``(T, 2)`` where the background has moved to since the first frame."""
        return self.step.cumsum(0)


def drift(gx: Tensor, gy: Tensor, gt: Tensor) -> Drift:
    r"""Translation of the border of each frame from gradients ``(T, h, w)``, by least squares.

    .. math:: I_t = -(I_x, I_y)\,d + c

    Args:
        gx, gy, gt: gradients, grey 0..1 per pixel and frame.

    Returns:
        The motion per frame where one translation explains the change.
    """
    inside = torch.ones(gt.shape[1:], dtype=torch.bool, device=gt.device)
    rows, columns = (max(2, round(BORDER * n)) for n in gt.shape[1:])
    inside[rows:-rows, columns:-columns] = False
    change = gt[:, inside].double()
    design = torch.stack([*(g[:, inside].double() for g in (gx, gy)), torch.ones_like(change)], dim=2)
    gram = design.mT @ design
    gram = gram + 1e-6 * torch.eye(3, dtype=torch.float64, device=gt.device) * gram.diagonal(dim1=1, dim2=2).amax(1)[:, None, None]
    found = torch.linalg.solve(gram, -(design.mT @ change[..., None]))
    left = change + (design @ found)[..., 0]
    step = found[:, :2, 0]
    spread = change - change.mean(1, keepdim=True)
    explained = 1 - left.square().sum(1) / spread.square().sum(1).clamp(min=1e-12)
    follows = (explained > EXPLAINED) & (step.norm(dim=1) > LEAST)
    lost = ((left.abs() > CHANGE).double().mean(1) > CHANGED) & ~follows
    return Drift(step * follows[:, None], lost)
