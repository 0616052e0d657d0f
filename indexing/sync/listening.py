"""What a camera's microphone recorded: the sound of a video on the clock of its pictures, and how loud it is at which pitch."""

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

from indexing.sync.options import SoundOptions

Signal = NDArray[np.float32]
CHUNK = 20_000  # spectra at once: 20 MB


@dataclass(frozen=True, eq=False)
class Sound:
    """What a camera's microphone recorded. samples ``(n,)``."""

    samples: NDArray[Any]
    rate: float
    start: float = 0.0
    options: SoundOptions = SoundOptions()

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
        return loudest / scale < self.options.quiet

    @property
    def first(self) -> float:
        """Seconds of the middle of the first frame of :attr:`energy`."""
        return self.start + self.options.window / 2

    @cached_property
    def energy(self) -> Signal:
        """``(bands, frames)`` energy of each band of pitch, ``options.hop`` seconds apart."""
        from scipy import fft, signal

        made = self.samples.astype(np.float32) / (32768.0 if self.samples.dtype.kind == "i" else 1.0)
        hertz = self.options.samples
        if self.rate != hertz:
            share = math.gcd(round(self.rate), hertz)
            made = signal.resample_poly(made, hertz // share, round(self.rate) // share).astype(np.float32)
        hop, width = round(self.options.hop * hertz), round(self.options.window * hertz)
        if len(made) < width:
            return np.zeros((self.options.bands, 0), np.float32)
        cut = np.lib.stride_tricks.sliding_window_view(made, width)[::hop]
        size = fft.next_fast_len(2 * width, real=True)
        pitch = fft.rfftfreq(size, 1 / hertz)
        edges = np.geomspace(self.options.lowest, self.options.highest, self.options.bands + 1)
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
        """``(bands, frames)`` envelopes of unit variance whose changes count alike at every rate, ``options.hop`` apart."""
        return self._envelopes(self.energy, self.options.hop)

    @cached_property
    def coarse(self) -> Signal:
        """The same, ``options.step`` seconds apart."""
        many = round(self.options.step / self.options.hop)
        whole = self.energy[:, : self.energy.shape[1] // many * many]
        return self._envelopes(whole.reshape(len(whole), -1, many).mean(axis=2), self.options.step)

    def _envelopes(self, energy: Signal, step: float) -> Signal:
        if not energy.shape[1]:
            return energy
        quiet = np.quantile(energy, 0.5, axis=1, keepdims=True) + 1e-9 * energy.max() + np.finfo(np.float32).tiny
        return flattened(np.log(energy + quiet), 1 / step, self.options.smooth, self.options.slowest)


def flattened(curves: Signal, rate: float, smooth: float, slowest: float) -> Signal:
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


def hear(path: str | Path, options: SoundOptions = SoundOptions()) -> Sound | None:
    """The sound of a video, on the clock of its pictures; None where it has none."""
    from indexing.opening import size_of

    path = Path(path).expanduser()
    try:
        changed = path.stat().st_mtime_ns, size_of(path)
    except (OSError, ValueError):
        changed = (0, 0)  # opening it says what is wrong
    return _heard(path, changed, options)


@lru_cache(maxsize=16)
def _heard(path: Path, changed: tuple[int, int], options: SoundOptions) -> Sound | None:
    from indexing.video.reading import opened

    with opened(path) as (container, pictures):
        streams = [stream for stream in container.streams.audio if stream.codec_context is not None]
        if not streams:
            return None
        zero = float((pictures.start_time or 0) * pictures.time_base)
        parts = list(_stretches(container, streams[0], options))
    if not parts:
        return None
    start = min(began for began, _ in parts)
    end = max(began + len(piece) / options.samples for began, piece in parts)
    samples = np.zeros(math.ceil((end - start) * options.samples) + 1, np.int16)
    for began, piece in parts:
        at = round((began - start) * options.samples)
        samples[at : at + len(piece)] = piece[: len(samples) - at]
    return Sound(samples, float(options.samples), start - zero, options)


def _stretches(container: Any, stream: Any, options: SoundOptions) -> Iterator[tuple[float, NDArray[np.int16]]]:
    """When each stretch of sound without a gap begins, and its samples at the rate of the options."""
    from indexing.video.reading import av

    pieces: list[NDArray[np.int16]] = []
    began = expected = 0.0
    form: Any = None
    resampler: Any = None

    def closed() -> NDArray[np.int16]:
        pieces.extend(made.to_ndarray()[0] for made in resampler.resample(None))
        return np.concatenate(pieces) if pieces else np.zeros(0, np.int16)

    for frame in _frames(container, stream):
        time = expected if frame.pts is None else float(frame.pts * frame.time_base)
        now = (frame.sample_rate, frame.layout.name, frame.format.name)
        if resampler is None or abs(time - expected) > options.gap or now != form:
            if resampler is not None:
                yield began, closed()
            pieces, form, began = [], now, time
            expected, resampler = time, av().AudioResampler(format="s16", layout="mono", rate=options.samples)
        pieces.extend(made.to_ndarray()[0] for made in resampler.resample(frame))
        expected += frame.samples / frame.sample_rate
    if resampler is not None:
        yield began, closed()


def _frames(container: Any, stream: Any) -> Iterator[Any]:
    """Frames of sound for as long as any can be decoded."""
    from indexing.video.reading import av, packets

    for packet in packets(container, stream, []):
        try:
            decoded = packet.decode()
        except av().FFmpegError:
            continue
        yield from decoded
