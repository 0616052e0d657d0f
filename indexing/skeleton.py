"""Joint layouts: names and bones, for pictures and for matching joints between formats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


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


def known(joints: int) -> Skeleton | None:
    """The common layout with this number of joints, where there is just one.

    17: COCO, 25: OpenPose, 26: Halpe, 33: MediaPipe, 133: COCO-WholeBody.
    """
    return {17: COCO17, 25: BODY25, 26: HALPE26, 33: MEDIAPIPE33, 133: WHOLEBODY133}.get(joints)


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
