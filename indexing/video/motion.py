"""Does the camera move, when, and by how much; and taking its motion out of frames and tracks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from indexing.video.reading import Chunk, Source, cv2
from indexing.video.sequence import chunks

# ----------------------------------------------------------------------------------------------------------------------
# Where the picture of the first frame lies in every later one: the motion of the camera, seen by the background.
#
# Every frame is compared with a *key frame*, not with the frame before it: errors then do not add up as long as the key frame
# stays,
# and for a camera that stands still it stays for good.


Floats = NDArray[np.float64]

MOTION_WORKING_SIDE = 640  # longest side, pixels, at which a camera's motion is measured
MOTION_CELLS = (8, 6)  # of the image, the same number of points in each: a textured person does not outvote the background
POINTS_PER_CELL = 8
MIN_BACKGROUND_POINTS = 12  # below which nothing is said about the camera
MOTION_TOLERANCE = 1.5  # pixels of a point from where the camera's motion puts it; KLT's own error is about 0.1
MODEL_TOLERANCE = 0.5  # pixels, to compare two models
STATIC_POINT_MOTION = 0.5  # pixels that points stay within where the camera is static
MIN_STATIC_EXTENT = 0.035  # share x standard deviation / longest side of static points: 20 clips of signing have .09-.21
MIN_MOTION_SUPPORT = 0.25  # share of points; below, the picture has changed or the background is hidden
MIN_KEY_SUPPORT = 0.6  # share of a key frame's best support at which a new one is taken
MAX_KEY_SHIFT = 0.2  # of the width: a key frame this far away overlaps too little
STATIC_CAMERA_MOTION = 0.002  # of the diagonal: a tripod stays well below, a hand goes beyond within half a second
MOTION_WINDOW_SECONDS = 0.5  # within which the corners of the picture must move by that
MAX_UNSEEN_SHARE = 0.1  # of frames without enough background, above which the answer is called unsure


class Background:
    """Follows the background through grey frames of one size; :meth:`step` per frame, in order."""

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
            self.cut = self.support == 0 and len(self._points) >= MIN_BACKGROUND_POINTS
            if self.support == 0:  # nothing known: as if the camera had stood still since
                self._renew(image, self.to_first)
            else:
                self._last = motion
                self._peak = max(self._peak, self.support)
                if self.support < MIN_KEY_SUPPORT * self._peak or _shift(motion, image.shape) > MAX_KEY_SHIFT * image.shape[1]:
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
        if len(self._points) < MIN_BACKGROUND_POINTS:
            return self._last, 0.0
        source = self._points.astype(np.float32)
        guess = transform(self._last, self._points).astype(np.float32)
        target, found, _ = cv2().calcOpticalFlowPyrLK(
            self._key, image, source, guess, winSize=(21, 21), maxLevel=3, flags=cv2().OPTFLOW_USE_INITIAL_FLOW
        )
        found = found.ravel().astype(bool)
        if found.sum() < MIN_BACKGROUND_POINTS:
            return self._last, 0.0
        motion, agree = robust_motion(self._points[found], target[found].astype(np.float64), self._last, max(image.shape))
        return motion, agree.sum() / len(source)


def robust_motion(source: Floats, target: Floats, guess: Floats, side: float) -> tuple[Floats, NDArray[np.bool_]]:
    """That of the points that rest, where these are enough; else the similarity, or the homography, that maps most points.
    source ``(n, 2)``, target ``(n, 2)``, guess ``(3, 3)`` -> ``(3, 3)``."""
    rests = np.linalg.norm(target - source, axis=1) < STATIC_POINT_MOTION
    if rests.sum() >= MIN_BACKGROUND_POINTS and rests.mean() * source[rests].std(0).max() > MIN_STATIC_EXTENT * side:
        return similarity(source[rests], target[rests]), rests
    motion = guess
    agree = _fits(motion, source, target, MOTION_TOLERANCE)
    if agree.mean() < 0.5:
        found = cv2().estimateAffinePartial2D(
            source, target, method=cv2().RANSAC, ransacReprojThreshold=MOTION_TOLERANCE, confidence=0.999
        )[0]
        if found is not None:
            motion = np.vstack([found, [0.0, 0, 1]])
            agree = _fits(motion, source, target, MOTION_TOLERANCE)
    for _ in range(3):
        if agree.sum() < MIN_BACKGROUND_POINTS:
            return motion, np.zeros_like(agree)
        motion = similarity(source[agree], target[agree])
        agree = _fits(motion, source, target, MOTION_TOLERANCE)
    # A pan by an angle is a homography; a similarity is enough for a few pixels, and stays off by less than the tolerance for more.
    if np.linalg.norm((target - source)[agree].mean(0)) > 2 * MOTION_TOLERANCE and len(source) >= 3 * MIN_BACKGROUND_POINTS:
        found = cv2().findHomography(source, target, cv2().RANSAC, MOTION_TOLERANCE)[0]
        if found is not None:
            gain = _fits(found, source, target, MODEL_TOLERANCE).sum() - _fits(motion, source, target, MODEL_TOLERANCE).sum()
            if gain > max(5, 0.05 * len(source)):
                motion, agree = found, _fits(found, source, target, MOTION_TOLERANCE)
    return motion, agree & (agree.mean() > MIN_MOTION_SUPPORT)


def similarity(source: Floats, target: Floats) -> Floats:
    """The similarity nearest to pairs of points, as ``(3, 3)``: least squares of :math:`z' = a z + b` in complex numbers."""
    z, w = source @ [1, 1j], target @ [1, 1j]
    here, there = z.mean(), w.mean()
    scale = np.vdot(z - here, w - there) / max(np.vdot(z - here, z - here).real, 1e-12)
    shift = there - scale * here
    return np.array([[scale.real, -scale.imag, shift.real], [scale.imag, scale.real, shift.imag], [0, 0, 1]])


def transform(matrix: Floats, points: Floats) -> Floats:
    """Points ``(..., n, 2)`` mapped by homographies ``(..., 3, 3)``."""
    mapped = points @ np.swapaxes(matrix[..., :2], -1, -2) + matrix[..., None, :, 2]
    return np.asarray(mapped[..., :2] / mapped[..., 2:])


def shrink_matrix(scale: tuple[float, float]) -> Floats:
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
    cells = (corners // [width / MOTION_CELLS[0], height / MOTION_CELLS[1]]) @ [1, MOTION_CELLS[0]]
    # corners come strongest first: their rank within the cell
    rank = np.zeros(len(corners), int)
    for cell in np.unique(cells):
        inside = cells == cell
        rank[inside] = np.arange(inside.sum())
    return np.asarray(corners[rank < POINTS_PER_CELL])


def _fits(motion: Floats, source: Floats, target: Floats, within: float) -> NDArray[np.bool_]:
    return np.asarray(np.linalg.norm(transform(motion, source) - target, axis=1) < within)


def _shift(motion: Floats, shape: tuple[int, ...]) -> float:
    corners = _corners((shape[1], shape[0]))
    return float(np.linalg.norm(transform(motion, corners) - corners, axis=1).max())


class Move(NamedTuple):
    """A time in which the camera moves: from ``start`` to ``stop`` seconds, by ``pixels`` from where it was."""

    start: float
    stop: float
    pixels: float


@dataclass(frozen=True, eq=False, repr=False)
class CameraMotion:
    """How the camera moved, as the background shows it.

    Attributes:
        times: ``(frames,)`` seconds.
        path: ``(frames, 3, 3)`` maps a frame's pixels to pixels of the first frame (similarity or homography); the identity
            throughout where the camera does not move.
        size: width and height that these pixels count.
        moves: whether the camera moves at all.
        moments: when, and by how much.
        kind: ``"still"``, ``"pan"`` (one way), ``"knock"`` (less than a second), ``"handheld"`` or ``"drift"`` (too slow to feel).
        share: of the time that it moves.
        support: ``(frames,)`` share of background points that agree with ``path``; 0 where nothing could be said, and ``path``
            then is that of the frame before.
        cuts: seconds at which the picture changes altogether.
        notes: what a user should know.
    """

    times: Floats
    path: Floats
    size: tuple[int, int]
    moves: bool
    moments: tuple[Move, ...]
    kind: str
    share: float
    support: Floats
    cuts: tuple[float, ...]
    notes: tuple[str, ...]

    def __str__(self) -> str:
        if not self.moves:
            return "camera stands still"
        shown = [f"between {m.start:.1f} and {m.stop:.1f} s by {m.pixels:.0f} px" for m in self.moments[:3]]
        more = f" and {len(self.moments) - 3} more times" if len(self.moments) > 3 else ""
        return f"camera moves {', '.join(shown)}{more} ({self.kind})"

    def __repr__(self) -> str:
        return "\n".join([f"CameraMotion({self})", *(f"  note: {note}" for note in self.notes)])

    def at(self, times: Floats) -> Floats:
        """``path`` of the frames nearest to these times: ``(..., 3, 3)``."""
        after = np.searchsorted(self.times, times).clip(1, max(len(self.times) - 1, 1))
        before = after - 1
        after = np.minimum(after, len(self.times) - 1)
        return np.asarray(self.path[np.where(times - self.times[before] <= self.times[after] - times, before, after)])


def camera_motion(source: str | Path | Source) -> CameraMotion:
    """Whether, when and by how much the camera moves, from the background of a video.

    Corners spread over the picture are followed from a key frame (KLT) and a similarity, or a homography where that explains
    more, is fitted to most of them (RANSAC), so that people who move in front do not count.  The camera is said to move where the
    corners of the picture move by more than 0.2 % of the diagonal within half a second.  A camera that changes its place (not only
    its direction) in front of a deep scene has no such motion; the nearest one for the bulk of the background is found.

    Args:
        source: a path, or chunks of grey frames.

    Returns:
        the motion in pixels of the video as shown (for chunks: of their frames).

    Raises:
        ValueError: the video cannot be read, or has no frames.

    Source: Lucas and Kanade 1981 in pyramids (Bouguet 2000); Fischler and Bolles 1981 (RANSAC).

    Example:
        >>> import numpy as np
        >>> from indexing.video import Chunk
        >>> wall = np.kron(np.random.default_rng(0).integers(0, 255, (30, 60)), np.ones((8, 8))).astype(np.uint8)
        >>> seen = [wall[:, 4 * max(0, i - 15) :][:, :320] for i in range(30)]  # from 1.5 s on, 4 pixels a frame
        >>> print(camera_motion([Chunk(np.stack(seen), np.arange(30) / 10)]))
        camera moves between 1.5 and 2.9 s by 56 px (pan)
    """
    background, builder = Background(), PathBuilder()
    for chunk in (stream := chunks(source, size=MOTION_WORKING_SIDE)):
        for image in chunk.frames:
            builder.add(background, image)
        builder.times.extend(chunk.times.tolist())
    scale = getattr(stream, "scale", (1.0, 1.0)) if isinstance(source, (str, Path)) else (1.0, 1.0)
    return builder.finish(scale, getattr(stream, "notes", ()))


class PathBuilder:
    """Collects the motion of a :class:`Background` frame by frame."""

    def __init__(self) -> None:
        self.times: list[float] = []
        self.path: list[Floats] = []
        self.support: list[float] = []
        self.cuts: list[int] = []
        self.shape = (0, 0)

    def add(self, background: Background, image: NDArray[np.uint8]) -> Floats:
        """The motion of the next frame to the first."""
        if image.ndim != 2:
            raise ValueError(f"video: frames must be grey (height, width), got shape {image.shape}; read them with gray=True")
        self.path.append(background.step(image))
        self.support.append(background.support)
        if background.cut:
            self.cuts.append(len(self.path) - 1)
        self.shape = image.shape
        return self.path[-1]

    def finish(self, scale: tuple[float, float], notes: tuple[str, ...]) -> CameraMotion:
        """The motion in pixels of the video, ``scale`` being pixels here per pixel there; ``notes`` of the reading come first."""
        if not self.times:
            raise ValueError("camera_motion: the video has no frames; give at least one chunk")
        times, support = np.array(self.times), np.array(self.support)
        shrink = shrink_matrix(scale)
        path = np.linalg.inv(shrink) @ np.array(self.path) @ shrink
        size = (round(self.shape[1] / scale[0]), round(self.shape[0] / scale[1]))
        limit = STATIC_CAMERA_MOTION * float(np.hypot(*size))
        # without jumps of one or two frames: no camera does that, but where somebody fills the picture the fit may
        corners = median_filter(transform(path, _corners(size)).reshape(len(times), -1), (5, 1), mode="nearest")
        moments = _moments(times, corners, limit)
        kind = _kind(times, corners, moments, limit)
        if not moments and _extent(corners) > 3 * limit:
            moments, kind = [Move(times[0], times[-1], _extent(corners))], "drift"
        if not moments:  # what is left is the error of measurement
            path = np.tile(np.eye(3), (len(times), 1, 1))
        span = max(times[-1] - times[0], 1e-9)
        said = list(notes)
        if (support == 0).mean() > MAX_UNSEEN_SHARE:
            said.append(f"too little background to tell in {(support == 0).mean():.0%} of the frames: is there texture behind?")
        cuts = tuple(float(times[i]) for i in self.cuts)
        if cuts:
            shown = ", ".join(f"{t:.1f}" for t in cuts[:3])
            said.append(
                f"the picture changes altogether at {shown} s{' and later' * (len(cuts) > 3)}: a cut, or something before the lens?"
            )
        share = min(1.0, sum(m.stop - m.start for m in moments) / span)
        return CameraMotion(times, path, size, bool(moments), tuple(moments), kind, share, support, cuts, tuple(said))


def stabilize(source: str | Path | Source, camera: CameraMotion) -> Iterator[Chunk]:
    """Frames as the camera of the first frame would have seen them; beyond the border the nearest pixel is repeated.

    Args:
        source: a path, or chunks, grey or RGB, of any size; times on the clock of ``camera``.
        camera: of :func:`camera_motion`.

    Returns:
        chunks of the same size and times.

    Example:
        >>> import numpy as np
        >>> from indexing.video import Chunk
        >>> video = [Chunk(np.zeros((3, 48, 64), np.uint8), np.arange(3.0))]
        >>> [chunk.frames.shape for chunk in stabilize(video, camera_motion(video))]
        [(3, 48, 64)]
    """
    for chunk in chunks(source):
        height, width = chunk.frames.shape[1:3]
        grow = shrink_matrix((width / camera.size[0], height / camera.size[1]))
        path = grow @ camera.at(chunk.times) @ np.linalg.inv(grow)
        frames = [warp(image, matrix) for image, matrix in zip(chunk.frames, path, strict=True)]
        yield Chunk(np.stack(frames), chunk.times)


def warp(image: NDArray[np.uint8], matrix: Floats) -> NDArray[np.uint8]:
    """The image with its pixels moved by a homography; unchanged where that is the identity."""
    if np.allclose(matrix, np.eye(3), atol=1e-6):
        return image
    height, width = image.shape[:2]
    return np.asarray(cv2().warpPerspective(image, matrix, (width, height), borderMode=cv2().BORDER_REPLICATE), np.uint8)


def _corners(size: tuple[int, int]) -> Floats:
    width, height = size
    return np.array([[0.0, 0], [width, 0], [0, height], [width, height]])


def _extent(corners: Floats) -> float:
    """How far apart positions ``(frames, 8)`` of the corners lie: of the corner that moves most."""
    return float(np.hypot(*np.ptp(corners, axis=0).reshape(4, 2).T).max())


def _moments(times: Floats, corners: Floats, limit: float) -> list[Move]:
    """Spans in which the corners move by more than the limit within a window."""
    if len(times) < 3:
        return []
    reach = max(1, round(MOTION_WINDOW_SECONDS / 2 / float(np.median(np.diff(times)))))
    windows = [slice(max(0, i - reach), i + reach + 1) for i in range(len(times))]
    moving = np.array([_extent(corners[window]) > limit for window in windows])
    edges = np.flatnonzero(np.diff(np.r_[0, moving.astype(int), 0]))
    spans: list[tuple[int, int]] = []
    for first, end in edges.reshape(-1, 2).tolist():
        # a window knows of a motion half its length before and after: spans are that much too long, where nothing cuts them off
        first, last = (
            (first if first == 0 else min(first + reach - 1, end - 1)),
            (end - 1 if end == len(times) else max(end - reach, first)),
        )
        if spans and times[first] - times[spans[-1][1]] < MOTION_WINDOW_SECONDS:
            first = spans.pop()[0]
        spans.append((first, max(first, last)))
    return [Move(float(times[a]), float(times[b]), _extent(corners[max(0, a - 1) : b + 2])) for a, b in spans]


def _kind(times: Floats, corners: Floats, moments: list[Move], limit: float) -> str:
    """One word for the moments."""
    if not moments:
        return "still"
    if max(m.stop - m.start for m in moments) < 1.0 and len(moments) < 4:
        return "knock"
    step = max(1, round(MOTION_WINDOW_SECONDS / float(np.median(np.diff(times)))))
    travelled = float(np.linalg.norm(np.diff(corners[::step], axis=0).reshape(-1, 4, 2), axis=2).max(axis=1).sum())
    return "pan" if _extent(corners) > 0.6 * travelled and _extent(corners) > 3 * limit else "handheld"
