"""The search of robust estimation: which weightings to start from, when to stop, and whether what was found beats chance."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyntorch.blocks import Result, map_blocks, workers
from dyntorch.chi_square import quantile
from dyntorch.hypotheses import Bundle, anneal, bundle, concentrate, median, msac
from dyntorch.invariant import Invariant
from dyntorch.matches import Matches
from dyntorch.normalize import Normalization, normalization, relative
from dyntorch.sampling import Draws
from dyntorch.solution import copied

SMALL = 8
"""Largest minimal sample for which samples of that size are drawn; other starts take 2.5 times the minimal number."""
DRAWN, KEPT = 32, 4
"""Minimal samples per start, and starts per sample that is annealed: the best samples are near already."""
ANNEALED = {"all": 30, "many": 20, "guided": 60, "minimal": 10}
"""Reweightings of a start: from all matches; from 2.5 times the minimal number, without and with a motion as guide; from a minimal
sample."""
FREE = 4
"""One start of so many is not guided by a motion.  Successes per start, not guided and guided: homography tensor (100 matches, 50 %
outliers) 0.48 and 0.70, translating lines (175, 30 %) 0.01 and 0.20, constant velocity tensor (150, 35 %) 0.53 and 0.52, but in
one scene of eight 0.9 and 0."""

BLOCK = 1 << 20
"""Numbers in one block of the batch (8 MB)."""
SEARCHED = 1000
"""Matches among which is searched, at least 10 for every column; of more, a random part (all are used for the final fit)."""
NEAR = 5.0
"""Matches farther from the median than so many median distances have no say in the normalization."""
MIXED = 4
"""Random sets of matches, made by mixing up the views, on which the chance of an inlier is measured."""
DOUBT = 0.15
"""Matches between one and three thresholds away, per inlier, above which the search goes on: a wrong model has many (constant
velocity tensors, 20 % outliers: wrong 0.7 and more, right 0.03 at most; right homography tensors reach 0.15 at 60 %)."""
MANY, AGREEING, SAME = 16, 0.25, 0.01
"""So many starts decide when to stop where there is doubt: when this share of them end at the best score so far, up to this
relative difference.  Whatever attracts one start in five, and is better, is then missed once in thirty times."""


@dataclass(frozen=True)
class Found:
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


class Search:
    """The search for the tensors of a batch, among at most so many matches that memory stays bounded."""

    def __init__(self, invariant: Invariant, data: Matches, generator: torch.Generator | None) -> None:
        self.invariant, self.data = invariant, data
        self.draws = Draws(len(data.weights), generator, data.weights.device)
        self.everyone = torch.arange(len(data.weights), device=data.weights.device)
        views, weights, _ = copied(invariant, replace(data, weights=data.weights * _near(invariant, data)))
        self.norm: Normalization = normalization(invariant, views, weights)
        # the search measures in this unit, so that no limit of it depends on that of the matches
        self.unit = relative([t.flatten(1)[:, 0] for t in self.norm.transforms])[1]
        self.some = some = self._some()
        moved = self.norm.apply(invariant, copied(invariant, some)[0])
        self.views = moved if invariant.copies else tuple(x[:, None] for x in moved)
        self.weights = some.weights / some.weights.amax(-1, keepdim=True).clamp(min=1e-300)

    def run(self, cut: Tensor, starts: Sequence[int]) -> Found:
        """Best tensors: more and more starts for the problems that need them.

        Args:
            cut: ``(b,)`` threshold.
            starts: numbers of starts, one after the other.
        """
        cut = cut * self.unit
        found = self._solve(self.everyone, cut, starts[0])
        settled = torch.zeros_like(found.doubt)
        enough = (self.weights > 0).sum(-1) >= self.invariant.minimal()
        for count in starts[1:]:
            left = (found.doubt & enough & ~settled).nonzero()[:, 0]
            if not len(left):
                break
            new = self._solve(left, cut, count)
            better = (new.score < found.score[left]).nonzero()[:, 0]
            for old, part in zip(vars(found).values(), vars(new).values(), strict=True):
                old[left[better]] = part[better]
            # more starts would find it again
            settled[left] = (new.agreeing >= AGREEING) & (new.score <= _same(found.score[left]))
        return found

    def scale(self) -> Tensor:
        """Threshold ``(b,)`` from the data: least median of squares (annealed), and what 99 % of the inliers then keep."""
        inv, everyone = self.invariant, self.everyone
        chosen = torch.cat([self.weights[:, None], self._samples(everyone, 16)], dim=1)

        def block(chosen: Tensor, *rest: Tensor) -> Tensor:
            work = self._bundle(rest)
            basis = _best(work, work.first(chosen), lambda square: median(square, work.weights), 17)
            # guided and soft: hard halves alone are 40 to 70 times off for lines (175, 20 % outliers), this 0.6 to 1.6 times
            basis = concentrate(work, anneal(work, basis, None, 20, guided=True), None, 5)
            return median(work.distances(basis)[0], work.weights).amin(1)

        middle = self._map(block, everyone, chosen)
        # Rousseeuw and Leroy 1987: the median of so few is too small
        few = 1 + 5 / ((self.weights > 0).sum(-1) - inv.minimal()).clamp(min=1)
        return threshold_of(inv, middle.sqrt() * few / quantile(0.5, inv.codim) ** 0.5) / self.unit

    def evidence(self, tensor: Tensor, cut: Tensor) -> Tensor:
        """Evidence ``(b,)``, see :class:`Found`, of normalized tensors as a solution holds them, with another threshold."""
        inv = self.invariant
        tensors = inv.basis_of(tensor)

        def block(basis: Tensor, cut: Tensor, *rest: Tensor) -> Tensor:
            work = self._bundle(rest)
            square = work.distances(basis[:, :, None])[0][:, 0]
            return judge(work, basis[:, :, None], square, cut.square())[0]

        return self._map(block, self.everyone, tensors if inv.copies else tensors[:, None], cut * self.unit)

    def _solve(self, where: Tensor, cut: Tensor, count: int) -> Found:
        chosen = self.weights[where, None] if count == 1 else self._samples(where, count)
        kind = "all" if count == 1 else "many" if chosen.shape[1] == count else "minimal"
        keep, steps = max(1, count // KEPT) if kind == "minimal" else count, ANNEALED[kind]

        def block(chosen: Tensor, cut: Tensor, *rest: Tensor) -> tuple[Tensor, ...]:
            work, limit = self._bundle(rest), cut.square()

            def score(square: Tensor) -> Tensor:
                return msac(square, work.weights, limit)

            basis = _best(work, work.first(chosen), score, keep)
            free, led = basis[:, :, : -(-keep // FREE)], basis[:, :, -(-keep // FREE) :]
            if kind == "many":
                led = anneal(work, led, limit, ANNEALED["guided"], guided=True)
                basis = torch.cat([anneal(work, free, limit, steps), led], dim=2)
            else:
                basis = anneal(work, basis, limit, steps)
            lost = score(work.distances(basis)[0])
            agreeing = (lost <= _same(lost.amin(-1, keepdim=True))).double().mean(-1) * (lost.shape[-1] >= MANY)
            basis = concentrate(work, _chosen(basis, lost.argmin(-1, keepdim=True)), limit, 5)
            square = work.distances(basis)[0]
            evidence, doubt = judge(work, basis, square[:, 0], limit)
            return basis[:, :, 0], score(square)[:, 0], evidence, doubt, square[:, 0] <= limit[:, None], agreeing

        return Found(*self._map(block, where, chosen, cut[where]))

    def _samples(self, where: Tensor, count: int) -> Tensor:
        """Starts ``(problems, K, n)``: 1 for so many random matches with weight."""
        minimal = self.invariant.minimal()
        size, count = (minimal, count * DRAWN) if minimal <= SMALL else (-(-5 * minimal // 2), count)
        present = self.weights[where, None] > 0
        drawn = self.draws(where, count, self.weights.shape[-1]).masked_fill(~present, 2.0)
        last = drawn.kthvalue(min(size, drawn.shape[-1]), dim=-1, keepdim=True).values
        return ((drawn <= last) & present).to(torch.float64)

    def _some(self) -> Matches:
        """The matches to search among."""
        data, limit = self.data, max(SEARCHED, 10 * self.invariant.width())
        if data.count <= limit:
            return data
        order = (self.draws(self.everyone, data.count) * (data.weights > 0)).topk(limit).indices
        rows = torch.arange(len(order), device=order.device)[:, None]
        return replace(data, views=tuple(x[rows, order] for x in data.views), weights=data.weights[rows, order])

    def _map(self, function: Callable[..., Result], where: Tensor, starts: Tensor, *more: Tensor) -> Result:
        inv, n = self.invariant, self.weights.shape[-1]
        packed = math.prod(p.width * (p.width + 1) // 2 for p in inv.primitives)
        per_start = 2 * inv.width() ** 2 + n * inv.nullity * sum(p.width for p in inv.primitives)
        per_problem = (inv.copies or 1) * (n * packed + starts.shape[1] * per_start)
        size = min(BLOCK // per_problem, -(-len(where) // workers()))
        rest = (self.weights, *self.views, *self.norm.transforms)
        return map_blocks(function, starts, *more, *(x[where] for x in rest), size=max(1, size))

    def _bundle(self, rest: tuple[Tensor, ...]) -> Bundle:
        count = len(self.invariant.primitives)
        weights, views, transforms = rest[0], rest[1 : 1 + count], rest[1 + count :]
        primitives = tuple(p.normalized(t) for p, t in zip(self.invariant.primitives, transforms, strict=True))
        return bundle(
            self.invariant.normalized(tuple(t[:, None] for t in transforms)),
            primitives,
            views,
            relative([t.flatten(1)[:, 0] for t in transforms])[0],
            weights,
        )


def judge(work: Bundle, basis: Tensor, square: Tensor, limit: Tensor) -> tuple[Tensor, Tensor]:
    r"""Evidence and doubt ``(b,)`` of one tensor per problem.

    Among n random matches, each an inlier with chance p, the expected number of tensors through m matches with k inliers is

    .. math:: (n - m) \binom{n}{k} \binom{k}{m} p^{k - m} ,

    with p measured on matches whose views were mixed up.

    Source: Moisan and Stival 2004 (a contrario detection).
    """
    present = work.weights > 0
    n, k = present.sum(-1).to(square), ((square <= limit[:, None]) & present).sum(-1).to(square)
    m = torch.full_like(n, float(work.invariant.minimal()))
    hits, trials = torch.zeros_like(n), torch.zeros_like(n)
    for mixed in _mixed(work):
        real = mixed.weights > 0
        hits = hits + ((mixed.distances(basis)[0][:, 0] <= limit[:, None]) & real).sum(-1)
        trials = trials + real.sum(-1)
    chance = (hits + 1) / (trials + 1)
    evidence = (n - m).clamp(min=1).log() + _choose(n, k) + _choose(k, m) + (k - m) * chance.log()
    near = ((square > limit[:, None]) & (square <= 9 * limit[:, None]) & present).sum(-1)
    return torch.where(k > m, evidence, torch.inf), (k <= m) | (evidence >= 0) | (near > DOUBT * k)


def _mixed(work: Bundle) -> list[Bundle]:
    """Random matches: view v shifted against the first one by v steps of several sizes."""
    n, count = work.weights.shape[-1], len(work.views)
    steps = sorted({max(1, (2 * j + 1) * n // (2 * MIXED * count)) for j in range(MIXED)})
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


def _best(work: Bundle, basis: Tensor, score: Callable[[Tensor], Tensor], count: int) -> Tensor:
    """The ``count`` starts with the least score."""
    if basis.shape[2] <= count:
        return basis
    return _chosen(basis, score(work.distances(basis)[0]).topk(count, largest=False).indices)


def _chosen(basis: Tensor, order: Tensor) -> Tensor:
    """The starts ``(b, count)`` of ``(b, c, K, a, D)``."""
    return basis.gather(2, order[:, None, :, None, None].expand(*basis.shape[:2], order.shape[-1], *basis.shape[3:]))


def _same(score: Tensor) -> Tensor:
    """The score up to which two finds are the same one: the weight of a hundredth of a match is no difference."""
    return score * (1 + SAME) + SAME


def _near(invariant: Invariant, data: Matches) -> Tensor:
    """Matches ``(b, n)`` without gross outliers, which would make the others small."""
    keep = data.weights > 0
    for primitive, x in zip(invariant.primitives, data.views, strict=True):
        points = primitive.points(x, data.weights).flatten(2).masked_fill((data.weights <= 0)[..., None], torch.nan)
        far = (points - points.nanmedian(1, keepdim=True).values).norm(dim=-1)
        middle = far.nanmedian(-1, keepdim=True).values
        keep = keep & ((far <= NEAR * middle) | ~(middle > 0))
    return keep


def threshold_of(invariant: Invariant, sigma: Tensor) -> Tensor:
    """The distance that 99 % of the inliers keep, with noise of standard deviation ``sigma``."""
    return (sigma * quantile(0.99, invariant.codim) ** 0.5).clamp(min=torch.finfo(sigma.dtype).tiny ** 0.25)
