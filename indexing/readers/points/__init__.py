"""Points or lines of two or three views, from files of any common format -> matched arrays: one file per format.

Adding a format is one new module with ``read(path) -> PointSet | Sequence``, and a line in :func:`open_points`.
"""

from __future__ import annotations

from indexing.readers.points.matching import Matched, open_points, read_matches
from indexing.readers.points.pointset import PointSet
from indexing.readers.points.sequence import Sequence

__all__ = ["Matched", "PointSet", "Sequence", "open_points", "read_matches"]
