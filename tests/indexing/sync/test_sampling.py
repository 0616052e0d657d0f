"""Takes on a common grid: rates, blends, gaps."""

import math

import numpy as np
import pytest
import torch

from indexing.brightness.footage import Resampler
from indexing.sync.brightness_features import KERNEL_HALF_FRAMES, common_rate, read_gray_video, sample


def whole(source):
    height, width = source.frames.shape[1:]
    return torch.tensor([[width / 2, height / 2, 60.0]], dtype=torch.float64).expand(len(source.frames), 3)


def test_rate_is_the_slower_or_a_fraction(films):
    takes = {fps: read_gray_video(films[0], "a", fps=fps) for fps in (10.0, 25.0, 60.0, 120.0)}
    assert common_rate(takes[25.0], takes[60.0]) == pytest.approx(25)
    assert common_rate(takes[120.0], takes[60.0]) == pytest.approx(30)
    assert common_rate(takes[10.0], takes[10.0]) == pytest.approx(10)


def test_blocks_do_not_show(films, monkeypatch):
    source = read_gray_video(films[0][:80], "a", fps=30.0)
    found = sample(source, whole(source), 30.0)
    assert found.profile.shape == (80, 18) and found.kernels.shape[0] == 80 - 2 * KERNEL_HALF_FRAMES
    monkeypatch.setattr("indexing.sync.brightness_features.PROFILE_BLOCK", 1000)
    once = sample(source, whole(source), 30.0)
    assert torch.allclose(found.kernels, once.kernels, atol=1e-5)
    cosine = torch.nn.functional.cosine_similarity(found.profile, once.profile)
    assert cosine.min() > 0.98  # the noise level is taken from 32 frames at a time


def test_half_rate_is_every_second_frame(films):
    fast = read_gray_video(films[0], "a", fps=60.0)
    slow = read_gray_video(films[0][::2], "a", fps=30.0)
    one, two = (sample(each, whole(each), 30.0) for each in (fast, slow))
    assert torch.allclose(one.profile, two.profile) and torch.allclose(one.kernels, two.kernels)


def test_gaps_are_missing(films):
    keep = torch.cat([torch.arange(60), torch.arange(66, 150)])
    source = read_gray_video(films[0][keep], "a", times=keep / 30.0)
    found = sample(source, whole(source), 30.0)
    known = found.profile.isfinite().all(1)
    assert len(found.profile) == 150 and not known[60:66].any() and known[:58].all() and known[68:].all()
    assert found.kernels[:40].isfinite().all() and found.kernels[50:55].isnan().all()


def test_backwards_twice_is_forwards(films):
    source = read_gray_video(films[0][:40], "a", fps=30.0)
    found = sample(source, whole(source), 30.0)
    twice = found.backwards().backwards()
    assert torch.equal(twice.profile, found.profile) and torch.equal(twice.kernels, found.kernels)


@pytest.mark.parametrize("gap", [60.0, 2.6e6, 1e9])
def test_nothing_is_made_up_for_a_pause_of_any_length(gap):
    frames = torch.arange(20.0)[:, None, None].expand(20, 2, 2)
    times = np.arange(20) / 25 + np.where(np.arange(20) < 10, 0.0, gap)
    grid, counts = Resampler(10.0, math.nan).push(frames, times)
    assert len(grid) <= 10 and counts[-1] == len(grid)
    before = grid[grid[:, 0, 0] < 9.5]
    assert len(before) == 4 and grid.max() <= 19 and not ((grid > 9.01) & (grid < 9.99)).any()
