"""Points that move, followed through a video: Kanade-Lucas-Tomasi with a forward-backward check."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from indexing.video.motion import Background, CameraMotion, Floats, PathBuilder, shrink_matrix, transform, warp
from indexing.video.reading import Chunk, Source, cv2
from indexing.video.sequence import chunks

# ----------------------------------------------------------------------------------------------------------------------
# Following single points, and where in the picture there is something to follow.

NUM_POINTS = 200  # followed at a time
STATIC_POINT_SHARE = 0.25  # of points on ground where nothing moves now: people who rest and move later
MIN_TRACK_EXTENT = 3.0  # pixels from which a track may be worth keeping
MIN_GRAY_CHANGE = 16  # levels over a chunk, after shrinking by four: beyond noise, where something moved
CHECK_FRAMES = 5  # after which a point must still look like itself
MIN_CORRELATION = 0.6  # of its surroundings then: a passer-by drags background points along, and there and back agree
MIN_MOTION = 0.01  # of the diagonal: extent of a track that counts as moving
MIN_MIDDLE_EXTENT = 0.15  # of that: background dragged along by a passer-by rests for the rest of its life


@dataclass(frozen=True)
class FollowSettings:
    """How points are followed from frame to frame; pixels are those of the working image."""

    working_side: int = 960  # longest side, pixels: KLT is exact to a tenth of these
    max_return_error: float = 0.7  # pixels between a point and where following it there and back ends
    patch: tuple[int, int] = (17, 17)  # surroundings of a point that are followed
    min_corner: float = 0.01  # of the best corner's strength
    renewal_frames: int = 10  # after which new points replace lost ones
    min_separation: int = 90  # one part in so many of the width
    min_frames: int = 10  # of a track that is worth keeping


POINT_FOLLOWING = FollowSettings()


class MovingArea:
    """Where something moves within a chunk, for each of its frames: a mask of the frame's size."""

    def __init__(self, chunk: Chunk, path: list[Floats]):
        height, width = chunk.frames.shape[1:]
        self.shape = (height, width)
        self.shrink = shrink_matrix((0.25, 0.25))
        self.reference = np.linalg.inv(path[0])  # first frame -> first frame of the chunk
        low = high = None
        for image, matrix in zip(chunk.frames, path, strict=True):
            small = cv2().resize(image, (max(1, width // 4), max(1, height // 4)), interpolation=cv2().INTER_AREA)
            motion = self.shrink @ self.reference @ matrix @ np.linalg.inv(self.shrink)
            small = warp(small, motion)
            low = small if low is None else np.minimum(low, small)
            high = small if high is None else np.maximum(high, small)
        assert low is not None and high is not None
        changes = cv2().GaussianBlur(high - low, (5, 5), 0)
        changed = (changes > max(MIN_GRAY_CHANGE, 3 * float(np.median(changes)))).astype(np.uint8)
        self.small = cv2().dilate(changed, np.ones((5, 5), np.uint8))

    def __call__(self, matrix: Floats) -> NDArray[np.uint8]:
        """The mask as seen by the frame whose motion to the first frame is ``matrix``."""
        motion = np.linalg.inv(matrix) @ np.linalg.inv(self.reference) @ np.linalg.inv(self.shrink)
        return np.asarray(cv2().warpPerspective(self.small, motion, self.shape[::-1], flags=cv2().INTER_NEAREST), np.uint8)


def follow(
    before: NDArray[np.uint8], after: NDArray[np.uint8], points: NDArray[np.float32], settings: FollowSettings = POINT_FOLLOWING
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Where points of one frame are in the next, and which of them can be trusted: following back ends where they came from."""
    how = {"winSize": settings.patch, "maxLevel": 3, "criteria": (3, 20, 0.01)}
    ahead, good = follow_both_ways(before, after, points, None, settings.max_return_error, **how)
    inside = ((ahead >= 2) & (ahead < np.array(after.shape[::-1]) - 2)).all(axis=1)
    return ahead, good & inside


def follow_both_ways(
    before: NDArray[np.uint8],
    after: NDArray[np.uint8],
    points: NDArray[np.float32],
    guess: NDArray[np.float32] | None,
    max_return_error: float,
    **how: Any,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Where points ``(n, 2)`` of one frame are in another, and whether following them back ends where they came from."""
    origin = None if guess is None else points.copy()
    ahead, found, _ = cv2().calcOpticalFlowPyrLK(before, after, points, guess, **how)
    back, found_back, _ = cv2().calcOpticalFlowPyrLK(after, before, ahead, origin, **how)
    good = (found.ravel() > 0) & (found_back.ravel() > 0) & (np.linalg.norm(back - points, axis=1) < max_return_error)
    return np.asarray(ahead, np.float32), np.asarray(good)


def patches(
    image: NDArray[np.uint8], points: NDArray[np.float32], settings: FollowSettings = POINT_FOLLOWING
) -> NDArray[np.float32]:
    """Surroundings of points ``(n, pixels)``, free of mean and of norm 1: their products are correlations."""
    if not len(points):
        return np.zeros((0, settings.patch[0] * settings.patch[1]), np.float32)
    found = np.stack(
        [cv2().getRectSubPix(image, settings.patch, point, patchType=cv2().CV_32F).ravel() for point in points.tolist()]
    )
    found -= found.mean(1, keepdims=True)
    return np.asarray(found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-6), np.float32)


def extent(track: Floats, share: float = 0.9) -> float:
    """Of positions ``(frames, 2)``: diagonal of the box of the middle ``share`` in x and y, in their unit."""
    low, high = np.percentile(track, [50 - 50 * share, 50 + 50 * share], axis=0)
    return float(np.hypot(*(high - low)))


@dataclass(frozen=True, eq=False, repr=False)
class Tracks:
    """Moving points of a video, those that live longest first.

    Attributes:
        points: ``(frames, n, 2)`` float64 pixels of the video as shown, y down; NaN before a point was found and after it was lost.
            Where the camera moves: as the camera of the first frame would have seen them.
        times: ``(frames,)`` seconds.
        size: width and height of the video as shown.
        camera: how the camera moved.
        notes: what a user should know.
    """

    points: Tensor
    times: Tensor
    size: tuple[int, int]
    camera: CameraMotion
    notes: tuple[str, ...]

    @property
    def share(self) -> Tensor:
        """``(n,)`` share of the frames in which each point is there."""
        return self.points[..., 0].isfinite().to(torch.float64).mean(0)

    def __repr__(self) -> str:
        frames, points = self.points.shape[:2]
        whole = int((self.share > 0.99).sum())
        size = f"{self.size[0]} x {self.size[1]}"
        head = f"Tracks({points} moving points, {whole} of them throughout, {frames} frames, {size}, {self.camera})"
        return "\n".join([head, *(f"  note: {note}" for note in self.notes)])


def track_points(
    source: str | Path | Source,
    *,
    keep: int = 40,
    complete: float = 0.7,
) -> Tracks:
    """Follow points that move against the background through a video.

    Corners are detected where something moves, followed from frame to frame (KLT), given up where following them back does not end
    where they came from, and replaced.  Of all tracks, those are kept that are there for at least ``complete`` of the frames and
    that move, the longest first; fragments of one point are not joined.

    Args:
        source: a path, or chunks of grey frames (one pass over them).
        keep: tracks returned at most.
        complete: least share of the frames in which a track must be there, in [0, 1].

    Returns:
        the tracks; none of them (``n = 0``), and a note, where nothing that moves could be followed long enough.

    Raises:
        ValueError: the video cannot be read, has fewer than two frames, or an option makes no sense.

    Source: Tomasi and Kanade 1991 (tracking), Shi and Tomasi 1994 (corners), Kalal et al. 2010 (forward-backward check).

    Example:
        >>> import numpy as np
        >>> from indexing.video import Chunk
        >>> squares = np.kron(np.random.default_rng(0).integers(0, 255, (15, 25)), np.ones((8, 8))).astype(np.uint8)
        >>> frames = np.stack([squares[:, :160]] * 20)
        >>> for i in range(20):  # a piece of cloth goes to the right
        ...     frames[i, 48:88, 20 + 3 * i : 60 + 3 * i] = squares[:40, 160:]
        >>> tracks = track_points([Chunk(frames, np.arange(20) / 10)], complete=1.0)
        >>> (tracks.points[-1] - tracks.points[0]).median(0).values.round().tolist()
        [57.0, 0.0]
    """
    if keep < 1:
        raise ValueError(f"track_points: keep must be at least 1, got {keep!r}")
    if not 0 <= complete <= 1:
        raise ValueError(f"track_points: complete is a share of the frames in [0, 1], got {complete!r}")
    background, path, book = Background(), PathBuilder(), _MovingBook()
    previous: NDArray[np.uint8] | None = None
    for chunk in (stream := chunks(source, size=POINT_FOLLOWING.working_side)):
        moved = [path.add(background, image) for image in chunk.frames]
        path.times.extend(chunk.times.tolist())
        where = MovingArea(chunk, moved)
        for image, matrix in zip(chunk.frames, moved, strict=True):
            book.look(previous, image, where(matrix), matrix)
            previous = image
    book.end()
    if len(path.times) < 2:
        raise ValueError(f"track_points: the video has {len(path.times)} frame(s); tracks need at least 2")
    scale = getattr(stream, "scale", (1.0, 1.0)) if isinstance(source, (str, Path)) else (1.0, 1.0)
    camera = path.finish(scale, getattr(stream, "notes", ()))
    limit = MIN_MOTION * float(np.hypot(*camera.size))
    points, notes = _select(book, camera, scale, limit, complete, keep)
    notes += [*camera.notes, *([f"{camera}; it is taken out"] if camera.moves else [])]
    return Tracks(torch.from_numpy(points), torch.from_numpy(camera.times), camera.size, camera, tuple(notes))


class Book:
    """Points being followed, and the histories of those that are worth it."""

    def __init__(self, count: int, settings: FollowSettings):
        self.settings = settings
        self.count, self.frame = count, -1
        self.alive = np.zeros((0, 2), np.float32)
        self.ids = np.zeros(0, int)
        self.histories: dict[int, tuple[int, list[NDArray[np.float32]]]] = {}  # id -> first frame, positions
        self.done: list[tuple[int, NDArray[np.float32]]] = []
        self.next = 0
        self.looks = np.zeros((0, self.settings.patch[0] * self.settings.patch[1]), np.float32)

    def step(self, previous: NDArray[np.uint8] | None, image: NDArray[np.uint8]) -> None:
        """Follow all points into the next frame, and find new ones."""
        self.frame += 1
        if previous is not None and len(self.ids):
            ahead, good = follow(previous, image, self.alive, settings=self.settings)
            self.alive = ahead
            self._keep(good)
            if self.frame % CHECK_FRAMES == 0:
                looks = patches(image, self.alive, settings=self.settings)
                same = (looks * self.looks).sum(1) > MIN_CORRELATION
                self.looks = looks
                self._keep(same)
        self._write()
        if self.frame % self.settings.renewal_frames == 0:
            self._replace(image)

    def _write(self) -> None:
        """Where all points are now."""
        for key, position in zip(self.ids.tolist(), self.alive, strict=True):
            self.histories[key][1].append(position)

    def _replace(self, image: NDArray[np.uint8]) -> None:
        """New points where there are none."""
        self._detect(image, np.ones(image.shape, np.uint8), self.count - len(self.ids))

    def _detect(self, image: NDArray[np.uint8], mask: NDArray[Any], room: int) -> None:
        if room <= 0 or not mask.any():
            return
        apart = max(4, image.shape[1] // self.settings.min_separation)
        free = (mask > 0).astype(np.uint8)
        for x, y in self.alive.tolist():
            cv2().circle(free, (round(x), round(y)), apart, 0, -1)
        found = cv2().goodFeaturesToTrack(image, room, self.settings.min_corner, apart, mask=free, blockSize=7)
        if found is None:
            return
        found = found.reshape(-1, 2)
        ids = np.arange(self.next, self.next + len(found))
        self.next += len(found)
        self._begin(ids, found)
        self.alive, self.ids = np.r_[self.alive, found], np.r_[self.ids, ids]
        self.looks = np.r_[self.looks, patches(image, found, settings=self.settings)]

    def _begin(self, ids: NDArray[np.int_], found: NDArray[np.float32]) -> None:
        """The histories of new points."""
        for key, position in zip(ids.tolist(), found, strict=True):
            self.histories[key] = (self.frame, [position])

    def _keep(self, good: NDArray[np.bool_]) -> None:
        self._finish(self.ids[~good])
        self.alive, self.ids, self.looks = self.alive[good], self.ids[good], self.looks[good]

    def _worth(self, key: int) -> bool:
        """Whether a track that has ended is kept."""
        return len(self.histories[key][1]) >= self.settings.min_frames

    def _finish(self, keys: NDArray[np.int_]) -> None:
        """Put tracks away, or forget those that are worth nothing."""
        for key in keys.tolist():
            if self._worth(key):
                first, positions = self.histories[key]
                self.done.append((first, np.array(positions)))
            del self.histories[key]

    def end(self) -> None:
        """After the last frame."""
        self._keep(np.zeros(len(self.ids), bool))


class _MovingBook(Book):
    """Points that move: they are looked for where something does."""

    def __init__(self) -> None:
        super().__init__(NUM_POINTS, POINT_FOLLOWING)
        self.moved: list[Floats] = []
        self.where = np.zeros((0, 0), np.uint8)

    def look(self, previous: NDArray[np.uint8] | None, image: NDArray[np.uint8], where: NDArray[np.uint8], matrix: Floats) -> None:
        """:meth:`step` into a frame of which is known where something moves, and how its camera did."""
        self.moved.append(matrix)
        self.where = where
        self.step(previous, image)

    def _replace(self, image: NDArray[np.uint8]) -> None:
        """New points where something moves, and a few where nothing does; points that rest elsewhere make room."""
        x, y = np.rint(self.alive).astype(int).T.clip(0, [[image.shape[1] - 1], [image.shape[0] - 1]])
        elsewhere = self.where[y, x] == 0
        spare = elsewhere.sum() - int(STATIC_POINT_SHARE * self.count)
        if spare > 0:
            old = [key for key in self.ids[elsewhere].tolist() if not self._moves(key)][:spare]
            self._keep(~np.isin(self.ids, old))
        self._detect(image, self.where, self.count - len(self.ids))
        resting = int(STATIC_POINT_SHARE * self.count) - max(0, int(elsewhere.sum()))
        self._detect(image, 1 - (self.where > 0), min(resting, self.count - len(self.ids)))

    def _moves(self, key: int) -> bool:
        first, positions = self.histories[key]
        image = transform(np.array(self.moved[first : first + len(positions)]), np.array(positions).astype(np.float64)[:, None])[
            :, 0
        ]
        return extent(image) > MIN_TRACK_EXTENT

    def _worth(self, key: int) -> bool:
        return super()._worth(key) and self._moves(key)

    def _finish(self, keys: NDArray[np.int_]) -> None:
        super()._finish(keys)
        if len(self.done) > 4 * self.count:  # bounded memory: the longest stay
            self.done = sorted(self.done, key=lambda track: -len(track[1]))[: 2 * self.count]


def _select(
    book: Book, camera: CameraMotion, scale: tuple[float, float], limit: float, complete: float, keep: int
) -> tuple[Floats, list[str]]:
    """The tracks that live long enough and move, ``(frames, n, 2)``, and what to say about them."""
    frames = len(camera.times)
    grow = np.asarray(np.linalg.inv(shrink_matrix(scale)), np.float64)
    chosen: list[tuple[int, float, int, Floats]] = []
    shorter = 0
    for first, positions in book.done:
        track = transform(grow, positions.astype(np.float64))
        if camera.moves:
            track = transform(camera.path[first : first + len(track)], track[:, None])[:, 0]
        moves = extent(track)
        if moves < limit or extent(track, 0.5) < MIN_MIDDLE_EXTENT * limit:
            continue
        if len(track) < complete * frames:
            shorter += 1
            continue
        chosen.append((len(track), moves, first, track))
    chosen = sorted(chosen, key=lambda item: item[:2], reverse=True)[:keep]
    points = np.full((frames, len(chosen), 2), np.nan)
    for i, (length, _, first, track) in enumerate(chosen):
        points[first : first + length, i] = track
    notes = []
    if not chosen:
        what = f"{shorter} were followed for less" if shorter else "nothing moves, or there is no texture on what moves"
        notes.append(
            f"no moving point could be followed for {complete:.0%} of the video ({what}); use keypoints, or a shorter stretch"
        )
    return points, notes
