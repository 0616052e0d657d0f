"""The homography tensor: points of a plane that stand still or move on straight lines, in three views."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.core.invariant import Constraint, Frame, Invariant
from dyntorch.core.normalize import unit_tensors
from dyntorch.core.primitives import Point
from dyntorch.geometry.extensors import levi_civita
from dyntorch.geometry.homogeneous import homogeneous, inhomogeneous, unit
from dyntorch.invariants.agreement import (
    point_error,
    skew_partner,
    static_map,
    static_map_derivative,
    static_residual,
    third_vector,
    unit_normal,
    whitened_agreement,
)
from dyntorch.numerics.least_squares import normalized_derivative


class HomographyTensor(Invariant):
    r"""Points of a plane on straight paths in three views: :math:`H_{ijk}\, p_1^i p_2^j p_3^k = \det[p_1, A p_2, B p_3] = 0`.

    A static point fulfils it as well: matches need no labels.  Matches known to be static add more rows
    (:math:`H(p_1, p_2, \cdot) = 0` and its two like).  The moving points must lie on at least four different lines.

    Source: thesis chapter 2 and section 8.1; Shashua and Wolf, ECCV 2000.

    Example:
        >>> import torch
        >>> A = torch.diag(torch.tensor([1.0, 2.0, 4.0], dtype=torch.float64))
        >>> H = HomographyTensor.compose(A, torch.eye(3, dtype=torch.float64))
        >>> back, _ = HomographyTensor.decompose(H)
        >>> bool(torch.allclose(back, A / A.norm()))
        True
    """

    primitives = (Point(2),) * 3
    motion = (Frame(0, 1), Frame(0, 2))
    dof = 16
    labels_static = True
    constraint = Constraint.HOMOGRAPHIES

    @staticmethod
    def compose(A: Tensor, B: Tensor) -> Tensor:
        r"""The tensor of two homographies: :math:`H_{ijk} = \epsilon_{iuv} A_{uj} B_{vk}`, :math:`H_{\cdot jk} = a_j \times b_k`.

        Args:
            A: ``(*batch, 3, 3)``, view 2 to view 1.
            B: ``(*batch, 3, 3)``, view 3 to view 1.

        Returns:
            ``(*batch, 3, 3, 3)``, axes in the order of the views, norm 1; zero where A or B is zero.

        Example:
            >>> import torch
            >>> HomographyTensor.compose(torch.eye(3), torch.eye(3))[0, 1].mul(6**0.5).round().tolist()
            [0.0, 0.0, 1.0]
        """
        tensor = torch.linalg.cross(A.mT[..., :, None, :], B.mT[..., None, :, :], dim=-1).movedim(-1, -3)
        return unit_tensors(tensor, 3)

    def compose_derivative(self, motion: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
        # by hand, a fifth of the time: the tensor is linear in A and in B
        A, B = motion
        epsilon, eye = levi_civita(3, dtype=A.dtype, device=A.device), torch.eye(3, dtype=A.dtype, device=A.device)
        value = torch.einsum("iuv,...uj,...vk->...ijk", epsilon, A, B).flatten(-3)
        by_a = torch.einsum("iuv,...vk,mj->...umijk", epsilon, B, eye).flatten(-5, -4).flatten(-3)
        by_b = torch.einsum("iuv,...uj,mk->...vmijk", epsilon, A, eye).flatten(-5, -4).flatten(-3)
        return normalized_derivative(value, torch.cat([by_a, by_b], dim=-2))

    @staticmethod
    def decompose(tensor: Tensor) -> tuple[Tensor, Tensor]:
        r"""The two homographies of a tensor, from linear systems.

        The slices :math:`G_k = H_{\cdot\cdot k} = -[b_k]_\times A` make :math:`A^T G_k` skew-symmetric: 18 equations whose
        only solution is A, up to scale.  The slices :math:`H_{\cdot j \cdot} = [a_j]_\times B` give B in the same way.  Of a
        noisy tensor this is a least-squares solution, best where the matches are centred and of order 1, as in
        ``Solution.motion`` (100 matches, 0.5 px: 1.3 px off, from the tensor in pixels 1.9, and 16 instead of 2.1 in one of ten).

        Args:
            tensor: ``(*batch, 3, 3, 3)`` of any scale, in any coordinates.

        Returns:
            A and B ``(*batch, 3, 3)``, norm 1, determinant not negative; zero for a zero tensor (a failed fit).

        Raises:
            ValueError: another shape.

        Source: thesis section 8.1 (i); Shashua and Wolf, ECCV 2000.

        Example:
            >>> import torch
            >>> H = HomographyTensor.compose(torch.eye(3).double(), torch.diag(torch.tensor([1.0, 2.0, 2.0]).double()))
            >>> [round(x, 6) for x in (3 * HomographyTensor.decompose(H)[1].diagonal()).tolist()]
            [1.0, 2.0, 2.0]
        """
        balanced, (first, second, third) = _balance_slices(tensor.double())
        a = _solve_skew_system(balanced) * second[..., None, :] / first[..., :, None]
        b = _solve_skew_system(balanced.mT) * third[..., None, :] / first[..., :, None]
        return unit(a).to(tensor.dtype), unit(b).to(tensor.dtype)

    @staticmethod
    def transfer(tensor: Tensor, x: Tensor, source: int = 2, target: int = 1) -> Tensor:
        r"""Where static points of one view are in another, without A and B.

        :math:`M = H(\cdot, p_2, \cdot)` has rank two; its left null vector is :math:`A p_2`, the point in view 1, its right
        null vector the point in view 3; likewise for the other views.

        Args:
            tensor: ``(*batch, 3, 3, 3)``.
            x: points ``(*batch, n, 2)`` of view ``source``.
            source: 1, 2 or 3.
            target: 1, 2 or 3, another view.

        Returns:
            ``(*batch, n, 2)`` positions in view ``target``.

        Raises:
            ValueError: views that are not two different ones of 1, 2, 3.

        Source: thesis section 8.1 (ii).

        Example:
            >>> import torch
            >>> A = torch.tensor([[1.0, 0.0, 5.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
            >>> H = HomographyTensor.compose(A, torch.eye(3))
            >>> HomographyTensor.transfer(H, torch.tensor([[1.0, 2.0]])).round(decimals=4).tolist()
            [[6.0, 2.0]]
        """
        return inhomogeneous(static_map(tensor, homogeneous(x), source, target)).to(x.dtype)

    @staticmethod
    def trajectory(tensor: Tensor, x_a: Tensor, x_b: Tensor, view: int = 1) -> Tensor:
        r"""The line on which each point moves, seen in one view, from its positions in the two others: in view 1
        :math:`l_i = H_{ijk} p_2^j p_3^k = A p_2 \times B p_3`.

        Args:
            tensor: ``(*batch, 3, 3, 3)``.
            x_a: ``(*batch, n, 2)`` positions in the first of the two other views.
            x_b: ``(*batch, n, 2)`` positions in the second of them.
            view: 1, 2 or 3.

        Returns:
            ``(*batch, n, 3)`` lines with unit normals.  A point that stands still between the two views has no line: the
            result is zero (with noise, any line through it).

        Raises:
            ValueError: view is not 1, 2 or 3.

        Source: thesis section 8.1 (ii).

        Example:
            >>> import torch
            >>> H = HomographyTensor.compose(torch.eye(3), torch.eye(3))
            >>> line = HomographyTensor.trajectory(H, torch.tensor([[0.0, 1.0]]), torch.tensor([[4.0, 1.0]]))
            >>> line.abs().tolist()
            [[0.0, 1.0, 1.0]]
        """
        return unit_normal(third_vector(tensor, homogeneous(x_a), homogeneous(x_b), view)).to(x_a.dtype)

    @staticmethod
    def transfer_moving(tensor: Tensor, x_a: Tensor, x_b: Tensor, line: Tensor, view: int = 1) -> Tensor:
        r"""Where a moving point is in one view, from its positions in the two others and a line through it there.

        Args:
            tensor: ``(*batch, 3, 3, 3)``.
            x_a: ``(*batch, n, 2)`` positions in the first of the two other views.
            x_b: ``(*batch, n, 2)`` positions in the second of them.
            line: ``(*batch, n, 3)`` lines of view ``view`` that contain the point, any scale.
            view: 1, 2 or 3.

        Returns:
            ``(*batch, n, 2)``: where the line meets the trajectory.

        Raises:
            ValueError: view is not 1, 2 or 3.

        Source: thesis section 8.1 (ii).

        Example:
            >>> import torch
            >>> H = HomographyTensor.compose(torch.eye(3), torch.eye(3))
            >>> positions = torch.tensor([[0.0, 1.0]]), torch.tensor([[4.0, 1.0]])
            >>> HomographyTensor.transfer_moving(H, *positions, torch.tensor([[1.0, 0.0, -3.0]])).tolist()
            [[3.0, 1.0]]
        """
        path = third_vector(tensor, homogeneous(x_a), homogeneous(x_b), view)
        return inhomogeneous(torch.linalg.cross(path, line.to(path.dtype), dim=-1)).to(x_a.dtype)

    @staticmethod
    def static_distance(tensor: Tensor, x1: Tensor, x2: Tensor, x3: Tensor) -> Tensor:
        r"""How far each match is from standing still, without A and B: to first order, the least motion of its six
        coordinates after which all three views agree.

        Args:
            tensor: ``(*batch, 3, 3, 3)``.
            x1: ``(*batch, n, 2)``; x2, x3 likewise.

        Returns:
            ``(*batch, n)`` in the unit of the points.  With noise of standard deviation s, the square over :math:`s^2` of a
            static point follows :math:`\chi^2_4`.

        Source: thesis section 8.1 (iii).

        Example:
            >>> import torch
            >>> H, x = HomographyTensor.compose(torch.eye(3), torch.eye(3)), torch.tensor([[1.0, 2.0]])
            >>> round(float(HomographyTensor.static_distance(H, x, x, x + 3)), 3)
            3.464
        """
        parts = []
        for source, x in ((2, x2), (3, x3)):
            image, derivative = static_map_derivative(tensor, homogeneous(x), source, 1)
            parts.append(point_error(image, derivative, x1.to(image.dtype)))
        one = torch.ones((), dtype=torch.float64, device=x1.device)
        return whitened_agreement(parts, (one,) * 3).norm(dim=-1).to(x1.dtype)

    def whitened_static_residual(self, motion: tuple[Tensor, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...]) -> Tensor:
        r"""Whitened :math:`e = (\pi(A p_2) - x_1,\ \pi(B p_3) - x_1)`, ``(*batch, n, 4)``."""
        return static_residual(motion, views, scales)


def _balance_slices(tensor: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor]]:
    r"""Scale the homogeneous coordinates of each view so that all slices of the tensor are of similar size."""
    if tensor.shape[-3:] != (3, 3, 3):
        raise ValueError(f"tensor must be (*batch, 3, 3, 3), got {tuple(tensor.shape)}")
    scales = [torch.ones(*tensor.shape[:-3], 3, dtype=tensor.dtype, device=tensor.device) for _ in range(3)]
    for _ in range(2):
        for axis in range(3):
            others = [a - 3 for a in range(3) if a != axis]
            size = torch.linalg.vector_norm(tensor, dim=others, keepdim=True)
            # a slice of rounding errors is not blown up
            floor = 1e-8 * size.detach().amax(dim=axis - 3, keepdim=True)
            size = torch.where(floor > 0, torch.maximum(size, floor), torch.ones_like(size))
            tensor, scales[axis] = tensor / size, scales[axis] * size.flatten(-3)
    return tensor, (scales[0], scales[1], scales[2])


def _solve_skew_system(slices: Tensor) -> Tensor:
    """The X ``(*batch, 3, 3)`` for which X^T G_k is skew, for the slices ``G_k = slices[..., k]``; zero where all of them are."""
    found = skew_partner(slices.movedim(-1, -3))
    return torch.where((slices == 0).flatten(-3).all(-1)[..., None, None], torch.zeros_like(found), found)
