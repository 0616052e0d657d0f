"""Shape from several synchronized affine views: the Tomasi-Kanade factorization and its metric upgrade."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.arguments import check_tensor
from dyntorch.blocks import one_thread
from dyntorch.eigenspace import eigh


@one_thread
def affine_factorization(views: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    r"""Best rank-3 fit of centred affine views: :math:`x_v - \bar x_v \approx X A_v`.

    Args:
        views: ``(*batch, views, points, 2)``, at least two views of the same points, no NaN.

    Returns:
        shape ``(*batch, points, 3)`` with orthogonal columns, cameras ``(*batch, views, 3, 2)`` and the part of the energy
        that the fit leaves unexplained ``(*batch,)``, from 0 (exact) to 1.

    Raises:
        ValueError: fewer than two views or three points, or coordinates that are not finite.

    Source: Tomasi and Kanade 1992.
    """
    check_tensor("views", views, "views", "points", 2)
    if views.shape[-3] < 2 or min(views.shape[-2], 2 * views.shape[-3]) < 3:
        raise ValueError(f"views must be (*batch, views >= 2, points >= 3, 2), got {tuple(views.shape)}")
    if not bool(views.isfinite().all()):
        raise ValueError("views hold coordinates that are NaN or infinite; leave those points out, or fill them in")
    largest = views.double().abs().amax((-3, -2, -1))[..., None, None]  # no square leaves the range
    scaled = views.double() / torch.where(largest > 0, largest, 1.0)[..., None]
    centred = scaled - scaled.mean(dim=-2, keepdim=True)
    count, points = views.shape[-3], views.shape[-2]
    stacked = centred.movedim(-3, -2).reshape(*views.shape[:-3], points, 2 * count)
    u, s, vt = torch.linalg.svd(stacked, full_matrices=False)
    shape = u[..., :3] * s[..., None, :3] * largest
    cameras = vt[..., :3, :].reshape(*views.shape[:-3], 3, count, 2).movedim(-3, -2)
    energy = s.square().sum(-1)
    left = torch.where(energy > 0, s[..., 3:].square().sum(-1) / energy.clamp(min=1e-300), torch.ones_like(energy))
    return shape.to(views.dtype), cameras.to(views.dtype), left.to(views.dtype)


@one_thread
def metric_upgrade(shape: Tensor, cameras: Tensor) -> tuple[Tensor, Tensor]:
    r"""Turn an affine shape into a metric one for scaled-orthographic cameras, with y along the mean vertical of the images.

    Finds the symmetric :math:`Q = H H^T` with :math:`a_v^T Q b_v = 0` and :math:`a_v^T Q a_v = b_v^T Q b_v` for the two
    columns of every camera; the shape becomes :math:`X H^{-T}`.  The result is defined up to scale, a rotation about the
    vertical and the mirror image :math:`z \to -z`.

    Args:
        shape: ``(points, 3)``; cameras: ``(views, 3, 2)``, at least three views.

    Returns:
        metric shape ``(points, 3)``, and whether the cameras decide it (``False``: Q is not positive definite, or the
        views are too few or too alike; the shape returned is then the affine one, unchanged).
    """
    largest = cameras.double().abs().amax() if cameras.numel() else torch.ones((), device=cameras.device)
    scaled = cameras.double() / torch.where(largest > 0, largest, 1.0)  # no square leaves the range
    a, b = scaled.unbind(-1)
    extent = shape.double().norm(dim=0)
    # a flat shape leaves the third row of the cameras to chance
    if len(cameras) < 3 or not (extent.min() > 1e-6 * extent.max()) & extent.max().isfinite() & largest.isfinite():
        return shape, torch.tensor(False, device=shape.device)
    rows = torch.cat([_quadratic(a, b), _quadratic(a, a) - _quadratic(b, b)])
    _, s, vt = torch.linalg.svd(rows, full_matrices=True)
    q = vt[-1]
    matrix = torch.stack([q[[0, 1, 2]], q[[1, 3, 4]], q[[2, 4, 5]]])
    matrix = matrix * torch.sign(torch.trace(matrix))
    values, vectors = eigh(matrix)
    # one solution only where the fifth singular value stands clear of the noise floor
    if not (values[0] > 1e-3 * values[-1] and s[4] > 1e-3 * s[0]):
        return shape, torch.tensor(False, device=shape.device)
    half = vectors * values.sqrt()
    upright = _vertical(scaled.mT @ half)
    metric = shape.double() @ torch.linalg.inv(half).mT @ upright
    return metric.to(shape.dtype), torch.tensor(True, device=shape.device)


def _quadratic(a: Tensor, b: Tensor) -> Tensor:
    """``(views, 6)`` coefficients of a^T Q b in the entries 00, 01, 02, 11, 12, 22 of the symmetric Q."""
    i, j = torch.triu_indices(3, 3, device=a.device).unbind()
    return torch.where(i == j, a[:, i] * b[:, i], a[:, i] * b[:, j] + a[:, j] * b[:, i])


def _vertical(rotated: Tensor) -> Tensor:
    """``(3, 3)`` rotation (columns x, y, z) whose y is the mean image vertical of the cameras ``(views, 2, 3)``."""
    y = torch.nn.functional.normalize(torch.nn.functional.normalize(rotated[:, 1], dim=-1).mean(0), dim=0)
    x = rotated[0, 0] - (rotated[0, 0] @ y) * y
    x = torch.nn.functional.normalize(x, dim=0)
    return torch.stack([x, y, torch.linalg.cross(x, y)], dim=1)
