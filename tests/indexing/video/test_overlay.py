"""Tracks drawn over a video: what is in the file, where, and what is refused."""

from __future__ import annotations

import io

import av
import numpy as np
import pytest

from indexing.video import Chunk
from indexing.video.drawing import LARGER, STRIP, WIDEST, Overlay, write_overlay

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


def test_a_video_that_ends_too_early_is_refused():
    with pytest.raises(ValueError, match="the video has no frame 5, in which points are to be drawn; give the one"):
        write_overlay(gray(5), overlay())
