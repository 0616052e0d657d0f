"""What decides in fit_distortion(): every number, by its name, with its unit and what was measured for it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LensOptions:
    """Every number that decides in :func:`dyntorch.geometry.fit_distortion`."""

    starts: tuple[tuple[float, float], ...] = ((0.0, 0.0), (-0.15, -0.15), (-0.4, -0.4), (-0.3, 0.0), (0.0, -0.3))
    """Strengths of distortion (lambda) of both lenses that the descent starts from; the first is that of no lenses."""
    start_rounds: int = 4
    """Reweighted fits of the fundamental matrix of each start."""
    matches: int = 1500
    """Matches that are used: lambda is known to 1e-3 long before."""
    start_matches: int = 300
    """Matches that choose among the starts."""
    fewest: int = 40
    """Matches below which nothing is said of lenses."""
    cap: float = 9.0
    """Squared distance, over the squared scale, up to which it counts."""
    folds: int = 4
    """Parts of the matches, each of which lenses fitted to the others must explain better than no lenses do."""
    significant: float = 12.0
    """F ratio of 2 and n - 9 degrees of freedom from which on distortion is there: 1e-5 of ideal cameras with independent errors
    exceed it, and the held-out parts guard against the others."""
