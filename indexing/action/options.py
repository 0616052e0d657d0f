"""What decides in ActionIndexer: every number of its stages, by its name, with its unit and what was measured for it."""

from __future__ import annotations

from dataclasses import dataclass

from indexing.recordings.options import ExplanationOptions, LiveOptions
from indexing.scoring import DecisionOptions
from indexing.windows import RepairOptions


@dataclass(frozen=True)
class ExemplarOptions:
    """What is kept of the clips that an indexer learns from."""

    crops: tuple[tuple[float, float], ...] = ((0.0, 1.0), (0.0, 0.85), (0.15, 1.0), (0.1, 0.9), (0.0, 0.7), (0.3, 1.0))
    """Begin and end of the crops of an exemplar, in parts of its duration: extent and tempo search; the first is all of it."""
    views: int = 4
    """Virtual views per exemplar: of cards 8 give no more than 4."""
    views_solid: int = 12
    """The same where exemplars have depth: 12 give +1 % over 4."""
    edge: float = 0.12
    """Part of its duration up to which a virtual view also loses at each end."""
    elevation: float = 0.1
    """Elevation of the virtual cameras around 3D exemplars, radians."""
    elevation_spread: float = 0.15
    """Its standard deviation, radians."""
    pitch: float = 0.1
    """Standard deviation of the pitch of turned cards, radians."""
    moment: float = 0.5
    """Of the duration of an ordinary exemplar: how long a short window lasts at most, so that one holds less than the action."""
    recurrence_steps: int = 96
    """Steps in which an exemplar is compared with itself: eight of each cycle where it holds twelve."""
    touching: int = 2
    """Steps apart (one step is smoothed into the next) whose autocorrelation only noise keeps from 1: with 15 mm of it on every
    joint a jog of exercises repeats itself to .48, measured by these to .74; what is performed once stays below .36."""
    fallen: float = 0.3
    """Autocorrelation below which a movement has left the pose that it may come back to."""
    unexplained: float = 0.01
    """Share of the energy that one rigid space-time shape may leave unexplained, for views of one performance to become a 3D clip.
    On synthetic people a detector's noise leaves .002-.005, views that lag by .3 s .006-.04, views of another action .01-.05."""


@dataclass(frozen=True)
class MirrorOptions:
    """Which joints are each other's mirror image, and which actions stay the same in the mirror."""

    windows: int = 500
    """Exemplars by whose distances between joints a layout is told, at most."""
    distortion: float = 0.25
    """Of the mean joint distance: the right layout fits to .02-.12 (one clip: .25), wrong ones to .34-.71."""
    shuffles: int = 20
    """Random layouts by which it is told what fits by chance."""
    chance: float = 0.5
    """Of their mean distortion, which the right layout stays below."""
    mutual: float = 0.5
    """Share of the mirror images of two classes that must be nearest to the other one for neither to be mirrored."""


@dataclass(frozen=True)
class NearestOptions:
    """Scorer A: the nearest exemplars under the fused epipolar residual."""

    whitening: float = 0.25
    """Power of the joint metric: UTKinect .909 -> .919, few shots +3 %; .5 whitens too much."""
    floor: float = 0.1
    """Added to the joints' covariance of mean diagonal 1; .03 amplifies noise (-2 %), 1 whitens too little (-1 %) on UTKinect and
    Florence3D."""
    turned: float = 0.3
    """Weight of turned cards: one shot +1.3 %, Florence3D +.8 %; .6 is too much."""
    neighbours: int = 2
    """Exemplars per class that are averaged (1: -1 %)."""
    hub_share: float = 0.5
    """Share of an exemplar's closeness to other classes that is taken off: +2..3 %, one shot +4 %."""
    hub_neighbours: int = 5
    """Nearest windows of other classes by which that closeness is measured."""
    moments: int = 500
    """Short windows whose closeness to others sets the hub shares, and the levels of events."""
    classes: int = 4
    """Classes from which evidence compares the best with the others: with fewer there is nothing for it to stand out from."""
    profile: float = 2.5
    """Weight of how unusual the profile of class scores is, in evidence.  AUROC at 0 / 90 degrees, UTKinect and Florence3D: without
    .755 / .719, .832 / .778; 2: .849 / .817, .867 / .841; 2.5: .856 / .824, .867 / .841; 4: .868 / .835, .861 / .836."""
    profile_floor: float = 0.3
    """Added to the variances of profiles, in parts of them: .1 gives .862 / .825, .867 / .843, 1 gives .848 / .818, .865 / .838."""


@dataclass(frozen=True)
class MachineOptions:
    """Scorer B: a kernel machine over virtual views of the exemplars."""

    penalty: float = 10.0
    """C of the support vector machine; 2 and 30 differ by less than 1 % on UTKinect, Florence3D and JHMDB."""
    whitening: float = 0.0
    """Power of the joint metric: .15 gives UTKinect +1 %, takes 1 % from Florence3D."""
    width: float = 0.5
    """Of a kernel, over the median distance; 1 costs 1-2 %."""
    scale_windows: int = 600
    """Windows whose distances set the kernel scales: their median is stable to 1 % from 300 on."""
    rows: int = 3000
    """Training rows at most: the fit grows with their square."""
    rows_solid: int = 5000
    """The same where exemplars have depth: true views are worth more."""


@dataclass(frozen=True)
class BlendOptions:
    """How the scorers are weighed, and how sure their sum is."""

    balance: float = 1.5
    """Weight of A against B after standardizing over classes; 1 .. 2 differ by 1 %."""
    balance_solid: float = 0.5
    """The same for exemplars with depth: B then sees true views (1.5: -1.5 % on Florence3D, UTKinect +-0)."""
    blends: tuple[tuple[float, float], ...] = ((1.0, 0.0), (1.0, 0.25), (1.0, 0.5), (1.0, 1.0), (1.0, 1.5), (1.0, 3.0), (0.0, 1.0))
    """Weights of B and A among which those are chosen that serve left-out people best."""
    sharpnesses: tuple[float, ...] = tuple(float(2 ** (k / 4)) for k in range(-4, 17))
    """Sharpnesses among which the most likely is chosen: .5 to 16."""
    enough: int = 8
    """Examples per class from which the blend is learned: chosen from 5 on UTKinect it costs 1 to 2 % (.90 to .91 for .92)."""
    folds: int = 5
    """Groups of people whose machines are trained."""
    views: int = 4
    """Virtual views asked per exemplar, besides the image itself."""
    noise: float = 0.01
    """Of the body height, on asked views: without it the kernel machine looks too good."""


@dataclass(frozen=True)
class JointWeightOptions:
    """Which joints and channels count how much, where weights are learned."""

    candidates: int = 2
    """Nearest exemplars per class that a query is compared with: as many as the scorer averages."""
    pulls: tuple[float, ...] = (1.0, 0.3, 0.1, 0.03)
    """Pulls towards equal weights that are tried, strongest first."""
    steps: int = 40
    """Of Adam; stopping early pulls, too: with junk joints 80 steps win .27, 40 win .34."""
    rate: float = 0.1
    """Its rate at the start, which falls to 0."""
    sharp: float = 1.0
    """Logarithm of the sharpness at the start."""
    folds: int = 4
    """Parts of the groups, each held out once."""
    sigmas: float = 1.0
    """Standard errors over groups by which learning must beat equal weights where it has not seen the people."""
    rounds: int = 2
    """Rounds of finding the nearest exemplars and learning the weights."""
    queries: int = 200
    """Queries at most."""
    entries: int = 60_000
    """Queries x classes x joints at most: 3.5 s of one core, 7 s where it learns."""


@dataclass(frozen=True)
class ImportanceOptions:
    """Which joints matter for which action, read off a fitted model."""

    halves: int = 4
    """Random halves per joint: importances from two seeds then correlate by .83-.98 on UTKinect (clapping: .60)."""
    least_halves: int = 32
    """Halves at least."""
    most_halves: int = 200
    """Halves at most."""
    queries: int = 120
    """Exemplars that are asked at most."""
    ridge: float = 1.0
    """Of the regression on 0/1 masks, in masks: matters only where there are more joints than halves."""


@dataclass(frozen=True)
class EventOptions:
    """The short windows along a recording, and when a person rests."""

    step: float = 0.2
    """Seconds between the short windows of a recording; .1 is as good (frames of exercises, actors, UTKinect: +-.002)."""
    shown: float = 0.3
    """Share of a window's frames that must show the person."""
    margin: float = 2.0
    """Seconds of frames on both sides of a block from which missing joints are interpolated."""
    still: float = 0.25
    """Quantile of the motion of all exemplars' short windows: who moves less is still, as actions go."""
    calm: float = 0.1
    """Quantile of the motion of one action's short windows: who moves less than its calm ones rests."""


@dataclass(frozen=True)
class BackgroundOptions:
    """What is not the action, where one action is learned alone or a background is given."""

    people: int = 2
    """Synthetic people who perform other actions."""
    views: int = 2
    """Cameras that see each of their performances."""
    exchanges: int = 2
    """Times that the clip is played with the movement of each joint done by another one."""
    alike: float = -9.5
    """Residual to the nearest synthetic people of a kind below which it may be the action itself: of 13 actions the same one by
    others stands at -10 to -16, a different one at -3.6 to -9.9."""
    replayed: float = -12.0
    """The same of clips played otherwise, which share body and camera: backwards, what is symmetric in time stands at -14 to -19
    (the jumping jack at -9), what is not at -6 to -11.7."""
    pieces: int = 60
    """Pieces of recordings given as background, at most: evenly spread."""
    parts: int = 6
    """Kinds that the pieces of one recording make, at most."""
    shown: float = 0.5
    """Share of a piece's frames that must show the person."""
    false_alarms: float = 0.1
    """Rate that is asked for where one action is learned and nothing is said."""


@dataclass(frozen=True)
class ActionOptions:
    """Every number that decides in :class:`indexing.ActionIndexer` besides its parameters, by stage."""

    exemplars: ExemplarOptions = ExemplarOptions()
    mirror: MirrorOptions = MirrorOptions()
    nearest: NearestOptions = NearestOptions()
    machine: MachineOptions = MachineOptions()
    blend: BlendOptions = BlendOptions()
    joints: JointWeightOptions = JointWeightOptions()
    importance: ImportanceOptions = ImportanceOptions()
    events: EventOptions = EventOptions()
    background: BackgroundOptions = BackgroundOptions()
    recordings: ExplanationOptions = ExplanationOptions()
    live: LiveOptions = LiveOptions()
    decisions: DecisionOptions = DecisionOptions()
    repair: RepairOptions = RepairOptions()
