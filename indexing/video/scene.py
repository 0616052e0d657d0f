"""Every point of a scene, what rests and what moves, followed through a video or a sequence of pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dyntorch.numerics import check_options
from indexing.video.motion import Floats, shrink_matrix, transform
from indexing.video.reading import Chunk, Source, Video, cv2
from indexing.video.sequence import PictureSequence, chunks, select_frames
from indexing.video.tracks import Book, FollowSettings, follow_both_ways

Picture = NDArray[np.uint8]
Images = list[Picture]

# Points more than a pixel off after 40 frames of rendered scenes (experiments.alignment.videos), patches of 11 / 15 / 21 pixels:
# a plane .001 / 0 / .002, a room .021 / .029 / .042.
SCENE_FOLLOWING = FollowSettings(
    working_side=1280, max_return_error=0.5, patch=(15, 15), min_corner=0.003, renewal_frames=5, min_separation=60, min_frames=2
)
RECONSTRUCTION_FRAMES = 8  # taken by dyntorch reconstruct, which compares many models of motion
DEFAULT_FRAMES = 3  # taken where nobody says which
MIN_PRESENCE = 0.6  # share of the frames taken in which a point must be seen
MIN_SURVIVAL = 0.5  # share of the first frame's points still followed in the last one taken
MAX_ANCHOR_CORRECTION = 1.0  # pixels by which a comparison with its first frame corrects a point; beyond, it is lost
MAX_ANCHOR_FRAMES = 24  # up to which that is done: it costs their number squared
MIN_POINTS = 12  # that must be there in two frames
STATIC_TOLERANCE = 1.0  # pixels that a static point before a static camera stays within
MIN_MOVING_POINTS = 4  # with fewer, nothing moves
THRESHOLD = 1.0  # pixels within which a point is followed; estimated, it is .3, and static walls are called moving


@dataclass(frozen=True)
class SceneTrackOptions:
    """How much of a scene is followed: what memory and time it takes."""

    num_points: int = 800
    """Points followed at a time."""
    max_frames: int = 200
    """Frames taken at most where a whole video is followed and nobody says which."""
    max_tracks: int = 3000
    """Points kept at most of a whole video."""


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
    options: SceneTrackOptions | None = None,
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
        missing: whether a point may be missing in some of them (see ``MIN_PRESENCE``), or must be in all.
        fps: frames per second of pictures and of files without times.
        options: how many points.

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
    options = options or SceneTrackOptions()
    check_options(options, SceneTrackOptions)
    wanted = Wanted.of(frames, at, every, views)
    stream = chunks(source, size=SCENE_FOLLOWING.working_side, fps=fps)
    if iter(stream) is stream:
        raise ValueError("track_scene: chunks that can be read only once, and two passes are needed; give a list of them")
    book, times, first, why = _follow(stream, wanted, options)
    taken = wanted.frame_numbers(times, first, name_of(source))
    pictures = [image.copy() for image in select_frames(stream, taken)]
    least = max(2, round(MIN_PRESENCE * len(taken))) if missing else len(taken)
    positions = _at(book, [k - first for k in taken])
    positions = _drop_rarely_seen(positions if len(taken) > MAX_ANCHOR_FRAMES else _refine_to_first(positions, pictures), least)
    return _scene_tracks(stream, name_of(source), positions, pictures, taken, times, why)


def _scene_tracks(
    stream: Iterable[Chunk],
    name: str,
    positions: Floats,
    pictures: Images,
    taken: list[int],
    times: list[float],
    why: str,
    notes: Sequence[str] = (),
    pictured: tuple[int, ...] | None = None,
) -> SceneTracks:
    """The result, in pixels of the video as shown, from positions ``(views, n, 2)`` in the pictures."""
    check(positions, taken, name)
    scale = getattr(stream, "scale", (1.0, 1.0))
    height, width = pictures[0].shape
    points = transform(np.asarray(np.linalg.inv(shrink_matrix(scale)), np.float64), positions)
    moments = np.array([times[k] for k in taken])
    untimed = isinstance(stream, PictureSequence) and stream.fps is None
    shown = (round(width / scale[0]), round(height / scale[1]))
    said = (frames_said(taken, moments, len(times), untimed) + why, *notes, *getattr(stream, "notes", ()))
    return SceneTracks(
        torch.from_numpy(points), torch.from_numpy(moments), tuple(taken), len(times), shown, tuple(pictures), said, pictured
    )


@dataclass(frozen=True)
class Wanted:
    """Which frames are asked for: by number, by moment, every so many, or how many of all."""

    frames: tuple[int, ...] | None
    at: tuple[float, ...] | None
    every: int | None
    views: int

    @staticmethod
    def of(frames: Sequence[int] | None, at: Sequence[float] | None, every: int | None, views: int | None) -> Wanted:
        if sum(given is not None for given in (frames, at, every, views)) > 1:
            raise ValueError("track_scene: frames, at, every and views each say which frames to take; give one of them")
        for name, given in (("frames", frames), ("at", at)):
            if given is not None and (len(given) < 2 or list(given) != sorted(set(given)) or given[0] < 0):
                raise ValueError(f"track_scene: {name} must be two or more numbers from 0 that increase, got {list(given)}")
        if every is not None and every < 1:
            raise ValueError(f"track_scene: every must be a whole number from 1, got {every!r}")
        if views is not None and views < 2:
            raise ValueError(f"track_scene: views must be at least 2, got {views!r}")
        return Wanted(None if frames is None else tuple(frames), None if at is None else tuple(at), every, views or DEFAULT_FRAMES)

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

    def frame_numbers(self, times: list[float], first: int, name: str) -> list[int]:
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


def _follow(stream: Iterable[Chunk], wanted: Wanted, options: SceneTrackOptions) -> tuple[Book, list[float], int, str]:
    """All points through the frames of interest, the times of all frames, the first one followed, and why it ended early."""
    book, first, why = Book(options.num_points, SCENE_FOLLOWING), -1, ""
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
        if lasting and index + 1 > wanted.views and alive < MIN_SURVIVAL * len(began):
            times.pop()
            why = f"; of the points of the first frame fewer than {MIN_SURVIVAL:.0%} are followed beyond frame {index - 1}"
            break
    book.end()
    return book, times, max(first, 0), why


def _at(book: Book, places: list[int]) -> Floats:
    """Positions ``(views, n, 2)`` of the tracks at these frames of the book, NaN where a track is not there."""
    kept = []
    for first, positions in book.done:
        there = np.array([first <= place < first + len(positions) for place in places])
        row = np.full((len(places), 2), np.nan)
        row[there] = positions[[place - first for place, seen in zip(places, there, strict=True) if seen]]
        kept.append(row)
    return np.stack(kept, axis=1) if kept else np.zeros((len(places), 0, 2))


def _drop_rarely_seen(positions: Floats, least: int) -> Floats:
    """Those that are in so many pictures."""
    return positions[:, np.isfinite(positions[..., 0]).sum(axis=0) >= least]


def _refine_to_first(positions: Floats, pictures: Images) -> Floats:
    """Each point compared with the first picture that shows it, there and back from where it was followed to; NaN where it
    fails."""
    seen = np.isfinite(positions[..., 0])
    first = seen.argmax(axis=0)
    out = positions.copy()
    for j in np.unique(first).tolist():
        for k in range(j + 1, len(positions)):
            rows = np.flatnonzero((first == j) & seen[k])
            if len(rows):
                out[k, rows] = refine_match(pictures[j], pictures[k], positions[j, rows], positions[k, rows])
    return out


def refine_match(before: Picture, after: Picture, here: Floats, there: Floats) -> Floats:
    """Where points ``here (n, 2)`` of one picture are in another, near ``there``; NaN where that is not so, there and back."""
    how = {"winSize": SCENE_FOLLOWING.patch, "maxLevel": 1, "criteria": (3, 30, 0.003), "flags": cv2().OPTFLOW_USE_INITIAL_FLOW}
    origin, goal = (np.ascontiguousarray(points, np.float32) for points in (here, there))
    moved, good = follow_both_ways(before, after, origin, goal.copy(), SCENE_FOLLOWING.max_return_error, **how)
    good &= np.linalg.norm(moved - goal, axis=1) < MAX_ANCHOR_CORRECTION
    return np.where(good[:, None], moved, np.nan).astype(np.float64)


def check(positions: Floats, taken: list[int], name: str) -> None:
    """Raise where there is too little to tell anything from."""
    count = positions.shape[1]
    where = f"frames {', '.join(map(str, taken[:4]))}{', ...' * (len(taken) > 4)}"
    if count < MIN_POINTS:
        said = f"{name}: {count} point{'s' * (count != 1)} could be followed through {where}, {MIN_POINTS} are needed"
        raise ValueError(f"{said}; take frames closer together, or a video with more texture")
    with np.errstate(invalid="ignore"):
        low, high = np.nanmin(positions, axis=0), np.nanmax(positions, axis=0)
    moving = int((np.linalg.norm(high - low, axis=1) > STATIC_TOLERANCE).sum())
    if moving < MIN_MOVING_POINTS:
        said = f"{name}: nothing moves: {count - moving} of {count} points stay within {STATIC_TOLERANCE:g} pixel in {where}"
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


MIN_TRACK_FRAMES = 5  # of a whole video; half of them where there are fewer than twice as many
ANCHOR_SPAN = 16  # frames after which a point is compared with a newer one; 8 / 16 / 24 lose .039 / .030 / .024
NUM_PICTURES = 4  # of a whole video that are kept, to draw on


def track_whole(
    source: Source | Sequence[str | Path],
    *,
    frames: Sequence[int] | None = None,
    at: Sequence[float] | None = None,
    every: int | None = None,
    options: SceneTrackOptions | None = None,
) -> SceneTracks:
    """Follow every point that can be followed through a whole video, from where it appears to where it is lost.

    Corners are followed from frame to frame (KLT) as in :func:`track_scene`; no point has to last.  In the frames that are taken,
    each is compared with the first of ``ANCHOR_SPAN`` that shows it, and that one with the span before: errors add up from span
    to span only, and a point that looks otherwise now ends there and may begin again.  Of more points than ``max_tracks``, half
    of those kept are those seen longest, the others are taken evenly, so that what passes quickly is there, too.

    Args:
        source: a video; a folder of pictures, a pattern such as ``"frames/*.png"``, or a list of them; or a list of chunks of grey
            frames (read several times).
        frames: numbers of the frames to take, from 0; by default all, or of more than ``options.max_frames`` every so many.
        at: moments to take in seconds, instead: the first frame at or after each.
        every: every so many frames, instead.
        options: how many points and frames.

    Returns:
        tracks in pixels as measured, NaN where a point is not seen, with the pictures of ``NUM_PICTURES`` of the frames.

    Raises:
        ValueError: a source that cannot be read, frames that it does not have, fewer than two frames, too few points, or no motion.

    Source: Tomasi and Kanade 1991 (tracking), Shi and Tomasi 1994 (corners), Kalal et al. 2010 (forward-backward check).

    Example:
        >>> import numpy as np
        >>> from indexing.video import Chunk
        >>> squares = np.kron(np.random.default_rng(0).integers(0, 255, (30, 60)), np.ones((8, 8))).astype(np.uint8)
        >>> frames = np.stack([squares[:, 8 * i : 8 * i + 160] for i in range(40)])  # nothing of the first frame is in the last
        >>> tracks = track_whole([Chunk(frames, np.arange(40) / 10)])
        >>> seen = tracks.points.isfinite().all(-1)
        >>> len(tracks.frames), bool(seen.all(0).any()), bool(seen.any(1).all())
        (40, False, True)
    """
    options = options or SceneTrackOptions()
    check_options(options, SceneTrackOptions)
    wanted = Wanted.of(frames, at, every, None)
    stream = chunks(source, size=SCENE_FOLLOWING.working_side)
    if iter(stream) is stream:
        raise ValueError("track_whole: chunks that can be read only once, and two passes are needed; give a list of them")
    step = 1 if frames or at or every else -(-_length(stream) // options.max_frames)
    book, times = _follow_all(stream, wanted, step, options)
    named = name_of(source)
    taken = wanted.frame_numbers(times, 0, named) if frames or at or every else list(range(0, wanted.enough(times, named), step))
    least = max(2, min(MIN_TRACK_FRAMES, len(taken) // 2))
    positions = select_longest(book.table(len(taken)), least, 2 * options.max_tracks)
    kept = evenly_spaced(len(taken), NUM_PICTURES)
    pictures: Images = []
    positions = refine_along_spans(positions, _collect_pictures(select_frames(stream, taken), kept, pictures))
    count = int((np.isfinite(positions[..., 0]).sum(axis=0) >= least).sum())
    positions = select_longest(positions, least, options.max_tracks)
    notes = []
    if count > options.max_tracks:
        notes.append(f"{options.max_tracks:,} of {count:,} points are used: those seen longest, and some of the others")
    why = f"; at most {options.max_frames} are taken" * (step > 1)
    return _scene_tracks(stream, named, positions, pictures, taken, times, why, notes, tuple(kept))


# ----------------------------------------------------------------------------------------------------------------------
# First reading: from frame to frame, remembering the frames that are taken.


class _Course(Book):
    """Points followed through any number of frames, of which those that are taken are remembered: memory is bounded."""

    def __init__(self, options: SceneTrackOptions):
        super().__init__(options.num_points, SCENE_FOLLOWING)
        self.most = 2 * options.max_tracks
        self.view, self.taking, self.renewed = -1, False, 0

    def look(self, previous: Picture | None, image: Picture, taking: bool) -> None:
        """:meth:`step` into a frame that is taken, or not."""
        self.taking = taking
        self.view += taking
        self.step(previous, image)
        if len(self.ids) < 0.5 * self.renewed:  # a cut, or something that hides most
            self._replace(image)

    def table(self, views: int) -> Floats:
        """Positions ``(views, n, 2)``, NaN where a point is not seen."""
        out = np.full((views, len(self.done), 2), np.nan, np.float32)
        for i, (first, positions) in enumerate(self.done):
            out[first : first + len(positions), i] = positions[: views - first]
        return out.astype(np.float64)

    def _write(self) -> None:
        if self.taking:
            super()._write()

    def _begin(self, ids: NDArray[np.int_], found: NDArray[np.float32]) -> None:
        for key, position in zip(ids.tolist(), found, strict=True):
            self.histories[key] = (self.view, [position]) if self.taking else (self.view + 1, [])

    def _replace(self, image: Picture) -> None:
        super()._replace(image)
        self.renewed = len(self.ids)

    def _finish(self, keys: NDArray[np.int_]) -> None:
        super()._finish(keys)
        if len(self.done) > 4 * self.most:
            rows = select_indices(np.array([len(positions) for _, positions in self.done]), 2 * self.most)
            self.done = [self.done[i] for i in rows.tolist()]


def _follow_all(stream: Iterable[Chunk], wanted: Wanted, step: int, options: SceneTrackOptions) -> tuple[_Course, list[float]]:
    """All points through all frames of interest, and the times of all frames up to the last of these."""
    book, taking = _Course(options), _frame_selector(wanted, step)
    times: list[float] = []
    previous: Picture | None = None
    for image, time in ((image, float(time)) for chunk in stream for image, time in zip(*chunk, strict=True)):
        index = len(times)
        times.append(time)
        if not wanted.begins(index, time):
            continue
        book.look(previous, image, taking(index, time))
        previous = image
        if wanted.ends(index, time):
            break
    book.end()
    return book, times


def _frame_selector(wanted: Wanted, step: int) -> Callable[[int, float], bool]:
    """Whether a frame of this number and time is taken, asked in order."""
    if wanted.frames is not None:
        numbers = set(wanted.frames)
        return lambda index, time: index in numbers
    if wanted.at is not None:
        left = list(wanted.at)

        def is_due(index: int, time: float) -> bool:
            due = bool(left) and time >= left[0] - 1e-6
            while left and time >= left[0] - 1e-6:
                left.pop(0)
            return due

        return is_due
    return lambda index, time: index % (wanted.every or step) == 0


def _length(stream: Iterable[Chunk]) -> int:
    """How many frames a source has, without decoding them where it knows."""
    if isinstance(stream, Video):
        return stream.info.frames
    return len(stream) if isinstance(stream, PictureSequence) else sum(len(chunk.frames) for chunk in stream)


def select_indices(lengths: NDArray[np.int_], most: int) -> NDArray[np.int_]:
    """Places of the tracks that are kept, in order: the longest, and as many of the others, evenly."""
    if len(lengths) <= most:
        return np.arange(len(lengths))
    order = np.argsort(-lengths, kind="stable")
    long, rest = order[: most - most // 2], np.sort(order[most - most // 2 :])
    return np.sort(np.concatenate([long, rest[np.linspace(0, len(rest) - 1, most // 2).round().astype(int)]]))


def evenly_spaced(views: int, most: int) -> list[int]:
    """Places of some of the views, evenly to the last one; the first a little after the beginning, when points have gone
    somewhere."""
    return np.unique(np.linspace(0.1 * (views - 1), views - 1, min(most, views)).round().astype(int)).tolist()


def select_longest(positions: Floats, least: int, most: int) -> Floats:
    """The tracks that are seen in so many of the pictures, at most so many of them."""
    lengths = np.isfinite(positions[..., 0]).sum(axis=0)
    rows = np.flatnonzero(lengths >= least)
    return positions[:, rows[select_indices(lengths[rows], most)]]


# ----------------------------------------------------------------------------------------------------------------------
# Second reading: each point compared with an earlier picture, span by span.


def _collect_pictures(pictures: Iterator[Picture], kept: list[int], out: Images) -> Iterator[Picture]:
    """The same; those that are kept are copied on the way."""
    for i, image in enumerate(pictures):
        if i in kept:
            out.append(image.copy())
        yield image


def refine_along_spans(positions: Floats, pictures: Iterator[Picture]) -> Floats:
    """Each point compared with the first picture of every span that shows it, there and back from where it was followed to.
    positions ``(views, n, 2)`` -> ``(views, m, 2)``."""
    out = positions.copy()
    again: list[Floats] = []
    views = len(out)
    held: Images = []
    start = 0
    for image in pictures:
        held.append(image)
        if len(held) <= ANCHOR_SPAN and start + len(held) < views:
            continue
        stop = start + len(held)
        ended = _refine_to_anchor(out, start, held)
        later = np.isfinite(out[stop:, ended, 0]).any(axis=0)
        if later.any():
            rows = ended[later]
            new = np.full((views, len(rows), 2), np.nan)
            new[stop:] = out[stop:, rows]
            again.append(new)
        out[stop:, ended] = np.nan
        if again:
            out = np.concatenate([out, *again], axis=1)
            again = []
        held, start = held[-1:], stop - 1
    return out


def _refine_to_anchor(out: Floats, start: int, pictures: Images) -> NDArray[np.int_]:
    """Compare the points of one span in place, and carry what they are corrected by; the tracks that end in it."""
    part = out[start : start + len(pictures)]
    before = part.copy()
    seen = np.isfinite(before[..., 0])
    some: NDArray[np.bool_] = np.asarray(seen.any(axis=0))
    part[:] = _refine_to_first(before, pictures)
    last = len(seen) - 1 - seen[::-1].argmax(axis=0)
    there = np.isfinite(part[..., 0])
    columns = np.arange(out.shape[1])
    fine = there[last, columns]
    shift = np.where(fine[:, None], part[last, columns] - before[last, columns], 0.0)
    out[start + len(pictures) :] += np.where(some[:, None], shift, 0.0)
    return np.flatnonzero(some & ~fine)
