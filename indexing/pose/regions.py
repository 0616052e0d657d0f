"""Square regions of a picture, turned with the body: cut out as the networks want them, and what they say put back.

Coordinates of a picture are pixels as it is shown, from 0 at its left or upper edge to the width or height at the other.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing.pose.blazepose import CIRCLE, HIPS, Floats, Landmarks, PersonCandidates
from indexing.video.reading import Orientation, cv2, orientation

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

    def moved(self, dx: float, dy: float) -> Region:
        """The region elsewhere."""
        return Region(self.x + dx, self.y + dy, self.side, self.turn)

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


def of_candidates(found: PersonCandidates, window: Region, expand: float) -> list[Region]:
    """The regions about detected people."""
    points = window.to_picture(found.points)
    return [about(one[0], one[1], expand) for one in points]


def of_landmarks(found: Landmarks, region: Region, expand: float) -> Region:
    """The next region of a person, from where the network sees the body in this one."""
    hips, circle = region.to_picture(found.places[[HIPS, CIRCLE]])
    return about(hips, circle, expand)


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

    def cut(self, region: Region, side: int, fill: bool = False) -> Image:
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
