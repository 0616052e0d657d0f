"""Every point of a scene, followed through a whole video: points that appear and disappear, also where none lasts."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from dyntorch.numerics import check_options
from indexing.video.motion import Floats, shrinking, transform
from indexing.video.options import SceneOptions
from indexing.video.reading import Chunk, Source, Video
from indexing.video.scene import Images, Picture, SceneTracks, Wanted, check, frames_said, matched, name_of
from indexing.video.sequence import PictureSequence, chunks
from indexing.video.tracks import Book


def track_whole(
    source: Source | Sequence[str | Path],
    *,
    frames: Sequence[int] | None = None,
    at: Sequence[float] | None = None,
    every: int | None = None,
    fps: float | None = None,
    options: SceneOptions = SceneOptions(),
) -> SceneTracks:
    """Follow every point that can be followed through a whole video, from where it appears to where it is lost.

    Corners are followed from frame to frame (KLT) as in :func:`track_scene`; no point has to last.  In the frames that are taken,
    each is compared with the first of ``options.span`` that shows it, and that one with the span before: errors add up from span
    to span only, and a point that looks otherwise now ends there and may begin again.  Of more points than ``options.tracks``, half
    of those kept are those seen longest, the others are taken evenly, so that what passes quickly is there, too.

    Args:
        source: a video; a folder of pictures, a pattern such as ``"frames/*.png"``, or a list of them; or a list of chunks of grey
            frames (read several times).
        frames: numbers of the frames to take, from 0; by default all, or of more than ``options.most`` every so many.
        at: moments to take in seconds, instead: the first frame at or after each.
        every: every so many frames, instead.
        fps: frames per second of pictures and of files without times.
        options: every number that decides.

    Returns:
        tracks in pixels as measured, NaN where a point is not seen, with the pictures of ``options.kept`` of the frames.

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
    check_options(options, SceneOptions)
    wanted = Wanted.of(frames, at, every, None, options)
    stream = chunks(source, size=options.follow.working, fps=fps)
    if iter(stream) is stream:
        raise ValueError("track_whole: chunks that can be read only once, and two passes are needed; give a list of them")
    step = 1 if frames or at or every else -(-_length(stream) // options.most)
    book, times = _followed(stream, wanted, step, options)
    named = name_of(source)
    taken = wanted.taken(times, 0, named) if frames or at or every else list(range(0, wanted.enough(times, named), step))
    least = max(2, min(options.brief, len(taken) // 2))
    positions = chosen(book.table(len(taken)), least, 2 * options.tracks)
    kept = spread(len(taken), options.kept)
    pictures: Images = []
    positions = anchored(positions, _watched(_read(stream, taken), kept, pictures), options)
    count = int((np.isfinite(positions[..., 0]).sum(axis=0) >= least).sum())
    positions = chosen(positions, least, options.tracks)
    scale = getattr(stream, "scale", (1.0, 1.0))
    shape = pictures[0].shape
    shown = (round(shape[1] / scale[0]), round(shape[0] / scale[1]))
    check(positions, taken, named, options)
    moments = np.array([times[k] for k in taken])
    untimed = isinstance(stream, PictureSequence) and stream.fps is None
    notes = [frames_said(taken, moments, len(times), untimed) + f"; at most {options.most} are taken" * (step > 1)]
    if count > options.tracks:
        notes.append(f"{options.tracks:,} of {count:,} points are used: those seen longest, and some of the others")
    points = transform(np.asarray(np.linalg.inv(shrinking(scale)), np.float64), positions)
    return SceneTracks(
        torch.from_numpy(points), torch.from_numpy(moments), tuple(taken), len(times), shown, tuple(pictures),
        (*notes, *getattr(stream, "notes", ())), tuple(kept),
    )  # fmt: skip


# ----------------------------------------------------------------------------------------------------------------------
# First reading: from frame to frame, remembering the frames that are taken.


class _Course(Book):
    """Points followed through any number of frames, of which those that are taken are remembered: memory is bounded."""

    def __init__(self, options: SceneOptions):
        super().__init__(options.count, options.follow)
        self.most = 2 * options.tracks
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
            rows = keeping(np.array([len(positions) for _, positions in self.done]), 2 * self.most)
            self.done = [self.done[i] for i in rows.tolist()]


def _followed(stream: Iterable[Chunk], wanted: Wanted, step: int, options: SceneOptions) -> tuple[_Course, list[float]]:
    """All points through all frames of interest, and the times of all frames up to the last of these."""
    book, taking = _Course(options), _taking(wanted, step)
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


def _taking(wanted: Wanted, step: int) -> Callable[[int, float], bool]:
    """Whether a frame of this number and time is taken, asked in order."""
    if wanted.frames is not None:
        numbers = set(wanted.frames)
        return lambda index, time: index in numbers
    if wanted.at is not None:
        left = list(wanted.at)

        def reached(index: int, time: float) -> bool:
            due = bool(left) and time >= left[0] - 1e-6
            while left and time >= left[0] - 1e-6:
                left.pop(0)
            return due

        return reached
    return lambda index, time: index % (wanted.every or step) == 0


def _length(stream: Iterable[Chunk]) -> int:
    """How many frames a source has, without decoding them where it knows."""
    if isinstance(stream, Video):
        return stream.info.frames
    return len(stream) if isinstance(stream, PictureSequence) else sum(len(chunk.frames) for chunk in stream)


def keeping(lengths: NDArray[np.int_], most: int) -> NDArray[np.int_]:
    """Places of the tracks that are kept, in order: the longest, and as many of the others, evenly."""
    if len(lengths) <= most:
        return np.arange(len(lengths))
    order = np.argsort(-lengths, kind="stable")
    long, rest = order[: most - most // 2], np.sort(order[most - most // 2 :])
    return np.sort(np.concatenate([long, rest[np.linspace(0, len(rest) - 1, most // 2).round().astype(int)]]))


def spread(views: int, most: int) -> list[int]:
    """Places of some of the views, evenly to the last one; the first a little after the beginning, when points have gone
    somewhere."""
    return np.unique(np.linspace(0.1 * (views - 1), views - 1, min(most, views)).round().astype(int)).tolist()


def chosen(positions: Floats, least: int, most: int) -> Floats:
    """The tracks that are seen in so many of the pictures, at most so many of them."""
    lengths = np.isfinite(positions[..., 0]).sum(axis=0)
    rows = np.flatnonzero(lengths >= least)
    return positions[:, rows[keeping(lengths[rows], most)]]


# ----------------------------------------------------------------------------------------------------------------------
# Second reading: each point compared with an earlier picture, span by span.


def _read(stream: Iterable[Chunk], taken: list[int]) -> Iterator[Picture]:
    """The frames that are taken, one by one."""
    index, left = 0, set(taken)
    for chunk in stream:
        for image in chunk.frames:
            if index in left:
                yield image
            index += 1
        if index > taken[-1]:
            return


def _watched(pictures: Iterator[Picture], kept: list[int], out: Images) -> Iterator[Picture]:
    """The same; those that are kept are copied on the way."""
    for i, image in enumerate(pictures):
        if i in kept:
            out.append(image.copy())
        yield image


def anchored(positions: Floats, pictures: Iterator[Picture], options: SceneOptions) -> Floats:
    """Each point compared with the first picture of every span that shows it, there and back from where it was followed to.
    positions ``(views, n, 2)`` -> ``(views, m, 2)``."""
    out = positions.copy()
    again: list[Floats] = []
    views = len(out)
    held: Images = []
    start = 0
    for image in pictures:
        held.append(image)
        if len(held) <= options.span and start + len(held) < views:
            continue
        stop = start + len(held)
        ended = _compared(out, start, held, options)
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


def _compared(out: Floats, start: int, pictures: Images, options: SceneOptions) -> NDArray[np.int_]:
    """Compare the points of one span in place, and carry what they are corrected by; the tracks that end in it."""
    part = out[start : start + len(pictures)]
    before = part.copy()
    seen = np.isfinite(before[..., 0])
    some: NDArray[np.bool_] = np.asarray(seen.any(axis=0))
    first = np.where(some, seen.argmax(axis=0), -1)
    for j in np.unique(first[first >= 0]).tolist():
        for k in range(j + 1, len(pictures)):
            rows = np.flatnonzero((first == j) & seen[k])
            if len(rows):
                part[k, rows] = matched(pictures[j], pictures[k], part[j, rows], before[k, rows], options)
    last = len(seen) - 1 - seen[::-1].argmax(axis=0)
    there = np.isfinite(part[..., 0])
    columns = np.arange(out.shape[1])
    fine = there[last, columns]
    shift = np.where(fine[:, None], part[last, columns] - before[last, columns], 0.0)
    out[start + len(pictures) :] += np.where(some[:, None], shift, 0.0)
    return np.flatnonzero(some & ~fine)
