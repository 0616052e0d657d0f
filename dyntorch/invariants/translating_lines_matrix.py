"""The translating lines matrix: lines of space that move sideways, each within a plane, between two poses of a sensor."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from dyntorch.core.invariant import Frame, Invariant
from dyntorch.core.normalize import unit_tensors
from dyntorch.core.primitives import Line, direction
from dyntorch.core.residual import whiten
from dyntorch.geometry.extensors import compound, compound_root, plucker_form, project


class TranslatingLinesMatrix(Invariant):
    r"""Translating lines matrix, :math:`l_2^T F\, l_1 = 0` with :math:`F \sim C_2(A)^T J`, A from view 2 to view 1.

    The line before its motion meets the line after it: both lie in the plane it sweeps.  So do two points of a body that
    translates.  35 lines, if the points of a line may move at different speeds; lines that only translate, each by its own
    vector, leave four more solutions (rank 31) which two static points remove
    (:meth:`static_point_lines`).  Two rigid translating bodies give rank 28, three or more 31.

    A line is two of its points ``(*batch, n, 2, 3)``, not the same ones in the two views, or Pluecker coordinates
    ``(*batch, n, 6)``.

    Source: thesis section 8.4 (which omits the scales and signs of the rows of A, and counts two bodies as sufficient).

    Example:
        >>> from dyntorch.scenes import translating_lines
        >>> scene = translating_lines(35)
        >>> F = TranslatingLinesMatrix.compose(*scene.motion)
        >>> bool((TranslatingLinesMatrix.decompose(F) - scene.motion[0]).abs().max() < 1e-9)
        True
    """

    primitives = (Line(), Line())
    nullity = 1
    motion = (Frame(0, 1),)
    dof = 15
    codim = 1
    resolves_noise = False
    layout = (1, 0)
    labels_static = True

    @staticmethod
    def compose(matrix: Tensor) -> Tensor:
        r"""The matrix :math:`F \sim C_2(A)^T J` of a collineation.

        Args:
            matrix: ``(*batch, 4, 4)`` A, from view 2 to view 1, of any scale and sign.

        Returns:
            ``(*batch, 6, 6)`` of norm 1; the first axis takes lines of view 2.
        """
        lines = compound(matrix, 2).mT @ plucker_form(dtype=matrix.dtype, device=matrix.device)
        return unit_tensors(lines, 2)

    @staticmethod
    def decompose(matrix: Tensor) -> Tensor:
        r"""The collineation of a matrix, :math:`C_2(A) \sim J F^T`; see :func:`~dyntorch.geometry.extensors.compound_root`.

        Args:
            matrix: ``(*batch, 6, 6)`` of any scale and sign.

        Returns:
            ``(*batch, 4, 4)`` A of norm 1 and canonical sign; 0 for a matrix that is 0 or not finite.
        """
        if matrix.ndim < 2 or matrix.shape[-2:] != (6, 6):
            raise ValueError(f"matrix must be (*batch, 6, 6), got {tuple(matrix.shape)}")
        return compound_root(plucker_form(dtype=matrix.dtype, device=matrix.device) @ matrix.mT)

    @staticmethod
    def transfer(matrix: Tensor, lines: Tensor, source: int = 2) -> Tensor:
        r"""Where a line of one view lies in the other if it does not move: :math:`l_1 \sim J F^T l_2`, :math:`l_2 \sim J F\, l_1`.

        A line that moves meets it there.

        Args:
            matrix: ``(*batch, 6, 6)``.
            lines: ``(*batch, n, 2, 3)`` or ``(*batch, n, 6)``.
            source: view of the lines, 1 or 2.

        Returns:
            ``(*batch, n, 6)`` Pluecker coordinates in the other view, of any scale.

        Raises:
            ValueError: another view.

        Example:
            >>> import torch
            >>> F = TranslatingLinesMatrix.compose(torch.eye(4))
            >>> TranslatingLinesMatrix.transfer(F, torch.tensor([[1.0, 0.0, 0.0, 0.0, 0.0, 0.0]])).sign().tolist()
            [[1.0, 0.0, 0.0, 0.0, 0.0, 0.0]]
        """
        if source not in (1, 2):
            raise ValueError(f"source must be view 1 or 2, got {source!r}")
        form = plucker_form(dtype=matrix.dtype, device=matrix.device)
        return Line().raw(lines) @ (matrix if source == 2 else matrix.mT) @ form

    @staticmethod
    def static_point_lines(x1: Tensor, x2: Tensor, *, length: float = 1.0) -> tuple[Tensor, Tensor]:
        """Static points as matches of lines: every line through the point in view 1 meets every line through it in view 2.

        Args:
            x1: ``(*batch, n, 3)`` static points in view 1.
            x2: ``(*batch, n, 3)`` in view 2.
            length: distance of the two points by which a line is given, in the unit of the points; about the size of the scene.

        Returns:
            Lines ``(*batch, 9 n, 2, 3)`` of both views: the point and one at this distance along a coordinate axis, three lines
            of view 1 with three of view 2.  To be joined with the matches of moving lines.

        Raises:
            ValueError: shapes that differ.

        Example:
            >>> import torch
            >>> l1, l2 = TranslatingLinesMatrix.static_point_lines(torch.zeros(2, 3), torch.ones(2, 3))
            >>> tuple(l1.shape)
            (18, 2, 3)
        """
        if x1.shape != x2.shape or x1.ndim < 2 or x1.shape[-1] != 3:
            raise ValueError(f"x1 and x2 must be (*batch, n, 3) and alike, got {tuple(x1.shape)} and {tuple(x2.shape)}")
        steps = length * torch.eye(3, dtype=x1.dtype, device=x1.device)
        first, second = (torch.stack([x[..., None, :].expand(*x.shape[:-1], 3, 3), x[..., None, :] + steps], -2) for x in (x1, x2))
        return (
            first[..., :, :, None, :, :].expand(*first.shape[:-2], 3, 2, 3).flatten(-5, -3),
            second[..., :, None, :, :, :].expand(*first.shape[:-3], 3, 3, 2, 3).flatten(-5, -3),
        )

    def whitened_static_residual(self, motion: tuple[Tensor, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...]) -> Tensor:
        """Residual of lines that do not move: both points of view 2, mapped to view 1, lie on the line there, whitened.

        Returns:
            ``(*batch, n, 4)``: for each of the two points its two coordinates across the line.
        """
        first, second = (_ends(x) for x in views)
        start, along = first[..., 0, :], first[..., 1, :] - first[..., 0, :]
        across = _across(along)
        mapped, jacobian = project(motion[0], second.flatten(-3, -2))
        mapped, jacobian = mapped.unflatten(-2, second.shape[-3:-1]), jacobian.unflatten(-3, second.shape[-3:-1])
        gap = mapped - start[..., None, :]
        square = along.square().sum(-1, keepdim=True)
        place = (gap @ along[..., None])[..., 0] / torch.where(square > 0, square, torch.ones_like(square))
        # the two points of view 1 carry a point of the line at place t with the weights 1 - t and t
        share = torch.stack([1 - place, place], dim=-1)
        common = share @ share.mT * scales[0][..., None, None, None].square()
        turned = across[..., None, :, :] @ jacobian * scales[1][..., None, None, None, None]
        own = turned @ turned.mT
        eye = torch.eye(2, dtype=own.dtype, device=own.device)
        blocks = [[common[..., i, j, None, None] * eye + (own[..., i, :, :] if i == j else 0.0) for j in (0, 1)] for i in (0, 1)]
        covariance = torch.cat([torch.cat(row, dim=-1) for row in blocks], dim=-2)
        return whiten((gap @ across.mT).flatten(-2), covariance)


def _ends(x: Tensor) -> Tensor:
    """Two points ``(*batch, n, 2, 3)`` of each line; of Pluecker coordinates the foot of the origin and one at distance 1."""
    if x.ndim >= 3 and tuple(x.shape[-2:]) == (2, 3):
        return x
    foot = Line().points(x)
    return torch.cat([foot, foot + normalize(direction(x)[..., None, :], dim=-1)], dim=-2)


def _across(direction: Tensor) -> Tensor:
    """Two orthonormal vectors ``(..., 2, 3)`` across each direction: the reflection that takes it to the third axis."""
    unit_direction = normalize(direction, dim=-1)
    eye = torch.eye(3, dtype=direction.dtype, device=direction.device)
    w = torch.where(unit_direction[..., 2:] < 0, -unit_direction, unit_direction) + eye[2]
    return (eye - w[..., :, None] * w[..., None, :] / w[..., 2, None, None])[..., :2, :]
