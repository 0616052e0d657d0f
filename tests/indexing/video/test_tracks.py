"""Tracks of moving points: they stay on the blobs they started on, and the wall behind gives none."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from indexing.video import Chunk, motion, track_points, tracks
from indexing.video.tracks import extent, follow, patches


def shift(x, y):
    return np.array([[1.0, 0, x], [0, 1, y], [0, 0, 1]])


def riders(points, centres, radius=24.0):
    """For each track, its blob and the track relative to that blob's centre ``(frames, n, 2)``."""
    apart = np.linalg.norm(points[:, :, None] - centres[:, None], axis=-1)  # (frames, n, blobs)
    blob = np.nanmedian(apart, axis=0).argmin(-1)
    relative = points - centres[:, blob]
    return blob, relative, np.nanmedian(apart, axis=0).min(-1) < radius


@pytest.mark.slow
def test_tracks_ride_on_what_moves(scene):
    chunks, centres = scene(60)
    tracks = track_points(chunks)
    points = tracks.points.numpy()
    assert points.dtype == np.float64 and points.shape[0] == 60 and points.shape[1] >= 12 and tracks.size == (320, 240)
    assert torch.equal(tracks.times, torch.from_numpy(np.concatenate([c.times for c in chunks])))
    blob, relative, on = riders(points, centres)
    assert on.mean() > 0.95 and set(blob) == {0, 1, 2}
    wobble = np.nanstd(relative, axis=0).max(-1)
    assert np.median(wobble) < 0.3 and (wobble < 1.0).mean() > 0.85
    assert (tracks.share >= 0.7).all() and (tracks.share[:-1] >= tracks.share[1:]).all()
    assert not tracks.camera.moves and tracks.notes == ()


@pytest.mark.slow
def test_a_moving_camera_is_taken_out(scene):
    chunks, centres = scene(60, camera=lambda i: shift(-0.5 * i, 4 * np.sin(i / 5)))
    tracks = track_points(chunks)
    assert tracks.camera.moves and any("it is taken out" in note for note in tracks.notes)
    _, relative, on = riders(tracks.points.numpy(), centres)
    assert tracks.points.shape[1] >= 6 and on.mean() > 0.9
    assert np.median(np.nanstd(relative, axis=0).max(-1)) < 0.6


@pytest.mark.slow
def test_complete_keep_and_motion_choose(scene, monkeypatch):
    chunks, _ = scene(30)
    assert track_points(chunks, keep=5).points.shape[1] == 5
    whole = track_points(chunks, complete=1.0)
    assert whole.points.shape[1] > 0 and not whole.points.isnan().any()
    monkeypatch.setattr(tracks, "MIN_MOTION", 1.2)
    nothing = track_points(chunks)
    assert nothing.points.shape == (30, 0, 2) and "no moving point could be followed for 70% of the video" in nothing.notes[0]


def test_nothing_moves(scene):
    chunks, _ = scene(30, blobs=0)
    tracks = track_points(chunks)
    assert tracks.points.shape == (30, 0, 2) and "nothing moves" in tracks.notes[0]


@pytest.mark.slow
def test_points_that_come_late_are_found(scene):
    chunks, centres = scene(45)
    first = np.repeat(chunks[0].frames[:1], 40, 0)
    late = [Chunk(first, np.arange(40) / 30), *(Chunk(c.frames, c.times + 40 / 30) for c in chunks)]
    tracks = track_points(late, complete=0.5)
    points = tracks.points.numpy()
    assert points.shape[1] >= 5
    _, relative, on = riders(points[40:], centres)
    assert on.mean() > 0.9 and np.median(np.nanstd(relative, axis=0).max(-1)) < 0.4


@pytest.mark.slow
def test_pixels_are_those_of_the_video(scene, write):
    chunks, centres = scene(20)
    frames = np.concatenate([c.frames for c in chunks]).repeat(4, 1).repeat(4, 2)  # 1280 x 960: tracked at 960
    tracks = track_points(write("big.mp4", frames))
    assert tracks.size == (1280, 960)
    _, _, on = riders(tracks.points.numpy() / 4, centres)
    assert on.mean() > 0.9


def test_following_and_what_cannot_be_followed():
    cv2 = pytest.importorskip("cv2")
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.integers(0, 255, (100, 120)).astype(np.uint8), (0, 0), 2)
    moved = cv2.warpAffine(image, np.array([[1.0, 0, 3.4], [0, 1, -1.7]]), (120, 100), borderMode=cv2.BORDER_REFLECT)
    points = np.array([[40.0, 50], [80, 60], [60, 3]], np.float32)
    ahead, good = follow(image, moved, points)
    assert good.tolist() == [True, True, False]  # the last one leaves the picture
    np.testing.assert_allclose(ahead[:2] - points[:2], [[3.4, -1.7]] * 2, atol=0.1)
    looks = patches(image, points), patches(moved, ahead)
    assert ((looks[0] * looks[1]).sum(1)[:2] > 0.9).all()
    assert not follow(image, rng.integers(0, 255, (100, 120)).astype(np.uint8), points)[1].any()


def test_options_that_make_no_sense_and_one_frame_is_no_video():
    for options in ({"keep": 0}, {"complete": 1.5}):
        with pytest.raises(ValueError, match=f"track_points: .*{next(iter(options))}"):
            track_points([], **options)
    with pytest.raises(ValueError, match=r"1 frame\(s\)"):
        track_points([Chunk(np.zeros((1, 48, 64), np.uint8), np.zeros(1))])
    track = np.zeros((100, 2))
    track[50] = 80  # a single jump is no extent
    assert extent(track) == 0 and extent(track, 1.0) == pytest.approx(80 * np.sqrt(2))


def test_too_few_points_say_nothing_of_the_camera(rng, monkeypatch):
    frames = rng.integers(0, 255, (12, 64, 64)).astype(np.uint8)
    chunks = [Chunk(np.repeat(frames[:1], 12, axis=0), np.arange(12.0))]
    assert track_points(chunks).camera.support.min() == 1.0
    monkeypatch.setattr(motion, "MIN_BACKGROUND_POINTS", 10_000)
    unsure = track_points(chunks)
    assert not unsure.camera.support[1:].any() and "too little background" in unsure.notes[-1]
