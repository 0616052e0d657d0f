"""Joint layouts: names and bones, for pictures and for matching joints between formats."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise


@dataclass(frozen=True)
class Skeleton:
    """Names of the joints, in the order of the data, and the bones between them (pairs of indices)."""

    name: str
    joints: tuple[str, ...]
    bones: tuple[tuple[int, int], ...] = ()

    def __post_init__(self) -> None:
        for a, b in self.bones:
            if not (0 <= a < len(self.joints) and 0 <= b < len(self.joints)):
                raise ValueError(f"skeleton {self.name!r}: bone ({a}, {b}) names a joint outside 0..{len(self.joints) - 1}")


def from_names(name: str, joints: Sequence[str], bones: Sequence[tuple[str, str]] = ()) -> Skeleton:
    """A skeleton whose bones are given by joint names."""
    index = {joint: i for i, joint in enumerate(joints)}
    return Skeleton(name, tuple(joints), tuple((index[a], index[b]) for a, b in bones))


def usual_layout(joints: int) -> Skeleton | None:
    """The usual layout with this number of joints: what pose estimators write where they say no more than the number."""
    return {17: COCO17, 25: BODY25, 26: HALPE26, 33: MEDIAPIPE33, 133: WHOLEBODY133, 136: HALPE136}.get(joints)


def candidates(joints: int) -> tuple[Skeleton, ...]:
    """The layouts of whole bodies that have this number of joints."""
    others = (HAND21, BLAZEPOSE33)  # no body, and the joints of MediaPipe
    return tuple(layout for layout in LAYOUTS.values() if len(layout.joints) == joints and layout not in others)


def layout_named(name: str) -> Skeleton:
    """A layout by its name, whatever its capitals and hyphens."""
    plain = {re.sub(r"[\W_]+", "", known_name.lower()): layout for known_name, layout in LAYOUTS.items()}
    layout = plain.get(re.sub(r"[\W_]+", "", str(name).lower()))
    if layout is None:
        raise ValueError(f"layout {str(name)[:60]!r}: there is none of this name; use one of {', '.join(LAYOUTS)}")
    return layout


COCO17 = from_names(
    "COCO-17",
    (
        "nose", "left_eye", "right_eye", "left_ear", "right_ear", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow",
        "left_wrist", "right_wrist", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle",
    ),
    (
        ("nose", "left_eye"), ("nose", "right_eye"), ("left_eye", "left_ear"), ("right_eye", "right_ear"),
        ("left_shoulder", "right_shoulder"), ("left_shoulder", "left_elbow"), ("left_elbow", "left_wrist"),
        ("right_shoulder", "right_elbow"), ("right_elbow", "right_wrist"), ("left_shoulder", "left_hip"),
        ("right_shoulder", "right_hip"), ("left_hip", "right_hip"), ("left_hip", "left_knee"), ("left_knee", "left_ankle"),
        ("right_hip", "right_knee"), ("right_knee", "right_ankle"),
    ),
)  # fmt: skip

BODY25 = from_names(
    "BODY_25",
    (
        "nose", "neck", "right_shoulder", "right_elbow", "right_wrist", "left_shoulder", "left_elbow", "left_wrist", "mid_hip",
        "right_hip", "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle", "right_eye", "left_eye", "right_ear",
        "left_ear", "left_big_toe", "left_small_toe", "left_heel", "right_big_toe", "right_small_toe", "right_heel",
    ),
    (
        ("neck", "mid_hip"), ("neck", "right_shoulder"), ("neck", "left_shoulder"), ("right_shoulder", "right_elbow"),
        ("right_elbow", "right_wrist"), ("left_shoulder", "left_elbow"), ("left_elbow", "left_wrist"), ("mid_hip", "right_hip"),
        ("right_hip", "right_knee"), ("right_knee", "right_ankle"), ("mid_hip", "left_hip"), ("left_hip", "left_knee"),
        ("left_knee", "left_ankle"), ("neck", "nose"), ("nose", "right_eye"), ("right_eye", "right_ear"), ("nose", "left_eye"),
        ("left_eye", "left_ear"), ("left_ankle", "left_big_toe"), ("left_big_toe", "left_small_toe"), ("left_ankle", "left_heel"),
        ("right_ankle", "right_big_toe"), ("right_big_toe", "right_small_toe"), ("right_ankle", "right_heel"),
    ),
)  # fmt: skip

MEDIAPIPE33 = from_names(
    "MediaPipe-33",
    (
        "nose", "left_eye_inner", "left_eye", "left_eye_outer", "right_eye_inner", "right_eye", "right_eye_outer", "left_ear",
        "right_ear", "mouth_left", "mouth_right", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist",
        "right_wrist", "left_pinky", "right_pinky", "left_index", "right_index", "left_thumb", "right_thumb", "left_hip",
        "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle", "left_heel", "right_heel", "left_foot_index",
        "right_foot_index",
    ),
    (
        ("left_shoulder", "right_shoulder"), ("left_shoulder", "left_elbow"), ("left_elbow", "left_wrist"),
        ("right_shoulder", "right_elbow"), ("right_elbow", "right_wrist"), ("left_wrist", "left_index"),
        ("right_wrist", "right_index"), ("left_shoulder", "left_hip"), ("right_shoulder", "right_hip"), ("left_hip", "right_hip"),
        ("left_hip", "left_knee"), ("left_knee", "left_ankle"), ("right_hip", "right_knee"), ("right_knee", "right_ankle"),
        ("left_ankle", "left_heel"), ("left_heel", "left_foot_index"), ("left_ankle", "left_foot_index"),
        ("right_ankle", "right_heel"), ("right_heel", "right_foot_index"), ("right_ankle", "right_foot_index"),
        ("left_ear", "left_eye"), ("left_eye", "nose"), ("nose", "right_eye"), ("right_eye", "right_ear"),
    ),
)  # fmt: skip

# what `dyntorch pose` writes: the same points, never smoothed
BLAZEPOSE33 = Skeleton("blazepose33", MEDIAPIPE33.joints, MEDIAPIPE33.bones)

_LIMBS = (
    ("neck", "right_shoulder"), ("right_shoulder", "right_elbow"), ("right_elbow", "right_wrist"), ("neck", "left_shoulder"),
    ("left_shoulder", "left_elbow"), ("left_elbow", "left_wrist"), ("right_hip", "right_knee"), ("right_knee", "right_ankle"),
    ("left_hip", "left_knee"), ("left_knee", "left_ankle"),
)  # fmt: skip

OPENPOSE18 = from_names(
    "OpenPose-COCO-18",
    (
        "nose", "neck", "right_shoulder", "right_elbow", "right_wrist", "left_shoulder", "left_elbow", "left_wrist", "right_hip",
        "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle", "right_eye", "left_eye", "right_ear", "left_ear",
    ),
    (
        *_LIMBS, ("neck", "nose"), ("neck", "right_hip"), ("neck", "left_hip"), ("nose", "right_eye"), ("right_eye", "right_ear"),
        ("nose", "left_eye"), ("left_eye", "left_ear"),
    ),
)  # fmt: skip

OPENPOSE_MPI15 = from_names(
    "OpenPose-MPI-15",
    (
        "head", "neck", "right_shoulder", "right_elbow", "right_wrist", "left_shoulder", "left_elbow", "left_wrist", "right_hip",
        "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle", "chest",
    ),
    (*_LIMBS, ("head", "neck"), ("neck", "chest"), ("chest", "right_hip"), ("chest", "left_hip")),
)  # fmt: skip

_FEET_BONES = tuple((f"{side}_ankle", f"{side}_{part}") for side in ("left", "right") for part in ("big_toe", "small_toe", "heel"))

HALPE26 = from_names(
    "Halpe-26",
    (
        *COCO17.joints, "head", "neck", "hip", "left_big_toe", "right_big_toe", "left_small_toe", "right_small_toe", "left_heel",
        "right_heel",
    ),
    (
        *_LIMBS, ("head", "neck"), ("neck", "hip"), ("hip", "left_hip"), ("hip", "right_hip"), ("nose", "left_eye"),
        ("left_eye", "left_ear"), ("nose", "right_eye"), ("right_eye", "right_ear"), ("nose", "neck"), *_FEET_BONES,
    ),
)  # fmt: skip

BODY25B = from_names(
    "BODY_25B",
    (
        *COCO17.joints, "upper_neck", "head_top", "left_big_toe", "left_small_toe", "left_heel", "right_big_toe", "right_small_toe",
        "right_heel",
    ),
    (
        ("upper_neck", "head_top"), ("upper_neck", "nose"), ("nose", "left_eye"), ("left_eye", "left_ear"), ("nose", "right_eye"),
        ("right_eye", "right_ear"), ("upper_neck", "left_shoulder"), ("upper_neck", "right_shoulder"),
        ("left_shoulder", "left_elbow"), ("left_elbow", "left_wrist"), ("right_shoulder", "right_elbow"),
        ("right_elbow", "right_wrist"), ("left_shoulder", "left_hip"), ("right_shoulder", "right_hip"), ("left_hip", "right_hip"),
        ("left_hip", "left_knee"), ("left_knee", "left_ankle"), ("right_hip", "right_knee"), ("right_knee", "right_ankle"),
        *_FEET_BONES,
    ),
)  # fmt: skip

# The points of the next three come from markers or a depth sensor: joints within the body, near those that pose estimators
# are trained to see, and not on them.  Centres of hips and shoulders and the head have names of their own.
H36M17 = from_names(
    "H36M-17",
    (
        "root", "right_hip", "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle", "spine", "thorax", "neck_base",
        "head", "left_shoulder", "left_elbow", "left_wrist", "right_shoulder", "right_elbow", "right_wrist",
    ),
    (
        ("root", "right_hip"), ("right_hip", "right_knee"), ("right_knee", "right_ankle"), ("root", "left_hip"),
        ("left_hip", "left_knee"), ("left_knee", "left_ankle"), ("root", "spine"), ("spine", "thorax"), ("thorax", "neck_base"),
        ("neck_base", "head"), ("thorax", "left_shoulder"), ("left_shoulder", "left_elbow"), ("left_elbow", "left_wrist"),
        ("thorax", "right_shoulder"), ("right_shoulder", "right_elbow"), ("right_elbow", "right_wrist"),
    ),
)  # fmt: skip

_ARM, _LEG = ("shoulder", "elbow", "wrist", "hand"), ("hip", "knee", "ankle", "foot")
_DEPTH_LIMBS = tuple(
    (f"{side}_{a}", f"{side}_{b}") for side in ("left", "right") for limb in (_ARM, _LEG) for a, b in pairwise(limb)
)

NTU25 = from_names(  # Kinect v2
    "NTU-25",
    (
        "spine_base", "spine_mid", "neck", "head_center",
        *(f"{side}_{joint}" for limb in (_ARM, _LEG) for side in ("left", "right") for joint in limb),
        "spine_shoulder", "left_hand_tip", "left_thumb", "right_hand_tip", "right_thumb",
    ),
    (
        ("spine_base", "spine_mid"), ("spine_mid", "spine_shoulder"), ("spine_shoulder", "neck"), ("neck", "head_center"),
        ("spine_shoulder", "left_shoulder"), ("spine_shoulder", "right_shoulder"), ("spine_base", "left_hip"),
        ("spine_base", "right_hip"), *_DEPTH_LIMBS, ("left_hand", "left_hand_tip"), ("left_hand", "left_thumb"),
        ("right_hand", "right_hand_tip"), ("right_hand", "right_thumb"),
    ),
)  # fmt: skip

KINECT20 = from_names(  # Kinect v1
    "Kinect-20",
    (
        "hip_center", "spine", "shoulder_center", "head_center",
        *(f"{side}_{joint}" for limb in (_ARM, _LEG) for side in ("left", "right") for joint in limb),
    ),
    (
        ("hip_center", "spine"), ("spine", "shoulder_center"), ("shoulder_center", "head_center"),
        ("shoulder_center", "left_shoulder"), ("shoulder_center", "right_shoulder"), ("hip_center", "left_hip"),
        ("hip_center", "right_hip"), *_DEPTH_LIMBS,
    ),
)  # fmt: skip

MEASURED = (H36M17.name, NTU25.name, KINECT20.name)
"""Layouts of markers and depth sensors, whose joints lie near those of the same name in the others."""

_FINGERS = tuple(
    tuple(f"{finger}_{part}" for part in (("cmc", "mcp", "ip", "tip") if finger == "thumb" else ("mcp", "pip", "dip", "tip")))
    for finger in ("thumb", "index_finger", "middle_finger", "ring_finger", "pinky")
)

_HAND_BONES = tuple(pair for finger in _FINGERS for pair in zip(("wrist", *finger[:-1]), finger, strict=True))

HAND21 = from_names(
    "MediaPipe-hand-21",
    ("wrist", *(part for finger in _FINGERS for part in finger)),
    _HAND_BONES,
)

WHOLEBODY133 = from_names(
    "COCO-WholeBody-133",
    (
        *COCO17.joints, "left_big_toe", "left_small_toe", "left_heel", "right_big_toe", "right_small_toe", "right_heel",
        *(f"face_{i}" for i in range(68)), *(f"{side}_hand_{joint}" for side in ("left", "right") for joint in HAND21.joints),
    ),
    (
        *((COCO17.joints[a], COCO17.joints[b]) for a, b in COCO17.bones), *_FEET_BONES,
        *((f"{side}_hand_{a}", f"{side}_hand_{b}") for side in ("left", "right") for a, b in _HAND_BONES),
    ),
)  # fmt: skip

HALPE136 = from_names(
    "Halpe-136",
    (
        *HALPE26.joints, *(f"face_{i}" for i in range(68)),
        *(f"{side}_hand_{joint}" for side in ("left", "right") for joint in HAND21.joints),
    ),
    (
        *((HALPE26.joints[a], HALPE26.joints[b]) for a, b in HALPE26.bones),
        *((f"{side}_hand_{a}", f"{side}_hand_{b}") for side in ("left", "right") for a, b in _HAND_BONES),
    ),
)  # fmt: skip

LAYOUTS = {
    layout.name: layout
    for layout in (
        *(COCO17, H36M17, BODY25, BODY25B, NTU25, KINECT20, HALPE26, HALPE136, WHOLEBODY133, MEDIAPIPE33, BLAZEPOSE33, HAND21),
        *(OPENPOSE18, OPENPOSE_MPI15),
    )
}
"""Every layout by its name: what ``layout=`` and ``--layout`` take."""
