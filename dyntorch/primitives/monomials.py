"""Monomials of the coordinates of a point: what polynomial constraints on points are linear in."""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import torch
from torch import Tensor

from dyntorch.algebra.homogeneous import homogeneous
from dyntorch.algebra.monomials import collecting, factors, monomial_derivatives, monomials, multiplicity
from dyntorch.primitives.base import Primitive


@dataclass(frozen=True, repr=False)
class Monomials(Primitive):
    r"""The monomials :math:`\nu(p)` of one degree of a point p = (x, 1) of P^d, in lexicographic order: 00, 01, 02, 11, 12, 22.

    A form :math:`\nu(p)^T c` is a curve (of degree 2 a conic) through the point.  A collineation T acts on them linearly,
    :math:`\nu(T p) = T_\nu\, \nu(p)`.

    Example:
        >>> import torch
        >>> Monomials().raw(torch.tensor([[2.0, 3.0]])).tolist()
        [[4.0, 6.0, 2.0, 9.0, 3.0, 1.0]]
    """

    degree: int = 2
    dim: int = 2
    isometric: bool = False
    r"""Whether each is scaled by the root of how often it occurs in :math:`p \otimes \dots \otimes p`, so that rotations of p
    rotate them."""

    @property
    def width(self) -> int:  # type: ignore[override]
        return comb(self.dim + self.degree, self.degree)

    def shapes(self) -> tuple[tuple[int, ...], ...]:
        return ((self.dim,),)

    def raw(self, x: Tensor) -> Tensor:
        return self.components(x).mT

    def components(self, x: Tensor) -> Tensor:
        product = monomials(torch.cat([x.mT, torch.ones_like(x.mT[..., :1, :])], dim=-2), self.degree)
        return product * self.scale(x.device).to(x.dtype)[:, None] if self.isometric else product

    def normalized(self, transform: Tensor) -> Primitive:
        """The isometric ones: what is least squares must not depend on how the axes lie."""
        return Monomials(self.degree, self.dim, isometric=True)

    def scale(self, device: torch.device) -> Tensor:
        """The factors ``(width,)`` of the isometric ones."""
        return multiplicity(self.degree, self.dim, device).sqrt()

    def action(self, transform: Tensor) -> Tensor:
        # row by row: the product of linear forms, whose coefficients add up by monomial
        product = torch.ones_like(transform[..., :1, :1])
        for factor in self._factors(transform.device).unbind(-1):
            product = (product[..., :, None] * transform[..., factor, None, :]).flatten(-2)
        lifted = product @ collecting(self.degree, self.dim, transform.device).to(transform.dtype).mT
        if not self.isometric:
            return lifted
        scale = self.scale(transform.device).to(transform.dtype)
        return scale[:, None] * lifted / scale

    def pullback(self, x: Tensor, gradient: Tensor) -> Tensor:
        return (gradient[..., None, :] @ self._derivative(x))[..., 0, :]

    def pushforward(self, x: Tensor, change: Tensor) -> Tensor:
        return (self._derivative(x) @ change[..., None])[..., 0]

    def _derivative(self, x: Tensor) -> Tensor:
        """``(*batch, n, width, dim)``."""
        total = monomial_derivatives(homogeneous(x), self.degree, self.dim)
        return total * self.scale(x.device).to(x.dtype)[:, None] if self.isometric else total

    def _factors(self, device: torch.device) -> Tensor:
        return factors(self.degree, self.dim, device)
