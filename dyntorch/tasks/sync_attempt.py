"""One attempt to synchronize corresponding points, and what speaks for and against its result."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from dyntorch.tasks.sync_curve import Curve, Samples, epipolar_curve
from dyntorch.tasks.sync_descent import Descent, Fit
from dyntorch.tasks.sync_tracks import Tracks

PEAKS = 6
"""Local maxima of the curve from which a descent may start."""
FEW_ROWS = 3_000
"""Residuals that are enough to compare peaks."""
CLEAR = 0.6
"""Nats above the next peak from which on that one needs no descent of its own."""
MARGIN = 0.2
"""Nats above the next peak for a decision.  Motion capture, 120 frames: exactly periodic gaits stay below .17 in 95 of 100, true peaks
above .31 with 30 mm of noise."""
AFFINE_MARGIN = 0.5
APART = 2.5
"""Frames within which peaks are one, and halves of a take agree."""
HALF = 0.5
"""Share of the largest overlap below which a half of the take does not judge a shift."""
RIVALS = 3
"""Other peaks that are compared between frames."""
FRACTIONS = 5
"""Places within a step of a peak."""
SHARP = 0.25
"""Frames: a larger sigma decides nothing: it is a lower bound where the motion is hardly above the noise."""
DRIFTING = 10.0
"""Seconds of overlap from which a clock rate is looked for: 1 % amounts to less than two frames of 30 at the ends of shorter takes,
and what is wrong with a motion fits into a rate."""
WANDER = 1.35
"""Residual over what each half of the take has by itself, beyond which a camera may have moved."""


@dataclass(frozen=True, eq=False)
class Attempt:
    """The best shift found in one way, with its evidence.

    Attributes:
        a, b: the tracks it was found with.
        fit: the best minimum, None where there is none.
        curve: scores at the fit's rate.
        step: seconds per lag.
        max_shift: of the search, seconds.
        points: ``(n,)`` bool, who takes part.
        method: ``"epipolar"`` or ``"affine"``.
    """

    a: Tracks
    b: Tracks
    fit: Fit | None
    curve: Curve
    samples: Samples
    step: float
    max_shift: float | None
    points: Tensor
    method: str

    @property
    def frame(self) -> float:
        """Seconds of the slower camera's frame."""
        return max(self.a.step, self.b.step)

    @cached_property
    def peaks(self) -> list[tuple[float, float]]:
        """Shifts at the center and scores of the curve's peaks; the fit's own first."""
        if self.fit is None:
            return []
        found = [(self._shift(lag), score) for lag, score in self.curve.peaks(4 * PEAKS)]
        here = [score for shift, score in found if self._near(shift)]
        others = [(shift, score) for shift, score in found if not self._near(shift)]
        own = here[0] if here else self._score(self.fit.shift)
        return [(self.fit.shift, own), *others[: PEAKS - 1]]

    @cached_property
    def margin(self) -> float:
        """Nats by which the residual is smaller than at any other peak, whatever the overlaps; negative where it is larger."""
        own, *others = self.misfits
        return own - max(others) if others else own

    @cached_property
    def misfits(self) -> list[float]:
        """Nats of every peak by its residual alone; of the best rivals, where each fits best between frames."""
        rough = [self.curve.misfit(self._lag(shift)) for shift, _ in self.peaks] or [0.0]
        if self.fit is None or len(rough) == 1:
            return rough
        descent = Descent(self.a, self.b, max(self.frame, self.step), rows=FEW_ROWS)
        steps = self.step * torch.linspace(-1, 1, FRACTIONS, dtype=torch.float64)
        level = max(self.curve.level, 1e-300)
        for k, (shift, _) in enumerate(self.peaks[: RIVALS + 1]):
            offset = shift - (self.fit.rate - 1) * self.fit.center
            found = [descent.variance(offset + float(step), self.fit.rate) for step in steps]
            # exact data: a step of the own peak is as far from its bottom as the nearest step of a rival's may be
            least = min(found) if k else min(found[FRACTIONS // 2 - 1], found[FRACTIONS // 2 + 1])
            rough[k] = -0.5 * math.log(max(least, 1e-300) / level)
        return rough

    @cached_property
    def halves(self) -> tuple[float, float]:
        """Shifts in which the first and the second half of the overlap are best, from the fit's, in frames; NaN where none."""
        return tuple(self._away(curve) for curve in self.half_curves)  # type: ignore[return-value]

    @cached_property
    def half_curves(self) -> list[Curve]:
        """Scores by a half of the overlap at a time."""
        assert self.fit is not None
        frames = float(self.a.times[0]) + self.step * torch.arange(len(self.samples.w1), dtype=torch.float64)
        early = (frames.to(self.samples.w1.device) < self.fit.center)[:, None]
        parts = torch.where(early, self.samples.w1, 0.0), torch.where(early, 0.0, self.samples.w1)
        return [epipolar_curve(dataclasses.replace(self.samples, w1=part), self.max_shift, HALF) for part in parts]

    @cached_property
    def agree(self) -> bool:
        """Whether both halves of the overlap say the same shift as the whole."""
        return self.fit is not None and all(abs(away) <= APART for away in self.halves)

    @cached_property
    def wander(self) -> float:
        """Residual of the whole over that of its halves by themselves: 1 where neither camera moves."""
        if self.fit is None:
            return 1.0
        place = int((self.curve.lags - self._lag(self.fit.shift)).abs().argmin())
        whole = float(self.curve.variance[place])
        parts = [float(curve.variance[place]) for curve in self.half_curves]
        mean = sum(parts) / 2
        return math.sqrt(whole / mean) if 0 < mean < math.inf else 1.0

    @cached_property
    def decided(self) -> bool:
        """Whether the shift is beyond doubt."""
        if self.fit is None or self.edge or self.fit.sigma > SHARP * self.frame:
            return False
        return self.margin >= self.needed and self.agree

    @property
    def needed(self) -> float:
        """Nats above the next peak: what affine cameras leave unexplained differs from period to period of a gait."""
        return MARGIN if self.method == "epipolar" else AFFINE_MARGIN

    @property
    def edge(self) -> bool:
        """Whether the best lies at the end of what was searched."""
        return self.fit is not None and self.max_shift is not None and abs(self.fit.shift) > self.max_shift - 0.5 * self.frame

    @property
    def confidence(self) -> float:
        """Probability that the shift is right to within a frame."""
        if self.fit is None:
            return 0.0
        own = math.erf(self.frame / max(math.sqrt(2) * self.fit.sigma, 1e-12))
        rival = 1 / (1 + math.exp(-(self.margin - 0.6 * self.needed) / 0.05)) if self.margin > -10 else 0.0
        return own * rival * (0.995 if self.agree else 0.3)

    def _shift(self, lag: float) -> float:
        """Of b's clock against a's at the center, of a lag of the curve."""
        assert self.fit is not None
        return self.curve.rate * (self.fit.center + lag) - self.fit.center

    def _lag(self, shift: float) -> float:
        """Of the curve, of a shift of b's clock against a's at the center."""
        assert self.fit is not None
        return (shift + self.fit.center) / self.curve.rate - self.fit.center

    def _near(self, shift: float) -> bool:
        assert self.fit is not None
        return abs(shift - self.fit.shift) <= max(APART * self.frame, 1.5 * self.step)

    def _score(self, shift: float) -> float:
        assert self.fit is not None
        return float(self.curve.scores[int((self.curve.lags - self._lag(shift)).abs().argmin())].nan_to_num(-math.inf))

    def _away(self, curve: Curve) -> float:
        """Frames from the fit's shift to this curve's best."""
        assert self.fit is not None
        best = curve.peaks(1)
        return (self._shift(best[0][0]) - self.fit.shift) / max(self.frame, self.step) if best else math.nan


def attempt(
    a: Tracks,
    b: Tracks,
    *,
    points: Tensor | None = None,
    step: float | None = None,
    rates: tuple[float, ...] = (1.0,),
    free_rate: bool = True,
    max_shift: float | None = None,
    method: str = "epipolar",
) -> Attempt:
    """Search all shifts at the given rates of b's clock, descend from the best, and settle the rate.

    Args:
        points: ``(n,)`` bool, who takes part; all by default.
        step: seconds per lag of the search; the slower camera's frame by default.
        rates: of b's clock, to search at.
        free_rate: whether the descent may change the rate.
        max_shift: seconds.
    """
    everyone = torch.ones(a.x.shape[1], dtype=torch.bool, device=a.x.device)
    points = everyone if points is None else points
    a, b = (a, b) if bool(points.all()) else (a.only(points), b.only(points))
    frame = max(a.step, b.step)
    step = max(frame, step or 0.0)
    searched = []
    for rate in rates:
        samples = Samples.of(a, b, step, rate)
        searched.append((samples, epipolar_curve(samples, max_shift)))
    fit = _best(a, b, [curve for _, curve in searched], step, frame, free_rate)
    samples, curve = min(searched, key=lambda found: abs(found[0].rate - (fit.rate if fit else 1.0)))
    if fit is not None and abs(fit.rate - samples.rate) * (float(a.times[-1]) - float(a.times[0])) > 0.25 * step:
        samples = Samples.of(a, b, step, fit.rate)
        curve = epipolar_curve(samples, max_shift)
    return Attempt(a, b, fit, curve, samples, step, max_shift, points, method)


def _best(a: Tracks, b: Tracks, curves: list[Curve], step: float, frame: float, free_rate: bool) -> Fit | None:
    """The likeliest minimum near the peaks of the curves."""
    starts = sorted(((score, lag, curve.rate) for curve in curves for lag, score in curve.peaks(PEAKS)), reverse=True)
    if not starts:
        return None
    apart = max(APART * frame, 1.5 * step)
    rivals = [
        start for start in starts if abs(start[1] * start[2] - starts[0][1] * starts[0][2]) > apart or start[2] != starts[0][2]
    ]
    several = len(curves) > 1 or not rivals or starts[0][0] - rivals[0][0] < CLEAR
    widths = [step]
    while widths[-1] > frame:
        widths.append(max(frame, widths[-1] / 3))
    coarse = Descent(a, b, widths[0])
    fits = []
    for _, lag, rate in starts[: PEAKS if several else 1]:
        fit = coarse.run(lag * rate, rate, free_rate=free_rate and len(widths) > 1)
        if fit is not None:
            fits.append(fit)
    if not fits:
        return None
    best = min(fits, key=lambda fit: math.log(max(fit.residual, 1e-300)) - 0.5 * math.log(fit.effective))
    for width in widths[1:]:
        best = Descent(a, b, width).run(best.offset, best.rate, free_rate=free_rate) or best
    if free_rate and float(best.times[-1] - best.times[0]) > DRIFTING:
        last = coarse if len(widths) == 1 else Descent(a, b, frame)
        best = _settled(last, best)
    return best


SIGNIFICANT = 3.0
"""Sigmas from 1 for a clock rate to be believed."""


FASTEST = 0.022
"""Clock rates off by more are none."""
NEGLIGIBLE = 0.1
"""Frames over the take that a rate must amount to."""


def _settled(descent: Descent, fit: Fit) -> Fit:
    """With its own rate where that differs from 1 beyond doubt, else with rate 1."""
    free = descent.run(fit.offset, fit.rate, free_rate=True)
    span = float(fit.times[-1] - fit.times[0])
    if free is not None and FASTEST > abs(free.rate - 1) > max(SIGNIFICANT * free.rate_sigma, NEGLIGIBLE * descent.frame / span):
        return free
    fixed = descent.run(fit.shift, 1.0) if fit.rate != 1 else fit
    return fixed or fit
