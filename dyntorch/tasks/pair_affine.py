"""Two affine cameras that see different points of one moving scene: which points each explains of the other, and their transfer."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyntorch.tasks.pair_normals import Motions, along, direction, likelihood, peaks, refined
from dyntorch.tasks.pair_prior import Prior, cosines, frames_of, motion_spectrum
from dyntorch.tasks.pair_regression import Ridge, Rows, combinations, predicted_apart, regress, ridges_apart

COARSE = 3e-3
"""Radians to which all peaks are refined; the best one then to the end."""
ROUNDS = 8
"""Of leaving out points that the other camera does not explain."""
FEWEST = 2
"""Points of a camera."""
SURE, UNUSUAL = 0.99, 4.0
"""A point of which a smaller share is predicted is an outlier where it is missed by more than so many times the usual distance."""
AFFINE = 3.0
"""Times the residual variance that the mean places may cost before they are taken for free."""
ROUNDING = 1e-11
"""Of the power of the motion: a residual that says nothing."""
DRAWS = 5
"""Unrelated motions, of the same spectrum in time and joint covariance of the points, that the cameras are compared with."""
MISSED = 3.0
"""Times the noise up to which what a prediction misses speaks against no point: it hardly moves across the epipolar lines."""


@dataclass(frozen=True)
class Transfer:
    """Epipolar geometry of two affine cameras, and each camera's points as combinations of the other's.

    Attributes:
        normals: ``(2, 2)`` unit normals of the epipolar lines of a and of b.
        scale, offset: :math:`m_b \\cdot y = c\\, (m_a \\cdot x) + o`, of coordinates about the centres.
        forward: ``(n, m)`` weights of a's points in b's; backward: ``(m, n)`` the other way round; their columns sum to 1 where
            ``affine``.
        affine: whether the mean places agree with affine combinations.
        x: ``(T, n, 2)`` a's motions about their means, rid of noise; y: those of b.
        r2: ``(n + m,)`` share of the motion of the epipolar coordinate that the other camera predicts.
        good: ``(n + m,)`` bool.
        residual: pixels, rms difference of the epipolar coordinate from what the other camera predicts.
        noise: ``(2,)`` pixels, of a coordinate of a and of b.
        beyond: how far the likelihood is above those of unrelated motions, in units of the range of these.
    """

    normals: Tensor
    scale: float
    offset: float
    forward: Tensor
    backward: Tensor
    affine: bool
    x: Tensor
    y: Tensor
    r2: Tensor
    good: Tensor
    residual: float
    noise: tuple[float, float]
    beyond: float = math.inf


def solve(x: Tensor, y: Tensor, noise: tuple[float, float], explained: float) -> Transfer | Tensor:
    """Everything of complete tracks.

    Args:
        x: ``(T, n, 2)`` positions about the centre of a's points; y: ``(T, m, 2)``.
        noise: of one coordinate; upper bounds.
        explained: share of a point's motion that the other camera must predict.

    Returns:
        Where too few points pass, only which do, ``(n + m,)``.
    """
    n = x.shape[1]
    good = torch.ones(n + y.shape[1], dtype=torch.bool, device=x.device)
    for _ in range(ROUNDS):
        angles = _directions(x[:, good[:n]], y[:, good[n:]], noise)
        r2, strange = judged(x, y, angles, noise, good, explained)
        worst = (strange * good).argsort(descending=True)[: max(1, int((strange * good > 0).sum()) // 2)]
        left = good.scatter(0, worst, False)
        # points explained wrongly by one another have to go one after the other
        if not bool((strange[worst] > 0).all()) or min(int(left[:n].sum()), int(left[n:].sum())) < FEWEST:
            break
        good = left
    good = strange == 0
    if min(int(good[:n].sum()), int(good[n:].sum())) < FEWEST:
        return good
    beyond = _beyond_chance(_motions(x[:, good[:n]], y[:, good[n:]], noise), angles)
    found = _transferred(x, y, noise, angles, r2, good)
    if found.affine:
        # the mean places tell the directions better than the motions alone
        angles = _directions(x[:, good[:n]], y[:, good[n:]], noise, angles)
        found = _transferred(x, y, noise, angles, r2, good)
    return replace(found, beyond=beyond)


def _directions(x: Tensor, y: Tensor, noise: tuple[float, float], start: Tensor | None = None) -> Tensor:
    """Angles ``(2,)`` of the epipolar normals; from a start, those that the mean places agree with as well."""
    motions = _motions(x, y, noise).compressed()
    if start is not None:
        return refined(motions, start, step=2 * COARSE, affine=True)[0]
    found = [refined(motions, start, COARSE) for start in peaks(motions)]
    return refined(motions, max(found, key=lambda one: one[1])[0], step=2 * COARSE)[0]


def _motions(x: Tensor, y: Tensor, noise: tuple[float, float]) -> Motions:
    """The motions of both cameras, weighted by how much of each frequency is no noise."""
    z = [cosines(part - part.mean(0)) for part in (x, y)]
    sizes = [float(part.square().mean().sqrt()) for part in z]
    variance = 0.5 * sum((one / size) ** 2 for one, size in zip(noise, sizes, strict=True))
    z = [part / size for part, size in zip(z, sizes, strict=True)]
    power = motion_spectrum(torch.cat(z, dim=1), variance)
    share = power / (power + variance)
    root = share.sqrt()[:, None, None]
    places = [(part.mean(0) - part.mean((0, 1))) / size for part, size in zip((x, y), sizes, strict=True)]
    return Motions(z[0] * root, z[1] * root, variance, float(share.sum()), (places[0], places[1]))


def _beyond_chance(motions: Motions, angles: Tensor) -> float:
    """How far the likelihood of what was found is above the highest of unrelated motions, over the range of theirs.

    Smooth motions of many points explain any other smooth motion.  With a random sign for each frequency b's points move as
    smoothly and as much together as before, but unrelated to a's; the same search is run on them.
    """
    # a generator of its own: the same tracks get the same answer
    generator = torch.Generator().manual_seed(0)
    levels = []
    for _ in range(DRAWS):
        signs = torch.randint(0, 2, (len(motions.y),), generator=generator).to(motions.y) * 2 - 1
        other = replace(motions, y=motions.y * signs[:, None, None]).compressed()
        levels.append(refined(other, peaks(other)[0], COARSE)[1])
    level = float(likelihood(motions.compressed(), angles[None])[0])
    return (level - max(levels)) / max(max(levels) - min(levels), 1e-9 * abs(level), 1e-300)


def judged(
    x: Tensor, y: Tensor, angles: Tensor, noise: tuple[float, float], good: Tensor, explained: float
) -> tuple[Tensor, Tensor]:
    """How the other camera's good points predict every point's epipolar coordinate.

    Returns:
        the share of its motion that they predict ``(n + m,)``, and how strange a point is: 0 where it passes, else how much more
        is missed than usual.
    """
    n = x.shape[1]
    u, v = (along(part - part.mean(0), angle[None])[0] for part, angle in zip((x, y), angles, strict=True))
    first = _judged(v[:, good[n:]], u, noise[0], good[:n], explained)
    second = _judged(u[:, good[:n]], v, noise[1], good[n:], explained)
    return torch.cat([first[0], second[0]]), torch.cat([first[1], second[1]])


def _judged(x: Tensor, y: Tensor, noise: float, good: Tensor, explained: float) -> tuple[Tensor, Tensor]:
    missed = predicted_apart(x, y, ridges_apart(x, y)).square().mean(0)
    small = missed <= (MISSED * noise) ** 2
    # noise is nobody's to predict
    power = y.square().mean(0) - noise**2
    share = 1 - (missed - noise**2).clamp(min=0) / power.clamp(min=1e-300)
    share = torch.where(power > noise**2, share.clamp(min=0.0), small.to(x))
    usual = missed[good].median().clamp(min=1e-300)
    bad = (share < explained) | ((share < SURE) & (missed > UNUSUAL**2 * usual))
    return share, torch.where(bad & ~small, missed / usual, 0.0)


def _transferred(x: Tensor, y: Tensor, noise: tuple[float, float], angles: Tensor, r2: Tensor, good: Tensor) -> Transfer:
    n = x.shape[1]
    left, right = good[:n], good[n:]
    means = (x.mean(0), y.mean(0))
    moving = [x - means[0], y - means[1]]
    rows = _rows(moving, moving, means, angles, (left, right))
    if float(regress(rows[0], means=True).gauge[0, 1]) < 0:
        angles = angles + angles.new_tensor([0.0, torch.pi])
        rows = _rows(moving, moving, means, angles, (left, right))
    free = [regress(_bare(one), means=False) for one in rows]
    # third differences bound the noise from above, and so do the residuals
    sigma = _bounded(
        noise, free, [combinations(_bare(one), fit.ridge, one.x.new_zeros(1, 2))[0] for one, fit in zip(rows, free, strict=True)]
    )
    clean = [_denoised(part, one, kept) for part, one, kept in zip(moving, sigma, (left, right), strict=True)]
    rows = _rows(clean, moving, means, angles, (left, right))
    free = [regress(_bare(one), means=False) for one in rows]
    tied = [regress(one, means=True) for one in rows]
    better = min(range(2), key=lambda i: float(free[i].variance) / float(rows[i].y.square().mean()))
    exact = ROUNDING * float(rows[better].y.square().mean())
    affine = float(tied[better].variance) <= max(AFFINE * float(free[better].variance), exact)
    if affine:
        scale, offset = _gauge(tied)
        gauges = angles.new_tensor([[offset, scale], [-offset / scale, 1 / scale]])
        both = [combinations(one, fit.ridge, g[None])[0] for one, fit, g in zip(rows, tied, gauges, strict=True)]
    else:
        rows = [_bare(one) for one in rows]
        both = [combinations(one, fit.ridge, one.free.new_zeros(1, 2))[0] for one, fit in zip(rows, free, strict=True)]
        scale, offset = _loose(both, means, angles, (left, right))
    missed = [(one.y[0] - one.x[0] @ q)[: len(x)] for one, q in zip(rows, both, strict=True)]
    residual = float(torch.cat([part.flatten() for part in missed]).square().mean().sqrt())
    forward, backward = (x.new_zeros(k, other) for k, other in ((n, y.shape[1]), (y.shape[1], n)))
    forward[left.nonzero(), right.nonzero()[:, 0]] = both[0] / scale
    backward[right.nonzero(), left.nonzero()[:, 0]] = both[1] * scale
    return Transfer(
        direction(angles), scale, offset, forward, backward, affine, clean[0], clean[1], r2, good, residual, (sigma[0], sigma[1])
    )


def _bounded(noise: tuple[float, float], free: list[Ridge], weights: list[Tensor]) -> list[float]:
    r"""Noise of a and of b: a residual has the variance :math:`\sigma_b^2 + |q|^2 \sigma_a^2`, and no less."""
    left = [float(fit.variance) ** 0.5 for fit in free]
    size = [float(q.norm(dim=0).median()) for q in weights]
    return [min(noise[i], left[1 - i], left[i] / max(size[i], 1e-9)) for i in range(2)]


def _rows(
    regressors: list[Tensor], explained: list[Tensor], means: tuple[Tensor, Tensor], angles: Tensor, good: tuple[Tensor, Tensor]
) -> list[Rows]:
    """b's epipolar coordinates by a's, and a's by b's."""
    u, v = (along(part[:, kept], angle[None]) for part, kept, angle in zip(regressors, good, angles, strict=True))
    s, t = (along(part[:, kept], angle[None]) for part, kept, angle in zip(explained, good, angles, strict=True))
    first, second = (along(part[kept], angle[None]) for part, kept, angle in zip(means, good, angles, strict=True))
    return [Rows.of(u, t, (first, second)), Rows.of(v, s, (second, first))]


def _bare(rows: Rows) -> Rows:
    """Without the rows of the means."""
    return Rows(rows.x[:, :-2], rows.y[:, :-2], torch.zeros_like(rows.free[:, :-2]))


def _denoised(x: Tensor, noise: float, good: Tensor) -> Tensor:
    """Motions of good points rid of noise; others as they are."""
    if not noise > 0:
        return x
    z = cosines(x[:, good])
    found = x.clone()
    found[:, good] = frames_of(Prior.of(z, noise**2).denoised(z))
    return found


def _gauge(tied: list[Ridge]) -> tuple[float, float]:
    """Scale and offset from both directions, each by its precision: regressors with noise make either scale too small."""
    (o1, c1), (o2, c2) = (fit.gauge[0].tolist() for fit in tied)
    if not (c1 > 0 and c2 > 0):
        return (c1 if c1 > 0 else 1.0), o1
    shares = [float(fit.precision[0, 1, 1]) * c * c for fit, c in zip(tied, (c1, c2), strict=True)]
    part = shares[1] / max(sum(shares), 1e-300)
    scale = c1 ** (1 - part) * c2**-part
    weights = [float(tied[0].precision[0, 0, 0]), float(tied[1].precision[0, 0, 0]) / scale**2]
    return scale, (weights[0] * o1 - weights[1] * o2 * scale) / max(sum(weights), 1e-300)


def _loose(both: list[Tensor], means: tuple[Tensor, Tensor], angles: Tensor, good: tuple[Tensor, Tensor]) -> tuple[float, float]:
    """Scale and offset where mean places are free: combinations sum to 1 in the median."""
    c1, c2 = (float(q.sum(0).median()) for q in both)
    scale = (c1 / c2) ** 0.5 if c1 > 0 and c2 > 0 else 1.0
    first, second = (along(part[kept], angle[None])[0] for part, kept, angle in zip(means, good, angles, strict=True))
    return scale, float((second - first @ both[0]).median())
