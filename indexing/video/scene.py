"""Every point of a scene, what rests and what moves, followed through a video or a sequence of pictures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dyntorch.numerics import check_options
from indexing.video.motion import Floats, shrinking, transform
from indexing.video.options import SceneOptions
from indexing.video.reading import Chunk, Source, cv2
from indexing.video.sequence import PictureSequence, chunks
from indexing.video.tracks import Book

Picture = NDArray[np.uint8]
Images = list[Picture]


@dataclass(frozen=True, eq=False, repr=False)
class SceneTracks:
    """Points in some pictures of a video, as its camera saw them.

    Attributes:
        points: ``(views, n, 2)`` float64 pixels of the video as shown, y down; NaN where a point is not followed to.
        times: ``(views,)`` seconds.
        frames: number of each of the pictures, from 0.
        total: frames that were read.
        size: width and height of the video as shown.
        pictures: gray values of the pictures, each ``(h, w)`` uint8, at the size at which points were followed.
        notes: what a user should know; first, which frames were taken and why.
        pictured: places in ``frames`` of those that ``pictures`` holds; None = all.
    """

    points: Tensor
    times: Tensor
    frames: tuple[int, ...]
    total: int
    size: tuple[int, int]
    pictures: tuple[NDArray[np.uint8], ...]
    notes: tuple[str, ...]
    pictured: tuple[int, ...] | None = None

    def __repr__(self) -> str:
        views, count = self.points.shape[:2]
        head = f"SceneTracks({count} points in {views} of {self.total} frames, {self.size[0]} x {self.size[1]})"
        return "\n".join([head, *(f"  note: {note}" for note in self.notes)])


def track_scene(
    source: Source | Sequence[str | Path],
    *,
    frames: Sequence[int] | None = None,
    at: Sequence[float] | None = None,
    every: int | None = None,
    views: int | None = None,
    missing: bool = False,
    fps: float | None = None,
    options: SceneOptions = SceneOptions(),
) -> SceneTracks:
    """Follow every point that can be followed, the background too, and say where each is in some of the frames.

    Corners all over the picture are followed from frame to frame (KLT), given up where following them back does not end where they
    came from or where they no longer look alike, and replaced.  In the frames that are taken, each is compared with the first of
    them that shows it, so that errors do not add up.  The result is what :func:`dyntorch.align_planar`, :func:`dyntorch.segment`
    and :func:`dyntorch.reconstruct` take.

    Args:
        source: a video; a folder of pictures, a pattern such as ``"frames/*.png"``, or a list of them; or a list of chunks of grey
            frames (read twice).
        frames: numbers of the frames to take, from 0.
        at: moments to take in seconds, instead: the first frame at or after each.
        every: every so many frames, instead.
        views: how many to take where none of these says it: evenly from the first one to the last in which half of its points are
            still followed; 3 by default.
        missing: whether a point may be missing in some of them (``options.present``), or must be in all.
        fps: frames per second of pictures and of files without times.
        options: every number that decides.

    Returns:
        tracks in pixels as measured: the camera's own motion is in them.

    Raises:
        ValueError: a source that cannot be read, frames that it does not have, fewer than two frames, too few points, or no motion.

    Source: Tomasi and Kanade 1991 (tracking), Shi and Tomasi 1994 (corners), Kalal et al. 2010 (forward-backward check).

    Example:
        >>> import numpy as np
        >>> from indexing.video import Chunk
        >>> squares = np.kron(np.random.default_rng(0).integers(0, 255, (30, 40)), np.ones((8, 8))).astype(np.uint8)
        >>> frames = np.stack([squares[:, 2 * i : 2 * i + 160] for i in range(20)])  # the camera goes to the right
        >>> tracks = track_scene([Chunk(frames, np.arange(20) / 10)], views=2)
        >>> tracks.frames, (tracks.points[1] - tracks.points[0]).median(0).values.round().tolist()
        ((0, 19), [-38.0, 0.0])
    """
    check_options(options, SceneOptions)
    wanted = Wanted.of(frames, at, every, views, options)
    stream = chunks(source, size=options.follow.working, fps=fps)
    if iter(stream) is stream:
        raise ValueError("track_scene: chunks that can be read only once, and two passes are needed; give a list of them")
    book, times, first, why = _follow(stream, wanted, options)
    taken = wanted.taken(times, first, name_of(source))
    pictures = _pictures(stream, taken)
    scale = getattr(stream, "scale", (1.0, 1.0))
    least = max(2, round(options.present * len(taken))) if missing else len(taken)
    positions = _seen(_anchored(_at(book, [k - first for k in taken]), pictures, options), least)
    shape = pictures[0].shape
    shown = (round(shape[1] / scale[0]), round(shape[0] / scale[1]))
    check(positions, taken, name_of(source), options)
    points = transform(np.asarray(np.linalg.inv(shrinking(scale)), np.float64), positions)
    moments = np.array([times[k] for k in taken])
    known = isinstance(stream, PictureSequence) and stream.fps is None
    notes = [frames_said(taken, moments, len(times), known) + why, *getattr(stream, "notes", ())]
    return SceneTracks(
        torch.from_numpy(points), torch.from_numpy(moments), tuple(taken), len(times), shown, tuple(pictures), tuple(notes)
    )


@dataclass(frozen=True)
class Wanted:
    """Which frames are asked for: by number, by moment, every so many, or how many of all."""

    frames: tuple[int, ...] | None
    at: tuple[float, ...] | None
    every: int | None
    views: int

    @staticmethod
    def of(
        frames: Sequence[int] | None, at: Sequence[float] | None, every: int | None, views: int | None, options: SceneOptions
    ) -> Wanted:
        if sum(given is not None for given in (frames, at, every, views)) > 1:
            raise ValueError("track_scene: frames, at, every and views each say which frames to take; give one of them")
        for name, given in (("frames", frames), ("at", at)):
            if given is not None and (len(given) < 2 or list(given) != sorted(set(given)) or given[0] < 0):
                raise ValueError(f"track_scene: {name} must be two or more numbers from 0 that increase, got {list(given)}")
        if every is not None and every < 1:
            raise ValueError(f"track_scene: every must be a whole number from 1, got {every!r}")
        if views is not None and views < 2:
            raise ValueError(f"track_scene: views must be at least 2, got {views!r}")
        return Wanted(None if frames is None else tuple(frames), None if at is None else tuple(at), every, views or options.views)

    def begins(self, index: int, time: float) -> bool:
        """Whether the first frame of interest is this one or an earlier one."""
        return index >= self.frames[0] if self.frames is not None else self.at is None or time >= self.at[0] - 1e-6

    def ends(self, index: int, time: float) -> bool:
        """Whether no later frame is asked for."""
        if self.frames is not None:
            return index >= self.frames[-1]
        return self.at is not None and time >= self.at[-1] - 1e-6

    @staticmethod
    def enough(times: list[float], name: str) -> int:
        """How many frames were read."""
        count = len(times)
        if count < 2:
            raise ValueError(f"{name}: has {count} frame{'s' * (count != 1)}, and motion needs at least 2; give a longer video")
        return count

    def taken(self, times: list[float], first: int, name: str) -> list[int]:
        """Numbers of the frames that are taken, of those that were read, ``first`` being the first that was followed."""
        count = self.enough(times, name)
        if self.frames is not None:
            lost = next((k for k in self.frames if k >= count), None)
            if lost is not None:
                raise ValueError(f"{name}: has no frame {lost}; its {count} frames are 0 to {count - 1}")
            return list(self.frames)
        if self.at is not None:
            found = [int(np.searchsorted(times, moment - 1e-6)) for moment in self.at]
            late = next((moment for moment, k in zip(self.at, found, strict=True) if k >= count), None)
            if late is not None:
                raise ValueError(f"{name}: has no frame at {late:g} s; its last one is at {times[-1]:.2f} s")
            if len(set(found)) < len(found):
                said = ", ".join(f"{moment:g}" for moment in self.at)
                raise ValueError(f"{name}: {said} s are not {len(found)} different frames; give moments further apart")
            return found
        if self.every is not None:
            found = list(range(0, count, self.every))
            if len(found) < 2:
                raise ValueError(f"{name}: has {count} frames, so every {self.every} is one frame; take more of them")
            return found
        if count < self.views:
            raise ValueError(f"{name}: has {count} frames, and {self.views} are needed; give a longer video")
        return [int(k) for k in np.linspace(0, count - 1, self.views).round()]


def _follow(stream: Iterable[Chunk], wanted: Wanted, options: SceneOptions) -> tuple[Book, list[float], int, str]:
    """All points through the frames of interest, the times of all frames, the first one followed, and why it ended early."""
    book, first, why = Book(options.count, options.follow), -1, ""
    times: list[float] = []
    previous: NDArray[np.uint8] | None = None
    began: NDArray[np.int_] = np.zeros(0, int)
    lasting = wanted.frames is None and wanted.at is None and wanted.every is None
    for image, time in ((image, float(time)) for chunk in stream for image, time in zip(*chunk, strict=True)):
        index = len(times)
        times.append(time)
        if not wanted.begins(index, time):
            continue
        first = index if first < 0 else first
        book.step(previous, image)
        previous = image
        if index == first:
            began = book.ids.copy()
        if wanted.ends(index, time):
            break
        alive = int(np.isin(began, book.ids).sum())
        if lasting and index + 1 > wanted.views and alive < options.lasting * len(began):
            times.pop()
            why = f"; of the points of the first frame fewer than {options.lasting:.0%} are followed beyond frame {index - 1}"
            break
    book.end()
    return book, times, max(first, 0), why


def _pictures(stream: Iterable[Chunk], taken: list[int]) -> Images:
    """The frames that are taken, read once more."""
    found: Images = []
    index = 0
    for chunk in stream:
        found += [chunk.frames[k - index].copy() for k in taken if index <= k < index + len(chunk.frames)]
        index += len(chunk.frames)
        if index > taken[-1]:
            break
    return found


def _at(book: Book, places: list[int]) -> Floats:
    """Positions ``(views, n, 2)`` of the tracks at these frames of the book, NaN where a track is not there."""
    kept = []
    for first, positions in book.done:
        there = np.array([first <= place < first + len(positions) for place in places])
        row = np.full((len(places), 2), np.nan)
        row[there] = positions[[place - first for place, seen in zip(places, there, strict=True) if seen]]
        kept.append(row)
    return np.stack(kept, axis=1) if kept else np.zeros((len(places), 0, 2))


def _seen(positions: Floats, least: int) -> Floats:
    """Those that are in so many pictures."""
    return positions[:, np.isfinite(positions[..., 0]).sum(axis=0) >= least]


def _anchored(positions: Floats, pictures: Images, options: SceneOptions) -> Floats:
    """Each point compared with the first picture that shows it, there and back from where it was followed to; NaN where it
    fails."""
    views = len(positions)
    if views > options.anchors:
        return positions
    seen = np.isfinite(positions[..., 0])
    first = seen.argmax(axis=0)
    out = positions.copy()
    for j in np.unique(first).tolist():
        for k in range(j + 1, views):
            rows = np.flatnonzero((first == j) & seen[k])
            if len(rows):
                out[k, rows] = matched(pictures[j], pictures[k], positions[j, rows], positions[k, rows], options)
    return out


def matched(before: Picture, after: Picture, here: Floats, there: Floats, options: SceneOptions) -> Floats:
    """Where points ``here (n, 2)`` of one picture are in another, near ``there``; NaN where that is not so, there and back."""
    how = {"winSize": options.follow.patch, "maxLevel": 1, "criteria": (3, 30, 0.003), "flags": cv2().OPTFLOW_USE_INITIAL_FLOW}
    origin, goal = (np.ascontiguousarray(points, np.float32) for points in (here, there))
    moved, ok, _ = cv2().calcOpticalFlowPyrLK(before, after, origin, goal.copy(), **how)
    back, ok_back, _ = cv2().calcOpticalFlowPyrLK(after, before, moved, origin.copy(), **how)
    good = (ok.ravel() > 0) & (ok_back.ravel() > 0) & (np.linalg.norm(back - origin, axis=1) < options.follow.back)
    good &= np.linalg.norm(moved - goal, axis=1) < options.anchored
    return np.where(good[:, None], moved, np.nan).astype(np.float64)


def check(positions: Floats, taken: list[int], name: str, options: SceneOptions) -> None:
    """Raise where there is too little to tell anything from."""
    count = positions.shape[1]
    where = f"frames {', '.join(map(str, taken[:4]))}{', ...' * (len(taken) > 4)}"
    if count < options.fewest:
        said = f"{name}: {count} point{'s' * (count != 1)} could be followed through {where}, {options.fewest} are needed"
        raise ValueError(f"{said}; take frames closer together, or a video with more texture")
    with np.errstate(invalid="ignore"):
        low, high = np.nanmin(positions, axis=0), np.nanmax(positions, axis=0)
    moving = int((np.linalg.norm(high - low, axis=1) > options.rest).sum())
    if moving < options.movers:
        said = f"{name}: nothing moves: {count - moving} of {count} points stay within {options.rest:g} pixel in {where}"
        raise ValueError(f"{said}; take frames further apart")


def frames_said(taken: list[int], moments: Floats, total: int, untimed: bool) -> str:
    """Which frames are taken."""
    steps = np.diff(taken)
    if len(taken) > 4 and (steps == steps[0]).all():
        which = f"{taken[0]} to {taken[-1]}, every {steps[0]}" if steps[0] > 1 else f"{taken[0]} to {taken[-1]}"
    else:
        which = ", ".join(map(str, taken))
    spans = "" if untimed else f" ({moments[0]:.2f} to {moments[-1]:.2f} s)"
    return f"frames {which} of the {total} that were read{spans}"


def name_of(source: object) -> str:
    if isinstance(source, (str, Path)):
        return str(source)
    if isinstance(source, Sequence) and source and isinstance(source[0], (str, Path)):
        return str(source[0])
    return "track_scene"
