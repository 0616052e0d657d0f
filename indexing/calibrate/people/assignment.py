"""Tracklets of all cameras assigned to people: clustering alternates with pairwise geometry; then ambiguities are tested."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from dyntorch import Clocks, Status, combine_shifts
from dyntorch.core import Notice, NoticeCode
from indexing.calibrate.people.pair_geometry import (
    MAX_DETECTION_DISTANCE,
    NUM_REWEIGHTINGS,
    STRANGER_DISTANCE,
    CameraPair,
    CommonFrames,
    PieceView,
    arrange,
    common_frames,
    estimate_pair,
    evidence,
    fit_pair,
    same_people,
    sum_over_time,
    synchronize_tracklets,
)
from indexing.calibrate.people.tracklets import Booleans, Floats, Integers, Tracklets, cluster, exchange

Pair = tuple[int, int]

MAX_SIGMA = 0.03  # body sizes of a pair of cameras that takes part besides those that were searched
MIN_EVIDENCE = 10.0  # nats for everybody together from which two cameras show the same people
NUM_CLOCK_PEOPLE = 2  # by whom the clocks are estimated together: those seen longest
NUM_CLOCK_PAIRS = 3  # of each camera, where there are as many
MAX_CLOCK_CHANGE = 1.0  # frames that undecided clocks by everybody may be off those by two people
MAX_ITERATIONS = 6  # clustering tracklets and refitting pairwise geometry
MIN_PERSON_SECONDS = 0.3  # that a person is seen by two cameras


class PeopleNotice(NoticeCode):
    """What to know of who is who in the cameras, or why it is not decided."""

    NOBODY = (
        "nobody",
        "nobody is seen by two cameras for long enough ({value:g} s); film longer, or lower the confidence that joints need",
        Status.TOO_FEW,
    )
    """Nobody to tell apart."""
    CLOCKS = (
        "clocks",
        "the clocks of the cameras are not decided, so nobody can be compared: {reason}; give the clocks, or film longer",
        Status.AMBIGUOUS,
    )
    """Clocks that the people do not decide."""
    LOST = (
        "unrelated",
        "{names}: nobody there is somebody whom another camera shows; check that all cameras film the same people at the same "
        "time, or leave it out",
        Status.NO_CONSENSUS,
    )
    """A camera that shows other people, another time, or too little."""
    ALIKE = (
        "alike",
        "{names}: persons {first} and {second} exchanged fit as well (by {value:.1f} nats): they do the same at the same time, or "
        "are seen too shortly; add a camera, film them longer, or apart",
        Status.AMBIGUOUS,
    )
    """Two people who can be exchanged in a camera."""
    EXCHANGED = "exchanged", "{name}: the tracker exchanged people {value:g} times, mended ({times})"
    """Numbers of a tracker that were mended."""
    ALONE = "alone", "{name}: {value:.0f} % of the detections are nobody whom another camera shows, and are left out"
    """Detections that belong to nobody."""


def estimate_spanning_tree(views: Sequence[PieceView], known: Floats | None) -> tuple[Floats, dict[Pair, CameraPair], list[int]]:
    """Clocks ``(cameras, 2)`` against the first camera, relations of the pairs that they come from, and the cameras without any."""
    order = sorted(range(len(views)), key=lambda camera: (-int(views[camera].lengths.sum()), camera))
    placed, waiting = [order[0]], order[1:]
    clocks = np.tile([0.0, 1.0], (len(views), 1)) if known is None else known
    relations: dict[Pair, CameraPair] = {}
    lost: list[int] = []
    while waiting:
        camera = waiting.pop(0)
        best: tuple[float, int, CameraPair] | None = None
        for other in placed:
            clock = None if known is None else relative_clock(clocks, other, camera)
            hypothesis = estimate_pair(views[other], views[camera], clock)
            if hypothesis is not None and (best is None or hypothesis.score > best[0]):
                best = hypothesis.score, other, hypothesis.relation
            if hypothesis is not None and hypothesis.confident():
                break
        if best is None or best[0] < MIN_EVIDENCE:
            lost.append(camera)
            continue
        _, other, relation = best
        relations[other, camera] = relation
        if known is None:
            offset, rate = clocks[other]
            clocks[camera] = relation.rate * offset + relation.offset, relation.rate * rate
        placed.append(camera)
    if known is None:  # relative to the first camera
        offset, rate = clocks[0]
        clocks = np.stack([clocks[:, 0] - clocks[:, 1] / rate * offset, clocks[:, 1] / rate], axis=1)
    return clocks, relations, lost


def relative_clock(clocks: Floats, a: int, b: int) -> tuple[float, float]:
    """Offset and rate of b's clock against a's."""
    rate = clocks[b, 1] / clocks[a, 1]
    return float(clocks[b, 0] - rate * clocks[a, 0]), float(rate)


@dataclass(frozen=True, eq=False)
class Assignment:
    """Pieces of all cameras sorted into groups."""

    views: Sequence[PieceView]
    relations: dict[Pair, CameraPair]
    labels: Integers
    scores: Floats = None  # type: ignore[assignment]  # of all pieces
    conflicts: Booleans = None  # type: ignore[assignment]

    @property
    def starts(self) -> Integers:
        """``(cameras + 1,)`` where the pieces of each camera begin."""
        return np.concatenate([[0], np.cumsum([len(one.pieces) for one in self.views])]).astype(np.int64)

    def of(self, camera: int) -> Integers:
        """Labels of the pieces of a camera."""
        return self.labels[self.starts[camera] : self.starts[camera + 1]]


def _orient_pair(relations: dict[Pair, CameraPair], i: int, j: int, clock: tuple[float, float]) -> CameraPair | None:
    """The relation of i < j from one that may be of (j, i), with another clock."""
    if (i, j) in relations:
        return replace(relations[i, j], offset=clock[0], rate=clock[1])
    if (j, i) in relations:
        other = relations[j, i]
        return replace(other, fundamental=other.fundamental.T, offset=clock[0], rate=clock[1])
    return None


def assign(views: Sequence[PieceView], clocks: Floats, relations: dict[Pair, CameraPair]) -> Assignment:
    """Sort the pieces by the relations that there are, fit those of all pairs to who is the same, until nothing changes."""
    pairs = list(combinations(range(len(views)), 2))
    both = {(i, j): common_frames(views[i], views[j], *relative_clock(clocks, i, j)) for i, j in pairs}
    current = {
        (i, j): relation for i, j in pairs if (relation := _orient_pair(relations, i, j, relative_clock(clocks, i, j))) is not None
    }
    sorting = Assignment(views, current, np.zeros(0, dtype=np.int64))
    links, conflicts = _within_cameras(sorting)
    begins = np.concatenate(
        [(one.times[one.pieces.starts] - offset) / rate for one, (offset, rate) in zip(views, clocks, strict=True)]
    )
    labels: Integers | None = None
    for _ in range(MAX_ITERATIONS):
        scores = links.copy()
        for (i, j), relation in current.items():
            nats = sum_over_time(evidence(relation, both[i, j]), both[i, j], (len(views[i].pieces), len(views[j].pieces)))
            a, b = sorting.starts[i], sorting.starts[j]
            scores[a : a + nats.shape[0], b : b + nats.shape[1]] = nats
            scores[b : b + nats.shape[1], a : a + nats.shape[0]] = nats.T
        after = cluster(scores, conflicts, begins)
        sorting = Assignment(views, current, after, scores, conflicts)
        if labels is not None and np.array_equal(after, labels):
            break
        labels = after
        current = _refit_pairs(sorting, both, clocks)
    return sorting


def _within_cameras(sorting: Assignment) -> tuple[Floats, Booleans]:
    """Links and conflicts of pieces of one camera, among all pieces."""
    starts = sorting.starts
    links = np.zeros((starts[-1], starts[-1]))
    conflicts = np.zeros((starts[-1], starts[-1]), dtype=bool)
    for camera, one in enumerate(sorting.views):
        part = slice(starts[camera], starts[camera + 1])
        links[part, part] = one.pieces.links + one.pieces.links.T
        conflicts[part, part] = one.pieces.conflicts
    return links, conflicts


def _refit_pairs(sorting: Assignment, both: dict[Pair, CommonFrames], clocks: Floats) -> dict[Pair, CameraPair]:
    """The relations of all pairs by who is the same now; one that nobody fits any more stays."""
    out: dict[Pair, CameraPair] = {}
    for (i, j), moments in both.items():
        old = sorting.relations.get((i, j))
        matched = sorting.of(i)[:, None] == sorting.of(j)[None]
        if old is not None:
            a, b = sorting.starts[i], sorting.starts[j]
            matched &= sorting.scores[a : a + matched.shape[0], b : b + matched.shape[1]] > 0
        start = old or CameraPair(*relative_clock(clocks, i, j), np.full((3, 3), np.nan), moments.spread)
        rounds = NUM_REWEIGHTINGS + (2 if old is None else 0)
        fitted = fit_pair(start, moments, matched, rounds) if len(moments.a) else None
        if fitted is not None and (old is not None or fitted.sigma <= MAX_SIGMA * moments.spread / STRANGER_DISTANCE):
            out[i, j] = fitted
        elif old is not None:
            out[i, j] = old
    return out


def estimate_clocks(sorting: Assignment, clocks: Floats, lost: Sequence[int]) -> tuple[Clocks | None, Floats, list[Notice]]:
    """The clocks of all cameras by everybody who was recognized, whether they are decided, and the table that follows from them."""

    pairs = _pairs_to_compare(sorting)
    people = _longest_seen(sorting)
    shifts = {}
    for i, j in pairs:
        a, b = (_stack_groups(sorting, camera, people) for camera in (i, j))
        shift = synchronize_tracklets(a, b)
        if shift is not None:
            shifts[i, j] = shift
    if not shifts:
        return None, clocks, [Notice(PeopleNotice.CLOCKS, 0.0, {"reason": "no two cameras show the same person for long enough"})]
    combined = combine_shifts(shifts, len(sorting.views))
    notices = []
    if not combined.ok and not lost:
        notices.append(Notice(PeopleNotice.CLOCKS, 0.0, {"reason": combined.reason}))
    table = np.stack([combined.offsets.numpy(), combined.rates.numpy()], axis=1)
    usable = np.isfinite(table).all(1)
    frame = min(one.seen.fps for one in sorting.views)
    near = np.abs(table[:, 0] - clocks[:, 0]) * frame <= MAX_CLOCK_CHANGE
    return combined, np.where((usable & (near | combined.ok))[:, None], table, clocks), notices


def _pairs_to_compare(sorting: Assignment) -> list[Pair]:
    """Those with most evidence, and as many as hold every camera by several."""
    starts = sorting.starts
    worth = {
        (i, j): float(np.clip(sorting.scores[starts[i] : starts[i + 1], starts[j] : starts[j + 1]], 0, None).sum())
        for i, j in sorting.relations
    }
    ranked = sorted(worth, key=lambda pair: (-worth[pair], pair))
    tied = np.zeros(len(sorting.views), dtype=int)
    chosen: list[Pair] = []
    for i, j in ranked:
        if min(tied[i], tied[j]) < NUM_CLOCK_PAIRS:
            chosen.append((i, j))
            tied[[i, j]] += 1
    return chosen


def _longest_seen(sorting: Assignment) -> list[int]:
    """The groups with most frames, as many as the clocks are found by."""
    lengths = np.concatenate([one.lengths for one in sorting.views])
    seen = np.bincount(sorting.labels, weights=lengths)
    return np.argsort(-seen, kind="stable")[:NUM_CLOCK_PEOPLE].tolist()


def _stack_groups(sorting: Assignment, camera: int, groups: Sequence[int]) -> tuple[Floats, Floats, Floats]:
    """Times, places ``(frames, groups * joints, 2)`` and trust of some groups in a camera."""
    one = sorting.views[camera]
    frames, _, joints = one.trust.shape
    places_, trust = np.full((frames, len(groups), joints, 2), np.nan), np.zeros((frames, len(groups), joints))
    label = np.where(one.piece >= 0, np.append(sorting.of(camera), -1)[one.piece], -1)
    for k, group in enumerate(groups):
        rows, slots = np.nonzero(label == group)
        places_[rows, k], trust[rows, k] = one.places[rows, slots], one.trust[rows, slots]
    return one.times, places_.reshape(frames, -1, 2), trust.reshape(frames, -1)


def identities(sorting: Assignment) -> list[int]:
    """The groups that are people: seen by two cameras at least, for long enough; those with most evidence first."""
    if not len(sorting.labels):
        return []
    groups = []
    for group in range(int(sorting.labels.max()) + 1):
        seconds = [float(one.lengths[sorting.of(camera) == group].sum()) / one.seen.fps for camera, one in enumerate(sorting.views)]
        if sum(value > 0 for value in seconds) >= 2 and sorted(seconds)[-2] >= MIN_PERSON_SECONDS:
            groups.append(group)
    return groups


MIN_SPLIT_EVIDENCE = 6.0  # nats on both sides of a split
MAX_TEST_FRAMES = 60  # at which two people are exchanged to test whether they fit as well
NUM_TEST_REWEIGHTINGS = 4  # steps of reweighted least squares then
MAX_PARTNERS = 3  # cameras that a camera is compared with: those with most people in common
TEST_SHIFTS = (-1.7, -1.1, -0.6, 0.6, 1.1, 1.7)  # seconds by which a camera is shifted to test whether its people fit at any time
MIN_SYNCHRONY = 0.55  # share of the fit that is lost at those times: same people .69 to .96, others .51 at most (virtual rigs)
MIN_EXCHANGE_LOSS = 10.0  # nats that an exchange of two people must cost


def split_inconsistent(sorting: Assignment) -> tuple[list[PieceView], bool]:
    """Cut the pieces whose beginning and end the other cameras see as two people."""
    views, changed = list(sorting.views), False
    groups = int(sorting.labels.max()) + 1 if len(sorting.labels) else 0
    for camera, one in enumerate(views):
        each = np.zeros((*one.piece.shape, groups + 1))
        for (i, j), relation in sorting.relations.items():
            if camera not in (i, j):
                continue
            other = j if camera == i else i
            turned = relation if camera == i else _reversed_pair(relation)
            both = common_frames(one, sorting.views[other], turned.offset, turned.rate)
            rows = np.searchsorted(one.times, _shared_times(one, sorting.views[other], turned))
            label = np.where(both.piece_b >= 0, np.append(sorting.of(other), groups)[both.piece_b], groups)
            found = evidence(turned, both)
            for slot in range(label.shape[1]):
                each[rows[:, None], np.arange(one.piece.shape[1])[None], label[:, slot, None]] += found[:, :, slot]
        marks = _find_changes(one, sorting.of(camera), each[..., :groups])
        if marks:
            views[camera] = arrange(one.seen, _split_tracklets(one, marks))
            changed = True
    return views, changed


def _reversed_pair(relation: CameraPair) -> CameraPair:
    """The same, of a against b."""
    return replace(
        relation, fundamental=relation.fundamental.T, offset=-relation.offset / relation.rate, rate=1 / relation.rate, shift=None
    )


def _shared_times(a: PieceView, b: PieceView, relation: CameraPair) -> Floats:
    """The times of a's frames that :func:`common_frames` takes."""
    moments = relation.rate * a.times + relation.offset
    margin = MAX_DETECTION_DISTANCE / b.seen.fps
    return a.times[(moments >= b.times[0] - margin) & (moments <= b.times[-1] + margin)]


def _find_changes(one: PieceView, labels: Integers, each: Floats) -> list[tuple[int, int]]:
    """Pieces, and the frames at which they become somebody else."""
    marks = []
    for piece in range(len(one.pieces)):
        rows, slots = np.nonzero(one.piece == piece)
        gains = each[rows, slots] - each[rows, slots][:, [labels[piece]]]
        after = np.cumsum(gains[::-1], axis=0)[::-1]
        before = gains.sum(0) - after
        both = np.minimum(after, -before)
        both[:1] = 0.0
        most = np.maximum(both, np.minimum(-after, before))
        row, group = np.unravel_index(int(most.argmax()), most.shape) if most.size else (0, 0)
        if most.size and most[row, group] > MIN_SPLIT_EVIDENCE:
            marks.append((piece, int(rows[row])))
    return marks


def _split_tracklets(one: PieceView, marks: Sequence[tuple[int, int]]) -> Tracklets:
    """The pieces of a camera with some cut in two; what is known of what they go on as goes to the second part."""
    pieces = one.pieces
    number, starts, ends = pieces.number.copy(), pieces.starts.tolist(), pieces.ends.tolist()
    count = len(pieces)
    links = np.zeros((count + len(marks), count + len(marks)))
    links[:count, :count] = pieces.links
    for extra, (piece, frame) in enumerate(marks):
        fresh = count + extra
        later = number[frame:]
        later[later == piece] = fresh
        rows = np.flatnonzero((number == piece).any(1))
        starts.append(frame)
        ends.append(ends[piece])
        ends[piece] = int(rows[-1]) if len(rows) else frame
        links[fresh], links[piece] = links[piece], 0.0
    return Tracklets(number, np.array(starts), np.array(ends), links, pieces.size)


def find_ambiguous_people(sorting: Assignment, names: Sequence[str]) -> list[Notice]:
    """Two people who fit as well when a camera exchanges them for the whole take, with its relations fitted anew."""
    groups = identities(sorting)
    notices = []
    trials = {pair: ExchangeTrial(sorting, pair) for pair in sorting.relations}
    for camera in range(len(sorting.views)) if len(sorting.views) > 2 else (0,):
        own = sorting.of(camera)
        with_it = sorted((pair for pair in trials if camera in pair), key=lambda pair: (-trials[pair].right, pair))[:MAX_PARTNERS]
        for p, q in combinations(groups, 2):
            if not with_it or not ((own == p).any() or (own == q).any()):
                continue
            lead = sum(trials[pair].exchange_loss(camera, (p, q)) for pair in with_it)
            if lead < MIN_EXCHANGE_LOSS:
                notices.append(
                    Notice(PeopleNotice.ALIKE, lead, {"names": names[camera], "first": groups.index(p), "second": groups.index(q)})
                )
    return notices


def find_unrelated_cameras(sorting: Assignment) -> list[int]:
    """Cameras whose people fit those of no other camera better now than at other times: they show others, or another time."""
    related: dict[int, float] = {}
    for pair in sorting.relations:
        ahead = ExchangeTrial(sorting, pair).synchrony()
        for camera in pair:
            related[camera] = max(related.get(camera, 0.0), ahead)
    return [camera for camera in range(len(sorting.views)) if related.get(camera, 0.0) < MIN_SYNCHRONY]


class ExchangeTrial:
    """Two cameras, by whose relation the sorting is compared with others, on fewer frames and points."""

    def __init__(self, sorting: Assignment, pair: Pair) -> None:
        self.pair = pair
        self.relation = sorting.relations[pair]
        self.labels = sorting.of(pair[0]), sorting.of(pair[1])
        first, second = (sorting.views[camera] for camera in pair)
        self.views = first, second
        self.both = self._at(0.0)
        self.right = self._score(self.labels[0][:, None] == self.labels[1][None], self.both)

    def _at(self, later: float) -> CommonFrames:
        """What both see, the second one so many seconds later."""
        return common_frames(*self.views, self.relation.offset + later, self.relation.rate, MAX_TEST_FRAMES)

    def synchrony(self) -> float:
        """By which share the same people fit better now than at the middle one of other times, the relation fitted anew."""
        matched = self.labels[0][:, None] == self.labels[1][None]
        now, there = self._evidence_at(matched, self.both)
        others = [self._evidence_at(matched, self._at(later)) for later in TEST_SHIFTS]
        usual = [score / seen for score, seen in others if seen >= there / 2]
        if not there or not usual:
            return 1.0 if now > 0 else 0.0
        return 1 - max(float(np.median(usual)), 0.0) / max(now / there, 1e-9)

    def _evidence_at(self, matched: Booleans, both: CommonFrames) -> tuple[float, int]:
        """Nats for a matching, and at how many moments it can be judged."""
        return self._score(matched, both), int(same_people(both, matched).sum())

    def exchange_loss(self, camera: int, people: tuple[int, int]) -> float:
        """Nats by which the sorting fits better than with two people exchanged in one of the cameras."""
        labels = [one.copy() for one in self.labels]
        side = self.pair.index(camera)
        own = self.labels[side]
        labels[side] = np.where(own == people[0], people[1], np.where(own == people[1], people[0], own))
        return self.right - max(0.0, self._score(labels[0][:, None] == labels[1][None], self.both))

    def _score(self, matched: Booleans, both: CommonFrames) -> float:
        start = replace(self.relation, fundamental=np.full((3, 3), np.nan), sigma=both.spread)
        again = fit_pair(start, both, matched, NUM_TEST_REWEIGHTINGS)
        if again is None:
            return 0.0
        found = sum_over_time(evidence(again, both), both, matched.shape)
        return float(found[matched].sum())


def certainties(sorting: Assignment) -> Floats:
    """``(pieces,)`` probability of each to be in its group rather than in the next best one, all that is in its way exchanged."""
    labels = sorting.labels
    out = np.ones(len(labels))
    groups = int(labels.max()) + 1 if len(labels) else 0
    for piece in range(len(labels)):
        near = np.unique(labels[(sorting.scores[piece] != 0) | sorting.conflicts[piece]])
        losses = [
            -exchange(sorting.scores, sorting.conflicts, labels, piece, int(other))[1]
            for other in (*near.tolist(), groups)
            if other != labels[piece]
        ]
        out[piece] = 1 / (1 + math.exp(-min(max(min(losses), 0.0), 50.0))) if losses else 1.0
    return out
