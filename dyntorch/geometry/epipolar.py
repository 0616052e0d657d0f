"""Fundamental matrices of many weightings of the same matches at once, linear and affine, and their Sampson distances.

All functions take matches ``(n, 2)`` of one pair of views that are already centred and of about unit size, at the same scale in
both views, and treat every hypothesis alike: a few products of large matrices, and small ones factorized in one batch.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.native import library
from dyntorch.numerics.blocks import constant
from dyntorch.numerics.function_transforms import is_plain
from dyntorch.numerics.nullspace import eigh

TINY = 1e-30
"""Squared gradients below it belong to a match at both epipoles, or to F = 0: the coordinates are of order 1."""
SHIFT = 1e-14
"""Of the trace: what keeps the factorization of a singular Gram finite, at the size of its rounding."""
SQUARINGS = 4
"""Of the inverse: the null vector is exact to (s_9 / s_8)^32."""


def sampson_squared(F: Tensor, x1: Tensor, x2: Tensor) -> Tensor:
    r"""Squared Sampson distances of matches: :math:`(x_2^T F x_1)^2 / (\|(F x_1)_{12}\|^2 + \|(F^T x_2)_{12}\|^2)`. F
    ``(*batch, 3, 3)``, x1, x2 ``(n, 2)`` -> ``(*batch, n)``."""
    value, square = PairMonomials(x1, x2).terms(F)
    return value.square() / square


class PairMonomials:
    """The products of coordinates in which the epipolar constraint and its squared gradient are linear and quadratic in F."""

    def __init__(self, x1: Tensor, x2: Tensor) -> None:
        """Of matches ``(n, 2)``, or of those of several pairs of views, ``(p, n, 2)``."""
        self.bilinear = bilinear(x1, x2).contiguous()
        """``(9, n)``: x2_i x1_j."""
        self.quadratic = torch.cat([_symmetric(x1), _symmetric(x2)], dim=-2)
        """``(12, n)``: x1_i x1_j, then x2_i x2_j, i <= j."""

    def terms(self, F: Tensor) -> tuple[Tensor, Tensor]:
        """The constraint and the square of its gradient, ``(*batch, n)`` each."""
        return self.flat_terms(F.flatten(-2))

    def products(self) -> Tensor:
        """``(n, 36)``: a product of two of the x2_i x1_j is one of x2_i x2_k with one of x1_j x1_l: 36 of them, not 81."""
        first, second = self.quadratic.split(6, dim=-2)
        return (second[..., :, None, :] * first[..., None, :, :]).flatten(-3, -2).mT

    def flat_terms(self, f: Tensor) -> tuple[Tensor, Tensor]:
        """The same of ``(*batch, 9)``; of several pairs ``(p, b, 9)``, each with its own."""
        square = (f[..., :, None] * f[..., None, :]).flatten(-2) @ polar(f.dtype, f.device).flatten(0, 1) @ self.quadratic
        return f @ self.bilinear, square.clamp_(min=TINY)


def bilinear(x1: Tensor, x2: Tensor) -> Tensor:
    """``(*batch, 9, n)``: the products x2_i x1_j."""
    one = torch.ones_like(x1[..., :1])
    first, second = torch.cat([x1, one], dim=-1).mT, torch.cat([x2, one], dim=-1).mT
    return (second[..., :, None, :] * first[..., None, :, :]).flatten(-3, -2)


def _symmetric(x: Tensor) -> Tensor:
    """``(*batch, 6, n)``: the products xx, xy, yy, x, y, 1 of points ``(*batch, n, 2)``."""
    a, b = x.unbind(-1)
    return torch.stack([a * a, a * b, b * b, a, b, torch.ones_like(a)], dim=-2)


@constant
def polar(dtype: torch.dtype, device: torch.device) -> Tensor:
    """``(9, 9, 12)``: two matrices to the coefficients of the inner product of the gradients of their constraints."""
    table = torch.zeros(3, 3, 3, 3, 2, 3, 3, dtype=dtype)
    for k in range(2):
        for i in range(3):
            for j in range(3):
                table[k, i, k, j, 0, i, j] += 1.0
                table[i, k, j, k, 1, i, j] += 1.0
    folding = torch.zeros(9, 6, dtype=dtype)
    for entry, monomial in enumerate((0, 1, 3, 1, 2, 4, 3, 4, 5)):
        folding[entry, monomial] = 1.0
    return (table.reshape(9, 9, 2, 9) @ folding).reshape(9, 9, 12).to(device)


def null_vector(gram: Tensor) -> Tensor:
    r"""Unit vectors to the smallest eigenvalue of small Gram matrices, as a start: accurate where it stands apart. gram
    ``(*batch, D, D)`` -> ``(*batch, D)``."""
    if is_plain(gram) and gram.dtype == torch.float64 and library.solves(gram.shape[-1], 1):
        # microseconds per matrix of D = 9 in batches of 1, 30, 1000: 12, .9, .6; by gram_null_space 99, 17, 5
        flat = gram.reshape(-1, *gram.shape[-2:])
        vector, _, _, _, certified = library.null_of_grams(flat, 1)
        hard = (~certified).nonzero()[:, 0]
        if len(hard):
            vector[hard, 0] = _by_squaring(flat[hard])
        return vector.view(gram.shape[:-1])
    return _by_squaring(gram)


def _by_squaring(gram: Tensor) -> Tensor:
    # microseconds per matrix of D = 9 in batches of 1, 30, 1000: 130, 6, 2.6
    trace = gram.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    eye = torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
    scaled = gram / torch.where(trace > 0, trace, 1.0) + SHIFT * eye
    power = torch.cholesky_inverse(torch.linalg.cholesky_ex(scaled)[0])
    # the largest eigenvalue is from 1 / D to 1 then, and its power no underflow
    power = power / power.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    for _ in range(SQUARINGS):
        power = power @ power
    power = torch.where(power.isfinite(), power, eye)
    best = power.diagonal(dim1=-2, dim2=-1).argmax(-1)[..., None, None].expand(*power.shape[:-1], 1)
    vector = power.gather(-1, best)[..., 0]
    return vector / vector.norm(dim=-1, keepdim=True)


def rank_two(F: Tensor) -> Tensor:
    """The nearest matrices of rank two to finite ``(*batch, 3, 3)``, at norm 1."""
    # a truncation, no null vector: microseconds per matrix in batches of 1, 30, 1000: 9, 2.3, 2; by null_vectors 190, 7.5, 0.8
    u, s, vt = torch.linalg.svd(F)
    s = s[..., :2] / torch.linalg.vector_norm(s[..., :2], dim=-1, keepdim=True).clamp(min=TINY)
    return (u[..., :2] * s[..., None, :]) @ vt[..., :2, :]


def eight_point(x1: Tensor, x2: Tensor, weights: Tensor, rounds: int = 0) -> Tensor:
    r"""Linear fits of weighted matches, each in Hartley's coordinates of its own weights, then rank two. x1, x2 ``(n, 2)``,
    weights ``(B, n)`` -> ``(B, 3, 3)``."""
    return eight_point_of(PairMonomials(x1, x2), weights, rounds)


def eight_point_of(data: PairMonomials, weights: Tensor, rounds: int) -> Tensor:
    products = data.products()
    weighted = weights
    for remaining in range(rounds, -1, -1):
        gram = gram_of_products(weighted @ products)
        first, second = hartley(torch.stack([gram[..., 6:, 6:], gram[..., 2::3, 2::3]])).unbind(0)
        # vec(T2^T F T1) = (T2^T (x) T1^T) vec(F)
        change = (second.mT[..., :, None, :, None] * first.mT[..., None, :, None, :]).reshape(*gram.shape)
        vector = null_vector(change.mT @ gram @ change)
        F = second.mT @ rank_two(vector.unflatten(-1, (3, 3))) @ first
        F = F / torch.linalg.matrix_norm(F, keepdim=True)
        if remaining:
            weighted = weights / data.terms(F)[1]
    return F


def gram_of_products(sums: Tensor) -> Tensor:
    """Grams ``(*batch, 9, 9)`` of the bilinear monomials from weighted sums ``(*batch, 36)`` of their products."""
    return sums[..., _places(sums.device)].unflatten(-1, (9, 9))


@constant
def _places(device: torch.device) -> Tensor:
    """Which product of ``(6, 6)`` each of the ``(9, 9)`` entries of the Gram is."""
    entry = torch.tensor([[0, 1, 3], [1, 2, 4], [3, 4, 5]])  # of xx, xy, yy, x, y, 1
    return (6 * entry[:, None, :, None] + entry[None, :, None, :]).flatten().to(device)


def hartley(moments: Tensor) -> Tensor:
    """Similarities ``(*batch, 3, 3)`` by second moments ``(*batch, 3, 3)`` of points (x, 1): centre 0, RMS distance sqrt(2)."""
    total = moments[..., 2, 2].clamp(min=TINY)
    centre = moments[..., :2, 2] / total[..., None]
    spread = (moments[..., 0, 0] + moments[..., 1, 1]) / total - centre.square().sum(-1)
    scale = torch.where(spread > 1e-12, 2 / spread, 1.0).sqrt()
    result = torch.zeros_like(moments)
    result[..., 0, 0] = result[..., 1, 1] = scale
    result[..., :2, 2] = -scale[..., None] * centre
    result[..., 2, 2] = 1.0
    return result


def affine_fundamental(x1: Tensor, x2: Tensor, weights: Tensor) -> Tensor:
    r"""Affine epipolar geometry: the hyperplane of least squares of the points :math:`(x_2, x_1)` of four-space. x1, x2
    ``(n, 2)``, weights ``(B, n)`` -> ``(B, 3, 3)``."""
    joint = torch.cat([x2, x1], dim=-1)
    total = weights.sum(-1, keepdim=True).clamp(min=TINY)
    centre = weights @ joint / total
    products = (joint[..., :, None] * joint[..., None, :]).flatten(-2)
    covariance = (weights @ products / total).unflatten(-1, (4, 4)) - centre[..., :, None] * centre[..., None, :]
    # microseconds per matrix in batches of 1, 30, 1000: 12, 3, 1.6; by gram_null_space 294, 14, 3.5
    normal = eigh(torch.nan_to_num(covariance))[1][..., 0]
    F = normal.new_zeros(*normal.shape[:-1], 3, 3)
    F[..., :2, 2], F[..., 2, :2] = normal[..., :2], normal[..., 2:]
    F[..., 2, 2] = -(normal * centre).sum(-1)
    return F / torch.linalg.matrix_norm(F, keepdim=True)


# ----------------------------------------------------------------------------------------------------------------------
# Epipolar residual variance from moment matrices: F and the mean squared Sampson distance, without the matches.


RIDGE = 1e-13
"""Relative to the trace, keeps exact moments positive definite; far below any measured noise."""
ITERATIONS = 4
"""Of inverse iteration.  The start is exact where one eigenvalue stands out; elsewhere the variance comes out larger by a few
per cent, where nobody looks."""


def gradient_moments(moments: Tensor, noise: tuple[float, float] = (1.0, 1.0)) -> Tensor:
    r"""Mean squared gradients of the epipolar constraint, as quadratic forms of F. moments ``(*batch, 9, 9)`` ->
    ``(*batch, 9, 9)``."""
    parts = moments.unflatten(-1, (3, 3)).unflatten(-3, (3, 3))  # x2, x1, x2, x1
    first = parts[..., 2, :, 2, :]  # x1 x1^T
    second = parts[..., :, 2, :, 2]  # x2 x2^T
    plane = _plane(moments.device)
    form = noise[0] ** 2 * torch.einsum("...bd,ac->...badc", second, plane)
    form = form + noise[1] ** 2 * torch.einsum("...ac,bd->...badc", first, plane)
    return form.flatten(-4, -3).flatten(-2, -1)


def epipolar_variance(moments: Tensor, noise: tuple[float, float] = (1.0, 1.0)) -> tuple[Tensor, Tensor]:
    r"""The least ratio of squared epipolar residuals to their squared gradients, and the fundamental matrix that has it.
    moments ``(*batch, 9, 9)`` -> ``(*batch,)``."""
    total = moments[..., 8, 8]
    present = total > 0
    unit = torch.eye(9, dtype=moments.dtype, device=moments.device)
    mean = torch.where(present[..., None, None], moments / torch.where(present, total, 1.0)[..., None, None], unit)
    form = gradient_moments(mean, noise)[..., :8, :8]
    edge = mean[..., :8, 8]
    inner = mean[..., :8, :8] - edge[..., :, None] * edge[..., None, :]
    ridge = RIDGE * mean[..., :8, :8].diagonal(dim1=-2, dim2=-1).sum(-1)
    inner = inner + ridge[..., None, None] * unit[:8, :8]
    variance, f = least_ratio(inner, form, present)
    whole = torch.cat([f, -(edge[..., None, :] @ f[..., None])[..., 0]], dim=-1)
    bad = ~variance.isfinite()[..., None]
    whole = torch.where(bad, 0.0, whole / torch.where(bad, 1.0, whole.norm(dim=-1, keepdim=True)))
    return variance, whole.unflatten(-1, (3, 3))


def least_ratio(inner: Tensor, form: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
    r"""The least :math:`f^T A f / f^T N f` of positive definite A and positive semidefinite N, by inverse iteration. inner
    ``(*batch, D, D)``, form ``(*batch, D, D)``, present ``(*batch,)`` -> ``(*batch,)``."""
    factor, failed = torch.linalg.cholesky_ex(inner)
    bad = ~present | (failed > 0)
    factor = torch.where(bad[..., None, None], torch.eye(inner.shape[-1], dtype=inner.dtype, device=inner.device), factor)
    columns = torch.cholesky_solve(form, factor)
    f = _longest(columns)
    for _ in range(ITERATIONS):
        f = columns @ f
        f = f / f.norm(dim=-2, keepdim=True)
    above, below = (f * (inner @ f)).sum((-2, -1)), (f * (form @ f)).sum((-2, -1))
    return torch.where(bad | (below <= 0), torch.inf, above / torch.where(below > 0, below, 1.0)), f[..., 0]


def _longest(columns: Tensor) -> Tensor:
    """``(*batch, D, 1)``: of the columns of inner^-1 form, the longest: rich in the wanted eigenvector."""
    best = columns.square().sum(-2).argmax(-1)
    start = columns.gather(-1, best[..., None, None].expand(*best.shape, columns.shape[-1], 1))
    return start / start.norm(dim=-2, keepdim=True)


@constant
def _plane(device: torch.device) -> Tensor:
    return torch.diag(torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64, device=device))


# ----------------------------------------------------------------------------------------------------------------------
# What closed forms for the matches of two views have in common: the check of what they are given, and how results print.


def check_matches(x1: Tensor, x2: Tensor, weights: Tensor | None = None) -> None:
    """Refuse what is not two views of the same points. x1 ``(*batch, n, 2)``, x2 ``(*batch, n, 2)``, weights ``(*batch, n)``."""
    for name, value in (("x1", x1), ("x2", x2), ("weights", x1 if weights is None else weights)):
        if not isinstance(value, Tensor):
            raise ValueError(f"{name} must be a torch.Tensor, got {type(value).__name__}; use torch.as_tensor(...)")
    if x1.shape != x2.shape or x1.ndim < 2 or x1.shape[-1] != 2 or not (x1.is_floating_point() and x2.is_floating_point()):
        raise ValueError(
            f"x1 and x2 must be floating point (*batch, n, 2) of one shape, got {tuple(x1.shape)} {x1.dtype} and "
            f"{tuple(x2.shape)} {x2.dtype}"
        )


def describe_labels(result: object, labels: Tensor, degenerate: Tensor, bodies: int) -> str:
    """Shape, how many matches each label has, and how many problems are degenerate, in two lines. labels ``(*batch, n)``,
    degenerate ``(*batch,)``."""
    counts = labels.flatten().bincount(minlength=bodies + 1).tolist()
    state = "degenerate" if not degenerate.ndim else f"{int(degenerate.sum())} of {degenerate.numel()} degenerate"
    state = state if degenerate.ndim or bool(degenerate) else "not degenerate"
    head = f"{type(result).__name__}(matches={labels.shape[-1]}, bodies={bodies}, batch={tuple(degenerate.shape)}: {state})"
    listed = [f"{counts[k]} of body {k}" for k in range(1, bodies + 1)] + [f"{counts[0]} unlabelled"] * bool(counts[0])
    return f"{head}\n  labels: {', '.join(listed)}"
