"""Clocks from sound: right to a millisecond; refused where it is silent, repeats itself or is another; a witness to pictures."""

from __future__ import annotations

import dataclasses
from fractions import Fraction

import numpy as np
import pytest

from indexing.sync.sound import Sound, check_by_sound, offset_difference, phase_transform, read_sound, sound_shift
from indexing.sync.synchronize import synchronize
from tests.indexing.sync.footage import RATE, clicks, microphone, noises, write_film
from tests.indexing.sync.scene import shift, told

STARTS = (3.0, 7.4321)  # seconds of the scene at which two cameras begin
LATER = STARTS[0] - STARTS[1]


def heard(scene: np.ndarray, start: float, seconds: float = 25.0, seed: int = 0, noise: float = 0.01) -> Sound:
    return Sound(microphone(scene, start, seconds, seed, noise), RATE)


@pytest.fixture(scope="module")
def scene() -> np.ndarray:
    return noises(40.0, 1)


# ---- what is found -------------------------------------------------------------------------------------------------------
def test_two_microphones_agree_to_a_millisecond(scene):
    first, second = heard(scene, STARTS[0]), heard(scene, STARTS[1], seed=1)
    found = sound_shift(first, second)
    assert found.ok and found.method == "sound" and found.confidence > 0.99 and found.rate == 1
    assert found.offset == pytest.approx(LATER, abs=1e-3)
    assert found.sigma == pytest.approx(np.hypot(0.015, 3 / 343), rel=0.05)  # distance and latency, not the fit, are what is unsure
    assert found.peaks[0, 0].item() == pytest.approx(LATER, abs=0.02) and (found.peaks[1:, 1] < found.peaks[0, 1]).all()
    assert found.lags[found.scores.argmax()].item() == pytest.approx(LATER, abs=0.02)
    # the starts on the clocks of the pictures count
    assert sound_shift(dataclasses.replace(first, start=0.25), second).offset == pytest.approx(LATER - 0.25, abs=1e-3)
    half = Sound((first.samples[::2] / 32768).astype(np.float32), RATE / 2)  # another rate, and another type of samples
    assert sound_shift(half, second).offset == pytest.approx(LATER, abs=2e-3)
    loud, quiet = heard(scene, STARTS[0], noise=0.1), heard(scene, STARTS[1], seed=1, noise=0.1)
    found = sound_shift(loud, dataclasses.replace(quiet, samples=quiet.samples // 50))
    assert found.ok and found.offset == pytest.approx(LATER, abs=3e-3)


@pytest.mark.slow
def test_a_clock_that_drifts(scene, monkeypatch):
    gained = 1 + 1.5e-4
    second = microphone(scene, STARTS[1], 30.0, 1)
    slower = np.interp(np.arange(int(28 * RATE)) / gained, np.arange(len(second)), second).astype(np.int16)
    pair = heard(scene, STARTS[0], 36.0), Sound(slower, RATE)
    found = sound_shift(*pair)
    assert found.at(found.center) == pytest.approx(gained * (found.center + LATER), abs=1e-3)
    monkeypatch.setattr("indexing.sync.sound.MIN_SECONDS_FOR_RATE", 10.0)
    short, held = sound_shift(*pair), sound_shift(*pair, rate=1.0)
    assert short.rate == pytest.approx(gained, abs=4 * short.rate_sigma) and 0 < short.rate_sigma < 5e-5
    assert held.rate == 1 and held.rate_sigma == 0
    scene = noises(140.0, 4)  # a long one, whose ends are many steps apart
    slower = np.interp(np.arange(int(130 * RATE)) / gained, np.arange(len(scene)), scene)
    found = sound_shift(Sound(scene.astype(np.float32), RATE), Sound(slower.astype(np.float32), RATE))
    assert found.ok and found.rate == pytest.approx(gained, abs=5e-6) and found.offset == pytest.approx(0.0, abs=1e-3)


@pytest.mark.slow
def test_max_shift_bounds_the_search(scene):
    pair = heard(scene, STARTS[0]), heard(scene, STARTS[1], seed=1)
    assert sound_shift(*pair, max_shift=4.5).offset == pytest.approx(LATER, abs=1e-3)
    found = sound_shift(*pair, max_shift=3.0)
    assert not found.ok and found.lags.abs().max() <= 3.0
    nothing = sound_shift(dataclasses.replace(pair[0], start=100.0), pair[1], max_shift=3.0)
    assert not nothing.ok and "overlap by less than 2 s" in nothing.reason


# ---- what is refused -----------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_unrelated_sounds_are_refused():
    sounds = [heard(noises(12.0, 10 + seed), 0.0, 10.0, seed) for seed in range(6)]
    found = [sound_shift(a, b) for i, a in enumerate(sounds) for b in sounds[:i]]
    assert not any(one.ok for one in found) and all("no shift of the sound stands out" in one.reason for one in found)


@pytest.mark.slow
def test_a_metronome_is_refused_and_says_why():
    click = clicks(40.0)
    found = sound_shift(heard(click, 3.0, noise=1e-3), heard(click, 7.1, seed=1, noise=1e-3))
    assert not found.ok and found.confidence < 0.9
    regular = noises(2.0, 3)
    loop = np.tile(regular, 15)
    found = sound_shift(heard(loop, 1.0), heard(loop, 4.3, seed=1))
    assert not found.ok and "the sound repeats itself" in found.reason


def test_silence_no_sound_and_one_clap(scene):
    speaking, off = heard(scene, 3.0), Sound(np.zeros(25 * RATE, np.int16), RATE)
    assert "the sound of b is silence" in sound_shift(speaking, off).reason.replace("camera ", "")
    assert "has no sound" in sound_shift(None, speaking).reason and off.silent and not speaking.silent
    assert not sound_shift(speaking, Sound(np.full(50, 900, np.int16), RATE)).ok  # a few milliseconds
    made = []
    for at in (4.0, 7.0):  # one clap fits any other clap
        samples = np.random.default_rng(int(at)).normal(size=12 * RATE) * 1e-3
        samples[int(at * RATE) :][:500] += np.random.default_rng(9).normal(size=500)
        made.append(Sound(samples.astype(np.float32), RATE))
    assert not sound_shift(*made).ok
    with pytest.raises(ValueError, match=r"one channel \(n,\) of numbers, got shape \(3, 2\)"):
        Sound(np.zeros((3, 2)), RATE)
    with pytest.raises(ValueError, match="positive number of samples per second, got 0"):
        Sound(np.zeros(3), 0)


def test_the_phase_transform_makes_every_rate_of_change_count_alike():
    curves = np.random.default_rng(0).normal(size=(2, 3000)).cumsum(axis=1).astype(np.float32)
    made = phase_transform(curves, 100.0, 1.0, 0.5)
    power = np.abs(np.fft.rfft(made, axis=1)) ** 2
    slow, fast = power[:, 30:300].mean(), power[:, 900:1400].mean()  # 1 to 10 Hz, 30 to 47 Hz
    assert slow == pytest.approx(fast, rel=0.6) and power[:, :10].mean() < 0.15 * slow
    assert not phase_transform(np.ones((1, 500), np.float32), 100.0, 1.0, 0.5).any()


# ---- from files ----------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def films(tmp_path_factory: pytest.TempPathFactory, scene):
    pytest.importorskip("av")
    folder = tmp_path_factory.mktemp("films")
    for i, (name, start) in enumerate(zip("ab", STARTS, strict=True)):
        numbers = np.arange(90)
        write_film(folder / f"{name}.mp4", numbers, 30.0, microphone(scene, start, 20.0, i))
    write_film(folder / "late.mp4", np.arange(90), 30.0, microphone(scene, STARTS[1] + 0.5, 20.0, 5), delay=0.5)
    write_film(folder / "mute.mp4", np.arange(90), 30.0)
    return folder


@pytest.mark.slow
def test_sound_is_placed_on_the_clock_of_the_pictures(films):
    a, b, late = (read_sound(films / f"{name}.mp4") for name in ("a", "b", "late"))
    assert a is not None and b is not None and late is not None
    assert a.seconds == pytest.approx(20.0, abs=0.1) and a.rate == RATE and late.start == pytest.approx(0.5, abs=0.07)
    assert sound_shift(a, b).offset == pytest.approx(LATER, abs=2e-3)
    assert sound_shift(a, late).offset == pytest.approx(LATER, abs=2e-3)
    assert read_sound(films / "mute.mp4") is None and read_sound(films / "a.mp4") is a  # heard once


def write_sound(path, samples, rate, codec, layout="stereo", gap=0.0):
    """Pictures, and sound of two channels that stops for ``gap`` seconds in the middle."""
    import av

    with av.open(str(path), "w") as file:
        stream = file.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        track = file.add_stream(codec, rate=rate, layout=layout)
        for _ in range(20):
            file.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8), format="rgb24")))
        file.mux(stream.encode())
        for begin in range(0, len(samples), 960):
            part = np.repeat(samples[begin : begin + 960], 2)[None]
            frame = av.AudioFrame.from_ndarray(part, format="s16", layout="stereo")
            late = round(gap * rate) if begin >= len(samples) // 2 else 0
            frame.sample_rate, frame.pts, frame.time_base = rate, begin + late, Fraction(1, rate)
            file.mux(track.encode(frame))
        file.mux(track.encode())
    return path


CONTAINERS = [
    ("b.mkv", "libopus", 48_000, 0.005),
    ("b.mov", "pcm_s16le", 44_100, 0.005),
    ("b.avi", "mp3", 44_100, 0.03),  # does not say that an encoder of MP3 is 25 ms late
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "codec", "rate", "off"), CONTAINERS)
def test_other_containers_and_codecs(films, scene, tmp_path, name, codec, rate, off):
    import av

    if codec not in av.codecs_available:
        pytest.skip(f"FFmpeg has no {codec}")
    samples = microphone(scene, STARTS[1], 15.0, 1)
    wide = np.interp(np.arange(int(15 * rate)) * RATE / rate, np.arange(len(samples)), samples).astype(np.int16)
    heard_b = read_sound(write_sound(tmp_path / name, wide, rate, codec))
    assert sound_shift(read_sound(films / "a.mp4"), heard_b).offset == pytest.approx(LATER, abs=off)


def test_a_gap_in_the_sound_keeps_its_length(tmp_path):
    samples = np.random.default_rng(0).normal(size=10 * RATE) * 3000
    found = read_sound(write_sound(tmp_path / "gap.mkv", samples.astype(np.int16), RATE, "pcm_s16le", gap=2.0))
    assert found is not None and found.seconds == pytest.approx(12.0, abs=0.1)
    quiet = np.abs(found.samples[int(5.2 * RATE) : int(6.8 * RATE)].astype(int)).max()
    assert quiet == 0 and np.abs(found.samples[int(7.2 * RATE) :].astype(int)).max() > 3000


def test_videos_by_sound_alone(films):
    found = synchronize(films / "a.mp4", films / "b.mp4", "sound")
    assert found.ok and found.offset == pytest.approx(LATER, abs=2e-3) and found.fps == pytest.approx((30.0, 30.0))
    mute = synchronize(films / "a.mp4", films / "mute.mp4", "sound")
    assert not mute.ok and "mute has no sound" in mute.reason
    with pytest.raises(ValueError, match=r"is no video, and method='sound' needs their sound"):
        synchronize(np.ones((30, 5, 2)), np.ones((30, 5, 2)), "sound", fps=30.0)


# ---- a witness -----------------------------------------------------------------------------------------------------------
def test_a_witness_agrees_contradicts_or_says_nothing():
    sure = shift(-0.4, sigma=0.002)
    sound = dataclasses.replace(shift(-0.39, method="sound"), sigma=0.017)
    found = check_by_sound(sure, sound)
    assert found.ok and found.offset == -0.4 and found.notes == ("sound agrees: +0.010 s",)
    assert offset_difference(sure, sound) == pytest.approx(0.01)
    away = dataclasses.replace(sound, offset=0.7)
    found = check_by_sound(sure, away)
    assert not found.ok and "the sound says +0.700 ± 0.017 s, and the pictures say -0.400 ± 0.002 s" in found.reason
    assert "method='sound'" in found.reason and "sound=False" in found.reason and found.offset == -0.4
    open_ = dataclasses.replace(sure, **told({"ok": False, "reason": "periodic"}))
    found = check_by_sound(open_, sound)
    assert not found.ok and found.reason == "periodic" and "the sound says -0.390 ± 0.017 s" in found.notes[-1]
    unsure = dataclasses.replace(sound, **told({"ok": False, "reason": "too quiet"}))
    assert check_by_sound(sure, unsure).ok and check_by_sound(sure, unsure).notes == ("the sound does not decide: too quiet",)
    assert check_by_sound(sure, sound_shift(None, None)) is sure
