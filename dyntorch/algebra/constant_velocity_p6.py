"""The thesis's way from the constant velocity tensor to the maps of the sensors, over a projective reconstruction in P^6."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.algebra.constant_velocity import complement_frame, infinity_planes
from dyntorch.algebra.homogeneous import unit
from dyntorch.nullspace import null_space


def constant_velocity_maps_p6(tensor: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    r"""The same maps by way of a projective reconstruction in :math:`P^6`, the route of the thesis.

    .. math:: w_0 = [I \mid 0], \quad w_1 = [H \mid E], \quad H^T \beta = \alpha, \quad E = \beta^\perp,

    :math:`w_2` linearly from the tensor; then columns :math:`g, g'` with :math:`w_t g' = t\, w_t g` turn the three into
    :math:`[A_t \mid t A_t^{1..3}]`.

    Args:
        tensor: ``(*batch, 4, 4, 4)`` or ``(*batch, 4, 4, 3)``.

    Returns:
        as :func:`constant_velocity_maps`, in another gauge.

    Source: thesis section 8.3.1.

    Example:
        >>> from dyntorch.algebra.constant_velocity import constant_velocity_tensor
        >>> T = constant_velocity_tensor(*torch.eye(4, dtype=torch.float64).expand(3, 4, 4))
        >>> again = constant_velocity_tensor(*constant_velocity_maps_p6(T))
        >>> bool(torch.allclose(again * (again * T).sum().sign(), T, atol=1e-9))
        True
    """
    alpha, beta = infinity_planes(tensor)
    turn = complement_frame(beta) @ complement_frame(alpha).mT
    plane = complement_frame(beta)[..., :3]
    # the least squares solution w2: the columns of its system are orthonormal
    right = torch.einsum("...i,...ijk->...kj", alpha, tensor) @ plane
    left = torch.einsum("...ijk,...j->...ki", tensor, beta) + right @ plane.mT @ turn
    eye = torch.eye(4, dtype=tensor.dtype, device=tensor.device).expand_as(turn)
    cameras = (
        torch.cat([eye, torch.zeros_like(plane)], dim=-1),
        torch.cat([turn, plane], dim=-1),
        torch.cat([left, right], dim=-1),
    )
    equations = torch.cat([torch.cat([-t * w, w], dim=-1) for t, w in enumerate(cameras)], dim=-2)
    pairs = null_space(equations, 3).unflatten(-1, (2, 7))
    rest = null_space(pairs.flatten(-3, -2))
    basis = torch.cat([pairs[..., 0, :], rest], dim=-2).mT
    first, second, third = (unit(w @ basis) for w in cameras)
    return first, second, third
