"""Does the camera move, when, and by how much; and taking its motion out of frames and tracks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from indexing.video.background import Background, Floats, shrinking, transform
from indexing.video.extra import cv2
from indexing.video.reading import Chunk, Source, chunks

WORKING = 640  # pixels of the longest side, at which a camera's motion is measured
STILL = 0.002  # of the diagonal (1.5 px of 640 x 480): a tripod stays well below, a hand goes beyond within half a second
WINDOW = 0.5  # seconds
UNSEEN = 0.1  # share of frames without enough background above which the answer is called unsure


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

    def still(self, points: Floats, times: Floats | None = None) -> Floats:
        """Points ``(frames, n, 2)`` as the first frame's camera would have seen them (exact for pans, or far backgrounds).

        Args:
            points: pixels of ``size``.
            times: ``(frames,)`` seconds of these frames; default: the frames of this motion.
        """
        return transform(self.path if times is None else self.at(times), np.asarray(points, np.float64))


def camera_motion(source: str | Path | Source, *, threshold: float | None = None) -> CameraMotion:
    """Whether, when and by how much the camera moves, from the background of a video.

    Corners spread over the picture are followed from a key frame (KLT) and a similarity, or a homography where that explains
    more, is fitted to most of them (RANSAC), so that people who move in front do not count.  The camera is said to move where the
    corners of the picture move by more than ``threshold`` within half a second.  A camera that changes its place (not only its
    direction) in front of a deep scene has no such motion; the nearest one for the bulk of the background is found.

    Args:
        source: a path, or chunks of grey frames.
        threshold: pixels; default: 0.2 % of the diagonal.

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
    for chunk in (stream := chunks(source, size=WORKING)):
        for image in chunk.frames:
            builder.add(background, image)
        builder.times.extend(chunk.times.tolist())
    scale = getattr(stream, "scale", (1.0, 1.0)) if isinstance(source, (str, Path)) else (1.0, 1.0)
    return builder.finish(scale, threshold, getattr(stream, "notes", ()))


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

    def finish(self, scale: tuple[float, float], threshold: float | None, notes: tuple[str, ...] = ()) -> CameraMotion:
        """The motion in pixels of the video, ``scale`` being pixels here per pixel there; ``notes`` of the reading come first."""
        if not self.times:
            raise ValueError("camera_motion: the video has no frames; give at least one chunk")
        times, support = np.array(self.times), np.array(self.support)
        shrink = shrinking(scale)
        path = np.linalg.inv(shrink) @ np.array(self.path) @ shrink
        size = (round(self.shape[1] / scale[0]), round(self.shape[0] / scale[1]))
        limit = STILL * float(np.hypot(*size)) if threshold is None else threshold
        corners = _steady(transform(path, _corners(size)).reshape(len(times), -1))
        moments = _moments(times, corners, limit)
        kind = _kind(times, corners, moments, limit)
        if not moments and _extent(corners) > 3 * limit:
            moments, kind = [Move(times[0], times[-1], _extent(corners))], "drift"
        if not moments:  # what is left is the error of measurement
            path = np.tile(np.eye(3), (len(times), 1, 1))
        span = max(times[-1] - times[0], 1e-9)
        said = list(notes)
        if (support == 0).mean() > UNSEEN:
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
        grow = shrinking((width / camera.size[0], height / camera.size[1]))
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


def _steady(corners: Floats) -> Floats:
    """Without jumps of one or two frames: no camera does that, but where somebody fills the picture the fit may."""
    padded = np.pad(corners, ((2, 2), (0, 0)), mode="edge")
    return np.asarray(np.median(np.lib.stride_tricks.sliding_window_view(padded, 5, axis=0), axis=-1))


def _extent(corners: Floats) -> float:
    """How far apart positions ``(frames, 8)`` of the corners lie: of the corner that moves most."""
    return float(np.hypot(*np.ptp(corners, axis=0).reshape(4, 2).T).max())


def _moments(times: Floats, corners: Floats, limit: float) -> list[Move]:
    """Spans in which the corners move by more than the limit within a window."""
    if len(times) < 3:
        return []
    reach = max(1, round(WINDOW / 2 / float(np.median(np.diff(times)))))
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
        if spans and times[first] - times[spans[-1][1]] < WINDOW:
            first = spans.pop()[0]
        spans.append((first, max(first, last)))
    return [Move(float(times[a]), float(times[b]), _extent(corners[max(0, a - 1) : b + 2])) for a, b in spans]


def _kind(times: Floats, corners: Floats, moments: list[Move], limit: float) -> str:
    """One word for the moments."""
    if not moments:
        return "still"
    if max(m.stop - m.start for m in moments) < 1.0 and len(moments) < 4:
        return "knock"
    step = max(1, round(WINDOW / float(np.median(np.diff(times)))))
    travelled = float(np.linalg.norm(np.diff(corners[::step], axis=0).reshape(-1, 4, 2), axis=2).max(axis=1).sum())
    return "pan" if _extent(corners) > 0.6 * travelled and _extent(corners) > 3 * limit else "handheld"
