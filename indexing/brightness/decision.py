"""Whether the best lag may be believed: what else must hold besides being the best."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from indexing.brightness.curves import Curve, part_curve, score_curve
from indexing.brightness.evidence import evidence
from indexing.brightness.profile import whitened
from indexing.brightness.sampling import Sampled
from indexing.brightness.window_kernel import HALF, kernel_descriptors

LEAST = 0.35  # of the shorter take must overlap
KERNEL_LEAST = 0.3  # of its kernels
AGREE = 2  # frames: halves and kernel
APART = 8  # frames from the best beyond which another peak is another answer
SECOND = 0.8  # of the best score: a peak as high as this makes the motion periodic or the answer open
BACKWARDS = 0.95  # of the best score: b played backwards must do worse
LEAD = 30.0  # nats for doing better than b played backwards by 100 %
ENOUGH = 31.0
"""Nats: evidence of short windows, and the lead.  Training, 235 pairs of one event (213 best lags within 1 frame) and 1,175 of
unrelated or reversed takes: 67 right, 1 wrong (by 2 frames) and none of the unrelated pass; at 25: 84, 2 and 3."""
AGREED, OPEN = (16.5, 6.2), (23.3, 4.9)  # centre and scale of the logistic curve of confidence, on all these pairs


@dataclass(frozen=True)
class Verdict:
    """The curve, its best lag, and what speaks for and against it.

    Attributes:
        curve: scores of the profile, all lags.
        best: its best lag.
        halves: best lags of the two halves of the overlap.
        kernel: best lag of the thesis's window kernel; None where the overlap is too short for it.
        second: score of the next peak relative to the best.
        backwards: score of the best lag of b played backwards, relative.
        nats: evidence of short windows, profile and kernel.
    """

    curve: Curve
    best: int
    halves: tuple[int, int]
    kernel: int | None
    second: float
    backwards: float
    nats: float

    @property
    def weight(self) -> float:
        """Evidence with the lead over the reversed take, in nats; ENOUGH is enough."""
        return self.nats + LEAD * (1 - min(self.backwards, 2.0))

    @property
    def agreed(self) -> bool:
        """Whether halves and kernel agree with the best lag."""
        halves = all(abs(half - self.best) <= AGREE for half in self.halves)
        return halves and self.kernel is not None and abs(self.kernel - self.best) <= AGREE

    @property
    def confidence(self) -> float:
        """Probability that the best lag is right to within a frame."""
        centre, scale = AGREED if self.agreed and self.second <= SECOND else OPEN
        return 1 / (1 + math.exp(-max(-30.0, min(30.0, (self.weight - centre) / scale))))

    def reason(self, rate: float) -> str:
        """Why the best lag is not to be believed; empty where it is."""
        if self.second > SECOND:
            return (
                f"another shift fits nearly as well ({100 * self.second:.0f} % of the best score): the motion repeats, or there is "
                "too little of it; film longer and less regular motion, or give max_shift"
            )
        if max(self.halves) - min(self.halves) > AGREE or any(abs(half - self.best) > AGREE for half in self.halves):
            first, second = ((half - self.best) / rate for half in self.halves)
            return (
                f"the halves of the overlap disagree with the whole (by {first:+.2f} and {second:+.2f} s): do both videos show "
                "the same event? Use a longer overlap, or keypoints"
            )
        if self.kernel is None or abs(self.kernel - self.best) > AGREE:
            said = "has too few frames" if self.kernel is None else f"says {(self.kernel - self.best) / rate:+.2f} s from it"
            return f"the window kernel {said}, so the best shift is not confirmed; use a longer overlap, or keypoints"
        if self.backwards > BACKWARDS:
            return "b fits as well when played backwards: the motion is symmetric in time, or of another time; use keypoints"
        if self.weight < ENOUGH:
            return (
                f"too little evidence ({self.weight:.0f} of {ENOUGH:.0f}): similar motion of another time would fit about as well; "
                "use a longer overlap, or keypoints"
            )
        return ""


def judge(a: Sampled, b: Sampled, lags: tuple[int, int], least: float) -> Verdict:
    """The best lag of two takes between ``lags``, with at least ``least`` frames of overlap, and what else speaks for it."""
    one, two = whitened(a.profile, b.profile)
    curve = score_curve(one, two, least).within(*lags)
    if not bool(curve.scores.isfinite().any()):  # nothing moves in one of them
        nowhere = max(lags[0], min(0, lags[1]))
        return Verdict(curve, nowhere, (nowhere, nowhere), None, 1.0, 1.0, 0.0)
    best = curve.best
    others = [float(curve.scores[k]) for k in curve.peaks(APART // 2) if abs(int(curve.lags[k]) - best) > APART]
    top = max(curve.at(best), 1e-9)
    kernel, nats = _kernel_opinion(a, b, lags, best)
    back = score_curve(*whitened(a.profile, b.backwards().profile), least)
    return Verdict(
        curve=curve,
        best=best,
        halves=_halves(one, two, best, lags),
        kernel=kernel,
        second=max([*others, 0.0]) / top,
        backwards=float(back.scores.max()) / top,
        nats=evidence(one, two, best) + nats,
    )


def _halves(one: torch.Tensor, two: torch.Tensor, best: int, lags: tuple[int, int]) -> tuple[int, int]:
    low, high = max(0, -best), min(len(one), len(two) - best)
    middle = (low + high) // 2
    first, second = (part_curve(one, two, rows).within(*lags).best for rows in (slice(low, middle), slice(middle, high)))
    return first, second


def _kernel_opinion(a: Sampled, b: Sampled, lags: tuple[int, int], best: int) -> tuple[int | None, float]:
    """Best lag of the window kernels, and the evidence of their windows for ``best``."""
    shorter = min(len(a.kernels), len(b.kernels))
    if shorter < HALF or not all(bool(x.kernels.isfinite().all(-1).all(-1).any()) for x in (a, b)):
        return None, 0.0
    one, two = kernel_descriptors(a.kernels, b.kernels)
    curve = score_curve(one, two, KERNEL_LEAST * shorter).within(*lags)
    found = curve.best if bool(curve.scores.isfinite().any()) else None
    overlap = min(len(one), len(two) - best) - max(0, -best)
    return found, evidence(one, two, best) if overlap >= 5 else 0.0
