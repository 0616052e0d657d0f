"""What the microphones of two cameras heard: a witness to how their clocks run, or, where asked, the only one.

Two microphones in one room do not record one waveform: reverberation, automatic gain and the electronics differ.  What they share
is *when* it gets loud, and at which pitch: the envelopes of :mod:`indexing.sync.soundtrack`.  They are compared by the generalized
cross-correlation with phase transform: every rate of change counts alike, however much of it there is, which makes the correlation
of anything but a repeating sound a single peak.

A peak must have many moments behind it.  One clap fits any other clap; what speaks for a shift is the sum of what short stretches
of the overlap say, over the root of the sum of their squares.  By chance this ratio exceeds t with a probability of at most
exp(-t^2 / 2), however loud single moments are.  A sound that repeats itself has rivals of the best shift, and is like itself at
their distance; what only one of the microphones hears makes the loudness of both less coherent.  A logistic regression makes one
probability of these figures (``sound_decision.json``, by ``python -m experiments.synchronization.sound --write``).
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from dyntorch import Shift, Status
from dyntorch.core import Notice, NoticeCode, status_from
from dyntorch.numerics import DecisionModel
from indexing.sync.recordings import undecided_shift
from indexing.sync.soundtrack import HOP_SECONDS, STEP_SECONDS, Sound, block_means

Floats = NDArray[np.float64]


class SoundNotice(NoticeCode):
    """What the sound of two videos says, and why it does not decide."""

    NONE = "no_sound", "{camera:{which}} has no sound; use keypoints or pixels", Status.TOO_FEW
    """A video without a stream of sound."""
    SILENT = "silent", "the sound of {camera:{which}} is silence; use keypoints or pixels", Status.DEGENERATE
    """A microphone that was off."""
    SHORT = (
        "short",
        "the sounds overlap by less than {value:g} s at every shift that is searched; film longer, or raise {arg:max_shift}",
        Status.TOO_FEW,
    )
    """Nothing to compare."""
    NOTHING = (
        "no_peak",
        "no shift of the sound stands out: the microphones heard too little, or different things; clap at some uneven moments",
        Status.AMBIGUOUS,
    )
    """No peak stands out."""
    REPEATED = (
        "sound_repeats",
        "the sound repeats itself: {value:+.3f} s fits hardly better than {rivals} s; clap at some uneven moments",
        Status.AMBIGUOUS,
    )
    """Several peaks, as of a metronome."""
    DIFFERENT = (
        "sound_differs",
        "at {value:+.3f} s much is loud at one microphone only, as where one recording was played in two takes, or in much noise; "
        "clap at some uneven moments",
        Status.AMBIGUOUS,
    )
    """Much of what is loud is loud at one microphone only."""
    SYSTEMATIC = (
        "sound_systematic",
        "sigma is that of the sound at the microphones: a source {metres:g} m nearer to one, and sound that is late in its file, "
        "add some {value:.3f} s; one recording that was played in two takes sounds like one event",
    )
    """What sound alone cannot know."""
    AGREES = "sound_agrees", "sound agrees: {value:+.3f} s"
    """The sound says the same; the value is how much later."""
    OPEN = "sound_open", "the sound does not decide: {why}"
    """The sound is no witness."""
    ALONE = "sound_alone", "the sound says {offset} ± {sigma} s; {arg:method='sound'} takes its word"
    """The sound decides where nothing else does."""
    CONTRADICTS = (
        "sound_contradicts",
        "the sound says {offset} ± {sigma} s, and the pictures say {found} ± {own} s: one of them is wrong; {arg:method='sound'} "
        "takes the word of the sound, {arg:sound=False} that of the pictures",
        Status.NO_CONSENSUS,
    )
    """The sound says something else."""


MIN_OVERLAP_SECONDS = 2.0  # Time that both must have recorded at once.


def sound_shift(
    a: Sound | None,
    b: Sound | None,
    *,
    fps: tuple[float, float] = (30.0, 30.0),
    max_shift: float | None = None,
    rate: float | None = None,
    risk: float = 0.002,
) -> Shift:
    """How the clock of one camera runs against that of another, by what their microphones heard.

    ``ok`` where the ``confidence``, the probability that the offset is right, is at least 1 - risk.  It is that of recordings like
    those of ``experiments.synchronization.sound``, in which one pair of a hundred with music is the same song in two takes: where
    nothing else can be heard nothing tells those apart, so that it is .999 at most.  ``sigma`` (s) is that of the offset between
    the microphones, room included; how much nearer the source is to one of them, and how late the sound of a file is, no sound
    tells: a note says so, and :func:`check_by_sound` adds it.
    """
    if not 0 < risk < 1:
        raise ValueError(f"risk must lie between 0 and 1, got {risk!r}")
    missing = [which for which, one in zip("ab", (a, b), strict=True) if one is None]
    if a is None or b is None:
        return undecided_shift(fps, "sound", *(Notice(SoundNotice.NONE, 0.0, {"which": which}) for which in missing))
    dead = [Notice(SoundNotice.SILENT, 0.0, {"which": which}) for which, one in zip("ab", (a, b), strict=True) if one.silent]
    if dead:
        return undecided_shift(fps, "sound", *dead)
    search = SoundSearch(a, b, max_shift, 0.0 if rate is None else rate - 1, rate is None)
    if not search.lags.size:
        return undecided_shift(fps, "sound", Notice(SoundNotice.SHORT, MIN_OVERLAP_SECONDS))
    return search.shift(fps, risk)


@dataclass(frozen=True)
class SoundPeak:
    """A shift that is worth a look."""

    lag: float
    drift: float
    score: float


MAX_RATE_DEVIATION = 2e-4  # Of one clock against the other: those of phones and cameras differ by 5e-5.
MAX_PIECE_SECONDS = 30.0  # Within it a rate is neglected, 6 ms at most.
NUM_PEAKS = 7  # Peaks that are compared.
MIN_PEAK_SEPARATION_SECONDS = 0.1  # Within this a peak is the slope of a higher one: a band's envelope, and a room's first echoes.
STRETCH_SECONDS = 0.03  # Time that speaks as one, a clap (experiments.synchronization.sound).
LOUDNESS_SECONDS = 0.05  # Over it the loudness is averaged whose coherence is a figure.
MAX_CURVE_POINTS = 20_000  # Points of the curve that are returned.


REPLAY_PROBABILITY = 1e-3
"""One recording in two takes of which nothing tells: in training one of 300 pairs, a fifth of which is believed."""


def decision_model() -> DecisionModel:
    """Of whether a shift is right."""
    return DecisionModel.load(Path(__file__).with_name("sound_decision.json"), "offset")


class SoundSearch:
    """Two sounds, and the score of every shift between them."""

    def __init__(self, a: Sound, b: Sound, max_shift: float | None, drift: float, free: bool):
        self.a, self.b, self.free, self.given = a, b, free, drift
        self.between = b.first - a.first  # seconds between the clocks at a shift of 0 steps
        one, two = a.coarse.shape[1], b.coarse.shape[1]
        self.middle = (one - 1) / 2
        every = np.arange(1 - one, two)
        count = np.minimum(np.minimum(one, two - every), np.minimum(one + every, two))
        keep = count >= MIN_OVERLAP_SECONDS / STEP_SECONDS
        if max_shift is not None:
            keep &= np.abs(every * STEP_SECONDS + self.between) <= max_shift
        self.lags, self.count, self._keep = every[keep], count[keep], keep

    def _drifts(self) -> Floats:
        """Drifts that are told apart by the ends of the recordings, steps per step."""
        if not self.free:
            return np.array([self.given])
        length = min(self.a.coarse.shape[1], self.b.coarse.shape[1])
        many = int(MAX_RATE_DEVIATION * length / 2)  # the ends of a stretch move by one step from one to the next
        return np.arange(-many, many + 1) * 2 / length

    @cached_property
    def lag_scores(self) -> tuple[Floats, Floats]:
        """``(L,)`` score of every lag at its best drift, and those drifts."""
        from scipy import fft

        one, two = self.a.coarse, self.b.coarse
        size = fft.next_fast_len(one.shape[1] + two.shape[1], real=True)
        other = fft.rfft(two, size, axis=1)
        drifts = self._drifts()
        length = one.shape[1] if len(drifts) == 1 and not drifts[0] else round(MAX_PIECE_SECONDS / STEP_SECONDS)
        sums = np.zeros((len(drifts), len(self._keep)))
        for begin in range(0, one.shape[1], length):
            part = one[:, begin : begin + length]
            found = fft.irfft((np.conj(fft.rfft(part, size, axis=1)) * other).sum(axis=0), size)
            curve = np.take(found, np.arange(1 - one.shape[1], two.shape[1]) + begin, mode="wrap")
            away = begin + part.shape[1] / 2 - self.middle
            for row, drift in enumerate(drifts):
                sums[row] += np.roll(curve, -round(drift * away))
        scores = sums[:, self._keep] / np.sqrt(self.count)
        usual = 1.4826 * float(np.median(np.abs(scores))) or 1.0  # of a normal distribution: its standard deviation
        best = scores.argmax(axis=0)
        return scores.max(axis=0) / usual, drifts[best]

    def peaks(self) -> list[SoundPeak]:
        """The best shifts that are not the slope of a better one, best first."""
        scores, drifts = self.lag_scores
        left = scores.copy()
        found: list[SoundPeak] = []
        away = MIN_PEAK_SEPARATION_SECONDS / STEP_SECONDS
        while len(found) < NUM_PEAKS and np.isfinite(left).any():
            at = int(np.nanargmax(left))
            if not left[at] > 0:
                break
            found.append(SoundPeak(float(self.lags[at]), float(drifts[at]), float(scores[at])))
            left[np.abs(self.lags - self.lags[at]) <= away] = -np.inf
        return found

    def _frame_pairs(self, peak: SoundPeak) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Frames of a and of b that a shift puts at the same moments."""
        rows = np.arange(self.a.coarse.shape[1])
        other = rows + np.rint(peak.lag + peak.drift * (rows - self.middle)).astype(np.int64)
        there = (other >= 0) & (other < self.b.coarse.shape[1])
        return rows[there], other[there]

    def stretch_scores(self, peak: SoundPeak) -> Floats:
        """What each short stretch of a says for a shift; 0 where b recorded nothing."""
        one, two = self._frame_pairs(peak)
        products = np.zeros(self.a.coarse.shape[1])
        products[one] = np.einsum("kt,kt->t", self.a.coarse[:, one], self.b.coarse[:, two])
        return stretch_sums(products)

    def _repetition(self, lag: int) -> float:
        """Evidence that both sounds are like themselves some frames later."""
        pairs = [(one.coarse[:, lag:], one.coarse[:, : max(0, one.coarse.shape[1] - lag)]) for one in (self.a, self.b)]
        return min(evidence_ratio(stretch_sums(np.einsum("kt,kt->t", *pair))) for pair in pairs)

    def _loudness(self, peak: SoundPeak) -> tuple[float, float]:
        """Coherence (as Fisher's z) of the mean logarithmic loudness of both at a shift, and the log of how much it varies."""
        curves = []
        for one, rows in zip((self.a, self.b), self._frame_pairs(peak), strict=True):
            energy = block_means(one.coarse_energy[:, rows], round(LOUDNESS_SECONDS / STEP_SECONDS))
            quiet = np.quantile(energy, 0.2, axis=1, keepdims=True) + 1e-9 * energy.max() + np.finfo(np.float32).tiny
            curve = np.log1p(energy / quiet).mean(axis=0)
            curves.append(curve - curve.mean())
        size = float(np.prod([np.sqrt((curve**2).mean()) for curve in curves]))
        coherence = float((curves[0] * curves[1]).mean()) / size if size else 0.0
        return math.atanh(min(max(coherence, -0.9), 0.99)), math.log(size + 1e-9)

    def rank_peaks(self) -> tuple[list[SoundPeak], list[Floats]]:
        """Peaks by their evidence, the best first (scores of short overlaps are of chance), and what stretches say for each."""
        peaks = self.peaks()
        said = [self.stretch_scores(one) for one in peaks]
        order = sorted(range(len(peaks)), key=lambda i: -evidence_ratio(said[i]))
        return [peaks[i] for i in order], [said[i] for i in order]

    def figures(self, peaks: list[SoundPeak], said: list[Floats]) -> dict[str, float]:
        """What the decision is made from, of at least one peak, ranked; some stop where more of them says no more."""
        strength = evidence_ratio(said[0])
        rivals = [evidence_ratio(other) for other in said[1:]]
        apart = [evidence_ratio(said[0] - other) for other in said[1:]]
        again = [self._repetition(abs(round(one.lag - peaks[0].lag))) for one in peaks[1:]]
        coherence, dynamics = self._loudness(peaks[0])
        return {
            "evidence_over_rivals": min(max(min(apart, default=strength), -3.0), 8.0),
            "lead": strength - max(rivals, default=0.0),
            "repetition": min(max(again, default=0.0), 12.0),
            "coherence": coherence,
            "dynamics": dynamics,
        }

    def shift(self, fps: tuple[float, float], risk: float) -> Shift:
        """The best shift, and whether it is to be believed."""
        peaks, said = self.rank_peaks()
        if not peaks:
            return undecided_shift(fps, "sound", Notice(SoundNotice.NOTHING, 0.0))
        figures, model = self.figures(peaks, said), decision_model()
        confidence = (1 - REPLAY_PROBABILITY) * model.probability(figures)
        fit = SoundFit(self, peaks[0])
        notices = (Notice(SoundNotice.SYSTEMATIC, SYSTEMATIC_SIGMA_SECONDS, {"metres": DISTANCE_SIGMA_METRES}),)
        if confidence < 1 - risk:
            notices = (self._refusal(peaks, model.against(figures)),)
        scores, _ = self.lag_scores
        kept = _thin(self.lags * STEP_SECONDS + self.between, scores, MAX_CURVE_POINTS)
        return Shift(
            offset=fit.offset,
            sigma=fit.sigma,
            rate=fit.rate,
            rate_sigma=fit.rate_sigma,
            confidence=confidence,
            peaks=torch.tensor([[self.seconds(one, fit.center), one.score] for one in peaks], dtype=torch.float64),
            method="sound",
            fps=fps,
            center=fit.center,
            lags=torch.from_numpy(kept[0]),
            scores=torch.from_numpy(kept[1]),
            status=status_from(notices),
            notices=notices,
        )

    def _refusal(self, peaks: list[SoundPeak], against: list[str]) -> Notice:
        """Why the best shift is not to be believed. against: names of figures, the most harmful one first."""
        code = SoundNotice.NOTHING
        if against[:1] == ["coherence"]:
            code = SoundNotice.DIFFERENT
        elif "repetition" in against and len(peaks) > 1:  # rivals are of the sound, not of chance
            code = SoundNotice.REPEATED
        said = ", ".join(f"{self.seconds(one):+.3f}" for one in peaks[1:4])
        return Notice(code, self.seconds(peaks[0]), {"rivals": said})

    def seconds(self, peak: SoundPeak, center: float | None = None) -> float:
        """Between the clocks at a shift, in the middle of a or at a time of a's."""
        away = 0.0 if center is None else (center - self.a.first) / STEP_SECONDS - self.middle
        return (peak.lag + peak.drift * away) * STEP_SECONDS + self.between


def stretch_sums(products: Floats) -> Floats:
    """Sums over the frames of each short stretch. products ``(n,)``."""
    size = max(1, round(STRETCH_SECONDS / STEP_SECONDS))
    whole = np.pad(products, (0, -len(products) % size))
    return np.asarray(whole.reshape(-1, size).sum(axis=1), dtype=np.float64)


def evidence_ratio(values: Floats) -> float:
    """The sum of values over the root of the sum of their squares; of values as likely positive as negative rarely above 4."""
    size = float(np.sqrt((values**2).sum()))
    return round(float(values.sum()) / size, 3) if size else 0.0


def _thin(lags: Floats, scores: Floats, most: int) -> tuple[Floats, Floats]:
    """The highest of every few values of a curve of many."""
    every = -(-len(lags) // most)
    if every == 1:
        return lags, scores
    rows = np.arange(0, len(lags), every)
    best = np.array([row + int(scores[row : row + every].argmax()) for row in rows])
    return lags[best], scores[best]


MIN_PIECE_SECONDS = 2.0  # Pieces whose scatter gives sigma.
MIN_PIECES = 12  # Number of them in an overlap that is long enough.
SCORE_SMOOTHING_SECONDS = 0.003  # Standard deviation of the kernel of scores about the peak, for slope and curvature.
MIN_SECONDS_FOR_RATE = 30.0  # Overlap from which a rate is estimated: 1e-4 moves the ends by 3 ms then.
SIGNIFICANCE_SIGMAS = 3.0  # Significant difference of a rate from 1, and of two witnesses.
MAX_NEWTON_STEPS = 8  # Newton's steps.
# A room moves the peak at all moments alike; by how much, its width tells: so many seconds at 5 ms, growing with its third power
# (of the powers 0 to 4 the likeliest in experiments.synchronization.sound).
ROOM_SIGMA_SECONDS = 0.001
ROOM_PEAK_WIDTH_SECONDS = 0.005


class SoundFit:
    """Offset and rate about a peak, to a fraction of a millisecond."""

    def __init__(self, search: SoundSearch, peak: SoundPeak):
        from scipy import ndimage

        self.search = search
        a, b = search.a, search.b
        self.between = search.between
        ends = [search.seconds(peak, a.first), search.seconds(peak, a.first + a.seconds)]
        low, high = max(a.first, b.first - ends[0]), min(a.first + a.seconds, b.first + b.seconds - ends[1])
        self.center = (low + high) / 2
        self.times, curves = self._pieces(peak, low, high)
        self.splines = ndimage.spline_filter(curves, order=3, mode="mirror")
        long = search.free and high - low >= MIN_SECONDS_FOR_RATE
        place, slope, covariance = self._maximize(peak.drift, free=long)
        if long and abs(slope) <= SIGNIFICANCE_SIGMAS * math.sqrt(covariance[1, 1]):  # nothing speaks for a drift
            long, (place, slope, covariance) = False, self._maximize(0.0, free=False)
        self.rate = 1 + slope
        self.rate_sigma = math.sqrt(covariance[1, 1]) if long else 0.0
        self.sigma = math.sqrt(covariance[0, 0])
        self.offset = search.seconds(peak, self.center) + place + self.center - self.rate * self.center

    def _pieces(self, peak: SoundPeak, low: float, high: float) -> tuple[Floats, Floats]:
        """``(p,)`` seconds from the center, and ``(p, lags)`` smoothed scores about the peak's lag at the center."""
        from scipy import fft, ndimage

        a, b = self.search.a.fine, self.search.b.fine
        about = self.search.seconds(peak, self.center)
        shift = round((about - self.between) / HOP_SECONDS)
        self._whole = shift * HOP_SECONDS + self.between - about
        length = float(np.clip((high - low) / MIN_PIECES, MIN_PIECE_SECONDS, MAX_PIECE_SECONDS))
        reach = round((MIN_PEAK_SEPARATION_SECONDS + MAX_RATE_DEVIATION * (high - low) / 2) / HOP_SECONDS)
        first, last = round((low - self.search.a.first) / HOP_SECONDS), round((high - self.search.a.first) / HOP_SECONDS)
        size, times, curves = round(length / HOP_SECONDS), [], []
        for begin in range(max(0, first), max(first + 1, last - size // 2), size):
            end = min(begin + size, a.shape[1])
            one = a[:, begin:end]
            other = np.zeros((len(b), one.shape[1] + 2 * reach), np.float32)
            start = begin + shift - reach
            inside = slice(max(0, start), max(0, min(b.shape[1], start + other.shape[1])))
            other[:, inside.start - start : inside.stop - start] = b[:, inside]
            n = fft.next_fast_len(other.shape[1], real=True)
            found = fft.irfft((np.conj(fft.rfft(one, n, axis=1)) * fft.rfft(other, n, axis=1)).sum(axis=0), n)
            times.append((begin + end - 1) / 2 * HOP_SECONDS + self.search.a.first - self.center)
            curves.append(ndimage.gaussian_filter1d(found[: 2 * reach + 1], SCORE_SMOOTHING_SECONDS / HOP_SECONDS))
        return np.array(times), np.array(curves, dtype=np.float64)

    def _scores(self, place: float, slope: float, away: float = 0.0) -> Floats:
        """``(p,)`` of every piece's curve where offset and drift put it, or some steps beside."""
        from scipy import ndimage

        last = self.splines.shape[1] - 1
        at = (place - self._whole + slope * self.times) / HOP_SECONDS + last / 2 + away
        places = [np.arange(len(at)), at.clip(0, last)]
        return np.asarray(ndimage.map_coordinates(self.splines, places, order=3, mode="mirror", prefilter=False))

    def _derivatives(self, found: Floats, both: int) -> tuple[Floats, Floats, Floats]:
        """``(p,)`` scores of the pieces, their slopes ``(p, both)`` in seconds and drift, and the negative Hessian of the sum."""
        before, here, after = (self._scores(float(found[0]), float(found[1]), away) for away in (-1.0, 0.0, 1.0))
        first, second = (after - before) / (2 * HOP_SECONDS), (after - 2 * here + before) / HOP_SECONDS**2
        design = np.stack([np.ones_like(self.times), self.times], axis=1)[:, :both]
        return here, design * first[:, None], -(design * second[:, None]).T @ design

    def _maximize(self, drift: float, free: bool) -> tuple[float, float, Floats]:
        """Seconds from the peak, drift, and the covariance of both: a grid, then Newton's steps while they go up."""
        reach = MIN_PEAK_SEPARATION_SECONDS / 2
        places = np.arange(-reach, reach + HOP_SECONDS / 2, HOP_SECONDS)
        half = max(float(np.abs(self.times).max()), HOP_SECONDS)
        near = min(MAX_RATE_DEVIATION, 2 * STEP_SECONDS / half)  # what the search before could not tell apart
        steps = drift + np.arange(-near, near + 1e-12, HOP_SECONDS / half) if free else np.array([drift])
        totals = [[float(self._scores(place, slope).sum()) for place in places.tolist()] for slope in steps.tolist()]
        row, column = np.unravel_index(int(np.argmax(totals)), np.shape(totals))
        found = np.array([places[column], steps[row]])
        both = 2 if free else 1
        for _ in range(MAX_NEWTON_STEPS):
            here, slopes, hessian = self._derivatives(found, both)
            if np.linalg.eigvalsh(hessian).min() <= 0:
                break
            move = np.zeros(2)
            move[:both] = np.linalg.solve(hessian, slopes.sum(axis=0))
            next_place, next_slope = (found + move).tolist()
            if self._scores(next_place, next_slope).sum() < here.sum():
                break
            found = found + move
        return float(found[0]), float(found[1]), self._covariance(found, both)

    def _covariance(self, found: Floats, both: int) -> Floats:
        """``(2, 2)`` of seconds and drift."""
        here, slopes, hessian = self._derivatives(found, both)
        covariance = np.zeros((2, 2))
        covariance[0, 0] = MIN_PEAK_SEPARATION_SECONDS**2
        if np.linalg.eigvalsh(hessian).min() > 0:
            inverse = np.linalg.inv(hessian)
            covariance[:both, :both] = inverse @ (slopes.T @ slopes) @ inverse * len(slopes) / max(1, len(slopes) - both)
            width = math.sqrt(max(0.0, float(here.sum())) / hessian[0, 0])
            room = ROOM_SIGMA_SECONDS * (width / ROOM_PEAK_WIDTH_SECONDS) ** 3
            covariance[0, 0] += min(room, MIN_PEAK_SEPARATION_SECONDS) ** 2
        return covariance


# ----------------------------------------------------------------------------------------------------------------------
# A witness to what keypoints or pixels say.


DISTANCE_SIGMA_METRES = 3.0  # How much nearer the sound is to one camera.
SPEED_OF_SOUND = 343.0  # Metres per second at 20 degrees.
LATENCY_SIGMA_SECONDS = 0.015  # Between sound and pictures of a file: three sigmas are the 45 ms of ITU-R BT.1359-1.
SYSTEMATIC_SIGMA_SECONDS = math.hypot(DISTANCE_SIGMA_METRES / SPEED_OF_SOUND, LATENCY_SIGMA_SECONDS)


def offset_difference(one: Shift, other: Shift) -> float:
    """Seconds that another result is later, in the middle of the first's overlap."""
    return float(other.at(one.center)) - float(one.at(one.center))


def check_by_sound(found: Shift, heard: Shift) -> Shift:
    """What keypoints or pixels say, with what the sound says to it: it agrees (the odds of both are multiplied), contradicts (a
    refusal), or does not decide."""
    if not heard.ok:
        if all(notice.code is SoundNotice.NONE for notice in heard.notices):
            return found
        why = next((notice.text for notice in heard.notices if notice.code.refuses is not None), heard.reason)
        return dataclasses.replace(found, notices=(*found.notices, Notice(SoundNotice.OPEN, 0.0, {"why": why})))
    sigma = math.hypot(heard.sigma, SYSTEMATIC_SIGMA_SECONDS)
    said = {"offset": f"{heard.at(heard.center) - heard.center:+.3f}", "sigma": f"{sigma:.3f}"}
    if not found.ok:
        return dataclasses.replace(found, notices=(*found.notices, Notice(SoundNotice.ALONE, 0.0, said)))
    off = offset_difference(found, heard)
    if abs(off) <= SIGNIFICANCE_SIGMAS * math.hypot(found.sigma, sigma):
        right, wrong = found.confidence * heard.confidence, (1 - found.confidence) * (1 - heard.confidence)
        notices = (*found.notices, Notice(SoundNotice.AGREES, off))
        return dataclasses.replace(found, confidence=right / (right + wrong), notices=notices)
    said["found"] = f"{found.at(found.center) - found.center:+.3f}"
    said["own"] = f"{found.sigma:.3f}"
    limits = (Notice(SoundNotice.CONTRADICTS, off, said), *found.notices)
    return dataclasses.replace(found, status=status_from(limits), notices=limits)
