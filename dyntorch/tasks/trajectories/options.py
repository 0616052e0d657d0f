"""What decides in triangulate_trajectories() and trajectory_cameras(): every number, with its unit and what was measured for it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class TrajectoryOptions:
    """Every number that decides in :func:`dyntorch.triangulate_trajectories` and :func:`dyntorch.trajectory_cameras`."""

    static: float = 2.0
    """Reprojection error of a point as one that does not move, RMS per degree of freedom, in sigmas, up to which it is called
    static."""
    ambiguous: float = 0.1
    """Expected error of the unit vector of a line, cameras normalized, above which other lines explain the views as well.
    Five views, 0.5 px: at 0.03 to 0.1 nine of ten points are within 0.04 of the scene's radius, at 0.1 to 0.3 within 0.13."""
    least_noise: float = 1e-10
    """Noise, in units of the normalized images, that even exact data are taken to have."""
    second_line_apart: float = 1e-12
    """Squared sine of the angle between the unit vectors of both lines of four views above which they are two."""
    visible: float = 1e-7
    """Length of the image of a line, line and camera of norm 1, below which the line goes through the centre of the camera."""
    adjustments: int = 3
    """Bundle adjustments of the cameras, each from lines that are fitted anew."""
