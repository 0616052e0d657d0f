"""What the points of one camera tell about time, whichever points they are: how the body changes and how it moves on the whole."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

STEP = 1 / 30
"""Seconds from frame to frame, unless told."""
SMOOTH = 1 / 30
"""Seconds, standard deviation of the Gaussian that positions are smoothed by (15 mm of noise: twice that finds one to two
percent less)."""
SLOW = 1 / 3
"""Seconds, of the Gaussian for the size of the body in the image: the distance changes slowly (half to six times as much are
alike to a percent)."""
WIDE = (1.0, 2.5, 6.0, 15.0, 40.0)
"""Frames, of ever wider Gaussians that look for what is missing."""
NOISE = 2.0
"""Noise variance of the rows over that of third differences: cameras are not affine (1 to 4 are alike, 8 is 4 percent
worse)."""
NARROW = 0.7
"""Frames, the least smoothing: below, a sampled Gaussian is none."""
ROUNDS = 12
"""Fills of what is missing from the other points."""
EDGE = 2.0
"""Widths of smoothing left out at either end, where it is one-sided, in both cameras at once: that would speak for lag 0."""
STRAY = 3.0
"""Median distances from the middle beyond which a track takes no part in the middle and the size."""
ROUNDING = 1e-6
"""Of the extent of the points: what a track is off a line by that says nothing."""
TINY = 1e-9
"""Of the size of the body: the least standard deviation of noise that is believed."""


@dataclass(frozen=True, eq=False)
class Body:
    """One camera's points over time.

    Attributes:
        rows: ``(T', 2n)`` without the ends, coordinates about the body's middle over its size, smoothed, in units of noise.
        motion: ``(T', 2)`` px per frame, the median velocity of the points.
        weights: ``(T',)`` 1 where a frame is seen, else 0.
        points: ``(T, n, 2)`` px, what is missing filled in.
        seen: ``(T, n)`` bool.
        step: seconds from frame to frame.
    """

    rows: Tensor
    motion: Tensor
    weights: Tensor
    points: Tensor
    seen: Tensor
    step: float

    @property
    def bend(self) -> float:
        """Variance of the points about straight lines at constant velocity, one each, over that of their noise."""
        time = torch.linspace(-1, 1, len(self.points), dtype=self.points.dtype, device=self.points.device)[:, None, None]
        w = self.seen.to(self.points)[..., None]
        # two parameters a track are to spare: one seen less often is on its line by itself
        spare = (w.sum(0) - 2).clamp(min=0)
        count = w.sum(0).clamp(min=1)
        x, t = self.points - (w * self.points).sum(0) / count, time - (w * time).sum(0) / count
        square = (w * t * t).sum(0)
        x = x - t * (w * t * x).sum(0) / torch.where(square > 0, square, 1.0)
        extent = float(self.points.flatten(0, 1).std(0).norm())
        noise = max(_noise(self.points, self.seen), (ROUNDING * extent) ** 2, 1e-300)
        return float((w * x.square()).sum() / (2 * spare.sum()).clamp(min=1)) / noise

    @property
    def reversed(self) -> Body:
        """The same played backwards: as smooth, and in step with nothing."""
        return replace(self, rows=self.rows.flip(0), motion=self.motion.flip(0), weights=self.weights.flip(0))

    @property
    def blurred(self) -> Body:
        """Rows with as much more noise as a time that is known to a frame only makes."""
        if len(self.rows) < 2:
            return self
        velocity = torch.gradient(self.rows, dim=0)[0].square().mean()
        return replace(self, rows=self.rows / (1 + velocity / 12).sqrt())

    @property
    def signal(self) -> float:
        """Directions in which the body's shape moves by more than noise."""
        x = self.rows[self.weights > 0]
        if len(x) < 2:
            return 0.0
        values = torch.linalg.eigvalsh(torch.cov(x.mT, correction=0).reshape(x.shape[1], x.shape[1])).clamp(min=0.0)
        return float((values / (values + 1)).sum())


def body_of(x: Tensor, weights: Tensor, step: float = STEP) -> Body:
    """Rows, motion and weights of tracks ``(T, n, 2)`` with weights ``(T, n)``, 0 = missing; some frames less at each end."""
    seen = (weights > 0) & x.isfinite().all(-1)
    x = torch.where(seen[..., None], x, 0.0).double()
    whole = seen.sum(-1) >= min(2, seen.shape[1])
    edge = _edge(step)
    if not bool(whole.any()) or len(x) <= 2 * edge:
        rest = max(len(x) - 2 * edge, 1)
        return Body(x.new_zeros(rest, 2 * x.shape[1]), x.new_zeros(rest, 2), x.new_zeros(rest), x, seen, step)
    return _body(completed(filled(x, seen), seen), seen, whole, step)


def halves(body: Body) -> tuple[Body, Body]:
    """Bodies of either half of the points: their noise is independent."""
    n = body.points.shape[1]
    order = torch.randperm(n, generator=torch.Generator().manual_seed(0)).to(body.points.device)
    whole = body.seen.sum(-1) >= min(2, n)
    first, second = (
        _body(body.points[:, part], body.seen[:, part], whole, body.step) for part in (order[: (n + 1) // 2], order[n // 2 :])
    )
    return first, second


def _body(held: Tensor, seen: Tensor, whole: Tensor, step: float) -> Body:
    """The body of complete points."""
    width, edge = _width(step), _edge(step)
    size, middle = _frame(held, SLOW / step)
    shape = (held - middle) / size[:, None, None]
    variance = max(_noise(shape, seen), TINY**2) * NOISE / (2 * math.sqrt(math.pi) * width)
    rows = smooth(shape, width).flatten(1)
    inside = slice(edge, -edge)
    rows = rows[inside]
    rows = (rows - rows.mean(0)) / math.sqrt(variance)
    return Body(rows, _motion(held, width)[inside], whole.double()[inside], held, seen, step)


def _width(step: float) -> float:
    return max(SMOOTH / step, NARROW)


def _edge(step: float) -> int:
    return math.ceil(EDGE * _width(step) - 1e-9)


def smooth(x: Tensor, width: float) -> Tensor:
    """Gaussian means along the first dimension, of what there is at the ends."""
    return _convolved(x, width) / _convolved(x.new_ones(len(x), *[1] * (x.ndim - 1)), width)


def filled(x: Tensor, seen: Tensor) -> Tensor:
    """Missing positions ``(T, n)`` from the same track's nearest times, by the narrowest Gaussian that sees some."""
    result, open_ = x, ~seen
    for width in WIDE:
        if not bool(open_.any()):
            return result
        share = _convolved(seen.double(), width)
        found = _convolved(torch.where(seen[..., None], x, 0.0), width) / share.clamp(min=1e-12)[..., None]
        take = open_ & (share > 0.1)
        result, open_ = torch.where(take[..., None], found, result), open_ & ~take
    count = seen.sum(0).clamp(min=1)[:, None]
    mean = torch.where(seen[..., None], x, 0.0).sum(0) / count
    return torch.where(open_[..., None], mean, result)


def _frame(x: Tensor, slow: float) -> tuple[Tensor, Tensor]:
    """Size ``(T,)`` and middle ``(T, 1, 2)`` of the body, of tracks that stay with it."""
    far = (x - x.median(1, keepdim=True).values).norm(dim=-1)
    ratio = (far / far.median(1, keepdim=True).values.clamp(min=1e-300)).median(0).values
    kept = (ratio <= max(STRAY, float(ratio.min())))[None, :, None]
    middle = (x * kept).sum(1, keepdim=True) / kept.sum()
    spread = ((x - middle).square() * kept).sum((1, 2)) / kept.sum()
    size = smooth(spread.sqrt(), slow)
    return size.clamp(min=1e-9 * float(size.max()) + 1e-300), middle


def _noise(x: Tensor, seen: Tensor) -> float:
    r"""Variance of a coordinate from third differences :math:`(\mathrm{med}|d_3| / .6745)^2 / 20`: motion is smooth."""
    rough = x.diff(n=3, dim=0)[seen[3:] & seen[2:-1] & seen[1:-2] & seen[:-3]].abs()
    return (float(rough.median()) / 0.6745) ** 2 / 20 if rough.numel() else 0.0


def completed(x: Tensor, seen: Tensor) -> Tensor:
    r"""Positions ``(T, n, 2)``, those missing by regression on the other points of their frame, over and over.

    .. math:: x_j \leftarrow x_j - K_{jj}^{-1} (K x)_j, \qquad K = (C + \sigma^2 I)^{-1}

    is the regression of point j on the others under the covariance C of all coordinates.  What regression leaves of a point at
    the nearest times that it is seen is added: half as much is wrong.
    """
    if bool(seen.all()):
        return x
    mean = x.mean(0)
    rows, n = (x - mean).flatten(1), x.shape[1]
    noise = max(_noise(x, seen), 1e-6 * float(rows.square().mean()), 1e-300)
    unit = torch.eye(2 * n, dtype=x.dtype, device=x.device)
    for _ in range(ROUNDS):
        inverse = torch.linalg.inv(rows.mT @ rows / len(rows) + noise * unit)
        own = inverse.unflatten(0, (n, 2)).unflatten(2, (n, 2)).diagonal(dim1=0, dim2=2).movedim(-1, 0)  # (n, 2, 2)
        change = torch.linalg.solve(own, (rows @ inverse).unflatten(1, (n, 2)).movedim(0, 2)).movedim(2, 0)
        nearby = filled(torch.where(seen[..., None], change, 0.0), seen)
        rows = rows - torch.where(seen[..., None], 0.0, change - nearby).flatten(1)
    return rows.unflatten(1, (n, 2)) + mean


def _motion(x: Tensor, width: float) -> Tensor:
    """Median velocity ``(T, 2)`` of the points: a few that go elsewhere do not matter."""
    velocity = torch.gradient(smooth(x, width), dim=0)[0]
    return 0.5 * (velocity.median(1).values - (-velocity).median(1).values)  # of both middle ones


def _convolved(x: Tensor, width: float) -> Tensor:
    """Sums under a Gaussian of sum 1 along the first dimension."""
    reach = min(math.ceil(4 * width), max(len(x) - 1, 1))
    u = torch.arange(-reach, reach + 1, dtype=x.dtype, device=x.device) / width
    kernel = torch.exp(-0.5 * u.square())
    flat = x.reshape(len(x), -1).mT[:, None]
    return torch.nn.functional.conv1d(flat, (kernel / kernel.sum())[None, None], padding=reach)[:, 0].mT.reshape(x.shape)
