"""What BlazePose's two networks see and say: regions of a picture, people in it, and the joints of one person.

The detector answers on a grid of anchors, of which each may give a box and four points; landmarks come as coordinates of a square
region and as heatmaps, and the heatmaps refine the coordinates.  Coordinates here are parts of the picture or region, from 0 at its
left or upper edge to 1 at the other; those of a whole video's picture are pixels as it is shown, from 0 to the width or height.

Source: Bazarevsky et al., "BlazePose: On-device Real-time Body Pose tracking", 2020; the graphs of MediaPipe 0.10 (Apache-2.0) say
how the outputs are read, and everything here is written from that description.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from indexing.video.reading import Orientation, cv2, orientation

Floats = NDArray[np.floating[Any]]

# ---- the formats of the networks ----
PICTURE, REGION = 224, 256  # pixels, the sides of what the detector and the network of landmarks see
HEATMAP = 64  # cells, the sides of what the network of landmarks gives
GRIDS = ((28, 2), (14, 2), (7, 6))  # cells per side, and anchors in each
POINTS = 4  # of a detection: hips, circle about the body, shoulders, circle about the upper body
LANDMARKS = 39  # 33 joints, two that say where the body is, four of the hands
JOINTS, HIPS, CIRCLE = 33, 33, 34

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
    return np.asarray(expit(np.asarray(logits, dtype=np.float64)))


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


# ----------------------------------------------------------------------------------------------------------------------
# Square regions of a picture, turned with the body: cut out as the networks want them, and what they say put back.


Image = NDArray[np.uint8]

MIN_REGION_SIDE = 12.0  # pixels in which nothing can be seen any more
MAX_REGION_SIDE = 4.0  # longest sides of the picture


@dataclass(frozen=True)
class Region:
    """A square: its centre and side in pixels, and by how much it is turned (radians, clockwise as seen)."""

    x: float
    y: float
    side: float
    turn: float = 0.0

    def to_picture(self, places: Floats) -> Floats:
        """``(..., 2)`` pixels of the picture, from parts of the region (0 to 1)."""
        c, s = math.cos(self.turn), math.sin(self.turn)
        return np.asarray((places - 0.5) * self.side @ np.array([[c, s], [-s, c]]) + [self.x, self.y])

    def usable(self, width: int, height: int) -> bool:
        """Whether anything can be seen in it: neither tiny nor huge, and its centre not far outside of the picture."""
        if not all(map(math.isfinite, (self.x, self.y, self.side, self.turn))):
            return False
        reach = self.side / 2
        near = -reach < self.x < width + reach and -reach < self.y < height + reach
        return near and MIN_REGION_SIDE <= self.side <= MAX_REGION_SIDE * max(width, height)


def about(centre: Floats, circle: Floats, expand: float) -> Region:
    """The region about a body: its hips, and a point of the circle that holds it, which lies above the head of who stands
    upright. centre, circle ``(2,)``."""
    (x, y), (u, v) = centre.tolist(), circle.tolist()
    return Region(x, y, 2 * expand * math.hypot(u - x, v - y), math.remainder(math.atan2(u - x, y - v), 2 * math.pi))


class VideoPicture:
    """One frame of a video, from which regions are cut; colours are converted once, and shrunk as far as a region allows."""

    def __init__(self, frame: Any, size: tuple[int, int] | None = None, reformat: Callable[..., Any] | None = None) -> None:
        self.upright: Orientation = orientation(frame)
        self.stored = size or (frame.width, frame.height)
        self.width, self.height = self.upright.size(*self.stored)
        self._frame, self._reformat = frame, reformat or type(frame).reformat
        self._levels: list[Image] = []

    def level(self, shrunk: int) -> Image:
        """RGB as stored, its sides halved so many times."""
        if not self._levels:
            self._levels = [self._reformat(self._frame, *self.stored, format="rgb24", interpolation="AREA").to_ndarray()]
        while len(self._levels) <= shrunk:
            last = self._levels[-1]
            height, width = last.shape[0] // 2, last.shape[1] // 2
            # of odd sides the last line is left out, so that places halve exactly
            last = last[: 2 * height, : 2 * width]
            self._levels.append(cv2().resize(last, (width, height), interpolation=cv2().INTER_AREA))
        return self._levels[shrunk]

    def extract_region(self, region: Region, side: int, fill: bool = False) -> Image:
        """``(side, side, 3)`` the region, upright."""
        scale = region.side / side
        most = max(0, min(self.stored).bit_length() - 2)  # levels that have two pixels at least
        shrunk = min(max(0, math.floor(math.log2(scale))), most) if scale > 1 else 0
        mode = cv2().BORDER_CONSTANT if fill else cv2().BORDER_REPLICATE
        flags = cv2().INTER_LINEAR | cv2().WARP_INVERSE_MAP
        image = self.level(shrunk)
        return np.asarray(cv2().warpAffine(image, self._map(region, side, shrunk), (side, side), flags=flags, borderMode=mode))

    def _map(self, region: Region, side: int, shrunk: int) -> Floats:
        """``(2, 3)`` from pixels of the region's image to those of a level, both counted from the middle of the first pixel."""
        corners = region.to_picture(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
        corners = self._as_stored(corners)
        axes = np.stack([corners[1] - corners[0], corners[2] - corners[0]], axis=1) / side
        start = corners[0] + axes @ [0.5, 0.5]
        return np.concatenate([axes, start[:, None]], axis=1) / 2**shrunk - [[0, 0, 0.5], [0, 0, 0.5]]

    def _as_stored(self, places: Floats) -> Floats:
        """Pixels as stored of pixels as shown."""
        x, y = places.T
        x = self.width - x if self.upright.flip_x else x
        y = self.height - y if self.upright.flip_y else y
        return np.stack([y, x] if self.upright.transpose else [x, y], axis=1)
