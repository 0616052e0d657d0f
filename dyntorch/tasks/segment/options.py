"""What decides in segment(): every number of its stages, by its name, with its unit and what was measured for it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class UnitOptions:
    """What a pixel is, in which most of the figures below are given."""

    threshold_in_pixels: float = 2.5
    """Threshold of :func:`dyntorch.segment`, in pixels, that the figures in pixels below refer to: all of them follow the
    threshold."""
    threshold_in_sigmas: float = 5.0
    """Threshold over the standard deviation of a coordinate, where the threshold is estimated."""
    first_threshold: float = 0.003
    """Threshold over the diagonal of the image that the estimation of the threshold starts from."""


@dataclass(frozen=True)
class CoherenceOptions:
    """Which matches move like their neighbours, before any model of motion is known."""

    neighbours: int = 15
    """Nearest matches, in either image, by which the coherence of a match is judged."""
    edges: int = 8
    """Nearest matches, in either image, that a match is linked with."""
    tolerance: float = 0.7
    """Deviation from the local affine motion, relative to the distance of the neighbour, at which coherence has fallen to 1/e."""
    edge_tolerance: float = 0.5
    """The same at which the weight of a link has fallen to 1/e."""
    ridge: float = 0.25
    """Weight of the common motion in the fit of a local one, over the moments of the neighbours."""
    reach: float = 2.5
    """Distance of a neighbour, over the median one, beyond which its deviation is no longer divided by its distance."""
    passes: int = 2
    """Times that coherence is found, each without the neighbours that the last one distrusts."""
    trusted: float = 0.02
    """Coherence in [0, 1] below which a match is no neighbour in the next pass."""
    members: int = 1500
    """Members of a body by which the conformity of a match is judged, about: closer ones have no other motion, only noise."""
    ratios: int = 400
    """Pairs of neighbours by whose zoom and rotation the common motions are looked for, about."""
    modes: int = 16
    """Of these pairs, those from which the mean shift starts."""
    distorted: float = 0.35
    """Distance from 1 of the complex factor of zoom and rotation up to which local motions start from the identity."""
    apart: float = 0.7
    """Relative distance of a further factor from the first ones from which local motions start from either: a local fit does not
    get so far."""
    share_of_further: float = 0.1
    """Share of the pairs that must have a further factor: wrong matches beside right ones agree on 0.05 to 0.08 by chance."""
    share_of_first: float = 0.05
    """Share of the pairs that must have the first factor: 0.02 to 0.04 of random matches agree by chance, 0.06 of 30 % right
    matches do."""
    noise: float = 3.0
    """Noise of the differences of matches, pixels."""
    coherent: float = 0.2
    """Coherence from which a match belongs to a group."""
    linked: float = 0.3
    """Weight of a link from which it joins two matches to one group."""


@dataclass(frozen=True)
class EnergyOptions:
    """What a segmentation costs."""

    noise: float = 0.7
    """Standard deviation of a Sampson distance, pixels."""
    cap: float = 4.0
    """Squared Sampson distance, over the variance of the noise, up to which it counts."""
    cut: float = 4.0
    """Cost of a link of weight 1 between two bodies."""
    parallax: float = 0.2
    """Weight of the parallax: motion along the epipolar lines beside that of the body's mean plane."""
    parallax_freedom: float = 2.0
    """Degrees of freedom of Student's distribution of the parallax."""
    parallax_scale: float = 2.0
    """Least scale of the parallax, pixels."""
    plane_rounds: int = 6
    """Reweighted fits of the mean plane of a body."""
    scale_rounds: int = 2
    """Reestimations of the scale of the parallax in each of them."""


@dataclass(frozen=True)
class CountOptions:
    """How many bodies there are."""

    first: int = 4
    """Numbers of bodies tried at first: one to so many."""
    further: int = 2
    """Numbers of bodies tried further, each time that the largest one was the best."""
    most: int = 12
    """Largest number of bodies tried."""
    penalty: float = 4.5
    """Cost of a body in units of the root of the number of matches: what models leave unexplained grows with the matches."""
    penalty_without_neighbours: float = 6.2
    """The same where geometry decides alone: spurious bodies explain up to 4.9, true ones 7.6 and more."""
    same: float = 0.9
    """Share of the matches with the same labels from which two segmentations are one."""
    decided: float = 1.0
    """What another segmentation must cost more for two views to decide, in units of the root of the number of matches: of pairs of
    street scenes the wrong ones have .7 to 3.7, the right ones .8 to 9, all pairs of AdelaideRMF and Hopkins155 2.4 and more."""
    left: int = 10
    """Linked matches without a body from which one body more is tried."""
    left_share: float = 0.08
    """Their share of all linked ones from which one body more is tried."""


@dataclass(frozen=True)
class FlowOptions:
    """Starts of the search: several affine flows at a time."""

    patches: tuple[int, ...] = (12, 20, 30, 45)
    """Matches of the patches that runs start from, in turns: small bodies need small ones, noisy flows large ones."""
    rounds: int = 8
    """Rounds of expectation maximization."""
    turns: int = 3
    """Turns of the mean field over the labels in each round."""
    scale_rounds: int = 2
    """Reestimations of the scale of each flow in each round."""
    cut: float = 2.0
    """Cost of a link of weight 1 between two flows."""
    freedom: float = 3.0
    """Degrees of freedom of Student's distribution of the deviations from a flow: bodies have depth."""
    runs: int = 16
    """Runs for each number of flows; twice as many where at most two numbers are tried."""
    noise: float = 0.5
    """Least standard deviation of a flow, pixels."""


@dataclass(frozen=True)
class PoolOptions:
    """The pool of epipolar geometries, and sets of them that explain all matches."""

    fitted: int = 10
    """Fewest matches of a group whose geometry enters the pool."""
    alike: float = 0.93
    """Overlap (intersection over union) of two groups above which one of them is enough."""
    fit_scales: tuple[float, float] = (4.0, 2.0)
    """Scales of the fits of the groups, one after the other, pixels."""
    noise: float = 1.0
    """Standard deviation of a Sampson distance by which geometries are chosen, pixels."""
    cap: float = 9.0
    """Squared Sampson distance, over the variance of the noise, up to which it counts in the search."""
    cut: float = 3.0
    """Cost of a link of weight 1 between two bodies in the search."""
    kept: int = 6
    """Starts kept of each kind."""
    sets: int = 400
    """Sets followed from one geometry to the next."""
    distinct: float = 0.97
    """Share of the matches in the same groups above which two labellings are one."""
    matrix_matches: int = 40
    """Matches that a segmentation matrix takes."""


@dataclass(frozen=True)
class DescentOptions:
    """Labels and epipolar geometries in turns."""

    schedule: tuple[float, ...] = (2.0, 2.0, 1.5, 1.0, 1.0, 1.0, 1.0, 1.0)
    """Noise in the rounds, over ``noise``."""
    noise: float = 0.5
    """Noise at the end, pixels: finer than in the final energy, for small bodies to hold their own."""
    turns: int = 3
    """Turns of the mean field over the labels in each round."""
    fit_scale: float = 2.0
    """Scale of the fits, pixels."""


@dataclass(frozen=True)
class SampleOptions:
    """The search by geometry alone, from samples of seven matches, for bodies that interleave."""

    at_once: int = 6000
    """Samples drawn at a time."""
    most: int = 24000
    """Samples drawn at most from the same matches."""
    pure: float = 10.0
    """Samples wanted all of whose matches are of the largest body."""
    distance: float = 3.0
    """Sampson distance up to which a match speaks for a sample, pixels: seven matches fix a geometry less well than all of a
    body."""
    best: int = 240
    """Samples of a round that descend."""
    fit_scales: tuple[float, float] = (3.0, 2.0)
    """Scales of these descents, one after the other, pixels."""
    partial: int = 4
    """Sets of geometries whose unexplained matches the next round samples."""
    first: int = 40
    """Geometries that sets start from."""
    alike: float = 0.97
    """Overlap (intersection over union) of the matches that agree with them above which one of two geometries is enough."""
    starts: int = 30
    """Sets that descend, for each number of bodies."""
    worth: float = 5.0
    """What a body must explain for further ones to be looked for, in units of the root of the number of matches: by chance 2 to 5,
    small bodies 8."""
    matrix_rounds: int = 3
    """Rounds of the weights of the segmentation matrix."""
    far: float = 20.0
    """Distance from the middle of the matches, over the median one, from which a match is garbage where neighbours do not
    matter."""
    outliers: float = 0.3
    """Share of outliers assumed where neighbours do not tell it."""


@dataclass(frozen=True)
class InputOptions:
    """Which matches take part, and what deserves a refusal or a notice."""

    farthest: float = 1e3
    """Distance from the middle of the matches, over the median one, to which farther ones are moved."""
    searched: int = 1500
    """Matches that the search looks at, and that are neighbours; the others are labelled by what it finds."""
    coarse: float = 0.2
    """Threshold over the spread of the points from which everything is near everything, and the problem is refused."""
    repeated: float = 0.1
    """Share of repeated matches that deserves a notice."""
    sparse: float = 0.3
    """Share of matches that move like their neighbours below which geometry alone may do better, which deserves a notice."""


@dataclass(frozen=True)
class LabelOptions:
    """Labels of all matches, outliers among them, given the bodies."""

    outlier: float = 1.0
    """Cost of an outlier where many are: that of a match a threshold away from a body in which it moves like its neighbours."""
    few_outliers: float = 0.005
    """Share of outliers below which they are no rarer."""
    many_outliers: float = 0.2
    """Share of outliers above which they cost no less."""
    strange: float = 2.5
    """Cost of a match that moves unlike all its neighbours of a body."""
    conforming: float = 0.25
    """Conformity, over the median one of the members, from which a match costs nothing."""
    least_conforming: float = 0.02
    """The same conformity, at least."""
    found: float = 6.0
    """What a match gains in the body that the search assigned it to."""
    sharpness: float = 4.0
    """Inverse temperature of the probabilities, and weight of the links between different labels."""
    cap: float = 9.0
    """Squared Sampson distance, over the squared threshold, up to which it counts."""
    turns: int = 20
    """Turns of the mean field over the labels."""
    rounds: int = 3
    """Rounds of labels and fits."""
    fit_scale: float = 0.8
    """Scale of the fits, in thresholds."""


@dataclass(frozen=True)
class ModelOptions:
    """Whether a body is one with depth or a plane, and whether it is an accident."""

    off_plane_share: float = 0.02
    """Share of a planar body that may be off the plane: wrong matches that lie on its epipolar lines."""
    off_plane: float = 1.5
    """Distance in two dimensions from which a match is off the plane, in thresholds."""
    least_noise: float = 0.1
    """Least standard deviation of a coordinate, pixels: no detector is better, and exact data shows none."""
    truncated: float = 6.25
    """Square, over the variance, up to which it counts in the estimate of the noise."""
    kept: float = 0.978
    """Mean of squares so truncated, over the variance: ``E min(z^2, 6.25)`` of a normal z."""
    noise_rounds: int = 10
    """Rounds of the estimate of the noise."""
    false_alarms: float = 1e-2
    """Bodies expected in random matches below which a body is believed."""


@dataclass(frozen=True)
class SegmentOptions:
    """Every number that decides in :func:`dyntorch.segment`, by stage; a pixel is the threshold over ``threshold_in_pixels``."""

    units: UnitOptions = UnitOptions()
    coherence: CoherenceOptions = CoherenceOptions()
    energy: EnergyOptions = EnergyOptions()
    count: CountOptions = CountOptions()
    flows: FlowOptions = FlowOptions()
    pool: PoolOptions = PoolOptions()
    descent: DescentOptions = DescentOptions()
    samples: SampleOptions = SampleOptions()
    input: InputOptions = InputOptions()
    labels: LabelOptions = LabelOptions()
    models: ModelOptions = ModelOptions()
