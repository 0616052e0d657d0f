"""What decides in translating_planes(): every number of its stages, by its name, with its unit and what was measured for it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PlaneFrameOptions:
    """Coordinates of order 1, in which all is computed, where there are no matches to take them from."""

    singular: float = 1e-8
    """Ratio of the singular values of a homography, in coordinates of order 1, below which it maps its plane to a line."""
    extent: float = 2.0
    """Focal lengths per half image.  The error of H alone at 1 is 1.3 times as large, at 3 the same."""
    centres: tuple[tuple[float, float], ...] = ((0.0, 0.0), (0.5, 0.4))
    """Where the middle of the image may be, in focal lengths: at the origin, or where pixels are counted from a corner.  With its
    estimate from the homographies instead, the error of the homography at infinity is 1.1 to 1.4 times as large (0.5 px)."""
    shortest_focal: float = -1.0
    """Least focal length that is tried, its decimal logarithm."""
    longest_focal: float = 4.5
    """Largest focal length that is tried, its decimal logarithm."""
    focals: int = 56
    """Focal lengths that are tried."""


@dataclass(frozen=True)
class PlaneStartOptions:
    """Closed forms that the fit starts from."""

    beam: int = 243
    """Choices of scales that are kept while planes are added: all of up to six planes."""
    choices: int = 4
    """Choices of scales that are solved to the end."""
    static_planes: int = 5
    """Planes up to which each is tried as if it stood still.  That raises the share of problems of 4 planes at 0.5 px that reach
    the best minimum from 90 to 98 %; with 8 planes 97 % reach it without."""
    reweightings: int = 1
    """Reweightings of the planes beside a known fundamental matrix, by how well their lines are known.  Errors 0.01 of the entries
    of H and 0.001 of F, 300 scenes each with 2, 3, 5 planes: median error .0116, .0097, .0079 without, .0109, .0084, .0069 with
    one, and the same with three."""


@dataclass(frozen=True)
class PlaneFitOptions:
    """Least squares on the matrices, then on the matches."""

    steps_on_matrices: int = 40
    """Steps on the matrices, at most."""
    steps_on_matches: int = 100
    """Steps on the matches, at most.  With 60 the median error of 3 to 5 planes at 0.5 px is the same, that of 8 at 1 px 0.031
    instead of 0.027."""
    kept: int = 4
    """Results on the matrices, of different homographies at infinity, that are refined on the matches.  Of 4 planes at 0.5 px the
    best minimum is reached in 98 %; with 2 in 90 %."""
    same: float = 1e-6
    """One minus the cosine of homographies at infinity that are one solution."""
    body_weight: float = 100.0
    """Inverse variance of a fundamental matrix against that of a homography: a body with depth is seen larger than a plane's patch.
    Of 5 planes and 2 bodies at 0.5 px the error without matches is 0.0112; with 1 it is 0.0174, with 10 or 10000 0.012."""


@dataclass(frozen=True)
class PlaneAmbiguityOptions:
    """Whether another homography at infinity would do as well."""

    apart: float = 0.3
    """Sine of homographies at infinity that are two solutions: a camera that turns by 20 degrees moves them as far."""
    likely: float = 4.0
    """Difference of costs in noise variances up to which a solution is as likely as the best."""
    exact: float = 1e-20
    """Cost, over one and the least cost, that is rounding error."""
    underestimated: float = 0.1
    """Share of problems whose noise is underestimated.  With a quarter instead, 8 of 109 answers to 3 to 8 planes without matches
    at 0.5 px are off by more than 0.2 and three standard deviations; so 3 of 97."""
    open: float = 1e12
    """Variance of the homography at infinity over what it would be if all epipoles and planes were known, from which on it is open.
    Three planes: 1e3 to 1e9; with collinear epipoles and coplanar normals: 1e14 and more."""
    uncertain: float = 0.5
    """Expected relative error of the homography at infinity, in normalized coordinates, from which on nothing is known of it."""


@dataclass(frozen=True)
class PlaneDegeneracyOptions:
    """Whether planes and bodies are in special positions."""

    exact: float = 1e-7
    """Sine or ratio that is rounding error."""
    near: float = 0.1
    """Sine or ratio below which noise is asked whether it is zero; above, nothing is degenerate."""
    confidence: float = 0.99
    """Probability that noise leaves what is zero within the limit."""
    still: float = 3.0
    """Standard deviations within which a plane does not move."""


@dataclass(frozen=True)
class PlaneMisfitOptions:
    """What speaks against one homography at infinity for all: a residual that noise does not explain."""

    spread: float = 0.4
    """Noise that the residuals show, over what it would be without epipoles and normals, from which on no homography at infinity is
    common to the planes.  Of 1200 scenes of 4, 5 and 8 planes, 40 matches in 120 pixels each, the largest is 0.37 at 0.5 and
    1 px."""
    chance: float = 0.43
    """The same, from which on random homographies near any common one would do as well, for very many planes.  Of such random ones
    a twentieth stays below 0.15, 0.20, 0.24, 0.28 and 0.34 (4, 5, 6, 8 and 12 planes; 150 times each); of the scenes nine in ten
    below 0.18, 0.18, 0.16, 0.15 at 0.5 px and 0.23, 0.24, 0.25, 0.24 at 1 px (4, 5, 6, 8 of them)."""
    chance_of_few: float = 0.62
    """What that limit is less, times the root of the residuals to spare."""
    entries: float = 0.065
    """Noise of the entries of homographies of norm 1 in normalized coordinates from which on no homography at infinity is common;
    in the scenes above it is 0.059 at most."""
    unlikely: float = 3.09
    """Normal deviate of the F ratio, exceeded once in a thousand, from which on one homography at infinity is not common to matched
    planes.  The largest of 60 scenes of 4, 6 and 8 planes at 0.5 px: 1.6.  Planes that turn by themselves by 3 degrees: 1 to
    12."""
    doubtful: float = 2.33
    """The same, exceeded once in a hundred, from which on the ratio is taken for an error of the model."""
    vague: float = 0.25
    """Noise of the matches over the extent of their planes and bodies from which on they are no matches: 0.03 at 1 px in 120
    pixels, 0.4 to 0.5 where they are random."""
    fewest_spare: int = 8
    """Residuals of the separate matrices to spare from which on these say what the noise is."""
    rounding: float = 1e-5
    """Residual in normalized coordinates that single precision may leave."""


@dataclass(frozen=True)
class PlaneCalibrationOptions:
    """Whether a calibration fits."""

    turned: float = 0.01
    """Distance from a rotation that a calibration to two or three digits leaves."""
    small: float = 0.01
    """Standard deviation of that distance from which on four planes do not tell."""
    deviations: float = 8.0
    """Standard deviations of that distance that noise is believed to reach."""


@dataclass(frozen=True)
class PlanesOptions:
    """Every number that decides in :func:`dyntorch.translating_planes`, by stage."""

    frames: PlaneFrameOptions = PlaneFrameOptions()
    starts: PlaneStartOptions = PlaneStartOptions()
    fit: PlaneFitOptions = PlaneFitOptions()
    ambiguity: PlaneAmbiguityOptions = PlaneAmbiguityOptions()
    degeneracy: PlaneDegeneracyOptions = PlaneDegeneracyOptions()
    misfit: PlaneMisfitOptions = PlaneMisfitOptions()
    calibration: PlaneCalibrationOptions = PlaneCalibrationOptions()
