"""Thousands of people who move at random, and what cameras placed at random see of them: to learn what depth an image tells.

Not actions: every limb goes from a pose near rest to a random one inside its range, along one curve of activation.  What was
found to matter for lifting images to depth is how poses and cameras are distributed: near rest most of the time, often
symmetric, one limb idle, sitting and bending among standing; all headings, in perspective, from above and from below.  Angles
drawn uniformly fail (R2 of the pose's depth on UTKinect .02 instead of .30).  How they move hardly matters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from indexing.actors.body import CHANNELS, INDEX, LANDMARKS, SIZES, landmarks, limited, root
from indexing.clip import FloatArray

Bools = NDArray[np.bool_]
PROPORTIONS = 0.1  # standard deviation of the logarithm of every length
OFFSET = 0.015  # metres: by how much formats and people place a joint differently, constant over a clip
LEVEL = 0.15  # radians: standard deviation of camera elevations about level (half of them looking down: R2 of depth less by .1)
NEAR, FAR = 2.5, 8.0  # metres
SHARES = {"step": 0.30, "hold": 0.28, "bump": 0.22, "cycle": 0.12, "drift": 0.08}  # of the activation curves


@dataclass(frozen=True)
class Views:
    """What cameras see: image ``(N, length, joints, 2)``, y up, and depth ``(N, length, joints)`` away from the camera, metres.

    Both are about the clip's mean; the image is scaled to metres at that depth.
    """

    image: FloatArray
    depth: FloatArray


def random_views(count: int, length: int, layout: FloatArray, rng: np.random.Generator | int) -> Views:
    r"""Random actors, each seen by a random perspective camera.

    A joint at :math:`(x, y, z)` from the clip's mean is seen at :math:`(x, y)\,d / (z + d)`.  The frame is that of
    :func:`indexing.cameras.virtual`: x as in right-handed data, so the image is the mirror image of a photograph.

    Args:
        count: actors.  length: steps per clip, uniform in time.
        layout: ``(joints, landmarks)`` of :func:`indexing.actors.layouts.layout_map`.

    Example:
        >>> from indexing.actors.layouts import LAYOUTS, layout_map
        >>> views = random_views(5, 8, layout_map(LAYOUTS["COCO-17"]), 0)
        >>> views.image.shape, views.depth.shape
        ((5, 8, 17, 2), (5, 8, 17))
    """
    rng = np.random.default_rng(rng)
    points = layout @ random_actors(count, length, rng)
    points += OFFSET * rng.normal(size=(count, 1, len(layout), 3))
    points -= points.mean(axis=(1, 2), keepdims=True)
    yaw = rng.uniform(0.0, 2 * np.pi, count)
    tilt = LEVEL * rng.normal(size=count)
    turned = points @ _rotations(yaw, tilt).swapaxes(1, 2)[:, None]
    distance = rng.uniform(NEAR, FAR, (count, 1, 1))
    depth = turned[..., 2]
    return Views(turned[..., :2] * (distance / np.maximum(depth + distance, 0.3))[..., None], depth)


def random_actors(count: int, length: int, rng: np.random.Generator) -> FloatArray:
    """``(count, length, landmarks, 3)`` metres: the feet that carry weight stand still, the lowest is on the floor."""
    angles, walks = _angles(count, length, rng)
    sizes = np.exp(PROPORTIONS * rng.normal(size=(count, len(SIZES))))
    sizes[:, 0] = 1.65 * np.exp(PROPORTIONS / 2 * rng.normal(size=count))
    out = landmarks(limited(angles.reshape(count * length, -1)), np.repeat(sizes, length, axis=0))
    out = out.reshape(count, length, len(LANDMARKS), 3)
    ankles = out[:, :, [LANDMARKS.index("left_ankle"), LANDMARKS.index("right_ankle")]]
    grip = np.full((count, length, 2), 0.5)
    lower = (ankles[..., 1] <= ankles[..., ::-1, 1]).astype(float)  # who walks holds on with the lower foot
    grip[walks] = lower[walks]
    return np.asarray(out + root(ankles, grip, np.zeros((count, length)))[:, :, None])


def _rotations(yaw: FloatArray, tilt: FloatArray) -> FloatArray:
    """``(count, 3, 3)`` as :func:`indexing.cameras.rotation`, batched."""
    cy, sy, ct, st, no = np.cos(yaw), np.sin(yaw), np.cos(tilt), np.sin(tilt), np.zeros_like(yaw)
    rows = [[cy, no, sy], [st * sy, ct, -st * cy], [-ct * sy, st, ct * cy]]
    return np.moveaxis(np.array(rows), 2, 0)


# ---- poses -------------------------------------------------------------------------------------------------------------
def _angles(count: int, length: int, rng: np.random.Generator) -> tuple[FloatArray, Bools]:
    """``(count, length, channels)`` degrees, and ``(count,)`` who walks."""
    base = np.zeros((count, len(CHANNELS)))
    target = np.zeros_like(base)
    curve = np.zeros((count, length, len(CHANNELS)))
    groups = {"trunk": ("twist", "side", "hips", "list"), "lean": ("lean",), "turn": ("turn",), "head": ("nod", "look")}
    for names in groups.values():
        curve[:, :, [INDEX[name] for name in names]] = _curves(count, length, rng)[:, :, None]
    _trunk(base, target, rng)
    _arms(base, target, curve, rng)
    _legs(base, target, curve, rng)
    angles = base[:, None] + (target - base)[:, None] * curve
    again = rng.random(count) < 0.35  # a second target on top of the first
    second = target[rng.permutation(count)]
    arms = [INDEX[side + name] for side in ("l_", "r_") for name in ("flex", "abd", "rot", "elbow")]
    share = (_curves(count, length, rng) * again[:, None])[:, :, None]
    angles[:, :, arms] += (second[:, None, arms] - angles[:, :, arms]) * share
    walks = rng.random(count) < 0.24
    _walk(angles, walks, rng)
    return angles, walks


def _curves(count: int, length: int, rng: np.random.Generator) -> FloatArray:
    """``(count, length)`` activations in [0, 1]: a step, up or down, a hold, a bump, a cycle, or a slow drift."""
    t = np.linspace(0.0, 1.0, length)
    middle, width = rng.uniform(0.2, 0.8, (count, 1)), rng.uniform(0.06, 0.3, (count, 1))
    step = 0.5 + 0.5 * np.tanh((t - middle) / width)
    step = np.where(rng.random((count, 1)) < 0.35, 1 - step, step)
    bump = np.exp(-0.5 * ((t - middle) / (width + 0.05)) ** 2)
    cycle = 0.5 - 0.5 * np.cos(2 * np.pi * (rng.uniform(1.0, 4.0, (count, 1)) * t + rng.random((count, 1))))
    drift = 0.5 + 0.5 * np.sin(np.pi * (rng.uniform(0.3, 1.0, (count, 1)) * t + 2 * rng.random((count, 1))))
    kinds = np.stack([step, np.ones_like(step), bump, cycle, drift])
    return np.asarray(kinds[rng.choice(len(SHARES), count, p=list(SHARES.values())), np.arange(count)])


def _trunk(base: FloatArray, target: FloatArray, rng: np.random.Generator) -> None:
    count = len(base)

    def set_both(name: str, mean: float, spread: float, further: float, share: float) -> None:
        at = INDEX[name]
        base[:, at] = mean + spread * rng.normal(size=count)
        target[:, at] = base[:, at] + (rng.random(count) < share) * further * rng.normal(size=count)

    set_both("twist", 0.0, 6.0, 25.0, 0.3)
    set_both("side", 0.0, 3.0, 12.0, 0.3)
    set_both("hips", 0.0, 4.0, 8.0, 0.3)
    set_both("list", 0.0, 2.0, 4.0, 0.3)
    set_both("nod", 5.0, 8.0, 20.0, 0.3)
    set_both("look", 0.0, 10.0, 25.0, 0.3)
    set_both("lean", 0.0, 6.0, 0.0, 0.0)
    bends = rng.random(count) < 0.28
    target[bends, INDEX["lean"]] = rng.uniform(15.0, 95.0, bends.sum())
    turns = rng.random(count) < 0.25
    target[turns, INDEX["turn"]] = rng.uniform(-200.0, 200.0, turns.sum())


def _arms(base: FloatArray, target: FloatArray, curve: FloatArray, rng: np.random.Generator) -> None:
    count, length = len(curve), curve.shape[1]
    at = [[INDEX[side + name] for name in ("flex", "abd", "rot", "elbow")] for side in ("l_", "r_")]
    rest = np.array([3.0, 10.0, 10.0, 18.0]) + np.array([10.0, 7.0, 20.0, 14.0]) * rng.normal(size=(2, count, 4))
    drawn = [_arm_target(count, rng) for _ in range(4)]
    start = np.where(rng.random((2, count, 1)) < 0.8, rest, np.stack(drawn[:2]))
    end = np.stack(drawn[2:])
    same = rng.random(count) < 0.3
    start[1, same] = start[0, same] + 5.0 * rng.normal(size=(same.sum(), 4))
    end[1, same] = end[0, same] + 5.0 * rng.normal(size=(same.sum(), 4))
    idle = (rng.random(count) < 0.5) & ~same
    who = rng.integers(0, 2, count)
    end[who[idle], idle] = start[who[idle], idle]
    curves = np.stack([_curves(count, length, rng) for _ in range(2)])
    together = same | (rng.random(count) < 0.3)
    curves[1, together] = curves[0, together]
    for side in (0, 1):
        base[:, at[side]], target[:, at[side]] = start[side], end[side]
        curve[:, :, at[side]] = curves[side][:, :, None]


def _arm_target(count: int, rng: np.random.Generator) -> FloatArray:
    """``(count, 4)`` somewhere to reach: mostly in front, at the height of hips to head."""
    flex = 65.0 + 50.0 * rng.normal(size=count)
    abd = 12.0 + np.abs(40.0 * rng.normal(size=count))
    rot = 15.0 + 35.0 * rng.normal(size=count)
    return np.stack([flex, abd, rot, rng.uniform(0.0, 140.0, count)], axis=1)


def _legs(base: FloatArray, target: FloatArray, curve: FloatArray, rng: np.random.Generator) -> None:
    count, length = len(curve), curve.shape[1]
    at = [[INDEX[side + name] for name in ("hip", "knee", "spread", "out")] for side in ("l_", "r_")]
    stand = np.array([3.0, 6.0, 4.0, 7.0]) + np.array([4.0, 5.0, 3.0, 5.0]) * rng.normal(size=(2, count, 4))
    end = stand.copy()
    kind = rng.random(count)
    sits, kicks = kind < 0.22, (kind >= 0.22) & (kind < 0.34)
    depth = rng.uniform(0.4, 1.15, int(sits.sum()))
    low = np.array([88.0, 88.0, 0.0, 0.0]) * depth[:, None] + np.array([0.0, 8.0, 0.0, 0.0]) * rng.normal(size=(len(depth), 1))
    spread = np.array([5.0, 7.0, 3.0, 5.0]) * rng.normal(size=(2, len(depth), 4))
    end[:, sits] = low + np.array([0.0, 0.0, 6.0, 8.0]) + spread
    lean = INDEX["lean"]
    target[sits, lean] = np.maximum(target[sits, lean], rng.uniform(-10.0, 30.0, len(depth)))
    n = int(kicks.sum())
    lifted = np.stack([*(rng.uniform(a, b, n) for a, b in ((-30.0, 100.0), (0.0, 115.0), (0.0, 40.0), (-5.0, 20.0)))], axis=1)
    end[rng.integers(0, 2, n), kicks] = lifted
    curves = _curves(count, length, rng)[:, :, None]
    for side in (0, 1):
        base[:, at[side]], target[:, at[side]] = stand[side], end[side]
        curve[:, :, at[side]] = curves


def _walk(angles: FloatArray, walks: Bools, rng: np.random.Generator) -> None:
    """Legs of those who walk, and the arms of two thirds of them."""
    n, length = int(walks.sum()), angles.shape[1]
    phase = 2 * np.pi * (rng.uniform(0.5, 3.0, (n, 1)) * np.linspace(0, 1, length) + rng.random((n, 1)))
    stride, swing = rng.uniform(10.0, 32.0, (n, 1)), rng.uniform(8.0, 35.0, (n, 1))
    swings = rng.random(n) < 0.65
    rows = np.flatnonzero(walks)
    for side, sign in (("l_", 1.0), ("r_", -1.0)):
        leg = sign * np.sin(phase)
        angles[rows, :, INDEX[side + "hip"]] = 3.0 + stride * leg
        angles[rows, :, INDEX[side + "knee"]] = 8.0 + 1.6 * stride * np.maximum(0.0, sign * np.cos(phase))
        angles[rows[swings], :, INDEX[side + "flex"]] = 4.0 - (swing * leg)[swings]
        angles[rows[swings], :, INDEX[side + "elbow"]] = 22.0 - 0.5 * (swing * leg)[swings]
