"""Points over time: files of which two or three frames are the views."""

from __future__ import annotations

from dataclasses import dataclass

from indexing.opening import error
from indexing.readers.points.pointset import FloatArray, PointSet


@dataclass(frozen=True, eq=False)
class Sequence:
    """Points over time.

    Attributes:
        path: the file.
        values: ``(frames, n, d)``, NaN = missing.
        ids: ``n`` names; None = none.
        first: number of the first frame.
    """

    path: str
    values: FloatArray
    ids: tuple[str, ...] | None = None
    first: int = 0

    def views(self, frames: tuple[int, ...] | None) -> list[PointSet]:
        """The frames of these numbers; without numbers, all, where there are two or three.

        Raises:
            ValueError: no numbers and more than three frames, or a frame that is not there.
        """
        count = len(self.values)
        last = self.first + count - 1
        if frames is None:
            if count not in (2, 3):
                middle = (self.first + last) // 2
                example = f"--frames {self.first},{middle},{last}"
                raise error(self.path, f"has {count} frames ({self.first} to {last})", f"say which are the views: {example}")
            frames = tuple(range(self.first, last + 1))
        for frame in frames:
            if not self.first <= frame <= last:
                raise error(self.path, f"has no frame {frame}", f"its frames are {self.first} to {last}")
        return [PointSet(f"{self.path} frame {frame}", self.values[frame - self.first], self.ids) for frame in frames]
