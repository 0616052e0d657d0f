"""What reconstruct_pair() returns: two cameras and the trajectories of all points that both explain."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.core.outcome import Notice, NoticeCode, Outcome, Status, has_inliers
from dyntorch.geometry.triangulation import reproject


class PairNotice(NoticeCode):
    """Why two cameras give no reconstruction, or what limits it, and how it is said."""

    FEW_OBSERVED = (
        "few_observed",
        "{value:# position is|# positions are} seen by both cameras, {needed} are needed; give more frames or points, check "
        "{arg:shift}",
        Status.TOO_FEW,
    )
    """Points seen in too few frames."""
    SHORT_OVERLAP = (
        "short_overlap",
        "the cameras have {value:# frame|# frames} in common, {needed} are needed; check {arg:shift} and {arg:fps}, film longer, "
        "or take fewer points",
        Status.TOO_FEW,
    )
    """Two cameras have too few frames in common."""
    FEW_POINTS = (
        "few_points",
        {
            "shown": "camera {camera:{which}} shows {value:# point|# points} in half of the frames, {needed} are needed; track "
            "more, or longer",
            "explained": "the cameras explain {a:# point|# points} of {camera:a} and {b:g} of {camera:b} of each other; check the "
            "{arg:shift}, or that both show one scene",
        },
    )
    """A camera shows too few points, long enough."""
    CHANCE = (
        "chance",
        "unrelated motions explain each other about as well: film longer, motion that changes faster, or check the {arg:shift}",
        Status.NO_CONSENSUS,
    )
    """Random data of the kind would fit as well."""
    DEGENERATE = (
        "degenerate",
        "the positions leave several fundamental matrices: the points stay in one plane, or hardly move; add points or motion",
        Status.DEGENERATE,
    )
    """The matches leave several fundamental matrices, exactly."""
    STATIC_SCENE = (
        "static_scene",
        "nothing moves in camera {camera:{which}}: {value:.2g} px beside a noise of {noise:.2g}; film more motion",
        Status.DEGENERATE,
    )
    """Nothing moves."""
    COLLINEAR = (
        "collinear",
        "all points of camera {camera:{which}} move along one line of the image ({value:.2g} px across it); film from elsewhere",
        Status.DEGENERATE,
    )
    """All points move along one line of the image."""
    TWO_MOTIONS = (
        "two_motions",
        "the cameras do not see one rigid motion (they differ by {value:.2g} times what is known of it): check the {arg:shift}, or "
        "that both show points of the same body",
        Status.NO_CONSENSUS,
    )
    """The motions before the two cameras are not one."""
    UNUSABLE = "unusable", "{said}", Status.TOO_FEW
    """A problem of a batch that would be refused as misuse by itself."""
    FREE_PLACES = (
        "free_places",
        "the mean places of the {a} and {b} points do not follow from their motions (residual {value:.2g} px without them): "
        "motions are right, places along the lines of sight are a guess",
    )
    """The mean places of the points do not follow from their motions."""


@dataclass(frozen=True, eq=False, repr=False)
class PairReconstruction(Outcome):
    """Result of :func:`dyntorch.reconstruct_pair`.

    Of a batch every attribute has the batch in front, filled up with NaN (whole numbers: -1) where problems have fewer frames.

    Attributes:
        cameras: ``(2, 3, 4)``, of a and of b; the last row is (0, 0, 0, 1) where they are affine.  Zero where the status says that
            there are none.
        points: ``(frames, N, 3)`` trajectories up to one affinity of space, first a's n points, then b's m.  Of corresponding
            points ``(frames, n, 4)``, of different ones before projective cameras ``(frames, N, 4)``, homogeneous of norm 1, up to
            one collineation of space.  NaN where a point was not found.
        times: ``(frames,)`` seconds of a's clock.
        source: ``(N,)`` camera that a point was seen by: 0 = a, 1 = b; all 0 for corresponding points.
        labels: ``(N,)`` 0 outlier or not transferable, 1 found.
        r2: ``(N,)`` share of the motion of a point's epipolar coordinate that the other camera predicts, in stretches of time left
            out one after the other; of projective cameras the share of a point's frames within the threshold.
        matches: ``(m,)`` the track of a that a track of b is, -1 = none.
        distances: ``(n, m)`` rms distance between a track of a and one of b, in pixels of a; NaN where there is none.
        normals: ``(2, 2)`` unit normals of the epipolar lines of a and of b; of projective cameras NaN.
        fundamental: ``(3, 3)`` of norm 1, :math:`x_b^T F x_a = 0`.
        residuals: ``(N,)`` rms distance of each point from the epipolar lines that the other camera says, pixels; of different
            points before projective cameras from its reprojection.
        residual: the same of all points found.
    """

    cameras: Tensor
    points: Tensor
    times: Tensor
    source: Tensor
    labels: Tensor
    r2: Tensor
    matches: Tensor
    distances: Tensor
    normals: Tensor
    fundamental: Tensor
    residuals: Tensor
    residual: float

    TASK = "reconstruct_pair"

    def images(self) -> Tensor:
        """Where both cameras see all points, ``(*batch, 2, frames, N, 2)`` pixels: one camera's tracks transferred to the other.

        Example:
            >>> import torch
            >>> from dyntorch.scenes.two_cameras import nonrigid_pair
            >>> from dyntorch.tasks.pair.pair import reconstruct_pair
            >>> scene = nonrigid_pair(12, 10, 60, generator=torch.Generator().manual_seed(0))
            >>> found = reconstruct_pair(scene.a, scene.b, scene.offset, fps=scene.fps)
            >>> truth = scene.images[0, :, 12:]
            >>> bool((found.images()[0, :, 12:] - truth).abs().max() < 1e-3)
            True
        """
        homogeneous = self.points.shape[-1] == 4
        points = self.points if homogeneous else torch.cat([self.points, torch.ones_like(self.points[..., :1])], dim=-1)
        seen = reproject(self.cameras, points.nan_to_num().flatten(-3, -2)).unflatten(-2, points.shape[-3:-1])
        return torch.where(self.points.isnan().any(-1)[..., None, :, :, None], torch.nan, seen)

    def __repr__(self) -> str:
        if self.status.ndim:
            return "\n".join([self.head(), *self.warning_lines()])
        kind = "projective" if self.points.shape[-1] == 4 else "affine"
        frames, count = self.points.shape[:2]
        found, matched = int((self.labels > 0).sum()), int((self.matches >= 0).sum())
        lines = [f"PairReconstruction({kind}, frames={frames}, points={count}: {Status(int(self.status)).name})"]
        if bool(has_inliers(self.status)):
            first, second = (int(((self.labels > 0) & (self.source == k)).sum()) for k in (0, 1))
            of = f" ({first} of a, {second} of b)" if bool((self.source > 0).any()) else ""
            lines.append(
                f"  {found} found{of}, {count - found} outliers, {matched} seen by both; residual {self.residual:.3g} px rms"
            )
        return "\n".join(lines + self.warning_lines())


Refusal = tuple[Notice, Status]


def failure(n: int, m: int, times: Tensor, refusal: Refusal, correspondence: bool, camera: str) -> PairReconstruction:
    """Nothing found of n and m points, and why."""
    notice, status = refusal
    width, count = 4 if correspondence or camera == "projective" else 3, n if correspondence else n + m
    like = {"dtype": torch.float64, "device": times.device}

    def empty(*shape: int) -> Tensor:
        return torch.full(shape, torch.nan, **like)  # type: ignore[call-overload]

    source = torch.arange(count, device=times.device) >= n
    none = torch.zeros(count, dtype=torch.long, device=times.device)
    return PairReconstruction(
        cameras=torch.zeros(2, 3, 4, **like),  # type: ignore[call-overload]
        points=empty(len(times), count, width),
        times=times,
        source=source.long(),
        labels=none,
        r2=empty(count),
        matches=torch.full((m,), -1, dtype=torch.long, device=times.device),
        distances=empty(n, m),
        normals=empty(2, 2),
        fundamental=torch.zeros(3, 3, **like),  # type: ignore[call-overload]
        residuals=empty(count),
        residual=float("nan"),
        status=torch.tensor(int(status), device=times.device),
        notices=(notice,),
    )
