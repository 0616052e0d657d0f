"""Where something moves: the box of a take, and the box that follows a person across the image or the image with its camera."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import conv1d, grid_sample

from indexing.brightness.camera import Drift, drift
from indexing.brightness.features import as_grey, blur, gradients

SIDE = 96  # px of a crop
QUIET = 0.006  # grey 0..1 per frame: less than this is noise
NOISE = 6.0  # times the median change: 4 standard deviations, 1 pixel in 16,000 by chance
SIGMA = 1.5
INSIDE = (0.02, 0.98)  # quantiles of the motion that a box encloses
PAD = 0.15  # of the box, on each side
SMALLEST = 0.35  # of the image's height
FOLLOW = 0.2  # seconds over which a moving box is smoothed
WIDER = 1.6  # times the moving box, from which the box of the take is too wide
LIVELY = 3e-4  # of the pixels must change in a frame that shows motion: 5 times what noise does
BLOCK = 32

Region = tuple[float, float, float, float]


@dataclass(frozen=True)
class Motion:
    """Where something moves.

    Attributes:
        rows, columns: ``(T, h)`` and ``(T, w)`` sums of the brightness change above the noise.
        changed: ``(T,)`` share of the pixels that change.
        drift: how the background moves.
    """

    rows: Tensor
    columns: Tensor
    changed: Tensor
    drift: Drift

    @property
    def lively(self) -> Tensor:
        """``(T,)`` bool: frames in which something moves."""
        return self.changed > LIVELY

    @property
    def activity(self) -> Tensor:
        """``(T,)`` mean brightness change per pixel."""
        return self.rows.sum(1) / (self.rows.shape[1] * self.columns.shape[1])


def motion(frames: Tensor, region: Region | None = None) -> Motion:
    """What moves in frames ``(T, h, w)``, in a region ``(x0, y0, x1, y1)`` of their pixels, after the background's own motion."""
    rows, columns, changed, steps, lost = [], [], [], [], []
    for begin in range(0, len(frames), BLOCK):
        first, end = max(begin - 1, 0), min(begin + BLOCK + 1, len(frames))
        gx, gy, gt = (g[begin - first :][:BLOCK] for g in gradients(blur(as_grey(frames[first:end]), SIGMA)))
        camera = drift(gx, gy, gt)
        dx, dy = camera.step.float().T[..., None, None]
        change = (gt + gx * dx + gy * dy).abs()
        change = (change - max(QUIET, NOISE * float(change.median()))).clamp(min=0)
        if region is not None:
            x0, y0, x1, y1 = (round(v) for v in region)
            mask = change.new_zeros(change.shape[1:])
            mask[max(y0, 0) : max(y1, 0), max(x0, 0) : max(x1, 0)] = 1
            change = change * mask
        rows.append(change.sum(2).double())
        columns.append(change.sum(1).double())
        changed.append((change > 0).double().mean((1, 2)))
        steps.append(camera.step)
        lost.append(camera.lost)
    return Motion(torch.cat(rows), torch.cat(columns), torch.cat(changed), Drift(torch.cat(steps), torch.cat(lost)))


def boxes(found: Motion, fps: float) -> tuple[Tensor, bool]:
    """``(T, 3)`` centre x, centre y and side in pixels of the square about what moves, frame by frame, and whether it moves.

    One box for the take, or, where a person crosses the image, one of constant size that follows the person smoothly.
    """
    height = found.rows.shape[1]
    path = found.drift.path if found.drift.moves else found.rows.new_zeros(len(found.rows), 2)
    across, along = (_quantiles(_smooth(m, FOLLOW * fps)) for m in (found.columns, found.rows))
    following = _square(across, along, height)
    seen = _smooth(found.lively.double()[:, None], FOLLOW * fps)[:, 0] > 0
    whole = _square(_quantiles(found.columns.sum(0, keepdim=True)), _quantiles(found.rows.sum(0, keepdim=True)), height)
    size = following[seen, 2].median() if bool(seen.any()) else whole[0, 2]
    if found.drift.moves or whole[0, 2] > WIDER * size:
        following[~seen] = whole
        centre = _smooth(following[:, :2] - path, FOLLOW * fps) + path
        return torch.cat([centre, size.expand(len(centre), 1)], dim=1), True
    return whole.expand(len(path), 3), False


def _quantiles(marginals: Tensor) -> Tensor:
    """``(T, 2)`` positions between which INSIDE of the sums of ``(T, n)`` lie."""
    total = marginals.cumsum(1)
    share = total / total[:, -1:].clamp(min=1e-12)
    return torch.stack([(share < q).sum(1).double() + end for q, end in zip(INSIDE, (0.0, 1.0), strict=True)], dim=1)


def _square(across: Tensor, along: Tensor, height: int) -> Tensor:
    size = torch.maximum(across[:, 1] - across[:, 0], along[:, 1] - along[:, 0]) * (1 + 2 * PAD)
    return torch.stack([across.mean(1), along.mean(1), size.clamp(min=SMALLEST * height)], dim=1)


def _smooth(values: Tensor, sigma: float) -> Tensor:
    """Gaussian mean over time of ``(T, n)``, renormalized at the ends."""
    reach = max(1, int(3 * sigma))
    kernel = torch.exp(-0.5 * (torch.arange(-reach, reach + 1, dtype=values.dtype, device=values.device) / sigma) ** 2)[None, None]
    weight = conv1d(values.new_ones(1, 1, len(values)), kernel, padding=reach)[0].T
    return conv1d(values.T[:, None], kernel, padding=reach)[:, 0].T / weight


def crop(frames: Tensor, where: Tensor, side: int = SIDE) -> Tensor:
    """``(n, side, side)`` float32 crops of frames ``(n, h, w)`` in boxes ``(n, 3)``; the border is repeated outside the image."""
    height, width = frames.shape[1:]
    steps = (torch.arange(side, device=where.device) + 0.5) / side - 0.5
    x, y, size = where.float().T[..., None]
    gx = 2 * (x + steps * size) / width - 1
    gy = 2 * (y + steps * size) / height - 1
    grid = torch.stack([gx[:, None].expand(-1, side, -1), gy[..., None].expand(-1, -1, side)], dim=-1)
    return grid_sample(as_grey(frames)[:, None], grid, padding_mode="border", align_corners=False)[:, 0]
