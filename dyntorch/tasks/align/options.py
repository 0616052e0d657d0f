"""What a user of align_planar(), align_points() or align_lines() may know of his data, or pays with."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class AlignOptions:
    """What :func:`dyntorch.align_planar`, :func:`dyntorch.align_points` and :func:`dyntorch.align_lines` take and expect."""

    num_samples: int | None = None
    """Minimal samples drawn (time); None is what each model needs at 20 to 40 % of static matches: 60 to 2000."""
    min_static_share: float = 0.1
    """Share of the matches (and at least 3) that must have one velocity to be taken for the static background, where all are at
    constant velocity."""
    max_deviation: float = 0.05
    """Standard deviation of the worst direction of a motion of norm 1 (rigid: radians, or sizes of the scene) without a notice."""
