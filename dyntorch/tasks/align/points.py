"""align_points(): the motion of a 3D sensor among points of space that stand still, move, or are mismatched."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, get_args

import torch
from torch import Tensor

from dyntorch.core.invariant import Invariant
from dyntorch.core.limits import MIN_INFORMATION
from dyntorch.core.matches import Matches, matches
from dyntorch.core.outcome import Notice, Status, in_order, is_failure, noting
from dyntorch.core.solution import Solution
from dyntorch.invariants.join_tensor import JoinTensor
from dyntorch.invariants.minimal_join_tensor import MinimalJoinTensor
from dyntorch.numerics.arguments import check_options, check_threshold
from dyntorch.numerics.blocks import one_thread
from dyntorch.numerics.messages import Message
from dyntorch.tasks.align import rigid, velocity
from dyntorch.tasks.align.labelling import (
    Evidence,
    Labelled,
    moving_points,
    normalized_motion,
    other_background,
    static_start,
    status_of_labels,
    tensor_start,
    trajectory_lines,
    without_failures,
)
from dyntorch.tasks.align.result import MOVING, OUTLIER, STATIC, Alignment, AlignNotice, AlignOptions, solved_alignment

# ----------------------------------------------------------------------------------------------------------------------
# Projective motions of a sensor among points of space that move on straight lines.


MIN_JOIN = 47
MIN_LABELLED_JOIN = 9
"""Fewest matches where some are labelled static: five determine A and B, and room to tell static from moving."""
MIN_MOVERS, MIN_LINES = 40, 10
"""Moving matches, and lines they lie on, that determine the tensors where nothing stands still (thesis section 8.2)."""
ENOUGH = 5  # static matches that determine A and B by themselves

AMBIGUITY = Message(
    "The collineations are unique, each up to its scale, unless the steps of all points keep one ratio (constant velocity): then "
    "they are known up to a velocity common to all points; of three views use {arg:model='constant_velocity'}. A match that "
    "agrees in all views but one counts as moving: a point that paused and a static point mismatched in that view look the same."
)


MIN_JOIN_MATCHES = 60  # from which on the join tensor itself gives a start
NUM_JOIN_SAMPLES = 1000  # of five: 97 % to draw five static ones where they are 20 % of all
MAX_JOIN_STEPS = 30  # of the final refinement
MAX_JOIN_DEVIATION = 0.5  # of the worst direction of a motion of norm 1, above which it is not known at all
MIN_SPARE_JOIN = 10  # conditions beyond the degrees of freedom that inliers must fulfil


def align_join(
    data: Matches, threshold: float | None, model: str, generator: torch.Generator | None, options: AlignOptions
) -> Alignment:
    """:func:`dyntorch.align_points` with a join tensor, for checked matches."""
    evidence = Evidence.of(moving_points(3, len(data.views)), data)
    best = _search(evidence, threshold, model, generator, options)
    solution, best, worst, rival = _solve(evidence, best, generator, options)
    notices = _notices(evidence, best, worst, rival, solution.status, data.batch, options)
    return solved_alignment(solution, data, best.labels, AMBIGUITY, notices)


def _search(
    evidence: Evidence, threshold: float | None, model: str, generator: torch.Generator | None, options: AlignOptions
) -> Labelled:
    """The best of the motions that static samples and the tensors lead to."""
    given, count = evidence.given_noise(threshold), evidence.data.count
    # of so few matches no half determines a motion, so that the noise cannot be told from outliers
    plain = (given is None and count < 3 * JoinTensor.dof) or not len(evidence.floor)

    def start(invariant: Invariant, evidence: Evidence) -> tuple[Tensor, Tensor]:
        return tensor_start(invariant, evidence, given, generator, plain=plain)

    starts = [static_start(evidence, given, options.num_samples or NUM_JOIN_SAMPLES, generator)]
    starts += [start(MinimalJoinTensor(), evidence)] if count >= MIN_JOIN else []
    full, size = model == "join" and count >= MIN_JOIN_MATCHES, len(evidence.floor)
    if given is None:
        starts += [start(JoinTensor(), evidence)] if full else []
        # the least estimate is that of a motion most matches agree with; it may be low, for static matches show half the noise
        sigma = 2 * torch.stack([noise for _, noise in starts]).amin(0).maximum(evidence.floor)
        theta = evidence.improve_starts([theta for theta, _ in starts], sigma, sampled=True)
    else:
        sigma, theta = given, evidence.improve_starts([theta for theta, _ in starts], given, sampled=True)
        # where the noise is known, so is whether the motion of the minimal tensor is the right one
        doubt = _doubt(evidence, theta[-size:], given) if full else torch.zeros_like(given)
        if bool(doubt.any()):
            part = replace(evidence, data=replace(evidence.data, weights=evidence.data.weights * doubt[:, None]))
            last, _ = start(JoinTensor(), part)
            theta = torch.cat([theta, evidence.improve_starts([last], given, sampled=False)])
    return evidence.iterate_labels(evidence.best_start(theta, sigma), sigma, estimate=given is None)


def _doubt(evidence: Evidence, theta: Tensor, sigma: Tensor) -> Tensor:
    """1 for problems ``(b,)`` whose motion fewer than half of the matches agree with, or fewer moving ones than determine one."""
    labels, invariant = evidence.labels(theta, sigma), evidence.invariant
    moving, agreeing, present = ((labels == MOVING).sum(-1), (labels != OUTLIER).sum(-1), (evidence.data.weights > 0).sum(-1))
    return ((2 * agreeing <= present) | (moving * invariant.codim <= invariant.dof)).to(theta)


def _solve(
    evidence: Evidence, best: Labelled, generator: torch.Generator | None, options: AlignOptions
) -> tuple[Solution, Labelled, Tensor, Tensor]:
    """The solution with its status, the final labels (none where there is no motion), the worst standard deviation, and how many
    matches stand still by a rival motion."""
    refined = evidence.refine(best.theta, best.labels, MAX_JOIN_STEPS)
    theta = normalized_motion(refined)
    values, spread = evidence.information(theta, best.labels)
    labels = evidence.labels(theta, best.sigma, spread)
    worst = best.sigma * values[:, 0].clamp(min=torch.finfo(values.dtype).tiny).rsqrt() * torch.stack(evidence.norm.scales).amax(0)
    best = Labelled(theta, labels, best.sigma)
    undetermined = values[:, 0] <= MIN_INFORMATION * values[:, -1]
    status = status_of_labels(evidence, best, worst > MAX_JOIN_DEVIATION, undetermined, False, MIN_SPARE_JOIN, (MIN_JOIN, ENOUGH))
    rival = other_background(
        evidence, best, status == Status.OK, options.num_samples or NUM_JOIN_SAMPLES, options.min_static_share, generator
    )
    status = torch.where(rival > 0, int(Status.AMBIGUOUS), status)
    solution, labels = without_failures(refined, status, labels, worst)
    return solution, replace(best, labels=labels), worst, rival


def _notices(
    evidence: Evidence, best: Labelled, worst: Tensor, rival: Tensor, status: Tensor, batch: tuple[int, ...], options: AlignOptions
) -> tuple[Notice, ...]:
    solved = ~is_failure(status)
    moving, still = (best.labels == MOVING).sum(-1), (best.labels == STATIC).sum(-1)
    found, note = noting(batch)
    note(AlignNotice.OTHER_BACKGROUND, rival, rival > 0, still=still)
    note(AlignNotice.FEW_MOVING, moving, solved & (moving < MIN_MOVERS) & (still < ENOUGH), least=f"{MIN_MOVERS} and more")
    note(AlignNotice.NEAR_STATIC, moving, solved & (moving < MIN_LINES) & (still >= ENOUGH), case="matches")
    lines = trajectory_lines(evidence, best, MIN_LINES)
    note(AlignNotice.FEW_LINES, lines, solved & (moving > lines) & (lines < MIN_LINES), least=MIN_LINES)
    note(AlignNotice.UNCERTAIN, worst, solved & (worst > options.max_deviation), case="matches", what="motion")
    return in_order(found)


# ----------------------------------------------------------------------------------------------------------------------
# align_points(): the motion of a 3D sensor among points of space that stand still, move, or are mismatched.


Model = Literal["join", "minimal_join", "constant_velocity", "affine_constant_velocity", "rigid"]
Motion = Literal["straight", "constant_velocity"]
LEAST = {
    "join": MIN_JOIN,
    "minimal_join": MIN_JOIN,
    "constant_velocity": velocity.MINIMAL[False],
    "affine_constant_velocity": velocity.MINIMAL[True],
    "rigid": 3,
}
LABELLED = {**LEAST, "join": MIN_LABELLED_JOIN, "minimal_join": MIN_LABELLED_JOIN}
"""Fewest matches where some are labelled static."""


@one_thread
def align_points(
    P1: Tensor,
    P2: Tensor,
    P3: Tensor,
    *more: Tensor,
    model: Model = "join",
    motion: Motion = "straight",
    threshold: float | None = None,
    weights: Tensor | None = None,
    static: Tensor | None = None,
    generator: torch.Generator | None = None,
    options: AlignOptions | None = None,
) -> Alignment:
    r"""Motion of a 3D sensor from three or more views of points, with a label for every match: static, moving or outlier.

    ============================  =========================  ===================================  ==========================
    model                         sensor                     points move                          matches
    ============================  =========================  ===================================  ==========================
    ``join``                      projective                 on straight lines, at any speed      47 (9 with ``static``)
    ``minimal_join``              projective                 the same; starts from 4 x 4 x 3      47 (9 with ``static``)
    ``constant_velocity``         projective                 at constant velocity                 21
    ``affine_constant_velocity``  affine                     at constant velocity                 7
    ``rigid``                     metric, A, B in SE(3)      as ``motion`` says                   6 moving, or 3 static
    ============================  =========================  ===================================  ==========================

    All three positions of a point, carried into view 1, lie on one line, or at equal steps on it:

    .. math:: P_1, A P_2, B P_3 \text{ collinear}, \qquad P_t \sim A_t\,(x + t\,v), \quad A = A_0 A_1^{-1},\ B = A_0 A_2^{-1} .

    The models ``join`` and ``minimal_join`` take any number of views: all positions of a moving point lie on one line.  Three at a
    time give the start; labels and motion are those of all views.

    No static point is needed, nor outliers be known.  The robust estimate is refined to least whitened residuals (Sampson
    distances), static matches by their disagreement, moving ones by what their model demands, and matches are labelled in
    turns with it.

    There is no calibration to give: a 3D sensor that measures metres is Euclidean as it is, and ``model="rigid"`` says that it
    does; before a projective or affine one nothing that could be known of it in advance is asked for.

    Args:
        P1: ``(*batch, n, 3)`` points of view 1; NaN = missing.
        P2: the same points in view 2.
        P3: the same points in view 3; for constant velocity the three views are at equal steps of time.
        *more: the same points in further views (``join``, ``minimal_join``); the last one may be the model.
        model: see the table.
        motion: of the points before a rigid sensor: ``"straight"``, at any speed, or ``"constant_velocity"``.
        threshold: three standard deviations of the noise of one coordinate, in the unit of the points: labels are decided at
            99.7 %.  None estimates the noise of every problem (at least half of the matches must be inliers).
        weights: ``(*batch, n)`` not negative; 0 leaves a match out.
        static: ``(*batch, n)`` bool, matches known not to move (they may still be outliers).
        generator: source of the random samples.
        options: what the search takes and expects; None is :class:`dyntorch.AlignOptions` as it is.

    Returns:
        An :class:`~dyntorch.tasks.align.result.Alignment`.  Rigid A and B have 1 as last entry, all others norm 1.  With constant
        velocity ``velocities`` ``(*batch, n, 3)`` are the displacements per step in the frame of view 1 (0 for outliers), and
        static matches fix the velocity common to all points; ``ambiguity`` says what is chosen where there are none.
        ``collineations`` holds A, B and those of further views.

    Raises:
        ValueError: unknown model or motion, more than three views for a model of three, fewer matches than in the table, shapes,
            dtypes or devices that do not agree, a threshold that is not positive.

    Source: thesis sections 8.2 and 8.3.

    Example:
        >>> import torch, dyntorch as dyn
        >>> from dyntorch import scenes
        >>> draw = torch.Generator().manual_seed(0)
        >>> scene = scenes.moving_points(20, sigma=0.01, sensors="rigid", generator=draw)  # everything moves
        >>> result = dyn.align_points(*scene.views, model="rigid", threshold=0.03, generator=draw)
        >>> A = scene.motion[0] / scene.motion[0][3, 3]
        >>> bool((result.A - A).abs().max() < 0.05), bool((result.labels == 2).all())
        (True, True)
    """
    views = (P1, P2, P3, *more)
    if model not in get_args(Model):
        raise ValueError(f"model must be one of {', '.join(get_args(Model))}, got {model!r}")
    if motion not in get_args(Motion):
        raise ValueError(f"motion must be one of {', '.join(get_args(Motion))}, got {motion!r}")
    if motion != "straight" and model != "rigid":
        text = (
            "{arg:motion='{motion}'} belongs to {arg:model='rigid'}, got {arg:model='{model}'}; use {arg:model='constant_velocity'}"
        )
        raise ValueError(Message(text, motion=motion, model=model))
    options = AlignOptions() if options is None else options
    check_options(options, AlignOptions)
    check_threshold(threshold)
    if len(views) > 3 and model not in ("join", "minimal_join"):
        text = "{arg:model='{model}'} takes three views, got {count}; {arg:model='join'} takes any number"
        raise ValueError(Message(text, model=model, count=len(views)))
    data = matches(moving_points(3, len(views)), views, weights, static)
    least = (LEAST if static is None else LABELLED)[model]
    if data.count < least:
        text = "align_points with {arg:model='{model}'} needs at least {least} matches, got {count}; add matches"
        raise ValueError(Message(text, model=model, least=least, count=data.count))
    with torch.no_grad():
        if model == "rigid":
            return rigid.align_rigid(data, threshold, motion, generator, options)
        if model in ("join", "minimal_join"):
            return align_join(data, threshold, model, generator, options)
        return velocity.align_velocity(data, threshold, model == "affine_constant_velocity", generator, options)
