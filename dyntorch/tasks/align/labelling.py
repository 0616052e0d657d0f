"""Static, moving or outlier: labels from a motion, and the motion from the labels, in turns."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyntorch.core.invariant import Invariant
from dyntorch.core.limits import median, three_sigma
from dyntorch.core.matches import Matches
from dyntorch.core.normalize import Normalization, normalization, normalize_motion
from dyntorch.core.refine import Problem, refine_matches
from dyntorch.core.residual import whiten, whitened_residual
from dyntorch.core.solution import Solution
from dyntorch.geometry.homogeneous import apply, homogeneous
from dyntorch.numerics.blocks import each, map_blocks, uniform
from dyntorch.numerics.nullspace import spectrum
from dyntorch.tasks.align.result import MOVING, OUTLIER, STATIC

NUM_LABEL_ROUNDS = 3  # of labelling and refining with the noise known
NUM_LABEL_ROUNDS_UNKNOWN_NOISE = 6  # turns with the noise to be found as well
NOISE_TOLERANCE = 0.02  # relative change of the noise that needs no further round
THRESHOLD_SIGMAS = 3.0  # a threshold, in standard deviations of the noise of one coordinate
ROUGH_LABEL_FACTOR = 3.0  # width of the first labels over that of the noise, where the motion comes from a minimal sample
MAX_WIDENING = 4.0  # of a limit by the uncertainty of the motion: a moving match called static gives a wrong motion
NUM_LABEL_STEPS = 6  # of Levenberg-Marquardt between two labellings
NUM_SCORED_MATCHES = 256  # that judge a hypothesis: enough to tell 5 % of agreement from none


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
    def still(self) -> int:
        """Conditions that a static match fulfils."""
        return sum(p.freedom() for p in self.invariant.primitives[1:])

    def repeated(self, count: int) -> Evidence:
        """The same problems several times, one block after the other."""

        def again(x: Tensor) -> Tensor:
            return x.repeat(count, *([1] * (x.ndim - 1)))

        views, weights, static = each(again, (self.data.views, self.data.weights, self.data.static))
        data = replace(self.data, views=views, weights=weights, static=static, batch=weights.shape[:1])
        transforms, actions = each(again, (self.norm.transforms, self.norm.actions))
        norm = Normalization(transforms, self.norm.primitives, actions)
        return Evidence(self.invariant, data, norm, each(again, self.views), again(self.floor))

    def weighted(self, weights: Tensor) -> Evidence:
        """With the matches of each problem weighted by ``(b,)``; 0 leaves a problem out."""
        return replace(self, data=replace(self.data, weights=self.data.weights * weights[:, None]))

    def parameters(self, motion: tuple[Tensor, ...]) -> Tensor:
        """``(b, p)`` from motions ``(b, ...)`` in the coordinates of the matches."""
        parts = normalize_motion(self.invariant, motion, self.norm.transforms)
        return torch.cat([part.flatten(1) for part in parts], dim=-1)

    def problem(self, labels: Tensor) -> Problem:
        """Least squares over the inliers, as refinement sees it."""
        shapes = tuple(
            torch.Size((self.norm.transforms[frame.target or 0].shape[-1],) * (1 if frame.vector else 2))
            for frame in self.invariant.motion
        )
        weights = self.data.weights * (labels != OUTLIER)
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
        still, path = three_sigma(self.still), three_sigma(self.invariant.codim)
        other = still + (moving.square().sum(-1) / variance).clamp(max=path)
        if self.data.static is not None:
            other = torch.where(self.data.static, still + path, other)
        cost = torch.minimum(resting.square().sum(-1) / variance, other)
        return (self.data.weights * cost.nan_to_num(nan=still + path)).sum(-1)

    def labels(self, theta: Tensor, sigma: Tensor, spread: Tensor | None = None) -> Tensor:
        """``(b, n)``; ``spread (b, p, p)`` is the covariance of theta for noise 1, which widens the limits."""
        moving, resting = self.residuals(theta)
        variance = sigma.square()[:, None]
        path, still = moving.square().sum(-1), resting.square().sum(-1)
        limits = [three_sigma(c) * variance for c in (self.invariant.codim, self.still)]
        agree = [path <= limits[0], still <= limits[1]]
        if spread is not None:
            pieces = [self._widened(theta, spread, piece) for piece in self._pieces(theta)]
            for k, (plain, limit) in enumerate(zip((path, still), limits, strict=True)):
                widened = torch.cat([piece[k] for piece in pieces], dim=-1)
                agree[k] = agree[k] | ((widened <= limit) & (plain <= MAX_WIDENING**2 * limit))
        if self.data.static is not None:
            agree[0] = agree[0] & ~self.data.static
        labels = torch.where(agree[1], STATIC, torch.where(agree[0], MOVING, OUTLIER))
        return torch.where(self.data.weights > 0, labels, OUTLIER)

    def _pieces(self, theta: Tensor) -> list[slice]:
        return self.problem(torch.zeros_like(self.data.weights)).pieces(theta.shape[-1])

    def _widened(self, theta: Tensor, spread: Tensor, piece: slice) -> tuple[Tensor, Tensor]:
        """Squares ``(b, piece)`` of the two residuals whitened by the uncertainty of the motion as well."""
        views = tuple(x[:, piece] for x in self.views)
        problem = self.problem(torch.zeros_like(self.data.weights))
        squares = []
        for value, derivative in (problem.moving(theta, views), problem.resting(theta, views)):
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

    def refined(self, theta: Tensor, labels: Tensor, steps: int) -> Solution:
        """Segmented refinement: moving matches by their Sampson distance, static ones by their disagreement."""
        problem = self.problem(labels)
        zero = torch.zeros(len(theta), dtype=torch.long, device=theta.device)
        parts = problem.parts(theta)
        tensor = self.invariant.compose(*parts)
        data = replace(self.data, weights=problem.weights, static=problem.static)
        nothing = torch.zeros_like(theta[:, 0])
        start = Solution(self.invariant, tensor, nothing, data, self.norm, tensor, status=zero, refined=parts)
        return refine_matches(start, data, steps)

    def improved(self, theta: Tensor, sigma: Tensor, rough: Tensor) -> Tensor:
        """One labelling and refinement; where ``rough (b,)``, the motion comes from a minimal sample of static matches."""
        labels = self.labels(theta, torch.where(rough, ROUGH_LABEL_FACTOR * sigma, sigma))
        # what a rough motion says about moving matches is left to chance
        labels = torch.where(rough[:, None] & (labels == MOVING), OUTLIER, labels)
        return normalized_motion(self.refined(theta, labels, NUM_LABEL_STEPS))

    def settled(self, theta: Tensor, sigma: Tensor, *, estimate: bool) -> Labelled:
        """Label and refine in turns, until the labels stay; ``estimate``: and the noise with them."""
        labels, steady = self.labels(theta, sigma), not estimate
        for _ in range(NUM_LABEL_ROUNDS_UNKNOWN_NOISE if estimate else NUM_LABEL_ROUNDS):
            _, spread = self.information(theta, labels)
            new = self.labels(theta, sigma, spread)
            if bool((new == labels).all()) and steady:
                break
            labels = new
            found = self.refined(theta, labels, NUM_LABEL_STEPS)
            theta = normalized_motion(found)
            if estimate and found.sigma is not None:
                old, sigma = sigma, torch.where(found.sigma.isfinite() & (found.sigma > 0), found.sigma, sigma).maximum(self.floor)
                steady = bool(((sigma - old).abs() <= NOISE_TOLERANCE * old).all())
        return Labelled(theta, labels, sigma)


def normalized_motion(solution: Solution) -> Tensor:
    """``(b, p)`` normalized motion of a solution."""
    return torch.cat([part.flatten(1) for part in solution.normalized_motion()], dim=-1)


# ----------------------------------------------------------------------------------------------------------------------
# Random sampling for scenes in which some points stand still: collineations from d + 2 matches, judged by their consensus.


BLOCK = 1 << 19
"""Numbers in the largest temporary of one block of the batch (4 MB)."""


def static_consensus(
    views: tuple[Tensor, ...],
    pool: Tensor,
    limit: Tensor | None,
    samples: int,
    generator: torch.Generator | None,
) -> tuple[tuple[Tensor, ...], Tensor]:
    r"""Collineations of view 2, 3, ... to view 1 on which the most matches agree, from samples of d + 2 matches. views
    ``(b, n, d)``, pool ``(b, n)``, limit ``(b,)`` -> ``(b, d + 1, d + 1)``."""
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
    valid = torch.arange(judges.shape[-1], device=judges.device) < count[:, None]
    ordered = torch.where(valid[:, None], square, torch.inf)
    middle = ((valid.sum(-1) - 1) // 2).clamp(min=0)[:, None].expand(-1, square.shape[1])
    if limit is None:
        score = ordered.sort(dim=-1).values.gather(-1, middle[..., None])[..., 0]
    else:
        score = torch.where(valid[:, None], torch.minimum(square, limit[:, None, None]), 0.0).sum(-1)
    best = score.argmin(-1)
    chosen_square = ordered[problem, best].sort(dim=-1).values.gather(-1, middle[:, :1])[:, 0]
    return tuple(matrix[problem, best] for matrix in maps), chosen_square / (2 * median(4))


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
