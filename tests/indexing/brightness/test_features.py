"""Gradients and weighted differences against numpy and against a pattern that moves by a known amount."""

import numpy as np
import torch

from indexing.brightness.features import GRADIENT_EPSILON, as_grey, blur, gradients, weighted_differences


def test_gradients_are_central_differences(rng):
    frames = rng.random((5, 6, 7))
    gx, gy, gt = gradients(torch.from_numpy(frames))
    for axis, found in ((2, gx), (1, gy), (0, gt)):
        inner = (slice(1, -1),) * 3
        assert np.allclose(found.numpy()[inner], np.gradient(frames, axis=axis)[inner])


def test_weighted_differences_are_the_motion_times_the_contrast():
    x, t = torch.meshgrid(torch.arange(40.0), torch.arange(5.0), indexing="ij")
    for slope in (0.05, -0.05):
        ramp = (slope * (x - 0.3 * t)).T[:, None].expand(-1, 10, -1)  # moves right by 0.3 px per frame
        u, v = weighted_differences(*gradients(ramp))
        assert torch.allclose(u[2, 5, 20], torch.tensor(0.3 * 0.05**2 / (0.05 + GRADIENT_EPSILON)))
        assert v.abs().max() < 1e-7


def test_blur_keeps_the_mean_and_fits_small_frames(rng):
    assert torch.allclose(blur(torch.full((2, 20, 20), 0.4), 2.0), torch.tensor(0.4))
    assert blur(torch.from_numpy(rng.random((2, 5, 9))), 3.0).shape == (2, 5, 9)


def test_grey_is_from_0_to_1():
    assert as_grey(torch.tensor([255], dtype=torch.uint8)).tolist() == [1.0]
