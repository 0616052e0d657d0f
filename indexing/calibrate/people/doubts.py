"""What may be wrong with who is who: pieces that become somebody else, people who can be exchanged, and how sure each piece is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from dyntorch.core import Notice
from indexing.calibrate.people.clusters import exchanged
from indexing.calibrate.people.options import AssociationOptions
from indexing.calibrate.people.relations import CommonMoments, PieceView, Relation, common, evidence, fitted, table, view
from indexing.calibrate.people.result import PeopleNotice
from indexing.calibrate.people.sorting import Pair, Sorting, identities
from indexing.calibrate.people.tracklets import Booleans, Floats, Integers, Tracklets


def cut_again(sorting: Sorting, options: AssociationOptions) -> tuple[list[PieceView], bool]:
    """Cut the pieces whose beginning and end the other cameras see as two people."""
    views, changed = list(sorting.views), False
    groups = int(sorting.labels.max()) + 1 if len(sorting.labels) else 0
    for camera, one in enumerate(views):
        each = np.zeros((*one.piece.shape, groups + 1))
        for (i, j), relation in sorting.relations.items():
            if camera not in (i, j):
                continue
            other = j if camera == i else i
            turned = relation if camera == i else _turned(relation)
            both = common(one, sorting.views[other], turned.offset, turned.rate, options)
            rows = np.searchsorted(one.times, _moments(one, sorting.views[other], turned, options))
            label = np.where(both.piece_b >= 0, np.append(sorting.of(other), groups)[both.piece_b], groups)
            found = evidence(turned, both, options)
            for slot in range(label.shape[1]):
                each[rows[:, None], np.arange(one.piece.shape[1])[None], label[:, slot, None]] += found[:, :, slot]
        marks = _changes(one, sorting.of(camera), each[..., :groups], options)
        if marks:
            views[camera] = view(one.seen, _split(one, marks))
            changed = True
    return views, changed


def _turned(relation: Relation) -> Relation:
    """The same, of a against b."""
    return replace(
        relation, fundamental=relation.fundamental.T, offset=-relation.offset / relation.rate, rate=1 / relation.rate, shift=None
    )


def _moments(a: PieceView, b: PieceView, relation: Relation, options: AssociationOptions) -> Floats:
    """The times of a's frames that :func:`common` takes."""
    moments = relation.rate * a.times + relation.offset
    margin = options.geometry.nearest / b.seen.fps
    return a.times[(moments >= b.times[0] - margin) & (moments <= b.times[-1] + margin)]


def _changes(one: PieceView, labels: Integers, each: Floats, options: AssociationOptions) -> list[tuple[int, int]]:
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
        if most.size and most[row, group] > options.clusters.split:
            marks.append((piece, int(rows[row])))
    return marks


def _split(one: PieceView, marks: Sequence[tuple[int, int]]) -> Tracklets:
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


def alike(sorting: Sorting, names: Sequence[str], options: AssociationOptions) -> list[Notice]:
    """Two people who fit as well when a camera exchanges them for the whole take, with its relations fitted anew."""
    how = options.verdict
    kept = identities(sorting, options)
    found = []
    trials = {pair: ExchangeTrial(sorting, pair, options) for pair in sorting.relations}
    for camera in range(len(sorting.views)) if len(sorting.views) > 2 else (0,):
        own = sorting.of(camera)
        with_it = sorted((pair for pair in trials if camera in pair), key=lambda pair: (-trials[pair].right, pair))[: how.partners]
        for p, q in combinations(kept, 2):
            if not with_it or not ((own == p).any() or (own == q).any()):
                continue
            lead = sum(trials[pair].lead(camera, (p, q)) for pair in with_it)
            if lead < how.margin:
                found.append(
                    Notice(PeopleNotice.ALIKE, lead, {"names": names[camera], "first": kept.index(p), "second": kept.index(q)})
                )
    return found


def strangers(sorting: Sorting, options: AssociationOptions) -> list[int]:
    """Cameras whose people fit those of no other camera better now than at other times: they show others, or another time."""
    related: dict[int, float] = {}
    for pair in sorting.relations:
        ahead = ExchangeTrial(sorting, pair, options).ahead()
        for camera in pair:
            related[camera] = max(related.get(camera, 0.0), ahead)
    return [camera for camera in range(len(sorting.views)) if related.get(camera, 0.0) < options.verdict.ahead]


class ExchangeTrial:
    """Two cameras, by whose relation the sorting is compared with others, on fewer frames and points."""

    def __init__(self, sorting: Sorting, pair: Pair, options: AssociationOptions) -> None:
        self.pair, self.options = pair, options
        self.relation = sorting.relations[pair]
        self.labels = sorting.of(pair[0]), sorting.of(pair[1])
        first, second = (sorting.views[camera] for camera in pair)
        self.views = first, second
        self.both = self._at(0.0)
        self.right = self._score(self.labels[0][:, None] == self.labels[1][None], self.both)

    def _at(self, later: float) -> CommonMoments:
        """What both see, the second one so many seconds later."""
        relation, frames = self.relation, self.options.verdict.frames
        return common(*self.views, relation.offset + later, relation.rate, self.options, frames)

    def ahead(self) -> float:
        """By which share the same people fit better now than at the middle one of other times, the relation fitted anew."""
        matched = self.labels[0][:, None] == self.labels[1][None]
        now, there = self._worth(matched, self.both)
        others = [self._worth(matched, self._at(later)) for later in self.options.verdict.later]
        usual = [score / seen for score, seen in others if seen >= there / 2]
        if not there or not usual:
            return 1.0 if now > 0 else 0.0
        return 1 - max(float(np.median(usual)), 0.0) / max(now / there, 1e-9)

    def _worth(self, matched: Booleans, both: CommonMoments) -> tuple[float, int]:
        """Nats for a matching, and at how many moments it can be judged."""
        first, second = both.piece_a, both.piece_b
        there = matched[first[:, :, None], second[:, None]] & (first >= 0)[:, :, None] & (second >= 0)[:, None]
        return self._score(matched, both), int(there.sum())

    def lead(self, camera: int, people: tuple[int, int]) -> float:
        """Nats by which the sorting fits better than with two people exchanged in one of the cameras."""
        labels = [one.copy() for one in self.labels]
        side = self.pair.index(camera)
        own = self.labels[side]
        labels[side] = np.where(own == people[0], people[1], np.where(own == people[1], people[0], own))
        return self.right - max(0.0, self._score(labels[0][:, None] == labels[1][None], self.both))

    def _score(self, matched: Booleans, both: CommonMoments) -> float:
        start = self.relation
        if not start.held:
            start = replace(start, fundamental=np.full((3, 3), np.nan), sigma=both.spread)
        again = fitted(start, both, matched, self.options.verdict.steps, self.options, self.options.verdict.points)
        if again is None:
            return 0.0
        found = table(evidence(again, both, self.options), both, matched.shape)
        return float(found[matched].sum())


def certainties(sorting: Sorting, options: AssociationOptions) -> Floats:
    """``(pieces,)`` probability of each to be in its group rather than in the next best one, all that is in its way exchanged."""
    labels = sorting.labels
    out = np.ones(len(labels))
    groups = int(labels.max()) + 1 if len(labels) else 0
    for piece in range(len(labels)):
        near = np.unique(labels[(sorting.scores[piece] != 0) | sorting.conflicts[piece]])
        losses = [
            -exchanged(sorting.scores, sorting.conflicts, labels, piece, int(other))[1]
            for other in (*near.tolist(), groups)
            if other != labels[piece]
        ]
        out[piece] = 1 / (1 + math.exp(-min(max(min(losses), 0.0), 50.0))) if losses else 1.0
    return out
