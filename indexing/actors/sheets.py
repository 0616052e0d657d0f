"""Grey video of textured sheets that move rigidly before a moving camera, and where every pixel of it goes: truth for what follows
points through pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import grid_sample

from indexing.actors.textured import texture

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Sheet:
    """A textured parallelogram."""

    texture: Tensor  # ``(h, w)`` grey 0..1
    place: Floats  # ``(3, 3)`` columns a, b, o: the texture's pixel (u, v) is at :math:`a u + b v + o` of its body, in metres
    body: int = 0  # which motion carries it


def sheet(
    corner: Sequence[float], right: Sequence[float], down: Sequence[float], pixels: int, body: int, generator: torch.Generator
) -> Sheet:
    """A sheet with smooth noise on it, whose smallest features are about six pixels of its texture."""
    edges = np.array([right, down], dtype=np.float64)
    lengths = np.linalg.norm(edges, axis=1)
    width, height = (max(8, round(pixels * length / lengths.max())) for length in lengths)
    cells = tuple(max(2, height // period) for period in (48, 20, 6))
    place = np.stack([edges[0] / (width - 1), edges[1] / (height - 1), np.asarray(corner, dtype=np.float64)], axis=1)
    return Sheet(texture(height, width, cells, generator), place, body)


@dataclass(frozen=True, eq=False)
class RenderedVideo:
    """A video and its truth."""

    frames: NDArray[np.uint8]  # ``(T, h, w)`` uint8
    seen: NDArray[np.int64]  # ``(T, h, w)`` int: which sheet every pixel shows; -1: none
    maps: Floats  # ``(T, sheets, 3, 3)`` texture pixels -> image pixels (pixel centres are whole numbers)
    bodies: NDArray[np.int64]  # ``(sheets,)`` which motion carries each

    def shown(self, points: Floats, frame: int) -> NDArray[np.int64]:
        """``(n,)`` the sheet that is seen at points ``(n, 2)`` of a frame; -1 where there is none, or an edge within two pixels."""
        height, width = self.seen.shape[1:]
        found = np.full(len(points), -1)
        at = np.rint(np.nan_to_num(points, nan=-9.0)).astype(np.int64)
        inside = ((at >= 2) & (at < np.array([width, height]) - 2)).all(axis=1)
        for i in np.flatnonzero(inside).tolist():
            x, y = at[i]
            around = self.seen[frame, y - 2 : y + 3, x - 2 : x + 3]
            found[i] = around[2, 2] if (around == around[2, 2]).all() else -1
        return found

    def followed(self, points: Floats, first: int, second: int) -> Floats:
        """Where points ``(n, 2)`` of one frame are in another, seen there or not; NaN where :meth:`shown` knows no sheet."""
        sheets = self.shown(points, first)
        out = np.full(points.shape, np.nan)
        for k in np.unique(sheets[sheets >= 0]).tolist():
            mine = sheets == k
            matrix = self.maps[second, k] @ np.linalg.inv(self.maps[first, k])
            rays = np.c_[points[mine], np.ones(mine.sum())] @ matrix.T
            out[mine] = rays[:, :2] / rays[:, 2:]
        return out


def render(
    sheets: Sequence[Sheet],
    cameras: Floats,
    motions: Floats,
    size: tuple[int, int],
    *,
    noise: float = 0.0,
    generator: torch.Generator | None = None,
) -> RenderedVideo:
    """Film sheets: the nearest one is seen at every pixel. cameras ``(T, 3, 4)``, motions ``(T, bodies, 4, 4)``."""
    width, height = size
    places = np.stack([np.vstack([one.place, [0.0, 0.0, 1.0]]) for one in sheets])
    bodies = np.array([one.body for one in sheets])
    maps = cameras[:, None] @ motions[:, bodies] @ places
    frames = np.empty((len(cameras), height, width), np.uint8)
    seen = np.empty((len(cameras), height, width), np.int64)
    for t in range(len(cameras)):
        value, seen[t] = _picture(sheets, maps[t], width, height)
        value = value + noise * torch.randn(value.shape, generator=generator)
        frames[t] = value.round_().clamp_(0, 255).to(torch.uint8).numpy()
    return RenderedVideo(frames, seen, maps, bodies)


def _picture(sheets: Sequence[Sheet], maps: Floats, width: int, height: int) -> tuple[Tensor, NDArray[np.int64]]:
    """Grey values ``(h, w)`` of one frame, and the sheet behind every pixel."""
    value = torch.full((height, width), 20.0)
    near = np.full((height, width), np.inf)
    seen = np.full((height, width), -1)
    for k, (one, matrix) in enumerate(zip(sheets, maps, strict=True)):
        rows, columns = one.texture.shape
        corners = np.array([[0, 0, 1], [columns - 1, 0, 1], [0, rows - 1, 1], [columns - 1, rows - 1, 1]]) @ matrix.T
        low, high = np.zeros(2, int), np.array([width, height])
        if (corners[:, 2] > 0).all():
            ends = corners[:, :2] / corners[:, 2:]
            low = np.floor(ends.min(axis=0)).clip(0, high).astype(int)
            high = (np.ceil(ends.max(axis=0)) + 1).clip(low, high).astype(int)
        if (high <= low).any():
            continue
        x, y = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
        rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(matrix).T
        depth = 1 / rays[..., 2]  # the point is (u, v, 1) = depth * ray: its depth before the camera, as maps are scaled
        u, v = rays[..., 0] * depth, rays[..., 1] * depth
        patch = (slice(low[1], high[1]), slice(low[0], high[0]))
        mine = (u >= 0) & (u <= columns - 1) & (v >= 0) & (v <= rows - 1) & (depth > 0) & (depth < near[patch])
        grid = torch.from_numpy(np.stack([2 * u / (columns - 1) - 1, 2 * v / (rows - 1) - 1], axis=-1)).float()
        shown = 20 + 215 * grid_sample(one.texture[None, None], grid[None], align_corners=True)[0, 0]
        value[patch] = torch.where(torch.from_numpy(mine), shown, value[patch])
        near[patch] = np.where(mine, depth, near[patch])
        seen[patch] = np.where(mine, k, seen[patch])
    return value, seen
