"""Rigs of known cameras before smooth random motion, imaged by formulas of their own."""

from dataclasses import dataclass

import torch
from torch import Tensor

from tests.draws import seeded

F64 = torch.float64


def exponential(vector: Tensor) -> Tensor:
    """The rotation by a vector, by the matrix exponential."""
    x, y, z = vector.double().tolist()
    return torch.linalg.matrix_exp(torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=F64))


def pictures(points, R, t, focal, k1=0.0, k2=0.0, middle=(960.0, 540.0)):
    """Images ``(..., 2)`` px of points in a camera whose lens has two terms."""
    seen = points @ R.mT + t
    u = seen[..., :2] / seen[..., 2:]
    r2 = (u**2).sum(-1, keepdim=True)
    return focal * u * (1 + k1 * r2 + k2 * r2**2) + torch.tensor(middle, dtype=F64)


def angles(R, truth):
    """Degrees ``(c,)`` between cameras of two rigs after the rotation that the first camera says."""
    turn = R[0].mT @ truth[0]
    away = R @ turn @ truth.mT
    sine = torch.stack([away[:, 2, 1] - away[:, 1, 2], away[:, 0, 2] - away[:, 2, 0], away[:, 1, 0] - away[:, 0, 1]], -1).norm(
        dim=-1
    )
    return torch.rad2deg(torch.atan2(sine, away.diagonal(dim1=-2, dim2=-1).sum(-1) - 1))


def shape_error(centers, truth):
    """Largest distance of centres from their true places after the best similarity, over the spread of these."""
    a, b = centers - centers.mean(0), truth - truth.mean(0)
    U, S, Vt = torch.linalg.svd(a.mT @ b)
    sign = torch.ones(3, dtype=F64)
    sign[2] = torch.sign(torch.linalg.det(U @ Vt))
    scale = (S * sign).sum() / a.square().sum()
    return float((scale * a @ U @ torch.diag(sign) @ Vt - b).norm(dim=-1).max() / b.norm(dim=-1).max())


@dataclass(frozen=True)
class Take:
    """What is filmed, and by which cameras."""

    tracks: list[Tensor]
    R: Tensor
    t: Tensor
    focals: list[float]
    times: list[Tensor]

    @property
    def centers(self) -> Tensor:
        return -(self.R.mT @ self.t[..., None])[..., 0]


class Motion:
    """n points on smooth ways of their own, at any time."""

    def __init__(self, n=8, seed=0, place=(0.0, 0.0, 0.0), flat=False):
        way = torch.randn(3, n, 3, generator=seeded(seed), dtype=F64)
        self.base, self.one, self.other = 0.4 * way[0] + torch.tensor(place, dtype=F64), way[1], way[2]
        self.factor = torch.tensor([1.0, 1.0, 0.0 if flat else 1.0], dtype=F64)

    def __call__(self, t):
        """``(T, n, 3)``."""
        t = t[:, None, None]
        return self.factor * (self.base + 0.6 * torch.sin(1.3 * t + self.one) + 0.3 * torch.sin(2.9 * t + self.other))


def filmed(
    motion, cameras=4, frames=110, fps=30.0, offsets=None, rates=None, focals=None, k1=0.0, noise=0.0, seed=0, line=False,
    times=None,
):  # fmt: skip
    """What cameras around a motion see; camera i's clock is rate_i t + offset_i."""
    draw = seeded(100 + seed)
    offsets, rates = offsets or [0.0] * cameras, rates or [1.0] * cameras
    focals = focals or [1500.0] * cameras
    fps = [fps] * cameras if isinstance(fps, float) else fps
    tracks, R, t, clocks = [], [], [], []
    for k in range(cameras):
        turn = exponential(torch.tensor([0.3 * (k % 2), 0.0 if line else 1.5 * k, 0.0]))
        away = torch.tensor([0.1 * k if not line else 1.2 * k - 1.2, 0.0, 5.0], dtype=F64)
        clock = torch.arange(frames, dtype=F64) / fps[k] if times is None else times[k]
        seen = pictures(motion((clock - offsets[k]) / rates[k]), turn, away, focals[k], k1)
        tracks.append(seen + noise * torch.randn(*seen.shape, generator=draw, dtype=F64))
        R.append(turn), t.append(away), clocks.append(clock)
    return Take(tracks, torch.stack(R), torch.stack(t), list(focals), clocks)
