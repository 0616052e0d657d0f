"""Tracks of points through views, as every format gives them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from indexing.readers.points.pointset import BoolArray, FloatArray, error


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
    """

    path: str
    values: FloatArray
    ids: tuple[str, ...]
    views: tuple[str, ...]
    times: FloatArray | None = None
    weights: FloatArray | None = None
    static: BoolArray | None = None
    notes: tuple[str, ...] = field(default=())

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


def numbered(count: int) -> tuple[str, ...]:
    """Names of tracks that have none.

    Example:
        >>> numbered(3)
        ('1', '2', '3')
    """
    return tuple(str(i + 1) for i in range(count))
