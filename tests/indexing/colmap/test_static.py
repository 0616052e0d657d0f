"""What stands still in scenes whose truth is known, in which more than half of the matches move."""

from __future__ import annotations

import io
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from experiments.segmentation.colmap import mapped, write_scene
from experiments.segmentation.photographs import photographs
from indexing.colmap import StaticOptions, find_static, read_database
from indexing.colmap.pair_segmentation import divide, prepare_image, select_pairs, task
from indexing.colmap.static import draw_mask, gray_png, mask_name, write_masks
from tests.indexing.colmap.test_database import changed, sha256

# torch's own, when it first loads its transforms; hidden outside of tests
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated")


def judged(scene, found):
    """Share of the verified matches that stand still, and of those that stand still the verified ones."""
    pairs = zip(found.database.pairs, found.geometries, strict=True)
    right = np.concatenate([scene.still(pair.first, pair.second, geometry.inliers) for pair, geometry in pairs])
    return float(right.mean()), right.sum() / sum(int(scene.still(*pair, rows).sum()) for pair, rows in scene.matches.items())


def test_static_matches_are_kept_and_moving_ones_are_gone(scene, found):
    assert 0.55 < scene.share < 0.65
    precision, recall = judged(scene, found)
    assert precision > 0.98 and recall > 0.9
    assert found.ok and not found.refused and found.check() is found
    kinds, bodies = np.concatenate(found.keypoints), np.concatenate(scene.bodies)
    assert (kinds[bodies == 1] > 0).mean() < 0.02 and (kinds[bodies == 1] < 0).mean() > 0.8
    assert (kinds[bodies == 0] < 0).mean() < 0.02 and (kinds[bodies == 0] > 0).mean() > 0.8


def test_what_is_written_is_static(scene, given, found, static):
    before = sha256(given)
    database = read_database(static)
    assert sha256(given) == before
    for pair, kept in zip(found.database.pairs, found.kept, strict=True):
        written = next(other for other in database.pairs if other.key == pair.key)
        assert np.array_equal(written.matches, kept)
    opened = pycolmap.Database.open(static)
    assert opened.num_verified_image_pairs() == sum(len(geometry.inliers) > 0 for geometry in found.geometries)
    geometry = opened.read_two_view_geometry(1, 2)
    x1, x2 = (
        np.c_[scene.keypoints[k][geometry.inlier_matches[:, k]].astype(float), np.ones(len(geometry.inlier_matches))]
        for k in (0, 1)
    )
    lines = x1 @ geometry.F.T
    distances = np.abs((x2 * lines).sum(axis=1)) / np.linalg.norm(lines[:, :2], axis=1)
    opened.close()
    assert np.median(distances) < 1.5  # pixels: x2' F x1 = 0 in COLMAP's order


def test_colmap_alone_is_wrong_and_right_afterwards(scene, given, static):
    after = mapped(static, scene)
    assert after.images == 6 and after.error < 1
    assert mapped(given, scene).error > 1


@pytest.mark.slow
def test_several_bodies_and_none(tmp_path):
    for images, bodies, seed, least in ((4, 2, 1, 0.85), (3, 0, 3, 0.95)):
        scene = photographs(images=images, bodies=bodies, matches=130, seed=seed)
        found = find_static(read_database(write_scene(tmp_path / f"{bodies}.db", scene, verify=False)))
        precision, recall = judged(scene, found)
        assert precision > 0.97 and recall > least
    assert found.notes == ("nothing moves: no pair of images has a second body; what is left out are wrong matches",)


def test_too_little_that_stands_still_is_refused_by_name(found, tmp_path):
    strict = StaticOptions(min_static_points=10_000)
    refused = find_static_again(found, strict)
    assert not refused.ok and refused.refused == tuple(range(6))
    assert (
        refused.reason.startswith("fewer than 10000 points stand still in 000.png, 001.png") and "6 of 6 images" in refused.reason
    )
    with pytest.raises(ValueError, match=r"database\.db: fewer than 10000 points stand still in 000\.png"):
        refused.write(tmp_path / "static.db")
    assert list(tmp_path.iterdir()) == []


def test_some_images_without_static_points_are_a_note(found):
    held = [set() for _ in range(6)]
    for pair, geometry in zip(found.database.pairs, found.geometries, strict=True):
        for side, place in enumerate((pair.first, pair.second)):
            held[place].update(geometry.inliers[:, side].tolist())
    least = min(map(len, held))
    some = find_static_again(found, StaticOptions(min_static_points=least + 1))
    assert some.ok and len(some.refused) >= 1
    assert some.notes[0].endswith("COLMAP will leave it out") and some.database.images[some.refused[0]].name in some.notes[0]


def find_static_again(found, options):
    """The same divisions, another judgement."""
    from indexing.colmap import static

    bodies = iter(found.bodies)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(static, "divide", lambda *_: next(bodies))
        return find_static(found.database, options=options)


def test_of_each_image_the_pairs_with_most_matches_are_divided(found):
    few = select_pairs(found.database, StaticOptions(pairs_per_image=1))
    images = {place for pair in few for place in (found.database.pairs[pair].first, found.database.pairs[pair].second)}
    assert images == set(range(6)) and len(few) < len(found.database.pairs)
    assert select_pairs(found.database, StaticOptions(min_matches=10_000)) == []


def test_matches_beyond_the_most_join_those_beside_them(scene, found):
    """Half of the matches are divided, and nearly as many are labelled as if all were."""
    images = [prepare_image(found.database, image) for image in found.database.images]
    pair, whole = found.database.pairs[0], found.bodies[0]
    half = divide(task(pair, images, 2.5, True, 0, StaticOptions(max_matches=len(pair.matches) // 2)))
    still = scene.still(pair.first, pair.second, pair.matches)
    moving = scene.right(pair.first, pair.second, pair.matches) & ~still
    assert (half.labels > 0).sum() > 0.85 * (whole.labels > 0).sum()
    of_scene = np.bincount(half.labels[still]).argmax()
    assert of_scene > 0 and (half.labels[moving] == of_scene).mean() < 0.05
    assert (half.labels[still] == of_scene).mean() > 0.8


def test_lens_distortion_is_undone(given, tmp_path):
    """A camera of COLMAP's model SIMPLE_RADIAL: number 2, with parameters f, cx, cy, k."""
    params = np.array([700.0, 480, 360, -0.1]).tobytes().hex()
    path = changed(given, tmp_path / "bent.db", f"UPDATE cameras SET model = 2, params = x'{params}'")
    database = read_database(path)
    image = prepare_image(database, database.images[0])
    rays = (image.points - [480, 360]) / 700
    bent = rays * (1 - 0.1 * (rays**2).sum(axis=1, keepdims=True)) * 700 + [480, 360]
    assert np.abs(bent - database.images[0].points).max() < 1e-3


def test_a_camera_that_colmap_does_not_know_and_colmap_that_is_not_there(given, tmp_path, monkeypatch):
    for change, said in (("model = 99", "model that pycolmap .* does not know"), ("params = x''", "0 parameters")):
        path = changed(given, tmp_path / "odd.db", f"UPDATE cameras SET {change}")
        with pytest.raises(ValueError, match=rf"odd\.db: the camera of image 000\.png .*{said}"):
            find_static(read_database(path))
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(ValueError, match=r"pip install 'dyntorch\[colmap\]'"):
        find_static(read_database(given))


@pytest.mark.slow
def test_whoever_divides_the_pairs_gives_the_same(tmp_path):
    """What a pair gives hangs on nothing but the pair."""
    database = read_database(write_scene(tmp_path / "a.db", photographs(images=3, matches=80, seed=2), verify=False))
    with ThreadPoolExecutor(2) as executor:
        shared, told = find_static(database, executor=executor), []
    alone = find_static(database, progress=lambda *done: told.append(done))
    assert all(np.array_equal(a, b) for a, b in zip(shared.kept, alone.kept, strict=True))
    assert told == [(1, 3), (2, 3), (3, 3)]


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


def test_masks_are_discs_that_close_up_but_for_static_points():
    grid = np.stack(np.meshgrid(np.arange(300, 500, 12.0), np.arange(200, 400, 12.0)), axis=-1).reshape(-1, 2)
    mask = draw_mask(grid, np.zeros((0, 2)), (960, 720))
    assert (mask[200:390, 300:490] == 0).all()
    assert (mask[:150] == 255).all() and (mask[:, :240] == 255).all()
    mask = draw_mask(np.array([[100.0, 50]]), np.array([[104.0, 50]]), (400, 300))
    assert mask[50, 99] == 0 and mask[50, 104] == 255
    assert (draw_mask(np.zeros((0, 2)), np.ones((3, 2)), (30, 20)) == 255).all()  # nothing moves
    mask = draw_mask(np.array([[4000.0, 3000.0]]), np.zeros((0, 2)), (8000, 6000))  # drawn small, and enlarged
    assert mask.shape == (6000, 8000) and mask[3000, 4000] == 0 and mask[0, 0] == 255
    mask = np.random.default_rng(0).choice(np.array([0, 255], dtype=np.uint8), (7, 5))
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(gray_png(mask)))), mask)


def test_names_that_lead_out_are_refused():
    for name in ("../a.jpg", "/etc/a.jpg", "C:\\a.jpg", "a/../../b.jpg", "", "..\\a.jpg"):
        with pytest.raises(ValueError, match="leads out of the folder of images"):
            mask_name(Path("a.db"), name)


def test_folders_of_images_are_folders_of_masks(found, tmp_path):
    database = found.database
    images = tuple(replace(image, name=f"left/{image.name}") for image in database.images)
    write_masks(tmp_path, replace(found, database=replace(database, images=images)))
    assert (tmp_path / "left" / "000.png.png").exists()
