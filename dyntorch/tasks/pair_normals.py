r"""The common direction of two affine cameras that see different points: which coordinate of one explains which of the other.

The planes through two parallel viewing rays cut both images along parallel lines.  Across these lines, along the epipolar normals
:math:`m_1, m_2`, both cameras see the same coordinate u of space, so that :math:`m_2 \cdot y_j` lies in the span of the
:math:`m_1 \cdot x_i` over time.  All pairs of directions are tried, so that no local optimum is taken for the best.

Source: Wolf and Zomet 2002, Correspondence-free synchronization and reconstruction in a non-rigid scene; thesis chapter 7.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyntorch.tasks.pair_regression import Rows, regress

GRID = 36
"""Directions of each camera: information changes little over 5 degrees."""
STARTS = 3
"""Peaks that are refined."""
FLOOR = 0.1
"""Of the noise's variance, added to all covariances, which already hold the noise itself.  Errors of the directions, CMU joints,
median of 16 at 1, 3 mm: 0.46, 1.6 degrees for .1; 0.83, 2.1 for 1; 1.4, 9.3 for 10."""
SHRINK = 0.4
FINEST = 1e-10
"""Radians."""
SETTLED = 1e-3
"""Gain of log likelihood below which noise decides."""


@dataclass(frozen=True)
class Motions:
    """Weighted motions of the points of both cameras over frequencies, of comparable units.

    Attributes:
        x: ``(F, n, 2)``; y: ``(F, m, 2)``.
        variance: of the noise of one coordinate.
        samples: of independent noise in the F rows.
        means: mean places ``(n, 2)``, ``(m, 2)`` about their centres.
    """

    x: Tensor
    y: Tensor
    variance: float
    samples: float
    means: tuple[Tensor, Tensor]
    dropped: int = 0

    @property
    def frequencies(self) -> int:
        """Rows, with those that were left out."""
        return len(self.x) + self.dropped

    def compressed(self) -> Motions:
        """The same products of columns in no more rows than there are columns."""
        columns = torch.cat([self.x.flatten(1), self.y.flatten(1)], dim=1)
        if len(columns) <= columns.shape[1]:
            return self
        small = torch.linalg.qr(columns, mode="r").R
        x, y = small.split([self.x[0].numel(), self.y[0].numel()], dim=1)
        dropped = self.dropped + len(columns) - len(small)
        return replace(self, x=x.unflatten(1, self.x.shape[1:]), y=y.unflatten(1, self.y.shape[1:]), dropped=dropped)


def direction(angle: Tensor) -> Tensor:
    """Unit vectors ``(..., 2)``."""
    return torch.stack([angle.cos(), angle.sin()], dim=-1)


def along(x: Tensor, angle: Tensor) -> Tensor:
    """Coordinates ``(g, ...)`` of ``(..., 2)`` along angles ``(g,)``."""
    return torch.movedim(x @ direction(angle).mT, -1, 0)


def information(motions: Motions, angles: Tensor) -> Tensor:
    r"""What the coordinates along two directions say of each other, ``(g,)``.

    .. math:: J = \tfrac12 \log\frac{|C_{yy} + \epsilon I|}{|C_{yy} + \epsilon I - C_{yx} (C_{xx} + \epsilon I)^{-1} C_{xy}|}
    """
    floor = max(FLOOR * motions.variance, 1e-14 * float(motions.x.square().sum(0).mean()) / motions.frequencies)
    x, y = (along(part, angle) for part, angle in zip((motions.x, motions.y), angles.unbind(-1), strict=True))
    n, m = x.shape[-1], y.shape[-1]
    both = torch.cat([x, y], dim=-1)
    moment = both.mT @ both / motions.frequencies + floor * torch.eye(n + m, dtype=x.dtype, device=x.device)
    # Cholesky: half of log |.| is the sum of the logarithms of the diagonal, of a Schur complement its last part
    whole = torch.linalg.cholesky_ex(moment)[0].diagonal(dim1=-2, dim2=-1)
    alone = torch.linalg.cholesky_ex(moment[:, n:, n:])[0].diagonal(dim1=-2, dim2=-1)
    return (alone.log().sum(-1) - whole[:, n:].log().sum(-1)).nan_to_num(nan=-torch.inf)


def peaks(motions: Motions) -> Tensor:
    """The best local maxima of :func:`information` on a grid over all directions, ``(k, 2)``, best first."""
    steps = torch.arange(GRID, dtype=motions.x.dtype, device=motions.x.device) * (torch.pi / GRID)
    values = torch.stack([information(motions, torch.stack([a.expand(GRID), steps], dim=-1)) for a in steps])
    around = [values.roll((i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
    top = torch.where((values >= torch.stack(around).amax(0)), values, -torch.inf).flatten()
    found, place = top.topk(STARTS)
    place = place[found.isfinite()]
    return torch.stack([steps[place // GRID], steps[place % GRID]], dim=-1)


def likelihood(motions: Motions, angles: Tensor, affine: bool = False) -> Tensor:
    """Log likelihood ``(g,)`` of each camera's coordinates given the other's, above their own; ``affine``: with the mean places."""
    both = [along(part, angle) for part, angle in zip((motions.x, motions.y), angles.unbind(-1), strict=True)]
    places = [along(part, angle) for part, angle in zip(motions.means, angles.unbind(-1), strict=True)]
    there = Rows.of(both[0], both[1], (places[0], places[1]) if affine else None, motions.dropped)
    back = Rows.of(both[1], both[0], (places[1], places[0]) if affine else None, motions.dropped)
    level = regress(there, means=affine).evidence + regress(back, means=affine).evidence
    floor = FLOOR * motions.variance
    for z in both:
        own = z.mT @ z / motions.frequencies
        own = own + (floor + 1e-14 * own.diagonal(dim1=-2, dim2=-1).mean(-1))[:, None, None] * torch.eye(len(own[0])).to(own)
        level = level + 0.5 * motions.samples * torch.linalg.slogdet(own).logabsdet
    return level


def refined(
    motions: Motions, start: Tensor, finest: float = FINEST, step: float = 0.5 * torch.pi / GRID, *, affine: bool = False
) -> tuple[Tensor, float]:
    """The directions ``(2,)`` of most likelihood near the start, and its value, by a grid that shrinks from step to finest."""
    offsets = torch.cartesian_prod(*(torch.tensor([-1.0, 0.0, 1.0], dtype=start.dtype, device=start.device),) * 2)
    angles, level = start, -torch.inf
    while step > finest:
        values = likelihood(motions, angles + step * offsets, affine).nan_to_num(nan=-torch.inf)
        best = int(values.argmax())
        gain, level = float(values[best]) - level, max(level, float(values[best]))
        angles = angles + step * offsets[best]
        if best == len(offsets) // 2:
            if float(values.max() - values.min()) < SETTLED:
                break
            step *= SHRINK
        elif gain < SETTLED:
            break
    return angles, level
