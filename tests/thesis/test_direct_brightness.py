"""The direct brightness measure of chapter 7, on films of textured spots whose motions share three functions of time."""

import numpy as np
import pytest
import torch

from indexing import synchronize
from indexing.sync.brightness import brightness_shift
from indexing.sync.brightness_features import window_kernels

FPS = (30.0, 30.0)
SPOTS, SIDE = 24, 96


def courses(frames, seed, speed):
    """Three smooth functions of time ``(3, frames)``."""
    rng = np.random.default_rng(seed)
    phases, rates = rng.uniform(0, 6.28, (3, 5)), speed * rng.uniform(0.4, 1.6, (3, 5))
    return np.sin(rates[..., None] * np.arange(frames) + phases[..., None]).mean(axis=1)


def filmed(motions, camera, seed, body=7):
    """Spots, each moving by its own mixture of the three functions, as ``camera (2, 3)`` sees them; ``seed``: sizes and greys."""
    scene, skin = np.random.default_rng(body), np.random.default_rng(seed)
    rest = scene.uniform(-19, 19, (SPOTS, 3))
    mixture = scene.normal(size=(SPOTS, 3, 3))
    paths = np.einsum("ik,nkj,jt->tni", camera, mixture, motions) + rest @ camera.T + SIDE / 2
    size, gray = skin.uniform(2.5, 4.0, SPOTS), skin.uniform(-90, 90, SPOTS)
    across, down = (np.exp(-((np.arange(SIDE) - paths[..., i, None]) ** 2) / (2 * size[:, None] ** 2)) for i in (0, 1))
    return np.clip(128 + np.einsum("n,tny,tnx->tyx", gray, down, across, optimize=True), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def cameras():
    rng = np.random.default_rng(3)
    return [np.linalg.qr(rng.normal(size=(3, 3)))[0][:2] for _ in range(2)]


def test_differences_lie_in_the_space_of_the_motions(cameras):
    """Patch k: h_k(t) = -G_k (u, v)_k(t): rows of H span the three functions, whatever the camera and the texture."""
    motions = courses(30, 1, 0.08)
    for camera, seed in zip(cameras, (4, 5), strict=True):
        kernels = window_kernels(torch.from_numpy(filmed(motions, camera, seed)).float() / 255, half=6, patch=12, rows=60).numpy()
        for tau in (0, 8, 17):
            window = motions[:, tau : tau + 13]
            basis = np.linalg.qr((window - window.mean(axis=1, keepdims=True)).T)[0]
            outside = np.eye(13) - basis @ basis.T
            assert np.trace(outside @ kernels[tau]) < 0.05  # of trace 1; a random subspace of 3 leaves 10 of 13


@pytest.mark.slow
def test_two_cameras_by_the_window_alone(cameras):
    motions = courses(112, 2, 0.22)
    first, second = (filmed(motions, camera, seed) for camera, seed in zip(cameras, (4, 5), strict=True))
    shift = synchronize(first[12:], second[:-12], "brightness", fps=30.0, measure="window")
    assert abs(shift.frames - 12) <= 1 and shift.method == "brightness"
    other = filmed(courses(60, 9, 0.22), cameras[1], 5)
    unrelated = brightness_shift(first[:60], other, fps=FPS, measure="window", region=None)
    assert not unrelated.ok and unrelated.reason


def test_what_it_cannot_do_is_said(cameras):
    film = filmed(courses(28, 2, 0.22), cameras[0], 4)
    with pytest.raises(ValueError, match=r"measure='window' needs 30 frames at 30 per second, the shorter video has 28"):
        brightness_shift(film, film, fps=FPS, measure="window")
    with pytest.raises(ValueError, match="measure must be one of profile, window, got 'rank'"):
        brightness_shift(film, film, fps=FPS, measure="rank")
    with pytest.raises(ValueError, match="measure='window' is a measure of brightness, and method='auto' was asked for"):
        synchronize(film, film, fps=30.0, measure="window")
