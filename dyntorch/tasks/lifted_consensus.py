"""Tracks of which many are wrong: projections on whose points the most agree, by concentration from many starts."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from dyntorch.algebra.triangulation import triangulate
from dyntorch.bundle_adjustment import bundle_adjust
from dyntorch.constrained import constrain_matches
from dyntorch.fitting import fit_matches
from dyntorch.invariants.grassmann_tensor import GrassmannTensor
from dyntorch.matches import Matches
from dyntorch.sampling import uniform
from dyntorch.solution import NOISY
from dyntorch.tasks.lifted_agreement import FAR, bound, distance, freedom, noise, settled_noise
from dyntorch.tasks.lifted_projections import Tracks, choices

SHARES = (0.5, 0.6, 0.7, 0.8)
"""Parts of the points that the starts keep: the smaller the fewer outliers, the larger the better the fit to them."""
DRAWN = 0.5
"""Of that part, what a start is drawn of."""
LEAST, DRAWN_LEAST = 1.3, 1.15
"""Times the minimal number, at least."""
CONCENTRATED = 3
"""Fits per start, each to the points nearest to the one before."""
ROUNDS = 12
"""Of starts, at most."""
FREE = 10
"""Steps of bundle adjustment per fit: what makes the distances tell the outliers (without it half of them stay)."""
DOUBT = 0.15
"""Points one to three thresholds away, per inlier, above which the search goes on: a wrong model has many."""
MAJORITY = 0.4
"""Inliers among the points, at least: more than half of them found 60 to 70 % outliers right in 3 of 28 scenes, wrong in 2."""
REDUNDANT = 1.25
"""Conditions of the inliers over the degrees of freedom of the projections, at least."""
CONFIRMED, BETTER, SURE = 3, 0.97, 4.0
"""Rounds without a better find after which the search ends where a find does not speak for itself: where the noise is not known,
or the points give fewer conditions than so many times the degrees of freedom.  Few points agree with wrong projections, too."""
TRIED, HOPELESS = 4, 0.3
"""Rounds after which a search ends whose best find leaves so much noise, over the extent of the images: no start came near.
Random and shuffled tracks leave 0.45 to 0.7 then (120 points in 6 views, 6 models), scenes with 40 and 50 % wrong tracks that end
well 0.17 at most."""


@dataclass(frozen=True)
class Consensus:
    """The best projections of every problem, and how far the points are from them."""

    chosen: Tensor
    """``(b, size)`` views of the tensor."""
    projections: Tensor
    """``(b, size, l + 1, K)``."""
    square: Tensor
    """``(b, n)`` squared distance, :data:`FAR` where a point is not seen in these views."""
    lost: Tensor
    """``(b,)`` what the problems are judged by, less is better."""

    def better(self, new: Consensus, where: Tensor) -> None:
        """Take the new ones of some problems, where they are better."""
        wins = new.lost < self.lost[where]
        for field in fields(self):
            getattr(self, field.name)[where[wins]] = getattr(new, field.name)[wins]


def consensus(
    tracks: Tracks, invariant: GrassmannTensor, sigma: Tensor | None, generator: torch.Generator | None
) -> tuple[Consensus, Tensor, Tensor]:
    r"""Projections of the tensor's views on whose points the most agree.

    A start fits all points, or a random half of those near the best projections so far: linear, constrained, adjusted.  It then
    fits those nearest to its own projections, and again.  The adjusted fit tells outliers where the linear tensor, which has
    more freedom (80 against 32 in :math:`P^6`), bends to them.

    Args:
        tracks: flat batch.
        invariant: of as many views as the tensor takes.
        sigma: ``(b,)`` noise of one coordinate, measured unit; None: estimated.
        generator: of the starts.

    Returns:
        The projections, the noise ``(b,)``, and where they are doubtful ``(b,)``.

    Source: Rousseeuw and van Driessen 2006 (concentration steps of least trimmed squares); Chum, Matas and Kittler 2003
        (starts from the inliers so far).
    """
    options = choices(tracks, len(invariant.profile))
    search = _Search(invariant, sigma, generator)
    everyone = torch.arange(len(tracks.x), device=tracks.x.device)
    first = torch.ones_like(tracks.weights[:, :1])
    stale = torch.zeros_like(everyone)
    best, ranks = search.run(tracks, options[:, 0], first, (SHARES[0],), sigma)
    for turn in range(1, ROUNDS):
        level, doubt = search.judged(tracks, best)
        hopeless = (best.square < FAR).any(-1) & (level * tracks.scales.amax(1) > HOPELESS)
        left = everyone[(doubt | (search.weak(tracks, best) & (stale < CONFIRMED))) & ~(hopeless & (turn >= TRIED))]
        if not len(left):
            break
        views = options[left, turn % options.shape[1]]
        some = tracks.subset(left)
        starts = search.starts(some, views, best.square[left], ranks[left])
        new, rank = search.run(some, views, starts, SHARES, None if sigma is None else sigma[left])
        stale[left] = torch.where(new.lost < BETTER * best.lost[left], 0, stale[left] + 1)
        best.better(new, left)
        ranks[left] += rank
    return best, *search.judged(tracks, best)


@dataclass(frozen=True)
class _Search:
    invariant: GrassmannTensor
    sigma: Tensor | None
    generator: torch.Generator | None

    def run(
        self, tracks: Tracks, views: Tensor, starts: Tensor, shares: tuple[float, ...], sigma: Tensor | None
    ) -> tuple[Consensus, Tensor]:
        """The best of the starts ``(b, s, n)``, and the mean rank ``(b, n)`` of the points in all of them."""
        count = starts.shape[1]
        work = _of_views(tracks, views).repeated(count)
        level = None if sigma is None else sigma.repeat_interleave(count)
        share = torch.tensor(shares, dtype=tracks.x.dtype, device=tracks.x.device).repeat(len(views))
        kept, best = starts.flatten(0, 1), None
        for _ in range(CONCENTRATED):
            new = self._fitted(work, kept, level)
            if best is None:
                best = new
            else:
                best.better(new, torch.arange(len(kept), device=kept.device))
            near = _nearest(new.square, _wanted(work, share, self.invariant.minimal(), LEAST))
            cut = self._level(work, new.square, level).square() * bound(freedom(work, self.invariant.k)).amax(-1)
            kept = (near | (new.square <= cut[:, None])).to(kept.dtype)
        assert best is not None
        rank = best.square.argsort(-1).argsort(-1).to(kept.dtype).unflatten(0, (-1, count)).mean(1)
        winner = best.lost.unflatten(0, (-1, count)).argmin(1) + count * torch.arange(len(views), device=views.device)
        return Consensus(views.clone(), best.projections[winner], best.square[winner], best.lost[winner]), rank

    def starts(self, tracks: Tracks, views: Tensor, square: Tensor, ranks: Tensor) -> Tensor:
        """Random parts ``(b, s, n)`` of the points near the best projections so far, or in the mean of all."""
        count, minimal = len(SHARES), self.invariant.minimal()
        work = _of_views(tracks, views).repeated(count)
        share = torch.tensor(SHARES, dtype=tracks.x.dtype, device=tracks.x.device).repeat(len(views))
        wanted = _wanted(work, share, minimal, LEAST)
        drawn = _wanted(work, DRAWN * share, minimal, DRAWN_LEAST)
        order = torch.stack([square, ranks], dim=1).repeat(1, -(-count // 2), 1)[:, :count].flatten(0, 1)
        seen = (work.weights > 0).all(1)
        pool = _nearest(order.masked_fill(~seen, torch.inf), torch.maximum(wanted, (LEAST * drawn).long()))
        number = uniform(*order.shape, generator=self.generator, device=order.device)
        chosen = _nearest(number.masked_fill(~(pool & seen), torch.inf), drawn).to(square.dtype)
        return chosen.view(-1, count, chosen.shape[-1])

    def judged(self, tracks: Tracks, found: Consensus) -> tuple[Tensor, Tensor]:
        """Noise and doubt ``(b,)``."""
        work = _of_views(tracks, found.chosen)
        level = self._level(work, found.square, self.sigma)
        return level, doubtful(work, found.square, level, self.invariant)

    def weak(self, tracks: Tracks, found: Consensus) -> Tensor:
        """Where only the search for better ones tells whether projections ``(b,)`` are right."""
        seen = (_of_views(tracks, found.chosen).weights > 0).all(1).sum(-1)
        few = seen * self.invariant.codim < SURE * self.invariant.dof
        return few | torch.full_like(few, self.sigma is None)

    def _fitted(self, tracks: Tracks, kept: Tensor, sigma: Tensor | None) -> Consensus:
        """Projections from the points that are kept ``(b, n)``."""
        some = tracks.only(tracks.weights * kept[:, None])
        seen = (some.weights > 0).all(1).to(kept.dtype)
        data = Matches(some.x.unbind(1), seen, None, (len(kept),), kept.dtype, kept.device)
        linear = fit_matches(self.invariant, data)
        projections = torch.stack(constrain_matches(linear, data).motion, dim=1)
        structure = triangulate(projections, some.x, some.weights)
        projections = bundle_adjust(some.x, some.weights, projections, structure, iterations=FREE).cameras
        whole = (tracks.weights > 0).all(1)
        square = torch.where(whole, distance(tracks, projections), FAR)
        free = freedom(tracks, self.invariant.k)
        if sigma is None:
            lost = noise(square, free, whole, _part(whole, self.invariant))
        else:
            cut = sigma.square()[:, None] * bound(free).clamp(min=torch.finfo(square.dtype).tiny)
            lost = torch.where(whole, (square / cut).clamp(max=1), 0.0).sum(-1) / whole.sum(-1).clamp(min=1)
        return Consensus(torch.empty_like(kept), projections, square, lost)

    def _level(self, tracks: Tracks, square: Tensor, sigma: Tensor | None) -> Tensor:
        """Noise ``(b,)``: as given, or the median distance of all, and then of the inliers."""
        if sigma is not None:
            return sigma
        free = freedom(tracks, self.invariant.k)
        chosen = (tracks.weights > 0).all(1)
        return settled_noise(tracks, square, free, chosen, self.invariant.dof, _part(chosen, self.invariant))


def doubtful(tracks: Tracks, square: Tensor, sigma: Tensor, invariant: GrassmannTensor) -> Tensor:
    """Whether projections ``(b,)`` may be wrong: few inliers, many points just outside, or noise as large as the scene."""
    free = freedom(tracks, invariant.k)
    cut = sigma.square()[:, None] * bound(free)
    counted = (free >= 1) & (tracks.weights > 0).any(1)
    inside = (counted & (square <= cut)).sum(-1)
    near = (counted & (square > cut) & (square <= 9 * cut)).sum(-1)
    few = (inside < MAJORITY * counted.sum(-1)) | (inside * invariant.codim < REDUNDANT * invariant.dof)
    return few | (near > DOUBT * inside) | (sigma * tracks.scales.amax(1) > NOISY)


def _part(chosen: Tensor, invariant: GrassmannTensor) -> float:
    """The part of the points whose distances tell the noise: half of those that the projections cannot fit anyway."""
    number = max(1, int(chosen.sum(-1).max()))
    return min(0.9, 0.5 + 0.5 * (invariant.dof / invariant.codim + 1) / number)


def _of_views(tracks: Tracks, chosen: Tensor) -> Tracks:
    """Some views ``(b, size)`` of every problem."""
    rows = torch.arange(len(chosen), device=chosen.device)[:, None]
    x, weights, scales, transforms = (part[rows, chosen] for part in (tracks.x, tracks.weights, tracks.scales, tracks.transforms))
    return Tracks(x, weights, scales, transforms, tracks.times)


def _wanted(tracks: Tracks, share: Tensor, minimal: int, least: float) -> Tensor:
    """How many points ``(b,)``: a share of those seen, but more than the minimal number."""
    seen = (tracks.weights > 0).all(1).sum(-1)
    return torch.minimum((share * seen).long().clamp(min=int(least * minimal) + 1), seen)


def _nearest(value: Tensor, count: Tensor) -> Tensor:
    """The so many ``(b,)`` least values of each row, bool ``(b, n)``."""
    return value.argsort(-1).argsort(-1) < count[:, None]
