"""Which matches of two views move like their neighbours, before any motion is known, and what their segmentations cost."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from dyntorch.geometry.epipolar import sampson_squared
from dyntorch.geometry.homogeneous import homogeneous, null_vectors, skew

TABLE = 1 << 22  # distances held at a time


DENSE = 1000
"""Matches up to which links are a dense matrix: milliseconds per product with 320 columns at 340, 550, 1100 matches 1.0, 2.2, 11;
of a sparse one 1.2, 1.6, 4.8, but with two copies."""


NUM_NEIGHBOURS = 15  # nearest matches, in either image, by which the coherence of a match is judged
NUM_EDGES = 8  # nearest matches, in either image, that a match is linked with
DEVIATION_TOLERANCE = 0.7  # relative to the distance of the neighbour: coherence falls to 1/e
EDGE_TOLERANCE = 0.5  # the same for the weight of a link
RIDGE = 0.25  # weight of the common motion in the fit of a local one, over the moments of the neighbours
MAX_NEIGHBOUR_DISTANCE = 2.5  # over the median one: farther deviations are no longer divided by the distance
NUM_PASSES = 2  # each without the neighbours that the last one distrusts
MIN_NEIGHBOUR_COHERENCE = 0.02  # below it a match is no neighbour in the next pass
MAX_CONFORMITY_MEMBERS = 1500  # members of a body by which the conformity of a match is judged, about
MAX_SIMILARITY_PAIRS = 400  # pairs of neighbours by which common similarities are looked for, about
NUM_MEAN_SHIFT_STARTS = 16  # of these pairs
MAX_IDENTITY_DISTANCE = 0.35  # of the complex factor of zoom and rotation from 1: local motions start from the identity
MIN_FACTOR_SEPARATION = 0.7  # relative distance of a further factor from the first ones
MIN_FURTHER_FACTOR_SHARE = 0.1  # of the pairs; by chance .05 to .08
MIN_FIRST_FACTOR_SHARE = 0.05  # of the pairs; by chance .02 to .04


@dataclass(frozen=True)
class Links:
    """Symmetric weights between neighbouring matches."""

    index: Tensor  # ``(n, d)`` the neighbours of each match
    weight: Tensor  # ``(n, d)`` in [0, 1], 0 where there are fewer than d

    @cached_property
    def _matrices(self) -> dict[torch.dtype, Tensor]:
        """Column i holds the neighbours of i; of many matches, sparse."""
        row, slot = self.weight.nonzero(as_tuple=True)
        place, size = torch.stack([self.index[row, slot], row]), (len(self.index), len(self.index))
        matrix = torch.sparse_coo_tensor(place, self.weight[row, slot], size, check_invariants=False).coalesce()
        if len(self.index) <= DENSE:
            matrix = matrix.to_dense()
        return {dtype: matrix.to(dtype) for dtype in (torch.float32, torch.float64)}

    def pull(self, values: Tensor) -> Tensor:
        """Weighted sums over the neighbours: ``(*, n)`` to ``(*, n)``."""
        return values @ self._matrices[values.dtype]

    def cut_weight(self, members: Tensor) -> Tensor:
        """Sum of the links between different bodies: members ``(*batch, K, n)``, 0 or 1, to ``(*batch,)``."""
        return (self.weight.sum() - (members * self.pull(members)).sum((-2, -1))) / 2

    def subset(self, keep: Tensor) -> Links:
        """The links among some of the matches (indices)."""
        place = torch.full((len(self.index),), -1, device=keep.device)
        place[keep] = torch.arange(len(keep), device=keep.device)
        index = place[self.index[keep]]
        return Links(index.clamp(min=0), torch.where(index >= 0, self.weight[keep], 0.0))

    def components(self, least: float, among: Tensor) -> Tensor:
        """Numbers ``(n,)`` of the connected components of the links above ``least`` among some matches ``(n,)`` bool."""
        row, slot = ((self.weight > least) & among[:, None] & among[self.index]).nonzero(as_tuple=True)
        ends, size = (row.cpu().numpy(), self.index[row, slot].cpu().numpy()), len(self.index)
        graph = coo_array((np.ones(len(row)), ends), shape=(size, size))
        return torch.from_numpy(connected_components(graph, directed=False)[1]).long().to(row.device)


def coherence(x1: Tensor, x2: Tensor, scale: float, among: Tensor | None = None) -> tuple[Tensor, Links]:
    """How well each match moves like its neighbours of both images, ``(n,)`` in [0, 1], by its deviation from their affine motion,
    and links by how well two neighbours move alike. x1 ``(n, 2)``, among ``(n,)``."""
    among = torch.ones_like(x1[:, 0], dtype=torch.bool) if among is None else among
    fresh = _first_of_copies(x1, x2, among, scale / 6)
    values = torch.ones_like(x1[:, 0])
    for _ in range(NUM_PASSES):
        # the first pass finds most wrong matches, which then no longer stand between the neighbours of the others
        trusted = values > MIN_NEIGHBOUR_COHERENCE
        values, linked = _measure_coherence(x1, x2, fresh & trusted, scale)
    return values, _links(*linked, among)


def _measure_coherence(x1: Tensor, x2: Tensor, eligible: Tensor, scale: float) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor]]:
    """Coherence of all matches with their nearest eligible ones ``(n,)``; rows, columns and weights of the links."""
    count = len(x1)
    values = torch.zeros_like(x1[:, 0])
    rows, columns, weights = [], [], []
    for a, b in ((x1, x2), (x2, x1)):
        index, usable = _nearest(a, b, eligible.nonzero().flatten(), scale / 6)
        da, db = a[index] - a[:, None], b[index] - b[:, None]
        reach = _reach(da, usable, eligible)
        each = torch.stack([_deviation(da, db, usable, common, reach, scale) for common in _common_motions(da, db, usable)])
        # a match follows the one of the common motions by which it agrees most with its neighbours
        agreed, best = (torch.exp(-((each / DEVIATION_TOLERANCE) ** 2)) * usable).sum(-1).max(0)
        deviation = each[best, torch.arange(count, device=x1.device)]
        values = values + agreed / usable.sum(-1).clamp(min=1) / 2
        linked = torch.exp(-((deviation[:, :NUM_EDGES] / EDGE_TOLERANCE) ** 2)) * usable[:, :NUM_EDGES]
        rows.append(torch.arange(count, device=x1.device)[:, None].expand_as(linked).flatten())
        columns.append(index[:, :NUM_EDGES].flatten())
        weights.append(linked.flatten())
    return values, (torch.cat(rows), torch.cat(columns), torch.cat(weights))


def conformity(x1: Tensor, x2: Tensor, members: Tensor, scale: float) -> Tensor:
    """How well every match moves like its nearest members of each body. x1 ``(n, 2)``, members ``(K, n)`` -> ``(K, n)``."""
    some = [_thin(body) for body in members]
    fresh = _first_of_copies(x1, x2, torch.stack(some).any(0), scale / 6)
    return torch.stack([_measure_coherence(x1, x2, fresh & body, scale)[0] for body in some])


def _thin(body: Tensor) -> Tensor:
    """About ``MAX_CONFORMITY_MEMBERS`` of the members ``(n,)`` bool, evenly."""
    rank = body.cumsum(-1)
    return body & (rank % max(1, int(rank[-1]) // MAX_CONFORMITY_MEMBERS) == 0)


def _links(row: Tensor, column: Tensor, weight: Tensor, among: Tensor) -> Links:
    """Links of directed ones, symmetric among the matches that can be neighbours ``(n,)``; the others only see them."""
    count, back = len(among), among[row]
    pairs = torch.stack([torch.cat([row, column[back]]), torch.cat([column, row[back]])])
    joined = torch.sparse_coo_tensor(pairs, torch.cat([weight, weight[back]]), (count, count), check_invariants=False).coalesce()
    start, other = joined.indices()
    # four directed links can join two neighbours, two one that is none: their mean over images and directions
    total = joined.values() / torch.where(among[start], 4.0, 2.0)
    degree = torch.bincount(start, minlength=count)
    first = degree.cumsum(0) - degree
    slot = torch.arange(len(start), device=row.device) - first[start]
    width = int(degree.max()) if len(start) else 0
    index = torch.zeros(count, width, dtype=torch.long, device=row.device)
    weights = torch.zeros(count, width, dtype=weight.dtype, device=weight.device)
    index[start, slot], weights[start, slot] = other, total
    return Links(index, weights)


def _blocks(count: int, width: int) -> list[slice]:
    """The rows of a table of distances in slices that fit into memory, whatever their number."""
    step = max(64, TABLE // max(1, width))
    return [slice(start, start + step) for start in range(0, count, step)]


def _first_of_copies(x1: Tensor, x2: Tensor, among: Tensor, least: float) -> Tensor:
    """Which of some matches ``(n,)`` bool repeat no earlier one: repeated matches would confirm themselves."""
    joint = torch.cat([x1, x2], dim=-1)[among]
    index = torch.arange(len(joint), device=joint.device)
    copies = [
        ((torch.cdist(joint[rows], joint) < least) & (index < index[rows, None])).any(-1)
        for rows in _blocks(len(joint), len(joint))
    ]
    fresh = among.clone()
    fresh[among] = ~torch.cat(copies) if copies else fresh[among]
    return fresh


def _nearest(a: Tensor, b: Tensor, among: Tensor, least: float) -> tuple[Tensor, Tensor]:
    """Indices ``(n, k)`` of the matches nearest in a, nearest first, of some of them (indices), and which of these exist."""
    near, joint = a[among], torch.cat([a, b], dim=-1)
    count = min(NUM_NEIGHBOURS, len(among))
    indices, exist = [], []
    for rows in _blocks(len(a), len(among)):
        distance = torch.cdist(a[rows], near).masked_fill_(torch.cdist(joint[rows], joint[among]) < least, torch.inf)
        nearest = distance.topk(count, dim=-1, largest=False)
        indices.append(among[nearest.indices])
        exist.append(nearest.values.isfinite())
    return torch.cat(indices), torch.cat(exist)


def _common_motions(da: Tensor, db: Tensor, usable: Tensor) -> Tensor:
    """The similarities ``(m, 2, 2)`` that many neighbours share, those that differ much, the identity for all near it."""
    size = da.square().sum(-1)
    near = usable & (size > 0)
    pair = near.flatten().nonzero().flatten()
    pair = pair[:: max(1, len(pair) // MAX_SIMILARITY_PAIRS)]
    da, db, size = da.flatten(0, 1)[pair], db.flatten(0, 1)[pair], size.flatten()[pair]
    # zoom and rotation as a complex number, db / da
    turned = da[:, 0] * db[:, 1] - da[:, 1] * db[:, 0]
    factor = torch.stack([(da * db).sum(-1), turned], dim=-1) / size[:, None]
    if not len(factor):
        return torch.eye(2, dtype=da.dtype, device=da.device)[None]
    # the modes, by mean shift from some of them, with a window relative to their size
    mode = factor[:: max(1, len(factor) // NUM_MEAN_SHIFT_STARTS)]
    score = torch.zeros_like(mode[:, 0])
    for _ in range(5):
        window = 0.3 * mode.norm(dim=-1, keepdim=True) + torch.finfo(da.dtype).tiny
        weight = torch.exp(-((torch.cdist(mode, factor) / window) ** 2))
        score = weight.sum(-1)
        mode = weight @ factor / score.clamp(min=torch.finfo(da.dtype).tiny)[:, None]
    order = score.argsort(descending=True, stable=True)
    factors: list[complex] = []
    for (real, imaginary), share in zip(mode[order].tolist(), (score[order] / len(factor)).tolist(), strict=True):
        candidate = complex(real, imaginary)
        candidate = 1.0 if abs(candidate - 1) <= MAX_IDENTITY_DISTANCE else candidate
        if share >= (MIN_FURTHER_FACTOR_SHARE if factors else MIN_FIRST_FACTOR_SHARE) and all(
            abs(candidate - other) > MIN_FACTOR_SEPARATION * abs(other) for other in factors
        ):
            factors.append(candidate)
    return torch.tensor([[[z.real, -z.imag], [z.imag, z.real]] for z in factors or [1.0]], dtype=da.dtype, device=da.device)


def _reach(da: Tensor, usable: Tensor, eligible: Tensor) -> Tensor:
    """d ``()``, from the neighbours of those matches that are neighbours themselves."""
    distance = da.norm(dim=-1)[usable & eligible[:, None]]
    return MAX_NEIGHBOUR_DISTANCE * distance.median() if len(distance) else da.new_tensor(torch.inf)


def _deviation(da: Tensor, db: Tensor, usable: Tensor, common: Tensor, reach: Tensor, scale: float) -> Tensor:
    """r ``(n, k)`` after one weighted fit of the local motions."""
    size = da.norm(dim=-1).minimum(reach) * torch.linalg.det(common).abs().sqrt() + scale
    error = db - da @ common.mT
    weight = torch.exp(-((error.norm(dim=-1) / size / DEVIATION_TOLERANCE) ** 2)) * usable
    moment = (da * weight[..., None]).mT @ da
    ridge = RIDGE * moment.diagonal(dim1=-2, dim2=-1).sum(-1) + 4 * scale * scale
    moment = moment + ridge[:, None, None] * torch.eye(2, dtype=da.dtype, device=da.device)
    local = torch.linalg.inv_ex(moment)[0] @ (da * weight[..., None]).mT @ error
    return (error - da @ local).norm(dim=-1) / size


# ----------------------------------------------------------------------------------------------------------------------
# What a segmentation of two views costs: distances from the epipolar geometries, links cut, and the relief of each body.


THRESHOLD_PIXELS = 2.5  # threshold in pixels to which all figures in pixels refer
SAMPSON_NOISE_PIXELS = 0.7  # standard deviation of a Sampson distance
ENERGY_MAX_SQUARED_DISTANCE = 4.0  # over the variance of the noise
CUT_COST = 4.0  # of a link of weight 1 between two bodies
PARALLAX_WEIGHT = 0.2  # of motion along the epipolar lines beside that of the body's mean plane
PARALLAX_FREEDOM = 2.0  # degrees of freedom of Student's distribution of the parallax
MIN_PARALLAX_PIXELS = 2.0  # least scale of the parallax
NUM_PLANE_FITS = 6  # reweighted fits of the mean plane of a body
NUM_PARALLAX_SCALE_UPDATES = 2  # in each of them


@dataclass(frozen=True)
class View:
    """The matches of one problem, centred and scaled alike in both views."""

    x1: Tensor  # ``(n, 2)``
    x2: Tensor
    pixel: float  # the threshold / ``THRESHOLD_PIXELS``, in these coordinates: a pixel at the default threshold
    links: Links  # between matches

    def subset(self, keep: Tensor) -> View:
        """Some of the matches (indices)."""
        return View(self.x1[keep], self.x2[keep], self.pixel, self.links.subset(keep))


def energy(view: View, fundamentals: Tensor, member: Tensor) -> Tensor:
    r"""Cost of labellings with their fundamental matrices: fundamentals ``(B, K, 3, 3)``, member ``(B, K, n)`` -> ``(B,)``."""
    square = sampson_squared(fundamentals, view.x1, view.x2) / (SAMPSON_NOISE_PIXELS * view.pixel) ** 2
    distances = (square.clamp(max=ENERGY_MAX_SQUARED_DISTANCE) * member).sum((-2, -1))
    cost = relief_cost(view, fundamentals, member)
    return distances + CUT_COST * view.links.cut_weight(member) + PARALLAX_WEIGHT * (cost * member).sum((-2, -1))


def relief_cost(view: View, fundamentals: Tensor, member: Tensor, min_scale: float = MIN_PARALLAX_PIXELS) -> Tensor:
    r"""Cost ``(B, K, n)`` of the parallax of every match beside every body:
    :math:`(\nu + 1) \log(1 + p^2 / \nu t^2) + \log t^2`."""
    value, scale = parallax(view, fundamentals, member, min_scale)
    return (PARALLAX_FREEDOM + 1) * torch.log1p(value.square() / (PARALLAX_FREEDOM * scale[..., None])) + scale.log()[..., None]


def parallax(view: View, fundamentals: Tensor, member: Tensor, min_scale: float = MIN_PARALLAX_PIXELS) -> tuple[Tensor, Tensor]:
    r"""Distances along the epipolar lines from the robust mean plane of each body, and their squared scale, in pixels.
    fundamentals ``(B, K, 3, 3)``, member ``(B, K, n)`` -> ``(B, K, n)``; of several pairs of views ``(p, ...)`` each."""
    shape, pairs, count = member.shape, view.x1.numel() // max(1, 2 * view.x1.shape[-2]), view.x1.shape[-2]
    # of every pair of views a few products of matrices, whatever the number of bodies: (p, G, ...)
    member, F = member.reshape(pairs, -1, count), fundamentals.reshape(pairs, -1, 3, 3)
    first, (x, y) = homogeneous(view.x1).view(pairs, count, 3), view.x2.view(pairs, 1, count, 2).unbind(-1)
    epipole = null_vectors(F)[0]
    a, b, c = ((skew(epipole) @ F).flatten(-3, -2) @ first.mT).unflatten(-2, (-1, 3)).unbind(-2)
    d, e, f = epipole[..., None].unbind(-2)
    across = y * f - e, d - x * f, x * e - y * d
    depth = (y * c - b) * across[0] + (a - x * c) * across[1] + (x * b - y * a) * across[2]
    depth = -depth / (across[0].square() + across[1].square() + across[2].square()).clamp(min=1e-20)
    # how far the image moves with depth
    lever = torch.hypot(d * c - a * f, e * c - b * f) / (c + depth * f).square().clamp(min=1e-12) / view.pixel
    lever = lever.clamp(max=1e6)
    moments = (first[..., :, None] * first[..., None, :]).flatten(-2)
    total = member.sum(-1) + 1e-9
    eye = torch.eye(3, dtype=first.dtype, device=first.device)
    weight, scale, value = member, torch.zeros_like(total), depth
    for turn in range(NUM_PLANE_FITS):
        heavy = weight * lever.square()
        inner = (heavy @ moments).unflatten(-1, (3, 3))
        ridge = 1e-9 * inner.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] + 1e-20
        plane = torch.linalg.solve_ex(inner + ridge * eye, (heavy * depth) @ first)[0]
        value = (depth - plane @ first.mT) * lever
        square = value.square()
        if turn == 0:
            scale = ((member * value.abs()).sum(-1) / total).square()
        for _ in range(NUM_PARALLAX_SCALE_UPDATES):
            share = (PARALLAX_FREEDOM + 1) / (PARALLAX_FREEDOM + square / scale.clamp(min=min_scale * min_scale)[..., None])
            scale = ((member * share * square).sum(-1) / total).clamp(min=min_scale * min_scale)
        weight = member * (PARALLAX_FREEDOM + 1) / (PARALLAX_FREEDOM + square / scale[..., None])
    return value.view(shape), scale.view(shape[:-1])


# ----------------------------------------------------------------------------------------------------------------------
# Probabilities of labels that neighbours share: the mean field of costs and links.


def mean_field(cost: Tensor, links: Links, cut: float, turns: int, start: Tensor | None = None) -> Tensor:
    """Probabilities of labels ``(*batch, K, n)`` that cost so much, with ``cut`` times the links between different labels."""
    member = torch.softmax(-cost, -2) if start is None else start
    for _ in range(turns):
        member = 0.5 * (member + torch.softmax(cut * links.pull(member) - cost, -2))
    return member
