r"""Moving shapes that few points and projective cameras determine: for understanding and tests, too ill-conditioned for noise.

The degrees and counts are those of the thesis: general projective views of six points take 49 frames, a static reference plane
with two moving points 8, four static points and a moving one 3, and of five points seen at an unknown time one condition is left.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.numerics.blocks import constant
from dyntorch.numerics.nullspace import null_space
from dyntorch.shapes.basis import Polynomial
from dyntorch.shapes.static import canonical, general_rows

SIX_DEGREE = 9
"""Degree in the time of the dual fundamental matrix of six points of constant velocity."""


def six_point_rows(x: Tensor, times: Tensor) -> Tensor:
    r"""Rows of :math:`p_5^T F(t)\, p_6 = 0` for six points of constant velocity and projective cameras, F of degree 9 in t. x
    ``(*batch, views, 6, 2)``, times ``(*batch, views)`` -> ``(*batch, views, 50)``."""
    row = general_rows(_homogeneous(x, 6))[..., 0, :]
    return (Polynomial(SIX_DEGREE).rows(times)[..., None] * row[..., None, :]).flatten(-2)


def reference_plane_rows(x: Tensor, times: Tensor) -> Tensor:
    r"""Rows of :math:`(p_5 \times p_6)^T (e_0 + e_1 t + e_2 t^2) = 0`: four static coplanar points and two of constant
    velocity. x ``(*batch, views, 6, 2)``, times ``(*batch, views)`` -> ``(*batch, views, 9)``."""
    first, second = canonical(_homogeneous(x, 6))[0].unbind(-2)
    line = torch.linalg.cross(first, second)
    return (Polynomial(2).rows(times)[..., None] * line[..., None, :]).flatten(-2)


def moving_point(x: Tensor, times: Tensor) -> Tensor:
    r"""The affine coordinates of a point of constant velocity in four static ones:
    :math:`x_5 = \sum_i (\alpha_i + t \beta_i) x_i`. x ``(*batch, views, 5, 2)``, times ``(*batch, views)`` ->
    ``(*batch, 2, 4)``."""
    if x.shape[-2] != 5 or x.shape[-3] < 3:
        raise ValueError(f"x must be (*batch, views >= 3, 5, 2), got {tuple(x.shape)}")
    differences = x[..., [0, 1, 2, 4], :] - x[..., 3:4, :]
    known = (times[..., None, None, None] ** torch.arange(2, device=x.device)[:, None, None]) * differences[..., None, :3, :]
    matrix = known.flatten(-3, -2).mT.flatten(-3, -2)  # (.., 2 views, 6)
    right = differences[..., 3, :].flatten(-2)
    q, r = torch.linalg.qr(matrix)
    found = torch.linalg.solve_triangular(r, q.mT @ right[..., None], upper=True)[..., 0].unflatten(-1, (2, 3))
    total = torch.tensor([1.0, 0.0], dtype=x.dtype, device=x.device)
    return torch.cat([found, (total - found.sum(-1))[..., None]], dim=-1)


def resultant(annihilator: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    r"""The condition on a view of five points at an unknown time, and that time. annihilator ``(*batch, d + 1, 5, 1)``, x
    ``(*batch, 5, 2)`` -> ``(*batch,)``."""
    if x.shape[-2] != 5 or annihilator.shape[-2:] != (5, 1):
        raise ValueError(f"a resultant takes five points, got {tuple(annihilator.shape)} and {tuple(x.shape)}")
    centred = x - x.mean(-2, keepdim=True)
    chebyshev = torch.einsum("...ki,...id->...dk", annihilator[..., 0], centred)
    degree = chebyshev.shape[-1] - 1
    powers = chebyshev @ _to_powers(degree, x.device)  # (.., 2, d + 1), lowest first
    powers = powers / powers.norm(dim=-1, keepdim=True).clamp(min=torch.finfo(x.dtype).tiny)
    shifted = [torch.nn.functional.pad(powers, (k, degree - 1 - k)) for k in range(degree)]
    sylvester = torch.stack(shifted, dim=-2).flatten(-3, -2)  # rows t^k p, t^k q; columns 1, t, ..., t^{2 d - 1}
    null = null_space(sylvester)[..., 0, :]
    # all ratios of neighbours are the root: least squares
    low, high = null[..., :-1], null[..., 1:]
    root = (low * high).sum(-1) / low.square().sum(-1).clamp(min=torch.finfo(x.dtype).tiny)
    return torch.linalg.det(sylvester), root


@constant
def _to_powers(degree: int, device: torch.device) -> Tensor:
    """From Chebyshev coefficients to those of powers, ``(d + 1, d + 1)``."""
    nodes = Polynomial(degree).nodes(degree + 1)
    vandermonde = nodes[:, None] ** torch.arange(degree + 1)
    return torch.linalg.solve(vandermonde, Polynomial(degree).rows(nodes)).mT.to(device)


def _homogeneous(x: Tensor, count: int) -> Tensor:
    if x.shape[-2:] != (count, 2):
        raise ValueError(f"x must be (*batch, views, {count}, 2), got {tuple(x.shape)}")
    return torch.cat([x, torch.ones_like(x[..., :1])], dim=-1)
