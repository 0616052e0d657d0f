"""Every point of a scene, followed through rendered videos whose truth is known in every pixel, and through folders of pictures."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

import dyntorch as dyn
from indexing.actors.textured import render, sheet
from indexing.video import Chunk, SceneTrackOptions, track_scene, track_whole
from indexing.video.scene import (
    ANCHOR_SPAN,
    MIN_TRACK_FRAMES,
    NUM_PICTURES,
    evenly_spaced,
    refine_along_spans,
    select_indices,
    select_longest,
)
from indexing.video.sequence import PictureSequence

SIZE, FRAMES = (200, 150), 14
OPTIONS = SceneTrackOptions(num_points=300)


@pytest.fixture(scope="module")
def video():
    """A wall, and a poster that slides over it, before a camera that goes and turns."""
    generator = torch.Generator().manual_seed(0)
    wall = sheet((-6, -5, 6), (12, 0, 0), (0, 10, 0), 600, 0, generator)
    poster = sheet((-1.6, -1.2, 5.99), (1.8, 0, 0), (0, 1.6, 0), 110, 1, generator)
    camera = np.array([[220.0, 0, 99.5], [0, 220.0, 74.5], [0, 0, 1]])
    motions = np.tile(np.eye(4), (FRAMES, 2, 1, 1))
    cameras = []
    for i in range(FRAMES):
        turn = 0.004 * i
        rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
        cameras.append(camera @ np.c_[rotation, [-0.03 * i, 0.02 * i, 0]])
        motions[i, 1, :2, 3] = [0.08 * i, 0.03 * i]
    return render([wall, poster], np.stack(cameras), motions, SIZE, noise=1.0, generator=generator)


def stream(video, frames=slice(None)):
    return [Chunk(video.frames[frames], np.arange(FRAMES)[frames] / 10)]


def errors(video, tracks):
    points = tracks.points.numpy()
    true = video.transfer(points[0], tracks.frames[0], tracks.frames[-1])
    off = np.linalg.norm(points[-1] - true, axis=1)
    return off[np.isfinite(off)]


def test_truth_of_sheets(video):
    """A point that is followed shows the same texture: grey levels differ by noise and interpolation alone."""
    x, y = np.meshgrid(np.arange(10.0, 190, 7), np.arange(10.0, 140, 7))
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    there = video.transfer(points, 0, 13)
    kept = (video.visible_sheets(points, 0) >= 0) & (video.visible_sheets(there, 13) == video.visible_sheets(points, 0))
    gray = [
        cv2.remap(video.frames[k].astype(np.float32), *(p[kept].astype(np.float32).T[..., None]), cv2.INTER_LINEAR).ravel()
        for k, p in ((0, points), (13, there))
    ]
    assert kept.sum() > 150 and np.corrcoef(gray)[0, 1] > 0.98
    assert set(video.bodies[video.visible_sheets(points, 0)[kept]]) == {0, 1}


@pytest.mark.slow
def test_background_and_what_moves_are_followed(video):
    tracks = track_scene(stream(video), frames=(0, 6, 13), options=OPTIONS)
    assert tracks.frames == (0, 6, 13) and tracks.times.tolist() == [0.0, 0.6, 1.3] and tracks.size == SIZE
    bodies = video.bodies[video.visible_sheets(tracks.points[0].numpy(), 0)]
    assert (bodies == 0).sum() > 60 and (bodies == 1).sum() > 8
    off = errors(video, tracks)
    assert np.median(off) < 0.3 and (off > 1).mean() < 0.05
    found = dyn.align_planar(*tracks.points, generator=torch.Generator().manual_seed(0))
    true = torch.from_numpy(video.maps[0, 0] @ np.linalg.inv(video.maps[13, 0]))
    assert dyn.metrics.grid_transfer_error(found.B, true, *map(float, SIZE)) < 1.0


def test_which_frames(video):
    usual = track_scene(stream(video), options=OPTIONS)
    assert usual.frames[0] == 0 and len(usual.frames) == 3 and usual.notes[0].startswith("frames 0, ")
    assert track_scene(stream(video), at=(0.15, 0.8), options=OPTIONS).frames == (2, 8)
    every = track_scene(stream(video), every=4, missing=True, options=OPTIONS)
    assert every.frames == (0, 4, 8, 12) and "frames 0, 4, 8, 12 of the 14" in every.notes[0]
    assert every.points[0].isnan().any() and every.points[-1].isnan().any()  # found later, and lost before
    seen = every.points[..., 0].isfinite().sum(0)
    assert int(seen.min()) >= 2
    assert "SceneTracks(" in repr(every)


def test_a_cut_ends_what_is_taken(video):
    """Nothing of the first picture is followed beyond it."""
    after = np.ascontiguousarray(video.frames[::-1, ::-1, ::-1])
    both = [Chunk(np.concatenate([video.frames[:8], after]), np.arange(8 + FRAMES) / 10)]
    tracks = track_scene(both, views=2, options=OPTIONS)
    assert tracks.frames[-1] <= 7 and "fewer than 50% are followed beyond" in tracks.notes[0]


@pytest.mark.slow
def test_pictures_are_a_video(video, tmp_path):
    for i, frame in enumerate(video.frames):
        cv2.imwrite(str(tmp_path / f"f{i}.png"), frame)
    (tmp_path / "notes.txt").write_text("no picture")
    paths = [tmp_path / f"f{i}.png" for i in range(FRAMES)]
    for source in (tmp_path, str(tmp_path / "f*.png"), paths):
        assert PictureSequence(source).paths == paths
    expected = track_scene(stream(video), frames=(0, 6), options=OPTIONS)
    found = track_scene(tmp_path, frames=(0, 6), fps=10.0, options=OPTIONS)
    assert found.times.tolist() == expected.times.tolist() and found.size == SIZE
    torch.testing.assert_close(found.points, expected.points)
    large = cv2.resize(video.frames[0], (400, 300))
    cv2.imwrite(str(tmp_path / "f3.png"), large)
    with pytest.raises(ValueError, match=r"f3.png: has 400 x 300 pixels, f0.png 200 x 150; pictures of one sequence have one size"):
        track_scene(tmp_path, frames=(0, 13))
    (tmp_path / "f1.png").write_bytes(b"damaged")
    with pytest.raises(ValueError, match=r"f1.png: cannot be read as an image"):
        track_scene(tmp_path, frames=(0, 13))


REFUSED = {
    r"has no frame 40; its 14 frames are 0 to 13": {"frames": (0, 40)},
    r"has no frame at 2 s; its last one is at 1.30 s": {"at": (0.0, 2.0)},
    r"0.41, 0.45 s are not 2 different frames": {"at": (0.41, 0.45)},
    r"every 20 is one frame": {"every": 20},
    r"give one of them": {"every": 2, "views": 3},
    r"frames must be two or more numbers from 0 that increase, got \[5, 0\]": {"frames": (5, 0)},
    r"at must be two or more": {"at": (0.1,)},
    r"every must be a whole number from 1, got 0": {"every": 0},
    r"views must be at least 2, got 1": {"views": 1},
    r"has 14 frames, and 20 are needed": {"views": 20},
}


def test_misuse_is_named(video):
    for said, asked in REFUSED.items():
        with pytest.raises(ValueError, match=said):
            track_scene(stream(video), options=OPTIONS, **asked)


def test_what_decides_nothing_is_refused(video, tmp_path):
    with pytest.raises(ValueError, match="has 1 frame, and motion needs at least 2"):
        track_scene(stream(video, slice(1)))
    with pytest.raises(ValueError, match=r"nothing moves: .* points stay within 1 pixel in frames 0, 3; take frames further apart"):
        track_scene([Chunk(video.frames[[0, 0, 0, 0]], np.arange(4) / 10)], views=2)
    with pytest.raises(ValueError, match="0 points could be followed through frames 0, 3, 12 are needed"):
        track_scene([Chunk(np.full((4, 60, 80), 90, np.uint8), np.arange(4) / 10)], views=2)
    with pytest.raises(ValueError, match="can be read only once"):
        track_scene(iter(stream(video)), views=2)
    with pytest.raises(ValueError, match="holds no pictures"):
        track_scene(tmp_path)
    with pytest.raises(ValueError, match="no such file"):
        track_scene(tmp_path / "no.mp4")


LONG_SIZE, LONG_FRAMES = (240, 180), 40
SMALL = SceneTrackOptions(num_points=150)


@pytest.fixture(scope="module")
def walk():
    """A camera that walks along a wall until nothing of the first picture is left, and a poster that slides over it."""
    generator = torch.Generator().manual_seed(0)
    wall = sheet((-3, -5, 6), (24, 0, 0), (0, 10, 0), 1400, 0, generator)
    poster = sheet((-1.0, -1.2, 5.9), (2.2, 0, 0), (0, 2.0, 0), 130, 1, generator)
    camera = np.array([[260.0, 0, 119.5], [0, 260.0, 89.5], [0, 0, 1]])
    motions = np.tile(np.eye(4), (LONG_FRAMES, 2, 1, 1))
    motions[:, 1, :2, 3] = np.arange(LONG_FRAMES)[:, None] * [0.19, 0.01]
    cameras = np.stack([camera @ np.c_[np.eye(3), [-0.16 * i, 0.01 * i, 0.0]] for i in range(LONG_FRAMES)])
    return render([wall, poster], cameras, motions, LONG_SIZE, noise=1.0, generator=generator)


def chunked(frames, length=16):
    return [Chunk(frames[i : i + length], np.arange(i, min(i + length, len(frames))) / 25) for i in range(0, len(frames), length)]


def test_no_point_has_to_last(walk):
    tracks = track_whole(chunked(walk.frames), options=SMALL)
    seen = tracks.points.isfinite().all(-1).numpy()
    assert tracks.points.shape[0] == LONG_FRAMES == len(tracks.frames) and seen.any(axis=1).all()
    lasting = tracks.points[0, seen.all(axis=0)].numpy()
    assert (walk.visible_sheets(lasting, 0) != 0).all()  # the wall is another one at the end
    assert (seen.sum(axis=0) >= MIN_TRACK_FRAMES).all() and tracks.notes[0].startswith("frames 0 to 39 of the 40 that were read")
    off = []
    for i, places in enumerate(tracks.points.numpy().transpose(1, 0, 2)):
        first, last = np.flatnonzero(seen[:, i])[[0, -1]]
        off.append(np.linalg.norm(walk.transfer(places[None, first], first, last)[0] - places[last]))
    off = np.array(off)
    assert np.nanmedian(off) < 0.3 and (off > 2).mean() < 0.08
    assert tracks.pictured == tuple(evenly_spaced(LONG_FRAMES, NUM_PICTURES)) and len(tracks.pictures) == NUM_PICTURES
    for place, picture in zip(tracks.pictured, tracks.pictures, strict=True):
        np.testing.assert_array_equal(picture, walk.frames[place])


@pytest.mark.parametrize(
    ("asked", "taken"),
    [({"every": 3}, range(0, 40, 3)), ({"frames": [2, 5, 9, 20]}, [2, 5, 9, 20]), ({"at": [0.1, 0.2, 0.5]}, [3, 5, 13])],
)
def test_frames_that_are_asked_for(walk, asked, taken):
    tracks = track_whole(chunked(walk.frames), options=SMALL, **asked)
    assert tracks.frames == tuple(taken) and tracks.points.shape[0] == len(taken)
    assert torch.isfinite(tracks.points).all(-1).sum(0).min() >= 2
    np.testing.assert_allclose(tracks.times.numpy(), np.array(taken) / 25)


def test_long_videos_are_thinned_and_many_points_are_left_out(walk):
    tracks = track_whole(chunked(walk.frames), options=SceneTrackOptions(num_points=150, max_frames=15, max_tracks=60))
    assert tracks.frames == tuple(range(0, 40, 3)) and tracks.points.shape[1] == 60
    assert tracks.notes[0].endswith("; at most 15 are taken") and tracks.notes[1].startswith("60 of ")
    assert tracks.points.isfinite().all(-1).any(1).all()
    lengths = np.array([5, 1, 9, 2, 2, 8, 1, 3])
    assert select_indices(lengths, 8).tolist() == list(range(8))
    rows = select_indices(lengths, 4)
    assert len(set(rows.tolist())) == 4 and {2, 5} <= set(rows.tolist())
    positions = np.where(np.arange(9)[:, None, None] < lengths[:, None], 1.0, np.nan) * np.ones(2)
    assert select_longest(positions, 3, 10).shape[1] == 4


def test_a_cut_ends_what_is_followed(walk):
    camera = np.array([[260.0, 0, 119.5], [0, 260.0, 89.5], [0, 0, 1]])
    wall = sheet((-6, -5, 6), (12, 0, 0), (0, 10, 0), 700, 0, torch.Generator().manual_seed(5))
    cameras = np.stack([camera @ np.c_[np.eye(3), [0.05 * i, 0, 0]] for i in range(12)])
    other = render([wall], cameras, np.tile(np.eye(4), (12, 1, 1, 1)), LONG_SIZE)
    tracks = track_whole(chunked(np.concatenate([walk.frames[:13], other.frames])), options=SMALL)
    seen = tracks.points.isfinite().all(-1)
    across = (seen[12] & seen[13]).sum()
    assert across < 0.1 * seen[12].sum() and seen[13].sum() > 40  # and points of the new scene are found at once


def test_a_point_that_is_dragged_along_begins_again(walk):
    views = 2 * ANCHOR_SPAN
    still = np.repeat(walk.frames[:1], views, axis=0)
    positions = np.tile(np.array([[80.0, 90.0], [150.0, 60.0]]), (views, 1, 1))
    positions[10:, 1] += np.linspace(3, 9, views - 10)[:, None]  # nothing moves, and it is somewhere else
    out = refine_along_spans(positions, iter(still))
    assert np.isfinite(out[:, 0]).all() and np.abs(out[:, 0] - positions[:, 0]).max() < 0.2
    assert np.isnan(out[10:, 1]).all() and np.isfinite(out[:10, 1]).all()
    assert out.shape[1] == 3 and np.isnan(out[: ANCHOR_SPAN + 1, 2]).all() and np.isfinite(out[ANCHOR_SPAN + 1, 2]).all()


def test_chunks_that_can_be_read_once_are_refused(walk):
    with pytest.raises(ValueError, match="can be read only once"):
        track_whole(iter(chunked(walk.frames)))
    with pytest.raises(ValueError, match="has 1 frame, and motion needs at least 2"):
        track_whole(chunked(walk.frames[:1]))
    with pytest.raises(ValueError, match="nothing moves"):
        track_whole(chunked(np.repeat(walk.frames[:1], 6, axis=0)), options=SMALL)
    with pytest.raises(ValueError, match="give one of them"):
        track_whole(chunked(walk.frames), frames=[0, 1, 2], every=2)
