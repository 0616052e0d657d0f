"""Pencils of matrices with a member of rank one: what a plane of a translating body makes with the homography at infinity."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.algebra.extensors import compound
from dyntorch.algebra.homogeneous import nonzero_sign
from dyntorch.algebra.rank_two import rank_one, unit_size

SINGULAR = 1e-12  # |det| / |H|^3 below which a homography cannot be scaled to determinant 1


@dataclass(frozen=True)
class PlaneParts:
    """Planes of translating bodies under a homography at infinity: :math:`H_i = \\lambda_i (H_\\infty + e_i n_i^T)`."""

    scale: Tensor
    """``(*batch, n)`` :math:`\\lambda_i`."""
    epipole: Tensor
    """``(*batch, n, 3)`` unit vectors :math:`e_i` in view 2; their signs are arbitrary."""
    normal: Tensor
    """``(*batch, n, 3)`` :math:`n_i`, for the unit epipole; about 0 for a plane that does not move, or at infinity."""
    residual: Tensor
    """``(*batch, n)`` what is left, :math:`\\|H_i - \\lambda_i (H_\\infty + e_i n_i^T)\\| / \\|H_i\\|`; no scale
    changes it."""


def unit_determinant(matrix: Tensor) -> Tensor:
    r"""A 3 x 3 matrix up to scale with determinant 1; one that is singular gets norm 1 instead, and 0 stays.

    Args:
        matrix: ``(*batch, 3, 3)``.

    Returns:
        ``(*batch, 3, 3)``.

    Example:
        >>> import torch
        >>> unit_determinant(-2 * torch.eye(3)).diagonal().tolist()
        [1.0, 1.0, 1.0]
    """
    norm = torch.linalg.matrix_norm(matrix, keepdim=True)
    scaled = matrix / torch.where(norm > 0, norm, 1.0)
    det = torch.linalg.det(scaled)[..., None, None]
    regular = det.abs() > SINGULAR
    root = torch.where(regular, det.abs(), 1.0) ** (1 / 3)
    return torch.where(regular, scaled * nonzero_sign(det) / root, scaled)


def rank_one_scale(first: Tensor, second: Tensor) -> Tensor:
    r"""The :math:`\nu` for which :math:`A - \nu B` is nearest to rank one, relative to its size.

    The 2-minors :math:`C_2(A - \nu B) = C_2(A) - \nu M + \nu^2 C_2(B)` vanish where the rank is one.  Their sum of squares is a
    quartic in :math:`\nu`; its stationary points, the roots of a cubic, are the candidates, and with them the :math:`\nu` of least
    squares, which is exact where A is a multiple of B.  The candidate with the least :math:`\|C_2(D)\| / \|D\|`, which is about
    the second singular value of :math:`D = A - \nu B`, wins.

    Args:
        first: A ``(*batch, r, c)``, r and c from 2.
        second: B, of the same shape or one that broadcasts.

    Returns:
        ``(*batch,)``, finite; where A or B is not finite or B is 0, it means nothing.

    Example:
        >>> import torch
        >>> B = torch.tensor([[1.0, 2.0, 0.0], [0.0, 1.0, 1.0]], dtype=torch.float64)
        >>> A = 3 * B + torch.tensor([[1.0], [2.0]], dtype=torch.float64) * torch.tensor([1.0, 0.0, -1.0], dtype=torch.float64)
        >>> round(float(rank_one_scale(A, B)), 9)
        3.0
    """
    a, size_a = unit_size(first)
    b, size_b = unit_size(second)
    a, b = torch.broadcast_tensors(a, b)
    constant, quadratic = compound(a, 2).flatten(-2), compound(b, 2).flatten(-2)
    linear = constant + quadratic - compound(a - b, 2).flatten(-2)
    coefficients = (
        (constant * linear).sum(-1),
        (linear.square() + 2 * constant * quadratic).sum(-1),
        (linear * quadratic).sum(-1),
        quadratic.square().sum(-1),
    )
    ratio = (a * b).sum((-2, -1))[..., None]
    candidates = torch.cat([_stationary(*coefficients), ratio], dim=-1)
    member = a[..., None, :, :] - candidates[..., None, None] * b[..., None, :, :]
    best = second_singular_value(member).argmin(-1, keepdim=True)
    return candidates.gather(-1, best)[..., 0] * (size_a / torch.where(size_b > 0, size_b, 1.0))[..., 0, 0]


def _stationary(c0: Tensor, c1: Tensor, c2: Tensor, c3: Tensor) -> Tensor:
    """Real parts ``(*batch, 3)`` of the roots of 2 c3 v^3 - 3 c2 v^2 + c1 v - c0, the derivative of the quartic (halved)."""
    lead = 2 * torch.where(c3 > torch.finfo(c3.dtype).tiny, c3, 1.0)
    companion = torch.diag_embed(torch.ones_like(c0)[..., None].expand(*c0.shape, 2), offset=-1)
    companion[..., 0, :] = torch.stack([3 * c2, -c1, c0], dim=-1) / lead[..., None]
    # the real part of a complex root is one more candidate, and never the best
    return torch.linalg.eigvals(companion.nan_to_num(0.0, 1e100, -1e100)).real


def second_singular_value(matrix: Tensor) -> Tensor:
    r"""About the second singular value, :math:`\|C_2(D)\| / \|D\|`: 0 where the rank is one, and for D = 0.

    At rank two it is exact to :math:`(\sigma_2 / \sigma_1)^2`; with a third singular value it is about
    :math:`\sqrt{\sigma_2^2 + \sigma_3^2}`.

    Args:
        matrix: ``(*batch, r, c)``.

    Returns:
        ``(*batch,)``.

    Example:
        >>> import torch
        >>> round(float(second_singular_value(torch.diag(torch.tensor([4.0, 1e-3, 0.0])))), 6)
        0.001
    """
    size = torch.linalg.matrix_norm(matrix)
    return torch.linalg.matrix_norm(compound(matrix, 2)) / torch.where(size > 0, size, 1.0)


def plane_parts(homographies: Tensor, infinity: Tensor) -> PlaneParts:
    r"""Scale, epipole and normal of planes, given the homography at infinity: :math:`H_i = \lambda_i (H_\infty + e_i n_i^T)`.

    :math:`\lambda_i` is the :func:`rank_one_scale` of :math:`H_i` and :math:`H_\infty`; :math:`e_i n_i^T` is then the nearest
    matrix of rank one.  The plane is :math:`n_i^T X = 1` in the affine frame where the cameras are :math:`[I \mid 0]` and
    :math:`[H_\infty \mid e_i]`, and the body's fundamental matrix is :math:`[e_i]_\times H_\infty`.

    Args:
        homographies: H ``(*batch, n, 3, 3)``, view 1 to view 2, of any scale, in coordinates of size 1.
        infinity: ``(*batch, 3, 3)``.

    Returns:
        the parts, in float64; zeros for a plane that is not finite.

    Raises:
        ValueError: shapes that do not fit.

    Source: thesis chapter 5.

    Example:
        >>> import torch
        >>> e, n = torch.tensor([0.6, 0.0, 0.8]).double(), torch.tensor([0.0, 0.3, 0.5]).double()
        >>> parts = plane_parts(2 * (torch.eye(3) + e[:, None] * n)[None], torch.eye(3).double())
        >>> parts.scale.round(decimals=6).tolist(), (parts.epipole[0, :, None] * parts.normal[0])[0].round(decimals=6).tolist()
        ([2.0], [0.0, 0.18, 0.3])
    """
    check_homographies(homographies, 1)
    if infinity.shape[-2:] != (3, 3):
        raise ValueError(f"infinity must be (*batch, 3, 3), got {tuple(infinity.shape)}")
    planes, finite = finite_matrices(homographies)
    base = finite_matrices(infinity)[0][..., None, :, :]
    scale = rank_one_scale(planes, base)
    nonzero = torch.where(scale == 0, 1.0, scale)
    difference = planes / nonzero[..., None, None] - base
    epipole, normal = rank_one(difference)
    left = torch.linalg.matrix_norm(difference - epipole[..., :, None] * normal[..., None, :])
    size = torch.linalg.matrix_norm(planes)
    residual = left * nonzero.abs() / torch.where(size > 0, size, 1.0)
    mask = finite.to(planes.dtype)
    return PlaneParts(scale * mask, epipole * mask[..., None], normal * mask[..., None], residual * mask)


def check_homographies(homographies: Tensor, least: int) -> None:
    """Refuse what is not a stack of at least so many homographies."""
    if homographies.ndim < 3 or homographies.shape[-2:] != (3, 3) or not homographies.is_floating_point():
        raise ValueError(
            f"H must be a floating point tensor (*batch, n, 3, 3), got {tuple(homographies.shape)} {homographies.dtype}"
        )
    if homographies.shape[-3] < least:
        raise ValueError(
            f"H has {homographies.shape[-3]} planes, this method takes at least {least}: add {least - homographies.shape[-3]}"
        )


def finite_matrices(matrices: Tensor) -> tuple[Tensor, Tensor]:
    """Matrices in float64 with zeros for those that are not finite, and which are finite ``(*batch,)``."""
    finite = matrices.isfinite().flatten(-2).all(-1)
    return torch.where(finite[..., None, None], matrices, 0.0).double(), finite
