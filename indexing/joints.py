"""Joints by name: which joint of a clip is which of those learned, decided here for every indexer and command.

A name counts whatever its spelling (``LShoulder``, ``left_shoulder``, ``shoulder.L``).  Different words are one joint only where
they mean the same point (:data:`SAME`): the middle of the hips, and the top of the head.  What is only near has another name and
is not matched: the upper neck of BODY_25B and the neck of BODY_25 between the shoulders, the centre of the head of depth sensors
and its top, MediaPipe's ``foot_index`` and the big toe.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dyntorch.numerics import Message
from indexing.clip import LARGEST, UP_AXES, Clip, FloatArray
from indexing.opening import error
from indexing.skeleton import MEASURED, Skeleton, candidates, layout_named

FEWEST = 3  # joints in common, and half of those learned: fewer cannot be compared
LISTED = 4  # names in a message
SAME = {
    **dict.fromkeys(("midhip", "hip", "hips", "pelvis", "root", "chip", "centerhip"), "midhip"),
    **dict.fromkeys(("head", "headtop", "topofhead"), "headtop"),
}
"""Words for one and the same point, by their letters alone; those with a side are put together by :func:`canonical`."""
PARTS = "shoulder|elbow|wrist|hip|knee|ankle|heel|eye|ear|hand|foot|bigtoe|smalltoe|thumb|index|pinky|mouth|footindex"
_SIDED = tuple(
    re.compile(pattern)
    for pattern in (
        *(r"(?P<side>left|right)(?P<part>.+)", r"(?P<part>.+)(?P<side>left|right)"),
        *(rf"(?P<side>[lr])(?P<part>{PARTS})", rf"(?P<part>{PARTS})(?P<side>[lr])"),
    )
)
# of faces and hands: what they lack does not make another layout of a body
_DETAIL = re.compile(
    r"face|(left|right)(hand.|eye|ear)|brow|lip|jaw|contour|nosebridge|mouth|"
    r"(left|right)(thumb|index|middle|ring|pinky|handtip)(?!toe)"
)


def has_names(skeleton: Skeleton | None) -> bool:
    """Whether the joints have names of their own; numbers are none.

    Example:
        >>> has_names(Skeleton("hand", ("wrist", "tip"))), has_names(Skeleton("any", ("0", "1"))), has_names(None)
        (True, False, False)
    """
    if skeleton is None:
        return False
    names = [_letters(joint) for joint in skeleton.joints]
    return len(set(names)) == len(names) and not all(name.isdigit() or not name for name in names)


def layout_of(clips: Sequence[Clip]) -> Skeleton | None:
    """Whose names the joints of many clips go by: the first with names, else the first with bones."""
    skeletons = [clip.skeleton for clip in clips if clip.skeleton is not None]
    return next((skeleton for skeleton in skeletons if has_names(skeleton)), skeletons[0] if skeletons else None)


def match_joints(clip: Clip, known: Skeleton | None, who: str = "") -> tuple[Clip, str]:
    """The clip with its joints in the order of those known, and what to say about it."""
    own, who = clip.skeleton, who or f"clip {clip.name!r}"
    if known is None or own is None or not (has_names(known) and has_names(own)):
        return clip, _note_unnamed(clip, known, who)
    if own.joints == known.joints:
        return clip, ""
    place = places(own, known)
    missing = [joint for joint, i in zip(known.joints, place, strict=True) if i < 0]
    shared = len(known.joints) - len(missing)
    counted = _of_body(known)
    if sum(place[i] >= 0 for i in counted) < max(FEWEST, len(counted) / 2):
        raise ValueError(
            f"{who}: joints: {shared} of its {len(own.joints)} ({_list_some(own.joints)}) have names of the "
            f"{len(known.joints)} joints learned ({_list_some(known.joints)}); use clips of one joint layout"
        )
    joints = clip.joints[:, place].copy()
    confidence = None if clip.confidence is None else clip.confidence[:, place].copy()
    gone = np.array(place) < 0
    joints[:, gone] = np.nan
    if confidence is not None:
        confidence[:, gone] = 0.0
    message = ""
    if missing:
        message = f"{who}: {shared} of the {len(known.joints)} joints learned are in it; not {_list_some(missing)}"
    elif shared < len(own.joints):
        message = f"{who}: of its {len(own.joints)} joints ({own.name}) the {shared} learned ({known.name}) are used"
    if message and (own.name in MEASURED) != (known.name in MEASURED):
        message += "; one layout is of markers or a depth sensor, so joints of the same name lie near each other, not on each other"
    return clip.replace(joints=joints, confidence=confidence, skeleton=known), message


def places(own: Skeleton, known: Skeleton) -> list[int]:
    """Where each joint known is among one's own, by name; -1 where it is not."""
    index = {_letters(joint): i for i, joint in enumerate(own.joints)}
    words = [canonical(joint) for joint in own.joints]
    wanted = [canonical(joint) for joint in known.joints]
    alike = {word: i for i, word in enumerate(words) if words.count(word) == 1 and wanted.count(word) == 1}
    indices = [index.get(_letters(joint), -1) for joint in known.joints]
    taken = set(indices)
    return [
        alike.get(word, -1) if i < 0 and alike.get(word, -1) not in taken else i for i, word in zip(indices, wanted, strict=True)
    ]


def canonical(joint: str) -> str:
    """What a joint is, whatever it is called."""
    plain = _letters(joint)
    if plain in SAME:
        return SAME[plain]
    if plain == "rear" and not re.match(r"[rR](E|[\W_])", joint):  # the back of an animal
        return plain
    found = next((match for pattern in _SIDED if (match := pattern.fullmatch(plain))), None)
    return plain if found is None else {"l": "left", "r": "right"}[found["side"][0]] + found["part"]


def _of_body(known: Skeleton) -> list[int]:
    """The joints that say whether a layout is another one: all but those of face and fingers, or all where there are no others."""
    body = [i for i, joint in enumerate(known.joints) if not _DETAIL.search(canonical(joint))]
    return body or list(range(len(known.joints)))


def match_all(clips: Sequence[Clip], known: Skeleton | None) -> list[Clip]:
    """:func:`match_joints` clips, with a warning where not all joints are used."""
    matches = [match_joints(clip, known, f"clip {i}" + (f" ({clip.name!r})" if clip.name else "")) for i, clip in enumerate(clips)]
    partly = [note for (clip, note), given in zip(matches, clips, strict=True) if note and clip is not given]
    if partly:
        warnings.warn(partly[0] + (f" (and {len(partly) - 1} more clips)" if len(partly) > 1 else ""), stacklevel=4)
    return [clip for clip, _ in matches]


def _note_unnamed(clip: Clip, known: Skeleton | None, who: str) -> str:
    own = clip.skeleton
    if known is None and own is None:
        return ""
    if known is not None and own is not None:
        bones = [{tuple(sorted(bone)) for bone in skeleton.bones} for skeleton in (own, known)]
        if len(own.joints) == len(known.joints) and all(bones) and bones[0] != bones[1]:
            raise ValueError(
                f"{who}: joints: their bones ({own.name}) are not those learned ({known.name}), so the same number is another "
                "joint; use clips of one joint layout, or name the joints of both"
            )
        if bones[0] == bones[1]:
            return ""
    return f"{who}: its joints have no names in common with those learned; joint 0 is taken for joint 0, and so on"


def _letters(joint: str) -> str:
    return re.sub(r"[\W_]+", "", joint.lower())


def _list_some(joints: Sequence[str]) -> str:
    return ", ".join(joints[:LISTED]) + (", ..." if len(joints) > LISTED else "")


# ----------------------------------------------------------------------------------------------------------------------
# Which joint is which where a file only has numbers: decided by what a body looks like


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
    fits = []
    for layout in layouts:
        bones = _bones(some, layout)
        best = max(((_posture(some, layout, axis), axis) for axis in ups), default=(-1.0, "y"))
        fits.append(LayoutFit(layout, bones, *best))
    return sorted(fits, key=lambda fit: -fit.value)


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
    fit = recognize_layout(joints, layouts, up) if len(joints) else None
    if fit is not None:
        message = {} if fit.layout is usual else {"layout": f"recognized: {fit.layout.name}"}
        return fit.layout, message, fit.up
    if usual is None or len(layouts) < 2:
        return usual, {}, None
    others = " or ".join(layout.name for layout in layouts if layout is not usual)
    return usual, {"layout": f"guessed: {usual.name}, not {others}"}, None


def estimate_up(joints: FloatArray, names: Sequence[str], usual: str) -> str:
    """The direction that is up for a body whose joints have names; the usual one where the body does not show it."""
    words = [canonical(name) for name in names]
    plain = {word.replace("_", ""): word for word in HEIGHT}
    joints_of_body = [plain.get(word, plain.get(re.sub("^(left|right)", "", word), f"joint {i}")) for i, word in enumerate(words)]
    fit = rank_layouts(joints, [Skeleton("", tuple(joints_of_body))], None)[0]
    return fit.up if fit.posture >= MIN_POSTURE else usual


def check_named_layout(path: Path, name: str, joints: int, own: Skeleton | None = None) -> Skeleton:
    """The layout that a person names."""
    layout = layout_named(name)
    if len(layout.joints) != joints:
        same = ", ".join(one.name for one in candidates(joints)) or "none"
        what = f"has {joints} joints, but layout={layout.name} has {len(layout.joints)}"
        raise error(path, what, f"name another one (of {joints} joints: {same}), or leave it out")
    layout_joints = {canonical(joint) for joint in layout.joints}
    pairs = zip(own.joints if own is not None else (), layout.joints, strict=False)  # names that the layout has elsewhere
    mismatch = next(((a, b) for a, b in pairs if canonical(a) in layout_joints and canonical(a) != canonical(b)), None)
    if mismatch is not None:
        message = f"names its joints itself ({mismatch[0]} where layout={layout.name} has {mismatch[1]})"
        raise error(path, message, Message("leave {arg:layout=} out, or correct the names in the file"))
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
    usable = seen.sum(axis=1) >= MIN_JOINTS
    if not usable.any():
        return -1.0
    seen, high = seen[usable], np.where(seen, high, 0.0)[usable]
    usual = np.where(seen, usual, 0.0)
    share = seen.sum(axis=1, keepdims=True)
    a, b = (np.where(seen, values - values.sum(axis=1, keepdims=True) / share, 0.0) for values in (high, usual))
    size = np.sqrt(np.square(a).sum(axis=1) * np.square(b).sum(axis=1))
    return float(np.median((a * b).sum(axis=1) / np.where(size > 0, size, np.inf)))
