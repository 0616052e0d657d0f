"""What the microphones of two cameras heard: a witness to how their clocks run, or, where asked, the only one.

Two microphones in one room do not record one waveform: reverberation, automatic gain and the electronics differ.  What they share
is *when* it gets loud, and at which pitch.  So the sound is cut into bands of pitch, the logarithm of the energy in each is taken
over time (its envelope), and the envelopes are compared by the generalized cross-correlation with phase transform: every rate of
change counts alike, however much of it there is, which makes the correlation of anything but a repeating sound a single peak.

A peak must have many moments behind it.  One clap fits any other clap; what speaks for a shift is the sum of what short stretches
of the overlap say, over the root of the sum of their squares.  By chance this ratio exceeds t with a probability of at most
exp(-t^2 / 2), however loud single moments are, and the same ratio of the differences between the best shift and the next one says
whether a sound that repeats leaves the two apart.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from dyntorch import Shift, Status
from dyntorch.core import Notice, NoticeCode, status_from
from indexing.opening import size_of
from indexing.sync.recordings import undecided_shift
from indexing.video.reading import av, open_video, packets

Signal = NDArray[np.float32]


CHUNK = 20_000  # spectra at once: 20 MB


SAMPLE_RATE = 16_000  # Samples per second of all sound: the bands below need no more.
SILENCE_AMPLITUDE = 3e-4  # Share of full scale: 10 steps of 16 bits are rounding.
MIN_PITCH_HERTZ = 200.0  # Below are hum of the mains, wind and hands on the phone.
MAX_PITCH_HERTZ = 7000.0  # What phones' noise suppression leaves.
NUM_BANDS = 8  # Bands of pitch, of equal ratio.
WINDOW_SECONDS = 0.01  # Window of a spectrum.
HOP_SECONDS = 0.002  # From one spectrum to the next, of the envelopes that offset and rate are estimated from.
STEP_SECONDS = 0.01  # Step of the envelopes in which shifts are searched.
# Average of magnitudes in the phase transform (margin, music at 10 dB, 0 / .05 / .5 Hz: 7.3 / 7.4 / 5.0).
SPECTRUM_SMOOTHING_HERTZ = 0.05
MIN_MODULATION_HERTZ = 0.5  # Slower changes of loudness are those of automatic gain.


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


@dataclass(frozen=True, eq=False)
class Sound:
    """What a camera's microphone recorded. samples ``(n,)``."""

    samples: NDArray[Any]
    rate: float
    start: float = 0.0

    def __post_init__(self) -> None:
        samples = np.asarray(self.samples)
        if samples.ndim != 1 or samples.dtype.kind not in "fi":
            raise ValueError(f"samples: expected one channel (n,) of numbers, got shape {samples.shape} of {samples.dtype}")
        if not 0 < self.rate < math.inf:
            raise ValueError(f"rate: expected a positive number of samples per second, got {self.rate!r}")

    @property
    def seconds(self) -> float:
        """How long it is."""
        return len(self.samples) / self.rate

    @property
    def silent(self) -> bool:
        """Whether nothing but the rounding of its samples can be heard."""
        loudest = float(np.abs(self.samples.astype(np.float32)).max(initial=0.0))
        scale = 32768.0 if self.samples.dtype.kind == "i" else 1.0
        return loudest / scale < SILENCE_AMPLITUDE

    @property
    def first(self) -> float:
        """Seconds of the middle of the first frame of :attr:`energy`."""
        return self.start + WINDOW_SECONDS / 2

    @cached_property
    def energy(self) -> Signal:
        """``(bands, frames)`` energy of each band of pitch, ``HOP_SECONDS`` seconds apart."""
        from scipy import fft, signal

        made = self.samples.astype(np.float32) / (32768.0 if self.samples.dtype.kind == "i" else 1.0)
        if self.rate != SAMPLE_RATE:
            share = math.gcd(round(self.rate), SAMPLE_RATE)
            made = signal.resample_poly(made, SAMPLE_RATE // share, round(self.rate) // share).astype(np.float32)
        hop, width = round(HOP_SECONDS * SAMPLE_RATE), round(WINDOW_SECONDS * SAMPLE_RATE)
        if len(made) < width:
            return np.zeros((NUM_BANDS, 0), np.float32)
        cut = np.lib.stride_tricks.sliding_window_view(made, width)[::hop]
        size = fft.next_fast_len(2 * width, real=True)
        pitch = fft.rfftfreq(size, 1 / SAMPLE_RATE)
        edges = np.geomspace(MIN_PITCH_HERTZ, MAX_PITCH_HERTZ, NUM_BANDS + 1)
        bands = [(pitch >= low) & (pitch < high) for low, high in pairwise(edges)]
        taper = np.hanning(width).astype(np.float32)
        found = np.empty((len(bands), len(cut)), np.float32)
        for begin in range(0, len(cut), CHUNK):
            power = np.abs(fft.rfft(cut[begin : begin + CHUNK] * taper, size, axis=1)) ** 2
            for band, chosen in enumerate(bands):
                found[band, begin : begin + CHUNK] = power[:, chosen].sum(axis=1)
        return found

    @cached_property
    def fine(self) -> Signal:
        """``(bands, frames)`` envelopes of unit variance whose changes count alike at every rate, ``HOP_SECONDS`` apart."""
        return self._envelopes(self.energy, HOP_SECONDS)

    @cached_property
    def coarse(self) -> Signal:
        """The same, ``STEP_SECONDS`` seconds apart."""
        many = round(STEP_SECONDS / HOP_SECONDS)
        whole = self.energy[:, : self.energy.shape[1] // many * many]
        return self._envelopes(whole.reshape(len(whole), -1, many).mean(axis=2), STEP_SECONDS)

    def _envelopes(self, energy: Signal, step: float) -> Signal:
        if not energy.shape[1]:
            return energy
        quiet = np.quantile(energy, 0.5, axis=1, keepdims=True) + 1e-9 * energy.max() + np.finfo(np.float32).tiny
        return phase_transform(np.log(energy + quiet), 1 / step, SPECTRUM_SMOOTHING_HERTZ, MIN_MODULATION_HERTZ)


def phase_transform(curves: Signal, rate: float, smooth: float, slowest: float) -> Signal:
    """The phase transform of curves: each frequency divided by its magnitude, smoothed over its neighbours. curves ``(k, n)``
    -> ``(k, n)``."""
    from scipy import fft, ndimage

    length = curves.shape[1]
    size = fft.next_fast_len(length + int(rate), real=True)
    spectrum = fft.rfft(curves - curves.mean(axis=1, keepdims=True), size, axis=1)
    near = 2 * int(smooth * size / rate) + 1
    magnitude = np.sqrt(ndimage.uniform_filter1d(np.abs(spectrum) ** 2, near, axis=1))
    magnitude += 1e-3 * magnitude.max(axis=1, keepdims=True) + np.finfo(np.float32).tiny
    spectrum = np.where(fft.rfftfreq(size, 1 / rate) >= slowest, spectrum / magnitude, 0)
    made = fft.irfft(spectrum, size, axis=1)[:, :length]
    return np.asarray(made / np.sqrt((made**2).mean(axis=1, keepdims=True)).clip(1e-12), dtype=np.float32)


# ----------------------------------------------------------------------------------------------------------------------
# Listening to a file.


def read_sound(path: str | Path) -> Sound | None:
    """The sound of a video, on the clock of its pictures; None where it has none."""
    path = Path(path).expanduser()
    try:
        changed = path.stat().st_mtime_ns, size_of(path)
    except (OSError, ValueError):
        changed = (0, 0)  # opening it says what is wrong
    return _read_sound(path, changed)


@lru_cache(maxsize=16)
def _read_sound(path: Path, changed: tuple[int, int]) -> Sound | None:
    with open_video(path) as (container, pictures):
        streams = [stream for stream in container.streams.audio if stream.codec_context is not None]
        if not streams:
            return None
        zero = float((pictures.start_time or 0) * pictures.time_base)
        parts = list(_stretches(container, streams[0]))
    if not parts:
        return None
    start = min(began for began, _ in parts)
    end = max(began + len(piece) / SAMPLE_RATE for began, piece in parts)
    samples = np.zeros(math.ceil((end - start) * SAMPLE_RATE) + 1, np.int16)
    for began, piece in parts:
        at = round((began - start) * SAMPLE_RATE)
        samples[at : at + len(piece)] = piece[: len(samples) - at]
    return Sound(samples, float(SAMPLE_RATE), start - zero)


MAX_TIMESTAMP_ERROR_SECONDS = 0.02  # Timestamps that are farther off the samples are a gap; Matroska rounds to .001.


def _stretches(container: Any, stream: Any) -> Iterator[tuple[float, NDArray[np.int16]]]:
    """When each stretch of sound without a gap begins, and its samples at the common rate."""
    pieces: list[NDArray[np.int16]] = []
    began = expected = 0.0
    form: Any = None
    resampler: Any = None

    def flush() -> NDArray[np.int16]:
        pieces.extend(made.to_ndarray()[0] for made in resampler.resample(None))
        return np.concatenate(pieces) if pieces else np.zeros(0, np.int16)

    for frame in _frames(container, stream):
        time = expected if frame.pts is None else float(frame.pts * frame.time_base)
        now = (frame.sample_rate, frame.layout.name, frame.format.name)
        if resampler is None or abs(time - expected) > MAX_TIMESTAMP_ERROR_SECONDS or now != form:
            if resampler is not None:
                yield began, flush()
            pieces, form, began = [], now, time
            expected, resampler = time, av().AudioResampler(format="s16", layout="mono", rate=SAMPLE_RATE)
        pieces.extend(made.to_ndarray()[0] for made in resampler.resample(frame))
        expected += frame.samples / frame.sample_rate
    if resampler is not None:
        yield began, flush()


def _frames(container: Any, stream: Any) -> Iterator[Any]:
    """Frames of sound for as long as any can be decoded."""
    for packet in packets(container, stream, []):
        try:
            decoded = packet.decode()
        except av().FFmpegError:
            continue
        yield from decoded


Floats = NDArray[np.float64]


MIN_OVERLAP_SECONDS = 2.0  # Time that both must have recorded at once.


def sound_shift(
    a: Sound | None,
    b: Sound | None,
    *,
    fps: tuple[float, float] = (30.0, 30.0),
    max_shift: float | None = None,
    rate: float | None = None,
) -> Shift:
    """How the clock of one camera runs against that of another, by what their microphones heard."""
    missing = [which for which, one in zip("ab", (a, b), strict=True) if one is None]
    if a is None or b is None:
        return undecided_shift(fps, "sound", *(Notice(SoundNotice.NONE, 0.0, {"which": which}) for which in missing))
    dead = [Notice(SoundNotice.SILENT, 0.0, {"which": which}) for which, one in zip("ab", (a, b), strict=True) if one.silent]
    if dead:
        return undecided_shift(fps, "sound", *dead)
    search = SoundSearch(a, b, max_shift, 0.0 if rate is None else rate - 1, rate is None)
    if not search.lags.size:
        return undecided_shift(fps, "sound", Notice(SoundNotice.SHORT, MIN_OVERLAP_SECONDS))
    return search.shift(fps)


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
MAX_CHANCE = 1e-2  # Bound of the probability of such evidence at any shift by chance.
# Evidence for the best shift over another one: wrong answers to a metronome reach 1.9, right ones have 2.9 and more.
MIN_EVIDENCE_OVER_PEAK = 3.0
DISTANCE_SIGMA_METRES = 3.0  # How much nearer the sound is to one camera.
SPEED_OF_SOUND = 343.0  # Metres per second at 20 degrees.
LATENCY_SIGMA_SECONDS = 0.015  # Between sound and pictures of a file: three sigmas are the 45 ms of ITU-R BT.1359-1.
MAX_CURVE_POINTS = 20_000  # Points of the curve that are returned.


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

    def stretch_scores(self, peak: SoundPeak) -> Floats:
        """What each short stretch of a says for a shift; 0 where b recorded nothing."""
        one, two = self.a.coarse, self.b.coarse
        rows = np.arange(one.shape[1])
        other = rows + np.rint(peak.lag + peak.drift * (rows - self.middle)).astype(np.int64)
        there = (other >= 0) & (other < two.shape[1])
        products = np.zeros(len(rows))
        products[there] = np.einsum("kt,kt->t", one[:, there], two[:, other[there]])
        size = max(1, round(STRETCH_SECONDS / STEP_SECONDS))
        whole = np.pad(products, (0, -len(products) % size))
        return np.asarray(whole.reshape(-1, size).sum(axis=1), dtype=np.float64)

    def shift(self, fps: tuple[float, float]) -> Shift:
        """The best shift, and whether it is to be believed."""
        peaks = self.peaks()
        if not peaks:
            return undecided_shift(fps, "sound", Notice(SoundNotice.NOTHING, 0.0))
        said = [self.stretch_scores(one) for one in peaks]
        order = sorted(range(len(peaks)), key=lambda i: -evidence_ratio(said[i]))  # a score is of chance where the overlap is short
        peaks, said = [peaks[i] for i in order], [said[i] for i in order]
        best, strength = peaks[0], evidence_ratio(said[0])
        apart = [evidence_ratio(said[0] - other) for other in said[1:]]
        chance = len(self.lags) * len(self._drifts()) * math.exp(-(max(strength, 0.0) ** 2) / 2)
        rivals = sum(math.exp(-(max(value, 0.0) ** 2) / 2) for value in apart)
        fit = SoundFit(self, best)
        close = [one for one, value in zip(peaks[1:], apart, strict=True) if value < MIN_EVIDENCE_OVER_PEAK]
        limits = self._limits(best, chance, close)
        scores, _ = self.lag_scores
        lags = self.lags * STEP_SECONDS + self.between
        kept = _thin(lags, scores, MAX_CURVE_POINTS)
        return Shift(
            offset=fit.offset,
            sigma=math.sqrt(fit.sigma**2 + (DISTANCE_SIGMA_METRES / SPEED_OF_SOUND) ** 2 + LATENCY_SIGMA_SECONDS**2),
            rate=fit.rate,
            rate_sigma=fit.rate_sigma,
            confidence=1 / (1 + chance + rivals),
            peaks=torch.tensor([[self.seconds(one, fit.center), one.score] for one in peaks], dtype=torch.float64),
            method="sound",
            fps=fps,
            center=fit.center,
            lags=torch.from_numpy(kept[0]),
            scores=torch.from_numpy(kept[1]),
            status=status_from(limits),
            notices=limits,
        )

    def _limits(self, best: SoundPeak, chance: float, rivals: list[SoundPeak]) -> tuple[Notice, ...]:
        """Why the best shift is not to be believed."""
        if chance > MAX_CHANCE:
            return (Notice(SoundNotice.NOTHING, self.seconds(best)),)
        if rivals:
            said = ", ".join(f"{self.seconds(one):+.3f}" for one in rivals[:3])
            return (Notice(SoundNotice.REPEATED, self.seconds(best), {"rivals": said}),)
        return ()

    def seconds(self, peak: SoundPeak, center: float | None = None) -> float:
        """Between the clocks at a shift, in the middle of a or at a time of a's."""
        away = 0.0 if center is None else (center - self.a.first) / STEP_SECONDS - self.middle
        return (peak.lag + peak.drift * away) * STEP_SECONDS + self.between


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


class SoundFit:
    """Offset and rate about a peak, to a fraction of a millisecond."""

    def __init__(self, search: SoundSearch, peak: SoundPeak):
        self.search = search
        a, b = search.a, search.b
        self.between = search.between
        ends = [search.seconds(peak, a.first), search.seconds(peak, a.first + a.seconds)]
        low, high = max(a.first, b.first - ends[0]), min(a.first + a.seconds, b.first + b.seconds - ends[1])
        self.center = (low + high) / 2
        self.times, self.curves = self._pieces(peak, low, high)
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

    def _scores_along(self, place: float, slope: float) -> tuple[Floats, Floats, Floats]:
        """Score, slope and curvature of every piece's curve where offset and drift put it."""
        from scipy import ndimage

        at = (place - self._whole + slope * self.times) / HOP_SECONDS + (self.curves.shape[1] - 1) / 2
        rows = np.arange(len(at))
        values = [ndimage.map_coordinates(self.curves, [rows, at + off], order=3, mode="nearest") for off in (-1.0, 0.0, 1.0)]
        before, here, after = values
        return here, (after - before) / (2 * HOP_SECONDS), (after - 2 * here + before) / HOP_SECONDS**2

    def _derivatives(self, found: Floats, both: int) -> tuple[Floats, Floats, Floats]:
        """``(p,)`` scores of the pieces, their slopes ``(p, both)`` in seconds and drift, and the negative Hessian of the sum."""
        here, first, second = self._scores_along(float(found[0]), float(found[1]))
        design = np.stack([np.ones_like(self.times), self.times], axis=1)[:, :both]
        return here, design * first[:, None], -(design * second[:, None]).T @ design

    def _maximize(self, drift: float, free: bool) -> tuple[float, float, Floats]:
        """Seconds from the peak, drift, and the covariance of both: a grid, then Newton's steps while they go up."""
        reach = MIN_PEAK_SEPARATION_SECONDS / 2
        places = np.arange(-reach, reach + HOP_SECONDS / 2, HOP_SECONDS)
        half = max(float(np.abs(self.times).max()), HOP_SECONDS)
        near = min(MAX_RATE_DEVIATION, 2 * STEP_SECONDS / half)  # what the search before could not tell apart
        steps = drift + np.arange(-near, near + 1e-12, HOP_SECONDS / half) if free else np.array([drift])
        totals = [[float(self._scores_along(place, slope)[0].sum()) for place in places.tolist()] for slope in steps.tolist()]
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
            if self._scores_along(next_place, next_slope)[0].sum() < here.sum():
                break
            found = found + move
        return float(found[0]), float(found[1]), self._covariance(found, both)

    def _covariance(self, found: Floats, both: int) -> Floats:
        """``(2, 2)`` of seconds and drift."""
        _, slopes, hessian = self._derivatives(found, both)
        covariance = np.zeros((2, 2))
        covariance[0, 0] = MIN_PEAK_SEPARATION_SECONDS**2
        if np.linalg.eigvalsh(hessian).min() > 0:
            inverse = np.linalg.inv(hessian)
            covariance[:both, :both] = inverse @ (slopes.T @ slopes) @ inverse * len(slopes) / max(1, len(slopes) - both)
        covariance[0, 0] += (HOP_SECONDS / math.sqrt(12)) ** 2
        return covariance


# ----------------------------------------------------------------------------------------------------------------------
# A witness to what keypoints or pixels say.


def offset_difference(one: Shift, other: Shift) -> float:
    """Seconds that another result is later, in the middle of the first's overlap."""
    return float(other.at(one.center)) - float(one.at(one.center))


def check_by_sound(found: Shift, heard: Shift) -> Shift:
    """What keypoints or pixels say, with what the sound says to it: it agrees, contradicts (a refusal), or does not decide."""
    if not heard.ok:
        if all(notice.code is SoundNotice.NONE for notice in heard.notices):
            return found
        why = next((notice.text for notice in heard.notices if notice.code.refuses is not None), heard.reason)
        return dataclasses.replace(found, notices=(*found.notices, Notice(SoundNotice.OPEN, 0.0, {"why": why})))
    said = {"offset": f"{heard.at(heard.center) - heard.center:+.3f}", "sigma": f"{heard.sigma:.3f}"}
    if not found.ok:
        return dataclasses.replace(found, notices=(*found.notices, Notice(SoundNotice.ALONE, 0.0, said)))
    off = offset_difference(found, heard)
    if abs(off) <= SIGNIFICANCE_SIGMAS * math.hypot(found.sigma, heard.sigma):
        return dataclasses.replace(found, notices=(*found.notices, Notice(SoundNotice.AGREES, off)))
    said["found"] = f"{found.at(found.center) - found.center:+.3f}"
    said["own"] = f"{found.sigma:.3f}"
    limits = (Notice(SoundNotice.CONTRADICTS, off, said), *found.notices)
    return dataclasses.replace(found, status=status_from(limits), notices=limits)
