"""Joint layouts as linear maps of the landmarks of a body: where an actor has the joints that a format names.

A joint is a landmark of :mod:`indexing.actors.body`, or lies on the line between two.  Formats place their joints a little
differently (the hip centre of a Kinect is above the hips, its shoulder centre above the shoulders).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from indexing.actors.body import LANDMARKS
from indexing.clip import FloatArray
from indexing.skeleton import BODY25, COCO17, HALPE26, MEDIAPIPE33, OPENPOSE18, OPENPOSE_MPI15

_SHOULDER_TO_HAND = ("shoulder", "elbow", "wrist", "hand")
_HIP_TO_FOOT = ("hip", "knee", "ankle", "foot")

_KINECT_SPINE = ("kinect_hip_centre", "kinect_spine", "kinect_shoulder_centre", "kinect_head")
_KINECT_LEG = ("kinect_hip", "knee", "ankle", "kinect_foot")
_NITE_ARM, _NITE_LEG = ("shoulder", "elbow", "hand"), ("nite_hip", "knee", "ankle")


def _sided(side: str, parts: Sequence[str]) -> tuple[str, ...]:
    return tuple(f"{side}_{part}" for part in parts)


def _pairs(*parts: str) -> tuple[str, ...]:
    return tuple(f"{side}_{part}" for part in parts for side in ("left", "right"))


_LEGS_UP = ("right_ankle", "right_knee", "right_hip", "left_hip", "left_knee", "left_ankle")
_ARMS_UP = ("right_wrist", "right_elbow", "right_shoulder", "left_shoulder", "left_elbow", "left_wrist")

LAYOUTS: Mapping[str, tuple[str, ...]] = {
    "COCO-17": COCO17.joints,
    "BODY_25": BODY25.joints,
    "Kinect-20": (
        *_KINECT_SPINE, *_sided("left", _SHOULDER_TO_HAND), *_sided("right", _SHOULDER_TO_HAND),
        *_sided("left", _KINECT_LEG), *_sided("right", _KINECT_LEG),
    ),
    "MSRAction3D-20": (  # which side comes first is written nowhere: the depth may come out with the other sign
        *_pairs("shoulder"), "kinect_shoulder_centre", "kinect_spine", *_pairs("kinect_hip"), "kinect_hip_centre",
        *_pairs("elbow", "wrist", "hand", "knee", "ankle", "kinect_foot"), "kinect_head",
    ),
    "NITE-15": (
        "head", "neck", "nite_torso", *_sided("left", _NITE_ARM), *_sided("right", _NITE_ARM), *_sided("left", _NITE_LEG),
        *_sided("right", _NITE_LEG),
    ),
    "JHMDB-15": (
        "shoulder_centre", "torso", "face",
        *(f"{side}_{part}" for part in ("shoulder", "hip", "elbow", "knee", "wrist", "ankle") for side in ("right", "left")),
    ),
    "OpenPose-MPI-15": OPENPOSE_MPI15.joints,
    "OpenPose-COCO-18": OPENPOSE18.joints,
    "Halpe-26": HALPE26.joints,
    "MediaPipe-33": MEDIAPIPE33.joints,
    "Penn-13": ("face", *_pairs("shoulder", "elbow", "wrist", "hip", "knee", "ankle")),
    "LSP-14": (*_LEGS_UP, *_ARMS_UP, "neck", "crown"),
    "MPII-16": (*_LEGS_UP, "pelvis", "chest", "neck", "crown", *_ARMS_UP),
    "Human3.6M-17": (
        "pelvis", *_sided("right", _HIP_TO_FOOT[:3]), *_sided("left", _HIP_TO_FOOT[:3]), "spine", "neck", "nose", "crown",
        *_sided("left", _SHOULDER_TO_HAND[:3]), *_sided("right", _SHOULDER_TO_HAND[:3]),
    ),
    "SMPL-24": (
        "pelvis", *_pairs("hip"), "hip_centre", *_pairs("knee"), "spine", *_pairs("ankle"), "torso", *_pairs("foot"), "neck",
        *_pairs("collar"), "head", *_pairs("shoulder", "elbow", "wrist", "hand"),
    ),
    "Kinect2-25": (
        "kinect_hip_centre", "kinect_spine", "kinect_neck", "head", *_sided("left", _SHOULDER_TO_HAND),
        *_sided("right", _SHOULDER_TO_HAND), *_sided("left", _KINECT_LEG), *_sided("right", _KINECT_LEG), "shoulder_centre",
        "left_fingers", "left_thumb", "right_fingers", "right_thumb",
    ),
}  # fmt: skip
"""Names of the joints of each format, in the order of the data."""

# joint -> (landmark or joint, other one, how far from the first to the other); S = side
_BETWEEN: Mapping[str, tuple[str, str, float]] = {
    "hip_centre": ("pelvis", "neck", 0.2), "spine": ("pelvis", "neck", 0.4), "torso": ("pelvis", "neck", 0.5),
    "chest": ("pelvis", "neck", 0.8), "shoulder_centre": ("neck", "crown", 0.25), "head": ("neck", "crown", 0.8),
    "face": ("neck", "nose", 1.0), "S_collar": ("neck", "S_shoulder", 0.4), "S_foot": ("S_ankle", "S_toes", 0.5),
    "S_big_toe": ("S_ankle", "S_toes", 1.0), "S_small_toe": ("S_ankle", "S_toes", 0.85), "S_foot_index": ("S_ankle", "S_toes", 1.0),
    "S_index": ("S_wrist", "S_hand", 1.6), "S_pinky": ("S_wrist", "S_hand", 1.4), "S_thumb": ("S_wrist", "S_hand", 0.8),
    "S_fingers": ("S_wrist", "S_hand", 2.0), "S_eye_inner": ("S_eye", "nose", 0.3), "S_eye_outer": ("S_eye", "S_ear", 0.3),
    "mouth_S": ("nose", "S_ear", 0.2),
    # depth cameras: hips high and narrow, feet under the ankles (median lengths of bones on UTKinect and Florence3D)
    "S_kinect_hip": ("S_kinect_groin", "neck", 0.16), "S_kinect_groin": ("S_hip", "pelvis", 0.22),
    "kinect_hip_centre": ("pelvis", "neck", 0.33), "kinect_spine": ("pelvis", "neck", 0.47),
    "kinect_shoulder_centre": ("neck", "crown", 0.38), "kinect_neck": ("neck", "crown", 0.4),
    "kinect_head": ("neck", "crown", 1.03),
    "S_kinect_foot": ("S_heel", "S_toes", 0.45), "S_nite_hip": ("S_hip", "neck", 0.12), "nite_torso": ("pelvis", "neck", 0.56),
}  # fmt: skip
_SAME: Mapping[str, str] = {
    "mid_hip": "pelvis", "hips": "pelvis", "hip": "pelvis", "root": "pelvis", "spine_base": "hip_centre",
    "hip_center": "hip_centre",
    "spine_mid": "spine", "belly": "torso", "thorax": "chest", "upper_neck": "neck", "spine_shoulder": "shoulder_centre",
    "shoulder_center": "shoulder_centre", "head_top": "crown", "top_head": "crown", "S_toe": "S_foot", "S_toe_base": "S_toes",
    "S_hand_tip": "S_fingers", "S_upper_arm": "S_shoulder", "S_forearm": "S_elbow", "S_fore_arm": "S_elbow", "S_arm": "S_shoulder",
    "S_up_leg": "S_hip", "S_leg": "S_knee",
}  # fmt: skip
_SIDES = {"left": "left", "right": "right", "l": "left", "r": "right"}


def layout_map(joints: Sequence[str]) -> FloatArray | None:
    """``(joints, landmarks)`` weights that give the named joints from the landmarks; ``None`` where a name is not understood.

    Names may say their side as ``left_knee``, ``KneeLeft``, ``l_knee`` or ``knee.r``.

    Example:
        >>> weights = layout_map(("LeftHip", "hip_center"))
        >>> weights.shape, weights.sum(axis=1).tolist()
        ((2, 26), [1.0, 1.0])
        >>> layout_map(("left_hip", "tail")) is None
        True
    """
    rows = [_row(name) for name in joints]
    return np.array(rows) if rows and all(row is not None for row in rows) else None


def agree(format_joints: Sequence[str], joints: Sequence[str]) -> bool:
    """Whether names, in order, can be those of a format: a name that is not understood (a number, say) can be any joint."""
    if len(format_joints) != len(joints):
        return False
    return all(_same(*_plain(mine), *_plain(name)) for mine, name in zip(format_joints, joints, strict=True))


def _same(mine: str, my_side: str, name: str, side: str) -> bool:
    if _resolve(name, "left") is None:
        return True
    return my_side == side and re.sub("kinect_|nite_", "", mine) == name


def _row(name: str) -> FloatArray | None:
    return _resolve(*_plain(name))


def _plain(name: str) -> tuple[str, str]:
    """A joint's name without its side (S stands for it), and the side."""
    words = [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)]
    side = next((_SIDES[word] for word in words if word in _SIDES), "")
    part = "_".join(word for word in words if word not in _SIDES)
    plain = part if not side else f"{part}_S" if part == "mouth" else f"S_{part}"
    return _SAME.get(plain, plain), side


def _resolve(plain: str, side: str) -> FloatArray | None:
    name = plain.replace("S", side)
    if name in LANDMARKS:
        return np.eye(len(LANDMARKS))[LANDMARKS.index(name)]
    if plain not in _BETWEEN:
        return None
    first, other, share = _BETWEEN[plain]
    a, b = _resolve(first, side), _resolve(other, side)
    return None if a is None or b is None else (1 - share) * a + share * b
