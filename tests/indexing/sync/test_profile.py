"""The row-band profile by loops, played backwards, and whitened."""

import numpy as np
import torch

from indexing.brightness.features import blur, gradients, weighted_differences
from indexing.sync.brightness_features import (
    NUM_BANDS,
    PROFILE_BLUR,
    PROFILE_NOISE_RATIO,
    inverse_root,
    reversed_profile,
    row_profile,
    whiten,
)


def test_profile_is_the_mean_motion_per_band(films):
    crops = torch.from_numpy(films[0][:12, :56, :56]).float() / 255
    gx, gy, gt = gradients(blur(crops, PROFILE_BLUR))
    gt = gt.sign() * (gt.abs() - PROFILE_NOISE_RATIO * gt.abs().median()).clamp(min=0)
    u, v = (m.numpy() for m in weighted_differences(gx, gy, gt))
    found = row_profile(crops)
    for band in range(NUM_BANDS):
        rows = slice(8 * band, 8 * band + 16)
        parts = (np.maximum(-v, 0), np.maximum(v, 0), np.abs(u))
        want = [np.sqrt(part[:, rows].mean(axis=(1, 2))) for part in parts]
        assert np.allclose(found.numpy()[:, band::NUM_BANDS], np.stack(want, axis=1), atol=1e-6)


def test_backwards_profile_is_that_of_the_backwards_video(films):
    crops = torch.from_numpy(films[0][:30]).float() / 255
    assert torch.allclose(reversed_profile(row_profile(crops)), row_profile(crops.flip(0)), atol=1e-6)


def test_whitening_equalizes_what_both_share(rng):
    mixing = rng.normal(size=(6, 6))
    first, second = (torch.from_numpy(rng.normal(size=(n, 6)) @ mixing) for n in (400, 300))
    first[5] = torch.nan
    one, two = whiten(first, second, ridge=1e-9, reach=0)
    assert (one[5] == 0).all() and torch.allclose(two.norm(dim=1), torch.ones(300, dtype=torch.float64))
    share = (one.T @ one / 399 + two.T @ two / 300) / 2
    assert (share - torch.eye(6) / 6).abs().max() < 0.03


def test_neighbours_in_time_are_whitened_together(rng):
    first, second = (torch.from_numpy(rng.normal(size=(n, 3))) for n in (40, 30))
    stacked = [torch.cat([z[[0, *range(len(z) - 1)]], z, z[[*range(1, len(z)), -1]]], dim=1) for z in (first, second)]
    for found, want in zip(whiten(first, second, reach=1), whiten(*stacked, reach=0), strict=True):
        assert torch.allclose(found, want)


def test_inverse_root(rng):
    a = rng.normal(size=(5, 5))
    a = torch.from_numpy(a @ a.T)
    root = inverse_root(a, 0.0)
    assert torch.allclose(root @ a @ root, torch.eye(5, dtype=torch.float64))
