"""Lifts: moving points as static points of a higher projective space, what they leave open, and the way back to the scene.

A point at view i is :math:`X_i = B_i Y` with a known matrix :math:`B_i` and a static Y of :math:`P^k`, so that cameras
:math:`P_i` of the scene are the projections :math:`M_i = P_i B_i` of :math:`P^k`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.geometry.homogeneous import nonzero_sign
from dyntorch.geometry.triangulation import unit_projections
from dyntorch.numerics.nullspace import null_space

DRAWS = 16
"""Random members of a solution space, or of the ambiguity with one plane at infinity, among which the best conditioned is taken."""
ZERO = 1e-8
"""Relative size of a singular value of matrices made of lifts alone that counts as 0: the known motions give below 1e-11 or above
0.1 (3 to 12 views from time 0, 100 and 1000)."""


def kernel(lifts: Tensor) -> Tensor:
    """What each lift sends to zero: orthonormal ``(views, K, K - a - 1)``, for lifts ``(views, a + 1, K)`` of full rank."""
    return torch.linalg.svd(lifts, full_matrices=True).Vh[..., lifts.shape[-2] :, :].mT


def gauge_algebra(lifts: Tensor) -> Tensor:
    r"""The changes of :math:`P^k` that no view can tell from a change of the cameras:
    :math:`\{S : B_i S \ker(B_i) = 0 \text{ for all } i\}`. lifts ``(views, a + 1, K)`` -> ``(dim, K, K)``."""
    if lifts.ndim != 3 or lifts.shape[-2] > lifts.shape[-1]:
        raise ValueError(f"lifts must be (views, a + 1, K) with a + 1 <= K, got {tuple(lifts.shape)}")
    even, root = balance_lifts(lifts)
    found = torch.linalg.solve(root, balanced_algebra(even) @ root)
    return torch.linalg.qr(found.flatten(1).mT).Q.mT.unflatten(-1, found.shape[1:]).to(lifts.dtype)


def balanced_algebra(lifts: Tensor) -> Tensor:
    """:func:`gauge_algebra` of balanced lifts."""
    rows, size = lifts.shape[-2:]
    q, _ = torch.linalg.qr(lifts.mT, mode="complete")
    equations = torch.einsum("vai,vbj->vijab", q[..., :rows], q[..., rows:]).reshape(-1, size * size)
    equations = torch.cat([equations, equations.new_zeros(max(0, size * size - len(equations)), size * size)])
    _, values, vh = torch.linalg.svd(equations, full_matrices=False)
    return vh[values <= ZERO * values[0].clamp(min=ZERO)].unflatten(-1, (size, size))


def balance_lifts(lifts: Tensor) -> tuple[Tensor, Tensor]:
    """Lifts ``(views, a + 1, K)`` whose stack has orthonormal columns, and the root R with ``lifts = balanced @ R``."""
    stack = lifts.double().flatten(0, 1)
    _, values, vh = torch.linalg.svd(stack, full_matrices=False)
    if vh.shape[0] < vh.shape[1]:
        vh = torch.linalg.qr(vh.mT, mode="complete").Q.mT
        values = torch.cat([values, values.new_zeros(len(vh) - len(values))])
    values = torch.where(values > 1e-12 * values[0], values, values[0]) / len(lifts) ** 0.5
    return lifts.double() @ (vh.mT / values), values[:, None] * vh


def upgrade(projections: Tensor, lifts: Tensor) -> tuple[Tensor, Tensor]:
    r"""From a projective frame to one in which :math:`M_i T = P_i B_i`: solve :math:`M_i T \ker(B_i) = 0`, which is linear.
    projections ``(*batch, views, m, K)``, lifts ``(views, a + 1, K)`` -> ``(*batch, K, K)``."""
    size, batch = lifts.shape[-1], projections.shape[:-3]
    algebra, vectors = gauge_algebra(lifts), kernel(lifts)
    if not vectors.shape[-1]:
        T = torch.eye(size, dtype=lifts.dtype, device=lifts.device).expand(*batch, size, size)
        return T, projections @ torch.linalg.inv(lifts)
    rows = torch.einsum("...vmi,vjr->...vmrij", unit_projections(projections), vectors).flatten(-5, -3).flatten(-2)
    dim = len(algebra)
    if rows.shape[-2] < size * size - dim:
        raise ValueError(f"{len(lifts)} views give {rows.shape[-2]} equations, {size * size - dim} are needed; add views")
    basis = null_space(rows, dim).unflatten(-1, (size, size))
    # a generator of its own: the same projections get the same frame
    draw = torch.randn(DRAWS, dim, generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(basis)
    trial = torch.einsum("dk,...kij->...dij", draw, basis)
    T = _best_conditioned(trial, trial.detach())
    return T, projections @ T[..., None, :, :] @ torch.linalg.pinv(lifts)


def _best_conditioned(trial: Tensor, matrices: Tensor) -> Tensor:
    """Of trials ``(*batch, draws, K, K)`` that whose matrix has the best condition."""
    values = torch.linalg.svdvals(matrices.nan_to_num())
    best = (values[..., -1] / values[..., 0].clamp(min=torch.finfo(values.dtype).tiny)).argmax(-1)
    return trial.take_along_dim(best[..., None, None, None], dim=-3).squeeze(-3)


def least_views(lifts: Tensor, rows: int) -> int:
    """Fewest of these views from which cameras with so many rows, otherwise arbitrary, are upgraded without doubt."""
    lifts = balance_lifts(lifts)[0]
    draw = torch.Generator().manual_seed(0)
    total, width = lifts.shape[0], lifts.shape[-1]
    whole = len(gauge_algebra(lifts))
    cameras = torch.randn(total, rows, lifts.shape[-2], generator=draw, dtype=torch.float64).to(lifts)
    vectors = kernel(lifts)
    for views in range(2, total + 1):
        if torch.linalg.matrix_rank(lifts[:views].flatten(0, 1)) < width:
            continue
        stack = torch.einsum("vmi,vjr->vmrij", (cameras @ lifts)[:views], vectors[:views]).reshape(-1, width * width)
        values = torch.linalg.svdvals(stack)
        rank = int((values > ZERO * values[0]).sum()) if values.numel() else 0
        if width * width - rank == whole == len(gauge_algebra(lifts[:views])):
            return views
    return total + 1


# ----------------------------------------------------------------------------------------------------------------------
# Frames of a lifted scene: which of the worlds that no view can tell apart is shown.
#
# Each function returns a collineation G of :math:`P^k` from the ambiguity of the lifts; :func:`change_frame` applies it, and the
# images stay what they are.


def change_frame(G: Tensor, cameras: Tensor, structure: Tensor, lifts: Tensor) -> tuple[Tensor, Tensor]:
    r"""Cameras :math:`P_i B_i G^{-1} B_i^+` and points :math:`G Y` after a change of frame, for any scale of both. G
    ``(*batch, K, K)``, cameras ``(*batch, views, m, a + 1)``, structure ``(*batch, n, K)``, lifts ``(views, a + 1, K)``."""
    inverse = torch.linalg.inv_ex(G)[0]
    return cameras @ lifts @ inverse[..., None, :, :] @ torch.linalg.pinv(lifts), structure @ G.mT


def finite(cameras: Tensor, structure: Tensor, lifts: Tensor, algebra: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    r"""A frame in which all points are finite and before the cameras, as nearly affine as the ambiguity allows."""
    size = lifts.shape[-1]
    eye = torch.eye(size, dtype=lifts.dtype, device=lifts.device)
    cameras, structure = _before(cameras, structure, lifts, weights)
    G = eye.expand(*structure.shape[:-2], size, size)
    last = lifts[:, -1]
    rows = torch.einsum("j,djk->dk", last[0], algebra)
    values, vh = torch.linalg.svd(rows, full_matrices=False)[1:]
    rank = int((values > ZERO * values[0]).sum())
    if bool(((last - last[0]).norm(dim=-1) > ZERO * last.norm()).any()) or rank == 1:
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
    free = vh[int((scales > ZERO * scales[0]).sum()) :]
    start = functional @ torch.linalg.pinv(rows)
    # draws of its own: the same points get the same frame
    draw = torch.randn(DRAWS, len(free), generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(rows)
    spread = start.norm(dim=-1)[..., None, None] * draw / max(1, len(free)) ** 0.5
    trial = torch.einsum("...sd,dij->...sij", start[..., None, :] + spread @ free, algebra)
    moments = structure.mT @ structure
    trace = moments.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None].clamp(min=torch.finfo(moments.dtype).tiny)
    eye = torch.eye(size, dtype=rows.dtype, device=rows.device)
    shape = torch.linalg.cholesky_ex(moments / trace + 1e-9 * eye)[0]
    return _best_conditioned(trial, trial @ shape[..., None, :, :])


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
    """Points ``(b, n)`` that are behind one of the cameras that see them, or beyond infinity, in a frame of :func:`finite`."""
    world = structure @ lifts[0, -1]
    depth = (structure[:, None] @ (cameras @ lifts)[..., -1, :, None])[..., 0] * (weights > 0) * world.sign()[:, None]
    return (torch.where(depth.sign().sum(-1, keepdim=True) < 0, -depth, depth) < 0).any(1)


def steadiest_frame(structure: Tensor, lifts: Tensor, start: Tensor, algebra: Tensor, weights: Tensor) -> Tensor:
    r"""The frame in which the chosen points move least: a motion common to all, which no view can tell, is taken off. structure
    ``(*batch, n, K)``, lifts ``(views, a + 1, K)``, start ``(a + 1, K)``, algebra ``(dim, K, K)``, weights ``(*batch, n)``."""
    size = lifts.shape[-1]
    eye = torch.eye(size, dtype=lifts.dtype, device=lifts.device)
    G = eye.expand(*structure.shape[:-2], size, size)
    fixed = torch.einsum("ai,dij->daj", start, algebra).flatten(1).mT
    values, vh = torch.linalg.svd(fixed, full_matrices=True)[1:]
    free = torch.einsum("cd,dij->cij", vh[int((values > ZERO * values[0]).sum()) :], algebra)
    change = (lifts - lifts.mean(0)).flatten(0, 1)
    if not len(free) or change.norm() < ZERO:
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


def center_frame(structure: Tensor, lifts: Tensor, weights: Tensor) -> Tensor:
    r"""A frame in which the positions over all views have mean 0 and rms distance from it :math:`\sqrt d`, if possible round.
    structure ``(*batch, n, K)``, lifts ``(views, a + 1, K)``, weights ``(*batch, n)``."""
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
        if _induced_map(_world(example, torch.ones_like(eye[:1])), lifts)[1] < ZERO:
            G = _induced_map(_world(torch.linalg.inv_ex(scale)[0], mean), lifts)[0]
            break
    return torch.where(counted & G.isfinite().flatten(-2).all(-1)[..., None, None], G, same)


def _world(linear: Tensor, mean: Tensor) -> Tensor:
    """The change x -> A (x - mean) of the world, homogeneous; ``mean (*batch, 1, d)``."""
    top = torch.cat([linear, -linear @ mean.mT], dim=-1)
    return torch.cat([top, torch.nn.functional.pad(torch.zeros_like(top[..., :1, :-1]), (0, 1), value=1.0)], dim=-2)


def _induced_map(world: Tensor, lifts: Tensor) -> tuple[Tensor, Tensor]:
    """The G with :math:`B_i G = H B_i` for all views, and what is left of that equation ``(*batch,)``."""
    target = (world[..., None, :, :] @ lifts).flatten(-3, -2)
    stack = lifts.flatten(0, 1)
    G = torch.linalg.pinv(stack) @ target
    return G, (stack @ G - target).flatten(-2).norm(dim=-1) / target.flatten(-2).norm(dim=-1)
