"""What goes wrong with keypoints, as pure functions of a clip: noise, missing joints, dropped frames, wrong joints.

Every function takes a clip, how much of it, and a generator, and returns a new clip; amount 0 returns the clip as it is.  The
same generator state gives the same corruption.  Times stay true: a dropped frame is a gap on the clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing import Clip

Mask = NDArray[np.bool_]
Corruption = Callable[[Clip, float, np.random.Generator], Clip]

BURST = 0.5  # seconds: mean length of an occlusion, as in `indexing.actors.detect`
MISTAKE = 0.1  # seconds: mean length of a mistake that lasts


def noisy(clip: Clip, sigma: float, rng: np.random.Generator) -> Clip:
    """White noise on every coordinate; ``sigma`` in the clip's unit (metres at the person, for virtual cameras)."""
    return clip.replace(joints=clip.joints + rng.normal(scale=sigma, size=clip.joints.shape)) if sigma else clip


def missing(clip: Clip, share: float, rng: np.random.Generator) -> Clip:
    """Each joint of each frame is missing with probability ``share``, independently."""
    return _without(clip, rng.random(clip.joints.shape[:2]) < share)


def missing_bursts(clip: Clip, share: float, rng: np.random.Generator) -> Clip:
    """Joints hidden for half a second on average: a joint is hidden with probability ``share`` in every frame."""
    return _without(clip, bursts(clip, share, BURST, rng))


def dropped(clip: Clip, share: float, rng: np.random.Generator) -> Clip:
    """Frames left out at random (at least 2 stay), the ends too; the times of the others stay."""
    count = max(2, len(clip) - round(share * len(clip)))
    if count >= len(clip):
        return clip
    kept = np.sort(rng.permutation(len(clip))[:count])
    confidence = None if clip.confidence is None else clip.confidence[kept]
    return clip.replace(joints=clip.joints[kept], times=clip.times[kept], confidence=confidence)


def astray(clip: Clip, share: float, rng: np.random.Generator) -> Clip:
    """Joints that are anywhere in the box in which the person moves, each frame on its own."""
    return _elsewhere(clip, rng.random(clip.joints.shape[:2]) < share, rng)


def astray_bursts(clip: Clip, share: float, rng: np.random.Generator) -> Clip:
    """Joints that are anywhere in the box in which the person moves, for a tenth of a second on average at one place."""
    return _elsewhere(clip, bursts(clip, share, MISTAKE, rng), rng, held=True)


def mistaken(clip: Clip, share: float, rng: np.random.Generator) -> Clip:
    """Joints taken for another joint of the same frame (half as many exchanges of two)."""
    frames, joints = clip.joints.shape[:2]
    twin = rng.permuted(np.tile(np.arange(joints), (frames, 1)), axis=1)  # pairs of neighbours in a random order
    first, second = twin[:, 0 : 2 * (joints // 2) : 2], twin[:, 1::2]
    struck = rng.random(first.shape) < share
    source = np.tile(np.arange(joints), (frames, 1))
    rows = np.broadcast_to(np.arange(frames)[:, None], first.shape)[struck]
    source[rows, first[struck]], source[rows, second[struck]] = second[struck], first[struck]
    return clip.replace(joints=np.take_along_axis(clip.joints, source[..., None], axis=1)) if struck.any() else clip


def missing_and_astray(clip: Clip, share: float, rng: np.random.Generator) -> Clip:
    """A bad detector: ``share`` of the joints missing, and a sixth as many astray."""
    return missing(astray(clip, share / 6, rng), share, rng)


def bursts(clip: Clip, share: float, seconds: float, rng: np.random.Generator) -> Mask:
    """``(frames, joints)`` bool: true with probability ``share``, for ``seconds`` on average.

    A two-state chain on the clip's own clock that has run for ever: exponential runs, whatever the frame rate.
    """
    state = rng.random(clip.joints.shape[:2])
    out = np.empty(state.shape, dtype=bool)
    out[0] = state[0] < share
    for frame, step in enumerate(np.diff(clip.times), start=1):
        keep = math.exp(-step / (seconds * max(1 - share, 1e-9)))  # mean run of the struck state: `seconds`
        out[frame] = state[frame] < share + keep * (out[frame - 1] - share)
    return out


def _without(clip: Clip, gone: Mask) -> Clip:
    """The clip with joints missing; at least two sightings of one joint stay, so that it can still be compared."""
    if not gone.any():
        return clip
    if gone.all():
        gone = gone.copy()
        gone[[0, -1], 0] = False
    return clip.replace(joints=np.where(gone[..., None], np.nan, clip.joints))


def _elsewhere(clip: Clip, struck: Mask, rng: np.random.Generator, held: bool = False) -> Clip:
    """Positions drawn anew in the box of all joints of the clip; ``held``: one place per run of struck frames."""
    if not struck.any():
        return clip
    joints: NDArray[Any] = clip.joints
    low, high = np.nanmin(joints, axis=(0, 1)), np.nanmax(joints, axis=(0, 1))
    places = rng.uniform(low, high, size=joints.shape)
    if held:
        for frame in range(1, len(places)):
            again = struck[frame] & struck[frame - 1]
            places[frame, again] = places[frame - 1, again]
    there = struck & clip.seen  # a joint that was not seen cannot be seen wrongly
    return clip.replace(joints=np.where(there[..., None], places, joints))


KINDS: dict[str, tuple[Corruption, str, tuple[float, ...]]] = {
    "noise": (noisy, "m", (0.0, 0.01, 0.02, 0.03, 0.045, 0.06)),
    "missing joints": (missing, "share", (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)),
    "missing joints, bursts": (missing_bursts, "share", (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)),
    "dropped frames": (dropped, "share", (0.0, 0.25, 0.5, 0.625, 0.75)),
    "wrong joints, anywhere": (astray, "share", (0.0, 0.01, 0.025, 0.05, 0.075, 0.1)),
    "wrong joints, lasting": (astray_bursts, "share", (0.0, 0.01, 0.025, 0.05, 0.075, 0.1)),
    "wrong joints, exchanged": (mistaken, "share", (0.0, 0.01, 0.025, 0.05, 0.075, 0.1)),
    "missing and wrong joints": (missing_and_astray, "share", (0.0, 0.15, 0.3, 0.45)),
}
"""By name: the function, the unit of its amount, and the amounts tried, 0 first."""
