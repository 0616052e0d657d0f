"""What the networks' numbers mean, against loops that say the same."""

from __future__ import annotations

import numpy as np
import pytest

from indexing.pose import blazepose
from indexing.pose.blazepose import (
    HEATMAP,
    LANDMARKS,
    PICTURE,
    REGION,
    PersonCandidates,
    anchors,
    candidates,
    landmarks,
    merge_overlapping,
    overlaps,
    refine_by_heatmap,
    sigmoid,
)  # fmt: skip


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


def test_nobody_is_no_candidate():
    found = candidates(np.zeros((2254, 12)), np.full(2254, -3.0))
    assert len(found) == 0 and found.boxes.shape == (0, 4) and found.points.shape == (0, 4, 2)


def test_values_that_are_none_are_left_out():
    raw = np.zeros((2254, 12))
    raw[:, 2:4] = 20
    raw[:3] = np.nan
    logits = np.full(2254, -9.0)
    logits[:4] = 5
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


@pytest.mark.parametrize("seed", range(5))
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


def test_boxes_that_only_touch_do_not_overlap():
    assert overlaps(np.array([0, 0, 1, 1.0]), np.array([[1, 0, 2, 1.0], [0, 0, 1, 1], [0, 0, 0, 0]])).tolist() == [0, 1, 0]


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


@pytest.mark.parametrize("seed", range(5))
def test_refinement_is_the_mean_of_the_cells_about_a_joint(seed, monkeypatch):
    rng = np.random.default_rng(seed)
    places, heatmap = rng.uniform(-0.1, 1.1, (39, 2)), rng.normal(-3, 2, (64, 64, 39))
    heatmap[..., ::3] -= 20  # nowhere sure
    got = refine_by_heatmap(places, heatmap)
    np.testing.assert_allclose(got, brute_refine(places, heatmap), atol=1e-12)
    assert (got[1::3] != places[1::3]).any() and (got[::3] == places[::3]).all()
    monkeypatch.setattr(blazepose, "HEATMAP_KERNEL", 3)
    monkeypatch.setattr(blazepose, "MIN_HEATMAP_PEAK", 0.2)
    np.testing.assert_allclose(refine_by_heatmap(places, heatmap), brute_refine(places, heatmap, 3, 0.2), atol=1e-12)


def test_places_that_are_none_stay_so():
    places = np.full((39, 2), np.nan)
    places[1] = np.inf
    got = refine_by_heatmap(places, np.zeros((HEATMAP, HEATMAP, LANDMARKS)))
    assert np.isnan(got[0]).all() and np.isinf(got[1]).all()


def test_landmarks_come_in_parts_of_the_region_with_the_lower_probability():
    values = np.zeros((LANDMARKS, 5))
    values[:, :2] = [64, 192]
    values[:, 3], values[:, 4] = 2, -1
    found = landmarks(values, 0.75, np.full((HEATMAP, HEATMAP, LANDMARKS), -50.0))
    np.testing.assert_allclose(found.places, [[64 / REGION, 192 / REGION]] * LANDMARKS)
    np.testing.assert_allclose(found.confidence, 1 / (1 + np.e))
    assert found.present == 0.75 and PICTURE == 224


def test_huge_logits_are_no_overflow():
    assert sigmoid([-1e9, 0, 1e9]).tolist() == pytest.approx([0, 0.5, 1])
