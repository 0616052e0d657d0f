"""Smoothed tracks at equal steps, for positions and velocities at any moment between."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.tasks.sync_tracks import Tracks, smoothed

CALM = 0.75, 1.25, 2.5
"""Velocities are smoothed more widely than positions: what noise they share with the residuals would pull the estimate and
make it look surer than it is.  How much more: 1 + .75 times the noise over the movement from frame to frame, within bounds."""


@dataclass(frozen=True, eq=False)
class Grid:
    """Smoothed tracks of b at equal steps, for positions and velocities anywhere between by cubic Hermite polynomials."""

    start: float
    step: float
    x: Tensor  # (m, n, 2)
    v: Tensor
    calm: Tensor  # velocities to differentiate by
    weights: Tensor  # (m, n)

    @staticmethod
    def of(tracks: Tracks, width: float) -> Grid:
        """With steps of half the kernel's width: between them the polynomial is exact to thousandths of the noise."""
        step, start = width / 2, float(tracks.times[0])
        count = max(2, math.ceil((float(tracks.times[-1]) - start) / step) + 1)
        at = start + step * torch.arange(count, dtype=torch.float64, device=tracks.x.device)
        x, v, weights = smoothed(tracks, at, width)
        speed = float(torch.where(weights > 0, v.square().sum(-1), torch.nan).nanmedian()) ** 0.5
        slope, least, most = CALM
        wider = min(max(1 + slope * tracks.noise / max(speed * width, 1e-300), least), most)
        _, calm, _ = smoothed(tracks, at, wider * width)
        return Grid(start, step, x, v, calm, weights)

    def at(self, times: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Positions, velocities ``(m, n, 2)`` and weights ``(m, n)``, 0 where not seen."""
        place = (times - self.start) / self.step
        left = place.floor().clamp(0, len(self.x) - 2).long()
        u = (place - left)[:, None, None]
        inside = (place >= 0) & (place <= len(self.x) - 1)
        x0, x1 = self.x[left], self.x[left + 1]
        v0, v1 = self.step * self.v[left], self.step * self.v[left + 1]
        d, s = x1 - x0, v0 + v1
        x = x0 + u * (v0 + u * (3 * d - s - v0 + u * (s - 2 * d)))
        v = self.calm[left] + u * (self.calm[left + 1] - self.calm[left])
        w0, w1 = self.weights[left], self.weights[left + 1]
        return x, v, torch.where((w0 > 0) & (w1 > 0) & inside[:, None], w0 + u[..., 0] * (w1 - w0), 0.0)
