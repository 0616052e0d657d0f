"""What decides how a long recording is explained: every number by its name, with its unit and what was measured for it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ExplanationOptions:
    """The quality of segments, and what they compete with.

    Chosen together on joined clips of UTKinect and Florence3D, on the exercise streams and on synthetic actors, seen from 0 and 90
    degrees: all figures lie on a broad plateau (halving or doubling one weight changes the frames that are right by less than .02
    where nothing else is said).  Frames right with these / without the moments: UTKinect .84 / .73, exercises .90 / .38.
    """

    step: float = 6.0
    """Steps that the shortest action (median of its exemplars) is divided into: segments begin and end at such steps."""
    coarsest: float = 0.1
    """Seconds of a step, at most; .2 costs .03 of the frames of synthetic actors seen from the side."""
    ratio: float = 1.12
    """Between neighbouring durations of the windows that are looked through.  1.25 takes a third less time, and costs .02 of the
    frames of exercises, .01 / .03 of Florence3D at 0 / 90 degrees."""
    many: int = 300
    """Exemplars up to which durations lie so close; of more, every other one is looked through, for the time it takes."""
    reach: float = 0.8
    """Times the shortest exemplar (and the longest, divided by it): the durations of windows."""
    strange: float = 3.0
    """Times longer or shorter than is usual for its class, from which an exemplar is not compared as a whole.  A label that holds
    more than the action, as one of UTKinect's, swallows whole recordings."""
    durations: int = 24
    """At most; of exemplars that differ more the ratio grows."""
    tempo: float = 2.0
    """Times longer or shorter than an exemplar up to which a window is compared with it."""
    spread: float = 0.35
    """Standard deviation of log durations around each exemplar of a class."""
    unlikely: float = 1e-6
    """Least likelihood of a duration."""
    whole: float = 1.0
    """Weight of the nearest whole exemplars."""
    machine: float = 0.8
    """Weight of the kernel machine (UTKinect without it: .813 for .843)."""
    moments: float = 1.25
    """Weight of short windows of the exemplars."""
    duration: float = 0.5
    """Weight of the log likelihood of a segment's duration; 0 costs .02 on UTKinect."""
    entry: float = 1.0
    """What beginning a segment costs."""
    background: float = 3.0
    """Quality that a segment must exceed to be told from no action at all."""
    rest: float = 4.0
    """Added to that where the person moves e times less than calm moments of the action, taken off where e times more.  F1 of
    actors who rest 2 to 7 s between actions, camera turned by 60 degrees: 3: .79, 4: .85, 6: .90, but then Florence3D loses .02."""
    absent: float = 8.0
    """Quality that is taken off where nobody is seen."""
    temperature: float = 0.15
    """Of the posterior of frames; best explanations alone (0) are as good for frames of most sets."""
    survive: float = 3.0
    """How much worse than the best explanation one with a given window may be for the window to be asked of the kernel machine."""
    cyclic: tuple[float, float] = (0.35, 0.65)
    """Autocorrelation of an exemplar with itself a cycle later, from which its class counts as cyclic, and fully so: .7 to .9 for
    jumping jacks, waves and squats in a row; .3 for what is performed once."""
    cyclic_moments: float = 2.0
    """Times more (plus one) that short windows count for cyclic actions, which have no begin and end to be aligned.  Frames right
    at 0 / 90 degrees, exercises and actors: 1: .89 / .80, .99 / .99; 2: .90 / .87, .98 / .97; 3: .89 / .89, .96 / .91."""
    cyclic_whole: float = 0.75
    """Share of the weight of whole exemplars that they lose."""
    joined: float = 0.5
    """How cyclic (0..1) a class must be for segments that touch to be one."""
    seam: float = 2.0
    """Times farther from the first and the last pose of the exemplar than from one within, from which the pose between two segments
    is none that the action begins or ends with.  Between bows, kicks, lunges, squats, throws of other people: .3 to 1.2; between
    the blows of a bout of punches: 3.7 to 3.9."""
    neighbours: int = 2
    """Exemplars per class that are averaged."""
    least: float = 1e-6
    """Likelihood whose logarithm is the least score of a frame."""
    faint: float = 1e-16
    """Likelihood down to which classes are still ranked where hardly anything is likely: the rounding of sums."""
    shade: float = 1e-3
    """Of the logarithm of such faint likelihoods, which ranks them."""
    edge: float = 1e-6
    """Seconds: a frame on an edge belongs to the cell behind it, however its time was rounded."""


@dataclass(frozen=True)
class LiveOptions:
    """How a recording is explained while it is being recorded."""

    block: float = 0.5
    """Seconds of frames that are looked at together: a part of the lag."""
    horizon: float = 1.25
    """Of the usual duration of the longest action: so much of what follows a moment is looked at before it is decided.  With half
    of it long actions are not found.  F1 of events, thirteen synthetic actions at 0 / 60 degrees, exercises at 0 / 90: 1: .94 /
    .91, .77 / .64; 1.25: .93 / .90, .79 / .69; 2: .93 / .89, .79 / .72; recordings that are known as a whole: .93 / .89,
    .79 / .77."""
    memory: float = 300.0
    """Seconds by which levels of scores are told, at most: cameras and people change."""
    recent: int = 30
    """Steps between the latest frames by which it is told that frames are too far apart for any window."""


@dataclass(frozen=True)
class SuggestOptions:
    """Which parts of recordings are worth a person's time, measured by ``experiments.labels.suggesting``."""

    candidates: int = 600
    """Parts that are compared with each other, at most, spread evenly over the recordings: some 2 s for all pairs."""
    shortest: float = 1.0
    """Seconds of a part of what nothing explains, at least: of less nobody can say what it is."""
    longest: float = 2.0
    """Times an ordinary example, beyond which what was found is cut into parts: a wrong find may hold several actions."""
    labelled: float = 0.3
    """Share of a part that is labelled already, from which on it is not suggested again."""
    still: float = 0.5
    """Times the motion of still moments of the examples: where nobody moves more there is nothing to name."""
    shown: float = 0.5
    """Share of a part's frames that must show the person."""
    alike: bool = True
    """Whether a part counts for all that is like it, or for itself alone (farthest first), which finds oddities: frames right after
    4 / 8 / 16 labels of actors .62 / .67 / .76, alone .60 / .60 / .64."""
    unsure: float = 0.3
    """How much more a part counts between two actions (margin 0) than where the action is sure (margin 1).  Doubt alone teaches
    little.  Frames right after 4 / 8 / 16 labels, exercises and actors, three repetitions, which differ by .04 to .1: with 0 .54 /
    .68 / .75 and .61 / .67 / .75, with .3 .53 / .62 / .71 and .62 / .67 / .76; any parts .42 / .55 / .74 and .55 / .63 / .74."""
    far: float = 0.33
    """Of the residual between examples of different actions, from which on the reason that is given is that a part is unlike all of
    them.  Actors: the actions that are known stand at .03 to .05 of it, others at .45 to .6."""
    doubt: float = 0.5
    """Margin, as a difference of probabilities, below which the reason that is given is that it may be either of two."""
