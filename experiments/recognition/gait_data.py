"""Walking and other actions of the CMU set, as random virtual cameras see them, with the phase of the step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.common.real_data import takes
from experiments.synchronization.data import RECORDED, SAME
from indexing import Clip
from indexing.cameras import virtual
from indexing.skeleton import Skeleton

Array = NDArray[Any]
OTHERS = {"run": "run", "jump": "jump", "punch": "punch", "bend": "bend", "wash": "wash"}
"""The other actions, by a word of the take's description."""
JOINTS = (
    "pelvis", "left_hip", "right_hip", "left_knee", "left_ankle", "right_knee", "right_ankle", "spine", "thorax", "neck",
    "left_shoulder", "right_shoulder", "head", "left_elbow", "left_wrist", "right_elbow", "right_wrist",
)  # fmt: skip
ELEVATIONS = (-0.1, 0.5)
STEP = 3
"""Frames from one that is kept to the next: 20 per second."""
PIECE, LEAST = 60, 600
"""Frames that a test camera stays, and frames of every take that are asked at least."""
LONG = 600
"""Frames: longer walks give two clips, whose cameras differ."""
HIP, ANKLE, TOES = (1, 2), (4, 6), ((6, 7), (10, 11))
"""Hips and ankles among the 17 joints; feet and toes among the 31."""


@dataclass(frozen=True)
class Frames:
    """A clip, whose it is, and the phase of every frame in cycles (NaN: not known, or no walking)."""

    clip: Clip
    label: str
    take: str
    phase: Array

    @property
    def joints(self) -> Array:
        """``(frames, 17, 2)``."""
        return np.asarray(self.clip.joints)


@dataclass(frozen=True)
class Split:
    """What is learned from and what is asked."""

    train: list[Frames]
    test: list[Frames]


def walks() -> list[str]:
    """Names of the walking takes."""
    return [take.name for take in takes() if "walk" in take.what]


def split(held_out: str, views: int, seed: int, noise: float, camera: Callable[..., Clip] = virtual) -> Split:
    """One walking take asked, the others learned from in so many views each; of other actions the first half is learned."""
    rng = np.random.default_rng([seed, views])
    data = Split([], [])
    for take in takes():
        joints = take.joints.numpy()
        label = "walk" if "walk" in take.what else next((name for name, word in OTHERS.items() if word in take.what), None)
        if label is None:
            continue
        count = len(joints)
        phase = step_phase(joints) if label == "walk" else np.full(count, np.nan)
        asked = (0, count) if take.name == held_out else (count, count) if label == "walk" else (count // 2, count)
        if asked[0] > 0:
            cuts = [0, count // 2, count] if label == "walk" and count > LONG else [0, asked[0]]
            for first, last in pairwise(cuts):
                for _ in range(views):
                    data.train.append(_filmed(joints, phase, (first, last), label, take.name, rng, noise, camera))
        for _ in range(max(1, round(LEAST / max(1, asked[1] - asked[0]))) if asked[1] > asked[0] else 0):
            for first in range(asked[0], asked[1] - PIECE // 3, PIECE):
                data.test.append(
                    _filmed(joints, phase, (first, min(first + PIECE, asked[1])), label, take.name, rng, noise, camera)
                )
    return data


def _filmed(
    joints: Array,
    phase: Array,
    part: tuple[int, int],
    label: str,
    take: str,
    rng: np.random.Generator,
    noise: float,
    camera: Callable[..., Clip],
) -> Frames:
    chosen = slice(part[0], part[1], STEP)
    bones = Skeleton("CMU-17", JOINTS)
    solid = Clip(joints[chosen][:, list(SAME)], fps=RECORDED / STEP, skeleton=bones, name=take)
    image = camera(solid, rng.uniform(0, 360), rng.uniform(*ELEVATIONS), noise=noise, random_state=rng)
    return Frames(image, label, take, phase[chosen])


def step_phase(joints: Array) -> Array:
    """``(frames,)`` cycles since some step, from the ankles in 3D: how far the left is ahead of the right.

    0 where it is furthest ahead, .5 where the right one is, .25 and .75 where they pass; linear in time in between.  NaN more
    than a fifth of a cycle before the first and after the last of these.
    """
    body = joints[:, list(SAME)]
    across = body[:, HIP[0]] - body[:, HIP[1]]
    ahead = np.cross(across, [0.0, 1.0, 0.0])
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    feet = sum(joints[:, toe] - joints[:, foot] for foot, toe in TOES)
    sign = np.sign(np.mean(np.sum(ahead * feet, axis=1)))
    lead = _smoothed(sign * np.sum((body[:, ANKLE[0]] - body[:, ANKLE[1]]) * ahead, axis=1))
    pass_ = np.flatnonzero(lead[1:] * lead[:-1] < 0)
    at = pass_ + lead[pass_] / (lead[pass_] - lead[pass_ + 1])
    events: list[tuple[float, float]] = []
    for k, (time, first) in enumerate(zip(at, pass_, strict=True)):
        events.append((float(time), 0.75 if lead[first + 1] > lead[first] else 0.25))
        if k + 1 < len(at):
            widest = first + 1 + int(np.argmax(np.abs(lead[first + 1 : pass_[k + 1] + 1])))
            events.append((float(widest), 0.0 if lead[widest] > 0 else 0.5))
    if len(events) < 3:
        return np.full(len(joints), np.nan)
    when = np.array([time for time, _ in events])
    cycles = np.unwrap(np.array([phase for _, phase in events]), period=1.0)
    rate = (cycles[-1] - cycles[0]) / (when[-1] - when[0])
    frames = np.arange(len(joints))
    phase = np.interp(frames, when, cycles)
    early, late = np.minimum(frames - when[0], 0), np.maximum(frames - when[-1], 0)
    phase = phase + rate * (early + late)
    return np.where((-early > 0.2 / rate) | (late > 0.2 / rate), np.nan, phase)


def _smoothed(values: Array, sigma: int = 3) -> Array:
    reach = 4 * sigma
    kernel = np.exp(-0.5 * np.square(np.arange(-reach, reach + 1) / sigma))
    padded = np.pad(values, reach, mode="reflect", reflect_type="odd")
    return np.convolve(padded, kernel / kernel.sum(), mode="valid")
