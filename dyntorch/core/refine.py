"""Batched Levenberg-Marquardt: the motion that minimizes the Sampson distances of all matches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from dyntorch.core.invariant import Invariant
from dyntorch.core.kernel_fit import refined_kinds
from dyntorch.core.matches import Matches, check_plain, largest_weights, matches, relative_weights
from dyntorch.core.matrix import gram
from dyntorch.core.normalize import Normalization, denormalization_derivative, denormalize, relative
from dyntorch.core.outcome import Notice, NoticeCode, in_order, is_failure, notices
from dyntorch.core.residual import multilinear_derivative, residual_derivative, whitened_residual
from dyntorch.core.solution import Solution
from dyntorch.native import library
from dyntorch.numerics.blocks import each, map_blocks, one_thread, select, workers
from dyntorch.numerics.function_transforms import is_transformed, over_problems
from dyntorch.numerics.least_squares import (
    LeastSquaresOptions,
    Minimum,
    NormalEquations,
    flat_directions,
    flatten_parts,
    follow_minimum,
    minimize,
    parts_of,
)
from dyntorch.numerics.nullspace import spectrum

# ----------------------------------------------------------------------------------------------------------------------
# The least squares problem that refinement solves: whitened residuals of all matches in the entries of a motion.


BLOCK = 1 << 18
"""Entries of the Jacobian per block of the batch: larger ones leave the cache, smaller ones pay for the calls."""


@dataclass(frozen=True)
class Problem(NormalEquations):
    """Least squares in the entries of a motion, over a block of problems."""

    invariant: Invariant
    shapes: tuple[torch.Size, ...]
    views: tuple[Tensor, ...]
    scales: tuple[Tensor, ...]
    weights: Tensor
    static: Tensor | None
    free: Tensor | None = None

    def parts(self, theta: Tensor) -> tuple[Tensor, ...]:
        """The motion ``(b, *shape)`` of parameters ``(b, p)``."""
        return parts_of(theta, self.shapes)

    def subset(self, keep: Tensor) -> Problem:
        """Only some of the problems."""
        data = self.views, self.scales, self.weights, self.static
        return Problem(self.invariant, self.shapes, *each(lambda x: x[keep], data), self.free)

    def residual(self, theta: Tensor, piece: slice) -> tuple[Tensor, Tensor]:
        """Weighted whitened residuals ``(b, rows)`` of some of the matches, and their derivative ``(b, p, rows)``."""
        views, weights = tuple(x[:, piece] for x in self.views), self.weights[:, piece]
        still = None if self.static is None else self.static[:, piece]
        moving = weights if still is None else weights * (still == 0)
        value, derivative = self.linearize_moving(theta, views)
        root = moving.sqrt()[..., None].expand(*moving.shape, value.shape[1] // max(1, moving.shape[1])).flatten(1)
        value, derivative = value * root, derivative * root[:, None]
        if still is None:
            return value, derivative
        values, slopes = [value], [derivative]
        for free in range(1, 2 if still.dtype == torch.bool else self.invariant.within):
            resting = (weights * (still == free)).sqrt()[..., None]
            more = self.linearize_static(theta, views, free)
            values.append((more[0].unflatten(1, (views[0].shape[1], -1)) * resting).flatten(1))
            wide = resting.expand(*resting.shape[:2], more[0].shape[1] // max(1, resting.shape[1])).flatten(1)
            slopes.append(more[1] * wide[:, None])
        return torch.cat(values, dim=-1), torch.cat(slopes, dim=-1)

    def linearize_moving(self, theta: Tensor, views: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
        """Unweighted residuals of matches that may move, and their derivative."""
        invariant, motion = self.invariant, self.parts(theta)
        known = invariant.linearize(motion, views, self.scales)
        if known is not None:
            return known
        nothing = each(lambda x: x[:0], (motion, views, self.scales))
        if invariant.whitened_residual(*nothing) is not None:
            return residual_derivative(invariant.whitened_residual, motion, views, self.scales)  # type: ignore[arg-type]
        # one row per match: by hand through the tensor, several times cheaper than forward mode through the matches
        tensor, slope = invariant.compose_derivative(motion)
        value, derivative = multilinear_derivative(invariant, tensor.unflatten(1, invariant.shape()), views, self.scales)
        return value, slope @ derivative.mT

    def linearize_static(self, theta: Tensor, views: tuple[Tensor, ...], free: int = 1) -> tuple[Tensor, Tensor]:
        """Unweighted residuals of matches that do not move, or move in so many dimensions less, and their derivative."""
        smaller = self.invariant.confine(free)
        if smaller is not None:
            return replace(self, invariant=smaller).linearize_moving(theta, views)
        return residual_derivative(self.invariant.whitened_static_residual, self.parts(theta), views, self.scales)

    def pieces(self, width: int) -> list[slice]:
        """The matches in slices whose Jacobians fit into memory, whatever their number."""
        n = self.weights.shape[-1]
        step = max(256, 8 * BLOCK // (max(1, width) * max(1, self.weights.shape[0])))
        return [slice(start, start + step) for start in range(0, max(n, 1), step)]

    def normal_equations(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cost ``(b,)``, gradient ``(b, p)`` and Gauss-Newton matrix ``(b, p, p)``."""
        cost = torch.zeros(theta.shape[0], dtype=theta.dtype, device=theta.device)
        gradient, matrix = torch.zeros_like(theta), theta.new_zeros(*theta.shape, theta.shape[-1])
        for piece in self.pieces(theta.shape[-1]):
            value, derivative = self.residual(theta, piece)
            cost = cost + value.square().sum(-1)
            gradient = gradient + (derivative @ value[..., None])[..., 0]
            matrix = matrix + derivative @ derivative.mT
        return torch.where(cost.isfinite(), cost, torch.inf), gradient, matrix


# ----------------------------------------------------------------------------------------------------------------------
# constrain(): the tensor of a motion with the least algebraic error, between the linear fit and refinement.


CONSTRAINED_ITERATIONS = 30
FREE = 1e-8  # least damping: leaves the gauge of the motions where it is to 1e-10


@dataclass(frozen=True)
class Algebraic(NormalEquations):
    r"""The algebraic error :math:`u^T G u` of tensors :math:`u = A(M) / |A(M)|`, with the Gram G of the matches."""

    invariant: Invariant
    shapes: tuple[torch.Size, ...]
    gram: Tensor
    """``(b, D, D)``."""

    def parts(self, theta: Tensor) -> tuple[Tensor, ...]:
        return parts_of(theta, self.shapes)

    def subset(self, keep: Tensor) -> Algebraic:
        return Algebraic(self.invariant, self.shapes, self.gram[keep])

    def cost(self, theta: Tensor) -> Tensor:
        """``(b,)``."""
        tensor = self._columns(self.invariant.compose(*self.parts(theta)).flatten(1))
        return ((self.gram @ tensor[..., None])[..., 0] * tensor).sum(-1)

    def normal_equations(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        tensor, slope = (self._columns(x) for x in self.invariant.compose_derivative(self.parts(theta)))
        image = (self.gram @ tensor[..., None])[..., 0]
        cost = (image * tensor).sum(-1)
        bent = slope @ self.gram
        return torch.where(cost.isfinite(), cost, torch.inf), (slope @ image[..., None])[..., 0], bent @ slope.mT

    def _columns(self, tensor: Tensor) -> Tensor:
        """Flat tensors ``(b, ..., D)`` with their entries in the order of the columns of the estimation matrix."""
        return self.invariant.basis_of(tensor.unflatten(-1, self.invariant.shape()))[..., 0, :]


@one_thread
def constrain(solution: Solution, *, iterations: int = CONSTRAINED_ITERATIONS) -> Solution:
    r"""Replace the tensor of a linear fit by that of a motion: minimize :math:`|E\,A(M)| / |A(M)|` over the motion M.

    The null vector of noisy matches is the tensor of no motion, and what it decomposes into may be far from the best one
    (projections from :math:`P^6` at one pixel of noise: useless).  This stage searches among the tensors of motions, from
    several starts, by Levenberg-Marquardt; :func:`dyntorch.refine`, which minimizes distances in the images, does it first
    where an invariant needs it.

    Args:
        solution: of :func:`dyntorch.fit`, for an invariant of nullity one.
        iterations: at most so many steps.

    Returns:
        The solution with the new tensor and motion; failed problems stay as they are.

    Raises:
        ValueError: an invariant of nullity above one or with copies, whose tensors do not stand alone.

    Source: Hartley and Zisserman, sections 11.3 and 16.3 (algebraic minimization), for the motion of any invariant.

    Example:
        >>> import torch, dyntorch as dyn
        >>> draw = torch.Generator().manual_seed(0)
        >>> M, Y = (torch.randn(*size, generator=draw, dtype=torch.float64) for size in ((3, 3, 5), (60, 5)))
        >>> seen = torch.einsum("vij,nj->vni", M, Y)
        >>> views = seen[..., :2] / seen[..., 2:] + 1e-3 * torch.randn(3, 60, 2, generator=draw, dtype=torch.float64)
        >>> found = constrain(dyn.fit(dyn.GrassmannTensor(4, (2, 2, 1)), *views))
        >>> bool(torch.allclose(found.invariant.compose(*found.motion).abs(), found.tensor.abs()))
        True
    """
    return constrain_matches(solution, solution.matches, iterations)


def constrain_matches(solution: Solution, data: Matches, iterations: int = CONSTRAINED_ITERATIONS) -> Solution:
    """:func:`constrain` by other weights of the same matches."""
    invariant = solution.invariant
    if invariant.nullity > 1 or invariant.copies is not None:
        raise ValueError(f"the tensors of {invariant!r} do not stand alone; use refine")
    with torch.no_grad():
        motion = algebraic_motion(solution, data, iterations)
        normalized = solution.base().compose(*motion)
        tensor = data.back(denormalize(invariant, normalized, solution.normalization.actions))
        good = ~is_failure(solution.status.reshape(-1)).to(normalized.device)
        return replace(
            solution,
            tensor=select(data.back(good), tensor, solution.tensor),
            normalized=select(good, normalized, solution.normalized),
            refined=motion,
        )


def algebraic_motion(solution: Solution, data: Matches, iterations: int = CONSTRAINED_ITERATIONS) -> tuple[Tensor, ...]:
    """The motion of least algebraic error in normalized coordinates, from the best start of each problem."""
    invariant, norm = solution.invariant, solution.normalization
    base, tensor = solution.base(), solution.normalized.detach()
    views = tuple(x.detach() for x in norm.apply(invariant, data.views))
    starts = tuple(part[None] for part in base.motion_of(tensor)) if base.starts is None else base.starts(tensor)
    shapes = tuple(part.shape[2:] for part in starts)
    options = LeastSquaresOptions(iterations=iterations, settling_steps=2, least_damping=FREE)

    def run(tries: Tensor, views: tuple[Tensor, ...], weights: Tensor, static: Tensor | None) -> Tensor:
        matrix = gram(norm.primitives, views, weights, static)
        trace = matrix.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None]
        problem = Algebraic(base, shapes, matrix / trace.clamp(min=torch.finfo(trace.dtype).tiny))
        theta = _select_start(tries, problem.cost)
        return minimize(problem, problem.evaluate((theta,)), options).theta[0]

    theta = torch.cat([part.flatten(2) for part in starts], dim=-1).transpose(0, 1)
    size = max(1, min(BLOCK // (invariant.width() * theta.shape[-1]), -(-len(theta) // workers())))
    return parts_of(map_blocks(run, theta, views, relative_weights(data.weights), data.static, size=size), shapes)


def _select_start(starts: Tensor, cost: Callable[[Tensor], Tensor]) -> Tensor:
    """The start ``(b, p)`` of least cost, of ``(b, tries, p)``."""
    if starts.shape[1] == 1:
        return starts[:, 0]
    costs = torch.stack([cost(theta) for theta in starts.unbind(1)], dim=1).nan_to_num(nan=torch.inf)
    return starts.gather(1, costs.argmin(1)[:, None, None].expand(-1, 1, starts.shape[-1]))[:, 0]


ITERATIONS = 30
ENOUGH_AT_FIRST = 10_000
"""Matches that the first descent takes of twice as many or more; the last one, from where it ends, takes all."""


@one_thread
def refine(
    solution: Solution,
    *views: Tensor,
    weights: Tensor | None = None,
    static: Tensor | None = None,
    dimensions: Tensor | None = None,
    iterations: int = ITERATIONS,
    **given: Tensor,
) -> Solution:
    r"""Refine the motion of a solution: minimize :math:`\sum_n w_n d_n^2` over its entries by Levenberg-Marquardt.

    :math:`d_n` is the Sampson distance of match n, for several conditions per match its vector form
    :math:`Q^{-1/2} e`.  The internal constraints of the tensor hold exactly, because its motion is what is varied.  Matches
    labelled static are held to agree in all views (the segmented refinement).  The cost never rises; where the solution had
    failed it is returned as it was.

    ``tensor``, ``motion`` and ``sigma`` are differentiable with respect to matches and weights, to every order: by the implicit
    function theorem at the minimum, whatever steps led there; a gradient costs one Hessian of the cost.  Inliers of a robust
    fit stay the inliers that they are.  A descent that ended before its minimum has a notice, ``unfinished`` (none within
    ``torch.func``); the covariance carries no gradient, and a problem that failed has gradients of 0.

    Args:
        solution: from :func:`dyntorch.fit` or :func:`dyntorch.robust_fit`.
        *views: the same matches.
        weights: ``(*batch, n)``; default: the solution's inliers, else its weights.
        static: ``(*batch, n)`` bool, matches that do not move; default: those labelled in the fit.
        dimensions: ``(*batch, n)`` integers in place of it, as in :func:`dyntorch.fit`.
        iterations: at most so many steps.
        **given: what else the invariant takes.

    Returns:
        The solution with ``tensor``, ``motion``, ``sigma`` (noise per coordinate, in the unit of the matches, that the
        residuals show) and ``covariance`` of the entries of the motion (rank ``invariant.dof``: its scale is fixed; infinite
        where no match is left to estimate the noise).

    Raises:
        ValueError: matches that do not fit the solution.

    Source: theory of nonlinear estimation as in Hartley and Zisserman, appendix A6.

    Example:
        >>> import torch, dyntorch as dyn
        >>> from dyntorch import scenes
        >>> scene = scenes.planar(n=60, sigma=0.5, generator=torch.Generator().manual_seed(0))
        >>> solution = dyn.fit(dyn.HomographyTensor, *scene.views)
        >>> refined = dyn.refine(solution, *scene.views)
        >>> bool((refined.sigma - 0.5).abs() < 0.15)
        True
    """
    invariant, views = solution.invariant.bind_arguments(views, **given)
    data = matches(invariant, views, weights, static, dimensions, mapped=True)
    old = solution.matches
    if data.batch != old.batch or data.count != old.count:
        raise ValueError(
            f"these matches have batch {data.batch} and {data.count} matches, the solution was fitted to batch {old.batch} and "
            f"{old.count}; give the same ones"
        )
    if weights is None:
        keep = old.weights if solution.inliers is None else solution.inliers.reshape(old.weights.shape).to(old.weights)
        data = replace(data, weights=data.weights * (keep > 0 if solution.inliers is not None else keep))
    if data.static is None and old.static is not None:
        data = replace(data, static=old.static)
    if not is_transformed(data.views, data.weights, data.static, solution.normalized, solution.normalization.transforms):
        return refine_matches(solution, data, iterations)
    return _of_transformed(solution, data, iterations)


def _of_transformed(solution: Solution, data: Matches, iterations: int) -> Solution:
    """:func:`refine` within ``torch.func``."""
    invariant, norm, status = solution.invariant, solution.normalization, solution.status.reshape(-1)
    check_plain(invariant)
    # the tensor of problems that failed stays: flat, in float64
    tensors = solution.tensor.reshape(*status.shape, *solution.tensor.shape[solution.status.ndim :]).to(data.weights.dtype)

    def refine_flat(
        state: tuple[Tensor, Tensor, Tensor, tuple[Tensor, ...] | None],
        transforms: tuple[Tensor, ...],
        views: tuple[Tensor, ...],
        weights: Tensor,
        static: Tensor | None,
    ) -> tuple[Tensor, Tensor, tuple[Tensor, ...], Tensor, Tensor]:
        tensor, normalized, status, refined = state
        flat = Matches(views, weights, static, weights.shape[:1], weights.dtype, weights.device)
        norm_of_flat = Normalization.of(invariant, transforms)
        nothing = torch.zeros_like(normalized.flatten(1)[:, 0])
        start = Solution(invariant, tensor, nothing, flat, norm_of_flat, normalized, refined=refined, status=status)
        result = refine_matches(start, flat, iterations)
        assert result.refined is not None and result.sigma is not None and result.covariance is not None
        return result.tensor, result.normalized, result.refined, result.sigma, result.covariance

    state = tensors, solution.normalized, status, solution.refined
    tensor, normalized, refined, sigma, covariance = over_problems(
        refine_flat, state, norm.transforms, data.views, data.weights, data.static
    )
    return replace(
        solution,
        tensor=data.back(tensor),
        normalized=normalized,
        refined=refined,
        sigma=data.back(sigma),
        covariance=data.back(covariance),
    )


def refine_matches(solution: Solution, data: Matches, iterations: int = ITERATIONS) -> Solution:
    """:func:`refine` for checked matches."""
    invariant, motion, recorded = solution.invariant, solution.normalized_motion(), needs_gradient(solution, data)
    with torch.no_grad():
        minimum = descend(solution, data, motion, iterations)
        if not recorded:
            return with_covariance(move_to(solution, motion, minimum), data, minimum)
        open_ = unfinished_notices(minimum, invariant.dof, data.batch)
    shapes = tuple(part.shape[1:] for part in motion)
    theta, cost = differentiable_minimum(solution, data, shapes, minimum)
    minimum = Minimum((theta,), cost, minimum.terms, minimum.steps)
    refined = with_covariance(move_to(solution, motion, minimum), data, minimum)
    return replace(refined, notices=in_order((*solution.notices, *open_)))


def descend(solution: Solution, data: Matches, motion: tuple[Tensor, ...], iterations: int) -> Minimum:
    """The minimum next to a motion in normalized coordinates, its cost in the unit of the matches."""
    invariant, base, shapes = solution.invariant, solution.base(), tuple(part.shape[1:] for part in motion)
    starts = [flatten_parts(motion).detach()]
    if invariant.starts is not None and solution.refined is None:
        starts.append(flatten_parts(algebraic_motion(solution, data)))
    frames = tuple(t.detach() for t in solution.frames())
    views = tuple(p.move(x, t).detach() for p, x, t in zip(invariant.primitives, data.views, frames, strict=True))
    kinds, options = refined_kinds(invariant, data), LeastSquaresOptions(iterations=iterations)

    def run(
        starts: Tensor, views: tuple[Tensor, ...], scales: tuple[Tensor, ...], weights: Tensor, static: Tensor | None
    ) -> Minimum:
        if kinds:
            form, given = int(invariant.constraint or 0), (kinds, views, weights, torch.stack(scales, -1), starts[:, 0])
            theta, cost, *terms, steps = library.refine(*given, constraint=form, iterations=iterations, rules=options.rules())
            return Minimum((theta,), cost, tuple(terms), steps)
        problem = Problem(base, shapes, views, scales, weights, static)
        theta = _select_start(starts, lambda theta: problem.normal_equations(theta)[0])
        return minimize(problem, problem.evaluate((theta,)), options)

    # a block for every thread at least: threads inside of small operations cost more than they bring
    theta = torch.stack(starts, dim=1)
    theta = torch.where(theta.isfinite(), theta, torch.zeros_like(theta))
    scales, unit = relative([t[:, 0, 0] for t in frames])
    rounds = [(views, data.weights, data.static)]
    if data.count >= 2 * ENOUGH_AT_FIRST:
        rounds.insert(0, each(lambda x: x[:, :: data.count // ENOUGH_AT_FIRST], rounds[0]))
    for some, weights, static in rounds:
        size = max(1, min(BLOCK // max(1, weights.shape[1] * theta.shape[-1]), -(-len(theta) // workers())))
        minimum = map_blocks(run, theta, some, scales, weights, static, size=size)
        theta = minimum.theta[0][:, None]
    return in_unit_of_matches(minimum, unit)


def in_unit_of_matches(minimum: Minimum, unit: Tensor) -> Minimum:
    """A minimum whose cost, gradient and matrix were those of coordinates in which the unit of the matches has size ``(b,)``."""
    square = unit.square()
    terms = tuple(x / square[(..., *[None] * (x.ndim - 1))] for x in minimum.terms)
    return Minimum(minimum.theta, minimum.cost / square, terms, minimum.steps)


def move_to(solution: Solution, old: tuple[Tensor, ...], minimum: Minimum) -> Solution:
    """The solution in normalized coordinates with the refined motion, where refinement was possible; elsewhere with the old one."""
    shapes, good = tuple(part.shape[1:] for part in old), _is_moved(solution, minimum)
    motion = parts_of(minimum.theta[0], shapes)
    if good.device.type == "cpu" and bool(good.all()):
        return replace(solution, normalized=solution.base().compose(*motion), refined=motion)
    motion = tuple(select(good, new, part) for new, part in zip(motion, old, strict=True))
    # tensors of copies have the axis of the copies behind the batch, like the transforms of the solution
    normalized = solution.base().compose(*(select(good, part, _any(part)) for part in motion))
    return replace(solution, normalized=select(good, normalized, solution.normalized), refined=motion)


def with_covariance(moved: Solution, data: Matches, minimum: Minimum) -> Solution:
    """The solution that moved to a minimum, with its tensor, noise and covariance in the coordinates of the matches."""
    invariant, frames, good = moved.invariant, tuple(t.detach() for t in moved.frames()), _is_moved(moved, minimum)
    shapes = tuple(part.shape[1:] for part in moved.normalized_motion())
    tensor = denormalize(invariant, moved.normalized, moved.normalization.actions)
    sigma = _noise(invariant, data, minimum.cost)
    with torch.no_grad():
        derivative = denormalization_derivative(invariant, parts_of(minimum.theta[0], shapes), frames)
        covariance = _covariance(derivative, minimum, invariant.dof, sigma * largest_weights(data.weights).sqrt())
    return replace(
        moved,
        tensor=data.back(tensor),
        sigma=data.back(select(good, sigma, torch.zeros_like(sigma))),
        covariance=data.back(select(good, covariance, torch.zeros_like(covariance))),
    )


def _is_moved(solution: Solution, minimum: Minimum) -> Tensor:
    """Where refinement was possible, ``(b,)``."""
    return minimum.cost.isfinite() & ~is_failure(solution.status.reshape(-1).to(minimum.cost.device))


def _noise(invariant: Invariant, data: Matches, cost: Tensor) -> Tensor:
    """Noise ``(b,)`` of one coordinate that the residuals show; infinite where no match is left to tell it."""
    conditions = torch.full_like(data.weights, float(invariant.codim))
    if data.static is not None:
        for free in range(1, invariant.within):
            smaller = invariant.confine(free)
            still = sum(p.freedom() for p in invariant.primitives[1:]) if smaller is None else smaller.codim
            conditions = torch.where(data.static == free, float(still), conditions)
    spare = ((data.weights > 0) * conditions).sum(-1) - invariant.dof
    mean = cost / largest_weights(data.weights).clamp(min=torch.finfo(cost.dtype).tiny)
    return torch.where(spare > 0, (mean / spare.clamp(min=1)).sqrt(), torch.inf)


def _covariance(derivative: Tensor, minimum: Minimum, dof: int, scale: Tensor) -> Tensor:
    r"""Covariance ``(b, p, p)`` of the motion in the coordinates of the matches: :math:`\sigma^2 D H^+ D^T`, H of rank dof."""
    values, vectors = spectrum(minimum.terms[1])
    count = min(dof, values.shape[-1])
    values, vectors = values[..., -count:], vectors[..., -count:]
    root = vectors * values.clamp(min=1e-12 * values[..., -1:].clamp(min=torch.finfo(values.dtype).tiny)).rsqrt()[..., None, :]
    spread = derivative.mT @ root
    covariance = (spread @ spread.mT) * scale.square()[:, None, None]
    # a motion without a matrix in the coordinates of the matches (singular) is not known at all, like one without spare matches
    determined = scale.isfinite() & covariance.isfinite().flatten(1).all(-1)
    return torch.where(determined[:, None, None], covariance, torch.inf)


def _any(part: Tensor) -> Tensor:
    """A harmless motion in place of one that failed."""
    if part.ndim == 3:
        return torch.eye(part.shape[-2], part.shape[-1], dtype=part.dtype, device=part.device).expand_as(part)
    return torch.ones_like(part)


# ----------------------------------------------------------------------------------------------------------------------
# The gradient of refinement: that of the minimum, by the implicit function theorem.


GRADIENT_BLOCK = 1 << 21
"""Numbers of the matches of all copies of a block of problems, whose Hessian needs one copy per parameter: 16 MB."""


UNFINISHED_DECREASE = 1e-6
"""Share of the cost that the next step would still take above which gradients are not those of a minimum.  Homography tensors (60
matches, 0.5 px) after 1, 2 and 3 steps: 2e-5, 9e-9, 7e-12, with gradients off by 1e-4, 1e-6, 2e-8."""
UNFINISHED_LENGTH = 1e-6
"""Least length of that step, of parameters of norm 1: of exact matches the cost is all rounding."""


class RefineNotice(NoticeCode):
    """What limits a refinement."""

    UNFINISHED = (
        "unfinished",
        "the descent ended before the minimum: its next step would lower the cost by {value:.1g} of it, and gradients are those of "
        "a minimum that was not reached; raise {arg:iterations}",
    )
    """Refinement took all its steps, and gradients were wanted."""


def needs_gradient(solution: Solution, data: Matches) -> bool:
    """Whether gradients are recorded of what refinement depends on."""
    given = *data.views, data.weights, *solution.normalization.transforms
    return torch.is_grad_enabled() and any(x.requires_grad for x in given)


def differentiable_minimum(
    solution: Solution, data: Matches, shapes: tuple[torch.Size, ...], minimum: Minimum
) -> tuple[Tensor, Tensor]:
    """Parameters ``(b, p)`` of the minimum and its cost ``(b,)``, in the unit of the matches, with their derivatives."""
    invariant, theta = solution.invariant, minimum.theta[0]
    count, labelled = len(data.views), data.static is not None
    cost = _cost(invariant, shapes, count, labelled)
    free = flat_directions(minimum.terms[1], theta.shape[-1] - invariant.dof)
    flat = *data.views, data.weights, *solution.normalization.transforms, *((data.static,) if data.static is not None else ())
    numbers = sum(x.numel() for x in data.views) * theta.shape[-1]
    size = max(1, GRADIENT_BLOCK * len(theta) // max(1, numbers))

    def block(theta: Tensor, free: Tensor, *flat: Tensor) -> tuple[Tensor, Tensor]:
        at = follow_minimum(cost, theta, free, *flat)
        return at, cost(at, *flat)

    return map_blocks(block, theta, free, *flat, size=size)


def _cost(invariant: Invariant, shapes: tuple[torch.Size, ...], count: int, labelled: bool) -> Callable[..., Tensor]:
    """What refinement minimizes, as a function of parameters, views, weights, transforms and labels, one after the other."""

    def cost(theta: Tensor, *flat: Tensor) -> Tensor:
        views, weights, transforms = flat[:count], flat[count], flat[count + 1 : 2 * count + 1]
        label = flat[-1] if labelled else torch.zeros_like(weights, dtype=torch.bool)
        frames = tuple(t.reshape(t.shape[0], *t.shape[-2:]) for t in transforms)
        moved = tuple(p.move(x, t) for p, x, t in zip(invariant.primitives, views, frames, strict=True))
        scales, unit = relative([t[:, 0, 0] for t in frames])
        base, motion = invariant.normalize(transforms), parts_of(theta, shapes)
        total = whitened_residual(base, motion, moved, scales).square().sum(-1) * torch.where(label == 0, weights, 0.0)
        for free in range(1, (2 if label.dtype == torch.bool else invariant.within) if labelled else 1):
            smaller = base.confine(free)
            static = base.whitened_static_residual if smaller is None else partial(whitened_residual, smaller)
            total = total + static(motion, moved, scales).square().sum(-1) * torch.where(label == free, weights, 0.0)
        return total.sum(-1) / unit.square()

    return cost


def unfinished_notices(minimum: Minimum, dof: int, batch: tuple[int, ...]) -> list[Notice]:
    """A notice for every problem whose next step would still be long and lower its cost."""
    gradient, matrix = minimum.terms
    values, vectors = spectrum(matrix)
    count = min(dof, values.shape[-1])
    values = values[..., -count:].clamp(min=torch.finfo(values.dtype).tiny)
    along = (vectors[..., -count:].mT @ gradient[..., None])[..., 0]
    share = (along.square() / values).sum(-1) / minimum.cost.clamp(min=torch.finfo(values.dtype).tiny)
    open_ = (share > UNFINISHED_DECREASE) & ((along / values).norm(dim=-1) > UNFINISHED_LENGTH) & minimum.cost.isfinite()
    return notices(RefineNotice.UNFINISHED, share, open_, batch)
