"""Null spaces of many small matrices at once: certified, differentiable, several times faster than the SVD."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from math import ceil, prod
from typing import Any

import torch
from torch import Tensor

from dyntorch.numerics.arguments import check_tensor
from dyntorch.numerics.blocks import constant, map_blocks, one_thread, workers

# ----------------------------------------------------------------------------------------------------------------------
# Eigenspaces of the smallest eigenvalues of many small Gram matrices, with a certificate, and their reduced resolvent.
#
# Everything here takes ``(b, D, D)`` float64 matrices scaled to trace 1 and has the vectors as columns.  A decision that looks
# at values is made on the CPU only: on an accelerator it would wait for everything queued before it.


EPS = torch.finfo(torch.float64).eps
UNDERFLOW = 1e-250  # of the order of the entries: squares and products of what is smaller are no normal numbers
ANGLE = 1e-11  # that an accepted eigenspace may be off by, rounding of the Gram apart
NULL = 1e-14  # of the largest eigenvalue: below it a Gram holds rounding only (rank defects below 9e-16, kappa 1e6 1e-12)
SQUARINGS = 5  # of the inverse at most: enough for a ratio of the last two singular values of 0.67
RESOLVED = 1e-11  # of the trace: a competing eigenvalue that inverse iteration still tells from rounding


@dataclass(frozen=True)
class Eigenspace:
    """Ritz vectors of the smallest eigenvalues, ascending, and whether to believe them."""

    vectors: Tensor  # (b, D, k)
    values: Tensor  # (b, k)
    competing: Tensor  # (b,) estimate of the next eigenvalue, from above and rarely by more than a factor of two
    certified: Tensor  # (b,) no smaller eigenvalue was missed, and the angle is below ANGLE
    factor: Tensor  # (b, D, D) lower Cholesky factor of G + D eps I
    deflated: Tensor  # (b, D, D) lower Cholesky factor of G - shift I + V V^T


def on_host(tensor: Tensor) -> bool:
    """Whether a decision may look at values."""
    return tensor.device.type == "cpu"


def unit_trace(gram: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Gram matrices scaled to trace 1, the factor ``(b,)`` applied, and which were finite; the others become I / D."""
    trace = gram.diagonal(dim1=-2, dim2=-1).sum(-1)
    scale = torch.where(trace > 1e-300, trace.reciprocal(), 1.0)
    finite = torch.isfinite(gram.sum((-2, -1))) & torch.isfinite(trace)
    scaled = gram * scale[:, None, None]
    if not on_host(gram) or not bool(finite.all()):
        eye = torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device) / gram.shape[-1]
        scaled = torch.where(finite[:, None, None], scaled, eye)
        scale = torch.where(finite, scale, torch.ones_like(scale))
    return scaled, scale, finite


def orthonormal(columns: Tensor) -> Tensor:
    """Orthonormal columns with the same span."""
    if columns.shape[-1] == 1:
        return _unit(columns)
    if on_host(columns):
        basis: Tensor = torch.linalg.qr(columns).Q
        return basis
    # the batched QR of accelerators loops over the problems; Gram-Schmidt, every column twice, keeps them together
    basis = columns[..., :0]
    for j in range(columns.shape[-1]):
        column = _unit(columns[..., j : j + 1])
        for _ in range(2):
            column = _unit(column - basis @ (basis.mT @ column))
        basis = torch.cat([basis, column], dim=-1)
    return basis


def _unit(columns: Tensor) -> Tensor:
    length: Tensor = columns.norm(dim=-2, keepdim=True)
    return columns / length.clamp(min=1e-300)


def solve(right: Tensor, factor: Tensor) -> Tensor:
    """Solution for a lower Cholesky factor: for one column two triangular solves take half the time of cholesky_solve."""
    half = torch.linalg.solve_triangular(factor, right, upper=False)
    whole: Tensor = torch.linalg.solve_triangular(factor.mT, half, upper=True)
    return whole


def fix_signs(vectors: Tensor) -> Tensor:
    """Columns turned to the side of a generic direction (a largest entry would be a tie in skew-symmetric tensors)."""
    product = _generic(vectors.shape[-2], 1, vectors.device).T @ vectors
    return torch.where(product < 0, -vectors, vectors)


@constant
def _generic(size: int, count: int, device: torch.device) -> Tensor:
    """``(size, count)`` fixed directions without symmetry."""
    index = torch.arange(1, size * count + 1, dtype=torch.float64)
    values = torch.frac(index * 0.6180339887498949) + 0.1 * torch.cos(index**2) - 0.5
    return values.reshape(count, size).T.contiguous().to(device)


def by_inverse_iteration(gram: Tensor, dim: int) -> Eigenspace:
    r"""Subspace iteration with :math:`(G + \mu I)^{-1}`, then Newton corrections with a certificate.

    One vector more than ``dim`` is carried along: its Ritz value estimates the next eigenvalue.  With the largest Ritz value
    :math:`\sigma` of the ``dim`` others, a successful Cholesky factorization of :math:`S = G - \sigma I + V V^T` proves that
    no more than ``dim`` eigenvalues are below :math:`\sigma`, and :math:`V - S^{-1}(G V - V V^T G V)` contracts the error by
    :math:`|\sigma - \rho_j| / (\lambda_{dim+1} - \sigma)`, which for one vector is the square of the error before.

    Args:
        gram: ``(b, D, D)`` symmetric, finite, trace 1.
        dim: below D.
    """
    size, host = gram.shape[-1], on_host(gram)
    factor, indefinite = torch.linalg.cholesky_ex(_shifted(gram.clone(), size * EPS))
    # half an iteration: any start is as good as any other
    block = orthonormal(torch.linalg.solve_triangular(factor.mT, _generic(size, dim + 1, gram.device), upper=True))
    for _ in range(2 if host else 6):
        block = orthonormal(solve(block, factor))
    block, values = ritz(gram, block)
    vectors = block[..., :dim]
    sigma, competing = values[:, dim - 1].clamp(0.0, 1.0), values[:, dim]
    deflated, missed = torch.linalg.cholesky_ex(_shifted(_deflated(gram, vectors), -sigma[:, None]))
    sound = (indefinite == 0) & (missed == 0)
    vectors, values, bound = newton(gram, deflated, vectors, sigma, competing)
    if host:
        for _ in range(8):
            rest = (sound & (bound > ANGLE)).nonzero()[:, 0]
            if len(rest) == 0:
                break
            again = newton(gram[rest], deflated[rest], vectors[rest], sigma[rest], competing[rest])
            vectors[rest], values[rest], bound[rest] = again
    else:
        for _ in range(2):
            vectors, values, bound = newton(gram, deflated, vectors, sigma, competing)
    if dim > 1:
        vectors, values = ritz(gram, vectors)
    return Eigenspace(vectors, values.clamp(min=0.0), competing, sound & (bound <= ANGLE), factor, deflated)


def by_squaring(gram: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    r"""The smallest eigenvalue by k squarings of the inverse: every column is multiplied by :math:`G^{-2^k}`.

    The purity :math:`\mathrm{tr}(Y^2) / \mathrm{tr}(Y)^2 = 1 - 2 \sum_i (\lambda_D / \lambda_i)^{2^k}` certifies that one direction
    is left: nothing can be missed, as all directions take part.

    Args:
        gram: ``(b, D, D)`` symmetric, finite, trace 1.

    Returns:
        Vectors ``(b, D, 1)``, values ``(b, 1)``, the sum of 1 / eigenvalue over the others ``(b,)``, and which are certified.
    """
    size = gram.shape[-1]
    factor, indefinite = torch.linalg.cholesky_ex(_shifted(gram.clone(), size * EPS))
    inverse = torch.cholesky_inverse(factor)
    power, enough = inverse, 2 * ANGLE / size**0.5
    for squarings in range(1, SQUARINGS + 1):
        power = power / power.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None]
        power = power @ power
        if squarings > 1:
            diagonal = power.diagonal(dim1=-2, dim2=-1)
            impurity = 1 - power.square().sum((-2, -1)) / diagonal.sum(-1).square()
            if bool((impurity < enough).all()):
                break
    best = diagonal.argmax(-1)[:, None, None].expand(-1, size, 1)
    vectors = torch.nan_to_num(_unit(inverse @ power.gather(-1, best)))
    image = gram @ vectors
    others = inverse.diagonal(dim1=-2, dim2=-1).sum(-1) - (vectors * (inverse @ vectors)).sum((-2, -1))
    certified = (indefinite == 0) & (impurity < enough) & (others * RESOLVED < 1)
    return vectors, (vectors * image).sum(-2).clamp(min=0.0), others.clamp(min=0.0), certified


def newton(gram: Tensor, deflated: Tensor, vectors: Tensor, sigma: Tensor, competing: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """One correction of Ritz vectors: vectors, Ritz values, and the angle left beyond what rounding of the Gram explains."""
    image = gram @ vectors
    small = vectors.mT @ image
    residual = image - vectors @ small
    step = solve(residual, deflated)
    values = small.diagonal(dim1=-2, dim2=-1)
    inner = 0 if vectors.shape[-1] == 1 else 2
    for _ in range(inner):  # towards the shift of each vector, at half the cost of a correction
        step = solve(residual - step * (sigma[:, None] - values)[:, None], deflated)
    gap = (0.25 * (competing - sigma)).clamp(min=EPS)  # competing comes from above
    # the correction is of second order in the values, and of third in the rotation among the vectors
    values = values - (step * residual).sum(-2)
    contraction = ((sigma[:, None] - values).abs().amax(-1) / gap) ** (1 + inner)
    length = step.square().sum((-2, -1)).sqrt()
    return orthonormal(vectors - step), values, length * (contraction + length) - EPS / gap


def ritz(gram: Tensor, vectors: Tensor) -> tuple[Tensor, Tensor]:
    """Ritz vectors and ascending Ritz values in the span of orthonormal columns."""
    small = torch.nan_to_num(vectors.mT @ (gram @ vectors))
    values, rotation = torch.linalg.eigh(small) if on_host(small) else jacobi(small)
    return vectors @ rotation, values


def jacobi(matrix: Tensor, sweeps: int = 6) -> tuple[Tensor, Tensor]:
    """Ascending eigenvalues and eigenvectors of tiny symmetric matrices: unlike eigh it never waits to check for errors."""
    size = matrix.shape[-1]
    eye = torch.eye(size, dtype=matrix.dtype, device=matrix.device)
    vectors = eye.expand_as(matrix)
    pairs = list(combinations(range(size), 2))
    for i, j in pairs * (sweeps if size > 2 else 1):
        twice, difference = 2 * matrix[:, i, j], matrix[:, j, j] - matrix[:, i, i]
        length = (difference.square() + twice.square()).sqrt() + difference.abs()
        tangent = torch.where(difference < 0, -twice, twice) / length.clamp(min=1e-300)
        cosine = (1 + tangent.square()).rsqrt()
        rotation = eye.repeat(len(matrix), 1, 1)
        rotation[:, i, i] = rotation[:, j, j] = cosine
        rotation[:, i, j], rotation[:, j, i] = tangent * cosine, -tangent * cosine
        matrix, vectors = rotation.mT @ matrix @ rotation, vectors @ rotation
    values, order = matrix.diagonal(dim1=-2, dim2=-1).sort(dim=-1)
    return values, vectors.gather(-1, order[:, None].expand_as(vectors))


def competing_sum(factor: Tensor, vectors: Tensor) -> Tensor:
    """Sum of 1 / eigenvalue outside the eigenspace, from the Cholesky factor of the (slightly shifted) Gram: ``(b,)``."""
    eye = torch.eye(factor.shape[-1], dtype=factor.dtype, device=factor.device)
    inverse = torch.linalg.solve_triangular(factor, eye, upper=False)
    total: Tensor = inverse.square().sum((-2, -1)) - (inverse @ vectors).square().sum((-2, -1))
    return total


def eigh(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Eigenvalues, ascending, and vectors of symmetric matrices whose entries are of the order of 1.

    Entries that underflow stop the iteration of some builds of LAPACK, and the error is that of the whole batch: they count as 0.

    Example:
        >>> import torch
        >>> eigh(torch.tensor([[1.0, 1e-310], [1e-310, 2.0]], dtype=torch.float64))[0].tolist()
        [1.0, 2.0]
    """
    values, vectors = torch.linalg.eigh(torch.where(matrix.abs() < UNDERFLOW, 0.0, matrix))
    return values, vectors


def spectrum(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """:func:`eigh` of symmetric matrices of any size; entries that are not finite, which stop the batch as well, count as 0.

    Example:
        >>> import torch
        >>> matrices = torch.tensor([[[3e-280, 0.0], [0.0, 1e-280]], [[1.0, torch.nan], [torch.nan, 1.0]]], dtype=torch.float64)
        >>> spectrum(matrices)[0].tolist()
        [[1e-280, 3e-280], [1.0, 1.0]]
    """
    even, size = _even(matrix)
    values, vectors = eigh(even)
    return values * size, vectors


def eigenvalues(matrix: Tensor) -> Tensor:
    """The eigenvalues of :func:`spectrum`."""
    even, size = _even(matrix)
    values: Tensor = torch.linalg.eigvalsh(torch.where(even.abs() < UNDERFLOW, 0.0, even))
    return values * size


def real_eigenvalues(matrix: Tensor) -> Tensor:
    """Real parts of the eigenvalues of square matrices of any size, not symmetric; entries that are not finite count as 0.

    Entries as far apart as 1e150 stop that iteration in every build of LAPACK: against the largest, 1e-100 counts as 0.

    Example:
        >>> import torch
        >>> matrices = torch.tensor([[[1e200, 1.0], [0.0, 3e200]], [[1.0, torch.inf], [0.0, 1.0]]], dtype=torch.float64)
        >>> real_eigenvalues(matrices).tolist()
        [[1e+200, 3e+200], [1.0, 1.0]]
    """
    even, size = _even(matrix)
    values: Tensor = torch.linalg.eigvals(torch.where(even.abs() < 1e-100, 0.0, even)).real
    return values * size


def _even(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Matrices whose largest entry is 1, and its size ``(..., 1)``; entries that are not finite are 0."""
    known = torch.where(matrix.isfinite(), matrix, 0.0)
    size = known.detach().abs().amax((-2, -1), keepdim=True)
    size = torch.where(size > 0, size, 1.0)
    return known / size, size[..., 0]


def by_eigh(gram: Tensor, dim: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Vectors, values, sum of 1 / eigenvalue over the others, and whether the next eigenvalue is numerically zero as well."""
    every, vectors = eigh(gram)
    others = every[:, dim:]
    degenerate = (others <= NULL * every[:, -1:].clamp(min=EPS)).any(-1)
    competing = others.clamp(min=EPS / gram.shape[-1]).reciprocal().sum(-1)
    return vectors[..., :dim].contiguous(), every[:, :dim].clamp(min=0.0), competing, degenerate


def resolvent(gram: Tensor, vectors: Tensor, gradient: Tensor) -> Tensor:
    r""":math:`w_j = (G - \rho_j I)^+ (I - V V^T) g_j` for each Ritz vector; rotations inside the eigenspace are left out.

    One Cholesky factorization of :math:`G - \rho_j I + V V^T` each.  Where the eigenspace is not separated from the rest the
    result is large, but finite.

    Args:
        gram: ``(b, D, D)`` of trace 1.
        vectors: ``(b, D, k)`` Ritz vectors.
        gradient: ``(b, D, k)``.
    """
    values = (vectors * (gram @ vectors)).sum(-2)
    gradient = gradient - vectors @ (vectors.mT @ gradient)
    deflated = _deflated(gram, vectors)
    columns = []
    for j in range(vectors.shape[-1]):
        factor = _regularized_factor(_shifted(deflated.clone(), gram.shape[-1] * EPS - values[:, j, None]))
        columns.append(solve(gradient[..., j : j + 1], factor))
    found = torch.cat(columns, dim=-1)
    return found - vectors @ (vectors.mT @ found)


def turned(gram: Tensor, vectors: Tensor, image: Tensor) -> Tensor:
    r"""How an eigenspace turns, :math:`dV = -W` where G changes by dG: the solution of a Sylvester equation.

    .. math:: G W - W V^T G V = (I - V V^T)\, dG\, V, \qquad V^T W = 0

    For Ritz vectors these are the columns of :func:`resolvent`.  Here nothing is decided and nothing is written in place, so
    that every derivative of it exists; a rotation R of the vectors makes W R of W, so that the derivative of a function that is
    blind to rotations inside the eigenspace stays blind to them.

    Args:
        gram: ``(b, D, D)``; where it is not finite the result is 0.
        vectors: ``(b, D, k)`` orthonormal.
        image: ``(b, D, k)``, dG V.
    """
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
    product = turned(gram, vectors, gradient) @ vectors.mT
    return 0.5 * (product + product.mT)


def _regularized_factor(matrix: Tensor) -> Tensor:
    """Cholesky factors; a matrix of trace about 1 that is singular to rounding gets a small multiple of the identity."""
    factor: Tensor
    factor, info = torch.linalg.cholesky_ex(matrix)
    failed = info > 0
    if on_host(matrix) and not bool(failed.any()):
        return factor
    factor, _ = torch.linalg.cholesky_ex(_shifted(matrix.clone(), torch.where(failed, 1e-10, 0.0)[:, None]))
    return factor


def _deflated(gram: Tensor, vectors: Tensor) -> Tensor:
    """G + V V^T: the eigenspace moves to the other end of the spectrum."""
    if vectors.shape[-1] == 1:
        return torch.addcmul(gram, vectors, vectors.mT)  # twice as fast as the product
    return torch.baddbmm(gram, vectors, vectors.mT)


def _shifted(matrix: Tensor, shift: Tensor | float) -> Tensor:
    """The matrix itself, with ``shift`` added to its diagonal."""
    matrix.diagonal(dim1=-2, dim2=-1).add_(shift)
    return matrix


GRAM_BLOCK, ROWS_BLOCK = 2 * 2**20, 8 * 2**20  # bytes per block
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
    basis: Tensor = _OfRows.apply(_flat(matrix), dim, keep)[0]  # type: ignore[no-untyped-call]
    return basis.reshape(*matrix.shape[:-2], dim, size)


def gram_null_space(gram: Tensor, dim: int = 1) -> GramNullSpace:
    r"""Eigenspace of the ``dim`` smallest eigenvalues of Gram matrices :math:`G = A^T A`.

    Args:
        gram: ``(*batch, D, D)`` symmetric positive semidefinite.
        dim: dimension of the null space.

    Returns:
        basis, residual, competing and degenerate; a matrix that is not finite gets a zero basis and ``degenerate``.

    Raises:
        ValueError: no square floating point matrices, or ``dim`` outside 1..D.

    Example:
        >>> import torch
        >>> found = gram_null_space(torch.diag(torch.tensor([4.0, 1e-6, 2.0], dtype=torch.float64)))
        >>> found.basis.abs().round(decimals=6).tolist(), round(float(found.competing), 3), bool(found.degenerate)
        ([[0.0, 1.0, 0.0]], 0.75, False)
    """
    _check(gram, "gram", dim)
    size = gram.shape[-1]
    if gram.shape[-2] != size:
        raise ValueError(f"gram must be square (*batch, D, D), got {tuple(gram.shape)}; null_space takes rows")
    if gram.device.type == "mps":  # no float64
        found = gram_null_space(gram.cpu(), dim)
        return GramNullSpace(*(part.to(gram.device) for part in vars(found).values()))
    basis, residual, competing, degenerate = _OfGram.apply(_flat(gram), dim)  # type: ignore[no-untyped-call]
    batch = gram.shape[:-2]
    return GramNullSpace(
        basis.reshape(*batch, dim, size), residual.reshape(*batch, dim), competing.reshape(batch), degenerate.reshape(batch)
    )


def decided_null_space(gram: Tensor, dim: int = 1) -> GramNullSpace:
    """:func:`gram_null_space` whose ``degenerate`` does not depend on the device: an accelerator waits, once, for the certificates.

    Grams ``(b, D, D)`` whose certificate fails there go to the solvers of the CPU, which look further before they give up.
    """
    found = gram_null_space(gram, dim)
    doubted = found.degenerate[:0] if on_host(gram) else found.degenerate.nonzero()[:, 0]
    if not len(doubted):
        return found
    again = gram_null_space(gram[doubted].cpu(), dim)
    pairs = zip(vars(found).values(), vars(again).values(), strict=True)
    return GramNullSpace(*(whole.index_put((doubted,), part.to(whole.device)) for whole, part in pairs))


def _check(matrix: Tensor, name: str, dim: int) -> None:
    check_tensor(name, matrix, "rows", "D", precise=False)
    if isinstance(dim, bool) or not isinstance(dim, int):
        raise ValueError(f"dim must be a whole number, got {dim!r}")
    if not 1 <= dim <= matrix.shape[-1]:
        raise ValueError(f"dim must be from 1 to D = {matrix.shape[-1]}, got {dim}")


def _flat(matrix: Tensor) -> Tensor:
    return matrix.reshape(prod(matrix.shape[:-2]), *matrix.shape[-2:])


def _gram(rows: Tensor) -> Tensor:
    """The Gram; a few columns beyond a multiple of eight, on which MKL is slow, apart (27 columns: 9.7 us instead of 16.1)."""
    size = rows.shape[-1]
    even = size - size % 8
    if not on_host(rows) or even < 16 or size - even not in (1, 2, 3):
        return rows.mT @ rows
    head, tail = rows[..., :even], rows[..., even:]
    gram = rows.new_empty(*rows.shape[:-2], size, size)
    gram[..., :even, :even] = head.mT @ head
    gram[..., even:, :] = tail.mT @ rows
    gram[..., :even, even:] = gram[..., even:, :even].mT
    return gram


def _size(matrix: Tensor) -> int:
    """Problems per block."""
    batch, rows, size = matrix.shape
    problems = max(1, min(GRAM_BLOCK // (8 * size * size), ROWS_BLOCK // (8 * max(rows, 1) * size)))
    if not on_host(matrix):
        return 256 * problems  # an accelerator wants everything at once: there the block only bounds the memory
    # as many blocks for every thread, unless that leaves too little to be worth a thread
    threads = workers()
    blocks = threads * ceil(batch / (problems * threads))
    return max(min(8, problems), ceil(batch / max(blocks, 1)))


def _few(gram: Tensor) -> bool:
    return on_host(gram) and gram.numel() <= FEW


class _OfGram(torch.autograd.Function):
    """``dim`` smallest eigenvectors of ``(b, D, D)``; derivatives of every order, reverse and forward, and a rule for vmap."""

    @staticmethod
    def forward(gram: Tensor, dim: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        found = map_blocks(lambda block: _solve_gram(block.double(), dim), gram, size=_size(gram))
        basis, residual, competing = (part.to(gram.dtype) for part in found[:3])
        return basis, residual, competing, found[3]

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

        return map_blocks(block, gram, basis, grad, size=_size(gram)), None

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, *_: None) -> tuple[Tensor, None, None, None]:
        gram, basis = ctx.saved_tensors
        moved = turned(gram.double(), basis.double().mT, tangent.double() @ basis.double().mT)
        return moved.mT.to(gram.dtype), None, None, None

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, None], gram: Tensor, dim: int) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        parts = _OfGram.apply(_merged(info, in_dims[0], gram), dim)  # type: ignore[no-untyped-call]
        return tuple(_split(info, part) for part in parts), (0, 0, 0, 0)


class _OfRows(torch.autograd.Function):
    """The same for rows ``(b, rows, D)``: the basis, and the Gram where ``keep`` saves the backward from forming it again."""

    @staticmethod
    def forward(matrix: Tensor, dim: int, keep: bool) -> tuple[Tensor, Tensor]:
        minimal = matrix.shape[-2] == matrix.shape[-1] - dim
        tiny = on_host(matrix) and matrix.numel() * matrix.shape[-1] <= TINY

        def block(matrix: Tensor) -> tuple[Tensor, Tensor]:
            a = matrix.double()
            none = a.new_empty(len(a), 0, 0)
            if minimal:
                return fix_signs(_solve_minimal(a, dim)).mT.to(matrix.dtype), none
            if tiny:
                return fix_signs(_by_svd(a, dim)).mT.to(matrix.dtype), none
            gram = _gram(a)
            return fix_signs(_solve_rows(a, gram, dim)).mT.to(matrix.dtype), gram if keep else none

        basis, gram = map_blocks(block, matrix, size=_size(matrix))
        return basis, gram

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
            return (2 * a @ gram_gradient(a.mT @ a, basis.double().mT, grad.double().mT)).to(matrix.dtype), None, None
        result = torch.empty_like(matrix, memory_format=torch.contiguous_format)

        def block(matrix: Tensor, gram: Tensor, basis: Tensor, grad: Tensor, result: Tensor) -> Tensor:
            a = matrix.double()
            scaled, scale, finite = unit_trace(gram if gram.numel() else _gram(a))
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

        map_blocks(block, matrix, gram, basis, grad, result, size=_size(matrix))
        return result, None, None

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, *_: None) -> tuple[Tensor, None]:
        matrix, basis = ctx.saved_tensors
        a, vectors = _or_zero(matrix.double()), basis.double().mT
        change = a.mT @ (tangent.double() @ vectors) + tangent.double().mT @ (a @ vectors)
        return turned(a.mT @ a, vectors, change).mT.to(matrix.dtype), None

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[int | None, None, None], matrix: Tensor, dim: int, keep: bool
    ) -> tuple[tuple[Tensor, Tensor], tuple[int, int]]:
        basis, gram = _OfRows.apply(_merged(info, in_dims[0], matrix), dim, keep)  # type: ignore[no-untyped-call]
        return (_split(info, basis), _split(info, gram)), (0, 0)


def _merged(info: Any, axis: int | None, matrix: Tensor) -> Tensor:
    """The dimension that vmap maps over as part of the batch."""
    whole = matrix.expand(info.batch_size, *matrix.shape) if axis is None else matrix.movedim(axis, 0)
    return whole.flatten(0, 1)


def _split(info: Any, part: Tensor) -> Tensor:
    return part.reshape(info.batch_size, len(part) // max(1, info.batch_size), *part.shape[1:])


def _or_zero(matrix: Tensor) -> Tensor:
    """Matrices with a number that is not finite replaced by zero ones."""
    return torch.where(torch.isfinite(matrix).flatten(1).all(-1)[:, None, None], matrix, 0.0)


def _solve_gram(gram: Tensor, dim: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Basis, residual, competing and degenerate of one block."""
    scaled, scale, finite = unit_trace(gram)
    host = on_host(gram)
    squaring = host and dim == 1 < gram.shape[-1] <= SMALL
    if dim == gram.shape[-1] or (_few(gram) and not (squaring and gram.numel() > FEWER)):
        vectors, values, competing, degenerate = by_eigh(scaled, dim)
    else:
        if squaring:
            vectors, values, competing, certified = by_squaring(scaled)
            degenerate = ~certified
        else:
            found = by_inverse_iteration(scaled, dim)
            vectors, values, competing = found.vectors, found.values, competing_sum(found.factor, found.vectors)
            degenerate = ~found.certified | (found.competing <= (RESOLVED if host else NULL))
        hard = degenerate.nonzero()[:, 0] if host else degenerate[:0]
        if len(hard):
            vectors[hard], values[hard], competing[hard], degenerate[hard] = by_eigh(scaled[hard], dim)
    basis = torch.where(finite[:, None, None], fix_signs(vectors).mT, 0.0)
    return basis, values / scale[:, None], competing * scale, degenerate | ~finite


def _solve_rows(matrix: Tensor, gram: Tensor, dim: int) -> Tensor:
    """Null spaces ``(b, D, dim)`` through the Gram, where it carries them; corrected with the rows; SVD for the rest."""
    scaled, scale, finite = unit_trace(gram)
    if dim == matrix.shape[-1]:
        return torch.where(finite[:, None, None], by_eigh(scaled, dim)[0], 0.0)
    if _few(gram):
        values, vectors = eigh(scaled)
        return _with_svd(matrix, vectors[..., :dim].contiguous(), ~finite | (values[:, dim] < ACCURATE))
    found = by_inverse_iteration(scaled, dim)
    vectors = found.vectors
    if not on_host(matrix):
        return torch.where(finite[:, None, None], _corrected(matrix, scale, vectors, found.deflated), 0.0)
    slow = (finite & ~found.certified & (found.competing > ACCURATE)).nonzero()[:, 0]
    if len(slow):
        vectors[slow] = by_eigh(scaled[slow], dim)[0]
    inexact = (finite & found.certified & (found.competing <= ACCURATE) & (found.competing > RESOLVED)).nonzero()[:, 0]
    if len(inexact):
        vectors[inexact] = _corrected(matrix[inexact], scale[inexact], vectors[inexact], found.deflated[inexact])
    return _with_svd(matrix, vectors, ~(finite & (found.competing > torch.where(found.certified, RESOLVED, ACCURATE))))


def _corrected(matrix: Tensor, scale: Tensor, vectors: Tensor, deflated: Tensor) -> Tensor:
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
