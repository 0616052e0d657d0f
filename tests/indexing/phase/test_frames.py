"""Distances of single frames against brute force, with joints missing."""

import numpy as np
import torch

from indexing.action.bank import Windows
from indexing.phase.frames import image_distance, normalize_frames, shape_distance


def frames(count, joints, dims, seed):
    return torch.randn(count, 1, joints, dims, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_residual_outside_a_shape_is_that_of_least_squares_on_the_joints_seen():
    x, shapes = frames(4, 9, 2, 0), frames(3, 9, 3, 1)
    seen = torch.ones(4, 9, dtype=torch.bool)
    seen[1, 2] = seen[2, 0] = seen[2, 5] = False
    x[~seen[:, None]] = 7.0
    found = shape_distance(Windows(x, seen), Windows(shapes, torch.ones(3, 9, dtype=torch.bool)))
    for q in range(4):
        here = seen[q].numpy()
        image = x[q, 0].numpy()[here]
        image = (image - image.mean(0)) / np.linalg.norm(image - image.mean(0))
        for g in range(3):
            span = np.column_stack([np.ones(here.sum()), shapes[g, 0].numpy()[here]])
            left = image - span @ np.linalg.lstsq(span, image, rcond=None)[0]
            assert abs(float(found[q, g]) - np.square(left).sum()) < 1e-5


def test_five_joints_are_not_judged():
    seen = torch.arange(9)[None] < 5
    found = shape_distance(Windows(frames(1, 9, 2, 0), seen), Windows(frames(2, 9, 3, 1), torch.ones(2, 9, dtype=torch.bool)))
    assert found.tolist() == [[1.0, 1.0]]


def test_images_are_compared_up_to_place_and_size():
    x = frames(2, 6, 2, 0)
    seen = torch.ones(2, 6, dtype=torch.bool)
    found = image_distance(Windows(3 * x + torch.tensor([5.0, -2.0], dtype=x.dtype), seen), Windows(x, seen))
    assert found.diagonal().abs().max() < 1e-12
    a, b = (normalize_frames(x[:, 0], seen)[k].flatten() for k in (0, 1))
    assert abs(float(found[0, 1] - (1 - a @ b))) < 1e-12
