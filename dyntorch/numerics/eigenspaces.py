"""Eigenspaces of the smallest eigenvalues of many small Gram matrices, with a certificate: what null spaces are found by."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from math import ceil

import torch
from torch import Tensor

from dyntorch.numerics.blocks import constant, workers

# Everything here takes ``(b, D, D)`` float64 matrices scaled to trace 1 and has the vectors as columns.  A decision that looks
# at values is made on the CPU only: on an accelerator it would wait for everything queued before it.


EPS = torch.finfo(torch.float64).eps
ANGLE = 1e-11  # that an accepted eigenspace may be off by, rounding of the Gram apart
NULL = 1e-14  # of the largest eigenvalue: below it a Gram holds rounding only (rank defects below 9e-16, kappa 1e6 1e-12)
SQUARINGS = 5  # of the inverse at most: enough for a ratio of the last two singular values of 0.67
GRAM_BLOCK, ROWS_BLOCK = 2 * 2**20, 8 * 2**20  # bytes per block
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


def gram_of(rows: Tensor) -> Tensor:
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


def block_size(matrix: Tensor) -> int:
    """Problems per block."""
    batch, rows, size = matrix.shape
    problems = max(1, min(GRAM_BLOCK // (8 * size * size), ROWS_BLOCK // (8 * max(rows, 1) * size)))
    if not on_host(matrix):
        return 256 * problems  # an accelerator wants everything at once: there the block only bounds the memory
    # as many blocks for every thread, unless that leaves too little to be worth a thread
    threads = workers()
    blocks = threads * ceil(batch / (problems * threads))
    return max(min(8, problems), ceil(batch / max(blocks, 1)))


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
    solution: Tensor = torch.linalg.solve_triangular(factor.mT, half, upper=True)
    return solution


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
    r"""Subspace iteration with :math:`(G + \mu I)^{-1}`, then Newton corrections with a certificate. gram ``(b, D, D)``."""
    size, host = gram.shape[-1], on_host(gram)
    factor, indefinite = torch.linalg.cholesky_ex(add_to_diagonal(gram.clone(), size * EPS))
    # half an iteration: any start is as good as any other
    block = orthonormal(torch.linalg.solve_triangular(factor.mT, _generic(size, dim + 1, gram.device), upper=True))
    for _ in range(2 if host else 6):
        block = orthonormal(solve(block, factor))
    block, values = ritz(gram, block)
    vectors = block[..., :dim]
    sigma, competing = values[:, dim - 1].clamp(0.0, 1.0), values[:, dim]
    deflated, missed = torch.linalg.cholesky_ex(add_to_diagonal(raise_eigenspace(gram, vectors), -sigma[:, None]))
    sound = (indefinite == 0) & (missed == 0)
    vectors, values, bound = newton(gram, deflated, vectors, sigma, competing)
    if host:
        for _ in range(8):
            rest = (sound & (bound > ANGLE)).nonzero()[:, 0]
            if len(rest) == 0:
                break
            corrected = newton(gram[rest], deflated[rest], vectors[rest], sigma[rest], competing[rest])
            vectors[rest], values[rest], bound[rest] = corrected
    else:
        for _ in range(2):
            vectors, values, bound = newton(gram, deflated, vectors, sigma, competing)
    if dim > 1:
        vectors, values = ritz(gram, vectors)
    return Eigenspace(vectors, values.clamp(min=0.0), competing, sound & (bound <= ANGLE), factor, deflated)


def by_squaring(gram: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    r"""The smallest eigenvalue by k squarings of the inverse: every column is multiplied by :math:`G^{-2^k}`. gram
    ``(b, D, D)`` -> ``(b, D, 1)``."""
    size = gram.shape[-1]
    factor, indefinite = torch.linalg.cholesky_ex(add_to_diagonal(gram.clone(), size * EPS))
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


def jacobi(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Ascending eigenvalues and eigenvectors of tiny symmetric matrices: unlike eigh it never waits to check for errors."""
    size = matrix.shape[-1]
    eye = torch.eye(size, dtype=matrix.dtype, device=matrix.device)
    vectors = eye.expand_as(matrix)
    pairs = list(combinations(range(size), 2))
    for i, j in pairs * (6 if size > 2 else 1):
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


def raise_eigenspace(gram: Tensor, vectors: Tensor) -> Tensor:
    """G + V V^T: the eigenspace moves to the other end of the spectrum."""
    if vectors.shape[-1] == 1:
        return torch.addcmul(gram, vectors, vectors.mT)  # twice as fast as the product
    return torch.baddbmm(gram, vectors, vectors.mT)


def add_to_diagonal(matrix: Tensor, shift: Tensor | float) -> Tensor:
    """The matrix itself, with ``shift`` added to its diagonal."""
    matrix.diagonal(dim1=-2, dim2=-1).add_(shift)
    return matrix
