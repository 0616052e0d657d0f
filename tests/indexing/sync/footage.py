"""Tiny videos with sound: every frame shows the number of the moment that it was taken at, and the microphones hear one scene."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

RATE = 16_000
BITS, BLOCK = 12, 8  # of the painted number, and pixels of a digit's side


def noises(seconds: float, seed: int = 0) -> NDArray[np.float64]:
    """Claps at uneven moments, and somebody who speaks: noise in syllables."""
    rng = np.random.default_rng(seed)
    made = np.zeros(round(seconds * RATE))
    for at in rng.integers(0, len(made) - 800, int(2 * seconds)):
        made[at : at + 800] += rng.normal(size=800) * np.exp(-np.arange(800) / 120) * rng.uniform(0.3, 1)
    syllables = np.repeat(rng.uniform(0, 0.1, int(5 * seconds) + 1) * (rng.random(int(5 * seconds) + 1) < 0.6), RATE // 5)
    return made + rng.normal(size=len(made)) * syllables[: len(made)]


def clicks(seconds: float, period: float = 0.5) -> NDArray[np.float64]:
    """A metronome."""
    made = np.zeros(round(seconds * RATE))
    click = np.sin(2 * np.pi * 1500 * np.arange(300) / RATE) * np.exp(-np.arange(300) / 60)
    for at in range(0, len(made) - 300, round(period * RATE)):
        made[at : at + 300] += click
    return made


def microphone(scene: NDArray[np.float64], start: float, seconds: float, seed: int, noise: float = 0.01) -> NDArray[np.int16]:
    """What one hears from ``start`` on: its own room and noise."""
    rng = np.random.default_rng(seed)
    room = np.concatenate([[1.0], rng.normal(size=3000) * np.exp(-np.arange(3000) / 500) * 0.1])
    size = len(scene) + len(room) - 1
    heard = np.fft.irfft(np.fft.rfft(scene, size) * np.fft.rfft(room, size), size)[round(start * RATE) :][: round(seconds * RATE)]
    heard = heard + noise * rng.normal(size=len(heard))
    return np.round(heard / np.abs(heard).max() * rng.uniform(3e3, 2e4)).astype(np.int16)


def painted(number: int) -> NDArray[np.uint8]:
    """A picture that shows a number as white and black blocks."""
    digits = [255 * (number >> bit & 1) for bit in range(BITS)]
    return np.repeat(np.repeat(np.array([digits], np.uint8), 3 * BLOCK, axis=0), BLOCK, axis=1)


def number_in(image: NDArray[np.uint8]) -> int:
    """The number that a gray picture shows."""
    row = image[image.shape[0] // 2].reshape(BITS, -1)[:, 2:-2].mean(axis=1)
    return sum(1 << bit for bit, value in enumerate(row) if value > 128)


def write_film(
    path: Path, numbers: NDArray[np.int64], fps: float, sound: NDArray[np.int16] | None = None, delay: float = 0.0
) -> Path:
    """An MP4 of pictures that show these numbers, with sound that begins ``delay`` seconds after the first of them."""
    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as file:
        exact = Fraction(fps).limit_denominator(1001)
        stream = file.add_stream("mpeg4", rate=exact, options={"qscale": "2"})
        stream.width, stream.height, stream.pix_fmt = BITS * BLOCK, 3 * BLOCK, "yuv420p"
        track = None
        if sound is not None:
            track = file.add_stream("aac", rate=RATE, layout="mono")
        for number in numbers.tolist():
            image = np.repeat(painted(number)[..., None], 3, axis=2)
            file.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        file.mux(stream.encode())
        if track is not None and sound is not None:
            for begin in range(0, len(sound), 1024):
                frame = av.AudioFrame.from_ndarray(sound[None, begin : begin + 1024], format="s16", layout="mono")
                frame.sample_rate, frame.pts, frame.time_base = RATE, begin + round(delay * RATE), Fraction(1, RATE)
                file.mux(track.encode(frame))
            file.mux(track.encode())
    return path


def numbers_of(path: Path) -> list[int]:
    """The numbers that a video's frames show."""
    from indexing.video import read_video

    return [number_in(image) for chunk in read_video(path) for image in chunk.frames]
