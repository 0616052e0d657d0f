"""An attempt to synchronize corresponding points: what was found in one way, and what speaks for and against it."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Generator, Tensor

from dyntorch.tasks.synchronize.epipolar import (
    EPIPOLAR,
    MIN_CURVE_PAIRS,
    MIN_HALF_OVERLAP_SHARE,
    MIN_OVERLAP_SHARE,
    MIN_PEAK_SEPARATION_FRAMES,
    Curve,
    EpipolarFit,
    PairModel,
    Samples,
    epipolar_curve,
)
from dyntorch.tasks.synchronize.tracks import Tracks, image_of

NUM_PEAKS = 6  # Local maxima of the curve from which a descent may start.
NUM_COMPARED_ROWS = 3_000  # Residuals that are enough to compare peaks.
# Margin of affine cameras over that of perspective ones: their misfit differs from period to period of a gait.
AFFINE_MARGIN_FACTOR = 2.5
# Extra nats where outliers were removed or the residual is far above the noise (two walks of one person led by .53).
ROUGH_MARGIN = 0.5
USUAL_ROUGHNESS = 1.25  # Usual residual over the noise: .9 to 1.2 on virtual cameras.
ROUGHNESS_LOG_RANGE = 0.25  # Logarithm of the residual over the usual one at which all of that margin is needed.
USUAL_ROUGHNESS_CLEAR = 4.0  # Usual residual of affine cameras, and where the time-reversed video fits far worse.
USUAL_ROUGHNESS_WITHOUT_OUTLIERS = 2.0  # The same where outliers were removed.
# Extra nats where outliers were removed from an overlap of half SHORT_OVERLAP_SHARE (false fits led by up to 1.1).
SHORT_OVERLAP_MARGIN = 0.6
SHORT_OVERLAP_SHARE = 0.5  # Share of the longest overlap below which it is short.
# Nats against the time-reversed video: false pairs -.9 to -1.9, good ones -.1 to 2.7 (experiments.synchronization.silent).
MIN_FORWARD_MARGIN = -0.35
DOUBTFUL_FORWARD_MARGIN = 0.55  # Extra nats of it where the fit is doubtful.
CLEAR_FORWARD_MARGIN = 0.6  # Nats of it from which removed outliers are no reason for doubt (false fits had .2 and less).
CLEAR_SCORE_MARGIN = 0.9  # Score above every other peak from which they are not, either (false fits had .3 and less).
FORWARD_SCALE = 0.04  # Nats of it per unit of the log odds of the confidence.
# Frames by which both halves may differ from the whole to the same side (good pairs .3; mirrored video 1.5).
MAX_COMMON_HALF_SHIFT_FRAMES = 0.8
NUM_COMPETING_PEAKS = 3  # Other peaks that are compared between frames.
NUM_FRACTIONS = 5  # Places within a step of a peak at which it is compared.
MAX_SIGMA_FRAMES = 0.25  # Sigma above which a shift decides nothing, frames: with motion near the noise it is a lower bound.
MIN_FRAME_SECONDS = 1 / 30  # Duration that a frame counts for at least in it.
EVEN_MARGIN = 0.6  # Margin over the required one at which right and wrong are as likely; set by hand, tests of refusals hold it.
MARGIN_SCALE = 0.05  # Nats of margin per unit of those log odds.
HOPELESS_MARGIN = -10  # Margin below which the confidence is 0, nats.
CONFIDENCE_AGREEING_HALVES = 0.995  # Confidence of a shift on which both halves agree, all else being certain.
CONFIDENCE_DISAGREEING_HALVES = 0.3  # The same where they do not.
IMPRECISE_CONFIDENCE_FACTOR = 0.5  # Factor of the confidence of an imprecise shift, or one at the end of the search.


@dataclass(frozen=True, eq=False)
class Attempt:
    """The best shift found in one way, with its evidence."""

    a: Tracks  # the tracks it was found with
    b: Tracks
    fit: EpipolarFit | None  # the best minimum, None where there is none
    curve: Curve  # scores at the fit's rate
    samples: Samples
    step: float  # seconds per lag
    max_shift: float | None  # of the search, seconds
    points: Tensor  # ``(n,)`` bool, who takes part
    method: str  # ``"epipolar"`` or ``"affine"``
    min_margin: float  # nats for a decision, of perspective cameras
    positions_removed: bool = False  # whether positions that did not fit were left out
    model: PairModel = EPIPOLAR  # what is compared

    @property
    def frame(self) -> float:
        """Seconds of the slower camera's frame."""
        return max(self.a.step, self.b.step)

    @cached_property
    def peaks(self) -> list[tuple[float, float]]:
        """Shifts at the center and scores of the curve's peaks; the fit's own first."""
        if self.fit is None:
            return []
        maxima = [(self._shift(lag), score) for lag, score in self.curve.peaks(4 * NUM_PEAKS)]
        here = [score for shift, score in maxima if self._is_own_peak(shift)]
        own = here[0] if here else self._score(self.fit.shift)
        # a higher maximum of the curve that a descent found no better is none
        others = [(shift, min(score, own)) for shift, score in maxima if not self._is_own_peak(shift)]
        return [(self.fit.shift, own), *others[: NUM_PEAKS - 1]]

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
        width = max(self.frame, self.step)
        descent = self.model.descent(self.a, self.b, width, rows=NUM_COMPARED_ROWS)
        steps = (self.step * torch.linspace(-1, 1, NUM_FRACTIONS, dtype=torch.float64)).tolist()
        level = max(self.curve.level, 1e-300)
        for k, (shift, _) in enumerate(self.peaks[: NUM_COMPETING_PEAKS + 1]):
            offset = shift - (self.fit.rate - 1) * self.fit.center
            variances = descent.variances([offset + step for step in steps], self.fit.rate)
            # exact data: a step of the own peak is as far from its bottom as the nearest step of a rival's may be
            least = min(variances) if k else min(variances[NUM_FRACTIONS // 2 - 1], variances[NUM_FRACTIONS // 2 + 1])
            rough[k] = -0.5 * math.log(max(least, 1e-300) / level)
        return rough

    @cached_property
    def time_reversal_margin(self) -> float:
        r"""Nats by which the residual is smaller than with b played backwards, at whatever shift."""
        if self.fit is None:
            return 0.0
        backwards = dataclasses.replace(self.samples, x2=self.samples.x2.flip(0), w2=self.samples.w2.flip(0))
        curve = epipolar_curve(backwards, self.max_shift)
        judged = curve.scores.isfinite()
        if not bool(judged.any()) or not self.misfits:
            return 0.0
        tiny = 1e-300
        own = self.misfits[0] - 0.5 * math.log(max(self.curve.level, tiny))
        return own + 0.5 * math.log(max(float(curve.variance[judged].min()), tiny))

    @property
    def required_time_reversal_margin(self) -> float:
        """The same for a decision: more where something may have been made to fit."""
        return MIN_FORWARD_MARGIN + DOUBTFUL_FORWARD_MARGIN * self.doubt

    @cached_property
    def halves(self) -> tuple[float, float]:
        """Shifts in which the first and the second half of the overlap are best, from the fit's, in frames; NaN where none."""
        return tuple(self._distance_to_best(curve) for curve in self.half_curves)  # type: ignore[return-value]

    @property
    def sigma(self) -> float:
        """Of the shift, seconds: the fit's, and what the halves of the take differ by, which sees errors as slow as a
        detector's."""
        if self.fit is None:
            return math.inf
        first, second = self.halves
        differing = abs(first - second) / 2 * self.frame if self.halves_agree and self.step <= self.frame else 0.0
        # as much is expected; short halves may differ by more than the whole is uncertain
        beyond = math.sqrt(max(differing**2 - self.fit.sigma**2, 0.0))
        return math.hypot(self.fit.sigma, min(beyond, 3 * self.fit.sigma))

    @cached_property
    def half_curves(self) -> list[Curve]:
        """Scores by a half of the overlap at a time."""
        assert self.fit is not None
        w1 = self.samples.w1
        times = float(self.a.times[0]) + self.step * torch.arange(len(w1), dtype=torch.float64, device=w1.device)
        there = times * self.fit.rate + self.fit.offset
        # what only a shows would have its largest overlap at another shift
        shared = (there >= float(self.b.times[0]) - self.step) & (there <= float(self.b.times[-1]) + self.step)
        early = times < self.fit.center
        parts = [torch.where((shared & part)[:, None], w1, 0.0) for part in (early, ~early)]
        return [
            epipolar_curve(dataclasses.replace(self.samples, w1=part), self.max_shift, MIN_HALF_OVERLAP_SHARE) for part in parts
        ]

    @cached_property
    def halves_agree(self) -> bool:
        """Whether both halves of the overlap say the same shift as the whole."""
        return self.fit is not None and self.half_disagreement == 0

    @cached_property
    def half_disagreement(self) -> float:
        """Frames by which halves of the overlap may differ from the whole, where one does by more, or both do to the same side; 0
        where they agree."""
        first, second = self.halves
        if not (abs(first) <= MIN_PEAK_SEPARATION_FRAMES and abs(second) <= MIN_PEAK_SEPARATION_FRAMES):
            return MIN_PEAK_SEPARATION_FRAMES
        leaning = first * second > 0 and min(abs(first), abs(second)) > MAX_COMMON_HALF_SHIFT_FRAMES
        return MAX_COMMON_HALF_SHIFT_FRAMES if leaning else 0.0

    @cached_property
    def camera_motion_ratio(self) -> float:
        """Residual of the whole over that of its halves by themselves: 1 where neither camera moves."""
        if self.fit is None:
            return 1.0
        place = int((self.curve.lags - self._lag(self.fit.shift)).abs().argmin())
        whole = float(self.curve.variance[place])
        parts = [float(curve.variance[place]) for curve in self.half_curves]
        mean = sum(parts) / 2
        return math.sqrt(whole / mean) if 0 < mean < math.inf else 1.0

    @cached_property
    def accepted_shift(self) -> bool:
        """Whether the shift is beyond doubt."""
        sure = (
            self.fit is not None
            and self.precise
            and not self.at_search_end
            and self.margin >= self.required_margin
            and self.halves_agree
        )
        return sure and self.time_reversal_margin >= self.required_time_reversal_margin

    @property
    def precise(self) -> bool:
        """Whether the shift is known well enough to trust its sigma."""
        return self.fit is not None and self.fit.sigma <= MAX_SIGMA_FRAMES * max(self.frame, MIN_FRAME_SECONDS)

    @property
    def required_margin(self) -> float:
        """Nats above the next peak, for a decision."""
        affine = self.method == "affine"
        least = AFFINE_MARGIN_FACTOR * self.min_margin if affine else self.min_margin
        if affine or self.doubt == 0:
            # with a residual far above the noise something may have been made to fit, the more so by leaving out what does not
            usual = USUAL_ROUGHNESS_WITHOUT_OUTLIERS if self.outliers_removed else USUAL_ROUGHNESS_CLEAR
            rough = math.log(max(self.normalized_residual, 1e-300) / usual)
            return least + ROUGH_MARGIN * min(max(rough, 0.0), 1.0) + SHORT_OVERLAP_MARGIN * self.overlap_shortage
        return least + ROUGH_MARGIN * self.doubt + SHORT_OVERLAP_MARGIN * self.overlap_shortage

    @property
    def overlap_shortage(self) -> float:
        """0 to 1: how much shorter than the longest overlap it is, where points were left out: so little fits easily."""
        assert self.fit is not None
        counts = self.curve.counts
        if not self.outliers_removed or not len(counts):
            return 0.0
        place = int((self.curve.lags - self._lag(self.fit.shift)).abs().argmin())
        share = float(counts[place] / counts.max().clamp(min=1e-300))
        return min(max((SHORT_OVERLAP_SHARE - share) / (0.5 * SHORT_OVERLAP_SHARE), 0.0), 1.0)

    @property
    def outliers_removed(self) -> bool:
        """Whether points or positions that did not fit were left out."""
        return self.positions_removed or not bool(self.points.all())

    @property
    def doubt(self) -> float:
        """0 where all points fit as well as their noise lets them; 1 where something may have been made to fit."""
        rough = math.log(max(self.normalized_residual, 1e-300) / USUAL_ROUGHNESS)
        if not self.outliers_removed and rough <= 0:
            return 0.0
        own, *others = (score for _, score in self.peaks)
        alone = own - max(others, default=-math.inf) >= CLEAR_SCORE_MARGIN
        if self.overlap_shortage == 0 and (alone or self.time_reversal_margin >= CLEAR_FORWARD_MARGIN):
            return 0.0
        return 1.0 if self.outliers_removed else min(rough / ROUGHNESS_LOG_RANGE, 1.0)

    @property
    def normalized_residual(self) -> float:
        """Residual over what white noise and the smoothing kernel leave of it."""
        assert self.fit is not None
        left = math.sqrt(0.5 / math.sqrt(math.pi))  # by a Gaussian kernel of one frame
        image = image_of(self.a, self.b)
        return self.fit.residual / (left * max(image.noise, 1e-6 * image.scale))

    @property
    def at_search_end(self) -> bool:
        """Whether the best lies at the end of what was searched."""
        return self.fit is not None and self.max_shift is not None and abs(self.fit.shift) > self.max_shift - 0.5 * self.frame

    @property
    def confidence(self) -> float:
        """Probability that the shift is right to within a frame."""
        if self.fit is None:
            return 0.0
        own = math.erf(self.frame / max(math.sqrt(2) * self.sigma, 1e-12))
        rival = (
            1 / (1 + math.exp(-(self.margin - EVEN_MARGIN * self.required_margin) / MARGIN_SCALE))
            if self.margin > HOPELESS_MARGIN
            else 0.0
        )
        return (
            own
            * rival
            * self._time_reversal_factor
            * (CONFIDENCE_AGREEING_HALVES if self.halves_agree else CONFIDENCE_DISAGREEING_HALVES)
            * (1.0 if self.precise and not self.at_search_end else IMPRECISE_CONFIDENCE_FACTOR)
        )

    @property
    def _time_reversal_factor(self) -> float:
        """Odds of a film that runs forwards, as a factor of the confidence; where the rest is hopeless that is not looked at."""
        if self.margin < EVEN_MARGIN * self.required_margin:
            return 1.0
        return 1 / (1 + math.exp(-min((self.time_reversal_margin - self.required_time_reversal_margin) / FORWARD_SCALE, 700.0)))

    def _shift(self, lag: float) -> float:
        """Of b's clock against a's at the center, of a lag of the curve."""
        assert self.fit is not None
        return self.curve.rate * (self.fit.center + lag) - self.fit.center

    def _lag(self, shift: float) -> float:
        """Of the curve, of a shift of b's clock against a's at the center."""
        assert self.fit is not None
        return (shift + self.fit.center) / self.curve.rate - self.fit.center

    def _is_own_peak(self, shift: float) -> bool:
        assert self.fit is not None
        return abs(shift - self.fit.shift) <= max(MIN_PEAK_SEPARATION_FRAMES * self.frame, 1.5 * self.step)

    def _score(self, shift: float) -> float:
        assert self.fit is not None
        return float(self.curve.scores[int((self.curve.lags - self._lag(shift)).abs().argmin())].nan_to_num(-math.inf))

    def _distance_to_best(self, curve: Curve) -> float:
        """Frames from the fit's shift to this curve's best."""
        assert self.fit is not None
        best = curve.peaks(1)
        return (self._shift(best[0][0]) - self.fit.shift) / max(self.frame, self.step) if best else math.nan


# ----------------------------------------------------------------------------------------------------------------------
# Which points are the same in both cameras: subsets vote, each at the shift it likes best.


SUBSET_SIZE = 6  # Points of a subset.
NUM_SUBSETS = 60  # Subsets: one of 6 without 4 outliers of 17 is drawn in all but 1 of 10,000 trials.
SUBSETS_AT_ONCE = 12  # of these at all lags: 6 MB of moments at most
MIN_INLIER_SHARE = 0.7  # Share of the points that have to fit.
MAX_RESIDUAL_RATIO = 3.0  # Residual over the median one of inliers beyond which a point is an outlier.
MIN_POINTS_FOR_REJECTION = 8  # Points below which none can be rejected.
MAX_SUBSET_LAGS = 800  # Lags of that search; longer ones go in coarser steps.


def consistent_points(a: Tracks, b: Tracks, attempt: Attempt, generator: Generator | None = None) -> Tensor | None:
    """Points ``(n,)`` bool whose epipolar residual agrees with the others' at one and the same shift; None where there are too
    few."""
    n = a.x.shape[1]
    lo, hi = attempt.samples.lags(attempt.max_shift)
    if n < MIN_POINTS_FOR_REJECTION or lo > hi:
        return None
    step = attempt.step * max(1, -(-(hi - lo) // MAX_SUBSET_LAGS))
    samples = attempt.model.samples.of(a, b, step, attempt.samples.rate)
    moments, counts = samples.moments(samples.lags(attempt.max_shift), per_point=True)
    total = counts.sum(0)
    judged = (total >= MIN_OVERLAP_SHARE * total.max()) & (total >= MIN_CURVE_PAIRS)
    if not bool(judged.any()):
        return None
    moments, counts = moments[:, judged], counts[:, judged]
    generator = generator or torch.Generator().manual_seed(0)
    best: tuple[float, Tensor] | None = None
    subsets = torch.stack([torch.randperm(n, generator=generator)[:SUBSET_SIZE] for _ in range(NUM_SUBSETS)]).to(moments.device)
    for chosen in subsets.split(SUBSETS_AT_ONCE):
        member = moments.new_zeros(len(chosen), n).scatter_(1, chosen, 1.0)
        together = (member @ moments.flatten(1)).unflatten(1, moments.shape[1:])
        variance, geometry = (part.unflatten(0, together.shape[:2]) for part in samples.solve(together.flatten(0, 1)))
        lags = (variance / (member @ counts.to(member)).clamp(min=1).sqrt()).argmin(-1).tolist()
        for subset, lag in enumerate(lags):
            each = samples.variances_by(geometry[subset, lag], moments[:, lag])
            cost = float(each.nanquantile(MIN_INLIER_SHARE))
            if best is None or cost < best[0]:
                best = cost, each
    assert best is not None
    each = best[1]
    level = each[each <= best[0]].median()
    consistent = ~(each > MAX_RESIDUAL_RATIO**2 * level)
    return consistent if int(consistent.sum()) >= MIN_INLIER_SHARE * n else None
