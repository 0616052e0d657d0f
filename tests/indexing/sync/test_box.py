"""Boxes about a patch that moves, and a camera that does."""

import numpy as np
import torch
from torch.nn.functional import interpolate

from indexing.sync.brightness_features import CROP_SIDE, boxes, crop, motion

SIDE = CROP_SIDE


def wall(generator, height=60, width=90):
    return interpolate(torch.rand(1, 1, height // 4, width // 4, generator=generator), size=(height, width), mode="bicubic")[
        0, 0
    ].clamp(0, 1)


def scene(centres, noise=0.01, size=8):
    """A textured square at ``centres (T, 2)`` (x, y) before a wall."""
    generator = torch.Generator().manual_seed(0)
    frames = wall(generator).repeat(len(centres), 1, 1)
    square = torch.rand(size, size, generator=generator)
    for frame, (x, y) in zip(frames, centres, strict=True):
        frame[y : y + size, x : x + size] = square
    return frames + noise * torch.randn(frames.shape, generator=generator)


def test_box_of_a_take_encloses_what_moves():
    t = np.arange(60)
    centres = np.stack([40 + (5 * np.sin(t / 3)).astype(int), 30 + (6 * np.cos(t / 4)).astype(int)], axis=1)
    found = motion(scene(centres))
    where, moving = boxes(found, 30.0)
    assert not moving and torch.equal(where[0], where[-1])
    assert (where[0, :2] - torch.tensor([44.0, 34.0])).abs().max() < 3 and 18 < where[0, 2] < 40
    assert found.lively.double().mean() > 0.9 and not found.drift.moves and not found.drift.too_fast


def test_box_follows_what_crosses_the_image():
    t = np.arange(70)
    centres = np.stack([5 + t, 25 + (3 * np.sin(t / 2)).astype(int)], axis=1)
    where, moving = boxes(motion(scene(centres)), 30.0)
    assert moving
    assert (where[10:-10, 0] - torch.from_numpy(centres[10:-10, 0] + 4.0)).abs().max() < 3
    assert where[:, 2].unique().numel() == 1


def test_region_is_where_motion_is_looked_for():
    t = np.arange(40)
    left = scene(np.stack([10 + t % 5, 20 + t % 3], axis=1))
    right = scene(np.stack([60 + t % 5, 20 + t % 3], axis=1))
    both = torch.where(torch.arange(90) < 45, left, right)
    where, _ = boxes(motion(both, (50.0, 0.0, 90.0, 60.0)), 30.0)
    assert 60 < where[0, 0] < 75


def test_nothing_moves_in_noise():
    assert motion(scene(np.full((40, 2), 20))).lively.sum() < 3


def test_camera_motion_is_measured():
    generator = torch.Generator().manual_seed(1)
    big = interpolate(torch.rand(1, 1, 30, 40, generator=generator), size=(120, 160), mode="bicubic")
    steps = 0.3 * torch.randn(40, 2, generator=generator).cumsum(0)
    steps = steps - steps.mean(0)
    still = torch.tensor([[80.0, 60.0, 60.0]]).repeat(40, 1)
    still[:, :2] -= steps  # the picture moves by + steps
    frames = crop(big[0].expand(40, -1, -1), still, side=60)
    found = motion(frames).drift
    assert found.moves
    true = torch.gradient(steps, dim=0)[0]
    followed = found.step.norm(dim=1) > 0
    assert (found.step[followed] - true[followed]).abs().median() < 0.05


def test_flicker_is_hopeless():
    frames = scene(np.full((40, 2), 20)) * (torch.arange(40) % 3)[:, None, None] / 2
    assert motion(frames).drift.too_fast


def test_crop_is_a_cut_where_pixels_coincide(rng):
    frames = torch.from_numpy(rng.random((2, 120, 130))).float()
    where = torch.tensor([[60.0, 55.0, float(SIDE)]]).expand(2, 3)
    assert torch.allclose(crop(frames, where, SIDE), frames[:, 7:103, 12:108], atol=1e-5)
