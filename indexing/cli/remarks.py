"""What a person should know of the clips that a command read: a sentence each, and nothing where all is as it should be."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from indexing.cli.console import count, names

if TYPE_CHECKING:
    from indexing.cli.inputs import KnownEvent, Reading
    from indexing.clip import Clip

SLOW, FAST = 5.0, 480.0  # frames per second given by hand, beyond which they are mentioned
STILL = 0.005  # of a body's size: joints that stay this close to their places do not move
LISTED = 3  # moments, and names of joints
FOLLOWED = {"largest": "the largest", "confident": "the one that the detector trusts most", "tracked": "one who is tracked"}


def remarks(clips: Sequence[Clip], reading: Reading) -> list[str]:
    """On clips of any use: who is in them, in which units, and at which rate."""
    found = [*_people(clips, reading), *_stretched(clips, reading)]
    if reading.fps is not None and not SLOW <= reading.fps <= FAST and clips:
        length = max(clip.duration for clip in clips)
        found.append(f"--fps {reading.fps:g}: the longest clip lasts {length:.3g} s then; is that so?")
    return found


def on_examples(clips: Sequence[Clip]) -> list[str]:
    """On clips to learn from."""
    still = [clip.name for clip in clips if _is_still(clip)]
    found = [f"{names(list(dict.fromkeys(still)))}: nobody moves there; a pose is learned, not an action"] if still else []
    lost: dict[int, list[str]] = {}
    for clip in clips:
        lost.setdefault(int((~clip.seen.any(axis=0)).sum()), []).append(clip.name)
    found += [
        f"{missing} of {count(clips[0].joints.shape[1], 'joint')} are never seen in {names(list(dict.fromkeys(which)))}; what they "
        "do is not learned"
        for missing, which in sorted(lost.items())
        if missing
    ]
    return [*found, *on_classes([str(clip.label) for clip in clips])]


def on_classes(labels: Sequence[str]) -> list[str]:
    """On what a model can tell apart."""
    known = sorted(set(labels))
    if len(known) != 2:
        return []
    return [
        f"{known[0]} and {known[1]} are all that is known, and most of a recording looks like one of two: add examples of ordinary "
        "movement, such as standing and walking about"
    ]


def on_gaps(clips: Sequence[Clip]) -> list[str]:
    """On recordings that pause."""
    from indexing.clip import stretches

    found = []
    for clip in clips:
        cuts = stretches(clip.times)
        if len(cuts) > 1:
            ends = [f"{clip.times[end - 1]:.6g}" for _, end in cuts[:-1].tolist()]
            listed = ", ".join(ends[:LISTED]) + " and more" * (len(ends) > LISTED)
            found.append(f"{clip.name}: no frames for a while after {listed} s; its {len(cuts)} parts are searched by themselves")
    return found


def on_truth(truth: Sequence[Sequence[KnownEvent]], recordings: Sequence[Any]) -> list[str]:
    """On known events that the recordings do not show; of videos that is not known before they are read."""
    from indexing.clip import Clip

    found = []
    for clip, events in zip(recordings, truth, strict=True):
        if not isinstance(clip, Clip):
            continue
        out = [event for event in events if event[2] < clip.times[0] or event[1] > clip.times[-1]]
        if out:
            label, start, end = out[0]
            first = f"{label} at {start:g} to {end:g} s" + ", ..." * (len(out) > 1)
            runs = f"{clip.name} runs from {clip.times[0]:.6g} to {clip.times[-1]:.6g} s"
            found.append(f"{runs}: {count(len(out), 'known event')} outside of it cannot be found ({first})")
    return found


def _people(clips: Sequence[Clip], reading: Reading) -> list[str]:
    from indexing.syncing.people import jumps

    found = []
    for clip in clips:
        people = clip.meta.get("people")
        if people is None or reading.person not in FOLLOWED:
            continue
        moments = jumps(clip) if clip.dims == 2 else []
        listed = ", ".join(f"{moment:.2f}" for moment in moments[:LISTED]) + " and more" * (len(moments) > LISTED)
        where = f", somebody else from {listed} s on" if moments else ""
        found.append(
            f"{clip.name}: {people} people in view; followed is {FOLLOWED[reading.person]}{where}; --person says otherwise"
        )
    return found


def _stretched(clips: Sequence[Clip], reading: Reading) -> list[str]:
    """Pixel coordinates from 0 to 1: of images that are not square, people come out too wide or too narrow."""
    import numpy as np

    if reading.size is not None:
        return []
    some = [
        clip.name
        for clip in clips
        if clip.dims == 2 and clip.up == "-y" and clip.seen.any() and float(np.nanmax(np.abs(clip.joints))) <= 1.5
    ]
    if not some:
        return []
    who = names(list(dict.fromkeys(some)))
    return [f"{who}: coordinates from 0 to 1, so the shape of the image is not known and people may be stretched; give --size W H"]


def _is_still(clip: Clip) -> bool:
    import numpy as np

    seen = clip.joints[:, clip.seen.any(axis=0)]
    if len(seen) < 2:
        return False
    size = float(np.linalg.norm(np.nanmax(seen, axis=(0, 1)) - np.nanmin(seen, axis=(0, 1))))
    moved = np.nanmax(seen, axis=0) - np.nanmin(seen, axis=0)
    return bool(np.nanmax(np.linalg.norm(moved, axis=1)) <= STILL * size)
