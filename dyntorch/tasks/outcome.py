"""What should be known about the data of one problem before its result is trusted: notices with their figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import torch
from torch import Tensor

from dyntorch.core.solution import check_status


class NoticeCode(StrEnum):
    """What a :class:`Notice` is about."""

    DEGENERATE = "degenerate"
    """The matches leave several tensors, exactly; the motion rests on static matches alone."""
    NEAR_STATIC = "near_static"
    """So little moves that the noise decides between tensors; the motion rests on the static matches."""
    FEW_MOVING = "few_moving"
    """Fewer moving matches than determine the motion by themselves."""
    FEW_LINES = "few_lines"
    """The moving matches lie on fewer lines than determine the motion by themselves."""
    ONE_LINE = "one_line"
    """All moving matches lie on one line."""
    COLLINEAR = "collinear"
    """All matches of a view lie on one line."""
    UNVERIFIED = "unverified"
    """Matches that stand still between two views only: points that paused, or static points mismatched in one view."""
    PLANAR_VELOCITIES = "planar_velocities"
    """The velocities lie in a plane."""
    LINEAR_VELOCITIES = "linear_velocities"
    """The velocities lie along one line."""
    EQUAL_VELOCITIES = "equal_velocities"
    """All matches have one velocity, or all are static."""
    COMMON_VELOCITY = "common_velocity"
    """No static match fixes the velocity common to all points."""
    PURE_TRANSLATION = "pure_translation"
    """The lines only translate: the motion is known up to a family, unless static points fix it."""
    STATIC_SCENE = "static_scene"
    """Nothing moves: the model leaves more than its tensor."""
    STATIC_MOVES = "static_moves"
    """Points given as static that move."""
    TURNING_CAMERA = "turning_camera"
    """The centres of all cameras are one point."""
    UNIFORM_CAMERA = "uniform_camera"
    """The camera itself moves at constant velocity, which the points' velocities cannot be told from."""
    WEAK_STACK = "weak_stack"
    """The projections of all views nearly share a centre: points are known badly along it."""
    BEHIND = "behind"
    """Points behind cameras, or at infinity, in every frame."""
    FEW_OBSERVED = "few_observed"
    """Points seen in too few views."""
    UNUSED_VIEW = "unused_view"
    """A view whose camera was not found."""
    ONE_BODY = "one_body"
    """All points belong to one of the two bodies, or too few to the other."""
    FEW_PLANES = "few_planes"
    """Fewer planes and bodies than determine the homography at infinity."""
    UNUSED_PLANE = "unused_plane"
    """A homography or fundamental matrix that is singular, not finite, or has too few matches."""
    COLLINEAR_EPIPOLES = "collinear_epipoles"
    """The epipoles lie on one line: all motion is parallel to one plane."""
    COPLANAR_NORMALS = "coplanar_normals"
    """The normals of the planes lie in one plane: all planes are parallel to one line."""
    SHARED_BODY = "shared_body"
    """Two planes or bodies that move alike."""
    STATIC_BODY = "static_body"
    """A plane that does not move against the cameras, or is infinitely far."""
    NO_COMMON_INFINITY = "no_common_infinity"
    """No homography at infinity is common to the planes, or they are too noisy to tell."""
    CHANCE = "chance"
    """Random data of the kind would fit as well."""
    CALIBRATION = "calibration"
    """The homography at infinity and the calibration do not make a rotation."""
    OTHER_SOLUTION = "other_solution"
    """Another solution fits as well."""
    FEWER_BODIES = "fewer_bodies"
    """The matches carry fewer bodies than were asked for."""
    SPARE_BODY = "spare_body"
    """Fewer bodies than were asked for explain the matches as well."""
    COARSE = "coarse"
    """The threshold is large beside the spread of the points."""
    REPEATED = "repeated"
    """Many matches are the same."""
    INCOHERENT = "incoherent"
    """Few matches move like their neighbours."""
    SHORT_OVERLAP = "short_overlap"
    """Two cameras have too few frames in common."""
    FEW_POINTS = "few_points"
    """A camera shows too few points, long enough."""
    FREE_PLACES = "free_places"
    """The mean places of the points do not follow from their motions."""
    UNCERTAIN = "uncertain"
    """The noise leaves the motion so uncertain that it says little."""


def check_threshold(threshold: float | None) -> None:
    """Refuse what is not one distance.

    Raises:
        ValueError: not a number, not positive, or not finite.
    """
    try:
        value = 1.0 if threshold is None else float(threshold)
    except (TypeError, ValueError, RuntimeError):
        value = float("nan")
    if not 0 < value < float("inf"):
        raise ValueError(f"threshold must be a positive distance in the unit of the points, got {threshold!r}; None estimates it")


@dataclass(frozen=True)
class Notice:
    """Something about the data of one problem that limits what its result can be trusted for.

    Attributes:
        code: what it is about.
        value: the measured figure behind it.
        message: one sentence with the figure and the remedy.
        problem: index into the batch, () for a single problem.
    """

    code: NoticeCode
    value: float
    message: str
    problem: tuple[int, ...] = ()

    def __str__(self) -> str:
        place = f"problem {', '.join(map(str, self.problem))}: " if self.problem else ""
        return f"{place}{self.code}: {self.message}"


def notices(code: NoticeCode, message: str, values: Tensor, flagged: Tensor, batch: tuple[int, ...]) -> list[Notice]:
    """A notice for every flagged problem.

    Args:
        code: what it is about.
        message: a sentence with ``{value:g}`` in it.
        values: ``(b,)`` figures.
        flagged: ``(b,)`` bool.
        batch: shape that the flat dimension b comes from.
    """
    # one copy: an accelerator would wait for every number
    figures = torch.where(flagged, values.detach().double(), torch.nan), flagged.double()
    found = []
    for flat, (value, counts) in enumerate(zip(*torch.stack(figures).tolist(), strict=True)):
        if not counts:
            continue
        place = tuple(int(i) for i in np.unravel_index(flat, batch)) if batch else ()
        found.append(Notice(code, value, message.format(value=value), place))
    return found


def check_results(what: str, status: Tensor, warnings: Sequence[Notice]) -> None:
    """Raise a ``ValueError`` where any problem failed, with what the notices say about it."""
    places = torch.arange(status.numel()).reshape(status.shape)
    check_status(what, status, [(int(places[notice.problem]), str(notice)) for notice in warnings])
