"""The dual homography tensor: lines of three views that meet in a static point of a plane, or static points themselves."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.core.invariant import Frame, Invariant
from dyntorch.core.normalize import unit_tensors
from dyntorch.core.primitives import Hyperplane, HyperplanesThrough, Primitive
from dyntorch.geometry.extensors import join, plucker_form
from dyntorch.geometry.homogeneous import cofactors, inhomogeneous, unit
from dyntorch.invariants.agreement import (
    static_map,
    static_map_derivative,
    static_residual,
    third_vector,
    unit_normal,
    whitened_agreement,
)
from dyntorch.invariants.homography_tensor import HomographyTensor


@dataclass(frozen=True)
class DualHomographyTensor(Invariant):
    r"""Three lines, one per view, through a static point of a plane: :math:`H^{ijk} s_i r_j q_k = \det[s, A^{-T} r, B^{-T} q] = 0`.

    It is the homography tensor of the lines, :math:`\epsilon(A^{-T}, B^{-T})`.  Also the quadrifocal tensor of four views
    contracted with a line of the fourth, for the plane of that line (:meth:`from_quadrifocal`).

    Attributes:
        measure: ``"lines"``, one line ``(*batch, n, 3)`` per view and match, 26 of them; or ``"points"``, static points
            ``(*batch, n, 2)`` of which every line through them is taken: 8 rows each, of which four points give rank 26.

    Raises:
        ValueError: another ``measure``.

    Source: thesis chapter 2 (upper indices); Shashua and Wolf, ECCV 2000.

    Example:
        >>> DualHomographyTensor.minimal(), DualHomographyTensor("points").minimal()
        (26, 4)
    """

    measure: str = "lines"

    def __post_init__(self) -> None:
        if self.measure not in ("lines", "points"):
            raise ValueError(f"measure must be 'lines' or 'points', got {self.measure!r}")

    @property
    def primitives(self) -> tuple[Primitive, ...]:  # type: ignore[override]
        return ((Hyperplane(2) if self.measure == "lines" else HyperplanesThrough(2)),) * 3

    @property
    def codim(self) -> int:  # type: ignore[override]
        return 1 if self.measure == "lines" else 4

    @property
    def labels_static(self) -> bool:  # type: ignore[override]
        return self.measure == "lines"

    motion = (Frame(0, 1), Frame(0, 2))
    dof = 16

    @staticmethod
    def compose(A: Tensor, B: Tensor) -> Tensor:
        r"""The tensor of two homographies of points: :math:`H^{ijk} = \epsilon_{iuv} (A^{-T})_{uj} (B^{-T})_{vk}`.

        Args:
            A: ``(*batch, 3, 3)``, points of view 2 to view 1.
            B: ``(*batch, 3, 3)``, points of view 3 to view 1.

        Returns:
            ``(*batch, 3, 3, 3)``, norm 1.

        Example:
            >>> import torch
            >>> A = torch.diag(torch.tensor([1.0, 2.0, 2.0]))
            >>> H, dual = HomographyTensor.compose(A.inverse(), A), DualHomographyTensor.compose(A, A.inverse())
            >>> bool(torch.allclose(H, dual))
            True
        """
        return HomographyTensor.compose(cofactors(A), cofactors(B))

    @staticmethod
    def decompose(tensor: Tensor) -> tuple[Tensor, Tensor]:
        r"""The two homographies of points: those of the lines, inverted and transposed.

        Args:
            tensor: ``(*batch, 3, 3, 3)`` of any scale.

        Returns:
            A and B ``(*batch, 3, 3)``, norm 1, determinant not negative; zero for a zero tensor.

        Raises:
            ValueError: another shape.

        Source: thesis section 8.1 (i), dual.

        Example:
            >>> import torch
            >>> A = torch.diag(torch.tensor([1.0, 2.0, 2.0], dtype=torch.float64))
            >>> found, _ = DualHomographyTensor.decompose(DualHomographyTensor.compose(A, A))
            >>> bool(torch.allclose(found, A / 3))
            True
        """
        a, b = HomographyTensor.decompose(tensor.double())
        return unit(cofactors(a)).to(tensor.dtype), unit(cofactors(b)).to(tensor.dtype)

    @staticmethod
    def from_quadrifocal(quadrifocal: Tensor, line: Tensor) -> Tensor:
        r"""The tensor of the plane :math:`P_4^T t` that a line t of the fourth view spans: :math:`H^{ijk} = Q^{ijkl} t_l`.

        Args:
            quadrifocal: ``(*batch, 3, 3, 3, 3)``, see :func:`quadrifocal`.
            line: ``(*batch, 3)`` in view 4.

        Returns:
            ``(*batch, 3, 3, 3)``, norm 1.

        Raises:
            ValueError: shapes that do not fit.

        Source: thesis chapter 2; Shashua and Wolf, CVPR 2000 (quadrifocal tensor).

        Example:
            >>> import torch
            >>> P = torch.rand(4, 3, 4, generator=torch.Generator().manual_seed(0))
            >>> DualHomographyTensor.from_quadrifocal(quadrifocal(*P), torch.tensor([1.0, 2.0, 3.0])).shape
            torch.Size([3, 3, 3])
        """
        if quadrifocal.shape[-4:] != (3, 3, 3, 3) or line.shape[-1:] != (3,):
            got = f"{tuple(quadrifocal.shape)} and {tuple(line.shape)}"
            raise ValueError(f"quadrifocal must be (*batch, 3, 3, 3, 3) and line (*batch, 3), got {got}")
        tensor = torch.einsum("...ijkl,...l->...ijk", quadrifocal, line)
        return unit_tensors(tensor, 3)

    @staticmethod
    def transfer(tensor: Tensor, lines: Tensor, source: int = 2, target: int = 1) -> Tensor:
        r"""Where static lines of the plane, seen in one view, are in another, without A and B.

        Args:
            tensor: ``(*batch, 3, 3, 3)``.
            lines: ``(*batch, n, 3)`` of view ``source``, any scale.
            source: 1, 2 or 3.
            target: 1, 2 or 3, another view.

        Returns:
            ``(*batch, n, 3)`` lines of view ``target`` with unit normals.

        Raises:
            ValueError: views that are not two different ones of 1, 2, 3.

        Source: thesis section 8.1 (ii), dual.

        Example:
            >>> import torch
            >>> A = torch.tensor([[1.0, 0.0, 5.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
            >>> H = DualHomographyTensor.compose(A, torch.eye(3))
            >>> line = DualHomographyTensor.transfer(H, torch.tensor([[1.0, 0.0, 0.0]]))  # x = 0 goes to x = 5
            >>> (line / line[:, :1])[0, 2].round(decimals=4)
            tensor(-5.)
        """
        return unit_normal(static_map(tensor, lines, source, target)).to(lines.dtype)

    @staticmethod
    def concurrency(tensor: Tensor, lines_a: Tensor, lines_b: Tensor, view: int = 1) -> Tensor:
        r"""Where the static point of a match is in one view, from its lines in the two others: in view 1
        :math:`p^i = H^{ijk} r_j q_k = A^{-T} r \times B^{-T} q`.

        Args:
            tensor: ``(*batch, 3, 3, 3)``.
            lines_a: ``(*batch, n, 3)`` lines in the first of the two other views.
            lines_b: ``(*batch, n, 3)`` lines in the second of them.
            view: 1, 2 or 3.

        Returns:
            ``(*batch, n, 2)`` points; 0 where both lines are the same line of the plane.

        Raises:
            ValueError: view is not 1, 2 or 3.

        Source: thesis section 8.1 (ii), dual.

        Example:
            >>> import torch
            >>> H = DualHomographyTensor.compose(torch.eye(3), torch.eye(3))
            >>> lines = torch.tensor([[1.0, 0.0, -3.0]]), torch.tensor([[0.0, 1.0, -2.0]])
            >>> DualHomographyTensor.concurrency(H, *lines).tolist()
            [[3.0, 2.0]]
        """
        return inhomogeneous(third_vector(tensor, lines_a, lines_b, view)).to(lines_a.dtype)

    @staticmethod
    def static_distance(tensor: Tensor, lines1: Tensor, lines2: Tensor, lines3: Tensor) -> Tensor:
        r"""How far each match is from being one and the same static line in all views, without A and B.

        Args:
            tensor: ``(*batch, 3, 3, 3)``.
            lines1: ``(*batch, n, 3)``; lines2, lines3 likewise.

        Returns:
            ``(*batch, n)``: with noise of standard deviation s in the angle and in the offset of each line, the square over
            :math:`s^2` of a static line follows :math:`\chi^2_4`.

        Source: thesis section 8.1 (iii), dual.

        Example:
            >>> import torch
            >>> H, line = DualHomographyTensor.compose(torch.eye(3), torch.eye(3)), torch.tensor([[0.6, 0.8, 2.0]])
            >>> bool(DualHomographyTensor.static_distance(H, line, -line, line) < 1e-6)
            True
        """
        parts = []
        for source, line in ((2, lines2.double()), (3, lines3.double())):
            image, derivative = static_map_derivative(tensor, unit_normal(line), source, 1)
            parts.append(_line_error(image, derivative, line, lines1.double()))
        one = torch.ones((), dtype=torch.float64, device=lines1.device)
        return whitened_agreement(parts, (one,) * 3).norm(dim=-1).to(lines1.dtype)

    def whitened_residual(self, motion: tuple[Tensor, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...]) -> Tensor | None:
        """Static points: their disagreement in view 1, ``(*batch, n, 4)``.  Lines: that of the form itself."""
        return static_residual(motion, views, scales) if self.measure == "points" else None

    def whitened_static_residual(self, motion: tuple[Tensor, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...]) -> Tensor:
        r"""Disagreement of a static line with its images :math:`A^{-T} l_2` and :math:`B^{-T} l_3` in angle and offset,
        whitened; ``(*batch, n, 4)``."""
        if self.measure == "points":
            return static_residual(motion, views, scales)
        first, *others = views
        parts = []
        for matrix, line in zip(motion, others, strict=True):
            to_first = cofactors(matrix)
            parts.append(_line_error(unit_normal(line) @ to_first.mT, to_first[..., None, :, :], line, first))
        return whitened_agreement(parts, scales)


def quadrifocal(P1: Tensor, P2: Tensor, P3: Tensor, P4: Tensor) -> Tensor:
    r"""The quadrifocal tensor of four cameras: :math:`Q^{ijkl}` is the determinant of row i of P1, j of P2, k of P3 and l of
    P4. P1 ``(*batch, 3, 4)`` -> ``(*batch, 3, 3, 3, 3)``."""
    for P in (P1, P2, P3, P4):
        if P.shape[-2:] != (3, 4):
            raise ValueError(f"cameras must be (*batch, 3, 4), got {tuple(P.shape)}")
    first = join(P1[..., :, None, :], P2[..., None, :, :])
    second = join(P3[..., :, None, :], P4[..., None, :, :])
    form = plucker_form(dtype=P1.dtype, device=P1.device)
    return torch.einsum("...ija,ab,...klb->...ijkl", first, form, second)


def _line_error(image: Tensor, derivative: Tensor, source: Tensor, line: Tensor) -> tuple[Tensor, Tensor]:
    """Angle and offset of image lines against measured ones, and their derivative by the angle and the offset of the source.
    image ``(*batch, n, 3)``, derivative ``(*batch, n, 3, 3)``, source ``(*batch, n, 3)``, line ``(*batch, n, 3)`` ->
    ``(*batch, n, 2)``."""
    reference, start = unit_normal(line), unit_normal(source)
    # the line at infinity has no normal: a short one stands in for it
    floor = torch.finfo(image.dtype).eps * image.detach().abs().amax(dim=-1, keepdim=True)
    length = torch.maximum(torch.linalg.vector_norm(image[..., :2], dim=-1, keepdim=True), floor)
    length = torch.where(length > 0, length, torch.ones_like(length))
    unit_line = image / length
    across = reference[..., 0] * unit_line[..., 1] - reference[..., 1] * unit_line[..., 0]
    along = (reference[..., :2] * unit_line[..., :2]).sum(-1)
    # lines have no orientation
    sign = torch.where(along < 0, -1.0, 1.0).to(image.dtype)
    # some versions of torch differentiate atan2(0, 0) to NaN
    nearby = torch.where((across == 0) & (along == 0), torch.ones_like(along), along.abs())
    error = torch.stack([torch.atan2(sign * across, nearby), sign * unit_line[..., 2] - reference[..., 2]], dim=-1)
    columns = []
    for tangent in (_rotate_normal(start), start.new_tensor([0.0, 0.0, 1.0]).expand_as(start)):
        change = (derivative @ tangent[..., None])[..., 0]
        change = (change - unit_line * (unit_line[..., :2] * change[..., :2]).sum(-1, keepdim=True)) / length
        columns.append(torch.stack([(_rotate_normal(unit_line) * change).sum(-1), sign * change[..., 2]], dim=-1))
    return error, torch.stack(columns, dim=-1)


def _rotate_normal(line: Tensor) -> Tensor:
    """The normal turned by a right angle, with offset 0: the derivative of the line by its angle."""
    return torch.stack([-line[..., 1], line[..., 0], torch.zeros_like(line[..., 0])], dim=-1)
