"""Clocks from sound: right to a millisecond; refused where it is silent, repeats itself or is another; a witness to pictures."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from indexing.sync.sound import check_by_sound, decision_model, offset_difference, sound_shift
from indexing.sync.soundtrack import Sound
from tests.indexing.sync.footage import RATE, clicks, microphone, noises
from tests.indexing.sync.scene import shift, told

STARTS = (3.0, 7.4321)  # seconds of the scene at which two cameras begin
LATER = STARTS[0] - STARTS[1]


def heard(scene: np.ndarray, start: float, seconds: float = 25.0, seed: int = 0, noise: float = 0.01) -> Sound:
    return Sound(microphone(scene, start, seconds, seed, noise), RATE)


@pytest.fixture(scope="module")
def scene() -> np.ndarray:
    return noises(40.0, 1)


# ---- what is found -------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_two_microphones_agree_to_a_millisecond(scene):
    first, second = heard(scene, STARTS[0], 18.0), heard(scene, STARTS[1], 18.0, seed=1)
    found = sound_shift(first, second)
    assert found.ok and found.method == "sound" and found.confidence > 0.99 and found.rate == 1
    assert found.offset == pytest.approx(LATER, abs=1e-3)
    assert abs(found.offset - LATER) < 3 * found.sigma < 5e-3 and "one recording that was played in two takes" in found.notes[0]
    assert found.peaks[0, 0].item() == pytest.approx(LATER, abs=0.02) and (found.peaks[1:, 1] < found.peaks[0, 1]).all()
    assert found.lags[found.scores.argmax()].item() == pytest.approx(LATER, abs=0.02)


@pytest.mark.slow
def test_starts_rates_types_and_levels_may_differ(scene):
    first, second = heard(scene, STARTS[0]), heard(scene, STARTS[1], seed=1)
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
    model = decision_model()  # a figure counts within the range that it was learned in
    assert model.against(dict(zip(model.names, model.usual, strict=True)) | {"dynamics": 1e9, "coherence": -5.0})[0] == "coherence"


@pytest.mark.slow
def test_a_metronome_is_refused_and_says_why():
    click = clicks(40.0)
    found = sound_shift(heard(click, 3.0, noise=1e-3), heard(click, 7.1, seed=1, noise=1e-3))
    assert not found.ok and found.confidence < 0.9
    for period in (2.0, 4.0):  # a longer overlap is no evidence
        loop = np.tile(noises(period, 3), int(40 / period))
        found = [sound_shift(heard(loop, 1.0), heard(loop, 1.0 + late, seed=1)) for late in (0.3, 3.3)]
        assert not any(one.ok for one in found) and all("the sound repeats itself" in one.reason for one in found)


@pytest.mark.slow
def test_what_one_microphone_hears_alone_speaks_against_one_event():
    music, people = noises(30.0, 1), [noises(30.0, seed) for seed in (2, 3)]
    takes = [Sound(microphone(music + other, 2.0 + i, 25.0, i), RATE) for i, other in enumerate(people)]
    together = [Sound(microphone(music + people[0], 2.0 + i, 25.0, i), RATE) for i in range(2)]
    event, replay = sound_shift(*together), sound_shift(*takes)
    assert event.ok and event.offset == pytest.approx(-1.0, abs=2e-3) and replay.confidence < event.confidence
    found = sound_shift(*takes, risk=1 - (event.confidence + replay.confidence) / 2)
    assert not found.ok and "loud at one microphone only" in found.reason and found.offset == pytest.approx(-1.0, abs=5e-3)


def test_the_decision_is_that_of_its_table(scene):
    pair = heard(scene, STARTS[0]), heard(scene, STARTS[1], seed=1)
    sure = sound_shift(*pair).confidence
    assert sound_shift(*pair, risk=1.001 - sure).ok and not sound_shift(*pair, risk=(1 - sure) / 2).ok
    with pytest.raises(ValueError, match="risk must lie between 0 and 1, got 0"):
        sound_shift(*pair, risk=0.0)


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


# ---- a witness -----------------------------------------------------------------------------------------------------------
def test_a_witness_agrees_contradicts_or_says_nothing():
    sure = shift(-0.4, sigma=0.002)
    sound = dataclasses.replace(shift(-0.39, method="sound"), sigma=0.001)  # sound and pictures are 17 ms apart, or less
    found = check_by_sound(sure, sound)
    assert found.ok and found.offset == -0.4 and found.notes == ("sound agrees: +0.010 s",)
    doubtful = [dataclasses.replace(one, confidence=0.75) for one in (sure, sound)]
    assert check_by_sound(*doubtful).confidence == pytest.approx(0.9)  # odds of 3, twice
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
