"""From pieces that move as one to bodies: pieces of the graph of links, joined where one motion explains two of them."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from sklearn.cluster import spectral_clustering
from torch import Tensor

from dyntorch.core.limits import MAX_SQUARED_DISTANCE
from dyntorch.geometry.epipolar import null_vector
from dyntorch.geometry.homogeneous import homogeneous
from dyntorch.numerics.chi_square import median
from dyntorch.tasks.segment.frame_pairs import DOUBLED_VARIANCE_MOTION, Pair, TrackSet
from dyntorch.tasks.segment.search import one_hot
from dyntorch.tasks.segment.track_energy import Candidates

FIRST_PIECE_NOISE_PIXELS = 0.15  # of a coordinate at rest
MIN_PIECE_NOISE_PIXELS = 0.05  # least one that is believed, pixels
COST_SCALE_FACTOR = 1.5  # scale of the costs over the noise of the pieces
OWN_COST_FLOOR = 0.4  # added to the cost of a sighting in its own body
CHANCE_PREFERENCE_SHARE = 0.1  # preferences in common by chance: PREFERRED_SHARE
PIECE_LINK_WEIGHT = 0.5  # beside what a common motion costs
NEGLIGIBLE_LINKS = 0.01  # per track of the smaller of two pieces
MIN_COMMON_MEMBERS = 3  # tracks of a group that a pair of frames must show
NEVER_COMMON_SEPARATION = 1e3  # of groups that no pair of frames shows together: they merge last


def pieces(sparse: Tensor, count: int) -> Tensor:
    """Labels ``(n,)`` from 0 of so many pieces of a graph ``(n, n)``, by normalized cuts."""
    # tracks without links are a piece's worth of trouble: all get a little of everything
    graph = sparse.double() + 1e-6 * float(sparse.max().clamp(min=1e-12))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a graph of several components is welcome
        found = spectral_clustering(
            graph.cpu().numpy(), n_clusters=count, eigen_solver="arpack", assign_labels="cluster_qr", random_state=0
        )
    return torch.from_numpy(found).long().to(sparse.device)


@dataclass(frozen=True)
class Separation:
    """How separate pairs of groups are."""

    first: Tensor
    second: Tensor
    excess: Tensor
    own: Tensor
    links: Tensor
    met: Tensor

    def value(self, weight: float) -> Tensor:
        r"""``(q,)``, large for groups that are surely two bodies: :math:`\log(1 + x / (o + f)) - w \log(l + l_0)`."""
        value = self.ratio() - weight * torch.log(self.links + NEGLIGIBLE_LINKS)
        # groups that never meet are one body only if others join them
        return torch.where(self.met, value, NEVER_COMMON_SEPARATION)

    def ratio(self) -> Tensor:
        r"""``(q,)`` what joining costs beside what the groups cost: :math:`\log(1 + x / (o + f))`."""
        return torch.log1p(self.excess.clamp(min=0) / (self.own.clamp(min=0) + OWN_COST_FLOOR))


class NearPairs:
    """Linear fits of many groups of tracks between many pairs of near frames at a time."""

    def __init__(self, film: TrackSet, pairs: Sequence[Pair]) -> None:
        """Of pairs of frames ``(p, 2)``."""
        first, second = torch.tensor(list(pairs), device=film.x.device).reshape(-1, 2).unbind(-1)
        x1, x2 = film.x[first], film.x[second]
        self.seen = film.seen[first] & film.seen[second]
        moved = (x2 - x1).norm(dim=-1) / film.pixel
        self.precision = self.seen / (1 + moved / DOUBLED_VARIANCE_MOTION) / film.pixel**2
        self.first, self.second = homogeneous(x1), homogeneous(x2)
        rows = (self.second[..., :, None] * self.first[..., None, :]).flatten(-2)
        self.rows = rows  # (p, n, 9)
        self.upper = torch.triu_indices(9, 9, device=film.x.device)
        self.count = self.seen.sum(0).double()

    def squares(self, group: Tensor, scale: float, rounds: int = 2) -> tuple[Tensor, Tensor]:
        """Squared distances in pixels at rest of the tracks of a group ``(n,)`` bool from its motion."""
        index = group.nonzero().flatten()
        live = (self.seen[:, index].sum(-1) >= MIN_COMMON_MEMBERS).nonzero().flatten()
        member = self.seen[live][:, index].double()
        rows = self.rows[live][:, index]
        products = rows[..., self.upper[0]] * rows[..., self.upper[1]]
        first, second = self.first[live][:, index], self.second[live][:, index]
        precision = self.precision[live][:, index]
        weight = square = member
        for remaining in range(rounds, -1, -1):
            F = self._solve_least_squares(weight, products)
            matrix = F.unflatten(-1, (3, 3))
            there, here = first @ matrix[:, :2].mT, second @ matrix[:, :, :2]
            gradient = (there.square().sum(-1) + here.square().sum(-1)).clamp(min=1e-12)
            square = (rows @ F[..., None])[..., 0].square() / gradient * precision
            if remaining:
                weight = member / (gradient * (1 + square / (4 * scale**2)).square())
                weight = weight / weight.amax(-1, keepdim=True).clamp(min=1e-200)
        return square, member > 0

    def _solve_least_squares(self, weight: Tensor, products: Tensor) -> Tensor:
        """Unit vectors ``(q, 9)`` of least squares."""
        sums = (weight[:, None] @ products)[:, 0]
        gram = sums.new_zeros(*sums.shape[:-1], 9, 9)
        gram[..., self.upper[0], self.upper[1]] = sums
        gram[..., self.upper[1], self.upper[0]] = sums
        return null_vector(gram)

    def meetings(self, groups: Tensor) -> tuple[Tensor, Tensor]:
        """Tracks of each group ``(g, n)`` that are seen beside others of each group, and their sightings there, ``(g, g)`` both."""
        member, seen = groups.double(), self.seen.double()
        there = ((seen @ member.mT) >= MIN_COMMON_MEMBERS).double()  # (p, g)
        beside = ((seen.mT @ there) > 0).double()  # (n, g)
        return member @ beside, member @ seen.mT @ there

    def cost(self, group: Tensor, scale: float) -> float:
        """Cost of a group ``(n,)`` bool: the squared distances of all sightings over the noise, each at most the cap."""
        square, seen = self.squares(group, scale)
        return float(((square / scale**2).clamp(max=MAX_SQUARED_DISTANCE) * seen).sum())


@dataclass
class GroupCosts:
    """Costs of groups of tracks under one motion each, every group fitted once."""

    near: NearPairs  # pairs of frames
    alike: Tensor  # ``(n, n)`` how alike tracks move, beyond chance
    scale: float  # of the costs, pixels at rest
    known: dict[bytes, float] = field(default_factory=dict)

    @staticmethod
    def of(near: NearPairs, kernel: Tensor, groups: Tensor) -> GroupCosts:
        """With the noise of groups ``(g, n)`` bool that are surely pure."""
        found = [near.squares(group, FIRST_PIECE_NOISE_PIXELS) for group in groups]
        own = torch.cat([square[seen] for square, seen in found])
        noise = (float(own.median()) / median(1)) ** 0.5 if len(own) else FIRST_PIECE_NOISE_PIXELS
        alike = (kernel - CHANCE_PREFERENCE_SHARE).clamp(min=0)
        return GroupCosts(near, alike, COST_SCALE_FACTOR * max(noise, MIN_PIECE_NOISE_PIXELS))

    def cost(self, groups: Tensor) -> Tensor:
        """``(g,)`` of groups ``(g, n)`` bool."""
        names = [group.cpu().numpy().tobytes() for group in groups]
        for name, group in zip(names, groups, strict=True):
            if name not in self.known:
                self.known[name] = self.near.cost(group, self.scale)
        return torch.tensor([self.known[name] for name in names], dtype=torch.float64, device=groups.device)

    def separation(self, groups: Tensor) -> Separation:
        """Of all pairs of groups ``(g, n)`` bool."""
        first, second = torch.triu_indices(len(groups), len(groups), 1, device=groups.device)
        alone, joint = self.cost(groups), self.cost(groups[first] | groups[second])
        size, seen = self.near.meetings(groups)
        between = (groups.float() @ self.alike @ groups.float().mT).double()
        either, other = (first, second), (second, first)
        return Separation(
            first=first,
            second=second,
            excess=(joint - alone[first] - alone[second]) / torch.minimum(seen[either], seen[other]).clamp(min=1.0),
            own=(alone[first] + alone[second]) / (seen.diagonal()[first] + seen.diagonal()[second]).clamp(min=1.0),
            links=between[first, second] / torch.minimum(size[either], size[other]).clamp(min=1.0),
            met=torch.minimum(seen[either], seen[other]) > 0,
        )


def merge_pieces(judge: GroupCosts, labels: Tensor, counts: Sequence[int]) -> dict[int, Tensor]:
    """Labels ``(n,)`` from 0 with each number of bodies, from pieces ``(n,)`` that are joined one pair after the other."""
    groups = one_hot(labels, int(labels.max()) + 1) > 0
    groups = groups[groups.any(-1)]
    found: dict[int, Tensor] = {}
    while True:
        if len(groups) in counts:
            found[len(groups)] = groups.long().argmax(0)
        if len(groups) <= max(1, min(counts)):
            return found
        pairs = judge.separation(groups)
        weakest = int(pairs.value(PIECE_LINK_WEIGHT).argmin())
        one, other = int(pairs.first[weakest]), int(pairs.second[weakest])
        rest = torch.ones(len(groups), dtype=torch.bool, device=groups.device)
        rest[[one, other]] = False
        groups = torch.cat([groups[rest], (groups[one] | groups[other])[None]])


def weakest_separation(judge: GroupCosts, candidate: Candidates, weight: float) -> float:
    """Of the least separate bodies of one candidate; infinite for a single body."""
    member = one_hot(candidate.labels[0], candidate.bodies) > 0
    if len(member) < 2:
        return float("inf")
    return float(judge.separation(member).value(weight).min())
