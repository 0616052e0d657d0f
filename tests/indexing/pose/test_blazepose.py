"""What the networks' numbers mean, against loops that say the same."""

from __future__ import annotations

import math

import numpy as np
import pytest

from indexing.pose import blazepose
from indexing.pose.blazepose import (
    HEATMAP,
    JOINTS,
    LANDMARKS,
    PICTURE,
    REGION,
    PersonCandidates,
    Region,
    VideoPicture,
    about,
    anchors,
    candidates,
    landmarks,
    merge_overlapping,
    refine_by_heatmap,
)  # fmt: skip
from tests.grid import grid
from tests.indexing.pose.scene import SceneNetworks, drawn, joints_of, written


def test_anchors_are_the_cells_of_the_grids_row_by_row():
    expected = [
        ((column + 0.5) / cells, (row + 0.5) / cells)
        for cells, each in ((28, 2), (14, 2), (7, 6))
        for row in range(cells)
        for column in range(cells)
        for _ in range(each)
    ]
    assert len(expected) == 2254
    np.testing.assert_allclose(anchors(), expected)


def test_a_candidate_is_measured_from_its_anchor():
    raw, logits = np.zeros((2254, 12)), np.full((2254, 1), -9.0)
    at = 1568 + 2 * (14 * 3 + 5)  # fourth row, sixth column of the second grid
    raw[at] = [10, 20, 30, 40, 1, 2, 3, 4, 5, 6, 7, 8]
    logits[at] = 1.0
    found = candidates(raw, logits)
    x, y = 5.5 / 14, 3.5 / 14
    np.testing.assert_allclose(found.boxes, [[x - 5 / 224, y, x + 25 / 224, y + 40 / 224]])
    np.testing.assert_allclose(found.points[0], [[x + k / 224, y + (k + 1) / 224] for k in (1, 3, 5, 7)])
    np.testing.assert_allclose(found.scores, 1 / (1 + np.exp(-1)))


def test_nobody_and_values_that_are_none_are_no_candidates():
    found = candidates(np.zeros((2254, 12)), np.full(2254, -3.0))
    assert len(found) == 0 and found.boxes.shape == (0, 4) and found.points.shape == (0, 4, 2)
    raw, logits = np.zeros((2254, 12)), np.full(2254, -9.0)
    raw[:, 2:4], raw[:3], logits[:4] = 20, np.nan, 5
    assert len(candidates(raw, logits)) == 1


def brute_merge(scores, boxes, values, threshold):
    """Weighted suppression, one box after the other."""
    left, out = sorted(range(len(scores)), key=lambda i: -scores[i]), []
    while left:
        best, group, rest = left[0], [], []
        for i in left:
            a, b = boxes[best], boxes[i]
            w, h = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
            common = w * h if w > 0 and h > 0 else 0.0
            area = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - common
            (group if i == best or common / area > threshold else rest).append(i)
        total = sum(scores[i] for i in group)
        out.append(
            (scores[best], sum(scores[i] * boxes[i] for i in group) / total, sum(scores[i] * values[i] for i in group) / total)
        )
        left = rest
    return out


@grid(("seed", range(5)))
def test_people_are_merged_as_box_after_box_says(seed):
    rng = np.random.default_rng(seed)
    corner, size = rng.uniform(0, 1, (40, 2)), rng.uniform(0.1, 0.4, (40, 2))
    boxes, points, scores = np.hstack([corner, corner + size]), rng.normal(size=(40, 4, 2)), rng.uniform(0.5, 1, 40)
    found = merge_overlapping(PersonCandidates(scores, boxes, points), 0.3)
    expected = brute_merge(scores, boxes, points, 0.3)
    assert len(found) == len(expected) < 40
    for i, (score, box, point) in enumerate(expected):
        np.testing.assert_allclose(found.scores[i], score)
        np.testing.assert_allclose(found.boxes[i], box)
        np.testing.assert_allclose(found.points[i], point)


def brute_refine(places, heatmap, kernel=7, sure=0.5):
    """MediaPipe's refinement, cell by cell."""
    rows, columns, count = heatmap.shape
    out = np.array(places, float)
    for k in range(count):
        column, row = int(np.floor(places[k, 0] * columns)), int(np.floor(places[k, 1] * rows))
        if not (0 <= column < columns and 0 <= row < rows):
            continue
        half, total, x, y, best = (kernel - 1) // 2, 0.0, 0.0, 0.0, 0.0
        for j in range(max(0, row - half), min(rows, row + half + 1)):
            for i in range(max(0, column - half), min(columns, column + half + 1)):
                weight = 1 / (1 + np.exp(-heatmap[j, i, k]))
                total, x, y, best = total + weight, x + weight * i, y + weight * j, max(best, weight)
        if best >= sure and total > 0:
            out[k] = x / total / columns, y / total / rows
    return out


@pytest.mark.parametrize(("kernel", "sure"), [(7, 0.5), (3, 0.2)])
def test_refinement_is_the_mean_of_the_cells_about_a_joint(kernel, sure, monkeypatch):
    monkeypatch.setattr(blazepose, "HEATMAP_KERNEL", kernel)
    monkeypatch.setattr(blazepose, "MIN_HEATMAP_PEAK", sure)
    for seed in range(5):
        rng = np.random.default_rng(seed)
        places, heatmap = rng.uniform(-0.1, 1.1, (39, 2)), rng.normal(-3, 2, (64, 64, 39))
        heatmap[..., ::3] -= 20  # nowhere sure
        got = refine_by_heatmap(places, heatmap)
        np.testing.assert_allclose(got, brute_refine(places, heatmap, kernel, sure), atol=1e-12)
        assert (got[1::3] != places[1::3]).any() and (got[::3] == places[::3]).all()
        places[:2] = np.array([[np.nan], [np.inf]])
        np.testing.assert_array_equal(refine_by_heatmap(places, heatmap)[:2], places[:2])


def test_landmarks_come_in_parts_of_the_region_with_the_lower_probability():
    values = np.zeros((LANDMARKS, 5))
    values[:, :2] = [64, 192]
    values[:, 3], values[:, 4] = 2, -1
    found = landmarks(values, 0.75, np.full((HEATMAP, HEATMAP, LANDMARKS), -50.0))
    np.testing.assert_allclose(found.places, [[64 / REGION, 192 / REGION]] * LANDMARKS)
    np.testing.assert_allclose(found.confidence, 1 / (1 + np.e))
    assert found.present == 0.75 and PICTURE == 224


av = pytest.importorskip("av")
pytest.importorskip("cv2")


@grid(("degrees", [0, 30, 90, 135, 180, -60]))
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


@grid(("size", [(321, 243), (1280, 720)]), ("degrees", [40, 170]), ("scale", [0.1, 0.3]))
def test_what_is_seen_in_a_region_is_put_back_where_it_is(tmp_path, size, degrees, scale):
    width, height = (side // 2 * 2 for side in size)
    hips, length = np.array([0.45 * width, 0.55 * height]), scale * height
    circle = hips + length * np.array([math.sin(math.radians(degrees)), -math.cos(math.radians(degrees))])
    picture = VideoPicture(frame_of(tmp_path, drawn([(hips, circle)], width, height)))
    region = about(hips + 3, circle - 2, 1.25)
    values, present, _ = SceneNetworks().landmarks(picture.extract_region(region, REGION))
    assert present > 0.5
    got = region.to_picture(values[:JOINTS, :2].astype(float) / REGION)
    np.testing.assert_allclose(got, joints_of(hips, circle), atol=max(1.0, 0.02 * length))


def test_levels_halve_exactly_and_the_edge_goes_on_or_is_black(tmp_path):
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (46, 62, 3)).astype(np.uint8)
    picture = VideoPicture(frame_of(tmp_path, image))
    base = picture.level(0).astype(float)
    assert [picture.level(k).shape[:2] for k in range(4)] == [(46, 62), (23, 31), (11, 15), (5, 7)]
    np.testing.assert_allclose(picture.level(1), base.reshape(23, 2, 31, 2, 3).mean(axis=(1, 3)), atol=1)
    frame = frame_of(tmp_path, np.full((64, 64, 3), 200, np.uint8))
    picture, outside = VideoPicture(frame), Region(0, 32, 64)
    assert picture.extract_region(outside, 64).min() > 190
    assert (picture.extract_region(outside, 64, fill=True)[:, :30] == 0).all()
    picture = VideoPicture(frame, (32, 48))
    assert (picture.width, picture.height) == (32, 48) and picture.level(0).shape == (48, 32, 3)
