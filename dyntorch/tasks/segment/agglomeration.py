r"""Which tracks move alike, and the pieces of them that are merged to bodies.

Tracks move alike that prefer the same hypotheses about the motion between two frames, in many pairs of frames.

Hypotheses are affine maps, homographies and fundamental matrices of a few tracks near each other.  Each track ranks them by its
distance; the share of the first ranks that two tracks have in common says how alike they move, whatever the noise.  Affine maps
and homographies tell cars on one road apart that share an epipolar geometry, fundamental matrices hold together what has depth.
The graph of what moves alike is cut into pieces, and pieces are merged where one motion explains two of them.

Source: Chin, Wang and Suter, The ordered residual kernel for robust motion subspace clustering, 2009; Xu, Cheong and Li, Motion
segmentation by exploiting complementary geometric models, 2018 (several models, many pairs of frames).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from sklearn.cluster import spectral_clustering
from torch import Tensor

from dyntorch.core.limits import MAX_SQUARED_DISTANCE, median
from dyntorch.geometry.epipolar import gram_of_products, null_vector
from dyntorch.geometry.homogeneous import cofactors, homogeneous
from dyntorch.numerics.blocks import uniform
from dyntorch.tasks.segment.coherence import Links
from dyntorch.tasks.segment.frame_pairs import FramePair, Pair, PairStack, TrackSet, select_near_pairs
from dyntorch.tasks.segment.search import one_hot

TINY = 1e-12


KERNEL_GAPS = (1, 2, 4, 8)  # frames between those of a pair
KERNEL_PAIRS_PER_GAP = 20  # in a video as long as its tracks; longer ones have more
MIN_KERNEL_TRACKS = 16  # that both frames of such a pair must show
PREFERRED_SHARE = 0.1  # of the hypotheses, that fit a track best
MIN_SAMPLE_RADIUS = 0.05  # about its first track in which a hypothesis finds the others, over the extent of all
MAX_SAMPLE_RADIUS = 0.7  # the largest one


def preference_kernel(film: TrackSet, searched: Tensor, generator: torch.Generator | None, num_hypotheses: int) -> Tensor:
    r"""How alike tracks move: the mean share of preferred hypotheses that they have in common, searched ``(m,)`` -> ``(n, m)``."""
    count = film.x.shape[1]
    place = torch.full((count,), -1, device=searched.device)
    place[searched] = torch.arange(len(searched), device=searched.device)
    kernel = torch.zeros(count, len(searched), dtype=torch.float32, device=searched.device)
    seen = []
    for pair in select_near_pairs(film, KERNEL_GAPS, KERNEL_PAIRS_PER_GAP, MIN_KERNEL_TRACKS):
        both = film.pair(pair)
        column = place[both.index]
        searched_rows = (column >= 0).nonzero().flatten()
        if len(searched_rows) < MIN_KERNEL_TRACKS:
            continue
        liked = _rank_hypotheses(both, searched_rows, generator, num_hypotheses)
        shared = torch.zeros(len(liked), len(searched), dtype=torch.float32, device=searched.device)
        shared[:, column[searched_rows]] = liked @ liked[searched_rows].mT
        kernel.index_add_(0, both.index, shared)
        seen.append((film.seen[pair[0]] & film.seen[pair[1]]).float())
    if seen:
        met = torch.stack(seen)
        kernel = kernel / (met.mT @ met[:, searched]).clamp(min=1)
    kernel[searched, torch.arange(len(searched), device=searched.device)] = 0.0
    return kernel


def _rank_hypotheses(both: FramePair, own: Tensor, generator: torch.Generator | None, number: int) -> Tensor:
    """``(m, 3 h)`` 1 for what a track prefers, else 0, over the root of the number of preferences."""
    x1, x2 = both.view.x1, both.view.x2
    # three of eight tracks give an affine map, four a homography, all of them a fundamental matrix
    sample = own[_samples(x1[own], generator, number)]
    a, b = x1[sample], x2[sample]
    squares = [
        _transfer(affine_map(a[:, :3], b[:, :3]), x1, x2),
        _transfer(homography_of_four(a[:, :4], b[:, :4]), x1, x2),
        _epipolar(fundamental_of_eight(a, b), x1, x2),
    ]
    few = max(1, round(PREFERRED_SHARE * len(sample)))
    return torch.cat([_mark_smallest(square, few) for square in squares], dim=-1) / (3 * few) ** 0.5


def _mark_smallest(square: Tensor, few: int) -> Tensor:
    """``(m, h)`` 1 for the least so many of the numbers ``(h, m)`` of every track, else 0; exactly so many, also of equal ones."""
    rows = square.mT.contiguous()
    # microseconds for 200 x 350 numbers: 130, by topk 780
    last = torch.from_numpy(np.partition(rows.numpy(), few - 1, axis=-1)[:, few - 1 : few])
    least = rows <= last
    equal = (least.sum(-1) > few).nonzero().flatten()
    liked = least.float()
    liked[equal] = torch.zeros_like(rows[equal]).scatter_(-1, rows[equal].topk(few, dim=-1, largest=False).indices, 1.0)
    return liked


def _samples(x: Tensor, generator: torch.Generator | None, number: int) -> Tensor:
    """``(h, 8)`` different points ``(m, 2)``: one at random, the others by a normal distribution about it, of some width."""
    count = len(x)
    low, high = x.quantile(x.new_tensor([0.02, 0.98]), dim=0)
    extent = (high - low).norm() / 2**0.5
    seed = (uniform(number, generator=generator, device=x.device) * count).long().clamp(max=count - 1)
    radius = (
        MIN_SAMPLE_RADIUS
        * (MAX_SAMPLE_RADIUS / MIN_SAMPLE_RADIUS) ** uniform(number, 1, generator=generator, device=x.device)
        * extent
    )
    # Gumbel's trick: the largest of log p + noise are a sample without replacement
    noise = -(-uniform(number, count, generator=generator, device=x.device).clamp(min=1e-300).log()).log()
    chance = noise - torch.cdist(x[seed], x).square() / (2 * radius.square()).clamp(min=TINY)
    chance.scatter_(1, seed[:, None], torch.inf)
    return chance.topk(8, dim=-1).indices


def affine_map(x1: Tensor, x2: Tensor) -> Tensor:
    """Affine maps ``(*batch, 3, 3)`` that take three points ``(*batch, 3, 2)`` to three others; huge where these are on a line."""
    here, there = homogeneous(x1).mT, homogeneous(x2).mT
    adjoint = cofactors(here).mT
    determinant = (here[..., 0, :] * adjoint[..., :, 0]).sum(-1)
    return there @ adjoint / torch.where(determinant.abs() < TINY, TINY, determinant)[..., None, None]


def homography_of_four(x1: Tensor, x2: Tensor) -> Tensor:
    """Homographies ``(*batch, 3, 3)`` of norm 1 that take four points ``(*batch, 4, 2)`` to four others."""

    def basis(x: Tensor) -> Tensor:
        points = homogeneous(x).mT
        weights = cofactors(points[..., :3]).mT @ points[..., 3:]
        return points[..., :3] * weights.mT

    homographies = basis(x2) @ cofactors(basis(x1)).mT
    return homographies / homographies.flatten(-2).norm(dim=-1).clamp(min=1e-300)[..., None, None]


def fundamental_of_eight(x1: Tensor, x2: Tensor) -> Tensor:
    """Matrices ``(*batch, 3, 3)`` of norm 1 with :math:`x_2^T F x_1 = 0` for eight matches ``(*batch, 8, 2)``, of any rank."""
    rows = (homogeneous(x2)[..., :, None] * homogeneous(x1)[..., None, :]).flatten(-2)
    found, info = torch.linalg.solve_ex(rows[..., :8], -rows[..., 8:])
    found = torch.cat([torch.where((info == 0)[..., None], found[..., 0], 0.0), torch.ones_like(rows[..., 0, :1])], dim=-1)
    return (found / found.norm(dim=-1, keepdim=True)).unflatten(-1, (3, 3))


def _transfer(H: Tensor, x1: Tensor, x2: Tensor) -> Tensor:
    """Squared distances ``(h, m)`` in the second frame."""
    mapped = (H @ homogeneous(x1).mT).float()
    finite = mapped[:, 2].abs() > 1e-9
    depth = torch.where(finite, mapped[:, 2], 1.0)
    x, y = x2.float().mT
    square = (mapped[:, 0] / depth - x).square() + (mapped[:, 1] / depth - y).square()
    return torch.where(finite, square, 1e30).nan_to_num(nan=1e30, posinf=1e30)


def _epipolar(F: Tensor, x1: Tensor, x2: Tensor) -> Tensor:
    """Squared Sampson distances ``(h, m)``, in single precision: they are only ranked."""
    first, second = homogeneous(x1).mT, homogeneous(x2).mT
    lines, others = (F @ first).float(), (F.mT[:, :2] @ second).float()
    value = (lines * second.float()).sum(-2)
    return value.square() / (lines[:, :2].square().sum(-2) + others.square().sum(-2)).clamp(min=1e-30)


def keep_strongest(kernel: Tensor, neighbours: int) -> Tensor:
    """A symmetric kernel ``(m, m)`` with the largest entries of every row or column alone."""
    count = min(neighbours, len(kernel) - 1)
    least = kernel.topk(count, dim=-1).values[:, -1:]
    sparse = torch.where((kernel >= least) & (kernel > 0), kernel, 0.0)
    return torch.maximum(sparse, sparse.mT)


def links_of(sparse: Tensor, total: float) -> Links:
    r"""Links of weight :math:`t\, W_{ij} / \sqrt{d_i d_j}` with the degrees d: about ``total`` for each track."""
    degree = sparse.sum(-1).clamp(min=1e-9)
    weight = sparse / (degree[:, None] * degree).sqrt() * total
    width = max(1, int((weight > 0).sum(-1).max()))
    top = weight.topk(width, dim=-1)
    return Links(top.indices, top.values.double())


# ----------------------------------------------------------------------------------------------------------------------
# From pieces that move as one to bodies: pieces of the graph of links, joined where one motion explains two of them.


FIRST_PIECE_NOISE_PIXELS = 0.15  # of a coordinate at rest
MIN_PIECE_NOISE_PIXELS = 0.05  # least one that is believed, pixels
COST_SCALE_FACTOR = 1.5  # scale of the costs over the noise of the pieces
OWN_COST_FLOOR = 0.4  # added to the cost of a sighting in its own body
CHANCE_PREFERENCE_SHARE = 0.1  # preferences in common by chance: PREFERRED_SHARE
PIECE_LINK_WEIGHT = 0.5  # beside what a common motion costs
NEGLIGIBLE_LINKS = 0.01  # per track of the smaller of two pieces
NUM_GROUP_REWEIGHTS = 2  # of the tracks of a group in the fit of its motion
MIN_COMMON_MEMBERS = 3  # tracks of a group that a pair of frames must show
GROUP_BLOCK = 1 << 17  # groups times sightings fitted at once: 1 MB each of what comes between
NEVER_COMMON_SEPARATION = 1e3  # of groups that no pair of frames shows together: they merge last


def cut_into_pieces(sparse: Tensor, count: int) -> Tensor:
    """Labels ``(n,)`` from 0 of so many pieces of a graph ``(n, n)``, by normalized cuts."""
    # tracks without links are a piece's worth of trouble: all get a little of everything
    graph = sparse.double() + 1e-6 * float(sparse.max().clamp(min=1e-12))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a graph of several components is welcome
        labels = spectral_clustering(
            graph.cpu().numpy(), n_clusters=count, eigen_solver="arpack", assign_labels="cluster_qr", random_state=0
        )
    return torch.from_numpy(labels).long().to(sparse.device)


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
        self.stack = PairStack.of([film.pair(pair) for pair in pairs])
        first, second = torch.tensor(list(pairs), device=film.x.device).reshape(-1, 2).unbind(-1)
        self.seen = film.seen[first] & film.seen[second]
        self.products = self.stack.monomials.products().contiguous()  # (p, m, 36)
        self.precision = self.stack.precision[:, None] / film.pixel**2
        self.count = self.seen.sum(0).double()

    def squared_distances(self, groups: Tensor, scale: float) -> tuple[Tensor, Tensor]:
        """Squared distances in pixels at rest ``(p, g, m)`` of the tracks of each pair from the motions of groups ``(g, n)`` bool,
        and which are members."""
        member = self.stack.members(groups)
        member = member * (member.sum(-1, keepdim=True) >= MIN_COMMON_MEMBERS)
        weight = member
        for remaining in range(NUM_GROUP_REWEIGHTS, -1, -1):
            F = null_vector(gram_of_products(weight @ self.products))
            value, gradient = self.stack.monomials.flat_terms(F)
            square = value.square_().div_(gradient.clamp_(min=1e-12)).mul_(self.precision)
            if remaining:
                weight = member / (square / (4 * scale**2)).add_(1).square_().mul_(gradient)
                weight = weight / weight.amax(-1, keepdim=True).clamp(min=1e-200)
        return square, member > 0

    def count_meetings(self, groups: Tensor) -> tuple[Tensor, Tensor]:
        """Tracks of each group ``(g, n)`` that are seen beside others of each group, and their sightings there, ``(g, g)`` both."""
        member, seen = groups.double(), self.seen.double()
        there = ((seen @ member.mT) >= MIN_COMMON_MEMBERS).double()  # (p, g)
        beside = ((seen.mT @ there) > 0).double()  # (n, g)
        return member @ beside, member @ seen.mT @ there


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
        distances, there = near.squared_distances(groups, FIRST_PIECE_NOISE_PIXELS)
        squares = distances[there]
        noise = (float(squares.median()) / median(1)) ** 0.5 if len(squares) else FIRST_PIECE_NOISE_PIXELS
        alike = (kernel - CHANCE_PREFERENCE_SHARE).clamp(min=0)
        return GroupCosts(near, alike, COST_SCALE_FACTOR * max(noise, MIN_PIECE_NOISE_PIXELS))

    def cost(self, groups: Tensor) -> Tensor:
        """``(g,)`` of groups ``(g, n)`` bool."""
        names = [group.cpu().numpy().tobytes() for group in groups]
        new = {name: place for place, name in enumerate(names) if name not in self.known}
        size = max(1, GROUP_BLOCK // max(1, self.near.stack.index.numel()))
        for places in torch.tensor(list(new.values()), dtype=torch.long, device=groups.device).split(size):
            square, there = self.near.squared_distances(groups[places], self.scale)
            costs = ((square / self.scale**2).clamp(max=MAX_SQUARED_DISTANCE) * there).sum((0, -1))
            self.known.update(zip([names[place] for place in places.tolist()], costs.tolist(), strict=True))
        return torch.tensor([self.known[name] for name in names], dtype=torch.float64, device=groups.device)

    def separation(self, groups: Tensor) -> Separation:
        """Of all pairs of groups ``(g, n)`` bool."""
        first, second = torch.triu_indices(len(groups), len(groups), 1, device=groups.device)
        alone, joint = self.cost(groups), self.cost(groups[first] | groups[second])
        size, seen = self.near.count_meetings(groups)
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
    labels_by_count: dict[int, Tensor] = {}
    while True:
        if len(groups) in counts:
            labels_by_count[len(groups)] = groups.long().argmax(0)
        if len(groups) <= max(1, min(counts)):
            return labels_by_count
        pairs = judge.separation(groups)
        weakest = int(pairs.value(PIECE_LINK_WEIGHT).argmin())
        first, second = int(pairs.first[weakest]), int(pairs.second[weakest])
        remaining = torch.ones(len(groups), dtype=torch.bool, device=groups.device)
        remaining[[first, second]] = False
        groups = torch.cat([groups[remaining], (groups[first] | groups[second])[None]])
