"""Eigenspaces of the smallest eigenvalues of many small Gram matrices, with a certificate, and their reduced resolvent.

Everything here takes ``(b, D, D)`` float64 matrices scaled to trace 1 and has the vectors as columns.  A decision that looks
at values is made on the CPU only: on an accelerator it would wait for everything queued before it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import torch
from torch import Tensor

from dyntorch.constants import constant

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
