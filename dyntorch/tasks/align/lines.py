"""align_lines(): the motion of a 3D sensor between two views of lines, each of which moves within a plane."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from dyntorch.core.fit import fit_matches
from dyntorch.core.limits import MIN_CONSENSUS, MIN_INFORMATION, median, three_sigma
from dyntorch.core.matches import Matches, matches
from dyntorch.core.matrix import gram
from dyntorch.core.normalize import Normalization, denormalize_motion
from dyntorch.core.outcome import Notice, Status, in_order, is_failure, noting
from dyntorch.core.primitives import Line, direction
from dyntorch.core.residual import multilinear, multilinear_derivative
from dyntorch.core.robust import robust_fit
from dyntorch.core.solution import Solution
from dyntorch.geometry.homogeneous import homogeneous, unit
from dyntorch.invariants.agreement import point_error, static_residual
from dyntorch.invariants.translating_lines_matrix import TranslatingLinesMatrix
from dyntorch.numerics.arguments import check_options, check_threshold
from dyntorch.numerics.blocks import each, one_thread
from dyntorch.numerics.least_squares import LeastSquaresOptions, NormalEquations, by_match, derivatives, minimize
from dyntorch.numerics.messages import Message
from dyntorch.numerics.nullspace import spectrum
from dyntorch.tasks.align.labelling import THRESHOLD_SIGMAS
from dyntorch.tasks.align.result import (
    MOVING,
    OUTLIER,
    STATIC,
    Alignment,
    AlignNotice,
    AlignOptions,
    alignment_of,
    labels_of,
    status_of_alignment,
)

# ----------------------------------------------------------------------------------------------------------------------
# Lines that move in planes, static lines and static points between two views: residuals, refinement, labels.


FIVE = 5  # static lines that determine a collineation
DESCENT = LeastSquaresOptions(iterations=12, stuck_damping=1e5, tolerance=1e-10)
DOF = TranslatingLinesMatrix.dof


NUM_LINE_ROUNDS = 4  # of labelling and least squares
MIN_LINES_UNKNOWN_NOISE = 45  # three times the degrees of freedom: below, noise and outliers cannot be told apart
MIN_LINE_SINGULAR_VALUE = 2.0  # over the noise, to count; missing ones reach 1.7, true ones of 45 lines begin at 2.4
MAX_LINE_DEVIATION = 0.5  # of the worst direction of A of norm 1, above which it is not known at all
MIN_AGREEING_SHARE = 0.65  # with the robust start, below which static lines are tried: wrong ones reach .54
NUM_LINE_SAMPLES = 2000  # of five static lines: eight of them are clean where a third of the lines is static
SAMPLE_THRESHOLD_FACTOR = 4.0  # times the threshold within which a line agrees with such a sample
NUM_WEAK_DIRECTIONS = 4  # of the matrix from which another motion is looked for where its rank is short
MAX_RIVAL_COST = 1.3  # squared error over the least, up to which another motion explains as well (.9 to 1.2)
MIN_SPARE_LINES = 6  # conditions beyond the degrees of freedom that inliers must fulfil


@dataclass(frozen=True)
class Lines:
    """Lines as two points each, and static points, in normalized coordinates; flat batch."""

    data: Matches  # lines ``(b, n, 2, 3)`` as measured
    views: tuple[Tensor, ...]  # normalized
    measured: tuple[Tensor, Tensor]  # static points ``(b, k, 3)`` of both views, k may be 0
    points: tuple[Tensor, ...]  # these normalized
    norm: Normalization  # the similarities of both views
    floor: Tensor  # ``(b,)`` the least noise that the numbers allow, in the unit of the points

    @classmethod
    def of(cls, data: Matches, points: tuple[Tensor, Tensor], norm: Normalization) -> Lines:
        """From measured lines and points."""
        moved = tuple(x @ t[:, :3, :3].mT + t[:, None, :3, 3] for x, t in zip(points, norm.transforms, strict=True))
        floor = 100 * torch.finfo(torch.float64).eps / torch.stack(norm.scales).amin(0)
        return cls(data, norm.apply(TranslatingLinesMatrix(), data.views), points, moved, norm, floor)

    def moving_residuals(self, theta: Tensor) -> Tensor:
        """Signed Sampson residual ``(b, n)`` of each line that may move, in the unit of the points."""
        tensor = TranslatingLinesMatrix.compose(theta.unflatten(-1, (4, 4)))
        return multilinear(TranslatingLinesMatrix(), tensor, self.views, self.norm.scales)

    def problem(self, labels: Tensor) -> LinesProblem:
        """Least squares of the residuals of the labelled lines and the static points, in the unit of the points."""
        root = self.data.weights.sqrt()
        still = torch.where(labels == STATIC, root, 0.0).repeat_interleave(6, dim=-1)
        return LinesProblem(self.views, self.points, self.norm.scales, (torch.where(labels == MOVING, root, 0.0), still))


@dataclass(frozen=True)
class LinesProblem(NormalEquations):
    """Least squares in A, from labelled lines and static points in normalized coordinates."""

    views: tuple[Tensor, ...]
    points: tuple[Tensor, ...]
    scales: tuple[Tensor, ...]
    roots: tuple[Tensor, ...]
    """Of the weights of the residuals of moving and of static lines."""

    def subset(self, keep: Tensor) -> LinesProblem:
        """Only some of the problems."""
        return each(lambda x: x[keep], self)

    def normal_equations(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cost ``(b,)``, gradient ``(b, 16)`` and Gauss-Newton matrix ``(b, 16, 16)``."""
        model = TranslatingLinesMatrix()
        tensor, slope = model.compose_derivative((theta.unflatten(-1, (4, 4)),))
        path, by_tensor = multilinear_derivative(model, tensor.unflatten(1, model.shape()), self.views, self.scales)
        parts = [(path, slope @ by_tensor.mT), by_match(_static_residuals, theta, self.scales, self.views)]
        parts = [(value * root, slope * root[:, None]) for (value, slope), root in zip(parts, self.roots, strict=True)]
        parts.append(by_match(_at_points, theta, self.scales, self.points))
        value, slope = (torch.cat(part, dim=-1) for part in zip(*parts, strict=True))
        cost = value.square().sum(-1)
        return torch.where(cost.isfinite(), cost, torch.inf), (slope @ value[..., None])[..., 0], slope @ slope.mT


def _static_residuals(theta: Tensor, scales: tuple[Tensor, ...], views: tuple[Tensor, ...]) -> Tensor:
    """Distances ``(b, n, 6)`` of both points of a line in view 2, carried into view 1, from the line there; 4 conditions."""
    first, second = views[0].unbind(-2)
    along = second - first
    square = along.square().sum(-1, keepdim=True).clamp(min=torch.finfo(theta.dtype).tiny)
    s1, s2 = (s[..., None, None] for s in scales)
    matrix = theta.unflatten(-1, (4, 4))
    parts = []
    for point in views[1].unbind(-2):
        error, slope = point_error(homogeneous(point) @ matrix.mT, matrix[..., None, :, :], first)
        place = (error * along).sum(-1, keepdim=True) / square
        across = error - place * along
        # isotropic: the noise of the line at this place, and that of the point, averaged over the plane across
        other = (slope.square().sum((-1, -2)) / 3)[..., None]
        variance = s1.square() * ((1 - place).square() + place.square()) + s2.square() * other
        parts.append(across * variance.rsqrt())
    return torch.cat(parts, dim=-1)


def _at_points(theta: Tensor, scales: tuple[Tensor, ...], points: tuple[Tensor, ...]) -> Tensor:
    return static_residual([theta.unflatten(-1, (4, 4))], points, scales)


def as_points(views: tuple[Tensor, ...], weights: Tensor) -> tuple[Tensor, ...]:
    """Lines ``(b, n, 2 3)`` or ``(b, n, 6)`` as two points each, of Pluecker lines near the centre of the scene."""
    return tuple(x if x.ndim == 4 else _two_points(x, (weights > 0).to(x)) for x in views)


def _two_points(line: Tensor, present: Tensor) -> Tensor:
    along = normalize(direction(line), dim=-1)
    foot = Line().points(line)[..., 0, :]
    share = (present / present.sum(-1, keepdim=True).clamp(min=1.0))[..., None]
    centre = (share * foot).sum(-2, keepdim=True)
    nearest = foot + along * (along * (centre - foot)).sum(-1, keepdim=True)
    size = ((nearest - centre).square() * share).sum((-2, -1)).sqrt()[:, None, None]
    size = torch.where(size > 0, size, 1.0)
    return torch.stack([nearest - size / 2 * along, nearest + size / 2 * along], dim=-2)


def settle(lines: Lines, theta: Tensor, sigma: Tensor, *, estimate: bool, plain: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Label and refine in turns: A ``(b, 16)`` in normalized coordinates, labels ``(b, n)``, noise ``(b,)``."""
    present = lines.data.weights > 0
    labels = torch.where(present, MOVING, OUTLIER) if plain else _labels(lines, theta, sigma)
    for _ in range(NUM_LINE_ROUNDS):
        theta, left = refine_map(lines, theta, labels)
        if estimate:
            spare = (labels == MOVING).sum(-1) + 4 * (labels == STATIC).sum(-1) + 3 * lines.points[0].shape[1] - DOF
            sigma = torch.where(spare >= 4, (left / spare.clamp(min=1)).sqrt(), sigma).maximum(lines.floor)
        new = _labels(lines, theta, sigma)
        if bool((new == labels).all()):
            break
        labels = new
    return theta, labels, sigma


def refine_map(lines: Lines, theta: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
    """A that minimizes the residuals of all labelled matches, by Levenberg-Marquardt, and their squares ``(b,)``."""
    problem = lines.problem(labels)
    found = minimize(problem, problem.evaluate((theta,)), DESCENT)
    return found.theta[0], found.cost


def spread(lines: Lines, theta: Tensor, labels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Extreme information ``(b, 2)`` on A, A ``(b, 4, 4)`` as measured, and its covariance ``(b, 16, 16)`` for noise 1."""
    _, _, matrix = lines.problem(labels).normal_equations(theta)
    values, vectors = spectrum(matrix)
    values, vectors = values[:, -DOF:], vectors[..., -DOF:]
    root = vectors * values.clamp(min=1e-12 * values[:, -1:].clamp(min=1e-300)).rsqrt()[:, None]

    def to_measured(t: Tensor) -> Tensor:
        part = denormalize_motion(TranslatingLinesMatrix(), (t.unflatten(-1, (4, 4)),), lines.norm.transforms)[0]
        return unit(part).flatten(-2)

    place, moved = derivatives(to_measured, theta, root.movedim(-1, 0))
    return values[:, [0, -1]], place.unflatten(-1, (4, 4)), moved.mT @ moved


def _labels(lines: Lines, theta: Tensor, sigma: Tensor) -> Tensor:
    square = sigma.square()[:, None]
    still = _static_residuals(theta, lines.norm.scales, lines.views).square().sum(-1) <= three_sigma(4) * square
    return labels_of(still, lines.moving_residuals(theta).square() <= three_sigma(1) * square, lines.data)


MINIMAL = TranslatingLinesMatrix.minimal()
PER_POINT = 9  # matches of lines that one static point gives
RANKS = ((20, "static"), (28, "bodies"), (31, "translation"))
"""Ranks of the estimation matrix (of 35) for special motions, cases of a notice (thesis section 8.4, counted exactly)."""

AMBIGUITY = (
    "A is unique up to its scale where points of one line move at different speeds, or with two static points. Lines that only "
    "translate leave a family of four degrees of freedom: the position and the scale of view 2."
)


@one_thread
def align_lines(
    l1: Tensor,
    l2: Tensor,
    static_points: tuple[Tensor, Tensor] | None = None,
    *,
    threshold: float | None = None,
    weights: Tensor | None = None,
    static: Tensor | None = None,
    generator: torch.Generator | None = None,
    options: AlignOptions | None = None,
) -> Alignment:
    r"""Motion of a 3D sensor from two views of lines, with a label for every line: static, moving or outlier.

    A line that moves within a plane meets itself as it was before, as do two points of a body that translates:

    .. math:: l_2^T F\, l_1 = 0, \qquad F \sim C_2(A)^T J .

    There is no calibration to give: the coordinates of a 3D sensor need none.  One that measures metres moves rigidly:
    :func:`dyntorch.align_points` with ``model="rigid"`` finds that motion from points.

    Args:
        l1: ``(*batch, n, 2, 3)`` two points of each line, or ``(*batch, n, 6)`` Pluecker coordinates (01, 02, 03, 12, 13, 23),
            in view 1; NaN = missing.  Pairs of points of a translating body do as well.
        l2: the same lines in view 2 (other points of them, as they come).
        static_points: points ``(*batch, k, 3)`` in view 1 and in view 2 that are known to stand still.  Two of them make the
            solution unique where lines only translate.
        static: ``(*batch, n)`` bool, lines known not to move.
        threshold: three standard deviations of the noise of one coordinate of the points, in their unit (of Pluecker
            coordinates: of two points on the line, as far apart as the lines are from their centre).  None estimates the noise
            of every problem (at least half of the lines must be inliers; fewer than 45 lines are all taken as such).
        weights: ``(*batch, n)`` not negative; 0 leaves a line out.
        generator: source of the random samples.
        options: what the search takes and expects; None is :class:`dyntorch.AlignOptions` as it is.

    Returns:
        An :class:`~dyntorch.tasks.align.result.Alignment` with A only.

    Raises:
        ValueError: fewer than 35 lines (9 less for each static point), shapes, dtypes or devices that do not agree, a threshold
            that is not positive.

    Source: thesis section 8.4.

    Example:
        >>> import torch, dyntorch as dyn
        >>> from dyntorch import scenes
        >>> draw = torch.Generator().manual_seed(0)
        >>> scene = scenes.translating_lines(60, sigma=0.002, generator=draw)
        >>> result = dyn.align_lines(*scene.views, threshold=0.006, generator=draw)
        >>> bool((result.A - scene.motion[0]).norm() < 0.02)
        True
    """
    options = AlignOptions() if options is None else options
    check_options(options, AlignOptions)
    check_threshold(threshold)
    data = matches(TranslatingLinesMatrix(), (l1, l2), weights, static)
    points = _points(static_points, data, l1)
    extra = points[0].shape[1]
    if data.count + PER_POINT * extra < MINIMAL:
        text = (
            "align_lines needs at least {needed} lines, got {lines} and {points} static points, which count {each} each; "
            "add lines, or give {arg:static_points=(P1, P2)}"
        )
        raise ValueError(Message(text, needed=MINIMAL, lines=data.count, points=extra, each=PER_POINT))
    with torch.no_grad():
        return _align(data, points, threshold, generator, options)


def _points(pair: tuple[Tensor, Tensor] | None, data: Matches, like: Tensor) -> tuple[Tensor, Tensor]:
    """Static points ``(b, k, 3)`` of both views, in float64."""
    if pair is None:
        return (none := data.weights.new_zeros(len(data.weights), 0, 3)), none
    if len(pair) != 2 or pair[0].shape != pair[1].shape or tuple(pair[0].shape[:-2]) != data.batch or pair[0].shape[-1] != 3:
        shapes = [tuple(x.shape) for x in pair]
        raise ValueError(f"static_points must be two (*batch, k, 3) with batch {data.batch}, got {shapes}")
    if any(x.dtype != like.dtype or x.device != like.device for x in pair):
        raise ValueError(f"static_points must be {like.dtype} on {like.device} as the lines are, got {[x.dtype for x in pair]}")
    first, second = (x.to(data.weights).reshape(-1, *x.shape[-2:]) for x in pair)
    if not bool(first.isfinite().all() and second.isfinite().all()):
        raise ValueError("static_points must be finite; leave missing ones out")
    return first, second


def _align(
    data: Matches, points: tuple[Tensor, Tensor], threshold: float | None, generator: torch.Generator | None, options: AlignOptions
) -> Alignment:
    flat = replace(data, views=as_points(data.views, data.weights), batch=data.weights.shape[:1], dtype=torch.float64)
    flat = replace(flat, weights=flat.weights / flat.weights.amax(-1, keepdim=True).clamp(min=1e-300), device=flat.weights.device)
    joined = _join_matches(flat, points)
    given = None if threshold is None else torch.full_like(flat.weights[:, 0], threshold / THRESHOLD_SIGMAS)
    plain = (given is None and joined.count < MIN_LINES_UNKNOWN_NOISE) or not len(flat.weights)
    start = (
        fit_matches(TranslatingLinesMatrix(), joined)
        if plain
        else robust_fit(
            TranslatingLinesMatrix,
            *joined.views,
            threshold=None if given is None else (THRESHOLD_SIGMAS * given),
            weights=joined.weights,
            generator=generator,
        )
    )
    usable = ~is_failure(start.status)
    lines = Lines.of(flat, points, start.normalization)
    theta = torch.where(usable[:, None], start.normalized_motion()[0].flatten(1), torch.eye(4).to(flat.weights).flatten() / 2)
    if not plain:
        bound = three_sigma(1) * (_noise(lines, theta, plain) if given is None else given.maximum(lines.floor)).square()
        theta = _select_start(lines, theta, usable, bound, generator, options)
    sigma = _noise(lines, theta, plain) if given is None else given.maximum(lines.floor)
    theta, labels, sigma = settle(lines, theta, sigma, estimate=given is None, plain=plain)
    return _result(data, lines, start, theta, labels, sigma, options)


def _from_static(lines: Lines, bound: Tensor, generator: torch.Generator | None, options: AlignOptions) -> Tensor:
    r"""A ``(b, 16)`` that the most lines agree with that did not move, of those that five random lines determine."""
    first, second = lines.views
    planes = torch.linalg.qr(homogeneous(first).mT, mode="complete").Q[..., 2:].mT  # (b, n, 2, 4) through the line in view 1
    planes = planes / planes[..., :3].norm(dim=-1, keepdim=True).clamp(min=1e-12)
    rows = (planes[..., :, None, :, None] * homogeneous(second)[..., None, :, None, :]).flatten(-2).flatten(-3, -2)  # (b, n, 4, 16)
    rows = torch.where((lines.data.weights > 0)[..., None, None], rows, 0.0)
    draw = torch.randint(rows.shape[1], (options.num_samples or NUM_LINE_SAMPLES, FIVE), generator=generator).to(rows.device)
    sample = rows[:, draw].flatten(2, 3)  # (b, samples, 16, 16)
    found = spectrum(sample.mT @ sample)[1][..., 0]
    present = lines.data.weights > 0

    def agreeing_lines(motion: Tensor, times: float) -> Tensor:
        """Which lines ``(b, samples, n)`` are where ``motion (b, samples, 16)`` takes them, to a multiple of the bound."""
        moved = homogeneous(second)[:, None] @ motion.unflatten(-1, (4, 4))[:, :, None].mT  # (b, samples, n, 2, 4)
        away = (moved @ planes[:, None].mT / moved[..., 3:]).square().amax((-2, -1)) / lines.norm.scales[0][:, None, None].square()
        return (away <= times**2 * bound[:, None, None]) & present[:, None]

    support = agreeing_lines(found, SAMPLE_THRESHOLD_FACTOR).sum(-1)
    best = found.gather(1, support.argmax(-1)[:, None, None].expand(-1, 1, 16))
    for times in (SAMPLE_THRESHOLD_FACTOR, SAMPLE_THRESHOLD_FACTOR / 2, 1.0):  # more lines and less noise in each turn
        kept = rows * agreeing_lines(best, times)[:, 0, :, None, None]
        best = spectrum(torch.einsum("bnij,bnik->bjk", kept, kept))[1][:, None, :, 0]
    return best[:, 0]


def _select_start(
    lines: Lines, theta: Tensor, usable: Tensor, bound: Tensor, generator: torch.Generator | None, options: AlignOptions
) -> Tensor:
    """The start, or where few lines agree with it that of :func:`_from_static`, if its truncated squared error is less."""
    present = lines.data.weights > 0

    def squares(motion: Tensor) -> Tensor:
        return torch.where(present, lines.moving_residuals(motion).square().nan_to_num(torch.inf).minimum(bound[:, None]), 0.0)

    here = squares(theta)
    doubtful = usable & (((here < bound[:, None]) & present).sum(-1) < MIN_AGREEING_SHARE * present.sum(-1))
    if not bool(doubtful.any()):
        return theta
    other = _from_static(lines, bound, generator, options)
    return torch.where((doubtful & (squares(other).sum(-1) < here.sum(-1)))[:, None], other, theta)


def _join_matches(data: Matches, points: tuple[Tensor, Tensor]) -> Matches:
    """Lines and static points as matches of lines."""
    length = float(points[0].std()) if points[0].shape[1] > 1 else 1.0
    stars = TranslatingLinesMatrix.static_point_lines(*points, length=max(length, 1e-12))
    views = tuple(torch.cat([x, star], dim=1) for x, star in zip(data.views, stars, strict=True))
    weights = torch.cat([data.weights, torch.ones_like(stars[0][..., 0, 0])], dim=1)
    return replace(data, views=views, weights=weights, static=None)


def _noise(lines: Lines, theta: Tensor, plain: bool) -> Tensor:
    """Standard deviation of the noise ``(b,)`` that the start shows: of all lines, or by their median."""
    square = lines.moving_residuals(theta).square()
    present = lines.data.weights > 0
    if plain:
        return (torch.where(present, square, 0.0).sum(-1) / present.sum(-1).clamp(min=1)).sqrt().maximum(lines.floor)
    middle = torch.where(present, square, torch.nan).nanmedian(dim=-1).values.nan_to_num()
    return 1.5 * (middle / median(1)).sqrt().maximum(lines.floor)


def _result(
    data: Matches, lines: Lines, start: Solution, theta: Tensor, labels: Tensor, sigma: Tensor, options: AlignOptions
) -> Alignment:
    usable = ~is_failure(start.status)
    extent, A, covariance = spread(lines, theta, labels)
    worst = sigma * extent[:, 0].clamp(min=torch.finfo(theta.dtype).tiny).rsqrt()
    present, inliers = (data.weights > 0).sum(-1), (labels != OUTLIER).sum(-1)
    conditions = inliers + 3 * (labels == STATIC).sum(-1) + 3 * lines.points[0].shape[1]
    accident = (inliers < MIN_CONSENSUS * present) | ((conditions < DOF + MIN_SPARE_LINES) & (present > MINIMAL))
    rank = _rank(lines, labels, sigma, usable)
    free = (worst > MAX_LINE_DEVIATION) | (rank <= RANKS[-1][0])
    free |= _has_alternatives(lines, theta, labels, (rank < MINIMAL) & ~free & ~accident, options)
    undetermined = extent[:, 0] <= MIN_INFORMATION * extent[:, 1]
    status = torch.where(usable, status_of_alignment(free, accident, undetermined, ~usable), start.status)
    return alignment_of(
        data,
        status,
        (A,),
        labels,
        sigma,
        covariance * sigma.square()[:, None, None],
        ambiguity=AMBIGUITY,
        notices=_notices(rank, worst, is_failure(status), status != Status.TOO_FEW, data.batch, options),
    )


def _has_alternatives(lines: Lines, theta: Tensor, labels: Tensor, doubtful: Tensor, options: AlignOptions) -> Tensor:
    """Whether another motion ``(b,)``, far from this one, explains the lines about as well."""
    found = torch.zeros_like(doubtful)
    if not bool(doubtful.any()):
        return found
    model = TranslatingLinesMatrix()
    joined = _join_matches(lines.data.restrict(labels != OUTLIER), lines.measured)
    _, vectors = spectrum(gram(model.primitives, lines.norm.apply(model, joined.views), joined.weights))
    best, here = lines.problem(labels).normal_equations(theta)[0], unit(theta.unflatten(-1, (4, 4)))
    weakest = vectors[..., :NUM_WEAK_DIRECTIONS].unbind(-1)
    mixed = [one + sign * two for one, two in combinations(weakest, 2) for sign in (1, -1)]
    for flat in (*weakest, *mixed):
        start = model.decompose(flat.unflatten(-1, (6, 6))).flatten(1)
        other, cost = refine_map(lines, torch.where(start.isfinite(), start, theta), labels)
        there = unit(other.unflatten(-1, (4, 4)))
        far = torch.minimum((there - here).flatten(1).norm(dim=-1), (there + here).flatten(1).norm(dim=-1)) > options.max_deviation
        found |= far & (cost <= MAX_RIVAL_COST * best)
    return found & doubtful


def _rank(lines: Lines, labels: Tensor, sigma: Tensor, usable: Tensor) -> Tensor:
    """Singular values ``(b,)`` of the estimation matrix above the noise: of the inliers, of all lines where there is no motion."""
    kept = lines.data.restrict((labels != OUTLIER) | ~usable[:, None])
    joined = _join_matches(kept, lines.measured)
    if joined.count < MINIMAL:
        return torch.full_like(labels[:, 0], MINIMAL)
    values = fit_matches(TranslatingLinesMatrix(), joined).singular_values
    noise = torch.where(usable, sigma, lines.floor) * torch.stack(lines.norm.scales).mean(0)
    noise = noise * joined.weights.square().sum(-1).sqrt()
    return (values > torch.maximum(MIN_LINE_SINGULAR_VALUE * noise[:, None], 1e-9 * values[:, :1])).sum(-1)


def _notices(
    rank: Tensor, worst: Tensor, none: Tensor, enough: Tensor, batch: tuple[int, ...], options: AlignOptions
) -> tuple[Notice, ...]:
    found, note = noting(batch)
    least = 0
    for most, case in RANKS:
        note(AlignNotice.PURE_TRANSLATION, rank, enough & (rank > least) & (rank <= most), case=case, full=MINIMAL)
        least = most
    note(AlignNotice.UNCERTAIN, worst, ~none & (worst > options.max_deviation), case="lines", what="motion")
    return in_order(found)
