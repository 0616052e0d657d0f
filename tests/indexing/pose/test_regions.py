"""Regions: their geometry, what is cut out of frames held in every way, and what comes back."""

from __future__ import annotations

import math

import numpy as np
import pytest

from indexing.pose.blazepose import JOINTS, REGION, Region, VideoPicture, about
from tests.indexing.pose.scene import SceneNetworks, drawn, joints_of, written

av = pytest.importorskip("av")
pytest.importorskip("cv2")


@pytest.mark.parametrize("degrees", [0, 30, 90, 135, 180, -60])
def test_a_region_is_turned_so_that_the_body_stands_upright(degrees):
    angle = math.radians(degrees)
    hips, up = np.array([300.0, 200.0]), np.array([math.sin(angle), -math.cos(angle)])
    region = about(hips, hips + 80 * up, 1.25)
    assert (region.x, region.y) == (300, 200) and region.side == pytest.approx(200)
    np.testing.assert_allclose(region.to_picture(np.array([0.5, 0.5 - 80 / 200])), hips + 80 * up, atol=1e-9)
    right = region.to_picture(np.array([1.0, 0.5])) - hips
    np.testing.assert_allclose(right, 100 * np.array([-up[1], up[0]]), atol=1e-9)


@pytest.mark.parametrize("region", [Region(1, 1, 5), Region(1, 1, 9e9), Region(-500, 20, 90), Region(math.nan, 1, 90)])
def test_regions_that_show_nothing(region):
    assert not region.usable(320, 240) and Region(160, 120, 90).usable(320, 240)


def frame_of(tmp_path, image, rotation=None):
    path = written(tmp_path / "a.mp4", [image], rotation=rotation)
    return next(av.open(str(path)).decode(video=0))


@pytest.mark.parametrize("size", [(321, 243), (1280, 720)])
@pytest.mark.parametrize("degrees", [0, 40, 170])
@pytest.mark.parametrize("scale", [0.1, 0.3])
def test_what_is_seen_in_a_region_is_put_back_where_it_is(tmp_path, size, degrees, scale):
    width, height = (side // 2 * 2 for side in size)
    hips, length = np.array([0.45 * width, 0.55 * height]), scale * height
    circle = hips + length * np.array([math.sin(math.radians(degrees)), -math.cos(math.radians(degrees))])
    picture = VideoPicture(frame_of(tmp_path, drawn([(hips, circle)], width, height)))
    region = about(hips + 3, circle - 2, 1.25)
    values, present, _ = SceneNetworks().landmarks(picture.cut(region, REGION))
    assert present > 0.5
    got = region.to_picture(values[:JOINTS, :2].astype(float) / REGION)
    np.testing.assert_allclose(got, joints_of(hips, circle), atol=max(1.0, 0.02 * length))


@pytest.mark.parametrize("rotation", [0, 90, 180, -90])
def test_frames_of_phones_are_cut_upright(tmp_path, rotation):
    if not hasattr(av.VideoStream, "set_display_rotation"):
        pytest.skip("this PyAV cannot write rotated videos")
    stored = drawn([((100, 80), (100, 40))], 256, 192)
    frame = frame_of(tmp_path, stored, rotation)
    upright = np.rot90(stored, rotation // 90)  # counter-clockwise, as PyAV's angle
    picture = VideoPicture(frame)
    assert (picture.width, picture.height) == upright.shape[1::-1]
    whole = picture.cut(Region(picture.width / 2, picture.height / 2, 256), 256, fill=True)
    x, y = (256 - picture.width) // 2, (256 - picture.height) // 2
    shown = whole[y : y + picture.height, x : x + picture.width]
    assert np.abs(shown.astype(int) - upright).mean() < 6
    assert (whole[: max(y, 1) * (y > 0)] == 0).all()


def test_levels_halve_exactly_and_odd_lines_are_left_out(tmp_path):
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (46, 62, 3)).astype(np.uint8)
    picture = VideoPicture(frame_of(tmp_path, image))
    base = picture.level(0).astype(float)
    assert [picture.level(k).shape[:2] for k in range(4)] == [(46, 62), (23, 31), (11, 15), (5, 7)]
    np.testing.assert_allclose(picture.level(1), base.reshape(23, 2, 31, 2, 3).mean(axis=(1, 3)), atol=1)


def test_the_edge_goes_on_or_is_black(tmp_path):
    picture = VideoPicture(frame_of(tmp_path, np.full((64, 64, 3), 200, np.uint8)))
    outside = Region(0, 32, 64)
    assert picture.cut(outside, 64).min() > 190
    assert (picture.cut(outside, 64, fill=True)[:, :30] == 0).all()


def test_frames_of_another_size_are_brought_to_the_first_ones(tmp_path):
    picture = VideoPicture(frame_of(tmp_path, np.full((64, 64, 3), 90, np.uint8)), (32, 48))
    assert (picture.width, picture.height) == (32, 48) and picture.level(0).shape == (48, 32, 3)
