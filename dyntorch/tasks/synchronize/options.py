"""What a user can set in synchronize(), and in putting several cameras on one clock."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class SynchronizeOptions:
    """What is known of the data, and what is paid, in :func:`dyntorch.synchronize`, :func:`dyntorch.synchronize_cameras` and
    :func:`dyntorch.tasks.breaks`."""

    min_frames: int = 12
    """Frames of each recording at least."""
    min_margin: float = 0.2
    """Risk of a wrong period, for corresponding points: nats by which the best peak must lead, 2.5 times as many for affine
    cameras.  Of exactly periodic gaits 95 of 100 lead by less than .17, right peaks by more than .31 (30 mm of noise)."""
    reject_points: bool = True
    """Whether some points may be others than those of the same number in the other camera, and are looked for and left out."""
    camera_model: Literal["auto", "affine", "affine_moving", "perspective"] = "auto"
    """Kind of both cameras, for different points; ``"auto"`` selects the one whose best lag stands out most."""
    measure: Literal["auto", "rank", "log_determinant", "principal_angles"] = "auto"
    """What two row spaces share, for different points: one measure of the thesis, or ``"auto"``: the log-determinant, beside the
    mutual information of shape and motion."""
    body_measure: Literal["attitude", "rank"] = "attitude"
    """What ranks the lags of ``camera="projective"``: the disagreement about the body's attitude, or the rank of both cameras'
    scaled measurements, which is exact for whole frames and long recordings alone."""
    focal_lengths: tuple[float, ...] = (4.0, 9.0, 25.0)
    """Starting focal lengths of ``camera="projective"``, over the RMS coordinate of the tracks."""
    num_views: int = 20
    """Frames that ``camera="projective"`` starts with, spread over the recording: more take longer."""
    max_jump: float = 2.0
    """Seconds that a clock may jump by where frames were lost or doubled (``breaks``): more take longer."""
