"""What is measured in one view: points, hyperplanes, lines.  The vectors each of them puts into the estimation matrix.

A multilinear invariant is a form :math:`T(u, v, w)` on vectors that the measured things give, one slot per view.  A slot is
described by its :class:`Primitive`: how a measurement becomes vectors, how these change under a collineation of the view, and
what replaces them where the invariant holds for *every* vector in the slot (a match known to be static).
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor

from dyntorch.constants import constant


@constant
def triangle(width: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Rows and columns of the upper triangle of a square matrix, in the order in which symmetric matrices are packed."""
    rows, columns = torch.triu_indices(width, width, device=device)
    return rows, columns


def inverse(matrix: Tensor) -> Tensor:
    """Without the check of ``torch.linalg.inv``, for which an accelerator would wait."""
    return torch.linalg.inv_ex(matrix)[0]


class Primitive(ABC):
    """One slot of a multilinear invariant."""

    dim: int
    """Dimension d of the space that is measured."""
    width: int
    """Length of the vectors."""
    rows: int = 1
    """Independent vectors per measurement."""

    @abstractmethod
    def shapes(self) -> tuple[tuple[int, ...], ...]:
        """The trailing shapes of one measurement that are understood."""

    @abstractmethod
    def raw(self, x: Tensor) -> Tensor:
        """The vector of a measurement, ``(*batch, n, width)``: a polynomial of the measured coordinates (``rows == 1`` only)."""

    def components(self, x: Tensor) -> Tensor:
        """The vectors as the estimation matrix takes them, components first: ``(*batch, width, n)``.

        They are not scaled to unit length: that would let the matches in the middle outweigh those at the rim, which decide
        the tensor (measured: 1.3 to 2 times the error for points of the plane, 1.2 in space).
        """
        return self.raw(x).mT

    def vectors(self, x: Tensor) -> Tensor:
        """The same, one row each: ``(*batch, n, rows, width)``."""
        return self.components(x).mT[..., None, :]

    @abstractmethod
    def action(self, transform: Tensor) -> Tensor:
        r"""The matrix M with :math:`\mathrm{vector}(T x) \sim M\,\mathrm{vector}(x)`, ``(*batch, width, width)``."""

    @abstractmethod
    def pullback(self, x: Tensor, gradient: Tensor) -> Tensor:
        r"""Chain rule :math:`J^T g` from the (unscaled) vector back to the measured coordinates.

        Args:
            x: measurements.
            gradient: ``(*batch, n, width)`` derivative of a scalar with respect to :meth:`raw`.

        Returns:
            ``(*batch, n, coordinates)`` derivative with respect to the measured coordinates.
        """

    @abstractmethod
    def pushforward(self, x: Tensor, change: Tensor) -> Tensor:
        r"""The other way: the change :math:`J c` of the raw vector, ``(*batch, n, width)``, for a change of the coordinates."""

    def packed(self, x: Tensor) -> Tensor:
        r"""Upper triangle of :math:`\sum_r v_r v_r^T` of each measurement, component first: ``(*batch, w (w + 1) / 2, n)``."""
        rows, columns = triangle(self.width, x.device)
        if self.rows > 1:
            vectors = self.vectors(x)
            return (vectors.mT @ vectors)[..., rows, columns].mT
        components = self.components(x)
        return components.index_select(-2, rows) * components.index_select(-2, columns)

    def free(self, x: Tensor) -> Tensor:
        """The form of all vectors that a static match allows in this slot: every vector, unless the primitive says otherwise."""
        eye = torch.eye(self.width, dtype=x.dtype, device=x.device)
        return eye.expand(*x.shape[: self.match_axis(x) + 1], self.width, self.width)

    def points(self, x: Tensor, weights: Tensor | None = None) -> Tensor:
        """Points ``(*batch, n, k, d)`` that stand for the size and place of each measurement (for the normalization).

        Args:
            x: measurements.
            weights: ``(*batch, n)``; None for equal ones.
        """
        return x.unsqueeze(-2)

    def move(self, x: Tensor, transform: Tensor) -> Tensor:
        """The measurement after a similarity of its view (a scale and a shift), ``(*batch, d+1, d+1)``, in the same shape."""
        return torch.addcmul(transform[..., None, :-1, -1], x, transform[..., :1, :1])

    def disturbed(self, x: Tensor, noise: Tensor) -> Tensor:
        """The measurement with noise of the same shape, in units of normalized coordinates."""
        return x + noise

    def normalized(self, transform: Tensor) -> Primitive:
        """The primitive that measures in normalized coordinates: the same one, unless it depends on the coordinates."""
        return self

    def freedom(self) -> int:
        """Degrees of freedom of one measurement, which is also how many conditions it fulfils where it is known."""
        return self.dim

    def match_axis(self, x: Tensor) -> int:
        """Axis of the matches in ``x``: the one before the shape of a measurement."""
        for shape in self.shapes():
            if tuple(x.shape[x.ndim - len(shape) :]) == shape and x.ndim > len(shape):
                return x.ndim - len(shape) - 1
        known = " or ".join(f"(*batch, n, {', '.join(map(str, shape))})" for shape in self.shapes())
        raise ValueError(f"expected {known}, got {tuple(x.shape)}")

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.dim})"
