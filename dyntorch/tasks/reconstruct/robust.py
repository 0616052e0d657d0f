"""Reconstruction from tracks of which some are wrong."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from dyntorch.core.fit import fit_matches
from dyntorch.core.limits import quantile
from dyntorch.core.matches import Matches
from dyntorch.core.outcome import Status
from dyntorch.core.refine import constrain_matches
from dyntorch.core.solution import NOISY
from dyntorch.geometry.bundle import bundle_adjust
from dyntorch.geometry.triangulation import reproject, resect, triangulate
from dyntorch.invariants.grassmann_tensor import GrassmannTensor
from dyntorch.numerics.blocks import each, replace_problems, uniform
from dyntorch.tasks.reconstruct.result import ReconstructOptions
from dyntorch.tasks.reconstruct.scene import (
    LiftedState,
    Lifting,
    Projections,
    ViewTracks,
    adjust_scene,
    camera_unknowns,
    distances,
    scene_of,
    view_subsets,
)

# ----------------------------------------------------------------------------------------------------------------------
# Which observations agree with given projections: per point all of its views, or all but the fewest that spoil it.


FAR = 1e30
"""Squared distance in place of one that is no number."""
PAIRS = 1 << 14
"""Points that are looked at together with one view left out."""


TRIANGULATION_ITERATIONS = 2  # of a distance


def distance(tracks: ViewTracks, projections: Tensor) -> Tensor:
    """Squared reprojection error of every point over its views, ``(b, n)``, measured units; :data:`FAR` where there is none."""
    structure = triangulate(projections, tracks.x, tracks.weights, steps=TRIANGULATION_ITERATIONS)
    error = (tracks.x - reproject(projections, structure)).square().sum(-1) / tracks.scales.square()[..., None]
    total = torch.where(tracks.weights > 0, error, 0.0).sum(1)
    return torch.where((structure != 0).any(-1), total, FAR).nan_to_num(nan=FAR, posinf=FAR).clamp(max=FAR)


def freedom(tracks: ViewTracks, k: int) -> Tensor:
    """Equations that every point fulfils beside those that determine it, ``(b, n)``, not negative."""
    return ((tracks.weights > 0).sum(1) * tracks.x.shape[-1] - k).clamp(min=0)


def bound(free: Tensor, share: float) -> Tensor:
    """The squared distance, in standard deviations, that so many of the inliers keep; 0 where nothing is left to judge by."""
    top = int(free.max()) if free.numel() else 0
    return torch.tensor(_bounds(top, share), dtype=torch.float64, device=free.device)[free]


@lru_cache(maxsize=64)
def _bounds(top: int, share: float) -> tuple[float, ...]:
    return (0.0, *(quantile(share, free) for free in range(1, top + 1)))


def noise(square: Tensor, free: Tensor, chosen: Tensor, part: float = 0.5) -> Tensor:
    """Standard deviation ``(b,)`` of one coordinate from a quantile of the chosen points; 0 where there are none."""
    relative = square / bound(free, part).clamp(min=torch.finfo(square.dtype).tiny)
    counted = chosen & (free >= 1)
    order = relative.masked_fill(~counted, torch.inf).sort(-1).values
    number = counted.sum(-1, keepdim=True)
    place = (number * part).long().clamp(min=0, max=max(0, square.shape[-1] - 1))
    found = order.gather(-1, torch.minimum(place, (number - 1).clamp(min=0)))[:, 0]
    return torch.where(number[:, 0] > 0, found, 0.0).sqrt()


INLIER_QUANTILE = 0.997  # share of the inliers that agree: three standard deviations of one coordinate
NOISE_CUTOFF = 1.5  # distance over the threshold up to which it counts when the noise is estimated
NOISE_ITERATIONS = 4  # of that estimate
MAX_VARIANCE_CORRECTION = 2.0  # for the degrees of freedom of the projections
MIN_NOISE = 1e-8  # over the extent of the image


def estimate_noise(tracks: ViewTracks, square: Tensor, free: Tensor, chosen: Tensor, used: int, part: float = 0.5) -> Tensor:
    """Noise ``(b,)`` of one coordinate from a quantile of the chosen points, then the median of those within its threshold."""
    least = MIN_NOISE / tracks.scales.amin(1)
    level = torch.maximum(noise(square, free, chosen, part), least)
    for _ in range(NOISE_ITERATIONS):
        inside = chosen & (square <= (NOISE_CUTOFF * level).square()[:, None] * bound(free, INLIER_QUANTILE))
        rows = (free * inside).sum(-1)
        small = rows / (rows - used).clamp(min=1)
        level = torch.maximum(noise(square, free, inside) * small.clamp(min=1, max=MAX_VARIANCE_CORRECTION).sqrt(), least)
    return level


MIN_SPARE_EQUATIONS = 2  # that must remain to confirm a point that has lost a view


def select_inliers(tracks: ViewTracks, projections: Tensor, sigma: Tensor) -> Tensor:
    r"""Weights ``(b, views, n)``, 0 for all observations that do not agree with the projections."""
    k, size = projections.shape[-1] - 1, tracks.x.shape[-1]
    free = freedom(tracks, k)
    agrees = (distance(tracks, projections) <= sigma.square()[:, None] * bound(free, INLIER_QUANTILE)) & (free >= 1)
    kept = tracks.weights * agrees[:, None]
    rest = (~agrees & (free - size >= MIN_SPARE_EQUATIONS)).nonzero()
    for some in rest.split(PAIRS):
        problem, point = some.unbind(-1)
        kept[problem, :, point] = _reject_views(tracks, projections, sigma, problem, point)
    return kept


def _reject_views(tracks: ViewTracks, projections: Tensor, sigma: Tensor, problem: Tensor, point: Tensor) -> Tensor:
    """Weights ``(p, views)`` of single points, without the views that spoil them; all 0 where no views agree."""
    alone = ViewTracks(
        tracks.x[problem, :, point][:, :, None],
        tracks.weights[problem, :, point][:, :, None],
        tracks.scales[problem],
        tracks.transforms[problem],
        tracks.times,
    )
    matrices, limit = projections[problem], sigma[problem].square()
    views, k, size = matrices.shape[1], matrices.shape[-1] - 1, tracks.x.shape[-1]
    result = torch.zeros_like(alone.weights[..., 0])
    left = torch.arange(len(problem), device=problem.device)
    others = 1 - torch.eye(views, dtype=tracks.x.dtype, device=tracks.x.device)
    while len(left):
        seen = alone.weights[:, :, 0] > 0
        fewer = alone.repeat(views).only((alone.weights[:, None] * others[:, :, None]).flatten(0, 1))
        square = distance(fewer, matrices.repeat_interleave(views, dim=0)).unflatten(0, (-1, views))[..., 0]
        least, worst = square.masked_fill(~seen, torch.inf).min(-1)
        alone = alone.only(alone.weights * others[worst][:, :, None])
        free = freedom(alone, k)[:, 0]
        agrees = least <= limit * bound(free, INLIER_QUANTILE)
        result[left[agrees]] = alone.weights[agrees][..., 0]
        on = (~agrees & (free - size >= MIN_SPARE_EQUATIONS)).nonzero()[:, 0]
        left, alone, matrices, limit = left[on], alone.subset(on), matrices[on], limit[on]
    return result


# ----------------------------------------------------------------------------------------------------------------------
# Tracks of which many are wrong: projections on whose points the most agree, by concentration from many starts.


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

    def merge_better(self, new: Consensus, at: Tensor) -> Consensus:
        """With the new ones of some problems, where they are better."""
        wins = new.lost < self.lost[at]
        return replace_problems(self, at[wins], each(lambda x: x[wins], new))


# parts of the points that the starts keep: the smaller the fewer outliers, the larger the better the fit
START_SHARES = (0.5, 0.6, 0.7, 0.8)
CONFIRMING_ROUNDS = 3  # without improvement, after which a solution of few conditions is taken
IMPROVEMENT_RATIO = 0.97  # cost over the least so far below which a solution is better
MIN_HOPELESS_ROUNDS = 4  # rounds before a search may end as hopeless
HOPELESS_NOISE = 0.3  # over the extent of the images: shuffled tracks leave .45 to .7, scenes of 50 % outliers .17


def consensus(
    tracks: ViewTracks,
    invariant: GrassmannTensor,
    sigma: Tensor | None,
    generator: torch.Generator | None,
    options: ReconstructOptions,
) -> tuple[Consensus, Tensor, Tensor]:
    r"""Projections of the tensor's views on whose points the most agree. sigma ``(b,)`` -> ``(b,)``."""
    subsets = view_subsets(tracks, len(invariant.profile))
    search = _Search(invariant, sigma, generator, options=options)
    everyone = torch.arange(len(tracks.x), device=tracks.x.device)
    first = torch.ones_like(tracks.weights[:, :1])
    stale = torch.zeros_like(everyone)
    best, ranks = search.run(tracks, subsets[:, 0], first, (START_SHARES[0],), sigma)
    for turn in range(1, options.max_search_rounds):
        level, doubt = search.assess(tracks, best)
        hopeless = (best.square < FAR).any(-1) & (level * tracks.scales.amax(1) > HOPELESS_NOISE)
        left = everyone[
            (doubt | (search.weak(tracks, best) & (stale < CONFIRMING_ROUNDS))) & ~(hopeless & (turn >= MIN_HOPELESS_ROUNDS))
        ]
        if not len(left):
            break
        views = subsets[left, turn % subsets.shape[1]]
        some = tracks.subset(left)
        starts = search.starts(some, views, best.square[left], ranks[left])
        new, rank = search.run(some, views, starts, START_SHARES, None if sigma is None else sigma[left])
        stale[left] = torch.where(new.lost < IMPROVEMENT_RATIO * best.lost[left], 0, stale[left] + 1)
        best = best.merge_better(new, left)
        ranks[left] += rank
    return best, *search.assess(tracks, best)


DRAWN_SHARE = 0.5  # of that part, that a start is drawn of
MIN_KEPT_RATIO = 1.3  # points kept over the minimal number
MIN_DRAWN_RATIO = 1.15  # points drawn over the minimal number
CONCENTRATION_STEPS = 3  # fits per start, each to the points nearest to the one before
START_ITERATIONS = 10  # of bundle adjustment per fit: without it half of the outliers stay
SUFFICIENT_REDUNDANCY = 4.0  # conditions over degrees of freedom from which on a solution of known noise needs no confirmation


@dataclass(frozen=True)
class _Search:
    invariant: GrassmannTensor
    sigma: Tensor | None
    generator: torch.Generator | None
    options: ReconstructOptions

    def run(
        self, tracks: ViewTracks, views: Tensor, starts: Tensor, shares: tuple[float, ...], sigma: Tensor | None
    ) -> tuple[Consensus, Tensor]:
        """The best of the starts ``(b, s, n)``, and the mean rank ``(b, n)`` of the points in all of them."""
        count = starts.shape[1]
        work, chosen = _of_views(tracks, views).repeat(count), views.repeat_interleave(count, 0)
        level = None if sigma is None else sigma.repeat_interleave(count)
        share = torch.tensor(shares, dtype=tracks.x.dtype, device=tracks.x.device).repeat(len(views))
        kept, best = starts.flatten(0, 1), None
        for _ in range(CONCENTRATION_STEPS):
            new = self._fit(work, chosen, kept, level)
            best = new if best is None else best.merge_better(new, torch.arange(len(kept), device=kept.device))
            near = _nearest(new.square, _num_points(work, share, self.invariant.minimal(), MIN_KEPT_RATIO))
            cut = self._level(work, new.square, level).square() * bound(freedom(work, self.invariant.k), INLIER_QUANTILE).amax(-1)
            kept = (near | (new.square <= cut[:, None])).to(kept.dtype)
        assert best is not None
        rank = best.square.argsort(-1).argsort(-1).to(kept.dtype).unflatten(0, (-1, count)).mean(1)
        winner = best.lost.unflatten(0, (-1, count)).argmin(1) + count * torch.arange(len(views), device=views.device)
        return each(lambda x: x[winner], best), rank

    def starts(self, tracks: ViewTracks, views: Tensor, square: Tensor, ranks: Tensor) -> Tensor:
        """Random parts ``(b, s, n)`` of the points near the best projections so far, or in the mean of all."""
        count, minimal = len(START_SHARES), self.invariant.minimal()
        work = _of_views(tracks, views).repeat(count)
        share = torch.tensor(START_SHARES, dtype=tracks.x.dtype, device=tracks.x.device).repeat(len(views))
        wanted = _num_points(work, share, minimal, MIN_KEPT_RATIO)
        drawn = _num_points(work, DRAWN_SHARE * share, minimal, MIN_DRAWN_RATIO)
        order = torch.stack([square, ranks], dim=1).repeat(1, -(-count // 2), 1)[:, :count].flatten(0, 1)
        seen = (work.weights > 0).all(1)
        pool = _nearest(order.masked_fill(~seen, torch.inf), torch.maximum(wanted, (MIN_KEPT_RATIO * drawn).long()))
        number = uniform(*order.shape, generator=self.generator, device=order.device)
        chosen = _nearest(number.masked_fill(~(pool & seen), torch.inf), drawn).to(square.dtype)
        return chosen.view(-1, count, chosen.shape[-1])

    def assess(self, tracks: ViewTracks, found: Consensus) -> tuple[Tensor, Tensor]:
        """Noise and doubt ``(b,)``."""
        work = _of_views(tracks, found.chosen)
        level = self._level(work, found.square, self.sigma)
        return level, is_doubtful(work, found.square, level, self.invariant, self.options)

    def weak(self, tracks: ViewTracks, found: Consensus) -> Tensor:
        """Where only the search for better ones tells whether projections ``(b,)`` are right."""
        seen = (_of_views(tracks, found.chosen).weights > 0).all(1).sum(-1)
        few = seen * self.invariant.codim < SUFFICIENT_REDUNDANCY * self.invariant.dof
        return few | torch.full_like(few, self.sigma is None)

    def _fit(self, tracks: ViewTracks, views: Tensor, kept: Tensor, sigma: Tensor | None) -> Consensus:
        """Projections of these views from the points that are kept ``(b, n)``."""
        some = tracks.only(tracks.weights * kept[:, None])
        seen = (some.weights > 0).all(1).to(kept.dtype)
        data = Matches(some.x.unbind(1), seen, None, (len(kept),), kept.dtype, kept.device)
        linear = fit_matches(self.invariant, data)
        projections = torch.stack(constrain_matches(linear, data).motion, dim=1)
        structure = triangulate(projections, some.x, some.weights)
        projections = bundle_adjust(some.x, some.weights, projections, structure, iterations=START_ITERATIONS).cameras
        whole = (tracks.weights > 0).all(1)
        square = torch.where(whole, distance(tracks, projections), FAR)
        free = freedom(tracks, self.invariant.k)
        if sigma is None:
            lost = noise(square, free, whole, _part(whole, self.invariant))
        else:
            cut = sigma.square()[:, None] * bound(free, INLIER_QUANTILE).clamp(min=torch.finfo(square.dtype).tiny)
            lost = torch.where(whole, (square / cut).clamp(max=1), 0.0).sum(-1) / whole.sum(-1).clamp(min=1)
        return Consensus(views, projections, square, lost)

    def _level(self, tracks: ViewTracks, square: Tensor, sigma: Tensor | None) -> Tensor:
        """Noise ``(b,)``: as given, or the median distance of all, and then of the inliers."""
        if sigma is not None:
            return sigma
        free = freedom(tracks, self.invariant.k)
        chosen = (tracks.weights > 0).all(1)
        return estimate_noise(tracks, square, free, chosen, self.invariant.dof, _part(chosen, self.invariant))


MAX_NEAR_SHARE = 0.15  # points one to three thresholds away, per inlier: a wrong model has many
MIN_REDUNDANCY = 1.25  # conditions of the inliers over the degrees of freedom of the projections


def is_doubtful(
    tracks: ViewTracks, square: Tensor, sigma: Tensor, invariant: GrassmannTensor, options: ReconstructOptions
) -> Tensor:
    """Whether projections ``(b,)`` may be wrong: few inliers, many points just outside, or noise as large as the scene."""
    free = freedom(tracks, invariant.k)
    cut = sigma.square()[:, None] * bound(free, INLIER_QUANTILE)
    counted = (free >= 1) & (tracks.weights > 0).any(1)
    inside = (counted & (square <= cut)).sum(-1)
    near = (counted & (square > cut) & (square <= 9 * cut)).sum(-1)
    few = (inside < options.min_inlier_share * counted.sum(-1)) | (inside * invariant.codim < MIN_REDUNDANCY * invariant.dof)
    return few | (near > MAX_NEAR_SHARE * inside) | (sigma * tracks.scales.amax(1) > NOISY)


def _part(chosen: Tensor, invariant: GrassmannTensor) -> float:
    """The part of the points whose distances tell the noise: half of those that the projections cannot fit anyway."""
    number = max(1, int(chosen.sum(-1).max()))
    return min(0.9, 0.5 + 0.5 * (invariant.dof / invariant.codim + 1) / number)


def _of_views(tracks: ViewTracks, chosen: Tensor) -> ViewTracks:
    """Some views ``(b, size)`` of every problem."""
    rows = torch.arange(len(chosen), device=chosen.device)[:, None]
    x, weights, scales, transforms = (part[rows, chosen] for part in (tracks.x, tracks.weights, tracks.scales, tracks.transforms))
    return ViewTracks(x, weights, scales, transforms, tracks.times)


def _num_points(tracks: ViewTracks, share: Tensor, minimal: int, least: float) -> Tensor:
    """How many points ``(b,)``: a share of those seen, but more than the minimal number."""
    seen = (tracks.weights > 0).all(1).sum(-1)
    return torch.minimum((share * seen).long().clamp(min=int(least * minimal) + 1), seen)


def _nearest(value: Tensor, count: Tensor) -> Tensor:
    """The so many ``(b,)`` least values of each row, bool ``(b, n)``."""
    return value.argsort(-1).argsort(-1) < count[:, None]


FALSE_ALARM_RATE = 0.05  # of problems without outliers, where few conditions are left for every unknown of the cameras
RARE_FALSE_ALARM_RATE = 1e-4  # the same where there are plenty: a false alarm costs fifty times the time
AMPLE_CONDITIONS = 6.0  # per unknown of the projections: from there on one outlier cannot hide
LOUD_NOISE = 0.01  # over the extent of the images: least squares spreads wrong tracks over all


def have_outliers(tracks: ViewTracks, apart: Tensor, unknowns: Tensor | int, limit: float | None) -> Tensor:
    """Which problems ``(b,)`` show outliers after least squares."""
    square, free, sigma = _misfit(tracks, apart, unknowns, limit)
    if not len(apart):
        return apart.new_zeros(0, dtype=torch.bool)
    size = int(torch.as_tensor(unknowns).max()) + 1
    used = camera_unknowns(tracks.x.shape[1], tracks.x.shape[-1] + 1, size)
    plenty = size <= 5 and int(free.sum(-1).min()) >= AMPLE_CONDITIONS * used
    share = (RARE_FALSE_ALARM_RATE if plenty else FALSE_ALARM_RATE) / max(1, apart.shape[-1])
    loud = sigma * tracks.scales.amax(1) > LOUD_NOISE
    return loud | (square > sigma.square()[:, None] * bound(free, 1 - share)).logical_and(free >= 1).any(-1)


STATIC_CUTOFF = 2.0  # over the threshold of the others, above which points given as static move


def moving_static_points(tracks: ViewTracks, apart: Tensor, unknowns: Tensor) -> Tensor:
    """The points ``(b, n)`` said to stand still that fit by far the worst: they move."""
    assert tracks.static is not None
    square, free, sigma = _misfit(tracks, apart, unknowns, None)
    excess = torch.where(
        tracks.static,
        square / (sigma.square()[:, None] * bound(free, INLIER_QUANTILE)).clamp(min=torch.finfo(sigma.dtype).tiny),
        0.0,
    )
    return (excess > STATIC_CUTOFF**2) & (excess >= excess.amax(-1, keepdim=True) / 2)


NUM_TRIMS = 2  # times that observations are taken from the least squares scene
MIN_TRIMMED_SHARE = 0.9  # of the observations that has to stay then


def trim_outliers(
    tracks: ViewTracks, scene: LiftedState, lifting: Lifting, unknowns: Tensor, limit: float | None
) -> tuple[LiftedState, ViewTracks, Tensor]:
    """The least squares scene after the few observations that disagree with it are taken away, the tracks without them, and
    whether ``(b,)`` that is all there was to do: one wrong track in many does not need a search."""
    fewer = tracks
    for _ in range(NUM_TRIMS):
        projections = scene.cameras @ lifting.lifts
        _, _, sigma = _misfit(fewer, distances(fewer, projections, scene.structure), unknowns, limit)
        fewer = tracks.only(select_inliers(tracks, projections, sigma))
        structure = triangulate(projections, fewer.x, fewer.weights, steps=2)
        scene = adjust_scene(fewer, LiftedState(scene.cameras, structure, scene.cost), lifting)
    apart = distances(fewer, scene.cameras @ lifting.lifts, scene.structure)
    return scene, fewer, ~have_outliers(fewer, apart, unknowns, limit) & (_inlier_share(fewer, tracks) >= MIN_TRIMMED_SHARE)


def _misfit(tracks: ViewTracks, apart: Tensor, unknowns: Tensor | int, limit: float | None) -> tuple[Tensor, Tensor, Tensor]:
    """Squared distance of every point, its conditions ``(b, n)``, and the noise ``(b,)``, a third of the limit or by the median."""
    square = apart.square().nansum(1)
    free = (apart.isfinite().sum(1) * tracks.x.shape[-1] - unknowns).clamp(min=0)
    least = MIN_NOISE / tracks.scales.amin(1)
    sigma = noise(square, free, free >= 1) if limit is None else torch.full_like(least, limit / 3)
    return square, free, torch.maximum(sigma, least)


def _inlier_share(fewer: ViewTracks, tracks: ViewTracks) -> Tensor:
    """Share ``(b,)`` of the observations that are left."""
    return (fewer.weights > 0).flatten(1).sum(-1) / (tracks.weights > 0).flatten(1).sum(-1).clamp(min=1)


SUFFICIENT_INLIER_SHARE = 0.7  # of the observations, with coordinates to spare: no more is asked
AMPLE_COORDINATES = 4  # of a point beyond its unknowns: most observations do not agree by accident
SELECTION_CUTOFFS = (6.0, 3.0, 1.5, 1.0, 1.0)  # over the final threshold, while all views converge


def robust_projections(
    tracks: ViewTracks,
    invariant: GrassmannTensor,
    lifting: Lifting | None,
    limit: float | None,
    generator: torch.Generator | None,
    options: ReconstructOptions,
) -> tuple[Projections, ViewTracks]:
    """Projections from the tracks that agree, and the tracks with weight 0 for all other observations."""
    given = None if limit is None else torch.full_like(tracks.scales[:, 0], limit / 3)
    best, sigma, _ = consensus(tracks, invariant, given, generator, options)
    cameras = _extend_to_all_views(tracks, best, sigma)
    cameras = _adjust_to_inliers(tracks, cameras, None, sigma, SELECTION_CUTOFFS)
    sigma = _level(tracks, cameras, sigma, given)
    if lifting is not None:
        cameras = _adjust_structured(tracks, cameras, lifting, sigma, given)
        sigma = _level(tracks, cameras, sigma, given)
    fewer = tracks.only(select_inliers(tracks, cameras, sigma))
    ample = tracks.x.shape[1] * tracks.x.shape[-1] >= cameras.shape[-1] + AMPLE_COORDINATES
    doubt = is_doubtful(tracks, distance(tracks, cameras), sigma, invariant, options) & ~(
        (_inlier_share(fewer, tracks) >= SUFFICIENT_INLIER_SHARE) & ample
    )
    status = torch.where(doubt, int(Status.NO_CONSENSUS), int(Status.OK))
    return Projections(cameras, triangulate(cameras, fewer.x, fewer.weights, steps=2), status), fewer


def _level(tracks: ViewTracks, cameras: Tensor, sigma: Tensor, given: Tensor | None) -> Tensor:
    """The noise ``(b,)``: as given, or that of the points that agree."""
    if given is not None:
        return given
    fewer = tracks.only(select_inliers(tracks, cameras, sigma))
    free = freedom(fewer, cameras.shape[-1] - 1)
    return estimate_noise(tracks, distance(fewer, cameras), free, free >= 1, camera_unknowns(*cameras.shape[1:]))


RESECTION_ITERATIONS = 10  # reweightings of the views that the tensor does not use


def _extend_to_all_views(tracks: ViewTracks, found: Consensus, sigma: Tensor) -> Tensor:
    """Projections of all views: the others by resection from the points that agree, reweighted."""
    b, size = found.chosen.shape
    if size == tracks.x.shape[1]:
        return found.projections.gather(1, found.chosen.argsort(1)[..., None, None].expand_as(found.projections))
    rows = torch.arange(b, device=found.chosen.device)[:, None]
    some = (tracks.x[rows, found.chosen], tracks.weights[rows, found.chosen])
    structure = triangulate(found.projections, *some, steps=2)
    free = torch.full_like(found.square, size * tracks.x.shape[-1] - structure.shape[-1] + 1).long()
    known = found.square <= sigma.square()[:, None] * bound(free, INLIER_QUANTILE)
    structure = torch.where(known[..., None], structure, 0.0)
    counted = (tracks.weights > 0) & known[:, None]
    weights, scale = tracks.weights, None
    for _ in range(RESECTION_ITERATIONS):
        whole = resect(structure, tracks.x, weights)
        square = (tracks.x - reproject(whole, structure)).square().sum(-1) / tracks.scales.square()[..., None]
        middle = square.masked_fill(~counted, torch.nan).nanmedian(-1).values.nan_to_num(nan=0.0)
        middle = torch.maximum(middle, sigma.square()[:, None])
        scale = 4 * middle if scale is None else torch.maximum(scale / 2, middle)
        weights = tracks.weights * (scale[..., None] / (scale[..., None] + square)).square()
    return whole.index_put((rows, found.chosen), found.projections)


SELECTION_ITERATIONS = 10  # of bundle adjustment after each selection


def _adjust_to_inliers(
    tracks: ViewTracks, cameras: Tensor, lifts: Tensor | None, sigma: Tensor, widths: tuple[float, ...]
) -> Tensor:
    """Projections adjusted to the observations that agree, which are chosen again after each time."""
    for width in widths:
        projections = cameras if lifts is None else cameras @ lifts
        weights = select_inliers(tracks, projections, width * sigma)
        structure = triangulate(projections, tracks.x, weights, steps=2)
        cameras = bundle_adjust(tracks.x, weights, cameras, structure, lifts, iterations=SELECTION_ITERATIONS).cameras
    return cameras if lifts is None else cameras @ lifts


def _adjust_structured(tracks: ViewTracks, cameras: Tensor, lifting: Lifting, sigma: Tensor, given: Tensor | None) -> Tensor:
    """Projections that the lifts allow, where as many observations agree with them."""
    weights = select_inliers(tracks, cameras, sigma)
    fewer = tracks.only(weights)
    found = Projections(cameras, triangulate(cameras, fewer.x, weights, steps=2), torch.zeros_like(sigma).long())
    scene = scene_of(fewer, found, lifting)
    better = _adjust_to_inliers(tracks, scene.cameras, lifting.lifts, sigma, (1.0, 1.0))
    more = (select_inliers(tracks, better, sigma) > 0).sum((1, 2)) >= 0.98 * (weights > 0).sum((1, 2))
    return torch.where(more[:, None, None, None], better, cameras)
