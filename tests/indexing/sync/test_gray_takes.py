"""What is accepted as a video: arrays, streams, colours; and what is not."""

import numpy as np
import pytest
import torch

from indexing.sync.brightness_features import MAX_IMAGE_SIDE, read_gray_video

FRAMES = np.random.default_rng(0).integers(0, 256, (50, 24, 32), dtype=np.uint8)


def chunks(frames, size=7, times=None):
    for begin in range(0, len(frames), size):
        part = frames[begin : begin + size]
        yield part if times is None else (part, times[begin : begin + size])


def test_arrays_and_streams_are_the_same_take():
    times = np.arange(50) / 25 + 3
    whole = read_gray_video(FRAMES, "a", fps=25.0)
    assert torch.equal(whole.frames, torch.from_numpy(FRAMES)) and whole.fps == pytest.approx(25)
    for source in (chunks(FRAMES), list(chunks(FRAMES)), iter(torch.from_numpy(FRAMES))):
        assert torch.equal(read_gray_video(source, "a", fps=25.0).frames, whole.frames)
    stamped = read_gray_video(chunks(FRAMES, times=times), "a")
    assert torch.equal(stamped.frames, whole.frames) and stamped.times.tolist() == times.tolist()


def test_floats_and_colours_become_grey_levels():
    for source in (FRAMES / 255, FRAMES.astype(np.float32), np.repeat(FRAMES[..., None], 3, axis=3)):
        found = read_gray_video(source, "a", fps=30.0).frames.int() - torch.from_numpy(FRAMES).int()
        assert found.abs().max() <= 1  # rounding


def test_large_frames_become_small():
    frames = np.repeat(np.repeat(FRAMES[:20], 40, axis=1), 40, axis=2)  # 1280 px wide
    small = read_gray_video(chunks(frames), "a", fps=30.0)
    assert small.frames.shape[2] == MAX_IMAGE_SIDE and small.scale == MAX_IMAGE_SIDE / 1280
    assert torch.equal(small.frames[:, 5::10, 5::10], torch.from_numpy(FRAMES[:20]))


def hole():
    frames = FRAMES / 255
    frames[3, 2, 1] = np.nan
    return frames


BAD = {
    "19 frames; at least 20": (FRAMES[:19], {}),
    "0 frames": (FRAMES[:0], {}),
    "NaN": (hole(), {}),
    r"frames of shape \(24, 32, 4\)": (np.zeros((50, 24, 32, 4), np.uint8), {}),
    r"array of shape \(50, 24\)": (FRAMES[..., 0], {}),
    "got str": ("video.mp4", {}),
    "got int": (3, {}),
    "convert them to uint8": (FRAMES.astype(np.int32), {}),
    "grey levels from": (FRAMES.astype(float) * 3, {}),
    "too small": (FRAMES[:, :3], {}),
    "neither fps nor times": (FRAMES, {"fps": None}),
    "fps must be": (FRAMES, {"fps": -3.0}),
    r"one per frame, \(50,\)": (FRAMES, {"times": np.arange(49.0)}),
    "must be finite and increase": (FRAMES, {"times": np.zeros(50)}),
    "frame 30 has": ([FRAMES[:30], FRAMES[:, :20]], {}),
    "has 2 times": ([(FRAMES, np.arange(2.0))], {}),
}


@pytest.mark.parametrize("words", BAD)
def test_bad_videos_are_named(words):
    source, options = BAD[words]
    with pytest.raises(ValueError, match=words):
        read_gray_video(source, "a", **({"fps": 30.0} | options))
