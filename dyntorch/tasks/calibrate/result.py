"""What calibrate() returns: cameras, lenses, clocks and moving points, how sure they are, and what the data leave open."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.core.outcome import Notice, NoticeCode, Status, status_from
from dyntorch.geometry.lens import distort
from dyntorch.tasks.synchronize.result import ClockOutcome, Clocks


class CalibrationNotice(NoticeCode):
    """Why cameras are not decided, or what to know besides, and how it is said."""

    CLOCKS = "clocks", "the clocks of the cameras are not decided: {first}", Status.AMBIGUOUS
    """Synchronization refused."""
    APART = (
        "apart",
        "{cameras:cameras}: fewer than {needed} positions are seen when another camera sees them; film together for longer, "
        "or leave the camera out",
        Status.TOO_FEW,
    )
    """A camera shares too little with the others."""
    STILL = (
        "still",
        "nobody moves: the points move by {value:.2g} times their noise; film people who walk about",
        Status.DEGENERATE,
    )
    """Nothing moves."""
    PLANE = (
        "plane",
        "all points move in one plane (a homography leaves no more than {value:.2g} times the noise): let people turn, and walk "
        "towards the cameras and away",
        Status.DEGENERATE,
    )
    """Planar motion."""
    TWO_FOCALS = (
        "two_focals",
        "two cameras of unknown focal lengths: their axes meet, and no picture tells both lengths; give {arg:focal}, say that both "
        "have one lens ({arg:one_lens=True}), or add a third camera",
        Status.DEGENERATE,
    )
    """Two cameras with two unknown focal lengths."""
    FOCAL = (
        "focal",
        {
            "": "{cameras:cameras}: the focal length is only known to {value:.1f} %; give {arg:focal}, or {arg:one_lens=True} "
            "where all cameras have one lens, or add a camera",
            "line": "{cameras:cameras}: the focal length is only known to {value:.1f} %, as all cameras stand in a line; give "
            "{arg:focal}, or put one elsewhere",
        },
        Status.AMBIGUOUS,
    )
    """A focal length is not decided."""
    ROTATION = (
        "rotation",
        "{cameras:cameras}: the rotation is only known to {value:.2f} degrees; film longer, let people walk through more of the "
        "picture, or give {arg:focal}",
        Status.AMBIGUOUS,
    )
    """A rotation is not decided."""
    CENTER = (
        "center",
        "{cameras:cameras}: the place is only known to {value:.1f} % of the distance from the people; film longer, or let people "
        "walk through more of the picture",
        Status.AMBIGUOUS,
    )
    """A centre is not decided."""
    RIVAL = (
        "rival",
        "another rig, in which a camera differs by {value:.0f} degrees, explains the pictures as well; give {arg:focal}, film "
        "longer, or add a camera",
        Status.AMBIGUOUS,
    )
    """Two rigs fit."""
    MOVED = (
        "moved",
        "{cameras:cameras} moved during the take: its pose differs by {value:.1f} degrees between the halves; use the part before "
        "or after, or leave the camera out",
        Status.NO_CONSENSUS,
    )
    """A camera that moved."""
    DISAGREES = (
        "disagrees",
        "{cameras:cameras}: only {value:.0f} % of the positions agree with the other cameras; check that it shows the same people, "
        "its clock and its lens",
        Status.NO_CONSENSUS,
    )
    """A camera that does not belong."""
    UNKNOWN_SCALE = (
        "unknown_scale",
        "the scale is unknown: lengths are in units of the median distance of the cameras from the people; give {arg:height} or "
        "{arg:lengths}",
    )
    """No length is known."""
    CAMERA_UP = (
        "camera_up",
        "no body stands upright for long ({value:.0f} % of the time): up is the mean upward direction of the cameras",
    )
    """Gravity from the cameras."""
    TWO = "two", "two cameras: nothing checks them; a third one would"
    """Nothing checks two cameras."""
    LINE = "line", "all cameras stand nearly in a line: depths along it are less sure"
    """Cameras in a line."""


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(ClockOutcome):
    r"""Cameras that were calibrated from what moves before them: :math:`x \sim K_i (R_i X + t_i)` at time
    :math:`t_i = \text{rate}_i\, t + \text{offset}_i` of each camera's clock.

    Attributes:
        K: ``(c, 3, 3)`` px.
        R, t: ``(c, 3, 3)``, ``(c, 3)`` world to camera.  The world's third axis points up, its origin lies on the ground below the
            people, its second axis points ahead of the first camera.
        distortion: ``(c, 5)`` OpenCV's k1, k2, p1, p2, k3.
        sizes: ``(c, 2)`` px.
        clocks: of all cameras against the first one's, better than synchronization alone.
        times: ``(T,)`` seconds of the first camera's clock, a frame of the slowest camera apart.
        points: ``(T, n, 3)``, from tracks smoothed by a Gaussian of one frame; NaN where two cameras do not tell.
        sigmas: ``(T, n)`` root mean square of a point's standard deviations along the axes.
        metric: whether lengths are metres; else the median distance of the cameras from the people is 1.
        upright: whether people said which way is up; else the cameras did.
        covariance: ``(c, 11, 11)`` of each camera: rotation vector about its own axes (radians), centre, logarithm of the focal
            length, k1, k2, clock at the middle (seconds), logarithm of the rate; 0 for what is held.  Changes of the whole world
            have no part in it; residuals that go on over time are accounted for.
        residuals: ``(c, n)`` px root mean square of the positions that agree; NaN where there is none.
        inliers: ``(c,)`` share of the positions that agree.
        fps: of the cameras.
        status: OK where the data decide, as ``ok`` says; ``reason`` says why not, in one sentence with what to do.
        notices: that reason, and what a user should know besides (``notes``).
    """

    K: Tensor
    R: Tensor
    t: Tensor
    distortion: Tensor
    sizes: Tensor
    clocks: Clocks
    times: Tensor
    points: Tensor
    sigmas: Tensor
    metric: bool
    upright: bool
    covariance: Tensor
    residuals: Tensor
    inliers: Tensor
    fps: tuple[float, ...]

    TASK = "calibrate"

    @classmethod
    def unknown(
        cls, sizes: Tensor, points: int, clocks: Clocks, fps: tuple[float, ...], notices: tuple[Notice, ...]
    ) -> Calibration:
        """A result without cameras, which are NaN.

        Args:
            sizes: ``(c, 2)`` px.
            points: n.
            clocks: as far as they are known.
            fps: of the cameras.
            notices: why there are none; the first that refuses says the status.
        """
        c = len(sizes)

        def empty(*shape: int) -> Tensor:
            return torch.full(shape, torch.nan, dtype=torch.float64)

        return cls(
            K=empty(c, 3, 3), R=empty(c, 3, 3), t=empty(c, 3), distortion=empty(c, 5), sizes=sizes, clocks=clocks, times=empty(0),
            points=empty(0, points, 3), sigmas=empty(0, points), metric=False, upright=False, covariance=empty(c, 11, 11),
            residuals=empty(c, points), inliers=empty(c), fps=fps, status=status_from(notices), notices=notices,
        )  # fmt: skip

    @property
    def centers(self) -> Tensor:
        """``(c, 3)`` where the cameras stand."""
        return -(self.R.mT @ self.t[..., None])[..., 0]

    @property
    def focals(self) -> Tensor:
        """``(c,)`` px."""
        return self.K[:, 0, 0]

    @property
    def focal_sigmas(self) -> Tensor:
        """``(c,)`` px; 0 where the focal length was given."""
        return self.focals * self.covariance[:, 6, 6].sqrt()

    @property
    def rotation_sigmas(self) -> Tensor:
        """``(c,)`` degrees: root mean square of the angle."""
        return torch.rad2deg(self.covariance.diagonal(dim1=-2, dim2=-1)[:, :3].sum(-1).sqrt())

    @property
    def center_sigmas(self) -> Tensor:
        """``(c,)``: root mean square of the distance, in the unit of the points."""
        return self.covariance.diagonal(dim1=-2, dim2=-1)[:, 3:6].sum(-1).sqrt()

    def project(self, points: Tensor) -> Tensor:
        """Images ``(c, ..., 2)`` px of points ``(..., 3)`` in all cameras, lenses included; NaN behind a camera."""
        seen = torch.einsum("cij,...j->c...i", self.R, points.double())
        seen = seen + self.t.view(-1, *[1] * (points.ndim - 1), 3)
        plane = torch.where(seen[..., 2:] > 0, seen[..., :2] / seen[..., 2:], torch.nan)
        flat = plane.flatten(1, -2) if plane.ndim > 2 else plane[:, None]
        x = flat @ self.K[:, :2, :2].mT + self.K[:, None, :2, 2]
        return distort(x, self.K, self.distortion).view(plane.shape)

    def __repr__(self) -> str:
        state = "ok" if self.ok else f"refused: {self.reason}"
        unit = " m" if self.metric else ""
        lines = [f"Calibration({len(self.K)} cameras, {tuple(self.points.shape[:2])} points, {state})"]
        rows = zip(
            self.focals.tolist(), self.focal_sigmas.tolist(), self.rotation_sigmas.tolist(), self.centers.tolist(),
            self.center_sigmas.tolist(), strict=True,
        )  # fmt: skip
        for camera, (focal, sigma, turn, center, away) in enumerate(rows):
            place = ", ".join(f"{value:+.3f}" for value in center)
            lines.append(
                f"  camera {camera}: f {focal:.0f} ± {sigma:.0f} px, at ({place}) ± {away:.3f}{unit}, rotation ± {turn:.2f} deg"
            )
        return "\n".join([*lines, *(f"  note: {note}" for note in self.notes)])
