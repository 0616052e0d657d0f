"""Frames of a lifted scene: which of the worlds that no view can tell apart is shown.

Each function returns a collineation G of :math:`P^k` from the ambiguity of the lifts; :func:`moved` applies it, and the images
stay what they are.
"""

from __future__ import annotations

import torch
from torch import Tensor

TOLERANCE = 1e-8
"""Of a matrix made of lifts alone, relative: below it a change of the world belongs to the ambiguity."""


def moved(G: Tensor, cameras: Tensor, structure: Tensor, lifts: Tensor) -> tuple[Tensor, Tensor]:
    r"""Cameras :math:`P_i B_i G^{-1} B_i^+` and points :math:`G Y` after a change of frame, for any scale of both.

    Args:
        G: ``(*batch, K, K)`` from the ambiguity of the lifts.
        cameras: ``(*batch, views, m, a + 1)``.
        structure: ``(*batch, n, K)``.
        lifts: ``(views, a + 1, K)``.
    """
    inverse = torch.linalg.inv_ex(G)[0]
    return cameras @ lifts @ inverse[..., None, :, :] @ torch.linalg.pinv(lifts), structure @ G.mT


def finite(cameras: Tensor, structure: Tensor, lifts: Tensor, algebra: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    r"""A frame in which all points are finite and before the cameras, as nearly affine as the ambiguity allows.

    Signs of points and cameras are chosen so that all depths are positive where that is possible.  The homogeneous coordinate
    of the world becomes the linear function f of Y, among those that the ambiguity allows, that fits :math:`f(Y) = 1` best
    for points scaled to a mean depth of 1.

    Args:
        cameras: ``(*batch, views, m, a + 1)``.
        structure: ``(*batch, n, K)``; a zero point is not counted.
        lifts: ``(views, a + 1, K)``.
        algebra: ``(dim, K, K)`` of :func:`~dyntorch.algebra.lift.gauge_algebra`.
        weights: ``(*batch, views, n)``.

    Returns:
        G ``(*batch, K, K)``, cameras and structure with their signs and scales (before G is applied).
    """
    size = lifts.shape[-1]
    eye = torch.eye(size, dtype=lifts.dtype, device=lifts.device)
    cameras, structure = _before(cameras, structure, lifts, weights)
    G = eye.expand(*structure.shape[:-2], size, size)
    last = lifts[:, -1]
    rows = torch.einsum("j,djk->dk", last[0], algebra)
    values, vh = torch.linalg.svd(rows, full_matrices=False)[1:]
    rank = int((values > TOLERANCE * values[0]).sum())
    if bool(((last - last[0]).norm(dim=-1) > TOLERANCE * last.norm()).any()) or rank == 1:
        # the homogeneous coordinate changes with time, or is what it is up to its sign
        sign = _majority((structure @ last[0]).sign().sum(-1))
        return G, cameras * sign[..., None, None, None], structure * sign[..., None, None]
    basis = vh[:rank]
    known = (structure != 0).any(-1)
    inside = structure @ basis.mT
    # a few rounds that look at the points nearest to infinity most
    weight = known.to(structure.dtype)
    target = torch.zeros_like(inside[..., 0, :])
    for _ in range(10):
        normal = inside.mT @ (inside * weight[..., None])
        ridge = (
            1e-12 * normal.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] * torch.eye(rank, dtype=eye.dtype, device=eye.device)
        )
        target = torch.linalg.solve_ex(normal + ridge, (inside.mT @ weight[..., None]))[0][..., 0]
        value = (inside @ target[..., None])[..., 0]
        weight = known / value.clamp(min=0.05).square()
    # of all members with this last coordinate the one next to the identity
    wanted = target @ basis - last[0]
    step = torch.linalg.lstsq(rows.mT, wanted.reshape(-1, size).mT).solution.mT.reshape(*wanted.shape[:-1], len(algebra))
    return G + torch.einsum("...d,dij->...ij", step, algebra), cameras, structure


def _before(cameras: Tensor, structure: Tensor, lifts: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Signs by which most depths are positive, and points scaled to a mean depth of 1 before cameras of unit third rows."""
    projections = cameras @ lifts
    cameras = cameras / projections[..., -1, :].norm(dim=-1)[..., None, None].clamp(min=torch.finfo(cameras.dtype).tiny)
    depth = (structure[..., None, :, :] @ (cameras @ lifts)[..., -1, :, None])[..., 0] * (weights > 0)
    # signs of a matrix of rank one: those of its leading singular vectors, by a few power iterations on the signs
    sign = depth.sign()
    view = torch.ones_like(sign[..., 0])
    for _ in range(5):
        point = _majority((view[..., None] * sign).sum(-2))
        view = _majority((point[..., None, :] * sign).sum(-1))
    cameras = cameras * view[..., None, None]
    mean = (depth * view[..., None]).sum(-2) / (weights > 0).sum(-2).clamp(min=1)
    scale = mean.abs().clamp(min=1e-12 * structure.norm(dim=-1).clamp(min=torch.finfo(mean.dtype).tiny))
    return cameras, structure * (point / scale)[..., None]


def _majority(total: Tensor) -> Tensor:
    return torch.where(total < 0, -1.0, 1.0).to(total.dtype)


def steady(structure: Tensor, lifts: Tensor, start: Tensor, algebra: Tensor, weights: Tensor) -> Tensor:
    r"""The frame in which the chosen points move least: a motion common to all, which no view can tell, is taken off.

    Members :math:`I + S` of the ambiguity with :math:`B(0) S = 0` leave the positions at time 0 alone; of these the one that
    minimizes the displacements of the chosen points between the views.

    Args:
        structure: ``(*batch, n, K)``, the homogeneous coordinate of the world positive.
        lifts: ``(views, a + 1, K)``.
        start: B(0), ``(a + 1, K)``.
        algebra: ``(dim, K, K)``.
        weights: ``(*batch, n)``: which points count; static ones are brought to rest.
    """
    size = lifts.shape[-1]
    eye = torch.eye(size, dtype=lifts.dtype, device=lifts.device)
    G = eye.expand(*structure.shape[:-2], size, size)
    fixed = torch.einsum("ai,dij->daj", start, algebra).flatten(1).mT
    values, vh = torch.linalg.svd(fixed, full_matrices=True)[1:]
    free = torch.einsum("cd,dij->cij", vh[int((values > TOLERANCE * values[0]).sum()) :], algebra)
    change = (lifts - lifts.mean(0)).flatten(0, 1)
    if not len(free) or change.norm() < TOLERANCE:
        return G
    depth = (structure @ lifts[0, -1])[..., None]
    unit = structure / torch.where(depth.abs() > 1e-12, depth, 1.0) * weights[..., None]
    now = (unit @ change.mT).flatten(-2)
    moves = torch.einsum("ai,cij,...nj->...nac", change, free, unit).flatten(-3, -2)
    normal = moves.mT @ moves
    ridge = 1e-12 * normal.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] + torch.finfo(normal.dtype).tiny
    step = torch.linalg.solve_ex(
        normal + ridge * torch.eye(len(free), dtype=eye.dtype, device=eye.device), moves.mT @ now[..., None]
    )[0]
    return G - torch.einsum("...c,cij->...ij", step[..., 0], free)


def centred(structure: Tensor, lifts: Tensor, weights: Tensor) -> Tensor:
    r"""A frame in which the positions over all views have mean 0 and rms distance from it :math:`\sqrt d`, if possible round.

    Whitens by an upper triangular matrix (which keeps the first coordinate directions, those of the motion), or scales the
    coordinates alike, whatever the ambiguity allows.

    Args:
        structure: ``(*batch, n, K)``, the homogeneous coordinate of the world positive.
        lifts: ``(views, a + 1, K)``.
        weights: ``(*batch, n)``.
    """
    homogeneous = structure[..., None, :, :] @ lifts.mT
    depth = homogeneous[..., -1:]
    good = (depth > 1e-9) & (weights[..., None, :, None] > 0)
    x = torch.where(good, homogeneous[..., :-1] / torch.where(good, depth, 1.0), 0.0).flatten(-3, -2)
    weight = good.flatten(-3, -2).to(x.dtype)
    total = weight.sum(-2, keepdim=True).clamp(min=1)
    mean = (x * weight).sum(-2, keepdim=True) / total
    off = (x - mean) * weight
    covariance = off.mT @ off / total
    variance = covariance.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None].clamp(min=torch.finfo(x.dtype).tiny)
    eye = torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)
    # U with U U^T = C, upper triangular: the Cholesky factor of C turned by half a turn
    factor = torch.linalg.cholesky_ex((covariance + 1e-6 * variance * eye).flip(-1, -2))[0].flip(-1, -2)
    plain = (variance / x.shape[-1]).sqrt() * eye
    for scale in (factor, plain):
        linear = torch.linalg.inv_ex(scale)[0]
        world = torch.cat([linear, -linear @ mean.mT], dim=-1)
        world = torch.cat([world, torch.nn.functional.pad(torch.zeros_like(world[..., :1, :-1]), (0, 1), value=1.0)], dim=-2)
        G, left = _induced(world, lifts)
        if bool((left < TOLERANCE).all()):
            return G
    size = lifts.shape[-1]
    return torch.eye(size, dtype=x.dtype, device=x.device).expand(*structure.shape[:-2], size, size)


def _induced(world: Tensor, lifts: Tensor) -> tuple[Tensor, Tensor]:
    """The G with :math:`B_i G = H B_i` for all views, and what is left of that equation ``(*batch,)``."""
    target = (world[..., None, :, :] @ lifts).flatten(-3, -2)
    stack = lifts.flatten(0, 1)
    G = torch.linalg.pinv(stack) @ target
    return G, (stack @ G - target).flatten(-2).norm(dim=-1) / target.flatten(-2).norm(dim=-1)
