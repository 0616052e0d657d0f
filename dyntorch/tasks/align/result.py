"""What the alignment tasks return: the motion of the sensor, a label for every match, and what should be known about them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from dyntorch.core.limits import MIN_CONSENSUS
from dyntorch.core.matches import Matches
from dyntorch.core.outcome import Notice, NoticeCode, Outcome, Status, has_inliers, is_failure
from dyntorch.core.solution import Solution
from dyntorch.geometry.rigid import PlaneMotion

OUTLIER, STATIC, MOVING = 0, 1, 2


_RANK = "the estimation matrix has rank {value:g} of 63 above the noise, {most} for velocities that are "
_TURN = "; add points that move in other directions, or use {arg:model='rigid'}"
_LINES = "the estimation matrix has rank {value:g} of {full} above the noise: "
_WORST = "the worst direction of the {what}, of norm 1, has a standard deviation of {value:.2g}; "


class AlignNotice(NoticeCode):
    """What limits an alignment, and how it is said."""

    DEGENERATE = "degenerate", "the matches leave {value:g} of 26 equations on the tensor; the motion rests on its static matches"
    """The matches leave several tensors, exactly; the motion rests on static matches alone."""
    NEAR_STATIC = (
        "near_static",
        {
            "tensor": "the weakest equation on the tensor is only {value:.2g} times the noise; the motion rests on its static "
            "matches",
            "matches": "nearly nothing moves ({value:# match|# matches}); the motion rests on the static matches",
        },
    )
    """So little moves that the noise decides between tensors; the motion rests on the static matches."""
    FEW_MOVING = "few_moving", "{value:# match moves|# matches move}, {least} would determine the motion without static ones"
    """Fewer moving matches than determine the motion by themselves."""
    FEW_LINES = (
        "few_lines",
        "the moving matches lie on {value:# line|# lines}, {least} would determine the motion without static ones",
    )
    """The moving matches lie on fewer lines than determine the motion by themselves."""
    ONE_LINE = "one_line", "all moving matches lie on one line"
    """All moving matches lie on one line."""
    COLLINEAR = (
        "collinear",
        "the points of a view lie on a line, to {value:.2g} standard deviations; a plane needs points off it",
    )
    """All matches of a view lie on one line."""
    UNVERIFIED = (
        "unverified",
        "{value:# match stands|# matches stand} still in all views but one: a point that paused, or a static one mismatched in "
        "that view",
    )
    """Matches that stand still in all views but one: points that paused, or static points mismatched in that view."""
    PLANAR_VELOCITIES = "planar_velocities", f"{_RANK}in a plane{_TURN}"
    """The velocities lie in a plane."""
    LINEAR_VELOCITIES = "linear_velocities", f"{_RANK}along a line{_TURN}"
    """The velocities lie along one line."""
    EQUAL_VELOCITIES = "equal_velocities", f"{_RANK}equal{_TURN}"
    """All matches have one velocity, or all are static."""
    COMMON_VELOCITY = (
        "common_velocity",
        "no static match fixes the velocity common to all points, so their mean is taken as zero; label static ones "
        "({arg:static=})",
    )
    """No static match fixes the velocity common to all points."""
    PURE_TRANSLATION = (
        "pure_translation",
        {
            "static": f"{_LINES}all lines stand still; give two static points",
            "bodies": f"{_LINES}the lines belong to two rigid bodies that translate; give two static points",
            "translation": f"{_LINES}the lines only translate: the position and the scale of view 2 remain unknown, four degrees "
            "of freedom; give two static points",
        },
    )
    """The lines only translate: the motion is known up to a family, unless static points fix it."""
    OTHER_SOLUTION = (
        "other_solution",
        "the moving matches fit a family of motions, and only {value:# static one chooses|# static ones choose} among them; give "
        "more static matches",
    )
    """Another solution fits as well."""
    OTHER_BACKGROUND = (
        "other_background",
        "either {still:# match stands|# matches stand} still, as the labels say, or {value:# other one does|# others do}, which "
        "move alike: the views fit both; label static ones ({arg:static=}), add a view behind a change of their course, or raise "
        "{arg:options.min_static_share} over the share that may stand still and does not",
    )
    """Matches that move alike may as well be what stands still, and what stands still move."""
    UNCERTAIN = (
        "uncertain",
        {
            "matches": f"{_WORST}add matches or lower the noise",
            "lines": f"{_WORST}add lines or static points",
            "rigid": "the worst direction of the motion has a standard deviation of {value:.2g} radians or sizes of the scene; add "
            "matches, static ones or movers that change their speed",
        },
    )
    """The noise leaves the motion so uncertain that it says little."""
    PLANE_OPEN = (
        "plane_open",
        "the cameras turn and hardly move (the normal of the plane has a standard deviation of {value:.2g} radians): rotations are "
        "known, translations and the normal are not; move the camera",
    )
    """Calibrated cameras that only turn do not determine the plane."""
    TWO_PLANES = (
        "two_planes",
        "two planes, {value:.3g} degrees apart, explain the matches, both before the cameras; the other one and its motion are in "
        "other_motion; add a view from a third place, away from the line of the others",
    )
    """Two motions of calibrated cameras fit, and one of them is given."""
    CALIBRATION = (
        "calibration",
        "no motion of cameras of this calibration gives these homographies (lengths in the plane differ by {value:.2g}); check "
        "{arg:calibration=}, and that lens distortion is removed",
    )
    """The homographies speak against the calibration."""


@dataclass(frozen=True, eq=False, repr=False)
class Alignment(Outcome):
    """Result of ``align_planar``, ``align_points`` and ``align_lines``.

    Attributes:
        A: ``(*batch, d + 1, d + 1)`` motion of the sensor, view 2 to view 1, :math:`p_1 \\sim A\\,p_2` for static points;
            Frobenius norm 1; zero where the status says that there is none, the best one found for ``NO_CONSENSUS``.
        B: the same for view 3; None with two views.
        collineations: ``(*batch, views - 1, d + 1, d + 1)``: A, B, and the same for every further view.
        labels: ``(*batch, n)`` 0 outlier, 1 static, 2 moving; all 0 where the status is neither OK nor AMBIGUOUS.
        sigma: ``(*batch,)`` noise of one coordinate that the inliers show, in the unit of the matches; 0 where there are none.
        covariance: ``(*batch, p, p)`` of the entries of A, then those of B (and of further views), row by row.
        ambiguity: a sentence: what the data cannot tell, even without noise.
        velocities: ``(*batch, n, d)``, where the model has them.
        unverified: ``(*batch, n)`` matches that stand still in all views but one: moving by geometry, but a static point mismatched
            in one view looks the same.
        solution: the fitted invariant behind it.
        rotations: :math:`R_v`, ``(*batch, views, 3, 3)`` of determinant 1, with a calibration: :math:`X_v = R_v X_1 + t_v`, the
            first one the identity; zero where the status says that there is no motion.  None without a calibration.
        translations: :math:`t_v`, ``(*batch, views, 3)`` in units of the distance of the plane from camera 1; zero as well where
            the normal is not determined (notice ``plane_open``).
        normal: ``(*batch, 3)`` n of length 1, the plane in the frame of camera 1: :math:`n^T X_1 = 1`; zero as the translations.
        other_motion: with a calibration, rotations, translations and normal of another motion that explains the matches as well;
            zero where there is none (elsewhere notice ``two_planes``).
    """

    A: Tensor
    B: Tensor | None
    labels: Tensor
    sigma: Tensor
    covariance: Tensor
    ambiguity: str
    velocities: Tensor | None = None
    unverified: Tensor | None = None
    solution: Solution | None = field(default=None, repr=False)
    others: tuple[Tensor, ...] = field(default=(), repr=False)
    """Of the views after the third."""
    rotations: Tensor | None = None
    translations: Tensor | None = None
    normal: Tensor | None = None
    other_motion: PlaneMotion | None = field(default=None, repr=False)

    @property
    def collineations(self) -> Tensor:
        """The motion of every view after the first."""
        return torch.stack([part for part in (self.A, self.B, *self.others) if part is not None], dim=-3)

    def __post_init__(self) -> None:
        """Where the matches do not agree, no label, velocity or noise says otherwise."""
        good = has_inliers(self.status)
        for name in ("labels", "sigma", "velocities", "unverified"):
            value = getattr(self, name)
            if value is not None:
                kept = good[(..., *[None] * (value.ndim - good.ndim))]
                object.__setattr__(self, name, torch.where(kept, value, torch.zeros_like(value)))

    TASK = "align"
    REMEDIES: ClassVar[Mapping[Status, str]] = {
        Status.TOO_FEW: "too few matches are present in all views; give more",
        Status.DEGENERATE: "several motions fit all matches exactly; add matches that move otherwise, or use a model with fewer "
        "unknowns",
        Status.AMBIGUOUS: "other motions fit as well; add matches that differ more, lower the noise, or use a model with fewer "
        "unknowns",
        Status.NO_CONSENSUS: "no motion fits enough of the matches; raise {arg:threshold}, or give matches of which more belong "
        "to the model",
    }

    def has_notice(self, code: NoticeCode | str) -> Tensor:
        """Which problems have a notice of this code, ``(*batch,)`` bool.

        Raises:
            ValueError: there is no such code.
        """
        known = [c.value for c in AlignNotice]
        if code not in known:
            raise ValueError(f"code must be one of {', '.join(known)}, got {code!r}")
        result = torch.zeros(self.status.shape, dtype=torch.bool)
        for notice in self.notices:
            if notice.code == code:
                result[notice.problem] = True
        return result.to(self.status.device)

    def check(self) -> Self:
        """Raise where any problem failed.

        Raises:
            ValueError: says which problems failed, how, and what to do.
        """
        if self.solution is not None:
            self.solution.check()
        return super().check()

    def _telling(self, status: Status) -> Sequence[Notice]:
        """What a notice says of the data is no reason by itself."""
        return ()

    def __repr__(self) -> str:
        flat = self.labels.reshape(-1)
        names = {"static": STATIC, "moving": MOVING, "outlier": OUTLIER}
        counts = ", ".join(f"{int((flat == label).sum())} {name}" for name, label in names.items())
        lines = [self.head(matches=self.labels.shape[-1]), f"  labels: {counts}"]
        if self.sigma.numel():
            sigma = float(self.sigma.flatten().double().nan_to_num().median())
            lines.append(f"  noise: {sigma:.3g} per coordinate" + (" (median)" if self.status.ndim else ""))
        return "\n".join(lines + self.warning_lines())


def labels_of(still: Tensor, path: Tensor, data: Matches) -> Tensor:
    """Labels ``(b, n)`` of matches that agree with a static point, or with a moving one where they are not known to be static."""
    path = path if data.static is None else path & ~data.static
    return torch.where(data.weights > 0, torch.where(still, STATIC, torch.where(path, MOVING, OUTLIER)), OUTLIER)


def agrees_too_little(labels: Tensor, weights: Tensor, conditions: tuple[int, int], least: Tensor | int) -> Tensor:
    """Whether few of the matches are inliers ``(b,)``, or these fulfil few conditions: so many each static one, and each moving."""
    still, moving = (labels == STATIC).sum(-1), (labels == MOVING).sum(-1)
    fulfilled = conditions[0] * still + conditions[1] * moving
    return (still + moving < MIN_CONSENSUS * (weights > 0).sum(-1)) | (fulfilled < least)


def contradicts(rests: Tensor, known: Tensor, weights: Tensor) -> Tensor:
    """Whether fewer than half of the matches known to be static ``(..., n)`` rest by a motion ``(...)``."""
    known = known & (weights > 0)
    return 2 * (rests & known).sum(-1) < known.sum(-1)


MIN_STATIC_SUPPORT = 10  # static matches that decide among motions; a wrong motion makes 0 to 6 of 80 matches static
MIN_RIVAL_SHARE = 0.9  # of the matches explained that a rival explains as well


def count_rival_static(labels: Tensor, rival: Tensor, data: Matches, min_share: float) -> Tensor:
    """Matches ``(b,)`` that move by some labels and stand still by those of a rival motion; 0 where it explains fewer, or too few
    stand still to be the background, or fewer of those that are known to."""
    explained, still = (labels != OUTLIER).sum(-1), ((rival == STATIC) & (labels == MOVING)).sum(-1)
    fits = (rival != OUTLIER).sum(-1) >= MIN_RIVAL_SHARE * explained
    fits = fits & (still >= min_share * explained) & (still >= MIN_STATIC_SUPPORT)
    if data.static is not None:
        known = data.static & (data.weights > 0)
        fits = fits & ((known & (rival == STATIC)).sum(-1) >= (known & (labels == STATIC)).sum(-1))
    return torch.where(fits, still, 0)


def status_of_alignment(ambiguous: Tensor, accident: Tensor, undetermined: Tensor, few: Tensor) -> Tensor:
    """The gravest status ``(b,)`` of: the noise leaves other motions, too little agrees, several fit exactly, too few matches."""
    status = torch.where(ambiguous, int(Status.AMBIGUOUS), int(Status.OK))
    status = torch.where(accident, int(Status.NO_CONSENSUS), status)
    status = torch.where(undetermined, int(Status.DEGENERATE), status)
    return torch.where(few, int(Status.TOO_FEW), status)


def alignment_of(
    data: Matches, status: Tensor, motion: Sequence[Tensor], labels: Tensor, sigma: Tensor, covariance: Tensor,
    velocities: Tensor | None = None, **more: Any,
) -> Alignment:  # fmt: skip
    """The result of a flat batch in the caller's; zero, and all matches outliers without velocity, where there is no motion."""
    none = is_failure(status)

    def back(value: Tensor) -> Tensor:
        return data.back(torch.where(none[(..., *[None] * (value.ndim - 1))], torch.zeros_like(value), value))

    if velocities is not None:
        velocities = back(torch.where((labels == OUTLIER)[..., None], 0.0, velocities))
    A, *others = map(back, motion)
    return Alignment(
        A=A,
        B=others[0] if others else None,
        labels=back(labels),
        status=data.back(status),
        sigma=back(sigma),
        covariance=back(covariance),
        velocities=velocities,
        **more,
    )


def solved_alignment(
    solution: Solution, data: Matches, labels: Tensor, ambiguity: str, notices: tuple[Notice, ...], **more: Any
) -> Alignment:
    """The result behind which there is a solution of an invariant, of a flat batch as the labels ``(b, n)``."""
    outcome = solution.back(data)
    A, B, *others = outcome.motion
    assert outcome.sigma is not None and outcome.covariance is not None
    return Alignment(
        A=A,
        B=B,
        labels=data.back(labels),
        status=outcome.status,
        sigma=outcome.sigma,
        covariance=outcome.covariance,
        ambiguity=ambiguity,
        notices=notices,
        solution=outcome,
        others=tuple(others),
        **more,
    )


# ----------------------------------------------------------------------------------------------------------------------
# What a user of align_planar(), align_points() or align_lines() may know of his data, or pays with.


@dataclass(frozen=True)
class AlignOptions:
    """What :func:`dyntorch.align_planar`, :func:`dyntorch.align_points` and :func:`dyntorch.align_lines` take and expect."""

    num_samples: int | None = None
    """Minimal samples drawn (time); None is what each model needs at 20 to 40 % of static matches: 150 to 2000.  Rigid and
    projective constant-velocity motions have fixed numbers of their own."""
    min_static_share: float = 0.1
    """Least share of the matches (and at least 3) that may be the static background: of one velocity, where all are at constant
    velocity; elsewhere a smaller group that moves alike leaves the answer without doubt."""
    max_deviation: float = 0.05
    """Standard deviation of the worst direction of a motion of norm 1 (rigid: radians, or sizes of the scene) without a notice."""
