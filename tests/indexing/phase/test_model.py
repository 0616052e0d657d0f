"""Distances of single frames against brute force, with joints missing, and by leaning cameras near by; files."""

import numpy as np
import pytest
import torch

from indexing import PhaseIndexer
from indexing.action.bank import Windows
from indexing.actors import dataset
from indexing.cameras import virtual
from indexing.clip import Clip
from indexing.phase.model import image_distance, leaning, normalize_frames, shape_distance


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


def test_five_joints_are_not_judged_and_images_are_compared_up_to_place_and_size():
    seen = torch.arange(9)[None] < 5
    found = shape_distance(Windows(frames(1, 9, 2, 0), seen), Windows(frames(2, 9, 3, 1), torch.ones(2, 9, dtype=torch.bool)))
    assert found.tolist() == [[1.0, 1.0]]
    x = frames(2, 6, 2, 0)
    seen = torch.ones(2, 6, dtype=torch.bool)
    found = image_distance(Windows(3 * x + torch.tensor([5.0, -2.0], dtype=x.dtype), seen), Windows(x, seen))
    assert found.diagonal().abs().max() < 1e-12
    a, b = (normalize_frames(x[:, 0], seen)[k].flatten() for k in (0, 1))
    assert abs(float(found[0, 1] - (1 - a @ b))) < 1e-12


def test_leaning_cameras_leave_what_least_squares_leaves():
    shapes, x = frames(4, 9, 3, 0)[:, 0], frames(3, 9, 2, 1)[:, 0]
    basis, x = torch.linalg.qr(shapes - shapes.mean(1, keepdim=True)).Q, x - x.mean(1, keepdim=True)
    x = x / x.flatten(1).norm(dim=1)[:, None, None]
    found = leaning(x, basis, 0.05)
    for q in range(3):
        for e in range(4):
            image = basis[e] @ basis[e].T @ x[q]
            away = torch.eye(9).double() - basis[e] @ basis[e].T - 1 / 9
            bent = torch.einsum("ij,jd,jk->idk", away, image, 3 * basis[e]).reshape(18, 3)
            rows = torch.cat([bent, 0.05**0.5 * torch.eye(3).double()])
            right = torch.cat([(x[q] - image).reshape(18), torch.zeros(3).double()])
            m = torch.linalg.lstsq(rows, -right[:, None]).solution
            torch.testing.assert_close(found[q, e], (rows @ m + right[:, None]).square().sum())
    # a stiff camera does not lean: what is left is that of affine ones
    stiff = 1 - torch.einsum("enk,qnd->qekd", basis, x).square().sum((2, 3))
    torch.testing.assert_close(leaning(x, basis, 1e9), stiff, atol=1e-8, rtol=0)


def walker(distance, azimuth, seed):
    """A synthetic walk on the spot in a camera at some distance, and the phase of every frame by construction."""
    draw = np.random.default_rng(seed)
    rest = np.random.default_rng(7).normal(size=(14, 3)) * [0.25, 0.5, 0.25]
    swing = np.random.default_rng(8).normal(size=(2, 14, 3)) * 0.12
    phase = np.linspace(0, 3, 90, endpoint=False) + draw.uniform()
    turns = 2 * np.pi * phase[:, None, None]
    joints = rest + np.cos(turns) * swing[0] + np.sin(turns) * swing[1]
    image = virtual(Clip(joints, fps=30.0), azimuth, 0.1, distance=distance, noise=0.01, random_state=draw)
    return image, phase % 1.0


@pytest.mark.slow
def test_phases_near_by_are_nearer_and_from_afar_no_further_off():
    train = [walker(4.5, azimuth, seed) for seed, azimuth in enumerate((0, 70, 140, 220, 300))]
    errors = {}
    for camera in ("affine", "projective"):
        indexer = PhaseIndexer(2, camera=camera, mirror=False)
        indexer.fit([clip for clip, _ in train], ["walk"] * 5, [phase for _, phase in train])
        for distance in (1.6, 10.0):
            off = []
            for seed in range(4):
                clip, phase = walker(distance, 40 + 90 * seed, 50 + seed)
                apart = np.abs((indexer.phase(clip)[:, 0] - phase + 0.5) % 1 - 0.5)
                off.append(np.median(apart))
            errors[camera, distance] = np.mean(off)
    assert errors["projective", 1.6] < 0.95 * errors["affine", 1.6]
    assert errors["projective", 10.0] < 1.1 * errors["affine", 10.0]


@pytest.mark.slow
def test_the_camera_is_a_parameter():
    clips = dataset(2, ["walk", "squat"], azimuth=0, rng=0)
    near, far = (PhaseIndexer(1, camera=camera).fit(clips, clips.labels) for camera in ("projective", "affine"))
    assert not np.allclose(far.score_frames(clips[0]), near.score_frames(clips[0]))
    with pytest.raises(ValueError, match="camera must be one of"):
        PhaseIndexer(camera="pinhole").fit(clips, clips.labels)
