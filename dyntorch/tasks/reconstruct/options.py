"""What a caller of ``reconstruct`` may ask for beside its arguments."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ReconstructOptions:
    """What a user can set in :func:`dyntorch.reconstruct`."""

    min_inlier_share: float = 0.4
    """Share of the points that must agree where tracks are wrong: .5 and more found 60 to 70 % outliers right in 3 of 28 scenes,
    wrong in 2."""
    max_search_rounds: int = 12
    """Rounds of random starts among wrong tracks, each as long as the first; 1 takes no random numbers."""
    max_uncertainty: float = 0.3
    """Expected error of the points over the size of the scene above which the status is AMBIGUOUS; true errors are about half."""
