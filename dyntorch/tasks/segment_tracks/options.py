"""What decides in segment_tracks(): every number of its stages, by its name, with its unit and what was measured for it."""

from __future__ import annotations

from dataclasses import dataclass

from dyntorch.tasks.segment.options import EnergyOptions, SegmentOptions


@dataclass(frozen=True)
class FrameOptions:
    """Which pairs of frames are compared, and how well tracks are measured."""

    long: float = 0.75
    """Quantile of the lengths of the tracks that the widest pairs of frames have."""
    halvings: int = 4
    """Times that the gap of the widest pairs is halved: near pairs show short tracks, far ones more motion."""
    least: int = 12
    """Pairs of frames compared, where there are so many."""
    most: int = 64
    """Pairs of frames compared at most."""
    each: float = 5.0
    """Pairs that a track should be in, on average, where ``most`` allows it."""
    common: int = 20
    """Tracks that both frames of a pair must show; half of all tracks where those are fewer than twice as many."""
    grows: float = 2.0
    """Motion of a point between two frames at which the variance of its place has doubled, pixels.  Measured on streets and
    checkerboards with true labels: the median distance is .03 px at .5 px of motion, .08 at 15, .2 at 120, .3 at 240."""
    cut: float = 0.2
    """Share of the tracks of a frame that live on in the next one, below which the video has a cut there."""
    jump: float = 0.5
    """Share of the tracks that jump at once, by more than ``jumped``, from which a frame is the first of another scene."""
    jumped: float = 12.0
    """Such a jump, over the median motion of tracks between all other frames."""


@dataclass(frozen=True)
class PreferenceOptions:
    """Which tracks move alike, by the hypotheses that both of them prefer."""

    gaps: tuple[int, ...] = (1, 2, 4, 8)
    """Frames between those of a pair."""
    starts: int = 20
    """Pairs of frames of each gap, in a video as long as its tracks; longer ones have more."""
    common: int = 16
    """Tracks that both frames of such a pair must show."""
    hypotheses: int = 200
    """Of each kind, for a pair of frames: affine maps of three tracks, homographies of four, fundamental matrices of eight."""
    preferred: float = 0.1
    """Share of the hypotheses that a track prefers: those that fit it best."""
    near: float = 0.05
    """Radius about its first track in which a hypothesis finds the others, over the extent of all: the smallest one."""
    far: float = 0.7
    """The largest one."""
    neighbours: int = 10
    """Tracks that each is linked with: those with the most common preferences."""
    coherent: float = 0.04
    """Share of its preferences that the usual track has in common with the five most alike, below which tracks move each by
    itself, for one track, and ..."""
    coherent_grows: float = 0.0435
    """... how it grows with the logarithm of their number.  Of 20, 60, 200 random tracks it is .16, .21, .27; of 32 and 76 tracks
    of two bodies .22 and .37, of real recordings of 150 and more .41 to .7."""
    cut: float = 18.0
    """Cost of cutting all links of a track."""
    searched: int = 1200
    """Tracks that take part in the search; the others are labelled by what it finds."""


@dataclass(frozen=True)
class MergeOptions:
    """Pieces that move as one, and how they are joined to bodies."""

    pieces: tuple[int, ...] = (10, 14)
    """How many pieces the tracks are cut into, one start of the search for each; fewer where a piece would have fewer tracks
    than ``members``.  With true labels pieces of ten are pure but for .1 to .7 % of the tracks."""
    members: int = 6
    """Tracks of a piece, on average, at least."""
    bodies: int = 8
    """Most bodies that are looked for where their number is not known."""
    gaps: tuple[int, ...] = (1, 2, 5)
    """Frames between those of the pairs that pieces are joined by: near ones, where linear fits do."""
    starts: int = 10
    """Pairs of frames of each gap, in a video as long as its tracks; longer ones have more."""
    first_scale: float = 0.15
    """Standard deviation of a coordinate at rest by which the pieces are fitted at first, pixels."""
    least_scale: float = 0.05
    """Least one that is believed, pixels."""
    widened: float = 1.5
    """Scale of the costs, over the noise of the pieces."""
    cap: float = 9.0
    """Squared distance, over the squared scale, up to which it counts."""
    floor: float = 0.4
    """Added to the cost of a sighting in its own body, with which the cost of joining it to another is compared."""
    chance: float = 0.1
    """Share of preferences that tracks have in common by chance: those of ``PreferenceOptions.preferred``."""
    links: float = 0.5
    """Weight of the links between pieces beside what their common motion costs."""
    unlinked: float = 0.01
    """Links per track of the smaller of two pieces that count as none."""
    together: int = 3
    """Tracks of a group that a pair of frames must show for others to be seen beside it."""
    never: float = 1e3
    """How separate groups are that are never seen together: they are joined last."""


@dataclass(frozen=True)
class TrackDescentOptions:
    """What a segmentation costs, and how it is improved."""

    freedom: float = 2.0
    """Degrees of freedom of Student's distribution of the Sampson distances: some tracks slide."""
    cutoff: float = 4.0
    """Distance, in standard deviations, up to which it counts."""
    least_scale: float = 0.03
    """Least standard deviation of a coordinate of a track at rest, pixels."""
    most_scale: float = 0.5
    """Largest one, pixels."""
    evidence: float = 3.0
    """Pairs of frames that those of a track count as: their errors are not independent."""
    relief: float = 0.2
    """Weight of the parallax against the mean plane of a body."""
    rounds: int = 4
    """Rounds of labels and geometries."""
    turns: int = 3
    """Turns of the mean field over the labels in each round."""
    first_fit_scales: tuple[float, float] = (4.0, 1.0)
    """Scales of the first fits, one after the other, pixels."""
    fit_scale: float = 3.0
    """Scale of the fits, in standard deviations."""
    least_fit_scale: float = 0.15
    """Least scale of the fits, pixels."""
    members: int = 7
    """Fewest tracks of a body."""


@dataclass(frozen=True)
class ExchangeOptions:
    """How bodies exchange pieces where their number is given, and which of the segmentations that come of it is the best."""

    pairs: int = 4
    """Pairs of frames from which bodies exchange pieces: the epipolar geometry of two views alone bears wrong exchanges."""
    weights: tuple[float, ...] = (1.0, 3.0)
    """Weights of the links cut, over that in the descent, one search each: either finds segmentations that the other misses."""
    links: float = 3.0
    """Their weight in the comparison: at 1, bodies that share an epipolar geometry swallow parts of each other."""
    most: int = 12
    """Exchanges at most."""
    gain: float = 1e-6
    """Cost that an exchange must save."""
    apart: float = 0.5
    """Weight of the separation of the least separate bodies beside the cost of a segmentation for each of its tracks."""
    relief: float = 0.04
    """Weight of the parallax in that cost: on streets relief prefers halves of what rests to bodies; without it, one of six
    sequences of MTPV62 comes out wrong."""


@dataclass(frozen=True)
class ChoiceOptions:
    """Which of several segmentations is the best, and how many bodies there are.

    The odds of one body more are a logistic regression on the shared halves of KT3DMoSeg, MTPV62 and Hopkins155, 104 sequences: it
    finds the right number in 96.
    """

    links: float = 0.1
    """Weight of the links cut between the least separate bodies."""
    energy: float = 0.5
    """Weight of the cost of a segmentation, for each of its tracks."""
    base: float = -5.7
    """Logarithm of the odds of one body more, without what follows."""
    ratio: float = 0.4
    """Weight of what one motion of both costs beside two."""
    unlinked: float = 1.6
    """Weight of the logarithm of the links between them, for each track of the smaller one."""
    saved: float = 2.2
    """Weight of the logarithm of the cost that it saves, in units of the root of the number of tracks."""


@dataclass(frozen=True)
class StrayOptions:
    """Which tracks belong to no body."""

    farthest: float = 2.5
    """Median distance from its body over the pairs of frames up to which a track belongs to it, pixels."""
    supported: float = 7.5
    """The same for a track that is linked with others of its body."""
    support: float = 0.5
    """Share of the links of a track that lead to its body from which they support it."""
    still: float = 1.0
    """Way of the tracks, in 19 of 20 cases, below which nothing moves, pixels."""


@dataclass(frozen=True)
class StaticOptions:
    """Which body stands still."""

    cells: int = 8
    """Cells of the grid, across and down, by which the width of bodies is measured."""
    larger: float = 1.5
    """Tracks of the largest body over those of any other from which it may be what stands still, if it is the widest, too."""
    share: float = 0.4
    """Its share of the tracks that belong to a body."""
    agrees: float = 0.4
    """Median distance, in thresholds, up to which a body agrees with declared cameras.  True cameras are .07 px off what stands
    still, those of a film that runs backwards 1.4 to 2.6."""


@dataclass(frozen=True)
class TrackSegmentOptions:
    """Every number that decides in :func:`dyntorch.segment_tracks`, by stage; a pixel is the threshold over 2.5."""

    frames: FrameOptions = FrameOptions()
    preferences: PreferenceOptions = PreferenceOptions()
    merge: MergeOptions = MergeOptions()
    exchange: ExchangeOptions = ExchangeOptions()
    descent: TrackDescentOptions = TrackDescentOptions()
    choice: ChoiceOptions = ChoiceOptions()
    outliers: StrayOptions = StrayOptions()
    static: StaticOptions = StaticOptions()
    views: SegmentOptions = SegmentOptions(energy=EnergyOptions(parallax_scale=0.5))
    """What two views show: parallax, and whether a body is a plane.  Tracks are measured finely: before a camera that stands, what
    moves would else pass for relief of what rests."""
