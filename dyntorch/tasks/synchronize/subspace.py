"""Two cameras that track different points of one motion: mutual information over all lags, and its best lag."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyntorch.core.outcome import Notice
from dyntorch.numerics.lags import lag_covariances
from dyntorch.tasks.synchronize.result import ShiftNotice

# ----------------------------------------------------------------------------------------------------------------------
# What the points of one camera tell about time, whichever points they are: how the body changes and how it moves on the whole.


MAX_SIGMA_FRAMES = 0.6  # Sigma above which a shift is refused, frames of the slower camera.


STEP = 1 / 30
"""Seconds from frame to frame, unless told."""


TINY = 1e-9
"""Of the size of the body: the least standard deviation of noise that is believed."""


MIN_RELATIVE_BEND = 1e-6  # Floor of the noise over the extent of the points: rounding.


@dataclass(frozen=True, eq=False)
class Body:
    """One camera's points over time."""

    rows: Tensor  # ``(T', d n)`` without the ends, coordinates about the body's middle over its size, smoothed, in units of noise
    motion: Tensor  # ``(T', d)`` px per frame, the median velocity of the points
    weights: Tensor  # ``(T',)`` 1 where a frame is seen, else 0
    points: Tensor  # ``(T, n, d)`` px, what is missing filled in; d = 2, of points in space 3
    seen: Tensor  # ``(T, n)`` bool
    step: float  # seconds from frame to frame
    noise: float = TINY**2  # variance of a coordinate's noise, over the squared size of the body

    @property
    def dims(self) -> int:
        """Coordinates of a point; that with number 1 is upright."""
        return self.points.shape[-1]

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
        noise = max(_noise(self.points, self.seen), (MIN_RELATIVE_BEND * extent) ** 2, 1e-300)
        return float((w * x.square()).sum() / (x.shape[-1] * spare.sum()).clamp(min=1)) / noise

    @property
    def time_reversed(self) -> Body:
        """The same played backwards: as smooth, and in step with nothing."""
        return replace(self, rows=self.rows.flip(0), motion=self.motion.flip(0), weights=self.weights.flip(0))

    @property
    def with_lag_noise(self) -> Body:
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


def body_of(x: Tensor, weights: Tensor, step: float = STEP, *, least: float = TINY**2) -> Body:
    """Rows, motion and weights of tracks ``(T, n, d)`` with weights ``(T, n)``, 0 = missing; some frames less at each end."""
    seen = (weights > 0) & x.isfinite().all(-1)
    x = torch.where(seen[..., None], x, 0.0).double()
    whole = seen.sum(-1) >= min(2, seen.shape[1])
    edge = _edge(step)
    if not bool(whole.any()) or len(x) <= 2 * edge:
        rest = max(len(x) - 2 * edge, 1)
        rows, motion = x.new_zeros(rest, x[0].numel()), x.new_zeros(rest, x.shape[-1])
        return Body(rows, motion, x.new_zeros(rest), x, seen, step)
    return _body(regress_missing(fill_gaps(x, seen), seen), seen, whole, step, least)


def split_points(body: Body) -> tuple[Body, Body]:
    """Bodies of either half of the points: their noise is independent."""
    n = body.points.shape[1]
    order = torch.randperm(n, generator=torch.Generator().manual_seed(0)).to(body.points.device)
    whole = body.seen.sum(-1) >= min(2, n)
    first, second = (
        _body(body.points[:, part], body.seen[:, part], whole, body.step, body.noise)
        for part in (order[: (n + 1) // 2], order[n // 2 :])
    )
    return first, second


# Standard deviation of the kernel for the size of the body in the image (half to six times as much are alike to 1 %).
SIZE_KERNEL_SECONDS = 1 / 3
# Noise variance of the rows over that of third differences: cameras are not affine (1 to 4 are alike, 8 is 4 % worse).
NOISE_FACTOR = 2.0


def _body(held: Tensor, seen: Tensor, whole: Tensor, step: float, least: float) -> Body:
    """The body of complete points."""
    width, edge = _width(step), _edge(step)
    size, middle = _frame(held, SIZE_KERNEL_SECONDS / step)
    shape = (held - middle) / size[:, None, None]
    noise = max(_noise(shape, seen), least)
    variance = noise * NOISE_FACTOR / (2 * math.sqrt(math.pi) * width)
    inside = slice(edge, -edge)
    places = smooth(shape, width)[inside]
    places = (places - places.mean(0)) / math.sqrt(variance)
    rows = (places if held.shape[-1] == 2 else _principal_combinations(places)).flatten(1)
    return Body(rows, _motion(held, width)[inside], whole.double()[inside], held, seen, step, noise=noise)


def _principal_combinations(places: Tensor) -> Tensor:
    """As many combinations ``(T, k, d)`` of points ``(T, n, d)`` as move by more than noise of variance 1: what all tell,
    sooner."""
    by_point = places.movedim(1, 0).flatten(1)
    values, vectors = torch.linalg.eigh(by_point @ by_point.mT / max(by_point.shape[1], 1))
    kept = max(int((values > 1).sum()), 1)
    return torch.einsum("tnd,nk->tkd", places, vectors[:, -kept:].flip(-1))


KERNEL_SECONDS = 1 / 30  # Standard deviation of the smoothing kernel (15 mm of noise: twice that finds 1 to 2 % less).
MIN_KERNEL_FRAMES = 0.7  # Below, a sampled Gaussian is none.


def _width(step: float) -> float:
    return max(KERNEL_SECONDS / step, MIN_KERNEL_FRAMES)


EDGE_SIGMAS = 2.0  # Kernel widths left out at either end: one-sided kernels of both cameras would speak for lag 0.


def _edge(step: float) -> int:
    return math.ceil(EDGE_SIGMAS * _width(step) - 1e-9)


def smooth(x: Tensor, width: float) -> Tensor:
    """Gaussian means along the first dimension, of what there is at the ends."""
    return _convolve(x, width) / _convolve(x.new_ones(len(x), *[1] * (x.ndim - 1)), width)


GAP_KERNELS_FRAMES = (1.0, 2.5, 6.0, 15.0, 40.0)  # Ever wider kernels that fill gaps, frames.


def fill_gaps(x: Tensor, seen: Tensor) -> Tensor:
    """Missing positions ``(T, n)`` from the same track's nearest times, by the narrowest Gaussian that sees some."""
    result, open_ = x, ~seen
    for width in GAP_KERNELS_FRAMES:
        if not bool(open_.any()):
            return result
        share = _convolve(seen.double(), width)
        filled = _convolve(torch.where(seen[..., None], x, 0.0), width) / share.clamp(min=1e-12)[..., None]
        take = open_ & (share > 0.1)
        result, open_ = torch.where(take[..., None], filled, result), open_ & ~take
    count = seen.sum(0).clamp(min=1)[:, None]
    mean = torch.where(seen[..., None], x, 0.0).sum(0) / count
    return torch.where(open_[..., None], mean, result)


MAX_DISTANCE_RATIO = 3.0  # Median distances from the centre beyond which a track has no part in centre and size.


def _frame(x: Tensor, slow: float) -> tuple[Tensor, Tensor]:
    """Size ``(T,)`` and middle ``(T, 1, 2)`` of the body, of tracks that stay with it."""
    far = (x - x.median(1, keepdim=True).values).norm(dim=-1)
    ratio = (far / far.median(1, keepdim=True).values.clamp(min=1e-300)).median(0).values
    kept = (ratio <= max(MAX_DISTANCE_RATIO, float(ratio.min())))[None, :, None]
    middle = (x * kept).sum(1, keepdim=True) / kept.sum()
    spread = ((x - middle).square() * kept).sum((1, 2)) / kept.sum()
    size = smooth(spread.sqrt(), slow)
    return size.clamp(min=1e-9 * float(size.max()) + 1e-300), middle


def _noise(x: Tensor, seen: Tensor) -> float:
    r"""Variance of a coordinate from third differences :math:`(\mathrm{med}|d_3| / .6745)^2 / 20`: motion is smooth."""
    rough = x.diff(n=3, dim=0)[seen[3:] & seen[2:-1] & seen[1:-2] & seen[:-3]].abs()
    return (float(rough.median()) / 0.6745) ** 2 / 20 if rough.numel() else 0.0


NUM_FILL_PASSES = 12  # Regressions of missing positions on the other points.


def regress_missing(x: Tensor, seen: Tensor) -> Tensor:
    r"""Positions ``(T, n, d)``, those missing by regression on the other points of their frame, over and over."""
    if bool(seen.all()):
        return x
    mean = x.mean(0)
    rows, (n, dims) = (x - mean).flatten(1), x.shape[1:]
    noise = max(_noise(x, seen), 1e-6 * float(rows.square().mean()), 1e-300)
    unit = torch.eye(dims * n, dtype=x.dtype, device=x.device)
    for _ in range(NUM_FILL_PASSES):
        inverse = torch.linalg.inv(rows.mT @ rows / len(rows) + noise * unit)
        own = inverse.unflatten(0, (n, dims)).unflatten(2, (n, dims)).diagonal(dim1=0, dim2=2).movedim(-1, 0)  # (n, d, d)
        change = torch.linalg.solve(own, (rows @ inverse).unflatten(1, (n, dims)).movedim(0, 2)).movedim(2, 0)
        nearby = fill_gaps(torch.where(seen[..., None], change, 0.0), seen)
        rows = rows - torch.where(seen[..., None], 0.0, change - nearby).flatten(1)
    return rows.unflatten(1, (n, dims)) + mean


def _motion(x: Tensor, width: float) -> Tensor:
    """Median velocity ``(T, d)`` of the points: a few that go elsewhere do not matter."""
    velocity = torch.gradient(smooth(x, width), dim=0)[0]
    return 0.5 * (velocity.median(1).values - (-velocity).median(1).values)  # of both middle ones


def _convolve(x: Tensor, width: float) -> Tensor:
    """Sums under a Gaussian of sum 1 along the first dimension."""
    reach = min(math.ceil(4 * width), max(len(x) - 1, 1))
    u = torch.arange(-reach, reach + 1, dtype=x.dtype, device=x.device) / width
    kernel = torch.exp(-0.5 * u.square())
    flat = x.reshape(len(x), -1).mT[:, None]
    return torch.nn.functional.conv1d(flat, (kernel / kernel.sum())[None, None], padding=reach)[:, 0].mT.reshape(x.shape)


PIECE = 2048
"""Lags at a time: bounds the memory on long takes."""


@dataclass(frozen=True, eq=False)
class SubspaceCurve:
    """Evidence over lags; frame i of a goes with frame i + lag of b."""

    lags: Tensor  # ``(L,)`` frames
    scores: Tensor
    counts: Tensor  # ``(L,)`` frames that overlap, but for the ends of each take
    shape: Tensor  # ``(L,)`` nats per frame that the shapes tell about each other, beyond chance
    height: Tensor  # ``(L,)`` the same of vertical coordinates alone
    motion: Tensor  # ``(L,)`` nats per frame that the motions of the whole tell
    signal: tuple[float, float]  # of either camera, directions in which the shape moves by more than noise
    bodies: tuple[Body, Body] | None = None

    @property
    def rates(self) -> Tensor:
        """``(L,)`` nats per frame: what does not grow with the overlap."""
        return self.scores / self.counts.clamp(min=1.0)


def subspace_curve(a: Tensor, b: Tensor, wa: Tensor, wb: Tensor, lags: tuple[int, int], *, step: float = STEP) -> SubspaceCurve:
    r"""Evidence for every lag between the tracks of two static cameras that need not have a point in common. a ``(Ta, n, 2)``,
    b ``(Tb, m, 2)``, wa ``(Ta, n)``, wb ``(Tb, m)``."""
    if a.shape[-1] == 3:
        second = body_of(b, wb, step)
        first = body_of(a, wa, step, least=second.noise)
    else:
        first = body_of(a, wa, step)
        second = body_of(b, wb, step, least=first.noise if b.shape[-1] == 3 else TINY**2)
    return bodies_curve(first, second, lags, step)


MIN_OVERLAP_SHARE = 0.35  # Share of the shorter take below which a lag is not scored.
MIN_OVERLAP_SECONDS = 0.8  # Overlap below which a lag is not scored.
SHAPE_SAMPLE_RATE = 2.4  # Independent samples per second of the shape; fitted, with the next two, to the posterior of the true lag.
HEIGHT_SAMPLE_RATE = 2.25  # The same of its vertical coordinate.
MOTION_SAMPLE_RATE = 5.7  # The same of the common motion.


def bodies_curve(first: Body, second: Body, lags: tuple[int, int], step: float = STEP) -> SubspaceCurve:
    """The same of what is prepared."""
    shape, height, motion, counts = _curves(first, second, lags)
    judged = counts >= max(
        MIN_OVERLAP_SHARE * min(float(first.weights.sum()), float(second.weights.sum())), MIN_OVERLAP_SECONDS / step - 1e-9
    )
    if bool(judged.any()):
        chance = _chance_bias(first, second.time_reversed, counts, judged, lags)
        shape, height = shape - chance[:, 0], height - chance[:, 1]
    scores = counts * step * (SHAPE_SAMPLE_RATE * shape + HEIGHT_SAMPLE_RATE * height + MOTION_SAMPLE_RATE * motion)
    span = torch.arange(lags[0], lags[1] + 1, dtype=torch.float64, device=counts.device)
    return SubspaceCurve(
        span, torch.where(judged, scores, torch.nan), counts, shape, height, motion, (first.signal, second.signal), (first, second)
    )


def _curves(a: Body, b: Body, lags: tuple[int, int]) -> list[Tensor]:
    """Information of shapes, of heights and of motions, and counts, at all lags."""
    weights = None if bool((a.weights > 0).all() and (b.weights > 0).all()) else (a.weights, b.weights)
    chunks = []
    for lo in range(lags[0], lags[1] + 1, PIECE):
        span = lo, min(lo + PIECE - 1, lags[1])
        aa, bb, ab, counts = lag_covariances(a.rows, b.rows, span, weights)
        *motion, _ = lag_covariances(a.motion, b.motion, span, weights)
        upright = _vertical((aa, bb, ab), (a.dims, b.dims))
        chunks.append((_mutual_information(aa, bb, ab), _mutual_information(*upright), _motion_information(*motion), counts))
    return [torch.cat(parts) for parts in zip(*chunks, strict=True)]


NUM_CHANCE_LAGS = 40  # Lags at which the bias by chance is measured.


def _chance_bias(a: Body, b: Body, counts: Tensor, judged: Tensor, lags: tuple[int, int]) -> Tensor:
    """What shapes and heights ``(L, 2)`` of different events tell about each other: a line in 1 / count, through some lags."""
    at = judged.nonzero()[:, 0]
    at = at[torch.linspace(0, len(at) - 1, min(NUM_CHANCE_LAGS, len(at))).round().long().to(at.device)]
    shared, inverse, n = [], [], a.rows.shape[1]
    for lag in (at + lags[0]).tolist():
        start, end = max(0, -lag), min(len(a.rows), len(b.rows) - lag)
        seen = a.weights[start:end] * b.weights[start + lag : end + lag] > 0
        both = torch.cat([a.rows[start:end], b.rows[start + lag : end + lag]], dim=1)[seen]
        both = both - both.mean(0)
        share = 1 / max(len(both), 1)
        c = (share * both.mT @ both)[None]
        parts = c[:, :n, :n], c[:, n:, n:], c[:, :n, n:]
        shared.append(torch.cat([_mutual_information(*parts), _mutual_information(*_vertical(parts, (a.dims, b.dims)))]))
        inverse.append([1.0, share])
    design = torch.tensor(inverse, dtype=torch.float64, device=counts.device)
    # the default driver reads an order of pivots that nobody wrote: last digits that differ from run to run (pytorch issue 187411)
    line = torch.linalg.lstsq(design, torch.stack(shared), driver="gelsd").solution
    return line[0] + line[1] / counts.clamp(min=1.0)[:, None]


def information(shape: Tensor, motion: Tensor, bodies: tuple[Body, Body]) -> Tensor:
    """Evidence per second ``(L,)`` of joint covariances of the bodies' shapes and motions; chance is in it."""
    dims, n = (bodies[0].dims, bodies[1].dims), bodies[0].rows.shape[1]
    parts = _parts(shape, n)
    shared = SHAPE_SAMPLE_RATE * _mutual_information(*parts) + HEIGHT_SAMPLE_RATE * _mutual_information(*_vertical(parts, dims))
    return shared + MOTION_SAMPLE_RATE * _motion_information(*_parts(motion, dims[0]))


_Parts = tuple[Tensor, Tensor, Tensor]


def _parts(joint: Tensor, n: int) -> _Parts:
    """Covariances of a and of b, and between them, of joint ones whose first n rows are a's."""
    return joint[:, :n, :n], joint[:, n:, n:], joint[:, :n, n:]


def _vertical(parts: _Parts, dims: tuple[int, int]) -> _Parts:
    """Covariances of the upright coordinate of points alone."""
    (aa, bb, ab), (da, db) = parts, dims
    return aa[..., 1::da, 1::da], bb[..., 1::db, 1::db], ab[..., 1::da, 1::db]


def _mutual_information(aa: Tensor, bb: Tensor, ab: Tensor) -> Tensor:
    """Mutual information ``(L,)`` of rows with noise of variance 1."""
    aa, bb = (c + torch.eye(c.shape[-1], dtype=c.dtype, device=c.device) for c in (aa, bb))
    low_a, low_b = _factor(aa), _factor(bb)
    white = torch.linalg.solve_triangular(low_a, ab, upper=False)
    white = torch.linalg.solve_triangular(low_b, white.mT, upper=False)
    left = torch.eye(white.shape[-2], dtype=aa.dtype, device=aa.device) - white @ white.mT
    return -_factor(left).diagonal(dim1=-2, dim2=-1).log().sum(-1)


VELOCITY_NOISE_SHARE = 0.02  # Noise of a velocity as a share of its variance: medians of different points differ.


def _motion_information(aa: Tensor, bb: Tensor, ab: Tensor) -> Tensor:
    """Mutual information ``(L,)`` where each coordinate has noise in proportion to itself."""
    one, two = (VELOCITY_NOISE_SHARE * c.diagonal(dim1=-2, dim2=-1) for c in (aa, bb))
    one, two = (v.clamp(min=1e-12 * float(v.max()) + 1e-300).rsqrt()[..., None] for v in (one, two))
    return _mutual_information(one * aa * one.mT, two * bb * two.mT, one * ab * two.mT)


def _factor(c: Tensor) -> Tensor:
    low: Tensor = torch.linalg.cholesky_ex(c).L
    return low


# ----------------------------------------------------------------------------------------------------------------------
# What speaks against a lag between different points: motion that repeats itself, and a peak that depends on single moments.


def self_similarity(curve: SubspaceCurve, best: int, apart: float) -> float:
    r"""How much the motion resembles itself at another time that fits as well: 0 not at all, 1 as much as at the same time."""
    if curve.bodies is None:
        return 0.0
    judged = curve.scores.isfinite()
    rivals = judged.nonzero()[:, 0] - best
    frames, step = min(len(body.rows) for body in curve.bodies), curve.bodies[0].step
    reach = min(int(rivals.abs().max()), frames - math.ceil(MIN_OVERLAP_SECONDS / step))
    if reach <= apart:
        return 0.0
    both = sum((_self_information(body, reach) for body in curve.bodies), curve.scores.new_zeros(2 * reach + 1))
    both = both + both.flip(0)
    padded = torch.nn.functional.pad(both, (1, 1), value=math.inf)
    peak = (both >= padded[:-2]) & (both >= padded[2:])
    rivals = rivals[(rivals.abs() <= reach) & (rivals.abs() > apart)] + reach
    repeats = both[rivals[peak[rivals]]]
    if not len(repeats):
        return 0.0
    own, other = float(both[reach]), float(repeats.max())
    return other / own if own > 0 else math.inf


def _self_information(body: Body, reach: int) -> Tensor:
    """Evidence per frame ``(2 reach + 1,)`` between halves of the points."""
    first, second = split_points(body)
    return bodies_curve(first.with_lag_noise, second.with_lag_noise, (-reach, reach), body.step).rates.nan_to_num(-math.inf)


NUM_JACKKNIFE_BLOCKS = 8  # Parts of the overlap that the jackknife leaves out in turn.


def jackknife_sigma(curve: SubspaceCurve, lag: int) -> float:
    r"""Standard deviation of the best lag in frames, by the jackknife over parts of the overlap."""
    if curve.bodies is None:
        return 0.0
    a, b = curve.bodies
    start, end = max(0, 1 - lag), min(len(a.rows), len(b.rows) - lag - 1)
    if end - start < NUM_JACKKNIFE_BLOCKS:
        return math.inf
    edges = torch.linspace(start, end, NUM_JACKKNIFE_BLOCKS + 1).round().long().tolist()
    sizes = torch.tensor(edges).diff().tolist()
    shapes: list[Tensor] = []
    motions: list[Tensor] = []
    for at in range(lag - 1, lag + 2):
        w = a.weights[start:end] * b.weights[start + at : end + at]
        for moments, x, y in ((shapes, a.rows, b.rows), (motions, a.motion, b.motion)):
            both = torch.cat([x[start:end], y[start + at : end + at], torch.ones_like(w)[:, None]], dim=1) * w[:, None]
            moments.append(torch.stack([part.mT @ part for part in both.split(sizes)]))
    shape, motion = (_leave_one_out(torch.stack(moments)) for moments in (shapes, motions))
    before, here, after = information(shape, motion, (a, b)).unflatten(0, (3, NUM_JACKKNIFE_BLOCKS))
    bend = float((before - 2 * here + after).mean())
    return math.sqrt((NUM_JACKKNIFE_BLOCKS - 1) * float(((after - before) / 2).var(correction=0))) / -bend if bend < 0 else math.inf


def _leave_one_out(moments: Tensor) -> Tensor:
    """Covariances ``(L B, d, d)`` of all parts but one, of moments ``(L, B, d + 1, d + 1)``."""
    rest = (moments.sum(1, keepdim=True) - moments).flatten(0, 1)
    count = rest[:, -1:, -1:].clamp(min=1.0)
    mean = rest[:, :-1, -1:] / count
    return rest[:, :-1, :-1] / count - mean @ mean.mT


# ----------------------------------------------------------------------------------------------------------------------
# The lag between two cameras that track different points, between frames, with what speaks against it.


@dataclass(frozen=True, eq=False)
class SubspaceShift:
    """Which frame of b goes with which of a."""

    position: float  # frames: frame i of a is at i + position of b; 0 where nothing could be judged
    sigma: float  # its standard deviation if the peak is the right one, frames
    peaks: Tensor  # ``(k, 2)`` position and score of local maxima, best first
    probability: float  # that the position is right to within a frame
    margin: float  # nats per frame over the next peak, times the frames that overlap at the best: periodic motion has none
    refusal: Notice | None = None  # why the data do not decide; None where they do

    @property
    def ok(self) -> bool:
        """Whether the data decide."""
        return self.refusal is None

    @property
    def reason(self) -> str:
        """Why not, and what to do; empty where they do."""
        return "" if self.refusal is None else self.refusal.text


NUM_PEAKS = 6  # Local maxima that are returned.
MIN_PEAK_SEPARATION_SECONDS = 0.1  # Within this peaks are one.
MAX_SIGMA_STEPS = 0.6  # Sigma above which a shift decides nothing, steps of the curve.
# Margin over the score from which the motion is not compared with itself (425 periodic motions stay below .6).
UNIQUE_PEAK_SHARE = 0.7
MAX_SELF_SIMILARITY = 0.68  # Resemblance of the motion to itself from which a peak may be another period.
MODEL_SIGMA_SECONDS = 1 / 150  # Error of a precise peak, because cameras are not affine.


def subspace_shift(curve: SubspaceCurve, *, start: float = 0.0, step: float = STEP) -> SubspaceShift:
    r"""The best lag of a curve, by the parabola through its highest three scores, and whether to believe it."""
    judged = curve.scores.isfinite()
    if int(judged.sum()) < 3:
        return SubspaceShift(0.0, math.inf, curve.scores.new_zeros(0, 2), 0.0, 0.0, Notice(ShiftNotice.SHORT_OVERLAP))
    scores = curve.scores.nan_to_num(-math.inf)
    top = local_maxima(scores, MIN_PEAK_SEPARATION_SECONDS / step)
    positions = [_between(scores, i) for i in top[:NUM_PEAKS]]
    places = torch.tensor([p for p, _ in positions], dtype=scores.dtype, device=scores.device)
    peaks = torch.stack([curve.lags[0] + places, scores[top[:NUM_PEAKS]]], dim=1)
    best = top[0]
    probability, margin = _probability(scores, best), _margin(curve, best, MIN_PEAK_SEPARATION_SECONDS / step)
    probability = min(probability, 1 / (1 + math.exp(-max(min(margin, 700.0), -700.0))))
    position = float(peaks[0, 0])
    sigma = math.hypot(MODEL_SIGMA_SECONDS / step, max(positions[0][1], jackknife_sigma(curve, round(position))))
    times = start + step * peaks[1:4, 0]
    refusal = _refusal(curve, best, probability, margin, times, step)
    if (
        refusal is None
        and margin < UNIQUE_PEAK_SHARE * float(scores[best])
        and self_similarity(curve, best, MIN_PEAK_SEPARATION_SECONDS / step) > MAX_SELF_SIMILARITY
    ):
        refusal = Notice(ShiftNotice.REPEATED, margin, {"case": "itself"})
    if refusal is None and sigma > MAX_SIGMA_STEPS:
        refusal = Notice(ShiftNotice.BLUNT, sigma * step, {"case": "known" if math.isfinite(sigma) else "rough"})
    return SubspaceShift(position, sigma, peaks, probability, margin, refusal)


def local_maxima(scores: Tensor, separation: float) -> list[int]:
    """Local maxima, best first, none within so many frames of a better one."""
    padded = torch.nn.functional.pad(scores, (1, 1), value=-math.inf)
    top = ((scores >= padded[:-2]) & (scores >= padded[2:]) & scores.isfinite()).nonzero()[:, 0]
    selected: list[int] = []
    for i in top[scores[top].argsort(descending=True, stable=True)].tolist():
        if all(abs(i - j) > separation + 1e-9 for j in selected):
            selected.append(i)
        if len(selected) > 4 * NUM_PEAKS:
            break
    return selected


def _between(scores: Tensor, i: int) -> tuple[float, float]:
    """Place of the maximum near entry i, and its standard deviation."""
    around = scores[max(i - 1, 0) : i + 2].tolist()
    bend = around[0] - 2 * around[1] + around[2] if len(around) == 3 else 0.0
    if not (math.isfinite(bend) and bend < 0):
        return float(i), 1.0
    move = 0.5 * (around[0] - around[2]) / bend
    return i + max(-0.5, min(0.5, move)), math.sqrt(-1 / bend)


def _probability(scores: Tensor, best: int) -> float:
    """Share of the posterior within a frame of the best."""
    weight = (scores - scores[best]).exp()
    return float(weight[max(best - 1, 0) : best + 2].sum() / weight.sum())


def _margin(curve: SubspaceCurve, best: int, apart: float) -> float:
    """Nats per frame over the best other maximum, times the best one's frames."""
    rates = torch.where(curve.scores.isfinite(), curve.rates, -math.inf)
    others = [i for i in local_maxima(rates, apart) if abs(i - best) > apart + 1e-9]
    return float((rates[best] - rates[others[0]]) * curve.counts[best]) if others else float(curve.scores[best])


MIN_POSTERIOR = 0.95  # Posterior of the best peak for a decision.
MIN_MARGIN = 7.0  # Nats above the next peak for a decision: 98 of 100 periodic gaits stay below 3, sums of harmonics reach 13.
MIN_INFORMATION_RATE = 1.5  # Nats per second below which nothing is shared.
MIN_BEND = 1.5  # Variance about straight lines over the noise: 1.0 to 1.1 for constant velocities, 16 and more for bodies.


def _refusal(curve: SubspaceCurve, best: int, probability: float, margin: float, times: Tensor, step: float) -> Notice | None:
    """Why the data do not decide; empty where they do."""
    if min(curve.signal) < 1 or float(curve.rates[best]) < MIN_INFORMATION_RATE * step:
        return Notice(ShiftNotice.NOISY, min(curve.signal))
    if curve.bodies is not None and min(body.bend for body in curve.bodies) < MIN_BEND:
        return Notice(ShiftNotice.STRAIGHT, min(body.bend for body in curve.bodies))
    if probability >= MIN_POSTERIOR and margin >= MIN_MARGIN:
        return None
    others = ", ".join(f"{time:+.2f}" for time in times.tolist())
    return Notice(ShiftNotice.REPEATED, margin, {"case": "others" if margin < MIN_MARGIN else "unclear", "rivals": others})
