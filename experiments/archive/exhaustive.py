"""Everything compared with everything, for comparison: what an archive's search approximates, and what people use today.

Recordings are cut into windows of the query's duration (or several durations) on an even grid of starts; a measure compares every
window with every query; neighbours are merged to one hit, as the archive does it: only the best of its surroundings may be a hit,
and hits that mostly cover one another are one.  The exact measure is that of the action indexer, as an archive uses it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from experiments.recognition.baselines import WarpedNearest
from experiments.recognition.protocol import Array
from indexing import Archive, Clip
from indexing.action.bank import Bank, Copy, JointMetric, Windows, channel, compare_windows, fused_residuals, planes_of
from indexing.archive import search
from indexing.archive.search import Hit
from indexing.archive.tracks import WINDOW_LENGTH
from indexing.windows import concatenate_clips, sample

STEP = 0.1  # seconds between windows
PART = 100  # recordings that are cut at once: bounds memory
KEPT = 3000  # windows per query that may become hits


@dataclass(frozen=True)
class Measure:
    """A way to compare windows: ``compare(queries, windows) -> (Q, N)``, higher is more alike; length: steps of a window."""

    length: int
    compare: Callable[[Windows, Windows], Tensor]


def metric_of(archive: Archive) -> JointMetric:
    """How much joints count in the exact comparison of an archive of one joint layout."""
    (layout,) = archive._open_snapshot().contents.layouts.values()
    return layout.joint_metric()


def exact(metric: JointMetric) -> Measure:
    """Minus the fused epipolar residual of clip, frame and motion."""
    planes = planes_of(metric)

    def compare(queries: Windows, windows: Windows) -> Tensor:
        return -fused_residuals(queries, [Bank([Copy(windows)], planes)], [("epi",)])[0]

    return Measure(WINDOW_LENGTH, compare)


def cosine(heights: bool, length: int = 12) -> Measure:
    """Of plain 2D poses about the window's middle; or of the heights alone, about the middle of every frame."""

    def describe(values: Tensor) -> Tensor:
        image = channel(values, "frame")[..., 1] if heights else channel(values, "clip")
        return torch.nn.functional.normalize(image.flatten(1), dim=1)

    def compare(queries: Tensor, windows: Tensor, _: Tensor | slice) -> Tensor:
        return describe(queries) @ describe(windows).mT

    return Measure(length, lambda queries, windows: compare_windows(queries, windows, compare, -1.0))


def warped() -> Measure:
    """Minus the distance by dynamic time warping (aeon) of normalized 2D poses.

    Raises:
        ValueError: aeon is not installed.
    """
    try:
        method = WarpedNearest()
    except ImportError:
        raise ValueError("aeon is not installed; pip install 'dyntorch[experiments]', or leave out what needs it") from None

    def compare(queries: Windows, windows: Windows) -> Tensor:
        return -torch.from_numpy(method.between(method.describe(queries.values), method.describe(windows.values))).float()

    return Measure(method.LENGTH, compare)


# ---- windows -----------------------------------------------------------------------------------------------------------
def cut(clips: Sequence[Clip], duration: float, step: float) -> tuple[Array, Array]:
    """``(windows,)`` owner and start of the windows that clips have room for; a clip that is a little too short is one."""
    owner, start = [], []
    for i, clip in enumerate(clips):
        room = clip.duration - duration
        count = int(room / step + 1e-6) + 1 if room > -step else 0
        owner.append(np.full(count, i, dtype=np.intp))
        start.append(clip.times[0] + step * np.arange(count) + min(0.0, room) / 2)
    return np.concatenate(owner), np.concatenate(start)


def windows_at(clips: Sequence[Clip], owner: Array, start: Array, duration: float, length: int) -> Windows:
    """Windows of some clips."""
    source = concatenate_clips(clips)
    return Windows(sample(source, owner, start, start + duration, length), torch.from_numpy(source.seen[owner]))


def asked(clips: Sequence[Clip], length: int) -> Windows:
    """Queries, each as one window."""
    source = concatenate_clips(clips)
    first, last = source.times[source.starts[:-1]], source.times[source.starts[1:] - 1]
    return Windows(sample(source, np.arange(len(clips)), first, last, length), torch.from_numpy(source.seen))


@dataclass(frozen=True)
class Ranking:
    """The best windows of one query, best first: ``(windows,)`` owner, start, end, score."""

    owner: Array
    start: Array
    end: Array
    score: Array

    def best(self, count: int) -> Ranking:
        """The first of those that may be hits, of equal ones those that come first in the archive."""
        order = np.argsort(-self.score, kind="stable")[:count]
        order = order[np.isfinite(self.score[order])]
        return Ranking(self.owner[order], self.start[order], self.end[order], self.score[order])

    def together(self, other: Ranking) -> Ranking:
        """Those of both, in no order."""
        pairs = ((getattr(self, name), getattr(other, name)) for name in ("owner", "start", "end", "score"))
        return Ranking(*(np.concatenate(pair) for pair in pairs))


def rankings(
    queries: Sequence[Clip],
    clips: Sequence[Clip],
    duration: float,
    measures: Mapping[str, Measure],
    tempos: Sequence[float] | None = None,
    step: float = STEP,
) -> dict[str, list[Ranking]]:
    """For every measure the best KEPT windows of every query, all of one duration.

    Args:
        tempos: durations of the windows, in those of the query; by default those that the archive tries.
        step: seconds between their starts.
    """
    lengths = {one.length for one in measures.values()}
    queried = {length: asked(queries, length) for length in lengths}
    nothing = Ranking(np.empty(0, dtype=np.intp), np.empty(0), np.empty(0), np.empty(0, dtype=np.float32))
    found = {name: [nothing] * len(queries) for name in measures}
    for at in range(0, len(clips), PART):
        part = clips[at : at + PART]
        for tempo in search.TEMPOS if tempos is None else tempos:
            owner, start = cut(part, tempo * duration, step)
            if not len(owner):
                continue
            apart = round(search.MIN_SEPARATION * tempo * duration / step)
            windows = {length: windows_at(part, owner, start, tempo * duration, length) for length in lengths}
            for name, one in measures.items():
                scores = peaks(one.compare(queried[one.length], windows[one.length]), owner, apart).numpy()
                add = partial(Ranking, owner + at, start, start + tempo * duration)
                found[name] = [old.together(add(row).best(KEPT)) for old, row in zip(found[name], scores, strict=True)]
        found = {name: [one.best(KEPT) for one in lists] for name, lists in found.items()}
    return found


def peaks(scores: Tensor, owner: Array, apart: int) -> Tensor:
    """``(Q, N)`` scores where none of the ``apart`` windows before and after it, of one owner, is better; else minus infinity.

    Example:
        >>> peaks(torch.tensor([[1.0, 3.0, 2.0, 4.0]]), np.array([0, 0, 0, 1]), 1).tolist()
        [[-inf, 3.0, -inf, 4.0]]
    """
    highest, nothing = scores.clone(), torch.tensor(-torch.inf)
    for step in range(1, min(apart, scores.shape[1] - 1) + 1):
        same = torch.from_numpy(owner[step:] == owner[:-step])
        torch.maximum(highest[:, step:], torch.where(same, scores[:, :-step], nothing), out=highest[:, step:])
        torch.maximum(highest[:, :-step], torch.where(same, scores[:, step:], nothing), out=highest[:, :-step])
    return torch.where(scores >= highest, scores, nothing)


def merged(ranking: Ranking, count: int, share: float) -> Iterator[tuple[int, float, float, float]]:
    """The best ``count`` hits ``(owner, start, end, score)``: of those that cover ``share`` of the shorter one, only the best.

    Example:
        >>> start = np.array([0.0, 0.2, 1.0, 5.0])
        >>> four = Ranking(np.zeros(4), start, start + 1.0, np.array([4.0, 3.0, 2.0, 1.0]))
        >>> [begin for _, begin, _, _ in merged(four, 10, 0.5)]
        [0.0, 1.0, 5.0]
    """
    left = np.ones(len(ranking.owner), dtype=bool)
    lasts = ranking.end - ranking.start
    for _ in range(count):
        if not left.any():
            return
        best = int(left.argmax())
        yield int(ranking.owner[best]), float(ranking.start[best]), float(ranking.end[best]), float(ranking.score[best])
        common = np.minimum(ranking.end, ranking.end[best]) - np.maximum(ranking.start, ranking.start[best])
        near = common >= share * np.minimum(lasts, lasts[best]) - 1e-9
        left &= ~(near & (ranking.owner == ranking.owner[best]))
        left[best] = False


def hits(ranking: Ranking, clips: Sequence[Clip], count: int) -> list[Hit]:
    """The same as an archive answers."""
    return [
        Hit(clips[owner].name, "", start, end, score) for owner, start, end, score in merged(ranking, count, search.MAX_OVERLAP)
    ]
