"""What the numbers mean that BlazePose's two networks give: people in a picture, and the joints of one person.

The detector answers on a grid of anchors, of which each may give a box and four points; landmarks come as coordinates of a square
region and as heatmaps, and the heatmaps refine the coordinates.  Coordinates here are parts of the picture or region, from 0 at its
left or upper edge to 1 at the other.

Source: Bazarevsky et al., "BlazePose: On-device Real-time Body Pose tracking", 2020; the graphs of MediaPipe 0.10 (Apache-2.0) say
how the outputs are read, and everything here is written from that description.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]

# ---- the formats of the networks ----
PICTURE, REGION = 224, 256  # pixels, the sides of what the detector and the network of landmarks see
HEATMAP = 64  # cells, the sides of what the network of landmarks gives
GRIDS = ((28, 2), (14, 2), (7, 6))  # cells per side, and anchors in each
POINTS = 4  # of a detection: hips, circle about the body, shoulders, circle about the upper body
LANDMARKS = 39  # 33 joints, two that say where the body is, four of the hands
JOINTS, HIPS, CIRCLE = 33, 33, 34
CLIPPED = 100.0  # of logits, before the exponential

DUPLICATE_OVERLAP = 0.3  # of two boxes (intersection over union); MediaPipe's value
HEATMAP_KERNEL = 7  # cells about a joint whose mean refines its place; MediaPipe's value
MIN_HEATMAP_PEAK = 0.5  # from which on it does; MediaPipe's value


@cache
def anchors() -> Floats:
    """``(2254, 2)`` centres of the detector's anchors, in parts of the picture."""
    found = []
    for cells, each in GRIDS:
        middle = (np.arange(cells) + 0.5) / cells
        x, y = np.meshgrid(middle, middle)
        found.append(np.repeat(np.stack([x, y], axis=-1).reshape(-1, 2), each, axis=0))
    return np.concatenate(found)


def sigmoid(logits: Any) -> Floats:
    """Probabilities of logits."""
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(np.asarray(logits, dtype=np.float64), -CLIPPED, CLIPPED))))


@dataclass(frozen=True, eq=False)
class PersonCandidates:
    """People in a picture, the surest first, in parts of it."""

    scores: Floats
    boxes: Floats
    points: Floats

    def __len__(self) -> int:
        return len(self.scores)


def candidates(raw: Floats, logits: Floats, min_score: float = 0.5) -> PersonCandidates:
    """People from the detector's outputs. raw ``(2254, 12)``, logits ``(2254,)``."""
    scores = sigmoid(logits).reshape(-1)
    chosen = np.flatnonzero(scores >= min_score)
    values = np.asarray(raw, dtype=np.float64)[chosen].reshape(-1, 2 + POINTS, 2) / PICTURE
    centre, size, points = values[:, 0] + anchors()[chosen], values[:, 1], values[:, 2:] + anchors()[chosen][:, None]
    boxes = np.concatenate([centre - size / 2, centre + size / 2], axis=1)
    fine = np.isfinite(values).all(axis=(1, 2)) & (size > 0).all(axis=1)
    return merge_overlapping(PersonCandidates(scores[chosen][fine], boxes[fine], points[fine]), DUPLICATE_OVERLAP)


def merge_overlapping(found: PersonCandidates, overlap: float) -> PersonCandidates:
    """One candidate of each group whose boxes overlap: the mean of their coordinates, weighted by their scores."""
    left = np.argsort(-found.scores, kind="stable")
    scores, boxes, points = [], [], []
    while len(left):
        same = overlaps(found.boxes[left[0]], found.boxes[left]) > overlap
        same[0] = True
        group, left = left[same], left[~same]
        weights = found.scores[group] / found.scores[group].sum()
        scores.append(found.scores[group[0]])
        boxes.append(weights @ found.boxes[group])
        points.append(np.tensordot(weights, found.points[group], axes=1))
    shape = (-1, POINTS, 2)
    return PersonCandidates(np.array(scores), np.array(boxes).reshape(-1, 4), np.array(points).reshape(shape))


def overlaps(box: Floats, boxes: Floats) -> Floats:
    """``(k,)`` intersection over union of a box ``(4,)`` with others ``(k, 4)``."""
    low, high = np.maximum(box[:2], boxes[:, :2]), np.minimum(box[2:], boxes[:, 2:])
    common = np.clip(high - low, 0, None).prod(axis=1)
    areas = np.clip(boxes[:, 2:] - boxes[:, :2], 0, None).prod(axis=1)
    either = areas + np.clip(box[2:] - box[:2], 0, None).prod() - common
    return np.asarray(np.where(either > 0, common / np.where(either > 0, either, 1.0), 0.0))


@dataclass(frozen=True, eq=False)
class Landmarks:
    """One person in a region."""

    present: float  # probability that there is a person
    places: Floats  # ``(39, 2)`` in parts of the region; the first 33 are the joints
    confidence: Floats


def landmarks(values: Floats, present: float, heatmap: Floats) -> Landmarks:
    """A person from the outputs of the network of landmarks. values ``(39, 5)``, heatmap ``(h, w, 39)``."""
    table = np.asarray(values, dtype=np.float64).reshape(LANDMARKS, -1)
    places = refine_by_heatmap(table[:, :2] / REGION, heatmap)
    return Landmarks(float(present), places, sigmoid(table[:, 3:5]).min(axis=1))


def refine_by_heatmap(places: Floats, heatmap: Floats) -> Floats:
    """Places moved to the mean of the heatmap's cells about them, where one of these is sure."""
    rows, columns, count = heatmap.shape
    column, row = np.nan_to_num(np.floor(places * [columns, rows]), nan=-1).clip(-1, max(rows, columns)).astype(np.intp).T
    reach = np.arange(HEATMAP_KERNEL) - (HEATMAP_KERNEL - 1) // 2
    y, x = (row[:, None] + reach)[:, :, None], (column[:, None] + reach)[:, None, :]
    inside = (y >= 0) & (y < rows) & (x >= 0) & (x < columns)
    cells = heatmap[y.clip(0, rows - 1), x.clip(0, columns - 1), np.arange(count)[:, None, None]]
    sure = np.where(inside, sigmoid(cells), 0.0)
    total = sure.sum(axis=(1, 2))
    use = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    use &= (sure.max(axis=(1, 2)) >= MIN_HEATMAP_PEAK) & (total > 0)
    weight = np.where(use, total, 1.0)
    moved = np.stack([(sure * x).sum(axis=(1, 2)) / weight / columns, (sure * y).sum(axis=(1, 2)) / weight / rows], axis=1)
    return np.asarray(np.where(use[:, None], moved, places))
