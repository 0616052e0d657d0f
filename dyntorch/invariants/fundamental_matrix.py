"""The fundamental matrix of two views of static points in space."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.core.invariant import Constraint, Frame, Invariant
from dyntorch.core.normalize import unit_tensors
from dyntorch.core.primitives import Point
from dyntorch.geometry.homogeneous import null_vectors, skew, unit
from dyntorch.numerics.least_squares import normalized_derivative


class FundamentalMatrix(Invariant):
    r"""Static points of space in two views: :math:`p_2^T F p_1 = 0`, rank two.

    Its motion is a collineation A of view 1 to view 2 (the homography of some plane) and the epipole :math:`e_2`:
    :math:`F = [e_2]_\times A`.

    Source: Hartley and Zisserman, chapters 9 and 11.

    Example:
        >>> import torch
        >>> F = FundamentalMatrix.compose(torch.eye(3), torch.tensor([1.0, 0.0, 0.0]))  # sideways: rows correspond
        >>> (F @ torch.tensor([4.0, 7.0, 1.0]) * 2**0.5).round().tolist()  # the epipolar line -y + 7 = 0
        [0.0, -1.0, 7.0]
    """

    primitives = (Point(2),) * 2
    motion = (Frame(1, 0), Frame(1, vector=True))
    dof = 7
    layout = (1, 0)
    constraint = Constraint.RANK_TWO

    @staticmethod
    def compose(A: Tensor, e2: Tensor) -> Tensor:
        r"""The fundamental matrix of a plane's homography and the epipole: :math:`F = [e_2]_\times A`.

        Args:
            A: ``(*batch, 3, 3)``, view 1 to view 2.
            e2: ``(*batch, 3)``, homogeneous, in view 2.

        Returns:
            ``(*batch, 3, 3)``, norm 1; zero where A or :math:`e_2` is zero.

        Example:
            >>> import torch
            >>> FundamentalMatrix.compose(torch.eye(3), torch.tensor([0.0, 0.0, 2.0]))[0, 1]
            tensor(-0.7071)
        """
        tensor = skew(e2) @ A
        return unit_tensors(tensor, 2)

    @staticmethod
    def decompose(tensor: Tensor) -> tuple[Tensor, Tensor]:
        r"""An invertible collineation and the epipole: :math:`A = e_2 e_1^T / \sqrt 2 - [e_2]_\times F`, with :math:`\|F\| = 1`.

        Every :math:`A + e_2 v^T` gives the same F; this one has the singular values of F beside :math:`1 / \sqrt 2`.
        Where F has rank three the motion is that of the nearest matrix of rank two.

        Args:
            tensor: ``(*batch, 3, 3)`` of any scale.

        Returns:
            A ``(*batch, 3, 3)``, norm 1, determinant not negative, and :math:`e_2` ``(*batch, 3)``, norm 1, its largest
            coordinate positive; zero for a zero matrix (a failed fit).

        Example:
            >>> import torch
            >>> F = FundamentalMatrix.compose(torch.eye(3), torch.tensor([3.0, 0.0, 4.0]))
            >>> A, e2 = FundamentalMatrix.decompose(F)
            >>> e2.round(decimals=4).tolist(), bool(torch.linalg.det(A) > 0.1)
            ([0.6000000238418579, 0.0, 0.800000011920929], True)
        """
        e1, e2 = FundamentalMatrix.epipoles(tensor.double())
        matrix = _canonical(tensor.double().flatten(-2)).unflatten(-1, (3, 3))
        collineation = 0.5**0.5 * e2[..., :, None] * e1[..., None, :] - skew(e2) @ matrix
        return unit(collineation).to(tensor.dtype), e2.to(tensor.dtype)

    def compose_derivative(self, motion: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
        r"""By hand: :math:`[e_2]_\times e_k e_l^T` by :math:`A_{kl}` and :math:`[e_m]_\times A` by coordinate m of the epipole."""
        A, e2 = motion
        eye = torch.eye(3, dtype=A.dtype, device=A.device)
        cross = skew(e2)
        by_matrix = torch.einsum("bik,lj->bklij", cross, eye).flatten(3).flatten(1, 2)
        by_epipole = (skew(eye) @ A[:, None]).flatten(2)
        return normalized_derivative((cross @ A).flatten(1), torch.cat([by_matrix, by_epipole], dim=1))

    def constrain(self, tensor: Tensor) -> Tensor:
        r"""The nearest matrix of rank two, :math:`F - F v v^T` with the singular vector v to the smallest singular value."""
        right = null_vectors(tensor)[1]
        return tensor - (tensor @ right[..., :, None]) * right[..., None, :]

    @staticmethod
    def epipoles(tensor: Tensor) -> tuple[Tensor, Tensor]:
        r"""The epipoles: :math:`F e_1 = 0,\ F^T e_2 = 0`.

        Args:
            tensor: ``(*batch, 3, 3)``; where it has rank three, those of the nearest matrix of rank two.

        Returns:
            :math:`e_1` in view 1 and :math:`e_2` in view 2, homogeneous ``(*batch, 3)``, norm 1, the largest coordinate
            positive; zero where the rank is below two.

        Example:
            >>> import torch
            >>> F = FundamentalMatrix.compose(torch.eye(3), torch.tensor([0.0, 0.0, 2.0]))
            >>> [e.tolist() for e in FundamentalMatrix.epipoles(F)]
            [[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]]
        """
        left, right = null_vectors(tensor.double())
        return _canonical(right).to(tensor.dtype), _canonical(left).to(tensor.dtype)


def _canonical(vector: Tensor) -> Tensor:
    """Norm 1, the largest coordinate positive; ``(*batch, size)``."""
    return unit(vector[..., None])[..., 0]
