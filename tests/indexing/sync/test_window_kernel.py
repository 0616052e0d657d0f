"""The window kernel against its definition in loops."""

import numpy as np
import torch

from indexing.brightness.features import blur
from indexing.sync.brightness_features import KERNEL_BLUR, kernel_descriptors, window_kernels

SIGMA = KERNEL_BLUR


def by_loops(crops, tau, half, patch, rows):
    b = blur(crops, SIGMA).double().numpy()
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


def test_kernel_is_its_definition(films):
    crops = torch.from_numpy(films[0][:20, 10:50, 20:60]).float() / 255
    found = window_kernels(crops, half=3, patch=7, rows=20)
    assert found.shape == (14, 7, 7)
    for tau in (3, 10, 16):
        assert np.allclose(found[tau - 3].numpy(), by_loops(crops, tau, 3, 7, 20), atol=1e-5)


def test_short_and_still_takes_give_no_kernel():
    assert window_kernels(torch.rand(9, 30, 30)).shape[0] == 0
    assert window_kernels(torch.full((25, 30, 30), 0.5)).abs().max() == 0


def test_descriptors_are_unit_vectors_without_mean(rng):
    h = torch.from_numpy(rng.normal(size=(40, 12, 5)))
    kernels = h.mT @ h
    kernels[3] = torch.nan
    one, two = kernel_descriptors(kernels[:25], kernels[25:])
    assert one.shape == (25, 25) and two.shape == (15, 25)
    assert (one[3] == 0).all()
    assert torch.allclose(two.norm(dim=1), torch.ones(15, dtype=torch.float64))
