"""Where the picture of the first frame lies in every later one: the motion of the camera, seen by the background.

Every frame is compared with a *key frame*, not with the frame before it: errors then do not add up as long as the key frame stays,
and for a camera that stands still it stays for good.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from indexing.video.extra import cv2

Floats = NDArray[np.float64]

CELLS = (8, 6)  # of the image; the same number of points in each, so that a textured person does not outvote the background
PER_CELL = 8
FEWEST = 12  # points below which nothing is said about the camera
TOLERANCE = 1.5  # pixels of a point from where the camera's motion puts it; KLT's own error is about 0.1
CLOSE = 0.5  # pixels, to tell which of two models is the better one
# Points that stay within REST pixels say that the camera stands where (share of all points) x (standard deviation / longest side)
# exceeds STANDS.  Of a person before a plain wall .8 of the corners are the person's, and the largest group that agrees may move
# with the person: 20 clips of signing before a fixed camera have .09-.21 in their median frames, two fixed cameras in a laboratory
# .20 and .23.  What rests on a subject that the camera follows is compact.
STANDS, REST = 0.035, 0.5
TRUSTED = 0.25  # share of points that must agree with a motion; below, the picture has changed or the background is hidden
RENEW = 0.6  # share of the best support of a key frame at which a new one is taken
FAR = 0.2  # of the width: a key frame this far away overlaps too little


class Background:
    """Follows the background through grey frames of one size; :meth:`step` per frame, in order.

    Attributes:
        support: share of the background points that agree with the motion of the last frame; 0 where nothing could be said.
        cut: whether the last frame shows nothing of the frame before it.
    """

    def __init__(self) -> None:
        self.support, self.cut = 1.0, False
        self._key: NDArray[np.uint8] | None = None  # key frame
        self._points = np.zeros((0, 2))
        self._key_to_first = np.eye(3)
        self._last = np.eye(3)  # key frame -> last frame
        self._previous: NDArray[np.uint8] | None = None
        self._peak = 0.0

    def step(self, image: NDArray[np.uint8]) -> Floats:
        """``(3, 3)``: maps pixels of this frame to pixels of the first."""
        if self._previous is None:
            self._renew(image, np.eye(3))
        else:
            previous = self._previous
            motion, self.support = self._match(image)
            if self.support == 0:  # the key frame may have grown old: try the frame before
                self._renew(previous, self.to_first)
                motion, self.support = self._match(image)
            self.cut = self.support == 0 and len(self._points) >= FEWEST
            if self.support == 0:  # nothing known: as if the camera had stood still since
                self._renew(image, self.to_first)
            else:
                self._last = motion
                self._peak = max(self._peak, self.support)
                if self.support < RENEW * self._peak or _shift(motion, image.shape) > FAR * image.shape[1]:
                    self._renew(image, self.to_first)
        self._previous = image
        return self.to_first

    @property
    def to_first(self) -> Floats:
        """``(3, 3)``: last frame -> first frame."""
        matrix = self._key_to_first @ np.linalg.inv(self._last)
        return np.asarray(matrix / matrix[2, 2])

    def _renew(self, image: NDArray[np.uint8], to_first: Floats) -> None:
        """Make this frame the key frame."""
        self._key_to_first, self._last, self._peak = to_first, np.eye(3), 0.0
        self._points = spread(image)
        self._key = image

    def _match(self, image: NDArray[np.uint8]) -> tuple[Floats, float]:
        """Motion of the key frame to this frame, and the share of points that agree."""
        if len(self._points) < FEWEST:
            return self._last, 0.0
        source = self._points.astype(np.float32)
        guess = transform(self._last, self._points).astype(np.float32)
        target, found, _ = cv2().calcOpticalFlowPyrLK(
            self._key, image, source, guess, winSize=(21, 21), maxLevel=3, flags=cv2().OPTFLOW_USE_INITIAL_FLOW
        )
        found = found.ravel().astype(bool)
        if found.sum() < FEWEST:
            return self._last, 0.0
        motion, agree = robust_motion(self._points[found], target[found].astype(np.float64), self._last, max(image.shape))
        return motion, agree.sum() / len(source)


def robust_motion(source: Floats, target: Floats, guess: Floats, side: float) -> tuple[Floats, NDArray[np.bool_]]:
    """That of the points that rest, where these are enough; else the similarity, or the homography, that maps most points.

    .. math:: x' \\sim H x, \\qquad H = \\begin{pmatrix} a & -b & c \\\\ b & a & d \\\\ 0 & 0 & 1 \\end{pmatrix} \\text{ or any}

    Args:
        source: ``(n, 2)`` pixels.
        target: ``(n, 2)`` pixels.
        guess: ``(3, 3)`` motion of the frame before, tried first: where half the points agree, no sampling is needed.
        side: the longest of the image, in pixels.

    Returns:
        the motion ``(3, 3)``, and which points agree with it; none where too few do to say.
    """
    rests = np.linalg.norm(target - source, axis=1) < REST
    if rests.sum() >= FEWEST and rests.mean() * source[rests].std(0).max() > STANDS * side:
        return similarity(source[rests], target[rests]), rests
    motion = guess
    agree = _agree(motion, source, target)
    if agree.mean() < 0.5:
        found = cv2().estimateAffinePartial2D(
            source, target, method=cv2().RANSAC, ransacReprojThreshold=TOLERANCE, confidence=0.999
        )[0]
        if found is not None:
            motion = np.vstack([found, [0.0, 0, 1]])
            agree = _agree(motion, source, target)
    for _ in range(3):
        if agree.sum() < FEWEST:
            return motion, np.zeros_like(agree)
        motion = similarity(source[agree], target[agree])
        agree = _agree(motion, source, target)
    # A pan by an angle is a homography; a similarity is enough for a few pixels, and stays off by less than the tolerance for more.
    if np.linalg.norm((target - source)[agree].mean(0)) > 2 * TOLERANCE and len(source) >= 3 * FEWEST:
        found = cv2().findHomography(source, target, cv2().RANSAC, TOLERANCE)[0]
        if found is not None:
            gain = _agree(found, source, target, CLOSE).sum() - _agree(motion, source, target, CLOSE).sum()
            if gain > max(5, 0.05 * len(source)):
                motion, agree = found, _agree(found, source, target)
    return motion, agree & (agree.mean() > TRUSTED)


def similarity(source: Floats, target: Floats) -> Floats:
    """The similarity nearest to pairs of points, as ``(3, 3)``: least squares of :math:`z' = a z + b` in complex numbers.

    Example:
        >>> import numpy as np
        >>> similarity(np.array([[0.0, 0], [1, 0], [0, 1]]), np.array([[1.0, 0], [1, 2], [-1, 0]])).round(6) + 0.0
        array([[ 0., -2.,  1.],
               [ 2.,  0.,  0.],
               [ 0.,  0.,  1.]])
    """
    z, w = source @ [1, 1j], target @ [1, 1j]
    here, there = z.mean(), w.mean()
    scale = np.vdot(z - here, w - there) / max(np.vdot(z - here, z - here).real, 1e-12)
    shift = there - scale * here
    return np.array([[scale.real, -scale.imag, shift.real], [scale.imag, scale.real, shift.imag], [0, 0, 1]])


def transform(matrix: Floats, points: Floats) -> Floats:
    """Points ``(..., n, 2)`` mapped by homographies ``(..., 3, 3)``."""
    mapped = points @ np.swapaxes(matrix[..., :2], -1, -2) + matrix[..., None, :, 2]
    return np.asarray(mapped[..., :2] / mapped[..., 2:])


def shrinking(scale: tuple[float, float]) -> Floats:
    """``(3, 3)``: pixels of a picture -> pixels of the picture resized by ``scale`` (x, y); pixel centres are whole numbers."""
    x, y = scale
    return np.array([[x, 0, (x - 1) / 2], [0, y, (y - 1) / 2], [0, 0, 1]])


def spread(image: NDArray[np.uint8]) -> Floats:
    """Corners of an image ``(n, 2)``, the strongest of each cell."""
    height, width = image.shape
    corners = cv2().goodFeaturesToTrack(image, 1500, 0.003, max(3, width / 100), blockSize=5)
    if corners is None:
        return np.zeros((0, 2))
    corners = corners.reshape(-1, 2).astype(np.float64)
    cells = (corners // [width / CELLS[0], height / CELLS[1]]) @ [1, CELLS[0]]
    # corners come strongest first: their rank within the cell
    rank = np.zeros(len(corners), int)
    for cell in np.unique(cells):
        inside = cells == cell
        rank[inside] = np.arange(inside.sum())
    return np.asarray(corners[rank < PER_CELL])


def _agree(motion: Floats, source: Floats, target: Floats, within: float = TOLERANCE) -> NDArray[np.bool_]:
    return np.asarray(np.linalg.norm(transform(motion, source) - target, axis=1) < within)


def _shift(motion: Floats, shape: tuple[int, ...]) -> float:
    corners = np.array([[0.0, 0], [shape[1], 0], [0, shape[0]], [shape[1], shape[0]]])
    return float(np.linalg.norm(transform(motion, corners) - corners, axis=1).max())
