"""Structure and velocities from many affine views at once: the factorization of constant velocity."""

from __future__ import annotations

from math import ceil, prod
from typing import NamedTuple

import torch
from torch import Tensor

from dyntorch.blocks import map_blocks, one_thread
from dyntorch.nullspace import gram_null_space, null_space

FLAT = 1e-9  # of the largest singular value: below it the measurements have no further dimension
BLOCK = 2**20  # measurements per block


class VelocityFactorization(NamedTuple):
    r"""Cameras, points and velocities up to :math:`(X, V) \mapsto (G X + a, G V + b)`; points and velocities have mean 0."""

    cameras: Tensor
    """``(*batch, views, 2, d)``, with :math:`\\sum_i A_i^T A_i` = (2 views / d) I: the world is in the unit of the tracks."""
    offsets: Tensor
    """``(*batch, views, 2)``, the mean of the tracks in each view."""
    points: Tensor
    """``(*batch, n, d)`` at time 0; 0 for points that were left out."""
    velocities: Tensor
    """``(*batch, n, d)`` per unit of time; 0 for points that were left out."""
    residual: Tensor
    """``(*batch,)`` root mean square of the image distances, in the unit of the tracks."""
    degenerate: Tensor
    """``(*batch,)`` bool: the tracks do not decide the result (see Args of the function), which then means nothing."""


@one_thread
def velocity_factorization(
    tracks: Tensor, times: Tensor, dim: int = 3, weights: Tensor | None = None, *, iterations: int = 100, tolerance: float = 1e-8
) -> VelocityFactorization:
    r"""Affine cameras and points at constant velocity: :math:`x_{ip} = A_i (X_p + t_i V_p) + b_i`.

    Without the mean of each view, the measurements have rank 2 d: :math:`W = [A_i,\ t_i A_i]\,[X_p; V_p]`.  A basis U of their
    columns differs from the first factor by a matrix :math:`[T_1, T_2]`, and each of its d columns solves

    .. math:: U_i (t_2 - \tau_i\, t_1) = 0 \qquad \text{for all views,}

    so that it spans a null space of dimension d of a matrix of 2 views rows and 4 d columns.  From there alternating least
    squares over cameras and structure reach the optimum of the image distances.

    The null space is larger, and the result ambiguous, iff there are :math:`v_0, v_1, v_2`, not all 0, with
    :math:`A_i (v_0 + t_i v_1 + t_i^2 v_2) = 0` in all views.  For d = 2 and invertible :math:`A_i` three times exclude that.
    For d = 3 it says that the viewing directions move along a curve that is quadratic in time: always so with four views; with
    five if all are orthogonal to one axis (a turntable takes six); for a fixed camera with any number.

    Args:
        tracks: ``(*batch, views, n, 2)`` in any unit.  **Only points measured in every view are used**, of which at least
            2 d + 1 with positions and velocities in general position are needed: not all static, nor in one direction, nor
            (d = 3) all velocities in parallel planes.
        times: ``(views,)`` or ``(*batch, views)``, three different ones at least; several views may share one.
        dim: d, 3 for space or 2 for a plane.
        weights: ``(*batch, views, n)``; a point with a 0, or a NaN coordinate, in any view is left out.
        iterations: most sweeps of the alternation.
        tolerance: of the relative change of the image distances in one sweep.

    Returns:
        cameras, offsets, points, velocities, residual, degenerate; without gradients, and finite also where degenerate.

    Raises:
        ValueError: shapes that do not fit, fewer views (5 for d = 3, 3 for d = 2), points or times than needed.

    Source: Han and Kanade 2000, "Reconstruction of a scene with multiple linearly moving objects"; thesis chapter 3.

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> A, X, V = (torch.randn(*s, generator=g, dtype=torch.float64) for s in ((6, 2, 3), (12, 3), (12, 3)))
        >>> times = torch.tensor([0.0, 1.0, 2.0, 4.0, 5.0, 7.0], dtype=torch.float64)
        >>> tracks = (X + times[:, None, None] * V) @ A.mT
        >>> found = velocity_factorization(tracks, times)
        >>> again = (found.points + times[:, None, None] * found.velocities) @ found.cameras.mT + found.offsets[:, None]
        >>> bool(torch.allclose(again, tracks)), bool(found.degenerate)
        (True, False)
    """
    _check(tracks, times, dim, weights)
    batch, (views, n, _) = tracks.shape[:-3], tracks.shape[-3:]
    x = tracks.detach().double()
    complete = torch.isfinite(x).all(-1).all(-2)
    if weights is not None:
        complete = complete & (weights > 0).all(-2)
    complete = complete & (complete.sum(-1, keepdim=True) > 2 * dim)
    x = torch.where(complete[..., None, :, None], x, 0.0)
    t = times.detach().to(x).expand(*batch, views)

    def block(x: Tensor, t: Tensor, complete: Tensor) -> tuple[Tensor, ...]:
        return _factorize(x, t, complete, dim, iterations, tolerance)

    count = prod(batch)
    problems = (x.reshape(count, views, n, 2), t.reshape(count, views), complete.reshape(count, n))
    found = map_blocks(block, *problems, size=max(1, ceil(BLOCK / (2 * views * n))))
    *parts, degenerate = (part.reshape(batch + part.shape[1:]) for part in found)
    cameras, offsets, points, velocities, residual = (part.to(tracks.dtype) for part in parts)
    return VelocityFactorization(cameras, offsets, points, velocities, residual, degenerate)


def _check(tracks: Tensor, times: Tensor, dim: int, weights: Tensor | None) -> None:
    if tracks.ndim < 3 or tracks.shape[-1] != 2 or not tracks.is_floating_point():
        raise ValueError(f"tracks must be floating point (*batch, views, n, 2), got {tuple(tracks.shape)} {tracks.dtype}")
    if dim not in (2, 3):
        raise ValueError(f"dim must be 3, space, or 2, a plane, got {dim}")
    views, n = tracks.shape[-3:-1]
    if weights is not None and weights.shape != tracks.shape[:-1]:
        raise ValueError(f"weights must be (*batch, views, n) = {tuple(tracks.shape[:-1])}, got {tuple(weights.shape)}")
    least = 5 if dim == 3 else 3
    if views < least:
        raise ValueError(f"constant velocity in {dim} dimensions needs at least {least} affine views, got {views}: add views")
    if n <= 2 * dim:
        raise ValueError(f"constant velocity in {dim} dimensions needs at least {2 * dim + 1} points, got {n}: add points")
    if times.shape[-1:] != (views,) or not bool(torch.isfinite(times).all()):
        raise ValueError(f"times must be finite (views,) or (*batch, views) with views = {views}, got {tuple(times.shape)}")
    different = 1 + (times.sort(-1).values.diff(dim=-1) > 0).sum(-1).min()
    if different < 3:
        raise ValueError(f"times must hold at least 3 different ones, got {int(different)}: velocities need views over time")


def _factorize(x: Tensor, t: Tensor, complete: Tensor, dim: int, iterations: int, tolerance: float) -> tuple[Tensor, ...]:
    """One block of problems ``(b, views, n, 2)``, in normalized images and times, and back."""
    share = complete.to(x.dtype) / complete.sum(-1, keepdim=True).clamp(min=1)
    offsets = (x * share[:, None, :, None]).sum(-2)
    x = torch.where(complete[:, None, :, None], x - offsets[:, :, None], 0.0)
    measured = complete.sum(-1) * x.shape[1]
    scale = (x.square().sum((1, 2, 3)) / (2 * measured.clamp(min=1))).sqrt()
    scale = torch.where(scale > 0, scale, 1.0)[:, None, None, None]
    start = t.mean(-1)
    unit = (t - start[:, None]).square().mean(-1).sqrt()
    tau = (t - start[:, None]) / unit[:, None]
    images = (x / scale).mT  # (b, views, 2, n)
    cameras, degenerate = _upgraded(images, tau, dim)
    cameras, points, velocities, error = _alternate(images, tau, cameras, iterations, tolerance)
    # the gauge: orthogonal cameras of the size of a scaled orthography with scale 1
    gram = (cameras.mT @ cameras).mean(1) * (dim / 2)
    factor, failed = torch.linalg.cholesky_ex(gram)
    degenerate = degenerate | (failed > 0) | ~torch.isfinite(error)
    eye = torch.eye(dim, dtype=x.dtype, device=x.device)
    factor = torch.where(degenerate[:, None, None], eye, factor)
    cameras = torch.linalg.solve_triangular(factor[:, None], cameras.mT, upper=False).mT
    points, velocities = ((factor.mT @ part).mT * scale[:, 0] for part in (points, velocities))
    velocities = velocities / unit[:, None, None]
    points = points - start[:, None, None] * velocities
    residual = (error / measured.clamp(min=1)).sqrt() * scale[:, 0, 0, 0]
    found = (cameras, offsets, points, velocities, residual)
    return *(torch.where(torch.isfinite(part), part, 0.0) for part in found), degenerate


def _upgraded(images: Tensor, tau: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """Cameras ``(b, views, 2, d)`` whose space-time extension [A, tau A] has the columns of the measurements, and doubt."""
    stacked = images.flatten(1, 2)
    vectors, values = torch.linalg.svd(stacked, full_matrices=False)[:2]
    # in units of the singular values the noise of all columns is the same
    basis = (vectors * values[:, None])[..., : 2 * dim].unflatten(1, images.shape[1:3])  # (b, views, 2, 2 d)
    rows = torch.cat([-tau[:, :, None, None] * basis, basis], -1).flatten(1, 2)
    ambiguous = gram_null_space(rows.mT @ rows, dim).degenerate
    first, second = (basis @ part.mT[:, None] for part in null_space(rows, dim).chunk(2, dim=-1))
    weight = tau[:, :, None, None]
    cameras = (first + weight * second) / (1 + weight.square())
    return cameras, ambiguous | (values[:, 2 * dim - 1] <= FLAT * values[:, 0])


def _alternate(
    images: Tensor, tau: Tensor, cameras: Tensor, iterations: int, tolerance: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Least squares in turn: structure ``(b, d, n)`` each for the cameras, cameras for the structure; and the squared error."""
    stacked, weight, dim = images.flatten(1, 2), tau[:, :, None, None], cameras.shape[-1]
    infinite = cameras.new_full((len(cameras),), torch.inf)
    result = [cameras.clone(), cameras.new_zeros(len(cameras), 2 * dim, images.shape[-1]), infinite]
    left = torch.arange(len(cameras), device=cameras.device)
    before = infinite.clone()
    for _ in range(max(1, iterations)):
        motion = torch.cat([cameras, weight[left] * cameras], -1).flatten(1, 2)
        structure = _least_squares(motion, stacked[left])
        error = (stacked[left] - motion @ structure).square().sum((1, 2))
        for part, value in zip(result, (cameras, structure, error), strict=True):
            part[left] = value
        more = (before - error > tolerance * error) & (error > 1e-28 * stacked[left].square().sum((1, 2)))
        left, before = left[more], error[more]
        if not len(left):
            break
        points, velocities = structure[more].chunk(2, dim=-2)
        moved = points[:, None] + weight[left] * velocities[:, None]  # (b, views, d, n)
        cameras = _least_squares(moved.mT, images[left].mT).mT
    points, velocities = result[1].chunk(2, dim=-2)
    return result[0], points, velocities, result[2]


def _least_squares(matrix: Tensor, right: Tensor) -> Tensor:
    """Solutions by QR, not finite where the matrix is singular."""
    q, r = torch.linalg.qr(matrix)
    solution: Tensor = torch.linalg.solve_triangular(r, q.mT @ right, upper=True)
    return solution
