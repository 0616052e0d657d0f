"""What microphones recorded: read from any container, on the clock of the pictures, as envelopes of bands of pitch."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from indexing.sync.sound import sound_shift
from indexing.sync.soundtrack import Sound, phase_transform, read_sound
from indexing.sync.synchronize import synchronize
from tests.indexing.sync.footage import RATE, microphone, noises, write_film

STARTS = (3.0, 7.4321)  # seconds of the scene at which two cameras begin
LATER = STARTS[0] - STARTS[1]


@pytest.fixture(scope="module")
def scene() -> np.ndarray:
    return noises(40.0, 1)


def test_what_is_no_sound_is_refused():
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
