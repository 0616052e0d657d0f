"""align_planar(): the motion of a camera over a plane on which points stand still, move, or are mismatched."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from dyntorch.blocks import one_thread
from dyntorch.chi_square import three_sigma
from dyntorch.fitting import fit_matches
from dyntorch.invariants.homography_tensor import HomographyTensor
from dyntorch.matches import Matches, matches
from dyntorch.robust import robust_fit
from dyntorch.solution import NOISY, Solution, Status, failed
from dyntorch.tasks.alignment import MOVING, OUTLIER, STATIC, Alignment
from dyntorch.tasks.labelling import ROUGH, SIGMAS, Evidence, Labelled, joined
from dyntorch.tasks.notices import check_threshold
from dyntorch.tasks.planar_notices import planar_notices, tensor_rank, undecided, unverified
from dyntorch.tasks.static_consensus import static_consensus

SAMPLES = 1000
"""Samples of four matches: 96 % to draw four static ones where they are 24 % of all (30 % static, 20 % outliers)."""
STEPS = 30
MINIMAL = HomographyTensor.minimal()
FEW = 3 * HomographyTensor.dof
"""Matches below which half of them do not determine a motion with certainty: noise and outliers cannot be told apart by it."""
LABELLED = 9
"""Fewest matches where some are labelled static: nine rows each for 26 equations, and room to tell static from moving."""
INDETERMINATE = 1e-13
"""Information on the worst direction of the motion over that on the best, below which it is rounding error."""
AMBIGUOUS = 0.5
"""Standard deviation of the worst direction of the motion, of norm 1, above which the motion is not known at all."""
SINGULAR = 1e-3
"""Ratio of the singular values of a homography in normalized coordinates (usually above 0.1) that no camera gives a plane."""
CONSENSUS = 0.4
"""Share of inliers below which the best motion may be an accident."""
UNIFORM, DOUBTFUL = 1.3, 0.7
"""Noise that the inliers show over the assumed noise, above which they fill the limits evenly as random matches do (1.7), where
their share is below the second figure."""
SPARE = 8
"""Conditions beyond the 16 degrees of freedom that inliers must fulfil: a minimal set fulfils 16 whatever it is."""

AMBIGUITY = (
    "A and B are unique, each up to its scale. A match that agrees in two views only counts as moving: a point that paused and a "
    "static point mismatched in the third view look the same."
)


@one_thread
def align_planar(
    x1: Tensor,
    x2: Tensor,
    x3: Tensor,
    *,
    threshold: float | None = 1.5,
    weights: Tensor | None = None,
    static: Tensor | None = None,
    generator: torch.Generator | None = None,
) -> Alignment:
    r"""Motion of a camera from three views of a plane, with a label for every match: static, moving or outlier.

    Points of the plane stand still or move on straight lines, at any speed; none has to be known to do either:

    .. math:: \det[p_1, A p_2, B p_3] = 0, \qquad p_1 \sim A p_2 \sim B p_3 \text{ for static points.}

    Two searches start it: :func:`dyntorch.robust_fit` of the homography tensor, which needs no static point, and samples of
    four matches, which need no moving one.  From the best motion of each, labels and motion are refined in turns: static
    matches by their disagreement (four conditions each), moving ones by their Sampson distance.  The motion that explains the
    matches better is returned.

    Args:
        x1: ``(*batch, n, 2)`` points of view 1; NaN = missing.
        x2: the same points in view 2.
        x3: the same points in view 3.
        threshold: greatest Sampson distance of a moving inlier, in the unit of the points: three standard deviations of the
            noise of one coordinate.  None estimates the noise of every problem (at least half of the matches must be inliers).
        weights: ``(*batch, n)`` not negative; 0 leaves a match out.
        static: ``(*batch, n)`` bool, matches known not to move (they may still be outliers).
        generator: source of the random samples.

    Returns:
        An :class:`~dyntorch.tasks.alignment.Alignment`.

    Raises:
        ValueError: fewer than 26 matches (9 with ``static``), shapes, dtypes or devices that do not agree, a threshold that is
            not positive.

    Source: thesis chapter 2 and section 8.1; Shashua and Wolf, ECCV 2000.

    Example:
        >>> import torch, dyntorch as dyn
        >>> from dyntorch import scenes
        >>> draw = torch.Generator().manual_seed(0)
        >>> scene = scenes.planar(n=80, sigma=0.5, static=0.3, outliers=0.1, generator=draw)
        >>> result = dyn.align_planar(*scene.views, threshold=1.5, generator=draw)
        >>> bool((result.A - scene.motion[0]).norm() < 0.01)
        True
        >>> float((result.labels == scene.labels).double().mean()) > 0.9
        True
    """
    check_threshold(threshold)
    data = matches(HomographyTensor(), (x1, x2, x3), weights, static)
    least = MINIMAL if static is None else LABELLED
    if data.count < least:
        remedy = "add matches" if static is not None else f"add matches, or label static ones (static=; then {LABELLED} suffice)"
        raise ValueError(f"align_planar needs at least {least} matches, got {data.count}; {remedy}")
    with torch.no_grad():
        return _align(data, threshold, generator)


def _align(data: Matches, threshold: float | None, generator: torch.Generator | None) -> Alignment:
    evidence = Evidence.of(HomographyTensor(), data)
    solution, best, tensor = _solved(evidence, _search(evidence, threshold, generator))
    outcome = solution.back(data)
    A, B = outcome.motion
    assert outcome.sigma is not None and outcome.covariance is not None
    return Alignment(
        A=A,
        B=B,
        labels=data.back(best.labels),
        status=outcome.status,
        sigma=outcome.sigma,
        covariance=outcome.covariance,
        ambiguity=AMBIGUITY,
        warnings=planar_notices(evidence, best, tensor, solution.status, data.batch),
        unverified=data.back(unverified(evidence, best) & (best.labels == MOVING)),
        solution=outcome,
    )


def _search(evidence: Evidence, threshold: float | None, generator: torch.Generator | None) -> Labelled:
    """The better one of the motions that the two searches start from, with its labels."""
    size = len(evidence.floor)
    given = None if threshold is None else torch.full_like(evidence.floor, threshold / SIGMAS).maximum(evidence.floor)
    starts = [_from_static(evidence, given, generator)]
    if MINIMAL <= evidence.data.count < FEW:
        starts.append(_from_all(evidence, given))
    if size and evidence.data.count >= (MINIMAL if given is not None else FEW):
        starts.append(_from_tensor(evidence, given, generator))
    count = len(starts)
    # the smaller estimate is that of a motion most matches agree with; it may still be low, for static matches show half the noise
    sigma = given if given is not None else 1.5 * torch.stack([noise for _, noise in starts]).amin(0).maximum(evidence.floor)
    several, noise = evidence.repeated(count), sigma.repeat(count)
    rough = torch.arange(count, device=sigma.device).repeat_interleave(size) == 0
    theta = several.improved(torch.cat([start for start, _ in starts]), noise, rough)
    cost = torch.where(_singular(theta), torch.inf, several.cost(theta, noise))
    best = cost.unflatten(0, (count, size)).argmin(0)
    chosen = theta[best * size + torch.arange(size, device=best.device)]
    return evidence.settled(chosen, sigma, estimate=given is None)


def _singular(theta: Tensor) -> Tensor:
    """Whether a motion ``(b, 18)`` maps the plane into a line or a point, which fulfils every match and explains none."""
    values = torch.linalg.svdvals(theta.nan_to_num().unflatten(-1, (2, 3, 3)))
    return (values[..., 2] < SINGULAR * values[..., 0]).any(-1)


def _from_static(evidence: Evidence, given: Tensor | None, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
    """Motion on which the most matches agree that they stand still, and the noise by their median."""
    data = evidence.data
    pool = data.weights > 0
    if data.static is not None:
        known = pool & data.static
        pool = torch.where((known.sum(-1) >= 4)[:, None], known, pool)
    scale = evidence.norm.scales[0]
    # each distance has the noise of two views
    limit = None if given is None else 2 * three_sigma(4) * (ROUGH * scale * given).square()
    motion, variance = static_consensus(evidence.views, pool, limit, SAMPLES, generator)
    theta = torch.cat([part.flatten(1) for part in motion], dim=-1)
    return theta, variance.nan_to_num(posinf=1.0).sqrt() / scale if given is None else given


def _from_tensor(evidence: Evidence, given: Tensor | None, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
    """Motion of the homography tensor by robust estimation, and the noise by the median distance from it."""
    data = evidence.data
    found = robust_fit(HomographyTensor, *data.views, threshold=given, weights=data.weights, generator=generator)
    theta, usable = _usable(evidence, found)
    if given is not None:
        return theta, given
    moving, _ = evidence.residuals(theta)
    noise = torch.where(data.weights > 0, moving[..., 0].abs(), torch.nan).nanmedian(dim=-1).values / 0.6745
    if found.sigma is not None:
        # what its inliers show is less than the median, where there are many outliers
        noise = torch.where((found.status == Status.OK) & (found.sigma > 0), torch.minimum(found.sigma, noise), noise)
    return theta, torch.where(usable & noise.isfinite(), noise, torch.inf)


def _from_all(evidence: Evidence, given: Tensor | None) -> tuple[Tensor, Tensor]:
    """Motion as if all matches were moving inliers, and the noise that they then show."""
    data = evidence.data
    theta, usable = _usable(evidence, fit_matches(HomographyTensor(), replace(data, static=None)))
    refined = evidence.refined(theta, torch.where(data.weights > 0, MOVING, OUTLIER), STEPS)
    assert refined.sigma is not None
    return joined(refined), torch.where(usable, refined.sigma, torch.inf) if given is None else given


def _usable(evidence: Evidence, found: Solution) -> tuple[Tensor, Tensor]:
    """The motion of a solution, the identity where it failed, and where it did not."""
    theta = evidence.parameters(tuple(part.reshape(-1, 3, 3) for part in found.motion))
    usable = theta.isfinite().all(-1) & ~failed(found.status)
    identity = torch.eye(3, dtype=theta.dtype, device=theta.device).flatten().repeat(2)
    return torch.where(usable[:, None], theta, identity), usable


def _solved(evidence: Evidence, best: Labelled) -> tuple[Solution, Labelled, tuple[Tensor, Tensor]]:
    """The solution with its status, the final labels, none where there is no motion, and what the tensor alone rests on."""
    refined = evidence.refined(best.theta, best.labels, STEPS)
    theta = joined(refined)
    values, spread = evidence.information(theta, best.labels)
    labels = evidence.labels(theta, best.sigma, spread)
    worst = best.sigma * values[:, 0].clamp(min=torch.finfo(values.dtype).tiny).rsqrt()
    assert refined.sigma is not None and refined.covariance is not None
    best = Labelled(theta, labels, best.sigma)
    tensor = tensor_rank(evidence.data.restricted(labels != OUTLIER), evidence, best.sigma)
    free = (worst > AMBIGUOUS) | undecided(evidence, best, tensor)
    status = _status(evidence, best, refined.sigma, free, values[:, 0] <= INDETERMINATE * values[:, -1])
    none = failed(status)
    labels = torch.where(none[:, None], OUTLIER, labels)
    zero = none[:, None, None]
    solution = replace(
        refined,
        status=status,
        tensor=torch.where(zero[..., None], 0.0, refined.tensor),
        normalized=torch.where(zero[..., None], 0.0, refined.normalized),
        covariance=torch.where(zero, 0.0, refined.covariance),
        sigma=torch.where(none, 0.0, refined.sigma),
        uncertainty=torch.where(none, 0.0, worst),
        inliers=labels != OUTLIER,
    )
    return solution, replace(best, labels=labels), tensor


def _status(evidence: Evidence, best: Labelled, shown: Tensor, free: Tensor, undetermined: Tensor) -> Tensor:
    """``(b,)`` from the inliers, the noise they show, and whether a part of the motion is free by the noise, or exactly."""
    usable = evidence.data.weights > 0
    present = usable.sum(-1)
    known = torch.zeros_like(present) if evidence.data.static is None else (usable & evidence.data.static).sum(-1)
    still, moving = (best.labels == STATIC).sum(-1), (best.labels == MOVING).sum(-1)
    share = (still + moving) / present.clamp(min=1)
    accident = (
        (share < CONSENSUS)
        | ((share < DOUBTFUL) & (shown > UNIFORM * best.sigma))
        | (4 * still + moving < HomographyTensor.dof + SPARE)
    )
    accident = accident | (best.sigma * torch.stack(evidence.norm.scales).amax(0) > NOISY)
    status = torch.full_like(present, int(Status.OK))
    status = torch.where(free, int(Status.AMBIGUOUS), status)
    status = torch.where(accident, int(Status.NO_CONSENSUS), status)
    status = torch.where(undetermined, int(Status.DEGENERATE), status)
    return torch.where((present < MINIMAL) & (known < 4), int(Status.TOO_FEW), status)
