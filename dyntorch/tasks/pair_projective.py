"""Two static cameras that see the same points: one fundamental matrix for the whole take, and projective structure per frame."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.algebra.triangulation import triangulate
from dyntorch.invariants.fundamental_matrix import FundamentalMatrix
from dyntorch.normalize import hartley
from dyntorch.residual import sampson
from dyntorch.robust import robust_fit
from dyntorch.solution import Status, failed
from dyntorch.tasks.notices import Notice, NoticeCode
from dyntorch.tasks.pair_result import PairReconstruction, failure
from dyntorch.tasks.pair_tracks import Overlap

SAMPLED = 4000
"""Positions that the fundamental matrix is searched from; its accuracy is then that of the noise's correlations."""
STEPS = 3
"""Gauss-Newton steps of the triangulation: the reprojection error no longer falls."""
LEAST = 12
"""Positions in both cameras: with fewer, agreement with some fundamental matrix is no evidence."""


def projective(seen: Overlap, threshold: float | None, explained: float, generator: torch.Generator | None) -> PairReconstruction:
    """The reconstruction of corresponding points.

    Args:
        seen: tracks of both cameras at the same moments.
        threshold: pixels, of the Sampson distance; None estimates it.
        explained: share of a point's frames that must be within it.
        generator: of the random samples.
    """
    frames, n = seen.a.shape[:2]
    both = (seen.a.isfinite() & seen.b.isfinite()).all(-1)
    if int(both.sum()) < LEAST or int(both.any(0).sum()) < 1:
        text = f"{int(both.sum())} positions are seen by both cameras, {LEAST} are needed; give more frames or points, check shift"
        notice = Notice(NoticeCode.FEW_OBSERVED, float(both.sum()), text)
        return failure((n, n), seen.times, Status.TOO_FEW, [notice], 4)
    # of unit size: neither the solver's nor the triangulation's precision depends on the unit
    x1, x2 = seen.a.nan_to_num(), seen.b.nan_to_num()
    chosen = both.flatten().nonzero()[:, 0]
    stride = -(-len(chosen) // SAMPLED)
    part = chosen[::stride]
    fitted = robust_fit(FundamentalMatrix, x1.flatten(0, 1)[part], x2.flatten(0, 1)[part], threshold=threshold, generator=generator)
    status = Status(int(fitted.status))
    if bool(failed(fitted.status)):
        text = (
            "the positions leave several fundamental matrices: the points stay in one plane, or hardly move; add points or motion"
        )
        return failure((n, n), seen.times, status, [Notice(NoticeCode.DEGENERATE, float(len(part)), text)], 4)
    F = fitted.tensor
    distance = sampson(FundamentalMatrix, F, x1.flatten(0, 1), x2.flatten(0, 1)).unflatten(0, (frames, n))
    distance = torch.where(both, distance.abs(), torch.nan)
    sigma = 0.0 if fitted.sigma is None else float(fitted.sigma)
    limit = threshold if threshold is not None else max(2.6 * sigma, 1e-9 * float(x1.abs().max()))
    share = torch.where(both, distance <= limit, False).sum(0) / both.sum(0).clamp(min=1)
    good = (share >= explained) & (both.sum(0) > 0)
    cameras, points = _structure(F, x1, x2, both, fitted.motion)
    points = torch.where((good & both)[..., None], points, torch.nan)
    residuals = distance.square().nanmean(0).sqrt()
    residual = float(distance[:, good].square().nanmean().sqrt())
    index = torch.arange(n, device=F.device)
    return PairReconstruction(
        cameras=cameras,
        points=points,
        times=seen.times,
        source=torch.zeros_like(index),
        labels=good.long(),
        r2=torch.where(both.any(0), share.double(), torch.nan),
        matches=torch.where(good, index, -1),
        distances=F.new_full((n, n), torch.nan),
        normals=F.new_full((2, 2), torch.nan),
        fundamental=F,
        residuals=residuals,
        residual=residual,
        status=status,
    )


def _structure(F: Tensor, x1: Tensor, x2: Tensor, both: Tensor, motion: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """Cameras ``(2, 3, 4)`` and points ``(frames, n, 4)``: the frame of :math:`[I \\mid 0],\\ [A \\mid e_2]`, of unit size."""
    views = torch.stack([x1.flatten(0, 1), x2.flatten(0, 1)])
    weights = both.flatten().to(views)
    T = hartley(views[..., None, :], weights.expand(2, -1))
    A, e2 = motion
    homography, epipole = T[1] @ A @ torch.linalg.inv(T[0]), T[1] @ e2
    second = torch.cat([homography / homography.norm(), (epipole / epipole.norm())[:, None]], dim=-1)
    first = torch.eye(3, 4, dtype=F.dtype, device=F.device)
    normal = torch.stack([first, second])
    moved = views * T[:, None, :1, 0] + T[:, None, :2, 2]
    points = triangulate(normal, moved, weights.expand(2, -1), steps=STEPS)
    cameras = torch.linalg.inv(T) @ normal
    return cameras / torch.linalg.matrix_norm(cameras, keepdim=True), points.unflatten(0, both.shape)
