"""Joints by name: which joint of a clip is which of those learned, decided here for every indexer and command."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence

import numpy as np

from indexing.clip import Clip
from indexing.skeleton import Skeleton

FEWEST = 3  # joints in common, and half of those learned: fewer cannot be compared
LISTED = 4  # names in a message


def named(skeleton: Skeleton | None) -> bool:
    """Whether the joints have names of their own; numbers are none.

    Example:
        >>> named(Skeleton("hand", ("wrist", "tip"))), named(Skeleton("any", ("0", "1"))), named(None)
        (True, False, False)
    """
    if skeleton is None:
        return False
    names = [_plain(joint) for joint in skeleton.joints]
    return len(set(names)) == len(names) and not all(name.isdigit() or not name for name in names)


def layout_of(clips: Sequence[Clip]) -> Skeleton | None:
    """Whose names the joints of many clips go by: the first with names, else the first with bones."""
    known = [clip.skeleton for clip in clips if clip.skeleton is not None]
    return next((skeleton for skeleton in known if named(skeleton)), known[0] if known else None)


def matched(clip: Clip, known: Skeleton | None, who: str = "") -> tuple[Clip, str]:
    """The clip with its joints in the order of those known, and what to say about it.

    Both with names: matched by name whatever their order; a joint that the clip does not have counts as not seen, one that is
    not known is left out.  Without names joints are taken in their order, which bones that differ speak against.

    Args:
        known: of the clips learned from; ``None``: nothing is known of theirs.
        who: what to call the clip in messages.

    Raises:
        ValueError: too few joints have the same names, or the layouts contradict each other.

    Example:
        >>> clip = Clip(np.array([[[1.0, 0], [2, 0], [3, 0]]]), skeleton=Skeleton("a", ("hip", "knee", "toe")))
        >>> matched(clip, Skeleton("b", ("Toe", "hip", "knee")))[0].joints[0, :, 0].tolist()
        [3.0, 1.0, 2.0]
    """
    own, who = clip.skeleton, who or f"clip {clip.name!r}"
    if known is None or own is None or not (named(known) and named(own)):
        return clip, _unnamed(clip, known, who)
    if own.joints == known.joints:
        return clip, ""
    place = places(own, known)
    missing = [joint for joint, i in zip(known.joints, place, strict=True) if i < 0]
    shared = len(known.joints) - len(missing)
    if shared < max(FEWEST, len(known.joints) / 2):
        raise ValueError(
            f"{who}: joints: {shared} of its {len(own.joints)} ({_few(own.joints)}) have names of the {len(known.joints)} joints "
            f"learned ({_few(known.joints)}); use clips of one joint layout"
        )
    joints = clip.joints[:, place].copy()
    confidence = None if clip.confidence is None else clip.confidence[:, place].copy()
    gone = np.array(place) < 0
    joints[:, gone] = np.nan
    if confidence is not None:
        confidence[:, gone] = 0.0
    said = ""
    if missing:
        said = f"{who}: {shared} of the {len(known.joints)} joints learned are in it; not {_few(missing)}"
    elif shared < len(own.joints):
        said = f"{who}: of its {len(own.joints)} joints ({own.name}) the {shared} learned ({known.name}) are used"
    return clip.replace(joints=joints, confidence=confidence, skeleton=known), said


def places(own: Skeleton, known: Skeleton) -> list[int]:
    """Where each joint known is among one's own, by name; -1 where it is not.

    Example:
        >>> places(Skeleton("a", ("hip", "knee", "toe")), Skeleton("b", ("Toe", "hand")))
        [2, -1]
    """
    index = {_plain(joint): i for i, joint in enumerate(own.joints)}
    return [index.get(_plain(joint), -1) for joint in known.joints]


def matched_all(clips: Sequence[Clip], known: Skeleton | None) -> list[Clip]:
    """:func:`matched` clips, with a warning where not all joints are used."""
    found = [matched(clip, known, f"clip {i}" + (f" ({clip.name!r})" if clip.name else "")) for i, clip in enumerate(clips)]
    partly = [note for (clip, note), given in zip(found, clips, strict=True) if note and clip is not given]
    if partly:
        warnings.warn(partly[0] + (f" (and {len(partly) - 1} more clips)" if len(partly) > 1 else ""), stacklevel=4)
    return [clip for clip, _ in found]


def _unnamed(clip: Clip, known: Skeleton | None, who: str) -> str:
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


def _plain(joint: str) -> str:
    return re.sub(r"[\W_]+", "", joint.lower())


def _few(joints: Sequence[str]) -> str:
    return ", ".join(joints[:LISTED]) + (", ..." if len(joints) > LISTED else "")
