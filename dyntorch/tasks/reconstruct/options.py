"""What decides in reconstruct(): every number of its stages, by its name, with its unit and what was measured for it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class TimeOptions:
    """Which times of the views are taken."""

    rounded: float = 1e-3
    """Rounding of the times, over the spacing of the views, that is too much."""
    frame: float = 1 / 16
    """Rounding below which whole numbers are frames, exact, rather than rounded."""
    far: tuple[float, float] = (1e4, 1e9)
    """Distance of the times from 0 over their span from which the points at time 0 are noise: of float32 tracks, of float64."""


@dataclass(frozen=True)
class ProjectionOptions:
    """The start from the tensor: cameras of the lifted space."""

    subsets: int = 6
    """Choices of views for the tensor, where there are more than it takes; the one of least error in all views wins."""
    looked_at: int = 60
    """Choices of which the most seen and best spread ones are taken."""
    constrained_steps: int = 3
    """Steps of the constrained fit at most; it starts the structured adjustment: of 20 scenes of constant velocity, 4 views of 60
    points at 0.5 px, 18 reach its minimum that way in 7 ms each, and 18 in 31 ms with 30 steps, 10 steps and 1e-9 in place of these
    three; below P^6 all do."""
    free_steps: int = 3
    """Steps of free bundle adjustment at most."""
    free_tolerance: float = 1e-2
    """Relative gain of a step with which free bundle adjustment ends."""


@dataclass(frozen=True)
class SceneOptions:
    """The scene of least squares, from several starts."""

    rest: float = 1e-8
    """Share of the lifts below which constants of a point do not change its position."""
    rest_views: int = 4
    """Views of the tensor of the scene at rest."""
    windows: tuple[int, int] = (6, 5)
    """Views that are taken at once, in turn; of 30 scenes of constant velocity, 8, 9 and 12 views with gaps of 20 to 25 %, most
    with too few points common to any four views, 28 are found and 2 given up."""
    tilt: float = 0.25
    """Standard deviation of the hyperplane at infinity of further frames, for points of unit variance."""
    steps: int = 60
    """Steps of structured bundle adjustment at most."""
    tolerance: float = 1e-7
    """Relative gain of a step with which it ends."""
    several: int = 7
    """Size K of the space of the constants from which on one start is not enough; of 20 scenes, 4 views of 60 points, the start
    from the tensor misses the minimum in 5 (constant velocity, 0.5 px) and 20 (weak constant acceleration in a plane, 1 px), that
    of the scene at rest in 1 and 0, and both together in none; below P^6 the first reaches it in all."""
    spare: int = 6
    """Spare coordinates per point beyond which the start from the tensor is enough in those spaces as well: of 20 scenes it misses
    the minimum in up to 18 with 5 views and 1 with 6, in none with 7, 8 and 12."""
    frames: int = 3
    """Starts from the scene at rest next to that from the tensor, at most."""
    frames_alone: int = 6
    """Starts from the scene at rest without one from the tensor, at most."""
    behind: float = 0.05
    """Share of points behind cameras from which on a scene is not believed: wrong minima have a tenth to a half of them there."""
    same: float = 1e-2
    """Relative difference of the costs of the same minimum."""
    exact: float = 1e-22
    """Difference of costs that is only rounding, per observation."""
    final_steps: int = 60
    """Steps of bundle adjustment of two bodies."""


@dataclass(frozen=True)
class NoiseOptions:
    """The noise, and which points agree with projections."""

    share: float = 0.997
    """Share of the inliers that agree: what three standard deviations are for one coordinate."""
    spare: int = 2
    """Equations that must remain to confirm a point that has lost a view: with fewer, wrong ones confirm each other."""
    triangulation_steps: int = 2
    """Steps of triangulation."""
    wide: float = 1.5
    """Distance over the threshold up to which it counts when the noise is estimated."""
    rounds: int = 4
    """Rounds of that estimate."""
    correction: float = 2.0
    """Largest correction of the variance for the degrees of freedom of the projections."""
    least: float = 1e-8
    """Least noise, over the extent of the image."""


@dataclass(frozen=True)
class ConcentrationOptions:
    """Starts of the search for projections among outliers, by concentration on the points that fit best."""

    shares: tuple[float, ...] = (0.5, 0.6, 0.7, 0.8)
    """Parts of the points that the starts keep: the smaller the fewer outliers, the larger the better the fit to them."""
    drawn: float = 0.5
    """Share of that part that a start is drawn of."""
    least_kept: float = 1.3
    """Points kept over the minimal number, at least."""
    least_drawn: float = 1.15
    """Points drawn over the minimal number, at least."""
    concentrations: int = 3
    """Fits per start, each to the points nearest to the one before."""
    rounds: int = 12
    """Rounds of starts at most."""
    adjustment_steps: int = 10
    """Steps of bundle adjustment per fit: what makes the distances tell the outliers (without it half of them stay)."""
    doubt: float = 0.15
    """Points one to three thresholds away, per inlier, above which the search goes on: a wrong model has many."""
    majority: float = 0.4
    """Share of inliers among the points at least: more than half of them found 60 to 70 % outliers right in 3 of 28 scenes, wrong
    in 2."""
    redundant: float = 1.25
    """Conditions of the inliers over the degrees of freedom of the projections, at least."""
    confirmed: int = 3
    """Rounds without a better find after which the search ends where a find does not speak for itself: few points agree with wrong
    projections, too."""
    better: float = 0.97
    """Cost over that of the best find below which a find is better."""
    sure: float = 4.0
    """Conditions over the degrees of freedom of the projections from which on a find with known noise speaks for itself."""
    tried: int = 4
    """Rounds after which a search may end as hopeless."""
    hopeless: float = 0.3
    """Noise over the extent of the images that the best find leaves then: random and shuffled tracks leave 0.45 to 0.7 (120 points
    in 6 views, 6 models), scenes with 40 and 50 % wrong tracks that end well 0.17 at most."""


@dataclass(frozen=True)
class OutlierOptions:
    """Whether there are outliers, and the fit without them."""

    alarms: float = 0.05
    """Share of the problems without outliers that are suspected, by their farthest point, where few conditions are left for every
    unknown of the cameras."""
    rare_alarms: float = 1e-4
    """The same where there are plenty."""
    plenty: float = 6.0
    """Conditions per unknown of the projections from which on one outlier cannot hide; of 200 scenes of constant velocity in a
    plane with one outlier among 30, 60 and 100 points the rare alarm misses 40, 3.5, 0.5 %, the other one 12, 0.5, 0 % (space, 60,
    100 and 200 points: 60, 28 and 8 %, 28, 8 and 0 %); a false alarm costs the time of a robust search, fifty times that of a clean
    batch."""
    loud: float = 0.01
    """Noise over the extent of the images from which on even residuals without extremes are looked into: where a fifth of the
    tracks are altogether wrong, least squares spreads the misfit over all."""
    trusted: float = 0.7
    """Share of the observations that agree from which on no more is asked: wrong ones may be spread over most of the tracks."""
    trims: int = 2
    """Times that observations are taken from the least squares scene."""
    least_left: float = 0.9
    """Share of the observations that has to stay then."""
    wrong: float = 2.0
    """Threshold of points said to stand still, over that of the others, above which they move."""
    tolerant: int = 4
    """Coordinates of a point beyond its unknowns that make an accidental agreement of most observations impossible."""
    widths: tuple[float, ...] = (6.0, 3.0, 1.5, 1.0, 1.0)
    """Thresholds over the final one, while all views settle."""
    resections: int = 10
    """Reweightings of the views that the tensor does not see."""
    adjustment_steps: int = 10
    """Steps of bundle adjustment after each choice of the observations."""


@dataclass(frozen=True)
class MotionModelOptions:
    """Which points stand still, and which motion model is taken where none is asked for."""

    corrections: int = 4
    """Times that points said to stand still are looked at."""
    exact: float = 1e-18
    """Square of the noise, over that of the extent of the image, that exact data are taken to have."""
    outlier: float = 2.0
    """Cost of a coordinate too many that does not fit, in variances of the noise: Torr's lambda 3."""
    label: float = 0.2
    """Cost of the label of a point of two bodies, which is free to take the better one; 4 views of 80 points: 0 takes two bodies
    for one plane once in 5 scenes (by 5), log 2 = 0.7 takes a static scene for two planes (by 30)."""
    agreed: float = 0.6
    """Share of observations that have to fit a model before the noise is taken from it."""
    similar: float = 1.8
    """Noise over the least that any model leaves, up to which a model fits: a model with too many unknowns may leave 0.6 times the
    noise that is there (constant_velocity_3d of points moving along one direction in a plane, 4 views of 80 points)."""
    mild: float = 1.1
    """Noise that least squares leaves, over that of the robust fit, up to which the models are not all fitted robustly: single
    false outliers among 720 observations raise it by .5 %, one of 100 px by 800 %."""
    clear: float = 0.02
    """Noise over the extent of the images up to which that holds: much noise may hide outliers, and a failed fit says nothing."""
    floor: float = 1e-9
    """Least noise over the extent of the images: rounding."""


@dataclass(frozen=True)
class DiagnosisOptions:
    """How well the scene is determined, and what deserves a notice."""

    rounding: float = 1e-10
    """Eigenvalue of the information on the cameras, over the largest, that rounding leaves of a zero; sound scenes of 60 points:
    3e-6 to 0.1, the gauge itself: up to 1e-11."""
    uncertain: float = 0.1
    """Expected error of the points over the size of the scene above which smaller models are tried, and a notice given; 80 points
    at 0.5 px, 10 scenes each: 0.001 to 0.14 (constant_velocity_3d before 4 views), true errors about half of that; 0.2 to 13 with a
    camera that stands still or moves at constant velocity, where the true errors are 0.3 to 1."""
    unknown: float = 0.3
    """The same above which the result is one of many."""
    explained: float = 1.25
    """Noise that a smaller model leaves over that of the model, up to which it explains the tracks as well."""
    exact: float = 1e-7
    """Noise over the extent of the images that counts as none."""
    weak_stack: float = 3e-3
    """Least singular value of the stacked projections over the largest that deserves a notice: 0.015 to 0.8 in sound scenes at 0.5
    px, below 0.005 with a fixed camera."""
    noisy_stack: float = 0.3
    """Noise over that singular value that deserves a notice: up to 0.1 in sound scenes at 0.5 px, above 0.3 with a fixed camera."""
    asked: int = 20
    """Points whose median uncertainty is taken, about."""
    thin: float = 3.0
    """Standard deviations of the noise across a line of images below which they may as well lie on it."""


@dataclass(frozen=True)
class MetricOptions:
    """The metric frame that known calibrations give."""

    steps: int = 40
    """Steps of each descent on the conditions that cameras are rotations."""
    tilts: tuple[float, ...] = (0.6, 1.15)
    """Angles, radians, between the normal of a plane and the first camera's axis, next to 0, that are started from."""
    around: int = 6
    """Normals around the axis at each of these angles."""
    draws: int = 7
    """Planes at infinity, drawn around that of the frame that is given, that are started from."""
    spread: float = 0.5
    """Size of these draws over that of the change of frame."""
    mixtures: int = 8
    """Mixtures of the two best solutions for the quadric that are started from: two views leave two."""
    turns: int = 20
    """Turns of alternation between a factor of the quadric and the changes that the motion allows."""
    ridge: float = 1e-3
    """Weight, over that of the conditions of the first camera, with which a start stays where the frame is."""
    as_good: float = 4.0
    """Cost over the least up to which a frame does as well."""
    exact: float = 1e-16
    """Cost that is rounding."""
    as_visible: float = 0.02
    """Share of points behind cameras beyond the least up to which a frame shows them as well."""
    other: float = 0.03
    """Relative difference of the metrics of two frames, where the points have unit variance, that makes them two."""
    family: float = 1e-5
    """Singular value of the conditions over the largest below which a family of frames is metric."""
    uncertain: float = 0.5
    """Expected error of the entries of the metric, before adjustment, from which on there is a notice; after it the points of 60
    tracks at 0.5 px, in 3 to 7 views of 11 motions, are wrong by 0.1 to 0.4 % where it is below, by up to 10 % above."""
    misfit: float = 1.5
    """Noise of the scene with calibrated cameras over that without from which on the calibration is doubted."""
    refused: float = 5.0
    """The same from which on the scene stays as it is without calibration: K is wrong, or the adjustment found no way."""
    adjustment_steps: int = 60
    """Steps of bundle adjustment with calibrated cameras at most."""


@dataclass(frozen=True)
class ReconstructOptions:
    """Every number that decides in :func:`dyntorch.reconstruct`, by stage."""

    times: TimeOptions = TimeOptions()
    projections: ProjectionOptions = ProjectionOptions()
    scene: SceneOptions = SceneOptions()
    noise: NoiseOptions = NoiseOptions()
    starts: ConcentrationOptions = ConcentrationOptions()
    outliers: OutlierOptions = OutlierOptions()
    models: MotionModelOptions = MotionModelOptions()
    diagnosis: DiagnosisOptions = DiagnosisOptions()
    metric: MetricOptions = MetricOptions()
