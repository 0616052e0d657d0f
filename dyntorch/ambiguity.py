"""Whether a second tensor explains noisy matches as well as the first one, although its residual is larger."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from dyntorch.eigenspace import eigh
from dyntorch.matrix import estimation_matrix, gram
from dyntorch.primitives import Primitive

STEP = 1e-4
"""Size of the changes that probe the noise, in normalized coordinates."""
ENOUGH = 1000
"""Matches that the noise is read off."""
MARGIN = 6.0
"""Energy of the second tensor over what the noise alone gives it, below which nothing but noise speaks against it.  Measured: 0.3
to 4.5 where velocities lie in a plane or all lines belong to one rigid body; for general motion 10 to 25 at noise of 0.5 % of the
scene (60 matches), and four times as much at half of it."""
TURN = 0.08
"""Ratio of the residuals of the best tensor and the second, the angle by which noise turns one to the other, up to which an
invariant that resolves noise keeps its best.  Measured for the homography tensor at 0.5 px: 0.004 to 0.02 where all points stand
still, 0.02 to 0.1 for general motion (30 to 300 matches), 0.15 to 0.7 where all make equal steps of 40 px (80 and 300 matches,
errors of 4 to 32 px)."""


def within_noise(
    primitives: Sequence[Primitive], views: Sequence[Tensor], weights: Tensor, static: Tensor | None, basis: Tensor, resolves: bool
) -> Tensor:
    r"""Whether the residual of the second best tensor is explained by the noise that the best one shows.

    Points that nearly fulfil many tensors at once (all static, all velocities in one plane) give the best tensor a residual
    of second order in the noise and the others one of first order.  The ratio of singular values then looks healthy, but the
    best tensor is not the true one.  The noise is read off the best tensor, :math:`\sigma^2 = |R v|^2 / |\partial R v|^2`, and
    the second one, u, is refuted only if :math:`|R u|^2` exceeds :math:`\sigma^2 |\partial R u|^2` clearly; the derivatives are
    probed by one small random change of all measurements.

    A tensor that singular points fulfil to second order, as the homography tensor static ones, is the best of all by far in spite
    of that; points with equal steps fulfil four homography tensors to first order, and the best is one of a family by accident.

    Args:
        primitives: one per view.
        views: ``(b, n, ...)`` normalized matches.
        weights: ``(b, n)``.
        static: ``(b, n)`` bool.
        basis: ``(b, nullity, D)`` the null space found.
        resolves: whether the best tensor is the true one where its residual is smaller by far.

    Returns:
        ``(b,)`` bool.
    """
    g = gram(primitives, views, weights, static)
    # a part of very many matches tells as much about the noise
    step = -(-weights.shape[1] // ENOUGH)
    views, weights = [x[:, ::step] for x in views], weights[:, ::step]
    static = None if static is None else static[:, ::step]
    second = eigh(g)[1][..., basis.shape[-2], None]
    # a generator of its own: the same matches get the same answer, on any device and beside any others, and the caller's random
    # numbers stay
    draw = torch.Generator().manual_seed(0)
    shifts = [STEP * torch.randn(x.shape[1:], generator=draw, dtype=x.dtype).to(x.device).expand_as(x) for x in views]
    moved = [p.disturbed(x, change) for p, x, change in zip(primitives, views, shifts, strict=True)]
    rows = estimation_matrix(primitives, views, weights, static)
    change = estimation_matrix(primitives, moved, weights, static) - rows
    first = basis.mT
    left, other = (rows @ first).square().mean((-2, -1)), (rows @ second).square().mean((-2, -1))
    noise = left / (change @ first).square().mean((-2, -1)).clamp(min=1e-300)
    energy = other / (change @ second).square().mean((-2, -1)).clamp(min=1e-300)
    near = energy <= MARGIN * noise
    return near & (left > TURN**2 * other) if resolves else near
