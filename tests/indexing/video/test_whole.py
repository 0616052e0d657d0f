"""Points followed through whole videos, none of which has to last: against rendered truth, and with what is left out."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from indexing.actors.sheets import render, sheet
from indexing.video import Chunk, SceneOptions, track_whole
from indexing.video.whole import anchored, chosen, keeping, spread

SIZE, FRAMES = (240, 180), 40
SMALL = SceneOptions(count=150)


@pytest.fixture(scope="module")
def walk():
    """A camera that walks along a wall until nothing of the first picture is left, and a poster that slides over it."""
    generator = torch.Generator().manual_seed(0)
    wall = sheet((-3, -5, 6), (24, 0, 0), (0, 10, 0), 1400, 0, generator)
    poster = sheet((-1.0, -1.2, 5.9), (2.2, 0, 0), (0, 2.0, 0), 130, 1, generator)
    camera = np.array([[260.0, 0, 119.5], [0, 260.0, 89.5], [0, 0, 1]])
    motions = np.tile(np.eye(4), (FRAMES, 2, 1, 1))
    motions[:, 1, :2, 3] = np.arange(FRAMES)[:, None] * [0.19, 0.01]
    cameras = np.stack([camera @ np.c_[np.eye(3), [-0.16 * i, 0.01 * i, 0.0]] for i in range(FRAMES)])
    return render([wall, poster], cameras, motions, SIZE, noise=1.0, generator=generator)


def chunked(frames, length=16):
    return [Chunk(frames[i : i + length], np.arange(i, min(i + length, len(frames))) / 25) for i in range(0, len(frames), length)]


def test_no_point_has_to_last(walk):
    tracks = track_whole(chunked(walk.frames), options=SMALL)
    seen = tracks.points.isfinite().all(-1).numpy()
    assert tracks.points.shape[0] == FRAMES == len(tracks.frames) and seen.any(axis=1).all()
    lasting = tracks.points[0, seen.all(axis=0)].numpy()
    assert (walk.shown(lasting, 0) != 0).all()  # the wall is another one at the end
    assert (seen.sum(axis=0) >= SMALL.brief).all() and tracks.notes[0].startswith("frames 0 to 39 of the 40 that were read")
    off = []
    for i, places in enumerate(tracks.points.numpy().transpose(1, 0, 2)):
        first, last = np.flatnonzero(seen[:, i])[[0, -1]]
        off.append(np.linalg.norm(walk.followed(places[None, first], first, last)[0] - places[last]))
    off = np.array(off)
    assert np.nanmedian(off) < 0.3 and (off > 2).mean() < 0.08


def test_pictures_of_some_frames_are_kept(walk):
    tracks = track_whole(chunked(walk.frames), options=SMALL)
    assert tracks.pictured == tuple(spread(FRAMES, SMALL.kept)) and len(tracks.pictures) == SMALL.kept
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
    tracks = track_whole(chunked(walk.frames), options=SceneOptions(count=150, most=15, tracks=60))
    assert tracks.frames == tuple(range(0, 40, 3)) and tracks.points.shape[1] == 60
    assert tracks.notes[0].endswith("; at most 15 are taken") and tracks.notes[1].startswith("60 of ")
    seen = tracks.points.isfinite().all(-1)
    assert seen.any(1).all()


def test_a_cut_ends_what_is_followed(walk):
    camera = np.array([[260.0, 0, 119.5], [0, 260.0, 89.5], [0, 0, 1]])
    wall = sheet((-6, -5, 6), (12, 0, 0), (0, 10, 0), 700, 0, torch.Generator().manual_seed(5))
    cameras = np.stack([camera @ np.c_[np.eye(3), [0.05 * i, 0, 0]] for i in range(12)])
    other = render([wall], cameras, np.tile(np.eye(4), (12, 1, 1, 1)), SIZE)
    tracks = track_whole(chunked(np.concatenate([walk.frames[:13], other.frames])), options=SMALL)
    seen = tracks.points.isfinite().all(-1)
    across = (seen[12] & seen[13]).sum()
    assert across < 0.1 * seen[12].sum() and seen[13].sum() > 40  # and points of the new scene are found at once


def test_a_point_that_is_dragged_along_begins_again(walk):
    views = 2 * SMALL.span
    still = np.repeat(walk.frames[:1], views, axis=0)
    positions = np.tile(np.array([[80.0, 90.0], [150.0, 60.0]]), (views, 1, 1))
    positions[10:, 1] += np.linspace(3, 9, views - 10)[:, None]  # nothing moves, and it is somewhere else
    out = anchored(positions, iter(still), SMALL)
    assert np.isfinite(out[:, 0]).all() and np.abs(out[:, 0] - positions[:, 0]).max() < 0.2
    assert np.isnan(out[10:, 1]).all() and np.isfinite(out[:10, 1]).all()
    assert out.shape[1] == 3 and np.isnan(out[: SMALL.span + 1, 2]).all() and np.isfinite(out[SMALL.span + 1, 2]).all()


def test_what_is_kept_of_too_many():
    lengths = np.array([5, 1, 9, 2, 2, 8, 1, 3])
    assert keeping(lengths, 8).tolist() == list(range(8))
    rows = keeping(lengths, 4)
    assert len(set(rows.tolist())) == 4 and {2, 5} <= set(rows.tolist())
    positions = np.where(np.arange(9)[:, None, None] < lengths[:, None], 1.0, np.nan) * np.ones(2)
    assert chosen(positions, 3, 10).shape[1] == 4


def test_chunks_that_can_be_read_once_are_refused(walk):
    with pytest.raises(ValueError, match="can be read only once"):
        track_whole(iter(chunked(walk.frames)))
    with pytest.raises(ValueError, match="has 1 frame, and motion needs at least 2"):
        track_whole(chunked(walk.frames[:1]))
    with pytest.raises(ValueError, match="nothing moves"):
        track_whole(chunked(np.repeat(walk.frames[:1], 6, axis=0)), options=SMALL)
    with pytest.raises(ValueError, match="give one of them"):
        track_whole(chunked(walk.frames), frames=[0, 1, 2], every=2)
