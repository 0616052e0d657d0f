"""What decides in robust_fit() and refine(): every number, by its name, with its unit and what was measured for it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class RefineOptions:
    """When gradients of a refinement are not those of a minimum: both must hold."""

    unfinished_decrease: float = 1e-6
    """Share of the cost that the next step would still take.  Homography tensors (60 matches) after 1, 2, 3 and 30 steps: at 0.5 px
    2e-5, 9e-9, 7e-12, 6e-15, with gradients off by 1e-4, 1e-6, 2e-8, 0; at 3 px 5e-4, 5e-6, 1e-7, 2e-11 and 5e-3, 2e-4, 2e-5, 0."""
    unfinished_length: float = 1e-6
    """Length of that step, of parameters of norm 1: of exact matches the cost is all rounding."""


@dataclass(frozen=True)
class RobustStartOptions:
    """Which matches are searched among, and which weightings of them the search starts from."""

    searched: int = 1000
    """Matches among which is searched, at least 10 for every column; of more, a random part (all are used for the final fit)."""
    gross: float = 5.0
    """Distance from the median of the matches, over the median distance, beyond which one has no say in the normalization."""
    smallest_samples: int = 8
    """Largest minimal sample for which samples of that size are drawn; other starts take 2.5 times the minimal number."""
    drawn: int = 32
    """Minimal samples per start: the best of them are near already."""
    drawn_per_annealed: int = 4
    """Starts per minimal sample that is annealed."""
    scale_starts: int = 16
    """Random starts of the estimate of the threshold, beside that from all matches."""


@dataclass(frozen=True)
class AnnealingOptions:
    """Reweighted fits whose scale shrinks to the threshold."""

    from_all: int = 30
    """Reweightings of the start from all matches."""
    from_many: int = 20
    """Reweightings of a start from 2.5 times the minimal number."""
    guided: int = 60
    """Reweightings of such a start with a motion as guide."""
    from_minimal: int = 10
    """Reweightings of a start from a minimal sample."""
    unguided: int = 4
    """One start of so many is not guided by a motion.  Successes per start, not guided and guided: homography tensor (100 matches,
    50 % outliers) 0.48 and 0.70, translating lines (175, 30 %) 0.01 and 0.20, constant velocity tensor (150, 35 %) 0.53 and 0.52,
    but in one scene of eight 0.9 and 0."""
    shrinking: float = 0.7
    """Share of the reweightings during which the scale shrinks."""
    concentrations: int = 5
    """Refits to the matches within the threshold, or to the nearer half, at the end."""
    scale_steps: int = 20
    """Reweightings in the estimate of the threshold, with a motion as guide: hard halves alone are 40 to 70 times off for lines
    (175, 20 % outliers), this 0.6 to 1.6 times."""
    inverse_iterations: int = 2
    """Inverse iterations per reweighting: the weights change more than what is left of the null vector's error."""


@dataclass(frozen=True)
class DoubtOptions:
    """When the search ends, and whether what it found beats chance."""

    mixed: int = 4
    """Random sets of matches, made by mixing up the views, on which the chance of an inlier is measured."""
    just_beyond: float = 0.15
    """Matches between one and three thresholds away, per inlier, above which the search goes on: a wrong model has many (constant
    velocity tensors, 20 % outliers: wrong 0.7 and more, right 0.03 at most; right homography tensors reach 0.15 at 60 %)."""
    many: int = 16
    """Starts from which on these decide when to stop where there is doubt."""
    agreeing: float = 0.25
    """Share of such starts that must end at the best score so far: whatever attracts one start in five, and is better, is then
    missed once in thirty times."""
    same: float = 0.01
    """Relative difference, and weight of matches, up to which two scores are the same."""


@dataclass(frozen=True)
class RobustFinishOptions:
    """The choice of the inliers, and the refinement on them, in turns."""

    steps: tuple[int, ...] = (3, 8)
    """Steps of refinement after each choice of the inliers."""
    threshold_updates: int = 4
    """Updates of an estimated threshold per choice."""
    wide: float = 1.5
    """Distance over the threshold up to which it counts when the threshold is estimated: cut at the threshold itself the noise
    comes out 14 % too small (homography tensors, 200 matches, no outliers)."""


@dataclass(frozen=True)
class RobustOptions:
    """Every number that decides in :func:`dyntorch.robust_fit`, by stage."""

    starts: RobustStartOptions = RobustStartOptions()
    annealing: AnnealingOptions = AnnealingOptions()
    doubt: DoubtOptions = DoubtOptions()
    finish: RobustFinishOptions = RobustFinishOptions()
