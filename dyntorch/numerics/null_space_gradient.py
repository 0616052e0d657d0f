"""Derivatives of null spaces, of every order, reverse and forward, for one problem or many mapped over by ``torch.func``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from dyntorch.numerics.blocks import map_blocks
from dyntorch.numerics.eigenspaces import EPS, add_to_diagonal, block_size, gram_of, on_host, raise_eigenspace, solve, unit_trace
from dyntorch.numerics.function_transforms import merge_mapped_dimension, split_again

OfGrams = Callable[[Tensor, int], tuple[Tensor, Tensor, Tensor, Tensor]]
"""Basis ``(b, dim, D)``, residual, competing and degenerate of Grams ``(b, D, D)``, as
:class:`~dyntorch.numerics.nullspace.GramNullSpace` has them."""
OfRows = Callable[[Tensor, int, bool], tuple[Tensor, Tensor]]
"""Basis ``(b, dim, D)`` of rows, and their Grams where they are to be kept (else empty)."""


def resolvent(gram: Tensor, vectors: Tensor, gradient: Tensor) -> Tensor:
    r""":math:`w_j = (G - \rho_j I)^+ (I - V V^T) g_j` for each Ritz vector; rotations inside the eigenspace are left out. gram
    ``(b, D, D)``, vectors ``(b, D, k)``, gradient ``(b, D, k)``."""
    values = (vectors * (gram @ vectors)).sum(-2)
    gradient = gradient - vectors @ (vectors.mT @ gradient)
    deflated = raise_eigenspace(gram, vectors)
    columns = []
    for j in range(vectors.shape[-1]):
        factor = _regularized_factor(add_to_diagonal(deflated.clone(), gram.shape[-1] * EPS - values[:, j, None]))
        columns.append(solve(gradient[..., j : j + 1], factor))
    found = torch.cat(columns, dim=-1)
    return found - vectors @ (vectors.mT @ found)


def eigenspace_derivative(gram: Tensor, vectors: Tensor, image: Tensor) -> Tensor:
    r"""How an eigenspace turns, :math:`dV = -W` where G changes by dG: the solution of a Sylvester equation. gram
    ``(b, D, D)``, vectors ``(b, D, k)``, image ``(b, D, k)``."""
    size, dim = vectors.shape[-2:]
    trace = gram.detach().diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    usable = torch.isfinite(gram.detach().sum((-2, -1), keepdim=True)) & (trace > 1e-300)
    scale = torch.where(usable, trace, 1.0).reciprocal()
    eye = torch.eye(size, dtype=gram.dtype, device=gram.device)
    scaled = torch.where(usable, gram, eye) * scale
    right = image - vectors @ (vectors.mT @ image)
    deflated = scaled + vectors @ vectors.mT + size * EPS * eye
    small = vectors.mT @ scaled @ vectors
    within = torch.eye(dim, dtype=gram.dtype, device=gram.device)
    operator = torch.einsum("...ij,kl->...ikjl", deflated, within) - torch.einsum("ij,...lk->...ikjl", eye, small)
    flat = operator.flatten(-4, -3).flatten(-2, -1)
    found = torch.linalg.solve_ex(flat, right.flatten(-2)[..., None])[0][..., 0].unflatten(-1, (size, dim))
    found = torch.where(usable, found, 0.0) * -scale
    return found - vectors @ (vectors.mT @ found)


def gram_gradient(gram: Tensor, vectors: Tensor, gradient: Tensor) -> Tensor:
    """Gradient ``(b, D, D)`` by a Gram of a function of its eigenvectors with this gradient ``(b, D, k)``; differentiable."""
    product = eigenspace_derivative(gram, vectors, gradient) @ vectors.mT
    return 0.5 * (product + product.mT)


def _regularized_factor(matrix: Tensor) -> Tensor:
    """Cholesky factors; a matrix of trace about 1 that is singular to rounding gets a small multiple of the identity."""
    factor: Tensor
    factor, info = torch.linalg.cholesky_ex(matrix)
    failed = info > 0
    if on_host(matrix) and not bool(failed.any()):
        return factor
    factor, _ = torch.linalg.cholesky_ex(add_to_diagonal(matrix.clone(), torch.where(failed, 1e-10, 0.0)[:, None]))
    return factor


class NullSpaceOfGrams(torch.autograd.Function):
    """``dim`` smallest eigenvectors of ``(b, D, D)``, as a solver finds them; only they carry gradients."""

    @staticmethod
    def forward(gram: Tensor, dim: int, solver: OfGrams) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return solver(gram, dim)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, int, OfGrams], output: tuple[Tensor, ...]) -> None:
        ctx.save_for_backward(inputs[0], output[0])
        ctx.save_for_forward(inputs[0], output[0])
        ctx.mark_non_differentiable(*output[1:])

    @staticmethod
    def backward(ctx: Any, grad: Tensor, *_: Tensor) -> tuple[Tensor, None, None]:
        gram, basis = ctx.saved_tensors
        if torch.is_grad_enabled():  # somebody wants the derivative of this one
            return gram_gradient(gram.double(), basis.double().mT, grad.double().mT).to(gram.dtype), None, None

        def block(gram: Tensor, basis: Tensor, grad: Tensor) -> Tensor:
            scaled, scale, finite = unit_trace(gram.double())
            vectors = basis.double().mT
            product = resolvent(scaled, vectors, grad.double().mT) @ vectors.mT * (-0.5 * scale)[:, None, None]
            return torch.where(finite[:, None, None], product + product.mT, 0.0).to(gram.dtype)

        return map_blocks(block, gram, basis, grad, size=block_size(gram)), None, None

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, *_: None) -> tuple[Tensor, None, None, None]:
        gram, basis = ctx.saved_tensors
        moved = eigenspace_derivative(gram.double(), basis.double().mT, tangent.double() @ basis.double().mT)
        return moved.mT.to(gram.dtype), None, None, None

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[int | None, None, None], gram: Tensor, dim: int, solver: OfGrams
    ) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        parts = NullSpaceOfGrams.apply(merge_mapped_dimension(info, in_dims[0], gram), dim, solver)  # type: ignore[no-untyped-call]
        return tuple(split_again(info, part) for part in parts), (0, 0, 0, 0)


class NullSpaceOfRows(torch.autograd.Function):
    """The same for rows ``(b, rows, D)``: the basis, and the Gram where ``keep`` saves the backward from forming it again."""

    @staticmethod
    def forward(matrix: Tensor, dim: int, keep: bool, solver: OfRows) -> tuple[Tensor, Tensor]:
        return solver(matrix, dim, keep)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, int, bool, OfRows], output: tuple[Tensor, Tensor]) -> None:
        ctx.save_for_backward(inputs[0], output[1], output[0])
        ctx.save_for_forward(inputs[0], output[0])
        ctx.mark_non_differentiable(output[1])

    @staticmethod
    def backward(ctx: Any, grad: Tensor, *_: Tensor) -> tuple[Tensor, None, None, None]:
        matrix, gram, basis = ctx.saved_tensors
        if torch.is_grad_enabled():  # somebody wants the derivative of this one
            a = _or_zero(matrix.double())
            bent = gram_gradient(a.mT @ a, basis.double().mT, grad.double().mT)
            return (2 * a @ bent).to(matrix.dtype), None, None, None
        result = torch.empty_like(matrix, memory_format=torch.contiguous_format)

        def block(matrix: Tensor, gram: Tensor, basis: Tensor, grad: Tensor, result: Tensor) -> Tensor:
            a = matrix.double()
            scaled, scale, finite = unit_trace(gram if gram.numel() else gram_of(a))
            if not on_host(a) or not bool(finite.all()):
                a = torch.where(finite[:, None, None], a, 0.0)
            vectors = basis.double().mT
            w = resolvent(scaled, vectors, grad.double().mT) * -scale[:, None, None]
            left, right = a @ torch.cat([w, vectors], -1), torch.cat([vectors, w], -1).mT
            # written in place: fresh memory for arrays of this size costs as much as the products
            if result.dtype == left.dtype:
                torch.bmm(left, right, out=result)
            else:
                result.copy_(left @ right)
            return finite

        map_blocks(block, matrix, gram, basis, grad, result, size=block_size(matrix))
        return result, None, None, None

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, *_: None) -> tuple[Tensor, None]:
        matrix, basis = ctx.saved_tensors
        a, vectors = _or_zero(matrix.double()), basis.double().mT
        change = a.mT @ (tangent.double() @ vectors) + tangent.double().mT @ (a @ vectors)
        return eigenspace_derivative(a.mT @ a, vectors, change).mT.to(matrix.dtype), None

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[int | None, None, None, None], matrix: Tensor, dim: int, keep: bool, solver: OfRows
    ) -> tuple[tuple[Tensor, Tensor], tuple[int, int]]:
        basis, gram = NullSpaceOfRows.apply(merge_mapped_dimension(info, in_dims[0], matrix), dim, keep, solver)  # type: ignore[no-untyped-call]
        return (split_again(info, basis), split_again(info, gram)), (0, 0)


def _or_zero(matrix: Tensor) -> Tensor:
    """Matrices with a number that is not finite replaced by zero ones."""
    return torch.where(torch.isfinite(matrix).flatten(1).all(-1)[:, None, None], matrix, 0.0)
