"""The numbers that decide in :func:`dyntorch.calibrate`, by stage."""

from __future__ import annotations

from dataclasses import dataclass, field

from dyntorch.numerics.least_squares import LeastSquaresOptions
from dyntorch.tasks.synchronize.options import SynchronizeOptions


@dataclass(frozen=True)
class RigInputOptions:
    """What is taken."""

    most_cameras: int = 8
    """Cameras at most: the graph of their pairs is complete."""
    fewest_matches: int = 60
    """Positions that two cameras must see at the same moments: ten times the seven unknowns of F is little."""
    outside: float = 0.5
    """Share of the picture by which positions may lie outside of it: beyond, sizes and keypoints do not belong together."""
    shares: float = 2.0
    """Largest coordinate up to which they are shares of the picture and no pixels."""
    outside_share: float = 0.05
    """Share of the positions that may lie farther out."""


@dataclass(frozen=True)
class RigStartOptions:
    """First cameras, from the epipolar geometry of the pairs."""

    moments: int = 60
    """Moments, evenly spread, at which starts are compared."""
    focals: tuple[float, ...] = (0.45, 0.6, 0.8, 1.05, 1.4, 1.9, 2.6)
    """Focal lengths that are tried, as shares of the longer side of the picture: 96 to 22 degrees of view across."""
    matches: int = 3_000
    """Matches of a pair that its F is fitted to."""
    scales: tuple[float, ...] = (40.0, 20.0, 10.0)
    """Thresholds of the first rounds in which F is fitted, thousandths of the longer side."""
    sigmas: tuple[float, ...] = (2.5, 1.5)
    """Those of the last rounds, in robust standard deviations of the residual."""
    averaging: int = 6
    """Rounds in which the weights of the pairs' rotations are learned."""
    disagreement: float = 0.1
    """Frobenius norm of the difference of two rotations (4 degrees) at which a pair's weight is a half."""
    kept: int = 3
    """Starts that are adjusted until they stay, of all."""


@dataclass(frozen=True)
class RigAdjustOptions:
    """Space and time adjusted together."""

    width: float = 1.0
    """Standard deviation of the kernel that tracks are smoothed by, frames of the slowest camera: below 1 the noise would depend on
    where between frames a moment is, which draws clocks to half frames."""
    positions: int = 7_000
    """Points times moments that take part at most, the moments evenly spread: 20 rigs of 300 frames and 17 points with half as many
    are 1.2 times as far off, in .6 of the time."""
    freedom: float = 4.0
    """Degrees of freedom of Student's t, the noise of a detector."""
    first_rounds: tuple[int, ...] = (8, 15, 15)
    """Steps of the rounds in which starts are compared; the scale of the noise is learned between rounds."""
    rounds: tuple[int, ...] = (12, 12, 10)
    """Steps of the rounds of the last adjustment; the noise, the bones and who is seen are learned between rounds."""
    tolerance: float = 1e-5
    """Share of the cost by which a step lowers it at most that ends a round."""
    noise_ratio: float = 2.0
    """Noise of a camera over the geometric mean of all at most, and its inverse."""
    least_noise: float = 0.05
    """Standard deviation of the noise at least, px: exact data have no scale."""
    focal: float = 0.85
    """Focal length before anything is seen, as a share of the longer side: 61 degrees across, a phone."""
    focal_sigma: float = 0.7
    """Standard deviation of its logarithm: a factor of two."""
    k1_scale: float = 0.015
    """Scale of Cauchy's distribution of the first term of the lens before anything is seen: most phones have less than .05, action
    cameras .3."""
    k2_sigma: float = 0.0
    """Of the second term; 0 holds it at 0."""
    rate_sigma: float = 1e-4
    """Of the logarithm of a clock rate beside what the pairs say: what quartz clocks differ by."""
    repeated: float = 0.02
    """Correlation of residuals with those some moments later from which on they repeat themselves."""
    lengths: bool = False
    """Whether distances between joints that stay the same take part.  They make it worse: of five virtual rigs of three and four
    cameras focal lengths are 2.4 % off in the median with them, 1.3 % without; the kernel shortens limbs that turn."""
    length_spread: float = 0.06
    """Spread of a distance over its length up to which two points may be the ends of a bone."""
    length_sigma: float = 2.5
    """Standard deviation of a bone's length, in multiples of the spread that was measured: a weak prior."""
    length_excess: float = 0.1
    """Share by which noise may lengthen a bone; beyond, a moment says nothing about it."""
    length_points: int = 40
    """Points up to which lengths take part: those of a frame are then solved together."""


@dataclass(frozen=True)
class RigPointOptions:
    """The points of every frame, when the cameras are known."""

    block: int = 20_000
    """Points times moments that are solved at a time."""
    steps: int = 8
    """Steps at most."""
    sigma: float = 0.08
    """Standard deviation of a point, as a share of the distance of the cameras, beyond which it is not known."""
    outlying: float = 4.0
    """Standard deviations of the noise beyond which a position does not agree."""


@dataclass(frozen=True)
class RigWorldOptions:
    """Which way is up."""

    upright: float = 15.0
    """Degrees from their middle within which long axes of bodies count as upright."""
    upright_share: float = 0.4
    """Share of the axes that must be so."""
    moments: int = 2_000
    """Moments that are looked at, evenly spread."""
    seen: float = 0.6
    """Share of the points of a body that must be known for a long axis of it."""
    whole: float = 0.9
    """The same for its height, or as many as ever are."""
    ground: float = 0.01
    """Quantile of the points' heights that is the ground."""
    elongation: float = 1.5
    """Ratio of the first two principal spreads from which a body has a long axis."""
    cameras: float = 40.0
    """Degrees of the long axes from the cameras' own upward direction at most: nobody stands on a wall."""
    body_spread: float = 0.15
    """Spread of a distance over itself up to which two points belong to one body."""
    standing: float = 0.75
    """Quantile of the extent upwards that is the standing one."""


@dataclass(frozen=True)
class RigTrustOptions:
    """When a calibration is refused."""

    rotation: float = 0.8
    """Degrees: standard deviation of the rotation of a camera beyond which a rig is refused."""
    focal: float = 0.08
    """The same of the focal length, as a share: Pose2Sim's recording of 1.5 s leaves 5 to 6 %, is 4 to 6 % off, and its rotations
    are within 1.6 degrees."""
    center: float = 0.04
    """The same of a centre, as a share of the distance from the people."""
    still: float = 2.0
    """Motion of the points in standard deviations of their noise below which nothing moves."""
    plane: float = 2.0
    """Residual of the best homography over that of F below which two cameras see a plane."""
    line: float = 0.06
    """Spread of the cameras across a line over that along it below which they stand in it."""
    rival: float = 10.0
    """Twice the logarithm of the likelihood ratio below which another rig fits as well."""
    apart: float = 2.0
    """Degrees from which on two rigs are different."""
    moved: float = 1.5
    """Degrees between the poses of a camera in both halves of the take from which on it moved."""
    went: float = 4.5
    """The same of its place, hundredths of its distance from the people."""
    moved_sigmas: float = 5.0
    """The same in standard deviations."""
    half: int = 1_000
    """Positions that a half must have to be judged by itself."""
    half_seconds: float = 2.5
    """Seconds that a half must last: what a detector gets wrong goes on for a second, and looks like a camera that moved
    (Pose2Sim's recording of 1.7 s, two and three cameras: 4 and 7 degrees)."""
    agree: float = 0.6
    """Share of the positions of a camera that must agree with the others."""


@dataclass(frozen=True)
class CalibrateOptions:
    """Every number that decides in :func:`dyntorch.calibrate`, by stage."""

    input: RigInputOptions = RigInputOptions()
    synchronize: SynchronizeOptions = SynchronizeOptions()
    start: RigStartOptions = RigStartOptions()
    adjust: RigAdjustOptions = RigAdjustOptions()
    points: RigPointOptions = RigPointOptions()
    world: RigWorldOptions = RigWorldOptions()
    trust: RigTrustOptions = RigTrustOptions()
    descent: LeastSquaresOptions = field(default_factory=LeastSquaresOptions)
    """How descents damp their steps."""
