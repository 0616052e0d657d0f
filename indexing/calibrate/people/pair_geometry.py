"""Two cameras: clock and epipolar geometry, and what they say about which piece of one is which piece of the other."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy.linalg import block_diag

import dyntorch
from dyntorch import Shift
from indexing.calibrate.people.tracklets import MIN_JOINTS, Booleans, CameraSightings, Floats, Integers, Tracklets, cluster

MAX_DETECTION_DISTANCE = 0.6  # frames from a moment within which a detection stands for it
MAX_INTERPOLATED_FRAMES = 2.5  # between two detections
STRANGER_DISTANCE = 0.1  # body sizes: distance of different people from each other's epipolar lines
INDEPENDENT_BODY_JOINTS = 4.0  # in one body: its joints are off together
EVIDENCE_SECONDS = 0.1  # within which frames carry the same evidence
MAX_SEARCH_FRAMES = 150  # at which two cameras are compared while their geometry is searched
MAX_MATCH_ITERATIONS = 4  # matching people and refitting the geometry to them
NUM_REWEIGHTINGS = 2  # steps of reweighted least squares each time
MIN_RELATIVE_GAIN = 0.01  # of an iteration to go on
MIN_MATCHES = 60  # points that a geometry is fitted to
MIN_SIGMA = 0.05  # pixels
INITIAL_SIGMA = 0.02  # body sizes: accuracy of the geometry of two people when applied to everybody
NUM_SEEDS = 3  # tracklets of each camera that are compared to find a geometry
MIN_SEED_SECONDS = 0.8  # that such a tracklet lasts
MIN_SYNCHRONIZE_FRAMES = 12  # that dyntorch.synchronize takes
MIN_EXPLAINED = 0.75  # share of the people with a partner, from which the search ends
MAX_CONFIDENT_SIGMA = 0.015  # body sizes then: .008 to .010 with 6 px of noise; two different people .03 (pose2sim)


@dataclass(frozen=True, eq=False)
class PieceView:
    """A camera whose detections are sorted by pieces. places ``(frames, slots, joints, 2)``, trust
    ``(frames, slots, joints)``, piece ``(frames, slots)``, track ``(frames, slots)``."""

    seen: CameraSightings
    pieces: Tracklets
    places: Floats
    trust: Floats
    piece: Integers
    track: Integers

    @property
    def times(self) -> Floats:
        """``(frames,)`` seconds."""
        return self.seen.times

    @property
    def lengths(self) -> Integers:
        """``(pieces,)`` frames in which each is seen."""
        return np.bincount(self.piece[self.piece >= 0], minlength=len(self.pieces)).astype(np.int64)


def arrange(seen: CameraSightings, pieces: Tracklets) -> PieceView:
    """Sort the detections of a camera by pieces: as few slots as hold all at once."""
    frames, joints = len(seen.times), seen.places.shape[2]
    free: list[int] = []
    slot = np.zeros(len(pieces), dtype=np.int64)
    for one in np.argsort(pieces.starts, kind="stable").tolist():
        open_slots = [k for k, until in enumerate(free) if until < pieces.starts[one]]
        slot[one] = open_slots[0] if open_slots else len(free)
        if open_slots:
            free[slot[one]] = int(pieces.ends[one])
        else:
            free.append(int(pieces.ends[one]))
    width = max(1, len(free))
    places, trust = np.full((frames, width, joints, 2), np.nan), np.zeros((frames, width, joints))
    piece, track = (np.full((frames, width), -1, dtype=np.int64) for _ in range(2))
    rows, columns = np.nonzero(pieces.number >= 0)
    target = slot[pieces.number[rows, columns]]
    places[rows, target], trust[rows, target] = seen.places[rows, columns], seen.trust[rows, columns]
    piece[rows, target], track[rows, target] = pieces.number[rows, columns], columns
    return PieceView(seen, pieces, places, trust, piece, track)


def interpolate(one: PieceView, times: Floats) -> tuple[Floats, Floats, Integers]:
    """What a camera saw at any times of its clock: linear between frames, the nearest frame where a piece has no other."""
    last = len(one.times) - 1
    after = np.clip(np.searchsorted(one.times, times), min(1, last), last)
    before = np.maximum(after - 1, 0)
    width = np.maximum(one.times[after] - one.times[before], 1e-12)
    share = (times - one.times[before]) / width
    step = 1.0 / one.seen.fps
    nearest = np.where(share > 0.5, after, before)
    other = np.where(share > 0.5, before, after)
    near = np.abs(times - one.times[nearest]) <= MAX_DETECTION_DISTANCE * step
    piece = np.where(near[:, None], one.piece[nearest], -1)
    weight = np.minimum(share, 1 - share)[:, None]
    between = (one.piece[other] == piece) & (piece >= 0) & (weight >= 0) & (width <= MAX_INTERPOLATED_FRAMES * step)[:, None]
    factor = np.where(between, weight, 0.0)[..., None, None]
    places = (1 - factor) * one.places[nearest] + np.where(between[..., None, None], factor * one.places[other], 0.0)
    trust = np.where(between[..., None], np.minimum(one.trust[nearest], one.trust[other]), one.trust[nearest])
    known = np.isfinite(places).all(-1) & (piece >= 0)[..., None]
    return np.where(known[..., None], places, np.nan), np.where(known, trust, 0.0), piece


@dataclass(frozen=True, eq=False)
class CameraPair:
    """How camera b relates to camera a. fundamental ``(3, 3)``."""

    offset: float
    rate: float
    fundamental: Floats
    sigma: float
    shift: Shift | None = None


@dataclass(frozen=True, eq=False)
class CommonFrames:
    """What both cameras saw at the same times: those of the first camera's frames. a, b ``(T, slots, joints, 2)``, trust_a,
    trust_b ``(T, slots, joints)``, piece_a, piece_b ``(T, slots)``."""

    a: Floats
    b: Floats
    trust_a: Floats
    trust_b: Floats
    piece_a: Integers
    piece_b: Integers
    fps: float
    spread: float


def common_frames(a: PieceView, b: PieceView, offset: float, rate: float, most: int | None = None) -> CommonFrames:
    """Both cameras at the frames of the first one, as far as the second one runs."""
    moments = rate * a.times + offset
    margin = MAX_DETECTION_DISTANCE / b.seen.fps
    rows = np.flatnonzero((moments >= b.times[0] - margin) & (moments <= b.times[-1] + margin))
    every = 1 if most is None else max(1, math.ceil(len(rows) / most))
    rows = rows[::every]
    places, trust, piece = interpolate(b, moments[rows])
    spread = STRANGER_DISTANCE * math.sqrt(a.pieces.size * b.pieces.size)
    return CommonFrames(a.places[rows], places, a.trust[rows], trust, a.piece[rows], piece, a.seen.fps / every, spread)


def distances(fundamental: Floats, a: Floats, b: Floats) -> Floats:
    """Sampson distances ``(T, slots_a, slots_b, joints)`` px of everybody from everybody; NaN where one is not seen."""
    return _sampson(fundamental, a[:, :, None], b[:, None])[0]


def evidence(relation: CameraPair, both: CommonFrames) -> Floats:
    """Nats for being the same person, ``(T, slots_a, slots_b)``; 0 where nothing can be compared."""
    return _evidence_of(distances(relation.fundamental, both.a, both.b), relation.sigma, both)


def _evidence_of(away: Floats, sigma: float, both: CommonFrames) -> Floats:
    weight = np.sqrt(both.trust_a[:, :, None] * both.trust_b[:, None])
    known = np.isfinite(away) & (weight > 0)
    r = np.where(known, away, 0.0)
    same = math.log(2 / (math.pi * math.sqrt(3))) - math.log(sigma) - 2 * np.log1p(np.square(r / sigma) / 3)
    other = -math.log(math.pi) - math.log(both.spread) - np.log1p(np.square(r / both.spread))
    each = np.where(known, weight * (same - other), 0.0)
    joints = known.sum(-1)
    worth = INDEPENDENT_BODY_JOINTS / max(1, away.shape[-1]) / max(1.0, both.fps * EVIDENCE_SECONDS)
    return np.asarray(np.where(joints >= MIN_JOINTS, worth * each.sum(-1), 0.0))


def sum_over_time(found: Floats, both: CommonFrames, shape: tuple[int, int]) -> Floats:
    """Evidence ``(T, slots_a, slots_b)`` summed over time for every two pieces."""
    first, second = np.broadcast_arrays(both.piece_a[:, :, None], both.piece_b[:, None])
    known = (first >= 0) & (second >= 0)
    flat = np.bincount(first[known] * shape[1] + second[known], weights=found[known], minlength=shape[0] * shape[1])
    return np.asarray(flat.reshape(shape))


def fit_pair(
    relation: CameraPair,
    both: CommonFrames,
    matched: Booleans,
    rounds: int,
) -> CameraPair | None:
    """The relation with the fundamental matrix and sigma of those who are the same, by reweighted least squares. matched
    ``(pieces_a, pieces_b)``."""
    x1, x2, weight = _matched_points(both, matched)
    if len(x1) < MIN_MATCHES:
        return None
    first, second = torch.from_numpy(x1), torch.from_numpy(x2)
    fundamental, sigma = relation.fundamental, relation.sigma
    for _ in range(rounds):
        if np.isfinite(fundamental).all():
            r, gradient = _sampson(fundamental, x1, x2)
            w = weight / (1 + np.square(r / sigma) / 3) / gradient
        else:
            w = weight
        solution = dyntorch.fit(dyntorch.FundamentalMatrix, first, second, weights=torch.from_numpy(w / w.max()))
        if int(solution.status) not in (dyntorch.Status.OK, dyntorch.Status.AMBIGUOUS):
            return None
        fundamental = solution.tensor.numpy()
        r, _ = _sampson(fundamental, x1, x2)
        sigma = _robust_sigma(r)
    return replace(relation, fundamental=fundamental, sigma=sigma)


def _robust_sigma(away: Floats) -> float:
    """Sigma by the median distance, which for Student's t with 3 degrees of freedom is .765 of it."""
    return max(float(np.median(np.abs(away))) / 0.7648923284, MIN_SIGMA)


def same_people(both: CommonFrames, matched: Booleans) -> Booleans:
    """``(T, slots_a, slots_b)`` where both show the same person."""
    there = (both.piece_a >= 0)[:, :, None] & (both.piece_b >= 0)[:, None]
    return np.asarray(matched[both.piece_a[:, :, None], both.piece_b[:, None]] & there)


def _matched_points(both: CommonFrames, matched: Booleans) -> tuple[Floats, Floats, Floats]:
    """The points of those who are the same, ``(n, 2)`` each, and their weights."""
    t, i, j = np.nonzero(same_people(both, matched))
    x1, x2 = both.a[t, i].reshape(-1, 2), both.b[t, j].reshape(-1, 2)
    weight = np.sqrt(both.trust_a[t, i] * both.trust_b[t, j]).reshape(-1)
    known = (weight > 0) & np.isfinite(x1).all(1) & np.isfinite(x2).all(1)
    return x1[known], x2[known], weight[known]


def _sampson(fundamental: Floats, x1: Floats, x2: Floats) -> tuple[Floats, Floats]:
    """Distances and squared gradients of matches ``(..., 2)``, from their lines in the other camera."""
    of_a, of_b = x1 @ fundamental[:, :2].T + fundamental[:, 2], x2 @ fundamental[:2] + fundamental[2]
    gradient = np.maximum(np.square(of_a[..., :2]).sum(-1) + np.square(of_b[..., :2]).sum(-1), 1e-300)
    return ((x2 * of_a[..., :2]).sum(-1) + of_a[..., 2]) / np.sqrt(gradient), gradient


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A relation with who is who by it."""

    relation: CameraPair
    score: float
    explained: float
    size: float

    def confident(self) -> bool:
        """Whether nothing better is to be looked for."""
        decided = self.relation.shift is None or self.relation.shift.ok
        return decided and self.explained >= MIN_EXPLAINED and self.relation.sigma <= MAX_CONFIDENT_SIGMA * self.size


def match_and_refit(a: PieceView, b: PieceView, relation: CameraPair) -> Hypothesis | None:
    """Match everybody by a relation that may come from two people only, and fit it to all who were matched."""
    both = common_frames(a, b, relation.offset, relation.rate, MAX_SEARCH_FRAMES)
    if not len(both.a):
        return None
    shape, size = (len(a.pieces), len(b.pieces)), math.sqrt(a.pieces.size * b.pieces.size)
    conflicts = block_diag(a.pieces.conflicts, b.pieces.conflicts)
    best: Hypothesis | None = None
    for _ in range(MAX_MATCH_ITERATIONS):
        nats = evidence(relation, both)
        scores = sum_over_time(nats, both, shape)
        within = (np.zeros((n, n)) for n in shape)
        labels = cluster(np.block([[next(within), scores], [scores.T, next(within)]]), conflicts)
        matched = (labels[: shape[0], None] == labels[None, shape[0] :]) & (scores > 0)
        hypothesis = Hypothesis(relation, float(scores[matched].sum()), _explained_share(both, matched), size)
        if best is not None and hypothesis.score <= best.score * (1 + MIN_RELATIVE_GAIN):
            return best if best.score >= hypothesis.score else hypothesis
        best = hypothesis
        refitted = fit_pair(relation, both, matched, NUM_REWEIGHTINGS)
        if refitted is None:
            return best
        relation = refitted
    return best


def _explained_share(both: CommonFrames, matched: Booleans) -> float:
    could = np.minimum((both.piece_a >= 0).sum(1), (both.piece_b >= 0).sum(1)).sum()
    return float(same_people(both, matched).any(2).sum() / max(1, could))


def seed_pairs(a: PieceView, b: PieceView) -> list[tuple[int, int]]:
    """The pieces that are compared to find clock and geometry: the longest of both cameras, longest first."""
    longest = [
        [
            k
            for k in np.argsort(-one.lengths, kind="stable")[:NUM_SEEDS].tolist()
            if one.lengths[k] >= MIN_SEED_SECONDS * one.seen.fps
        ]
        for one in (a, b)
    ]
    every = [(i, j) for i in longest[0] for j in longest[1]]
    return sorted(every, key=lambda both: -min(a.lengths[both[0]], b.lengths[both[1]]))


def propose_unsynchronized(a: PieceView, b: PieceView) -> Iterator[CameraPair]:
    """Relations by comparing pieces of people whose clocks nobody knows."""
    for i, j in seed_pairs(a, b):
        shift = synchronize_tracklets(_tracklet_points(a, i), _tracklet_points(b, j), quick=True)
        if shift is not None and shift.fundamental is not None and math.isfinite(shift.offset):
            yield CameraPair(shift.offset, shift.rate, shift.fundamental.numpy().astype(np.float64), math.nan, shift)


def _tracklet_points(one: PieceView, piece: int) -> tuple[Floats, Floats, Floats]:
    """Times, places and trust of one piece."""
    rows, slots = np.nonzero(one.piece == piece)
    return one.times[rows], one.places[rows, slots], one.trust[rows, slots]


def synchronize_tracklets(a: tuple[Floats, Floats, Floats], b: tuple[Floats, Floats, Floats], quick: bool = False) -> Shift | None:
    """:func:`dyntorch.synchronize` of times, places ``(frames, n, 2)`` and trust; None where it takes neither."""
    if min(len(a[0]), len(b[0])) < MIN_SYNCHRONIZE_FRAMES:
        return None
    more: dict[str, Any] = {}
    if quick:  # two people who are not the same have no points that are: nothing to look for
        every = dyntorch.SynchronizeOptions(reject_points=False)
        more = {"camera": "perspective", "rate": 1.0, "calibration": (None, None), "options": every}
    times, places, trust = ((torch.from_numpy(x), torch.from_numpy(y)) for x, y in zip(a, b, strict=True))
    shift: Shift = dyntorch.synchronize(places[0], places[1], times=times, weights=trust, correspondence=True, **more)
    return shift


def propose_synchronized(a: PieceView, b: PieceView, offset: float, rate: float) -> Iterator[CameraPair]:
    """Relations of people who may be the same, where the clocks are known."""
    both = common_frames(a, b, offset, rate, MAX_SEARCH_FRAMES)
    for i, j in seed_pairs(a, b):
        matched = np.zeros((len(a.pieces), len(b.pieces)), dtype=bool)
        matched[i, j] = True
        start = CameraPair(offset, rate, np.full((3, 3), np.nan), both.spread)
        fitted = fit_pair(start, both, matched, NUM_REWEIGHTINGS + 2) if len(both.a) else None
        if fitted is not None:
            yield fitted


def estimate_pair(a: PieceView, b: PieceView, clock: tuple[float, float] | None = None) -> Hypothesis | None:
    """The relation of two cameras that explains most people, or None where there is none."""
    best: Hypothesis | None = None
    for start in propose_unsynchronized(a, b) if clock is None else propose_synchronized(a, b, *clock):
        first = INITIAL_SIGMA * math.sqrt(a.pieces.size * b.pieces.size)
        relation = start if math.isfinite(start.sigma) else replace(start, sigma=first)
        hypothesis = match_and_refit(a, b, relation)
        if hypothesis is not None and (best is None or hypothesis.score > best.score):
            best = hypothesis
        if best is not None and best.confident():
            break
    return best
