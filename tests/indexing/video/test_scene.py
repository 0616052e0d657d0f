"""Every point of a scene, followed through rendered videos whose truth is known in every pixel, and through folders of pictures."""

import cv2
import numpy as np
import pytest
import torch

import dyntorch as dyn
from indexing.actors.sheets import render, sheet
from indexing.video import Chunk, SceneOptions, track_scene
from indexing.video.sequence import PictureSequence

SIZE, FRAMES = (200, 150), 14
OPTIONS = SceneOptions(count=300)


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
    true = video.followed(points[0], tracks.frames[0], tracks.frames[-1])
    off = np.linalg.norm(points[-1] - true, axis=1)
    return off[np.isfinite(off)]


def test_truth_of_sheets(video):
    """A point that is followed shows the same texture: grey levels differ by noise and interpolation alone."""
    x, y = np.meshgrid(np.arange(10.0, 190, 7), np.arange(10.0, 140, 7))
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    there = video.followed(points, 0, 13)
    kept = (video.shown(points, 0) >= 0) & (video.shown(there, 13) == video.shown(points, 0))
    gray = [
        cv2.remap(video.frames[k].astype(np.float32), *(p[kept].astype(np.float32).T[..., None]), cv2.INTER_LINEAR).ravel()
        for k, p in ((0, points), (13, there))
    ]
    assert kept.sum() > 150 and np.corrcoef(gray)[0, 1] > 0.98
    assert set(video.bodies[video.shown(points, 0)[kept]]) == {0, 1}


def test_background_and_what_moves_are_followed(video):
    tracks = track_scene(stream(video), frames=(0, 6, 13), options=OPTIONS)
    assert tracks.frames == (0, 6, 13) and tracks.times.tolist() == [0.0, 0.6, 1.3] and tracks.size == SIZE
    bodies = video.bodies[video.shown(tracks.points[0].numpy(), 0)]
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


@pytest.mark.parametrize("said", REFUSED)
def test_misuse_is_named(video, said):
    with pytest.raises(ValueError, match=said):
        track_scene(stream(video), options=OPTIONS, **REFUSED[said])


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
