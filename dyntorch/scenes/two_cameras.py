"""A person before two static perspective cameras, each with its own clock, and what a detector makes of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.geometry.homogeneous import apply, skew
from dyntorch.geometry.lens import Division
from dyntorch.scenes.scene import calibration, looking_at

FOCAL, SIZE, DISTANCE = 1000.0, (1280.0, 960.0), 4.5
BODY = (0.2, 0.45, 0.2)
"""Metres, standard deviations of the points from the middle of the person: across, up, deep."""
WAVES = 4
BLOCK = 12
"""Frames, about, for which a point is missing at a time."""
FAR_OFF = 150.0
"""Pixels, standard deviation of an outlier from where the point is."""


@dataclass(frozen=True)
class FilmedScene:
    """Tracks of two cameras and the truth.

    Attributes:
        a, b: ``(frames, n, 2)`` px, y down, with noise, lens distortion, outliers and wrong points; NaN where missing.
        exact: the same of ideal cameras, two of ``(frames, n, 2)``.
        times: ``(frames,)`` seconds of each camera's own clock.
        offset, rate: b's clock = a's clock * rate + offset.
        fps: of both.
        points: ``(frames, n, 3)`` metres, at a's moments.
        cameras: ``(2, 3, 4)``.
        fundamental: ``(3, 3)`` of norm 1, :math:`x_b^T F x_a = 0`.
        outliers: ``(frames, n)`` bool of each camera: positions that are elsewhere.
        wrong: ``(n,)`` bool: b shows another point.
    """

    a: Tensor
    b: Tensor
    exact: tuple[Tensor, Tensor]
    times: tuple[Tensor, Tensor]
    offset: float
    rate: float
    fps: tuple[float, float]
    points: Tensor
    cameras: Tensor
    fundamental: Tensor
    outliers: tuple[Tensor, Tensor]
    wrong: Tensor


def filmed_person(
    n: int = 15,
    seconds: float = 4.0,
    *,
    fps: tuple[float, float] = (30.0, 30.0),
    times: tuple[Tensor, Tensor] | None = None,
    offset: float = 0.0,
    rate: float = 1.0,
    noise: float = 0.0,
    missing: float = 0.0,
    outliers: float = 0.0,
    wrong: int = 0,
    lens: float = 0.0,
    walk: float = 0.6,
    period: float | None = None,
    generator: torch.Generator | None = None,
) -> FilmedScene:
    r"""Points that wobble about a person who walks, as two cameras film them, 60 degrees apart.

    .. math:: P_i(t) = B_i + W(t) + \sum_k A_{ik} \sin(\omega_{ik} t + \phi_{ik}), \qquad t_b = \text{rate}\; t_a + \text{offset}

    Args:
        n: points.
        seconds: that each camera films, from 0 s of its own clock.
        fps: frames per second of both.
        times: seconds of each frame of each camera's own clock, instead of ``seconds`` and ``fps``.
        offset: of b's clock, seconds.
        rate: of b's clock.
        noise: of a coordinate, px; the person is about 300 px tall.
        missing: share of the positions, in blocks.
        outliers: share of the positions that are elsewhere.
        wrong: how many points b takes for others, all the time.
        lens: the division model's parameter of both cameras; negative = barrel.
        walk: metres, how far the person walks to and fro; 0 = stays.
        period: seconds in which the wobbling repeats itself exactly; None = never.
        generator: source of all randomness.

    Example:
        >>> scene = filmed_person(12, seconds=2.0, fps=(30.0, 25.0), offset=0.3, generator=torch.Generator().manual_seed(0))
        >>> scene.a.shape, scene.b.shape
        (torch.Size([60, 12, 2]), torch.Size([50, 12, 2]))
    """
    clocks = times or (_clock(seconds, fps[0]), _clock(seconds, fps[1]))
    position = _motion(n, walk, period, generator)
    cameras = _cameras(generator)
    # b films a's moments (t_b - offset) / rate
    points = position(clocks[0]), position((clocks[1] - offset) / rate)
    exact = apply(cameras[0], points[0]), apply(cameras[1], points[1])
    mistaken = torch.zeros(n, dtype=torch.bool).index_fill(0, torch.randperm(n, generator=generator)[:wrong], True)
    own = torch.arange(n)
    seen = exact[0], exact[1][:, torch.where(mistaken, (own + 1) % n, own)]
    shown = [_detect(x, noise, missing, outliers, lens, generator) for x in seen]
    return FilmedScene(
        a=shown[0][0],
        b=shown[1][0],
        exact=exact,
        times=clocks,
        offset=offset,
        rate=rate,
        fps=fps,
        points=points[0],
        cameras=cameras,
        fundamental=_fundamental(cameras),
        outliers=(shown[0][1], shown[1][1]),
        wrong=mistaken,
    )


def _clock(seconds: float, fps: float) -> Tensor:
    return torch.arange(round(seconds * fps), dtype=torch.float64) / fps


def _motion(n: int, walk: float, period: float | None, generator: torch.Generator | None) -> Callable[[Tensor], Tensor]:
    """Positions ``(frames, n, 3)`` metres, of moments ``(frames,)`` seconds."""

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    rest = normal(n, 3) * torch.tensor(BODY, dtype=torch.float64)
    share = torch.rand(WAVES, n, 3, generator=generator, dtype=torch.float64)
    cycles = 0.3 + 1.5 * share if period is None else (1 + (WAVES * share).floor()) / period  # per second
    speeds = 2 * math.pi * cycles
    phases, sizes = 2 * math.pi * normal(WAVES, n, 3), 0.06 * normal(WAVES, n, 3)
    # to and fro across the floor, slower than any limb
    pace, start = 2 * math.pi * (0.05 + 0.1 * torch.rand(2, 3, generator=generator, dtype=torch.float64)), 6 * normal(2, 3)
    floor = walk * torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64)

    def at(times: Tensor) -> Tensor:
        t = times[:, None, None, None]
        limbs = (sizes * (speeds * t + phases).sin()).sum(1)
        walked = floor * (pace * times[:, None, None] + start).sin().mean(1)
        return rest + limbs + walked[:, None]

    return at


def _cameras(generator: torch.Generator | None) -> Tensor:
    """``(2, 3, 4)``, 60 degrees apart, at eye level."""
    azimuth = torch.tensor([0.0, math.pi / 3], dtype=torch.float64) + 2 * math.pi * torch.rand((), generator=generator)
    height = 0.4 * torch.randn(2, generator=generator, dtype=torch.float64)
    eye = torch.stack([DISTANCE * azimuth.sin(), height, DISTANCE * azimuth.cos()], dim=-1)
    K = calibration(torch.tensor([1.0, 0.9], dtype=torch.float64) * FOCAL, 0.0)
    K[:, :2, 2] = torch.tensor(SIZE, dtype=torch.float64) / 2
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64).expand(2, 3)
    return K @ looking_at(eye, torch.zeros_like(eye), up)


def _fundamental(cameras: Tensor) -> Tensor:
    """From the centre of the first camera and the map that takes its rays to the second picture."""
    first, second = cameras
    centre = torch.linalg.solve(first[:, :3], -first[:, 3:])[:, 0]
    epipole = second[:, :3] @ centre + second[:, 3]
    F = skew(epipole) @ second[:, :3] @ torch.linalg.inv(first[:, :3])
    return F / F.norm()


def _detect(
    x: Tensor, noise: float, missing: float, outliers: float, lens: float, generator: torch.Generator | None
) -> tuple[Tensor, Tensor]:
    """What a detector makes of ideal pixels, and which positions are elsewhere."""
    frames, n, _ = x.shape
    if lens:
        x = Division.of(x, SIZE, lens).distort(x)
    x = x + noise * torch.randn(x.shape, generator=generator, dtype=torch.float64)
    far = torch.rand(frames, n, generator=generator) < outliers
    x = torch.where(far[..., None], x + FAR_OFF * torch.randn(x.shape, generator=generator, dtype=torch.float64), x)
    blocks = torch.rand(frames // BLOCK + 2, n, generator=generator) < missing
    begun = torch.randint(BLOCK, (n,), generator=generator)  # blocks of different points begin at different frames
    gone = blocks[(torch.arange(frames)[:, None] + begun) // BLOCK, torch.arange(n)]
    return torch.where(gone[..., None], torch.nan, x), far & ~gone


# ----------------------------------------------------------------------------------------------------------------------
# Non-rigid scenes before two static cameras, with points that only one of them sees.


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
