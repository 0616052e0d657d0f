"""An attempt to synchronize corresponding points: what was found in one way, and what speaks for and against it."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Generator, Tensor

from dyntorch.tasks.synchronize.epipolar import EPIPOLAR, Curve, EpipolarFit, PairModel, Samples, epipolar_curve
from dyntorch.tasks.synchronize.options import SynchronizeOptions
from dyntorch.tasks.synchronize.tracks import Tracks, image_of


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
    options: SynchronizeOptions
    pruned: bool = False  # whether positions that did not fit were left out
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
        found = [(self._shift(lag), score) for lag, score in self.curve.peaks(4 * self.options.evidence.peaks)]
        here = [score for shift, score in found if self._near(shift)]
        own = here[0] if here else self._score(self.fit.shift)
        # a higher maximum of the curve that a descent found no better is none
        others = [(shift, min(score, own)) for shift, score in found if not self._near(shift)]
        return [(self.fit.shift, own), *others[: self.options.evidence.peaks - 1]]

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
        descent = self.model.descent(self.a, self.b, width, rows=self.options.evidence.rows, options=self.options)
        steps = self.step * torch.linspace(-1, 1, self.options.evidence.fractions, dtype=torch.float64)
        level = max(self.curve.level, 1e-300)
        for k, (shift, _) in enumerate(self.peaks[: self.options.evidence.rivals + 1]):
            offset = shift - (self.fit.rate - 1) * self.fit.center
            found = [descent.variance(offset + float(step), self.fit.rate) for step in steps]
            # exact data: a step of the own peak is as far from its bottom as the nearest step of a rival's may be
            least = (
                min(found)
                if k
                else min(found[self.options.evidence.fractions // 2 - 1], found[self.options.evidence.fractions // 2 + 1])
            )
            rough[k] = -0.5 * math.log(max(least, 1e-300) / level)
        return rough

    @cached_property
    def forward(self) -> float:
        r"""Nats by which the residual is smaller than with b played backwards, at whatever shift."""
        if self.fit is None:
            return 0.0
        backwards = dataclasses.replace(self.samples, x2=self.samples.x2.flip(0), w2=self.samples.w2.flip(0))
        curve = epipolar_curve(backwards, self.max_shift, options=self.options)
        judged = curve.scores.isfinite()
        if not bool(judged.any()) or not self.misfits:
            return 0.0
        tiny = 1e-300
        own = self.misfits[0] - 0.5 * math.log(max(self.curve.level, tiny))
        return own + 0.5 * math.log(max(float(curve.variance[judged].min()), tiny))

    @property
    def needed_forward(self) -> float:
        """The same for a decision: more where something may have been made to fit."""
        return self.options.evidence.forward + self.options.evidence.forward_doubtful * self.doubtful

    @cached_property
    def halves(self) -> tuple[float, float]:
        """Shifts in which the first and the second half of the overlap are best, from the fit's, in frames; NaN where none."""
        return tuple(self._away(curve) for curve in self.half_curves)  # type: ignore[return-value]

    @property
    def sigma(self) -> float:
        """Of the shift, seconds: the fit's, and what the halves of the take differ by, which sees errors as slow as a
        detector's."""
        if self.fit is None:
            return math.inf
        first, second = self.halves
        differing = abs(first - second) / 2 * self.frame if self.agree and self.step <= self.frame else 0.0
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
            epipolar_curve(
                dataclasses.replace(self.samples, w1=part), self.max_shift, self.options.evidence.half_overlap, options=self.options
            )
            for part in parts
        ]

    @cached_property
    def agree(self) -> bool:
        """Whether both halves of the overlap say the same shift as the whole."""
        return self.fit is not None and self.apart == 0

    @cached_property
    def apart(self) -> float:
        """Frames by which halves of the overlap may differ from the whole, where one does by more, or both do to the same side; 0
        where they agree."""
        first, second = self.halves
        evidence = self.options.evidence
        if not (abs(first) <= evidence.apart and abs(second) <= evidence.apart):
            return evidence.apart
        leaning = first * second > 0 and min(abs(first), abs(second)) > evidence.leaning
        return evidence.leaning if leaning else 0.0

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
        sure = self.fit is not None and self.sharp and not self.edge and self.margin >= self.needed and self.agree
        return sure and self.forward >= self.needed_forward

    @property
    def sharp(self) -> bool:
        """Whether the shift is known well enough to trust its sigma."""
        return self.fit is not None and self.fit.sigma <= self.options.evidence.sharp * max(
            self.frame, self.options.evidence.shortest_frame
        )

    @property
    def needed(self) -> float:
        """Nats above the next peak, for a decision."""
        evidence = self.options.evidence
        affine = self.method == "affine"
        least = evidence.affine_margin if affine else evidence.margin
        if affine or self.doubtful == 0:
            # with a residual far above the noise something may have been made to fit, the more so by leaving out what does not
            usual = evidence.usual_roughness_pruned if self.chosen else evidence.usual_roughness_clear
            rough = math.log(max(self.roughness, 1e-300) / usual)
            return least + evidence.rough_margin * min(max(rough, 0.0), 1.0) + evidence.short_margin * self.short
        return least + evidence.rough_margin * self.doubtful + evidence.short_margin * self.short

    @property
    def short(self) -> float:
        """0 to 1: how much shorter than the longest overlap it is, where points were left out: so little fits easily."""
        assert self.fit is not None
        counts = self.curve.counts
        if not self.chosen or not len(counts):
            return 0.0
        place = int((self.curve.lags - self._lag(self.fit.shift)).abs().argmin())
        share = float(counts[place] / counts.max().clamp(min=1e-300))
        evidence = self.options.evidence
        return min(max((evidence.short_overlap - share) / (0.5 * evidence.short_overlap), 0.0), 1.0)

    @property
    def chosen(self) -> bool:
        """Whether points or positions that did not fit were left out."""
        return self.pruned or not bool(self.points.all())

    @property
    def doubtful(self) -> float:
        """0 where all points fit as well as their noise lets them; 1 where something may have been made to fit."""
        evidence = self.options.evidence
        rough = math.log(max(self.roughness, 1e-300) / evidence.usual_roughness)
        if not self.chosen and rough <= 0:
            return 0.0
        own, *others = (score for _, score in self.peaks)
        alone = own - max(others, default=-math.inf) >= evidence.score_clear
        if self.short == 0 and (alone or self.forward >= evidence.forward_clear):
            return 0.0
        return 1.0 if self.chosen else min(rough / evidence.rough_growth, 1.0)

    @property
    def roughness(self) -> float:
        """Residual over what white noise and the smoothing kernel leave of it."""
        assert self.fit is not None
        left = math.sqrt(0.5 / math.sqrt(math.pi))  # by a Gaussian kernel of one frame
        image = image_of(self.a, self.b)
        return self.fit.residual / (left * max(image.noise, 1e-6 * image.scale))

    @property
    def edge(self) -> bool:
        """Whether the best lies at the end of what was searched."""
        return self.fit is not None and self.max_shift is not None and abs(self.fit.shift) > self.max_shift - 0.5 * self.frame

    @property
    def confidence(self) -> float:
        """Probability that the shift is right to within a frame."""
        if self.fit is None:
            return 0.0
        own = math.erf(self.frame / max(math.sqrt(2) * self.sigma, 1e-12))
        rival = (
            1
            / (1 + math.exp(-(self.margin - self.options.evidence.even_margin * self.needed) / self.options.evidence.margin_scale))
            if self.margin > self.options.evidence.hopeless_margin
            else 0.0
        )
        return (
            own
            * rival
            * self._forward_share
            * (self.options.evidence.agreeing if self.agree else self.options.evidence.disagreeing)
            * (1.0 if self.sharp and not self.edge else self.options.evidence.blurred)
        )

    @property
    def _forward_share(self) -> float:
        """Odds of a film that runs forwards, as a factor of the confidence; where the rest is hopeless that is not looked at."""
        evidence = self.options.evidence
        if self.margin < evidence.even_margin * self.needed:
            return 1.0
        return 1 / (1 + math.exp(-min((self.forward - self.needed_forward) / evidence.forward_scale, 700.0)))

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
        return abs(shift - self.fit.shift) <= max(self.options.evidence.apart * self.frame, 1.5 * self.step)

    def _score(self, shift: float) -> float:
        assert self.fit is not None
        return float(self.curve.scores[int((self.curve.lags - self._lag(shift)).abs().argmin())].nan_to_num(-math.inf))

    def _away(self, curve: Curve) -> float:
        """Frames from the fit's shift to this curve's best."""
        assert self.fit is not None
        best = curve.peaks(1)
        return (self._shift(best[0][0]) - self.fit.shift) / max(self.frame, self.step) if best else math.nan


# ----------------------------------------------------------------------------------------------------------------------
# Which points are the same in both cameras: subsets vote, each at the shift it likes best.


def consistent_points(
    a: Tracks, b: Tracks, found: Attempt, generator: Generator | None, options: SynchronizeOptions
) -> Tensor | None:
    """Points ``(n,)`` bool whose epipolar residual agrees with the others' at one and the same shift; None where there are too
    few."""
    n = a.x.shape[1]
    lo, hi = found.samples.lags(found.max_shift)
    if n < options.points.fewest or lo > hi:
        return None
    step = found.step * max(1, -(-(hi - lo) // options.points.most_lags))
    samples = found.model.samples.of(a, b, step, found.samples.rate, options=options)
    moments, counts = samples.moments(samples.lags(found.max_shift), per_point=True)
    total = counts.sum(0)
    judged = (total >= options.curve.least_overlap * total.max()) & (total >= options.curve.fewest_pairs)
    if not bool(judged.any()):
        return None
    moments, counts = moments[:, judged], counts[:, judged]
    generator = generator or torch.Generator().manual_seed(0)
    best: tuple[float, Tensor] | None = None
    for _ in range(options.points.subsets):
        chosen = torch.randperm(n, generator=generator)[: options.points.subset].to(moments.device)
        variance, geometry = samples.solved(moments[chosen].sum(0))
        lag = int((variance / counts[chosen].sum(0).clamp(min=1).sqrt()).argmin())
        each = samples.variances_by(geometry[lag], moments[:, lag])
        cost = float(each.nanquantile(options.points.share))
        if best is None or cost < best[0]:
            best = cost, each
    assert best is not None
    each = best[1]
    level = each[each <= best[0]].median()
    kept = ~(each > options.points.wrong**2 * level)
    return kept if int(kept.sum()) >= options.points.share * n else None
