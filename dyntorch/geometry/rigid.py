"""Rigid motions of space: rotations nearest to a matrix, least squares alignment of point sets, small motions."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.geometry.homogeneous import skew


def nearest_rotation(matrix: Tensor) -> Tensor:
    r"""The rotation R that maximizes :math:`\operatorname{tr}(R^T M)`: the polar factor, with determinant +1. matrix
    ``(*batch, 3, 3)`` -> ``(*batch, 3, 3)``."""
    u, _, vt = torch.linalg.svd(matrix)
    flip = torch.ones_like(u[..., 0])
    flip[..., 2] = torch.where(torch.linalg.det(u @ vt) < 0, -1.0, 1.0).to(u.dtype)
    return (u * flip[..., None, :]) @ vt


def rigid_alignment(target: Tensor, source: Tensor, weights: Tensor | None = None, *, scale: bool = False) -> Tensor:
    r"""The rigid motion that carries one point set onto another, :math:`\min \sum_n w_n \|x_n - s R y_n - t\|^2`. target
    ``(*batch, n, 3)``, source ``(*batch, n, 3)``, weights ``(*batch, n)`` -> ``(*batch, 4, 4)``."""
    if target.shape != source.shape or target.shape[-1:] != (3,):
        raise ValueError(f"target and source must be (*batch, n, 3) and alike, got {tuple(target.shape)}, {tuple(source.shape)}")
    weight = torch.ones_like(target[..., 0]) if weights is None else weights
    share = (weight / weight.sum(-1, keepdim=True).clamp(min=torch.finfo(target.dtype).tiny))[..., None]
    to, of = (share * target).sum(-2), (share * source).sum(-2)
    x, y = target - to[..., None, :], source - of[..., None, :]
    moment = (share * x).mT @ y
    rotation = nearest_rotation(moment)
    if scale:
        spread = (share * y.square()).sum((-2, -1)).clamp(min=torch.finfo(target.dtype).tiny)
        rotation = rotation * ((rotation * moment).sum((-2, -1)) / spread)[..., None, None]
    return rigid_motion(rotation, to - (rotation @ of[..., None])[..., 0])


def rigid_motion(rotation: Tensor, translation: Tensor) -> Tensor:
    """The matrix [R t; 0 1], ``(*batch, 4, 4)``, of ``(*batch, 3, 3)`` and ``(*batch, 3)``."""
    upper = torch.cat([rotation, translation[..., None]], dim=-1)
    last = torch.eye(4, dtype=rotation.dtype, device=rotation.device)[3:].expand(*upper.shape[:-2], 1, 4)
    return torch.cat([upper, last], dim=-2)


def rotation_exponential(vector: Tensor) -> Tensor:
    r"""The rotation by :math:`\|\omega\|` about the axis :math:`\omega`, Rodrigues' formula. vector ``(*batch, 3)`` ->
    ``(*batch, 3, 3)``."""
    angle = vector.norm(dim=-1)[..., None, None]
    turn = skew(vector)
    # sinc(x) = sin(pi x) / (pi x): no division by a vanishing angle
    half = torch.sinc(angle / (2 * torch.pi))
    eye = torch.eye(3, dtype=vector.dtype, device=vector.device)
    return eye + torch.sinc(angle / torch.pi) * turn + 0.5 * half.square() * (turn @ turn)


def moved_by(motion: Tensor, tangent: Tensor) -> Tensor:
    r"""A rigid motion after a small one: :math:`y \mapsto y + \omega \times y + \tau` to first order. motion
    ``(*batch, 4, 4)``, tangent ``(*batch, 6)`` -> ``(*batch, 4, 4)``."""
    return rigid_motion(rotation_exponential(tangent[..., :3]), tangent[..., 3:]) @ motion
