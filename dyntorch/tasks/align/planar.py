"""align_planar(): the motion of a camera over a plane on which points stand still, move, or are mismatched."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dyntorch.core.fit import fit_matches
from dyntorch.core.limits import MIN_INFORMATION, three_sigma
from dyntorch.core.matches import Matches, matches
from dyntorch.core.normalize import denormalize_motion
from dyntorch.core.outcome import Notice, Status, has_inliers, in_order, is_failure, noting
from dyntorch.core.solution import Solution
from dyntorch.geometry.bundle import calibrations
from dyntorch.geometry.homogeneous import homogeneous, nonzero_sign
from dyntorch.geometry.rigid import CommonPlane, PlaneMotion, motion_over, plane_motions
from dyntorch.invariants.dynamic_tensor import flat_residual
from dyntorch.invariants.homography_tensor import HomographyTensor
from dyntorch.numerics.arguments import check_options, check_threshold
from dyntorch.numerics.blocks import each, one_thread
from dyntorch.numerics.least_squares import LeastSquaresOptions, minimize
from dyntorch.numerics.messages import Message
from dyntorch.numerics.nullspace import eigenvalues
from dyntorch.tasks.align.labelling import (
    Evidence,
    Labelled,
    has_static_support,
    moving_points,
    normalized_motion,
    other_background,
    static_start,
    status_of_labels,
    tensor_start,
    three_of,
    trajectory_lines,
    without_failures,
)
from dyntorch.tasks.align.result import MOVING, OUTLIER, STATIC, Alignment, AlignNotice, AlignOptions, solved_alignment

# ----------------------------------------------------------------------------------------------------------------------
# align_planar(calibration=): how calibrated cameras turned and moved, and the plane below the points.


MAX_NORMAL_STEPS = 30  # of each descent on the normal of the plane
LENGTH_ROUNDING = 1e-9  # relative deviation from equal lengths: homographies of pixels lose 6 of 16 digits
MAX_EQUIVALENT_CHI_SQUARE = 9.0  # beyond the least, up to which a plane explains as well: three standard deviations
MAX_HIDDEN_SHARE = 0.02  # of points behind cameras, beyond the least, up to which a plane shows them as well
MIN_NORMAL_ANGLE = 0.03  # radians from which two normals are two
MIN_NORMAL_DEVIATIONS = 3.0  # and besides so many standard deviations
MAX_NORMAL_DEVIATION = 0.3  # radians; a camera that only turns leaves 1 and more
MAX_CALIBRATION_MISFIT = 5.0  # chi-square over its quantile of three standard deviations
MIN_LENGTH_DEVIATION = 0.003  # relative, that a calibration to two or three digits leaves


class CalibratedViews(NamedTuple):
    """Homographies between calibrated views of a plane, flat batch, and what was seen of it."""

    inverse: Tensor
    """``(b, v, 3, 3)`` N, every further view to view 1, of middle singular value 1 and the sign that keeps depths positive."""
    covariance: Tensor
    """``(b, 9 v, 9 v)`` of its entries; 0 where it is not known."""
    known: Tensor
    """``(b,)`` where it is."""
    fine: Tensor
    """``(b,)`` where there is a motion."""
    rays: Tensor
    """``(b, v + 1, n, 3)`` in calibrated coordinates, the first ones of view 1."""
    counts: Tensor
    """``(b, n)`` bool: matches that are inliers."""

    @classmethod
    def of(cls, solution: Solution, data: Matches, labels: Tensor, K: Tensor) -> CalibratedViews:
        """Of a solution and its labels ``(b, n)``, with K ``(b, v + 1, 3, 3)``."""
        back = torch.linalg.inv(K)
        motion = denormalize_motion(solution.invariant, solution.normalized_motion(), solution.normalization.transforms)
        solved = has_inliers(solution.status.reshape(-1))
        A = torch.stack(list(motion), dim=1)
        N = back[:, :1] @ A @ K[:, 1:]
        fine = solved & N.isfinite().flatten(1).all(-1) & (torch.linalg.det(N) != 0).all(-1)
        eye = torch.eye(3, dtype=N.dtype, device=N.device)
        N = torch.where(fine[:, None, None, None], N, eye)
        b, v = N.shape[:2]
        # the entries of X A Y, row by row, are those of A times kron(X, Y^T)
        by = torch.einsum("bij,bvlk->bvikjl", back[:, 0], K[:, 1:]).reshape(b, v, 9, 9)
        rays = homogeneous(torch.stack(data.views, dim=1)) @ back.mT
        counts = (labels != OUTLIER) & (data.weights > 0)
        mapped = (N @ rays[:, 1:].mT)[..., 2, :]
        sign = nonzero_sign((mapped.sign() * counts[:, None]).sum(-1))
        scale = sign / torch.linalg.svdvals(N)[..., 1]
        by = by * scale[..., None, None]
        assert solution.covariance is not None
        C = solution.covariance
        known = fine & C.isfinite().flatten(1).all(-1)
        C = torch.einsum("bvkp,bvpwq,bwlq->bvkwl", by, torch.where(C.isfinite(), C, 0.0).view(b, v, 9, v, 9), by)
        C = torch.where(known[:, None, None], C.reshape(b, 9 * v, 9 * v), 0.0)
        return cls(scale[..., None, None] * N, C, known, fine, rays, counts)

    def plane(self) -> CommonPlane:
        """The least squares problem of the normal."""
        return CommonPlane(inverse=self.inverse, covariance=self.covariance, floor=LENGTH_ROUNDING)

    def orient(self, normal: Tensor) -> Tensor:
        """The normals ``(b, 3)`` or their opposites, such that most of the plane that view 1 sees lies before it."""
        depth = (self.rays[:, 0] @ normal[..., None])[..., 0]
        return normal * nonzero_sign((depth.sign() * self.counts).sum(-1, keepdim=True))

    def behind(self, normal: Tensor) -> Tensor:
        """Greatest share over the views ``(b,)`` of matches whose ray meets the plane behind the camera."""
        mapped = torch.cat([self.rays[:, :1], self.rays[:, 1:] @ self.inverse.mT], dim=1)
        wrong = ((mapped @ normal[:, None, :, None])[..., 0] <= 0) & self.counts[:, None]
        return (wrong.sum(-1) / self.counts.sum(-1).clamp(min=1)[:, None]).amax(-1)

    def motion(self, normal: Tensor) -> PlaneMotion:
        """Rotations and translations ``(b, v + 1, ...)`` of all views, the first included, above the plane of a normal."""
        H = torch.linalg.inv_ex(self.plane().correct_homographies(normal))[0]
        rotation, translation = motion_over(torch.where(H.isfinite(), H, 0.0), normal[:, None].expand(*H.shape[:2], 3))
        eye = torch.eye(3, dtype=H.dtype, device=H.device).expand(len(H), 1, 3, 3)
        return PlaneMotion(
            torch.cat([eye, rotation], dim=1), torch.cat([torch.zeros_like(translation[:, :1]), translation], dim=1), normal
        )


class PlaneChoice(NamedTuple):
    """The normal of each problem, and what speaks for it."""

    normal: Tensor
    """``(b, 3)``."""
    other: Tensor
    """``(b, 3)`` one that explains the homographies as well; 0 where there is none."""
    cost: Tensor
    """``(b,)`` chi-square of ``2 v - 2`` degrees of freedom."""
    misfit: Tensor
    """``(b,)`` rms of the conditions."""
    deviation: Tensor
    """``(b,)`` standard deviation of the normal in its worst direction, radians."""


def chosen_plane(views: CalibratedViews) -> PlaneChoice:
    """The plane that explains the homographies best, and before the cameras, from either solution of every view."""
    inverse = views.inverse
    b = len(inverse)
    starts = plane_motions(torch.linalg.inv(inverse)).normal.flatten(1, 2)
    count = starts.shape[1]
    wide = each(lambda part: part.repeat_interleave(count, 0), views)  # every problem so many times in a row
    problem = wide.plane()
    found = minimize(problem, problem.evaluate((starts.flatten(0, 1),)), LeastSquaresOptions(iterations=MAX_NORMAL_STEPS))
    flat = wide.orient(found.theta[0])
    normal, cost, wrong = flat.view(b, count, 3), found.cost.view(b, count), wide.behind(flat).view(b, count)
    fits = cost <= cost.amin(-1, keepdim=True) + MAX_EQUIVALENT_CHI_SQUARE
    fits = fits & (wrong <= torch.where(fits, wrong, torch.inf).amin(-1, keepdim=True) + MAX_HIDDEN_SHARE)
    best = torch.where(fits, cost, torch.inf).argmin(-1)
    row = torch.arange(b, device=best.device)
    chosen = normal[row, best]
    r, turns, weight, _ = views.plane().whiten_conditions(chosen)
    deviation = eigenvalues(turns.mT @ weight @ turns)[:, 0].clamp(min=torch.finfo(r.dtype).tiny).rsqrt()
    apart = fits & ((normal - chosen[:, None]).norm(dim=-1) > MIN_NORMAL_ANGLE + MIN_NORMAL_DEVIATIONS * deviation[:, None])
    second = normal[row, torch.where(apart, cost, torch.inf).argmin(-1)]
    return PlaneChoice(
        chosen,
        torch.where(apart.any(-1)[:, None], second, 0.0),
        cost[row, best],
        r.square().mean(-1).sqrt(),
        deviation,
    )


def euclidean(solution: Solution, data: Matches, labels: Tensor, K: Tensor) -> tuple[PlaneMotion, PlaneMotion, list[Notice]]:
    """Motion of calibrated cameras above a plane, another that explains the matches as well, and what limits both. labels
    ``(b, n)``, K ``(b, views, 3, 3)``."""
    views = CalibratedViews.of(solution, data, labels, K)
    choice = chosen_plane(views)
    free = views.fine & (choice.deviation > MAX_NORMAL_DEVIATION)
    several = views.fine & ~free & (choice.other != 0).any(-1)
    degrees = 2 * views.inverse.shape[1] - 2
    odd = views.known & (choice.cost > MAX_CALIBRATION_MISFIT * three_sigma(degrees)) & (choice.misfit > MIN_LENGTH_DEVIATION)
    notices, note = noting(data.batch)
    note(AlignNotice.PLANE_OPEN, choice.deviation.clamp(max=9.9), free)
    angle = torch.atan2(torch.linalg.cross(choice.normal, choice.other).norm(dim=-1), (choice.normal * choice.other).sum(-1))
    note(AlignNotice.TWO_PLANES, torch.rad2deg(angle), several)
    note(AlignNotice.CALIBRATION, choice.misfit, odd & ~free)
    first = views.motion(choice.normal)
    second = views.motion(torch.where(several[:, None], choice.other, choice.normal))
    return _to_batch(first, views.fine, ~free, data), _to_batch(second, several, several, data), notices


def _to_batch(motion: PlaneMotion, turned: Tensor, determined: Tensor, data: Matches) -> PlaneMotion:
    """Zero where there is no rotation, and where the plane, in units of whose distance translations are, is not determined."""
    both = turned & determined
    return PlaneMotion(
        data.back(torch.where(turned[:, None, None, None], motion.rotations, 0.0)),
        data.back(torch.where(both[:, None, None], motion.translations, 0.0)),
        data.back(torch.where(both[:, None], motion.normal, 0.0)),
    )


# ----------------------------------------------------------------------------------------------------------------------
# align_planar(): the motion of a camera over a plane on which points stand still, move, or are mismatched.


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
MIN_LINE_WIDTH = 3.0  # standard deviations of the noise across a line of points, below which they may as well lie on it
NUM_PLANAR_SAMPLES = 1000  # of four: 96 % to draw four static ones where they are 24 % of all
MAX_PLANAR_STEPS = 30  # of the final refinement
MAX_DEVIATION = 0.5  # of the worst direction of a motion of norm 1, above which it is not known at all
MAX_NOISE_RATIO = 1.3  # shown by the inliers over assumed; random matches fill the limits evenly (1.7)
MIN_NOISY_INLIER_SHARE = 0.7  # where the inliers show more noise than that
MIN_SPARE_PLANAR = 8  # conditions beyond the 16 degrees of freedom that inliers must fulfil


def planar_notices(
    evidence: Evidence, best: Labelled, tensor: tuple[Tensor, Tensor], unverified: Tensor, rival: Tensor, status: Tensor,
    batch: tuple[int, ...],
) -> tuple[Notice, ...]:  # fmt: skip
    """All notices on a flat batch of problems with final labels, in the order of the problems; ``tensor`` from
    :func:`tensor_rank`, moving matches ``unverified (b, n)``, ``rival (b,)`` from :func:`other_background`."""
    data = evidence.data
    rank, strength = tensor
    solved = ~is_failure(status)
    count = (best.labels == MOVING).sum(-1)
    found, note = noting(batch)
    full = HomographyTensor.width() - 1
    note(AlignNotice.DEGENERATE, rank, solved & (rank < full))
    note(AlignNotice.NEAR_STATIC, strength, solved & (rank >= full) & (strength < MIN_TENSOR_STRENGTH), case="tensor")
    family, still = (status == Status.AMBIGUOUS) & is_undecided(evidence, best, tensor), (best.labels == STATIC).sum(-1)
    note(AlignNotice.OTHER_SOLUTION, still, family)
    note(AlignNotice.OTHER_BACKGROUND, rival, rival > 0, still=still)
    note(AlignNotice.FEW_MOVING, count, solved & (count < FEWEST), least=f"{FEWEST}")
    lines = trajectory_lines(evidence, best, LINES)
    note(AlignNotice.FEW_LINES, lines, solved & (lines > 0) & (lines < LINES), least=LINES)
    note(AlignNotice.ONE_LINE, lines, solved & (lines == 1))
    thin = thinness(evidence, best.sigma)
    note(AlignNotice.COLLINEAR, thin, (data.weights > 0).any(-1) & (thin < MIN_LINE_WIDTH))
    note(AlignNotice.UNVERIFIED, unverified.sum(-1), solved & unverified.any(-1))
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
    if evidence.data.static is not None:
        still = (best.labels == STATIC) & (evidence.data.weights > 0)
        family = family & ((still & evidence.data.static).sum(-1) < NOTICES_MINIMAL)
    return family & ~has_static_support(evidence, best)


def unverified_matches(evidence: Evidence, best: Labelled) -> Tensor:
    """Matches ``(b, n)`` that all views but one agree on as static, whatever that one says."""
    parts = evidence.problem(best.labels).parts(best.theta)
    maps = torch.stack([torch.eye(3, dtype=parts[0].dtype, device=parts[0].device).expand_as(parts[0]), *parts], dim=-3)
    limit = three_sigma(evidence.static_conditions - 2) * best.sigma.square()[:, None]
    agree = []
    for chosen in combinations(range(len(evidence.views)), len(evidence.views) - 1):
        views, scales = ([x[v] for v in chosen] for x in (evidence.views, evidence.norm.scales))
        agree.append(flat_residual(maps[:, list(chosen)], views, scales, 1).square().sum(-1) <= limit)
    return torch.stack(agree).any(0) & (evidence.data.weights > 0)


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
    solution, best, tensor, rival = _solve(evidence, _search(evidence, threshold, generator, options), generator, options)
    unverified = unverified_matches(evidence, best) & (best.labels == MOVING)
    notices = planar_notices(evidence, best, tensor, unverified, rival, solution.status, data.batch)
    calibrated: dict[str, Any] = {}
    if K is not None:
        turned, other, told = euclidean(solution, data, best.labels, K)
        notices = in_order([*notices, *told])
        calibrated = {**turned._asdict(), "other_motion": other}
    return solved_alignment(solution, data, best.labels, AMBIGUITY, notices, unverified=data.back(unverified), **calibrated)


def _search(evidence: Evidence, threshold: float | None, generator: torch.Generator | None, options: AlignOptions) -> Labelled:
    """The better one of the motions that the two searches start from, with its labels."""
    given, count = evidence.given_noise(threshold), evidence.data.count
    starts = [static_start(evidence, given, options.num_samples or NUM_PLANAR_SAMPLES, generator)]
    if MINIMAL <= count < FEW:
        starts.append(tensor_start(HomographyTensor(), evidence, given, generator, plain=True))
    if len(evidence.floor) and count >= (MINIMAL if given is not None else FEW):
        starts.append(tensor_start(HomographyTensor(), evidence, given, generator, plain=False))
    # the smaller estimate is that of a motion most matches agree with; it may still be low, for static matches show half the noise
    sigma = given if given is not None else 1.5 * torch.stack([noise for _, noise in starts]).amin(0).maximum(evidence.floor)
    theta = evidence.improve_starts([start for start, _ in starts], sigma, sampled=True)
    return evidence.iterate_labels(evidence.best_start(theta, sigma), sigma, estimate=given is None)


def _solve(
    evidence: Evidence, best: Labelled, generator: torch.Generator | None, options: AlignOptions
) -> tuple[Solution, Labelled, tuple[Tensor, Tensor], Tensor]:
    """The solution with its status, the final labels, none where there is no motion, what the tensor alone rests on, and how many
    matches stand still by a rival motion."""
    refined = evidence.refine(best.theta, best.labels, MAX_PLANAR_STEPS)
    theta = normalized_motion(refined)
    values, spread = evidence.information(theta, best.labels)
    labels = evidence.labels(theta, best.sigma, spread)
    worst = best.sigma * values[:, 0].clamp(min=torch.finfo(values.dtype).tiny).rsqrt()
    assert refined.sigma is not None
    best = Labelled(theta, labels, best.sigma)
    tensor = tensor_rank(evidence.data.restrict(labels != OUTLIER), evidence, best.sigma)
    free = (worst > MAX_DEVIATION) | is_undecided(evidence, best, tensor)
    share = (labels != OUTLIER).sum(-1) / (evidence.data.weights > 0).sum(-1).clamp(min=1)
    odd = (share < MIN_NOISY_INLIER_SHARE) & (refined.sigma > MAX_NOISE_RATIO * best.sigma)
    undetermined = values[:, 0] <= MIN_INFORMATION * values[:, -1]
    status = status_of_labels(evidence, best, free, undetermined, odd, MIN_SPARE_PLANAR, (MINIMAL, 4))
    # where the equations leave one tensor, there is no rival
    asked = (status == Status.OK) & (tensor[1] < MIN_TENSOR_STRENGTH)
    rival = other_background(evidence, best, asked, options.num_samples or NUM_PLANAR_SAMPLES, options.min_static_share, generator)
    status = torch.where(rival > 0, int(Status.AMBIGUOUS), status)
    solution, labels = without_failures(refined, status, labels, worst)
    return solution, replace(best, labels=labels), tensor, rival
