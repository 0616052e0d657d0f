"""Minimal join tensors: the third sensor is seen through given cameras, so that 47 matches suffice instead of 60."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from dyntorch.core.invariant import Invariant, on_class
from dyntorch.core.normalize import unit_tensors
from dyntorch.core.primitives import Point, Primitive, Projected
from dyntorch.geometry.extensors import meet
from dyntorch.invariants.agreement import join_forms, motion_of_forms
from dyntorch.invariants.join_tensor import CollinearPoints, check_motion

SAME_CENTRE = 1e-6  # sine of the angle between homogeneous centres; below, single precision cannot tell the cameras apart


@dataclass(frozen=True, eq=False, repr=False)
class MinimalJoinTensor(CollinearPoints):
    r"""Points of space on straight lines, where view 3 is looked at through given cameras: :math:`N(P, P', M P'') = 0`.

    For a camera M (3 x 4, any) with centre C and :math:`W = M B^{-1}`, the points W P, W A P', M P'' of its image are
    collinear, which makes the tensor

    .. math:: N_{ijk} = \epsilon_{lmk}\, W_{li}\, (W A)_{mj}

    the null vector of 47 matches or more (rank 47 of 48).  **One camera does not determine the motion**: A may be replaced
    by :math:`(\lambda I + B C v^T) A`.  Two cameras with different centres do, and the same 47 matches serve all of them;
    the tensor therefore has one part per camera.

    Attributes:
        cameras: ``(c, 3, 4)`` in the coordinates of view 3; by default the four that drop one homogeneous coordinate each
            (measured, 60 matches: .0105 of error against .0138 with two of them, and .0634 of the join tensor).

    Raises:
        ValueError: cameras of another shape, of rank below 3, or all with the same centre.

    Source: thesis section 8.2 (minimal join tensors); there, one camera is said to suffice, but see above.

    Example:
        >>> A, B = torch.randn(2, 4, 4, dtype=torch.float64)
        >>> tensor = MinimalJoinTensor.compose(A, B)
        >>> tensor.shape, MinimalJoinTensor.minimal(), [part.shape for part in MinimalJoinTensor.decompose(tensor)]
        (torch.Size([4, 4, 4, 3]), 47, [torch.Size([4, 4]), torch.Size([4, 4])])
    """

    cameras: Tensor | None = None
    primitives: tuple[Primitive, ...] = field(init=False)

    def __post_init__(self) -> None:
        cameras = _dropping() if self.cameras is None else self.cameras
        if cameras.ndim < 3 or cameras.shape[-2:] != (3, 4) or cameras.shape[-3] == 0:
            raise ValueError(f"cameras must be (c, 3, 4) with one camera or more, got {tuple(cameras.shape)}")
        if self.cameras is not None and cameras.ndim == 3:
            _check_cameras(cameras)
        object.__setattr__(self, "primitives", (Point(3), Point(3), Projected(cameras)))

    def normalize(self, transforms: tuple[Tensor, ...]) -> Invariant:
        """The invariant of normalized matches, whose cameras have orthonormal rows.

        Args:
            transforms: ``(*batch, 1, 4, 4)`` similarity of each view, with a dimension for the cameras.
        """
        third = self.primitives[2].normalize(transforms[2])
        assert isinstance(third, Projected)
        return MinimalJoinTensor(third.cameras)

    @on_class
    def compose(self, A: Tensor, B: Tensor) -> Tensor:
        r"""The tensor of every camera, :math:`N_{ijk} = \epsilon_{lmk} W_{li} (W A)_{mj}`, :math:`W = M B^{-1}`.

        Computed as :math:`\det[P, A P', B M^+ p, B C]`, which is the same up to scale and needs no inverse of B.

        Args:
            A: ``(*batch, 4, 4)`` from view 2 to view 1, of any scale.
            B: ``(*batch, 4, 4)`` from view 3 to view 1, of any scale.

        Returns:
            ``(*batch, c, 4, 4, 3)``, each of norm 1.

        Raises:
            ValueError: matrices that are not 4 x 4.

        Source: thesis equation 8.3.

        Example:
            >>> eye = torch.eye(4, dtype=torch.float64)
            >>> MinimalJoinTensor.compose(eye, eye).flatten(1).norm(dim=-1).round(decimals=9).tolist()
            [1.0, 1.0, 1.0, 1.0]
        """
        check_motion(A, B)
        m = self._cameras(A)
        right = torch.linalg.solve_ex(m @ m.mT, m)[0].mT
        centre = meet(*m.unbind(-2))
        b = B[..., None, :, :]
        return unit_tensors(join_forms(A[..., None, :, :], b @ right, (b @ centre[..., None])[..., 0]), 3)

    @on_class
    def decompose(self, tensor: Tensor) -> tuple[Tensor, Tensor]:
        r"""The motion, from the tensors of two cameras or more.

        With the camera put back, :math:`N_c(P, P', M_c P'') = \det[P, A P', B P'', B C_c]` is a join tensor, and the skew
        systems of :meth:`JoinTensor.decompose` hold for its slices.

        Args:
            tensor: ``(*batch, c, 4, 4, 3)``.

        Returns:
            (A, B), each ``(*batch, 4, 4)``, Frobenius norm 1, canonical sign.

        Raises:
            ValueError: a single camera (its tensor leaves eight degrees of freedom of the motion open), or another shape.

        Source: thesis section 8.2.

        Example:
            >>> A = torch.diag(torch.tensor([1.0, 2.0, 2.0, 4.0], dtype=torch.float64)) / 5
            >>> found, _ = MinimalJoinTensor.decompose(MinimalJoinTensor.compose(A, torch.eye(4, dtype=torch.float64)))
            >>> bool(torch.allclose(found, A))
            True
        """
        return motion_of_forms(self._several(tensor))

    def forms(self, tensor: Tensor) -> Tensor:
        """The tensors with the cameras put back, ``(*batch, c, 4, 4, 4)``, each of norm 1."""
        if tensor.shape[-4:] != (self.copies, 4, 4, 3):
            raise ValueError(f"tensor must be (*batch, {self.copies}, 4, 4, 3), one part per camera, got {tuple(tensor.shape)}")
        return unit_tensors(tensor @ self._cameras(tensor)[..., None, :, :], 3)

    def _cameras(self, like: Tensor) -> Tensor:
        third = self.primitives[2]
        assert isinstance(third, Projected)
        return third.cameras.to(like)

    def __repr__(self) -> str:
        return "MinimalJoinTensor" if self.cameras is None else f"MinimalJoinTensor({self.copies} cameras)"


def _dropping() -> Tensor:
    """The four cameras that drop one homogeneous coordinate each."""
    return torch.stack([torch.eye(4, dtype=torch.float64)[[i for i in range(4) if i != c]] for c in range(4)])


def _check_cameras(cameras: Tensor) -> None:
    cameras = cameras.detach().to("cpu", torch.float64)
    cameras = cameras / cameras.norm(dim=-1, keepdim=True)
    centres = meet(*cameras.unbind(-2))
    flat = (~(centres.norm(dim=-1) > torch.finfo(torch.float32).eps)).nonzero().flatten().tolist()
    if flat:
        raise ValueError(f"cameras must be of rank 3; camera {flat[0]} is not: give three independent rows")
    if len(centres) > 1 and torch.linalg.svdvals(centres / centres.norm(dim=-1, keepdim=True))[1] < SAME_CENTRE:
        raise ValueError("all cameras have the same centre and say the same; give at least two cameras with different centres")
