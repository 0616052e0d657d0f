"""Join tensors: points of space that move on straight lines, measured by 3D sensors in three poses."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.core.invariant import Frame, Invariant, on_class
from dyntorch.core.normalize import unit_tensors
from dyntorch.core.primitives import Point
from dyntorch.geometry.extensors import join
from dyntorch.geometry.homogeneous import homogeneous, inhomogeneous
from dyntorch.invariants.agreement import collinearity, join_forms, motion_of_forms, static_residual
from dyntorch.numerics.nullspace import null_space

LETTERS = "ijk"  # indices of the three views


class CollinearPoints(Invariant):
    """Points of space that move on straight lines, in three poses: what the join tensors have in common."""

    motion = (Frame(0, 1), Frame(0, 2))
    dof = 30
    codim = 2
    labels_static = True

    def forms(self, tensor: Tensor) -> Tensor:
        """Forms ``(*batch, c, 4, 4, 4)`` on the points of the three views."""
        raise NotImplementedError

    def whitened_residual(self, motion: tuple[Tensor, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...]) -> Tensor:
        """Distance from one straight line, ``(*batch, n, 3)``, two degrees of freedom; see :func:`collinearity`."""
        return collinearity(motion, views, scales)

    def whitened_static_residual(self, motion: tuple[Tensor, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...]) -> Tensor:
        """Disagreement of the three views of a static point, ``(*batch, n, 6)``, six degrees of freedom."""
        return static_residual(motion, views, scales)

    @on_class
    def transfer(self, tensor: Tensor, x: Tensor, source: int, target: int) -> Tensor:
        r"""Map static points from one view to another without A and B. x ``(*batch, n, 3)`` -> ``(*batch, n, 3)``."""
        if source == target or {source, target} - {1, 2, 3}:
            raise ValueError(f"source and target must be two different views of 1, 2, 3, got {source} and {target}")
        forms = self._several(tensor)
        given, wanted = LETTERS[source - 1], LETTERS[target - 1]
        free = (set(LETTERS) - {given, wanted}).pop()
        matrix = torch.einsum(f"...cijk,...n{given}->...nc{free}{wanted}", forms, homogeneous(x))
        return inhomogeneous(null_space(matrix.flatten(-3, -2))[..., 0, :])

    @on_class
    def trajectory_planes(self, tensor: Tensor, x_a: Tensor, x_b: Tensor, view: int = 1) -> Tensor:
        r"""Planes through the trajectory of each point, in the frame of one view, from the other two:
        :math:`J_c(\cdot, P', P'')`. x_a ``(*batch, n, 3)``, x_b ``(*batch, n, 3)`` -> ``(*batch, n, c, 4)``."""
        if view not in (1, 2, 3):
            raise ValueError(f"view must be 1, 2 or 3, got {view}")
        wanted = LETTERS[view - 1]
        a, b = (letter for letter in LETTERS if letter != wanted)
        terms = f"...cijk,...n{a},...n{b}->...nc{wanted}"
        return torch.einsum(terms, self.forms(tensor), homogeneous(x_a), homogeneous(x_b))

    @on_class
    def trajectory(self, tensor: Tensor, x_a: Tensor, x_b: Tensor, view: int = 1) -> Tensor:
        r"""The line each point moves on, in the frame of one view, from its positions in the other two. x_a ``(*batch, n, 3)``,
        x_b ``(*batch, n, 3)`` -> ``(*batch, n, 6)``."""
        self._several(tensor)
        planes = self.trajectory_planes(tensor, x_a, x_b, view)
        first, second = null_space(planes, 2).unbind(-2)
        return torch.nn.functional.normalize(join(first, second), dim=-1)

    @on_class
    def static_distance(self, tensor: Tensor, x1: Tensor, x2: Tensor, x3: Tensor) -> Tensor:
        r"""How far each match is from a static point: :math:`\sqrt{e^T Q^{-1} e}` of the disagreement e of its views. x1
        ``(*batch, n, 3)``, x2 ``(*batch, n, 3)``, x3 ``(*batch, n, 3)`` -> ``(*batch, n)``."""
        motion = motion_of_forms(self._several(tensor))
        one = torch.ones((), dtype=x1.dtype, device=x1.device)
        return self.whitened_static_residual(motion, (x1, x2, x3), (one, one, one)).norm(dim=-1)

    def _several(self, tensor: Tensor) -> Tensor:
        """The forms, unless there is only one."""
        forms = self.forms(tensor)
        if forms.shape[-4] < 2:
            raise ValueError(
                f"{self!r} has one camera: its tensor leaves 4 degrees of freedom of A and 4 of B open (A may be replaced by "
                "(t I + B C v^T) A, C the centre); give at least two cameras with different centres"
            )
        return forms


class JoinTensor(CollinearPoints):
    r"""The family :math:`J^V(P, P', P'') = \det[P, A P', B P'', V]`, one tensor for every V, of 60 matches or more.

    A point of space moves on a straight line while a 3D sensor takes it in three poses; A carries view 2 and B view 3 into
    the frame of view 1, as collineations.  Then P, A P', B P'' are collinear, so that all the determinants vanish:

    .. math:: J^V_{ijk} = \epsilon_{ilmu} A_{lj} B_{mk} V_u

    is a family of dimension 4, the null space of the matrix of rows :math:`P \otimes P' \otimes P''` (rank 60 of 64).  At
    least 10 trajectory lines are needed, with no more than 8 matches each, and of the 60 matches at least 40 must move.

    Source: thesis section 8.2.

    Example:
        >>> A, B = torch.randn(2, 4, 4, dtype=torch.float64)
        >>> tensor = JoinTensor.compose(A, B)
        >>> tensor.shape, JoinTensor.minimal(), [part.shape for part in JoinTensor.decompose(tensor)]
        (torch.Size([4, 4, 4, 4]), 60, [torch.Size([4, 4]), torch.Size([4, 4])])
    """

    primitives = (Point(3), Point(3), Point(3))
    nullity = 4

    @staticmethod
    def compose(A: Tensor, B: Tensor) -> Tensor:
        r"""An orthonormal basis of the family :math:`\epsilon_{ilmu} A_{lj} B_{mk} V_u`.

        Args:
            A: ``(*batch, 4, 4)`` from view 2 to view 1, of any scale.
            B: ``(*batch, 4, 4)`` from view 3 to view 1, of any scale.

        Returns:
            ``(*batch, 4, 4, 4, 4)``: four tensors.

        Raises:
            ValueError: matrices that are not 4 x 4.

        Example:
            >>> basis = JoinTensor.compose(torch.eye(4), torch.eye(4)).flatten(1)
            >>> bool(torch.allclose(basis @ basis.mT, torch.eye(4), atol=1e-6))
            True
        """
        check_motion(A, B)
        eye = torch.eye(4, dtype=A.dtype, device=A.device)
        return unit_tensors(join_forms(A[..., None, :, :], B[..., None, :, :], eye), 3, nullity=4)

    @staticmethod
    def decompose(tensor: Tensor) -> tuple[Tensor, Tensor]:
        r"""The motion of the family: :math:`A^T S + S^T A = 0` for all slices :math:`S = J_a(\cdot, \cdot, e_k)`, and so B.

        Args:
            tensor: ``(*batch, 4, 4, 4, 4)`` any basis of the family.

        Returns:
            (A, B), each ``(*batch, 4, 4)``, Frobenius norm 1, canonical sign.

        Raises:
            ValueError: another shape.

        Source: thesis section 8.2; the solution is unique because the lines :math:`b_k \vee V` span all lines of space.

        Example:
            >>> A = torch.diag(torch.tensor([1.0, 2.0, 2.0, 4.0], dtype=torch.float64)) / 5
            >>> B = torch.ones(4, 4, dtype=torch.float64) - 3 * torch.eye(4, dtype=torch.float64)
            >>> found, _ = JoinTensor.decompose(JoinTensor.compose(A, B))
            >>> bool(torch.allclose(found, A))
            True
        """
        if tensor.shape[-4:] != (4, 4, 4, 4):
            raise ValueError(f"tensor must be (*batch, 4, 4, 4, 4), the four tensors of a fit, got {tuple(tensor.shape)}")
        return motion_of_forms(tensor)

    def forms(self, tensor: Tensor) -> Tensor:
        """The tensor itself: each of its four parts is a form."""
        return tensor


def check_motion(A: Tensor, B: Tensor) -> None:
    """Refuse what is not a pair of collineations of space."""
    if A.shape[-2:] != (4, 4) or B.shape[-2:] != (4, 4):
        raise ValueError(f"A and B must be (*batch, 4, 4), got {tuple(A.shape)} and {tuple(B.shape)}")
