"""The search for the best shift of corresponding points: all lags at some clock rates, then descents from the best of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.tasks.sync_attempt import APART, PEAKS, Attempt
from dyntorch.tasks.sync_curve import Curve, Samples, epipolar_curve
from dyntorch.tasks.sync_descent import Descent, Fit
from dyntorch.tasks.sync_tracks import Tracks

CLEAR = 0.6
"""Nats above the next peak from which on that one needs no descent of its own."""
DRIFTING = 10.0
"""Seconds of overlap from which a clock rate is looked for: 1 % amounts to less than two frames of 30 at the ends of shorter takes,
and what is wrong with a motion fits into a rate."""
SIGNIFICANT = 3.0
"""Sigmas from 1 for a clock rate to be believed."""
FASTEST = 0.022
"""Clock rates off by more are none."""
NEGLIGIBLE = 0.1
"""Frames over the take that a rate must amount to."""


@dataclass(frozen=True)
class Search:
    """How to search.

    Attributes:
        step: seconds per lag; the slower camera's frame at least.
        max_shift: seconds, None for all shifts with some overlap.
        rates: of b's clock, to search at.
        free_rate: whether the descent may change the rate.
        method: ``"epipolar"`` or ``"affine"``: what the tracks were made for.
    """

    step: float = 0.0
    max_shift: float | None = None
    rates: tuple[float, ...] = (1.0,)
    free_rate: bool = True
    method: str = "epipolar"


def attempt(a: Tracks, b: Tracks, search: Search, points: Tensor | None = None) -> Attempt:
    """Search all shifts at the given rates of b's clock, descend from the best, and settle the rate.

    Args:
        points: ``(n,)`` bool, who takes part; all by default.
    """
    points = torch.ones(a.x.shape[1], dtype=torch.bool, device=a.x.device) if points is None else points
    a, b = (a, b) if bool(points.all()) else (a.only(points), b.only(points))
    step = max(a.step, b.step, search.step)
    searched = [
        (samples, epipolar_curve(samples, search.max_shift)) for samples in (Samples.of(a, b, step, r) for r in search.rates)
    ]
    fit = _best(a, b, [curve for _, curve in searched], step, search.free_rate)
    samples, curve = min(searched, key=lambda found: abs(found[0].rate - (fit.rate if fit else 1.0)))
    if fit is not None and abs(fit.rate - samples.rate) * (float(a.times[-1]) - float(a.times[0])) > 0.25 * step:
        samples = Samples.of(a, b, step, fit.rate)
        curve = epipolar_curve(samples, search.max_shift)
    return Attempt(a, b, fit, curve, samples, step, search.max_shift, points, search.method)


def _best(a: Tracks, b: Tracks, curves: list[Curve], step: float, free_rate: bool) -> Fit | None:
    """The likeliest minimum near the peaks of the curves."""
    frame = max(a.step, b.step)
    starts = sorted(((score, lag * curve.rate, curve.rate) for curve in curves for lag, score in curve.peaks(PEAKS)), reverse=True)
    if not starts:
        return None
    apart = max(APART * frame, 1.5 * step)
    rivals = [start for start in starts if abs(start[1] - starts[0][1]) > apart or start[2] != starts[0][2]]
    several = len(curves) > 1 or not rivals or starts[0][0] - rivals[0][0] < CLEAR
    widths = [step]
    while widths[-1] > frame:
        widths.append(max(frame, widths[-1] / 3))
    descent = Descent(a, b, step)
    found = []
    for score, offset, rate in starts[: PEAKS if several else 1]:
        fit = descent.run(offset, rate, free_rate=free_rate and step > frame)
        if fit is not None:
            # the curve's variance counts everything, the fit's robust residual nothing that is far: both have a say
            found.append((score - math.log(max(fit.residual, 1e-300)) + 0.5 * math.log(fit.effective), fit))
    if not found:
        return None
    best = max(found, key=lambda pair: pair[0])[1]
    for width in widths[1:]:
        descent = Descent(a, b, width)
        best = descent.run(best.offset, best.rate, free_rate=free_rate) or best
    long = float(best.times[-1] - best.times[0]) > DRIFTING
    return _settled(descent, best) if free_rate and long else best


def _settled(descent: Descent, fit: Fit) -> Fit:
    """With its own rate where that differs from 1 beyond doubt, else with rate 1."""
    free = descent.run(fit.offset, fit.rate, free_rate=True)
    span = float(fit.times[-1] - fit.times[0])
    if free is not None and FASTEST > abs(free.rate - 1) > max(SIGNIFICANT * free.rate_sigma, NEGLIGIBLE * descent.frame / span):
        return free
    fixed = descent.run(fit.shift, 1.0) if fit.rate != 1 else fit
    return fixed or fit
