"""What reconstruct_pair() returns: two cameras and the trajectories of all points that both explain."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.core.solution import Status
from dyntorch.geometry.triangulation import reproject
from dyntorch.tasks.outcome import Notice, check_results


@dataclass(frozen=True, eq=False, repr=False)
class PairReconstruction:
    """Result of :func:`dyntorch.reconstruct_pair`.

    Attributes:
        cameras: ``(2, 3, 4)``, of a and of b; the last row is (0, 0, 0, 1) where they are affine.  Zero where the status says that
            there are none.
        points: ``(frames, N, 3)`` trajectories up to one affinity of space, first a's n points, then b's m.  Of corresponding
            points ``(frames, n, 4)``, homogeneous of norm 1, up to one collineation of space.  NaN where a point was not found.
        times: ``(frames,)`` seconds of a's clock.
        source: ``(N,)`` camera that a point was seen by: 0 = a, 1 = b; all 0 for corresponding points.
        labels: ``(N,)`` 0 outlier or not transferable, 1 found.
        r2: ``(N,)`` share of the motion of a point's epipolar coordinate that the other camera predicts, in stretches of time left
            out one after the other; of corresponding points the share of their frames within the threshold.
        matches: ``(m,)`` the track of a that a track of b is, -1 = none.
        distances: ``(n, m)`` rms distance between a track of a and one of b, in pixels of a; NaN where there is none.
        normals: ``(2, 2)`` unit normals of the epipolar lines of a and of b; of corresponding points NaN.
        fundamental: ``(3, 3)`` of norm 1, :math:`x_b^T F x_a = 0`.
        residuals: ``(N,)`` rms distance of each point from the epipolar lines that the other camera says, pixels.
        residual: the same of all points found.
        status: of :class:`dyntorch.Status`.
        warnings: what limits what the result can be trusted for.
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
    status: Status
    warnings: tuple[Notice, ...] = ()

    def images(self) -> Tensor:
        """Where both cameras see all points, ``(2, frames, N, 2)`` pixels: the tracks of one camera transferred to the other.

        Example:
            >>> import torch
            >>> from dyntorch.scenes.filmed import nonrigid_pair
            >>> from dyntorch.tasks.pair.pair import reconstruct_pair
            >>> scene = nonrigid_pair(12, 10, 60, generator=torch.Generator().manual_seed(0))
            >>> found = reconstruct_pair(scene.a, scene.b, scene.offset, fps=scene.fps)
            >>> truth = scene.images[0, :, 12:]
            >>> bool((found.images()[0, :, 12:] - truth).abs().max() < 1e-3)
            True
        """
        homogeneous = self.points.shape[-1] == 4
        points = self.points if homogeneous else torch.cat([self.points, torch.ones_like(self.points[..., :1])], dim=-1)
        seen = reproject(self.cameras, points.nan_to_num().flatten(0, 1)).unflatten(1, points.shape[:2])
        return torch.where(self.points.isnan().any(-1)[None, ..., None], torch.nan, seen)

    def check(self) -> PairReconstruction:
        """Raise where there is no reconstruction.

        Raises:
            ValueError: says why, and what to do.
        """
        check_results("reconstruct_pair", torch.tensor(int(self.status)), self.warnings)
        return self

    def __repr__(self) -> str:
        kind = "projective" if self.points.shape[-1] == 4 else "affine"
        frames, count = self.points.shape[:2]
        found, matched = int((self.labels > 0).sum()), int((self.matches >= 0).sum())
        lines = [f"PairReconstruction({kind}, frames={frames}, points={count}: {self.status.name})"]
        if self.status in (Status.OK, Status.AMBIGUOUS):
            first, second = (int(((self.labels > 0) & (self.source == k)).sum()) for k in (0, 1))
            of = f" ({first} of a, {second} of b)" if kind == "affine" else ""
            lines.append(
                f"  {found} found{of}, {count - found} outliers, {matched} seen by both; residual {self.residual:.3g} px rms"
            )
        return "\n".join(lines + [f"  warning {notice}" for notice in self.warnings])


def failure(points: tuple[int, int], times: Tensor, status: Status, notices: list[Notice], width: int) -> PairReconstruction:
    """Nothing found.

    Args:
        points: of a and of b.
        width: coordinates of a point, 3 or 4.
    """
    n, m = points
    count = n + m if width == 3 else n
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
        status=status,
        warnings=tuple(notices),
    )
