"""The lag between two cameras that track different points, between frames, with what speaks against it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.tasks.sync_subspace import SubspaceCurve
from dyntorch.tasks.sync_subspace_body import STEP
from dyntorch.tasks.sync_subspace_doubt import resemblance, wobble

PEAKS = 6
"""Local maxima that are returned."""
APART = 0.1
"""Seconds within which peaks are one."""
SURE = 0.95
"""Posterior of the best peak for a decision."""
CLEAR = 7.0
"""Nats above the next peak at an equal overlap for a decision.  Motion that repeats itself exactly: 98 of 100 gaits stay below 3,
sums of harmonics reach 13, so this alone is not enough."""
TELLING = 1.5
"""Nats per second below which nothing is shared."""
SHARP = 0.6
"""Frames: a larger sigma decides nothing.  (.7 keeps 4 percent more of motion capture, and twice the wrong ones of a detector.)"""
ALONE = 0.7
"""Share of its score by which a peak is above the next, from which the motion is not compared with itself: of 425 exactly periodic
motions all stay below .6."""
REPEATED = 0.68
"""Resemblance of the motion to itself from which a peak may be another period."""
BENT = 1.5
"""Variance about straight lines at constant velocity over that of the noise, of either camera, below which only such lines are
seen: 1.0 to 1.1 where they are, 16 and more for bodies that bend and turn, at 6 px of noise.  The growing size of the whole bends
them alike at every shift."""
BLUR = 1 / 150
"""Seconds that the peak is off even where it is sharp, because cameras are not affine."""


@dataclass(frozen=True, eq=False)
class SubspaceShift:
    """Which frame of b goes with which of a.

    Attributes:
        position: frames: frame i of a is at i + position of b; 0 where nothing could be judged.
        sigma: its standard deviation if the peak is the right one, frames.
        peaks: ``(k, 2)`` position and score of local maxima, best first.
        probability: that the position is right to within a frame.
        margin: nats per frame over the next peak, times the frames that overlap at the best: periodic motion has none.
        ok: whether the data decide.
        reason: why not, and what to do; empty where ``ok``.
    """

    position: float
    sigma: float
    peaks: Tensor
    probability: float
    margin: float
    ok: bool
    reason: str


def subspace_shift(curve: SubspaceCurve, *, start: float = 0.0, step: float = STEP) -> SubspaceShift:
    r"""The best lag of a curve, by the parabola through its highest three scores, and whether to believe it.

    The scores are logarithms of a posterior over lags, up to a constant: the probability is the share of the peak.  A score grows
    with the overlap, which for a motion that repeats itself is no evidence for the lag of the longest overlap.  So peaks are also
    compared by what they tell per frame, and the lower of both probabilities holds.

    Args:
        curve: of :func:`dyntorch.tasks.sync_subspace.subspace_curve`.
        start: seconds that b is ahead of a at lag 0, for the reasons that are told.
        step: seconds from frame to frame.

    Returns:
        The shift; refused where no lag was judged, where the motion is below the noise, or where other lags fit as well.

    Example:
        >>> import torch
        >>> lags = torch.arange(-30.0, 31.0).double()
        >>> scores, count = 40 - 3 * (lags - 4.25) ** 2, torch.full((61,), 90.0)
        >>> shift = subspace_shift(SubspaceCurve(lags, scores, count, scores / 90, scores / 90, scores / 90, (8.0, 8.0)))
        >>> round(shift.position, 2), shift.ok
        (4.25, True)
    """
    judged = curve.scores.isfinite()
    if int(judged.sum()) < 3:
        return _refused(curve, "the cameras overlap too little to judge any shift: film longer, or give a larger max_shift")
    scores = curve.scores.nan_to_num(-math.inf)
    top = _maxima(scores, APART / step)
    positions = [_between(scores, i) for i in top[:PEAKS]]
    places = torch.tensor([p for p, _ in positions], dtype=scores.dtype, device=scores.device)
    peaks = torch.stack([curve.lags[0] + places, scores[top[:PEAKS]]], dim=1)
    best = top[0]
    probability, margin = _probability(scores, best), _margin(curve, best, APART / step)
    probability = min(probability, 1 / (1 + math.exp(-max(min(margin, 700.0), -700.0))))
    position = float(peaks[0, 0])
    sigma = math.hypot(BLUR / step, max(positions[0][1], wobble(curve, round(position))))
    times = start + step * peaks[1:4, 0]
    reason = _reason(curve, best, probability, margin, times, step)
    if not reason and margin < ALONE * float(scores[best]) and resemblance(curve, best, APART / step) > REPEATED:
        reason = "the motion repeats itself, and another shift fits as well: film something that does not"
    if not reason and sigma > SHARP:
        known = f"to {sigma * step:.3f} s" if math.isfinite(sigma) else "roughly"
        reason = f"the best shift is only known {known}: film longer, or a larger motion"
    return SubspaceShift(position, sigma, peaks, probability, margin, not reason, reason)


def _maxima(scores: Tensor, apart: float) -> list[int]:
    """Local maxima, best first, none within so many frames of a better one."""
    padded = torch.nn.functional.pad(scores, (1, 1), value=-math.inf)
    top = ((scores >= padded[:-2]) & (scores >= padded[2:]) & scores.isfinite()).nonzero()[:, 0]
    kept: list[int] = []
    for i in top[scores[top].argsort(descending=True)].tolist():
        if all(abs(i - j) > apart + 1e-9 for j in kept):
            kept.append(i)
        if len(kept) > 4 * PEAKS:
            break
    return kept


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
    others = [i for i in _maxima(rates, apart) if abs(i - best) > apart + 1e-9]
    return float((rates[best] - rates[others[0]]) * curve.counts[best]) if others else float(curve.scores[best])


def _reason(curve: SubspaceCurve, best: int, probability: float, margin: float, times: Tensor, step: float) -> str:
    """Why the data do not decide; empty where they do."""
    if min(curve.signal) < 1 or float(curve.rates[best]) < TELLING * step:
        return "the motion is too small against the noise, or the cameras do not show the same event: film a larger motion"
    if curve.bodies is not None and min(body.bend for body in curve.bodies) < BENT:
        return "all points move on straight lines at constant velocity, as at any other shift: film a motion that turns or stops"
    if probability >= SURE and margin >= CLEAR:
        return ""
    others = ", ".join(f"{time:+.2f}" for time in times.tolist())
    if margin < CLEAR:
        return (
            f"other shifts fit about as well (seconds: {others}), as where the motion repeats itself: film something that does not"
        )
    return f"the best shift is not clear of others (seconds: {others}): film longer, or a larger motion"


def _refused(curve: SubspaceCurve, reason: str) -> SubspaceShift:
    return SubspaceShift(0.0, math.inf, curve.scores.new_zeros(0, 2), 0.0, 0.0, False, reason)
