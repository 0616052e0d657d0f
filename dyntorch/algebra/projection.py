"""Projections and their inverses on points, with Jacobians, finite at any rank."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.algebra.extensors import compound
from dyntorch.algebra.homogeneous import finite_depth


def adjugate(matrix: Tensor) -> Tensor:
    r"""The adjugate, :math:`A\,\mathrm{adj}(A) = \det(A)\, I`: the inverse up to scale, finite and smooth at any rank.

    Args:
        matrix: ``(*batch, n, n)``, n from 2 to 4 in this library.

    Returns:
        ``(*batch, n, n)``, polynomials of the entries.

    Example:
        >>> import torch
        >>> adjugate(torch.tensor([[1.0, 2.0], [3.0, 4.0]])).tolist()
        [[4.0, -2.0], [-3.0, 1.0]]
    """
    n = matrix.shape[-1]
    # minors in lexicographic order: the last one is without the first row
    minors = compound(matrix, n - 1).flip(-1, -2)
    signs = 1.0 - 2.0 * (torch.arange(n, device=matrix.device) % 2).to(matrix.dtype)
    return (minors * (signs[:, None] * signs)).mT


def project(matrix: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    r"""Images :math:`y = \pi(A (x, 1))` of points, and the Jacobian :math:`\partial y / \partial x` of each.

    Args:
        matrix: ``(*batch, e + 1, d + 1)`` collineation or projection of any scale and sign.
        points: ``(*batch, n, d)``.

    Returns:
        ``(*batch, n, e)``, images at infinity as in :func:`~dyntorch.algebra.homogeneous.inhomogeneous`, and
        ``(*batch, n, e, d)``.

    Example:
        >>> import torch
        >>> camera = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
        >>> image, jacobian = project(camera, torch.tensor([[6.0, 2.0]]))
        >>> image.tolist(), jacobian.tolist()
        ([[3.0]], [[[0.5, -1.5]]])
    """
    return dehomogenized(points @ matrix[..., :-1].mT + matrix[..., None, :, -1], matrix[..., None, :, :-1])


def dehomogenized(p: Tensor, derivative: Tensor) -> tuple[Tensor, Tensor]:
    r"""Points :math:`\pi(p)` and the derivative of their coordinates.

    Args:
        p: ``(*batch, n, e + 1)`` homogeneous points of any scale.
        derivative: ``(*batch, n, e + 1, d)`` of p, at the same scale; multiples of p in it do not matter.

    Returns:
        ``(*batch, n, e)`` and ``(*batch, n, e, d)``.
    """
    depth = finite_depth(p)
    y = p[..., :-1] / depth
    return y, (derivative[..., :-1, :] - y[..., :, None] * derivative[..., -1:, :]) / depth[..., None]


def back_project(matrix: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    r"""Positions :math:`\pi(A^{-1} (x, 1))` of what a sensor measured, and their Jacobians, by way of the adjugate.

    Args:
        matrix: ``(*batch, d + 1, d + 1)`` world to sensor, of any scale and sign.
        x: ``(*batch, n, d)`` measurements.

    Returns:
        ``(*batch, n, d)`` and ``(*batch, n, d, d)``.

    Example:
        >>> import torch
        >>> back_project(torch.diag(torch.tensor([2.0, 4.0, 1.0])), torch.tensor([[2.0, 4.0]]))[0].tolist()
        [[1.0, 1.0]]
    """
    return project(adjugate(matrix), x)
