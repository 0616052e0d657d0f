"""What decides in synchronize(), and in putting several cameras on one clock: every number, with its unit and measurement."""

from __future__ import annotations

from dataclasses import dataclass
from math import log
from typing import Literal


@dataclass(frozen=True)
class TakeOptions:
    """Which takes are taken."""

    fewest_frames: int = 12
    """Frames of a take at least."""
    frame_rate_error: float = 0.02
    """Share by which a frame rate as told is wrong at most: clock rates are searched so far."""
    longest_over_frames: int = 20
    """Steps that a clock may run over, in multiples of the frames there are: it is searched frame by frame."""
    longest_steps: int = 20_000
    """Steps that a clock may run over in any case."""


@dataclass(frozen=True)
class CleaningOptions:
    """Which positions of the tracks are outliers, before the cameras are compared, and how tracks are smoothed."""

    kernel_end: float = 4.0
    """Standard deviations at which the smoothing kernel ends."""
    least_seen: float = 0.4
    """Share of the kernel's weight that must be seen; less is a gap."""
    outlying: float = 4.0
    """Robust standard deviations from the median of the neighbouring frames beyond which a position is an outlier (Hampel's 3 takes
    more good positions at turns of the motion)."""
    neighbours: int = 3
    """Frames on each side that an outlier is judged by."""
    line_width: float = 1.5
    """Standard deviation of the kernel of the local line in the second pass, frames."""
    line_outlying: float = 6.0
    """Robust standard deviations from that line beyond which a position is an outlier."""
    over_neighbours: float = 2.0
    """Residual over that of the neighbouring frames beyond which it is one: a sudden movement bends several frames alike, a wrong
    position its own most."""
    least_deviation: float = 1e-3
    """Deviation, over the distance of the points from their mean, below which there is none, whatever the spread: points at rest
    have no spread."""
    line_rounds: int = 8
    """Rounds of the second pass."""
    distance_width: float = 0.5
    """Standard deviation of the kernel for the distance of a person, seconds: how slowly it changes."""


@dataclass(frozen=True)
class CurveOptions:
    """The residual of the best fundamental matrix at every shift."""

    least_overlap: float = 0.25
    """Share of the largest overlap below which a shift is not judged: little data fit anything."""
    fewest_pairs: int = 24
    """Pairs of positions below which a shift is not judged: three times the unknowns of F."""
    calm_slope: float = 0.75
    """How much more widely velocities are smoothed than positions, per noise over the movement from frame to frame: noise that they
    share with the residuals would pull the estimate and make it look surer than it is."""
    calm_least: float = 1.25
    """The width for velocities over that for positions, at least."""
    calm_most: float = 2.5
    """The width for velocities over that for positions, at most."""


@dataclass(frozen=True)
class ShiftDescentOptions:
    """The shift between frames, with the fundamental matrix, by reweighted least squares."""

    cut: float = 4.0
    """Robust standard deviations of the residual at which Geman and McClure's weight is a quarter."""
    block_frames: int = 30
    """Frames that share a scale."""
    unequal: tuple[float, float] = (0.4, 6.0)
    """Least and largest scale of a point or a block of frames, over that of all."""
    optimism: float = 1.6
    """Errors over the sigma that the residuals alone say: 1.5 to 1.8 on motion capture with 5 to 60 mm of noise."""
    iterations: int = 30
    """Steps at most, on some of the rows and on all."""
    done: float = 1e-5
    """Step below which the descent ends, frames."""
    nearly: float = 1e-3
    """The same before the last rows come in, frames."""
    enough_rows: int = 4_000
    """Rows for most of the way."""
    largest_step: float = 2.0
    """Largest step, frames."""
    least_sigma: float = 0.003
    """Error that smoothing leaves in exact data, frames."""
    largest_drift: float = 0.03
    """Change of the clock rate at which a descent has gone astray."""
    most_rows: int = 200_000
    """Residuals that a descent takes at most, of longer takes at moments at equal distances: beyond, only sigma would shrink."""
    fewest_pairs: int = 16
    """Pairs of positions below which there is no descent."""
    nearest: float = 0.05
    """Least depth of a point in space before the camera, over the median one, that its image is taken from."""
    memory: float = 2.0
    """Seconds over which residuals are taken to depend on each other: detectors err for that long."""
    memory_parts: int = 6
    """That time is the overlap over this number at most."""


@dataclass(frozen=True)
class EvidenceOptions:
    """How sure the shift of the same points is."""

    peaks: int = 6
    """Local maxima of the curve from which a descent may start."""
    rows: int = 3_000
    """Residuals that are enough to compare peaks."""
    margin: float = 0.2
    """Nats above the next peak for a decision; motion capture, 120 frames: exactly periodic gaits stay below .17 in 95 of 100, true
    peaks are above .31 with 30 mm of noise."""
    affine_margin: float = 0.5
    """The same for affine cameras: what they leave unexplained differs from period to period of a gait."""
    rough_margin: float = 0.5
    """Nats more for a decision where points or positions were left out, or the residual is beyond the usual one by
    ``rough_growth``: two walks of one person were made to fit with a margin of .53, other traps with .52 and less; real detectors
    have margins above .86."""
    usual_roughness: float = 1.25
    """Usual residual over what the noise explains: .9 to 1.2 on virtual cameras; the two walks had 1.6, synthetic takes that have
    nothing in common 7 to 22, real detectors have 5 to 10."""
    rough_growth: float = 0.25
    """Logarithm of the residual over the usual one at which all of that margin is asked for."""
    usual_roughness_clear: float = 4.0
    """Usual residual where b played backwards fits far worse, and of affine cameras, which leave perspective unexplained."""
    usual_roughness_pruned: float = 2.0
    """The same where points or positions were left out."""
    short_margin: float = 0.6
    """Nats more for a decision where points or positions were left out of an overlap of half ``short_overlap``: traps were made to
    fit so with margins up to 1.1."""
    short_overlap: float = 0.5
    """Share of the longest overlap below which it is short."""
    forward: float = -0.35
    """Nats by which the residual has to be below that of b played backwards, for a decision: films that run backwards and were
    called ok had -.9 to -1.9, good pairs -.1 to 2.7 (9 in 10 above .3): training trials of experiments.synchronization.silent."""
    forward_doubtful: float = 0.55
    """Nats more for a decision where points or positions were left out, or the noise does not explain the residual; a detector's
    good pairs have .4 to 1.3."""
    forward_clear: float = 0.6
    """Nats of it from which leaving out points is no reason for doubt: of 40 virtual pairs with wrong joints, outliers or gaps all
    but one had .7 to 2.1, traps that were made to fit so .2 and less."""
    score_clear: float = 0.9
    """Score above that of every other peak from which the same is no reason: traps had .3 and less, but for short overlaps."""
    forward_scale: float = 0.04
    """Nats of it by which the odds of a film that runs forwards grow e times."""
    apart: float = 2.5
    """Frames within which peaks are one, and halves of a take agree."""
    leaning: float = 0.8
    """Frames by which both halves may differ from the whole to the same side: of good virtual pairs .3 at most, of a detector's .3;
    a mirrored film with left and right renamed was wrong by 1.1 frames, and its halves by 1.5 and 2.0."""
    half_overlap: float = 0.5
    """Share of the largest overlap below which a half of the take does not judge a shift."""
    rivals: int = 3
    """Other peaks that are compared between frames."""
    fractions: int = 5
    """Places within a step of a peak at which it is compared."""
    sharp: float = 0.25
    """Sigma above which a shift decides nothing, frames: where the motion is hardly above the noise, sigma is a lower bound."""
    shortest_frame: float = 1 / 30
    """Seconds that a frame counts for at least in it."""
    wander: float = 1.35
    """Residual over what each half of the take has by itself beyond which a camera may have moved."""
    even_margin: float = 0.6
    """Margin, over the one needed, at which the best peak is as likely as not; set by hand,
    tests/dyntorch/tasks/synchronize/test_refusal.py and the tables of docs/results hold what comes of it."""
    margin_scale: float = 0.05
    """Nats of margin by which these odds grow e times."""
    hopeless_margin: int = -10
    """Margin below which the best peak is none, nats."""
    agreeing: float = 0.995
    """Probability that a shift is right in which both halves of the take agree, all else being sure."""
    disagreeing: float = 0.3
    """The same where they do not."""
    blurred: float = 0.5
    """Factor of the confidence where the shift is not sharp, or at the end of what was searched."""


@dataclass(frozen=True)
class ConsistentPointOptions:
    """Which points are the same in both cameras: subsets vote, each at the shift it likes best."""

    subset: int = 6
    """Points of a subset."""
    subsets: int = 60
    """Subsets; one of 6 without 4 wrong points of 17 comes up with probability .14: one in 60 trials in all but 1 of 10,000."""
    share: float = 0.7
    """Share of the points that have to fit."""
    wrong: float = 3.0
    """Residual, over the median one of those that fit, beyond which a point is wrong."""
    fewest: int = 8
    """Points below which none can be told wrong."""
    most_lags: int = 800
    """Shifts at most; longer searches are made in coarser steps."""


@dataclass(frozen=True)
class ShiftSearchOptions:
    """The search for the shift of the same points, and what is tried where it does not decide."""

    clear: float = 0.6
    """Nats above the next peak from which on that one needs no descent of its own."""
    drifting: float = 10.0
    """Seconds of overlap from which a clock rate is looked for: 1 % amounts to less than two frames of 30 at the ends of shorter
    takes, and what is wrong with a motion fits into a rate."""
    significant: float = 3.0
    """Sigmas from 1 for a clock rate to be believed."""
    largest_drift: float = 0.022
    """Clock rates that differ from 1 by more are none."""
    negligible: float = 0.1
    """Frames over the take that a rate must amount to."""
    most_steps: int = 4_000
    """Steps of a take at most; longer takes are searched in coarser steps."""
    rate_steps: int = 2_000
    """Steps of a take for a search over rates, of a tenth of a second at least."""
    suspect: float = 3.0
    """Residual over the usual one beyond which a point is wrong."""
    far: float = 6.0
    """Robust standard deviations from the fit at which a position counts as an outlier."""
    lost: float = 0.3
    """Share of the positions of a point, or of a stretch of the take, that may be outliers."""
    stretches: int = 8
    """Stretches of the take that are looked at for it."""
    rare: float = 0.01
    """Share of outlying positions that makes no difference to a fit that is sure."""
    rough: float = 1.25
    """Residual over what the noise explains from which lenses are looked at."""
    blind: float = 10.0
    """Sigma from which no shift stands out at all, frames."""


@dataclass(frozen=True)
class SubspaceOptions:
    """The curve of evidence without correspondence, from subspaces of shape and motion."""

    width: float = 1 / 30
    """Standard deviation of the Gaussian that positions are smoothed by, seconds (15 mm of noise: twice that finds one to two
    percent less)."""
    size_width: float = 1 / 3
    """Standard deviation of the Gaussian for the size of the body in the image, seconds: the distance changes slowly (half to six
    times as much are alike to a percent)."""
    gap_widths: tuple[float, ...] = (1.0, 2.5, 6.0, 15.0, 40.0)
    """Standard deviations of ever wider Gaussians that look for what is missing, frames."""
    noise: float = 2.0
    """Noise variance of the rows over that of third differences: cameras are not affine (1 to 4 are alike, 8 is 4 percent
    worse)."""
    narrowest: float = 0.7
    """Least smoothing, frames: below, a sampled Gaussian is none."""
    fill_rounds: int = 12
    """Fills of what is missing from the other points."""
    edge: float = 2.0
    """Widths of smoothing left out at either end, where it is one-sided, in both cameras at once: that would speak for lag 0."""
    stray: float = 3.0
    """Median distances from the middle beyond which a track takes no part in the middle and the size."""
    rounding: float = 1e-6
    """Distance of a track from a straight line, over the extent of the points, that says nothing."""
    least_overlap: float = 0.35
    """Share of the shorter take below which a lag is not judged."""
    least_seconds: float = 0.8
    """Seconds of overlap below which a lag is not judged."""
    shape_rate: float = 2.4
    """Independent samples per second of the shape: neighbouring frames repeat each other; fitted, with the next two, as weights to
    the posterior of the true lag (30 frames per second, half of the motion capture takes, 15 mm)."""
    height_rate: float = 2.25
    """The same of its vertical part."""
    motion_rate: float = 5.7
    """The same of the motion."""
    loading: float = 0.02
    """Share of its own variance that a velocity is blurred by: no two medians of different points are the same."""
    chance_lags: int = 40
    """Lags at which chance is measured."""


@dataclass(frozen=True)
class RowSpaceOptions:
    """Row spaces of both cameras as they are, for every kind of camera."""

    width: float = 1.0
    """Standard deviation of the Gaussian that positions are smoothed by, frames of the slower camera: below 1 the noise would
    depend on where between frames a moment is."""
    edge: float = 3.0
    """Widths left out at either end, where the kernel is one-sided."""
    fractions: int = 2
    """Places within a frame at which lags are compared."""
    levels: tuple[float, ...] = (0.0, 0.03)
    """What a kind of camera may leave unexplained, as share of the rms coordinate, beside the noise."""
    noise: float = 2.0
    """Noise variance of the rows over that of third differences."""
    above: float = 4.0
    """Variance, over that of the noise, from which a direction belongs to a row space."""
    exact: float = 1e-6
    """Least noise, over the rms distance of the points from their mean: rounding."""
    least_overlap: float = 0.35
    """Share of the shorter take below which a lag is not judged."""
    least_seconds: float = 0.8
    """Seconds of overlap below which a lag is not judged."""
    apart: float = 0.2
    """Seconds within which peaks are one."""
    finest: float = 1 / 2048
    """Step at which the search between frames ends, frames."""
    bend: float = 0.125
    """Step by which the curvature of the score is told, frames."""
    zoom_terms: int = 8
    """Chebyshev polynomials in time of the logarithm of one camera's zoom over the other's."""
    zoom_steps: int = 12
    """Steps of least squares for it."""
    zoom_rounds: int = 3
    """Times that the zoom and the place between frames are found in turn."""
    zoom_least: float = 1e-6
    """Least share of a direction that is not common: rounding."""
    most_lags: int = 1_200
    """Lags that are looked at, at most: of longer searches those near the best of the body's evidence."""
    clear: float = 4.2
    """Margin of the best lag, over the spread of the others, from which it decides where all kinds and levels agree on it."""
    alone: float = 3.0
    """How much more is asked for where one kind and level says so alone; in proportion between."""
    odds: float = 4.0
    """How much the logarithm of the odds grows with the clearness, over that which decides."""
    beyond: float = 8.0
    """Clearness from which the lag is that of one kind of camera; below, it is as uncertain as the body's evidence differs."""
    precise: float = 0.045
    """Sigma up to which it is that of one kind of camera as well, frames: what cameras leave unexplained blurs."""
    contradicting: float = 0.3
    """Clearness, over that which decides, from which another lag than that of the body's evidence speaks against it."""
    confirming: float = 0.6
    """The same from which the same lag as that of the body's evidence, where that decides, is sure by itself."""
    heard: float = 0.15
    """The same below which not even the lag of the body's evidence is believed: nothing of it shows in the row spaces."""
    nearly: float = 0.75
    """Share of the nats of the best kind of camera from which another one is as good: their places are as uncertain as they
    differ."""
    hopeful: float = 0.35
    """The same below which no track is looked for that has no part in the motion."""
    looked_at: int = 400
    """Lags among which local maxima are looked for."""
    foreign: float = 0.34
    """Share of a camera's tracks that may have no part in the motion."""
    fewest: int = 3
    """Tracks that are kept at least."""
    gain: float = 1.15
    """Factor by which a lag must stand out more without a track for that to be left out."""


@dataclass(frozen=True)
class DifferentPointOptions:
    """When that curve decides a shift."""

    camera: Literal["auto", "affine", "affine_moving", "perspective"] = "auto"
    """Kind of both cameras; ``"auto"`` is the one whose best lag stands out most."""
    measure: Literal["auto", "rank", "log_determinant", "principal_angles"] = "auto"
    """What two row spaces share: a measure of the thesis by itself, or ``"auto"``: the log-determinant, beside the evidence of the
    body's shape and motion."""
    blocks: int = 8
    """Parts of the overlap that are left out in turn."""
    peaks: int = 6
    """Local maxima that are returned."""
    apart: float = 0.1
    """Seconds within which peaks are one."""
    sure: float = 0.95
    """Posterior of the best peak for a decision."""
    clear: float = 7.0
    """Nats above the next peak at an equal overlap for a decision; of motion that repeats itself exactly 98 of 100 gaits stay below
    3, sums of harmonics reach 13, so this alone is not enough."""
    forward: float = 5.0
    """Nats by which the best lag has to tell more than the best one of b played backwards, for a decision; good pairs had 7.7 and
    more, films of other takes or people 0 +- 8, training trials of experiments.synchronization.silent."""
    forward_clear: float = 20.0
    """Nats above the next peak from which on a film played backwards has no say: a good pair with two foreign tracks of nine led by
    26, and was told better by 7 backwards."""
    telling: float = 1.5
    """Nats per second below which nothing is shared."""
    sharp: float = 0.6
    """Sigma above which a shift decides nothing, steps of the curve (.7 keeps 4 percent more of motion capture, and twice the wrong
    ones of a detector)."""
    alone: float = 0.7
    """Share of its score by which a peak is above the next from which the motion is not compared with itself: of 425 exactly
    periodic motions all stay below .6."""
    repeated: float = 0.68
    """Resemblance of the motion to itself from which a peak may be another period."""
    bent: float = 1.5
    """Variance about straight lines at constant velocity over that of the noise, of either camera, below which only such lines are
    seen: 1.0 to 1.1 where they are, 16 and more for bodies that bend and turn, at 6 px of noise; the growing size of the whole
    bends them alike at every shift."""
    blur: float = 1 / 150
    """Seconds that the peak is off even where it is sharp, because cameras are not affine."""
    finest: float = 1 / 30
    """Seconds per step at least: faster films say no more, and noise of neighbouring frames of real detectors is the same."""
    drifting: float = 20.0
    """Seconds of overlap from which clock rates are looked for."""
    near: float = 1.0
    """Seconds around the best shift in which rates are compared."""
    sharp_frames: float = 0.6
    """Sigma above which a shift decides nothing, frames."""
    window: float = 10.0
    """Seconds of a window that has a shift of its own."""
    likely: float = 0.5
    """Probability from which the shift of a window counts."""
    spread: float = 0.3
    """Frames that the shift of a window is uncertain by at least."""
    significant: float = 3.0
    """Sigmas from 1 for a rate to be believed."""
    convincing: float = 8.0
    """Nats by which another clock rate has to be better."""


@dataclass(frozen=True)
class ProjectiveOptions:
    """Different points of one rigid body before perspective cameras (``camera="projective"``)."""

    fewest_points: int = 6
    """Points on the body that a camera has to see: fewer leave projective depths undecided."""
    seen: float = 0.5
    """Share of the frames in which a point must be seen to be used."""
    fewest_in_frame: int = 4
    """Points that place the body in a frame, once its shape is known."""
    fewest_frames: int = 10
    """Frames that show enough points, at least."""
    views: int = 20
    """Frames that the search starts with, spread over the take."""
    focals: tuple[float, ...] = (4.0, 9.0, 25.0)
    """Focal lengths to start from, over the rms coordinate of the tracks.  Of 96 cameras at 5 to 50 times the size of the body all
    ended at the same minimum as from six focal lengths, from 2 to 60."""
    first_iterations: int = 10
    """Steps from each start."""
    kept: int = 3
    """Starts that go on from there."""
    start_iterations: int = 50
    """Further steps from these."""
    iterations: int = 60
    """Steps of the adjustment of all frames."""
    placing_steps: int = 3
    """Gauss-Newton steps that place a point on a body whose motion is known."""
    misfit: float = 3.0
    """Rms of a point about the body, over the noise of its coordinates, beyond which it is not on the body."""
    exact: float = 1e-6
    """The same over the rms coordinate of the tracks, where that is more: rounding."""
    subsets: int = 100
    """Subsets of points that are compared where some are not on the body."""
    tried: int = 8
    """Of them those that are fitted, at most."""
    thick: float = 3.0
    """Thickness of the body in the image, over the noise, below which its points are in one plane."""
    turned: float = 5.0
    """Rms angle that the body turns by, over the noise at the distance of its points from their middle, below which it does not."""
    measure: str = "attitude"
    """What is compared at all lags: ``"attitude"``, how far the cameras disagree about the turns of the body, or ``"rank"``, the
    thesis's rank of both cameras' scaled measurements together; either way descents from its best lags decide.  The rank is exact
    where the shift is a whole number of frames and the take long: of 5 s of motion below .6 Hz 12 dimensions explain as much
    at other lags."""
    peaks: int = 5
    """Lags from which a descent starts."""
    agree: float = 1.8
    """Difference of the two motions, in standard deviations of what the cameras know, beyond which they are not one: 0.9 to 1.2 at
    the right shift."""
    margin: float = 0.2
    """Logarithm of that difference at the next lag over that at the best, for a decision."""
    even: float = 0.1
    """The same at which the best lag is as likely as not; set by hand."""
    margin_scale: float = 0.03
    """By how much it grows for odds of e times as much."""
    blur: float = 1e-6
    """Seconds that a shift is uncertain by at least: poses between frames are interpolated."""


@dataclass(frozen=True)
class CombinedOptions:
    """Where between frames the shift of a camera and motion capture lies that share no point."""

    most_combinations: int = 8
    """Combinations of the points in space, besides their middle: rms error of 15 films of 5 s, 8 / 12 / 20: .25 / .26 / .26
    frames."""
    start_combinations: int = 4
    """Those that the first affine camera is told by."""
    start_ridge: float = 1e-3
    """Ridge of the regressions for it, mean squares of coordinates of order 1."""
    above: float = 1.0
    """Movement of a combination, over the noise of the camera, from which it counts: rms error at .5 / 1 / 2: .26 / .26 / .42."""
    usual_weight: float = 1.0
    """Standard deviation of a combination's weights; a point that is one of the recorded has weights of norm 1 at most."""
    reach: float = 3.0
    """Frames from the lag of the row spaces within which the shift is looked for."""
    fewest: int = 24
    """Frames of each point that are needed at least."""
    most_rows: int = 40_000
    """Positions at most; of longer films frames at equal distances."""
    rounds: int = 4
    """Times that weights are told anew from the residuals."""
    iterations: int = 30
    """Steps of each."""
    tolerance: float = 1e-7
    """Share of the cost by which a step must lower it."""
    exact: float = 1e-6
    """Residual of normalized coordinates that is rounding."""
    optimism: float = 3.0
    """Errors over the sigma that the residuals alone say: a joint is only nearly a combination of others."""
    least_sigma: float = 0.05
    """Error at least, frames."""


@dataclass(frozen=True)
class NetworkOptions:
    """Several cameras on one clock, from the shifts of their pairs."""

    peaks: int = 8
    """Candidates per pair."""
    peak_error: float = 0.25
    """Error of a right peak that no standard deviation of one pair knows of, frames (view-dependent keypoints)."""
    sure: tuple[float, float] = (0.95, 0.99)
    """Range of the probability that the best peak is right, of a pair that decides: its confidence within it."""
    unsure: tuple[float, float] = (0.05, 0.5)
    """The same of a pair that refused."""
    rate_sigma: float = 5e-5
    """Standard deviation of the rate of a pair that did not search it, next to pairs that did: what quartz clocks differ by."""
    fixed_rate_sigma: float = 1e-9
    """The same where no pair searched it: rates stay as given."""
    unknown_range: float = 10.0
    """Seconds that the offset of a pair without a curve may have."""
    beam: int = 100
    """States that are kept when a camera joins."""
    final: int = 30
    """States that are refined in the end."""
    steps: int = 5
    """Reweighted least squares of a state."""
    drift_cost: float = 8.0
    """Cost at which a contradiction of the rates stops growing: the pair is wrong, by whatever."""
    decided: float = log(10)
    """Logarithm of the odds of the best reading to another from which it counts as the answer, where the two differ in cameras that
    sure pairs tie to the reference."""
    confirmed: float = log(300)
    """The same where they differ in others: refused pairs often fail together, all of one camera."""


@dataclass(frozen=True)
class BreakOptions:
    """Clocks that break: frames that were lost, or written twice, in the middle of a film."""

    window: float = 4.0
    """Seconds of a window that has a best shift by itself, where the search starts."""
    most_windows: int = 8
    """Windows at most."""
    window_overlap: float = 0.6
    """Share of a window that has to overlap for a shift to be judged."""
    longest: float = 2.0
    """Seconds that a jump may have."""
    near: float = 4.0
    """Frames from the offset so far within which half frames are compared, too."""
    least: float = 0.7
    """Frames that a jump must have."""
    shortest: float = 0.7
    """Seconds of the shortest piece: less says nothing."""
    dependence: float = 2.0
    """Residuals that count as one, beside those that smoothing makes alike: detectors err for longer."""
    resolved: float = 0.2
    """Frames that the search resolves: less motion than that is no residual."""
    unseen: float = 1.0
    """Nats that a position costs, before those that are alike are made one, that the other camera does not show: twice what one
    that fits does."""
    penalty: float = 12.0
    """Nats that a jump costs, in the search."""
    evidence: float = 25.0
    """Nats by which a jump has to explain the residuals better than one offset on both of its sides."""
    rounds: int = 6
    """Rounds of the search and the fit at most."""
    alone: float = 3.0
    """Seconds from which a piece has to have the same best shift by itself."""
    together: float = 1.0
    """Seconds within which the breaks that pairs of cameras tell are one."""
    whole: float = 0.3
    """Frames by which a jump may differ from a whole number of frames and still be one."""


@dataclass(frozen=True)
class SynchronizeOptions:
    """Every number that decides in :func:`dyntorch.synchronize`, :func:`dyntorch.synchronize_cameras` and
    :func:`dyntorch.combine_shifts`, by stage; frames are those of the slower camera."""

    input: TakeOptions = TakeOptions()
    cleaning: CleaningOptions = CleaningOptions()
    curve: CurveOptions = CurveOptions()
    descent: ShiftDescentOptions = ShiftDescentOptions()
    evidence: EvidenceOptions = EvidenceOptions()
    points: ConsistentPointOptions = ConsistentPointOptions()
    search: ShiftSearchOptions = ShiftSearchOptions()
    subspace: SubspaceOptions = SubspaceOptions()
    rows: RowSpaceOptions = RowSpaceOptions()
    different: DifferentPointOptions = DifferentPointOptions()
    cameras: NetworkOptions = NetworkOptions()
    projective: ProjectiveOptions = ProjectiveOptions()
    combined: CombinedOptions = CombinedOptions()
    breaks: BreakOptions = BreakOptions()
