"""The 3-D points behind shape tensors: the frames they are known in, and how tensors of that frame give them back."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from dyntorch.algebra.extensors import meet
from dyntorch.algebra.grassmann_nearest import projections_of
from dyntorch.algebra.homogeneous import unit_vectors
from dyntorch.algebra.shape_rows import PROFILES, by_lines, plane_map
from dyntorch.constants import constant
from dyntorch.nullspace import null_space
from dyntorch.primitives.base import inverse

GENERAL, PLANE, AFFINE = "general", "plane", "affine"
THIN = 1e-12
"""Determinant of four basis points of norm 1 (or of three and the normal of their plane) that are no basis, to rounding."""


def standard(points: Tensor, frame: str) -> Tensor:
    r"""Points in the frame that a shape tensor leaves open.

    - ``general``: :math:`P_1 \dots P_4 = e_1 \dots e_4` (any scale of the four coordinates is left);
    - ``plane``: :math:`P_1, P_2, P_3 = e_1, e_2, e_3` and :math:`P_4 = (1, 1, 1, 0)`, which is first moved onto their plane;
    - ``affine``: last coordinate 1.

    Args:
        points: ``(*batch, n, 4)`` homogeneous, of any scale.
        frame: one of the three.

    Returns:
        ``(*batch, n, 4)``; not finite where the basis points have no frame.
    """
    if frame == AFFINE:
        return points / points[..., 3:]
    corners = points[..., :4, :]
    if frame == PLANE:
        normal = meet(*corners[..., :3, :].unbind(-2))
        corners = torch.cat([corners[..., :3, :], unit_vectors(normal)[..., None, :]], dim=-2)
    others = points[..., 3:, :] @ inverse(corners)
    volume = torch.linalg.det(unit_vectors(corners))[..., None, None]
    others = torch.where(volume.abs() > THIN, others, torch.nan)
    if frame == PLANE:
        others = others / torch.cat([others[..., :1, :3], torch.ones_like(others[..., :1, 3:])], dim=-1)
    return with_basis(others[..., 1:, :], frame)


def with_basis(others: Tensor, frame: str) -> Tensor:
    """The points ``(*batch, n - 4, 4)`` behind the four of the basis: ``(*batch, n, 4)``."""
    basis = _basis(frame, others.device).to(others.dtype)
    return torch.cat([basis.expand(*others.shape[:-2], 4, 4), others], dim=-2)


@constant
def _basis(frame: str, device: torch.device) -> Tensor:
    basis = torch.eye(4, dtype=torch.float64)
    if frame == PLANE:
        basis[3] = torch.tensor([1.0, 1.0, 1.0, 0.0])
    return basis.to(device)


def dual_cameras(others: Tensor) -> list[Tensor]:
    r"""The matrices :math:`\hat P = (\mathrm{diag}(X, Y, Z) \mid W 1)` of points ``(*batch, k, 4)`` in the general frame."""
    last = others[..., 3:].expand(*others.shape[:-1], 3)[..., None]
    return list(torch.cat([torch.diag_embed(others[..., :3]), last], dim=-1).unbind(-3))


def reference_cameras(others: Tensor) -> list[Tensor]:
    r"""The matrices :math:`\hat P = (W I \mid (X, Y, Z)^T)` of points ``(*batch, k, 4)`` beside a reference plane."""
    eye = torch.eye(3, dtype=others.dtype, device=others.device)
    return list(torch.cat([others[..., 3, None, None] * eye, others[..., :3, None]], dim=-1).unbind(-3))


def general_points(tensor: Tensor, order: int) -> Tensor:
    r"""Points ``(*batch, n, 4)`` of a tensor ``(*batch, 3, 3, ...)`` of so many axes in the general frame with P5 = (1, 1, 1, 1).

    The tensor is the dual of a multi-view one: its cameras see each other's centres, :math:`\hat P_i c_5 \sim (X - W, Y - W,
    Z - W)` and :math:`\hat P_5 c_i \sim ((X - W) / X, \dots)` for :math:`P_i = (X, Y, Z, W)`, whose ratio is (X, Y, Z).
    """
    profile = PROFILES[4 + order]
    cameras = projections_of(by_lines(tensor, profile), profile, (3,) * order)
    sound = torch.stack([m.flatten(-2).abs().amax(-1) for m in cameras]).amin(0) > 0
    whole = torch.eye(3, 4, dtype=tensor.dtype, device=tensor.device)
    cameras = tuple(torch.where(sound[..., None, None], m, whole) for m in cameras)
    centres = [null_space(m)[..., 0, :, None] for m in cameras]
    others = [torch.ones_like(tensor.flatten(-order)[..., :4])]
    for camera, centre in zip(cameras[1:], centres[1:], strict=True):
        seen, back = (camera @ centres[0])[..., 0], (cameras[0] @ centre)[..., 0]
        others.append(_from_epipoles(seen, back))
    points = with_basis(torch.stack(others, dim=-2), GENERAL)
    return torch.where(sound[..., None, None] & points.isfinite(), points, 0.0)


def _from_epipoles(seen: Tensor, back: Tensor) -> Tensor:
    r"""(X, Y, Z, W) from :math:`e \sim (X - W, \dots)` and the ratio :math:`r \sim (X, Y, Z)`: :math:`\alpha r - \beta 1 = e`."""
    ratio = normalize(seen / back, dim=-1)
    mean_r, mean_e = ratio.mean(-1, keepdim=True), seen.mean(-1, keepdim=True)
    alpha = ((ratio - mean_r) * (seen - mean_e)).sum(-1, keepdim=True) / (ratio - mean_r).square().sum(-1, keepdim=True)
    return unit_vectors(torch.cat([alpha * ratio, alpha * mean_r - mean_e], dim=-1))


def plane_points(v: Tensor) -> Tensor:
    """Points ``(*batch, n, 4)`` in the frame of the reference plane for ``v (*batch, n - 4, 3)`` beside it, at RMS distance 1."""
    size = v.square().sum(-1).mean(-1)[..., None, None]
    v = v * torch.where(size > 0, size, 1.0).rsqrt()
    return with_basis(torch.cat([v, torch.ones_like(v[..., :1])], dim=-1), PLANE) * (size > 0)


@constant
def plane_inverse(points: int, device: torch.device) -> Tensor:
    """From a tensor ``3^k`` to the ``v (3 k)`` of sum 0."""
    return torch.linalg.pinv(plane_map(points, device))


def affine_points(annihilator: Tensor) -> Tensor:
    """Points ``(*batch, n, 4)``, orthonormal coordinates of RMS 1, of the annihilator ``(*batch, n - 4, n)`` of their shape."""
    n = annihilator.shape[-1]
    zero = annihilator.flatten(-2).abs().amax(-1)[..., None, None] == 0
    rows = torch.cat([annihilator, torch.ones_like(annihilator[..., :1, :])], dim=-2)
    eye = torch.eye(*rows.shape[-2:], dtype=rows.dtype, device=rows.device)
    found = null_space(torch.where(zero, eye, rows), 3).mT * n**0.5
    points = torch.cat([found, torch.ones_like(found[..., :1])], dim=-1)
    return torch.where(zero, 0.0, points)
