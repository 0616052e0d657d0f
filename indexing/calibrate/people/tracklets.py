"""Tracks of one camera split into tracklets of surely one person each, and correlation clustering of tracklets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from indexing.clip import Clip

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]

MIN_JOINTS = 4  # that make a detection
INDEPENDENT_STEP_JOINTS = 5.0  # in the step of a body from frame to frame: its joints move together
MIN_MARGIN = 6.0  # nats by which two people are distinguished from one frame to the next
MAX_STEP_COST = 12.0  # nats: a costlier step is no more likely than one lost and another one new
MAX_STEP = 0.5  # body sizes (diagonals of a box) from one frame to the next
MAX_SPEED = 1.0  # body sizes added per second without a detection
MIN_USUAL_STEP = 0.005  # body sizes: detections without noise are no certainty
MAX_GAP_SECONDS = 0.2  # that somebody may be unseen within one tracklet
MAX_LINK_SECONDS = 1.0  # between two tracklets that may be one person, by extrapolation
EXTRAPOLATION_POWER = 0.75  # of the frames, by which the expected error grows: .5 random walk, 1 wrong speed
MAX_LINK = 3.0  # nats that the position adds for two tracklets being one person
TRACKER_EVIDENCE = 0.3  # nats of the tracker's number: it swaps people in half of the unclear encounters
SPEED_SMOOTHING = 0.3  # share of the last step in the speed of a body


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


def split_tracks(seen: CameraSightings) -> Tracklets:
    """Follow everybody from frame to frame by the joints, and cut where two people could be exchanged."""
    there = (seen.trust > 0).sum(2) >= min(MIN_JOINTS, seen.places.shape[2])
    number = np.full(there.shape, -1, dtype=np.int64)
    size = _median_size(seen, there)
    step = max(_median_step(seen, there), MIN_USUAL_STEP * size)
    begun: list[_End] = []
    open_ends: list[_End] = []
    finished: list[_End] = []
    hold = max(1, round(MAX_GAP_SECONDS * seen.fps))
    for frame in range(len(seen.times)):
        tracks = np.flatnonzero(there[frame])
        finished += [end for end in open_ends if frame - end.frame > hold]
        open_ends = [end for end in open_ends if frame - end.frame <= hold]
        pairs, unsure = _match_ends(open_ends, seen, frame, tracks, step, size)
        after: list[_End] = []
        for column, track in enumerate(tracks.tolist()):
            row = pairs.get(column)
            old = open_ends[row] if row is not None else None
            if old is None:
                one = _End(len(begun), frame, track, seen.places[frame, track].copy(), np.zeros(2))
                begun.append(_End(one.piece, frame, track, one.place.copy(), one.velocity))
            else:
                one = _advance(old, seen.places[frame, track], frame, track, SPEED_SMOOTHING)
            number[frame, track] = one.piece
            after.append(one)
        going = set(pairs.values())
        finished += [open_ends[row] for row in unsure - going]
        open_ends = [end for row, end in enumerate(open_ends) if row not in going | unsure] + after
    last = sorted([*finished, *open_ends], key=lambda end: end.piece)
    return _link_tracklets(seen, number, begun, last, step, size)


def _median_size(seen: CameraSightings, there: Booleans) -> float:
    """Median diagonal of the boxes, px."""
    if not there.any():
        return 1.0
    known = seen.places[there]
    extent = np.nanmax(known, axis=1) - np.nanmin(known, axis=1)
    return max(float(np.median(np.linalg.norm(extent, axis=1))), 1e-9)


def _median_step(seen: CameraSightings, there: Booleans) -> float:
    """Median way of a joint from frame to frame, px."""
    steps = np.linalg.norm(np.diff(seen.places, axis=0), axis=-1)[there[1:] & there[:-1]]
    known = steps[np.isfinite(steps)]
    return float(np.median(known)) if known.size else 0.0


def _cost(away: Floats, step: float) -> Floats:
    """Of ways ``(..., joints)`` px from where somebody is expected, NaN = not known; what nothing is known of costs the limit."""
    known = np.isfinite(away)
    each = np.where(known, 2 * np.log1p(np.square(np.where(known, away, 0.0)) / (3 * step**2)), 0.0)
    count = known.sum(-1)
    cost = INDEPENDENT_STEP_JOINTS * each.sum(-1) / np.maximum(count, 1)
    return np.where(count >= 2, cost, np.inf)


def _match_ends(
    ends: Sequence[_End],
    seen: CameraSightings,
    frame: int,
    tracks: Integers,
    step: float,
    size: float,
) -> tuple[dict[int, int], set[int]]:
    """Which of the tracks of a frame, by its place among them, surely goes on from which end; and the ends that only may."""
    if not ends or not len(tracks):
        return {}, set()
    gaps = np.array([frame - end.frame for end in ends], dtype=np.float64)
    expected = np.stack([end.place + (frame - end.frame) * end.velocity for end in ends])
    distance = np.linalg.norm(seen.places[frame, tracks][None] - expected[:, None], axis=-1)
    cost = _cost(distance / np.sqrt(gaps)[:, None, None], step)
    # half of the joints at least within reach: their median is
    possible = np.isfinite(cost) & (2 * (distance <= MAX_STEP * size).sum(-1) >= np.isfinite(distance).sum(-1))
    padded = np.full((len(ends) + len(tracks), len(tracks) + len(ends)), MAX_STEP_COST)
    padded[: len(ends), : len(tracks)] = np.where(possible, cost, 1e6)
    padded[len(ends) :, len(tracks) :] = 0.0
    rows, columns = linear_sum_assignment(padded)
    assigned = {int(c): int(r) for r, c in zip(rows, columns, strict=True) if r < len(ends) and c < len(tracks) and possible[r, c]}
    bounded = np.where(possible, cost, np.inf)
    open_columns: set[int] = set()
    for a, b in combinations(assigned, 2):  # the two, exchanged
        if bounded[assigned[a], b] + bounded[assigned[b], a] - bounded[assigned[a], a] - bounded[assigned[b], b] < MIN_MARGIN:
            open_columns |= {a, b}
    for column, row in assigned.items():  # somebody else, who is lost or new otherwise
        others = [bounded[r, column] for r in range(len(ends)) if r not in assigned.values()]
        others += [bounded[row, c] for c in range(len(tracks)) if c not in assigned]
        if others and min(others) - bounded[row, column] < MIN_MARGIN:
            open_columns.add(column)
    unsure = {r for c in open_columns for r in range(len(ends)) if bounded[r, c] - bounded[assigned[c], c] < MIN_MARGIN}
    return {column: row for column, row in assigned.items() if column not in open_columns}, unsure


def _advance(old: _End, place: Floats, frame: int, track: int, smooth: float) -> _End:
    """The same piece one detection later; joints that are not seen are where they were, moved along."""
    gap = frame - old.frame
    expected = old.place + gap * old.velocity
    both = np.isfinite(place[:, 0]) & np.isfinite(old.place[:, 0])
    shift = np.median(place[both] - old.place[both], axis=0) / gap if both.any() else old.velocity
    velocity = old.velocity + smooth * (shift - old.velocity)
    return _End(old.piece, frame, track, np.where(np.isfinite(place), place, expected), velocity)


def _link_tracklets(
    seen: CameraSightings,
    number: Integers,
    begun: Sequence[_End],
    last: Sequence[_End],
    step: float,
    size: float,
) -> Tracklets:
    """The pieces with what speaks for one going on as another: nearer than any rival, and by the tracker's number."""
    starts = np.array([one.frame for one in begun], dtype=np.int64)
    ends = np.array([one.frame for one in last], dtype=np.int64)
    count = len(begun)
    plain = Tracklets(number, starts, ends, np.zeros((count, count)), size)
    if not count:
        return plain
    gap = starts[None] - ends[:, None]
    near = (gap > 0) & (gap <= max(1, round(MAX_LINK_SECONDS * seen.fps)))
    cost = np.full((count, count), np.inf)
    for a, b in np.argwhere(near):
        way = np.linalg.norm(begun[b].place - last[a].place - gap[a, b] * last[a].velocity, axis=-1)
        if np.nanmedian(way) <= MAX_STEP * size * (1 + MAX_SPEED * gap[a, b] / seen.fps):
            # a speed that is not quite right leads further astray with every frame
            cost[a, b] = float(_cost(way / gap[a, b] ** EXTRAPOLATION_POWER, step))
    conflicts = plain.conflicts
    links = np.zeros((count, count))
    for a, b in np.argwhere(np.isfinite(cost)):
        rivals = [MAX_STEP_COST, *cost[a, conflicts[b]], *cost[conflicts[a], b]]
        links[a, b] = np.clip(min(rivals) - cost[a, b], -MAX_LINK, MAX_LINK)
        links[a, b] += TRACKER_EVIDENCE if last[a].track == begun[b].track else 0.0
    return Tracklets(number, starts, ends, links, size)


MAX_SWEEPS = 20  # in which every tracklet may change its group
MIN_GAIN = 1e-6  # nats of a change


def cluster(scores: Floats, conflicts: Booleans, begins: Floats | None = None) -> Integers:
    """Correlation clustering with conflicts: scores ``(n, n)``, conflicts ``(n, n)``, begins ``(n,)`` -> ``(n,)``."""
    labels = _merge_greedily(scores, conflicts)
    for _ in range(MAX_SWEEPS):
        labels = _improve(scores, conflicts, labels)
        crossed = None if begins is None else _exchange_from_time(scores, conflicts, labels, begins)
        if crossed is None:
            break
        labels = crossed
    return _order_groups(scores, labels)


def _merge_greedily(scores: Floats, conflicts: Booleans) -> Integers:
    """Greedy: the two groups with most evidence between them are one, until none is left that gains."""
    count = len(scores)
    labels = np.arange(count, dtype=np.int64)
    if not count:
        return labels
    sums, barred = scores.astype(np.float64).copy(), conflicts.copy()
    np.fill_diagonal(barred, True)
    masked = np.where(barred, -np.inf, sums)
    best = masked.argmax(1)
    top = masked[np.arange(count), best]
    while True:
        a = int(top.argmax())
        if not top[a] > 0:
            return labels
        b = int(best[a])
        a, b = min(a, b), max(a, b)
        labels[labels == b] = a
        sums[a] += sums[b]
        sums[:, a] = sums[a]
        barred[a] |= barred[b]
        barred[:, a] = barred[a]
        barred[b], barred[:, b], barred[a, a] = True, True, True
        masked[a] = np.where(barred[a], -np.inf, sums[a])
        masked[:, a] = masked[a]
        masked[b], masked[:, b] = -np.inf, -np.inf
        stale = (best == a) | (best == b)
        stale[[a, b]] = True
        better = masked[:, a] > top
        best[better], top[better] = a, masked[better, a]
        for row in np.flatnonzero(stale & ~better):
            best[row] = masked[row].argmax()
            top[row] = masked[row, best[row]]


def _improve(scores: Floats, conflicts: Booleans, labels: Integers) -> Integers:
    """Pieces change groups, with all that are in their way, while the sum rises."""
    labels = _compact(labels)
    for _ in range(MAX_SWEEPS):
        changed = False
        for piece in range(len(labels)):
            better = _best_move(scores, conflicts, labels, piece)
            if better is not None:
                labels = better
                changed = True
        if not changed:
            break
    return labels


def _best_move(scores: Floats, conflicts: Booleans, labels: Integers, piece: int) -> Integers | None:
    """The labels after the exchange, begun by one piece, that gains most; None where none gains."""
    own = int(labels[piece])
    groups = int(labels.max()) + 1
    reach = np.bincount(labels, weights=scores[piece], minlength=groups + 1)
    best, most = None, MIN_GAIN
    for other in range(groups + 1):
        if other == own or (other < groups and reach[other] <= 0 and not (conflicts[piece] & (labels == other)).any()):
            continue
        changed, gain = exchange(scores, conflicts, labels, piece, other)
        if gain > most:
            best, most = changed, gain
    return None if best is None else _compact(best)


def exchange(scores: Floats, conflicts: Booleans, labels: Integers, piece: int, other: int) -> tuple[Integers, float]:
    """Labels after a piece went to another group, those in conflict with it to its own, those with these back, and so on."""
    own = int(labels[piece])
    within = np.flatnonzero((labels == own) | (labels == other))
    local = labels[within] == other
    against = conflicts[np.ix_(within, within)]
    chain = np.zeros(len(within), dtype=bool)
    front = within == piece
    while front.any():
        chain |= front
        front = against[front].any(0) & ~chain & (local != local[front][0])
    values = scores[np.ix_(within, within)]
    # what is between those that move and those that stay: together before is apart after, and the other way round
    between = values[np.ix_(chain, ~chain)]
    together = local[chain][:, None] == local[~chain][None]
    gain = float(between[~together].sum() - between[together].sum())
    out = labels.copy()
    moving = within[chain]
    out[moving] = np.where(labels[moving] == own, other, own)
    return out, gain


def _exchange_from_time(scores: Floats, conflicts: Booleans, labels: Integers, begins: Floats) -> Integers | None:
    """Labels after the exchange of what two groups are from a moment on that gains most; None where none gains."""
    labels = _compact(labels)
    best, most = None, MIN_GAIN
    groups = int(labels.max()) + 1 if len(labels) else 0
    for a in range(groups):
        for b in range(a + 1, groups):
            within = np.flatnonzero((labels == a) | (labels == b))
            within = within[np.argsort(begins[within], kind="stable")]
            own = labels[within] == a
            values, against = scores[np.ix_(within, within)], conflicts[np.ix_(within, within)]
            signed = np.where(own[:, None] == own[None], -values, values)
            barred = against & (own[:, None] != own[None])
            for cut in range(len(within)):  # the first part is before it
                gain = float(signed[:cut, cut:].sum()) if cut else _between_groups(values, against, own)
                if gain > most and not barred[:cut, cut:].any():
                    best, most = (within[cut:] if cut else within[own], a, b), gain
    if best is None:
        return None
    moving, a, b = best
    out = labels.copy()
    out[moving] = a + b - labels[moving]
    return _compact(out)


def _between_groups(values: Floats, against: Booleans, own: Booleans) -> float:
    """What one group of two gains, whenever their pieces begin."""
    apart = np.ix_(own, ~own)
    return -np.inf if against[apart].any() else float(values[apart].sum())


def _compact(labels: Integers) -> Integers:
    return np.unique(labels, return_inverse=True)[1].astype(np.int64)


def _order_groups(scores: Floats, labels: Integers) -> Integers:
    """Groups by their evidence, most first; of equals the one with the first piece."""
    if not len(labels):
        return labels
    labels = _compact(labels)
    one = np.zeros((len(labels), int(labels.max()) + 1))
    one[np.arange(len(labels)), labels] = 1.0
    within = np.einsum("pg,pq,qg->g", one, scores, one) / 2
    first = np.array([int(np.flatnonzero(labels == group)[0]) for group in range(one.shape[1])])
    order = np.lexsort((first, -np.round(within, 9)))
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    return place[labels]
