"""Rigid motions of space: rotations nearest to a matrix, least squares alignment of point sets, small motions."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.geometry.homogeneous import skew


def nearest_rotation(matrix: Tensor) -> Tensor:
    r"""The rotation R that maximizes :math:`\operatorname{tr}(R^T M)`: the polar factor, with determinant +1.

    Args:
        matrix: ``(*batch, 3, 3)`` finite; of rank 1 or 0 the rotation is one of several.

    Returns:
        ``(*batch, 3, 3)``.

    Source: Umeyama 1991.

    Example:
        >>> import torch
        >>> nearest_rotation(torch.diag(torch.tensor([2.0, 3.0, 0.1]))).round(decimals=6).diagonal().tolist()
        [1.0, 1.0, 1.0]
    """
    u, _, vt = torch.linalg.svd(matrix)
    flip = torch.ones_like(u[..., 0])
    flip[..., 2] = torch.where(torch.linalg.det(u @ vt) < 0, -1.0, 1.0).to(u.dtype)
    return (u * flip[..., None, :]) @ vt


def rigid_alignment(target: Tensor, source: Tensor, weights: Tensor | None = None, *, scale: bool = False) -> Tensor:
    r"""The rigid motion that carries one point set onto another, :math:`\min \sum_n w_n \|x_n - s R y_n - t\|^2`.

    Args:
        target: ``(*batch, n, 3)`` points x.
        source: ``(*batch, n, 3)`` points y.
        weights: ``(*batch, n)`` not negative; default 1.
        scale: True also estimates the scale s, a similarity; else s = 1.

    Returns:
        ``(*batch, 4, 4)`` from source to target, last row (0, 0, 0, 1).

    Raises:
        ValueError: shapes that differ.

    Source: Kabsch 1976; Umeyama 1991.

    Example:
        >>> import torch
        >>> y = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
        >>> rigid_alignment(y + 1, y).round(decimals=5)[:3, 3].tolist()
        [1.0, 1.0, 1.0]
    """
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
    r"""The rotation by :math:`\|\omega\|` about the axis :math:`\omega`, Rodrigues' formula.

    Args:
        vector: ``(*batch, 3)`` axis times angle, radians.

    Returns:
        ``(*batch, 3, 3)``.

    Example:
        >>> import torch
        >>> rotation_exponential(torch.tensor([0.0, 0.0, torch.pi / 2])).round(decimals=5)[:, 0].abs().tolist()
        [0.0, 1.0, 0.0]
    """
    angle = vector.norm(dim=-1)[..., None, None]
    turn = skew(vector)
    # sinc(x) = sin(pi x) / (pi x): no division by a vanishing angle
    half = torch.sinc(angle / (2 * torch.pi))
    eye = torch.eye(3, dtype=vector.dtype, device=vector.device)
    return eye + torch.sinc(angle / torch.pi) * turn + 0.5 * half.square() * (turn @ turn)


def moved_by(motion: Tensor, tangent: Tensor) -> Tensor:
    r"""A rigid motion after a small one: :math:`y \mapsto y + \omega \times y + \tau` to first order.

    Args:
        motion: ``(*batch, 4, 4)``.
        tangent: ``(*batch, 6)``, :math:`\omega` in radians, then :math:`\tau`.

    Returns:
        ``(*batch, 4, 4)``.

    Example:
        >>> import torch
        >>> moved_by(torch.eye(4), torch.tensor([0.0, 0.0, 0.0, 1.0, 2.0, 3.0]))[:3, 3].tolist()
        [1.0, 2.0, 3.0]
    """
    return rigid_motion(rotation_exponential(tangent[..., :3]), tangent[..., 3:]) @ motion
