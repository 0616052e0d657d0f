"""Bodies made of pieces, improved by exchange: pieces move, and bodies are joined, as long as that lowers the cost."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import torch
from torch import Tensor

from dyntorch.tasks.segment.search import one_hot
from dyntorch.tasks.segment_tracks.descent import TrackEvidence, costs, fitted, noise
from dyntorch.tasks.segment_tracks.options import TrackSegmentOptions

Body = frozenset[int]
"""The pieces of a body."""
Exchange = tuple[int, int, Body, Body]
"""Two bodies, by their places, and what takes the place of each."""


class Exchanges:
    r"""Local search over the ways to make bodies of pieces."""

    def __init__(self, evidence: TrackEvidence, cut: Tensor, options: TrackSegmentOptions) -> None:
        """Of pieces, labels ``(n,)`` from 0."""
        self.evidence, self.cut, self.options = evidence, cut, options
        self.count = int(cut.max()) + 1
        self.members = one_hot(cut, self.count).double()
        self.sizes = [int(size) for size in self.members.sum(-1)]
        geometry = [F[None] for F in fitted(evidence.pairs, self.members, options.descent.first_fit_scales, steps=1)]
        self.scale = noise(evidence.pairs, geometry, self.members[None], options.descent)
        self.between = self.members @ evidence.links.pull(self.members).mT
        self.known: dict[Body, tuple[float, float]] = {}

    def improved(self, labels: Tensor, weight: float) -> Tensor:
        """Labels ``(n,)`` from 0 after the best exchanges from bodies ``(n,)`` made of the pieces, at a weight of the links."""
        bodies = [
            frozenset(piece for piece in range(self.count) if int(labels[self.cut == piece].median()) == body)
            for body in range(int(labels.max()) + 1)
        ]
        for _ in range(self.options.exchange.most):
            offered = [one for one in self._offered(bodies) if min(self._size(one[2]), self._size(one[3])) >= self._least]
            self._fit([*bodies, *(body for one in offered for body in one[2:])])
            gain = [self._cost([bodies[one[0]], bodies[one[1]]], weight) - self._cost(one[2:], weight) for one in offered]
            if not gain or max(gain) <= self.options.exchange.gain:
                break
            first, second, one, other = offered[gain.index(max(gain))]
            bodies[first], bodies[second] = one, other
        of_piece = [next(k for k, body in enumerate(bodies) if piece in body) for piece in range(self.count)]
        return torch.tensor(of_piece, device=labels.device)[self.cut]

    @property
    def _least(self) -> int:
        return self.options.descent.members

    def _size(self, body: Body) -> int:
        return sum(self.sizes[piece] for piece in body)

    def _offered(self, bodies: Sequence[Body]) -> Iterator[Exchange]:
        """A piece to the other body, or both bodies joined and a piece made a body of its own."""
        for first, second in combinations(range(len(bodies)), 2):
            a, b = bodies[first], bodies[second]
            for piece in sorted(a | b):
                alone = frozenset([piece])
                yield (first, second, a ^ alone, b ^ alone)
                yield (first, second, (a | b) - alone, alone)

    def _cost(self, bodies: Sequence[Body], weight: float) -> float:
        return sum(self.known[body][0] + weight * self.known[body][1] for body in bodies)

    def _fit(self, bodies: Sequence[Body]) -> None:
        """Know the costs of bodies, and half of the links that they cut: the other half is another body's."""
        new = [body for body in dict.fromkeys(bodies) if body not in self.known]
        if not new:
            return
        chosen = self.members.new_tensor([[float(piece in body) for piece in range(self.count)] for body in new])
        groups = chosen @ self.members
        geometry = [F[None] for F in fitted(self.evidence.pairs, groups, self.options.descent.first_fit_scales, steps=1)]
        own = (costs(self.evidence, geometry, self.scale, None, self.options)[0] * groups).sum(-1)
        cut = ((chosen @ self.between) * (1 - chosen)).sum(-1) / 2
        self.known.update(zip(new, zip(own.tolist(), cut.tolist(), strict=True), strict=True))
