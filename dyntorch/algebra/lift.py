"""Lifts: moving points as static points of a higher projective space, what they leave open, and the way back to the scene.

A point at view i is :math:`X_i = B_i Y` with a known matrix :math:`B_i` and a static Y of :math:`P^k`, so that cameras
:math:`P_i` of the scene are the projections :math:`M_i = P_i B_i` of :math:`P^k`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.algebra.triangulation import unit_projections
from dyntorch.nullspace import null_space

DRAWS = 16
"""Random members of the solution space among which the best conditioned one is taken."""
ZERO = 1e-8
"""Relative size of a singular value of matrices made of lifts alone that counts as 0: the known motions give below 1e-11 or above
0.1 (3 to 12 views from time 0, 100 and 1000)."""


def kernel(lifts: Tensor) -> Tensor:
    """What each lift sends to zero: orthonormal ``(views, K, K - a - 1)``, for lifts ``(views, a + 1, K)`` of full rank."""
    return torch.linalg.svd(lifts, full_matrices=True).Vh[..., lifts.shape[-2] :, :].mT


def gauge_algebra(lifts: Tensor) -> Tensor:
    r"""The changes of :math:`P^k` that no view can tell from a change of the cameras:
    :math:`\{S : B_i S \ker(B_i) = 0 \text{ for all } i\}`.

    Its invertible members form the ambiguity of a reconstruction (less one dimension, the scale).

    Args:
        lifts: :math:`B_i`, ``(views, a + 1, K)``.

    Returns:
        ``(dim, K, K)`` orthonormal; all matrices where the lifts are invertible.

    Raises:
        ValueError: no stack of lifts with a + 1 <= K.

    Source: thesis section 3; the equations of the affine upgrade.

    Example:
        >>> import torch
        >>> t, eye = torch.arange(3.0, dtype=torch.float64), torch.eye(3, dtype=torch.float64)
        >>> lifts = torch.stack([torch.cat([eye, s * eye[:, :2]], dim=1) for s in t])  # constant velocity in a plane
        >>> gauge_algebra(lifts).shape
        torch.Size([9, 5, 5])
    """
    if lifts.ndim != 3 or lifts.shape[-2] > lifts.shape[-1]:
        raise ValueError(f"lifts must be (views, a + 1, K) with a + 1 <= K, got {tuple(lifts.shape)}")
    even, root = balanced(lifts)
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


def balanced(lifts: Tensor) -> tuple[Tensor, Tensor]:
    """Lifts ``(views, a + 1, K)`` whose stack has orthonormal columns, and the root R with ``lifts = balanced @ R``.

    Neither the unit nor the origin of time matters to them.  Columns that no view sees stay zero.
    """
    stack = lifts.double().flatten(0, 1)
    _, values, vh = torch.linalg.svd(stack, full_matrices=False)
    if vh.shape[0] < vh.shape[1]:
        vh = torch.linalg.qr(vh.mT, mode="complete").Q.mT
        values = torch.cat([values, values.new_zeros(len(vh) - len(values))])
    values = torch.where(values > 1e-12 * values[0], values, values[0]) / len(lifts) ** 0.5
    return lifts.double() @ (vh.mT / values), values[:, None] * vh


def upgrade(projections: Tensor, lifts: Tensor) -> tuple[Tensor, Tensor]:
    r"""From a projective frame to one in which :math:`M_i T = P_i B_i`: solve :math:`M_i T \ker(B_i) = 0`, which is linear.

    Args:
        projections: ``(*batch, views, m, K)``, of any scale each.
        lifts: ``(views, a + 1, K)``.

    Returns:
        T ``(*batch, K, K)``, the best conditioned one of the solutions (which differ by the ambiguity of the scene), and the
        cameras :math:`P_i = M_i T B_i^+`, ``(*batch, views, m, a + 1)``.

    Raises:
        ValueError: too few views for a unique solution; see :func:`least_views`.

    Source: thesis section 3.

    Example:
        >>> import torch
        >>> draw = torch.Generator().manual_seed(0)
        >>> P, H = (torch.randn(*size, generator=draw, dtype=torch.float64) for size in ((3, 3, 3), (5, 5)))
        >>> eye = torch.eye(3, dtype=torch.float64)
        >>> lifts = torch.stack([torch.cat([eye, t * eye[:, :2]], dim=1) for t in range(3)])
        >>> T, cameras = upgrade(P @ lifts @ H, lifts)
        >>> bool(torch.allclose(P @ lifts @ H @ T, cameras @ lifts))
        True
    """
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
    values = torch.linalg.svdvals(trial.detach().nan_to_num())
    best = (values[..., -1] / values[..., 0].clamp(min=torch.finfo(values.dtype).tiny)).argmax(-1)
    T = trial.gather(-3, best[..., None, None, None].expand(*batch, 1, size, size)).squeeze(-3)
    return T, projections @ T[..., None, :, :] @ torch.linalg.pinv(lifts)


def least_views(lifts: Tensor, rows: int) -> int:
    """Fewest of these views from which cameras with so many rows, otherwise arbitrary, are upgraded without doubt.

    Measured on random cameras: the equations of the upgrade have no more solutions than the ambiguity of these lifts.  One
    more than the number of lifts where they do not suffice.
    """
    lifts = balanced(lifts)[0]
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
