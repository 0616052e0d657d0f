"""Who is who where a frame shows several people: the one place where that is decided.

An *identity* is a set of detections, at most one per frame, taken to be one person: the tracker's ids where the file has
them, otherwise people linked from frame to frame by position (:func:`link`).  On identities the rules are:

- ``"largest"``: in each frame, the identity with the largest bounding boxes, summed over the whole recording, of those
  present.  It does not hop between two people who are both there, and it continues with the next largest where that
  person is absent, so broken tracks of one person join up.
- ``"confident"``: the same with mean joint confidence in place of the area.
- ``"tracked"``: one identity only, and empty frames where it is absent: the id seen in most frames (of equals, the larger);
  without ids, the identity with the largest summed box.
- ``"all"``: every tracked identity by itself; needs ids in the file.
- ``"everyone"``: the same, with identities by position where the file has no ids.

Ids that repeat within a frame are not identities (some tools write the same id for everybody) and are not used.
Detections without an id, in a file that has ids, are used by ``"largest"`` and ``"confident"`` where no other is there.
"""

from __future__ import annotations

from collections.abc import Hashable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from indexing.clip import FloatArray
from indexing.opening import error

if TYPE_CHECKING:
    from indexing.readers.recording import Recording

IntArray = NDArray[np.int64]
POINT = 0.2  # of the scene, that counts as the box of a person of whom there is only one point
REACH = 0.5  # box diagonals: a joint moves less from one detection of a person to the next, another person is farther away
WAITING = 256
"""Identities that are waited for at most, the latest seen: where nobody matches, the time for all detections is linear.  A frame
before 256 takes 0.1 ms (17 joints)."""


def choose(path: Path, recording: Recording, person: str) -> list[tuple[Hashable | None, IntArray]]:
    """The detections that make each clip.

    Args:
        recording: joints not seen are NaN, and every detection has at least one joint.
        person: the rule (see the module).

    Returns:
        per clip, the identity (None where people are not tracked) and its rows of the recording, one per frame.

    Raises:
        ValueError: ``"all"`` without ids, or ``"confident"`` without confidences.
    """
    ids, names, repeated = _given(recording)
    if person == "all" and ids is None:
        why = f"its person ids repeat in frame {repeated}" if repeated is not None else "it has no person ids"
        raise error(path, f"person='all' needs tracked people, but {why}", "run a tracker, or use person='largest' or 'tracked'")
    if person in ("all", "everyone"):
        ids = link(recording.at, recording.joints) if ids is None else ids
        return [(name, np.flatnonzero(ids == i)) for i, name in enumerate(names or range(int(ids.max()) + 1))]
    if person == "confident" and recording.confidence is None:
        raise error(path, "has no confidences, so person='confident' cannot be applied", "use person='largest' or 'tracked'")
    if ids is None and len(np.unique(recording.at)) == len(recording.at):
        return [(None, np.arange(len(recording.at)))]  # never more than one person
    area = _areas(recording.joints)
    weight = recording.confidence.mean(axis=1) if person == "confident" and recording.confidence is not None else area
    tracked = ids is not None
    if ids is None:
        ids = link(recording.at, recording.joints)
    known = np.maximum(ids, 0)
    total = np.bincount(known, weight * (ids >= 0))
    if person == "tracked":
        count = np.bincount(known, ids >= 0) if tracked else np.zeros(len(total))
        best = np.lexsort((total, count))[-1]
        return [(names[best] if tracked else None, np.flatnonzero(ids == best))]
    rank = np.where(ids >= 0, total[known], -1.0)
    order = np.lexsort((weight, rank, recording.at))  # by frame, and within it the best last
    last = np.append(np.diff(recording.at[order]) > 0, True)
    return [(None, order[last])]


def _given(recording: Recording) -> tuple[IntArray | None, list[Hashable], int | None]:
    """Ids 0, 1, ... of the detections (-1: none) and their names; None, and the frame where they repeat, if unusable."""
    if recording.tracks is None or all(track is None for track in recording.tracks):
        return None, [], None
    index: dict[Hashable, int] = {}
    for track in recording.tracks:
        if track is not None:
            index.setdefault(track, len(index))
    ids = np.array([-1 if track is None else index[track] for track in recording.tracks], dtype=np.int64)
    pairs = np.stack([recording.at[ids >= 0], ids[ids >= 0]], axis=1)
    unique, counts = np.unique(pairs, axis=0, return_counts=True)
    if (counts > 1).any():
        return None, [], int(recording.frames[unique[np.argmax(counts > 1), 0]])
    return ids, list(index), None


def link(at: IntArray, joints: FloatArray) -> IntArray:
    """Identities by position: each detection continues the nearest identity, nearest pairs first.

    An identity is expected one step farther along its last movement (people who cross would swap otherwise), and waits there
    until :data:`WAITING` others have been seen since.  Distance is the mean over the joints that both show, in units of the
    larger box's diagonal; beyond :data:`REACH` a new identity begins.  Tracked points have no box: one alone in every frame is
    always the same one.

    Args:
        at: ``(m,)`` frame of each detection.
        joints: ``(m, n, 2 | 3)``, NaN = not seen.

    Returns:
        ``(m,)`` identities 0, 1, ...

    Example:
        >>> import numpy as np
        >>> box = np.array([[0.0, 0.0], [10.0, 20.0]])
        >>> link(np.array([0, 0, 1, 1]), np.stack([box, box + 100, box + 101, box + 1])).tolist()
        [0, 1, 1, 0]
    """
    identity = np.full(len(at), -1, dtype=np.int64)
    count, waiting = 0, np.zeros(0, dtype=np.int64)
    last = np.zeros(len(at), dtype=np.int64)  # per identity, its latest detection,
    step = np.zeros((len(at), joints.shape[2]))  # and how far it had moved since the one before
    diagonal = np.linalg.norm(_extents(joints), axis=1)
    if len(at) and not (diagonal > 0).any():
        if len(np.unique(at)) == len(at):
            return np.zeros(len(at), dtype=np.int64)
        diagonal[:] = POINT * np.linalg.norm(_extents(joints.reshape(1, -1, joints.shape[2])))
    for rows in np.split(np.argsort(at, kind="stable"), np.flatnonzero(np.diff(np.sort(at))) + 1):
        before = last[waiting]
        cost = _distances(joints[before] + step[waiting, None], joints[rows], np.maximum.outer(diagonal[before], diagonal[rows]))
        while cost.size and cost.min() <= REACH:
            old, new = (int(i) for i in np.unravel_index(int(np.argmin(cost)), cost.shape))
            who, row = waiting[old], rows[new]
            step[who] = np.nanmean(joints[row] - joints[last[who]], axis=0)
            identity[row], last[who] = who, row
            cost[old, :] = cost[:, new] = np.inf
        fresh = rows[identity[rows] < 0]
        identity[fresh] = np.arange(count, count + len(fresh))
        last[identity[fresh]] = fresh
        count += len(fresh)
        waiting = _latest(np.append(waiting, identity[fresh]), at, last)
    return identity


def _latest(waiting: IntArray, at: IntArray, last: IntArray) -> IntArray:
    """Of some identities the :data:`WAITING` that were seen last, and all seen in the same frame as the first of these."""
    if len(waiting) <= WAITING:
        return waiting
    frames = at[last[waiting]]
    return waiting[frames >= np.partition(frames, -WAITING)[-WAITING]]


def _distances(awaited: FloatArray, found: FloatArray, size: FloatArray) -> FloatArray:
    """``(awaited, found)`` mean joint distance in units of ``size``; infinite where no joint is shown by both."""
    apart = np.linalg.norm(awaited[:, None] - found[None], axis=3)
    both = ~np.isnan(apart)
    shared = both.sum(axis=2)
    usable = (shared > 0) & (size > 0)
    mean = np.where(both, apart, 0.0).sum(axis=2) / np.maximum(shared, 1)
    return np.where(usable, mean / np.where(usable, size, 1.0), np.inf)


def _extents(joints: FloatArray) -> FloatArray:
    """``(m, d)`` sides of the boxes around the joints seen."""
    seen = ~np.isnan(joints)
    return np.asarray(np.where(seen, joints, -np.inf).max(axis=1) - np.where(seen, joints, np.inf).min(axis=1))


def _areas(joints: FloatArray) -> FloatArray:
    """``(m,)`` area of the box around the joints seen; in 3D, of its largest face."""
    return np.asarray(np.sort(_extents(joints), axis=1)[:, -2:].prod(axis=1))
