"""Motion maps, the causal box and the cells, against loops and kornia."""

import numpy as np
import pytest
import torch

from indexing.brightness.descriptors import (
    FEW_FRAMES,
    GRADIENT_EPSILON,
    MIN_CHANGE,
    SOFT_NORM,
    BrightnessOptions,
    MotionBox,
    MotionMaps,
    blur,
    blur_small,
    describe_cells,
    gradients,
    inner_gradients,
    mirror_rows,
    pool_cells,
    profile,
    weighted_differences,
)

QUIET, SIGMA = BrightnessOptions().noise_level, BrightnessOptions().blur_sigma


def video(frames=9, height=18, width=24, seed=0):
    return torch.rand(frames, height, width, generator=torch.Generator().manual_seed(seed))


def test_gradients_and_differences_are_the_motion(rng):
    frames = rng.random((5, 6, 7))
    gx, gy, gt = gradients(torch.from_numpy(frames))
    for axis, found in ((2, gx), (1, gy), (0, gt)):
        inner = (slice(1, -1),) * 3
        assert np.allclose(found.numpy()[inner], np.gradient(frames, axis=axis)[inner])
    x, t = torch.meshgrid(torch.arange(40.0), torch.arange(5.0), indexing="ij")
    for slope in (0.05, -0.05):
        ramp = (slope * (x - 0.3 * t)).T[:, None].expand(-1, 10, -1)  # moves right by 0.3 px per frame
        u, v = weighted_differences(*gradients(ramp))
        assert torch.allclose(u[2, 5, 20], torch.tensor(0.3 * 0.05**2 / (0.05 + GRADIENT_EPSILON)))
        assert v.abs().max() < 1e-7


def test_blur_keeps_the_mean_and_fits_small_frames(rng):
    assert torch.allclose(blur(torch.full((2, 20, 20), 0.4), 2.0), torch.tensor(0.4))
    assert blur(torch.from_numpy(rng.random((2, 5, 9))), 3.0).shape == (2, 5, 9)


def test_maps_are_kornias_gradients_of_the_frame_before_and_do_not_know_the_sign_of_the_contrast():
    frames = video()
    maps, change = MotionMaps(SIGMA, QUIET).push(frames)
    gx, gy, gt = gradients(blur(frames, SIGMA))
    for t in (2, 5, 8):  # the change from t - 2 to t, about frame t - 1
        weight = -gt[t - 1].sign() * (gt[t - 1].abs() - QUIET).clamp(min=0) / ((gx[t - 1] ** 2 + gy[t - 1] ** 2).sqrt() + 0.02)
        u, v = weight * gx[t - 1], weight * gy[t - 1]
        expected = torch.stack([u.clamp(min=0), (-u).clamp(min=0), v.clamp(min=0), (-v).clamp(min=0)])
        torch.testing.assert_close(maps[t], expected)
        torch.testing.assert_close(change[t], gt[t - 1].abs())
    assert not maps[0].any()
    torch.testing.assert_close(MotionMaps(SIGMA, QUIET).push(1 - frames)[0], maps, atol=1e-5, rtol=1e-4)


def test_tables_are_kornias():
    for count in (3, FEW_FRAMES + 2, FEW_FRAMES + 3):
        frames = video(count)
        torch.testing.assert_close(blur_small(frames, SIGMA), blur(frames, SIGMA))
        for part, expected in zip(inner_gradients(frames), gradients(frames), strict=True):
            torch.testing.assert_close(part, expected[1:-1])


def slow_box(change):
    """Frame by frame, quantiles by counting."""
    seen, out = np.zeros(change.shape[1:]), []
    for frame in change:
        seen = np.maximum(seen * (1 - 1 / 150), np.maximum(frame - MIN_CHANGE, 0))
        ends = []
        for axis in (0, 1):
            share = np.cumsum(seen.sum(axis)) / seen.sum()
            ends.append((np.argmax(share >= 0.02), np.argmax(share >= 0.98) + 1))
        side = max(b - a for a, b in ends) * 1.3
        out.append([*(np.mean(pair) for pair in ends), side, side])
    return np.array(out)


def test_the_box_is_that_of_a_loop_in_any_chunks_and_without_motion_the_image():
    change = 0.05 * video(40, 12, 16) * (video(40, 12, 16, 1) > 0.9)
    expected = slow_box(change.double().numpy())
    box = MotionBox(150.0)
    found = torch.cat([box.push(part) for part in change.double().split([1, 7, 20, 12])])
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-9)
    assert MotionBox(150.0).push(torch.zeros(2, 12, 16))[1].tolist() == pytest.approx([8, 6, 20.8, 20.8])


def test_cells_are_area_means():
    maps, count = video(2, 8, 12)[:, None].double(), 4
    boxes = torch.tensor([[6.2, 4.0, 6.0, 5.0], [1.0, 7.0, 8.0, 8.0]], dtype=torch.float64)
    fine = 200  # sub-pixels: the integral by brute force
    for i, (x, y, w, h) in enumerate(boxes.tolist()):
        found = pool_cells(maps, torch.stack([boxes, boxes.flip(0)], 1), count)[i, 0].view(count, count)
        for row, column in ((0, 0), (1, 3), (3, 2)):
            xs = x - w / 2 + w / count * (column + 0.5 + np.linspace(-1, 1, fine, endpoint=False) + 1 / fine)
            ys = y - h / 2 + h / count * (row + 0.5 + np.linspace(-1, 1, fine, endpoint=False) + 1 / fine)
            inside = ((xs >= 0) & (xs < 12))[None] & ((ys >= 0) & (ys < 8))[:, None]
            image = maps[i, 0].numpy()[np.clip(ys, 0, 7.99).astype(int)][:, np.clip(xs, 0, 11.99).astype(int)]
            assert float(found[row, column]) == pytest.approx((image * inside).mean(), abs=5e-3)


def test_descriptors_are_shorter_than_one_and_mirror_with_the_image():
    frames = video(6)
    box = torch.tensor([12.0, 9, 20, 20]).expand(6, 4)

    def seen(images):
        cells = pool_cells(MotionMaps(SIGMA, QUIET).push(images)[0], box[:, None])[:, 0]
        return torch.cat([describe_cells(cells), describe_cells(cells), describe_cells(profile(cells))], dim=1)

    rows = seen(frames)
    assert rows[2:, :256].norm(dim=1).max() < 1
    cells = rows[3, :256] / (1 - rows[3, :256].norm())
    mean = pool_cells(MotionMaps(SIGMA, QUIET).push(frames)[0], box[:, None])[3]
    torch.testing.assert_close(cells.norm() * SOFT_NORM, mean.sum().sqrt(), rtol=1e-3, atol=0)
    torch.testing.assert_close(mirror_rows(rows), seen(frames.flip(2)), atol=1e-5, rtol=1e-3)
