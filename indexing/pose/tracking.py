"""People followed through consecutive frames of a video: one tracker looks at one piece of it, in the order of its frames.

1. Whoever was in the frame before is looked for where the network saw the body then, farther along where it moves fast.
2. Who is not there any more is let go; of two tracks that came to sit on one person, the one that leapt.
3. The detector looks at the whole picture when somebody is missing, and from time to time.
4. Who is new there is looked at more than once, and followed from then on.

Nothing is smoothed, and nothing is filled in: a frame shows what the network saw in it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from indexing.pose.blazepose import (
    CIRCLE,
    HIPS,
    JOINTS,
    PICTURE,
    REGION,
    Floats,
    Landmarks,
    Region,
    VideoPicture,
    about,
    candidates,
    landmarks,
)
from indexing.pose.networks import Networks

MAX_CANDIDATES = 12  # people of one picture that are looked at, the largest first
MIN_PRESENCE = 0.5  # probability that the region shows somebody who is followed; MediaPipe's value
MIN_NEW_PRESENCE = 0.9  # the same for somebody new, at every look: of 30 regions without a person three had more
REGION_SCALE = 1.25  # side in diameters of the circle about the hips that holds the body; MediaPipe's value
NUM_LOOKS = 2  # at a new person, each from the region of the look before: the detector's regions are rough
SEARCH_SECONDS = 0.5  # between two searches of the whole picture
CLOSER_SEARCH_SECONDS = 2.0  # between searches in enlarged parts, which take some 20 looks
MIN_SIZE_RATIO = 1.5  # of somebody new to the smallest of those followed, to take that place
SAME_PLACE_RADII = 0.5  # between hips: a detection of somebody who is followed already
DUPLICATE_RADII = 0.3  # between joints, in the mean: two tracks on one person
STATIC_RADII = 0.1  # per frame, up to which a region stays: motion that small is noise


@dataclass(frozen=True)
class PoseOptions:
    """Options of :func:`indexing.pose.detect`."""

    chunk_seconds: float = 30.0
    """Seconds of a chunk of a long video: what an interruption costs at most, and a worker's share.  Short ones cost decoding, as
    each begins at a key frame before it: with key frames 8 s apart, one of 30 s costs 13 % more."""
    lead_seconds: float = 0.25
    """Seconds before a chunk that are looked at, too, and not kept, so that its first regions come from landmarks."""
    min_score: float = 0.5
    """Of the detector for a person in the picture; MediaPipe's value."""
    min_closer_score: float = 0.65
    """The same in enlarged parts: there parts of people and of furniture get up to .74, people whom it sees whole .7 and more."""
    zooms: tuple[int, ...] = (1, 2, 3)
    """The detector looks at the picture, and where that is not enough, at overlapping squares of one part in so many of its longer
    side."""
    farther_zooms: tuple[int, ...] = (5,)
    """The same where nobody is found by these.  People of 140 pixels in a picture of 1920: in .69 of the frames without it, in .95
    with it; of 100 pixels, in none and in .83."""
    max_absence: float = 2.0
    """Seconds within which somebody who is lost and found is the same."""


@dataclass(frozen=True, eq=False)
class Sighting:
    """One person in one frame: which track, ``(33, 2)`` pixels, ``(33,)`` confidences."""

    track: int
    joints: Floats
    confidence: Floats


@dataclass(eq=False)
class _Followed:
    """Somebody who is followed: where to look next, how fast that moves (pixels per second), and what was seen last."""

    number: int
    region: Region
    joints: Floats
    confidence: Floats
    time: float
    speed: tuple[float, float] = (0.0, 0.0)
    leap: float = 0.0


@dataclass
class Tracker:
    """Follows up to so many people from frame to frame."""

    networks: Networks
    people: int
    options: PoseOptions
    crowd: list[int] = field(default_factory=list)  # how many people were in view, whenever the detector looked
    begun: int = 0  # tracks so far
    _followed: list[_Followed] = field(default_factory=list)
    _searched: float = -math.inf
    _looked_closer: float = -math.inf

    def step(self, picture: VideoPicture, time: float) -> list[Sighting]:
        """Everybody who is seen in a frame; frames come in order, at ``time`` seconds."""
        before = len(self._followed)
        self._follow(picture, time)
        lost = not self._followed or len(self._followed) < before
        if lost or time - self._searched >= SEARCH_SECONDS:
            self._search(picture, time)
        return [Sighting(one.number, one.joints, one.confidence) for one in self._followed]

    # ---- who was there before ----
    def _follow(self, picture: VideoPicture, time: float) -> None:
        kept = []
        for one in self._followed:
            region = self._predict_region(one, time)
            if self._update(one, picture, region, time):
                kept.append(one)
        self._followed = self._remove_duplicates(kept)

    def _predict_region(self, one: _Followed, time: float) -> Region:
        """Where to look for somebody: where the body was, or farther along if it moves by more than noise does."""
        step = time - one.time
        dx, dy = one.speed[0] * step, one.speed[1] * step
        reach = self._radius(one.region)
        moves = STATIC_RADII * reach < math.hypot(dx, dy) < reach
        return replace(one.region, x=one.region.x + dx, y=one.region.y + dy) if moves else one.region

    def _update(self, one: _Followed, picture: VideoPicture, region: Region, time: float) -> bool:
        """Look for somebody in a region; whether anybody is there."""
        found = self._look(picture, region)
        if found is None:
            return False
        seen, following = found
        step = time - one.time
        if step > 0:
            one.speed = (following.x - one.region.x) / step, (following.y - one.region.y) / step
        one.leap = math.hypot(following.x - region.x, following.y - region.y) / self._radius(following)
        self._record(one, seen, region, following, time)
        return True

    def _record(self, one: _Followed, seen: Landmarks, region: Region, following: Region, time: float) -> None:
        one.joints = region.to_picture(seen.places[:JOINTS])
        one.confidence, one.region, one.time = seen.confidence[:JOINTS], following, time

    def _look(self, picture: VideoPicture, region: Region) -> tuple[Landmarks, Region] | None:
        """What a region shows and the next region; None where nobody is in it."""
        if not region.usable(picture.width, picture.height):
            return None
        seen = landmarks(*self.networks.landmarks(picture.extract_region(region, REGION)))
        if not (seen.present >= MIN_PRESENCE and np.isfinite(seen.places).all()):
            return None
        hips, circle = region.to_picture(seen.places[[HIPS, CIRCLE]])
        following = about(hips, circle, REGION_SCALE)
        return (seen, following) if following.usable(picture.width, picture.height) else None

    def _remove_duplicates(self, people: list[_Followed]) -> list[_Followed]:
        """Without those who sit on somebody else: the one that leapt farther goes, of equals the later one."""
        gone: set[int] = set()
        for i, one in enumerate(people):
            for other in people[i + 1 :]:
                if one.number not in gone and other.number not in gone and self._are_duplicates(one, other):
                    gone.add(one.number if one.leap > other.leap + DUPLICATE_RADII else other.number)
        return [one for one in people if one.number not in gone]

    def _are_duplicates(self, one: _Followed, other: _Followed) -> bool:
        apart = float(np.linalg.norm(one.joints - other.joints, axis=1).mean())
        return apart < DUPLICATE_RADII * max(self._radius(one.region), self._radius(other.region))

    def _radius(self, region: Region) -> float:
        return region.side / (2 * REGION_SCALE)

    # ---- who is new ----
    def _search(self, picture: VideoPicture, time: float) -> None:
        """Look at the whole picture, and closer where nobody is found there, or from time to time where some are still wanted."""
        wait = CLOSER_SEARCH_SECONDS if self._followed and self.people > 1 else SEARCH_SECONDS
        closer = time - self._looked_closer >= wait
        self._searched = time
        shrinks, farther = self.options.zooms, self.options.farther_zooms
        for shrink in (*shrinks, *farther):
            if shrink > 1:
                if self._followed and shrink in farther:
                    break
                if not closer or (self._followed if self.people == 1 else len(self._followed) >= self.people):
                    break
                self._looked_closer = time
            found = [region for region in self._detect(picture, shrink) if not self._is_followed(region)]
            if shrink == 1:
                self.crowd.append(len(found) + len(self._followed))
            for region in found:
                self._admit(picture, region, time)

    def _admit(self, picture: VideoPicture, region: Region, time: float) -> None:
        """Follow somebody new, if there is a place, or somebody much smaller has one."""
        full = len(self._followed) >= self.people
        smallest = min(self._followed, key=lambda one: one.region.side, default=None)
        if not full:
            self._begin(picture, region, time, None)
        elif smallest is not None and region.side >= MIN_SIZE_RATIO * smallest.region.side:
            self._begin(picture, region, time, smallest)

    def _detect(self, picture: VideoPicture, shrink: int) -> list[Region]:
        """Regions about the people whom the detector sees, the largest first."""
        least = self.options.min_score if shrink == 1 else self.options.min_closer_score
        found: list[Region] = []
        for window in windows(picture.width, picture.height, max(picture.width, picture.height) / shrink):
            seen = candidates(*self.networks.detector(picture.extract_region(window, PICTURE, fill=True)), least)
            found += [about(hips, circle, REGION_SCALE) for hips, circle, *_ in window.to_picture(seen.points)]
        return self._distinct(found)[:MAX_CANDIDATES]

    def _distinct(self, regions: list[Region]) -> list[Region]:
        """The largest first, and each person once, though windows overlap."""
        kept: list[Region] = []
        for region in sorted(regions, key=lambda one: (-one.side, one.x, one.y)):
            if not any(self._same_place(region, other) for other in kept):
                kept.append(region)
        return kept

    def _is_followed(self, region: Region) -> bool:
        return any(self._same_place(region, one.region) for one in self._followed)

    def _same_place(self, a: Region, b: Region) -> bool:
        return math.hypot(a.x - b.x, a.y - b.y) < SAME_PLACE_RADII * max(self._radius(a), self._radius(b))

    def _begin(self, picture: VideoPicture, region: Region, time: float, instead: _Followed | None) -> None:
        """Follow somebody new, if the region shows a person who is not followed already."""
        seen: Landmarks | None = None
        used = following = region
        for _ in range(NUM_LOOKS):
            found = self._look(picture, following)
            if found is None or found[0].present < MIN_NEW_PRESENCE:
                return
            used, (seen, following) = following, found
        if seen is None:
            return
        one = _Followed(self.begun, following, np.empty(0), np.empty(0), time)
        self._record(one, seen, used, following, time)
        others = [other for other in self._followed if other is not instead]
        if any(self._are_duplicates(one, other) for other in self._followed):
            return
        self.begun += 1
        self._followed = [*others, one]


def windows(width: int, height: int, side: float) -> list[Region]:
    """Squares that overlap by half and cover a picture; one, about its middle, where it is as large as the picture."""

    def middles(length: int) -> list[float]:
        count = 1 + math.ceil(max(0.0, length - side) / (side / 2) - 1e-9)
        spare = max(0.0, length - side)
        return [length / 2] if count == 1 else [side / 2 + spare * k / (count - 1) for k in range(count)]

    return [Region(x, y, side) for y in middles(height) for x in middles(width)]


# ----------------------------------------------------------------------------------------------------------------------
# Who is who in a video: tracks, which end where somebody is lost and where a chunk ends, joined to people.


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
        cost = np.array([_association_cost(owner[-1], one, max_absence) for owner in recent for one in fresh])
        cost = cost.reshape(-1, len(fresh))
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
    return sorted(people, key=lambda rows: (-float(np.ptp(seen.joints[rows], axis=1).prod(axis=1).sum()), int(rows[0])))


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
