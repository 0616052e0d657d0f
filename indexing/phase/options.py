"""What decides in PhaseIndexer: every number of its stages, by its name, with its unit and what was measured for it."""

from __future__ import annotations

from dataclasses import dataclass

from indexing.scoring import DecisionOptions


@dataclass(frozen=True)
class PhaseViewOptions:
    """The images that clips with depth are learned from."""

    turns: int = 8
    """Views of such a clip."""
    elevations: tuple[float, ...] = (0.05, 0.3)
    """Elevations of their cameras, radians, in turn."""
    mirror_windows: int = 500
    """Frames by which the joints' mirror images are told, at most."""


@dataclass(frozen=True)
class PeriodOptions:
    """Where in its action every training frame is, found from the clips themselves."""

    rate: float = 25.0
    """Samples per second at which clips are compared with themselves."""
    shortest: float = 0.3
    """Seconds that a period lasts at least."""
    longest: float = 4.0
    """Seconds that a period lasts at most."""
    deep: float = 0.65
    """An action repeats where the best piece of half its clips comes back to 1 - this correlation of the changes of pose: CMU walks
    .12-.3 and on uneven ground .3-.6, punches .2-.3, bending .2-.4; jumps on one leg .63-.78."""
    loose: float = 0.8
    """The same up to which pieces of such an action count their own period."""
    alike: float = 1.3
    """Times the best lag's, up to which lags are periods too; the shortest counts."""
    reach: int = 3
    """Samples to either side that a change of pose is measured over: slow turns of the person are none."""
    bins: int = 24
    """Of a mean cycle."""
    piece: float = 2.0
    """Periods of the pieces that become mean cycles."""
    local: float = 5.0
    """Seconds over which one period may hold."""
    slow: float = 0.5
    """Of the mean rate, at least, while a clip is followed through its cycle."""
    fast: float = 1.6
    """The same at most."""
    steps: int = 64
    """Phases of that path."""


@dataclass(frozen=True)
class CourseOptions:
    """How the shape of the joints goes through an action."""

    ridge: float = 1e-4
    """Of the mean diagonal of the normal matrix; 1e-5 is as good, 1e-3 costs .5 and 1e-2 4 degrees."""
    rounds: int = 30
    """Alternations from the mean shape."""
    again: int = 8
    """Alternations after every change of styles."""
    styles: tuple[float, ...] = (-0.7, 0.0, 0.7)
    """Styles of people; five from -1 to 1 give the same."""
    changes: int = 5
    """Changes of styles."""
    swing: float = 0.3
    """Share by which styles start as more and less motion."""
    styled: int = 4
    """Clips from which there are styles: fewer do not tell them apart."""
    grid: int = 96
    """Phases: 3.75 degrees apart; 192 changes the median error by less than .1 degree."""


@dataclass(frozen=True)
class PhaseLearningOptions:
    """What is kept of an action, and whether it is its own mirror image."""

    frames: int = 1500
    """Frames that an action's course is learned from: 600 costs .9 degrees of phase."""
    kept: int = 1000
    """Frames of an action that others are compared with, every one as all the cards below."""
    cards: tuple[float, ...] = (1.0, -1.0, 0.6, -0.6)
    """Widths of the image: a flat card turned about the vertical, and seen from behind; the turned ones take the AUC from one view
    per take from .970 to .982, 1.6 and .4 to .978."""
    rounds: tuple[int, ...] = (2, 3, 4)
    """Harmonics while phases are found: 58, 16, 20 and 11 degrees from the truth after none to three of them."""
    first_frames: int = 600
    """Frames for those."""
    mirror_harmonics: int = 3
    """Harmonics by which it is told whether an action is its own mirror image."""
    twin: float = 0.35
    """It is up to this part of the way from the frames' own residual to that at any phase, on a log scale: CMU gait .17-.2,
    punching, washing, bending .9-1.0; where all views are from one side gait too has .9-1 (nothing tells)."""


@dataclass(frozen=True)
class PhaseEvidenceOptions:
    """The evidence that one frame gives for each action."""

    nearest: int = 5
    """Frames of other actions that an action is held against: 1 costs .004 of the AUC."""
    near: int = 4
    """Steps of the grid, .04 of the course: frames this near in phase stand for a phase; twice as many cost .3 degrees."""
    mix: float = 0.5
    """Weight of the shape beside the nearest images: 0 / .5 / 1 give .867 / .957 / .946 AUC from one view per take."""
    lean: float = 0.1
    """Of perspective cameras: variance of what a frame of norm 1 leaves anyway, over that of the joints' relative depths."""
    fastest: float = 3.0
    """Cycles per second up to which neighbouring frames may go on, where phases are averaged over a window."""
    rates: int = 61
    """Rates tried, from backwards to forwards."""


@dataclass(frozen=True)
class PhaseEventOptions:
    """What seconds of an action find in the other actions: levels to refuse and to find by."""

    second: float = 1.0
    """Seconds of a recording that scores are averaged over before events are cut from them."""
    asked: int = 120
    """Such seconds asked, spread over all clips: bounds the time of calibration."""
    frames: int = 8
    """Frames asked of each."""
    classes: int = 3
    """Classes from which levels are calibrated: among two, leaving one out leaves nothing to be nearer to."""
    false_alarms: float = 0.1
    """Rate at which a wrong action may reach an event's peak.  Of ``find``, on streams of synthetic actions by other people in
    other views, 13 / 6 of them learned from six clips each: recall .67 / .80 at 7 / 14 % false finds (rate .05: .58 / .80 at none;
    .3: .78 / .80 at 15 / 37 %)."""
    extent: float = 1.7
    """Times that rate for the level that an event's ends reach."""
    least: tuple[float, float] = (0.3, 0.0)
    """Least level of an event's peak and ends; at 0 a frame is as near to other actions' frames as to its own."""


@dataclass(frozen=True)
class PhaseOptions:
    """Every number that decides in :class:`indexing.PhaseIndexer` besides its parameters, by stage."""

    views: PhaseViewOptions = PhaseViewOptions()
    period: PeriodOptions = PeriodOptions()
    course: CourseOptions = CourseOptions()
    learning: PhaseLearningOptions = PhaseLearningOptions()
    evidence: PhaseEvidenceOptions = PhaseEvidenceOptions()
    events: PhaseEventOptions = PhaseEventOptions()
    decisions: DecisionOptions = DecisionOptions()
