"""What decides in calibrate() of recordings besides what dyntorch.calibrate decides: every number, by stage, with its unit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from dyntorch import CalibrateOptions
from indexing.calibrate.people.options import AssociationOptions
from indexing.sync.options import SyncOptions


@dataclass(frozen=True)
class ViewOptions:
    """What is taken of the cameras' recordings."""

    cameras: int = 8
    """Cameras at most; two at least."""
    frames: int = 12
    """Frames of each camera that show somebody, at least: what clocks are found from."""
    joints: int = 8
    """Joints that every camera must share with another one, as for two layouts in ``synchronize``."""
    outside: float = 0.1
    """Of the picture's width or height, beyond which a joint is outside of it by far: detectors guess joints that are cut off
    (pose2sim, BODY_25B: none; RTMPose guesses up to .05)."""
    strays: float = 0.05
    """Share of the joints that may lie there before the size is wrong."""
    longest: float = 20.0
    """Times its frames that a recording's clock may run over."""
    longest_frames: int = 20_000
    """Frames that it may run over in any case."""
    longest_length: float = 100.0
    """Metres between two joints: nothing that is filmed whole is larger, and millimetres are."""


@dataclass(frozen=True)
class Share:
    """How high a joint of somebody who stands upright is, in body heights."""

    height: float
    spread: float


SHARES: Mapping[str, Share] = {
    "headtop": Share(1.0, 0.008),
    "eye": Share(0.936, 0.008),
    "eyeinner": Share(0.936, 0.008),
    "eyeouter": Share(0.936, 0.008),
    "ear": Share(0.930, 0.010),
    "headcenter": Share(0.930, 0.015),
    "nose": Share(0.915, 0.010),
    "mouth": Share(0.890, 0.010),
    "upperneck": Share(0.870, 0.015),
    "neck": Share(0.818, 0.012),
    "neckbase": Share(0.830, 0.015),
    "thorax": Share(0.818, 0.015),
    "shouldercenter": Share(0.818, 0.015),
    "spineshoulder": Share(0.818, 0.015),
    "shoulder": Share(0.818, 0.012),
    "ankle": Share(0.039, 0.006),
    "foot": Share(0.020, 0.010),
    "heel": Share(0.015, 0.008),
    "bigtoe": Share(0.010, 0.006),
    "smalltoe": Share(0.010, 0.006),
    "footindex": Share(0.010, 0.008),
}
"""Levels of eye, chin, shoulder, ankle and top of the head: Drillis and Contini (1966), as in D. A. Winter, Biomechanics and Motor
Control of Human Movement, figure 4.1.  Ear, nose, mouth, heel and toes lie between these by the proportions of the face and
the foot; the spread of a level between adults is about 0.6 % of the height, the rest is what detectors are off."""


@dataclass(frozen=True)
class StatureOptions:
    """How the standing height of a person becomes a length between joints."""

    shares: Mapping[str, Share] = field(default_factory=lambda: SHARES, hash=False)
    """By the joint's name without its side, in small letters."""
    smallest: float = 0.4
    """Metres: nobody who is filmed standing is smaller."""
    tallest: float = 2.6
    """Metres: nobody was ever taller than 2.72, and 2.6 is a slip."""
    least: float = 0.6
    """Body heights between the highest and the lowest joint, for the height to say anything of them."""
    straight: float = 0.97
    """Of the length of trunk and leg, that the shoulders are above an ankle of somebody who stands: 14 degrees off the vertical."""
    frames: int = 10
    """Frames at least in which somebody stands straight, or is seen from head to foot."""
    chain_sigma: float = 0.03
    """Of the height by the lengths of trunk and legs alone: 2.7 % off for Pose2Sim's balancing person (1.72 m), who never stands
    straight, where the way from feet to head is 6 % off."""
    extent: float = 0.75
    """Quantile of the way from feet to head, where nobody knows trunk and legs."""


@dataclass(frozen=True)
class SideOptions:
    """When a camera shows left as right: see :func:`indexing.calibrate.sides.sides`."""

    sigma: float = 0.015
    """Body sizes (diagonals in the picture): how far a joint is from where the other cameras see it; 6 to 8 px of 450."""
    freedom: float = 3.0
    """Degrees of freedom of Student's t for these distances: detectors have outliers."""
    most: float = 8.0
    """Nats that one joint of three cameras says at most."""
    joints: float = 3.0
    """Joints' worth of independent evidence in one limb: its joints are exchanged, and off, together."""
    lasting: float = 0.1
    """Seconds within which frames say the same."""
    triples: int = 20
    """Threes of cameras that are looked at; of 7 and 8 cameras every second or third one."""
    exchanged: float = 0.5
    """Nats per second of an exchanged camera: fewer exchanges are likelier."""
    alone: float = 1.0
    """Nats per second of a limb that is exchanged and the body is not, or the other way round."""
    change: float = 4.0
    """Nats of a change in one camera: what keeps single frames from flickering."""
    nearest: float = 0.6
    """Frames from a moment within which a camera's frame stands for it."""
    told: float = 0.2
    """Seconds of a tie from which on it is said."""


@dataclass(frozen=True)
class RigOptions:
    """Every number that decides in :func:`indexing.calibrate.calibrate`, by stage."""

    views: ViewOptions = ViewOptions()
    stature: StatureOptions = StatureOptions()
    recordings: SyncOptions = SyncOptions()
    """How recordings are read: those of ``synchronize``."""
    people: AssociationOptions = field(default_factory=AssociationOptions)
    """Who is who in all cameras, where several people are in view."""
    cameras: CalibrateOptions = field(default_factory=CalibrateOptions)
    """Those of :func:`dyntorch.calibrate`."""
    sides: SideOptions = field(default_factory=SideOptions)
    """Left and right, where a detector exchanges them."""
