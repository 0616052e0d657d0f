r"""When a single view of a moving shape was taken: the residual over a grid of times, its minima refined, the second one kept."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from math import prod

import numpy as np
import torch
from torch import Tensor

from dyntorch.core.outcome import Outcome, status_of
from dyntorch.numerics.arguments import check_weights
from dyntorch.numerics.blocks import one_thread
from dyntorch.shapes.basis import Trajectory
from dyntorch.shapes.moving import centred_views, project, shapes_at

CHUNK = 1 << 22
"""Numbers in the largest temporary."""
RIDGE_EPSILON = 1e-12
NUM_MINIMA = 3
"""Minima of the grid that are refined."""
TIME_STEPS = 8
"""Gauss-Newton steps in the time; exact data need 4 from a grid of 64, noise of 3 % 6."""


@dataclass(frozen=True, eq=False, repr=False)
class Recovery(Outcome):
    """Result of :func:`recover_times`: one entry per view.

    Attributes:
        residual: ``(*batch, views)`` part of the energy of the view that the shape at its best time leaves, in [0, 1]; 1 where
            the view says nothing.
        times: ``(*batch, views)`` that time; the middle of the grid where the view says nothing.
        sigma: ``(*batch, views)`` expected error of the time for noise 1 of the normalized view: times the noise of the shapes.
        second: ``(*batch, views)`` the time of the next minimum; the same time where there is none.
        rise: ``(*batch, views)`` how much more it leaves; infinite where there is none.
        status: ``(*batch, views)``: ``TOO_FEW`` where the view says nothing.
    """

    residual: Tensor
    times: Tensor
    sigma: Tensor
    second: Tensor
    rise: Tensor

    TASK = "recover_times"

    def __repr__(self) -> str:
        return f"Recovery(views={self.times.shape[-1]}, batch={tuple(self.times.shape[:-1])}: {self.count_statuses()})"

    def ambiguous(self, noise: Tensor | float, odds: float = 20.0) -> Tensor:
        """Whether noise of this standard deviation could exchange the two times, ``(*batch, views)`` bool.

        The likelihoods of two times differ by the factor exp(rise / 2 noise^2); below ``odds`` the view does not decide.
        """
        sigma = torch.as_tensor(noise, device=self.rise.device)
        return self.rise < 2 * sigma[..., None] ** 2 * math.log(odds)


@one_thread
def recover_times(
    shapes: Tensor,
    basis: Trajectory,
    x: Tensor,
    weights: Tensor | None = None,
    *,
    grid: int = 64,
    interval: tuple[float, float] = (-1.0, 1.0),
) -> Recovery:
    r"""Find the time at which a moving shape looks most like each of some new views, and what it leaves unexplained.

    .. math:: f(t) = \|(I - \Pi(t))\,\bar x\|^2, \qquad \Pi(t) \text{ onto } \mathrm{span}[1, X(t)]

    on a grid for all views by one product with precomputed projectors, then by Gauss-Newton from its three deepest minima.

    Args:
        shapes: ``(*batch, B, n, 3)`` of :func:`~dyntorch.shapes.moving.fit_shapes`.
        basis: of the trajectories.
        x: ``(*batch, views, n, 2)`` image points in any unit; NaN = missing.
        weights: ``(*batch, views, n)``, 0 = ignore.
        grid: times tried.
        interval: polynomial trajectories: times tried from and to.  Periodic ones are tried over the period.

    Returns:
        :class:`Recovery` in the dtype of x.

    Raises:
        ValueError: shapes that do not agree, negative weights, or a grid of fewer than 3 times.

    Source: thesis chapter 4: one view of enough points determines the time; a grid in the place of resultants.

    Example:
        >>> import torch
        >>> from dyntorch import Polynomial
        >>> g = torch.Generator().manual_seed(0)
        >>> points, camera = torch.randn(2, 8, 3, generator=g).double(), torch.randn(3, 2, generator=g).double()
        >>> found = recover_times(points, Polynomial(1), ((points[0] + 0.3 * points[1]) @ camera)[None])
        >>> bool(found.residual < 1e-12), round(float(found.times), 6)
        (True, 0.3)
    """

    def project_at(shapes: Tensor, x: Tensor, weights: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x, weights = x[:, :, None], weights[:, :, None]
        rows, slopes = (f(t).flatten(1, 2) for f in (basis.rows, basis.slopes))
        shape, speed = (shapes_at(shapes, c).unflatten(1, t.shape[1:]) for c in (rows, slopes))
        found = project(x, weights.expand(*t.shape, -1), shape)
        seen = weights.sqrt()[..., None] * (speed - (speed * weights[..., None]).mean(-2, keepdim=True)) @ found.cameras
        slope = seen - found.basis @ (found.basis.mT @ seen)
        gain = (found.residual * slope).sum((-2, -1))
        return found.residual.square().sum((-2, -1)), gain, slope.square().sum((-2, -1))

    def curve(shapes: Tensor, x: Tensor, weights: Tensor, times: Tensor) -> Tensor:
        return residuals_at(shapes, basis.rows(times), x, weights)

    return date_views(shapes, basis, x, weights, grid, interval, curve, project_at, width=16, min_points=1)


Curve = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]
Slopes = Callable[[Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]


def date_views(
    shapes: Tensor,
    basis: Trajectory,
    x: Tensor,
    weights: Tensor | None,
    grid: int,
    interval: tuple[float, float],
    curve: Curve,
    slopes: Slopes,
    *,
    width: int,
    min_points: int,
) -> Recovery:
    """The times of views by their residuals: ``curve`` of (shapes, views, weights, times) over the grid, and ``slopes`` of (...,
    times of each view) with what a Gauss-Newton step takes; ``width`` numbers per view and time."""
    check_weights(weights, "a point")
    times = tried_times(shapes, basis, x, grid, interval)
    batch = np.broadcast_shapes(shapes.shape[:-3], x.shape[:-3])
    flat = prod(batch)
    wide = shapes.double().expand(*batch, *shapes.shape[-3:]).reshape(flat, *shapes.shape[-3:])
    seen = x.double().expand(*batch, *x.shape[-3:]).reshape(flat, *x.shape[-3:])
    weight = None if weights is None else weights.double().expand(*batch, *x.shape[-3:-1]).reshape(flat, *x.shape[-3:-1])
    views = centred_views(seen, weight)
    known = (views.share > 0) & ((views.weights > 0).sum(-1) >= min_points)
    step = max(1, CHUNK // (grid * width * max(1, flat)))

    def date(x: Tensor, weights: Tensor) -> tuple[Tensor, ...]:
        place, lone = lowest_minima(curve(wide, x, weights, times), basis.period is not None)
        within = times if basis.period is None else None
        t, f, h = _refine(lambda t: slopes(wide, x, weights, t), times[place], times[1] - times[0], within)
        f = torch.where(lone, torch.inf, f)
        order = f.argsort(-1)
        t, f, h = (part.gather(-1, order) for part in (t, f, h))
        second = torch.where(f[..., 1].isfinite(), t[..., 1], t[..., 0])
        return f[..., 0].clamp(0, 1), t[..., 0], h[..., 0].clamp(min=1e-300).rsqrt(), second, f[..., 1] - f[..., 0]

    parts = [date(views.x[:, i : i + step], views.weights[:, i : i + step]) for i in range(0, max(1, known.shape[1]), step)]
    found = [torch.cat(part, dim=1) for part in zip(*parts, strict=True)]
    middle = times[len(times) // 2]
    none = (middle.new_tensor(1.0), middle, middle.new_tensor(torch.inf), middle, middle.new_tensor(0.0))
    done = [torch.where(known, part, value).reshape(*batch, -1).to(x.dtype) for part, value in zip(found, none, strict=True)]
    return Recovery(*done, status=status_of(torch.zeros_like(known), ~known).reshape(*batch, known.shape[1]))


def tried_times(shapes: Tensor, basis: Trajectory, x: Tensor, count: int, interval: tuple[float, float]) -> Tensor:
    """The times of a grid, float64, for shapes and views that agree."""
    if x.ndim < 3 or x.shape[-1] != 2 or shapes.ndim < 3 or shapes.shape[-1] != 3 or shapes.shape[-2] != x.shape[-2]:
        raise ValueError(
            f"expected shapes (*batch, B, n, 3) and x (*batch, views, n, 2), got {tuple(shapes.shape)}, {tuple(x.shape)}"
        )
    if shapes.shape[-3] != basis.size:
        raise ValueError(f"{basis!r} has {basis.size} functions, shapes {tuple(shapes.shape)} have {shapes.shape[-3]}")
    if count < 3:
        raise ValueError(f"grid must be at least 3 times, got {count}")
    if basis.period is None:
        return torch.linspace(*interval, count, dtype=torch.float64, device=x.device)
    return torch.arange(count, dtype=torch.float64, device=x.device) * (basis.period / count)


def residuals_at(shapes: Tensor, rows: Tensor, x: Tensor, weights: Tensor) -> Tensor:
    """Residuals ``(b, views, times)`` of centred views of norm 1 at all times ``rows (times, B)``, by one product."""
    b, views = weights.shape[:2]
    every = shapes_at(shapes, rows.expand(b, *rows.shape))
    q = torch.linalg.qr(every - every.mean(-2, keepdim=True))[0]  # (b, g, n, 3)
    grid = q.shape[1]
    flat = (x * weights[..., None]).mT.flatten(1, 2) @ q.permute(0, 2, 1, 3).flatten(2)
    inner = flat.reshape(b, views, 2, grid, 3)
    if bool((weights == 1).all()):
        return 1 - inner.square().sum((2, 4))
    # missing points: the columns are orthonormal no more, every view has a Gram of its own
    inner = inner.permute(0, 1, 3, 4, 2)
    pairs = (q[..., :, None] * q[..., None, :]).permute(0, 2, 1, 3, 4).flatten(2)
    gram = (weights @ pairs).reshape(b, views, grid, 3, 3)
    mean = (weights @ q.permute(0, 2, 1, 3).flatten(2)).reshape(b, views, grid, 3)
    total = weights.sum(-1)[..., None, None, None].clamp(min=1e-300)
    gram = gram - mean[..., :, None] * mean[..., None, :] / total
    factor, _ = torch.linalg.cholesky_ex(gram + RIDGE_EPSILON * torch.eye(3, dtype=x.dtype, device=x.device))
    return 1 - torch.linalg.solve_triangular(factor, inner, upper=False).square().sum((-2, -1))


def lowest_minima(curve: Tensor, periodic: bool) -> tuple[Tensor, Tensor]:
    """Places ``(b, views, minima)`` of the deepest local minima of curves, and which of them are none."""
    if periodic:
        before, after = curve.roll(1, -1), curve.roll(-1, -1)
    else:
        edge = torch.full_like(curve[..., :1], torch.inf)
        before, after = torch.cat([edge, curve[..., :-1]], -1), torch.cat([curve[..., 1:], edge], -1)
    low = (curve <= before) & (curve < after)
    # a constant curve has no minimum: its first time stands in
    low[..., 0] |= ~low.any(-1)
    depth, place = torch.where(low, curve, torch.inf).topk(min(NUM_MINIMA, curve.shape[-1]), dim=-1, largest=False)
    return place, ~depth.isfinite()


def _refine(
    at: Callable[[Tensor], tuple[Tensor, Tensor, Tensor]], start: Tensor, step: Tensor, within: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Times, residuals and curvatures ``(b, views, minima)`` at the minima next to ``start``; not more than a step away."""
    low, high = start - step, start + step
    if within is not None:
        low, high = low.clamp(min=within[0]), high.clamp(max=within[-1])
    t, size = start, torch.ones_like(start)
    f, gain, curvature = at(t)
    for _ in range(TIME_STEPS):
        trial = (t + size * gain / curvature.clamp(min=1e-300)).clamp(low, high)
        fresh = at(trial)
        better = fresh[0] < f
        t = torch.where(better, trial, t)
        f, gain, curvature = (torch.where(better, new, old) for new, old in zip(fresh, (f, gain, curvature), strict=True))
        size = torch.where(better, 1.0, size / 4)
    return t, f, curvature
