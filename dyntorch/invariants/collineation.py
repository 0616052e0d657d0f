"""The collineation between two views of static points: homography of a plane (n = 2), change of sensor frame in space (n = 3)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.core.invariant import Constraint, Frame, Invariant
from dyntorch.core.normalize import unit_tensors
from dyntorch.core.primitives import HyperplanesThrough, Point, Primitive
from dyntorch.geometry.homogeneous import apply, unit
from dyntorch.invariants.agreement import static_residual
from dyntorch.numerics.least_squares import normalized_derivative

SINGULAR = 1e-12
"""Determinant of a matrix of norm 1, in normalized coordinates, below which it maps space onto a part of it, to rounding."""


@dataclass(frozen=True)
class Collineation(Invariant):
    r"""Static points in two views of P^n: :math:`p_1 \sim A\, p_2`, that is :math:`h^T A\, p_2 = 0` for every hyperplane h
    through :math:`p_1` (n rows per match).

    A maps view 2 to view 1.  ``kornia.geometry.find_homography_dlt(points1, points2)`` and ``cv2.findHomography(points1,
    points2)`` map their first argument to their second: the same matrix is ``dyn.fit(dyn.Collineation(2), points2, points1)``.

    Attributes:
        n: dimension of the space.

    Raises:
        ValueError: n < 1.

    Source: Hartley and Zisserman, section 4.1 (DLT); thesis chapter 8 (opening).

    Example:
        >>> Collineation(3).minimal(), Collineation.minimal()
        (5, 4)
    """

    n: int = 2

    def __post_init__(self) -> None:
        if self.n < 1:
            raise ValueError(f"n is the dimension of the space, 1 or more, got {self.n}")

    @property
    def primitives(self) -> tuple[Primitive, ...]:  # type: ignore[override]
        return (HyperplanesThrough(self.n), Point(self.n))

    motion = (Frame(0, 1),)
    constraint = Constraint.NONSINGULAR

    @property
    def dof(self) -> int:  # type: ignore[override]
        return (self.n + 1) ** 2 - 1

    @property
    def codim(self) -> int:  # type: ignore[override]
        return self.n

    @staticmethod
    def compose(A: Tensor) -> Tensor:
        r"""The tensor of a collineation: A itself, at norm 1.

        Args:
            A: ``(*batch, n + 1, n + 1)``.

        Returns:
            The same shape; zero where A is zero.

        Example:
            >>> import torch
            >>> Collineation.compose(2 * torch.eye(4)).diagonal().tolist()
            [0.5, 0.5, 0.5, 0.5]
        """
        return unit_tensors(A, 2)

    def compose_derivative(self, motion: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
        """By hand: the identity, at norm 1."""
        flat = motion[0].flatten(1)
        eye = torch.eye(flat.shape[-1], dtype=flat.dtype, device=flat.device)
        return normalized_derivative(flat, eye.expand(len(flat), -1, -1))

    @staticmethod
    def decompose(tensor: Tensor) -> Tensor:
        r"""The collineation of a tensor: canonical scale and sign, see :func:`dyntorch.geometry.homogeneous.unit`.

        Args:
            tensor: ``(*batch, n + 1, n + 1)``.

        Returns:
            A, the same shape.

        Example:
            >>> import torch
            >>> Collineation.decompose(-2 * torch.eye(4)).diagonal().tolist()
            [0.5, 0.5, 0.5, 0.5]
        """
        return unit(tensor)

    def constrain(self, tensor: Tensor) -> Tensor:
        """0 for matrices that map everything onto less than the space: what coinciding points of view 1 leave."""
        flat = tensor.detach()
        singular = torch.linalg.det(flat).abs() <= SINGULAR * torch.linalg.matrix_norm(flat) ** (self.n + 1)
        return torch.where(singular[..., None, None], 0.0, tensor)

    @staticmethod
    def transfer(tensor: Tensor, x2: Tensor) -> Tensor:
        r"""Points of view 1 from their positions in view 2: :math:`x_1 = \pi(A p_2)`.

        Args:
            tensor: ``(*batch, n + 1, n + 1)``.
            x2: ``(*batch, matches, n)``.

        Returns:
            ``(*batch, matches, n)``.

        Raises:
            ValueError: points of another dimension than the tensor.

        Example:
            >>> import torch
            >>> shift = torch.tensor([[1.0, 0.0, 5.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
            >>> Collineation.transfer(shift, torch.tensor([[1.0, 2.0]])).tolist()
            [[6.0, 2.0]]
        """
        return apply(tensor, x2)

    def whitened_residual(self, motion: tuple[Tensor, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...]) -> Tensor:
        r"""Whitened :math:`e = \pi(A p_2) - x_1`, with :math:`Q = s_1^2 I + s_2^2 J J^T`; ``(*batch, matches, n)``."""
        return static_residual(motion, views, scales)
