"""Two affine cameras that see different points of one moving scene: which points each explains of the other, and their transfer."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyntorch.tasks.pair.tracks import Prior, cosines, inverse_cosines, motion_spectrum

# ----------------------------------------------------------------------------------------------------------------------
# The epipolar coordinates of one camera's points as combinations of the other's, by ridge regression of most evidence.
#
# .. math:: y_j(t) = \sum_i x_i(t)\,Q_{ij} + e_j(t), \qquad Q \sim N(0, \tau^2), \quad e \sim N(0, s^2)
#
# in many pairs of directions at once.  Where points are affine combinations of the others' points, their mean places obey the
# same
# Q, but for the scale c and the offset o between the two cameras' coordinates, :math:`\sum_i Q_{ij} = c` and
# :math:`\bar y_j = \sum_i \bar x_i Q_{ij} + o`: two more rows, with c and o common to all j.  Then :math:`Q - c / n` is what is
# expected near 0: about 0 itself, c would come out up to 40 % too small (CMU joints, 10 mm).


@dataclass(frozen=True)
class Ridge:
    """Regressions in g pairs of directions."""

    evidence: Tensor  # ``(g,)`` log likelihood of y with Q integrated out
    ridge: Tensor  # ``(g,)`` :math:`s^2 / \tau^2`
    variance: Tensor  # ``(g,)`` s^2
    gauge: Tensor  # ``(g, 2)`` o and c; zero where the means were not given
    precision: Tensor  # ``(g, 2, 2)`` inverse covariance of o and c


SUM_WEIGHT = 10.0  # of the row of sums, over the root of the sum of the squared singular values


@dataclass(frozen=True)
class Rows:
    """Regressors and what they are to explain, with the rows of the means: ``x (g, F, n)``, ``y (g, F, m)``,
    ``free (g, F, 2)``."""

    x: Tensor
    y: Tensor
    free: Tensor
    dropped: int = 0

    @staticmethod
    def of(x: Tensor, y: Tensor, means: tuple[Tensor, Tensor] | None = None, dropped: int = 0) -> Rows:
        """``x (g, F, n)``, ``y (g, F, m)`` over time, and mean places ``(g, n)``, ``(g, m)`` where they count."""
        free = x.new_zeros(*x.shape[:2], 2)
        if means is None:
            return Rows(x, y, free, dropped)
        # the largest singular value to a factor of a few is all that is needed
        firm = SUM_WEIGHT * x.square().sum((1, 2)).sqrt()
        free[..., 1] = x.mean(-1)
        unit = free.new_zeros(len(free), 2, 2)
        unit[:, 0, 0], unit[:, 0, 1] = 1.0, means[0].mean(-1)
        x = torch.cat([x, means[0][:, None], firm[:, None, None].expand(-1, 1, x.shape[2])], dim=1)
        y = torch.cat([y, means[1][:, None], torch.zeros_like(means[1])[:, None]], dim=1)
        return Rows(x, y, torch.cat([free, unit], dim=1), dropped)


def regress(rows: Rows, *, means: bool) -> Ridge:
    """The ridge, common to all columns of y, of most evidence."""
    u, s, _ = torch.linalg.svd(rows.x, full_matrices=False)
    inside, outside = u.mT @ rows.y, rows.y - u @ (u.mT @ rows.y)
    free, beyond = u.mT @ rows.free, rows.free - u @ (u.mT @ rows.free)
    # the part outside the regressors' span in few coordinates, without the cancellation of normal equations
    small = torch.linalg.qr(torch.cat([beyond, outside], dim=-1)).R
    beyond, outside = small[..., :2], small[..., 2:]
    energies = s.square()
    ridge = energies.amax(-1).clamp(min=1e-300)[:, None] * _grid(s)
    share = 1 / (energies[:, None] / ridge[..., None] + 1)  # (g, L, n)
    # c and o are common to all columns: what they change of squares summed over columns is the mean of the columns
    columns = rows.y.shape[2]
    inner, outer = inside.mean(-1), outside.mean(-1)
    spread, apart = (inside - inner[..., None]).square().sum(-1), (outside - outer[..., None]).square().sum((-2, -1))
    gauge = rows.x.new_zeros(*ridge.shape, 2)
    precision = gauge.new_zeros(*ridge.shape, 2, 2)
    if means:
        precision = free.mT[:, None] @ (share[..., None] * free[:, None]) + (beyond.mT @ beyond)[:, None]
        moment = (share * inner[:, None]) @ free + outer[:, None] @ beyond
        gauge = torch.linalg.solve_ex(precision, moment[..., None])[0][..., 0]
    left, rest = inner[:, None] - gauge @ free.mT, outer[:, None] - gauge @ beyond.mT
    cost = (share * (spread[:, None] + columns * left.square())).sum(-1) + apart[:, None] + columns * rest.square().sum(-1)
    count = (rows.y.shape[1] + rows.dropped) * columns - (2 if means else 0)
    variance = (cost / count).clamp(min=1e-300)
    level = -0.5 * count * variance.log() + 0.5 * columns * share.log().sum(-1)
    if means:
        level = level - 0.5 * torch.linalg.slogdet(precision + 1e-300).logabsdet
    best = level.nan_to_num(nan=-torch.inf).argmax(-1)
    pick = torch.arange(len(best), device=best.device), best
    scaled = precision[pick] * (columns / variance[pick])[:, None, None]
    return Ridge(level[pick], ridge[pick], variance[pick], gauge[pick], scaled)


def combination_weights(rows: Rows, ridge: Tensor, gauge: Tensor) -> Tensor:
    """Q ``(g, n, m)`` for a known ridge ``(g,)``, o and c ``(g, 2)``."""
    u, s, vt = torch.linalg.svd(rows.x, full_matrices=False)
    target = rows.y - rows.free @ gauge[..., None]
    found = vt.mT @ ((s / (s.square() + ridge[:, None]))[..., None] * (u.mT @ target))
    return found + gauge[:, 1, None, None] / rows.x.shape[2]


NUM_FOLDS = 5  # stretches of time that are predicted from the others


def leave_out_residuals(x: Tensor, y: Tensor, ridge: Tensor) -> Tensor:
    r"""Residuals of y where every stretch of time is predicted from all others, :math:`(I - H_{BB})^{-1} (y - H y)_B`. x
    ``(T, n)`` -> ``(T, m)``."""
    u, s, _ = torch.linalg.svd(x, full_matrices=False)
    energies = s.square()
    share = energies / (energies + ridge.reshape(-1, 1).clamp(min=1e-300))  # (1 or m, n)
    inside = u.mT @ y
    residual = y - u @ (share.mT * inside)
    pieces = []
    for rows in torch.arange(len(x), device=x.device).chunk(NUM_FOLDS):
        part = u[rows]
        eye = torch.eye(len(rows), dtype=x.dtype, device=x.device)
        hat = (part * share[:, None]) @ part.mT
        # a stretch that alone shows some motion says nothing of it; the least shift keeps the matrix regular
        solved = torch.linalg.solve_ex(eye * (1 + 1e-12) - hat, residual[rows].mT[..., None].expand(y.shape[1], -1, 1))[0]
        pieces.append(solved[..., 0].mT)
    return torch.cat(pieces)


def column_ridges(x: Tensor, y: Tensor) -> Tensor:
    """The ridge of most evidence of every column of ``y (T, m)`` by itself, given ``x (T, n)``: ``(m,)``."""
    u, s, _ = torch.linalg.svd(x, full_matrices=False)
    inside = u.mT @ y
    rest = (y - u @ inside).square().sum(0)
    energies = s.square()
    ridge = energies.amax().clamp(min=1e-300) * _grid(s)
    share = 1 / (energies / ridge[:, None] + 1)
    cost = share @ inside.square() + rest
    level = -0.5 * len(y) * cost.clamp(min=1e-300).log() + 0.5 * share.log().sum(-1, keepdim=True)
    return ridge[level.argmax(0)]


MIN_RIDGE = 1e-22  # over the largest eigenvalue of the Gram
NUM_RIDGES = 72  # tried from there to 1


def _grid(like: Tensor) -> Tensor:
    least = MIN_RIDGE
    return torch.logspace(0, 1, NUM_RIDGES, base=1 / least, dtype=like.dtype, device=like.device) * least


# ----------------------------------------------------------------------------------------------------------------------
# The common direction of two affine cameras that see different points: which coordinate of one explains which of the other.
#
# The planes through two parallel viewing rays cut both images along parallel lines.  Across these lines, along the epipolar
# normals
# :math:`m_1, m_2`, both cameras see the same coordinate u of space, so that :math:`m_2 \cdot y_j` lies in the span of the
# :math:`m_1 \cdot x_i` over time.  All pairs of directions are tried, so that no local optimum is taken for the best.
#
# Source: Wolf and Zomet 2002, Correspondence-free synchronization and reconstruction in a non-rigid scene; thesis chapter 7.


@dataclass(frozen=True)
class Motions:
    """Weighted motions of the points of both cameras over frequencies, of comparable units."""

    x: Tensor  # ``(F, n, 2)``; y: ``(F, m, 2)``
    y: Tensor
    variance: float  # of the noise of one coordinate
    samples: float  # of independent noise in the F rows
    means: tuple[Tensor, Tensor]  # mean places ``(n, 2)``, ``(m, 2)`` about their centres
    dropped: int = 0

    @property
    def frequencies(self) -> int:
        """Rows, with those that were left out."""
        return len(self.x) + self.dropped

    def compress(self) -> Motions:
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


def project_along(x: Tensor, angle: Tensor) -> Tensor:
    """Coordinates ``(g, ...)`` of ``(..., 2)`` along angles ``(g,)``."""
    return torch.movedim(x @ direction(angle).mT, -1, 0)


NOISE_FLOOR = 0.1  # share of the noise's variance added to covariances; CMU joints at 3 mm: 1.6 degrees off for .1, 2.1 for 1


def information(motions: Motions, angles: Tensor) -> Tensor:
    r"""What the coordinates along two directions say of each other, ``(g,)``."""
    floor = max(NOISE_FLOOR * motions.variance, 1e-14 * float(motions.x.square().sum(0).mean()) / motions.frequencies)
    x, y = (project_along(part, angle) for part, angle in zip((motions.x, motions.y), angles.unbind(-1), strict=True))
    n, m = x.shape[-1], y.shape[-1]
    both = torch.cat([x, y], dim=-1)
    moment = both.mT @ both / motions.frequencies + floor * torch.eye(n + m, dtype=x.dtype, device=x.device)
    # Cholesky: half of log |.| is the sum of the logarithms of the diagonal, of a Schur complement its last part
    whole = torch.linalg.cholesky_ex(moment)[0].diagonal(dim1=-2, dim2=-1)
    alone = torch.linalg.cholesky_ex(moment[:, n:, n:])[0].diagonal(dim1=-2, dim2=-1)
    return (alone.log().sum(-1) - whole[:, n:].log().sum(-1)).nan_to_num(nan=-torch.inf)


NUM_DIRECTIONS = 36  # of each camera: information changes little over 5 degrees
NUM_PEAKS = 3  # that are refined


def peaks(motions: Motions) -> Tensor:
    """The best local maxima of :func:`information` on a grid over all directions, ``(k, 2)``, best first."""
    grid = NUM_DIRECTIONS
    steps = torch.arange(grid, dtype=motions.x.dtype, device=motions.x.device) * (torch.pi / grid)
    values = torch.stack([information(motions, torch.stack([a.expand(grid), steps], dim=-1)) for a in steps])
    around = [values.roll((i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
    top = torch.where((values >= torch.stack(around).amax(0)), values, -torch.inf).flatten()
    found, place = top.topk(NUM_PEAKS)
    place = place[found.isfinite()]
    return torch.stack([steps[place // grid], steps[place % grid]], dim=-1)


def likelihood(motions: Motions, angles: Tensor, affine: bool = False) -> Tensor:
    """Log likelihood ``(g,)`` of each camera's coordinates given the other's, above their own; ``affine``: with the mean places."""
    both = [project_along(part, angle) for part, angle in zip((motions.x, motions.y), angles.unbind(-1), strict=True)]
    places = [project_along(part, angle) for part, angle in zip(motions.means, angles.unbind(-1), strict=True)]
    there = Rows.of(both[0], both[1], (places[0], places[1]) if affine else None, motions.dropped)
    back = Rows.of(both[1], both[0], (places[1], places[0]) if affine else None, motions.dropped)
    level = regress(there, means=affine).evidence + regress(back, means=affine).evidence
    floor = NOISE_FLOOR * motions.variance
    for z in both:
        own = z.mT @ z / motions.frequencies
        own = own + (floor + 1e-14 * own.diagonal(dim1=-2, dim2=-1).mean(-1))[:, None, None] * torch.eye(len(own[0])).to(own)
        level = level + 0.5 * motions.samples * torch.linalg.slogdet(own).logabsdet
    return level


FINEST_STEP = 1e-10  # radians, to which the best one is
STEP_SHRINKAGE = 0.4  # where no neighbour is better
MIN_GAIN = 1e-3  # of log likelihood, below which noise decides


def refine_directions(
    motions: Motions, start: Tensor, finest: float | None = None, step: float | None = None, *, affine: bool = False
) -> tuple[Tensor, float]:
    """The directions ``(2,)`` of most likelihood near the start, and its value, by a grid that shrinks from step to finest, if not
    given from half a step of the grid of :func:`peaks` to the finest one of the options."""
    finest = FINEST_STEP if finest is None else finest
    step = 0.5 * torch.pi / NUM_DIRECTIONS if step is None else step
    offsets = torch.cartesian_prod(*(torch.tensor([-1.0, 0.0, 1.0], dtype=start.dtype, device=start.device),) * 2)
    angles, level = start, -torch.inf
    while step > finest:
        values = likelihood(motions, angles + step * offsets, affine).nan_to_num(nan=-torch.inf)
        best = int(values.argmax())
        gain, level = float(values[best]) - level, max(level, float(values[best]))
        angles = angles + step * offsets[best]
        if best == len(offsets) // 2:
            if float(values.max() - values.min()) < MIN_GAIN:
                break
            step *= STEP_SHRINKAGE
        elif gain < MIN_GAIN:
            break
    return angles, level


@dataclass(frozen=True)
class Transfer:
    """Epipolar geometry of two affine cameras, and each camera's points as combinations of the other's."""

    normals: Tensor  # ``(2, 2)`` unit normals of the epipolar lines of a and of b
    scale: float  # :math:`m_b \cdot y = c\, (m_a \cdot x) + o`, of coordinates about the centres
    offset: float
    forward: Tensor  # ``(n, m)`` weights of a's points in b's
    backward: Tensor
    affine: bool  # whether the mean places agree with affine combinations
    x: Tensor  # ``(T, n, 2)`` a's motions about their means, rid of noise; y: those of b
    y: Tensor
    r2: Tensor  # ``(n + m,)`` share of the motion of the epipolar coordinate that the other camera predicts
    good: Tensor  # ``(n + m,)`` bool
    residual: float  # pixels, rms difference of the epipolar coordinate from what the other camera predicts
    noise: tuple[float, float]  # ``(2,)`` pixels, of a coordinate of a and of b
    beyond: float = math.inf  # how far the likelihood is above those of unrelated motions, in units of the range of these


MIN_POINTS = 2  # of a camera
MAX_REJECTIONS = 8  # rounds in which points that the other camera does not explain are left out


def solve(x: Tensor, y: Tensor, noise: tuple[float, float], explained: float, num_draws: int) -> Transfer | Tensor:
    """Everything of complete tracks.

    Args:
        x: ``(T, n, 2)`` positions about the centre of a's points; y: ``(T, m, 2)``.
        noise: of one coordinate; upper bounds.
        explained: share of a point's motion that the other camera must predict.
        num_draws: unrelated motions that the likelihood is compared with.

    Returns:
        Where too few points pass, only which do, ``(n + m,)``.
    """
    n = x.shape[1]
    good = torch.ones(n + y.shape[1], dtype=torch.bool, device=x.device)
    for _ in range(MAX_REJECTIONS):
        angles = _directions(x[:, good[:n]], y[:, good[n:]], noise)
        r2, strange = judge_points(x, y, angles, noise, good, explained)
        worst = (strange * good).argsort(descending=True)[: max(1, int((strange * good > 0).sum()) // 2)]
        left = good.scatter(0, worst, False)
        # points explained wrongly by one another have to go one after the other
        if not bool((strange[worst] > 0).all()) or min(int(left[:n].sum()), int(left[n:].sum())) < MIN_POINTS:
            break
        good = left
    good = strange == 0
    if min(int(good[:n].sum()), int(good[n:].sum())) < MIN_POINTS:
        return good
    beyond = _beyond_chance(_motions(x[:, good[:n]], y[:, good[n:]], noise), angles, num_draws)
    found = _transfer(x, y, noise, angles, r2, good)
    if found.affine:
        # the mean places tell the directions better than the motions alone
        angles = _directions(x[:, good[:n]], y[:, good[n:]], noise, angles)
        found = _transfer(x, y, noise, angles, r2, good)
    return replace(found, beyond=beyond)


COARSE_STEP = 3e-3  # radians, to which all peaks are refined


def _directions(x: Tensor, y: Tensor, noise: tuple[float, float], start: Tensor | None = None) -> Tensor:
    """Angles ``(2,)`` of the epipolar normals; from a start, those that the mean places agree with as well."""
    motions, coarse = _motions(x, y, noise).compress(), COARSE_STEP
    if start is not None:
        return refine_directions(motions, start, step=2 * coarse, affine=True)[0]
    found = [refine_directions(motions, start, coarse) for start in peaks(motions)]
    return refine_directions(motions, max(found, key=lambda one: one[1])[0], step=2 * coarse)[0]


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


def _beyond_chance(motions: Motions, angles: Tensor, num_draws: int) -> float:
    """How far the likelihood of what was found is above the highest of unrelated motions, over the range of theirs."""
    # a generator of its own: the same tracks get the same answer
    generator = torch.Generator().manual_seed(0)
    levels = []
    for _ in range(num_draws):
        signs = torch.randint(0, 2, (len(motions.y),), generator=generator).to(motions.y) * 2 - 1
        other = replace(motions, y=motions.y * signs[:, None, None]).compress()
        levels.append(refine_directions(other, peaks(other)[0], COARSE_STEP)[1])
    level = float(likelihood(motions.compress(), angles[None])[0])
    return (level - max(levels)) / max(max(levels) - min(levels), 1e-9 * abs(level), 1e-300)


def judge_points(
    x: Tensor, y: Tensor, angles: Tensor, noise: tuple[float, float], good: Tensor, explained: float
) -> tuple[Tensor, Tensor]:
    """How the other camera's good points predict every point's epipolar coordinate."""
    n = x.shape[1]
    u, v = (project_along(part - part.mean(0), angle[None])[0] for part, angle in zip((x, y), angles, strict=True))
    first = _judge_camera(v[:, good[n:]], u, noise[0], good[:n], explained)
    second = _judge_camera(u[:, good[:n]], v, noise[1], good[n:], explained)
    return torch.cat([first[0], second[0]]), torch.cat([first[1], second[1]])


SURE_SHARE = 0.99  # of the motion that must be predicted of a point missed by an unusual distance
UNUSUAL_RATIO = 4.0  # over the usual distance
MAX_MISSED_SIGMAS = 3.0  # up to which a prediction speaks against no point: it hardly moves across the epipolar lines


def _judge_camera(x: Tensor, y: Tensor, noise: float, good: Tensor, explained: float) -> tuple[Tensor, Tensor]:
    missed = leave_out_residuals(x, y, column_ridges(x, y)).square().mean(0)
    small = missed <= (MAX_MISSED_SIGMAS * noise) ** 2
    # noise is nobody's to predict
    power = y.square().mean(0) - noise**2
    share = 1 - (missed - noise**2).clamp(min=0) / power.clamp(min=1e-300)
    share = torch.where(power > noise**2, share.clamp(min=0.0), small.to(x))
    usual = missed[good].median().clamp(min=1e-300)
    bad = (share < explained) | ((share < SURE_SHARE) & (missed > UNUSUAL_RATIO**2 * usual))
    return share, torch.where(bad & ~small, missed / usual, 0.0)


MAX_MEAN_COST = 3.0  # factor of the residual variance that the mean places may cost before they are taken for free
VARIANCE_ROUNDING = 1e-11  # residual over the power of the motion


def _transfer(x: Tensor, y: Tensor, noise: tuple[float, float], angles: Tensor, r2: Tensor, good: Tensor) -> Transfer:
    n = x.shape[1]
    left, right = good[:n], good[n:]
    means = (x.mean(0), y.mean(0))
    moving = [x - means[0], y - means[1]]
    rows = _rows(moving, moving, means, angles, (left, right))
    if float(regress(rows[0], means=True).gauge[0, 1]) < 0:
        angles = angles + angles.new_tensor([0.0, torch.pi])
        rows = _rows(moving, moving, means, angles, (left, right))
    free = [regress(_without_means(one), means=False) for one in rows]
    # third differences bound the noise from above, and so do the residuals
    sigma = _bound_noise(
        noise,
        free,
        [
            combination_weights(_without_means(one), fit.ridge, one.x.new_zeros(1, 2))[0]
            for one, fit in zip(rows, free, strict=True)
        ],
    )
    clean = [_denoise(part, one, kept) for part, one, kept in zip(moving, sigma, (left, right), strict=True)]
    rows = _rows(clean, moving, means, angles, (left, right))
    free = [regress(_without_means(one), means=False) for one in rows]
    tied = [regress(one, means=True) for one in rows]
    better = min(range(2), key=lambda i: float(free[i].variance) / float(rows[i].y.square().mean()))
    exact = VARIANCE_ROUNDING * float(rows[better].y.square().mean())
    affine = float(tied[better].variance) <= max(MAX_MEAN_COST * float(free[better].variance), exact)
    if affine:
        scale, offset = _gauge(tied)
        gauges = angles.new_tensor([[offset, scale], [-offset / scale, 1 / scale]])
        both = [combination_weights(one, fit.ridge, g[None])[0] for one, fit, g in zip(rows, tied, gauges, strict=True)]
    else:
        rows = [_without_means(one) for one in rows]
        both = [combination_weights(one, fit.ridge, one.free.new_zeros(1, 2))[0] for one, fit in zip(rows, free, strict=True)]
        scale, offset = _gauge_of_free_means(both, means, angles, (left, right))
    missed = [(one.y[0] - one.x[0] @ q)[: len(x)] for one, q in zip(rows, both, strict=True)]
    residual = float(torch.cat([part.flatten() for part in missed]).square().mean().sqrt())
    forward, backward = (x.new_zeros(k, other) for k, other in ((n, y.shape[1]), (y.shape[1], n)))
    forward[left.nonzero(), right.nonzero()[:, 0]] = both[0] / scale
    backward[right.nonzero(), left.nonzero()[:, 0]] = both[1] * scale
    return Transfer(
        direction(angles), scale, offset, forward, backward, affine, clean[0], clean[1], r2, good, residual, (sigma[0], sigma[1])
    )


def _bound_noise(noise: tuple[float, float], free: list[Ridge], weights: list[Tensor]) -> list[float]:
    r"""Noise of a and of b: a residual has the variance :math:`\sigma_b^2 + |q|^2 \sigma_a^2`, and no less."""
    left = [float(fit.variance) ** 0.5 for fit in free]
    size = [float(q.norm(dim=0).median()) for q in weights]
    return [min(noise[i], left[1 - i], left[i] / max(size[i], 1e-9)) for i in range(2)]


def _rows(
    regressors: list[Tensor], explained: list[Tensor], means: tuple[Tensor, Tensor], angles: Tensor, good: tuple[Tensor, Tensor]
) -> list[Rows]:
    """b's epipolar coordinates by a's, and a's by b's."""
    u, v = (project_along(part[:, kept], angle[None]) for part, kept, angle in zip(regressors, good, angles, strict=True))
    s, t = (project_along(part[:, kept], angle[None]) for part, kept, angle in zip(explained, good, angles, strict=True))
    first, second = (project_along(part[kept], angle[None]) for part, kept, angle in zip(means, good, angles, strict=True))
    return [Rows.of(u, t, (first, second)), Rows.of(v, s, (second, first))]


def _without_means(rows: Rows) -> Rows:
    """Without the rows of the means."""
    return Rows(rows.x[:, :-2], rows.y[:, :-2], torch.zeros_like(rows.free[:, :-2]))


def _denoise(x: Tensor, noise: float, good: Tensor) -> Tensor:
    """Motions of good points rid of noise; others as they are."""
    if not noise > 0:
        return x
    z = cosines(x[:, good])
    found = x.clone()
    found[:, good] = inverse_cosines(Prior.of(z, noise**2).denoise(z))
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


def _gauge_of_free_means(
    both: list[Tensor], means: tuple[Tensor, Tensor], angles: Tensor, good: tuple[Tensor, Tensor]
) -> tuple[float, float]:
    """Scale and offset where mean places are free: combinations sum to 1 in the median."""
    c1, c2 = (float(q.sum(0).median()) for q in both)
    scale = (c1 / c2) ** 0.5 if c1 > 0 and c2 > 0 else 1.0
    first, second = (project_along(part[kept], angle[None])[0] for part, kept, angle in zip(means, good, angles, strict=True))
    return scale, float((second - first @ both[0]).median())
