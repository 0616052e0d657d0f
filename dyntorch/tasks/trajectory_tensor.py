r"""Uncalibrated cameras from points that move on straight lines: the tensor of six views, and bundle adjustment with lines."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.algebra.homogeneous import unit
from dyntorch.algebra.line_cameras import cameras_of_lines
from dyntorch.blocks import one_thread
from dyntorch.devices import on_cpu
from dyntorch.fitting import fit
from dyntorch.invariants.grassmann_tensor import GrassmannTensor
from dyntorch.solution import failed
from dyntorch.tasks.line_adjustment import adjust
from dyntorch.tasks.line_descent import normalized
from dyntorch.tasks.trajectories import Trajectories, fitted_lines, triangulate_trajectories

SIX = GrassmannTensor(5, (1,) * 6, dual=True)
ROUNDS = 3


@dataclass(frozen=True, eq=False)
class TrajectoryCameras:
    """Result of :func:`trajectory_cameras`.

    Attributes:
        cameras: ``(*batch, 6, 3, 4)`` of norm 1, up to one collineation of space; 0 where the status says that there are none.
        trajectories: lines and points in the same frame.
        status: ``(*batch,)`` of :class:`dyntorch.Status` values, those of the tensor.
    """

    cameras: Tensor
    trajectories: Trajectories
    status: Tensor


@one_thread
@on_cpu
def trajectory_cameras(
    x: Tensor, weights: Tensor | None = None, *, bundle: bool = True, sigma: float | None = None
) -> TrajectoryCameras:
    r"""Six uncalibrated cameras and straight trajectories from points seen one view at a time.

    The determinant of the six rows :math:`x_i^T M_i` vanishes for a point on a line: 3^6 = 729 coefficients, 728 matches.  The
    tensor gives the line cameras up to a collineation of P^5, and the Klein quadric, which it has moved, the cameras
    (:func:`~dyntorch.algebra.line_cameras.cameras_of_lines`).  The distances from the images of the lines that this linear result
    leaves are 200 to 400 times the noise with 728 matches and 17 times with 1500 (``python -m experiments.trajectories``); all
    cameras and lines are then adjusted together, which brings them down to the noise.

    Static points are of no use here: alone they give the tensor rank 78.

    A search: it computes on the CPU wherever its tensors are, and the result returns to their device.

    Args:
        x: ``(*batch, 6, n, 2)`` px, 728 or more points on lines in general position; NaN = missing, which drops the point.
        weights: ``(*batch, n)``, 0 = ignore.
        bundle: follow up with bundle adjustment; without it the linear result.
        sigma: noise of one image coordinate, px, as in :func:`~dyntorch.tasks.trajectories.triangulate_trajectories`.

    Returns:
        :class:`TrajectoryCameras`.

    Raises:
        ValueError: another shape, or too few points.

    Source: thesis section 1.3 names the tensor and its 728 matches; the way back to the cameras is derived here.

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> cameras = torch.randn(6, 3, 4, generator=g).double()
        >>> start, way = torch.randn(2, 728, 4, generator=g).double()
        >>> x = (start + torch.randn(6, 728, 1, generator=g).double() * way) @ cameras.mT
        >>> found = trajectory_cameras(x[..., :2] / x[..., 2:], bundle=False)
        >>> bool(found.trajectories.residual.median() < 1e-6)
        True
    """
    if x.ndim < 3 or x.shape[-3] != 6 or x.shape[-1] != 2:
        raise ValueError(f"x must be (*batch, 6, n, 2), six views, got {tuple(x.shape)}")
    if weights is not None and weights.shape != (*x.shape[:-3], x.shape[-2]):
        raise ValueError(f"weights must be (*batch, n) = {(*x.shape[:-3], x.shape[-2])}, one per point, got {tuple(weights.shape)}")
    flat = x.reshape(-1, *x.shape[-3:]).double()
    mass = torch.ones_like(flat[:, 0, :, 0]) if weights is None else weights.reshape(flat.shape[0], -1).double()
    solution = fit(SIX, *flat.unbind(1), weights=mass)
    good = ~failed(solution.status)
    parts = torch.stack(SIX.starts(solution.normalized), dim=-3)  # (tries, b, 6, 3, 6)
    transforms = torch.stack(solution.normalization.transforms, dim=-3)
    # lines are covariant: l' = T^-T l
    cameras = cameras_of_lines(transforms.mT @ parts)
    cameras = torch.where(good[..., None, None, None], cameras, torch.eye(3, 4, dtype=cameras.dtype, device=cameras.device))
    each = (mass * good[:, None])[:, None].expand(flat.shape[:-1])
    found = triangulate_trajectories(cameras, flat.expand(len(cameras), *flat.shape), each.expand(len(cameras), *each.shape))
    best = (found.residual.square() * mass).sum(-1).nan_to_num(nan=torch.inf).argmin(0)
    cameras = cameras[best, torch.arange(len(flat), device=x.device)]
    if bundle:
        cameras = _adjusted(cameras, flat, each)
    trajectories = triangulate_trajectories(cameras, flat, each, sigma=sigma)
    cameras = torch.where(good[..., None, None, None], cameras, 0.0)
    lead = x.shape[:-3]
    whole = Trajectories(*(part.reshape((*lead, *part.shape[1:])) for part in vars(trajectories).values()))
    return TrajectoryCameras(cameras.reshape(*lead, 6, 3, 4).to(x.dtype), whole, solution.status.reshape(lead))


def _adjusted(cameras: Tensor, x: Tensor, weights: Tensor) -> Tensor:
    """Cameras ``(b, 6, 3, 4)`` of least distances of the points from the images of their lines."""
    data, transform, _ = normalized(cameras, x, torch.where(x.isfinite().all(-1), weights, 0.0))
    for _ in range(ROUNDS):
        # a line whose start from the first cameras was bad stays in a minimum of its own: all get a new start
        data = adjust(data, fitted_lines(data))
    moved = torch.linalg.solve(transform, data.cameras)
    return unit(moved)
