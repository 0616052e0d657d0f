"""Errors of lifted reconstructions, after the best alignment within what their lifts leave open."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from dyntorch.algebra.homogeneous import homogeneous, inhomogeneous
from dyntorch.algebra.lift import balanced, balanced_algebra
from dyntorch.least_squares import damped_step
from dyntorch.nullspace import null_space

STEPS = 15
"""Of the robust alignments, from a start that is nearly right."""


class LiftedError(NamedTuple):
    """``position`` and ``velocity``, each ``(*batch,)``, relative to the scene."""

    position: Tensor
    velocity: Tensor


def lifted_error(structure: Tensor, true: Tensor, lifts: Tensor, mask: Tensor | None = None) -> LiftedError:
    r"""Errors of lifted points after the best alignment that their lifts allow, in the positions of the world points.

    The S of :func:`~dyntorch.algebra.lift.gauge_algebra` that aligns them starts as the least-squares solution of
    :math:`Y_{true} \sim S\,Y` on whitened points and is refined on the positions :math:`\pi(B_i S Y)` at all views, gross errors
    weighing little.

    Args:
        structure: ``(*batch, n, K)`` estimated, homogeneous, in any gauge that the lifts leave open.
        true: ``(*batch, n, K)``; batch dimensions broadcast.
        lifts: ``(views, d + 1, K)``.
        mask: ``(*batch, n)`` bool, points that count; all by default.

    Returns:
        LiftedError: ``position``, the median over points and views of the distance to the true position, relative to the rms
        radius of the scene; ``velocity``, the median error of the displacement from the first view to the last, relative to
        its rms (to the radius, where nothing moves).  For constant velocity the latter is the error of the velocity relative
        to the rms speed.  Points that are NaN or 0 have infinite errors.

    Raises:
        ValueError: shapes that do not fit.

    Example:
        >>> import torch
        >>> from dyntorch.scenes import lifted
        >>> scene = lifted("constant_velocity_2d", 20, generator=torch.Generator().manual_seed(0))
        >>> gauge = torch.eye(5, dtype=torch.float64)
        >>> gauge[3, 2] = 0.7  # a common velocity
        >>> error = lifted_error(scene.structure @ gauge.mT, scene.structure, scene.lifts)
        >>> bool(error.position < 1e-12), bool(error.velocity < 1e-12)
        (True, True)
    """
    size = lifts.shape[-1]
    if structure.shape[-2:] != true.shape[-2:] or structure.shape[-1] != size:
        raise ValueError(
            f"structure and true must be (*batch, n, {size}) for these lifts, got {tuple(structure.shape)} and {tuple(true.shape)}"
        )
    batch = torch.Size(np.broadcast_shapes(structure.shape[:-2], true.shape[:-2]))
    n = true.shape[-2]
    y, z = (x.double().expand(*batch, n, size).reshape(-1, n, size) for x in (structure, true))
    counts = torch.ones_like(y[..., 0], dtype=torch.bool) if mask is None else mask.expand(*batch, n).reshape(-1, n)
    valid = y.isfinite().all(-1) & (y != 0).any(-1)
    weights = (valid & counts).to(y.dtype)
    z = torch.where(counts[..., None], z, 0.0)
    placed = inhomogeneous(z[:, None] @ lifts.double().mT)
    # both sides in coordinates in which they fill the space: whatever the gauges, the least squares are well conditioned
    even, back = balanced(lifts)
    right, y = _balanced(torch.where(weights[..., None] > 0, y, 0.0) @ back.mT)
    left, z = _balanced(torch.where(weights[..., None] > 0, z, 0.0) @ back.mT)
    basis = torch.linalg.solve(left[:, None], balanced_algebra(even) @ right[:, None])
    basis = torch.linalg.qr(basis.flatten(2).mT).Q.mT.unflatten(-1, (size, size))
    image = (basis @ y.mT[:, None]).permute(0, 3, 2, 1)
    seen = (even @ left[:, None])[:, :, None] @ image[:, None]
    c = _refined(_algebraic(image, z, weights), seen, placed, weights)
    return _errors(inhomogeneous((seen @ c[:, None, None, :, None])[..., 0]), placed, counts, valid, batch)


def _errors(found: Tensor, placed: Tensor, counts: Tensor, valid: Tensor, batch: torch.Size) -> LiftedError:
    """Medians of the distances of positions ``(b, views, n, d)`` and of their displacements."""
    many = counts.sum(-1).clamp(min=1)
    inside = torch.where(counts[:, None, :, None], placed, 0.0)
    centre = inside.sum(-2, keepdim=True) / many[:, None, None, None]
    radius = torch.where(counts[:, None], (placed - centre).square().sum(-1), 0.0).sum((-2, -1)) / (many * placed.shape[1])
    moved, should = found[:, -1] - found[:, 0], placed[:, -1] - placed[:, 0]
    speed = torch.where(counts, should.square().sum(-1), 0.0).sum(-1) / many
    speed = torch.where(speed > 1e-18 * radius, speed, radius)
    far = torch.where(valid[:, None], (found - placed).norm(dim=-1), torch.inf)
    off = torch.where(valid, (moved - should).norm(dim=-1), torch.inf)
    position = _median(far.flatten(1), counts[:, None].expand_as(far).flatten(1)) / radius.sqrt()
    return LiftedError(position.reshape(batch), (_median(off, counts) / speed.sqrt()).reshape(batch))


def _median(x: Tensor, counts: Tensor) -> Tensor:
    """The (lower) median of the entries that count, infinite without any."""
    ordered = torch.where(counts & ~x.isnan(), x, torch.inf).sort(dim=-1).values
    middle = (counts.sum(-1, keepdim=True) - 1).clamp(min=0) // 2
    return ordered.gather(-1, middle)[..., 0]


def _balanced(y: Tensor) -> tuple[Tensor, Tensor]:
    r"""A map A and unit points w with :math:`y \sim A w` for which :math:`\sum w w^T \sim I` (Tyler), for points ``(b, n, K)``."""
    size = y.shape[-1]
    spread = torch.eye(size, dtype=y.dtype, device=y.device).expand(len(y), -1, -1)
    w = normalize(y, dim=-1, eps=0.0).nan_to_num()
    for _ in range(5 if y.shape[-2] >= size else 0):
        _, s, vh = torch.linalg.svd(w, full_matrices=False)
        s = torch.where(s > 1e-14 * s[:, :1], s, 1.0)
        w = normalize(w @ vh.mT / s[:, None], dim=-1, eps=0.0).nan_to_num()
        spread = spread @ (vh.mT * s[:, None])
        spread = spread / torch.linalg.matrix_norm(spread, keepdim=True)
    return spread, w


def _trust(residual: Tensor, weights: Tensor) -> Tensor:
    """Geman and McClure's weights of residuals ``(b, n)``, near 1 up to three times their median."""
    scale = (3 * _median(residual, weights > 0)).nan_to_num(posinf=1.0).clamp(min=1e-12)
    return weights * (1 + (residual / scale[:, None]).square()).pow(-2).nan_to_num()


def _algebraic(image: Tensor, z: Tensor, weights: Tensor) -> Tensor:
    """Coefficients ``(b, dim)`` with which the images ``(b, n, K, dim)`` of the points are parallel to unit z ``(b, n, K)``."""
    rows = image - z[..., None] * (z[..., None, :] @ image)
    trusted = weights
    for _ in range(STEPS):
        c = null_space((rows * trusted.sqrt()[..., None, None]).flatten(1, 2))[:, 0]
        off, size = ((x @ c[:, None, :, None])[..., 0].norm(dim=-1) for x in (rows, image))
        off = off / size.clamp(min=torch.finfo(size.dtype).tiny)
        # least sum of angles, where Geman and McClure's weights would keep to a bad start: a quarter of the points replaced
        # by random ones does no harm in moderate gauges, in 8 of 10 extreme ones
        trusted = weights / (off + (0.1 * _median(off, weights > 0)).nan_to_num(posinf=1.0).clamp(min=1e-12)[:, None])
        trusted = trusted / size.square().clamp(min=1e-6)
        trusted = trusted / trusted.amax(-1, keepdim=True).clamp(min=torch.finfo(size.dtype).tiny)
    return c


def _refined(c: Tensor, seen: Tensor, placed: Tensor, weights: Tensor) -> Tensor:
    """Levenberg-Marquardt on the positions ``(b, views, n, d)``, seen as ``seen (b, views, n, d + 1, dim) @ c``."""

    def residual(c: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        q = (seen @ c[:, None, None, :, None])[..., 0]
        x = inhomogeneous(q)
        return x - placed, x, q[..., -1:]

    damping = torch.full_like(c[:, 0], 1e-4)
    for _ in range(STEPS):
        off, x, depth = residual(c)
        trusted = _trust(off.square().sum((1, 3)).sqrt(), weights)[:, None, :, None]
        slope = (seen[..., :-1, :] - x[..., None] * seen[..., -1:, :]) / depth[..., None]
        slope = torch.where(trusted[..., None] > 0, slope, 0.0)
        weighted = (slope * trusted[..., None]).flatten(1, 3).mT
        step = damped_step((weighted @ off.flatten(1)[..., None])[..., 0], weighted @ slope.flatten(1, 3), damping)
        trial = normalize(c - step, dim=-1)
        before, after = ((trusted * e.square()).sum((1, 2, 3)) for e in (off, residual(trial)[0]))
        better = after < before
        c = torch.where(better[:, None], trial, c)
        damping = (damping * torch.where(better, 0.1, 10.0)).clamp(1e-12, 1e6)
    return c


def body_error(points: Tensor, true: Tensor, labels: Tensor, bodies: int = 2) -> Tensor:
    r"""Error of each body after its own best affine alignment, :math:`x_{true} \approx A x + a`, gross errors weighing little.

    Args:
        points: ``(*batch, n, d)`` estimated.
        true: ``(*batch, n, d)``.
        labels: ``(*batch, n)`` true bodies, 1 to ``bodies``; points of other labels do not count.
        bodies: their number.

    Returns:
        ``(*batch, bodies)`` median distance relative to the rms radius of the body; infinite for a body without points, and
        for more than half of its points NaN.

    Raises:
        ValueError: shapes that do not fit.

    Example:
        >>> import torch
        >>> x = torch.rand(20, 2, dtype=torch.float64)
        >>> labels = 1 + torch.arange(20) % 2
        >>> moved = x @ torch.tensor([[2.0, 1.0], [0.0, 3.0]], dtype=torch.float64) + labels[:, None]
        >>> bool(body_error(moved, x, labels).max() < 1e-12)
        True
    """
    if points.shape[-2:] != true.shape[-2:] or labels.shape[-1:] != true.shape[-2:-1]:
        raise ValueError(
            f"points and true must be (*batch, n, d) with labels (*batch, n), got {tuple(points.shape)}, {tuple(true.shape)} "
            f"and {tuple(labels.shape)}"
        )
    n, d = true.shape[-2:]
    batch = torch.Size(np.broadcast_shapes(points.shape[:-2], true.shape[:-2], labels.shape[:-1]))
    x, z = (p.double().expand(*batch, n, d)[..., None, :, :].expand(*batch, bodies, n, d).reshape(-1, n, d) for p in (points, true))
    kinds = torch.arange(1, bodies + 1, device=labels.device)[:, None]
    counts = (labels.expand(*batch, n)[..., None, :] == kinds).reshape(-1, n)
    valid = x.isfinite().all(-1)
    weights = (counts & valid).to(x.dtype)
    # each coordinate about its median, in units of its median distance from it: runaway points leave the rest its digits
    x = torch.where(weights[..., None] > 0, x, 0.0)
    x = x - torch.stack([_median(column, weights > 0) for column in x.unbind(-1)], -1).nan_to_num(posinf=0.0)[:, None]
    unit = torch.stack([_median(column.abs(), weights > 0) for column in x.unbind(-1)], -1)
    x = homogeneous(x / torch.where((unit > 0) & unit.isfinite(), unit, 1.0)[:, None])
    trusted = weights / (1 + x.square().sum(-1) / 9).square()  # far away points would fit themselves
    for _ in range(STEPS):
        root = trusted.sqrt()[..., None]
        off = (x @ (torch.linalg.pinv(root * x) @ (root * torch.where(weights[..., None] > 0, z, 0.0))) - z).norm(dim=-1)
        trusted = _trust(off, weights)
    many = counts.sum(-1).clamp(min=1)
    z = torch.where(counts[..., None], z, 0.0)
    spread = torch.where(counts[..., None], z - (z.sum(-2) / many[:, None])[:, None], 0.0).square().sum((-2, -1)) / many
    error = _median(torch.where(valid, off, torch.inf), counts) / spread.sqrt()
    return torch.where(error.isnan(), torch.inf, error).reshape(*batch, bodies)
