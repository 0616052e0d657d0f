"""What a user of translating_planes() may know of his data, or pays with."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PlanesOptions:
    """What :func:`dyntorch.translating_planes` takes and risks."""

    body_weight: float = 100.0
    """Inverse variance of a fundamental matrix against that of a homography: a body with depth is seen larger than a plane's patch.
    At 5 planes and 2 bodies 10 to 10000 do alike."""
    max_steps: int = 100
    """Steps of least squares on the matches at most (time)."""
    num_refined: int = 4
    """Solutions on the matrices that are refined on the matches (time).  Of 4 planes at 0.5 px the best minimum is reached in 98 %;
    with 2 in 90 %."""
    risk: float = 0.1
    """Share of problems whose noise is underestimated; a larger one calls more solutions wrong."""
    max_error: float = 0.5
    """Expected relative error of the homography at infinity, in normalized coordinates, from which on nothing is known of it."""
