"""Tracks: points followed through three or more views at different times, from files of any common format.

One table with a column of views or times, one file per view (as for alignments), or arrays.
"""

from __future__ import annotations

from indexing.readers.tracks.reading import read_tracks
from indexing.readers.tracks.trackset import TrackSet, exact

__all__ = ["TrackSet", "exact", "read_tracks"]
