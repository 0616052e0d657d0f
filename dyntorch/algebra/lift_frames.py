"""Frames of a lifted scene: which of the worlds that no view can tell apart is shown.

Each function returns a collineation G of :math:`P^k` from the ambiguity of the lifts; :func:`moved` applies it, and the images
stay what they are.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.algebra.homogeneous import nonzero_sign

TOLERANCE = 1e-8
"""Of a matrix made of lifts alone, relative: below it a change of the world belongs to the ambiguity."""
DRAWS = 16
"""Members of the ambiguity with the same plane at infinity among which the one that leaves the points roundest is taken."""


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
        sign = nonzero_sign((structure @ last[0]).sign().sum(-1))
        return G, cameras * sign[..., None, None, None], structure * sign[..., None, None]
    functional = _nearly_constant(structure, vh[:rank]) @ vh[:rank]
    return _member(functional, rows, algebra, structure), cameras, structure


def _nearly_constant(structure: Tensor, basis: Tensor) -> Tensor:
    """Coefficients ``(*batch, r)`` of the linear function of the points that is next to 1, relative to its value at each."""
    inside = structure @ basis.mT
    known = (structure != 0).any(-1).to(structure.dtype)
    weight = known
    eye = torch.eye(len(basis), dtype=structure.dtype, device=structure.device)
    target = torch.zeros_like(inside[..., 0, :])
    for _ in range(10):
        # a few rounds that look at the points nearest to infinity most
        normal = inside.mT @ (inside * weight[..., None])
        ridge = 1e-12 * normal.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] + torch.finfo(normal.dtype).tiny
        target = torch.linalg.solve_ex(normal + ridge * eye, inside.mT @ weight[..., None])[0][..., 0]
        value = (inside @ target[..., None])[..., 0]
        weight = known / value.clamp(min=0.05).square()
    return target


def _member(functional: Tensor, rows: Tensor, algebra: Tensor, structure: Tensor) -> Tensor:
    """Of some members of the algebra that have this last row the one that brings the points into the roundest shape."""
    size = algebra.shape[-1]
    _, scales, vh = torch.linalg.svd(rows.mT, full_matrices=True)
    free = vh[int((scales > TOLERANCE * scales[0]).sum()) :]
    start = functional @ torch.linalg.pinv(rows)
    # draws of its own: the same points get the same frame
    draw = torch.randn(DRAWS, len(free), generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(rows)
    spread = start.norm(dim=-1)[..., None, None] * draw / max(1, len(free)) ** 0.5
    trial = torch.einsum("...sd,dij->...sij", start[..., None, :] + spread @ free, algebra)
    moments = structure.mT @ structure
    trace = moments.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None].clamp(min=torch.finfo(moments.dtype).tiny)
    eye = torch.eye(size, dtype=rows.dtype, device=rows.device)
    shape = torch.linalg.cholesky_ex(moments / trace + 1e-9 * eye)[0]
    values = torch.linalg.svdvals((trial @ shape[..., None, :, :]).nan_to_num())
    best = (values[..., -1] / values[..., 0].clamp(min=torch.finfo(values.dtype).tiny)).argmax(-1)
    return trial.gather(-3, best[..., None, None, None].expand(*best.shape, 1, size, size)).squeeze(-3)


def _before(cameras: Tensor, structure: Tensor, lifts: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Signs by which most depths are positive, and points scaled to a mean depth of 1 before cameras of unit third rows."""
    projections = cameras @ lifts
    cameras = cameras / projections[..., -1, :].norm(dim=-1)[..., None, None].clamp(min=torch.finfo(cameras.dtype).tiny)
    depth = (structure[..., None, :, :] @ (cameras @ lifts)[..., -1, :, None])[..., 0] * (weights > 0)
    # the signs are those of a matrix of rank one where all depths can be positive: its leading singular vectors
    sign = depth.sign().nan_to_num()
    view = nonzero_sign(torch.linalg.eigh(sign @ sign.mT).eigenvectors[..., -1])
    point = nonzero_sign((view[..., None] * sign).sum(-2))
    cameras = cameras * view[..., None, None]
    mean = (depth * view[..., None]).sum(-2) / (weights > 0).sum(-2).clamp(min=1)
    size = structure.norm(dim=-1)
    scale = torch.where(size > 0, mean.abs().maximum(1e-12 * size), 1.0)
    return cameras, structure * (point / scale)[..., None]


def behind(cameras: Tensor, structure: Tensor, lifts: Tensor, weights: Tensor) -> Tensor:
    """Points ``(b, n)`` that are behind one of the cameras that see them, or beyond infinity, in a frame of :func:`finite`.

    Args:
        cameras: ``(b, views, m, a + 1)``.
        structure: ``(b, n, K)``.
        lifts: ``(views, a + 1, K)``.
        weights: ``(b, views, n)``.
    """
    world = structure @ lifts[0, -1]
    depth = (structure[:, None] @ (cameras @ lifts)[..., -1, :, None])[..., 0] * (weights > 0) * world.sign()[:, None]
    return (torch.where(depth.sign().sum(-1, keepdim=True) < 0, -depth, depth) < 0).any(1)


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
    counted = weight.sum(-2, keepdim=True) > 0
    total = weight.sum(-2, keepdim=True).clamp(min=1)
    mean = (x * weight).sum(-2, keepdim=True) / total
    off = (x - mean) * weight
    covariance = off.mT @ off / total
    variance = covariance.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None].clamp(min=torch.finfo(x.dtype).tiny)
    eye = torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)
    plain = (variance / x.shape[-1]).sqrt() * eye
    # U with U U^T = C, upper triangular: the Cholesky factor of C turned by half a turn
    factor = torch.linalg.cholesky_ex((covariance + 1e-6 * variance * eye).flip(-1, -2))[0].flip(-1, -2)
    G = same = torch.eye(lifts.shape[-1], dtype=x.dtype, device=x.device).expand(*structure.shape[:-2], -1, -1)
    # a matrix of one kind that the lifts allow tells that they allow the kind, whatever the points
    for scale, example in ((factor, eye + torch.ones_like(eye).triu()), (plain, 2 * eye)):
        if _induced(_world(example, torch.ones_like(eye[:1])), lifts)[1] < TOLERANCE:
            G = _induced(_world(torch.linalg.inv_ex(scale)[0], mean), lifts)[0]
            break
    return torch.where(counted & G.isfinite().flatten(-2).all(-1)[..., None, None], G, same)


def _world(linear: Tensor, mean: Tensor) -> Tensor:
    """The change x -> A (x - mean) of the world, homogeneous; ``mean (*batch, 1, d)``."""
    top = torch.cat([linear, -linear @ mean.mT], dim=-1)
    return torch.cat([top, torch.nn.functional.pad(torch.zeros_like(top[..., :1, :-1]), (0, 1), value=1.0)], dim=-2)


def _induced(world: Tensor, lifts: Tensor) -> tuple[Tensor, Tensor]:
    """The G with :math:`B_i G = H B_i` for all views, and what is left of that equation ``(*batch,)``."""
    target = (world[..., None, :, :] @ lifts).flatten(-3, -2)
    stack = lifts.flatten(0, 1)
    G = torch.linalg.pinv(stack) @ target
    return G, (stack @ G - target).flatten(-2).norm(dim=-1) / target.flatten(-2).norm(dim=-1)
