"""The body of an actor: proportions and habits of a person, and forward kinematics from joint angles to the landmarks of a body.

Frame: metres, y up, **right-handed**; at heading 0 a person faces -z, towards a camera at z = -distance that looks along +z.
Facing -z with y up, the anatomical left is up x forward = -x.  Such a camera has its own right hand at -x too (x grows to the
LEFT of its image), so a true picture shows the person's left on the right, as any photograph does: that is what
:func:`indexing.actors.detect` draws.  :func:`indexing.cameras.virtual` keeps x as the image's x, so from right-handed data it
shows the mirror image, here as for a Kinect's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from indexing.clip import FloatArray

CENTRAL = ("turn", "hips", "list", "lean", "side", "twist", "nod", "look", "air")
LIMBS = ("flex", "abd", "rot", "elbow", "hip", "spread", "out", "knee", "grip")
CHANNELS = CENTRAL + tuple("l_" + name for name in LIMBS) + tuple("r_" + name for name in LIMBS)
"""What describes a pose, in degrees unless said otherwise (the person at heading 0; l_ and r_ = anatomical left and right):

turn: heading, to the left; hips, list: the pelvis turned to the left, its right side raised (the legs keep the heading);
lean, side, twist: trunk forward, to the left, turned to the left; nod, look: head down, to the left; air: metres above the floor;
flex, abd, rot: upper arm raised forward, outward, turned inward; elbow: bend; hip: thigh forward of the vertical;
spread: straight-leg angle that puts the ankle as far outward; out: knee turned outward; knee: bend;
grip: share of this foot in holding the body in place (both 0: the body stays and the feet slide, as on a treadmill).
"""
INDEX: Mapping[str, int] = {name: i for i, name in enumerate(CHANNELS)}
STYLES = 8  # numbers that describe the habits of a person
_LIMITS = {
    "lean": (-35.0, 105.0), "side": (-35.0, 35.0), "twist": (-60.0, 60.0), "nod": (-45.0, 50.0), "look": (-70.0, 70.0),
    "air": (0.0, 0.4), "flex": (-60.0, 175.0), "abd": (-30.0, 172.0), "rot": (-110.0, 90.0), "elbow": (0.0, 150.0),
    "hip": (-35.0, 115.0), "spread": (0.0, 45.0), "out": (-10.0, 45.0), "knee": (0.0, 145.0), "grip": (0.0, 1.0),
}  # fmt: skip
_LOW, _HIGH = (np.array([_LIMITS.get(name.split("_")[-1], (-np.inf, np.inf))[end] for name in CHANNELS]) for end in (0, 1))
_ODD = ("turn", "hips", "list", "side", "twist", "look")  # change sign in the mirror


@dataclass(frozen=True)
class Person:
    """Proportions and habits of one actor.

    Args:
        height: metres, sole to crown.
        trunk, arms, legs, shoulders, hips: lengths and widths relative to an average person of that height.
        tempo: speed of every movement, 1 = average.
        amplitude: size of every movement, 1 = average.
        handed: 1 right-handed, -1 left-handed; the preferred arm and leg do the one-sided actions.
        asymmetry: relative difference between the sizes of right and left arm movements.
        posture: degrees of habitual forward lean.
        stance: degrees by which each straight leg stands further out than average.
        sway: size of the idle sway, 1 = average.
        lag: seconds by which the arms follow the legs.
        style: further habits as standard normal numbers; they shape every action in the person's own way.

    Example:
        >>> import numpy as np
        >>> Person.random(np.random.default_rng(3)) == Person.random(3)
        True
    """

    height: float = 1.72
    trunk: float = 1.0
    arms: float = 1.0
    legs: float = 1.0
    shoulders: float = 1.0
    hips: float = 1.0
    tempo: float = 1.0
    amplitude: float = 1.0
    handed: int = 1
    asymmetry: float = 0.0
    posture: float = 0.0
    stance: float = 0.0
    sway: float = 1.0
    lag: float = 0.0
    style: tuple[float, ...] = (0.0,) * STYLES

    def __post_init__(self) -> None:
        sizes = (self.height, self.trunk, self.arms, self.legs, self.shoulders, self.hips, self.tempo, self.amplitude)
        if not (np.isfinite(sizes).all() and min(sizes) > 0):
            raise ValueError(f"person: height, proportions, tempo and amplitude must be positive numbers, got {self}")
        if self.handed not in (1, -1):
            raise ValueError(f"person: handed must be 1 (right) or -1 (left), got {self.handed!r}")
        if len(self.style) != STYLES:
            raise ValueError(f"person: style must hold {STYLES} numbers, got {len(self.style)}")

    @classmethod
    def random(cls, rng: np.random.Generator | int) -> Person:
        """A plausible person: one in eight is left-handed; tempo and amplitude vary by about 12 %, proportions by 5 %."""
        rng = np.random.default_rng(rng)
        trunk, arms, legs, shoulders, hips = (float(v) for v in np.exp(np.clip(rng.normal(0.0, 0.05, 5), -0.12, 0.12)))
        tempo, amplitude = (float(v) for v in np.exp(np.clip(rng.normal(0.0, 0.12, 2), -0.25, 0.25)))
        asymmetry, posture, stance, lag = (float(v) for v in np.clip(rng.normal(size=4), -2, 2) * (0.06, 3.0, 1.5, 0.03))
        return cls(
            height=float(np.clip(rng.normal(1.71, 0.09), 1.5, 1.95)),
            trunk=trunk, arms=arms, legs=legs, shoulders=shoulders, hips=hips, tempo=tempo, amplitude=amplitude,
            handed=1 if rng.random() > 0.125 else -1,
            asymmetry=asymmetry, posture=posture, stance=stance, sway=float(rng.uniform(0.5, 1.6)), lag=lag,
            style=tuple(float(v) for v in np.clip(rng.normal(size=STYLES), -2, 2)),
        )  # fmt: skip


def clip_angles(angles: FloatArray) -> FloatArray:
    """The same channels with every joint inside its range of motion (elbows and knees never bend backwards)."""
    return np.clip(angles, _LOW, _HIGH)


def mirror_angles(angles: FloatArray) -> FloatArray:
    """The same movement done with the other side of the body."""
    n, m = len(CENTRAL), len(LIMBS)
    out = np.concatenate([angles[:, :n], angles[:, n + m :], angles[:, n : n + m]], axis=1)
    out[:, [INDEX[name] for name in _ODD]] *= -1.0
    return out


def joints(angles: FloatArray, person: Person) -> FloatArray:
    """``(frames, 17, 3)`` COCO joints in metres of the poses ``(frames, channels)``."""
    col = {name: angles[:, i] for name, i in INDEX.items()}
    heading = _about("y", col["turn"])
    trunk = heading @ _about("y", col["twist"]) @ _about("z", col["side"]) @ _about("x", -col["lean"])
    pelvis = heading @ _about("y", col["hips"]) @ _about("z", col["list"])
    neck = trunk[..., 1] * (0.288 * person.trunk)
    head = trunk @ _about("y", col["look"]) @ _about("x", -col["nod"])
    out = np.empty((len(angles), 17, 3))
    for at, place in enumerate(_FACE):
        out[:, at] = neck + head @ place
    for left, side, prefix in ((0, -1.0, "l_"), (1, 1.0, "r_")):  # anatomical left is -x
        limb = {name: col[prefix + name] for name in LIMBS}
        shoulder = neck + trunk[..., 0] * (side * 0.107 * person.shoulders)
        hip = pelvis[..., 0] * (side * 0.072 * person.hips)
        out[:, 5 + left] = shoulder
        for at, part in zip((7, 9), _arm(trunk, limb, side), strict=True):
            out[:, at + left] = shoulder + person.arms * part
        out[:, 11 + left] = hip
        for at, part in zip((13, 15), _leg(limb, side), strict=True):
            out[:, at + left] = hip + person.legs * np.einsum("fij,fj->fi", heading, part)
    out *= person.height
    grip = np.stack([angles[:, INDEX["l_grip"]], angles[:, INDEX["r_grip"]]], axis=1)
    return out + root(out[:, 15:17], grip, angles[:, INDEX["air"]])[:, None]


# Lengths as fractions of the body height (after the usual anthropometric tables), at relative size 1.
_FACE = np.array([[0, 0.092, -0.068], [-0.019, 0.113, -0.054], [0.019, 0.113, -0.054], [-0.044, 0.105, 0.0], [0.044, 0.105, 0.0]])
_UPPER_ARM, _FOREARM, _THIGH, _SHANK = 0.172, 0.150, 0.245, 0.243


def _arm(trunk: FloatArray, limb: Mapping[str, FloatArray], side: float) -> tuple[FloatArray, FloatArray]:
    """Elbow and wrist relative to the shoulder."""
    upper = trunk @ _about("x", limb["flex"]) @ _about("z", side * limb["abd"]) @ _about("y", side * limb["rot"])
    elbow = upper @ np.array([0.0, -_UPPER_ARM, 0.0])
    return elbow, elbow + upper @ _about("x", limb["elbow"]) @ np.array([0.0, -_FOREARM, 0.0])


def _leg(limb: Mapping[str, FloatArray], side: float) -> tuple[FloatArray, FloatArray]:
    """Knee and ankle relative to the hip."""
    knee = _sagittal(_THIGH, limb["hip"])
    ankle = knee + _sagittal(_SHANK, limb["hip"] - limb["knee"])
    axis = ankle / np.linalg.norm(ankle, axis=1, keepdims=True)
    swivel = np.deg2rad(side * limb["out"])[:, None]
    along = (axis * knee).sum(axis=1, keepdims=True) * axis
    knee = along + (knee - along) * np.cos(swivel) + np.cross(axis, knee) * np.sin(swivel)
    length = _THIGH + _SHANK
    drop = np.maximum(-ankle[:, 1], 0.3 * length)  # a raised leg has no drop to tilt
    sine = np.clip(length * np.sin(np.deg2rad(limb["spread"])) / drop, -0.9, 0.9)
    tilt = _about("z", side * np.rad2deg(np.arcsin(sine)))
    return np.einsum("fij,fj->fi", tilt, knee), np.einsum("fij,fj->fi", tilt, ankle)


def _sagittal(length: float, degrees: FloatArray) -> FloatArray:
    """``(frames, 3)`` a segment that hangs down and is raised forward (towards -z) by an angle."""
    angle = np.deg2rad(degrees)
    return length * np.stack([np.zeros_like(angle), -np.cos(angle), -np.sin(angle)], axis=1)


def root(ankles: FloatArray, grip: FloatArray, air: FloatArray) -> FloatArray:
    """``(*batch, frames, 3)`` where the pelvis is, given ankles relative to it: the feet that grip stay where they are."""
    out = np.empty((*ankles.shape[:-2], 3))
    out[..., 1] = air - ankles[..., 1].min(axis=-1)
    flat = ankles[..., [0, 2]]
    held = (grip[..., 1:, :] + grip[..., :-1, :]) / 2
    start = -flat[..., :1, :, :].mean(axis=-2)
    out[..., :1, [0, 2]] = start
    out[..., 1:, [0, 2]] = start - np.cumsum((held[..., None] * np.diff(flat, axis=-3)).sum(axis=-2), axis=-2)
    return out


def _about(axis: str, degrees: FloatArray) -> FloatArray:
    """``(frames, 3, 3)`` right-handed rotations about a coordinate axis."""
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    angle = np.deg2rad(degrees)
    out = np.zeros((len(angle), 3, 3))
    out[:, 3 - i - j, 3 - i - j] = 1.0
    out[:, i, i] = out[:, j, j] = np.cos(angle)
    out[:, j, i] = np.sin(angle)
    out[:, i, j] = -out[:, j, i]
    return out
