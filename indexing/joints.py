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

import numpy as np

from indexing.clip import Clip
from indexing.skeleton import MEASURED, Skeleton

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
    known = [clip.skeleton for clip in clips if clip.skeleton is not None]
    return next((skeleton for skeleton in known if has_names(skeleton)), known[0] if known else None)


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
    said = ""
    if missing:
        said = f"{who}: {shared} of the {len(known.joints)} joints learned are in it; not {_list_some(missing)}"
    elif shared < len(own.joints):
        said = f"{who}: of its {len(own.joints)} joints ({own.name}) the {shared} learned ({known.name}) are used"
    if said and (own.name in MEASURED) != (known.name in MEASURED):
        said += "; one layout is of markers or a depth sensor, so joints of the same name lie near each other, not on each other"
    return clip.replace(joints=joints, confidence=confidence, skeleton=known), said


def places(own: Skeleton, known: Skeleton) -> list[int]:
    """Where each joint known is among one's own, by name; -1 where it is not."""
    index = {_letters(joint): i for i, joint in enumerate(own.joints)}
    words = [canonical(joint) for joint in own.joints]
    wanted = [canonical(joint) for joint in known.joints]
    alike = {word: i for i, word in enumerate(words) if words.count(word) == 1 and wanted.count(word) == 1}
    found = [index.get(_letters(joint), -1) for joint in known.joints]
    taken = set(found)
    return [alike.get(word, -1) if i < 0 and alike.get(word, -1) not in taken else i for i, word in zip(found, wanted, strict=True)]


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


def matched_all(clips: Sequence[Clip], known: Skeleton | None) -> list[Clip]:
    """:func:`match_joints` clips, with a warning where not all joints are used."""
    found = [match_joints(clip, known, f"clip {i}" + (f" ({clip.name!r})" if clip.name else "")) for i, clip in enumerate(clips)]
    partly = [note for (clip, note), given in zip(found, clips, strict=True) if note and clip is not given]
    if partly:
        warnings.warn(partly[0] + (f" (and {len(partly) - 1} more clips)" if len(partly) > 1 else ""), stacklevel=4)
    return [clip for clip, _ in found]


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
