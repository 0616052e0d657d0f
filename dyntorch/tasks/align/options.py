"""What decides in align_planar(), align_points() and align_lines(): every number, by its name, with its unit and measurement."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class AlignLabelOptions:
    """Labels and least squares in turns."""

    threshold_in_sigmas: float = 3.0
    """The threshold in standard deviations of the noise of one coordinate."""
    rounds: int = 3
    """Turns of labelling and refining with the noise known."""
    rounds_with_noise: int = 6
    """Turns with the noise to be found as well."""
    rough: float = 3.0
    """Width of the first labels, over that of the noise, where the motion comes from a minimal sample."""
    steady: float = 0.02
    """Relative change of the noise that needs no further turn."""
    widest: float = 4.0
    """Factor by which the uncertainty of the motion widens a limit at most: calling a static match moving costs some accuracy,
    calling a moving one static gives a wrong motion."""
    steps: int = 6
    """Levenberg-Marquardt steps between two labellings."""
    judges: int = 256
    """Matches that judge a hypothesis: enough to tell 5 % of agreement from none."""


@dataclass(frozen=True)
class AlignSeveralOptions:
    """More than three views: the collineation of each further view from the lines that three views show."""

    samples: int = 256
    """Samples of matches per view."""
    sample: int = 10
    """Matches of a sample; 8 determine a collineation of the plane or of space.  Of 256 samples 99.9 % draw a clean one at 30 %
    wrong points in that view."""
    rounds: int = 4
    """Reweighted fits to all matches after that."""


@dataclass(frozen=True)
class AlignPlanarOptions:
    """A plane in three views."""

    rank: float = 1e-9
    """Singular value of the estimation matrix, over the largest, that rounding alone leaves."""
    near_static: float = 2.0
    """Strength of the weakest equation of the tensor below which a notice is given: 0.4 to 0.7 where all stands still, 1.3 to 1.6
    where points move by 1 to 5 pixels at 0.5 pixels of noise, 15 to 25 where they move by 25 to 80 (100 matches)."""
    undecided: float = 1.2
    """The same, corrected for the matches that 26 equations use up, below which moving matches alone leave a family of motions: 0.7
    to 0.9 where all make equal steps (80 matches), 0.5 where all stands still; at 3 px of motion at changing speed on either
    side."""
    support: int = 10
    """Static matches that settle such a family; a motion of the family that is off makes 0 to 6 of 80 matches static at steps of 10
    to 40 px, and up to 16 at 3 px, where 3 to 5 are expected."""
    chance: float = 3.0
    """Static matches that settle it for each that is expected by chance, besides."""
    wider: float = 3.0
    """Times the limit of static matches within which those that are static by chance spread evenly, over a plane of velocities."""
    thin: float = 3.0
    """Standard deviations of the noise across a line of points, below which they may as well lie on it."""
    room: float = 3.0
    """Standard deviations of the noise within which a match belongs to a trajectory line."""
    samples: int = 1000
    """Samples of four matches: 96 % to draw four static ones where they are 24 % of all (30 % static, 20 % outliers)."""
    steps: int = 30
    """Steps of the final refinement at most."""
    indeterminate: float = 1e-13
    """Information on the worst direction of the motion over that on the best, below which it is rounding error."""
    ambiguous: float = 0.5
    """Standard deviation of the worst direction of the motion, of norm 1, above which the motion is not known at all."""
    singular: float = 1e-3
    """Ratio of the singular values of a homography in normalized coordinates (usually above 0.1) that no camera gives a plane."""
    consensus: float = 0.4
    """Share of inliers below which the best motion may be an accident."""
    uniform: float = 1.3
    """Noise that the inliers show over the assumed noise, above which they fill the limits evenly as random matches do (1.7)."""
    doubtful: float = 0.7
    """Share of inliers below which that is an accident."""
    spare: int = 8
    """Conditions beyond the 16 degrees of freedom that inliers must fulfil: a minimal set fulfils 16 whatever it is."""


@dataclass(frozen=True)
class AlignMetricOptions:
    """The motion of calibrated cameras above a plane."""

    steps: int = 30
    """Steps of each descent on the normal of the plane."""
    floor: float = 1e-9
    """Relative deviation from equal lengths that is rounding: homographies of pixels lose 6 of 16 digits."""
    as_good: float = 9.0
    """Chi-square beyond the least up to which a plane explains the homographies as well: three standard deviations."""
    as_visible: float = 0.02
    """Share of points behind cameras beyond the least up to which a plane shows them as well."""
    other: float = 0.03
    """Angle between two normals, radians, from which on they are two."""
    deviations: float = 3.0
    """And besides so many standard deviations."""
    undetermined: float = 0.3
    """Standard deviation of the normal, radians, from which on it is not known: a camera that only turns leaves 1 and more."""
    misfit: float = 5.0
    """Chi-square over its quantile of three standard deviations from which on the calibration is doubted."""
    small: float = 0.003
    """Relative deviation from equal lengths that a calibration to two or three digits leaves."""


@dataclass(frozen=True)
class AlignJoinOptions:
    """Points in space before projective sensors: the join tensors."""

    full: int = 60
    """Matches from which on the join tensor itself joins the starts."""
    samples: int = 1000
    """Samples of five matches: 97 % to draw five static ones where they are 20 % of all."""
    steps: int = 30
    """Steps of the final refinement at most."""
    indeterminate: float = 1e-13
    """Information on the worst direction of the motion over that on the best, below which it is rounding error."""
    ambiguous: float = 0.5
    """Standard deviation of the worst direction of the motion, of norm 1, above which the motion is not known at all."""
    uncertain: float = 0.05
    """The same from which on a notice is given."""
    consensus: float = 0.4
    """Share of inliers below which the best motion may be an accident."""
    spare: int = 10
    """Conditions beyond the degrees of freedom that inliers must fulfil."""
    room: float = 3.0
    """Standard deviations of the noise within which a match belongs to a trajectory line."""


@dataclass(frozen=True)
class AlignVelocityOptions:
    """Points at constant velocity before projective or affine sensors."""

    rounds: int = 4
    """Turns of labelling and least squares."""
    seeds: int = 64
    """Velocities tried as the common one: of 10 % static matches six or seven are among them."""
    standing: float = 0.1
    """Least share of the inliers that must have one velocity before they are taken for the static background (and at least 3)."""
    samples: int = 150
    """Affine samples: 40 % outliers leave 1.7 % of samples of eight clean, 92 % to draw one."""
    sample: int = 8
    """Matches of a sample, one above the minimum."""
    held: float = 1e-9
    """Eigenvalue over the largest up to which a sample is degenerate: 3e-5 of the size of the data, far below any real noise."""
    indeterminate: float = 1e-13
    """Information on the worst direction of the maps over that on the best, below which it is rounding error."""
    ambiguous: float = 0.5
    """Standard deviation of the worst direction of the maps, of norm 1, above which they are not known at all."""
    uncertain: float = 0.05
    """The same from which on a notice is given."""
    consensus: float = 0.4
    """Share of inliers below which the best motion may be an accident."""
    spare: int = 6
    """Conditions beyond the degrees of freedom that inliers must fulfil."""
    problems: int = 8
    """Problems of a batch that are sampled together."""
    above: float = 3.0
    """Singular value of the estimation matrix over the noise from which on it counts."""


@dataclass(frozen=True)
class AlignRigidOptions:
    """Points before rigid sensors."""

    static_starts: int = 60
    """Samples of 3 matches taken as static: 40 % static points without outliers are met by 98 % of 60 such samples."""
    moving_starts: int = 60
    """Samples of matches taken as moving."""
    finalists: int = 5
    """Starts of least cost that are refined to the end."""
    rounds: int = 4
    """Turns of labelling and least squares."""
    problems: int = 16
    """Problems of a batch that are solved together."""
    seeds: int = 512
    """Velocities tried as the common one."""
    standing: float = 0.1
    """Least share of the matches that must have one velocity before they are taken for the static background (and at least 3)."""
    indeterminate: float = 1e-10
    """Information on the worst direction over that on the best, below which it is rounding error."""
    ambiguous: float = 0.3
    """Standard deviation of the worst direction, in radians or sizes of the scene, above which the motion is not known at all."""
    uncertain: float = 0.05
    """The same from which on a notice is given: 3 degrees."""
    consensus: float = 0.4
    """Share of inliers below which the best motion may be an accident."""
    spare: int = 4
    """Conditions beyond the degrees of freedom that inliers must fulfil: a minimal set fulfils those whatever it is."""


@dataclass(frozen=True)
class AlignLinesOptions:
    """Lines in two views of a 3D sensor."""

    rounds: int = 4
    """Turns of labelling and least squares."""
    certain: int = 45
    """Lines (three times the degrees of freedom) below which noise of unknown size cannot be told from outliers."""
    above: float = 2.0
    """Singular value of the estimation matrix over the noise from which on it counts: those that the model lacks reach 1.7, those
    of 45 lines in general position at a noise of a two-hundredth of the scene begin at 2.4."""
    ambiguous: float = 0.5
    """Standard deviation of the worst direction of A, of norm 1, above which it is not known at all."""
    uncertain: float = 0.05
    """The same from which on a notice is given."""
    indeterminate: float = 1e-13
    """Information on the worst direction over that on the best, below which it is rounding error."""
    agreed: float = 0.65
    """Share of lines that agree with the robust start below which a start from static lines is tried: wrong ones reach .54."""
    samples: int = 2000
    """Samples of five lines that may stand still: eight of them are clean where a third of the lines is static."""
    loose: float = 4.0
    """Times the threshold within which a line agrees with such a sample, whose noise is that of five lines."""
    starts: int = 4
    """Weakest directions of the matrix from which, and from between which, another motion is looked for where its rank is short."""
    rival: float = 1.3
    """Squared error over the least from which on another motion is no explanation: of 90 lines of one body with two static points,
    noise .001, the others reach .9 to 1.2."""
    consensus: float = 0.4
    """Share of inliers below which the best motion may be an accident."""
    spare: int = 6
    """Conditions beyond the degrees of freedom that inliers must fulfil."""


@dataclass(frozen=True)
class AlignOptions:
    """Every number that decides in :func:`dyntorch.align_planar`, :func:`dyntorch.align_points` and :func:`dyntorch.align_lines`,
    by stage and model."""

    labels: AlignLabelOptions = AlignLabelOptions()
    several: AlignSeveralOptions = AlignSeveralOptions()
    planar: AlignPlanarOptions = AlignPlanarOptions()
    metric: AlignMetricOptions = AlignMetricOptions()
    join: AlignJoinOptions = AlignJoinOptions()
    velocity: AlignVelocityOptions = AlignVelocityOptions()
    rigid: AlignRigidOptions = AlignRigidOptions()
    lines: AlignLinesOptions = AlignLinesOptions()
