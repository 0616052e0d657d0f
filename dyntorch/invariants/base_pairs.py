"""Products of two view relations: what the segmentation matrix and the convergent motion matrix have in common."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.core.invariant import Invariant
from dyntorch.core.matrix import gram
from dyntorch.core.normalize import hartley
from dyntorch.core.primitives import Monomials, Point
from dyntorch.core.residual import algebraic, sampson
from dyntorch.geometry.homogeneous import homogeneous, symmetric, unit
from dyntorch.geometry.pairs import factor_product, hyperplane_pair, product_matrix
from dyntorch.invariants.fundamental_matrix import FundamentalMatrix
from dyntorch.numerics.nullspace import gram_null_space

FLOOR = 1e-3
"""Least squared gradient, over the median one, that a weight of the reweighted fit believes."""


class RelationPair(Invariant):
    r"""Base of the 6 x 6 matrices of a product, :math:`\nu(p_2)^T S\, \nu(p_1) = (p_2^T F_1 p_1)(p_2^T F_2 p_1)`."""

    primitives = (Monomials(),) * 2
    layout = (1, 0)
    # otherwise a fifth to a half of the scenes with a planar body, and all of a single body, pass for two bodies at .1 px
    resolves_noise = False

    @staticmethod
    def product(first: Tensor, second: Tensor) -> Tensor:
        """The matrix S of two relations ``(*batch, 3, 3)``: ``(*batch, 6, 6)`` of norm 1; 0 where one of them is 0."""
        product = product_matrix(first, second)
        norm = torch.linalg.matrix_norm(product, keepdim=True)
        return product / torch.where(norm > 0, norm, torch.ones_like(norm))

    def tensor_of(self, basis: Tensor) -> Tensor:
        """The matrix for plain monomials, of a null vector for isometric ones."""
        scale = Monomials().scale(basis.device).to(basis.dtype)
        return scale[:, None] * super().tensor_of(basis) * scale

    def basis_of(self, tensor: Tensor) -> Tensor:
        scale = Monomials().scale(tensor.device).to(tensor.dtype)
        return super().basis_of(tensor / scale[:, None] / scale)

    @staticmethod
    def fundamentals(tensor: Tensor) -> tuple[Tensor, Tensor]:
        r"""The fundamental matrices of both bodies, from the null spaces of S, which are spanned by the epipoles. tensor
        ``(*batch, 6, 6)`` -> ``(*batch, 3, 3)``."""
        first, second = factor_product(tensor.double())
        return first.to(tensor.dtype), second.to(tensor.dtype)

    @staticmethod
    def decompose_by_derivatives(tensor: Tensor, x1: Tensor, x2: Tensor) -> tuple[Tensor, Tensor]:
        r"""The fundamental matrices by another way, with the matches: the derivative of the form at a match is its epipolar
        line. tensor ``(*batch, 6, 6)``, x1, x2 ``(*batch, n, 2)`` -> ``(*batch, 3, 3)``."""
        finite = x1.isfinite().all(-1) & x2.isfinite().all(-1)
        views = [torch.where(finite[..., None], x, 0.0).double() for x in (x1, x2)]
        weights = finite.double()
        frames = [hartley(x[..., None, :], weights) for x in views]
        first, second = (p.move(x, t) for p, x, t in zip(RelationPair.primitives, views, frames, strict=True))
        # the matrix of the normalized matches
        lifts = [Monomials().action(torch.linalg.inv_ex(t)[0]) for t in frames]
        form = (Monomials().raw(second) @ (lifts[1].mT @ tensor.double() @ lifts[0]))[..., symmetric(2, tensor.device)]
        half = 0.5 + 0.5 * torch.eye(3, dtype=form.dtype, device=form.device)
        lines = (form * half @ homogeneous(first)[..., None])[..., 0]
        labels = hyperplane_pair(lines, weights).labels
        found = [_eight_points(first, second, (labels == k).double()) for k in (1, 2)]
        one, two = (unit(frames[1].mT @ f @ frames[0]).to(tensor.dtype) for f in found)
        return one, two

    @staticmethod
    def labels(first: Tensor, second: Tensor, x1: Tensor, x2: Tensor) -> Tensor:
        r"""Which of two bodies each match moves with: the one to whose epipolar geometry its Sampson distance is less. first,
        second ``(*batch, 3, 3)``, x1, x2 ``(*batch, n, 2)`` -> ``(*batch, n)``."""
        distances = torch.stack([sampson(FundamentalMatrix, f, x1, x2) for f in (first, second)])
        finite = distances.isfinite().all(0)
        return torch.where(finite, 1 + distances.argmin(0), 0)

    @staticmethod
    def reweight(tensor: Tensor, x1: Tensor, x2: Tensor) -> Tensor:
        r"""Weights :math:`1 / \|\nabla h_n\|^2` of the matches for the next fit: the algebraic error becomes that in the
        images. tensor ``(*batch, 6, 6)``, x1, x2 ``(*batch, n, 2)`` -> ``(*batch, n)``."""
        value, distance = algebraic(RelationPair, tensor, x1, x2), sampson(RelationPair, tensor, x1, x2)
        square = torch.where(distance > 0, value / torch.where(distance > 0, distance, 1.0), 0.0).square()
        size = square.masked_fill(~(distance > 0), torch.nan).nanmedian(-1, keepdim=True).values.nan_to_num(nan=1.0)
        weights = 1 / torch.maximum(square / torch.where(size > 0, size, 1.0), torch.full_like(square, FLOOR))
        # a match without any distance has lost its gradient in the quotient
        weights = torch.where(distance > 0, weights, 1.0)
        return torch.where(distance.isfinite(), weights, 0.0)


def _eight_points(x1: Tensor, x2: Tensor, weights: Tensor) -> Tensor:
    """Fundamental matrices ``(*batch, 3, 3)`` of normalized, weighted matches."""
    basis = gram_null_space(gram((Point(2),) * 2, (x1, x2), weights)).basis
    invariant = FundamentalMatrix()
    return invariant.constrain(invariant.tensor_of(basis))
