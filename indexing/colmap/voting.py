"""Which bodies of all pairs are the ones that stand still: one decision over the graph of pairs that share keypoints.

Two images say what moves apart, not what moves.  The bodies of different pairs share keypoints, and a keypoint is on one thing.  So
an answer is a sign for every body of every pair (static, moving, or none): it starts from one body, whose keypoints vote static and
those of its pair's other bodies moving, and goes from keypoints to the bodies that hold them and back until nothing changes.  Of
the answers, each consistent in itself, the one is taken whose static keypoints spread widest, over each image and over all images:
a scene surrounds what moves in it, however many matches that has.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

MIN_SHARED_KEYPOINTS = 6  # of a body on which other pairs have voted, from which these decide about the body
MIN_AGREEMENT = 0.7  # in [-1, 1], of the votes on a body's keypoints from which it is static; below minus this it moves
SINGLE_BODY_WEIGHT = 0.3  # of the votes of a pair of one body
NEIGHBOUR_WEIGHT = 0.5  # of the votes of a matched keypoint, of its own ones
NUM_PASSES = 2  # times that votes are carried along matches: as many pairs away
MAX_ITERATIONS = 30  # of the exchange between bodies and keypoints
NUM_SEED_PAIRS = 5  # with most matches whose bodies are tried as the static one: 15 bodies or so
GRID_CELLS = 8  # columns and rows of the grid on an image in which keypoints are counted
BORDER_WEIGHT = 0.5  # of the outermost cells, where what is static surrounds what moves
MIN_SPREAD_RATIO = 1.15  # over the next body, of the static one; ten scenes of which 60 % moves: 3.3 to 9
DUPLICATE_OVERLAP = 0.5  # share of common static keypoints from which two answers are one


@dataclass(frozen=True, eq=False)
class DividedPair:
    """Matches of two images, divided."""

    first: IntArray  # ``(m,)`` keypoints, numbered through all images
    second: IntArray
    labels: IntArray  # ``(m,)`` 0 = of no body, 1..K the bodies

    @property
    def bodies(self) -> int:
        """K."""
        return int(self.labels.max(initial=0))


@dataclass(frozen=True, eq=False)
class Votes:
    """The answer."""

    keypoints: FloatArray
    signs: tuple[IntArray, ...]  # for each pair the signs ``(K,)`` of its bodies: 1 static, -1 moving, 0 undecided
    lead: float  # spread of the answer over that of the next one, the least of all parts of the graph
    spread: FloatArray  # ``(images,)`` in [0, 1] how far the static keypoints spread over each image
    open: tuple[int, ...] = ()  # the images of parts in which another body spreads as widely, so that nothing has a sign there


def vote(pairs: Sequence[DividedPair], cells: IntArray, image: IntArray) -> Votes:
    """Decide what stands still. cells ``(q,)``, image ``(q,)``."""
    graph = _Graph(pairs, cells, image)
    signs = np.zeros(graph.nodes, dtype=np.int64)
    lead, undecided = np.inf, list[int]()
    tried = np.zeros(len(pairs), dtype=bool)
    while True:
        seeds = graph.seeds(signs, tried)
        if not len(seeds):
            break
        best, ahead = _answer(graph, seeds, signs)
        told = best != signs
        tried[graph.pair[seeds]] = True
        lead = min(lead, ahead)
        if ahead >= MIN_SPREAD_RATIO:
            signs = best
        else:
            tried[graph.pair[told]] = True
            undecided += graph.images_of(told)
    keypoints = graph.propagate_votes(signs)
    split = np.split(graph.restore_static(signs), np.cumsum([pair.bodies for pair in pairs])[:-1]) if pairs else []
    return Votes(keypoints, tuple(split), float(lead), graph.spread(keypoints > 0), tuple(sorted(set(undecided))))


def _answer(graph: _Graph, seeds: IntArray, signs: IntArray) -> tuple[IntArray, float]:
    """The best answer from any of the bodies, beside the signs that stand already, and its lead over the next one."""
    found = []
    for seed in seeds.tolist():
        mine = graph.propagate_signs(graph.seed_signs(seed, signs))
        static = graph.mean_votes(mine) > 0
        found.append((float(graph.spread(static).sum()), mine, static))
    found.sort(key=lambda answer: -answer[0])
    spread, best, static = found[0]
    others = [other for other, _, also in found[1:] if _overlap_share(static, also) < DUPLICATE_OVERLAP]
    before = float(graph.spread(graph.mean_votes(signs) > 0).sum())  # of parts of the graph that were decided earlier
    return best, (spread - before) / max(max(others, default=0.0) - before, 1e-9) if others else np.inf


def _overlap_share(first: NDArray[np.bool_], second: NDArray[np.bool_]) -> float:
    either = int((first | second).sum())
    return int((first & second).sum()) / either if either else 1.0


class _Graph:
    """Bodies of pairs (nodes) and the keypoints that they hold."""

    def __init__(self, pairs: Sequence[DividedPair], cells: IntArray, image: IntArray) -> None:
        bodies = [pair.bodies for pair in pairs]
        self.nodes = sum(bodies)
        self.pair = np.repeat(np.arange(len(pairs)), bodies)
        self.weights = np.repeat([SINGLE_BODY_WEIGHT if count == 1 else 1.0 for count in bodies], bodies)
        ends, nodes, links = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros((2, 0), np.int64)]
        for pair, start in zip(pairs, np.cumsum([0, *bodies]).tolist(), strict=False):
            held = pair.labels > 0
            ends += [pair.first[held], pair.second[held]]
            nodes += [start + pair.labels[held] - 1] * 2
            links.append(np.stack([pair.first[held], pair.second[held]]))
        # a keypoint counts once in a body, however many matches of a pair it is in
        entry = np.unique(np.stack([np.concatenate(nodes), np.concatenate(ends)]), axis=1)
        self.node, self.keypoint = entry
        self.sizes = np.bincount(self.node, minlength=self.nodes)
        link = np.concatenate(links, axis=1)
        both = np.concatenate([link, link[::-1]], axis=1)
        self.links = coo_array((np.ones(both.shape[1]), (both[0], both[1])), shape=(len(image), len(image))).tocsr()
        self.image, self.images = image, int(image.max(initial=-1)) + 1
        self.part = self._parts(len(pairs))
        self._grid(cells)

    def _grid(self, cells: IntArray) -> None:
        """Cells of all images, by their weight: those that hold a keypoint of any body; of each image they sum to 1."""
        many = GRID_CELLS**2
        self.cell = self.image * many + cells
        row, column = np.divmod(np.arange(many), GRID_CELLS)
        edge = (np.minimum(row, column) == 0) | (np.maximum(row, column) == GRID_CELLS - 1)
        held = np.zeros(self.images * many)
        held[self.cell[np.unique(self.keypoint)]] = 1
        whole = held.reshape(self.images, many)
        outer = whole * edge
        inner, border = (part / np.maximum(part.sum(axis=1, keepdims=True), 1) for part in (whole, outer))
        share = np.where(outer.any(axis=1, keepdims=True), BORDER_WEIGHT, 0.0)
        self.worth = (1 - share) * inner + share * border

    def spread(self, static: NDArray[np.bool_]) -> FloatArray:
        """``(images,)`` how far keypoints spread over each."""
        held = np.zeros(self.worth.size)
        held[self.cell[static]] = 1
        return np.asarray((held.reshape(self.worth.shape) * self.worth).sum(axis=1))

    def images_of(self, nodes: NDArray[np.bool_]) -> list[int]:
        """The images whose keypoints some bodies hold."""
        return [int(image) for image in np.unique(self.image[self.keypoint[nodes[self.node]]])]

    def seeds(self, signs: IntArray, tried: NDArray[np.bool_]) -> IntArray:
        """Bodies to start from: those of the largest pairs none of whose bodies has a sign, and of their part of the graph."""
        count = len(tried)
        signed = np.zeros(count, dtype=bool)
        signed[self.pair[signs != 0]] = True
        sizes = np.bincount(self.pair, weights=self.sizes, minlength=count)
        open_ = np.flatnonzero(~signed & ~tried & (sizes > 0))
        if not len(open_):
            return np.zeros(0, dtype=np.int64)
        # of the part with the largest pair: elsewhere other bodies decide
        first = open_[np.argmax(sizes[open_])]
        open_ = open_[self.part[open_] == self.part[first]]
        chosen = open_[np.argsort(-sizes[open_], kind="stable")][:NUM_SEED_PAIRS]
        return np.flatnonzero(np.isin(self.pair, chosen))

    def _parts(self, pairs: int) -> IntArray:
        """Connected parts of the graph, by pair: those that share keypoints."""
        keypoint = pairs + self.keypoint
        total = pairs + len(self.image)
        edges = coo_array((np.ones(len(keypoint)), (self.pair[self.node], keypoint)), shape=(total, total))
        return np.asarray(connected_components(edges, directed=False)[1][:pairs], dtype=np.int64)

    def seed_signs(self, seed: int, signs: IntArray) -> IntArray:
        """The signs that stand, and one body static in its pair."""
        mine = signs.copy()
        mine[self.pair == self.pair[seed]] = -1
        mine[seed] = 1
        return mine

    def propagate_signs(self, signs: IntArray) -> IntArray:
        """Signs of all bodies that keypoints lead to, from those of some."""
        for _ in range(MAX_ITERATIONS):
            agreement, known = self.agreement(signs)
            told = known >= MIN_SHARED_KEYPOINTS
            new = np.where(told, np.where(np.abs(agreement) >= MIN_AGREEMENT, np.sign(agreement), 0), signs).astype(np.int64)
            # beside a static body, one that other pairs know nothing of moves
            beside = np.zeros(int(self.pair.max(initial=-1)) + 1, dtype=bool)
            beside[self.pair[new > 0]] = True
            new = np.where(~told & (new == 0) & beside[self.pair], -1, new)
            new = self._keep_one_static(new, np.where(told, agreement * known, self.sizes))
            if np.array_equal(new, signs):
                break
            signs = new
        return signs

    def _keep_one_static(self, signs: IntArray, support: FloatArray) -> IntArray:
        """At most one static body in a pair, the one with most support: the pair says that they move apart."""
        static = np.flatnonzero(signs > 0)
        order = static[np.lexsort((-support[static], self.pair[static]))]
        first = np.unique(self.pair[order], return_index=True)[1]
        rest = np.setdiff1d(order, order[first])
        signs = signs.copy()
        signs[rest] = -1
        return signs

    def restore_static(self, signs: IntArray) -> IntArray:
        """The signs, with the parts of the scene that some pairs take for bodies of their own static again."""
        agreement, known = self.agreement(signs)
        again = (signs < 0) & (known >= MIN_SHARED_KEYPOINTS) & (agreement >= MIN_AGREEMENT)
        return np.where(again, 1, signs)

    def agreement(self, signs: IntArray) -> tuple[FloatArray, IntArray]:
        """``(nodes,)`` how far the other pairs agree on the keypoints of a body, in [-1, 1], and on how many there is a vote."""
        votes, total = self._sums(signs)
        weight = self.weights * np.abs(signs)
        others = total[self.keypoint] - weight[self.node]
        mean = (votes[self.keypoint] - (weight * signs)[self.node]) / np.maximum(others, 1e-9)
        there = others > 1e-6
        node, mean = self.node[there], mean[there]
        known = np.bincount(node, minlength=self.nodes)
        sums, sizes = (np.bincount(node, each, minlength=self.nodes) for each in (mean, np.abs(mean)))
        return np.asarray(sums / np.maximum(sizes, 1e-9)), known

    def _sums(self, signs: IntArray) -> tuple[FloatArray, FloatArray]:
        """``(q,)`` weighted votes on each keypoint, and the weights."""
        weight = self.weights * np.abs(signs)
        votes, total = (
            np.bincount(self.keypoint, each[self.node], minlength=len(self.image)).astype(np.float64)
            for each in (weight * signs, weight)
        )
        return votes, total

    def mean_votes(self, signs: IntArray) -> FloatArray:
        """``(q,)`` mean vote on every keypoint, 0 where there is none."""
        votes, total = self._sums(signs)
        return np.asarray(votes / np.maximum(total, 1e-9))

    def propagate_votes(self, signs: IntArray) -> FloatArray:
        """The same with the votes on the keypoints that a keypoint is matched with."""
        own, total = self._sums(signs)
        mean = own / np.maximum(total, 1e-9)
        for _ in range(NUM_PASSES):
            known = (np.abs(mean) > 0).astype(np.float64)
            votes = own + NEIGHBOUR_WEIGHT * (self.links @ mean)
            mean = votes / np.maximum(total + NEIGHBOUR_WEIGHT * (self.links @ known), 1e-9)
        return np.asarray(mean)
