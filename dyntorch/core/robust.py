"""robust_fit(): tensors from matches of which many are wrong, for every invariant and whole batches at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from dyntorch.core.consensus import Search, SearchResult, threshold_of
from dyntorch.core.fit import fit_matches
from dyntorch.core.invariant import Invariant, as_invariant
from dyntorch.core.kernel_fit import refined_kinds, searched_kinds
from dyntorch.core.limits import quantile
from dyntorch.core.matches import Matches, matches
from dyntorch.core.normalize import denormalize, relative
from dyntorch.core.outcome import Status, is_failure
from dyntorch.core.refine import descend, in_unit_of_matches, move_to, with_covariance
from dyntorch.core.residual import multilinear, whitened_residual
from dyntorch.core.solution import NOISY, Solution
from dyntorch.native import library
from dyntorch.numerics.blocks import map_blocks, one_thread, select, select_problems, workers
from dyntorch.numerics.least_squares import LeastSquaresOptions, Minimum, parts_of

BLOCK = 1 << 16  # matches per block of the distances
REFINEMENT_STEPS = (3, 8)
"""Steps of refinement after each choice of the inliers."""
NUM_THRESHOLD_UPDATES = 4
"""Updates of an estimated threshold per choice of the inliers."""
WIDE_THRESHOLD = 1.5
"""Distance over the threshold up to which it counts when the threshold is estimated: cut at the threshold itself the noise comes
out 14 % too small (homography tensors, 200 matches, no outliers)."""


@one_thread
def robust_fit(
    invariant: Invariant | type[Invariant],
    *views: Tensor,
    threshold: float | Tensor | None = None,
    weights: Tensor | None = None,
    generator: torch.Generator | None = None,
    starts: Sequence[int] = (1, 4, 16, 64, 256),
    polish: bool = True,
    **given: Tensor,
) -> Solution:
    r"""Fit an invariant to matches of which some, or half, are wrong: graduated non-convexity, many starts where one is not enough.

    Each tensor comes from matches weighted by :math:`w_n / \|\nabla h_n\|^2 \cdot (a / (a + d_n^2))^2`, with the Sampson distance
    :math:`d_n` and a scale a that shrinks to the threshold (Geman-McClure loss, annealed).  The first start weighs all matches
    alike.  Where what it finds could be chance, or leaves many matches just beyond the threshold, 4, 16, then 64 random
    subsets are the starts (2.5 times the minimal number of matches; for minimal samples of 8 or fewer those themselves, 32 per
    start, and until one of inliers alone was missed once in a thousand times); no more where a quarter of 16 or more starts end
    at the best answer: others would find it again.  The least truncated
    square sum (MSAC) wins, and is refined on its inliers by :func:`dyntorch.refine`.

    The status is ``NO_CONSENSUS`` where random matches would do as well: with n matches, k of them inliers, m the minimal
    number and p the chance of an inlier (measured on matches whose views are mixed up), the expected number of such finds
    :math:`(n - m) \binom{n}{k} \binom{k}{m} p^{k-m}` is not below 1.

    No gradient passes; refit with ``weights=solution.inliers.to(x.dtype)`` for one.  On the CPU the result depends, to
    rounding, on nothing but the arguments and the state of the generator.

    Args:
        invariant: an invariant class such as ``dyntorch.HomographyTensor``, or an instance of a family.
        *views: matches, one argument per view, ``(*batch, n, ...)``; NaN = missing.
        threshold: largest distance of an inlier, a number or ``(*batch,)``, in the unit of the measurements.  The distance of a
            match is that of :func:`dyntorch.sampson`: over the noise of one coordinate it follows the chi distribution with
            ``invariant.codim`` degrees of freedom, so 99 % of the inliers need 2.6 sigma (codim 1), 3.0 (2), 3.4 (3).  None:
            estimated (least median of squares, then the median of the inliers; less than half of the matches may be wrong).
        weights: ``(*batch, n)`` not negative; 0 leaves a match out.
        generator: source of all randomness.
        starts: numbers of starts, tried one after the other on the problems that are not settled; 1 is all matches.
        polish: False leaves out the refinement.
        **given: what else the invariant takes.

    Returns:
        A :class:`~dyntorch.core.solution.Solution` with ``inliers`` ``(*batch, n)``, the matches within the threshold of its
        tensor, and ``sigma`` ``(*batch,)``, the noise of one coordinate by the median of their distances.

    Raises:
        ValueError: misuse - fewer matches than the minimal number, a threshold that is not positive, shapes, dtypes or devices
            that do not agree.

    Source: Yang, Antonante, Tzoumas and Carlone 2020 (graduated non-convexity); Torr and Zisserman 2000 (MSAC); Moisan and
    Stival 2004 (when to believe it).

    Example:
        >>> import torch, dyntorch as dyn
        >>> from dyntorch import scenes
        >>> scene = scenes.planar(n=200, sigma=0.5, outliers=0.3, generator=torch.Generator().manual_seed(0))
        >>> solution = dyn.robust_fit(dyn.HomographyTensor, *scene.views, threshold=1.5)
        >>> solution
        Solution(HomographyTensor, matches=200, batch=(): 1 OK, sigma 0.48)
        >>> right = scene.labels != 0
        >>> bool(solution.inliers[right].double().mean() > 0.95), bool(solution.inliers[~right].double().mean() < 0.2)
        (True, True)
    """
    invariant, views = as_invariant(invariant).bind_arguments(views, **given)
    with torch.no_grad():
        data = matches(invariant, views, weights)
        _check(invariant, data, starts)
        cut = None if threshold is None else _threshold(threshold, data)
        if not len(data.weights):
            return _empty(fit_matches(invariant, data))
        search = Search(invariant, data, generator)
        limit = search.scale() if cut is None else cut
        return _finish(search, search.run(limit, starts), limit, REFINEMENT_STEPS if polish else (), estimate=cut is None)


def _empty(solution: Solution) -> Solution:
    """The robust fit of no problem."""
    data = solution.matches
    return replace(solution, inliers=data.back(data.weights > 0), sigma=data.back(data.weights.new_zeros(0)))


def _check(invariant: Invariant, data: Matches, starts: Sequence[int]) -> None:
    if invariant.intrinsic:
        raise ValueError(
            f"robust_fit compares views of matches, and a match of {invariant!r} stands alone; fit, see which matches "
            "dyntorch.sampson finds far off, and fit again with weights= of 0 for them"
        )
    if not starts or any(count < 1 for count in starts):
        raise ValueError(f"starts must be numbers of starts >= 1, tried one after the other, got {starts!r}")
    if data.views[0].shape[0] and data.count < invariant.minimal():
        raise ValueError(f"{invariant!r} needs at least {invariant.minimal()} matches, got {data.count}; add matches")


def _threshold(threshold: float | Tensor, data: Matches) -> Tensor:
    """``(b,)``."""
    try:
        value = torch.as_tensor(threshold, dtype=torch.float64, device=data.weights.device).expand(data.batch).reshape(-1)
    except (RuntimeError, TypeError, ValueError):
        got = tuple(threshold.shape) if isinstance(threshold, Tensor) else repr(threshold)
        raise ValueError(f"threshold must be a number or (*batch,) = {data.batch}, got {got}; None estimates it") from None
    if not bool(((value > 0) & value.isfinite()).all()):
        raise ValueError(f"threshold must be a distance > 0 in the unit of the matches, got {threshold}; None estimates it")
    return value


def _finish(search: Search, result: SearchResult, cut: Tensor, rounds: Sequence[int], *, estimate: bool) -> Solution:
    """Refine on the inliers, choose them again, and say how it ended."""
    invariant, data = search.invariant, search.data
    kinds = [] if estimate or not rounds else refined_kinds(invariant, data)
    if kinds:
        solution, distance = _polish_by_kernel(search, result, cut, rounds, kinds)
    else:
        solution, distance, cut = _polish(search, result, cut, rounds, estimate=estimate)
    cut = _update_threshold(invariant, data, distance, cut) if estimate else cut
    evidence = search.evidence(solution.normalized, cut)
    # a tensor that the matches leave open has no motion, and so no inliers by it
    exact = fit_matches(invariant, search.some.restrict(result.inliers)).status.reshape(-1).to(cut.device)
    degenerate = (exact == int(Status.DEGENERATE)) & (result.evidence < 0)
    sigma = _sigma(invariant, data, distance, cut)
    if estimate:
        # with the noise unknown, a tensor whose inliers fill the scene has found nothing
        extent = torch.stack([t.reshape(len(cut), -1, *t.shape[-2:])[:, 0, 0, 0] for t in search.norm.transforms]).amax(0)
        evidence = torch.where(sigma * extent > NOISY, 1.0, evidence)
    return _with_status(solution, evidence, degenerate, _within(data, distance, cut), sigma)


def _polish(
    search: Search, result: SearchResult, cut: Tensor, rounds: Sequence[int], *, estimate: bool
) -> tuple[Solution, Tensor, Tensor]:
    """The find refined on its inliers, which are chosen again after each round; distances ``(b, n)``; the threshold."""
    invariant, data = search.invariant, search.data
    solution = _solution(search, result)
    distance, used = distances(solution), data.weights
    best: Minimum | None = None
    motion = solution.normalized_motion() if rounds else ()
    for i, steps in enumerate(rounds):
        if estimate:
            cut = _update_threshold(invariant, data, distance, cut) * (WIDE_THRESHOLD if i + 1 < len(rounds) else 1.0)
        chosen = data.restrict(_within(data, distance, cut))
        minimum = descend(solution, chosen, motion, steps)
        moved = move_to(solution, motion, minimum)
        new = distances(moved)
        # the tensor found has more freedom than the motion, so the first motion may well cost more
        better = (_score(data, new, cut) < _score(data, distance, cut)) | (best is None)
        best = minimum if best is None else select_problems(better, minimum, best)
        used, distance = select(better, chosen.weights, used), select(better, new, distance)
        motion = tuple(select(better, part, old) for part, old in zip(moved.normalized_motion(), motion, strict=True))
        solution = replace(solution, normalized=select(better, moved.normalized, solution.normalized), refined=motion)
    if best is not None:  # one covariance, of the last descent that brought something
        solution = with_covariance(solution, replace(data, weights=used), best)
    return solution, distance, cut


def _polish_by_kernel(
    search: Search, result: SearchResult, cut: Tensor, rounds: Sequence[int], kinds: list[int]
) -> tuple[Solution, Tensor]:
    """The same by the kernel in C, with a threshold that is given."""
    invariant, data, norm = search.invariant, search.data, search.norm
    scales, unit = relative(norm.scales)
    widths = [p.dim + 1 for p in invariant.primitives]
    shapes = [torch.Size(widths[v] for v in (f.target, f.source) if v is not None) for f in invariant.motion]
    size = sum(shape.numel() for shape in shapes)
    fixed: dict[str, Any] = {"parameters": size, "constraint": int(invariant.constraint or 0), "rounds": rounds}

    def block(
        views: tuple[Tensor, ...], weights: Tensor, scales: tuple[Tensor, ...], limits: Tensor, basis: Tensor
    ) -> tuple[Tensor, ...]:
        return library.polish(
            kinds, views, weights, torch.stack(scales, dim=-1), limits, basis, **fixed, rules=LeastSquaresOptions().rules()
        )

    views = norm.apply(invariant, data.views)
    parts = (views, data.weights, scales, (cut * unit).square(), result.basis[:, 0, 0])
    basis, weights, theta, cost, *terms, distance = map_blocks(block, *parts, size=max(1, -(-len(cut) // workers())))
    minimum = in_unit_of_matches(Minimum((theta,), cost, tuple(terms), torch.zeros_like(cost)), unit)
    status = data.back(torch.full_like(cost, int(Status.OK), dtype=torch.long))
    normalized, nothing = invariant.tensor_of(basis[:, None]), data.back(torch.zeros_like(cost))
    moved = Solution(invariant, normalized, nothing, data, norm, normalized, refined=parts_of(theta, shapes), status=status)
    return with_covariance(moved, replace(data, weights=weights), minimum), distance / unit[:, None]


def _update_threshold(invariant: Invariant, data: Matches, distance: Tensor, cut: Tensor) -> Tensor:
    """The threshold that the noise of its own inliers calls for."""
    for _ in range(NUM_THRESHOLD_UPDATES):
        cut = threshold_of(invariant, _sigma(invariant, data, distance, WIDE_THRESHOLD * cut))
    return cut


def _within(data: Matches, distance: Tensor, cut: Tensor) -> Tensor:
    return (distance <= cut[:, None]) & (data.weights > 0)


def _solution(search: Search, result: SearchResult) -> Solution:
    """The tensors found, as a solution in the coordinates of the search."""
    invariant, norm, data = search.invariant, search.norm, search.data
    tensor = invariant.tensor_of(result.basis if invariant.copies else result.basis[:, 0])
    nearest = invariant.normalize(norm.transforms).constrain(tensor)
    # 0 where there is none, which all matches would fulfil
    tensor = select((nearest != 0).flatten(1).any(-1), nearest, tensor)
    status = torch.full(tensor.shape[:1], int(Status.OK), device=tensor.device)
    back = data.back(denormalize(invariant, tensor, norm.actions))
    nothing = data.back(torch.zeros_like(result.score))
    return Solution(invariant, back, nothing, data, norm, tensor, status=data.back(status))


def distances(solution: Solution) -> Tensor:
    """Sampson distances ``(b, n)`` in the unit of the matches, as :func:`dyntorch.sampson` has them."""
    invariant, data = solution.invariant, solution.matches
    kinds = searched_kinds(invariant, data.views, data.weights)
    alone = invariant.single() or bool(kinds)
    parts = (solution.normalized,) if alone else solution.normalized_motion()

    def block(frames: tuple[Tensor, ...], x: tuple[Tensor, ...], motion: tuple[Tensor, ...]) -> Tensor:
        views = tuple(p.move(v, t) for p, v, t in zip(invariant.primitives, x, frames, strict=True))
        scales, unit = relative([t[:, 0, 0] for t in frames])
        if kinds:
            basis = invariant.basis_of(motion[0])[:, 0]
            return library.distances(kinds, views, torch.stack(scales, dim=-1), basis) / unit[:, None]
        if alone:
            return multilinear(invariant, motion[0], views, scales).abs() / unit[:, None]
        return whitened_residual(invariant, motion, views, scales).norm(dim=-1) / unit[:, None]

    size = max(1, min(BLOCK // max(1, data.count), -(-len(data.weights) // workers())))
    return map_blocks(block, solution.frames(), data.views, parts, size=size).nan_to_num(nan=torch.inf)


def _score(data: Matches, distance: Tensor, cut: Tensor) -> Tensor:
    return ((distance / cut[:, None]).square().clamp(max=1.0) * data.weights).sum(-1)


def _sigma(invariant: Invariant, data: Matches, distance: Tensor, cut: Tensor) -> Tensor:
    """Noise ``(b,)`` of one coordinate from the median distance of the inliers."""
    inliers = _within(data, distance, cut)
    middle = distance.masked_fill(~inliers, torch.nan).nanmedian(-1).values.nan_to_num(nan=0.0)
    rows = inliers.sum(-1) * invariant.codim
    return middle / quantile(0.5, invariant.codim) ** 0.5 * (rows / (rows - invariant.dof).clamp(min=1)).clamp(min=1.0).sqrt()


def _with_status(solution: Solution, evidence: Tensor, degenerate: Tensor, inliers: Tensor, sigma: Tensor) -> Solution:
    """The solution with its status, inliers and noise."""
    invariant, data = solution.invariant, solution.matches
    linear = fit_matches(invariant, data.restrict(inliers))
    status = torch.where(evidence < 0, linear.status.reshape(-1).to(evidence.device), int(Status.NO_CONSENSUS))
    status = torch.where(degenerate, int(Status.DEGENERATE), status)
    few = (data.weights > 0).sum(-1) < invariant.minimal()
    status = torch.where(few, int(Status.TOO_FEW), status)
    good, covariance = ~is_failure(status), solution.covariance
    return replace(
        solution,
        tensor=select(data.back(good), solution.tensor, 0.0),
        normalized=select(good, solution.normalized, 0.0),
        status=data.back(status),
        uncertainty=linear.uncertainty,
        covariance=None if covariance is None else select(data.back(good), covariance, 0.0),
        inliers=data.back(inliers & good[:, None]),
        sigma=data.back(torch.where(good, sigma, torch.zeros_like(sigma))),
    )
