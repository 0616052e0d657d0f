"""Points at constant velocity before three affine or metric sensors: one linear step from 7 matches, no tensor."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.nullspace import null_space

MINIMAL = 7
RANK = 1e-9  # of the largest eigenvalue of the 9 x 9 Gram matrix: 3e-5 of the size of the data, far below any real noise


@dataclass(frozen=True)
class AffineConstantVelocity:
    r"""Three affine maps from the world, and the relation :math:`x_2 = M_1 x_1 + M_0 x_0 + t` between their measurements.

    Attributes:
        motion: :math:`A_0, A_1, A_2`, ``(*batch, 4, 4)`` each, last row (0, 0, 0, 1); the linear part of :math:`A_0` is the
            identity, the mean world position is 0, and so is the mean velocity (choices of the gauge).
        M1: ``(*batch, 3, 3)``, :math:`2 L_2 L_1^{-1}` with the linear parts :math:`L_t` of the maps.
        M0: ``(*batch, 3, 3)``, :math:`-L_2 L_0^{-1}`.
        t: ``(*batch, 3)``.
        residual: ``(*batch,)`` RMS of the 3 conditions per match, in the unit of the measurements: the noise of one coordinate.
        ok: ``(*batch,)`` bool; False where the matches do not decide (fewer than 7 of weight, velocities in a plane, static
            or of one velocity, points in a plane); all matrices are then 0.
    """

    motion: tuple[Tensor, Tensor, Tensor]
    M1: Tensor
    M0: Tensor
    t: Tensor
    residual: Tensor
    ok: Tensor


def affine_constant_velocity(x1: Tensor, x2: Tensor, x3: Tensor, weights: Tensor | None = None) -> AffineConstantVelocity:
    r"""Affine maps of three sensors from points at constant velocity, :math:`x_t = L_t (y + t v) + a_t`.

    The nine centred coordinates of a match lie in a space of 6 dimensions (y and v), hence obey 3 conditions

    .. math:: N_0 x_0 + N_1 x_1 + N_2 x_2 = 0, \qquad (N_0, N_1, N_2) = G\,(L_0^{-1}, -2 L_1^{-1}, L_2^{-1}).

    The least singular vectors give the least squares solution with equal noise in all coordinates, which is also the most
    likely one: nothing is left to refine.

    Args:
        x1, x2, x3: ``(*batch, n, 3)`` the points at the times 0, 1, 2, all in one unit; NaN is missing.
        weights: ``(*batch, n)``, not negative, 0 = ignore.

    Returns:
        the maps up to an affinity of the world and a common velocity, with the residual and whether the matches decide.

    Raises:
        ValueError: fewer than 7 matches, or shapes that do not fit.

    Source: Tomasi and Kanade 1992 (factorization); thesis section 8.3 for the projective case.

    Example:
        >>> from dyntorch.scenes import constant_velocity
        >>> found = affine_constant_velocity(*constant_velocity(7, sensors="affine").views)
        >>> bool(found.ok), bool(found.residual < 1e-9)
        (True, True)
    """
    views = (x1, x2, x3)
    if any(x.ndim < 2 or x.shape != x1.shape or x.shape[-1] != 3 for x in views):
        raise ValueError(f"x1, x2, x3 must be (*batch, n, 3) and alike, got {[tuple(x.shape) for x in views]}")
    if x1.shape[-2] < MINIMAL:
        raise ValueError(f"x1 has {x1.shape[-2]} matches; affine constant velocity takes {MINIMAL} or more")
    if weights is not None and weights.shape != x1.shape[:-1]:
        raise ValueError(f"weights must be (*batch, n) = {tuple(x1.shape[:-1])}, got {tuple(weights.shape)}")
    stacked = torch.cat(views, dim=-1).double()
    seen = stacked.isfinite().all(-1)
    weight = seen.double() if weights is None else torch.where(seen, weights.double(), 0.0)
    stacked = torch.where((weight > 0)[..., None], stacked, torch.zeros_like(stacked))
    total = weight.sum(-1, keepdim=True)
    mean = (weight[..., None] * stacked).sum(-2) / torch.where(total > 0, total, torch.ones_like(total))
    centred = (
        torch.where((weight > 0)[..., None], stacked - mean[..., None, :], torch.zeros_like(stacked)) * weight.sqrt()[..., None]
    )
    found = _maps(centred, mean, (weight > 0).sum(-1), total[..., 0])
    return found if x1.dtype == torch.float64 else _cast(found, x1.dtype)


def _maps(centred: Tensor, mean: Tensor, count: Tensor, total: Tensor) -> AffineConstantVelocity:
    """The maps from centred matches ``(*batch, n, 9)``, root weights included, and their mean ``(*batch, 9)``."""
    gram = centred.mT @ centred
    values = torch.linalg.eigvalsh(gram.detach())
    ok = (count >= MINIMAL) & (values[..., 3] > RANK * values[..., 8])
    # a degenerate problem is replaced by one that is not, so that its numbers and gradients are finite
    safe = torch.eye(9, dtype=gram.dtype, device=gram.device)[3:]
    safe = torch.cat([safe, safe.new_zeros(centred.shape[-2] - 6, 9)])
    null = null_space(torch.where(ok[..., None, None], centred, safe), 3)
    blocks = null.unflatten(-1, (3, 3)).movedim(-2, -3)
    inverses, info = torch.linalg.inv_ex(
        torch.where(ok[..., None, None, None], blocks, torch.eye(3, dtype=blocks.dtype, device=blocks.device))
    )
    ok = ok & (info == 0).all(-1) & inverses.isfinite().flatten(-3).all(-1)
    keep = ok[..., None, None]
    n0, n1 = blocks[..., 0, :, :], blocks[..., 1, :, :]
    l1, l2 = -2 * inverses[..., 1, :, :] @ n0, inverses[..., 2, :, :] @ n0
    m1, m0 = -inverses[..., 2, :, :] @ n1, -l2
    first, second, third = mean.unflatten(-1, (3, 3)).unbind(-2)
    t = third - (m1 @ second[..., None] + m0 @ first[..., None])[..., 0]
    parts = (torch.eye(3, dtype=l1.dtype, device=l1.device).expand_as(l1), l1, l2)
    maps = [torch.where(keep, _affine(a, shift), 0.0) for a, shift in zip(parts, (first, second, third), strict=True)]
    left = (centred @ null.mT).square().sum((-1, -2)) / (3 * total.clamp(min=torch.finfo(total.dtype).tiny))
    residual = torch.where(ok, left, torch.zeros_like(left)).clamp(min=torch.finfo(left.dtype).tiny).sqrt()
    return AffineConstantVelocity(
        motion=(maps[0], maps[1], maps[2]),
        M1=torch.where(keep, m1, 0.0),
        M0=torch.where(keep, m0, 0.0),
        t=torch.where(ok[..., None], t, 0.0),
        residual=residual,
        ok=ok,
    )


def _affine(linear: Tensor, shift: Tensor) -> Tensor:
    """[L a; 0 1]."""
    last = torch.eye(4, dtype=linear.dtype, device=linear.device)[3:].expand(*linear.shape[:-2], 1, 4)
    return torch.cat([torch.cat([linear, shift[..., None]], dim=-1), last], dim=-2)


def _cast(found: AffineConstantVelocity, dtype: torch.dtype) -> AffineConstantVelocity:
    first, second, third = (m.to(dtype) for m in found.motion)
    return AffineConstantVelocity(
        (first, second, third), found.M1.to(dtype), found.M0.to(dtype), found.t.to(dtype), found.residual.to(dtype), found.ok
    )
