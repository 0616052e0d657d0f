"""What the microphone of a camera recorded, and its envelopes: when it gets loud, and at which pitch.

Reverberation, automatic gain and the electronics make another waveform of the same sound.  So it is cut into bands of pitch, the
logarithm of the energy in each is taken over time (its envelope), and the phase transform makes every rate of change count alike.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing.opening import size_of
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
    def coarse_energy(self) -> Signal:
        """:attr:`energy`, ``STEP_SECONDS`` seconds apart."""
        return block_means(self.energy, round(STEP_SECONDS / HOP_SECONDS))

    @cached_property
    def coarse(self) -> Signal:
        """:attr:`fine`, ``STEP_SECONDS`` seconds apart."""
        return self._envelopes(self.coarse_energy, STEP_SECONDS)

    def _envelopes(self, energy: Signal, step: float) -> Signal:
        if not energy.shape[1]:
            return energy
        quiet = np.quantile(energy, 0.5, axis=1, keepdims=True) + 1e-9 * energy.max() + np.finfo(np.float32).tiny
        return phase_transform(np.log(energy + quiet), 1 / step, SPECTRUM_SMOOTHING_HERTZ, MIN_MODULATION_HERTZ)


def block_means(values: Signal, many: int) -> Signal:
    """Of each ``many`` frames. values ``(k, n)`` -> ``(k, n // many)``."""
    whole = values[:, : values.shape[1] // many * many]
    return np.asarray(whole.reshape(len(whole), -1, many).mean(axis=2), dtype=np.float32)


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
