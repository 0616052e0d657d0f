"""What a user of segment() or segment_tracks() may know of his data, or pays with."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SegmentOptions:
    """What :func:`dyntorch.segment` takes and risks."""

    max_bodies: int = 12
    """Largest number of bodies tried where ``bodies`` is None."""
    outlier_share: float = 0.3
    """Share of wrong matches that is expected where ``spatial=False``: neighbours do not tell it then."""
    false_alarms: float = 1e-2
    """Bodies expected in random matches below which a body is believed where ``spatial=False``."""
    max_searched: int = 1500
    """Matches that the search looks at (time, memory); the others are labelled by what it finds."""
    num_starts: int = 16
    """Random starts for each number of bodies (time); twice as many where at most two numbers are tried."""
    max_samples: int = 24000
    """Samples of seven matches drawn at most where ``spatial=False`` (time)."""


@dataclass(frozen=True)
class TrackSegmentOptions:
    """What :func:`dyntorch.segment_tracks` takes and expects."""

    max_bodies: int = 8
    """Largest number of bodies tried where ``bodies`` is None."""
    min_motion: float = 1.0
    """Extent of the tracks, in 19 of 20 cases, below which nothing moves; pixels at a threshold of 2.5, and follows it."""
    max_frame_pairs: int = 64
    """Pairs of frames compared at most (time, memory)."""
    num_hypotheses: int = 200
    """Motions drawn of each kind (affine, homography, fundamental matrix) for a pair of frames (time)."""
    max_searched: int = 1200
    """Tracks that the search looks at (time, memory); the others are labelled by what it finds."""
