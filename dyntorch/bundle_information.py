"""What images tell about each point of a bundle adjustment, and its covariance."""

from __future__ import annotations

from math import prod

import torch
from torch import Tensor
from torch.nn.functional import normalize

from dyntorch.algebra.triangulation import observed
from dyntorch.arguments import check_tensor
from dyntorch.blocks import one_thread
from dyntorch.bundle_adjustment import LOSSES, check
from dyntorch.bundle_problem import BundleProblem


def point_information(cameras: Tensor, structure: Tensor, weights: Tensor | None = None, lifts: Tensor | None = None) -> Tensor:
    r"""What the images tell about each point, given the cameras.

    .. math:: V_j = \sum_i w_{ij}\, J_{ij}^T J_{ij}, \qquad J_{ij} = \partial \pi(P_i B_i Y_j) / \partial Y_j

    It refers to the point at norm 1, and has it as a null vector.

    Args:
        cameras: ``(*batch, views, l + 1, a + 1)``.
        structure: ``(*batch, n, k + 1)``.
        weights: ``(*batch, views, n)``, 0 = missing, or None.
        lifts: as in :func:`dyntorch.bundle_adjust`.

    Returns:
        ``(*batch, n, k + 1, k + 1)``, in the unit of 1 / images squared.

    Raises:
        ValueError: shapes that do not fit each other.

    Example:
        >>> import torch
        >>> point_information(torch.eye(3)[None], torch.tensor([[0.0, 0.0, 2.0]]))[0].diagonal().tolist()
        [1.0, 1.0, 0.0]
    """
    check_tensor("cameras", cameras, "views", "l + 1", "a + 1")
    check_tensor("structure", structure, "n", "k + 1")
    if not cameras.shape[-3] or cameras.shape[-2] < 2:
        raise ValueError(f"cameras must be (*batch, views >= 1, l + 1 >= 2, a + 1), got {tuple(cameras.shape)}")
    batch, views, n = cameras.shape[:-3], cameras.shape[-3], structure.shape[-2]
    x = cameras.new_zeros(*batch, views, n, cameras.shape[-2] - 1)
    check(x, weights, cameras, structure, lifts, LOSSES[0])
    count = prod(batch)

    def flat(tensor: Tensor, *shape: int) -> Tensor:
        return tensor.double().expand(*batch, *shape).reshape(count, *shape)

    w = flat(observed(x, weights)[1], views, n)
    points = normalize(flat(structure, *structure.shape[-2:]), dim=-1).mT
    w = w * (points != 0).any(1)[:, None]
    lift = None if lifts is None else flat(lifts, *lifts.shape[-3:])
    problem = BundleProblem(flat(x, views, n, x.shape[-1]).mT, w, lift, None, LOSSES[0])
    found = problem.information(flat(cameras, *cameras.shape[-3:]), points)
    return found.permute(0, 3, 1, 2).reshape(*batch, n, *found.shape[1:3]).to(cameras.dtype)


@one_thread
def structure_covariance(
    cameras: Tensor,
    structure: Tensor,
    weights: Tensor | None = None,
    lifts: Tensor | None = None,
    *,
    sigma: Tensor | float = 1.0,
) -> Tensor:
    r"""Covariance of each point, given the cameras: :math:`\sigma^2 V_j^+`, tangent to the unit sphere at the point of norm 1.

    Args:
        cameras: ``(*batch, views, l + 1, a + 1)``.
        structure: ``(*batch, n, k + 1)``.
        weights: ``(*batch, views, n)``, 0 = missing, or None.
        lifts: as in :func:`dyntorch.bundle_adjust`.
        sigma: noise per coordinate of an image of weight 1, one or ``(*batch,)``.

    Returns:
        ``(*batch, n, k + 1, k + 1)`` of rank k; infinite where the images do not determine the point.

    Raises:
        ValueError: shapes that do not fit each other.

    Source: Hartley and Zisserman, chapter 5 and appendix A6.

    Example:
        >>> import torch
        >>> structure_covariance(torch.eye(3)[None], torch.tensor([[0.0, 0.0, 2.0]]), sigma=0.5)[0].diagonal().tolist()
        [0.25, 0.25, 0.0]
    """
    information = point_information(cameras, structure, weights, lifts).double()
    points = normalize(structure.double(), dim=-1)
    along = points[..., :, None] * points[..., None, :]
    # of trace 1, so that the point, its null vector, gets an eigenvalue of the same size as the others
    trace = information.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    held = torch.nan_to_num(information / trace, 0.0, 0.0, 0.0) + along
    factor, failed = torch.linalg.cholesky_ex(held)
    factor = torch.where(failed[..., None, None] > 0, torch.eye(held.shape[-1], dtype=held.dtype, device=held.device), factor)
    inverse = torch.cholesky_inverse(factor)
    # the eigenvalues of what is not determined are rounding
    open_ = (failed > 0) | (inverse.diagonal(dim1=-2, dim2=-1).amax(-1) > 1e13) | (trace[..., 0, 0] == 0)
    noise = torch.as_tensor(sigma, dtype=held.dtype, device=held.device)[..., None, None, None].square()
    return torch.where(open_[..., None, None], torch.inf, (inverse - along) / trace * noise).to(cameras.dtype)
