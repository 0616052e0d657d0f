"""What decides in detect(): every number, by its stage, with its unit and what was measured for it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class DetectorOptions:
    """What counts as a person in a whole picture."""

    score: float = 0.5
    """Of the network, from which on it is a person; MediaPipe's value."""
    overlap: float = 0.3
    """Of two boxes (intersection over union), from which on they are one person; MediaPipe's value."""
    shrinks: tuple[int, ...] = (1, 2, 3)
    """The network looks at the whole picture, and where that is not enough, closer: at overlapping squares of one part in so many
    of its longer side."""
    farther: tuple[int, ...] = (5,)
    """The same where nobody is found by these.  People of 140 pixels in a picture of 1920: in .69 of the frames without it, in
    .95 with it; of 100 pixels, in none and in .83."""
    closer_score: float = 0.65
    """As ``score``, when it looks closer: there parts of people and of furniture get up to .74, people whom it sees whole .7 and
    more (two frames of a laboratory with a bystander)."""
    most: int = 12
    """People of one picture that are looked at, the largest first."""


@dataclass(frozen=True)
class LandmarkOptions:
    """How joints are read from the network of landmarks."""

    present: float = 0.5
    """Probability that the region shows a person, from which on somebody who is followed is there; MediaPipe's value."""
    new: float = 0.9
    """The same for somebody new, at every look: of 30 regions without a person in two frames of a laboratory three had more, of 28
    with one none had less at the second look."""
    expand: float = 1.25
    """Side of the region in diameters of the circle about the hips that holds the body; MediaPipe's value."""
    kernel: int = 7
    """Cells of the heatmap about a joint whose mean refines its place; MediaPipe's value."""
    sure: float = 0.5
    """Of the heatmap's best cell there, from which on it does; MediaPipe's value."""
    looks: int = 2
    """Times that a new person is looked at, each from the region that the look before gave: the detector's regions are rough."""


@dataclass(frozen=True)
class FollowOptions:
    """Who is followed from frame to frame; lengths are in radii: from the hips to the circle that holds the body, a bit more than
    half a person's height."""

    search: float = 0.5
    """Seconds after which the detector looks for further people, or for a larger one."""
    search_closer: float = 2.0
    """The same for looking closer, which takes some 20 looks, where somebody is followed, but fewer than are wanted."""
    larger: float = 1.5
    """Times that somebody must be larger than the smallest of those who are followed to take that place."""
    place: float = 0.5
    """Radii between hips, below which a detection is of somebody who is followed already."""
    alike: float = 0.3
    """Radii between joints, in the mean, below which two tracks sit on one person."""
    still: float = 0.1
    """Radii per frame, up to which a region stays where it was: motion that small is noise, and regions have a margin."""
    smallest: float = 12.0
    """Pixels: the side of a region in which nothing can be seen any more."""
    largest: float = 4.0
    """Longest sides of the picture, that a region spans at most."""


@dataclass(frozen=True)
class IdentityOptions:
    """Who is the same after being lost."""

    away: float = 2.0
    """Seconds, within which somebody who is lost and found is the same."""
    reach: float = 0.6
    """Radii between the joints then and now, in the mean, within which it is the same, after no time."""
    speed: float = 1.0
    """Radii per second by which that grows: a step to the side, not a run across the picture."""


@dataclass(frozen=True)
class PieceOptions:
    """How a long video is cut, the same however many workers there are: a piece is what an interruption costs at most."""

    seconds: float = 30.0
    """Of a piece.  Each begins at a key frame before it, so short ones cost decoding: with key frames 8 s apart, one of 30 s costs
    13 % more decoding, less than 1 % of the time that the larger network takes."""
    lead: float = 0.25
    """Seconds before a piece that are looked at, too, and not kept, so that its first regions come from landmarks."""


@dataclass(frozen=True)
class PoseOptions:
    """Everything that decides in :func:`indexing.pose.detect`."""

    detector: DetectorOptions = DetectorOptions()
    landmarks: LandmarkOptions = LandmarkOptions()
    follow: FollowOptions = FollowOptions()
    identity: IdentityOptions = IdentityOptions()
    pieces: PieceOptions = PieceOptions()
