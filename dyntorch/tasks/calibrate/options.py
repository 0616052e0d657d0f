"""What a caller of ``calibrate`` may ask for beside its arguments."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CalibrateOptions:
    """What a user can set in :func:`dyntorch.calibrate`: how much it takes, and what it may answer."""

    min_matches: int = 60
    """Positions that two cameras must see at the same moments: ten times the seven unknowns of F is little."""
    max_positions: int = 7_000
    """Points times moments that are adjusted, the moments evenly spread: half as many are 1.2 times as far off, in .6 of the time
    (20 rigs of 300 frames and 17 points)."""
    max_rotation_sigma: float = 0.8
    """Degrees: standard deviation of the rotation of a camera beyond which a rig is refused."""
    max_focal_sigma: float = 0.08
    """The same of the focal length, as a share: Pose2Sim's recording of 1.5 s leaves 5 to 6 %, is 4 to 6 % off, and its rotations
    are within 1.6 degrees."""
    max_center_sigma: float = 0.04
    """The same of a centre, as a share of the distance from the people."""
