"""Clocks and relations of all cameras, and pieces sorted into people by them, until both stay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from dyntorch.core import Notice
from indexing.calibrate.people.clusters import clustered
from indexing.calibrate.people.options import AssociationOptions
from indexing.calibrate.people.relations import (
    CommonMoments,
    PieceView,
    Relation,
    common,
    compared,
    evidence,
    fitted,
    relate,
    table,
)
from indexing.calibrate.people.result import PeopleNotice
from indexing.calibrate.people.tracklets import Booleans, Floats, Integers

if TYPE_CHECKING:
    from dyntorch import Calibration, Clocks

Pair = tuple[int, int]


def tree(
    views: Sequence[PieceView], known: Floats | None, options: AssociationOptions
) -> tuple[Floats, dict[Pair, Relation], list[int]]:
    """Clocks ``(cameras, 2)`` against the first camera, relations of the pairs that they come from, and the cameras without any."""
    order = sorted(range(len(views)), key=lambda camera: (-int(views[camera].lengths.sum()), camera))
    placed, waiting = [order[0]], order[1:]
    clocks = np.tile([0.0, 1.0], (len(views), 1)) if known is None else known
    relations: dict[Pair, Relation] = {}
    lost: list[int] = []
    while waiting:
        camera = waiting.pop(0)
        best: tuple[float, int, Relation] | None = None
        for other in placed:
            clock = None if known is None else between(clocks, other, camera)
            found = relate(views[other], views[camera], options, clock)
            if found is not None and (best is None or found.score > best[0]):
                best = found.score, other, found.relation
            if found is not None and found.sure(options):
                break
        if best is None or best[0] < options.geometry.related:
            lost.append(camera)
            continue
        _, other, relation = best
        relations[other, camera] = relation
        if known is None:
            offset, rate = clocks[other]
            clocks[camera] = relation.rate * offset + relation.offset, relation.rate * rate
        placed.append(camera)
    if known is None:  # told against the first camera
        offset, rate = clocks[0]
        clocks = np.stack([clocks[:, 0] - clocks[:, 1] / rate * offset, clocks[:, 1] / rate], axis=1)
    return clocks, relations, lost


def between(clocks: Floats, a: int, b: int) -> tuple[float, float]:
    """Offset and rate of b's clock against a's."""
    rate = clocks[b, 1] / clocks[a, 1]
    return float(clocks[b, 0] - rate * clocks[a, 0]), float(rate)


@dataclass(frozen=True, eq=False)
class Sorting:
    """Pieces of all cameras sorted into groups."""

    views: Sequence[PieceView]
    relations: dict[Pair, Relation]
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


def calibrated(
    views: Sequence[PieceView], clocks: Floats, calibration: Calibration, options: AssociationOptions
) -> dict[Pair, Relation]:
    """The relations of all pairs of known cameras: :math:`F = K_j^{-T} [t]_\\times R K_i^{-1}` with the motion R, t from i to j."""
    K, R, t = (getattr(calibration, name).detach().numpy().astype(np.float64) for name in ("K", "R", "t"))
    inverse = np.linalg.inv(K)
    out = {}
    for i, j in combinations(range(len(views)), 2):
        turn = R[j] @ R[i].T
        x, y, z = t[j] - turn @ t[i]
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        fundamental = inverse[j].T @ cross @ turn @ inverse[i]
        norm = np.linalg.norm(fundamental)
        if norm > 0:  # two cameras at one place have no epipolar geometry
            sigma = options.geometry.first_sigma * np.sqrt(views[i].pieces.size * views[j].pieces.size)
            out[i, j] = Relation(*between(clocks, i, j), fundamental / norm, float(sigma), held=True)
    return out


def _oriented(relations: dict[Pair, Relation], i: int, j: int, clock: tuple[float, float]) -> Relation | None:
    """The relation of i < j from one that may be of (j, i), with another clock."""
    if (i, j) in relations:
        return replace(relations[i, j], offset=clock[0], rate=clock[1])
    if (j, i) in relations:
        other = relations[j, i]
        return replace(other, fundamental=other.fundamental.T, offset=clock[0], rate=clock[1])
    return None


def sorted_out(views: Sequence[PieceView], clocks: Floats, relations: dict[Pair, Relation], options: AssociationOptions) -> Sorting:
    """Sort the pieces by the relations that there are, fit those of all pairs to who is the same, until nothing changes."""
    pairs = list(combinations(range(len(views)), 2))
    both = {(i, j): common(views[i], views[j], *between(clocks, i, j), options) for i, j in pairs}
    current = {(i, j): relation for i, j in pairs if (relation := _oriented(relations, i, j, between(clocks, i, j))) is not None}
    sorting = Sorting(views, current, np.zeros(0, dtype=np.int64))
    links, conflicts = _within(sorting)
    begins = np.concatenate(
        [(one.times[one.pieces.starts] - offset) / rate for one, (offset, rate) in zip(views, clocks, strict=True)]
    )
    labels: Integers | None = None
    for _ in range(options.clusters.rounds):
        scores = links.copy()
        for (i, j), relation in current.items():
            found = table(evidence(relation, both[i, j], options), both[i, j], (len(views[i].pieces), len(views[j].pieces)))
            a, b = sorting.starts[i], sorting.starts[j]
            scores[a : a + found.shape[0], b : b + found.shape[1]] = found
            scores[b : b + found.shape[1], a : a + found.shape[0]] = found.T
        after = clustered(scores, conflicts, options, begins)
        sorting = Sorting(views, current, after, scores, conflicts)
        if labels is not None and np.array_equal(after, labels):
            break
        labels = after
        current = _refitted(sorting, both, clocks, options)
    return sorting


def _within(sorting: Sorting) -> tuple[Floats, Booleans]:
    """Links and conflicts of pieces of one camera, among all pieces."""
    starts = sorting.starts
    links = np.zeros((starts[-1], starts[-1]))
    conflicts = np.zeros((starts[-1], starts[-1]), dtype=bool)
    for camera, one in enumerate(sorting.views):
        part = slice(starts[camera], starts[camera + 1])
        links[part, part] = one.pieces.links + one.pieces.links.T
        conflicts[part, part] = one.pieces.conflicts
    return links, conflicts


def _refitted(
    sorting: Sorting, both: dict[Pair, CommonMoments], clocks: Floats, options: AssociationOptions
) -> dict[Pair, Relation]:
    """The relations of all pairs by who is the same now; one that nobody fits any more stays."""
    out: dict[Pair, Relation] = {}
    for (i, j), moments in both.items():
        old = sorting.relations.get((i, j))
        matched = sorting.of(i)[:, None] == sorting.of(j)[None]
        if old is not None:
            a, b = sorting.starts[i], sorting.starts[j]
            matched &= sorting.scores[a : a + matched.shape[0], b : b + matched.shape[1]] > 0
        start = old or Relation(*between(clocks, i, j), np.full((3, 3), np.nan), moments.spread)
        rounds = options.geometry.reweighted + (2 if old is None else 0)
        found = fitted(start, moments, matched, rounds, options) if len(moments.a) else None
        if found is not None and (
            old is not None or found.sigma <= options.geometry.odd_sigma * moments.spread / options.geometry.spread
        ):
            out[i, j] = found
        elif old is not None:
            out[i, j] = old
    return out


def everybody_clocks(
    sorting: Sorting, clocks: Floats, lost: Sequence[int], options: AssociationOptions
) -> tuple[Clocks | None, Floats, list[Notice]]:
    """The clocks of all cameras by everybody who was recognized, whether they are decided, and the table that follows from them."""
    from dyntorch import combine_shifts

    chosen = _pairs_to_compare(sorting, options)
    people = _most_seen(sorting, options)
    shifts = {}
    for i, j in chosen:
        a, b = (_side_by_side(sorting, camera, people) for camera in (i, j))
        shift = compared(a, b, options)
        if shift is not None:
            shifts[i, j] = shift
    if not shifts:
        return None, clocks, [Notice(PeopleNotice.CLOCKS, 0.0, {"reason": "no two cameras show the same person for long enough"})]
    found = combine_shifts(shifts, len(sorting.views))
    notices = []
    if not found.ok and not lost:
        notices.append(Notice(PeopleNotice.CLOCKS, 0.0, {"reason": found.reason}))
    told = np.stack([found.offsets.numpy(), found.rates.numpy()], axis=1)
    usable = np.isfinite(told).all(1)
    frame = min(one.seen.fps for one in sorting.views)
    near = np.abs(told[:, 0] - clocks[:, 0]) * frame <= options.geometry.agree
    return found, np.where((usable & (near | found.ok))[:, None], told, clocks), notices


def _pairs_to_compare(sorting: Sorting, options: AssociationOptions) -> list[Pair]:
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
        if min(tied[i], tied[j]) < options.geometry.ties:
            chosen.append((i, j))
            tied[[i, j]] += 1
    return chosen


def _most_seen(sorting: Sorting, options: AssociationOptions) -> list[int]:
    """The groups with most frames, as many as the clocks are found by."""
    lengths = np.concatenate([one.lengths for one in sorting.views])
    seen = np.bincount(sorting.labels, weights=lengths)
    return np.argsort(-seen, kind="stable")[: options.geometry.people].tolist()


def _side_by_side(sorting: Sorting, camera: int, groups: Sequence[int]) -> tuple[Floats, Floats, Floats]:
    """Times, places ``(frames, groups * joints, 2)`` and trust of some groups in a camera."""
    one = sorting.views[camera]
    frames, _, joints = one.trust.shape
    places_, trust = np.full((frames, len(groups), joints, 2), np.nan), np.zeros((frames, len(groups), joints))
    label = np.where(one.piece >= 0, np.append(sorting.of(camera), -1)[one.piece], -1)
    for k, group in enumerate(groups):
        rows, slots = np.nonzero(label == group)
        places_[rows, k], trust[rows, k] = one.places[rows, slots], one.trust[rows, slots]
    return one.times, places_.reshape(frames, -1, 2), trust.reshape(frames, -1)


def identities(sorting: Sorting, options: AssociationOptions) -> list[int]:
    """The groups that are people: seen by two cameras at least, for long enough; those with most evidence first."""
    if not len(sorting.labels):
        return []
    found = []
    for group in range(int(sorting.labels.max()) + 1):
        seconds = [float(one.lengths[sorting.of(camera) == group].sum()) / one.seen.fps for camera, one in enumerate(sorting.views)]
        if sum(value > 0 for value in seconds) >= 2 and sorted(seconds)[-2] >= options.clusters.shortest:
            found.append(group)
    return found
