"""What decides in BrightnessIndexer: every number of its stages, by its name, with its unit and what was measured for it."""

from __future__ import annotations

from dataclasses import dataclass

from indexing.scoring import DecisionOptions


@dataclass(frozen=True)
class RateOptions:
    """Videos of other frame rates."""

    same: float = 0.01
    """Relative difference of frame rates that is none (29.97 and 30)."""
    pause: float = 10.0
    """Seconds without a frame for which none are interpolated: what a video costs is told by its frames."""


@dataclass(frozen=True)
class MotionMapOptions:
    """How much moves right, left, down and up, pixel by pixel."""

    sigma: float = 1.2
    """Blur, pixels of the work image (80 pixels wide)."""
    quiet: float = 0.004
    """Grey 0..1 per frame below which brightness change is noise (theory: .004; .008 at sensor noise 3/255)."""


@dataclass(frozen=True)
class MotionBoxOptions:
    """The box where somebody has moved of late."""

    memory: float = 20.0
    """Seconds over which motion is forgotten; 10: .007 fewer of the frames of exercises."""
    lively: float = 0.006
    """Grey 0..1 per frame: less does not widen the box."""
    inside: tuple[float, float] = (0.02, 0.98)
    """Quantiles of the motion that a box encloses."""
    pad: float = 0.15
    """Of the box, added on each side."""
    near: float = 0.35
    """Of the image's height: the smallest box about what moves."""


@dataclass(frozen=True)
class DescriptorOptions:
    """The descriptor of a frame."""

    soft: float = 0.005
    """Added to its norm: noise frames stay near 0 instead of being blown up."""
    shares: tuple[float, float, float, float] = (0.25, 0.07, 0.48, 0.2)
    """Of the cells about what moves, of those of the image, and of the row profiles of body and image, in the likeness of two
    frames.  Chosen on films of exercises by another person, camera turned 0 / 60, with seeds 0, 3, 7 of
    :mod:`experiments.recognition.brightness_indexing`, and on arm raises of another person (moving frames; videos of 126 recognized
    when shifted, scaled, stretched or cropped): .25 .07 .48 .2: .821 .829 .828 / .751 .722 .786, .963, 119; .3 .1 .5 .1: .822 .830
    .829 / .739 .691 .775, .960, 120; .2 .1 .6 .1: .811 .823 .829 / .756 .746 .786, .967, 120; with nothing of the image, .35 0 .65
    0: .821 / .719 (seed 0), .964, 125; the image alone: .812 / .779 (seed 0), .939, 100."""
    kept: int = 96
    """Principal directions in which frames are compared: all of 560 cost 4.3 ms per frame and 20,000 rows, these .2 ms.  Frames
    named rightly (shares .3 .1 .5 .1), exercises at 0 / 60, arm raises: 560: .822 .744 .962, 128: .821 .746 .962, 64: .821 .745
    .960, 32: .821 .745 .950."""


@dataclass(frozen=True)
class MatchingOptions:
    """A video against the exemplars, as its frames come in."""

    window_frames: float = 5.0
    """Frames of the window at least: of exercises at 15 per second, 0 / 60 degrees, 3 name .816 / .690 of the frames, 5 .821 /
    .751."""
    slack: float = 0.02
    """Price of a step other than 1."""
    sharp: float = 20.0
    """Of the mean over frames: moments that fit an exemplar well count more than many that fit somewhat.  Frames named rightly in
    exercise streams, camera turned 0 / 60: the mean itself .76 / .59, sharpness 12 .80 / .62 (cells alone)."""
    cold: float = 1e-3
    """Weight of a video's first window in its score: the warping has seen too little, but a short video has nothing else."""
    fewest: int = 3
    """Frames of an exemplar at least."""
    moves: float = 0.1
    """Energy of a frame in which anything moves."""


@dataclass(frozen=True)
class PixelEventOptions:
    """Levels for rejecting and for events, and whether left and right are different actions."""

    asked: int = 64
    """Exemplars asked at most: bounds the time of calibration."""
    quiet: float = 0.7
    """Of a frame's energy, below which nothing moves."""
    least: float = 0.02
    """Contrast that an event needs: two or three classes have little to stand out from."""
    false_alarms: float = 0.3
    """Rate at which a wrong action may reach an event's peak."""
    extent: float = 1.7
    """Times that rate for the level that an event's ends reach."""
    clear: float = 0.02
    """Of the score: mirrored exemplars that look that much more like another action make left and right matter."""


@dataclass(frozen=True)
class BrightnessOptions:
    """Every number that decides in :class:`indexing.BrightnessIndexer` besides its parameters, by stage."""

    rate: RateOptions = RateOptions()
    maps: MotionMapOptions = MotionMapOptions()
    box: MotionBoxOptions = MotionBoxOptions()
    descriptor: DescriptorOptions = DescriptorOptions()
    matching: MatchingOptions = MatchingOptions()
    events: PixelEventOptions = PixelEventOptions()
    decisions: DecisionOptions = DecisionOptions()
