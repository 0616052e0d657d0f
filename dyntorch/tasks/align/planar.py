"""align_planar(): the motion of a camera over a plane on which points stand still, move, or are mismatched."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import torch
from torch import Tensor

from dyntorch.core.fit import fit_matches
from dyntorch.core.limits import MIN_CONSENSUS, MIN_INFORMATION, median, three_sigma
from dyntorch.core.matches import Matches, matches
from dyntorch.core.outcome import Notice, Status, in_order, is_failure, noting
from dyntorch.core.robust import robust_fit
from dyntorch.core.solution import NOISY, Solution
from dyntorch.geometry.calibrated_cameras import calibrations
from dyntorch.geometry.homogeneous import cofactors, homogeneous, inhomogeneous
from dyntorch.invariants.agreement import static_residual
from dyntorch.invariants.homography_tensor import HomographyTensor
from dyntorch.numerics.arguments import check_options, check_threshold
from dyntorch.numerics.blocks import one_thread, select
from dyntorch.numerics.messages import Message
from dyntorch.tasks.align.euclidean import euclidean
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
from dyntorch.tasks.align.several import motion_of_all, moving_points, still_but_one, three_of

# ----------------------------------------------------------------------------------------------------------------------
# What should be known about the matches of a plane before its result is trusted.


LINES, FEWEST = 4, 16
"""Trajectory lines, and moving matches, that the tensor needs where nothing stands still (thesis chapter 2)."""
NOTICES_MINIMAL = 4
"""Static matches that determine the motion."""


PLANAR_RANK_TOLERANCE = 1e-9  # singular value over the largest that rounding alone leaves
# of the weakest equation; .4 to .7 where all is static, 1.3 to 1.6 at 1 to 5 px of motion and .5 px noise
MIN_TENSOR_STRENGTH = 2.0
MIN_DETERMINED_STRENGTH = 1.2  # corrected for 26 equations: .7 to .9 where all make equal steps, .5 where all is static
MIN_STATIC_SUPPORT = 10  # static matches that decide such a family; a wrong motion makes 0 to 6 of 80 matches static
STATIC_SUPPORT_FACTOR = 3.0  # static matches for each that is expected by chance, besides
CHANCE_LIMIT_FACTOR = 3.0  # times the limit of static matches within which those that are static by chance spread evenly
MIN_LINE_WIDTH = 3.0  # standard deviations of the noise across a line of points, below which they may as well lie on it
MAX_TRAJECTORY_DISTANCE = 3.0  # standard deviations of the noise from a trajectory line
NUM_PLANAR_SAMPLES = 1000  # of four: 96 % to draw four static ones where they are 24 % of all
MAX_PLANAR_STEPS = 30  # of the final refinement
MAX_DEVIATION = 0.5  # of the worst direction of a motion of norm 1, above which it is not known at all
MIN_SINGULAR_RATIO = 1e-3  # of a homography in normalized coordinates; usually above .1
MAX_NOISE_RATIO = 1.3  # shown by the inliers over assumed; random matches fill the limits evenly (1.7)
MIN_NOISY_INLIER_SHARE = 0.7  # where the inliers show more noise than that
MIN_SPARE_PLANAR = 8  # conditions beyond the 16 degrees of freedom that inliers must fulfil


def planar_notices(
    evidence: Evidence, best: Labelled, tensor: tuple[Tensor, Tensor], status: Tensor, batch: tuple[int, ...]
) -> tuple[Notice, ...]:
    """All notices on a flat batch of problems with final labels, in the order of the problems; ``tensor`` from
    :func:`tensor_rank`."""
    data = evidence.data
    rank, strength = tensor
    solved = ~is_failure(status)
    moving = best.labels == MOVING
    count = moving.sum(-1)
    found, note = noting(batch)
    full = HomographyTensor.width() - 1
    note(AlignNotice.DEGENERATE, rank, solved & (rank < full))
    note(AlignNotice.NEAR_STATIC, strength, solved & (rank >= full) & (strength < MIN_TENSOR_STRENGTH), case="tensor")
    family = (status == Status.AMBIGUOUS) & is_undecided(evidence, best, tensor)
    note(AlignNotice.OTHER_SOLUTION, (best.labels == STATIC).sum(-1), family)
    note(AlignNotice.FEW_MOVING, count, solved & (count < FEWEST), least=f"{FEWEST}")
    lines = trajectory_lines(evidence, best, moving)
    note(AlignNotice.FEW_LINES, lines, solved & (lines > 0) & (lines < LINES), least=LINES)
    note(AlignNotice.ONE_LINE, lines, solved & (lines == 1))
    thin = thinness(evidence, best.sigma)
    note(AlignNotice.COLLINEAR, thin, (data.weights > 0).any(-1) & (thin < MIN_LINE_WIDTH))
    doubtful = (best.labels == MOVING) & unverified_matches(evidence, best)
    note(AlignNotice.UNVERIFIED, doubtful.sum(-1), solved & doubtful.any(-1))
    return in_order(found)


def tensor_rank(inliers: Matches, evidence: Evidence, sigma: Tensor) -> tuple[Tensor, Tensor]:
    """Numeric rank ``(b,)`` of the estimation matrix, and how far its 26th singular value is above the noise."""
    # a row of unit length changes by about the noise of the normalized coordinates
    noise = sigma * torch.stack(evidence.norm.scales).square().mean(0).sqrt() * inliers.weights.square().sum(-1).sqrt()
    ranks, strengths = [], []
    for three in three_of(inliers):
        values = fit_matches(HomographyTensor(), three).singular_values
        ranks.append((values > PLANAR_RANK_TOLERANCE * values[:, :1]).sum(-1))
        strengths.append(values[:, -2] / noise.clamp(min=torch.finfo(values.dtype).tiny))
    return torch.stack(ranks).amax(0), torch.stack(strengths).amax(0)


def is_undecided(evidence: Evidence, best: Labelled, tensor: tuple[Tensor, Tensor]) -> Tensor:
    """Where the moving matches leave a family of motions ``(b,)``, and no more are static than some motion of it makes by
    chance."""
    rank, strength = tensor
    used = (best.labels != OUTLIER).sum(-1)
    equations = HomographyTensor.width() - 1
    spare = ((used - equations).clamp(min=1) / used.clamp(min=1)).sqrt()
    family = (rank >= equations) & (strength < MIN_DETERMINED_STRENGTH * spare)
    still = (best.labels == STATIC) & (evidence.data.weights > 0)
    if evidence.data.static is not None:
        family = family & ((still & evidence.data.static).sum(-1) < NOTICES_MINIMAL)
    square = evidence.residuals(best.theta)[1].square().sum(-1)
    limit = CHANCE_LIMIT_FACTOR**2 * three_sigma(evidence.still) * best.sigma.square()[:, None]
    beside = ((square <= limit) & ~still & (evidence.data.weights > 0)).sum(-1)
    return family & (still.sum(-1) < MIN_STATIC_SUPPORT + STATIC_SUPPORT_FACTOR * beside / (CHANCE_LIMIT_FACTOR**2 - 1))


def unverified_matches(evidence: Evidence, best: Labelled) -> Tensor:
    """Matches ``(b, n)`` that all views but one agree on as static, whatever that one says."""
    parts = evidence.problem(best.labels).parts(best.theta)
    if len(evidence.views) > 3:
        limit = three_sigma(evidence.still - 2) * best.sigma.square()[:, None]
        return still_but_one(parts, evidence.views, evidence.norm.scales, limit) & (evidence.data.weights > 0)
    first, second, third = evidence.views
    s1, s2, s3 = evidence.norm.scales
    between = cofactors(parts[0]).mT @ parts[1]  # view 3 to view 2
    pairs = (
        static_residual([parts[0]], (first, second), (s1, s2)),
        static_residual([parts[1]], (first, third), (s1, s3)),
        static_residual([between], (second, third), (s2, s3)),
    )
    limit = three_sigma(2) * best.sigma.square()[:, None]
    agree = torch.stack([pair.square().sum(-1) <= limit for pair in pairs])
    return agree.any(0) & (evidence.data.weights > 0)


def trajectory_lines(evidence: Evidence, best: Labelled, moving: Tensor) -> Tensor:
    """How many lines hold the paths of all moving matches ``(b,)``, counted up to LINES."""
    parts = evidence.problem(best.labels).parts(best.theta)
    places = torch.stack(
        [evidence.views[0], *(inhomogeneous(homogeneous(x) @ m.mT) for m, x in zip(parts, evidence.views[1:], strict=True))]
    )
    ends = torch.stack([places[b] - places[a] for a, b in combinations(range(len(places)), 2)])
    length, widest = ends.norm(dim=-1).max(dim=0)
    along = ends.gather(0, widest[None, ..., None].expand(1, -1, -1, 2))[0] / length[..., None].clamp(min=1e-12)
    normal = torch.stack([-along[..., 1], along[..., 0]], dim=-1)
    problem = torch.arange(len(length), device=length.device)
    left, count = moving, torch.zeros(len(length), dtype=torch.long, device=length.device)
    noise = MAX_TRAJECTORY_DISTANCE * (evidence.norm.scales[0] * best.sigma)[:, None]
    for _ in range(LINES):
        longest = torch.where(left, length, -1.0).argmax(-1)
        centre, across, base = places[:, problem, longest].mean(0), normal[problem, longest], length[problem, longest]
        offset = places - centre[:, None]
        distance = (offset * across[:, None]).sum(-1).abs()
        # away from the path its line is known by angle only
        reach = 1 + offset.norm(dim=-1) / base[:, None].clamp(min=1e-12)
        count = count + left.any(-1)
        left = left & ~(distance <= noise * reach).all(0)
        left = left.index_put((problem, longest), torch.zeros_like(problem, dtype=torch.bool))
    return count


def thinness(evidence: Evidence, sigma: Tensor) -> Tensor:
    """Least standard deviation of the points across their main direction, over the views, in standard deviations of the noise."""
    weights = (evidence.data.weights > 0).double()
    share = weights / weights.sum(-1, keepdim=True).clamp(min=1.0)
    found = []
    for x, scale in zip(evidence.views, evidence.norm.scales, strict=True):
        centred = x - (share[..., None] * x).sum(-2, keepdim=True)
        covariance = (share[..., None] * centred).mT @ centred
        # the smaller eigenvalue of a symmetric 2 x 2 matrix
        mean, det = covariance.diagonal(dim1=-2, dim2=-1).sum(-1) / 2, torch.linalg.det(covariance)
        across = det / (mean + (mean.square() - det).clamp(min=0).sqrt()).clamp(min=torch.finfo(mean.dtype).tiny)
        found.append(across.clamp(min=0).sqrt() / (scale * sigma.maximum(evidence.floor)))
    return torch.stack(found).amin(0)


MINIMAL = HomographyTensor.minimal()
FEW = 3 * HomographyTensor.dof
"""Matches below which half of them do not determine a motion with certainty: noise and outliers cannot be told apart by it."""
LABELLED = 9
"""Fewest matches where some are labelled static: nine rows each for 26 equations, and room to tell static from moving."""

AMBIGUITY = (
    "A and B are unique, each up to its scale. A match that agrees in two views only counts as moving: a point that paused and a "
    "static point mismatched in the third view look the same."
)
MORE_VIEWS = (
    "The collineations are unique, each up to its scale. A match that agrees in all views but one counts as moving: a point that "
    "paused and a static point mismatched in that view look the same."
)


@one_thread
def align_planar(
    x1: Tensor,
    x2: Tensor,
    x3: Tensor,
    *more: Tensor,
    threshold: float | None = 1.5,
    weights: Tensor | None = None,
    static: Tensor | None = None,
    calibration: Tensor | None = None,
    generator: torch.Generator | None = None,
    options: AlignOptions | None = None,
) -> Alignment:
    r"""Motion of a camera from three or more views of a plane, with a label for every match: static, moving or outlier.

    Points of the plane stand still or move on straight lines, at any speed; none has to be known to do either:

    .. math:: \det[p_1, A p_2, B p_3] = 0, \qquad p_1 \sim A p_2 \sim B p_3 \text{ for static points.}

    Two searches start it: :func:`dyntorch.robust_fit` of the homography tensor, which needs no static point, and samples of
    four matches, which need no moving one.  From the best motion of each, labels and motion are refined in turns: static
    matches by their disagreement (four conditions each), moving ones by their Sampson distance.  The motion that explains the
    matches better is returned.

    Of more views, three at a time give the start; labels and motion are then those of all: a static match is held to one point, a
    moving one to one line, by their distances from it in every view.

    With the calibration K of the cameras the motion is Euclidean: rotations, translations and the normal n of the plane,

    .. math:: X_v = R_v X_1 + t_v, \qquad n^T X_1 = 1, \qquad A_v^{-1} \sim K_v\,(R_v + t_v n^T)\,K_1^{-1},

    lengths in units of the distance of the plane from camera 1, which no view tells.  One homography leaves two planes
    (:func:`dyntorch.geometry.plane_motions`); the one that explains all views, by the covariance of A, B, and has the points before
    the cameras is the true one.  Where two still do, as before a camera that was at two places only, a notice says so and
    ``other_motion`` has the other.

    Args:
        x1: ``(*batch, n, 2)`` points of view 1; NaN = missing.
        x2: the same points in view 2.
        x3: the same points in view 3.
        *more: the same points in further views.
        threshold: greatest Sampson distance of a moving inlier, in the unit of the points: three standard deviations of the
            noise of one coordinate.  None estimates the noise of every problem (at least half of the matches must be inliers).
        weights: ``(*batch, n)`` not negative; 0 leaves a match out.
        static: ``(*batch, n)`` bool, matches known not to move (they may still be outliers).
        calibration: K of all views ``(3, 3)``, or of each ``(views, 3, 3)``, or ``(*batch, views, 3, 3)``, in the unit of the
            points, which are without lens distortion.  A, B and labels are the same with and without.
        generator: source of the random samples.
        options: what the search takes and expects; None is :class:`dyntorch.AlignOptions` as it is.

    Returns:
        An :class:`~dyntorch.tasks.align.result.Alignment`; ``collineations`` holds A, B and those of further views.

    Raises:
        ValueError: fewer than 26 matches (9 with ``static``), shapes, dtypes or devices that do not agree, a threshold that is
            not positive, a calibration of another shape or that is none.

    Source: thesis chapter 2 and section 8.1; Shashua and Wolf, ECCV 2000.  More views: thesis section 9.3.  Calibrated cameras:
    Faugeras and Lustman 1988.

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
        >>> K = torch.tensor([[800.0, 0.0, 320.0], [0.0, 800.0, 240.0], [0.0, 0.0, 1.0]])  # of some camera
        >>> result = dyn.align_planar(*scene.views, threshold=1.5, generator=draw, calibration=K)
        >>> result.rotations.shape, result.translations.shape, result.normal.shape
        (torch.Size([3, 3, 3]), torch.Size([3, 3]), torch.Size([3]))
    """
    options = AlignOptions() if options is None else options
    check_options(options, AlignOptions)
    check_threshold(threshold)
    data = matches(moving_points(2, 3 + len(more)), (x1, x2, x3, *more), weights, static)
    least = MINIMAL if static is None else LABELLED
    if data.count < least:
        remedy = "" if static is not None else ", or label static ones ({arg:static=}; then {labelled} suffice)"
        text = "align_planar needs at least {least} matches, got {count}; add matches" + remedy
        raise ValueError(Message(text, least=least, count=data.count, labelled=LABELLED))
    K = None if calibration is None else calibrations(calibration, data.batch, len(data.views), data.views[0])
    with torch.no_grad():
        return _align(data, threshold, K, generator, options)


def _align(
    data: Matches, threshold: float | None, K: Tensor | None, generator: torch.Generator | None, options: AlignOptions
) -> Alignment:
    evidence = Evidence.of(moving_points(2, len(data.views)), data)
    solution, best, tensor = _solve(evidence, _search(evidence, threshold, generator, options))
    outcome = solution.back(data)
    A, B, *others = outcome.motion
    assert outcome.sigma is not None and outcome.covariance is not None
    notices = planar_notices(evidence, best, tensor, solution.status, data.batch)
    turned, other = None, None
    if K is not None:
        turned, other, told = euclidean(solution, data, best.labels, K)
        notices = in_order([*notices, *told])
    return Alignment(
        A=A,
        B=B,
        labels=data.back(best.labels),
        status=outcome.status,
        sigma=outcome.sigma,
        covariance=outcome.covariance,
        ambiguity=MORE_VIEWS if others else AMBIGUITY,
        notices=notices,
        unverified=data.back(unverified_matches(evidence, best) & (best.labels == MOVING)),
        solution=outcome,
        others=tuple(others),
        rotations=None if turned is None else turned.rotations,
        translations=None if turned is None else turned.translations,
        normal=None if turned is None else turned.normal,
        other_motion=other,
    )


def _search(evidence: Evidence, threshold: float | None, generator: torch.Generator | None, options: AlignOptions) -> Labelled:
    """The better one of the motions that the two searches start from, with its labels."""
    size = len(evidence.floor)
    given = None if threshold is None else torch.full_like(evidence.floor, threshold / THRESHOLD_SIGMAS).maximum(evidence.floor)
    starts = [_from_static(evidence, given, generator, options)]
    if MINIMAL <= evidence.data.count < FEW:
        starts.append(_from_all(evidence, given, generator))
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
    """Whether a motion ``(b, 9 maps)`` takes the plane to a line or a point, which fulfils every match and explains none."""
    values = torch.linalg.svdvals(theta.nan_to_num().unflatten(-1, (-1, 3, 3)))
    return (values[..., 2] < MIN_SINGULAR_RATIO * values[..., 0]).any(-1)


def _from_static(
    evidence: Evidence, given: Tensor | None, generator: torch.Generator | None, options: AlignOptions
) -> tuple[Tensor, Tensor]:
    """Motion on which the most matches agree that they stand still, and the noise by their median."""
    data = evidence.data
    pool = data.weights > 0
    if data.static is not None:
        known = pool & data.static
        pool = torch.where((known.sum(-1) >= 4)[:, None], known, pool)
    scale = evidence.norm.scales[0]
    # each distance has the noise of two views
    limit = None if given is None else 2 * three_sigma(evidence.still) * (ROUGH_LABEL_FACTOR * scale * given).square()
    motion, variance = static_consensus(evidence.views, pool, limit, options.num_samples or NUM_PLANAR_SAMPLES, generator)
    theta = torch.cat([part.flatten(1) for part in motion], dim=-1)
    # static_consensus divides by the median of 4 conditions; more views have more
    variance = variance * (median(4) / median(evidence.still))
    return theta, variance.nan_to_num(posinf=1.0).sqrt() / scale if given is None else given


def _from_tensor(evidence: Evidence, given: Tensor | None, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
    """Motion of the homography tensor by robust estimation, and the noise by the median distance from it."""
    data = evidence.data

    def solve(views: tuple[Tensor, ...]) -> Solution:
        return robust_fit(HomographyTensor, *views, threshold=given, weights=data.weights, generator=generator)

    motion, found = motion_of_all(evidence, solve, given, generator)
    theta, usable = _usable(motion, found)
    if given is not None:
        return theta, given
    moving, _ = evidence.residuals(theta)
    codim = evidence.invariant.codim
    size = moving[..., 0].abs() / 0.6745 if codim == 1 else moving.norm(dim=-1) / median(codim) ** 0.5
    noise = torch.where(data.weights > 0, size, torch.nan).nanmedian(dim=-1).values
    if found.sigma is not None:
        # what its inliers show is less than the median, where there are many outliers
        noise = torch.where((found.status == Status.OK) & (found.sigma > 0), torch.minimum(found.sigma, noise), noise)
    return theta, torch.where(usable & noise.isfinite(), noise, torch.inf)


def _from_all(evidence: Evidence, given: Tensor | None, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
    """Motion as if all matches were moving inliers, and the noise that they then show."""
    data = evidence.data

    def solve(views: tuple[Tensor, ...]) -> Solution:
        return fit_matches(HomographyTensor(), replace(data, views=views, static=None))

    theta, usable = _usable(*motion_of_all(evidence, solve, given, generator))
    refined = evidence.refined(theta, torch.where(data.weights > 0, MOVING, OUTLIER), MAX_PLANAR_STEPS)
    assert refined.sigma is not None
    return normalized_motion(refined), torch.where(usable, refined.sigma, torch.inf) if given is None else given


def _usable(motion: tuple[Tensor, ...], found: Solution) -> tuple[Tensor, Tensor]:
    """The normalized motion, the identity where it failed, and where it did not."""
    theta = torch.cat([part.flatten(1) for part in motion], dim=-1)
    usable = theta.isfinite().all(-1) & ~is_failure(found.status)
    identity = torch.eye(3, dtype=theta.dtype, device=theta.device).flatten().repeat(len(motion))
    return torch.where(usable[:, None], theta, identity), usable


def _solve(evidence: Evidence, best: Labelled) -> tuple[Solution, Labelled, tuple[Tensor, Tensor]]:
    """The solution with its status, the final labels, none where there is no motion, and what the tensor alone rests on."""
    refined = evidence.refined(best.theta, best.labels, MAX_PLANAR_STEPS)
    theta = normalized_motion(refined)
    values, spread = evidence.information(theta, best.labels)
    labels = evidence.labels(theta, best.sigma, spread)
    worst = best.sigma * values[:, 0].clamp(min=torch.finfo(values.dtype).tiny).rsqrt()
    assert refined.sigma is not None and refined.covariance is not None
    best = Labelled(theta, labels, best.sigma)
    tensor = tensor_rank(evidence.data.restrict(labels != OUTLIER), evidence, best.sigma)
    free = (worst > MAX_DEVIATION) | is_undecided(evidence, best, tensor)
    status = _status(evidence, best, refined.sigma, free, values[:, 0] <= MIN_INFORMATION * values[:, -1])
    none = is_failure(status)
    labels = torch.where(none[:, None], OUTLIER, labels)
    zero = none[:, None, None]
    solution = replace(
        refined,
        status=status,
        tensor=select(~none, refined.tensor, 0.0),
        normalized=select(~none, refined.normalized, 0.0),
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
        (share < MIN_CONSENSUS)
        | ((share < MIN_NOISY_INLIER_SHARE) & (shown > MAX_NOISE_RATIO * best.sigma))
        | (evidence.still * still + evidence.invariant.codim * moving < evidence.invariant.dof + MIN_SPARE_PLANAR)
    )
    accident = accident | (best.sigma * torch.stack(evidence.norm.scales).amax(0) > NOISY)
    status = torch.full_like(present, int(Status.OK))
    status = torch.where(free, int(Status.AMBIGUOUS), status)
    status = torch.where(accident, int(Status.NO_CONSENSUS), status)
    status = torch.where(undetermined, int(Status.DEGENERATE), status)
    return torch.where((present < MINIMAL) & (known < 4), int(Status.TOO_FEW), status)
