"""Two videos of one event, no tracks: which moment of one is which of the other, from brightness alone."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import max_pool1d

from dyntorch import Shift, Status
from dyntorch.core import Notice, NoticeCode, status_from
from dyntorch.numerics import Message, on_cpu, one_thread
from indexing.sync.brightness_features import (
    KERNEL_HALF_FRAMES,
    MIN_FRAMES,
    GrayVideo,
    Region,
    Sampled,
    boxes,
    common_rate,
    kernel_descriptors,
    motion,
    read_gray_video,
    sample,
    whiten,
)
from indexing.sync.recordings import MEASURES, Measure


class BrightnessNotice(NoticeCode):
    """Why the brightness of two videos does not decide, or what to know besides."""

    FLICKER = (
        "flicker",
        "all of {camera:{which}} changes: its camera moves fast, or the light flickers; stabilize the video first",
        Status.DEGENERATE,
    )
    """A picture that changes everywhere."""
    STILL = "still", "nothing moves in {camera:{which}}; choose a take with motion", Status.DEGENERATE
    """Nothing moves."""
    CAMERA_MOVES = (
        "camera_moves",
        "{camera:{which}}: the camera moves ({value:.1f} px per frame); its motion was taken out approximately",
    )
    """A camera that moves."""
    CROSSES = "crosses", "{camera:{which}}: motion crosses the image; a moving box follows it"
    """Motion across the image."""
    REPEATED = (
        "repeated",
        "another shift fits nearly as well ({value:.0f} % of the best score): the motion repeats, or there is too little of it; "
        "film "
        "longer and less regular motion, or give {arg:max_shift}",
        Status.AMBIGUOUS,
    )
    """Another shift fits as well."""
    HALVES = (
        "halves",
        "the halves of the overlap disagree with the whole (by {first:+.2f} and {second:+.2f} s): do both videos show the same "
        "event? "
        "Use a longer overlap, or keypoints",
        Status.NO_CONSENSUS,
    )
    """The two halves of the overlap contradict the whole."""
    KERNEL = (
        "kernel",
        {
            "short": "the window kernel has too few frames, so the best shift is not confirmed; use a longer overlap, or keypoints",
            "apart": "the window kernel says {value:+.2f} s from it, so the best shift is not confirmed; use a longer overlap, or "
            "keypoints",
        },
        Status.NO_CONSENSUS,
    )
    """The second measure does not confirm the first."""
    BACKWARDS = (
        "backwards",
        "{camera:b} fits as well when played backwards: the motion is symmetric in time, or of another time; use keypoints",
        Status.AMBIGUOUS,
    )
    """Motion that looks the same backwards."""
    EVIDENCE = (
        "evidence",
        "too little evidence ({value:.0f} of {needed:.0f}): similar motion of another time would fit about as well; use a longer "
        "overlap, or keypoints",
        Status.AMBIGUOUS,
    )
    """Too little evidence."""


# ----------------------------------------------------------------------------------------------------------------------
# Two sequences of unit vectors against each other at all lags: scores, and the peaks of their curve.
#
# Lag s pairs row i of the first with row i + s of the second.  Rows of missing frames are 0 and do not count.


CHUNK = 32  # columns transformed at once


def lag_sums(a: Tensor, b: Tensor) -> Tensor:
    """``(n + m - 1,)`` sums of :math:`<a_i, b_{i+s}>` over i, for lags s from -(n - 1) to m - 1, of ``(n, D)`` and ``(m, D)``."""
    n, m = len(a), len(b)
    size = 1 << (n + m - 2).bit_length()
    spectrum = torch.zeros(size // 2 + 1, dtype=torch.complex128, device=a.device)
    for first in range(0, a.shape[1], CHUNK):
        left, right = (torch.fft.rfft(x[:, first : first + CHUNK].double(), size, dim=0) for x in (a, b))
        spectrum += (left.conj() * right).sum(1)
    sums = torch.fft.irfft(spectrum, size)
    return torch.cat([sums[size - (n - 1) :], sums[:m]])


@dataclass(frozen=True)
class Curve:
    """Scores over the lags: ``lags (L,)`` int64, ``scores (L,)`` with -inf where too little overlaps, ``counts (L,)`` frames."""

    lags: Tensor
    scores: Tensor
    counts: Tensor

    @property
    def best_lag(self) -> int:
        """The lag of the highest score."""
        return int(self.lags[self.scores.argmax()])

    def at(self, lag: int) -> float:
        """The score at a lag."""
        return float(self.scores[lag - int(self.lags[0])])

    def within(self, low: int, high: int) -> Curve:
        """The same with -inf outside the lags from ``low`` to ``high``."""
        inside = (self.lags >= low) & (self.lags <= high)
        return Curve(self.lags, self.scores.masked_fill(~inside, -torch.inf), self.counts)

    def peaks(self, radius: int) -> Tensor:
        """Indices of what is highest within ``radius`` lags to either side, best first."""
        around = max_pool1d(self.scores[None], 2 * radius + 1, 1, radius)[0]
        found = ((self.scores == around) & self.scores.isfinite()).nonzero()[:, 0]
        return found[self.scores[found].argsort(descending=True)]

    def offset(self, lag: int) -> float:
        """Where a parabola through the scores about a peak has its vertex, in lags from it, at most half a lag."""
        k = lag - int(self.lags[0])
        if not 0 < k < len(self.lags) - 1:
            return 0.0
        left, mid, right = self.scores[k - 1 : k + 2].tolist()
        bend = left - 2 * mid + right
        return max(-0.5, min(0.5, (left - right) / (2 * bend))) if -torch.inf < bend < 0 else 0.0


OVERLAP_POWER = 0.35  # Exponent of the overlap in the score: a mean alone (0) prefers chance agreement in short overlaps.


def score_curve(a: Tensor, b: Tensor, least: float) -> Curve:
    r"""Scores at all lags. a, b ``(n, D)``."""
    counts = lag_sums(*(x.abs().sum(1, keepdim=True).gt(0).double() for x in (a, b))).round()
    known = counts >= max(least, 1.0)
    mean = lag_sums(a, b) / counts.clamp(min=1.0)
    scores = mean * (counts / counts.max().clamp(min=1.0)) ** OVERLAP_POWER
    lags = torch.arange(-(len(a) - 1), len(b), device=a.device)
    return Curve(lags, scores.masked_fill(~known, -torch.inf), counts)


MIN_HALF_OVERLAP_SHARE = 0.5  # Share of a half.


def part_curve(a: Tensor, b: Tensor, rows: slice) -> Curve:
    """The curve of a part of the first sequence against all of the second."""
    part = a[rows]
    curve = score_curve(part, b, MIN_HALF_OVERLAP_SHARE * len(part))
    return Curve(curve.lags - rows.start, curve.scores, curve.counts)


# ----------------------------------------------------------------------------------------------------------------------
# Does every moment of the overlap ask for the same lag?  Evidence in nats, added up over short windows.
#
# Two takes of similar motion have a best lag too, but moment by moment the best lag wanders; of one motion it stays.


WINDOW_FRAMES = 16  # Frames of a window.
WINDOW_HOP_FRAMES = 8  # From one window to the next.
WINDOW_LAG_RANGE = 12  # Lags on either side of the candidate.
MIN_KNOWN_SHARE = 0.75  # Share of a window's pairs of frames that must be known.


def windows(a: Tensor, b: Tensor, lag: int) -> Tensor:
    """``(windows, 2 reach + 1)`` mean cosines in windows of the overlap at lags about ``lag``; NaN: less than 3/4 known."""
    low, high = max(0, -lag), min(len(a), len(b) - lag)
    rows = torch.arange(low, max(high, low), device=a.device)
    columns = rows[:, None] + lag + torch.arange(-WINDOW_LAG_RANGE, WINDOW_LAG_RANGE + 1, device=a.device)
    inside = (columns >= 0) & (columns < len(b))
    seen_a, seen_b = (x.abs().sum(1) > 0 for x in (a, b))
    columns = columns.clamp(0, len(b) - 1)
    known = inside & seen_a[rows, None] & seen_b[columns]
    values = torch.stack([(a[rows] * b[columns[:, k]]).sum(1) for k in range(2 * WINDOW_LAG_RANGE + 1)], dim=1) * known
    size = min(WINDOW_FRAMES, len(rows))
    if size == 0:
        return values.new_full((1, 2 * WINDOW_LAG_RANGE + 1), torch.nan)
    total = values.unfold(0, size, WINDOW_HOP_FRAMES).sum(-1)
    count = known.double().unfold(0, size, WINDOW_HOP_FRAMES).sum(-1)
    return torch.where(count >= MIN_KNOWN_SHARE * size, total / count.clamp(min=1), torch.nan)


WINDOW_LAG_TOLERANCE = 1  # Lags within which a window speaks for the candidate.
SOFTMAX_SHARPNESS = 10.0  # Of mean cosines (AUC of right against wrong candidates at 10 / 20 / 40: .926 / .904 / .892).
OUTLIER_SHARE = 0.05  # Share of windows that may say anything.


def evidence(a: Tensor, b: Tensor, lag: int) -> float:
    r"""Nats that the windows of the overlap speak for ``lag`` (within one) rather than for any of the lags around it. a, b
    ``(n, D)``."""
    means = windows(a, b, lag)
    known = means.isfinite()
    share = torch.softmax(torch.where(known, SOFTMAX_SHARPNESS * means, -torch.inf), dim=1)
    near = share[:, WINDOW_LAG_RANGE - WINDOW_LAG_TOLERANCE : WINDOW_LAG_RANGE + WINDOW_LAG_TOLERANCE + 1].sum(1)
    chance = (2 * WINDOW_LAG_TOLERANCE + 1) / known.sum(1).clamp(min=1).double()
    nats = torch.log((1 - OUTLIER_SHARE) * near / chance + OUTLIER_SHARE)
    return float(nats[known.sum(1) > WINDOW_LAG_RANGE].sum())


# ----------------------------------------------------------------------------------------------------------------------
# Whether the best lag may be believed: what else must hold besides being the best.


# Nats of evidence and lead that are enough: of 235 pairs of one event 67 right ones pass and 1 wrong one (by 2 frames), of 1,175
# unrelated or reversed ones none; of the window kernel alone 22 of 144 and none of 576.
MIN_EVIDENCE = {"profile": 31.0, "window": 25.0}
# Centre and scale, in nats, of the logistic curve of confidence where halves and kernel agree, and where they do not.
AGREED_LOGISTIC = {"profile": (16.5, 6.2), "window": (12.1, 4.0)}
OPEN_LOGISTIC = {"profile": (23.3, 4.9), "window": (112.0, 38.0)}


AGREEMENT_FRAMES = 2  # Within this halves and kernel agree with the best lag.
MAX_SECOND_SCORE = 0.8  # Second peak over the best one above which the motion is periodic.
MAX_REVERSED_SCORE = 0.95  # Score of the time-reversed video over the best one.
LEAD_NATS = 30.0  # Nats for doing better than the time-reversed video by 100 %.


@dataclass(frozen=True)
class Verdict:
    """The curve, its best lag, and what speaks for and against it."""

    curve: Curve  # scores of the profile, all lags
    best: int  # its best lag
    halves: tuple[int, int]  # best lags of the two halves of the overlap
    kernel: int | None  # best lag of the thesis's window kernel; None where the overlap is too short for it
    second: float  # score of the next peak relative to the best
    backwards: float  # score of the best lag of b played backwards, relative
    nats: float  # evidence of short windows, profile and kernel
    measure: Measure = "profile"

    @property
    def weight(self) -> float:
        """Evidence with the lead over the reversed take, in nats; ``MIN_EVIDENCE`` is enough."""
        return self.nats + LEAD_NATS * (1 - min(self.backwards, 2.0))

    @property
    def agrees(self) -> bool:
        """Whether halves and kernel agree with the best lag."""
        halves = all(abs(half - self.best) <= AGREEMENT_FRAMES for half in self.halves)
        return halves and self.kernel is not None and abs(self.kernel - self.best) <= AGREEMENT_FRAMES

    @property
    def confidence(self) -> float:
        """Probability that the best lag is right to within a frame."""
        table = AGREED_LOGISTIC if self.agrees and self.second <= MAX_SECOND_SCORE else OPEN_LOGISTIC
        centre, scale = table[self.measure]
        return 1 / (1 + math.exp(-max(-30.0, min(30.0, (self.weight - centre) / scale))))

    def refusal(self, rate: float) -> Notice | None:
        """Why the best lag is not to be believed; None where it is."""
        if self.second > MAX_SECOND_SCORE:
            return Notice(BrightnessNotice.REPEATED, 100 * self.second)
        away = max(max(self.halves) - min(self.halves), *(abs(half - self.best) for half in self.halves))
        if away > AGREEMENT_FRAMES:
            first, second = ((half - self.best) / rate for half in self.halves)
            return Notice(BrightnessNotice.HALVES, 0.0, {"first": first, "second": second})
        if self.kernel is None:
            return Notice(BrightnessNotice.KERNEL, 0.0, {"case": "short"})
        if abs(self.kernel - self.best) > AGREEMENT_FRAMES:
            return Notice(BrightnessNotice.KERNEL, (self.kernel - self.best) / rate, {"case": "apart"})
        if self.backwards > MAX_REVERSED_SCORE:
            return Notice(BrightnessNotice.BACKWARDS, self.backwards)
        if self.weight < MIN_EVIDENCE[self.measure]:
            return Notice(BrightnessNotice.EVIDENCE, self.weight, {"needed": MIN_EVIDENCE[self.measure]})
        return None


MIN_PEAK_SEPARATION_FRAMES = 8  # From the best peak, for another answer.


def evaluate(
    a: Sampled,
    b: Sampled,
    lags: tuple[int, int],
    least: float,
    measure: Measure = "profile",
) -> Verdict:
    """The best lag of two takes between ``lags``, with at least ``least`` rows of overlap, and what else speaks for it."""
    compare = whiten if measure == "profile" else kernel_descriptors
    one, two = compare(*_rows(a, b, measure))
    curve = score_curve(one, two, least).within(*lags)
    if not bool(curve.scores.isfinite().any()):  # nothing moves in one of them
        nowhere = max(lags[0], min(0, lags[1]))
        return Verdict(curve, nowhere, (nowhere, nowhere), None, 1.0, 1.0, 0.0, measure)
    best = curve.best_lag
    others = [
        float(curve.scores[k])
        for k in curve.peaks(MIN_PEAK_SEPARATION_FRAMES // 2)
        if abs(int(curve.lags[k]) - best) > MIN_PEAK_SEPARATION_FRAMES
    ]
    top = max(curve.at(best), 1e-9)
    kernel, nats = _kernel_opinion(a, b, lags, best) if measure == "profile" else (best, 0.0)
    back = score_curve(*compare(*_rows(a, b.backwards(), measure)), least)
    return Verdict(
        curve=curve,
        best=best,
        halves=_halves(one, two, best, lags),
        kernel=kernel,
        second=max([*others, 0.0]) / top,
        backwards=float(back.scores.max()) / top,
        nats=evidence(one, two, best) + nats,
        measure=measure,
    )


def _rows(a: Sampled, b: Sampled, measure: Measure) -> tuple[Tensor, Tensor]:
    """What a measure compares of two takes, a row per frame: row i of either is lag 0 of the other's."""
    return (a.profile, b.profile) if measure == "profile" else (a.kernels, b.kernels)


def _halves(one: torch.Tensor, two: torch.Tensor, best: int, lags: tuple[int, int]) -> tuple[int, int]:
    low, high = max(0, -best), min(len(one), len(two) - best)
    middle = (low + high) // 2
    first, second = (part_curve(one, two, rows).within(*lags).best_lag for rows in (slice(low, middle), slice(middle, high)))
    return first, second


MIN_KERNEL_OVERLAP_SHARE = 0.3  # Share of its kernels.
MIN_KERNELS = 5  # Pairs of kernels from which their windows count.


def _kernel_opinion(a: Sampled, b: Sampled, lags: tuple[int, int], best: int) -> tuple[int | None, float]:
    """Best lag of the window kernels, and the evidence of their windows for ``best``."""
    shorter = min(len(a.kernels), len(b.kernels))
    if shorter < KERNEL_HALF_FRAMES or not all(bool(x.kernels.isfinite().all(-1).all(-1).any()) for x in (a, b)):
        return None, 0.0
    one, two = kernel_descriptors(a.kernels, b.kernels)
    curve = score_curve(one, two, MIN_KERNEL_OVERLAP_SHARE * shorter).within(*lags)
    found = curve.best_lag if bool(curve.scores.isfinite().any()) else None
    overlap = min(len(one), len(two) - best) - max(0, -best)
    return found, evidence(one, two, best) if overlap >= MIN_KERNELS else 0.0


MIN_OVERLAP_SHARE = 0.35  # Share of the shorter video.


@on_cpu
@one_thread
def brightness_shift(
    a: Any,
    b: Any,
    *,
    fps: tuple[float, float] | None = None,
    times: tuple[Any, Any] | None = None,
    max_shift: float | None = None,
    region: str | Region | None = "motion",
    measure: Measure = "profile",
) -> Shift:
    r"""How camera b's clock runs against camera a's, from brightness alone, or why that cannot be told. a ``(frames, h, w)``."""
    if measure not in MEASURES:
        raise ValueError(f"measure must be one of {', '.join(MEASURES)}, got {measure!r}")
    first, second = _read_videos(a, b, fps, times)
    if max_shift is not None and not (math.isfinite(max_shift) and max_shift >= 0):
        raise ValueError(f"max_shift must be seconds, 0 or more, got {max_shift!r}")
    rate = common_rate(first, second)
    (one, of_a), (two, of_b) = (_sample_video(each, region, rate) for each in (first, second))
    base = two.start - one.start
    lengths = [len(rows) for rows in _rows(one, two, measure)]
    if measure == "window" and min(lengths) < KERNEL_HALF_FRAMES:
        text = "{arg:measure='window'} needs {needed} frames at {rate:.3g} per second, the shorter video has {frames}; film longer"
        shorter = min(len(one.profile), len(two.profile))
        raise ValueError(Message(text, needed=3 * KERNEL_HALF_FRAMES, rate=rate, frames=shorter))
    span = (1 - lengths[0], lengths[1] - 1)
    if max_shift is not None:
        span = (
            max(span[0], math.ceil((-max_shift - base) * rate - 1e-6)),
            min(span[1], math.floor((max_shift - base) * rate + 1e-6)),
        )
    shorter = min(lengths)
    by_kernel = max(float(MIN_KERNELS), MIN_KERNEL_OVERLAP_SHARE * shorter)
    least = max(float(MIN_FRAMES), MIN_OVERLAP_SHARE * shorter) if measure == "profile" else by_kernel
    longest = min(lengths[0], lengths[1] - span[0]) - max(0, -span[1])
    if span[0] > span[1] or longest < least:
        text = (
            "{arg:max_shift} {given!r}: within it the videos overlap by less than {least:.0f} frames at {rate:.3g} per second; "
            "allow larger shifts or give longer videos"
        )
        raise ValueError(Message(text, given=max_shift, least=least, rate=rate))
    verdict = evaluate(one, two, span, least, measure)
    return _shift((first, second), (one, two), verdict, (*of_a, *of_b))


def _read_videos(a: Any, b: Any, fps: tuple[float, float] | None, times: tuple[Any, Any] | None) -> tuple[GrayVideo, GrayVideo]:
    for name, pair in (("fps", fps), ("times", times)):
        if pair is not None and not (isinstance(pair, (tuple, list)) and len(pair) == 2):
            raise ValueError(f"{name} must be a pair, one for each video, got {pair!r}")
    rates, stamps = fps or (None, None), times or (None, None)
    return read_gray_video(a, "a", rates[0], stamps[0]), read_gray_video(b, "b", rates[1], stamps[1])


MIN_MOVING_FRAMES = 10  # Frames in which something moves.


def _sample_video(source: GrayVideo, region: str | Region | None, rate: float) -> tuple[Sampled, tuple[Notice, ...]]:
    """A take on the grid, and why it decides nothing, or what else to know of it."""
    height, width = source.frames.shape[1:]
    found = motion(source.frames, None if region is None else _region_in_pixels(region, source))
    box, moving = boxes(found, source.fps)
    if region is None:
        whole = torch.tensor([[width / 2, height / 2, max(width, height)]], dtype=torch.float64)
        box, moving = whole.expand(len(source.frames), 3), False
    on_grid, values = sample(source, box, rate), {"which": source.name, "camera": source.name}
    if found.drift.too_fast:
        return on_grid, (Notice(BrightnessNotice.FLICKER, 0.0, values),)
    if int(found.lively.sum()) < MIN_MOVING_FRAMES:
        return on_grid, (Notice(BrightnessNotice.STILL, float(found.lively.sum()), values),)
    if found.drift.moves:
        step = float(found.drift.step.norm(dim=1).mean()) / source.scale
        return on_grid, (Notice(BrightnessNotice.CAMERA_MOVES, step, values),)
    return on_grid, (Notice(BrightnessNotice.CROSSES, 0.0, values),) if moving else ()


def _region_in_pixels(region: str | Region, source: GrayVideo) -> Region | None:
    if isinstance(region, str):
        if region != "motion":
            raise ValueError(f"region must be 'motion', None or (x0, y0, x1, y1) in pixels, got {region!r}")
        return None
    height, width = source.frames.shape[1:]
    values = [float(v) for v in region] if len(region) == 4 else []
    if not values or not (values[0] < values[2] and values[1] < values[3]) or not all(map(math.isfinite, values)):
        raise ValueError(f"region must be (x0, y0, x1, y1) in pixels with x0 < x1 and y0 < y1, got {region!r}")
    x0, y0, x1, y1 = (v * source.scale for v in values)
    if x0 >= width or y0 >= height or x1 <= 0 or y1 <= 0:
        raise ValueError(f"region {region!r} lies outside the image of {source.name}")
    return x0, y0, x1, y1


NUM_PEAKS = 10  # Peaks that are returned.
MIN_SIGMA_FRAMES = 0.35  # Error of an accepted offset: .24 to .32 RMS on shifts by quarters of a frame.


def _shift(
    takes: tuple[GrayVideo, GrayVideo],
    grids: tuple[Sampled, Sampled],
    verdict: Verdict,
    known: tuple[Notice, ...],
) -> Shift:
    (one, two), curve, best = grids, verdict.curve, verdict.best
    rate, base = one.rate, two.start - one.start
    found = curve.peaks(MIN_PEAK_SEPARATION_FRAMES // 2)[:NUM_PEAKS]
    places = torch.tensor([int(curve.lags[k]) + curve.offset(int(curve.lags[k])) for k in found], dtype=torch.float64)
    unusable = any(notice.code.refuses is not None for notice in known)
    refusal = None if unusable else verdict.refusal(rate)
    limits = known if refusal is None else (refusal, *known)
    low, high = max(0, -best), min(len(one.profile), len(two.profile) - best)
    spread = max(abs(half - best) for half in verdict.halves) / 2
    return Shift(
        offset=base + (best + curve.offset(best)) / rate,
        sigma=math.hypot(MIN_SIGMA_FRAMES, spread) / rate,
        rate=1.0,
        rate_sigma=0.0,
        confidence=0.0 if unusable else verdict.confidence,
        peaks=torch.stack([base + places / rate, curve.scores[found]], dim=1),
        method="brightness",
        fps=(takes[0].fps, takes[1].fps),
        center=one.start + (low + high - 1) / 2 / rate,
        lags=base + curve.lags.double() / rate,
        scores=curve.scores.masked_fill(~curve.scores.isfinite(), torch.nan),
        status=status_from(limits),
        notices=limits,
    )
