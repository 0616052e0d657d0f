"""Projective motions of a sensor among points of space that move on straight lines."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import torch
from torch import Tensor

from dyntorch.core.fit import fit_matches
from dyntorch.core.invariant import Invariant
from dyntorch.core.limits import MIN_CONSENSUS, MIN_INFORMATION, median, three_sigma
from dyntorch.core.matches import Matches
from dyntorch.core.outcome import Notice, Status, in_order, is_failure, noting
from dyntorch.core.residual import whitened_residual
from dyntorch.core.robust import robust_fit
from dyntorch.core.solution import NOISY, Solution
from dyntorch.geometry.homogeneous import homogeneous, inhomogeneous
from dyntorch.invariants.join_tensor import JoinTensor
from dyntorch.invariants.minimal_join_tensor import MinimalJoinTensor
from dyntorch.numerics.blocks import select
from dyntorch.numerics.messages import Message
from dyntorch.tasks.align.labelling import (
    ROUGH_LABEL_FACTOR,
    THRESHOLD_SIGMAS,
    Evidence,
    Labelled,
    normalized_motion,
    static_consensus,
)
from dyntorch.tasks.align.options import AlignOptions
from dyntorch.tasks.align.result import MOVING, OUTLIER, STATIC, Alignment, AlignNotice
from dyntorch.tasks.align.several import motion_of_all, moving_points

MINIMAL = {"join": 47, "minimal_join": 47}
LABELLED = 9
"""Fewest matches where some are labelled static: five determine A and B, and room to tell static from moving."""
MOVERS, LINES = 40, 10
"""Moving matches, and lines they lie on, that determine the tensors where nothing stands still (thesis section 8.2)."""
ENOUGH = 5  # static matches that determine A and B by themselves

AMBIGUITY = Message(
    "A and B are unique, each up to its scale, unless the steps of all points keep one ratio (constant velocity): then they are "
    "known up to a velocity common to all points; use {arg:model='constant_velocity'}. A match that agrees in two views only "
    "counts as "
    "moving: a point that paused and a static point mismatched in the third view look the same."
)


MORE_VIEWS = Message(
    "The collineations are unique, each up to its scale, unless the steps of all points keep one ratio (constant velocity): then "
    "they are known up to a velocity common to all points. A match that agrees in all views but one counts as moving: a point that "
    "paused and a static point mismatched in that view look the same."
)


MIN_JOIN_MATCHES = 60  # from which on the join tensor itself gives a start
NUM_JOIN_SAMPLES = 1000  # of five: 97 % to draw five static ones where they are 20 % of all
MAX_JOIN_STEPS = 30  # of the final refinement
MAX_JOIN_DEVIATION = 0.5  # of the worst direction of a motion of norm 1, above which it is not known at all
MIN_SPARE_JOIN = 10  # conditions beyond the degrees of freedom that inliers must fulfil
MAX_JOIN_TRAJECTORY_DISTANCE = 3.0  # standard deviations of the noise from a trajectory line


def align_join(
    data: Matches, threshold: float | None, model: str, generator: torch.Generator | None, options: AlignOptions
) -> Alignment:
    """:func:`dyntorch.align_points` with a join tensor, for checked matches."""
    evidence = Evidence.of(moving_points(3, len(data.views)), data)
    best = _search(evidence, threshold, model, generator, options)
    solution, labels, worst = _solve(evidence, best)
    outcome = replace(solution, inliers=labels != OUTLIER).back(data)
    A, B, *others = outcome.motion
    assert outcome.sigma is not None and outcome.covariance is not None
    return Alignment(
        A=A,
        B=B,
        labels=data.back(labels),
        status=outcome.status,
        sigma=outcome.sigma,
        covariance=outcome.covariance,
        ambiguity=MORE_VIEWS if others else AMBIGUITY,
        notices=_notices(evidence, replace(best, labels=labels), worst, solution.status, data.batch, options),
        solution=outcome,
        others=tuple(others),
    )


def _search(
    evidence: Evidence, threshold: float | None, model: str, generator: torch.Generator | None, options: AlignOptions
) -> Labelled:
    """The best of the motions that static samples and the tensors lead to."""
    given = None if threshold is None else torch.full_like(evidence.floor, threshold / THRESHOLD_SIGMAS).maximum(evidence.floor)
    starts = [_from_static(evidence, given, generator, options)]
    if evidence.data.count >= MINIMAL[model]:
        starts.append(_from_tensor(MinimalJoinTensor(), evidence, given, generator))
    full, size = model == "join" and evidence.data.count >= MIN_JOIN_MATCHES, len(evidence.floor)
    if given is None:
        if full:
            starts.append(_from_tensor(JoinTensor(), evidence, None, generator))
        # the least estimate is that of a motion most matches agree with; it may be low, for static matches show half the noise
        sigma = 2 * torch.stack([noise for _, noise in starts]).amin(0).maximum(evidence.floor)
        theta = _improve_starts(evidence, [start for start, _ in starts], sigma, sampled=True)
    else:
        sigma, theta = given, _improve_starts(evidence, [start for start, _ in starts], given, sampled=True)
        # where the noise is known, so is whether the motion of the minimal tensor is the right one
        doubt = _doubt(evidence, theta[-size:], given) if full else torch.zeros_like(given)
        if bool(doubt.any()):
            last, _ = _from_tensor(JoinTensor(), evidence.weighted(doubt), given, generator)
            theta = torch.cat([theta, _improve_starts(evidence, [last], given, sampled=False)])
    count = len(theta) // size if size else 1
    best = evidence.repeated(count).cost(theta, sigma.repeat(count)).unflatten(0, (count, size)).argmin(0)
    chosen = theta[best * size + torch.arange(size, device=best.device)]
    return evidence.settled(chosen, sigma, estimate=given is None)


def _improve_starts(evidence: Evidence, starts: list[Tensor], sigma: Tensor, *, sampled: bool) -> Tensor:
    """All starts after :meth:`Evidence.improved`, ``(starts b, p)``; ``sampled``: the first is from a minimal sample."""
    count, size = len(starts), len(sigma)
    rough = (torch.arange(count, device=sigma.device).repeat_interleave(size) == 0) & sampled
    return evidence.repeated(count).improved(torch.cat(starts), sigma.repeat(count), rough)


def _doubt(evidence: Evidence, theta: Tensor, sigma: Tensor) -> Tensor:
    """1 for problems ``(b,)`` whose motion fewer than half of the matches agree with, or fewer moving ones than determine one."""
    labels, invariant = evidence.labels(theta, sigma), evidence.invariant
    moving, agreeing, present = ((labels == MOVING).sum(-1), (labels != OUTLIER).sum(-1), (evidence.data.weights > 0).sum(-1))
    return ((2 * agreeing <= present) | (moving * invariant.codim <= invariant.dof)).to(theta)


def _from_static(
    evidence: Evidence, given: Tensor | None, generator: torch.Generator | None, options: AlignOptions
) -> tuple[Tensor, Tensor]:
    """Motion on which the most matches agree that they stand still, and the noise by their median."""
    data = evidence.data
    pool = data.weights > 0
    if data.static is not None:
        known = pool & data.static
        pool = torch.where((known.sum(-1) >= ENOUGH)[:, None], known, pool)
    scale = evidence.norm.scales[0]
    # each distance has the noise of two views
    limit = None if given is None else 2 * three_sigma(evidence.still) * (ROUGH_LABEL_FACTOR * scale * given).square()
    motion, variance = static_consensus(evidence.views, pool, limit, options.num_samples or NUM_JOIN_SAMPLES, generator)
    theta = torch.cat([part.flatten(1) for part in motion], dim=-1)
    if given is not None:
        return theta, given
    # static_consensus divides by the median of 4 conditions; three views of space have 6
    return theta, (variance * median(4) / median(evidence.still)).nan_to_num(posinf=1.0).sqrt() / scale


def _from_tensor(
    invariant: Invariant, evidence: Evidence, given: Tensor | None, generator: torch.Generator | None
) -> tuple[Tensor, Tensor]:
    """Motion of a tensor by robust estimation, and the noise that the median of all matches shows."""
    data = evidence.data
    # of so few matches no half determines a motion, so that the noise cannot be told from outliers
    plain = (given is None and data.count < 3 * JoinTensor.dof) or not len(data.weights)

    def solve(views: tuple[Tensor, ...]) -> Solution:
        if plain:
            return fit_matches(invariant, replace(data, views=views, static=None))
        return robust_fit(invariant, *views, threshold=given, weights=data.weights, generator=generator)

    motion, found = motion_of_all(evidence, solve, given, generator)
    theta = torch.cat([part.flatten(1) for part in motion], dim=-1)
    usable = theta.isfinite().all(-1) & ~is_failure(found.status.reshape(-1))
    identity = torch.eye(4, dtype=theta.dtype, device=theta.device).flatten().repeat(len(motion)) / 2
    theta = torch.where(usable[:, None], theta, identity)
    if given is not None:
        return theta, given
    if plain:
        refined = evidence.refined(theta, torch.where(data.weights > 0, MOVING, OUTLIER), MAX_JOIN_STEPS)
        assert refined.sigma is not None
        theta, noise = normalized_motion(refined), refined.sigma
    else:
        parts = evidence.problem(torch.zeros_like(data.weights)).parts(theta)
        moving = whitened_residual(evidence.invariant, parts, evidence.views, evidence.norm.scales).square().sum(-1)
        middle = torch.where(data.weights > 0, moving, torch.nan).nanmedian(dim=-1).values
        noise = (middle / median(evidence.invariant.codim)).sqrt()
    return theta, torch.where(usable & noise.isfinite(), noise, torch.inf)


def _solve(evidence: Evidence, best: Labelled) -> tuple[Solution, Tensor, Tensor]:
    """The solution with its status, the final labels (none where there is no motion), and the worst standard deviation."""
    refined = evidence.refined(best.theta, best.labels, MAX_JOIN_STEPS)
    theta = normalized_motion(refined)
    values, spread = evidence.information(theta, best.labels)
    labels = evidence.labels(theta, best.sigma, spread)
    worst = best.sigma * values[:, 0].clamp(min=torch.finfo(values.dtype).tiny).rsqrt() * torch.stack(evidence.norm.scales).amax(0)
    status = _status(evidence, replace(best, labels=labels), worst, values[:, 0] <= MIN_INFORMATION * values[:, -1])
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
    )
    return solution, labels, worst


def _status(evidence: Evidence, best: Labelled, worst: Tensor, undetermined: Tensor) -> Tensor:
    usable = evidence.data.weights > 0
    present = usable.sum(-1)
    known = torch.zeros_like(present) if evidence.data.static is None else (usable & evidence.data.static).sum(-1)
    still, moving = (best.labels == STATIC).sum(-1), (best.labels == MOVING).sum(-1)
    conditions = evidence.still * still + evidence.invariant.codim * moving
    accident = (still + moving < MIN_CONSENSUS * present) | (conditions < evidence.invariant.dof + MIN_SPARE_JOIN)
    accident = accident | (best.sigma * torch.stack(evidence.norm.scales).amax(0) > NOISY)
    status = torch.where(worst > MAX_JOIN_DEVIATION, int(Status.AMBIGUOUS), torch.zeros_like(present))
    status = torch.where(accident, int(Status.NO_CONSENSUS), status)
    status = torch.where(undetermined, int(Status.DEGENERATE), status)
    return torch.where((present < MINIMAL["join"]) & (known < ENOUGH), int(Status.TOO_FEW), status)


def _notices(
    evidence: Evidence, best: Labelled, worst: Tensor, status: Tensor, batch: tuple[int, ...], options: AlignOptions
) -> tuple[Notice, ...]:
    solved = ~is_failure(status)
    moving, still = (best.labels == MOVING).sum(-1), (best.labels == STATIC).sum(-1)
    found, note = noting(batch)
    note(AlignNotice.FEW_MOVING, moving, solved & (moving < MOVERS) & (still < ENOUGH), least=f"{MOVERS} and more")
    note(AlignNotice.NEAR_STATIC, moving, solved & (moving < LINES) & (still >= ENOUGH), case="matches")
    lines = trajectory_lines(evidence, best)
    note(AlignNotice.FEW_LINES, lines, solved & (moving > lines) & (lines < LINES), least=LINES)
    note(AlignNotice.UNCERTAIN, worst, solved & (worst > options.max_deviation), case="matches", what="motion")
    return in_order(found)


def trajectory_lines(evidence: Evidence, best: Labelled) -> Tensor:
    """How many lines hold the paths of all moving matches ``(b,)``, counted up to LINES."""
    parts = evidence.problem(best.labels).parts(best.theta)
    others = [inhomogeneous(homogeneous(x) @ m.mT) for m, x in zip(parts, evidence.views[1:], strict=True)]
    places = torch.stack([evidence.views[0], *others])
    ends = torch.stack([places[b] - places[a] for a, b in combinations(range(len(places)), 2)])
    length, widest = ends.norm(dim=-1).max(dim=0)
    along = ends.gather(0, widest[None, ..., None].expand(1, -1, -1, 3))[0] / length[..., None].clamp(min=1e-12)
    problem = torch.arange(len(length), device=length.device)
    left, count = best.labels == MOVING, torch.zeros(len(length), dtype=torch.long, device=length.device)
    noise = MAX_JOIN_TRAJECTORY_DISTANCE * (evidence.norm.scales[0] * best.sigma)[:, None]
    for _ in range(LINES):
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
