r"""Lens distortion of two cameras that nobody calibrated, from what they see of the same points at the same moments.

With the division model, a point :math:`u` (from the picture's centre, in half diagonals) is the ray
:math:`\hat u = (u, 1 + \lambda \|u\|^2)`, and the epipolar constraint stays bilinear in rays:
:math:`\hat u_b^T F\, \hat u_a = 0`.  Its first-order (Sampson) distance is measured in the pixels as they were seen: a distance
in straightened pixels would reward shrinking the picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.algebra.epipolar import TINY, eight_point
from dyntorch.algebra.epipolar_descent import Frames
from dyntorch.algebra.lens import Division
from dyntorch.blocks import one_thread
from dyntorch.devices import on_cpu
from dyntorch.least_squares import damped_step

RANGE = (-0.8, 0.4)
"""Of lambda: from a fisheye of 150 degrees across the diagonal to more pincushion than any lens sold."""
STARTS = ((0.0, 0.0), (-0.15, -0.15), (-0.4, -0.4), (-0.3, 0.0), (0.0, -0.3))
MOST, FEW = 1500, 300
"""Matches that are used, and those that choose among the starts: lambda is known to 1e-3 long before."""
LEAST = 40
CAP = 9.0
"""Squared distances count up to this multiple of the squared scale."""
ITERATIONS, CONVERGED = 30, 1e-6
NEAR = 1e-5
"""Of a parameter: the step of a difference."""
FOLDS = 4
SIGNIFICANT = 12.0
"""Of F(2, n - 9): 1e-5 of ideal cameras with independent errors exceed it, and the held-out parts guard against the others."""


@dataclass(frozen=True)
class LensFit:
    """Lenses of two cameras.

    Attributes:
        lenses: the division models of a and b, which straighten points.
        sigmas: standard deviations of the two lambda, as if errors were independent.
        gain: share of the median Sampson distance that distortion explains, in [0, 1].
        significant: whether distortion is really there.
    """

    lenses: tuple[Division, Division]
    sigmas: tuple[float, float]
    gain: float
    significant: bool

    @property
    def lambda_a(self) -> float:
        """Of the first camera; negative = barrel."""
        return self.lenses[0].strength

    @property
    def lambda_b(self) -> float:
        """Of the second camera."""
        return self.lenses[1].strength

    @property
    def note(self) -> str:
        """What a user should know where the fit is used."""
        return (
            f"lens distortion fitted, lambda = {self.lambda_a:+.3f} and {self.lambda_b:+.3f}: an approximation; "
            "give calibration=((K, dist), (K, dist))"
        )


@one_thread
@on_cpu
def fit_distortion(
    a: Tensor, b: Tensor, weights: Tensor | None = None, sizes: Sequence[Sequence[float] | None] | None = None
) -> LensFit:
    r"""One parameter of radial distortion per camera, and whether it is there:

    .. math:: \min_{\lambda_a, \lambda_b, \operatorname{rank} F = 2} \sum_k w_k \min(d_k^2 / s^2,\, 9), \qquad
              d = \frac{\hat u_b^T F\, \hat u_a}{\|\partial / \partial(x_a, x_b)\|}, \quad \hat u = (u, 1 + \lambda \|u\|^2),

    with the robust scale s.  Distortion is significant where an F-test says so, and where lenses fitted without a quarter of the
    matches (in the order given: time) explain that quarter better than no lenses do, for each of the four.

    A search: it computes on the CPU wherever its tensors are, and the result returns to their device.

    Args:
        a, b: ``(N, 2)`` px, matches in the order of time; NaN = none.
        weights: ``(N,)``, 0 = ignore.
        sizes: (width, height) of the pictures; without, the boxes of the points stand in for them.

    Returns:
        Lenses that straighten the two cameras' points; lambda = 0 and not significant where there are too few matches.

    Raises:
        ValueError: other shapes, or no match at all.

    Source: Fitzgibbon 2001, Simultaneous linear estimation of multiple view geometry and lens distortion; the Sampson distance
        in measured pixels, as in Barreto and Daniilidis 2005.

    Example:
        >>> import torch
        >>> from dyntorch.scenes import two_view
        >>> views = two_view(200, generator=torch.Generator().manual_seed(0)).views
        >>> lens = Division.of(views[0], (640, 480), strength=-0.2)
        >>> seen = [lens.distort(x) for x in views]
        >>> fit = fit_distortion(*seen, sizes=((640, 480), (640, 480)))
        >>> round(fit.lambda_a, 4), round(fit.lambda_b, 4), fit.significant
        (-0.2, -0.2, True)
    """
    if a.ndim != 2 or a.shape[-1] != 2 or a.shape != b.shape:
        raise ValueError(f"matches must be (N, 2) in both cameras, got {tuple(a.shape)} and {tuple(b.shape)}")
    weights = torch.ones(len(a)) if weights is None else weights
    if weights.shape != a.shape[:1]:
        raise ValueError(f"weights must be ({len(a)},), one per match, got {tuple(weights.shape)}")
    sizes = (None, None) if sizes is None else sizes
    chosen = (a.isfinite().all(-1) & b.isfinite().all(-1) & (weights > 0)).nonzero().flatten()
    ideal = Division.of(a[chosen].double(), sizes[0]), Division.of(b[chosen].double(), sizes[1])
    if len(chosen) < LEAST:
        return LensFit(ideal, (torch.inf, torch.inf), 0.0, False)
    data = Matches.of(a[chosen].double(), b[chosen].double(), weights[chosen].double(), ideal).subset(MOST)
    plain, full = _fitted(data)
    scale = _scale(data, full)
    plain, full = plain.descended(data, scale, lens=False), full.descended(data, scale, lens=True)
    before, after = (float(fit.cost(data, scale)) for fit in (plain, full))
    free = float((data.weights / data.weights.max()).sum()) - 9
    strength = full.lens[0]
    inside = bool(((strength > RANGE[0]) & (strength < RANGE[1])).all())
    clear = inside and free > 0 and (before - after) / 2 > SIGNIFICANT * max(after, TINY) / free
    significant = clear and all(_holds(data, plain, full, scale, fold) for fold in range(FOLDS))
    lenses = tuple(Division(float(value), one.centre, one.radius) for value, one in zip(strength, ideal, strict=True))
    sigma = full.sigmas(data, scale) * max(after / max(free, 1.0), 0.0) ** 0.5
    gain = 1 - float(_median(full.distances(data), data.weights) / _median(plain.distances(data), data.weights))
    return LensFit((lenses[0], lenses[1]), (float(sigma[0]), float(sigma[1])), max(0.0, gain), significant)


@dataclass(frozen=True)
class Matches:
    """Points from the centres of their pictures, in half diagonals."""

    a: Tensor
    """``(N, 2)``."""
    b: Tensor
    weights: Tensor
    """``(N,)``."""
    radii: tuple[float, float]
    """px."""

    @staticmethod
    def of(a: Tensor, b: Tensor, weights: Tensor, ideal: tuple[Division, Division]) -> Matches:
        """Of pixels."""
        first, second = ((x - lens.centre) / lens.radius for x, lens in zip((a, b), ideal, strict=True))
        return Matches(first, second, weights, (ideal[0].radius, ideal[1].radius))

    def subset(self, count: int) -> Matches:
        """As many of them, evenly spread."""
        n = len(self.a)
        chosen = torch.arange(min(count, n), device=self.a.device) * n // min(count, n)
        return Matches(self.a[chosen], self.b[chosen], self.weights[chosen], self.radii)

    def weighing(self, weights: Tensor) -> Matches:
        """The same matches with other weights."""
        return Matches(self.a, self.b, weights, self.radii)

    def distances(self, F: Tensor, lens: Tensor) -> Tensor:
        """Signed Sampson distances ``(B, N)`` in px, of F ``(B, 3, 3)`` and lambda ``(B, 2)``."""
        strength_a, strength_b = lens[:, None, :1], lens[:, None, 1:]
        p, q = _rays(self.a, strength_a), _rays(self.b, strength_b)
        onto_b, onto_a = p @ F.mT, q @ F
        value = (q * onto_b).sum(-1)
        by_a = (onto_a[..., :2] + 2 * strength_a * self.a * onto_a[..., 2:]) / self.radii[0]
        by_b = (onto_b[..., :2] + 2 * strength_b * self.b * onto_b[..., 2:]) / self.radii[1]
        return value / (by_a.square().sum(-1) + by_b.square().sum(-1)).clamp(min=TINY).sqrt()


def _rays(u: Tensor, strength: Tensor) -> Tensor:
    third = 1 + strength * u.square().sum(-1, keepdim=True)
    return torch.cat([u.expand(*third.shape[:-1], 2), third], dim=-1)


@dataclass(frozen=True)
class Fit:
    """Fundamental matrices of rays and the lenses, B of them."""

    frames: Frames
    lens: Tensor
    """``(B, 2)``."""

    def moved(self, step: Tensor) -> Fit:
        """After a step ``(B, 9)``: seven parameters of F, two lambda."""
        return Fit(self.frames.moved(step[:, :7]), self.lens + step[:, 7:])

    def distances(self, data: Matches) -> Tensor:
        """``(B, N)`` px."""
        return data.distances(self.frames.matrix().unflatten(-1, (3, 3)), self.lens)

    def cost(self, data: Matches, scale: Tensor) -> Tensor:
        """Truncated squared distances ``(B,)`` in units of ``scale``."""
        return ((self.distances(data) / scale).square().clamp(max=CAP) * data.weights).sum(-1)

    def best(self, data: Matches, scale: Tensor) -> Fit:
        """The one with the least cost."""
        k = int(self.cost(data, scale).argmin())
        return Fit(Frames(self.frames.turns[k : k + 1], self.frames.core[k : k + 1]), self.lens[k : k + 1])

    def _normal(self, data: Matches, scale: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient ``(B, 9)`` and Gauss-Newton matrix ``(B, 9, 9)`` of half the cost."""
        away = self.distances(data) / scale
        # central differences: exact to 1e-10, and four times faster than jacfwd
        near = NEAR * torch.eye(9, dtype=away.dtype, device=away.device)
        turns, core, lens = (part.repeat_interleave(18, dim=0) for part in (self.frames.turns, self.frames.core, self.lens))
        moved = Fit(Frames(turns, core), lens).moved(torch.cat([near, -near]).repeat(len(away), 1))
        ahead, behind = moved.distances(data).unflatten(0, (-1, 2, 9)).unbind(1)
        jacobian = ((ahead - behind) / (2 * NEAR)).mT / scale[..., None]
        weighted = (data.weights * (away.square() < CAP))[..., None] * jacobian
        return (weighted * away[..., None]).sum(1), weighted.mT @ jacobian

    def descended(self, data: Matches, scale: Tensor, *, lens: bool) -> Fit:
        """Levenberg-Marquardt, with the lenses or without."""
        free = torch.ones_like(self.lens[0]).repeat_interleave(5)[:9]
        free[7:] = float(lens)
        fit, cost = self, self.cost(data, scale)
        damping = torch.full_like(cost, 1e-3)
        for _ in range(ITERATIONS):
            trial = fit.moved(-damped_step(*fit._normal(data, scale), damping, free))
            trial = Fit(trial.frames, trial.lens.clamp(*RANGE))
            fresh = trial.cost(data, scale)
            better = fresh < cost
            done = bool((((cost - fresh).abs() <= CONVERGED * cost) | (~better & (damping > 1e3))).all())
            fit = Fit(trial.frames.where(better, fit.frames), torch.where(better[:, None], trial.lens, fit.lens))
            cost, damping = torch.where(better, fresh, cost), torch.where(better, 0.1 * damping, 10 * damping).clamp(1e-10, 1e8)
            if done:
                break
        return fit

    def sigmas(self, data: Matches, scale: Tensor) -> Tensor:
        """Standard deviations ``(2,)`` of lambda for errors of one ``scale``."""
        matrix = self._normal(data, scale)[1][0]
        if not bool(matrix.isfinite().all()):
            return matrix.new_full((2,), torch.inf)
        return torch.linalg.pinv(matrix, hermitian=True).diagonal()[7:].clamp(min=0).sqrt()


def _fitted(data: Matches) -> tuple[Fit, Fit]:
    """The best fits without and with lenses."""
    few = data.subset(FEW)
    lens = torch.tensor(STARTS, dtype=data.a.dtype, device=data.a.device)
    F = torch.cat([_start(few, one) for one in lens])
    every = Fit(Frames.of(F), lens)
    scale = _scale(few, every).min()
    plain = Fit(Frames.of(F[:1]), lens[:1]).descended(few, scale, lens=False)
    # what explains the points without lenses is a start, too
    every = Fit(Frames.of(torch.cat([F, plain.frames.matrix().unflatten(-1, (3, 3))])), torch.cat([lens, lens[:1]]))
    return plain, every.descended(few, scale, lens=True).best(few, scale)


def _start(data: Matches, lens: Tensor) -> Tensor:
    """F ``(1, 3, 3)`` of straightened points, weighed again by the distances a few times."""
    p, q = _rays(data.a, lens[:1]), _rays(data.b, lens[1:])
    weights = data.weights[None]
    for _ in range(4):
        F = eight_point(p[:, :2] / p[:, 2:], q[:, :2] / q[:, 2:], weights, rounds=1)
        away = data.distances(F, lens[None])
        weights = data.weights / (1 + (away / _median(away, data.weights)[:, None]).square())
    return F


def _median(away: Tensor, weights: Tensor) -> Tensor:
    return away[:, weights > 0].abs().median(-1).values.clamp(min=1e-9)


def _scale(data: Matches, fit: Fit) -> Tensor:
    """Robust standard deviation of the distances, ``(B, 1)`` px."""
    return 1.4826 * _median(fit.distances(data), data.weights)[:, None]


def _holds(data: Matches, plain: Fit, full: Fit, scale: Tensor, fold: int) -> bool:
    """Whether lenses fitted without one part of the matches explain that part better than no lenses do."""
    place = torch.arange(len(data.weights), device=data.weights.device) * FOLDS // len(data.weights)
    rest, part = (data.weighing(data.weights * own) for own in (place != fold, place == fold))
    costs = [fit.descended(rest, scale, lens=lens).cost(part, scale) for fit, lens in ((plain, False), (full, True))]
    return bool(costs[1] < costs[0])
