"""Non-rigid scenes before two static cameras, with points that only one of them sees."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class NonrigidScene:
    """Tracks of two affine cameras and the truth.

    Attributes:
        a: ``(frames, n, 2)`` pixels, at frames 0, 1, ... of ``fps`` frames per second.
        b: ``(frames, m, 2)``; b's clock = a's clock + offset.
        points: ``(frames, n + m, 3)`` at a's moments.
        images: ``(2, frames, n + m, 2)`` of both cameras at a's moments, without noise.
        cameras: ``(2, 3, 4)``.
        offset: seconds.
        fps: of both cameras.
    """

    a: Tensor
    b: Tensor
    points: Tensor
    images: Tensor
    cameras: Tensor
    offset: float
    fps: float


def nonrigid_pair(
    n: int,
    m: int,
    frames: int,
    *,
    shapes: int = 3,
    sigma: float = 0.0,
    offset: float = 0.0,
    planar: bool = False,
    generator: torch.Generator | None = None,
) -> NonrigidScene:
    r"""Points that are constant affine combinations of a few moving ones.

    .. math:: P_i(t) = \sum_k L_{ik} B_k(t), \qquad \sum_k L_{ik} = 1

    Args:
        n: points that a tracks; m: that b tracks.
        frames: of both, 30 per second.
        shapes: moving points that all others are combinations of, besides one.
        sigma: noise of a coordinate, pixels; the motion is of about 40 px rms.
        offset: seconds, any fraction of a frame.
        planar: all points stay in one plane.
        generator: source of all randomness.

    Example:
        >>> scene = nonrigid_pair(8, 6, 50, generator=torch.Generator().manual_seed(0))
        >>> scene.a.shape, scene.points.shape
        (torch.Size([50, 8, 2]), torch.Size([50, 14, 3]))
    """

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    fps, count = 30.0, shapes + 1
    weights = normal(n + m, count)
    weights = weights + (1 - weights.sum(-1, keepdim=True)) / count
    # sums of five slow waves: nothing faster than 2.5 Hz
    speed, phase, size = (
        0.5 + 2 * torch.rand(5, count, 3, generator=generator, dtype=torch.float64),
        normal(5, count, 3),
        normal(5, count, 3),
    )
    rest = 40 * normal(count, 3)

    def at(times: Tensor) -> Tensor:
        angle = 2 * torch.pi * speed * times[:, None, None, None] + 3 * phase
        found = weights @ (rest + 12 * (size * angle.sin()).sum(1))
        return torch.cat([found[..., :2], 0.3 * found[..., :1] - 0.2 * found[..., 1:2]], dim=-1) if planar else found

    cameras = torch.zeros(2, 3, 4, dtype=torch.float64)
    for k in range(2):
        cameras[k, :2, :3] = torch.linalg.qr(normal(3, 3)).Q[:2] * (1.0, 1.3)[k]
        cameras[k, :2, 3] = torch.tensor([400.0, 300.0], dtype=torch.float64)
    cameras[:, 2, 3] = 1.0
    times = torch.arange(frames, dtype=torch.float64) / fps
    points, shifted = at(times), at(times - offset)
    images = points @ cameras[:, None, :2, :3].mT + cameras[:, None, None, :2, 3]
    b = shifted[:, n:] @ cameras[1, :2, :3].mT + cameras[1, :2, 3]
    a = images[0, :, :n] + sigma * normal(frames, n, 2)
    return NonrigidScene(a, b + sigma * normal(frames, m, 2), points, images, cameras, offset, fps)
