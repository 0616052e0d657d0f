r"""The homography at infinity of independently translating planes by linear equations for an extensor.

For a homography H the fundamental matrices that it is compatible with form a subspace of :math:`R^9`,

.. math:: S(H) = \{[e]_\times H : e \in R^3\} = \{F : H^T F + F^T H = 0\},

of dimension three.  A plane with the homography :math:`H_i = \lambda_i (H_\infty + e_i n_i^T)` has
:math:`F_i = [e_i]_\times H_\infty` in common with :math:`S(H_\infty)`: a transversal of all :math:`S(H_i)`.  Subspaces meet
where their join vanishes, :math:`a \vee \mathrm{ext}\, S(H_i) = 0` for the extensor a of :math:`S(H_\infty)`, linear in a.
"""

from __future__ import annotations

from math import prod

import numpy as np
import torch
from torch import Tensor

from dyntorch.algebra.exterior import extensor_of, subspace_of, wedge
from dyntorch.algebra.homogeneous import skew, unit_vectors
from dyntorch.algebra.infinity_epipoles import infinity_from_fundamentals
from dyntorch.algebra.rank_one_pencils import check_homographies, finite_matrices, unit_determinant
from dyntorch.blocks import map_blocks
from dyntorch.constants import constant
from dyntorch.nullspace import null_space

BLOCK = 1 << 19
"""Numbers per block of equations (4 MB): they stay in the cache."""


def infinity_linear(
    homographies: Tensor, weights: Tensor | None = None, fundamentals: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    r"""The homography at infinity from four planes of translating bodies, or more: 64 linear unknowns.

    The extensors of all :math:`S(H)` span 64 of the 84 dimensions of :math:`\Lambda^3(R^3 \otimes R^3)`, and a is sought there:

    .. math:: (a \vee \mathrm{ext}\, S(H_i))\, Q = 0,\quad a = Q\,v,\quad v \in R^{64}.

    One plane gives 20 equations, generic planes have ranks 20, 39, 56, 63.  It works where all epipoles are collinear (all
    bodies move on one ground plane) or all normals are coplanar, but not where both hold.  A known fundamental matrix lies in
    :math:`S(H_\infty)` itself, :math:`F_k \vee a = 0`, which is linear as well.

    Args:
        homographies: H ``(*batch, n, 3, 3)``, view 1 to view 2, of any scale, in coordinates of size 1 (normalized, the same
            ones for all planes).  A plane that is not finite is left out.
        weights: ``(*batch, n)`` of the planes, not negative; 0 leaves one out.
        fundamentals: F ``(*batch, m, 3, 3)`` of bodies, x2^T F x1 = 0, in the same coordinates, of any scale.

    Returns:
        :math:`H_\infty` ``(*batch, 3, 3)`` in float64, determinant 1, and the singular values ``(*batch, 64)``, descending: the
        solution is unique where the last but one is well above 0.  A problem without solution has some finite matrix, and its
        spectrum tells.  Differentiable.

    Raises:
        ValueError: shapes that do not fit, or fewer planes and fundamental matrices than determine it (4 planes; 2 planes and one
            F; two F).

    Source: after thesis chapter 5, whose 84 unknowns take five planes (:func:`infinity_thesis`).

    Example:
        >>> import torch
        >>> rand = torch.Generator().manual_seed(0)
        >>> e, n = torch.rand(2, 4, 3, generator=rand, dtype=torch.float64)
        >>> H = torch.eye(3) + e[:, :, None] * n[:, None, :]
        >>> found, spectrum = infinity_linear(H)
        >>> found.round(decimals=6).abs().tolist(), spectrum.shape
        ([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], torch.Size([64]))
    """
    m = 0 if fundamentals is None else fundamentals.shape[-3]
    check_homographies(homographies, max(0, 4 - 2 * m))
    return _solve(homographies, weights, fundamentals, 64)


def infinity_thesis(homographies: Tensor) -> tuple[Tensor, Tensor]:
    r"""The homography at infinity from five planes or more, by the double algebra of the thesis: 84 linear unknowns.

    :math:`a \vee \mathrm{ext}\, S(H_i) = 0` for any extensor a of three vectors of :math:`R^9`.  Generic planes have ranks
    20, 39, 57, 74, 83; collinear epipoles leave several solutions for any number of planes.  For reference:
    :func:`infinity_linear` takes four planes and errs less.

    Args:
        homographies: H ``(*batch, n, 3, 3)``, as there.

    Returns:
        :math:`H_\infty` ``(*batch, 3, 3)`` and the singular values ``(*batch, 84)``, as there.

    Raises:
        ValueError: fewer than five planes, or shapes that do not fit.

    Source: thesis chapter 5.

    Example:
        >>> import torch
        >>> rand = torch.Generator().manual_seed(0)
        >>> e, n = torch.rand(2, 5, 3, generator=rand, dtype=torch.float64)
        >>> found, _ = infinity_thesis(torch.eye(3) + e[:, :, None] * n[:, None, :])
        >>> found.round(decimals=6).abs().tolist()
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    check_homographies(homographies, 5)
    return _solve(homographies, None, None, 84)


def _solve(planes: Tensor, weights: Tensor | None, fundamentals: Tensor | None, unknowns: int) -> tuple[Tensor, Tensor]:
    """The solution among extensors of 64 or 84 unknowns."""
    if weights is not None and weights.shape != planes.shape[:-2]:
        raise ValueError(f"weights must be (*batch, n) = {tuple(planes.shape[:-2])}, got {tuple(weights.shape)}")
    extensors = _plane_extensors(planes)
    if weights is not None:
        extensors = extensors * weights.double().sqrt()[..., None]
    known = extensors.new_zeros(*planes.shape[:-3], 0, 9)
    if fundamentals is not None:
        known = unit_vectors(finite_matrices(fundamentals)[0].flatten(-2))
    batch, device = np.broadcast_shapes(extensors.shape[:-2], known.shape[:-2]), planes.device
    tables = _joins(3, unknowns, device), _joins(1, unknowns, device)

    def block(*parts: Tensor) -> tuple[Tensor, Tensor]:
        pairs = zip(parts, tables, strict=True)
        rows = torch.cat([(x @ t.flatten(1)).unflatten(-1, t.shape[1:]).flatten(1, 2) for x, t in pairs], dim=1)
        return null_space(rows)[:, 0], torch.linalg.svdvals(rows.detach())

    flat = [x.expand(*batch, -1, -1).reshape(prod(batch), *x.shape[-2:]) for x in (extensors, known)]
    per_problem = sum(x.shape[1] * t[0].numel() for x, t in zip(flat, tables, strict=True))
    vector, spectrum = map_blocks(block, *flat, size=max(1, BLOCK // max(1, per_problem)))
    extensor = vector if unknowns == 84 else vector @ _invariant_basis(device)
    transversal = subspace_of(extensor, 9, 3).unflatten(-1, (3, 3))
    return infinity_from_fundamentals(transversal)[0].reshape(*batch, 3, 3), spectrum.reshape(*batch, unknowns)


def _plane_extensors(planes: Tensor) -> Tensor:
    """Unit extensors ``(*batch, n, 84)`` of the S(H); 0 for a plane that is not finite, or singular."""
    axes = skew(torch.eye(3, dtype=torch.float64, device=planes.device))
    members = axes @ unit_determinant(finite_matrices(planes)[0])[..., None, :, :]
    return unit_vectors(extensor_of(members.flatten(-2)))


@constant
def _joins(step: int, unknowns: int, device: torch.device) -> Tensor:
    """The join with every unknown, as a linear map of an extensor: ``(binomial(9, step), equations, unknowns)``."""
    basis = _invariant_basis(device) if unknowns == 64 else torch.eye(84, dtype=torch.float64, device=device)
    count = 9 if step == 1 else 84
    eye = torch.eye(count, dtype=torch.float64, device=device)
    return wedge(eye[:, None, :], basis, 9, (step, 3)).mT.contiguous()


@constant
def _invariant_basis(device: torch.device) -> Tensor:
    r"""Orthonormal basis ``(64, 84)`` of what the extensors of all S(H) span.

    .. math:: \Lambda^3(V \otimes W) = S^3 V \otimes \Lambda^3 W + S_{21} V \otimes S_{21} W + \Lambda^3 V \otimes S^3 W

    of dimensions 10 + 64 + 10.  The extensors of the subspaces :math:`V \otimes w` span the last part, those of
    :math:`v \otimes W` the first.  S(H) is orthogonal to both: the Gram of its basis :math:`[e_k]_\times H` with the
    :math:`e_i w^T` is the skew :math:`[H w]_\times`, that with the :math:`v\, e_j^T` is :math:`[v]_\times H` up to sign, and both
    have determinant 0.
    """
    grid = [(i, j, 3 - i - j) for i in range(4) for j in range(4 - i)]  # on which no cubic vanishes
    points = torch.tensor(grid, dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64)
    left = eye[None, :, :, None] * points[:, None, None, :]
    right = points[:, None, :, None] * eye[None, :, None, :]
    others = extensor_of(torch.cat([left, right]).flatten(-2))
    return null_space(others, 64).to(device)
