"""Takes on a common grid: rates, blends, gaps."""

import math

import numpy as np
import pytest
import torch
from torch.nn.functional import interpolate

from indexing.brightness.descriptors import blur, gradients, weighted_differences
from indexing.brightness.videos import Resampler
from indexing.sync import brightness_features as features
from indexing.sync.brightness_features import (
    CROP_SIDE,
    KERNEL_BLUR,
    KERNEL_HALF_FRAMES,
    MAX_IMAGE_SIDE,
    NUM_BANDS,
    PROFILE_BLUR,
    PROFILE_NOISE_RATIO,
    boxes,
    common_rate,
    crop,
    kernel_descriptors,
    motion,
    read_gray_video,
    reversed_profile,
    row_profile,
    sample,
    whiten,
    window_kernels,
)


def whole(source):
    height, width = source.frames.shape[1:]
    return torch.tensor([[width / 2, height / 2, 60.0]], dtype=torch.float64).expand(len(source.frames), 3)


def test_blocks_do_not_show_and_half_rate_is_every_second_frame(films, monkeypatch):
    source = read_gray_video(films[0][:80], "a", fps=30.0)
    fast = read_gray_video(films[0][:80].repeat(2, axis=0), "a", fps=60.0)
    found, half = (sample(each, whole(each), 30.0) for each in (source, fast))
    assert torch.allclose(half.profile, found.profile) and torch.allclose(half.kernels, found.kernels)
    assert found.profile.shape == (80, 18) and found.kernels.shape[0] == 80 - 2 * KERNEL_HALF_FRAMES
    monkeypatch.setattr("indexing.sync.brightness_features.PROFILE_BLOCK", 1000)
    once = sample(source, whole(source), 30.0)
    assert torch.allclose(found.kernels, once.kernels, atol=1e-5)
    cosine = torch.nn.functional.cosine_similarity(found.profile, once.profile)
    assert cosine.min() > 0.98  # the noise level is taken from 32 frames at a time
    twice = once.backwards().backwards()
    assert torch.equal(twice.profile, once.profile) and torch.equal(twice.kernels, once.kernels)
    takes = {fps: read_gray_video(films[0][:30], "a", fps=fps) for fps in (10.0, 25.0, 60.0, 120.0)}
    for one, other, rate in ((25.0, 60.0, 25), (120.0, 60.0, 30), (10.0, 10.0, 10)):  # the slower one, or a fraction
        assert common_rate(takes[one], takes[other]) == pytest.approx(rate)


def test_gaps_are_missing(films):
    keep = torch.cat([torch.arange(60), torch.arange(66, 150)])
    source = read_gray_video(films[0][keep], "a", times=keep / 30.0)
    found = sample(source, whole(source), 30.0)
    known = found.profile.isfinite().all(1)
    assert len(found.profile) == 150 and not known[60:66].any() and known[:58].all() and known[68:].all()
    assert found.kernels[:40].isfinite().all() and found.kernels[50:55].isnan().all()


@pytest.mark.parametrize("gap", [60.0, 2.6e6, 1e9])
def test_nothing_is_made_up_for_a_pause_of_any_length(gap):
    frames = torch.arange(20.0)[:, None, None].expand(20, 2, 2)
    times = np.arange(20) / 25 + np.where(np.arange(20) < 10, 0.0, gap)
    grid, counts = Resampler(10.0, math.nan).push(frames, times)
    assert len(grid) <= 10 and counts[-1] == len(grid)
    before = grid[grid[:, 0, 0] < 9.5]
    assert len(before) == 4 and grid.max() <= 19 and not ((grid > 9.01) & (grid < 9.99)).any()


# The window kernel against its definition in loops.


def by_loops(crops, tau, half, patch, rows):
    b = blur(crops, KERNEL_BLUR).double().numpy()
    gx, gy = np.zeros_like(b[tau]), np.zeros_like(b[tau])
    gx[:, 1:-1], gy[1:-1] = (b[tau][:, 2:] - b[tau][:, :-2]) / 2, (b[tau][2:] - b[tau][:-2]) / 2
    h, energy = [], []
    for y in range(0, b.shape[1] // patch * patch, patch):
        for x in range(0, b.shape[2] // patch * patch, patch):
            cell = (slice(y, y + patch), slice(x, x + patch))
            for slope in (gx[cell], gy[cell]):
                h.append([(slope * (b[t][cell] - b[tau][cell])).sum() for t in range(tau - half, tau + half + 1)])
                energy.append((slope**2).sum())
    h = np.array(h) / np.sqrt(np.array(energy) + 0.05 * max(energy))[:, None]
    h = h[np.argsort(-(h**2).sum(axis=1))[:rows]]
    h = h - h.mean(axis=1, keepdims=True)
    return h.T @ h / np.trace(h.T @ h)


def test_kernel_is_its_definition(films, rng):
    crops = torch.from_numpy(films[0][:20, 10:50, 20:60]).float() / 255
    found = window_kernels(crops, half=3, patch=7, rows=20)
    assert found.shape == (14, 7, 7)
    for tau in (3, 10, 16):
        assert np.allclose(found[tau - 3].numpy(), by_loops(crops, tau, 3, 7, 20), atol=1e-5)
    assert window_kernels(torch.rand(9, 30, 30)).shape[0] == 0 and window_kernels(torch.full((25, 30, 30), 0.5)).abs().max() == 0
    h = torch.from_numpy(rng.normal(size=(40, 12, 5)))
    kernels = h.mT @ h
    kernels[3] = torch.nan
    one, two = kernel_descriptors(kernels[:25], kernels[25:])
    assert one.shape == (25, 25) and two.shape == (15, 25) and (one[3] == 0).all()
    assert torch.allclose(two.norm(dim=1), torch.ones(15, dtype=torch.float64))


# The row-band profile by loops, played backwards, and whitened.


def test_profile_is_the_mean_motion_per_band_and_backwards_that_of_the_backwards_video(films):
    crops = torch.from_numpy(films[0][:30, :56, :56]).float() / 255
    gx, gy, gt = gradients(blur(crops, PROFILE_BLUR))
    gt = gt.sign() * (gt.abs() - PROFILE_NOISE_RATIO * gt.abs().median()).clamp(min=0)
    u, v = (m.numpy() for m in weighted_differences(gx, gy, gt))
    found = row_profile(crops)
    for band in range(NUM_BANDS):
        rows = slice(8 * band, 8 * band + 16)
        parts = (np.maximum(-v, 0), np.maximum(v, 0), np.abs(u))
        want = [np.sqrt(part[:, rows].mean(axis=(1, 2))) for part in parts]
        assert np.allclose(found.numpy()[:, band::NUM_BANDS], np.stack(want, axis=1), atol=1e-6)
    assert torch.allclose(reversed_profile(found), row_profile(crops.flip(0)), atol=1e-6)


def test_whitening_equalizes_what_both_share(rng, monkeypatch):
    mixing = rng.normal(size=(6, 6))
    first, second = (torch.from_numpy(rng.normal(size=(n, 6)) @ mixing) for n in (400, 300))
    first[5] = torch.nan
    monkeypatch.setattr(features, "PROFILE_RIDGE", 1e-9)
    monkeypatch.setattr(features, "WHITENING_HALF_WIDTH", 0)
    one, two = whiten(first, second)
    assert (one[5] == 0).all() and torch.allclose(two.norm(dim=1), torch.ones(300, dtype=torch.float64))
    share = (one.T @ one / 399 + two.T @ two / 300) / 2
    assert (share - torch.eye(6) / 6).abs().max() < 0.03


def test_neighbours_in_time_are_whitened_together(rng, monkeypatch):
    first, second = (torch.from_numpy(rng.normal(size=(n, 3))) for n in (40, 30))
    stacked = [torch.cat([z[[0, *range(len(z) - 1)]], z, z[[*range(1, len(z)), -1]]], dim=1) for z in (first, second)]
    pairs = []
    for half_width, profiles in ((1, (first, second)), (0, stacked)):
        monkeypatch.setattr(features, "WHITENING_HALF_WIDTH", half_width)
        pairs.append(whiten(*profiles))
    for found, want in zip(*pairs, strict=True):
        assert torch.allclose(found, want)


# Boxes about a patch that moves, and a camera that does.


def scene(centres, noise=0.01, size=8):
    """A textured square at ``centres (T, 2)`` (x, y) before a wall."""
    generator = torch.Generator().manual_seed(0)
    grain = torch.rand(1, 1, 15, 22, generator=generator)
    frames = interpolate(grain, size=(60, 90), mode="bicubic")[0, 0].clamp(0, 1).repeat(len(centres), 1, 1)
    square = torch.rand(size, size, generator=generator)
    for frame, (x, y) in zip(frames, centres, strict=True):
        frame[y : y + size, x : x + size] = square
    return frames + noise * torch.randn(frames.shape, generator=generator)


def test_boxes_enclose_what_moves_and_follow_it():
    t = np.arange(60)
    centres = np.stack([40 + (5 * np.sin(t / 3)).astype(int), 30 + (6 * np.cos(t / 4)).astype(int)], axis=1)
    found = motion(scene(centres))
    where, moving = boxes(found, 30.0)
    assert not moving and torch.equal(where[0], where[-1])
    assert (where[0, :2] - torch.tensor([44.0, 34.0])).abs().max() < 3 and 18 < where[0, 2] < 40
    assert found.lively.double().mean() > 0.9 and not found.drift.moves and not found.drift.too_fast
    t = np.arange(70)
    centres = np.stack([5 + t, 25 + (3 * np.sin(t / 2)).astype(int)], axis=1)
    where, moving = boxes(motion(scene(centres)), 30.0)
    assert moving
    assert (where[10:-10, 0] - torch.from_numpy(centres[10:-10, 0] + 4.0)).abs().max() < 3
    assert where[:, 2].unique().numel() == 1


def test_region_is_where_motion_is_looked_for_and_noise_and_flicker_are_none():
    t = np.arange(40)
    left = scene(np.stack([10 + t % 5, 20 + t % 3], axis=1))
    right = scene(np.stack([60 + t % 5, 20 + t % 3], axis=1))
    both = torch.where(torch.arange(90) < 45, left, right)
    where, _ = boxes(motion(both, (50.0, 0.0, 90.0, 60.0)), 30.0)
    assert 60 < where[0, 0] < 75
    still = scene(np.full((40, 2), 20))
    assert motion(still).lively.sum() < 3 and motion(still * (torch.arange(40) % 3)[:, None, None] / 2).drift.too_fast


def test_camera_motion_is_measured(rng):
    generator = torch.Generator().manual_seed(1)
    big = interpolate(torch.rand(1, 1, 30, 40, generator=generator), size=(120, 160), mode="bicubic")
    steps = 0.3 * torch.randn(40, 2, generator=generator).cumsum(0)
    steps = steps - steps.mean(0)
    still = torch.tensor([[80.0, 60.0, 60.0]]).repeat(40, 1)
    still[:, :2] -= steps  # the picture moves by + steps
    found = motion(crop(big[0].expand(40, -1, -1), still, side=60)).drift
    assert found.moves
    true = torch.gradient(steps, dim=0)[0]
    followed = found.step.norm(dim=1) > 0
    assert (found.step[followed] - true[followed]).abs().median() < 0.05
    frames = torch.from_numpy(rng.random((2, 120, 130))).float()  # a crop is a cut where pixels coincide
    where = torch.tensor([[60.0, 55.0, float(CROP_SIDE)]]).expand(2, 3)
    assert torch.allclose(crop(frames, where, CROP_SIDE), frames[:, 7:103, 12:108], atol=1e-4)


# What is accepted as a video: arrays, streams, colours; and what is not.


FRAMES = np.random.default_rng(0).integers(0, 256, (50, 24, 32), dtype=np.uint8)


def chunks(frames, size=7, times=None):
    for begin in range(0, len(frames), size):
        part = frames[begin : begin + size]
        yield part if times is None else (part, times[begin : begin + size])


def test_arrays_streams_colours_and_sizes_are_the_same_take():
    times = np.arange(50) / 25 + 3
    whole = read_gray_video(FRAMES, "a", fps=25.0)
    assert torch.equal(whole.frames, torch.from_numpy(FRAMES)) and whole.fps == pytest.approx(25)
    for source in (chunks(FRAMES), list(chunks(FRAMES)), iter(torch.from_numpy(FRAMES))):
        assert torch.equal(read_gray_video(source, "a", fps=25.0).frames, whole.frames)
    stamped = read_gray_video(chunks(FRAMES, times=times), "a")
    assert torch.equal(stamped.frames, whole.frames) and stamped.times.tolist() == times.tolist()
    for source in (FRAMES / 255, FRAMES.astype(np.float32), np.repeat(FRAMES[..., None], 3, axis=3)):
        found = read_gray_video(source, "a", fps=30.0).frames.int() - whole.frames.int()
        assert found.abs().max() <= 1  # rounding
    large = np.repeat(np.repeat(FRAMES[:20], 40, axis=1), 40, axis=2)  # 1280 px wide
    small = read_gray_video(chunks(large), "a", fps=30.0)
    assert small.frames.shape[2] == MAX_IMAGE_SIDE and small.scale == MAX_IMAGE_SIDE / 1280
    assert torch.equal(small.frames[:, 5::10, 5::10], whole.frames[:20])


BAD = {
    "19 frames; at least 20": (FRAMES[:19], {}),
    "0 frames": (FRAMES[:0], {}),
    "NaN": (np.where(np.arange(50)[:, None, None] == 3, np.nan, FRAMES / 255), {}),
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


def test_bad_videos_are_named():
    for words, (source, options) in BAD.items():
        with pytest.raises(ValueError, match=words):
            read_gray_video(source, "a", **({"fps": 30.0} | options))
