"""Two microphones in one room: how near the clocks are that their sound tells, what is believed, and what else is believed.

    python -m experiments.synchronization.sound
    python -m experiments.synchronization.sound --quick
    python -m experiments.synchronization.sound --write     (trains the decision: indexing/sync/sound_decision.json)

A source (claps, speech-like noise in syllables, steps, music of random notes on a steady beat, steady noise; music with claps,
steps or speech in the same room) is heard by two microphones at 1 to 6 metres, each with its own reverberation (.2 to .8 s; direct
sound 12 dB below to 6 dB above it), frequency response, level, noise at 20, 10, 0 or -5 dB, clipped or not, and clock: up to 50 ppm
off, up to 20 s (a third of the recording) later or earlier, for 10 to 60 s.  Traps are music that repeats 4 to 32 notes, a
metronome, one recording that is played in two takes with other claps, steps or speech (20 dB below the music to as loud), one
score that is played twice, sounds that have nothing in common, hum of the mains, and sound that runs backwards.

The decision and the sigma of rooms are learned from seeds from ``TRAINING`` on; the figures are of others.  In training, one
recording in two takes weighs ``TWICE``: it is one pair of a hundred with music.
"""

from __future__ import annotations

import datetime
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import indexing.sync.sound
from experiments.common.decisions import calibration_error, reliability_diagram, train, write
from experiments.common.runner import Grid, SceneConfig, Tables, experiment
from experiments.common.tables import Row
from indexing.sync.sound import SoundFit, SoundSearch, sound_shift
from indexing.sync.soundtrack import Sound

Floats = NDArray[np.float64]
HERTZ = 16_000  # at which sounds are made
NOISES = (20, 10, 0, -5)  # decibels of the sound over the noise
SECONDS = (10, 20, 40, 60)  # of a recording
APART = 20.0  # seconds between the starts, at most
DRIFT = 50e-6  # between the clocks, at most
SPEED = 343.0  # metres per second
RIGHT = 0.05  # seconds within which an offset is right: far from other peaks, however blunt a room makes this one
TRAINING, TRAINING_SCENES = 1_000_000, 60  # first seed, and pairs per kind
TWICE = 0.02
STRENGTH = 100.0  # 1 / ridge of the regression
TABLE = Path(indexing.sync.sound.__file__).with_name("sound_decision.json")


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


def music(rng: np.random.Generator, seconds: float, notes: int = 0) -> Floats:
    """Random notes of a scale, and a drum on every beat; they repeat themselves after a number of notes."""
    return _played(rng, _score(rng, seconds, notes), seconds, 30 / rng.uniform(90, 140), 0.0)


def _score(rng: np.random.Generator, seconds: float, notes: int) -> list[tuple[float, float, float]]:
    """Hertz (0: none), length and loudness of every half beat."""
    many = notes or int(seconds * 5)
    hertz = 220 * 2 ** (rng.choice([0, 2, 4, 7, 9, 12, 14, 16], many) / 12) * (rng.random(many) < 0.7)
    return list(zip(hertz.tolist(), rng.choice([1, 2, 4], many).tolist(), rng.uniform(0.3, 1, many).tolist(), strict=True))


def _played(
    rng: np.random.Generator, score: list[tuple[float, float, float]], seconds: float, half: float, jitter: float
) -> Floats:
    """A score, half a beat after the other, each some seconds early or late."""
    made, drum = np.zeros(int(seconds * HERTZ)), _burst(rng, 0.01)
    for number in range(int((seconds - 3) / half)):
        at = max(0, int((number * half + jitter * rng.normal()) * HERTZ))
        hertz, length, loud = score[number % len(score)]
        if hertz:
            moments = np.arange(int(length * half * HERTZ)) / HERTZ
            tone = sum(np.sin(2 * np.pi * hertz * k * moments) / k for k in range(1, 6)) * np.exp(-moments / 0.3)
            made[at : at + len(moments)] += loud * tone * np.minimum(1, moments / 0.005)
        if number % 2 == 0:
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


Source = Callable[[np.random.Generator, float], Floats]
LIVE: dict[str, Source] = {"claps": claps, "speech": speech, "steps": steps}
SOURCES: dict[str, Source] = {**LIVE, "music": music, "noise": lambda rng, seconds: rng.normal(size=int(seconds * HERTZ))}
SINGLE: dict[str, Source] = {
    **SOURCES, "metronome": metronome, "loop": lambda rng, seconds: music(rng, seconds, int(rng.integers(4, min(33, int(seconds)))))
}  # fmt: skip
GOOD = (*SOURCES, "music and people")
TRAPS = ("loop", "metronome", "recording in two takes", "score played twice", "unrelated", "hum", "backwards")


def chosen(rng: np.random.Generator, sources: dict[str, Source]) -> Source:
    """One of them."""
    return list(sources.values())[int(rng.integers(len(sources)))]


def sources_of(kind: str, rng: np.random.Generator, seconds: float) -> tuple[list[Floats], list[Floats]]:
    """What sounds in the room of each microphone, the first with the power 1 and the others by their levels."""
    if kind in SINGLE:
        return ([unit(SINGLE[kind](rng, seconds))],) * 2
    if kind == "hum":
        moments, hertz = np.arange(int(seconds * HERTZ)) / HERTZ, rng.choice([50, 60])
        hums = [sum(np.sin(2 * np.pi * (hertz * k * moments + rng.random())) / k for k in range(1, 12)) for _ in "ab"]
        return [unit(hums[0])], [unit(hums[1])]
    if kind == "score played twice":
        score, half = _score(rng, seconds, 0), 30 / rng.uniform(90, 140)
        return tuple([unit(_played(rng, score, seconds, half * rng.uniform(0.99, 1.01), 0.01))] for _ in "ab")  # type: ignore[return-value]
    if kind in ("unrelated", "backwards"):
        one = chosen(rng, SOURCES)
        first, other = one(rng, seconds), (one if rng.random() < 0.5 else chosen(rng, SOURCES))
        return [unit(first)], [unit(first[::-1] if kind == "backwards" else other(rng, seconds))]
    song, level, live = unit(music(rng, seconds)), 10 ** (rng.uniform(-20, 0) / 20), chosen(rng, LIVE)
    people = [level * unit(live(rng, seconds)) for _ in "ab"]
    return [song, people[0]], [song, people[1 if kind == "recording in two takes" else 0]]


def unit(sound: Floats) -> Floats:
    """The same with the power 1."""
    return np.asarray(sound / np.sqrt((sound**2).mean()))


def room(rng: np.random.Generator, distance: float) -> Floats:
    """What a microphone hears of a click: the direct sound, then the room."""
    n = int(rng.uniform(0.2, 0.8) * HERTZ)
    tail = rng.normal(size=n) * np.exp(-6.9 * np.arange(n) / n)
    tail[: int(0.002 * HERTZ)] = 0
    tail *= 10 ** (-rng.uniform(-12, 6) / 20) / np.linalg.norm(tail)
    return np.concatenate([np.zeros(int(distance / SPEED * HERTZ)), [1.0], tail])


def recorded(rng: np.random.Generator, heard: Floats, start: float, seconds: float, decibels: float, drift: float) -> Sound:
    """What a microphone makes of a sound from ``start`` on."""
    from scipy import signal

    edges = np.concatenate([[0], np.sort(rng.uniform(0.01, 0.9, 5)), [1]])
    heard = signal.fftconvolve(heard, signal.firwin2(257, edges, 10 ** (rng.uniform(-10, 6, 7) / 20)), mode="same")
    heard = unit(np.pad(heard[int(start * HERTZ) :], (0, HERTZ))[: int((seconds + 1) * HERTZ)])
    white = rng.normal(size=len(heard))
    colour = signal.butter(1, rng.uniform(300, 3000) / (HERTZ / 2), output="sos")
    heard = heard + 10 ** (-decibels / 20) * unit(signal.sosfilt(colour, white) + 0.1 * white)
    limit = rng.choice([np.inf, np.inf, np.inf, 2.0, 1.0]) * heard.std()  # two of five are clipped
    made = np.interp(np.arange(int(seconds * HERTZ)) / (1 + drift), np.arange(len(heard)), heard.clip(-limit, limit))
    return Sound(np.round(made * 10 ** (rng.uniform(-30, -6) / 20) / np.abs(made).max() * 32767).astype(np.int16), HERTZ)


class Pair(NamedTuple):
    """Two recordings; b's time = rate * a's + offset, told by the arrival of the direct sound."""

    a: Sound
    b: Sound
    offset: float
    rate: float
    seconds: int
    decibels: int


def pair(kind: str, seed: int) -> Pair:
    """Two recordings of one sound, or of what is taken for one."""
    from scipy import signal

    rng = np.random.default_rng([seed, (*GOOD, *TRAPS).index(kind)])
    seconds, decibels = int(rng.choice(SECONDS)), int(rng.choice(NOISES))
    most = min(APART, seconds / 3)
    apart, drift = rng.uniform(-most, most), rng.uniform(-DRIFT, DRIFT)
    starts, distances = (max(0.0, -apart), max(0.0, apart)), rng.uniform(1, 6, (2, 2))
    sounds = []
    for sources, start, gained, away in zip(
        sources_of(kind, rng, seconds + abs(apart) + 2), starts, (0.0, drift), distances, strict=True
    ):
        parts = [signal.fftconvolve(one, room(rng, far))[: len(one)] for one, far in zip(sources, away, strict=False)]
        sounds.append(recorded(rng, sum(parts), start, seconds, decibels, gained))
    later = (starts[0] - starts[1]) * (1 + drift) + float(distances[1, 0] - distances[0, 0]) / SPEED
    return Pair(sounds[0], sounds[1], later, 1 + drift, seconds, decibels)


@dataclass(frozen=True)
class Trial:
    """What was said of a pair, and what is true."""

    kind: str
    seconds: int
    error: float  # seconds, in the middle of the overlap
    right: bool
    ok: bool
    confidence: float
    sigma: float
    took: float  # seconds, the envelopes known


@cache
def trial(kind: str, seed: int) -> Trial:
    """Of the whole verb."""
    one = pair(kind, seed)
    for sound in (one.a, one.b):
        sound.fine, sound.coarse  # noqa: B018
    began = time.process_time()
    found = sound_shift(one.a, one.b)
    took = time.process_time() - began
    error = float(found.at(found.center)) - (found.center * one.rate + one.offset)
    right = kind in GOOD and abs(error) <= RIGHT
    return Trial(kind, one.seconds, error, right, bool(found.ok), found.confidence, found.sigma, took)


def training(scenes: int) -> list[Row]:
    """Learn the decision and write it; what the models of the other folds say."""
    figures, right, groups, weights = [], [], [], []
    for seed in range(TRAINING, TRAINING + scenes):
        for kind in (*GOOD, *TRAPS):
            one = pair(kind, seed)
            search = SoundSearch(one.a, one.b, None, 0.0, True)
            peaks, said = search.rank_peaks()
            fit = SoundFit(search, peaks[0])
            error = fit.offset + fit.rate * fit.center - (fit.center * one.rate + one.offset)
            figures.append(search.figures(peaks, said))
            right.append(kind in GOOD and abs(error) <= RIGHT)
            groups.append(seed)
            weights.append(TWICE if kind == "recording in two takes" else 1.0)
    names, rights, share = list(figures[0]), np.array(right, dtype=np.bool_), np.array(weights)
    values = np.array([[one[name] for name in names] for one in figures])
    learned = train(names, values, rights, groups, share, strength=STRENGTH)
    command = "python -m experiments.synchronization.sound --write"
    write(TABLE, f"{datetime.date.today()}, {len(rights)} pairs, {command}", {"offset": learned.table})
    return [
        Row("right", f"{len(rights)} pairs", float(rights.mean())),
        Row(
            "calibration error of the other folds", f"{len(rights)} pairs", calibration_error(learned.probabilities, rights, share)
        ),
    ]


def decisions(trials: list[Trial]) -> list[Row]:
    """What is believed, kind by kind."""
    rows = []
    for kind in (*GOOD, *TRAPS):
        mine = [one for one in trials if one.kind == kind]
        wrong = sum(one.ok and not one.right for one in mine)
        goal = None if kind == "recording in two takes" else 0.0
        rows += [
            Row("believed", f"{kind}, {len(mine)} pairs", float(np.mean([one.ok for one in mine]))),
            Row("believed and wrong", f"{kind}, {len(mine)} pairs", float(wrong), goal, at_most=True),
        ]
    return rows


def share_believed(trials: list[Trial], kind: str, length: int) -> float:
    """Of the recordings of a length; NaN where there are none."""
    mine = [one.ok for one in trials if (one.kind, one.seconds) == (kind, length)]
    return sum(mine) / len(mine) if mine else np.nan


def accuracy(trials: list[Trial]) -> list[Row]:
    """Errors and sigmas of what is believed and right, of one source: several are at several distances."""
    rows = []
    for kind in (*SOURCES, "all"):
        mine = [one for one in trials if one.ok and one.right and (one.kind == kind or (kind == "all" and one.kind in SOURCES))]
        errors, setting = np.array([abs(one.error) for one in mine]), f"{kind}, {len(mine)} pairs"
        over = errors / np.array([one.sigma for one in mine])
        goals = (0.68 - 0.08, 0.95 - 0.04) if kind == "all" else (None, None)
        rows += [
            Row("error, median", setting, 1e3 * float(np.median(errors)), unit=" ms"),
            Row("error, worst", setting, 1e3 * float(errors.max()), unit=" ms"),
            Row("within 1 sigma", setting, float((over < 1).mean()), goals[0]),
            Row("within 2 sigma", setting, float((over < 2).mean()), goals[1]),
        ]
    return rows


@dataclass(frozen=True)
class SoundConfig(SceneConfig):
    """An experiment on made-up recordings."""

    write: bool = False
    """Train the decision on seeds of its own, write its table, and measure nothing."""


@experiment(SoundConfig(scenes=30, seed=100), quick={"scenes": 5})
def tables(config: SoundConfig) -> Tables:
    """Made-up recordings, so many pairs per kind of sound."""
    if config.write:
        yield "training", training(TRAINING_SCENES)
        return
    trials = [trial(kind, config.seed + i) for kind in (*GOOD, *TRAPS) for i in range(config.scenes)]
    yield "decisions", decisions(trials)
    shares = {kind: [share_believed(trials, kind, length) for length in SECONDS] for kind in GOOD}
    yield "believed, by the length of the recordings", Grid([f"{length} s" for length in SECONDS], shares)
    yield "errors of what is believed", accuracy(trials)
    counted = [one for one in trials if one.kind != "recording in two takes"]
    told, right = np.array([one.confidence for one in counted]), np.array([one.right for one in counted])
    took = [np.array([one.took for one in trials if one.ok == ok and one.seconds == SECONDS[-1]]).mean() for ok in (True, False)]
    yield (
        "confidence and time",
        [
            Row("calibration error", f"{len(counted)} pairs, without recordings in two takes", calibration_error(told, right)),
            Row("seconds, pairs that are believed", f"{SECONDS[-1]} s", float(took[0]), unit=" s"),
            Row("refusal over believed", f"{SECONDS[-1]} s", float(took[1] / took[0]), 1.5, at_most=True),
        ],
    )
    yield "sound-reliability", reliability_diagram({"sound": (told, right)})
