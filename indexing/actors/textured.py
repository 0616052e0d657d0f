"""Grey video of a synthetic person, textured capsules before a fixed camera, and of textured sheets before a moving one.

Texture and background are drawn per camera, so two films of one performance share its motion and nothing else: the hard case of
direct synchronization and indexing, and one in which the truth is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from kornia.geometry.transform import warp_perspective
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

from indexing.cameras import rotation, y_up
from indexing.clip import Clip, FloatArray
from indexing.skeleton import COCO17

Frames = NDArray[np.uint8]
DISTANCE = 2.9  # metres: a standing person fills about 60 % of the height of a 4:3 image
FOCAL = 0.72  # image widths, as in `indexing.actors.detect`
BLOCK = 32  # frames painted at once
_HEAD, _NECK, _PELVIS = 17, 18, 19  # added to the COCO joints
_LIMBS = ((5, 7), (7, 9), (6, 8), (8, 10), (11, 13), (13, 15), (12, 14), (14, 16))
_BODY = (*_LIMBS, (5, 6), (11, 12), (5, 11), (6, 12), (_NECK, _PELVIS), (_NECK, _HEAD))


def render_clip(
    clip: Clip,
    *,
    azimuth: float,
    elevation: float = 0.1,
    distance: float = DISTANCE,
    image: tuple[int, int] = (160, 120),
    noise: float = 2.0,
    rng: np.random.Generator | int = 0,
) -> Frames:
    """A grey video of a 3D clip: own texture, own background, perspective, sensor noise."""
    joints, bones = _figure(clip)
    if not (noise >= 0 and distance > 0):
        raise ValueError(f"noise must be at least 0 and distance positive (metres), got {noise!r} and {distance!r}")
    rng = np.random.default_rng(rng)
    generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
    pixels, depth = _project(joints, azimuth, elevation, distance, image)
    ends = np.asarray(bones).T
    length = np.median(np.linalg.norm(joints[:, ends[0]] - joints[:, ends[1]], axis=2), axis=0)
    radius = np.clip(0.22 * length, 0.03, 0.11)
    if clip.skeleton == COCO17:
        radius[-1] = 0.1  # the head
    background = 40 + 175 * texture(image[1], image[0], (4, 8, 16), generator)
    skins = torch.stack([20 + 215 * texture(24, 12, (3, 6), generator) for _ in bones])
    out = np.empty((len(clip), image[1], image[0]), dtype=np.uint8)
    for begin in range(0, len(clip), BLOCK):
        part = slice(begin, begin + BLOCK)
        canvas = background.expand(len(pixels[part]), -1, -1).clone()
        _paint(canvas, pixels[part][:, ends], FOCAL * image[0] * radius / depth[part][:, ends], depth[part][:, ends].mean(1), skins)
        canvas += noise * torch.randn(canvas.shape, generator=generator)
        out[part] = canvas.round_().clamp_(0, 255).to(torch.uint8).numpy()
    return out


def _figure(clip: Clip) -> tuple[FloatArray, tuple[tuple[int, int], ...]]:
    """Joints ``(frames, n, 3)``, y up, about their mean, and the bones to paint."""
    if clip.dims != 3 or clip.skeleton is None or not clip.skeleton.bones:
        raise ValueError(f"clip {clip.name!r}: a film needs 3D joints and a skeleton with bones, got {clip.dims}D joints")
    joints = y_up(clip).astype(np.float64)
    if not np.isfinite(joints).all():
        raise ValueError(f"clip {clip.name!r}: joints are missing; cut the clip to frames that have all joints")
    bones = clip.skeleton.bones
    if clip.skeleton == COCO17:
        middles = (joints[:, [3, 4]], joints[:, [5, 6]], joints[:, [11, 12]])
        joints = np.concatenate([joints, np.stack([pair.mean(axis=1) for pair in middles], axis=1)], axis=1)
        bones = _BODY
    return joints - joints.mean(axis=(0, 1)), bones


def _project(
    joints: FloatArray, azimuth: float, elevation: float, distance: float, image: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """Pixels ``(frames, n, 2)`` and depths ``(frames, n)``."""
    turned = joints @ rotation(np.deg2rad(azimuth), elevation).T
    depth = turned[..., 2] + distance
    if (depth <= 0.2).any():
        raise ValueError(f"a joint is {depth.min():.2f} m in front of the camera; increase distance={distance:g}")
    # Looking along +z in a right-handed frame with y up, x grows to the left: both image axes run against the scene's.
    return np.array(image) / 2 - FOCAL * image[0] * turned[..., :2] / depth[..., None], depth


def texture(height: int, width: int, cells: tuple[int, ...], generator: torch.Generator) -> Tensor:
    """``(height, width)`` in [0, 1]: smooth noise at several scales."""
    total = torch.zeros(1, 1, height, width)
    for n in cells:
        noise = torch.randn(1, 1, n, max(2, n * width // height), generator=generator)
        total += interpolate(noise, size=(height, width), mode="bicubic", align_corners=True)
    total = total[0, 0] - total.mean()
    return (0.5 + total / (4 * total.std())).clamp(0, 1)


def _paint(canvas: Tensor, ends: Any, radii: Any, depth: Any, skins: Tensor) -> None:
    """Paint all capsules onto ``canvas (T, h, w)``: ends ``(T, 2, bones, 2)``, radii ``(T, 2, bones)``, depths ``(T, bones)``."""
    a, b = (torch.from_numpy(ends[:, k]).float() for k in (0, 1))
    ra, rb = (torch.from_numpy(radii[:, k]).float() for k in (0, 1))
    order = torch.from_numpy(np.argsort(-depth, axis=1))
    frames = torch.arange(len(canvas))
    for rank in range(order.shape[1]):
        bone = order[:, rank]
        _capsule(canvas, a[frames, bone], b[frames, bone], ra[frames, bone], rb[frames, bone], skins[bone])


def _capsule(canvas: Tensor, a: Tensor, b: Tensor, ra: Tensor, rb: Tensor, skin: Tensor) -> None:
    """Blend one capsule per frame onto ``canvas``: axis from ``a`` to ``b (T, 2)``, radii ``(T,)``, texture ``(T, m, n)``."""
    reach = torch.maximum(ra, rb)[:, None] + 1
    low = (torch.minimum(a, b) - reach).amin(0).floor().long().clamp(min=0)
    high = (torch.maximum(a, b) + reach).amax(0).ceil().long() + 1
    window = canvas[:, int(low[1]) : max(int(high[1]), 0), int(low[0]) : max(int(high[0]), 0)]
    if window.numel() == 0:
        return
    y = torch.arange(window.shape[1]).view(1, -1, 1) + low[1] + 0.5 - a[:, 1].view(-1, 1, 1)
    x = torch.arange(window.shape[2]).view(1, 1, -1) + low[0] + 0.5 - a[:, 0].view(-1, 1, 1)
    dx, dy = (b - a).view(-1, 2, 1, 1).unbind(1)
    square = (dx * dx + dy * dy).clamp(min=1e-3)
    along = (x * dx + y * dy) / square
    across = (y * dx - x * dy) / square.sqrt()
    near = along.clamp(0, 1)
    radius = ra.view(-1, 1, 1) + near * (rb - ra).view(-1, 1, 1)
    gap = ((x - near * dx) ** 2 + (y - near * dy) ** 2).sqrt()
    cover = (radius - gap + 0.5).clamp_(0, 1)  # edges one pixel wide
    where = torch.stack([across / radius, 2 * along - 1], dim=-1)
    value = grid_sample(skin[:, None], where, padding_mode="reflection", align_corners=False)[:, 0]
    window += cover * (value - window)


# ----------------------------------------------------------------------------------------------------------------------
# Textured sheets that move rigidly before a moving camera, and where every pixel of them goes.


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

    def visible_sheets(self, points: Floats, frame: int) -> NDArray[np.int64]:
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

    def transfer(self, points: Floats, first: int, second: int) -> Floats:
        """Where points ``(n, 2)`` of one frame are in another, seen there or not; NaN where no sheet is visible in the first."""
        sheets = self.visible_sheets(points, first)
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
        to_patch = torch.from_numpy(np.array([[1.0, 0, -low[0]], [0, 1, -low[1]], [0, 0, 1]]) @ matrix).float()
        size = (int(high[1] - low[1]), int(high[0] - low[0]))
        shown = 20 + 215 * warp_perspective(one.texture[None, None], to_patch[None], size)[0, 0]
        value[patch] = torch.where(torch.from_numpy(mine), shown, value[patch])
        near[patch] = np.where(mine, depth, near[patch])
        seen[patch] = np.where(mine, k, seen[patch])
    return value, seen
