"""A large archive of people whose every moment is known: captured takes, and takes that were never performed, filmed by anybody.

Thirty takes are too few to get lost in, so most of an archive are *distractors*: people put together of the lower body of one take
and the upper body of another, each at a tempo of its own that wanders, either mirrored or not, turned to the same side, with limbs
of other lengths.  They move as people do and share half a body with a right answer, at another time.  Every recording is filmed by
a camera of its own: from anywhere around, a little from above or below, with noise on every joint.

Source of the takes: mocap.cs.cmu.edu (NSF EIA-0196217).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np

from experiments.recognition.protocol import Array, data_folder
from indexing import Clip
from indexing.skeleton import Skeleton, from_names

FILE = "cmu_mocap_60fps.npz"
CAPTURED, FPS = 60.0, 30.0  # frames per second of the takes, and of what is filmed
HEIGHT = 1.5  # metres to which people are scaled, as :func:`indexing.cameras.virtual` does
WAIST = "upperback"  # from here on a skeleton is the upper body
HIPS = "lhipjoint", "rhipjoint"
JOINTS = (
    *("head", "lowerneck", "thorax", "lhumerus", "lradius", "lhand", "rhumerus", "rradius", "rhand", "root"),
    *("lhipjoint", "rhipjoint", "lfemur", "ltibia", "lfoot", "ltoes", "rfemur", "rtibia", "rfoot", "rtoes"),
)
"""What a camera sees of the 31 that were captured."""


@dataclass(frozen=True)
class Takes:
    """Captured people: ``takes``, each ``(frames, joints, 3)`` metres, y up, and the tree of their joints.

    parents: of each joint, -1 at the root, before its children; twins: of each joint the one on the other side, or itself.
    """

    takes: tuple[Array, ...]
    joints: tuple[str, ...]
    parents: tuple[int, ...]
    twins: tuple[int, ...]

    @property
    def seconds(self) -> Array:
        """``(takes,)`` from the first frame to the last."""
        return np.array([(len(take) - 1) / CAPTURED for take in self.takes])

    @property
    def skeleton(self) -> Skeleton:
        """Of what a camera sees: every joint to the nearest of its ancestors that is seen."""
        bones = []
        for joint in JOINTS:
            above = self.parents[self.joints.index(joint)]
            while above >= 0 and self.joints[above] not in JOINTS:
                above = self.parents[above]
            bones += [(self.joints[above], joint)] if above >= 0 else []
        return from_names("cmu20", JOINTS, bones)


@dataclass(frozen=True)
class Cameras:
    """Where cameras stand: anywhere around, radians above the horizon with their spread, and degrees of roll, to either side."""

    above: float = 0.1
    spread: float = 0.15
    roll: float = 0.0
    distance: float = 4.5
    """Metres from the middle of the movement, at least."""
    nearest: float = 2.5
    """Metres that nobody comes nearer than: the camera stands further back where the person walks far."""
    noise: float = 0.015
    """Metres, of every coordinate in space."""


CEILING = Cameras(above=np.deg2rad(60.0), spread=0.0)
ROLLED = Cameras(roll=30.0)


# ---- people ------------------------------------------------------------------------------------------------------------
def captured() -> Takes:
    """The takes of the data folder.

    Raises:
        ValueError: no data folder, or the takes are not in it.
    """
    path = data_folder() / FILE
    if not path.is_file():
        raise ValueError(f"{path}: no such file; it holds the captured takes, so that people can be put together of them")
    return _read(path)


@cache
def _read(path: Path) -> Takes:
    with np.load(path, allow_pickle=False) as file:
        joints, ends = file["joints"].astype(np.float64), file["offsets"].tolist()
        names, parents = tuple(str(name) for name in file["joint_names"]), tuple(int(p) for p in file["parents"])
    takes = tuple(joints[start:end] for start, end in pairwise(ends))
    return Takes(takes, names, parents, tuple(_twin(names, name) for name in names))


def _twin(names: tuple[str, ...], name: str) -> int:
    other = {"l": "r", "r": "l"}.get(name[0], name[0]) + name[1:]
    return names.index(other if other in names else name)


def invented(people: Takes, rng: np.random.Generator) -> Array:
    """``(frames, joints, 3)`` at FPS of somebody put together of two takes, as long as the shorter one."""
    first, second = rng.choice(len(people.takes), 2, replace=False)
    lower, upper = people.takes[first], people.takes[second]
    count = max(2, round(min(people.seconds[[first, second]]) * FPS))
    halves = []
    for take in (lower, upper):
        bones = bones_of(resampled(take, wandering(len(take), count, rng)), people.parents)
        halves.append(bones[:, people.twins] * [-1.0, 1.0, 1.0] if rng.random() < 0.5 else bones)
    bones, above = halves
    turn = facing(bones, people) - facing(above, people)
    waist = people.joints.index(WAIST)
    mine = [joint for joint in range(len(people.joints)) if waist in ancestry(joint, people.parents)]
    bones[:, mine] = turned(above, turn[:, None])[:, mine]
    lengths = np.exp(rng.normal(0.0, 0.12, len(people.joints)))
    lengths = (lengths + lengths[list(people.twins)]) / 2
    bones[:, 1:] *= lengths[1:, None]
    return joints_of(bones, people.parents)


def wandering(frames: int, count: int, rng: np.random.Generator) -> Array:
    """``(count,)`` frames of a take at which somebody of another tempo is at each step; at its ends the way goes back."""
    rate, step, last = rng.uniform(0.7, 1.4), CAPTURED / FPS, frames - 1
    begin = rng.uniform(0.0, max(0.0, last - count * step * rate))
    seconds = np.arange(count) / FPS
    hurry = 0.1 * CAPTURED * np.sin(2 * np.pi * seconds / rng.uniform(3.0, 8.0) + rng.uniform(0.0, 2 * np.pi))
    at = np.abs(begin + (seconds * CAPTURED + hurry) * rate)
    return np.asarray(last - np.abs(last - at % (2 * last)))


def resampled(take: Array, at: Array) -> Array:
    """A take at frames that are not whole."""
    low = np.clip(at.astype(np.intp), 0, len(take) - 2)
    weight = (at - low)[:, None, None]
    return np.asarray(take[low] * (1 - weight) + take[low + 1] * weight)


def bones_of(joints: Array, parents: tuple[int, ...]) -> Array:
    """Each joint from its parent; the root stays where it is.

    Example:
        >>> way = np.array([[[1.0, 0.0, 0.0], [1.0, 2.0, 0.0], [4.0, 2.0, 0.0]]])
        >>> bones_of(way, (-1, 0, 1))[0].tolist()
        [[1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [3.0, 0.0, 0.0]]
        >>> bool((joints_of(bones_of(way, (-1, 0, 1)), (-1, 0, 1)) == way).all())
        True
    """
    bones = joints.copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            bones[:, joint] -= joints[:, parent]
    return bones


def joints_of(bones: Array, parents: tuple[int, ...]) -> Array:
    """The way back: :func:`bones_of`."""
    joints = bones.copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            joints[:, joint] += joints[:, parent]
    return joints


def ancestry(joint: int, parents: tuple[int, ...]) -> Iterator[int]:
    """A joint, its parent, and so on to the root."""
    while joint >= 0:
        yield joint
        joint = parents[joint]


def facing(bones: Array, people: Takes) -> Array:
    """``(frames,)`` radians about the vertical, by the hips."""
    left, right = (bones[:, people.joints.index(hip)] for hip in HIPS)
    across = left - right
    return np.asarray(np.unwrap(np.arctan2(across[:, 2], across[:, 0])))


def turned(points: Array, angle: Array | float) -> Array:
    """Points about the vertical."""
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    return np.stack([c * x - s * z, y, s * x + c * z], axis=-1)


# ---- cameras -----------------------------------------------------------------------------------------------------------
def filmed(joints: Array, people: Takes, rng: np.random.Generator, cameras: Cameras = Cameras(), name: str = "") -> Clip:
    """Somebody ``(frames, joints, 3)`` at FPS, as a camera sees them that stands anywhere; ``name``: of the clip."""
    points = joints[:, [people.joints.index(joint) for joint in JOINTS]]
    points = (points - points.mean(axis=(0, 1))) * (HEIGHT / np.median(np.ptp(points[..., 1], axis=1)))
    points = turned(points + rng.normal(0.0, cameras.noise, points.shape), rng.uniform(0.0, 2 * np.pi))
    above, roll = rng.normal(cameras.above, cameras.spread), np.deg2rad(cameras.roll) * rng.choice([-1.0, 1.0])
    c, s = np.cos(above), np.sin(above)
    height, depth = c * points[..., 1] - s * points[..., 2], s * points[..., 1] + c * points[..., 2]
    away = max(cameras.distance, cameras.nearest - depth.min())
    seen = np.stack([points[..., 0], height], axis=-1) * (away / (depth + away))[..., None]
    c, s = np.cos(roll), np.sin(roll)
    image = (seen @ np.array([[c, s], [-s, c]])).astype(np.float32)
    return Clip(image, fps=FPS, skeleton=people.skeleton, name=name)


def every_take(people: Takes, rng: np.random.Generator, cameras: Cameras = Cameras()) -> list[Clip]:
    """The takes themselves, each by a camera of its own, named ``take 0``, ..."""
    step = round(CAPTURED / FPS)
    return [filmed(take[::step], people, rng, cameras, name=f"take {i}") for i, take in enumerate(people.takes)]


def distractors(people: Takes, seconds: float, rng: np.random.Generator, cameras: Cameras = Cameras()) -> Iterator[Clip]:
    """People who were never there, until there are so many seconds of them, named ``made 0``, ..."""
    number = 0
    while seconds > 0:
        clip = filmed(invented(people, rng), people, rng, cameras, name=f"made {number}")
        number, seconds = number + 1, seconds - clip.duration
        yield clip


@dataclass(frozen=True)
class Question:
    """A moment of a take, seen by another camera: the clip that is asked, and where the same moment is in the archive (seconds)."""

    clip: Clip
    source: str
    start: float
    end: float


def questions(
    people: Takes, duration: float, count: int, rng: np.random.Generator, cameras: Cameras = Cameras(), margin: float = 0.5
) -> list[Question]:
    """Moments drawn at random from takes that are at least ``margin`` longer; the camera filmed the whole take.

    Its frames are not at the moments of the archive's: it has another clock.

    Raises:
        ValueError: no take is so long.
    """
    long = np.flatnonzero(people.seconds >= duration + margin)
    if not len(long):
        raise ValueError(f"durations: no take lasts {duration + margin:g} s; give {people.seconds.max() - margin:.1f} at most")
    found, frames = [], round(duration * FPS) + 1
    for _ in range(count):
        which = int(rng.choice(long))
        take, offset = people.takes[which], rng.uniform(0.0, 1.0 / FPS)
        at = np.arange(int((people.seconds[which] - offset) * FPS) + 1) / FPS + offset
        clip = filmed(resampled(take, at * CAPTURED), people, rng, cameras, name=f"take {which}")
        first = int(rng.integers(0, len(clip) - frames + 1))
        some = slice(first, first + frames)
        asked = clip.replace(joints=clip.joints[some], times=np.arange(frames) / FPS, fps=None, name="query")
        found.append(Question(asked, f"take {which}", at[first], at[first] + duration))
    return found
