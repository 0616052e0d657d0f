"""What a user can set in synchronize() of recordings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from dyntorch import SynchronizeOptions

Measure = Literal["profile", "window"]
"""What of the brightness is compared: the row-band profile, which the window kernel must confirm, or the window kernel alone."""
MEASURES = ("profile", "window")


@dataclass(frozen=True)
class SyncOptions:
    """What is known of the recordings, and what is paid, in :func:`indexing.synchronize`."""

    min_frames: int = 12
    """Frames of keypoints at least."""
    min_margin: float = 0.2
    """Risk of a wrong period: nats by which the best offset of corresponding keypoints must lead (see
    :class:`dyntorch.SynchronizeOptions`)."""
    num_candidates: int = 3
    """People of a camera that are tried, besides the largest one of each frame: all pairings are compared."""

    @property
    def of_points(self) -> SynchronizeOptions:
        """Those of :func:`dyntorch.synchronize`, for keypoints and tracks."""
        return SynchronizeOptions(min_frames=self.min_frames, min_margin=self.min_margin)
