"""Two microphones in one room: how near the clocks are that their sound tells, what is believed, and what else is believed.

    python -m experiments.synchronization.sound
    python -m experiments.synchronization.sound --quick

A source (claps, speech-like noise in syllables, steps, music of random notes on a steady beat, a metronome) is heard by two
microphones at 1 to 6 metres, each with its own reverberation (.2 to .8 s; direct sound 3 dB below to 6 dB above it), frequency
response, level, noise at 10, 0 or -5 dB, and clock: one at 48 kHz, the other at 44.1 kHz and up to 50 ppm off, up to 20 s later or
earlier.  Recordings last 60 s where nothing else is said.  *Unrelated* pairs are microphones that heard different sounds of one
kind, or of two; none of them may be believed.  Seeds below 100 chose the constants of ``indexing.sync.sound``; the
figures are of others.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dyntorch import Shift
from experiments.common.runner import SceneConfig, Tables, experiment
from experiments.common.tables import Row
from indexing.sync.sound import Sound, sound_shift

Floats = NDArray[np.float64]
HERTZ = 48_000  # at which sounds are made
RATES = (48_000, 44_100)  # of the two recordings
NOISES = (10, 0, -5)  # decibels of the sound over the noise
LONG = 60.0  # seconds of a recording
SHORTER = (5.0, 10.0, 20.0)
APART = 20.0  # seconds between the starts, at most
DRIFT = 50e-6  # between the clocks, at most
SPEED = 343.0  # metres per second
RIGHT = 0.02  # seconds within which an offset is right: less than a frame


def _spots(rng: np.random.Generator, seconds: float, gap: Callable[[], float]) -> list[int]:
    """Samples at which something begins."""
    found, time = [], gap() * rng.random()
    while time < seconds - 0.5:
        found.append(int(time * HERTZ))
        time += gap()
    return found


def _burst(rng: np.random.Generator, decay: float) -> Floats:
    n = int(8 * decay * HERTZ)
    return np.asarray(rng.normal(size=n) * np.exp(-np.arange(n) / (decay * HERTZ)))


def claps(rng: np.random.Generator, seconds: float) -> Floats:
    """At uneven moments, about one a second."""
    made = np.zeros(int(seconds * HERTZ))
    for at in _spots(rng, seconds, lambda: rng.exponential(0.8) + 0.15):
        one = _burst(rng, 0.004)
        made[at : at + len(one)] += rng.uniform(0.3, 1) * one
    return made


def steps(rng: np.random.Generator, seconds: float) -> Floats:
    """Somebody who walks, and rests now and then."""
    from scipy import signal

    made = np.zeros(int(seconds * HERTZ))
    for at in _spots(rng, seconds, lambda: 0.55 * rng.uniform(0.93, 1.07) + (rng.exponential(3) if rng.random() < 0.1 else 0)):
        one = _burst(rng, 0.015)
        made[at : at + len(one)] += rng.uniform(0.2, 1) * one
    low = signal.butter(2, 1200 / (HERTZ / 2), output="sos")
    return np.asarray(signal.sosfilt(low, made))


def speech(rng: np.random.Generator, seconds: float) -> Floats:
    """Syllables of a voice or of hisses, through random formants, with pauses."""
    from scipy import signal

    made, time = np.zeros(int(seconds * HERTZ)), 0.0
    while time < seconds - 0.5:
        length = rng.uniform(0.08, 0.25)
        at, n = int(time * HERTZ), int(length * HERTZ)
        pitch = rng.uniform(100, 220) * (1 + 0.1 * np.linspace(0, rng.normal(), n))
        one = signal.sawtooth(2 * np.pi * np.cumsum(pitch) / HERTZ) if rng.random() < 0.7 else rng.normal(size=n)
        for _ in range(2):
            peak = signal.tf2sos(*signal.iirpeak(rng.uniform(300, 3000) / (HERTZ / 2), 4))
            one = 0.3 * one + signal.sosfilt(peak, one)
        made[at : at + n] += np.hanning(n) ** 0.7 * rng.uniform(0.2, 1) * one / one.std()
        time += length * rng.uniform(0.7, 1.1) + (rng.exponential(0.6) if rng.random() < 0.15 else 0)
    return made


def music(rng: np.random.Generator, seconds: float) -> Floats:
    """Random notes of a scale, and a drum on every beat."""
    made, beat = np.zeros(int(seconds * HERTZ)), 60 / rng.uniform(90, 140)
    scale = np.array([0, 2, 4, 7, 9, 12, 14, 16])
    for number in range(int((seconds - 3) / beat * 2)):
        at = int(number * beat / 2 * HERTZ)
        if rng.random() < 0.7:
            time = np.arange(int(rng.choice([0.5, 1, 2]) * beat * HERTZ)) / HERTZ
            pitch = 220 * 2 ** (rng.choice(scale) / 12)
            tone = sum(np.sin(2 * np.pi * pitch * k * time) / k for k in range(1, 6)) * np.exp(-time / 0.3)
            made[at : at + len(time)] += rng.uniform(0.3, 1) * tone * np.minimum(1, time / 0.005)
        if number % 2 == 0:
            drum = _burst(rng, 0.01)
            made[at : at + len(drum)] += 0.5 * drum
    return made


def metronome(rng: np.random.Generator, seconds: float) -> Floats:
    """One click every half second, from before both recordings to after them."""
    made = np.zeros(int(seconds * HERTZ))
    time = np.arange(int(0.02 * HERTZ)) / HERTZ
    click = np.sin(2 * np.pi * 1500 * time) * np.exp(-time / 0.004)
    for at in range(int(rng.uniform(0, 0.5) * HERTZ), len(made) - len(click), HERTZ // 2):
        made[at : at + len(click)] += click
    return made


SOURCES: dict[str, Callable[[np.random.Generator, float], Floats]] = {
    "claps": claps, "speech": speech, "steps": steps, "music": music, "metronome": metronome,
}  # fmt: skip


def room(rng: np.random.Generator, distance: float) -> Floats:
    """What a microphone hears of a click: the direct sound, then the room."""
    n = int(rng.uniform(0.2, 0.8) * HERTZ)
    tail = rng.normal(size=n) * np.exp(-6.9 * np.arange(n) / n)
    tail[: int(0.002 * HERTZ)] = 0
    tail *= 10 ** (-rng.uniform(-3, 6) / 20) / np.linalg.norm(tail)
    return np.concatenate([np.zeros(int(distance / SPEED * HERTZ)), [1.0], tail])


def recorded(
    rng: np.random.Generator,
    source: Floats,
    start: float,
    seconds: float,
    decibels: float,
    rate: int,
    drift: float,
    distance: float,
) -> NDArray[np.int16]:
    """What a microphone makes of a sound from ``start`` on."""
    from scipy import signal

    heard = signal.fftconvolve(source, room(rng, distance))[: len(source)]
    edges = np.concatenate([[0], np.sort(rng.uniform(0.01, 0.9, 5)), [1]])
    heard = signal.fftconvolve(heard, signal.firwin2(257, edges, 10 ** (rng.uniform(-10, 6, 7) / 20)), mode="same")
    heard = np.pad(heard[int(start * HERTZ) :], (0, HERTZ))[: int((seconds + 1) * HERTZ)]
    power = float((heard[: int(seconds * HERTZ)] ** 2).mean())
    white = rng.normal(size=len(heard))
    colour = signal.butter(1, rng.uniform(300, 3000) / (HERTZ / 2), output="sos")
    noise = signal.sosfilt(colour, white) + 0.1 * white
    heard = heard + noise * np.sqrt(power * 10 ** (-decibels / 10) / (noise**2).mean())
    if rate < HERTZ:
        heard = signal.fftconvolve(heard, signal.firwin(101, 0.9 * rate / HERTZ), mode="same")
    moments = np.arange(int(seconds * rate)) / (rate * (1 + drift)) * HERTZ
    made = np.interp(moments, np.arange(len(heard)), heard)
    return np.round(made * 10 ** (rng.uniform(-30, -6) / 20) / np.abs(made).max() * 32767).astype(np.int16)


class Pair(NamedTuple):
    """Two recordings; b's time = rate * a's + offset, told by the arrival of the direct sound."""

    a: Sound
    b: Sound
    offset: float
    rate: float


@cache
def pair(kind: str, decibels: float, seed: int, seconds: float = LONG) -> Pair:
    """Two recordings of one sound."""
    rng = np.random.default_rng([seed, sorted(SOURCES).index(kind), int(decibels) + 100])
    most = min(APART, seconds / 3)
    apart, drift = rng.uniform(-most, most), rng.uniform(-DRIFT, DRIFT)
    starts, distances = (max(0.0, -apart), max(0.0, apart)), rng.uniform(1, 6, 2)
    source = SOURCES[kind](rng, seconds + abs(apart) + 2)
    sounds = [
        Sound(recorded(rng, source, start, seconds, decibels, rate, gained, distance), rate)
        for start, distance, rate, gained in zip(starts, distances, RATES, (0.0, drift), strict=True)
    ]
    later = (starts[0] - starts[1]) * (1 + drift) + float(distances[1] - distances[0]) / SPEED
    for sound in sounds:
        sound.energy  # noqa: B018  (kept, and the samples are not needed again)
    return Pair(_without_samples(sounds[0]), _without_samples(sounds[1]), later, 1 + drift)


def _without_samples(sound: Sound) -> Sound:
    """The same, in a hundredth of the memory: what is compared is its energy."""
    kept = Sound(np.full(len(sound.samples), 1, np.int8).astype(np.int16) * int(not sound.silent) * 1000, sound.rate)
    kept.__dict__["energy"] = sound.energy
    return kept


def off(found: Shift, truth: Pair) -> float:
    """Seconds that an answer is off in the middle of the overlap."""
    return float(found.at(found.center)) - (found.center * truth.rate + truth.offset)


def together(config: SceneConfig, kind: str) -> list[Row]:
    """Pairs that heard one sound."""
    rows = []
    for decibels in NOISES:
        pairs = [pair(kind, decibels, config.seed + i) for i in range(config.scenes)]
        found = [sound_shift(one.a, one.b) for one in pairs]
        errors = np.array([off(shift, one) for shift, one in zip(found, pairs, strict=True)])
        believed = np.array([bool(shift.ok) for shift in found])
        setting = f"{len(pairs)} pairs, {decibels:+d} dB"
        rows += [
            Row("believed", setting, float(believed.mean())),
            Row("wrong among the believed", setting, float((believed & (np.abs(errors) > RIGHT)).sum()), 0.0, at_most=True),
        ]
        if believed.any():
            good = [i for i in range(len(found)) if believed[i]]
            rates = [1e6 * abs(found[i].rate - pairs[i].rate) for i in good]
            rows += [
                Row("error, median", setting, 1e3 * float(np.median(np.abs(errors[good]))), unit=" ms"),
                Row("error, worst", setting, 1e3 * float(np.abs(errors[good]).max()), unit=" ms"),
                Row("rate, median error", setting, float(np.median(rates)), unit=" ppm"),
            ]
    return rows


def shorter(config: SceneConfig) -> list[Row]:
    """Pairs of shorter recordings, which overlap by two thirds at least."""
    rows = []
    for seconds in SHORTER:
        for kind in ("claps", "speech", "steps", "music"):
            pairs = [pair(kind, NOISES[0], config.seed + i, seconds) for i in range(config.scenes)]
            found = [sound_shift(one.a, one.b) for one in pairs]
            wrong = sum(bool(shift.ok) and abs(off(shift, one)) > RIGHT for shift, one in zip(found, pairs, strict=True))
            setting = f"{kind}, {len(pairs)} pairs of {seconds:g} s, {NOISES[0]:+d} dB"
            rows += [
                Row("believed", setting, float(np.mean([shift.ok for shift in found]))),
                Row("wrong among the believed", setting, float(wrong), 0.0, at_most=True),
            ]
    return rows


def unrelated(config: SceneConfig) -> list[Row]:
    """Microphones that heard different things."""
    rows, many, kinds = [], config.scenes, list(SOURCES)
    for seconds in (LONG, SHORTER[1]):
        for name, others in (("one kind of sound", [0]), ("two kinds", [1, 2])):
            believed = tried = 0
            for number, kind in enumerate(kinds):
                for i in range(many):
                    for step in others:
                        first = pair(kind, NOISES[0], config.seed + i, seconds)
                        second = pair(kinds[(number + step) % len(kinds)], NOISES[0], config.seed + (i + 1) % many, seconds)
                        believed += bool(sound_shift(first.a, second.b).ok)
                        tried += 1
            rows.append(Row("believed", f"{tried} pairs of {seconds:g} s, {name}", float(believed), 0.0, at_most=True))
    return rows


@experiment(SceneConfig(scenes=20, seed=100), quick={"scenes": 5})
def tables(config: SceneConfig) -> Tables:
    """Made-up recordings, so many pairs per kind of sound and level of noise; seeds below 100 were used to choose constants."""
    for kind in SOURCES:
        yield kind, together(config, kind)
    yield "shorter recordings", shorter(config)
    yield "unrelated", unrelated(config)
