"""Which joint is which where a file only has numbers: decided by what a body looks like, said where it is not clear, or told.

Layouts of one number of joints (BODY_25, BODY_25B and NTU-25; COCO-17 and H36M-17) are told apart by two numbers each:

- *bones*: the mean length of the bones of the layout, over the mean distance of any two joints.  Joints of another layout that are
  taken for these are joined across the body;
- *posture*: the correlation of how high the joints are with how high they are in people who stand (body segments after Drillis
  and Contini, as in Winter, Biomechanics and Motor Control of Human Movement).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dyntorch.numerics import Message
from indexing.clip import LARGEST, UP_AXES, FloatArray
from indexing.joints import canonical
from indexing.opening import error
from indexing.skeleton import Skeleton, candidates, layout_named

HEIGHT = {
    "head_top": 1.0, "head": 1.0, "head_center": 0.95, "eye": 0.94, "ear": 0.93, "nose": 0.92, "upper_neck": 0.87,
    "neck_base": 0.87, "neck": 0.83, "thorax": 0.82, "spine_shoulder": 0.82, "shoulder_center": 0.82, "shoulder": 0.82,
    "chest": 0.72, "spine": 0.67, "spine_mid": 0.67, "mid_hip": 0.53, "root": 0.53, "spine_base": 0.53, "hip_center": 0.53,
    "hip": 0.53, "knee": 0.29, "ankle": 0.04, "heel": 0.01, "foot": 0.01, "foot_index": 0.01, "big_toe": 0.01, "small_toe": 0.01,
}  # fmt: skip
"""Of joints of people who stand, in heights of the body; hands are anywhere."""


MAX_BONES = 0.65
"""Mean length of bones over the mean distance of two joints; .26 to .45 with the right layout, .34 to 1.06 with a wrong one."""
MIN_POSTURE = 0.8
"""Correlation of heights with those of people who stand; .98 to 1 with the right layout, up to .75 with a wrong one."""
MIN_LEAD = 0.2  # posture less bones, by which the best of several layouts that could be is ahead of the next
MAX_FRAMES = 200  # looked at, evenly over the recording
MIN_JOINTS = 8  # seen in a frame, of those whose height says something, that its posture counts


class LayoutFit(NamedTuple):
    """How well joints are a body of a layout: bones and posture as in the module, and the direction that is up then."""

    layout: Skeleton
    bones: float
    posture: float
    up: str

    @property
    def value(self) -> float:
        return self.posture - self.bones


def rank_layouts(joints: FloatArray, layouts: Sequence[Skeleton], up: str | None) -> list[LayoutFit]:
    """Each layout's fit, best first. joints ``(frames, n, 2 | 3)``."""
    some = np.asarray(joints[np.unique(np.linspace(0, len(joints) - 1, MAX_FRAMES).round().astype(int))], dtype=np.float64)
    some = np.where(np.abs(some) <= LARGEST, some, np.nan)
    ups = [axis for axis in UP_AXES if "xyz".index(axis[-1]) < joints.shape[2]] if up is None else [up]
    found = []
    for layout in layouts:
        bones = _bones(some, layout)
        best = max(((_posture(some, layout, axis), axis) for axis in ups), default=(-1.0, "y"))
        found.append(LayoutFit(layout, bones, *best))
    return sorted(found, key=lambda fit: -fit.value)


def recognize_layout(joints: FloatArray, layouts: Sequence[Skeleton], up: str | None) -> LayoutFit | None:
    """The layout that the joints are of, where that is clear."""
    could = [fit for fit in rank_layouts(joints, layouts, up) if fit.bones <= MAX_BONES and fit.posture >= MIN_POSTURE]
    return could[0] if len(could) == 1 or (could and could[0].value - could[1].value >= MIN_LEAD) else None


def choose_layout(
    joints: FloatArray,
    usual: Skeleton | None,
    layouts: Sequence[Skeleton],
    up: str | None,
) -> tuple[Skeleton | None, dict[str, str], str | None]:
    """The layout of joints whose number alone is known."""
    found = recognize_layout(joints, layouts, up) if len(joints) else None
    if found is not None:
        said = {} if found.layout is usual else {"layout": f"recognized: {found.layout.name}"}
        return found.layout, said, found.up
    if usual is None or len(layouts) < 2:
        return usual, {}, None
    others = " or ".join(layout.name for layout in layouts if layout is not usual)
    return usual, {"layout": f"guessed: {usual.name}, not {others}"}, None


def estimate_up(joints: FloatArray, names: Sequence[str], usual: str) -> str:
    """The direction that is up for a body whose joints have names; the usual one where the body does not show it."""
    words = [canonical(name) for name in names]
    plain = {word.replace("_", ""): word for word in HEIGHT}
    known = [plain.get(word, plain.get(re.sub("^(left|right)", "", word), f"joint {i}")) for i, word in enumerate(words)]
    found = rank_layouts(joints, [Skeleton("", tuple(known))], None)[0]
    return found.up if found.posture >= MIN_POSTURE else usual


def check_named_layout(path: Path, name: str, joints: int, own: Skeleton | None = None) -> Skeleton:
    """The layout that a person names."""
    layout = layout_named(name)
    if len(layout.joints) != joints:
        same = ", ".join(one.name for one in candidates(joints)) or "none"
        what = f"has {joints} joints, but layout={layout.name} has {len(layout.joints)}"
        raise error(path, what, f"name another one (of {joints} joints: {same}), or leave it out")
    known = {canonical(joint) for joint in layout.joints}
    pairs = zip(own.joints if own is not None else (), layout.joints, strict=False)  # names that the layout has elsewhere
    other = next(((a, b) for a, b in pairs if canonical(a) in known and canonical(a) != canonical(b)), None)
    if other is not None:
        said = f"names its joints itself ({other[0]} where layout={layout.name} has {other[1]})"
        raise error(path, said, Message("leave {arg:layout=} out, or correct the names in the file"))
    return layout


def _bones(joints: FloatArray, layout: Skeleton) -> float:
    """Mean length of bones over the mean distance of two joints; infinite where too little is seen."""
    first, second = np.array(layout.bones, dtype=np.int64).reshape(-1, 2).T
    bones = np.linalg.norm(joints[:, first] - joints[:, second], axis=2)
    rows, columns = np.triu_indices(joints.shape[1], 1)
    pairs = np.linalg.norm(joints[:, rows] - joints[:, columns], axis=2)
    if not len(first) or np.isfinite(bones).any(axis=0).sum() < len(first) / 2 or not np.nansum(pairs) > 0:
        return float("inf")
    lengths = bones[:, np.isfinite(bones).any(axis=0)]
    return float(np.nanmedian(lengths, axis=0).mean() / np.nanmean(pairs))


def _posture(joints: FloatArray, layout: Skeleton, up: str) -> float:
    """Median over the frames of the correlation of heights; -1 where too little is seen."""
    names = [joint.removeprefix("left_").removeprefix("right_") for joint in layout.joints]
    usual = np.array([HEIGHT.get(name, np.nan) for name in names])
    high = (-1 if up.startswith("-") else 1) * joints[..., "xyz".index(up[-1])]
    seen = np.isfinite(usual) & np.isfinite(high)
    kept = seen.sum(axis=1) >= MIN_JOINTS
    if not kept.any():
        return -1.0
    seen, high = seen[kept], np.where(seen, high, 0.0)[kept]
    usual = np.where(seen, usual, 0.0)
    share = seen.sum(axis=1, keepdims=True)
    a, b = (np.where(seen, values - values.sum(axis=1, keepdims=True) / share, 0.0) for values in (high, usual))
    size = np.sqrt(np.square(a).sum(axis=1) * np.square(b).sum(axis=1))
    return float(np.median((a * b).sum(axis=1) / np.where(size > 0, size, np.inf)))
