"""Null spaces of many small matrices at once: certified, differentiable, several times faster than the SVD."""

from __future__ import annotations

from dataclasses import dataclass
from math import prod
from typing import Any

import torch
from torch import Tensor

from dyntorch.native import library
from dyntorch.numerics.arguments import check_tensor
from dyntorch.numerics.blocks import map_blocks, one_thread
from dyntorch.numerics.eigenspaces import (
    EPS,
    NULL,
    RESOLVED,
    add_to_diagonal,
    block_size,
    by_inverse_iteration,
    by_squaring,
    competing_sum,
    fix_signs,
    gram_of,
    on_host,
    orthonormal,
    raise_eigenspace,
    solve,
    unit_trace,
)
from dyntorch.numerics.function_transforms import is_transformed, merge_mapped_dimension, needs_autograd, split_again

UNDERFLOW = 1e-250  # of the order of the entries: squares and products of what is smaller are no normal numbers


def eigh(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Eigenvalues, ascending, and vectors of symmetric matrices whose entries are of the order of 1."""
    values, vectors = torch.linalg.eigh(_without(matrix, UNDERFLOW))
    return values, vectors


def _without(matrix: Tensor, limit: float) -> Tensor:
    """The matrix with 0 for entries below a limit, which keep their derivatives."""
    nothing = matrix - matrix.detach() if matrix.requires_grad or is_transformed(matrix) else 0.0
    return torch.where(matrix.abs() < limit, nothing, matrix)


def spectrum(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """:func:`eigh` of symmetric matrices of any size; entries that are not finite, which stop the batch as well, count as 0."""
    even, size = _even(matrix)
    values, vectors = eigh(even)
    return values * size, vectors


def eigenvalues(matrix: Tensor) -> Tensor:
    """The eigenvalues of :func:`spectrum`."""
    even, size = _even(matrix)
    values: Tensor = torch.linalg.eigvalsh(_without(even, UNDERFLOW))
    return values * size


def real_eigenvalues(matrix: Tensor) -> Tensor:
    """Real parts of the eigenvalues of square matrices of any size, not symmetric; entries that are not finite count as 0."""
    even, size = _even(matrix)
    values: Tensor = torch.linalg.eigvals(_without(even, 1e-100)).real
    return values * size


def _even(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Matrices whose largest entry is 1, and its size ``(..., 1)``; entries that are not finite are 0."""
    finite = torch.where(matrix.isfinite(), matrix, 0.0)
    size = finite.detach().abs().amax((-2, -1), keepdim=True)
    size = torch.where(size > 0, size, 1.0)
    return finite / size, size[..., 0]


def by_eigh(gram: Tensor, dim: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Vectors, values, sum of 1 / eigenvalue over the others, and whether the next eigenvalue is numerically zero as well."""
    every, vectors = eigh(gram)
    others = every[:, dim:]
    degenerate = (others <= NULL * every[:, -1:].clamp(min=EPS)).any(-1)
    competing = others.clamp(min=EPS / gram.shape[-1]).reciprocal().sum(-1)
    return vectors[..., :dim].contiguous(), every[:, :dim].clamp(min=0.0), competing, degenerate


ACCURATE = 1e-6  # of the trace: a competing eigenvalue for which a Gram gives the null space to 1e-10
STABLE = 1e-13  # |A v| / |A| of an LU that did not go wrong
FEW = 20_000  # entries of Gram matrices per block up to which eigh beats the overhead of many small operations (D = 9 ... 64)
FEWER = 4_000  # the same for squaring (50 problems of D = 9)
SMALL = 20  # D up to which squaring the inverse beats inverse iteration: D = 9 2.8 to 7.0 us, 16 5.9 to 14.3, 27 20 to 19
TINY = 150_000  # rows * D^2 in all up to which one SVD beats that of a Gram with eigh as well (8 problems of 200 x 9)


@dataclass(frozen=True)
class GramNullSpace:
    """Null space of Gram matrices; only ``basis`` carries gradients."""

    basis: Tensor
    """``(*batch, dim, D)`` orthonormal rows: the Ritz vectors, in the order of ``residual``."""
    residual: Tensor
    """``(*batch, dim)`` eigenvalues of the null block, ascending, not negative."""
    competing: Tensor
    """``(*batch,)`` sum of 1 / eigenvalue over all others: how much the rest of the data resists, in the unit of 1 / gram."""
    degenerate: Tensor
    """``(*batch,)`` bool: the null space is larger than asked for, or the input not finite, or (accelerators) not converged."""


@one_thread
def null_space(matrix: Tensor, dim: int = 1) -> Tensor:
    r"""Orthonormal basis of the right null space: :math:`A v_j \approx 0`, least squares where no exact one exists.

    The rows span what ``torch.linalg.svd(A).Vh[-dim:]`` spans.  All derivatives of a function that does not depend on the choice
    of the basis are right, also the second (``create_graph=True``, ``torch.func``), at minimal rows, and for ``dim`` above one.

    Args:
        matrix: ``(*batch, rows, D)`` with ``rows >= D - dim``.
        dim: dimension of the null space.

    Returns:
        ``(*batch, dim, D)`` in the dtype and on the device of the input; zero where a matrix holds a number that is not finite.

    Raises:
        ValueError: fewer rows than D - dim, ``dim`` outside 1..D, or no floating point matrix.

    Example:
        >>> import torch
        >>> v = null_space(torch.tensor([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0]], dtype=torch.float64))
        >>> (v / v[..., 2:]).tolist()
        [[-1.0, -1.0, 1.0]]
    """
    _check(matrix, "matrix", dim)
    rows, size = matrix.shape[-2:]
    if rows < size - dim:
        raise ValueError(
            f"matrix of shape {tuple(matrix.shape)} has {rows} rows, a null space of dimension {dim} in R^{size} needs at least "
            f"{size - dim}: add equations, or ask for dim={size - rows}"
        )
    if matrix.device.type == "mps":  # no float64
        return null_space(matrix.cpu(), dim).to(matrix.device)
    keep = torch.is_grad_enabled() and matrix.requires_grad
    # its bookkeeping takes as long as a small null space
    solve = NullSpaceOfRows.apply if needs_autograd(matrix) else _of_rows
    basis: Tensor = solve(_flat(matrix), dim, keep)[0]
    return basis.reshape(*matrix.shape[:-2], dim, size)


def gram_null_space(gram: Tensor, dim: int = 1) -> GramNullSpace:
    r"""Eigenspace of the ``dim`` smallest eigenvalues of Gram matrices :math:`G = A^T A`. gram ``(*batch, D, D)``."""
    _check(gram, "gram", dim)
    size = gram.shape[-1]
    if gram.shape[-2] != size:
        raise ValueError(f"gram must be square (*batch, D, D), got {tuple(gram.shape)}; null_space takes rows")
    if gram.device.type == "mps":  # no float64
        space = gram_null_space(gram.cpu(), dim)
        return GramNullSpace(*(part.to(gram.device) for part in vars(space).values()))
    solve = NullSpaceOfGrams.apply if needs_autograd(gram) else _of_grams
    basis, residual, competing, degenerate = solve(_flat(gram), dim)
    batch = gram.shape[:-2]
    return GramNullSpace(
        basis.reshape(*batch, dim, size), residual.reshape(*batch, dim), competing.reshape(batch), degenerate.reshape(batch)
    )


def _check(matrix: Tensor, name: str, dim: int) -> None:
    check_tensor(name, matrix, "rows", "D", precise=False)
    if isinstance(dim, bool) or not isinstance(dim, int):
        raise ValueError(f"dim must be a whole number, got {dim!r}")
    if not 1 <= dim <= matrix.shape[-1]:
        raise ValueError(f"dim must be from 1 to D = {matrix.shape[-1]}, got {dim}")


def _flat(matrix: Tensor) -> Tensor:
    return matrix.reshape(prod(matrix.shape[:-2]), *matrix.shape[-2:])


def _is_small(gram: Tensor) -> bool:
    return on_host(gram) and gram.numel() <= FEW


def _of_grams(gram: Tensor, dim: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Basis, residual, competing and degenerate of all problems, in the dtype of the Grams."""
    parts = map_blocks(lambda block: _solve_gram(block.double(), dim), gram, size=block_size(gram))
    basis, residual, competing = (part.to(gram.dtype) for part in parts[:3])
    return basis, residual, competing, parts[3]


def _of_rows(matrix: Tensor, dim: int, keep: bool) -> tuple[Tensor, Tensor]:
    """Basis of all problems in the dtype of the rows, and their Grams where ``keep`` (and they were needed)."""
    minimal = matrix.shape[-2] == matrix.shape[-1] - dim
    # the vectors of a larger exact null space are free: those of LU follow the rows, Ritz vectors would follow their rounding
    native = on_host(matrix) and library.solves(matrix.shape[-1], dim) and not (minimal and dim > 1)
    tiny = on_host(matrix) and matrix.numel() * matrix.shape[-1] <= TINY

    def block(matrix: Tensor) -> tuple[Tensor, Tensor]:
        a = matrix.double()
        none = a.new_empty(len(a), 0, 0)
        if native:
            basis, gram = _by_kernel(a, dim, minimal, keep)
            return basis.to(matrix.dtype), gram
        if minimal:
            return fix_signs(_solve_minimal(a, dim)).mT.to(matrix.dtype), none
        if tiny:
            return fix_signs(_by_svd(a, dim)).mT.to(matrix.dtype), none
        gram = gram_of(a)
        return fix_signs(_solve_rows(a, gram, dim)).mT.to(matrix.dtype), gram if keep else none

    return map_blocks(block, matrix, size=block_size(matrix))


def _by_kernel(matrix: Tensor, dim: int, minimal: bool, keep: bool) -> tuple[Tensor, Tensor]:
    """Basis of one block by the kernel, and the Grams where ``keep``; what it does not certify is left to this file."""
    basis, following, certified, gram = library.null_of_rows(matrix, dim, always=minimal, keep=keep)
    sound = certified & (following > RESOLVED)
    if not bool(sound.all()):
        hard = (~sound).nonzero()[:, 0]
        part = matrix[hard]
        basis[hard] = fix_signs(_solve_minimal(part, dim) if minimal else _solve_rows(part, gram_of(part), dim)).mT
    return basis, gram


def _solve_gram(gram: Tensor, dim: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Basis, residual, competing and degenerate of one block."""
    if on_host(gram) and library.solves(gram.shape[-1], dim):
        basis, values, competing, following, certified = library.null_of_grams(gram, dim)
        degenerate = ~certified | (following <= RESOLVED)
        hard = degenerate.nonzero()[:, 0]
        if len(hard):
            scaled, scale, finite = unit_trace(gram[hard])
            basis[hard], values[hard], competing[hard], degenerate[hard] = _in_unit(scale, finite, *by_eigh(scaled, dim))
        return basis, values, competing, degenerate
    scaled, scale, finite = unit_trace(gram)
    host = on_host(gram)
    squaring = host and dim == 1 < gram.shape[-1] <= SMALL
    if dim == gram.shape[-1] or (_is_small(gram) and not (squaring and gram.numel() > FEWER)):
        vectors, values, competing, degenerate = by_eigh(scaled, dim)
    else:
        if squaring:
            vectors, values, competing, certified = by_squaring(scaled)
            degenerate = ~certified
        else:
            space = by_inverse_iteration(scaled, dim)
            vectors, values, competing = space.vectors, space.values, competing_sum(space.factor, space.vectors)
            degenerate = ~space.certified | (space.competing <= (RESOLVED if host else NULL))
        hard = degenerate.nonzero()[:, 0] if host else degenerate[:0]
        if len(hard):
            vectors[hard], values[hard], competing[hard], degenerate[hard] = by_eigh(scaled[hard], dim)
    return _in_unit(scale, finite, vectors, values, competing, degenerate)


def _in_unit(
    scale: Tensor, finite: Tensor, vectors: Tensor, values: Tensor, competing: Tensor, degenerate: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Basis, residual, competing and degenerate in the unit of the Grams; no basis where they were not finite."""
    basis = torch.where(finite[:, None, None], fix_signs(vectors).mT, 0.0)
    return basis, values / scale[:, None], competing * scale, degenerate | ~finite


def _solve_rows(matrix: Tensor, gram: Tensor, dim: int) -> Tensor:
    """Null spaces ``(b, D, dim)`` through the Gram, where it carries them; corrected with the rows; SVD for the rest."""
    scaled, scale, finite = unit_trace(gram)
    if dim == matrix.shape[-1]:
        return torch.where(finite[:, None, None], by_eigh(scaled, dim)[0], 0.0)
    if _is_small(gram):
        values, vectors = eigh(scaled)
        return _with_svd(matrix, vectors[..., :dim].contiguous(), ~finite | (values[:, dim] < ACCURATE))
    space = by_inverse_iteration(scaled, dim)
    vectors = space.vectors
    if not on_host(matrix):
        return torch.where(finite[:, None, None], _correct_by_newton(matrix, scale, vectors, space.deflated), 0.0)
    slow = (finite & ~space.certified & (space.competing > ACCURATE)).nonzero()[:, 0]
    if len(slow):
        vectors[slow] = by_eigh(scaled[slow], dim)[0]
    inexact = (finite & space.certified & (space.competing <= ACCURATE) & (space.competing > RESOLVED)).nonzero()[:, 0]
    if len(inexact):
        vectors[inexact] = _correct_by_newton(matrix[inexact], scale[inexact], vectors[inexact], space.deflated[inexact])
    return _with_svd(matrix, vectors, ~(finite & (space.competing > torch.where(space.certified, RESOLVED, ACCURATE))))


def _correct_by_newton(matrix: Tensor, scale: Tensor, vectors: Tensor, deflated: Tensor) -> Tensor:
    """Newton corrections whose residual comes from the rows: the error is that of the SVD, eps kappa, not eps kappa^2."""
    for _ in range(2):
        image = matrix @ vectors
        residual = (matrix.mT @ image - vectors @ (image.mT @ image)) * scale[:, None, None]
        vectors = orthonormal(vectors - solve(residual, deflated))
    return vectors


def _solve_minimal(matrix: Tensor, dim: int) -> Tensor:
    r"""Exactly D - dim rows: :math:`A^T = P L U`, and what is orthogonal to the columns of :math:`P L` is a null vector."""
    rows, size = matrix.shape[-2:]
    if rows == 0:
        return torch.eye(size, dtype=matrix.dtype, device=matrix.device).expand(len(matrix), -1, -1).clone()
    factors, pivots, _ = torch.linalg.lu_factor_ex(matrix.mT)
    upper, last = factors[:, :rows].mT, factors[:, rows:].mT
    head = torch.linalg.solve_triangular(upper, -last, upper=True, unitriangular=True)
    eye = torch.eye(dim, dtype=matrix.dtype, device=matrix.device).expand(len(matrix), -1, -1)
    permutation = torch.lu_unpack(factors, pivots, unpack_data=False)[0]
    vectors = orthonormal(permutation @ torch.cat([head, eye], dim=-2))
    error = (matrix @ vectors).square().sum((-2, -1))
    sound = error <= STABLE**2 * matrix.square().sum((-2, -1))
    return (
        _with_svd(matrix, vectors, ~sound) if on_host(matrix) else torch.where(torch.isfinite(error)[:, None, None], vectors, 0.0)
    )


def _with_svd(matrix: Tensor, vectors: Tensor, hard: Tensor) -> Tensor:
    """``vectors``, with the SVD's where ``hard`` (CPU only)."""
    chosen = hard.nonzero()[:, 0]
    if len(chosen):
        vectors[chosen] = _by_svd(matrix[chosen], vectors.shape[-1])
    return vectors


def _by_svd(matrix: Tensor, dim: int) -> Tensor:
    rows, size = matrix.shape[-2:]
    finite = torch.isfinite(matrix).flatten(1).all(-1)[:, None, None]
    sound = bool(finite.all())  # the SVD raises for the whole batch
    vh = torch.linalg.svd(matrix if sound else torch.where(finite, matrix, 0.0), full_matrices=rows < size).Vh
    vectors = vh[:, size - dim :].flip(-2).mT
    return vectors if sound else torch.where(finite, vectors, 0.0)


# ----------------------------------------------------------------------------------------------------------------------
# The derivatives of null spaces.


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
    solution = torch.cat(columns, dim=-1)
    return solution - vectors @ (vectors.mT @ solution)


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
    change = torch.linalg.solve_ex(flat, right.flatten(-2)[..., None])[0][..., 0].unflatten(-1, (size, dim))
    change = torch.where(usable, change, 0.0) * -scale
    return change - vectors @ (vectors.mT @ change)


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
    def forward(gram: Tensor, dim: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return _of_grams(gram, dim)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, int], output: tuple[Tensor, ...]) -> None:
        ctx.save_for_backward(inputs[0], output[0])
        ctx.save_for_forward(inputs[0], output[0])
        ctx.mark_non_differentiable(*output[1:])

    @staticmethod
    def backward(ctx: Any, grad: Tensor, *_: Tensor) -> tuple[Tensor, None]:
        gram, basis = ctx.saved_tensors
        if torch.is_grad_enabled():  # somebody wants the derivative of this one
            return gram_gradient(gram.double(), basis.double().mT, grad.double().mT).to(gram.dtype), None

        def block(gram: Tensor, basis: Tensor, grad: Tensor) -> Tensor:
            scaled, scale, finite = unit_trace(gram.double())
            vectors = basis.double().mT
            product = resolvent(scaled, vectors, grad.double().mT) @ vectors.mT * (-0.5 * scale)[:, None, None]
            return torch.where(finite[:, None, None], product + product.mT, 0.0).to(gram.dtype)

        return map_blocks(block, gram, basis, grad, size=block_size(gram)), None

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, *_: None) -> tuple[Tensor, None, None, None]:
        gram, basis = ctx.saved_tensors
        moved = eigenspace_derivative(gram.double(), basis.double().mT, tangent.double() @ basis.double().mT)
        return moved.mT.to(gram.dtype), None, None, None

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, None], gram: Tensor, dim: int) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        parts = NullSpaceOfGrams.apply(merge_mapped_dimension(info, in_dims[0], gram), dim)  # type: ignore[no-untyped-call]
        return tuple(split_again(info, part) for part in parts), (0, 0, 0, 0)


class NullSpaceOfRows(torch.autograd.Function):
    """The same for rows ``(b, rows, D)``: the basis, and the Gram where ``keep`` saves the backward from forming it again."""

    @staticmethod
    def forward(matrix: Tensor, dim: int, keep: bool) -> tuple[Tensor, Tensor]:
        return _of_rows(matrix, dim, keep)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, int, bool], output: tuple[Tensor, Tensor]) -> None:
        ctx.save_for_backward(inputs[0], output[1], output[0])
        ctx.save_for_forward(inputs[0], output[0])
        ctx.mark_non_differentiable(output[1])

    @staticmethod
    def backward(ctx: Any, grad: Tensor, *_: Tensor) -> tuple[Tensor, None, None]:
        matrix, gram, basis = ctx.saved_tensors
        if torch.is_grad_enabled():  # somebody wants the derivative of this one
            a = _or_zero(matrix.double())
            bent = gram_gradient(a.mT @ a, basis.double().mT, grad.double().mT)
            return (2 * a @ bent).to(matrix.dtype), None, None
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
        return result, None, None

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, *_: None) -> tuple[Tensor, None]:
        matrix, basis = ctx.saved_tensors
        a, vectors = _or_zero(matrix.double()), basis.double().mT
        change = a.mT @ (tangent.double() @ vectors) + tangent.double().mT @ (a @ vectors)
        return eigenspace_derivative(a.mT @ a, vectors, change).mT.to(matrix.dtype), None

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[int | None, None, None], matrix: Tensor, dim: int, keep: bool
    ) -> tuple[tuple[Tensor, Tensor], tuple[int, int]]:
        basis, gram = NullSpaceOfRows.apply(merge_mapped_dimension(info, in_dims[0], matrix), dim, keep)  # type: ignore[no-untyped-call]
        return (split_again(info, basis), split_again(info, gram)), (0, 0)


def _or_zero(matrix: Tensor) -> Tensor:
    """Matrices with a number that is not finite replaced by zero ones."""
    return torch.where(torch.isfinite(matrix).flatten(1).all(-1)[:, None, None], matrix, 0.0)
