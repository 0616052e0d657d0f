"""What is to be said of a recording that was read without an error and still may not be what it seems.

Commands, :func:`indexing.synchronize` and the archive say the same of the same clips: the sentences are here, and whoever shows
them words their arguments (``size=`` or ``--size``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from dyntorch.numerics import Message
from indexing.clip import Clip, FloatArray

NAMED = 4  # clips that a sentence names; of more it says how many


MAX_NORMALIZED = 1.5  # coordinates from 0 to 1 stay below it, those of joints guessed outside of the image too
FOLLOWED = {"largest": "the largest", "confident": "the one that the detector trusts most", "tracked": "one who is tracked"}
"""Who of several people is followed, in words, by the rules of :mod:`indexing.readers.recording`."""


def describe_issues(clips: Sequence[Clip], sized: bool = False) -> list[Message]:
    """What to know of clips besides who is in them: shape of the image, layout of the joints, clock."""
    messages = [] if sized else _group(clips, lambda clip: _STRETCHED if is_normalized(clip) else "")
    messages += _group(clips, _layout)
    messages += _group(clips, _lag)
    return messages


_STRETCHED = "coordinates from 0 to 1, so the shape of the image is not known and people may be stretched; give {arg:size=}"


def is_normalized(clip: Clip) -> bool:
    """Whether a clip has coordinates of an image from 0 to 1: of images that are not square, people come out too wide or narrow."""
    return clip.dims == 2 and clip.up == "-y" and bool(clip.seen.any()) and float(np.nanmax(np.abs(clip.joints))) <= MAX_NORMALIZED


def _layout(clip: Clip) -> str:
    """Which joint is which, where a reader had to find out by itself (``meta["layout"]``)."""
    how, _, which = str(clip.meta.get("layout", "")).partition(": ")
    if how == "recognized":
        return f"its joints are taken for {which}, which is how the body looks; {{arg:layout=}} says otherwise"
    if how == "guessed":
        taken, _, others = which.partition(", not ")
        also = f", though as many joints may be {others}" if others else ""
        return f"its joints are taken for {taken} by their number{also}; {{arg:layout=}} says otherwise"
    return ""


def _lag(clip: Clip) -> str:
    """Whether a program smoothed the recording (``meta["may_lag"]``)."""
    if not clip.meta.get("may_lag"):
        return ""
    return "may be smoothed by MediaPipe, whose tracking lags by up to 2.4 frames where movement is quick; 'dyntorch pose' does not"


def _group(clips: Sequence[Clip], sentence_of: Callable[[Clip], str]) -> list[Message]:
    """One message for all clips of which the same is to be said."""
    who: dict[str, dict[str, None]] = {}
    for clip in clips:
        sentence = sentence_of(clip)
        if sentence:
            who.setdefault(sentence, {})[clip.name or "clip"] = None
    return [Message("{names}: " + sentence, names=_names(list(named))) for sentence, named in who.items()]


def _names(found: list[str]) -> str:
    return ", ".join(found[:NAMED]) + (f" and {len(found) - NAMED} more" if len(found) > NAMED else "")


def same_clips(clips: Sequence[Clip]) -> list[tuple[int, int]]:
    """Pairs of clips that hold the same joints, each later one with its first: one recording given twice, whatever it is
    called."""
    first: dict[tuple[tuple[int, ...], bytes], int] = {}
    pairs = []
    for i, clip in enumerate(clips):
        key = clip.joints.shape, _digest(clip.joints)
        earlier = first.setdefault(key, i)
        if earlier != i:
            pairs.append((earlier, i))
    return pairs


def _digest(joints: FloatArray) -> bytes:
    """Of the values, whatever their type, their order in memory and the kind of their NaN; 0 and -0 are one place."""
    from hashlib import sha256

    values = np.where(np.isnan(joints), np.nan, joints).astype(np.float32) + np.float32(0)
    values[np.isnan(values)] = np.nan
    return sha256(np.ascontiguousarray(values).tobytes()).digest()
