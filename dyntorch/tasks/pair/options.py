"""What decides in reconstruct_pair(): every number of its stages, by its name, with its unit and what was measured for it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ResamplingOptions:
    """Positions between the frames of a camera."""

    orders: tuple[int, ...] = (6, 4, 2)
    """Frames around a moment that one position is interpolated from: as many as are seen of these.  At half a frame six multiply
    the variance of white noise by .71, two by .5, but two also lose what moves within a tenth of the frame rate."""
    rounding: float = 1e-6
    """Part of a frame by which a moment may be outside of the overlap: rounding."""
    gap: float = 2.5
    """Distance of two neighbouring frames, in frame intervals, from which on nothing is interpolated between them."""


@dataclass(frozen=True)
class CorrespondingOptions:
    """Points that correspond: one fundamental matrix for the whole take."""

    sampled: int = 4000
    """Positions that the fundamental matrix is searched from, about; its accuracy is then that of the noise's correlations."""
    fewest: int = 12
    """Positions in both cameras: with fewer, agreement with some fundamental matrix is no evidence."""
    sigmas: float = 2.6
    """Sampson distance up to which a position agrees, in estimated standard deviations of a coordinate."""
    triangulation_steps: int = 3
    """Gauss-Newton steps of the triangulation: the reprojection error no longer falls."""


@dataclass(frozen=True)
class PairInputOptions:
    """What is too little to say anything."""

    shortest: int = 12
    """Frames in common: fewer are explained by any tracks."""
    spare_frames: int = 6
    """Frames in common that must be there beyond the number of points of either camera: fewer are explained by any tracks."""
    fewest_points: int = 2
    """Points of a camera."""
    seen: float = 0.5
    """Share of the frames in which a track must be seen; more gaps are guessed, not interpolated."""
    still: float = 3.0
    """Motion across a line, over the noise, up to which nothing moves but along it."""
    exact: float = 1e-7
    """Motion, over the extent of the points, that is rounding."""


@dataclass(frozen=True)
class MotionPriorOptions:
    """What tracks of one camera say of themselves: which of it is motion."""

    rounds: int = 20
    """Rounds of expectation maximization for the covariance of the points; more change the estimates of a noise of 1 % by less than
    a hundredth of it."""
    fill_rounds: int = 30
    """Rounds of filling gaps: each leaves about the share of the positions that are missing of the error."""
    faint: float = 1e-6
    """Least motion of any frequency, over the noise's variance, and least noise in gaps, over the motion's: all stays finite."""


@dataclass(frozen=True)
class RidgeOptions:
    """The regression of one camera's coordinates on the other's."""

    least: float = 1e-22
    """Smallest ridge tried, over the largest eigenvalue of the Gram."""
    steps: int = 72
    """Ridges tried from there to 1."""
    firmness: float = 10.0
    """Weight of the row of sums, over the root of the sum of the squared singular values."""
    stretches: int = 5
    """Stretches of time that are predicted from the others."""


@dataclass(frozen=True)
class DirectionOptions:
    """The common direction of both cameras."""

    grid: int = 36
    """Directions of each camera that are tried: information changes little over 5 degrees."""
    starts: int = 3
    """Peaks that are refined."""
    noise_floor: float = 0.1
    """Share of the noise's variance added to all covariances, which already hold the noise itself.  Errors of the directions, CMU
    joints, median of 16 at 1, 3 mm: 0.46, 1.6 degrees for .1; 0.83, 2.1 for 1; 1.4, 9.3 for 10."""
    coarse: float = 3e-3
    """Step to which all peaks are refined, radians; the best one then to the finest."""
    finest: float = 1e-10
    """Step at which the refinement ends, radians."""
    shrinkage: float = 0.4
    """Factor of the step where no neighbour is better."""
    least_gain: float = 1e-3
    """Gain of log likelihood below which noise decides."""


@dataclass(frozen=True)
class ExplanationOptions:
    """Which points the other camera explains, and whether it would explain anything."""

    rounds: int = 8
    """Rounds of leaving out points that the other camera does not explain."""
    sure: float = 0.99
    """Share of the motion that must be predicted of a point that is missed by an unusual distance."""
    unusual: float = 4.0
    """Distance, over the usual one, by which a prediction must miss a point for it to be unusual."""
    missed: float = 3.0
    """What a prediction misses, over the noise, up to which it speaks against no point: it hardly moves across the epipolar
    lines."""
    draws: int = 5
    """Unrelated motions, of the same spectrum in time and joint covariance of the points, that the cameras are compared with."""
    beyond: float = 1.0
    """Ranges of the likelihoods of unrelated motions that the one found must be above the highest of them.  Two views of one scene:
    2 to 16 (3 px of noise and less, 60 frames and more); 4 points over 40 frames at 1 px: 0.6 and 1.8.  Of 12 pairs of unrelated
    bodies that wander for 4 s, all of which explain each other, one is above 1."""


@dataclass(frozen=True)
class PlaceOptions:
    """Whether the mean places of the points follow from their motions."""

    affine: float = 3.0
    """Factor of the residual variance that the mean places may cost before they are taken for free."""
    rounding: float = 1e-11
    """Residual, over the power of the motion, that says nothing."""


@dataclass(frozen=True)
class TrackMatchOptions:
    """Which track of one camera is which of the other, once both are in one frame."""

    ambiguous: float = 0.5
    """Distance, over that to the second nearest track, above which the nearest one is not taken."""
    same: float = 4.0
    """Difference of one point seen twice along the coordinate that both cameras see, over the residual."""
    near: float = 12.0
    """Its difference in all, over the residual: transfer amplifies noise three to five times."""
    same_of_extent: float = 0.005
    """The first difference over the extent of the points, where that is more: mean places are known less well than motions."""
    near_of_extent: float = 0.03
    """The second one over the extent of the points, where that is more."""


@dataclass(frozen=True)
class PairOptions:
    """Every number that decides in :func:`dyntorch.reconstruct_pair`, by stage."""

    resampling: ResamplingOptions = ResamplingOptions()
    corresponding: CorrespondingOptions = CorrespondingOptions()
    input: PairInputOptions = PairInputOptions()
    prior: MotionPriorOptions = MotionPriorOptions()
    ridge: RidgeOptions = RidgeOptions()
    directions: DirectionOptions = DirectionOptions()
    explanation: ExplanationOptions = ExplanationOptions()
    places: PlaceOptions = PlaceOptions()
    matching: TrackMatchOptions = TrackMatchOptions()
