"""Which joints are each other's mirror image: from their names, or from the data where nothing is named.

A person may do the same action with the other hand, and an exemplar of one is an exemplar of the other once the image is
mirrored *and* left and right joints change places.  Measured with one exemplar camera: Florence3D +2.5 %, UTKinect +-0.
"""

from __future__ import annotations

import re

import numpy as np
import torch
from torch import Tensor

from indexing.cameras import rotation
from indexing.clip import FloatArray
from indexing.skeleton import Skeleton

MAX_WINDOWS = 500  # exemplars by whose distances between joints a layout is recognized
MAX_DISTORTION = 0.25  # of the mean joint distance: the right layout fits to .02-.12 (one clip: .25), wrong ones to .34-.71
NUM_SHUFFLES = 20  # random layouts that show what fits by chance
MAX_CHANCE_RATIO = 0.5  # of their mean distortion, which the right layout stays below


def mirror_permutation(skeleton: Skeleton | None, windows: Tensor, seen: Tensor | None = None) -> Tensor | None:
    """``(joints,)`` index of every joint's mirror image (itself on the midline), or ``None`` where it cannot be told."""
    if skeleton is not None:
        named = from_names(skeleton.joints)
        if named is not None:
            return named
    return from_data(windows, seen)


def from_names(names: tuple[str, ...]) -> Tensor | None:
    """From names that say left and right (``left_knee``, ``LKnee``, ``knee.r``...); ``None`` where no pair is found."""
    index = {name: i for i, name in enumerate(names)}
    swap = list(range(len(names)))
    for name, i in index.items():
        for pattern, other in _SIDES:
            partner, changed = re.subn(pattern, other, name, count=1)
            if changed and partner != name and partner in index:
                swap[i] = index[partner]
                break
    if all(i == j for i, j in enumerate(swap)) or any(swap[j] != i for i, j in enumerate(swap)):
        return None
    return torch.tensor(swap)


_SIDES = (
    ("left", "right"), ("right", "left"), ("Left", "Right"), ("Right", "Left"), ("LEFT", "RIGHT"), ("RIGHT", "LEFT"),
    (r"(?<![a-zA-Z])[lL](?=[A-Z_\-. ])", lambda m: {"l": "r", "L": "R"}[m[0]]),
    (r"(?<![a-zA-Z])[rR](?=[A-Z_\-. ])", lambda m: {"r": "l", "R": "L"}[m[0]]),
    (r"(?<=[_\-. ])[lL](?![a-zA-Z])", lambda m: {"l": "r", "L": "R"}[m[0]]),
    (r"(?<=[_\-. ])[rR](?![a-zA-Z])", lambda m: {"r": "l", "R": "L"}[m[0]]),
    (r"^l(?=[a-z]{3})", "r"), (r"^r(?=[a-z]{3})", "l"),
)  # fmt: skip


# Mirror pairs of the common layouts, by number of joints, for data that come without names.
_LAYOUTS: dict[int, tuple[tuple[tuple[int, int], ...], ...]] = {
    13: (((1, 2), (3, 4), (5, 6), (7, 8), (9, 10), (11, 12)),),  # Penn Action
    14: (((0, 5), (1, 4), (2, 3), (6, 11), (7, 10), (8, 9)),),  # LSP
    15: (
        ((3, 6), (4, 7), (5, 8), (9, 12), (10, 13), (11, 14)),  # NITE: head, neck, torso, then limb by limb
        ((3, 4), (5, 6), (7, 8), (9, 10), (11, 12), (13, 14)),  # JHMDB: joint by joint
        ((2, 5), (3, 6), (4, 7), (8, 11), (9, 12), (10, 13)),  # OpenPose MPI
    ),
    16: (((0, 5), (1, 4), (2, 3), (10, 15), (11, 14), (12, 13)),),  # MPII
    17: (
        ((1, 2), (3, 4), (5, 6), (7, 8), (9, 10), (11, 12), (13, 14), (15, 16)),  # COCO
        ((1, 4), (2, 5), (3, 6), (11, 14), (12, 15), (13, 16)),  # Human3.6M
    ),
    18: (((2, 5), (3, 6), (4, 7), (8, 11), (9, 12), (10, 13), (14, 15), (16, 17)),),  # OpenPose COCO
    20: (
        ((4, 8), (5, 9), (6, 10), (7, 11), (12, 16), (13, 17), (14, 18), (15, 19)),  # Kinect SDK
        ((0, 1), (4, 5), (7, 8), (9, 10), (11, 12), (13, 14), (15, 16), (17, 18)),  # MSR Action3D
    ),
    24: (((1, 2), (4, 5), (7, 8), (10, 11), (13, 14), (16, 17), (18, 19), (20, 21), (22, 23)),),  # SMPL
    25: (
        ((4, 8), (5, 9), (6, 10), (7, 11), (12, 16), (13, 17), (14, 18), (15, 19), (21, 23), (22, 24)),  # Kinect 2
        ((2, 5), (3, 6), (4, 7), (9, 12), (10, 13), (11, 14), (15, 16), (17, 18), (19, 22), (20, 23), (21, 24)),  # BODY_25
    ),
    26: (
        ((1, 2), (3, 4), (5, 6), (7, 8), (9, 10), (11, 12), (13, 14), (15, 16), (20, 21), (22, 23), (24, 25)),  # Halpe
    ),
    33: (
        (
            (1, 4), (2, 5), (3, 6), (7, 8), (9, 10), (11, 12), (13, 14), (15, 16), (17, 18), (19, 20), (21, 22), (23, 24),
            (25, 26), (27, 28), (29, 30), (31, 32),
        ),  # MediaPipe
    ),
}  # fmt: skip


def from_data(windows: Tensor, seen: Tensor | None = None) -> Tensor | None:
    r"""The common layout with this number of joints whose mirror image keeps the distances between joints. windows
    ``(N, length, joints, 2)``."""
    joints = windows.shape[2]
    if joints not in _LAYOUTS:
        return None
    if seen is None:
        seen = torch.ones(len(windows), joints, dtype=torch.bool)
    x = windows.double()
    apart = (x[:, :, :, None] - x[:, :, None]).abs()
    both = (seen[:, :, None] & seen[:, None]).double()
    known = both.sum(0) > 0
    mean = [(d.mean(1) * both).sum(0) / both.sum(0).clamp(min=1) for d in (apart[..., 1], apart.square().sum(-1).sqrt())]
    tables = torch.stack(mean)
    tables = tables / (tables.sum(dim=(1, 2), keepdim=True) / known.sum().clamp(min=1)).clamp(min=1e-30)

    def distortion(swap: Tensor) -> float:
        counted = known & known[swap][:, swap]
        return float((tables - tables[:, swap][:, :, swap]).abs().mean(0)[counted].mean())

    shuffles = torch.Generator().manual_seed(0)
    chance = sum(distortion(torch.randperm(joints, generator=shuffles)) for _ in range(NUM_SHUFFLES)) / NUM_SHUFFLES
    best, chosen = min(MAX_DISTORTION, MAX_CHANCE_RATIO * chance), None
    for pairs in _LAYOUTS[joints]:
        swap = torch.arange(joints)
        for i, j in pairs:
            swap[i], swap[j] = j, i
        if distortion(swap) < best:
            best, chosen = distortion(swap), swap
    return chosen


# ----------------------------------------------------------------------------------------------------------------------
# Virtual views of the exemplars: what they would look like to cameras placed elsewhere.
#
# Where an exemplar has 3D joints they are rendered (:func:`indexing.cameras.virtual`).  Where it has one image only, the
# person is taken for a flat card and the card is turned: a random horizontal squeeze or mirror image with a slight pitch.
# Measured, that gives 65-85 % of the gain of true 3D to a view-bound kernel and nearly all of it once heights are compared
# too; it needs no weights, no training and no particular joints.


def turn(windows: Tensor, azimuth: FloatArray, pitch: FloatArray) -> Tensor:
    """Flat cards turned about the vertical and pitched, seen orthographically. windows ``(N, length, joints, 2)``, azimuth,
    pitch ``(N,)`` -> ``(N, length, joints, 2)``."""
    rotations = torch.tensor(np.stack([rotation(a, p) for a, p in zip(azimuth, pitch, strict=True)]))
    rotations = rotations.to(windows)
    centred = windows - windows.mean(dim=(1, 2), keepdim=True)
    return torch.einsum("nij,ntkj->ntki", rotations[:, :2, :2], centred)


def mirror(windows: Tensor, permutation: Tensor) -> Tensor:
    """The same action done by the other side of the body: image mirrored, left and right joints exchanged."""
    flipped = windows[:, :, permutation].clone()
    flipped[..., 0].neg_()
    return flipped
