"""align_points(): the motion of a 3D sensor among points of space that stand still, move, or are mismatched."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor

from dyntorch.core.matches import Matches, matches
from dyntorch.numerics.arguments import check_options, check_threshold
from dyntorch.numerics.blocks import one_thread
from dyntorch.numerics.messages import Message
from dyntorch.tasks.align import join, rigid, velocity
from dyntorch.tasks.align.options import AlignOptions
from dyntorch.tasks.align.result import Alignment
from dyntorch.tasks.align.several import moving_points

Model = Literal["join", "minimal_join", "constant_velocity", "affine_constant_velocity", "rigid"]
Motion = Literal["straight", "constant_velocity"]
LEAST = {
    "join": join.MINIMAL["join"],
    "minimal_join": join.MINIMAL["minimal_join"],
    "constant_velocity": velocity.MINIMAL[False],
    "affine_constant_velocity": velocity.MINIMAL[True],
    "rigid": 3,
}
LABELLED = {**LEAST, "join": join.LABELLED, "minimal_join": join.LABELLED}
"""Fewest matches where some are labelled static."""


@one_thread
def align_points(
    P1: Tensor,
    P2: Tensor,
    P3: Tensor,
    *more: Tensor | Model,
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
    views, model = _views_and_model((P1, P2, P3, *more), model)
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
        return _dispatch(data, model, threshold, motion, generator, options)


def _views_and_model(given: tuple[Tensor | Model, ...], model: Model) -> tuple[tuple[Tensor, ...], Model]:
    """The views, and the model, which stood behind three of them before there could be more."""
    last = given[-1]
    if isinstance(last, str):
        given, model = given[:-1], last
    views = tuple(x for x in given if not isinstance(x, str))
    if len(views) < len(given):
        raise ValueError(
            f"model stands behind the views or is given by name, got {[x for x in given if isinstance(x, str)]} before"
        )
    return views, model


def _dispatch(
    data: Matches, model: str, threshold: float | None, motion: str, generator: torch.Generator | None, options: AlignOptions
) -> Alignment:
    if model == "rigid":
        return rigid.align_rigid(data, threshold, motion, generator, options)
    if model in ("join", "minimal_join"):
        return join.align_join(data, threshold, model, generator, options)
    return velocity.align_velocity(data, threshold, model == "affine_constant_velocity", generator, options)
