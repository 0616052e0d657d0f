"""Pooling of motion maps in the cells of a box, and the unit of a frame's descriptor."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

CELLS = 8
SOFT = 0.005  # added to the norm: noise frames stay near 0 instead of being blown up


def overlaps(centre: Tensor, side: Tensor, pixels: int, cells: int = CELLS) -> Tensor:
    """``(..., cells, pixels)`` share of each cell's interval that lies in each pixel; neighbouring cells overlap by half.

    Args:
        centre, side: ``(...)`` of the interval that the cells divide, in pixels.
    """
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


def pooled(maps: Tensor, boxes: Tensor, cells: int = CELLS) -> Tensor:
    """``(n, b, c * cells * cells)`` mean of maps ``(n, c, h, w)`` in the cells of boxes ``(n, b, 4)``; 0 outside the image."""
    (n, b, _), (height, width) = boxes.shape, maps.shape[2:]
    across, along = overlaps(boxes[..., :2], boxes[..., 2:], max(height, width), cells).unbind(2)
    columns = across[..., :width].reshape(n, 1, b * cells, width)
    bands = (maps @ columns.mT).unflatten(3, (b, cells)).movedim(3, 1)
    return (along[:, :, None, :, :height] @ bands).flatten(2)


def described(cells: Tensor, soft: float = SOFT) -> Tensor:
    r"""Descriptor :math:`f = s / (\|s\| + .005)` with :math:`s = \sqrt{cells}`: shorter than 1, and near 0 where nothing moves."""
    root = cells.sqrt()
    return root / (root.norm(dim=-1, keepdim=True) + soft)


def profile(cells: Tensor, count: int = CELLS) -> Tensor:
    """``(..., 3 * count)`` motion sideways, down and up in each row of cells ``(..., 4 * count * count)``.

    Cameras that stand upright share the height of what they see, not its place across, and the sign of sideways motion depends
    on the side from which a camera looks.

    Example:
        >>> profile(torch.arange(1.0, 17.0).view(1, 16), 2).tolist()
        [[14.0, 22.0, 19.0, 23.0, 27.0, 31.0]]
    """
    right, left, down, up = cells.unflatten(-1, (4, count, count)).sum(-1).unbind(-2)
    return torch.cat([right + left, down, up], dim=-1)


def mirrored(rows: Tensor, count: int = CELLS) -> Tensor:
    """Descriptors of the same video seen in a mirror: right and left change places; a row profile at the end stays."""
    size = 4 * count**2
    grids, rest = rows.split([rows.shape[1] // size * size, rows.shape[1] % size], dim=1)
    maps = grids.unflatten(1, (-1, 4, count, count)).flip(4)
    return torch.cat([maps[:, :, [1, 0, 2, 3]].flatten(1), rest], dim=1)
