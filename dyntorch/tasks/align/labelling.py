"""Static, moving or outlier: labels from a motion, and the motion from the labels, in turns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations

import torch
from torch import Tensor

from dyntorch.core.fit import fit_matches
from dyntorch.core.invariant import Invariant
from dyntorch.core.limits import median, three_sigma
from dyntorch.core.matches import Matches
from dyntorch.core.normalize import Normalization, normalization, normalize_motion
from dyntorch.core.outcome import Status, is_failure
from dyntorch.core.refine import Problem, refine_matches
from dyntorch.core.residual import whiten, whitened_residual
from dyntorch.core.robust import robust_fit
from dyntorch.core.solution import NOISY, Solution
from dyntorch.geometry.homogeneous import apply, homogeneous, unit
from dyntorch.invariants.dynamic_tensor import DynamicMotion, nearest_flats
from dyntorch.invariants.homography_tensor import HomographyTensor
from dyntorch.invariants.join_tensor import JoinTensor
from dyntorch.numerics.blocks import each, map_blocks, select, uniform
from dyntorch.numerics.nullspace import null_space, spectrum
from dyntorch.tasks.align.result import (
    MIN_STATIC_SUPPORT,
    MOVING,
    OUTLIER,
    STATIC,
    agrees_too_little,
    contradicts,
    count_rival_static,
    labels_of,
    status_of_alignment,
)

NUM_LABEL_ROUNDS = 3  # of labelling and refining with the noise known
NUM_LABEL_ROUNDS_UNKNOWN_NOISE = 6  # turns with the noise to be found as well
NOISE_TOLERANCE = 0.02  # relative change of the noise that needs no further round
THRESHOLD_SIGMAS = 3.0  # a threshold, in standard deviations of the noise of one coordinate
ROUGH_LABEL_FACTOR = 3.0  # width of the first labels over that of the noise, where the motion comes from a minimal sample
MAX_TRAJECTORY_DISTANCE = 3.0  # standard deviations of the noise from a trajectory line
MAX_WIDENING = 4.0  # of a limit by the uncertainty of the motion: a moving match called static gives a wrong motion
MAX_START_STEPS = 30  # of the refinement that takes all matches for moving inliers
NUM_LABEL_STEPS = 6  # of Levenberg-Marquardt between two labellings
MIN_SINGULAR_RATIO = 1e-3  # of a collineation in normalized coordinates; usually above .1
NUM_SCORED_MATCHES = 256  # that judge a hypothesis: enough to tell 5 % of agreement from none
STATIC_SUPPORT_FACTOR = 3.0  # static matches for each that is expected by chance, besides
CHANCE_LIMIT_FACTOR = 3.0  # times the limit of static matches within which those that are static by chance spread evenly


@dataclass(frozen=True)
class Labelled:
    """Motions with the labels they give, flat batch."""

    theta: Tensor
    """``(b, p)`` motion in normalized coordinates, all parts one after the other, of norm 1 each."""
    labels: Tensor
    """``(b, n)``."""
    sigma: Tensor
    """``(b,)`` standard deviation of the noise that the labels assume, in the unit of the matches."""


@dataclass(frozen=True)
class Evidence:
    """Matches whose labels are sought, prepared: residuals of any motion in the unit of the matches."""

    invariant: Invariant
    data: Matches
    norm: Normalization
    views: tuple[Tensor, ...]
    """Normalized."""
    floor: Tensor
    """``(b,)`` the least noise that the numbers allow, in the unit of the matches."""

    @classmethod
    def of(cls, invariant: Invariant, data: Matches) -> Evidence:
        """From checked matches; those with ``data.static`` are known not to move."""
        largest = data.weights.amax(-1, keepdim=True).clamp(min=torch.finfo(torch.float64).tiny)
        flat = replace(
            data, weights=data.weights / largest, batch=data.weights.shape[:1], dtype=torch.float64, device=data.weights.device
        )
        norm = normalization(invariant, flat.views, flat.weights)
        floor = 100 * torch.finfo(data.dtype).eps / torch.stack(norm.scales).amin(0)
        return Evidence(invariant, flat, norm, norm.apply(invariant, flat.views), floor)

    @property
    def static_conditions(self) -> int:
        """Conditions that a static match fulfils."""
        return sum(p.freedom() for p in self.invariant.primitives[1:])

    def repeat(self, count: int) -> Evidence:
        """The same problems several times, one block after the other."""
        return self._select(lambda x: x.repeat(count, *([1] * (x.ndim - 1))))

    def subset(self, keep: Tensor) -> Evidence:
        """Some of the problems, ``(b,)`` bool."""
        return self._select(lambda x: x[keep])

    def _select(self, take: Callable[[Tensor], Tensor]) -> Evidence:
        views, weights, static = each(take, (self.data.views, self.data.weights, self.data.static))
        data = replace(self.data, views=views, weights=weights, static=static, batch=weights.shape[:1])
        transforms, actions = each(take, (self.norm.transforms, self.norm.actions))
        norm = Normalization(transforms, self.norm.primitives, actions)
        return Evidence(self.invariant, data, norm, each(take, self.views), take(self.floor))

    def given_noise(self, threshold: float | None) -> Tensor | None:
        """Standard deviation ``(b,)`` that a threshold stands for."""
        return None if threshold is None else torch.full_like(self.floor, threshold / THRESHOLD_SIGMAS).maximum(self.floor)

    def problem(self, labels: Tensor) -> Problem:
        """Least squares over the inliers, as refinement sees it."""
        size, weights = self.norm.transforms[0].shape[-1], self.data.weights * (labels != OUTLIER)
        shapes = (torch.Size((size, size)),) * len(self.invariant.motion)
        return Problem(self.invariant, shapes, self.views, self.norm.scales, weights, labels == STATIC)

    def residuals(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """Whitened residual ``(b, n, c)`` of every match if it moves, and if it stands still."""
        motion = self.problem(torch.zeros_like(self.data.weights)).parts(theta)
        moving = whitened_residual(self.invariant, motion, self.views, self.norm.scales)
        return moving, self.invariant.whitened_static_residual(motion, self.views, self.norm.scales)

    def cost(self, theta: Tensor, sigma: Tensor) -> Tensor:
        """How badly the motion explains the matches, ``(b,)``."""
        moving, resting = self.residuals(theta)
        variance = sigma.square()[:, None]
        still, path = three_sigma(self.static_conditions), three_sigma(self.invariant.codim)
        other = still + (moving.square().sum(-1) / variance).clamp(max=path)
        if self.data.static is not None:
            other = torch.where(self.data.static, still + path, other)
        cost = torch.minimum(resting.square().sum(-1) / variance, other).nan_to_num(nan=still + path)
        total = (self.data.weights * cost).sum(-1)
        if self.data.static is None:
            return total
        # a motion against most of what is known to stand still is worse than any other
        against = contradicts(cost < still + path, self.data.static, self.data.weights)
        return total + against * (still + path) * self.data.weights.sum(-1)

    def labels(self, theta: Tensor, sigma: Tensor, spread: Tensor | None = None) -> Tensor:
        """``(b, n)``; ``spread (b, p, p)`` is the covariance of theta for noise 1, which widens the limits."""
        moving, resting = self.residuals(theta)
        variance = sigma.square()[:, None]
        path, still = moving.square().sum(-1), resting.square().sum(-1)
        limits = [three_sigma(c) * variance for c in (self.invariant.codim, self.static_conditions)]
        agree = [path <= limits[0], still <= limits[1]]
        if spread is not None:
            problem = self.problem(torch.zeros_like(self.data.weights))
            pieces = [self._widened_squares(problem, theta, spread, piece) for piece in problem.pieces(theta.shape[-1])]
            for k, (plain, limit) in enumerate(zip((path, still), limits, strict=True)):
                widened = torch.cat([piece[k] for piece in pieces], dim=-1)
                agree[k] = agree[k] | ((widened <= limit) & (plain <= MAX_WIDENING**2 * limit))
        return labels_of(agree[1], agree[0], self.data)

    def _widened_squares(self, problem: Problem, theta: Tensor, spread: Tensor, piece: slice) -> tuple[Tensor, Tensor]:
        """Squares ``(b, piece)`` of the two residuals whitened by the uncertainty of the motion as well."""
        views = tuple(x[:, piece] for x in self.views)
        squares = []
        for value, derivative in (problem.linearize_moving(theta, views), problem.linearize_static(theta, views)):
            e = value.unflatten(1, (views[0].shape[1], -1))
            j = derivative.mT.unflatten(1, e.shape[1:])  # (b, n, c, p)
            eye = torch.eye(j.shape[-2], dtype=theta.dtype, device=theta.device)
            squares.append(whiten(e, eye + (j @ spread[:, None]) @ j.mT).square().sum(-1))
        return squares[0], squares[1]

    def information(self, theta: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
        """Eigenvalues ``(b, dof)``, ascending, of the information that the labelled matches hold on theta per unit of variance,
        and the covariance ``(b, p, p)`` of theta for noise 1."""
        _, _, matrix = self.problem(labels).normal_equations(theta)
        finite = matrix.isfinite().flatten(1).all(-1)
        values, vectors = spectrum(torch.where(finite[:, None, None], matrix, 0.0))
        values, vectors = values[:, -self.invariant.dof :], vectors[..., -self.invariant.dof :]
        floor = 1e-12 * values[:, -1:].clamp(min=torch.finfo(values.dtype).tiny)
        root = vectors * values.clamp(min=floor).rsqrt()[:, None, :]
        return values, root @ root.mT

    def refine(self, theta: Tensor, labels: Tensor, steps: int) -> Solution:
        """Segmented refinement: moving matches by their Sampson distance, static ones by their disagreement."""
        problem = self.problem(labels)
        zero = torch.zeros(len(theta), dtype=torch.long, device=theta.device)
        parts = problem.parts(theta)
        tensor = self.invariant.compose(*parts)
        data = replace(self.data, weights=problem.weights, static=problem.static)
        nothing = torch.zeros_like(theta[:, 0])
        start = Solution(self.invariant, tensor, nothing, data, self.norm, tensor, status=zero, refined=parts)
        return refine_matches(start, data, steps)

    def improve(self, theta: Tensor, sigma: Tensor, rough: Tensor) -> Tensor:
        """One labelling and refinement; where ``rough (b,)``, the motion comes from a minimal sample of static matches."""
        labels = self.labels(theta, torch.where(rough, ROUGH_LABEL_FACTOR * sigma, sigma))
        # what a rough motion says about moving matches is left to chance
        labels = torch.where(rough[:, None] & (labels == MOVING), OUTLIER, labels)
        return normalized_motion(self.refine(theta, labels, NUM_LABEL_STEPS))

    def improve_starts(self, starts: list[Tensor], sigma: Tensor, *, sampled: bool) -> Tensor:
        """All starts ``(b, p)`` after :meth:`improve`, ``(starts b, p)``; ``sampled``: the first is from a minimal sample."""
        count, size = len(starts), len(sigma)
        rough = (torch.arange(count, device=sigma.device).repeat_interleave(size) == 0) & sampled
        return self.repeat(count).improve(torch.cat(starts), sigma.repeat(count), rough)

    def best_start(self, theta: Tensor, sigma: Tensor) -> Tensor:
        """Of several motions for each problem ``(starts b, p)`` the one of least cost, ``(b, p)``; no singular one."""
        size = len(sigma)
        count = len(theta) // size if size else 1
        cost = torch.where(self._is_singular(theta), torch.inf, self.repeat(count).cost(theta, sigma.repeat(count)))
        best = cost.unflatten(0, (count, size)).argmin(0)
        return theta[best * size + torch.arange(size, device=best.device)]

    def _is_singular(self, theta: Tensor) -> Tensor:
        """Whether a motion takes the world to less than that, which fulfils every match and explains none."""
        d = self.views[0].shape[-1] + 1
        values = torch.linalg.svdvals(theta.nan_to_num().unflatten(-1, (-1, d, d)))
        return (values[..., -1] < MIN_SINGULAR_RATIO * values[..., 0]).any(-1)

    def iterate_labels(self, theta: Tensor, sigma: Tensor, *, estimate: bool) -> Labelled:
        """Label and refine in turns, until the labels stay; ``estimate``: and the noise with them."""
        labels, steady = self.labels(theta, sigma), not estimate
        for _ in range(NUM_LABEL_ROUNDS_UNKNOWN_NOISE if estimate else NUM_LABEL_ROUNDS):
            _, spread = self.information(theta, labels)
            new = self.labels(theta, sigma, spread)
            if bool((new == labels).all()) and steady:
                break
            labels = new
            found = self.refine(theta, labels, NUM_LABEL_STEPS)
            theta = normalized_motion(found)
            if estimate and found.sigma is not None:
                old, sigma = sigma, torch.where(found.sigma.isfinite() & (found.sigma > 0), found.sigma, sigma).maximum(self.floor)
                steady = bool(((sigma - old).abs() <= NOISE_TOLERANCE * old).all())
        return Labelled(theta, labels, sigma)


def tensor_start(
    invariant: Invariant, evidence: Evidence, given: Tensor | None, generator: torch.Generator | None, *, plain: bool
) -> tuple[Tensor, Tensor]:
    """Motion ``(b, p)`` of a tensor by robust estimation, ``plain``: as if all matches were moving inliers, the identity where
    there is none, and the noise ``(b,)`` that the median of all matches shows."""
    data = evidence.data

    def solve(views: tuple[Tensor, ...]) -> Solution:
        if plain:
            return fit_matches(invariant, replace(data, views=views, static=None))
        return robust_fit(invariant, *views, threshold=given, weights=data.weights, generator=generator)

    motion, found = motion_of_all(evidence, solve, given, generator)
    theta = torch.cat([part.flatten(1) for part in motion], dim=-1)
    usable = theta.isfinite().all(-1) & ~is_failure(found.status.reshape(-1))
    identity = torch.eye(motion[0].shape[-1], dtype=theta.dtype, device=theta.device).flatten().repeat(len(motion))
    theta = torch.where(usable[:, None], theta, identity)
    if plain:
        refined = evidence.refine(theta, torch.where(data.weights > 0, MOVING, OUTLIER), MAX_START_STEPS)
        assert refined.sigma is not None
        theta, noise = normalized_motion(refined), refined.sigma
    elif given is None:
        middle = torch.where(data.weights > 0, evidence.residuals(theta)[0].square().sum(-1), torch.nan).nanmedian(dim=-1).values
        noise = (middle / median(evidence.invariant.codim)).sqrt()
        if found.sigma is not None:
            # what its inliers show is less than the median, where there are many outliers
            noise = torch.where((found.status == Status.OK) & (found.sigma > 0), torch.minimum(found.sigma, noise), noise)
    return theta, given if given is not None else torch.where(usable & noise.isfinite(), noise, torch.inf)


def has_static_support(evidence: Evidence, found: Labelled) -> Tensor:
    """Where more matches are static ``(b,)`` than some motion of a family makes by chance."""
    still = (found.labels == STATIC) & (evidence.data.weights > 0)
    square = evidence.residuals(found.theta)[1].square().sum(-1)
    limit = CHANCE_LIMIT_FACTOR**2 * three_sigma(evidence.static_conditions) * found.sigma.square()[:, None]
    beside = ((square <= limit) & ~still & (evidence.data.weights > 0)).sum(-1)
    return still.sum(-1) >= MIN_STATIC_SUPPORT + STATIC_SUPPORT_FACTOR * beside / (CHANCE_LIMIT_FACTOR**2 - 1)


def other_background(
    evidence: Evidence, best: Labelled, asked: Tensor, samples: int, min_share: float, generator: torch.Generator | None
) -> Tensor:
    """Matches ``(b,)`` that stand still by a rival motion and move by this one, 0 where none explains the matches as well: a convoy
    and what it passes are each other's background.  ``asked (b,)`` problems are searched."""
    moving = best.labels == MOVING
    asked = asked & (moving.sum(-1) >= MIN_STATIC_SUPPORT)
    count = torch.zeros_like(moving[:, 0], dtype=torch.long)
    if not bool(asked.any()):
        return count
    evidence, sigma, labels, moving = evidence.subset(asked), best.sigma[asked], best.labels[asked], moving[asked]
    movers = replace(evidence, data=replace(evidence.data, weights=evidence.data.weights * moving, static=None))
    theta, _ = static_start(movers, sigma, samples, generator)
    # labels of a minimal sample, then those of all matches
    theta = movers.improve(theta, sigma, torch.ones_like(sigma, dtype=torch.bool))
    rival = evidence.iterate_labels(theta, sigma, estimate=False)
    still = count_rival_static(labels, rival.labels, evidence.data, min_share) * has_static_support(evidence, rival)
    return count.masked_scatter(asked, still)


def status_of_labels(
    evidence: Evidence, best: Labelled, free: Tensor, undetermined: Tensor, odd: Tensor | bool, spare: int, least: tuple[int, int]
) -> Tensor:
    """``(b,)`` from the labels, whether a part of the motion is free by the noise, or exactly, and whether the inliers are ``odd``;
    ``least`` matches in all, or known static ones."""
    usable = evidence.data.weights > 0
    present = usable.sum(-1)
    known = torch.zeros_like(present) if evidence.data.static is None else (usable & evidence.data.static).sum(-1)
    conditions = evidence.static_conditions, evidence.invariant.codim
    accident = odd | agrees_too_little(best.labels, evidence.data.weights, conditions, evidence.invariant.dof + spare)
    accident = accident | (best.sigma * torch.stack(evidence.norm.scales).amax(0) > NOISY)
    return status_of_alignment(free, accident, undetermined, (present < least[0]) & (known < least[1]))


def without_failures(refined: Solution, status: Tensor, labels: Tensor, worst: Tensor) -> tuple[Solution, Tensor]:
    """The solution with its status and inliers, zero where there is none, and the labels, all outliers there."""
    none = is_failure(status)
    labels = torch.where(none[:, None], OUTLIER, labels)
    assert refined.sigma is not None and refined.covariance is not None
    solution = replace(
        refined,
        status=status,
        tensor=select(~none, refined.tensor, 0.0),
        normalized=select(~none, refined.normalized, 0.0),
        covariance=torch.where(none[:, None, None], 0.0, refined.covariance),
        sigma=torch.where(none, 0.0, refined.sigma),
        uncertainty=torch.where(none, 0.0, worst),
        inliers=labels != OUTLIER,
    )
    return solution, labels


def trajectory_lines(evidence: Evidence, best: Labelled, most: int) -> Tensor:
    """How many lines hold the paths of all moving matches ``(b,)``, counted up to ``most``."""
    parts = evidence.problem(best.labels).parts(best.theta)
    places = torch.stack([evidence.views[0], *(apply(m, x) for m, x in zip(parts, evidence.views[1:], strict=True))])
    ends = torch.stack([places[b] - places[a] for a, b in combinations(range(len(places)), 2)])
    length, widest = ends.norm(dim=-1).max(dim=0)
    along = ends.gather(0, widest[None, ..., None].expand_as(ends[:1]))[0] / length[..., None].clamp(min=1e-12)
    problem = torch.arange(len(length), device=length.device)
    left, count = best.labels == MOVING, torch.zeros(len(length), dtype=torch.long, device=length.device)
    noise = MAX_TRAJECTORY_DISTANCE * (evidence.norm.scales[0] * best.sigma)[:, None]
    for _ in range(most):
        longest = torch.where(left, length, -1.0).argmax(-1)
        centre, direction, base = places[:, problem, longest].mean(0), along[problem, longest], length[problem, longest]
        offset = places - centre[:, None]
        across = offset - (offset * direction[:, None]).sum(-1, keepdim=True) * direction[:, None]
        # away from the path its line is known by angle only
        reach = 1 + offset.norm(dim=-1) / base[:, None].clamp(min=1e-12)
        count = count + left.any(-1)
        left = left & ~(across.norm(dim=-1) <= noise * reach).all(0)
        left = left.index_put((problem, longest), torch.zeros_like(problem, dtype=torch.bool))
    return count


def normalized_motion(solution: Solution) -> Tensor:
    """``(b, p)`` normalized motion of a solution."""
    return torch.cat([part.flatten(1) for part in solution.normalized_motion()], dim=-1)


# ----------------------------------------------------------------------------------------------------------------------
# Random sampling for scenes in which some points stand still: collineations from d + 2 matches, judged by their consensus.


BLOCK = 1 << 19
"""Numbers in the largest temporary of one block of the batch (4 MB)."""


def static_start(
    evidence: Evidence, given: Tensor | None, samples: int, generator: torch.Generator | None
) -> tuple[Tensor, Tensor]:
    """Motion ``(b, p)`` on which the most matches agree that they stand still, and the noise ``(b,)`` by their median."""
    pool, d = evidence.data.weights > 0, evidence.views[0].shape[-1]
    if evidence.data.static is not None:
        known = pool & evidence.data.static
        pool = torch.where((known.sum(-1) >= d + 2)[:, None], known, pool)
    scale = evidence.norm.scales[0]
    # each distance has the noise of two views
    limit = None if given is None else 2 * three_sigma(evidence.static_conditions) * (ROUGH_LABEL_FACTOR * scale * given).square()
    motion, square = _static_consensus(evidence.views, pool, limit, samples, generator)
    theta = torch.cat([part.flatten(1) for part in motion], dim=-1)
    variance = square / (2 * median(evidence.static_conditions))
    return theta, variance.nan_to_num(posinf=1.0).sqrt() / scale if given is None else given


def _static_consensus(
    views: tuple[Tensor, ...], pool: Tensor, limit: Tensor | None, samples: int, generator: torch.Generator | None
) -> tuple[tuple[Tensor, ...], Tensor]:
    """Collineations of view 2, 3, ... to view 1 on which the most matches agree, from samples of d + 2 matches, and the median
    squared distance ``(b,)``."""
    b, n, d = views[0].shape
    device = views[0].device
    shuffled = (uniform(b, n, generator=generator, device=device) + 2.0 * ~pool).argsort(dim=-1)
    count = pool.sum(-1)
    # distinct places: draw from ever fewer, and step over those already taken
    draws = uniform(b, samples, d + 2, generator=generator, device=device)
    taken: list[Tensor] = []
    for k in range(d + 2):
        place = (draws[..., k] * (count - k).clamp(min=1)[:, None]).long()
        for other in torch.stack(taken, -1).sort(dim=-1).values.unbind(-1) if taken else ():
            place = place + (place >= other)
        taken.append(place)
    chosen = torch.stack(taken, -1).clamp(max=n - 1)
    judges = shuffled[:, :NUM_SCORED_MATCHES]
    size = max(1, BLOCK // max(1, samples * judges.shape[-1] * (d + 1)))
    return map_blocks(_search, views, shuffled, chosen, judges, count, limit, size=size)


def _search(
    views: tuple[Tensor, ...], shuffled: Tensor, chosen: Tensor, judges: Tensor, count: Tensor, limit: Tensor | None
) -> tuple[tuple[Tensor, ...], Tensor]:
    index = shuffled.gather(1, chosen.flatten(1)).unflatten(1, chosen.shape[1:])
    problem = torch.arange(len(index), device=index.device)
    sampled = [homogeneous(x[problem[:, None, None], index]) for x in views]
    maps = [_collineation(sampled[0], p) for p in sampled[1:]]
    seen = [x[problem[:, None], judges] for x in views]
    square = sum(
        ((apply(matrix, x[:, None]) - seen[0][:, None]).square().sum(-1) for matrix, x in zip(maps, seen[1:], strict=True)),
        start=torch.zeros((), dtype=seen[0].dtype, device=seen[0].device),
    )
    valid = (torch.arange(judges.shape[-1], device=judges.device) < count[:, None])[:, None]
    known = torch.where(valid, square.nan_to_num(nan=torch.inf), torch.nan)
    if limit is None:
        score = known.nanmedian(-1).values
    else:
        score = torch.where(valid, torch.minimum(square, limit[:, None, None]), 0.0).sum(-1)
    best = score.argmin(-1)
    middle = known[problem, best].nanmedian(-1).values.nan_to_num(nan=torch.inf)
    return tuple(matrix[problem, best] for matrix in maps), middle


def _collineation(target: Tensor, source: Tensor) -> Tensor:
    """``(..., d + 1, d + 1)`` from d + 2 points ``(..., d + 2, d + 1)`` each; any matrix where three are on a line."""
    bases, coordinates = [], []
    for points in (target, source):
        inverse, _ = torch.linalg.inv_ex(points[..., :-1, :].mT)
        bases.append(inverse)
        coordinates.append((inverse @ points[..., -1, :, None])[..., 0])
    scaled = target[..., :-1, :].mT * (coordinates[0] / coordinates[1])[..., None, :]
    found = (scaled @ bases[1]).nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
    return found / torch.linalg.matrix_norm(found, keepdim=True).clamp(min=torch.finfo(found.dtype).tiny)


# ----------------------------------------------------------------------------------------------------------------------
# More than three views: the motion of three views carried on to all others, and what is asked of all choices of views.


NUM_RESECTION_SAMPLES = 256  # per view: 99.9 % to draw a clean one at 30 % wrong points
RESECTION_SAMPLE_SIZE = 10  # 8 determine a collineation of the plane or of space
NUM_RESECTION_ROUNDS = 4  # reweighted fits to all matches after that


def moving_points(dim: int, views: int) -> Invariant:
    """The invariant of points on straight lines of a plane or of space: for three views its tensor, for more the motion."""
    if views > 3:
        return DynamicMotion(dim, views, 2)
    return HomographyTensor() if dim == 2 else JoinTensor()


def motion_of_all(
    evidence: Evidence, solve: Callable[[tuple[Tensor, ...]], Solution], given: Tensor | None, generator: torch.Generator | None
) -> tuple[tuple[Tensor, ...], Solution]:
    """The normalized collineations ``(b, d + 1, d + 1)`` from every view to the first, and the solution of three views behind
    them."""
    count = len(evidence.views)
    three = (0, count // 2, count - 1)
    found = solve(tuple(evidence.data.views[v] for v in three))
    parts = tuple(part.reshape(-1, *part.shape[-2:]) for part in found.motion)
    parts = normalize_motion(moving_points(parts[0].shape[-1] - 1, 3), parts, [evidence.norm.transforms[v] for v in three])
    if count == 3:
        return parts, found
    sound = ~is_failure(found.status.reshape(-1))
    eye = torch.eye(parts[0].shape[-1], dtype=parts[0].dtype, device=parts[0].device).expand_as(parts[0])
    known = dict(zip(three, (eye, *(select(sound & p.isfinite().flatten(1).all(-1), p, eye) for p in parts)), strict=True))
    planes, weights, noise = _flats_of(evidence, three, torch.stack([known[v] for v in three], dim=-3), given)
    for v in range(1, count):
        if v not in known:
            known[v] = resect_view(planes, evidence.views[v], evidence.norm.scales[v] * noise, weights, generator)
    return tuple(known[v] for v in range(1, count)), found


def _flats_of(evidence: Evidence, three: tuple[int, ...], maps: Tensor, given: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Hyperplanes ``(b, n, d, d + 1)`` of view 1 that meet in the line or the point of each match, weights, and the noise
    ``(b,)``."""
    points = torch.stack([evidence.views[v] for v in three], dim=-2)
    scales = torch.stack([evidence.norm.scales[v] for v in three], dim=-1)
    dim = points.shape[-1]
    line, point = (nearest_flats(maps, points, scales, step) for step in (2, 1))
    moving, still = (at.residual.square().sum((-2, -1)) for at in (line, point))
    present = evidence.data.weights > 0
    middle = torch.where(present, moving, torch.nan).nanmedian(-1).values.nan_to_num(nan=1.0)
    noise = (middle / median(dim - 1)).sqrt().maximum(evidence.floor) if given is None else given
    square = noise.square()[:, None]
    rests = still <= three_sigma(2 * dim) * square
    if evidence.data.static is not None:
        rests = rests | evidence.data.static
    good = present & (rests | (moving <= three_sigma(dim - 1) * square))
    thin = torch.nn.functional.pad(line.hyperplanes, (0, 0, 0, 1))
    planes = torch.where(rests[..., None, None], point.hyperplanes, thin)
    return planes, evidence.data.weights * good, noise


def resect_view(planes: Tensor, x: Tensor, sigma: Tensor, weights: Tensor, generator: torch.Generator | None) -> Tensor:
    r"""The collineation A of a view whose points lie on known flats of view 1: :math:`L_i A (x_i, 1) = 0`, robustly. planes
    ``(b, n, d, d + 1)``, x ``(b, n, d)``, sigma ``(b,)``, weights ``(b, n)`` -> ``(b, d + 1, d + 1)``."""
    b, n, _, size = planes.shape
    p = homogeneous(x)
    rows = (planes[..., :, None] * p[..., None, None, :]).flatten(-2)  # (b, n, d, N N)
    drawn = uniform(b, NUM_RESECTION_SAMPLES, n, generator=generator, device=x.device).masked_fill(weights[:, None] <= 0, 2.0)
    chosen = drawn.argsort(-1)[..., : min(n, RESECTION_SAMPLE_SIZE)]
    problem = torch.arange(b, device=x.device)[:, None, None]
    maps = null_space(rows[problem, chosen].flatten(2, 3))[..., 0, :].unflatten(-1, (size, size))
    limit = (ROUGH_LABEL_FACTOR * sigma).square()[:, None] * three_sigma(size - 1)
    best = ((_squares(planes, maps, p) / limit[..., None]).clamp(max=1.0) * weights[:, None]).sum(-1).argmin(-1)
    found = maps[torch.arange(b, device=x.device), best]
    for _ in range(NUM_RESECTION_ROUNDS):
        square, length = _squares(planes, found[:, None], p)[:, 0], _lengths(planes, found[:, None])[:, 0]
        trust = weights * (limit / (limit + square)).square()
        scaled = rows * (trust.sqrt() / length)[..., None, None]
        found = null_space(scaled.flatten(1, 2))[..., 0, :].unflatten(-1, (size, size))
    return unit(found)


def _lengths(planes: Tensor, maps: Tensor) -> Tensor:
    """Size ``(b, maps, n)`` of the normals of the hyperplanes in the view."""
    normals = (planes[:, None] @ maps[:, :, None])[..., :-1]
    return normals.square().sum((-2, -1)).sqrt().clamp(min=torch.finfo(normals.dtype).tiny ** 0.25)


def _squares(planes: Tensor, maps: Tensor, p: Tensor) -> Tensor:
    """Squares ``(b, maps, n)`` of the distances of points from the hyperplanes, as if these were orthogonal."""
    h = planes[:, None] @ maps[:, :, None]
    normals = h[..., :-1].square().sum(-1).clamp(min=torch.finfo(h.dtype).tiny)
    return ((h @ p[:, None, :, :, None])[..., 0].square() / normals).sum(-1)


def three_of(data: Matches) -> list[Matches]:
    """The matches of three views that may tell by themselves whether the motion is unique: of neighbours, and of the ends."""
    count = len(data.views)
    pairs = [(1, 2)] if count == 3 else [*((v, v + 1) for v in range(1, count - 1)), (1, count - 1)]
    return [
        Matches((data.views[0], data.views[a], data.views[b]), data.weights, data.static, data.batch, data.dtype, data.device)
        for a, b in pairs
    ]
