"""Cameras against geometry done by hand."""

import numpy as np
import pytest

from indexing import Clip
from indexing.cameras import perspective, rotation, virtual, y_up

UP = {"y": [0, 1, 0], "-y": [0, -1, 0], "z": [0, 0, 1], "-z": [0, 0, -1]}


def cloud(frames=4, joints=6, seed=0):
    return np.random.default_rng(seed).normal(size=(frames, joints, 3))


@pytest.mark.parametrize("up", UP)
def test_y_up_is_a_rotation_that_turns_up_into_y(up):
    axes = Clip(np.eye(3)[None], up=up)
    turned = y_up(axes)[0].T  # columns: where the axes go
    np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=0)
    assert np.linalg.det(turned) == pytest.approx(1.0)
    np.testing.assert_array_equal(turned @ np.array(UP[up]), [0, 1, 0])
    joints = cloud()
    joints[1, 2] = np.nan
    assert np.argwhere(np.isnan(y_up(Clip(joints, up=up))).any(axis=2)).tolist() == [[1, 2]]


def test_y_up_of_images():
    joints = cloud()[..., :2].astype(np.float32)
    np.testing.assert_array_equal(y_up(Clip(joints)), joints)
    np.testing.assert_array_equal(y_up(Clip(joints, up="-y")), joints * [1, -1])
    assert y_up(Clip(joints, up="-y")).dtype == np.float32


def test_rotation_conventions():
    np.testing.assert_allclose(rotation(0, 0), np.eye(3), atol=0)
    # a quarter turn about the vertical: what was at the right (x) comes nearer (-z), what was deep (z) comes right
    np.testing.assert_allclose(rotation(np.pi / 2, 0) @ [1, 0, 0], [0, 0, -1], atol=1e-15)
    np.testing.assert_allclose(rotation(np.pi / 2, 0) @ [0, 0, 1], [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(rotation(0, np.pi / 2) @ [0, 1, 0], [0, 0, 1], atol=1e-15)
    for a, e in np.random.default_rng(1).uniform(-3, 3, (5, 2)):
        r = rotation(a, e)
        np.testing.assert_allclose(r @ r.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(r) == pytest.approx(1)
        np.testing.assert_allclose(r, rotation(0, e) @ rotation(a, 0), atol=1e-15)  # azimuth first
        assert (r @ [0, 1, 0])[0] == pytest.approx(0)  # the vertical stays vertical in the image


def test_perspective_divides_by_depth():
    joints = np.array([[[1.0, 2.0, 2.0], [3.0, -6.0, 3.0], [np.nan, 0.0, 1.0]]])
    image = perspective(Clip(joints, up="-y", name="a", label="wave", confidence=np.ones((1, 3))))
    np.testing.assert_allclose(image.joints[0, :2], [[0.5, 1.0], [1.0, -2.0]])
    assert np.isnan(image.joints[0, 2]).any()
    assert (image.dims, image.up, image.label, image.name) == (2, "-y", "wave", "a")


def test_perspective_refuses():
    for clip, message in (
        (Clip(np.zeros((2, 3, 2)), name="flat"), "clip 'flat': a perspective camera needs 3D joints, got 2D"),
        (Clip(cloud() - [0, 0, 9], name="b"), "clip 'b': a joint has depth z = -.* not in camera coordinates"),
        (Clip(np.zeros((2, 3, 3)), name="c"), "depth z = 0"),
        (Clip(cloud() + 9, up="z"), "up='z'"),
    ):
        with pytest.raises(ValueError, match=message):
            perspective(clip)


def person():
    """A cross of height 3 about the origin: feet, head, right, left, front, back; two frames."""
    one = np.array([[0, -1.5, 0], [0, 1.5, 0], [1, 0, 0], [-1, 0, 0], [0, 0, 1], [0, 0, -1]], dtype=float)
    return np.stack([one, one])


def test_virtual_view_by_hand():
    clip = Clip(person() + np.array([10, 20, 30]), label="stand")  # anywhere
    image = virtual(clip, 0.0, 0.0, distance=4.0, height=1.5)
    # scaled by 1.5 / 3: x / (z + 4) * 4
    expected = [[0, -0.75], [0, 0.75], [0.5, 0], [-0.5, 0], [0, 0], [0, 0]]
    np.testing.assert_allclose(image.joints[0], expected, atol=1e-12)
    assert (image.dims, image.up, image.label) == (2, "y", "stand")
    side = virtual(clip, 90.0, 0.0, distance=4.0, height=1.5)
    # z comes to x, and x goes to -z: the one at +x is nearer now
    np.testing.assert_allclose(side.joints[0, 4:], [[0.5, 0], [-0.5, 0]], atol=1e-12)
    np.testing.assert_allclose(side.joints[0, 2:4], 0, atol=1e-12)


def test_virtual_view_is_the_rotation_and_perspective():
    shape = cloud(3, 8)
    for azimuth, elevation, distance in ((35.0, 0.2, 50.0), (0.0, 0.0, 4.0)):
        image = virtual(Clip(shape), azimuth, elevation, distance=distance, height=1.0).joints
        points = (shape - shape.mean(axis=(0, 1))) / np.median(np.ptp(shape[..., 1], axis=1))
        points = points @ rotation(np.deg2rad(azimuth), elevation).T
        np.testing.assert_allclose(image, distance * points[..., :2] / (points[..., 2:] + distance), atol=1e-12)


@pytest.mark.parametrize(("up", "turn"), [("-y", [1, -1, -1]), ("z", None), ("-z", None)])
def test_virtual_view_does_not_depend_on_the_frame_of_the_data(up, turn):
    upright = person()
    x, y, z = np.moveaxis(upright, 2, 0)
    data = {"-y": (x, -y, -z), "z": (x, -z, y), "-z": (x, z, -y)}[up]
    np.testing.assert_allclose(
        virtual(Clip(np.stack(data, axis=2), up=up), 40.0).joints, virtual(Clip(upright), 40.0).joints, atol=1e-12
    )


def test_virtual_scale_is_the_median_height_whatever_is_missing_or_large():
    shape = np.repeat(person()[:1], 5, axis=0)
    shape[4] *= 1.5  # one tall frame does not matter
    shape[2, 0] = np.nan  # nor one without feet
    image = virtual(Clip(shape), 0.0, 0.0, distance=1e6).joints
    assert np.ptp(image[0, :, 1]) == pytest.approx(1.5, rel=1e-4)
    assert np.isnan(image[2, 0]).all() and np.isnan(image).sum() == 2
    np.testing.assert_allclose(virtual(Clip(shape * 1000), 0.0, 0.0, distance=1e6).joints, image, rtol=1e-9, atol=1e-9)


def test_noise_is_on_the_joints_and_repeats_with_the_seed():
    shape = np.repeat(person(), 500, axis=0)
    clean = virtual(Clip(shape), 0.0, 0.0, distance=100.0)
    a, b = (virtual(Clip(shape), 0.0, 0.0, distance=100.0, random_state=np.random.default_rng(3)) for _ in range(2))
    np.testing.assert_array_equal(a.joints, b.joints)
    assert (a.joints - clean.joints).std() == pytest.approx(0.015, rel=0.05)


def test_virtual_refuses():
    for clip, message in (
        (Clip(np.zeros((2, 3, 2)), name="flat"), "clip 'flat': a virtual camera needs 3D joints"),
        (Clip(np.full((2, 3, 3), np.nan), name="n"), "clip 'n': no joint was seen"),
        (Clip(np.zeros((2, 3, 3)), name="z"), "clip 'z': the joints have no vertical extent"),
        (Clip(cloud(2, 1), name="one"), "clip 'one': the joints have no vertical extent"),
    ):
        with pytest.raises(ValueError, match=message):
            virtual(clip, 0.0)
