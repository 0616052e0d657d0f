"""Synchronization by different points: common steps of time, then the shift at which the cameras share most information."""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor

from dyntorch.tasks.shift import Shift
from dyntorch.tasks.sync_subspace import SubspaceCurve, bodies_curve, subspace_curve
from dyntorch.tasks.sync_subspace_body import Body
from dyntorch.tasks.sync_subspace_shift import SubspaceShift, subspace_shift
from dyntorch.tasks.sync_tracks import RATES, Tracks, smoothed

FINEST = 1 / 30
"""Seconds per step at least: faster films say no more, and noise of neighbouring frames of real detectors is the same."""
DRIFTING = 20.0
"""Seconds of overlap from which clock rates are looked for."""
NEAR = 1.0
"""Seconds around the best shift in which rates are compared."""
SHARP = 0.6
"""Frames of the slower camera: a larger sigma decides nothing."""
WINDOW = 10.0
"""Seconds of a window that has a shift of its own."""
LIKELY = 0.5
"""Probability from which the shift of a window counts."""
SPREAD = 0.3
"""Frames that the shift of a window is uncertain by at least."""
SIGNIFICANT = 3.0
"""Sigmas from 1 for a rate to be believed."""
CONVINCING = 8.0
"""Nats by which another clock rate has to be better."""


def different_points(a: Tracks, b: Tracks, *, max_shift: float | None, rate: float | None) -> Shift:
    """The shift of cameras that see different points of one motion.

    Args:
        rate: of b's clock, where it is known.
    """
    step = max(a.step, b.step, FINEST)
    found = _Samples(a, b, step, rate or 1.0)
    curve = found.curve(max_shift)
    best = found.shift(curve)
    rate_sigma = 0.0
    span = min(float(t.times[-1] - t.times[0]) for t in (a, b))
    if rate is None and span > DRIFTING and math.isfinite(best.sigma):
        # a shift that is sure of itself is near enough everywhere; one that is not may be smeared by a wrong rate
        settled = _drift(curve, best, step) if best.ok else _rate(a, b, step, span, found.lag(best.position))
        ratio, rate_sigma = settled
        if ratio != 1:
            found = _Samples(a, b, step, ratio)
            curve = found.curve(max_shift)
            best = found.shift(curve)
    return _result(a, b, found, curve, _to_a_frame(best, step, max(a.step, b.step)), rate_sigma)


def _to_a_frame(best: SubspaceShift, step: float, frame: float) -> SubspaceShift:
    """Refused where the shift is not known to a frame of the slower camera, though it may be to a step of the search."""
    if not best.ok or best.sigma * step <= SHARP * frame:
        return best
    reason = (
        f"the best shift is uncertain by {best.sigma * step:.2g} s, frames are {frame:.2g} s apart: film longer, or larger motion"
    )
    return dataclasses.replace(best, ok=False, reason=reason)


class _Samples:
    """Both cameras at equal steps of a's clock."""

    def __init__(self, a: Tracks, b: Tracks, step: float, rate: float) -> None:
        self.first, self.wa = _sampled(a, step)
        self.second, self.wb = _sampled(b, step * rate)
        self.start = float(b.times[0]) / rate - float(a.times[0])
        self.step, self.rate = step, rate

    def curve(self, max_shift: float | None, around: float = 0.0) -> SubspaceCurve:
        """At all lags of a's clock within ``max_shift`` seconds of ``around``."""
        lo, hi = 1 - len(self.first), len(self.second) - 1
        if max_shift is not None:
            low, high = (((around + sign * max_shift) / self.rate - self.start) / self.step for sign in (-1, 1))
            lo, hi = min(max(lo, math.ceil(low - 1e-9)), hi), max(min(hi, math.floor(high + 1e-9)), lo)
        return subspace_curve(self.first, self.second, self.wa, self.wb, (lo, max(lo, hi)), step=self.step)

    def shift(self, curve: SubspaceCurve) -> SubspaceShift:
        return subspace_shift(curve, start=self.start, step=self.step)

    def lag(self, position: Tensor | float) -> Tensor | float:
        """Seconds of b's clock at time 0 of a's."""
        return (self.start + position * self.step) * self.rate


def _sampled(tracks: Tracks, step: float) -> tuple[Tensor, Tensor]:
    if abs(tracks.step / step - 1) < 1e-6 and float((tracks.times.diff() / step - 1).abs().max()) < 1e-3:
        return tracks.x, tracks.weights  # its own frames: nothing to interpolate
    x, _, weights = smoothed(tracks, tracks.every(step), max(0.5 * step, 0.5 * tracks.step))
    return x, weights


def _drift(curve: SubspaceCurve, best: SubspaceShift, step: float) -> tuple[float, float]:
    """The clock rate by a line through the shifts of windows, and its sigma; 1 unless it differs significantly."""
    assert curve.bodies is not None
    first, second = curve.bodies
    lag, reach = round(best.position), round(NEAR / step)
    begin, end = max(0, reach - lag), min(len(first.rows), len(second.rows) - lag)
    size = min(round(WINDOW / step), (end - begin) // 4)
    found = []
    for start in range(begin, end - size + 1, size):
        parts = _cut(first, start, start + size), _cut(second, start + lag - reach, start + lag + size + reach)
        local = subspace_shift(bodies_curve(*parts, (0, 2 * reach), step), step=1.0)
        if math.isfinite(local.sigma) and local.probability > LIKELY and 1 < local.position < 2 * reach - 1:
            found.append((start + size / 2, local.position, max(local.sigma, SPREAD)))
    if len(found) < 3:
        return 1.0, math.inf
    times, shifts, sigmas = torch.tensor(found, dtype=torch.float64).unbind(1)
    slopes = torch.combinations(shifts).diff(dim=1)[:, 0] / torch.combinations(times).diff(dim=1)[:, 0]
    slope = slopes.median()
    away = shifts - slope * times
    kept = (away - away.median()).abs() < 4 * sigmas
    w = torch.where(kept, sigmas.pow(-2), 0.0)
    middle = (w * times).sum() / w.sum()
    lever = w * (times - middle)
    total = float((lever * (times - middle)).sum())
    if total <= 0:
        return 1.0, math.inf
    drift, sigma = float((lever * shifts).sum()) / total, total**-0.5
    return (1 + drift, sigma) if abs(drift) > SIGNIFICANT * sigma else (1.0, sigma)


def _cut(body: Body, start: int, end: int) -> Body:
    part = slice(start, min(end, len(body.rows)))
    return dataclasses.replace(body, rows=body.rows[part], motion=body.motion[part], weights=body.weights[part])


def _rate(a: Tracks, b: Tracks, step: float, span: float, lag: Tensor | float) -> tuple[float, float]:
    """The clock rate whose best score near a shift is highest, by the parabola over rates, and its sigma; 1 unless convincing."""
    change = 4 * step / span  # moves the ends of the overlap by two steps
    count = math.ceil(RATES / change)
    rates = [1 + k * change for k in range(-count, count + 1)]
    middle = span / 2
    best = []
    for rate in rates:
        samples = _Samples(a, b, step, rate)
        # the moment in the middle keeps its place: (t + lag) of the old rate is rate (t + lag') of the new
        around = float(lag) - (rate - 1) * middle
        best.append(float(samples.curve(NEAR, around).scores.nan_to_num(-math.inf).max()))
    scores = torch.tensor(best, dtype=torch.float64)
    top = int(scores.argmax())
    bend = float(scores[top - 1] - 2 * scores[top] + scores[top + 1]) if 0 < top < len(rates) - 1 else 0.0
    if not (math.isfinite(bend) and bend < 0):
        return 1.0, 0.0
    sigma = change / math.sqrt(-bend)
    place = 0.5 * float(scores[top - 1] - scores[top + 1]) / bend
    if best[top] - best[count] < CONVINCING:
        return 1.0, sigma
    return rates[top] + change * max(-0.5, min(0.5, place)), sigma


def _result(a: Tracks, b: Tracks, samples: _Samples, curve: SubspaceCurve, best: SubspaceShift, rate_sigma: float) -> Shift:
    offset = float(samples.lag(best.position))
    rate = samples.rate
    first = max(float(a.times[0]), (float(b.times[0]) - offset) / rate)
    last = min(float(a.times[-1]), (float(b.times[-1]) - offset) / rate)
    center = (first + last) / 2
    drift = (rate - 1) * center
    peaks = best.peaks.clone()
    if len(peaks):
        peaks[:, 0] = samples.lag(peaks[:, 0]) + drift
    return Shift(
        offset=offset,
        sigma=best.sigma * samples.step,
        rate=rate,
        rate_sigma=rate_sigma if rate != 1 else 0.0,
        confidence=best.probability,
        peaks=peaks,
        ok=best.ok,
        reason=best.reason,
        method="subspace",
        fps=(1 / a.step, 1 / b.step),
        center=center,
        lags=torch.as_tensor(samples.lag(curve.lags)) + drift,
        scores=curve.scores,
    )
