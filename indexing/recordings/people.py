"""Who is in a recording: which tracks are people, what they are called, and who comes, goes and changes places.

A file with several people is read as one clip per identity (``person="everyone"``: by the ids of the file, else by position).
What follows from that is decided here, and nothing more than what was seen: a detector's ghosts are left out, and somebody who
leaves and returns is the same person only where the file's own ids say so.  Everything that a reader should know besides is
returned as data.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from indexing.clip import Clip, FloatArray
from indexing.windows import describe_unusable

IntArray = NDArray[np.intp]
GhostReason = Literal["too short", "too few joints", "at one place"]


MIN_SHARE = 0.5  # of the recording: whoever is in view for so much of it is a person, however short the recording
MIN_JOINTS = 3  # seen in half the frames: of fewer nothing can be compared (indexing.action.bank.MIN_SHARED_JOINTS)
MIN_ABSENCE = 1.0  # seconds out of view, from which on a person has left; detectors lose a person for less
MAX_RETURN_DISTANCE = 1.0  # box diagonals between where one left and another appears: there it may be the same
MAX_JUMP = 0.5  # box diagonals from one frame to the next: the reader's reach for one person
MIN_EXCHANGE_RATIO = 4.0  # times nearer to each other's last places than to their own, for two identities to have changed places


@dataclass(frozen=True, eq=False)
class TrackedPerson:
    """One person of a recording; the name is empty where never more than one is in view."""

    name: str
    clip: Clip


@dataclass(frozen=True)
class Appearance:
    """A person who comes into view at ``at`` seconds after ``left`` was last seen at ``since``: perhaps the same."""

    person: str
    at: float
    left: str
    since: float
    near: bool


@dataclass(frozen=True)
class Absence:
    """A person who is out of view from ``start`` to ``end`` (seconds)."""

    person: str
    start: float
    end: float


@dataclass(frozen=True)
class Exchange:
    """Two identities of which each is, at ``at`` seconds, where the other was a frame before."""

    first: str
    second: str
    at: float


@dataclass(frozen=True, eq=False)
class Crowd:
    """Who is in a recording."""

    people: tuple[TrackedPerson, ...]
    ghosts: dict[GhostReason, int]
    by_ids: bool
    untracked: int = 0
    appearances: tuple[Appearance, ...] = ()
    absences: tuple[Absence, ...] = ()
    exchanges: tuple[Exchange, ...] = ()


@dataclass(frozen=True, eq=False)
class _Track:
    """A clip and what is asked of it again and again: when it is seen, and how large, ``(frames seen,)``."""

    clip: Clip
    times: FloatArray
    rows: IntArray
    sides: FloatArray  # (frames seen, dims) of the box

    @property
    def area(self) -> float:
        """Summed over time; in 3D, of the box's largest face."""
        return float(np.sort(self.sides, axis=1)[:, -2:].prod(axis=1).sum())

    @property
    def size(self) -> float:
        return float(np.median(np.linalg.norm(self.sides, axis=1)))


def of_recording(clips: Sequence[Clip]) -> bool:
    """Whether clips are the people of one recording, as the readers follow them, and not a set of recordings."""
    return bool(clips) and all({"followed", "person"} <= clip.meta.keys() for clip in clips)


def tracked_people(clips: Sequence[Clip], name: str = "", min_seconds: float = 0.5) -> Crowd:
    """The people of one recording from its identities; tracks of less than ``min_seconds`` in view are ghosts of the detector."""
    by_ids = clips[0].meta["followed"] == "ids"
    is_complete = by_ids or clips[0].meta["person"] is None
    parts = list(clips) if is_complete else [part for clip in clips for part in _split_absences(clip)]
    step = _step(clips)
    length = max(clip.times[-1] for clip in clips) - min(clip.times[0] for clip in clips) + step
    least = min(MIN_JOINTS, max(int(clip.seen.sum(axis=1).max()) for clip in clips))
    tracks, ghosts = [], Counter[GhostReason]()
    for part in parts:
        reason = _ghost(part, step, length, least, min_seconds)
        if reason is None:
            tracks.append(_track(part))
        else:
            ghosts[reason] += 1
    if not by_ids and tracks and not _overlap(tracks):
        tracks = [_track(_merge_identities(tracks))]
    tracks.sort(key=lambda track: (-track.area, track.times[0]))
    alone = not by_ids and len(tracks) == 1
    names = [""] if alone else [str(track.clip.meta["person"]) if by_ids else str(i) for i, track in enumerate(tracks, 1)]
    people = tuple(
        TrackedPerson(who, track.clip.replace(name=name if not who else f"{name}#{who}"))
        for who, track in zip(names, tracks, strict=True)
    )
    return Crowd(
        people,
        dict(ghosts),
        by_ids,
        int(clips[0].meta.get("untracked", 0)),
        tuple(_appearances(names, tracks)),
        tuple(Absence(who, *gap) for who, track in zip(names, tracks, strict=True) for gap in _absences(track)),
        tuple(_exchanges(names, tracks)),
    )


def _track(clip: Clip) -> _Track:
    rows = np.flatnonzero(clip.seen.any(axis=1))
    joints = clip.joints[rows]
    return _Track(clip, clip.times[rows], rows, np.nanmax(joints, axis=1) - np.nanmin(joints, axis=1))


def _step(clips: Sequence[Clip]) -> float:
    """Seconds between the frames of a recording, of which every clip has a part."""
    steps = [np.diff(clip.times) for clip in clips if len(clip) > 1]
    return float(np.median(np.concatenate(steps))) if steps else 0.0


def _split_absences(clip: Clip) -> list[Clip]:
    """An identity by position, cut where it is out of view for long; frames that do not show it at an end are left out."""
    rows = np.flatnonzero(clip.seen.any(axis=1))
    cuts = np.flatnonzero(np.diff(clip.times[rows]) > MIN_ABSENCE) + 1
    if not len(cuts) and len(rows) == len(clip):
        return [clip]
    return [_rows(clip, slice(int(some[0]), int(some[-1]) + 1)) for some in np.split(rows, cuts) if len(some)]


def _rows(clip: Clip, rows: slice) -> Clip:
    confidence = None if clip.confidence is None else clip.confidence[rows]
    return clip.replace(joints=clip.joints[rows], times=clip.times[rows], confidence=confidence)


def _ghost(clip: Clip, step: float, length: float, least: int, min_seconds: float) -> GhostReason | None:
    """Why an identity is no person."""
    joints = clip.seen.sum(axis=1)
    shown = joints > 0
    if shown.sum() * step < min(min_seconds, MIN_SHARE * length) - step / 2 or len(clip) < 2:
        return "too short"
    if np.median(joints[shown]) < least:
        return "too few joints"
    return "at one place" if describe_unusable(clip, point=True) else None


def _overlap(tracks: Sequence[_Track]) -> bool:
    """Whether any two are ever in view in the same frame."""
    moments = np.concatenate([track.times for track in tracks])
    return len(np.unique(moments)) < len(moments)


def _merge_identities(tracks: Sequence[_Track]) -> Clip:
    """Identities that are never in view together as one clip, without the frames between them that another's clip has empty."""
    if len(tracks) == 1:
        return tracks[0].clip
    clips = [_rows(track.clip, slice(int(track.rows[0]), int(track.rows[-1]) + 1)) for track in tracks]
    times, seen = np.concatenate([clip.times for clip in clips]), np.concatenate([clip.seen.any(axis=1) for clip in clips])
    order = np.lexsort((~seen, times))  # of the rows of one moment, the one that shows somebody first
    order = order[np.append(True, np.diff(times[order]) > 0)]
    sure = (
        None if clips[0].confidence is None else np.concatenate([clip.confidence for clip in clips if clip.confidence is not None])
    )
    joints = np.concatenate([clip.joints for clip in clips])[order]
    return clips[0].replace(joints=joints, times=times[order], confidence=None if sure is None else sure[order])


def _absences(track: _Track) -> list[tuple[float, float]]:
    """When a person is out of view; a pause of the recording itself is none, where the clip has all of its frames."""
    away = np.diff(track.times) > MIN_ABSENCE
    if track.clip.meta["person"] is None:
        away &= np.diff(track.rows) > 1
    return [(float(track.times[i]), float(track.times[i + 1])) for i in np.flatnonzero(away)]


def _appearances(names: Sequence[str], tracks: Sequence[_Track]) -> list[Appearance]:
    """Whoever comes after somebody else has left; of those who may be the same, who left nearby, and of these the latest."""
    if not tracks:
        return []
    begin = min(float(track.times[0]) for track in tracks)
    appearances = []
    for who, track in zip(names, tracks, strict=True):
        at = float(track.times[0])
        candidates: list[tuple[bool, float, str]] = []
        for other, left in zip(names, tracks, strict=True):
            before = int(np.searchsorted(left.times, at)) - 1
            if left is track or before < 0:
                continue  # itself, or not there yet
            gone = before + 1 == len(left.times)
            if not gone and left.times[before + 1] - left.times[before] <= MIN_ABSENCE:
                continue  # in view all the time
            near = _distance(left, before, track) <= MAX_RETURN_DISTANCE * max(left.size, track.size)
            if near or gone:
                candidates.append((near, float(left.times[before]), other))
        if candidates and at > begin:
            near, since, other = max(candidates)
            appearances.append(Appearance(who, at, other, since, near))
    return sorted(appearances, key=lambda one: one.at)


def _distance(left: _Track, row: int, track: _Track) -> float:
    """From the middle of one person's joints in a frame to that of another's first."""
    a, b = left.clip.joints[left.rows[row]], track.clip.joints[track.rows[0]]
    return float(np.linalg.norm(np.nanmean(a, axis=0) - np.nanmean(b, axis=0)))


def _exchanges(names: Sequence[str], tracks: Sequence[_Track]) -> list[Exchange]:
    """Where two identities are, from one frame to the next, at each other's places."""
    leaps = [(who, track, _leaps(track)) for who, track in zip(names, tracks, strict=True)]
    exchanges = []
    for (first, a, mine), (second, b, other) in combinations([one for one in leaps if len(one[2])], 2):
        for at in np.intersect1d(mine, other).tolist():
            now, then = _pair(a, at), _pair(b, at)
            own_distance = min(_mean(now[1] - now[0]), _mean(then[1] - then[0]))
            crossed = max(_mean(now[1] - then[0]), _mean(then[1] - now[0]))
            if own_distance > MIN_EXCHANGE_RATIO * crossed:
                exchanges.append(Exchange(first, second, float(at)))
    return sorted(exchanges, key=lambda one: one.at)


def _leaps(track: _Track) -> FloatArray:
    """The times at which a person is farther from where it was a frame before than anybody goes."""
    if len(track.times) < 2:
        return np.empty(0)
    joints = track.clip.joints[track.rows]
    distance = np.linalg.norm(np.diff(joints, axis=0), axis=2)
    known = np.isfinite(distance)
    mean = np.where(known, distance, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    return np.asarray(track.times[1:][(mean > MAX_JUMP * track.size) & (np.diff(track.times) <= MIN_ABSENCE)])


def _pair(track: _Track, at: float) -> tuple[Any, Any]:
    row = int(np.searchsorted(track.times, at))
    joints = track.clip.joints
    return joints[track.rows[row - 1]], joints[track.rows[row]]


def _mean(differences: FloatArray) -> float:
    """Mean length over the joints that both show; infinite where there is none."""
    lengths = np.linalg.norm(differences, axis=1)
    known = np.isfinite(lengths)
    return float(lengths[known].mean()) if known.any() else np.inf
