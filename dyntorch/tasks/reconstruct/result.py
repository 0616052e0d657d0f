"""What ``reconstruct`` returns: cameras, points and velocities of a moving scene, and what should be known about them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from dyntorch.core.outcome import Notice, NoticeCode, Outcome, Status, is_failure
from dyntorch.geometry.homogeneous import inhomogeneous
from dyntorch.geometry.triangulation import reproject
from dyntorch.tasks.reconstruct.motions import Motion

_SMALLER = "a smaller model leaves a residual of {value:.2g}: "
_TAKE = "take {arg:motion='{smaller}'}"


class ReconstructNotice(NoticeCode):
    """What limits a reconstruction, and how it is said."""

    STATIC_SCENE = (
        "static_scene",
        {
            "": f"{_SMALLER}nothing moves, or too few points: {_TAKE}, or add moving points",
            "sensors": f"{_SMALLER}nothing moves, or too few points: add moving points",
        },
    )
    """Nothing moves: the model leaves more than its tensor."""
    TURNING_CAMERA = (
        "turning_camera",
        f"{_SMALLER}the points lie in a plane, or the camera stands still or only turns: let it move around points in space",
    )
    """The centres of all cameras are one point."""
    UNIFORM_CAMERA = (
        "uniform_camera",
        f"{_SMALLER}the camera stands still, only turns or itself moves at constant velocity, or all is in a plane: change its "
        "velocity",
    )
    """The camera itself moves at constant velocity, which the points' velocities cannot be told from."""
    LINEAR_VELOCITIES = "linear_velocities", f"{_SMALLER}the velocities have one direction: {_TAKE}"
    """The velocities lie along one line."""
    PLANAR_VELOCITIES = "planar_velocities", f"{_SMALLER}the velocities are parallel to a plane: {_TAKE}"
    """The velocities lie in a plane."""
    DEGENERATE = "degenerate", f"{_SMALLER}nothing is accelerated: {_TAKE}"
    """A smaller model explains the tracks."""
    ONE_BODY = (
        "one_body",
        {
            "": f"{_SMALLER}one body, too few points on the other, or a camera that only turns: {_TAKE}",
            "few": "{value:# point lies|# points lie} on the smaller body, {needed} determine it and others have to confirm it; "
            "add "
            "points on it",
        },
    )
    """All points belong to one of the two bodies, or too few to the other."""
    UNCERTAIN = (
        "uncertain",
        {
            "": "the noise makes the points uncertain by {value:.2g} of the size of the scene; add views, points or motion",
            "family": "several scenes give the same images; move points or the camera more",
        },
    )
    """The noise leaves the scene so uncertain that it says little."""
    WEAK_STACK = (
        "weak_stack",
        "the projections of all views nearly share a centre (singular value {value:.2g} of the largest); move the camera more",
    )
    """The projections of all views nearly share a centre: points are known badly along it."""
    FEW_OBSERVED = (
        "few_observed",
        {
            "points": "{value:# track is seen in fewer than {needed} views and has|# tracks are seen in fewer than {needed} "
            "views and "
            "have} no position; track {value:it|them} longer",
            "tracks": "{value:# track is|# tracks are} seen in {views} views or more, {motion!r} needs {needed} through the "
            "same ones; "
            "add tracks",
        },
    )
    """Points seen in too few views."""
    COLLINEAR = ("collinear", "the images of a view lie on a line, to {value:.2g} standard deviations; points off it are needed")
    """All images of a view lie on one line."""
    BEHIND = ("behind", "{value:# point|# points} behind a camera or at infinity; noise, or tracks that do not follow the motion")
    """Points behind cameras, or at infinity, in every frame."""
    UNUSED_VIEW = (
        "unused_view",
        "{value:# view shows fewer than {needed} tracks and has no camera; leave it out|# views show fewer than {needed} tracks "
        "and "
        "have no camera; leave them out}, or add tracks",
    )
    """A view whose camera was not found."""
    COMMON_VELOCITY = (
        "common_velocity",
        "{value:# of the static points has|# of the static points have} a position: the motion common to all points is not fixed",
    )
    """No static point fixes the velocity common to all points."""
    METRIC_FAMILY = (
        "metric_family",
        {
            "plane": "the calibration leaves a family of metric frames (singular value {value:.2g} of the largest): before a "
            "camera that only turns the slant of a plane is open; move the camera",
            "space": "the calibration leaves a family of metric frames (singular value {value:.2g} of the largest): the cameras "
            "turn and move too little against each other; add views from other places",
        },
    )
    """The calibration does not determine a metric frame."""
    METRIC_UNCERTAIN = (
        "metric_uncertain",
        "the metric frame is badly determined (before adjustment its entries are uncertain by {value:.2g}); let the camera move "
        "more, or add views",
    )
    """The noise leaves the metric frame uncertain."""
    METRIC_SEVERAL = (
        "metric_several",
        {
            "plane": "{value:.0f} metric frames fit as well: two views of a plane leave its slant open between two; add a view",
            "space": "{value:.0f} metric frames fit as well, with all points before the cameras; add a view",
        },
    )
    """Several metric frames fit, and one of them is given."""
    CALIBRATION = (
        "calibration",
        {
            "": "cameras of this calibration leave {value:.3g} times the noise that any cameras leave; check "
            "{arg:calibration=}, and that lens distortion is removed",
            "none": "cameras of this calibration leave {value:.3g} times the noise that any cameras leave, so that the scene "
            "stays as it is without; check {arg:calibration=}, and that lens distortion is removed",
        },
    )
    """The tracks speak against the calibration."""
    STATIC_MOVES = (
        "static_moves",
        "{value:# point given as static moves, and is taken as moving; take it|# points given as static move, and are taken as "
        "moving; "
        "take them} off {arg:static=}",
    )
    """Points given as static that move."""


class Ranked(NamedTuple):
    """How one model did when the model was to be chosen."""

    motion: str
    score: float
    """Penalized cost, less is better; infinite where the model failed or was not tried."""
    residual: float
    """Rms reprojection error in the unit of the tracks; NaN where there is none."""
    reason: str = ""
    """Why it was not tried; empty where it was."""


@dataclass(frozen=True, eq=False, repr=False)
class Reconstruction(Outcome):
    """Result of :func:`dyntorch.reconstruct`.

    Attributes:
        motion: the model.
        cameras: :math:`P_i`, ``(*batch, views, l + 1, d + 1)`` of norm 1, :math:`x_i \\sim P_i X(t_i)`; zero where the status says
            that there are none.  Of two bodies: those of body 1.
        points: ``(*batch, n, d)`` positions at time 0; NaN where a point was not found.  Of two bodies: each in the frame of its
            own body.
        velocities: ``(*batch, n, d)`` per unit of the times, at time 0; None for two bodies.
        labels: ``(*batch, n)`` 0 outlier or not found, 1 static (known only where static points were given), 2 moving; of two
            bodies 1 and 2.  All 0 where the status is neither OK nor AMBIGUOUS.
        residual: ``(*batch,)`` rms reprojection error of the observations that count, in the unit of the tracks.
        residuals: ``(*batch, views, n)`` reprojection distances; NaN where missing or not found.
        sigma: ``(*batch,)`` noise of one coordinate that the residuals show.
        structure: ``(*batch, n, K)`` homogeneous constants Y of the model, :math:`X(t) \\sim B(t)\\,Y`.
        projections: ``(*batch, views, l + 1, K)``, :math:`M_i \\sim P_i B_i`.
        inliers: ``(*batch, views, n)`` observations that count.
        times: ``(views,)``.
        ambiguity: a sentence: what the tracks cannot tell, even without noise.
        bodies: cameras of both bodies, ``(*batch, 2, views, l + 1, d + 1)``; None without.
        candidates: where the model was to be chosen, the models that were tried, best first, and those that could not be, with the
            reason.
        metric: ``(*batch,)`` bool, with a calibration: whether the scene is metric, known up to a similarity (and what
            ``ambiguity`` says of common motions); elsewhere everything is as without calibration, and a notice says why.  None
            without a calibration.
        rotations: :math:`R_i`, ``(*batch, views, 3, 3)`` of determinant 1, with a calibration; zero where the scene is not metric.
            :math:`P_i \\sim K_i [R_i \\mid t_i]`, of a plane (z = 0) without the third column of :math:`R_i`.
        translations: :math:`t_i`, ``(*batch, views, 3)``, in the unit of the points (of sensors: in that of the tracks); of two
            bodies those of both, ``(*batch, 2, views, 3)``.
        calibration: K that was given, ``(*batch, views, l + 1, l + 1)``.
    """

    motion: Motion
    cameras: Tensor
    points: Tensor
    velocities: Tensor | None
    labels: Tensor
    residual: Tensor
    residuals: Tensor
    sigma: Tensor
    structure: Tensor
    projections: Tensor
    inliers: Tensor
    times: Tensor
    ambiguity: str
    bodies: Tensor | None = None
    candidates: tuple[Ranked, ...] = field(default=())
    metric: Tensor | None = None
    rotations: Tensor | None = None
    translations: Tensor | None = None
    calibration: Tensor | None = None

    REMEDIES: ClassVar[Mapping[Status, str]] = {
        Status.TOO_FEW: "too few tracks are seen in enough views; track more points, or for longer",
        Status.DEGENERATE: "the tracks leave several scenes, exactly; let camera and points move otherwise, or take a smaller "
        "{arg:motion}",
        Status.AMBIGUOUS: "other scenes fit as well; add views and tracks, let the camera move more, or take a smaller "
        "{arg:motion}",
        Status.NO_CONSENSUS: "no scene fits enough of the tracks; raise {arg:threshold}, take another {arg:motion}, or clean the "
        "tracks",
    }

    def at(self, time: float) -> Tensor:
        """Positions ``(*batch, n, d)`` at any time; of two bodies the points, which rest in their frames.

        Example:
            >>> import torch, dyntorch as dyn
            >>> from dyntorch import scenes
            >>> scene = scenes.lifted_points("constant_velocity_2d", 30, generator=torch.Generator().manual_seed(0))
            >>> found = dyn.reconstruct(scene.tracks, "constant_velocity_2d")
            >>> bool(torch.allclose(found.at(2.0), found.points + 2 * found.velocities))
            True
        """
        if self.motion.lift is None:
            return self.points
        lift = self.motion.lifts([time])[0].to(self.structure)
        return torch.where(self.points.isnan(), self.points, inhomogeneous(self.structure @ lift.mT))

    def image(self, camera: Tensor, time: float) -> Tensor:
        """Where a camera ``(*batch, l + 1, d + 1)`` sees the points at any time, ``(*batch, n, l)``: views that nobody took."""
        if self.motion.lift is None:
            raise ValueError(f"{self.motion!r} says nothing about times between the views")
        lift = self.motion.lifts([time])[0].to(self.structure)
        seen = reproject((camera @ lift).unsqueeze(-3), self.structure).squeeze(-3)
        return torch.where(self.points.isnan().any(-1, keepdim=True), torch.nan, seen)

    @property
    def task(self) -> str:
        return self.motion.name

    def _telling(self, status: Status) -> Sequence[Notice]:
        """That nothing fits is no consequence of what a notice says of the scene that fits best."""
        return () if status == Status.NO_CONSENSUS else self.notices

    def __repr__(self) -> str:
        views, n = self.residuals.shape[-2:]
        lines = [
            f"Reconstruction({self.motion.name}, views={views}, points={n}, batch={tuple(self.status.shape)}: "
            f"{self.count_statuses()})"
        ]
        good = ~is_failure(self.status)
        if bool(good.any()):
            kinds = ("outlier", "body 1", "body 2") if self.motion.bodies > 1 else ("outlier", "static", "moving")
            kinds = ("outlier", "static", "static") if self.motion.static else kinds
            count = Counter(kinds[int(label)] for label in self.labels[good].flatten().tolist())
            lines.append("  labels: " + ", ".join(f"{count[kind]} {kind}" for kind in dict.fromkeys(kinds) if count[kind]))
            middle = float(self.residual[good].double().median())
            lines.append(f"  residual: {middle:.3g} rms" + (" (median)" if self.status.ndim else ""))
        if self.candidates:
            best = self.candidates[0].score
            tried = [c for c in self.candidates[1:] if not c.reason]
            others = ", ".join(f"{c.motion} (+{c.score - best:.0f})" for c in tried[:3])
            lines.append(f"  chosen by a penalized cost of {best:.0f}; then {others or 'no other'}")
            lines += [f"  not tried: {c.motion} ({c.reason})" for c in self.candidates if c.reason]
        if self.metric is not None:
            whole = f" in {int(self.metric.sum())} of {self.metric.numel()} problems" if self.metric.ndim else ""
            lines.append(f"  metric{whole}" if bool(self.metric.any()) else "  not metric")
        if self.ambiguity:
            lines.append(f"  {self.ambiguity}")
        return "\n".join(lines + self.warning_lines())


# ----------------------------------------------------------------------------------------------------------------------
# What a caller of ``reconstruct`` may ask for beside its arguments.


@dataclass(frozen=True)
class ReconstructOptions:
    """What a user can set in :func:`dyntorch.reconstruct`."""

    min_inlier_share: float = 0.4
    """Share of the points that must agree where tracks are wrong: .5 and more found 60 to 70 % outliers right in 3 of 28 scenes,
    wrong in 2."""
    max_search_rounds: int = 12
    """Rounds of random starts among wrong tracks, each as long as the first; 1 takes no random numbers."""
    max_uncertainty: float = 0.3
    """Expected error of the points over the size of the scene above which the status is AMBIGUOUS; true errors are about half."""
