"""robust_fit(): tensors from matches of which many are wrong, for every invariant and whole batches at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from dyntorch.blocks import map_blocks
from dyntorch.fitting import fit_matches
from dyntorch.invariant import Invariant, as_invariant
from dyntorch.matches import Matches, matches
from dyntorch.normalize import denormalize
from dyntorch.refinement import refine_matches
from dyntorch.residual import multilinear, whitened
from dyntorch.solution import FAILED, Solution, Status
from dyntorch.starts import Found, Search, chi, threshold_of

STARTS = (1, 16, 64)
ROUNDS = (3, 8)
"""Steps of refinement after each choice of the inliers."""
BLOCK = 1 << 16  # matches per block of the distances


def robust_fit(
    invariant: Invariant | type[Invariant],
    *views: Tensor,
    threshold: float | Tensor | None = None,
    weights: Tensor | None = None,
    generator: torch.Generator | None = None,
    starts: Sequence[int] = STARTS,
    polish: bool = True,
) -> Solution:
    """TODO"""
    invariant = as_invariant(invariant)
    with torch.no_grad():
        data = matches(invariant, views, weights)
        _check(invariant, data, starts)
        cut = None if threshold is None else _threshold(threshold, data)
        search = Search(invariant, data, generator)
        limit = search.scale() if cut is None else cut
        return _finish(search, search.run(limit, starts), limit, ROUNDS if polish else (), estimate=cut is None)


def _check(invariant: Invariant, data: Matches, starts: Sequence[int]) -> None:
    if not starts or any(count < 1 for count in starts):
        raise ValueError(f"starts must be numbers of starts >= 1, tried one after the other, got {starts!r}")
    if data.views[0].shape[0] and data.count < invariant.minimal():
        raise ValueError(f"{invariant!r} needs at least {invariant.minimal()} matches, got {data.count}; add matches")


def _threshold(threshold: float | Tensor, data: Matches) -> Tensor:
    """``(b,)``."""
    value = torch.as_tensor(threshold, dtype=torch.float64, device=data.weights.device)
    try:
        value = value.expand(data.batch).reshape(-1)
    except RuntimeError:
        raise ValueError(f"threshold must be a number or (*batch,) = {data.batch}, got {tuple(value.shape)}") from None
    if not bool((value > 0).all()):
        raise ValueError(f"threshold must be a distance > 0 in the unit of the matches, got {threshold}; None estimates it")
    return value


def _finish(search: Search, found: Found, cut: Tensor, rounds: Sequence[int], *, estimate: bool) -> Solution:
    """Refine on the inliers, choose them again, and say how it ended."""
    data = search.data
    solution = _solution(search, found)
    distance = _distances(solution)
    for steps in rounds:
        if estimate:
            cut = threshold_of(search.invariant, _sigma(search.invariant, data, distance, cut))
        inliers = (distance <= cut[:, None]) & (data.weights > 0)
        refined = refine_matches(solution, data.restricted(inliers), iterations=steps)
        new = _distances(refined)
        better = _score(data, new, cut) < _score(data, distance, cut)
        solution, distance = _choose(better, refined, solution), torch.where(better[:, None], new, distance)
    inliers = (distance <= cut[:, None]) & (data.weights > 0)
    return _judged(solution, found, inliers, _sigma(search.invariant, data, distance, cut))


def _solution(search: Search, found: Found) -> Solution:
    """The tensors found, as a solution in the coordinates of the search."""
    invariant, norm, data = search.invariant, search.norm, search.data
    tensor = found.basis if invariant.copies else found.basis[:, 0]
    tensor = tensor.unflatten(-1, tuple(p.width for p in invariant.primitives))
    lead = tensor.ndim - len(invariant.primitives)
    tensor = tensor.permute(*range(lead), *(lead + v for v in invariant.axes()))
    if invariant.nullity == 1:
        tensor = tensor.squeeze(lead - 1)
    tensor = invariant.normalized(norm.transforms).constrain(tensor)
    status = torch.full(tensor.shape[:1], int(Status.OK), device=tensor.device)
    back = data.back(denormalize(invariant, tensor, norm.actions))
    return Solution(invariant, back, data.back(status), data.back(torch.zeros_like(found.score)), data, norm, tensor)


def _distances(solution: Solution) -> Tensor:
    """Sampson distances ``(b, n)`` in the unit of the matches, as :func:`dyntorch.sampson` has them."""
    invariant, data, norm = solution.invariant, solution.matches, solution.normalization
    alone = invariant.codim == 1 and invariant.rows() == 1
    parts = (solution.normalized,) if alone else solution.normalized_motion()
    transforms = tuple(t[:, 0] for t in norm.transforms) if invariant.copies else norm.transforms
    count = len(data.views)

    def block(*tensors: Tensor) -> Tensor:
        frames, x, motion = tensors[:count], tensors[count : 2 * count], tensors[2 * count :]
        views = tuple(p.move(v, t) for p, v, t in zip(invariant.primitives, x, frames, strict=True))
        scales = tuple(t[:, 0, 0] for t in frames)
        if alone:
            return multilinear(invariant, motion[0], views, scales).abs()
        return whitened(invariant, motion, views, scales).norm(dim=-1)

    size = max(1, BLOCK // max(1, data.count))
    return map_blocks(block, *transforms, *data.views, *parts, size=size).nan_to_num(nan=torch.inf)


def _score(data: Matches, distance: Tensor, cut: Tensor) -> Tensor:
    return ((distance / cut[:, None]).square().clamp(max=1.0) * data.weights).sum(-1)


def _sigma(invariant: Invariant, data: Matches, distance: Tensor, cut: Tensor) -> Tensor:
    """Noise ``(b,)`` of one coordinate from the median distance of the inliers."""
    inliers = (distance <= cut[:, None]) & (data.weights > 0)
    middle = distance.masked_fill(~inliers, torch.nan).nanmedian(-1).values.nan_to_num(nan=0.0)
    rows = inliers.sum(-1) * invariant.codim
    return middle / chi(invariant.codim, 0.0) * (rows / (rows - invariant.dof).clamp(min=1)).clamp(min=1.0).sqrt()


def _choose(better: Tensor, new: Solution, old: Solution) -> Solution:
    """The better solution of every problem."""

    def pick(a: Tensor, b: Tensor) -> Tensor:
        mask = better.reshape(old.matches.batch).to(a.device) if a.shape[: len(old.matches.batch)] == old.matches.batch else better
        return torch.where(mask[(..., *[None] * (a.ndim - mask.ndim))], a, b)

    motion = tuple(torch.where(better[(..., *[None] * (a.ndim - 1))], a, b) for a, b in zip(new.refined or (), old.normalized_motion(), strict=True))
    return replace(
        new,
        tensor=pick(new.tensor, old.tensor),
        normalized=torch.where(better[(..., *[None] * (new.normalized.ndim - 1))], new.normalized, old.normalized),
        refined=motion,
        covariance=None if new.covariance is None else (new.covariance if old.covariance is None else pick(new.covariance, old.covariance)),
    )


def _judged(solution: Solution, found: Found, inliers: Tensor, sigma: Tensor) -> Solution:
    invariant, data = solution.invariant, solution.matches
    linear = fit_matches(invariant, data.restricted(inliers))
    status = linear.status.reshape(-1).to(inliers.device)
    status = torch.where(found.evidence < 0, status, int(Status.NO_CONSENSUS))
    few = (data.weights > 0).sum(-1) * invariant.rows() < invariant.width() - invariant.nullity
    status = torch.where(few, int(Status.TOO_FEW), status)
    failed = torch.zeros_like(few)
    for state in FAILED:
        failed = failed | (status == state)
    out = data.back(~failed)
    zero = out[(..., *[None] * (solution.tensor.ndim - out.ndim))]
    return replace(
        solution,
        tensor=torch.where(zero, solution.tensor, torch.zeros_like(solution.tensor)),
        normalized=torch.where((~failed)[(..., *[None] * (solution.normalized.ndim - 1))], solution.normalized, torch.zeros_like(solution.normalized)),
        status=data.back(status),
        uncertainty=linear.uncertainty,
        inliers=data.back(inliers & ~failed[:, None]),
        sigma=data.back(sigma),
    )
