"""Row spaces of two cameras' tracks of different points, by kind of camera: what they share at a lag, and where between frames.

Points of the second camera are fixed linear combinations of those of the first at every moment.  At the right lag, and only
there, the row spaces of the two matrices of tracks :math:`A` and :math:`B` meet, so that

* ``"rank"``: the rank of :math:`[A; B]` is least.  With noise no rank is: what lies beyond it is measured.
* ``"log_determinant"``: :math:`\\tfrac12 \\log |C_{aa} + I| |C_{bb} + I| / |C + I|`, in units of noise, is largest: the rank
  counted smoothly, and the information that Gaussian rows have about each other.
* ``"principal_angles"``: most angles between the spaces are zero: the sum of their squared cosines is largest.

Affine cameras that stand still show :math:`x_i = A X_i + b`: the rows of coordinates over time are those of the motion.  Affine
cameras that pan and zoom, :math:`x_i(t) = z(t) A X_i(t) + b(t)`, show it about the mean of each frame, :math:`x_i(t) - \\bar x(t)`,
and the ratio :math:`z_b / z_a` of the zooms is estimated.  For a body that is small beside its distance a perspective camera is the
latter, with the inverse of the distance as zoom.  Every kind is tried with little and with much noise; the one whose best lag
stands out most, above what lags of the time-reversed video reach, is selected.

Source: thesis, chapter 7; Wolf and Zomet 2006, Wide baseline matching between unsynchronized video sequences; Björck and Golub
1973.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import torch
from torch import Tensor

from dyntorch.numerics.lags import compress, lag_covariances
from dyntorch.tasks.synchronize.result import SynchronizeOptions
from dyntorch.tasks.synchronize.subspace import (
    MIN_OVERLAP_SECONDS,
    MIN_OVERLAP_SHARE,
    NOISE_FACTOR,
    SIZE_KERNEL_SECONDS,
    fill_gaps,
    regress_missing,
    smooth,
)
from dyntorch.tasks.synchronize.tracks import Tracks, smooth_at

Kind = Literal["affine", "affine_moving", "perspective"]


KINDS: tuple[Kind, ...] = ("affine", "affine_moving", "perspective")


Measure = Literal["auto", "rank", "log_determinant", "principal_angles"]


MEASURES: tuple[Measure, ...] = ("auto", "rank", "log_determinant", "principal_angles")


@dataclass(frozen=True)
class LagCovariances:
    """Covariances of a's and b's rows over the overlap of every lag, about its mean."""

    aa: Tensor  # ``(L, p, p)``
    bb: Tensor  # ``(L, q, q)``
    ab: Tensor  # ``(L, p, q)``
    counts: Tensor  # ``(L,)`` frames

    @staticmethod
    def of(a: Tensor, b: Tensor, lags: tuple[int, int]) -> LagCovariances:
        """Of rows ``(Ta, p)`` and ``(Tb, q)`` at the lags from the first to the last."""
        return LagCovariances(*lag_covariances(a, b, lags, None))

    def scale(self, variances: tuple[float, float]) -> LagCovariances:
        """In units of these variances of a's and of b's noise."""
        va, vb = variances
        return LagCovariances(self.aa / va, self.bb / vb, self.ab / math.sqrt(va * vb), self.counts)

    def combine(self, a: Tensor, b: Tensor) -> LagCovariances:
        """Of combinations ``(p', p)`` of a's rows and ``(q', q)`` of b's."""
        return LagCovariances(a @ self.aa @ a.mT, b @ self.bb @ b.mT, a @ self.ab @ b.mT, self.counts)

    @property
    def joint(self) -> Tensor:
        """``(L, p + q, p + q)``."""
        return torch.cat([torch.cat([self.aa, self.ab], dim=-1), torch.cat([self.ab.mT, self.bb], dim=-1)], dim=-2)


MIN_SIGNAL_VARIANCE = 4.0  # Variance over the noise from which a direction belongs to a row space.


def shared_information(moments: LagCovariances, judged: Tensor, measure: Measure) -> Tensor:
    r"""How much the rows share at every lag ``(L,)``, more is better; in units of noise of variance 1."""
    if measure == "rank":
        return _beyond_rank(moments, judged)
    if measure == "principal_angles":
        return _angles(moments, judged)
    if measure not in MEASURES:
        raise ValueError(f"measure must be one of {', '.join(MEASURES)}, got {measure!r}")
    return 0.5 * (_log_determinant(moments.aa) + _log_determinant(moments.bb) - _log_determinant(moments.joint))


def _log_determinant(c: Tensor) -> Tensor:
    low = torch.linalg.cholesky_ex(c + torch.eye(c.shape[-1], dtype=c.dtype, device=c.device)).L
    return 2 * low.diagonal(dim1=-2, dim2=-1).log().sum(-1)


def _beyond_rank(moments: LagCovariances, judged: Tensor) -> Tensor:
    """Less of what the least rank at any lag leaves is better."""
    values = torch.linalg.eigvalsh(moments.joint).clamp(min=0.0).flip(-1)
    ranks = (values > MIN_SIGNAL_VARIANCE).sum(-1)
    rank = int(ranks[judged].min()) if bool(judged.any()) else 0
    rest = values[:, rank:].sum(-1) if rank < values.shape[1] else values.new_zeros(len(values))
    return -0.5 * (rest + 1).log()


def _angles(moments: LagCovariances, judged: Tensor) -> Tensor:
    """Sum of squared cosines between the spaces of most motion, of as many dimensions as rise above the noise."""
    one, two = (_basis(c, judged) for c in (moments.aa, moments.bb))
    return (one.mT @ moments.ab @ two).square().sum((-2, -1))


def _basis(c: Tensor, judged: Tensor) -> Tensor:
    """``(L, p, k)`` combinations of rows that are orthonormal over time."""
    values, vectors = torch.linalg.eigh(c)
    rank = int((values[judged] > MIN_SIGNAL_VARIANCE).sum(-1).max()) if bool(judged.any()) else 0
    return vectors[..., c.shape[-1] - rank :] * values[..., None, c.shape[-1] - rank :].clamp(min=1e-12).rsqrt()


KERNEL_FRAMES = 1.0  # Kernel in frames of the slower camera: below 1 the noise would depend on the place between frames.
EDGE_SIGMAS = 3.0  # Kernel widths left out at either end, where the kernel is one-sided.
MIN_RELATIVE_NOISE = 1e-6  # Floor of the noise over the RMS distance of the points: rounding.


@dataclass(frozen=True, eq=False)
class TrackPair:
    """Two cameras' tracks on a common clock, smoothed alike, b at several moments between frames."""

    a: Tracks  # the tracks
    b: Tracks
    step: float  # seconds of a's clock from frame to frame
    rate: float  # of b's clock
    options: SynchronizeOptions

    @property
    def spatial(self) -> bool:
        """Whether a is of points in space, ``(frames, n, 3)``."""
        return self.a.x.shape[-1] == 3

    @property
    def width(self) -> float:
        """Standard deviation of the kernel, seconds: from one frame on noise is alike at all moments."""
        return KERNEL_FRAMES * max(self.step, self.a.step, self.b.step)

    @cached_property
    def times(self) -> tuple[Tensor, Tensor]:
        """Of a's frames and of b's, on their clocks, ends left out: there the kernel is one-sided."""
        edge = math.ceil(EDGE_SIGMAS * self.width / self.step)
        ta, tb = self.a.every(self.step), self.b.every(self.step * self.rate)
        return ta[edge : len(ta) - edge], tb[edge : len(tb) - edge - 1]

    @cached_property
    def first(self) -> Tensor:
        """``(T, n, d)`` a's points, complete."""
        return self._points(self.a, self.times[0], self.width)

    def second(self, fraction: float) -> Tensor:
        """``(T', m, d)`` b's points, so much of a frame later."""
        return self._points(self.b, self.times[1] + fraction * self.step * self.rate, self.width * self.rate)

    def _points(self, tracks: Tracks, times: Tensor, width: float) -> Tensor:
        x, _, weights = smooth_at(tracks, times, width)
        seen = weights > 0
        return regress_missing(fill_gaps(x, seen), seen)

    def variance(self, tracks: Tracks, width: float) -> float:
        """Of a coordinate's noise after the kernel."""
        least = MIN_RELATIVE_NOISE * tracks.scale
        return max(tracks.noise, least, 1e-150) ** 2 * min(1.0, tracks.step / (2 * math.sqrt(math.pi) * width))

    def variances(self, energies: tuple[float, float]) -> tuple[float, float]:
        """Of a's and of b's coordinates."""
        found = self.variance(self.a, self.width), self.variance(self.b, self.width * self.rate)
        if not (self.spatial and min(energies) > 0):
            return found
        share = max(v / energy for v, energy in zip(found, energies, strict=True))
        return share * energies[0], share * energies[1]

    @property
    def samples(self) -> float:
        """Independent ones of the noise per frame."""
        return min(1.0, self.step / (2 * math.sqrt(math.pi) * self.width))

    @property
    def without_gaps(self) -> TrackPair:
        """With what is missing filled in once, in the frames as they are, rather than at every moment that is asked for."""
        whole = []
        for tracks in (self.a, self.b):
            seen = tracks.weights > 0
            x = regress_missing(fill_gaps(tracks.x, seen), seen)
            whole.append(replace(tracks, x=x, weights=torch.ones_like(tracks.weights)))
        return replace(self, a=whole[0], b=whole[1])

    def only(self, a: Tensor, b: Tensor) -> TrackPair:
        """Of these points ``(n,)`` and ``(m,)`` bool alone."""
        return replace(self, a=self.a.only(a), b=self.b.only(b))


def rows_of(x: Tensor, kind: Kind, slow: float) -> Tensor:
    """Rows ``(T, d n)`` of mean 0 of points ``(T, n, d)`` as a camera of this kind needs them."""
    if kind != "affine":
        x = x - x.mean(1, keepdim=True)
    if kind == "perspective":
        size = smooth(x.square().sum((1, 2)).sqrt(), slow)
        x = x / size.clamp(min=1e-9 * float(size.max()) + 1e-300)[:, None, None] * size.mean()
    rows = x.flatten(1)
    return rows - rows.mean(0)


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """What one kind of camera, at one level of noise, says of all lags."""

    kind: Kind  # of the cameras
    level: float  # what the kind leaves unexplained, as share of the rms coordinate, beside the noise of the tracks
    lags: Tensor  # ``(L,)`` frames
    scores: Tensor  # ``(L,)`` nats per frame above chance, NaN where the overlap is too short
    counts: Tensor  # ``(L,)``
    samples: float  # independent ones per frame
    apart: float  # frames within which peaks are one

    @cached_property
    def totals(self) -> Tensor:
        """``(L,)`` nats of the whole overlap."""
        return (self.scores * self.counts * self.samples).nan_to_num(-math.inf)

    @cached_property
    def best_index(self) -> int:
        """Entry of the best lag."""
        return int(self.totals.argmax())

    @cached_property
    def margin(self) -> float:
        """Nats above any lag apart, in total and per frame, whichever is less."""
        return self._over(self.totals)[0]

    @cached_property
    def clearness(self) -> float:
        """That margin over the standard deviation of the scores at lags apart."""
        return self._over(self.totals)[1]

    def _over(self, totals: Tensor) -> tuple[float, float]:
        away = ((self.lags - self.lags[self.best_index]).abs() > self.apart) & totals.isfinite()
        if int(away.sum()) < 3 or not math.isfinite(float(totals[self.best_index])):
            return 0.0, 0.0
        count = self.counts * self.samples
        per_frame = totals / count.clamp(min=1e-9) * count[self.best_index]
        found = []
        for values in (totals, per_frame):
            rest = values[away]
            margin = float(values[self.best_index] - rest.max())
            found.append((margin, margin / max(float(rest.std()), 1e-12 + 1e-6 * float(rest.abs().max()))))
        return min(m for m, _ in found), min(c for _, c in found)


MIN_PEAK_SEPARATION_SECONDS = 0.2  # Within this peaks are one.


@dataclass(frozen=True, eq=False)
class KindMoments:
    """Covariances of both cameras' rows as one kind of camera needs them, at all lags and with b played backwards."""

    films: TrackPair
    kind: Kind  # of the cameras
    moments: LagCovariances  # of the films, and with b backwards
    chance: LagCovariances
    judged: Tensor  # ``(L,)`` bool, lags of either that overlap enough
    chance_scored: Tensor
    lags: Tensor  # ``(L,)`` frames
    energies: tuple[float, float]  # mean squares of a's and of b's rows

    @staticmethod
    def of(films: TrackPair, kind: Kind, second: list[Tensor], lags: tuple[int, int]) -> KindMoments:
        """Of b's points at fractions of frames."""
        slow = SIZE_KERNEL_SECONDS / films.step
        a, bs = rows_of(films.first, kind, slow), [rows_of(part, kind, slow) for part in second]
        energies = float(a.square().mean()), float(bs[0].square().mean())
        if films.spatial:
            a = compress(a, noise=math.sqrt(films.variances(energies)[0] * NOISE_FACTOR))
        parts = [LagCovariances.of(a, b, lags) for b in bs]
        moments = LagCovariances(
            *(torch.stack([getattr(part, name) for part in parts], dim=1).flatten(0, 1) for name in ("aa", "bb", "ab", "counts"))
        )
        chance = LagCovariances.of(a, bs[0].flip(0), lags)
        least = max(MIN_OVERLAP_SHARE * min(len(a), len(bs[0])), MIN_OVERLAP_SECONDS / films.step)
        places = torch.arange(lags[0], lags[1] + 1, dtype=a.dtype, device=a.device)[:, None]
        places = (places + torch.arange(len(bs), dtype=a.dtype, device=a.device) / len(bs)).flatten()
        within = places <= lags[1]  # fractions after the last lag are beyond the search
        moments, places = LagCovariances(*(getattr(moments, x)[within] for x in ("aa", "bb", "ab", "counts"))), places[within]
        return KindMoments(films, kind, moments, chance, moments.counts >= least, chance.counts >= least, places, energies)

    def only(self, a: Tensor, b: Tensor) -> KindMoments:
        """Of these points ``(n,)`` and ``(m,)`` bool alone: their rows are combinations of all points' rows."""
        one, two = torch.eye(self.moments.aa.shape[-1], dtype=self.moments.aa.dtype, device=a.device), self._combination(b)
        one = one if self.films.spatial else self._combination(a)
        return replace(self, moments=self.moments.combine(one, two), chance=self.chance.combine(one, two))

    def _combination(self, kept: Tensor) -> Tensor:
        rows = torch.eye(len(kept), dtype=self.moments.aa.dtype, device=kept.device)[kept]
        if self.kind != "affine":  # about the middle of those that are left
            rows = rows - rows.mean(0)
        return torch.kron(rows, torch.eye(2, dtype=rows.dtype, device=rows.device))

    def hypothesis(self, level: float) -> Hypothesis | None:
        """What all lags share at a level of noise; None without motion."""
        measure = self.films.options.measure
        first, second = (
            v * NOISE_FACTOR + level**2 * energy
            for v, energy in zip(self.films.variances(self.energies), self.energies, strict=True)
        )
        if not (0 < first < math.inf and 0 < second < math.inf and min(self.energies) > 0):
            return None
        scores = shared_information(self.moments.scale((first, second)), self.judged, measure)
        if bool(self.chance_scored.any()):
            chance = shared_information(self.chance.scale((first, second)), self.chance_scored, measure).nan_to_num(0.0)
            scores = scores - _line(chance, self.chance.counts, self.moments.counts, self.chance_scored)
        scores = torch.where(self.judged, scores, torch.nan)
        apart = MIN_PEAK_SEPARATION_SECONDS / self.films.step
        return Hypothesis(self.kind, level, self.lags, scores, self.moments.counts, self.films.samples, apart)


NUM_FRACTIONS = 2  # Places within a frame at which lags are scored.


def kind_moments(films: TrackPair, lags: tuple[int, int]) -> list[KindMoments]:
    """Of every kind of camera that the options allow."""
    fractions = NUM_FRACTIONS
    asked = films.options.camera_model
    second = [films.second(k / fractions) for k in range(fractions)]
    return [KindMoments.of(films, kind, second, lags) for kind in KINDS if asked in ("auto", kind)]


MODEL_ERRORS = (0.0, 0.03)  # What a kind of camera leaves unexplained, as shares of the RMS coordinate.


def hypotheses(kinds: list[KindMoments]) -> list[Hypothesis]:
    """One of every kind of camera and level of noise, by the measure of the options."""
    found = [one.hypothesis(level) for one in kinds for level in MODEL_ERRORS]
    return [one for one in found if one is not None and bool(one.scores.isfinite().any())]


def _line(values: Tensor, of: Tensor, at: Tensor, judged: Tensor) -> Tensor:
    """What different events share by chance at counts ``at``: a line in 1 / count, through values at counts ``of``."""
    inverse = 1 / of[judged].clamp(min=1.0)
    if float(inverse.max() - inverse.min()) < 1e-9:
        return values[judged].mean().expand(len(at))
    design = torch.stack([torch.ones_like(inverse), inverse], dim=1)
    line = torch.linalg.lstsq(design, values[judged][:, None], driver="gelsd").solution[:, 0]
    return line[0] + line[1] / at.clamp(min=1.0)


# ----------------------------------------------------------------------------------------------------------------------
# The place of a lag between frames, and the zoom of one camera over that of the other.


@dataclass(frozen=True)
class Place:
    """Where a hypothesis's best lag lies."""

    lag: float  # frames
    sigma: float  # its standard deviation, frames
    nats: float  # that the rows tell about each other there
    zoom: Tensor | None = None  # ``(T,)`` logarithm of a's zoom over b's in a's frames; None where a common one explains as much


NUM_ZOOM_TERMS = 8  # Chebyshev polynomials in time of the log ratio of both cameras' zooms.
NUM_ZOOM_ALTERNATIONS = 3  # Alternations of zoom and lag.


def refine_lag(films: TrackPair, found: Hypothesis) -> Place:
    """Lag of most information near a hypothesis's best; of cameras that may zoom, with the ratio of their zooms."""
    start = float(found.lags[found.best_index])
    plain = _climb(_LagScore(films, found.kind, found.level, around=start), start)
    if found.kind == "affine" or films.options.measure not in ("auto", "log_determinant"):
        return plain
    place = plain
    rounds = NUM_ZOOM_ALTERNATIONS
    for level in [max(MODEL_ERRORS)] + [found.level] * (rounds - 1):  # a wide optimum first
        between = _LagScore(films, "affine_moving", level, place.zoom, around=start)
        place = _climb(replace(between, zoom=between.estimate_zoom(place.lag)), place.lag)
    # a function of time is fitted with so many numbers, each worth half the logarithm of the samples
    price = 0.5 * NUM_ZOOM_TERMS * math.log(max(len(films.first) * films.samples, 2.0))
    return replace(place, nats=place.nats - price) if place.nats > plain.nats + price else plain


MIN_SEARCH_STEP_FRAMES = 1 / 2048  # Step that ends the search between frames.
CURVATURE_STEP_FRAMES = 0.125  # Step of the second difference of the score.


def _climb(score: _LagScore, place: float) -> Place:
    """The highest place near this one."""
    top, reach = score(place), 1.0 / NUM_FRACTIONS
    while reach > MIN_SEARCH_STEP_FRAMES:
        for other in (place - reach, place + reach):
            value = score(other)
            if value > top:
                place, top = other, value
                break
        else:
            reach /= 2
    bend = (2 * top - score(place - CURVATURE_STEP_FRAMES) - score(place + CURVATURE_STEP_FRAMES)) / CURVATURE_STEP_FRAMES**2
    return Place(place, 1 / math.sqrt(bend) if bend > 0 else math.inf, top, score.zoom)


NUM_ZOOM_STEPS = 12  # Steps of least squares for it.
MIN_UNSHARED_VARIANCE = 1e-6  # Floor of the share of a direction that is not common: rounding.


@dataclass(frozen=True)
class _LagScore:
    """Nats at any lag near one, by one kind of camera and level of noise; ``zoom`` as of :class:`Place`."""

    films: TrackPair
    kind: Kind
    level: float
    zoom: Tensor | None = None
    around: float = 0.0

    def __call__(self, lag: float) -> float:
        a, b = self.rows(lag)
        if len(a) < 3:
            return -math.inf
        # a zoom multiplies mean places as well: they are part of what both cameras see
        both = torch.cat([a, b], dim=1)
        both = both - both.mean(0) if self.zoom is None else both
        c, p = (both.mT @ both / len(both))[None], a.shape[1]
        count = both.new_full((1,), len(both))
        moments = LagCovariances(c[:, :p, :p], c[:, p:, p:], c[:, :p, p:], count)
        value = shared_information(moments, count > 0, self.films.options.measure)
        return float(value[0] * count[0]) * self.films.samples

    def rows(self, lag: float) -> tuple[Tensor, Tensor]:
        """Both cameras' rows in the overlap, in units of noise; of cameras with a zoom about no mean over time."""
        films, whole = self.films, math.floor(lag)
        slow = SIZE_KERNEL_SECONDS / films.step
        first, second = films.first, films.second(lag - whole)
        if self.zoom is None:
            a, b = rows_of(first, self.kind, slow), rows_of(second, self.kind, slow)
        else:
            a = ((first - first.mean(1, keepdim=True)) * torch.exp(-self.zoom)[:, None, None]).flatten(1)
            b = (second - second.mean(1, keepdim=True)).flatten(1)
        spreads = [float((x - x.mean(0)).square().mean()) for x in (a, b)]
        units = [
            math.sqrt(variance * NOISE_FACTOR + self.level**2 * spread)
            for variance, spread in zip(films.variances((spreads[0], spreads[1])), spreads, strict=True)
        ]
        start, end = self.span(len(a), len(b), whole)
        return a[start:end] / units[0], b[start + whole : max(end + whole, 0)] / units[1]

    def span(self, first: int, second: int, whole: int) -> tuple[int, int]:
        """First frame of a, and that after the last, that has a partner at a lag, and at all up to one frame from the start."""
        low, high = min(whole, math.floor(self.around) - 1), max(whole, math.ceil(self.around) + 1)
        return max(0, -low), max(min(first, second - high), 0)

    def estimate_zoom(self, lag: float) -> Tensor:
        r"""The ratio of the zooms that makes the row spaces meet best, by steps of least squares."""
        frames = len(self.films.first)
        zoom = self.films.first.new_zeros(frames) if self.zoom is None else self.zoom
        time = (torch.arange(frames, dtype=zoom.dtype, device=zoom.device) + 0.5) / frames
        order = torch.arange(1, NUM_ZOOM_TERMS + 1, dtype=zoom.dtype, device=zoom.device)
        basis = torch.cos(torch.acos(2 * time - 1)[:, None] * order)  # Chebyshev polynomials
        start, _ = self.span(frames, len(self.films.times[1]), math.floor(lag))
        for _ in range(NUM_ZOOM_STEPS):
            a, b = replace(self, zoom=zoom).rows(lag)
            u, v, rho = _canonical(a, b)
            here = basis[start : start + len(a)]
            weight = rho / (1 - rho.square()).clamp(min=MIN_UNSHARED_VARIANCE).sqrt()
            design = (u * weight)[:, None, :] * here[:, :, None]  # (T, terms, pairs)
            rest = (u - v * rho) * weight
            normal = torch.einsum("tik,tjk->ij", design, design)
            normal = normal + 1e-9 * normal.diagonal().mean() * torch.eye(len(normal), dtype=normal.dtype, device=normal.device)
            step = torch.linalg.solve_ex(normal, torch.einsum("tik,tk->i", design, rest))[0]
            zoom = zoom + basis @ step.nan_to_num(0.0).clamp(-0.5, 0.5)
        return zoom


def _canonical(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Canonical variates ``(T, k)`` of rows with noise of variance 1, of unit square, and their correlations ``(k,)``."""
    eye_a, eye_b = (torch.eye(x.shape[1], dtype=x.dtype, device=x.device) for x in (a, b))
    low_a, low_b = (torch.linalg.cholesky_ex(x.mT @ x / len(x) + eye).L for x, eye in ((a, eye_a), (b, eye_b)))
    white_a = torch.linalg.solve_triangular(low_a, a.mT, upper=False)
    white_b = torch.linalg.solve_triangular(low_b, b.mT, upper=False)
    left, rho, right = torch.linalg.svd(white_a @ white_b.mT / len(a), full_matrices=False)
    return white_a.mT @ left, white_b.mT @ right.mT, rho.clamp(max=1.0)
