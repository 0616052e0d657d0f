"""The check video: what stands beside what, and that it is written whole or not at all."""

from __future__ import annotations

import io
from dataclasses import dataclass

import av
import numpy as np
import pytest

from indexing import Clip
from indexing.video import Chunk, drawing, read_video, write_check_video
from indexing.video.drawing import LARGER, STRIP, TIME_STRIP, WIDEST, Overlay, write_overlay


@pytest.fixture(autouse=True)
def low(monkeypatch):
    monkeypatch.setattr(drawing, "CHECK_HEIGHT", 96)


@dataclass
class Shifted:
    """b's clock = rate * a's clock + offset."""

    offset: float
    rate: float = 1.0

    def at(self, times):
        return np.asarray(times) * self.rate + self.offset

    def inverse(self, times):
        return (np.asarray(times) - self.offset) / self.rate


def ramp(count, width=128):
    """Grey frames whose brightness tells their number: 40 + 4 i."""
    return np.stack([np.full((96, width), 40 + 4 * i, np.uint8) for i in range(count)])


def numbers(path, split=None):
    """Which frames a check video shows, left and right."""
    frames = np.concatenate([chunk.frames for chunk in read_video(path)]).astype(float)[:, TIME_STRIP + 8 : -8]
    split = split or frames.shape[2] // 2
    levels = np.stack([np.median(frames[:, :, 10 : split - 10], (1, 2)), np.median(frames[:, :, split + 10 : -10], (1, 2))], 1)
    return np.rint((levels - 40) / 4).astype(int)


def test_b_stands_beside_a_at_the_shifted_time(write, tmp_path):
    a, b = write("a.mp4", ramp(30), fps=10), write("b.mp4", ramp(40), fps=20)
    out = write_check_video(tmp_path / "check.mp4", a, b, Shifted(0.5))
    seen = numbers(out)
    moments = np.arange(15) / 10  # b ends at 1.95 s, which a's clock calls 1.45
    np.testing.assert_allclose(seen[:, 0], np.rint(10 * moments), atol=1)
    np.testing.assert_allclose(seen[:, 1], np.rint(20 * (moments + 0.5)), atol=1)
    info = read_video(out).info
    assert info.fps == pytest.approx(10) and info.width % 2 == info.height % 2 == 0 and info.codec in ("h264", "mpeg4")


def test_only_what_both_recorded_is_shown(write, tmp_path):
    a, b = write("a.mp4", ramp(30), fps=10), write("b.mp4", ramp(30), fps=10)
    early = numbers(write_check_video(tmp_path / "c.mp4", a, b, Shifted(-1.0)))
    assert len(early) == 20 and early[0].tolist() == [10, 0]
    drift = write_check_video(tmp_path / "c.mp4", a, b, Shifted(0.0, rate=0.5))
    np.testing.assert_allclose(numbers(drift)[-1], [29, 14], atol=1)
    with pytest.raises(ValueError, match="no moment in common"):
        write_check_video(tmp_path / "none.mp4", a, b, Shifted(5.0))
    assert not (tmp_path / "none.mp4").exists()


def test_keypoints_are_drawn_as_figures(write, tmp_path):
    joints = np.random.default_rng(0).uniform(0, 100, (1, 17, 2)).repeat(20, 0)
    joints[5, 3] = np.nan
    joints[6] = np.nan
    clip = Clip(joints, fps=10, up="-y")
    out = write_check_video(tmp_path / "c.mp4", clip, write("b.mp4", ramp(20), fps=10), Shifted(0.0))
    frames = np.concatenate([chunk.frames for chunk in read_video(out)])
    split = frames.shape[2] - 128 - 4
    drawn = (frames[:, TIME_STRIP:, :split] < 200).mean((1, 2))
    assert (np.delete(drawn, 6) > 0.02).all() and drawn[6] < 0.002
    with pytest.raises(ValueError, match="is 3D"):
        write_check_video(tmp_path / "c.mp4", Clip(np.zeros((3, 17, 3))), clip, Shifted(0.0))
    with pytest.raises(ValueError, match="no joint in any frame"):
        write_check_video(tmp_path / "c.mp4", clip, Clip(np.full((3, 17, 2), np.nan)), Shifted(0.0))


def test_an_older_file_survives_what_cannot_be_written(write, tmp_path):
    a = write("a.mp4", ramp(10))
    old = tmp_path / "check.mp4"
    old.write_bytes(b"old")
    cut = tmp_path / "cut.mp4"
    cut.write_bytes(a.read_bytes()[:200])
    with pytest.raises(ValueError, match=r"cut\.mp4"):
        write_check_video(old, a, cut, Shifted(0.0))
    assert old.read_bytes() == b"old"
    with pytest.raises(ValueError, match="cannot write"):
        write_check_video(tmp_path / "no" / "such" / "folder.mp4", a, a, Shifted(0.0))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mp4", "check.mp4", "cut.mp4"]


RED, BLUE = (220, 40, 40), (40, 90, 220)


def overlay(views=6, size=(160.0, 120.0), frames=None):
    """A red track that goes to the right, a blue one that rests, and a stray one."""
    points = np.tile(np.array([[30.0, 30.0], [120.0, 90.0], [60.0, 100.0]]), (views, 1, 1))
    points[:, 0, 0] += 6 * np.arange(views)
    points[:2, 1] = np.nan
    frames = range(views) if frames is None else frames
    captions = [f"frame {k}" for k in frames]
    return Overlay(points, frames, size, np.array([1, 2, 0]), ["body 1 (static)", "körper 2"], [RED, BLUE], captions)


def gray(views, width=160, height=120):
    return [Chunk(np.full((views, height, width), 120, np.uint8), np.arange(float(views)))]


def decoded(data):
    with av.open(io.BytesIO(data)) as container:
        rate = float(container.streams.video[0].average_rate)
        return [frame.to_ndarray(format="rgb24").astype(int) for frame in container.decode(video=0)], rate


def test_what_is_drawn_and_where():
    frames, rate = decoded(write_overlay(gray(6), overlay(), 12.0))
    assert len(frames) == 6 and rate == pytest.approx(12, abs=0.1)
    assert frames[0].shape == (120 * LARGER + STRIP, 160 * LARGER, 3)
    first, last = frames[0], frames[-1]
    assert np.ptp(first[60, 60]) > 60 and first[60, 60].argmax() == 0  # the red one, where it is
    assert last[60, 120].argmax() == 0 and np.ptp(last[60, 120]) > 60 and np.ptp(last[60, 100]) > 30  # and its tail
    assert np.ptp(first[180, 240]) < 30 and last[180, 240].argmax() == 2  # the blue one is not there at first
    assert last[-STRIP:].max() > 150 and np.ptp(last[150, 40]) < 25  # the legend; and gray where nothing is


def test_only_the_frames_taken_are_written_and_large_ones_are_made_smaller():
    frames, rate = decoded(write_overlay(gray(9, 1301, 651), overlay(3, (1301.0, 651.0), (0, 4, 8)), 1.0))
    assert len(frames) == 3 and rate == pytest.approx(8, abs=0.1)
    assert frames[0].shape[1] == WIDEST and frames[0].shape[0] % 2 == 0
    with pytest.raises(ValueError, match="the video has no frame 5, in which points are to be drawn; give the one"):
        write_overlay(gray(5), overlay())
