"""Following single points, and where in the picture there is something to follow."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from indexing.video.background import Floats, shrinking
from indexing.video.extra import cv2
from indexing.video.motion import warp
from indexing.video.reading import Chunk

BACK = 0.7  # pixels between a point and where following it there and back ends
PATCH = (17, 17)
CHANGE = 16  # grey levels over a chunk, after shrinking by four: beyond noise, where something moved


class MovingArea:
    """Where something moves within a chunk, for each of its frames: a mask of the frame's size.

    Example:
        >>> import numpy as np
        >>> from indexing.video import Chunk
        >>> frames = np.zeros((8, 64, 64), np.uint8)
        >>> frames[4:, 16:32, 16:32] = 200
        >>> where = MovingArea(Chunk(frames, np.arange(8.0)), [np.eye(3)] * 8)
        >>> bool(where(np.eye(3))[20, 20]), bool(where(np.eye(3))[60, 60])
        (True, False)
    """

    def __init__(self, chunk: Chunk, path: list[Floats]):
        height, width = chunk.frames.shape[1:]
        self.shape = (height, width)
        self.shrink = shrinking((0.25, 0.25))
        self.reference = np.linalg.inv(path[0])  # first frame -> first frame of the chunk
        low = high = None
        for image, matrix in zip(chunk.frames, path, strict=True):
            small = cv2().resize(image, (max(1, width // 4), max(1, height // 4)), interpolation=cv2().INTER_AREA)
            motion = self.shrink @ self.reference @ matrix @ np.linalg.inv(self.shrink)
            small = warp(small, motion)
            low = small if low is None else np.minimum(low, small)
            high = small if high is None else np.maximum(high, small)
        assert low is not None and high is not None
        change = cv2().GaussianBlur(high - low, (5, 5), 0)
        changed = (change > max(CHANGE, 3 * float(np.median(change)))).astype(np.uint8)
        self.small = cv2().dilate(changed, np.ones((5, 5), np.uint8))

    def __call__(self, matrix: Floats) -> NDArray[np.uint8]:
        """The mask as seen by the frame whose motion to the first frame is ``matrix``."""
        motion = np.linalg.inv(matrix) @ np.linalg.inv(self.reference) @ np.linalg.inv(self.shrink)
        return np.asarray(cv2().warpPerspective(self.small, motion, self.shape[::-1], flags=cv2().INTER_NEAREST), np.uint8)


def follow(
    before: NDArray[np.uint8], after: NDArray[np.uint8], points: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Where points of one frame are in the next, and which of them can be trusted: following back ends where they came from."""
    options = {"winSize": PATCH, "maxLevel": 3, "criteria": (3, 20, 0.01)}
    ahead, found, _ = cv2().calcOpticalFlowPyrLK(before, after, points, None, **options)
    back, found_back, _ = cv2().calcOpticalFlowPyrLK(after, before, ahead, None, **options)
    good = (found.ravel() > 0) & (found_back.ravel() > 0) & (np.linalg.norm(back - points, axis=1) < BACK)
    inside = ((ahead >= 2) & (ahead < np.array(after.shape[::-1]) - 2)).all(axis=1)
    return np.asarray(ahead, np.float32), np.asarray(good & inside)


def patches(image: NDArray[np.uint8], points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Surroundings of points ``(n, pixels)``, free of mean and of norm 1: their products are correlations."""
    if not len(points):
        return np.zeros((0, PATCH[0] * PATCH[1]), np.float32)
    found = np.stack([cv2().getRectSubPix(image, PATCH, point, patchType=cv2().CV_32F).ravel() for point in points.tolist()])
    found -= found.mean(1, keepdims=True)
    return np.asarray(found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-6), np.float32)


def extent(track: Floats, share: float = 0.9) -> float:
    """Of positions ``(frames, 2)``: diagonal of the box of the middle ``share`` in x and y, in their unit.

    Example:
        >>> import numpy as np
        >>> extent(np.stack([np.linspace(0, 10, 101), np.zeros(101)], 1))
        9.0
    """
    low, high = np.percentile(track, [50 - 50 * share, 50 + 50 * share], axis=0)
    return float(np.hypot(*(high - low)))
