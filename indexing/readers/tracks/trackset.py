"""Tracks of points through views, as every format gives them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from indexing.opening import error
from indexing.readers.points.pointset import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class TrackSet:
    """Points followed through views.

    Attributes:
        path: the file, or the first of several.
        values: ``(views, n, 2 | 3)``, NaN = missing.
        ids: ``n`` names.
        views: names of the views: frame numbers, times, or files.
        times: ``(views,)``; None = the files say nothing of time.
        weights: ``(views, n)`` not negative; None = all equal.
        static: ``(n,)`` known to stand still; None = not known of any.
        notes: what a reader should know, a sentence each.
        by_time: whether the views are named by their times.
        start: the time from which ``times`` count, in full: that of the first view where they begin at 0.
    """

    path: str
    values: FloatArray
    ids: tuple[str, ...]
    views: tuple[str, ...]
    times: FloatArray | None = None
    weights: FloatArray | None = None
    static: BoolArray | None = None
    notes: tuple[str, ...] = field(default=())
    by_time: bool = False
    start: float = 0.0

    def since_first(self) -> TrackSet:
        """The same with times that begin at 0; views that are named by their times are named by the new ones.

        Example:
            >>> tracks = TrackSet("t.csv", np.zeros((2, 1, 2)), ("a",), ("1e9", "1e9"), np.array([1e9, 1e9 + 0.2]), by_time=True)
            >>> tracks.since_first().views, tracks.since_first().start
            (('0', '0.2'), 1000000000.0)
        """
        if self.times is None:
            return self
        first = float(self.times[0])
        views = since(self.times) if self.by_time else self.views
        return replace(self, views=views, times=self.times - first, start=self.start + first)

    def select(self, frames: Sequence[str]) -> TrackSet:
        """The views of these names, in this order.

        Raises:
            ValueError: no view has such a name, or one is asked for twice.
        """
        twice = next((frame for i, frame in enumerate(frames) if frame in frames[:i]), None)
        if twice is not None:
            raise error(self.path, f"frame {twice} is asked for twice", "name each view once")
        lost = next((frame for frame in frames if frame not in self.views), None)
        if lost is not None:
            raise error(self.path, f"has no frame {lost}", f"its {len(self.views)} frames are {self.views[0]} to {self.views[-1]}")
        at = np.array([self.views.index(frame) for frame in frames])
        return replace(
            self,
            values=self.values[at],
            views=tuple(frames),
            times=None if self.times is None else self.times[at],
            weights=None if self.weights is None else self.weights[at],
        )

    def seen(self, least: int = 2) -> TrackSet:
        """Without the tracks that fewer views see: of these nothing can be known."""
        count = np.isfinite(self.values).all(axis=-1).sum(axis=0)
        kept = count >= least
        if kept.all():
            return self
        lost = int((~kept).sum())
        was = "track is seen in fewer than {} views and was" if lost == 1 else "tracks are seen in fewer than {} views and were"
        said = f"{lost} {was.format(least)} left out"
        return replace(
            self,
            values=self.values[:, kept],
            ids=tuple(name for name, keep in zip(self.ids, kept, strict=True) if keep),
            weights=None if self.weights is None else self.weights[:, kept],
            static=None if self.static is None else self.static[kept],
            notes=(*self.notes, said),
        )


def since(times: FloatArray) -> tuple[str, ...]:
    """Times since the first, in as many decimals as they have; in full where that would give two the same name.

    Example:
        >>> since(np.array([1700000000.25, 1700000000.45, 1700000001.25]))
        ('0', '0.2', '1')
    """
    finest = float(np.spacing(np.abs(times).max()))
    short = tuple(f"{step:.10g}" for step in np.round(times - times[0], int(np.floor(-np.log10(finest)))))
    return short if len(set(short)) == len(short) else tuple(exact(time - times[0]) for time in times)


def exact(value: float) -> str:
    """A number with all the digits that it has, and no more.

    Example:
        >>> exact(1700000000.25), exact(3.0)
        ('1700000000.25', '3')
    """
    return repr(float(value)).removesuffix(".0")


def numbered(count: int) -> tuple[str, ...]:
    """Names of tracks that have none.

    Example:
        >>> numbered(3)
        ('1', '2', '3')
    """
    return tuple(str(i + 1) for i in range(count))
