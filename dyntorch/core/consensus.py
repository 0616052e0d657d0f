"""The search for a tensor that most matches agree with: many weightings of the same matches, and whether a find beats chance."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dyntorch.core.invariant import Constraint, Invariant
from dyntorch.core.kernel_fit import searched_kinds
from dyntorch.core.limits import quantile
from dyntorch.core.matches import Matches
from dyntorch.core.matrix import unpack
from dyntorch.core.normalize import Normalization, normalization, relative
from dyntorch.core.primitives import HyperplanesThrough, Point, Primitive, triangle
from dyntorch.core.residual import SINGULAR, whiten
from dyntorch.core.solution import with_copies
from dyntorch.native import library
from dyntorch.numerics.blocks import Draws, Record, each, map_blocks, replace_problems, workers
from dyntorch.numerics.eigenspaces import orthonormal
from dyntorch.numerics.nullspace import gram_null_space

# ----------------------------------------------------------------------------------------------------------------------
# Many weightings of the same matches: tensors, distances and annealed reweighting for a whole bundle of starts at once.


SHIFT_EPSILON = 1e-14  # of the trace: keeps the factor of an exactly singular Gram finite
HUGE_SQUARE = 1e30  # squared distance in place of one that is no number
MAX_SEARCHED = 1000
"""Matches among which is searched, at least 10 for every column; of more, a random part (all are used for the final fit)."""
GROSS_OUTLIER = 5.0
"""Distance from the median of the matches, over the median distance, beyond which one has no say in the normalization."""
MAX_MINIMAL_SAMPLE = 8
"""Largest minimal sample for which samples of that size are drawn; other starts take 2.5 times the minimal number."""
SAMPLES_PER_START = 32
"""Minimal samples drawn per start."""
MISSED = 1e-3
"""Share of the searches that may have drawn no minimal sample of inliers alone: what they found may then be a worse tensor."""
STARTS_PER_ANNEALED_SAMPLE = 4
NUM_SCALE_STARTS = 16
"""Random starts of the estimate of the threshold, beside that from all matches."""
REWEIGHTINGS = {"all": 30, "many": 20, "minimal": 10}
"""Of the start from all matches, from 2.5 times the minimal number, and from a minimal sample."""
GUIDED_REWEIGHTINGS = 60
"""Of a start from many matches, with a motion as guide."""
STARTS_PER_UNGUIDED = 4
"""One start of so many is not guided.  Successes per start, not guided and guided: homography tensor (100 matches, 50 % outliers)
0.48 and 0.70, translating lines (175, 30 %) 0.01 and 0.20, constant velocity tensor (150, 35 %) 0.53 and 0.52."""
SHRINKING_SHARE = 0.7
"""Share of the reweightings during which the scale shrinks."""
NUM_CONCENTRATIONS = 5
"""Refits to the matches within the threshold, or to the nearer half, at the end."""
SCALE_REWEIGHTINGS = 20
"""In the estimate of the threshold, with a motion as guide: hard halves alone are 40 to 70 times off for lines."""
NUM_INVERSE_ITERATIONS = 2
"""Per reweighting: the weights change more than what is left of the null vector's error."""
NUM_SHUFFLES = 4
"""Random sets of matches, made by mixing up the views, on which the chance of an inlier is measured."""
MAX_NEAR_MISSES = 0.15
"""Matches between one and three thresholds away, per inlier, above which the search goes on: a wrong model has many (constant
velocity tensors, 20 % outliers: wrong 0.7 and more, right 0.03 at most; right homography tensors reach 0.15 at 60 %)."""
MIN_STARTS_TO_COMPARE = 16
"""Starts from which on their agreement decides when to stop."""
MIN_AGREEING_STARTS = 0.25
"""Share of such starts that must end at the least score so far: what attracts one start in five is missed once in thirty times."""
SAME_SCORE = 0.01
"""Relative difference, and weight of matches, up to which two scores are the same."""


@dataclass(frozen=True)
class Bundle:
    """Matches of a block of problems in normalized coordinates, with everything that does not depend on their weights."""

    invariant: Invariant
    """In these coordinates, for tensors ``(b, K, ..)``."""
    primitives: tuple[Primitive, ...]
    views: tuple[Tensor, ...]
    """``(b, 1, n, ...)``."""
    scales: tuple[Tensor, ...]
    """``(b,)`` size, in these coordinates, of one unit of the search."""
    weights: Tensor
    """``(b, n)``."""
    moments: Tensor
    """``(b, c, n, m)`` packed outer squares of the rows of each match."""
    vectors: tuple[Tensor, ...]
    """``(b, c, width, rows, n)`` per view, of the length that the derivatives of the primitives suppose."""

    def first(self, weights: Tensor) -> Tensor:
        """Null spaces ``(b, c, K, a, D)`` of the weightings ``(b, K, n)`` of rows of unit length."""
        gram = self._gram(weights[:, None] / self.lengths()[:, :, None])
        return gram_null_space(gram, self.invariant.nullity).basis

    def lengths(self) -> Tensor:
        """Squared lengths ``(b, c, n)`` of the rows."""
        norms = torch.ones_like(self.weights[:, None])
        for primitive, u in zip(self.primitives, self.vectors, strict=True):
            norms = norms * u[..., 0, :].square().sum(-2) if primitive.rows == 1 else norms
        return norms.clamp(min=1e-300)

    def constrain_to_motions(self, basis: Tensor) -> Tensor:
        """The tensors of the motions that tensors ``(b, c, K, a, D)`` decompose into; where no motion guides, the tensors."""
        if self.invariant.starts is not None:
            return basis
        inv, own = self.invariant, basis.transpose(1, 2)
        composed = inv.compose(*inv.motion_of(inv.tensor_of(own if inv.copies else own[:, :, 0])))
        composed = inv.basis_of(composed).reshape(own.shape).transpose(1, 2)
        sound = composed.isfinite().all(-1, keepdim=True) & (composed.abs().amax(-1, keepdim=True) > 0)
        return torch.where(sound.all(-2, keepdim=True).all(1, keepdim=True), composed, basis)

    def next(self, weights: Tensor, basis: Tensor) -> Tensor:
        """The same for weightings ``(b, c, K, n)`` of unscaled rows, by inverse iteration from the null spaces before."""
        gram = self._gram(weights)
        diagonal = gram.diagonal(dim1=-2, dim2=-1)
        diagonal += diagonal.sum(-1, keepdim=True) * SHIFT_EPSILON + 1e-300
        factor, _ = torch.linalg.cholesky_ex(gram)
        columns = basis.mT
        for _ in range(NUM_INVERSE_ITERATIONS):
            columns = orthonormal(torch.cholesky_solve(columns, factor))
        iterate = columns.mT
        return torch.where(iterate.isfinite().all(-1, keepdim=True).all(-2, keepdim=True), iterate, basis)

    def _gram(self, weights: Tensor) -> Tensor:
        # all starts in one product: the matches are read once, however many weightings there are
        return unpack(weights @ self.moments, tuple(p.width for p in self.primitives))

    def distances(self, basis: Tensor) -> tuple[Tensor, Tensor]:
        r"""Squared Sampson distances ``(b, K, n)`` in the unit of the measurements, and row weights ``(b, c, K, n)``."""
        slot = transfer_slot(self.primitives)
        square, rows = self._form(basis) if slot is None else self._transfer(basis, slot)
        return square.nan_to_num(nan=HUGE_SQUARE, posinf=HUGE_SQUARE).clamp(max=HUGE_SQUARE), rows.nan_to_num(nan=0.0, posinf=0.0)

    def _form(self, basis: Tensor) -> tuple[Tensor, Tensor]:
        """Values of the multilinear form on all rows of a match over the length of their gradients."""
        widths = [p.width for p in self.primitives]
        cube = basis.unflatten(-1, widths)
        square = torch.zeros((), dtype=basis.dtype, device=basis.device)
        value = torch.zeros((), dtype=basis.dtype, device=basis.device)
        for v, scale in enumerate(self.scales):
            others = _products([u for w, u in enumerate(self.vectors) if w != v])
            flat = cube.movedim(4 + v, 4).flatten(2, 4).flatten(3) @ others.flatten(3)
            gradient = flat.unflatten(2, (*basis.shape[2:4], widths[v])).unflatten(-1, others.shape[3:]).movedim(-2, 4)
            if v == 0:
                for u in self.vectors[v][:, :, None, None, None].unbind(-2):
                    value = value + (gradient * u).sum(-2).square().sum((3, 4))
            square = square + scale.square()[:, None, None, None] * self._slopes(v, gradient).square().sum((3, 4, 5))
        return (value / (square + SINGULAR)).mean(1) * self.invariant.codim, 1 / (square + SINGULAR)

    def _transfer(self, basis: Tensor, slot: int) -> tuple[Tensor, Tensor]:
        """Rows that say where the point of one view lies: how far it is from where the others predict it."""
        widths = [p.width for p in self.primitives]
        d = widths[slot] - 1
        cube = basis[:, :, :, 0].unflatten(-1, widths).movedim(3 + slot, 3)
        rest = [v for v in range(len(widths)) if v != slot]
        lead = cube.shape[:2]
        image = cube.reshape(*lead, cube.shape[2] * (d + 1), -1) @ _products([self.vectors[v] for v in rest])[..., 0, :]
        image = image.unflatten(2, (-1, d + 1))
        depth, floor = image[..., d, :], 1e-12 * image.abs().amax(-2)
        depth = torch.where(depth.abs() > floor, depth, floor.clamp(min=1e-300))
        place = image[..., :d, :] / depth[..., None, :]
        eye = torch.eye(d, dtype=basis.dtype, device=basis.device)
        covariance = self.scales[slot].square()[:, None, None, None, None, None] * eye
        for i, v in enumerate(rest):
            others = _products([self.vectors[w] for w in rest if w != v] or [torch.ones_like(self.vectors[v][:, :, :1])])[..., 0, :]
            rows = cube.movedim(4 + i, 4).reshape(*lead, cube.shape[2] * (d + 1) * widths[v], -1)
            moved = self._slopes(v, (rows @ others).unflatten(2, (-1, d + 1, widths[v])))
            jacobian = (moved[:, :, :, :d] - place[..., None, :] * moved[:, :, :, d:]) / depth[..., None, None, :]
            jacobian = (self.scales[v][:, None, None, None, None, None] * jacobian).movedim(-1, 3)
            covariance = covariance + (jacobian[..., :, None, :] * jacobian[..., None, :, :]).sum(-1)
        error = place.mT - self.views[slot][:, :, None]
        size = covariance.diagonal(dim1=-2, dim2=-1).sum(-1) / d * depth.square()
        return whiten(error, covariance).square().sum(-1)[:, 0], 1 / (size + SINGULAR)

    def _slopes(self, view: int, gradient: Tensor) -> Tensor:
        """Derivatives by the measured coordinates ``(b, c, .., d, n)`` from those by the vectors ``(b, c, .., width, n)``."""
        primitive = self.primitives[view]
        if isinstance(primitive, HyperplanesThrough):
            return primitive.slopes(gradient)
        if isinstance(primitive, Point):
            return gradient[..., :-1, :]
        x = self.views[view]
        columns = gradient.mT
        item = x.shape[3:]
        # one long axis of matches, because the primitive knows only one
        spread = x[(slice(None), slice(None), *[None] * (gradient.ndim - 4))].expand(*x.shape[:2], *columns.shape[2:-1], *item)
        flat = primitive.pullback(spread.reshape(*x.shape[:2], -1, *item), columns.flatten(2, -2))
        return flat.unflatten(2, columns.shape[2:-1]).mT


def bundle(
    invariant: Invariant, primitives: tuple[Primitive, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...], weights: Tensor
) -> Bundle:
    """Prepare matches ``(b, 1, n, ...)`` in normalized coordinates, with weights ``(b, n)``."""
    packed, vectors = [], []
    for primitive, x in zip(primitives, views, strict=True):
        rows, columns = triangle(primitive.width, x.device)
        if primitive.rows > 1:
            vectors.append(primitive.vectors(x).permute(0, 1, 4, 3, 2).contiguous())
            packed.append(primitive.pack(x).mT)
        else:
            # not the components of the estimation matrix, which may be scaled: distances need the length that is measured
            vectors.append(primitive.raw(x).mT.contiguous()[..., None, :])
            packed.append((vectors[-1][..., rows, 0, :] * vectors[-1][..., columns, 0, :]).mT)
    moments = packed[0]
    for factor in packed[1:]:
        moments = (moments[..., :, None] * factor[..., None, :]).flatten(-2)
    return Bundle(invariant, primitives, views, scales, weights, moments, tuple(vectors))


def transfer_slot(primitives: Sequence[Primitive]) -> int | None:
    """The only view measured through all hyperplanes of its points, which the other views then predict."""
    slots = [v for v, p in enumerate(primitives) if isinstance(p, HyperplanesThrough) and p.order == 1]
    return slots[0] if len(slots) == 1 and all(p.rows == 1 for v, p in enumerate(primitives) if v not in slots) else None


def anneal(data: Bundle, basis: Tensor, end: Tensor | None, iterations: int, *, guided: bool = False) -> Tensor:
    r"""Graduated non-convexity: weights :math:`(a / (a + d^2))^2` (Geman-McClure) with a scale a that shrinks to ``end``. basis
    ``(b, c, K, a, D)``, end ``(b,)``."""
    start: Tensor | None = None
    shrinking = SHRINKING_SHARE * iterations
    for i in range(iterations):
        square, rows = data.distances(data.constrain_to_motions(basis) if guided and i < shrinking else basis)
        if guided and 2 * i < iterations:
            # the gradients of a wrong tensor mislead: half their say doubles the successes of lines (175, 30 % outliers)
            rows = (rows / data.lengths()[:, :, None]).sqrt()
        if end is None:
            scale = median(square, data.weights)[:, None, :, None].clamp(min=torch.finfo(square.dtype).tiny)
        else:
            stop = end[:, None, None, None]
            start = torch.maximum(4 * median(square, data.weights)[:, None, :, None], stop) if start is None else start
            scale = start * (stop / start) ** min(1.0, i / shrinking)
        weights = (scale / (scale + square[:, None])).square() * data.weights[:, None, None] * rows
        basis = data.next(weights, basis)
    return basis


def concentrate(data: Bundle, basis: Tensor, cut: Tensor | None, iterations: int) -> Tensor:
    """Refit to the matches with a squared distance up to ``cut (b,)``, or (None) to the nearer half of them."""
    for _ in range(iterations):
        square, rows = data.distances(basis)
        limit = median(square, data.weights)[:, :, None] if cut is None else cut[:, None, None]
        basis = data.next((square <= limit)[:, None] * data.weights[:, None, None] * rows, basis)
    return basis


def msac(square: Tensor, weights: Tensor, cut: Tensor) -> Tensor:
    """Truncated squares in units of the cut, ``(b, K)``: the matches' weight lost, less is better."""
    return ((square / cut[:, None, None]).clamp(max=1.0) * weights[:, None]).sum(-1)


def median(square: Tensor, weights: Tensor) -> Tensor:
    """Median ``(b, K)`` over the matches with weight."""
    order = square.masked_fill(weights[:, None] <= 0, torch.inf).sort(-1).values
    middle = ((weights > 0).sum(-1) // 2).clamp(max=order.shape[-1] - 1)
    return order.gather(-1, middle[:, None, None].expand(*order.shape[:2], 1))[..., 0].clamp(max=HUGE_SQUARE)


def _products(vectors: list[Tensor]) -> Tensor:
    """Kronecker products of the vectors of each match, and of their rows: ``(b, c, w1 w2 .., r1 r2 .., n)``."""
    total = vectors[0]
    for u in vectors[1:]:
        total = (total[..., :, None, :, None, :] * u[..., None, :, None, :, :]).flatten(-5, -4).flatten(-3, -2)
    return total


# ----------------------------------------------------------------------------------------------------------------------
# The search of robust estimation: which weightings to start from, when to stop, and whether what was found beats chance.


STARTS_BLOCK = 1 << 20
"""Numbers in one block of the batch (8 MB)."""


class SearchResult(NamedTuple):
    """The best tensor of each problem."""

    basis: Tensor
    """``(b, c, a, D)``, axes of the tensor in the order of the views."""
    score: Tensor
    """``(b,)`` weight of the matches lost; less is better."""
    evidence: Tensor
    """``(b,)`` log of the expected number of such finds among random matches; negative: not by chance."""
    doubt: Tensor
    """``(b,)`` bool: to be searched on."""
    inliers: Tensor
    """``(b, searched)`` bool: by the tensor itself, before its motion is known."""
    agreeing: Tensor
    """``(b,)`` share of the starts that ended there, of so many that it says something, else 0."""

    def replace_worse(self, new: SearchResult, at: Tensor) -> SearchResult:
        """With the new ones of some problems, where they lose less."""
        wins = new.score < self.score[at]
        return replace_problems(self, at[wins], each(lambda x: x[wins], new))


class SearchMatches(NamedTuple):
    """Matches among which is searched."""

    weights: Tensor
    """``(b, n)``, 1 at most."""
    views: tuple[Tensor, ...]
    """``(b, 1, n, ...)`` in normalized coordinates."""
    transforms: tuple[Tensor, ...]
    """That led there."""


class Search:
    """The search for the tensors of a batch, among at most so many matches that memory stays bounded."""

    def __init__(self, invariant: Invariant, data: Matches, generator: torch.Generator | None) -> None:
        self.invariant, self.data = invariant, data
        self.draws = Draws(len(data.weights), generator, data.weights.device)
        self.everyone = torch.arange(len(data.weights), device=data.weights.device)
        near = data.weights * _without_gross_outliers(invariant, data)
        views, weights, _ = with_copies(invariant, data.views, near, None)
        self.norm: Normalization = normalization(invariant, views, weights)
        # the search measures in this unit, so that no limit of it depends on that of the matches
        self.unit = relative([t.flatten(1)[:, 0] for t in self.norm.transforms])[1]
        self.some = some = self._some()
        moved = self.norm.apply(invariant, with_copies(invariant, some.views, some.weights, None)[0])
        self.weights = some.weights / some.weights.amax(-1, keepdim=True).clamp(min=1e-300)
        views = moved if invariant.copies else tuple(x[:, None] for x in moved)
        self.searched = SearchMatches(self.weights, views, self.norm.transforms)
        self.kinds = searched_kinds(invariant, data.views, data.weights)
        # the kernel knows the motions that guide a search of this invariant alone
        self.guided = bool(self.kinds) and invariant.constraint is Constraint.HOMOGRAPHIES

    def run(self, cut: Tensor, starts: Sequence[int]) -> SearchResult:
        """Best tensors: more and more starts for the problems that need them.

        Args:
            cut: ``(b,)`` threshold.
            starts: numbers of starts, one after the other.
        """
        cut = cut * self.unit
        result = self._solve(self.everyone, cut, starts[0])
        settled = torch.zeros_like(result.doubt)
        enough, tried = (self.weights > 0).sum(-1) >= self.invariant.minimal(), 0
        for count in starts[1:]:
            left = ((result.doubt | (self._samples_needed(result) > tried)) & enough & ~settled).nonzero()[:, 0]
            tried += count * SAMPLES_PER_START
            if not len(left):
                break
            new = self._solve(left, cut, count)
            result = result.replace_worse(new, left)
            # more starts would find it again
            settled[left] = (new.agreeing >= MIN_AGREEING_STARTS) & (new.score <= self._equal_score(result.score[left]))
        return result

    def _samples_needed(self, result: SearchResult) -> Tensor:
        """Minimal samples ``(b,)`` of which one is inliers alone, but for :data:`MISSED` of all searches; 0 of larger samples."""
        minimal, present = self.invariant.minimal(), (self.weights > 0).sum(-1).clamp(min=1)
        if minimal > MAX_MINIMAL_SAMPLE:
            return torch.zeros_like(result.score)
        share = (result.inliers & (self.weights > 0)).sum(-1) / present
        return math.log(MISSED) / torch.log1p(-share.double().pow(minimal).clamp(1e-12, 1 - 1e-12))

    def scale(self) -> Tensor:
        """Threshold ``(b,)`` from the data: least median of squares (annealed), and what 99 % of the inliers then keep."""
        inv, everyone, count = self.invariant, self.everyone, NUM_SCALE_STARTS

        def block(searched: SearchMatches, chosen: Tensor) -> Tensor:
            work = self._bundle(searched)
            basis = _select_starts(work, work.first(chosen), lambda square: median(square, work.weights), count + 1)
            basis = concentrate(work, anneal(work, basis, None, SCALE_REWEIGHTINGS, guided=True), None, NUM_CONCENTRATIONS)
            return median(work.distances(basis)[0], work.weights).amin(1)

        if self.guided:
            numbers = {"starts": count, "keep": count + 1, "iterations": SCALE_REWEIGHTINGS, "mode": library.LEAST_MEDIAN}
            middle = self._by_kernel(everyone, torch.zeros_like(self.unit), self.draws.seeds + count + 1, None, **numbers).score
        else:
            middle = self._map(block, everyone, torch.cat([self.weights[:, None], self._samples(everyone, count)], dim=1))
        # Rousseeuw and Leroy 1987: the median of so few is too small
        few = 1 + 5 / ((self.weights > 0).sum(-1) - inv.minimal()).clamp(min=1)
        return threshold_of(inv, middle.sqrt() * few / quantile(0.5, inv.codim) ** 0.5) / self.unit

    def evidence(self, tensor: Tensor, cut: Tensor) -> Tensor:
        """Evidence ``(b,)``, see :class:`SearchResult`, of normalized tensors as a solution holds them, with another threshold."""
        inv = self.invariant
        tensors = inv.basis_of(tensor)
        if self.kinds:
            return self._by_kernel(self.everyone, cut * self.unit, given=tensors[:, 0]).evidence

        def block(searched: SearchMatches, basis: Tensor, cut: Tensor) -> Tensor:
            work = self._bundle(searched)
            square = work.distances(basis[:, :, None])[0][:, 0]
            return evidence_and_doubt(work, basis[:, :, None], square, cut.square())[0]

        return self._map(block, self.everyone, tensors if inv.copies else tensors[:, None], cut * self.unit)

    def _solve(self, where: Tensor, cut: Tensor, count: int) -> SearchResult:
        minimal = self.invariant.minimal()
        if self.kinds and count == 1:
            return self._by_kernel(where, cut[where], iterations=REWEIGHTINGS["all"])
        if self.kinds and minimal <= MAX_MINIMAL_SAMPLE:
            # every rung of the ladder has samples of its own
            seeds, keep = self.draws.seeds[where] + count, max(1, count // STARTS_PER_ANNEALED_SAMPLE)
            sampled = {"starts": count * SAMPLES_PER_START, "keep": keep}
            numbers = {**sampled, "iterations": REWEIGHTINGS["minimal"], "mode": library.FROM_SAMPLES}
            return self._by_kernel(where, cut[where], seeds, None, **numbers)
        if self.guided:
            numbers = {"starts": count, "keep": count, "iterations": REWEIGHTINGS["many"], "mode": library.FROM_SUBSETS}
            return self._by_kernel(where, cut[where], self.draws.seeds[where] + count, None, **numbers)
        chosen = self.weights[where, None] if count == 1 else self._samples(where, count)
        kind = "all" if count == 1 else "many" if chosen.shape[1] == count else "minimal"
        steps = REWEIGHTINGS[kind]
        keep = max(1, count // STARTS_PER_ANNEALED_SAMPLE) if kind == "minimal" else count

        def block(searched: SearchMatches, chosen: Tensor, cut: Tensor) -> SearchResult:
            work, limit = self._bundle(searched), cut.square()

            def score(square: Tensor) -> Tensor:
                return msac(square, work.weights, limit)

            basis = _select_starts(work, work.first(chosen), score, keep)
            unguided = -(-keep // STARTS_PER_UNGUIDED)
            free, led = basis[:, :, :unguided], basis[:, :, unguided:]
            if kind == "many":
                led = anneal(work, led, limit, GUIDED_REWEIGHTINGS, guided=True)
                basis = torch.cat([anneal(work, free, limit, steps), led], dim=2)
            else:
                basis = anneal(work, basis, limit, steps)
            lost = score(work.distances(basis)[0])
            agreeing = (lost <= self._equal_score(lost.amin(-1, keepdim=True))).double().mean(-1)
            agreeing = agreeing * (lost.shape[-1] >= MIN_STARTS_TO_COMPARE)
            basis = concentrate(work, _gather_starts(basis, lost.argmin(-1, keepdim=True)), limit, NUM_CONCENTRATIONS)
            square = work.distances(basis)[0]
            evidence, doubt = evidence_and_doubt(work, basis, square[:, 0], limit)
            return SearchResult(basis[:, :, 0], score(square)[:, 0], evidence, doubt, square[:, 0] <= limit[:, None], agreeing)

        return self._map(block, where, chosen, cut[where])

    def _equal_score(self, score: Tensor) -> Tensor:
        """The score up to which two finds are the same one: the weight of a hundredth of a match is no difference."""
        return score * (1 + SAME_SCORE) + SAME_SCORE

    def _samples(self, where: Tensor, count: int) -> Tensor:
        """Starts ``(problems, K, n)``: 1 for so many random matches with weight."""
        minimal = self.invariant.minimal()
        size, count = (minimal, count * SAMPLES_PER_START) if minimal <= MAX_MINIMAL_SAMPLE else (-(-5 * minimal // 2), count)
        present = self.weights[where, None] > 0
        drawn = self.draws(where, count, self.weights.shape[-1]).masked_fill(~present, 2.0)
        last = drawn.kthvalue(min(size, drawn.shape[-1]), dim=-1, keepdim=True).values
        return ((drawn <= last) & present).to(torch.float64)

    def _some(self) -> Matches:
        """The matches to search among."""
        data, limit = self.data, max(MAX_SEARCHED, 10 * self.invariant.width())
        if data.count <= limit:
            return data
        order = (self.draws(self.everyone, data.count) * (data.weights > 0)).topk(limit).indices
        rows = torch.arange(len(order), device=order.device)[:, None]
        return replace(data, views=tuple(x[rows, order] for x in data.views), weights=data.weights[rows, order])

    def _map(self, function: Callable[..., Record], where: Tensor, starts: Tensor, *more: Tensor) -> Record:
        inv, n = self.invariant, self.weights.shape[-1]
        packed = math.prod(p.width * (p.width + 1) // 2 for p in inv.primitives)
        per_start = 2 * inv.width() ** 2 + n * inv.nullity * sum(p.width for p in inv.primitives)
        per_problem = (inv.copies or 1) * (n * packed + starts.shape[1] * per_start)
        size = min(STARTS_BLOCK // per_problem, -(-len(where) // workers()))
        return map_blocks(function, each(lambda x: x[where], self.searched), starts, *more, size=max(1, size))

    def _by_kernel(
        self, where: Tensor, cut: Tensor, seeds: Tensor | None = None, given: Tensor | None = None, **numbers: Any
    ) -> SearchResult:
        """The search, or the judgement of given tensors ``(b, D)``, by the kernel in C."""
        minimal = self.invariant.minimal()
        counts = MIN_STARTS_TO_COMPARE, SAME_SCORE, GUIDED_REWEIGHTINGS, STARTS_PER_UNGUIDED
        rules = (SHRINKING_SHARE, NUM_CONCENTRATIONS, NUM_SHUFFLES, MAX_NEAR_MISSES, *counts)

        def block(searched: SearchMatches, limit: Tensor, seeds: Tensor | None, given: Tensor | None) -> SearchResult:
            views = tuple(x[:, 0] for x in searched.views)
            scales = torch.stack(relative([t[:, 0, 0] for t in searched.transforms])[0], dim=-1)
            options: dict[str, Any] = {**numbers, "minimal": minimal, "rules": rules, "seeds": seeds, "given": given}
            found = library.search(self.kinds, views, searched.weights, scales, limit, **options)
            numbers_of = (found.score, found.evidence, found.doubt, found.inliers, found.agreeing)
            return SearchResult(found.basis[:, None, None], *numbers_of)

        searched = self.searched if where is self.everyone else each(lambda x: x[where], self.searched)
        return map_blocks(block, searched, cut.square(), seeds, given, size=max(1, -(-len(where) // workers())))

    def _bundle(self, searched: SearchMatches) -> Bundle:
        transforms = searched.transforms
        primitives = tuple(p.normalize(t) for p, t in zip(self.invariant.primitives, transforms, strict=True))
        base = self.invariant.normalize(tuple(t[:, None] for t in transforms))
        scales = relative([t.flatten(1)[:, 0] for t in transforms])[0]
        return bundle(base, primitives, searched.views, scales, searched.weights)


def evidence_and_doubt(work: Bundle, basis: Tensor, square: Tensor, limit: Tensor) -> tuple[Tensor, Tensor]:
    r"""Evidence and doubt ``(b,)`` of one tensor per problem."""
    present = work.weights > 0
    n, k = present.sum(-1).to(square), ((square <= limit[:, None]) & present).sum(-1).to(square)
    m = torch.full_like(n, float(work.invariant.minimal()))
    hits, trials = torch.zeros_like(n), torch.zeros_like(n)
    for mixed in _shuffle_views(work):
        real = mixed.weights > 0
        hits = hits + ((mixed.distances(basis)[0][:, 0] <= limit[:, None]) & real).sum(-1)
        trials = trials + real.sum(-1)
    chance = (hits + 1) / (trials + 1)
    evidence = (n - m).clamp(min=1).log() + _choose(n, k) + _choose(k, m) + (k - m) * chance.log()
    near = ((square > limit[:, None]) & (square <= 9 * limit[:, None]) & present).sum(-1)
    return torch.where(k > m, evidence, torch.inf), (k <= m) | (evidence >= 0) | (near > MAX_NEAR_MISSES * k)


def _shuffle_views(work: Bundle) -> list[Bundle]:
    """Random matches: view v shifted against the first one by v steps of several sizes."""
    n, count = work.weights.shape[-1], len(work.views)
    steps = sorted({max(1, (2 * j + 1) * n // (2 * NUM_SHUFFLES * count)) for j in range(NUM_SHUFFLES)})
    mixed = []
    for step in steps:
        weights = work.weights
        for v in range(1, count):
            weights = weights * work.weights.roll(v * step, -1)
        views = tuple(x.roll(v * step, 2) for v, x in enumerate(work.views))
        vectors = tuple(u.roll(v * step, -1) for v, u in enumerate(work.vectors))
        mixed.append(replace(work, views=views, vectors=vectors, weights=weights))
    return mixed


def _choose(n: Tensor, k: Tensor) -> Tensor:
    k = torch.minimum(k, n)
    return torch.lgamma(n + 1) - torch.lgamma(k + 1) - torch.lgamma(n - k + 1)


def _select_starts(work: Bundle, basis: Tensor, score: Callable[[Tensor], Tensor], count: int) -> Tensor:
    """The ``count`` starts with the least score."""
    if basis.shape[2] <= count:
        return basis
    return _gather_starts(basis, score(work.distances(basis)[0]).topk(count, largest=False).indices)


def _gather_starts(basis: Tensor, order: Tensor) -> Tensor:
    """The starts ``(b, count)`` of ``(b, c, K, a, D)``."""
    return basis.gather(2, order[:, None, :, None, None].expand(*basis.shape[:2], order.shape[-1], *basis.shape[3:]))


def _without_gross_outliers(invariant: Invariant, data: Matches) -> Tensor:
    """Matches ``(b, n)`` without gross outliers, which would make the others small."""
    keep = data.weights > 0
    for primitive, x in zip(invariant.primitives, data.views, strict=True):
        points = primitive.points(x, data.weights).flatten(2).masked_fill((data.weights <= 0)[..., None], torch.nan)
        far = (points - points.nanmedian(1, keepdim=True).values).norm(dim=-1)
        middle = far.nanmedian(-1, keepdim=True).values
        keep = keep & ((far <= GROSS_OUTLIER * middle) | ~(middle > 0))
    return keep


def threshold_of(invariant: Invariant, sigma: Tensor) -> Tensor:
    """The distance that 99 % of the inliers keep, with noise of standard deviation ``sigma``."""
    return (sigma * quantile(0.99, invariant.codim) ** 0.5).clamp(min=torch.finfo(sigma.dtype).tiny ** 0.25)
