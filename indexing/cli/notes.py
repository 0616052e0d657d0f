"""What a person should know of the clips that a command read: a sentence each, and nothing where all is as it should be."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dyntorch.numerics import with_words
from indexing.cli.console import count, flag_words, names
from indexing.cli.flags.shared import Reading
from indexing.clip import Clip, stretches
from indexing.recordings.people import Appearance, Crowd
from indexing.remarks import FOLLOWED, remarks_on
from indexing.sync.people import jumps

SLOW, FAST = 5.0, 480.0  # frames per second given by hand, beyond which they are mentioned
STILL = 0.005  # of a body's size: joints that stay this close to their places do not move
LISTED = 3  # moments, and names of joints
WORDS = flag_words("fps", "person", "min_confidence", "format", "layout", size="--size W H")


def clip_notes(clips: Sequence[Clip], reading: Reading) -> list[str]:
    """On clips of any use: who is in them, in which units, and at which rate."""
    found = [*_people(clips, reading), *(with_words(one, WORDS) for one in remarks_on(clips, reading.size is not None))]
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
    found = []
    for clip in clips:
        cuts = stretches(clip.times)
        if len(cuts) > 1:
            ends = [f"{clip.times[end - 1]:.6g}" for _, end in cuts[:-1].tolist()]
            listed = ", ".join(ends[:LISTED]) + " and more" * (len(ends) > LISTED)
            found.append(f"{clip.name}: no frames for a while after {listed} s; its {len(cuts)} parts are searched by themselves")
    return found


def on_people(name: str, crowd: Crowd) -> list[str]:
    """On who is in view, who comes and goes, and what was left out."""
    found = []
    if len(crowd.people) > 1:
        told = "by the file's ids" if crowd.by_ids else "by position, as the file has no ids to rely on"
        found.append(
            f"{len(crowd.people)} people in view, told apart {told}; each is scanned by itself; --person largest follows one"
        )
    if not crowd.people:
        found.append("nobody is in view for long enough to be scanned")
    if crowd.ghosts:
        reasons = ", ".join(f"{number} {reason}" for reason, number in crowd.ghosts.items())
        found.append(f"{count(sum(crowd.ghosts.values()), 'track')} left out, as of no person ({reasons})")
    if crowd.untracked:
        found.append(f"{count(crowd.untracked, 'detection')} without an id left out; --person largest uses them")
    found += first_sentences([_appears(one) for one in crowd.appearances])
    found += first_sentences([_is_away(who, crowd) for who in dict.fromkeys(one.person for one in crowd.absences)])
    swapped = "change places at {:.2f} s; their ids may be swapped there"
    found += first_sentences([f"persons {one.first} and {one.second} {swapped.format(one.at)}" for one in crowd.exchanges])
    return [f"{name}: {sentence}" for sentence in found]


def _appears(one: Appearance) -> str:
    where = "where" if one.near else "elsewhere than"
    perhaps = "may be the same" if one.near else "may be the same or not"
    return f"person {one.person} appears at {one.at:.1f} s {where} person {one.left} left at {one.since:.1f} s: {perhaps}"


def _is_away(who: str, crowd: Crowd) -> str:
    spans = [f"{one.start:.1f} to {one.end:.1f} s" for one in crowd.absences if one.person == who]
    listed = ", ".join(spans[:LISTED]) + f" and {count(len(spans) - LISTED, 'time')} more" * (len(spans) > LISTED)
    if crowd.by_ids:
        return f"person {who} is out of view from {listed}; that it is the same person says the file's id"
    return f"nobody is in view from {listed}; whoever comes then may be somebody else"


def first_sentences(sentences: Sequence[str]) -> list[str]:
    """The first of many, and how many more there are."""
    more = len(sentences) - LISTED
    return [*sentences[:LISTED], *([f"and so {count(more, 'time')} more"] if more > 0 else [])]


def _people(clips: Sequence[Clip], reading: Reading) -> list[str]:

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


def _is_still(clip: Clip) -> bool:

    seen = clip.joints[:, clip.seen.any(axis=0)]
    if len(seen) < 2:
        return False
    size = float(np.linalg.norm(np.nanmax(seen, axis=(0, 1)) - np.nanmin(seen, axis=(0, 1))))
    moved = np.nanmax(seen, axis=0) - np.nanmin(seen, axis=0)
    return bool(np.nanmax(np.linalg.norm(moved, axis=1)) <= STILL * size)
