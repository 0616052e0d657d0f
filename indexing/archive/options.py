"""What decides in an archive: every number of its stages, by its name, with its unit and what was measured for it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class StorageOptions:
    """How movement is stored.  Fixed when an archive is made: it says so itself, whatever is asked of it later."""

    rate: float = 15.0
    """Stored poses per second, each with a sketch: 4.8 MB per hour of 17 joints.  Windows may begin and end at any of them."""
    dimensions: int = 8
    """Directions of joint space that a sketch keeps, of x and of y.  Right moment among the best 10 / 100 / 300 of 280,000 windows
    of 1 s (CMU): 6 give .72 / .89 / .96, 8 .88 / .98 / .99, 12 .92 / 1.00 / 1.00, all .98 / .99 / .99 (without re-ranking)."""
    whitening: float = 0.5
    """Power of the joint covariance by which directions are evened out: .25 gives .88 / .98 / .99 there, too, at 2 s .82 of first
    places for .88."""
    floor: float = 0.03
    """Added to the covariance of mean diagonal 1."""
    shortest: float = 0.5
    """Seconds of the shortest window; what is in view for less is left out."""
    bridged: float = 1.0
    """Seconds between two sightings of a joint over which it is interpolated; it counts as not seen in longer gaps."""
    joints: int = 3
    """Joints that a frame must show, to show anybody."""
    far: float = 200.0
    """Body sizes from the middle of a stretch beyond which a joint is a slip: rounding costs .6 % of a body at worst."""
    sized: int = 500
    """Frames by which the size of a body is told for that."""
    views: tuple[float, ...] = (0.0, 90.0)
    """Degrees about the vertical from which movement in 3D is kept: what goes towards one camera, the other sees."""
    free: float = 10.0
    """Variance of where the middle of all joints is, in those of a joint, where some were not seen."""
    sure: float = 1e-3
    """Variance of a sighting, in the same: nearly none, a code is to be that of the joints that were seen."""
    learned: int = 20_000
    """Poses from which the directions of a layout are learned, at most, and after which they stay: 22 minutes."""


@dataclass(frozen=True)
class GrowthOptions:
    """How files of an archive grow and are put together."""

    windows: int = 1_000_000
    """Of a segment at most, unless one source has more: 18 hours, 88 MB of 17 joints."""
    seconds: float = 120.0
    """After which what was read is committed: as much is lost at most where an addition is killed."""
    relearned: float = 4.0
    """Times as much movement as a layout was learned from, from which on it is learned anew, until it was learned from enough."""
    small: int = 16
    """Segments of less than half the size that may lie about before they are put together."""
    dead: float = 0.5
    """Share of removed windows from which a segment is written anew."""
    tries: int = 3
    """Times that a source is tried where its worker dies, the last time by itself."""
    ahead: int = 4
    """Sources per worker that are read ahead of what is written: bounds memory."""
    under_way: int = 32
    """Of these at least: nobody says how many workers a cluster has."""
    patience: float = 30.0
    """Seconds that a reader waits for a commit."""
    peeked: int = 2**22
    """Bytes of a JSON file up to which it may be one frame of many."""


@dataclass(frozen=True)
class SearchOptions:
    """How an example is searched."""

    candidates: int = 1000
    """Moments that are compared exactly."""
    tempos: tuple[float, ...] = (0.8, 1.0, 1.25)
    """Durations that are searched, in those of the query: people differ."""
    scanned: tuple[float, ...] = (1.0,)
    """Durations that everything is scanned with."""
    trimmed: float = 2.0
    """Durations, at any tempo, of a recording up to which it may be one performance, cut out: its first and last windows are
    compared, which may lie between two steps of the scan.  Of every recording, this would take half of the time of a search."""
    samples: int = 4
    """Steps that a window is divided into by the scan, at least where its duration allows: it is compared by the poses at their
    ends."""
    settled: int = 2000
    """Windows of the scan that are compared at all tempos by more samples, and moved to the pose where they fit best."""
    fine: int = 16
    """Steps that they are divided into, at least where their duration allows."""
    apart: float = 0.05
    """Durations between two candidates: nearer ones are one.  Of right ones among ten in exercises, .2 finds .49, .05 .54, as
    looking at everything exactly does."""
    shifts: tuple[float, ...] = (-0.1, -0.05, 0.0, 0.05, 0.1)
    """Durations, in its own, by which one of the best candidates is moved where it is compared exactly."""
    stretches: tuple[float, ...] = (1.0,)
    """Durations, in its own, with which a candidate is compared then, besides the tempos: .9 and 1.1 add nothing there."""
    refined: int = 100
    """Best candidates that are moved and stretched."""
    merged: float = 0.5
    """Share of the shorter of two hits, of one person, that both cover, from which they are one."""
    power: float = 0.4
    """Of the joint metric.  Right moment first, of 280,000 of 1 s and 2 s: .25 gives .81 / .93, .4 .83 / .95, .5 .79 / .95."""
    floor: float = 0.05
    """Of the joint metric."""
    length: int = 12
    """Steps that windows are resampled to for the exact comparison."""
    deepest: float = 30.0
    """Seconds of the longest query; a longer one is no movement but a recording."""
    sampled: int = 3000
    """Windows from which the joint metric of a layout is learned."""
    attempts: int = 3
    """Times that a question is asked where segments are put together meanwhile."""


@dataclass(frozen=True)
class FindOptions:
    """How learned actions are found in an archive."""

    least: float = 0.3
    """Squared correlation of movement between sketches and the nearest exemplar, below which nothing is looked for.  All of 182
    actions of the exercises, UTKinect and synthetic people, by others and from other sides, reach .33; at .36 the F1 of three
    exercises falls by .07."""
    quiet: float = 0.25
    """Share of an exemplar's movement, by energy beside that of the pose, below which somebody rests and is no match.  With both a
    quarter of a recording is skipped in which people stand for three quarters of the time, and nothing of one in which all of it
    may be an action."""
    tempos: tuple[float, ...] = (0.7, 1.0, 1.4)
    """Durations of exemplars by which that is told, in their own."""
    margin: float = 0.5
    """Seconds around what may be an action that are looked at with it."""
    rows: int = 54_000
    """Poses that one worker looks at before it answers: an hour."""


@dataclass(frozen=True)
class ArchiveOptions:
    """Every number that decides in :class:`indexing.Archive`, by stage."""

    storage: StorageOptions = StorageOptions()
    growth: GrowthOptions = GrowthOptions()
    search: SearchOptions = SearchOptions()
    find: FindOptions = FindOptions()
