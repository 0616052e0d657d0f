"""Epipolar residual variance from moment matrices: F and the mean squared Sampson distance, without the matches."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.constants import constant

RIDGE = 1e-13
"""Relative to the trace, keeps exact moments positive definite; far below any measured noise."""
ITERATIONS = 4
"""Of inverse iteration.  The start is exact where one eigenvalue stands out; elsewhere the variance comes out larger by a few
per cent, where nobody looks."""


def gradient_moments(moments: Tensor, noise: tuple[float, float] = (1.0, 1.0)) -> Tensor:
    r"""Mean squared gradients of the epipolar constraint, as quadratic forms of F.

    .. math:: f^T N f = \sum \sigma_1^2 |(F^T x_2)_{1,2}|^2 + \sigma_2^2 |(F x_1)_{1,2}|^2

    Its entries are among those of the moments: the products of one camera's coordinates with the other's 1.

    Args:
        moments: ``(*batch, 9, 9)`` of :math:`x_2 \otimes x_1`, as :func:`dyntorch.lags.epipolar_moments` gives them.
        noise: standard deviations of the coordinates of view 1 and view 2, in their units.

    Returns:
        ``(*batch, 9, 9)``; row and column 8 are 0.
    """
    parts = moments.unflatten(-1, (3, 3)).unflatten(-3, (3, 3))  # x2, x1, x2, x1
    first = parts[..., 2, :, 2, :]  # x1 x1^T
    second = parts[..., :, 2, :, 2]  # x2 x2^T
    plane = _plane(moments.device)
    form = noise[0] ** 2 * torch.einsum("...bd,ac->...badc", second, plane)
    form = form + noise[1] ** 2 * torch.einsum("...ac,bd->...badc", first, plane)
    return form.flatten(-4, -3).flatten(-2, -1)


def epipolar_variance(moments: Tensor, noise: tuple[float, float] = (1.0, 1.0)) -> tuple[Tensor, Tensor]:
    r"""The least ratio of squared epipolar residuals to their squared gradients, and the fundamental matrix that has it.

    .. math:: \lambda = \min_f \frac{f^T M f}{f^T N f}

    With isotropic noise the residual's variance is :math:`f^T N f`, so that the ratio is about the variance of the noise in
    units of
    ``noise``, whatever the scale and the place of the points; the plain smallest eigenvalue of M, which fixes :math:`|f| = 1`
    instead, prefers where F costs little.  N has no entry for :math:`f_9`; it is eliminated, which centres the products.

    Args:
        moments: ``(*batch, 9, 9)``, sums or means; coordinates should be normalized.
        noise: as in :func:`gradient_moments`.

    Returns:
        ``(*batch,)`` variances, infinite where there are no moments, and ``(*batch, 3, 3)`` fundamental matrices of norm 1
        (rank 2 is not imposed), 0 there.

    Source: Taubin 1991, Estimation of planar curves, surfaces and nonplanar space curves.

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> space = torch.rand(50, 3, generator=g, dtype=torch.float64)
        >>> x1, x2 = space[:, :2] / (2 + space[:, 2:]), space[:, :2] / (3 + space[:, :1])
        >>> x1, x2 = x1 + 0.01 * torch.randn(50, 2, generator=g), x2 + 0.01 * torch.randn(50, 2, generator=g)
        >>> one = torch.ones(50, 1)
        >>> z = torch.einsum("ni,nj->nij", torch.cat([x2, one], 1), torch.cat([x1, one], 1)).flatten(1)
        >>> variance, _ = epipolar_variance(z.T @ z)
        >>> 0.007 < float(variance.sqrt()) < 0.013
        True
    """
    total = moments[..., 8, 8]
    present = total > 0
    unit = torch.eye(9, dtype=moments.dtype, device=moments.device)
    mean = torch.where(present[..., None, None], moments / torch.where(present, total, 1.0)[..., None, None], unit)
    form = gradient_moments(mean, noise)[..., :8, :8]
    edge = mean[..., :8, 8]
    inner = mean[..., :8, :8] - edge[..., :, None] * edge[..., None, :]
    ridge = RIDGE * mean[..., :8, :8].diagonal(dim1=-2, dim2=-1).sum(-1)
    inner = inner + ridge[..., None, None] * unit[:8, :8]
    factor, failed = torch.linalg.cholesky_ex(inner)
    bad = ~present | (failed > 0)
    factor = torch.where(bad[..., None, None], unit[:8, :8], factor)
    f = _start(form, factor)
    for _ in range(ITERATIONS):
        f = torch.cholesky_solve(form @ f, factor)
        f = f / f.norm(dim=-2, keepdim=True)
    above, below = (f * (inner @ f)).sum((-2, -1)), (f * (form @ f)).sum((-2, -1))
    variance = torch.where(bad | (below <= 0), torch.inf, above / torch.where(below > 0, below, 1.0))
    whole = torch.cat([f[..., 0], -(edge[..., None, :] @ f)[..., 0]], dim=-1)
    whole = torch.where(bad[..., None], 0.0, whole / whole.norm(dim=-1, keepdim=True))
    return variance, whole.unflatten(-1, (3, 3))


def _start(form: Tensor, factor: Tensor) -> Tensor:
    """``(*batch, 8, 1)``: of the columns of inner^-1 form, the longest: rich in the wanted eigenvector."""
    columns = torch.cholesky_solve(form, factor)
    best = columns.square().sum(-2).argmax(-1)
    start = columns.gather(-1, best[..., None, None].expand(*best.shape, 8, 1))
    return start / start.norm(dim=-2, keepdim=True)


@constant
def _plane(device: torch.device) -> Tensor:
    return torch.diag(torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64, device=device))
