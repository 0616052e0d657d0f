"""Masks: black around what moves, white around what stands still, under COLMAP's names."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from indexing.colmap.static import draw_mask, gray_png, mask_name, write_masks


def test_masks_cover_the_moving_points_and_leave_the_static_ones(scene, found, tmp_path):
    write_masks(tmp_path / "masks", found)
    written = sorted(path.name for path in (tmp_path / "masks").iterdir())
    assert written == [f"{name}.png" for name in scene.names]
    for name, points, bodies in zip(scene.names, scene.keypoints, scene.bodies, strict=True):
        mask = np.asarray(Image.open(tmp_path / "masks" / f"{name}.png"))
        assert mask.shape == (720, 960) and set(np.unique(mask)) == {0, 255}
        x, y = np.floor(points).astype(int).clip(0, [959, 719]).T
        assert (mask[y, x][bodies == 1] == 0).mean() > 0.9
        assert (mask[y, x][bodies == 0] == 255).mean() > 0.9


def test_discs_of_a_body_close_up():
    grid = np.stack(np.meshgrid(np.arange(300, 500, 12.0), np.arange(200, 400, 12.0)), axis=-1).reshape(-1, 2)
    mask = draw_mask(grid, np.zeros((0, 2)), (960, 720))
    assert (mask[200:390, 300:490] == 0).all()
    assert (mask[:150] == 255).all() and (mask[:, :240] == 255).all()


def test_static_points_keep_their_surroundings():
    mask = draw_mask(np.array([[100.0, 50]]), np.array([[104.0, 50]]), (400, 300))
    assert mask[50, 99] == 0 and mask[50, 104] == 255


def test_an_image_in_which_nothing_moves_is_white():
    assert (draw_mask(np.zeros((0, 2)), np.ones((3, 2)), (30, 20)) == 255).all()


def test_large_images_are_drawn_small_and_enlarged():
    mask = draw_mask(np.array([[4000.0, 3000.0]]), np.zeros((0, 2)), (8000, 6000))
    assert mask.shape == (6000, 8000) and mask[3000, 4000] == 0 and mask[0, 0] == 255


def test_the_png_is_one(tmp_path):
    mask = np.random.default_rng(0).choice(np.array([0, 255], dtype=np.uint8), (7, 5))
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(gray_png(mask)))), mask)


@pytest.mark.parametrize("name", ["../a.jpg", "/etc/a.jpg", "C:\\a.jpg", "a/../../b.jpg", "", "..\\a.jpg"])
def test_names_that_lead_out_are_refused(name):
    with pytest.raises(ValueError, match="leads out of the folder of images"):
        mask_name(Path("a.db"), name)


def test_folders_of_images_are_folders_of_masks(found, tmp_path):
    database = found.database
    images = tuple(replace(image, name=f"left/{image.name}") for image in database.images)
    write_masks(tmp_path, replace(found, database=replace(database, images=images)))
    assert (tmp_path / "left" / "000.png.png").exists()
