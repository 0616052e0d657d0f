"""What one camera saw, cut into pieces that are surely one person each, whatever numbers the tracker gave."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from indexing.calibrate.people.options import AssociationOptions
from indexing.clip import Clip

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class CameraSightings:
    """One camera: all detections of all frames. times ``(frames,)``, places ``(frames, tracks, joints, 2)``, trust
    ``(frames, tracks, joints)``."""

    name: str
    times: Floats
    places: Floats
    trust: Floats

    @property
    def fps(self) -> float:
        """Frames per second, of the usual step."""
        return 1.0 / float(np.median(np.diff(self.times))) if len(self.times) > 1 else 30.0


def sightings(clips: Sequence[Clip], name: str, joints: Sequence[int] | None = None) -> CameraSightings:
    """The people of a camera on the common grid of its frames."""
    times = np.unique(np.concatenate([clip.times for clip in clips]))
    chosen = list(range(clips[0].joints.shape[1])) if joints is None else list(joints)
    places = np.full((len(times), len(clips), len(chosen), 2), np.nan)
    trust = np.zeros(places.shape[:3])
    for track, clip in enumerate(clips):
        rows = np.searchsorted(times, clip.times)
        places[rows, track] = clip.joints[:, chosen]
        sure = np.ones(clip.joints.shape[:2]) if clip.confidence is None else np.clip(clip.confidence, 0.0, 1.0)
        trust[rows, track] = np.where(np.isfinite(clip.joints).all(2), np.nan_to_num(sure), 0.0)[:, chosen]
    return CameraSightings(name, times, places, trust)


@dataclass(frozen=True, eq=False)
class Tracklets:
    """Pieces of tracks of one camera. number ``(frames, tracks)``, starts, ends ``(pieces,)``, links ``(pieces, pieces)``."""

    number: Integers
    starts: Integers
    ends: Integers
    links: Floats
    size: float

    def __len__(self) -> int:
        return len(self.starts)

    @property
    def conflicts(self) -> Booleans:
        """``(pieces, pieces)``: both are seen at once, so they are two people; a piece has none with itself."""
        there = np.zeros((len(self.number), len(self)))
        rows, columns = np.nonzero(self.number >= 0)
        there[rows, self.number[rows, columns]] = 1.0
        both = (there.T @ there) > 0
        np.fill_diagonal(both, False)
        return both


@dataclass
class _End:
    """Where a piece was last seen, and where it goes."""

    piece: int
    frame: int
    track: int
    place: Floats
    velocity: Floats


def cut(seen: CameraSightings, options: AssociationOptions) -> Tracklets:
    """Follow everybody from frame to frame by the joints, and cut where two people could be exchanged."""
    how = options.pieces
    there = (seen.trust > 0).sum(2) >= min(how.seen, seen.places.shape[2])
    number = np.full(there.shape, -1, dtype=np.int64)
    size = _usual_size(seen, there)
    step = max(_usual_step(seen, there), how.least_step * size)
    begun: list[_End] = []
    open_ends: list[_End] = []
    finished: list[_End] = []
    hold = max(1, round(how.hold * seen.fps))
    for frame in range(len(seen.times)):
        tracks = np.flatnonzero(there[frame])
        finished += [end for end in open_ends if frame - end.frame > hold]
        open_ends = [end for end in open_ends if frame - end.frame <= hold]
        pairs, unsure = _followed(open_ends, seen, frame, tracks, step, size, options)
        after: list[_End] = []
        for column, track in enumerate(tracks.tolist()):
            row = pairs.get(column)
            old = open_ends[row] if row is not None else None
            if old is None:
                one = _End(len(begun), frame, track, seen.places[frame, track].copy(), np.zeros(2))
                begun.append(_End(one.piece, frame, track, one.place.copy(), one.velocity))
            else:
                one = _moved(old, seen.places[frame, track], frame, track, how.smooth)
            number[frame, track] = one.piece
            after.append(one)
        going = set(pairs.values())
        finished += [open_ends[row] for row in unsure - going]
        open_ends = [end for row, end in enumerate(open_ends) if row not in going | unsure] + after
    last = sorted([*finished, *open_ends], key=lambda end: end.piece)
    return _with_links(seen, number, begun, last, step, size, options)


def _usual_size(seen: CameraSightings, there: Booleans) -> float:
    """Median diagonal of the boxes, px."""
    if not there.any():
        return 1.0
    known = seen.places[there]
    extent = np.nanmax(known, axis=1) - np.nanmin(known, axis=1)
    return max(float(np.median(np.linalg.norm(extent, axis=1))), 1e-9)


def _usual_step(seen: CameraSightings, there: Booleans) -> float:
    """Median way of a joint from frame to frame, px."""
    steps = np.linalg.norm(np.diff(seen.places, axis=0), axis=-1)[there[1:] & there[:-1]]
    known = steps[np.isfinite(steps)]
    return float(np.median(known)) if known.size else 0.0


def _cost(away: Floats, step: float, options: AssociationOptions) -> Floats:
    """Of ways ``(..., joints)`` px from where somebody is expected, NaN = not known; what nothing is known of costs the limit."""
    worth = options.pieces.joints
    known = np.isfinite(away)
    each = np.where(known, 2 * np.log1p(np.square(np.where(known, away, 0.0)) / (3 * step**2)), 0.0)
    count = known.sum(-1)
    cost = worth * each.sum(-1) / np.maximum(count, 1)
    return np.where(count >= 2, cost, np.inf)


def _followed(
    ends: Sequence[_End],
    seen: CameraSightings,
    frame: int,
    tracks: Integers,
    step: float,
    size: float,
    options: AssociationOptions,
) -> tuple[dict[int, int], set[int]]:
    """Which of the tracks of a frame, by its place among them, surely goes on from which end; and the ends that only may."""
    if not ends or not len(tracks):
        return {}, set()
    how = options.pieces
    gaps = np.array([frame - end.frame for end in ends], dtype=np.float64)
    expected = np.stack([end.place + (frame - end.frame) * end.velocity for end in ends])
    away = np.linalg.norm(seen.places[frame, tracks][None] - expected[:, None], axis=-1)
    cost = _cost(away / np.sqrt(gaps)[:, None, None], step, options)
    # half of the joints at least within reach: their median is
    possible = np.isfinite(cost) & (2 * (away <= how.jump * size).sum(-1) >= np.isfinite(away).sum(-1))
    limit = how.limit
    padded = np.full((len(ends) + len(tracks), len(tracks) + len(ends)), limit)
    padded[: len(ends), : len(tracks)] = np.where(possible, cost, 1e6)
    padded[len(ends) :, len(tracks) :] = 0.0
    rows, columns = linear_sum_assignment(padded)
    found = {int(c): int(r) for r, c in zip(rows, columns, strict=True) if r < len(ends) and c < len(tracks) and possible[r, c]}
    bounded = np.where(possible, cost, np.inf)
    open_columns: set[int] = set()
    for a, b in combinations(found, 2):  # the two, exchanged
        if bounded[found[a], b] + bounded[found[b], a] - bounded[found[a], a] - bounded[found[b], b] < how.clear:
            open_columns |= {a, b}
    for column, row in found.items():  # somebody else, who is lost or new otherwise
        others = [bounded[r, column] for r in range(len(ends)) if r not in found.values()]
        others += [bounded[row, c] for c in range(len(tracks)) if c not in found]
        if others and min(others) - bounded[row, column] < how.clear:
            open_columns.add(column)
    unsure = {r for c in open_columns for r in range(len(ends)) if bounded[r, c] - bounded[found[c], c] < how.clear}
    return {column: row for column, row in found.items() if column not in open_columns}, unsure


def _moved(old: _End, place: Floats, frame: int, track: int, smooth: float) -> _End:
    """The same piece one detection later; joints that are not seen are where they were, moved along."""
    gap = frame - old.frame
    expected = old.place + gap * old.velocity
    both = np.isfinite(place[:, 0]) & np.isfinite(old.place[:, 0])
    shift = np.median(place[both] - old.place[both], axis=0) / gap if both.any() else old.velocity
    velocity = old.velocity + smooth * (shift - old.velocity)
    return _End(old.piece, frame, track, np.where(np.isfinite(place), place, expected), velocity)


def _with_links(
    seen: CameraSightings,
    number: Integers,
    begun: Sequence[_End],
    last: Sequence[_End],
    step: float,
    size: float,
    options: AssociationOptions,
) -> Tracklets:
    """The pieces with what speaks for one going on as another: nearer than any rival, and by the tracker's number."""
    how = options.pieces
    starts = np.array([one.frame for one in begun], dtype=np.int64)
    ends = np.array([one.frame for one in last], dtype=np.int64)
    count = len(begun)
    plain = Tracklets(number, starts, ends, np.zeros((count, count)), size)
    if not count:
        return plain
    gap = starts[None] - ends[:, None]
    near = (gap > 0) & (gap <= max(1, round(how.bridge * seen.fps)))
    cost = np.full((count, count), np.inf)
    for a, b in np.argwhere(near):
        way = np.linalg.norm(begun[b].place - last[a].place - gap[a, b] * last[a].velocity, axis=-1)
        if np.nanmedian(way) <= how.jump * size * (1 + how.roam * gap[a, b] / seen.fps):
            # a speed that is not quite right leads further astray with every frame
            cost[a, b] = float(_cost(way / gap[a, b] ** how.astray, step, options))
    conflicts = plain.conflicts
    links = np.zeros((count, count))
    for a, b in np.argwhere(np.isfinite(cost)):
        rivals = [how.limit, *cost[a, conflicts[b]], *cost[conflicts[a], b]]
        links[a, b] = np.clip(min(rivals) - cost[a, b], -how.link, how.link)
        links[a, b] += how.same if last[a].track == begun[b].track else 0.0
    return Tracklets(number, starts, ends, links, size)
