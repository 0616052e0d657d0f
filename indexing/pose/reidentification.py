"""Who is who in a video: tracks, which end where somebody is lost and where a piece of the video ends, joined to people.

This needs nothing but the tracks, so that it comes out the same however the work was divided.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from indexing.pose.blazepose import Floats

Indices = NDArray[np.int64]

MAX_RETURN_RADII = 0.6  # between the joints then and now, in the mean, after no time
RETURN_SPEED = 1.0  # radii per second by which that grows: a step aside, not a run


@dataclass(frozen=True, eq=False)
class Sightings:
    """Everybody in every frame of a video or a part of it."""

    times: Floats  # ``(frames,)`` seconds
    at: Indices  # ``(m,)`` the frame of each sighting, not decreasing
    tracks: Indices  # ``(m,)`` which track it belongs to
    joints: Floats  # ``(m, n, 2)`` pixels; confidence: ``(m, n)``
    confidence: Floats
    crowd: Indices = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    notes: tuple[str, ...] = ()  # what a user should know


def concatenate(parts: Sequence[Sightings]) -> Sightings:
    """Consecutive parts of a video as one; each has tracks of its own."""
    frames = np.cumsum([0, *(len(part.times) for part in parts)])
    tracks = np.cumsum([0, *(int(part.tracks.max(initial=-1)) + 1 for part in parts)])
    return Sightings(
        np.concatenate([part.times for part in parts]),
        np.concatenate([part.at + first for part, first in zip(parts, frames, strict=False)]),
        np.concatenate([part.tracks + first for part, first in zip(parts, tracks, strict=False)]),
        np.concatenate([part.joints for part in parts]),
        np.concatenate([part.confidence for part in parts]),
        np.concatenate([part.crowd for part in parts]),
        tuple(dict.fromkeys(note for part in parts for note in part.notes)),
    )


@dataclass(frozen=True, eq=False)
class _Stretch:
    """A track: when it begins and ends, what it shows there, and how large the person is."""

    rows: Indices
    begin: float
    end: float
    first: Floats
    last: Floats

    @property
    def size(self) -> float:
        return max(_size(self.first), _size(self.last))


def identities(seen: Sightings, max_absence: float = 2.0) -> list[Indices]:
    """The sightings of each person, the largest person first."""
    order = np.argsort(seen.tracks, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(seen.tracks[order])) + 1) if len(order) else []
    tracks = sorted((_stretch(seen, rows) for rows in groups), key=lambda one: (one.begin, -one.size))
    owners: list[list[_Stretch]] = []
    recent: list[list[_Stretch]] = []  # those of them who may return; an hour has thousands of tracks
    for moment, begun in groupby(tracks, key=lambda one: one.begin):
        fresh = list(begun)
        recent = [owner for owner in recent if moment - owner[-1].end <= max_absence]
        cost = np.array([[_association_cost(owner[-1], one, max_absence) for one in fresh] for owner in recent]).reshape(
            -1, len(fresh)
        )
        taken = set()
        while cost.size and cost.min() <= 1:
            i, j = (int(k) for k in np.unravel_index(int(np.argmin(cost)), cost.shape))
            recent[i].append(fresh[j])
            taken.add(j)
            cost[i, :] = cost[:, j] = np.inf
        new = [[one] for j, one in enumerate(fresh) if j not in taken]
        owners += new
        recent += new
    people = [np.sort(np.concatenate([one.rows for one in owner])) for owner in owners]
    return sorted(people, key=lambda rows: (-float(_areas(seen.joints[rows]).sum()), int(rows[0])))


def largest(seen: Sightings, people: Sequence[Indices]) -> Indices:
    """One sighting a frame: of the person who is the largest over the whole video, among those who are there."""
    rank = np.zeros(len(seen.at), dtype=np.int64)
    for number, rows in enumerate(people):
        rank[rows] = number
    order = np.lexsort((rank, seen.at))
    first = np.append(True, np.diff(seen.at[order]) > 0)[: len(order)]
    return np.asarray(order[first])


def _stretch(seen: Sightings, rows: Indices) -> _Stretch:
    rows = rows[np.argsort(seen.at[rows], kind="stable")]
    times = seen.times[seen.at[rows]]
    return _Stretch(rows, float(times[0]), float(times[-1]), seen.joints[rows[0]], seen.joints[rows[-1]])


def _association_cost(old: _Stretch, new: _Stretch, max_absence: float) -> float:
    """How far somebody is from where somebody was, in what is allowed; infinite where they cannot be the same."""
    gap = new.begin - old.end
    if not 0 < gap <= max_absence:
        return np.inf
    size = max(_size(old.last), _size(new.first)) / 2
    allowed = size * (MAX_RETURN_RADII + RETURN_SPEED * gap)
    far = float(np.linalg.norm(old.last - new.first, axis=1).mean())
    return far / allowed if allowed > 0 else np.inf


def _size(joints: Floats) -> float:
    """The diagonal of the box about somebody."""
    return float(np.linalg.norm(joints.max(axis=0) - joints.min(axis=0)))


def _areas(joints: Floats) -> Floats:
    return np.asarray((joints.max(axis=1) - joints.min(axis=1)).prod(axis=1))
