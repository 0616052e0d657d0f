"""Whether the camera moves: scenes with a camera whose motion is known, and people-like blobs that must not count."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from indexing.video import Chunk, camera_motion, stabilize
from indexing.video.motion import robust_motion, shrink_matrix, similarity, transform


def shift(x, y):
    return np.array([[1.0, 0, x], [0, 1, y], [0, 0, 1]])


def turn(angle, focal=300.0, centre=(160, 120)):
    """The homography of a camera that turns about the vertical axis."""
    inner = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1.0]])
    c, s = np.cos(angle), np.sin(angle)
    return inner @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ np.linalg.inv(inner)


def pan(i):
    return shift(-40 * np.clip((i - 30) / 30, 0, 1), 0)


def handheld(i):
    t = i / 30
    x, y = 6 * np.sin(5 * t) + 3 * np.sin(11 * t + 1), 5 * np.sin(4 * t + 2) + 2 * np.sin(9 * t)
    a = 0.01 * np.sin(6 * t + 0.3)
    first = 3 * np.sin(1), 5 * np.sin(2)
    return (
        shift(160 + x - first[0], 120 + y - first[1])
        @ np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        @ shift(-160, -120)
    )


def knock(i):
    return shift(0, 12 if 31 <= i < 37 else 0)


@pytest.fixture(scope="module")
def motion_of(scene):
    """The motion found of a camera, worked out once for all tests that ask about it."""

    @cache
    def found(path, frames):
        return camera_motion(scene(frames, camera=path)[0])

    return found


def test_a_camera_on_a_tripod_stands_still(scene):
    chunks, _ = scene(45, noise=5.0)
    camera = camera_motion(chunks)
    assert not camera.moves and camera.kind == "still" and camera.share == 0 and camera.moments == ()
    assert str(camera) == "camera stands still"
    np.testing.assert_allclose(camera.path, np.broadcast_to(np.eye(3), (45, 3, 3)))


@pytest.mark.slow
@pytest.mark.parametrize(("path", "kind", "start", "stop", "pixels"), [(pan, "pan", 1.0, 2.0, 40), (knock, "knock", 1.0, 1.25, 12)])
def test_when_and_by_how_much_it_moves(motion_of, path, kind, start, stop, pixels):
    camera = motion_of(path, 75)
    assert camera.moves and camera.kind == kind
    (moment,) = camera.moments
    assert (moment.start, moment.stop) == (pytest.approx(start, abs=0.1), pytest.approx(stop, abs=0.15))
    assert moment.pixels == pytest.approx(pixels, abs=1.5)
    assert str(camera) == f"camera moves between {moment.start:.1f} and {moment.stop:.1f} s by {pixels} px ({kind})"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("path", "frames", "kind"),
    [
        (pan, 75, "pan"),
        (handheld, 50, "handheld"),
        (lambda i: turn(0.004 * i), 50, "pan"),
        (lambda i: shift(0.035 * i, 0), 90, "drift"),
    ],
)
def test_the_path_is_the_cameras(motion_of, path, frames, kind):
    camera = motion_of(path, frames)
    corners = np.array([[0.0, 0], [319, 0], [0, 239], [319, 239]])
    truth = np.array([path(i) for i in range(frames)])
    back = transform(camera.path, transform(truth @ np.linalg.inv(truth[0]), corners))
    off = np.linalg.norm(back - corners, axis=-1).max(1)
    assert np.median(off) < 0.5 and off.max() < 2.5
    assert camera.moves and camera.kind == kind


@pytest.mark.slow
def test_stabilized_frames_stand_still(scene):
    still, _ = scene(20, noise=0.0, blobs=0)
    moving, _ = scene(30, camera=handheld, noise=0.0, blobs=0)
    camera = camera_motion(moving)
    inside = np.s_[:, 25:-25, 25:-25]
    first = moving[0].frames[:1].astype(int)
    before = max(np.abs(c.frames.astype(int) - first)[inside].mean() for c in moving)
    after = max(np.abs(c.frames.astype(int) - first)[inside].mean() for c in stabilize(moving, camera))
    assert after < 0.2 * before
    assert [c.times.tolist() for c in stabilize(moving, camera)] == [c.times.tolist() for c in moving]
    still_camera = camera_motion(still)
    assert all((a.frames == b.frames).all() for a, b in zip(still, stabilize(still, still_camera), strict=True))


@pytest.mark.slow
def test_a_cut_is_named(scene):
    (first, _), (second, _) = scene(30, chunk=30), scene(30, seed=7, chunk=30)
    camera = camera_motion([*first, Chunk(second[0].frames, second[0].times + 1.0)])
    assert camera.cuts == (1.0,) and "changes altogether at 1.0 s" in camera.notes[0]


@pytest.mark.slow
def test_pixels_are_those_of_the_video(scene, write):
    chunks, _ = scene(30, camera=lambda i: pan(20 + 1.5 * i), noise=0.0)
    frames = np.concatenate([c.frames for c in chunks]).repeat(3, 1).repeat(3, 2)
    camera = camera_motion(write("big.mp4", frames))
    assert camera.size == (960, 720)
    assert camera.moments[0].pixels == pytest.approx(3 * 40 * 29 / 30, abs=5)


def test_bad_input():
    with pytest.raises(ValueError, match="no frames"):
        camera_motion([])
    with pytest.raises(ValueError, match="gray=True"):
        camera_motion([Chunk(np.zeros((2, 20, 20, 3), np.uint8), np.arange(2.0))])


def test_the_motion_of_most_points():
    rng = np.random.default_rng(0)
    source = rng.uniform(0, 300, (100, 2))
    truth = np.array([[0.99, -0.05, 8], [0.05, 0.99, -3], [0, 0, 1]])
    target = transform(truth, source) + 0.1 * rng.normal(size=(100, 2))
    target[:35] = rng.uniform(0, 300, (35, 2))
    motion, agree = robust_motion(source, target, np.eye(3), 300)
    assert agree[35:].all() and agree[:35].sum() <= 1
    np.testing.assert_allclose(transform(motion, source), transform(truth, source), atol=0.2)


def test_similarity_against_least_squares():
    source, target = np.random.default_rng(1).normal(size=(2, 20, 2))
    (x, y), one, none = source.T, np.ones(20), np.zeros(20)
    rows = np.concatenate([np.stack([x, -y, one, none], 1), np.stack([y, x, none, one], 1)])
    a, b, c, d = np.linalg.lstsq(rows, target.T.ravel(), rcond=None)[0]
    np.testing.assert_allclose(similarity(source, target), [[a, -b, c], [b, a, d], [0, 0, 1]], atol=1e-9)
    cv2 = pytest.importorskip("cv2")
    ramp = np.arange(40, dtype=np.float32)[None].repeat(40, 0)  # value = x
    small = cv2.resize(ramp, (20, 10), interpolation=cv2.INTER_AREA)  # keeps pixel centres
    x = transform(np.linalg.inv(shrink_matrix((0.5, 0.25))), np.array([[3.0, 5.0]]))[0]
    assert x[0] == pytest.approx(float(small[5, 3])) and x[1] == pytest.approx(21.5)
    flat = [Chunk(np.full((10, 120, 160), 128, np.uint8), np.arange(10) / 10)]
    camera = camera_motion(flat)
    assert not camera.moves and "too little background" in camera.notes[0] and np.isfinite(camera.path).all()
