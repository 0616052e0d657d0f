"""What a segmentation of tracks costs: distances from the epipolar geometry of many pairs of frames, links cut, and relief."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from math import log1p

import torch
from torch import Tensor

from dyntorch.geometry.epipolar_fit import descend, fit_fundamental
from dyntorch.tasks.segment.coherence import Links, mean_field, relief_cost
from dyntorch.tasks.segment.frame_pairs import FramePair, PairStack
from dyntorch.tasks.segment.search import one_hot

Geometry = Tensor
"""Fundamental matrices ``(P, B, K, 3, 3)``, for every pair of frames."""


TRACK_FREEDOM = 2.0  # degrees of freedom of Student's distribution of Sampson distances: some tracks slide
MAX_TRACK_DISTANCE = 4.0  # in standard deviations
MIN_TRACK_NOISE_PIXELS = 0.03  # of a coordinate of a track at rest
MAX_TRACK_NOISE_PIXELS = 0.5  # largest one, pixels
EFFECTIVE_PAIRS = 3.0  # that the pairs of frames of a track count as: their errors are not independent
RELIEF_WEIGHT = 0.2  # of the parallax against the mean plane of a body
MIN_TRACK_PARALLAX_PIXELS = 0.5  # tracks are precise: before a static camera moving bodies would pass for relief
NUM_TRACK_ROUNDS = 4  # of labels and geometries
NUM_TRACK_LABEL_UPDATES = 3  # of the mean field in each round
FIRST_FIT_SCALES_PIXELS = (4.0, 1.0)  # one after the other
TRACK_FIT_SCALE = 3.0  # in standard deviations
MIN_TRACK_FIT_SCALE_PIXELS = 0.15  # least scale of the fits, pixels
MIN_BODY_TRACKS = 7  # fewest tracks of a body


@dataclass(frozen=True)
class TrackEvidence:
    """Tracks in many pairs of frames."""

    pairs: Sequence[FramePair]  # of frames
    links: Links  # between tracks that move alike
    count: Tensor  # ``(n,)`` pairs that each track is in

    @staticmethod
    def of(pairs: Sequence[FramePair], links: Links) -> TrackEvidence:
        """With the number of pairs of each track."""
        count = torch.zeros(len(links.index), dtype=torch.float64, device=links.index.device)
        for pair in pairs:
            count[pair.index] += 1
        return TrackEvidence(pairs, links, count)

    @cached_property
    def stack(self) -> PairStack:
        """All pairs side by side."""
        return PairStack.of(self.pairs)

    def share(self) -> Tensor:
        """``(n,)`` weight of what one pair says of a track: together they count as ``EFFECTIVE_PAIRS``."""
        return EFFECTIVE_PAIRS / self.count.clamp(min=1)


@dataclass(frozen=True)
class Candidates:
    """Segmentations into the same number of bodies."""

    labels: Tensor  # ``(B, n)`` from 0
    member: Tensor  # ``(B, K, n)`` probabilities
    geometry: Geometry  # of the bodies
    scale: Tensor  # ``(B,)`` standard deviation of a coordinate of a track at rest, pixels
    energy: Tensor  # ``(B,)``, infinite where a body has too few tracks

    @property
    def bodies(self) -> int:
        """How many bodies."""
        return self.geometry.shape[2]

    def of(self, which: int) -> Candidates:
        """One of them."""
        part = slice(which, which + 1)
        return Candidates(self.labels[part], self.member[part], self.geometry[:, part], self.scale[part], self.energy[part])


def no_links(count: int, device: torch.device) -> Links:
    """No links between so many tracks."""
    return Links(torch.zeros(count, 0, dtype=torch.long, device=device), torch.zeros(count, 0, dtype=torch.float64, device=device))


def fit_groups(evidence: TrackEvidence, groups: Tensor, scales: Sequence[float], steps: int = 2) -> Tensor:
    """Fundamental matrices ``(P, B, 3, 3)`` of groups of tracks ``(B, n)``, weights, for every pair of frames."""
    fits = []
    for part in evidence.stack.split(len(groups)):
        view, weight = part.view, part.members(groups) * part.weight[:, None]
        fits.append(fit_fundamental(view.x1, view.x2, weight, [scale * view.pixel for scale in scales], steps=steps)[0])
    return torch.cat(fits)


def squares(part: PairStack, fundamentals: Tensor) -> Tensor:
    """Squared Sampson distances ``(p, *batch, m)`` in pixels, as of tracks at rest: fundamentals ``(p, *batch, 3, 3)``."""
    value, square = part.monomials.flat_terms(fundamentals.reshape(len(fundamentals), -1, 9))
    at_rest = value.square() / square * (part.precision / part.view.pixel**2)[:, None]
    return at_rest.view(*fundamentals.shape[:-2], -1)


def noise(evidence: TrackEvidence, geometry: Geometry, member: Tensor) -> Tensor:
    """Standard deviations ``(B,)`` of a coordinate of a track at rest, for members ``(B, K, n)``: most likely for Student's
    distribution of all distances from the own body."""
    own, weight = [], []
    for part, F in _parts(evidence, geometry):
        members = part.members(member)
        own.append((squares(part, F) * members).sum(-2).movedim(0, 1)[:, part.present])
        weight.append(members.sum(-2).movedim(0, 1)[:, part.present])
    square, present = torch.cat(own, dim=-1), torch.cat(weight, dim=-1)
    low, high = MIN_TRACK_NOISE_PIXELS**2, MAX_TRACK_NOISE_PIXELS**2
    variance = (2 * square.median(-1).values).clamp(low, high)
    total = present.sum(-1).clamp(min=1.0)
    for _ in range(4):
        heavy = (TRACK_FREEDOM + 1) / (TRACK_FREEDOM + square / variance[:, None])
        variance = ((heavy * square * present).sum(-1) / total).clamp(low, high)
    return variance.sqrt()


def costs(
    evidence: TrackEvidence, geometry: Geometry, scale: Tensor, member: Tensor | None, relief_weight: float = RELIEF_WEIGHT
) -> Tensor:
    """Cost ``(B, K, n)`` of every track in every body without links; with the relief of bodies of members ``(B, K, n)``."""
    B, K = geometry.shape[1:3]
    total = torch.zeros(B, K, len(evidence.count), dtype=torch.float64, device=scale.device)
    worst = (TRACK_FREEDOM + 1) * log1p(MAX_TRACK_DISTANCE**2 / TRACK_FREEDOM)
    for part, F in _parts(evidence, geometry):
        ratio = squares(part, F) / scale.square()[:, None, None]
        cost = ((TRACK_FREEDOM + 1) * torch.log1p(ratio / TRACK_FREEDOM)).clamp(max=worst)
        if member is not None and relief_weight > 0:
            cost = cost + relief_weight * relief_cost(part.view, F, part.members(member), MIN_TRACK_PARALLAX_PIXELS)
        cost = (cost * part.present[:, None, None]).movedim(0, 2).flatten(2)
        total.scatter_add_(-1, part.index.flatten().expand(cost.shape), cost)
    return total * evidence.share()


def _parts(evidence: TrackEvidence, geometry: Geometry) -> Iterator[tuple[PairStack, Tensor]]:
    """Pairs that are taken together, with the geometry of the bodies there."""
    parts = evidence.stack.split(geometry.shape[1:3].numel())
    return zip(parts, geometry.split([len(part.index) for part in parts]), strict=True)


def descend_labels(evidence: TrackEvidence, labels: Tensor, bodies: int) -> Candidates:
    """Labels and epipolar geometries in turns, from several labellings ``(B, n)`` from 0."""
    count = len(labels)
    member = one_hot(labels, bodies).float()
    geometry = fit_groups(evidence, member.flatten(0, 1), FIRST_FIT_SCALES_PIXELS).unflatten(1, (count, bodies))

    def turn(member: Tensor, geometry: Geometry) -> tuple[Tensor, Tensor]:
        scale = noise(evidence, geometry, member)
        cost = costs(evidence, geometry, scale, member).float()
        # links are scaled so that cutting one costs its weight
        return mean_field(cost, evidence.links, 1.0, NUM_TRACK_LABEL_UPDATES, member), scale

    for _ in range(NUM_TRACK_ROUNDS):
        member, scale = turn(member, geometry)
        size = float(TRACK_FIT_SCALE * scale.median())
        geometry = torch.cat([_refit(part, F, member, size) for part, F in _parts(evidence, geometry)])
    member, scale = turn(member, geometry)
    found_labels = member.argmax(1)
    return Candidates(found_labels, member, geometry, scale, energy(evidence, geometry, found_labels, scale))


def _refit(part: PairStack, F: Tensor, member: Tensor, scale: float) -> Tensor:
    # the noise grows with the motion, and with it the scale
    size = (scale * part.usual.rsqrt()).clamp(min=MIN_TRACK_FIT_SCALE_PIXELS) * part.view.pixel
    weight = part.members(member.flatten(0, 1)) * part.weight[:, None]
    return descend(F.flatten(1, 2), part.view.x1, part.view.x2, weight, size, steps=2).view(F.shape)


def energy(
    evidence: TrackEvidence, geometry: Geometry, labels: Tensor, scale: Tensor, relief_weight: float = RELIEF_WEIGHT
) -> Tensor:
    r"""Cost ``(B,)`` of labellings ``(B, n)`` from 0:"""
    member = one_hot(labels, geometry.shape[2])
    own = (costs(evidence, geometry, scale, member, relief_weight) * member).sum((-2, -1))
    seen = float((evidence.count > 0).sum())
    total = own + 2 * EFFECTIVE_PAIRS * seen * scale.log() + evidence.links.cut_weight(member)
    return torch.where(member.sum(-1).amin(-1) >= MIN_BODY_TRACKS, total, torch.inf)


# ----------------------------------------------------------------------------------------------------------------------
# Bodies made of pieces, improved by exchange: pieces move, and bodies are joined, as long as that lowers the cost.


Body = frozenset[int]
"""The pieces of a body."""
Exchange = tuple[int, int, Body, Body]
"""Two bodies, by their places, and what takes the place of each."""


MAX_EXCHANGES = 12  # exchanges at most
MIN_EXCHANGE_GAIN = 1e-6  # cost that an exchange must save


class Exchanges:
    r"""Local search over the ways to make bodies of pieces."""

    def __init__(self, evidence: TrackEvidence, cut: Tensor) -> None:
        """Of pieces, labels ``(n,)`` from 0."""
        self.evidence, self.cut = evidence, cut
        self.count = int(cut.max()) + 1
        self.members = one_hot(cut, self.count).double()
        self.sizes = [int(size) for size in self.members.sum(-1)]
        geometry = fit_groups(evidence, self.members, FIRST_FIT_SCALES_PIXELS, steps=1)[:, None]
        self.scale = noise(evidence, geometry, self.members[None])
        self.between = self.members @ evidence.links.pull(self.members).mT
        self.known: dict[Body, tuple[float, float]] = {}

    def improve(self, labels: Tensor, weight: float) -> Tensor:
        """Labels ``(n,)`` from 0 after the best exchanges from bodies ``(n,)`` made of the pieces, at a weight of the links."""
        bodies = [
            frozenset(piece for piece in range(self.count) if int(labels[self.cut == piece].median()) == body)
            for body in range(int(labels.max()) + 1)
        ]
        for _ in range(MAX_EXCHANGES):
            offered = [
                one for one in self._possible_exchanges(bodies) if min(self._size(one[2]), self._size(one[3])) >= MIN_BODY_TRACKS
            ]
            self._fit([*bodies, *(body for one in offered for body in one[2:])])
            gain = [self._cost([bodies[one[0]], bodies[one[1]]], weight) - self._cost(one[2:], weight) for one in offered]
            if not gain or max(gain) <= MIN_EXCHANGE_GAIN:
                break
            first, second, one, other = offered[gain.index(max(gain))]
            bodies[first], bodies[second] = one, other
        of_piece = [next(k for k, body in enumerate(bodies) if piece in body) for piece in range(self.count)]
        return torch.tensor(of_piece, device=labels.device)[self.cut]

    def _size(self, body: Body) -> int:
        return sum(self.sizes[piece] for piece in body)

    def _possible_exchanges(self, bodies: Sequence[Body]) -> Iterator[Exchange]:
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
        geometry = fit_groups(self.evidence, groups, FIRST_FIT_SCALES_PIXELS, steps=1)[:, None]
        own = (costs(self.evidence, geometry, self.scale, None)[0] * groups).sum(-1)
        cut = ((chosen @ self.between) * (1 - chosen)).sum(-1) / 2
        self.known.update(zip(new, zip(own.tolist(), cut.tolist(), strict=True), strict=True))
