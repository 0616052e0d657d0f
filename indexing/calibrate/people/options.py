"""What decides who is who in the cameras: every number, by stage, with its unit."""

from __future__ import annotations

from dataclasses import dataclass

from dyntorch import SynchronizeOptions


@dataclass(frozen=True)
class TrackletOptions:
    """How the tracks of one camera are cut into pieces of surely one person."""

    seen: int = 4
    """Joints that make a detection."""
    joints: float = 5.0
    """Joints' worth of independent evidence in the way of a body from frame to frame: joints of one body move together."""
    clear: float = 6.0
    """Nats by which two people are told apart from one frame to the next."""
    limit: float = 12.0
    """Nats that a way costs which is no more likely than that one is lost and another one is new."""
    jump: float = 0.5
    """Body sizes (diagonals of a box) that somebody goes from one frame to the next at most."""
    roam: float = 1.0
    """Those added per second without a sighting."""
    least_step: float = 0.005
    """Body sizes: the usual way of a joint from frame to frame is taken as no less: detections without noise are no certainty."""
    hold: float = 0.2
    """Seconds that somebody may be unseen within one piece."""
    bridge: float = 1.0
    """Seconds between two pieces that may be one person, by where that one went."""
    astray: float = 0.75
    """Power of the frames between two pieces by which the way grows that is expected: .5 for random walks, 1 for a wrong speed."""
    link: float = 3.0
    """Nats: the most that the place of a piece says about what it goes on as."""
    same: float = 0.3
    """Nats that the number of the tracker adds: it swaps people in half of the encounters where nothing else tells, either."""
    smooth: float = 0.3
    """Share of the last step in the speed of a body."""
    common: int = 8
    """Joints of the same name that all cameras must have, as in ``synchronize``."""


@dataclass(frozen=True)
class EpipolarOptions:
    """Clock and epipolar geometry of two cameras, and what a distance says about two people."""

    nearest: float = 0.6
    """Frames from a moment within which a detection stands for it."""
    between: float = 2.5
    """Frames between two detections that are interpolated at most."""
    spread: float = 0.1
    """Body sizes: how far two people are from each other's epipolar lines."""
    joints: float = 4.0
    """Joints' worth of independent evidence in one body: its joints are off together."""
    lasting: float = 0.1
    """Seconds within which frames say the same."""
    frames: int = 150
    """Frames at which two cameras are compared at most while their relation is searched."""
    rounds: int = 4
    """Times that people are matched and the relation is fitted to them."""
    reweighted: int = 2
    """Steps of reweighted least squares each time."""
    gain: float = 0.01
    """Share by which a round must be better than the last one to go on."""
    matches: int = 60
    """Points that a relation is fitted to at least."""
    finest: float = 0.05
    """Pixels: distances are never taken as more exact."""
    first_sigma: float = 0.02
    """Body sizes: how exact the relation of two people is taken for everybody at first."""
    seeds: int = 3
    """Pieces of each camera that are compared to find a relation."""
    shortest: float = 0.8
    """Seconds that such a piece lasts at least."""
    fewest: int = 12
    """Frames that :func:`dyntorch.synchronize` takes at least."""
    explained: float = 0.75
    """Share of the people who could have a partner that have one, from which a relation is not searched further."""
    sure_sigma: float = 0.015
    """Body sizes that its distances are at most then: .008 to .010 with 6 px of noise; of two different people, whom a relation of
    their own can fit, .03 (pose2sim)."""
    odd_sigma: float = 0.03
    """Body sizes that the distances of a pair of cameras are at most, for it to take part besides those that were searched."""
    related: float = 10.0
    """Nats for everybody together from which two cameras show the same people."""
    people: int = 2
    """People by whom the clocks are found together: those who are seen longest."""
    ties: int = 3
    """Pairs by which every camera's clock is held, where there are as many."""
    agree: float = 1.0
    """Frames that clocks found by everybody may be off those found by two people, where they are not decided."""


@dataclass(frozen=True)
class ClusterOptions:
    """How pieces are sorted into people."""

    sweeps: int = 20
    """Times that every piece is asked whether it belongs elsewhere."""
    gain: float = 1e-6
    """Nats that an exchange gains at least."""
    rounds: int = 6
    """Times that people are sorted and relations fitted to them."""
    cuts: int = 3
    """Times that pieces are cut where other cameras see two people in them."""
    split: float = 6.0
    """Nats on both sides of such a cut."""
    shortest: float = 0.3
    """Seconds that a person is seen by two cameras at least."""


@dataclass(frozen=True)
class AssociationVerdictOptions:
    """When identities are decided, and what is said."""

    frames: int = 60
    """Frames at which two people are exchanged to see whether they fit as well."""
    points: int = 1000
    """Points by which relations are fitted then."""
    steps: int = 4
    """Steps of reweighted least squares then."""
    partners: int = 3
    """Cameras that a camera is compared with then: those with which it has most people in common."""
    later: tuple[float, ...] = (-1.7, -1.1, -0.6, 0.6, 1.1, 1.7)
    """Seconds by which a camera is shifted to see whether its people fit at any time."""
    ahead: float = 0.55
    """Share by which they must fit better now than at the middle one of these times: on virtual rigs the same people do by .69 to
    .96, others by .24 at most where the clocks are known, and by .51 where the best clock was searched."""
    margin: float = 10.0
    """Nats that they must fit worse then."""
    left: float = 0.02
    """Share of the detections that are nobody from which on it is said."""
    listed: int = 4
    """Moments in a note."""


@dataclass(frozen=True)
class AssociationOptions:
    """Every number that decides who is who, by stage."""

    pieces: TrackletOptions = TrackletOptions()
    geometry: EpipolarOptions = EpipolarOptions()
    clusters: ClusterOptions = ClusterOptions()
    verdict: AssociationVerdictOptions = AssociationVerdictOptions()
    points: SynchronizeOptions = SynchronizeOptions()
    """Those of :func:`dyntorch.synchronize`."""
