"""The translating lines matrix: lines of space that move sideways, each within a plane, between two poses of a sensor."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from dyntorch.core.invariant import Frame, Invariant
from dyntorch.core.primitives import Line, direction
from dyntorch.core.residual import whiten
from dyntorch.geometry.extensors import common_point, compound, compound_root, join, plucker_form, project, skew_line
from dyntorch.geometry.homogeneous import hyperplanes_through, inhomogeneous
from dyntorch.numerics.nullspace import null_space


class TranslatingLinesMatrix(Invariant):
    r"""Translating lines matrix, :math:`l_2^T F\, l_1 = 0` with :math:`F \sim C_2(A)^T J`, A from view 2 to view 1.

    The line before its motion meets the line after it: both lie in the plane it sweeps.  So do two points of a body that
    translates.  35 lines, if the points of a line may move at different speeds; lines that only translate, each by its own
    vector, leave four more solutions (rank 31, see :meth:`pure_translation_family`) which two static points remove
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
        norm = torch.linalg.matrix_norm(lines, keepdim=True)
        return lines / torch.where(norm > 0, norm, torch.ones_like(norm))

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
    def transfer_points(matrix: Tensor, points: Tensor, source: int = 2) -> Tensor:
        r"""Where a static point of one view lies in the other: the common point of three transferred lines through it.

        Args:
            matrix: ``(*batch, 6, 6)``.
            points: ``(*batch, n, 3)``.
            source: view of the points, 1 or 2.

        Returns:
            ``(*batch, n, 3)`` in the other view.

        Raises:
            ValueError: another view.

        Example:
            >>> import torch
            >>> F = TranslatingLinesMatrix.compose(torch.diag(torch.tensor([2.0, 2.0, 2.0, 1.0])))
            >>> TranslatingLinesMatrix.transfer_points(F, torch.tensor([[1.0, 2.0, 3.0]])).round(decimals=4).tolist()
            [[2.0, 4.0, 6.0]]
        """
        stars = _star(points)
        moved = TranslatingLinesMatrix.transfer(matrix, stars.flatten(-3, -2), source).unflatten(-2, stars.shape[-3:-1])
        return inhomogeneous(common_point(normalize(moved, dim=-1)))

    @staticmethod
    def swept_plane(matrix: Tensor, l1: Tensor, l2: Tensor) -> Tensor:
        r"""The plane in which the line of each match moves, in the frame of view 1: the join of :math:`l_1` and :math:`J F^T l_2`.

        Args:
            matrix: ``(*batch, 6, 6)``.
            l1, l2: matches.

        Returns:
            ``(*batch, n, 4)`` of norm 1 (least squares where the lines do not quite meet); any plane through a line that is
            static.

        Example:
            >>> import torch
            >>> F = TranslatingLinesMatrix.compose(torch.eye(4))
            >>> l1 = torch.tensor([[[0.0, 0.0, 5.0], [1.0, 0.0, 5.0]]])
            >>> plane = TranslatingLinesMatrix.swept_plane(F, l1, l1 + torch.tensor([0.0, 1.0, 0.0]))
            >>> (plane / plane[:, 2:3]).round(decimals=4).abs().tolist()
            [[0.0, 0.0, 1.0, 5.0]]
        """
        first, second = Line().raw(l1), TranslatingLinesMatrix.transfer(matrix, l2)
        # a plane contains a line if it contains the points where that meets the coordinate planes
        points = torch.stack([normalize(first, dim=-1), normalize(second, dim=-1)], dim=-2)
        return null_space(skew_line(points).flatten(-3, -2))[..., 0, :]

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

    @staticmethod
    def pure_translation_family(matrix: Tensor, infinity: Tensor | None = None) -> Tensor:
        r"""All matrices that lines fulfil which only translate, each by its own vector: a space of 5 dimensions.

        In affine coordinates of the world, lines as moment and direction (m, w), translation keeps the direction, hence
        :math:`w_2^T [s]_\times w_1 = 0`, :math:`w_2 \cdot m_1 = 0`, :math:`m_2 \cdot w_1 = 0`: nobody can tell the scale of the
        second view (the ratio of the last two) nor its position (s).

        Args:
            matrix: ``(*batch, 4, 4)`` A, from view 2 to view 1.
            infinity: ``(*batch, 4)`` plane at infinity in view 1, last coordinate not 0; default (0, 0, 0, 1), a metric sensor.

        Returns:
            ``(*batch, 5, 6, 6)`` orthonormal basis, whose span contains ``compose(matrix)``.

        Example:
            >>> import torch
            >>> tuple(TranslatingLinesMatrix.pure_translation_family(torch.eye(4)).shape)
            (5, 6, 6)
        """
        eye = torch.eye(4, dtype=matrix.dtype, device=matrix.device)
        plane = eye[3] if infinity is None else infinity / infinity[..., 3:]
        world = torch.cat([eye[:3].expand(*plane.shape[:-1], 3, 4), plane[..., None, :]], dim=-2)
        right, left = compound(world, 2), compound(world @ matrix, 2)
        family = left.mT[..., None, :, :] @ _translation_forms(matrix) @ right[..., None, :, :]
        basis = torch.linalg.qr(family.flatten(-2).mT)[0].mT
        return basis.unflatten(-1, (6, 6))

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


def _star(points: Tensor) -> Tensor:
    """Three independent unit lines ``(..., 3, 6)`` through each point ``(..., 3)``."""
    p = torch.cat([points, torch.ones_like(points[..., :1])], dim=-1)[..., None, :]
    return join(normalize(p, dim=-1), hyperplanes_through(points))


def _translation_forms(like: Tensor) -> Tensor:
    """``(5, 6, 6)``: skew forms of the directions, and the two products of direction and moment."""
    forms = torch.zeros(5, 6, 6, dtype=like.dtype, device=like.device)
    direction = torch.tensor([2, 4, 5], device=like.device)
    for a, (i, j) in enumerate(((0, 1), (0, 2), (1, 2))):
        forms[a, direction[i], direction[j]], forms[a, direction[j], direction[i]] = 1.0, -1.0
    # w . m' is one half of the form J: 23 with 01, -13 with 02, 12 with 03 and so on
    form = plucker_form(dtype=like.dtype, device=like.device)
    forms[3][direction] = form[direction]
    forms[4][:, direction] = form[:, direction]
    return forms
