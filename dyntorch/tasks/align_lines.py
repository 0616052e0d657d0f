"""align_lines(): the motion of a 3D sensor between two views of lines, each of which moves within a plane."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from dyntorch.blocks import one_thread
from dyntorch.chi_square import median
from dyntorch.fitting import fit_matches
from dyntorch.invariants.translating_lines_matrix import TranslatingLinesMatrix
from dyntorch.matches import Matches, matches
from dyntorch.robust import robust_fit
from dyntorch.solution import Solution, Status, failed
from dyntorch.tasks.alignment import OUTLIER, STATIC, Alignment
from dyntorch.tasks.labelling import SIGMAS
from dyntorch.tasks.line_model import Lines, as_points, settle, spread
from dyntorch.tasks.notices import Notice, NoticeCode, check_threshold, notices

MINIMAL = TranslatingLinesMatrix.minimal()
PER_POINT = 9  # matches of lines that one static point gives
CERTAIN = 45
"""Lines (three times the degrees of freedom) below which noise of unknown size cannot be told from outliers."""
ABOVE = 2.0
"""A singular value counts from so many times the noise on: those that the model lacks reach 1.7, those of 45 lines in general
position at a noise of a two-hundredth of the scene begin at 2.4 (measured)."""
AMBIGUOUS, UNCERTAIN = 0.5, 0.05
"""Standard deviation of the worst direction of A, of norm 1, above which it is not known at all; or hardly."""
INDETERMINATE = 1e-13  # information on the worst direction over that on the best: rounding error below it
CONSENSUS, SPARE = 0.4, 6
RANKS = (
    (20, "all lines stand still"),
    (28, "the lines belong to two rigid bodies that translate"),
    (31, "the lines only translate: the position and the scale of view 2 remain unknown, four degrees of freedom"),
)
"""Ranks of the estimation matrix (of 35) for special motions (thesis section 8.4, counted exactly)."""

AMBIGUITY = (
    "A is unique up to its scale where points of one line move at different speeds, or with two static points. Lines that only "
    "translate leave a family of four degrees of freedom: the position and the scale of view 2."
)


@one_thread
def align_lines(
    l1: Tensor,
    l2: Tensor,
    static_points: tuple[Tensor, Tensor] | None = None,
    static: Tensor | None = None,
    threshold: float | None = None,
    weights: Tensor | None = None,
    generator: torch.Generator | None = None,
) -> Alignment:
    r"""Motion of a 3D sensor from two views of lines, with a label for every line: static, moving or outlier.

    A line that moves within a plane meets itself as it was before, as do two points of a body that translates:

    .. math:: l_2^T F\, l_1 = 0, \qquad F \sim C_2(A)^T J .

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

    Returns:
        An :class:`~dyntorch.tasks.alignment.Alignment` with A only.

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
    check_threshold(threshold)
    data = matches(TranslatingLinesMatrix(), (l1, l2), weights, static)
    points = _points(static_points, data, l1)
    extra = 0 if points is None else points[0].shape[1]
    if data.count + PER_POINT * extra < MINIMAL:
        raise ValueError(
            f"align_lines needs at least {MINIMAL} lines, got {data.count} and {extra} static points, which count "
            f"{PER_POINT} each; add lines, or give static_points=(P1, P2)"
        )
    with torch.no_grad():
        return _align(data, points, threshold, generator)


def _points(pair: tuple[Tensor, Tensor] | None, data: Matches, like: Tensor) -> tuple[Tensor, Tensor] | None:
    """Static points ``(b, k, 3)`` of both views, in float64."""
    if pair is None:
        return None
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
    data: Matches, points: tuple[Tensor, Tensor] | None, threshold: float | None, generator: torch.Generator | None
) -> Alignment:
    flat = replace(data, views=as_points(data.views, data.weights), batch=data.weights.shape[:1], dtype=torch.float64)
    flat = replace(flat, weights=flat.weights / flat.weights.amax(-1, keepdim=True).clamp(min=1e-300), device=flat.weights.device)
    joined = _joined(flat, points)
    given = None if threshold is None else torch.full_like(flat.weights[:, 0], threshold / SIGMAS)
    plain = (given is None and joined.count < CERTAIN) or not len(flat.weights)
    start = (
        fit_matches(TranslatingLinesMatrix(), joined)
        if plain
        else robust_fit(
            TranslatingLinesMatrix,
            *joined.views,
            threshold=None if given is None else (SIGMAS * given),
            weights=joined.weights,
            generator=generator,
        )
    )
    usable = ~failed(start.status)
    lines = Lines.of(flat, points, start.normalization)
    theta = torch.where(usable[:, None], start.normalized_motion()[0].flatten(1), torch.eye(4).to(flat.weights).flatten() / 2)
    sigma = _noise(lines, theta, plain) if given is None else given.maximum(lines.floor)
    theta, labels, sigma = settle(lines, theta, sigma, estimate=given is None, plain=plain)
    return _result(data, lines, start, theta, labels, sigma, usable, points)


def _joined(data: Matches, points: tuple[Tensor, Tensor] | None) -> Matches:
    """Lines and static points as matches of lines."""
    if points is None:
        return replace(data, static=None)
    length = float(points[0].std()) if points[0].shape[1] > 1 else 1.0
    stars = TranslatingLinesMatrix.static_point_lines(*points, length=max(length, 1e-12))
    views = tuple(torch.cat([x, star], dim=1) for x, star in zip(data.views, stars, strict=True))
    weights = torch.cat([data.weights, torch.ones_like(stars[0][..., 0, 0])], dim=1)
    return replace(data, views=views, weights=weights, static=None)


def _noise(lines: Lines, theta: Tensor, plain: bool) -> Tensor:
    """Standard deviation of the noise ``(b,)`` that the start shows: of all lines, or by their median."""
    square = lines.moving(theta).square()
    present = lines.data.weights > 0
    if plain:
        return (torch.where(present, square, 0.0).sum(-1) / present.sum(-1).clamp(min=1)).sqrt().maximum(lines.floor)
    middle = torch.where(present, square, torch.nan).nanmedian(dim=-1).values.nan_to_num()
    return 1.5 * (middle / median(1)).sqrt().maximum(lines.floor)


def _result(
    data: Matches,
    lines: Lines,
    start: Solution,
    theta: Tensor,
    labels: Tensor,
    sigma: Tensor,
    usable: Tensor,
    points: tuple[Tensor, Tensor] | None,
) -> Alignment:
    extent, A, covariance = spread(lines, theta, labels)
    worst = sigma * extent[:, 0].clamp(min=torch.finfo(theta.dtype).tiny).rsqrt()
    present = (data.weights > 0).sum(-1)
    conditions = (labels != OUTLIER).sum(-1) + 3 * (labels == STATIC).sum(-1) + (0 if points is None else 3 * points[0].shape[1])
    accident = ((labels != OUTLIER).sum(-1) < CONSENSUS * present) | (
        (conditions < TranslatingLinesMatrix.dof + SPARE) & (present > MINIMAL)
    )
    status = torch.where(worst > AMBIGUOUS, int(Status.AMBIGUOUS), torch.zeros_like(present))
    status = torch.where(accident, int(Status.NO_CONSENSUS), status)
    rank = _rank(lines, labels, sigma, usable, points)
    status = torch.where((rank <= RANKS[-1][0]) & (status == Status.OK), int(Status.AMBIGUOUS), status)
    status = torch.where(extent[:, 0] <= INDETERMINATE * extent[:, 1], int(Status.DEGENERATE), status)
    status = torch.where(usable, status, start.status.to(status))
    none = failed(status)
    labels = torch.where(none[:, None], OUTLIER, labels)
    zero = none[:, None, None]
    return Alignment(
        A=data.back(torch.where(zero, 0.0, A)),
        B=None,
        labels=data.back(labels),
        status=data.back(status),
        sigma=data.back(torch.where(none, 0.0, sigma)),
        covariance=data.back(torch.where(zero, 0.0, covariance * sigma.square()[:, None, None])),
        ambiguity=AMBIGUITY,
        warnings=_notices(rank, worst, none, status != Status.TOO_FEW, data.batch),
    )


def _rank(lines: Lines, labels: Tensor, sigma: Tensor, usable: Tensor, points: tuple[Tensor, Tensor] | None) -> Tensor:
    """Singular values ``(b,)`` of the estimation matrix above the noise: of the inliers, of all lines where there is no motion."""
    kept = lines.data.restricted((labels != OUTLIER) | ~usable[:, None])
    joined = _joined(kept, points)
    if joined.count < MINIMAL:
        return torch.full_like(labels[:, 0], MINIMAL)
    values = fit_matches(TranslatingLinesMatrix(), joined).singular_values
    noise = torch.where(usable, sigma, lines.floor) * torch.stack(lines.norm.scales).mean(0)
    noise = noise * joined.weights.square().sum(-1).sqrt()
    return (values > torch.maximum(ABOVE * noise[:, None], 1e-9 * values[:, :1])).sum(-1)


def _notices(rank: Tensor, worst: Tensor, none: Tensor, enough: Tensor, batch: tuple[int, ...]) -> tuple[Notice, ...]:
    found: list[Notice] = []
    least = 0
    for most, kind in RANKS:
        text = f"the estimation matrix has rank {{value:g}} of {MINIMAL} above the noise: {kind}; give two static points"
        found += notices(NoticeCode.PURE_TRANSLATION, text, rank, enough & (rank > least) & (rank <= most), batch)
        least = most
    text = "the worst direction of the motion, of norm 1, has a standard deviation of {value:.2g}; add lines or static points"
    found += notices(NoticeCode.UNCERTAIN, text, worst, ~none & (worst > UNCERTAIN), batch)
    return tuple(sorted(found, key=lambda notice: notice.problem))
